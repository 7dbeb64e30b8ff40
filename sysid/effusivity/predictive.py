"""What a gripper will read in another touch of a block, under each candidate.

Under a candidate the readings y to come are nearly Gaussian.  Nothing of the touch is read yet: what the
block keeps (temperature, effusivity, heat capacity, part of the contact conductance) comes from the touches
so far through :mod:`~thermogrip.sysid.effusivity.multi_touch`, the rest from the gripper's spreads, and with
J = df/du

    y ~ N(f(mean), J P J' + C).

Each candidate's prediction and the probabilities of the candidates now are a :class:`PosteriorPredictive`;
the expected information of readings is a sum over it (:mod:`thermogrip.classify.decisions.next_touch`).
Nothing is simulated sample by sample: it costs a few evaluations of the response per candidate.

A second sensor is left out: it may gain more than is expected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from thermogrip.datasets.arrays import Array
from thermogrip.sysid.contact.materials import Material
from thermogrip.sysid.contact.simulation import PUMP_OFF
from thermogrip.sysid.effusivity.data import Touches, noise_covariance
from thermogrip.sysid.effusivity.gripper_model import GripperModel
from thermogrip.sysid.effusivity.laplace_approximation import (
    BUILD_UP,
    EFFUSIVITY,
    LEVEL,
    N_NUISANCE,
    ONSET,
    jacobian,
    nodes_for,
)
from thermogrip.sysid.effusivity.multi_touch import SHARED, Coupling, next_touch_prior

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Grasps


@dataclass(frozen=True)
class ForecastSettings:
    """Readings to come, and how a gripper begins."""

    bin_s: float = 0.5  # readings to come are taken as means over this
    regulation_sd_K: float = 0.35  # of a gripper about its set point at contact, as of simulated grasps
    first_s: float = 0.3  # before it the moment of contact matters too much for one expansion


FORECAST = ForecastSettings()


class PosteriorPredictive(NamedTuple):
    """``n`` situations and m candidates."""

    log_p: Array  # (n, m), now
    mean: Array  # (n, m, n_reading), of the readings to come under each candidate [degC]
    covariance: Array  # (n, m, n_reading, n_reading) [K^2]


def next_touch(
    gripper: GripperModel, grasps: Grasps, candidates: Sequence[str | Material], t_gripper: ArrayLike, *,
    coupling: Coupling | None = None, rest: float = 60.0, end: float = 10.0,
) -> PosteriorPredictive:  # fmt: skip
    """Return what another touch of the block would read at each gripper temperature."""
    temperature = np.atleast_1d(np.asarray(t_gripper, dtype=float))
    prior = next_touch_prior(gripper, grasps, candidates, coupling=coupling, rest=rest)
    evidence = prior.log_evidence
    n, m = temperature.size, evidence.size
    room = float(grasps["t_ambient"].values[-1]) if "t_ambient" in grasps else np.nan
    sample_s = float(np.median(np.diff(np.asarray(grasps["time"].values, dtype=float))))
    data = _coming(np.repeat(temperature, m), room, end, sample_s)
    u, spread = np.zeros((n * m, N_NUISANCE)), np.zeros((n * m, N_NUISANCE, N_NUISANCE))
    u[:, BUILD_UP], u[:, ONSET], u[:, LEVEL] = np.log(gripper.stack.build_up), gripper.onset, data.level
    own_nuisances = [BUILD_UP, ONSET, LEVEL]
    spread[:, own_nuisances, own_nuisances] = np.square(
        [gripper.spreads.ln_build_up, gripper.spreads.onset, FORECAST.regulation_sd_K]
    )
    u[:, SHARED] = np.tile(prior.mean, (n, 1))
    spread[:, np.array(SHARED)[:, None], SHARED] = np.tile(prior.covariance, (n, 1, 1))
    vary = np.diagonal(spread, axis1=1, axis2=2) > 0
    beyond = gripper.beyond(data.t, u[:, EFFUSIVITY])
    y, slopes = jacobian(gripper.stack, nodes_for(data), data, u, vary, beyond)
    excursion = np.abs(y[:, 1:] - data.level[:, None]).max(axis=1)
    noise = noise_covariance(replace(data, excursion=excursion), gripper.noise)
    covariance = slopes @ spread @ slopes.transpose(0, 2, 1) + noise
    log_p = np.tile(evidence - np.logaddexp.reduce(evidence), (n, 1))
    return PosteriorPredictive(log_p, y.reshape(n, m, -1), covariance.reshape(n, m, *covariance.shape[1:]))


def _coming(level: Array, room: float, end: float, dt: float) -> Touches:
    """Return touches of which nothing is read yet: a reading of the level, then one every half second."""
    bin_times = np.concatenate(
        [[-1.0 - FORECAST.bin_s], np.arange(FORECAST.first_s + FORECAST.bin_s / 2, end, FORECAST.bin_s)]
    )
    per_bin = max(1, round(FORECAST.bin_s / dt))
    times = (bin_times[:, None] + dt * (np.arange(per_bin) - 0.5 * (per_bin - 1))).ravel()
    bins, count = np.repeat(np.arange(bin_times.size), per_bin), np.full(bin_times.size, float(per_bin))
    n = level.size
    unknown = np.full(n, np.nan)

    def each(row: Array) -> Array:
        return np.broadcast_to(row, (n, row.size)).copy()

    return Touches(
        grasp_id=np.full(n, "next"), material=np.full(n, ""), sample_t=each(times),
        sample_bin=np.broadcast_to(bins, (n, bins.size)).copy(), y=np.zeros((n, bin_times.size)),
        t=each(bin_times), count=each(count), ramp=each(np.maximum(bin_times - PUMP_OFF, 0.0)), level=level,
        t_object=unknown, t_object_sd=unknown, t_ambient=np.full(n, room), excursion=np.zeros(n),
        share=np.zeros(n), unlike=np.zeros(n), since=np.full(n, -np.inf), thin=np.zeros(n),
        question=np.arange(n), trace=np.arange(n),
    )  # fmt: skip
