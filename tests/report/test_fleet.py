"""The page of a fleet: which rig is ill, and every rig in its picture."""

from __future__ import annotations

import numpy as np
import pytest

from tests.sysid.greybox.makers import N_FREE, fits, plant_at
from thermogrip.report.fleet import fleet_sections
from thermogrip.sysid.greybox.population import pool_rigs


@pytest.mark.parametrize("ill", [False, True])
def test_the_page_names_the_ill_rig_and_draws_all(ill):
    _, plants = fits(12, np.random.default_rng(0))
    if ill:
        plants["odd"] = plant_at(np.full(N_FREE, 3.0), 0.01 * np.eye(N_FREE))
    population, rigs = pool_rigs(plants)
    first, numbers, each = fleet_sections(plants, population, rigs)
    assert (first.tone, first.verdict) == (
        ("bad", "odd far from the others.") if ill else ("good", "No rig is far from the others.")
    )
    table = first.parts[0].rows
    assert len(table) == len(plants)
    assert [row[0] for row in table if row[1] == "ill"] == (["odd"] if ill else [])
    assert [row[0] for row in numbers.parts[0].rows] == list(population.parameters)
    axes = [axis for axis in each.parts[0].figure.axes if axis.get_visible()]
    assert len(axes) == N_FREE
    drawn = [line for line in axes[0].lines if line.get_marker() in ("o", "x")]
    assert [line.get_marker() == "x" for line in drawn] == [rig.ill for rig in rigs]  # not by colour alone
    assert [tick.get_text() for tick in axes[0].get_yticklabels() if "(ill)" in tick.get_text()] == (
        ["odd (ill)"] if ill else []
    )
    low, high = axes[0].get_xlim()
    assert all(low < float(line.get_xdata()[0]) < high for line in drawn)
