"""The page of a comparison says what its numbers count, and what its pictures leave out."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from thermogrip.classify import evaluate, make_classifier
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.report.classification import comparison_sections, curves_section, touch_section
from thermogrip.report.html import Picture, Section


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


@pytest.mark.parametrize(("name", "title"), [("session", "Sessions held out"), ("files", "Other files")])
def test_each_kind_of_split_has_its_title(name: str, title: str) -> None:
    models = {"features-lda": make_classifier("features-lda")}
    found = evaluate(models, [load_example_grasps()["exp2_dT20"]], seed=0, probe=False)
    assert [s.title for s in comparison_sections(name, found)] == [f"Which material? {title}"]


def test_what_lies_above_a_curve_is_named() -> None:
    row = {"accuracy": 0.5, "low": 0.4, "high": 0.6, "log_loss_chance": 1.1}
    rows = [
        row | {"classifier": name, "train_per_class": n, "log_loss": loss}
        for name, n, loss in (("a", 2, 2.3), ("a", 5, 0.5), ("b", 2, 0.6), ("b", 5, 0.4))
    ]
    said = list(captions([curves_section({"train_per_class": rows})]))
    assert said[0].endswith("Off the page, above twice chance: a.")


def test_a_strange_grasp_stands_with_its_reason() -> None:
    record = load_example_grasps()["exp2_dT20"].isel(grasp=[0, 16])
    row = {"p_copper": 1.0, "p_wood": 0.0, "decided_at_s": 10.0}
    rows = [
        row
        | {"true": "copper", "material": "copper", "p_unknown": 0.8, "why": "as copper it is cold (4.1 sd)"},
        row | {"true": "wood", "material": "copper", "p_unknown": 0.1, "why": ""},
    ]
    section = touch_section([record], rows, "some grasps")
    assert section.verdict == (
        "1 of 2 grasps of the twin were named right. That of copper is marked as unlike any block of the "
        "training: as copper it is cold (4.1 sd)."
    )
    assert section.tone == "warn"
