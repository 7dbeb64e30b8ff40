"""Control: prediction model, observer, condensed QP, controller, PI baseline, tuning, review."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from thermogrip.mpc.closed_loop.simulate import ClosedLoop, Surroundings, simulate_closed_loop
    from thermogrip.mpc.controllers.mpc import Controller, design_controller
    from thermogrip.mpc.controllers.pi import PIController
    from thermogrip.mpc.design.design import Design, default_design
    from thermogrip.mpc.design.spec import SPEC_TEMPLATE, Spec, read_spec
    from thermogrip.mpc.interface import Move
    from thermogrip.mpc.tuning.design_review import Check, review
    from thermogrip.mpc.tuning.figures import closed_loop_figure
    from thermogrip.mpc.tuning.tune import Tuning, tune

# Loaded at first use: importing the room must not cost what its heaviest module costs.
_MODULES = {
    "closed_loop.simulate": ("ClosedLoop", "Surroundings", "simulate_closed_loop"),
    "controllers.mpc": ("Controller", "design_controller"),
    "controllers.pi": ("PIController",),
    "design.design": ("Design", "default_design"),
    "design.spec": ("SPEC_TEMPLATE", "Spec", "read_spec"),
    "tuning.design_review": ("Check", "review"),
    "interface": ("Move",),
    "tuning.figures": ("closed_loop_figure",),
    "tuning.tune": ("Tuning", "tune"),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}

__all__ = [
    "SPEC_TEMPLATE", "Check", "ClosedLoop", "Controller", "Design", "Move", "PIController", "Spec",
    "Surroundings", "Tuning", "closed_loop_figure", "default_design", "design_controller", "read_spec",
    "review", "simulate_closed_loop", "tune",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
