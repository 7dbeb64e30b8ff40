"""Plant and logs to samples of its parameters, with intervals that mean what they say.

The likelihood (:mod:`~thermogrip.sysid.likelihood`) counts what a log really says: model error that
remembers, an offset of every sensor and an unknown start for each log, all widened if leaving out one log
after the other moves the parameters by more than it allows.  Its numbers are learnt at the mode and held.

Most parameters of a network act almost linearly over the width of their posterior; the few that the data know
best relative to the prior are sampled with emcee, all others are integrated out by their linearisation and
drawn afterwards, so every sample is a whole parameter vector.  The walkers start in the Laplace approximation
and move by differential evolution, which needs no tuning when parameters trade off against each other.

**Converged** means that the chain is longer than 50 integrated autocorrelation times of every parameter, as
the authors of emcee ask for [1]_.  The walkers of one ensemble are not independent chains, so comparing them
with each other (R-hat) would prove nothing.

The simulation takes a coarser step than the plant's own.  What the fine step would change at the mode is
added to the residuals, so both agree there; the mode is then looked for again, and how far the fine step
would still move it is part of the record.  If that is more than a quarter of a standard deviation, the step
is refined.

References
----------
.. [1] Foreman-Mackey, Hogg, Lang, Goodman, "emcee: The MCMC Hammer", PASP 125 (2013) 306, and the package's
   documentation on autocorrelation.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.files import atomic_path
from thermogrip.datasets.schema import Log
from thermogrip.sysid.discrepancy import Discrepancy, LogResiduals, fit_discrepancy, log_jackknife, white
from thermogrip.sysid.likelihood import Bins, Likelihood, linearise, make_bins
from thermogrip.sysid.mode import find_mode, mode_shift, step_change
from thermogrip.sysid.plant import Plant

__all__ = ["Chain", "Posterior", "run_chain", "sample_posterior"]

Array = NDArray[np.float64]

LENGTH = 50  # autocorrelation times that make a chain long enough
_CHECK_EVERY = 50
_COARSE = (4, 2, 1)  # times the plant's own step, tried in this order
_MAX_SHIFT = 0.25


@dataclass(frozen=True, eq=False)
class Chain:
    """What emcee did.

    Attributes
    ----------
    steps : (n_step, n_walker, n_dim) ndarray
        The whole chain, burn-in included.
    log_posterior : (n_step, n_walker) ndarray
    tau : (n_dim,) ndarray
        Integrated autocorrelation time of each dimension [steps].
    converged : bool
        Whether the chain is longer than 50 tau in every dimension.
    acceptance : float
        Share of moves that were accepted.
    """

    steps: Array
    log_posterior: Array
    tau: Array
    converged: bool
    acceptance: float

    def kept(self, n: int) -> Array:
        """Return about ``n`` rows (n, n_dim), spread evenly over the chain behind its burn-in."""
        burn = min(int(np.ceil(3 * np.max(self.tau))), len(self.steps) // 2)
        flat = self.steps[burn:].reshape(-1, self.steps.shape[-1])
        return np.asarray(flat[np.linspace(0, len(flat) - 1, min(n, len(flat))).astype(int)])


@dataclass(frozen=True, eq=False)
class Posterior:
    """The record of a posterior.

    Attributes
    ----------
    free : tuple of str
        All parameters, in the order of ``samples``.
    sampled : tuple of str
        Those that emcee moved; the others were integrated out.
    samples : (n, n_free) ndarray
        Whole parameter vectors in natural units.
    units : dict of str to str
    fitted : dict of str to float
        The plant's own values.
    chain : Chain
        Of the sampled parameters in natural units.
    tau : dict of str to float
        Autocorrelation time of each sampled parameter [steps].
    n_steps : int
        Length of the chain.
    converged : bool
        Longer than 50 tau throughout.
    acceptance : float
        Share of accepted moves.
    quantiles : dict of str to (float, float, float)
        5, 50 and 95 % of each free parameter.
    likelihood : str
        What was assumed about the residuals, in words.
    step_shift : float
        How far the plant's own step would still move the mode, in posterior standard deviations.
    verdict : str
        One sentence.
    """

    free: tuple[str, ...]
    sampled: tuple[str, ...]
    samples: Array
    units: dict[str, str]
    fitted: dict[str, float]
    chain: Chain
    tau: dict[str, float]
    n_steps: int
    converged: bool
    acceptance: float
    quantiles: dict[str, tuple[float, float, float]]
    likelihood: str
    step_shift: float
    verdict: str

    def inference_data(self) -> Any:
        """Return the chain and, as ``posterior_whole``, the whole samples: arviz ``InferenceData``."""
        arviz = _arviz()
        chain = np.moveaxis(self.chain.steps, 1, 0)  # arviz wants (chain, draw)
        said = {"likelihood": self.likelihood, "verdict": self.verdict, "converged": int(self.converged)}
        data = arviz.from_dict(
            posterior={name: chain[:, :, i] for i, name in enumerate(self.sampled)},
            sample_stats={"lp": self.chain.log_posterior.T},
            attrs=said | {f"tau_{name}": tau for name, tau in self.tau.items()},
        )
        whole = {name: self.samples[None, :, i] for i, name in enumerate(self.free)}
        data.add_groups({"posterior_whole": arviz.dict_to_dataset(whole)}, warn_on_custom_groups=False)
        return data

    def save(self, path: str | Path) -> Path:
        """Write NetCDF (arviz reads it) in one step and return the path."""
        with atomic_path(path) as temporary:
            self.inference_data().to_netcdf(str(temporary), engine="h5netcdf")
        return Path(path)


def sample_posterior(
    plant: Plant,
    logs: Sequence[Log],
    *,
    free: Sequence[str] | None = None,
    n_sampled: int = 6,
    memory: bool = True,
    average: float | None = None,
    step: float | None = None,
    walkers: int | None = None,
    max_steps: int = 4000,
    n_samples: int = 400,
    seed: int = 0,
    progress: Callable[[float, str], None] | None = None,
) -> tuple[Plant, Posterior]:
    """Sample the parameters of a fitted plant.

    Parameters
    ----------
    plant : Plant
        With free parameters; the start is at its values.
    logs : sequence of Log
        The logs of the fit.
    free : sequence of str, optional
        Parameters that emcee samples; default the ``n_sampled`` that the data know best relative to the
        prior. All other free parameters of the plant are integrated out by linearisation.
    n_sampled : int, optional
        How many, where ``free`` is absent.
    memory : bool, optional
        False treats residuals as independent: for comparison only, the intervals are then too narrow.
    average : float, optional
        Bin width [s]; default a 150th of the longest log.
    step : float, optional
        Step of the simulation [s]; default the coarsest of 4, 2, 1 times the plant's own that keeps the mode.
    walkers : int, optional
        Default 2 n_dim + 4.
    max_steps : int, optional
        Give up after so many steps of the ensemble; the record then says that it has not converged.
    n_samples : int, optional
        Samples kept.
    seed : int, optional
    progress : callable, optional
        Called with (fraction done, what is being done).

    Returns
    -------
    plant : Plant
        The same plant with ``samples``, and verdict, ``converged``, likelihood and tau in
        ``scores["posterior"]``; its values are unchanged.
    posterior : Posterior

    Raises
    ------
    UserError
        If the plant has no free parameter or no prior, a name in ``free`` is not free, or a log does not fit.
    """
    report = progress or _silent
    report(0.0, "averaging the logs")
    bins, linear, z, discrepancy, spread, shift = _prepare(plant, logs, average, step, memory, report)
    sampled = _choose(plant, free, n_sampled, spread)
    target = Likelihood(bins, linear, z, discrepancy, sampled)
    rng = np.random.default_rng(seed)
    here = spread[np.ix_(sampled, sampled)]
    n_walkers = max(walkers or 0, 2 * len(sampled) + 4)
    start = _inside(rng.multivariate_normal(z[sampled], here, size=4 * n_walkers), target, n_walkers)
    chain = run_chain(
        target.log_posterior,
        start,
        max_steps=max_steps,
        seed=seed,
        progress=lambda f, w: report(0.1 + 0.85 * f, w),
    )
    report(0.95, "completing the samples")
    whole = bins.prior.natural(target.complete(chain.kept(n_samples), rng))
    whole = np.clip(whole, bins.prior.low, bins.prior.high)
    record = _record(plant, bins, sampled, chain, whole, discrepancy, shift)
    report(1.0, record.verdict)
    said = {"verdict": record.verdict, "converged": record.converged, "likelihood": record.likelihood}
    return replace(
        plant, samples=whole, scores=plant.scores | {"posterior": said | {"tau": record.tau}}
    ), record


def run_chain(
    log_posterior: Callable[[Array], Array],
    start: Array,
    *,
    max_steps: int,
    seed: int = 0,
    progress: Callable[[float, str], None] | None = None,
) -> Chain:
    """Run emcee until the chain is 50 autocorrelation times long, or ``max_steps`` are done.

    Parameters
    ----------
    log_posterior : callable
        (n, n_dim) -> (n,), of many points at once.
    start : (n_walker, n_dim) ndarray
        Where the walkers start; all must have a finite posterior.
    max_steps : int
    seed : int, optional
    progress : callable, optional

    Returns
    -------
    chain : Chain

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> chain = run_chain(lambda x: -0.5 * (x**2).sum(axis=1), rng.normal(size=(16, 2)), max_steps=3000)
    >>> chain.converged, bool(abs(chain.kept(4000).std() - 1) < 0.1)
    (True, True)
    """
    import emcee

    n_walkers, n_dim = start.shape
    # differential evolution alone: the snooker move of emcee 3.1.6 samples a 6-D standard normal with sd 0.82
    sampler = emcee.EnsembleSampler(
        n_walkers, n_dim, log_posterior, moves=emcee.moves.DEMove(), vectorize=True
    )
    state = emcee.State(start, random_state=np.random.RandomState(seed).get_state())
    tau = np.full(n_dim, np.nan)
    for _ in sampler.sample(state, iterations=max_steps, skip_initial_state_check=True):
        n = sampler.iteration
        if n % _CHECK_EVERY == 0 or n == max_steps:
            tau = _autocorrelation(sampler.get_chain())
            worst = float(np.max(tau))
            if progress is not None:
                progress(max(n / max_steps, min(1.0, n / (LENGTH * worst))), f"sampling, {n / worst:.0f} tau")
            if n > LENGTH * worst:
                break
    return Chain(
        steps=np.asarray(sampler.get_chain()),
        log_posterior=np.asarray(sampler.get_log_prob()),
        tau=tau,
        converged=bool(sampler.iteration > LENGTH * np.max(tau)),
        acceptance=float(np.mean(sampler.acceptance_fraction)),
    )


def _prepare(
    plant: Plant,
    logs: Sequence[Log],
    average: float | None,
    step: float | None,
    memory: bool,
    report: Callable[[float, str], None],
) -> tuple[Bins, list[LogResiduals], Array, Discrepancy, Array, float]:
    """Return bins, linearisation, mode, covariance numbers, posterior covariance, the coarse step's shift."""
    fine = make_bins(plant, logs, average=average)
    start = fine.prior.standard(np.array([plant.values[name] for name in fine.prior.names]))
    for times in _COARSE if step is None else (step / fine.dt,):
        per_bin = fine.average / (times * fine.dt)
        if step is None and times > 1 and (per_bin < 2 or abs(per_bin - round(per_bin)) > 1e-6):
            continue
        bins = make_bins(plant, logs, average=fine.average, step=times * fine.dt)
        report(0.02, "looking for the mode")
        linear, z, discrepancy, spread = _mode(bins, start, memory, report)
        if bins.dt == fine.dt:
            return bins, linear, z, discrepancy, spread, 0.0
        bins = replace(bins, correction=tuple(step_change(bins, fine, z)))
        linear, z, discrepancy, spread = _mode(bins, z, memory, report)
        shift = mode_shift(step_change(bins, fine, z), discrepancy, linear, spread)
        if shift <= _MAX_SHIFT:
            break
        start = z
    return bins, linear, z, discrepancy, spread, shift


def _mode(
    bins: Bins, z: Array, memory: bool, report: Callable[[float, str], None]
) -> tuple[list[LogResiduals], Array, Discrepancy, Array]:
    """Return linearisation, mode, covariance numbers and posterior covariance, learnt in turns."""
    linear = linearise(bins, z)
    for turn in range(3):  # the numbers change little once the mode is near
        report(0.03 + 0.02 * turn, "learning the model error")
        discrepancy = fit_discrepancy(linear, z) if memory else _white(bins, linear)
        z, spread, moved = find_mode(bins, z, discrepancy, linear)
        linear = linearise(bins, z)
        if moved < 0.2:
            break
    if memory:
        discrepancy = replace(discrepancy, inflation=log_jackknife(discrepancy, linear, z))
        z, spread, _ = find_mode(bins, z, discrepancy, linear)
        linear = linearise(bins, z)
    return linear, z, discrepancy, spread


def _white(bins: Bins, linear: Sequence[LogResiduals]) -> Discrepancy:
    """Return independent residuals of the size that they have."""
    parts = [
        np.concatenate([log.residual[log.output == j] for log in linear])
        for j in range(len(bins.plant.outputs))
    ]
    return white([float(np.std(part)) for part in parts])


def _choose(plant: Plant, free: Sequence[str] | None, n: int, spread: Array) -> list[int]:
    """Return which free parameters are sampled."""
    if free is None:
        return sorted(np.argsort(np.diag(spread))[:n].tolist())
    for name in free:
        if name not in plant.free:
            raise UserError(f"{name!r} is not a free parameter", mend=f"choose from {', '.join(plant.free)}")
    if not free:
        raise UserError("no parameter to sample", mend=f"choose from {', '.join(plant.free)}")
    return [plant.free.index(name) for name in dict.fromkeys(free)]


def _inside(candidates: Array, target: Likelihood, n: int) -> Array:
    """Return n starts with a finite posterior."""
    ok = candidates[np.isfinite(target.log_posterior(candidates))]
    if len(ok) < n:
        raise UserError(
            "the fit lies at a bound of its parameters, so their posterior cannot be sampled",
            mend="widen the bounds and fit again",
        )
    return np.asarray(ok[:n])


def _autocorrelation(steps: Array) -> Array:
    """Return the integrated autocorrelation times, never below one step."""
    from emcee.autocorr import integrated_time

    return np.asarray(np.maximum(integrated_time(steps, tol=0, quiet=True), 1.0), dtype=float)


def _record(
    plant: Plant,
    bins: Bins,
    sampled: Sequence[int],
    chain: Chain,
    whole: Array,
    discrepancy: Discrepancy,
    shift: float,
) -> Posterior:
    """Return the record, in natural units."""
    names = tuple(plant.free[i] for i in sampled)
    prior = bins.prior
    full = np.zeros((*chain.steps.shape[:2], len(plant.free)))
    full[..., list(sampled)] = chain.steps
    natural = prior.natural(full)[..., list(sampled)]
    low, mid, high = np.quantile(whole, [0.05, 0.5, 0.95], axis=0)
    length = len(chain.steps) / float(np.max(chain.tau))
    verdict = f"{'converged' if chain.converged else 'not converged'}: {length:.0f} autocorrelation times"
    about = (
        f"bins of {bins.average:g} s, simulated with a step of {bins.dt:g} s; "
        f"{discrepancy.describe(plant.outputs)}; sensor offsets and start of each log integrated out"
    )
    return Posterior(
        free=plant.free,
        sampled=names,
        samples=whole,
        units={name: plant.units.get(name, "1") for name in plant.free},
        fitted={name: plant.values[name] for name in plant.free},
        chain=replace(chain, steps=natural),
        tau=dict(zip(names, chain.tau.tolist())),
        n_steps=len(chain.steps),
        converged=chain.converged,
        acceptance=chain.acceptance,
        quantiles={name: (float(a), float(b), float(c)) for name, a, b, c in zip(plant.free, low, mid, high)},
        likelihood=about,
        step_shift=shift,
        verdict=verdict,
    )


def _arviz() -> Any:
    """Return arviz, whose import announces its next major version once a day."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        import arviz
    return arviz


def _silent(fraction: float, what: str) -> None:
    """Report to nobody."""
