"""A conversation with our firmware over a port: every question is answered or the device counts as lost.

A question that is met with silence, or whose answer came damaged, is asked again with the same number, and
the device does nothing twice.  A lost port is tried again (with back-off) at each question; a device that
answers again after it was lost or reset is greeted anew, which switches everything off.

Whatever happened on the way (a reset, a latch, a line that was damaged or repeated, an expired drive) waits
in :meth:`DeviceLine.notices` to be written down once.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from thermogrip.rig.drivers.gathering import DeviceClock
from thermogrip.rig.interface import DeviceRefusedError
from thermogrip.rig.serial.framing import Damaged
from thermogrip.rig.serial.port import AnyPort, PortError
from thermogrip.rig.serial.protocol import (
    MAX_TTL_MS,
    REFUSALS,
    Answer,
    Boot,
    Event,
    Hello,
    HostEnd,
    Identity,
    Read,
    Refused,
    Request,
    State,
    Taken,
    Unexpected,
)

__all__ = ["TTL_S", "DeviceLine", "Notice"]

TTL_S = MAX_TTL_MS / 1000
MOST_TRIES = 12  # of one question on a line that spoils half of what it carries


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


class DeviceLine:
    """A device that can be asked.

    Parameters
    ----------
    port : Port
        Not open yet, or open.
    timeout : float
        How long an answer may take, in real seconds.
    tries : int
        So often a question is met with silence before the device counts as lost.
    greeting : float
        How long the device may take to say hello after the port opened, in real seconds.
    clock : callable
        The rig's clock [s].

    Attributes
    ----------
    identity : Identity
        What the device said of itself.

    Raises
    ------
    PortError
        If the port cannot be opened, or nothing behind it speaks our protocol.
    """

    def __init__(
        self, port: AnyPort, *, timeout: float, tries: int, greeting: float, clock: Callable[[], float]
    ) -> None:
        self.port, self.timeout, self.tries = port, timeout, tries
        self._clock, self._start = clock, clock()
        self._host, self._device_clock = HostEnd(), DeviceClock()
        self._notices: deque[Notice] = deque(maxlen=1000)
        self._known: State | None = None
        self._heard, self._silent = 0, False  # bytes so far; whether the last question was met with none
        self._greeted_at, self._lost, self.closed = 0, False, False
        port.open()
        self.identity = self._first_hello(greeting)

    @property
    def state(self) -> State | None:
        """The device's last state, None while it cannot be reached."""
        return None if self._lost else self._known

    def notices(self) -> list[Notice]:
        """Return what happened since the last call, and forget it."""
        happened = list(self._notices)
        self._notices.clear()
        return happened

    def _now(self) -> float:
        return round(self._clock() - self._start, 9)

    def _note(self, kind: str, text: str) -> None:
        self._notices.append(Notice(self._now(), kind, text))

    def _drive_is_over(self) -> None:
        """Take note that the device does not do any more what it was told."""

    def _first_hello(self, seconds: float) -> Identity:
        """Ask for the device's identity until it answers; an Arduino takes seconds to start."""
        rounds = max(1, round(seconds / self.timeout))
        for _ in range(rounds):
            answer = self._once(self._host.ask(Hello()))
            if isinstance(answer, Answer) and isinstance(answer.content, Identity):
                self._greeted_at = self.port.opened
                return answer.content
        self.port.close()
        hint = "check that it runs thermogrip's firmware, or give --protocol"
        raise PortError("absent", "nothing here speaks our protocol", file=self.port.url, hint=hint)

    def _ask(self, request: Request) -> State:
        """Return the state that answers a question."""
        state = self._content(request)
        assert isinstance(state, State)
        self._see(state)
        return state

    def _content(self, request: Request) -> Identity | State | Taken:
        """Return what answers a question, greeting the device first where it is a new one."""
        if self.closed:
            raise PortError("lost", "is closed", file=self.port.url, hint="open the rig again")
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
            raise DeviceRefusedError(answer.code, REFUSALS[answer.code], latched)
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
            raise PortError("lost", "is not there", file=self.port.url, hint="check cable and power")
        if self._greeted_at == self.port.opened:
            return
        self._host.reset()
        answer = self._exchange(Hello())
        if not isinstance(answer, Answer) or answer.content != self.identity:
            raise PortError("lost", "is another device now", file=self.port.url, hint="start anew")
        self._greeted_at = self.port.opened

    def _exchange(self, request: Request) -> Answer | Refused:
        """Ask until there is an answer; the device does nothing twice."""
        data, sent = self._host.ask(request), self._now()
        silent, most = 0, 1 if self._silent else self.tries  # one that was silent holds up the loop no longer
        for _ in range(MOST_TRIES):
            before = self._heard
            answer = self._once(data)
            self._silent = self._heard == before
            if isinstance(answer, Answer) and isinstance(answer.content, State | Taken):
                self._device_clock.see(sent, self._now(), answer.content.uptime_ms)
            if answer is not None:
                return answer
            silent += self._silent
            if silent >= most:
                text = f"did not answer within {most * self.timeout:g} s"
                raise PortError("lost", text, file=self.port.url, hint="check cable and power")
            data = self._host.again()
            self._note("repeated", "no answer; asked again")
        text = f"was asked {MOST_TRIES} times and only damaged answers came"
        raise PortError("lost", text, file=self.port.url, hint="check cable and ground")

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
            if time.monotonic() > end:
                return None  # bytes without end are no answer either

    def _tell(self, event: Event) -> None:
        """Note what a session should know."""
        match event:
            case Damaged(why=why):
                self._note("damaged", f"a line came damaged ({why})")
            case Refused(request=None):
                self._note("damaged", "the device received a damaged line")
            case Boot(cause=cause, count=count):
                self._note("reset", f"the device was reset ({cause}, boot {count}); everything is off")
                self._greeted_at, self._known = 0, None
                self._drive_is_over()
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
            self._greeted_at = 0
            self._drive_is_over()
        if set(state.faults) - set(last.faults):
            self._note("latched", f"{', '.join(state.faults)}; mend it, then clear the latch")
            self._drive_is_over()
        if state.mode == "expired" and last.mode != "expired":
            self._note("expired", f"a drive outlived its {TTL_S:g} s; drive and pump are off")
