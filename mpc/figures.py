"""A closed loop on one sheet: what the skin did, what it was asked, what it cost."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermogrip.mpc.closed_loop import ClosedLoop

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["closed_loop_figure"]

_COLOURS = ("#1f5fa8", "#c8553d", "#17703f", "#8a5a00", "#7a4fa3")


def closed_loop_figure(run: ClosedLoop, title: str = "") -> Figure:
    """Draw the temperatures with target and band, the drive with its range, and any status but ``ok``.

    Parameters
    ----------
    run : ClosedLoop
    title : str, optional

    Returns
    -------
    figure : matplotlib.figure.Figure
        Made without ``pyplot``: no window system is asked for.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.6), layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(2.4, 1.0))
    controlled = list(run.target)
    for k, (name, values) in enumerate(run.outputs.items()):
        strong = name in controlled
        top.plot(
            run.time,
            values,
            color=_COLOURS[k % 5],
            lw=1.4 if strong else 0.9,
            alpha=1.0 if strong else 0.6,
            label=name,
        )
    for name in controlled:
        goal = run.target[name]
        top.step(
            run.sample_time, goal, where="post", color="#1d2733", lw=0.9, ls="--", label=f"target of {name}"
        )
        top.fill_between(
            run.sample_time, goal - run.band, goal + run.band, step="post", color="#1d2733", alpha=0.12, lw=0
        )
    for segment in run.segments:
        if np.isfinite(segment.settle_s):
            top.axvline(segment.begin_s + segment.settle_s, color="#5b6776", lw=0.7, ls=":")
    for k, (name, values) in enumerate(run.drive.items()):
        bottom.step(run.sample_time, values, where="post", color=_COLOURS[(k + 1) % 5], lw=0.9, label=name)
        for end in run.drive_range[name]:
            bottom.axhline(end, color="#9aa7b5", lw=0.6)
    odd = np.array([status != "ok" for status in run.status])
    if odd.any():
        first = next(iter(run.drive.values()))
        bottom.plot(run.sample_time[odd], first[odd], "x", color="#a3262a", ms=4, label="status not ok")
    top.set_ylabel("temperature [degC]")
    bottom.set_ylabel("drive")
    bottom.set_xlabel("time [s]")
    if title:
        top.set_title(title, fontsize=10)
    for axis in (top, bottom):
        axis.legend(frameon=False, fontsize=7, loc="best")
    return figure
