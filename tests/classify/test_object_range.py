"""An object of unknown temperature has a stated range, and what the model does not explain is told."""

from __future__ import annotations

import csv
import gzip
import os
from pathlib import Path

import numpy as np
import pytest

from thermogrip.classify import classify_grasps, save_classifier
from thermogrip.classify.decisions.explain import unexplained_answers, unexplained_effusivities
from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.cli.main import main
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import Grasps, make_grasps
from thermogrip.sysid.effusivity.data import object_range, touches, with_object_range
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
from thermogrip.sysid.effusivity.laplace_approximation import T_OBJECT
from thermogrip.sysid.effusivity.posterior import effusivity_posterior
from thermogrip.sysid.effusivity.priors import material_hypotheses, prior_of


@pytest.fixture(scope="module")
def finger() -> PosteriorClassifier:
    return PosteriorClassifier().with_device(load_default_gripper())


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


def test_what_the_model_does_not_explain_is_told(finger: PosteriorClassifier, cold: Grasps) -> None:
    def said(grasps: Grasps, stated: tuple[float, float] | None = None) -> list[str]:
        return unexplained_answers(
            finger, grasps, classify_grasps(finger, with_object_range(grasps, stated)), stated
        )

    assert said(load_example_grasps()["exp3C_obj18_grip38"]) == [""] * 24
    assert said(cold) == said(cold, (10.0, 26.0)) == [""] * 3
    assert all("doubt the answer" in words for words in said(cold, (28.0, 34.0))[:2])  # metals at 18
    cut = (
        3.0 * (cold["time"] > 3.0) * (1 - np.exp(-(cold["time"] - 3.0).clip(0.0) / 0.3))
    )  # heat let in at 3 s
    wrong = said(cold.assign(t_surface=cold["t_surface"] + cut))
    assert wrong == ["the trace is not explained by the model: doubt the answer"] * 3


def test_the_command_line_takes_the_range_and_names_what_is_not_explained(
    finger: PosteriorClassifier, cold: Grasps, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cold.to_netcdf(tmp_path / "g.nc")
    save_classifier(finger, tmp_path / "m")
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
    assert "doubt the answer" in capsys.readouterr().out
    assert "doubt" in rows("classify", str(tmp_path / "m"), file, "--object-range", "28,34")[0]["note"]
    assert rows("classify", str(tmp_path / "m"), file, "--object-range", "15,21")[2]["material"] == "wood"
    for bad in ("12", "21,15", "21,21", "a,b", "nan,3"):
        assert main(["classify", str(tmp_path / "m"), file, "--object-range", bad, "--out", str(table)]) == 2
        assert "--object-range" in capsys.readouterr().err


REAL = Path(os.environ.get("THERMOGRIP_REAL_DATA", Path(__file__).parents[3] / "shared" / "data" / "real"))


@pytest.mark.skipif(
    not (REAL / "two_sensor_contacts.csv.gz").is_file(),
    reason=f"no measurements of other labs in {REAL} (set THERMOGRIP_REAL_DATA)",
)
def test_no_contact_of_another_rig_is_put_out_of_the_range_without_a_word() -> None:
    """Cooled wood came out at -35 to +23 degC, and nothing was told."""
    with gzip.open(REAL / "two_sensor_contacts.csv.gz", "rt", newline="") as file:
        lines = [row for row in csv.DictReader(file) if int(row["grasp"]) % 6 == 0]
    names = list(dict.fromkeys(row["grasp"] for row in lines))
    skin = np.array([[float(row["t_heated_degC"]) for row in lines if row["grasp"] == k] for k in names])
    time = [float(row["time_s"]) for row in lines if row["grasp"] == names[0]]
    grasps = make_grasps(time, skin, names, t_ambient=np.full(len(names), 23.0))
    device = load_default_gripper()
    for stated in (None, (1.0, 25.0)):
        rows = effusivity_posterior(device, with_object_range(grasps, stated))
        told = unexplained_effusivities(device, grasps, rows, stated)
        ends = object_range(grasps, stated)
        outside = [
            row.grasp_id
            for row, (low, high) in zip(rows, ends)
            if not low - 2 <= row.t_object <= high + 2  # at the median effusivity it may be just inside
        ]
        assert set(outside) <= set(told)
