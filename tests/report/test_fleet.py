"""The page of a fleet: which rig is ill, and every rig in its picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.sysid.greybox.makers import N_FREE, fits, plant_at
from thermogrip.report.fleet import drift_figure, drift_table, fleet_sections, ill_words, rig_table
from thermogrip.sysid.greybox.drift import Drift, find_drift
from thermogrip.sysid.greybox.population import pool_rigs


@pytest.mark.parametrize("ill", [False, True])
def test_the_page_names_the_ill_rig_and_draws_all(ill):
    _, plants = fits(12, np.random.default_rng(0))
    if ill:
        plants["odd"] = plant_at(np.full(N_FREE, 3.0), 0.01 * np.eye(N_FREE))
    population, rigs = pool_rigs(plants)
    first, numbers, each = fleet_sections(plants, population, rigs)
    assert (first.tone, first.verdict) == (
        ("bad", "Far from the others: odd (power_2 +17.8 sd).")
        if ill
        else ("good", "No rig is surely unlike the others.")
    )
    table = first.parts[0].rows
    assert len(table) == len(plants)
    assert [row[0] for row in table if row[1] == "ill"] == (["odd"] if ill else [])
    assert [row[0] for row in numbers.parts[0].rows] == list(population.parameters)
    axes = [axis for axis in each.parts[0].figure.axes if axis.get_visible()]
    assert len(axes) == N_FREE - 1  # the room is no part of a rig
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
    assert (section.title, section.tone) == ("Which rig changes?", "bad")
    assert section.verdict.startswith("Changed from first log to last: r2 (")
    table, picture = section.parts
    assert [row[0] for row in table.rows if row[1] == "changing"] == ["r2"]
    axes = [axis for axis in picture.figure.axes if axis.get_visible()]
    assert len(axes) == N_FREE - 1  # the room is no part of a rig
    assert all(len(line.get_xdata()) == len(days) for line in axes[0].lines)
    assert "r2" in axes[0].get_legend_handles_labels()[1]
    # 2 sd of the prior of 0.7 in the logarithm
    told = next(row for row in drift_table(moved, population, dated=True)[1] if row[0] == "r2")
    assert told[2] == 90
    assert len(fleet_sections(plants, population, rigs)) == len(sections) - 1


def test_the_page_names_the_rig_that_is_next_to_be_ill_and_the_one_that_no_fit_describes():
    _, plants = fits(12, np.random.default_rng(0))
    plants = {name: replace(plant, noise={"t1": 0.2, "t2": 0.3}) for name, plant in plants.items()}
    one = plants["r3"]
    plants["r3"] = replace(one, values=one.values | {"G_amb": one.values["G_amb"] * 1.45})
    population, rigs = pool_rigs(plants)
    assert 0.05 < rigs[3].chance < 0.25
    assert "r3 (G_amb +" in ill_words(plants, rigs, population)
    assert "does not fit" not in ill_words(plants, rigs, population)
    # a heater that no column has: the fit is 3 K off
    odd = plants | {"r5": replace(plants["r5"], noise={"t1": 0.2, "t2": 3.0})}
    assert "does not fit the logs of r5" in ill_words(odd, rigs, population)
    head, rows = rig_table(odd, rigs, population)
    assert [row[0] for row in rows if row[1] == "misfit"] == ["r5"]
    assert head[-1] == "error of its fit [degC]"
    assert fleet_sections(odd, population, rigs)[0].tone == "warn"


def test_a_rig_whose_name_begins_with_an_underscore_is_in_the_legend():
    _, plants = fits(4, np.random.default_rng(2))
    population, _ = pool_rigs(plants)
    days, k = np.array([0.0, 30.0, 60.0]), len(population.parameters)
    one = Drift("_a", days, np.zeros((3, k)), np.ones((3, k)), np.ones(k), np.ones(k), 0.01, 0)
    figure = drift_figure(plants["r0"], population, [one], dated=True)
    assert "_a" in [text.get_text().strip() for text in figure.legends[0].get_texts()]
