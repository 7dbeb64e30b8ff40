"""Nothing corrupt is ever taken for a message, however the stream is cut, spoilt or repeated."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path
from random import Random

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from thermogrip.rig.firmware.reference import DeviceCore
from thermogrip.rig.serial import protocol
from thermogrip.rig.simulation.cable import SPOILS

SPECIFICATION = Path(__file__).parents[3] / "docs" / "reference" / "protocol.md"
LINES = [
    protocol.encode_line(7, "read"),
    protocol.encode_line(8, "drive", "2000", "1", "-2500"),
    protocol.encode_line(
        8, "ok", "armed", "81204", "power", "17", "-", "1", "0", "-2500", "31250,open,25000"
    ),
    protocol.encode_line(65535, "err", "interlock"),
    protocol.encode_line(0, "boot", "watchdog", "18", "0.1.0"),
]
STREAM = b"".join(LINES)
SENT = [protocol.decode_line(line[:-1]) for line in LINES]

words = st.text(
    st.characters(min_codepoint=33, max_codepoint=126, exclude_characters="*"), min_size=1, max_size=20
)
lines = st.builds(
    lambda seq, parts: protocol.encode_line(seq, *parts),
    st.integers(0, 65535),
    st.lists(words, min_size=1, max_size=6),
)


def test_the_crc_is_the_catalogues_check_value() -> None:
    assert protocol.crc16(b"123456789") == 0x29B1  # CRC-16/IBM-3740, in the catalogue of parametrised CRCs


def test_the_vectors_of_the_specification_are_true() -> None:
    right = SPECIFICATION.read_text().split("## Lines that are right")[1].split("## Lines that are not")[0]
    vectors = re.findall(r"^\| `([^`]+)` \|", right, flags=re.MULTILINE)
    assert len(vectors) >= 12
    for text in vectors:
        line = protocol.decode_line(text.encode())
        assert isinstance(line, protocol.Line), text
        assert protocol.encode_line(line.seq, *line.words) == text.encode() + b"\n"


def test_the_bad_lines_of_the_specification_are_refused_for_the_reason_given() -> None:
    wrong = SPECIFICATION.read_text().split("## Lines that are not")[1]
    bad = re.findall(r"^\| `([^`]+)` \| ([a-z]+) \|", wrong, flags=re.MULTILINE)
    assert {why for _, why in bad} == {"check", "length", "crc", "grammar"}
    for text, why in bad:
        damaged = protocol.decode_line(text.encode())
        assert isinstance(damaged, protocol.Damaged)
        assert damaged.why == why, text


def test_the_specification_names_every_refusal() -> None:
    text = SPECIFICATION.read_text()
    assert all(f"`{code}`" in text for code in protocol.REFUSALS)


@given(lines)
def test_what_is_encoded_is_decoded(line: bytes) -> None:
    decoded = protocol.decode_line(line[:-1])
    assert isinstance(decoded, protocol.Line)
    assert protocol.encode_line(decoded.seq, *decoded.words) == line


def heard(stream: bytes) -> list[protocol.Line]:
    """Return the whole lines of a stream, each of which was sent."""
    found = [event for event in protocol.LineParser().feed(stream) if isinstance(event, protocol.Line)]
    assert all(line in SENT for line in found)
    return found


@given(st.lists(st.integers(0, len(STREAM)), max_size=8).map(sorted))
@example([1])
def test_pieces_of_any_size_give_the_same_lines(places: list[int]) -> None:
    for cuts in (places, *([place] for place in range(len(STREAM) + 1) if places == [1])):
        parser = protocol.LineParser()
        pieces = [event for a, b in pairwise([0, *cuts, len(STREAM)]) for event in parser.feed(STREAM[a:b])]
        assert pieces == SENT


def test_a_byte_spoilt_or_lost_anywhere_costs_its_line_and_at_most_the_next() -> None:
    for place in range(len(STREAM)):
        for mask in (0x01, 0x02, 0x04, 0x08, 0x10, 0x20, 0x40, 0x80, 0xFF):
            spoilt = bytearray(STREAM)
            spoilt[place] ^= mask
            assert len(heard(bytes(spoilt))) >= len(SENT) - 2  # a lost end of line costs two
        assert len(SENT) - 2 <= len(heard(STREAM[:place] + STREAM[place + 1 :])) < len(SENT)


@given(st.integers(0, 2**32), st.sampled_from(sorted(SPOILS)))
def test_every_kind_of_damage_is_noticed(seed: int, kind: str) -> None:
    rng = Random(seed)
    line = rng.choice(LINES)
    assert heard(SPOILS[kind](line, rng)) in ([], [protocol.decode_line(line[:-1])])


@given(st.binary(max_size=600))
def test_noise_is_never_a_line(noise: bytes) -> None:
    assert not any(isinstance(event, protocol.Line) for event in protocol.LineParser().feed(noise + b"\n"))


@given(st.integers(0, len(STREAM)), st.integers(0, len(STREAM)))
def test_the_head_of_one_line_never_goes_with_the_tail_of_another(start: int, end: int) -> None:
    whole = STREAM[:start].count(b"\n") + STREAM[end:].count(b"\n")
    assert len(heard(STREAM[:start] + STREAM[end:])) >= whole - 1  # where the two meet one is lost


def test_endless_noise_without_an_end_of_line_takes_no_memory() -> None:
    parser = protocol.LineParser()
    for _ in range(1000):
        assert parser.feed(b"x" * 1000) == []
    assert len(parser._pending) <= protocol.MAX_BODY + 12
    events = parser.feed(b"\n" + LINES[0])
    assert [type(event) for event in events] == [protocol.Damaged, protocol.Line]
    assert isinstance(events[0], protocol.Damaged)
    assert events[0].why == "overlong"


@pytest.mark.parametrize(
    ("seq", "parts"),
    [(1, ()), (1, ("",)), (1, ("two words",)), (1, ("star*",)), (1, ("line\nend",)), (1, ("ä",)),
     (1, ("x" * 160,)), (-1, ("read",)), (65536, ("read",))],
)  # fmt: skip
def test_words_that_make_no_line_are_refused(seq: int, parts: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match=r"line|ascii"):
        protocol.encode_line(seq, *parts)


@pytest.mark.parametrize(
    "request_",
    [protocol.Hello(), protocol.Read(), protocol.Off(), protocol.Clear(), protocol.Grip(1),
     protocol.Drive(2000, 1, (1, -2)), protocol.Drive(1, 0, (0,))],
)  # fmt: skip
def test_a_question_reads_back(request_: protocol.Hello) -> None:
    assert protocol.parse_request(protocol.request_words(request_)) == request_


@pytest.mark.parametrize(
    "text",
    ["hello 1", "grip", "grip 2", "grip 0 1", "drive 1 1", "drive x 1 1", "drive 1 1 x", "drive 1 2 1",
     "drive 1 1 1 1"],
)  # fmt: skip
def test_a_question_with_the_wrong_words_is_refused(text: str) -> None:
    assert protocol.parse_request(text.split()) == "syntax"
    assert protocol.parse_request(["fly", *text.split()[1:]]) == "unknown"


def test_the_longest_line_is_whole() -> None:
    longest = protocol.encode_line(65535, "x" * 154)
    assert protocol.decode_line(longest[:-1]) == protocol.Line(65535, ("x" * 154,))
    with pytest.raises(ValueError, match="line"):
        protocol.encode_line(65535, "x" * 155)
    assert protocol.decode_line(b"a" * 172) == protocol.Damaged("overlong", b"a" * 171)


states = st.builds(
    protocol.State,
    mode=st.sampled_from(["off", "armed", "expired"]),
    uptime_ms=st.integers(0, 2**32 - 1),
    cause=st.sampled_from(["power", "watchdog"]),
    boot=st.integers(0, 65535),
    faults=st.just(()),
    pump=st.integers(0, 1),
    grip=st.integers(0, 1),
    drive=st.lists(st.integers(-(2**31), 2**31 - 1), min_size=1, max_size=2).map(tuple),
    temperatures=st.lists(
        st.integers(-273150, 10**6) | st.sampled_from(["open", "short"]), min_size=1, max_size=4
    ).map(tuple),
)


@given(states)
def test_a_state_reads_back(state: protocol.State) -> None:
    assert protocol.parse_state(state.words()) == state


@pytest.mark.parametrize(
    "text",
    [
        "armed 1 power 17 - 1 0 2500",  # a word is missing
        "armed 1 power 17 - 1 0 2500 +1",
        "armed 1 power 17 - 1 0 2500 1,",
        "armed 01 power 17 - 1 0 2500 1",
        "armed 1 power 65536 - 1 0 2500 1",
        "armed 1 lightning 17 - 1 0 2500 1",
        "armed 1 power 17 over:t_tank 1 0 2500 1",  # a fault, and yet not latched
        "latched 1 power 17 - 1 0 2500 1",
        "latched 1 power 17 hot:t_tank 1 0 2500 1",
        "armed 1 power 17 - 2 0 2500 1",
        "armed 4294967296 power 17 - 1 0 2500 1",
        "armed 1 power 17 - 1 0 2500 nan",
    ],
)
def test_a_state_that_makes_no_sense_is_malformed(text: str) -> None:
    with pytest.raises(ValueError, match=r"malformed|unpack"):
        protocol.parse_state(text.split())


@pytest.mark.parametrize(
    "text",
    ["thermogrip/2 0.1.0 drive:1:-1:1 pump t", "thermogrip/1 0.1.0 drive:1:1:-1 pump t",
     "thermogrip/1 0.1.0 drive:1:-1 pump t", "thermogrip/1 0.1.0 drive:1:-1:1 fan t",
     "thermogrip/1 0.1.0 drive:1:-1:1 pump T!", "thermogrip/1 0.1.0 drive:1:-1:1 pump"],
)  # fmt: skip
def test_an_identity_that_makes_no_sense_is_malformed(text: str) -> None:
    with pytest.raises(ValueError, match=r"malformed|unpack"):
        protocol.parse_identity(text.split())


def _answer(seq: int) -> bytes:
    return protocol.encode_line(seq, *LINES[2].split(b"*")[0].decode().split(" ")[1:])


def test_only_the_open_question_is_answered() -> None:
    host = protocol.HostEnd()
    host.ask(protocol.Read())
    host.ask(protocol.Read())
    late, answered, twice = host.hear(_answer(1) + _answer(2) + _answer(2))
    assert (type(late), late.why) == (protocol.Unexpected, "late")
    assert isinstance(answered, protocol.Answer)
    assert (type(twice), twice.why) == (protocol.Unexpected, "duplicate")


def test_an_echo_is_distinguished_from_an_answer() -> None:
    host = protocol.HostEnd()
    (echo,) = host.hear(host.ask(protocol.Read()))
    assert (type(echo), echo.why) == (protocol.Unexpected, "echo")
    assert isinstance(host.hear(_answer(1))[0], protocol.Answer)  # the question is open still


def test_an_answer_of_another_shape_than_the_device_has_is_not_used() -> None:
    host, core = protocol.HostEnd(), DeviceCore()
    host.hear(core.receive(host.ask(protocol.Hello()), 0))
    host.ask(protocol.Read())
    two_drives = protocol.State("armed", 1, "power", 17, (), 1, 0, (1, 2), (25000, 25000, 25000))
    (odd,) = host.hear(protocol.encode_line(2, "ok", *two_drives.words()))
    assert isinstance(odd, protocol.Unexpected)
    assert odd.why == "content"


def test_a_reset_is_announced_damage_is_reported_and_an_unknown_refusal_is_not_used() -> None:
    host = protocol.HostEnd()
    assert host.hear(DeviceCore(cause="watchdog", boot=18, serial=5309).announcement()) == [
        protocol.Boot("watchdog", 18, "0.2.0+5309")
    ]
    assert host.hear(DeviceCore().receive(b"7 reed*06EC819405\n", 0)) == [protocol.Refused(None, "corrupt")]
    host.ask(protocol.Read())
    (odd,) = host.hear(protocol.encode_line(1, "err", "mood"))
    assert isinstance(odd, protocol.Unexpected)


def test_sequence_numbers_go_round_and_leave_out_zero() -> None:
    host = protocol.HostEnd()
    seen = [int(host.ask(protocol.Read()).split()[0]) for _ in range(65537)]
    assert seen[:2] == [1, 2]
    assert seen[-2:] == [1, 2]
    assert 0 not in seen


@pytest.mark.parametrize(
    ("text", "want"),
    [("boot power 0 0.1.0", protocol.Boot("power", 0, "0.1.0")),
     ("boot unknown 65535 2", protocol.Boot("unknown", 65535, "2")), ("boot power 65536 0.1.0", None),
     ("boot power -1 0.1.0", None), ("boot mood 0 0.1.0", None), ("boot power 0 v!", None),
     ("boot power 0", None), ("boat power 0 0.1.0", None), ("err range", None)],
)  # fmt: skip
def test_a_device_announces_a_reset_and_nothing_else(text: str, want: protocol.Event | None) -> None:
    (event,) = protocol.HostEnd().hear(protocol.encode_line(0, *text.split()))
    assert event == (want or protocol.Unexpected("content", protocol.Line(0, tuple(text.split()))))
