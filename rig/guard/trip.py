"""What the guard reports when it ends a session: expected against measured, what to check, how to clear.

A trip without its two numbers is what people work around: "not heating at expected rate" has been answered
for years by weakening the check.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from importlib.resources import files

_WORDS = tomllib.loads((files(__package__) / "trips.toml").read_text(encoding="utf-8"))

#: kind -> (what to check, how to clear), in the order of the module docstrings of the checks.
KINDS: dict[str, tuple[str, str]] = {kind: (row["check"], row["clear"]) for kind, row in _WORDS.items()}

#: How to clear, where nothing on the device ends its drive (a TCLab).
ENDLESS: dict[str, str] = {kind: row["endless"] for kind, row in _WORDS.items() if "endless" in row}


@dataclass(frozen=True)
class Trip:
    """Why the guard ended a session."""

    kind: str  # one of :data:`KINDS`
    time_s: float  # when [s, the rig's clock]
    subject: str  # the sensor, input or part that it is about
    expected: str  # with its unit
    measured: str  # with its unit
    check: str = ""  # what to look at; the kind's own where not given
    clear: str = ""  # what makes a new start possible; the kind's own where not given

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


class TripError(Exception):
    """The guard ended the session; ``trip`` says why."""

    def __init__(self, trip: Trip) -> None:
        super().__init__(trip.line())
        self.trip = trip
