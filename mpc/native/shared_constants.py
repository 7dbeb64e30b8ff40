"""Numbers that the Python and the C share: written once, in Python, and defined in each ``tg_config.h``.

A constant stands in the module whose rule it belongs to.  Those of rules that lie above this folder, in
:mod:`thermogrip.mpc.controllers`, stand here.
"""

from __future__ import annotations

from types import ModuleType

from thermogrip.mpc.estimator import call_times, observer, reading_checks
from thermogrip.mpc.optimiser import qp, rti

STAYS = 1e-5  # of its range: a plan that moves by less has converged
UNCUT = 1e-9  # of its range: a drive of the PI that is cut by less is not limited
WEAK = 0.05  # of its gain at rest, below which a drive's bias is not learnt

_SHARED: dict[ModuleType, tuple[str, ...]] = {
    call_times: ("RESTART_S", "SAME"),
    observer: ("LARGEST_BIAS",),
    qp: ("SHORT", "TOLERANCE"),
    reading_checks: (*("LEFT_OUT", "SHARE"),),
    rti: ("BARELY", "BREAKS", "BREAKS_FAR", "FADING", "LITTLE", "LOOK_AROUND", "SAFE", "SHARES", "SHORTEST"),
}


def shared_constants() -> dict[str, float | tuple[float, ...]]:
    """Return each shared constant by the name that the C puts behind ``TG_``."""
    out = {name: getattr(module, name) for module, names in _SHARED.items() for name in names}
    return out | {"STAYS": STAYS, "UNCUT": UNCUT, "WEAK": WEAK}


def shared_definitions() -> list[str]:
    """Return the lines that define the shared constants in C."""
    braces = str.maketrans("()", "{}")  # of a tuple
    values = sorted(shared_constants().items())
    return [f"#define TG_{name} {repr(value).translate(braces)}" for name, value in values]
