"""The effusivity of one grasp by the grid engine, emcee, NumPyro's NUTS and dynesty, in one run.

    python -m venv peers && peers/bin/pip install . -r benchmarks/classify/requirements.txt
    OMP_NUM_THREADS=1 XLA_FLAGS=--xla_cpu_multi_thread_eigen=false \
        peers/bin/python benchmarks/classify/engine.py --out engine.json

All sample the same five unknowns under the same priors with the two temperatures integrated exactly; NUTS has
a density of its own in JAX (``jax_posterior.py``), checked here against thermogrip's.  Times are process CPU
time.  The engine and emcee are compared on 50 grasps of all kinds; the others, which take half a minute
each, on the first ten.  Deviations are in units of the posterior's sd.

A chain is no truth either: the 5 % quantile of n effective samples is off by 2.1 / sqrt(n) of the
posterior's sd, the median by 1.25 / sqrt(n).  So four chains of 6000 effective samples or more stand beside
the engine, and their spread says how well they know their own quantiles.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import Grasps
from thermogrip.sysid.effusivity.calibration import calibrate_example_gripper
from thermogrip.sysid.effusivity.data import touches
from thermogrip.sysid.effusivity.gripper_model import GripperModel, load_default_gripper
from thermogrip.sysid.effusivity.laplace_approximation import (
    BUILD_UP,
    CAPACITY,
    ONSET,
    H,
    free_hypotheses,
    prior_of,
)
from thermogrip.sysid.effusivity.posterior import effusivity_posterior, material_posterior
from thermogrip.sysid.effusivity.posterior_grid import LN_E_RANGE, MarginalPosterior, grid_posteriors

sys.path.insert(0, str(Path(__file__).parents[2]))  # the oracles of the tests
from tests.oracles.emcee_posterior import emcee_posterior

LEVELS = (0.05, 0.5, 0.95)
FIVE = ["brass", "copper", "iron", "wood", "zinc"]
REST = [H, BUILD_UP, ONSET, CAPACITY]
CHAINS, EFFECTIVE = 4, 6000
AT_ENDS, AT_MEDIAN = 2.1, 1.25  # standard error of a quantile of a normal sample times sqrt(n)


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--grasps", type=int, default=50, help="for engine against emcee")
    parser.add_argument(
        "--peers", type=int, default=10, help="grasps for NUTS and dynesty; 0 leaves them out"
    )
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    device, files = load_default_gripper(), load_example_grasps()
    found: dict[str, Any] = {"times": engine_times(device, files["exp1A_obj43_grip23"])}
    print_times(found["times"])
    found["emcee"] = [beside_emcee(device, g) for g in chosen(files, given.grasps)]
    print_emcee(found["emcee"])
    found["peers"] = []
    for one in chosen(files, given.peers):
        found["peers"] += peers(device, one)
        # a minute each: what is found so far is kept
        if given.out:
            given.out.write_text(json.dumps(found))
    print_peers(found["peers"])
    if given.out:
        given.out.write_text(json.dumps(found))


def chosen(files: dict[str, Grasps], n: int) -> list[Grasps]:
    """Return n single grasps, every material and temperature difference among them."""
    every = [
        (name, i) for name, g in files.items() if not name.startswith("exp5") for i in range(g.sizes["grasp"])
    ]
    rng = np.random.default_rng(0)
    picked = [every[k] for k in rng.permutation(len(every))[:n]]
    return [files[name].isel(grasp=[i]) for name, i in picked]


def cpu(run: Callable[[], Any], times: int = 1) -> tuple[Any, float]:
    """Return the answer and the median process CPU time [s]."""
    spent = []
    for _ in range(times):
        clock = time.process_time()
        answer = run()
        spent.append(time.process_time() - clock)
    return answer, float(np.median(spent))


def engine_times(device: GripperModel, grasps: Grasps) -> dict[str, float]:
    """Return CPU seconds of the engine's three jobs."""
    one = grasps.isel(grasp=[5])
    material_posterior(device, one, FIVE), effusivity_posterior(device, one)  # compiled from here on
    return {
        "five candidates, one grasp": cpu(lambda: material_posterior(device, one, FIVE), 31)[1],
        "free effusivity, one grasp": cpu(lambda: effusivity_posterior(device, one), 31)[1],
        "free effusivity, per grasp of 40": cpu(lambda: effusivity_posterior(device, grasps), 3)[1] / 40,
        "joint fit of 195 grasps": cpu(calibrate_example_gripper, 3)[1],
    }


def grid_quantiles(device: GripperModel, one: Grasps) -> np.ndarray[Any, Any]:
    """Return the engine's quantiles of ln e."""
    p = grid_posteriors(device, touches(one))[0]
    # half of a point's mass lies below it
    return np.asarray(np.interp(LEVELS, np.cumsum(p.mass) - 0.5 * p.mass, p.x))


def beside_emcee(device: GripperModel, one: Grasps) -> dict[str, Any]:
    """Return deviations of the engine from four long chains, and how well the chains know and mix."""
    found = [
        cpu(lambda k=k: emcee_posterior(device, one, 0, seed=k, effective=EFFECTIVE))
        for k in range(1, CHAINS + 1)
    ]
    chains = [chain for chain, _ in found]
    samples = np.concatenate([chain.ln_effusivity for chain in chains])
    sd = float(np.std(samples))
    want = np.quantile(samples, LEVELS)
    spread = np.std([chain.quantiles for chain in chains], axis=0, ddof=1) / np.sqrt(CHAINS)
    effective = [24 * chain.steps / chain.autocorrelation for chain in chains]
    return {
        "material": str(one["material"].values[0]),
        "deviation": ((grid_quantiles(device, one) - want) / sd).tolist(),
        "error": (spread / sd).tolist(),
        "effective": float(np.sum(effective)),
        "tau": float(np.median([chain.autocorrelation for chain in chains])),
        "steps": [chain.steps for chain in chains],
        "converged": all(chain.converged for chain in chains),
        "ess_per_s": float(np.sum(effective) / np.sum([spent for _, spent in found])),
    }


def peers(device: GripperModel, one: Grasps) -> list[dict[str, Any]]:
    """Return a row for each sampler: CPU seconds, effective samples, quantiles beside the engine's."""
    want = grid_quantiles(device, one)
    sd = (want[2] - want[0]) / 3.29
    rows = []
    for name, run in (
        ("engine", None),
        ("emcee", emcee_of),
        ("NumPyro NUTS", nuts),
        ("dynesty rslice", nested),
    ):
        if run is None:
            _, spent = cpu(lambda: effusivity_posterior(device, one), 9)
            rows.append({"sampler": name, "s": spent, "ess": None, "deviation": [0.0, 0.0, 0.0]})
            continue
        (quantiles, ess), spent = cpu(lambda run=run: run(device, one))
        rows.append(
            {"sampler": name, "s": spent, "ess": ess, "deviation": ((quantiles - want) / sd).tolist()}
        )
    return [{"material": str(one["material"].values[0]), **row} for row in rows]


def emcee_of(device: GripperModel, one: Grasps) -> tuple[Any, float]:
    """Return quantiles and effective samples of thermogrip's own reference."""
    chain = emcee_posterior(device, one, 0, seed=1)
    return np.array(chain.quantiles), 24 * chain.steps / chain.autocorrelation


def _scaled(device: GripperModel, one: Grasps) -> tuple[Any, Any]:
    """Return centre and scale that bring the five unknowns to order one."""
    data = touches(one)
    p = grid_posteriors(device, data)[0]
    middle, spread = float((p.mass * p.x).sum()), 0.5
    prior = prior_of(device, data, free_hypotheses(device, [middle]))
    return np.r_[middle, prior.mean[0, REST]], np.r_[spread, prior.sd[0, REST]]


def nuts(device: GripperModel, one: Grasps) -> tuple[Any, float]:
    """Return quantiles and effective samples of one chain, 500 to warm up and 1000 to keep."""
    import jax
    import numpyro
    from jax_posterior import log_density
    from numpyro.diagnostics import effective_sample_size

    data = touches(one)
    density, (centre, scale) = log_density(device, data), _scaled(device, one)
    ours = MarginalPosterior(device, data)
    spots = centre + 0.3 * scale * np.random.default_rng(0).standard_normal((4, 5))
    gap = np.diff([float(density(s)) for s in spots]) - np.diff(ours(spots))
    if np.abs(gap).max() > 1e-3 * max(1.0, np.abs(np.diff(ours(spots))).max()):
        raise SystemExit(f"the JAX density is not thermogrip's: {gap}")
    low, high = (np.array(LN_E_RANGE) - centre[0]) / scale[0]

    def potential(z: Any) -> Any:
        # a uniform prior's walls as a steep slope, which NUTS can feel
        wall = jax.nn.softplus(40 * (z[0] - high)) + jax.nn.softplus(40 * (low - z[0]))
        return -density(centre + scale * z) + 20 * wall

    kernel = numpyro.infer.NUTS(potential_fn=potential)
    run = numpyro.infer.MCMC(kernel, num_warmup=500, num_samples=1000, progress_bar=False)
    run.run(jax.random.PRNGKey(0), init_params=np.zeros(5))
    x = np.asarray(run.get_samples())[:, 0] * scale[0] + centre[0]
    return np.quantile(x, LEVELS), float(effective_sample_size(x[None, :]))


def nested(device: GripperModel, one: Grasps) -> tuple[Any, float]:
    """Return quantiles and effective samples of dynesty, 200 live points, slices."""
    import dynesty
    from scipy.special import ndtri
    from scipy.stats import t as student_t

    data = touches(one)
    ours = MarginalPosterior(device, data)

    def parts(x: float) -> tuple[Any, Any, Any]:
        p = prior_of(device, data, free_hypotheses(device, [x]))
        return p.mean[0, REST], p.sd[0, REST], p.dof[0, REST]

    def transform(cube: Any) -> Any:
        x = LN_E_RANGE[0] + cube[0] * (LN_E_RANGE[1] - LN_E_RANGE[0])
        mean, sd, dof = parts(x)
        heavy = np.isfinite(dof)
        w = np.where(heavy, student_t.ppf(cube[1:], np.where(heavy, dof, 1.0)), ndtri(cube[1:]))
        return np.r_[x, mean + sd * w]

    def likelihood(u: Any) -> float:
        mean, sd, dof = parts(u[0])
        w = (u[1:] - mean) / sd
        heavy = np.isfinite(dof)
        law = np.where(
            heavy, student_t.logpdf(w, np.where(heavy, dof, 1.0)) + 0.5 * np.log(2 * np.pi), -0.5 * w**2
        )
        return float(ours(u[None, :])[0] - (law - np.log(sd)).sum())

    sampler = dynesty.NestedSampler(
        likelihood, transform, 5, nlive=200, sample="rslice", rstate=np.random.default_rng(0)
    )
    sampler.run_nested(print_progress=False, dlogz=0.1)
    samples, weights = sampler.results.samples[:, 0], sampler.results.importance_weights()
    order = np.argsort(samples)
    quantiles = np.interp(LEVELS, np.cumsum(weights[order]), samples[order])
    return quantiles, float(1 / (weights**2).sum())


def print_times(times: dict[str, float]) -> None:
    """Print what the engine takes."""
    print("\n| engine, one core | CPU |\n|---|---|")
    for name, spent in times.items():
        print(f"| {name} | {1e3 * spent:.1f} ms |" if spent < 1 else f"| {name} | {spent:.1f} s |")


def print_emcee(rows: list[dict[str, Any]]) -> None:
    """Print agreement with emcee."""
    deviation = np.abs([r["deviation"] for r in rows])
    error = np.array([r["error"] for r in rows])
    print(f"\n| engine beside emcee, {len(rows)} grasps | 5 % | median | 95 % |\n|---|---|---|---|")
    for name, values in (
        ("mean distance [sd]", deviation.mean(axis=0)),
        ("90 % of grasps within [sd]", np.quantile(deviation, 0.9, axis=0)),
        ("farthest [sd]", deviation.max(axis=0)),
        ("emcee's own standard error, rms [sd]", np.sqrt((error**2).mean(axis=0))),
        ("by its effective samples [sd]", _own_error(np.median([r["effective"] for r in rows]))),
    ):
        print(f"| {name} | " + " | ".join(f"{v:.3f}" for v in values) + " |")
    tau, ess = [r["tau"] for r in rows], [r["ess_per_s"] for r in rows]
    print(
        f"\nwithin 0.1 sd in all three: {int((deviation.max(axis=1) <= 0.1).sum())} of {len(rows)}.  emcee: "
        f"autocorrelation time {np.median(tau):.1f} steps (worst {max(tau):.1f}), effective samples a CPU "
        f"second {np.median(ess):.0f} (worst {min(ess):.0f}), converged "
        f"{sum(r['converged'] for r in rows)} of {len(rows)}."
    )


def _own_error(effective: float) -> np.ndarray[Any, Any]:
    return np.array([AT_ENDS, AT_MEDIAN, AT_ENDS]) / np.sqrt(effective)


def print_peers(rows: list[dict[str, Any]]) -> None:
    """Print the samplers beside each other: each grasp, then each sampler over all grasps."""
    print("\n| grasp | sampler | CPU s | effective samples | per s | 5 / 50 / 95 % off by [sd] |")
    print("|---|---|---|---|---|---|")
    for r in rows:
        ess = "" if r["ess"] is None else f"{r['ess']:.0f}"
        rate = "" if r["ess"] is None else f"{r['ess'] / r['s']:.0f}"
        off = " / ".join(f"{v:+.2f}" for v in r["deviation"])
        print(f"| {r['material']} | {r['sampler']} | {r['s']:.3g} | {ess} | {rate} | {off} |")
    print("\n| sampler | grasps | CPU s, median | effective samples a second, median (worst) ", end="")
    print("| off by, rms [sd] | expected of its samples [sd] | farthest |\n|---|---|---|---|---|---|---|")
    for name in dict.fromkeys(r["sampler"] for r in rows):
        own = [r for r in rows if r["sampler"] == name]
        head = f"| {name} | {len(own)} | {np.median([r['s'] for r in own]):.3g} "
        if own[0]["ess"] is None:
            print(head + "| | | | |")
            continue
        rate = [r["ess"] / r["s"] for r in own]
        off = np.array([r["deviation"] for r in own])
        rms = np.sqrt((off**2).mean(axis=0))
        due = np.sqrt(np.mean([_own_error(r["ess"]) ** 2 for r in own], axis=0))
        print(
            f"{head}| {np.median(rate):.0f} ({min(rate):.0f}) | {' / '.join(f'{v:.3f}' for v in rms)} "
            f"| {' / '.join(f'{v:.3f}' for v in due)} | {np.abs(off).max():.2f} |"
        )


if __name__ == "__main__":
    main()
