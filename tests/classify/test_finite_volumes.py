"""The reference of the benchmarks obeys conservation and the closed form: inference can be scored on it."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy.special import erfcx

from thermogrip.sysid.contact.materials import find_material


@pytest.fixture(scope="module")
def fv() -> ModuleType:
    path = Path(__file__).parents[2] / "benchmarks" / "classify" / "finite_volumes.py"
    spec = importlib.util.spec_from_file_location("finite_volumes", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["finite_volumes"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def test_heat_is_conserved_where_none_is_lost(fv: ModuleType) -> None:
    rng = np.random.default_rng(0)
    n, k = 3, 12
    capacity, link = rng.uniform(1, 2, (n, k)), rng.uniform(1, 50, (n, k - 1))
    cells = rng.uniform(10, 40, (n, k))
    after = cells
    for _ in range(50):
        after = fv._implicit(after, capacity, link, np.zeros((n, k)), np.full(n, 25.0))
    np.testing.assert_allclose((after * capacity).sum(axis=1), (cells * capacity).sum(axis=1), rtol=1e-12)
    assert np.all(np.ptp(after, axis=1) < np.ptp(cells, axis=1))


def test_early_contact_of_one_material_with_wood_is_the_closed_form(fv: ModuleType) -> None:
    """Two half-spaces with constant conductance: the gripper's face rises by the erfcx of the closed form."""
    one = (8e-3, 1.4, 2.3e6, 200)
    h, t_end = 900.0, 4.0
    dx, k, c = one[0] / one[3], one[1], one[2]
    wood = find_material("wood")
    d = 0.5 * fv.LENGTH / 200
    link = np.concatenate([np.full(199, k / dx), [0.0], np.full(199, wood.k / d)])[None]
    link[0, 199] = 1 / (1 / h + dx / (2 * k) + d / (2 * wood.k))
    capacity = np.concatenate([np.full(200, c * dx), np.full(200, wood.rho * wood.c_p * d)])[None]
    cells = np.concatenate([np.full(200, 23.0), np.full(200, 43.0)])[None]
    for _ in range(round(t_end / 0.02)):
        cells = fv._implicit(cells, capacity, link, np.zeros((1, 400)), np.array([25.0]), dt=0.02)
    e_dev, e_obj = np.sqrt(k * c), wood.effusivity
    a = h * (1 / e_dev + 1 / e_obj)
    rise = 20.0 * e_obj / (e_dev + e_obj) * (1 - erfcx(a * np.sqrt(t_end)))
    face = cells[0, 199] + 0.5 * (cells[0, 199] - cells[0, 198])
    assert face - 23.0 == pytest.approx(rise, rel=0.01)
