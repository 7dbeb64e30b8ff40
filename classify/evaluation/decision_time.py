r"""Time to decision: how long contacts last that end by a confidence threshold, and how often the answer is
right.

Each test contact is followed through growing windows and ends where the likeliest candidate reaches a
threshold that training grasps alone have taught (:mod:`thermogrip.classify.decisions.stopping_rule`), or
where contact ends anyway.  Two kinds of classifiers can be followed:

- one that reads any beginning of a trace (the effusivity posterior) is fitted once; its training grasps are
  those that calibrated the gripper, a handful of common numbers;
- any other is fitted anew for every window, on training grasps cut alike.  It would know its training grasps
  by heart, so c comes from grasps held out inside the training (whole sessions where there are several).
  Those whose fits take long are left out with a note.

The grasps of all conditions learn one threshold together: n training grasps cannot show an error below
1 / (n + 2), and where fewer are given the error is raised to that, with a note.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone

from thermogrip.classify.decisions.predict import Row
from thermogrip.classify.decisions.stopping_rule import (
    StopRule,
    Windows,
    contact_end,
    growing_windows,
    learn_from_windows,
    stops,
)
from thermogrip.classify.estimators.base import Floats, GraspClassifier, grasp_labels, pick
from thermogrip.classify.estimators.margins import inner_folds
from thermogrip.classify.evaluation.comparison import POOLED, grasp_numbers
from thermogrip.classify.evaluation.harness import cut_at
from thermogrip.classify.evaluation.metrics import clopper_pearson, mean_intervals
from thermogrip.classify.evaluation.splits import Fold, plan_folds
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.parallel import Progress
from thermogrip.datasets.schema import Grasps

WINDOW_ENDS = (0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 7.0)
"""When the rule is evaluated [s after the closed message]."""

_LEAST_GRASPS = 3  # of each material, so that two are left where one is held out

Part = tuple[Windows, NDArray[np.int64]]


@dataclass(frozen=True)
class Decisions:
    """Where contacts ended: ``rows`` of ``classifier, repeat, condition, grasp_id, time, end, correct,
    correct_at_end, early, p_wrong`` (the probability of an error when it ended), the ``rules`` of each
    classifier, one a repeat, and ``notes`` on those left out."""

    rows: tuple[Row, ...]
    rules: Mapping[str, tuple[StopRule, ...]]
    notes: tuple[str, ...]

    @property
    def classifiers(self) -> tuple[str, ...]:
        """Names, in the order given."""
        return tuple(self.rules)

    def table(self, *, level: float = 0.95, seed: int = 0) -> list[Row]:
        """Return a row for each classifier and condition, ``pooled`` first where there are several.

        ``n`` distinct grasps; ``time`` mean [s] with its bootstrap interval over grasps; ``end``, mean length
        of the whole contacts; ``accuracy`` where they stopped, with its Clopper-Pearson interval;
        ``accuracy_at_end``; ``early``, share that stopped before the end, ``wrong_early``, share of these
        that was wrong, with its Clopper-Pearson interval, ``expected_early``, what the classifier itself
        expected of them, and ``error`` that was stated.
        """
        table = []
        for name, rules in self.rules.items():
            own = [row for row in self.rows if row["classifier"] == name]
            names = dict.fromkeys(row["condition"] for row in own)
            groups = {c: [row for row in own if row["condition"] == c] for c in names}
            if len(groups) > 1:
                groups = {POOLED: own} | groups
            error = max(rule.error for rule in rules)
            for condition, rows in groups.items():
                head = {"classifier": name, "condition": condition, "error": error}
                table.append(head | _scores(rows, level, seed))
        return table


def decision_times(
    classifiers: Mapping[str, GraspClassifier],
    conditions: Sequence[Grasps],
    *,
    split: str = "shipped",
    repeats: int = 5,
    train_per_class: int = 5,
    error: float = 0.05,
    times: Sequence[float] = WINDOW_ENDS,
    seed: int = 0,
    progress: Progress | None = None,
) -> Decisions:
    """Return when each classifier would have ended the contacts at a stated ``error``, evaluated at ``times``
    [s], and whether it was right then, without conditions that have two touches or objects of unknown
    temperature; the other arguments are those of ``evaluate``."""
    followed = {name: c for name, c in classifiers.items() if c.reads_beginnings or c.fits_in_a_blink}
    notes = [
        f"{n}: training it for each window takes long, left out" for n in classifiers if n not in followed
    ]
    if not followed:
        raise UserError("no classifier can be followed through a contact", hint="add posterior or pca-lda")
    plan = plan_folds(conditions, split=split, repeats=repeats, train_per_class=train_per_class, seed=seed)
    folds = [fold for fold in map(_known, plan.folds) if fold is not None and not fold.apart]
    large = [fold for fold in folds if _fewest(fold) >= _LEAST_GRASPS]
    rows: list[Row] = []
    rules: dict[str, tuple[StopRule, ...]] = {}
    for k, (name, classifier) in enumerate(followed.items()):
        some, learnt = folds if classifier.reads_beginnings else large, []
        rounds = sorted({fold.repeat for fold in some})
        for i, repeat in enumerate(rounds):
            if progress is not None:
                progress((k + i / len(rounds)) / len(followed), name)
            own = [fold for fold in some if fold.repeat == repeat]
            seen = _windows(classifier, own, plan.training[repeat], times)
            rule = _rule([train for train, _ in seen], error, times)
            rows += [row for fold, (_, test) in zip(own, seen) for row in _stopped(name, fold, rule, test)]
            learnt.append(rule)
        if learnt:
            rules[name] = tuple(learnt)
        if len(some) < len(folds):
            notes.append(f"{name}: {len(folds) - len(some)} conditions with too few training grasps left out")
    notes += [
        f"{name}: {r[0].n_grasp} training grasps show an error of {r[0].error:.2g} at best"
        for name, r in rules.items()
        if r[0].error > error
    ]
    return Decisions(tuple(rows), rules, tuple(notes))


def _known(fold: Fold) -> Fold | None:
    """Return the fold with those test grasps alone whose material is a candidate."""
    there = np.isin(fold.test["material"].values.astype(str), fold.candidates)
    return replace(fold, test=pick(fold.test, there)) if there.any() else None


def _fewest(fold: Fold) -> int:
    return int(np.unique(grasp_labels(fold.train), return_counts=True)[1].min())


def _windows(
    classifier: GraspClassifier, folds: Sequence[Fold], training: Sequence[Grasps], times: Sequence[float]
) -> list[tuple[Part, Part]]:
    """Return what is seen of the training and of the test grasps of each fold."""
    if not classifier.reads_beginnings:
        return [_refitted(classifier, fold, times) for fold in folds]
    fitted = clone(classifier).fit(
        list(training) if classifier.learns_from_all_conditions else folds[0].train
    )
    seen = []
    for fold in folds:
        how: dict[str, Any] = {"candidates": fold.candidates, "times": times, "gain": False}
        train, test = (
            (growing_windows(fitted, part, end=contact_end(part, fitted.longest_), **how), _truth(part, fold))
            for part in (fold.train, fold.test)
        )
        seen.append((train, test))
    return seen


def _refitted(classifier: GraspClassifier, fold: Fold, times: Sequence[float]) -> tuple[Part, Part]:
    """Return windows from a classifier that is fitted for each, training grasps as held-out ones."""
    end = min(contact_end(fold.train, np.inf), contact_end(fold.test, np.inf))
    at = [*(t for t in sorted(times) if t < end), end]
    inner = inner_folds(fold.train, grasp_labels(fold.train))
    held = np.sort(np.concatenate([b for _, b in inner])) if inner else np.empty(0, dtype=np.int64)
    tested, kept = [], []
    for t in at:
        train, test = cut_at(fold.train, t), cut_at(fold.test, t)
        tested.append(clone(classifier).fit(train).candidate_log_proba(test, fold.candidates))
        kept.append(_held_out(classifier, train, inner, fold.candidates)[held])
    train_truth = _truth(fold.train, fold)[held]
    return (_as_windows(at, kept), train_truth), (_as_windows(at, tested), _truth(fold.test, fold))


def _held_out(
    classifier: GraspClassifier,
    train: Grasps,
    inner: Sequence[tuple[NDArray[np.int64], NDArray[np.int64]]],
    candidates: Sequence[str],
) -> Floats:
    out = np.zeros((train.sizes["grasp"], len(candidates)))
    for fitted, held in inner:
        model = clone(classifier).fit(pick(train, fitted))
        out[held] = model.candidate_log_proba(pick(train, held), candidates)
    return out


def _as_windows(at: Sequence[float], log_p: Sequence[Floats]) -> Windows:
    stacked = np.stack(log_p, axis=1)
    return Windows(np.asarray(at, dtype=float), stacked, np.full(stacked.shape[:2], np.inf))


def _truth(grasps: Grasps, fold: Fold) -> NDArray[np.int64]:
    return np.array([fold.candidates.index(label) for label in grasp_labels(grasps)], dtype=np.int64)


def _rule(parts: Sequence[Part], error: float, times: Sequence[float]) -> StopRule:
    """Return the threshold of the training grasps, the error raised to what so many can show."""
    n = sum(truth.size for _, truth in parts)
    return learn_from_windows(parts, error=max(error, 1 / (n + 2)), loss=0.0, times=times, end=np.inf)


def _stopped(name: str, fold: Fold, rule: StopRule, part: Part) -> list[Row]:
    seen, truth = part
    found = stops(rule, seen)
    last = seen.log_p[:, -1].argmax(axis=1)
    return [
        {
            "classifier": name,
            "repeat": fold.repeat,
            "condition": fold.condition,
            "grasp_id": str(fold.test["grasp"].values[i]),
            "time": float(found.time[i]),
            "end": float(seen.times[-1]),
            "correct": bool(found.answer[i] == truth[i]),
            "correct_at_end": bool(last[i] == truth[i]),
            "early": bool(found.early[i]),
            "p_wrong": float(found.p_wrong[i]),
        }
        for i in range(truth.size)
    ]


def _scores(rows: Sequence[Row], level: float, seed: int) -> dict[str, Any]:
    grasp = grasp_numbers(rows)
    n = int(grasp.max()) + 1
    keys = ("time", "correct", "correct_at_end", "end")
    columns = np.array([[float(row[key]) for key in keys] for row in rows])
    time, right, last, end = mean_intervals(columns, grasp, level=level, seed=seed)
    low, high = clopper_pearson(right.value * n, n, level=level)
    return {
        "n": n,
        "tested": len(rows),
        "time": time.value,
        "time_low": time.low,
        "time_high": time.high,
        "end": end.value,
        "accuracy": right.value,
        "low": low,
        "high": high,
        "accuracy_at_end": last.value,
        **_early_scores(rows, grasp, level),
    }


def _early_scores(rows: Sequence[Row], grasp: NDArray[np.int64], level: float) -> dict[str, Any]:
    """Return what became of the contacts that ended early; n counts distinct grasps."""
    at = [i for i, row in enumerate(rows) if row["early"]]
    names = ("wrong_early", "wrong_early_low", "wrong_early_high", "expected_early")
    share = {"early": len(at) / len(rows)}
    if not at:
        return share | dict.fromkeys(names)
    wrong = sum(not rows[i]["correct"] for i in at) / len(at)
    n = np.unique(grasp[at]).size
    low, high = clopper_pearson(wrong * n, n, level=level)
    expected = sum(rows[i]["p_wrong"] for i in at) / len(at)
    return share | dict(zip(names, (wrong, low, high, expected)))
