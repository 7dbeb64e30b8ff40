"""The answer for each grasp: a material, probabilities, and how likely it is none of them.

``material`` is the likeliest known one, or "unknown" where it is likelier none of them; ``p_unknown`` is
beside the probabilities, not in their sum.
Touches of one block (``touch_group``) are one question: a classifier that knows how touches hang together
answers it from all of them, of another the log probabilities are added, and each row has the common answer.
``decided_at_s`` is the contact time that was used: the last sample of the grasp or of its group's last
touch, or where a stop rule would have ended the contact.  What of a grasp is usable is decided in
:mod:`thermogrip.sysid.effusivity.quality`, and ``note`` explains what is not: a grasp without contact is
none of the candidates for certain, and the row of a left-out touch has the answer of its block's others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from thermogrip.classify.decisions.stopping_rule import (
    StopRule,
    contact_end,
    growing_windows,
    silent_windows,
    stops,
)
from thermogrip.classify.estimators.base import (
    Answered,
    Floats,
    GraspClassifier,
    Note,
    Records,
    normalised,
    pick,
    record_list,
    unit_names,
)
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.files import write_atomic
from thermogrip.datasets.schema import has_touch_groups, label_values, log_name
from thermogrip.media.rendering import csv_text
from thermogrip.sysid.effusivity.data import touches, with_object_range
from thermogrip.sysid.effusivity.gripper_model import GripperModel
from thermogrip.sysid.effusivity.laplace_approximation import (
    fit_pairs,
    free_hypotheses,
    prior_of,
    unexplained,
)
from thermogrip.sysid.effusivity.posterior import EffusivityRow
from thermogrip.sysid.effusivity.quality import NO_CONTACT, GraspQuality, check_grasps

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Grasps

Row: TypeAlias = dict[str, Any]


UNKNOWN = "unknown"  # the material of a grasp that is likelier of none of the candidates


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What one grasp touched.

    Parameters
    ----------
    grasp_id : str
    material : str
        "unknown" where it is likelier none of the candidates, "" without an answer.
    probabilities : dict of str to float or None
        Of each candidate if it is one of them; None without an answer.
    p_unknown : float or None
        That it is none of them [1]; None where the classifier has no model of other materials.
    decided_at : float
        Contact time that was used [s].
    misfit_sd : float, optional
        Of a single touch by ``posterior``: that of the trace under the likeliest candidate,
        standardised [1].
    deviates : str, optional
        What that candidate requires that is unusual, where it is likelier none of them.
    notes : tuple of Note, optional
        All that there is to know; none hides another.
    """

    grasp_id: str
    material: str
    probabilities: dict[str, float | None]
    p_unknown: float | None
    decided_at: float
    misfit_sd: float | None = None
    deviates: str = ""
    notes: tuple[Note, ...] = ()

    @property
    def nearest(self) -> str:
        """The likeliest candidate, "" without an answer."""
        p = {name: value for name, value in self.probabilities.items() if value is not None}
        return max(p, key=p.__getitem__) if p else ""

    def row(self) -> Row:
        """Return the answer as a row of a table."""
        out: Row = {"grasp_id": self.grasp_id, "material": self.material}
        out |= {f"p_{name}": p for name, p in self.probabilities.items()}
        out |= {"p_unknown": self.p_unknown, "decided_at_s": self.decided_at}
        out |= {"misfit_sd": self.misfit_sd, "deviates": self.deviates}
        out["note"] = "; ".join(note.words for note in self.notes)
        return out | {"note_codes": " ".join(note.code for note in self.notes)}


def answer(
    classifier: GraspClassifier,
    X: Records,
    candidates: Sequence[str] | None = None,
    *,
    rule: StopRule | None = None,
    object_range: tuple[float, float] | None = None,
    nearest: bool = False,
) -> list[Answer]:
    """Return what each grasp touched, by all that one needs to know of it.

    Parameters
    ----------
    classifier : GraspClassifier
        A fitted one.
    X : Grasps or list of Grasps
    candidates : sequence of str, optional
        The materials in question; by default all that the classifier knows.
    rule : StopRule, optional
        Use of each grasp only what was read until this rule would have ended the contact.
    object_range : (float, float), optional
        Between what objects of unknown temperature are [degC]; by default 20 K about the room.
    nearest : bool, optional
        Name the likeliest candidate also where it is likelier none of them.

    Returns
    -------
    answers : list of Answer

    Raises
    ------
    UserError
        If a candidate is unknown to the classifier, or named twice, or a rule is to stop touches of one
        block, which share an answer.

    Examples
    --------
    >>> from thermogrip.classify import make_classifier
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> grasps = load_example_grasps()["exp2_dT20"]
    >>> first = answer(make_classifier("features-lda").fit(grasps), grasps)[0]
    >>> first.material, round(first.probabilities["copper"], 2), first.decided_at, first.notes
    ('copper', 0.85, 10.0, ())
    """
    return [
        one_answer
        for grasps in record_list(X)
        for one_answer in answer_record(
            classifier, grasps, candidates, rule, object_range, nearest=nearest
        ).answers
    ]


def classify_grasps(
    classifier: GraspClassifier, X: Records, candidates: Sequence[str] | None = None, **options: Any
) -> list[Row]:
    """Return :func:`answer` as rows of a table: ``grasp_id, material, p_<material>..., p_unknown,
    decided_at_s, misfit_sd, deviates, note, note_codes``."""
    return [one_answer.row() for one_answer in answer(classifier, X, candidates, **options)]


class AnsweredRecord(NamedTuple):
    """What the grasps of one record touched, and what of them was usable."""

    answers: list[Answer]
    quality: GraspQuality


def answer_record(
    classifier: GraspClassifier,
    as_read: Grasps,
    candidates: Sequence[str] | None,
    rule: StopRule | None,
    object_range: tuple[float, float] | None,
    *,
    nearest: bool,
) -> AnsweredRecord:
    """Return :func:`answer` of one record: answers that can be given, and what the others get."""
    names = [str(c) for c in (classifier.classes_ if candidates is None else candidates)]
    if len(set(names)) < len(names):
        raise UserError("a candidate is named twice", hint="name each once")
    whole, grasps = not classifier.leaves_samples_out, with_object_range(as_read, object_range)
    quality = check_grasps(grasps, longest=classifier.longest_, whole_traces=whole)
    usable, units = quality.read(grasps), unit_names(grasps)
    named = [] if usable is None else _answers_of_usable(classifier, usable, names, rule, nearest=nearest)
    of_unit = {} if usable is None else dict(zip(unit_names(usable).tolist(), named))
    last = _last_samples(grasps["time"].values, grasps["t_surface"].values, units)
    unread, answers = iter(named), list[Answer]()
    for i, grasp_id in enumerate(grasps["grasp"].values.astype(str).tolist()):
        notes: tuple[Note, ...] = (Note("readings", quality.note[i]),) if quality.note[i] else ()
        if quality.usable[i]:
            one = next(unread)
            notes += one.notes
        elif units[i] in of_unit:
            one = of_unit[str(units[i])]
            notes = (Note("other_touches", f"{quality.note[i]}: the answer of its block's other touches"),)
        else:
            # without contact it is none of the candidates for certain
            p_unknown = 1.0 if quality.reason[i] == NO_CONTACT else None
            one = Answer(
                grasp_id="",
                material="",
                probabilities=dict.fromkeys(names),
                p_unknown=p_unknown,
                decided_at=float(last[i]),
            )
        answers.append(replace(one, grasp_id=grasp_id, notes=notes))
    return AnsweredRecord(answers, quality)


def _answers_of_usable(
    classifier: GraspClassifier, grasps: Grasps, names: list[str], rule: StopRule | None, *, nearest: bool
) -> list[Answer]:
    """Return the answers of a classifier to grasps whose usable part is given, without their ids."""
    if rule is None:
        answered, units = classifier.answered(grasps, names), unit_names(grasps)
        answered = answered._replace(log_p=joined_touches(classifier, answered.log_p, units))
        decided = _last_samples(grasps["time"].values, grasps["t_surface"].values, units)
    else:
        answered, decided = _stopped(classifier, grasps, names, rule)
    out = []
    for i, row in enumerate(answered.log_p):
        p_unknown, misfit = (float(v[i]) if np.isfinite(v[i]) else None for v in answered[1:3])
        none = p_unknown is not None and p_unknown > _STRANGE
        out.append(
            Answer(
                grasp_id="",
                material=UNKNOWN if none and not nearest else names[int(row.argmax())],
                probabilities={name: float(p) for name, p in zip(names, np.exp(row))},
                p_unknown=p_unknown,
                decided_at=float(decided[i]),
                misfit_sd=misfit,
                deviates=answered.deviates[i] if none else "",
                notes=tuple(answered.notes[i]),
            )
        )
    return out


def _stopped(
    classifier: GraspClassifier, grasps: Grasps, names: list[str], rule: StopRule
) -> tuple[Answered, Floats]:
    """Return the answers where the rule ends each contact, and when that is, (n,) [s]."""
    if has_touch_groups(grasps):
        problem = "touches of one block are answered together, no rule ends one of them"
        raise UserError(problem, file=log_name(grasps), hint="leave --early out, or the column touch_group")
    end = contact_end(grasps, rule.end)
    windows = growing_windows(classifier, grasps, candidates=names, times=rule.times, end=end)
    ended = stops(rule, windows, silent_windows(grasps, windows.times)).time
    out = Answered.nothing(ended.size, len(names))
    for time in np.unique(ended):
        ended_then = np.flatnonzero(ended == time)
        cut = classifier.answered(pick(grasps, ended_then).sel(time=slice(None, time + 1e-9)), names)
        pairs: Any = zip(out, cut)
        for whole, cut_values in pairs:
            for i, value in zip(ended_then.tolist(), cut_values):
                whole[i] = value
    return out, ended


def joined_touches(classifier: GraspClassifier, log_p: Floats, units: NDArray[np.str_]) -> Floats:
    """Return log probabilities in which all touches of one unit have their common answer, same shape: the
    classifier's own, or the normalised sum of theirs."""
    if classifier.joins_touches or np.unique(units).size == units.size:
        return log_p
    out = np.empty_like(log_p)
    for unit in np.unique(units):
        out[units == unit] = normalised(log_p[units == unit].sum(axis=0, keepdims=True))
    return out


def write_predictions(rows: Sequence[Row], path: str | Path) -> Path:
    """Write ``predictions.csv`` whole or not at all and return its path; probabilities get six digits."""
    return write_atomic(path, table_csv(rows))


def table_csv(rows: Sequence[Mapping[str, Any]], unknown: str = "") -> str:
    """Return a table as CSV text: a header from all rows' keys, floats with six digits, None empty, NaN as
    ``unknown``."""
    names = list(dict.fromkeys(key for row in rows for key in row))
    return csv_text([names, *([_cell(row.get(name), unknown) for name in names] for row in rows)])


def _cell(value: Any, unknown: str) -> str:
    if value is None:
        return ""
    if isinstance(value, float) and np.isnan(value):
        return unknown
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _last_samples(time: Floats, skin: Floats, units: NDArray[np.str_]) -> Floats:
    """Return the time of the last sample of each grasp's unit, (n_grasp,) [s]."""
    has_sample = np.isfinite(skin)
    return np.array([time[has_sample[units == unit].any(axis=0)][-1] for unit in units])


_STRANGE = 0.5  # p_unknown


def unexplained_effusivities(
    device: GripperModel, grasps: Grasps, rows: Sequence[EffusivityRow]
) -> dict[str, tuple[float, str]]:
    """Return the misfit of single touches under their effusivity [standard deviations], and in words why
    that does not explain them."""
    ln_e = np.log([row.effusivity for row in rows])
    single = np.flatnonzero((label_values(grasps, "touch_group") == "") & np.isfinite(ln_e))
    if not single.size:
        return {}
    data = touches(grasps, at=single)
    hypotheses = free_hypotheses(device, device.found_effusivity(ln_e[single]))
    sd = np.log(10) * np.array([rows[i].log10_effusivity_sd for i in single])
    with_spread, row = hypotheses._replace(ln_e_sd=sd), np.arange(single.size)
    prior = prior_of(device, data, with_spread)
    misfits = unexplained(data, row, fit_pairs(device, data, row, with_spread, prior=prior), prior)
    return {str(name): why for name, why in zip(data.grasp_id, misfits)}
