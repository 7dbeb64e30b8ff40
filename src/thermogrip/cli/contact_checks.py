"""Do the grasps show contacts, at time 0, and within the sensor's range?  Mistakes that spoil every answer.

A grasp 10 K or more from its object that has not moved by 1.5 % of the difference in its last second
probably touched nothing: cork, the least of the materials in the examples, moves by 3.5 % in 10 s
(:mod:`thermogrip.sysid.effusivity.quality`).  Where most such grasps of a file feel their object more
than 0.7 s after time 0, or move before it, that is not the "closed" message.  A trace that stops dead in
full motion has met the end of its sensor's range, and one that jumps there and back was not read
(:mod:`thermogrip.sysid.effusivity.quality`).  A skin that still moves as it touches is told too
(:mod:`thermogrip.sysid.effusivity.quality`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Grasps

__all__ = ["contact_faults", "torn_groups"]

_LEAST_MOVE = 0.015  # of the difference: less is odd
_LATEST = 0.7  # s
_MOVES_BEFORE = 0.04  # of the difference, within the record before contact: the pump's stop moves 0.005
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
    from thermogrip.sysid.effusivity.quality import (
        CONTRARY,
        TELLING,
        contradicts,
        difference_to_object,
        stays,
        without_spikes,
    )

    faults = [*_spikes(grasps), *_stopped_dead(grasps)]
    grasps = without_spikes(grasps)
    time, skin = grasps["time"].values, grasps["t_surface"].values
    if "t_object" not in grasps or time[-1] < _LEAST_TIME or not (time < -0.25).any():
        return faults + _moving(grasps)
    difference, still = difference_to_object(grasps), stays(grasps, _LEAST_MOVE)
    if still.any():
        first, off = str(grasps["grasp"].values[still][0]), np.abs(difference[still]).min()
        faults.append(
            f"{_counted(int(still.sum()))} ({first!r} first) {off:.0f} K from their object stay as they are: "
            "no contact?"
        )
    wrong = contradicts(grasps)
    if wrong.any():
        first = str(grasps["grasp"].values[wrong][0])
        faults.append(f"{_counted(int(wrong.sum()))} ({first!r} first): {CONTRARY}")
    far = (np.abs(difference) >= TELLING) & ~still & ~wrong
    mistimed = _mistimed(time, skin[far], np.abs(difference[far]))
    # a contact before time 0 moves the skin too
    return faults + (mistimed or _moving(grasps))


def torn_groups(records: Sequence[Grasps]) -> list[str]:
    """Return in words which blocks have touches in several records: no answer joins those.

    Examples
    --------
    >>> from thermogrip.datasets.schema import make_grasps
    >>> one, two = (
    ...     make_grasps([-1.0, 1.0], [[23.0, 25.0]], [name], touch_group=["p1"], name=name) for name in "ab"
    ... )
    >>> torn_groups([one, two])
    ["touch_group 'p1' stands in a and in b, and touches are joined within a file: one block, one file"]
    """
    from thermogrip.datasets.schema import label_values

    found: dict[str, list[str]] = {}
    for record in records:
        for name in dict.fromkeys(filter(None, label_values(record, "touch_group").tolist())):
            found.setdefault(name, []).append(str(record.attrs["name"]))
    torn = {name: files for name, files in found.items() if len(files) > 1}
    if not torn:
        return []
    first, files = next(iter(torn.items()))
    more = f" ({len(torn) - 1} more like it)" if len(torn) > 1 else ""
    return [
        f"touch_group {first!r}{more} stands in {' and in '.join(files[:2])}, and touches are joined "
        "within a file: one block, one file"
    ]


def _mistimed(
    time: NDArray[np.float64], skin: NDArray[np.float64], difference: NDArray[np.float64]
) -> list[str]:
    """Return in words how far time 0 is from the contacts, where that holds for most of them."""
    from thermogrip.sysid.effusivity.quality import find_contact

    if not skin.size:
        return []
    first, last = time <= time[0] + 0.55, (time >= -0.65) & (time <= -0.25)
    before = np.abs(_medians(skin[:, last]) - _medians(skin[:, first]))
    early = int(np.sum(before > _MOVES_BEFORE * difference))
    if 2 * early > len(skin):
        return [
            f"{_counted(early)} of {len(skin)} move before time 0; time 0 must be the closed message, and "
            "the record must start before contact"
        ]
    felt = [find_contact(time, row) for row in skin]
    seen = np.array([t for t in felt if t is not None])
    if seen.size and 2 * np.sum(seen > _LATEST) > len(felt):
        return [
            f"contact shows {np.median(seen):.1f} s after time 0 (median of {seen.size}); "
            "time 0 must be the closed message"
        ]
    return []


def _medians(block: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the median of each row but for lost samples, NaN where there is none."""
    found = [np.median(row[np.isfinite(row)]) if np.isfinite(row).any() else np.nan for row in block]
    return np.array(found)


def _spikes(grasps: Grasps) -> list[str]:
    """Return in words which grasps have spikes."""
    from thermogrip.sysid.effusivity.quality import spiked_samples

    spiked = spiked_samples(grasps)
    if not spiked.any():
        return []
    i, k = np.argwhere(spiked)[0]
    return [
        f"{int(spiked.sum())} spikes in {_counted(int(spiked.any(axis=1).sum()))} are left out, the first of "
        f"{grasps['t_surface'].values[i, k]:g} degC in {str(grasps['grasp'].values[i])!r}"
    ]


def _stopped_dead(grasps: Grasps) -> list[str]:
    """Return in words which grasps meet the end of their sensor's range."""
    from thermogrip.sysid.effusivity.quality import clipped_from

    reading = clipped_from(grasps)[1]
    dead = np.isfinite(reading)
    if not dead.any():
        return []
    return [
        f"{_counted(int(dead.sum()))} ({str(grasps['grasp'].values[dead][0])!r} first) stop dead at "
        f"{reading[dead][0]:g} degC: a sensor at the end of its range?"
    ]


def _moving(grasps: Grasps) -> list[str]:
    """Return in words which skins were not settled as they touched."""
    from thermogrip.sysid.effusivity.quality import BIAS_S, level_slope, unsettled

    moving = unsettled(grasps)
    if not moving.any():
        return []
    most = float(np.abs(level_slope(grasps)[0][moving]).max())
    return [
        f"{_counted(int(moving.sum()))} ({str(grasps['grasp'].values[moving][0])!r} first) touched while the "
        f"skin still moved, by up to {most:.2f} K/s: a metal may be found {BIAS_S * most:.1f} K too warm or "
        "too cold; let the gripper settle"
    ]


def _counted(n: int) -> str:
    return "1 grasp" if n == 1 else f"{n} grasps"
