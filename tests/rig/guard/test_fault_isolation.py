"""A window that went elsewhere names what happened in it, and nothing where nothing did."""

from __future__ import annotations

import numpy as np
import pytest

from thermogrip.rig.guard.fault_isolation import Cause, by_danger, explain_window
from thermogrip.rig.guard.model_checks import ModelMonitor
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

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
        made.follow(k * DT, {"q": asked * full}, 1, dict(zip("ab", y[:sensors].tolist())))
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


def test_the_only_sensor_is_not_called_wrong_by_itself() -> None:
    assert explained(0.0, sensors=1) == "the driver gives nothing"


def test_before_there_is_a_window_nothing_is_reported() -> None:
    made = monitor("1", 1.0, 2)
    assert explain_window(made._model, made._past, 12.0) == []


HALF = Cause("driver", "the driver", "the driver gives half of what is asked")
PUMP = Cause("pump", "the pump", "the pump stands still")
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
        made.follow(k * DT, {"q": 0.0}, 1, dict(zip(("t_driver", "t_pump"), y.tolist())))
    (cause,) = explain_window(made._model, made._past, 12.0)
    assert (cause.kind, cause.subject) == ("drift", "t_pump")
