"""Relays of a controller: trials with them, in Python and in C, their file, and what is refused."""

from __future__ import annotations

import ctypes
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from tests.mpc.makers import GCC, heater, kit
from thermogrip.datasets.errors import UserError
from thermogrip.mpc import Controller, PIController, load_controller, review
from thermogrip.mpc.closed_loop.simulate import ClosedLoop, Surroundings, simulate_closed_loop
from thermogrip.mpc.closed_loop.simulate_native import compiled_loop
from thermogrip.mpc.controllers.export import export_controller
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.design.relays import Relay, Switches
from thermogrip.mpc.design.spec import Spec, spec_from_dict
from thermogrip.mpc.native.runtime import compiler
from thermogrip.mpc.tuning.tune import unknown_to_pi
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

PAIR = {"hot": Relay(cooler="cold", on_s=30.0, off_s=60.0, dead_s=45.0), "cold": Relay(on_s=20.0, off_s=90.0)}


def chamber(low: float = 0.0) -> Plant:
    """Return a chamber of 3000 s that a heater brings 40 K above, a cooler 40 K below its room."""
    a = float(np.exp(-5 / 3000))
    A, B = np.diag([a, 0, 0]), np.array([[0, 0], [1, 0], [0, 1.0]])
    A[0, 1:] = 40 * (1 - a), -40 * (1 - a)
    model = StateSpaceModel(("hot", "cold"), (), ("t",), A=A, B=B, C=[[1.0, 0, 0]], dt=5.0, y0=[25.0])
    valid = {"hot": (low, 1.0), "cold": (0.0, 1.0), "t": (0.0, 50.0)}
    return Plant(model, {}, dt=5.0, units={"hot": "1", "cold": "1"}, valid=valid)


def ripple(run: ClosedLoop) -> float:
    """Return the range of the output in the last third of a run."""
    return float(np.ptp(run.outputs["t"][-len(run.time) // 3 :]))


def test_a_trial_has_the_ripple_of_its_relays_and_is_judged_by_it():
    ripples = []
    for seconds, verdict in ((None, "pass"), (2.0, "pass"), (40.0, "fail")):
        relays = {} if seconds is None else {"q": Relay(on_s=seconds, off_s=seconds)}
        controller, still = heater(relays=relays), Surroundings(relays=relays, noise=0.0, quantum=0.0)
        run = simulate_closed_loop(controller, controller.plant, [(40.0, 1800.0)], surroundings=still)
        ripples.append(ripple(run))
        spec = Spec(steps=[(30, 40)], band_degC=1.5, overshoot_degC=1.5, bias_degC=0.5, relays=relays)
        controller.notes["spec"] = spec.model_dump(mode="json")
        assert review(controller, draws=1)[1].verdict == verdict
    assert ripples[0] < 0.01 < 0.5 < ripples[1] < 1.5 < 5.0 < ripples[2]


@GCC
@pytest.mark.parametrize("make", [Controller, PIController])
@pytest.mark.parametrize("relays", [PAIR, {"hot": Relay(on_s=7.0, off_s=3.0)}])
def test_a_trial_with_relays_is_the_same_in_c_and_after_a_file(make, relays, tmp_path):
    plant = chamber()
    controller = make(plant, default_design(plant, relays=relays))
    again = load_controller(controller.save(tmp_path / "controller.json"))
    assert again.design == controller.design
    about = {"start": 18.0, "surroundings": Surroundings(relays=relays), "seed": 1}
    python = simulate_closed_loop(controller, plant, [(22.0, 2000.0)], **about)
    again.c = again.c or Controller(plant, controller.design).c
    in_c = compiled_loop(again, plant, [(22.0, 2000.0)], **about)
    np.testing.assert_allclose(in_c.outputs["t"], python.outputs["t"], atol=1e-8)
    assert ripple(python) > 0.05


class _Switch(ctypes.Structure):
    _fields_ = [(name, ctypes.c_int) for name in ("on", "stopped", "fresh")]
    _fields_ += [(name, ctypes.c_double) for name in ("owed_s", "since_s")]


@GCC
def test_the_exported_c_switches_at_the_same_samples(tmp_path):
    plant = chamber()
    export_controller(Controller(plant, default_design(plant, relays=PAIR)), tmp_path)
    text = '#include "tg_relays.h"\nconst tg_relay *table(void) { return tg_the_relays; }\n'
    (tmp_path / "table.c").write_text(text)
    flags = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-shared", "-fPIC"]
    sources = [tmp_path / "tg_switches.c", tmp_path / "table.c"]
    subprocess.run([compiler(), *flags, *sources, "-o", tmp_path / "t.so", "-lm"], check=True)
    c = ctypes.CDLL(str(tmp_path / "t.so"))
    c.table.restype, rng = ctypes.c_void_p, np.random.default_rng(2)
    states, python = (_Switch * 2)(), Switches(PAIR, plant.valid)
    table, seconds = ctypes.c_void_p(c.table()), ctypes.c_double(0.7)
    c.tg_switches_reset(states, 2)
    drive, switched = {"hot": 0.0, "cold": 0.0}, np.zeros((20_000, 2))
    for k in range(len(switched)):
        numbers = (ctypes.c_double * 2)(*drive.values())
        c.tg_switches_pass(table, states, 2, numbers, seconds)
        python.pass_time(0.7)
        if rng.random() < 0.01:
            drive = dict(zip(drive, np.clip(rng.uniform(-0.5, 1.2, 2), 0, 1)))
        stopped = k % 3000 > 2900
        c.tg_switches_turn(table, states, 2, (ctypes.c_double * 2)(*drive.values()), not stopped)
        python.request(drive, running=not stopped)
        switched[k] = [switch.on for switch in python.each]
        assert [state.on for state in states] == switched[k].tolist()
        assert not (stopped and switched[k].any())
    assert switched.sum(axis=0).min() > 2000
    assert switched.sum(axis=1).max() == 1


@pytest.mark.parametrize(
    ("relays", "says"),
    [({"q3": {}}, "relays: the plant has no drive q3"), ({"q1": {"on": 3}}, "relays.q1.on: no such key"),
     ({"q1": {"on_s": -1.0}}, "relays.q1.on_s: input should be greater"),
     ({"q1": {"on_s": 300.0, "off_s": 200.0}}, "q1 goes on and off in 500 s, longer than settle_within_s"),
     ({"q1": {"dead_s": 5.0}}, "dead_s of q1 is between it and a cooler"),
     ({"q1": {"cooler": "fan"}}, "a drive has a cooler where it goes below 0"),
     ({"q1": {"cooler": "q2"}, "q2": {}}, "q1 and q2 move no output in opposite directions")],
)  # fmt: skip
def test_relays_that_make_no_sense_are_refused(relays, says):
    with pytest.raises(UserError, match=says):
        spec_from_dict({"relays": relays}).design(kit().plant)


def test_a_pair_has_one_heater_and_one_cooler():
    spec = spec_from_dict({"relays": {name: vars(relay) for name, relay in PAIR.items()}})
    design = spec.design(chamber())
    assert (design.relays, design.drive) == (PAIR, pytest.approx(0.5 * spec.bias_degC * 40, rel=0.01))
    # otherwise both are on at once, which holds nothing, and the relays wait for each other
    errors = []
    for drive in (0.0, design.drive):
        controller, around = Controller(chamber(), replace(design, drive=drive)), Surroundings(relays=PAIR)
        run = simulate_closed_loop(controller, chamber(), [(24.0, 6000.0)], start=22.0, surroundings=around)
        errors.append(float(np.sqrt(np.mean((run.outputs["t"][600:] - 24.0) ** 2))))
    assert errors[1] < 0.25 < 0.5 < errors[0]
    assert unknown_to_pi(spec) == ["a heater and a cooler"]
    both = {"hot": Relay(cooler="cold"), "cold": Relay(cooler="hot")}
    with pytest.raises(UserError, match="cold is in two pairs"):
        default_design(chamber(), relays=both)
    with pytest.raises(UserError, match="hot is from -1 up"):
        default_design(chamber(-1.0), relays={"hot": Relay()})
