r"""What a PI loop may say of itself: it swings, it does not arrive, or its drive stands at its limit.

**Arrival.**  Of the first-order plant with gain K, lag T and apparent delay L that its step response is, the
loop has the poles of

    T s^2 + (1 + K Kc) s + K Kc / Ti = 0,

and with the slowest of them, 1 / t, it is there in L + 4 t (2 % are left).  While its drive is at its limit
no time counts; else :mod:`thermogrip.mpc.estimator.arrival` has the rule.

**Limits.**  Where a drive is within 1 % of its range of its limit, on the side to which the error drives it,
the plant has nothing but its own lag.  On the way to a rest at or beyond the target the distance falls by
1 - exp(-1) in T, or by 28 % where the lag is three times the model's; one of which three quarters are left
after L + T is held by nothing.  And after 2 L it should not grow; where it has by more than what is near,
another plant or a load is at work.

**Swings.**  :mod:`thermogrip.mpc.estimator.oscillation`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.mpc.design.design import PILoop
from thermogrip.mpc.estimator.arrival import ArrivalMonitor
from thermogrip.mpc.estimator.oscillation import OscillationMonitor
from thermogrip.mpc.plant.prediction import PredictionModel, step_response

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant

_CONSTANTS = 4.0  # time constants until a loop is there
_AT_LIMIT = 0.01  # of a range
_STALLED = 0.75  # of a distance, left after the delay and the lag
_REMEMBER = 0.3  # share of the newest distance in their mean


class _Answer(NamedTuple):
    gain: float  # for the whole range
    delay: float  # s, a sample at least
    lag: float


@lru_cache(maxsize=64)
def _answer(plant: Plant, drive: str, output: str, dt: float) -> _Answer:
    found = step_response(plant, drive, output)
    return _Answer(found.gain, max(found.delay, dt), found.lag)


def settling_time(gain: float, delay: float, lag: float, Kc: float, Ti: float) -> float:
    """Return how long a loop of a first-order plant takes until 2 % are left [s], gain and Kc for one and the
    same unit of drive; inf where it is not stable.

    >>> round(settling_time(gain=2.0, delay=5.0, lag=100.0, Kc=5.0, Ti=40.0), 1)
    129.7
    """
    slowest = float(np.max(np.roots([lag, 1.0 + gain * Kc, gain * Kc / Ti]).real))
    return delay - _CONSTANTS / slowest if slowest < 0 else np.inf


class LoopStatus:
    """What PI ``loops`` of a model say whose drives are ``lowest`` to ``highest`` (n_loops,); outputs may
    overshoot by ``allowed``."""

    def __init__(
        self,
        model: PredictionModel,
        loops: Sequence[PILoop],
        *,
        lowest: Array,
        highest: Array,
        allowed: float,
    ) -> None:
        n, dt = len(loops), model.dt
        self.drives = tuple(p.drive for p in loops)
        answers = [_answer(model.plant, p.drive, p.output, dt) for p in loops]
        span = [float(model.span[model.drives.index(name)]) for name in self.drives]
        self._promised = np.array(
            [settling_time(a.gain / s, a.delay, a.lag, p.Kc, p.Ti) for a, s, p in zip(answers, span, loops)]
        )
        margin = _AT_LIMIT * (highest - lowest)
        self._low, self._high = lowest + margin, highest - margin
        self._side = np.sign([p.Kc for p in loops])
        self._delay, self._lag = np.array([[a.delay, a.lag] for a in answers]).reshape(n, 2).T
        outputs = [p.output for p in loops]
        self.swings = OscillationMonitor(outputs, dt, self._delay.tolist(), [allowed] * n)
        self.arrival = ArrivalMonitor(outputs, dt, np.full(n, allowed))
        self.restart()

    def forget(self) -> None:
        """Begin anew, as with other readings."""
        self.swings.forget()
        self.restart()

    def restart(self) -> None:
        """Begin anew, as towards a new target."""
        n = len(self.drives)
        self.arrival.restart()
        self._target = np.full(n, np.nan)
        self._error = np.full(n, np.nan)  # mean of the last errors
        self._limited_s = np.zeros(n)
        self._marked_s = np.zeros(n)  # when the distance was noted
        self._marked = np.full(n, np.inf)  # the distance then
        self._begun = np.full(n, np.inf)  # the distance when 2 L were over
        self._stalled = np.zeros(n, dtype=bool)

    def note(self, y: Array, target: Array, u: Array, seconds: float) -> tuple[str, str]:
        """Note readings y and targets of the loops (n,) and the drives u (n,) that were applied in so many
        seconds before; return status and advice."""
        if np.any(target != self._target):
            self.restart()
            self._target = target.copy()
        swings = self.swings.note(y, target, seconds)
        self.arrival.near = near = self.swings.least
        error = target - y
        begun = np.where(np.isfinite(self._error), self._error, error)
        self._error = np.where(np.isfinite(error), begun + _REMEMBER * (error - begun), begun)
        limited = self._limits(u, seconds, near)
        counts = np.where(limited, 0.0, seconds)
        overdue = self.arrival.expect(y, target, self._promised, counts, np.zeros(len(y)))
        off = np.abs(self._error)
        away = limited & (off > self._begun + near)
        for which, status in ((away, "mismatch"), (limited & self._stalled, "infeasible")):
            if which.any():
                k = int(np.argmax(np.where(which, off / near, 0.0)))
                does = "goes away from its target" if which is away else f"stays {off[k]:.2g} off its target"
                name, drive = self.arrival.names[k], self.drives[k]
                why = "a load, or another plant than the model"
                return status, f"{name} {does} while {drive} is at its limit: {why}"
        said = swings or overdue
        return ("mismatch" if said else "ok"), said

    def _limits(self, u: Array, seconds: float, near: Array) -> Mask:
        """Note for how long drives have been at the limits to which errors drive them; return which are."""
        way, off = self._side * self._error, np.abs(self._error)
        limited = (off > near) & np.where(way > 0, u >= self._high, u <= self._low)
        self._limited_s = np.where(limited, self._limited_s + seconds, 0.0)
        fresh = ~limited | np.isinf(self._marked)
        self._stalled &= limited
        due = limited & (self._limited_s - self._marked_s >= self._delay + self._lag)
        self._stalled = np.where(due, off > _STALLED * self._marked, self._stalled)
        self._marked = np.where(fresh | due, np.where(limited, off, np.inf), self._marked)
        self._marked_s = np.where(fresh | due, self._limited_s, self._marked_s)
        early = self._limited_s <= 2.0 * self._delay
        self._begun = np.where(early, np.where(limited, off, np.inf), self._begun)
        return np.asarray(limited)
