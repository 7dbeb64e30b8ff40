"""What ``identify`` says of public sets, beside what is true on the half that it has not seen.

    python benchmarks/abroad/score.py FOLDER [--sets luca,house] [--each [--swapped]]

By set and output: the error stated for another run, that on the other half, the share of its readings inside
the 90 % band with the band's interval score, of two boards by how much the gain is off on the other day; by
set: the chosen model, whether it is called good, CPU seconds.  ``--each``: every black box beside it, fitted
to the whole training half.  ``--swapped``: only the black boxes, fitted to the other half and scored on the
training half: what errors on unseen data of the same plant say of which kind is best.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from foreign_sets import ForeignSet, load, present

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, column
from thermogrip.sysid import identify
from thermogrip.sysid.blackbox.fit import BLACK_BOXES, fit_black_box
from thermogrip.sysid.identification import USUAL_MODELS
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.validation.free_run import FreeRun, free_run
from thermogrip.sysid.validation.stated_errors import between_runs


def run_over(plant: Plant, some: ForeignSet) -> FreeRun:
    warmup = max(some.warmup, plant.dt)
    return free_run(plant, some.test, warmup=warmup, score_from=warmup, tests=False)


def mean_rmse(run: FreeRun) -> float:
    return float(np.mean([score.rmse for score in run.scores.values()]))


def mean_share(errors: Sequence[float], some: ForeignSet, outputs: Sequence[str]) -> float:
    """Return the mean over outputs of errors over the spread of what is scored, for units that differ."""
    rows = some.test["time"].values - some.test["time"].values[0] >= some.warmup
    return float(np.mean([e / np.nanstd(column(some.test, y)[rows]) for e, y in zip(errors, outputs)]))


def gain_off(plant: Plant, log: Log, output: str) -> float:
    """Return by what share of the inputs' effect a run differs from the plant, by least squares."""
    effect = between_runs(plant, [log], 1.0)[output]
    miss = column(plant.simulate(log), output) - column(log, output)
    return float(effect @ miss / (effect @ effect))


def score_set(some: ForeignSet, each: bool) -> None:
    began = time.process_time()
    try:
        found = identify(some.train)
    except UserError as error:
        print(f"{some.name:10s} refused: {error}", flush=True)
        return
    cpu = time.process_time() - began
    run = run_over(found.plant, some)
    share = mean_share([score.rmse for score in run.scores.values()], some, list(run.scores))
    print(
        f"{some.name:10s} {found.model:9s} RMSE {mean_rmse(run):.3f} ({share:.3f} of the spread) "
        f"{'good' if found.good else '-':4s} {cpu:4.0f} s CPU  "
        f"{found.plant.scores.structure} dt {found.plant.dt:g}",
        flush=True,
    )
    band = run.band()
    scored = np.asarray(run.log["scored"].values) > 0
    for name, score in run.scores.items():
        stated = found.expected[name].rmse
        miss = np.abs(column(some.test, name) - column(run.log, name))[scored]
        half = band.half[name][scored]
        interval = float(np.mean(2 * half + 20 * np.maximum(miss - half, 0.0)))
        day = "" if some.same_run else f", gain off by {gain_off(found.plant, some.test, name):+.3f}"
        print(
            f"    {name}: stated {stated:.3g}, other half {score.rmse:.3g} ({score.rmse / stated:.2f} times, "
            f"{score.rmse / band.expected[name]:.2f} by the band), band holds {band.inside[name]:.2f}, "
            f"interval score {interval:.3g}{day}",
            flush=True,
        )
    for row in dict.fromkeys((r.model, r.structure) for r in found.rows if r.held_out) if each else ():
        print(f"    held: {row[0]:9s} {found.errors()[row[0]]:.3f} {row[1]}", flush=True)
    if each:
        score_kinds(some, BLACK_BOXES)


def score_kinds(some: ForeignSet, kinds: Sequence[str]) -> None:
    """Print the error of each kind of black box, fitted to the training half."""
    for kind in kinds:
        began = time.process_time()
        try:
            fit = fit_black_box(kind, [some.train])
            error = mean_rmse(run_over(fit.plant, some))
            label = f"{fit.choice.structure.label} dt {fit.plant.dt:g} folds {fit.choice.error:.3f}"
        except UserError as refused:
            error, label = np.nan, str(refused)
        print(f"    all:  {kind:9s} {error:.4g} {time.process_time() - began:4.0f} s  {label}", flush=True)


def main() -> None:
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("folder", type=Path)
    words.add_argument("--sets", help="separated by commas; where absent, all whose files are there")
    words.add_argument("--each", action="store_true")
    words.add_argument("--swapped", action="store_true")
    given = words.parse_args()
    for name in given.sets.split(",") if given.sets else present(given.folder):
        some = load(given.folder, name)
        if given.swapped:
            print(f"{name:10s} swapped", flush=True)
            score_kinds(
                replace(some, train=some.test, test=some.train), [k for k in USUAL_MODELS if k != "network"]
            )
        else:
            score_set(some, given.each)


if __name__ == "__main__":
    main()
