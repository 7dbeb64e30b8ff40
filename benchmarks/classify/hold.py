"""Six objects held by a fluid-filled finger: pairs of holds left out, with the level and without.

    python benchmarks/classify/hold.py FOLDER [--classifiers A,B] [--out F.json]

FOLDER holds ``OBJECT_NUMBER_TRIAL_HOLD.mat`` of github joshsia/haptics-classification (``data/``), read by
``thermogrip.datasets.public_sets``.  The data are not part of this package.

The rule, written down before the first look at a trace.  Each object was held ten times in a row.  Holds 1
and 2 of every object are left out together, then 3 and 4, and so on: five folds of 48 holds that train and 12
that test, all 60 tested once.  Two holds in turn are alike, so no hold is tested beside its partner.
Temperature of finger 0 alone, all samples of it.  Everything is chosen within the 48; the classifiers are
those of ``make_classifier`` with their defaults, and nothing in them is chosen with these holds in view.
Ten in a row of one object also means that the level from which the finger starts tells the object: so
all is scored twice, as published, and with each trace less its first 0.1 s.  The second is the one that
says something about touch.  Beside both stands the leak probe, which is given nothing but that level.

Nobody published temperatures of objects or room: the objects are taken to have been at 23 +- 1 degC, in every
classifier that reads it.  Less its level, a trace begins at 49 degC, as about all did.  ``acrylic`` alone is
in the materials table; the posterior learns the other objects from their grasps beside it.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from ambiguous import Traces

from thermogrip.classify import evaluate, make_classifier
from thermogrip.datasets.public_sets import read_hold
from thermogrip.datasets.schema import Grasps

OURS, PEERS = "posterior,bayes,features-lda,expansions,vote", "svm-pca,pca-lda,forest,logistic-pca,rocket"
ROOM, ROOM_SD, START = 23.0, 1.0, 49.0  # degC
PATHS = {"forest": "sklearn.ensemble:RandomForestClassifier", "vote": "expansions+rocket"}


def without_level(grasps: Grasps) -> Grasps:
    """Return the holds as if all had begun at the same level."""
    shift = START - grasps["t_gripper"]
    return grasps.assign(t_surface=grasps["t_surface"] + shift, t_gripper=grasps["t_gripper"] + shift)


def main() -> None:
    """Evaluate, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--classifiers", default=f"{OURS},{PEERS}")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    holds = read_hold(given.folder)
    n = holds.sizes["grasp"]
    holds = holds.assign(t_object=("grasp", np.full(n, ROOM)), t_object_sd=("grasp", np.full(n, ROOM_SD)))
    cases = {"as published": holds, "without the level": without_level(holds)}
    rows = []
    for case, grasps in cases.items():
        models = {
            name: Traces() if name == "logistic-pca" else make_classifier(PATHS.get(name, name), seed=0)
            for name in given.classifiers.split(",")
        }
        found = evaluate(models, [grasps], split="session")
        for note in found.notes:
            print(note)
        for leak in (row for row in found.leaks if row["leak"] or row["classifier"] == "untouched traces"):
            print(
                f"{case}: probe {leak['classifier']}: {leak['accuracy']:.2f} right without a touch (chance "
                f"{leak['chance']:.2f}, p {leak['p_value']:.1g}){': a leak' * leak['leak']}"
            )
        for row in found.scores():
            rows.append({"case": case} | row)
            print(
                f"{case}  {row['classifier']:13} {row['accuracy']:.3f} "
                f"({row['low']:.2f} to {row['high']:.2f})  log loss {row['log_loss']:.3f} "
                f"({row['log_loss_low']:.3f} to {row['log_loss_high']:.3f})  stated {row['confidence']:.3f}",
                flush=True,
            )
        for d in found.differences(found.conditions[0]):
            if d["first"] in OURS.split(",") and d["second"] in PEERS.split(","):
                print(
                    f"    {d['first']} less {d['second']}: {d['test']} p = {d['p_value']:.2f}, log loss "
                    f"{d['log_loss_difference']:+.3f} ({d['log_loss_low']:+.3f} to {d['log_loss_high']:+.3f})"
                )
    if given.out:
        given.out.write_text(json.dumps(rows), encoding="utf-8")


if __name__ == "__main__":
    main()
