"""A lumped thermal network as a model: nodes, links, pipes, Peltiers, heaters, sensors.

The network is declared in TOML (:mod:`thermogrip.sysid.models.network_spec`).  One arithmetic of a step runs
on numbers, NumPy rows and CasADi symbols: no branch depends on a temperature, an input or a parameter.

Every state x_i is a temperature [degC] of a heat capacity C_i, and C_i dx_i/dt = sum of q, the heat that
flows to it; z is x followed by the boundary temperatures (disturbances, then fixed ones).  A sensor is a
state too: its time constant is C, a unit flow from its node for q.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError, reading
from thermogrip.sysid.models.model import SMOOTH, Described, FreeRuns, RestWeights, Run, Sizes, Values
from thermogrip.sysid.models.network_spec import (
    Network,
    Parameter,
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

REFERENCE = 25.0  # degC at which a Peltier element has its nominal numbers
BEND_SPAN = 10.0  # K to which the bend of a conductance refers
STEFAN_BOLTZMANN = 5.670374419e-8  # W m^-2 K^-4


class _Exchange(NamedTuple):
    """Heat that flows along a conductance from a place to a state."""

    to: str
    source: str
    conductance: Any  # [W/K]
    both: bool = True  # whether it is taken from the source: the water of a flow moves on with its heat
    bend: Any = None  # share by which the conductance grows per 10 K


class _Pivot(NamedTuple):
    """One step of an elimination."""

    state: str
    inverse: Any  # of the pivot
    below: dict[str, Any]  # by row: what was taken of the pivot's
    right: dict[str, Any]  # by column: the pivot's row


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


def _capacities(network: Network, p: Mapping[str, Any]) -> Iterator[Any]:
    """Yield the heat capacity [J/K] of each state in order (sensors: the time constant [s])."""
    for node in network.nodes.values():
        yield p[node.capacity]
    # A pipe of n cells with flow F and delay t holds F t of water.  The mean delay of the chain is t exactly
    # and its spread t / sqrt(n), as in a tube with some mixing.
    for pipe in network.pipes.values():
        for _ in range(pipe.cells):
            yield 1.0 / pipe.cells * p[pipe.flow] * p[pipe.delay]
            if pipe.wall_capacity is not None:
                yield 1.0 / pipe.cells * p[pipe.wall_capacity]
    for output in network.outputs.values():
        if output.lag is not None:
            yield p[output.lag]


def _exchanges(network: Network, u: Mapping[str, Any], p: Mapping[str, Any]) -> Iterator[_Exchange]:
    """Yield what links, elements, pipes and sensors exchange at these inputs."""
    for link in network.links.values():
        to, source = _receiver(network, link.between)
        bend = None if link.bend is None else p[link.bend]
        yield _Exchange(to, source, p[link.conductance] * _open(link.switch, link.off, u, p), bend=bend)
    for element in network.peltiers.values():
        if element.conductance is not None:
            yield _Exchange(element.face, element.sink, p[element.conductance])
    for name, pipe in network.pipes.items():
        yield from _pipe(name, pipe, u, p)
    for name, output in network.outputs.items():
        if output.lag is not None:
            yield _Exchange(f"{name}.sensor", output.node, 1.0, both=False)


def _pipe(name: str, pipe: Pipe, u: Mapping[str, Any], p: Mapping[str, Any]) -> Iterator[_Exchange]:
    """Yield the flow through the cells and out of them, and what each cell exchanges with wall and
    surroundings."""
    upstream, share = pipe.source, 1.0 / pipe.cells
    flow = p[pipe.flow] * _open(pipe.switch, pipe.off, u, p)
    for k in range(1, pipe.cells + 1):
        water = outside = f"{name}.{k}"
        yield _Exchange(water, upstream, flow, both=False)
        if pipe.film is not None:
            outside = f"{name}.{k}.wall"
            film_switch = None if pipe.film_off is None else pipe.switch
            yield _Exchange(water, outside, share * p[pipe.film] * _open(film_switch, pipe.film_off, u, p))
        if pipe.loss is not None and pipe.surroundings is not None:
            yield _Exchange(outside, pipe.surroundings, share * p[pipe.loss])
        upstream = water
    yield _Exchange(pipe.target, upstream, flow, both=False)


def _open(switch: str | None, off: str | None, u: Mapping[str, Any], p: Mapping[str, Any]) -> Any:
    """Return the share of a conductance or flow that a switch, such as a pump, leaves of it."""
    left_off = 0.0 if off is None else p[off]
    return 1.0 if switch is None else left_off + (1.0 - left_off) * u[switch]


def _receiver(network: Network, between: Sequence[str]) -> tuple[str, str]:
    """Return (to, from) such that the receiver is a state."""
    a, b = between
    return (b, a) if a in network.disturbances or a in network.boundaries else (a, b)


def _peltier_heat(
    peltier: Peltier, v: Any, t_face: Any, t_sink: Any, p: Mapping[str, Any]
) -> tuple[Any, Any]:
    """Return the heat that face and sink of an element receive [W] at a command, a share of full scale."""

    def of(name: str, absent: float = 0.0) -> Any:
        parameter = getattr(peltier, name)
        return absent if parameter is None else p[parameter]

    v, dead = v + of("offset"), of("dead_zone")
    # beyond a dead zone v_d, v - v_d replaces the command v
    v = v - 0.5 * (abs(v + dead) - abs(v - dead))
    # the current follows by two gains, I = I_max (g_heat max(v, 0) + g_cool min(v, 0)), and droops by a share
    # per 50 K between face and sink
    size = abs(v)
    up, down = of("heating_gain", 1.0) * 0.5 * (v + size), of("cooling_gain", 1.0) * 0.5 * (v - size)
    droop = of("droop") / DROOP_SPAN * (t_face - t_sink)
    if peltier.driver == "duty":
        # pulses of I_max (1 - r dT / 50) for the share v of the time: Joule heat goes with v, not its square
        on = of("current") * (1.0 - droop)
        current, square = up * on, up * on * on
    else:
        current = of("current") * ((up + down) - droop * (up - down))
        square = current * current
    # a and R follow the mean temperature of the element by a share per kelvin
    warm = 0.5 * (t_face + t_sink) - REFERENCE
    pumped = of("seebeck") * (1.0 + of("seebeck_slope") * warm) * current
    joule = 0.5 * of("resistance") * (1.0 + of("resistance_slope") * warm) * square
    # a I T_face + R I^2 / 2 and -a I T_sink + R I^2 / 2, T in kelvin
    return pumped * (t_face + KELVIN) + joule, joule - pumped * (t_sink + KELVIN)


def _factors(exchanges: Sequence[_Exchange], capacity: Mapping[str, Any], gh: Any) -> list[_Pivot]:
    """Return the LU factors of 1 - gh A, by rows of what is not 0."""
    rows: dict[str, dict[str, Any]] = {state: {state: 1.0} for state in capacity}

    def add(row: str, column: str, value: Any) -> None:
        rows[row][column] = rows[row][column] + value if column in rows[row] else value

    for to, source, conductance, both, _ in exchanges:
        share = gh * conductance / capacity[to]
        add(to, to, share)
        if source in rows:
            add(to, source, -share)
            if both:
                share = gh * conductance / capacity[source]
                add(source, source, share)
                add(source, to, -share)
    # 1 - gh A is diagonally dominant by columns and needs no pivots for its size
    factors, remaining = [], list(rows)
    while remaining:
        # the state with the fewest neighbours first, so that little is filled in
        pivot = min(remaining, key=lambda i: sum(j in rows[i] or i in rows[j] for j in remaining))
        remaining.remove(pivot)
        inverse = 1.0 / rows[pivot][pivot]
        right = {column: value for column, value in rows[pivot].items() if column in remaining}
        below = {row: rows[row][pivot] * inverse for row in remaining if pivot in rows[row]}
        for row, share in below.items():
            for column, value in right.items():
                add(row, column, -(share * value))
        factors.append(_Pivot(pivot, inverse, below, right))
    return factors


def _solved(factors: Sequence[_Pivot], q: dict[str, Any]) -> list[Any]:
    """Return the solution of (1 - gh A) k = q, by state in the order of ``q``."""
    k = dict(q)
    for pivot in factors:
        for row, share in pivot.below.items():
            k[row] = k[row] - share * k[pivot.state]
    for pivot in reversed(factors):
        value = k[pivot.state]
        for column, entry in pivot.right.items():
            value = value - entry * k[column]
        k[pivot.state] = value * pivot.inverse
    return list(k.values())


class NetworkModel(Described):
    """The equations of a network; the numbers come as ``p``, in the order of :attr:`parameters`."""

    kind = "network"
    independent = warmup = 60.0  # [s]
    smooth = SMOOTH

    def __init__(self, network: Network) -> None:
        super().__init__(network)
        self.network = network
        self.states = state_names(network)
        self.n_x = len(self.states)
        self.reference = next((name for name, item in network.outputs.items() if item.reference), None)
        self.sensor_sd = {name: item.sd for name, item in network.outputs.items()}
        self.command_steps = {k: item.step for k, item in network.inputs.items() if item.step is not None}
        self.average = network.average or max(5.0, 5 * self.dt)
        sd = np.full(self.n_x, 0.5)
        sd[: len(network.nodes)] = [node.start_sd for node in network.nodes.values()]
        self.spread = np.diag(sd**2)
        inputs = network.inputs.values()
        self.rest_weights = RestWeights(
            full=np.array([item.full_scale for item in inputs]),
            ranges=np.array([item.range for item in inputs]).reshape(-1, 2),
            sensor=1e2,
            input=1e-3,
        )

    def prepared(
        self, free_runs: FreeRuns, spread: Mapping[str, float], p: Array | None = None
    ) -> NetworkModel:
        """Return the network itself: its implicit step is accurate whatever the logs."""
        return self

    def step(self, x: Values, u: Values, d: Values, p: Values, dt: float) -> list[Any]:
        """Return the state after ``dt`` seconds; numbers, NumPy rows or CasADi symbols alike."""
        inputs, parameters = dict(zip(self.inputs, u)), dict(zip(self.parameters, p))
        capacity = dict(zip(self.states, _capacities(self.network, parameters)))
        # A holds the conductances and flows, the only stiff terms
        factors = _factors(list(_exchanges(self.network, inputs, parameters)), capacity, GAMMA * dt)
        # (1 - g h A) k_1 = f(x)
        k = _solved(factors, self.rates(x, u, d, p))
        later = self.rates([a + dt * b for a, b in zip(x, k)], u, d, p)
        # (1 - g h A) k_2 = f(x + h k_1) - 2 k_1, x+ = x + h (3 k_1 + k_2) / 2
        k2 = _solved(factors, {name: b - 2.0 * e for (name, b), e in zip(later.items(), k)})
        return [a + dt * (1.5 * e + 0.5 * b) for a, e, b in zip(x, k, k2)]

    def output(self, x: Values, p: Values) -> list[Any]:
        """Return what the sensors read at state x [degC], a list of length n_y."""
        z = dict(zip(self.states, x))
        return [z.get(f"{name}.sensor", z[item.node]) for name, item in self.network.outputs.items()]

    def rates(self, x: Values, u: Values, d: Values, p: Values) -> dict[str, Any]:
        """Return dx/dt [K/s] by state."""
        capacities = _capacities(self.network, dict(zip(self.parameters, p)))
        return {name: q / c for (name, q), c in zip(self.heat(x, u, d, p).items(), capacities)}

    def heat(self, x: Values, u: Values, d: Values, p: Values) -> dict[str, Any]:
        """Return the heat that each state receives [W] (sensors: [K])."""
        network, inputs = self.network, dict(zip(self.inputs, u))
        parameters, measured = dict(zip(self.parameters, p)), dict(zip(self.disturbances, d))
        z = dict(zip(self.states, x)) | measured
        z |= {name: parameters[item.temperature] for name, item in network.boundaries.items()}
        q = {name: 0.0 * z[name] for name in self.states}

        def move(to: str, source: str, flow: Any, both: bool = True) -> None:
            q[to] = q[to] + flow
            if both and source in q:
                q[source] = q[source] - flow

        for to, source, conductance, both, bend in _exchanges(network, inputs, parameters):
            rise = z[source] - z[to]
            move(to, source, conductance * rise, both)
            if bend is not None:
                # q_ij = G_ij (z_j - z_i) (1 + b |z_j - z_i| / 10 K)
                move(to, source, conductance * bend / BEND_SPAN * rise * abs(rise), both)
        for item in network.radiation.values():
            # q_ij = k (T_j^4 - T_i^4)
            to, source = _receiver(network, item.between)
            a, b = z[to] + KELVIN, z[source] + KELVIN
            factor = STEFAN_BOLTZMANN * parameters[item.area] * parameters[item.emissivity]
            move(to, source, factor * (b * b * b * b - a * a * a * a))
        full = {name: item.full_scale for name, item in (network.inputs | network.disturbances).items()}
        for heater in network.heaters.values():
            # P u, or P d of what is measured and not moved
            power = 1.0 / full[heater.input] * parameters[heater.power]
            q[heater.node] = q[heater.node] + power * (inputs | measured)[heater.input]
        for element in network.peltiers.values():
            command, (face, sink) = inputs[element.input] / full[element.input], (element.face, element.sink)
            at_face, at_sink = _peltier_heat(element, command, z[face], z[sink], parameters)
            q[face] = q[face] + at_face
            q[sink] = q[sink] + at_sink
        return q

    def balance(self, x: list[Any], u: list[Any], d: list[Any], p: list[Any]) -> tuple[Array, Array]:
        """Return what flows to each state (..., n_x) [W] and what the outputs read (..., n_y), at rows."""
        flow = list(self.heat(x, u, d, p).values())
        return np.stack(flow, axis=-1), np.stack(self.output(x, p), axis=-1)

    def rollout(self, x0: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike, dt: float) -> Run:
        """Simulate a batch."""
        return _kernel(self._structure).rollout(x0, u, d, p, float(dt))

    @cached_property
    def _structure(self) -> str:
        """The network without the numbers of its parameters."""
        some = dict.fromkeys(self.parameters, Parameter(unit="1", value=1.0, fixed=True))
        return self.network.model_copy(update={"parameters": some}).model_dump_json(by_alias=True)

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
    out = deepcopy(dict(content))
    with reading("its network is not whole", hint="save the plant again"):
        for item in out["inputs"].values():
            if item.get("unit") in ("1", "A", "V", "W"):
                item.setdefault("full_scale", 1.0)
        for item in out["outputs"].values():
            item.pop("wander", None)
            item.pop("wander_time", None)
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


@lru_cache(maxsize=64)
def _kernel(structure: str) -> Kernel:
    """Return the compiled steps of all networks of a structure."""
    from thermogrip.sysid.models.jit_rollout import Kernel  # pulls in llvmlite

    model = NetworkModel(Network.model_validate_json(structure))
    sizes = Sizes(model.n_x, len(model.inputs), len(model.disturbances), len(model.parameters))
    return Kernel(model.step, model.output, sizes, [model.inputs.index(name) for name in model.switches])
