"""Figures of curves: accuracy and log loss over training grasps, contact time or temperature difference."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from thermogrip.classify.decisions.predict import Row
from thermogrip.classify.figures import MARKERS, PALETTE, make_grid
from thermogrip.datasets.errors import UserError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["curve_figure"]

_LABELS = {
    "train_per_class": "training grasps of each material",
    "contact_s": "contact time [s]",
    "difference_K": "object warmer than skin by [K]",
}


def curve_figure(rows: Sequence[Row], over: str) -> Figure:
    """Draw accuracy with its interval, and log loss, against one column.

    Parameters
    ----------
    rows : sequence of dict
        Of :mod:`thermogrip.classify.evaluation.curves`; several rows of a classifier at one place are drawn
        apart.
    over : {"train_per_class", "contact_s", "difference_K"}
        The column.

    Raises
    ------
    UserError
        If there are no rows.
    """
    if not rows:
        raise UserError("there is no curve to draw", mend="give at least one point")
    figure, [[left, right]] = make_grid(1, 2, size=(7.6, 3.0))
    names = list(dict.fromkeys(row["classifier"] for row in rows))
    span = max(row[over] for row in rows) - min(row[over] for row in rows)
    for k, name in enumerate(names):
        mine = sorted((row for row in rows if row["classifier"] == name), key=lambda row: row[over])
        shift = 0.008 * span * (k - (len(names) - 1) / 2)  # so that intervals do not cover each other
        at, colour = [row[over] + shift for row in mine], PALETTE[k % 8]
        left.vlines(at, [r["low"] for r in mine], [r["high"] for r in mine], color=colour, lw=1, alpha=0.6)
        line = "" if over == "difference_K" else "-"
        left.plot(at, [r["accuracy"] for r in mine], line + MARKERS[k % 8], color=colour, ms=4, lw=1.1)
        right.plot(
            at, [r["log_loss"] for r in mine], line + MARKERS[k % 8], color=colour, ms=4, lw=1.1, label=name
        )
    chance = {round(row["log_loss_chance"], 6) for row in rows}
    if len(chance) == 1:
        guess = chance.pop()  # told in words too: a good classifier's page ends below it
        right.axhline(guess, color="#9aa7b5", lw=0.8, ls=":", label=f"chance: log loss {guess:.2f}")
    left.set(ylim=(0, 1.02), ylabel="accuracy, 95 % interval", xlabel=_LABELS[over])
    right.set(ylabel="log loss", xlabel=_LABELS[over])
    worst = 2 * max(row["log_loss_chance"] for row in rows)  # what is worse than that is off the page
    right.set_ylim(0, min(worst, 1.1 * max(row["log_loss"] for row in rows)))
    if over == "train_per_class":
        for axis in (left, right):
            axis.set_xticks(sorted({row[over] for row in rows}))
    figure.legend(loc="outside upper center", ncols=min(6, len(names) + 1), frameon=False, fontsize=8)
    return figure
