r"""Drives that act later than the model has it, and what of them is still to come.

A drive that acts s seconds after it was applied delays every output that it moves, whether that is
controlled or not; no lag of one output stands for it, and what the others show is taken for biases of drives
until the loop swings between their ends.  With U(t) the integral of what was applied, the mean of what acts
from a to b is

    ( U(b - s) - U(a - s) ) / (b - a),

so that s may be any share of a sample.  The filter runs on what acts.  A move of now begins to act in s
seconds, and what was applied before decides the state of then: the plan begins there [1]_.

**How late.**  Over a window of 7.5 apparent delays the model, with its own numbers, is run on the drives as
they act for each s that is tried.  State z at the start, biases w and the gain of each drive are unknown,

    z ~ N(z_s, 1 degC in its unit),    w ~ N(w_s, P_0 + w_s^2),    gain ~ N(1, 0.2^2),

z_s and w_s being the filter's.  A filter that runs on other drives than those that act is wrong by degrees,
and so is the model for most s, so that Gauss-Newton steps with the variance of readings diverge: the variance
v of the n readings, in theirs, is unknown too, 1 at least.  Each step is made with the v of the one before,
and shortened where the fit becomes worse.  Twice the negative logarithm of what is most likely is

    L(s) = n log v + r' r / v + unknowns in their standard deviations, squared.

Another s is taken where L falls by n log 5, as if four fifths of the variance were explained by it, for one
drive or for all of them together; a plant that is as the model in all but its numbers has gains and biases to
be explained by. The filter then starts anew, from the fit at the start of the window, and is led through it.

References
----------
.. [1] O. J. M. Smith, "Closer control of loops with dead time", Chemical Engineering Progress 53(5), 1957.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.signal import lfilter

from thermogrip.datasets.arrays import Array
from thermogrip.mpc.plant.prediction import PredictionModel, step_response

if TYPE_CHECKING:
    from thermogrip.mpc.estimator.observer import Observer
    from thermogrip.sysid.plant.plant import Plant

#: Of a window, in apparent delays; the same in samples, least and most.
DELAYS, FEWEST, MOST = 7.5, 20, 200
#: Of a window, from which on it is looked at.
ENOUGH = 0.7
#: Standard deviations of each state at the start [degC] and of a drive's gain.
STATE, GAIN = 1.0, 0.2
#: degC, or standard deviations: a run beyond diverges.
SOLVABLE = 1e9
_EXPLAINED = 5.0  # by how much the variance is to fall
_STEPS, _SHARES = 5, (1.0, 0.4, 0.1, 0.0)  # of Gauss and Newton; shares of one that are tried
_TRIED = 0.3  # standard deviations, of a difference quotient
# apparent delays by which drives may be late, and about the best of these
_COARSE, _FINER = np.linspace(0.0, 1.0, 6), np.array([0.1, 0.05])
_LONG = 1e6  # s for which drives have been what they are at the start
_UNQUIET = 3.0  # standard deviations of a mean innovation, from which on a window is looked at


@lru_cache(maxsize=64)
def apparent_delays(
    plant: Plant, drives: tuple[str, ...], controlled: tuple[str, ...], dt: float
) -> tuple[float, ...]:
    """Return the apparent delay [s] of each controlled output behind the drive that moves it most, a sample
    ``dt`` [s] at least and no more than fits into the longest window."""
    found = []
    for of in controlled:
        best = max((step_response(plant, name, of) for name in drives), key=lambda one: abs(one.gain))
        found.append(float(np.clip(best.delay, dt, MOST / DELAYS * dt)))
    return tuple(found)


def window_of(delay: float) -> int:
    """Return the samples of a window for an apparent delay in samples."""
    return int(np.clip(round(DELAYS * delay), FEWEST, MOST))


class LateDrives:
    """What was applied until now, and what of it acts; each drive is ``late`` (n_u,) [s], ``longest`` at
    most.

    >>> drives = LateDrives(1, longest=10.0)
    >>> drives.late = np.array([3.0])
    >>> for u in (0.2, 0.4, 0.8):
    ...     drives.apply(2.0, np.array([u]))
    >>> [round(drives.acting(at, 2.0, np.array([0.8])).item(), 3) for at in (-2.0, 0.0, 2.0, 4.0)]
    [0.3, 0.6, 0.8, 0.8]
    """

    def __init__(self, n_u: int, longest: float) -> None:
        self.late, self._longest = np.zeros(n_u), longest
        self.begin(np.zeros(n_u))

    def begin(self, u: Array) -> None:
        """Forget what was applied; drives u (n_u,) have been for long."""
        self._at, self._sum = np.array([-_LONG, 0.0]), np.vstack([-_LONG * u, 0.0 * u])

    def apply(self, seconds: float, u: Array) -> None:
        """Let so many seconds pass under drives u (n_u,)."""
        before = self._at[-1] - self._longest
        first = max(0, int(np.searchsorted(self._at, before)) - 1)
        self._at = np.append(self._at[first:], self._at[-1] + seconds)
        self._sum = np.vstack([self._sum[first:], self._sum[-1] + seconds * u])

    def acting(self, begin: float, seconds: float, last: Array) -> Array:
        """Return the mean (n_u,) of what acts for so many seconds, ``begin`` seconds from now on, where
        drives ``last`` (n_u,) are applied from now on."""
        if seconds <= 0 or not self.late.any():
            return last
        ends = np.array([begin, begin + seconds])[:, None] - self.late
        within = [np.interp(t, self._at - self._at[-1], total) for t, total in zip(ends.T, self._sum.T)]
        whole = np.column_stack(within) + np.maximum(ends, 0.0) * last
        return np.asarray((whole[1] - whole[0]) / seconds)


class _Row(NamedTuple):
    x: Array  # the filter's after the reading
    w: Array
    shown: Array  # (n_y,) what the filter expected to read, after the reading
    y: Array
    u: Array  # applied until here
    d: Array


class _Fit(NamedTuple):
    L: float
    v: float
    x: Array  # at the first row
    w: Array


class LateDriveMonitor:
    """Looks in one closed loop for drives that act ``late`` (n_u,) [s]; ``said`` is what it found, ``delays``
    are the apparent ones of controlled outputs [s]."""

    def __init__(self, model: PredictionModel, controlled: Sequence[str]) -> None:
        self.model = model
        self.delays = apparent_delays(model.plant, model.drives, tuple(controlled), model.dt)
        self._window = window_of(max(self.delays) / model.dt)
        self._most = self._window / DELAYS
        self.forget()

    def forget(self) -> None:
        """Start afresh."""
        self.late = np.zeros(self.model.n_u)
        self.restart()

    def restart(self) -> None:
        """Begin a new window; what is known stays."""
        self._rows: deque[_Row] = deque(maxlen=MOST + round(MOST / DELAYS) + 2)
        self._count = self._unquiet = 0

    @property
    def said(self) -> str:
        """Which drives are late, and how much."""
        if not self.late.any():
            return ""
        late = [name for name, seconds in zip(self.model.drives, self.late) if seconds]
        acts = f"{', '.join(late)} act{'s' * (len(late) == 1)} later than in the model"
        return f"{acts} by about {self.late.max():.2g} s: identify the plant anew"

    def note(self, observer: Observer, y: Array, u: Array, d: Array) -> bool:
        """Note a sample: the filter after reading y (n_y,), and what was applied before it, drives u (n_u,)
        and measured disturbances d (n_d,); return whether drives are late by another time, on which the
        filter then is."""
        x, w, shown = observer.now.copy(), observer.w.copy(), observer.reading()
        self._rows.append(_Row(x, w, shown, y, u, d))
        self._count += 1
        if observer.innovation_bias > _UNQUIET:
            self._unquiet = self._count
        enough = max(FEWEST, ENOUGH * self._window)
        due = self._count >= enough and self._count % max(1, self._window // 6) == 0
        shows = self._unquiet > max(0, self._count - self._window)
        return due and shows and self._look(observer)

    def _look(self, observer: Observer) -> bool:
        """Find by how many samples drives are late; return whether that is another number."""
        rows, now = list(self._rows), self.late / self.model.dt
        n = int(np.count_nonzero(np.isfinite([row.y for row in rows[1 - self._window :]])))
        here, fits = self._fitted(observer, rows, now, lags=observer.lag), dict[tuple[float, ...], _Fit]()
        if here.v < _EXPLAINED:
            return False

        def cost(late: Array) -> float:
            key = tuple(late.tolist())
            if key not in fits:
                fits[key] = self._fitted(observer, rows, late)
            return fits[key].L

        n_u, best = self.model.n_u, now
        for way in [*np.eye(n_u), np.ones(n_u)][: n_u + (n_u > 1)]:
            s = min((now + way * (late - now) for late in self._most * _COARSE), key=cost)
            for step in self._most * _FINER if cost(s) < here.L else ():
                s = min((np.clip(s + k * step * way, 0.0, self._most) for k in (0, -1, 1)), key=cost)
            best = min((best, s), key=cost)
        if np.array_equal(best, now) or not cost(best) < np.inf:
            return False
        found = fits[tuple(best.tolist())]
        enough = n * np.log(_EXPLAINED)
        if not (np.isfinite(here.L) and enough < here.L - found.L):
            return False
        self.late = best * self.model.dt
        self._lead(observer, rows, best, found)
        return True

    def _lead(self, observer: Observer, rows: list[_Row], late: Array, fit: _Fit) -> None:
        """Let the filter start where a fit does and go through its window."""
        acting = _delayed(np.array([row.u for row in rows]), late)[-self._window :]
        last = rows[-self._window :]
        observer.begin_again(fit.x, fit.w, (STATE * observer.unit) ** 2)
        self._rows.clear()
        self._rows.extend(rows[: -len(last)])
        for k, (row, u) in enumerate(zip(last, acting)):
            if k:
                observer.predict(u, row.d)
                observer.update(row.y)
            x, w, shown = observer.x.copy(), observer.w.copy(), observer.reading()
            self._rows.append(row._replace(x=x, w=w, shown=shown))

    def _fitted(
        self, observer: Observer, rows: list[_Row], late: Array, *, lags: Array | None = None
    ) -> _Fit:
        """Return the most likely run of the model over the last window, drives being late by so many samples
        (n_u,) and outputs that may lag by ``lags`` [s]."""
        model = self.model
        u = _delayed(np.array([row.u for row in rows]), late)[-self._window :][1:]
        rows = rows[-self._window :]
        first, rows = rows[0], rows[1:]
        d, y = (np.array([getattr(row, name) for row in rows]) for name in ("d", "y"))
        n_x, n_w = model.n_x, len(first.w)
        center = np.concatenate([first.x, first.w, np.ones(model.n_u)])
        sd = [STATE * observer.unit, np.sqrt(observer.P0 + first.w**2), np.full(model.n_u, GAIN)]
        scale, found = np.concatenate(sd), observer.disturbance
        offset = observer.offset + observer.found_offset
        weight = np.where(np.isfinite(y), 1 / np.sqrt(observer.R), 0.0)
        seen, n = np.nan_to_num(y), max(1, int(np.count_nonzero(np.isfinite(y))))

        def misses(z: Array) -> Array:
            """Return the residuals (B, n) of unknowns z (B, m) in standard deviations of readings."""
            x, w, gain = np.split(center + z * scale, [n_x, n_x + n_w], axis=1)
            pushed = u * gain[:, None] + (w @ found.on_drive.T * model.span)[:, None]
            held = d + (w @ found.on_disturbance.T)[:, None]
            shown, _ = model.run(x, pushed, held)
            shown = shown[:, 1:] + (w @ found.on_output.T)[:, None] + offset
            for i, lag in zip(observer.lagged, () if lags is None else lags):
                keep = lag / (model.dt + lag)
                begin = np.full((len(z), 1), keep * first.shown[i])
                shown[:, :, i] = lfilter([1 - keep], [1, -keep], shown[:, :, i], axis=1, zi=begin)[0]
            return np.asarray(((seen - shown) * weight).reshape(len(z), -1))

        m = len(center)
        z, none = np.zeros(m), _Fit(np.inf, np.inf, first.x, first.w)
        with np.errstate(all="ignore"):  # a run that diverges is found below
            r = misses(z[None])[0]
            for _ in range(_STEPS):
                v = max(1.0, float(r @ r) / n)
                J = (r - misses(z + _TRIED * np.eye(m))) / _TRIED
                if not (np.abs(J).max() < SOLVABLE and v < SOLVABLE):
                    return none
                step = np.linalg.solve(J @ J.T / v + np.eye(m), J @ (r + z @ J) / v) - z
                ways = z + np.array(_SHARES)[:, None] * step
                missed = misses(ways)
                costs = np.sum(missed**2, axis=1) / v + np.sum(ways**2, axis=1)
                at = int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))
                z, r = ways[at], missed[at]
        v = max(1.0, float(r @ r) / n)
        x, w, _ = np.split(center + z * scale, [n_x, n_x + n_w])
        return _Fit(float(n * np.log(v) + r @ r / v + z @ z), v, x, w)


def _delayed(u: Array, late: Array) -> Array:
    """Return drives (n, n_u) by sample as they act so many samples (n_u,) later."""
    at = np.arange(len(u))
    return np.column_stack([np.interp(at - s, at, column) for s, column in zip(late, u.T)])
