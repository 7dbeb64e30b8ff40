"""Parts of a prediction one by one: two drives, a room, an offset of the readings, steps of a third."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.mpc.export.test_export import kit
from thermogrip.mpc.design.spec import Spec
from thermogrip.mpc.plant.prediction import PredictionModel
from thermogrip.mpc.tuning.minimum_time import full_drive_bound
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

A = np.array([[0.9, 0.05, 0.0], [0.0, 0.8, 0.1], [0.1, 0.0, 0.7]])
B, E = np.array([[0.4, 0.0], [0.1, 0.3], [0.0, 0.2]]), np.array([[0.05], [0.1], [0.2]])
C = np.array([[1.0, 0.0, 0.5]])


def two_drives() -> Plant:
    model = StateSpaceModel(
        ("q", "r"), ("room",), ("t",), A=A, B=B, C=C, E=E, c=-25.0 * E[:, 0], dt=0.1, y0=[25.0]
    )
    units = {"q": "1", "r": "1", "room": "degC", "t": "degC"}
    return Plant(model, {}, dt=0.1, units=units, valid={"q": (0.0, 1.0), "r": (0.0, 1.0)})


@pytest.mark.parametrize(("asked", "dt"), [(0.3, 0.3), (0.7, 0.7), (0.26, 0.3), (0.04, 0.1)])
def test_a_sample_is_the_nearest_number_of_whole_steps(asked: float, dt: float):
    assert PredictionModel(two_drives(), dt=asked).dt == pytest.approx(dt)


def test_slopes_of_a_sample_are_those_of_its_steps():
    model = PredictionModel(two_drives(), dt=0.3)
    x, u, d = np.array([1.0, -2.0, 3.0]), np.array([0.2, 0.7]), np.array([22.0])
    after, a, b, e = model.linearise(x, u, d)
    more = np.eye(3) + A + A @ A
    np.testing.assert_allclose(a, np.linalg.matrix_power(A, 3), atol=1e-9)
    np.testing.assert_allclose(b, more @ B, atol=1e-9)
    np.testing.assert_allclose(e, more @ E, atol=1e-9)
    np.testing.assert_allclose(after, a @ x + b @ u + e @ (d - 25.0), atol=1e-9)
    np.testing.assert_allclose(model.C, C, atol=1e-12)  # whatever is read at nought
    y, G = model.trajectory(x, np.array([u, [0.0, 1.0]]), d, [1, 2])
    exact = model.trajectory_exact(x, np.array([u, [0.0, 1.0]]), d, [1, 2])
    np.testing.assert_allclose(y, exact[0], atol=1e-9)
    np.testing.assert_allclose(G, exact[1], atol=1e-9)
    np.testing.assert_allclose(G[2, 0], [(C @ a @ a @ b)[0], (C @ a @ b + C @ b)[0]], atol=1e-9)
    np.testing.assert_allclose(model.dc_gain(u, d), C @ np.linalg.solve(np.eye(3) - A, B), atol=1e-7)


def test_several_steps_in_a_sample_have_the_slopes_of_all_of_them():
    model = PredictionModel(kit().plant, dt=10.0)
    assert model.sub == 2
    x, d = model.rest([35.0, 30.0], np.zeros(model.n_d)), np.zeros(model.n_d)
    plan = np.array([[40.0, 10.0], [0.0, 60.0]])
    y, G = model.trajectory(x, plan, d, [2, 3])
    exact = model.trajectory_exact(x, plan, d, [2, 3])
    np.testing.assert_allclose(y, exact[0], atol=1e-9)
    np.testing.assert_allclose(G, exact[1], atol=1e-9)


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
