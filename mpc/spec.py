"""What is wanted from a controller, in the user's units; read from TOML, every key with a default.

The template in :data:`SPEC_TEMPLATE` is the documentation: ``thermogrip init spec`` writes it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.files import read_toml
from thermogrip.mpc.design import Design, default_design

if TYPE_CHECKING:
    from thermogrip.sysid.plant import Plant

__all__ = ["SPEC_TEMPLATE", "Spec", "read_spec", "spec_from_dict"]

SPEC_TEMPLATE = """\
# What the controller should do.  Every line may be left out; the values here are the defaults.

# Steps of the skin that are tested in simulation, from -> to [degC].  Each starts with the plant at rest.
steps = [[28, 38], [28, 18], [18, 43]]

settle_within_s = 450      # inside the band, and staying there, after this long
band_degC = 0.25           # half width of the band
overshoot_degC = 0.3       # beyond the target, at most
bias_degC = 0.05           # mean error at the end, at most
hold_s = 600               # how long each step is simulated

energy_weight = 0.0        # seconds of settling that you would give for one second at full drive

# sample_time_s = 2.0      # by default a quarter of the plant's delay
# slew_per_s = 0.25        # largest change of a drive [its units per s]; default: an eighth of its range
# drive_limits = [-1.0, 1.0]      # several drives: drive_limits = { q1 = [0, 100], q2 = [0, 80] }
# output = "t_surface"     # what is regulated; several: output = ["t1", "t2"]

ambient_degC = 25.0        # the room of the simulations
noise_degC = 0.04          # of one reading (a quantum of 1/16 degC comes on top)
sensor_offset_degC = 0.2   # thermocouple and room sensor are off by this, unknown to the controller

search_draws = 2           # posterior draws of the plant in the search
check_draws = 5            # and in the final comparison
evaluations = 20           # designs that the search may try

# [limits]                 # soft limits of outputs [degC]; default for a water tank:
# t_tank = [2, 65]
"""

_WATER = (2.0, 65.0)  # degC: neither ice nor scald in a tank of water

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Temperature = Annotated[float, Field(ge=-20, le=150)]
Range = tuple[float, float]


class Spec(BaseModel):
    """What is wanted; the fields are explained in :data:`SPEC_TEMPLATE`.

    Examples
    --------
    >>> Spec(settle_within_s=200).steps[0]
    (28.0, 38.0)
    >>> try:
    ...     spec_from_dict({"band_degC": -1})
    ... except UserError as error:
    ...     print(error.problem)
    band_degC: input should be greater than 0
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    steps: Annotated[list[tuple[Temperature, Temperature]], Field(min_length=1, max_length=20)] = [
        (28.0, 38.0),
        (28.0, 18.0),
        (18.0, 43.0),
    ]
    settle_within_s: Positive = 450.0
    band_degC: Positive = 0.25
    overshoot_degC: Positive = 0.3
    bias_degC: Positive = 0.05
    hold_s: Annotated[float, Field(ge=10, le=36000)] = 600.0
    energy_weight: NotNegative = 0.0
    sample_time_s: Positive | None = None
    slew_per_s: Positive | dict[str, Positive] | None = None
    drive_limits: Range | dict[str, Range] | None = None
    output: str | list[str] | None = None
    ambient_degC: Temperature = 25.0
    noise_degC: NotNegative = 0.04
    sensor_offset_degC: float = 0.2
    search_draws: Annotated[int, Field(ge=1, le=50)] = 2
    check_draws: Annotated[int, Field(ge=1, le=200)] = 5
    evaluations: Annotated[int, Field(ge=1, le=10000)] = 20
    limits: dict[str, Range] | None = None

    @model_validator(mode="after")
    def _agree(self) -> Spec:
        for start, target in self.steps:
            if abs(start - target) <= self.band_degC:
                raise ValueError(f"steps: {start:g} -> {target:g} stays inside the band")
        ranges: dict[str, dict[str, Range]] = {"limits": self.limits or {}}
        if self.drive_limits is not None:
            one = self.drive_limits
            ranges["drive_limits"] = one if isinstance(one, dict) else {"drive": one}
        for key, group in ranges.items():
            for low, high in group.values():
                if not low < high:
                    raise ValueError(f"{key}: {low:g} to {high:g} is empty")
        return self

    def design(self, plant: Plant, **changes: Any) -> Design:
        """Return the plant's default design under this spec; a key that does not fit it is a UserError."""
        wanted = [self.output] if isinstance(self.output, str) else self.output
        design = default_design(
            plant,
            controlled=None if wanted is None else tuple(wanted),
            dt=self.sample_time_s,
            ambient=self.ambient_degC,
        )
        drives = tuple(design.drive_range)
        ranges = dict(design.drive_range)
        for name, (low, high) in _by_drive("drive_limits", self.drive_limits, drives).items():
            ends = design.drive_range[name]
            if low < ends[0] - 1e-9 or high > ends[1] + 1e-9:
                allowed = f"{ends[0]:g} to {ends[1]:g}"
                raise UserError(
                    f"drive_limits: {low:g} to {high:g} of {name} leaves its range", mend=f"stay in {allowed}"
                )
            ranges[name] = (low, high)
        slews = {**design.slew_per_s, **_by_drive("slew_per_s", self.slew_per_s, drives)}
        limits = self.limits
        if limits is None:
            free = "t_tank" in plant.outputs and "t_tank" not in design.controlled
            limits = {"t_tank": _WATER} if free else {}
        for name in limits:
            if name not in plant.outputs:
                raise UserError(
                    f"limits: the plant has no output {name}", mend=f"it has {', '.join(plant.outputs)}"
                )
        values: dict[str, Any] = {"drive_range": ranges, "slew_per_s": slews, "limits": dict(limits)}
        values["overshoot"] = 0.5 * self.overshoot_degC
        return Design.from_dict({**design.to_dict(), **_plain(values), **changes})


def read_spec(path: str | Path) -> Spec:
    """Read a spec from a TOML file.

    Raises
    ------
    UserError
        Naming the file and the key that is wrong.
    """
    return spec_from_dict(read_toml(path, mend="'init spec' writes one to edit"), file=path)


def spec_from_dict(content: Mapping[str, Any], *, file: str | Path | None = None) -> Spec:
    """Return a spec from plain values; a wrong or unknown key is a :class:`UserError` that names it."""
    try:
        return Spec.model_validate(dict(content))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(
            str(part) for part in first["loc"] if not str(part).startswith(("tuple", "dict", "list"))
        )
        text = first["msg"].removeprefix("Value error, ")
        if first["type"] == "extra_forbidden":
            text = "no such key"
        problem = f"{key}: {text[0].lower()}{text[1:]}" if key else text
        raise UserError(problem, file=file, mend="the template of 'init spec' shows every key") from error


def _by_drive(key: str, value: Any, drives: tuple[str, ...]) -> dict[str, Any]:
    if value is None:
        return {}
    if not isinstance(value, dict):
        return dict.fromkeys(drives, value)
    for name in value:
        if name not in drives:
            raise UserError(f"{key}: the plant has no drive {name}", mend=f"it has {', '.join(drives)}")
    return dict(value)


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values as JSON has them: pairs are lists."""
    out: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            out[key] = {name: list(v) if isinstance(v, tuple) else v for name, v in value.items()}
        else:
            out[key] = value
    return out
