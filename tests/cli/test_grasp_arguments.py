"""Files of grasps that a command line names: folders, patterns, names of one stem, a place for answers."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

import pytest

from thermogrip.cli.classify import check_place
from thermogrip.cli.grasp_arguments import distinct_names, list_grasp_files, read_grasp_files
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.grasp_files import write_grasps
from thermogrip.datasets.schema import Grasps, make_grasps


def grasps(*ids: str) -> Grasps:
    return make_grasps([-1.0, 0.0, 1.0], [[23.0, 23.0, 24.0]] * len(ids), ids, name="small")


def test_a_folder_is_its_grasp_files(tmp_path: Path) -> None:
    write_grasps(grasps("a", "b"), tmp_path / "b.csv")
    write_grasps(grasps("a", "b"), tmp_path / "a.nc")
    assert [r.attrs["name"] for r in read_grasp_files([tmp_path])] == ["small", "b"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="holds no grasp files"):
        read_grasp_files([tmp_path / "empty"])
    with pytest.raises(UserError, match="is given twice"):
        read_grasp_files([tmp_path / "b.csv", tmp_path / "b.csv"])


def test_two_files_that_call_themselves_alike_are_both_read(tmp_path: Path) -> None:
    for k in range(2):
        write_grasps(grasps(f"g{k}"), tmp_path / f"{k}.nc")
    assert [r.attrs["name"] for r in read_grasp_files([tmp_path])] == ["small", str(tmp_path / "1.nc")]


def test_a_folder_of_folders_says_the_pattern_for_it(tmp_path: Path) -> None:
    (tmp_path / "may").mkdir()
    with pytest.raises(UserError, match=r"holds no grasp files.*or a pattern in quotes: '.*/\*/\*.parquet'"):
        read_grasp_files([tmp_path])


def test_files_of_one_name_in_several_folders_are_told_apart_by_these(tmp_path: Path) -> None:
    files = [tmp_path / "may" / "a.csv", tmp_path / "june" / "a.csv", tmp_path / "b.csv"]
    assert distinct_names(files) == ["may/a.csv", "june/a.csv", None]
    with pytest.raises(UserError, match=r"b\.csv: is given twice"):
        distinct_names([tmp_path / "b.csv", tmp_path / "may" / ".." / "b.csv"])


def test_files_of_every_ending_but_meta_files_and_hidden_ones_are_found_in_a_folder(tmp_path: Path) -> None:
    for name in ("a.parquet", "b.pq", "c.csv", "c_meta.csv", "d.csv.xz", "e.nc", ".f.csv", "g.txt"):
        (tmp_path / name).touch()
    found = [path.name for path in list_grasp_files([tmp_path])]
    assert found == ["a.parquet", "b.pq", "c.csv", "d.csv.xz", "e.nc"]


@pytest.mark.parametrize(
    ("out", "given", "problem"),
    [
        ("a.csv", ["a.csv"], "is to be read and written"),
        ("a_meta.csv", ["b.csv", "a.csv"], "is to be read and written"),
        ("new.csv", ["."], "is in a folder that is read"),
        ("new.csv", ["*.csv"], "is to be read and written"),
        ("more/new.csv", [".", "*.csv"], ""),
    ],
)
def test_an_output_is_no_file_that_is_read(out: str, given: list[str], problem: str, tmp_path: Path) -> None:
    (tmp_path / "more").mkdir()
    for name in "ab":
        write_grasps(grasps(name), tmp_path / f"{name}.csv")
    with pytest.raises(UserError, match=problem) if problem else nullcontext():
        check_place(tmp_path / out, [str(tmp_path / name) for name in given])
