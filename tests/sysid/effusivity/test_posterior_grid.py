"""Quantiles of mixtures: right, and in a few rounds of Newton's method."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from thermogrip.sysid.effusivity import posterior_grid
from thermogrip.sysid.effusivity.posterior_grid import mixture_quantiles

LEVELS = (0.05, 0.5, 0.95)


@pytest.mark.parametrize("seed", range(6))
def test_the_mixture_has_its_levels_below_its_quantiles(seed: int) -> None:
    rng = np.random.default_rng(seed)
    weight, mean = rng.dirichlet(np.full(60, 0.3)), np.sort(10 + 2 * rng.standard_normal(60))
    sd = np.exp(rng.normal(-2, 1.5, 60))
    x = mixture_quantiles(weight, mean, sd, LEVELS)
    np.testing.assert_allclose((weight * ndtr((x[:, None] - mean) / sd)).sum(axis=1), LEVELS, atol=1e-9)


def test_a_level_that_has_arrived_waits_for_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sent back to the middle of its bounds, it took 36 rounds of 1500 error functions each."""
    rounds: list[int] = []
    monkeypatch.setattr(posterior_grid, "ndtr", lambda z: (rounds.append(1), ndtr(z))[1])
    x = np.linspace(9.4, 12.0, 500)
    mass = np.exp(-0.5 * ((x - 11.1) / 0.45) ** 2)
    mixture_quantiles(mass / mass.sum(), x, 0.05 + 0.07 * (x - 9.4), LEVELS)
    assert len(rounds) <= 8
