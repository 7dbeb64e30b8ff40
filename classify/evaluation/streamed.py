r"""A comparison on more test grasps than fit in memory: read, answered and counted part by part.

The training grasps are in memory, and every classifier is fitted once, before the first test grasp is read:
by nature, for those that are not fitted in steps (the LSTM's epochs go over all of them, too).  What is lazy
is the test: its predictions go to disk with each part (:mod:`thermogrip.datasets.partitions`), and a score is
a sum over them.  A part is tested on the training condition at its temperatures, under whose name it counts.

With n grasps that are drawn independently, each tested once, and scores :math:`x_i`,

.. math:: \bar x \pm z \sqrt{(\overline{x^2} - \bar x^2) / n}

is the interval of a mean, by sums alone; the draws of :mod:`~thermogrip.classify.evaluation.metrics` for the
calibration error are of normal bin sums with the variances that were counted.  The area under the ROC curve
is that of p_unknown in 400 bins of its log odds.  Grasps that no memory holds cannot be told to be unlike all
others: a test grasp that is given twice counts twice; one that is in the training is refused.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import combinations
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from scipy.special import logit
from scipy.stats import norm
from sklearn.base import clone

from thermogrip.classify.decisions.predict import Row, cell_text
from thermogrip.classify.estimators.base import Floats, GraspClassifier
from thermogrip.classify.evaluation import metrics as s
from thermogrip.classify.evaluation.comparison import POOLED, Comparison
from thermogrip.classify.evaluation.harness import taught_together, tested_rows
from thermogrip.classify.evaluation.splits import Fold, like_it, refuse_shared, scored_apart, training_grasps
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.parallel import Progress, Workers, run_parallel
from thermogrip.datasets.partitions import Answers
from thermogrip.datasets.schema import Grasps, log_name

_SUMMED = ("correct", "log_loss", "brier", "log_loss_base", "confidence")
_DRAWS, _BINS = 2000, 400
_FAULTS = 20  # that are shown
_FARTHEST = 20.0  # of the log odds of an unknown


class Fitted(NamedTuple):
    """A classifier fitted to one training condition, or to all where ``of`` is -1, and how long it took [s];
    the fault of one that could not be."""

    name: str
    of: int
    model: GraspClassifier
    fit_s: float
    fault: UserError | None = None


@dataclass(frozen=True)
class FittedClassifiers:
    """Classifiers that are fitted, and the conditions that taught them."""

    fitted: tuple[Fitted, ...]
    training: tuple[Grasps, ...]

    def answer(self, part: Grasps) -> dict[str, Any]:
        """Return the predictions for a part, as of :class:`Comparison`, the seconds of fit and grasp, and why
        a classifier has none."""
        refuse_shared(self.training, [part])
        at = like_it(part, self.training)
        like, apart = self.training[at], scored_apart(part)
        name = f"{log_name(like)}, apart" if apart else log_name(like)
        fold = Fold(name, 0, like, part, apart)
        found, times, faults = list[Row](), dict[str, list[float]](), list[str]()
        for classifier in dict.fromkeys(each.name for each in self.fitted):
            mine = {each.of: each for each in self.fitted if each.name == classifier}
            one = mine[at]
            if -1 in mine and taught_together(mine[-1].model, fold, self.training):
                one = mine[-1]
            if one.fault is None:
                try:
                    rows, predict_s = tested_rows(classifier, one.model, fold, touch=True)
                except UserError as fault:
                    faults.append(f"{classifier} left out of {name}: {fault.problem}")
                    continue
                found += rows
                times[classifier] = [one.fit_s, predict_s]
        return {"rows": found, "times": times, "faults": faults}


def fitted_classifiers(
    classifiers: Mapping[str, GraspClassifier], records: Sequence[Grasps], *, workers: Workers = 1,
    progress: Progress | None = None,
) -> FittedClassifiers:  # fmt: skip
    """Return classifiers fitted to each training condition, and to all where they learn from those."""
    training = training_grasps(records)
    jobs = []
    for name, classifier in classifiers.items():
        every = len(training) > 1 and classifier.learns_from_all_conditions
        jobs += [(name, classifier, k) for k in ([-1] if every else []) + list(range(len(training)))]
    found = run_parallel(partial(_fit, training), jobs, workers, progress, what="train")
    for each in found:
        if each.fault is not None and all(other.fault is not None for other in found):
            raise each.fault
    return FittedClassifiers(tuple(found), tuple(training))


def _fit(training: Sequence[Grasps], job: tuple[str, GraspClassifier, int]) -> Fitted:
    name, classifier, of = job
    model, begin = clone(classifier), perf_counter()
    try:
        model.fit(list(training) if of < 0 and len(training) > 1 else training[of])
    except UserError as fault:
        return Fitted(name, of, model, 0.0, fault)
    return Fitted(name, of, model, perf_counter() - begin)


@dataclass
class Tally:
    """Sums over the test grasps of one classifier in one condition."""

    n: int = 0
    apart: bool = False
    sums: Floats = field(default_factory=lambda: np.zeros((2, len(_SUMMED))))  # of scores, and of squares
    chance: float = 0.0
    # of each bin of confidence: grasps, confidence, right, square of their difference, variance if calibrated
    bins: Floats = field(default_factory=lambda: np.zeros((s.N_BINS, 5)))
    confusion: Counter[tuple[str, str]] = field(default_factory=Counter)
    seconds: Floats = field(default_factory=lambda: np.zeros(2))  # fit and prediction, summed over grasps

    def add(self, rows: Sequence[Row], seconds: Sequence[float]) -> None:
        """Count some predictions of known materials, and the seconds of fit and grasp."""
        values = np.array([[float(row[key]) for key in _SUMMED] for row in rows])
        self.n, self.apart = self.n + len(rows), bool(rows[0]["apart"])
        self.sums += [values.sum(axis=0), np.square(values).sum(axis=0)]
        self.chance += float(np.log([row["candidates"] for row in rows]).sum())
        right, stated = values[:, 0], values[:, -1]
        columns = [np.ones(right.size), stated, right, np.square(stated - right), stated * (1 - stated)]
        np.add.at(self.bins, s.bin_of(stated), np.stack(columns, axis=1))
        self.confusion.update((row["material"], row["predicted"]) for row in rows)
        self.seconds += len(rows) * np.asarray(seconds)

    def mean(self, key: str, level: float) -> s.Interval:
        """Return the mean of a score with its interval."""
        total, squares = self.sums[:, _SUMMED.index(key)]
        return _mean(total, squares, self.n, level)

    def calibration_error(self, level: float, seed: int) -> s.CalibrationError:
        """Return the ECE, its interval and what calibrated forecasters would show."""
        rng, n = np.random.default_rng(seed), self.n
        gap = (self.bins[:, 1] - self.bins[:, 2]) / n
        value, tail = float(np.abs(gap).sum()), (1 + level) / 2
        spread = np.sqrt(np.maximum(self.bins[:, 3] / n - gap**2, 0.0) / n)
        off = rng.normal(size=(_DRAWS, gap.size)) * spread
        chance = np.abs(rng.normal(size=(_DRAWS, gap.size)) * np.sqrt(self.bins[:, 4]) / n).sum(axis=1)
        p = (1 + int(np.sum(chance >= value - 1e-12))) / (1 + _DRAWS)
        low = value - float(np.quantile(np.abs(off).sum(axis=1), tail))
        high = value + float(np.quantile(-off @ np.sign(gap), tail))
        return s.CalibrationError(value, max(0.0, low), min(1.0, max(high, value)), float(chance.mean()), p)


@dataclass
class Pair:
    """Sums over the test grasps that two classifiers share: differences of right and of log loss, squares."""

    n: int = 0
    only: Floats = field(
        default_factory=lambda: np.zeros(2)
    )  # that only the first, only the second has right
    sums: Floats = field(default_factory=lambda: np.zeros((2, 2)))

    def add(self, first: Sequence[Row], second: Sequence[Row]) -> None:
        """Count some grasps."""
        right, loss = (
            np.array([float(a[key]) - float(b[key]) for a, b in zip(first, second)])
            for key in ("correct", "log_loss")
        )
        self.n += right.size
        self.only += [(right > 0).sum(), (right < 0).sum()]
        self.sums += [[right.sum(), loss.sum()], [right @ right, loss @ loss]]


def _mean(total: float, squares: float, n: int, level: float) -> s.Interval:
    value = total / n
    if n < 2:
        return s.Interval(value, np.nan, np.nan)
    width = norm.ppf((1 + level) / 2) * np.sqrt(max(squares / n - value**2, 0.0) / n)
    return s.Interval(value, value - width, value + width)


class Counts:
    """All sums over predictions."""

    def __init__(self) -> None:
        self.tallies: dict[tuple[str, str], Tally] = {}
        self.pairs: dict[tuple[str, str, str], Pair] = {}
        self.strange: dict[tuple[str, str], Counter[int]] = {}  # p_unknown by material, "" the known ones

    def add(self, rows: Sequence[Row], times: Mapping[str, Sequence[float]]) -> None:
        """Count the predictions of one part, which has one condition."""
        known: dict[str, list[Row]] = {}
        for row in rows:
            if row["known"]:
                known.setdefault(row["classifier"], []).append(row)
            if row["p_unknown"] is not None and not (row["known"] and row["apart"]):
                key = row["classifier"], "" if row["known"] else row["material"]
                odds = float(np.clip(logit(row["p_unknown"]), -_FARTHEST, _FARTHEST))
                self.strange.setdefault(key, Counter())[round(odds / _FARTHEST * _BINS / 2)] += 1
        for name, own in known.items():
            for condition in (own[0]["condition"], *([] if own[0]["apart"] else [POOLED])):
                self.tallies.setdefault((name, condition), Tally()).add(own, times[name])
        for first, second in combinations(known, 2):
            a = {row["grasp_id"]: row for row in known[first]}
            shared = [(a[row["grasp_id"]], row) for row in known[second] if row["grasp_id"] in a]
            if shared:
                head = shared[0][0]
                for condition in (head["condition"], *([] if head["apart"] else [POOLED])):
                    pair = self.pairs.setdefault((first, second, condition), Pair())
                    pair.add(*zip(*shared))


@dataclass(frozen=True, repr=False)
class StreamedComparison(Comparison):
    """A comparison whose predictions are on disk, and whose scores are of their sums."""

    counts: Counts = field(default_factory=Counts)
    answers: Answers | None = None

    @property
    def classifiers(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for name, _ in self.counts.tallies))

    @property
    def conditions(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for _, name in self.counts.tallies if name != POOLED))

    @property
    def interval_note(self) -> str:
        percent = f"{100 * self.level:.0f} % Clopper-Pearson interval"
        return f"Accuracy: {percent}; n counts test grasps. Other intervals: normal, from sums over grasps."

    @cached_property
    def _scores(self) -> list[Row]:
        table = []
        for classifier in self.classifiers:
            pooled = sum(not t.apart for (name, c), t in self.counts.tallies.items()
                         if name == classifier and c != POOLED)  # fmt: skip
            for condition in ([POOLED] if pooled > 1 else []) + list(self.conditions):
                if tally := self.counts.tallies.get((classifier, condition)):
                    table.append({"classifier": classifier, "condition": condition} | self._of_tally(tally))
        return table

    def _of_tally(self, tally: Tally) -> Row:
        right, loss, brier = (tally.mean(key, self.level) for key in ("correct", "log_loss", "brier"))
        low, high = s.clopper_pearson(right.value * tally.n, tally.n, level=self.level)
        ece = tally.calibration_error(self.level, self.seed)
        out: Row = {
            "apart": tally.apart,
            "materials": len({true for true, _ in tally.confusion}),
            "n": tally.n,
        }
        out |= {"tested": tally.n, "accuracy": right.value, "low": low, "high": high}
        out |= {"boot_low": right.low, "boot_high": right.high, "sd_over_splits": None}
        out |= {"log_loss": loss.value, "log_loss_low": loss.low, "log_loss_high": loss.high}
        out |= {"log_loss_chance": tally.chance / tally.n}
        out |= {"log_loss_base": tally.mean("log_loss_base", self.level).value}
        out |= {"brier": brier.value, "brier_low": brier.low, "brier_high": brier.high}
        out |= {"confidence": tally.mean("confidence", self.level).value}
        out |= {"ece": ece.value, "ece_low": ece.low, "ece_high": ece.high}
        out |= {"ece_calibrated": ece.if_calibrated, "ece_p": ece.p_value}
        out |= dict(zip(("fit_s", "predict_s_per_grasp"), (tally.seconds / tally.n).tolist()))
        return {key: None if isinstance(v, float) and np.isnan(v) else v for key, v in out.items()}

    def confusion(self, classifier: str, condition: str = POOLED) -> tuple[list[str], Floats]:
        found = self.counts.tallies[classifier, condition].confusion
        names = sorted({name for pair in found for name in pair})
        counts = np.zeros((len(names), len(names)))
        for (true, predicted), n in found.items():
            counts[names.index(true), names.index(predicted)] += n
        return names, counts

    def calibration(self, classifier: str, condition: str = POOLED) -> list[Row]:
        table = []
        for b, (n, stated, right, *_) in enumerate(self.counts.tallies[classifier, condition].bins.tolist()):
            if n:
                low, high = s.clopper_pearson(right, int(n), level=self.level)
                own = s.Bin(b / s.N_BINS, (b + 1) / s.N_BINS, int(n), stated / n, right / n)
                table.append(own._asdict() | {"grasps": int(n), "accuracy_low": low, "accuracy_high": high})
        return table

    def differences(self, condition: str = POOLED) -> list[Row]:
        table = []
        for (first, second, where), pair in self.counts.pairs.items():
            if where == condition:
                (a, b), (a2, b2) = pair.sums.tolist()
                right, lost = _mean(a, a2, pair.n, self.level), _mean(b, b2, pair.n, self.level)
                only = [int(n) for n in pair.only]
                table.append({
                    "first": first, "second": second, "condition": condition, "n": pair.n,
                    "difference": right.value, "low": right.low, "high": right.high,
                    "log_loss_difference": lost.value, "log_loss_low": lost.low, "log_loss_high": lost.high,
                    "only_first": only[0], "only_second": only[1], "p_value": s.mcnemar_p(*only),
                    "test": "McNemar exact",
                })  # fmt: skip
        return table

    def open_set(self) -> list[Row]:
        table = []
        for (classifier, material), strange in sorted(self.counts.strange.items()):
            known = self.counts.strange.get((classifier, ""), Counter())
            if material and known:
                counts = {"n_unknown": strange.total(), "n_known": known.total()}
                area = _area(known, strange)
                table.append({"classifier": classifier, "material": material} | counts | {"auroc": area})
        return table

    def save(self, folder: str | Path) -> Path:
        path = super().save(folder)
        if self.answers is not None:
            self.answers.write(path / "predictions.csv", cell_text)
        return path


def _area(negative: Counter[int], positive: Counter[int]) -> float:
    """Return the probability that a positive is in a higher bin than a negative, the same bin half."""
    below, area = 0, 0.0
    for k in sorted({*negative, *positive}):
        area += positive[k] * (below + 0.5 * negative[k])
        below += negative[k]
    return area / (below * positive.total())


def streamed_comparison(answers: Answers, models: FittedClassifiers, *, seed: int = 0) -> StreamedComparison:
    """Return the comparison of predictions on disk."""
    counts, faults = Counts(), dict[str, None]()
    for part in answers:
        counts.add(part["rows"], part["times"])
        faults |= dict.fromkeys(part["faults"][: _FAULTS - len(faults)])
    unable = [*faults]
    unable += [f"{each.name} left out: {each.fault}" for each in models.fitted if each.fault is not None]
    note = "test files are read part by part: no leak probe, and what is given twice counts twice"
    return StreamedComparison("files", 1, seed, (), notes=(note, *dict.fromkeys(unable)),
                              counts=counts, answers=answers)  # fmt: skip
