"""The filter of the rig is the Kalman filter of its equations, wherever a drive and a sensor may be off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.end_to_end.conftest import small_plant
from tests.rig.makers import make_heater
from thermogrip.rig.guard.kalman_filter import RigFilter
from thermogrip.rig.guard.settings import ModelSettings
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

A = np.array([[0.95, 0.02], [0.06, 0.9]])
B = np.array([0.4, -0.1])
C = np.array([[1.0, 0.0], [0.5, 0.5]])
LEVEL, OFFSET, HALF = np.array([25.0, 24.0]), np.array([0.3, -0.2]), 50.0
BELIEF = ModelSettings(
    state_K_per_sqrt_s=0.03, drive_per_sqrt_s=0.01, output_K_per_sqrt_s=0.02, reading_K=0.1
)


def plant() -> Plant:
    """Two outputs of which the second is the reference, behind a drive in percent and a step of 2 s."""
    model = StateSpaceModel(
        ("q",), ("hall",), ("a", "b"), A=A, B=B[:, None] / HALF, E=np.zeros((2, 1)), C=C, dt=2.0, y0=LEVEL
    )
    units = {"q": "percent", "hall": "degC", "a": "degC", "b": "degC"}
    offsets = dict(zip("ab", OFFSET.tolist()))
    return Plant(model, {}, dt=2.0, units=units, offsets=offsets, noise={"a": 0.2, "b": 0.01}, reference="b")


def at_rest(**settings: float) -> RigFilter:
    made = RigFilter(plant(), BELIEF.model_copy(update=settings), 100)
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
        found.correct(2.0 * k, y)
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
        found.correct(2.0 * k, LEVEL + OFFSET)
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
    made = RigFilter(plant(), BELIEF, 100)
    made.reset(0.0, np.array(y), np.array([room]))
    assert made.at_rest == rests
    times = Textbook(made.x, 1.0 if rests else 100.0)
    np.testing.assert_allclose(made.spread(), times.spread(), rtol=1e-9)
    if not rests:  # the reference says how warm it is, the room where nothing does
        level = np.nan_to_num(y[1] - OFFSET[1], nan=25.0)
        want = plant().model.rest(np.full(2, level), np.zeros(1), np.array([room]), plant().p)
        np.testing.assert_allclose(made.x, want, atol=1e-9)


def test_a_room_that_is_not_read_is_as_warm_as_the_rig_and_a_pump_runs() -> None:
    made = RigFilter(plant(), BELIEF, 100)
    made.reset(0.0, np.array([30.3, 29.7]), np.array([np.nan]))
    assert made.d.tolist() == [30.0]
    small = RigFilter(small_plant(), BELIEF, 9)
    small.reset(0.0, np.array([25.0, 25.0]), np.array([25.0]))
    assert small.u.tolist() == [0.0, 1.0]


@pytest.mark.parametrize(("spread", "unit"), [(1.0, 0.5), (1e-4, 0.1)])
def test_a_state_is_as_uncertain_as_the_fit_says_and_no_less_than_a_tenth(spread: float, unit: float) -> None:
    known = plant()
    model = replace(known.model, C=np.eye(2), spread=np.diag([4.0, spread]))
    made = RigFilter(replace(known, model=model), BELIEF, 9)
    made.reset(0.0, 25.0 + OFFSET, np.array([25.0]))
    want = [0.5**2 + 0.3**2 + 0.2**2, (0.5 * unit) ** 2 + 0.1**2]
    np.testing.assert_allclose(made.spread() ** 2, want)
    np.testing.assert_allclose(made._q, [0.03**2, (0.03 * unit) ** 2, 0.01**2, 0.02**2])


@pytest.mark.parametrize(("jump_k", "jump_floor_K"), [(3.0, 0.1), (3.0, 5.0)])
def test_a_jump_is_beyond_its_deviations_and_the_floor(jump_k: float, jump_floor_K: float) -> None:
    found = at_rest(jump_k=jump_k, jump_floor_K=jump_floor_K)
    limit = max(jump_k * found.spread()[0], jump_floor_K)
    for off in (limit, -limit):
        assert found.is_jump(0, float(found.expected[0]) + 1.01 * off)
        assert not found.is_jump(0, float(found.expected[0]) + 0.99 * off)


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
        found.correct(2.0 * k, y)
        assert abs(found.w[0]) <= 0.5
    assert found.w[0] == 0.5


# ---- inputs between readings ----


NOTHING = np.zeros(0)


def heater(keep: int = 10) -> RigFilter:
    """A filter that keeps so many steps of 1 s, at rest at 25 degC."""
    made = RigFilter(make_heater(), ModelSettings(), keep)
    made.reset(0.0, np.array([25.0]), NOTHING)
    return made


@pytest.mark.parametrize(
    ("unit", "valid", "half"),
    [("W", None, 1.0), ("W", (2.0, 8.0), 3.0), ("percent", (2.0, 8.0), 50.0), ("0_255", None, 127.5),
     (None, (-0.2, 0.8), 1.0), (None, (0.0, 100.0), 50.0)],
)  # fmt: skip
def test_a_bias_is_a_share_of_half_the_range_of_the_unit_else_of_the_logs(
    unit: str | None, valid: tuple[float, float] | None, half: float
) -> None:
    units, spans = {} if unit is None else {"q": unit}, {} if valid is None else {"q": valid}
    made = RigFilter(replace(make_heater(), units=units, valid=spans), ModelSettings(), 10)
    biased = made.driven(np.array([[2.0], [3.0]]), np.array([0.1]))
    assert biased.tolist() == [[2.0 + 0.1 * half], [3.0 + 0.1 * half]]


def test_a_window_begins_at_the_newest_estimate_that_is_so_old_and_whose_inputs_are_kept() -> None:
    found = heater(keep=3)
    for k in range(1, 6):
        found.predict(float(k), np.array([0.1 * k]), NOTHING)
        found.correct(float(k), np.array([25.0]))
    assert [one.time for one in found.estimates] == [2.0, 3.0, 4.0, 5.0]
    for seconds, step in ((3.0, 2), (2.0 + 5e-7, 3), (1.9, 3), (0.0, 5)):
        assert found.begin(seconds).step == step
    assert found.begin(3.1) is None
    for step, inputs in ((2, [0.3, 0.4, 0.5]), (4, [0.5]), (5, [])):
        assert found.applied_since(step)[0].ravel().tolist() == pytest.approx(inputs)
    found.predict(6.5, np.array([1.0]), NOTHING)
    assert found.begin(3.0) is None  # what was applied in its first step is forgotten


@pytest.mark.parametrize("silence", [5, 15, 40])
def test_a_long_silence_counts_as_many_short_waits(silence: int) -> None:
    once, often = heater(), heater()
    for made in (once, often):
        made.predict(1.0, np.array([0.2]), NOTHING)
    once.predict(1.0 + silence, np.array([0.8]), NOTHING)
    for k in range(silence):
        often.predict(2.0 + k, np.array([0.8]), NOTHING)
    np.testing.assert_allclose(once.expected, often.expected, rtol=1e-12)


def test_inputs_are_averaged_over_each_native_step() -> None:
    found = heater(keep=5)
    for time, u in ((0.5, 1.0), (1.25, 0.0), (3.0 - 5e-10, 4.0)):  # until the third step, but for rounding
        found.predict(time, np.array([u]), NOTHING)
    assert found.applied_since(0)[0].ravel().tolist() == pytest.approx([0.5, 3.0, 4.0])
    for time, u in ((3.25, 2.0), (4.0, 6.0)):
        found.predict(time, np.array([u]), NOTHING)
    assert found.applied_since(3)[0].ravel().tolist() == pytest.approx([5.0])
