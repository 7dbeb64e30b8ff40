"""The way through, verb by verb, each stage from the files of the one before."""

from __future__ import annotations

import csv
import json
import re
from typing import Any

import numpy as np
import pytest

from tests.end_to_end.conftest import Bench
from thermogrip.datasets.examples import example_path

SPEC = """
steps = [[28, 34]]
hold_s = 200
evaluations = 3
search_draws = 1
check_draws = 1
"""


def answer(bench: Bench, *words: object, code: int = 0) -> dict[str, Any]:
    done = bench.run(*words, "--json")
    assert done.code == code, done.err
    found = json.loads(done.out)
    return found


def test_logs_become_a_plant_that_runs_freely(bench: Bench) -> None:
    options = ["--network", "none", "--models", "arx", "--average", "1", "--out", "p.json"]
    found = answer(bench, "identify", "good.csv", *options, "--report", "p.html")
    assert found["model"] == "arx"
    scored = answer(bench, "validate", "p.json", "good.csv")["logs"]
    assert scored[0]["outputs"]["t_tank"]["rmse"] < 0.2  # noise 0.02
    assert set(scored[0]["outputs"]["t_tank"]) == {"fit_percent", "rmse", "unit", "n"}
    assert "<svg" not in (bench.path / "p.html").read_text().split("<main>")[1].split("</main>")[0]
    assert "Which plant is behind the logs?" in (bench.path / "p.html").read_text()


def test_the_plant_simulates_what_was_measured(bench: Bench) -> None:
    assert bench.run("simulate", "plant.json", "good.csv", "--out", "sim.csv").code == 0
    with (bench.path / "good.csv").open() as measured, (bench.path / "sim.csv").open() as simulated:
        y = np.array([float(row["t_tank_degC"]) for row in csv.DictReader(measured)])
        v = np.array([float(row["t_tank_degC"]) for row in csv.DictReader(simulated)])
    assert np.sqrt(np.mean((y - v) ** 2)) < 0.05  # the truth itself, noise 0.02


def test_a_plant_becomes_a_controller_that_grasps_and_both_have_whole_pages(bench: Bench) -> None:
    bench.write("spec.toml", SPEC)
    tuned = answer(
        bench, "tune", "plant.json", "--spec", "spec.toml", "--out", "c.json", "--report", "t.html"
    )
    assert tuned["meets_spec"] is True
    assert {row["controller"] for row in tuned["rows"]} == {"baseline", "tuned", "PI"}
    kept = json.loads((bench.path / "c.json").read_text())["notes"]
    assert kept["scores"] == tuned["scores"]
    reviewed = bench.run("review", "c.json", "--json")
    assert reviewed.code in (0, 3)
    names = {check["name"] for check in json.loads(reviewed.out)["checks"]}
    assert "settles where the model lacks structure" in names
    run = ["run", "c.json", "--target", "34", "--from", "28", "--twin", "plant.json", "--hold", "150"]
    run += ["--object", "18", "--material", "copper", "--grasp-time", "2", "--out", "r"]
    done = answer(bench, *run, "--report", "r.html")
    assert done["verdict"] == "settled"
    assert abs(float(str(done["bias"]))) < 0.05
    made = {path.name for path in (bench.path / "r").iterdir()}
    assert made == {"run.json", "samples.csv", "events.jsonl", "grasps.csv", "grasps_meta.csv", "SHA256SUMS"}
    pages = [(bench.path / name).read_text() for name in ("t.html", "r.html")]
    assert all(words in pages[0] for words in ("Does the controller meet the spec?", "minimum time [s]"))
    assert all(words in pages[1] for words in ("Settled on plant.json, draw 0.", "as its sensors read it"))
    for page in pages:
        # the address in uPlot's line of licence is the only one
        own = page.replace("http-equiv", "").replace("/*! https://github.com/leeoniya/uPlot", "")
        assert "http" not in own
        assert not re.search(r"\bnan\b", own.split("<main>")[1].lower().split("base64")[0])
    again = bench.run(*run)
    assert again.code == 2
    assert "holds a run already" in again.said[0]


def test_grasps_become_materials(bench: Bench) -> None:
    assert answer(bench, "train", "grasps.csv", "--classifier", "features-lda", "--out", "m")["grasps"] == 8
    assert bench.run("classify", "m", "more.csv", "--out", "p.csv").code == 0
    with (bench.path / "p.csv").open() as file:
        rows = list(csv.DictReader(file))
    numbers = ["p_copper", "p_wood", "p_unknown", "decided_at_s", "misfit_sd"]
    assert list(rows[0]) == ["grasp_id", "material", *numbers, "deviates", "note", "note_codes"]
    assert [row["material"] for row in rows] == ["copper", "wood"] * 6
    assert all(abs(float(row["p_copper"]) + float(row["p_wood"]) - 1) < 1e-5 for row in rows)


def test_a_comparison_says_n_and_interval(bench: Bench) -> None:
    words = ["compare", "grasps.csv", "--classifiers", "features-lda,pca-lda", "--repeats", "2"]
    found = answer(bench, *words, "--train-per-class", "3", "--out", "c")["splits"]
    assert set(found) == {"shipped", "random"}
    row = found["shipped"]["scores"][0]
    assert (row["n"], row["accuracy"]) == (4, 1.0)
    assert row["low"] == pytest.approx(0.3976, abs=1e-4)  # Clopper-Pearson of 4/4: 0.025^(1/4)
    assert {"report.html", "shipped", "random"} <= {path.name for path in (bench.path / "c").iterdir()}


def test_effusivity_without_calibration_warns_and_orders_copper_above_wood(bench: Bench) -> None:
    done = bench.run("effusivity", example_path("exp3B_obj28_grip48"), "--out", "e.csv", "--json")
    assert done.code == 0, done.err
    assert "warning" in done.err
    with (bench.path / "e.csv").open() as file:
        rows = list(csv.DictReader(file))
    wanted = "grasp_id effusivity effusivity_p05 effusivity_p95 t_object t_object_p05 t_object_p95 h_c"
    assert list(rows[0]) == [*wanted.split(), "log10_effusivity_sd", "misfit_sd"]
    of = {row["grasp_id"]: float(row["effusivity"]) for row in rows}
    copper, wood = list(of.values())[:8], list(of.values())[-8:]
    assert np.median(copper) > 10 * np.median(wood)
