"""What the command line says of grasps without a contact, or with one that comes late."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from thermogrip.classify import classify_grasps, make_classifier
from thermogrip.cli.contact_checks import contact_faults
from thermogrip.cli.main import main
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.log_files import write_grasps
from thermogrip.datasets.schema import Grasps, make_grasps
from thermogrip.rig.simulation.grasps import Grip, simulate_grasps
from thermogrip.sysid.effusivity.quality import without_contact


def delayed(grasps: Grasps, seconds: float) -> Grasps:
    """Return the traces as if the clock had been set to 0 so much too early."""
    time = grasps["time"].values
    moved = np.stack([np.interp(time - seconds, time, row) for row in grasps["t_surface"].values])
    return grasps.assign(t_surface=(("grasp", "time"), moved, grasps["t_surface"].attrs))


def test_nothing_is_said_of_the_example_grasps() -> None:
    found = {name: contact_faults(grasps) for name, grasps in load_example_grasps().items()}
    assert all(words == [] for words in found.values()), found


@pytest.mark.parametrize(("seconds", "said"), [(0.0, False), (0.3, False), (1.0, True), (2.0, True)])
def test_a_late_contact_is_said(seconds: float, said: bool) -> None:
    found = contact_faults(delayed(load_example_grasps()["exp1A_obj43_grip23"], seconds))
    assert bool(found) == said
    assert not said or "after time 0 (median of 40); time 0 must be the closed message" in found[0]


@pytest.mark.parametrize(("warmer", "told"), [(9.99, False), (10.0, True), (-10.0, True)])
def test_a_late_contact_is_told_from_a_difference_of_10_K_on(warmer: float, told: bool) -> None:
    time = np.arange(-20, 101) / 8.0
    skin = 32.0 + 0.5 * warmer * -np.expm1(-np.maximum(time - 2.0, 0.0))
    found = contact_faults(make_grasps(time, [skin] * 3, list("abc"), t_object=[32.0 + warmer] * 3))
    assert any("after time 0 (median of 3)" in words for words in found) == told


def test_one_grasp_without_a_contact_is_named() -> None:
    grasps = load_example_grasps()["exp2_dT20"]
    still = grasps["t_surface"].values.copy()
    still[7] = 48.0 + 0.05 * np.random.default_rng(0).standard_normal(still.shape[1])
    [words] = contact_faults(grasps.assign(t_surface=(("grasp", "time"), still)))
    name = str(grasps["grasp"].values[7])
    assert words == f"1 grasp ({name!r} first) 20 K from their object stay as they are: no contact?"


def test_a_trace_that_ends_early_is_no_missing_contact() -> None:
    grasps = load_example_grasps()["exp2_dT20"]
    assert contact_faults(grasps.assign(t_surface=grasps["t_surface"].where(grasps["time"] < 8.0))) == []


def test_a_skin_that_moves_as_it_touches_is_told_with_what_it_may_cost() -> None:
    grasps = load_example_grasps()["exp2_dT20"]
    drift = np.where(np.arange(24) == 3, 0.4, 0.0)[:, None] * (grasps["time"].values + 2.0)
    moved = grasps.assign(t_surface=grasps["t_surface"] + drift)
    for record in (moved, moved.drop_vars("t_object")):
        [words] = contact_faults(record)
        assert words.startswith(
            "1 grasp ('g0179' first) touched while the skin still moved, by up to 0.38 K/s"
        )
        assert words.endswith("K too warm or too cold; let the gripper settle")


def test_train_warns_and_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, out = tmp_path / "late.nc", tmp_path / "model"
    delayed(load_example_grasps()["exp2_dT20"], 1.0).to_netcdf(file)
    assert main(["train", str(file), "--classifier", "pca-lda", "--out", str(out)]) == 0
    assert "contact shows 1." in capsys.readouterr().err


def test_a_grasp_that_touched_nothing_has_no_effusivity_and_leaves_the_others_as_they_were(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    grasps = load_example_grasps()["exp2_dT20"].isel(grasp=[0, 8, 16])
    still = grasps.copy(deep=True)
    still["t_surface"][1] = 48.0 + 0.05 * np.random.default_rng(0).standard_normal(still.sizes["time"])
    for name, record in (("all", grasps), ("missed", still)):
        record.to_netcdf(tmp_path / f"{name}.nc")
        out = tmp_path / f"{name}.csv"
        assert main(["effusivity", str(tmp_path / f"{name}.nc"), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    missing = str(grasps["grasp"].values[1])
    assert f"no contact, so no effusivity: {missing}\n" in said
    full, part = ((tmp_path / f"{name}.csv").read_text().splitlines() for name in ("all", "missed"))
    assert part[2] == missing + 8 * ",nan"
    assert part[0] == full[0]
    for one, other in ((part[1], full[1]), (part[3], full[3])):
        cells, wanted = (np.array(line.split(",")[1:], dtype=float) for line in (one, other))
        np.testing.assert_allclose(cells, wanted, rtol=1e-4)  # six digits are written


def test_the_best_insulator_of_the_library_is_a_contact_that_is_doubted_but_no_missing_one() -> None:
    touched = simulate_grasps(
        Grip.from_device(), ["expanded polystyrene"], t_object=43.0, t_gripper=23.0, n=20, quantum=0.0
    )
    assert not without_contact(touched).any()
    assert "no contact?" in contact_faults(touched)[0]


def test_what_touched_nothing_is_none_of_the_candidates() -> None:
    grasps = load_example_grasps()["exp2_dT20"]
    train, test = (grasps.isel(grasp=grasps["split"].values == which) for which in ("train", "test"))
    missed = test.copy(deep=True)
    missed["t_surface"][0] = 48.0 + 0.05 * np.random.default_rng(0).standard_normal(test.sizes["time"])
    finger = make_classifier("posterior").fit([train])
    rows, usual = classify_grasps(finger, missed), classify_grasps(finger, test)
    assert rows[0]["p_unknown"] == 1.0
    wanted = [row["p_unknown"] for row in usual[1:]]  # to rounding: one grasp fewer is summed over
    assert [row["p_unknown"] for row in rows[1:]] == pytest.approx(wanted, rel=1e-6, abs=1e-9)


def test_a_sensor_at_the_end_of_its_range_is_told_and_a_coarse_one_is_not() -> None:
    grasps = load_example_grasps()["exp2_dT20"]
    clipped = contact_faults(grasps.assign(t_surface=np.maximum(grasps["t_surface"], 41.0)))
    assert "stop dead at 41 degC: a sensor at the end of its range?" in clipped[0]
    for step in (0.25, 0.5, 1.0):
        coarse = step * np.round(grasps["t_surface"] / step)
        assert contact_faults(grasps.assign(t_surface=coarse)) == []


def test_what_was_mended_in_a_file_of_grasps_is_said_and_not_for_ever(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    grasps = load_example_grasps()["exp2_dT20"]
    write_grasps(grasps, tmp_path / "twice.csv")
    head, *rows = (tmp_path / "twice.csv").read_text().splitlines()
    at_one = [twice for row in rows for twice in [row] * (1 + (",1.0," in row))]
    (tmp_path / "twice.csv").write_text("\n".join([head, *at_one]) + "\n")
    words = ["train", str(tmp_path / "twice.csv"), "--classifier", "pca-lda", "--out", str(tmp_path / "m")]
    assert main(words) == 0
    said = [line for line in capsys.readouterr().err.splitlines() if "warning: twice:" in line]
    assert "1 repeated time stamp(s) dropped" in said[0]
    assert len(said) == 6
    assert said[5].endswith("more like these")


@pytest.mark.parametrize("seconds", [1.0, 1.5])
def test_a_contact_before_time_0_is_called_early_and_not_late(seconds: float) -> None:
    [words] = contact_faults(delayed(load_example_grasps()["exp2_dT20"].isel(time=slice(0, 90)), -seconds))
    assert "move before time 0; time 0 must be the closed message" in words


def test_spikes_and_a_wrong_object_temperature_are_told() -> None:
    grasps = load_example_grasps()["exp2_dT20"]
    spiked = grasps.copy(deep=True)
    spiked["t_surface"][3, [50, 51, 90]] = -127.0
    [words] = contact_faults(spiked)
    name = str(grasps["grasp"].values[3])
    assert words == f"3 spikes in 1 grasp are left out, the first of -127 degC in {name!r}"
    [words] = contact_faults(grasps.assign(t_object=grasps["t_object"] + 40.0))
    assert "24 grasps ('g0176' first): the skin moves away from t_object" in words


def test_an_object_that_may_be_as_warm_as_the_skin_shows_no_missing_contact() -> None:
    still = load_example_grasps()["exp2_dT20"].isel(grasp=[0])
    still["t_surface"][0] = 48.0
    for sd, missed in ((np.nan, True), (2.0, True), (8.0, False)):
        assert without_contact(still.assign(t_object_sd=("grasp", [sd]))).tolist() == [missed]


def test_touches_of_a_block_in_two_files_are_not_taken_for_joined(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    two = load_example_grasps()["exp5_two_touch_unknown_object"]
    files = []
    for touch in (1, 2):
        some = two.isel(grasp=np.flatnonzero(two["touch"].values == touch)[24:26])
        files.append(write_grasps(some.assign_attrs(name=f"touch{touch}"), tmp_path / f"touch{touch}.csv"))
    main(["effusivity", *map(str, files), "--out", str(tmp_path / "e.csv")])
    said = " ".join(capsys.readouterr().err.split())
    assert (
        "touch_group 'p024' (1 more like it) stands in touch1 and in touch2, and touches are joined" in said
    )


def test_effusivity_tells_of_a_rest_longer_than_known(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    two = load_example_grasps()["exp5_two_touch_unknown_object"].isel(grasp=[28, 76])
    file = write_grasps(two.assign(rest=("grasp", [np.nan, 300.0])), tmp_path / "waited.csv")
    main(["effusivity", str(file), "--out", str(tmp_path / "e.csv")])
    said = " ".join(capsys.readouterr().err.split())
    assert "blocks that rested longer than those that taught how they move between touches" in said
