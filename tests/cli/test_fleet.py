"""fleet: from folders of logs to a population, to pooled plants and to a prior."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.cli.conftest import Bench
from thermogrip.datasets.log_files import write_log
from thermogrip.datasets.schema import make_log
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.plant.plant import Plant


@pytest.fixture
def rigs(tmp_path: Path) -> Path:
    """Three boards that lose heat 0.9, 1.0 and 1.1 times as fast as 1.3 times the prior, a log of each."""
    board, rng = prior_plant(load_network("tclab")), np.random.default_rng(0)
    t = np.arange(0.0, 400.0, 4.0)
    signals = {"q1": (60.0 * (t < 200), "percent", "input"), "q2": (40.0 * (t > 100), "percent", "input")}
    signals |= {name: (np.full(t.size, 23.0), "degC", "output") for name in ("t1", "t2")}
    for k, factor in enumerate((0.9, 1.0, 1.1)):
        truth = replace(board, values=board.values | {"G_amb": 0.013 * factor})
        log = truth.simulate(make_log(t, signals))
        for name in ("t1", "t2"):
            log[name] = ("time", log[name].values + 0.1 * rng.normal(size=t.size), log[name].attrs)
        (tmp_path / f"rigs/b{k}").mkdir(parents=True)
        write_log(log, tmp_path / f"rigs/b{k}/log.csv")
    return tmp_path / "rigs"


def test_a_fleet_gives_population_plants_page_and_prior(bench: Bench, rigs: Path) -> None:
    words = ("fleet", str(rigs), "--network", "tclab", "--report", "f.html", "--out", "f", "--json")
    done = bench.run(*words)
    answer = json.loads(done.out)
    assert (done.code, answer["ill"]) == (0, [])
    assert "t1: fits leave 0.09" in done.err  # of 0.1, where the network expects 0.4
    low, high = answer["population"]["intervals_90"]["G_amb"]
    assert low < 0.013 < high
    assert [rig["rig"] for rig in answer["rigs"]] == ["b0", "b1", "b2"]
    lost = [Plant.load(bench.path / f"f/b{k}_plant.json").values["G_amb"] for k in range(3)]
    assert lost == sorted(lost)
    assert "b2" in (bench.path / "f.html").read_text()
    log, prior = str(rigs / "b0/log.csv"), str(bench.path / "f/population.json")
    done = bench.run("identify", log, "--models", "network", "--prior", prior, "--out", "p.json", "--json")
    assert json.loads(done.out)["model"] == "network"
    model = Plant.load(bench.path / "p.json").model
    assert model.specs["G_amb"].value == pytest.approx(np.exp(answer["population"]["mean"][0]))


def test_two_runs_write_the_same_but_for_provenance(bench: Bench, rigs: Path) -> None:
    for out in ("f", "g"):
        assert bench.run("fleet", str(rigs), "--network", "tclab", "--out", out).code == 0
    for one in (bench.path / "f").iterdir():
        first, again = (json.loads((bench.path / out / one.name).read_text()) for out in ("f", "g"))
        assert first | {"provenance": None} == again | {"provenance": None}


def test_logs_of_several_days_show_which_board_changes(bench: Bench, tmp_path: Path) -> None:
    board, rng = prior_plant(load_network("tclab")), np.random.default_rng(1)
    t = np.arange(0.0, 800.0, 4.0)
    signals = {"q1": (60.0 * (t < 400), "percent", "input"), "q2": (40.0 * (t > 200), "percent", "input")}
    signals |= {name: (np.full(t.size, 23.0), "degC", "output") for name in ("t1", "t2")}
    for k, factor in enumerate((0.9, 1.0, 1.1)):
        (tmp_path / f"days/b{k}").mkdir(parents=True)
        for month in range(4):
            more = 1 + 0.25 * month * (k == 1)  # a fan that is turned up
            truth = replace(board, values=board.values | {"G_amb": 0.013 * factor * more})
            log = truth.simulate(make_log(t, signals))
            for name in ("t1", "t2"):
                log[name] = ("time", log[name].values + 0.1 * rng.normal(size=t.size), log[name].attrs)
            write_log(log, tmp_path / f"days/b{k}/{month}_2026-0{4 - month}-10.csv")  # the last day first
    words = ("fleet", str(tmp_path / "days"), "--network", "tclab", "--report", "f.html", "--out", "f")
    done = bench.run(*words, "--json")
    answer = json.loads(done.out)
    assert (done.code, answer["changing"]) == (3, ["b1"])
    moved = answer["rigs"][1]["from_first_to_last"]
    assert moved["days"] == [90, 59, 31, 0]
    assert moved["change"]["G_amb"] == pytest.approx(-np.log(1.75), abs=0.1)  # April's has the least
    page = (bench.path / "f.html").read_text()
    assert "Which rig changes?" in page
    (tmp_path / "days/b2/3_2026-01-10.csv").rename(tmp_path / "days/b2/undated.csv")
    done = bench.run(*words[:4], "--out", "g", "--json")
    assert "undated.csv: says no date" in done.err
    assert json.loads(done.out)["rigs"][0]["from_first_to_last"]["days"] is None


def test_folders_that_are_no_fleet_are_refused(bench: Bench, rigs: Path) -> None:
    (rigs / "empty").mkdir()
    done = bench.run("fleet", str(rigs), "--network", "tclab", "--out", "f")
    assert (done.code, "has no log" in done.err) == (2, True)
    (rigs / "empty").rename(rigs / ".hidden")  # of a notebook, say
    (rigs / "b1/deep").mkdir()
    (rigs / "b1/log.csv").rename(rigs / "b1/deep/log.csv")
    done = bench.run("fleet", str(rigs), "--network", "tclab", "--out", "f")
    assert (done.code, "not deeper" in done.err) == (2, True)
    (rigs / "b1/deep/log.csv").rename(rigs / "b1/log.csv")
    (rigs / "b2/log.csv").unlink()
    (rigs / "b2").rmdir()
    done = bench.run("fleet", str(rigs), "--network", "tclab", "--out", "f")
    assert (done.code, "2 folders" in done.err) == (2, True)
    done = bench.run("fleet", str(rigs / "b0/log.csv"), "--out", "f")
    assert (done.code, "is no folder" in done.err) == (2, True)


def test_a_prior_needs_its_network(bench: Bench, rigs: Path) -> None:
    log = str(rigs / "b0/log.csv")
    done = bench.run("identify", log, "--prior", log, "--out", "p.json")
    assert done.code == 2
    assert not (bench.path / "p.json").exists()


def test_a_fault_names_file_and_column_and_leaves_no_folder(bench: Bench, rigs: Path) -> None:
    words = ("fleet", str(rigs), "--network", "tclab", "--out", "f")
    log, text = rigs / "b2/log.csv", (rigs / "b2/log.csv").read_text()
    log.write_text(text.replace("q1_percent", "q1_W"))
    done = bench.run(*words)
    assert (done.code, f"{log}, column q1: is in 'W'" in done.err) == (2, True)
    log.write_text("".join(text.splitlines(keepends=True)[:6]))
    done = bench.run(*words)
    assert (done.code, "b2/log: too short" in done.err) == (2, True)
    assert not (bench.path / "f").exists()


def test_what_is_repaired_missing_or_no_log_is_told(bench: Bench, rigs: Path) -> None:
    log = rigs / "b2/log.csv"
    rows = [line.split(",") for line in log.read_text().splitlines()]
    q1 = rows[0].index("q1_percent")
    rows[9][rows[0].index("t1_degC")] = "hello"
    log.write_text("\n".join(",".join(row[:q1] + row[q1 + 1 :]) for row in rows))
    (rigs / "b0/notes.md").write_text("new fan")
    (rigs / "loose.csv").write_text("")
    (rigs / "b1/again.csv").write_text((rigs / "b0/log.csv").read_text())
    done = bench.run("fleet", str(rigs), "--network", "tclab", "--out", "f", "--json")
    assert done.code == 0
    for told in (
        f"{log}: t1_degC: 1 cell(s) that are no numbers left empty (row 10: 'hello')",
        "rig b2: q1: no such column, taken as 0 percent",
        "rig b2: q1 never moves",
        f"{rigs / 'b0/notes.md'}: is no log and left out",
        f"{rigs / 'loose.csv'}: is in no rig's folder",
        f"{rigs / 'b1/again.csv'}: has the data of {rigs / 'b0/log.csv'}",
    ):
        assert told in done.err
    assert json.loads(done.out)["misfit"] == ["b2"]


def test_what_many_logs_have_in_common_is_told_once(bench: Bench, rigs: Path) -> None:
    for log in rigs.glob("b*/log.csv"):
        head, *rows = log.read_text().splitlines()
        at = head.split(",").index("t1_degC")
        cells = [row.split(",") for row in rows]
        for row in cells:
            row[at] = f"{float(row[at]) + 273.15:.2f}"
        log.write_text("\n".join([head.replace("t1_degC", "t1_K"), *(",".join(row) for row in cells)]))
    done = bench.run("fleet", str(rigs), "--network", "tclab", "--out", "f", "--json")
    assert done.code == 0
    assert done.err.count("converted from K to degC") == 1
    assert f"{rigs / 'b0/log.csv'} (and 2 more logs): t1: converted from K to degC" in done.err
