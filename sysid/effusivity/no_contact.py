"""Did the gripper touch anything?

A grasp that is |dT| >= 10 K from its object has a skin that moves by a share of dT in any contact.  On the
example rig's gripper the least of the library, expanded polystyrene, moves it by 1.0 % in 10 s, cork by
3.5 %; a skin alone moves by up to 0.5 % of 20 K as its pump stands.  So a trace whose last second lies within
0.6 % of its level before contact shows no contact: there is no effusivity in it, and no material.

A skin that moves the other way, by a twentieth of the difference or more, contradicts its object's
temperature: the number is wrong, or not in degC, and whatever is inferred with it is too.

Nor is there a material in a grasp that has no reading within its sensor's range
(:mod:`thermogrip.sysid.effusivity.clipping`) before contact or after it.  None of them counts where others
are asked: the answer of a block that was touched several times is that of its other touches, and the block
has rested longer before the next of them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermogrip.datasets.schema import Grasps, has_touch_groups, label_values
from thermogrip.sysid.effusivity.clipping import in_range, without_spikes

__all__ = ["CONTRARY", "NO_CONTACT", "NO_MOVE", "OUT_OF_RANGE", "TELLING", "difference_to_object", "stays"]
__all__ += ["contradicts", "find_contact", "telling", "unmoved", "untold", "without_contact"]

#: Why a grasp tells nothing.
NO_CONTACT, OUT_OF_RANGE = "no contact", "no reading within the sensor's range"
CONTRARY = "the skin moves away from t_object: is that right, and in degC?"

#: A difference that tells whether there was a contact [K].
TELLING = 10.0
#: What a skin moves by at most without a contact, as a share of the difference.
NO_MOVE = 0.006
_CONTRARY_MOVE = 0.05  # of the difference
_LEAST_TIME = 3.0  # s of contact
_BEFORE, _AFTER = -0.25, 0.15  # s: the level before contact, whatever the closed message misses it by
_JUST_NOW = 0.25  # s
_REST = 60.0  # s between two touches, where the record does not say


def without_contact(grasps: Grasps) -> NDArray[np.bool_]:
    """Return which grasps show no contact although their object is 10 K or more away.

    Parameters
    ----------
    grasps : Grasps
        ``n`` grasps; of unknown object temperature, or shorter than 3 s, none shows that it has no contact,
        nor does one that is not 10 K away if its object's temperature is off by two of its ``t_object_sd``.

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


def untold(grasps: Grasps) -> list[str]:
    """Return for each grasp why nothing can be said of what it touched, empty where something can.

    Returns
    -------
    why : (n,) list of str
        ``NO_CONTACT``, ``CONTRARY``, ``OUT_OF_RANGE`` or empty.

    Examples
    --------
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> grasps = load_example_grasps()["exp2_dT20"].isel(grasp=[0, 1])
    >>> grasps["t_surface"][1] = 48.0
    >>> untold(grasps)
    ['', 'no contact']
    """
    grasps = without_spikes(grasps)
    time, seen = grasps["time"].values, np.isfinite(in_range(grasps)["t_surface"].values)
    clipped = seen.sum(axis=1) < np.isfinite(grasps["t_surface"].values).sum(axis=1)
    blind = clipped & ~(seen[:, time < _BEFORE].any(axis=1) & seen[:, time > _AFTER].any(axis=1))
    told = np.where(contradicts(grasps), CONTRARY, np.where(blind, OUT_OF_RANGE, ""))
    why = np.where(without_contact(grasps), NO_CONTACT, told)
    return [str(words) for words in why]


def telling(grasps: Grasps, why: list[str] | None = None) -> Grasps | None:
    """Return the grasps of which something can be said, None where there are none.

    The ``rest`` before a touch of a block grows by touches that are left out before it.

    Parameters
    ----------
    grasps : Grasps
    why : (n,) list of str, optional
        What :func:`untold` said.

    Examples
    --------
    >>> from thermogrip.datasets.schema import make_grasps
    >>> t = [-1.0, 0.0, 9.0, 10.0]
    >>> skins = [[23.0, 23.0, 30.0, 30.0], [43.0] * 4, [23.0, 23.0, 29.0, 29.0]]
    >>> grasps = make_grasps(t, skins, ["a", "b", "c"], touch_group=["one"] * 3, touch=[1, 2, 3],
    ...                      rest=[np.nan, 60.0, 45.0], t_object=[33.0, 33.0, 33.0])
    >>> telling(grasps)["rest"].values.tolist()
    [nan, 115.0]
    """
    left_out = np.array([bool(words) for words in (untold(grasps) if why is None else why)])
    if left_out.all():
        return None
    kept = grasps.isel(grasp=~left_out)
    if not left_out.any() or not has_touch_groups(grasps):
        return kept
    return kept.assign(rest=("grasp", _rests(grasps, left_out)[~left_out]))


def _rests(grasps: Grasps, left_out: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return each touch's time since the touch before that counts [s], NaN where unknown."""
    n = left_out.size
    rest = np.array(grasps["rest"].values if "rest" in grasps else np.full(n, np.nan), dtype=float)
    order = np.asarray(grasps["touch"].values if "touch" in grasps else np.zeros(n), dtype=float)
    group, time = label_values(grasps, "touch_group"), grasps["time"].values
    seen = np.isfinite(grasps["t_surface"].values)
    for name in np.unique(group[left_out & (group != "")]):
        at = np.flatnonzero(group == name)
        more = 0.0
        for i in at[np.argsort(order[at], kind="stable")]:
            if left_out[i]:
                more += (rest[i] if np.isfinite(rest[i]) else _REST) + float(time[seen[i]][-1])
            elif more > 0:
                rest[i], more = (rest[i] if np.isfinite(rest[i]) else _REST) + more, 0.0
    return rest


def stays(grasps: Grasps, share: float) -> NDArray[np.bool_]:
    """Return which grasps move by less than this share of a difference that would tell, shape (n,)."""
    if not _long_enough(grasps):
        return np.zeros(grasps.sizes["grasp"], dtype=bool)
    away = np.abs(difference_to_object(grasps)) - _doubt(grasps)
    return np.asarray((away >= TELLING) & (np.abs(_moved(grasps)) < share * away))


def unmoved(grasps: Grasps) -> NDArray[np.bool_]:
    """Return which grasps, 10 K from their object, have not moved towards it yet, however short, (n,)."""
    time = grasps["time"].values
    if "t_object" not in grasps or not (time < _BEFORE).any():
        return np.zeros(grasps.sizes["grasp"], dtype=bool)
    difference = difference_to_object(grasps)
    away = np.abs(difference) - _doubt(grasps)
    moved = _means(grasps["t_surface"].values[:, time > time[-1] - _JUST_NOW]) - _level(grasps)
    return np.asarray((away >= TELLING) & (np.sign(difference) * moved < NO_MOVE * away))


def contradicts(grasps: Grasps) -> NDArray[np.bool_]:
    """Return which grasps move away from an object that is said to be 10 K off or more, shape (n,)."""
    if not _long_enough(grasps):
        return np.zeros(grasps.sizes["grasp"], dtype=bool)
    difference = difference_to_object(grasps)
    away = np.abs(difference) - _doubt(grasps)
    return np.asarray((away >= TELLING) & (-np.sign(difference) * _moved(grasps) > _CONTRARY_MOVE * away))


def _long_enough(grasps: Grasps) -> bool:
    time = grasps["time"].values
    return "t_object" in grasps and bool(time[-1] >= _LEAST_TIME and (time < _BEFORE).any())


def _moved(grasps: Grasps) -> NDArray[np.float64]:
    """Return by how much each skin stands above its level in its last second [K], (n,)."""
    time = grasps["time"].values
    return _means(grasps["t_surface"].values[:, time > time[-1] - 1.0]) - _level(grasps)


def difference_to_object(grasps: Grasps) -> NDArray[np.float64]:
    """Return how much warmer than the skin each object is [K], NaN where unknown, shape (n,)."""
    return np.asarray(grasps["t_object"].values - _level(grasps))


def _doubt(grasps: Grasps) -> NDArray[np.float64]:
    """Return by how much an object may be nearer than its temperature says [K], (n,)."""
    n = grasps.sizes["grasp"]
    sd = grasps["t_object_sd"].values if "t_object_sd" in grasps else np.zeros(n)
    return np.asarray(2 * np.nan_to_num(np.asarray(sd, dtype=float)))


def _level(grasps: Grasps) -> NDArray[np.float64]:
    return _means(grasps["t_surface"].values[:, grasps["time"].values < _BEFORE])


def _means(block: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean of each row but for lost samples, NaN where all are lost."""
    seen = np.isfinite(block)
    n = seen.sum(axis=1)
    return np.asarray(np.where(n > 0, np.where(seen, block, 0.0).sum(axis=1) / np.maximum(n, 1), np.nan))


def find_contact(
    time: ArrayLike, skin: ArrayLike, *, k: float = 6.0, quantum: float = 1 / 16, since: float = -1.0
) -> float | None:
    """Return when the skin first felt an object, None where it felt none.

    A line through the readings between ``since`` and 0 is carried on; with its uncertainty there,

        var(t) = s^2 (1 + 1/n + (t - t_mean)^2 / sum (t_i - t_mean)^2),

    contact is the first of three readings in a row beyond k standard deviations on one side, carried back
    along those three to the line.  Contact that was made before the message shows in the readings from which
    the line is made, and is then found late or not at all.

    Parameters
    ----------
    time : (n,) array_like
        Since the "closed" message [s], from before it.
    skin : (n,) array_like
        Temperatures [degC]; NaN where a sample was lost.
    k : float, optional
        Standard deviations that are no noise.
    quantum : float, optional
        Step of the sensor [K].
    since : float, optional
        Where the line starts [s]; after the pump stopped.

    Returns
    -------
    onset : float or None
        [s] after the message.

    Examples
    --------
    A skin at 23 degC that warms by 2 K/s from 0.4 s on, and one that feels nothing:

    >>> t = np.arange(-1.0, 3.0, 0.1)
    >>> round(find_contact(t, 23.0 + 2.0 * np.maximum(t - 0.4, 0.0)), 3)
    0.4
    >>> find_contact(t, np.full(t.size, 23.0)) is None
    True
    """
    t, y = np.asarray(time, dtype=float), np.asarray(skin, dtype=float)
    t, y = t[np.isfinite(y)], y[np.isfinite(y)]
    before = (t >= since) & (t < 0)
    if before.sum() < 4 or not (t >= 0).any():
        return None
    slope, level = np.polyfit(t[before] - t[before].mean(), y[before], 1)
    about = t - t[before].mean()
    residual = y[before] - level - slope * about[before]
    s2 = max(float(residual @ residual) / (before.sum() - 2), quantum**2 / 6)
    sd = np.sqrt(s2 * (1 + 1 / before.sum() + about**2 / float(about[before] @ about[before])))
    off = y - level - slope * about
    beyond = np.where(np.abs(off) > k * sd, np.sign(off), 0.0) * (t >= 0)
    runs = np.flatnonzero((beyond[:-2] != 0) & (beyond[:-2] == beyond[1:-1]) & (beyond[:-2] == beyond[2:]))
    if not runs.size:
        return None
    first = int(runs[0])
    rise = (off[first + 2] - off[first]) / (t[first + 2] - t[first])
    onset = t[first] - off[first] / rise if rise * off[first] > 0 else t[first]
    return float(np.clip(onset, t[first] - 0.5, t[first]))
