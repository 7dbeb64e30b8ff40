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

A calibration is of one gripper and its blocks.  For another one of the same kind its numbers are a guess, and
an answer that takes them as exact is far too confident: ``gripper="another"`` integrates over what such a
gripper may be (:mod:`thermogrip.sysid.effusivity.gripper_model`), and
:meth:`PosteriorClassifier.for_another_gripper` learns it from a few of its grasps of known blocks.

Nobody need say which: by default a record of three touches or more decides between the training's gripper
and blocks, other blocks of the same materials, and another gripper, with prior odds :math:`\pi_L` of 0.784,
0.196 and 0.02.  Its grasps j have one gripper and one set of blocks, so

.. math:: p(m | i) \propto \sum_L \pi_L Z_{i m L} \prod_{j \ne i} Z_{j L}, \qquad
          Z_{j L} = (1 - u) \frac{1}{M} \sum_m Z_{j m L} + u Z_{j, free},

u being the probability of a material that is no candidate, which shall not pass for another gripper.  Where
the training's own numbers explain a record, the answers are theirs.  Fewer touches, and touches of one block,
are taken for the training's, and so is any gripper where the calibration has a discrepancy, which is that one
device's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self

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
from thermogrip.datasets.materials import load_materials
from thermogrip.datasets.schema import has_touch_groups, label_values
from thermogrip.sysid.effusivity.data import Touches, Whitened, graded, touches
from thermogrip.sysid.effusivity.gripper_model import GripperModel, GripperSpread, another_gripper
from thermogrip.sysid.effusivity.laplace_approximation import fit_candidates, whitened
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

FINISHES = ("auto", "known", "unknown")
GRIPPERS = ("auto", "same", "uncertain", "another")
_OTHER_GRIPPER, _OTHER_BLOCKS = 0.02, 0.2  # prior probabilities, the latter given the training's gripper
_SEVERAL = 3  # single touches of a record, from which on it decides
_SURE = 0.99  # of the training's gripper and blocks, from which on no free effusivity is asked against others
_ASKED = 5  # grasps of a record about which another gripper is asked first
_HARDLY = 0.001  # of the odds of another gripper, below which no more grasps are asked
_NEEDED = 0.05  # of the odds of another gripper, below which its free effusivity is not asked for
_LIKELY = 0.9  # that a grasp is of another gripper or block, from which on its row says so


class _Level(NamedTuple):
    """One of the explanations that a record decides between."""

    prior: float
    device: GripperModel
    finish: str
    words: str  # for the row of a grasp that needs it


class _Decided(NamedTuple):
    """Log evidence of the candidates (n, m), log odds of all of them to a free effusivity (n,), and in words
    which grasps another gripper or block explains."""

    log_evidence: Floats
    odds: Floats
    words: list[str]


@dataclass(eq=False, repr=False)
class PosteriorClassifier(GraspClassifier):
    """Evidence of each material under the calibrated gripper (``"posterior"``).

    ``gripper`` is which one took the grasps: the ``same`` that was calibrated, its parameters taken as the
    file has them (as exact, unless that marks them uncertain); the same, but ``uncertain``: integrated over;
    ``another`` one of its kind; or ``auto``: the same or another, as each record decides.  ``device_`` is the
    calibrated one, ``coupling_`` (or None) how blocks move between touches, where groups of those taught it.
    """

    learns_from_all_conditions: ClassVar[bool] = True
    joins_touches: ClassVar[bool] = True
    leaves_samples_out: ClassVar[bool] = True
    reads_both_sensors: ClassVar[bool] = True

    # the test blocks are those of the training; "unknown": others of their materials; "auto": either
    finish: str = "auto"
    priors: dict[str, float] | None = None  # odds of the materials; equal by default
    prior_unknown: float = 0.1  # probability of a material that is not among the candidates
    device: GripperModel | None = None  # a calibration to start from: fitting is quicker
    random_state: int = 0  # of the calibration
    gripper: str = "auto"

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
            from thermogrip.sysid.effusivity.calibration import calibrate_gripper

            device = calibrate_gripper(record_list(known), prior=device, seed=self.random_state)
        other = copy(self)
        other.device_ = device
        return other

    def can_name(self, name: str) -> bool:
        """Return whether a material can be a candidate: also those of the table, on blocks never touched."""
        return super().can_name(name) or name in load_materials()

    def certain(self) -> PosteriorClassifier:
        """Return this classifier for the training's own gripper and blocks: no record decides otherwise."""
        own = copy(self)
        own.gripper, own.finish = "same", self.as_taught
        return own

    def _check_params(self) -> None:
        if self.finish not in FINISHES:
            raise UserError(f"finish is {self.finish!r}", hint=f"use one of {', '.join(FINISHES)}")
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
    ) -> tuple[Floats, Floats, list[str]]:
        """Return the log evidence of each candidate, (n_grasp, n_name), joint for touches of one block, and,
        where it is asked for, the posterior probability of a free effusivity beside them, at equal odds of
        these; and in words which grasps another gripper, block or loss to the room explains."""
        group = label_values(grasps, "touch_group")
        single = group == ""
        evidence, odds = np.empty((group.size, len(names))), np.full(group.size, np.nan)
        words = np.full(group.size, "", dtype=object)
        if single.any():
            data = touches(grasps, until=self.longest_, at=np.flatnonzero(single))
            found = self._decided(data, names, unknown)
            evidence[single], odds[single] = found.log_evidence, found.odds if unknown else np.nan
            words[single] = found.words
        if not single.all():
            fit = two_touch_fit(self.device_, grasps, names, coupling=self.coupling_, finish=self.as_taught)
            for at, row, loss, as_taught in zip(fit.rows, fit.log_evidence, fit.loss, fit.as_taught):
                evidence[at] = row
                if as_taught < 1 - _LIKELY:
                    words[at] = (
                        f"read as of a block that loses {loss:.2g} times as much as those of the training"
                    )
            groups = free_touch_fit(self.device_, grasps, coupling=self.coupling_) if unknown else {}
            for name, fits in groups.items():
                at = group == name
                odds[at] = logsumexp(evidence[at], axis=1) - np.log(len(names)) - fits[0].log_evidence
        return evidence, np.asarray(expit(logit(self.prior_unknown) - odds)), words.tolist()

    @property
    def as_taught(self) -> str:
        """``finish`` where only the training's gripper is asked about."""
        return "known" if self.finish == "auto" else self.finish

    def _levels(self, n: int) -> list[_Level]:
        """Return what a record of ``n`` single touches decides between, the training's own gripper and blocks
        first; a few touches that these do not explain are no evidence of others."""
        if self.device_.uncertain or n < _SEVERAL:
            return [_Level(1.0, self.device_, self.as_taught, "")]
        # what another gripper reads beyond the model, nobody knows
        other = _OTHER_GRIPPER if self.gripper == "auto" and self.device_.discrepancy is None else 0.0
        blocks = (1 - other) * _OTHER_BLOCKS if self.finish == "auto" else 0.0
        out = [_Level(1 - other - blocks, self.device_, self.as_taught, "")]
        if blocks:
            words = "read as another block of its material than those of the training"
            out.append(_Level(blocks, self.device_, "unknown", words))
        if other:
            words = "read as by another gripper than the training's: a labelled grasp of it helps (--known)"
            out.append(_Level(other, another_gripper(self.device_), self.as_taught, words))
        return out

    def _decided(self, data: Touches, names: Sequence[str], unknown: bool = False) -> _Decided:
        """Return what single touches of one record decide; the odds where a free effusivity is asked for."""
        levels, u = self._levels(data.level.size), np.log(self.prior_unknown)
        noise = whitened(self.device_, graded(data, self.device_.grades))
        own = np.array([level.device is self.device_ for level in levels])
        n_own = int(own.sum())
        each, modes = _of_levels(levels[:n_own], data, names, noise)
        if n_own < own.size and _unlikely(levels, data, names, each, modes[0]):
            levels, own = levels[:-1], own[:-1]
        elif n_own < own.size:
            each = np.concatenate([each, _of_levels(levels[-1:], data, names)[0]])
        prior = np.log([level.prior for level in levels])[:, None]
        known, free = logsumexp(each, axis=2) - np.log(len(names)), np.full(each.shape[:2], -np.inf)
        sure = _share(levels, each)[0] > _SURE
        if unknown or not sure:
            # the level and the candidate that explain each touch best
            best = np.concatenate(each[own], axis=1).argmax(axis=1)
            near = np.concatenate(modes, axis=1)[np.arange(best.size), best]
            free[own] = free_evidence(self.device_, data, near, noise=noise)
        explained = known if sure else np.logaddexp(np.log(1 - self.prior_unknown) + known, u + free)
        others = explained.sum(axis=1, keepdims=True) - explained
        weight = normalised((prior + others).T).T
        strange = logsumexp(weight + free, axis=0)
        share = np.exp(normalised(np.column_stack([(weight + known).T, u + strange])))
        words = [*(level.words for level in levels), ""]
        found = [words[int(row.argmax())] if row.max() > _LIKELY else "" for row in share]
        if unknown and not own.all() and (at := np.flatnonzero(share[:, -2] > _NEEDED)).size:
            free[-1, at] = free_evidence(levels[-1].device, data.take(at))
            strange = logsumexp(weight + free, axis=0)
        # a stranger is none of the training's blocks, whatever another block of a known material may be
        blocks = known[0] if self.finish != "unknown" else _mean_evidence(self.device_, data, names)
        weighed = np.where(own[:, None], blocks, known) + weight
        candidates = logsumexp(each + weight[:, :, None], axis=0)
        return _Decided(candidates, logsumexp(weighed, axis=0) - strange, found)

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
        log_p = [normalised(evidence + self.log_prior(names)) for evidence, _, _ in found]
        return np.vstack(log_p), np.concatenate([unknown for _, unknown, _ in found])

    def open_set_answer(self, grasps: Grasps, candidates: Sequence[str]) -> tuple[Floats, Floats, list[str]]:
        """Return :meth:`open_set_log_proba` and :meth:`beyond_training` of one record, from one evaluation of
        the evidence where all materials of the training are asked about."""
        names = self.asked(candidates)
        (part,) = self._records(grasps)
        few = part.sizes["grasp"] < _SEVERAL and not has_touch_groups(part)  # which decide nothing
        if set(names) != set(self.asked()) and not few:
            return super().open_set_answer(part, names)
        evidence, unknown, words = self._evidence(part, names, unknown=True)
        return normalised(evidence + self.log_prior(names)), unknown, self._beyond(part, words)

    def p_unknown(self, X: Records, candidates: Sequence[str] | None = None) -> Floats:
        names = self.asked() if candidates is None else [str(c) for c in candidates]
        return np.concatenate([self._evidence(part, names, unknown=True)[1] for part in self._records(X)])

    def beyond_training(self, grasps: Grasps) -> list[str]:
        """Return in words which grasps another gripper or other blocks explain, which blocks rested longer
        between touches or lose more than those of the training, and which sensor of two has no part."""
        return self._beyond(grasps, self._evidence(grasps, self.asked())[2])

    def _beyond(self, grasps: Grasps, words: Sequence[str]) -> list[str]:
        """Return what makes the answers overconfident: these ``words``, or what else there is to say."""
        known = (self.coupling_ or Coupling()).longest_rest
        rested = f"rested longer than the {known:g} s of the training: the answer may be too confident"
        trained, has = self.device_.second is not None, "t_surface_2" in grasps
        other = "" if trained == has else "the second sensor is not read: the training had one"
        if trained and not has:
            other = "answered by the first sensor alone: the record has no second one"
        notes = [rested if long else other for long in rested_long(grasps, self.coupling_)]
        return ["; ".join(filter(None, pair)) for pair in zip(words, notes)]

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


def _of_levels(
    levels: Sequence[_Level], data: Touches, names: Sequence[str], noise: Whitened | None = None,
    start: Floats | None = None,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Return the log evidence of each candidate for each touch on each level of one gripper, (n_level, n,
    n_name), and the nuisances there, (n_level, n, n_name, 7), from those of ``start`` on."""
    found, modes = list[Floats](), list[Floats]()
    for level in levels:
        # what the first level found is near what its gripper finds with another block
        begin = modes[0] if modes else start
        mode, *_ = fit_candidates(level.device, data, names, level.finish, start=begin, noise=noise)
        found.append(mode.log_evidence.reshape(-1, len(names)))
        modes.append(mode.u.reshape(*found[0].shape, -1))
    return np.stack(found), np.stack(modes)


def _unlikely(
    levels: Sequence[_Level], data: Touches, names: Sequence[str], own: Floats, modes: Floats
) -> bool:
    """Return whether some grasps, one after another, leave nothing of the last level, which takes longest to
    ask; ``own`` is the evidence of the others, ``modes`` are those of the first."""
    if data.level.size <= _ASKED:
        return False
    found, share = list[Floats](), 1.0
    asked = np.unique(np.linspace(0, data.level.size - 1, _ASKED).astype(int))
    # a grasp that moved the temperature far tells most of a gripper
    for i in asked[np.argsort(-data.excursion[asked], kind="stable")]:
        if share > _HARDLY:
            at = np.array([i])
            theirs = _of_levels(levels[-1:], data.take(at), names, start=modes[at])[0]
            found.append(np.concatenate([own[:, at], theirs]))
            share = float(_share(levels, np.concatenate(found, axis=1))[-1])
    return share < 1 - _SURE


def _share(levels: Sequence[_Level], each: Floats) -> Floats:
    """Return the probability of each level given all touches, (n_level,)."""
    total = np.log([level.prior for level in levels]) + logsumexp(each, axis=2).sum(axis=1)
    return np.asarray(np.exp(normalised(total[None])[0]))


def _mean_evidence(device: GripperModel, data: Touches, names: Sequence[str]) -> Floats:
    """Return the log evidence of the training's own blocks, the mean over candidates, (n,)."""
    evidence = fit_candidates(device, data, names, "known")[0].log_evidence
    return np.asarray(logsumexp(evidence.reshape(-1, len(names)), axis=1) - np.log(len(names)))


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
