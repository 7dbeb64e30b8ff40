r"""Pipelines of scikit-learn and aeon: an SVM on principal components, and MiniRocket with ridge.

Both answer with margins d_k, the distance of a grasp from the boundaries of its class (MiniRocket's own
classifier answers 0 or 1).  Here

.. math:: p_k = \frac{e^{s d_k}}{\sum_j e^{s d_j}},

and s is found on training grasps that were held out, by session where there are several, else by grasp or
touched block; on these the SVM's C is chosen, too.  With n held-out grasps the truth counts as
(n + 1)/(n + 2) of an observation and not as 1 [2]_, so that margins without an error do not make s infinite:
``CalibratedClassifierCV(method="temperature")`` lacks that and has a log loss of 0.89 in place of 0.50 where
five grasps of each material train; its ``"sigmoid"`` has 0.55.  Where not every grasp can be held out, s = 1.

MiniRocket [1]_ convolves each trace with 84 kernels at several dilations; the share of samples where a
convolution exceeds a threshold is one feature, about 10 000 in all.  The kernels sum to zero, so that but for
its ends a trace's level does not matter.  The transform is aeon's (extra ``rocket``; its first use compiles
for a minute).

References
----------
.. [1] A. Dempster, D. F. Schmidt, G. I. Webb, "MiniRocket: a very fast (almost) deterministic transform for
   time series classification", KDD 2021.
.. [2] J. Platt, "Probabilistic outputs for support vector machines", Advances in Large Margin Classifiers,
   1999.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import log_softmax
from sklearn.decomposition import PCA
from sklearn.linear_model import RidgeClassifierCV
from sklearn.model_selection import GridSearchCV, StratifiedGroupKFold, cross_val_predict
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC

from thermogrip.classify.estimators.base import Floats, JoinedClassifier, Labels, as_array, times_from
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps, unit_names

Folds = list[tuple[NDArray[np.int64], NDArray[np.int64]]]


class MarginClassifier(JoinedClassifier):
    """Base of the classifiers whose pipeline gives margins.

    A subclass writes ``_rows(grasps)``, what the pipeline reads of each grasp, and ``_pipeline(rows, labels,
    folds)``, which returns one that has a ``decision_function``.
    """

    reads_both_sensors: ClassVar[bool] = True
    start: float
    random_state: int

    def _fit(self, grasps: Grasps, labels: Labels) -> None:
        self.times_ = times_from(grasps, self.start)
        rows = self._rows(grasps)
        folds = inner_folds(grasps, labels, seed=self.random_state)
        self.machine_ = self._pipeline(rows, labels, folds)
        self.scale_ = 1.0
        if sum(held.size for _, held in folds) == labels.size:  # each grasp was held out once
            held = cross_val_predict(self.machine_, rows, labels, cv=folds, method="decision_function")
            self.scale_ = calibrated_scale(_of_each_class(held), np.searchsorted(self.classes_, labels))
        self.machine_.fit(rows, labels)

    @abstractmethod
    def _rows(self, grasps: Grasps) -> NDArray[np.floating[Any]]:
        """Return what the pipeline reads of each grasp."""

    @abstractmethod
    def _pipeline(self, rows: NDArray[np.floating[Any]], labels: Labels, folds: Folds) -> Pipeline:
        """Return an unfitted pipeline."""

    def _log_proba(self, grasps: Grasps) -> Floats:
        margins = _of_each_class(self.machine_.decision_function(self._rows(grasps)))
        return np.asarray(log_softmax(self.scale_ * margins, axis=1))


def calibrated_scale(margins: Floats, truth: NDArray[np.int64]) -> float:
    """Return the scale of margins (n, K) whose probabilities have the least log loss."""
    n, k = margins.shape
    target = np.full((n, k), 1 / (n + 2) / (k - 1))
    target[np.arange(n), truth] = (n + 1) / (n + 2)

    def loss(log_scale: float) -> float:
        return float(-(target * log_softmax(np.exp(log_scale) * margins, axis=1)).sum())

    # unimodal in its logarithm
    found = minimize_scalar(loss, bounds=(np.log(1e-3), np.log(1e3)), method="bounded")
    return float(np.exp(found.x))


def _of_each_class(margins: NDArray[np.floating[Any]]) -> Floats:
    """Return (n, K) margins; those of two classes are half of the one margin that a machine gives."""
    d = np.asarray(margins, dtype=float)
    return np.column_stack([-0.5 * d, 0.5 * d]) if d.ndim == 1 else d


@dataclass(eq=False, repr=False)
class SvmPca(MarginClassifier):
    """Support vector machine on principal components of the rise (``"svm-pca"``)."""

    components: int = 10  # kept; fewer where there are fewer grasps
    start: float = 0.0  # first time that is used [s]
    random_state: int = 0  # of the folds inside the training

    def _rows(self, grasps: Grasps) -> NDArray[np.floating[Any]]:
        return as_array(grasps, times=self.times_, subtract_level=True)

    def _pipeline(self, rows: NDArray[np.floating[Any]], labels: Labels, folds: Folds) -> Pipeline:
        if self.components < 1:
            raise UserError(f"components must be >= 1, got {self.components}")
        fewest = max(1, min(self.components, labels.size // 2, self.times_.size))  # a fold has fewer grasps
        pipeline = make_pipeline(PCA(fewest, svd_solver="full"), SVC(C=1.0))
        if not folds:
            return pipeline
        search = GridSearchCV(pipeline, {"svc__C": [1.0, 10.0, 100.0, 1000.0]}, cv=folds, refit=False)
        return pipeline.set_params(**search.fit(rows, labels).best_params_)


def inner_folds(grasps: Grasps, labels: Labels, *, count: int = 5, seed: int = 0) -> Folds:
    """Return (fitted, held out) rows of training grasps, whole sessions apart, or whole grasps where a
    session has all of a class; a fold without a class to train on is left out."""
    groups = unit_names(grasps)
    session = grasps["session"].values.astype(str) if "session" in grasps else groups
    kept: Folds = []
    for tried in (session, groups):
        fewest = min(np.unique(tried[labels == c]).size for c in np.unique(labels))
        if fewest > 1:
            split = StratifiedGroupKFold(min(count, fewest), shuffle=True, random_state=seed)
            found = [(np.asarray(a), np.asarray(b)) for a, b in split.split(labels, labels, tried)]
            whole = np.unique(labels).size
            sound = [(a, b) for a, b in found if b.size and np.unique(labels[a]).size == whole]
            if len(sound) == len(found):
                return sound
            kept = kept or sound
    return kept


_LEAST_SAMPLES = 9  # length of a kernel


@dataclass(eq=False, repr=False)
class RocketClassifier(MarginClassifier):
    """MiniRocket and ridge regression, with calibrated probabilities (``"rocket"``)."""

    needs: ClassVar[tuple[str, str] | None] = ("aeon", "rocket")

    kernels: int = 10_000  # features, about
    start: float = 0.0  # first time that is used [s]
    random_state: int = 0  # of the thresholds, and of the folds inside the training

    def _rows(self, grasps: Grasps) -> NDArray[np.floating[Any]]:
        x = as_array(grasps, times=self.times_)
        cube = x.reshape(x.shape[0], -1, self.times_.size)
        missing = max(0, _LEAST_SAMPLES - self.times_.size)  # a short contact stays where it ended
        return np.pad(cube, ((0, 0), (0, 0), (0, missing)), mode="edge").astype(np.float32)

    def _pipeline(self, rows: NDArray[np.floating[Any]], labels: Labels, folds: Folds) -> Pipeline:
        from aeon.transformations.collection.convolution_based import MiniRocket

        transform = MiniRocket(n_kernels=self.kernels, random_state=self.random_state)
        alphas = np.logspace(-1, 5, 7)  # of a penalty on some 10 000 features of spread 1
        return make_pipeline(transform, StandardScaler(), RidgeClassifierCV(alphas))
