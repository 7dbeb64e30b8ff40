"""The default design, fields that cannot be, and the same plant in another file or process."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

from thermogrip.datasets.atomic_files import read_json
from thermogrip.datasets.errors import UserError
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.design.design import LONGEST_HORIZON, Design, check_design, default_design
from thermogrip.mpc.design.spec import Spec
from thermogrip.mpc.tuning.design_review import review
from thermogrip.mpc.tuning.objective import Search
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant


@pytest.fixture(scope="module")
def sampled() -> Plant:
    """Return the gripper with 400 samples of what it knows least."""
    plant = prior_plant(load_network("gripper"))
    middle = np.array([plant.values[name] for name in plant.free])
    samples = middle * (1 + 0.05 * np.random.default_rng(0).uniform(-1, 1, (400, middle.size)))
    return replace(plant, samples=samples)


def test_a_controller_keeps_some_draws_and_a_worker_gets_them_all(sampled, tmp_path):
    controller = Controller(sampled, default_design(sampled))
    some = read_json(controller.save(tmp_path / "c.json"), "thermogrip.controller", 1)["plant"]
    every = sampled.to_dict()
    assert (len(some["draws"]), len(every["draws"])) == (50, 400)
    assert all(row in every["draws"] for row in some["draws"])


def test_a_search_that_travels_evaluates_the_same_draws(sampled):
    spec = Spec(steps=[(28, 30)], hold_s=120.0, search_draws=1, check_draws=1)
    search = Search(sampled, spec, default_design(sampled), seed=0)
    there = pickle.loads(pickle.dumps(search))  # noqa: S301, what a process pool does
    for draw in (*search.draws, *search.unseen):
        assert there.plant.draw(draw).values == search.plant.draw(draw).values


def block(
    delay: int, lag: float, *, dt: float = 1.0, unit: str = "percent", output: str = "degC", gain: float = 0.5
) -> Plant:
    """Return one input that moves one output ``delay`` steps of ``dt`` s late, with one lag [s]."""
    n, a = delay + 1, float(np.exp(-dt / lag))
    A, B = np.diag(np.ones(n - 1), -1), np.zeros((n, 1))
    A[n - 1, n - 1], B[0, 0] = a, 1.0
    A[n - 1, n - 2], E = gain * (1 - a), np.zeros((n, 1))
    E[n - 1, 0] = 1 - a
    C = np.eye(n)[n - 1 :]
    model = StateSpaceModel(("q",), ("room",), ("t",), A=A, B=B, C=C, dt=dt, E=E)
    valid = {"q": (0.0, 100.0), "t": (0.0, 90.0)}
    units = {"q": unit, "room": "degC", "t": output}
    return Plant(model, {}, dt=dt, units=units, valid=valid, noise={"t": 0.05})


@pytest.mark.parametrize(
    ("delay", "lag", "seconds"),
    [
        (10, 200.0, 80.0),  # eight delays
        (10, 10.0, 40.0),  # no more than the delay and three lags
        (20, 300.0, 160.0),
    ],
)
def test_the_horizon_is_eight_delays_or_the_delay_and_three_lags(delay: int, lag: float, seconds: float):
    design = default_design(block(delay, lag), dt=2.0)
    # a step of 1 s resolves a delay to 1 s, so eight delays to 8 s
    assert sum(design.blocks) * 2.0 == pytest.approx(seconds, abs=8 + 2)


def test_the_horizon_has_twenty_samples_at_least_and_eighty_at_most():
    assert sum(default_design(block(5, 6.0), dt=4.0).blocks) == 20
    assert sum(default_design(block(40, 900.0), dt=1.0).blocks) == 80


def test_the_sample_time_is_a_multiple_of_the_plants_step_and_a_quarter_of_the_delay():
    assert default_design(block(10, 50.0), dt=2.4).dt == 2.0
    assert default_design(block(10, 50.0), dt=0.1).dt == 1.0
    assert default_design(block(10, 50.0, dt=2.0), dt=5.2).dt == 6.0
    assert default_design(block(20, 200.0)).dt == 5.0


@pytest.mark.parametrize(("unit", "ends"), [("percent", (0.0, 100.0)), ("0_255", (0.0, 255.0))])
def test_a_drive_may_move_an_eighth_of_its_range_a_second(unit: str, ends: tuple[float, float]):
    design = default_design(block(10, 50.0, unit=unit))
    assert design.drive_range == {"q": ends}
    assert design.slew_per_s == {"q": ends[1] / 8}


def test_what_is_no_temperature_and_what_nothing_moves_is_no_target():
    with pytest.raises(UserError, match="t is in V, and controllers here regulate temperatures"):
        default_design(block(10, 50.0, output="V"))
    with pytest.raises(UserError, match="the plant has no output u; it has t"):
        default_design(block(10, 50.0), controlled=["u"])
    with pytest.raises(UserError, match="no drive moves t"):
        default_design(block(10, 50.0, gain=0.0), dt=1.0)


LOOP = {"drive": "drive", "output": "t_surface", "Kc": 0.1, "Ti": 50.0, "Tt": 50.0, "feedforward": 0.0}


@pytest.fixture(scope="module")
def design(tank) -> dict:
    return default_design(tank, dt=2.0).to_dict()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"dt": 0}, "dt"),
        ({"dt": 2.5}, "dt is 2.5 s, no multiple of the plant's step of 1 s"),
        ({"dt": 1e9}, "longer than"),
        ({"dt": "2"}, "dt must be a finite number"),
        ({"track": True}, "track"),
        ({"price": float("nan")}, "price"),
        ({"overshoot": -0.1}, "overshoot"),
        ({"ambient": 1e6}, "ambient"),
        ({"patience_s": -1}, "patience_s"),
        ({"deadline_s": -1}, "deadline_s"),
        ({"offset_free": "no"}, "offset_free"),
        ({"blocks": [LONGEST_HORIZON + 1]}, "blocks"),
        ({"blocks": [1] * 300}, "unknowns"),
        ({"controlled": []}, "controlled"),
        ({"controlled": ["t_surface", "t_surface"]}, "twice"),
        ({"drive_range": {"drive": [-5.0, 5.0]}}, "beyond the drive's -1 to 1"),
        ({"drive_range": {"drive": [-1.0, 1.0], "fan": [0.0, 1.0]}}, "no drive fan"),
        ({"slew_per_s": {"drive": "fast"}}, "slew_per_s"),
        ({"limits": {"t_tank": [float("-inf"), 60.0]}}, "limits of t_tank"),
        ({"loops": [{**LOOP, "drive": "fan"}]}, "loops"),
        ({"loops": [{**LOOP, "output": "t_tank"}]}, "loops"),
        ({"loops": [LOOP, LOOP]}, "twice"),
        ({"loops": [{**LOOP, "Ti": 0.0}]}, "Ti"),
        ({"loops": [{**LOOP, "Kc": "much"}]}, "PI of t_surface"),
        ({"noise": {"state": -1.0}}, "noise"),
        ({"limits": {"t_tank": [40.0, 20.0]}}, "limits of t_tank"),
        ({"limits": {"t_nose": [20.0, 40.0]}}, "t_nose"),
        ({"move": 0.0}, "move"),
        ({"blocks": []}, "blocks"),
        ({"move_delay": 3}, "move_delay"),
        ({"slew_per_s": {"drive": 0.0}}, "slew_per_s"),
        ({"slew_per_s": {}}, "slew_per_s"),
    ],
)
def test_a_field_that_cannot_be_is_named(tank, design, change, says):
    with pytest.raises(UserError, match=says):
        check_design(Design.from_dict({**design, **change}), tank)


@pytest.mark.parametrize("spec", [{"steps": "abc"}, {"steps": [[1], [None]]}])
def test_a_review_of_notes_that_were_edited_is_one_line(tank, spec):
    controller = Controller(tank, default_design(tank, dt=2.0), notes={"spec": spec})
    with pytest.raises(UserError, match="steps"):
        review(controller)
