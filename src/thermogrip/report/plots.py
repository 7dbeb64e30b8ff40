"""Charts and figures of a plant and of a session: free runs, posterior, closed loops, grasps.

They take records and numbers.  What a reader wants to zoom into is a chart
(:class:`~thermogrip.report.charts.Chart`), the rest are matplotlib figures.  Figures of a classifier's
results are in :mod:`thermogrip.classify.figures`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError, known_names
from thermogrip.datasets.limits import LARGEST
from thermogrip.datasets.media import panels
from thermogrip.datasets.schema import Grasps, Log, column, log_name, names
from thermogrip.report.charts import DASHES, INK, PALETTE, SOFT, Chart, Curve, Panel, stretches

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from thermogrip.mpc.closed_loop.simulate import ClosedLoop
    from thermogrip.sysid.export.dynamics import Dynamics, Estimate
    from thermogrip.sysid.greybox import Posterior
    from thermogrip.sysid.validation import Band, FreeRun
    from thermogrip.sysid.validation.verdict import Row

MODEL, TARGET = PALETTE[0], INK
MEASURED, PREDICTED = "#9dabb9", PALETTE[1]  # a broad line, and a thin one of dashes over it
MARKERS = ("o", "s", "D", "^", "v", "P", "X", "*")


def free_run_chart(run: FreeRun, outputs: Sequence[str], band: Band | None = None) -> Chart:
    """Return outputs measured and in free run, their difference and the inputs, a column an output; rows
    whose ``scored`` is 0 stand on grey, and where a band is given readings are expected in the shade."""
    log, simulated = run.measured, run.log
    t = np.asarray(log["time"].values, dtype=float)
    shaded = stretches(t, column(simulated, "scored") == 0) if "scored" in simulated else ()
    inputs = tuple(
        Curve(_with_unit(u, log[u].attrs["units"]), t, column(log, u), PALETTE[(2 + k) % 8], step=True)
        for k, u in enumerate(names(log, "input"))
    )
    columns = []
    for name in outputs:
        measured, model = column(log, name), column(simulated, name)
        unit = log[name].attrs["units"]
        read = Curve("measured", t, measured, MEASURED, width=5.0)
        freely = Curve("free run", t, model, PREDICTED, width=1.6, dash="--")
        error = Curve("measured - free run", t, measured - model, MODEL, width=0.9)
        above: tuple[Curve, ...] = (read, freely)
        below: tuple[Curve, ...] = (error,)
        if band is not None:
            half = band.half[name]
            above = (read, replace(freely, low=model - half, high=model + half))
            below = (Curve("expected", t, 0 * half, PREDICTED, 1.0, "--", low=-half, high=half), error)
        columns.append(
            (
                Panel(_with_unit(name, unit), above, name, 2.4, shaded=shaded),
                Panel(f"error [{difference_unit(unit)}]", below, height=1.3, shaded=shaded),
                Panel("inputs", inputs),
            )
        )
    return Chart(tuple(columns))


def models_figure(rows: Sequence[Row]) -> Figure:
    """Draw the held-out free-run error of every model, a panel an output, on a logarithmic scale."""
    held_out = [row for row in rows if row.held_out]
    outputs = list(dict.fromkeys(row.output for row in held_out))
    models = list(dict.fromkeys(row.model for row in held_out))
    logs = list(dict.fromkeys(row.log for row in held_out))
    figure, axes = panels(1, len(outputs), size=(max(9.6, 4.6 * len(outputs)), 0.9 + 0.42 * len(models)))
    for axis, output in zip(axes[0], outputs):
        for k, log in enumerate(logs):
            mine = {row.model: row.rmse for row in held_out if row.output == output and row.log == log}
            heights = [models.index(name) for name in mine]
            axis.plot(list(mine.values()), heights, MARKERS[k % 8], ms=6, color=PALETTE[k % 8], label=log)
        _log_scale(axis, [row.rmse for row in held_out if row.output == output])
        axis.set_yticks(range(len(models)), models, fontsize=9)
        axis.set_ylim(len(models) - 0.5, -0.5)
        unit = next(row.unit for row in held_out if row.output == output)
        axis.set_xlabel(f"{output}: free-run RMSE [{unit}]")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", fontsize=7, ncols=2)
    return figure


def step_response_chart(found: Dynamics) -> Chart:
    """Return the response of each output, a panel each, to a unit step of each input, a column each."""
    outputs, inputs = found.linear.outputs, found.linear.inputs
    time, step = found.step_response()
    units = {name: found.units.get(name, "1") for name in (*outputs, *inputs)}

    def panel(i: int, j: int) -> Panel:
        value, low, high = (np.asarray(values)[:, i, j] for values in step)
        ends = (low, high) if np.isfinite(low).all() else (None, None)
        curve = Curve(outputs[i], time, value, PALETTE[i % 8], low=ends[0], high=ends[1])
        by = units[inputs[j]]
        title = f"{inputs[j]} + 1{'' if by == '1' else ' ' + difference_unit(by)}"
        label = _with_unit(outputs[i], difference_unit(units[outputs[i]]))
        return Panel(label, (curve,), title if i == 0 else "", 1.3)

    rows = range(len(outputs))
    columns = tuple(tuple(panel(i, j) for i in rows) for j in range(len(inputs)))
    return Chart(columns, wide=max(3.2, 6.4 / len(inputs)))


def bode_chart(found: Dynamics) -> Chart:
    """Return magnitude and phase from each input, a column each, to every output, a line each."""
    outputs, inputs = found.linear.outputs, found.linear.inputs
    omega, magnitude, phase = found.frequency_response()
    least = 1e-4 * magnitude.value.max(axis=(0, 1))  # of each input: the scale has no zero
    turned = type(phase)(*(np.where(magnitude.value < least, np.nan, part) for part in phase))

    def curve(part: Estimate, i: int, j: int, floor: float) -> Curve:
        value, low, high = (ends[:, i, j] for ends in part)
        line = Curve(
            outputs[i], omega, np.where(value < floor, np.nan, value), PALETTE[i % 8], dash=DASHES[i % 4]
        )
        if not np.isfinite(high).any():
            return line
        visible = high >= floor
        low, high = np.where(visible, np.maximum(low, floor), np.nan), np.where(visible, high, np.nan)
        return replace(line, low=low, high=high)

    rows = range(len(outputs))
    columns = []
    for j, name in enumerate(inputs):
        sizes = tuple(curve(magnitude, i, j, float(least[j])) for i in rows)
        turns = tuple(curve(turned, i, j, -np.inf) for i in rows)
        above = Panel("magnitude", sizes, name, 1.5, log=True)
        columns.append((above, Panel("phase [deg]", turns, height=1.3)))
    return Chart(tuple(columns), "frequency [rad/s]", log=True, wide=max(3.2, 6.4 / len(inputs)))


def loops_chart(runs: Mapping[str, Log], targets: Mapping[str, float], output: str = "t_surface") -> Chart:
    """Return closed loops side by side by title: the regulated temperature and its target [degC] above, the
    drive below."""
    columns = []
    for title, log in runs.items():
        t = np.asarray(log["time"].values, dtype=float)
        t = t - t[0]
        goal = Curve("target", t[[0, -1]], np.full(2, targets[title]), TARGET, 1.0, "--")
        others = tuple(
            Curve(n, t, column(log, n), PALETTE[(5 + j) % 8], 0.9)
            for j, n in enumerate(name for name in names(log, "output") if name != output)
        )
        drives = tuple(
            Curve(_with_unit(u, log[u].attrs["units"]), t, column(log, u), PALETTE[(1 + j) % 8], step=True)
            for j, u in enumerate(names(log, "input"))
        )
        regulated = Curve(output, t, column(log, output), MODEL, 1.6)
        top = Panel("temperature [degC]", (*others, goal, regulated), title, 2.2)
        columns.append((top, Panel("inputs", drives)))
    return Chart(tuple(columns), wide=3.6)


def closed_loop_chart(
    run: ClosedLoop, title: str = "", *, limits: Mapping[str, tuple[float, float]] | None = None
) -> Chart:
    """Return the regulated outputs with target and band, the others with their limits (the tank's) [degC],
    and the drives; any status but ``ok`` is a cross on the drive."""
    t, called = run.time, run.sample_time
    ends = called[[0, -1]]
    regulated, driven = [], []
    for k, (name, goal) in enumerate(run.target.items()):
        band = {"low": goal - run.band, "high": goal + run.band}
        label = f"target, \N{PLUS-MINUS SIGN}{run.band:g} degC"
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
    return Chart((tuple(rows),), wide=8.6)


def steps_chart(runs: Mapping[str, ClosedLoop]) -> Chart:
    """Return simulated closed loops by "<step>, <controller>": a column a step, controllers over each
    other."""
    steps = list(dict.fromkeys(key.rsplit(", ", 1)[0] for key in runs))
    above: dict[str, list[Curve]] = {step: [] for step in steps}
    below: dict[str, list[Curve]] = {step: [] for step in steps}
    for title, run in runs.items():
        step, controller = title.rsplit(", ", 1)
        # the MPC is broader, so that it shows where both do the same
        colour, width, dash = (PALETTE[5], 3.2, "-") if controller == "MPC" else (PALETTE[1], 1.4, "--")
        for name, target in run.target.items():
            if not any(curve.label == "target" for curve in above[step]):
                above[step].append(Curve("target", run.sample_time, target, SOFT, 1.0, "-.", step=True))
            above[step].append(Curve(controller, run.time, run.outputs[name], colour, width, dash))
        below[step] += [
            Curve(controller, run.sample_time, drive, colour, 0.8 * width, dash, step=True)
            for drive in run.drive.values()
        ]
    columns = tuple(
        (Panel("temperature [degC]", tuple(above[s]), s, 2.2), Panel("drive", tuple(below[s]))) for s in steps
    )
    return Chart(columns, wide=3.6)


def grasps_chart(records: Mapping[str, Sequence[Grasps]], materials: Sequence[str] = ()) -> Chart:
    """Return the traces of grasps by title, a panel each, a colour and dash for each material; those of
    ``materials`` get the first ones, the same as in another chart."""
    styles = {name: k for k, name in enumerate(materials)}
    columns = []
    for title, group in records.items():
        curves = []
        for grasps in group:
            time = np.asarray(grasps["time"].values, dtype=float)
            labels = grasps["material"].values.astype(str) if "material" in grasps else [log_name(grasps)]
            for row, name in zip(grasps["t_surface"].values, np.resize(labels, grasps.sizes["grasp"])):
                k = styles.setdefault(str(name), len(styles))
                curves.append(Curve(str(name), time, row, PALETTE[k % 8], 1.1, DASHES[k % 4]))
        columns.append((Panel("t_surface [degC]", tuple(curves), title, 2.2, marks=(0.0,)),))
    label = 'time since the "closed" message [s]'
    return Chart(tuple(columns), label, wide=6.4 if len(columns) == 1 else 2.9, across=4)


def _log_scale(axis: Axes, values: Sequence[float]) -> None:
    """Give the axis a logarithmic scale of at least a decade, with plain numbers at 1, 2 and 5."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    positive = [value for value in values if np.isfinite(value) and value > 0] or [1.0]
    low, high = 0.7 * min(positive), 1.4 * max(positive)
    widen = max(1.0, np.sqrt(10 * low / high))
    axis.set_xscale("log")
    axis.set_xlim(low / widen, high * widen)
    axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())


def _with_unit(name: str, unit: str) -> str:
    """Return the variable with its unit, where it has one."""
    return name if unit == "1" else f"{name} [{unit}]"


def difference_unit(unit: str) -> str:
    """Return the unit of a difference: kelvin of temperatures."""
    return "K" if unit == "degC" else unit


def corner_figure(posterior: Posterior, names: Sequence[str] | None = None) -> Figure:
    """Draw the samples of each pair of parameters, with marginals and the fitted values; UserError if a name
    is not a free parameter."""
    from matplotlib.figure import Figure

    names = posterior.sampled if names is None else tuple(names)
    for name in names:
        if name not in posterior.free:
            raise UserError(f"{name!r} was not sampled", hint=known_names(name, posterior.free))
    columns = posterior.samples[:, [posterior.free.index(name) for name in names]]
    n = len(names)
    # without pyplot: no window system is asked for, and nothing global is left behind
    figure = Figure(figsize=(1.7 * n + 0.6, 1.7 * n + 0.6), layout="constrained")
    axes = figure.subplots(n, n, squeeze=False)
    for i in range(n):
        for j in range(n):
            _corner_panel(axes[i, j], columns, names, posterior, i, j)
    return figure


def _corner_panel(
    ax: Any, columns: Array, names: Sequence[str], posterior: Posterior, i: int, j: int
) -> None:
    """Draw row i, column j of the corner figure."""
    if j > i:
        ax.set_axis_off()
        return
    ax.tick_params(labelsize=6)
    ax.locator_params(axis="x", nbins=3)
    ax.axvline(posterior.fitted[names[j]], color="0.6", lw=0.8)
    if i == j:
        ax.hist(columns[:, i], bins=25, color="tab:blue", alpha=0.6)
        for edge in (posterior.quantiles[names[i]][0], posterior.quantiles[names[i]][2]):
            ax.axvline(edge, color="tab:blue", lw=0.8, ls="--")
        ax.set_yticks([])
    else:
        # a ridge where two parameters trade off: neither is known well, a combination is
        ax.plot(columns[:, j], columns[:, i], ".", ms=1.5, alpha=0.4, rasterized=True)  # of thousands
        ax.axhline(posterior.fitted[names[i]], color="0.6", lw=0.8)
        ax.tick_params(labelleft=j == 0)  # a row shares its scale
    if i == len(names) - 1:
        ax.set_xlabel(f"{names[j]} [{posterior.units.get(names[j], '1')}]", fontsize=7)
    if j == 0 and i > 0:
        ax.set_ylabel(f"{names[i]} [{posterior.units.get(names[i], '1')}]", fontsize=7)
