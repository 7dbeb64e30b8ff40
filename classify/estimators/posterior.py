r"""Materials from the physics: the evidence of each candidate under the calibrated gripper.

:mod:`thermogrip.sysid.effusivity.posterior` integrates everything unknown about a grasp (contact
conductance, onset, object temperature, level) and gives :math:`\ln Z_m = \ln p(\text{trace} | m)` for each
candidate m.  With prior odds :math:`\pi_m` (equal by default)

.. math:: p(m | \text{trace}) = \frac{\pi_m Z_m}{\sum_k \pi_k Z_k}.

Fitting calibrates the gripper, which is one and the same in every condition: training grasps at all
temperatures describe it together, also those of materials that are no candidates.  Beside the known materials
is a free effusivity; its Bayes factor gives the probability that the grasp is of none of them.

Touches of one block (``touch_group``) are one question: their evidence is joint, since they share the block's
temperature (:mod:`thermogrip.sysid.effusivity.multi_touch`), and each of their rows has the common
answer.

A calibration is of one gripper.  For another one of the same kind its numbers are a guess, and an answer
that takes them as exact is far too confident: ``gripper="another"`` integrates over what such a gripper may
be (:mod:`thermogrip.sysid.effusivity.gripper_model`), and :meth:`PosteriorClassifier.for_another_gripper`
learns it from a few of its grasps of known blocks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit, logit, logsumexp

from thermogrip.classify.estimators.base import (
    Floats,
    GraspClassifier,
    Labels,
    Records,
    normalised,
    record_list,
    two_or_more,
)
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps, has_touch_groups, label_values
from thermogrip.sysid.effusivity.calibration import calibrate_gripper
from thermogrip.sysid.effusivity.data import Touches, touches
from thermogrip.sysid.effusivity.gripper_model import GripperModel, GripperSpread, another_gripper
from thermogrip.sysid.effusivity.laplace_approximation import fit_candidates
from thermogrip.sysid.effusivity.multi_touch import (
    Coupling,
    free_touch_fit,
    learn_coupling,
    rested_long,
    two_touch_fit,
)
from thermogrip.sysid.effusivity.posterior_grid import grid_posteriors
from thermogrip.sysid.effusivity.quality import longest_contact

GRIPPERS = ("same", "uncertain", "another")


@dataclass(eq=False, repr=False)
class PosteriorClassifier(GraspClassifier):
    """Evidence of each material under the calibrated gripper (``"posterior"``).

    ``gripper`` is which one took the grasps: the ``same`` that was calibrated, its parameters taken as the
    file has them (as exact, unless that marks them uncertain); the same, but ``uncertain``: integrated over;
    or ``another`` one of its kind.  ``device_`` is the calibrated one, ``coupling_`` (or None) how blocks
    move between touches, where groups of touches taught it.
    """

    learns_from_all_conditions: ClassVar[bool] = True
    reads_beginnings: ClassVar[bool] = True
    joins_touches: ClassVar[bool] = True
    leaves_samples_out: ClassVar[bool] = True

    finish: str = "known"  # the test blocks are those of the training; "unknown": others of their materials
    priors: dict[str, float] | None = None  # odds of the materials; equal by default
    prior_unknown: float = 0.1  # probability of a material that is not among the candidates
    device: GripperModel | None = None  # a calibration to start from: fitting is quicker
    random_state: int = 0  # of the calibration
    gripper: str = "same"

    def fit(
        self, X: Records, y: ArrayLike | None = None, *, progress: Callable[[float, str], None] | None = None
    ) -> Self:
        """Calibrate the gripper on labelled grasps of one or several conditions, which need not share a
        time axis; ``y`` (n_grasp,) are their materials, record after record, by default each record's
        own."""
        return self._taught(X, y, partial(self._learn, progress=progress))

    def _learn(
        self,
        records: list[Grasps],
        labels: list[Labels],
        progress: Callable[[float, str], None] | None = None,
    ) -> None:
        self._check_params()
        where = "+".join(str(part.attrs.get("name")) for part in records)
        self.classes_ = two_or_more(np.concatenate(labels), where)
        records = [part.assign(material=("grasp", own)) for part, own in zip(records, labels)]
        device = calibrate_gripper(records, start=self.device, seed=self.random_state, progress=progress)
        self.notes_ = [f"{m}: not in the materials table, learnt from its grasps" for m in device.unlisted]
        self.longest_ = longest_contact(records)
        self.coupling_: Coupling | None = None
        for part in records:
            if has_touch_groups(part):
                self.coupling_ = learn_coupling(device, part, start=self.coupling_)
        self.device_ = _uncertain_as(device, self.gripper)

    def with_device(self, device: GripperModel, coupling: Coupling | None = None) -> Self:
        """Take up a calibration in place of fitting one; the classes are its materials."""
        self._check_params()
        self.classes_ = np.asarray(sorted(device.materials))
        self.device_, self.coupling_ = _uncertain_as(device, self.gripper), coupling
        return self

    def for_another_gripper(
        self, known: Records | None = None, *, spread: GripperSpread | None = None
    ) -> PosteriorClassifier:
        """Return this classifier for another gripper of the same kind, ``spread`` from it as their making
        allows by default.

        Of ``known``, grasps of the other gripper whose material is known, one helps most, three to ten of two
        materials reach nearly all.  Without them answers are as uncertain as grippers differ.
        """
        self._check_fitted()
        device = another_gripper(self.device_, spread)
        if known is not None:
            device = calibrate_gripper(record_list(known), prior=device, seed=self.random_state)
        other = copy(self)
        other.device_ = device
        return other

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
        names = self.asked()
        return np.asarray(self._evidence(grasps, names)[0] + self.log_prior(names))

    def _evidence(
        self, grasps: Grasps, names: Sequence[str], *, unknown: bool = False
    ) -> tuple[Floats, Floats]:
        """Return the log evidence of each candidate, (n_grasp, n_name), joint for touches of one block, and,
        where it is asked for, the posterior probability of a free effusivity beside them, at equal odds of
        these."""
        group = label_values(grasps, "touch_group")
        single = group == ""
        evidence, free, other = np.empty((group.size, len(names))), np.full(group.size, np.nan), None
        if single.any():
            data = touches(grasps, until=self.longest_, at=np.flatnonzero(single))
            evidence[single] = _of_candidates(self.device_, data, names, self.finish)
            if unknown:
                free[single] = [fit.log_evidence for fit in grid_posteriors(self.device_, data)]
                if self.finish != "known":  # a free effusivity has the conductance of the training's blocks
                    other = _of_candidates(self.device_, data, names, "known")
        if not single.all():
            fit = two_touch_fit(self.device_, grasps, names, coupling=self.coupling_, finish=self.finish)
            for at, row in zip(fit.rows, fit.log_evidence):
                evidence[at] = row
            groups = free_touch_fit(self.device_, grasps, coupling=self.coupling_) if unknown else {}
            for name, fits in groups.items():
                free[group == name] = fits[0].log_evidence
        known = evidence.copy()
        if other is not None:
            known[single] = other
        odds = logsumexp(known, axis=1) - np.log(len(names)) - free
        return evidence, np.asarray(expit(logit(self.prior_unknown) - odds))

    def log_prior(self, names: Sequence[str]) -> Floats:
        """Return the log prior odds of some materials, (n_name,)."""
        return np.log([(self.priors or {}).get(name, 1.0) for name in names])

    def candidate_log_proba(self, X: Records, candidates: Sequence[str]) -> Floats:
        """Return log probabilities over a subset of ``classes_``: only their evidence is computed."""
        names = self.asked(candidates)
        prior = self.log_prior(names)
        return np.vstack([normalised(self._evidence(part, names)[0] + prior) for part in self._records(X)])

    def open_set_log_proba(self, X: Records, candidates: Sequence[str]) -> tuple[Floats, Floats]:
        """Return :meth:`candidate_log_proba` and :meth:`p_unknown` from one evaluation of the evidence."""
        names = self.asked(candidates)
        found = [self._evidence(part, names, unknown=True) for part in self._records(X)]
        log_p = [normalised(evidence + self.log_prior(names)) for evidence, _ in found]
        return np.vstack(log_p), np.concatenate([unknown for _, unknown in found])

    def p_unknown(self, X: Records, candidates: Sequence[str] | None = None) -> Floats:
        names = self.asked() if candidates is None else [str(c) for c in candidates]
        return np.concatenate([self._evidence(part, names, unknown=True)[1] for part in self._records(X)])

    def beyond_training(self, grasps: Grasps) -> list[str]:
        """Return in words which blocks rested longer between touches than those of the training."""
        known = (self.coupling_ or Coupling()).longest_rest
        words = f"rested longer than the {known:g} s of the training: the answer may be too confident"
        notes = [words if long else "" for long in rested_long(grasps, self.coupling_)]
        if self.device_.second is not None and "t_surface_2" in grasps:
            joint = label_values(grasps, "touch_group") != ""
            one = "of touches of one block the second sensor is not read"
            notes = [word or (one if group else "") for word, group in zip(notes, joint)]
        return notes

    def get_state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Return how long contacts of the training lasted; the device has a file of its own."""
        return {"longest_contact_s": self.longest_ if np.isfinite(self.longest_) else None}, {}

    def set_state(self, numbers: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
        """Take up what :meth:`get_state` returned; earlier files lack the length of contacts."""
        longest = numbers.get("longest_contact_s")
        self.longest_ = np.inf if longest is None else float(longest)
        if not self.longest_ > 0:
            raise ValueError(f"longest_contact_s {longest}")  # the reader adds the file

    def save_parts(self, folder: Path) -> None:
        self.device_.save(folder / "device.json")
        if self.coupling_ is not None:
            self.coupling_.save(folder / "coupling.json")

    def load_parts(self, folder: Path) -> None:
        self._check_params()
        self.device_ = GripperModel.load(folder / "device.json")
        file = folder / "coupling.json"
        self.coupling_ = Coupling.load(file) if file.exists() else None


def _of_candidates(device: GripperModel, data: Touches, names: Sequence[str], finish: str) -> Floats:
    """Return the log evidence of each candidate for each touch, (n, n_name)."""
    return fit_candidates(device, data, names, finish)[0].log_evidence.reshape(-1, len(names))


def _uncertain_as(device: GripperModel, gripper: str) -> GripperModel:
    """Return a calibrated gripper with the parameter uncertainty that the question requires."""
    if gripper == "another":
        return another_gripper(device)
    if gripper == "uncertain":
        if device.uncertainty is None:
            raise UserError(
                "the calibration has no parameter covariance of the gripper", hint="calibrate again"
            )
        return replace(device, uncertain=True)
    return device
