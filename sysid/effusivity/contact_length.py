"""A gripper is known for as long as the contacts lasted that taught it.

What lies deep in a finger shows late: water behind a cast layer, a pad on its metal.  Contacts of 10 s do not
tell of it, and a calibration from them takes it for one more layer without an end.  By finite volumes, 25
grasps of 10 s train: of fresh contacts of 20 s 0.40 are named right where 0.94 is stated, of 120 s 0.52 where
1.00 is, and 90 % intervals of the effusivity hold in 0.20 of those; read for their first ten seconds 0.72 and
0.67, stated 0.68 and 0.72, and 0.92 (``benchmarks/classify/unlike_training.py``).

So of a contact that lasts longer the beginning is read, and the answer says so.  Touches of one block are
read whole: each leaves in the block what it took as long as it lasted.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.schema import Grasps, has_touch_groups

__all__ = ["READ_WHOLE", "beginnings", "longest_contact", "outlast"]

READ_WHOLE = 1.2
"""A contact up to so many times as long as the longest known one is not worth a word."""


def longest_contact(records: Sequence[Grasps]) -> float:
    """Return how long the longest contact of some records was read [s].

    Examples
    --------
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> files = load_example_grasps()
    >>> longest_contact([files["exp2_dT20"]]), longest_contact([files["exp4_cooled5_obj18_grip38_40s"]])
    (10.0, 40.0)
    """
    return max(float(_ends(record).max()) for record in records)


def beginnings(grasps: Grasps, longest: float) -> Grasps:
    """Return the record without readings later than ``longest`` [s], whole where rows share a touch_group.

    Examples
    --------
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> long = load_example_grasps()["exp4_cooled5_obj18_grip38_40s"]
    >>> [float(beginnings(long, at)["time"][-1]) for at in (10.0, 60.0)]
    [10.0, 40.0]
    """
    if float(grasps["time"].values[-1]) <= longest or has_touch_groups(grasps):
        return grasps
    return grasps.sel(time=slice(None, longest + 1e-9))


def outlast(grasps: Grasps, longest: float) -> NDArray[np.bool_]:
    """Return which contacts go on for so much longer than ``longest`` [s] that it should be said, (n,)."""
    return np.asarray((_ends(grasps) > READ_WHOLE * longest) & (not has_touch_groups(grasps)))


def _ends(grasps: Grasps) -> NDArray[np.float64]:
    """Return when each trace has its last reading [s], (n,)."""
    seen = np.isfinite(grasps["t_surface"].values)
    last = seen.shape[1] - 1 - np.argmax(seen[:, ::-1], axis=1)
    return np.asarray(grasps["time"].values[last], dtype=float)
