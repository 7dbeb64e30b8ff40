"""The sketch around the firmware's core: a compiler reads it, and its lines are never too long."""

from __future__ import annotations

import re
import shutil
import subprocess
from importlib.resources import files
from pathlib import Path

import pytest

from tests.rig.cores import BOARDS
from thermogrip.mpc.design.spec import Spec
from thermogrip.rig.firmware.reference import SERIALS, DeviceCore
from thermogrip.rig.guard.guard import LIMIT_MARGIN, Guard
from thermogrip.rig.guard.settings import GuardSettings
from thermogrip.rig.serial.protocol import State, encode_line
from thermogrip.rig.simulation.virtual_device import example_plant

SKETCH = Path(str(files("thermogrip.rig"))) / "firmware"
STUB = Path(__file__).parents[1] / "arduino_stub"


def compiled(*words: str | Path) -> subprocess.CompletedProcess[str]:
    """Let a compiler read a file."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("no g++ on this computer: the sketch cannot be read here")
    command = [compiler, "-std=c++11", "-fsyntax-only", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.parametrize(("extra", "fits"), [("", True), ("_of_the_second_loop_in_the_left_room" * 2, False)])
def test_a_compiler_reads_the_sketch_unless_names_would_cut_a_line_off(
    extra: str, fits: bool, tmp_path: Path
) -> None:
    for path in (p for p in SKETCH.iterdir() if p.suffix in {".h", ".cpp", ".ino"}):
        (tmp_path / path.name).write_text(path.read_text().replace('{"t_tank"', f'{{"t_tank{extra}"'))
    flags = ["-Wall", "-Wextra", "-Werror", "-Wno-attributes", "-I", STUB, "-I", tmp_path]
    done = compiled(*flags, "-include", STUB / "Arduino.h", "-x", "c++", tmp_path / "firmware.ino")
    assert (done.returncode == 0) == fits, done.stderr
    assert fits or "the names are too long for a line" in done.stderr


@pytest.mark.parametrize("board", BOARDS)
def test_the_longest_lines_are_as_long_as_the_sketch_says(board: str, tmp_path: Path) -> None:
    it = BOARDS[board]
    core = DeviceCore(it, "watchdog", 65535, serial=SERIALS - 1)
    lowest = tuple(max((c.low, c.high), key=lambda n: len(str(n))) for c in it.drives)
    faults = tuple(f"short:{s.name}" for s in it.sensors if s.guarded) + ("pump",) * it.tachometer
    cold = (-273150,) * len(it.sensors)
    whole = [
        State("expired", 2**32 - 1, "watchdog", 65535, (), 1, 1, lowest, cold),
        State("latched", 2**32 - 1, "watchdog", 65535, faults, 0, 1, (0,) * len(lowest), cold),
    ]
    states = [len(encode_line(65535, "ok", *state.words())) for state in whole]
    lengths = [len(encode_line(65535, "ok", *core.identity.words())), max(states)]
    host = (Path(__file__).parents[1] / "firmware_host.cpp").read_text()
    sums = [f"longest_{what}({board.upper()}) == {n - 12}" for what, n in zip(("identity", "state"), lengths)]
    asserts = "".join(f'static_assert({said}, "{said}");' for said in sums)
    (tmp_path / "host.cpp").write_text(host.replace("static const", "static constexpr") + asserts)
    done = compiled("-I", SKETCH, tmp_path / "host.cpp")
    assert done.returncode == 0, done.stderr


def test_tune_stays_inside_of_what_the_guard_and_the_device_allow() -> None:
    plant, sketch = example_plant(), (SKETCH / "config.h").read_text()
    guard = Guard(plant, GuardSettings.of(plant))
    limits = re.findall(r'{"(\w+)", (\d+), (\d+), true}', sketch)
    assert limits
    for name, low, high in limits:
        assert guard.limits_of(name) == (int(low) / 1e3, int(high) / 1e3)
    [(tank, (least, most))] = Spec().design(plant).limits.items()
    low, high = guard.limits_of(tank)
    assert low + LIMIT_MARGIN <= least < most <= high - LIMIT_MARGIN


def test_the_sketch_uses_every_pin_that_it_configures() -> None:
    used = (SKETCH / "firmware.ino").read_text()
    pins = re.findall(r"\bPIN_\w+", (SKETCH / "config.h").read_text())
    assert pins
    assert all(pin in used for pin in pins)
