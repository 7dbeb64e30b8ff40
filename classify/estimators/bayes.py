r"""A Bayesian Gaussian classifier on the physics features, for a handful of training grasps.

The equations of a touch are linear, so the features of a grasp in kelvin are :math:`y = (\Delta T +
\delta)\, x + \epsilon` with the known difference :math:`\Delta T = T_{obj} - T_{skin}`, its error
:math:`\delta \sim N(0, \sigma_T^2)` (a warmer's setting is not the block's temperature), and noise
:math:`\epsilon \sim N(0, N)` that follows from the sensor's
(:func:`~thermogrip.classify.estimators.features.feature_noise`). The normalised features :math:`x` of
material :math:`m` scatter as :math:`x \sim N(\mu_m, \Sigma)` with one covariance for all materials, since
it comes from the grasping (contact, onset) and not from the block. To first order in the scatter,

.. math:: y \sim N(\Delta T \mu_m,\; \Delta T^2 \Sigma + \sigma_T^2 \mu_m \mu_m^T + N).

That is the features divided by :math:`\Delta T`, grasp by grasp, with noise :math:`N / \Delta T^2`, and
needs no division: a grasp at :math:`\Delta T` near 0 weighs little and spoils nothing. With conjugate priors

.. math:: \Sigma \sim IW(\nu_0, (\nu_0 - d - 1) I), \qquad \mu_m | \Sigma \sim N(0, \Sigma / \kappa_0)

on features scaled by their within-class spread, expectation maximisation finds the posterior of the means,
:math:`\Sigma` and :math:`\sigma_T`, and a new grasp is Student-t distributed: the uncertainty of a mean of
five grasps and of a covariance of twenty is in the answer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.special import expit, gammaln, logit, logsumexp, multigammaln

from thermogrip.classify.estimators import features
from thermogrip.classify.estimators.base import (
    Answered,
    Floats,
    GraspClassifier,
    Labels,
    level,
    named_arrays,
    normalised,
    pick,
    set_arrays,
    two_or_more,
)
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.limits import number_within
from thermogrip.datasets.schema import Grasps, log_name
from thermogrip.sysid.effusivity.data import object_range

_COVARIANCE_GRID = np.geomspace(0.5, 200.0, 25)  # nu_0 - d - 1, grasps
_MEAN_GRID = np.geomspace(0.001, 30.0, 16)  # kappa_0, grasps


@dataclass(frozen=True)
class DensitySettings:
    """What little is believed of features before the training, and how the search goes."""

    half_weight_K2: float = 4.0  # at 2 K the error of some 0.5 K is as large as the difference between metals
    least_weight: float = 0.5  # grasps; with less a material's normalised features are unknown
    t_object_sd_K: float = 0.5  # of a nominal object temperature
    sd_grasps: float = 4.0  # that this prior counts for
    steps: int = 100  # of the expectation maximisation
    still: float = 1e-5  # change that ends it
    drowned: float = 1e9  # in units of the scatter within a class: the noise of a feature that is missing
    # the end of a contact is a time of its own where it is so many times as late as the one before
    own_end: float = 1.4
    wide_sd_K: float = 2.0  # an object's temperature that is less certain is integrated over
    nodes: int = 21  # temperatures of that integral
    reach_sd: float = 2.5  # from the stated one, of that integral


DENSITY = DensitySettings()


@dataclass(frozen=True)
class Readings:
    """Features in kelvin of n grasps, what multiplies the normalised ones in them, and their noise."""

    y: Floats  # (n, d), NaN where a grasp lacks a feature
    # (n, d), the difference of temperature [K], NaN where the object's is unknown, 1 everywhere in kelvin
    gain: Floats
    noise: Floats  # (n, d, d)
    t_object_sd: Floats  # (n,) [K], NaN where no file has it
    difference: Floats  # (n,) [K] of the first sensor, NaN where the object's temperature is unknown

    def normalised(self) -> tuple[Floats, Floats]:
        """Return the features over their gain, (n, d), and their noise, (n, d, d); NaN within 1 K."""
        with np.errstate(divide="ignore", invalid="ignore"):
            x = self.y / self.gain
            sd = np.where(np.isfinite(self.t_object_sd), self.t_object_sd, DENSITY.t_object_sd_K)[:, None]
            off = np.where(self.gain == 1, 0.0, sd / self.gain) * x
            noise = self.noise / (self.gain[:, :, None] * self.gain[:, None, :]) + _outer(off)
        small = np.abs(self.difference) < features.LEAST_DIFFERENCE
        return np.where(small[:, None], np.nan, x), np.where(small[:, None, None], np.nan, noise)


class LearntFeatures(NamedTuple):
    """What training reads of its grasps."""

    reader: FeatureReader
    readings: Readings
    usable: NDArray[np.bool_]  # which grasps can be learnt from
    notes: list[str]  # the others, in words


@dataclass(eq=False)
class FeatureReader:
    """Which features a classifier was trained on, and how to read them again; a shorter contact has fewer,
    and those that it has are the same numbers."""

    names: list[str]
    normalise: bool
    end: float  # median end of the training grasps, up to 10 s

    @classmethod
    def learn(cls, records: Sequence[Grasps], labels: Labels) -> LearntFeatures:
        """Return a reader of the features that most grasps of any record have, and what it reads.

        Not learnt from are, where features are normalised, grasps of unknown temperature, and materials that
        were only touched at the skin's own.
        """
        end = min(float(np.median(np.concatenate([_last(record) for record in records]))), features.FIT_END)
        names, tables = [], []
        for record in records:
            table = features.linear_features(record, _times(record, end))
            mostly_known = np.isfinite(table.values).mean(axis=0) > 0.5
            names += [str(f) for f in table["feature"].values[mostly_known]]
            tables.append(table)
        names = sorted(set(names), key=_feature_order)
        if not names:
            where = "+".join(map(log_name, records))
            raise UserError("no feature is known for every grasp", file=where, hint="record longer")
        difference = np.concatenate([features.object_difference(record) for record in records])
        usable, notes = _usable(difference, labels)
        reader = cls(names, any(map(features.can_normalise, records)) and bool(usable.any()), end)
        if not reader.normalise:
            usable = np.ones(labels.size, dtype=bool)
        by_record = [
            reader._readings(record, table.reindex(feature=names)) for record, table in zip(records, tables)
        ]
        readings = {key: np.concatenate([getattr(p, key) for p in by_record]) for key in vars(by_record[0])}
        return LearntFeatures(reader, Readings(**readings), usable, notes)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-able description."""
        return {"features": self.names, "normalise": self.normalise, "end": self.end}

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> FeatureReader:
        """Return the reader that :meth:`to_dict` described."""
        if not all(name.startswith(features.KINDS) for name in content["features"]):
            raise ValueError("features of an earlier version")
        return cls(list(content["features"]), bool(content["normalise"]), float(content["end"]))

    def read(self, grasps: Grasps) -> Readings:
        """Return the features of other grasps."""
        times = sorted({_time(f) for f in self.names if f.endswith("s")})
        return self._readings(grasps, features.linear_features(grasps, times).sel(feature=self.names))

    def _readings(self, grasps: Grasps, table: xr.DataArray) -> Readings:
        y = np.asarray(table.values, dtype=float)
        n = y.shape[0]
        if not self.normalise:
            # in kelvin N and sigma_T vanish, and all is the textbook normal-inverse-Wishart algebra with V_m
            # = Sigma / (kappa_0 + n_m), Sigma = S_n / (nu_n - d + 1) and, W being the within-class scatter,
            # S_n = S_0 + W + sum_m kappa_0 n_m / (kappa_0 + n_m) mean_m mean_m^T
            noise, unknown = np.zeros((*y.shape, y.shape[1])), np.full(n, np.nan)
            return Readings(y, np.ones_like(y), noise, unknown, unknown)
        difference = features.object_difference(grasps)
        gain = np.repeat(difference[:, None], len(self.names), axis=1)
        noise = np.nan_to_num(features.feature_noise(grasps, self.names))  # none where nobody has a feature
        sd = grasps["t_object_sd"].values if "t_object_sd" in grasps else np.full(n, np.nan)
        return Readings(y, gain, noise, np.asarray(sd, dtype=float), difference)

    def check_temperatures(self, grasps: Grasps) -> None:
        """Raise UserError where a response cannot be compared for want of the difference behind it."""
        unknown = np.isnan(features.object_difference(grasps)) & self.normalise
        if unknown.any():
            raise UserError(
                f"grasp {str(grasps['grasp'].values[unknown][0])!r} has no object temperature, and the "
                "classifier was trained with them",
                file=log_name(grasps),
                hint="fill in t_object_nominal_degC, or train without that column",
            )


@dataclass(eq=False, repr=False)
class BayesClassifier(GraspClassifier):
    """Posterior-predictive Gaussian classifier on physics features (``"bayes"``).

    Records of several conditions, sample rates and lengths are learnt from together.  ``shrinkage_`` and
    ``mean_shrinkage_`` are what was used of nu_0 - d - 1 and kappa_0 [grasps], ``t_object_sd_`` by how much
    object temperatures were off their nominal ones [K].
    """

    learns_from_all_conditions: ClassVar[bool] = True

    shrinkage: float | None = None  # nu_0 - d - 1 [grasps]; by default the most evident of a grid
    prior_unknown: float = 0.1  # probability of a material that is not among the candidates

    def _learn(self, records: list[Grasps], labels_of: list[Labels]) -> None:
        if self.shrinkage is not None and not self.shrinkage > 0:
            raise UserError(f"shrinkage must be > 0 grasps, got {self.shrinkage}")
        labels = np.concatenate(labels_of)
        two_or_more(labels, "+".join(map(log_name, records)))
        learnt = FeatureReader.learn(records, labels)
        self.reader_, self.notes_, usable = learnt.reader, learnt.notes, learnt.usable
        self.feature_names_ = self.reader_.names
        self.classes_ = np.unique(labels[usable])
        self._fit_density(
            _rows_of_readings(learnt.readings, usable), np.searchsorted(self.classes_, labels[usable])
        )

    def _fit_density(self, read: Readings, at: NDArray[np.intp]) -> None:
        """Find means, covariance and the error of object temperatures; ``at`` is the class of each grasp."""
        k, (n, d) = self.classes_.size, read.y.shape
        has_feature = np.isfinite(read.y)
        square = np.where(read.gain == 1, read.difference[:, None], read.gain) ** 2
        clear = square / (square + DENSITY.half_weight_K2) if self.reader_.normalise else np.ones_like(square)
        weight = np.where(has_feature & (read.gain != 0), clear, 0.0)
        x = np.divide(read.y, read.gain, out=np.zeros_like(read.y), where=weight > 0)
        self.center_ = _weighted_mean(x, weight)
        means = np.array([_weighted_mean(x[at == m], weight[at == m], self.center_) for m in range(k)])
        self.scale_ = _within_class_sd(x, weight, means[at], self.center_)
        x = (np.where(has_feature, x, means[at]) - self.center_) / self.scale_
        self.shrinkage_, self.mean_shrinkage_ = self._shrinkages(x, weight.max(axis=1), at)
        y, noise = self._scaled(read)
        own_sd, knows_sd = read.t_object_sd, np.isfinite(read.t_object_sd)
        typical = DENSITY.t_object_sd_K if self.reader_.normalise else 0.0
        zero = self.center_ / self.scale_
        # A missing feature is one that noise drowns: its precision is 0, and so are its row and column.
        has_both = has_feature[:, :, None] & has_feature[:, None, :]
        noise = np.where(has_both, noise, DENSITY.drowned * np.eye(d))
        y, gain = np.where(has_feature, y, 0.0), np.where(has_feature, read.gain, 0.0)
        means, covariance = np.zeros((k, d)), np.eye(d)
        for _ in range(DENSITY.steps):
            sd = np.where(knows_sd, own_sd, typical)
            ray = np.where(has_feature, (means + zero)[at], 0.0) * (gain != 1)
            between = gain[:, :, None] * covariance * gain[:, None, :]
            precision = np.linalg.inv(between + noise + sd[:, None, None] ** 2 * _outer(ray))
            prior = self.mean_shrinkage_ * np.linalg.inv(covariance)
            before, spread = means, np.empty((k, d, d))
            means = np.empty((k, d))
            for m in range(k):
                g = at == m
                weighted = gain[g, :, None] * precision[g]
                spread[m] = np.linalg.inv(prior + np.sum(weighted * gain[g, None, :], axis=0))  # V_m
                means[m] = spread[m] @ np.einsum("gij,gj->i", weighted, y[g])
            pull = np.einsum("gij,gj->gi", precision, y - gain * means[at])
            scatter_mean = (gain * pull) @ covariance  # what each grasp is off its material, expected ...
            scatter_covariance = (
                covariance - covariance @ (gain[:, :, None] * precision * gain[:, None, :]) @ covariance
            )
            scatter = (
                scatter_mean.T @ scatter_mean
                + scatter_covariance.sum(axis=0)
                + self.mean_shrinkage_ * means.T @ means
            )
            new_covariance = (self.shrinkage_ * np.eye(d) + scatter) / (self.shrinkage_ + n + 2)
            off = sd**2 * np.sum(ray * pull, axis=1)  # ... and by how much its temperature is off
            off_var = sd**2 - sd**4 * np.einsum("gi,gij,gj->g", ray, precision, ray)
            moved = max(np.abs(new_covariance - covariance).max(), np.abs(means - before).max())
            covariance = new_covariance
            if self.reader_.normalise and not knows_sd.all():
                total = np.sum((off**2 + off_var)[~knows_sd]) + DENSITY.sd_grasps * DENSITY.t_object_sd_K**2
                typical = float(np.sqrt(total / (DENSITY.sd_grasps + np.sum(~knows_sd))))
            if moved < DENSITY.still:
                break
        informative = n - np.sum(np.linalg.inv(covariance) * scatter_covariance.sum(axis=0)) / d
        self.dof_ = float(self.shrinkage_ + informative + 2)  # nu_n - d + 1
        self.means_ = means
        self.mean_covariance_ = spread
        self.covariance_ = covariance
        self.t_object_sd_ = typical

    def _shrinkages(self, x: Floats, weight: Floats, at: NDArray[np.intp]) -> tuple[float, float]:
        """Return nu_0 - d - 1 and kappa_0 of the greatest evidence, from weighted normalised features."""
        counts = np.bincount(at, weight, self.classes_.size).astype(float)
        means = np.array([_weighted_mean(x[at == m], weight[at == m, None]) for m in range(counts.size)])
        residual = x - means[at]
        within = (weight[:, None] * residual).T @ residual
        grid = _COVARIANCE_GRID if self.shrinkage is None else np.array([self.shrinkage])
        tried = [
            (_log_evidence_of_feature(within, means, counts, s, k), s, k) for s in grid for k in _MEAN_GRID
        ]
        # kappa_0 is large where the materials do not differ
        _, shrinkage, mean_shrinkage = max(tried)
        return float(shrinkage), float(mean_shrinkage)

    def _scaled(self, read: Readings) -> tuple[Floats, Floats]:
        """Return features and noise in units of the scatter within a class, about the centre."""
        y = (read.y - read.gain * self.center_) / self.scale_
        return y, read.noise / np.outer(self.scale_, self.scale_)

    def _log_proba(self, grasps: Grasps) -> Floats:
        return self._log_density(grasps)[:, :-1]

    def _answered(self, grasps: Grasps, names: list[str]) -> Answered:
        columns, log_p = [self.asked().index(name) for name in names], self._log_density(grasps)
        # the mean density of the candidates beside that of a material that was not trained
        odds = logsumexp(log_p[:, columns], axis=1) - np.log(len(columns)) - log_p[:, -1]
        answered = Answered.nothing(len(log_p), len(names))
        unknown = np.asarray(expit(logit(self.prior_unknown) - odds))
        return answered._replace(log_p=normalised(log_p[:, columns]), p_unknown=unknown)

    def _log_density(self, grasps: Grasps) -> Floats:
        """Return the log density of each grasp under each class, and last under an unknown material,
        (n_grasp, n_class + 1)."""
        read = self.reader_.read(grasps)
        unknown = np.isnan(read.difference)
        wide = (unknown | (read.t_object_sd > DENSITY.wide_sd_K)) & self.reader_.normalise
        out = np.empty((wide.size, self.classes_.size + 1))
        out[~wide] = self._log_t_of(_rows_of_readings(read, ~wide))
        if not wide.any():
            return out
        # Of an unknown temperature the density is the mean of those at temperatures 2 K apart, up to 20 K
        # from the room's; where its stated sd is more than 2 K, the mean over that normal distribution.
        record = pick(grasps, wide)
        unknown = unknown[wide]
        some = _rows_of_readings(read, wide)
        low, high = object_range(record).T
        skin = level(record)
        centre = np.where(unknown, (low + high) / 2, skin + np.where(unknown, 0.0, some.difference))
        half = np.where(
            unknown, (high - low) / 2, DENSITY.reach_sd * np.where(unknown, 0.0, some.t_object_sd)
        )
        z = np.linspace(-1.0, 1.0, DENSITY.nodes)
        log_w = np.where(unknown[:, None], 0.0, -0.5 * (DENSITY.reach_sd * z) ** 2)
        log_w -= logsumexp(log_w, axis=1, keepdims=True)
        log_t_at = np.empty((DENSITY.nodes, *out[wide].shape))
        for k, (node, weight) in enumerate(zip(z, log_w.T)):
            gain = np.where(some.gain == 1, 1.0, (centre + node * half - skin)[:, None])
            sd = 0.6 * half * (z[1] - z[0])  # bells that wide, so far apart, add up to a smooth density
            log_t_at[k] = weight[:, None] + self._log_t_of(replace(some, gain=gain, t_object_sd=sd))
        out[wide] = logsumexp(log_t_at, axis=0)
        return out

    def _log_t_of(self, read: Readings) -> Floats:
        """Return :meth:`_log_density` of grasps whose objects' temperatures are known."""
        y, noise = self._scaled(read)
        sd = np.where(np.isfinite(read.t_object_sd), read.t_object_sd, self.t_object_sd_)
        k, zero = self.classes_.size, self.center_ / self.scale_
        # The mean of a material that was not trained is drawn as those of the k trained ones were, from
        # N(middle, B) with B = (k + 1) / (k (k - 1)) sum (mu_m - middle)(mu_m - middle)^T, so that its grasps
        # are Student-t distributed with k - 1 degrees of freedom and scale gain^2 (B + Sigma) + N.
        middle = self.means_.mean(axis=0)
        off = self.means_ - middle
        strange = (k + 1) / (k * (k - 1)) * off.T @ off
        kinds = [
            (mean, covariance, self.dof_) for mean, covariance in zip(self.means_, self.mean_covariance_)
        ]
        out = np.zeros((y.shape[0], k + 1))
        # a feature that a grasp does not have (a response at 40 s in one of 10 s) is marginalised
        for has in np.unique(np.isfinite(y), axis=0):
            rows = (np.isfinite(y) == has).all(axis=1)
            gain, y_has = read.gain[np.ix_(rows, has)], y[np.ix_(rows, has)]
            noise_known = noise[rows][:, has][:, :, has]
            for m, (mean, mean_covariance, dof) in enumerate([*kinds, (middle, strange, k - 1.0)]):
                ray = (mean + zero)[has] * (gain != 1)
                block = (self.covariance_ + mean_covariance)[np.ix_(has, has)]
                # gain^2 (Sigma + V_m) + sd^2 mu_m mu_m^T + N
                scale = gain[:, :, None] * block * gain[:, None, :] + noise_known
                scale += sd[rows, None, None] ** 2 * _outer(ray)
                out[rows, m] = _log_t(y_has - gain * mean[has], scale, dof)
        return out

    def get_state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        numbers = self.reader_.to_dict() | {
            "dof": self.dof_,
            "shrinkage": self.shrinkage_,
            "mean_shrinkage": self.mean_shrinkage_,
            "t_object_sd": self.t_object_sd_,
        }
        return numbers, named_arrays(self, ("center_", "scale_", "means_", "covariance_", "mean_covariance_"))

    def set_state(self, numbers: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
        """Take up what :meth:`get_state` returned."""
        self.reader_ = FeatureReader.from_dict(numbers)
        self.feature_names_ = self.reader_.names
        self.dof_, self.shrinkage_ = float(numbers["dof"]), float(numbers["shrinkage"])
        self.mean_shrinkage_ = float(numbers["mean_shrinkage"])
        self.t_object_sd_ = number_within(numbers, "t_object_sd", 0.0, 1e3)
        n, k = len(self.feature_names_), self.classes_.size
        square = {"covariance_": (n, n), "mean_covariance_": (k, n, n)}
        set_arrays(self, arrays, center_=(n,), scale_=(n,), means_=(k, n), **square)


def _usable(difference: Floats, labels: Labels) -> tuple[NDArray[np.bool_], list[str]]:
    """Return which grasps have normalised features of at least two materials, and in words which have not."""
    clear = np.abs(difference) >= features.LEAST_DIFFERENCE
    weight = np.where(clear, difference**2 / (difference**2 + DENSITY.half_weight_K2), 0.0)
    seen_materials = [str(m) for m in np.unique(labels) if weight[labels == m].sum() >= DENSITY.least_weight]
    if len(seen_materials) < 2:
        return np.zeros(labels.size, dtype=bool), [
            "features stay in kelvin: object temperatures are unknown, or within 1 K of the skin's"
        ]
    usable, notes = np.isfinite(difference) & np.isin(labels, seen_materials), []
    if lost := [str(m) for m in np.unique(labels) if m not in seen_materials]:
        notes.append(f"{', '.join(lost)} left out: no object of known temperature 1 K from the skin's")
    unknown = int(np.sum(np.isin(labels, seen_materials) & ~np.isfinite(difference)))
    if unknown:
        notes.append(f"{unknown} grasps left out: their object temperature is unknown")
    return usable, notes


def _rows_of_readings(read: Readings, at: NDArray[np.bool_]) -> Readings:
    return Readings(**{key: value[at] for key, value in vars(read).items()})


def _times(grasps: Grasps, end: float) -> list[float]:
    """Return when a response is read of the contacts of a record [s], an ``end`` that is late among these."""
    times = [t for t in features.RESPONSE_TIMES if t <= float(grasps["time"].values[-1]) + 0.05]
    before = max([t for t in times if t <= end + 0.05], default=0.0)
    return sorted([*times, round(end, 2)]) if end > DENSITY.own_end * before else times


def _feature_order(name: str) -> tuple[int, float]:
    """Return the place of a feature: in the order of the table, responses by time."""
    kind = next(i for i, prefix in enumerate(features.KINDS) if name.startswith(prefix))
    return kind, _time(name) if name.endswith("s") else 0.0


def _time(name: str) -> float:
    """Return when a response is read after the onset [s]."""
    return float(name.rpartition("_")[2][:-1])


def _last(grasps: Grasps) -> Floats:
    """Return when each trace was last read [s], (n_grasp,)."""
    has_sample = np.isfinite(grasps["t_surface"].values)
    return np.asarray(np.where(has_sample, grasps["time"].values, -np.inf).max(axis=1))


def _weighted_mean(x: Floats, weight: Floats, otherwise: Floats | float = 0.0) -> Floats:
    """Return the weighted mean over grasps, or something else where nothing weighs anything."""
    total = weight.sum(axis=0)
    mean = np.sum(weight * x, axis=0) / np.where(total > 0, total, 1.0)
    return np.asarray(np.where(total > 0, mean, otherwise))


def _within_class_sd(x: Floats, weight: Floats, means: Floats, center: Floats) -> Floats:
    total = weight.sum(axis=0)
    freedom = np.maximum(total - np.unique(means, axis=0).shape[0], 1)
    sd = np.sqrt(np.sum(weight * (x - means) ** 2, axis=0) / freedom)
    # One grasp a material has no within-class spread: the spread of all grasps is used.
    spread = np.sqrt(_weighted_mean((x - center) ** 2, weight))
    return np.asarray(np.where(sd > 1e-12, sd, np.where(spread > 0, spread, 1.0)))


def _outer(rows: Floats) -> Floats:
    return np.asarray(rows[:, :, None] * rows[:, None, :])


def _log_evidence_of_feature(
    within: Floats, means: Floats, counts: Floats, extra: float, kappa: float
) -> float:
    """Return ln p(features) but for a constant; ``extra`` is nu_0 - d - 1."""
    d, n = within.shape[0], float(counts.sum())
    prior = d + 1 + extra
    scatter = within + np.einsum("m,mi,mj->ij", kappa * counts / (kappa + counts), means, means)
    total = np.linalg.slogdet(extra * np.eye(d) + scatter)[1]
    # nu_0 / 2 ln|S_0| - nu_n / 2 ln|S_n| + ln Gamma_d(nu_n / 2) - ln Gamma_d(nu_0 / 2) + d / 2 sum_m ln
    # kappa_0 / (kappa_0 + n_m)
    return float(
        0.5 * prior * d * np.log(extra)
        - 0.5 * (prior + n) * total
        + multigammaln(0.5 * (prior + n), d)
        - multigammaln(0.5 * prior, d)
        + 0.5 * d * np.sum(np.log(kappa / (kappa + counts)))
    )


def _log_t(x: Floats, scale: Floats, dof: float) -> Floats:
    """Return the log density of a multivariate t at each row of ``x``, each with its own scale (n, d, d)."""
    d = x.shape[1]
    if d == 0:
        return np.zeros(x.shape[0])
    distance = np.sum(x * np.linalg.solve(scale, x[:, :, None])[:, :, 0], axis=1)
    norm = gammaln(0.5 * (dof + d)) - gammaln(0.5 * dof) - 0.5 * d * np.log(np.pi * dof)
    return np.asarray(norm - 0.5 * np.linalg.slogdet(scale)[1] - 0.5 * (dof + d) * np.log1p(distance / dof))
