"""What a change of room, of blocks or of gripper costs a classifier that was trained before it.

    OMP_NUM_THREADS=1 python benchmarks/classify/transfer.py [--parts made,bundled] [--sets 3] [--test 12]

- made: grasps by finite volumes (finite_volumes.py), which are no classifier's model.  Five grasps of each of
  five materials at four pairs of temperatures train; each target has ``--test`` fresh ones of each: the same
  situation again; a room at 8 to 15 degC instead of 22 to 29; other blocks of the same materials (contact
  conductance by a factor of spread 0.25 and conductivity of spread 0.10 in the logarithm, three sets of
  blocks); another gripper (sheet, silicone, lag and build-up time); all three.
- bundled: two pairs of example files were taken at the same temperatures on other occasions: trained on one,
  tested on the other, and the other way round.

Intervals count test grasps; +- is the spread over training sets.  ``posterior-finish`` is the
posterior for other blocks, ``posterior-another`` for another gripper,
``posterior-uncertain`` that its calibration is not exact.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from finite_volumes import Rig, labelled

from thermogrip.classify import Comparison, GraspClassifier, evaluate, make_classifier
from thermogrip.classify.evaluation.comparison import POOLED
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import Grasps, log_name

FIVE = ("brass", "copper", "iron", "wood", "zinc")
OTHER_LAYERS = ((1.5e-4, 8.0, 1.6e6, 8), (1.0e-3, 1.0, 2.0e6, 20), (6.0e-3, 0.6, 4.2e6, 16))
COLD = (8.0, 15.0)


def main() -> None:
    """Train, test, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--parts", default="made,bundled")
    parser.add_argument("--classifiers", default="posterior,features-lda,pca-lda,rocket,lstm")
    parser.add_argument("--sets", type=int, default=3, help="training sets of made grasps")
    parser.add_argument("--test", type=int, default=12, help="made test grasps of a material and condition")
    given = parser.parse_args()
    names = given.classifiers.split(",")
    for part in given.parts.split(","):
        for name in names:
            found = {"made": made, "bundled": bundled}[part](name, given.sets, given.test)
            print_table(name, found)


def make(name: str) -> GraspClassifier:
    """Return a classifier by name; LSTMs with 200 epochs."""
    if name == "posterior-finish":
        return make_classifier("posterior", seed=0, finish="unknown")
    if name in ("posterior-another", "posterior-uncertain"):
        return make_classifier("posterior", seed=0, gripper=name.removeprefix("posterior-"))
    return make_classifier(name, quick=True, seed=0)


def made(name: str, sets: int, test: int) -> Comparison:
    """Return the study on grasps by finite volumes."""
    training = [labelled(FIVE, repeats=5, seed=100 + k) for k in range(sets)]
    return transfer({name: make(name)}, training, targets(test))


def targets(test: int) -> dict[str, list[Grasps]]:
    """Return fresh grasps in each situation."""
    old = Rig()
    new = replace(old, layers=OTHER_LAYERS, lag=0.25, build=0.4)
    kinds = [other_blocks(old, seed) for seed in range(3)]
    share = max(1, test // len(kinds))
    return {
        "the same again": named(labelled(FIVE, repeats=test, seed=1), "a"),
        "another room": named(labelled(FIVE, repeats=test, seed=2, rig=replace(old, room=COLD)), "b"),
        "other blocks": [
            g
            for k, rig in enumerate(kinds)
            for g in named(labelled(FIVE, repeats=share, seed=3 + k, rig=rig), f"c{k}")
        ],
        "another gripper": named(labelled(FIVE, repeats=test, seed=6, rig=new), "d"),
        "all three": [
            g
            for k in range(3)
            for g in named(
                labelled(FIVE, repeats=share, seed=7 + k, rig=replace(other_blocks(new, k), room=COLD)),
                f"e{k}",
            )
        ],
    }


def other_blocks(rig: Rig, seed: int) -> Rig:
    """Return the rig with other blocks of the same materials."""
    rng = np.random.default_rng([seed, 7])
    h_scale = {m: float(np.exp(0.25 * rng.standard_normal())) for m in FIVE}
    grade = {m: float(np.exp(0.10 * rng.standard_normal())) for m in FIVE}
    return replace(rig, h_scale=h_scale, grade=grade)


def named(records: list[Grasps], letter: str) -> list[Grasps]:
    """Return records under names of their own."""
    return [g.assign_attrs(name=f"{letter} {g.attrs['name']}") for g in records]


def bundled(name: str, sets: int, test: int) -> Comparison:
    """Return the study on example files: one of each pair trains, the other is tested, both ways."""
    del sets, test
    files = load_example_grasps()
    first = files["exp1A_obj43_grip23"]
    three = first.isel(grasp=np.isin(first["material"].values, ["copper", "iron", "wood"]))
    pairs = ((files["exp2_dT20"], files["exp3B_obj28_grip48"]), (three, files["exp3A_obj43_grip23"]))
    there = [[unmarked(a) for a, _ in pairs], [unmarked(b) for _, b in pairs]]
    ways = [transfer({name: make(name)}, [there[k]], {"another session": there[1 - k]}) for k in (0, 1)]
    return replace(ways[0], predictions=ways[0].predictions + ways[1].predictions)


def transfer(
    classifiers: dict[str, GraspClassifier], training: list[list[Grasps]], targets: dict[str, list[Grasps]]
) -> Comparison:
    """Return what classifiers that were trained in one situation say in others: conditions are the targets,
    repeats the training sets; a test record is answered by the training record at its temperatures."""
    target_of = {f"{t}: {log_name(g)}": t for t, records in targets.items() for g in records}
    tests = [g.assign_attrs(name=f"{t}: {log_name(g)}") for t, records in targets.items() for g in records]
    rows = []
    for k, records in enumerate(training):
        for row in evaluate(classifiers, records, test=tests, probe=False).predictions:
            place = {
                "condition": target_of[row["condition"]],
                "grasp_id": f"{row['condition']}/{row['grasp_id']}",
            }
            rows.append(row | {"repeat": k} | place)
    return Comparison(split="files", repeats=len(training), seed=0, predictions=tuple(rows))


def unmarked(grasps: Grasps) -> Grasps:
    """Return all grasps of a record, whatever its split says."""
    return grasps.drop_vars("split")


def print_table(name: str, found: Comparison) -> None:
    """Print a line for each target."""
    for row in found.scores():
        if row["condition"] == POOLED:
            continue
        spread = f" +- {row['sd_over_splits']:.3f}" if row["sd_over_splits"] is not None else ""
        print(
            f"| {name} | {row['condition']} | {row['n']} "
            f"| {row['accuracy']:.3f} ({row['low']:.2f} to {row['high']:.2f}){spread} "
            f"| {row['log_loss']:.2f} ({row['log_loss_low']:.2f} to {row['log_loss_high']:.2f}) "
            f"| {row['ece']:.3f} ({row['ece_low']:.2f} to {row['ece_high']:.2f}) "
            f"| {row['ece_calibrated']:.3f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
