"""Grey-box fit: from a network, or a model of the user's own, and logs to a plant with its covariance.

1. Least squares with priors as residuals, from the prior medians
   (:mod:`thermogrip.sysid.greybox.problem`).
2. The correlation of residuals (tau) is measured on the fit, which is repeated with more weight where they
   are whiter than one reading a minute.
3. Covariance (:mod:`thermogrip.sysid.greybox.sandwich`), and which parameters are practically identifiable
   (:mod:`thermogrip.sysid.greybox.identifiability`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.log_files import Logs
from thermogrip.datasets.parallel import Progress
from thermogrip.datasets.schema import Log, columns, log_name
from thermogrip.sysid.data.data_quality import reading_excess
from thermogrip.sysid.greybox.identifiability import describe
from thermogrip.sysid.greybox.problem import Problem, make_problem
from thermogrip.sysid.greybox.sandwich import score_covariance
from thermogrip.sysid.models.model import GreyModel
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.plant import plant_data
from thermogrip.sysid.plant.log_grid import cut_stretches, match_logs, rows_of
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.plant.simulation import find_starts, predict

_HUGE = 1e150  # residuals beyond it would overflow when squared
_WARM_ROWS = 30  # of a log, from whose readings its start is estimated at least
_STUCK = 5.0  # rms residual in sensor sd from which a fit does not explain the logs


def bounded_least_squares(
    residual: Callable[[Array], Array],
    jacobian: Callable[[Array], Array],
    z0: Array,
    *,
    low: Array,
    high: Array,
    evaluations: int = 200,
    tolerance: float = 1e-5,
) -> OptimizeResult:
    """Minimise |r|^2 inside a box, by r (m,) and J (m, n) at a point; see
    :func:`scipy.optimize.least_squares`, for what is not finite is huge here and never wins."""

    def finite(z: Array) -> Array:
        r = np.nan_to_num(residual(z), nan=_HUGE, posinf=_HUGE, neginf=-_HUGE)
        return np.asarray(np.clip(r, -_HUGE, _HUGE))

    def finite_slopes(z: Array) -> Array:
        return np.nan_to_num(jacobian(z), nan=0.0, posinf=0.0, neginf=0.0)

    # combinations of parameters that the logs barely determine make |r|^2 a narrow curved valley, in which
    # SciPy's other method with bounds stops: at 201 for 51 on a printer's heater block
    return least_squares(
        finite,
        np.clip(z0, low, high),
        finite_slopes,
        bounds=(low, high),
        method="dogbox",
        ftol=tolerance,
        max_nfev=evaluations,
    )


def fit_network(network: GreyModel | str | Path, logs: Logs, *, progress: Progress | None = None) -> Plant:
    """Fit a network, or a model of the user's own, to logs.

    Parameters
    ----------
    network : GreyModel, str or Path
        A network or a model of the user's own, or the name or path of a network.
    logs : Log, DataFrame, str, Path, or sequence of them
        All are fitted together.
    progress : callable, optional
        Called with (fraction done, what).

    Returns
    -------
    Plant
        With covariance, noise, pooled offsets, valid ranges, ``scores`` (identifiability, weights) and a
        verdict.

    Raises
    ------
    UserError
        If a log lacks a signal of the network, or has no readings.

    Examples
    --------
    A heater of 1 W per full scale on 2 J/K, losing 0.02 W/K, found again from its own simulation:

    >>> from thermogrip.datasets.schema import make_log
    >>> from thermogrip.sysid.greybox.problem import prior_plant
    >>> truth = prior_plant(load_network("tclab"))
    >>> truth = replace(truth, values=truth.values | {"G_amb": 0.014, "power_1": 1.3})
    >>> t = np.arange(0.0, 1200.0, 2.0)
    >>> q1, q2, room = 60.0 * (t % 600 < 300), 40.0 * (t % 400 < 200), np.full(t.size, 23.0)
    >>> signals = {"q1": (q1, "percent", "input"), "q2": (q2, "percent", "input")}
    >>> readings = {"t1": (room, "degC", "output"), "t2": (room, "degC", "output")}
    >>> run = truth.simulate(make_log(t, signals | readings))
    >>> plant = fit_network("tclab", [run])
    >>> round(plant.values["G_amb"], 4), round(plant.values["power_1"], 2)
    (0.0139, 1.3)
    """
    report = progress or (lambda fraction, what: None)
    model = load_network(network) if isinstance(network, (str, Path)) else network
    logs, _ = match_logs(model, logs)
    if not logs:
        raise UserError("no log to fit", hint="give at least one")
    report(0.0, "preparing the model")
    signals = (*model.inputs, *model.disturbances, *model.outputs)
    rows = [rows_of(log, model.inputs, model.outputs, model.disturbances) for log in logs]
    logged = dict(zip(signals, np.concatenate([columns(log, signals) for log in logs]).T))
    spread = {name: float(np.nanstd(logged[name])) for name in model.outputs}
    runs = partial(free_runs, logs)
    model = model.prepared(runs, spread)
    problem = make_problem(model, logs, average=model.average, independent=model.independent)
    report(0.0, "fitting from the priors")
    solution = _descend(problem, np.zeros(len(problem.free)), report, (0.0, 0.6))
    tau = residual_tau(problem.errors(solution.x), problem.tau)
    # data have at least the weight of one reading a minute: a slow error of the model must not leave the fit
    # to the priors
    whiter = tau < 0.8 * problem.tau
    if whiter.any():
        problem = replace(problem, tau=np.where(whiter, tau, problem.tau))
        solution = _descend(problem, solution.x, report, (0.8, 0.95))
    finer = model.prepared(runs, spread, problem.parameters(solution.x[None])[0])
    if finer is not model:  # its step was short enough at the prior, and is not where the fit ended
        refined = make_problem(finer, logs, average=model.average, independent=model.independent)
        problem = replace(refined, tau=problem.tau)
        solution = _descend(problem, solution.x, report, (0.9, 0.95))
    report(0.95, "covariance")
    plant = _as_plant(problem, solution)
    scores = replace(plant.scores, reading_excess=reading_excess(rows, model.outputs, problem.average))
    valid = {name: (float(np.nanmin(values)), float(np.nanmax(values))) for name, values in logged.items()}
    plant = plant.with_medians({name: logged[name] for name in model.disturbances})
    report(1.0, "fitted")
    return replace(plant, valid=valid, fitted_to=plant_data.fit_logs(logs), scores=scores)


def residual_tau(errors: Sequence[Sequence[Sequence[Array]]], least: Array) -> Array:
    """Return bins per independent bin of each output, tau = 1 + 2 sum rho_k of the errors' correlation."""
    out = np.array(least, dtype=float)
    for k in range(len(out)):
        series = [stretch[k] for log in errors for stretch in log if stretch[k].size > 20]
        n = sum(s.size for s in series)
        if not n:
            continue
        power = sum(float(s @ s) for s in series)
        tau, longest = 1.0, n / 20  # a log never counts as fewer than twenty readings
        for lag in range(1, max(s.size for s in series) // 2):
            rho = sum(float(s[lag:] @ s[:-lag]) for s in series if s.size > lag) / max(power, 1e-300)
            if rho < 0.05 or tau > longest:
                break
            tau += 2 * rho
        out[k] = min(tau, max(longest, 1.0))
    return out


def _descend(problem: Problem, z0: Array, report: Progress, part: tuple[float, float]) -> OptimizeResult:
    low, high = problem.box
    iterations = count(1)

    def jacobian(z: Array) -> Array:
        iteration = next(iterations)
        share = 1 - 0.85**iteration  # the number of iterations is not known beforehand
        report(part[0] + (part[1] - part[0]) * share, f"fitting, iteration {iteration}")
        return problem.jacobian(z)

    return bounded_least_squares(problem.residual, jacobian, z0, low=low, high=high)


def _as_plant(problem: Problem, solution: OptimizeResult) -> Plant:
    model, z = problem.model, np.asarray(solution.x)
    names = tuple(model.parameters[i] for i in problem.free)
    by_log = problem.by_log(z, central=True)
    spread = score_covariance(problem, z, by_log)
    data = np.vstack([jacobian for _, jacobian in by_log])
    width = 1e-6 * (1 + np.abs(z))
    at_ends = zip(names, z <= problem.box[0] + width, z >= problem.box[1] - width)
    on_bound = {name: "low" if low else "high" for name, low, high in at_ends if low or high}
    identifiability = describe(names, data, spread.covariance, on_bound, shift=z)
    p = problem.parameters(z[None])[0]
    errors, starts = problem.errors(z), problem.start(z)
    by_output = [np.concatenate(parts) for parts in zip(*(stretch for log in errors for stretch in log))]
    rms = [float(np.sqrt(np.mean(error**2))) if error.size else 0.0 for error in by_output]
    first = [begin[0] for begin in starts]
    offsets = dict(zip(model.outputs, np.mean([s.y_offset for s in first], axis=0).tolist()))
    offsets |= dict(zip(model.disturbances, np.mean([s.d_offset for s in first], axis=0).tolist()))
    scores = plant_data.PlantScores(
        identifiability=identifiability,
        average_s=problem.average,
        weight_s={k: float(t * problem.average) for k, t in zip(model.outputs, problem.tau)},
        intervals=plant_data.Intervals(
            numbers=plant_data.ErrorNumbers(**vars(spread.numbers)),
            between_logs=round(spread.phi, 3),
            coarsening=round(spread.coarsening, 3),
        ),
    )
    return replace(
        problem.plant,
        values=dict(zip(model.parameters, p.tolist())),
        free=names,
        covariance=spread.covariance * np.outer(problem.width, problem.width),
        noise=dict(zip(model.outputs, rms)),
        offsets=offsets,
        logs=problem.names,
        scores=scores,
        verdict=_fit_verdict(problem, rms, identifiability, finished=bool(solution.success)),
    )


def _fit_verdict(
    problem: Problem, rms: Sequence[float], identifiability: plant_data.Identifiability, *, finished: bool
) -> str:
    units = [problem.plant.units.get(name, "degC") for name in problem.model.outputs]
    errors = ", ".join(
        f"{name} {error:.2f} {unit}" for name, error, unit in zip(problem.model.outputs, rms, units)
    )
    clauses = [f"in-sample error {errors}"]
    if not finished:
        clauses.append("the fit ran out of iterations")
    if np.max(rms / problem.sd) > _STUCK:
        clauses.append("it does not explain the logs, do not use it")
    if not identifiability.identifiable:
        clauses.append(f"not practically identifiable: {identifiability.flat[0]}")
    if identifiability.on_bound:
        clauses.append(f"on bounds: {', '.join(identifiability.on_bound)}")
    if identifiability.prior_only:
        clauses.append(f"known from the prior only: {', '.join(identifiability.prior_only)}")
    return "; ".join(clauses)


def free_runs(logs: Sequence[Log], model: GreyModel, p: Array) -> list[tuple[str, Array]]:
    """Return the free runs of a model over logs with parameters p, by log and stretch,
    from what the model states of a log's beginning and thirty rows, or half of a short log."""
    values, sensors = dict(zip(model.parameters, p.tolist())), dict(model.sensor_sd)
    plant = Plant(model, values, dt=model.dt, units=model.units, noise=sensors)
    out: list[tuple[str, Array]] = []
    for log in logs:
        stretches = cut_stretches(plant, log)
        first = stretches[0].time
        warmup = max(model.warmup, _WARM_ROWS * float(np.median(np.diff(first))))
        starts = find_starts(plant, p, stretches, min(warmup, max(float(first[-1]) / 2, model.dt)))
        out += [(log_name(log), run) for run in predict(model, model.dt, p[None], stretches, starts)]
    return out
