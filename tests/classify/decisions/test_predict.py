"""The predictions table, also for grasps without contact or at the end of their sensor's range."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from thermogrip.classify import (
    classify_grasps,
    make_classifier,
    reasons,
    save_classifier,
    write_predictions,
)
from thermogrip.classify.decisions.next_touch import advise_touches
from thermogrip.classify.decisions.stopping_rule import StopRule
from thermogrip.classify.estimators.base import GraspClassifier, pick
from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.cli.main import main
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import Grasps
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper


def test_the_table_has_the_columns_of_its_contract(three: Grasps, tmp_path: Path) -> None:
    model = make_classifier("bayes").fit(three)
    path = write_predictions(classify_grasps(model, three), tmp_path / "predictions.csv")
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [
        "grasp_id",
        "material",
        "p_copper",
        "p_iron",
        "p_wood",
        "p_unknown",
        "decided_at_s",
    ]
    p = np.array([[float(r[f"p_{m}"]) for m in ("copper", "iron", "wood")] for r in rows])
    np.testing.assert_allclose(p.sum(axis=1), 1.0, atol=2e-6)
    assert [r["material"] for r in rows] == model.predict(three).tolist()
    assert {r["p_unknown"] for r in rows} == {""}
    assert {r["decided_at_s"] for r in rows} == {"10"}


def test_candidates_are_asked_for_by_name(three: Grasps) -> None:
    model = make_classifier("bayes").fit(three)
    rows = classify_grasps(model, three, ["wood", "copper"])
    assert {r["material"] for r in rows} == {"wood", "copper"}
    assert "p_iron" not in rows[0]
    with pytest.raises(UserError, match="named twice"):
        classify_grasps(model, three, ["wood", "wood"])
    with pytest.raises(UserError, match="'gold' is no class"):
        classify_grasps(model, three, ["gold"])
    with pytest.raises(UserError, match="no candidate"):
        classify_grasps(model, three, [])


def test_two_touches_multiply_and_share_the_answer(three: Grasps) -> None:
    model = make_classifier("bayes").fit(three)
    paired = three.assign(touch_group=("grasp", [f"p{i // 2}" for i in range(24)]))
    alone, both = model.predict_proba(three), classify_grasps(model, paired)
    product = alone[0] * alone[1]
    got = [[r[f"p_{m}"] for m in ("copper", "iron", "wood")] for r in both[:2]]
    np.testing.assert_allclose(got, [product / product.sum()] * 2, rtol=1e-9)


def test_the_decision_time_is_that_of_the_last_sample(
    three: Grasps, make_touches: Callable[..., Grasps]
) -> None:
    model = make_classifier("bayes").fit(three)
    cut = make_touches(seed=3)
    cut["t_surface"].values[0, cut["time"].values > 9.65] = np.nan
    times = [r["decided_at_s"] for r in classify_grasps(model, cut)]
    assert times[0] == pytest.approx(9.6)
    assert times[1] == pytest.approx(10.0)


@pytest.mark.parametrize(("gain", "asked"), [(0.0, False), (1e-6, True)])
def test_what_more_contact_would_bring_is_worked_out_only_for_a_rule_that_asks(
    gain: float, asked: bool, three: Grasps, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Seen(Exception):
        pass

    def windows(*_: object, gain: bool, **__: object) -> None:
        raise Seen(gain)

    monkeypatch.setattr("thermogrip.classify.decisions.stopping_rule.growing_windows", windows)
    with pytest.raises(Seen) as seen:
        classify_grasps(make_classifier("bayes").fit(three), three, rule=StopRule(sure=0.99, gain=gain))
    assert seen.value.args == (asked,)


NAMES = ["copper", "iron", "wood"]


def still(grasps: Grasps, *which: int) -> Grasps:
    """Return the grasps as if some had no contact."""
    skin = grasps["t_surface"].values.copy()
    for i in which:
        noise = 0.05 * np.random.default_rng(i).standard_normal(skin.shape[1])
        skin[i] = skin[i, :5].mean() + noise
    return grasps.assign(t_surface=(("grasp", "time"), skin, grasps["t_surface"].attrs))


def numbers(row: dict[str, Any]) -> dict[str, float]:
    """Return what is a number in a row of answers."""
    return {key: value for key, value in row.items() if isinstance(value, float)}


def fitted(name: str) -> GraspClassifier:
    if name == "posterior":
        return PosteriorClassifier().with_device(load_default_gripper())
    options = {"epochs": 2, "hidden": 4} if name == "lstm" else {}
    return make_classifier(name, **options).fit(load_example_grasps()["exp2_dT20"])


@pytest.mark.parametrize("name", ["posterior", "bayes", "features-lda", "pca-lda", "svm-pca", "lstm"])
def test_no_classifier_names_what_was_not_touched(name: str) -> None:
    grasps = load_example_grasps()["exp2_dT20"].isel(grasp=[0, 8, 16])
    model = fitted(name)
    rows, usual = (classify_grasps(model, g, NAMES) for g in (still(grasps, 1), grasps))
    assert rows[1]["material"] == ""
    assert [rows[1][f"p_{m}"] for m in NAMES] == [None] * 3
    assert (rows[1]["p_unknown"], rows[1]["note"]) == (1.0, "no contact")
    for k in (0, 2):  # to rounding: sums over fewer grasps are taken in another order on some processors
        assert numbers(rows[k]) == pytest.approx(numbers(usual[k]), rel=1e-6, abs=1e-9)
        assert (rows[k]["grasp_id"], rows[k]["material"]) == (usual[k]["grasp_id"], usual[k]["material"])
    assert all("note" not in row for row in usual)


@pytest.mark.parametrize("name", ["posterior", "pca-lda"])
def test_a_touch_without_contact_does_not_count_in_its_block(name: str) -> None:
    grasps = load_example_grasps()["exp2_dT20"].isel(grasp=[8, 9])
    grasps = grasps.assign(touch_group=("grasp", ["one", "one"]))
    model = fitted(name)
    both = classify_grasps(model, still(grasps, 0), NAMES)
    (alone,) = classify_grasps(model, pick(grasps, [1]), NAMES)
    wanted = {key: value for key, value in numbers(alone).items() if key.startswith("p_")}
    for row in both:
        assert row["material"] == alone["material"]
        assert {key: row[key] for key in wanted} == pytest.approx(wanted, rel=1e-6, abs=1e-9)
    assert both[0]["note"] == "no contact: the answer of its block's other touches"
    assert "note" not in both[1]
    none = classify_grasps(model, still(grasps, 0, 1), NAMES)
    assert [row["material"] for row in none] == ["", ""]


def test_whoever_can_do_without_the_samples_at_a_rail_names_a_clipped_grasp() -> None:
    grasps = load_example_grasps()["exp2_dT20"].isel(grasp=[0, 8, 16])
    cut = grasps.assign(t_surface=np.maximum(grasps["t_surface"], 41.0))
    row = classify_grasps(fitted("posterior"), cut, NAMES)[1]
    assert row["material"] in NAMES
    assert row["note"].endswith("is the end of the sensor's range")
    assert row["decided_at_s"] < 4.0  # what was read later is not used
    for name in ("bayes", "features-lda", "pca-lda", "svm-pca", "lstm"):
        row = classify_grasps(fitted(name), cut, NAMES)[1]
        assert (row["material"], row["p_copper"], row["p_unknown"]) == ("", None, None)
        assert "needs whole traces" in row["note"]


@pytest.mark.parametrize("name", ["bayes", "features-lda"])
def test_features_of_a_shorter_contact_are_other_numbers_and_refused(name: str) -> None:
    """Asked all the same, they were right in 0.2 to 0.5 of simulated grasps of 3 s, and said 0.8 to 1.0."""
    model = fitted(name)
    grasps = load_example_grasps()["exp2_dT20"].isel(grasp=[8])
    short = grasps.assign(t_surface=grasps["t_surface"].where(grasps["time"] < 3.05))
    with pytest.raises(
        UserError, match="ends at 3 s, the classifier was trained on contacts of 10 s; leave it"
    ):
        model.predict(short)
    with pytest.raises(UserError, match="ends at 3 s"):
        model.predict(grasps.sel(time=slice(None, 3.05)))
    assert model.predict(grasps.sel(time=slice(None, 9.65))).size == 1


@pytest.mark.parametrize("name", ["posterior", "bayes", "pca-lda", "svm-pca"])
def test_a_spike_is_no_reading(name: str) -> None:
    grasps = load_example_grasps()["exp2_dT20"].isel(grasp=[0, 8, 16])
    model = fitted(name)
    for bad in (85.0, -127.0, 0.0):
        spoilt, lost = grasps.copy(deep=True), grasps.copy(deep=True)
        spoilt["t_surface"][1, [40, 70, 71]] = bad
        lost["t_surface"][1, [40, 70, 71]] = np.nan
        for row, other in zip(classify_grasps(model, spoilt, NAMES), classify_grasps(model, lost, NAMES)):
            assert row["material"] == other["material"]
            assert numbers(row) == pytest.approx(numbers(other), rel=1e-6, abs=1e-9)


def test_a_skin_that_moves_away_from_its_object_is_not_named() -> None:
    """The posterior named such grasps with probability 1.00 and p_unknown 0.00."""
    grasps = load_example_grasps()["exp2_dT20"].isel(grasp=[0, 8, 16])
    rows = classify_grasps(fitted("posterior"), grasps.assign(t_object=grasps["t_object"] + 40.0), NAMES)
    assert [row["material"] for row in rows] == [""] * 3
    assert rows[0]["note"] == "the skin moves away from t_object: is that right, and in degC?"
    unsure = grasps.assign(t_object=grasps["t_object"] + 40.0, t_object_sd=("grasp", [20.0] * 3))
    assert all(row["material"] for row in classify_grasps(fitted("posterior"), unsure, NAMES))


def test_what_has_no_answer_asks_for_no_touch_and_has_no_reasons() -> None:
    grasps = still(load_example_grasps()["exp2_dT20"].isel(grasp=[0]), 0)
    model = fitted("posterior")
    assert advise_touches(model, grasps) == [{"next_touch_degC": None, "next_touch_accuracy": None}]
    assert reasons(model, grasps, classify_grasps(model, grasps)) == [""]


def test_the_command_line_writes_it_in_file_and_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    grasps = load_example_grasps()["exp2_dT20"].isel(grasp=[0, 8, 16])
    still(grasps, 1).to_netcdf(tmp_path / "g.nc")
    save_classifier(fitted("posterior"), tmp_path / "model")
    words = ["classify", str(tmp_path / "model"), str(tmp_path / "g.nc"), "--or-unknown", "--next-touch"]
    assert main([*words, "--materials", "copper,wood", "--out", str(tmp_path / "p.csv")]) == 0
    name = str(grasps["grasp"].values[1])
    assert f"no contact, so no name: {name}\n" in capsys.readouterr().out
    with (tmp_path / "p.csv").open() as file:
        row = list(csv.DictReader(file))[1]
    assert (row["material"], row["p_copper"], row["p_unknown"], row["note"]) == ("", "", "1", "no contact")
    assert row["answer"] == "unknown"
