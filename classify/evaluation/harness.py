"""One harness for every classifier: the same grasps, splits and intervals.

Rules that it keeps:

- splits are those of :mod:`thermogrip.classify.evaluation.splits`, and whatever a classifier does with its
  training grasps, augmentation included, happens inside ``fit``;
- each record is one condition, and its candidates are the materials of its training grasps.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np
from scipy.stats import binom
from sklearn.base import clone
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis

from thermogrip.classify.decisions.predict import Row, joined_touches
from thermogrip.classify.estimators.base import Floats, GraspClassifier, grasp_labels, level, pick, unit_names
from thermogrip.classify.estimators.features import LEAST_DIFFERENCE, object_difference
from thermogrip.classify.estimators.lda import ArrayClassifier, is_estimator
from thermogrip.classify.estimators.registry import classifier_name, make_classifier
from thermogrip.classify.evaluation import metrics as s
from thermogrip.classify.evaluation.comparison import Caution, Comparison
from thermogrip.classify.evaluation.splits import Fold, Plan, plan_folds
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.grasp_files import Records
from thermogrip.datasets.parallel import Progress, Workers, in_order
from thermogrip.datasets.schema import Grasps, log_name
from thermogrip.sysid.effusivity.quality import check_grasps, contact_faults

LAST_UNTOUCHED = -0.5  # s; contact may precede the "closed" message by 0.3 s


@dataclass(frozen=True)
class ProbeSettings:
    """The leak probe: what is before contact, and when a label in it counts."""

    level_until_s: float = -0.25  # contact may precede the closed message by 0.3 s
    level_samples: int = 3  # that show a level
    epochs: int = 100  # enough for a leak that matters
    least_noise_K: float = 0.02  # a sensor that rests on one step shows less than it has
    leak_level: float = 0.01  # of the test, shared among all of them


PROBE = ProbeSettings()


def untouched(grasps: Grasps, *, seed: int = 0) -> Grasps:
    """Return the record as if the gripper had never closed."""
    out = grasps.copy(deep=True)
    time = grasps["time"].values
    rng = np.random.default_rng(seed)
    for key in [k for k in ("t_surface", "t_surface_2") if k in grasps]:
        values, base = out[key].values, level(grasps, key)
        early = values[:, time <= LAST_UNTOUCHED]
        spread = np.nanstd(early, axis=1) if early.shape[1] > 1 else np.zeros(base.size)
        still_trace = base[:, None] + np.maximum(spread, PROBE.least_noise_K)[:, None] * rng.standard_normal(
            values.shape
        )
        # the trace's own level before contact goes on, with noise of the size seen there
        after = (time > LAST_UNTOUCHED)[None, :] & np.isfinite(values)
        out[key] = (("grasp", "time"), np.where(after, still_trace, values), grasps[key].attrs)
    return out


def has_before(grasps: Grasps) -> bool:
    """Return whether a record has a level before contact, without which there is nothing to probe."""
    return bool(np.sum(grasps["time"].values <= PROBE.level_until_s) >= PROBE.level_samples)


def probe_clone(classifier: GraspClassifier) -> GraspClassifier:
    """Return an unfitted copy for the probe; a network trains briefly, enough for a leak that matters."""
    copy: GraspClassifier = clone(classifier)
    if "epochs" in copy.get_params():
        copy.set_params(epochs=min(int(copy.get_params()["epochs"]), PROBE.epochs))
    return copy


def binomial_p(right: float, n: int, by_chance: float) -> float:
    """Return the probability of so many or more right of n by chance."""
    # one-sided: how likely are k or more right of n grasps, at the share of the commonest material?
    return float(binom.sf(np.ceil(right - 1e-9) - 1, n, by_chance))


_PROBE_NAME = "untouched traces"


def evaluate(
    classifiers: Sequence[str | GraspClassifier] | Mapping[str, GraspClassifier],
    conditions: Records,
    *,
    split: str = "shipped",
    repeats: int = 20,
    train_per_class: int = 5,
    test: Records | None = None,
    seed: int = 0,
    workers: Workers = 1,
    probe: bool = True,
    progress: Progress | None = None,
) -> Comparison:
    """Return the predictions of each classifier for each test grasp, and scores.

    Parameters
    ----------
    classifiers : sequence of str or estimator, or dict of name to estimator
        Names as for :func:`~thermogrip.classify.estimators.registry.make_classifier`, or unfitted estimators:
        of thermogrip, or any classifier or pipeline of scikit-learn's kind, which gets the traces as rows
        (:class:`~thermogrip.classify.estimators.lda.ArrayClassifier`).
    conditions : Grasps, str, Path, or sequence of them
        One record a condition, each under its own name.
    split : {"shipped", "random", "session", "block"}, optional
        By the records' ``split`` column, ``repeats`` random splits by grasp, or one session, one block of
        each material held out after the other.
    repeats, train_per_class : int, optional
        Of the random splits.
    test : as ``conditions``, optional
        Test records; the conditions then only train (their grasps marked ``train``, or all).
    seed : int, optional
        Of splits, and of classifiers that are given by name.
    workers : int or str, optional
        Local processes.
    probe : bool, optional
        Run the leak probe, where every record begins before contact.
    progress : callable, optional
        Called with the fraction done and what is being done.

    Returns
    -------
    Comparison

    Raises
    ------
    UserError
        If a name is unknown, a grasp is in training and test, or nothing can be scored.  Of classifiers that
        cannot all be scored ``notes`` has the reason.

    Examples
    --------
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> found = evaluate(["features-lda"], [load_example_grasps()["exp3B_obj28_grip48"]], probe=False)
    >>> [row] = found.scores()
    >>> row["n"], row["accuracy"], round(row["low"], 2)  # nine of nine is "more than 0.66"
    (9, 1.0, 0.66)
    """
    named = _named(classifiers, seed)
    plan = plan_folds(
        conditions, split=split, repeats=repeats, train_per_class=train_per_class, test=test, seed=seed
    )
    late = _late(plan) if probe else ()
    jobs = _jobs(named, plan, probe and not late)
    done = list(in_order(_run_job, jobs, workers, progress, what="train and test"))
    order = {name: i for i, name in enumerate(named)}
    results = sorted(
        (r for job_results in done for r in job_results), key=lambda r: (order.get(r.classifier, -1), r.order)
    )
    faults = [r for r in results if r.fault is not None]
    real = [r for r in results if not r.probe and r.fault is None]
    if faults and not real:
        raise faults[0].fault  # type: ignore[misc]
    # what cannot be scored is noted, not dropped in silence, and the other classifiers are scored
    unable = dict.fromkeys(
        f"{r.classifier} left out of {plan.folds[r.order].condition}: {r.fault}" for r in faults
    )
    return Comparison(
        split="files" if test is not None else split,
        repeats=repeats if split == "random" and test is None else 1,
        seed=seed,
        predictions=tuple(row for r in real for row in r.rows),
        leaks=tuple(_leaks([r for r in results if r.probe and r.fault is None])),
        times=tuple(r.time for r in real),
        notes=(*plan.notes, *late, *unable),
        of_records=(*plan.cautions, *_session_faults(plan)),
    )


def _session_faults(plan: Plan) -> list[Caution]:
    """Return what is wrong with the contacts that a score rests on, those of its own training among them."""
    out: dict[Caution, None] = {}
    for fold in plan.folds:
        for record in (fold.train, fold.test):
            name = log_name(record)
            for words in contact_faults(record, check_grasps(record)) if fold.repeat == 0 else ():
                of_record = f"{name}: {words}" if name != fold.condition else words
                out[Caution("session_fault", fold.condition, of_record)] = None
    return list(out)


@dataclass(frozen=True)
class _Job:
    """One fit: a classifier, its training grasps, and the folds that it then predicts."""

    name: str
    classifier: GraspClassifier
    training: tuple[Grasps, ...]
    folds: tuple[tuple[int, Fold], ...]
    probe: str  # "no", "also" predict untouched grasps, "only" train and predict on untouched grasps


@dataclass(frozen=True)
class _FoldResult:
    classifier: str
    order: int
    probe: bool
    rows: tuple[Row, ...] = ()
    time: Row = field(default_factory=dict)
    fault: UserError | None = None


def _named(
    classifiers: Sequence[str | GraspClassifier] | Mapping[str, GraspClassifier], seed: int
) -> dict[str, GraspClassifier]:
    if isinstance(classifiers, str):
        raise UserError("classifiers is one word", hint="give a list of names")
    if isinstance(classifiers, Mapping):
        named = {
            name: _grasp_classifier(classifier_or_name, seed)
            for name, classifier_or_name in classifiers.items()
        }
    else:
        named = {}
        for classifier_or_name in classifiers:
            classifier = _grasp_classifier(classifier_or_name, seed)
            name = classifier_or_name if isinstance(classifier_or_name, str) else classifier_name(classifier)
            if name in named:
                raise UserError(f"two classifiers are called {name!r}", hint="give a dict of names")
            named[name] = classifier
    if not named:
        raise UserError("no classifier is given", hint="name at least one")
    return named


def _grasp_classifier(given: Any, seed: int) -> GraspClassifier:
    """Return a classifier of grasps from its name, itself, or an estimator of rows."""
    if isinstance(given, GraspClassifier):
        return given
    if isinstance(given, str):
        return make_classifier(given, seed=seed)
    if isinstance(given, type) or not is_estimator(given):
        hint = "give a name, or an unfitted estimator with fit, predict and get_params"
        raise UserError(f"{given!r} is no classifier", hint=hint)
    return ArrayClassifier(given, random_state=seed)


def _late(plan: Plan) -> tuple[str, ...]:
    """Return a note on each record that begins with the contact: there the probe would see touch."""
    records = [*(f.test for f in plan.folds), *(record for training in plan.training for record in training)]
    names = dict.fromkeys(log_name(record) for record in records if not has_before(record))
    return tuple(f"{name}: no three readings before contact, so there was no leak probe" for name in names)


def _jobs(named: Mapping[str, GraspClassifier], plan: Plan, probe: bool) -> list[_Job]:
    """Return all fits; the probe by the classifiers themselves in the first repeat, the generic one, which is
    cheap, in all."""
    numbered = list(enumerate(plan.folds))
    jobs = []
    for name, classifier in named.items():
        together = [
            classifier.learns_from_all_conditions
            and _taught_together(classifier, fold, plan.training[fold.repeat])
            for fold in plan.folds
        ]
        for repeat, training in enumerate(plan.training):
            folds = tuple((i, f) for i, f in numbered if f.repeat == repeat and together[i])
            also = "also" if probe and repeat == 0 else "no"
            if folds:
                jobs.append(_Job(name, classifier, training, folds, also))
        for i, fold in numbered:
            if together[i]:
                continue
            jobs.append(_Job(name, classifier, (fold.train,), ((i, fold),), "no"))
            if probe and fold.repeat == 0:
                jobs.append(_Job(name, probe_clone(classifier), (fold.train,), ((i, fold),), "only"))
    if probe:  # shrinkage LDA of what was before touch, levels included
        lda = LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto")
        generic = ArrayClassifier(lda, start=-np.inf, subtract_level=False)
        jobs += [_Job(_PROBE_NAME, generic, (f.train,), ((i, f),), "only") for i, f in numbered]
    # what takes longest first: a network that begins last leaves other processes idle
    return sorted(jobs, key=lambda job: "epochs" not in job.classifier.get_params())


def _taught_together(classifier: GraspClassifier, fold: Fold, training: Sequence[Grasps]) -> bool:
    """Return whether the training grasps of all conditions serve one of them."""
    # what describes the gripper, the same in all conditions, may be learnt from the training grasps of all
    if classifier.joins_touches:
        return True
    labels_far = [
        grasp_labels(record)[np.abs(object_difference(record)) >= LEAST_DIFFERENCE] for record in training
    ]
    # a classifier that does not join touches learns a condition that is scored apart, or has a material that
    # only other temperatures could show, alone
    return not fold.apart and set(fold.candidates) <= set(np.concatenate(labels_far))


def _run_job(job: _Job) -> list[_FoldResult]:
    classifier: GraspClassifier = clone(job.classifier)
    only = job.probe == "only"
    # without a touch a classifier must be at chance; one that is not has found the label elsewhere: in the
    # gripper's temperature on that day, in the order of the grasps, in a column of the record (on public
    # touch data such a probe reached 0.83 where chance is 0.17)
    training = [untouched(g, seed=1) for g in job.training] if only else list(job.training)
    start = perf_counter()
    try:
        classifier.fit(training if len(training) > 1 else training[0])
    except UserError as fault:
        return [_FoldResult(job.name, order, only, fault=fault) for order, _ in job.folds]
    fit_s = perf_counter() - start
    results = []
    for order, fold in job.folds:
        for touch in (not only, *((False,) if job.probe == "also" else ())):
            try:
                results.append(_tested(job.name, classifier, fold, order, fit_s, touch=touch))
            except UserError as fault:
                results.append(_FoldResult(job.name, order, not touch, fault=fault))
    return results


def _tested(
    name: str, classifier: GraspClassifier, fold: Fold, order: int, fit_s: float, *, touch: bool
) -> _FoldResult:
    """Return the rows of one fold's test grasps by a fitted classifier, and the seconds a grasp; as if they
    had touched nothing where ``touch`` is not."""
    test = fold.test if touch else untouched(fold.test, seed=2)
    candidates, n = fold.candidates, fold.test.sizes["grasp"]
    start = perf_counter()
    if touch:
        log_p, unknown = classifier.open_set_log_proba(test, candidates)
    else:
        log_p, unknown = classifier.candidate_log_proba(test, candidates), np.full(n, np.nan)
    units = unit_names(test)
    log_p = joined_touches(classifier, log_p, units)
    predict_s = (perf_counter() - start) / n
    first = np.sort(np.unique(units, return_index=True)[1])  # one row a unit: its touches share an answer
    head = {"classifier": name, "repeat": fold.repeat, "condition": fold.condition, "apart": fold.apart}
    rows = _fold_rows(pick(test, first), units[first], np.exp(log_p[first]), unknown[first], candidates)
    trained = Counter(map(str, grasp_labels(fold.train)))
    for row in rows:
        row["log_loss_base"] = -np.log(trained[row["material"]] / trained.total()) if row["known"] else None
    time = head | {"fit_s": fit_s, "predict_s_per_grasp": predict_s}
    return _FoldResult(name, order, not touch, tuple(head | row for row in rows), time)


def _fold_rows(
    test: Grasps, units: np.ndarray[Any, Any], p: Floats, unknown: Floats, candidates: tuple[str, ...]
) -> list[Row]:
    materials = [str(m) for m in test["material"].values]
    is_candidate = np.array([m in candidates for m in materials])
    true = np.array([candidates.index(m) if m in candidates else 0 for m in materials])
    loss, squared = s.log_loss(p, true), s.brier(p, true)
    best = p.argmax(axis=1)
    return [
        {
            "grasp_id": str(units[i]),
            "material": materials[i],
            "predicted": candidates[best[i]],
            "known": bool(is_candidate[i]),
            "correct": bool(is_candidate[i] and best[i] == true[i]),
            "confidence": float(p[i, best[i]]),
            "log_loss": float(loss[i]) if is_candidate[i] else None,
            "brier": float(squared[i]) if is_candidate[i] else None,
            "p_unknown": float(unknown[i]) if np.isfinite(unknown[i]) else None,
            "candidates": len(candidates),
            **{f"p_{name}": float(p[i, k]) for k, name in enumerate(candidates)},
        }
        for i in range(len(materials))
    ]


def _leaks(probes: Sequence[_FoldResult]) -> list[Row]:
    """Return a row for each probe and condition; the level is shared among all rows (Bonferroni)."""
    keys = list(dict.fromkeys((r.classifier, row["condition"]) for r in probes for row in r.rows))
    table = []
    for classifier, condition in keys:
        rows = [row for r in probes if r.classifier == classifier for row in r.rows]
        rows = [row for row in rows if row["condition"] == condition and row["known"]]
        if not rows:
            continue
        n = len({row["grasp_id"] for row in rows})
        accuracy = float(np.mean([row["correct"] for row in rows]))
        # constant guessing reaches the share of the commonest material
        by_chance = max(Counter(row["material"] for row in rows).values()) / len(rows)
        p = binomial_p(accuracy * n, n, by_chance)
        table.append(
            {
                "classifier": classifier,
                "condition": condition,
                "n": n,
                "accuracy": accuracy,
                "chance": by_chance,
                "p_value": p,
                "leak": bool(p < PROBE.leak_level / len(keys)),
            }
        )
    return table
