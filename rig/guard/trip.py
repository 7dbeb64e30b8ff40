"""What the guard reports when it ends a session: expected against measured, what to check, how to clear.

A trip without its two numbers is what people work around: "not heating at expected rate" has been answered
for years by weakening the check.  So every trip has what was expected and what was measured, with their
units, the likely causes in the order in which they are worth checking, and what clears it.  A trip is data:
one JSON object in ``events.jsonl``, one line on the terminal.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

#: kind -> (what to check, how to clear), in the order of the module docstrings of the checks.
KINDS: dict[str, tuple[str, str]] = {
    "limit": (
        "the target, the water level, whether the driver obeys (does the drive's LED go off at drive 0?)",
        "let it come back inside the limits, then start again",
    ),
    "lost": (
        "the sensor's plug and wire (open or shorted), then the converter's supply",
        "repair it until the reading is plausible, then start again",
    ),
    "stuck": (
        "the converter (does its reading change when the sensor is warmed by hand?), a frozen driver program",
        "power-cycle the converter, then start again",
    ),
    "jump": (
        "the sensor's plug and wire for a loose contact",
        "repair it, then start again",
    ),
    "disagree": (
        "which of the two sensors is wrong: compare both with a third, or in one cup of water",
        "replug or replace the wrong one, then start again",
    ),
    "drift": (
        "the sensor's seat (has it come off its place?), its converter, its calibration",
        "compare it with a thermometer; if the plant itself has changed, identify it anew",
    ),
    "model": (
        "pump, tube and water level; the driver and its supply; fan and heatsink; the sensor's seat",
        "find the cause; if the rig was changed on purpose, identify the plant anew",
    ),
    "pump": (
        "the pump: its supply, a kinked tube, air in the loop, the water level",
        "see water move, then start again",
    ),
    "driver": (
        "the current driver: its supply and fuse, its wiring to the module, a shorted output stage",
        "switch the supply off by hand if the rig still heats or cools; repair the driver, then start again; "
        "if it is in order, identify the plant anew",
    ),
    "reversed": (
        "the polarity of the module's two wires",
        "swap them, then start again; if they are right, identify the plant anew",
    ),
    "stale": (
        "the cable, the device's power, what else keeps the computer busy",
        "see readings arrive, then start again",
    ),
    "frozen": (
        "what stopped the program (Ctrl-Z, a suspended or overloaded computer)",
        "the device has switched off by itself after its 2 s; start again",
    ),
    "clock": (
        "whether the device was reset (its supply, its cable) or its clock was set",
        "start again; rows before the jump are good",
    ),
    "device": (
        "what the device's own message says",
        "repair the cause; a new connection clears the device's latch; then start again",
    ),
    "cable": (
        "the cable at both ends, the device's power",
        "plug it in; the device has switched off by itself after its 2 s; start again",
    ),
    "drive": (
        "whether the controller file fits this rig, and whether another program drives it",
        "start again with a controller that was tuned for this rig",
    ),
    "interlock": (
        "the controller: with the pump off no heat may be pumped into standing water",
        "start again; if it comes back, the controller does not fit this rig",
    ),
    "optimum": (
        "fan and heatsink (too warm?), the lower end of drive_limits in the spec",
        "limit the cooling drive to where more of it still cools, tune again",
    ),
    "disk": (
        "the space on the disk of the run folder",
        "free some space; what is on disk is whole; go on with the same folder's batch, or start again",
    ),
}  # fmt: skip

#: How to clear, where nothing on the device ends its drive (a TCLab).
ENDLESS: dict[str, str] = {
    "frozen": "nothing on this device ended its drive meanwhile; it is off now; start again",
    "cable": "PULL THE PLUG of its supply, nothing on this device ends its drive; then start again",
}


@dataclass(frozen=True)
class Trip:
    """Why the guard ended a session.

    Attributes
    ----------
    kind : str
        One of :data:`KINDS`.
    time_s : float
        When [s, the rig's clock].
    subject : str
        The sensor, input or part that it is about.
    expected, measured : str
        With their units.
    check, clear : str
        What to look at, and what makes a new start possible; the kind's own where not given.
    figures : mapping of str to float
        The numbers behind the words, for a program.

    Examples
    --------
    >>> line = Trip("jump", 52.0, "t_surface", "near 30 degC", "39 degC, 3 readings in a row").line()
    >>> for part in line.split("; "):
    ...     print(part)
    jump: t_surface: expected near 30 degC, measured 39 degC, 3 readings in a row
    check the sensor's plug and wire for a loose contact
    to clear: repair it, then start again
    """

    kind: str
    time_s: float
    subject: str
    expected: str
    measured: str
    check: str = ""
    clear: str = ""
    figures: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"{self.kind!r} is no kind of trip; the kinds are {', '.join(KINDS)}")
        check, clear = KINDS[self.kind]
        object.__setattr__(self, "check", self.check or check)
        object.__setattr__(self, "clear", self.clear or clear)

    def line(self) -> str:
        """Return the one line for the terminal."""
        return (
            f"{self.kind}: {self.subject}: expected {self.expected}, measured {self.measured}; "
            f"check {self.check}; to clear: {self.clear}"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON; a number that is not finite becomes None."""
        plain = {
            key: getattr(self, key) for key in ("kind", "subject", "expected", "measured", "check", "clear")
        }
        numbers = {
            key: float(value) if abs(value) < float("inf") else None for key, value in self.figures.items()
        }
        return {**plain, "time_s": self.time_s, "figures": numbers}


class TripError(Exception):
    """The guard ended the session; ``trip`` says why."""

    def __init__(self, trip: Trip) -> None:
        super().__init__(trip.line())
        self.trip = trip
