"""The review: a sound design passes, and each planted fault is found by the check that is there for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.mpc.makers import network_plant
from thermogrip.mpc.controllers.mpc import Controller, design_controller
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.design.simc import PILoop
from thermogrip.mpc.estimator.observer import ObserverNoise
from thermogrip.mpc.tuning import design_review as checks
from thermogrip.mpc.tuning.design_review import review, worst
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant


def verdicts(controller, **options) -> dict[str, str]:
    return {check.name: check.verdict for check in review(controller, **{"draws": 0} | options)}


@pytest.fixture(scope="module")
def sound(tank):
    return review(design_controller(tank, dt=2.0), wanted=(18.0, 43.0))


def test_a_sound_design_passes_every_check(sound):
    assert {check.verdict for check in sound} == {"pass"}
    assert worst(sound) == "pass"
    assert len(sound) >= 10


def test_every_finding_has_a_number_and_every_fault_a_fix(sound, reversing_tank):
    faulty = review(design_controller(reversing_tank, dt=2.0), wanted=(2.0, 43.0))
    for check in (*sound, *faulty):
        assert check.verdict == "pass" or check.fix
        assert any(char.isdigit() for char in check.finding) or check.finding == "no limits of outputs"


SIGN, DETECTABLE = "gain keeps its sign over the drive", "disturbances are detectable"
LIMITS, ROOM = "soft limits agree with the targets", "hard limits leave room"
HELD, LOGS = "targets can be held in steady state", "targets lie where the logs were"
FORGETS, STAND_IN = "observer forgets its errors", "a PI controller takes over"
DEADLINE, PELTIER = "step time fits the sample time", "current stays below the Peltier optimum"


@pytest.mark.parametrize(
    ("name", "verdict", "plant", "changes", "wanted"),
    [
        (SIGN, "warn", "reversing_tank", {}, None),
        (SIGN, "pass", "reversing_tank", {"drive_range": {"drive": (-0.5, 1.0)}}, None),
        (HELD, "fail", "reversing_tank", {}, (-5.0, 30.0)),
        (DETECTABLE, "fail", "tank", {"offset_free": False}, None),
        (LIMITS, "fail", "tank", {"limits": {"t_tank": (10.0, 30.0)}}, (18.0, 43.0)),
        (ROOM, "fail", "tank", {"drive_range": {"drive": (0.1, 1.0)}}, None),  # the drive cannot be zero
        (ROOM, "warn", "tank", {"slew_per_s": {"drive": 1e-4}}, None),
        (LOGS, "warn", "tank", {}, (18.0, 60.0)),
        (DEADLINE, "fail", "tank", {"deadline_s": 1e-7}, None),
        (PELTIER, "pass", "tank", {}, None),  # it has none
        ("horizon covers delay and lag", "fail", "tank", {"blocks": (1, 1, 1, 1)}, None),
        (FORGETS, "warn", "tank", {"noise": ObserverNoise(drive=1e-9, output=1e-9)}, None),
        (STAND_IN, "warn", "tank", {"loops": ()}, None),
        (STAND_IN, "fail", "tank", {"loops": (PILoop("drive", "t_surface", -0.1, 50.0, 50.0),)}, None),
    ],
)
def test_a_planted_fault_is_found_by_its_check(request, name, verdict, plant, changes, wanted):
    controller = design_controller(request.getfixturevalue(plant), dt=2.0, **changes)
    assert verdicts(controller, wanted=wanted)[name] == verdict


@pytest.mark.parametrize(
    ("own", "verdict"),
    [(0.9999, "pass"), (0.9, "warn"), (0.99995, "warn"), (1.0, "warn")],
    ids=["the plant's own", "made by the loop", "made slower or faster by half", "of an integrator"],
)
def test_a_slow_eigenvalue_is_the_loops_fault_unless_the_plant_has_it_by_itself(own: float, verdict: str):
    from types import SimpleNamespace

    quick = SimpleNamespace(matrix=np.diag([0.5, 0.9]), A=np.diag([0.8, 0.9]))
    slow = SimpleNamespace(matrix=np.diag([0.5, 0.9999]), A=np.diag([0.8, own]))
    check = checks.eigenvalues([quick, slow])
    assert check.verdict == verdict
    assert ("as without the loop" in check.finding) == (verdict == "pass")


def test_a_target_beyond_the_logs_is_reported_before_a_run(tank):
    from thermogrip.mpc.tuning.design_review import beyond_logs

    controller = design_controller(tank, dt=2.0)
    assert beyond_logs(controller, 43.0) == []
    (said,) = beyond_logs(controller, {"t_surface": 60.0})
    assert "t_surface was 8.0 to 52.0 degC" in said


@pytest.mark.parametrize(
    ("target", "inside"), [(7.5, True), (7.4, False), (52.5, True), (52.6, False), (30.0, True)]
)
def test_half_a_degree_beyond_the_logs_is_forgiven_on_either_side(tank, target: float, inside: bool):
    controller = design_controller(tank, dt=2.0)
    assert (checks.beyond_logs(controller, target) == []) == inside
    for span in ((target, 30.0), (30.0, target)):
        check = checks.valid_range(controller, span)
        assert check.verdict == ("pass" if inside else "warn")
        assert check.finding.endswith("beyond: " + f"{target:g} degC") != inside


@pytest.mark.parametrize(
    ("limits", "target", "verdict"),
    [((20.0, 40.0), 30.0, "pass"), ((31.0, 40.0), 30.0, "fail"), ((20.0, 29.0), 30.0, "fail")],
)
def test_a_limit_on_either_side_of_what_a_target_takes_is_a_conflict(
    tank, limits, target: float, verdict: str
):
    controller = design_controller(tank, dt=2.0, limits={"t_tank": limits})
    assert checks.limits(controller, (target, target)).verdict == verdict


def test_a_grasp_by_a_plant_whose_pump_never_stood_is_reported_before_it(tank):
    from thermogrip.mpc.tuning.design_review import beyond_logs

    controller = design_controller(replace(tank, valid={**tank.valid, "pump": (1.0, 1.0)}), dt=2.0)
    assert beyond_logs(controller, 43.0) == []
    (said,) = beyond_logs(controller, 43.0, grasps=True)
    assert "the pump never stood" in said
    assert beyond_logs(design_controller(tank, dt=2.0), 43.0, grasps=True) == []


@pytest.fixture(scope="module")
def gripper() -> Plant:
    return network_plant("gripper")


def test_a_current_beyond_the_optimum_of_the_peltier_warns_with_the_range_to_take(gripper):
    from thermogrip.mpc.tuning.design_review import peltier_optimum

    def at(resistance: float):
        plant = replace(gripper, values=gripper.values | {"resistance": resistance})
        return peltier_optimum(design_controller(plant), (18.0, 43.0), draws=0)

    # I* = S Tc / R = 0.083 * 291.15 / R; full drive is 4 A
    assert at(3.75).verdict == "pass"
    assert f"I* at {-0.083 * 291.15 / 3.75 / 4:.2f} of drive" in at(3.75).finding
    assert at(5.9).verdict == "warn"
    beyond = at(7.5)
    assert beyond.verdict == "warn"
    assert beyond.fix == f"set drive_limits: drive = [{-0.8 * 0.083 * 291.15 / 7.5 / 4:.2f}, ...]"


def test_an_offset_stays_without_disturbance_states(tank):
    name = "no offset is left in steady state"
    assert verdicts(design_controller(tank, dt=2.0, offset_free=False))[name] == "fail"
    finding = {c.name: c.finding for c in review(design_controller(tank, dt=2.0))}[name]
    assert "0.0000 degC is left" in finding


def test_a_drive_that_moves_nothing_fails_and_one_that_hardly_does_warns(tank_maker):
    name = "variables are well scaled"
    assert verdicts(design_controller(tank_maker(heat=1e-7), dt=2.0), wanted=(25, 25.001))[name] == "fail"
    assert verdicts(design_controller(tank_maker(heat=1e-3), dt=2.0), wanted=(25, 25.5))[name] == "warn"


def test_a_weight_that_does_nothing_is_named(tank):
    name = "every weight does something"
    checks = {c.name: c for c in review(design_controller(tank, dt=2.0, terminal=1e-6))}
    assert checks[name].verdict == "warn"
    assert "terminal" in checks[name].fix
    alone = design_controller(tank, dt=2.0, blocks=(30,), move=1e-12, terminal=0.0)
    assert verdicts(alone)[name] == "fail"


def test_a_program_that_runs_into_its_limit_of_iterations_fails(tank):
    from thermogrip.mpc.tuning.design_review import _iterations

    controller = design_controller(tank, dt=2.0)
    found = [_iterations(controller, [3, worst]).verdict for worst in (20, 200, 500)]
    assert found == ["pass", "warn", "fail"]


def test_a_gain_that_is_wrong_by_its_sign_makes_the_loop_unstable(tank):
    controller = design_controller(tank, dt=2.0)
    loop = checks.loops_of(controller, 0)[0]
    assert checks.eigenvalues([loop]).verdict == "pass"
    loop = checks.loops_of(controller, 0)[0]
    loop.B = -loop.B
    assert checks.eigenvalues([loop]).verdict == "fail"


def adder(**changes) -> Controller:
    """A store without losses: a heater of 0.05 degC per sample, through a filter; it stays wherever it is."""
    A, B = [[1.0, 0.05], [0.0, 0.9]], [[0.0], [1.0]]
    model = StateSpaceModel(("q",), (), ("t",), A=A, B=B, C=[[1.0, 0.0]], dt=1.0, y0=[25.0])
    plant = Plant(model, {}, dt=1.0, units={"q": "1"}, valid={"q": (-1.0, 1.0), "t": (20.0, 60.0)})
    return Controller(plant, default_design(plant, **changes))


def test_an_integrator_holds_any_target_with_no_drive():
    checks = {check.name: check for check in review(adder(limits={"t": (15.0, 65.0)}))}
    assert "fail" not in {check.verdict for check in checks.values()}
    assert checks["targets can be held in steady state"].verdict == "pass"
    assert checks["soft limits agree with the targets"].verdict == "pass"
    assert checks["gain keeps its sign over the drive"].verdict == "warn"


def test_where_a_step_starts_need_not_be_a_target():
    controller = adder()
    controller.notes["spec"] = {"steps": [[90.0, 30.0], [30.0, 50.0]]}
    found = {check.name: check for check in review(controller)}
    assert found["targets lie where the logs were"].verdict == "pass"
    assert found["targets can be held in steady state"].finding.startswith("30 to 50 degC")
