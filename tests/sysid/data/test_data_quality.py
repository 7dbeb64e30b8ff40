"""Each check of the data finds the fault that was planted, and stays silent without it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from thermogrip.datasets.examples import load_example_logs
from thermogrip.datasets.schema import make_log
from thermogrip.sysid.data.data_quality import check_data, evidence
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.models.network import load_network


def plant_log(n=2000, *, seed=0, noise=0.02, level=25.0, name="a", drift=0.0, q=None, time=None):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.random(n // 25) - 0.5, 25) if q is None else q
    y = level + drift * np.arange(n) / n + lfilter([0, 0.5], [1, -0.95], u) + noise * rng.standard_normal(n)
    t = np.arange(float(n)) if time is None else time
    return make_log(t, {"q": (u, "1", "input"), "t": (y, "degC", "output")}, name=name)


def one(logs, check, **how):
    found = check_data(logs, average=1.0, **how).of(check)
    return max(found, key=lambda f: {"ok": 0, "warn": 1, "fail": 2}[f.verdict])


def test_a_clean_log_is_ok_throughout():
    assert check_data([plant_log()], average=1.0).verdict == "ok"


def test_jitter_gap_and_lost_readings_are_found():
    rng = np.random.default_rng(1)
    time = np.cumsum(1 + 0.3 * (rng.random(2000) - 0.5) * 2)
    time[1200:] += 60
    log = plant_log(time=time)
    log["t"].values[rng.random(2000) < 0.1] = np.nan
    checked = check_data([log], average=2.0)
    assert checked.of("gaps")[0].value == pytest.approx(61, abs=1.5)
    assert checked.of("gaps")[0].verdict == "warn"
    assert checked.of("jitter")[0].value == pytest.approx(0.3 / np.sqrt(3), rel=0.1)
    assert checked.of("lost")[0].value == pytest.approx(0.1, abs=0.03)


CLIPPED = np.clip(np.repeat(3 * np.random.default_rng(2).standard_normal(80), 25), -1, 1)


def coarse_log():
    log = plant_log()
    log["t"].values[:] = np.round(log["t"].values / 0.5) * 0.5
    return log


def twin_inputs():
    log = plant_log()
    log["q2"] = ("time", 2 * log["q"].values + 1, {"units": "1", "role": "input"})
    return log


@pytest.mark.parametrize(
    ("make", "check", "verdict", "says"),
    [
        (coarse_log, "quantum", "warn", "unreliable"),
        (lambda: plant_log(q=CLIPPED), "saturation", "warn", f"{100 * np.mean(np.abs(CLIPPED) == 1):.0f} %"),
        (lambda: plant_log(q=np.r_[np.zeros(1000), np.ones(1000) * 0.7]), "excitation", "warn", "too little"),
        (lambda: plant_log(q=np.full(2000, 0.3)), "excitation", "fail", "never moves"),
        (twin_inputs, "excitation", "fail", "separated"),
    ],
)
def test_a_fault_is_found_with_its_consequence(make, check, verdict, says):
    found = one([make()], check)
    assert found.verdict == verdict
    assert says in found.says


def test_a_controller_in_the_loop_is_found():
    rng = np.random.default_rng(3)
    n = 2000
    target = np.repeat(rng.random(n // 100), 100)
    u, y = np.zeros(n), np.zeros(n)
    for k in range(n):
        y[k] = (0.95 * y[k - 1] + 0.05 * u[k - 1] if k else 0) + 0.02 * rng.standard_normal()
        u[k] = 2.0 * (target[k] - y[k])
    log = make_log(np.arange(float(n)), {"q": (u, "V", "input"), "t": (y, "degC", "output")})
    found = one([log], "feedback")
    assert found.verdict == "warn"
    assert "closed loop" in found.says


def test_open_loop_logs_are_not_accused_of_feedback():
    accused = sum(one([plant_log(seed=s)], "feedback").verdict == "warn" for s in range(20))
    assert accused == 0  # the test asks for p < 1e-4: 20 logs give 0.002 false alarms


def test_levels_that_are_held_in_open_loop_are_not_accused_of_feedback():
    # the output settles under each level and so shows when the next one is due
    for seed in range(4):
        rng = np.random.default_rng(seed)
        u = np.repeat(rng.choice([0.0, 0.3, 0.6], 60), 60)
        y = 23 + lfilter([0, 1 / 300], [1, -np.exp(-1 / 300)], u) * 40 + 0.05 * rng.standard_normal(u.size)
        log = make_log(np.arange(float(u.size)), {"q": (u, "1", "input"), "t": (y, "degC", "output")})
        (found,) = check_data([log], average=6.0).of("feedback")
        assert found.verdict == "ok"


def test_a_smooth_input_in_open_loop_is_not_accused_of_feedback():
    t = np.arange(1000)
    phases = np.random.default_rng(0).uniform(0, 2 * np.pi, 12)
    u = np.sum([np.sin(2 * np.pi * k * t / 400 + phase) for k, phase in enumerate(phases, 1)], axis=0)
    noisy = u + 1e-3 * np.random.default_rng(1).standard_normal(1000)
    assert one([plant_log(1000, q=noisy, noise=0.0)], "feedback").verdict == "ok"


def test_drift_within_a_log_and_a_shift_between_logs_are_found():
    assert one([plant_log(drift=12.0)], "drift").verdict == "warn"
    logs = [plant_log(seed=1, name="a"), plant_log(seed=2, name="b", level=35.0)]
    found = one(logs, "shift between logs")
    assert found.verdict == "warn"
    assert found.value == pytest.approx(10, abs=1.0)
    same = [plant_log(seed=1, name="a"), plant_log(seed=2, name="b")]
    assert one(same, "shift between logs").verdict == "ok"


def test_a_drift_says_which_stretch_it_is_of_where_a_gap_leaves_two():
    time = np.arange(2000.0) + np.where(np.arange(2000) < 1200, 0.0, 60.0)
    whole = check_data([plant_log(drift=12.0)], average=1.0).of("drift")
    cut = check_data([plant_log(drift=12.0, time=time)], average=1.0).of("drift")
    assert [finding.says.split(" between ")[1] for finding in whole] == [
        "the halves beyond what a static fit says"
    ]
    assert [finding.says.split(" between ")[1].split(" beyond")[0] for finding in cut] == [
        "the halves of 0 to 1199 s",
        "the halves of 1260 to 2059 s",
    ]


# ---- what a plant rests on ----


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


def test_a_pump_that_never_stops_is_reported(gripper):
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


def test_rows_of_an_hour_are_no_gaps(gripper):
    log = load_example_logs()["step_up_down"].isel(time=slice(0, 200))
    signals = {name: (log[name].values, log[name].attrs["units"], log[name].attrs["role"]) for name in log}
    time = 3600.0 * np.arange(200)
    assert evidence(gripper, [make_log(time, signals)]).total == pytest.approx(200 * 60)
    time[100:] += 6 * 3600.0  # a step of seven hours counts as five
    assert evidence(gripper, [make_log(time, signals)]).total == pytest.approx(204 * 60)


def test_an_input_of_one_sign_is_described_by_its_halves():
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
