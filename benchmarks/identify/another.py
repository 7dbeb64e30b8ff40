"""What `validate` says of pairs of logs whose truth is known: the same plant once more, or another one.

    python benchmarks/identify/another.py [--pairs 10] [--only network,black boxes,three logs]

A TCLab with the numbers of the virtual board: 25 min of random pulses, white noise of 0.043 K, the steps of
its converter, and a slow error of 0.03 K over 100 s.  A plant is identified from one log (or three), and
scored on others of the same board and of boards that differ.  Printed by case: shares of logs that are called
another plant, and what of; the median of the largest error over the stated one; the share of readings that
the 90 % band covers; and how many logs have a significant correlation, by which all were called another
plant before.
"""

from __future__ import annotations

import argparse
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from left import LSB, SECONDS, board, levels, pulses
from numpy.typing import NDArray
from scipy.signal import lfilter

from thermogrip.datasets.schema import Log, make_log
from thermogrip.sysid import identify
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.validation.free_run import FreeRun, free_run

Array = NDArray[np.float64]
ROOM = 23.0


def boards() -> Iterator[tuple[str, Plant, float, Callable[[np.random.Generator, int], Array]]]:
    """Yield cases: words, the plant, its room, its moves."""
    same = board()

    def scaled(share: float, *names: str) -> Plant:
        return replace(same, values=same.values | {name: share * same.values[name] for name in names})

    yield "same", same, ROOM, pulses
    yield "same, 0 to 90 % in steps of 10 min", same, ROOM, levels
    for less in (3, 10, 25):
        yield f"heaters {less} % less", scaled(1 - less / 100, "power_1", "power_2"), ROOM, pulses
    yield "one heater 25 % less", scaled(0.75, "power_1"), ROOM, pulses
    for times in (1.5, 3.0):
        yield f"lags times {times:g}", scaled(times, "lag_1", "lag_2"), ROOM, pulses
    for room in (18.0, 28.0):
        yield (
            f"room {room - ROOM:+g} degC",
            replace(same, values=same.values | {"t_room": room}),
            room,
            pulses,
        )


def log_of(plant: Plant, u: Array, room: float, rng: np.random.Generator) -> Log:
    """Return what this board shows that begins at its room's temperature."""
    x0 = plant.model.rest(np.full(2, room), np.zeros(2), np.zeros(0), plant.p)
    y = plant.model.rollout(x0[None], u[None], np.zeros((1, len(u), 0)), plant.p[None], 1.0)[0][0, :-1]
    keep = np.exp(-1 / 100)
    slow = lfilter([np.sqrt(1 - keep**2)], [1, -keep], rng.standard_normal((len(u) + 1000, 2)), axis=0)[1000:]
    y = y + 0.03 * slow + 0.043 * rng.standard_normal(y.shape)
    y = np.round((y + 50) / LSB * 10) / 10 * LSB - 50
    heaters = {f"q{k + 1}": (u[:, k], "percent", "input") for k in range(2)}
    outputs = {f"t{k + 1}": (y[:, k], "degC", "output") for k in range(2)}
    log = make_log(np.arange(float(len(u))), heaters | outputs)
    log.attrs["name"] = f"log {rng.integers(10**9)}"
    return log


def fitted(kind: str, logs: list[Log]) -> Plant:
    """Return the plant that identify finds."""
    if kind == "network":
        return identify(logs[:1], "tclab", models=["network"]).plant
    return identify(logs if kind == "three logs" else logs[:1], models=["arx", "subspace"]).plant


def main() -> None:
    """Print a table for each kind of plant."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pairs", type=int, default=10)
    parser.add_argument("--only", default="network,black boxes,three logs")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    for kind in given.only.split(","):
        rng = np.random.default_rng(given.seed)
        found: dict[str, list[FreeRun]] = {}
        for _ in range(given.pairs):
            plant = fitted(kind, [log_of(board(), pulses(rng, SECONDS), ROOM, rng) for _ in range(3)])
            for name, truth, room, moves in boards():
                log = log_of(truth, moves(rng, SECONDS), room, rng)
                found.setdefault(name, []).append(free_run(plant, log, warmup=50, score_from=50))
        print(f"\n{kind}\n| log | another plant | verdicts | error over stated | covered | correlates |")
        print("|---|---|---|---|---|---|")
        for name, runs in found.items():
            print(row(name, runs), flush=True)


def row(name: str, runs: list[FreeRun]) -> str:
    """Return the row of one case."""
    verdicts = [run.verdict for run in runs if run.verdict is not None]
    counts = Counter(verdict.standing for verdict in verdicts)
    kinds = ", ".join(f"{count} {standing}" for standing, count in counts.most_common())
    over = np.median([max(verdict.over_stated.values()) for verdict in verdicts])
    covered = np.mean([list(run.band().inside.values()) for run in runs])
    named = [any(t.significant for row in run.residual.tests.values() for t in row.values()) for run in runs]
    share = counts["changed"] / len(runs)
    return f"| {name} | {share:.2f} | {kinds} | {over:.2f} | {covered:.2f} | {np.mean(named):.2f} |"


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()
