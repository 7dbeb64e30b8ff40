"""Gains, time constants and responses against scipy, python-control, closed forms, plants of known spread."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.experiment.information import plant_from_prior
from thermogrip.sysid.export.dynamics import plant_dynamics
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

FAST, SLOW = np.exp(-2.0 / 8.0), np.exp(-2.0 / 50.0)  # steps of 2 s: 8 s and 50 s


def two_by_two(scale=1.0):
    """Return two outputs of lags of 50 s and 8 s, the second heated by v alone, 6 s late, by -3 K/percent."""
    A = np.diag([SLOW, FAST, 0, 0, 0]) + np.diag([0, 1.0, 1, 1], 1)
    B = scale * np.array([[4 * (1 - SLOW), 1 - SLOW], [0, 0], [0, 0], [0, 0], [0, -3 * (1 - FAST)]])
    C = [[1, 0, 0, 0, 0], [0, 1, 0, 0, 0]]
    return StateSpaceModel(("u", "v"), (), ("hot", "level"), A=A, B=B, C=C, dt=2.0, y0=[20.0, 0.0])


UNITS = {"u": "V", "v": "percent", "hot": "degC", "level": "1"}
SPREAD = np.array([0.9, 1.1] * 4)  # gains of eight refits: 10 % off, of both signs
PLANT = Plant(two_by_two(), {}, dt=2.0, units=UNITS, refits=tuple(two_by_two(s) for s in SPREAD))


def test_gains_times_and_poles_are_those_of_the_lags():
    found = plant_dynamics(PLANT)
    np.testing.assert_allclose(found.gain.value, [[4.0, 1.0], [0.0, -3.0]], atol=1e-9)
    np.testing.assert_allclose(found.time_constants, [50.0, 8.0], rtol=1e-6)
    np.testing.assert_allclose(found.poles, [-0.02, -0.125], rtol=1e-6)
    np.testing.assert_array_equal(found.dead_time, [[0.0, 0.0], [np.nan, 6.0]])
    # to the step after 1 - 1/e; of 2000 points of at least one step
    np.testing.assert_allclose(found.rise_time, [[50.0, 50.0], [np.nan, 14.0]], atol=1.01)
    first = found.rows()[0]
    assert {key: first[key] for key in ("input", "output", "unit", "dead_time_s")} == {
        "input": "u", "output": "hot", "unit": "K/V", "dead_time_s": 0.0,
    }  # fmt: skip
    assert [row["unit"] for row in found.rows()] == ["K/V", "1/V", "K/percent", "1/percent"]
    assert found.rows()[1]["dead_time_s"] is None
    assert found.rows()[1]["rise_time_s"] is None


def test_responses_in_json_are_those_of_each_pair_and_have_no_ends_without_draws():
    found, answer = plant_dynamics(PLANT), plant_dynamics(PLANT).to_dict()
    time, step = found.step_response(60)
    omega, size, phase = found.frequency_response(60)
    steps, waves = answer["step_responses"], answer["frequency_responses"]
    assert (steps["time_s"], waves["rad_per_s"]) == (time.tolist(), omega.tolist())
    names = [("u", "hot"), ("u", "level"), ("v", "hot"), ("v", "level")]
    assert [(pair["input"], pair["output"]) for pair in steps["pairs"]] == names
    assert [(pair["input"], pair["output"]) for pair in waves["pairs"]] == names
    late, wave = steps["pairs"][3], waves["pairs"][3]
    assert late["value"][-1] == pytest.approx(-3.0, rel=1e-6)
    assert (late["low"], late["high"]) == (step.low[:, 1, 1].tolist(), step.high[:, 1, 1].tolist())
    assert wave["magnitude"] == size.value[:, 1, 1].tolist()
    assert wave["magnitude_high"] == size.high[:, 1, 1].tolist()
    assert wave["phase_deg"] == phase.value[:, 1, 1].tolist()
    assert wave["phase_deg_low"] == phase.low[:, 1, 1].tolist()
    alone = plant_dynamics(replace(PLANT, refits=())).to_dict()["step_responses"]["pairs"][3]
    assert (alone["value"], alone["low"], alone["high"]) == (late["value"], None, None)


def test_a_pair_of_complex_poles_is_one_oscillation():
    poles = np.exp(2.0 * (-0.05 + 0.3j)), np.exp(2.0 * (-0.05 - 0.3j))
    A = np.array([[2 * poles[0].real, -(abs(poles[0]) ** 2)], [1.0, 0.0]])
    swing = StateSpaceModel(("u",), (), ("y",), A=A, B=[[1.0], [0.0]], C=[[0.0, 1.0]], dt=2.0)
    found = plant_dynamics(Plant(swing, {}, dt=2.0))
    np.testing.assert_allclose(found.time_constants, [20.0, 20.0], rtol=1e-6)
    np.testing.assert_allclose(np.abs(found.poles.imag), 0.3, rtol=1e-6)


@pytest.mark.parametrize(
    ("logs", "between"), [((), 0.0), (("a",), 0.05), (("a", "b"), 0.05), (tuple("abc"), 0.0)]
)
def test_intervals_are_of_the_draws_and_of_what_few_logs_cannot_show(logs, between):
    found = plant_dynamics(replace(PLANT, logs=logs), draws=8)
    half = 1.6448536 * 4.0 * np.hypot(0.1, between)
    assert (found.gain.low[0, 0], found.gain.high[0, 0]) == pytest.approx((4 - half, 4 + half), rel=1e-5)
    assert found.to_dict()["gain_sd_between_runs"] == between
    _, step = found.step_response(50)
    np.testing.assert_allclose(step.high - step.value, np.abs(step.value) * half / 4, rtol=1e-5, atol=1e-9)
    _, size, phase = found.frequency_response(20)
    np.testing.assert_allclose(size.low, size.value * (1 - half / 4), rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(phase.low, phase.high, atol=1e-6)  # the refits differ in gain alone


@pytest.mark.parametrize("refits", [0, 7])
def test_a_plant_of_few_draws_has_no_intervals(refits):
    found = plant_dynamics(replace(PLANT, refits=PLANT.refits[:refits], logs=("a",)), draws=refits)
    assert np.isnan(found.gain.low).all()
    assert np.isnan(found.gain.high).all()
    assert found.rows()[0]["low"] is None


def test_disturbances_have_a_gain_without_the_spread_between_runs():
    room = StateSpaceModel(
        ("u",), ("t_room",), ("t",), A=[[0.9]], B=[[0.2]], E=[[0.1]], C=[[1.0]], dt=1.0, y0=[0.0]
    )
    units = {"u": "1", "t_room": "degC", "t": "degC"}
    plant = Plant(
        room, {}, dt=1.0, units=units, refits=(room,) * 8, logs=("a",), valid={"t_room": (10.0, 20.0)}
    )
    found = plant_dynamics(plant)
    assert found.linear.inputs == ("u", "t_room")
    assert found.to_dict()["operating_point"] == {"u": 0.0, "t_room": 15.0}
    assert [row["unit"] for row in found.rows()] == ["K", "1"]
    np.testing.assert_allclose(found.gain.value, [[2.0, 1.0]], rtol=1e-6)
    np.testing.assert_allclose(found.gain.high - found.gain.value, [[1.6448536 * 0.1, 0.0]], atol=1e-6)


def test_responses_of_a_network_are_those_of_scipy_and_python_control():
    plant = plant_from_prior(load_network("tclab"))
    point = {"inputs": {"q1": 30.0, "q2": 20.0}}
    found, system = plant_dynamics(plant, **point, draws=0), plant.to_scipy(**point, dt=plant.dt)
    time, step = found.step_response(40)
    every = round(time[1] / plant.dt)
    _, answers = signal.dstep(system, n=40 * every + 1)
    for j, answer in enumerate(answers[:2]):
        np.testing.assert_allclose(step.value[:, :, j], answer[::every], rtol=1e-7, atol=1e-9)
    assert time[-1] == pytest.approx(5 * found.time_constants[0], rel=0.04)  # whole steps
    omega, size, phase = found.frequency_response(30)
    wanted = plant.to_control(**point, dt=plant.dt).frequency_response(omega).complex
    np.testing.assert_allclose(size.value, np.moveaxis(np.abs(wanted), 2, 0), rtol=1e-6)
    turned = (phase.value - np.degrees(np.moveaxis(np.angle(wanted), 2, 0)) + 180) % 360 - 180
    np.testing.assert_allclose(turned, 0.0, atol=1e-5)
    assert omega[0] == pytest.approx(0.1 / found.time_constants[0])
    assert omega[-1] == pytest.approx(np.pi / plant.dt)


def test_the_phase_of_a_negative_gain_begins_at_half_a_turn_behind():
    _, _, phase = plant_dynamics(PLANT).frequency_response()
    assert phase.value[0, 0, 0] == pytest.approx(0.0, abs=8.0)
    assert phase.value[0, 1, 1] == pytest.approx(-180.0, abs=4.0)
    assert np.all(np.diff(phase.value[:, 1, 1]) < 0)  # a delay of three steps turns on and on


@pytest.mark.parametrize(
    ("valid", "middle"),
    [((10.0, 50.0), 30.0), ((-1.0, 1.0), 0.5), ((-3.0, -1.0), -2.0), ((-2.0, 0.0), -1.0), ((0.0, 8.0), 4.0)],
)
def test_the_point_is_the_middle_of_the_logs_on_one_side_of_zero(valid, middle):
    found = plant_dynamics(replace(PLANT, valid={"u": valid}), inputs={"v": 7.0})
    assert found.to_dict()["operating_point"] == {"u": pytest.approx(middle), "v": pytest.approx(7.0)}
    assert found.to_dict()["at_rest"]["hot"] == pytest.approx(20 + 4 * middle + 7.0)


def test_an_input_that_the_plant_does_not_have_is_refused():
    with pytest.raises(UserError, match="no w"):
        plant_dynamics(PLANT, inputs={"w": 1.0})


def test_a_plant_that_runs_away_has_no_gains():
    grows = StateSpaceModel(("u",), (), ("y",), A=[[1.02]], B=[[1.0]], C=[[1.0]], dt=1.0)
    with pytest.raises(UserError, match="runs away"):
        plant_dynamics(Plant(grows, {}, dt=1.0))


def test_a_draw_that_runs_away_is_left_out():
    grows = replace(two_by_two(), A=np.diag([1.02, FAST, 0, 0, 0]))
    found = plant_dynamics(replace(PLANT, refits=(*PLANT.refits, grows)), draws=30)
    assert 8 <= len(found.draws) < 30


def test_an_input_acts_for_certain_where_no_draw_is_as_far_from_the_plant_as_the_plant_from_0():
    def made(gain):
        return StateSpaceModel(("a", "b"), (), ("t",), A=[[0.9]], B=[[1.0, gain]], C=[[1.0]], dt=1.0)

    for gain, acts in ((0.3, False), (3.0, True), (-3.0, True)):
        refits = tuple(made(gain + off) for off in np.linspace(-1.0, 1.0, 9))
        plant = Plant(made(gain), {}, dt=1.0, refits=refits)
        assert plant_dynamics(plant).is_certain.tolist() == [True, acts]
        assert plant_dynamics(plant, draws=3).is_certain.all()  # too few say nothing
