r"""Touch again, and at which temperature.

**Another touch** at one of several gripper temperatures is worth it where

.. math:: V \, (A_{after} - A_{now}) > c \, (t_{reach} + t_{rest} + t_{touch}),

V being what a right answer is worth (1 here), A the expected accuracy and c the cost of a second.

**Expected information.**  With p_m the probability of candidate m now and a normal distribution of the
readings y to come under each (:mod:`thermogrip.sysid.effusivity.predictive`), the probabilities after y are
:math:`p_m(y) \propto p_m N(y; m)`, so that

.. math:: I = H(p) - \sum_m p_m E_{y|m} H(p(y)), \qquad A = \sum_m p_m E_{y|m} \max_k p_k(y)

are the expected information [nat] and the expected accuracy of naming the likeliest candidate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import logsumexp

from thermogrip.classify.estimators.base import Floats, GraspClassifier, normalised, pick, unit_names
from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.datasets.errors import UserError
from thermogrip.sysid.effusivity.predictive import PosteriorPredictive, next_touch
from thermogrip.sysid.effusivity.quality import check_grasps

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Grasps

_NEGLIGIBLE = 1e-4  # of probability: such a candidate's futures are not drawn


class Expected(NamedTuple):
    """``n`` situations: ``information`` [nat], ``accuracy`` after the readings and its ``gain``, (n,)
    each."""

    information: Floats
    accuracy: Floats
    gain: Floats


def entropy(log_p: Floats) -> Floats:
    """Return the entropy [nat] of log probabilities along the last axis."""
    return np.asarray(-(np.exp(log_p) * np.where(np.isfinite(log_p), log_p, 0.0)).sum(axis=-1))


def expected_information(forecast: PosteriorPredictive, *, draws: int = 48, seed: int = 0) -> Expected:
    """Return the expected information of the readings to come, from ``draws`` of each candidate with both
    signs."""
    rng = np.random.default_rng(seed)
    log_p, mean, covariance = forecast[:3]
    n, m, width = mean.shape
    now = entropy(log_p)
    best = log_p.argmax(axis=1)
    p = np.exp(log_p)
    if width == 0:
        return Expected(np.zeros(n), p.max(axis=1), np.zeros(n))
    chol = np.linalg.cholesky(covariance)
    white = np.linalg.inv(chol)  # small, and used for every draw
    log_det = 2 * np.log(np.diagonal(chol, axis1=2, axis2=3)).sum(axis=2)
    half = rng.standard_normal((draws, width))
    z = np.concatenate([half, -half])
    later, gain = np.zeros(n), np.zeros(n)
    # averages over draws of y under each candidate k
    for k in range(m):
        likely = np.flatnonzero(p[:, k] > _NEGLIGIBLE)
        if not likely.size:
            continue
        y = mean[likely, k, None, :] + z @ chol[likely, k].transpose(0, 2, 1)
        off = (y[:, None] - mean[likely][:, :, None, :]) @ white[likely].transpose(0, 1, 3, 2)
        # p_m(y) ~ p_m N(y; m)
        after = log_p[likely][:, :, None] - 0.5 * ((off**2).sum(axis=3) + log_det[likely][:, :, None])
        after = (after - logsumexp(after, axis=1, keepdims=True)).transpose(0, 2, 1)
        q = np.exp(after)
        later[likely] += p[likely, k] * entropy(after).mean(axis=1)
        p_of_best = np.take_along_axis(q, best[likely][:, None, None], axis=2)[:, :, 0]
        # Accuracy is never lost by reading on: with k* the candidate that is likeliest now, max_k p_k(y) -
        # p_k*(y) is negative in no draw, and exactly zero where no reading could change the answer.
        gain[likely] += p[likely, k] * (q.max(axis=2) - p_of_best).mean(axis=1)
    return Expected(np.maximum(now - later, 0.0), p.max(axis=1) + gain, gain)


TEMPERATURES = tuple(np.arange(12.5, 50.1, 2.5).tolist())


@dataclass(frozen=True)
class NextTouch:
    """Whether to touch again, and at which of n gripper temperatures."""

    t_gripper: Floats  # (n,), that were weighed [degC]
    information: Floats  # (n,), expected of a touch at each [nat]
    accuracy: Floats  # (n,), expected after it
    seconds: Floats  # (n,), what it takes: reaching the temperature, resting, touching
    value: Floats  # (n,), gain of accuracy less the cost of the seconds
    entropy: float  # before it [nat]
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
        table = {name: np.asarray(value).tolist() for name, value in asdict(self).items()}
        return table | {"best": self.best, "worth_it": self.worth_it}


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
    """Return what a further touch of the block is expected to gain at each gripper temperature.

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
        Time to bring the gripper to a temperature [s]; by default it is done within the rest.
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
    model = with_model(classifier)
    levels = np.atleast_1d(np.asarray(t_gripper, dtype=float))
    if not (np.isfinite(levels).all() and levels.size and np.isfinite(price) and price >= 0):
        raise UserError("a temperature or the price is no number", hint="give degC, and a price of 0 or more")
    names = model.asked(candidates)
    forecast = next_touch(model.device_, grasps, names, levels, coupling=model.coupling_, rest=rest, end=end)
    forecast = forecast._replace(log_p=normalised(forecast.log_p + model.log_prior(names)))
    expected = expected_information(forecast, draws=draws, seed=seed)
    reach = np.array([0.0 if seconds is None else float(seconds(float(t))) for t in levels])
    whole = np.maximum(reach, rest) + end
    return NextTouch(
        t_gripper=levels,
        information=expected.information,
        accuracy=expected.accuracy,
        seconds=whole,
        value=expected.gain - price * whole,
        entropy=float(entropy(forecast.log_p[0])),
        accuracy_now=float(np.exp(forecast.log_p[0].max())),
    )


def advise_touches(
    classifier: GraspClassifier,
    grasps: Grasps,
    *,
    candidates: Sequence[str] | None = None,
    price: float = 0.001,
    progress: Callable[[float, str], None] | None = None,
) -> list[dict[str, float | None]]:
    """Return, a row a grasp, what another touch of its block would bring (:func:`choose_next_touch`)."""
    units = unit_names(grasps)
    names = list(dict.fromkeys(units.tolist()))
    advice_of: dict[str, dict[str, float | None]] = {}
    for k, name in enumerate(names):
        if progress is not None:
            progress(k / len(names), f"another touch of {name}")
        touched = pick(grasps, units == name)
        block = check_grasps(touched).usable_grasps(touched)
        # no touch of the block has a contact
        if block is None:
            advice_of[name] = {"next_touch_degC": None, "next_touch_accuracy": None}
            continue
        choice = choose_next_touch(classifier, block, candidates=candidates, price=price)
        best, accuracy = None, choice.accuracy_now
        # of the touch that is worth most, or without one
        if choice.worth_it:
            best, accuracy = choice.best, float(choice.accuracy[choice.t_gripper == choice.best][0])
        advice_of[name] = {"next_touch_degC": best, "next_touch_accuracy": accuracy}
    return [advice_of[name] for name in units.tolist()]


def with_model(classifier: GraspClassifier) -> PosteriorClassifier:
    """Return the classifier if it can predict readings."""
    if not isinstance(classifier, PosteriorClassifier):
        raise UserError(
            f"a {type(classifier).__name__} cannot predict readings", hint="train the classifier 'posterior'"
        )
    classifier._check_fitted()
    return classifier
