"""Relays as drives: a requested share of full power, by switching on and off with least times.

A relay keeps what it owes, debt(t) = int (requested - state) dt [s of full power], and switches on once it
owes half of its shortest pulse, off once it owes nothing, neither before its least time is over.  There is no
period to choose: at a share d it is the shortest that the least times allow.

A heater and a cooler are two such relays of one drive from -1 to 1, each asked for its own sign.  One comes
on only when the other has been off for a dead time; what it owes by then beyond its bound is forgiven.  A
request of the other sign takes back what is owed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from typing import Annotated

from pydantic import ConfigDict, Field, Strict, TypeAdapter, ValidationError

from thermogrip.datasets.atomic_files import read_toml
from thermogrip.datasets.errors import UserError, known_names
from thermogrip.mpc.design.design import problem_of
from thermogrip.rig.interface import UNIT_RANGES, Reading, Rig, check_order


@dataclass(frozen=True)
class Switching:
    """Numbers of all relays."""

    now_s: float = 1e-6  # a switching that is due within this is due
    shortest_s: float = 0.01  # wait between two switchings: what comes later for it is owed
    same: float = 0.01  # of full: a device rounds what it applies


_SWITCHING = Switching()

#: A least time.
Seconds = Annotated[float, Strict(), Field(ge=0, le=3600)]


@dataclass(frozen=True)
class Relay:
    """One drive that is switched: by one relay, or by two, of which the cooler is the other sign."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    heater: str  # the device's input that is full on; where both are one input, its ends are on and reversed
    cooler: str = ""  # empty where nothing cools
    on_s: Seconds = 1.0  # least time on [s]
    off_s: Seconds = 1.0  # and off
    dead_s: Seconds = 0.0  # least time between heater and cooler


class Switch:
    """One relay: what it owes, and when it goes over."""

    def __init__(self, on_s: float, off_s: float) -> None:
        self.on, self.debt = False, 0.0
        self.since_s = inf  # it last went over
        self._on_s, self._off_s = on_s, off_s

    def pass_time(self, seconds: float, share: float) -> None:
        """Let time pass under a requested share, below zero where the other sign is asked for."""
        self.since_s += seconds
        if self.on:
            self.debt += (max(share, 0.0) - 1.0) * seconds
            return
        # -on_s / 2 <= debt <= max(on_s / 2, off_s), whatever is requested: over a window of W seconds the
        # mean is off by at most the width of that over W
        least = min(self.debt, 0.0) if share < 0 else -inf
        most = max(0.5 * self._on_s, self._off_s) + _SWITCHING.shortest_s
        self.debt = min(max(self.debt + share * seconds, least), most)

    def due_s(self, share: float) -> float:
        """Return in how long it goes over if this share is requested all the time."""
        if self.on:
            paid = self.debt / (1.0 - share) if share < 1 and self.debt > 0 else 0.0 if share < 1 else inf
            return max(paid, self._on_s - self.since_s)
        owed = 0.5 * self._on_s - self.debt
        return max(owed / share, self._off_s - self.since_s, 0.0) if share > 0 else inf

    def go_over(self) -> None:
        """Switch."""
        self.on, self.since_s = not self.on, 0.0


class RelayRig:
    """A rig some of whose drives are relays, behind the interface of one whose drives are graded."""

    def __init__(self, rig: Rig, relays: Mapping[str, Relay], clock: Callable[[], float]) -> None:
        self.rig = rig
        self.expires_s = rig.expires_s
        self.has_pump = rig.has_pump
        # what relays do not change is the device's own; its latch, if it has one, too
        self.grasp = rig.grasp
        self.release = rig.release
        self.notices = rig.notices
        self.close = rig.close
        self.clear = getattr(rig, "clear", None)
        self.relays = dict(relays)
        self._clock = clock
        for relay in self.relays.values():
            for name in filter(None, (relay.heater, relay.cooler)):
                if name not in rig.units:
                    hint = known_names(name, rig.units, "it has {}")
                    raise UserError(f"relays: the rig has no input {name!r}", hint=hint)
        switched = {name for relay in self.relays.values() for name in (relay.heater, relay.cooler)}
        self._through = {name: unit for name, unit in rig.units.items() if name not in switched}
        # of the drives as a controller has them; with a cooler -1...1
        self.units = {
            name: "1" if relay.cooler else rig.units[relay.heater] for name, relay in self.relays.items()
        } | self._through
        self._switches = {
            (name, sign): Switch(relay.on_s, relay.off_s)
            for name, relay in self.relays.items()
            for sign in ((1, -1) if relay.cooler else (1,))
        }
        self._requested = dict.fromkeys(self.units, 0.0)
        self._pump = 0
        self._now = clock()
        self._read_at = clock()
        self._on_s = dict.fromkeys(self.relays, 0.0)  # since the last reading, the cooler's below zero

    def read(self) -> Reading:
        """Return the newest sample."""
        reading, orders = self.rig.read(), self._orders()
        drive = dict(self._requested)  # where the device applies what was switched, else what it applies
        for name, relay in self.relays.items():
            applied = {channel: reading.drive[channel] for channel in {relay.heater, relay.cooler} - {""}}
            differs = [
                abs(value - orders[channel]) / self._full(channel) for channel, value in applied.items()
            ]
            if max(differs) > _SWITCHING.same:
                share = applied[relay.heater] / self._full(relay.heater)
                if relay.cooler not in ("", relay.heater):
                    share -= applied[relay.cooler] / self._full(relay.cooler)
                drive[name] = share * UNIT_RANGES[self.units[name]][1]
        self._pass_time()
        seconds, self._read_at = self._now - self._read_at, self._now
        on_s, self._on_s = self._on_s, dict.fromkeys(self.relays, 0.0)
        if seconds <= 0:
            return replace(reading, drive=drive, mean_drive=None)
        means = {name: on_s[name] / seconds * UNIT_RANGES[self.units[name]][1] for name in self.relays}
        return replace(reading, drive=drive, mean_drive=self._requested | means)

    def apply(self, drive: Mapping[str, float], pump: int) -> None:
        """Request drives from now on; with the pump off all relays are off at once."""
        ranges = {name: UNIT_RANGES[unit] for name, unit in self.units.items()}
        check_order(drive, pump, ranges)
        self._pass_time()
        self._requested, self._pump = {name: float(value) for name, value in drive.items()}, pump
        self._switch()
        self.rig.apply(self._orders(), pump)

    def wait(self, seconds: float) -> None:
        """Let time pass, and switch meanwhile what is due."""
        remaining_s = seconds
        while remaining_s > _SWITCHING.now_s:
            due = min((self._due_s(*key) for key in self._switches), default=inf)
            step = min(remaining_s, max(due, _SWITCHING.shortest_s))
            self.rig.wait(step)
            remaining_s -= step
            self._pass_time()
            if remaining_s > _SWITCHING.now_s and self._switch():
                self.rig.apply(self._orders(), self._pump)

    def _full(self, name: str) -> float:
        """Return what an input of the device is when it is full on."""
        return UNIT_RANGES[self.rig.units[name]][1]

    def _share(self, name: str, sign: int) -> float:
        """Return the share that a relay is asked for, below zero for the other sign."""
        return sign * self._requested[name] / UNIT_RANGES[self.units[name]][1]

    def _pass_time(self) -> None:
        now = self._clock()
        for (name, sign), switch in self._switches.items():
            self._on_s[name] += sign * switch.on * (now - self._now)
            switch.pass_time(now - self._now, self._share(name, sign))
        self._now = now

    def _due_s(self, name: str, sign: int) -> float:
        """Return in how long a relay goes over: the other one of its drive must be off for long enough."""
        switch, other = self._switches[name, sign], self._switches.get((name, -sign))
        if not self._pump:
            return 0.0 if switch.on else inf
        due = switch.due_s(self._share(name, sign))
        if switch.on or other is None:
            return due
        return inf if other.on else max(due, self.relays[name].dead_s - other.since_s)

    def _switch(self) -> bool:
        """Switch what is due; say whether anything was."""
        due = [key for key in self._switches if self._due_s(*key) <= _SWITCHING.now_s]
        for key in due:
            self._switches[key].go_over()
        return bool(due)

    def _orders(self) -> dict[str, float]:
        """Return the command to the device."""
        orders = {name: self._requested[name] for name in self._through}
        for name, relay in self.relays.items():
            for channel in filter(None, (relay.heater, relay.cooler)):
                orders.setdefault(channel, 0.0)
            if self._switches[name, 1].on:
                orders[relay.heater] = self._full(relay.heater)
            elif relay.cooler and self._switches[name, -1].on:
                sign = -1 if relay.cooler == relay.heater else 1
                orders[relay.cooler] = sign * self._full(relay.cooler)
        return orders


def read_relays(path: str | Path) -> dict[str, Relay]:
    """Return the relays of a TOML file: a table by drive, with the keys of :class:`Relay`."""
    hint = "write [q1] and below it on_s = 10"
    content = read_toml(path, hint=hint)
    if not content:
        raise UserError("has no relay", file=path, hint=hint)
    tables = {
        name: {"heater": name, **table} if isinstance(table, dict) else table
        for name, table in content.items()
    }
    try:
        return TypeAdapter(dict[str, Relay]).validate_python(tables)
    except ValidationError as error:
        raise UserError(problem_of(error), file=path, hint=hint) from error
