"""Has the rig done in the last seconds what its model says?  Heating and cooling alike, with a sign.

The state of H seconds ago is carried on under the drives that were applied since, without looking at a
reading, and the last ``smooth`` seconds of readings are compared with where it ends.  The residual r may be

    |r| <= floor(H) + share * swing,

swing the largest change that either path makes in the window: a model is wrong by a share of what it
predicts, and by a floor when it predicts nothing.  This is the "not heating at the expected rate" of
printers, with a sign, for cooling too, and with the expected number at hand.  A pump that was switched
meanwhile is another plant, and the floor is larger by ``switching``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermogrip.rig.guard.history import Moment, Past
from thermogrip.rig.guard.kalman_filter import RigModel
from thermogrip.sysid.models.model import Array

__all__ = ["Surprise", "WindowSettings", "compare_windows", "window_slopes"]


@dataclass(frozen=True)
class WindowSettings:
    """How far a window may be from the model.

    Attributes
    ----------
    windows : tuple of float
        Lengths H [s], rising.
    floors : tuple of float
        Allowed residual of each where the model predicts no change [K].
    share : float
        Allowed part of the change in the window.
    switching : float
        Allowed besides where the pump was switched in the window [K].
    smooth : float
        Readings of so long are averaged [s].
    """

    windows: tuple[float, ...] = (10.0, 30.0, 90.0)
    floors: tuple[float, ...] = (0.55, 0.35, 0.45)
    share: float = 0.25
    switching: float = 0.5
    smooth: float = 3.0


@dataclass(frozen=True)
class Surprise:
    """What the rig does against its model.

    Attributes
    ----------
    kind : str
        ``window`` or ``bias``.
    subject : str
        Output or drive.
    window : float
        Seconds that were compared; 0 for a bias.
    expected, measured : float
        Change over the window [K], or the bias and 0.
    allowed : float
        What the difference may be.

    Examples
    --------
    >>> Surprise("window", "t_tank", 10.0, expected=4.5, measured=1.5, allowed=1.5).excess
    2.0
    """

    kind: str
    subject: str
    window: float
    expected: float
    measured: float
    allowed: float

    @property
    def excess(self) -> float:
        """How many times what is allowed."""
        return self.off / self.allowed

    @property
    def off(self) -> float:
        """How far measured is from expected."""
        return abs(self.measured - self.expected)


def compare_windows(model: RigModel, past: Past, settings: WindowSettings, since: Array) -> list[Surprise]:
    """Compare every window that ends now.

    Parameters
    ----------
    model : RigModel
    past : Past
    settings : WindowSettings
    since : (n_y,) ndarray
        From when on each output may be compared [s].

    Returns
    -------
    compared : list of Surprise
        Of every window and output that can be compared; a surprise where ``off`` is beyond ``allowed``.
    """
    found = []
    for length, floor in zip(settings.windows, settings.floors):
        begin = past.begin(past.now - length)
        if begin is None or begin.step >= past.steps.done:
            continue
        window = _Window(begin, length, floor)
        found += _compare(model, past, settings, window, since <= begin.time)
    return found


def window_slopes(
    model: RigModel, past: Past, smooth: float, length: float, steps: Array
) -> tuple[Array, Array] | None:
    """Return what a window owes to the plant's parameters rather than to biases of its drives.

    Parameters
    ----------
    model : RigModel
    past : Past
    smooth, length : float
        As of :class:`WindowSettings`, and of the window [s].
    steps : (n_p,) ndarray
        By how much each parameter is moved.

    Returns
    -------
    change, slopes : (n_y,), (n_y, n_p) ndarray
        How far the path without biases of the drives goes [K], and by how much further with each step [K];
        None where there is no such window.
    """
    begin, n = past.begin(past.now - length), len(steps)
    if begin is None or begin.step >= past.steps.done:
        return None
    u, d = past.steps.rows(begin.step)
    p = np.repeat(model.p[None], n + 1, axis=0)
    p[np.arange(1, n + 1), np.arange(n)] += steps
    many = [np.repeat(part[None], n + 1, axis=0) for part in (begin.x, u, d)]
    y = np.asarray(model.rollout(many[0], many[1], many[2], p)[0])
    at = [min(m.step - begin.step, y.shape[1] - 1) for m in _recent(past, begin, smooth)]
    ends = y[:, at].mean(axis=1)
    return ends[0] - y[0, 0], (ends[1:] - ends[0]).T


def _recent(past: Past, begin: Moment, smooth: float) -> list[Moment]:
    """Return the moments that the end of a window is the mean of."""
    return [m for m in past.after(past.now - smooth) if m.time > begin.time]


@dataclass(frozen=True)
class _Window:
    begin: Moment
    length: float
    floor: float


def _compare(
    model: RigModel, past: Past, settings: WindowSettings, window: _Window, known: NDArray[np.bool_]
) -> list[Surprise]:
    begin, plant = window.begin, model.plant
    recent = _recent(past, begin, settings.smooth)
    if not recent or not known.any():
        return []
    u, d = past.steps.rows(begin.step)
    path = model.run(begin.x[None], model.biased(u, begin.w)[None], d[None])[0] + model.offsets + begin.b
    switched = [at for at, name in enumerate(plant.inputs) if name in plant.model.switches]
    floor = window.floor + (settings.switching if np.ptp(u[:, switched], axis=0).any() else 0.0)
    readings = np.array([m.y for m in recent])
    ends = np.array([path[min(m.step - begin.step, len(path) - 1)] for m in recent])
    found = []
    for k in np.flatnonzero(known & np.isfinite(readings).all(axis=0)):
        measured, expected = float(readings[:, k].mean()), float(ends[:, k].mean())
        start = float(path[0, k])
        swing = max(float(np.ptp(path[:, k])), abs(measured - start))
        allowed = floor + settings.share * swing
        change = expected - start, measured - start
        found.append(Surprise("window", plant.outputs[k], window.length, *change, allowed))
    return found
