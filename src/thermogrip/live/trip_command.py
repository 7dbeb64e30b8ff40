"""A command of the user's own that is run on each trip, with the trip as JSON on its standard input.

It runs in a thread of its own and without a shell: nothing waits for it while a session runs, and what it
returns changes nothing.  Whether it failed is reported.
"""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import threading
from collections.abc import Callable

from thermogrip.datasets.errors import UserError, as_user_error
from thermogrip.datasets.media import printable
from thermogrip.rig.guard.trip import Trip

LONGEST_S = 60.0  # that it may take


class TripCommand:
    """Run a command line on each trip; ``report`` hears of failures."""

    def __init__(self, line: str, report: Callable[[str], None]) -> None:
        with as_user_error(
            ValueError, f"'--on-trip' {line!r} is no command ({{error}})", hint="close the quotes"
        ):
            self.words = shlex.split(line)
        if not self.words or shutil.which(self.words[0]) is None:
            problem = f"'--on-trip' {line!r}: there is no such program"
            raise UserError(problem, hint="name one that can be run; no shell reads the line")
        self._report = report
        self._running: list[threading.Thread] = []

    def start(self, trip: Trip) -> None:
        """Begin to run it for this trip."""
        content = json.dumps(trip.as_dict(), ensure_ascii=False, allow_nan=False)
        self._running.append(threading.Thread(target=self._run, args=(content,), daemon=True))
        self._running[-1].start()

    def join(self) -> None:
        """Wait until it is done."""
        for thread in self._running:
            thread.join()

    def _run(self, content: str) -> None:
        try:
            done = subprocess.run(
                self.words, input=content.encode(), capture_output=True, timeout=LONGEST_S, check=False
            )
            last = (done.stderr.decode("utf-8", "replace").strip().splitlines() or [""])[-1]
            why = (
                "" if not done.returncode else f"exit code {done.returncode} {printable(last)[:200]}".strip()
            )
        except subprocess.TimeoutExpired:
            why = f"not done after {LONGEST_S:g} s, ended"
        except OSError as error:
            why = str(error)
        if why:
            self._report(f"--on-trip {self.words[0]}: {why}")
