"""What a network file may say, and what is refused.

A network is a TOML file of tables: ``inputs``, ``disturbances``, ``outputs``, ``nodes``, ``boundaries``,
``links``, ``pipes``, ``radiation``, ``heaters``, ``peltiers`` and ``parameters``.  Elements name
parameters, never numbers, so every number has a unit, a prior and a line that says where it comes from.
:func:`network_from_dict` checks it in two passes: each table by itself (:mod:`pydantic`), then what they say
about each other.  Each refusal names the table and the key.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib import resources
from math import exp, inf
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from thermogrip.datasets.errors import UserError, known_names
from thermogrip.datasets.files import read_toml
from thermogrip.datasets.limits import LARGEST, STEP_RANGE

#: What full scale reads in the units of a share of it.
SHARES = {"1": 1.0, "percent": 100.0, "0_255": 255.0}


class Quantity(NamedTuple):
    """What a parameter that an element names must be: its unit, and where it may lie."""

    unit: str
    sign: Literal["positive", "any", "share"] = "positive"


class Refers(NamedTuple):
    """What a name in an element refers to; a place is a node, a measured temperature or a boundary."""

    to: Literal["place", "node", "switch", "input", "heat"]


Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$", max_length=100)]
Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Positive = Annotated[float, Field(gt=0, le=LARGEST)]
NotNegative = Annotated[float, Field(ge=0, le=LARGEST)]
Step = Annotated[float, Field(ge=STEP_RANGE[0], le=STEP_RANGE[1])]
# ends of a range, None where it is open
OpenLow = Annotated[float, BeforeValidator(lambda end: -inf if end is None else end)]
OpenHigh = Annotated[float, BeforeValidator(lambda end: inf if end is None else end)]
# what is compiled and simulated grows with these, the time of a fit with their square
Few = Field(max_length=50)
Many = Field(max_length=200)
Most = Field(max_length=500)
Two = Annotated[list[Name], Field(min_length=2, max_length=2), Refers("place")]
OfNode = Annotated[Name, Refers("node")]
Switch = Annotated[Name | None, Refers("switch")]
Share = Annotated[Name | None, Quantity("1", "share")]  # what is left with the switch off
Conductance = Annotated[Name, Quantity("W/K")]
Gain = Annotated[Name | None, Quantity("1")]
Signed = Annotated[Name | None, Quantity("1", "any")]
Slope = Annotated[Name | None, Quantity("1/K", "any")]


class Table(BaseModel):
    """What allows no key that is not its own."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)


_DriveUnit = Literal["1", "percent", "0_255", "A", "V", "W"]


class _Scaled(Table):
    """A signal that heaters see as a share of ``full_scale``."""

    full_scale: Positive = 0.0  # 0 until the validator has set it

    @model_validator(mode="before")
    @classmethod
    def _full_scale(cls, content: Any) -> Any:
        if not isinstance(content, Mapping) or "full_scale" in content:
            return content
        ends = content.get("range")
        numbers = isinstance(ends, (list, tuple)) and all(isinstance(end, (int, float)) for end in ends)
        reach = max((abs(float(end)) for end in ends), default=0.0) if numbers and ends is not None else 0.0
        full = SHARES.get(str(content.get("unit")), 0.0)
        if full <= 1.0 and reach > full:
            full = reach
        return {**content, "full_scale": full or 1.0}


class Input(_Scaled):
    """What is moved, seen by elements as a share of ``full_scale``; ``switch`` marks a pump or valve.

    A driver with a coarse register drops what lies behind a multiple of ``step``.
    """

    unit: _DriveUnit
    range: tuple[Number, Number]
    switch: bool = False
    step: Positive | None = None


class Disturbance(_Scaled):
    """What is measured and not moved: a temperature, or of another unit what brings heat, such as a lamp.

    ``log_sd`` is how far its sensor is off, from log to log; heaters see a share of ``full_scale``, which is
    1 of its unit where the unit is no share and the file does not say.
    """

    unit: Literal["degC"] | _DriveUnit = "degC"
    log_sd: NotNegative = 0.0


class Output(Table):
    """A sensor on a node."""

    node: OfNode
    unit: Literal["degC"] = "degC"
    lag: Annotated[Name | None, Quantity("s")] = None
    sd: Positive = 0.1  # of a mean over the fit's bins about the model
    log_sd: NotNegative = 0.0  # of its offset
    reference: bool = False


class Node(Table):
    """A heat capacity; ``start_sd`` is how unsure its temperature is where a log begins."""

    capacity: Annotated[Name, Quantity("J/K")]
    start_sd: Positive = 1.0


class Boundary(Table):
    """A temperature that nothing moves and nobody measures: a parameter."""

    temperature: Annotated[Name, Quantity("degC", "any")]


class Link(Table):
    """A conductance between two nodes."""

    between: Two
    conductance: Conductance
    switch: Switch = None
    off: Share = None
    bend: Signed = None  # by which share it grows per 10 K of difference, as natural convection does


class Pipe(Table):
    """Water that moves from one node to another: cells in a row, each with a piece of wall."""

    source: Annotated[Name, Field(alias="from"), Refers("place")]
    target: Annotated[Name, Field(alias="to"), Refers("node")]
    flow: Conductance  # mass flow times the heat capacity of water
    delay: Annotated[Name, Quantity("s")]  # the time at full flow
    cells: Annotated[int, Field(ge=1, le=60)]
    switch: Switch = None
    off: Share = None
    wall_capacity: Annotated[Name | None, Quantity("J/K")] = None  # as film and loss a sum over all cells
    film: Annotated[Name | None, Quantity("W/K")] = None  # water to wall
    film_off: Share = None
    loss: Annotated[Name | None, Quantity("W/K")] = None  # wall, or else water, to the surroundings
    surroundings: Annotated[Name | None, Refers("place")] = None

    @model_validator(mode="after")
    def _whole(self) -> Pipe:
        if (self.wall_capacity is None) != (self.film is None):
            raise ValueError("wall_capacity and film come together")
        if (self.loss is None) != (self.surroundings is None):
            raise ValueError("loss and surroundings come together")
        return self


class Radiation(Table):
    """Grey radiation between two nodes."""

    between: Two
    area: Annotated[Name, Quantity("m2")]
    emissivity: Annotated[Name, Quantity("1")]


class Heater(Table):
    """What brings heat, or a load that takes it, of a power below 0; ``power`` at the ``full_scale`` of its
    input or disturbance."""

    node: OfNode
    input: Annotated[Name, Refers("heat")]
    power: Annotated[Name, Quantity("W", "any")]


class Peltier(Table):
    """A Peltier element that warms ``face`` at positive command and takes the heat from ``sink``."""

    face: OfNode
    sink: OfNode
    input: Annotated[Name, Refers("input")]
    seebeck: Annotated[Name, Quantity("V/K")]
    resistance: Annotated[Name, Quantity("ohm")]
    current: Annotated[Name, Quantity("A")]
    conductance: Annotated[Name | None, Quantity("W/K")] = None
    offset: Signed = None
    heating_gain: Gain = None
    cooling_gain: Gain = None
    droop: Signed = None
    dead_zone: Signed = None
    seebeck_slope: Slope = None
    resistance_slope: Slope = None
    driver: Literal["current", "duty"] = "current"


class Parameter(Table):
    """One number: unit, prior, bounds.

    The prior is log-normal about ``value`` with ``sd_log``, or normal with ``sd``; ``fixed`` keeps the value.
    ``per_log`` is how far it differs from log to log: a standard deviation on the same scale.
    """

    unit: Annotated[str, Field(min_length=1)]
    value: Number
    sd_log: Annotated[float, Field(gt=0, le=10)] | None = None
    sd: Positive | None = None
    low: Number | None = None
    high: Number | None = None
    fixed: bool = False
    per_log: Positive | None = None
    about: str = ""

    @model_validator(mode="after")
    def _prior(self) -> Parameter:
        if self.sd is not None and self.sd_log is not None:
            raise ValueError("has both sd and sd_log")
        if not self.fixed and self.sd is None and self.sd_log is None:
            raise ValueError("has no prior: give sd or sd_log, or fixed = true")
        if self.per_log is not None and self.fixed:
            raise ValueError("is fixed, so it cannot differ from log to log: leave out per_log or fixed")
        if self.sd_log is not None and self.value <= 0:
            raise ValueError(f"value {self.value:g} is not positive, so it has no sd_log")
        low, high = self.bounds
        if not low <= self.value <= high or (low == high and not self.fixed):
            raise ValueError(f"value {self.value:g} lies outside {low:g} to {high:g}")
        return self

    @property
    def scale(self) -> str:
        """``"log"`` or ``"linear"``: the scale of its prior."""
        return "linear" if self.sd_log is None else "log"

    @property
    def bounds(self) -> tuple[float, float]:
        """Where it may lie; five prior sd either way where the file does not say."""
        if self.sd_log is not None:
            factor = exp(5 * self.sd_log)
            low, high = self.value / factor, self.value * factor
        elif self.sd is not None:
            low, high = self.value - 5 * self.sd, self.value + 5 * self.sd
        else:
            low = high = self.value
        return (low if self.low is None else self.low, high if self.high is None else self.high)


class Network(Table):
    """A whole network file, checked."""

    schema_: Literal["thermogrip.network"] = Field(alias="schema")
    version: Literal[1]
    name: Annotated[str, Field(min_length=1)]
    about: str = ""
    dt: Step
    average: Step | None = None  # length of the bins of a fit [s]
    inputs: Annotated[dict[Name, Input], Few]
    disturbances: Annotated[dict[Name, Disturbance], Few] = {}
    outputs: Annotated[dict[Name, Output], Field(min_length=1), Many]
    nodes: Annotated[dict[Name, Node], Field(min_length=1), Many]
    boundaries: Annotated[dict[Name, Boundary], Many] = {}
    links: Annotated[dict[Name, Link], Most] = {}
    pipes: Annotated[dict[Name, Pipe], Few] = {}
    radiation: Annotated[dict[Name, Radiation], Many] = {}
    heaters: Annotated[dict[Name, Heater], Many] = {}
    peltiers: Annotated[dict[Name, Peltier], Few] = {}
    parameters: Annotated[dict[Name, Parameter], Field(min_length=1), Most]


def builtin_networks() -> tuple[str, ...]:
    """Return the names of the networks that come with the package."""
    folder = resources.files("thermogrip.sysid") / "networks"
    return tuple(
        sorted(item.name.removesuffix(".toml") for item in folder.iterdir() if item.name.endswith(".toml"))
    )


def named_network(name_or_path: str | Path) -> Network:
    """Return what a network's file says, by its name or path; see
    :func:`thermogrip.sysid.models.network.load_network`."""
    text = str(name_or_path)
    if text in builtin_networks():
        text = str(resources.files("thermogrip.sysid") / "networks" / f"{text}.toml")
    elif not text.endswith(".toml") and not Path(text).is_file():
        hint = known_names(text, builtin_networks(), "name one of {}, or a TOML file")
        raise UserError(f"no network {text!r}", hint=hint)
    return network_from_dict(read_toml(text, hint="see 'thermogrip init network'"), file=text)


def network_from_dict(content: Mapping[str, Any], *, file: str | None = None) -> Network:
    """Check the tables of a network; ``file`` is where they are from."""
    try:
        network = Network.model_validate(dict(content))
    except ValidationError as error:
        raise UserError(fault_words(error), file=file, hint="see 'thermogrip init network'") from error
    for problem, hint in _network_faults(network):
        raise UserError(problem, file=file, hint=hint)
    return network


def fault_words(error: ValidationError) -> str:
    """Return the first thing that pydantic found wrong, behind the keys where it is."""
    first = error.errors()[0]
    text, value = first["msg"].removeprefix("Value error, "), first["input"]
    if text.startswith("Input should be") and isinstance(value, (int, float, str)):
        text += f", not {repr(value)[:40]}"
    return f"{'.'.join(map(str, first['loc']))}: {text}"


class _Named(NamedTuple):
    """A name that an element mentions."""

    where: str  # table, element and key
    kind: Quantity | Refers
    names: list[str]


def _mentioned(network: Network) -> list[_Named]:
    """Return every name that an element mentions."""
    out = []
    for group in ("outputs", "nodes", "boundaries", "links", "pipes", "radiation", "heaters", "peltiers"):
        for name, element in getattr(network, group).items():
            for key, field in type(element).model_fields.items():
                value, where = getattr(element, key), f"{group}.{name}.{field.alias or key}"
                names = value if isinstance(value, list) else [value]
                kinds = [mark for mark in field.metadata if isinstance(mark, (Quantity, Refers))]
                out += [_Named(where, kind, names) for kind in kinds if value is not None]
    return out


def _network_faults(network: Network) -> Iterator[tuple[str, str]]:
    """Yield (problem, hint) for each contradiction between the tables."""
    group_of: dict[str, str] = {}
    for group in ("inputs", "disturbances", "outputs", "nodes", "boundaries", "pipes"):
        for name in getattr(network, group):
            if name in group_of:
                yield f"{group}.{name}: the name is in {group_of[name]} too", "give each its own name"
            group_of[name] = group
    mentioned = _mentioned(network)
    for where, kind, names in mentioned:
        if isinstance(kind, Refers):
            yield from _reference_faults(network, where, kind, names)
        else:
            yield from _parameter_faults(network, where, kind, names[0])
    used = {name for _, _, names in mentioned for name in names}
    for name in network.parameters:
        if name not in used:
            yield f"parameters.{name}: no element names it", "use it or leave it out"
    linked = {name for _, kind, names in mentioned if isinstance(kind, Refers) for name in names}
    for node in network.nodes:
        if node not in linked:
            yield f"nodes.{node}: no element touches it", "link it or leave it out"
    if sum(output.reference for output in network.outputs.values()) > 1:
        yield "outputs: two are the reference", "mark one sensor as the temperature scale"
    for name, item in network.inputs.items():
        if not item.range[0] < item.range[1]:
            yield f"inputs.{name}.range: {list(item.range)} is empty", "write [low, high]"


def _reference_faults(
    network: Network, where: str, kind: Refers, names: list[str]
) -> Iterator[tuple[str, str]]:
    measured = {name: item.unit for name, item in network.disturbances.items()}
    outside = [*(name for name, unit in measured.items() if unit == "degC"), *network.boundaries]
    switches = [name for name, item in network.inputs.items() if item.switch]
    candidates = {"place": [*network.nodes, *outside], "node": [*network.nodes], "switch": switches}
    candidates["input"] = [*network.inputs]
    candidates["heat"] = [*network.inputs, *(name for name, unit in measured.items() if unit != "degC")]
    for name in names:
        if name not in candidates[kind.to]:
            lacking = {"place": "node", "heat": "input"}.get(kind.to, kind.to)
            yield f"{where}: no {lacking} {name!r}", known_names(name, candidates[kind.to], "there are {}")
    if len(names) == 2 and (names[0] == names[1] or set(names) <= set(outside)):
        yield f"{where}: joins {names[0]} and {names[1]}", "join two places, one of them a node"


def _parameter_faults(network: Network, where: str, kind: Quantity, name: str) -> Iterator[tuple[str, str]]:
    if name not in network.parameters:
        yield f"{where}: no parameter {name!r}", known_names(name, network.parameters, "there are {}")
        return
    parameter = network.parameters[name]
    if parameter.unit != kind.unit:
        problem = f"parameters.{name}.unit: {parameter.unit!r}, but {where} is in {kind.unit}"
        yield problem, "correct one"
    if kind.sign == "positive" and (parameter.value <= 0 or parameter.bounds[0] < 0):
        yield f"parameters.{name}: {where} must be positive", "give a value and bounds above 0"
    if kind.sign == "share" and not (parameter.bounds[0] >= 0 and parameter.value <= 1):
        yield f"parameters.{name}: {where} is what is left, 0 to 1", "set low = 0.0 and high = 1.0"
