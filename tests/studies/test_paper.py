"""The paper's cases as this project states them, and as the verb repeats them on few grasps."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import binomtest

from tests.end_to_end.drawn import faults_of
from thermogrip.classify import make_classifier
from thermogrip.classify.estimators.base import GraspClassifier
from thermogrip.cli.main import main
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.parallel import Progress
from thermogrip.studies.paper import CASES, Case, PaperResult, _published, repeat_paper

FEW = (CASES[0], CASES[4])  # 1-A of five materials, and 2-C of three


@pytest.fixture(scope="module")
def examples() -> dict[str, object]:
    return dict(load_example_grasps())


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_a_case_is_the_bundled_condition_of_that_name(case: Case, examples: dict[str, object]) -> None:
    grasps = examples[case.record]
    assert set(grasps["material"].values.astype(str)) == set(case.materials)
    assert np.all(grasps["t_object"].values == case.t_object)
    assert np.all(grasps["t_gripper"].values == case.t_gripper)
    assert grasps["time"].values[-1] == pytest.approx(case.seconds)


def test_published_accuracies_are_those_of_the_paper() -> None:
    said = {case.name: _published(case)[0] for case in CASES}
    assert said["1-A"] == "100 %"
    assert said["1-B"] == "40 %"
    assert [said[name] for name in said if name.startswith("2-")] == ["33.33 %", "66.66 %", *["100 %"] * 3]
    assert [said[f"3-{letter}"] for letter in "ABC"] == ["100 %"] * 3


@dataclass(frozen=True)
class Repeated:
    """What the verb printed, wrote and found, and its progress."""

    said: str
    found: PaperResult
    table: tuple[tuple[str, ...], tuple[tuple[Any, ...], ...]]
    out: Path
    progress: list[tuple[float, str]]


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Repeated:
    """The verb on two cases, with few grasps and with classifiers that learn at once."""
    out, seen, found = tmp_path_factory.mktemp("paper") / "out", [], []
    quick = {"posterior": "features-lda", "bayes": "pca-lda"}
    tiny = {"epochs": 2, "hidden": 4, "series_per_class": 5}

    def make(name: str, **params: object) -> GraspClassifier:
        return make_classifier(quick[name]) if name in quick else make_classifier(name, **tiny)

    def repeat(*, progress: Progress, **options: object) -> PaperResult:
        def note(fraction: float, what: str) -> None:
            seen.append((fraction, what))
            progress(fraction, what)

        found.append(repeat_paper(progress=note, **options))
        return found[0]

    with pytest.MonkeyPatch.context() as patch, redirect_stdout(StringIO()) as said:
        patch.setattr("thermogrip.studies.paper.CASES", FEW)
        patch.setattr("thermogrip.studies.paper.TWIN_TEST", 3)
        patch.setattr("thermogrip.studies.paper.COPIES", 4)
        patch.setattr("thermogrip.studies.paper.repeat_paper", repeat)
        patch.setattr("thermogrip.classify.estimators.registry.make_classifier", make)
        assert main(["paper", "--quick", "--out", str(out)]) == 0
        return Repeated(said.getvalue(), found[0], found[0].table(), out, seen)


def counted(predictions: Iterable[dict[str, Any]], classifier: str, condition: str) -> str:
    """Return right/n and the exact interval, counted anew."""
    rows = [r for r in predictions if (r["classifier"], r["condition"]) == (classifier, condition)]
    right = sum(r["predicted"] == r["material"] for r in rows)
    low, high = binomtest(right, len(rows)).proportion_ci(0.95, "exact")
    return f"{right}/{len(rows)} ({100 * low:.0f}–{100 * high:.0f})"


def test_the_table_counts_what_was_named_right_beside_what_was_published(small: Repeated) -> None:
    head, rows = small.table
    assert [row[:6] for row in rows] == [
        ("1-A", 43.0, 23.0, 5, "100 %", "5/5 (48–100)"),
        ("2-C, 10 K", 28.0, 38.0, 3, "100 %", "3/3 (29–100)"),
    ]
    assert head[6:] == tuple(
        f"{name}, {kind}"
        for name in ("posterior", "bayes", "lstm", "lstm-paper")
        for kind in ("bundled", "simulated")
        if (name, kind) != ("lstm-paper", "simulated")
    )
    for row, case in zip(rows, FEW, strict=True):
        for title, cell in zip(head[6:], row[6:]):
            name, kind = title.split(", ")
            comparison = small.found.bundled if kind == "bundled" else small.found.twin
            assert cell == counted(comparison.predictions, name, case.record)
            assert f"/{3 * case.of} (" in cell  # three test grasps a material in either


def test_every_case_and_every_rate_is_printed(small: Repeated) -> None:
    lines = small.said.splitlines()
    head, rows = small.table
    assert lines[0] == "1-A: object 43, gripper 23 degC, 5 materials"
    assert lines[1] == "    paper: 100 % (5/5 (48–100))"
    cells = [f"    {title}: {cell}" for row in rows for title, cell in zip(head[6:], row[6:])]
    assert [line for line in lines if ", bundled: " in line or ", simulated: " in line] == cells
    said = " ".join(small.said.split())
    assert "100 % is 3 of 3 or 5 of 5 grasps: 29 % or 48 % and more" in said
    assert said.endswith(f" {small.found.copies_verdict} wrote {small.out}/report.html")
    assert {path.name for path in small.out.iterdir()} == {"bundled", "simulated", "report.html"}
    page = (small.out / "report.html").read_text(encoding="utf-8")
    assert all(cell in page for row in rows for cell in row[6:])
    assert list(faults_of(page)) == []
    assert all(row["copies_right"] < 0.9 * row["copies_n"] for row in small.found.copies)  # after two epochs
    # of a case that has not learnt its copies nothing is said
    assert "has learnt the copies of no case, so nothing is said of their worth" in page
    drawn = [f"Case {case.name}, bundled grasps: rows true, columns predicted." in page for case in FEW]
    assert drawn == [True, False]  # the paper has none of 2-C
    assert [case.name for case in CASES if not case.confusion] == [c.name for c in CASES if c.name[0] == "2"]
    assert small.found.bundled.leaks == small.found.twin.leaks == ()  # the paper has no such probe


def test_copies_are_of_one_grasp_a_material_and_all_others_are_asked(small: Repeated) -> None:
    sizes = ("train_grasps", "copies_n", "one_n", "others_n")
    assert [[row[key] for key in sizes] for row in small.found.copies] == [[5, 20, 5, 35], [3, 12, 3, 21]]
    assert small.found.epochs == 2


def test_the_verdict_on_copies_adds_up_all_cases() -> None:
    sizes = {"copies_n": 100, "one_n": 5, "others_n": 30}
    rows = (
        sizes | {"copies_right": 90, "one_right": 2, "others_right": 12, "confidence": 0.9},
        sizes | {"copies_right": 100, "one_right": 3, "others_right": 15, "others_n": 15, "confidence": 0.6},
    )
    said = PaperResult(None, None, rows, 2).copies_verdict
    for words in (
        "95 % (n = 200) of",
        "50 % (n = 10) of",
        "60 % (n = 45) of",
        "is 80 % sure on average, in the 2 cases",
    ):
        assert words in said
    poor = sizes | {"copies_right": 89, "one_right": 0, "others_right": 0, "confidence": 0.1}
    assert PaperResult(None, None, (*rows, poor), 2).copies_verdict == said
