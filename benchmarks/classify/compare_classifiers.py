r"""Every classifier on the eleven conditions of exp1 to exp4: the same random splits by grasp for all.

    OMP_NUM_THREADS=1 python benchmarks/classify/compare_classifiers.py --out comparison \
        [--classifiers A,B] [--splits 20]

Of every condition five grasps a material train and three test, 20 times; the example files hold eight, so n
in the tables counts 40 or 24 distinct grasps and the intervals do, too.  LSTMs train for 200 epochs
(``--epochs``).  Answers of each classifier go into ``--out`` when it is done, so that a run can be taken up
again; tables are printed in Markdown from all that is there.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

from thermogrip.classify import GraspClassifier, evaluate, make_classifier
from thermogrip.classify.estimators.lda import ArrayClassifier
from thermogrip.classify.estimators.lstm import QUICK_EPOCHS
from thermogrip.classify.evaluation.comparison import POOLED, Comparison
from thermogrip.datasets.examples import load_example_grasps

LADDER = "features-lda,pca-lda,bayes,svm-pca,posterior,rocket,lstm,lstm-paper"

DEEP = {
    "inception": ("InceptionTimeClassifier", {}),
    "h-inception": ("InceptionTimeClassifier", {"use_custom_filters": True}),
    "lite": ("LITETimeClassifier", {}),
}


def made(name: str, epochs: int, members: int) -> GraspClassifier:
    """Return a classifier of this package or one of aeon's networks by name."""
    if name in DEEP:
        kind, params = DEEP[name]
        path = f"aeon.classification.deep_learning:{kind}"
        return ArrayClassifier(path, {"n_epochs": epochs, "n_classifiers": members, **params}, random_state=0)
    return make_classifier(name, seed=0, **({"epochs": epochs} if name.startswith("lstm") else {}))


def main() -> None:
    """Score what is not scored yet, print all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--classifiers", default=LADDER)
    parser.add_argument("--splits", type=int, default=20)
    parser.add_argument("--epochs", type=int, default=QUICK_EPOCHS, help="of the networks")
    parser.add_argument("--members", type=int, default=5, help="of an ensemble of networks")
    parser.add_argument("--conditions", help="these alone, by name")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    records = [g for name, g in load_example_grasps().items() if name[:4] in ("exp1", "exp2", "exp3", "exp4")]
    if given.conditions:
        wanted = given.conditions.split(",")
        records = [record for record in records if record.attrs["name"] in wanted]
    parts = []
    for name in given.classifiers.split(","):
        file = given.out / f"{name}.json"
        if not file.exists():
            clock = time.perf_counter()
            model = {name: made(name, given.epochs, given.members)}
            found = evaluate(model, records, split="random", repeats=given.splits, probe=False)
            file.write_text(json.dumps(asdict(found)), encoding="utf-8")
            print(f"{name}: {time.perf_counter() - clock:.0f} s", file=sys.stderr, flush=True)
        parts.append(read(file))
    rows = {key: sum((getattr(p, key) for p in parts), ()) for key in ("predictions", "times", "notes")}
    print_tables(replace(parts[0], **rows))


def read(file: Path) -> Comparison:
    """Return what one classifier said."""
    content = json.loads(file.read_text(encoding="utf-8"))
    return Comparison(**{k: tuple(v) if isinstance(v, list) else v for k, v in content.items()})


def print_tables(found: Comparison) -> None:
    """Print pooled scores, and accuracy and log loss of each condition, all with intervals."""
    rows = {(row["classifier"], row["condition"]): row for row in found.scores()}
    print("\n| classifier | n | accuracy | log loss | Brier | ECE | if calibrated | p |")
    print("|---|---|---|---|---|---|---|---|")
    for name in found.classifiers:
        row = rows[name, POOLED if len(found.conditions) > 1 else found.conditions[0]]
        cells = [span(row, "accuracy", "low", "high")]
        cells += [span(row, key, f"{key}_low", f"{key}_high") for key in ("log_loss", "brier", "ece")]
        print(
            f"| {name} | {row['n']} | {' | '.join(cells)} "
            f"| {row['ece_calibrated']:.3f} | {row['ece_p']:.3f} |"
        )
    for what, low, high in (("accuracy", "low", "high"), ("log_loss", "log_loss_low", "log_loss_high")):
        print(f"\n| {what.replace('_', ' ')} | n | {' | '.join(found.classifiers)} |")
        print("|---|---|" + "---|" * len(found.classifiers))
        for condition in found.conditions:
            cells = [span(rows[name, condition], what, low, high) for name in found.classifiers]
            n = rows[found.classifiers[0], condition]["n"]
            print(f"| {condition} | {n} | {' | '.join(cells)} |")
    print("\npairs, pooled:")
    for row in found.differences():
        print(
            f"  {row['first']} less {row['second']}: accuracy {row['difference']:+.3f} "
            f"({row['low']:+.3f} to {row['high']:+.3f}), p = {row['p_value']:.3f}; log loss "
            f"{row['log_loss_difference']:+.3f} ({row['log_loss_low']:+.3f} to {row['log_loss_high']:+.3f})"
        )


def span(row: dict[str, float], value: str, low: str, high: str) -> str:
    """Return a score and its interval."""
    return f"{row[value]:.3f} ({row[low]:.2f} to {row[high]:.2f})"


if __name__ == "__main__":
    main()
