"""What shows a session while it runs, and takes what an operator asks; the loop waits for none of it.

The loop appends a snapshot to a queue (:meth:`Watch.listen`).  A thread takes them out ten times a second for
the terminal and for the page's process (:mod:`~thermogrip.live.server`), which it writes lines to; another
one reads what comes back.
"""

from __future__ import annotations

import json
import os
import queue
import secrets
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from shutil import get_terminal_size
from types import TracebackType
from typing import Any

import typer

from thermogrip.datasets.errors import UserError
from thermogrip.live.server import PAGE
from thermogrip.live.terminal import line, panel
from thermogrip.media.rendering import printable
from thermogrip.report.console import Console, plain
from thermogrip.rig.session.loop import PHASES
from thermogrip.rig.session.signals import check_stopped
from thermogrip.rig.session.snapshot import Operator, Snapshot


@dataclass(frozen=True)
class WatchSettings:
    """How often a session is shown, and how long anything is waited for."""

    every_s: float = 0.1  # between two looks at the queue
    refresh_s: float = 0.5  # between two pictures on a terminal ...
    line_s: float = 1.0  # ... and two lines elsewhere
    keep: int = 4096  # snapshots that wait
    switch_s: float = 5e-4  # after which a thread that shows passes Python's lock on (5 ms elsewhere)
    patience_s: float = 10.0  # for the page's process to start
    goodbye_s: float = 4.0  # for it to end
    reload_s: float = 2.0  # a page that is loaded anew is back within


WATCH = WatchSettings()


@dataclass(frozen=True)
class Show:
    """What of a session is shown where."""

    live: int | None = None  # port of the page, 0 for any; None for no page
    foxglove: int | None = None  # port
    layout: Path | None = None  # where Foxglove's layout goes
    pace: float | None = None  # of a twin [times real time]: its page stays until it has been looked at

    def check(self) -> None:
        """Raise UserError where a package is missing."""
        needs = {"live": ("starlette", "uvicorn"), "foxglove": ("foxglove",)}
        for extra, packages in needs.items():
            if getattr(self, extra) is not None and not all(map(find_spec, packages)):
                hint = f'pip install "thermogrip[{extra}]"'
                raise UserError(f"--{extra} needs {' and '.join(packages)}", hint=hint)


@dataclass(frozen=True)
class Question:
    """What an operator is asked: answers to choose from (what is sent, what is shown), or own words."""

    number: int
    text: str
    choices: tuple[tuple[str, str], ...]
    own_words: str = ""  # what they are for; empty where there is none


class Watch:
    """Show a session; a context manager, whose methods are called from the session's thread."""

    def __init__(self, title: str, console: Console, show: Show | None = None) -> None:
        self.title = title
        self._console = console
        self._show = show or Show()
        self.operator = Operator()  # is handed to the session, as are listen and progress
        self._show.check()
        # full, it drops its oldest: the loop never waits
        self._queue: deque[Snapshot] = deque(maxlen=WATCH.keep)
        self._posterior: deque[list[Any]] = deque(maxlen=WATCH.keep)
        self.now: Snapshot | None = None  # the newest
        self._heard = time.monotonic()
        self._fraction, self._what = 0.0, ""
        self._verdict = ""
        self._question: Question | None = None
        self._asked = 0
        self._answers: queue.Queue[tuple[int, str]] = queue.Queue()
        self.typing: threading.Thread | None = None  # reads the terminal
        self._over = threading.Event()
        self.address = ""  # of the page, with its token
        self.page: subprocess.Popen[bytes] | None = None
        self._reached = False  # whether the page's process takes what is written
        self.viewers: int | None = None  # who look at the page now; None where nobody has come yet
        self._view = _LineDisplay(title) if not sys.stderr.isatty() else _Panel(title)

    @property
    def hooks(self) -> dict[str, Any]:
        """What a session takes of it, by name."""
        return {"progress": self.progress, "listener": self.listen, "operator": self.operator}

    def listen(self, snapshot: Snapshot) -> None:
        """Take a snapshot; returns at once."""
        self._queue.append(snapshot)

    def progress(self, fraction: float, what: str) -> None:
        """Take how far the work is."""
        self._fraction, self._what = max(self._fraction, fraction), what
        self._view.progress = self._fraction, what

    def posterior(self, time_s: float, probabilities: Mapping[str, float]) -> None:
        """Take the probabilities of the materials at this time of the contact [s]."""
        self._posterior.append([time_s, dict(probabilities)])

    def ended(self, verdict: str) -> None:
        """Say how the work ended."""
        self._verdict = verdict

    def cleared(self) -> None:
        """Show the trip no more."""
        if self.now is not None:
            self._queue.append(replace(self.now, trip=None, verdict="cleared"))

    def ask(
        self, text: str, keys: str = "", choices: tuple[tuple[str, str], ...] = (), own_words: str = ""
    ) -> str:
        """Return what is answered, on the terminal, which says what the ``keys`` mean, or on the page."""
        self._view.pause()
        typed = printable(f"{text}; {keys}" if keys else text)
        try:
            if not self._reached:
                return str(typer.prompt(typed, default="", show_default=False)).strip()
            return self._ask_both(text, typed, choices, own_words)
        finally:
            self._view.resume()

    def _ask_both(self, text: str, typed: str, choices: tuple[tuple[str, str], ...], own_words: str) -> str:
        self._asked += 1
        with suppress(queue.Empty):
            while True:
                self._answers.get_nowait()  # typed before there was a question
        self._question = Question(self._asked, text, choices, own_words)
        sys.stderr.write(f"{typed} (here or on the page): ")
        sys.stderr.flush()
        if self.typing is None:
            self.typing = threading.Thread(target=self._read_typed, daemon=True)
            self.typing.start()
        try:
            while True:
                check_stopped()
                if self.operator.stop_asked:
                    return "q"
                if not self._reached and not self.typing.is_alive():
                    raise UserError("nobody can answer any more", hint="run the same command again to go on")
                with suppress(queue.Empty):
                    number, reply = self._answers.get(timeout=0.2)
                    if number in (0, self._asked):
                        return reply.strip()
        finally:
            self._question = None
            sys.stderr.write("\n")

    def _read_typed(self) -> None:
        """Read lines from the terminal."""
        # not through Python's buffer, whose lock a waiting thread would hold at the end
        unfinished = b""
        with suppress(OSError, ValueError):
            while data := os.read(sys.stdin.fileno(), 4096):
                *whole, unfinished = (unfinished + data).split(b"\n")
                for typed in whole:
                    self._answers.put((0, typed.decode("utf-8", "replace")))

    def __enter__(self) -> Watch:
        if self._show.live is not None or self._show.foxglove is not None:
            self._open_page()
        self._switch = sys.getswitchinterval()
        sys.setswitchinterval(WATCH.switch_s)
        self._view.resume()
        self._thread = threading.Thread(target=self._work, name="watch", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            stopped = issubclass(kind, KeyboardInterrupt)
            self._verdict = "stopped by Ctrl-C" if stopped else f"failed: {error}"
        elif self._show.pace is not None and self._reached:
            with suppress(KeyboardInterrupt):
                self._stay()
        self._over.set()
        self._thread.join(WATCH.goodbye_s)
        if self._thread.is_alive() and self.page is not None:  # it writes to a process that hangs
            self.page.kill()
            self._thread.join()
        self._view.pause()
        self._close_page()
        sys.setswitchinterval(self._switch)

    def _stay(self) -> None:
        """Keep the page of a twin until whoever looked at it has left."""
        self._view.pause()
        sys.stderr.write("the session has ended; close the page, or press Ctrl-C here\n")
        sys.stderr.flush()
        end = time.monotonic() + PAGE.linger_s
        while self._reached and time.monotonic() < end:
            if self.viewers:
                end = float("inf")
            elif self.viewers == 0:
                end = min(end, time.monotonic() + WATCH.reload_s)
            time.sleep(WATCH.every_s)

    def _work(self) -> None:
        """Show what is new until the end, and that too."""
        shown = 0.0
        while True:
            over = self._over.wait(WATCH.every_s)
            taken = _drain(self._queue)
            if taken:
                self.now = self._view.now = taken[-1]
                self._heard = time.monotonic()
            if over or time.monotonic() - shown > self._view.every_s:
                shown = time.monotonic()
                self._view.show()
            self._send(taken, over)
            if over:
                return

    def _send(self, taken: list[Snapshot], over: bool) -> None:
        """Write what is new to the page's process; one that is gone is let go."""
        page, now = self.page, self.now
        if page is None or page.stdin is None or not self._reached:
            return
        question = self._question
        names = [] if now is None else [*now.values, *now.drive]
        units = [] if now is None else [*["degC"] * len(now.values), *(now.units[k] for k in now.drive)]
        message = {
            "title": self.title,
            "what": self._what,
            "fraction": self._fraction,
            "columns": ["time_s", "phase", "pump", "target", *names],
            "units": ["s", "1", "1", "degC", *units],
            "rows": [_page_row(snapshot) for snapshot in taken],
            "now": {} if now is None else asdict(now),
            "posterior": _drain(self._posterior),
            "age": time.monotonic() - self._heard,
            "question": None if question is None else asdict(question),
            "stopping": bool(self.operator.stop_asked),
            "ended": (self._verdict or "ended") if over else "",
        }
        if now is None:
            message |= {"columns": [], "units": []}
        try:
            # NaN and infinity are left to the page
            page.stdin.write(json.dumps(message, default=plain).encode() + b"\n")
            page.stdin.flush()
        except OSError:
            self._reached = False
            self._console.warn("the page's process is gone; the session goes on without it")

    def _open_page(self) -> None:
        """Start the page's process and say where the page is."""
        token = secrets.token_urlsafe(24)
        words = [sys.executable, "-P", "-m", "thermogrip.live.server"]
        self.page = page = subprocess.Popen(
            words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
        )
        assert page.stdin is not None
        assert page.stdout is not None
        show, layout = self._show, self._show.layout
        settings = {"token": token, "port": show.live, "foxglove": show.foxglove, "title": self.title}
        settings |= {"layout": None if layout is None else str(layout)}
        page.stdin.write(json.dumps(settings).encode() + b"\n")
        page.stdin.flush()
        begin = time.monotonic()
        opening: dict[str, Any] = {}
        for text in page.stdout:
            opening |= json.loads(text)
            if opening.keys() & {"ready", "error"} or time.monotonic() - begin > WATCH.patience_s:
                break
        self._reader = threading.Thread(target=self._read_page, args=(page,), daemon=True)
        self._reader.start()
        self._reached = "ready" in opening
        if not self._reached:
            page.kill()
            self._close_page()
            why = opening.get("error", "its process did not start")
            raise UserError(f"the live page cannot be served ({why})", hint="choose another port")
        if show.live is not None:
            self.address = f"http://127.0.0.1:{opening['port']}/?token={token}"
            sys.stderr.write(f"live: {self.address}\n")
        if show.pace is not None:
            sys.stderr.write(f"the twin runs {show.pace:g} times as fast as real time (--speed)\n")
        if show.foxglove is not None:
            sys.stderr.write(f"foxglove: ws://127.0.0.1:{show.foxglove}, layout {printable(str(layout))}\n")
        sys.stderr.flush()

    def _read_page(self, page: subprocess.Popen[bytes]) -> None:
        """Take what viewers ask."""
        assert page.stdout is not None
        for text in page.stdout:
            request = json.loads(text)
            do = request.get("do")  # it may also say why it ends
            if do == "viewers":
                self.viewers = request["count"]
            elif do == "stop":
                self.operator.stop("the page")
            elif do == "bad":
                self.operator.mark_bad(request.get("text") or "marked on the page")
            elif do == "answer" and request.get("question", "").isdecimal():
                self._answers.put((int(request["question"]), request.get("text", "")))

    def _close_page(self) -> None:
        page, self.page = self.page, None
        self._reached = False
        if page is None or page.stdin is None or page.stdout is None:
            return
        with suppress(OSError):
            page.stdin.close()
        try:
            page.wait(WATCH.goodbye_s)
        except subprocess.TimeoutExpired:
            page.kill()
            page.wait()
        self._reader.join()
        page.stdout.close()


class _LineDisplay:
    """What is no terminal: a line where something is new."""

    every_s = WATCH.line_s

    def __init__(self, title: str) -> None:
        self._title = title
        self._last_text = ""
        self.now: Snapshot | None = None
        self._paused = False
        self.progress: tuple[float, str] = 0.0, ""

    def show(self) -> None:
        fraction, stage = self.progress
        begin = f"{printable(self._title)} {100 * fraction:3.0f} % {printable(stage)}"
        text = begin if self.now is None else f"{begin}; {line(self.now)}"
        if not self._paused and text != self._last_text and (stage or self.now):
            self._last_text = text
            sys.stderr.write(text + "\n")
            sys.stderr.flush()

    def pause(self) -> None:
        self._paused = True

    def resume(self) -> None:
        self._paused = False


class _Panel:
    """A terminal: a panel that is drawn anew in its place, by the thread that shows."""

    every_s = WATCH.refresh_s

    def __init__(self, title: str) -> None:
        from rich.console import Console as RichConsole

        self._title = title
        self.now: Snapshot | None = None
        self.progress: tuple[float, str] = 0.0, ""
        self._console, self._lock = RichConsole(stderr=True, highlight=False), threading.Lock()
        self._live: Any = None

    def show(self) -> None:
        with self._lock:
            if self._live is not None:
                self._live.update(self._drawn(), refresh=True)

    def pause(self) -> None:
        with self._lock:
            if self._live is not None:
                self._live.stop()
                self._live = None

    def resume(self) -> None:
        from rich.live import Live

        with self._lock:
            self._live = Live(self._drawn(), console=self._console, auto_refresh=False)
            self._live.start()

    def _drawn(self) -> Any:
        fraction, stage = self.progress
        note = f"{100 * fraction:3.0f} %  {stage}" if stage else ""
        width = get_terminal_size().columns
        return panel(f"thermogrip {self._title}", self.now, note=note, width=width)


def _drain(waiting: deque[Any]) -> list[Any]:
    """Return what waits, oldest first, and take it out."""
    taken: list[Any] = []
    with suppress(IndexError):
        while True:
            taken.append(waiting.popleft())
    return taken


def _page_row(now: Snapshot) -> list[float | None]:
    """Return a snapshot as a row of the page's columns."""
    phase = float(PHASES.index(now.phase)) if now.phase else None
    head = [now.time_s, phase, None if now.pump is None else float(now.pump), now.target.get(now.skin)]
    return [*head, *now.values.values(), *now.drive.values()]
