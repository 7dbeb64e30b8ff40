"""Contacts are read as long as those lasted that taught the gripper."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from thermogrip.classify import Stream, classify_grasps, load_classifier, save_classifier
from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.cli.main import main
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.log_files import write_grasps
from thermogrip.datasets.schema import Grasps
from thermogrip.sysid.effusivity.quality import beginnings, longest_contact, outlast

FIVE = ["brass", "copper", "iron", "wood", "zinc"]


@pytest.fixture(scope="module")
def long() -> Grasps:
    """Contacts of 40 s."""
    return load_example_grasps()["exp4_cooled5_obj18_grip38_40s"].isel(grasp=[0, 8, 16, 24, 32])


@pytest.fixture(scope="module")
def short() -> PosteriorClassifier:
    """What contacts of 10 s taught."""
    files = load_example_grasps()
    training = [files[name] for name in ("exp1A_obj43_grip23", "exp3C_obj18_grip38")]
    return PosteriorClassifier().fit([r.isel(grasp=r["split"].values == "train") for r in training])


def test_a_longer_contact_is_named_by_its_beginning_and_the_answer_says_so(
    short: PosteriorClassifier, long: Grasps
) -> None:
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
        short.predict_proba(long), short.predict_proba(beginnings(long, 10.0)), rtol=1e-6, atol=1e-9
    )


def test_a_gripper_that_was_taught_as_long_reads_all(long: Grasps) -> None:
    taught = PosteriorClassifier().fit(load_example_grasps()["exp4_cooled5_obj18_grip38_40s"])
    assert taught.longest_ == 40.0
    rows = classify_grasps(taught, long)
    assert all("note" not in row and row["decided_at_s"] == 40.0 for row in rows)


def test_a_stream_stays_with_its_answer_once_contact_lasts_longer(
    short: PosteriorClassifier, long: Grasps
) -> None:
    touch = Stream(short, t_object=18.0, t_ambient=float(long["t_ambient"].values[0]))
    for time, reading in zip(long["time"].values, long["t_surface"].values[0]):
        if (time > 9.6 and time < 10.3) or time > 39.5 or time < 1.0:
            touch.update(float(time), float(reading))
            if abs(time - 10.0) < 1e-6:
                at_ten = touch.log_p
    np.testing.assert_array_equal(touch.log_p, at_ten)
    np.testing.assert_allclose(list(touch.result().values()), np.exp(at_ten), atol=1e-3)


def test_how_long_contacts_lasted_is_in_the_file_and_may_be_absent(
    short: PosteriorClassifier, tmp_path: Path
) -> None:
    folder = save_classifier(short, tmp_path / "finger")
    assert load_classifier(folder).longest_ == 10.0
    file = folder / "classifier.json"
    content = json.loads(file.read_text())
    file.write_text(json.dumps(content | {"numbers": {}}))  # as earlier versions wrote it
    assert load_classifier(folder).longest_ == np.inf
    file.write_text(json.dumps(content | {"numbers": {"longest_contact_s": -3.0}}))
    with pytest.raises(UserError, match=r"is damaged \(longest_contact_s -3\.0\)"):
        load_classifier(folder)


def test_two_touches_are_read_whole() -> None:
    """What the first one took from the block depends on how long it lasted."""
    two = load_example_grasps()["exp5_two_touch_unknown_object"]
    assert beginnings(two, 5.0) is two
    assert not outlast(two, 5.0).any()


def test_a_trace_that_was_lost_early_is_no_longer_contact(long: Grasps) -> None:
    lost = long.assign(
        t_surface=long["t_surface"].where((long["time"] < 9.0) | (long["grasp"] != long["grasp"][0]))
    )
    assert outlast(lost, 10.0).tolist() == [False, True, True, True, True]
    assert longest_contact([lost.isel(grasp=[0])]) == pytest.approx(8.9)


def test_effusivity_reads_as_long_as_its_calibration(
    long: Grasps, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    taught = load_example_grasps()["exp3C_obj18_grip38"]
    calibration = write_grasps(taught.assign_attrs(name="taught"), tmp_path / "taught.csv")
    out = []
    for name, record in (("long", long), ("begun", beginnings(long, 10.0))):
        file = write_grasps(record.assign_attrs(name=name), tmp_path / f"{name}.csv")
        main(
            [
                "effusivity",
                str(file),
                "--calibrate",
                str(calibration),
                "--out",
                str(tmp_path / f"{name}_e.csv"),
            ]
        )
        out.append((tmp_path / f"{name}_e.csv").read_text())
        said = " ".join(capsys.readouterr().err.split())
        assert ("long: 5 of 5 contacts are read until 10 s" in said) == (name == "long")
    assert out[0] == out[1]
