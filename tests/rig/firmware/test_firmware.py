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

from tests.rig.cores import SCRIPTS, reference, say
from thermogrip.rig.serial.protocol import encode_line

SPECIFICATION = Path(__file__).parents[3] / "docs" / "reference" / "protocol.md"


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
    sources = [*map(str, sorted(sketch.glob("*.cpp"))), str(Path(__file__).parents[1] / "firmware_host.cpp")]
    subprocess.run([compiler, *flags, *sources, "-o", str(out)], check=True, timeout=300)
    return out


def compiled(firmware: Path, script: list[str]) -> str:
    """Return what the compiled core says to a script."""
    lines, options = "\n".join(script) + "\n", {"capture_output": True, "text": True, "timeout": 600}
    done = subprocess.run([str(firmware)], input=lines, check=False, **options)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("name", SCRIPTS)
def test_both_cores_say_the_same(firmware: Path, name: str) -> None:
    script = SCRIPTS[name]
    assert compiled(firmware, script) == reference(script)


_QUESTIONS = st.sampled_from([
    "hello", "read", "off", "clear", "grip 1", "grip 0", "drive 2000 1 2500", "drive 300 1 -10000",
    "drive 2000 0 0", "drive 2000 0 5", "drive 1 1 10001", "drive 007 1 1", "drive 9 1 1,", "ok", "err x",
    "drive 99999999999 1 1", "drive 5 1 4294967296", "read read", "xyz", "a b c d e f g h i",
]).map(str.split)  # fmt: skip
_TEMPERATURES = st.sampled_from(["25000", "60001", "60000", "1999", "-5000", "open", "short", "2147483"])


@st.composite
def conversations(draw: st.DrawFn) -> list[str]:
    """Return a script of anything in any order, with damage."""
    now, script = 0, ["board gripper", "begin external 3 0", "sample 1 0 25000 25000 25000"]
    for _ in range(draw(st.integers(1, 40))):
        now += draw(st.sampled_from([0, 1, 100, 300, 1999, 2001, 70000]))
        kind = draw(st.sampled_from(["ask", "ask", "sample", "sample", "noise", "pins"]))
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
        else:
            script.append("pins")
    return [*script, "pins"]


@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
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
