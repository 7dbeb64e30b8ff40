r"""Which grasps, and which of their samples, are usable: :func:`check_grasps` decides it for everybody.

A grasp shows no contact, or contradicts its object's temperature, or its sensor saturates: then it is
unusable, or clipped samples and spikes of it are masked as lost ones are.  Of touches of one block an
unusable one is left out, and the block has rested longer before the next of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermogrip.datasets.repair import SPIKE_FLOOR_K, SPIKE_LENGTH, find_spikes
from thermogrip.datasets.schema import has_touch_groups, label_values

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Grasps

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class ContactSettings:
    """What a contact looks like: times, shares of the object's distance from the skin, sensor steps."""

    leap_K: float = 10.0  # no skin moves by so much from one reading to the next
    level_until_s: float = -0.25  # whatever the closed message misses the contact by
    contact_after_s: float = 0.15  # whatever the closed message misses the contact by
    surely_after_s: float = 0.25  # readings until then may be of before contact
    # a block that moved five steps in the second before has no time constant above 0.6 s
    saturated_s: float = 2.0
    moving_s: float = 1.0  # the second before it saturates
    begins_to_saturate_s: float = 0.3  # too short to tell a rail from a slow contact
    moving_steps: int = 5  # of the sensor, in the second before it saturates
    finest_step_K: float = 1e-3  # no thermometer's step is smaller
    silent_samples: int = 30  # normal jitter stays within one step for so long once in 100 000 traces
    telling_difference_K: float = 10.0  # a smaller one does not show whether there was a contact
    # what a skin moves by at most without a contact: 0.5 % of 20 K as a pump stops; in any contact of 10 s it
    # moves by 1.0 % for the least of the library, expanded polystyrene, by 3.5 % for cork
    no_contact_share: float = 0.006
    odd_share: float = 0.015  # less is odd; cork, the least of the examples, moves it by 0.035
    contrary_share: float = 0.05  # beyond ten times what a skin moves by without a contact
    # the least insulator of the library has moved the skin by no_contact_share then
    least_contact_s: float = 3.0
    just_now_s: float = 0.25  # of a contact that goes on
    unknown_rest_s: float = 60.0  # between two touches, where the record does not say
    # a contact up to so many times as long as the longest known one is not worth a word
    read_whole: float = 1.2
    latest_contact_s: float = 0.7  # after time 0; where most contacts show later it is not the closed message
    # of the difference, within the record before contact: the pump's stop moves 0.005
    moves_before_share: float = 0.04


LIMITS = ContactSettings()

#: Attribute of a record whose samples are all usable: no check is needed again.
CHECKED = "checked_samples"
#: Why a grasp is unusable.
NO_CONTACT, OUT_OF_RANGE = "no contact", "no reading within the sensor's range"
CONTRARY = "the skin moves away from t_object: is that right, and in degC?"


@dataclass(frozen=True, eq=False)
class GraspQuality:
    """What of each grasp of a record is usable; made by :func:`check_grasps`."""

    # (n,), why nothing is usable: ``NO_CONTACT``, ``CONTRARY``, ``OUT_OF_RANGE`` or a sentence; else empty
    reason: list[str]
    note: list[str]  # (n,), the reason, or what an answer should say of what is usable in part; else empty
    masked: Flags  # (n, n_time), samples that are no readings (clipped or spikes)
    spiked: Flags  # (n, n_time), the spikes among them
    clipped_at: Floats  # (n,), the reading at which the sensor saturates [degC]; NaN if never
    shortened: Flags  # (n,), contacts that are read in part and last much longer
    until: float  # later readings are not used [s]; inf where touches of one block are read whole
    _trace: _Trace = field(repr=False)

    @property
    def usable(self) -> Flags:
        """Return which grasps have a usable part, (n,)."""
        return np.array([not why for why in self.reason])

    @property
    def undecided(self) -> Flags:
        """Return which contacts are too short to be evaluated at their last reading, (n,): of a skin that has
        not moved (an insulator's, or about to touch), one that has just stood still in full motion (perhaps
        at the end of its sensor's range), and one without a reading yet."""
        trace = self._trace
        unread = ~np.isfinite(trace.clean[:, trace.time > LIMITS.surely_after_s]).any(axis=1)
        return np.asarray(unread | trace.unmoved() | trace.begins_to_saturate())

    def usable_grasps(self, grasps: Grasps) -> Grasps | None:
        """Return the usable grasps with all their samples (None where there are none), a block's ``rest``
        before a touch longer by the touches left out before it."""
        if not self.usable.any():
            return None
        if self.usable.all():
            return grasps
        usable = grasps.isel(grasp=self.usable)
        if not has_touch_groups(grasps):
            return usable
        return usable.assign(rest=("grasp", _rests(grasps, ~self.usable)[self.usable]))

    def read(self, grasps: Grasps) -> Grasps | None:
        """Return the usable grasps as an answer reads them: masked samples lost (NaN), and cut."""
        if self.masked.any():
            grasps = grasps.assign(t_surface=grasps["t_surface"].where(~self.masked))
        if self.until < grasps["time"].values[-1]:
            grasps = grasps.sel(time=slice(None, self.until + 1e-9))
        return self.usable_grasps(grasps.assign_attrs({CHECKED: True}))


def check_grasps(grasps: Grasps, *, longest: float = np.inf, whole_traces: bool = False) -> GraspQuality:
    """Return which grasps of a record, and which of their samples, are usable.

    Of unknown object temperature, or shorter than 3 s, none shows that it has no contact, nor does one that
    is not 10 K away if its object's temperature is off by two of its ``t_object_sd``. Of single touches no
    more is used than ``longest`` [s], as the contacts of the calibration lasted; with ``whole_traces`` a
    grasp with clipped samples is unusable.
    """
    time = np.asarray(grasps.variables["time"].values, dtype=float)
    raw = np.asarray(grasps.variables["t_surface"].values, dtype=float)
    spiked, temperatures = _spiked(raw), (number_values(grasps, name) for name in ("t_object", "t_object_sd"))
    trace = _Trace(time, raw, np.where(spiked, np.nan, raw), spiked, *temperatures)
    has_reading = np.isfinite(trace.clean)
    clipped = _clipped(time, trace.clean)
    masked = np.asarray(spiked | clipped)
    read = has_reading & ~clipped
    out_of_range = clipped.any(axis=1) & ~(
        read[:, time < LIMITS.level_until_s].any(axis=1) & read[:, time > LIMITS.contact_after_s].any(axis=1)
    )
    why = np.where(trace.contradicts(), CONTRARY, np.where(out_of_range, OUT_OF_RANGE, ""))
    reason = [str(words) for words in np.where(trace.stays(LIMITS.no_contact_share), NO_CONTACT, why)]
    first_clipped = clipped.argmax(axis=1)
    row = np.arange(len(clipped))
    ever = np.asarray(clipped.any(axis=1))
    since = np.where(ever, time[first_clipped], np.nan)
    reading = np.where(ever, raw[row, first_clipped], np.nan)
    # Longer contacts than the calibration's show what that could not identify, such as water behind a cast
    # layer.  Touches of one block are read whole: each leaves in it what it took as long as it lasted.
    single = not has_touch_groups(grasps)
    last = _last_sample_times(time, np.isfinite(raw))
    shortened = np.asarray((last > LIMITS.read_whole * longest) & single)
    note = list(reason)
    for i in range(len(note)):
        if not note[i] and ever[i]:
            note[i] = f"{reading[i]:g} degC from {since[i]:.1f} s on is the end of the sensor's range"
            if whole_traces:
                reason[i] = note[i] = f"{note[i]}, and this classifier needs whole traces"
        if not note[i] and shortened[i]:
            note[i] = f"read until {longest:g} s, as long as contacts of the training lasted"
    until = float(longest) if single else np.inf
    return GraspQuality(reason, note, masked, spiked, reading, shortened, until, trace)


@dataclass(frozen=True, eq=False)
class _Trace:
    """The samples of a record: ``raw`` and ``clean`` (n, n_time), the latter without spikes."""

    time: Floats
    raw: Floats
    clean: Floats
    spiked: Flags
    t_object: Floats
    t_object_sd: Floats

    @cached_property
    def level(self) -> Floats:
        """Mean before contact (n,) [degC]."""
        return _row_means(self.clean[:, self.time < LIMITS.level_until_s])

    @cached_property
    def difference(self) -> Floats:
        """How much warmer than the skin each object is (n,) [K], NaN where unknown."""
        return np.asarray(self.t_object - self.level)

    @cached_property
    def away(self) -> Floats:
        """The least that the difference may be (n,) [K], the object's temperature being off by two sd."""
        return np.asarray(np.abs(self.difference) - 2 * np.nan_to_num(self.t_object_sd))

    @cached_property
    def moved(self) -> Floats:
        """How far each skin is above its level in its last second (n,) [K]."""
        return _row_means(self.clean[:, self.time > self.time[-1] - 1.0]) - self.level

    @property
    def telling(self) -> Flags:
        """Which grasps are long enough, and far enough from their object, to show a contact, (n,)."""
        return (self.away >= LIMITS.telling_difference_K) & bool(self.time[-1] >= LIMITS.least_contact_s)

    def stays(self, share: float) -> Flags:
        """Return which grasps move by less than this share of a difference that would show contact, (n,)."""
        return np.asarray(self.telling & (np.abs(self.moved) < share * self.away))

    def contradicts(self) -> Flags:
        """Return which grasps move away from an object that is stated to be 10 K off or more, (n,)."""
        against = -np.sign(self.difference) * self.moved > LIMITS.contrary_share * self.away
        return np.asarray(self.telling & against)

    def unmoved(self) -> Flags:
        """Return which grasps, 10 K from their object, have not moved towards it yet, however short, (n,)."""
        moved = _row_means(self.clean[:, self.time > self.time[-1] - LIMITS.just_now_s]) - self.level
        still = np.sign(self.difference) * moved < LIMITS.no_contact_share * self.away
        return np.asarray((self.away >= LIMITS.telling_difference_K) & still)

    def begins_to_saturate(self) -> Flags:
        """Return which grasps have stood still for 0.3 s after full motion: too early to know why, (n,)."""
        still = np.zeros(len(self.clean), dtype=bool)
        for i, row in enumerate(self.clean):
            readings = row[np.isfinite(row)]
            for sign in (1.0, -1.0):
                if readings.size and sign * readings[-1] == (sign * readings).max():
                    still[i] |= _saturates(
                        self.time, sign * row, float(sign * readings[-1]), LIMITS.begins_to_saturate_s
                    )
        return still


def find_contact(
    time: ArrayLike, skin: ArrayLike, *, k: float = 6.0, quantum: float = 1 / 16, since: float = -1.0
) -> float | None:
    """Return when the skin first felt an object [s after the "closed" message], None where it felt none.

    A line through the readings between ``since`` [s] and 0 is extrapolated; with its uncertainty there,

        var(t) = s^2 (1 + 1/n + (t - t_mean)^2 / sum (t_i - t_mean)^2),

    s at least that of the sensor's ``quantum`` [K], contact is the first of three readings in a row beyond k
    standard deviations on one side, extrapolated back along those three to the line.  Contact that was made
    before the message shows in the readings of the line itself, and is then found late or not at all.

    >>> t = np.arange(-1.0, 3.0, 0.1)
    >>> round(find_contact(t, 23.0 + 2.0 * np.maximum(t - 0.4, 0.0)), 3)
    0.4
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


def longest_contact(records: Sequence[Grasps]) -> float:
    """Return how long the longest contact of some records was read [s]."""
    readings = [(record["time"].values, np.isfinite(record["t_surface"].values)) for record in records]
    return max(float(_last_sample_times(*times_and_read).max()) for times_and_read in readings)


def contact_faults(grasps: Grasps, quality: GraspQuality) -> list[str]:
    """Return in words what is wrong with the contacts of a record, by its :func:`check_grasps`; nothing where
    all is well."""
    trace, spiked = quality._trace, quality.spiked
    clipped, difference = np.isfinite(quality.clipped_at), trace.difference
    still, wrong = trace.stays(LIMITS.odd_share), trace.contradicts()
    faults = []

    def named(which: Flags) -> str:
        return f"{_grasp_count(int(which.sum()))} ({str(grasps['grasp'].values[which][0])!r} first)"

    if spiked.any():
        i, k = np.argwhere(spiked)[0]
        faults.append(
            f"{int(spiked.sum())} spikes in {_grasp_count(int(spiked.any(axis=1).sum()))} are left out, the "
            f"first of {trace.raw[i, k]:g} degC in {str(grasps['grasp'].values[i])!r}"
        )
    if clipped.any():
        faults.append(
            f"{named(clipped)} saturate at {quality.clipped_at[clipped][0]:g} degC: a sensor at the end of "
            "its range?"
        )
    if still.any():
        off = np.abs(difference[still]).min()
        faults.append(f"{named(still)} {off:.0f} K from their object stay as they are: no contact?")
    if wrong.any():
        faults.append(f"{named(wrong)}: {CONTRARY}")
    far_apart = trace.telling & ~still & ~wrong
    mistimed = _mistimed(trace.time, trace.clean[far_apart], np.abs(difference[far_apart]))
    if mistimed:  # a contact before time 0 moves the skin too
        faults.append(mistimed)
    return faults


def touched_groups(record: Grasps) -> list[str]:
    """Return the names of the touch groups of a record."""
    return list(dict.fromkeys(filter(None, label_values(record, "touch_group").tolist())))


def torn_groups(touched: Iterable[tuple[str, Sequence[str]]]) -> list[str]:
    """Return in words which blocks, by the name of each file and its groups, have touches in several files:
    no answer joins those."""
    files_of: dict[str, list[str]] = {}
    for file, groups in touched:
        for name in groups:
            files_of.setdefault(name, []).append(file)
    torn = {name: files for name, files in files_of.items() if len(files) > 1}
    if not torn:
        return []
    first, files = next(iter(torn.items()))
    more = f" ({len(torn) - 1} more like it)" if len(torn) > 1 else ""
    return [
        f"touch_group {first!r}{more} is in {' and in '.join(files[:2])}, and touches are joined "
        "within a file: one block, one file"
    ]


def _mistimed(time: Floats, skin: Floats, difference: Floats) -> str:
    """Return in words how far time 0 is from the contacts, where that is so for most of them."""
    if not skin.size:
        return ""
    first, last = time <= time[0] + 0.55, (time >= -0.65) & (time <= -0.25)
    before = np.abs(_medians(skin[:, last]) - _medians(skin[:, first]))
    early = int(np.sum(before > LIMITS.moves_before_share * difference))
    if 2 * early > len(skin):
        return (
            f"{_grasp_count(early)} of {len(skin)} move before time 0; time 0 must be the closed message, "
            "and the record must start before contact"
        )
    felt = [find_contact(time, row) for row in skin]
    contact_times = np.array([t for t in felt if t is not None])
    if contact_times.size and 2 * np.sum(contact_times > LIMITS.latest_contact_s) > len(felt):
        return (
            f"contact shows {np.median(contact_times):.1f} s after time 0 (median of {contact_times.size}); "
            "time 0 must be the closed message"
        )
    return ""


def _medians(block: Floats) -> Floats:
    """Return the median of each row but for lost samples, NaN where there is none."""
    medians = [np.median(row[np.isfinite(row)]) if np.isfinite(row).any() else np.nan for row in block]
    return np.array(medians)


def _grasp_count(n: int) -> str:
    return "1 grasp" if n == 1 else f"{n} grasps"


def _spiked(data: Floats) -> Flags:
    """Return which samples are spikes, (n, n_time)."""
    # a bus that answered 85 or -127 degC, or 0 for a lost reading: one to three samples that a trace leaves
    # for and comes back from, or with which it begins or ends
    spiked = np.zeros(data.shape, dtype=bool)
    jumps = np.diff(data, axis=1)
    # a contact moves one way, or there and back slowly: only few traces need a closer look
    both_ways = (jumps > SPIKE_FLOOR_K).any(axis=1) & (jumps < -SPIKE_FLOOR_K).any(axis=1)
    for i in np.flatnonzero(both_ways):
        moves = np.abs(jumps[i])
        step = float(moves[moves > 0].min())  # a coarse sensor flickers by one of them
        spiked[i] = find_spikes(data[i], floor=max(SPIKE_FLOOR_K, 2.5 * step))
    for i in np.flatnonzero((np.abs(jumps) > LIMITS.leap_K).any(axis=1)):
        read_at = np.flatnonzero(np.isfinite(data[i]))
        for order in (read_at, read_at[::-1]):  # the few samples at either end a leap away from the rest
            leaps = np.flatnonzero(np.abs(np.diff(data[i][order[: SPIKE_LENGTH + 1]])) > LIMITS.leap_K)
            if leaps.size and read_at.size > 2 * SPIKE_LENGTH:
                spiked[i, order[: leaps[-1] + 1]] = True
    return spiked


def _clipped(time: Floats, clean: Floats) -> Flags:
    """Return which samples stand at the end of their sensor's range, (n, n_time)."""
    clipped = np.zeros(clean.shape, dtype=bool)
    for data in (clean, -clean):
        top = np.max(data, axis=1, initial=-np.inf, where=np.isfinite(data))
        at_top = data == top[:, None]
        # seconds at the top are needed: most traces have none, and cost nothing more
        often = (at_top & (time > 0)).sum(axis=1) > 2
        saturated = [i for i in np.flatnonzero(often) if _saturates(time, data[i], float(top[i]))]
        # Where no reading of the record lies beyond, that is the rail of the sensor, and samples at it are
        # clipped in every grasp, with those between: jitter that dips below a rail is half a jitter.  Of a
        # trace that others pass the sensor stuck, and its own stretch is clipped alone.
        rail = any(top[i] == top.max() for i in saturated)
        for i in {*saturated, *(np.flatnonzero(top == top.max()) if rail else ())}:
            first, last = np.flatnonzero(at_top[i])[[0, -1]]
            clipped[i, first : last + 1] = True
    return clipped


def _saturates(time: Floats, row: Floats, top: float, stays_for: float = LIMITS.saturated_s) -> bool:
    """Return whether a trace gets to its highest reading in full motion, or falls silent there."""
    # A skin that is pulled past the last reading of its sensor goes on moving; its trace does not, as if the
    # heat flow had stopped: it stays after it moved by five steps in a second (an exponential that does this
    # and stays within one step for two has a time constant below 0.6 s, as no block has), or it jittered
    # before contact and does not at all there.  That the skin was "at least this warm" is not used.
    has_reading = np.isfinite(row)
    t, y = time[has_reading], row[has_reading]
    at_top = (y == top) & (t > 0)
    edges = np.flatnonzero(np.diff(at_top, prepend=False, append=False))
    runs = edges.reshape(-1, 2)  # from, to (one past the last)
    n, seconds = runs[:, 1] - runs[:, 0], t[runs[:, 1] - 1] - t[runs[:, 0]]
    stays = seconds >= stays_for - 1e-9
    if not stays.any():
        return False
    moves = np.abs(np.diff(y))
    step = max(float(moves[moves > 0].min(initial=np.inf)), LIMITS.finest_step_K)
    first = runs[0, 0]
    if y[first] - np.interp(t[first] - LIMITS.moving_s, t, y) > LIMITS.moving_steps * step:
        return True
    before = y[t < LIMITS.level_until_s]
    jitter = np.diff(before)
    # two readings in turn are a quiet sensor between two steps
    jitters = min((jitter > 0).sum(), (jitter < 0).sum()) > 1 and np.unique(before).size > 2
    return bool(jitters and (n[stays] >= LIMITS.silent_samples).any())


def _rests(grasps: Grasps, left_out: Flags) -> Floats:
    """Return each touch's time since the touch before that counts [s], NaN where unknown."""
    rest_s, order = np.array(number_values(grasps, "rest")), number_values(grasps, "touch")
    group, time = label_values(grasps, "touch_group"), grasps["time"].values
    has_reading = np.isfinite(grasps["t_surface"].values)
    known_rest_s = np.where(np.isfinite(rest_s), rest_s, LIMITS.unknown_rest_s)
    for name in np.unique(group[left_out & (group != "")]):
        group_rows = np.flatnonzero(group == name)
        more = 0.0
        for i in group_rows[np.argsort(order[group_rows], kind="stable")]:
            if left_out[i]:
                more += known_rest_s[i] + float(time[has_reading[i]][-1])
            elif more > 0:
                rest_s[i], more = known_rest_s[i] + more, 0.0
    return rest_s


def number_values(grasps: Grasps, name: str) -> Floats:
    """Return a number of each grasp, (n_grasp,), NaN where it is absent."""
    if name not in grasps:
        return np.full(grasps.sizes["grasp"], np.nan)
    # the variable itself: a DataArray made of it costs more than all its numbers
    return np.asarray(grasps.variables[name].values, dtype=float)


def _row_means(block: Floats) -> Floats:
    """Return the mean of each row but for lost samples, NaN where all are lost."""
    has_reading = np.isfinite(block)
    n = has_reading.sum(axis=1)
    total = np.where(has_reading, block, 0.0).sum(axis=1)
    return np.asarray(np.where(n > 0, total / np.maximum(n, 1), np.nan))


def _last_sample_times(time: Floats, seen: Flags) -> Floats:
    """Return the time of each row's last sample that counts, (n,) [s]."""
    return np.asarray(time[seen.shape[1] - 1 - np.argmax(seen[:, ::-1], axis=1)], dtype=float)
