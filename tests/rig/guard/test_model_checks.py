"""A rig beside its model: what is an alarm, how it is explained, and what is no alarm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.rig.fault_injection.drills import drill_plants
from tests.rig.makers import follow
from thermogrip.rig.guard.model_checks import Cause, ModelMonitor, _wrong_drives, by_danger, explain_window
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
            if found := follow(self.monitor, rig.time, {"drive": drive}, values):
                return rig.time - begin, ", or ".join(c.text for c in self.monitor.explain(found[0]))
        return np.inf, ""


def test_a_rig_that_follows_its_model_is_left_alone(plant: Plant) -> None:
    followed = Followed(plant)
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
    assert followed.drive(0.8, 60.0, pump=0)[1].startswith("the pump has stopped")


@pytest.mark.parametrize("name", ["t_tank", "t_surface"])
def test_a_sensor_that_is_wrong_alone_is_distinguished_from_a_plant_that_changes(
    plant: Plant, name: str
) -> None:
    followed = Followed(plant)
    followed.drive(0.5, 40.0)
    at, because = followed.drive(0.5, 60.0, error=lambda t: {name: 0.15 * t})
    assert at <= 15.0
    assert f"{name} alone is wrong" in because  # a driver that gives more is like it for a while


def test_a_drift_that_the_filter_follows_ends_at_the_bias_limit(plant: Plant) -> None:
    followed = Followed(plant)
    followed.drive(0.3, 200.0)
    at, _ = followed.drive(0.3, 1000.0, error=lambda t: {"t_surface": 0.005 * t})
    assert at < 700.0  # 2 K at 5 mK/s is 400 s


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


# ---- which fault explains a window ----

DT = 0.5
A = np.array([[1 - DT / 60, 0.0], [DT / 10, 1 - DT / 10]])
B = np.array([0.5 * DT, 0.0])


def monitor(unit: str, full: float, sensors: int, names: tuple[str, str] = ("a", "b")) -> ModelMonitor:
    model = StateSpaceModel(
        ("q",),
        (),
        names[:sensors],
        A=A,
        B=B[:, None] / full,
        C=np.eye(2)[:sensors],
        dt=DT,
        y0=[25.0] * sensors,
    )
    units = {"q": unit, **dict.fromkeys(names, "degC")}
    made = ModelMonitor(Plant(model, {}, dt=DT, units=units, valid={"q": (-1.0, 1.0)}))
    made.reset(0.0, dict.fromkeys(names, 25.0))
    return made


def explained(
    real: float | None = None,
    *,
    late: float = 0.0,
    off: float = 0.0,
    onset: float = 0.0,
    unit: str = "1",
    full: float = 1.0,
    sensors: int = 2,
) -> str:
    """Rest a minute, ask for 0.6 of full drive, and let ``real`` of it come ``onset`` seconds later."""
    made, rng = monitor(unit, full, sensors), np.random.default_rng(0)
    x, path = np.zeros(2), [np.zeros(2)]
    for k in range(1, 145):
        since = (k - 121) * DT
        asked = 0.6 if since >= 0 else 0.0
        x = A @ x + B * (asked if real is None or since < onset else real)
        path.append(x)
        y = 25.0 + x
        if since >= 0:
            y[1] = 25.0 + path[k - round(late / DT)][1] + off
        y += 0.02 * rng.standard_normal(2)
        follow(made, k * DT, {"q": asked * full}, dict(zip("ab", y[:sensors].tolist())))
    return ", or ".join(cause.text for cause in explain_window(made._model, made._past, 12.0))


STORIES = [
    ({}, ""),
    ({"real": 0.0}, "the driver gives nothing"),
    ({"real": 1.0}, "the driver is stuck at full drive"),
    ({"real": -1.0}, "the driver is stuck at full cooling"),
    ({"real": -0.6}, "the module is wired the wrong way round"),
    ({"real": 0.3}, "the driver gives half of what is asked"),
    ({"real": 0.0, "onset": 6.0}, "the driver gives nothing"),
    ({"real": -1.0, "onset": 6.0}, "the driver is stuck at full cooling"),
    ({"late": 3.0}, "b is late"),
    ({"late": 5.0}, "b is late"),
    ({"late": 8.0}, "b is late"),
    ({"off": 3.0}, "b alone is wrong"),
]


@pytest.mark.parametrize(("story", "said"), STORIES)
def test_what_happened_is_named_and_nothing_else(story: dict[str, float], said: str) -> None:
    assert explained(**story) == said


def test_a_heater_neither_cools_nor_has_a_wrong_way_round() -> None:
    assert explained(0.0, unit="percent", full=100.0) == "the driver gives nothing"


@pytest.mark.parametrize(
    ("asked", "left"),
    [(5.0, "full"), (5.1, "nothing full"), (10.0, "nothing full"), (10.1, "nothing full half"),
     (94.9, "nothing full half"), (95.0, "nothing half")],
)  # fmt: skip
def test_a_fault_that_changes_at_most_a_twentieth_of_the_drive_is_no_hypothesis(
    asked: float, left: str
) -> None:
    found = _wrong_drives(monitor("percent", 100.0, 2)._model, np.full((4, 1), asked))
    words = ("nothing", "full", "half")
    assert " ".join(next(word for word in words if word in cause.text) for cause, _ in found) == left


def test_the_only_sensor_is_not_called_wrong_by_itself() -> None:
    assert explained(0.0, sensors=1) == "the driver gives nothing"


def test_before_there_is_a_window_nothing_is_reported() -> None:
    made = monitor("1", 1.0, 2)
    assert explain_window(made._model, made._past, 12.0) == []


HALF = Cause("driver", "the driver", "the driver gives half of what is asked")
PUMP = Cause("pump", "the pump", "the pump has stopped")
REVERSED = Cause("reversed", "the module", "the module is wired the wrong way round", 2.0)
LATE, WRONG = (Cause("drift", "a", f"a {words}") for words in ("is late", "alone is wrong"))


@pytest.mark.parametrize(
    ("causes", "kinds"),
    [([], [("model", "b")]), ([LATE, HALF], [("driver", "the driver"), ("drift", "a")]),
     ([WRONG, PUMP], [("pump", "the pump"), ("drift", "a")]),
     ([PUMP, REVERSED], [("reversed", "the module"), ("pump", "the pump")]),
     ([LATE, WRONG], [("drift", "a")])],
)  # fmt: skip
def test_the_most_dangerous_kind_comes_first(causes: list[Cause], kinds: list[tuple[str, str]]) -> None:
    assert by_danger(causes, "b") == kinds


def test_a_sensor_at_the_pump_is_no_pump_whatever_its_name() -> None:
    made, rng = monitor("1", 1.0, 2, ("t_driver", "t_pump")), np.random.default_rng(0)
    for k in range(1, 145):
        y = 25.0 + 0.02 * rng.standard_normal(2) + [0.0, 3.0 * (k > 120)]
        follow(made, k * DT, {"q": 0.0}, dict(zip(("t_driver", "t_pump"), y.tolist())))
    (cause,) = explain_window(made._model, made._past, 12.0)
    assert (cause.kind, cause.subject) == ("drift", "t_pump")
