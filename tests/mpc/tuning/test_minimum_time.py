"""The bound on settling, against closed forms and against every plan there is."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from thermogrip.mpc.design.spec import Spec
from thermogrip.mpc.plant.prediction import PredictionModel
from thermogrip.mpc.tuning.minimum_time import full_drive_bound
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

STEP = (25.0, 29.0)


def plant_of(A, B, C, *, F=None, y0=(25.0,), low=-1.0) -> Plant:
    n = np.shape(B)[1]
    names = tuple(f"q{k}" for k in range(n)) if n > 1 else ("q",)
    outputs = tuple(f"t{k}" for k in range(np.shape(C)[0])) if np.shape(C)[0] > 1 else ("t",)
    model = StateSpaceModel(
        names,
        (),
        outputs,
        A=A,
        B=B,
        C=C,
        dt=5.0,
        y0=list(y0),
        **({} if F is None else {"F": F, "terms": ("q*q",)}),
    )
    valid = dict.fromkeys(names, (low, 1.0))
    return Plant(
        model, {}, dt=5.0, units={**dict.fromkeys(names, "1"), **dict.fromkeys(outputs, "degC")}, valid=valid
    )


def spec_of(**changes) -> Spec:
    given = {"steps": [STEP], "hold_s": 35.0, "slew_per_s": 0.1, "sample_time_s": 5.0}
    return Spec(**{**given, "sensor_offset_degC": 0.0, "band_degC": 0.25, "output": "t"} | changes)


def soonest_of_all(plant: Plant, spec: Spec, levels: np.ndarray, step=STEP) -> tuple[float, float]:
    """Return the least arrival and the least settling [s] over every plan of these levels within the slew."""
    model, design = PredictionModel(plant, dt=plant.dt), spec.design(plant)
    n, slew = round(spec.hold_s / plant.dt), design.slew_per_s["q"] * plant.dt
    plans = np.array(list(product(levels, repeat=n)))
    moves = np.abs(np.diff(plans, prepend=0.0, axis=1))
    plans = plans[np.all(moves <= slew + 1e-9, axis=1)]
    x = np.repeat(model.rest([step[0]], np.zeros(0))[None], len(plans), axis=0)
    y, _ = model.run(x, plans[:, :, None], np.zeros(0))
    error = y[:, :, 0] - step[1]
    arrived = np.sign(step[1] - step[0]) * error >= -spec.band_degC
    inside = np.abs(error) <= spec.band_degC
    stays = np.logical_and.accumulate(inside[:, ::-1], axis=1)[:, ::-1]
    first = [np.where(ok.any(axis=1), np.argmax(ok, axis=1), np.inf).min() for ok in (arrived, stays)]
    return plant.dt * first[0], plant.dt * first[1]


@pytest.mark.parametrize(
    ("step", "known", "unknown", "seconds"),
    [
        ((20.0, 30.0), 0.0, 0.0, 9.75 / 0.1),
        ((30.0, 20.0), 0.0, 0.0, 9.75 / 0.03),  # a drive that cools by less than a third
        ((20.0, 30.0), 2.0, 0.0, 7.75 / 0.1),  # a sensor that reads 2 K too much is there sooner
        ((20.0, 30.0), -1.0, 0.5, 10.25 / 0.1),
        ((30.0, 20.0), -1.0, 0.5, 9.25 / 0.03),
    ],
)
def test_the_bound_is_of_what_the_sensor_reads_at_the_drive_of_that_side(
    step: tuple[float, float], known: float, unknown: float, seconds: float
):
    model = StateSpaceModel(("drive",), (), ("t",), A=[[1.0]], B=[[0.1]], C=[[1.0]], dt=1.0)
    plant = Plant(model, {}, dt=1.0, units={"drive": "1"}, valid={"drive": (-1.0, 1.0)}, offsets={"t": known})
    spec = spec_of(steps=[step], hold_s=400.0, slew_per_s=1.0, sample_time_s=2, sensor_offset_degC=unknown)
    design = replace(spec.design(plant), drive_range={"drive": (-0.3, 1.0)})
    assert full_drive_bound(plant, design, step, spec) == np.ceil(seconds - 1e-9)


def test_the_slew_counts_from_the_drive_that_holds_the_start():
    plant = plant_of([[0.95]], [[1.0]], [[1.0]])  # 20 K at full drive, 25 degC without
    spec = spec_of(steps=[(35.0, 40.0)], slew_per_s=0.02, hold_s=100.0)
    # 0.6, 0.7, 0.8, 0.9, 1: 11.40 K; of the 8.60 K to full drive 5.25 are left after ten samples more
    assert full_drive_bound(plant, spec.design(plant), (35.0, 40.0), spec) == 75.0


@pytest.mark.parametrize("step", [STEP, (25.0, 22.0)])
def test_no_plan_of_a_tank_with_a_lagging_skin_arrives_or_settles_sooner(step):
    A = [[0.97, 0.0], [0.25, 0.75]]
    plant = plant_of(A, [[2.2], [0.0]], [[0.0, 1.0]])
    spec = spec_of()
    bound = full_drive_bound(plant, spec.design(plant), step, spec)
    arrives, settles = soonest_of_all(plant, spec, np.array([-1.0, -0.5, 0.0, 0.5, 1.0]), step)
    assert bound == arrives  # the extremes are among these plans, and the plant is linear
    assert settles >= bound


def test_a_plant_that_first_goes_the_wrong_way_is_not_driven_flat_out():
    # heating cools at first: the output is a slow rise minus three fast dips
    A, B, C = [[0.95, 0.0], [0.0, 0.4]], [[1.6], [1.0]], [[1.0, -4.0]]
    plant = plant_of(A, B, C)
    spec = spec_of()
    bound = full_drive_bound(plant, spec.design(plant), STEP, spec)
    arrives, _ = soonest_of_all(plant, spec, np.array([-1.0, -0.5, 0.0, 0.5, 1.0]))
    assert bound == arrives
    flat_out = PredictionModel(plant, dt=5.0)
    plan = np.minimum(0.5 * np.arange(1, 31), 1.0)[None, :, None]
    y, _ = flat_out.run(flat_out.rest([25.0], np.zeros(0))[None], plan, np.zeros(0))
    assert plant.dt * np.argmax(y[0, :, 0] >= 28.75) > bound


def test_past_the_optimum_of_a_peltier_element_less_is_sooner():
    # cooling power q + 0.9 q^2 is largest at q = -0.56, and its half is left at full drive
    A = [[0.97, 0.0], [0.25, 0.75]]
    plant = plant_of(A, [[2.6], [0.0]], [[0.0, 1.0]], F=[[2.34], [0.0]])
    spec = spec_of(steps=[(25.0, 23.0)])
    bound = full_drive_bound(plant, spec.design(plant), (25.0, 23.0), spec)
    levels = np.array([-0.8, -0.6, -0.5, -0.3, 0.0])
    arrives, settles = soonest_of_all(plant, spec, levels, (25.0, 23.0))
    assert np.isfinite(arrives)
    assert bound <= arrives
    assert bound <= settles


def test_two_outputs_are_no_sooner_than_the_slower_of_them():
    A, B = np.diag([0.9, 0.97]), [[2.0, 0.1], [0.1, 0.7]]
    plant = plant_of(A, B, np.eye(2), y0=(25.0, 25.0))
    both, fast, slow = (
        spec_of(output=names, steps=[(25.0, 30.0)], hold_s=200.0) for names in (["t0", "t1"], "t0", "t1")
    )
    bound = [full_drive_bound(plant, s.design(plant), (25.0, 30.0), s) for s in (both, fast, slow)]
    assert bound[0] == max(bound[1:])
    assert bound[1] < bound[2]


def test_what_the_drive_cannot_hold_is_never():
    plant = plant_of([[0.9]], [[1.0]], [[1.0]])
    spec = spec_of(steps=[(25.0, 60.0)], hold_s=600.0)
    assert full_drive_bound(plant, spec.design(plant), (25.0, 60.0), spec) == np.inf


def test_a_drive_that_cannot_be_off_starts_from_the_least_that_it_gives():
    model = StateSpaceModel(("drive",), (), ("t",), A=[[1.0]], B=[[0.1]], C=[[1.0]], dt=1.0)
    plant = Plant(model, {}, dt=1.0, units={"drive": "1"}, valid={"drive": (0.0, 1.0)})
    spec = Spec(
        steps=[(20, 30)], hold_s=300.0, slew_per_s=0.1, sample_time_s=2, sensor_offset_degC=0.0,
        band_degC=0.25, output="t",
    )  # fmt: skip
    design = replace(spec.design(plant), drive_range={"drive": (0.4, 1.0)})
    # samples of 2 s at 0.6 and 0.8, then all: 0.12 + 0.16 K, and 9.47 K at 0.1 K/s
    assert full_drive_bound(plant, design, (20.0, 30.0), spec) == 4 + np.ceil(9.47 / 0.1)


def test_two_drives_one_of_which_cools_are_each_as_fast_as_its_slew():
    plant = plant_of(np.diag([0.9, 0.97]), [[2.0, 0.3], [-0.4, 0.7]], np.eye(2), y0=(25.0, 25.0))
    spec = spec_of(output=["t0", "t1"], sample_time_s=10.0, hold_s=50.0, band_degC=0.25)
    ranges, slews = {"q0": (-0.4, 1.0), "q1": (0.1, 0.9)}, {"q0": 0.02, "q1": 0.03}
    design = replace(spec.design(plant), drive_range=ranges, slew_per_s=slews)
    # -0.2, -0.4 (it cools) and 0.4, 0.7, 0.9, for 10 s each: 0.36, 0.71, 1.34, 1.95, 2.68, 3.39, 4.08 K
    assert full_drive_bound(plant, replace(design, controlled=("t1",)), STEP, spec) == 35.0
