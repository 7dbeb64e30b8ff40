"""The numbers of a plant: a model, its parameters with their uncertainty, and where both may be trusted.

**Scales.**  A positive parameter is uncertain by a factor, so its ``theta`` is its logarithm; any other has
``theta`` equal to itself.  Covariance and Laplace draws live in theta; values, samples and intervals are in
natural units.

``nuisance`` is the sd of each sensor's offset from log to log.

**Files.**  One dictionary serves the plant's own file and others that contain a plant.  Samples stand beside
the file as ``.nc``, or under ``draws`` where they are few or there is no file.  Reading never runs code.
This module loads no xarray, so that a file can be refused at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from statistics import NormalDist
from typing import Any, Self

import numpy as np

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.errors import UserError, reading
from thermogrip.datasets.files import atomic_path, read_json
from thermogrip.datasets.limits import LARGEST, MOST_NUMBER, STEP_RANGE, array_within, number_within
from thermogrip.datasets.roles import is_room_temperature
from thermogrip.sysid.models.model import Model
from thermogrip.sysid.models.state_space import symmetric_root
from thermogrip.sysid.plant.fit_record import FitLog, PlantScores


@dataclass(frozen=True, eq=False)
class PlantData:
    """The fields of a plant, see :class:`thermogrip.sysid.plant.plant.Plant`, and what follows from them."""

    model: Model
    values: dict[str, float]
    dt: float
    units: dict[str, str] = field(default_factory=dict)
    free: tuple[str, ...] = ()
    scales: dict[str, str] = field(default_factory=dict)
    bounds: dict[str, tuple[float, float]] = field(default_factory=dict)
    covariance: Array | None = None
    samples: Array | None = None
    refits: tuple[Model, ...] = ()
    noise: dict[str, float] = field(default_factory=dict)
    offsets: dict[str, float] = field(default_factory=dict)
    nuisance: dict[str, float] = field(default_factory=dict)
    reference: str | None = None
    valid: dict[str, tuple[float, float]] = field(default_factory=dict)
    nominal: dict[str, float] = field(default_factory=dict)
    logs: tuple[str, ...] = ()
    scores: PlantScores = field(default_factory=PlantScores)
    verdict: str = ""
    fitted_to: tuple[FitLog, ...] = ()
    inputs_end_at_row: bool = False
    offset_memory: float = np.inf

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
_MOST_ERROR, _MOST_READING = 1e6, 1e9  # of a sensor, in any unit
_PLAIN = ("values", "units", "scales", "noise", "offsets", "nuisance", "reference", "verdict", "nominal")


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
    content: dict[str, Any] = {"model": plant.model.to_dict(), "dt": plant.dt}
    content |= {name: getattr(plant, name) for name in _PLAIN}
    content |= {"free": list(plant.free), "logs": list(plant.logs)}
    content["scores"] = plant.scores.to_json()
    content["fitted_to"] = [asdict(log) for log in plant.fitted_to]
    for kind in ("bounds", "valid"):  # an open end is null, for JSON has no infinity
        ranges: dict[str, tuple[float, float]] = getattr(plant, kind)
        content[kind] = {n: [end if np.isfinite(end) else None for end in ends] for n, ends in ranges.items()}
    content["covariance"] = None if plant.covariance is None else np.asarray(plant.covariance).tolist()
    content["samples"] = None
    content["inputs_end_at_row"] = plant.inputs_end_at_row
    if np.isfinite(plant.offset_memory):
        content["offset_memory"] = plant.offset_memory
    content["refits"] = [model.to_dict() for model in plant.refits]
    return content


def fields_of(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a plant from :func:`plain_content`, but for model and samples."""
    with whole_plant():
        return {
            "values": _finite_numbers(content, "values"),
            "dt": number_within(content, "dt", *STEP_RANGE),
            "units": _texts(content["units"]),
            "free": tuple(str(name) for name in content["free"]),
            "scales": _texts(content["scales"]),
            "bounds": _ranges_of_json(content["bounds"]),
            "covariance": _covariance(content),
            "noise": _finite_numbers(content, "noise", 0.0, _MOST_ERROR),
            "offsets": _finite_numbers(content, "offsets", -_MOST_ERROR, _MOST_ERROR),
            "nuisance": _finite_numbers(content, "nuisance", 0.0, _MOST_ERROR),
            "reference": content["reference"],
            "valid": _valid(content["valid"]),
            "nominal": _finite_numbers({"nominal": {}} | dict(content), "nominal"),
            "logs": tuple(str(name) for name in content["logs"]),
            "fitted_to": tuple(_fit_log(log) for log in content.get("fitted_to", ())),
            "scores": PlantScores.from_json(content["scores"]),
            "verdict": str(content["verdict"]),
            "inputs_end_at_row": bool(content.get("inputs_end_at_row", False)),
            "offset_memory": number_within(content, "offset_memory", 1e-6, LARGEST)
            if "offset_memory" in content
            else np.inf,
        }


def whole_plant() -> AbstractContextManager[None]:
    """Raise what a reader stumbles over in content that is not a whole plant."""
    return reading("is not a whole plant", hint="save the plant again")


def thin(samples: Array, draws: int | None) -> Array:
    """Return so many rows of the samples, evenly spread; all where ``draws`` is None."""
    n = len(samples)
    rows = np.unique(np.linspace(0, n - 1, n if draws is None else min(n, draws)).astype(int))
    return np.asarray(np.asarray(samples)[rows], dtype=float)


def draws_of(rows: Any) -> Array:
    """Return samples that stand in the JSON itself."""
    with whole_plant():
        return np.asarray(rows, dtype=float)


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


def _fit_log(content: Mapping[str, Any]) -> FitLog:
    start_s, stop_s = (number_within(content, name, -LARGEST, LARGEST) for name in ("start_s", "stop_s"))
    return FitLog(str(content["name"]), str(content["sha256"]), start_s, stop_s)


def _texts(content: Mapping[str, Any]) -> dict[str, str]:
    return {str(name): str(value) for name, value in content.items()}


def _finite_numbers(
    content: Mapping[str, Any], key: str, low: float = -LARGEST, high: float = LARGEST
) -> dict[str, float]:
    return {str(name): number_within(content[key], name, low, high) for name in content[key]}


def _covariance(content: Mapping[str, Any]) -> Array | None:
    if content["covariance"] is None:
        return None
    covariance = array_within(content, "covariance", MOST_NUMBER)
    if covariance.ndim != 2 or (np.diag(covariance) < 0).any():
        raise ValueError("covariance has a negative variance")
    return covariance


def _valid(content: Mapping[str, Sequence[float | None]]) -> dict[str, tuple[float, float]]:
    ranges = _ranges_of_json(content)
    for name, (low, high) in ranges.items():
        if not (low <= high and all(abs(end) <= _MOST_READING or np.isinf(end) for end in (low, high))):
            raise ValueError(f"valid of {name} is {low:g} to {high:g}")
    return ranges


def _ranges_of_json(content: Mapping[str, Sequence[float | None]]) -> dict[str, tuple[float, float]]:
    return {
        str(name): (-np.inf if low is None else float(low), np.inf if high is None else float(high))
        for name, (low, high) in content.items()
    }
