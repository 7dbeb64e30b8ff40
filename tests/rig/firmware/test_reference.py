"""What the device's core does by itself: its reference in Python, from which the firmware does not differ.

What the device measured by its own clock arrives, once and in order, or is known to be lost.
"""

from __future__ import annotations

import re
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.rig.cores import SCRIPTS, START, last_state, reference, say
from thermogrip.rig.firmware.reference import CELLS, DeviceCore, Ring
from thermogrip.rig.serial import protocol

SIZE = CELLS // 5  # of one drive and three sensors


def test_a_drive_ends_after_its_time_and_not_before() -> None:
    pins = [line for line in reference(SCRIPTS["a drive expires"]).splitlines() if line.startswith("pins")]
    assert pins == ["pins 1 -2500 1 0", "pins 1 -2500 1 0", "pins 0 0 0 0"]
    assert last_state(reference(SCRIPTS["a drive expires"]))[0] == "expired"


def test_a_repeated_drive_does_not_live_longer() -> None:
    assert reference(SCRIPTS["a repeated question does nothing twice"]).endswith("pins 0 0 0 0\n")


def test_a_latch_holds_until_its_cause_is_over_and_it_is_cleared() -> None:
    said = reference(SCRIPTS["an open sensor latches at the fourth sample"])
    assert re.findall(r"(?:err|pins) (\w+)", said) == ["1", "0", "latched", "active", "1"]


def test_a_lost_room_sensor_is_no_reason_to_stop() -> None:
    script = [*START, *[f"sample 1 {100 * k} 25000 25000 open" for k in range(1, 9)]]
    assert last_state(reference([*script, say(2, "read", now=900)]))[::4] == ["off", "-", "25000,25000,open"]


def test_what_is_out_of_limits_is_named() -> None:
    said = reference(SCRIPTS["too warm and too cold latch"])
    assert last_state(said)[4] == "over:t_tank,under:t_surface"


def test_a_stalled_pump_switches_off_after_three_seconds_and_has_them_again_when_it_was_cleared() -> None:
    said = reference(SCRIPTS["a pump that has stopped latches"])
    assert re.findall(r"pins (\d)", said) == ["1", "0", "1", "0"]
    assert "pump" in said


def test_refusals_name_their_reason() -> None:
    said = reference(SCRIPTS["what is refused"])
    codes = ["hello", "interlock", *["ttl"] * 2, "range", *["syntax"] * 3, "unknown", *["syntax"] * 2]
    assert re.findall(r"err (\w+)", said) == codes
    assert said.endswith("pins 0 0 0 1\n")  # nothing was driven, only the gripper closed


# ---- readings by the device's own clock ----


class Conversation:
    """A host and a device on one clock; tick k measures k thousandths of a degC."""

    def __init__(self, period_ms: int = 10) -> None:
        self.host, self.core, self.now = protocol.HostEnd(), DeviceCore(), 0
        self.core.sample([25_000, 25_000, 25_000], flow=True, now_ms=0)
        self.host.hear(self.core.receive(self.host.ask(protocol.Hello()), 0))
        self.ask(protocol.Sample(period_ms))

    def ask(self, request: protocol.Request) -> protocol.Event:
        (event,) = self.host.hear(self.core.receive(self.host.ask(request), self.now))
        return event

    def run(self, ms: int) -> None:
        """Let so much time pass on the device."""
        for _ in range(ms):
            if self.core.ring.due(self.now):
                self.core.keep([self.core.ring.next, 25_000, 25_000], self.now)
            self.now += 1

    def take(self, number: int) -> protocol.Taken:
        event = self.ask(protocol.Take(number))
        assert isinstance(event, protocol.Answer)
        assert isinstance(event.content, protocol.Taken)
        return event.content

    def numbers(self, taken: protocol.Taken) -> list[int]:
        """Return the numbers of the readings, each of which holds its own."""
        found = [taken.first + k for k, kept in enumerate(taken.readings) if kept is not None]
        assert found == [kept.temperatures[0] for kept in taken.readings if kept is not None]
        return found


numbers = st.integers(-(2**31), 2**31 - 1)
temperatures = st.lists(numbers | st.sampled_from(["open", "short"]), min_size=1, max_size=4).map(tuple)
kept = st.builds(protocol.Kept, st.integers(0, 65535), st.integers(0, 1), st.tuples(numbers), temperatures)


@given(st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1), st.lists(kept | st.none(), max_size=2))
def test_what_is_taken_reads_back(uptime: int, first: int, readings: list[protocol.Kept | None]) -> None:
    taken = protocol.Taken(uptime, first, (first + len(readings)) % 2**32, tuple(readings))
    assert protocol.parse_taken(taken.words(), 1) == taken
    assert taken.waiting == 0


@pytest.mark.parametrize(
    "text",
    [
        "",
        "1 2",
        "1 2 2 4,1,0,25000",  # more readings than ticks
        "1 2 3",  # ticks, and nothing of them: would be asked for for ever
        "1 2 1 4,1,0,25000",
        "-1 2 3 4,1,0,25000",
        "1 2 3 -4,1,0,25000",
        "1 2 3 4,2,0,25000",
        "1 2 3 4,1,0",
        "1 2 3 4,1,x,25000",
        "1 2 3 4,1,0,warm",
        "1 2 3 4,1,0,25000,",
        "1 2 3 --",
        "01 2 3 4,1,0,25000",
    ],
)
def test_readings_that_make_no_sense_are_malformed(text: str) -> None:
    with pytest.raises(ValueError, match=r"malformed|unpack"):
        protocol.parse_taken(text.split(), 1)


def test_readings_of_another_shape_than_the_device_has_are_not_used() -> None:
    talk = Conversation()
    talk.host.ask(protocol.Take(0))
    seq = int(talk.host.again().split()[0])
    for odd in ("4,1,0,25000", "4,1,0,1,2,3,4"):
        (event,) = talk.host.hear(protocol.encode_line(seq, "ok", "1", "0", "1", odd))
        assert isinstance(event, protocol.Unexpected)


def test_every_tick_is_taken_once_however_irregularly_the_host_asks() -> None:
    talk, number, got = Conversation(), 0, []
    rng = Random(1)
    while talk.now < 20_000:
        talk.run(rng.choice([1, 7, 10, 12, 90, 230]))
        while True:
            taken = talk.take(number)
            assert taken.first == number
            got += talk.numbers(taken)
            number += len(taken.readings)
            if not taken.waiting:
                break
    assert got == list(range(number))
    assert number == -(-talk.now // 10)


@given(st.integers(0, 3000))
def test_what_was_overwritten_is_counted(silence: int) -> None:
    talk = Conversation()
    talk.run(silence)
    made = -(-silence // 10)
    taken = talk.take(0)
    assert taken.next == made
    assert taken.first == max(0, made - SIZE)


def test_ages_say_when_each_was_measured_and_a_device_that_stood_still_leaves_holes() -> None:
    talk = Conversation()
    talk.run(27)
    taken = talk.take(0)
    assert (taken.uptime_ms, [kept.age_ms for kept in taken.readings]) == (27, [27, 17, 7])
    talk.now += 38  # the loop did not turn
    talk.run(15)
    taken = talk.take(0)
    assert [kept is not None for kept in taken.readings] == [True] * 3 + [False] * 3 + [True] * 2
    assert taken.next == 8


@given(st.integers(10, 1000), st.integers(0, 2**31 - 1), st.integers(0, 2**32 - 1))
def test_numbers_follow_the_clock_however_long_it_stood(period: int, stood: int, start: int) -> None:
    ring = Ring(4)
    ring.start(period, start)
    ring.keep(start, 0, (0,), (1, 2, 3))
    now = (start + stood) % 2**32
    assert ring.due(now) == (stood >= period)
    if stood >= period:
        ring.keep(now, 0, (0,), (1, 2, 3))
        assert ring.next == (stood // period + 1) % 2**32
        assert len(ring) == min(SIZE, stood // period + 1)
        reading = ring.at(len(ring) - 1, now)
        assert reading.age_ms == 0


def test_a_number_that_has_not_come_is_refused_nothing_is_forgotten_and_a_reset_ends_it() -> None:
    talk = Conversation()
    talk.run(45)
    assert talk.ask(protocol.Take(6)) == protocol.Refused(protocol.Take(6), "range")
    talk.ask(protocol.Read())
    assert talk.take(0).first == 0
    assert talk.take(5).readings == ()
    for k in range(20):  # the guards do not check readings that the host asked for
        talk.core.keep(["open", 99_000, 25_000], 100 + 10 * k)
    assert talk.core.faults == ()
    talk.core = DeviceCore(cause="watchdog", boot=2)
    assert talk.ask(protocol.Take(5)) == protocol.Refused(protocol.Take(5), "idle")


@pytest.mark.parametrize("period", [-10, 1, 9, 1001])
def test_a_period_that_the_device_cannot_keep_is_refused(period: int) -> None:
    talk = Conversation()
    talk.run(30)
    assert talk.ask(protocol.Sample(period)) == protocol.Refused(protocol.Sample(period), "range")
    assert talk.take(0).next == 3  # what ran goes on


def test_an_answer_never_outgrows_a_line_and_always_brings_a_tick() -> None:
    talk = Conversation(1000)
    talk.core.ring.first = 2**32 - 30  # the longest numbers there are
    for _ in range(SIZE):
        talk.core.keep([-(2**31), -(2**31), -(2**31)], talk.now)
        talk.now += 1000
    back = talk.core.receive(protocol.encode_line(65535, "take", str(2**32 - 30)), 2**32 - 1)
    (line,) = protocol.LineParser().feed(back)
    assert isinstance(line, protocol.Line)
    taken = protocol.parse_taken(line.words[1:], 1)
    assert len(taken.readings) >= 2
    assert len(back) <= protocol.MAX_BODY + 12


@pytest.mark.parametrize("how", ["cut", "flip", "lose"])
def test_an_answer_damaged_at_any_byte_loses_nothing(how: str) -> None:
    place, end = 0, 1
    while place < end:
        talk = Conversation()
        talk.run(60)
        back = talk.core.receive(talk.host.ask(protocol.Take(0)), talk.now)
        spoilt = {
            "cut": back[:place],
            "flip": back[:place] + bytes([back[place] ^ 1]) + back[place + 1 :],
            "lose": back[:place] + back[place + 1 :],
        }[how]
        assert not any(isinstance(event, protocol.Answer) for event in talk.host.hear(spoilt))
        talk.run(20)
        talk.host.reset()  # half a line may stand there; the host asks anew, with another number
        taken = talk.take(0)
        assert talk.numbers(taken)[:5] == [0, 1, 2, 3, 4]
        assert taken.next == 8
        place, end = place + 1, len(back)


def test_a_repeated_question_repeats_its_answer_though_time_went_on() -> None:
    talk = Conversation()
    talk.run(60)
    data = talk.host.ask(protocol.Take(0))
    first = talk.core.receive(data, talk.now)
    talk.run(300)
    assert talk.core.receive(data, talk.now) == first
