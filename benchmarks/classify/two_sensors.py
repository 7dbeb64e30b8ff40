"""Contacts with two sensors, one heated: the pool on derivatives beside SVM with PCA and MiniRocket.

    python benchmarks/classify/two_sensors.py FOLDER [--sensors heated] [--classifiers A,B] [--out F.json]

FOLDER holds ``two_sensor_contacts.csv.gz`` and ``two_sensor_contacts_meta.csv``: 180 contacts of aluminium,
wood and cooled wood by Clever et al. (github Healthcare-Robotics/thermal-ambiguity-ToH, MIT; IEEE Trans.
Haptics, arXiv 2012.02176) at 20 Hz, with the columns ``grasp,time_s,t_heated_degC,t_passive_degC`` and
``grasp,set,material``.  The data are not part of this package.  Each of the 20 sets is held out in turn;
whatever a classifier chooses, it chooses within the other 19.  Intervals count contacts; contacts of one set
are not independent, so they are too short.

``nested`` is the pool of expansions as a grid in octaves (windows, degrees, components, strengths), 168
machines, of which the 19 training sets choose with whole sets held out, the rule of choice included.  The
grid was written down before it was scored here.  ``expansions`` is the pool of 30 that was settled on with
scores of these contacts in view.  ``vote`` is the mean of the probabilities of ``nested`` and ``rocket``,
with equal weights, so that nothing is chosen.
"""

from __future__ import annotations

import argparse
import csv
import gzip
import json
from collections import defaultdict
from pathlib import Path

import numpy as np

from thermogrip.classify import GraspClassifier, evaluate, make_classifier
from thermogrip.classify.estimators.local_polynomials import ExpansionClassifier
from thermogrip.classify.estimators.registry import VoteClassifier
from thermogrip.classify.evaluation.harness import cut_at
from thermogrip.datasets.public_sets import read_toh
from thermogrip.datasets.schema import Grasps, make_grasps

CASES = (("both", 1.0), ("both", 2.0), ("both", 4.0), ("heated", 4.0))


def read(folder: Path) -> Grasps:
    """Return all contacts as one record, a set as a session, of the two files or the published folder."""
    if (folder / "R_1").is_dir():
        return read_toh(folder)
    with open(folder / "two_sensor_contacts_meta.csv", newline="", encoding="utf-8") as file:
        about = {row["grasp"]: row for row in csv.DictReader(file)}
    traces: dict[str, list[tuple[float, float, float]]] = defaultdict(list)
    with gzip.open(folder / "two_sensor_contacts.csv.gz", "rt", newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            sample = (row["time_s"], row["t_heated_degC"], row["t_passive_degC"])
            traces[row["grasp"]].append(tuple(map(float, sample)))
    cube = np.array([traces[name] for name in about])
    return make_grasps(
        cube[0, :, 0],
        cube[:, :, 1],
        [f"contact{name}" for name in about],
        t_surface_2=cube[:, :, 2],
        material=[row["material"] for row in about.values()],
        session=[f"set{row['set']}" for row in about.values()],
        name="two_sensor_contacts",
    )


def make(name: str) -> GraspClassifier:
    """Return a classifier by name."""
    if name == "nested":
        return ExpansionClassifier(pool="wide", rule="nested")
    if name == "vote":
        return VoteClassifier([make("nested"), make("rocket")])
    return make_classifier(name, seed=0)


def main() -> None:
    """Evaluate, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--classifiers", default="vote,nested,expansions,svm-pca,rocket")
    parser.add_argument("--sensors", choices=("both", "heated"), help="these cases alone")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    every, rows = read(args.folder), []
    print("sensors, s  classifier    accuracy (95 %)          log loss (95 %)        stated")
    for sensors, seconds in CASES:
        if args.sensors not in (None, sensors):
            continue
        grasps = cut_at(every, seconds)
        if sensors == "heated":
            grasps = grasps.drop_vars("t_surface_2")
        models = {name: make(name) for name in args.classifiers.split(",")}
        found = evaluate(models, [grasps], split="session", probe=False)
        condition = found.conditions[0]
        for row in found.scores():
            rows.append({"sensors": sensors, "seconds": seconds} | row)
            print(
                f"{sensors:7} {seconds:g}   {row['classifier']:12}  {row['accuracy']:.3f} "
                f"({row['low']:.3f} to {row['high']:.3f})  {row['log_loss']:.4f} "
                f"({row['log_loss_low']:.4f} to {row['log_loss_high']:.4f})  {row['confidence']:.3f}",
                flush=True,
            )
        for d in found.differences(condition):
            print(
                f"    {d['first']} less {d['second']}: {d['test']} p = {d['p_value']:.2f}, log loss "
                f"{d['log_loss_difference']:+.4f} ({d['log_loss_low']:+.4f} to {d['log_loss_high']:+.4f})"
            )
    if args.out:
        args.out.write_text(json.dumps(rows), encoding="utf-8")


if __name__ == "__main__":
    main()
