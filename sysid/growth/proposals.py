"""What a residual asks for: terms that it still obeys, and the changes of a network that they stand for.

:mod:`thermogrip.sysid.growth.residual_regression` finds products of signals that explain the residual on
held-out stretches.  A product is no physics, but each kind has few causes in a thermal network:

==============  ==================================================================================
term            changes of the network that would leave it out of the residual
==============  ==================================================================================
u               sides that differ, a dead zone, an offset of the drive; a second zone (the term is slow)
abs(u)          the same
u u             a driver that droops, a resistance that rises, sides that differ; a second zone (an input that
                is on or off is its own square)
u T             a Seebeck coefficient that follows the temperature, a driver that droops
abs(u) T        a resistance that follows the temperature
T               a second zone behind the sensor's node, with the term's time constant
T T             a loss that grows faster than the difference
d, d d          air about the rig that lags what is read, by the term's time constant; a steady bench
T d             convection, a steady bench
s               heat of the pump; a film that follows the flow
s T, s u, s d   a film that follows the flow
==============  ==================================================================================

u: an input, T: a simulated output, d: a measured ambient, s: a switch.  A term proposes; the held-out rule of
:mod:`thermogrip.sysid.growth.stepwise` judges a proposal like any other candidate.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from thermogrip.sysid.growth.candidates import Candidate, lagging_air, second_zone, suggested
from thermogrip.sysid.growth.residual_regression import ResidualTerm
from thermogrip.sysid.models.network import NetworkModel
from thermogrip.sysid.models.network_spec import Network

__all__ = ["meaning", "proposed"]

MOST = 6  # terms that may propose

_SIDES = ("cooling gain", "dead zone", "drive offset")
_ANSWERS: dict[str, tuple[str, ...]] = {
    "u": (*_SIDES, "second zone"),
    "|u|": (*_SIDES, "second zone"),
    "u*u": ("droop", "R(T)", "cooling gain", "second zone"),
    "|u|*u": ("droop", "R(T)", "cooling gain"),
    "|u|*|u|": ("droop", "R(T)", "cooling gain"),
    "T*u": ("S(T)", "droop"),
    "T*|u|": ("R(T)", "S(T)"),
    "T": ("second zone",),
    "T*T": ("convection",),
    "d": ("lagging air", "steady bench"),
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
    """Return the kind of a residual's term: u, d, T and s, in a fixed order.

    Examples
    --------
    >>> from thermogrip.sysid.models.network import load_network
    >>> [meaning(load_network("gripper"), term) for term in ("drive*|drive|", "pump*t_tank", "t_ambient")]
    ['|u|*u', 'T*s', 'd']
    """
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
    """Return the changes that the largest terms stand for, each with the term that asks for it.

    Parameters
    ----------
    model : NetworkModel
    terms : sequence of ResidualTerm
        From :func:`thermogrip.sysid.growth.residual_regression.residual_terms`.

    Returns
    -------
    asked : list of (Candidate, ResidualTerm)
        Each candidate once, of the largest term first; empty where the network has all that they stand for.

    Examples
    --------
    >>> from thermogrip.sysid.models.network import load_network
    >>> gripper = load_network("gripper")
    >>> bent = ResidualTerm("t_surface", "drive*t_tank", 0.1, 60.0, 0.3)
    >>> [candidate.name for candidate, _ in proposed(gripper, [bent])]
    ['module: S(T)', 'module: droop']
    """
    out: dict[str, tuple[Candidate, ResidualTerm]] = {}
    for term in sorted(terms, key=lambda term: -term.share)[:MOST]:
        for label in _ANSWERS.get(meaning(model, term.term), ()):
            for candidate in _standing_for(model, label, term):
                if not set(candidate.patch["parameters"]) <= set(model.parameters):  # it is there already
                    out.setdefault(candidate.name, (candidate, term))
    return list(out.values())


def _standing_for(model: NetworkModel, label: str, term: ResidualTerm) -> Iterator[Candidate]:
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
