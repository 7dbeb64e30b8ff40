"""Leak probe: what a classifier says when nothing was touched yet.

Everything after -0.5 s is replaced by the trace's own level before contact, with noise of the size seen
there.  Such a record holds no touch, so a classifier trained and tested on it must be at chance; one that is
not has found the label elsewhere: in the gripper's temperature on that day, in the order of the grasps, in a
column of the record. On public touch data such a probe reached 0.83 where chance is 0.17.

The probe is one-sided binomial: how likely are k or more right of n grasps, at the share of the commonest
material.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import binom

from thermogrip.classify.estimators.base import GraspClassifier, level
from thermogrip.classify.estimators.lda import ArrayClassifier
from thermogrip.datasets.schema import Grasps

__all__ = [
    "LAST_UNTOUCHED",
    "binomial_p",
    "chance",
    "generic_probe",
    "has_before",
    "probe_clone",
    "untouched",
]

LAST_UNTOUCHED = -0.5  # s; hands are slower than messages: contact may precede the "closed" message by 0.3 s
_LATEST_LEVEL, _LEVEL_SAMPLES = -0.25, 3
_PROBE_EPOCHS = 100
_LEAST_NOISE = 0.02  # degC


def untouched(grasps: Grasps, *, seed: int = 0) -> Grasps:
    """Return the record as if the gripper had never closed.

    Examples
    --------
    >>> from thermogrip.datasets.schema import make_grasps
    >>> t = np.arange(-1.0, 5.0, 0.1)
    >>> g = make_grasps(t, [np.where(t > 0, 30.0, 23.0)], ["g0"])
    >>> bool(abs(untouched(g)["t_surface"] - 23.0).max() < 0.2)
    True
    """
    out = grasps.copy(deep=True)
    time = grasps["time"].values
    rng = np.random.default_rng(seed)
    for key in [k for k in ("t_surface", "t_surface_2") if k in grasps]:
        values, base = out[key].values, level(grasps, key)
        early = values[:, time <= LAST_UNTOUCHED]
        spread = np.nanstd(early, axis=1) if early.shape[1] > 1 else np.zeros(base.size)
        held = base[:, None] + np.maximum(spread, _LEAST_NOISE)[:, None] * rng.standard_normal(values.shape)
        after = (time > LAST_UNTOUCHED)[None, :] & np.isfinite(values)
        out[key] = (("grasp", "time"), np.where(after, held, values), grasps[key].attrs)
    return out


def has_before(grasps: Grasps) -> bool:
    """Return whether a record holds a level before contact, without which there is nothing to probe.

    Contact may precede the message by 0.3 s: what is needed is three readings before that.
    """
    return bool(np.sum(grasps["time"].values <= _LATEST_LEVEL) >= _LEVEL_SAMPLES)


def probe_clone(classifier: GraspClassifier) -> GraspClassifier:
    """Return an unfitted copy for the probe; a network trains briefly, enough for a leak that matters."""
    from sklearn.base import clone

    copy: GraspClassifier = clone(classifier)
    if "epochs" in copy.get_params():
        copy.set_params(epochs=min(int(copy.get_params()["epochs"]), _PROBE_EPOCHS))
    return copy


def generic_probe() -> GraspClassifier:
    """Return the classifier that looks for the label before touch: shrinkage LDA, levels included."""
    return ArrayClassifier(
        "sklearn.discriminant_analysis.LinearDiscriminantAnalysis",
        params={"solver": "lsqr", "shrinkage": "auto"},
        start=-np.inf,
        subtract_level=False,
    )


def chance(materials: np.ndarray[tuple[int, ...], np.dtype[np.str_]]) -> float:
    """Return the share of the commonest material: what constant guessing can reach."""
    counts = np.unique(materials, return_counts=True)[1]
    return float(counts.max() / counts.sum())


def binomial_p(right: float, n: int, by_chance: float) -> float:
    """Return the probability of so many or more right of n by chance.

    Examples
    --------
    >>> round(binomial_p(9, 9, 1 / 3), 6)  # nine of nine, three materials
    5.1e-05
    """
    return float(binom.sf(np.ceil(right - 1e-9) - 1, n, by_chance))
