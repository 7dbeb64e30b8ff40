"""Equations without numbers: what every model offers.

With the state x, the inputs u, the measured disturbances d and the parameters p,

    x+ = step(x, u, d, p, dt),        y = output(x, p),

both in plain arithmetic, so that NumPy rows and CasADi symbols run the same lines.

A :class:`GreyModel` also states what was known before any log was seen: a prior and bounds for each
parameter, how well each sensor reads, and the times over which the fit averages.  Thermal networks
(:mod:`thermogrip.sysid.models.network`) and classes of the user's own
(:mod:`thermogrip.sysid.models.user_model`) are of this kind.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar, NamedTuple, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError, reading
from thermogrip.datasets.limits import STEP_RANGE, array_within, number_within
from thermogrip.sysid.models.network_spec import Parameter


class Sizes(NamedTuple):
    """How long the lists of a model's equations are."""

    n_x: int  # states
    n_u: int  # inputs
    n_d: int  # disturbances
    n_p: int  # parameters


Run = tuple[Array, Array]  # outputs (B, N + 1, n_y) and last states (B, n_x) of a batch
# what the arithmetic takes: numbers, rows with an entry a member of a batch, CasADi's symbols
Values = Sequence[Any]
# (x, u, d, p, h [s]) -> state after h seconds; (x, p) -> outputs
Step = Callable[[Values, Values, Values, Values, Any], list[Any]]
Output = Callable[[Values, Values], list[Any]]

SMOOTH = 20.0  # [s] mean of a measured ambient, for its sensor is slow and coarse


class Model(Protocol):
    """Equations of a plant; the numbers stand in a :class:`~thermogrip.sysid.plant.plant.Plant`.

    ``kind`` says what reads a model back; ``inputs``, ``disturbances`` and ``outputs`` name u, d and y;
    ``switches`` are the inputs that are on or off, such as a pump; ``parameters`` name p, in order;
    ``spread`` is the prior covariance (n_x, n_x) of a state about :meth:`rest`, for estimating a start;
    ``smooth`` the seconds over which a disturbance is averaged, a step at least; ``command_steps`` what the
    driver of an input drops: all behind a multiple of this.
    """

    @property
    def kind(self) -> str: ...
    @property
    def inputs(self) -> tuple[str, ...]: ...
    @property
    def disturbances(self) -> tuple[str, ...]: ...
    @property
    def outputs(self) -> tuple[str, ...]: ...
    @property
    def switches(self) -> tuple[str, ...]: ...
    @property
    def n_x(self) -> int: ...
    @property
    def parameters(self) -> tuple[str, ...]: ...
    @property
    def spread(self) -> Array: ...
    @property
    def smooth(self) -> float: ...
    @property
    def command_steps(self) -> Mapping[str, float]: ...

    def rest(self, y: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike) -> Array:
        """Return the state (n_x,) of a plant at rest whose outputs read y, held by some input near u."""
        ...

    def step(self, x: Values, u: Values, d: Values, p: Values, dt: float) -> list[Any]:
        """Return the state one step later; u and d are held over the step."""
        ...

    def output(self, x: Values, p: Values) -> list[Any]:
        """Return the outputs at state x."""
        ...

    def rollout(self, x0: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike, dt: float) -> Run:
        """Simulate a batch: x0 (B, n_x), u (B|1, N, n_u), d (B|1, N, n_d), p (B|1, n_p); return y
        (B, N + 1, n_y), row 0 at x0, and the last state (B, n_x)."""
        ...

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON; key ``kind`` says what reads it back."""
        ...


_STATES_AT_ONCE = 2_000_000  # numbers of states at a time, 16 MB, of which a simulation has five copies


@dataclass(frozen=True, eq=False)
class BlackBox(ABC):
    """What linear, polynomial and neural models share: their numbers are fields, and keys of a file."""

    inputs: tuple[str, ...]
    disturbances: tuple[str, ...]
    outputs: tuple[str, ...]
    dt: float  # step [s]

    kind: ClassVar[str]
    title: ClassVar[str]
    labels: ClassVar[tuple[str, ...]] = ("inputs", "disturbances", "outputs", "switches")
    arrays: ClassVar[tuple[str, ...]]
    parameters: ClassVar[tuple[str, ...]] = ()
    smooth: ClassVar[float] = SMOOTH
    command_steps: ClassVar[Mapping[str, float]] = {}

    @property
    def stable(self) -> bool:
        """Whether free runs stay bounded; true where the fit or the model's own form sees to that."""
        return True

    @property
    @abstractmethod
    def n_x(self) -> int:
        """Number of states."""

    @abstractmethod
    def one_step(self, x: Values, u: Values, d: Values) -> list[Any]:
        """Return the state one step of the model later, in plain arithmetic (numbers, NumPy rows or CasADi
        symbols)."""

    @abstractmethod
    def output(self, x: Values, p: Values) -> list[Any]:
        """Return the outputs at state x, in plain arithmetic."""

    @abstractmethod
    def states(self, x0: Array, u: Array, d: Array, times: int = 1) -> Array:
        """Return the states (B, N + 1, n_x) of :meth:`rollout`, ``times`` steps with each row."""

    def step(self, x: Values, u: Values, d: Values, p: Values, dt: float) -> list[Any]:
        """Return the state ``dt`` seconds later, a multiple of the model's step."""
        now = [x[i] for i in range(self.n_x)]
        u, d = [u[i] for i in range(len(self.inputs))], [d[i] for i in range(len(self.disturbances))]
        for _ in range(whole_steps(dt, self.dt)):
            now = self.one_step(now, u, d)
        return now

    def rollout(self, x0: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike, dt: float) -> Run:
        """Simulate a batch."""
        x_end = np.asarray(x0, dtype=float)
        readings: list[Array] = []
        for x in self.state_blocks(x_end, np.asarray(u, dtype=float), np.asarray(d, dtype=float), dt):
            y = np.empty((*x.shape[:-1], len(self.outputs)))
            for k, column in enumerate(self.output(list(np.moveaxis(x, -1, 0)), ())):
                y[..., k] = column
            readings.append(y[:, 1:] if readings else y)
            x_end = x[:, -1]
        return np.concatenate(readings, axis=1), x_end

    def state_blocks(self, x0: Array, u: Array, d: Array, dt: float) -> Iterator[Array]:
        """Yield the states of :meth:`rollout`, each time so many rows that they have :data:`_STATES_AT_ONCE`
        numbers, from the last row of the ones before on."""
        times = max(1, round(dt / self.dt))  # the step of a gap may differ a little from the model's
        rows = max(1, _STATES_AT_ONCE // max(1, x0.size))
        for begin in range(0, max(1, u.shape[1]), rows):
            block = slice(begin, begin + rows)
            x = self.states(x0, u[:, block], d[:, block], times)
            yield x
            x0 = x[:, -1]

    def to_dict(self) -> dict[str, Any]:
        """Return the model as plain lists and numbers, for JSON."""
        return {"kind": self.kind} | {
            entry.name: _plain_json(getattr(self, entry.name)) for entry in fields(self)
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Return the model of :meth:`to_dict`; raise :class:`UserError` where a field is missing or wrong."""
        with reading(f"not a {cls.title}", hint="save it again with this version"):
            content: dict[str, Any] = {key: tuple(str(name) for name in data[key]) for key in cls.labels}
            content |= {key: array_within(data, key) for key in cls.arrays}
            if content["spread"].ndim == 2 and not (np.diagonal(content["spread"]) > 0).all():
                raise ValueError("spread has a variance that is not positive")
            return cls(**content | {"dt": number_within(data, "dt", *STEP_RANGE)} | cls.others(data))

    @staticmethod
    def others(data: Mapping[str, Any]) -> dict[str, Any]:
        """Return the fields that are neither names nor plain arrays."""
        return {}


def whole_steps(dt: float, own: float) -> int:
    """Return ``dt`` [s] in steps of ``own``, or refuse it."""
    times = round(dt / own)
    if times < 1 or abs(times * own - dt) > 1e-6 * dt:
        problem = f"{dt:g} s is no whole multiple of the plant's step"
        raise UserError(problem, hint=f"take a multiple of {own:g} s")
    return times


def _plain_json(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain_json(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return list(value) if isinstance(value, tuple) else value


@runtime_checkable
class GreyModel(Model, Protocol):
    """Equations with priors."""

    name: str  # what tables call it
    dt: float  # step of the simulation [s]
    specs: dict[str, Parameter]  # unit, prior and bounds of each parameter
    units: dict[str, str]  # of signals and parameters
    states: tuple[str, ...]
    sensor_sd: dict[str, float]  # of the mean over a bin about the model, by output
    nuisance: dict[str, float]  # how far each output and disturbance is off, from log to log
    reference: str | None  # the output that has no offset of its own, if one does not
    average: float  # length of the bins of a fit [s], where none is asked for
    independent: float  # seconds per independent residual, until that is measured
    warmup: float  # seconds of a log from which a fit may estimate how it starts

    def prepared(self, free_runs: FreeRuns, spread: Mapping[str, float], p: Array | None = None) -> GreyModel:
        """Return the model with a step short enough at p (its prior where absent) for these runs' logs."""
        ...


# (model, p (n_p,)) -> (log's name, simulated outputs (1, N + 1, n_y)) of each stretch without a gap
FreeRuns = Callable[[GreyModel, Array], list[tuple[str, Array]]]


@dataclass(frozen=True, eq=False)
class RestWeights:
    """Units and weights of a state at rest: readings are nearly exact, input and level tie-breakers."""

    full: Array  # (n_u,) unit of each input
    ranges: Array  # (n_u, 2) of the inputs
    sensor: Array | float  # (n_y,)
    input: float  # of a unit
    state: Array | float = 1.0  # (n_x,) unit of each state
    limits: Array | tuple[float, float] = (-np.inf, np.inf)  # (n_x, 2) of the states
    flow: Array | float = 1.0  # (n_x,)
    level: float = 1e-6  # of what is away from a first guess


_REST_STEPS = 50  # at most; what is bilinear settles in three or four
_AHEAD = 1e-5  # of a unit: the difference of slopes


class Described(ABC):
    """The part of a :class:`GreyModel` that its tables answer: ``inputs``, ``disturbances``, ``outputs`` and
    ``parameters`` by name, ``name`` and ``dt``; and the state at rest, by what a model says of it."""

    states: tuple[str, ...]
    rest_weights: RestWeights

    def __init__(self, tables: Any) -> None:
        self.tables = tables
        self.name, self.dt = str(tables.name), float(tables.dt)
        groups = (tables.inputs, tables.disturbances, tables.outputs, tables.parameters)
        self.inputs, self.disturbances, self.outputs, self.parameters = map(tuple[str, ...], groups)
        self.switches = tuple(name for name, item in tables.inputs.items() if item.switch)
        self.specs: dict[str, Parameter] = dict(tables.parameters)
        self.units: dict[str, str] = {name: item.unit for group in groups for name, item in group.items()}
        sensors = (*tables.outputs.items(), *tables.disturbances.items())
        self.nuisance: dict[str, float] = {name: item.log_sd for name, item in sensors}
        self.prior = np.array([item.value for item in self.specs.values()])  # (n_p,), median or mean

    @abstractmethod
    def balance(self, x: list[Any], u: list[Any], d: list[Any], p: list[Any]) -> tuple[Array, Array]:
        """Return what flows to each state (..., n_x) and what the outputs read (..., n_y), at rows."""

    def rest(self, y: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike) -> Array:
        """Return the state (n_x,) of a plant at rest whose sensors read y."""
        return np.asarray(self.rest_of_each(y, u, d, np.asarray(p, dtype=float)[None])[0])

    def rest_of_each(self, y: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike) -> Array:
        """Return the states (k, n_x) of :meth:`rest` for parameters p (k, n_p), found together; not finite
        where the equations are not."""
        y, u, d, p = (np.asarray(value, dtype=float) for value in (y, u, d, p))
        is_read, weights, n_x = np.isfinite(y), self.rest_weights, len(self.states)
        if not is_read.any():
            hint = "give a log whose first rows are read"
            raise UserError("no output has a reading to start from", hint=hint)
        moved = [k for k, name in enumerate(self.inputs) if name not in self.switches]
        scale = np.append(np.broadcast_to(weights.state, n_x), weights.full[moved])
        ends = np.vstack([np.broadcast_to(weights.limits, (n_x, 2)), weights.ranges[moved]])
        low, high = (ends / scale[:, None]).T
        # the reading of the output of a state's name, else the mean of all
        readings = dict(zip(self.outputs, np.where(is_read, y, np.nanmean(y)).tolist()))
        guess = np.array([readings.get(name, np.nanmean(y)) for name in self.states])

        def residuals(z: Array, which: NDArray[np.int_]) -> Array:
            z = z * scale
            inputs: list[Any] = list(u)
            for column, k in enumerate(moved, n_x):
                inputs[k] = z[..., column]
            x = list(np.moveaxis(z[..., :n_x], -1, 0))
            flow, read = self.balance(x, inputs, list(d), list(p[which].T[:, :, None]))
            misses = [
                weights.flow * flow,
                (weights.sensor * (read - y))[..., is_read],
                weights.input * (z[..., n_x:] - u[moved]) / scale[n_x:],
                weights.level * (z[..., :n_x] - guess),
            ]
            return np.concatenate(misses, axis=-1)

        # a plant at rest was held by some input v inside its range, not necessarily that of the first row:
        # min |flow(x, v)|^2 + w_y |y - output(x)|^2 + w_u |v - u|^2
        z = np.tile(np.clip(np.append(guess, u[moved]) / scale, low, high), (len(p), 1))
        return np.asarray(gauss_newton(residuals, z, low, high)[:, :n_x] * scale[:n_x])


def gauss_newton(
    residuals: Callable[[Array, NDArray[np.int_]], Array], z: Array, low: Array, high: Array
) -> Array:
    """Return the z (k, n) of least squares of each member's residuals, within the bounds; ``residuals(z (k,
    B, n), which)`` are (k, B, m), of the members ``which`` (k,)."""
    unsettled = np.arange(len(z) if z.size else 0)  # each until it has settled, whoever is beside it
    ahead = np.vstack([np.zeros(len(low)), _AHEAD * np.eye(len(low))])
    for _ in range(_REST_STEPS):
        if not unsettled.size:
            break
        rows = residuals(z[unsettled][:, None] + ahead, unsettled)
        slopes = np.nan_to_num((rows[:, 1:] - rows[:, :1]).transpose(0, 2, 1) / _AHEAD)
        move = _bounded_moves(slopes, rows[:, 0], z[unsettled], low, high)
        before = np.sum(rows[:, 0] ** 2, axis=1) * (1 + 1e-9)  # rounding is no growth
        for _ in range(10):  # halved where the residuals would grow, to a thousandth
            after = np.sum(residuals((z[unsettled] + move)[:, None], unsettled)[:, 0] ** 2, axis=1)
            if (after <= before).all():
                break
            move[~(after <= before)] *= 0.5
        z[unsettled] += move
        unsettled = unsettled[~(np.abs(move).max(axis=1) < 1e-6)]
    return z


def _bounded_moves(jacobian: Array, residual: Array, z: Array, low: Array, high: Array) -> Array:
    """Return the Gauss-Newton steps (k, n_z) from z (k, n_z); what would leave its range goes to the end of
    it, and the rest is found for that."""
    span, root = np.linalg.qr(jacobian)
    moves = -np.linalg.solve(root, span.transpose(0, 2, 1) @ residual[:, :, None])[:, :, 0]
    beyond = (z + moves < low) | (z + moves > high)
    for k in np.flatnonzero(beyond.any(axis=1)):
        move = moves[k] = np.clip(z[k] + moves[k], low, high) - z[k]
        remaining = residual[k] + jacobian[k][:, beyond[k]] @ move[beyond[k]]
        moves[k, ~beyond[k]] = np.linalg.lstsq(jacobian[k][:, ~beyond[k]], -remaining, rcond=None)[0]
    return np.asarray(np.clip(z + moves, low, high) - z)
