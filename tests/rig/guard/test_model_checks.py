"""A rig beside its model: what is an alarm, how it is explained, and what is no alarm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.rig.fault_injection.drills import drill_plants
from thermogrip.rig.guard.model_checks import ModelMonitor
from thermogrip.rig.simulation.twin import Twin
from thermogrip.sysid.contact.simulation import Grip
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
    ) -> tuple[float, str]:
        """Ask for a drive; return when there is an alarm (infinity: none) and its explanation.

        The rig may get another drive or no pump, and its sensors may be off by ``error`` after t seconds.
        """
        rig, begin = self.rig, self.rig.time
        while rig.time - begin < seconds:
            rig.apply({"drive": drive if real is None else real}, pump)
            rig.wait(1.0)
            off = error(rig.time - begin)
            values = {name: value + off.get(name, 0.0) for name, value in rig.read().values.items()}
            if found := self.monitor.follow(rig.time, {"drive": drive}, 1, values):
                return rig.time - begin, ", or ".join(c.text for c in self.monitor.explain(found[0]))
        return np.inf, ""


@pytest.mark.parametrize("seed", range(3))
def test_a_rig_that_follows_its_model_is_left_alone(plant: Plant, seed: int) -> None:
    followed = Followed(plant, seed)
    for drive in (0.8, -0.6, 0.0, 1.0, -1.0):
        assert followed.drive(drive, 120.0)[0] == np.inf


@pytest.mark.parametrize(("drive", "real"), [(0.8, 0.0), (-0.8, 0.0), (0.0, 1.0), (0.0, -1.0), (0.6, -0.6)])
def test_a_driver_that_does_something_else_is_found_for_heating_and_cooling(
    plant: Plant, drive: float, real: float
) -> None:
    followed = Followed(plant)
    assert followed.drive(drive, 30.0)[0] == np.inf
    at, because = followed.drive(drive, 60.0, real=real)
    assert at <= 14.0
    assert "driver" in because or "wrong way" in because


def test_a_pump_that_stands_still_is_distinguished_from_a_driver(plant: Plant) -> None:
    followed = Followed(plant)
    followed.drive(0.8, 40.0)
    assert followed.drive(0.8, 60.0, pump=0)[1].startswith("the pump stands still")


@pytest.mark.parametrize("name", ["t_tank", "t_surface"])
def test_a_sensor_that_is_wrong_alone_is_distinguished_from_a_plant_that_changes(
    plant: Plant, name: str
) -> None:
    followed = Followed(plant)
    followed.drive(0.5, 40.0)
    at, because = followed.drive(0.5, 60.0, error=lambda t: {name: 0.15 * t})
    assert at <= 15.0
    assert f"{name} alone is wrong" in because  # a driver that gives more looks alike for a while


def test_a_drift_that_the_filter_follows_ends_at_the_bias_limit(plant: Plant) -> None:
    followed = Followed(plant)
    followed.drive(0.3, 200.0)
    at, _ = followed.drive(0.3, 1000.0, error=lambda t: {"t_surface": 0.005 * t})
    assert at < 700.0  # 2 K at 5 mK/s is 400 s


def test_a_spike_is_suspect_and_noise_is_not(plant: Plant) -> None:
    followed = Followed(plant)
    followed.drive(0.3, 60.0)
    monitor = followed.monitor
    monitor.predict(followed.rig.time + 1.0, {"drive": 0.3}, 1, {})
    expected = monitor.expected()["t_surface"]
    assert monitor.is_jump("t_surface", expected + 4.0)
    assert not monitor.is_jump("t_surface", expected + 0.3)


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
        spreads.append(monitor.spread())
    touched, with_a_second, never = spreads
    assert with_a_second == touched
    assert never["t_surface"] < 0.5 * touched["t_surface"]


def test_a_peltier_past_its_optimum_is_noticed_by_the_model() -> None:
    """Q = S T I - R I^2 / 2 - K dT turns over at I = S T / R; the bundled network, 5 R."""
    known = drill_plants()[0]
    turned = replace(known, values={**known.values, "resistance": 20.0})
    for plant, drive, past in ((known, -1.0, False), (turned, -1.0, True), (turned, -0.1, False)):
        monitor = ModelMonitor(plant)
        monitor.reset(0.0, {"t_tank": 25.0, "t_surface": 25.0, "t_ambient": 25.0})
        for k in range(1, 30):
            monitor.predict(float(k), {"drive": drive}, 1, {"t_ambient": 25.0})
        assert bool(monitor.past_optimum()) == past


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
        assert followed.drive(drive, 150.0)[0] == np.inf
