"""Parts of files: an ended run goes on where it stopped, to the same bytes."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from thermogrip.datasets import parallel, partitions
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.grasp_files import write_grasps
from thermogrip.datasets.partitions import Answers, check_apart, parts_of, sources
from thermogrip.datasets.schema import Grasps, make_grasps

Answer = Callable[[Grasps], dict[str, Any]]
N_FILES, N = 3, 5  # with parts of two grasps: three parts a file


def record_of(name: str, n: int = N, **columns: Any) -> Grasps:
    skin = 23.0 + np.arange(3 * n).reshape(n, 3) / 8
    return make_grasps([-1.0, 0.0, 1.0], skin, [f"{name}{k}" for k in range(n)], name=name, **columns)


@pytest.fixture(autouse=True)
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(partitions, "PART", 2)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder of grasp files."""
    made = tmp_path / "grasps"
    made.mkdir()
    for k in range(N_FILES):
        write_grasps(record_of("abc"[k]), made / f"{'abc'[k]}.csv")
    return made


class Work:
    """Answers that count their parts and fail when they are told to."""

    def __init__(self, fails_at: int | None = None, fault: BaseException | None = None) -> None:
        self.asked: list[list[str]] = []
        self.read: list[str] = []
        self.shares: list[float] = []
        self.fails_at, self.fault = fails_at, fault or KeyboardInterrupt()

    def prepare(self, record: Grasps) -> Grasps:
        self.read.append(record.attrs["name"])
        return record

    def answer(self, part: Grasps) -> dict[str, Any]:
        if len(self.asked) == self.fails_at:
            raise self.fault
        self.asked.append([str(name) for name in part["grasp"].values])
        rows = [{"grasp_id": n, "last": v} for n, v in zip(self.asked[-1], part["t_surface"].values[:, -1])]
        if "b2" in self.asked[-1]:
            rows[0]["note"] = "a column of its own"
        return {"rows": rows}

    def run(self, folder: Path, out: Path, question: str = "?", said: list[str] | None = None) -> Answers:
        found, warn = Answers(out, [question]), [].append if said is None else said.append
        found.find(
            sources([folder]),
            self.prepare,
            self.answer,
            lambda share, _: self.shares.append(share),
            warn=warn,
        )
        found.write(out, lambda cell: "" if cell is None else cell)
        found.close()
        return found


@pytest.fixture
def whole(folder: Path, tmp_path: Path) -> bytes:
    Work().run(folder, tmp_path / "whole.csv").remove()
    return (tmp_path / "whole.csv").read_bytes()


def test_all_parts_are_answered_in_order_under_the_columns_of_all(folder: Path, tmp_path: Path) -> None:
    work = Work()
    found = work.run(folder, tmp_path / "o.csv")
    assert [len(part) for part in work.asked] == [2, 2, 1] * N_FILES
    assert found.grasps == N_FILES * N
    lines = (tmp_path / "o.csv").read_text().splitlines()
    assert lines[:2] == ["grasp_id,last,note", "a0,23.25,"]
    assert [line.split(",")[0] for line in lines[1:]] == [*chain(*work.asked)]
    assert lines[1 + N + 2] == "b2,24.0,a column of its own"
    assert work.shares == pytest.approx(np.arange(10) / 9, abs=0.02)
    found.remove()
    assert sorted(os.listdir(tmp_path)) == ["grasps", "o.csv"]


@pytest.mark.parametrize("done", range(1, 9))
def test_the_same_command_goes_on_to_the_same_bytes(
    done: int, folder: Path, tmp_path: Path, whole: bytes
) -> None:
    out = tmp_path / "o.csv"
    with pytest.raises(KeyboardInterrupt):
        Work(done).run(folder, out)
    assert not out.exists()
    again = Work()
    again.run(folder, out)
    assert (len(again.asked), out.read_bytes() == whole) == (9 - done, True)
    assert again.read == ["a", "b", "c"][done // 3 :]  # what is answered is not read
    assert again.shares[:2] == pytest.approx([done / 9, (done + 1) / 9], abs=0.02)


@pytest.mark.parametrize("cut", [1, 40, 200])
def test_a_torn_line_is_cut_off(cut: int, folder: Path, tmp_path: Path, whole: bytes) -> None:
    out, partial = tmp_path / "o.csv", tmp_path / "o.csv.partial"
    with pytest.raises(KeyboardInterrupt):
        Work(4).run(folder, out)
    partial.write_bytes(partial.read_bytes()[:-cut])
    again = Work()
    again.run(folder, out)
    assert (len(again.asked) > 5, out.read_bytes() == whole) == (True, True)


def test_what_was_done_of_other_files_or_asked_otherwise_is_done_anew(
    folder: Path, tmp_path: Path, whole: bytes
) -> None:
    out = tmp_path / "o.csv"
    with pytest.raises(KeyboardInterrupt):
        Work(7).run(folder, out)
    os.utime(folder / "b_meta.csv", (1, 1))
    with pytest.raises(KeyboardInterrupt):
        Work(0).run(folder, out)  # keeps what is of file a
    changed = Work()
    changed.run(folder, out)
    assert [names[0] for names in changed.asked] == ["b0", "b2", "b4", "c2", "c4"]
    assert out.read_bytes() == whole
    other = Work()
    other.run(folder, out, "another question")
    assert (len(other.asked), out.read_bytes() == whole) == (9, True)


def test_a_run_that_answered_nothing_leaves_nothing(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such"):
        Work(0, UserError("no such material")).run(folder, tmp_path / "o.csv")
    assert os.listdir(tmp_path) == ["grasps"]


@pytest.mark.skipif(sys.platform == "win32", reason="no limit on the size of files")
def test_a_full_disk_is_one_line_and_keeps_whole_lines(folder: Path, tmp_path: Path, whole: bytes) -> None:
    import resource

    out, first = tmp_path / "o.csv", Work()
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1200, usual[1]))  # stands for the end of the disk
    try:
        with pytest.raises(UserError, match=r"o.csv.partial: File too large"):
            first.run(folder, out)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)
    again = Work()
    again.run(folder, out)
    assert (0 < len(again.asked) < 9, out.read_bytes() == whole) == (True, True)


def test_two_runs_do_not_write_one_file(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "o.csv"

    class Second(Work):
        def answer(self, part: Grasps) -> dict[str, Any]:
            with pytest.raises(UserError, match="written by another run"):
                Work().run(folder, out)
            return super().answer(part)

    Second().run(folder, out)
    assert out.exists()


def rows_of(record: Grasps) -> dict[str, Any]:
    """Return answers that processes can find."""
    names = record["grasp"].values.tolist()
    return {"rows": [{"grasp_id": name} for name in names], "warnings": [record.attrs["name"]]}


def test_workers_share_out_files_and_give_the_same_bytes(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parallel, "_processes", ThreadPoolExecutor)
    monkeypatch.setattr(parallel.os, "cpu_count", lambda: 3)
    found: list[bytes] = []
    for workers in (1, 3):
        said: list[str] = []
        answers, out = Answers(tmp_path / "o.csv", []), tmp_path / f"{workers}.csv"
        answers.find(
            sources([folder]), lambda r: r, rows_of, lambda *_: None, workers=workers, warn=said.append
        )
        answers.write(out, str)
        assert said == ["a", "a", "a", "b", "b", "b", "c", "c", "c"]
        found.append(answers.path.read_bytes() + out.read_bytes())
        answers.remove()
    assert found[0] == found[1]
    assert b"warnings" not in found[0]


def test_answers_as_parquet_have_the_rows_of_the_table(folder: Path, tmp_path: Path, whole: bytes) -> None:
    import pandas as pd

    work = Work()
    work.run(folder, tmp_path / "o.PARQUET").remove()
    frame = pd.read_parquet(tmp_path / "o.PARQUET")
    table = pd.read_csv(tmp_path / "whole.csv")
    pd.testing.assert_frame_equal(frame, table, check_dtype=False)


def test_a_pattern_that_a_shell_left_is_filled_in(folder: Path) -> None:
    assert [each.name for each in sources([str(folder / "[ac]*.csv")])] == ["a.csv", "c.csv"]


def test_files_of_one_name_in_several_folders_are_told_apart_by_these(folder: Path, tmp_path: Path) -> None:
    for name in ("may", "june"):
        (tmp_path / "year" / name).mkdir(parents=True)
        write_grasps(record_of("a"), tmp_path / "year" / name / "a.csv")
    given = sources([str(tmp_path / "year" / "*" / "a.csv"), folder / "b.csv"])
    assert [each.read().attrs["name"] for each in given] == ["june/a.csv", "may/a.csv", "b"]
    assert (
        Answers(tmp_path / "o.csv", []).find(given, Work().prepare, Work().answer, lambda *_: None).grasps
        == 3 * N
    )


def test_a_file_that_is_given_twice_is_refused_before_any_is_read(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"b\.csv: is given twice"):
        sources([folder, folder / ".." / "grasps" / "b.csv"])


def test_an_answer_to_another_command_waits_for_it(folder: Path, tmp_path: Path, whole: bytes) -> None:
    out, said = tmp_path / "o.csv", list[str]()
    with pytest.raises(KeyboardInterrupt):
        Work(7).run(folder, out)
    with pytest.raises(KeyboardInterrupt):
        Work(2).run(folder, out, "typed by mistake", said)
    assert said[0].startswith(
        f"{out}.partial: {N + N + 2} answers in it are of files as they were, or to another"
    )
    again = Work()
    again.run(folder, out)
    assert (len(again.asked), out.read_bytes() == whole) == (2, True)


@pytest.mark.parametrize("change", ["first", "between", "gone"])
def test_files_that_come_or_go_leave_the_answers_of_the_others(
    change: str, folder: Path, tmp_path: Path
) -> None:
    out = tmp_path / "o.csv"
    with pytest.raises(KeyboardInterrupt):
        Work(7).run(folder, out)
    if change == "gone":
        (folder / "a.csv").unlink()
    else:
        name = {"first": "0", "between": "bb"}[change]
        write_grasps(record_of(name), folder / f"{name}.csv")
    again = Work()
    again.run(folder, out).remove()
    assert len(again.asked) == 2 + 3 * (change != "gone")
    Work().run(folder, tmp_path / "anew.csv").remove()
    assert out.read_bytes() == (tmp_path / "anew.csv").read_bytes()


def test_a_file_that_is_no_file_of_answers_stays_as_it_is(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "o.csv.partial").write_text('{"mine": 1}\n')
    with pytest.raises(UserError, match="is no file of kept answers; move it away"):
        Work().run(folder, tmp_path / "o.csv")
    assert (tmp_path / "o.csv.partial").read_text() == '{"mine": 1}\n'


@pytest.mark.skipif(sys.platform == "win32", reason="no such locks")
def test_no_run_begins_while_another_one_writes_its_table(folder: Path, tmp_path: Path) -> None:
    out, first = tmp_path / "o.csv", Answers(tmp_path / "o.csv", ["?"])
    first.find(sources([folder]), Work().prepare, Work().answer, lambda *_: None)
    with pytest.raises(UserError, match="written by another run"):
        Work().run(folder, out, "another question")
    first.write(out, str)
    first.remove()
    assert len(out.read_text().splitlines()) == 1 + N_FILES * N
    Work().run(folder, out).remove()


@pytest.mark.skipif(sys.platform == "win32", reason="no such locks")
def test_a_run_that_begins_as_another_one_ends_has_a_file_of_its_own(
    folder: Path, tmp_path: Path, whole: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    import fcntl

    out, lock, ended = tmp_path / "o.csv", fcntl.flock, list[int]()

    def late(file: int, how: int) -> None:
        if not ended:  # the other run removes the file between the two calls
            ended.append(file)
            (tmp_path / "o.csv.partial").unlink()
        lock(file, how)

    monkeypatch.setattr(fcntl, "flock", late)
    Work().run(folder, out).remove()
    assert (len(ended), out.read_bytes() == whole) == (1, True)


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
def test_an_output_is_no_file_that_is_read(out: str, given: list[str], problem: str, folder: Path) -> None:
    (folder / "more").mkdir()
    paths = [folder / name for name in given]
    if not problem:
        check_apart(folder / out, paths)
        return
    with pytest.raises(UserError, match=problem):
        check_apart(folder / out, paths)


@pytest.mark.parametrize(("groups", "parts"), [(["", "", "", "", ""], 3), (["", "x", "x", "", ""], 1)])
def test_touches_of_a_record_stay_together(groups: list[str], parts: int) -> None:
    found = parts_of(record_of("a", touch_group=groups, touch=[1.0, 1.0, 2.0, 1.0, 1.0]))
    assert len(found) == parts
    assert [str(name) for part in found for name in part["grasp"].values] == [f"a{k}" for k in range(N)]
