"""Figures of a plant and of a session: free runs, posterior, closed loops, one grasp.

They take records and numbers, and return matplotlib figures made without ``pyplot``, so that no window system
is asked for and nothing global is left behind.  Figures of a classifier's results are in
:mod:`thermogrip.classify.figures`.

The corner figure of a posterior: each pair of parameters, marginals on the diagonal
------------------------------------------------------------------------------------

Where two parameters trade off, their panel is a ridge: neither is known well, a combination
is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError, known_names
from thermogrip.datasets.media import panels
from thermogrip.datasets.schema import Grasps, Log, column, log_name, names

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from thermogrip.mpc.closed_loop.simulate import ClosedLoop
    from thermogrip.sysid.export.dynamics import Dynamics
    from thermogrip.sysid.greybox import Posterior
    from thermogrip.sysid.identification import Row
    from thermogrip.sysid.validation import Band, FreeRun

MEASURED, MODEL, TARGET = "#9aa7b5", "#1f5fa8", "#1d2733"
# after Okabe and Ito: eight colours that are distinct under every kind of colour-vision deficiency
PALETTE = ("#1f5fa8", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8a5a00")
MARKERS = ("o", "s", "D", "^", "v", "P", "X", "*")
MAX_POINTS = 1500


def free_run_figure(run: FreeRun, band: Band | None = None) -> Figure:
    """Draw outputs measured and in free run, their difference and the inputs, a column an output; rows whose
    ``scored`` is 0 stand on grey, and where a band is given readings are expected in the shade."""
    log, simulated, outputs = run.measured, run.log, tuple(run.scores)
    figure, axes = panels(
        3, len(outputs), heights=(3, 1.2, 1.0), size=(5.2 * len(outputs), 4.4), sharex="col"
    )
    t = np.asarray(log["time"].values, dtype=float)
    keep = _thin(t.size)
    unscored = column(simulated, "scored") == 0 if "scored" in simulated else np.zeros(t.shape, dtype=bool)
    for k, name in enumerate(outputs):
        measured, model = column(log, name), column(simulated, name)
        top, middle, bottom = axes[:, k]
        high = middle.get_xaxis_transform()  # from the bottom of the panel, 0, to its top, 1
        middle.fill_between(t, 0, 1, where=unscored, transform=high, color="#e6eaef", lw=0)
        top.plot(t[keep], measured[keep], color=MEASURED, lw=2.2, label="measured")
        top.plot(t[keep], model[keep], color=MODEL, lw=1.0, label="free run")
        top.set_ylabel(f"{name} [{log[name].attrs['units']}]")
        if band is not None:
            half = band.half[name][keep]
            top.fill_between(t[keep], model[keep] - half, model[keep] + half, color=MODEL, alpha=0.18, lw=0)
            middle.fill_between(t[keep], -half, half, color=MODEL, alpha=0.18, lw=0)
        middle.plot(t[keep], (measured - model)[keep], color=PALETTE[1], lw=0.8)
        middle.axhline(0, color=TARGET, lw=0.6)
        middle.set_ylabel(f"error [{difference_unit(log[name].attrs['units'])}]")
        for j, u in enumerate(names(log, "input")):
            label, colour = _with_unit(u, log[u].attrs["units"]), PALETTE[(2 + j) % 8]
            bottom.step(t[keep], column(log, u)[keep], where="post", lw=0.8, color=colour, label=label)
        bottom.set_xlabel("time [s]")
        bottom.set_ylabel("inputs")
    lines = axes[0, 0].get_lines() + axes[2, 0].get_lines()
    figure.legend(handles=lines, loc="outside upper center", ncols=6, frameon=False, fontsize=8)
    return figure


def residual_figure(run: FreeRun) -> Figure:
    """Draw the correlation of residuals with themselves and with the inputs before them, a row an output; the
    shaded bands cover 95 % of the lags of white residuals."""
    outputs = tuple(run.whiteness)
    inputs = tuple(run.input_correlation[outputs[0]])
    size = (2.6 * (1 + len(inputs)), 1.7 * len(outputs))
    figure, axes = panels(len(outputs), 1 + len(inputs), size=size, sharex="col")
    for row, name in zip(axes, outputs):
        shown = {f"{name}, own": run.whiteness[name]}
        shown |= {f"{name} after {u}": found for u, found in run.input_correlation[name].items()}
        for axis, (title, found) in zip(row, shown.items()):
            axis.axhspan(-found.band, found.band, color=MODEL, alpha=0.15, lw=0)
            axis.vlines(found.lags, 0.0, found.values, color=PALETTE[1], lw=1.2)
            axis.axhline(0, color=TARGET, lw=0.6)
            axis.set_ylim(-1.05, 1.05)
            axis.set_title(title, fontsize=8)
        row[0].set_ylabel("correlation")
    for axis in axes[-1]:
        axis.set_xlabel("lag [rows]")
    return figure


def models_figure(rows: Sequence[Row]) -> Figure:
    """Draw the held-out free-run error of every model, a panel an output, on a logarithmic scale."""
    held = [row for row in rows if row.held_out]
    outputs = list(dict.fromkeys(row.output for row in held))
    models = list(dict.fromkeys(row.model for row in held))
    logs = list(dict.fromkeys(row.log for row in held))
    figure, axes = panels(1, len(outputs), size=(4.6 * len(outputs), 0.9 + 0.42 * len(models)))
    for axis, output in zip(axes[0], outputs):
        for k, log in enumerate(logs):
            mine = {row.model: row.rmse for row in held if row.output == output and row.log == log}
            at = [models.index(name) for name in mine]
            axis.plot(list(mine.values()), at, MARKERS[k % 8], ms=6, color=PALETTE[k % 8], label=log)
        _log_scale(axis, [row.rmse for row in held if row.output == output])
        axis.set_yticks(range(len(models)), models, fontsize=9)
        axis.set_ylim(len(models) - 0.5, -0.5)
        unit = next(row.unit for row in held if row.output == output)
        axis.set_xlabel(f"{output}: free-run RMSE [{unit}]")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", fontsize=7, ncols=2)
    return figure


def step_response_figure(found: Dynamics) -> Figure:
    """Draw the response of each output, a row each, to a unit step of each input, a column each."""
    outputs, inputs = found.near.outputs, found.near.inputs
    time, step = found.step_response()
    size = (max(4.6, 2.6 * len(inputs)), 0.6 + 1.5 * len(outputs))
    figure, axes = panels(len(outputs), len(inputs), size=size, sharex="col")
    for i, name in enumerate(outputs):
        unit = difference_unit(found.units.get(name, "1"))
        axes[i, 0].set_ylabel(name if unit == "1" else f"{name} [{unit}]")
        for j, axis in enumerate(axes[i]):
            axis.axhline(0, color=TARGET, lw=0.6)
            axis.fill_between(time, step.low[:, i, j], step.high[:, i, j], color=MODEL, alpha=0.18, lw=0)
            axis.plot(time, step.value[:, i, j], color=MODEL, lw=1.2)
    for j, name in enumerate(inputs):
        by = found.units.get(name, "1")
        axes[0, j].set_title(f"{name} + 1{'' if by == '1' else ' ' + difference_unit(by)}", fontsize=8)
        axes[-1, j].set_xlabel("time [s]")
    return figure


def bode_figure(found: Dynamics) -> Figure:
    """Draw magnitude and phase from each input, a column each, to every output, a line each."""
    outputs, inputs = found.near.outputs, found.near.inputs
    omega, *parts = found.frequency_response()
    figure, axes = panels(2, len(inputs), size=(max(4.6, 2.6 * len(inputs)), 3.6), sharex="col")
    for j, (name, column_of) in enumerate(zip(inputs, axes.T)):
        for axis, part in zip(column_of, parts):
            axis.set_xscale("log")
            for i in range(len(outputs)):
                colour, low = PALETTE[i % 8], part.low[:, i, j]
                if axis is column_of[0]:
                    low = np.maximum(low, 1e-3 * part.value[:, i, j])  # the scale has no zero
                axis.fill_between(omega, low, part.high[:, i, j], color=colour, alpha=0.15, lw=0)
                axis.plot(omega, part.value[:, i, j], color=colour, lw=1.2, label=outputs[i])
        column_of[0].set_yscale("log")
        column_of[0].set_ylim(bottom=1e-4 * parts[0].value[:, :, j].max() or None)
        column_of[0].set_title(name, fontsize=8)
        column_of[1].set_xlabel("frequency [rad/s]")
    axes[0, 0].set_ylabel("magnitude")
    axes[1, 0].set_ylabel("phase [deg]")
    lines = axes[0, 0].get_lines()
    figure.legend(handles=lines, loc="outside upper center", ncols=6, frameon=False, fontsize=8)
    return figure


def posterior_figure(
    samples: Array, free: Sequence[str], units: Mapping[str, str], values: Mapping[str, float]
) -> Figure:
    """Draw the marginal posterior of each parameter from samples (n, n_free) in natural units, with its 90 %
    interval and the fitted value."""
    across = min(5, max(1, len(free)))
    down = -(-len(free) // across)
    figure, axes = panels(down, across, size=(2.1 * across, 1.55 * down))
    for k, axis in enumerate(axes.ravel()):
        if k >= len(free):
            axis.set_axis_off()
            continue
        name = free[k]
        low, high = np.quantile(samples[:, k], [0.05, 0.95])
        axis.hist(samples[:, k], bins=40, color="#c9d6e6", edgecolor="none")
        axis.axvspan(low, high, color=MODEL, alpha=0.10, lw=0)
        axis.axvline(values[name], color=PALETTE[1], lw=1.0)
        axis.set_yticks([])
        axis.set_title(f"{name} [{units.get(name, '1')}]", fontsize=8)
        axis.locator_params(axis="x", nbins=3)
    return figure


def loop_figure(runs: Mapping[str, Log], targets: Mapping[str, float], output: str = "t_surface") -> Figure:
    """Draw closed loops side by side by title: the regulated temperature and its target [degC] above, the
    drive below."""
    figure, axes = panels(2, len(runs), heights=(2.4, 1), size=(3.6 * len(runs), 3.6), sharex="col")
    for k, (title, log) in enumerate(runs.items()):
        t = np.asarray(log["time"].values, dtype=float)
        t, keep = t - t[0], _thin(t.size)
        top, bottom = axes[:, k]
        for j, name in enumerate(n for n in names(log, "output") if n != output):
            top.plot(
                t[keep], column(log, name)[keep], color=PALETTE[(5 + j) % 8], lw=0.8, alpha=0.8, label=name
            )
        top.plot(t[keep], column(log, output)[keep], color=MODEL, lw=1.3, label=output)
        top.axhline(targets[title], color=TARGET, lw=0.8, ls="--", label="target")
        top.set_title(title, fontsize=9)
        for j, u in enumerate(names(log, "input")):
            label, colour = _with_unit(u, log[u].attrs["units"]), PALETTE[(1 + j) % 8]
            bottom.step(t[keep], column(log, u)[keep], where="post", lw=0.9, color=colour, label=label)
        bottom.set_xlabel("time [s]")
    axes[0, 0].set_ylabel("temperature [degC]")
    axes[1, 0].set_ylabel("inputs")
    lines = axes[0, 0].get_lines() + axes[1, 0].get_lines()
    figure.legend(handles=lines, loc="outside upper center", ncols=6, frameon=False, fontsize=8)
    return figure


def steps_figure(runs: Mapping[str, ClosedLoop]) -> Figure:
    """Draw simulated closed loops by "<step>, <controller>", a column a step, controllers over each other."""
    steps = list(dict.fromkeys(key.rsplit(", ", 1)[0] for key in runs))
    figure, axes = panels(2, len(steps), heights=(2.4, 1), size=(3.6 * len(steps), 3.6), sharex="col")
    for title, run in runs.items():
        step, controller = title.rsplit(", ", 1)
        top, bottom = axes[:, steps.index(step)]
        # the one under another is broader, so that it shows where both do the same
        colour, width = {"MPC": (PALETTE[5], 3.0), "LQR": (TARGET, 0.9)}.get(controller, (PALETTE[1], 1.3))
        keep, rows = _thin(run.time.size), _thin(run.sample_time.size)
        for name, target in run.target.items():
            top.plot(run.time[keep], run.outputs[name][keep], color=colour, lw=width, label=controller)
            top.plot(run.sample_time, target, color=MEASURED, lw=0.8, ls="--", zorder=1)
        for drive in run.drive.values():
            bottom.step(run.sample_time[rows], drive[rows], where="post", lw=0.8 * width, color=colour)
        top.set_title(f"{step} degC", fontsize=9)
        bottom.set_xlabel("time [s]")
    axes[0, 0].set_ylabel("temperature [degC]")
    axes[1, 0].set_ylabel("drive")
    axes[0, 0].legend(frameon=False, fontsize=8)
    return figure


def grasp_figure(records: Sequence[Grasps], title: str = "") -> Figure:
    """Draw the traces of grasps, a colour for each material."""
    figure, [[axis]] = panels(1, 1, size=(6.4, 3.0))
    colours: dict[str, str] = {}
    for grasps in records:
        time = np.asarray(grasps["time"].values, dtype=float)
        labels = grasps["material"].values.astype(str) if "material" in grasps else [log_name(grasps)]
        for row, name in zip(grasps["t_surface"].values, np.resize(labels, grasps.sizes["grasp"])):
            label = None if name in colours else str(name)
            colours.setdefault(str(name), PALETTE[len(colours) % 8])
            axis.plot(time, row, lw=1.0, color=colours[str(name)], label=label)
    axis.axvline(0, color=TARGET, lw=1.0, ls=":")
    axis.set_xlabel('time since the "closed" message [s]')
    axis.set_ylabel("t_surface [degC]")
    axis.set_title(title, fontsize=9)
    axis.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def responses_figure(records: Mapping[str, Grasps], materials: Sequence[str] = ()) -> Figure:
    """Draw the traces of several conditions side by side, a colour for each material; those of ``materials``
    get the first colours, the same as in another figure."""
    across = min(4, len(records))
    down = -(-len(records) // across)
    figure, axes = panels(down, across, size=(2.9 * across, 2.2 * down))
    colours = {name: PALETTE[k % 8] for k, name in enumerate(materials)}
    for axis, (title, grasps) in zip(axes.ravel(), records.items()):
        for row, name in zip(grasps["t_surface"].values, grasps["material"].values.astype(str)):
            colours.setdefault(name, PALETTE[len(colours) % 8])
            axis.plot(grasps["time"].values, row, lw=0.7, alpha=0.8, color=colours[name])
        axis.axvline(0, color=TARGET, lw=0.6, ls=":")
        axis.set_title(title, fontsize=8)
    for axis in axes.ravel()[len(records) :]:
        axis.set_axis_off()
    for axis in axes[:, 0]:
        axis.set_ylabel("t_surface [degC]")
    for axis in axes.ravel()[max(0, len(records) - across) : len(records)]:
        axis.set_xlabel("time since contact [s]")
    lines = [axes[0, 0].plot([], [], color=colour, label=name)[0] for name, colour in colours.items()]
    figure.legend(handles=lines, loc="outside upper center", ncols=len(lines), frameon=False, fontsize=8)
    return figure


def exchange_figure(
    effusivity: Mapping[str, float], *, e_dev: float, seconds: float = 10.0, area: float = 4e-4
) -> Figure:
    """Draw the heat that two half-spaces in perfect contact exchange, over the difference and over the area.

    The flux e_dev (T_s - T_dev) / sqrt(pi t), T_s - T_dev = dT / (1 + e_dev / e_obj), has the integral
    2 e_dev dT sqrt(t / pi) / (1 + e_dev / e_obj).
    """
    figure, axes = panels(1, 2, size=(7.6, 3.0))
    difference, areas = np.linspace(0, 20, 41), np.linspace(0, 6e-4, 41)
    for k, (name, e_obj) in enumerate(effusivity.items()):
        share = 2 * e_dev * np.sqrt(seconds / np.pi) / (1 + e_dev / e_obj)
        axes[0, 0].plot(difference, share * area * difference, color=PALETTE[k % 8], label=name)
        for dT, style in ((5.0, ":"), (20.0, "-")):
            axes[0, 1].plot(1e4 * areas, share * areas * dT, color=PALETTE[k % 8], ls=style)
    axes[0, 0].set_xlabel(f"temperature difference [K], {1e4 * area:g} cm\u00b2")
    axes[0, 1].set_xlabel("contact area [cm\u00b2], 20 K (lines) and 5 K (dots)")
    axes[0, 0].set_ylabel(f"heat in {seconds:g} s [J]")
    axes[0, 0].legend(frameon=False, fontsize=8)
    return figure


def _log_scale(axis: Axes, values: Sequence[float]) -> None:
    """Give the axis a logarithmic scale of at least a decade, with plain numbers at 1, 2 and 5."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    known = [value for value in values if np.isfinite(value) and value > 0] or [1.0]
    low, high = 0.7 * min(known), 1.4 * max(known)
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


def _thin(n: int) -> slice:
    """Return a slice that keeps at most :data:`MAX_POINTS` of n points."""
    return slice(None, None, max(1, -(-n // MAX_POINTS)))


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
    ax.axvline(posterior.fitted[names[j]], color="0.6", lw=0.8)
    if i == j:
        ax.hist(columns[:, i], bins=25, color="tab:blue", alpha=0.6)
        for edge in (posterior.quantiles[names[i]][0], posterior.quantiles[names[i]][2]):
            ax.axvline(edge, color="tab:blue", lw=0.8, ls="--")
        ax.set_yticks([])
    else:
        ax.plot(columns[:, j], columns[:, i], ".", ms=1.5, alpha=0.4)
        ax.axhline(posterior.fitted[names[i]], color="0.6", lw=0.8)
        ax.tick_params(labelleft=j == 0)  # a row shares its scale
    if i == len(names) - 1:
        ax.set_xlabel(f"{names[j]} [{posterior.units.get(names[j], '1')}]", fontsize=7)
    if j == 0 and i > 0:
        ax.set_ylabel(f"{names[i]} [{posterior.units.get(names[i], '1')}]", fontsize=7)
