"""Free runs: only the warm-up of the outputs is read, gaps are filled from data, averages are exact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.resample import average
from thermogrip.datasets.schema import Log, make_log
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.plant.log_grid import cut_stretches
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.plant.simulation import find_starts


@pytest.fixture(scope="module")
def gripper() -> Plant:
    return prior_plant(load_network("gripper"))


def as_log(
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


def truth(plant: Plant, t: np.ndarray, drive: np.ndarray) -> Log:
    """What the plant itself reads from rest at 25 degC, with offsets 0.2 (ambient) and 0.1 (surface)."""
    still = np.full(t.size, 25.0)
    run = plant.simulate(as_log(t, drive, still, still + 0.1))
    return as_log(t, drive, run["t_tank"].values, run["t_surface"].values)


def test_a_plant_reproduces_its_own_run_from_the_first_seconds(gripper: Plant):
    t = np.arange(0, 600, 0.5)
    log = truth(gripper, t, np.where(t < 10, 0.0, np.sin(t / 40)))
    again = gripper.simulate(log)
    np.testing.assert_allclose(again["t_surface"], log["t_surface"], atol=1e-2)
    assert "started at rest at 25.00" in again.attrs["notes"]


def test_outputs_after_the_warm_up_are_not_read(gripper: Plant):
    t = np.arange(0, 300, 0.5)
    log = truth(gripper, t, np.sin(t / 40))
    masked = log.copy(deep=True)
    for name in ("t_tank", "t_surface"):
        masked[name] = masked[name].where(masked["time"] <= 5.0, 99.0)
    xr.testing.assert_equal(gripper.simulate(log), gripper.simulate(masked))


def test_uneven_rows_give_the_same_run_as_even_ones(gripper: Plant):
    rng = np.random.default_rng(0)
    even = np.arange(0, 400, 0.25)
    steps = 0.8 * np.sign(np.sin(even // 20))
    keep = np.sort(np.concatenate([[0, even.size - 1], rng.choice(even.size, 900, replace=False)]))
    keep = np.unique(np.concatenate([keep, np.flatnonzero(np.diff(steps)) + 1]))  # rows where the drive moves
    log = truth(gripper, even, steps)
    run, thin = gripper.simulate(log), gripper.simulate(log.isel(time=keep))
    np.testing.assert_allclose(thin["t_tank"], run["t_tank"].values[keep], atol=2e-3)


def test_the_switch_inside_a_gap_is_found_from_the_data_after_it(gripper: Plant):
    t = np.arange(0, 900, 0.25)
    log = truth(gripper, t, np.where(t < 425.0, 0.6, -0.7))
    gap = log.isel(time=np.flatnonzero((t < 400) | (t > 440)))
    filled, held = gripper.simulate(gap), gripper.simulate(gap, gaps="hold")
    after = gap["time"].values > 445

    def rms(run: Log) -> float:
        return float(np.sqrt(np.mean((run["t_tank"].values - gap["t_tank"].values)[after] ** 2)))

    assert rms(filled) < 0.05 < rms(held)
    change = float(filled.attrs["notes"].split("changed ")[1].split(" s")[0])
    assert change == pytest.approx(25.0, abs=1.5)
    unscored = gap["time"].values[filled["scored"].values == 0]
    assert unscored[unscored > 5].min() > 440
    assert unscored.max() == pytest.approx(500.0, abs=0.5)
    assert held["scored"].values[gap["time"].values > 5].all()


def test_a_log_that_does_not_start_at_rest_is_started_from_its_warm_up(gripper: Plant):
    t = np.arange(0, 900, 0.5)
    log = truth(gripper, t, np.where(t < 300, 0.8, -0.2))
    second = log.isel(time=np.flatnonzero(t >= 280))
    run = gripper.simulate(second, warmup=30.0)
    assert "warm-up" in run.attrs["notes"]
    error = (run["t_tank"] - second["t_tank"]).values
    assert np.abs(error).max() < 1.0  # the heatsink is not seen, so some of it stays unknown
    start = find_starts(gripper, gripper.p, cut_stretches(gripper, second), 30.0)[0]
    sink = start.x0[load_network("gripper").states.index("heatsink")]
    assert sink < 25.0  # it was giving heat to the tank


def test_an_averaged_log_is_compared_at_the_middle_of_its_blocks(gripper: Plant):
    t = np.arange(0, 600, 0.5)
    log = truth(gripper, t, np.where(t < 20, 0.0, 0.7))
    coarse = average(log, 4.0)
    run = gripper.simulate(coarse, warmup=12.0)
    late = coarse["time"].values > 60
    np.testing.assert_allclose(run["t_tank"].values[late], coarse["t_tank"].values[late], atol=0.03)


def test_wrong_units_missing_signals_and_lost_channels_are_refused(gripper: Plant):
    t = np.arange(0, 60, 0.5)
    log = truth(gripper, t, np.zeros(t.size))
    volts = log.copy(deep=True)
    volts["drive"].attrs["units"] = "V"
    with pytest.raises(UserError, match="column drive: is in 'V', the plant's is in '1'"):
        gripper.simulate(volts)
    with pytest.raises(UserError, match="column pump: no such column"):
        gripper.simulate(log.drop_vars("pump"))
    with pytest.raises(UserError, match="warm-up"):
        gripper.simulate(log, warmup=0.0)


def test_a_drive_in_percent_or_counts_is_the_same_share_of_full_scale(gripper: Plant):
    t = np.arange(0, 200, 0.5)
    log = truth(gripper, t, np.full(t.size, 0.4))
    for unit, full in (("percent", 100.0), ("0_255", 255.0)):
        other = log.copy(deep=True)
        other["drive"] = ("time", full * log["drive"].values, {"units": unit, "role": "other"})
        seen = gripper.simulate(other)
        np.testing.assert_allclose(seen["t_tank"], gripper.simulate(log)["t_tank"], atol=1e-9)
        assert f"drive: converted from {unit} to 1" in seen.attrs["notes"]
        assert other["drive"].attrs["units"] == unit  # the log itself is left as it was
    bare = replace(gripper, valid=gripper.valid | {"drive": (0.0, 80.0)})  # its 1 is no share
    with pytest.raises(UserError, match="leave the unit away"):
        bare.simulate(other)


def test_a_draw_simulates_differently(gripper: Plant):
    t = np.arange(0, 200, 0.5)
    log = truth(gripper, t, np.full(t.size, 0.5))
    sure = replace(gripper, covariance=1e-2 * np.eye(len(gripper.free)))
    assert np.abs(sure.draw(1).simulate(log)["t_tank"] - log["t_tank"]).max() > 0.1
