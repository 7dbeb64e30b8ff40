"""Why a grasp is out of distribution: how far its nuisances are from the training under each material.

Under a candidate every nuisance u_k of a grasp has a value that fits best, and training grasps have given
its mean m_k and standard deviation s_k (:mod:`thermogrip.sysid.effusivity.priors`).  Its standardised
deviation is

    w_k = (u_k - m_k) / s_k,

and what is left of the trace, whitened residuals r of n bins, has |r|^2 of about n under the model; its
deviation is (|r|^2 - n) / sqrt(2 n).  A grasp with a large ``p_unknown`` has large deviations under every
known material, and they show what to check: a block that was not at its nominal temperature, a contact that
closed badly, or a trace that no such block gives.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermogrip.classify.estimators.base import GraspClassifier, Records, pick, record_list
from thermogrip.datasets.schema import Grasps, label_values
from thermogrip.sysid.effusivity.quality import check_grasps

if TYPE_CHECKING:
    from thermogrip.classify.decisions.predict import Row
    from thermogrip.classify.estimators.posterior import PosteriorClassifier
    from thermogrip.sysid.effusivity.gripper_model import GripperModel
    from thermogrip.sysid.effusivity.posterior import EffusivityRow
    from thermogrip.sysid.effusivity.priors import Hypotheses

__all__ = [
    "Deviation",
    "deviation_words",
    "deviations",
    "reasons",
    "unexplained",
    "unexplained_answers",
    "unexplained_effusivities",
]

_UNUSUAL = 2.5  # standard deviations: less is usual, one grasp in eighty
_STRANGE = 0.5  # p_unknown
_UNEXPLAINED = 4.0  # standard deviations of the misfit; the rig's grasps have 2.3 at most


class Deviation(NamedTuple):
    """One thing that a candidate must assume: how many standard deviations ``sd`` it is off, and that in
    ``words``."""

    sd: float
    words: str


def deviations(device: GripperModel, grasps: Grasps, materials: Sequence[str]) -> list[list[Deviation]]:
    """Return for each of n grasps how far its nuisances and its misfit are from the usual if it is of the
    material named for it, the farthest first."""
    from thermogrip.sysid.effusivity.data import touches
    from thermogrip.sysid.effusivity.priors import fit_pairs, prior_of

    data, hypotheses = touches(grasps), _taken_for(device, materials)
    prior = prior_of(device, data, hypotheses)
    mode = fit_pairs(device, data, np.arange(len(materials)), hypotheses)
    found = []
    for i in range(len(materials)):
        rows = _nuisances(mode.u[i] - prior.mean[i], prior.sd[i], bool(np.isfinite(data.t_object[i])))
        n = float((data.count[i] > 0).sum())
        times = float(np.sqrt(mode.misfit[i] / n))
        rows.append(
            Deviation(
                float((mode.misfit[i] - n) / np.sqrt(2 * n)), f"a trace {times:.1f} times its noise away"
            )
        )
        found.append(sorted(rows, key=lambda row: -row.sd))
    return found


def unexplained(
    device: GripperModel, grasps: Grasps, hypotheses: Hypotheses, stated: tuple[float, float] | None = None
) -> list[str]:
    """Return for each of n grasps, each under its own row of ``hypotheses``, why its trace is not explained;
    empty where it is.

    ``stated`` is the range of unknown object temperatures [degC]; by default 20 K about the room.
    """
    from thermogrip.sysid.effusivity.data import object_range, touches, with_object_range
    from thermogrip.sysid.effusivity.laplace_approximation import T_OBJECT
    from thermogrip.sysid.effusivity.priors import fit_pairs

    data, ends = touches(with_object_range(grasps, stated)), object_range(grasps, stated)
    known = np.isfinite(touches(grasps).t_object)
    mode = fit_pairs(device, data, np.arange(ends.shape[0]), hypotheses)
    n = (data.count > 0).sum(axis=1)
    words = []
    for i, (low, high) in enumerate(ends):
        if mode.misfit[i] > n[i] + _UNEXPLAINED * np.sqrt(2 * n[i]):
            words.append("the trace is not explained by the model: the answer is unreliable")
        elif not known[i] and not low <= mode.u[i, T_OBJECT] <= high:
            outside = f"explained only by an object outside of {low:.0f} to {high:.0f} degC"
            words.append(f"{outside}: the answer is unreliable")
        else:
            words.append("")
    return words


def unexplained_answers(
    classifier: GraspClassifier, X: Records, rows: Sequence[Row], stated: tuple[float, float] | None = None
) -> list[str]:
    """Return for each row of predictions what its material does not explain, empty as for :func:`reasons`.

    ``stated`` is the range of unknown object temperatures [degC].
    """

    def words(model: PosteriorClassifier, grasps: Grasps, named: list[str]) -> list[str]:
        hypotheses = _taken_for(model.device_, named, finish=model.finish)
        part = check_grasps(grasps, longest=model.longest_).read(grasps)
        return unexplained(model.device_, part, hypotheses, stated)

    return _explained(classifier, X, rows, words, lambda row: True)


def unexplained_effusivities(
    device: GripperModel,
    grasps: Grasps,
    rows: Sequence[EffusivityRow],
    stated: tuple[float, float] | None = None,
) -> dict[str, str]:
    """Return the single touches that their effusivity does not explain, and why.

    ``stated`` is the range of unknown object temperatures [degC].
    """
    from thermogrip.sysid.effusivity.priors import free_hypotheses

    alone = label_values(grasps, "touch_group") == ""
    ln_e = np.log([row.effusivity for row in rows])
    at = np.flatnonzero(alone & np.isfinite(ln_e))
    if device.uncertain or not at.size:
        return {}
    hypotheses = free_hypotheses(device, device.found_effusivity(ln_e[at]))
    sd = np.log(10) * np.array([rows[i].log10_effusivity_sd for i in at])
    part = pick(grasps, at)
    found = unexplained(device, check_grasps(part).read(part), hypotheses._replace(ln_e_sd=sd), stated)
    names = grasps["grasp"].values[at]
    return {str(name): why for name, why in zip(names, found) if why}


def deviation_words(material: str, row: Sequence[Deviation]) -> str:
    """Return in words which unusual values a material requires; empty where nothing is unusual."""
    unusual = [f"{s.words} ({s.sd:.1f} sd)" for s in row if s.sd > _UNUSUAL][:2]
    return f"as {material} it needs {' and '.join(unusual)}" if unusual else ""


def reasons(classifier: GraspClassifier, X: Records, rows: Sequence[Row]) -> list[str]:
    """Return for each row of predictions why it is taken for no known material, empty where it is not.

    Parameters
    ----------
    classifier : GraspClassifier
        Only ``posterior`` has a model for that.
    X : Grasps or list of Grasps
        What was classified.
    rows : (n,) sequence of dict
        As :func:`~thermogrip.classify.decisions.predict.classify_grasps` returned them.

    Returns
    -------
    words : (n,) list of str
        Empty too for touches of one block, which have no nominal temperature, and for grasps without a name.
    """

    def words(model: PosteriorClassifier, grasps: Grasps, named: list[str]) -> list[str]:
        part = check_grasps(grasps, longest=model.longest_).cut(grasps)
        found = deviations(model.device_, part, named)
        return [deviation_words(name, row) for name, row in zip(named, found)]

    return _explained(classifier, X, rows, words, lambda row: (row["p_unknown"] or 0.0) > _STRANGE)


def _explained(
    classifier: GraspClassifier,
    X: Records,
    rows: Sequence[Row],
    words: Callable[[PosteriorClassifier, Grasps, list[str]], list[str]],
    wanted: Callable[[Row], bool],
) -> list[str]:
    """Return the words on each wanted row that is a named single touch of an exactly known gripper."""
    from thermogrip.classify.estimators.posterior import PosteriorClassifier

    out = [""] * len(rows)
    # an uncertain gripper may be the reason itself
    if not isinstance(classifier, PosteriorClassifier) or classifier.device_.uncertain:
        return out
    first = 0
    for grasps in record_list(X):
        group = label_values(grasps, "touch_group")
        own = rows[first : first + group.size]
        at = [i for i, row in enumerate(own) if group[i] == "" and row["material"] and wanted(row)]
        if at:
            for i, why in zip(at, words(classifier, pick(grasps, at), [str(own[i]["material"]) for i in at])):
                out[first + i] = why
        first += group.size
    return out


def _taken_for(device: GripperModel, named: Sequence[str], **finish: str) -> Hypotheses:
    """Return the hypothesis of each named material, a row each."""
    from thermogrip.sysid.effusivity.priors import material_hypotheses

    names = list(dict.fromkeys(named))
    known = material_hypotheses(device, names, **finish)
    return type(known)(*(column[[names.index(name) for name in named]] for column in known))


def _nuisances(off: NDArray[np.float64], sd: NDArray[np.float64], nominal: bool) -> list[Deviation]:
    """Return the deviations of one grasp's nuisances, of those that are uncertain at all."""
    from thermogrip.sysid.effusivity.laplace_approximation import BUILD_UP, EFFUSIVITY, ONSET, T_OBJECT, H

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
