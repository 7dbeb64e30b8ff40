"""What a plant keeps of its fit: numbers for tables, bands and later fits, and which data it was fitted to.

A free run over a log of the fit says how well the plant is fitted, not how well it predicts.  A log's name
may change, so a plant keeps the hash of each log's data (:func:`thermogrip.datasets.schema.hash_columns`)
beside the seconds of it that were used.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import AliasChoices, Field, TypeAdapter, ValidationError

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Log


#: Of the inputs' effect, from run to run, of a plant of too few logs to show it: gains of four boards and
#: motors were off by 0, 3 and 4 to 8 % on another day.
RUN_GAIN_SD = 0.05
SEVERAL = 3  # logs of a fit from which on its held-out errors show what differs between runs
HELD_OUT_SHARE = 0.3  # of each log, where whole logs are not left out
TAIL = f"last {100 * HELD_OUT_SHARE:.0f} % of "  # how what is held out of a log is called


@dataclass(frozen=True)
class HeldOut:
    """The free run of one output over one log that the fit had not seen; n scored samples."""

    log: str
    output: str
    rmse: float
    fit_percent: float
    unit: str
    n: int


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
    """Numbers of a fit; what a kind of fit does not know keeps its default.

    >>> PlantScores(average_s=2.0, structure="na 1").to_json()
    {'structure': 'na 1', 'average_s': 2.0}
    """

    identifiability: Identifiability | None = None
    structure: str = ""  # of a black box: its orders
    average_s: float | None = None  # averaging step or bin of the fit [s]
    average_why: str = ""  # which rule set it
    reading_excess: dict[str, float] = field(default_factory=dict)  # one reading off its bin's mean, by noise
    reading_sd: dict[str, float] = field(default_factory=dict)  # of a black box: white noise of one reading
    # of a black box, by output: errors over the parts held out in turn
    held_out_by_part: dict[str, list[float]] = field(default_factory=dict)
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

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> PlantScores:
        """Return what :meth:`to_json` wrote; keys that it does not know are left out."""
        try:
            return TypeAdapter(cls).validate_python(dict(content))
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(key) for key in ("scores", *first["loc"]))
            raise ValueError(f"{where}: {first['msg']}") from error


@dataclass(frozen=True)
class FitLog:
    """A log of a fit."""

    name: str
    sha256: str  # of the data of the whole log that it was cut from
    start_s: float  # the first row that was used [s]
    stop_s: float  # the last


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
