"""What the innovations of a plant's logs say of its noise, on logs whose noise is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermogrip.datasets.schema import Log, make_log
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.innovations import innovation_noise
from thermogrip.sysid.plant.plant import Plant

DT, N = 2.0, 3000


def heater() -> Plant:
    a = float(np.exp(-DT / 60.0))
    model = StateSpaceModel(("q",), (), ("t",), A=[[a]], B=[[0.6 * (1 - a)]], C=[[1.0]], dt=DT, y0=[25.0])
    return Plant(model, {}, dt=DT, units={"q": "percent", "t": "degC"}, noise={"t": 0.1})


def logged(state: float, bias: float, reading: float) -> Log:
    """Return a log of the heater with noise of its state, of what its drive lacks, and of readings."""
    rng, plant = np.random.default_rng(3), heater()
    q = np.repeat(rng.choice([0.0, 30.0, 60.0], N // 50), 50)
    x, w, y = 0.0, 0.0, []
    A, B = plant.model.A[0, 0], plant.model.B[0, 0]
    for u in q:
        y.append(25.0 + x + reading * rng.standard_normal())
        x = A * x + B * (u + w) + state * DT**0.5 * rng.standard_normal()
        w += bias * DT**0.5 * rng.standard_normal()
    return make_log(DT * np.arange(N), {"q": (q, "percent", "input"), "t": (np.array(y), "degC", "output")})


@pytest.mark.parametrize(
    ("state", "bias", "reading"), [(0.0, 0.0, 0.05), (0.05, 0.0, 0.05), (0.0, 0.5, 0.3), (0.02, 0.2, 0.02)]
)
def test_noise_is_found_as_it_was(state: float, bias: float, reading: float):
    found = innovation_noise(heater(), [logged(state, bias, reading)])
    assert found.reading["t"] == pytest.approx(reading, rel=0.25)
    assert found.state == pytest.approx(state, rel=0.5, abs=0.1 * reading)
    assert found.input["q"] == pytest.approx(bias, rel=0.5, abs=0.1)
    assert found.fastest == {"q": 60.0 / DT}


def test_noise_is_the_same_in_any_coordinates_of_the_states():
    T, spread = np.array([[1.0, 0.5], [3.0, -2.0]]), np.array([[4.0, 3.8], [3.8, 4.0]])
    A, B, C = np.array([[0.97, 0.0], [0.4, 0.6]]), np.array([[0.02], [0.0]]), np.array([[0.0, 1.0]])
    lagged = replace(heater().model, A=A, B=B, C=C, c=[0.0, 0.0], spread=spread)
    back = np.linalg.inv(T)
    moved = replace(lagged, A=T @ A @ back, B=T @ B, C=C @ back, spread=T @ spread @ T.T)
    log = logged(0.05, 0.0, 0.05)
    one, other = (innovation_noise(replace(heater(), model=model), [log]) for model in (lagged, moved))
    assert other.state == pytest.approx(one.state, rel=1e-3) != 0.0
    assert (other.input, other.reading) == (pytest.approx(one.input, rel=1e-3), pytest.approx(one.reading))


@pytest.mark.parametrize(
    ("a", "b", "course", "sd"),  # of which LAPACK fails on one ratio
    [
        ([2.272, -1.5653, 0.2933], [1.696, -1.674, 0.0], [1.0, -1.96, 0.96], 3.0),
        ([2.957, -2.9145, 0.9575], [0.03, -0.03, 0.0], [1.0, -1.957, 0.9575], 0.1),
    ],
)
def test_a_filter_that_does_not_settle_leaves_those_that_do(
    a: list[float], b: list[float], course: list[float], sd: float
) -> None:
    A, spread = np.column_stack([a, np.eye(3)[:, :2]]), 240.0 * np.outer(course, course)
    B, C = np.reshape(b, (3, 1)), np.eye(3)[:1]
    model = StateSpaceModel(("q",), (), ("t",), A=A, B=B, C=C, dt=5.0, y0=[25.0], spread=spread)
    plant, log = replace(heater(), model=model, dt=5.0, noise={"t": sd}), logged(0.05, 0.0, 0.05)
    found = innovation_noise(plant, [log.assign(q=log["q"] / 60)])
    assert 0 < found.reading["t"] < np.inf


def test_lost_readings_and_two_logs_change_little():
    log = logged(0.05, 0.0, 0.05)
    holes = log.copy(deep=True)
    holes["t"].values[100:180] = np.nan
    one, other = innovation_noise(heater(), [log]), innovation_noise(heater(), [holes, log])
    assert other.state == pytest.approx(one.state, rel=0.3)
    assert other.reading["t"] == pytest.approx(one.reading["t"], rel=0.1)


def test_without_a_noise_to_begin_with_or_an_input_that_moves_nothing_is_said():
    log = logged(0.0, 0.0, 0.05)
    assert innovation_noise(replace(heater(), noise={}), [log]) is None
    log["q"].values[:] = 30.0
    assert innovation_noise(heater(), [log]) is None
