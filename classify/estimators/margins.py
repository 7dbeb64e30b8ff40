r"""Classifiers that answer with margins, made to answer with probabilities: SVM, and MiniRocket with ridge.

A support vector machine or a ridge regression on class labels gives the distance of a grasp from its
boundaries, :math:`d_k`, not the probability of each class (MiniRocket's own classifier answers 0 or 1).  Here

.. math:: p_k = \frac{e^{s d_k}}{\sum_j e^{s d_j}},

and the one scale s is found on margins of grasps that were held out, inside the training grasps: by session
where there are several, else by grasp or touched block.  The same held-out margins choose among a few
settings of the machine, by their log loss.  With n held-out grasps the truth counts as (n + 1)/(n + 2) of an
observation and not as 1 (Platt, 1999), so that margins without an error do not make s infinite.  Where a
class has a single grasp nothing can be held out: the first setting is used, with s = 1.

**MiniRocket** (Dempster, Schmidt and Webb, 2021): each trace is convolved with 84 kernels at several
dilations; the share of samples where a convolution exceeds a threshold (a quantile of the training traces)
is one feature, about 10 000 in all.  The kernels sum to zero, so that but for its ends a trace's level does
not matter.  The transform is aeon's (extra ``rocket``; its first use compiles for a minute).  Ridge
regression knows the n training grasps by their inner products only, so the standardised features are first
turned into the n coordinates that keep these.  In the inner folds the thresholds, which know no labels, are
those of all training grasps.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import log_softmax
from sklearn.base import BaseEstimator, clone
from sklearn.decomposition import PCA
from sklearn.feature_selection import VarianceThreshold
from sklearn.linear_model import RidgeClassifier
from sklearn.model_selection import StratifiedGroupKFold
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler
from sklearn.svm import SVC

from thermogrip.classify.estimators.base import Floats, JoinedClassifier, Labels, as_array, times_from
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps, unit_names

_SCALES = (1e-3, 1e3)


class MarginClassifier(JoinedClassifier):
    """Base of the classifiers whose machine gives margins.

    A subclass writes ``_learn_rows(grasps)``, which sets up reading, ``_rows(grasps)``, numbers of each
    grasp, and ``_machines(n)``, scikit-learn classifiers with a ``decision_function`` for n training grasps.
    ``scale_`` multiplies margins, ``held_out_loss_`` is the log loss of held-out training grasps or NaN.
    """

    reads_both_sensors: ClassVar[bool] = True
    random_state: int

    def _fit(self, grasps: Grasps, labels: Labels) -> None:
        self._learn_rows(grasps)
        rows, machines = self._rows(grasps), self._machines(labels.size)
        folds = inner_folds(grasps, labels, seed=self.random_state)
        truth = np.searchsorted(self.classes_, labels)
        best, self.scale_, self.held_out_loss_ = machines[0], 1.0, float("nan")
        if folds:
            # a fold without one of the classes to train on is left out, and its grasps with it
            held = np.sort(np.concatenate([at for _, at in folds]))
            tried = [calibrated_scale(_held_out(m, rows, labels, folds)[held], truth[held]) for m in machines]
            k = int(np.argmin([loss for _, loss in tried]))
            best, (self.scale_, self.held_out_loss_) = machines[k], tried[k]
        self.machine_ = clone(best).fit(rows, labels)

    @abstractmethod
    def _learn_rows(self, grasps: Grasps) -> None:
        """Learn how grasps are read."""

    @abstractmethod
    def _rows(self, grasps: Grasps) -> Floats:
        """Return one row of numbers for each grasp."""

    @abstractmethod
    def _machines(self, n: int) -> list[BaseEstimator]:
        """Return unfitted machines to choose from."""

    def _log_proba(self, grasps: Grasps) -> Floats:
        return np.asarray(log_softmax(self.scale_ * _margins(self.machine_, self._rows(grasps)), axis=1))


@dataclass(eq=False, repr=False)
class SvmPca(MarginClassifier):
    """Support vector machine on principal components of the rise (``"svm-pca"``)."""

    fits_in_a_blink: ClassVar[bool] = True

    components: int = 10  # kept; fewer where there are fewer grasps
    start: float = 0.0  # first time that is used [s]
    random_state: int = 0  # of the folds inside the training

    def _learn_rows(self, grasps: Grasps) -> None:
        if self.components < 1:
            raise UserError(f"components must be >= 1, got {self.components}")
        self.times_ = times_from(grasps, self.start)

    def _rows(self, grasps: Grasps) -> Floats:
        return as_array(grasps, times=self.times_, subtract_level=True)

    def _machines(self, n: int) -> list[BaseEstimator]:
        fewest = max(1, min(self.components, n // 2, self.times_.size))  # a fold inside has fewer grasps
        return [
            make_pipeline(PCA(fewest, svd_solver="full"), SVC(C=c, gamma="scale"))
            for c in (1.0, 10.0, 100.0, 1000.0)
        ]


def inner_folds(
    grasps: Grasps, labels: Labels, *, count: int = 5, seed: int = 0
) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Return (fitted, held out) rows of training grasps, whole sessions or whole grasps apart; there are none
    where a class is in one group only."""
    groups = unit_names(grasps)
    session = grasps["session"].values.astype(str) if "session" in grasps else groups
    for tried in (session, groups):
        fewest = min(np.unique(tried[labels == c]).size for c in np.unique(labels))
        if fewest > 1:
            split = StratifiedGroupKFold(min(count, fewest), shuffle=True, random_state=seed)
            found = [(np.asarray(a), np.asarray(b)) for a, b in split.split(labels, labels, tried)]
            whole = np.unique(labels).size
            return [(a, b) for a, b in found if b.size and np.unique(labels[a]).size == whole]
    return []


def calibrated_scale(margins: Floats, truth: NDArray[np.int64]) -> tuple[float, float]:
    """Return the scale of margins (n, K) whose probabilities have the least log loss, and that loss."""
    n, k = margins.shape
    kept = (n + 1) / (n + 2)
    target = np.where(np.arange(k) == truth[:, None], kept, (1 - kept) / (k - 1))

    def loss(log_scale: float) -> float:
        return float(-np.mean(np.sum(target * log_softmax(np.exp(log_scale) * margins, axis=1), axis=1)))

    # the loss is convex in the scale, so unimodal in its logarithm
    found = minimize_scalar(loss, bounds=(np.log(_SCALES[0]), np.log(_SCALES[1])), method="bounded")
    scale = float(np.exp(found.x))
    log_p = log_softmax(scale * margins, axis=1)
    return scale, float(-log_p[np.arange(n), truth].mean())


def _margins(machine: Any, rows: Floats) -> Floats:
    """Return (n, K) margins; those of two classes are half of the one margin that the machine gives."""
    d = np.asarray(machine.decision_function(rows), dtype=float)
    return np.column_stack([-0.5 * d, 0.5 * d]) if d.ndim == 1 else d


def _held_out(
    machine: BaseEstimator,
    rows: Floats,
    labels: Labels,
    folds: Sequence[tuple[NDArray[np.int64], NDArray[np.int64]]],
) -> Floats:
    out = np.zeros((labels.size, np.unique(labels).size))
    for fitted, held in folds:
        out[held] = _margins(clone(machine).fit(rows[fitted], labels[fitted]), rows[held])
    return out


_LEAST_SAMPLES = 9  # length of a kernel
_LEAST_SD = 1e-4  # a share that never changes is no feature
_ALPHAS = np.geomspace(1e-5, 10, 7)  # ridge, a feature


@dataclass(eq=False, repr=False)
class RocketClassifier(MarginClassifier):
    """MiniRocket and ridge regression, with calibrated probabilities (``"rocket"``)."""

    needs: ClassVar[tuple[str, str] | None] = ("aeon", "rocket")

    kernels: int = 10_000  # features, about
    start: float = 0.0  # first time that is used [s]
    random_state: int = 0  # of the thresholds, and of the folds inside the training

    def _learn_rows(self, grasps: Grasps) -> None:
        from aeon.transformations.collection.convolution_based import MiniRocket

        self.times_ = times_from(grasps, self.start)
        self.reader_ = make_pipeline(
            MiniRocket(n_kernels=self.kernels, random_state=self.random_state),
            FunctionTransformer(np.asarray, kw_args={"dtype": float}),
            VarianceThreshold(_LEAST_SD**2),
            StandardScaler(),
            PCA(svd_solver="full"),
        ).fit(self._series(grasps))

    def _series(self, grasps: Grasps) -> NDArray[np.float32]:
        x = as_array(grasps, times=self.times_)
        cube = x.reshape(x.shape[0], -1, self.times_.size)
        missing = max(0, _LEAST_SAMPLES - self.times_.size)  # a short contact stays where it ended
        return np.pad(cube, ((0, 0), (0, 0), (0, missing)), mode="edge").astype(np.float32)

    def _rows(self, grasps: Grasps) -> Floats:
        return np.asarray(self.reader_.transform(self._series(grasps)))

    def _machines(self, n: int) -> list[BaseEstimator]:
        count = self.reader_[2].variances_.size
        return [RidgeClassifier(alpha=alpha) for alpha in _ALPHAS * count]
