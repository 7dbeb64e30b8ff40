r"""A drive that does another share than before, and a sensor that has stopped.

Both compare what a plant was driven with and what was read, and neither asks for a posterior.

What this cannot tell: anything before five changes of target; a drive that did another share of its model
from the start; a loss of less than a fifth; and a load against each of several targets, up and down, from a
loss.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.mpc.estimator.reading_checks import SHARE
from thermogrip.sysid.plant.plant_data import RUN_GAIN_SD

if TYPE_CHECKING:
    from thermogrip.mpc.estimator.observer import Observer

_LESS = 0.1  # of a drive: a derivative by differences
_PRIOR_SD = 3.0 * RUN_GAIN_SD  # of what a model's gain is off by
# up, down, up and down, for which a load that stays has opposite signs: on four plants with moving targets
# and loads (false_alarms.py, three seeds) three targets had a false word (5.5 % of three hours of an
# extruder), two had one too, four had none
_LAST_TARGETS = 4
# share of a drive's gain: the geometric middle of 1 and .6.  Without a fault it was .80 to 1.11 on those
# plants, with a loss of 40 % .49 to .74
_CHANGED = 0.775
# standard deviations beyond which, on either side, is a hundredth of a normal: so seldom a word may be false
_RARE = 2.576


class GainMonitor:
    """Which drive does another share than before, by what readings do after new targets."""

    def __init__(self, filters: Mapping[str, Observer], settling_s: float) -> None:
        # one of each drive, and how long after a target a drive moves for it
        self.filters, self._settling_s = filters, settling_s
        self.forget()

    def forget(self) -> None:
        """Begin anew, as with other readings."""
        n = len(self.filters)
        self._window = np.zeros((2, n))  # P = sum(psi^2 / R), E = sum(psi e / R)
        self._before = np.zeros((6, n))  # sums over windows of 1, P, E, P^2, P E, E^2
        self._last: deque[Array] = deque()
        self._since_s, self._was_new = np.inf, False
        # what each drive (n_u,) does of what it did before, NaN until enough targets were new
        self.share = np.full(n, np.nan)
        self._changed, self._reported = np.zeros((2, n), dtype=bool)

    def restart(self, y: Array, d: Array) -> None:
        """Begin the filters anew at readings y (n_y,) and d (n_d,); what was found stays."""
        for observer in self.filters.values():
            observer.reset(y, d)
            observer.update(y)
        self._since_s = np.inf

    def note(
        self, innovation: Array, R: Array, y: Array, u: Array, d: Array, seconds: float, *, new: bool
    ) -> None:
        """Note the loop's innovation of variance R at readings y, and whether the target is new."""
        slopes = []
        for j, observer in enumerate(self.filters.values()):
            less = u.copy()
            less[j] *= 1.0 - _LESS
            observer.advance(seconds, less, d)
            observer.look(d)
            # With e the innovation of the loop's filter, and e' that of this one, which is given a tenth less
            # of the drive, psi = (e' - e) / 0.1, and a drive whose gain is 1 + g times the model's has
            # e = g psi + noise.
            slopes.append((observer.update(y) - innovation) / _LESS)
        if new and not self._was_new:  # along a profile every target is new: that is one window
            self._end_window()
        self._since_s, self._was_new = 0.0 if new else self._since_s + seconds, new
        # after a new target a drive moves for the target and not for a load
        if self._since_s <= self._settling_s:
            psi, e = np.nan_to_num(slopes), np.nan_to_num(innovation)
            self._window = self._window + np.array([psi**2 @ (1.0 / R), psi @ (e / R)])

    def _end_window(self) -> None:
        """Compare the last windows with those before."""
        power, effect = self._window
        if power.any():
            products = [np.ones_like(power), power, effect, power**2, power * effect, effect**2]
            self._last.append(np.array(products))
        self._window = np.zeros_like(self._window)
        was = self._changed  # windows of a drive that has changed are not added to those before
        if len(self._last) > _LAST_TARGETS:
            self._before = self._before + np.where(was, 0.0, self._last.popleft())
        if len(self._last) == _LAST_TARGETS and self._before[1].all():
            now, variance = _gain(np.sum(self._last, axis=0))
            before, doubt = _gain(self._before)
            # shrunk by the share of the prior in prior and variance: few windows before say little
            shrink = _PRIOR_SD**2 / (_PRIOR_SD**2 + doubt)
            known, variance = shrink * before, variance + shrink * doubt
            # a model's own gain may be wrong (of a kiln by 30 %) and no fault: 1 + g of now and of before
            self.share = (1.0 + now) / (1.0 + known)
            large = (self.share < _CHANGED) | (self.share > 1.0 / _CHANGED)
            self._changed = large & (np.abs(now - known) > _RARE * np.sqrt(variance))
        self._reported = was & self._changed  # at two new targets in a row

    @property
    def message(self) -> str:
        """Which drive does another share, empty where none does."""
        if not self._reported.any():
            return ""
        drive = int(self._reported.argmax())
        does = f"{list(self.filters)[drive]} does {self.share[drive]:.0%} of what it did before"
        return f"{does}: has it changed, or is it a load?"


def _gain(windows: Array) -> tuple[Array, Array]:
    """Return g = sum(E) / sum(P) of each drive (n_u,) by sums over windows (6, n_u), and its variance."""
    count, power, effect, power2, product, effect2 = windows
    gain = effect / power
    # The misses of a window have one cause, such as a load that goes as the target comes: a window is one
    # observation, and g varies by sum((E - g P)^2) / sum(P)^2 n / (n - 1).  A single one has
    # no scatter: its miss is that from the model, E.
    center = np.where(count > 1, gain, 0.0)
    scatter = effect2 - 2.0 * center * product + center**2 * power2
    return gain, np.maximum(scatter, 0.0) / power**2 * count / np.maximum(count - 1.0, 1.0)


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
        self.message = ""

    def note(self, observer: Observer, y: Array, u: Array, d: Array) -> None:
        """Note readings y (n_y,) after drives u (n_u,) and measured disturbances d (n_d,)."""
        model, disturbance = observer.model, observer.disturbance
        self.message = ""
        for i, name in enumerate(self.outputs):
            run = self._runs[i]
            if y[i] != self._y[i] or run is None:
                begin, start = float(model.output(observer.now)[i]), observer.now.copy()
                self._runs[i] = begin, start, start, u.copy(), observer.w.copy()
                continue
            begin, x, still, held_drive, w = run
            on_drive, on_d = disturbance.on_drive @ w * model.span, disturbance.on_disturbance @ w
            # under the drives that were sent, and under that of when the reading last changed
            x = model.next_state(x, u + on_drive, d + on_d)
            still = model.next_state(still, held_drive + on_drive, d + on_d)
            self._runs[i] = begin, x, still, held_drive, w
            moved = float(model.output(x)[i]) - begin
            by_drive = float((model.output(x) - model.output(still))[i])
            # at rest both stay together, however far a bias that is a little off leads them in hours; where a
            # drive stops an output that was on its way, the first stays
            if min(abs(moved), abs(by_drive)) > SHARE * float(model.spike[i]):
                self.message = f"{name} is stuck at {y[i]:.4g}: by its drives the model moves by {moved:+.2g}"
        self._y = np.where(np.isfinite(y), y, self._y)
