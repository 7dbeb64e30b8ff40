"""The rules of the comparison: which rows fit, which rows score, and how a peer's structure is chosen.

* A model sees the training rows, then the inputs of the test rows and the outputs of their first 50 rows.
* It simulates the rest; nothing measured is fed back.  RMSE over those rows, in the output's unit.
* A structure (orders, delays, terms) is chosen inside the training rows: fitted to their first 70 percent,
  simulated over their last 30 percent, then fitted to all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.log_files import read_log
from thermogrip.datasets.resample import average
from thermogrip.datasets.schema import Log, column

HEAD = 50  # rows whose outputs may set the start

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Record:
    """Rows of inputs u (n, n_u) and outputs y (n, n_y), ``dt`` seconds apart."""

    u: Array
    y: Array
    dt: float


@dataclass(frozen=True, eq=False)
class Problem:
    """A data set, cut into what fits and what scores."""

    name: str
    unit: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    train: Record
    test: Record
    logs: tuple[Log, Log]

    @property
    def dt(self) -> float:
        """Sample time [s]."""
        return self.train.dt


#: Takes the inputs of a record and the outputs of its first rows; returns outputs of the same length as u.
Simulator = Callable[[Array, Array], Array]


@dataclass(frozen=True)
class Peer:
    """A tool: its structures, and how one is fitted."""

    name: str
    structures: tuple[object, ...]
    fit: Callable[[Record, object], Simulator]
    most_outputs: int = 9


def problems(folder: Path, wanted: Sequence[str] = ()) -> Iterator[Problem]:
    """Yield the data sets of ``folder`` (see docs/measured.md for where they come from)."""
    table = {
        "cascaded_tanks": (("pump",), ("level",), "V", "cascaded_tanks_train.csv", "cascaded_tanks_test.csv"),
        "peltier_chamber": (("pwm", "ambient"), ("chamber",), "degC", "peltier_chamber.csv", ""),
        "heat_exchanger": (("flow",), ("outlet",), "degC", "heat_exchanger.csv", ""),
        "tclab_prbs": (("q1", "q2"), ("t1", "t2"), "degC", "tclab_prbs.csv", ""),
    }
    for name, (inputs, outputs, unit, first, second) in table.items():
        if wanted and name not in wanted:
            continue
        roles = {"inputs": inputs, "outputs": outputs, "disturbances": ()}
        if second:
            train, test = (read_log(folder / file, **roles) for file in (first, second))
        else:
            whole = read_log(folder / first, **roles)
            if name == "peltier_chamber":
                whole = average(whole, 2.0)
            half = whole.sizes["time"] // 2
            train, test = whole.isel(time=slice(0, half)), whole.isel(time=slice(half, None))
        yield Problem(
            name,
            unit,
            inputs,
            outputs,
            record(train, inputs, outputs),
            record(test, inputs, outputs),
            (train, test),
        )


def chosen(peer: Peer, problem: Problem) -> tuple[object, Simulator]:
    """Return the peer's structure of the least free-run error on held-out training rows, and its model."""
    structures = peer.structures
    if len(structures) > 1:
        cut = int(0.7 * len(problem.train.u))
        first = Record(problem.train.u[:cut], problem.train.y[:cut], problem.dt)
        last = Record(problem.train.u[cut:], problem.train.y[cut:], problem.dt)
        errors = [_error(peer, first, structure, last) for structure in structures]
        structures = (structures[int(np.argmin(errors))],)
    return structures[0], peer.fit(problem.train, structures[0])


def rmse(simulator: Simulator, record: Record) -> Array:
    """Return the free-run RMSE of each output after the first rows."""
    simulated = simulator(record.u, record.y[:HEAD])
    return np.asarray(np.sqrt(np.mean((simulated - record.y)[HEAD:] ** 2, axis=0)))


def _error(peer: Peer, first: Record, structure: object, last: Record) -> float:
    try:
        with np.errstate(all="ignore"):
            found = rmse(peer.fit(first, structure), last)
    except (ArithmeticError, ValueError, np.linalg.LinAlgError):
        return np.inf
    return float(np.mean(found / np.std(last.y, axis=0))) if np.isfinite(found).all() else np.inf


def record(log: Log, inputs: Sequence[str], outputs: Sequence[str]) -> Record:
    """Return inputs and outputs of a log as rows."""
    time = log["time"].values

    def stack(names: Sequence[str]) -> Array:
        """Return the columns; the one reading that the reader rejects is bridged, for no peer takes NaN."""
        columns = [np.asarray(column(log, name), dtype=float) for name in names]
        return np.stack([np.interp(time, time[np.isfinite(c)], c[np.isfinite(c)]) for c in columns], axis=1)

    return Record(stack(inputs), stack(outputs), float(np.median(np.diff(time))))
