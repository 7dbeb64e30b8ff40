"""What a comparison found: tidy tables, one fact a row, and how each number was made.

``Comparison`` holds the predictions of every classifier for every test grasp in every repeat, and
derives everything else from that.  Rows are plain dicts, so a table goes into a CSV file or a data frame as
it is.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermogrip.classify.decisions.predict import Row, table_csv
from thermogrip.classify.evaluation import metrics as s
from thermogrip.classify.evaluation.metrics import calibration_interval, mean_intervals
from thermogrip.datasets.files import make_folder, write_atomic, write_json
from thermogrip.media.rendering import Shown

POOLED = "pooled"

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Caution:
    """What a score has to be read with."""

    code: str  # ``leak``, ``unseen_material``, ``excluded_material`` or ``session_fault``
    condition: str  # whose scores it touches
    words: str
    classifier: str = ""  # whose score it touches; empty: everybody's
    detail: str = ""  # of this classifier
    brief: str = ""  # beside the score; the code where there is none

    def __post_init__(self) -> None:
        object.__setattr__(self, "brief", self.brief or self.code.replace("_", " "))


@dataclass(frozen=True, repr=False)
class Comparison(Shown):
    """The result of :func:`~thermogrip.classify.evaluation.harness.evaluate`."""

    split: str  # ``shipped``, ``random``, ``session``, ``block`` or ``files``
    repeats: int  # random splits; 1 otherwise
    seed: int
    # a row for each classifier, repeat, condition and test grasp (or touched block): ``classifier, repeat,
    # condition, grasp_id, material, predicted, known, correct, confidence, log_loss, log_loss_base, brier,
    # p_unknown, apart`` and ``p_<candidate>``; ``known`` is False where the material was no candidate: such
    # grasps are not in the accuracy, and are what ``open_set`` is about
    predictions: tuple[Row, ...]
    # the leak probe: ``classifier, condition, n, accuracy, chance, p_value, leak``
    leaks: tuple[Row, ...] = ()
    times: tuple[Row, ...] = ()  # ``classifier, repeat, condition, fit_s, predict_s_per_grasp``
    notes: tuple[str, ...] = ()  # what was left out, and why
    of_records: tuple[Caution, ...] = ()  # cautions that come from the records and their split
    level: float = field(default=0.95)  # confidence of the intervals

    def _facts(self) -> dict[str, object]:
        """Return the split and the accuracy of each classifier with its interval, pooled where it can be."""
        facts: dict[str, object] = {"split": self.split, "conditions": ", ".join(self.conditions)}
        for row in reversed(self.scores()):  # the first of a classifier stays
            interval = f"({100 * self.level:.0f} %: {row['low']:.3f} to {row['high']:.3f})"
            of = f"{row['n']} of {row['n_test']}" if row["n_test"] > row["n"] else str(row["n"])
            facts[row["classifier"]] = f"accuracy {row['accuracy']:.3f} {interval} of {of} grasps"
        return facts | {f"caution {k}": words for k, words in enumerate(self.caution_lines(), 1)}

    @property
    def classifiers(self) -> tuple[str, ...]:
        """Names, in the order given."""
        return tuple(dict.fromkeys(str(r["classifier"]) for r in self.predictions))

    @property
    def conditions(self) -> tuple[str, ...]:
        """Names of the conditions, in the order given."""
        return tuple(dict.fromkeys(str(r["condition"]) for r in self.predictions))

    @property
    def interval_note(self) -> str:
        """How the intervals were made, in a few sentences."""
        percent = f"{100 * self.level:.0f} % Clopper-Pearson interval"
        others = "Intervals of log loss, Brier score and ECE: bootstrap over grasps."
        if self.split in ("session", "block"):
            others += (
                f" Grasps of one {self.split} fail together: another {self.split} may lie further off than "
                "these intervals, which count grasps."
            )
        if self.repeats == 1:
            return f"Accuracy: {percent}; n counts test grasps. {others}"
        return (
            f"Mean over {self.repeats} random splits by grasp. Accuracy: {percent} with n counted as "
            "distinct grasps, since all splits test the same ones (conservative; the spread over splits is "
            f"no interval). {others}"
        )

    @cached_property
    def cautions(self) -> tuple[Caution, ...]:
        """What the scores have to be read with: leaks, materials that training lacks and how each classifier
        answered them, then what the records and their split bring."""
        leaks = [self._leak(row) for row in self.leaks if row["leak"]]
        pairs = [(condition, name) for condition in self.conditions for name in self.classifiers]
        tested = [(self._tested(name, condition), condition, name) for condition, name in pairs]
        unseen = [
            _unseen_caution(*unknown_in)
            for unknown_in in tested
            if not all(row["known"] for row in unknown_in[0])
        ]
        return (*leaks, *unseen, *self.of_records)

    def cautions_of(self, classifier: str, condition: str) -> list[Caution]:
        """Return the cautions that touch a score; of the pooled one, those of every condition in it."""
        pool = {str(r["condition"]) for r in self._tested(classifier, condition)}
        return [c for c in self.cautions if c.classifier in ("", classifier) and c.condition in pool]

    def caution_lines(self) -> list[str]:
        """Return the cautions in words, one line for what is so of several classifiers."""
        lines: dict[str, list[str]] = {}
        for caution in self.cautions:
            details = lines.setdefault(f"{caution.condition}: {caution.words}", [])
            details += [caution.detail] if caution.detail else []
        return ["; ".join([line, *details]) for line, details in lines.items()]

    def _leak(self, row: Row) -> Caution:
        who, condition = str(row["classifier"]), str(row["condition"])
        right, chance = (f"{100 * row[key]:.0f} %" for key in ("accuracy", "chance"))
        return Caution(
            "leak",
            condition,
            "labels can be predicted from samples before contact, so accuracy need not come from touch",
            who if who in self.classifiers else "",  # the probe's own classifier speaks of the record
            f"{who}: {right} of n = {row['n']}, chance {chance}",
        )

    def _tested(self, classifier: str, condition: str) -> list[Row]:
        """Return the predictions for all test grasps of a condition, of unseen materials among them."""
        return [
            r
            for r in self.predictions
            if r["classifier"] == classifier
            and (r["condition"] == condition or (condition == POOLED and not r["apart"]))
        ]

    def scores(self) -> list[Row]:
        """Return a row for each classifier and condition, ``pooled`` ones first where there are several.

        ``n`` distinct grasps of ``n_test`` in the test, the others of materials that training lacks;
        ``cautions``, codes of what touches the score, and ``caution``, the same in a few words; ``tested``
        times in all; ``accuracy`` with ``low``, ``high`` (Clopper-Pearson) and ``boot_low``, ``boot_high``
        (bootstrap over grasps); ``sd_over_splits``;
        ``log_loss``, ``brier`` and ``ece`` with ``<score>_low`` and ``<score>_high`` over grasps
        (:mod:`~thermogrip.classify.evaluation.metrics`); ``ece_calibrated``, what a calibrated forecaster
        of these confidences would show, and ``ece_p``, how often one would show more; ``confidence``;
        ``log_loss_chance`` (equal probabilities) and ``log_loss_base`` (always stating the shares of the
        training grasps); ``fit_s``, ``predict_s_per_grasp``.
        """
        return [dict(row) for row in self._scores]

    @cached_property
    def _scores(self) -> list[Row]:
        table = []
        for classifier in self.classifiers:
            scored = [r for r in self.predictions if r["classifier"] == classifier and r["known"]]
            groups = {c: [r for r in scored if r["condition"] == c] for c in self.conditions}
            pooled = [r for r in scored if not r["apart"]]
            if len({r["condition"] for r in pooled}) > 1:
                groups = {POOLED: pooled} | groups
            for condition, rows in groups.items():
                if rows:
                    table.append(self._score(classifier, condition, rows))
        return table

    def _score(self, classifier: str, condition: str, rows: Sequence[Row]) -> Row:
        grasp = grasp_numbers(rows)
        n = int(grasp.max()) + 1
        columns = np.array([[float(r[key]) for key in ("correct", "log_loss", "brier")] for r in rows])
        settings: dict[str, Any] = {"level": self.level, "seed": self.seed}
        right, loss, brier = mean_intervals(columns, grasp, **settings)
        low, high = s.clopper_pearson(right.value * n, n, level=self.level)
        confidence = np.array([r["confidence"] for r in rows])
        cautions = self.cautions_of(classifier, condition)
        ece = calibration_interval(confidence, columns[:, 0], grasp, **settings)
        return {
            "classifier": classifier,
            "condition": condition,
            "apart": bool(rows[0]["apart"]),
            "materials": len({r["material"] for r in rows}),
            "n": n,
            "n_test": len(_distinct(self._tested(classifier, condition))),
            "cautions": " ".join(dict.fromkeys(caution.code for caution in cautions)),
            "caution": "; ".join(dict.fromkeys(caution.brief for caution in cautions)),
            "tested": len(rows),
            "accuracy": right.value,
            "low": low,
            "high": high,
            "boot_low": _none_for_nan(right.low),
            "boot_high": _none_for_nan(right.high),
            "sd_over_splits": _sd_over_splits(rows) if self.repeats > 1 else None,
            **_interval_row("log_loss", loss),
            "log_loss_chance": float(np.mean([np.log(r["candidates"]) for r in rows])),
            "log_loss_base": float(np.mean([r["log_loss_base"] for r in rows])),
            **_interval_row("brier", brier),
            "confidence": float(confidence.mean()),
            **_interval_row("ece", ece),
            "ece_calibrated": ece.if_calibrated,
            "ece_p": ece.p_value,
            **{key: self._time(classifier, rows, key) for key in ("fit_s", "predict_s_per_grasp")},
        }

    def _time(self, classifier: str, rows: Sequence[Row], key: str) -> float | None:
        conditions = {r["condition"] for r in rows}
        seconds = [
            r[key] for r in self.times if r["classifier"] == classifier and r["condition"] in conditions
        ]
        return float(np.mean(seconds)) if seconds else None

    def confusion(self, classifier: str, condition: str = POOLED) -> tuple[list[str], Floats]:
        """Return the materials tested or predicted, and the confusion matrix: rows true, columns predicted,
        in test grasps a split."""
        rows = self._rows(classifier, condition)
        names = sorted({r["material"] for r in rows} | {r["predicted"] for r in rows})
        counts = np.zeros((len(names), len(names)))
        for r in rows:
            counts[names.index(r["material"]), names.index(r["predicted"])] += 1
        return names, counts / self.repeats

    def calibration(self, classifier: str, condition: str = POOLED) -> list[Row]:
        """Return confidence beside accuracy in bins of 0.1, each accuracy with its interval over distinct
        grasps."""
        rows, table = self._rows(classifier, condition), []
        confidence = np.array([r["confidence"] for r in rows])
        for b in s.calibration_bins(confidence, [r["correct"] for r in rows]):
            inside = [r for r, c in zip(rows, np.clip(confidence, 0.0, 1.0)) if b.low < c <= b.high]
            n = len({(r["condition"], r["grasp_id"]) for r in inside})
            low, high = s.clopper_pearson(b.accuracy * n, n, level=self.level)
            table.append(b._asdict() | {"grasps": n, "accuracy_low": low, "accuracy_high": high})
        return table

    def differences(self, condition: str = POOLED) -> list[Row]:
        """Return a row for each pair of classifiers on the same test grasps.

        ``difference`` of accuracies and ``log_loss_difference``, first less second, with bootstrap intervals
        over grasps; ``p_value`` of the exact McNemar
        test, or for repeated splits of the sign-flip test over grasps (named in ``test``).
        """
        table = []
        for first, second in combinations(self.classifiers, 2):
            a, b = (
                {(r["repeat"], r["condition"], r["grasp_id"]): r for r in self._rows(name, condition)}
                for name in (first, second)
            )
            if shared := [(a[k], b[k]) for k in a if k in b]:
                head = {"first": first, "second": second, "condition": condition}
                table.append(head | self._difference(shared))
        return table

    def _difference(self, shared: Sequence[tuple[Row, Row]]) -> Row:
        right_a, right_b = np.array([[a["correct"], b["correct"]] for a, b in shared], dtype=float).T
        loss = np.array([a["log_loss"] - b["log_loss"] for a, b in shared])
        grasp = grasp_numbers([a for a, _ in shared])
        gap = np.bincount(grasp, weights=right_a - right_b) / np.bincount(grasp)
        test = s.mcnemar(right_a, right_b)
        columns = np.column_stack([right_a - right_b, loss])
        right, lost = mean_intervals(columns, grasp, level=self.level, seed=self.seed)
        return {
            "n": int(gap.size),
            "difference": right.value,
            "low": _none_for_nan(right.low),
            "high": _none_for_nan(right.high),
            "log_loss_difference": lost.value,
            "log_loss_low": _none_for_nan(lost.low),
            "log_loss_high": _none_for_nan(lost.high),
            "only_first": test.only_first / self.repeats,
            "only_second": test.only_second / self.repeats,
            "p_value": test.p_value if self.repeats == 1 else s.sign_flip_p(gap, seed=self.seed),
            "test": "McNemar exact" if self.repeats == 1 else "sign flips over grasps",
        }

    def open_set(self) -> list[Row]:
        """Return how well ``p_unknown`` separates materials that were no candidates from those that were.

        A row for each classifier with such a probability and each such material: ``n_unknown``, ``n_known``
        and the area under the ROC curve.  Known grasps are all that are not apart.
        """
        table = []
        for classifier in self.classifiers:
            rows = [r for r in self.predictions if r["classifier"] == classifier]
            rows = [r for r in rows if r["p_unknown"] is not None]
            p_of_known = [r["p_unknown"] for r in rows if r["known"] and not r["apart"]]
            strange = [r for r in rows if not r["known"]]
            for material in sorted({r["material"] for r in strange}) if p_of_known else ():
                scored = [r["p_unknown"] for r in strange if r["material"] == material]
                head = {"classifier": classifier, "material": material}
                counts = {"n_unknown": len(scored), "n_known": len(p_of_known)}
                table.append(head | counts | {"auroc": s.auroc(p_of_known, scored)})
        return table

    def save(self, folder: str | Path) -> Path:
        """Write every table as CSV and ``comparison.json`` into a folder; return the folder."""
        path = Path(folder)
        make_folder(path)
        conditions = dict.fromkeys(score["condition"] for score in self.scores())
        tables = {
            "scores": self.scores(),
            "predictions": list(self.predictions),
            "confusion": self._each(self._confusion_rows),
            "calibration": self._each(self.calibration),
            "differences": [row for condition in conditions for row in self.differences(condition)],
            "leaks": list(self.leaks),
            "cautions": [asdict(caution) for caution in self.cautions],
            "open_set": self.open_set(),
        }
        for name, rows in tables.items():
            if rows:
                write_atomic(path / f"{name}.csv", table_csv(rows))
        summary = {
            "split": self.split,
            "repeats": self.repeats,
            "seed": self.seed,
            "interval": self.interval_note,
            "notes": list(self.notes),
            "cautions": tables["cautions"],
            "scores": tables["scores"],
            "leaks": tables["leaks"],
        }
        write_json(path / "comparison.json", summary, schema="thermogrip.comparison", version=1)
        return path

    def _each(self, rows_of: Callable[[str, str], list[Row]]) -> list[Row]:
        """Return the rows of every classifier and condition, which each row names first."""
        heads = [{key: row[key] for key in ("classifier", "condition")} for row in self.scores()]
        return [head | row for head in heads for row in rows_of(head["classifier"], head["condition"])]

    def _confusion_rows(self, classifier: str, condition: str) -> list[Row]:
        names, counts = self.confusion(classifier, condition)
        return [
            {"true": names[i], "predicted": names[j], "grasps_a_split": float(n)}
            for (i, j), n in np.ndenumerate(counts)
        ]

    def _rows(self, classifier: str, condition: str) -> list[Row]:
        return [r for r in self._tested(classifier, condition) if r["known"]]


def _distinct(rows: Sequence[Row]) -> set[tuple[str, str]]:
    """Return the distinct grasps among rows."""
    return {(str(r["condition"]), str(r["grasp_id"])) for r in rows}


def _unseen_caution(rows: Sequence[Row], condition: str, classifier: str) -> Caution:
    """Return the number of test grasps of materials that training lacks, and how they were answered."""
    unseen = [r for r in rows if not r["known"]]
    n, materials = len(_distinct(unseen)), ", ".join(sorted({str(r["material"]) for r in unseen}))
    named = Counter("unknown" if (r["p_unknown"] or 0.0) > 0.5 else r["predicted"] for r in unseen)
    answers = ", ".join(f"{name} {k}" for name, k in named.most_common())
    of = f"{n} of {len(_distinct(rows))} test grasps"
    return Caution(
        "unseen_material",
        condition,
        f"{of} are of {materials}, which training lacks, and are not scored",
        classifier,
        f"{classifier} answered {answers}",
        f"{n} unseen ({materials}): {answers}",
    )


def grasp_numbers(rows: Sequence[Row]) -> NDArray[np.int64]:
    """Return the number of the distinct grasp of each row, counted from 0."""
    number_of: dict[tuple[str, str], int] = {}
    return np.array([number_of.setdefault((r["condition"], r["grasp_id"]), len(number_of)) for r in rows])


def _interval_row(name: str, found: s.Interval | s.CalibrationError) -> Row:
    return {
        name: found.value,
        f"{name}_low": _none_for_nan(found.low),
        f"{name}_high": _none_for_nan(found.high),
    }


def _none_for_nan(value: float) -> float | None:
    """Return None for NaN, of which neither JSON nor a page has a word."""
    return None if np.isnan(value) else value


def _sd_over_splits(rows: Sequence[Row]) -> float:
    of = np.array([r["repeat"] for r in rows])
    right = np.array([float(r["correct"]) for r in rows])
    return float(np.std([right[of == repeat].mean() for repeat in np.unique(of)]))
