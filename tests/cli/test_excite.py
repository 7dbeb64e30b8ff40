"""excite: a plain schedule is as large as the plant's temperatures allow, and says how large that is."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.cli.conftest import Bench
from tests.end_to_end.conftest import small_plant
from thermogrip.datasets.log_files import read_log
from thermogrip.datasets.schema import Log, make_log
from thermogrip.sysid.plant.plant import Plant


def highest_of(plant: Plant, schedule: Log, share: float = 1.0) -> float:
    """Return the highest simulated output from rest at 25 degC, the drives at so much of the schedule."""
    moved = schedule.copy(deep=True)
    for name in plant.inputs:
        if name not in plant.model.switches:
            moved[name].values[:] *= share
    signals = {name: (moved[name].values, plant.units[name], "input") for name in plant.inputs}
    rest = {name: (np.full(moved.sizes["time"], 25.0), "degC", "other") for name in plant.disturbances}
    outputs = {name: (np.full(moved.sizes["time"], 25.0), "degC", "output") for name in plant.outputs}
    log = make_log(moved["time"].values, signals | rest | outputs)
    simulated = plant.simulate(log)
    return max(float(simulated[name].max()) for name in plant.outputs)


@pytest.mark.parametrize("highest", [40, 60])
def test_a_schedule_is_as_large_as_the_highest_temperature_allows(highest: int, bench: Bench) -> None:
    words = f"excite --kind staircase --minutes 30 --plant plant.json --lowest -40 --highest {highest}"
    done = bench.run(*words.split(), "--out", "s.csv")
    schedule = read_log(bench.path / "s.csv", inputs=["drive", "pump"], outputs=[])
    assert highest_of(small_plant(), schedule) <= highest < highest_of(small_plant(), schedule, 1.05)
    assert set(schedule["pump"].values) == {1.0}
    share = float(np.abs(schedule["drive"].values).max())  # a drive of both signs swings about zero
    said = f"{100 * share:.0f} % of the drive's range keeps the outputs from -40 to {highest} degC"
    assert said in done.out
    assert done.out.endswith(f"wrote s.csv: {schedule.sizes['time']} rows\n")
    answer = json.loads(bench.run(*words.split(), "--out", "s.csv", "--json").out)
    assert answer.pop("share") == pytest.approx(share, abs=1e-3)
    assert answer == {"kind": "staircase", "rows": schedule.sizes["time"], "out": "s.csv"}


def test_each_heater_moves_by_itself_about_half_of_its_share(bench: Bench) -> None:
    words = "excite --kind prbs --minutes 20 --network tclab --highest 60 --seed 3 --out s.csv"
    answer = json.loads(bench.run(*words.split(), "--json").out)
    schedule = read_log(bench.path / "s.csv", inputs=["q1", "q2"], outputs=[])
    for name in ("q1", "q2"):
        drive = schedule[name].values
        assert (drive.min(), drive.max()) == pytest.approx((0.0, 100 * answer["share"]), abs=1e-3)
    assert abs(np.corrcoef(schedule["q1"], schedule["q2"])[0, 1]) < 0.5
    written = Path("s.csv").read_text()
    bench.run(*words.split())
    assert Path("s.csv").read_text() == written
    bench.run(*words.replace("--seed 3", "--seed 4").split())
    assert Path("s.csv").read_text() != written


def test_without_a_plant_a_schedule_has_the_whole_range(bench: Bench) -> None:
    done = bench.run("excite", "--kind", "prbs", "--minutes", "5", "--out", "s.csv", "--json")
    schedule = read_log(bench.path / "s.csv", inputs=["drive", "pump"], outputs=[])
    assert json.loads(done.out)["share"] == 1.0
    assert (schedule["drive"].min(), schedule["drive"].max()) == (-1.0, 1.0)
