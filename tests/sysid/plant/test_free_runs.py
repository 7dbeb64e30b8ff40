"""Free runs row by row: what a start refers to, what goes through a gap, what the grid makes of a log."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from tests.sysid.models.test_initial_state import SPREAD, A, B, C, E, P, plant
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, make_log
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.log_grid import Stretch, at_rows, cut_stretches
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.plant.simulation import _binned, find_starts, predict


def log_of(t: np.ndarray, y: Any, q: Any = 0.5, room: Any = 25.0, name: str = "a") -> Log:
    y, q, room = (
        np.broadcast_to(np.asarray(v, float), s) for v, s in ((y, (t.size, 2)), (q, t.size), (room, t.size))
    )
    columns = {"q": (q, "1", "input"), "t_room": (room, "degC", "disturbance")}
    columns |= {"a": (y[:, 0], "degC", "output"), "b": (y[:, 1], "degC", "output")}
    return make_log(t, columns, name=name)


def truth(t: np.ndarray, q: np.ndarray, room: float = 25.0, x0: Any = (8.0, -2.0)) -> np.ndarray:
    """Readings (n, 2) at rows on the plant's steps of 2 s, the drive held from row to row."""
    x, y = np.array(x0, float), []
    for u in q:
        y.append(C @ x + 25.0)
        x = A @ x + B * u + E * (room - 25.0)
    return np.array(y)


class Leaning(StateSpaceModel):
    """Its hidden balance leans on drive and room, as that of a network whose nodes are not all read."""

    def rest(self, y: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike) -> np.ndarray:
        y, u, d = (np.asarray(value, float) for value in (y, u, d))
        return np.linalg.solve(C, y - 25.0) + 3.0 * u[0] * np.array([1.0, -1.0]) + 0.5 * (d[0] - 25.0)


def leaning(**changes: Any) -> Plant:
    model = Leaning(
        ("q",), ("t_room",), ("a", "b"), A=A, B=B[:, None], E=E[:, None], c=-25.0 * E, C=C,
        dt=2.0, y0=[25.0, 25.0], spread=SPREAD,
    )  # fmt: skip
    made = plant(**changes)
    return Plant(
        model, {}, dt=2.0, units=made.units, noise=made.noise, nuisance=made.nuisance,
        offsets=made.offsets, reference=made.reference,
    )  # fmt: skip


T = 2.0 * np.arange(100)


# ---- the start ----


def test_a_start_leans_on_the_drive_and_the_room_of_its_first_step():
    later = np.where(T < 60.0, 0.5, 2.0)
    y = truth(T, later, x0=(6.0, 1.0)) + [0.05, -0.1]
    made = leaning(nuisance={})
    (start,) = find_starts(made, P, cut_stretches(made, log_of(T, y, later, 26.4)), 20.0)
    first = y[:2].mean(axis=0) - [0.05, -0.1]
    want = np.linalg.solve(C, first - 25.0) + 1.5 * np.array([1.0, -1.0]) + 0.5 * (26.4 - 0.4 - 25.0)
    np.testing.assert_allclose(start.x0 - start.shift, want, atol=1e-9)


@pytest.mark.parametrize("own", [True, False])
def test_at_rest_a_room_sensor_without_an_offset_of_its_own_is_accepted(own: bool):
    nuisance = {"b": 0.3} | ({"t_room": 0.2} if own else {})
    made = leaning(reference="a", nuisance=nuisance)
    (start,) = find_starts(made, P, cut_stretches(made, log_of(T, [24.0, 24.5], 0.0, 24.8)), 5.0)
    room = 24.0 if own else 24.8 - 0.4
    np.testing.assert_allclose(start.x0, np.linalg.solve(C, [-1.0, -1.0]) + 0.5 * (room - 25.0), atol=1e-9)


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
    stretch = Stretch(slice(0, 8), time, y, np.zeros((5, 1)), np.zeros((5, 0)), 0.0, "a")
    found = _binned(stretch, 2.0, 3, 6.0)
    np.testing.assert_allclose(found, [[0.5, 10.0], [3.0, 10.0], [5.5, 10.0], [np.nan, np.nan]])


# ---- rows and names ----


def test_a_run_is_scored_from_its_own_first_row_whatever_its_clock_says():
    y = truth(T, np.full(T.size, 0.5))
    one, late = (plant().simulate(log_of(T + begin, y), warmup=20.0) for begin in (0.0, 5000.0))
    np.testing.assert_array_equal(late["scored"].values, one["scored"].values)
    np.testing.assert_allclose(late["a"].values, one["a"].values, atol=1e-9)
    assert one["scored"].values[:11].tolist() == [0.0] * 10 + [1.0]


def test_a_run_keeps_name_units_and_roles_of_its_log():
    made = plant(units={"q": "1", "t_room": "degC", "a": "K", "b": "degC"})
    y = truth(T, np.full(T.size, 0.5))
    log = log_of(T, y, name="monday")
    log["a"].attrs["units"] = "K"
    run = made.simulate(log)
    assert run.attrs["name"] == "monday"
    said = {name: (run[name].attrs["role"], run[name].attrs["units"]) for name in ("q", "t_room", "a", "b")}
    assert said == {
        "q": ("input", "1"), "t_room": ("disturbance", "degC"), "a": ("output", "K"), "b": ("output", "degC"),
    }  # fmt: skip
    with pytest.raises(ValueError, match="gaps is 'mend' or 'hold'"):
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


def test_every_gap_is_carried_over_from_the_stretch_before_it():
    t = 2.0 * np.arange(300)
    q = np.where(t < 150.0, 0.2, np.where(t < 330.0, 1.5, -0.5))
    y = truth(t, q)
    made = plant(nuisance={}, offsets={}, noise={"a": 0.01, "b": 0.01})
    log = log_of(t, y, q)
    rows = kept(t, (140.0, 170.0), (320.0, 360.0))
    run = made.simulate(log.isel(time=rows), warmup=20.0)
    stretches = cut_stretches(made, log.isel(time=rows))
    starts = find_starts(made, P, stretches, 20.0)
    begins = [np.linalg.solve(C, y[k] - 25.0) for k in (0, 86, 181)]
    for start, begin in zip(starts, begins, strict=True):
        np.testing.assert_allclose(start.x0, begin, atol=0.02)
    assert [np.abs(start.shift).max() < 0.1 for start in starts[1:]] == [True, True]
    np.testing.assert_allclose(run["a"].values, y[rows, 0], atol=0.05)


def test_a_change_is_looked_for_where_the_last_row_before_a_gap_and_the_first_behind_it_differ():
    t = 2.0 * np.arange(200)
    q = np.where(t < 40.0, -0.5, np.where(t < 180.0, 1.5, -0.5))  # first and last are alike
    made = plant(nuisance={}, offsets={}, noise={"a": 0.01, "b": 0.01})
    log = log_of(t, truth(t, q), q).isel(time=kept(t, (161.0, 199.0)))
    _, start = find_starts(made, P, cut_stretches(made, log), 20.0)
    assert start.change == pytest.approx(180.0 - 160.0, abs=1.0)
    q = np.where(t < 40.0, -0.5, 1.5)  # it changed before the gap, and not in it
    log = log_of(t, truth(t, q), q).isel(time=kept(t, (161.0, 199.0)))
    _, start = find_starts(made, P, cut_stretches(made, log), 20.0)
    assert (start.change, "changed" in start.how) == (0.0, False)


def test_offsets_are_those_of_the_log_also_behind_a_gap():
    t = 2.0 * np.arange(200)
    y = truth(t, np.full(t.size, 0.5)) + [0.05, 0.2]
    y[t > 170.0, 1] += 0.4
    made = plant()
    first, second = find_starts(
        made, P, cut_stretches(made, log_of(t, y, room=25.4).isel(time=kept(t, (121.0, 179.0)))), 30.0
    )
    assert first.y_offset[1] > 0.0  # it has moved from the pooled -0.1
    assert second.y_offset.tolist() == first.y_offset.tolist()


def test_a_grid_that_ends_beyond_the_last_row_takes_that_from_the_gap():
    fine = np.arange(300.0)  # rows each second, steps of two: the last step before the gap is half a row long
    q = np.full(fine.size, 0.5)
    y = np.repeat(truth(fine[::2], q[::2]), 2, axis=0)
    y[1:-1:2] = (y[:-2:2] + y[2::2]) / 2
    made = plant(nuisance={}, offsets={}, noise={"a": 0.01, "b": 0.01})
    log = log_of(fine, y, q).isel(time=kept(fine, (79.5, 119.5)))
    stretches = cut_stretches(made, log)
    assert (len(stretches[0].u), stretches[0].time[-1], stretches[1].gap) == (40, 79.0, 41.0)
    starts = find_starts(made, P, stretches, 20.0)
    np.testing.assert_allclose(starts[1].x0, np.linalg.solve(C, y[120] - 25.0), atol=1e-3)
    np.testing.assert_allclose(starts[1].shift, 0.0, atol=5e-3)


def test_the_time_of_a_change_is_the_likeliest_with_the_carried_state_as_unsure_as_its_spread():
    rng = np.random.default_rng(3)
    t = 2.0 * np.arange(160)
    q = np.where(t < 172.0, 1.5, -0.5)
    y = truth(t, q) + 0.3 * rng.normal(size=(t.size, 2))
    y[t > 160.0] += [0.8, -0.5]  # and the plant is not quite the model
    made = plant(nuisance={}, offsets={}, noise={"a": 0.3, "b": 0.3})
    stretches = cut_stretches(made, log_of(t, y, q).isel(time=kept(t, (159.0, 191.0))))
    before, after = find_starts(made, P, stretches, 40.0)
    assert stretches[1].gap == 34.0
    x = before.x0
    for _ in range(79):  # to the last row before the gap
        x = A @ x + B * 1.5
    sd, rows = 0.3 * np.sqrt(21 / (1 + 40.0 / 10.0)), range(21)
    moves = np.concatenate([C @ np.linalg.matrix_power(A, k) for k in rows]) / sd
    inverse = np.linalg.inv(moves @ SPREAD @ moves.T + np.eye(len(moves)))
    seen = y[t >= 192.0][:21]
    costs = []
    for change in np.linspace(0.0, 34.0, 69):
        end = x
        for k in range(17):
            share = np.clip((change - 2.0 * k) / 2.0, 0.0, 1.0)
            end = A @ end + B * (share * 1.5 + (1 - share) * -0.5)
        free = []
        for _ in rows:
            free.append(C @ end + 25.0)
            end = A @ end + B * -0.5
        r = ((seen - np.array(free)) / sd).ravel()
        costs.append(r @ inverse @ r)
    assert after.change == np.linspace(0.0, 34.0, 69)[int(np.argmin(costs))]


# ---- the grid ----


def chamber(pwm: np.ndarray, **attrs: Any) -> Log:
    model, still = load_network("peltier_chamber"), np.full(pwm.size, 22.0)
    columns = {"pwm": (pwm, "0_255", "input")}
    columns |= dict.fromkeys(model.disturbances, (still, "degC", "disturbance"))
    log = make_log(
        np.arange(float(pwm.size)), columns | dict.fromkeys(model.outputs, (still, "degC", "output"))
    )
    log.attrs |= attrs
    return log


def test_a_driver_drops_fractions_towards_nought_either_way():
    made = prior_plant(load_network("peltier_chamber"))
    pwm = np.array([-0.6, -18.6, -18.0, 18.6, -200.999] + [5.0] * 12)
    (found,) = cut_stretches(made, chamber(pwm))
    assert found.u[:5, 0].tolist() == [0.0, -18.0, -18.0, 18.0, -200.0]
    (mean,) = cut_stretches(made, chamber(pwm, averaged_s=2.0))
    np.testing.assert_allclose(mean.u[:5, 0], [-0.1, -18.1, -17.5, 18.1, -200.499])


def test_a_stretch_behind_a_gap_has_the_inputs_of_its_own_rows():
    t = 2.0 * np.arange(200)
    q = np.sin(t / 20.0)
    made = plant()
    rows = kept(t, (101.0, 139.0))
    first, second = cut_stretches(made, log_of(t, 25.0, q).isel(time=rows))
    np.testing.assert_allclose(first.u[:, 0], q[:50])
    np.testing.assert_allclose(second.u[:, 0], q[70:199])  # the last row has no step of its own
    assert (first.rows, second.rows) == (slice(0, 51), slice(51, 181))


def test_the_last_step_is_whole_and_ends_at_or_behind_the_last_row():
    made = plant()
    for last, steps in ((20.0, 10), (20.5, 11), (21.9, 11), (22.0, 11)):
        t = np.append(np.arange(0.0, 20.0), last)
        (found,) = cut_stretches(made, log_of(t, 25.0))
        assert len(found.u) == len(found.d) == steps


@pytest.mark.parametrize("middle", [11.0, 59.0, 151.0])
def test_the_mean_of_a_room_ends_where_its_log_does(middle: float):
    made = plant()
    t = np.arange(0.0, 161.0)
    room = 20.0 + 0.01 * t**1.5 + np.where(t > 6.0, 1.0, 0.0)
    (found,) = cut_stretches(made, log_of(t, 25.0, room=room))
    fine = np.arange(0.005, 160.0, 0.01)
    held = room[fine.astype(int)]
    for at in (1.0, 5.0, middle, 159.0):
        about = (fine > max(at - 10.0, 0.0)) & (fine < min(at + 10.0, 160.0))
        assert found.d[round((at - 1.0) / 2.0), 0] == pytest.approx(held[about].mean(), abs=1e-6)


@pytest.mark.parametrize(("seconds", "dt", "window"), [(8.0, 2.0, 8.0), (0.0, 2.0, 2.0), (20.0, 40.0, 40.0)])
def test_a_model_may_say_over_how_long_a_room_is_averaged_and_a_step_is_the_least(
    seconds: float, dt: float, window: float
):
    class Own(StateSpaceModel):
        smooth = seconds

    model = Own(
        ("q",), ("t_room",), ("a", "b"), A=A, B=B[:, None], E=E[:, None], c=-25.0 * E, C=C,
        dt=dt, y0=[25.0, 25.0], spread=SPREAD,
    )  # fmt: skip
    made = Plant(model, {}, dt=dt, units=plant().units)
    t = np.arange(0.0, 401.0)
    room = 20.0 + np.where(t >= 200.0, 4.0, 0.0)
    (found,) = cut_stretches(made, log_of(t, 25.0, room=room))
    at = dt * (np.arange(len(found.d)) + 0.5)
    np.testing.assert_allclose(
        found.d[:, 0], 20.0 + 4.0 * np.clip((at + window / 2 - 200.0) / window, 0.0, 1.0), atol=1e-9
    )


def test_the_last_row_reads_the_end_of_the_last_step():
    (found,) = cut_stretches(plant(), log_of(2.0 * np.arange(6), 25.0))
    run = np.arange(6.0)[None, :, None] ** 2
    np.testing.assert_allclose(at_rows(found, run, 2.0)[0, :, 0], np.arange(6.0) ** 2)


def test_a_batch_of_parameters_ends_where_each_member_alone_does():
    made = prior_plant(load_network("gripper"))
    t = np.arange(0.0, 300.0, 0.5)
    drive = np.where(t < 100.0, 0.6, -0.3)
    signals = {
        "drive": (drive, "1", "input"), "pump": (np.ones(t.size), "1", "input"),
        "t_ambient": (np.full(t.size, 25.0), "degC", "disturbance"),
        "t_tank": (25.0 + t / 30, "degC", "output"), "t_surface": (25.5 + t / 40, "degC", "output"),
    }  # fmt: skip
    log = make_log(t, signals).isel(time=kept(t, (150.0, 190.0)))
    stretches = cut_stretches(made, log)
    starts = find_starts(made, made.p, stretches, 5.0)
    more = made.p * (1 + 0.1 * np.random.default_rng(0).uniform(-1, 1, (2, made.p.size)))
    both = predict(made.model, made.dt, np.vstack([made.p, more]), stretches, starts)
    _, alone = predict(made.model, made.dt, made.p[None], stretches, starts)
    np.testing.assert_allclose(both[1][0], alone[0], atol=1e-9)
