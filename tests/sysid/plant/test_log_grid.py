"""Logs on a grid: which holes are bridged, where pieces end, what a driver makes of its commands."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, make_log
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.models.initial_state import StartPrior, estimate_starts
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.log_grid import (
    Segment,
    at_rows,
    bridge,
    choose_step,
    cut_stretches,
    make_grid,
    signals,
    switches_of,
    whole_readings,
)

T = np.arange(200.0)


def log_of(y: Any, q: Any = None, t: np.ndarray = T, **more: Any) -> Log:
    u = (np.arange(t.size) // 20 % 2).astype(float) if q is None else q
    return make_log(t, {"q": (u, "1", "input"), "t": (y, "degC", "output")} | more)


@pytest.mark.parametrize(("hole", "filled"), [(1, True), (5, True), (6, False)])
def test_holes_of_up_to_five_rows_are_bridged(hole: int, filled: bool):
    y = 2.0 * np.arange(20.0)[:, None]
    broken = y.copy()
    broken[7 : 7 + hole] = broken[:2] = np.nan
    found = bridge(broken)
    assert np.isnan(found[:2]).all()  # before the first reading there is no line
    np.testing.assert_array_equal(found[7 : 7 + hole], y[7 : 7 + hole] if filled else broken[7 : 7 + hole])


@pytest.mark.parametrize(("every", "filled"), [(8, False), (5, True)])
def test_readings_are_bridged_where_most_windows_are_broken(every: int, filled: bool):
    """One in eight lost leaves 5 of 8 windows of three rows whole in a row of them, one in five 2 of 5."""
    y = np.arange(200.0)[:, None]
    y[every // 2 :: every] = np.nan
    none = np.zeros((200, 0))
    (found,) = whole_readings([Segment(T, y, none, none, "a")], 3)
    assert np.isfinite(found[5:-5]).all() == filled


def test_a_grid_ends_with_the_last_whole_row_and_begins_with_the_first_reading():
    y = T**2
    grid = make_grid([log_of(y)], average=4.0)
    (part,) = grid.segments
    assert part.time.tolist() == (4.0 * np.arange(50)).tolist()
    # a mean over two seconds to either side of the line through t^2 is (0 + 1 + 1 + 4 ...) / 4 above it
    np.testing.assert_allclose(part.y[1:-1, 0], (4.0 * np.arange(1, 49)) ** 2 + 1.5)
    assert part.y[0, 0] == 0.0
    with pytest.raises(UserError, match=r"averaging over 0.9 s is shorter than the sample time 1 s"):
        make_grid([log_of(y)], average=0.9)


def test_a_bin_without_a_reading_is_lost_and_counted():
    y = T.copy()
    y[41:60] = np.nan
    other = np.where(T % 50 == 3, np.nan, T)
    grid = make_grid([log_of(y, t2=(other, "degC", "output"))], average=4.0)
    lost = np.isnan(grid.segments[0].y)
    assert lost[:, 0].tolist() == [44 <= t <= 56 for t in grid.segments[0].time]
    assert grid.lost == pytest.approx(4 / 50)
    fine = make_grid([log_of(y, t2=(other, "degC", "output"))], average=1.0)
    assert fine.lost == pytest.approx((19 + 3) / 200)  # rows of which any sensor is missing; one in both


def test_switches_are_shares_that_are_nought_or_one():
    on = (T > 50).astype(float)
    log = log_of(T, on, p=(on, "percent", "input"), half=(0.5 * on, "1", "input"))
    assert switches_of([log], ["q", "p", "half"]) == ("q",)


def test_what_is_asked_for_as_an_output_is_no_disturbance_besides():
    log = log_of(T, room=(T, "degC", "disturbance"))
    assert signals([log], outputs=["t", "room"]) == (("q",), ("t", "room"), ())
    with pytest.raises(UserError, match="reads 20 whenever it reads"):
        signals([log_of(np.full(200, 20.0))])


def test_a_step_is_a_hundredth_of_the_time_constant_as_long_as_two_hundred_rows_are_left():
    rng = np.random.default_rng(0)

    def lag(tau: float, n: int, dt: float) -> Log:
        q = np.repeat(rng.random(n // 200 + 1), 200)[:n]
        y, x = np.zeros(n), 0.0
        for k in range(n):
            y[k] = x
            x += (1 - np.exp(-dt / tau)) * (q[k] - x)
        return log_of(y, q, dt * np.arange(n))

    step = choose_step([lag(400.0, 16_000, 1.0)], inputs=["q"], outputs=["t"])
    assert 3.0 <= step <= 6.0
    assert choose_step([lag(400.0, 400, 1.0)], inputs=["q"], outputs=["t"]) <= 2.0


# ---- the grid of a free run ----


def chamber(pwm: Any, t: np.ndarray, **attrs: Any) -> Log:
    still = np.full(t.size, 22.0)
    model = load_network("peltier_chamber")
    columns = {"pwm": (pwm, "0_255", "input")}
    columns |= dict.fromkeys(model.disturbances, (still, "degC", "disturbance"))
    columns |= dict.fromkeys(model.outputs, (still, "degC", "output"))
    log = make_log(t, columns)
    log.attrs |= attrs
    return log


def test_a_driver_drops_what_lies_behind_its_step():
    plant, t = prior_plant(load_network("peltier_chamber")), np.arange(0.0, 20.0)
    assert plant.dt == 1.0
    pwm = np.array([0.0, 0.3, 17.99, 18.0, 18.6, 200.999, 3 * 0.1 * 10, 54.99999999999999] + [5.0] * 12)
    (found,) = cut_stretches(plant, chamber(pwm, t))
    assert found.u[:8, 0].tolist() == [0.0, 0.0, 17.0, 18.0, 18.0, 200.0, 3.0, 55.0]
    (mean,) = cut_stretches(plant, chamber(pwm, t, averaged_s=2.0))  # half a step is lost on average
    np.testing.assert_allclose(mean.u[:6, 0], [0.0, 0.0, 17.49, 17.5, 18.1, 200.499])
    np.testing.assert_allclose(mean.time, t + 1.0)  # the middle of what a row is the mean of


def test_a_measured_ambient_is_the_mean_over_twenty_seconds():
    plant, t = prior_plant(load_network("gripper")), np.arange(0.0, 120.0, 0.5)
    room = np.where(t < 60.0, 20.0, 24.0)
    still = np.full(t.size, 22.0)
    columns = {"drive": (0 * t, "1", "input"), "pump": (0 * t + 1, "1", "input")}
    columns |= {"t_ambient": (room, "degC", "disturbance")}
    columns |= dict.fromkeys(plant.outputs, (still, "degC", "output"))
    (found,) = cut_stretches(plant, make_log(t, columns))
    middle = plant.dt * (np.arange(len(found.d)) + 0.5)
    want = 20.0 + 4.0 * np.clip((middle + 10.0 - 60.0) / 20.0, 0.0, 1.0)
    inner = (middle > 10) & (middle < 109)
    np.testing.assert_allclose(found.d[inner, 0], want[inner], atol=1e-9)
    np.testing.assert_allclose(found.d[~inner & (middle < 60), 0], 20.0)


def test_rows_between_steps_are_on_the_line_between_them():
    plant, t = prior_plant(load_network("peltier_chamber")), np.array([0.0, 1.5, 2.5, 7.0, 30.0, 31.0, 33.0])
    log = chamber(np.zeros(7), t)
    first, second = cut_stretches(plant, log)
    assert (first.gap, second.gap) == (0.0, 23.0)
    run = np.arange(0.0, 12.0)[None, :, None] ** 2  # at 0, 2, 4 ... s
    np.testing.assert_allclose(at_rows(first, run, 2.0)[0, :, 0], [0.0, 0.75, 1.75, 9 + 0.5 * 7])


# ---- the start of a black box ----


@pytest.mark.parametrize(("noise", "nuisance"), [(0.1, 0.0), (0.3, 0.5), (0.05, 2.0)])
def test_a_start_is_ridge_regression_on_state_and_offsets(noise: float, nuisance: float):
    rng = np.random.default_rng(2)
    A, B, C = (
        np.array([[0.9, 0.05], [0.1, 0.8]]),
        np.array([[0.4], [0.1]]),
        np.array([[1.0, 0.0], [0.3, 1.0]]),
    )
    spread, scale = np.array([[2.0, 0.5], [0.5, 1.0]]), np.array([3.0, 0.5])
    model = StateSpaceModel(("q",), (), ("a", "b"), A=A, B=B, C=C, dt=1.0, y0=[20.0, 30.0], spread=spread)
    u, y = rng.random((15, 1)), np.array([20.0, 30.0]) + rng.normal(size=(15, 2))
    y[0, 1] = y[4] = np.nan
    priors = [StartPrior(noise, nuisance), StartPrior(0.2, 0.0)]
    x0, offset = estimate_starts(model, y, u, np.zeros((15, 0)), dt=1.0, scale=scale, priors=priors)

    rest = model.rest([y[0, 0], y[1, 1]], u.mean(axis=0), [], ())
    free = model.rollout(rest[None], u[None], np.zeros((1, 15, 0)), (), 1.0)[0][0]
    rows, right = [], []
    for k in range(15):
        for j in (0, 1):
            if np.isfinite(y[k, j]):
                by = np.append((C @ np.linalg.matrix_power(A, k))[j], np.eye(2)[j])
                rows.append(by / (noise * scale[j]))
                right.append((y[k, j] - free[k, j]) / (noise * scale[j]))
    state = np.linalg.cholesky(np.linalg.inv(spread)).T
    rows += [*np.hstack([state, np.zeros((2, 2))])]
    keep = 4 if nuisance else 2  # without a spread of their own there are no offsets
    rows += [np.append([0.0, 0.0], e / (nuisance * scale)) for e in np.eye(2)] if nuisance else []
    right += [0.0] * (keep if nuisance else 2)
    want = np.linalg.lstsq(np.array(rows)[:, :keep], np.array(right), rcond=None)[0]
    np.testing.assert_allclose(x0[0], rest + want[:2], atol=1e-6)
    np.testing.assert_allclose(offset[0], want[2:] if nuisance else [0.0, 0.0], atol=1e-6)
    assert offset[1].tolist() == [0.0, 0.0]
