"""Our firmware as a rig: every question confirmed, every drive with a time to live, every oddity told.

A drive is sent with :data:`TTL_S` to live and renewed while :meth:`DeviceRig.wait` lets time pass, so it ends
by itself within that time when the program freezes, dies, or loses its cable, and it holds while all is well.

**What fails how.**  A reading that cannot be had is a reading: every temperature NaN and the drive 0, so a
session sees it, writes it down and can decide.  A drive that was not confirmed raises, because nobody may
believe that it was applied: :class:`~thermogrip.rig.serial.port.PortError` where the device cannot be
reached,
:class:`DeviceRefusedError` where it says no.  A lost port is tried again (with back-off) at each call; a
device that answers again after it was lost or reset is greeted anew, which switches everything off.

**Readings by the device's clock.**  :meth:`DeviceRig.sample_every` lets the device measure by itself and
:meth:`DeviceRig.take` fetches what it has (:mod:`~thermogrip.rig.drivers.gathering`): a program that is held
up for less than the device can keep loses none, and what is lost is counted.

The conversation itself is in :mod:`~thermogrip.rig.drivers.link`; what happened on the way (a reset, a latch,
a line that was damaged or repeated, an expired drive) waits in ``notices()`` to be written down once.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import suppress

from thermogrip.rig.clock import Metronome
from thermogrip.rig.drivers.gathering import Gathering
from thermogrip.rig.drivers.link import TTL_S, DeviceLine, Notice
from thermogrip.rig.firmware.ring_buffer import MAX_PERIOD_MS, MIN_PERIOD_MS
from thermogrip.rig.interface import DeviceRefusedError, Reading
from thermogrip.rig.serial.port import AnyPort, PortError
from thermogrip.rig.serial.protocol import (
    MAX_TTL_MS,
    Channel,
    Clear,
    Drive,
    Grip,
    Kept,
    Off,
    Read,
    Sample,
    State,
    Take,
    Taken,
)

__all__ = ["RENEW_S", "TTL_S", "DeviceRig", "Notice"]

RENEW_S = 0.5  # how often a drive is renewed while time passes


class DeviceRig(DeviceLine):
    """A device with our firmware, behind the rig's interface.

    Parameters
    ----------
    port : Port
        Not open yet, or open.
    timeout : float, optional
        How long an answer may take, in real seconds.
    tries : int, optional
        So often a question is met with silence before the device counts as lost.
    greeting : float, optional
        How long the device may take to say hello after the port opened, in real seconds: an Arduino starts
        anew when its port is opened.
    clock, sleep : callable, optional
        The rig's clock and how it waits [s].
    units
        Given by the device: units of the driven inputs, by name.

    Raises
    ------
    PortError
        If the port cannot be opened, or nothing behind it speaks our protocol.

    Examples
    --------
    >>> from thermogrip.rig.clock import SteppedClock
    >>> from thermogrip.rig.simulation.virtual_device import DirectPort, VirtualDevice
    >>> clock = SteppedClock()
    >>> device = VirtualDevice(link="none", clock=clock, t_start=25.0)
    >>> rig = DeviceRig(DirectPort(device), clock=clock, sleep=clock.sleep)
    >>> rig.units
    {'drive': '1'}
    >>> rig.apply({"drive": 0.8}, pump=1)
    >>> rig.wait(60.0)
    >>> rig.read().values["t_tank"] > 25.5
    True
    >>> rig.close()
    """

    def __init__(
        self,
        port: AnyPort,
        *,
        timeout: float = 0.25,
        tries: int = 3,
        greeting: float = 6.0,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._sleep, self._beat = sleep, Metronome(clock)
        self._command: tuple[dict[str, float], int] | None = None
        self._confirmed = 0.0  # when the device last took the drive
        self._gathering: Gathering | None = None
        super().__init__(port, timeout=timeout, tries=tries, greeting=greeting, clock=clock)

    @property
    def units(self) -> dict[str, str]:
        """Units of the driven inputs, by name."""
        return {channel.name: channel.unit for channel in self.identity.drives}

    @property
    def expires_s(self) -> float:
        """How long a drive lives on the device when nobody renews it [s]."""
        return TTL_S

    def read(self) -> Reading:
        """Return the newest sample; NaN everywhere while the device cannot be reached."""
        try:
            state = self._ask(Read())
            return self._reading(self._now(), state)
        except PortError:
            nothing = dict.fromkeys(self.identity.sensors, float("nan"))
            return Reading(self._now(), nothing, dict.fromkeys(self.units, 0.0), 0)

    def apply(self, drive: Mapping[str, float], pump: int) -> None:
        """Drive from now on, until the next call; returns when the device has confirmed it.

        Raises
        ------
        ValueError
            If an input is unknown or missing, or a value is outside its range or not finite.
        PortError
            If the device cannot be reached: what it did last ends by itself within its time to live.
        DeviceRefusedError
            If it says no: a latched fault, a drive while the pump is off, a reset since it was greeted.
        RuntimeError
            If the rig is closed and something is to be switched on.
        """
        counts = tuple(_counts(channel, drive) for channel in self._channels(drive))
        if pump not in (0, 1):
            raise ValueError(f"pump = {pump} is neither 0 nor 1")
        if self.closed:
            if pump or any(counts):
                raise RuntimeError("the rig is closed")
            return
        self._command = None  # whatever was renewed so far is over
        idle = not pump and not any(counts)
        self._ask(Off() if idle else Drive(MAX_TTL_MS, pump, counts))
        self._command, self._confirmed = None if idle else (dict(drive), pump), self._clock()

    def wait(self, seconds: float) -> None:
        """Let time pass and renew the drive; one that cannot be renewed ends on the device.

        Waits that follow each other end on a grid (:class:`~thermogrip.rig.clock.Metronome`).
        """
        if not seconds >= 0:
            raise ValueError(f"cannot wait {seconds:g} s")
        end = self._beat.next(seconds)
        while (left := end - self._clock()) > 0:
            self._sleep(min(left, RENEW_S))
            old = self._clock() - self._confirmed >= 2 * RENEW_S  # many short waits follow each other
            if self._command is not None and (old or end - self._clock() > 0):
                self._renew()

    def sample_every(self, seconds: float) -> bool:
        """Let the device take a reading every so many seconds by its own clock; 0 ends it.

        Returns
        -------
        does : bool
            Whether it does: False where its firmware is older, or it cannot keep this time.

        Raises
        ------
        PortError
            If the device cannot be reached.
        """
        period = round(1000 * seconds)
        possible = MIN_PERIOD_MS <= period <= MAX_PERIOD_MS and abs(period - 1000 * seconds) < 1e-6
        self._gathering = None
        if seconds and not possible:
            return False
        try:
            self._ask(Sample(period))
        except DeviceRefusedError as refused:
            if refused.code == "unknown":
                return False
            raise
        self._gathering = Gathering(period) if period else None
        return period > 0

    def take(self) -> tuple[list[Reading], int]:
        """Return the device's own readings since the last call, oldest first, and how many were lost since.

        None come while the device cannot be reached (:meth:`read` tells); it goes on taking them.

        Raises
        ------
        RuntimeError
            If the device takes none: see :meth:`sample_every`.
        """
        gathering = self._gathering
        if gathering is None:
            raise RuntimeError("the device takes no readings of its own; see sample_every")
        before, readings = gathering.lost, []
        while taken := self._next_taken(gathering):
            there = gathering.take(taken, self._device_clock)
            readings += [self._reading(time, kept) for time, kept in there]
            if not taken.waiting:
                break
        return readings, gathering.lost - before

    def grasp(self, material: str, t_object: float) -> None:
        """Close the gripper.

        Raises
        ------
        PortError, DeviceRefusedError
            As of :meth:`apply`.
        """
        self._ask(Grip(1))

    def release(self) -> None:
        """Open the gripper; raises as :meth:`grasp`."""
        self._ask(Grip(0))

    def clear(self) -> None:
        """Clear the fault latch.

        Raises
        ------
        DeviceRefusedError
            If what tripped it is still there.
        """
        self._ask(Clear())

    def close(self) -> None:
        """Switch everything off and let the port go; never raises, and may be called twice."""
        if self.closed:
            return
        self._command = None
        try:
            self._ask(Off())
        except (PortError, DeviceRefusedError) as error:
            self._note("link", f"could not be switched off: {error}; its drive ends within {TTL_S:g} s")
        self.closed = True
        self._known = None
        self.port.close()

    def _drive_is_over(self) -> None:
        self._command = None

    def _channels(self, drive: Mapping[str, float]) -> tuple[Channel, ...]:
        if set(drive) != set(self.units):
            raise ValueError(f"drive has {sorted(drive)}, the rig's inputs are {sorted(self.units)}")
        return self.identity.drives

    def _reading(self, time_s: float, told: State | Kept) -> Reading:
        values = {
            name: float("nan") if isinstance(value, str) else value / 1000
            for name, value in zip(self.identity.sensors, told.temperatures)
        }
        applied = {channel.name: value / 1e4 for channel, value in zip(self.identity.drives, told.drive)}
        return Reading(time_s, values, applied, told.pump)

    def _next_taken(self, gathering: Gathering) -> Taken | None:
        """Return the device's next readings, None where it cannot be reached or has only begun anew."""
        try:
            content = self._content(Take(gathering.number))
        except PortError:
            return None
        except DeviceRefusedError:  # it was reset: it takes none any more, or counts from 0
            gathering.begin_anew()
            with suppress(PortError):  # then the next call begins
                self._ask(Sample(gathering.period_ms))
            return None
        assert isinstance(content, Taken)
        return content

    def _renew(self) -> None:
        """Send the drive once more; a failure shows at the next reading."""
        assert self._command is not None
        drive, pump = self._command
        if self._clock() - self._confirmed >= TTL_S:  # this program stood still: the loop has to decide anew
            self._command = None
            self._note("expired", f"the program stood still for {self._clock() - self._confirmed:.1f} s")
            return
        counts = tuple(_counts(channel, drive) for channel in self.identity.drives)
        try:
            self._ask(Drive(MAX_TTL_MS, pump, counts))
            self._confirmed = self._clock()
        except PortError:
            self._command = None  # by the time it is back, it has expired: only the loop may drive it again
        except DeviceRefusedError as refused:
            self._command = None
            self._note("refused", str(refused))


def _counts(channel: Channel, drive: Mapping[str, float]) -> int:
    """Return a drive as the device takes it."""
    value, low, high = drive[channel.name], channel.low / 1e4, channel.high / 1e4
    if not low <= value <= high:  # also false for NaN
        raise ValueError(f"{channel.name} = {value:g} is outside {low:g} to {high:g}")
    return round(1e4 * value)
