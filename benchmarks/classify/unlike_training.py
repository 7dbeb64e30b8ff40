"""Contacts that last longer than those of the training, and stop rules from few grasps, by finite volumes.

    OMP_NUM_THREADS=1 python benchmarks/classify/unlike_training.py [--parts long,stop] [--sets 24]

- long: 25 contacts of 10 s teach the gripper; 60 fresh ones of 10 to 120 s are read as long as those, and
  whole;
- stop: 25 contacts teach gripper and stop rule, 100 fresh ones are stopped by it; by what the training grasps
  got wrong and the classifier's own expectation, and by the first alone.
"""

from __future__ import annotations

import argparse

import numpy as np
from finite_volumes import labelled

from thermogrip.classify.decisions import stopping_rule
from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.datasets.materials import find_material
from thermogrip.sysid.effusivity.posterior import effusivity_posterior

FIVE = ("brass", "copper", "iron", "wood", "zinc")
WARM = ((43.0, 23.0),)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--parts", default="long,stop")
    parser.add_argument("--sets", type=int, default=24, help="trainings of the stop rules")
    given = parser.parse_args()
    for part in given.parts.split(","):
        PARTS[part](given.sets)


def longer(sets: int) -> None:
    """Print accuracy, stated confidence and how often 90 % intervals cover, by length of contact."""
    del sets
    known = PosteriorClassifier().fit(labelled(FIVE, repeats=5, seed=700, conditions=WARM))
    taught, names = known.longest_, known.classes_.tolist()
    print("\n| contact [s] | read [s] | right | stated | 90 % intervals of e hold |\n|---|---|---|---|---|")
    for seconds in (10.0, 20.0, 40.0, 120.0):
        (test,) = labelled(FIVE, repeats=12, seed=701, conditions=WARM, seconds=seconds)
        label = test["material"].values.tolist()
        e = [find_material(name).effusivity for name in label]
        for read in dict.fromkeys((min(taught, seconds), seconds)):
            known.longest_ = read
            p = np.exp(known.candidate_log_proba(test, names))
            right = np.mean(np.array(names)[p.argmax(axis=1)] == label)
            found = effusivity_posterior(known.device_, test, until=read)
            inside = np.mean([row.effusivity_p05 <= x <= row.effusivity_p95 for row, x in zip(found, e)])
            stated = p.max(axis=1).mean()
            print(f"| {seconds:g} | {read:g} | {right:.2f} | {stated:.2f} | {inside:.2f} |", flush=True)


def stop(sets: int) -> None:
    """Print how many of the contacts that a rule ended early it named wrong."""
    both = stopping_rule._early
    found: dict[tuple[str, float], list[tuple[int, int, float]]] = {}
    for k in range(sets):
        (train,) = labelled(FIVE, repeats=5, seed=800 + 2 * k, conditions=WARM)
        (test,) = labelled(FIVE, repeats=20, seed=801 + 2 * k, conditions=WARM)
        known = PosteriorClassifier().fit([train])
        seen = []
        for part in (train, test):
            windows = stopping_rule.growing_windows(known, part, candidates=FIVE, gain=False)
            seen.append((windows, np.array([FIVE.index(m) for m in part["material"].values])))
        for how in ("errors and own expectation", "errors alone"):
            stopping_rule._early = both if how == "errors and own expectation" else _without_expectation(both)
            for error in (0.1, 0.2):
                rule = stopping_rule.learn_from_windows(seen[:1], error=error)
                ended = stopping_rule.stops(rule, seen[1][0])
                wrong = ended.early & (ended.answer != seen[1][1])
                row = int(wrong.sum()), int(ended.early.sum()), float(ended.time.mean())
                found.setdefault((how, error), []).append(row)
        stopping_rule._early = both
    print("\n| rule | stated error | wrong of those ended early | worst training | mean time [s] |")
    print("|---|---|---|---|---|")
    for (how, error), rows in found.items():
        wrong, early, time = np.array(rows).T
        worst = (wrong / np.maximum(early, 1)).max()
        print(f"| {how} | {error:g} | {wrong.sum() / early.sum():.3f} | {worst:.2f} | {time.mean():.2f} |")


def _without_expectation(early):
    def counted(rule, parts):
        wrong, expected = early(rule, parts)
        return wrong, 0.0 * expected

    return counted


PARTS = {"long": longer, "stop": stop}

if __name__ == "__main__":
    main()
