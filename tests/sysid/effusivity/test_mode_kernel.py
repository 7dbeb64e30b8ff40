"""The small parts of the compiled search, run as plain Python, against linear algebra and densities."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm
from scipy.stats import t as student_t

from thermogrip.sysid.effusivity import mode_kernel as kernel

SD = np.array([0.3, 0.5, 0.1, 3.0, 0.4, 0.0, 0.2])
DOF = np.array([np.inf, 6.0, 4.0, np.inf, np.inf, 5.0, np.inf])


@pytest.fixture(scope="module")
def matrix():
    """A positive definite matrix of 7 unknowns, the sixth of which is known."""
    root = np.random.default_rng(2).normal(size=(9, 7)) * (SD > 0)
    return root.T @ root


@pytest.fixture
def plain(monkeypatch):
    for name in ("_cholesky", "_solve", "_dot", "_whiten"):
        monkeypatch.setattr(kernel, name, getattr(kernel, name).py_func)
    return kernel


def law(u, mean):
    slope, bound, own = np.empty((3, 7))
    value = kernel.penalty.py_func(u, mean, SD, DOF, slope, bound, own)
    return value, slope, bound, own


def test_the_penalty_is_the_priors_density_beside_its_peak():
    rng = np.random.default_rng(0)
    mean = rng.normal(size=7)
    u = mean + rng.normal(size=7)
    w = np.where(SD > 0, (u - mean) / np.where(SD > 0, SD, 1.0), 0.0)
    laws = [norm() if np.isinf(v) else student_t(v) for v in DOF]
    value, slope, curvature, own = law(u, mean)
    want = sum(2 * (one.logpdf(0) - one.logpdf(x)) for one, x in zip(laws, w))
    assert value == pytest.approx(want)
    for a in range(7):
        h = 1e-6 * SD[a] * (np.arange(7) == a)
        rise = (law(u + h, mean)[0] - law(u - h, mean)[0]) / 4e-6 if SD[a] > 0 else 0.0
        assert slope[a] == pytest.approx(rise, rel=1e-5, abs=1e-8)
        bend = (law(u + h, mean)[1][a] - law(u - h, mean)[1][a]) / 2e-6 if SD[a] > 0 else 1.0
        assert own[a] == pytest.approx(max(bend, 1e-3), rel=1e-5)
        # what makes of the slope a step to the mean; 1 of a normal law, and of what is known
        assert curvature[a] == pytest.approx(slope[a] / w[a] if w[a] else 1.0)


def test_triangular_systems_are_those_of_linear_algebra(matrix):
    diagonal, rhs = np.linspace(0.5, 2.0, 7), np.arange(7.0) - 2.5
    low, step, white = np.zeros((7, 7)), np.zeros(7), np.zeros(7)
    lower_alone = np.where(np.tri(7, dtype=bool), matrix, np.nan)
    log_det = kernel._cholesky.py_func(lower_alone, diagonal, low)
    whole = matrix + np.diag(diagonal)
    np.testing.assert_allclose(low, np.linalg.cholesky(whole), atol=1e-12)
    assert log_det == pytest.approx(np.linalg.slogdet(whole)[1])
    kernel._solve.py_func(low, rhs, step)
    np.testing.assert_allclose(whole @ step, rhs)
    assert kernel._dot.py_func(step, rhs) == pytest.approx(step @ rhs)
    kernel._whiten.py_func(low + np.triu(np.full((7, 7), 9.0), 1), rhs, 3.0, white)
    np.testing.assert_allclose(white, 3.0 * (low @ rhs))


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_a_step_is_that_of_the_quadratic_model(plain, matrix, damping):
    here = kernel._Expansion(*(np.zeros(0),) * 7)._replace(
        matrix=matrix, gradient=np.arange(7.0), slope=np.linspace(1, 2, 7), curvature=np.linspace(0.5, 1.1, 7)
    )
    work = kernel._Work(np.zeros((7, 7)), *(np.zeros(7) for _ in range(3)))
    decrease = kernel._propose.py_func(here, SD, damping, work)
    whole = matrix + np.diag(here.curvature)
    want = np.linalg.solve(whole + damping * np.diag(np.diag(whole)), here.gradient - here.slope)
    np.testing.assert_allclose(work.step, want)
    assert decrease == pytest.approx(want @ (here.gradient - here.slope))


@pytest.mark.parametrize(
    ("at", "step", "part"),
    [
        (0, 5.0, 1.0),
        (0, 10.0, 0.5),
        (1, -6.0, 0.5),
        (6, 15.0, 0.5),
        (2, 1e3, 1.0),
        (3, 1e3, 1.0),
        (4, 1e3, 1.0),
    ],
)
def test_a_step_moves_no_logarithm_by_more_than_one_and_a_half(at, step, part):
    assert kernel._shorten.py_func(step * (np.arange(7) == at), SD) == pytest.approx(part)
    assert kernel._shorten.py_func(np.where(np.arange(7) == 5, 3.0, 0.0), np.ones(7)) == pytest.approx(0.5)


def test_the_covariance_has_the_densitys_own_curvature(plain, matrix):
    """Of Student's t (nu + 1) (nu - w^2) / (nu + w^2)^2, a thousandth at least: it is negative far out."""
    w = np.array([0.5, 0.8, 5.0, 0.1, 0.2, 0.0, 0.3])
    mean = np.arange(7.0)
    here = kernel._Expansion(mean + w * SD, matrix, *(np.zeros(7),) * 4, np.zeros(2))
    work = kernel._Work(np.zeros((7, 7)), *(np.zeros(7) for _ in range(3)))
    covariance = np.zeros((7, 7))
    log_det = kernel._conclude.py_func(here, np.stack([mean, SD, DOF]), work, covariance)
    own = np.ones(7)
    own[1] = 7 * (6 - 0.64) / (6 + 0.64) ** 2
    own[2] = 1e-3
    whole = matrix + np.diag(own)
    assert log_det == pytest.approx(np.linalg.slogdet(whole)[1])
    np.testing.assert_allclose(covariance, np.linalg.inv(whole) * np.outer(SD, SD), atol=1e-12)
