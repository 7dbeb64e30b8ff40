"""From a checked network to lists of integers: states, links, coefficients and the elimination order.

States are numbered nodes first, then the cells of the pipes (water, then wall), then the sensors that lag.  A
pipe of n cells with flow F and delay t holds F t of water, so each cell has the capacity F t / n; the
chain's mean delay is t exactly and its spread t / sqrt(n), as in a tube with some mixing.

The matrix 1 - g h A has the same non-zero entries whatever the numbers.  A minimum-degree order keeps the
fill low; the elimination is played through once here, on integers, and written down as a list of
multiplications.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from thermogrip.sysid.models.network_equations import PELTIER, Layout
from thermogrip.sysid.models.network_spec import Network, Pipe

__all__ = ["build_layout", "elimination", "state_names"]

STEFAN_BOLTZMANN = 5.670374419e-8  # W m^-2 K^-4

Coefficient = tuple[float, tuple[str, ...]]  # a number times at most two parameters
_ONE: Coefficient = (1.0, ())


@dataclass
class _Links:
    to: list[int] = field(default_factory=list)
    source: list[int] = field(default_factory=list)
    both: list[int] = field(default_factory=list)
    switch: list[int] = field(default_factory=list)
    value: list[Coefficient] = field(default_factory=list)
    off: list[Coefficient] = field(default_factory=list)
    bent: list[int] = field(default_factory=list)
    bend: list[Coefficient] = field(default_factory=list)

    def add(
        self,
        to: int,
        source: int,
        value: Coefficient,
        *,
        both: bool,
        switch: int = -1,
        off: str | None = None,
    ) -> None:
        self.to.append(to)
        self.source.append(source)
        self.both.append(int(both))
        self.switch.append(switch)
        self.value.append(value)
        self.off.append((0.0, ()) if off is None else (1.0, (off,)))


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
    """Return the integers of :class:`thermogrip.sysid.models.network_equations.Layout` for a checked
    network."""
    states = state_names(network)
    index = {name: i for i, name in enumerate([*states, *network.disturbances, *network.boundaries])}
    links = _links(network, index)
    parts: dict[str, list[Coefficient]] = {
        "capacity": _capacities(network),
        "fixed": [(1.0, (item.temperature,)) for item in network.boundaries.values()],
        "link": links.value,
        "off": links.off,
        "bend": links.bend,
        "radiation": [(STEFAN_BOLTZMANN, (r.area, r.emissivity)) for r in network.radiation.values()],
        "heater": [(1.0 / _full(network, h.input), (h.power,)) for h in network.heaters.values()],
        "peltier": [item for element in network.peltiers.values() for item in _peltier(network, element)],
    }
    begin = dict(zip(parts, np.cumsum([0, *map(len, parts.values())]).tolist()))
    scale, left, right = _monomials([item for part in parts.values() for item in part], network)
    inputs = list(network.inputs)
    glow = [_receiver(r.between, index, len(states)) for r in network.radiation.values()]
    return Layout(
        n_x=len(states),
        n_d=len(network.disturbances),
        n_fixed=len(network.boundaries),
        **{f"at_{name}": at for name, at in begin.items() if name != "capacity"},
        scale=scale,
        left=left,
        right=right,
        link_to=_ints(links.to),
        link_from=_ints(links.source),
        link_both=_ints(links.both),
        link_switch=_ints(links.switch),
        bent=_ints(links.bent),
        radiation_to=_ints([i for i, _ in glow]),
        radiation_from=_ints([j for _, j in glow]),
        heater_to=_ints([index[h.node] for h in network.heaters.values()]),
        heater_input=_ints([inputs.index(h.input) for h in network.heaters.values()]),
        peltier_face=_ints([index[e.face] for e in network.peltiers.values()]),
        peltier_sink=_ints([index[e.sink] for e in network.peltiers.values()]),
        peltier_input=_ints([inputs.index(e.input) for e in network.peltiers.values()]),
        peltier_duty=_ints([int(e.driver == "duty") for e in network.peltiers.values()]),
        **elimination(len(states), list(zip(links.to, links.source, links.both))),
        output=_ints(
            [index[o.node if o.lag is None else f"{name}.sensor"] for name, o in network.outputs.items()]
        ),
    )


def _full(network: Network, name: str) -> float:
    return network.inputs[name].full_scale


def _capacities(network: Network) -> list[Coefficient]:
    out: list[Coefficient] = [(1.0, (node.capacity,)) for node in network.nodes.values()]
    for pipe in network.pipes.values():
        for _ in range(pipe.cells):
            out.append((1.0 / pipe.cells, (pipe.flow, pipe.delay)))
            if pipe.wall_capacity is not None:
                out.append((1.0 / pipe.cells, (pipe.wall_capacity,)))
    out += [(1.0, (output.lag,)) for output in network.outputs.values() if output.lag is not None]
    return out


def _links(network: Network, index: Mapping[str, int]) -> _Links:
    links, n_x, inputs = _Links(), len(state_names(network)), list(network.inputs)
    for link in network.links.values():
        to, source = _receiver(link.between, index, n_x)
        switch = -1 if link.switch is None else inputs.index(link.switch)
        if link.bend is not None:
            links.bent.append(len(links.to))
            links.bend.append((1.0, (link.bend,)))
        links.add(to, source, (1.0, (link.conductance,)), both=True, switch=switch, off=link.off)
    for element in network.peltiers.values():
        if element.conductance is not None:
            face, sink = index[element.face], index[element.sink]
            links.add(face, sink, (1.0, (element.conductance,)), both=True)
    for name, pipe in network.pipes.items():
        _pipe(links, name, pipe, index, -1 if pipe.switch is None else inputs.index(pipe.switch))
    for name, output in network.outputs.items():
        if output.lag is not None:
            links.add(index[f"{name}.sensor"], index[output.node], _ONE, both=False)
    return links


def _pipe(links: _Links, name: str, pipe: Pipe, index: Mapping[str, int], switch: int) -> None:
    """Add the flow through the cells and out of them, and what each cell exchanges with wall and
    surroundings."""
    upstream, share = index[pipe.source], 1.0 / pipe.cells
    for k in range(1, pipe.cells + 1):
        water = outside = index[f"{name}.{k}"]
        links.add(water, upstream, (1.0, (pipe.flow,)), both=False, switch=switch, off=pipe.off)
        if pipe.film is not None:
            outside = index[f"{name}.{k}.wall"]
            film_switch = -1 if pipe.film_off is None else switch
            links.add(water, outside, (share, (pipe.film,)), both=True, switch=film_switch, off=pipe.film_off)
        if pipe.loss is not None and pipe.surroundings is not None:
            links.add(outside, index[pipe.surroundings], (share, (pipe.loss,)), both=True)
        upstream = water
    target = index[pipe.target]
    links.add(target, upstream, (1.0, (pipe.flow,)), both=False, switch=switch, off=pipe.off)


def _peltier(network: Network, element: Any) -> list[Coefficient]:
    """Return the coefficients of one element in the order of ``thermal_step.PELTIER``."""
    out: list[Coefficient] = []
    for name in PELTIER:
        parameter = None if name == "full" else getattr(element, name)
        if name == "full":
            out.append((_full(network, element.input), ()))
        elif parameter is None:
            out.append((1.0 if name.endswith("gain") else 0.0, ()))
        else:
            out.append((1.0, (parameter,)))
    return out


def _monomials(
    items: list[Coefficient], network: Network
) -> tuple[tuple[float, ...], tuple[int, ...], tuple[int, ...]]:
    index = {name: i for i, name in enumerate(network.parameters)}
    factors = [[*(index[name] for name in names), len(index), len(index)][:2] for _, names in items]
    return tuple(scale for scale, _ in items), _ints(k for k, _ in factors), _ints(k for _, k in factors)


def _receiver(between: list[str], index: Mapping[str, int], n_x: int) -> tuple[int, int]:
    """Return (to, from) such that the receiver is a state."""
    a, b = (index[name] for name in between)
    return (a, b) if a < n_x else (b, a)


def elimination(n: int, links: list[tuple[int, int, int]]) -> dict[str, Any]:
    """Return the elimination lists of the matrix whose rows are coupled by (to, from, both) links."""
    pattern: list[set[int]] = [{i} for i in range(n)]
    for to, source, both in links:
        if source < n:
            pattern[to].add(source)
            if both:
                pattern[source].add(to)
    order = _minimum_degree(pattern)
    entry: dict[tuple[int, int], int] = {}
    for row in range(n):
        for column in sorted(pattern[row]):
            entry[row, column] = len(entry)
    lower, update, upper = _play(order, pattern, entry)
    place = [
        (
            entry[to, to],
            entry[to, source] if source < n else -1,
            entry[source, source] if both and source < n else -1,
            entry[source, to] if both and source < n else -1,
        )
        for to, source, both in links
    ]
    return {
        "place": tuple(place),
        "diagonal": _ints([entry[i, i] for i in range(n)]),
        "order": _ints(order),
        "lower_entry": _ints([item[0] for item in lower]),
        "lower_row": _ints([item[1] for item in lower]),
        "lower_pivot": _ints([item[2] for item in lower]),
        "lower_begin": _ints([item[3] for item in lower] + [len(update)]),
        "update_to": _ints([to for to, _ in update]),
        "update_by": _ints([by for _, by in update]),
        "upper_begin": _ints(np.cumsum([0, *map(len, upper)]).tolist()),
        "upper_entry": _ints([entry[i, j] for i, row in zip(order, upper) for j in row]),
        "upper_column": _ints([j for row in upper for j in row]),
        "n_entry": len(entry),
    }


def _minimum_degree(pattern: list[set[int]]) -> list[int]:
    """Return the order that eliminates the state with the fewest neighbours first."""
    near = [set() for _ in pattern]  # type: list[set[int]]
    for i, row in enumerate(pattern):
        for j in row - {i}:
            near[i].add(j)
            near[j].add(i)
    order, left = [], set(range(len(pattern)))
    while left:
        pivot = min(left, key=lambda i: (len(near[i]), i))
        left.remove(pivot)
        order.append(pivot)
        for i in near[pivot]:
            near[i] = (near[i] | near[pivot]) - {i, pivot}
    return order


def _play(
    order: list[int], pattern: list[set[int]], entry: dict[tuple[int, int], int]
) -> tuple[list[tuple[int, int, int, int]], list[tuple[int, int]], list[list[int]]]:
    """Eliminate on the pattern alone; fill-in is added to ``entry`` as it appears."""
    lower: list[tuple[int, int, int, int]] = []
    update: list[tuple[int, int]] = []
    upper: list[list[int]] = []
    rows = [set(row) for row in pattern]
    for position, pivot in enumerate(order):
        later = order[position + 1 :]
        right = [j for j in later if j in rows[pivot]]
        upper.append(right)
        for row in later:
            if pivot not in rows[row]:
                continue
            lower.append((entry[row, pivot], row, pivot, len(update)))
            for j in right:
                if j not in rows[row]:
                    rows[row].add(j)
                    entry[row, j] = len(entry)
                update.append((entry[row, j], entry[pivot, j]))
    return lower, update, upper


def _ints(values: Iterable[int]) -> tuple[int, ...]:
    return tuple(int(value) for value in values)
