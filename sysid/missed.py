"""Did the gripper touch anything?

A grasp that is |dT| >= 10 K from its object has a skin that moves by a share of dT in any contact.  On the
example rig's gripper the least of the library, expanded polystyrene, moves it by 1.0 % in 10 s, cork by
3.5 %; a skin alone moves by up to 0.5 % of 20 K as its pump stands.  So a trace whose last second lies within
0.6 % of its level before contact shows no contact: there is no effusivity in it, and no material.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.schema import Grasps

__all__ = ["NO_MOVE", "TELLING", "difference_to_object", "stays", "without_contact"]

#: A difference that tells whether there was a contact [K].
TELLING = 10.0
#: What a skin moves by at most without a contact, as a share of the difference.
NO_MOVE = 0.006
_LEAST_TIME = 3.0  # s of contact
_BEFORE = -0.25  # s: the level before contact, whatever the closed message misses it by


def without_contact(grasps: Grasps) -> NDArray[np.bool_]:
    """Return which grasps show no contact although their object is 10 K or more away.

    Parameters
    ----------
    grasps : Grasps
        ``n`` grasps; of unknown object temperature, or shorter than 3 s, none shows that it has no contact.

    Returns
    -------
    missed : (n,) ndarray of bool

    Examples
    --------
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> grasps = load_example_grasps()["exp2_dT20"].isel(grasp=[0, 1])
    >>> grasps["t_surface"][1] = 48.0
    >>> without_contact(grasps)
    array([False,  True])
    """
    return stays(grasps, NO_MOVE)


def stays(grasps: Grasps, share: float) -> NDArray[np.bool_]:
    """Return which grasps move by less than this share of a difference that would tell, shape (n,)."""
    time = grasps["time"].values
    if "t_object" not in grasps or time[-1] < _LEAST_TIME or not (time < _BEFORE).any():
        return np.zeros(grasps.sizes["grasp"], dtype=bool)
    away = np.abs(difference_to_object(grasps))
    end = _means(grasps["t_surface"].values[:, time > time[-1] - 1.0])
    return np.asarray((away >= TELLING) & (np.abs(end - _level(grasps)) < share * away))


def difference_to_object(grasps: Grasps) -> NDArray[np.float64]:
    """Return how much warmer than the skin each object is [K], NaN where unknown, shape (n,)."""
    return np.asarray(grasps["t_object"].values - _level(grasps))


def _level(grasps: Grasps) -> NDArray[np.float64]:
    return _means(grasps["t_surface"].values[:, grasps["time"].values < _BEFORE])


def _means(block: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean of each row but for lost samples, NaN where all are lost."""
    seen = np.isfinite(block)
    n = seen.sum(axis=1)
    return np.asarray(np.where(n > 0, np.where(seen, block, 0.0).sum(axis=1) / np.maximum(n, 1), np.nan))
