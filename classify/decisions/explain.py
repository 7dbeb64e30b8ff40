"""What a material would have to be forgiven: why a grasp looks like none that the training knows.

Under a candidate every nuisance u_k of a grasp has a value that fits best, and training grasps have told what
is usual, mean m_k and spread s_k (:mod:`thermogrip.sysid.effusivity.priors`).  Its strain is

    w_k = (u_k - m_k) / s_k,

and what is left of the trace, whitened residuals r of n bins, has |r|^2 of about n where the model holds; its
strain is (|r|^2 - n) / sqrt(2 n).  A grasp with a large ``p_unknown`` has large strains under every known
material, and they say what to look at: a block that was not as warm as its dial, a contact that closed badly,
or a trace that no such block gives.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermogrip.classify.estimators.base import GraspClassifier, Records, pick, record_list
from thermogrip.datasets.schema import Grasps, label_values
from thermogrip.sysid.effusivity.quality import check_grasps

if TYPE_CHECKING:
    from thermogrip.classify.decisions.predict import Row
    from thermogrip.sysid.effusivity.gripper_model import GripperModel
    from thermogrip.sysid.effusivity.posterior import EffusivityRow
    from thermogrip.sysid.effusivity.priors import Hypotheses

__all__ = [
    "Strain",
    "reasons",
    "strain_words",
    "strains",
    "unexplained",
    "unexplained_answers",
    "unexplained_effusivities",
]

_TELLING = 2.5  # spreads: less is usual, one grasp in eighty
_STRANGE = 0.5  # p_unknown
_UNEXPLAINED = 4.0  # standard deviations of the misfit; the rig's grasps have 2.3 at most


class Strain(NamedTuple):
    """One thing that a candidate must assume: how many ``spreads`` it is off, and that in ``words``."""

    spreads: float
    words: str


def strains(device: GripperModel, grasps: Grasps, materials: Sequence[str]) -> list[list[Strain]]:
    """Return what is unusual about each grasp if it is of the material named for it, the farthest first.

    Parameters
    ----------
    device : GripperModel
        A calibrated gripper.
    grasps : Grasps
        ``n`` grasps.
    materials : (n,) sequence of str
        A material for each grasp, of the calibration or the library.

    Returns
    -------
    strains : list of list of Strain
        A row a grasp.

    Examples
    --------
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
    >>> iron = load_example_grasps()["exp2_dT20"].isel(grasp=[8])
    >>> cold = iron.assign(t_object=iron["t_object"] + 2.0)  # its dial said two degrees too much
    >>> device = load_default_gripper()
    >>> strains(device, cold, ["iron"])[0][0].words
    'its block 1.5 K colder than its dial says'
    """
    from thermogrip.sysid.effusivity.data import touches
    from thermogrip.sysid.effusivity.priors import fit_pairs, material_hypotheses, prior_of

    data, names = touches(grasps), list(dict.fromkeys(materials))
    known = material_hypotheses(device, names)
    pick = np.array([names.index(name) for name in materials])
    hypotheses = type(known)(*(column[pick] for column in known))
    prior = prior_of(device, data, hypotheses)
    mode = fit_pairs(device, data, np.arange(len(pick)), hypotheses)
    found = []
    for i in range(pick.size):
        rows = _nuisances(mode.u[i] - prior.mean[i], prior.sd[i], bool(np.isfinite(data.t_object[i])))
        n = float((data.count[i] > 0).sum())
        times = float(np.sqrt(mode.misfit[i] / n))
        rows.append(
            Strain(float((mode.misfit[i] - n) / np.sqrt(2 * n)), f"a trace {times:.1f} times its noise away")
        )
        found.append(sorted(rows, key=lambda row: -row.spreads))
    return found


def unexplained(
    device: GripperModel,
    grasps: Grasps,
    hypotheses: Hypotheses,
    stated: tuple[float, float] | None = None,
) -> list[str]:
    """Return in words what no value of the nuisances explains in each grasp, or only an odd temperature.

    Parameters
    ----------
    device : GripperModel
        A calibrated gripper.
    grasps : Grasps
        ``n`` grasps.
    hypotheses : Hypotheses
        What each of them is taken for, ``n`` rows.
    stated : (float, float), optional
        The range of unknown object temperatures [degC]; default 20 K about the room.

    Returns
    -------
    words : (n,) list of str
        Empty where the trace is explained.
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
            words.append("the trace is not explained by the model: doubt the answer")
        elif not known[i] and not low <= mode.u[i, T_OBJECT] <= high:
            words.append(
                f"explained only by an object outside of {low:.0f} to {high:.0f} degC: doubt the answer"
            )
        else:
            words.append("")
    return words


def unexplained_answers(
    classifier: GraspClassifier,
    X: Records,
    rows: Sequence[Row],
    stated: tuple[float, float] | None = None,
) -> list[str]:
    """Return for each row of predictions what its material does not explain; only ``posterior`` can tell.

    ``stated`` is the range of unknown object temperatures [degC].  Empty too for touches of one block.
    """
    from thermogrip.classify.estimators.posterior import PosteriorClassifier
    from thermogrip.sysid.effusivity.priors import material_hypotheses

    words = [""] * len(rows)
    if not isinstance(classifier, PosteriorClassifier) or classifier.device_.uncertain:
        return words
    first = 0
    for grasps in record_list(X):
        n, group = grasps.sizes["grasp"], label_values(grasps, "touch_group")
        at = [i for i in range(n) if group[i] == "" and rows[first + i]["material"]]
        if at:
            named = [str(rows[first + i]["material"]) for i in at]
            names = list(dict.fromkeys(named))
            known = material_hypotheses(classifier.device_, names, finish=classifier.finish)
            taken = np.array([names.index(name) for name in named])
            hypotheses = type(known)(*(column[taken] for column in known))
            part = pick(grasps, at)
            part = check_grasps(part, longest=classifier.longest_).read(part)
            for i, said in zip(at, unexplained(classifier.device_, part, hypotheses, stated)):
                words[first + i] = said
        first += n
    return words


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
    said = unexplained(device, check_grasps(part).read(part), hypotheses._replace(ln_e_sd=sd), stated)
    names = grasps["grasp"].values[at]
    return {str(name): why for name, why in zip(names, said) if why}


def strain_words(material: str, row: Sequence[Strain]) -> str:
    """Return in words what a grasp asks of a material; empty where nothing is unusual.

    Examples
    --------
    >>> strain_words("copper", [Strain(4.1, "its block 1.2 K colder than its dial says"), Strain(0.4, "...")])
    'as copper it needs its block 1.2 K colder than its dial says (4.1 sd)'
    >>> strain_words("copper", [Strain(1.0, "...")])
    ''
    """
    telling = [f"{s.words} ({s.spreads:.1f} sd)" for s in row if s.spreads > _TELLING][:2]
    return f"as {material} it needs {' and '.join(telling)}" if telling else ""


def reasons(classifier: GraspClassifier, X: Records, rows: Sequence[Row]) -> list[str]:
    """Return for each row of predictions why it is taken for no known material, empty where it is not.

    Parameters
    ----------
    classifier : GraspClassifier
        Only ``posterior`` can tell.
    X : Grasps or list of Grasps
        What was classified.
    rows : (n,) sequence of dict
        As :func:`~thermogrip.classify.decisions.predict.classify_grasps` returned them.

    Returns
    -------
    words : (n,) list of str
        Empty too for touches of one block, whose temperature is no dial's, and for grasps without a name.
    """
    from thermogrip.classify.estimators.posterior import PosteriorClassifier

    words = [""] * len(rows)
    # a gripper in doubt may be the reason itself
    if not isinstance(classifier, PosteriorClassifier) or classifier.device_.uncertain:
        return words
    first = 0
    for grasps in record_list(X):
        n = grasps.sizes["grasp"]
        group = label_values(grasps, "touch_group")
        own = rows[first : first + n]
        at = [i for i in range(n) if group[i] == "" and own[i]["material"] and _strange(own[i])]
        if at:
            named = [str(own[i]["material"]) for i in at]
            part = grasps.isel(grasp=at)
            part = check_grasps(part, longest=classifier.longest_).cut(part)
            found = strains(classifier.device_, part, named)
            for i, name, row in zip(at, named, found):
                words[first + i] = strain_words(name, row)
        first += n
    return words


def _strange(row: Row) -> bool:
    return bool((row["p_unknown"] or 0.0) > _STRANGE)


def _nuisances(off: NDArray[np.float64], sd: NDArray[np.float64], dial: bool) -> list[Strain]:
    """Return the strains of one grasp's nuisances, of those that are uncertain at all."""
    from thermogrip.sysid.effusivity.laplace_approximation import BUILD_UP, EFFUSIVITY, ONSET, T_OBJECT, H

    warmer = "warmer" if off[T_OBJECT] > 0 else "colder"
    late = "late" if off[ONSET] > 0 else "early"
    words = {
        H: f"{np.exp(off[H]):.2f} times the usual contact conductance",
        BUILD_UP: f"a contact that builds up in {np.exp(off[BUILD_UP]):.2f} times the usual time",
        ONSET: f"a contact {abs(off[ONSET]):.2f} s {late}",
        EFFUSIVITY: f"{np.exp(off[EFFUSIVITY]):.2f} times its block's effusivity",
    }
    if dial:
        words[T_OBJECT] = f"its block {abs(off[T_OBJECT]):.1f} K {warmer} than its dial says"
    return [Strain(float(abs(off[k]) / sd[k]), text) for k, text in words.items() if sd[k] > 0]
