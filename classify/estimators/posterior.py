r"""Materials from the physics: the evidence of each candidate under the calibrated gripper.

:mod:`thermogrip.sysid.effusivity.posterior` integrates everything unknown about a grasp (contact
conductance, onset, object temperature, level) and gives :math:`\ln Z_m = \ln p(\text{trace} | m)` for each
candidate m.  With prior odds :math:`\pi_m` (equal by default)

.. math:: p(m | \text{trace}) = \frac{\pi_m Z_m}{\sum_k \pi_k Z_k}.

Beside the known materials is a free effusivity; its Bayes factor gives the probability that the grasp is of
none of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit, logit

from thermogrip.classify.estimators.base import (
    Answered,
    Floats,
    GraspClassifier,
    Labels,
    Note,
    Records,
    normalised,
    record_list,
    two_or_more,
)
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import has_touch_groups, label_values
from thermogrip.sysid.contact.materials import load_materials
from thermogrip.sysid.effusivity.data import Touches, graded, touches, whiten
from thermogrip.sysid.effusivity.gripper_model import GripperModel, another_gripper
from thermogrip.sysid.effusivity.laplace_approximation import (
    BUILD_UP,
    EFFUSIVITY,
    ONSET,
    T_OBJECT,
    Fitted,
    H,
    fit_candidates,
    unexplained,
)
from thermogrip.sysid.effusivity.multi_touch import (
    Coupling,
    free_touch_fit,
    learn_coupling,
    rested_long,
    two_touch_fit,
)
from thermogrip.sysid.effusivity.posterior_grid import free_evidence
from thermogrip.sysid.effusivity.quality import longest_contact

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Grasps

_UNUSUAL = 2.5  # standard deviations of a nuisance: less is usual, one grasp in eighty
_LIKELY = 0.9  # that a grasp, or a block's loss, is unlike those of the training: then its row says so


@dataclass(eq=False, repr=False)
class PosteriorClassifier(GraspClassifier):
    """Evidence of each material under the calibrated gripper (``"posterior"``).

    ``device_`` is the calibrated gripper, ``coupling_`` (or None) how blocks move between touches, where
    groups of those taught it.
    """

    learns_from_all_conditions: ClassVar[bool] = True
    joins_touches: ClassVar[bool] = True
    leaves_samples_out: ClassVar[bool] = True
    reads_both_sensors: ClassVar[bool] = True

    priors: dict[str, float] | None = None  # odds of the materials; equal by default
    prior_unknown: float = 0.1  # probability of a material that is not among the candidates
    device: GripperModel | None = None  # a calibration to start from: fitting is quicker
    random_state: int = 0  # of the calibration

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
        from thermogrip.sysid.effusivity.calibration import calibrate_gripper

        self._check_params()
        where = "+".join(str(record.attrs.get("name")) for record in records)
        self.classes_ = two_or_more(np.concatenate(labels), where)
        records = [record.assign(material=("grasp", materials)) for record, materials in zip(records, labels)]
        # the gripper is one and the same in every condition: training grasps at all temperatures describe it
        # together, also those of materials that are no candidates
        device = calibrate_gripper(records, start=self.device, seed=self.random_state, progress=progress)
        self.notes_ = [f"{m}: not in the materials table, learnt from its grasps" for m in device.unlisted]
        self.longest_ = longest_contact(records)
        self.coupling_: Coupling | None = None
        for record in records:
            if has_touch_groups(record):
                self.coupling_ = learn_coupling(device, record, start=self.coupling_)
        self.device_ = device

    def with_device(self, device: GripperModel, coupling: Coupling | None = None) -> Self:
        """Take up a calibration in place of fitting one; the classes are its materials."""
        self._check_params()
        self.classes_ = np.asarray(sorted(device.materials))
        self.device_, self.coupling_ = device, coupling
        return self

    def for_another_gripper(self, known: Records) -> PosteriorClassifier:
        """Return this classifier for another gripper of the same kind, of whose grasps some are ``known``,
        their material stated: one helps most, three to ten of two materials reach nearly all."""
        from thermogrip.sysid.effusivity.calibration import calibrate_gripper

        self._check_fitted()
        # what other blocks of the same materials, or another gripper of its kind, read beyond a calibration
        # is one of the ways in which a grasp may be unlike those of the training, and answered less surely
        prior = another_gripper(self.device_)
        other = copy(self)
        other.device_ = calibrate_gripper(record_list(known), prior=prior, seed=self.random_state)
        return other

    def can_name(self, name: str) -> bool:
        """Return whether a material can be a candidate: also those of the table, on blocks never touched."""
        return super().can_name(name) or name in load_materials()

    def _check_params(self) -> None:
        if not 0 < self.prior_unknown < 1:
            raise UserError(
                f"prior_unknown is {self.prior_unknown}", hint="use a probability between 0 and 1"
            )
        if self.priors is not None and not all(p > 0 for p in self.priors.values()):
            raise UserError("a prior is not positive", hint="leave a material out of the candidates instead")

    def _log_proba(self, grasps: Grasps) -> Floats:
        return self._answered(grasps, self.asked(), unknown=False).log_p

    def candidate_log_proba(self, X: Records, candidates: Sequence[str]) -> Floats:
        """Return log probabilities of the candidates alone, (n_grasp, n_candidate)."""
        names = self.asked(candidates)
        return np.vstack([self._answered(record, names, unknown=False).log_p for record in self._records(X)])

    def _answered(self, grasps: Grasps, names: list[str], *, unknown: bool = True) -> Answered:
        """Return the answers of one record; p_unknown, which takes longest, only where it is asked for."""
        group = label_values(grasps, "touch_group")
        answered = Answered.nothing(group.size, len(names))
        single = np.flatnonzero(group == "")
        evidence, odds = np.empty((group.size, len(names))), np.full(group.size, np.nan)
        if single.size:
            data = touches(grasps, until=self.longest_, at=single)
            noise = whiten(graded(data, self.device_.grades), self.device_.reading_noise)
            fitted = fit_candidates(self.device_, data, names, noise=noise)
            evidence[single] = fitted.mode.log_evidence.reshape(-1, len(names))
            best = np.arange(single.size) * len(names) + evidence[single].argmax(axis=1)
            if unknown:
                free = free_evidence(self.device_, data, fitted.mode.u[best], noise)
                odds[single] = np.logaddexp.reduce(fitted.sure, axis=1) - np.log(len(names)) - free
                self._explain(answered, single, data, names, fitted, best)
        # touches of one block are one question: they share its temperature
        if single.size < group.size:
            self._touched(answered, grasps, names, evidence, odds, unknown=unknown)
        if unknown:
            self._warn_of_training(answered, grasps)
        log_p = normalised(evidence + self.log_prior(names))
        return answered._replace(log_p=log_p, p_unknown=expit(logit(self.prior_unknown) - odds))

    def _explain(
        self,
        found: Answered,
        at: NDArray[np.int64],
        data: Touches,
        names: list[str],
        fitted: Fitted,
        best: NDArray[np.int64],
    ) -> None:
        """Add to the answers what the likeliest candidate does not explain of single touches, and what it
        requires that is unusual; ``best`` is its row of ``fitted``."""
        mode, prior = fitted.plain.take(best), fitted.plain_prior.take(best)
        misfits = unexplained(data, fitted.row[best], mode, prior)
        for k, (i, (misfit, words)) in enumerate(zip(at.tolist(), misfits)):
            found.misfit_sd[i], name = misfit, names[int(best[k]) % len(names)]
            found.deviates[i] = deviation_words(name, mode.u[k] - prior.mean[k], prior.sd[k], misfit)
            if words:
                found.notes[i].append(Note("not_explained", words))
            elif fitted.unlike[k] > _LIKELY:
                off = float(fitted.mode.u[best[k], T_OBJECT] - prior.mean[k, T_OBJECT])
                words = "unlike the grasps of the training"
                if _UNUSUAL * prior.sd[k, T_OBJECT] < abs(off):  # of which a misstated temperature is one
                    words = f"as {name} its object is {_warmer(off)} than stated"
                found.notes[i].append(Note("beyond_training", f"{words}: answered less surely"))

    def _touched(
        self, found: Answered, grasps: Grasps, names: list[str], evidence: Floats, odds: Floats, *,
        unknown: bool,
    ) -> None:  # fmt: skip
        """Fill evidence (n, m) and odds (n,) of touches of one block, and add what there is to say of it."""
        fit = two_touch_fit(self.device_, grasps, names, coupling=self.coupling_)
        groups = free_touch_fit(self.device_, grasps, coupling=self.coupling_) if unknown else {}
        for k, rows in enumerate(fit.rows):
            evidence[rows] = fit.log_evidence[k]
            if unknown:
                free = groups[fit.groups[k]][0].log_evidence
                odds[rows] = np.logaddexp.reduce(fit.log_evidence[k]) - np.log(len(names)) - free

    def _warn_of_training(self, found: Answered, grasps: Grasps) -> None:
        """Add to the answers what of a record the training did not have."""
        taught_rest = (self.coupling_ or Coupling()).longest_rest
        rested = f"rested longer than the {taught_rest:g} s of the training: the answer may be too confident"
        for i in np.flatnonzero(rested_long(grasps, self.coupling_)).tolist():
            found.notes[i].append(Note("beyond_training", rested))
        trained, has = self.device_.second is not None, "t_surface_2" in grasps
        if trained != has:
            words = "the second sensor is not read: the training had one"
            if trained:
                words = "answered by the first sensor alone: the record has no second one"
            for notes in found.notes:
                notes.append(Note("beyond_training", words))

    def log_prior(self, names: Sequence[str]) -> Floats:
        """Return the log prior odds of some materials, (n_name,)."""
        return np.log([(self.priors or {}).get(name, 1.0) for name in names])

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


def _warmer(off: float) -> str:
    return f"{abs(off):.1f} K {'warmer' if off > 0 else 'colder'}"


def deviation_words(material: str, off: Floats, sd: Floats, misfit: float) -> str:
    """Return in words which unusual values of nuisances (7,) a material requires, ``off`` by so much of a
    mean that is known to ``sd``, or which ``misfit`` [standard deviations]; empty where nothing is
    unusual."""
    # they show what to check: a block that was not at its nominal temperature, a contact that closed badly,
    # or a trace that no such block gives
    late = "late" if off[ONSET] > 0 else "early"
    words = {
        H: f"{np.exp(off[H]):.2f} times the usual contact conductance",
        BUILD_UP: f"a contact that builds up in {np.exp(off[BUILD_UP]):.2f} times the usual time",
        ONSET: f"a contact {abs(off[ONSET]):.2f} s {late}",
        EFFUSIVITY: f"{np.exp(off[EFFUSIVITY]):.2f} times its block's effusivity",
        T_OBJECT: f"its block {_warmer(off[T_OBJECT])} than its nominal temperature",
    }
    deviations = [(float(abs(off[k]) / sd[k]), text) for k, text in words.items() if sd[k] > 0]
    deviations.append((misfit, "a trace that is not its own"))
    unusual = [
        f"{text} ({deviation:.1f} sd)"
        for deviation, text in sorted(deviations, reverse=True)
        if deviation > _UNUSUAL
    ][:2]
    return f"as {material} it needs {' and '.join(unusual)}" if unusual else ""
