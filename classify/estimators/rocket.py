r"""MiniRocket: thousands of fixed convolutions, and a ridge regression on how often they are positive.

Dempster, Schmidt and Webb (2021): each trace is convolved with 84 kernels at several dilations; the share of
samples where a convolution exceeds a threshold (a quantile of the training traces) is one feature, about
10 000 in all.  The kernels sum to zero, so that but for its ends a trace's level does not matter.  The
transform is aeon's (extra ``rocket``; its first use compiles for a minute).  Ridge regression knows the n
training grasps by their inner products only, so the standardised features are first turned into the n
coordinates that keep these.  Probabilities come from held-out margins
(:mod:`thermogrip.classify.estimators.svm`); the thresholds, which know no labels, are those of all training
grasps there.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator
from sklearn.linear_model import RidgeClassifier

from thermogrip.classify.estimators.base import Floats, as_array, times_from
from thermogrip.classify.estimators.svm import MarginClassifier
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps, log_name

__all__ = ["RocketClassifier"]

_LEAST_SAMPLES = 9  # length of a kernel
_LEAST_SD = 1e-4  # a share that never changes is no feature
_ALPHAS = np.geomspace(1e-5, 10, 7)  # ridge, a feature


class RocketClassifier(MarginClassifier):
    """MiniRocket and ridge regression, with calibrated probabilities (``"rocket"``).

    Parameters
    ----------
    kernels : int, optional
        Features, about.
    start : float, optional
        First time [s] that is used.
    random_state : int, optional
        Of the thresholds, and of the folds inside the training.
    """

    needs: ClassVar[tuple[str, str] | None] = ("aeon", "rocket")

    def __init__(self, kernels: int = 10_000, start: float = 0.0, random_state: int = 0) -> None:
        self.kernels = kernels
        self.start = start
        self.random_state = random_state

    def _learn_rows(self, grasps: Grasps) -> None:
        from aeon.transformations.collection.convolution_based import MiniRocket

        self.times_ = times_from(grasps, self.start)
        if self.times_.size < _LEAST_SAMPLES:
            problem = f"{self.times_.size} samples from {self.start:g} s, MiniRocket needs {_LEAST_SAMPLES}"
            raise UserError(problem, file=log_name(grasps), hint="record longer")
        self.rocket_ = MiniRocket(n_kernels=self.kernels, random_state=self.random_state)
        features = np.asarray(self.rocket_.fit_transform(self._series(grasps)), dtype=float)
        self.mean_, sd = features.mean(axis=0), features.std(axis=0)
        self.weight_ = np.where(sd > _LEAST_SD, 1 / np.maximum(sd, _LEAST_SD), 0.0)
        sizes, axes = np.linalg.svd((features - self.mean_) * self.weight_, full_matrices=False)[1:]
        self.axes_ = axes[sizes > 1e-9 * sizes[0]].T

    def _series(self, grasps: Grasps) -> NDArray[np.float32]:
        x = as_array(grasps, times=self.times_)
        return x.reshape(x.shape[0], -1, self.times_.size).astype(np.float32)

    def _rows(self, grasps: Grasps) -> Floats:
        features = np.asarray(self.rocket_.transform(self._series(grasps)), dtype=float)
        return np.asarray(((features - self.mean_) * self.weight_) @ self.axes_)

    def _machines(self, n: int) -> list[BaseEstimator]:
        return [RidgeClassifier(alpha=alpha) for alpha in _ALPHAS * self.weight_.size]
