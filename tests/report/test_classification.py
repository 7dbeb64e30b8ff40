"""The page of a comparison says what its numbers count, and what its pictures leave out."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from tests.report.conftest import part
from thermogrip.classify import evaluate, make_classifier
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import make_log
from thermogrip.report import classification
from thermogrip.report.charts import Chart
from thermogrip.report.classification import comparison_sections, effusivity_section, touch_section
from thermogrip.report.html import Picture, Section, Table, Text
from thermogrip.sysid.effusivity import EffusivityRow


@pytest.fixture(autouse=True)
def _no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures have tests of their own."""
    for name in ("accuracy", "confusion", "effusivity", "reliability"):
        monkeypatch.setattr(f"thermogrip.classify.figures.{name}_figure", lambda *_, **__: Figure())
    monkeypatch.setattr(classification, "loops_chart", lambda *_, **__: Chart(()))


def captions(sections: list[Section]) -> Iterator[str]:
    return (part.caption for section in sections for part in section.parts if isinstance(part, Picture))


@pytest.mark.parametrize(
    ("split", "repeats", "said"),
    [("shipped", 1, "; grasps. Shade"), ("random", 3, "; grasps a split, mean of 3. Shade")],
)
def test_a_confusion_says_what_it_counts(split: str, repeats: int, said: str) -> None:
    models = {"features-lda": make_classifier("features-lda")}
    found = evaluate(
        models, [load_example_grasps()["exp2_dT20"]], split=split, repeats=repeats, seed=0, probe=False
    )
    assert any(said in text for text in captions(comparison_sections(split, found)))


def test_touches_are_counted_by_what_was_taught_and_what_was_not() -> None:
    record = load_example_grasps()["exp2_dT20"].isel(grasp=[0, 16])
    row = {"p_copper": 1.0, "p_wood": 0.0, "decided_at_s": 10.0}
    rows = [
        row | {"true": "copper", "material": "copper", "p_unknown": 0.8, "why": "as copper it is cold"},
        row | {"true": "wood", "material": "copper", "p_unknown": 0.1, "why": ""},
        row | {"true": "glass", "material": "copper", "p_unknown": 0.9, "why": ""},
    ]
    section = touch_section([record], rows, ("copper", "wood"))
    assert section.verdict == (
        "1 of 2 blocks of copper, wood are named right; 1 of 1 that was not taught (glass) is called unknown."
    )
    assert section.tone == "warn"
    assert Text("Copper: as copper it is cold.") in section.parts
    sure = [rows[0] | {"p_unknown": 0.1}, rows[2]]
    assert touch_section([record], sure, ("copper", "wood")).tone == "good"
    assert touch_section([record], [rows[2] | {"p_unknown": 0.1}], ("copper",)).tone == "warn"


@pytest.mark.parametrize(
    ("verdicts", "said", "tone"),
    [
        ("pass pass", "2 of 2 checks pass.", "good"),
        ("pass warn pass", "2 of 3 checks pass (with a warning: c1).", "warn"),
        ("fail warn fail", "0 of 3 checks pass (failed: c0, c2; with a warning: c1).", "bad"),
    ],
)
def test_a_review_counts_what_passes_and_names_the_rest(verdicts: str, said: str, tone: str) -> None:
    checks: Any = [
        SimpleNamespace(name=f"c{k}", verdict=verdict, finding=f"f{k}", fix="")
        for k, verdict in enumerate(verdicts.split())
    ]
    section = classification.review_section(checks)
    assert (section.verdict, section.tone) == (said, tone)
    assert part(section, 0, Table).rows[0] == ("c0", verdicts.split()[0], "f0", "")


def test_sessions_that_did_not_settle_are_counted_and_their_advice_shown() -> None:
    log = make_log([0.0, 1.0], {"target_t_surface": ([38.0, 38.0], "degC", "other")})
    rest = {"log": log, "settle_time": 9.0, "overshoot": 0.1, "bias": 0.02}
    runs: Any = [
        ("first", SimpleNamespace(verdict="settled", advice="", **rest)),
        ("second", SimpleNamespace(verdict="tripped", advice="look at the pump", **rest)),
    ]
    section = classification.session_section(runs, "the twin")
    assert (section.verdict, section.tone) == ("1 of 2 sessions settled on the twin.", "warn")
    assert part(section, 1, Table).rows[1] == ("second", "tripped", 9.0, 0.1, 0.02)
    assert [part for part in section.parts if isinstance(part, Text)] == [Text("second: look at the pump")]
    assert classification.session_section(runs[:1], "the twin").tone == "good"


@pytest.mark.parametrize(
    ("p_value", "more"), [(0.2, " In accuracy n does not separate a from b."), (0.01, "")]
)
def test_who_wins_has_the_least_log_loss_and_is_set_apart_only_where_n_can(p_value: float, more: str) -> None:
    score = {"condition": "pooled", "log_loss_chance": 1.1, "n": 20, "low": 0.683, "high": 0.988}
    score |= {"n_test": 20}
    scores = [
        score | {"classifier": "b", "log_loss": 0.5, "accuracy": 0.85},
        score | {"classifier": "a", "log_loss": 0.25, "accuracy": 0.9},
        score | {"classifier": "c", "log_loss": 0.1, "accuracy": 1.0, "condition": "other"},
    ]
    pairs = [{"first": "b", "second": "a", "p_value": p_value}, {"first": "b", "second": "c", "p_value": 0.9}]
    found: Any = SimpleNamespace(scores=lambda: scores, differences=lambda condition: pairs)
    assert classification._who_wins(found, "pooled") == (
        "a has the lowest log loss (0.25; chance 1.10) and 90 % right of n = 20 grasps (68 to 99 %).",
        f"b: 85 %, log loss 0.50.{more}",
    )


@pytest.mark.parametrize(
    ("apart", "reported"), [([False, False], False), ([True, True], False), ([False, True], True)]
)
def test_conditions_below_the_line_are_reported_where_there_are_others_above_it(
    apart: list[bool], reported: bool
) -> None:
    said = classification._below([{"apart": value} for value in apart])
    assert bool(said) == reported
    assert not reported or "touched twice or of unknown temperature, not in the pool" in said


def test_each_score_stands_under_its_name_with_its_own_interval() -> None:
    row: dict[str, Any] = {"classifier": "a", "condition": "b", "n": 7, "n_test": 7, "log_loss_chance": 1.099}
    row["caution"] = ""
    row["log_loss_base"] = 0.871
    for at, key in enumerate(("accuracy", "log_loss", "brier", "ece")):
        low, high = ("low", "high") if key == "accuracy" else (f"{key}_low", f"{key}_high")
        row |= {key: 0.5 + at / 100, low: 0.1 + at / 100, high: 0.9 + at / 100}
    row |= {"ece_calibrated": 0.0321, "fit_s": 1.234}
    found: Any = SimpleNamespace(scores=lambda: [row])
    head, [cells] = classification.score_table(found)
    assert dict(zip(head, cells, strict=True)) == {
        "classifier": "a", "condition": "b", "n": 7, "accuracy": "0.500 (.10\N{EN DASH}.90)",
        "log loss": "0.510 (.11\N{EN DASH}.91)", "by chance": "1.10", "by base rates": "0.87",
        "Brier": "0.520 (.12\N{EN DASH}.92)",
        "ECE": "0.530 (.13\N{EN DASH}.93)", "if calibrated": "0.032", "fit [s]": "1.23",
    }  # fmt: skip
    found.scores = lambda: [row | {"n_test": 9, "caution": "2 unseen (zinc): iron 2"}, row]
    head, beside = classification.score_table(found)
    assert head[2:5] == ("n", "accuracy", "caution")
    assert [line[2] for line in beside] == ["7/9", 7]
    assert [line[4] for line in beside] == ["2 unseen (zinc): iron 2", ""]


def test_a_leak_and_an_unseen_material_stand_in_the_verdict_as_caution() -> None:
    record = load_example_grasps()["exp2_dT20"]
    marks = np.where(record["material"].values == "copper", "test", record["split"].values.astype(str))
    models = {"features-lda": make_classifier("features-lda")}
    found = evaluate(models, [record.assign(split=("grasp", marks))], seed=0, probe=False)
    leak = {"classifier": "features-lda", "condition": found.conditions[0], "n": 9, "accuracy": 1.0}
    leaking = replace(found, leaks=(leak | {"chance": 0.3, "p_value": 0.0, "leak": True},))
    [before], [section] = (comparison_sections("shipped", each) for each in (found, leaking))
    assert (before.tone, section.tone) == ("warn", "warn")
    assert "of copper, which training lacks, and are not scored; features-lda answered" in before.verdict
    assert "labels can be predicted" not in before.verdict
    assert section.verdict.startswith(f"{leak['condition']}: labels can be predicted from samples before")


def test_a_page_of_effusivities_has_every_grasp_and_says_what_is_missing() -> None:
    row = EffusivityRow("a", 1.5e4, 1.1e4, 2e4, 23.0, 22.5, 23.5, 900.0, 0.1)
    known = asdict(row) | {"misfit_sd": 0.0}
    lost = {key: value if key == "grasp_id" else math.nan for key, value in known.items()} | {"grasp_id": "b"}
    section = effusivity_section([(known, ""), (known | {"grasp_id": "c"}, "too slow"), (lost, "")], 500)
    picture, table = section.parts[0], part(section, 1, Table)
    assert section.verdict == (
        "2 of 3 grasps have an effusivity. The model does not explain 1 of them. "
        "The first 3 of 500 are shown."
    )
    assert (section.tone, picture.kind) == ("warn", "picture")
    assert [(row[0], row[1], row[-1]) for row in table.rows] == [
        ("a", 1.5e4, ""), ("c", 1.5e4, "too slow"), ("b", None, "no contact, or no answer"),
    ]  # fmt: skip
    assert effusivity_section([(known, "")], 1).tone == "good"
    assert [part.kind for part in effusivity_section([(lost, "")], 1).parts] == ["table"]
