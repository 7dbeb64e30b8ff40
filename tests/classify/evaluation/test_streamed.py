"""A comparison by sums beside the same one in memory, and what an ended run goes on to."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from thermogrip.classify.estimators.registry import make_classifier
from thermogrip.classify.evaluation.comparison import POOLED
from thermogrip.classify.evaluation.harness import evaluate
from thermogrip.classify.evaluation.streamed import (
    StreamedComparison,
    fitted_classifiers,
    streamed_comparison,
)
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import example_path, load_example_grasps
from thermogrip.datasets.grasp_files import write_grasps
from thermogrip.datasets.partitions import Answers, sources
from thermogrip.datasets.schema import Grasps

NAMES = ["features-lda", "pca-lda"]
FILE = "exp1A_obj43_grip23"
PER_FILE, N_FILE = 40, 3


def touched_anew(k: int) -> Grasps:
    """Return grasps of the example condition with so much noise that some are taken for others."""
    grasps, rng = load_example_grasps()[FILE], np.random.default_rng(k)
    part = grasps.isel(grasp=rng.integers(0, grasps.sizes["grasp"], PER_FILE))
    part = part.assign_coords(grasp=[f"{k}-{i}" for i in range(PER_FILE)])
    noise = rng.normal(0, 0.3, part["t_surface"].shape)
    part = part.assign(t_surface=(("grasp", "time"), part["t_surface"].values + noise, {"units": "degC"}))
    part.attrs["name"] = f"part{k}"
    return part


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("tests")
    for k in range(N_FILE):
        write_grasps(touched_anew(k), path / f"part{k}.csv")
    return path


@pytest.fixture(scope="module")
def training() -> Grasps:
    grasps = load_example_grasps()[FILE]
    return grasps.isel(grasp=grasps["split"].values == "train")


@pytest.fixture(scope="module")
def found(folder: Path, training: Grasps, tmp_path_factory: pytest.TempPathFactory) -> StreamedComparison:
    asked = fitted_classifiers({name: make_classifier(name) for name in NAMES}, [training])
    answers = Answers(tmp_path_factory.mktemp("out") / "found", ["test"])
    answers.find(sources([str(folder)]), lambda record: record, asked.answer, lambda *_: None)
    return streamed_comparison(answers, asked)


def test_sums_give_the_scores_that_all_predictions_give(
    found: StreamedComparison, training: Grasps, tmp_path: Path
) -> None:
    whole = evaluate(NAMES, [training], test=[touched_anew(k) for k in range(N_FILE)], probe=False)
    want = {row["classifier"]: row for row in whole.scores() if row["condition"] == POOLED}
    got = {row["classifier"]: row for row in found.scores()}
    assert list(got) == NAMES
    assert 0.5 < got["pca-lda"]["accuracy"] < 1.0  # so that there is something to count
    for name in NAMES:
        for key in ("n", "materials", "accuracy", "low", "high", "log_loss", "brier", "ece", "confidence",
                    "log_loss_base", "log_loss_chance"):  # fmt: skip
            assert got[name][key] == pytest.approx(want[name][key], abs=2e-5)  # files have rounded numbers
        for key in ("log_loss", "brier", "boot"):
            width, other = (row[name][f"{key}_high"] - row[name][f"{key}_low"] for row in (got, want))
            assert width == pytest.approx(other, rel=0.35)
        assert got[name]["ece_calibrated"] == pytest.approx(want[name]["ece_calibrated"], abs=0.01)
        names, counts = whole.confusion(name)
        own, mine = found.confusion(name, FILE)
        assert own == names
        np.testing.assert_array_equal(mine, counts)
        one, other = whole.calibration(name), found.calibration(name, FILE)
        assert [row["n"] for row in other] == [row["n"] for row in one]
        np.testing.assert_allclose([r["accuracy"] for r in other], [r["accuracy"] for r in one])
    (one,), (other,) = whole.differences(), found.differences(FILE)
    for key in ("n", "difference", "only_first", "only_second", "p_value", "log_loss_difference"):
        assert other[key] == pytest.approx(one[key], abs=2e-5)
    whole.save(tmp_path / "whole")
    found.save(tmp_path / "sums")
    rows = [(tmp_path / kind / "predictions.csv").read_text().splitlines() for kind in ("whole", "sums")]
    assert [len(part) for part in rows] == [1 + len(NAMES) * N_FILE * PER_FILE] * 2
    tables = [sorted(p.name for p in (tmp_path / kind).iterdir()) for kind in ("whole", "sums")]
    assert tables[0] == tables[1]


def test_a_condition_apart_is_not_in_the_pool_and_strangers_are_told_by_their_odds(
    training: Grasps, tmp_path: Path
) -> None:
    known = training.isel(grasp=training["material"].values != "copper")
    test = touched_anew(0)
    blind = test.assign(t_object=("grasp", np.full(PER_FILE, np.nan))).assign_coords(
        grasp=[f"b{i}" for i in range(PER_FILE)]
    )
    blind.attrs["name"] = "blind"
    for part in (test, blind):
        write_grasps(part, tmp_path / f"{part.attrs['name']}.csv")
    asked = fitted_classifiers({name: make_classifier(name) for name in NAMES}, [known])
    answers = Answers(tmp_path / "found", ["test"])
    answers.find(sources([str(tmp_path)]), lambda record: record, asked.answer, lambda *_: None)
    found = streamed_comparison(answers, asked)
    names = {(row["classifier"], row["condition"]): row["apart"] for row in found.scores()}
    assert names == {(NAMES[0], FILE): False, (NAMES[1], FILE): False, (NAMES[1], f"{FILE}, apart"): True}
    assert any(note.startswith("features-lda left out of") for note in found.notes)
    whole = evaluate(NAMES, [known], test=[test], probe=False)
    areas = {row["classifier"]: row["auroc"] for row in whole.open_set()}
    mine = {row["classifier"]: row for row in found.open_set()}
    assert set(areas) == set(mine)
    for name, area in areas.items():
        n = int((test["material"].values == "copper").sum())
        assert mine[name]["n_unknown"] == n * (1 if name == NAMES[0] else 2)
        assert mine[name]["auroc"] == pytest.approx(area, abs=0.1)


def test_a_grasp_of_the_training_is_refused(training: Grasps) -> None:
    asked = fitted_classifiers({"pca-lda": make_classifier("pca-lda")}, [training])
    with pytest.raises(UserError, match="is in training"):
        asked.answer(training.isel(grasp=[0]))
    copy = training.isel(grasp=[0]).assign_coords(grasp=["another"])
    copy.attrs["name"] = "copy"
    with pytest.raises(UserError, match="a copy in training and in test"):
        asked.answer(copy)


def test_a_run_that_was_killed_goes_on_to_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    program = (
        "import sys, time; import thermogrip.cli.compare as c; from thermogrip.cli.main import main\n"
        "c.LARGE = 1; own = c._Asked.answer\n"
        "c._Asked.answer = lambda ask, part: (time.sleep(float(sys.argv[1])), own(ask, part))[1]\n"
        "sys.exit(main(sys.argv[2:]))"
    )

    def run(out: Path, wait: float) -> subprocess.Popen[bytes]:
        words = ["compare", str(example_path(FILE)), "--test", str(folder), "--classifiers", "pca-lda"]
        return subprocess.Popen(
            [sys.executable, "-c", program, str(wait), *words, "--out", str(out)], stderr=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
        )  # fmt: skip

    kept = tmp_path / "killed.partial"
    with run(tmp_path / "killed", 1.0) as process:
        end = time.monotonic() + 120
        while time.monotonic() < end and not (kept.exists() and kept.read_bytes().count(b"\n") >= 2):
            time.sleep(0.05)
        os.kill(process.pid, signal.SIGKILL)
    before = kept.read_bytes()
    assert 2 <= before.count(b"\n") <= N_FILE
    assert run(tmp_path / "killed", 0.0).wait() == 0
    assert run(tmp_path / "whole", 0.0).wait() == 0
    assert not kept.exists()
    for name in ("predictions.csv", "confusion.csv", "calibration.csv"):
        one, other = (tmp_path / kind / "files" / name for kind in ("killed", "whole"))
        assert one.read_bytes() == other.read_bytes()
