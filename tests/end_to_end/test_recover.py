"""recover and batch on the command line: what they say, and their exit codes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from thermogrip.cli.main import main
from thermogrip.datasets.log_files import read_log
from thermogrip.rig.interface import Event
from thermogrip.rig.records.run_folder import RunFolder


def killed(path: Path, n: int = 30) -> Path:
    """Return the folder of a run that ended in the middle of a line."""
    folder = RunFolder(path, {"seed": 1})
    folder.event(Event(0.0, "phase", "settle"))
    for k in range(n):
        folder.sample({"time_s": float(k), "drive": 0.1, "pump": 1.0, "t_surface_degC": 20.0 + 0.1 * k})
    folder.sync()
    with (path / "samples.csv").open("ab") as file:
        file.write(b"30,0.1,1,2")
    return path


@pytest.mark.parametrize("name", ["log.nc", "log.parquet", "log.csv", "log.mcap"])
def test_a_run_is_written_in_other_formats_and_reads_back(tmp_path: Path, name: str) -> None:
    folder = killed(tmp_path / "run")
    assert main(["recover", str(folder), "--out", str(tmp_path / name)]) == 0
    log = read_log(tmp_path / name)
    assert log["t_surface"].values.tolist() == pytest.approx([20.0 + 0.1 * k for k in range(30)])
    assert log["time"].values.tolist() == pytest.approx(list(range(30)), abs=1e-6)
    assert log["drive"].attrs["role"] == "input"


def test_the_runs_of_a_batch_are_repaired_one_by_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folders = [killed(tmp_path / "batch" / name, n) for name, n in (("0001", 30), ("0002", 20))]
    assert main(["recover", str(tmp_path / "batch"), "--json"]) == 0
    runs = json.loads(capsys.readouterr().out)["runs"]
    assert [(run["run"], run["rows"], run["changed"]) for run in runs] == [
        (str(folders[0]), 30, True), (str(folders[1]), 20, True),
    ]  # fmt: skip
    assert {run["verdict"] for run in runs} == {"interrupted"}
    assert main(["recover", str(tmp_path / "batch")]) == 0  # a second time nothing is left to repair
    said = capsys.readouterr().out.splitlines()
    assert [line.partition(": ")[0] for line in said] == ["0001", "0002"]
    assert main(["recover", str(tmp_path / "batch"), "--out", str(tmp_path / "x.csv")]) == 2
    assert "batch: holds several runs; give the folder of one of them" in capsys.readouterr().err
    assert not (tmp_path / "x.csv").exists()


def test_what_comes_next_names_files_that_are_there_and_a_run_without_a_row_is_an_answer_of_no(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    killed(tmp_path / "batch" / "0001")
    assert main(["recover", str(tmp_path / "batch" / "0001")]) == 0
    then = f"identify {tmp_path}/batch/0001/samples.csv --out plant.json"
    assert capsys.readouterr().err == f"next: thermogrip {then}\n"
    assert main(["recover", str(tmp_path / "batch")]) == 0
    then = f"next: thermogrip batch CONTROLLER PLAN.csv --twin PLANT --out {tmp_path}/batch\n"
    assert capsys.readouterr().err == then
    killed(tmp_path / "batch" / "0002", n=0)
    assert main(["recover", str(tmp_path / "batch")]) == 3
