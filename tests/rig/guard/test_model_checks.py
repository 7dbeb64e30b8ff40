"""A rig beside its model: what is an alarm, how it is explained, and what is no alarm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple

import numpy as np
import pytest

from tests.rig.fault_injection.drills import drill_plants
from tests.rig.makers import follow
from thermogrip.rig.guard.model_checks import ModelMonitor, Residual
from thermogrip.rig.simulation.twin import Twin
from thermogrip.sysid.contact.simulation import Grip
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant


class Followed:
    """A twin and its monitor."""

    def __init__(self, plant: Plant, seed: int = 0, *, real: Plant | None = None, **twin: float) -> None:
        self.rig = Twin(real or plant, seed=seed, contact=Grip(), **twin)
        self.monitor = ModelMonitor(plant)
        self.start()

    def start(self) -> None:
        self.monitor.reset(self.rig.time, self.rig.read().values)

    def drive(
        self,
        drive: float,
        seconds: float,
        *,
        real: float | None = None,
        pump: int = 1,
        error: Callable[[float], dict[str, float]] = lambda t: {},
    ) -> float:
        """Ask for a drive; return when there is an alarm (infinity: none).

        The rig may get another drive or no pump, and its sensors may be off by ``error`` after t seconds.
        """
        rig, begin = self.rig, self.rig.time
        while rig.time - begin < seconds:
            rig.apply({"drive": drive if real is None else real}, pump)
            rig.wait(1.0)
            off = error(rig.time - begin)
            values = {name: value + off.get(name, 0.0) for name, value in rig.read().values.items()}
            if follow(self.monitor, rig.time, {"drive": drive}, values):
                return rig.time - begin
        return np.inf


def test_a_rig_that_follows_its_model_is_left_alone(plant: Plant) -> None:
    followed = Followed(plant)
    for drive in (0.8, -0.6, 0.0, 1.0, -1.0):
        assert followed.drive(drive, 120.0) == np.inf


@pytest.mark.parametrize(("drive", "real"), [(0.8, 0.0), (-0.8, 0.0), (0.0, 1.0), (0.0, -1.0), (0.6, -0.6)])
def test_a_driver_that_does_something_else_is_found_for_heating_and_cooling(
    plant: Plant, drive: float, real: float
) -> None:
    followed = Followed(plant)
    assert followed.drive(drive, 30.0) == np.inf
    assert followed.drive(drive, 60.0, real=real) <= 14.0


@pytest.mark.parametrize("name", ["t_tank", "t_surface"])
def test_a_sensor_that_is_wrong_alone_is_found(plant: Plant, name: str) -> None:
    followed = Followed(plant)
    followed.drive(0.5, 40.0)
    assert followed.drive(0.5, 60.0, error=lambda t: {name: 0.15 * t}) <= 15.0


def test_a_pump_that_stands_still_is_found(plant: Plant) -> None:
    followed = Followed(plant)
    followed.drive(0.8, 40.0)
    assert followed.drive(0.8, 60.0, pump=0) <= 30.0


def test_a_drift_that_the_filter_follows_ends_at_the_bias_limit(plant: Plant) -> None:
    followed = Followed(plant)
    followed.drive(0.3, 200.0)
    at = followed.drive(0.3, 1000.0, error=lambda t: {"t_surface": 0.005 * t})
    assert at < 700.0  # 2 K at 5 mK/s is 400 s


def test_two_sensors_that_drift_together_end_where_no_drive_is_so_far_off(plant: Plant) -> None:
    """Both read 1 K less every two minutes; to the model the drive gives less and less."""
    followed = Followed(plant)
    assert followed.drive(0.15, 300.0) == np.inf
    at = followed.drive(0.15, 1200.0, error=lambda t: dict.fromkeys(("t_tank", "t_surface"), -t / 120))
    assert 240.0 < at < 1200.0  # no sooner than 2 K
    [alarm] = followed.monitor._biases(followed.rig.time)
    assert (alarm.subject, alarm.measured < -alarm.allowed) == ("drive", True)


def test_a_sensor_that_the_rig_has_not_makes_nothing_less_known(plant: Plant) -> None:
    """The guard names both sensors that a skin may have; what is known after a touch is the same."""
    spreads = []
    for masked in ({"t_surface"}, {"t_surface", "t_surface_2"}, {"t_surface_2"}):
        followed = Followed(plant)
        followed.drive(0.3, 60.0)
        monitor, now = followed.monitor, followed.rig.time + 1.0
        monitor.predict(now, {"drive": 0.3}, 1, {})
        monitor.update(now, {}, frozenset(masked))
        monitor.update(now, {})
        spreads.append(monitor._filter.spread())
    touched, with_a_second, never = spreads
    assert with_a_second.tolist() == touched.tolist()
    assert never[1] < 0.5 * touched[1]


def test_a_rig_that_stood_with_a_warm_tank_is_not_taken_for_one_at_rest() -> None:
    known, real = drill_plants()
    followed = Followed(known, real=real, t_start=25.0)
    rig = followed.rig
    while rig.truth()["t_tank"] < 26.8:
        rig.apply({"drive": 0.3}, 0)
        rig.wait(1.0)
    rig.apply({"drive": 0.0}, 0)
    rig.wait(30.0)
    assert rig.truth()["t_tank"] - rig.truth()["t_surface"] > 1.0
    followed.start()
    for drive in (0.8, -0.4):
        assert followed.drive(drive, 150.0) == np.inf


# ---- what a window compares, in numbers ----


def integrator(outputs: tuple[str, ...] = ("a",), *, pump: bool = False) -> Plant:
    """Return what warms by 0.1 K/s at full drive for ever, with one state that every sensor reads."""
    n = len(outputs)
    inputs, switches = (("q", "pump"), ("pump",)) if pump else (("q",), ())
    model = StateSpaceModel(
        inputs, (), outputs, A=[[1.0]], B=[[0.1, 0.0][: len(inputs)]], C=np.ones((n, 1)), dt=1.0,
        y0=[0.0] * n, switches=switches, A_switch={"pump": np.zeros((1, 1))} if pump else {},
    )  # fmt: skip
    return Plant(model, {}, dt=1.0, units=dict.fromkeys(inputs, "1"))


def driven(made: ModelMonitor, rate: float, until: int, *, pump_off: int = 0) -> list[Residual]:
    """Rest for 100 s, then ask for full drive while a rises by ``rate`` K/s; return the last alarms."""
    found = []
    for k in range(1, until + 1):
        made.predict(float(k), {"q": float(k > 100)}, int(k != pump_off), {})
        found = made.update(float(k), {"a": rate * max(k - 100, 0)})
    return found


def test_a_window_compares_the_last_three_seconds_with_where_the_drive_leads() -> None:
    """At 110 s the model is at 0.8, 0.9 and 1.0 K; the rig came to half of that, and the swing is 1 K."""
    made = ModelMonitor(integrator(pump=True))
    made.reset(0.0, {"a": 0.0})
    found = driven(made, 0.05, 110, pump_off=90)
    allowed = {10.0: 0.8, 30.0: 0.35 + 0.5 + 0.25, 90.0: 0.45 + 0.5 + 0.25}  # the pump was off at 90 s
    both = (pytest.approx(0.9), pytest.approx(0.45))
    want = [("window", "a", w, *both, pytest.approx(x)) for w, x in allowed.items()]
    assert [astuple(one) for one in made.compare()] == want
    assert found == []
    assert Residual("bias", "a", 0.0, 0.0, -3.0, 2.0).excess == 1.5


@pytest.mark.parametrize(("period", "windows"), [(49.0, [10.0, 30.0, 90.0]), (33.0, [10.0, 30.0])])
def test_a_window_begins_at_a_reading_up_to_eight_steps_earlier(period: float, windows: list[float]) -> None:
    made = ModelMonitor(integrator())
    made.reset(0.0, {"a": 0.0})
    for k in range(1, 51):
        follow(made, period * k, {"q": 0.0}, {"a": 0.0})
    assert [one.window for one in made.compare()] == windows


def test_after_a_touch_a_sensors_windows_and_jumps_start_afresh() -> None:
    made = ModelMonitor(integrator(("a", "b")))
    made.reset(0.0, {"a": 0.0, "b": 0.0})
    assert (made.compared_from, made.is_jump("b", 50.0), made.is_jump("c", 50.0)) == (0.0, True, False)
    for k in range(1, 71):
        made.predict(float(k), {"q": 0.0}, 1, {})
        made.update(float(k), {"a": 0.0, "b": 9.0 * (50 <= k < 60)}, frozenset("b" if 50 <= k < 60 else ""))
        assert made.is_jump("b", 50.0) == (not 50 <= k < 60)
        if k in (58, 69, 70):
            subjects = [(one.window, one.subject) for one in made.compare()]
            assert subjects == [(10.0, "a"), *[(10.0, "b")] * (k == 70), (30.0, "a")]
        if k == 69:
            made.predict(69.5, {"q": 0.0}, 1, {})
            assert made.update(69.5, {"a": 50.0, "b": 50.0}) == []  # the model has made no step
            assert not made.compared_now
            made._filter.estimates.pop()
    made.reset(5.0, {"a": 0.0, "b": 3.0})  # no rest: a warm-up of a minute
    assert made.compared_from == 65.0
    assert not made.is_jump("b", 50.0)


@pytest.mark.parametrize(
    ("time", "b", "w", "since", "want"),
    [(60.0, 2.01, 0.0, 59.0, [Residual("bias", "b", 0.0, 0.0, 2.01, 2.0)]), (59.9, 2.01, 0.26, 59.0, []),
     (60.0, -2.0, 0.149, 59.0, []), (60.0, -2.1, 0.0, 60.0, []),
     (60.0, -2.1, -0.151, 59.0,
      [Residual("bias", "b", 0.0, 0.0, -2.1, 2.0), Residual("bias", "q", 0.0, 0.0, -0.151, 0.15)])],
)  # fmt: skip
def test_a_bias_beyond_its_limit_is_an_alarm_after_a_minute(
    time: float, b: float, w: float, since: float, want: list[Residual]
) -> None:
    """A drive's: 15 % of the 0.6 that were asked for, and five times its 0.024 in the filter."""
    made = ModelMonitor(integrator(("a", "b")))
    made.reset(0.0, {"a": 0.0, "b": 0.0})
    for until, drive in ((20.0, -0.6), (59.0, 0.1)):
        made.predict(until, {"q": drive}, 1, {})
    n = made._filter.x.size
    made._filter._P[n, n] = 0.024**2
    made._filter.b[:], made._filter.w[:], made._since[:] = (9.0, b), w, since  # the reference has no bias
    found = made._biases(time)
    assert [(*astuple(one)[:-1], pytest.approx(one.allowed)) for one in want] == list(map(astuple, found))
