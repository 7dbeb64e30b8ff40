"""A mistake of a user is one line with a hint, code 2, no traceback and no half-written file."""

from __future__ import annotations

import errno
import os

import pytest

from tests.end_to_end.conftest import HEADER, Bench, small_log_rows

ROWS = small_log_rows(60)


def table(*rows: str, header: str = HEADER) -> str:
    return "\n".join([header, *rows]) + "\n"


def row(k: int, **cells: str) -> str:
    names = HEADER.split(",")
    values = ROWS[k].split(",")
    for name, text in cells.items():
        values[names.index(name)] = text
    return ",".join(values)


# What is wrong -> the log on disk, and what the line must name.
BAD_LOGS: dict[str, tuple[str | bytes, tuple[str, ...]]] = {
    "text in a number column": (
        table(*(row(k, t_tank_degC="warm") if k % 2 else ROWS[k] for k in range(60))),
        ("row 3", "t_tank_degC", "'warm'"),
    ),
    "a column without one time": (table(*(row(k, time_s="") for k in range(60))), ("row 2", "time")),
    "time going back": (table(*ROWS[:30], row(30, time_s="2.25"), *ROWS[31:]), ("row 32",)),
    "no temperature that can be": (table(*(row(k, t_tank_degC="-300") for k in range(60))), ("t_tank",)),
    "bytes that are no text": (bytes(range(256)) * 20, ()),
}


def assert_refused(bench: Bench, words: list[object], *names: str) -> None:
    before = {path: path.read_bytes() for path in bench.path.rglob("*") if path.is_file()}
    done = bench.run(*words)
    assert done.code == 2, done
    assert done.out == ""
    assert len(done.said) == 1, done.err
    assert "Traceback" not in done.err
    line = done.said[0]
    for name in names:
        assert name in line
    after = {path: path.read_bytes() for path in bench.path.rglob("*") if path.is_file()}
    assert after == before, "a file was left behind or changed"


@pytest.mark.parametrize("what", BAD_LOGS)
def test_a_bad_log_is_refused_by_name(what: str, bench: Bench) -> None:
    content, names = BAD_LOGS[what]
    path = bench.write("bad.csv", content)
    assert_refused(bench, ["identify", path, "--network", "none", "--out", "p.json"], "bad.csv", *names)
    assert_refused(bench, ["simulate", "plant.json", path, "--out", "sim.csv"], "bad.csv", *names)


BAD_WORDS: dict[str, tuple[str, tuple[str, ...]]] = {
    "a column that is absent": (
        "identify good.csv --network none --inputs drive,valve --out p.json",
        ("valve", "good.csv"),
    ),
    "a cut past the end": ("validate plant.json good.csv@5000:", ("good", "299.5")),
    "an output behind a file": ("identify good.csv --network none --out good.csv/p.json", ("good.csv",)),
    "a plant that lacks the columns of the log": ("validate plant.json more.csv", ("more.csv",)),
    "a material that is unknown": (
        "run c.json --target 30 --twin plant.json --object 43 --material coper --out r",
        ("coper", "copper"),
    ),
    "one file in training and test": (
        "compare grasps.csv --test grasps.csv --out c",
        ("grasps.csv", "trained and tested"),
    ),
}


@pytest.mark.parametrize("what", BAD_WORDS)
def test_a_bad_word_is_refused_by_name(what: str, bench: Bench) -> None:
    words, names = BAD_WORDS[what]
    for file in ("c.json", "plant.json"):  # files are looked for first, and are not what is wrong here
        (bench.path / file).touch()
    assert_refused(bench, list(words.split()), *names)


@pytest.mark.parametrize(
    "words",
    [
        ("train", "odd.csv", "--split", "all", "--classifier", "posterior", "--out", "m"),
        ("effusivity", "grasps.csv", "--calibrate", "odd.csv", "--out", "e.csv"),
    ],
)
def test_a_label_that_is_misspelt_is_named_with_its_file(bench: Bench, words: tuple[str, ...]) -> None:
    bench.write("odd.csv", (bench.path / "grasps.csv").read_text())
    meta = (bench.path / "grasps_meta.csv").read_text()
    bench.write("odd_meta.csv", meta.replace("copper", "coper"))
    said = "odd, column material: grasp 'g000'", "'coper'", "did you mean copper?"
    assert_refused(bench, [*words], *said)
    bench.write("odd_meta.csv", meta.replace("copper", "unobtainium"))
    done = bench.run(*words)
    assert done.code == 0
    assert "unobtainium: not in the materials table, learnt from its grasps" in done.err


def test_a_full_disk_is_one_line_and_leaves_no_half_file(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("os.fsync", full)
    assert_refused(bench, ["simulate", "plant.json", "good.csv", "--out", "sim.csv"], "sim.csv", "full")


def test_a_read_only_folder_is_one_line(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    readable = os.access
    monkeypatch.setattr("os.access", lambda path, mode: not mode & os.W_OK and readable(path, mode))
    assert_refused(bench, ["simulate", "plant.json", "good.csv", "--out", "sim.csv"], "cannot be written")


@pytest.mark.parametrize("verb", ["validate plant.json {log}", "simulate plant.json {log} --out sim.csv"])
def test_what_was_found_in_a_log_is_said_by_every_verb_that_runs_over_it(bench: Bench, verb: str):
    kelvin = table(*(row(k, t_tank_degC=f"{298.15 + k % 3}") for k in range(60)))
    bench.write("kelvin.csv", kelvin)
    done = bench.run(*verb.format(log=bench.path / "kelvin.csv").split())
    assert done.code == (3 if verb.startswith("validate") else 0), done  # a tank that does as it likes
    assert "name the column t_tank_K if this is kelvin" in done.err
