r"""Decisions: name the material or say "unknown"; touch again, and at which temperature.

**Open set.**  With :math:`p_u` the probability that the object is none of the candidates, naming the
likeliest one m is wrong with probability :math:`p_u + (1 - p_u)(1 - p_m)`, "unknown" with probability
:math:`1 - p_u`.  What each mistake costs is the user's to say (:class:`Costs`), and the answer is the cheaper
one.  Chow's rule is the case without unknown materials: answer only where :math:`1 - p_m` is below the cost
of not answering.

**Another touch.**  The gripper chooses its temperature, so it can ask the question that tells most.  For each
temperature the outlook of the next touch gives the expected information and the expected accuracy
(:mod:`thermogrip.classify.decisions.expected_information`); reaching the temperature, resting and touching
take seconds, which have a price.  A touch is worth it where

.. math:: V \, (A_{after} - A_{now}) > c \, (t_{reach} + t_{rest} + t_{touch}),

V being what a right answer is worth (1 here) and c the price of a second.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import logsumexp

from thermogrip.classify.decisions.expected_information import entropy, expected_information
from thermogrip.classify.estimators.base import Floats, GraspClassifier, Labels, pick
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps, unit_names
from thermogrip.sysid.effusivity.quality import check_grasps

if TYPE_CHECKING:
    from thermogrip.classify.estimators.posterior import PosteriorClassifier

__all__ = ["UNKNOWN", "Costs", "NextTouch", "advise_touches", "at_rates", "choose_next_touch"]
__all__ += ["name_or_unknown", "with_model"]

UNKNOWN = "unknown"
TEMPERATURES = tuple(np.arange(12.5, 50.1, 2.5).tolist())


@dataclass(frozen=True, kw_only=True)
class Costs:
    """What mistakes cost, a wrong name of a known material being 1.

    Parameters
    ----------
    rejected : float
        To say "unknown" of a known material.
    missed : float
        To name a material that is none of the candidates.
    """

    rejected: float = 0.5
    missed: float = 1.0

    def __post_init__(self) -> None:
        if not (self.rejected > 0 and self.missed > 0):
            raise UserError("a cost is not positive", hint="give what a mistake costs, a wrong name being 1")


def name_or_unknown(
    p: ArrayLike, p_unknown: ArrayLike, names: Sequence[str], *, costs: Costs | None = None
) -> Labels:
    """Return the cheaper answer for each grasp: its likeliest material, or ``"unknown"``.

    Parameters
    ----------
    p : (n, m) array_like
        Probabilities of the candidates, given that it is one of them; rows sum to 1.  A row of NaN, a grasp
        that has no answer, is "unknown".
    p_unknown : (n,) array_like
        Probability that it is none of them.
    names : sequence of str
        The m candidates.
    costs : Costs, optional

    Returns
    -------
    answer : (n,) ndarray of str

    Raises
    ------
    UserError
        If a probability is missing: the classifier has no model of other materials.

    Examples
    --------
    >>> name_or_unknown([[0.9, 0.1], [0.9, 0.1]], [0.05, 0.8], ["iron", "wood"]).tolist()
    ['iron', 'unknown']
    """
    used = costs or Costs()
    inside, outside = np.asarray(p, dtype=float), np.asarray(p_unknown, dtype=float)
    named = np.isfinite(inside).all(axis=1)
    if not np.isfinite(outside[named]).all():
        raise UserError("p_unknown is missing", hint="use the classifier 'posterior'")
    inside, outside = np.where(named[:, None], inside, 1.0), np.where(named, outside, 1.0)
    best = inside.argmax(axis=1)
    wrong = used.missed * outside + (1 - outside) * (1 - inside.max(axis=1))
    return np.where(used.rejected * (1 - outside) < wrong, UNKNOWN, np.asarray(list(names))[best])


@dataclass(frozen=True)
class NextTouch:
    """Whether to touch again, and at which gripper temperature.

    Attributes
    ----------
    t_gripper : (n,) ndarray
        Temperatures that were weighed [degC].
    information : (n,) ndarray
        Expected information of a touch at each [nat].
    accuracy : (n,) ndarray
        Expected accuracy after it.
    seconds : (n,) ndarray
        What it takes: reaching the temperature, resting, touching.
    value : (n,) ndarray
        Gain of accuracy less the price of the seconds.
    entropy, accuracy_now : float
        Before it [nat], [1].
    """

    t_gripper: Floats
    information: Floats
    accuracy: Floats
    seconds: Floats
    value: Floats
    entropy: float
    accuracy_now: float

    @property
    def best(self) -> float:
        """Return the temperature of the highest value, of the most information where values tie [degC]."""
        top = np.flatnonzero(self.value >= self.value.max() - 1e-12)
        return float(self.t_gripper[top[self.information[top].argmax()]])

    @property
    def worth_it(self) -> bool:
        """Return whether some touch gains more than its seconds cost."""
        return bool(self.value.max() > 0)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-able description."""
        table = {name: getattr(self, name).tolist() for name in ("t_gripper", "information", "accuracy")}
        table |= {"seconds": self.seconds.tolist(), "value": self.value.tolist()}
        now = {"entropy": self.entropy, "accuracy_now": self.accuracy_now}
        return table | now | {"best": self.best, "worth_it": self.worth_it}


def choose_next_touch(
    classifier: GraspClassifier,
    grasps: Grasps,
    *,
    candidates: Sequence[str] | None = None,
    t_gripper: ArrayLike = TEMPERATURES,
    seconds: Callable[[float], float] | None = None,
    price: float = 0.001,
    rest: float = 60.0,
    end: float = 10.0,
    draws: int = 48,
    seed: int = 0,
) -> NextTouch:
    """Return what a further touch of the block is expected to tell at each gripper temperature.

    Parameters
    ----------
    classifier : PosteriorClassifier
        A fitted one; others have no model of what they would read.
    grasps : Grasps
        The touches of one block so far.
    candidates : sequence of str, optional
        The materials in question; by default all that the classifier knows.
    t_gripper : (n,) array_like, optional
        Temperatures to weigh [degC].
    seconds : callable, optional
        Time to bring the gripper to a temperature [s], of
        :func:`~thermogrip.classify.decisions.reach.by_plant` or
        :func:`at_rates`; by default it is done within the rest.
    price : float, optional
        Of a second, in units of a right answer.
    rest, end : float, optional
        Least time between the touches, and how long the next one lasts [s].
    draws, seed : int, optional
        Of the simulated readings.

    Raises
    ------
    UserError
        If the classifier is another, the grasps are of several blocks, or a price or temperature is no
        number.

    Examples
    --------
    >>> from thermogrip.classify.estimators.posterior import PosteriorClassifier
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
    >>> known = PosteriorClassifier().with_device(load_default_gripper())
    >>> copper = load_example_grasps()["exp5_two_touch_unknown_object"].isel(grasp=[24])
    >>> choice = choose_next_touch(known, copper, t_gripper=[20.0, 30.0, 40.0])
    >>> choice.worth_it, choice.best, bool(choice.accuracy_now < choice.accuracy.max())
    (True, 20.0, True)
    """
    from thermogrip.sysid.effusivity.predictive import next_touch

    model = with_model(classifier)
    levels = np.atleast_1d(np.asarray(t_gripper, dtype=float))
    if not (np.isfinite(levels).all() and levels.size and np.isfinite(price) and price >= 0):
        raise UserError("a temperature or the price is no number", hint="give degC, and a price of 0 or more")
    names = [str(c) for c in (model.classes_ if candidates is None else candidates)]
    model._check_candidates(names)
    outlook = next_touch(
        model.device_, grasps, names, levels,
        coupling=model.coupling_, rest=rest, end=end, finish=model.finish,
    )  # fmt: skip
    log_p = outlook.log_p + model.log_prior(names)
    outlook = outlook._replace(log_p=log_p - logsumexp(log_p, axis=1, keepdims=True))
    found = expected_information(outlook, draws=draws, seed=seed)
    reach = np.array([0.0 if seconds is None else float(seconds(float(t))) for t in levels])
    whole = np.maximum(reach, rest) + end
    return NextTouch(
        t_gripper=levels,
        information=found.information,
        accuracy=found.accuracy,
        seconds=whole,
        value=found.gain - price * whole,
        entropy=float(entropy(outlook.log_p[0])),
        accuracy_now=float(np.exp(outlook.log_p[0].max())),
    )


def advise_touches(
    classifier: GraspClassifier,
    grasps: Grasps,
    *,
    candidates: Sequence[str] | None = None,
    price: float = 0.001,
    progress: Callable[[float, str], None] | None = None,
) -> list[dict[str, float | None]]:
    """Return what another touch of each grasp's block would bring, a row a grasp.

    Parameters
    ----------
    classifier, candidates, price
        As in :func:`choose_next_touch`.
    grasps : Grasps
        Rows that share ``touch_group`` are touches of one block and get one answer.
    progress : callable, optional
        Called with (fraction done, what).

    Returns
    -------
    list of dict
        ``next_touch_degC``, the gripper temperature of the touch that is worth most, None where none is worth
        its time; ``next_touch_accuracy``, the accuracy expected after a touch there, or without one.  Both
        are None where no touch of the block has anything to tell (no contact).

    Examples
    --------
    >>> from thermogrip.classify.estimators.posterior import PosteriorClassifier
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
    >>> known = PosteriorClassifier().with_device(load_default_gripper())
    >>> copper, wood = 24, 28
    >>> touched = load_example_grasps()["exp5_two_touch_unknown_object"].isel(grasp=[copper, wood])
    >>> [row["next_touch_degC"] for row in advise_touches(known, touched)]
    [12.5, None]
    """
    units = unit_names(grasps)
    names = list(dict.fromkeys(units.tolist()))
    found: dict[str, dict[str, float | None]] = {}
    for k, name in enumerate(names):
        if progress is not None:
            progress(k / len(names), f"another touch of {name}")
        touched = pick(grasps, units == name)
        block = check_grasps(touched).usable_grasps(touched)
        if block is None:
            found[name] = {"next_touch_degC": None, "next_touch_accuracy": None}
            continue
        choice = choose_next_touch(classifier, block, candidates=candidates, price=price)
        best, accuracy = None, choice.accuracy_now
        if choice.worth_it:
            best, accuracy = choice.best, float(choice.accuracy[choice.t_gripper == choice.best][0])
        found[name] = {"next_touch_degC": best, "next_touch_accuracy": accuracy}
    return [found[name] for name in units.tolist()]


def at_rates(now: float, *, heating: float, cooling: float) -> Callable[[float], float]:
    """Return the time [s] from temperature ``now`` [degC] to another at constant rates [K/s].

    Examples
    --------
    >>> seconds = at_rates(30.0, heating=0.1, cooling=0.05)
    >>> seconds(40.0), seconds(20.0)
    (100.0, 200.0)
    """
    if not (heating > 0 and cooling > 0):
        raise UserError("a rate is not positive", hint="give K/s, both as positive numbers")

    def seconds(there: float) -> float:
        return round(abs(there - now) / (heating if there > now else cooling), 9)

    return seconds


def with_model(classifier: GraspClassifier) -> PosteriorClassifier:
    """Return the classifier if it can foresee readings."""
    from thermogrip.classify.estimators.posterior import PosteriorClassifier

    if not isinstance(classifier, PosteriorClassifier):
        raise UserError(
            f"a {type(classifier).__name__} cannot foresee readings", hint="train the classifier 'posterior'"
        )
    classifier._check_fitted()
    return classifier
