"""Charts of a session: closed loops and grasps.

Those of a plant are in :mod:`thermogrip.report.plant`, figures of a classifier's results in
:mod:`thermogrip.classify.figures`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from thermogrip.datasets.limits import LARGEST
from thermogrip.datasets.schema import Grasps, Log, column, log_name, names
from thermogrip.report.charts import DASHES, INK, PALETTE, SOFT, Chart, Curve, Panel, with_unit

if TYPE_CHECKING:
    from thermogrip.mpc.closed_loop.simulate import ClosedLoop


def loops_chart(runs: Mapping[str, Log], targets: Mapping[str, float], output: str = "t_surface") -> Chart:
    """Return closed loops side by side by title: the regulated temperature and its target [degC] above, the
    drive below."""
    columns = []
    for title, log in runs.items():
        t = np.asarray(log["time"].values, dtype=float)
        t = t - t[0]
        goal = Curve("target", t[[0, -1]], np.full(2, targets[title]), INK, 1.0, "--")
        others = tuple(
            Curve(n, t, column(log, n), PALETTE[(5 + j) % 8], 0.9)
            for j, n in enumerate(name for name in names(log, "output") if name != output)
        )
        drives = tuple(
            Curve(with_unit(u, log[u].attrs["units"]), t, column(log, u), PALETTE[(1 + j) % 8], step=True)
            for j, u in enumerate(names(log, "input"))
        )
        regulated = Curve(output, t, column(log, output), PALETTE[0], 1.6)
        top = Panel("temperature [degC]", (*others, goal, regulated), title, 2.2)
        columns.append((top, Panel("inputs", drives)))
    return Chart(tuple(columns), wide=3.6)


def closed_loop_chart(run: ClosedLoop, *, limits: Mapping[str, tuple[float, float]] | None = None) -> Chart:
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
    rows = [Panel("regulated [degC]", tuple(regulated), height=2.4, marks=settled)]
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
