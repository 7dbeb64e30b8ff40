r"""Materials from the physics: the evidence of each candidate under the calibrated gripper.

:mod:`thermogrip.sysid.effusivity.posterior` integrates everything unknown about a grasp (contact
conductance, onset, object temperature, level) and gives :math:`\ln Z_m = \ln p(\text{trace} | m)` for each
candidate m.  With prior odds :math:`\pi_m` (equal by default)

.. math:: p(m | \text{trace}) = \frac{\pi_m Z_m}{\sum_k \pi_k Z_k}.

Fitting calibrates the gripper, which is one and the same in every condition: training grasps at all
temperatures describe it together, also those of materials that are no candidates.  Beside the known materials
stands a free effusivity; its Bayes factor gives the probability that the grasp is of none of them.

Touches of one block (``touch_group``) are one question: their evidence is joint, since they share the block's
temperature (:mod:`thermogrip.sysid.effusivity.multi_touch`), and each of their rows carries the common
answer.

A calibration is of one gripper.  For another one of the same kind its numbers are a guess, and an answer
that takes them as exact is far too sure: ``gripper="another"`` integrates over what such a gripper may be
(:mod:`thermogrip.sysid.effusivity.gripper_model`), and :meth:`PosteriorClassifier.for_another_gripper`
learns it from a few of its grasps of known blocks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit, logsumexp

from thermogrip.classify.estimators.base import (
    Floats,
    GraspClassifier,
    Labels,
    Records,
    grasp_labels,
    pick,
    record_list,
    two_or_more,
)
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps, has_touch_groups, label_values
from thermogrip.sysid.effusivity.quality import check_grasps, longest_contact

if TYPE_CHECKING:
    from thermogrip.sysid.effusivity.gripper_model import GripperModel, GripperSpread
    from thermogrip.sysid.effusivity.multi_touch import Coupling, TouchGroups

__all__ = ["GRIPPERS", "PosteriorClassifier"]

GRIPPERS = ("same", "uncertain", "another")


class PosteriorClassifier(GraspClassifier):
    """Evidence of each material under the calibrated gripper (``"posterior"``).

    Parameters
    ----------
    finish : {"known", "unknown"}, optional
        Whether the test blocks are those of the training, or others of the same material.
    priors : dict of str to float, optional
        Prior odds of the materials; equal by default.
    prior_unknown : float, optional
        Prior probability of a material that is none of the candidates.
    device : GripperModel, optional
        A calibration to start from: fitting is quicker.
    random_state : int, optional
        Seed of the calibration.
    gripper : {"same", "uncertain", "another"}, optional
        Which gripper is asked about: the one that was calibrated, its numbers taken as the calibration's file
        says (as exact, unless it is in doubt); the same, with what the calibration left open integrated over;
        or another one of its kind.

    Attributes
    ----------
    classes_ : (K,) ndarray of str
    device_ : GripperModel
        The calibrated gripper.
    coupling_ : Coupling or None
        How blocks move between touches, where groups of touches taught it.
    longest_ : float
        How long the longest training contact lasted [s]: of single touches no more is read.
    """

    learns_from_all_conditions: ClassVar[bool] = True
    reads_beginnings: ClassVar[bool] = True
    joins_touches: ClassVar[bool] = True
    leaves_samples_out: ClassVar[bool] = True
    coupling_: Coupling | None = None

    def __init__(
        self,
        finish: str = "known",
        priors: dict[str, float] | None = None,
        prior_unknown: float = 0.1,
        device: GripperModel | None = None,
        random_state: int = 0,
        gripper: str = "same",
    ) -> None:
        self.finish = finish
        self.gripper = gripper
        self.priors = priors
        self.prior_unknown = prior_unknown
        self.device = device
        self.random_state = random_state

    def fit(
        self,
        X: Records,
        y: ArrayLike | None = None,
        *,
        progress: Callable[[float, str], None] | None = None,
    ) -> Self:
        """Calibrate the gripper on labelled grasps of one or several conditions.

        Parameters
        ----------
        X : Grasps or list of Grasps
            They need not share a time axis.
        y : (n_grasp,) array_like of str, optional
            Their materials, record after record; by default each record's own.
        progress : callable, optional
            Called with the fraction done and what is being done.

        Returns
        -------
        self
        """
        from thermogrip.sysid.effusivity.calibration import calibrate_gripper
        from thermogrip.sysid.effusivity.multi_touch import learn_coupling

        self._check_params()
        records = _labelled(record_list(X), y)
        labels = np.concatenate([grasp_labels(part) for part in records])
        self.classes_ = two_or_more(labels, "+".join(str(part.attrs.get("name")) for part in records))
        device = calibrate_gripper(records, start=self.device, seed=self.random_state, progress=progress)
        self.longest_ = longest_contact(records)
        self.coupling_ = None
        for part in records:
            if has_touch_groups(part):
                self.coupling_ = learn_coupling(device, part, start=self.coupling_)
        self.device_ = _asked_about(device, self.gripper)
        return self

    def with_device(self, device: GripperModel, coupling: Coupling | None = None) -> Self:
        """Take up a calibration in place of fitting one; the classes are its materials.

        Examples
        --------
        >>> from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
        >>> PosteriorClassifier().with_device(load_default_gripper()).classes_.tolist()
        ['brass', 'copper', 'iron', 'wood', 'zinc']
        """
        self._check_params()
        self.classes_ = np.asarray(sorted(device.materials))
        self.device_, self.coupling_ = _asked_about(device, self.gripper), coupling
        return self

    def for_another_gripper(
        self, known: Records | None = None, *, spread: GripperSpread | None = None
    ) -> PosteriorClassifier:
        """Return this classifier for another gripper of the same kind.

        Parameters
        ----------
        known : Grasps or list of Grasps, optional
            Grasps of the other gripper whose material is known: one tells most, three to ten of two materials
            nearly all.  Without them answers are as unsure as grippers differ.
        spread : GripperSpread, optional
            How far grippers lie apart; default what their making allows.

        Returns
        -------
        classifier : PosteriorClassifier
            Its classes are those of this one.

        Examples
        --------
        >>> from thermogrip.datasets.examples import load_example_grasps
        >>> from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
        >>> grasps = load_example_grasps()["exp1A_obj43_grip23"]
        >>> ours = PosteriorClassifier().with_device(load_default_gripper())
        >>> other = ours.for_another_gripper()
        >>> learnt = ours.for_another_gripper(grasps.isel(grasp=grasps["material"].values == "copper"))
        >>> iron = grasps.isel(grasp=grasps["material"].values == "iron")
        >>> sure = [float(m.predict_proba(iron).max(axis=1).mean()) for m in (other, learnt, ours)]
        >>> bool(sure[0] < sure[1] < sure[2])
        True
        """
        from thermogrip.sysid.effusivity.calibration import calibrate_gripper
        from thermogrip.sysid.effusivity.gripper_model import another_gripper

        self._check_fitted()
        device = another_gripper(self.device_, spread)
        if known is not None:
            device = calibrate_gripper(record_list(known), prior=device, seed=self.random_state)
        moved = PosteriorClassifier(**self.get_params(deep=False))
        moved.classes_, moved.device_, moved.coupling_ = self.classes_, device, self.coupling_
        moved.longest_ = self.longest_
        return moved

    def _check_params(self) -> None:
        if self.finish not in ("known", "unknown"):
            raise UserError(f"finish is {self.finish!r}", hint="use 'known' or 'unknown'")
        if self.gripper not in GRIPPERS:
            raise UserError(f"gripper is {self.gripper!r}", hint=f"use one of {', '.join(GRIPPERS)}")
        if not 0 < self.prior_unknown < 1:
            raise UserError(
                f"prior_unknown is {self.prior_unknown}", hint="use a probability between 0 and 1"
            )
        if self.priors is not None and not all(p > 0 for p in self.priors.values()):
            raise UserError("a prior is not positive", hint="leave a material out of the candidates instead")

    def _log_proba(self, grasps: Grasps) -> Floats:
        from thermogrip.sysid.effusivity.posterior import material_evidence

        names = [str(c) for c in self.classes_]
        evidence = np.empty((grasps.sizes["grasp"], len(names)))
        alone = _ungrouped(grasps)
        if alone.size:
            part = pick(grasps, alone)
            part = check_grasps(part, longest=self.longest_).cut(part)
            evidence[alone] = material_evidence(self.device_, part, names, finish=self.finish)
        if has_touch_groups(grasps):
            fit = self._joint(grasps, names)
            for at, row in zip(fit.rows, fit.log_evidence):
                evidence[at] = row
        return np.asarray(evidence + self.log_prior(names))

    def log_prior(self, names: Sequence[str]) -> Floats:
        """Return the log prior odds of some materials, (n_name,)."""
        return np.log([(self.priors or {}).get(name, 1.0) for name in names])

    def candidate_log_proba(self, X: Records, candidates: Sequence[str]) -> Floats:
        """Return log probabilities over a subset of ``classes_``: only their evidence is computed."""
        self._check_candidates(candidates)
        narrow = self._restricted(candidates)
        at = [list(narrow.classes_).index(name) for name in candidates]
        return narrow.predict_log_proba(X)[:, at]

    def p_unknown(self, X: Records, candidates: Sequence[str] | None = None) -> Floats:
        """Return the probability that a grasp is of none of the candidates, shape (n_grasp,)."""
        self._check_fitted()
        names = [str(c) for c in (self.classes_ if candidates is None else candidates)]
        return np.concatenate([self._p_unknown(part, names) for part in record_list(X)])

    def _p_unknown(self, grasps: Grasps, names: list[str]) -> Floats:
        from thermogrip.sysid.effusivity.multi_touch import free_touch_fit
        from thermogrip.sysid.effusivity.posterior import open_set

        p = np.empty(grasps.sizes["grasp"])
        alone = _ungrouped(grasps)
        if alone.size:
            part = pick(grasps, alone)
            part = check_grasps(part, longest=self.longest_).cut(part)
            p[alone] = open_set(self.device_, part, names, prior_unknown=self.prior_unknown).p_unknown
        if has_touch_groups(grasps):
            fit = self._joint(grasps, names)
            free = free_touch_fit(self.device_, grasps, coupling=self.coupling_)
            for name, at, row in zip(fit.groups, fit.rows, fit.log_evidence):
                odds = logsumexp(row) - np.log(len(names)) - free[name][0].log_evidence
                p[at] = expit(np.log(self.prior_unknown) - np.log1p(-self.prior_unknown) - odds)
        return p

    def beyond_training(self, grasps: Grasps) -> list[str]:
        """Return in words which blocks rested longer between touches than those of the training."""
        from thermogrip.sysid.effusivity.multi_touch import Coupling, rested_long

        known = (self.coupling_ or Coupling()).longest_rest
        words = f"rested longer than the {known:g} s of the training: the answer may be too sure"
        return [words if long else "" for long in rested_long(grasps, self.coupling_)]

    def _joint(self, grasps: Grasps, names: list[str]) -> TouchGroups:
        from thermogrip.sysid.effusivity.multi_touch import two_touch_fit

        return two_touch_fit(self.device_, grasps, names, coupling=self.coupling_, finish=self.finish)

    def _restricted(self, candidates: Sequence[str]) -> PosteriorClassifier:
        narrow = PosteriorClassifier(**self.get_params(deep=False))
        narrow.coupling_, narrow.longest_ = self.coupling_, self.longest_
        narrow.device_, narrow.classes_ = self.device_, np.asarray(sorted(map(str, candidates)))
        return narrow

    def get_state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Return how long contacts of the training lasted; the device has a file of its own."""
        return {"longest_contact_s": self.longest_ if np.isfinite(self.longest_) else None}, {}

    def set_state(self, numbers: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
        """Take up what :meth:`get_state` returned; earlier files do not say how long contacts lasted."""
        longest = numbers.get("longest_contact_s")
        self.longest_ = np.inf if longest is None else float(longest)
        if not self.longest_ > 0:
            raise ValueError(f"longest_contact_s {longest}")  # the reader says which file

    def save_parts(self, folder: Path) -> None:
        """Write ``device.json``, and ``coupling.json`` where touches of one block taught it."""
        self.device_.save(folder / "device.json")
        if self.coupling_ is not None:
            self.coupling_.save(folder / "coupling.json")

    def load_parts(self, folder: Path) -> None:
        """Read what :meth:`save_parts` wrote."""
        from thermogrip.sysid.effusivity.gripper_model import GripperModel
        from thermogrip.sysid.effusivity.multi_touch import Coupling

        self._check_params()
        self.device_ = GripperModel.load(folder / "device.json")
        file = folder / "coupling.json"
        self.coupling_ = Coupling.load(file) if file.exists() else None


def _asked_about(device: GripperModel, gripper: str) -> GripperModel:
    """Return a calibrated gripper as one that is as sure of itself as the question allows."""
    from thermogrip.sysid.effusivity.gripper_model import another_gripper

    if gripper == "another":
        return another_gripper(device)
    if gripper == "uncertain":
        if device.uncertainty is None:
            raise UserError(
                "the calibration does not say how well it knows the gripper", hint="calibrate again"
            )
        return replace(device, uncertain=True)
    return device


def _labelled(records: list[Grasps], y: ArrayLike | None) -> list[Grasps]:
    """Return the records with ``y``, which runs through all of them, as their materials."""
    if y is None:
        return records
    labels: Labels = np.asarray(y).astype(str).ravel()
    ends = np.cumsum([part.sizes["grasp"] for part in records])
    if labels.size != ends[-1]:
        raise UserError(f"{labels.size} labels for {ends[-1]} grasps")
    return [
        part.assign(material=("grasp", grasp_labels(part, chunk)))
        for part, chunk in zip(records, np.split(labels, ends[:-1]))
    ]


def _ungrouped(grasps: Grasps) -> NDArray[np.int64]:
    """Return the rows that are no part of a group of touches."""
    return np.flatnonzero(label_values(grasps, "touch_group") == "")
