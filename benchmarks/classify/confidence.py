"""Are stated confidences true, and do block temperatures have a heavier tail than the normal one?

    OMP_NUM_THREADS=1 python benchmarks/classify/confidence.py --comparison comparison/posterior.json

- bands: right answers beside stated confidence in bands of it, on the example grasps (a comparison that
  ``compare_classifiers.py`` wrote), with an interval that draws whole grasps anew, and how often a
  forecaster whose confidences are true lies as far off;
- population: the same where grippers that five simulated grasps of each material and condition have taught
  name fresh grasps of the population they came from;
- finite: the same on grasps by finite volumes, which are no model of the engine;
- tails: of the shipped training grasps, errors of the nominal temperatures, material known: -2 ln likelihood
  of populations with heavier and lighter tails than the normal one, of one spread for each file, and of an
  error that all grasps of a material in a file share.

No test grasp of the example files is used for the tails.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from finite_volumes import labelled
from no_difference import CONDITIONS, FIVE
from scipy import stats
from scipy.optimize import minimize, minimize_scalar

from thermogrip.classify.evaluation.metrics import grasp_counts
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.sysid.contact.simulation import simulate_grasps
from thermogrip.sysid.effusivity.calibration import calibrate_gripper
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
from thermogrip.sysid.effusivity.posterior import material_fit, material_posterior

BANDS = ((0.0, 0.5), (0.5, 0.6), (0.6, 0.8), (0.8, 0.9), (0.9, 0.99), (0.99, 1.0))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--comparison", type=Path, help="posterior.json of compare_classifiers.py")
    parser.add_argument("--refits", type=int, default=4, help="made training sets; 0 for none")
    given = parser.parse_args()
    if given.comparison:
        rows = json.loads(given.comparison.read_text())["predictions"]
        answers = [
            (r["confidence"], r["correct"], (r["condition"], r["grasp_id"]))
            for r in rows
            if r["classifier"] == "posterior"
        ]
        bands("example grasps", answers)
    if given.refits:
        bands("fresh grasps of the population", population(given.refits))
        bands("finite volumes", finite(given.refits))
    tails()


def bands(title, answers):
    """Print right answers and stated confidence by band of confidence."""
    stated, right = (np.array([a[k] for a in answers], dtype=float) for k in (0, 1))
    _, of = np.unique([str(a[2]) for a in answers], return_inverse=True)
    m = int(of.max()) + 1
    counts, luck = grasp_counts(m), np.random.default_rng(1).random((1000, m))
    print(
        f"\n{title}: {m} grasps, {right.size} answers; stated {stated.mean():.3f}, right {right.mean():.3f}\n"
    )
    print("| stated | grasps | mean | right (95 %) | as far off by chance |\n|---|---|---|---|---|")
    for low, high in BANDS:
        at = (stated > low) & (stated <= high)
        if not at.any():
            continue
        hits, tests = (np.bincount(of[at], weights=w, minlength=m) for w in (right[at], np.ones(at.sum())))
        drawn = (counts @ hits) / np.maximum(counts @ tests, 1e-9)
        ends = np.quantile(drawn[counts @ tests > 0], [0.025, 0.975])
        gap = right[at].mean() - stated[at].mean()
        true = np.array([(row[of[at]] < stated[at]).mean() for row in luck]) - stated[at].mean()
        p = np.mean(np.abs(true) >= abs(gap) - 1e-12)
        print(
            f"| {low:g} to {high:g} | {np.count_nonzero(tests)} | {stated[at].mean():.3f} "
            f"| {right[at].mean():.3f} ({ends[0]:.2f} to {ends[1]:.2f}) | {p:.2f} |"
        )


def named(device, record, names, key):
    """Return (confidence, right, grasp) of each grasp."""
    p = material_posterior(device, record, names)
    right = np.array(names)[p.argmax(axis=1)] == record["material"].values
    return [(c, ok, (*key, i)) for i, (c, ok) in enumerate(zip(p.max(axis=1), right))]


def population(refits, fresh=20):
    """Return the answers of grippers that were taught by simulated grasps, on fresh ones."""
    device, answers = load_default_gripper(), []
    for k in range(refits):

        def drawn(i, repeats, seed):
            warm, grip, names, end = CONDITIONS[i]
            kind = {"t_gripper": float(grip), "t_object": float(warm), "end": float(end)}
            return simulate_grasps(
                device.grip(), names, n=repeats, seed=seed + i, **kind, **device.readings()
            )

        seed = 50000 + 100 * k
        learnt = calibrate_gripper([drawn(i, 5, seed) for i in range(len(CONDITIONS))])
        for i, condition in enumerate(CONDITIONS):
            answers += named(learnt, drawn(i, fresh, seed + 50), condition[2], (k, i))
    return answers


def finite(refits, fresh=24):
    """Return the answers about grasps by finite volumes of grippers that other such grasps have taught."""
    answers = []
    for k in range(refits):
        learnt = calibrate_gripper(labelled(tuple(FIVE), repeats=5, seed=300 + 2 * k))
        for i, record in enumerate(labelled(tuple(FIVE), repeats=fresh, seed=301 + 2 * k)):
            answers += named(learnt, record, FIVE, (k, i))
    return answers


def nominal_errors():
    """Return the error of each training block's nominal temperature, its variance, the file, the material."""
    device, rows = load_default_gripper(), []
    for name, record in load_example_grasps().items():
        if name[:4] not in ("exp1", "exp2", "exp3", "exp4"):
            continue
        train = record.isel(grasp=record["split"].values == "train")
        names = sorted(set(train["material"].values.tolist()))
        fit = material_fit(device, train, names, until=10.0)
        for i, material in enumerate(train["material"].values):
            k = names.index(material)
            prior, found = fit.prior_t_object_sd[i, k] ** 2, fit.t_object_sd[i, k] ** 2
            share = 1 - found / prior  # of what the grasp itself says
            if share > 0.01:
                off = (fit.t_object[i, k] - fit.prior_t_object[i, k]) / share
                rows.append((off, found / share, name, (name, material)))
    return rows


def tails():
    """Print how well populations of another form describe the nominal temperatures' errors."""
    rows = nominal_errors()
    off, variance = np.array([r[0] for r in rows]), np.array([r[1] for r in rows])
    grid = np.linspace(-3, 3, 1201)

    def least(of, family):
        likelihood = stats.norm.pdf(off[of, None], grid, np.sqrt(variance[of])[:, None])

        def minus(log_scale):
            scale = np.exp(log_scale)
            return -2 * np.log(likelihood @ family.pdf(grid / scale) / scale * (grid[1] - grid[0])).sum()

        found = minimize_scalar(minus, bounds=(-3, 1), method="bounded")
        return float(found.fun), float(np.exp(found.x))

    every = np.arange(off.size)
    normal, sd = least(every, stats.norm)
    print(f"\n{off.size} training blocks, nominal temperatures: sd {sd:.3f} K, largest of those", end=" ")
    print(f"known to 0.2 K {np.abs(off[variance < 0.04]).max():.2f} K\n")
    print("| population | -2 ln likelihood, to the normal one |\n|---|---|")
    for nu in (3, 5, 10, 30):
        print(f"| Student's t, {nu} | {least(every, stats.t(nu))[0] - normal:+.1f} |")
    print(f"| lighter: exp(-abs(x)^3) | {least(every, stats.gennorm(3))[0] - normal:+.1f} |")
    files = [r[2] for r in rows]
    own = sum(least(np.flatnonzero(np.array(files) == f), stats.norm)[0] for f in set(files)) - normal
    p = stats.chi2.sf(-own, len(set(files)) - 1)
    print(f"| a spread for each file | {own:+.1f} (p = {p:.2f}) |")
    for title, column in (("file", 2), ("material in a file", 3)):
        common = shared([r[column] for r in rows], off, variance)
        print(f"| an error shared by each {title} | {common:+.1f} |")


def shared(group, off, variance):
    """Return what a common error of each group gains in -2 ln likelihood."""
    members = [np.flatnonzero([g == name for g in group]) for name in dict.fromkeys(group)]

    def minus(p):
        s2, tau2 = np.exp(2 * np.asarray(p))
        parts = [(off[m], np.diag(variance[m] + s2) + tau2) for m in members]
        return -2 * sum(stats.multivariate_normal.logpdf(x, np.zeros(x.size), c) for x, c in parts)

    alone = minimize(lambda p: minus([p[0], -12.0]), [-1.0], method="Nelder-Mead").fun
    return float(minimize(minus, [-1.0, -2.3], method="Nelder-Mead").fun - alone)


if __name__ == "__main__":
    main()
