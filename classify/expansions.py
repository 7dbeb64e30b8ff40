r"""How far, how fast, how bent: the last seconds of each sensor, and a pool of classifiers on them.

When a contact has just begun, its level tells little and its derivatives tell most.  Each trace is described
by its level before contact and by the coefficients of

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

by expectation maximisation from equal weights (stacking).  One grasp more, of which all machines say the
same, keeps the weights from zero; with nothing held out they stay equal.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_softmax
from sklearn.base import BaseEstimator, ClassifierMixin, TransformerMixin, clone
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from thermogrip.classify.base import Floats, JoinedClassifier, Labels, as_array, level, times_from
from thermogrip.classify.margins import inner_folds
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps

__all__ = ["ExpansionClassifier", "mixture_weights"]

_LEAST = 1e-6  # probability; a machine that excludes the truth is not believed so far
_WINDOWS = (1.0, 1.5, 2.5, 4.5)  # s
_DEGREES = (3, 5)
_COMPONENTS = (6, 12)
_PULL, _FLOOR = 10.0, 1e-3  # grasps; of features with spread 1


class ExpansionClassifier(JoinedClassifier):
    """Pool of classifiers on value, slope and curvature of the last seconds (``"expansions"``).

    Parameters
    ----------
    start : float, optional
        First time [s] that may be used.
    random_state : int, optional
        Of the folds inside the training.

    Attributes
    ----------
    classes_ : (K,) ndarray of str
    weights_ : dict of str to float
        Share of each machine.
    """

    def __init__(self, start: float = 0.0, random_state: int = 0) -> None:
        self.start = start
        self.random_state = random_state

    def _fit(self, grasps: Grasps, labels: Labels) -> None:
        self.times_ = times_from(grasps, self.start)
        if self.times_.size <= max(_DEGREES):
            raise UserError(f"{self.times_.size} samples cannot be expanded", mend="record longer")
        rows, machines = self._rows(grasps), _machines(self.times_, self._sensors(grasps))
        if labels.size == self.classes_.size:  # one grasp a material has no spread within
            machines = {name: m for name, m in machines.items() if name.startswith("logistic")}
        truth = np.searchsorted(self.classes_, labels)
        folds = inner_folds(grasps, labels, seed=self.random_state)
        said = np.ones((len(machines), labels.size))
        for fitted, held in folds:
            for k, machine in enumerate(machines.values()):
                p = _probabilities(clone(machine).fit(rows[fitted], labels[fitted]), rows[held])
                said[k, held] = p[np.arange(held.size), truth[held]]
        self.weights_ = dict(zip(machines, mixture_weights(said).tolist()))
        self.machines_ = {name: machine.fit(rows, labels) for name, machine in machines.items()}

    def _sensors(self, grasps: Grasps) -> int:
        return 2 if "t_surface_2" in grasps else 1

    def _rows(self, grasps: Grasps) -> Floats:
        levels = [level(grasps, key)[:, None] for key in ("t_surface", "t_surface_2") if key in grasps]
        return np.hstack([as_array(grasps, times=self.times_, subtract_level=True), *levels])

    def _log_proba(self, grasps: Grasps) -> Floats:
        rows = self._rows(grasps)
        each = [w * _probabilities(self.machines_[name], rows) for name, w in self.weights_.items()]
        return np.asarray(np.log(np.sum(each, axis=0)))


class _Expand(TransformerMixin, BaseEstimator):  # type: ignore[misc]  # scikit-learn has no types
    """Legendre coefficients of the last ``window`` seconds of each sensor, then the levels."""

    def __init__(self, times: Floats, sensors: int, window: float, degree: int) -> None:
        self.times, self.sensors, self.window, self.degree = times, sensors, window, degree

    def fit(self, X: Floats, y: Any = None) -> _Expand:
        """Learn nothing."""
        return self

    def transform(self, X: Floats) -> Floats:
        """Return coefficients and levels."""
        n = self.times.size
        used = self.times > self.times[-1] - self.window - 1e-9
        place = 1 + 2 * (self.times[used] - self.times[-1]) / self.window
        solve = np.linalg.pinv(np.polynomial.legendre.legvander(place, self.degree)).T
        parts = [X[:, k * n : (k + 1) * n][:, used] @ solve for k in range(self.sensors)]
        return np.hstack([*parts, X[:, self.sensors * n :]])


class _Components(TransformerMixin, BaseEstimator):  # type: ignore[misc]
    """Principal components of the traces: the shapes that the training shows, in place of polynomials."""

    def __init__(self, count: int) -> None:
        self.count = count

    def fit(self, X: Floats, y: Any = None) -> _Components:
        """Learn the components."""
        self.mean_ = X.mean(axis=0)
        self.axes_ = np.linalg.svd(X - self.mean_, full_matrices=False)[2][: self.count].T
        return self

    def transform(self, X: Floats) -> Floats:
        """Return what the components are multiplied by."""
        return np.asarray((X - self.mean_) @ self.axes_)


class _Gaussians(ClassifierMixin, BaseEstimator):  # type: ignore[misc]
    """A Gaussian a class, its covariance drawn towards the common one as if by ten grasps of that."""

    def fit(self, X: Floats, y: Labels) -> _Gaussians:
        """Learn means and covariances."""
        self.classes_ = np.unique(y)
        d = X.shape[1]
        groups = [X[y == c] for c in self.classes_]
        scatter = [(g - g.mean(axis=0)).T @ (g - g.mean(axis=0)) for g in groups]
        common = (sum(scatter) + _PULL * _FLOOR * np.eye(d)) / (y.size - len(groups) + _PULL)
        self.parts_ = []
        for g, own in zip(groups, scatter):
            covariance = (own + _PULL * common) / (len(g) - 1 + _PULL)
            self.parts_.append((g.mean(axis=0), np.linalg.inv(covariance), np.linalg.slogdet(covariance)[1]))
        return self

    def predict_proba(self, X: Floats) -> Floats:
        """Return probabilities, (n, K)."""
        log_p = [
            -0.5 * np.einsum("ij,jk,ik->i", X - mean, inverse, X - mean) - 0.5 * size
            for mean, inverse, size in self.parts_
        ]
        return np.asarray(np.exp(log_softmax(np.column_stack(log_p), axis=1)))


def _machines(times: Floats, sensors: int) -> dict[str, BaseEstimator]:
    """Return the unfitted machines of the pool by name."""
    length = times[-1] - times[0]
    windows = sorted({min(w, float(length)) for w in _WINDOWS})
    ends = {
        "logistic": LogisticRegression(C=3.0, max_iter=5000),
        "one covariance": LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto"),
        "a covariance each": _Gaussians(),
    }
    made: dict[str, BaseEstimator] = {}
    for name, end in ends.items():
        for w in windows:
            for d in _DEGREES:
                expand = _Expand(times, sensors, w, d)
                made[f"{name}, {w:g} s, degree {d}"] = make_pipeline(expand, StandardScaler(), clone(end))
        for k in _COMPONENTS:
            made[f"{name}, {k} components"] = make_pipeline(_Components(k), StandardScaler(), clone(end))
    return made


def _probabilities(machine: Any, rows: Floats) -> Floats:
    p = np.maximum(np.asarray(machine.predict_proba(rows), dtype=float), _LEAST)
    return np.asarray(p / p.sum(axis=1, keepdims=True))


def mixture_weights(said: Floats, *, rounds: int = 200) -> NDArray[np.float64]:
    """Return the weights of a mixture from what each machine said of the truth, shape (n_machine,).

    Parameters
    ----------
    said : (n_machine, n) array_like
        Probability of the true class of each held-out grasp.
    rounds : int, optional
        Of expectation maximisation.

    Examples
    --------
    >>> said = np.array([[0.9] * 30, [0.5] * 30])
    >>> mixture_weights(said).round(2)
    array([0.96, 0.04])
    """
    count, n = said.shape
    weights = np.full(count, 1 / count)
    for _ in range(rounds):
        shares = weights[:, None] * said
        shares /= shares.sum(axis=0)
        weights = (shares.sum(axis=1) + 1 / count) / (n + 1)
    return weights
