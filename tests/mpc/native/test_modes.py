"""The modes in which the C keeps the covariance of a linear plant."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import block_diag

from tests.mpc.makers import make_tank
from thermogrip.datasets.arrays import Array
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.native.design_struct import filter_modes
from thermogrip.mpc.native.modes import modes_of
from thermogrip.mpc.native.runtime import CompiledController, compiler
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant


def plant_of(A: Array, heated: tuple[int, ...], read: tuple[int, ...]) -> Plant:
    """Return a plant with states that are heated and read, and a room that all feel."""
    n = len(A)
    B, C = np.eye(n)[:, list(heated)], np.eye(n)[list(read)]
    drives, outputs = (tuple(f"{kind}{k}" for k in at) for kind, at in (("q", heated), ("t", read)))
    E = 0.01 * np.ones((n, 1))
    offsets = [20.0] * len(read)
    model = StateSpaceModel(drives, ("room",), outputs, A=A, B=B, C=C, E=E, dt=1.0, y0=offsets)
    ends = dict.fromkeys(drives, (0.0, 1.0))
    return Plant(model, {}, dt=1.0, units=dict.fromkeys(drives, "1"), valid=ends)


def swinging(n: int = 13) -> Array:
    """Return a plant with three pairs of poles that swing, its states a mixture of all modes."""
    pairs = [
        r * np.array([[np.cos(w), np.sin(w)], [-np.sin(w), np.cos(w)]]) for r, w in ((0.9, 0.3), (0.6, 1.0))
    ]
    pairs.append(np.array([[0.7, 0.5], [-0.1, 0.7]]))
    own = block_diag(*pairs, np.diag(np.linspace(0.2, 0.97, n - 6)))
    mixed = np.eye(n) + 0.3 * np.random.default_rng(5).normal(size=(n, n)) / np.sqrt(n)
    return np.asarray(np.linalg.solve(mixed, own @ mixed))


def chain_of_delays(n: int = 10) -> Array:
    """Return a mass behind a tube of shift registers."""
    A = np.eye(n, k=-1)
    A[-1, -1] = 0.9
    return A


def test_a_sample_is_tridiagonal_in_modes_and_pairs_of_poles_swing():
    plant = plant_of(swinging(), (0,), (3,))
    controller = Controller(plant, default_design(plant))
    model = controller.model
    modes = filter_modes(controller)
    assert modes is not None
    assert model.affine is not None
    A = model.affine[0]
    assert np.count_nonzero(np.linalg.eigvals(A).imag) == 6
    before, own, behind = modes.step
    banded = np.diag(own) + np.diag(before[1:], -1) + np.diag(behind[:-1], 1)
    np.testing.assert_allclose(modes.states @ banded @ modes.inverse, A, atol=1e-13)
    assert np.linalg.norm(modes.states / controller.observer.unit[:, None], axis=0) == pytest.approx(1.0)
    P = np.random.default_rng(0).normal(size=(model.n_x + 2, model.n_x + 2))
    np.testing.assert_allclose(modes.out_of(modes.into(P)), P, atol=1e-12)
    np.testing.assert_array_equal(modes.into(P)[model.n_x :, model.n_x :], P[model.n_x :, model.n_x :])


@pytest.mark.parametrize(
    "A", [chain_of_delays(), np.eye(9), 0.9 * np.eye(5)], ids=["no full set", "does not settle", "few states"]
)
def test_a_plant_without_good_modes_keeps_its_states(A):
    model = SimpleNamespace(n_x=len(A), affine=(A, None, None, None))
    assert modes_of.__wrapped__(model, (1.0,) * len(A)) is None


def test_a_plant_that_is_not_linear_has_no_modes():
    assert filter_modes(Controller(make_tank(joule=0.05))) is None
    plant = plant_of(swinging(), (0,), (3,))
    assert filter_modes(Controller(plant, default_design(plant)), single=True) is None


@pytest.mark.skipif(compiler() is None, reason="no gcc here")
def test_the_filter_in_modes_is_the_filter_in_states():
    """Readings lost, between samples and at them, biases held: all as in Python."""
    plant = plant_of(swinging(), (0, 12), (2, 10, 5))
    design = default_design(plant, controlled=("t2", "t10"))
    python, c = Controller(plant, design), Controller(plant, design, compiled=True)
    inside = c.observer.__dict__["_c"]
    assert isinstance(inside, CompiledController)
    assert inside.modes is not None
    rng, d = np.random.default_rng(2), np.array([24.0])
    for part in (python.observer, c.observer):
        part.reset_in_room(np.array([25.0, 26.0, 25.5]), d)
    for k in range(60):
        u, y = rng.uniform(0, 1, 2), python.observer.reading() + 0.5 * rng.normal(size=3)
        y[rng.random(3) < 0.2] = np.nan
        weak = rng.random(2) < 0.3
        between = []
        for part in (python.observer, c.observer):
            part.hold_drives(weak)
            part.predict(u, d)
            part.update(y)
            if k % 3:
                part.advance(0.4, u, d)
                part.look(d)
                part.refine(y)
                between.append(part.now)
                part.advance(0.6, u, d)
        np.testing.assert_allclose(between[1:], between[:-1], atol=1e-10)
        for name in ("x", "w", "output_bias"):
            one, two = getattr(python.observer, name), getattr(c.observer, name)
            np.testing.assert_allclose(two, one, atol=1e-10, err_msg=name)
        P = python.observer.estimate()["P"]
        np.testing.assert_allclose(c.observer.estimate()["P"], P, rtol=0.0, atol=1e-11 * P.max())
    inside.reset(y := np.array([25.0, 26.0, 25.5]), d, python.observer)
    np.testing.assert_allclose(inside.covariance(), P, rtol=0.0, atol=1e-11 * P.max())
    inside.reset(y, d)  # the start in C
    python.observer.reset_in_room(y, d)
    np.testing.assert_allclose(inside.view("x", python.observer.x.shape), python.observer.x, atol=1e-10)
    P = python.observer.estimate()["P"]
    np.testing.assert_allclose(inside.covariance(), P, rtol=0.0, atol=1e-11 * P.max())
