"""`bayes`, trained on all conditions at once, beside classifiers that learn each condition from its own.

    OMP_NUM_THREADS=1 python benchmarks/classify/bayes.py FOLDER [--splits 20] [--seed 0] [--own A,B]

FOLDER holds grasps as CSV, such as ``exp1*`` to ``exp6*`` of the example rig.  Of every condition of known
temperatures five grasps a material train and three test, ``--splits`` times, the same for all.  ``bayes``
learns from the training grasps of all of them.  Printed are accuracy and log loss of each condition, of five
materials together, of three at 10 K and more, the time of a prediction, and how well ``p_unknown`` separates
grasps of other materials from held-out ones of the trained (AUROC).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from thermogrip.classify import evaluate, make_classifier
from thermogrip.classify.evaluation.metrics import auroc
from thermogrip.classify.evaluation.splits import plan_folds, scored_apart
from thermogrip.datasets.grasp_files import read_grasps


def main() -> None:
    """Evaluate and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--splits", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--own", default="pca-lda")
    given = parser.parse_args()
    files = [f for f in sorted(given.folder.glob("*.csv*")) if "_meta.csv" not in f.name]
    records = [read_grasps(f) for f in files]
    single = [g for g in records if not scored_apart(g)]
    known = [g for g in single if set(np.unique(g["material"].values)) <= trained(single)]
    names = ["bayes", *given.own.split(",")]
    found = evaluate(names, known, split="random", repeats=given.splits, seed=given.seed, probe=False)
    rows = {(row["classifier"], row["condition"]): row for row in found.scores()}
    print(f"| condition | n | {' | '.join(names)} |\n|---|---|{'---|' * len(names)}")
    for condition in found.conditions:
        n = rows["bayes", condition]["n"]
        print(f"| {condition} | {n} | {' | '.join(cell(rows[name, condition]) for name in names)} |")
    pools = {"five materials": lambda r: r["candidates"] == 5, "three, 10 K and more": far(known)}
    for pool, kept in pools.items():
        cells = []
        for name in names:
            some = [r for r in found.predictions if r["classifier"] == name and kept(r)]
            cells.append(
                f"{np.mean([r['correct'] for r in some]):.3f}, {np.mean([r['log_loss'] for r in some]):.3f}"
            )
        print(f"| {pool} | | {' | '.join(cells)} |")
    for name in names:
        took = [1e3 * t["predict_s_per_grasp"] for t in found.times if t["classifier"] == name]
        print(f"{name}: {np.median(took):.2f} ms a grasp (median), {np.max(took):.2f} at most")
    names_known = {str(g.attrs["name"]) for g in known}
    strangers([g for g in single if str(g.attrs["name"]) not in names_known], known, given.seed)


def trained(records: list) -> set[str]:
    """Return the materials that have five grasps or more for training and some to spare in any record."""
    counts = [np.unique(g["material"].values, return_counts=True) for g in records]
    return {str(m) for names, n in counts for m, k in zip(names, n) if k > 5}


def far(records: list):
    """Return which predictions are of three materials, objects 10 K from the skin."""
    from thermogrip.classify.estimators.features import object_difference

    off = {str(g.attrs["name"]): np.abs(object_difference(g)).mean() for g in records}
    return lambda row: row["candidates"] == 3 and off[row["condition"]] > 9.0


def cell(row: dict) -> str:
    """Return accuracy with its interval and log loss."""
    return f"{row['accuracy']:.2f} ({row['low']:.2f} to {row['high']:.2f}), {row['log_loss']:.4f}"


def strangers(others: list, known: list, seed: int) -> None:
    """Print how ``p_unknown`` separates other materials from held-out grasps of the trained ones."""
    if not others:
        return
    plan = plan_folds(known, split="random", repeats=1, train_per_class=5, seed=seed)
    model = make_classifier("bayes").fit(list(plan.training[0]))
    home = np.concatenate([model.p_unknown(fold.test) for fold in plan.folds])
    print(f"held-out grasps of the trained materials: p_unknown over 0.5 in {np.mean(home > 0.5):.3f}")
    for part in others:
        p, names = model.p_unknown(part), part["material"].values
        for name in np.unique(names):
            own = p[names == name]
            area = auroc(home.tolist(), own.tolist())
            print(f"{name}: AUROC {area:.3f}, mean p_unknown {own.mean():.2f}")


if __name__ == "__main__":
    main()
