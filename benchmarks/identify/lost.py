"""What lost readings cost ARX and subspace fits, beside lines through the holes.

    python benchmarks/identify/lost.py [FOLDER] [--seeds 3]

Readings are struck out of training data only, at random or in bursts of 12 rows in the mean, each channel
its own; the fit chooses its structure as ever, on what is left.  Simulated plants are scored against their
outputs without noise on a fresh record, started from it; logs of ``FOLDER`` (docs/measured.md says where
they come from) against the second half as it was read, whose first 50 rows start the run.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rules import problems
from scipy.signal import lfilter

from thermogrip.datasets.schema import Log, make_log, names
from thermogrip.sysid.blackbox.fit import fit_black_box

CASES = ((0.0, "random"), (0.1, "random"), (0.3, "random"), (0.5, "random"), (0.3, "bursts"), (0.5, "bursts"))
HEAD, BURST = 50, 12

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Case:
    """A training log, a test log, and what is to be predicted there (n, n_y)."""

    name: str
    train: Log
    test: Log
    true: Array
    average: float | None = 1.0


def lag(seed: int, n: int = 900) -> tuple[Array, Array, Array]:
    """A heater read through a sensor that lags, white noise: inputs, readings, readings without noise."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.random((n // 20, 1)), 20, axis=0)
    y = 25 + lfilter([0, 0.25], [1, -0.75], lfilter([0, 0.5], [1, -0.95], u[:, 0]))[:, None]
    return u, y + 0.1 * rng.standard_normal(y.shape), y


def coupled(seed: int, n: int = 900) -> tuple[Array, Array, Array]:
    """Two heaters that warm each other, noise that warms them too."""
    rng = np.random.default_rng(seed)
    A, B = np.array([[0.93, 0.04], [0.05, 0.90]]), np.array([[0.6, 0.0], [0.1, 0.4]])
    K, e = np.array([[0.3, 0.0], [0.1, 0.4]]), 0.1 * rng.standard_normal((n, 2))
    u = np.repeat(rng.random((n // 15, 2)), 15, axis=0)
    x, free = np.zeros((n + 1, 2)), np.zeros((n + 1, 2))
    for k in range(n):
        x[k + 1] = A @ x[k] + B @ u[k] + K @ e[k]
        free[k + 1] = A @ free[k] + B @ u[k]
    return u, 25 + x[:-1] + e, 25 + free[:-1]


def as_log(u: Array, y: Array) -> Log:
    """Return rows a second apart as a log."""
    columns = {f"q{i}": (u[:, i], "1", "input") for i in range(u.shape[1])}
    columns |= {f"t{i}": (y[:, i], "degC", "output") for i in range(y.shape[1])}
    return make_log(np.arange(float(len(u))), columns)


def cases(folder: Path | None, seed: int) -> Iterator[Case]:
    """Yield the simulated plants of this seed and the public logs."""
    for name, system in (("lag", lag), ("coupled", coupled)):
        u, y, _ = system(seed)
        u_test, _, true = system(seed + 1000)
        yield Case(name, as_log(u, y), as_log(u_test, true), true)
    for problem in problems(folder, ["heat_exchanger", "tclab_prbs"]) if folder else ():
        train, test = problem.logs
        true = np.stack([test[name].values for name in problem.outputs], axis=1)
        yield Case(problem.name, train, test, true, None)


def struck(log: Log, share: float, how: str, seed: int) -> Log:
    """Return the log with this share of the readings lost."""
    rng, out = np.random.default_rng(2000 + seed), log.copy(deep=True)
    for name in names(log, "output"):
        n, lost = log.sizes["time"], []
        if how == "random":
            lost = rng.random(n) < share
        else:
            end, begin, gone = 1 / BURST, share / (1 - share) / BURST, False
            for draw in rng.random(n):
                gone = draw > end if gone else draw < begin
                lost.append(gone)
        out[name].values[np.asarray(lost)] = np.nan
    return out


def lined(log: Log) -> Log:
    """Return the log with lines through its holes."""
    out, rows = log.copy(deep=True), np.arange(log.sizes["time"])
    for name in names(log, "output"):
        known = np.isfinite(log[name].values)
        out[name].values[:] = np.interp(rows, rows[known], log[name].values[known])
    return out


def error(kind: str, log: Log, case: Case) -> float:
    """Return the free-run RMSE over the test record, the mean of its outputs."""
    plant = fit_black_box(kind, [log], average=case.average).plant
    run = plant.simulate(case.test, warmup=HEAD * float(np.median(np.diff(case.test["time"].values))))
    seen = np.stack([run[name].values for name in names(case.test, "output")], axis=1)
    return float(np.sqrt(np.nanmean((seen - case.true)[HEAD:] ** 2, axis=0)).mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--only", default="")
    asked = parser.parse_args()
    found: dict[tuple[str, str, str], dict[str, list[float]]] = {}
    for seed in range(asked.seeds):
        for case in (some for some in cases(asked.folder, seed) if asked.only in some.name):
            for (share, how), kind in ((c, k) for c in CASES for k in ("arx", "subspace")):
                log = struck(case.train, share, how, seed)
                row = found.setdefault((case.name, kind, f"{100 * share:.0f} % {how}"), {})
                if share or not seed or case.average:
                    row.setdefault("as it is", []).append(error(kind, log, case))
                if share:
                    row.setdefault("lines", []).append(error(kind, lined(log), case))
    for (name, kind, how), row in found.items():
        said = [f"{what} {np.mean(v):.3f} ({min(v):.3f} to {max(v):.3f})" for what, v in row.items()]
        print(f"{name:15s} {kind:9s} {how:13s} " + ", ".join(said))


if __name__ == "__main__":
    main()
