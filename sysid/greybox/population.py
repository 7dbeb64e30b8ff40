r"""Rigs of one kind: how far each parameter differs from rig to rig, and what that says of one of them.

Each rig is fitted by itself.  In units of the network's prior, z = (theta - theta_prior) / sd_prior, the fit
leaves z_i with covariance S_i, the prior N(0, 1) included.  Its logs alone are a likelihood of precision
:math:`\Lambda_i = S_i^{-1} - 1` and information :math:`\eta_i = S_i^{-1} z_i`, in the directions in which
S_i is narrower than the prior; others say nothing.

The population is normal, z ~ N(mu, T) with T diagonal, and mu has the network's prior.  Given T,

.. math::

   V_i = (\Lambda_i + T^{-1})^{-1}, \quad b_i = V_i (\eta_i + T^{-1} \mu), \quad
   C = (1 + \sum T^{-1} - T^{-1} V_i T^{-1})^{-1}, \quad \mu = C \sum T^{-1} V_i \eta_i.

**Spread.** EM with mu integrated out (REML): with A_i = V_i / T - 1,

.. math:: T \leftarrow \frac{1}{N - 1} \sum_i \mathrm{diag}\, [V_i + A_i C A_i' + (b_i - \mu)^2].

N - 1 in place of N is a gamma(2) prior on the standard deviation, which keeps a small population from being
found of one piece [1]_.

**A new rig** is N(mu, T + C), with Student's t of N - 1 degrees of freedom for its intervals: with three rigs
those are half as wide again.  That is the prior for the next rig (`identify --prior`), and b_i, V_i is what
all rigs together say of one (partial pooling).

**A temperature** (of the room) is no part of a rig: each has its own, with the prior of the network, that is
integrated out, and the population says nothing of it.

**A rig that is ill** is far from what the others predict.  With the eigenvectors of its
:math:`\Lambda_i = U l U'`, its information :math:`w = l^{-1/2} U' \eta_i` is N(F' mu, 1 + F' (T + C) F),
F = U l^{1/2}, of the population of the others.  The squared distance over its r dimensions is compared with
an F distribution of r and N - 2 degrees of freedom, and its farthest parameter with Student's t of N - 2,
times the number of parameters: one that is far off may be lost among others that are not.  Twice the smaller
of both, times the number of rigs, is the chance of such a rig in a healthy fleet.  Its plant is that of its
own logs, and the population is that of the others, while three are left.

References
----------
.. [1] Y. Chung et al., "A nondegenerate penalized likelihood estimator for variance parameters in multilevel
   models", Psychometrika 78 (2013) 685.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import f as f_law
from scipy.stats import t as t_law

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.atomic_files import read_json, write_json
from thermogrip.datasets.errors import UserError
from thermogrip.sysid.models.network import NetworkModel
from thermogrip.sysid.models.network_spec import Parameter
from thermogrip.sysid.plant.plant import Plant

SCHEMA, VERSION = "thermogrip.population", 1
LEAST_RIGS = 3
_SEEN = 1e-3  # of the prior's precision: what logs say less about is not counted as told
ROUNDS, STILL = 500, 1e-4
_FIRST = 0.25  # of the prior's variance, where EM begins
MISFIT = 3.0  # times the median error of the fleet's fits
ILL = 0.05  # chance that one of a healthy fleet is as far off


class Told(NamedTuple):
    """What the logs of n rigs say, in units of the prior."""

    precision: Array  # (n, k, k)
    information: Array  # (n, k)


class _Pooled(NamedTuple):
    """A population and its rigs, in units of the prior."""

    mean: Array  # (k,)
    variance: Array  # (k,), from rig to rig
    unsure: Array  # (k, k), covariance of the mean
    rigs: Array  # (n, k)
    covariances: Array  # (n, k, k)


@dataclass(frozen=True)
class Population:
    """Where the parameters of rigs of one kind lie: theta is the logarithm of a ``"log"`` parameter.

    Parameters
    ----------
    network : str
        Name of the network that was fitted.
    parameters : tuple of str
        The free ones, in the order of the tuples below.
    scales : tuple of str
        ``"log"`` or ``"linear"`` of each.
    mean, spread, mean_sd : tuple of float
        Of theta: the mean, the standard deviation from rig to rig, and how well the mean is known.
    rigs : tuple of str
        Names of the rigs.

    Examples
    --------
    >>> rooms = Population("room", ("G_amb",), ("log",), (0.0,), (0.3,), (0.1,), ("a", "b", "c", "d"))
    >>> low, high = rooms.intervals(0.9)["G_amb"]
    >>> round(low, 2), round(high, 2)
    (0.48, 2.1)
    """

    network: str
    parameters: tuple[str, ...]
    scales: tuple[str, ...]
    mean: tuple[float, ...]
    spread: tuple[float, ...]
    mean_sd: tuple[float, ...]
    rigs: tuple[str, ...]

    @property
    def sd(self) -> Array:
        """Standard deviation (k,) of theta of a new rig, of Student's t as its scale."""
        return np.hypot(self.spread, self.mean_sd)

    def natural(self, theta: Array) -> Array:
        """Return parameters (..., k) in their units."""
        logs = np.array(self.scales) == "log"
        return np.where(logs, np.exp(np.where(logs, theta, 0.0)), theta)

    def intervals(self, level: float = 0.9) -> dict[str, tuple[float, float]]:
        """Return the interval of probability ``level`` for each parameter of a new rig, in natural units."""
        half = t_law.ppf(0.5 + level / 2, len(self.rigs) - 1) * self.sd
        low, high = self.natural(np.array(self.mean) - half), self.natural(np.array(self.mean) + half)
        return {name: (float(a), float(b)) for name, a, b in zip(self.parameters, low, high)}

    def prior_of(self, model: NetworkModel) -> NetworkModel:
        """Return the network with the population in place of its priors; UserError if it is of another."""
        specs, known = dict(model.network.parameters), dict(zip(self.parameters, range(len(self.parameters))))
        free = {name for name, spec in specs.items() if not spec.fixed}
        odd_ones = {name for name in free ^ set(known) if name not in free or is_of_rig(specs[name])}
        if odd_ones:
            odd = ", ".join(sorted(odd_ones))
            problem = (
                f"the population is of network {self.network!r}, {model.network.name!r} differs in {odd}"
            )
            raise UserError(problem, hint=f"--network {self.network}")
        # the variance of Student's t, which three rigs have not: twice its scale then
        dof = len(self.rigs) - 1
        wide = np.sqrt(dof / (dof - 2)) if dof > 2 else 2.0
        values = self.natural(np.array(self.mean))
        for name, k in known.items():
            if not is_of_rig(specs[name]):
                continue
            low, high = specs[name].bounds
            value, sd = float(np.clip(values[k], low, high)), float(wide * self.sd[k])
            specs[name] = _with_prior(specs[name], value, sd)
        return NetworkModel(model.network.model_copy(update={"parameters": specs}))

    def save(self, path: str | Path) -> Path:
        """Write the population as JSON and return its path."""
        return write_json(path, vars(self), schema=SCHEMA, version=VERSION)

    @classmethod
    def load(cls, path: str | Path) -> Population:
        """Read a population; UserError for another file."""
        content = read_json(path, SCHEMA, VERSION)
        names = ("parameters", "scales", "mean", "spread", "mean_sd", "rigs")
        try:
            parts = {name: tuple(content[name]) for name in names}
            numbers = np.array([parts[name] for name in ("mean", "spread", "mean_sd")], dtype=float)
            sizes = {len(parts[name]) for name in names[:-1]}
            if len(sizes) > 1 or not np.isfinite(numbers).all() or (numbers[1:] <= 0).any():
                raise ValueError("its numbers do not belong together")
            if len(parts["rigs"]) < LEAST_RIGS or not set(parts["scales"]) <= {"log", "linear"}:
                raise ValueError("rigs or scales are wrong")
            return cls(str(content["network"]), **parts)
        except (KeyError, TypeError, ValueError) as error:
            problem = f"is no whole population ({type(error).__name__}: {error})"
            raise UserError(problem, file=path, hint="make it again with fleet") from error


def check_population(path: str | Path) -> None:
    """Refuse what is no population."""
    Population.load(path)


class Rig(NamedTuple):
    """One rig against the population of the others."""

    name: str
    pooled: Array  # theta by all rigs together, of the plant's free parameters
    covariance: Array  # of that
    deviation: Array  # (k,) of its own fit from the others' mean, in sd, of the population's parameters
    distance: float  # squared, per dimension; about 1 of a healthy rig
    chance: float  # of a rig as far off or farther, if all were healthy
    others: Population

    @property
    def ill(self) -> bool:
        """Whether fewer than one healthy fleet of twenty has such a rig."""
        return self.chance < ILL


def pool_rigs(plants: Mapping[str, Plant]) -> tuple[Population, tuple[Rig, ...]]:
    """Return the population of the healthy rigs and each rig against that of the others.

    Parameters
    ----------
    plants : mapping of str to Plant
        Fits of one network to the logs of each rig, by its name.

    Raises
    ------
    UserError
        If there are fewer than three rigs, or their plants are not fits of one thermal network.
    """
    if len(plants) < LEAST_RIGS:
        raise UserError(f"{len(plants)} rigs make no population", hint=f"give {LEAST_RIGS} at least")
    names, first = tuple(plants), next(iter(plants.values()))
    model = first.model
    for name, plant in plants.items():
        if not isinstance(plant.model, NetworkModel) or plant.covariance is None or plant.free != first.free:
            raise UserError(f"rig {name} has no fit of the others' thermal network", hint="leave it out")
    assert isinstance(model, NetworkModel)
    specs = [model.specs[name] for name in first.free]
    centre, width = prior_units(specs)
    z, S = in_prior_units(plants.values(), centre, width)
    own = np.array([is_of_rig(spec) for spec in specs])
    if not own.any():
        raise UserError(f"network {model.network.name!r} has no free parameter of a rig", hint="free one")
    told = told_by(z[:, own], S[:, own][:, :, own])
    variance = _pool(told).variance
    against = [against_others(told, z[i, own], S[i][np.ix_(own, own)], i, variance) for i in range(len(z))]
    ill = np.array([chance < ILL for *_, chance in against])
    kept = ~ill if (~ill).sum() >= LEAST_RIGS else np.full(ill.size, True)
    whole = _pool(Told(told.precision[kept], told.information[kept]), variance)

    def population(found: _Pooled, rigs: Sequence[str]) -> Population:
        mean, spread = centre[own] + width[own] * found.mean, width[own] * np.sqrt(found.variance)
        sure = width[own] * np.sqrt(np.diagonal(found.unsure))
        parts = [(name, spec.scale) for name, spec, part in zip(first.free, specs, own) if part]
        return Population(
            str(model.network.name), tuple(name for name, _ in parts), tuple(scale for _, scale in parts),
            tuple(mean.tolist()), tuple(spread.tolist()), tuple(sure.tolist()), tuple(rigs),
        )  # fmt: skip

    # what is no part of a rig keeps the network's prior
    mean, precision = np.zeros(own.size), np.ones(own.size)
    mean[own], precision[own] = whole.mean, 1 / whole.variance
    everything = told_by(z, S)
    rigs = []
    for i, name in enumerate(names):
        others, off, distance, chance = against[i]
        theta, covariance = z[i], S[i]
        if kept[i]:
            covariance = np.linalg.inv(everything.precision[i] + np.diag(precision))
            theta = covariance @ (everything.information[i] + precision * mean)
        of_others = population(others, [other for other in names if other != name])
        pooled, covariance = centre + width * theta, covariance * np.outer(width, width)
        rigs.append(Rig(name, pooled, covariance, off, distance, chance, of_others))
    return population(whole, [name for name, keep in zip(names, kept) if keep]), tuple(rigs)


def against_others(
    told: Told, z: Array, S: Array, i: int, start: Array | None = None
) -> tuple[_Pooled, Array, float, float]:
    """Return the population without rig ``i``, and deviation, distance and chance of that :class:`Rig`, whose
    fit is ``z`` (k,) with covariance ``S`` (k, k)."""
    n = len(told.information)
    rest = np.arange(n) != i
    others = _pool(Told(told.precision[rest], told.information[rest]), start)
    spread = np.diag(others.variance) + others.unsure
    off = (z - others.mean) / np.sqrt(np.diagonal(S + spread))
    distance, of_all = _distance(told.precision[i], told.information[i], others, n - 2)
    of_one = 2 * off.size * float(t_law.sf(np.abs(off).max(), n - 2))
    return others, off, distance, min(1.0, 2 * n * min(of_all, of_one))


def is_of_rig(spec: Parameter) -> bool:
    """Return whether a parameter is a rig's own: a temperature is that of the room."""
    return spec.unit != "degC"


def prior_units(specs: Sequence[Parameter]) -> tuple[Array, Array]:
    """Return where theta is 0 and by how much it is 1 (k,) in units of the prior of these parameters."""
    centre = np.array([np.log(s.value) if s.scale == "log" else s.value for s in specs])
    width = np.array([s.sd_log if s.sd_log is not None else s.sd for s in specs], dtype=float)
    return centre, width


def in_prior_units(plants: Iterable[Plant], centre: Array, width: Array) -> tuple[Array, Array]:
    """Return theta (n, k) of fits and its covariances (n, k, k) in units of the prior."""
    fits = list(plants)
    z = (np.array([plant.theta for plant in fits]) - centre) / width
    return z, np.array([plant.covariance for plant in fits]) / np.outer(width, width)


def _with_prior(spec: Parameter, value: float, sd: float) -> Parameter:
    return spec.model_copy(update={"value": value, "sd_log" if spec.scale == "log" else "sd": sd})


def told_by(z: Array, S: Array) -> Told:
    """Return what logs alone say, from fits with the prior."""
    size, axes = np.linalg.eigh(S)
    size = np.maximum(size, 1e-12)
    seen = 1 / size - 1 > _SEEN
    along = np.einsum("nji,nj->ni", axes, z) / size
    precision = np.einsum("nij,nj,nkj->nik", axes, np.where(seen, 1 / size - 1, 0.0), axes)
    return Told(precision, np.einsum("nij,nj->ni", axes, np.where(seen, along, 0.0)))


def _pool(told: Told, start: Array | None = None) -> _Pooled:
    """Return the population by EM."""
    n, k = told.information.shape
    T = np.full(k, _FIRST) if start is None else start
    for _ in range(ROUNDS):
        found = _given(told, T)
        A = found.covariances / T - np.eye(k)
        unsure = np.einsum("nij,jl,nil->ni", A, found.unsure, A)
        own = np.diagonal(found.covariances, axis1=1, axis2=2)
        renewed = (own + unsure + (found.rigs - found.mean) ** 2).sum(axis=0) / (n - 1)
        moved, T = np.abs(np.log(renewed / T)).max(), renewed
        if moved < STILL:
            break
    return _given(told, T)


def _given(told: Told, T: Array) -> _Pooled:
    """Return mean and rigs of a population with the variances ``T``."""
    V = np.linalg.inv(told.precision + np.diag(1 / T))
    own = np.einsum("nij,nj->ni", V, told.information)
    weight = len(V) * np.diag(1 / T) - V.sum(axis=0) / np.outer(T, T)
    C = np.linalg.inv(np.eye(T.size) + weight)
    mean = C @ (own.sum(axis=0) / T)
    return _Pooled(mean, T, C, np.asarray(own + V @ (mean / T)), np.asarray(V))


def _distance(precision: Array, information: Array, others: _Pooled, dof: int) -> tuple[float, float]:
    """Return the squared distance per dimension of a rig from the others, and the chance of a larger one."""
    size, axes = np.linalg.eigh(precision)
    seen = size > _SEEN
    if not seen.any():
        return 1.0, 1.0
    F = axes[:, seen] * np.sqrt(size[seen])
    off = axes[:, seen].T @ information / np.sqrt(size[seen]) - F.T @ others.mean
    cov = np.eye(F.shape[1]) + F.T @ (np.diag(others.variance) + others.unsure) @ F
    distance = float(off @ np.linalg.solve(cov, off)) / off.size
    return distance, float(f_law.sf(distance, off.size, dof))


def poorly_fitted(plants: Mapping[str, Plant]) -> tuple[str, ...]:
    """Return the rigs whose fit leaves more than three times the error of the fleet's median, in an output:
    the network does not describe these logs, so that their parameters say little of the rig."""
    most = {
        name: MISFIT
        * float(np.median([plant.noise[name] for plant in plants.values() if name in plant.noise]))
        for name in {name for plant in plants.values() for name in plant.noise}
    }
    return tuple(
        rig for rig, plant in plants.items() if any(error > most[name] for name, error in plant.noise.items())
    )


def pooled_plant(plant: Plant, rig: Rig) -> Plant:
    """Return a rig's plant with the parameters and the covariance that all rigs together give it."""
    values = dict(zip(plant.free, plant.natural(rig.pooled).tolist()))
    inside = {
        name: float(np.clip(value, *plant.bounds.get(name, (-np.inf, np.inf))))
        for name, value in values.items()
    }
    scores = replace(plant.scores, seconds=None)  # of one fit, and another at every run
    return replace(
        plant, values=plant.values | inside, covariance=rig.covariance, samples=None, scores=scores
    )
