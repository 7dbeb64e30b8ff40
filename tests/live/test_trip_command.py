"""The command that a trip runs: what it gets, and that nothing waits for it or fails with it."""

from __future__ import annotations

import json
import shlex
import sys
import time
from pathlib import Path

import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.live import trip_command
from thermogrip.live.trip_command import TripCommand
from thermogrip.rig.guard.trip import Trip

TRIP = Trip("limit", 12.5, "t_surface", "3 to 55 degC", "61.00 degC", figures={"measured": float("inf")})


def python(code: str, *words: str) -> str:
    """Return the command line of a program in Python."""
    return shlex.join([sys.executable, "-c", code, *words])


def test_it_gets_the_trip_as_json_and_its_words_as_they_are(tmp_path: Path) -> None:
    reports: list[str] = []
    out = tmp_path / "a b; $HOME.json"
    code = "import sys; open(sys.argv[1], 'w').write(sys.stdin.read())"
    command = TripCommand(python(code, str(out)), reports.append)
    command.start(TRIP)
    command.join()
    assert reports == []
    assert json.loads(out.read_text()) == {**TRIP.as_dict(), "figures": {"measured": None}}
    assert TRIP.as_dict()["clear"]


def test_nobody_waits_for_it_and_its_failure_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    reports: list[str] = []
    monkeypatch.setattr(trip_command, "LONGEST_S", 0.3)
    begin = time.monotonic()
    command = TripCommand(python("import time; time.sleep(600)"), reports.append)
    command.start(TRIP)
    assert time.monotonic() - begin < 0.25
    failing = TripCommand(python("raise SystemExit('no \\x1b[31mmail')"), reports.append)
    command.join()
    monkeypatch.setattr(trip_command, "LONGEST_S", 60.0)
    failing.start(TRIP)
    failing.join()
    assert len(reports) == 2
    assert "not done after 0.3 s, ended" in reports[0]
    assert "exit code 1 no " in reports[1]
    assert "\x1b" not in reports[1]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("no-such-program --now", "there is no such program"),
        ("", "no such program"),
        ("mail 'x", "is no command"),
    ],
)
def test_what_cannot_be_run_is_refused_before_the_session(line: str, words: str) -> None:
    with pytest.raises(UserError, match=words):
        TripCommand(line, print)
