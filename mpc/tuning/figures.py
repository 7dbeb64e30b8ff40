"""Closed loops on a sheet: what the outputs did, what was asked of them, and what the drives did."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from thermogrip.datasets.charts import INK, PALETTE, SOFT, Chart, Curve, Panel, draw_chart
from thermogrip.datasets.limits import LARGEST
from thermogrip.mpc.closed_loop.simulate import ClosedLoop

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def closed_loop_figure(
    run: ClosedLoop,
    title: str = "",
    *,
    limits: Mapping[str, tuple[float, float]] | None = None,
) -> Figure:
    """Draw the regulated outputs with target and band, the others with their limits, and the drives.

    Parameters
    ----------
    run : ClosedLoop
    title : str, optional
    limits : mapping of str to (float, float), optional
        Of outputs, e.g. the tank's [degC].

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
    return draw_chart(closed_loop_chart(run, title, limits=limits))


def closed_loop_chart(
    run: ClosedLoop,
    title: str = "",
    *,
    limits: Mapping[str, tuple[float, float]] | None = None,
) -> Chart:
    """Return what :func:`closed_loop_figure` draws as a chart."""
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
