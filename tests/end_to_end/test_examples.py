"""The programs in examples/ do what they say."""

from __future__ import annotations

from pathlib import Path

import pytest

from thermogrip.datasets.log_files import read_log
from thermogrip.sysid.models.user_model import load_object

EXAMPLES = Path(__file__).parents[2] / "examples"


def test_every_program_is_in_the_list() -> None:
    listed = (EXAMPLES / "README.md").read_text(encoding="utf-8")
    assert all(f"`{path.name}`" in listed for path in EXAMPLES.glob("*.py"))


@pytest.mark.slow
def test_the_loop_brings_the_skin_to_its_target(capsys: pytest.CaptureFixture[str]) -> None:
    assert load_object(EXAMPLES / "control_loop.py", "main")() < 0.25
    assert capsys.readouterr().out.count(" ok\n") == 10


@pytest.mark.slow
def test_grasps_at_twenty_kelvin_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert load_object(EXAMPLES / "name_materials.py", "main")() >= 8 / 9
    assert "while it is touched" in capsys.readouterr().out


def test_the_benchmarks_table_becomes_two_logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    table = tmp_path / "dataBenchmark.csv"
    table.write_text(
        "uEst,uVal,yEst,yVal,Ts,\n3.25,1.5,5.205,4.97,4,\n3.24,1.6,5.2154,4.98,,\n", encoding="utf-8"
    )
    names = load_object(EXAMPLES / "cascaded_tanks.py", "split_benchmark")(table)
    assert names == ["cascaded_tanks_train.csv", "cascaded_tanks_test.csv"]
    train, test = (read_log(name) for name in names)
    assert train["time"].values.tolist() == [0.0, 4.0]
    assert train["level"].values.tolist() == [5.205, 5.2154]
    assert test["pump"].values.tolist() == [1.5, 1.6]
    assert (train["pump"].attrs["role"], test["level"].attrs["units"]) == ("input", "V")
