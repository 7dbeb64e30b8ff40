r"""How far, how fast, how bent: the last seconds of each sensor, and a pool of classifiers on them.

When a contact has just begun, its level has little information and its derivatives have most.  Each trace
is described by its level before contact and by the coefficients of

.. math:: T(t) - b \approx \sum_{j=0}^{d} c_j P_j\!\left(1 + 2\,\frac{t - t_1}{w}\right),
          \qquad t_1 - w < t \le t_1,

least squares over the last w seconds before the end :math:`t_1`, with Legendre's polynomials :math:`P_j`:
value, slope and curvature, freed from noise.  Two sensors at different temperatures that touch one object are
two such rows side by side; their difference does not depend on the object's temperature, which the machines
can find.  Beside polynomials stand principal components, the shapes that the training traces have.

Which w, d, shapes and machine (logistic regression, Gaussians with one covariance or one each) suit the data
is not known beforehand.  All are fitted; grasps held out inside the training (whole sessions where there are
several) give the weights of their mixture

.. math:: p(m | x) = \sum_k w_k\, p_k(m | x), \qquad w = \arg\max \sum_i \ln \sum_k w_k\, p_k(m_i | x_i),

by expectation maximisation from equal weights (stacking).  One grasp more, to which all machines give the
same probability, keeps the weights from zero; with nothing held out they stay equal.

Two pools are ready: ``small``, 30 machines, was chosen with the contacts of two sensors in view on which the
page of classifiers scores it; ``wide`` is a grid in octaves that was written down before it was scored
anywhere.  The rule ``nested`` lets held-out grasps decide, too, whether the mixture or its best machine is to
speak: both are made without one fold of them and scored on it, fold after fold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_softmax
from sklearn.base import BaseEstimator, ClassifierMixin, clone
from sklearn.decomposition import PCA
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler

from thermogrip.classify.estimators.base import Floats, JoinedClassifier, Labels, as_array, level, times_from
from thermogrip.classify.estimators.lda import one_of_a_kind
from thermogrip.classify.estimators.margins import inner_folds
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps

_LEAST = 1e-6  # probability; no machine excludes the truth
_FLOOR = 1e-3  # least variance of features with spread 1


@dataclass(frozen=True)
class Pool:
    """What is tried: windows [s], degrees, numbers of components, C of the logistic regression, and how many
    grasps of the common covariance are added to each class's own."""

    windows: tuple[float, ...]
    degrees: tuple[int, ...]
    components: tuple[int, ...]
    strengths: tuple[float, ...]
    pulls: tuple[float, ...]


POOLS = {
    "small": Pool((1.0, 1.5, 2.5, 4.5), (3, 5), (6, 12), (3.0,), (10.0,)),
    "wide": Pool((0.5, 1.0, 2.0, 4.0), (2, 3, 4, 5, 6), (4, 8, 12, 16), (0.1, 1.0, 10.0), (3.0, 10.0, 30.0)),
}
RULES = ("stack", "nested")


@dataclass(eq=False, repr=False)
class ExpansionClassifier(JoinedClassifier):
    """Pool of classifiers on value, slope and curvature of the last seconds (``"expansions"``), the share of
    each machine by name in ``weights_``."""

    reads_both_sensors: ClassVar[bool] = True

    start: float = 0.0  # first time that may be used [s]
    random_state: int = 0  # of the folds inside the training
    pool: str = "small"  # what is tried, of POOLS
    rule: str = "stack"  # a mixture; "nested": that or its best machine, as held-out grasps decide

    def _fit(self, grasps: Grasps, labels: Labels) -> None:
        if self.pool not in POOLS or self.rule not in RULES:
            have = f"pools are {', '.join(POOLS)}, rules {', '.join(RULES)}"
            raise UserError(f"no pool {self.pool!r} or rule {self.rule!r}", hint=have)
        pool = POOLS[self.pool]
        self.times_ = times_from(grasps, self.start)
        rows, machines = self._rows(grasps), _machines(pool, self.times_, self._sensors(grasps))
        if labels.size == self.classes_.size:  # one grasp a material has no spread within
            machines = {name: m for name, m in machines.items() if name.startswith("logistic")}
        truth = np.searchsorted(self.classes_, labels)
        folds = inner_folds(grasps, labels, seed=self.random_state)
        p_true = np.ones((len(machines), labels.size))
        for fitted, held in folds:
            for k, machine in enumerate(machines.values()):
                with one_of_a_kind():
                    fit = clone(machine).fit(rows[fitted], labels[fitted])
                p_true[k, held] = _probabilities(fit, rows[held])[np.arange(held.size), truth[held]]
        held_out = [held for _, held in folds] if self.rule == "nested" else []
        self.weights_ = dict(zip(machines, chosen_weights(p_true, held_out).tolist()))
        with one_of_a_kind():
            self.machines_ = {name: machine.fit(rows, labels) for name, machine in machines.items()}

    def _sensors(self, grasps: Grasps) -> int:
        return 2 if "t_surface_2" in grasps else 1

    def _rows(self, grasps: Grasps) -> Floats:
        levels = [level(grasps, key)[:, None] for key in ("t_surface", "t_surface_2") if key in grasps]
        return np.hstack([as_array(grasps, times=self.times_, subtract_level=True), *levels])

    def _log_proba(self, grasps: Grasps) -> Floats:
        rows = self._rows(grasps)
        each = [w * _probabilities(self.machines_[name], rows) for name, w in self.weights_.items() if w]
        return np.asarray(np.log(np.sum(each, axis=0)))


def _expanded(X: Floats, *, times: Floats, sensors: int, window: float, degree: int) -> Floats:
    """Return Legendre coefficients of the last ``window`` seconds of each sensor, then the levels."""
    n = times.size
    used = times > times[-1] - window - 1e-9
    place = 1 + 2 * (times[used] - times[-1]) / window
    solve = np.linalg.pinv(np.polynomial.legendre.legvander(place, degree)).T
    parts = [X[:, k * n : (k + 1) * n][:, used] @ solve for k in range(sensors)]
    return np.hstack([*parts, X[:, sensors * n :]])


def _first(X: Floats, *, count: int) -> Floats:
    return X[:, :count]


@dataclass(eq=False, repr=False)
class _Gaussians(ClassifierMixin, BaseEstimator):  # type: ignore[misc]  # scikit-learn has no types
    """A Gaussian a class, its covariance drawn towards the common one as if by ``pull`` grasps of that."""

    pull: float

    def fit(self, X: Floats, y: Labels) -> _Gaussians:
        """Learn means and covariances."""
        self.classes_ = np.unique(y)
        d = X.shape[1]
        groups = [X[y == c] for c in self.classes_]
        scatter = [(g - g.mean(axis=0)).T @ (g - g.mean(axis=0)) for g in groups]
        pull = self.pull
        common = (sum(scatter) + pull * _FLOOR * np.eye(d)) / (y.size - len(groups) + pull)
        self.parts_ = []
        for g, own in zip(groups, scatter):
            covariance = (own + pull * common) / (len(g) - 1 + pull)
            self.parts_.append((g.mean(axis=0), np.linalg.inv(covariance), np.linalg.slogdet(covariance)[1]))
        return self

    def predict_proba(self, X: Floats) -> Floats:
        """Return probabilities, (n, K)."""
        log_p = [
            -0.5 * np.einsum("ij,jk,ik->i", X - mean, inverse, X - mean) - 0.5 * size
            for mean, inverse, size in self.parts_
        ]
        return np.asarray(np.exp(log_softmax(np.column_stack(log_p), axis=1)))


def _machines(pool: Pool, times: Floats, sensors: int) -> dict[str, BaseEstimator]:
    """Return the unfitted machines of the pool by name."""
    length = float(times[-1] - times[0])
    windows = sorted({min(w, length) for w in pool.windows})
    ends: dict[str, BaseEstimator] = {
        f"logistic {c:g}": LogisticRegression(C=c, max_iter=5000) for c in pool.strengths
    }
    ends["one covariance"] = LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto")
    ends |= {f"a covariance each, {pull:g}": _Gaussians(pull) for pull in pool.pulls}
    made: dict[str, BaseEstimator] = {}
    for name, end in ends.items():
        for w in windows:
            for d in pool.degrees:
                if np.sum(times > times[-1] - w - 1e-9) > d:  # else no polynomial is least squares
                    how = {"times": times, "sensors": sensors, "window": w, "degree": d}
                    expand = FunctionTransformer(_expanded, kw_args=how)
                    made[f"{name}, {w:g} s, degree {d}"] = make_pipeline(expand, StandardScaler(), clone(end))
        for k in pool.components:
            shapes = PCA(svd_solver="full"), FunctionTransformer(_first, kw_args={"count": k})
            made[f"{name}, {k} components"] = make_pipeline(*shapes, StandardScaler(), clone(end))
    return made


def _probabilities(machine: Any, rows: Floats) -> Floats:
    p = np.maximum(np.asarray(machine.predict_proba(rows), dtype=float), _LEAST)
    return np.asarray(p / p.sum(axis=1, keepdims=True))


def mixture_weights(p_true: Floats, *, rounds: int = 200) -> NDArray[np.float64]:
    """Return the weights (n_machine,) of a mixture from each machine's probabilities of the true classes of
    held-out grasps, ``p_true`` (n_machine, n), by ``rounds`` of expectation maximisation."""
    count, n = p_true.shape
    weights = np.full(count, 1 / count)
    for _ in range(rounds):
        shares = weights[:, None] * p_true
        shares /= shares.sum(axis=0)
        weights = (shares.sum(axis=1) + 1 / count) / (n + 1)
    return weights


def chosen_weights(p_true: Floats, held_out: Sequence[NDArray[np.int64]]) -> NDArray[np.float64]:
    """Return the weights of the mixture or of its best machine alone, whichever the folds of held-out grasps
    prefer; ``p_true`` as in :func:`mixture_weights`, and without folds it is the mixture."""
    rules = (mixture_weights, _best_alone)
    lost = np.zeros(len(rules))
    for fold in held_out:
        rest = np.setdiff1d(np.arange(p_true.shape[1]), fold)
        lost += [-np.log(rule(p_true[:, rest]) @ p_true[:, fold]).sum() for rule in rules]
    return np.asarray(rules[int(np.argmin(lost))](p_true))


def _best_alone(p_true: Floats) -> NDArray[np.float64]:
    weights = np.zeros(p_true.shape[0])
    weights[np.argmin(-np.log(p_true).sum(axis=1))] = 1.0
    return weights
