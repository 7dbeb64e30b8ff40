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
from thermogrip.sysid.greybox.population import Population, Rig, pooled_plant, poorly_fitted
from thermogrip.sysid.plant.plant import Plant

_OWN = "by its own logs"
_NEAR = 0.25  # chance below which a page names the rig that is next to be ill or to change
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
    plants: Mapping[str, Plant], rigs: Sequence[Rig], population: Population
) -> tuple[tuple[str, ...], list[tuple[object, ...]]]:
    """Return head and rows of each rig against the others, the farthest first."""
    first, badly = next(iter(plants.values())), poorly_fitted(plants)
    chance = "chance in a healthy fleet"
    error = f"error of its fit [{first.units.get(next(iter(first.noise), ''), '1')}]"
    head = ("rig", "verdict", "squared distance", chance, "farthest parameter", "off by [sd]", error)
    rows: list[tuple[object, ...]] = []
    for rig in sorted(rigs, key=lambda each: (each.chance, -each.distance)):
        k = int(np.abs(rig.deviation).argmax())
        word = "ill" if rig.ill else "misfit" if rig.name in badly else "ok"
        far, left = population.parameters[k], max(plants[rig.name].noise.values(), default=float("nan"))
        rows.append((rig.name, word, rig.distance, rig.chance, far, float(rig.deviation[k]), left))
    return head, rows


def ill_words(plants: Mapping[str, Plant], rigs: Sequence[Rig], population: Population) -> str:
    """Return which rigs are ill, or which comes nearest to it, and which no fit describes."""

    def off(rig: Rig) -> str:
        k = int(np.abs(rig.deviation).argmax())
        return f"{rig.name} ({population.parameters[k]} {rig.deviation[k]:+.1f} sd)"

    ill = [off(rig) for rig in rigs if rig.ill]
    words = f"Far from the others: {', '.join(ill)}." if ill else "No rig is surely unlike the others."
    next_one = min((rig for rig in rigs if not rig.ill), key=lambda rig: rig.chance, default=None)
    if next_one is not None and next_one.chance < _NEAR:
        words += f" {off(next_one)} is as far off as one in {_percent(next_one.chance)} of healthy fleets."
    if badly := poorly_fitted(plants):
        names = ", ".join(badly)
        words += f" The network does not fit the logs of {names}: look at them, their parameters say little."
    return words


def _percent(chance: float) -> str:
    return f"{100 * chance:.2g} %"


def _changed(rig: Drift, population: Population) -> str:
    """Return by how much the farthest parameter of a rig changed."""
    change = float(rig.change[rig.farthest])
    log = population.scales[rig.farthest] == "log"
    return f"{100 * np.expm1(change):+.0f} %" if log else f"{change:+.2g}"


def drift_words(moved: Sequence[Drift], population: Population) -> str:
    """Return which rigs change, or which comes nearest to it."""

    def by(rig: Drift) -> str:
        return f"{rig.name} ({population.parameters[rig.farthest]} {_changed(rig, population)})"

    changing = [by(rig) for rig in moved if rig.drifts]
    words = (
        f"Changed from first log to last: {', '.join(changing)}." if changing else "No rig surely changes."
    )
    next_one = min((rig for rig in moved if not rig.drifts), key=lambda rig: rig.chance, default=None)
    if next_one is not None and next_one.chance < _NEAR:
        words += f" {by(next_one)} moves as one does in {_percent(next_one.chance)} of steady fleets."
    return words


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
        log, told = population.scales[k] == "log", _changed(rig, population)
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
                    rig.days[order],
                    middle[order],
                    size,
                    fmt=f"{mark}-",
                    color=colour,
                    ms=4,
                    label=_shown(rig.name),
                )
            else:
                axis.plot(rig.days[order], middle[order], "-", color="0.6", lw=0.8, label="other rigs")
        axis.yaxis.set_major_locator(MaxNLocator(4))
        axis.set_ylabel(f"{name} [{plant.units.get(name, '1')}]")
        axis.set_xlabel("days from a rig's first log" if dated else "log, from the first on")
        if not dated:
            axis.xaxis.set_major_locator(MaxNLocator(integer=True))
    return _with_legend(figure, 5)


def _shown(name: str) -> str:
    """Return a name that a legend shows: it leaves out what begins with an underscore."""
    return f" {name}" if name.startswith("_") else name


def fleet_figure(plants: Mapping[str, Plant], population: Population, rigs: Sequence[Rig]) -> Figure:
    """Draw every parameter of every rig, by its own logs and pooled, on the population's 90 % interval."""
    figure, axes = _panels(population, 0.9 + 0.17 * len(rigs))
    ranges = population.intervals(0.9)
    pooled = {rig.name: pooled_plant(plants[rig.name], rig) for rig in rigs}
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
            axis.plot(
                pooled[rig.name].values[name], place + 0.15, "D", color=PALETTE[0], ms=3, label="pooled"
            )
        low, high = ranges[name]
        own_values = (plants[rig.name].values[name] for rig in rigs)
        values = [low, high, *own_values, *(plant.values[name] for plant in pooled.values())]
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
    words, badly = ill_words(plants, rigs, population), poorly_fitted(plants)
    head, rows = rig_table(plants, rigs, population)
    caption = (
        "Squared distance from the population of the others, about 1 of a healthy rig. Below 0.05 of chance "
        "a rig is ill: fewer than one healthy fleet of twenty has such a rig. The room's warmth does not "
        "count. A misfit leaves more than three times the error of the fleet's median."
    )
    first = next(iter(plants.values()))
    names, numbers = population_table(population, first)
    drawn = (
        "Dots, or crosses of an ill rig: by its own logs, with 90 %. Diamonds: by all rigs; an ill rig "
        "keeps its own."
    )
    of = f"By the {len(population.rigs)} rigs that are not ill, taken as one normal law of each parameter."
    sections = [
        Section(
            "Which rig is ill?",
            (Table(head, tuple(rows), caption),),
            words,
            "bad" if ill else "warn" if badly else "good",
        ),
        Section("What may a new rig have?", (Table(names, tuple(numbers), of),)),
        Section("Each rig", (Picture(fleet_figure(plants, population, rigs), drawn),)),
    ]
    if moved:
        sections.insert(1, _drift_section(first, population, moved, dated=dated))
    return sections


def _drift_section(plant: Plant, population: Population, moved: Sequence[Drift], *, dated: bool) -> Section:
    """Return what changes over time."""
    changing = [rig.name for rig in moved if rig.drifts]
    words = drift_words(moved, population)
    head, rows = drift_table(moved, population, dated=dated)
    caption = (
        "Trend from a rig's first log to its last, beside how all rigs differ from day to day; +-: one sd. "
        "Below 0.05 of chance it is a change: fewer than one steady fleet of twenty has such a rig. Its "
        "plant in the folder is then that of the middle of its logs: identify it again from the last."
    )
    drawn = "Each log by itself, with the population and the trend; bars: 90 %."
    picture = Picture(drift_figure(plant, population, moved, dated=dated), drawn)
    parts = (Table(head, tuple(rows), caption), picture)
    return Section("Which rig changes?", parts, words, "bad" if changing else "good")
