"""Copies of training grasps with noise and a shifted initial temperature, as the paper trains its network.

A few real grasps become a training set of a hundred series a material: each copy is one real trace plus white
noise on every sample and one shift of the whole trace, which is what another initial temperature looks like
to a network that sees temperatures.  Copies are not new grasps.  They must be made from the training grasps
alone, after the split, or the test holds copies of what was trained on: each copy therefore carries the
number of its source.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermogrip.datasets.errors import UserError

__all__ = ["Augmented", "augment"]


class Augmented(NamedTuple):
    """``traces`` (n_series, n_time) [degC], ``labels`` and ``source`` (row of the real trace) (n_series,)."""

    traces: NDArray[np.float64]
    labels: NDArray[np.str_]
    source: NDArray[np.int64]


def augment(
    traces: ArrayLike,
    labels: ArrayLike,
    *,
    series_per_class: int = 100,
    noise_sd: float = 0.05,
    shift_sd: float = 0.3,
    seed: int = 0,
) -> Augmented:
    """Return about ``series_per_class`` noisy, shifted copies a class, the same number of each of its grasps.

    Parameters
    ----------
    traces : (n_grasp, n_time) array_like
        Real training traces [degC].
    labels : (n_grasp,) array_like of str
    series_per_class : int, optional
        Series a class, rounded up to whole copies; one grasp a class gives the paper's x100.
    noise_sd, shift_sd : float, optional
        Standard deviation of the noise of each sample and of the shift of each copy [degC].
    seed : int, optional

    Returns
    -------
    Augmented
        ``traces``, ``labels`` and ``source``.

    Raises
    ------
    UserError
        If a standard deviation is negative or there would be no series.

    Examples
    --------
    >>> made = augment([[23.0, 24.0], [23.0, 25.0]], ["wood", "iron"], series_per_class=3)
    >>> made.traces.shape, made.labels.tolist(), made.source.tolist()
    ((6, 2), ['wood', 'wood', 'wood', 'iron', 'iron', 'iron'], [0, 0, 0, 1, 1, 1])
    """
    x, y = np.asarray(traces, dtype=float), np.asarray(labels).astype(str)
    if min(noise_sd, shift_sd) < 0 or series_per_class < 1:
        raise UserError(
            f"cannot augment with {series_per_class=}, {noise_sd=:g}, {shift_sd=:g}",
            hint="use at least one series and no negative spread",
        )
    rng = np.random.default_rng(seed)
    grasps_of = dict(zip(*np.unique(y, return_counts=True)))
    copies = [-(-series_per_class // int(grasps_of[label])) for label in y]
    source = np.repeat(np.arange(y.size), copies)
    noise = noise_sd * rng.standard_normal((source.size, x.shape[1]))
    shift = shift_sd * rng.standard_normal((source.size, 1))
    return Augmented(x[source] + noise + shift, y[source], source)
