"""The command that a trip runs: what it gets, and that nothing waits for it or fails with it."""

from __future__ import annotations

import json
import os
import shlex
import signal
import sys
import threading
import tracemalloc
from dataclasses import asdict
from pathlib import Path
from select import select

import pytest

from tests.end_to_end.conftest import Bench
from tests.end_to_end.conftest import bench as bench
from tests.rig.makers import PATIENCE_S
from thermogrip.datasets.errors import UserError
from thermogrip.live import trip_command
from thermogrip.live.trip_command import TripCommand
from thermogrip.mpc import Controller
from thermogrip.rig.guard.trip import Trip
from thermogrip.sysid.plant.plant import Plant

TRIP = Trip("limit", 12.5, "skin \udcff", "3 to 55 degC", "61.00 degC")


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
    sent = {**asdict(TRIP), "subject": "skin ?"}
    assert json.loads(out.read_text()) == sent
    assert sent["clear"]


def test_nobody_waits_for_it_and_its_failure_is_reported(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    reports: list[str] = []
    go = tmp_path / "go"
    waiting = f"import os, time\nwhile not os.path.exists({str(go)!r}): time.sleep(0.01)"
    patient = TripCommand(python(waiting), reports.append)
    patient.start(TRIP)
    go.touch()  # after the start has returned
    patient.join()
    assert reports == []
    monkeypatch.setattr(trip_command, "LONGEST_S", 0.3)
    command = TripCommand(python("import time; time.sleep(600)"), reports.append)
    command.start(TRIP)
    failing = TripCommand(python("raise SystemExit('no \\x1b[31mmail')"), reports.append)
    command.join()
    monkeypatch.setattr(trip_command, "LONGEST_S", 60.0)
    failing.start(TRIP)
    failing.join()
    assert len(reports) == 2
    assert "not done after 0.3 s, ended" in reports[0]
    assert "exit code 1 no " in reports[1]
    assert "\x1b" not in reports[1]


def test_of_what_it_prints_the_last_line_alone_is_kept() -> None:
    reports: list[str] = []
    code = "import sys\nfor _ in range(64): sys.stderr.write('x' * 999_999 + '\\n')\nsys.exit('full')"
    command = TripCommand(python(code), reports.append)
    tracemalloc.start()
    command.start(TRIP)
    command.join()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert reports[0].endswith("exit code 1 full")
    assert peak < 4e6


@pytest.mark.skipif(sys.platform == "win32", reason="no process groups there")
@pytest.mark.parametrize("how", ["it takes too long", "the program is stopped"])
def test_what_it_started_ends_with_it(how: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trip_command, "LONGEST_S", 1.0 if how == "it takes too long" else 600.0)
    lives = tmp_path / "lives"
    os.mkfifo(lives)
    seen = os.open(lives, os.O_RDONLY | os.O_NONBLOCK)
    command = TripCommand(f"sh -c '(echo begun; exec sleep 600) > {lives} & wait'", print)
    command.start(TRIP)
    assert select([seen], [], [], PATIENCE_S)[0]
    assert os.read(seen, 100) == b"begun\n"
    if how == "the program is stopped":
        threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
        with pytest.raises(KeyboardInterrupt):
            command.join()
    assert select([seen], [], [], PATIENCE_S)[0]
    assert os.read(seen, 100) == b""  # nobody can write there any more
    os.close(seen)


SECRET = "hunter2"


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (f"no-such-program {SECRET}", "there is no such program: 'no-such-program'; name one"),
        ("", "no such program"),
        (f"mail '{SECRET}", r"'--on-trip' is no command \(No closing quotation\); close"),
    ],
)
def test_what_cannot_be_run_is_refused_before_the_session(line: str, words: str) -> None:
    with pytest.raises(UserError, match=words) as refused:
        TripCommand(line, print)
    assert SECRET not in str(refused.value)


@pytest.mark.parametrize("given", [["--on-trip", f"true {SECRET}"], [f"--on-trip=true {SECRET}"]])
def test_no_record_of_a_session_has_its_words(given: list[str], bench: Bench) -> None:
    Controller(Plant.load("plant.json")).save("c.json")
    words = ["run", "c.json", "--target", "38", "--twin", "plant.json", "--out", "run"]
    done = bench.run(*words, "--settle-timeout", "5", "--report", "r.html", *given)
    assert done.code == 3, done.err  # it has not settled by then
    written = [path for path in bench.path.rglob("*") if path.is_file()]
    assert not [path for path in written if SECRET.encode() in path.read_bytes()]
    assert SECRET not in done.out + done.err
    command = json.loads((bench.path / "run" / "run.json").read_text())["provenance"]["command"]
    assert "true ..." in command
