"""What a black box's 90 % bands hold of logs, or parts of logs, that it has not seen.

    python benchmarks/identify/bands.py FOLDER [--kinds arx,oe,subspace]

Every case fits on one part of the logs in ``FOLDER`` (docs/measured.md says where they come from) and runs
freely over another.  A row says by how much it errs more there than on the held-out parts that chose the
structure, what share a band of these errors alone holds, what was predicted of the worst part, and the share
with the factor that would make the predicted shares right on average (tried, not used).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import ndtr

from thermogrip.datasets.log_files import read_log
from thermogrip.datasets.schema import Log, column
from thermogrip.sysid.blackbox.fit import fit_black_box
from thermogrip.sysid.validation.prediction_bands import expected_coverage

WIDE, LEVEL = 1.6449, 0.9

Array = NDArray[np.float64]


def cases(folder: Path) -> Iterator[tuple[str, Log, Log]]:
    """Yield (what, the log to fit, the log to run over)."""
    tanks = [folder / f"cascaded_tanks_{half}.csv" for half in ("train", "test")]
    for file in tanks:
        yield f"{file.stem}, last 30 %", read_log(f"{file}@:2866"), read_log(f"{file}@2866:")
        yield f"{file.stem}, second half", read_log(f"{file}@:2048"), read_log(f"{file}@2048:")
        yield f"{file.stem}, first half", read_log(f"{file}@2048:"), read_log(f"{file}@:2048")
    train, test = map(read_log, tanks)
    yield "tanks, test", train, test
    yield "tanks, train", test, train
    for name in ("heat_exchanger", "tclab_prbs"):
        file = folder / f"{name}.csv"
        begin, end = read_log(file)["time"].values[[0, -1]]
        half, cut = (begin + end) / 2, begin + 0.35 * (end - begin)
        yield f"{name}, second half", read_log(f"{file}@:{half:g}"), read_log(f"{file}@{half:g}:")
        yield f"{name}, first half", read_log(f"{file}@{half:g}:"), read_log(f"{file}@:{half:g}")
        yield f"{name}, 35 to 50 %", read_log(f"{file}@:{cut:g}"), read_log(f"{file}@{cut:g}:{half:g}")


def factor(errors: Array) -> float:
    """Return by what to widen a band so that parts predicted by the others come out right on average."""
    squares = errors**2
    ratio = np.sqrt((squares.sum() - squares) / (len(squares) - 1) / squares)

    def above(c: float) -> float:
        return float(np.mean(2 * ndtr(c * WIDE * ratio) - 1)) - LEVEL

    return 1.0 if above(1.0) >= 0 else float(brentq(above, 1.0, 100.0))


def rows(name: str, kind: str, train: Log, test: Log) -> Iterator[tuple[float, float]]:
    """Print a line an output and yield the share held, as it is and with the factor."""
    plant = fit_black_box(kind, [train]).plant
    run = plant.simulate(test)
    for output in plant.outputs:
        miss = np.abs(column(test, output) - column(run, output))
        miss = miss[(run["scored"].values > 0) & np.isfinite(miss)]
        half = WIDE * plant.scores.held_out_rmse[output]
        wider = factor(np.array(plant.scores.held_out_by_part[output]))
        held, with_factor = float(np.mean(miss <= half)), float(np.mean(miss <= wider * half))
        more = np.sqrt(np.mean(miss**2)) * WIDE / half
        worst = expected_coverage(plant)[output].min()
        print(
            f"{name:30s} {kind:9s} {output:7s} errs {more:.2f} times, holds {held:.2f} "
            f"(worst part {worst:.2f}), times {wider:.2f}: {with_factor:.2f}",
            flush=True,
        )
        yield held, with_factor


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kinds", default="arx,oe,subspace")
    args = parser.parse_args()
    shares = np.array(
        [
            pair
            for name, train, test in cases(args.folder)
            for kind in args.kinds.split(",")
            for pair in rows(name, kind, train, test)
        ]
    )
    for what, column_ in zip(("as it is", "with the factor"), shares.T):
        print(f"{what}: mean {column_.mean():.2f}, {np.sum(column_ < 0.8)} of {len(shares)} below 0.8")


if __name__ == "__main__":
    main()
