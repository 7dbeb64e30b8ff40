"""Accuracy and log loss against what an experimenter can choose: training grasps, contact time, difference.

Every point is a comparison of its own on the same random splits by grasp, and its interval counts distinct
grasps.  Contact time cuts training and test grasps alike: a classifier for 1 s was trained on 1 s.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from thermogrip.classify.decisions.predict import Row
from thermogrip.classify.estimators.base import GraspClassifier, grasp_labels, level
from thermogrip.classify.evaluation.comparison import POOLED, Comparison
from thermogrip.classify.evaluation.harness import evaluate
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.parallel import Progress, sub_progress
from thermogrip.datasets.schema import Grasps, check_grasps, log_name, unit_names

__all__ = ["contact_time_curve", "cut_at", "difference_curve", "learning_curve"]

Named = Sequence[str | GraspClassifier] | Mapping[str, GraspClassifier]


def learning_curve(
    classifiers: Named,
    conditions: Sequence[Grasps],
    *,
    sizes: Sequence[int] = (2, 3, 4, 5, 6),
    repeats: int = 10,
    seed: int = 0,
    workers: int = 1,
    progress: Progress | None = None,
) -> list[Row]:
    """Return scores, pooled over the conditions, against the number ``train_per_class`` of training grasps of
    each material; sizes that leave nothing to test are left out."""
    room = min(_fewest(grasps) for grasps in conditions)
    fit = [size for size in sizes if size < room]
    if not fit:
        raise UserError(f"{room} grasps of a material leave none to test", hint="give smaller sizes")
    points = [(size, list(conditions), size) for size in fit]
    return _curve("train_per_class", classifiers, points, repeats, seed, workers, progress)


def contact_time_curve(
    classifiers: Named,
    conditions: Sequence[Grasps],
    *,
    times: Sequence[float] = (1.0, 2.0, 5.0, 10.0),
    repeats: int = 5,
    train_per_class: int = 5,
    seed: int = 0,
    workers: int = 1,
    progress: Progress | None = None,
) -> list[Row]:
    """Return scores against contact time ``contact_s`` [s], as :func:`learning_curve`."""
    end = min(float(grasps["time"].values[-1]) for grasps in conditions)
    fit = [t for t in times if t <= end + 1e-6]
    if not fit:
        raise UserError(f"the grasps end at {end:g} s", hint="give shorter times")
    points = [(t, [cut_at(grasps, t) for grasps in conditions], train_per_class) for t in fit]
    return _curve("contact_s", classifiers, points, repeats, seed, workers, progress)


def _curve(
    column: str,
    classifiers: Named,
    points: Sequence[tuple[float, list[Grasps], int]],
    repeats: int,
    seed: int,
    workers: int,
    progress: Progress | None,
) -> list[Row]:
    """Return the pooled scores of an evaluation at each point, of its records and training grasps a class."""
    rows = []
    for k, (point, records, train_per_class) in enumerate(points):
        scores = evaluate(
            classifiers,
            records,
            split="random",
            repeats=repeats,
            train_per_class=train_per_class,
            seed=seed,
            workers=workers,
            probe=False,
            progress=sub_progress(progress, k / len(points), (k + 1) / len(points)),
        ).scores()
        pooled = [row for row in scores if row["condition"] == POOLED]
        rows += [{column: point} | row for row in pooled or scores]
    return rows


def difference_curve(comparison: Comparison, conditions: Sequence[Grasps]) -> list[Row]:
    """Return the score rows against ``difference_K``, the mean of object less skin [K], in its order among
    conditions of as many materials; without those of unknown object temperature."""
    found = {log_name(grasps): _difference(grasps) for grasps in conditions}
    rows = [
        {"difference_K": found[row["condition"]]} | row
        for row in comparison.scores()
        if np.isfinite(found.get(row["condition"], np.nan)) and not row["apart"]
    ]
    place = comparison.classifiers.index
    return sorted(rows, key=lambda r: (r["materials"], place(r["classifier"]), abs(r["difference_K"])))


def cut_at(grasps: Grasps, seconds: float) -> Grasps:
    """Return the record as if the touches had ended after so many seconds."""
    kept = np.round(grasps["time"].values, 6) <= seconds + 1e-6
    if kept.sum() < 2 or seconds <= 0:
        raise UserError(f"{seconds:g} s of contact hold no sample", file=log_name(grasps))
    return check_grasps(grasps.isel(time=kept))


def _fewest(grasps: Grasps) -> int:
    labels, units = grasp_labels(grasps), unit_names(grasps)
    return min(np.unique(units[labels == m]).size for m in np.unique(labels))


def _difference(grasps: Grasps) -> float:
    if "t_object" not in grasps:
        return float("nan")
    return float(np.mean(grasps["t_object"].values - level(grasps)))
