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
    """Return scores against the number of training grasps of each material.

    Parameters
    ----------
    classifiers, conditions, seed, workers, progress
        As in :func:`~thermogrip.classify.evaluation.harness.evaluate`.
    sizes : sequence of int, optional
        Training grasps a material; those that leave nothing to test are left out.
    repeats : int, optional
        Random splits of each size.

    Returns
    -------
    rows : list of dict
        ``train_per_class`` beside the columns of :meth:`Comparison.scores`, pooled over the conditions.

    Examples
    --------
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> wood_or_metal = load_example_grasps()["exp3B_obj28_grip48"]
    >>> rows = learning_curve(["pca-lda"], [wood_or_metal], sizes=(2, 5), repeats=2)
    >>> [row["train_per_class"] for row in rows], rows[1]["log_loss"] < rows[0]["log_loss"]
    ([2, 5], True)
    """
    room = min(_fewest(grasps) for grasps in conditions)
    fit = [size for size in sizes if size < room]
    if not fit:
        raise UserError(f"{room} grasps of a material leave none to test", hint="give smaller sizes")
    rows = []
    for k, size in enumerate(fit):
        found = evaluate(
            classifiers,
            conditions,
            split="random",
            repeats=repeats,
            train_per_class=size,
            seed=seed,
            workers=workers,
            probe=False,
            progress=sub_progress(progress, k / len(fit), (k + 1) / len(fit)),
        )
        rows += [{"train_per_class": size} | row for row in _overall(found)]
    return rows


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
    """Return scores against contact time; as :func:`learning_curve`, with ``contact_s`` in its place.

    Examples
    --------
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> grasps = load_example_grasps()["exp2_dT20"]
    >>> rows = contact_time_curve(["pca-lda"], [grasps], times=(0.5, 10.0), repeats=2)
    >>> [row["contact_s"] for row in rows], rows[0]["accuracy"] <= rows[1]["accuracy"]
    ([0.5, 10.0], True)
    """
    end = min(float(grasps["time"].values[-1]) for grasps in conditions)
    fit = [t for t in times if t <= end + 1e-6]
    if not fit:
        raise UserError(f"the grasps end at {end:g} s", hint="give shorter times")
    rows = []
    for k, t in enumerate(fit):
        found = evaluate(
            classifiers,
            [cut_at(grasps, t) for grasps in conditions],
            split="random",
            repeats=repeats,
            train_per_class=train_per_class,
            seed=seed,
            workers=workers,
            probe=False,
            progress=sub_progress(progress, k / len(fit), (k + 1) / len(fit)),
        )
        rows += [{"contact_s": t} | row for row in _overall(found)]
    return rows


def difference_curve(comparison: Comparison, conditions: Sequence[Grasps]) -> list[Row]:
    """Return scores against the temperature difference: conditions of as many materials, in its order.

    Returns
    -------
    rows : list of dict
        ``difference_K`` (mean of what the object is warmer than the skin) beside the columns of
        :meth:`Comparison.scores`; conditions without known object temperatures are left out.
    """
    found = {log_name(grasps): _difference(grasps) for grasps in conditions}
    rows = [
        {"difference_K": found[row["condition"]]} | row
        for row in comparison.scores()
        if np.isfinite(found.get(row["condition"], np.nan)) and not row["apart"]
    ]
    place = comparison.classifiers.index
    return sorted(rows, key=lambda r: (r["materials"], place(r["classifier"]), abs(r["difference_K"])))


def cut_at(grasps: Grasps, seconds: float) -> Grasps:
    """Return the record as if the touches had ended after so many seconds.

    Examples
    --------
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> float(cut_at(load_example_grasps()["exp2_dT20"], 1.5)["time"].values[-1])
    1.5
    """
    kept = np.round(grasps["time"].values, 6) <= seconds + 1e-6
    if kept.sum() < 2 or seconds <= 0:
        raise UserError(f"{seconds:g} s of contact hold no sample", file=log_name(grasps))
    return check_grasps(grasps.isel(time=kept))


def _overall(found: Comparison) -> list[Row]:
    rows = found.scores()
    pooled = [row for row in rows if row["condition"] == POOLED]
    return pooled or rows


def _fewest(grasps: Grasps) -> int:
    labels, units = grasp_labels(grasps), unit_names(grasps)
    return min(np.unique(units[labels == m]).size for m in np.unique(labels))


def _difference(grasps: Grasps) -> float:
    if "t_object" not in grasps:
        return float("nan")
    return float(np.mean(grasps["t_object"].values - level(grasps)))
