"""What a controller tells its operator: one clause for each thing that may be wrong, empty where all is well.

The step in Python and the one in C come to the same findings; their words are these.
"""

from __future__ import annotations

from collections.abc import Sequence

#: A call that comes before its move is due.
TOO_EARLY = "called before its sample time: the move is held"
#: A reading that was seen already.
STALE = "reading is stale: its time has not moved on"
OUT_OF_RANGE = "the drive that was applied is out of range: brought back"
TOO_LATE = "the step took longer than its deadline"


def silence(seconds: float) -> str:
    """Return what is said of a call after so many seconds without one."""
    return f"no reading for {seconds:.0f} s: the estimate was started again"


def lost_readings(names: Sequence[str], *, stuck: bool) -> str:
    """Return what is said of sensors without a usable reading, nothing where there are none."""
    stays = ", stuck: it should have moved" if stuck else ""
    return f"{', '.join(names)}: no usable reading{stays}" if names else ""


def jump(names: Sequence[str], *, offset: bool) -> str:
    """Return what is said of sensors whose readings have jumped and stay there."""
    taken = "taken for an offset of the sensor" if offset else "the estimate was started again"
    return f"{', '.join(names)}: a jump that stays, {taken}"


def no_target(*, safe: bool) -> str:
    """Return what is said before the first good target."""
    return f"no target yet: {'drives to their safe values' if safe else 'drive to zero'}"


def bad_target(controlled: Sequence[str], name: str | None = None) -> str:
    """Return what is said of a target for an output that is not controlled, or without a name of one that is
    missing or absurd."""
    if name is None:
        return f"target of {controlled[0]} is missing or absurd: the last good one is kept"
    return f"target names {name}, controlled is {', '.join(controlled)}"


def blind(seconds: float) -> str:
    """Return what is said where no controlled output was read for so long."""
    return f"no reading for {seconds:.0f} s: check the sensor"


def solver(status: str) -> str:
    """Return what is said of a program that was not solved."""
    return f"optimiser: {status}"


def limit_breaks(name: str, over: float) -> str:
    """Return what is said of a limit that will be broken."""
    return f"limit of {name} will be broken by {over:.1f} degC: choose a nearer target"


def pump_off(switches: Sequence[str]) -> str:
    """Return what is said while no water moves the heat."""
    return f"{', '.join(switches)} is off: drive to zero until it runs"


def unseen(names: Sequence[str], parked: Sequence[str], seconds: float, *, lost: bool) -> str:
    """Return what is said of controlled outputs that are not read while others are, ``lost`` for longer than
    patience, so that the drives ``parked`` go to rest."""
    if not lost:
        return f"{', '.join(names)}: no usable reading, the model replaces it"
    rest = f"{', '.join(parked)} to rest, the others go on" if parked else "the others go on"
    return f"no reading of {', '.join(names)} for {seconds:.0f} s: {rest}"
