"""Closed loops on a sheet: what the skin did, what it was asked, what it cost, and how long a step took.

And what a tuning leaves to be chosen: designs over settling and energy.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.charts import INK, PALETTE, SOFT, Chart, Curve, Panel, draw_chart
from thermogrip.datasets.limits import LARGEST
from thermogrip.datasets.media import panels
from thermogrip.mpc.closed_loop.simulate import ClosedLoop, band_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from thermogrip.mpc.tuning.trade_offs import Pareto

_MARKS = {"MPC": "o", "PI": "^"}


def closed_loop_figure(
    run: ClosedLoop,
    title: str = "",
    *,
    limits: Mapping[str, tuple[float, float]] | None = None,
    slew_per_s: Mapping[str, float] | None = None,
) -> Figure:
    """Draw the regulated outputs with target and band, the others with their limits, drive and slew.

    Parameters
    ----------
    run : ClosedLoop
    title : str, optional
    limits : mapping of str to (float, float), optional
        Of outputs, e.g. the tank's [degC].
    slew_per_s : mapping of str to float, optional
        What each drive may change by [its units per s]; with it a panel shows what it did change by.

    Returns
    -------
    figure : matplotlib.figure.Figure
        Made without ``pyplot``: no window system is asked for.  Any status but ``ok`` is a cross on the
        drive.

    Examples
    --------
    >>> from thermogrip.sysid import Plant, load_network
    >>> kit = load_network("tclab")
    >>> p, heaters = dict(zip(kit.parameters, kit.prior)), dict.fromkeys(kit.inputs, (0.0, 100.0))
    >>> plant = Plant(kit, p, dt=kit.dt, units=kit.units, valid=heaters)
    >>> from thermogrip.mpc import design_controller, simulate_closed_loop
    >>> run = simulate_closed_loop(design_controller(plant, dt=5.0), plant, [(40.0, 300.0)])
    >>> [axis.get_ylabel() for axis in closed_loop_figure(run).axes]
    ['regulated [degC]', 'drive']
    """
    return draw_chart(closed_loop_chart(run, title, limits=limits, slew_per_s=slew_per_s))


def closed_loop_chart(
    run: ClosedLoop,
    title: str = "",
    *,
    limits: Mapping[str, tuple[float, float]] | None = None,
    slew_per_s: Mapping[str, float] | None = None,
) -> Chart:
    """Return what :func:`closed_loop_figure` draws as a chart."""
    t, called = run.time, run.sample_time
    ends = called[[0, -1]]
    regulated, driven = [], []
    for k, (name, goal) in enumerate(run.target.items()):
        half = band_of(run.band, name)
        band = {"low": goal - half, "high": goal + half}
        label = f"target, \N{PLUS-MINUS SIGN}{half:g} degC"
        regulated.append(Curve(label, called, goal, INK, 1.0, "--", step=True, **band))
        regulated.append(Curve(name, t, run.outputs[name], PALETTE[k % 5], 1.6))
    settled = tuple(
        segment.begin_s + segment.settle_s for segment in run.segments if np.isfinite(segment.settle_s)
    )
    rows = [Panel("regulated [degC]", tuple(regulated), title, 2.4, marks=settled)]
    others = [name for name in run.outputs if name not in run.target]
    if others:
        curves = []
        for k, name in enumerate(others):
            colour = PALETTE[(2 + k) % 5]
            curves.append(Curve(name, t, run.outputs[name], colour, 1.2))
            curves += [
                Curve(f"limits of {name}", ends, np.full(2, end), colour, 1.0, "-.")
                for end in (limits or {}).get(name, ())
                if abs(end) < LARGEST  # an open end
            ]
        rows.append(Panel("others [degC]", tuple(curves), height=1.3))
    for k, (name, values) in enumerate(run.drive.items()):
        driven.append(Curve(name, called, values, PALETTE[(1 + k) % 5], 1.2, step=True))
        driven += [Curve("range", ends, np.full(2, end), SOFT, 0.9) for end in run.drive_range[name]]
    odd = np.array([status != "ok" for status in run.status])
    if odd.any():
        first = next(iter(run.drive.values()))
        driven.append(Curve("status not ok", called[odd], first[odd], "#a3262a", dash=""))
    rows.append(Panel("drive", tuple(driven)))
    if slew_per_s:
        rows.append(Panel("slew [1/s]", tuple(_slewed(run, called, slew_per_s)), height=0.9))
    return Chart((tuple(rows),), wide=8.6)


def step_time_figure(seconds: Mapping[str, ArrayLike], deadline_s: float, dt: float) -> Figure:
    """Draw how long the steps took (given in s, drawn in ms, logarithmic), beside the deadline and the sample
    time."""
    figure, [[axis]] = panels(1, 1, size=(8.6, 2.2))
    shown = {name: 1e3 * np.asarray(values, float) for name, values in seconds.items()}
    everything = np.concatenate([values[values > 0] for values in shown.values()] or [np.ones(1)])
    low, high = np.min(everything, initial=1e3 * deadline_s), 1e3 * max(deadline_s, dt)
    bins = np.geomspace(0.7 * low, 1.4 * max(high, float(np.max(everything, initial=0.0))), 60)
    for k, (name, values) in enumerate(shown.items()):
        label = f"{name}:\nmedian {np.median(values):.2g} ms\nslowest {np.max(values):.2g} ms"
        axis.hist(values, bins=bins.tolist(), color=PALETTE[k % 5], alpha=0.7, label=label)
    axis.axvline(1e3 * deadline_s, color="#a3262a", lw=1.2, label=f"deadline {1e3 * deadline_s:g} ms")
    axis.axvline(1e3 * dt, color=INK, lw=0.9, ls="--", label=f"sample time {1e3 * dt:g} ms")
    axis.set_xscale("log")
    axis.set_xlabel("time of a step [ms]")
    axis.set_ylabel("steps")
    _legend(axis)
    return figure


def pareto_figure(pareto: Pareto) -> Figure:
    """Draw designs over settling and energy, overshoot as colour; those that nothing beats are ringed."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    figure, [[axis]] = panels(1, 1, size=(8.6, 3.8))
    rows = [row for row in pareto.rows() if row["settle_s"] is not None]
    colour = Normalize(0.0, max([0.05, *(row["overshoot_degC"] for row in rows)]))
    front = sorted((row for row in rows if row["best"]), key=lambda row: row["settle_s"])
    axis.plot(
        [r["settle_s"] for r in front], [r["energy_s"] for r in front], color=SOFT, lw=0.9, ls=":", zorder=1
    )
    for name, mark in _MARKS.items():
        mine = [row for row in rows if row["controller"] == name]
        axis.scatter(
            [row["settle_s"] for row in mine],
            [row["energy_s"] for row in mine],
            c=[row["overshoot_degC"] for row in mine],
            norm=colour,
            cmap="viridis_r",
            marker=mark,
            s=52,
            edgecolors=["#a3262a" if row["best"] else "none" for row in mine],
            linewidths=1.4,
            label=name if mine else None,
        )
    axis.margins(0.12)
    _note_all(axis, [row for row in rows if row["name"] in ("baseline", "tuned", "PI")])
    bar = figure.colorbar(ScalarMappable(colour, "viridis_r"), ax=axis, pad=0.12)
    bar.set_label("overshoot, worst [K]", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    axis.set_xlabel("settling, mean of steps and draws [s]")
    axis.set_ylabel("energy [s at full drive]")
    _legend(axis)
    return figure


def _slewed(run: ClosedLoop, called: Array, slew_per_s: Mapping[str, float]) -> Iterator[Curve]:
    """Yield what each drive changed by a second, and what it may change by."""
    dt = float(np.median(np.diff(run.sample_time))) if run.sample_time.size > 1 else 1.0
    for k, (name, values) in enumerate(run.drive.items()):
        first = min(max(0.0, run.drive_range[name][0]), run.drive_range[name][1])
        change = np.diff(values, prepend=first) / dt
        yield Curve(f"slew of {name}", called, change, PALETTE[(1 + k) % 5], 1.0, step=True)
        for end in (-slew_per_s[name], slew_per_s[name]):
            yield Curve("limit of slew", called[[0, -1]], np.full(2, end), SOFT, 0.9)


def _note_all(axis: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write the names of designs beside their marks; marks that are one to the eye share one label."""
    (left, right), (low, high) = axis.get_xlim(), axis.get_ylim()
    shared: list[tuple[float, float, list[str]]] = []
    for row in sorted(rows, key=lambda row: (row["settle_s"], row["energy_s"])):
        x, y, name = row["settle_s"], row["energy_s"], row["name"]
        near = [s for s in shared if abs(s[0] - x) < (right - left) / 8 and abs(s[1] - y) < (high - low) / 25]
        if near:
            near[0][2].append(name)
        else:
            shared.append((x, y, [name]))
    for x, y, names in shared:
        label = ", ".join(dict.fromkeys(names))
        axis.annotate(label, (x, y), textcoords="offset points", xytext=(7, 5), fontsize=7, color="#5b6776")


def _legend(axis: Axes) -> None:
    """Put the legend beside the axis, where it hides nothing."""
    if axis.get_legend_handles_labels()[0]:
        axis.legend(frameon=False, fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.02))
