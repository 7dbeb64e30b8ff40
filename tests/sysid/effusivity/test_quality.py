"""Which grasps, and which of their samples, are usable; and what answers make of the others."""

from __future__ import annotations

import json

import numpy as np
import pytest

from thermogrip.classify import Stream, classify_grasps, load_classifier, save_classifier
from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import make_grasps
from thermogrip.sysid.contact.simulation import simulate_grasps
from thermogrip.sysid.effusivity.data import touches
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
from thermogrip.sysid.effusivity.posterior_grid import grid_posteriors, mixture_quantiles
from thermogrip.sysid.effusivity.quality import (
    CONTRARY,
    NO_CONTACT,
    OUT_OF_RANGE,
    check_grasps,
    contact_faults,
    find_contact,
    longest_contact,
    torn_groups,
    touched_groups,
)

from .makers import drawn_from_the_prior

STEP = 0.0625
TIME = np.round(np.arange(-20, 101) / 10, 1)


def delayed(grasps, seconds):
    """Return the traces as if the clock had been set to 0 so much too early."""
    time = grasps["time"].values
    moved = np.stack([np.interp(time - seconds, time, row) for row in grasps["t_surface"].values])
    return grasps.assign(t_surface=(("grasp", "time"), moved, grasps["t_surface"].attrs))


def faults_of(grasps):
    return contact_faults(grasps, check_grasps(grasps))


def bounded(grasps, high=np.inf, low=-np.inf):
    """Return what a sensor of sixteenths of a degree reads between two rails."""
    return grasps.assign(t_surface=np.clip(STEP * np.round(grasps["t_surface"] / STEP), low, high))


def test_nothing_is_reported_of_the_example_grasps(files):
    for grasps in files.values():
        assert faults_of(grasps) == []
        for step in (STEP, 0.1, 0.25, 0.5, 1.0):
            coarse = grasps.assign(t_surface=step * np.round(grasps["t_surface"] / step))
            assert not check_grasps(coarse).masked.any()


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0.0, ""), (0.3, ""), (1.0, "contact shows 1."), (2.0, "s after time 0 (median of"),
        (-1.0, "move before time 0; time 0 must be the closed message"), (-1.5, "move before time 0"),
    ],
)  # fmt: skip
def test_a_contact_that_is_not_at_time_0_is_reported(seconds, words):
    found = faults_of(delayed(load_example_grasps()["exp2_dT20"].isel(time=slice(0, 90)), seconds))
    assert len(found) == bool(words)
    assert all(words in fault for fault in found)


@pytest.mark.parametrize(("warmer", "reported"), [(9.99, False), (10.0, True), (-10.0, True)])
def test_a_late_contact_is_reported_from_a_difference_of_10_K_on(warmer, reported):
    time = np.arange(-20, 101) / 8.0
    skin = 32.0 + 0.5 * warmer * -np.expm1(-np.maximum(time - 2.0, 0.0))
    found = faults_of(make_grasps(time, [skin] * 3, list("abc"), t_object=[32.0 + warmer] * 3))
    assert any("after time 0 (median of 3)" in words for words in found) == reported


def test_the_best_insulator_of_the_library_is_an_odd_contact_but_no_missing_one():
    touched = simulate_grasps(
        load_default_gripper().grip(), ["expanded polystyrene"], t_object=43.0, t_gripper=23.0, n=20,
        quantum=0.0,
    )  # fmt: skip
    assert check_grasps(touched).usable.all()
    assert "no contact?" in faults_of(touched)[0]


def test_spikes_are_reported():
    spiked = load_example_grasps()["exp2_dT20"].copy(deep=True)
    spiked["t_surface"][3, [50, 51, 90]] = -127.0
    [words] = faults_of(spiked)
    assert words == "3 spikes in 1 grasp are left out, the first of -127 degC in 'g0179'"


def test_a_block_whose_touches_stand_in_two_files_is_reported_with_how_many_are_like_it():
    ids, groups = ["a1", "a2", "a3", "a4"], ["p", "q", "", "r"]
    record = make_grasps([-1.0, 1.0], [[23.0, 25.0]] * 4, ids, touch_group=groups, name="a")
    one, two, three = ("a", touched_groups(record)), ("b", ["q", "p"]), ("c", ["r", "s"])
    [words] = torn_groups([one, two, three])
    assert words.startswith("touch_group 'p' (2 more like it) is in a and in b, and touches are joined")
    [words] = torn_groups([one, three])
    assert words.startswith("touch_group 'r' is in a and in c")
    assert torn_groups([two, three]) == []


@pytest.mark.parametrize("drift", [-0.2, 0.0, 0.3])
@pytest.mark.parametrize("rate", [-5.0, 2.0])
@pytest.mark.parametrize("at", [0.0, 0.4, 3.0])
def test_contact_is_where_the_ramp_leaves_the_line(drift, rate, at):
    skin = 23.0 + drift * TIME + rate * np.maximum(TIME - at, 0.0)
    assert find_contact(TIME, skin) == pytest.approx(at, abs=1e-6)


def test_contact_is_found_among_lost_readings():
    skin = 23.0 + 3.0 * np.maximum(TIME - 0.5, 0.0)
    skin[[12, 15, 25, 27]] = np.nan  # two before the message, two about the contact
    assert find_contact(TIME, skin) == pytest.approx(0.5, abs=1e-6)


def step_at(*odd):
    """Return a skin at 23 degC with some odd readings."""
    skin = np.full(TIME.size, 23.0)
    for at, value in odd:
        skin[at] = value
    return skin


RAMP = 23.0 + 5.0 * np.maximum(TIME - 0.4, 0.0)


@pytest.mark.parametrize(
    ("time", "skin", "onset"),
    [
        # two odd readings are no contact, and three that do not rise stay where they are
        (TIME, step_at((30, 24.0), (31, 24.0)), None),
        (TIME, step_at((30, 24.0), (31, 24.0), (32, 22.0)), None),
        (TIME, step_at((30, 24.0), (31, 24.0), (32, 24.0)), TIME[30]),
        # extrapolated back by half a second at most
        (TIME, 23.0 + np.where(TIME >= 2.0, 2.0 + 0.1 * (TIME - 2.0), 0.0), 1.5),
        # four readings before the message are needed, and some after it
        (TIME[17:], RAMP[17:], None),
        (TIME[16:], RAMP[16:], 0.4),
        (TIME[:20], RAMP[:20], None),
        # what happened before the line begins does not count
        (TIME, np.where(TIME < -1.2, 25.0, 23.0), None),
        (TIME, RAMP + np.where(TIME < -1.2, 2.0, 0.0), 0.4),
    ],
)
def test_where_contact_is_found(time, skin, onset):
    assert find_contact(time, skin) == (None if onset is None else pytest.approx(onset, abs=1e-6))


def test_what_a_short_line_leaves_open_is_no_contact():
    # ten readings know their slope to 0.044 K/s, so after 10 s the line is out by 0.44 K, or eleven times the
    # noise; of Student's t with 8 degrees of freedom 3e-4 lies beyond 6
    rng = np.random.default_rng(5)
    found = [find_contact(TIME, 23.0 + 0.04 * rng.standard_normal(TIME.size)) for _ in range(200)]
    assert sum(onset is not None for onset in found) <= 1


@pytest.mark.parametrize(("share", "found"), [(0.97, False), (1.03, True)])
def test_three_readings_are_measured_with_the_uncertainty_of_the_line(share, found):
    t = np.array([-0.4, -0.3, -0.2, -0.1, 0.0, 0.1, 0.2])
    odd = np.array([0.1, -0.1, -0.1, 0.1])  # neither level nor slope in it: s^2 = 4 * 0.01 / (4 - 2)
    about = t[4:] + 0.25  # and the squares of the four times about their mean are 0.05 together
    limit = 6 * np.sqrt(0.02 * (1 + 1 / 4 + about**2 / 0.05))
    felt = find_contact(t, np.concatenate([23.0 + odd, 23.0 + share * limit]))
    assert (felt is not None) == found


@pytest.mark.parametrize("rail", [44.0, 41.0, 38.0])
@pytest.mark.parametrize("mirrored", [False, True])
def test_all_samples_at_a_rail_are_found(rail, mirrored):
    grasps = load_example_grasps()["exp2_dT20"]  # the gripper is 20 K warmer
    cut = bounded(grasps, low=rail)
    at_rail = cut["t_surface"].values == rail
    if mirrored:
        cut = cut.assign(t_surface=80.0 - cut["t_surface"])
    quality = check_grasps(cut)
    found, reading, hit = quality.masked, quality.clipped_at, quality.masked.any(axis=1)
    assert found[at_rail].all()
    assert found.sum() < 1.02 * at_rail.sum()
    assert set(reading[hit].tolist()) == {80.0 - rail if mirrored else rail}
    assert np.isnan(reading[~hit]).all()
    assert np.isnan(quality.read(cut)["t_surface"].values).sum() == found[quality.usable].sum()


def test_a_stuck_sensor_clips_its_own_grasp_alone():
    grasps = bounded(load_example_grasps()["exp2_dT20"])
    skin = grasps["t_surface"].values.copy()
    stuck = 10  # copper: 20 K warmer than it, the skin falls for seconds
    skin[stuck, 26:] = skin[stuck, 26]
    found = check_grasps(grasps.assign(t_surface=(("grasp", "time"), skin))).masked
    assert np.flatnonzero(found.any(axis=1)).tolist() == [stuck]


def test_spikes_are_found_wherever_they_stand_and_hide_no_rail():
    grasps = bounded(load_example_grasps()["exp2_dT20"], low=41.0)
    skin = grasps["t_surface"].values.copy()
    at = ([0, 3, 3, 8, 9, 9, 9], [0, 60, 61, 24, 118, 119, 120])
    skin[at] = [85.0, -127.0, -127.0, 0.0, 85.0, 85.0, 85.0]
    spoilt = grasps.assign(t_surface=(("grasp", "time"), skin))
    assert [row.tolist() for row in np.nonzero(check_grasps(spoilt).spiked)] == list(at)
    lost = check_grasps(grasps).masked
    lost[at] = False
    np.testing.assert_array_equal(check_grasps(spoilt).masked & ~check_grasps(spoilt).spiked, lost)


def test_clipped_samples_reach_no_average():
    cut = bounded(load_example_grasps()["exp2_dT20"], low=41.0)
    whole, lost = touches(cut), touches(check_grasps(cut).read(cut))
    np.testing.assert_array_equal(whole.count, lost.count)
    np.testing.assert_array_equal(whole.y[whole.count > 0], lost.y[lost.count > 0])


@pytest.mark.slow
def test_intervals_of_clipped_grasps_cover(device):
    """Taken for readings, the samples at this rail leave 0.29 of the effusivities in their 90 % intervals."""
    n = 60
    grasps, x, _ = drawn_from_the_prior(device, n, low=2000.0, high=50000.0, seed=7)
    cut = bounded(grasps, high=30.0)
    assert check_grasps(cut).masked.any(axis=1).mean() > 0.75
    ends = [
        mixture_quantiles(p.mass, p.x, np.full(p.x.size, 1e-4), (0.05, 0.95))
        for p in grid_posteriors(device, touches(cut))
    ]
    within = [low < true < high for true, (low, high) in zip(x, ends)]
    assert 0.9 - 3 * np.sqrt(0.09 / n) < np.mean(within)


def made(*skins, time=TIME, **given):
    """Return a record of these skins, each given as readings or as (where, value) pieces on 23 degC."""
    rows = [
        np.select([w for w, _ in s], [v for _, v in s], 23.0) if isinstance(s, list) else s for s in skins
    ]
    given = {name: np.broadcast_to(value, len(rows)) for name, value in given.items()}
    return make_grasps(time, rows, [f"g{i}" for i in range(len(rows))], **given)


def jump(by, since=0.0):
    """Return a skin that moves at once, which no sensor's end is: it is one of its steps."""
    return [(since < TIME, 23.0 + by)]


def within(low, high, by):
    return [((low - 1e-9 <= TIME) & (high + 1e-9 >= TIME), 23.0 + by)]


@pytest.mark.parametrize(
    ("skin", "warmer", "sd", "end", "reason"),
    [
        # 0.6 % of the difference, 10 K of it, 3 s of contact
        (jump(0.0599), 10.0, np.nan, 10.0, NO_CONTACT), (jump(0.0601), 10.0, np.nan, 10.0, ""),
        (jump(-0.0599), -10.0, np.nan, 10.0, NO_CONTACT), (jump(-0.0601), -10.0, np.nan, 10.0, ""),
        (jump(0.0), 9.99, np.nan, 10.0, ""), (jump(0.0), np.nan, np.nan, 10.0, ""),
        ([(TIME > 8.0, np.nan)], 20.0, np.nan, 10.0, ""), (jump(0.0), -20.0, np.nan, 3.0, NO_CONTACT),
        (jump(0.0), -20.0, np.nan, 2.9, ""),
        # of the least that the difference may be
        (jump(0.119), 24.0, 2.0, 10.0, NO_CONTACT), (jump(0.121), 24.0, 2.0, 10.0, ""),
        (jump(0.0), 12.0, 1.0, 10.0, NO_CONTACT), (jump(0.0), 11.99, 1.0, 10.0, ""),
        # in the last second: ten readings, from 9.1 s on; a level of those up to -0.3 s, eighteen
        (within(9.1, 9.2, 0.5), 10.0, np.nan, 10.0, ""),
        (within(8.8, 9.0, 0.5), 10.0, np.nan, 10.0, NO_CONTACT),
        (within(-0.4, -0.3, 0.59), 10.0, np.nan, 10.0, ""),
        (within(-0.2, 0.0, 0.59), 10.0, np.nan, 10.0, NO_CONTACT),
        # 5 % the other way
        (jump(-1.01), 20.0, np.nan, 10.0, CONTRARY), (jump(-0.99), 20.0, np.nan, 10.0, ""),
        (jump(1.01), -20.0, np.nan, 10.0, CONTRARY), (jump(5.0), 20.0, np.nan, 10.0, ""),
        (jump(-1.1), 24.0, 2.0, 10.0, CONTRARY), (jump(-3.0), 11.99, 1.0, 10.0, ""),
        (jump(-0.51), 10.0, np.nan, 10.0, CONTRARY), (jump(-2.0), 9.99, np.nan, 10.0, ""),
        (jump(-2.0), 20.0, np.nan, 3.0, CONTRARY), (jump(-2.0), 20.0, np.nan, 2.9, ""),
    ],
)  # fmt: skip
def test_what_shows_that_there_was_no_contact_or_another_object(skin, warmer, sd, end, reason):
    record = made(skin, t_object=23.0 + warmer, t_object_sd=sd).sel(time=slice(None, end))
    level = record["t_surface"].values[0, record["time"].values < -0.25].mean()
    record["t_object"] = record["t_object"] + (level - 23.0)
    quality = check_grasps(record)
    assert (quality.reason, quality.note) == ([reason], [reason])
    assert quality.usable.tolist() == [not reason]


@pytest.mark.parametrize(
    ("skin", "warmer", "end", "undecided"),
    [
        (jump(0.1199), 20.0, 1.0, True), (jump(0.1201), 20.0, 1.0, False),
        (jump(-0.1201), -20.0, 1.0, False), (jump(0.1201), -20.0, 1.0, True),
        (jump(0.0), 10.0, 5.0, True), (jump(0.0), 9.99, 5.0, False), (jump(0.0), np.nan, 5.0, False),
        # a reading after 0.25 s is needed
        (jump(2.0), 20.0, 0.2, True), (jump(2.0), 20.0, 0.3, False),
        # the last three readings
        (within(0.9, 1.0, 0.19), 20.0, 1.0, False), (within(0.9, 1.0, 0.17), 20.0, 1.0, True),
        # 0.5 K a reading, and then 0.3 s, or less, at the highest or the lowest
        (23.0 + np.clip(5 * TIME, 0.0, 5.0), 20.0, 1.3, True),
        (23.0 + np.clip(5 * TIME, 0.0, 5.0), 20.0, 1.2, False),
        (23.0 - np.clip(5 * TIME, 0.0, 5.0), -20.0, 1.3, True),
        (23.0 - np.clip(5 * TIME, 0.0, 5.0), -20.0, 1.2, False),
        (23.0 + np.clip(5 * TIME, 0.0, 5.0) - (TIME > 1.35), 20.0, 1.5, False),
        (np.where(abs(TIME - 1.2) < 0.01, np.nan, 23.0 + np.clip(5 * TIME, 0.0, 5.0)), 20.0, 1.3, True),
    ],
)  # fmt: skip
def test_which_contacts_are_too_short_to_be_evaluated(skin, warmer, end, undecided):
    record = made(skin, t_object=23.0 + warmer).sel(time=slice(None, end))
    assert check_grasps(record).undecided.tolist() == [undecided]


RISE = 23.0 + np.clip(10 * TIME, 0.0, 10.0)  # 1 K a reading, at the rail of 33 degC from 1.0 s on


def test_what_is_read_of_a_saturated_trace():
    rail = 33.0
    rows = [
        RISE, jump(5.0),
        # nothing before -0.25 s, or after 0.15 s, and one reading there
        [(TIME < -0.25, rail)], [(TIME > 0.15, rail)],
        [(TIME < -0.35, rail)], [(TIME > 0.25, rail), (TIME > 0.15, 32.9)],
        [(TIME > -5, rail)],
    ]  # fmt: skip
    record = made(*rows)
    quality = check_grasps(record)
    assert quality.reason == ["", "", OUT_OF_RANGE, OUT_OF_RANGE, "", "", OUT_OF_RANGE]
    words = "33 degC from {} s on is the end of the sensor's range"
    assert quality.note == [
        words.format("1.0"), "", OUT_OF_RANGE, OUT_OF_RANGE, words.format("-2.0"), words.format("0.3"),
            OUT_OF_RANGE,
    ]  # fmt: skip
    np.testing.assert_array_equal(quality.clipped_at, [rail, np.nan, rail, rail, rail, rail, rail])
    assert quality.masked.sum(axis=1).tolist() == [91, 0, 18, 99, 17, 98, 121]
    assert not quality.spiked.any()
    part = quality.read(record)
    assert part["grasp"].values.tolist() == ["g0", "g1", "g4", "g5"]
    whole = check_grasps(record, whole_traces=True)
    needed = f"{words.format('1.0')}, and this classifier needs whole traces"
    assert (whole.reason[0], whole.note[0], whole.reason[1]) == (needed, needed, "")
    short = check_grasps(record, longest=5.0)
    assert short.note[:2] == [
        words.format("1.0"), "read until 5 s, as long as contacts of the training lasted"
    ]  # fmt: skip
    assert short.until == 5.0


@pytest.mark.parametrize(
    ("end", "groups", "shortened", "last"),
    [(4.9, "", False, 4.9), (5.0, "", False, 5.0), (6.0, "", False, 5.0), (6.1, "", True, 5.0),
     (9.0, "block", False, 9.0)],
)  # fmt: skip
def test_a_contact_is_shortened_from_1_2_times_the_longest_on(end, groups, shortened, last):
    record = made(jump(5.0), t_object=43.0, touch_group=groups, touch=1).sel(time=slice(None, end))
    quality = check_grasps(record, longest=5.0)
    assert quality.shortened.tolist() == [shortened]
    assert quality.read(record)["time"].values[-1] == last
    assert quality.usable_grasps(record) is record


def ramp(rate, rises=1.0, stays=9.0, step=0.1):
    """Return times and a skin that rises for so long, stays there for so long, and falls."""
    time = step * np.arange(round(-2 / step), round((rises + stays + 1) / step) + 1)
    return time, 23.0 + rate * (np.clip(time, 0, rises) - np.maximum(time - rises - stays, 0.0))


@pytest.mark.parametrize(
    ("time", "skin", "clipped"),
    [
        # 2 s at the end, of three readings at least, after more than five steps in the second before
        (*ramp(10.0, stays=2.0), True), (*ramp(10.0, stays=1.9), False),
        (*ramp(6.0, 6.0, stays=2.0, step=1.0), False),
        (TIME, 23.0 + np.where(TIME > 0, 1.0, 0.0) * np.round(np.minimum(5.0, 5 * TIME / 0.9)), False),
        (TIME, 23.0 + np.where(TIME > 0, 1.0, 0.0) * np.round(np.minimum(6.0, 6 * TIME / 0.9)), True),
        # a step is a millikelvin at least
        (*ramp(0.004), False), (*ramp(0.006), True),
        # at the top before contact only
        (TIME, np.where(TIME < 0, 23.0, 23.0 - np.minimum(8 * TIME, 6.0) - 0.01 * TIME), False),
    ],
)  # fmt: skip
def test_what_saturates(time, skin, clipped):
    record = make_grasps(time, [skin], ["a"])
    assert check_grasps(record).masked.any() == clipped
    mirrored = record.assign(t_surface=46.0 - record["t_surface"])
    assert check_grasps(mirrored).masked.any() == clipped


@pytest.mark.parametrize(
    ("before", "silent", "clipped"),
    [
        ([0.0, 0.5, 0.25], 30, True), ([0.0, 0.5, 0.25], 29, False), ([0.0, 0.25], 60, False),
        ([0.0, 0.0, 0.0], 60, False), ([0.0] * 14 + [0.5, 0.25], 60, False),
    ],
)  # fmt: skip
def test_a_sensor_that_falls_silent_is_at_its_end(before, silent, clipped):
    """A slow rise by one step a second, from a jitter over three of them, or two, or none."""
    n = round((TIME < -0.25).sum())
    skin = np.concatenate([(before * n)[:n], 0.25 + 0.25 * np.floor(np.arange(TIME.size - n) / 10)])
    top = TIME.size - silent
    skin[top:] = skin[top - 1] + 0.25
    record = made(23.0 + skin)
    assert check_grasps(record).masked.any() == clipped


@pytest.mark.parametrize(
    ("at", "by", "spiked"),
    [
        ([0], 10.1, True), ([0], -10.1, True), ([0], 9.9, False), ([0, 1, 2], 30.0, True),
        ([0, 1, 2, 3], 30.0, False),
        ([-1], 10.1, True), ([-1, -2, -3], -30.0, True), ([-1, -2, -3, -4], 30.0, False),
        ([1, 2], 30.0, True), ([60], 0.59, False), ([60], 0.61, True), ([60, 61, 62], 5.0, True),
        ([60, 61, 62, 63], 5.0, False),
    ],
)  # fmt: skip
def test_which_readings_are_spikes(at, by, spiked):
    skin = 23.0 + 0.01 * np.arange(TIME.size)  # rises by a step of 0.01 K
    skin[at] += by
    quality = check_grasps(made(skin))
    hit = {k % TIME.size for k in at} | ({0} if at == [1, 2] else set())  # what stands before them goes too
    assert set(np.flatnonzero(quality.spiked[0]).tolist()) == (hit if spiked else set())
    np.testing.assert_array_equal(quality.masked, quality.spiked)
    assert np.isnan(quality.read(made(skin))["t_surface"].values).sum() == quality.spiked.sum()


def test_seven_readings_are_needed_for_a_leap_and_a_coarse_sensor_may_flicker_by_two_steps():
    rows = np.array([85.0, *23.0 + 0.1 * np.arange(6)])
    for n, spiked in ((7, 1), (6, 0)):
        record = make_grasps(np.arange(n) - 2.0, [rows[:n]], ["a"])
        assert check_grasps(record).spiked.sum() == spiked
    for steps, spiked in ((2, 0), (3, 1)):
        skin = 23.0 + np.floor(TIME / 4)  # by a whole degree every 4 s
        skin[60] += steps
        assert check_grasps(made(skin)).spiked.sum() == spiked


def test_what_contact_faults_says_of_each_fault():
    def faults(*skins, **given):
        return faults_of(made(*skins, **given))

    [words] = faults(jump(5.0), RISE)
    assert words == "1 grasp ('g1' first) saturate at 33 degC: a sensor at the end of its range?"
    # 1.5 % of the least that the difference may be
    three = made(jump(0.449), jump(0.299), jump(0.301), t_object=[53.0, 43.0, 43.0], t_object_sd=np.nan)
    assert faults_of(three) == ["2 grasps ('g0' first) 20 K from their object stay as they are: no contact?"]
    two = faults(jump(-1.01), jump(5.0), t_object=43.0)
    assert two == [f"1 grasp ('g0' first): {CONTRARY}"]


EARLY = [(TIME > 0, 33.0), ((TIME > -0.65) & (TIME < 0.05), 23.81)]  # 4.05 % of 20 K within half a second
LITTLE = [(TIME > 0, 33.0), ((TIME > -0.65) & (TIME < 0.05), 23.79)]
WORDS_EARLY = (
    " move before time 0; time 0 must be the closed message, and the record must start before contact"
)


@pytest.mark.parametrize(
    ("skins", "words"),
    [
        ([EARLY], "1 grasp of 1" + WORDS_EARLY), ([LITTLE], None),
        ([EARLY, EARLY, LITTLE], "2 grasps of 3" + WORDS_EARLY),
        # half of them are not most
        ([EARLY, LITTLE], None),
        # windows of six and four readings: -2.0 to -1.5 s, -0.6 to -0.3 s
        ([[(TIME > 0, 33.0), ((TIME > -0.45) & (TIME < 0.05), 26.0)]], "1 grasp of 1" + WORDS_EARLY),
        ([[(TIME > 0, 33.0), ((TIME > -0.35) & (TIME < 0.05), 25.9)]], None),
        ([[(TIME > 0, 33.0), (TIME < -1.75, 21.0)]], "1 grasp of 1" + WORDS_EARLY), ([[(TIME > 0, 33.0),
        (TIME < -1.85, 22.5)]], None),
        *[([23.0 + 5.0 * np.maximum(TIME - t, 0.0)] * late + [RAMP] * (n - late), words) for t, late, n,
            words in (
            (0.69, 1, 1, None), (1.5, 2, 4, None),
            (0.72, 1, 1, "contact shows 0.7 s after time 0 (median of 1); time 0 must be the closed message"),
            (1.5, 2, 3, "contact shows 1.5 s after time 0 (median of 3); time 0 must be the closed message"),
        )],
    ],
)  # fmt: skip
def test_how_a_clock_that_is_off_is_told(skins, words):
    found = faults_of(made(*skins, t_object=43.0))
    assert [w for w in found if "time 0 must" in w] == ([] if words is None else [words])


def test_rests_grow_touch_by_touch_in_the_order_of_the_touches():
    moved, still = [23.0, 23.0, 30.0, 30.0], [23.0] * 4
    rows = [moved, still, still, moved, moved, still, moved, moved]
    group, order = ["one"] * 6 + ["two", ""], [1, 3, 2, 5, 4, 6, 1, 1]
    rest = [np.nan, np.nan, 50.0, 30.0, np.nan, 20.0, 7.0, np.nan]
    rows[2] = [23.0, 23.0, 23.0, np.nan]
    names = [*"abcdefgh"]
    grasps = make_grasps(
        [-1.0, 0.0, 9.5, 10.0], rows, names, t_object=[43.0] * 8, touch_group=group, touch=order, rest=rest
    )
    part = check_grasps(grasps).usable_grasps(grasps)
    assert part["grasp"].values.tolist() == ["a", "d", "e", "g", "h"]
    # e: 60 s of its own, c (50 s, read until 9.5 s) and b (60 s, 10 s)
    np.testing.assert_array_equal(part["rest"].values, [np.nan, 30.0, 60 + 59.5 + 70, 7.0, np.nan])
    assert check_grasps(grasps.isel(grasp=[1])).usable_grasps(grasps.isel(grasp=[1])) is None


def test_a_reading_a_quarter_of_a_second_from_time_0_is_of_neither_side():
    time = np.arange(-8, 41) / 4.0
    odd = np.where(time == -0.25, 0.59, 0.0)
    assert check_grasps(made(23.0 + odd, time=time, t_object=33.0)).reason == [NO_CONTACT]
    first = made(23.0 + 2.0 * (time > 0), time=time, t_object=43.0).sel(time=slice(None, 0.25))
    assert check_grasps(first).undecided.tolist() == [True]
    top = np.where(time < -0.25, 33.0, 23.0)
    both = made(top, 23.0 + np.interp(time, [0.0, 0.25, 1.25], [0.0, 0.5, 10.0]), time=time)
    assert check_grasps(both).reason[0] == OUT_OF_RANGE
    # but the last half second before contact is until then
    moved = made(np.where(time > 0, 33.0, 23.0 + 1.7 * (time == -0.25)), time=time, t_object=43.0)
    assert [w for w in faults_of(moved) if "1 grasp of 1 move before time 0" in w]


def test_the_longest_contact_is_that_of_all_records():
    records = [made(jump(5.0)).sel(time=slice(None, end)) for end in (4.0, 9.0, 6.0)]
    assert longest_contact(records) == 9.0


@pytest.fixture(scope="module")
def long():
    """Contacts of 40 s."""
    return load_example_grasps()["exp4_cooled5_obj18_grip38_40s"].isel(grasp=[0, 8, 16, 24, 32])


@pytest.fixture(scope="module")
def short():
    """What contacts of 10 s taught."""
    files = load_example_grasps()
    training = [files[name] for name in ("exp1A_obj43_grip23", "exp3C_obj18_grip38")]
    return PosteriorClassifier().fit([r.isel(grasp=r["split"].values == "train") for r in training])


def test_a_longer_contact_is_named_by_its_beginning_and_the_answer_reports_it(short, long):
    rows = classify_grasps(short, long)
    first = classify_grasps(short, long.sel(time=slice(None, 10.0)))
    assert {row.pop("note") for row in rows} == {
        "read until 10 s, as long as contacts of the training lasted"
    }
    assert {row.pop("note_codes") for row in rows} == {"readings"}
    assert {row.pop(column) for row in first for column in ("note", "note_codes")} == {""}
    assert {row.pop("deviates") for row in rows + first} == {""}
    assert [row.pop("material") for row in rows] == [row.pop("material") for row in first]
    assert [row.pop("grasp_id") for row in rows] == [row.pop("grasp_id") for row in first]
    for row, wanted in zip(rows, first):
        assert row == pytest.approx(wanted, rel=1e-6, abs=1e-9)
    assert {row["decided_at_s"] for row in rows} == {10.0}
    np.testing.assert_allclose(
        short.predict_proba(long), short.predict_proba(long.sel(time=slice(None, 10.0))), rtol=1e-6, atol=1e-9
    )


def test_a_stream_stays_with_its_answer_once_contact_lasts_longer(short, long):
    touch = Stream(short, t_object=18.0, t_ambient=float(long["t_ambient"].values[0]))
    for time, reading in zip(long["time"].values, long["t_surface"].values[0]):
        if (time > 9.6 and time < 10.3) or time > 39.5 or time < 1.0:
            touch.update(float(time), float(reading))
            if abs(time - 10.0) < 1e-6:
                at_ten = touch.log_p
    np.testing.assert_array_equal(touch.log_p, at_ten)
    np.testing.assert_allclose(list(touch.result().values()), np.exp(at_ten), atol=1e-3)


def test_how_long_contacts_lasted_is_in_the_file_and_may_be_absent(short, tmp_path):
    folder = save_classifier(short, tmp_path / "finger")
    assert load_classifier(folder).longest_ == 10.0
    file = folder / "classifier.json"
    content = json.loads(file.read_text())
    file.write_text(json.dumps(content | {"numbers": {}}))  # as earlier versions wrote it
    assert load_classifier(folder).longest_ == np.inf
    file.write_text(json.dumps(content | {"numbers": {"longest_contact_s": -3.0}}))
    with pytest.raises(UserError, match=r"is damaged \(longest_contact_s -3\.0\)"):
        load_classifier(folder)


def test_two_touches_are_read_whole():
    """What the first one took from the block depends on how long it lasted."""
    two = load_example_grasps()["exp5_two_touch_unknown_object"]
    quality = check_grasps(two, longest=5.0)
    assert quality.read(two).equals(two)
    assert not quality.shortened.any()


def test_a_trace_that_was_lost_early_is_no_longer_contact(long):
    lost = long.assign(
        t_surface=long["t_surface"].where((long["time"] < 9.0) | (long["grasp"] != long["grasp"][0]))
    )
    assert check_grasps(lost, longest=10.0).shortened.tolist() == [False, True, True, True, True]
    assert longest_contact([lost.isel(grasp=[0])]) == pytest.approx(8.9)
