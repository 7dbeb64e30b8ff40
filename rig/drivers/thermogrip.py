"""Our firmware as a rig: every request is confirmed, every drive has a time to live, every oddity is noted.

**What fails how.**  A reading that cannot be had is a reading, so a session sees it, records it and can
decide.  A drive that was not confirmed raises, because it must not count as applied.

**The conversation.**  A question that is met with silence, or whose answer came damaged, is repeated with the
same number, and the device does nothing twice.  A lost port is tried again (with back-off) at each question;
a device that answers again after it was lost or reset is greeted anew, which switches everything off.  It
must be the same board, by its own serial number: another one is never driven.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

from thermogrip.rig.interface import DeviceRefusedError, Reading, check_order
from thermogrip.rig.serial import protocol
from thermogrip.rig.serial.port import Port, PortError, SerialRig

TTL_S = protocol.MAX_TTL_MS / 1000
MOST_TRIES = 12  # of one question on a line that spoils half of it


class DeviceRig(SerialRig):
    """A device with our firmware, behind the rig's interface.

    ``timeout`` of an answer and ``greeting`` of an Arduino that starts anew are real seconds; after ``tries``
    questions that are met with silence the device counts as lost.
    """

    expires_s = TTL_S

    def __init__(
        self,
        port: Port,
        *,
        timeout: float = 0.25,
        tries: int = 3,
        greeting: float = 6.0,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        super().__init__(port, timeout, clock, sleep)
        self.tries = tries
        self._host = protocol.HostEnd()
        self._known: protocol.State | None = None
        self._heard, self._silent = 0, False  # bytes so far; whether the last question was met with none
        self._greeted_at = 0
        self.identity = self._first_hello(greeting)
        self.units = {channel.name: channel.unit for channel in self.identity.drives}
        self.has_pump = self.identity.pump

    @property
    def state(self) -> protocol.State | None:
        """The device's last state, None while it cannot be reached."""
        return None if self._lost else self._known

    def read(self) -> Reading:
        """Return the newest sample; NaN everywhere while the device cannot be reached."""
        try:
            state = self._ask(protocol.Read())
        except PortError:
            nothing = dict.fromkeys(self.identity.sensors, float("nan"))
            return Reading(self._now(), nothing, dict.fromkeys(self.units, 0.0), 0)
        values = {
            name: float("nan") if isinstance(value, str) else value / 1000
            for name, value in zip(self.identity.sensors, state.temperatures)
        }
        applied = {channel.name: value / 1e4 for channel, value in zip(self.identity.drives, state.drive)}
        return Reading(self._now(), values, applied, state.pump)

    def apply(self, drive: Mapping[str, float], pump: int) -> None:
        """Drive from now on, for :data:`TTL_S` or until the next call; returns when the device has confirmed.

        PortError where it cannot be reached (what it did last ends by itself), DeviceRefusedError where it
        refuses (a latched fault, a drive while the pump is off, a reset since it was greeted).
        """
        check_order(drive, pump, {c.name: (c.low / 1e4, c.high / 1e4) for c in self.identity.drives})
        counts = tuple(round(1e4 * drive[channel.name]) for channel in self.identity.drives)
        if self.closed:
            if pump or any(counts):
                raise RuntimeError("the rig is closed")
            return
        idle = not pump and not any(counts)
        self._ask(protocol.Off() if idle else protocol.Drive(protocol.MAX_TTL_MS, pump, counts))

    def grasp(self, material: str, t_object: float) -> None:
        """Close the gripper."""
        self._ask(protocol.Grip(1))

    def release(self) -> None:
        """Open the gripper; raises as :meth:`grasp`."""
        self._ask(protocol.Grip(0))

    def clear(self) -> None:
        """Clear the fault latch; DeviceRefusedError where the cause is still there."""
        self._ask(protocol.Clear())

    def close(self) -> None:
        """Switch everything off and let the port go; never raises, and may be called twice."""
        if self.closed:
            return
        try:
            self._ask(protocol.Off())
        except (PortError, DeviceRefusedError) as error:
            self._note("link", f"could not be switched off: {error}; its drive ends within {TTL_S:g} s")
        self.closed = True
        self._known = None
        self.port.close()

    def _first_hello(self, seconds: float) -> protocol.Identity:
        """Ask for the device's identity until it answers; an Arduino takes seconds to start."""
        rounds = max(1, round(seconds / self.timeout))
        for _ in range(rounds):
            answer = self._once(self._host.ask(protocol.Hello()))
            if isinstance(answer, protocol.Answer) and isinstance(answer.content, protocol.Identity):
                self._greeted_at = self.port.opened
                return answer.content
        self.port.close()
        hint = "check that it runs thermogrip's firmware, or give --protocol"
        raise PortError("nothing here speaks our protocol", file=self.port.url, hint=hint)

    def _ask(self, request: protocol.Request) -> protocol.State:
        """Return what answers a question, greeting the device first where it is a new one."""
        with self._answering():
            if self._lost or self._greeted_at != self.port.opened:
                self._greet()
            answer = self._exchange(request)
        if isinstance(answer, protocol.Refused):
            latched: tuple[str, ...] = ()
            if answer.code in ("latched", "active"):  # a refusal does not have the faults
                latched = self._ask(protocol.Read()).faults
            raise DeviceRefusedError(answer.code, protocol.REFUSALS[answer.code], latched)
        state = answer.content
        assert isinstance(state, protocol.State)
        self._compare(state)
        return state

    def _greet(self) -> None:
        """Say hello, on a new connection and after a silence or a reset."""
        self._host.reset()
        answer = self._exchange(protocol.Hello())
        if not isinstance(answer, protocol.Answer) or answer.content != self.identity:
            raise PortError("is another device now", file=self.port.url, hint="start anew")
        self._greeted_at = self.port.opened

    def _exchange(self, request: protocol.Request) -> protocol.Answer | protocol.Refused:
        """Repeat a question until it is answered."""
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
                raise PortError(text, file=self.port.url, hint="check cable and power")
            data = self._host.again()
            self._note("repeated", "no answer; asked again")
        text = f"was asked {MOST_TRIES} times and only damaged answers came"
        raise PortError(text, file=self.port.url, hint="check cable and ground")

    def _once(self, data: bytes) -> protocol.Answer | protocol.Refused | None:
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
                self._note_event(event)
            for event in events:
                if isinstance(event, protocol.Answer) or (
                    isinstance(event, protocol.Refused) and event.request is not None
                ):
                    return event
            if any(isinstance(event, protocol.Damaged | protocol.Refused) for event in events):
                return None  # no use in waiting for what was damaged
            if time.monotonic() > end:
                return None  # bytes without end are no answer either

    def _note_event(self, event: protocol.Event) -> None:
        match event:
            case protocol.Damaged(why=why):
                self._note("damaged", f"a line came damaged ({why})")
            case protocol.Refused(request=None):
                self._note("damaged", "the device received a damaged line")
            case protocol.Boot(cause=cause, count=count):
                self._note("reset", f"the device was reset ({cause}, boot {count}); everything is off")
                self._greeted_at, self._known = 0, None
            case protocol.Unexpected(why=why):
                self._note("unexpected", f"a line came that answers nothing ({why})")

    def _compare(self, state: protocol.State) -> None:
        """Compare with the last state: a reset whose line was lost, a new latch, an expired drive."""
        last, self._known = self._known, state
        if last is None:
            return
        if state.boot != last.boot:
            self._note("reset", f"the device was reset ({state.cause}, boot {state.boot}); everything is off")
            self._greeted_at = 0
        if set(state.faults) - set(last.faults):
            self._note("latched", f"{', '.join(state.faults)}; repair it, then clear the latch")
        if state.mode == "expired" and last.mode != "expired":
            self._note("expired", f"a drive outlived its {TTL_S:g} s; drive and pump are off")
