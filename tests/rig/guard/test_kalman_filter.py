"""The filter of the rig is the Kalman filter of its equations, wherever a drive and a sensor may be off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.end_to_end.conftest import small_plant
from tests.rig.makers import make_heater
from thermogrip.rig.guard.kalman_filter import (
    Estimate,
    FilterSettings,
    History,
    InputSteps,
    RigFilter,
    RigModel,
)
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

A = np.array([[0.95, 0.02], [0.06, 0.9]])
B = np.array([0.4, -0.1])
C = np.array([[1.0, 0.0], [0.5, 0.5]])
LEVEL, OFFSET, HALF = np.array([25.0, 24.0]), np.array([0.3, -0.2]), 50.0
BELIEF = FilterSettings(state=0.03, drive=0.01, output=0.02, reading=0.1)


def plant() -> Plant:
    """Two outputs of which the second is the reference, behind a drive in percent and a step of 2 s."""
    model = StateSpaceModel(
        ("q",),
        ("hall",),
        ("a", "b"),
        A=A,
        B=B[:, None] / HALF,
        E=np.zeros((2, 1)),
        C=C,
        dt=2.0,
        y0=LEVEL,
    )
    units = {"q": "percent", "hall": "degC", "a": "degC", "b": "degC"}
    offsets = dict(zip("ab", OFFSET.tolist()))
    return Plant(model, {}, dt=2.0, units=units, offsets=offsets, noise={"a": 0.2, "b": 0.01}, reference="b")


def at_rest() -> RigFilter:
    made = RigFilter(RigModel(plant()), BELIEF, 100)
    made.reset(0.0, 25.0 + OFFSET, np.array([25.0]))
    assert made.at_rest
    return made


class Textbook:
    """z = (x, w, b of the first output): x+ = A x + B (u + w), y = C x + b + levels, written down."""

    def __init__(self, x: np.ndarray, spread: float = 1.0) -> None:
        self.F = np.eye(4)
        self.F[:2, :2], self.F[:2, 2] = A, B
        self.H = np.hstack([C, np.zeros((2, 1)), [[1.0], [0.0]]])
        self.Q = np.diag([0.03**2, 0.03**2, 0.01**2, 0.02**2]) * 2.0
        self.R = np.diag([0.2**2, 0.1**2])  # no sensor counts as better than the settings say
        self.z = np.array([*x, 0.0, 0.0])
        self.P = np.diag([0.5**2 * spread, 0.5**2 * spread, 0.03**2, 0.3**2])

    def predict(self, q: float) -> None:
        self.z = self.F @ self.z + np.array([*(B * q / HALF), 0.0, 0.0])
        self.P = self.F @ self.P @ self.F.T + self.Q

    def correct(self, y: np.ndarray) -> None:
        seen = np.isfinite(y)
        H, R = self.H[seen], self.R[np.ix_(seen, seen)]
        K = self.P @ H.T @ np.linalg.inv(H @ self.P @ H.T + R)
        self.z = self.z + K @ (y - self.expected())[seen]
        self.z[2] = np.clip(self.z[2], -0.5, 0.5)  # a drive's bias is at most half of half its range
        self.P = (np.eye(4) - K @ H) @ self.P

    def expected(self) -> np.ndarray:
        return np.asarray(self.H @ self.z + LEVEL + OFFSET)

    def spread(self) -> np.ndarray:
        return np.sqrt(np.diag(self.H @ self.P @ self.H.T + self.R))


@pytest.mark.parametrize("seed", range(12))
def test_state_and_biases_are_those_of_the_textbook(seed: int) -> None:
    rng, found = np.random.default_rng(seed), at_rest()
    want = Textbook(found.x.copy())
    for k in range(1, 26):
        q = float(rng.uniform(20.0, 80.0))
        found.predict(2.0 * k, np.array([q]), np.array([np.nan]))
        want.predict(q)
        np.testing.assert_allclose(found.expected, want.expected(), atol=1e-6)
        np.testing.assert_allclose(found.spread(), want.spread(), rtol=1e-4)
        y = LEVEL + OFFSET + np.where(rng.random(2) < 0.2, np.nan, rng.uniform(-1.0, 1.0, 2))
        found.correct(y)
        want.correct(y)
        np.testing.assert_allclose([*found.x, found.w[0], found.b[0]], want.z, atol=1e-5)
    assert found.b[1] == 0.0  # the reference has no bias
    assert found.d.tolist() == [25.0]  # the room's last reading


def test_a_silence_of_some_steps_makes_as_much_less_known_as_these_steps() -> None:
    once = at_rest()
    want = Textbook(once.x.copy())
    want.Q *= 100.0  # so that it is this that counts
    once._q = once._q * 100.0
    for _ in range(3):
        want.predict(40.0)
    once.predict(6.0, np.array([40.0]), np.array([25.0]))
    np.testing.assert_allclose(once.expected, want.expected(), atol=1e-6)
    # what comes in between counts from the end of the silence, not from where it came
    np.testing.assert_allclose(once.spread(), want.spread(), rtol=0.1)


def test_what_is_not_described_for_a_while_is_known_as_little_as_at_first_besides() -> None:
    found = at_rest()
    want = Textbook(found.x.copy())
    for k in range(1, 30):
        found.predict(2.0 * k, np.array([40.0]), np.array([25.0]))
        want.predict(40.0)
        found.correct(LEVEL + OFFSET)
        want.correct(LEVEL + OFFSET)
    found.loosen()
    want.P[:2, :2] += 0.25 * np.eye(2)
    np.testing.assert_allclose(found.spread(), want.spread(), rtol=1e-4)


@pytest.mark.parametrize(
    ("y", "room", "rests"),
    [
        ((25.3, 24.9), 25.0, True),  # 25.0 and 25.1 without what the sensors read too much
        ((25.3, 25.49), 25.0, True),  # 0.69 K apart
        ((25.3, 25.51), 25.0, False),
        ((27.29, 26.79), 25.0, True),  # 1.99 K above the room
        ((23.29, 22.79), 25.0, False),  # 2.01 K below it
        ((25.3, np.nan), 25.0, True),
        ((np.nan, np.nan), 25.0, False),
    ],
)
def test_a_rig_rests_where_its_sensors_agree_with_each_other_and_with_the_room(
    y: tuple[float, float], room: float, rests: bool
) -> None:
    made = RigFilter(RigModel(plant()), BELIEF, 100)
    made.reset(0.0, np.array(y), np.array([room]))
    assert made.at_rest == rests
    times = Textbook(made.x, 1.0 if rests else 100.0)
    np.testing.assert_allclose(made.spread(), times.spread(), rtol=1e-9)
    if not rests:  # the reference says how warm it is, the room where nothing does
        level = np.nan_to_num(y[1] - OFFSET[1], nan=25.0)
        want = made.model.plant.model.rest(np.full(2, level), np.zeros(1), np.array([room]), made.model.p)
        np.testing.assert_allclose(made.x, want, atol=1e-9)


def test_a_room_that_is_not_read_is_as_warm_as_the_rig_and_a_pump_runs() -> None:
    made = RigFilter(RigModel(plant()), BELIEF, 100)
    made.reset(0.0, np.array([30.3, 29.7]), np.array([np.nan]))
    assert made.d.tolist() == [30.0]
    small = RigFilter(RigModel(small_plant()), BELIEF, 9)
    small.reset(0.0, np.array([25.0, 25.0]), np.array([25.0]))
    assert small.u.tolist() == [0.0, 1.0]


@pytest.mark.parametrize(("spread", "unit"), [(1.0, 0.5), (1e-4, 0.1)])
def test_a_state_is_as_uncertain_as_the_fit_says_and_no_less_than_a_tenth(spread: float, unit: float) -> None:
    known = plant()
    model = replace(known.model, C=np.eye(2), spread=np.diag([4.0, spread]))
    made = RigFilter(RigModel(replace(known, model=model)), BELIEF, 9)
    made.reset(0.0, 25.0 + OFFSET, np.array([25.0]))
    want = [0.5**2 + 0.3**2 + 0.2**2, (0.5 * unit) ** 2 + 0.1**2]
    np.testing.assert_allclose(made.spread() ** 2, want)
    np.testing.assert_allclose(made._q, [0.03**2, (0.03 * unit) ** 2, 0.01**2, 0.02**2])


def test_a_jump_is_beyond_its_deviations_and_the_floor() -> None:
    found = at_rest()
    settings_ = replace(BELIEF, jump_k=2.0, jump_floor=0.5)
    for jump_k, jump_floor, limit in ((2.0, 0.1, 2 * found.spread()[0]), (0.1, 0.5, 0.5)):
        found.settings = replace(settings_, jump_k=jump_k, jump_floor=jump_floor)
        at = float(found.expected[0])
        for off in (limit, -limit):
            assert found.is_jump(0, at + 1.01 * off)
            assert not found.is_jump(0, at + 0.99 * off)


def test_between_two_steps_the_reading_lies_between_theirs() -> None:
    found = at_rest()
    found.predict(2.0, np.array([80.0]), np.array([25.0]))
    begin = found.expected.copy()
    for share in (0.25, 0.75):
        found.predict(2.0 + 2.0 * share, np.array([80.0]), np.array([25.0]))
        state = A @ found.x + B * 80.0 / HALF
        want = begin + share * (C @ state + LEVEL + OFFSET - begin)
        np.testing.assert_allclose(found.expected, want, atol=1e-9)


def test_the_bias_of_a_drive_ends_at_half_of_half_its_range() -> None:
    found = at_rest()
    y = LEVEL + OFFSET
    for k in range(1, 400):
        found.predict(2.0 * k, np.array([10.0]), np.array([25.0]))
        y = y + 0.5
        found.correct(y)
        assert abs(found.w[0]) <= 0.5
    assert found.w[0] == 0.5
    # and what a driver gives is its command and the bias, no further than the bias beyond its range
    assert found.driven(np.array([[10.0], [100.0]])).tolist() == [[35.0], [125.0]]


# ---- inputs between readings ----


NOTHING = np.zeros(0)


def heater() -> RigFilter:
    """A filter that keeps ten steps of 1 s, at rest at 25 degC."""
    made = RigFilter(RigModel(make_heater()), FilterSettings(), 10)
    made.reset(0.0, np.array([25.0]), NOTHING)
    return made


@pytest.mark.parametrize(
    ("unit", "valid", "span", "half"),
    [("W", None, (-1.0, 1.0), 1.0), ("W", (2.0, 8.0), (2.0, 8.0), 3.0),
     ("percent", (2.0, 8.0), (0.0, 100.0), 50.0), ("0_255", None, (0.0, 255.0), 127.5),
     (None, (-0.2, 0.8), (-1.0, 1.0), 1.0), (None, (0.0, 100.0), (0.0, 100.0), 50.0)],
)  # fmt: skip
def test_a_drive_has_the_range_of_its_unit_else_of_its_logs(
    unit: str | None, valid: tuple[float, float] | None, span: tuple[float, float], half: float
) -> None:
    units, spans = {} if unit is None else {"q": unit}, {} if valid is None else {"q": valid}
    model = RigModel(replace(make_heater(), units=units, valid=spans))
    assert (model.ranges.tolist(), model.half.tolist()) == ([list(span)], [half])
    assert model.biased(np.array([[2.0], [3.0]]), np.array([0.1])).tolist() == [
        [2.0 + 0.1 * half],
        [3.0 + 0.1 * half],
    ]
    assert model.offsets.tolist() == [0.0]


def estimate(time: float, step: int, *y: float) -> Estimate:
    return Estimate(time, step, np.zeros(1), np.zeros(1), np.zeros(len(y)), np.array(y))


def test_a_history_keeps_its_seconds_and_finds_where_a_window_begins() -> None:
    steps = InputSteps(dt=1.0, start=0.0, time=0.0)
    past = History(steps, 3.0)
    for k in range(6):
        past.add(estimate(float(k), k))
    assert past.now == 5.0
    assert [one.time for one in past.after(0.0)] == [2.0, 3.0, 4.0, 5.0]
    assert [one.time for one in past.after(4.0)] == [5.0]
    for time, step in ((2.0, 2), (3.0 - 5e-7, 3), (2.9, 2), (99.0, 5)):
        assert past.begin(time).step == step
    assert past.begin(1.9) is None
    steps.first = 3
    assert (past.begin(2.9), past.begin(3.0).step) == (None, 3)  # inputs of the second step are lost


def test_errors_are_readings_less_paths_at_their_steps() -> None:
    past = History(InputSteps(dt=1.0, start=0.0, time=0.0), 99.0)
    for k, y in ((3, 0.0), (4, 5.0), (6, 7.0)):
        past.add(estimate(float(k), k, y))
    paths = np.array([[[0.0], [1.0], [2.0], [3.0]], [[0.0], [0.5], [0.0], [10.0]]])
    errors = past.errors(past.begin(3.0), paths)
    assert errors.tolist() == [[[4.0], [4.0]], [[4.5], [-3.0]]]


@pytest.mark.parametrize("silence", [5, 15, 40])
def test_a_long_silence_counts_as_many_short_waits(silence: int) -> None:
    once, often = heater(), heater()
    for made in (once, often):
        made.predict(1.0, np.array([0.2]), NOTHING)
    once.predict(1.0 + silence, np.array([0.8]), NOTHING)
    for k in range(silence):
        often.predict(2.0 + k, np.array([0.8]), NOTHING)
    np.testing.assert_allclose(once.expected, often.expected, rtol=1e-12)


def test_steps_that_are_forgotten_are_refused() -> None:
    steps = InputSteps(dt=1.0, start=0.0, time=0.0)
    for k in range(1, 8):
        steps.add(float(k), np.array([float(k)]), NOTHING, keep=3)
    assert steps.rows(4)[0].tolist() == [[5.0], [6.0], [7.0]]
    with pytest.raises(ValueError, match="the oldest that is kept is 4"):
        steps.rows(3)


def test_inputs_are_averaged_over_each_native_step() -> None:
    steps = InputSteps(dt=2.0, start=0.0, time=0.0)
    assert [steps.add(t, np.array([u]), NOTHING, keep=10) for t, u in ((1.0, 1.0), (2.5, 0.0))] == [0, 1]
    assert steps.rows(0)[0].tolist() == [[0.5]]
    assert steps.part(2.5) == 0.25
    assert (
        steps.add(6.0 - 5e-10, np.array([4.0]), NOTHING, keep=1) == 2
    )  # until the third step, but for rounding
    assert steps.rows(1)[0].tolist() == [[3.0], [4.0]]  # 0.5 s of 0, then 4; those of one call are all kept
    assert steps.add(6.5, np.array([2.0]), NOTHING, keep=1) == 0
    assert steps.add(8.0, np.array([6.0]), NOTHING, keep=1) == 1
    assert steps.rows(3)[0].tolist() == [[5.0]]
