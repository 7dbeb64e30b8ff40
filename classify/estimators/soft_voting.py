r"""Several classifiers asked at once: the mean of their probabilities.

.. math:: p(m) = \frac{1}{n} \sum_{i=1}^{n} p_i(m).

By Jensen's inequality the log loss of the mean is at most the mean of the log losses, on every set of grasps;
where the members err on different grasps it is lower than that of the best of them.  The weights are equal,
so that nothing is learnt from held-out grasps, of which there are few.  A member that is sure and wrong costs
at most ln n.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import logsumexp
from sklearn.base import clone

from thermogrip.classify.estimators.base import Floats, GraspClassifier, Records
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps

__all__ = ["VoteClassifier", "check_members"]


class VoteClassifier(GraspClassifier):
    """The mean of the probabilities of several classifiers.

    Parameters
    ----------
    members : sequence of GraspClassifier
        At least two, unfitted; none that learns from the grasps of other conditions than its own.

    Attributes
    ----------
    classes_ : (K,) ndarray of str
    members_ : list of GraspClassifier
        Fitted.

    Examples
    --------
    >>> from thermogrip.classify import make_classifier
    >>> from thermogrip.classify.estimators.base import pick
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> grasps = load_example_grasps()["exp1A_obj43_grip23"]
    >>> train, test = (pick(grasps, grasps["split"].values == part) for part in ("train", "test"))
    >>> vote = make_classifier("features-lda+svm-pca").fit(train)
    >>> truth = vote.classes_.searchsorted(test["material"].values)
    >>> def loss(one):
    ...     return -np.mean(one.predict_log_proba(test)[np.arange(truth.size), truth])
    >>> bool(loss(vote) <= np.mean([loss(member) for member in vote.members_]))
    True
    """

    def __init__(self, members: Sequence[GraspClassifier] = ()) -> None:
        self.members = members

    def fit(self, X: Records, y: ArrayLike | None = None) -> Self:
        """Fit each member to labelled grasps.

        Raises
        ------
        UserError
            If there are fewer than two members, or one learns from other conditions too; and what a member
            raises.
        """
        check_members(self.members)
        self.members_ = [clone(member).fit(X, y) for member in self.members]
        self.classes_ = self.members_[0].classes_
        return self

    def check_installed(self) -> None:
        """Raise :class:`UserError` where a member needs a package that is not installed."""
        for member in self.members:
            member.check_installed()

    def _log_proba(self, grasps: Grasps) -> Floats:
        said = np.stack([member.predict_log_proba(grasps) for member in self.members_])
        return np.asarray(logsumexp(said, axis=0) - np.log(len(said)))


def check_members(members: Sequence[GraspClassifier]) -> None:
    """Raise :class:`UserError` where these can be no vote."""
    if len(members) < 2:
        raise UserError("a vote has fewer than two members", hint="name them like rocket+features-lda")
    for member in members:
        if member.learns_from_all_conditions:
            raise UserError(
                f"{type(member).__name__} learns from all conditions and can be no member of a vote",
                hint="compare it beside the vote",
            )
