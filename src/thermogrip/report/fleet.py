"""The page of a fleet: every rig against the population of the others, and what a new rig may have."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from thermogrip.datasets.charts import PALETTE
from thermogrip.datasets.media import panels
from thermogrip.report.html import Picture, Section, Table
from thermogrip.sysid.greybox.drift import Drift
from thermogrip.sysid.greybox.population import Population, Rig
from thermogrip.sysid.plant.plant import Plant

_OWN = "by its own logs"
_COLUMNS = 3  # of panels


def population_table(
    population: Population, plant: Plant
) -> tuple[tuple[str, ...], list[tuple[object, ...]]]:
    """Return head and rows of what a new rig may have, a row a parameter; ``plant`` has the units."""
    middle, ranges = population.natural(np.array(population.mean)), population.intervals(0.9)
    head = ("parameter", "unit", "population", "90 % of new rigs from", "to", "spread from rig to rig")
    rows: list[tuple[object, ...]] = []
    for k, name in enumerate(population.parameters):
        unit, spread = plant.units.get(name, "1"), population.spread[k]
        told = f"{100 * spread:.2g} %" if population.scales[k] == "log" else f"{spread:.2g} {unit}"
        rows.append((name, unit, float(middle[k]), *ranges[name], told))
    return head, rows


def rig_table(
    rigs: Sequence[Rig], population: Population
) -> tuple[tuple[str, ...], list[tuple[object, ...]]]:
    """Return head and rows of each rig against the others, the farthest first."""
    chance = "chance in a healthy fleet"
    head = ("rig", "verdict", "squared distance", chance, "farthest parameter", "off by [sd]")
    rows: list[tuple[object, ...]] = []
    for rig in sorted(rigs, key=lambda each: (each.chance, -each.distance)):
        k = int(np.abs(rig.deviation).argmax())
        word = "ill" if rig.ill else "ok"
        far = population.parameters[k]
        rows.append((rig.name, word, rig.distance, rig.chance, far, float(rig.deviation[k])))
    return head, rows


def drift_table(
    moved: Sequence[Drift], population: Population, *, dated: bool
) -> tuple[tuple[str, ...], list[tuple[object, ...]]]:
    """Return head and rows of how each rig changed, the least likely first."""
    span = "days" if dated else "logs"
    head = ("rig", "verdict", span, "farthest parameter", "changed by", "+-", "chance in a steady fleet")
    rows: list[tuple[object, ...]] = []
    for rig in sorted(moved, key=lambda each: each.chance):
        k = rig.farthest
        change, sd = float(rig.change[k]), float(rig.change_sd[k])
        log = population.scales[k] == "log"
        told = f"{100 * np.expm1(change):+.0f} %" if log else f"{change:+.2g}"
        more = f"{100 * np.exp(change) * sd:.0f} %" if log else f"{sd:.2g}"
        length = float(rig.days.max()) if dated else rig.days.size
        word = "changing" if rig.drifts else "ok"
        rows.append((rig.name, word, length, population.parameters[k], told, more, rig.chance))
    return head, rows


def _panels(population: Population, height: float) -> tuple[Figure, dict[str, Axes]]:
    """Return a figure with a panel a parameter, so high each [in], and the panels by name."""
    n = len(population.parameters)
    rows = -(-n // _COLUMNS)
    figure, axes = panels(rows, _COLUMNS, size=(10.0, rows * height))
    for axis in axes.flat[n:]:
        axis.set_visible(False)
    return figure, dict(zip(population.parameters, axes.flat))


def _with_legend(figure: Figure, columns: int) -> Figure:
    """Return a figure with what its first panel shows, each once, above it."""
    handles, labels = figure.axes[0].get_legend_handles_labels()
    found = dict(zip(labels, handles))
    figure.legend(list(found.values()), list(found), loc="outside upper center", fontsize=7, ncols=columns)
    return figure


def drift_figure(plant: Plant, population: Population, moved: Sequence[Drift], *, dated: bool) -> Figure:
    """Draw every parameter of every rig by the time of its logs; rigs that change are named."""
    figure, axes = _panels(population, 2.6)
    ranges = population.intervals(0.9)
    for k, (name, axis) in enumerate(axes.items()):
        axis.axhspan(*ranges[name], color=PALETTE[0], alpha=0.15, lw=0, label="90 % of new rigs")
        looks = zip(cycle(PALETTE[1:]), cycle("os^vD"))
        for rig in sorted(moved, key=lambda each: each.drifts):
            low, middle, high = (population.natural(rig.theta + q * rig.sd)[:, k] for q in (-1.64, 0.0, 1.64))
            order = np.argsort(rig.days, kind="stable")
            if rig.drifts:
                colour, mark = next(looks)
                size = np.abs(np.stack([low, high]) - middle)[:, order]
                axis.errorbar(
                    rig.days[order], middle[order], size, fmt=f"{mark}-", color=colour, ms=4, label=rig.name
                )
            else:
                axis.plot(rig.days[order], middle[order], "-", color="0.6", lw=0.8, label="other rigs")
        axis.yaxis.set_major_locator(MaxNLocator(4))
        axis.set_ylabel(f"{name} [{plant.units.get(name, '1')}]")
        axis.set_xlabel("days from a rig's first log" if dated else "log")
    return _with_legend(figure, 5)


def fleet_figure(plants: Mapping[str, Plant], population: Population, rigs: Sequence[Rig]) -> Figure:
    """Draw every parameter of every rig, by its own logs and pooled, on the population's 90 % interval."""
    figure, axes = _panels(population, 0.9 + 0.17 * len(rigs))
    ranges = population.intervals(0.9)
    y, called = np.arange(len(rigs)), [f"{rig.name} (ill)" if rig.ill else rig.name for rig in rigs]
    for k, (name, axis) in enumerate(axes.items()):
        axis.axvspan(*ranges[name], color=PALETTE[0], alpha=0.15, lw=0, label="90 % of new rigs")
        for place, rig in zip(y, rigs):
            own = plants[rig.name]
            low, high = own.intervals(0.9)[name]
            look, label = (("x", PALETTE[1]), "ill, by its own logs") if rig.ill else (("o", "0.6"), _OWN)
            axis.plot([low, high], [place - 0.15] * 2, "-", color=look[1], lw=1)
            size = 6 if rig.ill else 3
            axis.plot(own.values[name], place - 0.15, look[0], color=look[1], ms=size, mew=1.5, label=label)
            pooled = population.natural(rig.pooled)[k]
            axis.plot(pooled, place + 0.15, "D", color=PALETTE[0], ms=3, label="pooled")
        low, high = ranges[name]
        own_values = (plants[rig.name].values[name] for rig in rigs)
        values = [low, high, *own_values, *(population.natural(rig.pooled)[k] for rig in rigs)]
        margin = 0.15 * (max(values) - min(values))
        axis.set_xlim(min(values) - margin, max(values) + margin)  # a short log's interval may be far wider
        axis.xaxis.set_major_locator(MaxNLocator(4))
        axis.set_yticks(y, called if k % _COLUMNS == 0 else [], fontsize=7)
        axis.set_ylim(len(rigs) - 0.5, -0.5)
        axis.set_xlabel(f"{name} [{next(iter(plants.values())).units.get(name, '1')}]")
    return _with_legend(figure, 3)


def fleet_sections(
    plants: Mapping[str, Plant],
    population: Population,
    rigs: Sequence[Rig],
    moved: Sequence[Drift] = (),
    *,
    dated: bool = True,
) -> list[Section]:
    """Return the page's sections; rigs with too few logs are not among those that ``moved``."""
    ill = [rig.name for rig in rigs if rig.ill]
    words = f"{', '.join(ill)} far from the others." if ill else "No rig is far from the others."
    head, rows = rig_table(rigs, population)
    caption = "Distance from the population of the others, 1 on average; less than 0.05 of chance is ill."
    first = next(iter(plants.values()))
    names, numbers = population_table(population, first)
    drawn = "Dots, or crosses of an ill rig: by its own logs, with 90 %. Diamonds: by all rigs together."
    sections = [
        Section("Which rig is ill?", (Table(head, tuple(rows), caption),), words, "bad" if ill else "good"),
        Section("What may a new rig have?", (Table(names, tuple(numbers)),)),
        Section("Each rig", (Picture(fleet_figure(plants, population, rigs), drawn),)),
    ]
    if moved:
        sections.insert(1, _drift_section(first, population, moved, dated=dated))
    return sections


def _drift_section(plant: Plant, population: Population, moved: Sequence[Drift], *, dated: bool) -> Section:
    """Return what changes over time."""
    changing = [rig.name for rig in moved if rig.drifts]
    words = f"{', '.join(changing)}." if changing else "No rig is seen to change."
    head, rows = drift_table(moved, population, dated=dated)
    caption = (
        "Trend from a rig's first log to its last, beside how all rigs differ from day to day; less than "
        "0.05 of chance is a change. The plant of all its logs is then that of their middle: identify it "
        "again from the last."
    )
    drawn = "Each log by itself, with the population and the trend; bars: 90 %."
    picture = Picture(drift_figure(plant, population, moved, dated=dated), drawn)
    parts = (Table(head, tuple(rows), caption), picture)
    return Section("Which rig changes?", parts, words, "bad" if changing else "good")
