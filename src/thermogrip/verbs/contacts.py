"""Do the grasps show contacts, and at time 0?  Two mistakes that spoil every answer.

A grasp 10 K or more from its object that has not moved by 1.5 % of the difference in its last second touched
nothing: cork, the least of the materials in the examples, moves by 3.5 % in 10 s.  And where most such
grasps of a file feel their object more than 0.7 s after time 0, that is not the "closed" message.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Grasps

__all__ = ["contact_faults"]

_TELLING = 10.0  # K
_LEAST_MOVE = 0.015  # of the difference
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
    if "t_object" not in grasps or time[-1] < _LEAST_TIME or not (time < -0.25).any():
        return []
    level, end = (_means(skin[:, at]) for at in (time < -0.25, time > time[-1] - 1.0))
    difference = grasps["t_object"].values - level
    far = np.abs(difference) >= _TELLING
    still = far & (np.abs(end - level) < _LEAST_MOVE * np.abs(difference))
    faults = []
    if still.any():
        first, off = str(grasps["grasp"].values[still][0]), np.abs(difference[still]).min()
        faults.append(
            f"{_counted(int(still.sum()))} ({first!r} first) {off:.0f} K from their object stay as they are: "
            "no contact?"
        )
    felt = [find_contact(time, skin[i]) for i in np.flatnonzero(far & ~still)]
    seen = np.array([t for t in felt if t is not None])
    if seen.size and 2 * np.sum(seen > _LATEST) > len(felt):
        faults.append(
            f"contact shows {np.median(seen):.1f} s after time 0 (median of {seen.size}); "
            "time 0 must be the closed message"
        )
    return faults


def _means(block: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean of each row but for lost samples, NaN where all are lost."""
    seen = np.isfinite(block)
    n = seen.sum(axis=1)
    return np.asarray(np.where(n > 0, np.where(seen, block, 0.0).sum(axis=1) / np.maximum(n, 1), np.nan))


def _counted(n: int) -> str:
    return "1 grasp" if n == 1 else f"{n} grasps"
