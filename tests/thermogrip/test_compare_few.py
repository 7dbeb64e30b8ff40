"""compare where a material has too few grasps for random splits: the given split is scored all the same."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from thermogrip.cli import main
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.report import Picture, Section, write_report


def test_the_given_split_is_scored_where_no_random_one_can_be(
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
    assert list(json.loads(said.out)["splits"]) == ["shipped"]
    assert "no random splits: no condition can be split; " in said.err
    assert "1 grasp(s) of wood" in said.err
    assert "UserWarning" not in said.err


def test_letters_that_the_font_has_not_are_no_warning(tmp_path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure()
    figure.subplots().set_title("木")
    write_report(tmp_path / "r.html", "t", "l", [Section("s", (Picture(figure, "木"),), "v")])
    assert "木" in (tmp_path / "r.html").read_text(encoding="utf-8")
