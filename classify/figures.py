"""Figures of a comparison: accuracy, confusions, reliability, effusivity strips, curves, times to decision.

All are matplotlib figures made without ``pyplot``: no window system, nothing global.  Colours are those of
Okabe and Ito, which differ for every kind of colour vision, and each classifier has a marker of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermogrip.classify.evaluation.comparison import POOLED, Comparison
from thermogrip.datasets.errors import UserError
from thermogrip.media.rendering import panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from thermogrip.sysid.effusivity.posterior import EffusivityRow

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8a8a2a")
MARKERS = ("o", "s", "D", "^", "v", "P", "X", "*")
_INK, _FAINT = "#1d2733", "#c4ccd4"


def accuracy_figure(comparison: Comparison) -> Figure:
    """Draw the accuracy of each classifier with its interval and chance: a row a condition, ``pooled`` on
    top, those scored apart below a line."""
    rows = comparison.scores()
    order = sorted(
        dict.fromkeys(r["condition"] for r in rows),
        key=lambda c: (c != POOLED, any(r["apart"] for r in rows if r["condition"] == c)),
    )
    count = len(comparison.classifiers)
    figure, [[axis]] = panels(1, 1, size=(9.6, 1.5 + len(order) * (0.22 + 0.11 * count)), ticks=7)
    for row in rows:
        k = comparison.classifiers.index(row["classifier"])
        y = order.index(row["condition"]) + 0.7 * ((k + 0.5) / count - 0.5)
        axis.plot([row["low"], row["high"]], [y, y], color=PALETTE[k % 8], lw=1.6, solid_capstyle="butt")
        axis.plot(row["accuracy"], y, MARKERS[k % 8], ms=5, color=PALETTE[k % 8], mec="white", mew=0.5)
        guess = 1 / np.exp(row["log_loss_chance"])
        axis.plot([guess, guess], [y - 0.35 / count, y + 0.35 / count], color=_FAINT, lw=2, zorder=0)
    counts = {r["condition"]: (r["n"], r["n_test"]) for r in reversed(rows)}
    labels = [
        f"{c}  (n = {n})" if n == of else f"{c}  (n = {n} of {of})" for c in order for n, of in [counts[c]]
    ]
    axis.set_yticks(range(len(order)), labels)
    for k, name in enumerate(comparison.classifiers):
        axis.plot([], [], MARKERS[k % 8], ls="-", ms=5, color=PALETTE[k % 8], label=name)
    axis.plot([], [], color=_FAINT, lw=2, label="chance")
    apart = [i for i, c in enumerate(order) if any(r["apart"] for r in rows if r["condition"] == c)]
    if apart and apart[0] > 0:
        axis.axhline(apart[0] - 0.5, color=_INK, lw=0.6, ls=":")
    axis.set(xlim=(-0.02, 1.02), ylim=(len(order) - 0.5, -0.5), xlabel="accuracy on test grasps")
    figure.legend(loc="outside upper center", ncols=min(5, count + 1), frameon=False, fontsize=8)
    return figure


def confusion_figure(comparison: Comparison, condition: str = POOLED) -> Figure:
    """Draw the confusion matrix of each classifier: shares of each true material, with counts a split."""
    names = [c for c in comparison.classifiers if comparison.confusion(c, condition)[0]]
    if not names:
        raise UserError(
            f"nothing was tested in {condition!r}", hint=f"there are {', '.join(comparison.conditions)}"
        )
    across = len(names) if len(names) < 5 else 3 if len(names) < 7 else 4
    down = -(-len(names) // across)
    wide = 3.1 if across < 4 else 2.5
    figure, axes = panels(down, across, size=(wide * across, wide * down + 0.2), ticks=7)
    for axis, name in zip(axes.ravel(), names):
        _confusion(axis, *comparison.confusion(name, condition))
        axis.set_title(name, fontsize=9)
    for axis in axes.ravel()[len(names) :]:
        axis.set_axis_off()
    figure.suptitle(f"{condition}: true material (rows), named as (columns)\n", fontsize=9)
    return figure


def reliability_figure(comparison: Comparison, condition: str = POOLED) -> Figure:
    """Draw accuracy against confidence of each classifier, with intervals and the grasps in each bin."""
    count = len(comparison.classifiers)
    figure, axes = panels(
        2, count, size=(2.4 * count, 3.2), heights=(3, 1), sharex="col", sharey="row", ticks=7
    )
    for k, name in enumerate(comparison.classifiers):
        bins = comparison.calibration(name, condition)
        top, bottom = axes[0, k], axes[1, k]
        top.plot([0, 1], [0, 1], color=_FAINT, lw=1)
        for b in bins:
            top.plot(
                [b["confidence"]] * 2, [b["accuracy_low"], b["accuracy_high"]], color=PALETTE[k % 8], lw=1.2
            )
        top.plot(
            [b["confidence"] for b in bins],
            [b["accuracy"] for b in bins],
            MARKERS[k % 8],
            ms=5,
            color=PALETTE[k % 8],
            clip_on=False,
        )
        centers = [(b["low"] + b["high"]) / 2 for b in bins]
        bottom.bar(centers, [b["n"] / comparison.repeats for b in bins], width=0.08, color=PALETTE[k % 8])
        top.set(xlim=(-0.04, 1.04), ylim=(-0.04, 1.04), xticks=(0, 0.5, 1), aspect="auto")
        top.set_title(name, fontsize=9)
        bottom.set_xlabel("confidence")
    axes[0, 0].set_ylabel("accuracy")
    axes[1, 0].set_ylabel("grasps")
    figure.suptitle(condition, fontsize=9)
    return figure


def effusivity_figure(rows: Sequence[EffusivityRow], library: Mapping[str, float]) -> Figure:
    """Draw the posterior of each grasp as a strip on a logarithmic effusivity axis [W s^0.5 m^-2 K^-1], with
    lines for the library."""
    if not rows:
        raise UserError("there is no posterior to draw", hint="give at least one grasp")
    figure, [[axis]] = panels(1, 1, size=(9.6, 1.2 + 0.16 * len(rows)), ticks=7)
    for i, row in enumerate(rows):
        axis.plot([row.effusivity_p05, row.effusivity_p95], [i, i], color=PALETTE[0], lw=4, alpha=0.45)
        axis.plot(row.effusivity, i, MARKERS[0], ms=4.5, color=PALETTE[0])
    axis.set_xscale("log")
    axis.tick_params(axis="x", which="minor", labelsize=7)
    _library_lines(axis, library)
    axis.set_yticks(range(len(rows)), [row.grasp_id for row in rows], fontsize=6)
    axis.set_ylim(len(rows) - 0.3, -0.7)
    axis.set_xlabel("effusivity [W s$^{0.5}$ m$^{-2}$ K$^{-1}$], median and 90 % interval")
    return figure


def _confusion(axis: Axes, names: list[str], counts: NDArray[np.float64]) -> None:
    share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1e-12)
    axis.imshow(share, cmap="Blues", vmin=0, vmax=1)
    for (i, j), n in np.ndenumerate(counts):
        if n > 0:
            ink = "white" if share[i, j] > 0.55 else _INK
            # a mean of counts with as many digits as one reads
            count = f"{n:.0f}" if n == round(n) else f"{n:.1f}" if n > 1 else f"{n:.2g}"
            axis.text(j, i, count, ha="center", va="center", fontsize=7, color=ink)
    axis.set_xticks(range(len(names)), names, rotation=45, ha="right", fontsize=7)
    axis.set_yticks(range(len(names)), names, fontsize=7)
    axis.grid(False)


def _library_lines(axis: Axes, library: Mapping[str, float]) -> None:
    """Draw a line with its name for each of the library's effusivities that the axis shows."""
    low, high = axis.get_xlim()
    text: dict[str, Any] = {"rotation": 90, "fontsize": 6, "ha": "center", "va": "bottom"}
    for name, effusivity in library.items():
        if low <= effusivity <= high:
            axis.axvline(effusivity, color=_FAINT, lw=0.8, zorder=0)
            axis.text(effusivity, 1.01, name, transform=axis.get_xaxis_transform(), **text)
