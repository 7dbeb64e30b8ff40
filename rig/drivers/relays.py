"""Relays as drives of a rig: see :mod:`thermogrip.mpc.design.relays`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from math import inf
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from thermogrip.datasets.errors import UserError, known_names
from thermogrip.datasets.files import read_toml
from thermogrip.mpc.design.design import problem_of
from thermogrip.mpc.design.relays import NOW_S, Relay, Switches, two_signed
from thermogrip.rig.interface import UNIT_RANGES, Reading, Rig, check_order

_SAME = 0.01  # of full: a device rounds what it applies


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
        channels = {
            name: filter(None, (relay.heater or name, relay.cooler)) for name, relay in relays.items()
        }
        switched = {channel for of_drive in channels.values() for channel in of_drive}
        for channel in switched - set(rig.units):
            hint = known_names(channel, rig.units, "it has {}")
            raise UserError(f"relays: the rig has no input {channel!r}", hint=hint)
        self._through = {name: unit for name, unit in rig.units.items() if name not in switched}
        # of the drives as a controller has them; with a cooler -1...1
        signed = two_signed(relays)
        self.units = {
            name: "1" if name in signed else rig.units[relay.heater or name]
            for name, relay in self.relays.items()
        } | self._through
        self._switches = Switches(relays, {name: UNIT_RANGES[self.units[name]] for name in self.relays})
        # sign of each input of the device in its drive; the heater's where both relays are one input
        self._signs: dict[str, dict[str, int]] = {name: {} for name in self.relays}
        for switch in self._switches.each:
            self._signs[switch.drive].setdefault(switch.channel, 1 if switch.full > 0 else -1)
        self._on_s = dict.fromkeys(self._signs, 0.0)  # integral of each drive since the last reading
        self._requested = dict.fromkeys(self.units, 0.0)
        self._now = clock()
        self._read_at, self._newest_s = self._now, -inf  # the newest reading, by this clock and by its own
        self._means = dict.fromkeys(self._signs, 0.0)

    def read(self) -> Reading:
        """Return the newest sample."""
        reading, orders = self.rig.read(), self._orders()
        drive = dict(self._requested)  # where the device applies what was switched, else what it applies
        for name, signs in self._signs.items():
            full = {channel: self._full(channel) for channel in signs}
            if any(
                abs(reading.drive[channel] - orders[channel]) > _SAME * full[channel] for channel in signs
            ):
                shares = (sign * reading.drive[channel] / full[channel] for channel, sign in signs.items())
                drive[name] = sum(shares) * UNIT_RANGES[self.units[name]][1]
        self._pass_time()
        seconds = self._now - self._read_at
        if reading.time_s > self._newest_s and seconds > 0:  # one that is read twice has its mean
            self._means = {name: value / seconds for name, value in self._on_s.items()}
            self._on_s = dict.fromkeys(self._signs, 0.0)
            self._read_at, self._newest_s = self._now, reading.time_s
        return replace(reading, drive=drive, mean_drive=self._means)

    def apply(self, drive: Mapping[str, float], pump: int) -> None:
        """Request drives from now on; with the pump off all relays are off at once."""
        ranges = {name: UNIT_RANGES[unit] for name, unit in self.units.items()}
        check_order(drive, pump, ranges)
        self._pass_time()
        self._requested, self._pump = {name: float(value) for name, value in drive.items()}, pump
        self._switches.request(drive, running=bool(pump))
        self.rig.apply(self._orders(), pump)

    def wait(self, seconds: float) -> None:
        """Let time pass, and switch meanwhile what is due."""
        remaining_s = seconds
        while remaining_s > NOW_S:
            step = self._switches.step_s(remaining_s)
            self.rig.wait(step)
            remaining_s -= step
            self._pass_time()
            if remaining_s > NOW_S:
                before = self._orders()
                self._switches.go_over()
                if before != self._orders():
                    self.rig.apply(self._orders(), self._pump)

    def _full(self, name: str) -> float:
        """Return what an input of the device is when it is full on."""
        return UNIT_RANGES[self.rig.units[name]][1]

    def _pass_time(self) -> None:
        now = self._clock()
        for switch in self._switches.each:
            self._on_s[switch.drive] += switch.on * switch.full * (now - self._now)
        self._switches.pass_time(now - self._now)
        self._now = now

    def _orders(self) -> dict[str, float]:
        """Return the command to the device."""
        orders = {name: self._requested[name] for name in self._through}
        for switch in self._switches.each:
            orders.setdefault(switch.channel, 0.0)
            if switch.on:
                sign = self._signs[switch.drive][switch.channel] * (1 if switch.full > 0 else -1)
                orders[switch.channel] = sign * self._full(switch.channel)
        return orders


def of_inputs(relays: Mapping[str, Relay], rig: Rig) -> dict[str, Relay]:
    """Return the relays of a rig whose inputs are the drives themselves, as those of a twin are."""
    signed = two_signed(relays)
    return {
        name: replace(relay, heater=name, cooler=name if name in signed else relay.cooler)
        if name in rig.units
        else relay
        for name, relay in relays.items()
    }


def read_relays(path: str | Path) -> dict[str, Relay]:
    """Return the relays of a TOML file: a table by drive, with the keys of :class:`Relay`."""
    hint = "write [q1] and below it on_s = 10"
    content = read_toml(path, hint=hint)
    if not content:
        raise UserError("has no relay", file=path, hint=hint)
    try:
        return TypeAdapter(dict[str, Relay]).validate_python(content)
    except ValidationError as error:
        raise UserError(problem_of(error), file=path, hint=hint) from error
