"""Measured disturbances that are no temperature: a room in the sun, a tank with a flow through it.

What nobody reads is what the logs had, or the spec says, in the trials of ``tune``, in a run and in exported
C; the truths are equations of their own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import pytest

from tests.mpc.makers import make_tank, start_in_c
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import make_log
from thermogrip.mpc.closed_loop.simulate import Surroundings, Truth, simulate_closed_loop
from thermogrip.mpc.controllers.export import check_export, export_controller
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.controllers.reference import ReferenceController
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.design.spec import Spec, spec_from_dict
from thermogrip.mpc.native.runtime import compiler
from thermogrip.mpc.tuning.design_review import reachable
from thermogrip.mpc.tuning.objective import Case as Trial
from thermogrip.mpc.tuning.objective import lacking, run_trials, surroundings_of, trial
from thermogrip.rig.guard.guard import Guard
from thermogrip.rig.session.session import run_session
from thermogrip.rig.simulation.twin import Twin
from thermogrip.sysid.identification import identify
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.models.user_model import own_model
from thermogrip.sysid.plant.linearise import operating_point
from thermogrip.sysid.plant.plant import Plant

needs_gcc = pytest.mark.skipif(compiler() is None, reason="no gcc here")


@dataclass(frozen=True)
class Case:
    """dT/dt = (by_u u + by_d (d - base) + room - T) / tau, of a heater in percent."""

    name: str
    nominal: float
    logs: tuple[float, float]
    by_u: float
    by_d: float
    tau: float
    steps: tuple[tuple[float, float], tuple[float, float]]
    room: float = 15.0
    dt: float = 10.0

    def plant(self, **changes: Any) -> Plant:
        """Return the plant, its state behind a delay of two steps."""
        a = float(np.exp(-self.dt / self.tau))
        A = np.zeros((3, 3))
        A[0, 0], A[0, 2], A[2, 1] = a, self.by_u * (1 - a), 1.0
        B, E = np.array([[0.0], [1.0], [0.0]]), np.zeros((3, 2))
        E[0] = 1 - a, self.by_d * (1 - a)
        model = StateSpaceModel(
            ("heat",), ("t_out", self.name), ("t",), A=A, B=B, E=E, C=[[1.0, 0.0, 0.0]], dt=self.dt
        )
        units = {"heat": "percent", "t_out": "degC", self.name: "1", "t": "degC"}
        ends = sorted(end for step in self.steps for end in step)
        valid = {"heat": (0.0, 100.0), "t": (ends[0] - 4.0, ends[-1] + 4.0), self.name: self.logs}
        given: dict[str, Any] = {"valid": valid, "nominal": {self.name: self.nominal}, "noise": {"t": 0.03}}
        return Plant(model, {}, dt=self.dt, units=units, **given | changes)

    def spec(self, **changes: Any) -> Spec:
        """Return what is wanted, in a room of its own."""
        keys = {"steps": self.steps, "ambient_degC": self.room, "hold_s": 1800.0, "sample_time_s": self.dt}
        return spec_from_dict({"settle_within_s": 1200.0} | keys | changes)

    def held(self, target: float, d: float) -> float:
        """Return the drive that holds a target [percent]."""
        return (target - self.room - self.by_d * d) / self.by_u

    def loop(self, controller: Any, target: float, seconds: float, *, d: float, read: bool) -> Any:
        """Close the loop on own equations, by explicit steps of 1 s from where 10 percent hold it; return
        temperatures, drives and statuses by sample."""
        rng, heat = np.random.default_rng(5), 10.0
        t = self.room + self.by_u * heat + self.by_d * d
        pipe, rows = [heat] * int(2 * self.dt), []
        for k in range(round(seconds / self.dt)):
            reading = {"time_s": k * self.dt, "t": t + 0.03 * rng.standard_normal(), "t_out": self.room}
            reading |= {self.name: d} if read else {}
            if k == 0:
                controller.reset(reading)
            move = controller.step(reading, target)
            rows.append((t, float(move.drive), move.status))
            for _ in range(int(self.dt)):
                pipe.append(float(move.drive))
                t += (self.by_u * pipe.pop(0) + self.by_d * d + self.room - t) / self.tau
        found, drive, status = zip(*rows)
        return np.array(found), np.array(drive), status


SUN = Case("sun", 420.0, (0.0, 850.0), 0.4, 0.02, 900.0, ((24.0, 28.0), (28.0, 25.0)))
FLOW = Case("flow", 0.05, (0.02, 0.08), 1.2, -400.0, 400.0, ((25.0, 40.0), (40.0, 30.0)))
CASES = pytest.mark.parametrize("case", [SUN, FLOW], ids=lambda case: case.name)


@CASES
def test_what_nobody_reads_is_what_the_logs_had(case):
    plant = case.plant()
    assert plant.undisturbed(18.0).tolist() == [18.0, case.nominal]
    older = case.plant(nominal={})  # a file without it: the middle of what the logs showed
    assert older.undisturbed(18.0).tolist() == pytest.approx([18.0, np.mean(case.logs)])
    nothing = case.plant(nominal={}, valid={"heat": (0.0, 100.0)})
    assert np.isnan(nothing.undisturbed(18.0)[1])
    inflow = replace(plant, model=replace(plant.model, disturbances=("t_out", "t_inlet")))
    inflow = replace(inflow, units=inflow.units | {"t_inlet": "degC"}, nominal={"t_inlet": 60.0})
    assert inflow.undisturbed(18.0).tolist() == [18.0, 60.0]
    assert replace(inflow, nominal={}).undisturbed(18.0).tolist() == [18.0, 18.0]


@CASES
def test_a_plant_file_keeps_it_and_one_without_opens(case, tmp_path):
    plant = case.plant()
    assert Plant.load(plant.save(tmp_path / "plant.json")).nominal == {case.name: case.nominal}
    content = plant.to_dict()
    del content["nominal"]
    assert Plant.from_dict(content).nominal == {}


@CASES
def test_a_fit_notes_the_median_of_its_logs(case):
    rng, n = np.random.default_rng(2), 900
    heat = np.repeat(rng.uniform(0.0, 60.0, n // 30), 30)
    low, high = case.logs
    d = np.where(np.arange(n) % 300 < 200, case.nominal, rng.uniform(low, high, n // 100).repeat(100))
    t, now = [], case.room
    for k in range(n):
        t.append(now)
        now += case.dt * (case.by_u * heat[k] + case.by_d * d[k] + case.room - now) / case.tau
    log = make_log(
        case.dt * np.arange(n),
        {
            "heat": (heat, "percent", "input"),
            "t_out": (np.full(n, case.room) + 0.1 * rng.standard_normal(n), "degC", "disturbance"),
            case.name: (d, "1", "disturbance"),
            "t": (np.array(t) + 0.03 * rng.standard_normal(n), "degC", "output"),
        },
    )
    plant = identify([log], models=("arx",)).plant
    assert plant.nominal == pytest.approx({case.name: float(np.median(d))})
    u, at = operating_point(plant, None, None)
    assert (u.tolist(), at[1]) == ([0.0], pytest.approx(case.nominal))


@CASES
def test_trials_run_amid_it_and_every_controller_settles_without_offset(case):
    plant, spec = case.plant(), case.spec()
    design = spec.design(plant)
    around = surroundings_of(spec, design.controlled, plant)
    assert around.offset[case.name] == pytest.approx(0.02 * (case.logs[1] - case.logs[0]))
    assert (around.quanta[case.name], around.offset["t_out"]) == (0.0, pytest.approx(0.3))
    truth = Truth(plant, design.dt, around, case.steps[0][0], 0)
    assert truth.d.tolist() == [case.room, case.nominal]
    shown = truth.reading()[case.name]
    assert shown == pytest.approx(case.nominal, abs=0.03 * (case.logs[1] - case.logs[0]))
    for regulator in (Controller(plant, design), PIController(plant, design)):
        run = trial(regulator, plant, spec, Trial(*case.steps[0], 0))
        (segment,) = run.segments
        assert segment.settle_s < 900.0
        assert abs(segment.bias) < 0.05
        end = case.held(segment.target - 0.2, case.nominal)  # its sensor reads 0.2 too much
        assert float(run.drive["heat"][-20:].mean()) == pytest.approx(end, abs=1.0)
    doubted = spec.model_copy(update={"lost_gain": 0.15})
    (weaker,) = lacking(plant, doubted, design.controlled)
    cases = [Trial(*step, 0, words) for step in case.steps for words in ("", weaker)]
    found = run_trials(Controller(plant, design), plant, doubted, cases)
    assert all(np.isfinite(result.settle_s) and abs(result.bias) < 0.1 for result in found)


@CASES
def test_a_spec_says_otherwise_and_a_line_tells_what_is_taken(case, tmp_path):
    plant, value = case.plant(), case.logs[1]
    spec = case.spec(disturbances={case.name: value})
    wide = spec.widened(plant)
    assert wide.undisturbed(18.0).tolist() == [18.0, value]
    assert spec.surroundings_in_words(plant) == f"{case.name} is taken as {value:.4g} (the spec)"
    assert case.spec().surroundings_in_words(plant) == (
        f"{case.name} is taken as {case.nominal:.4g} (the logs' median)"
    )
    said = case.spec().surroundings_in_words(case.plant(nominal={}))
    assert said == f"{case.name} is taken as {np.mean(case.logs):.4g} (the middle of the logs)"
    assert Spec().surroundings_in_words(make_tank()) == ""
    run = trial(Controller(wide, spec.design(wide)), wide, spec, Trial(*case.steps[0], 0, seconds=900.0))
    end = case.held(case.steps[0][1] - 0.2, value)
    assert float(run.drive["heat"][-10:].mean()) == pytest.approx(np.clip(end, 0, 100), abs=1.5)
    with pytest.raises(UserError, match="the plant has no measured disturbance wind; these are: t_out"):
        case.spec(disturbances={"wind": 1.0}).widened(plant)
    file = tmp_path / "controller.json"
    Controller(wide, spec.design(wide)).save(file)
    again = Controller.load(file)
    assert again.model.undisturbed(18.0).tolist() == [18.0, value]


@CASES
def test_a_loop_without_the_reading_begins_as_one_that_reads_it(case):
    plant, spec = case.plant(), case.spec()
    design, target = spec.design(plant), case.steps[0][1]
    blind = case.loop(Controller(plant, design), target, 1500.0, d=case.nominal, read=False)
    seeing = case.loop(Controller(plant, design), target, 1500.0, d=case.nominal, read=True)
    np.testing.assert_allclose(blind[0], seeing[0], atol=1e-9)
    assert np.abs(blind[0][-30:] - target).max() < 0.1
    assert set(blind[2]) == {"ok"}


@CASES
def test_a_reading_far_from_any_temperature_counts(case):
    plant, spec = case.plant(), case.spec()
    controller = ReferenceController(plant, spec.design(plant))
    controller.reset({"t": 25.0, "t_out": 15.0, case.name: case.logs[1]})
    assert controller._past.d.tolist() == [15.0, case.logs[1]]
    controller.step({"t": 25.0, "t_out": 15.0, case.name: case.logs[0]}, 26.0)
    assert controller._past.d.tolist() == [15.0, case.logs[0]]
    controller.step({"t": 25.0, "t_out": 300.0, case.name: -9999.0}, 26.0)  # broken wires
    assert controller._past.d.tolist() == [15.0, case.logs[0]]


@needs_gcc
@CASES
def test_c_does_the_same_beside_python(case, tmp_path):
    plant, spec = case.plant(), case.spec()
    design, target = spec.design(plant), case.steps[0][1]
    for read, d in ((False, case.nominal), (True, case.logs[1]), (True, case.logs[0])):
        ours = case.loop(ReferenceController(plant, design), target, 600.0, d=d, read=read)
        theirs = case.loop(Controller(plant, design), target, 600.0, d=d, read=read)
        np.testing.assert_allclose(theirs[1], ours[1], atol=1e-6)
        assert theirs[2] == ours[2]
    controller = Controller(plant, design)
    export = export_controller(controller, tmp_path)
    found = check_export(export, controller, states=60, sanitize=False)
    assert found.passed
    assert found.same_status == 60
    text = (tmp_path / "README.md").read_text()
    assert f"/* t_out [degC], {case.name} [1] */" in text.replace("\\", "")


@needs_gcc
@CASES
def test_the_c_alone_starts_amid_it(case, tmp_path):
    plant, spec = case.plant(), case.spec()
    controller = Controller(plant, spec.design(plant))
    y = np.array([case.steps[0][0]])
    controller.observer.reset_in_room(y, controller.model.undisturbed(case.room))
    np.testing.assert_allclose(start_in_c(controller, y), controller.observer.x, atol=1e-9)


def test_review_says_amid_what_targets_are_held():
    plant, spec = SUN.plant(), SUN.spec()
    said = reachable(Controller(plant, spec.design(plant)), spec, (26.0, 28.0), (8.0, 12.0)).finding
    assert said == "26 to 28 degC in rooms of 8, 12 degC, sun of 420"


def test_a_run_without_the_reading_says_what_is_taken_and_goes_on():
    plant, spec = SUN.plant(), SUN.spec()
    controller = Controller(plant, spec.design(plant))
    twin = Twin(plant, ambient=SUN.room, t_start=24.0, skin="t")
    assert set(twin.read().values) == {"t", "t_out"}
    session = run_session(
        twin, controller, 28.0, output="t", guard=Guard(plant, skin="t"), settle_timeout=1500.0
    )
    said = [event.text for event in session.events if event.kind == "room"]
    assert said == ["the rig does not read sun: the controller takes sun as 420"]
    assert session.trip is None
    with pytest.raises(UserError, match="does not say what its disturbance 'sun' was in the logs"):
        Twin(SUN.plant(nominal={}, valid={"heat": (0.0, 100.0)}))


def test_a_room_of_the_trials_is_not_taken_from_the_sun():
    swapped = replace(SUN.plant(), model=replace(SUN.plant().model, disturbances=("sun", "t_out")))
    wanted = Spec.of(replace(swapped, valid=swapped.valid | {"t_out": (8.0, 12.0)}))
    assert wanted.ambient_degC == 10.0
    model = Controller(swapped, SUN.spec().design(swapped)).model
    assert model.room([700.0, 12.0]) == 12.0


def test_a_loop_may_run_amid_another_value():
    plant = SUN.plant()
    around = Surroundings(ambient=15.0, disturbances={"sun": 100.0}, quantum=0.0)
    run = simulate_closed_loop(
        Controller(plant, SUN.spec().design(plant)), plant, [(28.0, 3000.0)], start=24.0, surroundings=around
    )
    assert float(run.drive["heat"][-100:].mean()) == pytest.approx(SUN.held(28.0, 100.0), abs=1.0)


# ---- outputs in several units ----


class Tank:
    """A heated tank with an inflow: its level in percent has nothing to do with its temperature."""

    inputs: ClassVar[dict[str, Any]] = {
        "inflow": {"unit": "l/min", "range": (1.0, 9.0)},
        "heat": {"unit": "kW", "range": (0.0, 10.0)},
    }
    outputs: ClassVar[dict[str, Any]] = {"level": "percent", "t": "degC"}
    states: ClassVar[dict[str, Any]] = {"level": 5.0, "t": 2.0}
    parameters: ClassVar[dict[str, Any]] = {"out": 0.5}
    dt = 2.0

    def rhs(self, x: Any, u: Any, d: Any, p: Any) -> list[Any]:
        """Return dx/dt of level and temperature."""
        level = np.maximum(x.level, 1.0)
        return [
            0.01 * (10.0 * u.inflow - p.out * level * (1.0 + 0.001 * level)),
            (14.3 * u.heat - u.inflow * (x.t - 15.0)) / level / 6.0,
        ]


def mixed(**changes: Any) -> Controller:
    """Return a controller of the level."""
    model = own_model(Tank)
    valid = {"inflow": (1.0, 9.0), "heat": (0.0, 10.0), "level": (60.0, 98.0), "t": (15.0, 60.0)}
    plant = Plant(model, {"out": 0.5}, dt=2.0, units=model.units, valid=valid, noise={"level": 0.1, "t": 0.1})
    return Controller(plant, default_design(plant, controlled=("level",), dt=4.0, **changes))


def test_only_temperatures_share_a_level_at_the_start():
    controller = mixed()
    assert controller.model.warm.tolist() == [False, True]
    controller.reset({"level": 90.0, "t": 31.0})
    # the mean of 60 is neither level nor temperature
    assert controller.observer.x == pytest.approx([90.0, 31.0], abs=0.5)
    assert controller.observer.found_offset == pytest.approx([0.0, 0.0], abs=0.5)


@needs_gcc
def test_nor_do_they_in_c():
    controller = mixed()
    y = np.array([90.0, 31.0])
    controller.observer.reset_in_room(y, np.zeros(0))
    np.testing.assert_allclose(start_in_c(controller, y), controller.observer.x, atol=1e-9)


def test_a_drive_that_serves_a_limit_alone_is_not_held_to_its_gain_on_a_target():
    controller = mixed(limits={"t": (10.0, 50.0)})
    drives = list(controller.model.drives)
    assert [loop.drive for loop in controller.design.loops] == ["inflow"]
    seen = controller.optimiser.at_rest.seen
    assert seen[:, drives.index("inflow")].any()
    assert not seen[:, drives.index("heat")].any()
    # a plan that is improved until it stays needs it too: beyond an optimum it would go to and fro
    np.testing.assert_array_equal(
        mixed(limits={"t": (10.0, 50.0)}, iterations=3).optimiser.at_rest.seen, seen
    )
    # without a limit to serve the gain is all that speaks for a drive
    plain = mixed().optimiser.at_rest
    rest = np.abs(plain.response)
    np.testing.assert_array_equal(plain.seen, rest > 0.02 * rest.max(axis=0))
