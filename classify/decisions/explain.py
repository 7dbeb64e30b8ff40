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

from thermogrip.classify.estimators.base import GraspClassifier, Records, record_list
from thermogrip.datasets.schema import Grasps, label_values
from thermogrip.sysid.effusivity.contact_length import beginnings

if TYPE_CHECKING:
    from thermogrip.classify.decisions.predict import Row
    from thermogrip.sysid.effusivity.gripper_model import Device

__all__ = ["Strain", "reasons", "strain_words", "strains"]

_TELLING = 2.5  # spreads: less is usual, one grasp in eighty
_STRANGE = 0.5  # p_unknown


class Strain(NamedTuple):
    """One thing that a candidate must assume: how many ``spreads`` it is off, and that in ``words``."""

    spreads: float
    words: str


def strains(device: Device, grasps: Grasps, materials: Sequence[str]) -> list[list[Strain]]:
    """Return what is unusual about each grasp if it is of the material named for it, the farthest first.

    Parameters
    ----------
    device : Device
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
    >>> from thermogrip.sysid.effusivity.gripper_model import load_default_device
    >>> iron = load_example_grasps()["exp2_dT20"].isel(grasp=[8])
    >>> cold = iron.assign(t_object=iron["t_object"] + 2.0)  # its dial said two degrees too much
    >>> device = load_default_device()
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
    if not isinstance(classifier, PosteriorClassifier) or classifier.device_.in_doubt:
        return words
    first = 0
    for grasps in record_list(X):
        n = grasps.sizes["grasp"]
        group = label_values(grasps, "touch_group")
        own = rows[first : first + n]
        at = [i for i in range(n) if group[i] == "" and own[i]["material"] and _strange(own[i])]
        if at:
            named = [str(own[i]["material"]) for i in at]
            found = strains(classifier.device_, beginnings(grasps.isel(grasp=at), classifier.longest_), named)
            for i, name, row in zip(at, named, found):
                words[first + i] = strain_words(name, row)
        first += n
    return words


def _strange(row: Row) -> bool:
    return bool((row["p_unknown"] or 0.0) > _STRANGE)


def _nuisances(off: NDArray[np.float64], sd: NDArray[np.float64], dial: bool) -> list[Strain]:
    """Return the strains of one grasp's nuisances, of those that are uncertain at all."""
    from thermogrip.sysid.effusivity.laplace_approximation import BUILD, EFFUSIVITY, ONSET, T_OBJECT, H

    warmer = "warmer" if off[T_OBJECT] > 0 else "colder"
    late = "late" if off[ONSET] > 0 else "early"
    words = {
        H: f"{np.exp(off[H]):.2f} times the usual contact conductance",
        BUILD: f"a contact that builds up in {np.exp(off[BUILD]):.2f} times the usual time",
        ONSET: f"a contact {abs(off[ONSET]):.2f} s {late}",
        EFFUSIVITY: f"{np.exp(off[EFFUSIVITY]):.2f} times its block's effusivity",
    }
    if dial:
        words[T_OBJECT] = f"its block {abs(off[T_OBJECT]):.1f} K {warmer} than its dial says"
    return [Strain(float(abs(off[k]) / sd[k]), text) for k, text in words.items() if sd[k] > 0]
