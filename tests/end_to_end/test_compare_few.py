"""compare where a material has too few grasps for random splits: the others are scored."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from thermogrip.cli.main import main
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.grasp_files import write_grasps


def test_random_splits_are_of_the_materials_that_have_grasps_enough(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    grasps = load_example_grasps()["exp2_dT20"]
    wood = grasps["material"].values == "wood"
    keep = ~wood | (np.cumsum(wood) == 1)
    grasps.isel(grasp=keep).to_netcdf(tmp_path / "few.nc")
    words = [
        "compare",
        str(tmp_path / "few.nc"),
        "--classifiers",
        "features-lda",
        "--out",
        str(tmp_path / "c"),
    ]
    assert main([*words, "--json"]) == 0
    said = capsys.readouterr()
    assert list(json.loads(said.out)["splits"]) == ["shipped", "random"]
    (caution,) = json.loads(said.out)["splits"]["random"]["cautions"]
    assert caution["words"] == "wood is left out: 1 grasp(s) cannot give 5 to train and one to test"
    assert "UserWarning" not in said.err


def test_files_that_share_no_material_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = load_example_grasps()
    for name, key in (("ours", "exp2_dT20"), ("others", "exp6_other_materials_obj43_grip23")):
        write_grasps(files[key].assign_attrs(name=name), tmp_path / f"{name}.csv")
    ours, others = str(tmp_path / "ours.csv"), str(tmp_path / "others.csv")
    code = main(["compare", ours, "--test", others, "--classifiers", "pca-lda", "--out", str(tmp_path / "c")])
    said = " ".join(capsys.readouterr().err.split())
    assert code == 2
    assert "nothing to score, as no training grasp is of acrylic, aluminium" in said
    assert said.endswith("nothing to score; test on grasps of the materials that were trained")


def test_grasps_without_a_contact_neither_train_nor_count(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    grasps = load_example_grasps()["exp2_dT20"]
    missed = np.isin(np.arange(24), [1, 6])  # one of the training, one of the test
    still = grasps.assign(t_surface=grasps["t_surface"].where(~missed[:, None], 48.0))
    file = write_grasps(still.assign_attrs(name="still"), tmp_path / "still.csv")
    options = ["--classifiers", "pca-lda", "--repeats", "0", "--json", "--out", str(tmp_path / "c")]
    assert main(["compare", str(file), *options]) == 0
    shown = capsys.readouterr()
    assert "2 left out: no contact" in " ".join(shown.err.split())
    [score] = json.loads(shown.out)["splits"]["shipped"]["scores"]
    assert score["n"] == 8
