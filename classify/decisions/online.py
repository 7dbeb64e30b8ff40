"""One contact, sample by sample: probabilities that follow the readings, and the moment they suffice.

A :class:`Stream` holds what a robot loop needs during one contact.  Each sample costs milliseconds, since
every candidate's mode starts from the one of the sample before; :meth:`Stream.result` gives the same answer
as the batch call on the finished grasp.

What a robot sends is not always a contact.  A reading that leaps by 10 K waits for the next three, which show
whether it was a spike; a skin that does not move, or has just saturated, ends no contact; and once a skin
has not moved for three seconds, 10 K from its object, the probabilities are NaN, as no material is there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from thermogrip.classify.decisions.next_touch import expected_information, with_model
from thermogrip.classify.decisions.stopping_rule import StopRule, load_stop_rule
from thermogrip.classify.estimators.base import Floats, GraspClassifier, normalised
from thermogrip.classify.estimators.registry import load_classifier
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import HOTTEST, Grasps, make_grasps
from thermogrip.sysid.effusivity.posterior import material_fit
from thermogrip.sysid.effusivity.predictive import rest_of_contact
from thermogrip.sysid.effusivity.quality import GraspQuality, check_grasps

_CONTACT = 0.25  # s after the closed message: before it there is no contact
_SAME = 1e-6  # s


class Stream:
    """Probabilities of the candidates during one contact.

    Parameters
    ----------
    classifier : PosteriorClassifier
        A fitted one, e.g. from :func:`~thermogrip.classify.estimators.registry.load_classifier`; load it
        once.
    candidates : sequence of str, optional
        The materials in question; by default all that the classifier knows.
    t_object, t_object_sd, t_ambient : float, optional
        What is known of the block and the room [degC]; NaN where unknown.
    rule : StopRule, optional
        When to end the contact.

    Attributes
    ----------
    decided_at : float or None
        When the rule ended the contact [s]; None until then.

    Examples
    --------
    >>> from thermogrip.classify.estimators.posterior import PosteriorClassifier
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
    >>> known = PosteriorClassifier().with_device(load_default_gripper())
    >>> grasp = load_example_grasps()["exp2_dT20"].isel(grasp=[21])
    >>> touch = Stream(known, candidates=["copper", "iron", "wood"], t_object=28.0, t_ambient=27.0)
    >>> for time, temperature in zip(grasp["time"].values[:40], grasp["t_surface"].values[0]):
    ...     p = touch.update(float(time), float(temperature))
    >>> {name: round(float(v), 3) for name, v in p.items()}
    {'copper': 0.0, 'iron': 0.0, 'wood': 1.0}
    """

    def __init__(
        self,
        classifier: GraspClassifier,
        *,
        candidates: Sequence[str] | None = None,
        t_object: float = np.nan,
        t_object_sd: float = np.nan,
        t_ambient: float = np.nan,
        rule: StopRule | None = None,
    ) -> None:
        self._model = with_model(classifier)
        self.candidates = tuple(self._model.asked(candidates))
        self._odds = self._model.log_prior(self.candidates)
        self._about = {"t_object": t_object, "t_object_sd": t_object_sd, "t_ambient": t_ambient}
        self._rule = rule
        self._time: list[float] = []
        self._reading: list[float] = []
        self._u: Floats | None = None
        self._evaluated = 0
        self.decided_at: float | None = None
        self.log_p: Floats = normalised(self._odds[None])[0]
        self._warm()

    def update(self, time_s: float, t_surface: float) -> dict[str, float]:
        """Take one sample and return the probability of each candidate.

        ``time_s`` [s] since the closed message grows from call to call, from -1 s or before; ``t_surface``
        [degC] is NaN where it was lost.  Probabilities are the prior ones until a quarter of a second after
        the message, NaN for a contact that is not usable (:attr:`nothing_because`), and stay as they are once
        it lasts longer than those of the training.

        Time that does not grow, a reading that is not in degC, or a contact without a reading before it is a
        :class:`UserError`.  That sample is not taken, the next one may follow.
        """
        if not np.isfinite(time_s) or (self._time and not time_s > self._time[-1]):
            after = f" after {self._time[-1]:g} s" if self._time else ""
            raise UserError(f"time {time_s:g} s{after}", hint="give samples in order, each once")
        if abs(t_surface) > HOTTEST:
            raise UserError(f"a reading of {t_surface:g} degC", hint="give degC, and NaN where one was lost")
        if time_s > _CONTACT and not self._has_level():
            raise UserError(f"no reading before contact, and now it is {time_s:g} s", hint="start at -1 s")
        self._time.append(float(time_s))
        self._reading.append(float(t_surface))
        if _CONTACT < time_s <= self._model.longest_ + _SAME and np.isfinite(t_surface):
            self._evaluate()
        return self._answer(self.log_p)

    @property
    def nothing_because(self) -> str:
        """Why the contact is not usable, empty where it is."""
        read = len(self._time) > 1 and np.isfinite(self._reading).any()
        return check_grasps(self.grasps()).reason[0] if read else ""

    def grasps(self) -> Grasps:
        """Return the contact so far as a record of one grasp."""
        about = {name: [value] for name, value in self._about.items()}
        return make_grasps(self._time, [self._reading], ["stream"], name="stream", **about)

    def result(self) -> dict[str, float]:
        """Return the probabilities by the batch call on the contact so far, NaN where it is not usable."""
        if self.nothing_because:
            return dict.fromkeys(self.candidates, np.nan)
        return self._answer(self._model.candidate_log_proba(self.grasps(), self.candidates)[0])

    def _answer(self, log_p: Floats) -> dict[str, float]:
        return dict(zip(self.candidates, np.exp(log_p).tolist()))

    def _has_level(self) -> bool:
        return any(t < -_CONTACT and np.isfinite(y) for t, y in zip(self._time, self._reading))

    def _warm(self) -> None:
        """Look at a made-up contact once, so that no sample waits for the compiler."""
        made_up = make_grasps([-1.0, -0.5, 0.5], [[23.0, 23.0, 23.0]], ["warm"])
        material_fit(self._model.device_, made_up, self.candidates[:1], finish=self._model.finish)

    def _evaluate(self) -> None:
        """Take what was read so far for what it is."""
        grasp = self.grasps()
        quality = check_grasps(grasp)
        if quality.spiked[0, -1]:  # the next readings show whether it was a spike
            return
        if quality.reason[0]:
            self.log_p = np.full(len(self.candidates), np.nan)
            return
        seen = material_fit(
            self._model.device_, grasp, self.candidates, finish=self._model.finish, start=self._u
        )
        self._u = seen.u
        self.log_p = normalised(seen.log_evidence + self._odds)[0]
        self._decide(grasp, quality)

    def _decide(self, grasp: Grasps, quality: GraspQuality) -> None:
        """Ask the rule, at its own times only."""
        rule, now = self._rule, self._time[-1]
        if rule is None or self.decided_at is not None:
            return
        due = sum(t <= now + _SAME for t in rule.times)
        if due <= self._evaluated:
            return
        self._evaluated = due
        if quality.undecided[0]:
            return
        if np.exp(self.log_p.max()) >= rule.sure or self._gain(grasp, rule) < rule.gain:
            self.decided_at = now

    def _gain(self, grasp: Grasps, rule: StopRule) -> float:
        if rule.gain <= 0:
            return np.inf
        ahead = rest_of_contact(
            self._model.device_, grasp, self.candidates,
            until=self._time[-1], end=rule.end, finish=self._model.finish, start=self._u,
        )  # fmt: skip
        return float(expected_information(ahead._replace(log_p=self.log_p[None])).gain[0])


def stop_callback(
    classifier: GraspClassifier, rule: StopRule, *, candidates: Sequence[str] | None = None
) -> Callable[[Grasps], bool]:
    """Return a function of the one grasp so far that returns whether the rule ends the contact.

    A session calls it after each sample (``stop`` of :func:`thermogrip.rig.session.session.run_session`) and
    knows nothing else of classifiers.  It uses the record's ``t_object`` and ``t_ambient``, never its
    ``material``.
    """
    stream: Stream | None = None

    def stop(grasp: Grasps) -> bool:
        nonlocal stream
        time, reading = grasp["time"].values, grasp["t_surface"].values[0]
        if stream is None:
            known = {
                name: float(grasp[name].values[0]) for name in ("t_object", "t_object_sd", "t_ambient")
                if name in grasp
            }  # fmt: skip
            stream = Stream(classifier, candidates=candidates, rule=rule, **known)
        for at in range(len(stream._time), time.size):
            stream.update(float(time[at]), float(reading[at]))
        return stream.decided_at is not None

    return stop


def session_stop(folder: str | Path, *, candidates: Sequence[str] | None = None) -> Callable[[Grasps], bool]:
    """Return :func:`stop_callback` of the classifier and the stop rule in a folder of ``train``."""
    return stop_callback(load_classifier(folder), load_stop_rule(folder), candidates=candidates)
