"""Subspace: exact without noise, its Hankel algebra by hand, several logs, honest refusals."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import make_log
from thermogrip.sysid.blackbox.subspace import extended_observability, subspace_family, subspace_model
from thermogrip.sysid.plant.log_grid import make_grid

_SPEC = importlib.util.spec_from_file_location(
    "blackbox_truth", Path(__file__).parents[1] / "blackbox_truth.py"
)
truth = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(truth)


def markov(A, B, C, n):
    """C A^k B, k = 0 .. n-1."""
    return np.stack([C @ np.linalg.matrix_power(A, k) @ B for k in range(n)])


@pytest.mark.parametrize("weighting", ["moesp", "cva"])
def test_without_noise_the_markov_parameters_are_those_of_the_plant(weighting):
    log, (A, B, C) = truth.mimo_log(800, noise=0.0)
    # a trace of noise keeps the CVA weight regular
    for name in ("t1", "t2"):
        log[name].values[:] += 1e-7 * np.random.default_rng(1).standard_normal(800)
    model = subspace_model(make_grid([log], average=1.0), order=2, rows=8, weighting=weighting)
    np.testing.assert_allclose(markov(model.A, model.B, model.C, 20), markov(A, B, C, 20), atol=2e-5)


def test_poles_and_gain_are_found_under_noise():
    log, (A, B, C) = truth.mimo_log(3000, noise=0.05)
    model = subspace_model(make_grid([log], average=1.0), order=2, rows=15)
    np.testing.assert_allclose(np.sort(np.abs(model.poles())), np.sort(np.linalg.eigvals(A)), atol=0.01)
    want = C @ np.linalg.solve(np.eye(2) - A, B)
    np.testing.assert_allclose(model.gain(), want, rtol=0.03, atol=0.1)


def test_gamma_of_a_known_system_is_returned_up_to_a_basis():
    C, A = np.array([[1.0, 0.0]]), np.array([[0.9, 0.2], [0.0, 0.5]])
    gamma = np.vstack([C @ np.linalg.matrix_power(A, k) for k in range(5)])
    X = np.random.default_rng(0).standard_normal((2, 12))
    found, sizes = extended_observability(gamma @ X, np.zeros((5, 1)), n_y=1, weighting="moesp")
    assert np.sum(sizes > 1e-10) == 2
    basis = np.linalg.lstsq(found[:, :2], gamma, rcond=None)[0]
    np.testing.assert_allclose(found[:, :2] @ basis, gamma, atol=1e-12)
    shift = np.linalg.lstsq(found[:4, :2], found[1:, :2], rcond=None)[0]
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(shift).real), [0.5, 0.9], atol=1e-9)


def test_a_window_with_a_lost_reading_is_left_out_and_the_rest_suffices():
    log, (A, _, _) = truth.mimo_log(1500, noise=0.0)
    for name in ("t1", "t2"):
        log[name].values[:] += 1e-7 * np.random.default_rng(1).standard_normal(1500)
    log["t1"].values[700:705] = np.nan
    model = subspace_model(make_grid([log], average=1.0), order=2, rows=8)
    np.testing.assert_allclose(np.sort(np.abs(model.poles())), np.sort(np.linalg.eigvals(A)), atol=1e-5)


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


def test_the_family_holds_no_unstable_model():
    log, _ = truth.mimo_log(1000, noise=0.05)
    family = subspace_family(make_grid([log], average=1.0), orders=(1, 2, 3), rows=(8,))
    assert family
    assert all(model.stable for model in family.values())


def test_too_few_windows_and_unknown_weights_are_refused():
    log, _ = truth.mimo_log(60)
    with pytest.raises(UserError, match="too few whole windows"):
        subspace_model(make_grid([log], average=1.0), order=2, rows=15)
    with pytest.raises(ValueError, match="weighting"):
        extended_observability(np.eye(3), np.eye(3), n_y=1, weighting="n4sid")
