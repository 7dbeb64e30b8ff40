"""Every mistake of a user is one line with the mend, code 2, no traceback and no half-written file."""

from __future__ import annotations

import errno
import os
import pickle
from collections.abc import Callable
from pathlib import Path

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


# What is wrong -> the log as it stands on disk, and what the line must name.
BAD_LOGS: dict[str, tuple[str | bytes, tuple[str, ...]]] = {
    "empty file": ("", ()),
    "header only": (table(), ()),
    "one row": (table(ROWS[0]), ("row",)),
    "text in a number column": (
        table(*ROWS[:5], row(5, t_tank_degC="warm"), *ROWS[6:]),
        ("row 7", "t_tank_degC", "'warm'"),
    ),
    "a column without one number": (
        table(*(row(k, t_surface_degC="") for k in range(60))),
        ("t_surface",),
    ),
    "time going back": (table(*ROWS[:30], row(30, time_s="2.25"), *ROWS[31:]), ("row 32",)),
    "an unknown unit": (table(*ROWS, header=HEADER.replace("t_tank_degC", "t_tank_mV")), ("t_tank_mV",)),
    "no time column": (table(*ROWS, header=HEADER.replace("time_s", "stamp")), ("time",)),
    "a row with a cell too many": (table(*ROWS[:5], ROWS[5] + ",9", *ROWS[6:]), ("row 7",)),
    "a column twice": (table(*ROWS, header=HEADER.replace("pump", "drive")), ("drive",)),
    "bytes that are no text": (bytes(range(256)) * 20, ()),
    "temperatures below absolute zero": (
        table(*(row(k, t_tank_degC="-400") for k in range(60))),
        ("t_tank",),
    ),
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
    "a missing log": ("identify none.csv --network none --out p.json", ("none.csv",)),
    "an unknown ending": ("identify plant.json --network none --out p.json", ("plant.json",)),
    "a column that is absent": (
        "identify good.csv --network none --inputs drive,valve --out p.json",
        ("valve", "good.csv"),
    ),
    "a model that is unknown": ("identify good.csv --models arx,magic --out p.json", ("magic", "arx")),
    "a network that is unknown": ("identify good.csv --network griper --out p.json", ("griper",)),
    "a network without its file": ("identify good.csv --network none.toml --out p.json", ("none.toml",)),
    "a cut that is empty": ("identify good.csv@50:20 --network none --out p.json", ("good.csv",)),
    "a cut past the end": ("validate plant.json good.csv@5000:", ("good", "299.5")),
    "an output that is a folder": ("identify good.csv --network none --out made.json", ("folder",)),
    "an output behind a file": ("identify good.csv --network none --out good.csv/p.json", ("good.csv",)),
    "an output of another kind": ("identify good.csv --network none --out plant.txt", (".json",)),
    "a log instead of a plant": ("validate good.csv good.csv", ("good.csv",)),
    "a plant instead of a controller": ("review plant.json", ("plant.json",)),
    "a plant that lacks the log's columns": ("validate plant.json more.csv", ("more.csv",)),
    "a target out of range": ("run c.json --target 90 --twin plant.json --out r", ("90", "10 to 50")),
    "no rig": ("run c.json --target 30 --out r", ("--twin",)),
    "an object without material": (
        "run c.json --target 30 --twin plant.json --object 43 --out r",
        ("--material",),
    ),
    "a material that is unknown": (
        "run c.json --target 30 --twin plant.json --object 43 --material coper --out r",
        ("coper", "copper"),
    ),
    "no such row in the table": ("materials unobtainium", ("unobtainium",)),
    "a missing spec": ("tune plant.json --spec none.toml --out c.json", ("none.toml",)),
    "an excitation of an unknown kind": ("excite --kind noise --minutes 5 --out s.csv", ("noise", "prbs")),
    "an excitation without length": ("excite --kind prbs --minutes 0 --out s.csv", ("--minutes",)),
    "a classifier that is unknown": ("train grasps.csv --classifier forest --out m", ("forest", "posterior")),
    "a part that is unknown": ("train grasps.csv --classifier features-lda --split some --out m", ("some",)),
    "no grasps": ("train none.csv --classifier features-lda --out m", ("none.csv",)),
    "a log instead of grasps": ("train good.csv --classifier features-lda --out m", ("good.csv",)),
    "no model": ("classify none grasps.csv --out p.csv", ("none",)),
    "one grasp in training and test": ("compare grasps.csv --test grasps.csv --out c", ("g000",)),
    "a comparison of nothing": ("compare grasps.csv --classifiers , --out c", ("names nothing",)),
}


@pytest.mark.parametrize("what", BAD_WORDS)
def test_a_bad_word_is_refused_by_name(what: str, bench: Bench) -> None:
    words, names = BAD_WORDS[what]
    for file in ("c.json", "plant.json"):  # files are looked for first, and are not what is wrong here
        (bench.path / file).touch()
    assert_refused(bench, list(words.split()), *names)


def cut_in_half(bench: Bench) -> Path:
    bench.run("simulate", "plant.json", "good.csv", "--out", "whole.nc")
    path = bench.path / "whole.nc"
    assert path.is_file()
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return path


def pickle_as_json(bench: Bench) -> Path:
    return bench.write("evil.json", pickle.dumps({"schema": "thermogrip.plant"}))


def json_cut_in_half(bench: Bench) -> Path:
    text = (bench.path / "plant.json").read_bytes()
    return bench.write("half.json", text[: len(text) // 2])


def newer_version(bench: Bench) -> Path:
    text = (bench.path / "plant.json").read_text()
    return bench.write("newer.json", text.replace('"version": 1', '"version": 99'))


def plant_without_a_key(bench: Bench) -> Path:
    text = (bench.path / "plant.json").read_text()
    return bench.write("keyless.json", text.replace('"values"', '"worth"'))


@pytest.mark.parametrize("make", [pickle_as_json, json_cut_in_half, newer_version, plant_without_a_key])
def test_a_damaged_plant_is_refused_and_runs_no_code(make: Callable[[Bench], Path], bench: Bench) -> None:
    path = make(bench)
    assert_refused(bench, ["validate", path, "good.csv"], path.name)


def test_a_truncated_netcdf_is_refused(bench: Bench) -> None:
    path = cut_in_half(bench)
    assert_refused(bench, ["validate", "plant.json", path], "whole.nc")


def test_a_network_with_a_mistake_names_table_and_key(bench: Bench) -> None:
    text = bench.run("init", "network").out
    path = bench.write("mine.toml", text.replace('capacity = "C_plate"', 'capacity = "C_plat"'))
    assert_refused(
        bench, ["identify", "good.csv", "--network", path, "--out", "p.json"], "mine.toml", "C_plat"
    )


def test_a_spec_with_an_unknown_key_names_it(bench: Bench) -> None:
    path = bench.write("spec.toml", bench.run("init", "spec").out + "\nhapiness = 3\n")
    assert_refused(bench, ["tune", "plant.json", "--spec", path, "--out", "c.json"], "spec.toml", "hapiness")


def test_a_grasp_without_contact_is_refused(bench: Bench) -> None:
    lines = (bench.path / "grasps.csv").read_text().splitlines()
    before_contact = [
        line for line in lines[1:] if not line.startswith("g003") or float(line.split(",")[1]) < 0
    ]
    path = bench.write("early.csv", "\n".join([lines[0], *before_contact]) + "\n")
    bench.write("early_meta.csv", (bench.path / "grasps_meta.csv").read_text())
    assert_refused(bench, ["train", path, "--classifier", "features-lda", "--out", "m"], "early.csv", "g003")


def test_grasps_without_their_meta_file_are_refused(bench: Bench) -> None:
    path = bench.write("alone.csv", (bench.path / "grasps.csv").read_text())
    assert_refused(bench, ["train", path, "--classifier", "features-lda", "--out", "m"], "alone")


def test_unlabelled_grasps_cannot_train(bench: Bench) -> None:
    path = bench.write("blind.csv", (bench.path / "grasps.csv").read_text())
    bench.write("blind_meta.csv", (bench.path / "grasps_meta.csv").read_text().replace("copper", ""))
    assert_refused(bench, ["train", path, "--classifier", "features-lda", "--out", "m"], "blind")


@pytest.mark.parametrize(
    "words",
    [
        ("train", "odd.csv", "--split", "all", "--classifier", "posterior", "--out", "m"),
        ("effusivity", "grasps.csv", "--calibrate", "odd.csv", "--out", "e.csv"),
    ],
)
@pytest.mark.parametrize(
    ("label", "hint"),
    [("coper", "did you mean copper?"), ("unobtainium", "'thermogrip materials' lists them all")],
)
def test_a_label_that_the_materials_table_has_not_is_named_with_its_file(
    bench: Bench, words: tuple[str, ...], label: str, hint: str
) -> None:
    bench.write("odd.csv", (bench.path / "grasps.csv").read_text())
    meta = (bench.path / "grasps_meta.csv").read_text()
    bench.write("odd_meta.csv", meta.replace("copper", label))
    assert_refused(bench, [*words], "odd, column material: grasp 'g000'", repr(label), hint)


def test_an_unknown_candidate_is_refused(bench: Bench) -> None:
    assert bench.run("train", "grasps.csv", "--classifier", "features-lda", "--out", "m").code == 0
    words = ["classify", "m", "more.csv", "--materials", "copper,gold", "--out", "p.csv"]
    assert_refused(bench, words, "gold", "copper")


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
    assert done.code == 0, done
    assert "name the column t_tank_K if this is kelvin" in done.err
