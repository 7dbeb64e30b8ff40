"""The answer for each grasp: a material, probabilities, and how likely it is none of them.

``material`` is the likeliest known one.  ``p_unknown`` stands beside the probabilities, not in their sum, and
is empty for a classifier that has no model of other materials.  A grasp that shows no contact
(:mod:`thermogrip.sysid.missed`) is none of them for certain.  Touches of one block (``touch_group``) are
one question: a classifier that knows how touches hang together answers it from all of them, of another the
log probabilities are added, and each of its rows carries the common answer. ``decided_at_s`` is the contact
time that was used: the last sample of the grasp or of its group's last touch, or where a stop rule
(:mod:`~thermogrip.classify.stopping`) would have ended the contact.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from thermogrip.classify.base import Floats, GraspClassifier, Records, pick, record_list
from thermogrip.classify.folds import grouped, unit_names
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.files import write_atomic
from thermogrip.datasets.schema import Grasps, log_name
from thermogrip.sysid.missed import without_contact

if TYPE_CHECKING:
    from thermogrip.classify.stopping import StopRule

__all__ = ["Row", "classify_grasps", "joined_touches", "table_csv", "touch_log_proba"]
__all__ += ["write_predictions"]

Row: TypeAlias = dict[str, Any]


def classify_grasps(
    classifier: GraspClassifier,
    X: Records,
    candidates: Sequence[str] | None = None,
    *,
    rule: StopRule | None = None,
) -> list[Row]:
    """Return one row a grasp: ``grasp_id, material, p_<material>..., p_unknown, decided_at_s``.

    Parameters
    ----------
    classifier : GraspClassifier
        A fitted one.
    X : Grasps or list of Grasps
    candidates : sequence of str, optional
        The materials in question; by default all that the classifier knows.
    rule : StopRule, optional
        Use of each grasp only what was read until this rule would have ended the contact.

    Raises
    ------
    UserError
        If a candidate is unknown to the classifier, or stands twice, or a rule is to stop touches of one
        block, which share an answer.
    """
    names = [str(c) for c in (classifier.classes_ if candidates is None else candidates)]
    if len(set(names)) < len(names):
        raise UserError("a candidate is named twice", mend="name each once")
    rows: list[Row] = []
    for grasps in record_list(X):
        if rule is None:
            log_p, unknown = touch_log_proba(classifier, grasps, names), classifier.p_unknown(grasps, names)
            decided = np.array([_last_sample(grasps, i) for i in range(grasps.sizes["grasp"])])
        else:
            log_p, unknown, decided = _stopped(classifier, grasps, names, rule)
        unknown = np.where(np.isfinite(unknown) & without_contact(grasps), 1.0, unknown)
        for i, grasp_id in enumerate(grasps["grasp"].values):
            row: Row = {"grasp_id": str(grasp_id), "material": names[int(log_p[i].argmax())]}
            row |= {f"p_{name}": float(p) for name, p in zip(names, np.exp(log_p[i]))}
            row["p_unknown"] = float(unknown[i]) if np.isfinite(unknown[i]) else None
            row["decided_at_s"] = float(decided[i])
            rows.append(row)
    return rows


def _stopped(
    classifier: GraspClassifier, grasps: Grasps, names: list[str], rule: StopRule
) -> tuple[Floats, Floats, Floats]:
    """Return log probabilities, p_unknown and times where the rule ends each contact."""
    from thermogrip.classify.stopping import contact_end, growing_windows, stops

    if grouped(grasps):
        problem = "touches of one block are answered together, no rule ends one of them"
        raise UserError(problem, file=log_name(grasps), mend="leave --early out, or the column touch_group")
    seen = growing_windows(
        classifier,
        grasps,
        candidates=names,
        times=rule.times,
        end=contact_end(grasps, rule.end),
        gain=rule.gain > 0,
    )
    found = stops(rule, seen)
    at = np.searchsorted(seen.times, found.time)
    unknown = np.empty(found.time.size)
    for time in np.unique(found.time):
        there = found.time == time
        cut = pick(grasps, there).sel(time=slice(None, time + 1e-9))
        unknown[there] = classifier.p_unknown(cut, names)
    return seen.log_p[np.arange(at.size), at], unknown, found.time


def touch_log_proba(classifier: GraspClassifier, grasps: Grasps, candidates: Sequence[str]) -> Floats:
    """Return log probabilities (n_grasp, n_candidate) in which touches of one block share their answer."""
    log_p = classifier.candidate_log_proba(grasps, candidates)
    return log_p if classifier.joins_touches else joined_touches(log_p, grasps)


def joined_touches(log_p: Floats, grasps: Grasps) -> Floats:
    """Return log probabilities in which all touches of one block carry their common answer, same shape.

    Examples
    --------
    >>> from thermogrip.datasets.schema import make_grasps
    >>> g = make_grasps([0.0, 1.0], [[1.0, 2.0]] * 2, ["a1", "a2"], touch_group=["a", "a"])
    >>> np.exp(joined_touches(np.log([[0.8, 0.2], [0.5, 0.5]]), g)).round(3).tolist()
    [[0.8, 0.2], [0.8, 0.2]]
    """
    units = unit_names(grasps)
    if np.unique(units).size == units.size:
        return log_p
    out = np.empty_like(log_p)
    for unit in np.unique(units):
        total = log_p[units == unit].sum(axis=0)
        out[units == unit] = total - np.logaddexp.reduce(total)
    return out


def write_predictions(rows: Sequence[Row], path: str | Path) -> Path:
    """Write ``predictions.csv`` whole or not at all; probabilities with six digits, unknown ones empty."""
    return write_atomic(path, table_csv(rows))


def table_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a table as CSV text: a header from all rows' keys, floats with six digits, None and NaN empty.

    Examples
    --------
    >>> print(table_csv([{"grasp_id": "g0", "p_wood": 1 / 3, "p_unknown": None}]), end="")
    grasp_id,p_wood,p_unknown
    g0,0.333333,
    """
    names = list(dict.fromkeys(key for row in rows for key in row))
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(names)
    writer.writerows([_cell(row.get(name)) for name in names] for row in rows)
    return out.getvalue()


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _last_sample(grasps: Grasps, i: int) -> float:
    units = unit_names(grasps)
    seen = np.isfinite(grasps["t_surface"].values[units == units[i]]).any(axis=0)
    return float(grasps["time"].values[seen][-1])
