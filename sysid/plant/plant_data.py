"""The numbers of a plant: a model, its parameters with their uncertainty, where both may be trusted, its fit.

**Scales.**  A positive parameter is uncertain by a factor, so its ``theta`` is its logarithm; any other has
``theta`` equal to itself.  Covariance and Laplace draws live in theta; values, samples and intervals are in
natural units.

**Its fit.**  A free run over a log of the fit says how well the plant is fitted, not how well it predicts.  A
log's name may change, so a plant keeps the hash of each log's data
(:func:`thermogrip.datasets.schema.hash_columns`) beside the seconds of it that were used.

**Files.**  One dictionary serves the plant's own file and others that contain a plant; :class:`PlantData`
says what each key may hold.  Samples stand beside the file as ``.nc``, or under ``draws`` where they are few
or there is no file.  Reading never runs code.  This module loads no xarray, so that a file can be refused at
once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from statistics import NormalDist
from typing import TYPE_CHECKING, Annotated, Any, Self, get_type_hints

import numpy as np
from pydantic import (
    AfterValidator,
    AliasChoices,
    BaseModel,
    Field,
    PlainValidator,
    ValidationError,
    create_model,
)

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.errors import UserError, reading
from thermogrip.datasets.files import atomic_path, read_json
from thermogrip.datasets.limits import LARGEST, MOST_NUMBER, STEP_RANGE, array_within
from thermogrip.datasets.roles import is_room_temperature
from thermogrip.sysid.models.model import Model
from thermogrip.sysid.models.network_spec import OpenHigh, OpenLow, fault_words
from thermogrip.sysid.models.state_space import symmetric_root

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Log


#: Of the inputs' effect, from run to run, of a plant of too few logs to show it: gains of four boards and
#: motors were off by 0, 3 and 4 to 8 % on another day.
RUN_GAIN_SD = 0.05
SEVERAL = 3  # logs of a fit from which on its held-out errors show what differs between runs
HELD_OUT_SHARE = 0.3  # of each log, where whole logs are not left out
TAIL = f"last {100 * HELD_OUT_SHARE:.0f} % of "  # how what is held out of a log is called


_MOST_ERROR, _MOST_READING = 1e6, 1e9  # of a sensor, in any unit


def _ordered(ends: tuple[float, float]) -> tuple[float, float]:
    low, high = ends
    if not (low <= high and all(abs(end) <= _MOST_READING or np.isinf(end) for end in ends)):
        raise ValueError(f"is {low:g} to {high:g}")
    return ends


def _covariance(rows: Any) -> Array | None:
    if rows is None:
        return None
    covariance = array_within({"it": rows}, "it", MOST_NUMBER)
    if covariance.ndim != 2 or (np.diag(covariance) < 0).any():
        raise ValueError("has a negative variance")
    return covariance


_Finite = Annotated[float, Field(strict=True, ge=-LARGEST, le=LARGEST)]
_Step = Annotated[float, Field(strict=True, ge=STEP_RANGE[0], le=STEP_RANGE[1])]
_Sd = Annotated[float, Field(strict=True, ge=0.0, le=_MOST_ERROR)]
_Offset = Annotated[float, Field(strict=True, ge=-_MOST_ERROR, le=_MOST_ERROR)]
_Ends = tuple[OpenLow, OpenHigh]


@dataclass(frozen=True)
class HeldOut:
    """The free run of one output over one log that the fit had not seen."""

    log: str  # what was simulated
    output: str
    rmse: float
    fit_percent: float
    unit: str  # of the output
    n: int  # scored samples


@dataclass(frozen=True)
class ExpectedError:
    """The rms error of a free run over another run like those of the fit, in the output's unit."""

    rmse: float  # as likely more as less
    low: float  # less in one run of twenty
    high: float  # more in one run of twenty
    same_gain: float | None = None  # ``rmse`` without the gain that is assumed to vary; None where none is

    def words(self, unit: str) -> str:
        """Return it as it is printed everywhere."""
        shown = "" if unit == "1" else f" {unit}"
        return f"{self.rmse:.2g}{shown} ({self.low:.2g} to {self.high:.2g})"


@dataclass(frozen=True)
class Identifiability:
    """What the logs say of the free parameters (:mod:`thermogrip.sysid.greybox.identifiability`)."""

    condition: float  # of the scaled Hessian
    flat: list[str]  # all directions that the logs barely determine, in words, the weakest first
    # False: a direction changes no output at all (``told`` in files of 0.2.0 and before)
    identifiable: Annotated[bool, Field(validation_alias=AliasChoices("identifiable", "told"))]
    prior_only: list[str]  # names
    on_bound: dict[str, str]  # name -> "low" or "high"


@dataclass(frozen=True)
class ErrorNumbers:
    """Numbers of the errors of a fit (:class:`thermogrip.sysid.greybox.noise_model.ErrorModel`)."""

    white: tuple[float, ...]  # w by output, of one bin
    tau: tuple[float, ...]  # correlation times [bins]
    sd: tuple[tuple[float, ...], ...]  # a by slow error and output
    correlation: tuple[float, ...]  # between outputs, by slow error
    spread: tuple[float, ...] = ()  # s by kind of column, in units of what was stated beforehand


@dataclass(frozen=True)
class Intervals:
    """What the intervals of a grey-box fit rest on."""

    numbers: ErrorNumbers | None = None
    between_logs: float = 1.0
    coarsening: float = 1.0  # times less information in a log than the fit's weights assume


@dataclass(frozen=True)
class Sampling:
    """How a posterior was sampled; autocorrelation times ``tau`` by parameter."""

    verdict: str
    converged: bool
    likelihood: str
    tau: dict[str, float]


@dataclass(frozen=True)
class InnovationNoise:
    """What the innovations of a filter over the logs say (:mod:`thermogrip.sysid.plant.innovations`), as
    standard deviations, and how fast the inputs were moved."""

    state: float  # of the states in a second, in units of the outputs' as each state is spread
    reading: dict[str, float]  # of a reading, by output, in its unit
    input: dict[str, float]  # of what an input lacks, in a second, in its unit
    fastest: dict[str, float]  # change of an input from a row to the next, in a second


@dataclass(frozen=True)
class PlantScores:
    """Numbers of a fit for tables, bands and later fits; what a fit does not know keeps its default."""

    identifiability: Identifiability | None = None
    structure: str = ""  # of a black box: its orders
    average_s: float | None = None  # averaging step or bin of the fit [s]
    average_why: str = ""  # which rule set it
    reading_excess: dict[str, float] = field(default_factory=dict)  # one reading off its bin's mean, by noise
    reading_sd: dict[str, float] = field(default_factory=dict)  # of a black box: white noise of one reading
    # of a black box, by output: errors over the parts held out in turn
    held_out_by_part: dict[str, list[float]] = field(default_factory=dict)
    # of a black box, sd of the gain over the gain of inputs that move in no part held out; 0: nor in the logs
    untested: dict[str, float] = field(default_factory=dict)
    # between independent residuals, as the fit weighted them
    weight_s: dict[str, float] = field(default_factory=dict)
    intervals: Intervals | None = None
    innovations: InnovationNoise | None = None
    posterior: Sampling | None = None
    held_out: list[HeldOut] = field(default_factory=list)  # free runs over what the fit had not seen
    expected: dict[str, ExpectedError] = field(default_factory=dict)  # by output, of another run

    def to_json(self) -> dict[str, Any]:
        """Return the content of key ``scores`` of ``plant.json``; a default is left out."""
        default = asdict(PlantScores())
        return {key: value for key, value in asdict(self).items() if value != default[key]}


@dataclass(frozen=True)
class FitLog:
    """A log of a fit."""

    name: str
    sha256: str  # of the data of the whole log that it was cut from
    start_s: _Finite  # the first row that was used [s]
    stop_s: _Finite  # the last


@dataclass(frozen=True, eq=False)
class PlantData:
    """The fields of a plant, see :class:`thermogrip.sysid.plant.plant.Plant`, and what follows from them."""

    model: Model
    values: dict[str, _Finite]
    dt: _Step
    units: dict[str, str] = field(default_factory=dict)
    free: tuple[str, ...] = ()
    scales: dict[str, str] = field(default_factory=dict)
    bounds: dict[str, _Ends] = field(default_factory=dict)
    covariance: Annotated[Array | None, PlainValidator(_covariance)] = None
    samples: Array | None = None
    refits: tuple[Model, ...] = ()
    noise: dict[str, _Sd] = field(default_factory=dict)
    offsets: dict[str, _Offset] = field(default_factory=dict)
    nuisance: dict[str, _Sd] = field(default_factory=dict)
    reference: str | None = None
    valid: dict[str, Annotated[_Ends, AfterValidator(_ordered)]] = field(default_factory=dict)
    nominal: dict[str, _Finite] = field(default_factory=dict)
    logs: tuple[str, ...] = ()
    scores: PlantScores = field(default_factory=PlantScores)
    verdict: str = ""
    fitted_to: tuple[FitLog, ...] = ()
    inputs_end_at_row: bool = False
    offset_memory: Annotated[float, Field(strict=True, ge=1e-6, le=LARGEST)] = np.inf

    def __post_init__(self) -> None:
        missing = [name for name in self.model.parameters if name not in self.values]
        if missing:
            raise ValueError(f"no value for {', '.join(missing)}")
        unknown = [name for name in (*self.values, *self.free) if name not in self.model.parameters]
        if unknown:
            raise ValueError(f"the model has no parameter {', '.join(unknown)}")
        if self.reference is not None and self.reference not in self.outputs:
            raise ValueError(f"the reference {self.reference!r} is no output of the model")
        n = len(self.free)
        if self.covariance is not None and np.shape(self.covariance) != (n, n):
            raise ValueError(f"covariance is {np.shape(self.covariance)}, not {(n, n)}")
        if self.samples is not None and np.shape(self.samples)[1:] != (n,):
            raise ValueError(f"samples are {np.shape(self.samples)}, not (n, {n})")

    @property
    def uncertain(self) -> bool:
        """Whether there is anything to draw from."""
        return bool(self.refits) or self.samples is not None or self.covariance is not None

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return self.model.inputs

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return self.model.outputs

    @property
    def disturbances(self) -> tuple[str, ...]:
        """Names of the measured disturbances."""
        return self.model.disturbances

    def is_room(self, name: str) -> bool:
        """Tell whether a measured disturbance is the temperature of the room."""
        return is_room_temperature(name, self.units.get(name, "degC"))

    @property
    def room(self) -> float | None:
        """The middle of what the logs showed of the room's temperature [degC]; None where they did not."""
        rooms = (self.valid[name] for name in self.disturbances if self.is_room(name) and name in self.valid)
        return next((float(np.mean(ends)) for ends in rooms), None)

    def undisturbed(self, ambient: float) -> Array:
        """Return the measured disturbances (n_d,) where nobody reads them: ``nominal``, else ``ambient``
        [degC] for the room's temperature and the middle of the logs for another; NaN where none is known."""
        levels = []
        for name in self.disturbances:
            temperature = self.units.get(name, "degC") == "degC"
            otherwise = float(np.mean(self.valid.get(name, (ambient if temperature else np.nan,) * 2)))
            levels.append(self.nominal.get(name, ambient if self.is_room(name) else otherwise))
        return np.array(levels, dtype=np.float64)

    def with_medians(self, seen: Mapping[str, Array]) -> Self:
        """Return the plant with the medians of measured disturbances (n,) by name for nominal values, but for
        the room's temperature."""
        medians = {name: float(np.nanmedian(values)) for name, values in seen.items()}
        return replace(self, nominal={name: v for name, v in medians.items() if not self.is_room(name)})

    @property
    def p(self) -> Array:
        """The parameter vector (n_p,) in the order of ``model.parameters``."""
        return np.array([self.values[name] for name in self.model.parameters], dtype=float)

    def draw(self, k: int) -> Self:
        """Return the plant with the parameters of the k-th draw: 0 is the plant itself, others are spread
        over the samples or refits, else from N(theta, covariance) with seed k."""
        if k < 0:
            raise UserError(f"draw {k} is negative", hint="count draws from 0")
        if k == 0:
            return self
        # a golden-ratio sequence visits a chain evenly, however few draws are taken
        along = (k * 0.6180339887498949) % 1.0
        if self.refits:
            return replace(self, model=self.refits[int(along * len(self.refits))])
        if self.samples is not None:
            drawn = np.asarray(self.samples[int(along * len(self.samples))], dtype=float)
        elif self.covariance is not None:
            # not Cholesky's: a weakly determined direction may have lost its last digits
            root = symmetric_root(np.asarray(self.covariance))
            drawn = self._inside(self.theta + root @ np.random.default_rng(k).standard_normal(len(root)))
        else:
            raise UserError("the plant has no uncertainty to draw from", hint="fit a network, or use draw 0")
        return replace(self, values=self.values | dict(zip(self.free, drawn.tolist())))

    def intervals(self, level: float = 0.9) -> dict[str, tuple[float, float]]:
        """Return the central interval of probability ``level`` of each free parameter, in natural units:
        theta +- z sd, clipped to the bounds; quantiles of the samples where there is no covariance."""
        if not 0 < level < 1:
            raise ValueError(f"level must lie between 0 and 1, got {level:g}")
        if self.covariance is not None:
            half = NormalDist().inv_cdf(0.5 + level / 2) * np.sqrt(np.diag(self.covariance))
            low, high = self._inside(self.theta - half), self._inside(self.theta + half)
        elif self.samples is not None:
            tails = [0.5 - level / 2, 0.5 + level / 2]
            low, high = np.quantile(self.samples, tails, axis=0)
        else:
            return {}
        return {name: (float(a), float(b)) for name, a, b in zip(self.free, low, high)}

    @property
    def theta(self) -> Array:
        """The free parameters (n_free,) as ``covariance`` has them: logarithms of the ``"log"`` ones."""
        return self.on_scale(np.array([self.values[name] for name in self.free], dtype=float))

    def on_scale(self, natural: Array) -> Array:
        """Return free parameters (..., n_free) on the scale of ``theta``."""
        logs = self.log_scaled
        return np.where(logs, np.log(np.where(logs, np.maximum(natural, 1e-300), 1.0)), natural)

    def natural(self, theta: Array) -> Array:
        """Return the free parameters (..., n_free) in their units, wherever ``theta`` is."""
        return np.where(self.log_scaled, np.exp(np.where(self.log_scaled, theta, 0.0)), theta)

    def _inside(self, theta: Array) -> Array:
        pairs = [self.bounds.get(name, (-np.inf, np.inf)) for name in self.free]
        low, high = np.array(pairs, dtype=float).reshape(-1, 2).T
        return np.asarray(np.clip(self.natural(theta), low, high))

    @property
    def log_scaled(self) -> Mask:
        """Which free parameters (n_free,) are logarithms in ``theta``."""
        return np.array([self.scales.get(name) == "log" for name in self.free], dtype=bool)


SCHEMA, VERSION = "thermogrip.plant", 1
_PLAIN = (
    *("dt", "values", "units", "free", "scales", "noise", "offsets", "nuisance", "reference", "nominal"),
    *("logs", "verdict", "inputs_end_at_row"),
)
# what a file may lack: others have no default, or damage would go unseen
_ABSENT = {"nominal": {}, "fitted_to": (), "inputs_end_at_row": False, "offset_memory": np.inf}


def check_plant_file(
    path: str | Path, *, inside: str | None = None, version: int = VERSION
) -> dict[str, Any]:
    """Return what a plant file holds, or one of another schema with a plant ``inside``, once its limits and
    fields are checked; this loads nothing that its model needs."""
    content = read_json(path, inside or SCHEMA, version)
    with reading("is not whole", file=path, hint="write the file again"):
        if inside and not isinstance(content.get("plant"), dict):
            raise UserError("plant is missing", hint="write the file again")
        fields_of(content["plant"] if inside else content)
    return content


def plain_content(plant: PlantData) -> dict[str, Any]:
    """Return everything of the plant but its samples as plain JSON."""
    content: dict[str, Any] = {"model": plant.model.to_dict()}
    content |= {name: getattr(plant, name) for name in _PLAIN}
    content["scores"] = plant.scores.to_json()
    content["fitted_to"] = [asdict(log) for log in plant.fitted_to]
    for kind in ("bounds", "valid"):  # an open end is null, for JSON has no infinity
        ranges: dict[str, tuple[float, float]] = getattr(plant, kind)
        content[kind] = {n: [end if np.isfinite(end) else None for end in ends] for n, ends in ranges.items()}
    content["covariance"] = None if plant.covariance is None else np.asarray(plant.covariance).tolist()
    content["samples"] = None
    if np.isfinite(plant.offset_memory):
        content["offset_memory"] = plant.offset_memory
    content["refits"] = [model.to_dict() for model in plant.refits]
    return content


@cache
def _plant_file() -> type[BaseModel]:
    """Return what a plant's file may say, but for model, refits and samples: the kinds of the fields."""
    kinds = get_type_hints(PlantData, include_extras=True)
    fields: dict[str, Any] = {
        name: (kind, _ABSENT.get(name, ...))
        for name, kind in kinds.items()
        if name not in ("model", "refits", "samples")
    }
    return create_model("PlantFile", **fields)


def fields_of(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a plant from :func:`plain_content`, but for model and samples."""
    with whole_plant():
        try:
            return dict(_plant_file().model_validate(dict(content)))
        except ValidationError as error:
            raise ValueError(fault_words(error)) from error


def whole_plant() -> AbstractContextManager[None]:
    """Raise what a reader stumbles over in content that is not a whole plant."""
    return reading("is not a whole plant", hint="save the plant again")


def thin(samples: Array, draws: int | None) -> Array:
    """Return so many rows of the samples, evenly spread; all where ``draws`` is None."""
    n = len(samples)
    rows = np.unique(np.linspace(0, n - 1, n if draws is None else min(n, draws)).astype(int))
    return np.asarray(np.asarray(samples)[rows], dtype=float)


def write_samples(path: Path, free: Sequence[str], samples: Array, units: Mapping[str, str]) -> None:
    """Write posterior samples (n, n_free) with their names and units."""
    import xarray as xr

    record = xr.Dataset(
        {"samples": (("draw", "parameter"), np.asarray(samples, dtype=float))},
        coords={"parameter": list(free), "units": ("parameter", [units.get(name, "1") for name in free])},
        attrs={"schema": "thermogrip.samples", "version": 1},
    )
    with atomic_path(path) as temporary:
        record.to_netcdf(temporary, engine="h5netcdf")


def read_samples(plant: Path, name: str | None, free: Sequence[str]) -> Array | None:
    """Return the samples that stand beside a plant's file, None where it has none."""
    if name is None:
        return None
    from thermogrip.datasets.netcdf import open_netcdf

    path = plant.parent / Path(str(name)).name  # beside the plant, wherever both were moved to
    if not path.is_file():
        raise UserError(f"its samples {path.name} are missing", hint="keep the .nc file beside the plant")
    record = open_netcdf(path)
    with reading("are no samples of the plant", file=path, hint="draw the posterior again"):
        samples = np.asarray(record["samples"].sel(parameter=list(free)).values, dtype=float)
        if samples.ndim != 2 or not np.isfinite(samples).all():
            raise ValueError("a sample is not finite")
    return samples


def fit_logs(logs: Sequence[Log]) -> tuple[FitLog, ...]:
    """Return what a plant keeps of the logs of its fit; the hash is that of a log's file where it has one."""
    from thermogrip.datasets.schema import hash_columns, log_name

    fitted = []
    for log in logs:
        time = log["time"].values
        sha256 = log.attrs.get("sha256") or hash_columns(
            {"time": time} | {str(name): log[name].values for name in log}
        )
        fitted.append(FitLog(log_name(log), str(sha256), float(time[0]), float(time[-1])))
    return tuple(fitted)


def said_of_fit(fitted_to: Sequence[FitLog], seen: FitLog) -> list[str]:
    """Return a line for each log of the fit that holds rows of the one that is ``seen``."""
    start = seen.start_s
    stop = seen.stop_s
    lines = []
    for used in fitted_to:
        first, last = max(start, used.start_s), min(stop, used.stop_s)
        if used.sha256 != seen.sha256 or not first < last:
            continue
        whole = (first, last) == (start, stop)
        overlap = "all of it is" if whole else f"{first:g} to {last:g} s of {start:g} to {stop:g} s are"
        name = "" if used.name == seen.name else f" (as {used.name})"
        meaning = "the scores say how well the plant is fitted, not how well it predicts"
        lines.append(f"{overlap} in the fit{name}: {'' if whole else 'there '}{meaning}")
    return lines
