"""Another gripper: what a few of its grasps of known blocks are worth, and whether the confidence shows it.

    OMP_NUM_THREADS=1 python benchmarks/classify/grippers.py [--grippers 8] [--test 3] [--workers N]

A posterior classifier is calibrated on grasps of one gripper (finite_volumes.py: no classifier's model; five
of each of five materials at four pairs of temperatures) and asked about grasps of others.  The first of these
is the other gripper of transfer.py; the rest are drawn, wider than the spread that the classifier assumes and
in other terms: thicknesses, conductivities and heat capacities of all three layers, lag, build-up time,
contact conductance of all blocks and of each, and the heat that blocks lose.  It is asked

- as it is: each record decides whether another gripper or other blocks explain it better;
- as that of the training for certain (``gripper="same"``), its numbers taken as exact;
- as ``for_another_gripper()`` from no known grasp, and from 1, 3, 5, 10, 25 known ones of the other gripper,
  copper and wood in turn at 20 K;
- beside a calibration of the other gripper from those 10 alone, cold, and from a hundred grasps of all five.

The cold calibration of ten has copper and wood alone: the other three materials come from the library, finish
unknown.  Intervals are by bootstrap over grippers and then over their grasps, since grasps of one gripper
share its faults.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from finite_volumes import Rig, labelled
from numpy.typing import NDArray
from transfer import FIVE, OTHER_LAYERS

from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.classify.evaluation.metrics import calibration_interval
from thermogrip.datasets.schema import Grasps
from thermogrip.sysid.effusivity.calibration import calibrate_gripper
from thermogrip.sysid.effusivity.posterior import material_posterior

Array = NDArray[np.float64]
KNOWN = (1, 3, 5, 10, 25)


def main() -> None:
    """Calibrate, ask, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--grippers", type=int, default=8)
    parser.add_argument(
        "--test", type=int, default=3, help="test grasps of a material and pair of temperatures"
    )
    parser.add_argument("--seed", type=int, default=100, help="of the training grasps")
    parser.add_argument("--out", type=Path, help="also write every answer here, as JSON")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    given = parser.parse_args()
    ours = PosteriorClassifier().fit(labelled(FIVE, repeats=5, seed=given.seed))
    rows: list[dict[str, Any]] = []
    with ProcessPoolExecutor(given.workers, mp_context=get_context("spawn")) as pool:
        asks = [pool.submit(about, ours, given.test, k) for k in range(given.grippers)]
        for k, answers in enumerate(one.result() for one in asks):
            for name, p, truth, seconds in answers:
                rows += [
                    {"gripper": k, "how": name, "truth": t, "p": row.tolist()} for t, row in zip(truth, p)
                ]
                cost = f"{seconds * 1e3:.0f} ms a grasp"
                print(f"gripper {k} | {name} | {summary(p, truth)} | {cost}", flush=True)
    print("\n| asked | accuracy | log loss | ECE | stated |\n|---|---|---|---|---|")
    for name in dict.fromkeys(row["how"] for row in rows):
        print(table_row(name, [row for row in rows if row["how"] == name]), flush=True)
    if given.out:
        given.out.write_text(json.dumps(rows))


def rig_of(k: int) -> Rig:
    """Return gripper k."""
    return Rig(layers=OTHER_LAYERS, lag=0.25, build=0.4) if k == 0 else drawn(k)


def calibrated(k: int) -> PosteriorClassifier:
    """Return what a hundred grasps of gripper k teach."""
    return PosteriorClassifier().fit(labelled(FIVE, repeats=5, seed=600 + k, rig=rig_of(k)))


def about(ours: PosteriorClassifier, test: int, k: int) -> list[tuple[str, Array, list[str], float]]:
    """Return all answers about gripper k."""
    return list(asked(ours, rig_of(k), test, 500 + k, calibrated(k)))


def drawn(seed: int) -> Rig:
    """Return a gripper drawn wider than the classifier assumes."""
    rng = np.random.default_rng([seed, 77])

    def factor(sd: float) -> float:
        return float(np.exp(sd * rng.standard_normal()))

    base = Rig()
    layers = tuple((d * factor(0.35), k * factor(0.35), c * factor(0.15), n) for d, k, c, n in base.layers)
    common = factor(0.3)
    return replace(
        base,
        layers=layers,
        lag=base.lag * factor(0.6),
        build=base.build * factor(0.5),
        h_c={name: h * common for name, h in base.h_c.items()},
        h_c_else=base.h_c_else * common,
        h_scale={name: factor(0.1) for name in FIVE},
        far=base.far * factor(0.5),
        sides=base.sides * factor(0.5),
    )


def asked(
    ours: PosteriorClassifier, rig: Rig, test: int, seed: int, own: PosteriorClassifier
) -> Iterator[tuple[str, Array, list[str], float]]:
    """Return (how, probabilities, truth, CPU seconds a grasp) of each way to ask about one gripper."""
    fresh = labelled(FIVE, repeats=test, seed=seed, rig=rig)
    truth = [str(m) for record in fresh for m in record["material"].values]
    pool = labelled(("copper", "wood"), repeats=13, seed=seed + 50, rig=rig)[1]
    order = [i for pair in zip(range(13), range(13, 26)) for i in pair]
    known: dict[int, Grasps | None] = {0: None} | {n: pool.isel(grasp=order[:n]) for n in KNOWN}

    def answer(model: PosteriorClassifier) -> tuple[Array, float]:
        clock = time.process_time()
        p = np.concatenate([model.predict_proba(record) for record in fresh])
        return p, (time.process_time() - clock) / len(truth)

    yield "as it is", *_with(truth, answer(ours))
    yield "the same for certain", *_with(truth, answer(ours.certain()))
    for n, few in known.items():
        model = ours.for_another_gripper(few)
        yield f"another, {n} known", *_with(truth, answer(model))
    cold = calibrate_gripper([pool.isel(grasp=order[:10])])
    p = np.concatenate([material_posterior(cold, record, FIVE) for record in fresh])
    yield "cold, 10 known", p, truth, 0.0
    yield "cold, 100 of five", *_with(truth, answer(own))


def _with(truth: list[str], answer: tuple[Array, float]) -> tuple[Array, list[str], float]:
    return answer[0], truth, answer[1]


def summary(p: Array, truth: list[str]) -> str:
    """Return accuracy, log loss and stated confidence in words."""
    at = np.array([FIVE.index(t) for t in truth])
    right = p.argmax(axis=1) == at
    loss = -np.log(np.maximum(p[np.arange(at.size), at], 1e-15))
    return f"{right.mean():.3f} | {loss.mean():.2f} | stated {p.max(axis=1).mean():.3f}"


def table_row(name: str, rows: list[dict[str, Any]]) -> str:
    """Return the Markdown row of one way to ask, pooled over grippers."""
    p = np.array([row["p"] for row in rows])
    truth = np.array([FIVE.index(row["truth"]) for row in rows])
    gripper = np.array([row["gripper"] for row in rows])
    found = figures(p, truth)
    rng = np.random.default_rng(0)
    draws = []
    for _ in range(500):
        chosen = rng.choice(np.unique(gripper), np.unique(gripper).size)
        at = np.concatenate([rng.choice(np.flatnonzero(gripper == g), (gripper == g).sum()) for g in chosen])
        draws.append(figures(p[at], truth[at]))
    low, high = np.quantile(np.array(draws), [0.025, 0.975], axis=0)
    cells = [f"{v:.3f} ({a:.2f} to {b:.2f})" for v, a, b in zip(found, low, high)]
    return f"| {name} | " + " | ".join(cells) + " |"


def figures(p: Array, truth: NDArray[np.int64]) -> tuple[float, float, float, float]:
    """Return accuracy, log loss, expected calibration error and mean stated confidence."""
    right = p.argmax(axis=1) == truth
    loss = -np.log(np.maximum(p[np.arange(truth.size), truth], 1e-15)).mean()
    confidence = p.max(axis=1)
    ece = calibration_interval(confidence, right, np.arange(right.size)).value
    return float(right.mean()), float(loss), ece, float(confidence.mean())


if __name__ == "__main__":
    main()
