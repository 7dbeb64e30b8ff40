"""Do the grasps show contacts, and at time 0?  Two mistakes that spoil every answer.

A grasp 10 K or more from its object that has not moved by 1.5 % of the difference in its last second
probably touched nothing: cork, the least of the materials in the examples, moves by 3.5 % in 10 s.  One that
has not moved by 0.6 % shows no contact at all: on the example rig's gripper expanded polystyrene, the least
of the library, moves by 1.0 %, and a skin alone by up to 0.5 % as its pump stands.  And where most such
grasps of a file feel their object more than 0.7 s after time 0, that is not the "closed" message.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Grasps

__all__ = ["contact_faults", "without_contact"]

_TELLING = 10.0  # K
_LEAST_MOVE = 0.015  # of the difference: less is odd
_NO_MOVE = 0.006  # of the difference: less is nothing
_LATEST = 0.7  # s
_LEAST_TIME = 3.0  # s of contact


def contact_faults(grasps: Grasps) -> list[str]:
    """Return in words what is wrong with the contacts of a record; nothing where all is well.

    Examples
    --------
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> grasps = load_example_grasps()["exp2_dT20"]
    >>> contact_faults(grasps)
    []
    >>> [words] = contact_faults(grasps.assign(t_surface=0.0 * grasps["t_surface"] + 48.0))
    >>> words
    "24 grasps ('g0176' first) 20 K from their object stay as they are: no contact?"
    """
    from thermogrip.rig.touch import find_contact

    time, skin = grasps["time"].values, grasps["t_surface"].values
    if not _tells(grasps):
        return []
    difference, still = _difference(grasps), _stay(grasps, _LEAST_MOVE)
    faults = []
    if still.any():
        first, off = str(grasps["grasp"].values[still][0]), np.abs(difference[still]).min()
        faults.append(
            f"{_counted(int(still.sum()))} ({first!r} first) {off:.0f} K from their object stay as they are: "
            "no contact?"
        )
    far = np.abs(difference) >= _TELLING
    felt = [find_contact(time, skin[i]) for i in np.flatnonzero(far & ~still)]
    seen = np.array([t for t in felt if t is not None])
    if seen.size and 2 * np.sum(seen > _LATEST) > len(felt):
        faults.append(
            f"contact shows {np.median(seen):.1f} s after time 0 (median of {seen.size}); "
            "time 0 must be the closed message"
        )
    return faults


def without_contact(grasps: Grasps) -> NDArray[np.bool_]:
    """Return which grasps show no contact although their object is 10 K or more away, shape (n_grasp,).

    Examples
    --------
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> grasps = load_example_grasps()["exp2_dT20"].isel(grasp=[0, 1])
    >>> grasps["t_surface"][1] = 48.0
    >>> without_contact(grasps)
    array([False,  True])
    """
    return _stay(grasps, _NO_MOVE)


def _stay(grasps: Grasps, share: float) -> NDArray[np.bool_]:
    """Return which grasps move by less than this share of a difference that would tell."""
    if not _tells(grasps):
        return np.zeros(grasps.sizes["grasp"], dtype=bool)
    level, end = _ends(grasps)
    away = np.abs(_difference(grasps))
    return np.asarray((away >= _TELLING) & (np.abs(end - level) < share * away))


def _tells(grasps: Grasps) -> bool:
    """Say whether the record is such that a missing contact would show."""
    time = grasps["time"].values
    return "t_object" in grasps and time[-1] >= _LEAST_TIME and bool((time < -0.25).any())


def _ends(grasps: Grasps) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return each grasp's mean before contact and in its last second [degC]."""
    time, skin = grasps["time"].values, grasps["t_surface"].values
    return _means(skin[:, time < -0.25]), _means(skin[:, time > time[-1] - 1.0])


def _difference(grasps: Grasps) -> NDArray[np.float64]:
    """Return how much warmer than the skin each object is [K], NaN where unknown."""
    return np.asarray(grasps["t_object"].values - _ends(grasps)[0])


def _means(block: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean of each row but for lost samples, NaN where all are lost."""
    seen = np.isfinite(block)
    n = seen.sum(axis=1)
    return np.asarray(np.where(n > 0, np.where(seen, block, 0.0).sum(axis=1) / np.maximum(n, 1), np.nan))


def _counted(n: int) -> str:
    return "1 grasp" if n == 1 else f"{n} grasps"
