import numpy as np
import pytest

from thermogrip.datasets.examples import load_example_logs
from thermogrip.datasets.schema import make_log
from thermogrip.sysid.data.data_quality import evidence
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.models.network import load_network


@pytest.fixture
def gripper():
    return prior_plant(load_network("gripper"))


def test_minutes_of_heating_and_cooling_are_those_of_the_columns(gripper):
    log = load_example_logs()["step_up_down"]
    seen = evidence(gripper, [log])
    drive, time = log["drive"].values, log["time"].values
    cooling = np.sum(np.diff(time)[drive[:-1] < -0.05 * np.abs(drive).max()]) / 60
    assert seen.minutes["drive < 0"] == pytest.approx(cooling, abs=0.05)
    assert seen.total == pytest.approx((time[-1] - time[0]) / 60, rel=0.01)


def test_a_pump_that_never_stops_is_said(gripper):
    seen = evidence(gripper, [load_example_logs()["step_up_down"]])
    assert "pump off" in seen.thin
    assert "pump off never occurs" in seen.sentence(gripper.units)
    both = evidence(gripper, list(load_example_logs().values()))
    assert both.minutes["pump off"] > 5


def test_a_gap_does_not_count_as_minutes(gripper):
    time = np.append(np.arange(0.0, 600.0), np.arange(3600.0, 4200.0))
    log = load_example_logs()["step_up_down"].isel(time=slice(0, time.size))
    signals = {name: (log[name].values, log[name].attrs["units"], log[name].attrs["role"]) for name in log}
    assert evidence(gripper, [make_log(time, signals)]).total == pytest.approx(20.0, abs=0.3)


def test_an_input_of_one_sign_is_told_by_its_halves():
    plant = prior_plant(load_network("tclab"))
    t = np.arange(0.0, 3600.0)
    signals = {
        "q1": (np.where(t < 60, 80.0, 20.0), "percent", "input"),
        "q2": (np.where(t < 1800, 80.0, 20.0), "percent", "input"),
        "t1": (t / 100, "degC", "output"),
        "t2": (t / 100, "degC", "output"),
    }
    seen = evidence(plant, [make_log(t, signals)])
    assert seen.thin == ("q1 above 50",)
    assert seen.ranges["t1"] == pytest.approx((0.36, 35.63), abs=0.01)
    assert "the logs cover t1 between 0.36 and 35.6 degC, t2" in seen.sentence({"t1": "degC", "t2": "1"})
    # no unit, no "1"
    assert seen.sentence({"t1": "degC", "t2": "1"}).split(";")[0].endswith("35.6 (98 % of the readings)")
