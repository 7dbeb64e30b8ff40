"""Free runs: only the warm-up of the outputs is read, starts are least squares, gaps are filled from data."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import xarray as xr
from numpy.typing import ArrayLike

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, make_log
from thermogrip.sysid.greybox.problem import make_problem, prior_plant
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.log_grid import Stretch, cut_stretches
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.plant.simulation import _binned, _first_reading, find_starts, predict

A = np.array([[0.97, 0.01], [0.05, 0.9]])
B, E = np.array([0.3, 0.05]), np.array([0.02, 0.05])
C = np.array([[1.0, 0.2], [0.0, 1.0]])
SPREAD = np.array([[1.5, 0.3], [0.3, 0.8]])
P = np.zeros(0)
T = 2.0 * np.arange(100)


def plant(kind: type[StateSpaceModel] = StateSpaceModel, dt: float = 2.0, **changes: Any) -> Plant:
    """Two coupled bodies in a room, read every 2 s; the second sensor is off by 0.3 K from log to log."""
    model = kind(
        ("q",), ("t_room",), ("a", "b"), A=A, B=B[:, None], E=E[:, None], c=-25.0 * E, C=C,
        dt=dt, y0=[25.0, 25.0], spread=SPREAD,
    )  # fmt: skip
    usual: dict[str, Any] = {
        "dt": dt,
        "units": {"q": "1", "t_room": "degC", "a": "degC", "b": "degC"},
        "noise": {"a": 0.1, "b": 0.2},
        "nuisance": {"b": 0.3},
        "offsets": {"a": 0.05, "b": -0.1, "t_room": 0.4},
    }
    return Plant(model, {}, **usual | changes)


def log_of(t: np.ndarray, y: Any, q: Any = 0.5, room: Any = 25.0, name: str = "a") -> Log:
    y, q, room = (
        np.broadcast_to(np.asarray(v, float), s) for v, s in ((y, (t.size, 2)), (q, t.size), (room, t.size))
    )
    columns = {"q": (q, "1", "input"), "t_room": (room, "degC", "disturbance")}
    columns |= {"a": (y[:, 0], "degC", "output"), "b": (y[:, 1], "degC", "output")}
    return make_log(t, columns, name=name)


def truth(q: np.ndarray, room: float = 25.0, x0: Any = (8.0, -2.0)) -> np.ndarray:
    """Readings (n + 1, 2) without offsets, row by row, the drive held from row to row."""
    x = np.array(x0, float)
    y = [C @ x + 25.0]
    for u in q:
        x = A @ x + B * u + E * (room - 25.0)
        y.append(C @ x + 25.0)
    return np.array(y)


class Leaning(StateSpaceModel):
    """Its hidden balance leans on drive and room, as that of a network whose nodes are not all read."""

    def rest(self, y: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike) -> np.ndarray:
        y, u, d = (np.asarray(value, float) for value in (y, u, d))
        return np.linalg.solve(C, y - 25.0) + 3.0 * u[0] * np.array([1.0, -1.0]) + 0.5 * (d[0] - 25.0)


# ---- the start ----


@pytest.mark.parametrize("seconds", [10.0, 30.0, 60.0])
@pytest.mark.parametrize("lost", [0.0, 0.4])
def test_a_start_from_its_warm_up_is_the_least_squares_one_with_its_priors_as_rows(
    seconds: float, lost: float
):
    rng = np.random.default_rng(int(seconds))
    y = truth(np.full(99, 0.5)) + [0.05, 0.25]
    y += rng.normal(size=y.shape) * [0.1, 0.2]
    gone = rng.random(y.shape) < lost
    gone[0] = False
    y[gone] = np.nan
    made, log = plant(), log_of(T[: len(y)], y, room=25.4)
    start = find_starts(made, P, cut_stretches(made, log), seconds)[0]

    pooled, q = np.array([0.05, -0.1]), np.array([0.0, 0.3])
    first = np.nanmean(y[:2], axis=0) - pooled  # of two seconds
    guess = made.model.rest(first, [0.5], [25.0], P)
    n = round(seconds / 2.0)
    # n + 1 bins count as one reading every ten seconds
    sd = np.array([0.1, 0.2]) * np.sqrt((n + 1) / (1 + seconds / 10.0))
    free = truth(np.full(n, 0.5), x0=guess)
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
    y = truth(np.full(99, 0.5)) + [0.05, 0.25]
    made, log = plant(), log_of(T[: len(y)], y, room=25.4)
    stretches = cut_stretches(made, log)
    starts = find_starts(made, P, stretches, 20.0)
    (one,) = predict(made.model, 2.0, np.zeros((1, 0)), stretches, starts)
    (three,) = predict(made.model, 2.0, np.zeros((3, 0)), stretches, starts)
    want = truth(np.full(99, 0.5), x0=starts[0].x0) + starts[0].y_offset
    np.testing.assert_allclose(one[0], want, atol=1e-9)
    np.testing.assert_allclose(three, np.repeat(one, 3, axis=0), atol=1e-9)


@pytest.mark.parametrize(("apart", "rests"), [(0.95, True), (1.05, False)])
@pytest.mark.parametrize("who", ["sensor", "room"])
def test_a_log_rests_where_sensors_and_room_are_within_a_kelvin(apart: float, rests: bool, who: str):
    y = np.tile([24.0, 24.0 + (apart if who == "sensor" else 0.0)], (40, 1))
    room = 24.0 + (apart if who == "room" else 0.0)
    made = plant(reference="a")
    start = find_starts(made, P, cut_stretches(made, log_of(T[: len(y)], y, 0.0, room)), 5.0)[0]
    assert (start.level is not None) == rests
    assert start.how.startswith("started at rest" if rests else "started from")


@pytest.mark.parametrize("own", [True, False])
def test_at_rest_what_else_is_read_is_an_offset_where_a_sensor_has_one_of_its_own(own: bool):
    y = np.tile([24.0, 24.5], (40, 1))
    y[:, 0] += np.where(np.arange(40) % 2, 0.01, -0.01)
    nuisance = {"b": 0.3} | ({"t_room": 0.2} if own else {})
    made = plant(Leaning, reference="a", nuisance=nuisance)  # of which the room moves the balance
    driven = np.minimum(np.arange(40.0), 1.0)  # from the second row on
    start = find_starts(made, P, cut_stretches(made, log_of(T[: len(y)], y, driven, 24.8)), 5.0)[0]
    level = float(np.mean(y[:3, 0]))
    assert start.level == pytest.approx(level)
    np.testing.assert_allclose(start.y_offset, [0.05, 24.5 - level])
    np.testing.assert_allclose(start.d_offset, [24.8 - level if own else 0.4])
    room = level if own else 24.8 - 0.4
    want = made.model.rest(np.full(2, level), [0.0], [room], P)
    np.testing.assert_allclose(start.x0, want, atol=1e-9)


def test_a_start_leans_on_the_drive_and_the_room_of_its_first_step():
    later = np.where(T < 60.0, 0.5, 2.0)
    y = truth(later, x0=(6.0, 1.0))[:-1] + [0.05, -0.1]
    made = plant(Leaning, nuisance={})
    (start,) = find_starts(made, P, cut_stretches(made, log_of(T, y, later, 26.4)), 20.0)
    first = y[:2].mean(axis=0) - [0.05, -0.1]
    want = np.linalg.solve(C, first - 25.0) + 1.5 * np.array([1.0, -1.0]) + 0.5 * (26.4 - 0.4 - 25.0)
    np.testing.assert_allclose(start.x0 - start.shift, want, atol=1e-9)


def test_a_log_that_moves_after_five_seconds_began_at_rest_however_long_its_warm_up():
    y = 24.0 + 0.5 * np.maximum(T - 5.0, 0.0)[:, None] * [1.0, 1.0]
    made = plant(reference="a")
    (start,) = find_starts(made, P, cut_stretches(made, log_of(T, y, room=24.0)), 60.0)
    assert start.level == 24.0


def test_a_lost_reading_of_the_first_seconds_leaves_a_log_at_rest():
    y = np.tile([24.0, 24.5], (T.size, 1))
    y[1, 0] = y[0, 1] = np.nan
    made = plant(reference="b")
    (start,) = find_starts(made, P, cut_stretches(made, log_of(T, y, room=24.3)), 5.0)
    assert start.level == 24.5  # of the reference, whichever output that is
    y[:3, 0] = np.nan
    (start,) = find_starts(made, P, cut_stretches(made, log_of(T, y, room=24.3)), 5.0)
    assert start.level is None  # a sensor that says nothing is not known to be at rest


def test_the_rooms_offset_at_rest_is_the_mean_over_the_steps_of_the_first_seconds():
    made = plant(reference="a", nuisance={"t_room": 0.2})
    stretches = cut_stretches(made, log_of(T, [24.0, 24.0], 0.0, np.where(T < 8.0, 24.0, 24.9)))
    (start,) = find_starts(made, P, stretches, 5.0)
    assert stretches[0].d[4, 0] > stretches[0].d[1, 0] + 0.05  # smoothed, it rises already
    np.testing.assert_allclose(start.d_offset, stretches[0].d[:2, 0].mean() - 24.0)


def test_a_reading_counts_for_the_step_that_is_nearest():
    time = np.array([0.0, 0.9, 1.1, 2.0, 2.9, 3.2, 4.9, 9.0])
    y = np.column_stack([np.arange(8.0), np.where(np.arange(8) == 3, np.nan, 10.0)])
    stretch = Stretch(time, y, np.zeros((5, 1)), np.zeros((5, 0)), "a", slice(0, 8), 0.0)
    found = _binned(stretch, 2.0, 3, 6.0)
    np.testing.assert_allclose(found, [[0.5, 10.0], [3.0, 10.0], [5.5, 10.0], [np.nan, np.nan]])


def test_a_channel_that_is_read_later_starts_from_its_first_reading():
    y = truth(np.full(59, 0.5))
    y[:4, 1] = np.nan
    made = plant(nuisance={}, offsets={})
    start = find_starts(made, P, cut_stretches(made, log_of(T[: len(y)], y)), 4.0)[0]
    guess = made.model.rest([y[:2, 0].mean(), y[4, 1]], [0.5], [25.0], P)
    np.testing.assert_allclose(start.x0 - start.shift, guess, atol=1e-9)


def test_a_fit_sees_the_errors_that_its_plant_makes_also_where_a_warm_log_shows_an_offset():
    """The batch that a Jacobian is taken from begins with the run of the parameters themselves."""
    model = load_network("gripper")
    t = np.arange(0.0, 400.0, 0.5)
    drive, still = np.where(t < 60, 0.6, 0.0), np.full(t.size, 25.0)
    made = prior_plant(model).simulate(gripper_log(t, drive, still, still, 25.0))
    tank, surface = (made[name].values for name in model.outputs)
    log = gripper_log(t, drive, tank, surface + 1.5, 25.0).isel(time=t >= 50.0)
    problem = make_problem(model, [log], average=5.0, independent=60.0)
    z = 0.1 * np.random.default_rng(0).standard_normal(len(problem.free))
    start = problem.start(z)[0][0]
    assert abs(start.y_offset[1] - problem.plant.offsets.get("t_surface", 0.0)) > 0.1  # it is taken for one
    errors = problem.errors(z)[0][0]
    scaled = np.concatenate([problem.scaled(k, e[None])[0] for k, e in enumerate(errors)])
    np.testing.assert_allclose(problem.by_log(z)[0][0], scaled, atol=1e-6)


def stretch_of(time: Any, y: Any = None, steps: int = 5, gap: float = 0.0, **held: float) -> Stretch:
    time = np.asarray(time, float)
    u, d = (np.full((steps, 1), held.get(name, 0.0)) for name in ("u", "d"))
    y = np.zeros((time.size, 2)) if y is None else y
    return Stretch(time, y, u, d, "a", slice(0, time.size), gap)


def test_a_first_reading_is_of_two_seconds_or_else_of_the_first_minute():
    time = np.array([0.0, 2.0, 3.0, 59.0, 60.0])
    y = np.array([[1.0, np.nan], [4.0, np.nan], [90.0, np.nan], [90.0, 7.0], [90.0, 8.0]])
    assert _first_reading(stretch_of(time, y)).tolist() == [2.5, 7.0]
    y[3, 1] = np.nan
    assert _first_reading(stretch_of(time, y))[0] == 2.5
    assert np.isnan(_first_reading(stretch_of(time, y))[1])
    y[:, 1] = np.nan
    assert np.isnan(_first_reading(stretch_of(time, y))[1])


def test_without_a_reference_or_a_warm_up_no_start_is_at_rest():
    log = log_of(T, [24.0, 24.0], 0.0, 24.0)
    (start,) = find_starts(plant(), P, cut_stretches(plant(), log), 5.0)
    assert start.level is None
    for seconds in (0.0, -1.0):
        with pytest.raises(UserError, match=f"a warm-up of {seconds:g} s says nothing"):
            plant().simulate(log, warmup=seconds)


# ---- rows and names ----


def test_a_run_is_scored_from_its_own_first_row_whatever_its_clock_says():
    y = truth(np.full(99, 0.5))
    one, late = (plant().simulate(log_of(T + begin, y), warmup=20.0) for begin in (0.0, 5000.0))
    np.testing.assert_array_equal(late["scored"].values, one["scored"].values)
    np.testing.assert_allclose(late["a"].values, one["a"].values, atol=1e-9)
    assert one["scored"].values[:11].tolist() == [0.0] * 10 + [1.0]
    out = plant().simulate(log_of(T, y), warmup=10.0, score_from=30.0)
    assert out["time"].values[out["scored"].values == 1].tolist() == T[15:].tolist()


def test_a_run_keeps_name_units_and_roles_of_its_log():
    made = plant(units={"q": "1", "t_room": "degC", "a": "K", "b": "degC"})
    y = truth(np.full(99, 0.5))
    log = log_of(T, y, name="monday")
    log["a"].attrs["units"] = "K"
    run = made.simulate(log)
    assert run.attrs["name"] == "monday"
    said = {name: (run[name].attrs["role"], run[name].attrs["units"]) for name in ("q", "t_room", "a", "b")}
    assert said == {
        "q": ("input", "1"), "t_room": ("disturbance", "degC"), "a": ("output", "K"), "b": ("output", "degC"),
    }  # fmt: skip
    with pytest.raises(ValueError, match="gaps is 'restart' or 'hold'"):
        made.simulate(log, gaps="bridge")


def test_what_the_plant_and_its_log_disagree_on_is_refused_by_name():
    log = log_of(T, 25.0)
    for name in ("t_room", "b"):
        other = log.copy(deep=True)
        other[name].attrs["units"] = "K"
        with pytest.raises(UserError, match=f"column {name}: is in 'K', the plant's is in 'degC'"):
            plant().simulate(other)
    lost = log.copy(deep=True)
    lost["t_room"].attrs["role"] = "output"  # of which a reading may be lost
    lost["t_room"].values[7] = np.nan
    with pytest.raises(UserError, match="column t_room: is unknown in some rows"):
        plant().simulate(lost)


# ---- gaps ----


def kept(t: np.ndarray, *gaps: tuple[float, float]) -> np.ndarray:
    return np.flatnonzero(np.all([(t < a) | (t > b) for a, b in gaps], axis=0))


def test_over_a_gap_the_input_changes_in_its_middle_and_the_room_goes_on_a_line():
    """The plant's own run with a row before and a row after a gap, in which the drive was switched."""
    n, begin, end = 240, 80, 111
    q = np.where(np.arange(n) < 95, 1.0, -0.5)
    room = np.where(np.arange(n) < begin, 25.0, 27.0)
    room[begin:end] = 25.0 + 2.0 * (np.arange(begin, end) - begin + 1) / (end - begin + 1)
    x, y = np.array([8.0, -2.0]), []
    for u, r in zip(q, room):
        y.append(C @ x + 25.0)
        x = A @ x + B * u + E * (r - 25.0)
    whole = log_of(2.0 * np.arange(n), y, q, room + 0.4)
    made = plant(nuisance={}, offsets={"t_room": 0.4}, noise={"a": 0.01, "b": 0.01})
    log = whole.isel(time=np.r_[0:begin, end:n])
    stretches = cut_stretches(made, log)
    starts = find_starts(made, P, stretches, 20.0)
    assert stretches[1].gap == 2.0 * (end - begin + 1)
    assert "changed in its middle" in starts[1].how
    np.testing.assert_allclose(
        starts[1].x0, np.linalg.lstsq(C, np.array(y)[end] - 25.0, rcond=None)[0], atol=0.02
    )
    assert np.abs(starts[1].shift).max() < 0.1  # so what was propagated there was nearly right
    runs = predict(made.model, 2.0, np.zeros((1, 0)), stretches, starts)
    np.testing.assert_allclose(runs[1][0, : n - end], np.array(y)[end:], atol=0.1)
    moved = [starts[0], replace(starts[1], shift=starts[1].shift + [1.0, 0.0])]
    off = predict(made.model, 2.0, np.zeros((1, 0)), stretches, moved)[1] - runs[1]
    np.testing.assert_allclose(off[0, 0], C[:, 0], atol=1e-9)
    out = made.simulate(log, warmup=20.0)
    since = out["time"].values - 2.0 * end
    after = since >= 0
    assert (out["scored"].values[after] == (since[after] >= 60.0)).all()


def test_every_gap_is_carried_over_from_the_stretch_before_it():
    t = 2.0 * np.arange(300)
    q = np.where(t < 156.0, 0.2, np.where(t < 340.0, 1.5, -0.5))
    y = truth(q)[:-1]
    made = plant(nuisance={}, offsets={}, noise={"a": 0.01, "b": 0.01})
    log = log_of(t, y, q)
    rows = kept(t, (140.0, 172.0), (320.0, 360.0))
    run = made.simulate(log.isel(time=rows), warmup=20.0)
    stretches = cut_stretches(made, log.isel(time=rows))
    starts = find_starts(made, P, stretches, 20.0)
    begins = [np.linalg.solve(C, y[k] - 25.0) for k in (0, 87, 181)]
    for start, begin in zip(starts, begins, strict=True):
        np.testing.assert_allclose(start.x0, begin, atol=0.02)
    assert [np.abs(start.shift).max() < 0.1 for start in starts[1:]] == [True, True]
    np.testing.assert_allclose(run["a"].values, y[rows, 0], atol=0.05)


def test_a_gap_of_centuries_as_a_damaged_clock_has_is_passed_at_rest():
    t = 2.0 * np.arange(300)
    q = np.full(t.size, 0.2)
    made = plant(nuisance={}, offsets={}, noise={"a": 0.01, "b": 0.01})
    log = log_of(t, truth(q)[:-1], q)
    later = log.assign_coords(time=np.where(t < 300.0, t, t + 1e11))
    run = made.simulate(later, warmup=20.0)
    np.testing.assert_allclose(run["a"].values[-1], log["a"].values[-1], atol=0.05)


def test_offsets_are_those_of_the_log_also_behind_a_gap():
    t = 2.0 * np.arange(200)
    y = truth(np.full(t.size - 1, 0.5)) + [0.05, 0.2]
    y[t > 170.0, 1] += 0.4
    made = plant()
    first, second = find_starts(
        made, P, cut_stretches(made, log_of(t, y, room=25.4).isel(time=kept(t, (121.0, 179.0)))), 30.0
    )
    assert first.y_offset[1] > 0.0  # it has moved from the pooled -0.1
    assert second.y_offset.tolist() == first.y_offset.tolist()


def test_an_offset_that_fades_does_from_the_middle_of_the_warm_up_on_and_through_gaps():
    t = 2.0 * np.arange(200)
    y = truth(np.full(t.size - 1, 0.5)) + [0.05, 0.2]
    y[t > 170.0, 1] = y[t > 170.0, 1] - 0.3 + 0.3 * np.exp(-(t[t > 170.0] - 15.0) / 100.0)
    log = log_of(t, y, room=25.4).isel(time=kept(t, (121.0, 179.0)))
    lasts, fades = plant(), plant(offset_memory=100.0)
    stretches = cut_stretches(fades, log)
    first, second = find_starts(fades, P, stretches, 30.0)
    steady = find_starts(lasts, P, stretches, 30.0)[0]
    np.testing.assert_allclose(first.y_offset, steady.y_offset)  # it is what the warm-up says in both
    own = first.y_offset[1] + 0.1  # beside the pooled -0.1, which stays
    for start, begins in ((first, 0.0), (second, 180.0)):
        seconds = np.array([0.0, 30.0, 90.0])
        left = np.exp(-np.maximum(begins + seconds - 15.0, 0.0) / 100.0)
        np.testing.assert_allclose(
            start.offset(seconds), np.column_stack([0.05 + 0 * left, own * left - 0.1])
        )
    runs = predict(fades.model, 2.0, P[None], stretches, [first, second])
    plain = predict(lasts.model, 2.0, P[None], stretches[:1], [steady])[0]
    lost = own * (np.exp(-np.maximum(2.0 * np.arange(plain.shape[1]) - 15.0, 0.0) / 100.0) - 1.0)
    np.testing.assert_allclose(runs[0][0, :, 1] - plain[0, :, 1], lost, atol=1e-9)
    # behind the gap the readings were those of the faded offset: the state needs next to no shift
    again = find_starts(lasts, P, stretches, 30.0)[1]
    assert abs(second.shift[1]) < abs(again.shift[1])


def test_a_grid_that_ends_beyond_the_last_row_takes_that_from_the_gap():
    fine = np.arange(300.0)  # rows each second, steps of two: the last step before the gap is half a row long
    q = np.full(fine.size, 0.5)
    y = np.repeat(truth(q[::2])[:-1], 2, axis=0)
    y[1:-1:2] = (y[:-2:2] + y[2::2]) / 2
    made = plant(nuisance={}, offsets={}, noise={"a": 0.01, "b": 0.01})
    log = log_of(fine, y, q).isel(time=kept(fine, (79.5, 119.5)))
    stretches = cut_stretches(made, log)
    assert (len(stretches[0].u), stretches[0].time[-1], stretches[1].gap) == (40, 79.0, 41.0)
    starts = find_starts(made, P, stretches, 20.0)
    np.testing.assert_allclose(starts[1].x0, np.linalg.solve(C, y[120] - 25.0), atol=1e-3)
    np.testing.assert_allclose(starts[1].shift, 0.0, atol=5e-3)


# ---- the grid ----


def test_a_stretch_behind_a_gap_has_the_inputs_of_its_own_rows():
    t = 2.0 * np.arange(200)
    q = np.sin(t / 20.0)
    made = plant()
    rows = kept(t, (101.0, 139.0))
    first, second = cut_stretches(made, log_of(t, 25.0, q).isel(time=rows))
    np.testing.assert_allclose(first.u[:, 0], q[:50])
    np.testing.assert_allclose(second.u[:, 0], q[70:199])  # the last row has no step of its own
    assert (first.rows, second.rows) == (slice(0, 51), slice(51, 181))


# ---- a network ----


@pytest.fixture(scope="module")
def gripper() -> Plant:
    return prior_plant(load_network("gripper"))


def gripper_log(
    t: np.ndarray, drive: np.ndarray, tank: np.ndarray, surface: np.ndarray, room: float = 25.2
) -> Log:
    return make_log(
        t,
        {
            "drive": (drive, "1", "input"),
            "pump": (np.ones(t.size), "1", "input"),
            "t_ambient": (np.full(t.size, room), "degC", "disturbance"),
            "t_tank": (tank, "degC", "output"),
            "t_surface": (surface, "degC", "output"),
        },
        name="made",
    )


def gripper_run(plant: Plant, t: np.ndarray, drive: np.ndarray) -> Log:
    """What the plant itself reads from rest at 25 degC, with offsets 0.2 (ambient) and 0.1 (surface)."""
    still = np.full(t.size, 25.0)
    run = plant.simulate(gripper_log(t, drive, still, still + 0.1))
    return gripper_log(t, drive, run["t_tank"].values, run["t_surface"].values)


def test_outputs_after_the_warm_up_are_not_read(gripper: Plant):
    t = np.arange(0, 300, 0.5)
    log = gripper_run(gripper, t, np.sin(t / 40))
    masked = log.copy(deep=True)
    for name in ("t_tank", "t_surface"):
        masked[name] = masked[name].where(masked["time"] <= 5.0, 99.0)
    xr.testing.assert_equal(gripper.simulate(log), gripper.simulate(masked))


def test_a_plant_is_carried_through_a_gap_with_a_switch_inside(gripper: Plant):
    t = np.arange(0, 900, 0.25)
    log = gripper_run(gripper, t, np.where(t < 425.0, 0.6, -0.7))
    gap = log.isel(time=np.flatnonzero((t < 400) | (t > 440)))
    filled, held = gripper.simulate(gap), gripper.simulate(gap, gaps="hold")
    after = gap["time"].values > 445
    errors = [np.std((run["t_tank"].values - gap["t_tank"].values)[after]) for run in (filled, held)]
    assert errors[0] < 0.05 < errors[1]
    assert held["scored"].values[gap["time"].values > 5].all()


def test_a_batch_of_parameters_ends_where_each_member_alone_does(gripper: Plant):
    made = gripper
    t = np.arange(0.0, 300.0, 0.5)
    drive = np.where(t < 100.0, 0.6, -0.3)
    log = gripper_log(t, drive, 25.0 + t / 30, 25.5 + t / 40, 25.0).isel(time=kept(t, (150.0, 190.0)))
    stretches = cut_stretches(made, log)
    starts = find_starts(made, made.p, stretches, 5.0)
    more = made.p * (1 + 0.1 * np.random.default_rng(0).uniform(-1, 1, (2, made.p.size)))
    both = predict(made.model, made.dt, np.vstack([made.p, more]), stretches, starts)
    _, alone = predict(made.model, made.dt, made.p[None], stretches, starts)
    np.testing.assert_allclose(both[1][0], alone[0], atol=1e-9)
