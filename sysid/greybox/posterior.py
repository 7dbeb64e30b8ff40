"""Posterior of a grey-box fit: whole parameter vectors from emcee, or a few draws for bands.

**Density.** What a fit leaves open is how far its simulations may move, d(z) = r(z) - r(z_fit), all logs
together:

    ln p(z) = -1/2 |z - z_fit|^2 - 1/2 |K^(1/2) Q'd(z)|^2 - 1/(2 T) |d(z) - Q Q'd(z)|^2.

Q spans the slopes J = Q S R' of the fit. With A = J'J, V the learnt covariance of the score
(:mod:`~thermogrip.sysid.greybox.sandwich`) and K = S R' V^-1 R S, the second term is A V^-1 A near the fit.
The third, 0 where the plant is linear, excludes runs that the slopes do not predict.

**Draws.** Each is a fit of its own, to perturbed readings from a perturbed prior, a draw from p where the
model is linear.

**Sampling.** emcee moves the few parameters z_s that the data determine best relative to the prior; the
others are integrated out to second order about one Gauss-Newton step from their conditional mean, and drawn
afterwards, each as a fit of its own.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.files import atomic_path
from thermogrip.datasets.log_files import Logs, as_logs
from thermogrip.datasets.parallel import Progress
from thermogrip.datasets.schema import Log
from thermogrip.sysid.greybox.fit import bounded_least_squares
from thermogrip.sysid.greybox.noise_model import ErrorModel
from thermogrip.sysid.greybox.problem import DIFFERENCE_STEP, Problem, make_problem
from thermogrip.sysid.greybox.sandwich import ScoreCovariance, score_covariance
from thermogrip.sysid.models.model import GreyModel
from thermogrip.sysid.plant.log_grid import match_logs, roles_of
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.plant.plant_data import Sampling


@dataclass(frozen=True)
class DrawSettings:
    """Numbers of the draws and of the chain."""

    enough: float = 1e-2  # share of the objective by which the last step lowers it
    evaluations: int = 40  # at most, of one: with 20 the objective of one log's is a tenth larger
    least_error: float = 1e-3  # of A: the least that V may be in any direction
    unseen_slope: float = 1e-9  # of the largest one: what moves the runs by less is lost in the differences
    proposal_freedom: int = 6  # of the t: a tail
    proposal_width: float = 1.25  # the factor s
    check_steps: int = 50  # of the chain, between two looks at its length
    n_sampled: int = 6  # parameters: a chain of emcee's walkers slows down with each more


DRAW = DrawSettings()


class RandomizedMap:
    """The density of plants that agree with the logs, and draws from it."""

    def __init__(self, problem: Problem, z: Array, uncertainty: ScoreCovariance) -> None:
        self.problem, self.z = problem, np.asarray(z, dtype=float)
        self.starts = problem.start(self.z)
        self.low, self.high = problem.box
        by_log = problem.by_log(self.z, central=True)
        self._fitted = np.concatenate([r for r, _ in by_log])
        span, size, turn = np.linalg.svd(np.vstack([J for _, J in by_log]), full_matrices=False)
        # directions that move no run are left to the prior's term
        moves_runs = size > DRAW.unseen_slope * size.max(initial=0.0)
        self._span = span[:, moves_runs]
        size = size[moves_runs]
        turn = turn[moves_runs]
        along = turn / size[:, None]
        # without model discrepancy, which the parameters have absorbed and a plant that is to predict
        # readings keeps
        error = along @ uncertainty.spread @ along.T  # S^-1 R V R' S^-1, about the error's covariance along Q
        value, axes = np.linalg.eigh((error + error.T) / 2)
        root = axes.T / np.sqrt(np.maximum(value, 0.0) + DRAW.least_error)[:, None]
        self._root = np.linalg.qr(root)[1]  # K = root' root, and no rounding makes it indefinite
        self._root *= np.where(np.diag(self._root) < 0, -1.0, 1.0)[:, None]
        self._pull = turn.T * size @ self._root.T  # J'Q K^(1/2)'
        self.information = self._pull @ self._pull.T
        # T = tr(P^-1 V) / tr(P^-1 A): J. W. Miller, D. B. Dunson, "Robust Bayesian inference via coarsening",
        # JASA 114 (2019)
        self._loose = 1.0 / np.sqrt(uncertainty.coarsening)

    @property
    def covariance(self) -> Array:
        """Covariance (n_free, n_free) of z near the fit."""
        return np.asarray(np.linalg.inv(np.eye(self.z.size) + self.information))

    def log_profile(self, z: Array, columns: Sequence[int]) -> Array:
        """Return ln p (n,) of the parameters ``columns`` at z (n, n_columns), the others integrated out;
        -inf outside of the bounds."""
        others = np.setdiff1d(np.arange(self.z.size), np.array(columns, dtype=int))
        whole = np.tile(self.z, (len(z), 1))
        whole[:, list(columns)] = z
        out = np.full(len(z), -np.inf)
        inside = np.all((whole >= self.low) & (whole <= self.high), axis=1)
        points = whole[inside]
        if not len(points):
            return out
        if not others.size:
            out[inside] = -self._gradient(points)[1]
            return out
        # H = 1 + A V^-1 A
        H = np.eye(self.z.size) + self.information
        factor = cho_factor(H[np.ix_(others, others)], lower=True)
        # z_o = z_fit - H_oo^-1 H_os (z_s - z_fit) - H_oo^-1 g_o
        tied = H[others][:, list(columns)] @ (points - self.z)[:, list(columns)].T
        points[:, others] = points[:, others] - cho_solve(factor, tied).T
        points = np.clip(points, self.low, self.high)
        step = cho_solve(factor, self._gradient(points)[0][:, others].T).T
        points[:, others] = np.clip(points[:, others] - step, self.low[others], self.high[others])
        gradient, cost = self._gradient(points)
        # ln p(z_s) = ln p(z_s, z_o) + g_o' H_oo^-1 g_o / 2
        other_gradient = gradient[:, others]
        out[inside] = -cost + 0.5 * np.einsum("ki,ik->k", other_gradient, cho_solve(factor, other_gradient.T))
        return out

    def draws(
        self,
        n: int,
        *,
        seed: int = 0,
        held: Array | None = None,
        columns: Sequence[int] = (),
        progress: Progress | None = None,
    ) -> Array:
        """Return draws (n, n_free) of z, in prior units, inside the bounds."""
        # draws of the normal approximation move runs 4 to 40 times as far as these (the rig's logs), for they
        # leave the valley that the logs see
        rng = np.random.default_rng(seed)
        z = np.tile(self.z, (n, 1))
        xi, noise = rng.standard_normal(z.shape), rng.standard_normal((n, len(self._root)))
        moving = np.setdiff1d(np.arange(self.z.size), np.array(columns, dtype=int))
        if held is not None:
            z[:, list(columns)] = held
        for k in range(n):
            if progress is not None:
                progress(k / n, "plants that agree with the logs")
            z[k, moving] = self._draw(z[k], xi[k], noise[k], moving)
        return z

    def _draw(self, z: Array, xi: Array, noise: Array, moving: NDArray[np.int_]) -> Array:
        """Return the parameters ``moving`` of the least objective, the others at z (n_free,)."""

        # |z - z_fit - xi|^2 + |K^(1/2) Q'd(z) - e|^2 + |d(z) - Q Q'd(z)|^2 / T is least, xi, e ~ N(0, 1):
        # J. M. Bardsley, A. Solonen, H. Haario, M. Laine, "Randomize-then-optimize", SIAM J. Sci. Comput. 36
        # (2014)
        def residuals(points: Array) -> Array:
            whole = np.tile(z, (len(points), 1))
            whole[:, moving] = points
            along, off_span = self._moved(whole)
            return np.hstack([whole - self.z - xi, along - noise, off_span])

        def slopes(point: Array) -> Array:
            sign = np.where(point + DIFFERENCE_STEP > self.high[moving], -1.0, 1.0)
            ahead = DIFFERENCE_STEP * np.diag(sign)
            r = residuals(np.vstack([point, point + ahead]))
            return np.asarray(((r[1:] - r[0]) / (DIFFERENCE_STEP * sign[:, None])).T)

        least = bounded_least_squares(
            lambda point: residuals(point[None])[0],
            slopes,
            z[moving],
            low=self.low[moving],
            high=self.high[moving],
            evaluations=DRAW.evaluations,
            tolerance=DRAW.enough,
        )
        return np.asarray(least.x)

    def _moved(self, z: Array) -> tuple[Array, Array]:
        """Return K^(1/2) Q'd (n, n_free) and d, off the span and weighed (n, m)."""
        with np.errstate(over="ignore", invalid="ignore"):
            d = np.concatenate(self.problem.residuals(z, self.starts), axis=1) - self._fitted
            along = d @ self._span
            return along @ self._root.T, self._loose * (d - along @ self._span.T)

    def _gradient(self, z: Array) -> tuple[Array, Array]:
        """Return g (n, n_free), with the slopes of the fit, and -ln p (n,); what blew up has no pull."""
        along, off_span = self._moved(z)
        with np.errstate(over="ignore", invalid="ignore"):
            # g = z - z_fit + J'Q K Q'd
            gradient = z - self.z + along @ self._pull.T
            cost = 0.5 * (
                ((z - self.z) ** 2).sum(axis=1) + (along**2).sum(axis=1) + (off_span**2).sum(axis=1)
            )
        finite = np.isfinite(cost) & np.isfinite(gradient).all(axis=1)
        return np.where(finite[:, None], gradient, 0.0), np.where(finite, cost, np.inf)


# Foreman-Mackey, Hogg, Lang, Goodman, "emcee: The MCMC Hammer", PASP 125 (2013) 306, and the package's
# documentation on autocorrelation
LENGTH = 50  # autocorrelation times that make a chain long enough


@dataclass(frozen=True, eq=False)
class Chain:
    """What emcee did."""

    steps: Array  # (n_step, n_walker, n_dim), the whole chain, burn-in included
    log_posterior: Array  # (n_step, n_walker)
    tau: Array  # (n_dim,), integrated autocorrelation time of each dimension [steps]
    converged: bool  # whether the chain is longer than 50 tau in every dimension
    acceptance: float  # share of moves that were accepted

    @property
    def settled(self) -> Array:
        """The steps (n, n_walker, n_dim) behind the burn-in."""
        return self.steps[min(int(np.ceil(3 * np.max(self.tau))), len(self.steps) // 2) :]

    @property
    def ess(self) -> Array:
        """Effective number of samples (n_dim,) behind the burn-in, by the autocorrelation."""
        return np.asarray(self.settled[..., 0].size / self.tau)

    def kept(self, n: int) -> Array:
        """Return about ``n`` rows (n, n_dim), spread evenly over walkers and steps behind the burn-in."""
        # walker by walker: a stride over all walkers of a step may meet the same few at every step
        flat = self.settled.swapaxes(0, 1).reshape(-1, self.steps.shape[-1])
        return np.asarray(flat[np.linspace(0, len(flat) - 1, min(n, len(flat))).astype(int)])


def run_chain(
    log_posterior: Callable[[Array], Array],
    start: Array,
    *,
    max_steps: int,
    normal: tuple[Array, Array] | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Chain:
    """Run emcee until the chain is 50 autocorrelation times long, or ``max_steps`` are done."""
    import emcee

    n_walkers, n_dim = start.shape
    # no snooker moves: those of emcee 3.1.6 sample a 6-D standard normal with sd 0.82.  With half of the
    # moves proposals x' ~ t_6(m, s^2 C) about the normal approximation, accepted with min(1, p(x') t(x) /
    # (p(x) t(x'))), chains converge in 400 steps for 1,100 and in 650 for 1,500 (the gripper's, two logs and
    # one)
    moves = [emcee.moves.DEMove()]
    if normal is not None:
        moves.append(emcee.moves.MHMove(_proposals(*normal), n_dim))
    sampler = emcee.EnsembleSampler(n_walkers, n_dim, log_posterior, moves=moves, vectorize=True)
    state = emcee.State(start, random_state=np.random.RandomState(seed).get_state())
    tau = np.full(n_dim, np.nan)
    for _ in sampler.sample(state, iterations=max_steps, skip_initial_state_check=True):
        n_step = sampler.iteration
        if n_step % DRAW.check_steps == 0 or n_step == max_steps:
            with np.errstate(invalid="ignore"):
                tau = np.asarray(sampler.get_autocorr_time(tol=0, quiet=True))
            # the whole chain for a dimension in which a walker has not moved yet
            tau = np.maximum(np.where(np.isfinite(tau), tau, n_step), 1.0)
            slowest = float(np.max(tau))
            if progress is not None:
                share = max(n_step / max_steps, min(1.0, n_step / (LENGTH * slowest)))
                progress(share, f"sampling, {n_step / slowest:.0f} tau")
            if n_step > LENGTH * slowest:
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
    from scipy.stats import multivariate_t  # slow to import, and draws do without

    t: Any = multivariate_t(mean, DRAW.proposal_width**2 * covariance, df=DRAW.proposal_freedom)

    def propose(points: Array, random: np.random.RandomState) -> tuple[Array, Array]:
        new = t.rvs(len(points), random_state=random).reshape(points.shape)
        return new, t.logpdf(points) - t.logpdf(new)

    return propose


@dataclass(frozen=True, eq=False)
class Posterior:
    """The record of a posterior."""

    free: tuple[str, ...]  # all parameters, in the order of ``samples``
    sampled: tuple[str, ...]  # those that emcee moved; the others were integrated out
    samples: Array  # (n, n_free), whole parameter vectors in natural units
    chain: Chain  # of the sampled parameters, in natural units
    sampling: Sampling  # its verdict, and what was assumed about the residuals
    off_centre: float  # of the medians from the fitted values, in standard deviations, at most

    def inference_data(self) -> Any:
        """Return the chain and, as ``posterior_whole``, the whole samples: arviz ``InferenceData``."""
        with warnings.catch_warnings():  # its import announces its next major version once a day
            warnings.simplefilter("ignore", FutureWarning)
            arviz: Any = import_module("arviz")
        chain = np.moveaxis(self.chain.steps, 1, 0)  # arviz wants (chain, draw)
        how = self.sampling
        about = {"likelihood": how.likelihood, "verdict": how.verdict, "converged": int(how.converged)}
        data = arviz.from_dict(
            posterior={name: chain[:, :, i] for i, name in enumerate(self.sampled)},
            sample_stats={"lp": self.chain.log_posterior.T},
            attrs=about | {f"tau_{name}": tau for name, tau in how.tau.items()},
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
    logs: Logs,
    *,
    max_steps: int = 4000,
    n_samples: int = 200,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[Plant, Posterior]:
    """Sample the parameters of a fitted plant.

    Parameters
    ----------
    plant : Plant
        A fitted network, or model of the user's own with priors.
    logs : Log, DataFrame, str, Path, or sequence of them
        The logs of the fit.
    max_steps : int, optional
        Give up after so many steps of the ensemble; the record is then marked as not converged.
    n_samples : int, optional
        Samples kept.
    seed : int, optional
    progress : callable, optional
        Called with (fraction done, what is being done).

    Returns
    -------
    plant : Plant
        The same plant with ``samples``, and verdict, ``converged``, likelihood and tau in
        ``scores.posterior``; its values are unchanged.
    posterior : Posterior

    Raises
    ------
    UserError
        If the plant has no free parameter or no prior, or a log does not fit.

    Examples
    --------
    >>> plant = fit_network("gripper", logs)  # doctest: +SKIP
    >>> plant, posterior = sample_posterior(plant, logs)  # minutes  # doctest: +SKIP
    >>> posterior.chain.converged, plant.draw(1).values["flow"]  # doctest: +SKIP
    """
    report = progress or (lambda fraction, what: None)
    report(0.0, "averaging the logs")
    logs = as_logs(logs, known=roles_of(plant))
    problem = fit_problem(plant, logs)
    z = problem.standard(plant.values)
    report(0.02, "learning the model error")
    uncertainty = score_covariance(problem, z)
    target = RandomizedMap(problem, z, uncertainty)
    spread = target.covariance
    sampled = sorted(np.argsort(np.diag(spread))[: DRAW.n_sampled].tolist())
    rng = np.random.default_rng(seed)
    n_walkers = 2 * len(sampled) + 4
    draws = rng.multivariate_normal(z[sampled], spread[np.ix_(sampled, sampled)], size=8 * n_walkers)

    log_posterior = partial(target.log_profile, columns=sampled)
    start = draws[np.isfinite(log_posterior(draws))][:n_walkers]
    if len(start) < n_walkers:
        raise UserError(
            "the fit lies at a bound of its parameters, so their posterior cannot be sampled",
            hint="widen the bounds and fit again",
        )
    chain = run_chain(
        log_posterior,
        start,
        max_steps=max_steps,
        normal=(z[sampled], spread[np.ix_(sampled, sampled)]),
        seed=seed,
        progress=lambda f, w: report(0.1 + 0.85 * f, w),
    )
    report(0.95, "completing the samples")
    sampled_z = chain.kept(n_samples)
    whole = target.draws(len(sampled_z), seed=seed, held=sampled_z, columns=sampled)
    record = _record(plant, problem, z, sampled, chain, whole, uncertainty)
    report(1.0, record.sampling.verdict)
    scores = replace(plant.scores, posterior=record.sampling)
    return replace(plant, samples=record.samples, scores=scores), record


def with_draws(
    plant: Plant, problem: Problem, n: int = 24, *, seed: int = 0, progress: Progress | None = None
) -> Plant:
    """Return the plant with a few draws of its posterior as its samples, for bands and closed loops."""
    z = problem.standard(plant.values)
    intervals = plant.scores.intervals
    numbers = None
    if intervals is not None and intervals.numbers is not None and problem.names == tuple(plant.logs):
        numbers = ErrorModel(**vars(intervals.numbers))  # the fit has learnt it already
    target = RandomizedMap(problem, z, score_covariance(problem, z, numbers=numbers))
    drawn = problem.parameters(target.draws(n, seed=seed, progress=progress))
    return replace(plant, samples=drawn[:, list(problem.free)])


def fit_problem(plant: Plant, logs: Sequence[Log]) -> Problem:
    """Return the least-squares problem of the fit, with its weights."""
    if not plant.free:
        raise UserError("the plant has no free parameter", hint="fit a network first")
    model = plant.model
    if not isinstance(model, GreyModel):
        raise UserError(f"a {model.kind} model has no priors", hint="fit a network, or a model with priors")
    bin_s = plant.scores.average_s or model.average
    logs, _ = match_logs(model, logs)
    problem = make_problem(model, logs, average=bin_s, independent=model.independent)
    weights, bin_s = plant.scores.weight_s, problem.average
    tau = [weights.get(name, t * bin_s) / bin_s for name, t in zip(model.outputs, problem.tau)]
    return replace(problem, tau=np.maximum(tau, 1.0))


def _record(
    plant: Plant,
    problem: Problem,
    z: Array,
    sampled: Sequence[int],
    chain: Chain,
    whole: Array,
    uncertainty: ScoreCovariance,
) -> Posterior:
    """Return the record, in natural units."""
    names = tuple(plant.free[i] for i in sampled)
    full = np.tile(z, (*chain.steps.shape[:2], 1))
    full[..., list(sampled)] = chain.steps
    steps = problem.parameters(full.reshape(-1, z.size))[:, [problem.free[i] for i in sampled]]
    drawn = replace(chain, steps=steps.reshape(chain.steps.shape))
    samples = problem.parameters(whole)[:, list(problem.free)]
    length = len(chain.steps) / float(np.max(chain.tau))
    verdict = f"{'converged' if chain.converged else 'not converged'}: {length:.0f} autocorrelation times"
    units = [
        (float(w), plant.units.get(name, "degC"))
        for name, w in zip(plant.outputs, problem.sd * np.sqrt(problem.tau))
    ]
    about = (
        f"bins of {problem.average:g} s; "
        f"{uncertainty.numbers.describe(plant.outputs, uncertainty.bin_s, units)}; "
        f"logs differ {uncertainty.phi:.1f} times as much as expected (variance); all in all a log has "
        f"{uncertainty.coarsening:.1f} times less information than the fit's weights assume; "
        "sensor offsets and start of each log allowed for"
    )
    sampling = Sampling(verdict, chain.converged, about, dict(zip(names, chain.tau.tolist())))
    off_centre = float(np.max(np.abs(np.median(whole, axis=0) - z) / whole.std(axis=0)))
    return Posterior(plant.free, names, samples, drawn, sampling, off_centre)
