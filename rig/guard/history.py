"""The last minutes of a rig: what was applied, what was estimated, and what was read.

A model steps with its own dt, readings come when they come.  What was applied is averaged over each native
step of the model, as the twin and the fits do: with u(t) held between calls, step k gets

    u_k = (1 / dt) * integral of u(t) from k dt to (k + 1) dt.

An estimate that is kept with the number of its step can so be carried on again under what was applied since,
or under what may have been.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from thermogrip.sysid.models.model import Array

__all__ = ["InputSteps", "Moment", "Past"]


@dataclass
class InputSteps:
    """Inputs as native steps.

    Attributes
    ----------
    dt : float
        Of a step [s].
    start, time : float
        When the first step began, and until when inputs are known [s].
    done : int
        Steps that are complete.
    first : int
        The oldest that is kept.

    Examples
    --------
    >>> steps = InputSteps(dt=2.0, start=0.0, time=0.0)
    >>> steps.add(1.0, np.array([1.0]), np.array([25.0]), keep=10)
    0
    >>> steps.add(2.5, np.array([0.0]), np.array([25.0]), keep=10)
    1
    >>> steps.rows(0)[0].tolist()
    [[0.5]]
    """

    dt: float
    start: float
    time: float
    done: int = 0
    first: int = 0
    _total: Array = field(default_factory=lambda: np.zeros(0))
    _passed: float = 0.0
    _u: deque[Array] = field(default_factory=deque)
    _d: deque[Array] = field(default_factory=deque)

    def add(self, until: float, u: Array, d: Array, keep: int) -> int:
        """Hold u (n_u,) and d (n_d,) until a time [s]; return how many steps that completed.

        Of all that are complete the newest ``keep`` are kept, and in any case those of this call.
        """
        before = self.done
        while (grid := self.start + (self.done + 1) * self.dt) <= until + 1e-9:
            self._accumulate(max(grid - self.time, 0.0), u)
            self._u.append(self._total / self._passed if self._passed > 0 else u.copy())
            self._d.append(d.copy())
            self._total, self._passed, self.time = np.zeros_like(u), 0.0, grid
            self.done += 1
        self._accumulate(max(until - self.time, 0.0), u)
        self.time = max(until, self.time)
        while len(self._u) > max(keep, self.done - before):
            self._u.popleft()
            self._d.popleft()
            self.first += 1
        return self.done - before

    def rows(self, since: int) -> tuple[Array, Array]:
        """Return inputs (N, n_u) and disturbances (N, n_d) of the steps from this one on.

        Raises
        ------
        ValueError
            If it is no longer kept.
        """
        if since < self.first:
            raise ValueError(f"step {since} is forgotten, the oldest that is kept is {self.first}")
        at = range(since - self.first, len(self._u))
        return np.array([self._u[k] for k in at]), np.array([self._d[k] for k in at])

    def part(self, time: float) -> float:
        """Return how much of the step that is not complete has passed at a time, as a fraction."""
        return (time - self.start) / self.dt - self.done

    def _accumulate(self, seconds: float, u: Array) -> None:
        if self._total.size == 0:
            self._total = np.zeros_like(u)
        self._total = self._total + seconds * u
        self._passed += seconds


@dataclass(frozen=True)
class Moment:
    """The estimate at a tick, and the reading that came with it.

    Attributes
    ----------
    time : float
        [s].
    step : int
        Native steps that were complete.
    x, w, b : (n_x,), (n_w,), (n_y,) ndarray
        State, drive biases (fractions) and output biases [K].
    y : (n_y,) ndarray
        Readings [degC], NaN where one is not compared.
    """

    time: float
    step: int
    x: Array
    w: Array
    b: Array
    y: Array


class Past:
    """The moments of the last seconds, and the inputs between them.

    Parameters
    ----------
    steps : InputSteps
        That somebody else goes on adding to.
    seconds : float
        How long a moment is kept [s].
    """

    def __init__(self, steps: InputSteps, seconds: float) -> None:
        self.steps = steps
        self._seconds = seconds
        self._moments: deque[Moment] = deque()

    @property
    def now(self) -> float:
        """Time of the newest moment [s]."""
        return self._moments[-1].time

    def add(self, moment: Moment) -> None:
        """Keep a moment, and drop what is too old."""
        self._moments.append(moment)
        while moment.time - self._moments[0].time > self._seconds:
            self._moments.popleft()

    def begin(self, time: float) -> Moment | None:
        """Return the newest moment up to a time [s]; None where there is none or inputs since are lost."""
        found = None
        for moment in self._moments:
            if moment.time > time + 1e-6:
                break
            found = moment
        return found if found is not None and found.step >= self.steps.first else None

    def after(self, time: float) -> list[Moment]:
        """Return the moments later than a time [s]."""
        return [m for m in self._moments if m.time > time]

    def errors(self, begin: Moment, y: Array) -> Array:
        """Return reading less path (B, n_readings, n_y) of every later moment that the paths reach.

        Parameters
        ----------
        begin : Moment
            Where the paths begin.
        y : (B, N + 1, n_y) ndarray
            Outputs at native steps, that of ``begin`` first [degC].
        """
        last = y.shape[1] - 1
        later = [m for m in self.after(begin.time) if m.step - begin.step <= last]
        at = [m.step - begin.step for m in later]
        return np.asarray(np.array([m.y for m in later])[None] - y[:, at])
