"""What shows a session: the loop waits for none of it."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from contextlib import suppress
from dataclasses import replace
from importlib import util
from urllib.request import Request, urlopen

import pytest

from tests.live.test_terminal import NOW, TRIP
from thermogrip.datasets.errors import UserError
from thermogrip.live import watch as module
from thermogrip.live.watch import Show, Watch
from thermogrip.report.console import Console


def test_a_page_that_hangs_holds_up_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "WATCH", replace(module.WATCH, goodbye_s=0.5))
    with Watch("run", Console(), Show(live=0)) as watch:
        page = watch.page
        assert page is not None
        os.kill(page.pid, signal.SIGSTOP)
        wide = replace(NOW, values={f"t_{k}": float(k) for k in range(200)})
        # who waited for the page would wait here: more than the queue and the pipe to it hold
        for _ in range(3 * module.WATCH.keep):
            watch.listen(wide)
        assert len(watch._queue) <= module.WATCH.keep  # the oldest are dropped
    assert page.poll() is not None


def test_without_a_terminal_there_is_a_line_a_second_at_most(capsys: pytest.CaptureFixture[str]) -> None:
    begin = time.monotonic()
    with Watch("record", Console()) as watch:
        for k in range(120):
            watch.listen(replace(NOW, time_s=float(k)))
            time.sleep(0.01)
        watch.listen(replace(NOW, time_s=999.0, trip=TRIP, verdict="tripped"))
    lines = capsys.readouterr().err.splitlines()
    assert 2 <= len(lines) <= 2 + (time.monotonic() - begin)
    assert lines[-1].endswith(TRIP.line())
    assert all(line.startswith("record   0 % ; ") and "t_surface 37.90 degC" in line for line in lines)


def test_work_that_shows_no_session_shows_its_progress(capsys: pytest.CaptureFixture[str]) -> None:
    with Watch("batch", Console()) as watch:
        watch.progress(0.5, "trial 2 of 4: copper")
    assert capsys.readouterr().err == "batch  50 % trial 2 of 4: copper\n"


@pytest.mark.parametrize("extra", ["live", "foxglove"])
def test_a_missing_package_is_one_line(extra: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    assert util.find_spec("starlette")
    with pytest.raises(UserError, match=rf'--{extra} needs .*; pip install "thermogrip\[{extra}\]"'):
        Watch("run", Console(), Show(**{extra: 0}))


def test_without_a_page_questions_are_asked_on_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    monkeypatch.setattr("typer.prompt", lambda text, **_: (asked.append(text), " q ")[1])
    with Watch("batch", Console()) as watch:
        assert watch.ask("ready \x1b[2J?") == "q"
    assert asked == ["ready \\x1b[2J?"]


def test_a_question_on_the_page_may_be_answered_on_the_terminal(
    watch: Watch, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends = os.pipe()
    with os.fdopen(ends[0]) as terminal:
        monkeypatch.setattr("sys.stdin", terminal)
        threading.Timer(0.3, os.write, (ends[1], b"slipped\n")).start()
        assert watch.ask("was it good?", own_words="what was bad") == "slipped"
        threading.Timer(0.3, watch.operator.stop, ("the page",)).start()
        assert watch.ask("ready?") == "q"  # a stop that was asked for is an answer
        os.close(ends[1])
        watch.typing.join()


@pytest.mark.parametrize(
    ("error", "ended"), [(KeyboardInterrupt(), "stopped by Ctrl-C"), (RuntimeError("odd"), "failed: odd")]
)
def test_a_page_is_told_what_ended_a_session(error: BaseException, ended: str) -> None:
    with suppress(type(error)), Watch("run", Console(), Show(live=0)) as watch:
        address, _, token = watch.address.partition("/?token=")
        cookie = f"thermogrip_{address.rpartition(':')[2]}={token}"
        page = urlopen(Request(f"{address}/events", headers={"Cookie": cookie}), timeout=30.0)
        raise error
    events = [line.removeprefix(b"data: ") for line in page if line.strip()]
    assert json.loads(events[-1])["ended"] == ended
