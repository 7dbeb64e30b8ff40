"""The controller's filter is the Kalman filter of plant and disturbances, and settles where Riccati says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.mpc.makers import make_tank, network_plant
from thermogrip.datasets.errors import UserError
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.estimator.observer import (
    DisturbanceModel,
    Observer,
    ObserverNoise,
    choose_disturbances,
    detectability_margin,
    resting_state,
)
from thermogrip.mpc.plant.prediction import PredictionModel
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.plant.plant_data import InnovationNoise, PlantScores

A = np.array([[0.95, 0.02], [0.06, 0.9]])
B, E = np.array([0.4, -0.1]), np.array([0.03, 0.05])
C = np.array([[1.0, 0.0], [0.5, 0.5]])
LEVEL, OFFSET, SPAN = np.array([25.0, 24.0]), np.array([0.3, -0.2]), 100.0
SPREAD = np.array([2.0, 0.5])
NOISE = ObserverNoise(state=0.03, drive={"q": 0.01}, output=0.02)
DT = 2.0


def model(
    gain: float = 1.0, noise: tuple[tuple[str, float], ...] = (("a", 0.2), ("b", 0.02))
) -> PredictionModel:
    """Two outputs behind a drive in percent, in a room that is measured."""
    plant = StateSpaceModel(
        ("q",), ("t_room",), ("a", "b"), A=A, B=gain * B[:, None] / SPAN, E=E[:, None], C=C, dt=DT, y0=LEVEL,
        spread=np.diag(SPREAD**2),
    )  # fmt: skip
    units = {"q": "percent", "t_room": "degC", "a": "degC", "b": "degC"}
    offsets = dict(zip("ab", OFFSET.tolist()))
    valid = {"q": (0.0, 80.0)}
    made = Plant(plant, {}, dt=DT, units=units, offsets=offsets, noise=dict(noise), valid=valid)
    return PredictionModel(made, dt=DT)


MODEL = model()
CHOSEN = choose_disturbances(MODEL, ("b",))


UNIT = SPREAD / np.sqrt(C**2 @ SPREAD**2).max()  # a state's own swing, as outputs see it


def start(y: np.ndarray, room: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weighted least squares for a plant at rest: state, past drive, the drive's bias, and both offsets."""
    seen = np.isfinite(y)
    level = np.mean((y - OFFSET)[seen]) if seen.any() else room
    own = MODEL.rest(np.full(2, level), np.array([room]))
    none = np.zeros((2, 3))
    rows = np.vstack([
        np.hstack([np.eye(2) - A, -B[:, None], np.zeros((2, 3))]) / (0.2 * UNIT[:, None]),
        np.hstack([np.eye(2), none, np.zeros((2, 1))]) / (10 * UNIT[:, None]),
        np.hstack([np.zeros((4, 2)), np.diag([1.0, 1 / 0.03, 1 / 0.3, 1 / 0.3])]),
        (np.hstack([C, np.zeros((2, 2)), [[0.0, 1.0], [1.0, 0.0]]]) / [[0.2], [0.02]])[seen],
    ])  # fmt: skip
    right = np.concatenate([E * room / (0.2 * UNIT), own / (10 * UNIT), np.zeros(4)])
    z = np.linalg.lstsq(rows, [*right, *((y - LEVEL - OFFSET) / [0.2, 0.02])[seen]])[0]
    P = np.linalg.inv(rows.T @ rows)
    kept = [0, 1, 3, 4]
    levels = LEVEL + OFFSET
    if seen[0]:
        levels = levels + [y[0] - levels[0] - C[0] @ z[:2], 0.0]  # a has no offset in the filter: it stays
    return z[kept], P[np.ix_(kept, kept)], levels


class Textbook:
    """z = (x, drive's bias, b's bias): x+ = A x + B (u + w) + E d, y = C x + b + levels, written down."""

    def __init__(self, y: np.ndarray, room: float) -> None:
        self.F = np.eye(4)
        self.F[:2, :2], self.F[:2, 2] = A, B
        self.H = np.hstack([C, np.zeros((2, 1)), [[0.0], [1.0]]])
        unit = UNIT
        self.Q = np.diag([*(0.03 * unit) ** 2, 0.01**2, 0.02**2]) * DT
        self.R = np.diag([0.2**2, 0.02**2])  # no sensor is trusted to better than 0.02 degC
        self.z, self.P, self.levels = start(y, room)

    def predict(self, q: float, room: float, held: bool = False) -> None:
        self.z = self.F @ self.z + np.array([*(B * q / SPAN + E * room), 0.0, 0.0])
        self.P = self.F @ self.P @ self.F.T + self.Q * np.diag([1.0, 1.0, 0.0 if held else 1.0, 1.0])

    def correct(self, y: np.ndarray, held: bool = False) -> None:
        seen = np.isfinite(y)
        H, R = self.H[seen], self.R[np.ix_(seen, seen)]
        K = self.P @ H.T @ np.linalg.inv(H @ self.P @ H.T + R)
        if held:
            K[2] = 0.0
        self.z = self.z + K @ (y - self.H @ self.z - self.levels)[seen]
        self.z[2] = np.clip(self.z[2], -1.0, 1.0)
        left = np.eye(4) - K @ H
        self.P = left @ self.P @ left.T + K @ R @ K.T


# A per cent of q moves a by 0.1 and b by 0.075 degC, a degree of the room by 1.0526 and 1.0921
MARGINS = {"q": 0.125, "q, b": 0.0997171, "q, a": 0.0746257, "a or b": 1.0, "room": 1.5168148}


@pytest.mark.parametrize(
    ("controlled", "more", "names", "margin"),
    [
        (("b",), {}, ("input q", "output b"), "q, b"),
        (("a",), {}, ("input q", "output a"), "q, a"),
        (("b",), {"least": 0.12}, ("input q",), "q"),
        (("a",), {"least": 0.09}, ("input q", "output b"), "q, b"),
        (("b",), {"least": 0.13}, ("output b", "output a"), "a or b"),
        (("b",), {"least": 1.2}, ("disturbance t_room",), "room"),
    ],
)
def test_a_drive_and_the_controlled_output_are_what_may_be_off(controlled, more, names, margin) -> None:
    found = choose_disturbances(MODEL, controlled, **more)
    assert (found.names, found.n_w) == (names, len(names))
    assert found.margin == pytest.approx(MARGINS[margin], rel=1e-6)
    for kind, rows, of in zip(
        ("input", "disturbance", "output"), (("q",), ("t_room",), ("a", "b")),
        (found.on_drive, found.on_disturbance, found.on_output), strict=True
    ):  # fmt: skip
        np.testing.assert_array_equal(of, [[name == f"{kind} {row}" for name in names] for row in rows])


def test_what_no_set_of_disturbances_explains_is_refused() -> None:
    for least in (0.12, 1e9):
        with pytest.raises(UserError, match="no disturbance model of 2 states is detectable from a, b"):
            choose_disturbances(MODEL, ("a", "b"), least=least)
    weak = choose_disturbances(model(gain=1 / 80), ("b",))  # a per cent of q moves the outputs by 1.5 mK
    assert weak.names == ("input q", "output b")
    unseen = np.zeros((2, 1))
    assert detectability_margin(A, C, unseen, unseen) == 0.0


def test_states_wander_as_in_the_logs_whatever_their_coordinates() -> None:
    T, plant = np.array([[1.0, 0.5], [3.0, -2.0]]), MODEL.plant
    linear, back = plant.model, np.linalg.inv(T)
    spread = np.array([[4.0, 0.8], [0.8, 0.25]])
    moved = replace(
        linear, A=T @ A @ back, B=T @ linear.B, E=T @ linear.E, C=C @ back, spread=T @ spread @ T.T
    )
    one, other = (
        Observer(PredictionModel(replace(plant, model=states), dt=DT), CHOSEN, NOISE)
        for states in (replace(linear, spread=spread), moved)
    )
    np.testing.assert_allclose(other.Q[:2, :2], T @ one.Q[:2, :2] @ T.T, rtol=1e-9)
    np.testing.assert_allclose(one.Q[:2, :2], 0.03**2 * DT * spread / (C @ spread @ C.T).max())


def test_what_nobody_says_of_noise_is_assumed() -> None:
    found = Observer(model(noise=(("a", 0.2),)), CHOSEN)
    np.testing.assert_allclose(found.R, [0.2**2, 0.05**2])
    np.testing.assert_allclose(np.sqrt(np.diag(found.Q) / DT)[2:], [0.002, 0.03])
    said = Observer(MODEL, CHOSEN, replace(NOISE, reading={"b": 0.1}))
    np.testing.assert_allclose(said.R, [0.2**2, 0.1**2])


def test_the_margin_is_the_steady_change_of_the_worst_combination_in_its_own_size() -> None:
    into_x, into_y, scale = (
        np.array([[0.1, 0.0], [0.02, 0.03]]),
        np.array([[0.0, 0.5], [0.3, 0.0]]),
        [2.0, 0.1],
    )
    steady = into_y + C @ np.linalg.inv(np.eye(2) - A) @ into_x
    want = np.linalg.svd(steady * scale)[1][-1]
    assert detectability_margin(A, C, into_x, into_y, scale=np.array(scale)) == pytest.approx(want)
    beyond = np.array([[1.005, 0.0], [0.0, 0.3]])  # of a pole that grows slowly, whose states are large
    steady = C @ np.linalg.inv(np.eye(2) - beyond) @ into_x
    found = detectability_margin(beyond, C, into_x, 0 * into_y, scale=np.array(scale))
    assert found == pytest.approx(np.linalg.svd(steady * scale)[1][-1])
    integrator = np.diag([1.0, 0.8])
    for size in (1.0, 10.0):  # there the rank test decides, of the disturbances in their sizes
        whole = np.block([[integrator - np.eye(2), into_x * size], [C, into_y * size]])
        values = np.linalg.svd(whole)[1]
        found = detectability_margin(integrator, C, into_x, into_y, scale=np.full(2, size))
        assert found == pytest.approx(values[-1] / values[0])


@settings(max_examples=15, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.floats(0.0, 100.0),
            st.lists(st.one_of(st.floats(-1.0, 1.0), st.just(np.nan)), min_size=2, max_size=2),
            st.booleans(),
        ),
        min_size=1,
        max_size=12,
    )
)
def test_the_estimate_is_that_of_the_textbook(rows: list[tuple[float, list[float], bool]]) -> None:
    observer, room = Observer(MODEL, CHOSEN, NOISE), 22.0
    observer.reset(LEVEL + OFFSET + [0.5, -0.7], np.array([room]))
    want = Textbook(LEVEL + OFFSET + [0.5, -0.7], room)
    np.testing.assert_allclose([*observer.x, *observer.w], want.z, atol=1e-6)
    np.testing.assert_allclose(observer._P, want.P, atol=1e-7)
    for q, noise, held in rows:
        observer.hold_drives(np.array([held]))
        y = LEVEL + OFFSET + np.array(noise)
        miss = observer.update(y)
        np.testing.assert_allclose(miss, y - (want.H @ want.z + want.levels), atol=1e-6)
        want.correct(y, held)
        np.testing.assert_allclose([*observer.x, *observer.w], want.z, atol=1e-6)
        np.testing.assert_allclose(observer.drive_bias, [want.z[2] * SPAN], atol=1e-4)
        np.testing.assert_allclose(observer.output_bias, want.levels - LEVEL + [0.0, want.z[3]], atol=1e-6)
        observer.predict(np.array([q]), np.array([room]))
        want.predict(q, room, held)
        np.testing.assert_allclose(observer._P, want.P, atol=1e-7)
    np.testing.assert_allclose(observer.reading(), want.H @ want.z + want.levels, atol=1e-6)


def test_the_settled_gain_is_where_the_filter_goes() -> None:
    observer = Observer(MODEL, CHOSEN, NOISE)
    want = Textbook(LEVEL + OFFSET, 25.0)
    for _ in range(3000):
        K = want.P @ want.H.T @ np.linalg.inv(want.H @ want.P @ want.H.T + want.R)
        want.correct(LEVEL + OFFSET)
        want.predict(0.0, 0.0)
    np.testing.assert_allclose(observer.settled_gain(want.F), K, rtol=1e-6, atol=1e-9)


def test_a_bias_of_a_drive_ends_at_its_range_and_an_outputs_goes_on() -> None:
    observer = Observer(MODEL, CHOSEN, NOISE)
    observer.reset(LEVEL + OFFSET, np.array([25.0]))
    for k in range(300):
        observer.update(LEVEL + OFFSET + [0.2 * k, -0.2 * k])
        assert abs(observer.w[0]) <= 1.0
        observer.predict(np.array([10.0]), np.array([25.0]))
    assert observer.w[0] == pytest.approx(1.0)
    assert observer.w[1] < -1.0


def test_where_a_sensor_is_lost_at_the_start_the_others_say_how_warm_it_is() -> None:
    observer = Observer(MODEL, CHOSEN, NOISE)
    for y in (np.array([30.0, np.nan]), np.array([np.nan, 31.0]), np.full(2, np.nan)):
        observer.reset(y, np.array([21.0]))
        z, P, levels = start(y, 21.0)
        np.testing.assert_allclose([*observer.x, *observer.w], z, atol=1e-6)
        np.testing.assert_allclose(observer.output_bias, levels - LEVEL + [0.0, z[3]], atol=1e-6)
        np.testing.assert_allclose(observer._P, P, atol=1e-7)


@pytest.mark.parametrize(("y", "room"), [([30.0, 27.0], 19.0), ([np.nan, 31.0], 24.0)])
def test_the_start_of_a_linear_plant_is_that_linearised_in_the_room(y: list[float], room: float) -> None:
    own, mapped = (Observer(MODEL, CHOSEN, NOISE, ambient=21.0) for _ in range(2))
    own.reset(np.array(y), np.array([room]))
    mapped.reset_in_room(np.array(y), np.array([room]))
    for name, value in own.estimate().items():
        np.testing.assert_allclose(mapped.estimate()[name], value, atol=1e-9)


def test_how_the_rest_of_a_peltier_plant_answers_to_level_and_room() -> None:
    plant = PredictionModel(network_plant("gripper"), dt=2.0)
    x, v, room = plant.at_rest(22.0)
    unit = np.linspace(0.5, 1.5, plant.n_x)
    rest, steps = resting_state(plant, x, v, np.full(plant.n_y, 25.0), room, unit=unit), np.eye(plant.n_d)
    np.testing.assert_allclose(rest.P, rest.P.T, rtol=1e-12)

    def mean(level: float, step: np.ndarray) -> np.ndarray:
        return resting_state(plant, x, v, np.full(plant.n_y, level), room + step, unit=unit).x

    none = np.zeros(plant.n_d)
    np.testing.assert_allclose(rest.by_level, (mean(26.0, none) - mean(24.0, none)) / 2, atol=1e-7)
    by_d = [(mean(25.0, step) - mean(25.0, -step)) / 2 for step in steps]
    np.testing.assert_allclose(rest.by_d.T, by_d, atol=1e-4)


def test_the_past_drive_of_a_state_is_the_likeliest_that_held_it() -> None:
    rest = resting_state(
        MODEL, np.array([1.0, 2.0]), np.array([40.0]), np.full(2, 26.0), np.array([22.0]), unit=UNIT
    )
    x, W = np.array([3.0, -1.0]), 1 / (0.2 * UNIT) ** 2
    left = x - A @ x - E * 22.0  # what the drive has to make up for, but for 0.2 degC a sample
    assert rest.past_drive(x) == pytest.approx(SPAN * (B * W @ left) / (B * W @ B + 1))


@pytest.mark.parametrize("held", [False, True])
def test_between_samples_the_filter_is_that_of_the_state_there(held: bool) -> None:
    """0.6 of a sample at 30 %, a reading, 0.8 of one at 50 %; the drive and the room may be off."""
    entries = np.array([[1.0, 0.0]]), np.array([[0.0, 1.0]]), np.zeros((2, 2))
    observer, room = Observer(MODEL, DisturbanceModel(("q", "room"), *entries, 1.0), NOISE), np.array([22.0])
    observer.reset(LEVEL + OFFSET + [0.5, -0.7], room)
    observer.hold_drives(np.array([held]))
    F, H = np.eye(4), np.hstack([C, np.zeros((2, 2))])
    F[:2] = np.hstack([A, B[:, None], E[:, None]])
    Q = DT * np.diag([*(0.03 * UNIT) ** 2, 0.0 if held else 0.01**2, 0.02**2])
    z, P, levels = np.array([*observer.x, *observer.w]), observer._P.copy(), observer.output_bias + LEVEL

    def after(z: np.ndarray, percent: float) -> np.ndarray:
        return F @ z + np.array([*(B * percent / SPAN + E * 22.0), 0.0, 0.0])

    observer.advance(0.6 * DT, np.array([30.0]), room)
    observer.look(room)
    P, between = P + 0.6 * Q, 0.4 * np.eye(4) + 0.6 * F
    np.testing.assert_allclose(observer.now, (0.4 * z + 0.6 * after(z, 30.0))[:2], atol=1e-9)
    y = np.array([26.0, 25.5])
    bent = 4 * 0.6 * 0.4 * C @ (after(z, 30.0) - z)[:2]  # between samples an output is not on a straight line
    Hs, R = H @ between, np.diag(np.array([0.2, 0.02]) ** 2 + bent**2)
    K = P @ Hs.T @ np.linalg.inv(Hs @ P @ Hs.T + R)
    K[2] = 0.0 if held else K[2]
    miss = y - levels - H @ (0.4 * z + 0.6 * after(z, 30.0))
    np.testing.assert_allclose(observer.update(y), miss, atol=1e-9)
    z = z + K @ miss
    left = np.eye(4) - K @ Hs
    P = left @ P @ left.T + K @ R @ K.T
    for _ in range(2):  # looking twice is looking once
        np.testing.assert_allclose([*observer.x, *observer.w], z, atol=1e-9)
        np.testing.assert_allclose(observer.now, (0.4 * z + 0.6 * after(z, 30.0))[:2], atol=1e-9)
        np.testing.assert_allclose(observer._P, P, atol=1e-12)
        observer.look(room)
    np.testing.assert_allclose(observer.disturbance_bias, [z[3]])
    observer.advance(0.8 * DT, np.array([50.0]), room)
    z, P = after(z, 0.6 * 30.0 + 0.4 * 50.0), F @ P @ F.T + 0.4 * Q
    np.testing.assert_allclose([*observer.x, *observer.w], z, atol=1e-9)
    np.testing.assert_allclose(observer.now, z[:2], atol=1e-9)
    observer.look(room)
    np.testing.assert_allclose(observer._P, P + 0.4 * Q, atol=1e-12)
    np.testing.assert_allclose(observer.now, (0.6 * z + 0.4 * after(z, 50.0))[:2], atol=1e-9)
    observer.advance(0.6 * DT, np.array([50.0]), room)
    np.testing.assert_allclose(observer._P, F @ (P + 0.4 * Q) @ F.T + 0.6 * Q, atol=1e-12)


def test_of_two_drives_the_weak_one_is_held_alone() -> None:
    plant = PredictionModel(network_plant("tclab"), dt=10.0)
    observer = Observer(plant, choose_disturbances(plant, ("t1", "t2")))
    assert observer.disturbance.names == ("input q1", "input q2")
    observer.reset(np.array([30.0, 28.0]), np.zeros(plant.n_d))
    observer.predict(np.array([20.0, 10.0]), np.zeros(plant.n_d))
    for weak in ([True, False], [False, True]):
        observer.hold_drives(np.array(weak))
        before = observer.w
        observer.update(observer.reading() + [0.3, 0.2])
        assert (observer.w == before).tolist() == weak
    before = observer.reading()
    observer.set_offsets(np.array([40.0, np.nan]), np.array([True, True]))
    assert observer.reading() == pytest.approx([40.0, before[1]])


@pytest.mark.parametrize("drive", [0.3, 0.5])
def test_the_start_finds_the_heatsink_of_a_peltier_plant_that_rested_under_a_drive(drive: float) -> None:
    """Joule heat grows with the square of the drive: linearised once, about no drive, 0.5 is off by 1.2 K."""
    model = PredictionModel(network_plant("gripper"), dt=2.0)
    room = np.array([22.0])
    cold = model.rest(np.full(2, 22.0), room)[None]
    y, x = model.run(cold, np.full((1, 4000, 1), drive), room)
    observer = Observer(model, choose_disturbances(model, ("t_surface",)))
    observer.reset(y[0, -1], room)
    assert model.model.states[0] == "heatsink"
    assert observer.x[0] == pytest.approx(x[0, 0], abs=0.2)


def test_more_disturbances_than_outputs_cannot_be_distinguished():
    A, C = np.diag([0.9, 0.8]), np.eye(2)
    assert detectability_margin(A, C, np.eye(2), np.zeros((2, 2))) > 1
    assert detectability_margin(A, C, np.eye(2, 3), np.eye(2, 3)) == 0
    same = np.array([[0.1, 0.2], [0.0, 0.0]])  # two heat flows into one state
    for poles in (A, np.diag([1.0, 0.8])):
        assert detectability_margin(poles, C, same, np.zeros((2, 2))) == 0


def test_an_unseen_mode_that_does_not_decay_is_not_detectable():
    A, C = np.diag([0.9, 1.0]), np.array([[1.0, 0.0]])
    assert detectability_margin(A, C, np.array([[0.1], [0.0]]), np.zeros((1, 1))) == 0


def test_a_reading_is_as_noisy_as_the_innovations_of_the_fit_say_else_as_its_sensor_or_the_fit():
    tank = replace(make_tank(), noise={"t_tank": 9.0, "t_surface": 0.1})
    sensors = PlantScores(reading_sd={"t_tank": 0.3, "t_surface": 0.02})
    record = InnovationNoise(0.01, {"t_tank": 0.4, "t_surface": 0.03}, {"drive": 0.002}, {"drive": 0.4})
    for scores, want in (
        (PlantScores(), [9.0, 0.1]),
        (sensors, [0.3, 0.02]),
        (replace(sensors, innovations=record), [0.4, 0.03]),
    ):
        plant = replace(tank, scores=scores)
        R = default_design(plant).observer(PredictionModel(plant, dt=2.0)).R
        assert np.sqrt(R) == pytest.approx(want)
