"""Figures of decisions: when contacts end, what contact time tells, and what a next touch would tell.

Made without ``pyplot``, in the colours of :mod:`thermogrip.classify.figures`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thermogrip.classify.decisions.next_touch import NextTouch
from thermogrip.classify.decisions.stopping_rule import StopRule, Windows, stops
from thermogrip.classify.figures import MARKERS, PALETTE
from thermogrip.datasets.errors import UserError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from thermogrip.classify.evaluation.decision_time import Decisions

__all__ = ["contact_time_figure", "decision_figure", "next_touch_figure", "stop_time_figure"]

_INK, _FAINT = "#1d2733", "#c4ccd4"


def contact_time_figure(conditions: Mapping[str, tuple[Windows, NDArray[np.int64]]]) -> Figure:
    """Draw accuracy and stated confidence against contact time, a panel a condition.

    Parameters
    ----------
    conditions : mapping of str to (Windows, (n,) ndarray)
        What was seen of test grasps, and the true candidate of each.

    Returns
    -------
    figure : matplotlib.figure.Figure
    """
    figure, axes = _panels(conditions)
    for axis, (name, (seen, true)) in zip(axes, conditions.items()):
        right = (seen.log_p.argmax(axis=2) == true[:, None]).mean(axis=0)
        stated = np.exp(seen.log_p.max(axis=2)).mean(axis=0)
        axis.plot(seen.times, right, "o-", ms=3.5, color=PALETTE[0], label="accuracy")
        axis.plot(seen.times, stated, "s--", ms=3, color=PALETTE[1], label="stated confidence")
        axis.set_title(f"{name}, n = {true.size}", fontsize=9)
        _over_time(axis)
        axis.set(ylim=(0, 1.03))
    axes[0].legend(frameon=False, fontsize=8, loc="lower right")
    return figure


def stop_time_figure(rule: StopRule, conditions: Mapping[str, tuple[Windows, NDArray[np.int64]]]) -> Figure:
    """Draw the share of contacts that a rule has ended by each time, and where it named the wrong material.

    Parameters
    ----------
    rule : StopRule
    conditions : mapping of str to (Windows, (n,) ndarray)
        As in :func:`contact_time_figure`.

    Returns
    -------
    figure : matplotlib.figure.Figure
    """
    figure, [axis] = _panels({"all": None})
    figure.set_size_inches(6.4, 3.4)
    for k, (name, (seen, true)) in enumerate(conditions.items()):
        found = stops(rule, seen)
        order = np.argsort(found.time, kind="stable")
        share = (np.arange(true.size) + 1) / true.size
        label = f"{name}: {found.time.mean():.1f} s on average"
        start = np.concatenate([[seen.times[0]], found.time[order]])
        axis.step(start, np.concatenate([[0.0], share]), where="post", color=PALETTE[k % 8], label=label)
        wrong = (found.answer != true)[order]
        axis.plot(found.time[order][wrong], share[wrong], "x", color=PALETTE[k % 8], ms=6)
    axis.plot([], [], "x", color=_INK, label="named wrong")
    _over_time(axis)
    axis.set(ylabel="share of contacts ended", ylim=(0, 1.03))
    figure.legend(loc="outside upper center", ncols=2, frameon=False, fontsize=8)
    return figure


def decision_figure(found: Decisions) -> Figure:
    """Draw when contacts were ended, and accuracy beside their mean time, all conditions together.

    Parameters
    ----------
    found : Decisions
        Of :func:`~thermogrip.classify.evaluation.decision_time.decision_times`.

    Returns
    -------
    figure : matplotlib.figure.Figure
        Left, the share of contacts that has ended by each time; right, a marker for each classifier where its
        contacts ended, with intervals, and a hollow one at their full length.
    """
    figure, [ended, beside] = _panels({"ended": None, "beside": None})
    figure.set_size_inches(8.4, 3.6)
    first: dict[str, dict[str, float]] = {}
    for row in found.table():
        first.setdefault(row["classifier"], row)
    for k, (name, row) in enumerate(first.items()):
        color, marker = PALETTE[k % 8], MARKERS[k % 8]
        times = np.sort([r["time"] for r in found.rows if r["classifier"] == name])
        share = np.arange(1, times.size + 1) / times.size
        at = np.concatenate([[min(0.3, times[0])], times])
        ended.step(at, np.concatenate([[0.0], share]), where="post", color=color, label=name)
        beside.plot([row["time"], row["end"]], [row["accuracy"], row["accuracy_at_end"]], color=color, lw=0.7)
        beside.plot([row["time_low"], row["time_high"]], [row["accuracy"]] * 2, color=color, lw=1.4)
        beside.plot([row["time"]] * 2, [row["low"], row["high"]], color=color, lw=1.4)
        beside.plot(row["time"], row["accuracy"], marker, color=color, ms=6, mec="white")
        beside.plot(row["end"], row["accuracy_at_end"], marker, mfc="white", mec=color, ms=6)
    _over_time(ended)
    if max(row["time"] for row in found.rows) > 20:
        ended.set_xticks([0.3, 1, 3, 10, 30], ["0.3", "1", "3", "10", "30"])
    ended.set(ylabel="share of contacts ended", ylim=(0, 1.03))
    beside.set(xlabel="mean contact time [s]", ylabel="accuracy (hollow: whole contact)", xlim=(0, None))
    figure.legend(loc="outside upper center", ncols=5, frameon=False, fontsize=8)
    return figure


def next_touch_figure(choices: Mapping[str, NextTouch]) -> Figure:
    """Draw expected information and accuracy of another touch against the gripper's temperature.

    Parameters
    ----------
    choices : mapping of str to NextTouch
        A curve each.

    Returns
    -------
    figure : matplotlib.figure.Figure
    """
    if not choices:
        raise UserError("nothing to draw", mend="give at least one choice")
    figure, axes = _panels({"information": None, "accuracy": None})
    for k, (name, choice) in enumerate(choices.items()):
        color = PALETTE[k % 8]
        axes[0].plot(choice.t_gripper, choice.information, "-", color=color, label=name)
        axes[1].plot(choice.t_gripper, choice.accuracy, "-", color=color)
        axes[1].axhline(choice.accuracy_now, color=color, lw=0.8, ls=":")
    axes[0].set(xlabel="gripper in the next touch [degC]", ylabel="expected information [nat]")
    axes[1].set(xlabel="gripper in the next touch [degC]", ylabel="expected accuracy", ylim=(0, 1.03))
    axes[1].set_title("dotted: without it", fontsize=8, color=_INK)
    figure.legend(loc="outside upper center", ncols=2, frameon=False, fontsize=8)
    return figure


def _over_time(axis: Axes) -> None:
    axis.set(xscale="log", xlabel="contact time [s]")
    axis.set_xticks([0.3, 1, 3, 10], ["0.3", "1", "3", "10"])
    axis.minorticks_off()


def _panels(names: Mapping[str, object]) -> tuple[Figure, list[Axes]]:
    from matplotlib.figure import Figure

    if not names:
        raise UserError("nothing to draw", mend="give at least one condition")
    figure = Figure(figsize=(3.2 * len(names), 3.0), layout="constrained")
    axes = list(np.atleast_1d(figure.subplots(1, len(names))))
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(color=_FAINT, lw=0.4)
    return figure, axes
