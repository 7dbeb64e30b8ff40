"""The engine with two sensors beside emcee: the effusivity of one object that both touched.

    OMP_NUM_THREADS=1 python benchmarks/classify/two_sensor_emcee.py [--grasps 20] [--workers N]

The example rig's gripper with a passive copy beside it: thicker skin, slower sensor, another noise, its
thermometer 0.4 K above the first.  Grasps are simulated, a room of 25 degC, five materials in turn, a skin at
38 and 28 degC, objects at 18 degC, nominal to 0.5 K in one half, unknown in the other.  emcee samples nine
unknowns (ln e, and conductance, build-up, onset and heat capacity at each sensor); two levels and two
temperatures enter linearly and are integrated out here, by one normal distribution of all readings, so that
neither Laplace's method, the grid nor the engine's product of two sensors has a part in it.

A first walk by differential evolution is thrown away; a normal mixture fitted to it then proposes every
second move of the walk that counts, Metropolis and Hastings' rule as ever, so that a poor mixture costs time,
not truth.  emcee's own error of a quantile is stated: sqrt(p (1 - p) / n_effective) over the density there.
"""

from __future__ import annotations

import argparse
import json
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import emcee
import numpy as np
from scipy.stats import gaussian_kde
from scipy.stats import t as student
from sklearn.mixture import GaussianMixture

from thermogrip.datasets.schema import Grasps
from thermogrip.sysid.contact.simulation import simulate_grasps
from thermogrip.sysid.effusivity.data import Touches, touches, whiten
from thermogrip.sysid.effusivity.gripper_model import GripperModel, load_default_gripper
from thermogrip.sysid.effusivity.laplace_approximation import (
    BUILD_UP,
    CAPACITY,
    LEVEL,
    ONSET,
    SLIPS,
    T_OBJECT,
    H,
    free_hypotheses,
    hypotheses_of_second,
    jacobian,
    nodes_for,
    prior_of,
    slip_of,
)
from thermogrip.sysid.effusivity.posterior_grid import LN_E_RANGE, grid_posteriors

LEVELS = (0.05, 0.5, 0.95)
OWN = [H, BUILD_UP, ONSET, CAPACITY]
APART = 0.3  # K between two thermometers
WALKERS, CHAINS, FIRST_STEPS = 36, 2, 800
COMPONENTS, WIDER = 8, 1.5  # of the mixture that proposes; its covariances are this much wider


def finger() -> GripperModel:
    """Return a gripper with a second sensor."""
    one = load_default_gripper()
    stack = replace(one.stack, lag=0.3, e_outer=0.7 * one.stack.e_outer, z_outer=1.5 * one.stack.z_outer)
    noise = replace(one.noise, white=0.06)
    return replace(one, second=replace(one, stack=stack, noise=noise, bias=one.bias + 0.4))


def grasps_of(device: GripperModel, n: int) -> list[Grasps]:
    """Return simulated grasps, one a record."""
    assert device.second is not None
    out, names = [], ["copper", "iron", "wood", "brass", "zinc"]
    for k in range(n):
        known, rng = k % 2 == 0, np.random.default_rng([k, 5])
        true = 18.0 + 0.5 * rng.standard_normal()
        both = [
            simulate_grasps(
                replace(own.grip(), t_object_sd=0.0), [names[k % 5]], t_object=true, t_gripper=skin,
                seed=k + 1000 * j, ambient=25.0, **own.readings(),
            )
            for j, (own, skin) in enumerate([(device, 38.0), (device.second, 28.0)])
        ]  # fmt: skip
        whole = both[0].assign(t_surface_2=both[1]["t_surface"])
        stated = np.full(1, 18.0 if known else np.nan)
        out.append(whole.assign(t_object=("grasp", stated), t_object_sd=("grasp", 0.5 + 0 * stated)))
    return out


class Density:
    """Log posterior of (ln e, then ln h, ln tau_b, t0, ln C at each sensor), (n_point, 9)."""

    def __init__(self, device: GripperModel, data: Touches) -> None:
        assert device.second is not None
        assert data.second is not None
        self.devices, self.data = (device, device.second), (data, data.second)
        self.white = [whiten(d, g.noise)[0][0] for g, d in zip(self.devices, self.data)]
        self.slips = SLIPS if np.isfinite(data.t_object[0]) else 0.0

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return the density, -inf outside the prior's range."""
        inside = (points[:, 0] > LN_E_RANGE[0]) & (points[:, 0] < LN_E_RANGE[1])
        out = np.full(points.shape[0], -np.inf)
        if inside.any():
            out[inside] = self._inside(points[inside])
        return out

    def _inside(self, points: np.ndarray) -> np.ndarray:
        n = points.shape[0]
        first = free_hypotheses(self.devices[0], points[:, 0])
        both = (first, hypotheses_of_second(self.devices[0], self.devices[1], first))
        total, left, by = np.zeros(n), [], []
        for j, (device, data, one) in enumerate(zip(self.devices, self.data, both)):
            row = data.take(np.zeros(n, dtype=np.int64))
            prior = prior_of(device, row, one)
            assert prior.dof is not None
            own = points[:, 1 + 4 * j : 5 + 4 * j]
            for k, x in zip(OWN, own.T):
                dof = np.minimum(prior.dof[:, k], 1e9)
                total += student.logpdf(x, dof, prior.mean[:, k], prior.sd[:, k])
            u = prior.mean.copy()
            u[:, OWN] = own
            linear = np.isin(np.arange(u.shape[1]), [LEVEL, T_OBJECT]) * np.ones(u.shape, dtype=bool)
            y, slopes = jacobian(device.stack, nodes_for(data), row, u, linear)
            left.append((data.y - y) @ self.white[j].T)
            by.append(np.einsum("ab,nbk->nak", self.white[j], slopes[:, :, [LEVEL, T_OBJECT]]))
            if j == 0:
                mean, sd, level_sd = prior.mean[0, T_OBJECT], prior.sd[0, T_OBJECT], prior.sd[0, LEVEL]
            else:  # the prediction is at its own prior mean; the object's is the first's, and the offset
                shift = mean + device.bias - self.devices[0].bias - prior.mean[0, T_OBJECT]
                left[1] = left[1] - by[1][:, :, 1] * shift
        rest, size = np.concatenate(left, axis=1), left[0].shape[1]
        ways = np.zeros((n, rest.shape[1], 4))  # two levels, the object, what is between the thermometers
        ways[:, :size, [0, 2]], ways[:, size:, 1], ways[:, size:, 2] = by[0], by[1][:, :, 0], by[1][:, :, 1]
        ways[:, size:, 3] = by[1][:, :, 1]
        narrow = _integrated(rest, ways * [level_sd, level_sd, sd, APART])
        if self.slips:
            wide = _integrated(rest, ways * [level_sd, level_sd, slip_of(sd) * sd, APART])
            narrow = np.logaddexp(np.log(1 - self.slips) + narrow, np.log(self.slips) + wide)
        return np.asarray(total + narrow)


def _integrated(rest: np.ndarray, ways: np.ndarray) -> np.ndarray:
    """Return ln N(rest; 0, I + V V')."""
    inner = np.eye(4) + ways.transpose(0, 2, 1) @ ways
    along = np.einsum("nak,na->nk", ways, rest)
    gain = np.einsum("nk,nk->n", along, np.linalg.solve(inner, along[:, :, None])[:, :, 0])
    return np.asarray(-0.5 * ((rest**2).sum(axis=1) - gain) - 0.5 * np.linalg.slogdet(inner)[1])


def beside(device: GripperModel, one: Grasps, steps: int) -> dict[str, object]:
    """Return how far the engine's quantiles of ln e are from emcee's, in its sd, and what both took."""
    data = touches(one)
    clock = time.process_time()
    p = grid_posteriors(device, data)[0]
    ours, spent = np.interp(LEVELS, np.cumsum(p.mass) - 0.5 * p.mass, p.x), time.process_time() - clock
    density, chains, tau = Density(device, data), [], []
    rng = np.random.default_rng(1)
    for seed in range(CHAINS):
        x = np.clip(rng.choice(p.x, WALKERS, p=p.mass), LN_E_RANGE[0] + 0.01, LN_E_RANGE[1] - 0.01)
        first = free_hypotheses(device, x)
        assert device.second is not None
        assert data.second is not None
        row = np.zeros(WALKERS, dtype=np.int64)
        priors = (
            prior_of(device, data.take(row), first),
            prior_of(
                device.second, data.second.take(row), hypotheses_of_second(device, device.second, first)
            ),
        )
        start = np.concatenate(
            [
                x[:, None],
                *(q.mean[:, OWN] + 0.3 * q.sd[:, OWN] * rng.standard_normal((WALKERS, 4)) for q in priors),
            ],
            axis=1,
        )
        found, length = walk(density, start, steps, seed)
        tau.append(length)
        chains.append(found)
    samples = np.concatenate(chains)
    sd = samples.std()
    apart = (np.quantile(chains[0], LEVELS) - np.quantile(chains[1], LEVELS)) / sd
    effective = samples.size / float(np.mean(tau))
    return {
        "material": str(one["material"].values[0]), "known": bool(np.isfinite(data.t_object[0])),
        "deviation": ((ours - np.quantile(samples, LEVELS)) / sd).tolist(), "chains_apart": apart.tolist(),
        "emcee_error": (quantile_error(samples, effective) / sd).tolist(), "sd": float(sd), "tau": tau,
        "effective": effective, "engine_s": spent,
    }  # fmt: skip


def walk(density: Density, start: np.ndarray, steps: int, seed: int) -> tuple[np.ndarray, float]:
    """Return what a walk from ``start`` (n_walker, 9) found of ln e, and its autocorrelation time."""

    def sampler(moves: list[tuple[emcee.moves.Move, float]], seed: int) -> emcee.EnsembleSampler:
        made = emcee.EnsembleSampler(WALKERS, 9, density, moves=moves, vectorize=True)
        made.random_state = np.random.RandomState(seed).get_state()
        return made

    local = [(emcee.moves.DEMove(), 0.9), (emcee.moves.DEMove(gamma0=1.0), 0.1)]
    first = sampler(local, seed)
    first.run_mcmc(start, FIRST_STEPS)
    seen = first.get_chain(discard=FIRST_STEPS // 2, flat=True)
    mixture = GaussianMixture(COMPONENTS, reg_covar=1e-4, random_state=seed).fit(seen)
    mixture.covariances_ *= WIDER
    mixture.precisions_cholesky_ /= np.sqrt(WIDER)

    def propose(x: np.ndarray, rng: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        mixture.random_state = rng
        drawn = rng.permutation(mixture.sample(x.shape[0])[0])
        return drawn, mixture.score_samples(x) - mixture.score_samples(drawn)

    second = sampler([(emcee.moves.MHMove(propose), 0.8), *((m, 0.2 * w) for m, w in local)], seed + 100)
    second.run_mcmc(first.get_last_sample(), steps)
    return second.get_chain(flat=True)[:, 0], float(second.get_autocorr_time(tol=0)[0])


def quantile_error(samples: np.ndarray, effective: float) -> np.ndarray:
    """Return the standard errors of the quantiles, (3,)."""
    p, at = np.array(LEVELS), np.quantile(samples, LEVELS)
    density = gaussian_kde(samples[:: max(1, samples.size // 20_000)])(at)
    return np.sqrt(p * (1 - p) / effective) / density


def main() -> None:
    """Compare, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--grasps", type=int, default=20)
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    device, rows = finger(), []
    with ProcessPoolExecutor(given.workers, mp_context=get_context("spawn")) as pool:
        for row in pool.map(partial(beside, device, steps=given.steps), grasps_of(device, given.grasps)):
            rows.append(row)
            print(json.dumps(row), flush=True)
    off = np.abs([row["deviation"] for row in rows])
    print(
        f"5, 50, 95 %: mean {off.mean(axis=0).round(3)}, farthest {off.max(axis=0).round(3)} sd; within "
        f"0.1 sd in all three {int((off.max(axis=1) <= 0.1).sum())} of {len(rows)}; chains differ by "
        f"{np.sqrt(np.mean([np.square(row['chains_apart']) for row in rows], axis=0)).round(3)} sd (rms)"
    )
    if given.out:
        given.out.write_text(json.dumps(rows), encoding="utf-8")


if __name__ == "__main__":
    main()
