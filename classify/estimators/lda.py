r"""Shrinkage linear discriminants, and a door for any scikit-learn estimator: a forest, an SVM, MiniRocket.

Linear discriminant analysis is the Gaussian classifier with one covariance and equal priors; the covariance
of 25 grasps is shrunk to a multiple of the identity by the amount of Ledoit and Wolf.  It is fitted on
physics features (``"features-lda"``) or on the first four principal components of the traces (``"pca-lda"``,
the baseline that knows no physics).  What is kept is linear, ``x @ coef.T + intercept``, and its softmax.
"""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, RegressorMixin, clone
from sklearn.calibration import CalibratedClassifierCV
from sklearn.decomposition import PCA
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.linear_model import RidgeClassifierCV
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler
from sklearn.svm import SVC

from thermogrip.classify.estimators.base import (
    Floats,
    JoinedClassifier,
    Labels,
    as_array,
    named_arrays,
    set_arrays,
    times_from,
)
from thermogrip.classify.estimators.bayes import FeatureReader
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps, log_name


class _Lda(JoinedClassifier):
    """A shrinkage LDA on rows that a subclass reads from grasps."""

    @abstractmethod
    def _rows(self, grasps: Grasps) -> Floats:
        """Return one row of numbers for each grasp."""

    def _fit_rows(self, rows: Floats, labels: Labels) -> None:
        if labels.size == self.classes_.size:
            raise UserError(
                f"one training grasp of each of {labels.size} materials does not show how grasps scatter",
                hint="give a second one of any of them, or use the classifier 'posterior'",
            )
        self.center_ = rows.mean(axis=0)
        sd = rows.std(axis=0)
        self.scale_ = np.where(sd > 1e-12, sd, 1.0)
        priors = np.full(self.classes_.size, 1 / self.classes_.size)
        lda = LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto", priors=priors)
        with one_of_a_kind():
            lda.fit((rows - self.center_) / self.scale_, labels)
        if self.classes_.size == 2:  # scikit-learn keeps one row: the log odds of the second class
            self.coef_ = np.vstack([np.zeros_like(lda.coef_[0]), lda.coef_[0]])
            self.intercept_ = np.array([0.0, float(lda.intercept_[0])])
        else:
            self.coef_, self.intercept_ = np.asarray(lda.coef_), np.asarray(lda.intercept_)

    def _take_up(self, arrays: dict[str, NDArray[Any]], n: int) -> None:
        """Take up the rule for rows of n numbers."""
        k = self.classes_.size
        set_arrays(self, arrays, center_=(n,), scale_=(n,), coef_=(k, n), intercept_=(k,))

    def _log_proba(self, grasps: Grasps) -> Floats:
        return self._discriminants(self._rows(grasps))

    def _discriminants(self, rows: Floats) -> Floats:
        z = (rows - self.center_) / self.scale_
        # A feature that a contact lacks is put at the training mean: it speaks for no class.
        z = np.where(np.isfinite(z), z, 0.0)
        return np.asarray(z @ self.coef_.T + self.intercept_)


class FeaturesLda(_Lda):
    """Shrinkage LDA on the physics features (``"features-lda"``).

    One covariance for all grasps cannot express that noise grows as a difference of temperature shrinks.
    So the discriminants of a grasp are multiplied by the share of their variance that is scatter within a
    class, not noise; grasps within 1 K teach nothing and speak for no class.
    """

    spread_: float
    """Variance of the discriminants within a class, summed."""

    def _fit(self, grasps: Grasps, labels: Labels) -> None:
        learnt = FeatureReader.learn([grasps], labels)
        self.reader_, self.notes_ = learnt.reader, learnt.notes
        x, _ = learnt.readings.normalised()
        usable = learnt.usable & np.isfinite(x).any(axis=1)
        x, labels = x[usable], labels[usable]
        whole = np.flatnonzero(np.isfinite(x).all(axis=0))
        self.reader_.names = [self.reader_.names[k] for k in whole]
        if not self.reader_.names:
            raise UserError(
                "no feature is known for every grasp", file=log_name(grasps), hint="record longer"
            )
        self.feature_names_ = self.reader_.names
        self.classes_ = np.unique(labels)
        self._fit_rows(x[:, whole], labels)
        logits = self._discriminants(x[:, whole])
        class_means = np.array([logits[labels == name].mean(axis=0) for name in self.classes_])
        within = logits - class_means[np.searchsorted(self.classes_, labels)]
        self.spread_ = float(np.sum(_centred(within) ** 2) / max(labels.size - self.classes_.size, 1))

    def _rows(self, grasps: Grasps) -> Floats:
        return self.reader_.read(grasps).normalised()[0]

    def _log_proba(self, grasps: Grasps) -> Floats:
        self.reader_.check_temperatures(grasps)
        x, noise = self.reader_.read(grasps).normalised()
        by_feature = _centred(self.coef_.T / self.scale_[:, None])  # (d, K)
        noise = np.einsum("dk,gde,ek->g", by_feature, np.nan_to_num(noise), by_feature)
        share = np.where(np.isfinite(x).any(axis=1), 1 / (1 + noise / self.spread_), 0.0)
        return np.asarray(share[:, None] * self._discriminants(x))

    def get_state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        arrays = named_arrays(self, ("center_", "scale_", "coef_", "intercept_"))
        return self.reader_.to_dict() | {"spread": self.spread_}, arrays

    def set_state(self, numbers: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
        self.reader_ = FeatureReader.from_dict(numbers)
        self.feature_names_ = self.reader_.names
        self.spread_ = float(numbers["spread"])
        self._take_up(arrays, len(self.feature_names_))


@dataclass(eq=False, repr=False)
class PcaLda(_Lda):
    """Shrinkage LDA on principal components of the traces (``"pca-lda"``)."""

    reads_both_sensors: ClassVar[bool] = True

    components: int = 4  # kept; fewer where there are fewer grasps
    start: float = 0.0  # first time that is used [s]

    def _fit(self, grasps: Grasps, labels: Labels) -> None:
        if self.components < 1:
            raise UserError(f"components must be >= 1, got {self.components}")
        self.times_ = times_from(grasps, self.start)
        x = as_array(grasps, times=self.times_)
        with np.errstate(invalid="ignore"):  # of its shares of the variance, where there is none
            pca = PCA(n_components=min(self.components, *x.shape), svd_solver="full").fit(x)
        self.pca_mean_, self.axes_ = np.asarray(pca.mean_), np.asarray(pca.components_)
        self._fit_rows((x - self.pca_mean_) @ self.axes_.T, labels)

    def _rows(self, grasps: Grasps) -> Floats:
        return np.asarray((as_array(grasps, times=self.times_) - self.pca_mean_) @ self.axes_.T)

    def get_state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        keys = ("times_", "pca_mean_", "axes_", "center_", "scale_", "coef_", "intercept_")
        return {}, named_arrays(self, keys)

    def set_state(self, numbers: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
        n = arrays["times_"].size * (getattr(self, "sensors_", None) or 1)
        set_arrays(self, arrays, times_=(None,), pca_mean_=(n,), axes_=(None, n))
        self._take_up(arrays, self.axes_.shape[0])


@dataclass(eq=False, repr=False)
class ArrayClassifier(JoinedClassifier):
    """Any scikit-learn classifier on the traces as a matrix.

    Without ``predict_proba`` it answers with the class that it predicts at probability (n + 1) / (n + K) for
    n training grasps of K classes. It is not saved to a file: loading one would run code.
    """

    reads_both_sensors: ClassVar[bool] = True

    # a classifier or pipeline, or its import path (``module:Class``, ``module:object``), which is imported:
    # give only what you trust
    estimator: BaseEstimator | str = "sklearn.linear_model.LogisticRegression"
    params: dict[str, Any] | None = None  # its parameters, where a path was given
    start: float = 0.0  # first time that is used [s]
    subtract_level: bool = True  # subtract each trace's level before contact
    standardise: bool = True  # bring each sample time to mean 0 and spread 1 over the training grasps
    random_state: int | None = None  # passed on where the estimator takes one

    def _made(self, labels: Labels) -> Any:
        """Return the unfitted estimator for training grasps of these labels."""
        return imported_estimator(self.estimator, self.params)

    def _fit(self, grasps: Grasps, labels: Labels) -> None:
        self.times_ = times_from(grasps, self.start)
        model = self._made(labels)
        if self.random_state is not None and "random_state" in model.get_params():
            model.set_params(random_state=self.random_state)
        self.center_, self.scale_ = np.zeros(1), np.ones(1)
        if self.standardise:
            raw = self._rows(grasps)
            self.center_, self.scale_ = raw.mean(axis=0), np.maximum(raw.std(axis=0), 1e-9)
        rows = self._rows(grasps)
        with _as_user_error(model, "learn", grasps), one_of_a_kind():
            self.model_ = model.fit(rows, labels)
        self.n_trained_ = labels.size

    def _rows(self, grasps: Grasps) -> Floats:
        x = as_array(grasps, times=self.times_, subtract_level=self.subtract_level)
        return np.asarray((x - self.center_) / self.scale_)

    def _log_proba(self, grasps: Grasps) -> Floats:
        rows = self._rows(grasps)
        with _as_user_error(self.model_, "name", grasps):
            if hasattr(self.model_, "predict_proba"):
                p = np.asarray(self.model_.predict_proba(rows), dtype=float)
            else:
                hit = np.asarray(self.model_.predict(rows))[:, None] == self.model_.classes_
                p = (1.0 + hit * self.n_trained_) / (self.n_trained_ + self.classes_.size)
        return np.asarray(np.log(np.maximum(p, 1e-12)))  # a vote of zero trees is no certainty


def imported_estimator(estimator: BaseEstimator | str, params: dict[str, Any] | None = None) -> Any:
    """Return a fresh scikit-learn classifier from an estimator or an import path, which must name one."""
    if not isinstance(estimator, str):
        return clone(estimator)
    module, _, name = estimator.rpartition(":" if ":" in estimator else ".")
    try:
        made = getattr(import_module(module), name)
        if isinstance(made, type):
            made = made(**(params or {}))
        elif hasattr(made, "get_params"):
            made = clone(made).set_params(**(params or {}))
    except (ImportError, AttributeError, ValueError) as error:
        raise UserError(f"{estimator!r} cannot be imported", hint=f"give module:Class ({error})") from error
    except TypeError as error:
        raise UserError(f"{estimator!r} does not take these parameters", hint=str(error)) from error
    if not is_estimator(made) or isinstance(made, RegressorMixin):
        raise UserError(
            f"{estimator!r} is no scikit-learn classifier", hint="it must have fit, and predict a class"
        )
    return made


def is_estimator(made: Any) -> bool:
    """Return whether an object has what scikit-learn asks of a classifier or a pipeline that ends in one."""
    return all(hasattr(made, method) for method in ("fit", "predict", "get_params"))


@dataclass(eq=False, repr=False)
class ForestClassifier(ArrayClassifier):
    """A random forest on the traces as they are, scikit-learn's with 500 trees (``"forest"``)."""

    estimator: BaseEstimator | str = "sklearn.ensemble:RandomForestClassifier"
    params: dict[str, Any] | None = field(default_factory=lambda: {"n_estimators": 500})
    standardise: bool = False  # a tree's thresholds need no scale


@dataclass(eq=False, repr=False)
class SvmPca(ArrayClassifier):
    """Support vector machine on ten principal components of the rise (``"svm-pca"``)."""

    standardise: bool = False

    def _made(self, labels: Labels) -> Any:
        components = max(1, min(10, labels.size // 2, self.times_.size))  # a fold has fewer grasps
        return _with_probabilities(make_pipeline(PCA(components, svd_solver="full"), SVC(C=100.0)), labels)


_LEAST_SAMPLES = 9  # length of a kernel


@dataclass(eq=False, repr=False)
class RocketClassifier(ArrayClassifier):
    """MiniRocket and ridge regression, aeon's and scikit-learn's (``"rocket"``).

    MiniRocket convolves each trace with 84 kernels at several dilations (Dempster, Schmidt, Webb, KDD 2021);
    the share of samples where a convolution exceeds a threshold is one feature, about 10 000 in all.
    """

    needs: ClassVar[tuple[str, str] | None] = ("aeon", "rocket")

    subtract_level: bool = False  # the kernels sum to zero
    standardise: bool = False

    def _rows(self, grasps: Grasps) -> Floats:
        rows = as_array(grasps, times=self.times_)
        cube = rows.reshape(len(rows), -1, self.times_.size)
        missing = max(0, _LEAST_SAMPLES - self.times_.size)  # a short contact stays where it ended
        return np.pad(cube, ((0, 0), (0, 0), (0, missing)), mode="edge").astype(np.float32)

    def _made(self, labels: Labels) -> Any:
        from aeon.transformations.collection.convolution_based import MiniRocket

        transform = MiniRocket(random_state=self.random_state)
        # sums of 10 000 features in single precision differ by 1e-6 with the number of grasps
        double = FunctionTransformer(np.asarray, kw_args={"dtype": np.float64})
        alphas = np.logspace(-1, 5, 7)  # of a penalty on some 10 000 features of spread 1
        return _with_probabilities(
            make_pipeline(transform, double, StandardScaler(), RidgeClassifierCV(alphas)), labels
        )


def _with_probabilities(machine: Any, labels: Labels) -> Any:
    """Return a classifier whose margins become probabilities by Platt's sigmoids on held-out grasps, itself
    where a class has too few for that."""
    folds = min(5, int(np.unique(labels, return_counts=True)[1].min()))
    return CalibratedClassifierCV(machine, cv=folds, ensemble=False) if folds > 1 else machine


@contextmanager
def _as_user_error(model: Any, verb: str, grasps: Grasps) -> Iterator[None]:
    """Turn the exception of a user's estimator on grasps that it cannot take into one line."""
    try:
        yield
    except (TypeError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        problem = f"{type(model).__name__} cannot {verb} these {grasps.sizes['grasp']} grasps ({reason})"
        raise UserError(problem, file=log_name(grasps), hint="check its parameters") from error


@contextmanager
def one_of_a_kind() -> Iterator[None]:
    """Let a single training grasp of a material pass: it has no scatter about its mean, which is right."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Only one sample available")
        yield


def _centred(values: Floats) -> Floats:
    """Return values less their mean over the classes, the last axis: what all share does not decide."""
    return np.asarray(values - values.mean(axis=-1, keepdims=True))
