"""Control: prediction model, observer, condensed QP, controller, PI baseline, tuning, review."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from thermogrip.mpc.checks import Check, review
    from thermogrip.mpc.closed_loop import ClosedLoop, Surroundings, simulate_closed_loop
    from thermogrip.mpc.controller import Controller, design_controller
    from thermogrip.mpc.design import Design, default_design
    from thermogrip.mpc.explicit import explicit_law
    from thermogrip.mpc.figures import closed_loop_figure
    from thermogrip.mpc.interface import Move
    from thermogrip.mpc.pid import PIController
    from thermogrip.mpc.spec import SPEC_TEMPLATE, Spec, read_spec
    from thermogrip.mpc.tuning import Tuning, tune

# Loaded at first use: importing the room must not cost what its heaviest module costs.
_HOME = {
    "Check": "checks",
    "ClosedLoop": "closed_loop",
    "Controller": "controller",
    "Design": "design",
    "Move": "interface",
    "PIController": "pid",
    "SPEC_TEMPLATE": "spec",
    "Spec": "spec",
    "Surroundings": "closed_loop",
    "Tuning": "tuning",
    "closed_loop_figure": "figures",
    "default_design": "design",
    "design_controller": "controller",
    "explicit_law": "explicit",
    "read_spec": "spec",
    "review": "checks",
    "simulate_closed_loop": "closed_loop",
    "tune": "tuning",
}

__all__ = [
    "SPEC_TEMPLATE",
    "Check",
    "ClosedLoop",
    "Controller",
    "Design",
    "Move",
    "PIController",
    "Spec",
    "Surroundings",
    "Tuning",
    "closed_loop_figure",
    "default_design",
    "design_controller",
    "explicit_law",
    "read_spec",
    "review",
    "simulate_closed_loop",
    "tune",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
