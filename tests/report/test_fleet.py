"""The page of a fleet: which rig is ill, and every rig in its picture."""

from __future__ import annotations

import numpy as np
import pytest

from tests.sysid.greybox.makers import N_FREE, fits, plant_at
from thermogrip.report.fleet import drift_table, fleet_sections
from thermogrip.sysid.greybox.drift import find_drift
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


def test_the_page_names_the_rig_that_changes_and_draws_every_log():
    rng = np.random.default_rng(1)
    _, plants = fits(6, rng)
    population, rigs = pool_rigs(plants)
    days, sure = [0.0, 30.0, 60.0, 90.0], 0.01 * np.eye(N_FREE)
    logs = {
        rig: [plant_at(0.1 * rng.normal(size=N_FREE) + (rig == "r2") * day / 45, sure) for day in days]
        for rig in plants
    }
    moved, _ = find_drift(logs, dict.fromkeys(logs, days))
    sections = fleet_sections(plants, population, rigs, moved)
    section = sections[1]
    assert (section.title, section.tone, section.verdict) == ("Which rig changes?", "bad", "r2.")
    table, picture = section.parts
    assert [row[0] for row in table.rows if row[1] == "changing"] == ["r2"]
    axes = [axis for axis in picture.figure.axes if axis.get_visible()]
    assert len(axes) == N_FREE
    assert all(len(line.get_xdata()) == len(days) for line in axes[0].lines)
    assert "r2" in axes[0].get_legend_handles_labels()[1]
    # 2 sd of the prior of 0.7 in the logarithm
    told = next(row for row in drift_table(moved, population, dated=True)[1] if row[0] == "r2")
    assert told[2] == 90
    assert len(fleet_sections(plants, population, rigs)) == len(sections) - 1
