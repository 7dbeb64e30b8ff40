"""Relays as drives: a requested share of full power, by switching on and off with least times.

A relay keeps what it owes, owed(t) = int (requested - state) dt [s of full power], and switches on once it
owes half of its shortest pulse, off once it owes nothing, neither before its least time is over.  There is no
period to choose: at a share d it is the shortest that the least times allow.

A heater and a cooler are two such relays, each asked for its sign of one drive, or for a drive of its own.
One comes on only when the other has been off for a dead time; what it owes by then beyond its bound is
forgiven.  A request of the other sign takes back what is owed.  ``csource/tg_switches.c`` is the same in C.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf
from typing import Annotated

from pydantic import ConfigDict, Field, Strict

NOW_S = 1e-6  # a switching that is due within this is due
SHORTEST_S = 0.01  # wait between two switchings: what comes later for it is owed

#: A least time.
Seconds = Annotated[float, Strict(), Field(ge=0, le=3600)]


@dataclass(frozen=True)
class Relay:
    """One drive that is switched: by one relay, or by two, of which the cooler is the other sign."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    # the device's input that is full on, by default the drive's name; where both are one input, its ends are
    # on and reversed
    heater: str = ""
    # empty where nothing cools; a drive with a table of its own is never on together with this one
    cooler: str = ""
    on_s: Seconds = 1.0  # least time on [s]
    off_s: Seconds = 1.0  # and off
    dead_s: Seconds = 0.0  # least time between heater and cooler


def pairs_of_drives(relays: Mapping[str, Relay]) -> dict[str, str]:
    """Return the cooler of each heater where both are drives of their own."""
    return {name: of.cooler for name, of in relays.items() if of.cooler in relays.keys() - {name}}


def two_signed(relays: Mapping[str, Relay]) -> set[str]:
    """Return the drives that go both ways, whose coolers are no drives of their own."""
    return {name for name, of in relays.items() if of.cooler} - pairs_of_drives(relays).keys()


@dataclass(eq=False)
class Switch:
    """One relay: what it owes, and when it goes over; nobody knows what it did before."""

    drive: str
    full: float  # of its drive, where it is on; below zero a cooler's
    channel: str  # of the device
    on_s: float
    off_s: float
    dead_s: float
    opposite: Switch | None = field(default=None, repr=False)  # off for dead_s before this one comes on
    share: float = 0.0  # that is requested, below zero where the other sign is
    on: bool = False
    fresh: bool = True  # it has not been on, and for what it waited until then nothing is owed
    owed_s: float = 0.0
    since_s: float = 0.0  # it last went over

    def pass_time(self, seconds: float) -> None:
        """Let time pass."""
        self.since_s += seconds
        if self.on:
            self.owed_s += (max(self.share, 0.0) - 1.0) * seconds
            return
        # -on_s / 2 <= owed <= max(on_s / 2, off_s), whatever is requested: over a window of W seconds the
        # mean is off by at most the width of that over W
        least = min(self.owed_s, 0.0) if self.share < 0 else -inf
        most = max(0.5 * self.on_s, 0.0 if self.fresh else self.off_s) + SHORTEST_S
        self.owed_s = min(max(self.owed_s + self.share * seconds, least), most)

    def due_s(self) -> float:
        """Return in how long it goes over if its share is requested all the time."""
        if self.on:
            paid = max(self.owed_s, 0.0) / (1.0 - self.share) if self.share < 1 else inf
            return max(paid, self.on_s - self.since_s)
        if self.share <= 0 or (self.opposite is not None and self.opposite.on):
            return inf
        dead = -inf if self.opposite is None else self.dead_s - self.opposite.since_s
        return max((0.5 * self.on_s - self.owed_s) / self.share, self.off_s - self.since_s, dead, 0.0)


class Switches:
    """The relays of all drives; at the ends of a drive's range one is on all the time."""

    def __init__(self, relays: Mapping[str, Relay], ranges: Mapping[str, tuple[float, float]]) -> None:
        of_drive: dict[str, list[Switch]] = {}
        for name, relay in relays.items():
            ends = [(ranges[name][1], relay.heater or name)]
            ends += [(ranges[name][0], relay.cooler)] if name in two_signed(relays) else []
            of_drive[name] = [Switch(name, *end, relay.on_s, relay.off_s, relay.dead_s) for end in ends]
        for name, relay in relays.items():
            if relay.cooler:
                heater, cooler = (of_drive[name] + of_drive.get(relay.cooler, []))[:2]
                heater.opposite, cooler.opposite, cooler.dead_s = cooler, heater, relay.dead_s
        self.each = [switch for switches in of_drive.values() for switch in switches]

    def request(self, drive: Mapping[str, float], *, running: bool = True) -> None:
        """Request drives from now on, and switch what is due; unless ``running`` all go off at once, whatever
        their least times."""
        for switch in self.each:
            switch.share = drive[switch.drive] / switch.full if running else 0.0
            if switch.on and not running:
                switch.on, switch.since_s, switch.owed_s = False, 0.0, 0.0
        self.go_over()

    def go_over(self) -> None:
        """Switch what is due, one after the other: of two that are due one comes on, and the other waits."""
        for switch in self.each:
            if switch.due_s() <= NOW_S:
                switch.on, switch.since_s, switch.fresh = not switch.on, 0.0, False

    def pass_time(self, seconds: float) -> None:
        """Let time pass."""
        for switch in self.each:
            switch.pass_time(seconds)

    def step_s(self, seconds: float) -> float:
        """Return for how long to wait until anything is due, at most so many seconds."""
        return min(seconds, max(min(switch.due_s() for switch in self.each), SHORTEST_S))

    def mean(self, drive: Mapping[str, float], seconds: float) -> dict[str, float]:
        """Return drives as they are given on average while these are requested for so many seconds."""
        given = {**drive, **dict.fromkeys((switch.drive for switch in self.each), 0.0)}
        remaining_s = seconds
        while remaining_s > NOW_S:
            self.request(drive)
            step = self.step_s(remaining_s)
            for switch in self.each:
                given[switch.drive] += switch.on * switch.full * step / seconds
            self.pass_time(step)
            remaining_s -= step
        return given
