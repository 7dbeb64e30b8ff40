"""A lumped thermal network as a model: nodes, links, pipes, Peltiers, heaters, sensors.

The network is declared in TOML (:mod:`thermogrip.sysid.models.network_spec`).  One arithmetic of a step runs
on NumPy rows, CasADi symbols and SIMD vectors: no branch depends on a temperature, an input or a parameter.

Every state x_i is a temperature [degC] of a heat capacity C_i, and C_i dx_i/dt = sum of q, the heat that
flows to it; z is x followed by the boundary temperatures (disturbances, then fixed ones).  A sensor is a
state too: its time constant is C, a unit flow from its node for q.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from thermogrip.datasets.arrays import Array, Run, Values
from thermogrip.datasets.errors import UserError
from thermogrip.sysid.models.model import SMOOTH, Described, FreeRuns, Sizes
from thermogrip.sysid.models.network_spec import (
    Heater,
    Network,
    Peltier,
    Pipe,
    named_network,
    network_from_dict,
)

if TYPE_CHECKING:
    from thermogrip.sysid.models.jit_rollout import Kernel

# ROS2 of J. G. Verwer, E. J. Spee, J. G. Blom, W. Hundsdorfer, "A second-order Rosenbrock method applied to
# photochemical dispersion problems", SIAM J. Sci. Comput. 20 (1999): of second order for *any* matrix A, and
# L-stable with this g where A is the Jacobian
GAMMA = 0.2928932188134524  # 1 - 1/sqrt(2)
KELVIN = 273.15
DROOP_SPAN = 50.0  # K between face and sink to which the droop refers

# coefficients of one Peltier element, in this order
PELTIER = (
    *("seebeck", "resistance", "current", "offset", "heating_gain", "cooling_gain", "droop", "full"),
    *("dead_zone", "seebeck_slope", "resistance_slope"),
)
REFERENCE = 25.0  # degC at which a Peltier element has its nominal numbers
BEND_SPAN = 10.0  # K to which the bend of a conductance refers


class Coefficient(NamedTuple):
    """A number times at most two parameters, by their places in p."""

    scale: float
    places: tuple[int, ...] = ()

    def of(self, p: Values) -> Any:
        """Return its value at the parameters p."""
        value: Any = self.scale
        for place in self.places:
            value = value * p[place]
        return value


_NONE, _ONE = Coefficient(0.0), Coefficient(1.0)


class _Link(NamedTuple):
    """What heat flows along from ``source``, an index into z, to a state; ``both``: taken from there too."""

    to: int
    source: int
    value: Coefficient
    both: bool
    switch: int = -1  # an input, or -1
    off: Coefficient = _NONE  # the share that is left with the switch off
    bend: Coefficient | None = None


class _Heater(NamedTuple):
    state: int
    source: int  # an input, or an index into z of what is measured
    measured: bool
    power: Coefficient  # of one unit of the source


class _Peltier(NamedTuple):
    face: int
    sink: int
    input: int
    duty: bool  # whether by a pulse-width driver
    values: tuple[Coefficient, ...]  # in the order of PELTIER


class _Pivot(NamedTuple):
    """One step of an elimination."""

    state: int
    inverse: Any  # of the pivot
    below: dict[int, Any]  # by row: what was taken of the pivot's
    right: dict[int, Any]  # by column: the pivot's row


@dataclass(frozen=True)
class ThermalSteps:
    """The equations of a network.  Places are numbers and no parameter has a value, so that networks of one
    structure share what is compiled."""

    sizes: Sizes
    switches: tuple[int, ...]  # inputs that are on or off
    capacities: tuple[Coefficient, ...]  # by state
    fixed: tuple[Coefficient, ...]  # temperatures of the boundaries
    links: tuple[_Link, ...]
    radiation: tuple[_Link, ...]
    heaters: tuple[_Heater, ...]
    peltiers: tuple[_Peltier, ...]
    outputs: tuple[int, ...]  # (n_y,) state that each output reads

    def step(self, x: Values, u: Values, d: Values, p: Values, h: Any) -> list[Any]:
        """Return the state ``h`` [s] later."""
        capacity = self.capacity(p)
        # A holds the conductances and flows, the only stiff terms
        factors = self._factors(capacity, self._conductances(u, p), GAMMA * h)
        # (1 - g h A) k_1 = f(x)
        k = _solved(factors, [a / b for a, b in zip(self.heat(x, u, d, p), capacity)])
        q = self.heat([a + h * b for a, b in zip(x, k)], u, d, p)
        # (1 - g h A) k_2 = f(x + h k_1) - 2 k_1, x+ = x + h (3 k_1 + k_2) / 2
        k2 = _solved(factors, [a / b - 2.0 * e for a, b, e in zip(q, capacity, k)])
        return [a + h * (1.5 * e + 0.5 * b) for a, e, b in zip(x, k, k2)]

    def output(self, x: Values, p: Values) -> list[Any]:
        """Return what the sensors read [degC]."""
        return [x[i] for i in self.outputs]

    def capacity(self, p: Values) -> list[Any]:
        """Return the heat capacity of each state [J/K] (sensors: time constant [s])."""
        return [item.of(p) for item in self.capacities]

    def _conductances(self, u: Values, p: Values) -> list[Any]:
        """Return the conductance [W/K] of every link at these switch positions."""
        # conductances and flows may hang on a switch, such as a pump, that leaves a share of them when off
        values = []
        for link in self.links:
            value = link.value.of(p)
            if link.switch >= 0:
                off = link.off.of(p)
                value = value * (off + (1.0 - off) * u[link.switch])
            values.append(value)
        return values

    def heat(self, x: Values, u: Values, d: Values, p: Values) -> list[Any]:
        """Return the heat that each state receives [W] (sensors: [K])."""
        z, n = [*x, *d, *(item.of(p) for item in self.fixed)], self.sizes.n_x
        q = [0.0 * z[i] for i in range(n)]

        def move(i: int, j: int, flow: Any, both: bool = True) -> None:
            q[i] = q[i] + flow
            if both and j < n:
                q[j] = q[j] - flow

        for link, conductance in zip(self.links, self._conductances(u, p)):
            # taken from j, given to i; of a flow given to i only, the water of i moved on with its heat
            rise = z[link.source] - z[link.to]
            move(link.to, link.source, conductance * rise, link.both)
            if link.bend is not None:
                # q_ij = G_ij (z_j - z_i) (1 + b |z_j - z_i| / 10 K)
                bent = conductance * link.bend.of(p) / BEND_SPAN * rise * abs(rise)
                move(link.to, link.source, bent, link.both)
        for link in self.radiation:
            # q_ij = k (T_j^4 - T_i^4)
            a, b = z[link.to] + KELVIN, z[link.source] + KELVIN
            move(link.to, link.source, link.value.of(p) * (b * b * b * b - a * a * a * a))
        for heater in self.heaters:
            # P u, or P d of what is measured and not moved
            drive = (z if heater.measured else u)[heater.source]
            q[heater.state] = q[heater.state] + heater.power.of(p) * drive
        for element in self.peltiers:
            at_face, at_sink = _peltier_heat(element, u[element.input], z[element.face], z[element.sink], p)
            q[element.face] = q[element.face] + at_face
            q[element.sink] = q[element.sink] + at_sink
        return q

    def _factors(self, capacity: Values, g: Values, gh: Any) -> list[_Pivot]:
        """Return the LU factors of 1 - gh A, by rows of what is not 0."""
        rows: list[dict[int, Any]] = [{i: 1.0} for i in range(self.sizes.n_x)]

        def add(row: int, column: int, value: Any) -> None:
            rows[row][column] = rows[row][column] + value if column in rows[row] else value

        for link, conductance in zip(self.links, g):
            i, j = link.to, link.source
            share = gh * conductance / capacity[i]
            add(i, i, share)
            if j < len(rows):
                add(i, j, -share)
                if link.both:
                    share = gh * conductance / capacity[j]
                    add(j, j, share)
                    add(j, i, -share)
        # 1 - gh A is diagonally dominant by columns and needs no pivots for its size
        factors, remaining = [], set(range(len(rows)))
        while remaining:
            # the state with the fewest neighbours first, so that little is filled in
            neighbours = {i: sum(j in rows[i] or i in rows[j] for j in remaining) for i in remaining}
            pivot = min(remaining, key=lambda i: (neighbours[i], i))
            remaining.remove(pivot)
            inverse = 1.0 / rows[pivot][pivot]
            right = {column: value for column, value in rows[pivot].items() if column in remaining}
            below = {row: rows[row][pivot] * inverse for row in sorted(remaining) if pivot in rows[row]}
            for row, share in below.items():
                for column, value in right.items():
                    add(row, column, -(share * value))
            factors.append(_Pivot(pivot, inverse, below, right))
        return factors


def _peltier_heat(peltier: _Peltier, u: Any, t_face: Any, t_sink: Any, p: Values) -> tuple[Any, Any]:
    """Return the heat that face and sink of an element receive [W]."""
    element = {name: item.of(p) for name, item in zip(PELTIER, peltier.values)}
    v, dead = u / element["full"] + element["offset"], element["dead_zone"]
    # beyond a dead zone v_d, v - v_d replaces the command v
    v = v - 0.5 * (abs(v + dead) - abs(v - dead))
    # the current follows by two gains, I = I_max (g_heat max(v, 0) + g_cool min(v, 0)), and droops by a share
    # per 50 K between face and sink
    size = abs(v)
    up, down = element["heating_gain"] * 0.5 * (v + size), element["cooling_gain"] * 0.5 * (v - size)
    droop = element["droop"] / DROOP_SPAN * (t_face - t_sink)
    if peltier.duty:
        # pulses of I_max (1 - r dT / 50) for the share v of the time: Joule heat goes with v, not its square
        on = element["current"] * (1.0 - droop)
        current, square = up * on, up * on * on
    else:
        current = element["current"] * ((up + down) - droop * (up - down))
        square = current * current
    # a and R follow the mean temperature of the element by a share per kelvin
    warm = 0.5 * (t_face + t_sink) - REFERENCE
    pumped = element["seebeck"] * (1.0 + element["seebeck_slope"] * warm) * current
    joule = 0.5 * element["resistance"] * (1.0 + element["resistance_slope"] * warm) * square
    # a I T_face + R I^2 / 2 and -a I T_sink + R I^2 / 2, T in kelvin
    return pumped * (t_face + KELVIN) + joule, joule - pumped * (t_sink + KELVIN)


def _solved(factors: list[_Pivot], q: list[Any]) -> list[Any]:
    """Return the solution of (1 - gh A) k = q, in the place of ``q``."""
    for pivot in factors:
        for row, share in pivot.below.items():
            q[row] = q[row] - share * q[pivot.state]
    for pivot in reversed(factors):
        value = q[pivot.state]
        for column, entry in pivot.right.items():
            value = value - entry * q[column]
        q[pivot.state] = value * pivot.inverse
    return q


STEFAN_BOLTZMANN = 5.670374419e-8  # W m^-2 K^-4


def state_names(network: Network) -> tuple[str, ...]:
    """Return the names of the states: nodes, pipe cells (``supply.1``, ``supply.1.wall``), sensors."""
    cells = []
    for name, pipe in network.pipes.items():
        for k in range(1, pipe.cells + 1):
            cells.append(f"{name}.{k}")
            if pipe.wall_capacity is not None:
                cells.append(f"{name}.{k}.wall")
    sensors = [f"{name}.sensor" for name, output in network.outputs.items() if output.lag is not None]
    return (*network.nodes, *cells, *sensors)


class _Places:
    """Where the names of a network stand in z, u and p."""

    def __init__(self, network: Network) -> None:
        states = state_names(network)
        self.n_x = len(states)
        self.z = {name: i for i, name in enumerate([*states, *network.disturbances, *network.boundaries])}
        self.u = {name: i for i, name in enumerate(network.inputs)}
        self._p = list(network.parameters)

    def coefficient(self, *names: str, scale: float = 1.0) -> Coefficient:
        return Coefficient(scale, tuple(self._p.index(name) for name in names))

    def share(self, off: str | None) -> Coefficient:
        return _NONE if off is None else self.coefficient(off)

    def switch(self, name: str | None) -> int:
        return -1 if name is None else self.u[name]

    def receiver(self, between: list[str]) -> tuple[int, int]:
        """Return (to, from) such that the receiver is a state."""
        a, b = (self.z[name] for name in between)
        return (a, b) if a < self.n_x else (b, a)


def thermal_steps(network: Network) -> ThermalSteps:
    """Return the equations of a checked network."""
    at = _Places(network)
    return ThermalSteps(
        sizes=Sizes(at.n_x, len(network.inputs), len(network.disturbances), len(network.parameters)),
        switches=tuple(k for k, item in enumerate(network.inputs.values()) if item.switch),
        capacities=tuple(_capacities(network, at)),
        fixed=tuple(at.coefficient(item.temperature) for item in network.boundaries.values()),
        links=tuple(_links(network, at)),
        radiation=tuple(
            _Link(*at.receiver(r.between), at.coefficient(r.area, r.emissivity, scale=STEFAN_BOLTZMANN), True)
            for r in network.radiation.values()
        ),
        heaters=tuple(_heater(network, heater, at) for heater in network.heaters.values()),
        peltiers=tuple(_peltier(network, element, at) for element in network.peltiers.values()),
        outputs=tuple(
            at.z[o.node if o.lag is None else f"{name}.sensor"] for name, o in network.outputs.items()
        ),
    )


def _capacities(network: Network, at: _Places) -> Iterator[Coefficient]:
    """Yield the capacity of each state in order."""
    for node in network.nodes.values():
        yield at.coefficient(node.capacity)
    # A pipe of n cells with flow F and delay t holds F t of water.  The mean delay of the chain is t exactly
    # and its spread t / sqrt(n), as in a tube with some mixing.
    for pipe in network.pipes.values():
        for _ in range(pipe.cells):
            yield at.coefficient(pipe.flow, pipe.delay, scale=1.0 / pipe.cells)
            if pipe.wall_capacity is not None:
                yield at.coefficient(pipe.wall_capacity, scale=1.0 / pipe.cells)
    for output in network.outputs.values():
        if output.lag is not None:
            yield at.coefficient(output.lag)


def _links(network: Network, at: _Places) -> Iterator[_Link]:
    for link in network.links.values():
        bend = None if link.bend is None else at.coefficient(link.bend)
        value, switch = at.coefficient(link.conductance), at.switch(link.switch)
        yield _Link(*at.receiver(link.between), value, True, switch, at.share(link.off), bend)
    for element in network.peltiers.values():
        if element.conductance is not None:
            yield _Link(at.z[element.face], at.z[element.sink], at.coefficient(element.conductance), True)
    for name, pipe in network.pipes.items():
        yield from _pipe(name, pipe, at)
    for name, output in network.outputs.items():
        if output.lag is not None:
            yield _Link(at.z[f"{name}.sensor"], at.z[output.node], _ONE, both=False)


def _pipe(name: str, pipe: Pipe, at: _Places) -> Iterator[_Link]:
    """Yield the flow through the cells and out of them, and what each cell exchanges with wall and
    surroundings."""
    upstream, share, switch = at.z[pipe.source], 1.0 / pipe.cells, at.switch(pipe.switch)
    flow, off = at.coefficient(pipe.flow), at.share(pipe.off)
    for k in range(1, pipe.cells + 1):
        water = outside = at.z[f"{name}.{k}"]
        yield _Link(water, upstream, flow, False, switch, off)
        if pipe.film is not None:
            outside = at.z[f"{name}.{k}.wall"]
            film_switch = -1 if pipe.film_off is None else switch
            film = at.coefficient(pipe.film, scale=share)
            yield _Link(water, outside, film, True, film_switch, at.share(pipe.film_off))
        if pipe.loss is not None and pipe.surroundings is not None:
            yield _Link(outside, at.z[pipe.surroundings], at.coefficient(pipe.loss, scale=share), True)
        upstream = water
    yield _Link(at.z[pipe.target], upstream, flow, False, switch, off)


def _heater(network: Network, heater: Heater, at: _Places) -> _Heater:
    measured = heater.input in network.disturbances
    source = (network.disturbances if measured else network.inputs)[heater.input]
    power = at.coefficient(heater.power, scale=1.0 / source.full_scale)
    return _Heater(at.z[heater.node], (at.z if measured else at.u)[heater.input], measured, power)


def _peltier(network: Network, element: Peltier, at: _Places) -> _Peltier:
    values = []
    for name in PELTIER:
        if name == "full":
            values.append(Coefficient(network.inputs[element.input].full_scale))
        elif (parameter := getattr(element, name)) is None:
            values.append(_ONE if name.endswith("gain") else _NONE)
        else:
            values.append(at.coefficient(parameter))
    duty = element.driver == "duty"
    return _Peltier(at.z[element.face], at.z[element.sink], at.u[element.input], duty, tuple(values))


@dataclass(frozen=True)
class RestWeights:
    """Weights of the state at rest: readings are nearly exact, input and level tie-breakers."""

    sensor: float = 1e2
    input: float = 1e-3
    level: float = 1e-6


REST = RestWeights()


class NetworkModel(Described):
    """The equations of a network; the numbers come as ``p``, in the order of :attr:`parameters`."""

    kind = "network"
    independent = warmup = 60.0  # [s]
    smooth = SMOOTH

    def __init__(self, network: Network) -> None:
        super().__init__(network)
        self.network = network
        self.steps = thermal_steps(network)
        self.states = state_names(network)
        self.n_x = len(self.states)
        self.reference = next((name for name, item in network.outputs.items() if item.reference), None)
        self.sensor_sd = {name: item.sd for name, item in network.outputs.items()}
        self.command_steps = {k: item.step for k, item in network.inputs.items() if item.step is not None}
        self.average = network.average or max(5.0, 5 * self.dt)
        sd = np.full(self.n_x, 0.5)
        sd[: len(network.nodes)] = [node.start_sd for node in network.nodes.values()]
        self.spread = np.diag(sd**2)

    def prepared(
        self, free_runs: FreeRuns, spread: Mapping[str, float], p: Array | None = None
    ) -> NetworkModel:
        """Return the network itself: its implicit step is accurate whatever the logs."""
        return self

    def step(self, x: Values, u: Values, d: Values, p: Values, dt: float) -> list[Any]:
        """Return the state after ``dt`` seconds; numbers, NumPy rows or CasADi symbols alike."""
        return self.steps.step(x, u, d, p, dt)

    def output(self, x: Values, p: Values) -> list[Any]:
        """Return what the sensors read at state x [degC], a list of length n_y."""
        return self.steps.output(x, p)

    def rest(self, y: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike) -> Array:
        """Return the state (n_x,) of a plant at rest whose sensors read y."""
        return np.asarray(self.rest_of_each(y, u, d, np.asarray(p, dtype=float)[None])[0])

    def rest_of_each(self, y: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike) -> Array:
        """Return the states (k, n_x) of :meth:`rest` for parameters p (k, n_p), found together."""
        y, u, d, p = (np.asarray(value, dtype=float) for value in (y, u, d, p))
        if not np.isfinite(y).any():
            raise UserError(
                "no output has a reading to start from", hint="give a log whose first rows are read"
            )
        level = float(np.nanmean(y))
        moved = [i for i, name in enumerate(self.inputs) if name not in self.switches]
        low, high = np.array([self.network.inputs[self.inputs[i]].range for i in moved]).reshape(-1, 2).T
        full = np.array([self.network.inputs[self.inputs[i]].full_scale for i in moved])
        low, high = low / full, high / full
        z = np.concatenate([np.full(self.n_x, level), np.clip(u[moved] / full, low, high)])
        # a plant at rest was held by some input v inside its range, not necessarily that of the first row:
        # min |heat(x, v)|^2 + w_y |y - output(x)|^2 + w_u |v - u|^2
        z, ahead = np.tile(z, (len(p), 1)), 1e-4 * np.eye(len(z))
        unsettled = np.arange(len(p))  # each until it has settled by itself, whoever is beside it
        for _ in range(8):  # bilinear and T^4 at most: Gauss-Newton settles in three or four
            z_now = z[unsettled]
            around = np.concatenate([z_now[:, None], z_now[:, None] + ahead], axis=1)
            rows = self._rest_residuals(around, y, u, d, p[unsettled], moved, full)
            slopes = (rows[:, 1:] - rows[:, :1]).transpose(0, 2, 1) / 1e-4
            move = _bounded_moves(slopes, rows[:, 0], z_now[:, self.n_x :], low, high)
            z[unsettled] = z_now + move
            z[unsettled, self.n_x :] = np.clip(z[unsettled, self.n_x :], low, high)
            unsettled = unsettled[~(np.abs(move).max(axis=1) < 1e-6)]
            if not unsettled.size:
                break
        return np.asarray(z[:, : self.n_x])

    def _rest_residuals(
        self, z: Array, y: Array, u: Array, d: Array, p: Array, moved: list[int], full: Array
    ) -> Array:
        """Return the residuals (k, B, n_r) at z (k, B, n_z), states and shares of the moved inputs, for
        parameters p (k, n_p)."""
        x, v = z[..., : self.n_x], z[..., self.n_x :]
        states = list(np.moveaxis(x, -1, 0))
        inputs: list[Any] = list(u)
        for share, i in enumerate(moved):
            inputs[i] = v[..., share] * full[share]
        flow = self.steps.heat(states, inputs, list(d), list(p.T[:, :, None]))
        is_read = np.isfinite(y)
        read = np.stack(self.output(states, ()), axis=-1)
        residuals = [
            np.stack(flow, axis=-1),
            REST.sensor * (read - y)[..., is_read],
            REST.input * (v - u[moved] / full),
            REST.level * (x - np.nanmean(y)),
        ]
        return np.concatenate(residuals, axis=-1)

    def rollout(self, x0: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike, dt: float) -> Run:
        """Simulate a batch."""
        x0, u, d, p = (np.ascontiguousarray(value, dtype=float) for value in (x0, u, d, p))
        return _kernel(self.steps).rollout(x0, u, d, p, float(dt))

    def to_dict(self) -> dict[str, Any]:
        """Return the whole network as plain JSON."""
        return {
            "kind": self.kind,
            "network": self.network.model_dump(by_alias=True, mode="json", exclude_none=True),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> NetworkModel:
        """Return the model of :meth:`to_dict`; raise :class:`UserError` where it is not one."""
        content = data.get("network")
        if not isinstance(content, Mapping):
            raise UserError("the model holds no network", hint="save the plant again")
        return cls(network_from_dict(_as_it_was_fitted(content)))


def _as_it_was_fitted(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return a plant's network; 0.1.0 wrote no ``full_scale`` and took 1 for that of V, A, W and 1, and until
    0.2.0 the slow error of a sensor was a ``wander`` of the file."""
    out = dict(content)
    inputs, outputs = out.get("inputs"), out.get("outputs")
    if isinstance(inputs, Mapping):
        out["inputs"] = {
            name: {"full_scale": 1.0, **item}
            if isinstance(item, Mapping) and item.get("unit") in ("1", "A", "V", "W")
            else item
            for name, item in inputs.items()
        }
    if isinstance(outputs, Mapping):
        out["outputs"] = {
            name: {key: item[key] for key in item if key not in ("wander", "wander_time")}
            if isinstance(item, Mapping)
            else item
            for name, item in outputs.items()
        }
    return out


def load_network(name_or_path: str | Path) -> NetworkModel:
    """Return a network by its name (``"gripper"``) or by the path of its TOML file.

    Parameters
    ----------
    name_or_path : str or Path
        ``"gripper"``, ``"peltier_chamber"``, ``"tclab"``, or a file as ``thermogrip init network`` writes it.

    Raises
    ------
    UserError
        If there is no such network or its file is refused.

    Examples
    --------
    >>> load_network("tclab").parameters[:3]
    ('C_heater', 'G_amb', 'G_between')
    """
    return NetworkModel(named_network(name_or_path))


def _bounded_moves(jacobian: Array, residual: Array, v: Array, low: Array, high: Array) -> Array:
    """Return the Gauss-Newton steps (k, n_z) of states and inputs v (k, n_v); what would leave its range goes
    to the end of it, and the rest is found for that."""
    span, root = np.linalg.qr(jacobian)
    moves = -np.linalg.solve(root, span.transpose(0, 2, 1) @ residual[:, :, None])[:, :, 0]
    first = moves.shape[1] - v.shape[1]
    wanted = v + moves[:, first:]
    outside = (wanted < low) | (wanted > high)
    for k in np.flatnonzero(outside.any(axis=1)):
        move, beyond = moves[k], np.append(np.zeros(first, dtype=bool), outside[k])
        move[first:] = np.clip(wanted[k], low, high) - v[k]
        remaining = residual[k] + jacobian[k][:, beyond] @ move[beyond]
        move[~beyond] = np.linalg.lstsq(jacobian[k][:, ~beyond], -remaining, rcond=None)[0]
    return np.asarray(moves)


@lru_cache(maxsize=64)
def _kernel(steps: ThermalSteps) -> Kernel:
    """Return the compiled steps."""
    from thermogrip.sysid.models.jit_rollout import Kernel  # pulls in llvmlite

    return Kernel(steps.step, steps.output, steps.sizes, steps.switches)
