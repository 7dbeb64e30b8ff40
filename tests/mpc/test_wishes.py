"""What a spec may wish beside settling, each shown by a closed loop: zones, prices, ramps, hard limits, a
safe drive, a forecast, programs to convergence; and what cannot be had together, in one line."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.mpc.makers import WAYS, heater, kit, make_tank, network_plant
from thermogrip.datasets.errors import UserError
from thermogrip.mpc.closed_loop.simulate import ClosedLoop, Surroundings, simulate_closed_loop
from thermogrip.mpc.controllers.mpc import Controller, design_controller
from thermogrip.mpc.controllers.reference import ReferenceController
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.design.spec import spec_from_dict
from thermogrip.mpc.tuning.objective import bounds_of
from thermogrip.sysid.plant.plant import Plant

QUIET = Surroundings(noise=0.02, quantum=0.0)


# the board that closes the loops is not the model: 8 % less heat of one heater, a tenth more loss
@pytest.fixture(scope="module")
def board():
    plant = network_plant("tclab", t1=(20.0, 60.0), t2=(20.0, 60.0))
    values = plant.values
    names = list(plant.model.parameters)
    changed = np.array([values[name] for name in names])
    changed[0] *= 0.92
    changed[1] *= 1.1
    p = dict(zip(names, changed.tolist(), strict=True))
    return Plant(plant.model, p, dt=plant.dt, units=plant.units, valid=plant.valid)


def run(controller: Controller, board, target=40.0, seconds=2400.0, **more) -> ClosedLoop:
    return simulate_closed_loop(controller, board, [(target, seconds)], surroundings=QUIET, seed=3, **more)


def spent(loop: ClosedLoop, begin_s: float = 600.0) -> float:
    """Seconds of full drive from then on."""
    time = loop.sample_time
    return float(
        sum(np.sum(drive[time >= begin_s]) for drive in loop.drive.values()) / 100.0 * (time[1] - time[0])
    )


def test_in_a_zone_the_least_energy_is_spent_and_no_more_than_a_tenth_beyond_it_is_seen(board):
    tracking = run(kit(), board)
    priced = run(kit(zones={"t1": 1.5, "t2": 1.5}, energy_price={"q1": 1.0, "q2": 1.0}), board)
    edge = run(kit(), board, 38.5)  # who knew where the cheap edge is
    late = slice(-1500, None)
    for name in ("t1", "t2"):
        assert priced.outputs[name][late].min() > 38.4
        assert priced.outputs[name][late].max() < 39.0
    assert spent(priced) < 0.93 * spent(tracking)
    assert spent(priced) == pytest.approx(spent(edge), rel=0.01)
    assert set(priced.status) <= {"ok", "mismatch"}


def test_without_a_price_an_output_in_its_zone_is_left_alone(board):
    loop = run(kit(zones={"t1": 1.0, "t2": 1.0}), board)
    moves = [np.sum(np.abs(np.diff(loop.drive[name][240:]))) for name in ("q1", "q2")]
    tracked = run(kit(), board)
    assert max(moves) < 0.1 * max(np.sum(np.abs(np.diff(tracked.drive[name][240:]))) for name in ("q1", "q2"))
    assert all(np.all(np.abs(loop.outputs[name][-1500:] - 40.0) < 1.1) for name in ("t1", "t2"))


def test_targets_ramp_no_faster_than_they_may_and_arrive(board):
    loop = run(kit(ramp_per_s={"t1": 0.04}), board, {"t1": 40.0, "t2": 32.0}, 900.0)
    time, t1 = loop.time, loop.outputs["t1"]
    middle = (time > 120) & (time < 320)
    assert np.polyfit(time[middle], t1[middle], 1)[0] == pytest.approx(0.04, rel=0.03)
    assert np.max(np.abs(t1[middle] - (25.0 + 0.04 * time[middle]))) < 0.5
    assert abs(np.mean(t1[-200:]) - 40.0) < 0.05
    assert abs(loop.outputs["t2"][np.searchsorted(time, 200.0)] - 32.0) < 0.3  # the other one does not ramp


def test_a_step_of_a_target_that_ramps_is_in_its_band_no_sooner_than_the_ramp(board):
    spec = spec_from_dict({"steps": [[25.0, 40.0]], "hold_s": 900.0, "ramp_per_s": {"t1": 0.05}})
    design = spec.design(board)
    assert bounds_of(board, design, spec, [0]) == {(25.0, 40.0, 0): pytest.approx(14.75 / 0.05)}
    assert bounds_of(board, replace(design, ramp_per_s={}), spec, [0])[25.0, 40.0, 0] < 150.0


def test_a_hard_limit_gives_way_last():
    # the skin's target needs a tank beyond its limit: a soft one is broken for its sake, a hard one is not
    plant = make_tank()
    beyond = {}
    for hard in ((), ("t_tank",)):
        design = {"limits": {"t_tank": (5.0, 33.0)}, "price": 0.02, "hard": hard, "dt": 2.0}
        loop = simulate_closed_loop(
            design_controller(plant, **design), plant, [(36.0, 900.0)], start=25.0, surroundings=QUIET
        )
        beyond[hard] = float(loop.outputs["t_tank"].max() - 33.0)
    assert beyond[()] > 1.0
    assert beyond[("t_tank",)] < 0.1


@pytest.mark.parametrize("make", WAYS)
def test_a_failing_loop_goes_to_its_safe_drive(make):
    plant = network_plant("tclab", t1=(20.0, 60.0), t2=(20.0, 60.0))
    design = default_design(plant, dt=5.0, safe_drive={"q1": 20.0, "q2": 5.0})
    controller = make(plant, design)
    controller.reset({"t1": 30.0, "t2": 30.0})
    for k in range(30):
        lost = float("nan") if k > 3 else 30.0
        move = controller.step({"t1": lost, "t2": lost}, 35.0)
    assert (move.status, move.drive, move.pump) == ("off", {"q1": 20.0, "q2": 5.0}, 1)


def test_programs_to_convergence_end_where_one_more_changes_nothing():
    plant = make_tank(joule=0.1)  # its cooling turns over
    moved, plans = {}, {}
    for n in (1, 30):
        controller = ReferenceController(plant, default_design(plant, dt=2.0, iterations=n))
        reading = {"t_tank": 30.0, "t_surface": 30.0, "t_ambient": 25.0}
        controller.reset(reading)
        controller.step(reading, 16.0)
        plans[n] = controller.plan
        again = controller._optimise(controller._target, None)  # from its own plan, of the same state
        moved[n] = np.max(np.abs(np.repeat(again.plan, controller.design.blocks, axis=0) - plans[n]))
    assert moved[30] < 2e-5 * 2
    assert moved[1] > 20 * moved[30]


REFUSED = [
    ({"zones": {"t3": 0.04}}, "zones: t3 is not regulated"),
    ({"zones": {"t1": 1.0}}, "zones: 1 about t1 is wider than band_degC, 0.25"),
    ({"energy_price": 1.0}, "energy_price without zones of t1, t2"),
    ({"ramp_per_s": {"t9": 1.0}}, "ramp_per_s: t9 is not regulated"),
    ({"hard": ["t1"]}, "hard: t1 has no limits"),
    ({"safe_drive": {"q1": 120.0}}, "safe_drive of q1 is 120, beyond its 0 to 100"),
    ({"safe_drive": {"q7": 1.0}}, "safe_drive: the plant has no drive q7"),
    ({"settling": {"t1": {"within_s": 600.0}}}, "settling: no such key"),
    ({"iterations": 0}, "iterations: input should be greater than or equal to 1"),
]


@pytest.mark.parametrize(("keys", "said"), REFUSED)
def test_what_cannot_be_had_is_refused_in_one_line(keys, said):
    plant = network_plant("tclab", t1=(20.0, 60.0), t2=(20.0, 60.0))
    with pytest.raises(UserError) as refused:
        spec_from_dict({"steps": [[25.0, 40.0]], **keys}).design(plant)
    assert refused.value.problem.startswith(said)
    assert "\n" not in str(refused.value)


WIDE = {"band_degC": 1.0, "overshoot_degC": 1.0, "bias_degC": 1.0, "steps": [[25.0, 40.0]]}


def test_energy_of_a_drive_that_goes_both_ways_has_no_price():
    keys = {"zones": {"t_surface": 1.0}, "energy_price": 1.0}
    with pytest.raises(UserError, match="energy_price: drive goes both ways"):
        spec_from_dict(WIDE | keys).design(make_tank())


def test_what_may_rest_anywhere_is_no_linear_system():
    with pytest.raises(UserError, match="zones: a controller that may rest anywhere"):
        heater(zones={"t": 1.0}).to_control()


def test_wishes_are_in_the_controllers_file(tmp_path):
    wishes = {
        "zones": {"t1": 1.0, "t2": 2.0},
        "energy_price": {"q1": 1.0},
        "safe_drive": {"q2": 10.0},
        "iterations": 3,
        "limits": {"t1": (0.0, 60.0)},
        "hard": ("t1",),
        "ramp_per_s": {"t2": 0.5},
    }
    controller = kit(**wishes)
    assert Controller.load(controller.save(tmp_path / "c.json")).design == controller.design


def test_drives_may_leave_out_none_where_a_safe_drive_is_named():
    plant = network_plant("tclab", t1=(20.0, 60.0), t2=(20.0, 60.0))
    limits = {"q1": [10.0, 90.0], "q2": [0.0, 90.0]}
    spec = {"steps": [[25.0, 40.0]], "drive_limits": limits}
    with pytest.raises(UserError, match="leaves out 0, where a failing loop goes"):
        spec_from_dict(spec).design(plant)
    design = spec_from_dict(spec | {"safe_drive": {"q1": 15.0}}).design(plant)
    assert (design.drive_range["q1"], design.safe_drive) == ((10.0, 90.0), {"q1": 15.0})
