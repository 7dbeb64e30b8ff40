"""What the posterior engine reaches on the bundled grasps: accuracy, calibration, effusivity, open set.

    OMP_NUM_THREADS=1 python benchmarks/classify/table.py --out table.json

Prints Markdown.  Of every condition of exp1 to exp4, five grasps a material train, in 20 random splits, and
the gripper is calibrated on the training grasps of all conditions together, from a cold start: no split
knows anything of its test grasps, noise and structure included.  For the effusivities a material is left out
of the calibration altogether and all of its grasps are tested.

Rates stand with a standard error that counts distinct grasps, sqrt(p (1 - p) / m): all splits reuse the same
8 grasps a material, and the spread from split to split is not an interval.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import expit, logit, logsumexp

from thermogrip.classify.evaluation.metrics import auroc
from thermogrip.classify.evaluation.splits import plan_folds
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.materials import find_material
from thermogrip.datasets.schema import Grasps
from thermogrip.sysid.effusivity.calibration import calibrate_gripper
from thermogrip.sysid.effusivity.data import touches
from thermogrip.sysid.effusivity.gripper_model import GripperModel
from thermogrip.sysid.effusivity.posterior import (
    effusivity_posterior,
    material_evidence,
    material_posterior,
)
from thermogrip.sysid.effusivity.posterior_grid import grid_posteriors

Row = dict[str, Any]

FIVE = ["brass", "copper", "iron", "wood", "zinc"]
METALS, INSULATORS = ("copper", "brass", "zinc", "iron"), ("glass", "acrylic", "rubber", "cork")
PRIOR_UNKNOWN = 0.1  # probability of a material that is not among the five
OTHERS = "exp6_other_materials_obj43_grip23"
LONG = "exp4_cooled5_obj18_grip38_40s"
# name: (condition, seconds of contact), what must be reached, what hundreds of grasps teach a classifier
RATES: dict[str, tuple[tuple[str, ...], float | None, float, float]] = {
    "exp1A": (("exp1A_obj43_grip23",), None, 0.78, 0.83),
    "exp1B": (("exp1B_obj43_grip38",), None, 0.57, 0.66),
    "exp2 dT 0": (("exp2_dT00",), None, 0.54, 0.62),
    "exp2 dT 5": (("exp2_dT05",), None, 0.91, 0.92),
    "exp2 dT 10": (("exp2_dT10",), None, 0.95, 0.97),
    "exp2 dT 15": (("exp2_dT15",), None, 0.95, 0.98),
    "exp2 dT 20": (("exp2_dT20",), None, 0.95, 0.99),
    "exp3 A, B, C": (("exp3A_obj43_grip23", "exp3B_obj28_grip48", "exp3C_obj18_grip38"), None, 0.97, 0.99),
    "exp4, 10 s": ((LONG,), 10.0, 0.76, 0.79),
    "exp4, 40 s": ((LONG,), None, 0.84, 0.90),
}


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--splits", type=int, default=20)
    parser.add_argument("--out", type=Path, help="also write every answer here, as JSON")
    parser.add_argument("--only", choices=["classes", "effusivity"], help="one half of it")
    parser.add_argument("--quick", action="store_true", help="no open set: a third of the time")
    parser.add_argument(
        "--in-doubt", action="store_true", help="integrate over what the calibration leaves open"
    )
    given = parser.parse_args()
    files = load_example_grasps()
    found: dict[str, list[Row]] = {"classes": [], "open": [], "effusivity": []}
    if given.only != "effusivity":
        found |= classes(files, given.splits, open_too=not given.quick, in_doubt=given.in_doubt)
        print_classes(found["classes"])
        print_open(found["open"])
    if given.only != "classes":
        found["effusivity"] = effusivities(files)
        print_effusivities(found["effusivity"])
    if given.out:
        given.out.write_text(json.dumps(found))


def conditions(files: dict[str, Grasps]) -> list[Grasps]:
    """Return exp1 to exp4, whose nominal object temperature is known."""
    return [g for name, g in files.items() if name[:4] in ("exp1", "exp2", "exp3", "exp4")]


def classes(files: dict[str, Grasps], splits: int, *, open_too: bool, in_doubt: bool) -> dict[str, list[Row]]:
    """Return the answers about held-out grasps, and the open-set scores, of every split."""
    plan = plan_folds(conditions(files), split="random", repeats=splits, train_per_class=5, seed=0)
    rows: list[Row] = []
    strange: list[Row] = []
    for repeat, training in enumerate(plan.training):
        clock = time.process_time()
        device = replace(calibrate_gripper(training), uncertain=in_doubt)
        fitted = time.process_time() - clock
        for fold in (f for f in plan.folds if f.repeat == repeat):
            for until in (None, 10.0) if fold.condition == LONG else (None,):
                for finish in ("known", "unknown"):
                    rows += answers(device, fold.test, fold.candidates, repeat, until, finish)
            if open_too and fold.condition.startswith("exp1A"):
                for part, known in ((fold.test, True), (files[OTHERS], False)):
                    strange += open_answers(device, part, known, repeat)
        print(f"split {repeat}: fitted in {fitted:.1f} s", file=sys.stderr)
    return {"classes": rows, "open": strange}


def answers(
    device: GripperModel, test: Grasps, names: Iterable[str], repeat: int, until: float | None, finish: str
) -> list[Row]:
    """Return a row a grasp: the probability of each candidate."""
    candidates = list(names)
    p = material_posterior(device, test, candidates, until=until, finish=finish)
    return [
        {
            "repeat": repeat,
            "condition": str(test.attrs["name"]),
            "until": until,
            "finish": finish,
            "grasp": str(test["grasp"].values[i]),
            "material": str(test["material"].values[i]),
            "p": dict(zip(candidates, p[i].tolist())),
        }
        for i in range(p.shape[0])
    ]


def open_answers(device: GripperModel, grasps: Grasps, known: bool, repeat: int) -> list[Row]:
    """Return a row a grasp: the log Bayes factor of the five against any other material."""
    known_to_it = logsumexp(material_evidence(device, grasps, FIVE), axis=1) - np.log(len(FIVE))
    odds = known_to_it - [fit.log_evidence for fit in grid_posteriors(device, touches(grasps))]
    p_unknown = expit(logit(PRIOR_UNKNOWN) - odds)
    return [
        {
            "repeat": repeat,
            "grasp": str(grasps["grasp"].values[i]),
            "material": str(grasps["material"].values[i]),
            "known": known,
            "log_bayes_factor": float(odds[i]),
            "p_unknown": float(p_unknown[i]),
        }
        for i in range(grasps.sizes["grasp"])
    ]


def effusivities(files: dict[str, Grasps]) -> list[Row]:
    """Return found effusivities: materials left out of the calibration, finish unknown, 10 s of contact."""
    rows: list[Row] = []
    records = conditions(files)
    for left_out in FIVE:
        device = calibrate_gripper([g.isel(grasp=g["material"].values != left_out) for g in records])
        for g in records:
            part = g.isel(grasp=g["material"].values == left_out)
            if part.sizes["grasp"]:
                rows += effusivity_rows(device, part, "left out")
        print(f"without {left_out}", file=sys.stderr)
    device = calibrate_gripper(records)
    rows += effusivity_rows(device, files[OTHERS], "never shown")
    return rows


def effusivity_rows(device: GripperModel, grasps: Grasps, how: str) -> list[Row]:
    """Return a row a grasp: found effusivity, its interval, and the library's."""
    found = effusivity_posterior(device, grasps, until=10.0)
    differences = np.round(grasps["t_gripper"].values - grasps["t_object"].values)
    return [
        {
            "how": how,
            "grasp": row.grasp_id,
            "condition": str(grasps.attrs["name"]),
            "material": str(grasps["material"].values[i]),
            "dT": float(abs(differences[i])),
            "library": find_material(str(grasps["material"].values[i])).effusivity,
            "found": row.effusivity,
            "low": row.effusivity_p05,
            "high": row.effusivity_p95,
        }
        for i, row in enumerate(found)
    ]


def scored(rows: Iterable[Row]) -> dict[str, float]:
    """Return accuracy, its standard error over distinct grasps, log loss and stated confidence."""
    rows = list(rows)
    right = np.array([max(r["p"], key=r["p"].get) == r["material"] for r in rows], dtype=float)
    stated = np.array([max(r["p"].values()) for r in rows])
    loss = np.array([-np.log(max(r["p"][r["material"]], 1e-15)) for r in rows])
    grasps = len({(r["condition"], r["grasp"]) for r in rows})
    accuracy = float(right.mean())
    return {
        "grasps": grasps,
        "accuracy": accuracy,
        "error": float(np.sqrt(accuracy * (1 - accuracy) / grasps)),
        "loss": float(loss.mean()),
        "stated": float(stated.mean()),
    }


def print_classes(rows: list[Row]) -> None:
    """Print accuracy, log loss and calibration."""
    print("\n| row | grasps | accuracy | se | must | hundreds | log loss | stated |")
    print("|---|---|---|---|---|---|---|---|")
    known = [r for r in rows if r["finish"] == "known"]
    for name, (names, until, must, hundreds) in RATES.items():
        s = scored(r for r in known if r["condition"] in names and r["until"] == until)
        print(
            f"| {name} | {s['grasps']} | {s['accuracy']:.3f} | {s['error']:.3f} | {must} | {hundreds} "
            f"| {s['loss']:.3f} | {s['stated']:.3f} |"
        )
    other = scored(r for r in rows if r["finish"] == "unknown" and r["condition"].startswith("exp1A"))
    print(
        f"| exp1A, another block | {other['grasps']} | {other['accuracy']:.3f} | {other['error']:.3f} | 0.81 "
        f"| | {other['loss']:.3f} | {other['stated']:.3f} |"
    )
    print("\n| pooled | stated confidence | accuracy | difference |")
    print("|---|---|---|---|")
    pools = {
        "10 s": [r for r in known if r["condition"] != LONG or r["until"] == 10.0],
        "40 s": [r for r in known if r["condition"] == LONG and r["until"] is None],
    }
    for name, pool in pools.items():
        s = scored(pool)
        print(f"| {name} | {s['stated']:.3f} | {s['accuracy']:.3f} | {s['stated'] - s['accuracy']:+.3f} |")
        for low, high in ((0.0, 0.6), (0.6, 0.8), (0.8, 0.95), (0.95, 0.99), (0.99, 1.01)):
            part = [r for r in pool if low <= max(r["p"].values()) < high]
            if part:
                b = scored(part)
                print(
                    f"| {name}, {low:g} to {min(high, 1):g} ({len(part)}) | {b['stated']:.3f} "
                    f"| {b['accuracy']:.3f} | {b['stated'] - b['accuracy']:+.3f} |"
                )


def print_open(rows: list[Row]) -> None:
    """Print how well other materials are separated from the five."""
    if not rows:
        return
    home = [r for r in rows if r["known"]]
    print("\n| other material | AUROC | mean p_unknown |")
    print("|---|---|---|")
    for material in sorted({r["material"] for r in rows if not r["known"]}):
        away = [r for r in rows if r["material"] == material and not r["known"]]
        repeats = sorted({r["repeat"] for r in away})
        area = np.mean(
            [
                auroc(
                    [-r["log_bayes_factor"] for r in home if r["repeat"] == k],
                    [-r["log_bayes_factor"] for r in away if r["repeat"] == k],
                )
                for k in repeats
            ]
        )
        print(f"| {material} | {area:.3f} | {np.mean([r['p_unknown'] for r in away]):.3f} |")
    held = np.array([r["p_unknown"] for r in home])
    print(f"| (held-out grasps of the five) | | {held.mean():.3f}, over 0.5: {(held > 0.5).mean():.3f} |")


def print_effusivities(rows: list[Row]) -> None:
    """Print errors of log10 effusivity, and how often the 90 % intervals cover the library's value."""
    print("\n| effusivity | grasps | rms log10 error | mean | 90 % interval covers | width in log10 |")
    print("|---|---|---|---|---|---|")
    blocks = {
        "metals, dT 20": [r for r in rows if r["material"] in METALS and r["dT"] == 20],
        "metals, dT 10 and 15": [r for r in rows if r["material"] in METALS and r["dT"] in (10, 15)],
        "metals, dT 5": [r for r in rows if r["material"] in METALS and r["dT"] == 5],
        "four insulators, wood as scale": [r for r in rows if r["material"] in INSULATORS],
    }
    blocks |= {
        f"{m}, dT 20": [r for r in rows if r["material"] == m and r["dT"] == 20]
        for m in (*METALS, "wood", *INSULATORS, "stainless", "aluminium")
    }
    for name, part in blocks.items():
        if not part:
            continue
        error = np.log10([r["found"] / r["library"] for r in part])
        inside = np.mean([r["low"] < r["library"] < r["high"] for r in part])
        width = np.mean([np.log10(r["high"] / r["low"]) for r in part])
        print(
            f"| {name} | {len(part)} | {np.sqrt((error**2).mean()):.3f} | {error.mean():+.3f} "
            f"| {inside:.2f} | {width:.2f} |"
        )


if __name__ == "__main__":
    main()
