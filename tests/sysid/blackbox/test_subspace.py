"""Subspace: exact without noise, its Hankel algebra by hand, several logs, refusals."""

from __future__ import annotations

import numpy as np
import pytest

from tests.sysid.models.makers import steady_gain
from thermogrip.datasets.schema import make_log
from thermogrip.sysid.blackbox.subspace import (
    _windows,
    extended_observability,
    parsim_family,
    stabilised,
    subspace_family,
)
from thermogrip.sysid.plant.log_grid import make_grid


def markov(A, B, C, n):
    """C A^k B, k = 0 .. n-1."""
    return np.stack([C @ np.linalg.matrix_power(A, k) @ B for k in range(n)])


@pytest.mark.parametrize("weighting", ["moesp", "cva"])
def test_without_noise_the_markov_parameters_are_those_of_the_plant(weighting, coupled, fit_one):
    log = coupled.log(800, reading=1e-7)  # which keeps the CVA weight regular
    model = fit_one("subspace", make_grid([log], average=1.0), orders=2, rows=8, variant=weighting)
    wanted = markov(coupled.A, coupled.B, coupled.C, 20)
    np.testing.assert_allclose(markov(model.A, model.B, model.C, 20), wanted, atol=2e-5)


def test_poles_and_gain_are_found_under_noise(coupled, fit_one):
    grid = make_grid([coupled.log(3000, reading=0.05)], average=1.0)
    model = fit_one("subspace", grid, orders=2, rows=15, variant="moesp")
    poles = np.sort(np.linalg.eigvals(coupled.A))
    np.testing.assert_allclose(np.sort(np.abs(model.poles())), poles, atol=0.01)
    gain = coupled.C @ np.linalg.solve(np.eye(2) - coupled.A, coupled.B)
    np.testing.assert_allclose(steady_gain(model), gain, rtol=0.03, atol=0.1)


def test_gamma_of_a_known_system_is_returned_up_to_a_basis():
    C, A = np.array([[1.0, 0.0]]), np.array([[0.9, 0.2], [0.0, 0.5]])
    gamma = np.vstack([C @ np.linalg.matrix_power(A, k) for k in range(5)])
    X = np.random.default_rng(0).standard_normal((2, 12))
    found = extended_observability(gamma @ X, np.zeros((5, 1)), weighting="moesp")
    assert np.sum(np.linalg.norm(found, axis=0) > 1e-5) == 2
    basis = np.linalg.lstsq(found[:, :2], gamma, rcond=None)[0]
    np.testing.assert_allclose(found[:, :2] @ basis, gamma, atol=1e-12)
    shift = np.linalg.lstsq(found[:4, :2], found[1:, :2], rcond=None)[0]
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(shift).real), [0.5, 0.9], atol=1e-9)


def test_a_window_with_a_lost_reading_is_left_out_and_the_rest_suffices(coupled, fit_one):
    log = coupled.log(1500, reading=1e-7)
    log["t1"].values[700:705] = np.nan
    model = fit_one("subspace", make_grid([log], average=1.0), orders=2, rows=8, variant="moesp")
    poles = np.sort(np.linalg.eigvals(coupled.A))
    np.testing.assert_allclose(np.sort(np.abs(model.poles())), poles, atol=1e-5)


def test_rounding_changes_no_model_of_an_input_that_moves_once():
    rng = np.random.default_rng(8)
    q, k = np.repeat([0.0, 1.0], [2, 298]), np.arange(300)
    y = 60 - 35 * 0.98**k + 3 * 0.9**k + 0.2 * rng.standard_normal(300)
    found = []
    for size in (0.0, 1e-12):
        off = 1 + size * rng.standard_normal((2, 300))
        signals = {"q": (q * off[0], "1", "input"), "t": (y * off[1], "degC", "output")}
        log = make_log(k.astype(float), signals)
        found.append(subspace_family(make_grid([log], average=1.0), orders=(1, 2, 3), rows=(3, 8)))
    assert len(found[0]) == 2 * (2 + 3)
    for structure, model in found[0].items():
        other = found[1][structure]
        want = markov(model.A, model.spread, model.C, 9) @ model.C.T
        np.testing.assert_allclose(markov(other.A, other.spread, other.C, 9) @ other.C.T, want, rtol=1e-6)


def test_a_structure_with_a_term_has_one_number_more_for_each_state():
    log = make_log(
        np.arange(400.0),
        {
            "q": (np.repeat(np.random.default_rng(5).uniform(-1, 1, 40), 10), "1", "input"),
            "t": (25 + np.random.default_rng(6).standard_normal(400), "degC", "output"),
        },
    )
    family = subspace_family(make_grid([log], average=1.0), orders=(1, 2), rows=(8,), terms=((), ("|q|",)))
    sizes = {structure.label: structure.size for structure in family}
    plain = {label: size for label, size in sizes.items() if "with" not in label}
    assert plain
    for label, size in plain.items():
        order = int(label.split()[1].rstrip(","))
        assert size == order * (1 + 1 + 1)  # of input, output and offset
        assert sizes.get(f"{label}, with |q|", size + order) == size + order
    assert any("with |q|" in label for label in sizes)


@pytest.mark.parametrize(
    ("poles", "expected"),  # 50 rows: the circle exp(-1/50) = 0.9802
    [
        ((0.5, 0.9), (0.5, 0.9)),
        ((0.5, 0.99), (0.5, 0.9802)),
        ((-1.3, 1.1), (-0.9802, 0.9802)),
        ((0.98, 0.981), (0.98, 0.9802)),
    ],
)
def test_poles_slower_than_the_record_are_moved_along_their_direction(poles, expected):
    basis = np.array([[1.0, 0.4], [-0.3, 2.0]])
    A = stabilised(basis @ np.diag(poles) @ np.linalg.inv(basis), 50)
    np.testing.assert_allclose(np.linalg.inv(basis) @ A @ basis, np.diag(expected), atol=3e-5)


def test_a_pair_of_growing_poles_keeps_its_angle_and_a_defective_one_is_stable():
    turn = 1.2 * np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    np.testing.assert_allclose(stabilised(turn, 100), turn * np.exp(-0.01) / 1.2, atol=1e-12)
    A = stabilised(np.array([[1.01, 1.0], [0.0, 1.01]]), 100)
    assert np.abs(np.linalg.eigvals(A)).max() < 1


def test_each_structure_is_stable_whatever_the_record(coupled):
    log = coupled.log(1000, reading=0.05)
    log["t1"].values[:] += 2e-5 * np.arange(1000.0) ** 2  # a drift that no input explains
    family = subspace_family(make_grid([log], average=1.0), orders=(1, 2, 3), rows=(8,), terms=((),))
    assert len(family) == 6
    assert all(model.stable for model in family.values())


def test_too_few_windows_give_no_model(coupled):
    assert not subspace_family(make_grid([coupled.log(60)], average=1.0), orders=(2,), rows=(15,))


def test_a_window_has_future_and_past_drives_a_constant_and_past_and_future_readings():
    z = np.arange(15.0).reshape(5, 3)  # two drives and a reading
    wanted = [[6, 7, 9, 10, 1, 0, 1, 3, 4, 2, 5, 8, 11], [9, 10, 12, 13, 1, 3, 4, 6, 7, 5, 8, 11, 14]]
    assert _windows(z, 2, 2).tolist() == wanted
    z[0, 2] = np.nan
    assert _windows(z, 2, 2).tolist() == wanted[1:]


def test_parsim_is_consistent_under_feedback_and_moesp_is_not():
    pole, K, errors = 0.9, 0.6, {"moesp": [], "parsim": []}
    for seed in range(3):
        rng = np.random.default_rng(seed)
        r, e = 0.5 * rng.standard_normal((2, 4000))
        x, y, q = np.zeros(2), np.zeros(4000), np.zeros(4000)
        for k in range(4000):
            y[k] = x[0] + e[k]
            q[k] = r[k] - 0.5 * y[k]  # a proportional controller
            x = np.array([pole * x[0] + x[1] + K * e[k], 0.5 * x[1] + 0.4 * q[k]])
        signals = {"q": (q, "1", "input"), "t": (y, "degC", "output")}
        grid = make_grid([make_log(np.arange(4000.0), signals)], average=1.0)
        for weighting, off in errors.items():
            found = subspace_family(grid, orders=(2,), rows=(8,), terms=((),), weightings=(weighting,))
            off.append(np.abs(next(iter(found.values())).poles()).max() - pole)
    assert np.abs(errors["parsim"]).max() < 0.04
    assert np.max(errors["moesp"]) < -0.1


def test_parsim_finds_the_markov_parameters_of_the_plant_without_feedback(coupled):
    grid = make_grid([coupled.log(3000, reading=1e-3)], average=1.0)
    (model,) = parsim_family(grid, orders=(2,), rows=(15,), terms=((),)).values()
    wanted = markov(coupled.A, coupled.B, coupled.C, 20)
    np.testing.assert_allclose(markov(model.A, model.B, model.C, 20), wanted, atol=2e-3)
