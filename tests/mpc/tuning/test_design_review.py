"""The review: a sound design passes, and each planted fault is found by the check that is there for it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from thermogrip.mpc.controllers.mpc import Controller, design_controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.design.spec import Spec
from thermogrip.mpc.tuning import design_review as checks
from thermogrip.mpc.tuning.design_review import review
from thermogrip.mpc.tuning.objective import Case, StepResult, apparent_delays
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

NAN = float("nan")


@pytest.fixture(scope="module")
def sound(tank):
    return review(design_controller(tank, dt=2.0, move=1000.0), wanted=(18.0, 43.0))


def test_a_sound_design_passes_every_check(sound):
    assert {check.verdict for check in sound} == {"pass"}
    assert len(sound) == 6


def test_every_finding_has_a_number_and_every_fault_a_fix(sound, reversing_tank):
    faulty = review(design_controller(reversing_tank, dt=2.0), wanted=(2.0, 43.0))
    for check in (*sound, *faulty):
        assert check.verdict == "pass" or check.fix
        assert any(char.isdigit() for char in check.finding)


def test_a_target_that_no_drive_holds_and_one_beyond_the_logs_are_found(tank, reversing_tank):
    held = checks.reachable(design_controller(reversing_tank, dt=2.0), Spec(), (-5.0, 30.0), (18.0, 30.0))
    logged = checks.valid_range(design_controller(tank, dt=2.0), (18.0, 60.0))
    assert (held.verdict, logged.verdict) == ("fail", "warn")


def test_a_target_beyond_the_logs_is_reported_before_a_run(tank):
    from thermogrip.mpc.tuning.design_review import beyond_logs

    controller = design_controller(tank, dt=2.0)
    assert beyond_logs(controller, 43.0) == []
    (said,) = beyond_logs(controller, {"t_surface": 60.0})
    assert "t_surface was 8.0 to 52.0 degC" in said


@pytest.mark.parametrize(
    ("target", "inside"), [(7.6, True), (7.5, False), (52.4, True), (52.5, False), (30.0, True)]
)
def test_a_hundredth_of_their_range_beyond_the_logs_is_forgiven(tank, target: float, inside: bool):
    controller = design_controller(tank, dt=2.0)
    assert (checks.beyond_logs(controller, target) == []) == inside
    for span in ((target, 30.0), (30.0, target)):
        check = checks.valid_range(controller, span)
        assert check.verdict == ("pass" if inside else "warn")
        assert check.finding.startswith(f"{target:g} degC lies outside the logs") != inside


def test_a_grasp_by_a_plant_whose_pump_never_stood_is_reported_before_it(tank):
    from thermogrip.mpc.tuning.design_review import beyond_logs

    controller = design_controller(replace(tank, valid={**tank.valid, "pump": (1.0, 1.0)}), dt=2.0)
    assert beyond_logs(controller, 43.0) == []
    (said,) = beyond_logs(controller, 43.0, grasps=True)
    assert "the pump never stood" in said
    assert beyond_logs(design_controller(tank, dt=2.0), 43.0, grasps=True) == []


def adder() -> Controller:
    """A store without losses: a heater of 0.05 degC per sample, through a filter; it stays wherever it is."""
    A, B = [[1.0, 0.05], [0.0, 0.9]], [[0.0], [1.0]]
    model = StateSpaceModel(("q",), (), ("t",), A=A, B=B, C=[[1.0, 0.0]], dt=1.0, y0=[25.0])
    plant = Plant(model, {}, dt=1.0, units={"q": "1"}, valid={"q": (-1.0, 1.0), "t": (20.0, 60.0)})
    return Controller(plant, default_design(plant))


def test_an_integrator_holds_any_target_with_no_drive_wherever_a_step_starts():
    controller = adder()
    controller.notes["spec"] = {"steps": [[90.0, 30.0], [30.0, 50.0]]}
    checks = {check.name: check for check in review(controller)}
    assert "fail" not in {check.verdict for check in checks.values()}
    assert checks["targets lie where the logs were"].verdict == "pass"
    assert checks["targets can be held in steady state"].finding.startswith("30 to 50 degC")


def stub(**design) -> Any:
    """Return as much of a controller as a check asks for: two drives, one output."""
    usual = {"controlled": ("t",), "dt": 2.0, "blocks": (1, 3), "slew_per_s": {"q": 0.1}}
    usual |= {"drive_range": {"q": (-1.0, 3.0)}, "limits": {}, "ambient": 22.0, "relays": {}}
    model = SimpleNamespace(drives=("p", "q"), n_u=2, n_d=1, outputs=("t",), span=np.array([1.0, 4.0]))
    model.disturbances, model.rooms = ("t_room",), np.array([True])
    model.undisturbed = lambda ambient: np.array([ambient])
    return SimpleNamespace(
        design=SimpleNamespace(**usual | design), model=model, plant=None, dt=2.0, notes={}
    )


def test_steps_are_the_specs_or_the_ends_of_the_logs():
    controller = stub()
    controller.controlled, controller.notes = ("t",), {"spec": {"steps": [[20, 30], [35.5, 10]]}}
    assert checks.spec_of(controller, None)[0].steps == [(20.0, 30.0), (35.5, 10.0)]
    for valid, steps in (({"t": (5.0, 50.0)}, (5.0, 50.0)), ({"u": (5.0, 50.0)}, (20.0, 40.0))):
        controller.notes, controller.plant = {}, SimpleNamespace(valid=valid)
        assert checks.spec_of(controller, None) == (Spec(steps=[steps]), False)
    assert checks.spec_of(controller, (12.0, 13.5))[0].steps == [(12.0, 13.5)]
    assert (
        checks.valid_range(controller, (20.0, 30.0)).finding == "the plant does not say where its logs were"
    )


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
        stub(drive_range={"p": (0.0, 1.0), "q": (-1.0, 3.0)}), Spec(), (24.0, 40.0), (18.0, 30.5)
    )
    assert (check.verdict, said in check.finding, bool(check.fix)) == (verdict, True, verdict != "pass")
    assert [(target.tolist(), d.tolist()) for _, target, d in asked] == [
        ([target], [room]) for room in (18.0, 30.5) for target in (24.0, 40.0)
    ]


@pytest.mark.parametrize(("move", "verdict"), [(1000.0, "pass"), (30.0, "warn")])
def test_a_plant_that_has_what_its_model_lacks_settles_or_is_warned_of(tank: Any, move: float, verdict: str):
    notes = {"spec": {"steps": [[18.0, 43.0]], "lost_gain": 0.1}}
    controller = Controller(tank, default_design(tank, dt=4.0, move=move), notes=notes)
    found = checks.lacks_structure(controller, checks.spec_of(controller, None)[0], 0, 0, noted=False)
    assert found.verdict == verdict
    lead, seen = found.finding.split(", each alone: ")
    assert lead == "18 to 43 degC"
    words = [part.split(":")[0] for part in seen.split("; ")]
    (delay,) = apparent_delays(tank, ("t_surface",))
    late = [f"sensors slower by {0.5 * delay:.2g} s", f"delay longer by {0.5 * delay:.2g} s"]
    assert words == [*late, "drive weaker by 10 %"]
    assert ("never" in found.finding or "(asked" in found.finding) == (verdict == "warn")


STEP = StepResult(Case(18.0, 43.0, 0), 60.0, 0.1, 0.02, 0.0, 1.0, 1.0, 0.5, 600.0)
NEVER = "never settles, overshoot 0.10, offset"


@pytest.mark.parametrize(
    ("changes", "said", "verdict"),
    [
        ({}, "settles in 60 s, overshoot 0.10, offset 0.02", "pass"),
        ({"overshoot": 0.5}, "settles in 60 s, overshoot 0.50 (asked 0.3), offset 0.02", "warn"),
        ({"bias": -0.09}, "settles in 60 s, overshoot 0.10, offset -0.09 (asked 0.05)", "warn"),
        ({"settle_s": NAN, "bias": -0.3}, f"{NEVER} -0.30 (asked 0.05)", "warn"),
        ({"settle_s": NAN, "bias": -0.8}, f"{NEVER} -0.80 (asked 0.05)", "fail"),
        (
            {"settle_s": NAN, "overshoot": 5.0},
            "never settles, overshoot 5.00 (asked 0.3), offset 0.02",
            "fail",
        ),
    ],
)
def test_a_step_is_judged_by_overshoot_and_offset_too(changes: dict[str, float], said: str, verdict: str):
    assert checks._step_verdict(replace(STEP, **changes), Spec()) == (said, verdict)


@pytest.mark.parametrize(
    ("changes", "said", "verdict"),
    [
        ({}, "settles in 60 s, overshoot 0.10, offset 0.02", "pass"),
        ({"settle_s": 451.0}, "settles in 451 s (asked 450 s), overshoot 0.10, offset 0.02", "fail"),
        ({"bias": 0.06}, "settles in 60 s, overshoot 0.10, offset 0.06 (asked 0.05)", "fail"),
        ({"settle_s": NAN}, "never settles (asked 450 s), overshoot 0.10, offset 0.02", "fail"),
    ],
)
def test_every_step_of_the_spec_must_settle_where_the_model_is_right(
    tank: Any, changes: dict[str, float], said: str, verdict: str, monkeypatch: pytest.MonkeyPatch
):
    design = default_design(tank, dt=4.0)

    def asked_of(notes: dict[str, Any]) -> checks.Check:
        controller = Controller(tank, design, notes={"spec": notes})
        spec, noted = checks.spec_of(controller, None)
        return checks.meets_each_step(controller, spec, [0, 1], 0, noted=noted)

    last = replace(STEP, case=Case(43.0, 30.0, 0))
    # the worst draw of the last step counts
    monkeypatch.setattr(checks, "run_trials", lambda *given, seed: [STEP, last, replace(last, **changes)])
    for steps in ({"settle_within_s": 450.0}, {}):  # of the defaults
        spec = {"steps": [[18.0, 43.0], [43.0, 30.0]], **steps}
        found = asked_of(spec)
        assert (found.verdict, bool(found.fix)) == (verdict, verdict != "pass")
        assert found.finding.endswith(f"overshoot 0.10, offset 0.02; 43 to 30 degC: {said}")
    # a file that tells the default beside shorter steps is read
    short = spec | {"settle_within_s": 450.0, "hold_s": 90.0}
    assert asked_of(short).verdict == verdict


def test_a_pi_is_reviewed_by_its_loops_and_by_what_it_does(tank):
    good = PIController(tank, dt=4.0)
    found = {check.name: check.verdict for check in review(good, wanted=(25.0, 33.0), draws=0)}
    assert "fail" not in found.values()
    wild = replace(good.design, loops=(replace(good.loops[0], Kc=20 * good.loops[0].Kc),))
    found = {check.name: check.verdict for check in review(PIController(tank, wild), draws=0)}
    assert found["comes back after a load"] == "fail"


@pytest.mark.parametrize(
    ("said", "verdict", "finding"),
    [
        ("Good for simulation (oe). Expected error: 1 K.", "pass", "Good for simulation (oe)"),
        ("Not good (oe): no better on a. Expected error: 1 K.", "warn", "Not good (oe): no better on a"),
        ("oe: RMSE 9; not good: no better on a", "warn", "oe: RMSE 9; not good: no better on a"),
        ("", "pass", "no verdict, of 2 logs"),
    ],
)
def test_a_plant_that_identify_does_not_call_good_is_warned_of(said: str, verdict: str, finding: str):
    check = checks.plant_is_good(SimpleNamespace(plant=SimpleNamespace(verdict=said, logs=("a", "b"))))
    assert (check.verdict, check.finding, bool(check.fix)) == (verdict, finding, verdict == "warn")
