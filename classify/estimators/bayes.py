r"""A Bayesian Gaussian classifier on the physics features, for a handful of training grasps.

Features of material :math:`m` scatter as :math:`x \sim N(\mu_m, \Sigma)` with one covariance for all
materials, since it comes from the grasping (contact, object temperature, onset) and not from the block.  With
conjugate priors

.. math:: \Sigma \sim IW(\nu_0, (\nu_0 - d - 1) I), \qquad \mu_m | \Sigma \sim N(0, \Sigma / \kappa_0)

on features scaled by their within-class spread, everything integrates exactly.  From n grasps of K materials

.. math:: \nu_n = \nu_0 + n, \quad
          S_n = S_0 + W + \sum_m \frac{\kappa_0 n_m}{\kappa_0 + n_m} \bar x_m \bar x_m^T,

(:math:`W` the within-class scatter) a new grasp of material :math:`m` is Student-t distributed with
:math:`\nu_n - d + 1` degrees of freedom, mean :math:`n_m \bar x_m / (\kappa_0 + n_m)` and scale
:math:`S_n (1 + 1/(\kappa_0 + n_m)) / (\nu_n - d + 1)`: the uncertainty of a mean of five grasps and of a
covariance of twenty is in the answer, not only in a footnote.  The two shrinkages, :math:`\nu_0` of the
covariance and :math:`\kappa_0` of the means (large where the materials do not differ, as at equal
temperatures), maximise the evidence

.. math:: \ln p(X) = \tfrac{\nu_0}{2} \ln|S_0| - \tfrac{\nu_n}{2} \ln|S_n| + \ln\Gamma_d(\nu_n / 2)
          - \ln\Gamma_d(\nu_0 / 2) + \tfrac{d}{2} \sum_m \ln \frac{\kappa_0}{\kappa_0 + n_m} + const.

A feature that a grasp does not have (a response at 40 s in one of 10 s) is marginalised: the t distribution
of the others remains.  All of it is the textbook normal-inverse-Wishart algebra with one scatter matrix for
several means.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.special import gammaln, multigammaln

from thermogrip.classify.estimators.base import HELD_AT_AN_END, Floats, JoinedClassifier, Labels, check_shapes
from thermogrip.classify.estimators.features import (
    FIT_END,
    MATERIAL_FEATURES,
    can_normalise,
    extract_features,
)
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps, log_name

__all__ = ["BayesClassifier", "FeatureReader"]

_COVARIANCE_GRID = np.geomspace(0.5, 200.0, 25)  # nu_0 - d - 1, grasps
_MEAN_GRID = np.geomspace(0.001, 30.0, 16)  # kappa_0, grasps


class FeatureReader:
    """Which features a classifier was trained on, and how to read them again.

    Features come from a rise that is fitted to the whole of a contact, up to 10 s: of a shorter contact they
    are other numbers, and a classifier that was asked about them was right in 0.2 to 0.5 of 300 simulated
    grasps and said 0.7 to 1.0.  So a contact that is shorter than those of the training is refused.

    Parameters
    ----------
    names : list of str
    normalise : bool
    end : float
        Until when the training grasps were read (their median), up to 10 s [s].
    """

    def __init__(self, names: list[str], normalise: bool, end: float) -> None:
        self.names, self.normalise, self.end = names, normalise, end

    @classmethod
    def learn(cls, grasps: Grasps) -> tuple[FeatureReader, Floats]:
        """Return a reader of every feature that all of these grasps have, and their features."""
        normalise = can_normalise(grasps)
        table = extract_features(grasps, normalise=normalise)
        names = [str(f) for f in table["feature"].values if str(f).startswith(MATERIAL_FEATURES)]
        names = [f for f in names if np.isfinite(table.sel(feature=f).values).all()]
        if not names:
            raise UserError(
                "no feature is known for every grasp", file=log_name(grasps), mend="record longer"
            )
        return cls(names, normalise, min(float(np.median(_last(grasps))), FIT_END)), cls._values(table, names)

    def read(self, grasps: Grasps) -> Floats:
        """Return the features of other grasps, shape (n_grasp, n_feature), NaN where they have none.

        Raises
        ------
        UserError
            If a contact is more than half a second shorter than those of the training.
        """
        last = _last(grasps)
        if (last < self.end - HELD_AT_AN_END).any():
            i = int(last.argmin())
            raise UserError(
                f"grasp {str(grasps['grasp'].values[i])!r} ends at {last[i]:g} s, "
                f"the classifier was trained on contacts of {self.end:g} s",
                file=log_name(grasps),
                mend="leave it out, or train on contacts of that length",
            )
        times = [float(f[len("response_") : -1]) for f in self.names if f.startswith("response_")]
        if self.normalise:
            self._check_temperatures(grasps)
        table = extract_features(grasps, normalise=self.normalise, times=times)
        return self._values(table, self.names)

    @staticmethod
    def _check_temperatures(grasps: Grasps) -> None:
        """Raise UserError where a response cannot be divided by the difference that it was trained with."""
        ids, n = grasps["grasp"].values, grasps.sizes["grasp"]
        t_object = grasps["t_object"].values if "t_object" in grasps else np.full(n, np.nan)
        if np.isnan(t_object).any():
            first = str(ids[np.isnan(t_object)][0])
            raise UserError(
                f"grasp {first!r} has no object temperature, and the classifier was trained with them",
                file=log_name(grasps),
                mend="fill in t_object_nominal_degC, or train without that column",
            )

    @staticmethod
    def _values(table: xr.DataArray, names: list[str]) -> Floats:
        return np.asarray(table.sel(feature=names).values, dtype=float)


class BayesClassifier(JoinedClassifier):
    """Posterior-predictive Gaussian classifier on physics features (``"bayes"``).

    Parameters
    ----------
    shrinkage : float, optional
        Prior degrees of freedom beyond d + 1, in grasps; by default the most evident of a grid.

    Attributes
    ----------
    classes_ : (K,) ndarray of str
    feature_names_ : list of str
    shrinkage_, mean_shrinkage_ : float
        What was used of nu_0 - d - 1 and kappa_0 [grasps].
    """

    fits_in_a_blink: ClassVar[bool] = True

    def __init__(self, shrinkage: float | None = None) -> None:
        self.shrinkage = shrinkage

    def _fit(self, grasps: Grasps, labels: Labels) -> None:
        if self.shrinkage is not None and not self.shrinkage > 0:
            raise UserError(f"shrinkage must be > 0 grasps, got {self.shrinkage}")
        self.reader_, x = FeatureReader.learn(grasps)
        self.feature_names_ = self.reader_.names
        self.center_ = x.mean(axis=0)
        self.scale_ = _within_class_sd(x, labels)
        z = (x - self.center_) / self.scale_
        counts = np.array([np.sum(labels == c) for c in self.classes_], dtype=float)
        means = np.array([z[labels == c].mean(axis=0) for c in self.classes_])
        residual = np.concatenate([z[labels == c] - mean for c, mean in zip(self.classes_, means)])
        within = residual.T @ residual
        grid = _COVARIANCE_GRID if self.shrinkage is None else np.array([self.shrinkage])
        tried = [(_log_evidence(within, means, counts, s, k), s, k) for s in grid for k in _MEAN_GRID]
        _, self.shrinkage_, self.mean_shrinkage_ = max(tried)
        n, d = z.shape
        self.dof_ = float(self.shrinkage_ + n + 2)  # nu_n - d + 1
        self.means_ = means * (counts / (self.mean_shrinkage_ + counts))[:, None]
        scatter = _scatter(within, means, counts, self.mean_shrinkage_)
        self.covariance_ = (self.shrinkage_ * np.eye(d) + scatter) / self.dof_
        self.widening_ = 1 + 1 / (self.mean_shrinkage_ + counts)

    def _log_proba(self, grasps: Grasps) -> Floats:
        z = (self.reader_.read(grasps) - self.center_) / self.scale_
        out = np.zeros((z.shape[0], self.classes_.size))
        for has in np.unique(np.isfinite(z), axis=0):
            rows = (np.isfinite(z) == has).all(axis=1)
            block = self.covariance_[np.ix_(has, has)]
            for m, widening in enumerate(self.widening_):
                out[rows, m] = _log_t(z[rows][:, has] - self.means_[m, has], block * widening, self.dof_)
        return out

    def get_state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Return what ``fit`` learnt: numbers, and named arrays."""
        numbers = {
            "features": self.feature_names_,
            "normalise": self.reader_.normalise,
            "end": self.reader_.end,
            "dof": self.dof_,
            "shrinkage": self.shrinkage_,
            "mean_shrinkage": self.mean_shrinkage_,
        }
        keys = ("center_", "scale_", "means_", "covariance_", "widening_")
        return numbers, {key: np.asarray(getattr(self, key)) for key in keys}

    def set_state(self, numbers: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
        """Take up what :meth:`get_state` returned."""
        self.feature_names_ = list(numbers["features"])
        self.reader_ = FeatureReader(self.feature_names_, bool(numbers["normalise"]), float(numbers["end"]))
        self.dof_, self.shrinkage_ = float(numbers["dof"]), float(numbers["shrinkage"])
        self.mean_shrinkage_ = float(numbers["mean_shrinkage"])
        n, k = len(self.feature_names_), self.classes_.size
        check_shapes(arrays, center_=(n,), scale_=(n,), means_=(k, n), covariance_=(n, n), widening_=(k,))
        for key in ("center_", "scale_", "means_", "covariance_", "widening_"):
            setattr(self, key, arrays[key])


def _last(grasps: Grasps) -> Floats:
    """Return when each trace was last read [s], (n_grasp,)."""
    seen = np.isfinite(grasps["t_surface"].values)
    return np.asarray(np.where(seen, grasps["time"].values, -np.inf).max(axis=1))


def _within_class_sd(x: Floats, labels: Labels) -> Floats:
    residual = np.concatenate([x[labels == c] - x[labels == c].mean(axis=0) for c in np.unique(labels)])
    freedom = max(x.shape[0] - np.unique(labels).size, 1)
    sd = np.sqrt(np.sum(residual**2, axis=0) / freedom)
    # One grasp a material has no within-class spread: the spread of all grasps stands in for it.
    fallback = np.where(x.std(axis=0) > 0, x.std(axis=0), 1.0)
    return np.asarray(np.where(sd > 1e-12, sd, fallback))


def _scatter(within: Floats, means: Floats, counts: Floats, kappa: float) -> Floats:
    return np.asarray(within + np.einsum("m,mi,mj->ij", kappa * counts / (kappa + counts), means, means))


def _log_evidence(within: Floats, means: Floats, counts: Floats, extra: float, kappa: float) -> float:
    """Return ln p(features) but for a constant; ``extra`` is nu_0 - d - 1."""
    d, n = within.shape[0], float(counts.sum())
    prior = d + 1 + extra
    total = np.linalg.slogdet(extra * np.eye(d) + _scatter(within, means, counts, kappa))[1]
    return float(
        0.5 * prior * d * np.log(extra)
        - 0.5 * (prior + n) * total
        + multigammaln(0.5 * (prior + n), d)
        - multigammaln(0.5 * prior, d)
        + 0.5 * d * np.sum(np.log(kappa / (kappa + counts)))
    )


def _log_t(x: Floats, scale: Floats, dof: float) -> Floats:
    """Return the log density of a multivariate t at each row of ``x``; 0 where there is no feature."""
    d = x.shape[1]
    if d == 0:
        return np.zeros(x.shape[0])
    distance = np.sum(x * np.linalg.solve(scale, x.T).T, axis=1)
    norm = gammaln(0.5 * (dof + d)) - gammaln(0.5 * dof) - 0.5 * d * np.log(np.pi * dof)
    return np.asarray(norm - 0.5 * np.linalg.slogdet(scale)[1] - 0.5 * (dof + d) * np.log1p(distance / dof))
