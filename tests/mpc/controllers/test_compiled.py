"""The step in C beside the step in Python: the same drives, statuses and words, whatever is read."""

from __future__ import annotations

import numpy as np
import pytest

from tests.mpc.makers import GCC, crossed, make_tank, network_plant
from thermogrip.mpc.closed_loop.simulate import Surroundings, Truth
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.reference import ReferenceController
from thermogrip.mpc.design.design import default_design

pytestmark = GCC
NAN = float("nan")


def tank():
    return make_tank(joule=0.05)


def board():
    return network_plant("tclab", t1=(20.0, 60.0), t2=(20.0, 60.0))


ZONES = {"zones": {"t1": 1.0, "t2": 1.5}, "energy_price": {"q1": 1.0, "q2": 0.5}}
#: A plant, and what of its design is another than by default.
CASES = {
    "a tank whose cooling turns over": (tank, {"dt": 2.0}),
    "its limit, and programs to convergence": (tank, {"limits": {"t_tank": (8.0, 45.0)}, "iterations": 5}),
    "both outputs by one drive": (make_tank, {"dt": 2.0, "controlled": ("t_tank", "t_surface")}),
    "a drive without a loop": (make_tank, {"dt": 2.0, "loops": (), "safe_drive": {"drive": 0.1}}),
    "two heaters": (board, {"dt": 5.0, "weights": {"t2": 9.0}}),
    "zones and prices": (board, {"dt": 5.0} | ZONES),
    "ramps": (board, {"dt": 5.0, "ramp_per_s": {"t1": 0.04}}),
    "a hard limit": (board, {"dt": 5.0, "limits": {"t2": (20.0, 38.0)}, "hard": ("t2",)}),
    "outputs that cross": (crossed, {"controlled": ("b", "a"), "blocks": (1, 2, 3, 6)}),
}


def spoilt(reading: dict[str, float], outputs, rng: np.random.Generator) -> dict[str, float]:
    """Return a reading in which now and then something is lost, absurd, or jumps."""
    found = dict(reading)
    for name in outputs:
        chance = rng.random()
        if chance < 0.04:
            found[name] = rng.choice([NAN, 900.0, -300.0])
        elif chance < 0.06:
            found[name] += rng.choice([-12.0, 12.0])
    if rng.random() < 0.05:
        del found[str(rng.choice(list(found)))]
    return found


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize("case", CASES)
def test_a_random_loop_is_answered_alike(case, seed):
    """Targets move, ramp or lead through a trajectory, readings are lost and late; C's moves are applied."""
    make, changes = CASES[case]
    plant, rng = make(), np.random.default_rng(seed)
    design = default_design(plant, deadline_s=1e9, patience_s=12.0, **changes)
    python, c = ReferenceController(plant, design), Controller(plant, design)
    model, truth = (
        python.model,
        Truth(plant, design.dt, Surroundings(offset={plant.outputs[0]: 0.3}), 28.0, seed),
    )
    first, said = truth.reading(), set()
    for controller in (python, c):
        controller.reset(first)
    now, target, applied, gone = 0.0, 32.0, {}, range(0)
    for k in range(120):
        if rng.random() < 0.08:
            target = float(rng.choice([24.0, 30.0, 36.0, 42.0, 70.0]))
        asked = dict.fromkeys(design.controlled, target) if k % 3 else target
        if rng.random() < 0.1:
            asked = {name: [target, target + 1.0, NAN, target + 2.0] for name in design.controlled}
        elif rng.random() < 0.05:
            asked = rng.choice([NAN, 1e9])
        elif rng.random() < 0.03:
            asked = {**dict.fromkeys(design.controlled, target), "nobody": 1.0}
        reading = spoilt(truth.reading(), plant.outputs, rng) | {"time_s": now}
        if k in (40, 80):
            gone = range(k, k + int(rng.integers(3, 12)))  # for some time one sensor is not there
        if k in gone:
            reading[design.controlled[-1]] = NAN
        if rng.random() < 0.03 and plant.model.switches:
            reading["pump"] = 0.0
        one, two = (each.step(reading | applied, asked) for each in (python, c))
        assert (two.status, two.advice, two.pump) == (one.status, one.advice, one.pump), (k, reading)
        np.testing.assert_allclose(
            two.drives(model.drives), one.drives(model.drives), atol=1e-6 * model.span[0]
        )
        said.add(two.status)
        applied = dict(zip(model.drives, two.drives(model.drives)))
        truth.apply(two)
        now += design.dt * float(
            rng.choice([1.0, 0.5, 1.0, 1.7, 0.0, 20.0], p=[0.6, 0.15, 0.1, 0.08, 0.05, 0.02])
        )
    assert {"ok", "infeasible", "fallback_plan"} <= said


def test_the_plan_is_that_of_python_a_sample_at_a_time():
    plant = tank()
    design = default_design(plant, dt=2.0, deadline_s=1e9)
    python, c = ReferenceController(plant, design), Controller(plant, design)
    reading = {"t_tank": 25.0, "t_surface": 25.0, "t_ambient": 25.0}
    for controller in (python, c):
        controller.reset(reading)
        assert controller.plan is None
        controller.step(reading, 33.0)
        controller.step({**reading, "t_surface": NAN}, 33.0)  # the plan of the sample before goes on
    assert c.plan.shape == (sum(design.blocks), 1)
    np.testing.assert_allclose(c.plan, python.plan, atol=1e-9)


def test_a_step_in_c_is_late_by_its_own_clock():
    controller = Controller(tank(), default_design(tank(), deadline_s=0.0))
    reading = {"t_tank": 25.0, "t_surface": 25.0, "t_ambient": 25.0}
    controller.reset(reading)
    move = controller.step(reading, 33.0)
    assert (move.status, move.advice) == ("late", "the step took longer than its deadline")


def test_numbers_of_any_kind_are_read_and_what_is_none_is_lost():
    controller = Controller(tank(), default_design(tank()))
    reading = {"t_tank": np.float32(25.0), "t_surface": "25", "t_ambient": np.array(25.0)}
    controller.reset(reading)
    assert controller.step(reading, np.float32(30.0)).advice == ""
    lost = controller.step(reading | {"t_tank": None, "t_ambient": [25.0, 26.0]}, 30)
    assert lost.advice == "t_tank, t_ambient: no usable reading"
