"""Our firmware as a rig: every question confirmed, every drive with a time to live, every oddity told.

A drive is sent with :data:`TTL_S` to live and renewed while :meth:`DeviceRig.wait` lets time pass, so it ends
by itself within that time when the program freezes, dies, or loses its cable, and it holds while all is well.

**What fails how.**  A reading that cannot be had is a reading: every temperature NaN and the drive 0, so a
session sees it, writes it down and can decide.  A drive that was not confirmed raises, because nobody may
believe that it was applied: :class:`~thermogrip.rig.port.PortError` where the device cannot be reached,
:class:`DeviceRefusedError` where it says no.  A lost port is tried again (with back-off) at each call; a
device that answers again after it was lost or reset is greeted anew, which switches everything off.

Whatever happened on the way (a reset, a latch, a line that was damaged or repeated, an expired drive) waits
in :meth:`DeviceRig.notices` to be written down once.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from thermogrip.rig.clock import Metronome
from thermogrip.rig.framing import Damaged
from thermogrip.rig.interface import Reading
from thermogrip.rig.port import AnyPort, PortError
from thermogrip.rig.protocol import (
    MAX_TTL_MS,
    REFUSALS,
    Answer,
    Boot,
    Channel,
    Clear,
    Drive,
    Event,
    Grip,
    Hello,
    HostEnd,
    Identity,
    Off,
    Read,
    Refused,
    Request,
    State,
    Unexpected,
)

__all__ = ["RENEW_S", "TTL_S", "DeviceRefusedError", "DeviceRig", "Notice"]

TTL_S = MAX_TTL_MS / 1000
MOST_TRIES = 12  # of one question on a line that spoils half of what it carries
RENEW_S = 0.5  # how often a drive is renewed while time passes


class DeviceRefusedError(Exception):
    """The device said no.

    Parameters
    ----------
    code : str
        One of :data:`~thermogrip.rig.protocol.REFUSALS`.
    faults : tuple of str
        What is latched.
    """

    def __init__(self, code: str, faults: tuple[str, ...] = ()) -> None:
        self.code, self.faults = code, faults
        latched = f" ({', '.join(faults)})" if faults else ""
        super().__init__(f"the device refuses: {REFUSALS[code]}{latched}")


@dataclass(frozen=True)
class Notice:
    """Something that happened on the line or the device.

    Attributes
    ----------
    time_s : float
        The rig's clock [s].
    kind : str
        ``link`` (lost, found), ``reset``, ``latched``, ``expired``, ``damaged``, ``repeated``, ``refused``,
        ``unexpected``.
    text : str
        In words.
    """

    time_s: float
    kind: str
    text: str


class DeviceRig:
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
    >>> from thermogrip.rig.virtual import DirectPort, VirtualDevice
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
        self.port, self.timeout, self.tries = port, timeout, tries
        self._clock, self._sleep = clock, sleep
        self._host = HostEnd()
        self._start, self._beat = clock(), Metronome(clock)
        self._notices: deque[Notice] = deque(maxlen=1000)
        self._known: State | None = None
        self._command: tuple[dict[str, float], int] | None = None
        self._heard, self._silent = 0, False  # bytes so far; whether the last question was met with none
        self._confirmed = 0.0  # when the device last took the drive
        self._greeted_at, self._lost, self.closed = 0, False, False
        port.open()
        self.identity = self._first_hello(greeting)

    @property
    def units(self) -> dict[str, str]:
        """Units of the driven inputs, by name."""
        return {channel.name: channel.unit for channel in self.identity.drives}

    @property
    def expires_s(self) -> float:
        """How long a drive lives on the device when nobody renews it [s]."""
        return TTL_S

    @property
    def state(self) -> State | None:
        """The device's last state, None while it cannot be reached."""
        return None if self._lost else self._known

    def read(self) -> Reading:
        """Return the newest sample; NaN everywhere while the device cannot be reached."""
        try:
            return self._reading(self._ask(Read()))
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
            if end - self._clock() > 0 and self._command is not None:
                self._renew()

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

    def notices(self) -> list[Notice]:
        """Return what happened since the last call, and forget it."""
        happened = list(self._notices)
        self._notices.clear()
        return happened

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

    def _now(self) -> float:
        return round(self._clock() - self._start, 9)

    def _note(self, kind: str, text: str) -> None:
        self._notices.append(Notice(self._now(), kind, text))

    def _channels(self, drive: Mapping[str, float]) -> tuple[Channel, ...]:
        if set(drive) != set(self.units):
            raise ValueError(f"drive has {sorted(drive)}, the rig's inputs are {sorted(self.units)}")
        return self.identity.drives

    def _reading(self, state: State) -> Reading:
        values = {
            name: float("nan") if isinstance(value, str) else value / 1000
            for name, value in zip(self.identity.sensors, state.temperatures)
        }
        applied = {channel.name: value / 1e4 for channel, value in zip(self.identity.drives, state.drive)}
        return Reading(self._now(), values, applied, state.pump)

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

    def _first_hello(self, seconds: float) -> Identity:
        """Ask for the device's identity until it answers; an Arduino takes seconds to start."""
        rounds = max(1, round(seconds / self.timeout))
        for _ in range(rounds):
            answer = self._once(self._host.ask(Hello()))
            if isinstance(answer, Answer) and isinstance(answer.content, Identity):
                self._greeted_at = self.port.opened
                return answer.content
        self.port.close()
        mend = "check that it runs thermogrip's firmware, or give --protocol"
        raise PortError("absent", "nothing here speaks our protocol", file=self.port.url, mend=mend)

    def _ask(self, request: Request) -> State:
        """Return the state that answers a question, greeting the device first where it is a new one."""
        if self.closed:
            raise PortError("lost", "is closed", file=self.port.url, mend="open the rig again")
        try:
            self._greet_if_new()
            answer = self._exchange(request)
        except PortError as error:
            if not self._lost:
                self._note("link", str(error))
            self._lost = True
            raise
        if self._lost:
            self._lost = False
            self._note("link", "answers again")
        if isinstance(answer, Refused):
            latched = self._faults() if answer.code in ("latched", "active") else ()
            raise DeviceRefusedError(answer.code, latched)
        assert isinstance(answer.content, State)
        self._see(answer.content)
        return answer.content

    def _faults(self) -> tuple[str, ...]:
        """Return what is latched; a refusal does not say it."""
        answer = self._exchange(Read())
        if not isinstance(answer, Answer) or not isinstance(answer.content, State):
            return ()
        self._see(answer.content)
        return answer.content.faults

    def _greet_if_new(self) -> None:
        """Open a lost port if that is due, and say hello on a new connection or after a reset."""
        if not self.port.try_open():
            raise PortError("lost", "is not there", file=self.port.url, mend="check cable and power")
        if self._greeted_at == self.port.opened:
            return
        self._host.reset()
        answer = self._exchange(Hello())
        if not isinstance(answer, Answer) or answer.content != self.identity:
            raise PortError("lost", "is another device now", file=self.port.url, mend="start anew")
        self._greeted_at = self.port.opened

    def _exchange(self, request: Request) -> Answer | Refused:
        """Ask until there is an answer; the device does nothing twice."""
        data = self._host.ask(request)
        silent, most = 0, 1 if self._silent else self.tries  # one that was silent holds up the loop no longer
        for _ in range(MOST_TRIES):
            before = self._heard
            answer = self._once(data)
            self._silent = self._heard == before
            if answer is not None:
                return answer
            silent += self._silent
            if silent >= most:
                text = f"did not answer within {most * self.timeout:g} s"
                raise PortError("lost", text, file=self.port.url, mend="check cable and power")
            data = self._host.again()
            self._note("repeated", "no answer; asked again")
        text = f"was asked {MOST_TRIES} times and only damaged answers came"
        raise PortError("lost", text, file=self.port.url, mend="check cable and ground")

    def _once(self, data: bytes) -> Answer | Refused | None:
        """Send a question and return its answer, None if none came in time or it was damaged."""
        self.port.write(data)
        # real time: on a stepped clock an answer that does not come would never be late
        end = time.monotonic() + self.timeout
        while True:
            heard = self.port.read(max(0.0, end - time.monotonic()))
            if not heard:
                return None
            self._heard += len(heard)
            events = self._host.hear(heard)
            for event in events:
                self._tell(event)
            for event in events:
                if isinstance(event, Answer) or (isinstance(event, Refused) and event.request is not None):
                    return event
            if any(isinstance(event, Damaged | Refused) for event in events):
                return None  # no use in waiting for what was damaged

    def _tell(self, event: Event) -> None:
        """Note what a session should know."""
        match event:
            case Damaged(why=why):
                self._note("damaged", f"a line came damaged ({why})")
            case Refused(request=None):
                self._note("damaged", "the device received a damaged line")
            case Boot(cause=cause, count=count):
                self._note("reset", f"the device was reset ({cause}, boot {count}); everything is off")
                self._greeted_at, self._command, self._known = 0, None, None
            case Unexpected(why=why):
                self._note("unexpected", f"a line came that answers nothing ({why})")
            case _:
                pass

    def _see(self, state: State) -> None:
        """Compare with the last state: a reset whose line was lost, a new latch, an expired drive."""
        last, self._known = self._known, state
        if last is None:
            return
        if state.boot != last.boot:
            self._note("reset", f"the device was reset ({state.cause}, boot {state.boot}); everything is off")
            self._greeted_at, self._command = 0, None
        if set(state.faults) - set(last.faults):
            self._note("latched", f"{', '.join(state.faults)}; mend it, then clear the latch")
            self._command = None
        if state.mode == "expired" and last.mode != "expired":
            self._note("expired", f"a drive outlived its {TTL_S:g} s; drive and pump are off")


def _counts(channel: Channel, drive: Mapping[str, float]) -> int:
    """Return a drive as the device takes it."""
    value, low, high = drive[channel.name], channel.low / 1e4, channel.high / 1e4
    if not low <= value <= high:  # also false for NaN
        raise ValueError(f"{channel.name} = {value:g} is outside {low:g} to {high:g}")
    return round(1e4 * value)

