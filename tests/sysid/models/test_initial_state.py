"""How a free run starts: at rest at one temperature, or where prior and warm-up put it by least squares."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from thermogrip.datasets.schema import Log, make_log
from thermogrip.sysid.greybox.problem import make_problem, prior_plant
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.log_grid import cut_stretches
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.plant.simulation import find_starts, predict

A = np.array([[0.97, 0.01], [0.05, 0.9]])
B, E = np.array([0.3, 0.05]), np.array([0.02, 0.05])
C = np.array([[1.0, 0.2], [0.0, 1.0]])
SPREAD = np.array([[1.5, 0.3], [0.3, 0.8]])
P = np.zeros(0)


def plant(**changes: Any) -> Plant:
    """Two coupled bodies in a room, read every 2 s; the second sensor is off by 0.3 K from log to log."""
    model = StateSpaceModel(
        ("q",), ("t_room",), ("a", "b"), A=A, B=B[:, None], E=E[:, None], c=-25.0 * E, C=C,
        dt=2.0, y0=[25.0, 25.0], spread=SPREAD,
    )  # fmt: skip
    usual: dict[str, Any] = {
        "dt": 2.0,
        "units": {"q": "1", "t_room": "degC", "a": "degC", "b": "degC"},
        "noise": {"a": 0.1, "b": 0.2},
        "nuisance": {"b": 0.3},
        "offsets": {"a": 0.05, "b": -0.1, "t_room": 0.4},
    }
    return Plant(model, {}, **usual | changes)


def log_of(y: np.ndarray, q: Any = 0.5, room: float = 25.4) -> Log:
    n = len(y)
    columns = {
        "q": (np.broadcast_to(q, n).astype(float), "1", "input"),
        "t_room": (np.full(n, room), "degC", "disturbance"),
        "a": (y[:, 0], "degC", "output"),
        "b": (y[:, 1], "degC", "output"),
    }
    return make_log(2.0 * np.arange(n), columns)


def run(x0: np.ndarray, q: np.ndarray, room: float) -> np.ndarray:
    """Readings (n + 1, 2) without offsets, row by row."""
    x, y = x0, [C @ x0 + 25.0]
    for u in q:
        x = A @ x + B * u + E * (room - 25.0)
        y.append(C @ x + 25.0)
    return np.array(y)


@pytest.mark.parametrize("seconds", [10.0, 30.0, 60.0])
@pytest.mark.parametrize("lost", [0.0, 0.4])
def test_a_start_from_its_warm_up_is_the_least_squares_one_with_its_priors_as_rows(
    seconds: float, lost: float
):
    rng = np.random.default_rng(int(seconds))
    y = run(np.array([8.0, -2.0]), np.full(99, 0.5), 25.0) + [0.05, 0.25]
    y += rng.normal(size=y.shape) * [0.1, 0.2]
    gone = rng.random(y.shape) < lost
    gone[0] = False
    y[gone] = np.nan
    made, log = plant(), log_of(y)
    start = find_starts(made, P, cut_stretches(made, log), seconds)[0]

    pooled, q = np.array([0.05, -0.1]), np.array([0.0, 0.3])
    first = np.nanmean(y[:2], axis=0) - pooled  # of two seconds
    guess = made.model.rest(first, [0.5], [25.0], P)
    n = round(seconds / 2.0)
    # n + 1 bins count as one reading every ten seconds
    sd = np.array([0.1, 0.2]) * np.sqrt((n + 1) / (1 + seconds / 10.0))
    free = run(guess, np.full(n, 0.5), 25.0)
    rows, right = [], []
    for k in range(n + 1):
        for j in (0, 1):
            if np.isfinite(y[k, j]):
                by_state = (C @ np.linalg.matrix_power(A, k))[j]
                rows.append(np.append(by_state, 1.0 * (j == 1)) / sd[j])
                right.append((y[k, j] - pooled[j] - free[k, j]) / sd[j])
    prior = np.linalg.cholesky(np.linalg.inv(SPREAD)).T
    rows += [*np.hstack([prior, np.zeros((2, 1))]), np.array([0.0, 0.0, 1 / q[1]])]
    want = np.linalg.lstsq(np.array(rows), np.array([*right, 0.0, 0.0, 0.0]), rcond=None)[0]
    np.testing.assert_allclose(start.x0, guess + want[:2], atol=1e-6)
    np.testing.assert_allclose(start.y_offset, pooled + [0.0, want[2]], atol=1e-6)
    rest = made.model.rest(np.nanmean(y[:2], axis=0) - start.y_offset, [0.5], [25.0], P)
    np.testing.assert_allclose(start.x0 - start.shift, rest, atol=1e-9)
    assert start.d_offset.tolist() == [0.4]
    assert start.level is None


def test_a_run_is_predicted_with_its_offsets_for_one_member_as_for_many():
    y = run(np.array([8.0, -2.0]), np.full(99, 0.5), 25.0) + [0.05, 0.25]
    made, log = plant(), log_of(y)
    stretches = cut_stretches(made, log)
    starts = find_starts(made, P, stretches, 20.0)
    (one,) = predict(made.model, 2.0, np.zeros((1, 0)), stretches, starts)
    (three,) = predict(made.model, 2.0, np.zeros((3, 0)), stretches, starts)
    want = run(starts[0].x0, np.full(99, 0.5), 25.0) + starts[0].y_offset
    np.testing.assert_allclose(one[0], want, atol=1e-9)
    np.testing.assert_allclose(three, np.repeat(one, 3, axis=0), atol=1e-9)


@pytest.mark.parametrize(("apart", "rests"), [(0.95, True), (1.05, False)])
@pytest.mark.parametrize("who", ["sensor", "room"])
def test_a_log_rests_where_sensors_and_room_are_within_a_kelvin(apart: float, rests: bool, who: str):
    y = np.tile([24.0, 24.0 + (apart if who == "sensor" else 0.0)], (40, 1))
    room = 24.0 + (apart if who == "room" else 0.0)
    made = plant(reference="a")
    start = find_starts(made, P, cut_stretches(made, log_of(y, 0.0, room)), 5.0)[0]
    assert (start.level is not None) == rests
    assert start.how.startswith("started at rest" if rests else "started from")


@pytest.mark.parametrize("own", [True, False])
def test_at_rest_what_else_is_read_is_an_offset_where_a_sensor_has_one_of_its_own(own: bool):
    y = np.tile([24.0, 24.5], (40, 1))
    y[:, 0] += np.where(np.arange(40) % 2, 0.01, -0.01)
    nuisance = {"b": 0.3} | ({"t_room": 0.2} if own else {})
    made = plant(reference="a", nuisance=nuisance)
    start = find_starts(made, P, cut_stretches(made, log_of(y, 0.0, 24.8)), 5.0)[0]
    level = float(np.mean(y[:3, 0]))
    assert start.level == pytest.approx(level)
    np.testing.assert_allclose(start.y_offset, [0.05, 24.5 - level])
    np.testing.assert_allclose(start.d_offset, [24.8 - level if own else 0.4])
    room = level if own else 24.8 - 0.4
    want = made.model.rest(np.full(2, level), [0.0], [room], P)
    np.testing.assert_allclose(start.x0, want, atol=1e-9)


def test_scored_is_what_comes_from_the_end_of_the_warm_up_on():
    y = run(np.array([8.0, -2.0]), np.full(59, 0.5), 25.0)
    made = plant()
    for options, first in (({"warmup": 10.0}, 10.0), ({"warmup": 10.0, "score_from": 30.0}, 30.0)):
        out = made.simulate(log_of(y), **options)
        assert out["time"].values[out["scored"].values == 1].tolist() == np.arange(first, 120.0, 2.0).tolist()


def test_a_channel_that_is_read_later_starts_from_its_first_reading():
    y = run(np.array([8.0, -2.0]), np.full(59, 0.5), 25.0)
    y[:4, 1] = np.nan
    made = plant(nuisance={}, offsets={})
    start = find_starts(made, P, cut_stretches(made, log_of(y, room=25.0)), 4.0)[0]
    guess = made.model.rest([y[:2, 0].mean(), y[4, 1]], [0.5], [25.0], P)
    np.testing.assert_allclose(start.x0 - start.shift, guess, atol=1e-9)


def test_over_a_gap_the_input_changes_once_and_the_room_goes_on_a_line():
    """The plant's own run with a row before and a row after a gap, in which the drive was switched."""
    n, begin, end = 240, 80, 110
    q = np.where(np.arange(n) < 95, 1.0, -0.5)
    room = np.where(np.arange(n) < begin, 25.0, 27.0)
    room[begin:end] = 25.0 + 2.0 * (np.arange(begin, end) - begin + 1) / (end - begin + 1)
    x, y = np.array([8.0, -2.0]), []
    for u, r in zip(q, room):
        y.append(C @ x + 25.0)
        x = A @ x + B * u + E * (r - 25.0)
    whole = make_log(
        2.0 * np.arange(n),
        {
            "q": (q, "1", "input"),
            "t_room": (room + 0.4, "degC", "disturbance"),
            "a": (np.array(y)[:, 0], "degC", "output"),
            "b": (np.array(y)[:, 1], "degC", "output"),
        },
    )
    made = plant(nuisance={}, offsets={"t_room": 0.4}, noise={"a": 0.01, "b": 0.01})
    log = whole.isel(time=np.r_[0:begin, end:n])
    stretches = cut_stretches(made, log)
    starts = find_starts(made, P, stretches, 20.0)
    assert stretches[1].gap == 2.0 * (end - begin + 1)
    assert starts[1].change == pytest.approx(2.0 * (95 - begin + 1), abs=2.0)
    np.testing.assert_allclose(
        starts[1].x0, np.linalg.lstsq(C, np.array(y)[end] - 25.0, rcond=None)[0], atol=0.02
    )
    assert np.abs(starts[1].shift).max() < 0.1  # so what was carried there was nearly right
    runs = predict(made.model, 2.0, np.zeros((1, 0)), stretches, starts)
    np.testing.assert_allclose(runs[1][0, : n - end], np.array(y)[end:], atol=0.1)
    moved = [starts[0], replace(starts[1], shift=starts[1].shift + [1.0, 0.0])]
    off = predict(made.model, 2.0, np.zeros((1, 0)), stretches, moved)[1] - runs[1]
    np.testing.assert_allclose(off[0, 0], C[:, 0], atol=1e-9)
    out = made.simulate(log, warmup=20.0)
    since = out["time"].values - 2.0 * end
    after = since >= 0
    assert (out["scored"].values[after] == (since[after] >= 60.0)).all()


def test_a_fit_sees_the_errors_that_its_plant_makes_also_where_a_warm_log_shows_an_offset():
    """The batch that a Jacobian is taken from begins with the run of the parameters themselves."""
    model = load_network("gripper")
    t = np.arange(0.0, 400.0, 0.5)
    drive = np.where(t < 60, 0.6, 0.0)
    signals = {
        "drive": (drive, "1", "input"),
        "pump": (np.ones(t.size), "1", "input"),
        "t_ambient": (np.full(t.size, 25.0), "degC", "disturbance"),
    }
    still = {name: (np.full(t.size, 25.0), "degC", "output") for name in model.outputs}
    made = prior_plant(model).simulate(make_log(t, signals | still))
    warm = {
        name: (made[name].values + (1.5 if name == "t_surface" else 0.0), "degC", "output") for name in still
    }
    log = make_log(t, signals | warm).isel(time=t >= 50.0)
    problem = make_problem(model, [log], average=5.0, independent=60.0)
    z = 0.1 * np.random.default_rng(0).standard_normal(len(problem.free))
    start = problem.start(z)[0][0]
    assert abs(start.y_offset[1] - problem.plant.offsets.get("t_surface", 0.0)) > 0.1  # it is taken for one
    errors = problem.errors(z)[0][0]
    scaled = np.concatenate([problem.scaled(k, e[None])[0] for k, e in enumerate(errors)])
    np.testing.assert_allclose(problem.by_log(z)[0][0], scaled, atol=1e-6)
