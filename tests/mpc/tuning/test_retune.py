"""A closed loop on a plant that is not the model gives a plant, and a controller, that are nearer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.mpc.estimator.test_structure_monitor import DT, kit
from thermogrip.datasets.schema import Log, make_log
from thermogrip.mpc.closed_loop.simulate import Surroundings, simulate_closed_loop
from thermogrip.mpc.controllers.mpc import Controller, design_controller
from thermogrip.mpc.design.spec import Spec
from thermogrip.mpc.tuning.retune import Retuning, RunError, retune
from thermogrip.sysid.plant.plant import Plant

SPEC = Spec(
    steps=[(25.0, 40.0)],
    evaluations=2,
    sample_time_s=DT,
    search_draws=1,
    check_draws=1,
    hold_s=240.0,
    settle_within_s=200.0,
)


def played(controller: Controller, truth: Plant) -> Log:
    """Return the log of a loop of two targets."""
    schedule = [({"t1": 45.0, "t2": 38.0}, 200.0), ({"t1": 35.0, "t2": 45.0}, 200.0)]
    run = simulate_closed_loop(controller, truth, schedule, surroundings=Surroundings(quantum=0.0), seed=4)
    drives = {name: (values, "percent", "input") for name, values in run.drive.items()}
    drives["pump"] = (np.ones(len(run.sample_time)), "1", "input")
    own = {name: (run.readings[name], "degC", "output") for name in truth.outputs}
    known = {name: drives[name] for name in truth.inputs}
    return make_log(run.sample_time, known | own, name="run")


@pytest.mark.slow
def test_a_slower_sensor_is_found_and_the_new_controller_does_better_on_it():
    old = design_controller(kit(), dt=DT)
    truth = replace(kit(), values=kit().values | {"lag_1": 32.0, "lag_2": 32.0, "power_1": 0.9})
    found = retune(old, played(old, truth), spec=SPEC)
    assert found.better
    assert found.identification.plant.values["lag_1"] == pytest.approx(32.0, rel=0.1)
    assert [error.output for error in found.errors] == ["t1", "t2"]
    assert all(error.new < 0.5 * error.old for error in found.errors)
    assert [step.draw for step in found.old] == [1]
    assert found.new[0].settle_s < found.old[0].settle_s
    assert found.tuning.controller.plant.values == found.identification.plant.values


def test_a_plant_that_was_right_is_kept(monkeypatch):
    old = design_controller(kit(), dt=DT)
    monkeypatch.setattr("thermogrip.mpc.tuning.retune.tune", None)
    found = retune(old, played(old, kit()), spec=SPEC)
    assert (found.better, found.tuning, found.old) == (False, None, ())


def test_better_is_a_tenth_less_in_the_geometric_mean_over_the_outputs():
    for new, better in ((0.4, True), (0.41, False)):
        errors = (RunError("a", "degC", 1.0, 2.0), RunError("b", "degC", 1.0, new))
        assert Retuning(None, errors, None, (), ()).better == better
