"""Public sets that nobody here made, as logs: the part to identify from, and the part to score.

The files are not part of this project.  Each comes from a public repository and lies in one folder under the
name in :data:`SETS`:

    l2late/intProj                  luca_prbs_test_60min{,_val}.mat, halithan_prbs_test_60min{,_val}.mat
    APMonitor/arduino               apm_energy_balance.txt
    cellularmitosis/logs            rtempco0204_run3_oven.csv
    DaISy                           glassfurnace.dat, dryer.dat, dryer2.dat, CD_player_arm.dat,
                                    heating_system.dat
    srouchier/buildingenergygeeks   house_statespace.csv
    DaISy, as .mat of robotsorcerer/FARNN   powplant.mat, cstr.mat, winding.mat, steamgen.mat, flutter.mat

Rule: identify from the first half (of the two boards: from the identification log), run freely over the
other.  Roles are those that DaISy's descriptions state; steps are theirs (of the flutter log none is known).
The last five were chosen, and this written, before they were looked at.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat

from thermogrip.datasets.schema import Log, make_log

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ForeignSet:
    """A log to identify from, one to score, and the seconds of it that set the state."""

    name: str
    train: Log
    test: Log
    warmup: float
    same_run: bool  # whether both are halves of one log


@dataclass(frozen=True)
class _Kind:
    """Where a set's columns lie: inputs, disturbances, outputs, unit of the outputs, step [s]."""

    file: str  # its second log is named with _val
    u: tuple[int, ...]
    d: tuple[int, ...]
    y: tuple[int, ...]
    unit: str
    dt: float
    two: bool = False  # the second log is scored; else the second half of the first one
    mean: int = 1  # rows that are averaged to one


SETS: dict[str, _Kind] = {
    "luca": _Kind("luca_prbs_test_60min.mat", (1, 2), (), (3, 4), "degC", 1.0, two=True),
    "halithan": _Kind("halithan_prbs_test_60min.mat", (1, 2), (), (3, 4), "degC", 1.0, two=True),
    "apmonitor": _Kind("apm_energy_balance.txt", (1, 2), (), (3, 4), "degC", 1.0),
    "peltier": _Kind("rtempco0204_run3_oven.csv", (2,), (3,), (1,), "degC", 10.0, mean=10),
    "furnace": _Kind("glassfurnace.dat", (1, 2, 3), (), (4, 5, 6, 7, 8, 9), "1", 1.0),
    "cd_arm": _Kind("CD_player_arm.dat", (0, 1), (), (2, 3), "1", 1.0),
    "hairdryer": _Kind("dryer.dat", (0,), (), (1,), "1", 0.08),
    "dryer": _Kind("dryer2.dat", (1, 2, 3), (), (4, 5, 6), "1", 10.0),
    "halogen": _Kind("heating_system.dat", (1,), (), (2,), "degC", 2.0),
    "house": _Kind("house_statespace.csv", (2,), (1, 3), (4,), "degC", 1800.0),
    # a 120 MW power plant: gas flow, turbine valves, spray, dampers, air; steam pressure, two temperatures
    "powplant": _Kind("powplant.mat", (1, 2, 3, 4, 5), (), (6, 7, 8), "1", 1228.8),
    # a stirred tank reactor: coolant flow; concentration, temperature
    "cstr": _Kind("cstr.mat", (1,), (), (2, 3), "1", 6.0),
    # a winding process: speeds of three reels, set currents of two motors; two web tensions
    "winding": _Kind("winding.mat", (0, 1, 2, 3, 4), (), (5, 6), "1", 0.1),
    # a steam generator: fuel, air, reference level, load; drum pressure, oxygen, level, steam flow
    "steamgen": _Kind("steamgen.mat", (1, 2, 3), (4,), (5, 6, 7, 8), "1", 3.0),
    # a wing in a flow
    "flutter": _Kind("flutter.mat", (0,), (), (1,), "1", 1.0),
}


def load(folder: Path, name: str) -> ForeignSet:
    """Return one set."""
    kind = SETS[name]
    rows = _rows(folder / kind.file, kind.mean)
    if kind.two:
        train, test = rows, _rows(folder / kind.file.replace(".", "_val."), kind.mean)
    else:
        train, test = rows[: len(rows) // 2], rows[len(rows) // 2 :]
    warmup = min(50.0, len(test) // 6) * kind.dt
    logs = _log(train, kind, f"{name}_train"), _log(test, kind, f"{name}_test")
    return ForeignSet(name, *logs, warmup, same_run=not kind.two)


def present(folder: Path) -> list[str]:
    """Return the sets whose files lie in the folder."""
    return [name for name, kind in SETS.items() if (folder / kind.file).is_file()]


def _rows(file: Path, mean: int) -> Array:
    if file.suffix == ".mat":
        inside = loadmat(file)
        rows = np.asarray(inside.get("data", inside.get(file.stem)), dtype=float)
    elif file.suffix == ".dat":
        rows = np.loadtxt(file)
    else:
        rows = np.genfromtxt(file, delimiter=",", skip_header=1)
    whole = len(rows) // mean * mean
    return np.asarray(rows[:whole].reshape(-1, mean, rows.shape[1]).mean(axis=1))


def _log(rows: Array, kind: _Kind, name: str) -> Log:
    signals = {f"u{i}": (rows[:, i], "1", "input") for i in kind.u}
    signals |= {f"d{i}": (rows[:, i], "1", "disturbance") for i in kind.d}
    signals |= {f"y{i}": (rows[:, i], kind.unit, "output") for i in kind.y}
    log = make_log(np.arange(len(rows)) * kind.dt, signals)
    log.attrs["name"] = name
    return log
