"""The firmware's core, compiled on this computer, does what the reference in Python does, byte for byte."""

from __future__ import annotations

import math
import re
import shutil
import subprocess
from importlib.resources import files
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from thermogrip.rig.device_core import Board, DeviceCore, Sensor, Value
from thermogrip.rig.framing import encode_line
from thermogrip.rig.protocol import Channel, State

GRIPPER = Board(
    sensors=(
        Sensor("t_tank", 2_000, 60_000),
        Sensor("t_surface", 3_000, 55_000),
        Sensor("t_ambient", guarded=False),
    )
)
LAB = Board(
    drives=(Channel("q1", "percent", 0, 1_000_000), Channel("q2", "percent", 0, 1_000_000)),
    sensors=(Sensor("t1", 2_000, 80_000), Sensor("t2", 2_000, 80_000)),
    pump=False,
    tachometer=False,
)
BOARDS = {"gripper": GRIPPER, "lab": LAB}
SPECIFICATION = Path(__file__).parents[2] / "docs" / "reference" / "protocol.md"


@pytest.fixture(scope="session")
def firmware(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the core with every warning an error and the sanitizers in."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("no g++ on this computer: the firmware cannot be built here")
    out = tmp_path_factory.mktemp("firmware") / "host"
    sketch = Path(str(files("thermogrip.rig"))) / "firmware"
    flags = ["-std=c++11", "-O1", "-Wall", "-Wextra", "-Werror", "-Wconversion"]
    flags += ["-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-I", str(sketch)]
    sources = [*map(str, sorted(sketch.glob("*.cpp"))), str(Path(__file__).with_name("firmware_host.cpp"))]
    subprocess.run([compiler, *flags, *sources, "-o", str(out)], check=True, timeout=300)
    return out


def compiled(firmware: Path, script: list[str]) -> str:
    """Return what the compiled core says to a script."""
    done = subprocess.run(
        [str(firmware)],
        input="\n".join(script) + "\n",
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def reference(script: list[str]) -> str:
    """Return what the core in Python says to the same script."""
    board, core, out = GRIPPER, DeviceCore(), b""
    for line in script:
        word, *rest = line.split()
        if word == "board":
            board = BOARDS[rest[0]]
        elif word == "begin":
            core = DeviceCore(board, rest[0], int(rest[1]), int(rest[2]))
            out += core.announcement()
        elif word == "bytes":
            out += core.receive(bytes.fromhex(rest[0]), int(rest[1]))
        elif word == "sample":
            values: list[Value] = [text if text.isalpha() else int(text) for text in rest[2:]]
            core.sample(values, flow=rest[0] == "1", now_ms=int(rest[1]))
        elif word == "keep" and core.ring.due(int(rest[0])):
            core.keep([text if text.isalpha() else int(text) for text in rest[1:]], int(rest[0]))
        elif word == "pins":
            pins = core.outputs
            numbers = [pins.enable, *pins.drive, pins.pump, pins.grip]
            out += ("pins " + " ".join(map(str, numbers)) + "\n").encode()
    return out.decode()


def say(seq: int, *words: str, now: int) -> str:
    return f"bytes {encode_line(seq, *words).hex()} {now}"


WARM = "1 {now} 25000 25000 25000"
START = ["board gripper", "begin power 7 0", "sample " + WARM.format(now=0), say(1, "hello", now=5)]


def last_state(text: str) -> list[str]:
    """Return the words of the last state in what a core said."""
    lines = [line for line in text.splitlines() if " ok " in line]
    return lines[-1].split("*")[0].split(" ")[2:]


SCRIPTS = {
    "a drive expires": [
        *START,
        say(2, "drive", "2000", "1", "-2500", now=10),
        "pins",
        "sample " + WARM.format(now=2009),
        "pins",
        "sample " + WARM.format(now=2010),
        "pins",
        say(3, "read", now=2020),
    ],
    "a repeated question does nothing twice": [
        *START,
        say(2, "drive", "500", "1", "100", now=10),
        say(2, "drive", "500", "1", "100", now=400),
        "sample " + WARM.format(now=520),
        "pins",
    ],
    "an open sensor latches at the fourth sample": [
        *START,
        say(2, "drive", "2000", "1", "5000", now=10),
        *[f"sample 1 {100 * k} open 25000 25000" for k in range(1, 4)],
        "pins",
        "sample 1 400 open 25000 25000",
        "pins",
        say(3, "drive", "2000", "1", "5000", now=410),
        say(4, "clear", now=420),
        "sample " + WARM.format(now=500),
        say(5, "clear", now=510),
        say(6, "drive", "2000", "1", "5000", now=520),
        "pins",
    ],
    "too warm and too cold latch": [
        *START,
        *[f"sample 1 {100 * k} 60001 2999 99000" for k in range(1, 5)],
        say(3, "read", now=410),
        say(4, "off", now=420),
        "pins",
    ],
    "a pump that stands still latches": [
        *START,
        say(2, "drive", "2000", "1", "5000", now=10),
        "sample 0 100 25000 25000 25000",
        say(3, "drive", "2000", "1", "5000", now=1900),
        "sample 0 3009 25000 25000 25000",
        "pins",
        "sample 0 3010 25000 25000 25000",
        "pins",
        say(4, "read", now=3020),
        say(5, "clear", now=3030),
        say(6, "drive", "2000", "1", "5000", now=3040),
        "sample 0 3050 25000 25000 25000",
        "pins",
        say(7, "drive", "2000", "1", "5000", now=5000),
        "sample 0 6040 25000 25000 25000",
        "pins",
    ],
    "what is refused": [
        "begin watchdog 65535 0",
        say(1, "drive", "2000", "1", "0", now=1),
        say(2, "hello", now=2),
        say(3, "drive", "2000", "0", "1", now=3),
        say(4, "drive", "2001", "1", "1", now=4),
        say(5, "drive", "0", "1", "1", now=5),
        say(6, "drive", "9", "1", "10001", now=6),
        say(7, "drive", "9", "1", "1,1", now=7),
        say(8, "drive", "9", "1", "-0", now=8),
        say(9, "drive", "9", now=9),
        say(10, "fire", now=10),
        say(11, "grip", "2", now=11),
        say(12, "grip", "1", now=12),
        say(13, "read", "x", now=13),
        say(14, "drive", "2000", "0", "0", now=14),
        "pins",
    ],
    "damage, echoes and empty lines": [
        *START,
        "bytes 0a0a 10",
        "bytes 3720726561642a304543383131 11",
        "bytes ff0a 12",
        say(9, "ok", "off", now=13),
        say(0, "boot", "x", now=14),
        "bytes " + "41" * 400 + "0a 15",
        say(10, "read", now=16),
    ],
    "the clock wraps after 49 days": [
        "begin power 1 4294967000",
        "sample 1 4294967000 25000 25000 25000",
        say(1, "hello", now=4294967001),
        say(2, "drive", "1000", "1", "7", now=4294967290),
        "sample 1 990 25000 25000 25000",
        "pins",
        "sample 1 994 25000 25000 25000",
        "pins",
        say(3, "read", now=1000),
    ],
    "readings by the device's own clock": [
        *START,
        say(2, "take", "0", now=6),
        say(3, "sample", "9", now=7),
        say(4, "sample", "1001", now=8),
        say(5, "sample", "x", now=9),
        say(6, "sample", "10", now=10),
        "keep 9 1 1 1",
        "keep 10 25000 -25000 open",
        "keep 11 1 1 1",
        say(7, "drive", "2000", "1", "-2500", now=12),
        "keep 20 25001 short 273150",
        "keep 47 25002 25000 25000",  # two ticks too late
        say(8, "take", "0", now=48),
        say(8, "take", "0", now=49),
        say(9, "take", "1", now=50),
        say(10, "take", "5", now=51),
        say(11, "take", "4294967295", now=52),
        say(12, "take", "4", now=53),
        say(13, "take", now=54),
        say(14, "sample", "0", now=55),
        say(15, "take", "0", now=56),
    ],
    "a ring that nobody empties keeps the newest": [
        *START,
        say(2, "sample", "10", now=0),
        *[f"keep {10 * k} {25000 + k} 25000 25000" for k in range(60)],
        say(3, "take", "0", now=600),
        say(4, "take", "36", now=601),
        say(5, "take", "59", now=602),
    ],
    "readings across the end of the clock, and a device that stood still": [
        "begin power 1 4294967200",
        say(1, "sample", "1000", now=4294967200),
        "keep 4294967200 25000 25000 25000",
        "keep 904 25001 25000 25000",
        say(2, "take", "0", now=905),
        "keep 500000 25002 25000 25000",
        say(3, "take", "0", now=500001),
        say(4, "take", "500", now=500002),
    ],
    "two drives and no pump": [
        "board lab",
        "begin power 1 0",
        "sample 0 0 25000 25000",
        say(1, "hello", now=1),
        say(2, "drive", "2000", "0", "500000,1000000", now=2),
        "pins",
        "sample 0 5000 25000 25000",
        "pins",
        say(3, "sample", "20", now=5001),
        *[f"keep {5001 + 20 * k} -1{k:02d}000 25000" for k in range(30)],
        say(4, "take", "0", now=5600),
    ],
}


@pytest.mark.parametrize("name", SCRIPTS)
def test_both_cores_say_the_same(firmware: Path, name: str) -> None:
    script = SCRIPTS[name]
    assert compiled(firmware, script) == reference(script)


def test_a_drive_ends_after_its_time_and_not_before() -> None:
    pins = [line for line in reference(SCRIPTS["a drive expires"]).splitlines() if line.startswith("pins")]
    assert pins == ["pins 1 -2500 1 0", "pins 1 -2500 1 0", "pins 0 0 0 0"]
    assert last_state(reference(SCRIPTS["a drive expires"]))[0] == "expired"


def test_a_repeated_drive_does_not_live_longer() -> None:
    assert reference(SCRIPTS["a repeated question does nothing twice"]).endswith("pins 0 0 0 0\n")


def test_a_latch_holds_until_its_cause_is_over_and_it_is_cleared() -> None:
    said = reference(SCRIPTS["an open sensor latches at the fourth sample"])
    assert re.findall(r"err (\w+)|pins (\d)", said) == [
        ("", "1"),
        ("", "0"),
        ("latched", ""),
        ("active", ""),
        ("", "1"),
    ]


def test_a_lost_room_sensor_is_no_reason_to_stop() -> None:
    script = [*START, *[f"sample 1 {100 * k} 25000 25000 open" for k in range(1, 9)]]
    assert last_state(reference([*script, say(2, "read", now=900)]))[::4] == ["off", "-", "25000,25000,open"]


def test_what_is_out_of_limits_is_named() -> None:
    said = reference(SCRIPTS["too warm and too cold latch"])
    assert last_state(said)[4] == "over:t_tank,under:t_surface"


def test_a_stalled_pump_switches_off_after_three_seconds_and_has_them_again_when_it_was_cleared() -> None:
    said = reference(SCRIPTS["a pump that stands still latches"])
    assert re.findall(r"pins (\d)", said) == ["1", "0", "1", "0"]
    assert "pump" in said


def test_refusals_name_their_reason() -> None:
    said = reference(SCRIPTS["what is refused"])
    codes = re.findall(r"err (\w+)", said)
    assert codes == [
        "hello",
        "interlock",
        "ttl",
        "ttl",
        "range",
        "syntax",
        "syntax",
        "syntax",
        "unknown",
        "syntax",
        "syntax",
    ]
    assert said.endswith("pins 0 0 0 1\n")  # nothing was driven, only the gripper closed


_QUESTIONS = st.sampled_from(
    [
        ("hello",),
        ("read",),
        ("off",),
        ("clear",),
        ("grip", "1"),
        ("grip", "0"),
        ("drive", "2000", "1", "2500"),
        ("drive", "300", "1", "-10000"),
        ("drive", "2000", "0", "0"),
        ("drive", "2000", "0", "5"),
        ("drive", "1", "1", "10001"),
        ("drive", "007", "1", "1"),
        ("drive", "9", "1", "1,"),
        ("ok",),
        ("err", "x"),
        ("drive", "99999999999", "1", "1"),
        ("drive", "5", "1", "4294967296"),
        ("read", "read"),
        ("xyz",),
        ("a", "b", "c", "d", "e", "f", "g", "h", "i"),
        ("sample", "10"),
        ("sample", "1000"),
        ("sample", "0"),
        ("sample", "-10"),
        ("take", "0"),
        ("take", "2"),
        ("take", "7"),
        ("take", "4294967290"),
    ]
)
_TEMPERATURES = st.sampled_from(["25000", "60001", "60000", "1999", "-5000", "open", "short", "2147483"])


@st.composite
def conversations(draw: st.DrawFn) -> list[str]:
    """Return a script of anything in any order, with damage."""
    now, script = 0, ["board gripper", "begin external 3 0", "sample 1 0 25000 25000 25000"]
    for _ in range(draw(st.integers(1, 40))):
        now += draw(st.sampled_from([0, 1, 100, 300, 1999, 2001, 70000]))
        kind = draw(st.sampled_from(["ask", "ask", "sample", "sample", "keep", "noise", "pins"]))
        if kind == "ask":
            script.append(say(draw(st.integers(0, 4)), *draw(_QUESTIONS), now=now))
        elif kind == "noise":
            line = bytearray(encode_line(draw(st.integers(0, 65535)), *draw(_QUESTIONS)))
            line[draw(st.integers(0, len(line) - 1))] ^= draw(st.integers(1, 255))
            cut = bytes(line)[: draw(st.integers(1, len(line)))]
            script.append(f"bytes {cut.hex()} {now}")
        elif kind == "sample":
            values = " ".join(draw(_TEMPERATURES) for _ in range(3))
            script += [f"sample {draw(st.integers(0, 1))} {now} {values}"] * draw(st.integers(1, 5))
        elif kind == "keep":
            values = " ".join(draw(_TEMPERATURES) for _ in range(3))
            script += [f"keep {now + 10 * k} {values}" for k in range(draw(st.integers(1, 30)))]
            now += 300
        else:
            script.append("pins")
    return [*script, "pins"]


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(script=conversations())
def test_whatever_comes_both_cores_say_the_same(firmware: Path, script: list[str]) -> None:
    assert compiled(firmware, script) == reference(script)


def test_the_firmware_takes_the_lines_of_the_specification_and_no_bad_one(firmware: Path) -> None:
    _, right_and_wrong = SPECIFICATION.read_text().split("## Lines that are right")
    right, wrong = right_and_wrong.split("## Lines that are not")
    for part, damaged in ((right, False), (wrong, True)):
        texts = re.findall(r"^\| `([^`]+)` \|", part, flags=re.MULTILINE)
        assert len(texts) > 5
        for text in texts:
            said = compiled(firmware, ["begin power 1 0", f"bytes {text.encode().hex()}0a 1"])
            assert ("err corrupt" in said) == damaged, text


@pytest.mark.parametrize("n", [1, 8, 64])
def test_the_thermistor_follows_its_beta_equation(firmware: Path, n: int) -> None:
    sums = range(8 * n, 1015 * n + 1, 7 * n + 1)
    got = [float(text) / 1000 for text in compiled(firmware, [f"ntc {k} {n}" for k in sums]).split()]
    for k, degC in zip(sums, got, strict=True):
        ohm = 10_000 * (k / (1023 * n)) / (1 - k / (1023 * n))
        exact = 1 / (1 / 298.15 + math.log(ohm / 10_000) / 3950) - 273.15
        assert degC == pytest.approx(exact, abs=0.003)


def test_a_converter_at_its_end_is_an_open_or_a_shorted_sensor(firmware: Path) -> None:
    for n in (1, 8, 64):
        sums = (0, 8 * n - 1, 1015 * n + 1, 1023 * n)
        said = compiled(firmware, [f"ntc {k} {n}" for k in sums]).split()
        assert said == ["short", "short", "open", "open"]


def test_a_compiler_reads_the_sketch() -> None:
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("no g++ on this computer: the sketch cannot be read here")
    sketch = Path(str(files("thermogrip.rig"))) / "firmware"
    stub = Path(__file__).with_name("arduino_stub")
    flags = ["-std=c++11", "-fsyntax-only", "-Wall", "-Wextra", "-Werror", "-Wno-attributes"]
    flags += ["-I", str(stub), "-I", str(sketch), "-include", str(stub / "Arduino.h"), "-x", "c++"]
    subprocess.run([compiler, *flags, str(sketch / "firmware.ino")], check=True, timeout=120)


@pytest.mark.parametrize(("extra", "fits"), [("", True), ("_of_the_second_loop_in_the_left_room" * 2, False)])
def test_names_that_would_cut_a_line_off_do_not_compile(extra: str, fits: bool, tmp_path: Path) -> None:
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("no g++ on this computer: the sketch cannot be read here")
    sketch = Path(str(files("thermogrip.rig"))) / "firmware"
    for path in sketch.iterdir():
        (tmp_path / path.name).write_text(path.read_text().replace('{"t_tank"', f'{{"t_tank{extra}"'))
    stub = Path(__file__).with_name("arduino_stub")
    flags = ["-std=c++11", "-fsyntax-only", "-Wall", "-Wextra", "-Werror"]
    flags += ["-I", str(stub), "-I", str(tmp_path), "-include", str(stub / "Arduino.h"), "-x", "c++"]
    command = [compiler, *flags, str(tmp_path / "firmware.ino")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode == 0) == fits, done.stderr
    assert fits or "the names are too long for a line" in done.stderr


@pytest.mark.parametrize("board", BOARDS)
def test_the_longest_lines_are_as_long_as_the_sketch_says(board: str, tmp_path: Path) -> None:
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("no g++ on this computer: the firmware cannot be built here")
    it = BOARDS[board]
    core = DeviceCore(it, "watchdog", 65535)
    lowest = tuple(max((c.low, c.high), key=lambda n: len(str(n))) for c in it.drives)
    faults = tuple(f"short:{s.name}" for s in it.sensors if s.guarded) + ("pump",) * it.tachometer
    cold = (-273150,) * len(it.sensors)
    whole = [
        State("expired", 2**32 - 1, "watchdog", 65535, (), 1, 1, lowest, cold),
        State("latched", 2**32 - 1, "watchdog", 65535, faults, 0, 1, (0,) * len(lowest), cold),
    ]
    states = [len(encode_line(65535, "ok", *state.words())) for state in whole]
    lengths = [len(encode_line(65535, "ok", *core.identity.words())), max(states)]
    host = Path(__file__).with_name("firmware_host.cpp").read_text()
    sums = [f"longest_{what}({board.upper()}) == {n - 12}" for what, n in zip(("identity", "state"), lengths)]
    asserts = "".join(f'static_assert({said}, "{said}");' for said in sums)
    (tmp_path / "host.cpp").write_text(host.replace("static const", "static constexpr") + asserts)
    sketch = Path(str(files("thermogrip.rig"))) / "firmware"
    command = [compiler, "-std=c++11", "-fsyntax-only", "-I", str(sketch), str(tmp_path / "host.cpp")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr


def test_the_sketch_uses_every_pin_that_it_configures() -> None:
    sketch = Path(str(files("thermogrip.rig"))) / "firmware"
    used = (sketch / "firmware.ino").read_text()
    pins = re.findall(r"\bPIN_\w+", (sketch / "config.h").read_text())
    assert pins
    assert all(pin in used for pin in pins)
