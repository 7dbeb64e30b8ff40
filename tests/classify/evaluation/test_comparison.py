"""Tables of a comparison, from a handful of predictions made by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from thermogrip.classify.evaluation.comparison import Comparison
from thermogrip.classify.evaluation.metrics import (
    calibration_interval,
    clopper_pearson,
    mean_intervals,
    sign_flip_p,
)


def said(
    classifier: str, condition: str, grasp: str, right: bool, confidence: float, repeat: int = 0, **more: Any
) -> dict[str, Any]:
    """Return a prediction: iron or wood, as the name of the grasp has it."""
    material = "iron" if grasp.startswith("i") else "wood"
    other = {"iron": "wood", "wood": "iron"}[material]
    return {
        "classifier": classifier,
        "condition": condition,
        "grasp_id": grasp,
        "repeat": repeat,
        "correct": right,
        "material": material,
        "predicted": material if right else other,
        "confidence": confidence,
        "known": True,
        "log_loss": float(-np.log(confidence if right else 1 - confidence)),
        "log_loss_base": 0.5 if right else 0.8,
        "candidates": 2,
        "apart": False,
        "brier": 2 * (1 - confidence if right else confidence) ** 2,
        "p_unknown": None,
    } | more


ROWS = (
    said("a", "wet", "i1", True, 0.9),
    said("a", "wet", "w1", False, 0.6),
    said("a", "wet", "i1", True, 0.8, 1),
    said("a", "wet", "w2", True, 0.95, 1),
    said("a", "dry", "i1", True, 0.7, candidates=3),
    said("a", "dry", "w1", False, 0.85, 1, candidates=3),
    said("a", "far", "w1", True, 0.55, apart=True),
    said("b", "wet", "i1", False, 0.65, p_unknown=0.1),
    said("b", "wet", "w1", True, 0.75, p_unknown=0.3),
    said("b", "wet", "w2", True, 0.9, 1, p_unknown=0.2),
    said("b", "wet", "w9", False, 0.5, known=False, material="cork", p_unknown=0.25),
    said("b", "wet", "w8", False, 0.5, known=False, material="cork", p_unknown=0.9),
    said("b", "dry", "w7", False, 0.5, known=False, material="ash", p_unknown=0.15),
    said("b", "far", "w1", True, 0.99, apart=True, p_unknown=0.95),
)
TIMES = tuple(
    {"classifier": c, "condition": where, "repeat": k, "fit_s": fit, "predict_s_per_grasp": fit / 10}
    for c, where, k, fit in (
        ("a", "wet", 0, 1.0),
        ("a", "wet", 1, 2.0),
        ("a", "dry", 0, 6.0),
        ("b", "far", 0, 9.0),
    )
)
FOUND = Comparison("random", 2, 4, ROWS, times=TIMES, level=0.9)


def test_scores_are_means_over_tests_and_their_intervals_count_grasps() -> None:
    rows = {(r["classifier"], r["condition"]): r for r in FOUND.scores()}
    assert list(rows) == [*(("a", c) for c in ("pooled", "wet", "dry", "far")), ("b", "wet"), ("b", "far")]
    row = rows["a", "pooled"]
    right, loss = np.array([1, 0, 1, 1, 1, 0.0]), -np.log([0.9, 0.4, 0.8, 0.95, 0.7, 0.15])
    brier = [r["brier"] for r in ROWS[:6]]
    of, sure = np.array([0, 1, 0, 2, 3, 4]), [0.9, 0.6, 0.8, 0.95, 0.7, 0.85]
    assert (row["n"], row["tested"], row["materials"], row["apart"]) == (5, 6, 2, False)
    assert (row["low"], row["high"]) == pytest.approx(clopper_pearson(5 * 4 / 6, 5, level=0.9))
    spreads = mean_intervals(np.column_stack([right, loss, brier]), of, level=0.9, seed=4)
    for names, spread in zip((("accuracy", "boot"), ("log_loss",) * 2, ("brier",) * 2), spreads):
        got = [row[names[0]], row[f"{names[1]}_low"], row[f"{names[1]}_high"]]
        assert got == pytest.approx(list(spread))
    ece = calibration_interval(sure, right, of, level=0.9, seed=4)
    got = [row[key] for key in ("ece", "ece_low", "ece_high", "ece_calibrated", "ece_p")]
    assert got == pytest.approx(list(ece))
    assert row["confidence"] == pytest.approx(0.8)
    assert row["log_loss_chance"] == pytest.approx((4 * np.log(2) + 2 * np.log(3)) / 6)
    assert row["log_loss_base"] == pytest.approx((4 * 0.5 + 2 * 0.8) / 6)
    # first split 2 of 3, second 2 of 3; of the wet grasps 1 of 2 and 2 of 2
    assert (row["sd_over_splits"], rows["a", "wet"]["sd_over_splits"]) == (0.0, 0.25)
    assert (row["fit_s"], row["predict_s_per_grasp"]) == pytest.approx((3.0, 0.3))
    assert (rows["a", "wet"]["fit_s"], rows["b", "wet"]["fit_s"], rows["b", "far"]["fit_s"]) == (
        1.5,
        None,
        9.0,
    )
    assert rows["a", "far"]["boot_low"] is rows["a", "far"]["ece_high"] is None  # one grasp
    assert rows["a", "far"]["apart"] is True
    once = Comparison("shipped", 1, 0, ROWS[:2])
    assert once.scores()[0]["sd_over_splits"] is None
    assert [r["condition"] for r in once.scores()] == ["wet"]  # of one condition nothing is pooled


def test_confusions_and_bins_of_confidence() -> None:
    names, counts = FOUND.confusion("a")
    assert names == ["iron", "wood"]
    assert counts.tolist() == [[1.5, 0.0], [1.0, 0.5]]  # six tests in two splits
    assert FOUND.confusion("b", "wet")[1].tolist() == [[0.0, 0.5], [0.0, 1.0]]  # cork was no candidate
    assert FOUND.confusion("b", "none")[0] == []
    bins = FOUND.calibration("a")
    assert [(b["low"], b["n"], b["grasps"]) for b in bins] == [
        (pytest.approx(low), n, grasps)
        for low, n, grasps in ((0.5, 1, 1), (0.6, 1, 1), (0.7, 1, 1), (0.8, 2, 2), (0.9, 1, 1))
    ]
    assert (bins[3]["confidence"], bins[3]["accuracy"]) == (pytest.approx(0.875), 0.5)
    assert (bins[3]["accuracy_low"], bins[3]["accuracy_high"]) == clopper_pearson(1, 2, level=0.9)


def test_differences_are_of_the_tests_that_both_have() -> None:
    [row] = FOUND.differences("wet")
    right, loss = np.array([1, -1, 0.0]), -np.log(np.array([0.9, 0.4, 0.95]) / [0.35, 0.75, 0.9])
    spread = mean_intervals(np.column_stack([right, loss]), [0, 1, 2], level=0.9, seed=4)
    assert (row["first"], row["second"], row["condition"], row["n"]) == ("a", "b", "wet", 3)
    assert [row[key] for key in ("difference", "low", "high")] == pytest.approx(list(spread[0]))
    keys = ("log_loss_difference", "log_loss_low", "log_loss_high")
    assert [row[key] for key in keys] == pytest.approx(list(spread[1]))
    assert (row["only_first"], row["only_second"]) == (0.5, 0.5)
    assert (row["p_value"], row["test"]) == (sign_flip_p(right, seed=4), "sign flips over grasps")
    assert FOUND.differences()[0]["n"] == 3  # nothing apart is pooled
    assert FOUND.differences("dry") == []
    once = Comparison("shipped", 1, 0, tuple(r for r in ROWS if r["repeat"] == 0))
    [row] = once.differences("wet")
    assert (row["only_first"], row["only_second"], row["p_value"], row["test"]) == (
        1,
        1,
        1.0,
        "McNemar exact",
    )
    three = Comparison("shipped", 1, 0, tuple(said(c, "wet", "i1", c != "b", 0.9) for c in "abc"))
    assert [(r["first"], r["second"], r["difference"], r["low"]) for r in three.differences()] == [
        ("a", "b", 1.0, None),
        ("a", "c", 0.0, None),
        ("b", "c", -1.0, None),
    ]


def test_strange_materials_stand_against_the_known_grasps_that_are_not_apart() -> None:
    """Of cork at 0.25 and 0.9, known at 0.1, 0.3 and 0.2: five of six pairs are the right way round."""
    assert FOUND.open_set() == [
        {"classifier": "b", "material": "ash", "n_unknown": 1, "n_known": 3, "auroc": pytest.approx(1 / 3)},
        {"classifier": "b", "material": "cork", "n_unknown": 2, "n_known": 3, "auroc": pytest.approx(5 / 6)},
    ]
    assert Comparison("shipped", 1, 0, ROWS[10:]).open_set() == []  # no known grasp to stand against


@pytest.mark.parametrize(
    ("split", "repeats", "parts"),
    [
        ("random", 2, ["Mean over 2 random splits", "90 % Clopper-Pearson", "with n counted as distinct"]),
        ("shipped", 1, ["90 % Clopper-Pearson interval; n counts test grasps."]),
        ("session", 1, ["n counts test grasps", "one session fail together: another session may"]),
    ],
)
def test_how_intervals_were_made_is_written_beside_them(split: str, repeats: int, parts: list[str]) -> None:
    note = Comparison(split, repeats, 0, ROWS, level=0.9).interval_note
    assert all(part in note for part in parts)
    assert note.endswith("bootstrap over grasps.") is (split != "session")


def test_each_table_is_a_file_of_its_rows(tmp_path: Path) -> None:
    FOUND.save(tmp_path)
    lines = {file.stem: file.read_text().splitlines() for file in tmp_path.glob("*.csv")}
    assert {name: len(rows) - 1 for name, rows in lines.items()} == {
        "scores": 6,
        "cautions": 2,
        "predictions": 14,
        "confusion": 4 + 4 + 4 + 1 + 4 + 1,
        "calibration": 5 + 4 + 2 + 1 + 3 + 1,
        "differences": 3,
        "open_set": 2,
    }
    assert lines["confusion"][:3] == [
        "classifier,condition,true,predicted,grasps_a_split",
        "a,pooled,iron,iron,1.5",
        "a,pooled,iron,wood,0",
    ]
