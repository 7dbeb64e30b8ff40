"""Why a grasp is out of distribution, and what the model does not explain."""

from __future__ import annotations

import csv
import gzip
import os
from pathlib import Path

import numpy as np
import pytest

from thermogrip.classify import classify_grasps, make_classifier, reasons, save_classifier
from thermogrip.classify.decisions.predict import (
    deviation_words,
    deviations,
    unexplained_answers,
    unexplained_effusivities,
)
from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.cli.main import main
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import Grasps, make_grasps
from thermogrip.sysid.effusivity.data import object_range, touches, with_object_range
from thermogrip.sysid.effusivity.gripper_model import GripperModel, load_default_gripper
from thermogrip.sysid.effusivity.laplace_approximation import T_OBJECT, material_hypotheses, prior_of
from thermogrip.sysid.effusivity.posterior import effusivity_posterior

from ...sysid.effusivity.makers import simulated_blocks

FIVE = ["brass", "copper", "iron", "wood", "zinc"]


@pytest.fixture(scope="module")
def device() -> GripperModel:
    return load_default_gripper()


def drawn(device: GripperModel, *, ln_h: float = 0.0, ln_e: float = 0.0, n: int = 12) -> Grasps:
    block = device.blocks["iron"]
    return simulated_blocks(
        device,
        ln_e=[block.ln_effusivity + ln_e] * n,
        ln_h=[block.ln_h + ln_h] * n,
        ln_rho_c=[15.088] * n,
        t_gripper=43.0,
        t_object=23.0,
        material=["iron"] * n,
        seed=5,
    )[0]


def test_usual_grasps_ask_for_nothing_unusual(device: GripperModel) -> None:
    rows = deviations(device, drawn(device, n=30), ["iron"] * 30)
    assert sum(deviation_words("iron", row) != "" for row in rows) <= 2


def test_a_contact_half_as_good_is_named(device: GripperModel) -> None:
    rows = deviations(device, drawn(device, ln_h=-0.7), ["iron"] * 12)
    first = [row[0].words for row in rows]
    assert sum("times the usual contact conductance" in words for words in first) >= 11
    assert all("0.4" <= words[:3] <= "0.7" for words in first if "conductance" in words)


@pytest.mark.parametrize(("off", "word"), [(2.5, "colder"), (-2.5, "warmer")])
def test_a_wrong_nominal_temperature_is_named_with_its_sign(
    device: GripperModel, off: float, word: str
) -> None:
    grasps = drawn(device)
    rows = deviations(device, grasps.assign(t_object=grasps["t_object"] + off), ["iron"] * 12)
    assert sum(f"{word} than its nominal" in row[0].words for row in rows) >= 11


def test_a_trace_that_no_block_gives_is_named(device: GripperModel) -> None:
    grasps = drawn(device)
    saw = grasps.assign(t_surface=grasps["t_surface"] + 0.5 * (grasps["time"] % 1.0))
    assert all("trace" in row[0].words for row in deviations(device, saw, ["iron"] * 12))


def test_reasons_stand_beside_strange_grasps_alone(device: GripperModel) -> None:
    model = PosteriorClassifier().with_device(device)
    files = load_example_grasps()
    known = files["exp1A_obj43_grip23"].isel(grasp=[0, 8, 16])
    cork = files["exp6_other_materials_obj43_grip23"]
    cork = cork.isel(grasp=cork["material"].values == "cork")
    rows = classify_grasps(model, [known, cork], FIVE)
    words = reasons(model, [known, cork], rows)
    assert words[:3] == ["", "", ""]
    assert len(words) == 3 + cork.sizes["grasp"] > 3
    assert all(text.startswith("as wood it needs 0.3") and "effusivity" in text for text in words[3:])
    block = cork.assign(touch_group=("grasp", ["one"] * cork.sizes["grasp"]))
    assert set(reasons(model, block, rows[3:])) == {""}  # its touches have no nominal temperature


def test_a_classifier_without_physics_gives_no_reasons() -> None:
    record = load_example_grasps()["exp2_dT20"]
    model = make_classifier("features-lda").fit(record)
    rows = classify_grasps(model, record)
    assert set(reasons(model, record, rows)) == {""}


@pytest.fixture
def cold() -> Grasps:
    """Copper, iron and wood at 18 degC in a room of 27 to 29, touched at 38; no file has their degrees."""
    grasps = load_example_grasps()["exp3C_obj18_grip38"].isel(grasp=[0, 8, 16])
    return grasps.assign(t_object=grasps["t_object"] * np.nan)


def test_an_unknown_object_is_as_warm_as_the_room_give_or_take(cold: Grasps) -> None:
    device = load_default_gripper()
    bare = cold.drop_vars("t_ambient")
    for grasps, centre in ((cold, cold["t_ambient"].values), (bare, touches(bare).level)):
        prior = prior_of(device, touches(grasps), material_hypotheses(device, ["copper", "iron", "wood"]))
        np.testing.assert_allclose(prior.mean[:, T_OBJECT], centre)
        np.testing.assert_allclose(prior.sd[:, T_OBJECT], 20 / np.sqrt(3))
        ends = object_range(grasps)
        np.testing.assert_allclose(np.diff(ends, axis=1), 40.0)
        np.testing.assert_allclose(ends.mean(axis=1), centre, atol=0.1)


def test_a_stated_range_is_for_objects_of_unknown_temperature(cold: Grasps) -> None:
    known = cold.assign(t_object=("grasp", [18.0, np.nan, np.nan]))
    ranged = with_object_range(known, (10.0, 22.0))
    assert ranged["t_object"].values.tolist() == [18.0, 16.0, 16.0]
    assert np.isnan(ranged["t_object_sd"].values[0])
    np.testing.assert_allclose(ranged["t_object_sd"].values[1:], 12 / np.sqrt(12))
    assert with_object_range(known, None) is known
    for ends in ((5.0, 5.0), (9.0, 5.0), (-400.0, 5.0), (5.0, np.nan)):
        with pytest.raises(UserError, match="an object range of"):
            with_object_range(known, ends)


def test_what_the_model_does_not_explain_is_reported(known: PosteriorClassifier, cold: Grasps) -> None:
    def said(grasps: Grasps, stated: tuple[float, float] | None = None) -> list[str]:
        return unexplained_answers(
            known, grasps, classify_grasps(known, with_object_range(grasps, stated)), stated
        )

    assert said(load_example_grasps()["exp3C_obj18_grip38"]) == [""] * 24
    assert said(cold) == said(cold, (10.0, 26.0)) == [""] * 3
    assert all("the answer is unreliable" in words for words in said(cold, (28.0, 34.0))[:2])  # metals at 18
    cut = (
        3.0 * (cold["time"] > 3.0) * (1 - np.exp(-(cold["time"] - 3.0).clip(0.0) / 0.3))
    )  # heat let in at 3 s
    wrong = said(cold.assign(t_surface=cold["t_surface"] + cut))
    assert wrong == ["the trace is not explained by the model: the answer is unreliable"] * 3


def test_the_command_line_takes_the_range_and_names_what_is_not_explained(
    known: PosteriorClassifier, cold: Grasps, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cold.to_netcdf(tmp_path / "g.nc")
    save_classifier(known, tmp_path / "m")
    file, table = str(tmp_path / "g.nc"), tmp_path / "o.csv"

    def rows(*words: str) -> list[dict[str, str]]:
        assert main([*words, "--out", str(table)]) == 0
        with table.open() as lines:
            return list(csv.DictReader(lines))

    width = []
    for more in ([], ["--object-range", "15,21"]):
        found = rows("effusivity", file, *more)
        width.append(float(found[0]["t_object_p95"]) - float(found[0]["t_object_p05"]))
        assert all(float(row["t_object_p05"]) < 18.5 < float(row["t_object_p95"]) + 1 for row in found)
    assert width[1] < width[0]
    capsys.readouterr()
    rows("effusivity", file, "--object-range", "28,34")
    assert "the answer is unreliable" in capsys.readouterr().out
    assert "unreliable" in rows("classify", str(tmp_path / "m"), file, "--object-range", "28,34")[0]["note"]
    assert rows("classify", str(tmp_path / "m"), file, "--object-range", "15,21")[2]["material"] == "wood"
    for bad in ("12", "21,15", "21,21", "a,b", "nan,3"):
        assert main(["classify", str(tmp_path / "m"), file, "--object-range", bad, "--out", str(table)]) == 2
        assert "--object-range" in capsys.readouterr().err


REAL = Path(os.environ.get("THERMOGRIP_REAL_DATA", Path(__file__).parents[4] / "shared" / "data" / "real"))


@pytest.mark.skipif(
    not (REAL / "two_sensor_contacts.csv.gz").is_file(),
    reason=f"no measurements of other labs in {REAL} (set THERMOGRIP_REAL_DATA)",
)
def test_no_contact_of_another_rig_is_put_out_of_the_range_without_a_word() -> None:
    """Cooled wood came out at -35 to +23 degC, and nothing was reported."""
    with gzip.open(REAL / "two_sensor_contacts.csv.gz", "rt", newline="") as file:
        lines = [row for row in csv.DictReader(file) if int(row["grasp"]) % 6 == 0]
    names = list(dict.fromkeys(row["grasp"] for row in lines))
    skin = np.array([[float(row["t_heated_degC"]) for row in lines if row["grasp"] == k] for k in names])
    time = [float(row["time_s"]) for row in lines if row["grasp"] == names[0]]
    grasps = make_grasps(time, skin, names, t_ambient=np.full(len(names), 23.0))
    device = load_default_gripper()
    for stated in (None, (1.0, 25.0)):
        rows = effusivity_posterior(device, with_object_range(grasps, stated))
        reported = unexplained_effusivities(device, grasps, rows, stated)
        ends = object_range(grasps, stated)
        outside = [
            row.grasp_id
            for row, (low, high) in zip(rows, ends)
            if not low - 2 <= row.t_object <= high + 2  # at the median effusivity it may be just inside
        ]
        assert set(outside) <= set(reported)
