"""The answer for each grasp: a material, probabilities, and how likely it is none of them.

``material`` is the likeliest known one, or "unknown" where it is likelier none of them; ``p_unknown`` is
beside the probabilities, not in their sum.
Touches of one block (``touch_group``) are one question: a classifier that knows how touches hang together
answers it from all of them, of another the log probabilities are added, and each row has the common answer.
``decided_at_s`` is the contact time that was used: the last sample of the grasp or of its group's last
touch, or where a stop rule would have ended the contact.  What of a grasp is usable is decided in
:mod:`thermogrip.sysid.effusivity.quality`, and ``note`` explains what is not: a grasp without contact is
none of the candidates for certain, and the row of a left-out touch has the answer of its block's others.

**Why a grasp is out of distribution.**  Under a candidate every nuisance u_k has a value that fits best, and
training grasps have given its mean m_k and standard deviation s_k.  A large ``p_unknown`` comes with large
deviations (u_k - m_k) / s_k under every known material, or with whitened residuals r of n bins whose
(|r|^2 - n) / sqrt(2 n) is large.  They show what to check: a block that was not at its nominal temperature,
a contact that closed badly, or a trace that no such block gives.
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
    Floats,
    GraspClassifier,
    Records,
    normalised,
    pick,
    record_list,
)
from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.datasets.arrays import Array
from thermogrip.datasets.atomic_files import write_atomic
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.media import csv_text
from thermogrip.datasets.schema import has_touch_groups, label_values, log_name, unit_names
from thermogrip.sysid.effusivity.data import (
    Touches,
    object_range,
    touches,
    with_object_range,
)
from thermogrip.sysid.effusivity.gripper_model import GripperModel
from thermogrip.sysid.effusivity.laplace_approximation import (
    BUILD_UP,
    EFFUSIVITY,
    ONSET,
    T_OBJECT,
    H,
    Hypotheses,
    fit_pairs,
    free_hypotheses,
    material_hypotheses,
    prior_of,
)
from thermogrip.sysid.effusivity.posterior import EffusivityRow
from thermogrip.sysid.effusivity.quality import NO_CONTACT, check_grasps, number_values

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Grasps

Row: TypeAlias = dict[str, Any]


UNKNOWN = "unknown"  # the material of a grasp that is likelier of none of the candidates


@dataclass(frozen=True)
class Note:
    """One thing to know of an answer.

    Parameters
    ----------
    code : str
        For programs: ``readings`` (what of them was usable), ``other_touches`` (the answer is theirs),
        ``beyond_training`` (another gripper, other blocks, a longer rest), ``not_explained``.
    words : str
        For people.
    """

    code: str
    words: str


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
        out |= {} if self.misfit_sd is None else {"misfit_sd": self.misfit_sd}
        out |= {"deviates": self.deviates} if self.deviates else {}
        if self.notes:
            out["note"] = "; ".join(note.words for note in self.notes)
            out["note_codes"] = " ".join(note.code for note in self.notes)
        return out


def answer(
    classifier: GraspClassifier, X: Records, candidates: Sequence[str] | None = None, *,
    rule: StopRule | None = None, object_range: tuple[float, float] | None = None, nearest: bool = False,
) -> list[Answer]:  # fmt: skip
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
    ('copper', 0.94, 10.0, ())
    """
    names = [str(c) for c in (classifier.classes_ if candidates is None else candidates)]
    if len(set(names)) < len(names):
        raise UserError("a candidate is named twice", hint="name each once")
    return [
        found
        for grasps in record_list(X)
        for found in _answers(classifier, grasps, names, rule, object_range, nearest=nearest)
    ]


def classify_grasps(
    classifier: GraspClassifier, X: Records, candidates: Sequence[str] | None = None, **options: Any
) -> list[Row]:
    """Return :func:`answer` as rows of a table: ``grasp_id, material, p_<material>..., p_unknown,
    decided_at_s``, and where there is something to say ``misfit_sd, deviates, note, note_codes``."""
    return [found.row() for found in answer(classifier, X, candidates, **options)]


def _answers(
    classifier: GraspClassifier, as_read: Grasps, names: list[str], rule: StopRule | None,
    object_range: tuple[float, float] | None, *, nearest: bool,
) -> list[Answer]:  # fmt: skip
    """Return the answers of one record: those that can be given, and what the others get."""
    whole, grasps = not classifier.leaves_samples_out, with_object_range(as_read, object_range)
    quality = check_grasps(grasps, longest=classifier.longest_, whole_traces=whole)
    usable, units = quality.read(grasps), unit_names(grasps)
    found = [] if usable is None else _named(classifier, usable, names, rule, nearest=nearest)
    of_unit = {} if usable is None else dict(zip(unit_names(usable).tolist(), found))
    last = _last_samples(grasps["time"].values, grasps["t_surface"].values, units)
    left, answers = iter(found), list[Answer]()
    for i, grasp_id in enumerate(grasps["grasp"].values.astype(str).tolist()):
        notes: tuple[Note, ...] = (Note("readings", quality.note[i]),) if quality.note[i] else ()
        if quality.usable[i]:
            one = next(left)
            notes += one.notes
        elif units[i] in of_unit:
            one = of_unit[str(units[i])]
            notes = (Note("other_touches", f"{quality.note[i]}: the answer of its block's other touches"),)
        else:
            one = _no_answer(names, quality.reason[i], float(last[i]))
        answers.append(replace(one, grasp_id=grasp_id, notes=notes))
    # what a contact that a rule ended would have shown later is no misfit of its answer
    return answers if rule is not None else _with_misfits(classifier, as_read, answers, object_range)


def _named(
    classifier: GraspClassifier, grasps: Grasps, names: list[str], rule: StopRule | None, *, nearest: bool
) -> list[Answer]:
    """Return the answers of a classifier to grasps whose usable part is given, without their ids."""
    if rule is None:
        units = unit_names(grasps)
        log_p, unknown, beyond = classifier.open_set_answer(grasps, names)
        log_p = joined_touches(classifier, log_p, units)
        decided = _last_samples(grasps["time"].values, grasps["t_surface"].values, units)
    else:
        log_p, unknown, decided = _stopped(classifier, grasps, names, rule)
        beyond = classifier.beyond_training(grasps)
    out = []
    for i, row in enumerate(log_p):
        p_unknown = float(unknown[i]) if np.isfinite(unknown[i]) else None
        none = not nearest and p_unknown is not None and p_unknown > _STRANGE
        out.append(
            Answer(
                grasp_id="", material=UNKNOWN if none else names[int(row.argmax())],
                probabilities={name: float(p) for name, p in zip(names, np.exp(row))}, p_unknown=p_unknown,
                decided_at=float(decided[i]),
                notes=(Note("beyond_training", beyond[i]),) if beyond[i] else (),
            )
        )  # fmt: skip
    return out


def _no_answer(names: list[str], why: str, last: float) -> Answer:
    """Return the answer of an unusable grasp; without contact it is none of the candidates for certain."""
    return Answer(
        grasp_id="", material="", probabilities=dict.fromkeys(names), decided_at=last,
        p_unknown=1.0 if why == NO_CONTACT else None,
    )  # fmt: skip


def _with_misfits(
    classifier: GraspClassifier, grasps: Grasps, answers: list[Answer], stated: tuple[float, float] | None
) -> list[Answer]:
    """Return the answers to one record with what the likeliest candidate does not explain, and what it
    requires that is unusual, of single touches by an exactly known gripper."""
    # an uncertain gripper may be the reason itself
    if not isinstance(classifier, PosteriorClassifier) or classifier.device_.uncertain:
        return answers
    single = label_values(grasps, "touch_group") == ""
    at = np.array([i for i, one in enumerate(answers) if single[i] and one.nearest], dtype=np.int64)
    if not at.size:
        return answers
    out, model = [*answers], classifier.device_
    data, ends = _asked(grasps, at, classifier.longest_, stated)
    named = [answers[i].nearest for i in at]
    misfits = _unexplained(model, data, ends, _taken_for(model, named, finish=classifier.as_taught))
    strange = np.flatnonzero([(answers[i].p_unknown or 0.0) > _STRANGE for i in at])
    words = dict.fromkeys(range(at.size), "")
    if strange.size:
        unusual = deviations(model, data.take(strange), [named[k] for k in strange])
        words |= {k: deviation_words(named[k], row) for k, row in zip(strange.tolist(), unusual)}
    for k, (i, (misfit, why)) in enumerate(zip(at.tolist(), misfits)):
        notes = (*out[i].notes, Note("not_explained", why)) if why else out[i].notes
        out[i] = replace(out[i], misfit_sd=misfit, deviates=words[k], notes=notes)
    return out


def _stopped(
    classifier: GraspClassifier, grasps: Grasps, names: list[str], rule: StopRule
) -> tuple[Floats, Floats, Floats]:
    """Return log probabilities, p_unknown and times where the rule ends each contact."""
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
    seen = np.isfinite(skin)
    return np.array([time[seen[units == unit].any(axis=0)][-1] for unit in units])


_UNUSUAL = 2.5  # standard deviations: less is usual, one grasp in eighty
_STRANGE = 0.5  # p_unknown
_UNEXPLAINED = 4.0  # standard deviations of the misfit; the rig's grasps have 2.3 at most


class Deviation(NamedTuple):
    """One thing that a candidate must assume: how many standard deviations ``sd`` it is off, and that in
    ``words``."""

    sd: float
    words: str


def deviations(device: GripperModel, data: Touches, materials: Sequence[str]) -> list[list[Deviation]]:
    """Return for each of n touches how far its nuisances and its misfit are from the usual if it is of the
    material named for it, the farthest first."""
    hypotheses = _taken_for(device, materials)
    prior = prior_of(device, data, hypotheses)
    mode = fit_pairs(device, data, np.arange(len(materials)), hypotheses)
    found = []
    for i in range(len(materials)):
        rows = _nuisances(mode.u[i] - prior.mean[i], prior.sd[i], bool(np.isfinite(data.t_object[i])))
        n = float((data.count[i] > 0).sum())
        times = float(np.sqrt(mode.misfit[i] / n))
        rows.append(Deviation(_misfit_sd(mode.misfit[i], n), f"a trace {times:.1f} times its noise away"))
        found.append(sorted(rows, key=lambda row: -row.sd))
    return found


def _misfit_sd(square: float, n: float) -> float:
    """Return how unusual the squared whitened residuals of n readings are, in standard deviations."""
    return float((square - n) / np.sqrt(2 * n))


def _unexplained(device: GripperModel, data: Touches, ends: Array, hypotheses: Hypotheses) -> list[Deviation]:
    """Return for each of n touches, each under its own row of ``hypotheses``, its misfit, and in words why
    its trace is not explained, if it is not.  ``ends`` (n, 2) [degC] are those of the range of its object,
    NaN where that is known."""
    mode = fit_pairs(device, data, np.arange(ends.shape[0]), hypotheses)
    n = (data.count > 0).sum(axis=1)
    if device.second is not None and data.second is not None:
        n = n + (data.second.count > 0).sum(axis=1)
    out = []
    for i, (low, high) in enumerate(ends):
        sd, found, words = _misfit_sd(mode.misfit[i], n[i]), mode.u[i, T_OBJECT], ""
        if sd > _UNEXPLAINED:
            words = "the trace is not explained by the model: the answer is unreliable"
        elif found < low or found > high:  # NaN compares false
            outside = f"explained only by an object outside of {low:.0f} to {high:.0f} degC"
            words = f"{outside}: the answer is unreliable"
        out.append(Deviation(sd, words))
    return out


def unexplained_effusivities(
    device: GripperModel,
    grasps: Grasps,
    rows: Sequence[EffusivityRow],
    stated: tuple[float, float] | None = None,
) -> dict[str, Deviation]:
    """Return the misfit of single touches under their effusivity, and in words why that does not explain
    them, with unknown object temperatures in the range ``stated`` [degC]."""
    alone = label_values(grasps, "touch_group") == ""
    ln_e = np.log([row.effusivity for row in rows])
    at = np.flatnonzero(alone & np.isfinite(ln_e))
    if device.uncertain or not at.size:
        return {}
    hypotheses = free_hypotheses(device, device.found_effusivity(ln_e[at]))
    sd = np.log(10) * np.array([rows[i].log10_effusivity_sd for i in at])
    data, ends = _asked(grasps, at, np.inf, stated)
    found = _unexplained(device, data, ends, hypotheses._replace(ln_e_sd=sd))
    return {str(name): why for name, why in zip(data.grasp_id, found)}


def deviation_words(material: str, row: Sequence[Deviation]) -> str:
    """Return in words which unusual values a material requires; empty where nothing is unusual."""
    unusual = [f"{s.words} ({s.sd:.1f} sd)" for s in row if s.sd > _UNUSUAL][:2]
    return f"as {material} it needs {' and '.join(unusual)}" if unusual else ""


def _asked(
    grasps: Grasps, at: NDArray[np.int64], until: float, stated: tuple[float, float] | None
) -> tuple[Touches, Array]:
    """Return some touches until a time [s], and the ends of each one's range of temperatures (n, 2) [degC],
    NaN where the object's is known; ``stated`` is that of unknown ones, by default 20 K about the room."""
    unknown = np.isnan(number_values(grasps, "t_object"))[at, None]
    ends = np.where(unknown, object_range(grasps, stated)[at], np.nan)
    return touches(with_object_range(grasps, stated), until=until, at=at), ends


def _taken_for(device: GripperModel, named: Sequence[str], **finish: str) -> Hypotheses:
    """Return the hypothesis of each named material, a row each."""
    names = list(dict.fromkeys(named))
    known = material_hypotheses(device, names, **finish)
    return type(known)(*(column[[names.index(name) for name in named]] for column in known))


def _nuisances(off: NDArray[np.float64], sd: NDArray[np.float64], nominal: bool) -> list[Deviation]:
    """Return the deviations of one grasp's nuisances, of those that are uncertain at all."""
    warmer = "warmer" if off[T_OBJECT] > 0 else "colder"
    late = "late" if off[ONSET] > 0 else "early"
    words = {
        H: f"{np.exp(off[H]):.2f} times the usual contact conductance",
        BUILD_UP: f"a contact that builds up in {np.exp(off[BUILD_UP]):.2f} times the usual time",
        ONSET: f"a contact {abs(off[ONSET]):.2f} s {late}",
        EFFUSIVITY: f"{np.exp(off[EFFUSIVITY]):.2f} times its block's effusivity",
    }
    if nominal:
        words[T_OBJECT] = f"its block {abs(off[T_OBJECT]):.1f} K {warmer} than its nominal temperature"
    return [Deviation(float(abs(off[k]) / sd[k]), text) for k, text in words.items() if sd[k] > 0]
