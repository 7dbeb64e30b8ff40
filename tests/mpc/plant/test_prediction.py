"""Prediction: derivatives that CasADi finds too, delay, steady states, step responses, several drives."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from tests.mpc.design.test_design import block
from tests.mpc.makers import kit, network_plant
from thermogrip.mpc.design.design import make_blocks
from thermogrip.mpc.plant.prediction import (
    PredictionModel,
    held_start,
    holding_drive,
    sample_time,
    step_response,
)
from thermogrip.sysid.models.neural import NeuralModel
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

ROOM = np.array([25.0])


@pytest.fixture(scope="module")
def gripper() -> Plant:
    return network_plant("gripper")


def derived(model: PredictionModel, x, u, d) -> list[np.ndarray]:
    """Return what CasADi makes of a sample: the next state, and its derivatives by x, u, d."""
    symbols = [ca.SX.sym("s", len(values)) for values in (x, u, d)]
    full = [ca.SX(1.0)] * len(model.model.inputs)
    for at, value in zip(model.drive_index, ca.vertsplit(symbols[1]), strict=True):
        full[at] = value
    state, room = (ca.vertsplit(item) if item.numel() else [] for item in (symbols[0], symbols[2]))
    for _ in range(model.sub):
        state = model.model.step(state, full, room, model.p.tolist(), model.dt / model.sub)
    after = ca.vertcat(*state)
    parts = [after, *(ca.densify(ca.jacobian(after, item)) for item in symbols)]
    return [np.asarray(part.full()) for part in ca.Function("sample", symbols, parts)(x, u, d)]


def along(model: PredictionModel, x, plan, d, blocks) -> tuple[np.ndarray, np.ndarray]:
    """Return outputs and their derivatives along a plan, by forward sensitivities of CasADi's samples."""
    S, outputs, gains = np.zeros((model.n_x, *plan.shape)), [], []
    for b, length in enumerate(blocks):
        for _ in range(length):
            after, A, B, _ = derived(model, x, plan[b], d)
            S = np.tensordot(A, S, axes=1)
            S[:, b] += B
            x = after.ravel()
            outputs.append(model.output(x))
            gains.append(np.tensordot(model.C, S, axes=1))
    return np.stack(outputs), np.stack(gains)


@pytest.mark.parametrize("level", [-0.7, 0.4])
@pytest.mark.parametrize("name", ["tank", "gripper", "kit"])
def test_derivatives_along_a_plan_are_those_that_casadi_finds(tank, gripper, name, level):
    plant = {"tank": tank, "gripper": gripper, "kit": kit().plant}[name]
    model = PredictionModel(plant, dt=10.0 if name == "kit" else 2.0)
    assert model.sub == (2 if name == "kit" else 1)
    d = ROOM[: model.n_d]
    x, blocks = model.rest(np.array([30.0, 29.0]), d), make_blocks(20, 5)
    plan = model.lowest + model.span * np.clip(0.5 + 0.5 * level + 0.02 * np.arange(5)[:, None], 0, 1)
    y, G = model.trajectory(x, plan, d, blocks)
    y_exact, G_exact = along(model, x, plan, d, blocks)
    np.testing.assert_allclose(y, y_exact, atol=1e-9)
    np.testing.assert_allclose(G, G_exact, atol=1e-12 * np.abs(G_exact).max())
    assert (G[0, :, 1:] == 0).all()  # nothing answers to what is still to come
    found = model.linearise(x, plan[0], d)
    for own, exact in zip(found, derived(model, x, plan[0], d), strict=True):
        np.testing.assert_allclose(
            own, exact.reshape(own.shape), atol=1e-12 * np.max(np.abs(exact), initial=1.0)
        )


def test_a_coarser_step_is_taken_only_where_it_predicts_the_same(gripper):
    coarse, fine = PredictionModel(gripper, dt=2.0), PredictionModel(gripper, dt=0.5)
    assert coarse.sub < 4
    x = fine.rest(np.array([25.0, 25.0]), ROOM)
    plan = np.where(np.arange(60) < 30, 1.0, -1.0)[None, :, None]
    y, _ = coarse.run(x[None], plan, ROOM)
    y_fine, _ = fine.run(x[None], np.repeat(plan, 4, axis=1), ROOM)
    assert np.max(np.abs(y - y_fine[:, ::4])) < 0.02


def test_nothing_moves_before_the_delay_is_over(tank):
    model = PredictionModel(tank, dt=1.0)
    x = model.rest(np.array([25.0, 25.0]), ROOM)
    _, G = model.trajectory(x, np.zeros((1, 1)), ROOM, (30,))
    skin = np.abs(G[:, 1, 0, 0])
    assert np.all(skin[:8] < 1e-12)
    assert skin[12] > 1e-4


def test_at_steady_state_the_prediction_stays(tank):
    model = PredictionModel(tank, dt=2.0)
    u = np.array([0.2])
    x = model.steady_state(u, ROOM)
    np.testing.assert_allclose(model.next_state(x, u, ROOM), x, atol=1e-6)


def test_delay_and_lag_are_read_off_the_step_response(tank):
    answer = step_response(tank, "drive", "t_surface")
    steady = [PredictionModel(tank, dt=1.0).steady_output([level], ROOM)[1] for level in (0.0, 0.1)]
    assert answer.gain == pytest.approx(20 * (steady[1] - steady[0]), rel=2e-2)
    assert 9 <= answer.delay <= 25  # 9 s of tube, and most of the 12 s lag of the skin
    assert answer.lag == pytest.approx(700, rel=0.1)


@pytest.mark.parametrize(
    ("dt", "time_constant", "longest", "end"),
    [
        (1.0, 50.0, 14400.0, 400.0),  # of the slope a 2400th is left; at 200 s it were a 45th
        (1.0, 50.0, 100.0, 100.0),
        (1.0, 50.0, 101.0, 200.0),
        (0.5, 1.0, 14400.0, 60.0),  # a minute at least,
        (2.0, 1.0, 14400.0, 200.0),  # and a hundred steps
    ],
)
def test_a_step_is_watched_until_it_is_over(dt, time_constant, longest, end):
    answer = step_response(block(10, time_constant, dt=dt), "q", "t", longest=longest)
    late = np.maximum(answer.time - 10 * dt, 0.0)
    np.testing.assert_allclose(answer.y, 50 * (1 - np.exp(-late / time_constant)), atol=1e-9)
    assert (answer.time[0], answer.time[-1], answer.gain) == (0.0, end, answer.y[-1])
    # the slope is a difference over two steps, largest one step behind the delay
    slope = 50 * (1 - np.exp(-2 * dt / time_constant)) / (2 * dt)
    assert answer.lag == pytest.approx(answer.gain / slope)
    assert answer.delay == pytest.approx(11 * dt - 50 * (1 - np.exp(-dt / time_constant)) / slope)


def test_what_first_goes_the_other_way_is_delay():
    """y = K (1 - exp(-t/T)) - k (1 - exp(-t/tau)), which falls faster at first than it ever rises, comes back
    to where it began after about k T/K."""
    K, T, k, tau, dt = 10.0, 150.0, 0.1, 0.3, 0.1
    decay = np.exp(-dt / np.array([T, tau]))
    gains = (1 - decay) * [K, k]
    model = StateSpaceModel(
        ("q",), (), ("t",), A=np.diag(decay), B=gains[:, None], C=[[1.0, -1.0]], c=25.0 * (1 - decay), dt=dt
    )
    plant = Plant(model, {}, dt=dt, units={"q": "1"}, valid={"q": (0.0, 1.0), "t": (0.0, 60.0)})
    answer = step_response(plant, "q", "t")
    assert answer.y.min() < -0.04
    assert answer.delay == pytest.approx(k * T / K, rel=0.1)
    assert answer.lag == pytest.approx(T, rel=0.02)


def test_a_drive_that_moves_nothing_has_no_delay_and_no_lag():
    answer = step_response(block(10, 50.0, gain=0.0), "q", "t")
    assert (answer.gain, answer.delay, answer.lag) == (0.0, np.inf, np.inf)


def test_the_sample_time_is_a_round_part_of_the_delay_or_of_the_lag(tank, gripper):
    assert [sample_time(plant) for plant in (gripper, tank)] == [2.0, 5.0]
    # a quarter of 10 s and of 20 s; without a delay a 400th of 4000 s, and no more; the plant's own step
    plants = [
        block(10, 50.0),
        block(20, 200.0),
        lag((0.0, 4.0), 4000.0),
        lag((0.0, 4.0), 9e4),
        lag((0.0, 4.0)),
    ]
    assert [sample_time(plant) for plant in plants] == [2.0, 5.0, 10.0, 10.0, 1.0]
    assert sample_time(block(3, 800.0, gain=0.0)) == 1.0
    # what adds up: half of the range leads through the 80 of the logs in 160 s, of which 4 are a 40th
    level = StateSpaceModel(("q",), (), ("t",), A=np.eye(1), B=np.full((1, 1), 0.01), C=np.eye(1), dt=1.0)
    seen = {"q": (0.0, 100.0), "t": (10.0, 90.0)}
    assert sample_time(Plant(level, {}, dt=1.0, units={"q": "percent"}, valid=seen)) == 2.0


def test_a_plant_whose_logs_were_never_in_the_room_rests_amid_them():
    plant = block(10, 50.0)
    warm = PredictionModel(replace(plant, valid={"q": (40.0, 60.0), "t": (30.1, 90.0)}))
    x, v, d = warm.at_rest(25.0)
    assert (warm.output(x), v.tolist(), d.tolist()) == (pytest.approx(60.05), [50.0], [25.0])
    near = PredictionModel(replace(plant, valid={"q": (40.0, 60.0), "t": (30.0, 90.0)}))
    x, v, d = near.at_rest(25.0)
    assert (near.output(x), v.tolist()) == (pytest.approx(25.0), [0.0])
    assert PredictionModel(replace(plant, valid={"t": (0.0, 19.9)})).usual(25.0) == pytest.approx(9.95)
    assert PredictionModel(replace(plant, valid={})).usual(25.0).tolist() == [25.0]


@pytest.mark.parametrize(
    ("valid", "ends", "spike"),
    [
        ({"t": (20.0, 45.0)}, (-60.0, 200.0), 6.0),
        ({}, (-60.0, 200.0), 6.0),
        ({"t": (25.0, 285.0)}, (-235.0, 545.0), 26.0),
    ],
)
def test_a_reading_may_be_as_far_from_the_logs_as_they_are_wide(valid, ends, spike):
    model = PredictionModel(replace(block(10, 50.0), valid={"q": (0.0, 100.0)} | valid))
    assert (model.coldest, model.hottest) == ends
    assert model.spike.tolist() == [spike]


def test_a_steady_state_is_one_that_stays_or_none(tank):
    model = PredictionModel(two_drives(), dt=0.3)
    x = model.steady_state([0.3, 0.8], [22.0])
    np.testing.assert_allclose(x, np.linalg.solve(np.eye(3) - A, B @ [0.3, 0.8] - 3.0 * E[:, 0]), atol=1e-9)
    assert model.steady_output([0.3, 0.8], [22.0]) == pytest.approx(25.0 + C @ x)
    model = PredictionModel(tank, dt=2.0)
    a = np.exp(-1 / 700)  # the tank gains 0.11 K a second and loses its share; the skin reads 2 % of the room
    warm = 21.0 + 0.3 * 0.11 / (1 - a)
    assert model.steady_output([0.3], [21.0]) == pytest.approx([warm, 0.98 * warm + 0.02 * 21.0])
    assert np.isnan(PredictionModel(lag((0.0, 4.0), np.inf), dt=1.0).steady_state([1.0], [])).all()


def test_a_plan_may_run_from_several_states_in_several_rooms():
    model = PredictionModel(two_drives(), dt=0.2)
    x, d = np.array([[1.0, 2.0, 3.0], [-1.0, 0.5, 0.0]]), np.array([[20.0], [30.0]])
    u = np.array([[[0.1, 0.9], [0.4, 0.2]], [[0.8, 0.3], [0.0, 1.0]]])
    y, end = model.run(x, u, d)
    for k in range(2):
        state, want = x[k], [25.0 + C @ x[k]]
        for step in (0, 0, 1, 1):
            state = A @ state + B @ u[k, step] + E[:, 0] * (d[k, 0] - 25.0)
            want.append(25.0 + C @ state)
        np.testing.assert_allclose(y[k], want[::2], atol=1e-12)
        np.testing.assert_allclose(end[k], state, atol=1e-12)
    np.testing.assert_allclose(model.run(x, u, d[0])[0][0], y[0], atol=1e-12)
    state, drives, room = model.at_rest(18.0)
    assert (model.output(state), drives.tolist(), room.tolist()) == (
        pytest.approx([18.0]),
        [0.0, 0.0],
        [18.0],
    )


A = np.array([[0.9, 0.05, 0.0], [0.0, 0.8, 0.1], [0.1, 0.0, 0.7]])
B, E = np.array([[0.4, 0.0], [0.1, 0.3], [0.0, 0.2]]), np.array([[0.05], [0.1], [0.2]])
C = np.array([[1.0, 0.0, 0.5]])


def two_drives() -> Plant:
    model = StateSpaceModel(
        ("q", "r"), ("room",), ("t",), A=A, B=B, C=C, E=E, c=-25.0 * E[:, 0], dt=0.1, y0=[25.0]
    )
    units = {"q": "1", "r": "1", "room": "degC", "t": "degC"}
    return Plant(model, {}, dt=0.1, units=units, valid={"q": (0.0, 1.0), "r": (0.0, 1.0)})


@pytest.mark.parametrize(("asked", "dt"), [(0.3, 0.3), (0.7, 0.7), (0.26, 0.3), (0.04, 0.1)])
def test_a_sample_is_the_nearest_number_of_whole_steps(asked: float, dt: float):
    assert PredictionModel(two_drives(), dt=asked).dt == pytest.approx(dt)


def test_slopes_of_a_sample_are_those_of_its_steps():
    model = PredictionModel(two_drives(), dt=0.3)
    x, u, d = np.array([1.0, -2.0, 3.0]), np.array([0.2, 0.7]), np.array([22.0])
    after, a, b, e = model.linearise(x, u, d)
    more = np.eye(3) + A + A @ A
    np.testing.assert_allclose(a, np.linalg.matrix_power(A, 3), atol=1e-9)
    np.testing.assert_allclose(b, more @ B, atol=1e-9)
    np.testing.assert_allclose(e, more @ E, atol=1e-9)
    np.testing.assert_allclose(after, a @ x + b @ u + e @ (d - 25.0), atol=1e-9)
    np.testing.assert_allclose(model.C, C, atol=1e-12)  # whatever is read at nought
    _, G = model.trajectory(x, np.array([u, [0.0, 1.0]]), d, [1, 2])
    np.testing.assert_allclose(G[2, 0], [(C @ a @ a @ b)[0], (C @ a @ b + C @ b)[0]], atol=1e-9)


def lag(
    valid: tuple[float, float], seconds: float = -1 / np.log(0.98), disturbances: tuple[str, ...] = ()
) -> Plant:
    model = StateSpaceModel(
        ("q",), disturbances, ("t",), A=[[np.exp(-1 / seconds)]], B=[[0.1]], C=[[1.0]],
        E=np.zeros((1, len(disturbances))), dt=1.0, y0=[25.0],
    )  # fmt: skip
    units = {"q": "W", "t": "degC"} | dict.fromkeys(disturbances, "degC")
    return Plant(model, {}, dt=1.0, units=units, valid={"q": valid})


@pytest.mark.parametrize(
    ("valid", "neutral", "step"),
    [((0.0, 4.0), 0.0, 0.2), ((1.0, 4.0), 1.0, 0.15), ((-4.0, 0.0), 0.0, -0.2), ((-4.0, -1.0), -1.0, -0.15),
     ((-3.9, 0.1), 0.0, -0.2)],
)  # fmt: skip
def test_no_drive_is_what_is_nearest_to_none_and_a_step_from_there_stays_in_range(
    valid: tuple[float, float], neutral: float, step: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant, driven, run = lag(valid), [], PredictionModel.run

    def kept(self: PredictionModel, x: np.ndarray, u: np.ndarray, d: np.ndarray) -> object:
        driven.append(u.reshape(2, -1))
        return run(self, x, u, d)

    model = PredictionModel(plant, dt=1.0)
    assert model.neutral.tolist() == [neutral]
    assert model.span.tolist() == [valid[1] - valid[0]]
    monkeypatch.setattr(PredictionModel, "run", kept)
    answer = step_response(plant, "q", "t")
    np.testing.assert_allclose(driven[-1].T - [neutral, neutral + step], 0.0, atol=1e-12)
    assert answer.gain == pytest.approx(5.0 * (valid[1] - valid[0]), rel=0.01)
    assert answer.lag == pytest.approx(-1 / np.log(0.98), rel=0.05)
    assert answer.delay < 1.0


def test_the_room_is_the_first_of_what_is_measured() -> None:
    model = PredictionModel(lag((0.0, 4.0), disturbances=("t_room", "t_water")), dt=1.0)
    assert [model.room(d) for d in ([21.0, 30.0], [np.nan, 30.0], [21.0, np.nan])] == [21.0, 25.0, 21.0]


def test_the_holding_drive_holds_and_says_what_it_misses(tank):
    model = PredictionModel(tank, dt=2.0)
    held = holding_drive(model, ("t_surface",), [38.0], ROOM)
    assert held.miss < 1e-6
    # the skin reads 0.98 of the tank, which a drive of 1 warms by 0.11 K a second
    assert held.u == pytest.approx([13.0 / 0.98 * (1 - np.exp(-1 / 700)) / 0.11])
    assert held.y == pytest.approx([25.0 + 13.0 / 0.98, 38.0])
    # a search that begins at a tenth of this range, -7e-18, must leave it
    within = np.array([-0.07]), np.array([0.63])
    assert holding_drive(model, ("t_surface",), [26.0], ROOM, within=within).miss < 1e-6
    for target, u in ((500.0, 1.0), (-300.0, -1.0)):
        beyond = holding_drive(model, ("t_surface",), [target], ROOM)
        assert beyond.u == pytest.approx([u])
        assert beyond.miss == pytest.approx(abs(target - 25.0 - 0.98 * u * 0.11 / (1 - np.exp(-1 / 700))))


def test_of_two_drives_that_hold_the_smaller_is_taken(reversing_tank):
    model = PredictionModel(reversing_tank, dt=2.0)
    held = holding_drive(model, ("t_surface",), [18.0], ROOM)
    assert held.miss < 1e-6
    assert held.u[0] > -0.55


def test_what_balances_an_integrator_may_lie_beyond_its_drive():
    model = StateSpaceModel(
        ("q",), ("leak",), ("t",), A=[[1.0]], B=[[0.5]], E=[[0.1]], C=[[1.0]], dt=1.0, y0=[25.0]
    )
    valid = {"q": (-1.0, 1.0), "t": (20.0, 60.0)}
    plant = Plant(model, {}, dt=1.0, units={"q": "1", "leak": "1"}, valid=valid)
    prediction = PredictionModel(plant, dt=1.0)
    for leak in (2.0, -8.0):
        held = holding_drive(prediction, ("t",), [40.0], [leak])
        assert held.u == pytest.approx([-0.2 * leak])
        assert held.y == pytest.approx([40.0])
        assert held.miss == pytest.approx(0.0, abs=1e-6)
        at_rest, _ = held_start(prediction, ("t",), 40.0, (leak,))  # -8 asks for more than the drive has
        assert prediction.output(at_rest) == pytest.approx([40.0])


@pytest.mark.parametrize("target", [54.0, 60.0, 63.0])
def test_a_target_where_the_plant_runs_away_by_itself_can_be_held(target: float):
    """Near 60 degC a sample of this network leads away: x+ - x = 0.1 (tanh 2x - x) + w / 5."""
    one = {"A": [[[0.9]]], "B": [[[0.2]]], "V": [[[0.1]]], "W": [[[2.0]]]}
    none = {"c": [[0.0]], "U": [[[0.0]]], "b": [[0.0]]}
    scales = {"y_middle": [60.0], "y_size": [20.0], "w_middle": [0.3], "w_size": [0.2], "reach": [10.0]}
    rails = {"low": [-np.inf], "high": [np.inf]}
    model = NeuralModel(("q",), (), ("t",), switches=(), dt=1.0, **one, **none, **scales, **rails)
    plant = Plant(model, {}, dt=1.0, units={"q": "1"}, valid={"q": (-0.3, 0.6), "t": (5.0, 80.0)})
    held = holding_drive(PredictionModel(plant, dt=1.0), ("t",), [target], [])
    x = (target - 60.0) / 20.0
    assert held.miss < 1e-5
    assert held.u == pytest.approx([0.3 - 0.1 * (np.tanh(2 * x) - x)], abs=1e-6)


def test_a_plant_that_was_held_stays_and_one_that_cannot_be_is_as_warm_all_over(tank):
    model = PredictionModel(tank, dt=2.0)
    held, _ = held_start(model, ("t_surface",), 38.0, (25.0,))
    drive = holding_drive(model, ("t_surface",), [38.0], ROOM).u
    assert model.run(held[None], drive[None, None], np.array(ROOM))[1][0] == pytest.approx(held)
    assert model.output(held) == pytest.approx([25.0 + 13.0 / 0.98, 38.0])
    assert model.output(held_start(model, ("t_surface",), 500.0, (25.0,))[0]) == pytest.approx([500.0, 500.0])
