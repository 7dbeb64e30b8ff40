"""How much of a row of ``table.py`` is chance: which splits were drawn, which grasps there are, near ties.

    OMP_NUM_THREADS=1 python benchmarks/classify/table.py --splits 100 --only classes --quick --out all.json
    python benchmarks/classify/chance.py all.json

- splits: accuracy over all of them, and of each twenty in the order drawn: what another seed would have said;
- grasps: the accuracy that the engine's own probabilities predict for these very readings, labels drawn from
  them, and how often it lies below what was asked;
- ties: answers by the distance between the two likeliest materials.

It reads answers about test grasps: it explains a table, nothing may be chosen by it.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from table import RATES

Row = dict[str, Any]

MARGINS = ((0.0, 0.1), (0.1, 0.2), (0.2, 0.4), (0.4, 1.01))


def main() -> None:
    """Read and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("answers", type=Path, help="what table.py --out wrote")
    parser.add_argument("--ties", default="exp2 dT 0", help="the row whose ties are printed")
    given = parser.parse_args()
    rows = [r for r in json.loads(given.answers.read_text())["classes"] if r["finish"] == "known"]
    print("\n| row | splits | accuracy | log loss | by twenties | must | reach it | predicted | below must |")
    print("|---|---|---|---|---|---|---|---|---|")
    for name, (conditions, until, must, _) in RATES.items():
        part = [r for r in rows if r["condition"] in conditions and r["until"] == until]
        print_row(name, part, must)
        if name == given.ties:
            tied = part
    print_ties(given.ties, tied)


def right(row: Row) -> bool:
    """Return whether the likeliest material is the true one."""
    return bool(max(row["p"], key=row["p"].get) == row["material"])


def print_row(name: str, rows: list[Row], must: float) -> None:
    """Print one row: what its splits say, and what its readings predict."""
    repeats = np.array([r["repeat"] for r in rows])
    correct = np.array([right(r) for r in rows])
    each = np.array([correct[repeats == k].mean() for k in np.unique(repeats)])
    twenties = each[: each.size // 20 * 20].reshape(-1, 20).mean(axis=1)
    predicted = drawn_labels(rows)
    loss = -np.mean([np.log(r["p"][r["material"]]) for r in rows])
    error = each.std(ddof=1) / np.sqrt(each.size)
    cells = [name, f"{each.size}", f"{each.mean():.3f} +- {error:.3f}", f"{loss:.3f}"]
    cells += [", ".join(f"{v:.3f}" for v in twenties), f"{must}"]
    cells += [f"{(twenties >= must).sum()} of {twenties.size}"]
    cells += [f"{predicted.mean():.3f} +- {predicted.std():.3f}", f"{(predicted < must).mean():.3f}"]
    print(f"| {' | '.join(cells)} |")


def drawn_labels(rows: list[Row], n: int = 20000) -> NDArray[np.float64]:
    """Return the row's accuracy (n,) were labels drawn from the engine's mean probabilities of each grasp."""
    of: dict[tuple[str, str], list[Row]] = defaultdict(list)
    for r in rows:
        of[r["condition"], r["grasp"]].append(r)
    rng, total = np.random.default_rng(0), np.zeros(n)
    for answers in of.values():
        names = list(answers[0]["p"])
        p = np.mean([[r["p"][m] for m in names] for r in answers], axis=0)
        said = np.mean([[max(r["p"], key=r["p"].get) == m for m in names] for r in answers], axis=0)
        total += len(answers) * said[rng.choice(len(names), size=n, p=p / p.sum())]
    return total / len(rows)


def print_ties(name: str, rows: list[Row]) -> None:
    """Print share and accuracy of answers by the distance between the two likeliest materials."""
    ordered = np.sort([list(r["p"].values()) for r in rows], axis=1)
    margin, correct = ordered[:, -1] - ordered[:, -2], np.array([right(r) for r in rows])
    print(f"\n| {name}: the likeliest two apart by | share of answers | distinct grasps | right |")
    print("|---|---|---|---|")
    for low, high in MARGINS:
        at = (margin >= low) & (margin < high)
        grasps = {r["grasp"] for r, inside in zip(rows, at) if inside}
        print(f"| {low} to {min(high, 1.0)} | {at.mean():.2f} | {len(grasps)} | {correct[at].mean():.2f} |")


if __name__ == "__main__":
    main()
