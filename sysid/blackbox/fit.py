"""One black-box rung: choose a structure, fit it on all logs, return a Plant that knows its errors.

``arx``, ``oe``, ``subspace``, ``sindy`` and ``neural`` differ in the family of models they try; everything
else is shared: the averaging, the choice by held-out free run
(:mod:`thermogrip.sysid.blackbox.order_selection`), and what the Plant carries along.  Where the averaging is
not prescribed, both the averaged rate and the logs' own are tried, for a coarse converter calls for the one
and a delay for the other.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log
from thermogrip.sysid.blackbox.arx import arx_family, default_terms
from thermogrip.sysid.blackbox.order_selection import Choice, Family, Model, Structure, choose
from thermogrip.sysid.blackbox.output_error import oe_family
from thermogrip.sysid.blackbox.subspace import subspace_family
from thermogrip.sysid.data.data_quality import reading_excess
from thermogrip.sysid.plant.fit_record import PlantScores, fit_logs
from thermogrip.sysid.plant.log_grid import Grid, make_grid, signals
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.plant.simulation import READING_EVERY

__all__ = ["BLACK_BOXES", "Rung", "family_of", "fit_black_box", "refit"]

Array = NDArray[np.float64]

BLACK_BOXES = ("arx", "oe", "subspace", "sindy", "neural")

AVERAGED = ("sindy", "neural")  # fitted at the averaged rate alone

MAX_ROWS = 8000  # beyond it the logs' own rate is not tried beside the averaged one


@dataclass(frozen=True, eq=False)
class Rung:
    """A fitted black box."""

    kind: str
    plant: Plant  # fitted on all logs
    model: Model  # the plant's
    choice: Choice  # the structure with its held-out errors
    grid: Grid  # the data that it was fitted on


def fit_black_box(
    kind: str,
    logs: Sequence[Log],
    *,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    disturbances: Sequence[str] | None = None,
    average: float | None = None,
    warmup: float | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> Rung:
    """Fit one kind of black box to one or several logs.

    Parameters
    ----------
    kind : {"arx", "oe", "subspace", "sindy", "neural"}
    logs : sequence of Log
    inputs, outputs, disturbances : sequence of str, optional
        Names of the signals; by role where absent.
    average : float, optional
        Step [s]; both the chosen and the logs' own are tried where absent.
    warmup : float, optional
        Seconds whose readings set the state of a held-out stretch; 5 s for whole logs (they begin at rest),
        50 samples for stretches cut out of a log, where absent.
    progress : callable, optional
        Called with (fraction done, what).

    Raises
    ------
    UserError
        If the data are too short or no structure survives the held-out free run.

    Examples
    --------
    >>> from thermogrip.datasets.schema import make_log
    >>> rng = np.random.default_rng(0)
    >>> q = np.repeat(rng.random(60), 20)
    >>> from scipy.signal import lfilter
    >>> y = 25 + lfilter([0, 0.5], [1, -0.95], q) + 0.01 * rng.standard_normal(1200)
    >>> log = make_log(np.arange(1200.0), {"q": (q, "1", "input"), "t": (y, "degC", "output")})
    >>> rung = fit_black_box("oe", [log], average=1.0)
    >>> rung.choice.structure.label, rung.plant.model.time_constants().round(0).tolist()  # -1/ln 0.95 s
    ('na 1, nb 1, delay 1', [20.0])
    """
    u, y, d = signals(logs, inputs=inputs, outputs=outputs, disturbances=disturbances)
    first = make_grid(logs, inputs=u, outputs=y, disturbances=d, average=average)
    grids = [first]
    native_rows = sum(len(s.time) for s in first.segments) * first.dt / first.native
    if average is None and first.dt > 1.5 * first.native and native_rows <= MAX_ROWS and kind not in AVERAGED:
        own = make_grid(logs, inputs=u, outputs=y, disturbances=d, average=first.native)
        grids.append(replace(own, why=f"the logs' own: held-out free runs err less than at {first.dt:.3g} s"))
    best: tuple[Grid, Choice] | None = None
    refused: UserError | None = None
    for at, grid in enumerate(grids):
        rows = _warmup_rows(grid, warmup)

        def told(done: float, what: str, at: int = at) -> None:
            if progress is not None:
                progress((at + done) / len(grids), f"{kind}, {what}")

        try:
            choice = choose(grid, family_of(kind), warmup=rows, progress=told)
        except UserError as error:
            refused = error
            continue
        if best is None or choice.error < best[1].error:
            best = (grid, choice)
    if best is None:
        raise refused if refused is not None else UserError(f"{kind} could not be fitted")
    grid, choice = best
    model = refit(kind, grid, choice.structure)
    if model is None:
        raise UserError(
            f"{kind}: the chosen structure is unstable on all data together",
            hint="average more, or use another model",
        )
    plant = _plant(model, grid, choice, _warmup_rows(grid, warmup), logs)
    return Rung(kind, plant, model, choice, grid)


def family_of(kind: str) -> Family:
    """Return the family of models that a kind tries."""
    if kind == "arx":
        return arx_family
    if kind == "oe":
        return _oe
    if kind == "subspace":
        return subspace_family
    if kind == "sindy":
        from thermogrip.sysid.blackbox.sindy import sindy_family  # pulls in pysindy

        return sindy_family
    if kind == "neural":
        from thermogrip.sysid.blackbox.neural import neural_family

        return neural_family
    raise UserError(f"no model of kind {kind!r}", hint=f"choose from {', '.join(BLACK_BOXES)}")


def refit(kind: str, grid: Grid, structure: Structure) -> Model | None:
    """Return the model of this structure on all of the grid, None where it is unstable."""
    if kind == "arx":
        models: Mapping[Structure, Model] = arx_family(grid, only=structure)
    elif kind == "oe":
        models = _oe(grid, structure)
    elif kind == "subspace":
        models = subspace_family(grid, only=structure)
    elif kind == "sindy":
        from thermogrip.sysid.blackbox.sindy import sindy_family

        models = sindy_family(grid, only=structure)
    else:
        from thermogrip.sysid.blackbox.neural import neural_family

        models = neural_family(grid, only=structure)
    return models.get(structure)


def _oe(grid: Grid, only: Structure | None = None) -> Mapping[Structure, Model]:
    # magnitudes and signed squares, never products that ride on one log's pump
    return oe_family(grid, terms=default_terms(grid, switched=False), only=only)


def _warmup_rows(grid: Grid, warmup: float | None) -> int:
    seconds = warmup or (5.0 if len(grid.logs) >= 3 else 50 * grid.native)
    return max(2, round(seconds / grid.dt))


def _plant(model: Model, grid: Grid, choice: Choice, rows: int, logs: Sequence[Log]) -> Plant:
    scale = np.maximum(grid.output_spread(), 1e-9)
    prior = choice.prior
    # a simulation counts one independent reading in 10 s, the choice counted every row
    independent = min(1 + rows * grid.dt / READING_EVERY, rows + 1) / (rows + 1)
    noise, nuisance = prior.noise * scale * np.sqrt(independent), prior.nuisance * scale
    rmse = np.sqrt(np.mean(choice.rmse**2, axis=0))
    scores = PlantScores(
        structure=choice.structure.label,
        average_s=grid.dt,
        average_why=grid.why,
        reading_excess=reading_excess(logs, grid.outputs, grid.dt),
        folds=list(choice.folds),
        held_out_rmse={name: float(v) for name, v in zip(grid.outputs, rmse)},
        held_out_by_part={name: part.tolist() for name, part in zip(grid.outputs, choice.rmse.T)},
    )
    return Plant(
        model,
        {},
        dt=grid.dt,
        units=dict(grid.units),
        noise={name: float(v) for name, v in zip(grid.outputs, noise)},
        nuisance={name: float(v) for name, v in zip(grid.outputs, nuisance)},
        valid=grid.ranges(),
        logs=grid.logs,
        scores=scores,
        fitted_to=fit_logs(logs),
    )
