r"""A drive that does another share of what its model says, and a sensor that has stopped.

Both compare what a plant was driven with and what was read, and neither asks for a posterior.

**Gain.**  Of a drive whose gain is 1 + s times the model's, the filter finds the bias w = s u / span + load.
Loads do not know when a target changes, so from the end of one target to the end of the next

    s = span (w_2 - w_1) / (u_2 - u_1),

where the drive has changed by 5 % of its range at least and the loop had the time to settle.  A gain is
reported where three of these in a row, one after another, are beyond 30 % on one side: a load that comes
between two targets makes one of them wrong, and that it goes again the next, with the other sign where the
drive goes the same way.  The report is taken back by the first that is not.  (Of four plants with loads,
targets that change every ten minutes and no fault, none had three such shares in a row with five of six
seeds; with the sixth a heated bed had, and "does about 46 % more" was said for ten minutes of three hours.
Where targets changed sooner than the loop had settled, another had.)

**Stuck.**  While a reading stays the very same number, the model is run twice from where the filter was when
it last changed: under the drives that were sent, and under that of then.  Where the first moves by more than
a third of a jump, and by as much otherwise than the second, the reading should have moved.  At rest both stay
together, however far a bias that is a little off leads them in hours; where a drive stops an output that was
on its way, the first stays.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.mpc.estimator.reading_checks import FOLLOWS_DRIVE, SHARE

if TYPE_CHECKING:
    from thermogrip.mpc.estimator.observer import Observer

_IN_A_ROW = 3
_LEAST_CHANGE = 0.05  # of a drive's range, below which a bias over it is noise


class GainMonitor:
    """What each drive does, of what its model says, from target to target."""

    def __init__(self, drives: tuple[str, ...], settling_s: float) -> None:
        self.drives, self._settling_s = drives, settling_s
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self._shares: list[deque[float]] = [deque(maxlen=_IN_A_ROW) for _ in self.drives]
        self._seconds = 0.0
        self._last: tuple[Array, Array] | None = None
        self._now: tuple[Array, Array] | None = None

    def note(self, observer: Observer, u: Array, seconds: float) -> None:
        """Note the drives (n_u,) that were applied until now."""
        self._seconds += seconds
        span = observer.model.span
        self._now = u / span, observer.disturbance.on_drive @ observer.w

    def new_target(self) -> None:
        """Note that the target changes now."""
        now, seconds, self._seconds = self._now, self._seconds, 0.0
        if now is None or seconds < self._settling_s:
            self._last = None
            return
        if self._last is not None:
            changes = now[0] - self._last[0], now[1] - self._last[1]
            for shares, of_drive, of_bias in zip(self._shares, *changes):
                if abs(of_drive) >= _LEAST_CHANGE:
                    shares.append(float(of_bias / of_drive))
        self._last = now

    @property
    def said(self) -> str:
        """Which drive does another share, empty where none does."""
        for name, shares in zip(self.drives, self._shares):
            if len(shares) == _IN_A_ROW and (min(shares) > FOLLOWS_DRIVE or max(shares) < -FOLLOWS_DRIVE):
                mean = float(np.mean(shares))
                what = f"{abs(mean):.0%} {'more' if mean > 0 else 'less'}"
                return f"{name} does about {what} than in the model: identify the plant anew"
        return ""


class StuckMonitor:
    """Which readings should have moved."""

    def __init__(self, outputs: tuple[str, ...]) -> None:
        self.outputs = outputs
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        n = len(self.outputs)
        self._y = np.full(n, np.nan)
        # of each output since its reading changed: where it was, x, x of the held drive, that drive, w
        self._runs: list[tuple[float, Array, Array, Array, Array] | None] = [None] * n
        self.said = ""

    def note(self, observer: Observer, y: Array, u: Array, d: Array) -> None:
        """Note readings y (n_y,) after drives u (n_u,) and measured disturbances d (n_d,)."""
        model, found = observer.model, observer.disturbance
        self.said = ""
        for i, name in enumerate(self.outputs):
            run = self._runs[i]
            if y[i] != self._y[i] or run is None:
                begin, start = float(model.output(observer.now)[i]), observer.now.copy()
                self._runs[i] = begin, start, start, u.copy(), observer.w.copy()
                continue
            begin, x, still, held, w = run
            on_drive, on_d = found.on_drive @ w * model.span, found.on_disturbance @ w
            x = model.next_state(x, u + on_drive, d + on_d)
            still = model.next_state(still, held + on_drive, d + on_d)
            self._runs[i] = begin, x, still, held, w
            moved = float(model.output(x)[i]) - begin
            by_drive = float((model.output(x) - model.output(still))[i])
            if min(abs(moved), abs(by_drive)) > SHARE * float(model.spike[i]):
                self.said = f"{name} is stuck at {y[i]:.4g}: by its drives the model moves by {moved:+.2g}"
        self._y = np.where(np.isfinite(y), y, self._y)
