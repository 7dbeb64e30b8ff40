"""Which data a plant was fitted to, and whether a log is among them.

A free run over a log of the fit says how well the plant is fitted, not how well it predicts.  A log's name
may change, so a plant keeps the hash of each log's data (:func:`thermogrip.datasets.schema.data_hash`)
beside the seconds of it that were used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Log

__all__ = ["FitLog", "fit_logs", "said_of_fit"]


@dataclass(frozen=True)
class FitLog:
    """A log of a fit.

    Parameters
    ----------
    name : str
    sha256 : str
        Of the data of the whole log that it was cut from.
    start_s, stop_s : float
        The first and the last row that were used [s].
    """

    name: str
    sha256: str
    start_s: float
    stop_s: float


def fit_logs(logs: Sequence[Log]) -> tuple[FitLog, ...]:
    """Return what a plant keeps of the logs of its fit."""
    from thermogrip.datasets.schema import data_hash, log_name

    return tuple(FitLog(log_name(log), data_hash(log), *_ends(log)) for log in logs)


def said_of_fit(fitted_to: Sequence[FitLog], log: Log) -> list[str]:
    """Return a line for each log of the fit that holds rows of this one.

    Examples
    --------
    >>> from thermogrip.datasets.schema import make_log
    >>> log = make_log([0.0, 1.0, 2.0], {"q": ([0, 1, 0], "1", "input")})
    >>> said_of_fit(fit_logs([log]), log)[0]
    'all of it is in the fit: the scores say how well the plant is fitted, not how well it predicts'
    """
    from thermogrip.datasets.schema import data_hash, log_name

    start, stop = _ends(log)
    sha256, said = data_hash(log), []
    for used in fitted_to:
        first, last = max(start, used.start_s), min(stop, used.stop_s)
        if used.sha256 != sha256 or not first < last:
            continue
        whole = (first, last) == (start, stop)
        what = "all of it is" if whole else f"{first:g} to {last:g} s of {start:g} to {stop:g} s are"
        name = "" if used.name == log_name(log) else f" (as {used.name})"
        judged = "the scores say how well the plant is fitted, not how well it predicts"
        said.append(f"{what} in the fit{name}: {'' if whole else 'there '}{judged}")
    return said


def _ends(log: Log) -> tuple[float, float]:
    time = log["time"].values
    return float(time[0]), float(time[-1])
