"""The rows of exp1 to exp4 on hundreds of fresh grasps, from a truth that no classifier models.

    OMP_NUM_THREADS=1 python benchmarks/classify/fresh.py [--sets 4] [--test 40] [--hundreds 200]

The example files hold 24 or 40 grasps a row: too few to distinguish a rate of 0.54 from one of 0.62. Here
finite volumes (finite_volumes.py) make grasps at the same temperatures, ten seconds each, of blocks whose
contact conductances are to each other as those of the example rig. Five of each material and condition train,
all conditions together, and ``--test`` fresh ones of each material are named, for ``--sets`` such trainings.
Beside the posterior stand itself, taught by ``--more`` of each, and generic classifiers, trained on the same
five grasps of the row alone, and on ``--hundreds`` of them, which is about what the row allows.
"""

from __future__ import annotations

import argparse
from collections import defaultdict

import numpy as np
from finite_volumes import Rig, labelled
from no_difference import CONDITIONS

from thermogrip.classify import make_classifier
from thermogrip.datasets.schema import Grasps
from thermogrip.sysid.effusivity.calibration import calibrate_gripper
from thermogrip.sysid.effusivity.posterior import material_posterior

ROWS = ("1A", "1B", "2 dT 0", "2 dT 5", "2 dT 10", "2 dT 15", "2 dT 20", "3A", "3B", "3C", "4")
# contact conductance over the metals' mean, as calibrated on the example rig; wood has 600 W m^-2 K^-1
RIG = Rig(h_scale={"copper": 1.13, "brass": 1.07, "zinc": 0.96, "iron": 0.87})
GENERIC = ("pca-lda", "svm-pca", "features-lda", "bayes")
Answers = dict[tuple[str, str], list[tuple[bool, float]]]


def main() -> None:
    """Train, name, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sets", type=int, default=4, help="training sets of five grasps")
    parser.add_argument("--test", type=int, default=40, help="fresh grasps of each material, each set")
    parser.add_argument("--more", type=int, default=20, help="training grasps of a posterior that has more")
    parser.add_argument("--hundreds", type=int, default=200, help="training grasps of each material; 0: none")
    given = parser.parse_args()
    found: Answers = defaultdict(list)
    more = calibrate_gripper(drawn(given.more, 1500))
    for k in range(given.sets):
        training, fresh = drawn(5, 1000 + k), drawn(given.test, 2000 + k)
        device = calibrate_gripper(training)
        for row, few, record in zip(ROWS, training, fresh):
            names = sorted(set(record["material"].values.tolist()))
            for who, gripper in (("posterior", device), (f"posterior, {given.more}", more)):
                keep(found, row, who, record, names, material_posterior(gripper, record, names))
            for kind in GENERIC:
                generic(found, row, kind, "five", few, record)
        if given.hundreds and k == 0:
            for row, many, record in zip(ROWS, drawn(given.hundreds, 3000), drawn(2 * given.test, 4000)):
                for kind in GENERIC:
                    generic(found, row, kind, "hundreds", many, record)
        print(f"set {k + 1} of {given.sets}", flush=True)
    print_table(found, given.sets)


def drawn(repeats: int, seed: int) -> list[Grasps]:
    """Return a record for each row, ``repeats`` grasps of each of its materials."""
    out = []
    for i, (warm, grip, names, _) in enumerate(CONDITIONS):
        at = {"rig": RIG, "conditions": ((warm, grip),)}
        (record,) = labelled(tuple(names), repeats=repeats, seed=100 * seed + i, **at)
        out.append(record.assign_attrs(name=f"{ROWS[i]} {seed}"))
    return out


def generic(found: Answers, row: str, kind: str, how: str, train: Grasps, record: Grasps) -> None:
    """Train one generic classifier on one row and keep its answers."""
    model = make_classifier(kind, seed=0)
    model.fit([train])
    keep(found, row, f"{kind}, {how}", record, model.classes_.tolist(), model.predict_proba([record]))


def keep(found: Answers, row: str, who: str, record: Grasps, names: list[str], p: np.ndarray) -> None:
    """Keep right or wrong and the log loss of each grasp."""
    true = np.array([names.index(m) for m in record["material"].values])
    loss = -np.log(np.maximum(p[np.arange(true.size), true], 1e-12))
    found[row, who] += zip((p.argmax(axis=1) == true).tolist(), loss.tolist())


def print_table(found: Answers, sets: int) -> None:
    """Print accuracy with its standard error and by training set, and log loss, by row and classifier."""
    print("\n| row | classifier | grasps | accuracy | se | by training set | log loss |")
    print("|---|---|---|---|---|---|---|")
    for (row, who), answers in found.items():
        right, loss = np.array(answers, dtype=float).T
        accuracy, n = right.mean(), right.size
        each = "" if who.endswith("hundreds") else right.reshape(sets, -1).mean(axis=1).round(2).tolist()
        se = np.sqrt(accuracy * (1 - accuracy) / n)
        print(f"| {row} | {who} | {n} | {accuracy:.3f} | {se:.3f} | {each} | {loss.mean():.3f} |")


if __name__ == "__main__":
    main()
