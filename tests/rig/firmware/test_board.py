"""The sketch as it is, compiled for an Arduino Uno and run on a simulated chip, where the tools are there."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[3] / "benchmarks" / "rig" / "board.py"
MISSING = 77


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs a pty")
def test_an_arduino_uno_does_what_the_firmware_specifies() -> None:
    words = [sys.executable, str(SCRIPT), "--board", "Uno"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300, check=False)
    if done.returncode == MISSING:
        pytest.skip(done.stdout.strip())
    assert done.returncode == 0, done.stdout + done.stderr
    assert "FAIL" not in done.stdout
