"""Candidate changes of a network: what it may lack, and which of these the residuals propose.

Each :class:`Candidate` is a patch of the network's tables, merged key by key; ``None`` takes a key away.
:func:`suggested` returns what a network does not have yet, and what could be taken from it.

**Terms of the residual.** Let r = y - v be the error of the free run. A heat flow that the equations lack
moves it like

    tau dr/dt = -r + sum_j xi_j phi_j(u, d, v)          (tau infinite: a flow that is only stored),

phi_j products of inputs, magnitudes of signed inputs, disturbances and simulated outputs. So r is regressed
on every phi_j filtered by 1 / (1 + tau s), for a range of tau; simulated outputs stand in the terms, not
measured ones, for the noise of a regressor would bias its coefficient. Terms enter one at a time, the one
that explains most of the residual's variance on stretches *not* fitted (each log in turn, or each of four
blocks of a single one), and the search stops when the best adds less than :data:`LEAST`. Levels are taken
out of each stretch, since sensors have offsets of their own.

**Candidates that a term proposes.** A product of signals is no physics, but each kind has few causes in a
thermal network (:data:`_ANSWERS`). A term proposes; the held-out rule of
:mod:`thermogrip.sysid.growth.stepwise` evaluates a proposal like any other candidate.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, columns, log_name
from thermogrip.sysid.models.lti import evaluate_terms
from thermogrip.sysid.models.network import NetworkModel
from thermogrip.sysid.models.network_spec import Network, network_from_dict, roles
from thermogrip.sysid.plant.plant import Plant

LEAST = 0.02  # of the residual's variance on held-out rows
ROWS = 400  # of the longest log: a residual is slow
BLOCKS = 4


@dataclass(frozen=True)
class ResidualTerm:
    """A term with which the residual of one output correlates."""

    output: str  # whose residual
    term: str  # product of signals, such as ``"drive*|drive|"``; a simulated output has its own name
    tau: float  # time constant of the response [s]
    share: float  # part of the residual's held-out variance that it explains beyond the terms before it


def residual_terms(
    plant: Plant, logs: Sequence[Log], *, warmup: float = 5.0, most: int = 4
) -> tuple[ResidualTerm, ...]:
    """Return the terms with which the residuals of free runs correlate, output by output as they enter."""
    longest = max(float(np.ptp(log["time"].values)) for log in logs)
    step = max(plant.dt, longest / ROWS)
    runs = [_rows(plant, log, step, warmup) for log in logs]
    parts = _parts([len(time) for time, _, _ in runs])
    signs = np.concatenate([signals for _, signals, _ in runs])
    labels = _labels(plant, signs)
    taus = np.geomspace(2 * step, longest, 24)
    features = np.stack([_filtered(runs, labels, plant, tau) for tau in taus])  # (n_tau, rows, terms)
    residual = np.concatenate([r for _, _, r in runs])
    out: list[ResidualTerm] = []
    for i, name in enumerate(plant.outputs):
        out += _grow(residual[:, i], features, parts, labels, taus, name, most)
    return tuple(out)


def _rows(plant: Plant, log: Log, step: float, warmup: float) -> tuple[Array, Array, Array]:
    """Return block means: times, signals [inputs, disturbances, simulated outputs], residuals."""
    run = plant.simulate(log, warmup=warmup)
    time = np.asarray(log["time"].values, dtype=float)
    simulated = columns(run, plant.outputs)
    residual = np.where(run["scored"].values[:, None] > 0, columns(log, plant.outputs) - simulated, np.nan)
    signals = np.hstack([columns(log, plant.inputs), columns(log, plant.disturbances), simulated])
    cell = ((time - time[0]) / step).astype(int)
    if cell[-1] < 10 * BLOCKS:
        raise UserError("is too short to learn from its residual", file=log_name(log), hint="leave it out")
    return time[0] + step * np.unique(cell), _means(signals, cell), _means(residual, cell)


def _means(values: Array, cell: NDArray[np.int_]) -> Array:
    """Return means (n_cell, n) of the finite values in each cell that has rows; NaN where none is finite."""
    known = pd.DataFrame(np.where(np.isfinite(values), values, np.nan))
    return known.groupby(cell).mean().to_numpy()


def _parts(lengths: Sequence[int]) -> NDArray[np.int_]:
    """Return which stretch each row belongs to: its log, or with fewer than three its block of a log."""
    per = 1 if len(lengths) >= 3 else BLOCKS
    return np.concatenate([at * per + np.arange(n) * per // n for at, n in enumerate(lengths)])


def _labels(plant: Plant, signals: Array) -> list[str]:
    """Return single signals, magnitudes of signed inputs, and all products of two."""
    names = [*plant.inputs, *plant.disturbances, *plant.outputs]
    moving = [n for i, n in enumerate(names) if np.ptp(signals[:, i]) > 1e-9 * np.abs(signals[:, i]).max()]
    signed = [n for n in moving if n in plant.inputs and signals[:, names.index(n)].min() < 0]
    single = [*moving, *(f"|{n}|" for n in signed)]
    return [*single, *("*".join(pair) for pair in combinations_with_replacement(single, 2))]


def _filtered(
    runs: Sequence[tuple[Array, Array, Array]], labels: Sequence[str], plant: Plant, tau: float
) -> Array:
    """Return the terms (rows, n_term), filtered by a first-order lag log by log."""
    names = (*plant.inputs, *plant.disturbances, *plant.outputs)
    out = []
    for time, signals, _ in runs:
        phi = evaluate_terms(labels, names, signals)
        keep = np.exp(-np.diff(time) / tau)
        lagged = np.empty_like(phi)
        lagged[0] = phi[0]
        for k in range(1, len(phi)):
            lagged[k] = keep[k - 1] * lagged[k - 1] + (1 - keep[k - 1]) * phi[k - 1]
        out.append(lagged)
    return np.concatenate(out)


def _grow(
    residual: Array,
    features: Array,
    parts: NDArray[np.int_],
    labels: Sequence[str],
    taus: Array,
    name: str,
    most: int,
) -> list[ResidualTerm]:
    """Return the terms of one output, each the best next one on held-out stretches."""
    known = np.isfinite(residual)
    r, X, where = residual[known], features[:, known], parts[known]
    r = _levelled(r[:, None], where)[:, 0]
    X = np.stack([_levelled(some, where) for some in X])
    chosen: list[tuple[int, int]] = []
    out: list[ResidualTerm] = []
    reached = 0.0
    while len(chosen) < most:
        best, at = reached + LEAST, None
        for tau in range(len(taus)):
            for term in range(len(labels)):
                some = np.column_stack([X[i, :, j] for i, j in (*chosen, (tau, term))])
                explained = _explained(some, r, where)
                if explained > best:
                    best, at = explained, (tau, term)
        if at is None:
            break
        chosen.append(at)
        out.append(ResidualTerm(name, labels[at[1]], float(taus[at[0]]), best - reached))
        reached = best
    return out


def _levelled(values: Array, where: NDArray[np.int_]) -> Array:
    return np.asarray(values - pd.DataFrame(values).groupby(where).transform("mean").to_numpy())


def _explained(X: Array, r: Array, where: NDArray[np.int_]) -> float:
    """Return 1 - (held-out squares) / (squares of r), each stretch predicted from the others."""
    grams = [(X[rows].T @ X[rows], X[rows].T @ r[rows]) for rows in (where == p for p in np.unique(where))]
    gram, cross = sum(g for g, _ in grams), sum(c for _, c in grams)
    ridge = 1e-9 * np.trace(gram) * np.eye(len(cross))
    left = 0.0
    for g, c in grams:
        value = np.linalg.solve(gram - g + ridge, cross - c)
        left += float(value @ g @ value - 2 * value @ c)
    return -left / max(float(r @ r), 1e-300)


Patch = Mapping[str, Any]

_MUCH = 100.0  # of the largest capacity: what the rig does not warm
_AIR_LAG = 60.0  # [s]
_LEFT = {"unit": "1", "value": 0.5, "sd": 0.3, "low": 0.0, "high": 1.0}  # of a film, in still water


@dataclass(frozen=True)
class Candidate:
    """A named change of a network."""

    name: str
    patch: Patch  # tables to merge into the network's; ``None`` takes a key away
    change: Literal["add", "remove"] = "add"
    about: str = ""  # what in the residuals it would explain


def patched(model: NetworkModel, candidate: Candidate) -> NetworkModel:
    """Return the network with the candidate's change, without parameters that nothing names any more."""
    tables = model.network.model_dump(by_alias=True, mode="json", exclude_none=True)
    merged = _merged(tables, candidate.patch)
    parameters = merged.get("parameters", {})
    used = _named(merged)
    merged["parameters"] = {name: item for name, item in parameters.items() if name in used}
    try:
        return NetworkModel(network_from_dict(merged))
    except UserError as error:
        raise UserError(f"candidate {candidate.name!r}: {error}") from error


def suggested(model: NetworkModel) -> list[Candidate]:
    """Return what a network does not have yet, then what could be taken from it."""
    network = model.network
    air = [lagging_air(network, name) for name in network.disturbances if f"{name}_near" not in network.nodes]
    return [*_of_peltiers(network), *_of_nodes(network), *air, *_of_pipes(network), *_removals(model)]


def second_zone(network: Network, node: str, *, tau: float | None = None) -> Candidate:
    """Return a zone behind a node that follows it with the time constant ``tau`` [s]."""
    zone, C, G = f"{node}_zone", f"C_{node}_zone", f"G_{node}_zone"
    size = max(0.3 * network.parameters[network.nodes[node].capacity].value, 1.0)
    conductance = max(size / 15.0, 0.02) if tau is None else size / tau
    patch = {
        "nodes": {zone: {"capacity": C, "start_sd": 0.5}},
        "links": {zone: {"between": [node, zone], "conductance": G}},
        "parameters": {
            C: {"unit": "J/K", "value": size, "sd_log": 1.0},
            G: {"unit": "W/K", "value": conductance, "sd_log": 1.4},
        },
    }
    return Candidate(f"{node}: second zone", patch, about="two time constants after a step")


def lagging_air(network: Network, disturbance: str, *, tau: float = _AIR_LAG) -> Candidate:
    """Return air about the rig that follows the measured ambient with the time constant ``tau`` [s]: a node
    of so large a capacity that the rig does not warm it, for a sensor that lags the air would need the
    reading's slope, which a network does not know."""
    air, C, G = f"{disturbance}_near", f"C_{disturbance}_near", f"G_{disturbance}_near"
    size = _MUCH * max(network.parameters[node.capacity].value for node in network.nodes.values())

    def near(end: str) -> str:
        return air if end == disturbance else end

    links: dict[str, Any] = {
        name: {"between": [near(end) for end in link.between]}
        for name, link in network.links.items()
        if disturbance in link.between
    }
    patch = {
        "nodes": {air: {"capacity": C, "start_sd": 0.5}},
        "links": links | {air: {"between": [air, disturbance], "conductance": G}},
        "pipes": {
            name: {"surroundings": air}
            for name, pipe in network.pipes.items()
            if pipe.surroundings == disturbance
        },
        "radiation": {
            name: {"between": [near(end) for end in glow.between]}
            for name, glow in network.radiation.items()
            if disturbance in glow.between
        },
        "parameters": {
            C: {"unit": "J/K", "value": size, "fixed": True},
            G: {"unit": "W/K", "value": size / tau, "sd_log": 1.4},
        },
    }
    return Candidate(f"{disturbance}: lagging air", patch, about="the ambient is felt late")


def _merged(tables: Mapping[str, Any], patch: Patch) -> dict[str, Any]:
    out = dict(tables)
    for key, value in patch.items():
        if value is None:
            out.pop(key, None)
        elif isinstance(value, Mapping):
            out[key] = _merged(out.get(key, {}), value)
        else:
            out[key] = value
    return out


def _named(tables: Mapping[str, Any]) -> set[str]:
    """Return every string that an element holds: the parameters that are still used are among them."""
    out: set[str] = set()
    for group, elements in tables.items():
        if group == "parameters" or not isinstance(elements, Mapping):
            continue
        for element in elements.values():
            if isinstance(element, Mapping):
                out |= {value for value in element.values() if isinstance(value, str)}
    return out


def _of_peltiers(network: Network) -> Iterator[Candidate]:
    """What a Peltier element and its driver may do beside a constant Seebeck coefficient and resistance."""
    terms = (
        ("droop", "droop", {"unit": "1", "value": 0.0, "sd": 0.14}, "less drive at large differences"),
        ("dead zone", "dead_zone", {"unit": "1", "value": 0.01, "sd": 0.02, "low": 0.0}, "flat about zero"),
        ("S(T)", "seebeck_slope", {"unit": "1/K", "value": 0.0, "sd": 0.002}, "gain that follows the level"),
        ("R(T)", "resistance_slope", {"unit": "1/K", "value": 0.0, "sd": 0.005}, "heat follows the level"),
        ("drive offset", "offset", {"unit": "1", "value": 0.0, "sd": 0.05}, "heat at zero drive"),
        ("cooling gain", "cooling_gain", {"unit": "1", "value": 1.0, "sd": 0.3, "low": 0.2}, "sides differ"),
    )
    for name, element in network.peltiers.items():
        one_sided = network.inputs[element.input].range[0] >= 0
        for label, key, parameter, about in terms:
            if getattr(element, key) is None and not (one_sided and key == "cooling_gain"):
                own = f"{name}_{key}"
                patch = {"peltiers": {name: {key: own}}, "parameters": {own: parameter}}
                yield Candidate(f"{name}: {label}", patch, about=about)


def _of_nodes(network: Network) -> Iterator[Candidate]:
    """Second zones behind nodes, bends of what leads to the air, a steady place beside the ambient."""
    for name in network.nodes:
        if f"{name}_zone" not in network.nodes:
            yield second_zone(network, name)
    for name, link in network.links.items():
        if set(link.between) & set(network.disturbances) and link.bend is None:
            own = f"{name}_bend"
            patch = {
                "links": {name: {"bend": own}},
                "parameters": {own: {"unit": "1", "value": 0.1, "sd": 0.1, "low": 0.0}},
            }
            yield Candidate(f"{name}: convection", patch, about="loss that grows faster than the difference")
    for link in network.links.values():
        inside = [end for end in link.between if end in network.nodes]
        if len(inside) != 1 or not set(link.between) & set(network.disturbances):
            continue
        [node] = inside
        place, T, G = f"{node}_bench", f"t_{node}_bench", f"G_{node}_bench"
        if place in network.boundaries:
            continue
        value = 0.5 * network.parameters[link.conductance].value
        patch = {
            "boundaries": {place: {"temperature": T}},
            "links": {place: {"between": [node, place], "conductance": G}},
            "parameters": {
                T: {"unit": "degC", "value": 22.0, "sd": 2.0},
                G: {"unit": "W/K", "value": value, "sd_log": 1.0},
            },
        }
        yield Candidate(f"{node}: steady bench", patch, about="ambient matters less than it should")


def _of_pipes(network: Network) -> Iterator[Candidate]:
    """Films that are thinner in still water: of tubes, and of links beside which water flows."""
    films: dict[str, list[str]] = {}
    for name, pipe in network.pipes.items():
        if pipe.film is not None and pipe.film_off is None and pipe.switch is not None:
            films.setdefault(pipe.film, []).append(name)
    for film, pipes in films.items():
        own = f"{film}_off"
        patch = {"pipes": {name: {"film_off": own} for name in pipes}, "parameters": {own: _LEFT}}
        yield Candidate(f"{film}: film follows the flow", patch, about="slower while the pump rests")
    wet = {end: pipe.switch for pipe in network.pipes.values() for end in (pipe.source, pipe.target)}
    for name, link in network.links.items():
        pump = next((wet[end] for end in link.between if wet.get(end) is not None), None)
        if pump is None or link.switch is not None or set(link.between) & set(network.disturbances):
            continue
        own = f"{link.conductance}_off"
        patch = {"links": {name: {"switch": pump, "off": own}}, "parameters": {own: _LEFT}}
        yield Candidate(f"{name}: film follows the flow", patch, about="slower while the pump rests")


def _removals(model: NetworkModel) -> Iterator[Candidate]:
    """Every optional key of an element that is a free parameter, and every node with one link."""
    network = model.network
    free = {name for name, item in network.parameters.items() if not item.fixed}
    seen: set[str] = set()
    for table, key, parameter in roles(network):
        group, name = table.split(".", 1)
        optional = type(getattr(network, group)[name]).model_fields[key].default is None
        together = key in ("wall_capacity", "film", "loss")  # these come in pairs
        if parameter in free - seen and optional and not together:
            seen.add(parameter)
            yield Candidate(f"without {parameter}", _without(network, parameter), "remove")
    for name, link in network.links.items():
        if link.conductance in free and set(link.between) & set(network.disturbances):
            yield Candidate(f"without {name}", {"links": {name: None}}, "remove")
    for name in network.nodes:
        touching = [n for n, link in network.links.items() if name in link.between]
        inner = [n for n in touching if not set(network.links[n].between) & set(network.disturbances)]
        elsewhere = any(
            name in (getattr(e, a, None) for a in ("face", "sink", "source", "target", "node"))
            for g in ("peltiers", "pipes", "heaters", "outputs")
            for e in getattr(network, g).values()
        )
        if len(inner) == 1 and not elsewhere:
            patch = {"nodes": {name: None}, "links": dict.fromkeys(touching)}
            yield Candidate(f"without {name}", patch, "remove")


def _without(network: Network, parameter: str) -> dict[str, Any]:
    """Return the patch that takes every mention of a parameter away."""
    patch: dict[str, Any] = {}
    for table, key, name in roles(network):
        if name == parameter:
            group, element = table.split(".", 1)
            patch.setdefault(group, {}).setdefault(element, {})[key] = None
    return patch


MOST = 6  # terms that may propose

_SIDES = ("cooling gain", "dead zone", "drive offset")
# what would remove a term from the residual; u: an input, T: a simulated output, d: a measured ambient, s: a
# switch
_ANSWERS: dict[str, tuple[str, ...]] = {
    "u": (*_SIDES, "second zone"),  # where the term is slow
    "|u|": (*_SIDES, "second zone"),
    "u*u": ("droop", "R(T)", "cooling gain", "second zone"),  # an input that is on or off is its own square
    "|u|*u": ("droop", "R(T)", "cooling gain"),
    "|u|*|u|": ("droop", "R(T)", "cooling gain"),
    "T*u": ("S(T)", "droop"),
    "T*|u|": ("R(T)", "S(T)"),
    "T": ("second zone",),  # behind the sensor's node, with the term's time constant
    "T*T": ("convection",),
    "d": ("lagging air", "steady bench"),  # air that lags what is read by the term's time constant
    "d*d": ("lagging air", "steady bench"),
    "T*d": ("convection", "steady bench"),
    "s": ("film follows the flow", "heat of the pump"),
    "s*s": ("film follows the flow", "heat of the pump"),
    "T*s": ("film follows the flow",),
    "s*u": ("film follows the flow",),
    "s*|u|": ("film follows the flow",),
    "d*s": ("film follows the flow",),
}


def meaning(model: NetworkModel, term: str) -> str:
    """Return the kind of a residual's term: u, d, T and s, in a fixed order."""
    kinds = []
    for factor in term.split("*"):
        name = factor.strip("|")
        if name in model.switches:
            kinds.append("s")
        elif name in model.inputs:
            kinds.append("|u|" if factor.startswith("|") else "u")
        else:
            kinds.append("d" if name in model.disturbances else "T")
    return "*".join(sorted(kinds, key=["T", "d", "s", "|u|", "u"].index))


def proposed(model: NetworkModel, terms: Sequence[ResidualTerm]) -> list[tuple[Candidate, ResidualTerm]]:
    """Return the changes that the largest terms propose, each with its term and once, largest term first."""
    out: dict[str, tuple[Candidate, ResidualTerm]] = {}
    for term in sorted(terms, key=lambda term: -term.share)[:MOST]:
        for label in _ANSWERS.get(meaning(model, term.term), ()):
            for candidate in _candidates_of(model, label, term):
                if not set(candidate.patch["parameters"]) <= set(model.parameters):  # it is there already
                    out.setdefault(candidate.name, (candidate, term))
    return list(out.values())


def _candidates_of(model: NetworkModel, label: str, term: ResidualTerm) -> Iterator[Candidate]:
    """Yield the candidates of one kind that concern the signals of the term."""
    network, factors = model.network, {factor.strip("|") for factor in term.term.split("*")}
    if label == "second zone":
        yield second_zone(network, network.outputs[term.output].node, tau=term.tau)
    elif label == "lagging air":
        yield from (
            lagging_air(network, name, tau=term.tau) for name in model.disturbances if name in factors
        )
    elif label == "heat of the pump":
        yield from _pump_heat(network, factors)
    else:
        touched = {name for name, e in network.peltiers.items() if e.input in factors}
        for candidate in suggested(model):
            element, _, kind = candidate.name.partition(": ")
            if kind == label and (element not in network.peltiers or element in touched):
                yield candidate


def _pump_heat(network: Network, factors: set[str]) -> Iterator[Candidate]:
    """Yield what a pump's motor gives to the water that it moves."""
    pumps = {pipe.switch: pipe.source for pipe in reversed(network.pipes.values()) if pipe.switch in factors}
    heated = {heater.input for heater in network.heaters.values()}
    for pump, node in pumps.items():
        if pump is None or pump in heated or node not in network.nodes:
            continue
        own = f"P_{pump}"
        patch = {
            "heaters": {f"{pump}_motor": {"node": node, "input": pump, "power": own}},
            "parameters": {own: {"unit": "W", "value": 0.5, "sd_log": 1.0}},
        }
        yield Candidate(f"{pump}: heat of the pump", patch, about="warmer while the pump runs")
