"""A lumped thermal network as a model: nodes, links, pipes, Peltiers, heaters, sensors.

The network is declared in TOML (:mod:`thermogrip.sysid.models.network_spec`).  One arithmetic of a step runs
on NumPy rows, CasADi symbols and SIMD vectors: no branch depends on a temperature, an input or a parameter.

**Heat balance.**  Every state x_i is a temperature [degC] of a heat capacity C_i; z is x followed by the
boundary temperatures (disturbances, then fixed ones).  Heat flows through

    conductances   q_ij = G_ij (z_j - z_i) (1 + b |z_j - z_i| / 10 K),    taken from j, given to i
    flows          q_ij = F (z_j - z_i),       given to i only: the water of i moved on with its heat
    radiation      q_ij = k (T_j^4 - T_i^4),   T in kelvin
    heaters        q_i  = P u,                 or P d of what is measured and not moved
    Peltiers       face: a I T_face + R I^2 / 2,    sink: -a I T_sink + R I^2 / 2,    T in kelvin

and C_i dx_i/dt = sum of q.  A sensor is a state too: its time constant is C, a unit flow from its
node for q.  Conductances and flows may hang on a switch u_s (a pump): they have off + (1 - off) u_s of their
value. The current follows the command v = u / full + u_0 by two gains, I = I_max (g_heat max(v, 0) + g_cool
min(v, 0)), and droops by r per 50 K between face and sink.  A pulse-width driver ("duty") pushes I_max (1 -
r dT / 50) for the share v of the time, so that its Joule heat is proportional to v, not to its square.
Beyond a dead zone v_d, v - v_d replaces v.  a and R may follow the mean temperature of the element by a share
per kelvin from 25 degC.

**At rest** (:meth:`NetworkModel.rest`) a plant whose sensors read y was held there by some input v, inside
its range and not necessarily that of the first row:  min |heat(x, v)|^2 + w_y |y - output(x)|^2 + w_u |v -
u|^2.

**Time step.**  ROS2 of Verwer et al. [1]_, for dx/dt = f(x) over a step h with the input held:

    (1 - g h A) k_1 = f(x),    (1 - g h A) k_2 = f(x + h k_1) - 2 k_1,    x+ = x + h (3 k_1 + k_2) / 2

is of second order for *any* matrix A, and L-stable with g = 1 - 1/sqrt(2) where A is the Jacobian.  A holds
the conductances and flows, the only stiff terms, so it changes with the switches alone and is factorised once
per change.  1 - g h A is diagonally dominant by columns and needs no pivots: the elimination is found once
per network, in minimum-degree order, and written down as a list of multiplications.

**Layout.**  States are numbered nodes first, then the cells of the pipes (water, then wall), then the sensors
that lag.  A pipe of n cells with flow F and delay t holds F t of water, so each cell has the capacity F t /
n; the chain's mean delay is t exactly and its spread t / sqrt(n), as in a tube with some mixing.

References
----------
.. [1] J. G. Verwer, E. J. Spee, J. G. Blom, W. Hundsdorfer, "A second-order Rosenbrock method applied to
   photochemical dispersion problems", SIAM J. Sci. Comput. 20 (1999).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from thermogrip.datasets.arrays import Array, Run, Values
from thermogrip.datasets.errors import UserError
from thermogrip.sysid.models.model import SMOOTH, Described, FreeRuns, Sizes
from thermogrip.sysid.models.network_spec import Network, Pipe, named_network, network_from_dict

if TYPE_CHECKING:
    from thermogrip.sysid.models.jit_rollout import Kernel

GAMMA = 0.2928932188134524  # 1 - 1/sqrt(2)
KELVIN = 273.15
DROOP_SPAN = 50.0  # K between face and sink to which the droop refers

#: Coefficients of one Peltier element, in this order.
PELTIER = (
    *("seebeck", "resistance", "current", "offset", "heating_gain", "cooling_gain", "droop", "full"),
    *("dead_zone", "seebeck_slope", "resistance_slope"),
)
REFERENCE = 25.0  # degC at which a Peltier element has its nominal numbers
BEND_SPAN = 10.0  # K to which the bend of a conductance refers


class Monomial(NamedTuple):
    """``scale * p[left] * p[right]``, where index n_p means 1."""

    scale: float
    left: int
    right: int


class Layout(NamedTuple):
    """The structure of a network as integers: ``at_*`` is where each part of the coefficients begins."""

    n_x: int
    n_d: int
    n_fixed: int
    at_fixed: int
    at_link: int
    at_off: int
    at_bend: int
    at_radiation: int
    at_heater: int
    at_peltier: int
    coefficients: tuple[Monomial, ...]
    links: tuple[
        tuple[int, int, bool, int], ...
    ]  # (to, from: an index into z, taken from there, switch or -1)
    bent: tuple[int, ...]  # links whose conductance depends on their temperature difference
    radiation: tuple[tuple[int, int], ...]  # (to, from)
    heaters: tuple[tuple[int, int, bool], ...]  # (state, input or index into z, whether it is measured)
    peltiers: tuple[tuple[int, int, int, bool], ...]  # (face, sink, input, whether by a pulse-width driver)
    # of each link the entries (to, to), (to, from), (from, from), (from, to) of the matrix, or -1
    place: tuple[tuple[int, int, int, int], ...]
    diagonal: tuple[int, ...]  # (n_x,) entry of each pivot
    order: tuple[int, ...]  # (n_x,) elimination order
    # pivot by pivot the entries below the diagonal: (entry, row, updates), each w[to] -= entry w[by]
    lower: tuple[tuple[tuple[int, int, tuple[tuple[int, int], ...]], ...], ...]
    upper: tuple[tuple[tuple[int, int], ...], ...]  # pivot by pivot: (entry, column) right of the diagonal
    n_entry: int
    output: tuple[int, ...]  # (n_y,) state that each output reads


@dataclass(frozen=True)
class ThermalSteps:
    """The three parts of a step; see :class:`thermogrip.sysid.models.model.Equations`."""

    layout: Layout
    n_u: int  # number of inputs
    n_p: int  # of parameters

    @property
    def sizes(self) -> Sizes:
        """Numbers of states, inputs, disturbances and parameters."""
        return Sizes(self.layout.n_x, self.n_u, self.layout.n_d, self.n_p)

    def prepare(self, p: Values) -> list[Any]:
        """Return the coefficients: products of at most two parameters and a number."""
        c: list[Any] = []
        for monomial in self.layout.coefficients:
            value = monomial.scale + 0.0 * p[0]
            if monomial.left < self.n_p:
                value = value * p[monomial.left]
            if monomial.right < self.n_p:
                value = value * p[monomial.right]
            c.append(value)
        return c

    def renew(self, u: Values, c: Values, h: Any) -> list[Any]:
        """Return the conductances, then the factors of 1 - g h A."""
        g = _conductances(u, c, self.layout)
        return [*g, *_lu_factors(c, g, GAMMA * h, self.layout)]

    def advance(self, x: Values, u: Values, d: Values, c: Values, kept: Values, h: Any) -> list[Any]:
        """Return the state one step of ``h`` [s] on."""
        layout, n_link = self.layout, len(self.layout.links)
        g = kept[:n_link]
        w = kept[n_link:]
        outside = self._outside(d, c)
        q = _heat([*x, *outside], u, c, g, layout)
        k = _solved(w, layout, [a / b for a, b in zip(q, c)])
        q = _heat([*(a + h * b for a, b in zip(x, k)), *outside], u, c, g, layout)
        k2 = _solved(w, layout, [a / b - 2.0 * e for a, b, e in zip(q, c, k)])
        return [a + h * (1.5 * e + 0.5 * b) for a, e, b in zip(x, k, k2)]

    def read(self, x: Values, c: Values) -> list[Any]:
        """Return what the sensors read [degC]."""
        return [x[i] for i in self.layout.output]

    def heat(self, x: Values, u: Values, d: Values, p: Values) -> list[Any]:
        """Return the heat that each state receives [W] (sensors: [K])."""
        c = self.prepare(p)
        return _heat([*x, *self._outside(d, c)], u, c, _conductances(u, c, self.layout), self.layout)

    def _outside(self, d: Values, c: Values) -> list[Any]:
        """Return the boundary temperatures: measured, then fixed."""
        first_fixed, n_d = self.layout.at_fixed, self.layout.n_d
        return [*(d[i] for i in range(n_d)), *c[first_fixed : first_fixed + self.layout.n_fixed]]


def _conductances(u: Any, c: Any, layout: Layout) -> list[Any]:
    """Return the conductance [W/K] of every link at these switch positions."""
    g = []
    for k, (_, _, _, switch) in enumerate(layout.links):
        value = c[layout.at_link + k]
        if switch >= 0:
            off = c[layout.at_off + k]
            value = value * (off + (1.0 - off) * u[switch])
        g.append(value)
    return g


def _heat(z: Any, u: Any, c: Any, g: Any, layout: Layout) -> list[Any]:
    """Return the heat that each state receives [W], at temperatures z [degC]."""
    n = layout.n_x
    q = [0.0 * z[i] for i in range(n)]

    def move(i: int, j: int, flow: Any, both: bool = True) -> None:
        q[i] = q[i] + flow
        if both and j < n:
            q[j] = q[j] - flow

    for (i, j, both, _), conductance in zip(layout.links, g):
        move(i, j, conductance * (z[j] - z[i]), both)
    for m, k in enumerate(layout.bent):
        i, j, both, _ = layout.links[k]
        rise = z[j] - z[i]
        move(i, j, g[k] * c[layout.at_bend + m] / BEND_SPAN * rise * abs(rise), both)
    for k, (i, j) in enumerate(layout.radiation):
        a, b = z[i] + KELVIN, z[j] + KELVIN
        move(i, j, c[layout.at_radiation + k] * (b * b * b * b - a * a * a * a))
    for k, (i, by, measured) in enumerate(layout.heaters):
        q[i] = q[i] + c[layout.at_heater + k] * (z[by] if measured else u[by])
    for k, (face, sink, by, duty) in enumerate(layout.peltiers):
        first = layout.at_peltier + len(PELTIER) * k
        v = u[by] / c[first + 7] + c[first + 3]
        v = v - 0.5 * (abs(v + c[first + 8]) - abs(v - c[first + 8]))
        size = abs(v)
        up, down = c[first + 4] * 0.5 * (v + size), c[first + 5] * 0.5 * (v - size)
        droop = c[first + 6] / DROOP_SPAN * (z[face] - z[sink])
        if duty:
            on = c[first + 2] * (1.0 - droop)
            current, square = up * on, up * on * on
        else:
            current = c[first + 2] * ((up + down) - droop * (up - down))
            square = current * current
        warm = 0.5 * (z[face] + z[sink]) - REFERENCE
        pumped = c[first] * (1.0 + c[first + 9] * warm) * current
        joule = 0.5 * c[first + 1] * (1.0 + c[first + 10] * warm) * square
        q[face] = q[face] + pumped * (z[face] + KELVIN) + joule
        q[sink] = q[sink] - pumped * (z[sink] + KELVIN) + joule
    return q


def _lu_factors(c: Any, g: Any, gh: Any, layout: Layout) -> list[Any]:
    """Return the LU factors of 1 - gh A; pivots are inverted."""
    w = [0.0 * c[0] for _ in range(layout.n_entry)]
    for i in layout.diagonal:
        w[i] = 1.0 + 0.0 * c[0]
    for (i, j, _, _), conductance, (to_to, to_from, from_from, from_to) in zip(layout.links, g, layout.place):
        share = gh * conductance / c[i]
        w[to_to] = w[to_to] + share
        if to_from >= 0:
            w[to_from] = w[to_from] - share
        if from_from >= 0:
            share = gh * conductance / c[j]
            w[from_from] = w[from_from] + share
            w[from_to] = w[from_to] - share
    for pivot, below in zip(layout.order, layout.lower):
        diagonal = layout.diagonal[pivot]
        w[diagonal] = 1.0 / w[diagonal]
        for entry, _, updates in below:
            w[entry] = w[entry] * w[diagonal]
            for to, by in updates:
                w[to] = w[to] - w[entry] * w[by]
    return w


def _solved(w: Any, layout: Layout, q: list[Any]) -> list[Any]:
    """Return the solution of (1 - gh A) k = q, in the place of ``q``."""
    for pivot, below in zip(layout.order, layout.lower):
        for entry, row, _ in below:
            q[row] = q[row] - w[entry] * q[pivot]
    for pivot, right in zip(reversed(layout.order), reversed(layout.upper)):
        value = q[pivot]
        for entry, column in right:
            value = value - w[entry] * q[column]
        q[pivot] = value * w[layout.diagonal[pivot]]
    return q


STEFAN_BOLTZMANN = 5.670374419e-8  # W m^-2 K^-4

Coefficient = tuple[float, tuple[str, ...]]  # a number times at most two parameters
_ONE: Coefficient = (1.0, ())


class _Link(NamedTuple):
    """A conductance or flow from ``source``, an index into z, to a state; ``both``: taken from there too."""

    to: int
    source: int
    value: Coefficient
    both: bool
    switch: int = -1
    off: str | None = None
    bend: str | None = None


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


def build_layout(network: Network) -> Layout:
    """Return the layout of a checked network."""
    states = state_names(network)
    index = {name: i for i, name in enumerate([*states, *network.disturbances, *network.boundaries])}
    links = _links(network, index)
    places, one = list(network.parameters), len(network.parameters)  # the place of a factor 1
    full_scale = {name: item.full_scale for name, item in network.inputs.items()}
    full_scale |= {name: item.full_scale for name, item in network.disturbances.items()}
    groups: dict[str, list[Coefficient]] = {
        "capacity": _capacities(network),
        "fixed": [(1.0, (item.temperature,)) for item in network.boundaries.values()],
        "link": [link.value for link in links],
        "off": [(0.0, ()) if link.off is None else (1.0, (link.off,)) for link in links],
        "bend": [(1.0, (link.bend,)) for link in links if link.bend is not None],
        "radiation": [(STEFAN_BOLTZMANN, (r.area, r.emissivity)) for r in network.radiation.values()],
        "heater": [(1.0 / full_scale[h.input], (h.power,)) for h in network.heaters.values()],
        "peltier": [item for element in network.peltiers.values() for item in _peltier(network, element)],
    }
    begin = dict(zip(groups, np.cumsum([0, *map(len, groups.values())]).tolist()))
    inputs = list(network.inputs)
    return Layout(
        n_x=len(states),
        n_d=len(network.disturbances),
        n_fixed=len(network.boundaries),
        **{f"at_{name}": position for name, position in begin.items() if name != "capacity"},
        coefficients=tuple(
            Monomial(scale, *[*map(places.index, names), one, one][:2])
            for group in groups.values()
            for scale, names in group
        ),
        links=tuple((link.to, link.source, link.both, link.switch) for link in links),
        bent=tuple(k for k, link in enumerate(links) if link.bend is not None),
        radiation=tuple(_receiver(r.between, index, len(states)) for r in network.radiation.values()),
        heaters=tuple(
            (index[h.node], index[h.input], True)
            if h.input in network.disturbances
            else (index[h.node], inputs.index(h.input), False)
            for h in network.heaters.values()
        ),
        peltiers=tuple(
            (index[e.face], index[e.sink], inputs.index(e.input), e.driver == "duty")
            for e in network.peltiers.values()
        ),
        **elimination(len(states), [(link.to, link.source, link.both) for link in links]),
        output=tuple(
            index[o.node if o.lag is None else f"{name}.sensor"] for name, o in network.outputs.items()
        ),
    )


def _capacities(network: Network) -> list[Coefficient]:
    out: list[Coefficient] = [(1.0, (node.capacity,)) for node in network.nodes.values()]
    for pipe in network.pipes.values():
        for _ in range(pipe.cells):
            out.append((1.0 / pipe.cells, (pipe.flow, pipe.delay)))
            if pipe.wall_capacity is not None:
                out.append((1.0 / pipe.cells, (pipe.wall_capacity,)))
    out += [(1.0, (output.lag,)) for output in network.outputs.values() if output.lag is not None]
    return out


def _links(network: Network, index: Mapping[str, int]) -> list[_Link]:
    links = list[_Link]()
    n_x = len(state_names(network))
    inputs = list(network.inputs)
    for link in network.links.values():
        to, source = _receiver(link.between, index, n_x)
        switch = -1 if link.switch is None else inputs.index(link.switch)
        value = (1.0, (link.conductance,))
        links.append(_Link(to, source, value, both=True, switch=switch, off=link.off, bend=link.bend))
    for element in network.peltiers.values():
        if element.conductance is not None:
            face, sink = index[element.face], index[element.sink]
            links.append(_Link(face, sink, (1.0, (element.conductance,)), both=True))
    for name, pipe in network.pipes.items():
        _pipe(links, name, pipe, index, -1 if pipe.switch is None else inputs.index(pipe.switch))
    for name, output in network.outputs.items():
        if output.lag is not None:
            links.append(_Link(index[f"{name}.sensor"], index[output.node], _ONE, both=False))
    return links


def _pipe(links: list[_Link], name: str, pipe: Pipe, index: Mapping[str, int], switch: int) -> None:
    """Add the flow through the cells and out of them, and what each cell exchanges with wall and
    surroundings."""
    upstream, share = index[pipe.source], 1.0 / pipe.cells
    for k in range(1, pipe.cells + 1):
        water = outside = index[f"{name}.{k}"]
        links.append(_Link(water, upstream, (1.0, (pipe.flow,)), both=False, switch=switch, off=pipe.off))
        if pipe.film is not None:
            outside = index[f"{name}.{k}.wall"]
            film_switch = -1 if pipe.film_off is None else switch
            links.append(
                _Link(water, outside, (share, (pipe.film,)), both=True, switch=film_switch, off=pipe.film_off)
            )
        if pipe.loss is not None and pipe.surroundings is not None:
            links.append(_Link(outside, index[pipe.surroundings], (share, (pipe.loss,)), both=True))
        upstream = water
    target = index[pipe.target]
    links.append(_Link(target, upstream, (1.0, (pipe.flow,)), both=False, switch=switch, off=pipe.off))


def _peltier(network: Network, element: Any) -> list[Coefficient]:
    """Return the coefficients of one element in the order of ``PELTIER``."""
    out: list[Coefficient] = []
    for name in PELTIER:
        if name == "full":
            out.append((network.inputs[element.input].full_scale, ()))
        elif (parameter := getattr(element, name)) is None:
            out.append((1.0 if name.endswith("gain") else 0.0, ()))
        else:
            out.append((1.0, (parameter,)))
    return out


def _receiver(between: list[str], index: Mapping[str, int], n_x: int) -> tuple[int, int]:
    """Return (to, from) such that the receiver is a state."""
    a, b = (index[name] for name in between)
    return (a, b) if a < n_x else (b, a)


def elimination(n: int, links: list[tuple[int, int, bool]]) -> dict[str, Any]:
    """Return the elimination lists of the matrix whose rows are coupled by (to, from, both) links."""
    pattern: list[set[int]] = [{i} for i in range(n)]
    for to, source, both in links:
        if source < n:
            pattern[to].add(source)
            if both:
                pattern[source].add(to)
    order = _minimum_degree(pattern)
    places = [(row, column) for row in range(n) for column in sorted(pattern[row])]
    entry = {place: k for k, place in enumerate(places)}
    lower, upper = _play(order, pattern, entry)
    return {
        "place": tuple(
            (
                entry[to, to],
                entry[to, source] if source < n else -1,
                entry[source, source] if both and source < n else -1,
                entry[source, to] if both and source < n else -1,
            )
            for to, source, both in links
        ),
        "diagonal": tuple(entry[i, i] for i in range(n)),
        "order": tuple(order),
        "lower": tuple(lower),
        "upper": tuple(upper),
        "n_entry": len(entry),
    }


def _minimum_degree(pattern: list[set[int]]) -> list[int]:
    """Return the order that eliminates the state with the fewest neighbours first."""
    neighbours = [set() for _ in pattern]  # type: list[set[int]]
    for i, row in enumerate(pattern):
        for j in row - {i}:
            neighbours[i].add(j)
            neighbours[j].add(i)
    order, remaining = [], set(range(len(pattern)))
    while remaining:
        pivot = min(remaining, key=lambda i: (len(neighbours[i]), i))
        remaining.remove(pivot)
        order.append(pivot)
        for i in neighbours[pivot]:
            neighbours[i] = (neighbours[i] | neighbours[pivot]) - {i, pivot}
    return order


def _play(order: list[int], pattern: list[set[int]], entry: dict[tuple[int, int], int]) -> tuple[Any, Any]:
    """Eliminate on the pattern alone; return ``lower`` and ``upper``, fill-in is added to ``entry``."""
    lower = []
    upper = []
    rows = [set(row) for row in pattern]
    for position, pivot in enumerate(order):
        later = order[position + 1 :]
        right = [j for j in later if j in rows[pivot]]
        upper.append(tuple((entry[pivot, j], j) for j in right))
        below = [row for row in later if pivot in rows[row]]
        for row in below:
            rows[row].update(right)
            for j in right:
                entry.setdefault((row, j), len(entry))
        lower.append(
            tuple(
                (entry[row, pivot], row, tuple((entry[row, j], entry[pivot, j]) for j in right))
                for row in below
            )
        )
    return lower, upper


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
        self.steps = ThermalSteps(build_layout(network), len(network.inputs), len(network.parameters))
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
        steps = self.steps
        c = steps.prepare(p)
        return steps.advance(x, u, d, c, steps.renew(u, c, dt), dt)

    def output(self, x: Values, p: Values) -> list[Any]:
        """Return what the sensors read at state x [degC], a list of length n_y."""
        return self.steps.read(x, ())

    def rest(self, y: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike) -> Array:
        """Return the state (n_x,) of a plant at rest whose sensors read y; see the module's theory."""
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
        switched = [self.inputs.index(name) for name in self.switches]
        renew = np.ones(u.shape[1], dtype=bool)
        renew[1:] = np.any(u[:, 1:, switched] != u[:, :-1, switched], axis=(0, 2))
        return _kernel(self.steps).rollout(x0, u, d, p, float(dt), renew)

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

    return Kernel(steps)
