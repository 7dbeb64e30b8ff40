r"""Which grasps, and which of their readings, are usable.

Did the gripper touch anything?
-------------------------------

A grasp that is |dT| >= 10 K from its object has a skin that moves by a share of dT in any contact.  On the
example rig's gripper the least of the library, expanded polystyrene, moves it by 1.0 % in 10 s, cork by
3.5 %; a skin alone moves by up to 0.5 % of 20 K as its pump stands.  So a trace whose last second lies within
0.6 % of its level before contact shows no contact: there is no effusivity in it, and no material.

A skin that moves the other way, by a twentieth of the difference or more, contradicts its object's
temperature: the number is wrong, or not in degC, and whatever is inferred with it is too.

Nor is there a material in a grasp that has no reading within its sensor's range
(:mod:`thermogrip.sysid.effusivity.quality`) before contact or after it.  None of them counts where others
are asked: the answer of a block that was touched several times is that of its other touches, and the block
has rested longer before the next of them.

Readings at the end of a sensor's range say "at least this much", and no more
-----------------------------------------------------------------------------

A skin that is pulled past the last reading of its sensor goes on moving; its trace stands still.  Taken for a
temperature such a stretch tells of a heat flow that stopped, which no contact does: a gripper and an object
come to terms ever slower, as :math:`1 / \sqrt t` at first and exponentially in the end.  So a trace has
**stopped dead** at its highest or lowest reading where it stays for 2 s or more, and

- had moved by more than five of its steps in the second before it got there (an exponential that does this
  and then stays within one step for two seconds has a time constant below 0.6 s: no block has), or
- jitters over three of its steps or more before contact, and not at all for 30 samples there (normal jitter
  of half a step stays in one of its steps for so long once in 100 000 traces).

Where no reading of the record lies beyond, that is the rail of the sensor, and the samples at it are clipped
in every grasp of the record, with those between the first and the last of them: jitter that dips below a
rail is half a jitter.  Of a trace that others pass, the sensor stuck, and its own stretch is clipped alone.

The engine leaves clipped samples out as it leaves out lost ones.  Which samples those are depends on the
readings, and "at least this much" is not used: answers are a little less sure than they could be.

A **spike** (a bus that answered 85 or -127 degC, or 0 for a lost reading) is no reading either: one to three
samples that a trace leaves for and comes back from, by the rule of :mod:`thermogrip.datasets.repair`, or with
which it begins or ends, a leap of 10 K away from the rest.

Was the skin still moving when it touched?
------------------------------------------

The engine's skin has one level before contact, and drifts afterwards as its calibration says.  One that was
not settled goes on moving for a while, and an object that answers to it is found too warm or too cold: a skin
that moves by s [K/s] and keeps to it puts the temperature of a metal off by 12 to 17 s times s (simulated
copper and iron at 20 K, 10 s of contact), half of that where it settles within 10 s; of an insulator it is
the effusivity that moves, 0.13 in log10 e for 0.05 K/s.

That drift is no unknown of the model.  A grasp tells its own only badly: a second and a half before contact
leaves 0.02 K/s open at 10 Hz, the contact itself, with all else unknown, 0.014 K/s.  With that for a prior
every metal's temperature would be known to 0.3 K instead of 0.1; the 195 training grasps of the example rig
want 0.002 K/s (-2 ln likelihood -4; +58 at 0.01 K/s), which moves nothing.  So it is looked for, and told: a
line through the last five seconds before contact whose slope noise would make once in 100 000 grasps.  Of the
second and a half that the example rig records that is 0.17 K/s, of five seconds 0.03 K/s; a slower drift
passes, and only a session that has settled rules it out.

A gripper is known for as long as the contacts lasted that taught it
--------------------------------------------------------------------

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
from numpy.typing import ArrayLike, NDArray
from scipy.special import stdtr

from thermogrip.datasets.repair import SPIKE_FLOOR_K, SPIKE_LENGTH, find_spikes
from thermogrip.datasets.schema import Grasps, has_touch_groups, label_values

__all__ = [
    "BIAS_S",
    "CONTRARY",
    "LEAP",
    "NO_CONTACT",
    "NO_MOVE",
    "OUT_OF_RANGE",
    "READ_WHOLE",
    "TELLING",
    "beginnings",
    "begins_to_clip",
    "clipped_from",
    "clipped_samples",
    "contradicts",
    "difference_to_object",
    "find_contact",
    "in_range",
    "level_slope",
    "longest_contact",
    "outlast",
    "spiked_samples",
    "stays",
    "telling",
    "unmoved",
    "unread_samples",
    "unsettled",
    "untold",
    "without_contact",
    "without_spikes",
]

Floats = NDArray[np.float64]

#: No skin moves by so much from one reading to the next [K].
LEAP = 10.0

_STAYS, _MOVING = 2.0, 1.0  # s
_BEGINS = 0.3  # s
_STEPS = 5  # of the trace, in the second before it stops
_FINEST = 1e-3  # K: no thermometer's step is smaller
_SILENT = 30  # samples
_BEFORE, _AFTER = -0.25, 0.15  # s: the level before contact, whatever the closed message misses it by


def clipped_samples(grasps: Grasps) -> NDArray[np.bool_]:
    """Return which samples stand at the end of their sensor's range, shape (n_grasp, n_time).

    Examples
    --------
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> grasps = load_example_grasps()["exp2_dT20"].isel(grasp=[0, 8])
    >>> int(clipped_samples(grasps).sum())
    0
    >>> low = grasps.assign(t_surface=np.maximum(grasps["t_surface"], 41.0))
    >>> bool((clipped_samples(low) == (low["t_surface"].values == 41.0)).all())
    True
    """
    return _clipped(grasps, spiked_samples(grasps))


def spiked_samples(grasps: Grasps) -> NDArray[np.bool_]:
    """Return which samples are spikes, shape (n_grasp, n_time).

    Examples
    --------
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> grasps = load_example_grasps()["exp2_dT20"].isel(grasp=[0, 8])
    >>> grasps["t_surface"][1, 60] = -127.0
    >>> np.argwhere(spiked_samples(grasps)).tolist()
    [[1, 60]]
    """
    data = np.asarray(grasps.variables["t_surface"].values, dtype=float)
    spiked = np.zeros(data.shape, dtype=bool)
    jumps = np.diff(data, axis=1)
    # a contact moves one way, or there and back slowly: only few traces need a closer look
    both_ways = (jumps > SPIKE_FLOOR_K).any(axis=1) & (jumps < -SPIKE_FLOOR_K).any(axis=1)
    for i in np.flatnonzero(both_ways):
        moves = np.abs(jumps[i])
        step = float(moves[moves > 0].min())  # a coarse sensor flickers by one of them
        spiked[i] = find_spikes(data[i], floor=max(SPIKE_FLOOR_K, 2.5 * step))
    for i in np.flatnonzero((np.abs(jumps) > LEAP).any(axis=1)):
        _mark_ends(data[i], spiked[i])
    return spiked


def unread_samples(grasps: Grasps) -> NDArray[np.bool_]:
    """Return which samples are no readings, clipped or spikes, shape (n_grasp, n_time)."""
    spiked = spiked_samples(grasps)
    return np.asarray(spiked | _clipped(grasps, spiked))


def in_range(grasps: Grasps) -> Grasps:
    """Return the record with what is no reading lost (NaN); the record itself where all are."""
    return _without(grasps, unread_samples(grasps))


def without_spikes(grasps: Grasps) -> Grasps:
    """Return the record with its spikes lost (NaN); the record itself where there are none."""
    return _without(grasps, spiked_samples(grasps))


def clipped_from(grasps: Grasps) -> tuple[Floats, Floats]:
    """Return when each grasp first reads the end of its range [s], and what that is [degC]; NaN if never."""
    clipped = clipped_samples(grasps)
    at, row = clipped.argmax(axis=1), np.arange(len(clipped))
    ever = clipped.any(axis=1)
    when = np.where(ever, grasps["time"].values[at], np.nan)
    return when, np.where(ever, grasps["t_surface"].values[row, at], np.nan)


def begins_to_clip(grasps: Grasps) -> NDArray[np.bool_]:
    """Return which grasps have stood still for 0.3 s after full motion: it is too early to tell why, (n,).

    Examples
    --------
    >>> from thermogrip.datasets.schema import make_grasps
    >>> skin = [23.0, 23.1, 25.0, 27.0, 28.0, 28.0, 28.0, 28.0]
    >>> begins_to_clip(make_grasps([-2.0, -1.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6], [skin], ["g0"]))
    array([ True])
    """
    time = np.asarray(grasps["time"].values, dtype=float)
    data = np.where(spiked_samples(grasps), np.nan, grasps["t_surface"].values)
    stands = np.zeros(len(data), dtype=bool)
    for i, row in enumerate(data):
        seen = row[np.isfinite(row)]
        for sign in (1.0, -1.0):
            top = float(sign * seen[-1])
            if top == (sign * seen).max():
                stands[i] |= _stops_dead(time, sign * row, top, _BEGINS)
    return stands


def _mark_ends(row: Floats, spiked: NDArray[np.bool_]) -> None:
    """Mark the few samples at either end that lie a leap away from the rest, in place."""
    seen = np.flatnonzero(np.isfinite(row))
    for order in (seen, seen[::-1]):
        leaps = np.flatnonzero(np.abs(np.diff(row[order[: SPIKE_LENGTH + 1]])) > LEAP)
        if leaps.size and seen.size > 2 * SPIKE_LENGTH:
            spiked[order[: leaps[-1] + 1]] = True


def _without(grasps: Grasps, samples: NDArray[np.bool_]) -> Grasps:
    return grasps.assign(t_surface=grasps["t_surface"].where(~samples)) if samples.any() else grasps


def _clipped(grasps: Grasps, spiked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    time = np.asarray(grasps.variables["time"].values, dtype=float)
    data = np.where(spiked, np.nan, grasps.variables["t_surface"].values)
    clipped = np.zeros(data.shape, dtype=bool)
    for sign in (1.0, -1.0):
        _clip_above(time, sign * data, clipped)
    return clipped


def _clip_above(time: Floats, data: Floats, clipped: NDArray[np.bool_]) -> None:
    """Mark the samples at an upper end in place."""
    top = np.max(data, axis=1, initial=-np.inf, where=np.isfinite(data))
    at_top = data == top[:, None]
    # seconds at the top are needed: most traces have none, and cost nothing more
    often = (at_top & (time > 0)).sum(axis=1) > 2
    dead = [i for i in np.flatnonzero(often) if _stops_dead(time, data[i], float(top[i]))]
    for i in dead:
        if top[i] < top.max():
            _mark(at_top[i], clipped[i])
    if any(top[i] == top.max() for i in dead):
        for i in np.flatnonzero(top == top.max()):
            _mark(at_top[i], clipped[i])


def _mark(at_end: NDArray[np.bool_], clipped: NDArray[np.bool_]) -> None:
    first, last = np.flatnonzero(at_end)[[0, -1]]
    clipped[first : last + 1] = True


def _stops_dead(time: Floats, row: Floats, top: float, stays_for: float = _STAYS) -> bool:
    """Return whether a trace gets to its highest reading in full motion, or falls silent there."""
    seen = np.isfinite(row)
    t, y = time[seen], row[seen]
    there = (y == top) & (t > 0)
    edges = np.flatnonzero(np.diff(there, prepend=False, append=False))
    runs = edges.reshape(-1, 2)  # from, to (one past the last)
    n, seconds = runs[:, 1] - runs[:, 0], t[runs[:, 1] - 1] - t[runs[:, 0]]
    stays = seconds >= stays_for - 1e-9
    if not stays.any():
        return False
    moves = np.abs(np.diff(y))
    step = max(float(moves[moves > 0].min(initial=np.inf)), _FINEST)
    first = runs[0, 0]
    if y[first] - np.interp(t[first] - _MOVING, t, y) > _STEPS * step:
        return True
    before = y[t < _BEFORE]
    jitter = np.diff(before)
    # two readings in turn are a quiet sensor between two steps
    jitters = min((jitter > 0).sum(), (jitter < 0).sum()) > 1 and np.unique(before).size > 2
    return bool(jitters and (n[stays] >= _SILENT).any())


#: Why a grasp tells nothing.
NO_CONTACT, OUT_OF_RANGE = "no contact", "no reading within the sensor's range"
CONTRARY = "the skin moves away from t_object: is that right, and in degC?"

#: A difference that tells whether there was a contact [K].
TELLING = 10.0
#: What a skin moves by at most without a contact, as a share of the difference.
NO_MOVE = 0.006
_CONTRARY_MOVE = 0.05  # of the difference
_LEAST_TIME = 3.0  # s of contact
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


#: A metal's temperature is off by so many seconds of a drift that lasts [s].
BIAS_S = 15.0
_FROM, _UNTIL = -5.0, -0.4  # s: some contacts are made before the message
_LEAST = 6  # readings
_CHANCE = 1e-5


def level_slope(grasps: Grasps) -> tuple[Floats, Floats]:
    """Return the slope of each skin just before contact, and its standard error, (n,) each [K/s].

    NaN where fewer than six readings tell of it.

    Examples
    --------
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> slope, sd = level_slope(load_example_grasps()["exp2_dT20"].isel(grasp=[0]))
    >>> bool(abs(slope[0]) < 3 * sd[0]), round(float(sd[0]), 2)
    (True, 0.02)
    """
    near = _near(grasps)
    t = np.asarray(grasps["time"].values, dtype=float)[near]
    y = np.asarray(grasps["t_surface"].values, dtype=float)[:, near]
    there = np.isfinite(y)
    n = there.sum(axis=1)
    least = np.maximum(n, 1)

    def centred(values: Floats) -> Floats:
        kept = np.where(there, values, 0.0)
        return np.where(there, kept - (kept.sum(axis=1) / least)[:, None], 0.0)

    x, off = centred(np.broadcast_to(t, y.shape)), centred(y)
    spread = np.maximum((x**2).sum(axis=1), 1e-12)
    slope = (x * off).sum(axis=1) / spread
    left = ((off - slope[:, None] * x) ** 2).sum(axis=1) / np.maximum(n - 2, 1)
    # readings that all round to one step know no better than that step
    sd = np.sqrt(np.maximum(left, _step(y) ** 2 / 12) / spread)
    known = n >= _LEAST
    return np.where(known, slope, np.nan), np.where(known, sd, np.nan)


def unsettled(grasps: Grasps) -> NDArray[np.bool_]:
    """Return which grasps touched while their skin was surely still moving, (n,).

    Examples
    --------
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> grasps = load_example_grasps()["exp2_dT20"].isel(grasp=[0, 1])
    >>> moved = grasps.assign(t_surface=grasps["t_surface"] + 0.2 * grasps["time"])
    >>> unsettled(grasps).any(), unsettled(moved).all()
    (np.False_, np.True_)
    """
    slope, sd = level_slope(grasps)
    n = np.isfinite(np.asarray(grasps["t_surface"].values)[:, _near(grasps)]).sum(axis=1)
    chance = 2 * stdtr(np.maximum(n - 2, 1), -np.abs(slope) / np.maximum(sd, 1e-9))
    return np.asarray(chance < _CHANCE)


def _near(grasps: Grasps) -> NDArray[np.bool_]:
    """Return which times are just before contact, (n_time,)."""
    time = np.asarray(grasps["time"].values, dtype=float)
    return np.asarray((time >= _FROM) & (time < _UNTIL))


def _step(y: Floats) -> float:
    """Return the step of the sensor [K]: the least difference of two readings that differ."""
    apart = np.diff(np.unique(y[np.isfinite(y)]))
    apart = apart[apart > 1e-6]
    return float(apart.min()) if apart.size else 0.0


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
