"""compare: which splits are scored by which classifiers, on what; what is printed, written and answered."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.cli.conftest import Bench, StandIn, shares, words_of
from thermogrip.classify.evaluation.comparison import POOLED, Caution
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps, make_grasps

HEAD = ("classifier", "condition", "accuracy", "Brier", "fit [s]")


@dataclass(frozen=True)
class Found:
    """Stands for a comparison."""

    of: str
    notes: tuple[str, ...] = ("one note",)
    conditions: tuple[str, ...] = ("c1",)
    empty: bool = False
    interval_note: str = "exact"
    cautions: tuple[Caution, ...] = (Caution("leak", "c1", "labels leak"),)

    def caution_lines(self) -> list[str]:
        return [f"{caution.condition}: {caution.words}" for caution in self.cautions]

    def scores(self) -> list[dict[str, Any]]:
        return [] if self.empty else [{"condition": name, "apart": name == "c2"} for name in self.conditions]

    def save(self, out: Path) -> None:
        out.write_text(self.of)


def record_of(split: list[str] | None = None, **columns: Any) -> Grasps:
    marks = {} if split is None else {"split": split}
    n = len(split or "ab")
    traces = np.full((n, 3), 23.0)
    return make_grasps([-1.0, 0.0, 1.0], traces, [f"g{k}" for k in range(n)], **marks, **columns)


MARKED, PLAIN = record_of(["train", "test"]), record_of()


@pytest.fixture
def scored(bench: Bench, stand_in: StandIn) -> SimpleNamespace:
    """Return a bench whose grasps, classifiers and comparisons are stand-ins."""

    def evaluate(*_: Any, progress: Any, split: str = "shipped", **__: Any) -> Found:
        progress(0.0, "fold")
        progress(1.0, "fold")
        return made.of.get(split, Found(split))

    made = SimpleNamespace(bench=bench, read={"grasps.csv": MARKED, "more.csv": PLAIN}, of={}, missing=())
    stand_in(
        "thermogrip.cli.grasp_arguments.read_grasp_files", lambda paths: [made.read[path] for path in paths]
    )
    made.warned = stand_in("thermogrip.cli.options.warn_of_contacts")
    made.touched = stand_in("thermogrip.cli.compare.touched_part", lambda console, records: records)
    made.asked = stand_in(
        "thermogrip.classify.estimators.registry.trainable",
        lambda names, quick, seed: (
            {name: quick for name in names if not (made.missing and name == "lstm")},
            made.missing,
        ),
    )
    made.planned = stand_in("thermogrip.classify.evaluation.splits.plan_folds")
    made.scored = stand_in("thermogrip.classify.evaluation.harness.evaluate", evaluate)
    stand_in("thermogrip.report.classification.comparison_sections", lambda name, found: [f"of {name}"])
    stand_in(
        "thermogrip.report.classification.score_table",
        lambda found: (HEAD, tuple(("bayes", name, "0.9", "0.1", "3") for name in found.conditions)),
    )
    made.pages = stand_in("thermogrip.report.html.write_report")
    return made


@pytest.mark.parametrize(
    ("words", "splits", "at"),
    [
        ("grasps.csv", ["shipped", "random"], [0, 30]),
        ("grasps.csv --repeats 0", ["shipped"], [0]),
        ("grasps.csv --repeats 0 --by session", ["shipped", "session"], [0, 38]),
        ("grasps.csv --by block", ["shipped", "random", "block"], [0, 20, 67]),
        ("more.csv", ["random"], [0]),
        ("more.csv --test grasps.csv", ["files"], [0]),
        ("more.csv --test grasps.csv --by session", ["files", "session"], [0, 38]),
    ],
)
def test_what_is_split_how_and_by_whom_it_is_scored(
    words: str, splits: list[str], at: list[int], scored: SimpleNamespace
) -> None:
    options = ["--classifiers", "bayes,pca-lda", "--seed", "4", "--workers", "3", "--train-per-class", "2"]
    done = scored.bench.run("compare", *words.split(), *options, "--out", "c")
    assert done.code == 0, done
    assert list(dict.fromkeys(shares(done.err, "compare"))) == [*at, 100]
    first = scored.read[words.split()[0]]
    for call, name in zip(scored.scored, splits, strict=True):
        assert call.args[1] == [first]
        assert (call.seed, call.workers) == (4, 3)
        fast = name not in ("shipped", "files")  # the LSTM's long training is for the given split alone
        assert call.args[0] == {"bayes": fast, "pca-lda": fast}
        options_of = vars(call).keys() - {"args", "seed", "workers", "progress"}
        assert options_of == {
            "shipped": {"test"}, "files": {"test"}, "random": {"split", "repeats", "train_per_class"},
        }.get(name, {"split"})  # fmt: skip
        if name == "random":
            assert (call.split, call.repeats, call.train_per_class) == ("random", 20, 2)
        elif "test" in options_of:
            assert call.test == ([MARKED] if name == "files" else None)
        else:
            assert call.split == name
    tests = [MARKED] if "--test" in words else []
    assert scored.warned[0].args[1] == [first, *tests]
    assert [call.args[1] for call in scored.touched] == [[first], *([tests] if tests else [])]
    assert [call.quick for call in scored.asked] == [False, True]
    assert {call.seed for call in scored.asked} == {4}
    [page] = scored.pages
    assert page.args[0] == Path("c/report.html")
    assert page.args[3] == [f"of {name}" for name in splits]
    assert all((scored.bench.path / "c" / name).read_text() for name in splits)
    said = words_of(done.out)
    for name in splits:
        assert f"Split: {name} classifier condition accuracy " in said
    assert said.endswith(
        "bayes c1 0.9 caution: c1: labels leak exact note: one note wrote c/report.html and tables beside it"
    )


def test_the_answer_holds_scores_notes_and_intervals_of_each_split(scored: SimpleNamespace) -> None:
    scored.missing = (UserError("lstm needs torch"),)
    done = scored.bench.run("compare", "grasps.csv", "--repeats", "0", "--quick", "--out", "c", "--json")
    caution = {"code": "leak", "condition": "c1", "words": "labels leak", "classifier": "", "detail": ""}
    assert json.loads(done.out) == {
        "splits": {"shipped": {"scores": [{"condition": "c1", "apart": False}], "interval": "exact",
                               "cautions": [caution | {"brief": "leak"}],
                               "notes": ["left out: lstm needs torch", "one note"]}},
        "out": "c",
    }  # fmt: skip
    assert done.err.count("warning: left out: lstm needs torch") == 1
    assert [call.quick for call in scored.asked] == [True, True]
    assert scored.asked[0].args == (("lstm", "posterior", "bayes", "features-lda", "pca-lda"),)
    assert (scored.scored[0].workers, scored.scored[0].seed) == (1, 0)
    both = scored.bench.run("compare", "grasps.csv", "--classifiers", "lstm,bayes", "--out", "d")
    assert (both.code, both.err.count("warning: left out: lstm needs torch")) == (0, 1)
    assert list(scored.scored[-1].args[0]) == ["bayes"]
    assert both.err.endswith("next: thermogrip train grasps.csv --classifier posterior --out MODEL_DIR\n")
    refused = scored.bench.run("compare", "grasps.csv", "--classifiers", "lstm", "--out", "c")
    assert (refused.code, refused.said) == (2, ["thermogrip: lstm needs torch"])


def test_there_is_nothing_to_score_only_without_split_repeats_sessions_and_test_files(
    scored: SimpleNamespace,
) -> None:
    refused = scored.bench.run("compare", "more.csv", "--repeats", "0", "--out", "c")
    assert (refused.code, refused.said) == (
        2, ["thermogrip: nothing to score; give --test, a column split, or --repeats"],
    )  # fmt: skip
    scored.of = {"shipped": Found("shipped", ("no material is shared",), empty=True)}
    done = scored.bench.run("compare", "grasps.csv", "--out", "c", "--json")
    assert (done.code, list(json.loads(done.out)["splits"])) == (0, ["random"])
    assert "warning: shipped: no material is shared" in done.err
    refused = scored.bench.run("compare", "grasps.csv", "--repeats", "0", "--out", "c")
    assert (refused.code, "nothing to score; test on grasps of the materials" in refused.said[0]) == (2, True)


def test_where_a_material_has_too_few_grasps_there_are_no_random_splits(
    scored: SimpleNamespace, stand_in: StandIn
) -> None:
    planned = stand_in("thermogrip.classify.evaluation.splits.plan_folds", UserError("1 grasp of wood"))
    done = scored.bench.run("compare", "grasps.csv", "--repeats", "7", "--seed", "4", "--out", "c", "--json")
    assert list(json.loads(done.out)["splits"]) == ["shipped"]
    assert "warning: no random splits: 1 grasp of wood" in done.err
    [call] = planned
    assert (call.args, call.split, call.repeats, call.train_per_class, call.seed) == (
        ([MARKED],), "random", 7, 5, 4,
    )  # fmt: skip
    assert (
        scored.bench.run("compare", "more.csv", "--out", "c").code == 0
    )  # the random ones name it themselves


@pytest.mark.parametrize(("n", "cut"), [(4, False), (5, True)])
def test_of_many_conditions_the_pooled_scores_are_printed(n: int, cut: bool, scored: SimpleNamespace) -> None:
    names = (POOLED, *(f"c{k}" for k in range(n - 1)))
    scored.of = {"shipped": Found("shipped", conditions=names, cautions=())}
    said = words_of(scored.bench.run("compare", "grasps.csv", "--repeats", "0", "--out", "c").out)
    assert (f"Split: shipped; {n} conditions, one by one in the report" in said) == cut
    assert [name in said for name in names] == [not cut or name in (POOLED, "c2") for name in names]
    assert "Brier" not in said
    assert "fit [s]" not in said
