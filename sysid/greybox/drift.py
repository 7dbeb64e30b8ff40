r"""How the parameters of a rig move over months: a trend through fits of its logs, one by one.

A log j at time :math:`\tau_j` (from -1/2 to 1/2 over the rig's logs) says by itself, in units of the
population's prior, a likelihood of precision :math:`\Lambda_j` and information :math:`\eta_j`
(:mod:`~thermogrip.sysid.greybox.population`).  The rig's parameters are then

.. math:: z_j = b + s \tau_j + e_j, \quad b \sim N(0, 1), \quad s \sim N(0, 2^2), \quad e_j \sim N(0, T),

T diagonal and one for all rigs: what differs from day to day without a trend, a draught or another room,
found by EM with b and s integrated out, as the population's spread is.

**A rig that drifts** has a slope that days which merely differ would seldom give: with s = 0 its posterior
mean has the covariance :math:`C (1 - Q_s C)`, C being the posterior's and Q_s the slope's prior precision.
The largest ratio of a rig is compared with Student's t of as many degrees of freedom as all rigs have logs
beyond two each, times the number of parameters and of rigs.  A temperature (of the room) is no part of a
rig: its trend is no drift.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import t as t_law

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError
from thermogrip.sysid.greybox.population import (
    ILL,
    ROUNDS,
    STILL,
    Told,
    in_prior_units,
    is_of_rig,
    prior_units,
    told_by,
)
from thermogrip.sysid.models.network import NetworkModel
from thermogrip.sysid.plant.plant import Plant

LEAST_LOGS = 3
_SLOPE = 2.0  # sd of a rig's change over its logs, in units of the population's prior
_FIRST = 0.25  # of the population's variance, where EM begins
_FLAT = 1e-9  # of the slope's prior variance: what logs say less about has no slope


class Drift(NamedTuple):
    """How one rig moved."""

    name: str
    days: Array  # (m,) of its logs, from the first
    theta: Array  # (m, k) what each log, the population and the trend say of the rig's parameters
    sd: Array  # (m, k) of that
    change: Array  # (k,) of theta from the first log to the last
    change_sd: Array  # (k,)
    chance: float  # of a rig that seems to move as much, if none of the fleet moved
    farthest: int  # the parameter whose change is the least likely

    @property
    def drifts(self) -> bool:
        """Whether fewer than one steady fleet of twenty has such a rig."""
        return self.chance < ILL


class _Trend(NamedTuple):
    """Mean and slope of one rig given T, and what its days are beside them."""

    beta: Array  # (2k,)
    covariance: Array  # (2k, 2k)
    days: Array  # (m, k), mean of b + s tau + e
    day_sd: Array  # (m, k)
    scatter: Array  # (k,), sum over days of the expected e^2


def find_drift(
    fits: Mapping[str, Sequence[Plant]], days: Mapping[str, Sequence[float]]
) -> tuple[tuple[Drift, ...], Array]:
    """Return how each rig moved, and how theta (k,) scatters from day to day without a trend (sd).

    Parameters
    ----------
    fits : mapping of str to sequence of Plant
        Fits of one network to the logs of each rig, a log a fit, with the same prior.  Rigs of fewer than
        three logs have no trend and are left out.
    days : mapping of str to sequence of float
        When these logs began [days].

    Raises
    ------
    UserError
        If no rig has three logs, its logs are of one time, or fits are not of one thermal network.

    Examples
    --------
    >>> from dataclasses import replace
    >>> from thermogrip.sysid.greybox.problem import prior_plant
    >>> from thermogrip.sysid.models.network import load_network
    >>> board = prior_plant(load_network("tclab"))
    >>> sure, days = np.diag(0.05**2 * np.ones(len(board.free))), [0.0, 30.0, 60.0, 90.0]
    >>> def lose(factors):  # heat, so many times as fast on each day
    ...     values = [board.values | {"G_amb": x * board.values["G_amb"]} for x in factors]
    ...     return [replace(board, values=each, covariance=sure) for each in values]
    >>> steady, fouled = lose([1.01, 0.99, 1.0, 1.0]), lose([1.0, 0.87, 0.74, 0.64])
    >>> rigs, scatter = find_drift({"a": steady, "b": steady, "c": fouled}, dict.fromkeys("abc", days))
    >>> [rig.name for rig in rigs if rig.drifts], board.free[rigs[2].farthest]
    (['c'], 'G_amb')
    >>> round(float(np.exp(rigs[2].change[0])), 2), round(float(scatter[0]), 3)
    (0.64, 0.023)
    """
    names = [name for name, plants in fits.items() if len(plants) >= LEAST_LOGS]
    if not names:
        raise UserError("no rig has three logs", hint="a trend needs three logs of a rig")
    first = fits[names[0]][0]
    model = first.model
    for name in names:
        same = all(plant.free == first.free and plant.covariance is not None for plant in fits[name])
        if not same or not isinstance(model, NetworkModel):
            raise UserError(f"rig {name} has no fits of one thermal network", hint="leave it out")
        if np.ptp(days[name]) <= 0:
            raise UserError(f"logs of rig {name} are of one time", hint="give their dates")
    assert isinstance(model, NetworkModel)
    specs = [model.specs[name] for name in first.free]
    centre, width = prior_units(specs)
    told, taus = [], []
    for name in names:
        told.append(told_by(*in_prior_units(fits[name], centre, width)))
        at = np.asarray(days[name], dtype=float)
        taus.append((at - at.min()) / np.ptp(at) - 0.5)
    T = _day_to_day(told, taus)
    own_part = np.array([is_of_rig(spec) for spec in specs])
    k, dof = len(specs), sum(tau.size - 2 for tau in taus)
    found = []
    for name, own, tau in zip(names, told, taus):
        trend = _trend(own, tau, T)
        slope, C = trend.beta[k:], trend.covariance
        steady = np.diagonal(C[k:, k:] - C[k:, k:] @ C[k:, k:] / _SLOPE**2)
        seen = (steady > _FLAT * _SLOPE**2)[own_part]
        ratio = np.where(seen, np.abs(slope[own_part]) / np.sqrt(np.where(seen, steady[own_part], 1.0)), 0.0)
        chance = min(1.0, 2 * ratio.size * len(names) * float(t_law.sf(ratio.max(), dof)))
        at = np.asarray(days[name], dtype=float)
        theta, sd, change, change_sd = (
            (first_part + width * value)[..., own_part]
            for first_part, value in (
                (centre, trend.days), (0.0, trend.day_sd), (0.0, slope), (0.0, np.sqrt(np.diagonal(C)[k:]))
            )
        )  # fmt: skip
        farthest = int(ratio.argmax())
        found.append(Drift(name, at - at.min(), theta, sd, change, change_sd, chance, farthest))
    return tuple(found), (width * np.sqrt(T))[own_part]


def _day_to_day(told: Sequence[Told], taus: Sequence[Array]) -> Array:
    """Return the variance (k,) from day to day by EM, of all rigs."""
    n = sum(tau.size for tau in taus)
    T = np.full(told[0].information.shape[1], _FIRST)
    for _ in range(ROUNDS):
        renewed = np.sum([_trend(own, tau, T).scatter for own, tau in zip(told, taus)], axis=0) / (n - 1)
        moved, T = np.abs(np.log(renewed / T)).max(), renewed
        if moved < STILL:
            break
    return T


def _trend(told: Told, tau: Array, T: Array) -> _Trend:
    """Return mean, slope and days of a rig whose days scatter with the variance ``T``."""
    k = T.size
    X = np.stack([np.hstack([np.eye(k), t * np.eye(k)]) for t in tau])
    V = np.linalg.inv(told.precision + np.diag(1 / T))
    # P = (1 / Lambda + T)^-1 without the inverse of a Lambda that logs may leave singular
    P = np.diag(1 / T) - V / np.outer(T, T)
    own = np.einsum("nij,nj->ni", V, told.information)
    Q = np.diag(np.repeat([1.0, _SLOPE**-2], k))
    C = np.linalg.inv(Q + np.einsum("nia,nij,njb->ab", X, P, X))
    beta = C @ np.einsum("nia,ni->a", X, own / T)
    pull = np.einsum("nij,nja->nia", V / T, X)  # of a day towards the trend
    days = own + pull @ beta
    day_cov = V + np.einsum("nia,ab,njb->nij", pull, C, pull)
    off = days - X @ beta
    A = pull - X
    left = np.diagonal(V + np.einsum("nia,ab,njb->nij", A, C, A), axis1=1, axis2=2)
    day_sd = np.sqrt(np.diagonal(day_cov, axis1=1, axis2=2))
    return _Trend(beta, C, days, day_sd, (left + off**2).sum(axis=0))
