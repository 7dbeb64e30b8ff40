"""Sample a rig at a fixed rate, whatever else the program does.

A thread reads the rig on a grid, t_k = t_0 + k dt, and keeps every reading until it is taken.

* A rig that can (:class:`~thermogrip.rig.interface.SamplingRig`; our firmware) measures by its own clock and
  keeps its readings until they are fetched: a host that is held up fetches them later and loses none.
* Any other rig is read at each tick; what was not asked for in time was not measured.

Either way missing readings are counted, never interpolated.

The thread and the program share Python's lock.  It is passed on after :data:`SWITCH_S` while a sampler runs
(5 ms otherwise), or a controller at work would delay one sample in fifty by half a period.  What is asked of
the rig from elsewhere (a drive) goes through :meth:`Sampler.ask`, one at a time.
"""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import TypeVar

from thermogrip.datasets.errors import UserError
from thermogrip.rig.interface import Reading, Rig, SamplingRig

SWITCH_S = 1e-4
T = TypeVar("T")


class Sampler:
    """Read a rig every ``dt`` seconds in a thread, for as long as a ``with`` block lasts.

    The newest ``keep`` readings wait to be taken; ``dropped`` counts older ones, ``missed`` samples without
    a reading.  ``late`` [s] is how long after its tick each answer was there, ``by_device`` whether the rig
    measures by its own clock.  The rig must allow reading from another thread than the one that made it.
    """

    def __init__(
        self,
        rig: Rig,
        dt: float,
        *,
        keep: int = 100_000,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        if not dt > 0:
            raise ValueError(f"cannot sample every {dt:g} s")
        self.rig, self.dt, self.missed, self.dropped, self.by_device = rig, dt, 0, 0, False
        self.late: deque[float] = deque(maxlen=keep)
        self._clock, self._sleep, self._keep = clock, sleep, keep
        self._readings: deque[Reading] = deque()
        self._lock, self._stop = threading.Lock(), threading.Event()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="sampler", daemon=True)
        self._switch = sys.getswitchinterval()

    def take(self) -> list[Reading]:
        """Return the readings since the last call, oldest first; once they are taken, raise what ended it."""
        ended, taken = self._failure, []
        with suppress(IndexError):  # the thread may drop the oldest meanwhile: its length may change
            while True:
                taken.append(self._readings.popleft())
        if ended is not None and not taken:
            raise ended
        return taken

    def ask(self, call: Callable[[], T]) -> T:
        """Ask the rig for something between two samples, e.g. ``lambda: rig.apply(...)``, often enough: no
        sample renews a drive, which on our firmware lives 2 s."""
        with self._lock:
            return call()

    def __enter__(self) -> Sampler:
        self.by_device = isinstance(self.rig, SamplingRig) and self.rig.sample_every(self.dt)
        self._switch = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_S)
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self._thread.join()
        sys.setswitchinterval(self._switch)
        if isinstance(self.rig, SamplingRig) and self.by_device:
            with suppress(UserError):  # it is gone, and so is what it had
                self.rig.sample_every(0.0)

    def _run(self) -> None:
        # a device that measures at its own ticks answers at once between them
        begin, k = self._clock() + (0.5 * self.dt if self.by_device else 0.0), 0
        while not self._stop.is_set():
            wait = begin + k * self.dt - self._clock()
            if wait > 0:
                self._sleep(wait)
            try:
                with self._lock:
                    self._ask_rig()
            except BaseException as failure:  # handed to whoever takes the readings
                self._failure = failure
                return
            now = self._clock()
            self.late.append(now - begin - k * self.dt)
            due = max(k, int((now - begin) / self.dt)) + 1  # the next tick ahead, whatever rounding says
            self.missed += 0 if self.by_device else due - k - 1
            k = due

    def _ask_rig(self) -> None:
        if isinstance(self.rig, SamplingRig) and self.by_device:
            readings, lost = self.rig.take()
            self.missed += lost
        else:
            readings = [self.rig.read()]
        for reading in readings:
            self._readings.append(reading)
            if len(self._readings) > self._keep:
                self._readings.popleft()
                self.dropped += 1
