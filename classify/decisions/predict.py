"""The answer for each grasp: a material, probabilities, and how likely it is none of them.

``material`` is the likeliest known one.  ``p_unknown`` stands beside the probabilities, not in their sum, and
is empty for a classifier that has no model of other materials.  Touches of one block (``touch_group``) are
one question: a classifier that knows how touches hang together answers it from all of them, of another the
log probabilities are added, and each of its rows carries the common answer. ``decided_at_s`` is the contact
time that was used: the last sample of the grasp or of its group's last touch, or where a stop rule
(:mod:`~thermogrip.classify.decisions.stopping_rule`) would have ended the contact.

For any classifier, a grasp that shows no contact (:mod:`thermogrip.sysid.effusivity.quality`) has no
material and no probabilities, and is none of the candidates for certain; nor is a trace named that ran into
the end of its sensor's range (:mod:`thermogrip.sysid.effusivity.quality`) by a classifier that needs whole
traces.  Of a block such a touch is left out, and its row carries the answer of the others.  Nor is more read
of a contact than those of the training lasted (:mod:`thermogrip.sysid.effusivity.quality`).  ``note``
explains each; other rows have none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from thermogrip.classify.estimators.base import (
    Floats,
    GraspClassifier,
    Records,
    normalised,
    pick,
    record_list,
)
from thermogrip.datasets.atomic_files import write_atomic
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.media import csv_text
from thermogrip.datasets.schema import Grasps, has_touch_groups, log_name, unit_names
from thermogrip.sysid.effusivity.quality import NO_CONTACT, check_grasps

if TYPE_CHECKING:
    from thermogrip.classify.decisions.stopping_rule import StopRule

__all__ = ["Row", "classify_grasps", "joined_touches", "table_csv"]
__all__ += ["write_predictions"]

Row: TypeAlias = dict[str, Any]


def classify_grasps(
    classifier: GraspClassifier,
    X: Records,
    candidates: Sequence[str] | None = None,
    *,
    rule: StopRule | None = None,
) -> list[Row]:
    """Return one row a grasp: ``grasp_id, material, p_<material>..., p_unknown, decided_at_s``, and ``note``.

    Parameters
    ----------
    classifier : GraspClassifier
        A fitted one.
    X : Grasps or list of Grasps
    candidates : sequence of str, optional
        The materials in question; by default all that the classifier knows.
    rule : StopRule, optional
        Use of each grasp only what was read until this rule would have ended the contact.

    Returns
    -------
    rows : list of dict
        A grasp that cannot be named has the material ``""`` and None for each probability.

    Raises
    ------
    UserError
        If a candidate is unknown to the classifier, or stands twice, or a rule is to stop touches of one
        block, which share an answer.
    """
    names = [str(c) for c in (classifier.classes_ if candidates is None else candidates)]
    if len(set(names)) < len(names):
        raise UserError("a candidate is named twice", hint="name each once")
    return [row for grasps in record_list(X) for row in _answers(classifier, grasps, names, rule)]


def _answers(
    classifier: GraspClassifier, grasps: Grasps, names: list[str], rule: StopRule | None
) -> list[Row]:
    """Return the rows of one record: those that can be answered for, and what the others get."""
    whole = not classifier.leaves_samples_out
    quality = check_grasps(grasps, longest=classifier.longest_, whole_traces=whole)
    notes = [note or more for note, more in zip(quality.note, classifier.beyond_training(grasps))]
    usable = quality.usable_part(grasps)
    found = [] if usable is None else _named(classifier, usable, names, rule)
    units = unit_names(grasps)
    of_unit = {} if usable is None else dict(zip(unit_names(usable).tolist(), found))
    left = iter(found)
    rows: list[Row] = []
    for i, grasp_id in enumerate(grasps["grasp"].values):
        note = notes[i]
        if quality.usable[i]:
            row = next(left)
        elif units[i] in of_unit:
            row, note = dict(of_unit[str(units[i])]), f"{note}: the answer of its block's other touches"
        else:
            row = _no_name(names, quality.reason[i], _last_sample(grasps, i))
        rows.append({"grasp_id": str(grasp_id)} | row | ({"note": note} if note else {}))
    return rows


def _named(classifier: GraspClassifier, grasps: Grasps, names: list[str], rule: StopRule | None) -> list[Row]:
    """Return the answers of a classifier to grasps whose usable part is given, without their names."""
    if rule is None:
        log_p, unknown = classifier.open_set_log_proba(grasps, names)
        log_p = joined_touches(classifier, log_p, grasps)
        decided = np.array([_last_sample(grasps, i) for i in range(grasps.sizes["grasp"])])
    else:
        log_p, unknown, decided = _stopped(classifier, grasps, names, rule)
    rows: list[Row] = []
    for i, row in enumerate(log_p):
        answer: Row = {"material": names[int(row.argmax())]}
        answer |= {f"p_{name}": float(p) for name, p in zip(names, np.exp(row))}
        answer["p_unknown"] = float(unknown[i]) if np.isfinite(unknown[i]) else None
        rows.append(answer | {"decided_at_s": float(decided[i])})
    return rows


def _no_name(names: list[str], why: str, last: float) -> Row:
    """Return the row of an unusable grasp; without contact it is none of the candidates for certain."""
    none: Row = {"material": ""} | {f"p_{name}": None for name in names}
    return none | {"p_unknown": 1.0 if why == NO_CONTACT else None, "decided_at_s": last}


def _stopped(
    classifier: GraspClassifier, grasps: Grasps, names: list[str], rule: StopRule
) -> tuple[Floats, Floats, Floats]:
    """Return log probabilities, p_unknown and times where the rule ends each contact."""
    from thermogrip.classify.decisions.stopping_rule import (
        contact_end,
        growing_windows,
        silent_windows,
        stops,
    )

    if has_touch_groups(grasps):
        problem = "touches of one block are answered together, no rule ends one of them"
        raise UserError(problem, file=log_name(grasps), hint="leave --early out, or the column touch_group")
    seen = growing_windows(
        classifier,
        grasps,
        candidates=names,
        times=rule.times,
        end=contact_end(grasps, rule.end),
        gain=rule.gain > 0,
    )
    found = stops(rule, seen, silent_windows(grasps, seen.times))
    at = np.searchsorted(seen.times, found.time)
    unknown = np.empty(found.time.size)
    for time in np.unique(found.time):
        there = found.time == time
        cut = pick(grasps, there).sel(time=slice(None, time + 1e-9))
        unknown[there] = classifier.p_unknown(cut, names)
    return seen.log_p[np.arange(at.size), at], unknown, found.time


def joined_touches(classifier: GraspClassifier, log_p: Floats, grasps: Grasps) -> Floats:
    """Return log probabilities in which all touches of one block have their common answer, same shape: the
    classifier's own, or the normalised sum of theirs."""
    units = unit_names(grasps)
    if classifier.joins_touches or np.unique(units).size == units.size:
        return log_p
    out = np.empty_like(log_p)
    for unit in np.unique(units):
        out[units == unit] = normalised(log_p[units == unit].sum(axis=0, keepdims=True))
    return out


def write_predictions(rows: Sequence[Row], path: str | Path) -> Path:
    """Write ``predictions.csv`` whole or not at all; probabilities with six digits, unknown ones empty."""
    return write_atomic(path, table_csv(rows))


def table_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a table as CSV text: a header from all rows' keys, floats with six digits, None and NaN
    empty."""
    names = list(dict.fromkeys(key for row in rows for key in row))
    return csv_text([names, *([_cell(row.get(name)) for name in names] for row in rows)])


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _last_sample(grasps: Grasps, i: int) -> float:
    units = unit_names(grasps)
    seen = np.isfinite(grasps["t_surface"].values[units == units[i]]).any(axis=0)
    return float(grasps["time"].values[seen][-1])
