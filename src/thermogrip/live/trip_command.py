"""A command of the user's own that is run on each trip, with the trip as JSON on its standard input.

It runs in a thread of its own and without a shell: nothing waits for it while a session runs, and what it
returns changes nothing.  Whether it failed is reported, with the program's name alone, since the words behind
it may hold a password.  What it prints is read and forgotten but for the end.  After ``LONGEST_S``, or when
this program is stopped, its process group is killed: the command and what it started.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from typing import IO

from thermogrip.datasets.errors import UserError, as_user_error
from thermogrip.datasets.media import printable
from thermogrip.rig.guard.trip import Trip

LONGEST_S = 60.0  # that it may take
_KEPT = 1024  # bytes of what it prints, for the last line
_READ = 1 << 16  # bytes at once


class TripCommand:
    """Run a command line on each trip; ``report`` hears of failures."""

    def __init__(self, line: str, report: Callable[[str], None]) -> None:
        with as_user_error(ValueError, "'--on-trip' is no command ({error})", hint="close the quotes"):
            self._words = shlex.split(line)
        if not self._words or shutil.which(self._words[0]) is None:
            problem = f"'--on-trip': there is no such program: {''.join(self._words[:1])!r}"
            raise UserError(problem, hint="name one that can be run; no shell reads the line")
        self._report = report
        self._threads: list[threading.Thread] = []
        self._running: list[subprocess.Popen[bytes]] = []

    def start(self, trip: Trip) -> None:
        """Begin to run it for this trip."""
        content = json.dumps(asdict(trip), ensure_ascii=False, allow_nan=False).encode("utf-8", "replace")
        self._threads.append(threading.Thread(target=self._run, args=(content,), daemon=True))
        self._threads[-1].start()

    def join(self) -> None:
        """Wait until it is done; whatever interrupts that ends it."""
        try:
            for thread in self._threads:
                thread.join()
        except BaseException:
            for process in self._running:
                _kill_group(process)
            raise

    def _run(self, content: bytes) -> None:
        try:
            process = subprocess.Popen(
                self._words,
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                start_new_session=True,
            )
        except OSError as error:
            why = str(error)
        else:
            self._running.append(process)
            why = self._wait(process, content)
            self._running.remove(process)
        if why:
            self._report(f"--on-trip {self._words[0]}: {why}")

    def _wait(self, process: subprocess.Popen[bytes], content: bytes) -> str:
        """Return how a command failed, "" where it did not."""
        assert process.stdin is not None
        assert process.stderr is not None
        end, printed = time.monotonic() + LONGEST_S, bytearray()
        reader = threading.Thread(target=_keep_end, args=(process.stderr, printed), daemon=True)
        reader.start()
        with suppress(OSError), process.stdin as pipe:  # it need not read what it gets
            pipe.write(content)
        reader.join(LONGEST_S)  # it ends with the last of the group that can print
        late = reader.is_alive()
        if not late:
            try:
                process.wait(max(0.0, end - time.monotonic()))
            except subprocess.TimeoutExpired:
                late = True
        if late:
            _kill_group(process)
            process.wait()
            return f"not done after {LONGEST_S:g} s, ended"
        last = (printed.decode("utf-8", "replace").strip().splitlines() or [""])[-1]
        code = process.returncode
        return f"exit code {code} {printable(last)[:200]}".strip() if code else ""


def _keep_end(pipe: IO[bytes], kept: bytearray) -> None:
    """Read a pipe to its end and keep the last bytes."""
    with pipe:
        while more := os.read(pipe.fileno(), _READ):
            kept += more
            del kept[:-_KEPT]


def _kill_group(process: subprocess.Popen[bytes]) -> None:
    """Kill a command and what it started (Windows has no such groups: the command alone)."""
    with suppress(OSError):  # all of it has ended
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()
