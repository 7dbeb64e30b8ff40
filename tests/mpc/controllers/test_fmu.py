"""A controller as an FMU: run by another program beside a plant's, it does what it does in Python."""

from __future__ import annotations

import numpy as np
import pytest

from tests.mpc.makers import kit
from thermogrip.datasets.errors import UserError
from thermogrip.mpc.controllers.fmu import Core
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.interface import STATUSES

OUTPUTS = ("q1", "q2", "pump", "status")


def test_a_controllers_fmu_run_by_fmpy_answers_as_the_controller(tmp_path):
    fmpy = pytest.importorskip("fmpy")
    controller = kit()
    path = controller.to_fmu(tmp_path / "loop.fmu")
    described = {v.name: v for v in fmpy.read_model_description(str(path)).modelVariables}
    causes = {name: v.causality for name, v in described.items()}
    given = ["t1", "t2", *controller.model.disturbances, "target_t1", "target_t2"]
    assert causes == dict.fromkeys(given, "input") | dict.fromkeys(OUTPUTS, "output")
    assert (described["t1"].unit, described["q1"].unit) == ("degC", "percent")
    rng, n = np.random.default_rng(4), 40
    rows = {"t1": 25 + np.cumsum(0.2 * rng.random(n)), "t2": 25 + np.cumsum(0.1 * rng.random(n))}
    rows |= {"target_t1": np.where(np.arange(n) < 20, 40.0, 32.0), "target_t2": np.full(n, 30.0)}
    rows["t1"][30] = 1e4  # a broken wire
    types = [("time", float), *((name, float) for name in rows)]
    signals = np.array([(5.0 * k, *(values[k] for values in rows.values())) for k in range(n)], dtype=types)
    run = fmpy.simulate_fmu(
        str(path), stop_time=5.0 * n, step_size=5.0, output_interval=5.0, input=signals, output=list(OUTPUTS)
    )
    twin = Controller.load(controller.save(tmp_path / "loop.json"))
    twin.reset({"t1": rows["t1"][0], "t2": rows["t2"][0]})
    statuses = []
    for k in range(n):
        targets = {name: rows[f"target_{name}"][k] for name in ("t1", "t2")}
        move = twin.step({"time_s": 5.0 * k, "t1": rows["t1"][k], "t2": rows["t2"][k]}, targets)
        statuses.append(move.status)
        ours = [move.drive["q1"], move.drive["q2"], move.pump, STATUSES.index(move.status)]
        assert [run[name][k + 1] for name in OUTPUTS] == pytest.approx(ours, abs=1e-9)
    assert len(set(statuses)) > 1
    assert np.ptp(run["q1"]) > 20


def test_within_a_sample_the_core_holds_its_move_and_an_unknown_name_is_none():
    core = Core(kit())
    core.set("target_t1", 40.0)
    core.begin()
    seen = []
    for k in range(11):
        core.set("t1", 25.0 + 0.3 * k)
        assert core.advance(1.0)
        seen.append(core.get("q1"))
    assert seen[0] == seen[4] > 0
    assert seen[5] != seen[4]
    assert seen[5] == seen[9]
    with pytest.raises(KeyError):
        core.set("q1", 3.0)


def test_an_fmu_of_a_controller_wants_a_name_that_is_an_identifier(tmp_path):
    with pytest.raises(UserError, match="cannot name an FMU"):
        kit().to_fmu(tmp_path / "my loop.fmu")
