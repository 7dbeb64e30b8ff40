"""A chain of walkers, run until it is long enough or its time is up.

The walkers move by differential evolution, which needs no tuning when parameters trade off against each
other.  With few walkers it is slow: steps are differences of the others, and eight of them are few directions
in six dimensions.  So where a normal approximation of the density is at hand, half of the moves are proposals
of their own, wherever the walker stands: Student's t about the approximation's mean, somewhat wider than it,

    x' ~ t_6(m, s^2 C),      accepted with min(1, p(x') t(x) / (p(x) t(x'))).

A poor approximation costs acceptance and never truth, for the other half of the moves reaches what t forgets.

**Converged** means that the chain is longer than 50 integrated autocorrelation times of every parameter,
as the authors of emcee ask for [1]_.  The walkers of one ensemble are not independent chains, so comparing
them with each other (R-hat) would prove nothing.

References
----------
.. [1] Foreman-Mackey, Hogg, Lang, Goodman, "emcee: The MCMC Hammer", PASP 125 (2013) 306, and the package's
   documentation on autocorrelation.

A chain in a file: kept as it grows, and gone on from if it belongs to the same problem
---------------------------------------------------------------------------------------

What a chain belongs to is said by a hash of everything that decides its density and its moves: the model, the
fitted values and priors, every row of every log, the bins, which parameters are sampled, walkers and seed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, columns, log_name
from thermogrip.sysid.plant.plant import Plant

__all__ = [
    "Chain",
    "mark_backend",
    "problem_hash",
    "run_chain",
]

Array = NDArray[np.float64]

LENGTH = 50  # autocorrelation times that make a chain long enough
_DOF, _WIDER = 6.0, 1.25  # of the proposals: a tail, and the factor s
_CHECK_EVERY = 50


@dataclass(frozen=True, eq=False)
class Chain:
    """What emcee did."""

    steps: Array  # (n_step, n_walker, n_dim), the whole chain, burn-in included
    log_posterior: Array  # (n_step, n_walker)
    tau: Array  # (n_dim,), integrated autocorrelation time of each dimension [steps]
    converged: bool  # whether the chain is longer than 50 tau in every dimension
    acceptance: float  # share of moves that were accepted

    def kept(self, n: int) -> Array:
        """Return about ``n`` rows (n, n_dim), spread evenly over the chain behind its burn-in."""
        burn = min(int(np.ceil(3 * np.max(self.tau))), len(self.steps) // 2)
        flat = self.steps[burn:].reshape(-1, self.steps.shape[-1])
        return np.asarray(flat[np.linspace(0, len(flat) - 1, min(n, len(flat))).astype(int)])


def run_chain(
    log_posterior: Callable[[Array], Array],
    start: Array,
    *,
    max_steps: int,
    normal: tuple[Array, Array] | None = None,
    seed: int = 0,
    backend: Any | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> Chain:
    """Run emcee until the chain is 50 autocorrelation times long, or ``max_steps`` are done."""
    import emcee

    n_walkers, n_dim = start.shape
    # no snooker moves: those of emcee 3.1.6 sample a 6-D standard normal with sd 0.82
    moves = [emcee.moves.DEMove()]
    if normal is not None:
        moves.append(emcee.moves.MHMove(_proposals(*normal), n_dim))
    sampler = emcee.EnsembleSampler(
        n_walkers, n_dim, log_posterior, moves=moves, vectorize=True, backend=backend
    )
    if sampler.iteration:  # a chain is there already
        state = sampler.get_last_sample()
    else:
        state = emcee.State(start, random_state=np.random.RandomState(seed).get_state())
    tau = _autocorrelation(sampler.get_chain()) if sampler.iteration else np.full(n_dim, np.nan)
    left = max_steps - sampler.iteration
    if left > 0 and not sampler.iteration > LENGTH * np.max(tau):
        for _ in sampler.sample(state, iterations=left, skip_initial_state_check=True):
            n = sampler.iteration
            if n % _CHECK_EVERY == 0 or n == max_steps:
                tau = _autocorrelation(sampler.get_chain())
                worst = float(np.max(tau))
                if progress is not None:
                    share = max(n / max_steps, min(1.0, n / (LENGTH * worst)))
                    progress(share, f"sampling, {n / worst:.0f} tau")
                if n > LENGTH * worst:
                    break
    return Chain(
        steps=np.asarray(sampler.get_chain()),
        log_posterior=np.asarray(sampler.get_log_prob()),
        tau=tau,
        converged=bool(sampler.iteration > LENGTH * np.max(tau)),
        acceptance=float(np.mean(sampler.acceptance_fraction)),
    )


def _proposals(mean: Array, covariance: Array) -> Callable[..., tuple[Array, Array]]:
    """Return the function of (points (n, n_dim), random) to new points and ln t(old) - ln t(new)."""
    root = _WIDER * np.linalg.cholesky(covariance)

    def log_t(x: Array) -> Array:
        squares = (np.linalg.solve(root, (x - mean).T) ** 2).sum(axis=0)
        return np.asarray(-0.5 * (_DOF + mean.size) * np.log1p(squares / _DOF))

    def propose(points: Array, random: np.random.RandomState) -> tuple[Array, Array]:
        normal = random.standard_normal(points.shape)
        drawn = normal * np.sqrt(_DOF / random.chisquare(_DOF, len(points)))[:, None]
        new = mean + drawn @ root.T
        return new, log_t(points) - log_t(new)

    return propose


def _autocorrelation(steps: Array) -> Array:
    """Return the integrated autocorrelation times, never below one step.

    That of a dimension in which a walker has not moved yet is not known: it counts as the whole chain.
    """
    from emcee.autocorr import integrated_time

    with np.errstate(invalid="ignore"):
        found = np.asarray(integrated_time(steps, tol=0, quiet=True), dtype=float)
    return np.asarray(np.maximum(np.where(np.isfinite(found), found, len(steps)), 1.0))


_MARK = "thermogrip_problem"
_METHOD = 2  # counts up when density or moves change, so that no chain goes on with other ones


def problem_hash(
    plant: Plant, logs: Sequence[Log], sampled: Sequence[int], average: float, walkers: int, seed: int
) -> str:
    """Return a hash of all that decides a chain."""
    settings = [
        _METHOD,
        list(plant.free),
        list(sampled),
        average,
        walkers,
        seed,
        {k: f"{t:.4g}" for k, t in plant.scores.weight_s.items()},
    ]
    # a machine's last digits are its own
    values = {name: f"{value:.6g}" for name, value in plant.values.items()}
    said = {"model": plant.model.to_dict(), "values": values, "settings": settings}
    digest = hashlib.sha256(json.dumps(said, sort_keys=True).encode())
    for log in logs:
        digest.update(log_name(log).encode())
        names = (*plant.inputs, *plant.disturbances, *plant.outputs)
        digest.update(np.ascontiguousarray(log["time"].values, dtype=float).tobytes())
        digest.update(np.ascontiguousarray(columns(log, names), dtype=float).tobytes())
    return digest.hexdigest()


def mark_backend(backend: Any, path: str | Path, mark: str, shape: tuple[int, ...]) -> None:
    """Leave a backend its steps if they belong to ``mark``, else empty it and write the mark."""
    try:
        same = Path(path).exists() and backend.initialized and _read_mark(backend) == mark
        if not same:
            backend.reset(*shape)
            with backend.open("a") as file:
                file[backend.name].attrs[_MARK] = mark
    except (OSError, KeyError) as error:
        raise UserError(
            "is not a chain of a posterior", file=path, hint="delete it, or name another"
        ) from error


def _read_mark(backend: Any) -> str:
    with backend.open() as file:
        return str(file[backend.name].attrs.get(_MARK, ""))
