"""Which grasps, and which of their samples, are usable; and what answers make of the others."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.stats import kstest

from thermogrip.classify import Stream, classify_grasps, load_classifier, save_classifier
from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import Grasps, make_grasps
from thermogrip.sysid.contact.simulation import simulate_grasps
from thermogrip.sysid.effusivity.data import touches
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
from thermogrip.sysid.effusivity.posterior import material_fit
from thermogrip.sysid.effusivity.posterior_grid import grid_posteriors, mixture_quantiles
from thermogrip.sysid.effusivity.quality import (
    BIAS_S,
    NO_CONTACT,
    check_grasps,
    contact_faults,
    find_contact,
    longest_contact,
    torn_groups,
)

from .makers import drawn_from_the_prior, simulated_blocks

STEP = 0.0625
TIME = np.round(np.arange(-20, 101) / 10, 1)


def delayed(grasps, seconds):
    """Return the traces as if the clock had been set to 0 so much too early."""
    time = grasps["time"].values
    moved = np.stack([np.interp(time - seconds, time, row) for row in grasps["t_surface"].values])
    return grasps.assign(t_surface=(("grasp", "time"), moved, grasps["t_surface"].attrs))


def bounded(grasps, high=np.inf, low=-np.inf):
    """Return what a sensor of sixteenths of a degree reads between two rails."""
    return grasps.assign(t_surface=np.clip(STEP * np.round(grasps["t_surface"] / STEP), low, high))


def noisy(slope, n=400, quantum=1 / 16, seed=0):
    y = 30.0 + slope * TIME + np.random.default_rng(seed).normal(0.0, 0.045, (n, TIME.size))
    y = np.round(y / quantum) * quantum if quantum else y
    return make_grasps(TIME, y, [f"g{i}" for i in range(n)])


def test_nothing_is_reported_of_the_example_grasps(files):
    for grasps in files.values():
        assert contact_faults(grasps) == []
        assert not check_grasps(grasps).unsettled.any()
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
    found = contact_faults(delayed(load_example_grasps()["exp2_dT20"].isel(time=slice(0, 90)), seconds))
    assert len(found) == bool(words)
    assert all(words in fault for fault in found)


@pytest.mark.parametrize(("warmer", "reported"), [(9.99, False), (10.0, True), (-10.0, True)])
def test_a_late_contact_is_reported_from_a_difference_of_10_K_on(warmer, reported):
    time = np.arange(-20, 101) / 8.0
    skin = 32.0 + 0.5 * warmer * -np.expm1(-np.maximum(time - 2.0, 0.0))
    found = contact_faults(make_grasps(time, [skin] * 3, list("abc"), t_object=[32.0 + warmer] * 3))
    assert any("after time 0 (median of 3)" in words for words in found) == reported


def test_one_grasp_without_a_contact_is_named_and_one_that_ends_early_is_none():
    grasps = load_example_grasps()["exp2_dT20"]
    still = grasps["t_surface"].values.copy()
    still[7] = 48.0 + 0.05 * np.random.default_rng(0).standard_normal(still.shape[1])
    [words] = contact_faults(grasps.assign(t_surface=(("grasp", "time"), still)))
    name = str(grasps["grasp"].values[7])
    assert words == f"1 grasp ({name!r} first) 20 K from their object stay as they are: no contact?"
    assert contact_faults(grasps.assign(t_surface=grasps["t_surface"].where(grasps["time"] < 8.0))) == []


def test_a_skin_that_moves_as_it_touches_is_reported_with_its_cost():
    grasps = load_example_grasps()["exp2_dT20"]
    drift = np.where(np.arange(24) == 3, 0.4, 0.0)[:, None] * (grasps["time"].values + 2.0)
    moved = grasps.assign(t_surface=grasps["t_surface"] + drift)
    for record in (moved, moved.drop_vars("t_object")):
        [words] = contact_faults(record)
        assert words.startswith(
            "1 grasp ('g0179' first) touched while the skin still moved, by up to 0.38 K/s"
        )
        assert words.endswith("K too warm or too cold; let the gripper settle")


def test_the_best_insulator_of_the_library_is_an_odd_contact_but_no_missing_one():
    touched = simulate_grasps(
        load_default_gripper().grip(), ["expanded polystyrene"], t_object=43.0, t_gripper=23.0, n=20,
        quantum=0.0,
    )  # fmt: skip
    assert check_grasps(touched).usable.all()
    assert "no contact?" in contact_faults(touched)[0]


def test_spikes_saturation_and_a_wrong_object_temperature_are_reported():
    grasps = load_example_grasps()["exp2_dT20"]
    clipped = contact_faults(grasps.assign(t_surface=np.maximum(grasps["t_surface"], 41.0)))
    assert "saturate at 41 degC: a sensor at the end of its range?" in clipped[0]
    spiked = grasps.copy(deep=True)
    spiked["t_surface"][3, [50, 51, 90]] = -127.0
    [words] = contact_faults(spiked)
    name = str(grasps["grasp"].values[3])
    assert words == f"3 spikes in 1 grasp are left out, the first of -127 degC in {name!r}"
    [words] = contact_faults(grasps.assign(t_object=grasps["t_object"] + 40.0))
    assert "24 grasps ('g0176' first): the skin moves away from t_object" in words


def test_the_rest_before_a_touch_grows_by_touches_that_are_left_out():
    skins = [[23.0, 23.0, 30.0, 30.0], [43.0] * 4, [23.0, 23.0, 29.0, 29.0]]
    group = {"touch_group": ["one"] * 3, "touch": [1, 2, 3], "rest": [np.nan, 60.0, 45.0]}
    grasps = make_grasps([-1.0, 0.0, 9.0, 10.0], skins, ["a", "b", "c"], t_object=[33.0] * 3, **group)
    quality = check_grasps(grasps)
    assert quality.reason == ["", NO_CONTACT, ""]
    assert quality.usable_part(grasps)["rest"].values.tolist() == pytest.approx([np.nan, 115.0], nan_ok=True)


def test_an_object_that_may_be_as_warm_as_the_skin_shows_no_missing_contact():
    still = load_example_grasps()["exp2_dT20"].isel(grasp=[0])
    still["t_surface"][0] = 48.0
    for sd, missed in ((np.nan, True), (2.0, True), (8.0, False)):
        found = check_grasps(still.assign(t_object_sd=("grasp", [sd])))
        assert (found.reason == [NO_CONTACT]) == missed


def test_a_block_whose_touches_stand_in_two_files_is_reported_with_how_many_are_like_it():
    def record(name: str, groups: list[str]) -> Grasps:
        ids = [f"{name}{k}" for k in range(len(groups))]
        return make_grasps([-1.0, 1.0], [[23.0, 25.0]] * len(ids), ids, touch_group=groups, name=name)

    one, two, three = record("a", ["p", "q", "", "r"]), record("b", ["q", "", "p"]), record("c", ["r", "s"])
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
    assert np.isnan(quality.read(cut)["t_surface"].values).sum() == found.sum()


def test_a_slow_skin_falls_silent_at_a_rail():
    """Jitter that is gone shows it, where the last second before does not."""
    t = np.arange(-20, 101) / 10
    rng = np.random.default_rng(0)
    rise = 4.0 * (1 - np.exp(-np.maximum(t, 0) / 3))
    skin = 23.0 + np.stack([rise + 0.08 * rng.standard_normal(t.size) for _ in range(20)])
    grasps = load_example_grasps()["exp2_dT20"].isel(grasp=range(20), time=slice(0, t.size))
    grasps = grasps.assign(t_surface=(("grasp", "time"), skin))
    assert not check_grasps(bounded(grasps)).masked.any()
    assert check_grasps(bounded(grasps, high=26.0)).masked.any(axis=1).all()


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


def test_the_slope_is_known_as_well_as_its_sd_states():
    """t-distributed with 14 degrees of freedom: 16 readings before -0.4 s."""
    slope, sd = check_grasps(noisy(0.03, quantum=0.0)).drift
    assert kstest((slope - 0.03) / sd, "t", args=(14,)).pvalue > 0.01
    assert np.median(sd) == pytest.approx(0.045 / np.sqrt(16 * (16**2 - 1) / 12 * 0.1**2), rel=0.1)


def test_a_fast_drift_is_found_and_noise_lost_readings_and_early_contacts_are_none():
    def unsettled(y: np.ndarray) -> list[bool]:
        return check_grasps(make_grasps(TIME, y, [str(k) for k in range(len(y))])).unsettled.tolist()

    assert not check_grasps(noisy(0.0)).unsettled.any()
    assert check_grasps(noisy(-0.3)).unsettled.all()
    assert 0.2 < check_grasps(noisy(0.17)).unsettled.mean() < 0.8  # where the docstring says that it begins
    jitter = 0.05 * ((TIME * 10) % 2)
    early = 30.0 + np.where(TIME > -0.35, 8.0 * (TIME + 0.35), 0.0) + jitter
    # readings of one value know no better than their step: one rounding that turns over
    flat = np.stack([np.full(TIME.size, 30.0), np.where(TIME > -0.55, 30.0625, 30.0)])
    assert unsettled(np.concatenate([early[None], flat])) == [False] * 3
    y = np.tile(30.0 + 0.5 * TIME + jitter, (2, 1))
    y[0, 3:6], y[1, 5:20] = np.nan, np.nan
    assert unsettled(y) == [True, False]
    slope, sd = check_grasps(make_grasps(TIME, y, ["some", "few"])).drift
    assert slope[0] == pytest.approx(0.5, abs=3 * sd[0])
    assert np.isnan([slope[1], sd[1]]).all()


@pytest.mark.parametrize(("name", "seconds"), [("copper", 12.0), ("iron", 17.0)])
def test_a_drift_that_lasts_moves_a_metal_by_so_many_seconds_of_it(name, seconds):
    """The drift as the object lets it be: less the integral of the response, by trapezes."""
    device, rate = load_default_gripper(), 0.05
    block = device.blocks[name]
    one = {"ln_e": [block.ln_effusivity], "ln_h": [block.ln_h], "ln_rho_c": [np.log(block.heat_capacity)]}
    grasps, _ = simulated_blocks(device, t_gripper=23.0, t_object=43.0, seed=4, **one)
    y, t = grasps["t_surface"].values, grasps["time"].values
    rise = (y[0] - y[0, t < -0.2].mean()) / 20.0  # the response itself, nearly
    answered = np.concatenate([[0.0], np.cumsum(0.5 * (rise[1:] + rise[:-1]) * np.diff(t))])
    moved = grasps.assign(t_surface=grasps["t_surface"] + rate * (t - np.where(t > 0, answered, 0.0)))
    off = material_fit(device, moved, [name]).t_object - material_fit(device, grasps, [name]).t_object
    assert off[0, 0] == pytest.approx(seconds * rate, rel=0.2)
    assert abs(seconds - BIAS_S) <= 3


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
    begun = classify_grasps(short, long.sel(time=slice(None, 10.0)))
    assert {row.pop("note") for row in rows} == {
        "read until 10 s, as long as contacts of the training lasted"
    }
    assert [row.pop("material") for row in rows] == [row.pop("material") for row in begun]
    assert [row.pop("grasp_id") for row in rows] == [row.pop("grasp_id") for row in begun]
    for row, wanted in zip(rows, begun):
        assert row == pytest.approx(wanted, rel=1e-6, abs=1e-9)
    assert {row["decided_at_s"] for row in rows} == {10.0}
    np.testing.assert_allclose(
        short.predict_proba(long),
        short.predict_proba(check_grasps(long, longest=10.0).cut(long)),
        rtol=1e-6,
        atol=1e-9,
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
    assert check_grasps(two, longest=5.0).cut(two) is two
    assert not check_grasps(two, longest=5.0).shortened.any()


def test_a_trace_that_was_lost_early_is_no_longer_contact(long):
    lost = long.assign(
        t_surface=long["t_surface"].where((long["time"] < 9.0) | (long["grasp"] != long["grasp"][0]))
    )
    assert check_grasps(lost, longest=10.0).shortened.tolist() == [False, True, True, True, True]
    assert longest_contact([lost.isel(grasp=[0])]) == pytest.approx(8.9)
