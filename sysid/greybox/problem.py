"""The least-squares problem behind a grey-box fit.

**Unknowns.** z = (theta - theta_prior) / sd_prior for each free parameter, theta its logarithm where it is
positive; z ~ N(0, 1) is the prior and adds n residuals z to the cost.

**Residuals.** Readings and simulation are averaged over bins of a few seconds with the same weights; their
difference is divided by the sensor's ``sd``. The model's error is slow, so neighbouring bins are
correlated: all residuals of an output are divided by sqrt(tau), with tau the bins per independent one.

**Starts** are nuisances of each log (:mod:`thermogrip.sysid.plant.simulation`), estimated anew at each z and
held while the sensitivities are taken: differences over all parameters in one batch.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, log_name
from thermogrip.sysid.models.model import GreyModel
from thermogrip.sysid.models.state_space import symmetric_root
from thermogrip.sysid.plant.log_grid import Stretch, cut_stretches
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.plant.simulation import Start, find_starts, predict

DIFFERENCE_STEP = 1e-4  # of a prior sd


@dataclass(frozen=True, eq=False)
class _Bins:
    """Averages of one stretch, per output."""

    operators: tuple[sparse.csr_matrix, ...]  # from the grid to the bins
    means: tuple[Array, ...]  # of the readings
    places: tuple[NDArray[np.int64], ...]  # which bins these are


@dataclass(frozen=True, eq=False)
class Problem:
    """Residuals of a model on logs; see the module's theory."""

    plant: Plant  # the model at its prior
    logs: tuple[tuple[list[Stretch], list[_Bins]], ...]
    names: tuple[str, ...]  # names of the logs
    free: tuple[int, ...]  # where the free parameters stand in p
    average: float  # length of a bin [s]
    sd: Array  # (n_y,), standard deviation of a bin about the model
    tau: Array  # (n_y,), bins per independent one
    _starts: dict[bytes, list[list[Start]]] = field(default_factory=dict)  # of all stretches, at the last z

    @property
    def model(self) -> GreyModel:
        """The equations and their priors."""
        return cast(GreyModel, self.plant.model)  # make_problem takes no other

    @property
    def box(self) -> tuple[Array, Array]:
        """Lower and upper bounds of z, each (n_free,)."""
        ends = np.array([self.plant.bounds[name] for name in self.plant.free], dtype=float).reshape(-1, 2)
        low, high = (self.plant.on_scale(ends.T) - self.plant.theta) / self.width
        return low, high

    def parameters(self, z: Array) -> Array:
        """Return p (k, n_p) for z (k, n_free)."""
        p = np.repeat(self.plant.p[None], len(z), axis=0)
        p[:, list(self.free)] = self.plant.natural(self.plant.theta + z * self.width)
        return p

    def standard(self, values: Mapping[str, float]) -> Array:
        """Return z (n_free,) of parameters by name, inside the box; 0, the prior, for what is not named."""
        named = np.array([values.get(name, self.plant.values[name]) for name in self.plant.free])
        return np.asarray(np.clip((self.plant.on_scale(named) - self.plant.theta) / self.width, *self.box))

    def start(self, z: Array) -> list[list[Start]]:
        """Return the starts of all stretches at z."""
        point = z.tobytes()
        if point not in self._starts:
            p = self.parameters(z[None])[0]
            self._starts.clear()
            self._starts[point] = [
                find_starts(self.plant, p, stretches, float(stretches[0].time[-1]))
                for stretches, _ in self.logs
            ]
        return self._starts[point]

    def residuals(self, z: Array, starts: Sequence[Sequence[Start]]) -> list[Array]:
        """Return the residuals of each log, (k, m_log) each, at z (k, n_free)."""
        return [
            np.concatenate([self.scaled(k, e) for stretch in log for k, e in enumerate(stretch)], axis=1)
            for log in self._bin_errors(self.parameters(z), starts)
        ]

    def scaled(self, k: int, errors: Array) -> Array:
        """Return the errors (k, m) of output k in units of their sd."""
        return np.asarray(errors / float(self.sd[k] * np.sqrt(self.tau[k])))

    def errors(self, z: Array) -> list[list[list[Array]]]:
        """Return the model's errors by log, stretch and output (bins in order of time)."""
        errors_by_log = self._bin_errors(self.parameters(z[None]), self.start(z))
        return [[[error[0] for error in stretch] for stretch in log] for log in errors_by_log]

    def _bin_errors(self, p: Array, starts: Sequence[Sequence[Start]]) -> Iterator[list[list[Array]]]:
        """Yield each log's errors (k, m) by stretch and output, at parameters p (k, n_p)."""
        for (stretches, bins), begin in zip(self.logs, starts):
            runs = predict(self.model, self.plant.dt, p, stretches, begin)
            yield [
                [(o @ run[:, :, k].T).T - m for k, (o, m) in enumerate(zip(cells.operators, cells.means))]
                for run, cells in zip(runs, bins)
            ]

    def residual(self, z: Array) -> Array:
        """Return the residuals (m + n,) of all logs at z (n,), the prior's rows last."""
        return np.concatenate([*(r[0] for r in self.residuals(z[None], self.start(z))), z])

    def jacobian(self, z: Array) -> Array:
        """Return the slopes (m + n, n) of :meth:`residual`."""
        return np.vstack([*(J for _, J in self.by_log(z)), np.eye(len(z))])

    def by_log(self, z: Array, *, central: bool = False) -> list[tuple[Array, Array]]:
        """Return residual (m,) and Jacobian (m, n) of each log, without the prior, by ``central`` differences
        (twice the cost) where a null direction is looked for."""
        # a step outside the box may not be simulated
        sign = np.where(z + DIFFERENCE_STEP > self.box[1], -1.0, 1.0)
        ahead = DIFFERENCE_STEP * np.diag(sign)
        around = np.vstack([z, z + ahead, z - ahead] if central else [z, z + ahead])
        out = []
        for r, by_start in zip(self.residuals(around, self.start(z)), self._start_slopes(z)):
            rise = (r[1 : len(z) + 1] - r[len(z) + 1 :]) / 2 if central else r[1:] - r[0]
            slopes = (rise / (DIFFERENCE_STEP * sign[:, None])).T
            # the start that is best moves with z: what it explains of a slope is no knowledge of a parameter
            known = np.eye(by_start.shape[1]) + by_start.T @ by_start
            out.append((r[0], slopes - by_start @ np.linalg.solve(known, by_start.T @ slopes)))
        return out

    def _start_slopes(self, z: Array) -> list[Array]:
        """Return what a spread of each state at a log's start does to its residuals (m, n_x); nothing where
        the log starts at rest."""
        starts = self.start(z)
        unmoved = self.residuals(z[None], starts)
        out = [np.empty((r.shape[1], 0)) for r in unmoved]
        # a tenth of a spread: a state near a limit must not cross it
        for step in 0.1 * symmetric_root(self.model.spread).T:
            moved = [[log[0].moved(step), *log[1:]] for log in starts]
            for k, r in enumerate(self.residuals(z[None], moved)):
                if starts[k][0].level is None:
                    out[k] = np.column_stack([out[k], 10.0 * (r[0] - unmoved[k][0])])
        return out

    @property
    def width(self) -> Array:
        """Prior sd of theta, (n_free,)."""
        specs = (self.model.specs[name] for name in self.plant.free)
        return np.array([spec.sd_log or spec.sd for spec in specs], dtype=float)


def prior_plant(model: GreyModel) -> Plant:
    """Return the model at its prior medians as a plant without uncertainty."""
    free = tuple(name for name, spec in model.specs.items() if not spec.fixed)
    return Plant(
        model,
        {name: spec.value for name, spec in model.specs.items()},
        dt=model.dt,
        units=model.units,
        free=free,
        scales={name: model.specs[name].scale for name in free},
        bounds={name: model.specs[name].bounds for name in free},
        noise=dict(model.sensor_sd),
        nuisance=model.nuisance,
        reference=model.reference,
        verdict="prior values, not fitted to any log",
    )


def make_problem(model: GreyModel, logs: Sequence[Log], *, average: float, independent: float) -> Problem:
    """Put logs on the model's grid and into bins of ``average`` [s], or of a row where rows are longer."""
    if not logs:
        raise UserError("no log to fit", hint="give at least one")
    average = max(average, *(float(np.median(np.diff(log["time"].values))) for log in logs))
    plant = prior_plant(model)
    steps = max(1, round(average / plant.dt))
    prepared_logs = []
    for log in logs:
        stretches = cut_stretches(plant, log)
        bins = [_bins(stretch, plant.dt, steps) for stretch in stretches]
        if not any(mean.size for cells in bins for mean in cells.means):
            raise UserError("has no reading to fit", file=log_name(log), hint="leave it out")
        prepared_logs.append((stretches, bins))
    free = tuple(i for i, spec in enumerate(model.specs.values()) if not spec.fixed)
    sd = np.array([model.sensor_sd[name] for name in model.outputs])
    tau = np.full(len(sd), max(1.0, independent / (steps * plant.dt)))
    return Problem(plant, tuple(prepared_logs), tuple(map(log_name, logs)), free, steps * plant.dt, sd, tau)


def _bins(stretch: Stretch, dt: float, steps: int) -> _Bins:
    """Return the averaging operators of one stretch; a bin without readings is left out."""
    n_grid = len(stretch.u) + 1
    place = np.clip(stretch.time / dt, 0.0, n_grid - 1)
    cell_before = np.minimum(place.astype(int), n_grid - 2)
    share, cell = place - cell_before, cell_before // steps
    operators: list[sparse.csr_matrix] = []
    means: list[Array] = []
    places: list[NDArray[np.int64]] = []
    for k in range(stretch.y.shape[1]):
        read_rows = np.flatnonzero(np.isfinite(stretch.y[:, k]))
        filled, where, count = np.unique(cell[read_rows], return_inverse=True, return_counts=True)
        weight = 1.0 / count[where]
        entries = np.concatenate([weight * (1 - share[read_rows]), weight * share[read_rows]])
        columns = np.concatenate([cell_before[read_rows], cell_before[read_rows] + 1])
        places_in_it = np.tile(where, 2), columns
        operators.append(sparse.csr_matrix((entries, places_in_it), shape=(filled.size, n_grid)))
        means.append(np.bincount(where, weight * stretch.y[read_rows, k], filled.size).astype(float))
        places.append(filled)
    return _Bins(tuple(operators), tuple(means), tuple(places))
