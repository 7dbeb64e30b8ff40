"""The review: a sound design passes, and each planted fault is found by the check that is there for it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.mpc.makers import crossed, heater, network_plant
from thermogrip.datasets.limits import LARGEST
from thermogrip.mpc.controllers.mpc import Controller, design_controller
from thermogrip.mpc.design.design import PILoop, default_design
from thermogrip.mpc.design.spec import Asked
from thermogrip.mpc.estimator.observer import ObserverNoise
from thermogrip.mpc.plant.prediction import PredictionModel
from thermogrip.mpc.tuning import design_review as checks
from thermogrip.mpc.tuning.design_review import Check, review, worst
from thermogrip.mpc.tuning.objective import StepResult, apparent_delay
from thermogrip.report.classification import review_section
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

NAN = float("nan")


@pytest.fixture(scope="module")
def sound(tank):
    return review(design_controller(tank, dt=2.0, move=1000.0), wanted=(18.0, 43.0))


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
HORIZON, OFFSET = "horizon covers delay and lag", "no offset is left in steady state"
WEIGHTS = "every weight does something"


def one_check(name: str, controller: Controller, wanted: tuple[float, float] = (8.0, 52.0)) -> Check:
    """Return one check of a review, made alone."""
    rooms = (controller.design.ambient - 7.0, controller.design.ambient + 5.0)
    made = {
        SIGN: lambda: [checks.gain_sign(controller)],
        HELD: lambda: [checks.reachable(controller, wanted, rooms)],
        DETECTABLE: lambda: [checks.detectable(controller)],
        LIMITS: lambda: [checks.limits(controller, wanted)],
        ROOM: lambda: [checks.room_to_move(controller)],
        LOGS: lambda: [checks.valid_range(controller, wanted)],
        DEADLINE: lambda: checks._effort(controller, wanted),
        PELTIER: lambda: [checks.peltier_optimum(controller, wanted, 0)],
        HORIZON: lambda: [checks.horizon(controller)],
        FORGETS: lambda: [checks.observer_stable(controller, checks.loops_of(controller, 0)[0], wanted)],
        STAND_IN: lambda: [checks._stand_in(controller)],
        OFFSET: lambda: [checks.offset_free(checks.loops_of(controller, 0))],
        WEIGHTS: lambda: [checks.weights(controller)],
    }
    (found,) = (check for check in made[name]() if check.name == name)
    return found


@pytest.mark.parametrize(
    ("name", "verdict", "plant", "changes", "wanted"),
    [
        (SIGN, "warn", "reversing_tank", {}, (8.0, 52.0)),
        (SIGN, "pass", "reversing_tank", {"drive_range": {"drive": (-0.5, 1.0)}}, (8.0, 52.0)),
        (HELD, "fail", "reversing_tank", {}, (-5.0, 30.0)),
        (DETECTABLE, "fail", "tank", {"offset_free": False}, (8.0, 52.0)),
        (LIMITS, "fail", "tank", {"limits": {"t_tank": (10.0, 30.0)}}, (18.0, 43.0)),
        (
            ROOM,
            "fail",
            "tank",
            {"drive_range": {"drive": (0.1, 1.0)}},
            (8.0, 52.0),
        ),  # the drive cannot be zero
        (ROOM, "warn", "tank", {"slew_per_s": {"drive": 1e-4}}, (8.0, 52.0)),
        (LOGS, "warn", "tank", {}, (18.0, 60.0)),
        (DEADLINE, "fail", "tank", {"deadline_s": 1e-7}, (8.0, 52.0)),
        (PELTIER, "pass", "tank", {}, (8.0, 52.0)),  # it has none
        (HORIZON, "fail", "tank", {"blocks": (1, 1, 1, 1)}, (8.0, 52.0)),
        (FORGETS, "warn", "tank", {"noise": ObserverNoise(drive={"drive": 1e-9}, output=1e-9)}, (8.0, 52.0)),
        (STAND_IN, "warn", "tank", {"loops": ()}, (8.0, 52.0)),
        (STAND_IN, "fail", "tank", {"loops": (PILoop("drive", "t_surface", -0.1, 50.0, 50.0),)}, (8.0, 52.0)),
    ],
)
def test_a_planted_fault_is_found_by_its_check(request, name, verdict, plant, changes, wanted):
    controller = design_controller(request.getfixturevalue(plant), dt=2.0, **changes)
    assert one_check(name, controller, wanted).verdict == verdict


@pytest.mark.parametrize(
    ("own", "verdict"),
    [(0.9999, "pass"), (0.9, "warn"), (0.99995, "warn"), (1.0, "warn")],
    ids=["the plant's own", "made by the loop", "made slower or faster by half", "of an integrator"],
)
def test_a_slow_eigenvalue_is_the_loops_fault_unless_the_plant_has_it_by_itself(own: float, verdict: str):
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
        assert check.finding.endswith(f"beyond: t_surface at {target:g} degC") != inside


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
    beyond = at(7.5)
    assert beyond.verdict == "warn"
    assert beyond.fix == f"set drive_limits: drive = [{-0.8 * 0.083 * 291.15 / 7.5 / 4:.2f}, ...]"


def test_an_offset_stays_without_disturbance_states(tank):
    assert one_check(OFFSET, design_controller(tank, dt=2.0, offset_free=False)).verdict == "fail"
    assert "0.0000 degC is left" in one_check(OFFSET, design_controller(tank, dt=2.0)).finding


def test_a_drive_that_moves_nothing_fails_and_one_that_hardly_does_warns(tank_maker):
    for heat, verdict in ((1e-7, "fail"), (1e-3, "warn")):
        assert checks.scaling(design_controller(tank_maker(heat=heat), dt=2.0)).verdict == verdict


def test_a_weight_that_does_nothing_is_named(tank):
    check = one_check(WEIGHTS, design_controller(tank, dt=2.0, terminal=1e-6))
    assert check.verdict == "warn"
    assert "terminal" in check.fix
    alone = design_controller(tank, dt=2.0, blocks=(30,), move=1e-12, terminal=0.0)
    assert one_check(WEIGHTS, alone).verdict == "fail"


def test_a_program_that_runs_into_its_limit_of_iterations_fails(tank):
    from thermogrip.mpc.tuning.design_review import _iterations

    controller = design_controller(tank, dt=2.0)
    found = [_iterations(controller, [3, worst]).verdict for worst in (20, 200, 500)]
    assert found == ["pass", "warn", "fail"]


def test_a_gain_that_is_wrong_by_its_sign_makes_the_loop_unstable(tank):
    controller = design_controller(tank, dt=2.0)
    loop = checks.loops_of(controller, 0)[0]
    assert checks.eigenvalues([loop]).verdict == "pass"
    assert checks.eigenvalues([replace(loop, B=-loop.B)]).verdict == "fail"


def adder(**changes) -> Controller:
    """A store without losses: a heater of 0.05 degC per sample, through a filter; it stays wherever it is."""
    A, B = [[1.0, 0.05], [0.0, 0.9]], [[0.0], [1.0]]
    model = StateSpaceModel(("q",), (), ("t",), A=A, B=B, C=[[1.0, 0.0]], dt=1.0, y0=[25.0])
    plant = Plant(model, {}, dt=1.0, units={"q": "1"}, valid={"q": (-1.0, 1.0), "t": (20.0, 60.0)})
    return Controller(plant, default_design(plant, **changes))


def test_an_integrator_holds_any_target_with_no_drive_wherever_a_step_starts():
    controller = adder(limits={"t": (15.0, 65.0)})
    controller.notes["spec"] = {"steps": [[90.0, 30.0], [30.0, 50.0]]}
    checks = {check.name: check for check in review(controller)}
    assert "fail" not in {check.verdict for check in checks.values()}
    assert checks["targets lie where the logs were"].verdict == "pass"
    assert checks["targets can be held in steady state"].finding.startswith("30 to 50 degC")
    assert checks["soft limits agree with the targets"].verdict == "pass"
    assert checks["gain keeps its sign over the drive"].verdict == "warn"


@pytest.mark.parametrize(
    ("ends", "words"),
    [((15.0, 65.0), "15 to 65"), ((-LARGEST, 65.0), "at most 65"), ((15.0, LARGEST), "at least 15")],
)
def test_a_limit_that_is_open_at_one_end_is_written_as_the_other(ends: tuple[float, float], words: str):
    assert one_check(LIMITS, adder(limits={"t": ends}), (20.0, 60.0)).finding == f"t {words} degC"


def stub(**design) -> Any:
    """Return as much of a controller as a check asks for: two drives, one output."""
    usual = {"controlled": ("t",), "dt": 2.0, "horizon_s": 40.0, "blocks": (1, 3), "slew_per_s": {"q": 0.1}}
    usual |= {"drive_range": {"q": (-1.0, 3.0)}, "limits": {}, "ambient": 22.0}
    model = SimpleNamespace(drives=("p", "q"), n_u=2, n_d=1, outputs=("t",), span=np.array([1.0, 4.0]))
    model.disturbances, model.rooms = ("t_room",), np.array([True])
    model.undisturbed = lambda ambient: np.array([ambient])
    vars(model).update(model=None, on_off=(), lowest=np.array([0.0, -1.0]), highest=np.array([1.0, 3.0]))
    return SimpleNamespace(
        design=SimpleNamespace(**usual | design), model=model, plant=None, dt=2.0, notes={}
    )


@pytest.mark.parametrize(
    ("delay", "lag", "seconds", "verdict", "wanted"),
    [
        (10.0, 100.0, 40.0, "pass", "wanted 40 s: four delays (delay 10 s, lag 100 s)"),
        (10.0, 100.0, 39.9, "warn", "wanted 40 s: four delays"),
        (10.0, 100.0, 20.0, "warn", "horizon 20 s, wanted 40 s"),
        (10.0, 100.0, 19.9, "fail", "wanted 40 s"),
        (10.0, 12.0, 22.0, "pass", "wanted 22 s: delay and lag (delay 10 s, lag 12 s)"),
        (10.0, 12.0, 21.9, "warn", "wanted 22 s: delay and lag"),
    ],
)
def test_a_horizon_sees_four_delays_or_the_delay_and_the_lag_of_the_strongest_drive(
    monkeypatch, delay, lag, seconds, verdict, wanted
):
    weak = SimpleNamespace(gain=3.0, delay=100.0, lag=900.0)
    strong = SimpleNamespace(gain=-5.0, delay=delay, lag=lag)
    monkeypatch.setattr(
        checks, "step_response", lambda plant, drive, output: weak if drive == "p" else strong
    )
    check = checks.horizon(stub(horizon_s=seconds))
    assert (check.verdict, wanted in check.finding, bool(check.fix)) == (verdict, True, verdict != "pass")


@pytest.mark.parametrize(
    ("ends", "slew", "verdict", "share"),
    [
        ((-1.0, 3.0), 0.004, "pass", "-1 to 3, 0.2 % of it a sample"),
        ((-1.0, 3.0), 0.0039, "warn", "0.2 %"),
        ((0.0, 4.0), 0.1, "pass", "5.0 %"),
        ((-4.0, 0.0), 0.1, "pass", "5.0 %"),
        ((-4.0, -0.1), 0.1, "fail", "5.1 %"),
        ((0.1, 4.0), 1e-4, "fail", "0.0 %"),
    ],
)
def test_a_range_contains_0_and_is_crossed_within_500_samples(ends, slew, verdict, share):
    check = checks.room_to_move(stub(drive_range={"q": ends}, slew_per_s={"q": slew}))
    assert (check.verdict, share in check.finding) == (verdict, True)
    assert ("500 samples" in check.fix, "contain 0" in check.fix) == (verdict == "warn", verdict == "fail")


@pytest.mark.parametrize(
    ("values", "verdict"),
    [((2.0, 1.9e8), "pass"), ((2.0, 2.1e8), "warn"), ((2.0, 1.9e12), "warn"), ((2.0, 2.1e12), "fail"),
     ((0.0, 1.0), "fail"), ((-1.0, 1.0), "fail")],
)  # fmt: skip
def test_a_condition_of_eight_digits_warns_and_one_of_twelve_fails(monkeypatch, values, verdict):
    monkeypatch.setattr(checks, "linear_move", lambda controller: (np.diag([*values, 5.0]), None, None))
    check = checks.hessian(stub())
    assert (check.verdict, "3 unknowns" in check.finding) == (verdict, True)
    if values[0] > 0:
        assert f"condition {values[1] / values[0]:.1e}" in check.finding


@pytest.mark.parametrize(
    ("weak", "strong", "verdict"),
    [(0.05, 1.0, "pass"), (0.049, 1.0, "warn"), (1.1e-4, 1.0, "warn"), (0.9e-4, 0.9, "fail"),
     (9.0, 2700.0, "pass"), (8.9, 2700.0, "warn"), (12.0, 3001.0, "warn"), (0.9, 1e4, "fail")],
)  # fmt: skip
def test_gains_are_means_over_the_horizon_and_comparable(weak, strong, verdict):
    controller = stub()  # four samples; the largest response of two blocks counts, whatever its sign
    controller.optimiser = SimpleNamespace(at_rest=4 * np.array([[0.5 * weak, -strong], [weak, 0.1]]))
    check = checks.scaling(controller)
    assert (check.verdict, f"by p {weak:.3g} degC, q {strong:.3g} degC" in check.finding) == (verdict, True)


@pytest.mark.parametrize(
    ("most", "verdict"), [(125, "pass"), (126, "warn"), (499, "warn"), (500, "fail"), (501, "fail")]
)
def test_iterations_near_their_limit_are_counted_with_their_rows(most, verdict):
    controller = stub()
    controller.optimiser = SimpleNamespace(n_b=3, qp=SimpleNamespace(soft=np.zeros(17)))
    check = checks._iterations(controller, [3, most, 2])
    assert check.verdict == verdict
    assert check.finding == f"12 hard and 5 soft rows; at most {most} iterations of 500 allowed"


@pytest.mark.parametrize(
    ("size", "verdict", "seconds"),
    [(0.5, "pass", "3 s"), (np.exp(-2 / 3599), "pass", "3599 s"), (np.exp(-2 / 3602), "warn", "3602 s"),
     (1.0, "fail", "inf s"), (1.2, "fail", "inf s")],
)  # fmt: skip
def test_an_observer_forgets_within_an_hour(size, verdict, seconds):
    law = SimpleNamespace(forgets=np.array([[0.1, 2.0], [0.0, -size]]))
    check = checks.observer_stable(stub(), SimpleNamespace(law=law), (20.0, 30.0))
    assert (check.verdict, f"to a third in {seconds}" in check.finding) == (verdict, True)


@pytest.mark.parametrize(("left", "verdict"), [(0.0499, "pass"), (0.05, "fail"), (np.nan, "fail")])
def test_a_twentieth_of_an_offset_may_be_left_on_the_worst_draw(left, verdict):
    loops = [SimpleNamespace(left_of_offset=lambda value=value: value) for value in (0.0, left, 0.01)]
    check = checks.offset_free(loops if np.isfinite(left) else loops[1:])
    assert (check.verdict, check.finding.endswith(f"plant and {2 - np.isnan(left)} draws")) == (verdict, True)


def test_the_worst_of_a_review_is_by_rank_and_steps_are_the_specs_or_the_ends_of_the_logs():
    found = [checks.Check("a", verdict, "1") for verdict in ("warn", "fail", "pass")]
    assert [worst(found[k:]) for k in (0, 2, 3)] == ["fail", "pass", "pass"]
    assert worst([found[0], found[2]]) == "warn"
    controller = stub()
    controller.controlled, controller.notes = ("t",), {"spec": {"steps": [[20, 30], [35.5, 10]]}}
    assert checks._steps(controller) == ([20.0, 35.5], [30.0, 10.0])
    for notes, valid in (({}, {"t": (5.0, 50.0)}), ({"spec": {}}, {"u": (5.0, 50.0)})):
        controller.notes, controller.plant = notes, SimpleNamespace(valid=valid)
        assert checks._steps(controller) == ([], [5.0, 50.0] if "t" in valid else [20.0, 40.0])
    assert (
        checks.valid_range(controller, (20.0, 30.0)).finding == "the plant does not say where its logs were"
    )


TENTH = "the last tenth of the current hardly cools: leave it out"


@pytest.mark.parametrize(
    ("low", "worst_resistance", "gain", "verdict", "said", "fix"),
    [
        # I* = 0.04 * 293.15 / 2 = 5.863 A; full drive is 5 A, of which 1.1726 counts: the whole drive
        (-0.89, None, "g", "pass", "e: I* at -1.00 of q at 20 degC, its range ends at -0.89", ""),
        (-0.91, None, "g", "warn", "ends at -0.91", TENTH),
        (-0.999, None, "g", "warn", "ends at -0.999", TENTH),
        (-1.01, None, "g", "warn", "ends at -1.01", "set drive_limits: q = [-0.80, ...]"),
        (-1.01, None, "", "pass", "e: I* at -1.17 of q", ""),
        (-0.71, 2.5, "g", "pass", "e: I* at -1.00 of q at 20 degC, -0.80 on the worst of 2 draws, its", ""),
        (-0.73, 2.5, "g", "warn", "-0.80 on the worst", TENTH),
        (-0.81, 2.5, "g", "warn", "-0.80 on the worst", "set drive_limits: q = [-0.64, ...]"),
    ],
)  # fmt: skip
def test_the_optimum_of_an_element_is_at_the_coldest_target_on_the_worst_draw(
    monkeypatch, low, worst_resistance, gain, verdict, said, fix
):
    values = {"S": 0.04, "R": 2.0, "I": 5.0, "g": 1.1726}
    element = SimpleNamespace(input="q", seebeck="S", resistance="R", current="I", cooling_gain=gain)
    drawn = {3: SimpleNamespace(values=values | {"R": worst_resistance}), 7: SimpleNamespace(values=values)}
    controller = stub(drive_range={"q": (low, 3.0)})
    network = SimpleNamespace(peltiers={"e": element})
    controller.plant = SimpleNamespace(
        values=values, model=SimpleNamespace(network=network), draw=drawn.__getitem__
    )
    picked = (0, 3, 7) if worst_resistance else (0,)
    monkeypatch.setattr(checks, "draws_of", lambda plant, draws: picked[: 1 + draws])
    check = checks.peltier_optimum(controller, (40.0, 20.0), 5)
    assert (check.verdict, said in check.finding, check.fix) == (verdict, True, fix)


@pytest.mark.parametrize(
    ("y", "turns", "verdict", "finding"),
    [
        ([12.0, NAN, 50.55, 31.0], [-1.0, 3.0], "pass", "q: 12.0 to 50.5 degC in steady state"),
        ([12.0, 50.25, 31.0], [-0.99, 2.5, 3.5], "warn", "q turns over at -0.99, 2.50 of -1 to 3; "
         "q: 12.0 to 50.2 degC in steady state; rising from -0.25 to 2.50"),
        ([NAN, NAN], [], "warn", "q: t comes to rest at no drive (it only adds up)"),
    ],
)  # fmt: skip
def test_a_turn_of_the_gain_counts_inside_the_range(monkeypatch, y, turns, verdict, finding):
    asked = []
    curve = SimpleNamespace(y=np.array(y), turns=turns, rising=(-0.25, 2.5))
    monkeypatch.setattr(checks, "steady_curve", lambda *given: asked.append(given[1:]) or curve)
    check = checks.gain_sign(stub())
    assert (check.verdict, check.finding) == (verdict, finding)
    assert [(drive, output, d.tolist()) for drive, output, d in asked] == [("q", "t", [22.0])]


def test_of_a_black_box_gains_are_looked_at_where_its_logs_were():
    boxed = replace(crossed(), valid={"q1": (20.0, 60.0), "q2": (0.0, 120.0)})
    low, high = checks._known(PredictionModel(boxed, dt=2.0))
    assert (low.tolist(), high.tolist()) == ([20.0, 0.0], [60.0, 100.0])
    network = network_plant("tclab", q1=(20.0, 60.0))
    assert [ends.tolist() for ends in checks._known(PredictionModel(network))] == [[0.0, 0.0], [100.0, 100.0]]


@pytest.fixture(scope="module")
def two() -> Controller:
    plant = replace(crossed("0_255"), valid={"q1": (0.0, 100.0), "q2": (0.0, 255.0)})
    return Controller(plant, default_design(plant, controlled=("b", "a"), ambient=21.0))


@pytest.mark.parametrize(
    ("least", "verdict"), [(1e-6, "fail"), (1.1e-6, "warn"), (0.0199, "warn"), (0.02, "pass")]
)
def test_disturbances_are_looked_for_over_the_whole_range(two, monkeypatch, least, verdict):
    margins, given, at = iter([0.5, 0.31, least, 0.62, 0.4]), [], []
    linearise = two.model.linearise

    def margin(*args, scale):
        given.append((at[-1], *args, scale))
        return next(margins)

    monkeypatch.setattr(checks, "detectability_margin", margin)
    monkeypatch.setattr(
        type(two.model), "linearise", lambda self, x, u, d: at.append((x, u, d)) or linearise(x, u, d)
    )
    check = checks.detectable(two)
    assert check.verdict == verdict
    assert check.finding == (
        f"input q1, input q2; 1 % of the drive or 1 degC shows as {least:.2f} to 0.62 degC"
    )
    for share, ((x, u, d), A, C, into, on_output, scale) in zip(
        (0.1, 0.3, 0.5, 0.7, 0.9), given, strict=True
    ):
        np.testing.assert_allclose(u, [100.0 * share, 255.0 * share], rtol=1e-12)
        np.testing.assert_allclose(x, [21.0 + 0.2 * u[1], 21.0 + 0.25 * u[0]], rtol=1e-6)
        np.testing.assert_allclose(A, np.diag([0.9, 0.8]))
        np.testing.assert_allclose(into, [[0.0, 0.02 * 255], [0.05 * 100, 0.0]])
        np.testing.assert_equal([C, on_output], [np.eye(2), np.zeros((2, 2))])
        assert (d.tolist(), scale.tolist()) == ([21.0], [0.01, 0.01])


@pytest.mark.parametrize(("factor", "verdict"), [(5.0, "pass"), (5.1, "warn"), (9.9, "warn"), (10.1, "fail")])
def test_the_slowest_step_fits_the_deadline_and_most_a_quarter_of_the_sample(
    two, monkeypatch, factor, verdict
):
    asked = []

    def run(fresh, plant, schedule, start):
        asked.append((schedule, start))
        for move in ({"a": 22.0, "b": 22.0, "room": 21.0},) * 2:
            fresh.step(move, 30.0)
        asked.append(fresh.iterations)
        return SimpleNamespace(seconds=np.array([99.0, *(factor * 1e-3 * np.arange(101))]))

    monkeypatch.setattr(checks, "simulate_closed_loop", run)
    time, iterations = checks._effort(two, (24.0, 40.0))
    assert time.verdict == verdict
    assert time.finding == (
        f"101 steps on swings across the range: median {50 * factor:.1f} ms, p99 {99 * factor:.1f} ms, "
        f"slowest {100 * factor:.1f} ms; deadline 1000 ms, sample 2 s"
    )
    ends = [({"b": end, "a": end}, 80.0) for end in (40.0, 24.0, 40.0)]
    assert asked[0] == (ends, 24.0)
    assert len(asked[1]) == 2
    assert f"at most {max(asked[1])} iterations" in iterations.finding


@pytest.mark.parametrize(
    ("u", "y", "miss", "verdict", "said"),
    [
        ([0.04, 2.87], 30.0, 0.05, "pass", "24 to 40 degC in rooms of 18, 30.5 degC"),
        ([0.029, 2.0], 30.0, 0.0, "warn", "within 3 % of the drive's limit: 24 degC in a room of 18 degC"),
        ([0.5, 2.89], 30.0, 0.0, "warn", "within 3 % of the drive's limit: 24 degC"),
        ([-2e-6, 2.0], 30.0, 0.0, "fail", "24 degC in a room of 18 degC (needs a drive of -0.00, 2.00)"),
        ([0.5, 3.01], 30.0, 0.0, "fail", "40 degC in a room of 30.5 degC (needs a drive of 0.50, 3.01)"),
        ([0.5, 2.0], 30.0, 0.06, "fail", "24 degC in a room of 18 degC (misses by 0.1 degC)"),
        ([0.5, 2.0], NAN, 0.0, "fail", "24 degC in a room of 30.5 degC (nothing comes to rest)"),
    ],
)  # fmt: skip
def test_a_target_is_held_well_inside_the_drives(monkeypatch, u, y, miss, verdict, said):
    asked = []
    found = SimpleNamespace(u=np.array(u), y=np.array([y]), miss=miss)
    monkeypatch.setattr(checks, "holding_drive", lambda *given: asked.append(given[1:]) or found)
    check = checks.reachable(
        stub(drive_range={"p": (0.0, 1.0), "q": (-1.0, 3.0)}), (24.0, 40.0), (18.0, 30.5)
    )
    assert (check.verdict, said in check.finding, bool(check.fix)) == (verdict, True, verdict != "pass")
    assert [(target.tolist(), d.tolist()) for _, target, d in asked] == [
        ([target], [room]) for room in (18.0, 30.5) for target in (24.0, 40.0)
    ]


@pytest.mark.parametrize(("move", "verdict"), [(1000.0, "pass"), (30.0, "warn")])
def test_a_plant_that_has_what_its_model_lacks_settles_or_is_warned_of(tank: Any, move: float, verdict: str):
    notes = {"spec": {"steps": [[18.0, 43.0]], "lost_gain": 0.1}}
    controller = Controller(tank, default_design(tank, dt=4.0, move=move), notes=notes)
    found = checks.lacks_structure(controller, (20.0, 30.0))
    assert found.verdict == verdict
    lead, seen = found.finding.split(", each alone: ")
    assert lead == "18 to 43 degC"
    words = [part.split(":")[0] for part in seen.split("; ")]
    delay = apparent_delay(tank, ("t_surface",))
    late = [f"sensors slower by {0.5 * delay:.2g} s", f"delay longer by {0.5 * delay:.2g} s"]
    assert words == [*late, "drive weaker by 10 %"]
    assert ("never" in found.finding or "(asked" in found.finding) == (verdict == "warn")


ASKED = Asked(450.0, 0.25, 0.3, 0.05, 0.0)
STEP = StepResult(18.0, 43.0, 1000, 60.0, 0.1, 0.02, 0.0, 1.0, 1.0, 0.5, 600.0)
SWINGS = {"settle_s": np.nan, "overshoot": 5.0}
NEVER = "never settles, overshoot 0.10, offset"


@pytest.mark.parametrize(
    ("changes", "said", "verdict"),
    [
        ({}, "settles in 60 s, overshoot 0.10, offset 0.02", "pass"),
        ({"overshoot": 0.5}, "settles in 60 s, overshoot 0.50 (asked 0.3), offset 0.02", "warn"),
        ({"overshoot": 1.0}, "settles in 60 s, overshoot 1.00 (asked 0.3), offset 0.02", "warn"),
        ({"bias": -0.09}, "settles in 60 s, overshoot 0.10, offset -0.09 (asked 0.05)", "warn"),
        ({"bias": -0.24}, "settles in 60 s, overshoot 0.10, offset -0.24 (asked 0.05)", "warn"),
        (
            {"settle_s": np.nan, "bias": -0.3},
            f"{NEVER} -0.30 (asked 0.05)",
            "warn",
        ),
        (
            {"settle_s": np.nan, "bias": -0.8},
            f"{NEVER} -0.80 (asked 0.05)",
            "fail",
        ),
        (SWINGS, "never settles, overshoot 5.00 (asked 0.3), offset 0.02", "fail"),
    ],
)
def test_structure_that_lacks_is_judged_by_overshoot_and_offset_too(
    tank: Any, changes: dict[str, float], said: str, verdict: str, monkeypatch: pytest.MonkeyPatch
):
    notes = {"spec": {"steps": [[18.0, 43.0]]}}
    controller = Controller(tank, default_design(tank, dt=4.0), notes=notes)
    monkeypatch.setattr(checks, "run_trials", lambda *given: [replace(STEP, **changes)])
    found = checks.lacks_structure(controller, (18.0, 43.0))
    delay = 0.5 * apparent_delay(tank, ("t_surface",))
    assert found.finding == f"18 to 43 degC, each alone: sensors slower by {delay:.2g} s: {said}"
    assert (found.verdict, bool(found.fix)) == (verdict, verdict != "pass")
    nobody = checks.lacks_structure(Controller(tank, controller.design), (18.0, 43.0))  # asked for anything
    assert nobody.verdict == ("pass" if verdict == "pass" else "warn")
    assert checks._stepped(replace(STEP, settle_s=70.0), ASKED._replace(pace_s=65.0))[1] == "warn"


@pytest.mark.parametrize(
    ("changes", "said", "verdict"),
    [
        ({}, "settles in 60 s, overshoot 0.10, offset 0.02", "pass"),
        ({"settle_s": 451.0}, "settles in 451 s (asked 450 s), overshoot 0.10, offset 0.02", "warn"),
        ({"bias": 0.06}, "settles in 60 s, overshoot 0.10, offset 0.06 (asked 0.05)", "warn"),
        (
            {"settle_s": np.nan},
            "never settles (asked 450 s), overshoot 0.10, offset 0.02",
            "fail",
        ),
    ],
)
def test_every_step_of_the_spec_must_settle_where_the_model_is_right(
    tank: Any, changes: dict[str, float], said: str, verdict: str, monkeypatch: pytest.MonkeyPatch
):
    design = default_design(tank, dt=4.0)
    last = replace(STEP, start=43.0, target=30.0)
    results = [
        STEP,
        replace(last, draw=0),
        replace(last, **changes),
    ]  # the worst draw of the last step counts
    monkeypatch.setattr(checks, "run_trials", lambda *given: results)
    for steps in ({"settle_within_s": 450.0}, {}):  # of the defaults
        spec = {"steps": [[18.0, 43.0], [43.0, 30.0]], **steps}
        found = checks.as_asked(Controller(tank, design, notes={"spec": spec}), (18.0, 43.0))
        assert (found.verdict, bool(found.fix)) == (verdict, verdict != "pass")
        assert found.finding.endswith(f"overshoot 0.10, offset 0.02; 43 to 30 degC: {said}")
    # a file that tells the default beside shorter steps is read
    short = spec | {"settle_within_s": 450.0, "hold_s": 90.0}
    assert checks.as_asked(Controller(tank, design, notes={"spec": short}), (18.0, 43.0)).verdict == verdict
    nobody = replace(STEP, start=18.0, target=43.0, **changes)
    monkeypatch.setattr(checks, "run_trials", lambda *given: [nobody])
    assert checks.as_asked(Controller(tank, design), (18.0, 43.0)).verdict in ("pass", "warn")


@pytest.mark.parametrize(
    ("said", "verdict", "finding"),
    [
        ("oe: expected RMSE 0.1; good for simulation; on another", "pass", "oe: expected RMSE 0.1"),
        ("oe: RMSE 9; not good: no better on a; on another", "warn", "oe: RMSE 9; not good: no better on a"),
        ("", "pass", "no verdict, of 2 logs"),
    ],
)
def test_a_plant_that_identify_does_not_call_good_is_warned_of(said: str, verdict: str, finding: str):
    check = checks.called_good(SimpleNamespace(plant=SimpleNamespace(verdict=said, logs=("a", "b"))))
    assert (check.verdict, check.finding, bool(check.fix)) == (verdict, finding, verdict == "warn")


def test_an_observer_that_needs_longer_than_a_step_has_is_warned_of():
    law, asked = SimpleNamespace(forgets=np.array([[np.exp(-2 / 700)]])), stub()
    assert checks.observer_stable(asked, SimpleNamespace(law=law), (20.0, 30.0)).verdict == "pass"
    asked.notes = {"spec": {"settle_within_s": 600.0}}
    check = checks.observer_stable(asked, SimpleNamespace(law=law), (20.0, 30.0))
    assert (check.verdict, check.finding.split(": ")[1]) == (
        "warn",
        "an error falls to a third in 700 s, a step has 600 s",
    )


@pytest.mark.parametrize(("move", "verdict"), [(1.0, "pass"), (3e4, "warn")])
def test_a_design_that_leaves_an_offset_behind_play_is_warned_of(move: float, verdict: str):
    """A valve of 2 % of play, on a heater of 40 K: the slower design is left a tenth of a degree off."""
    spec = {"steps": [[30.0, 40.0], [40.0, 33.0]], "hold_s": 600.0}
    plant = heater().plant
    design = default_design(plant, deadline_s=1e9, move=move)
    check = checks.has_play(Controller(plant, design, notes={"spec": spec}), (30.0, 40.0))
    assert (check.name, check.verdict) == ("settles where drives have play", verdict)
    assert check.finding.startswith("play of 2 % of each drive's range: 30 to 40 degC: settles in ")
    assert bool(check.fix) == (verdict == "warn")


def test_where_nothing_is_tried_it_does_not_say_pass(tank: Any):
    none = dict.fromkeys(("extra_lag", "extra_delay", "lost_gain"), 0.0)
    controller = Controller(tank, default_design(tank, dt=4.0), notes={"spec": none})
    found = checks.lacks_structure(controller, (18.0, 43.0))
    assert (found.verdict, found.fix) == ("not tried", "")
    assert found.finding == "the spec's extra_lag, extra_delay and lost_gain are 0"
    others = [Check("a", "pass", ""), Check("b", "warn", "", "do")]
    assert worst([found]) == "pass"
    assert worst([found, *others]) == "warn"
    section = review_section([found, *others])
    name = "settles where the model lacks structure"
    assert section.verdict == f"1 of 3 checks pass (with a warning: b; not tried: {name})."
    assert review_section([found, others[0]]).tone == "good"
