"""A file that was cut, flipped or filled with nonsense is refused in one line, whatever reads it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.end_to_end.conftest import Bench, small_plant
from tests.end_to_end.damage import KINDS, damaged_case, read_many, whole_files
from thermogrip.classify.estimators.registry import load_classifier, make_classifier, save_classifier
from thermogrip.datasets.errors import UserError, known_names
from thermogrip.datasets.grasp_files import read_grasps
from thermogrip.datasets.log_files import read_log, write_log
from thermogrip.mpc.controllers.mpc import design_controller
from thermogrip.rig.records.batch import read_plan
from thermogrip.rig.records.run_folder import read_run

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="children are forked")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    whole_files(folder)
    return folder


@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_file_is_read_or_refused(kind: str, whole: Path) -> None:
    ends = read_many(kind, whole, range(-1, 2))
    assert ends.pop(-1) in ("0", "3")  # the whole one
    assert set(ends.values()) <= {"0", "2", "3"}


@pytest.mark.parametrize(
    ("kind", "seed"), [("log.nc", 1292), ("one.mcap", 1283), ("features-lda/", 1247), ("posterior/", 1051)]
)
def test_damage_that_was_no_line_once_is_one(kind: str, seed: int, whole: Path) -> None:
    """A lost column, a clock of centuries, a divisor of zero, a curvature that is none."""
    assert read_many(kind, whole, [seed])[seed] in {"0", "2", "3"}


def test_grasps_of_a_run_that_cannot_be_read_are_reported(whole: Path, tmp_path: Path) -> None:
    damaged_case(whole, tmp_path / "place", "run/", -1)
    run = tmp_path / "place" / "run"
    (run / "grasps_meta.csv").write_text("grasp_id")
    assert "grasps_meta.csv: has a header but no rows" in read_run(run).lost


def test_a_header_whose_line_has_no_end_has_no_rows(tmp_path: Path) -> None:
    plan = tmp_path / "plan.csv"
    plan.write_text("material,t_object_degC,target_degC")
    with pytest.raises(UserError, match=r"plan.csv: has a header but no rows; give at least two rows"):
        read_plan(plan)


def test_a_log_whose_column_lost_every_reading_is_read_without_it(bench: Bench) -> None:
    log = read_log(bench.path / "good.csv")
    path = write_log(log, bench.path / "log.nc")
    import h5py

    with h5py.File(path, "r+") as file:
        file["t_ambient"][...] = np.nan
    assert "t_ambient" not in read_log(path)


def test_a_guess_of_a_column_that_a_file_has_lost_is_no_guess(bench: Bench) -> None:
    path = write_log(read_log(bench.path / "good.csv"), bench.path / "log.nc")
    import h5py

    with h5py.File(path, "r+") as file:
        file.attrs["guesses"] = "gone: input, by its course"
    small_plant().save(bench.path / "plant.json")
    done = bench.run("simulate", bench.path / "plant.json", path, "--out", bench.path / "s.csv")
    assert done.code == 0


def test_a_reading_beyond_all_use_is_lost(bench: Bench) -> None:
    text = (bench.path / "good.csv").read_text().splitlines()
    cells = text[9].split(",")
    text[9] = ",".join([*cells[:3], "3.40E+38", *cells[4:]])
    log = read_log(bench.write("far.csv", "\n".join(text) + "\n"))
    assert "t_tank: 1 reading(s) beyond 9e+37 taken as lost" in log.attrs["repairs"]
    assert not np.nanmax(log["t_tank"].values) > 100


def test_a_controller_whose_limits_are_a_number_is_no_controller(bench: Bench) -> None:
    plant = small_plant()
    path = design_controller(plant, dt=2.0).save(bench.path / "c.json")
    content = json.loads(path.read_text())
    content["design"]["slew_per_s"] = 1.5
    path.write_text(json.dumps(content))
    for words in (["review", path], ["run", path, "--target", 30, "--twin", "plant.json", "--out", "r"]):
        done = bench.run(*words)
        assert (done.code, len(done.said)) == (2, 1)
        assert f"{path}: slew_per_s: input should be a valid dictionary" in done.err


def test_a_classifier_whose_parts_do_not_fit_together_is_damaged(bench: Bench) -> None:
    grasps = read_grasps(bench.path / "grasps.csv")
    folder = save_classifier(make_classifier("pca-lda").fit(grasps), bench.path / "m")
    content = json.loads((folder / "classifier.json").read_text())
    content["arrays"]["times_"].pop()
    (folder / "classifier.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match=r"classifier.json: is damaged \(pca_mean_ has shape"):
        load_classifier(folder)
    for name in ("pca-lda", "bayes"):
        folder = save_classifier(make_classifier(name).fit(grasps), bench.path / name)
        content = json.loads((folder / "classifier.json").read_text())
        content["arrays"]["scale_"][0] = 0.0
        (folder / "classifier.json").write_text(json.dumps(content))
        with pytest.raises(UserError, match=r"classifier.json: is damaged \(scale_ is not positive"):
            load_classifier(folder)


def test_no_warning_of_python_reaches_the_terminal(tmp_path: Path) -> None:
    program = (
        "import warnings, thermogrip.cli.main as line\n"
        "line.main = lambda: warnings.warn('mean of empty slice', RuntimeWarning)\n"
        "import thermogrip.__main__ as door\n"
        "door.main()\n"
    )
    for words, shown in (([], False), (["--debug"], True)):
        done = subprocess.run(
            [sys.executable, "-c", program, *words], capture_output=True, text=True, check=True
        )
        assert ("mean of empty slice" in done.stderr) is shown


def test_a_name_is_not_suggested_in_place_of_itself() -> None:
    assert known_names("overshoot_degC", ["overshoot_degC", "band_degC"], "see {}") == (
        "see overshoot_degC, band_degC"
    )
