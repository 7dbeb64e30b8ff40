"""Naming materials where gripper and object are equally warm: what limits it, and what is luck.

    OMP_NUM_THREADS=1 python benchmarks/classify/no_difference.py [--sets 200] [--refits 6] [--generic 60]

- temperatures: of the shipped training grasps, how far the blocks miss their nominal temperatures, by
  file; whether they follow the room's sensor or the gripper's own error;
- shapes: of the same grasps, how far the readings lie from what the model expects of them, chi2 by file; and
  the significance of a dozen shapes that it lacks (drifts towards set point, room or block, steps at contact,
  growing misfits);
- shared: an error of one nuisance that all grasps of a file, or of a material in a file, have in common: its
  standard deviation and what it gains in -2 ln likelihood;
- tails: of ln h, build-up time, onset and block temperature of those grasps, what Student's t gains over a
  normal population, the scale free in both;
- integrals: Laplace's method beside a sum over 3000 points, on grasps drawn from the populations;
- sets: 24 grasps (copper, iron, wood) drawn from the bundled gripper's populations, as many as exp2 dT 0 has,
  and named by the engine that knows them; and 40 of five materials 5 K apart, as in exp1B;
- refits: the same by grippers that were calibrated on five simulated grasps of each material and condition;
- generic: a support vector machine on principal components on such sets of 24, 5/3 splits as in the table.

No test grasp of the example files is looked at.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy import stats
from scipy.optimize import minimize_scalar
from scipy.special import logsumexp

from thermogrip.classify import evaluate, make_classifier
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.sysid.contact.simulation import simulate_grasps
from thermogrip.sysid.effusivity.calibration import calibrate_gripper
from thermogrip.sysid.effusivity.data import noise_covariance, touches, whiten
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
from thermogrip.sysid.effusivity.laplace_approximation import (
    BUILD_UP,
    CAPACITY,
    EFFUSIVITY,
    LEVEL,
    ONSET,
    T_OBJECT,
    H,
    Hypotheses,
    fit_pairs,
    jacobian,
    material_hypotheses,
    nodes_for,
    prior_of,
)
from thermogrip.sysid.effusivity.posterior import material_evidence, material_fit
from thermogrip.sysid.effusivity.posterior_grid import slipped

THREE, FIVE = ["copper", "iron", "wood"], ["brass", "copper", "iron", "wood", "zinc"]
# object, gripper [degC], materials, contact time [s]: exp1 to exp4
CONDITIONS = (
    (43, 23, FIVE, 10), (43, 38, FIVE, 10), (28, 28, THREE, 10), (28, 33, THREE, 10), (28, 38, THREE, 10),
    (28, 43, THREE, 10), (28, 48, THREE, 10), (43, 23, THREE, 10), (28, 48, THREE, 10), (18, 38, THREE, 10),
    (18, 38, FIVE, 40),
)  # fmt: skip
MUST = 0.54
REST = [H, BUILD_UP, ONSET, EFFUSIVITY, CAPACITY]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", type=int, default=200)
    parser.add_argument("--refits", type=int, default=6)
    parser.add_argument("--generic", type=int, default=60)
    given = parser.parse_args()
    device = load_default_gripper()
    temperatures(device)
    shapes(device)
    shared(device)
    tails(device)
    integrals(device)
    sets(device, given.sets)
    refits(device, given.refits)
    generic(device, given.generic)


def training():
    """Yield name and shipped training grasps of exp1 to exp4."""
    for name, record in load_example_grasps().items():
        if name[:4] in ("exp1", "exp2", "exp3", "exp4"):
            yield name, record.isel(grasp=record["split"].values == "train")


def temperatures(device):
    """Print how far blocks miss their nominal temperatures, and what that follows."""
    rows = []
    for name, train in training():
        names = sorted(set(train["material"].values.tolist()))
        own = np.array([names.index(m) for m in train["material"].values])
        fit, each = material_fit(device, train, names), np.arange(own.size)
        expected = fit.prior_t_object[each, own]
        nominal, room = train["t_object"].values, train["t_ambient"].values
        level = train["t_surface"].values[:, train["time"].values < -0.25].mean(axis=1)
        missed = fit.t_object[each, own] - expected
        spread = np.sqrt((missed**2 + fit.t_object_sd[each, own] ** 2).mean())
        print(f"{name}: {own.size} blocks miss the expected temperature by {spread:.2f} K")
        rows.append(np.stack([nominal, missed, room - nominal, level - train["t_gripper"].values]))
    nominal, missed, room, error = np.concatenate(rows, axis=1)
    at = nominal == 28
    design = np.stack([np.ones(at.sum()), room[at], error[at]], axis=1)
    slope = np.linalg.lstsq(design, missed[at], rcond=None)[0]
    left = missed[at] - design @ slope
    sd = np.sqrt(np.diag(np.linalg.inv(design.T @ design)) * left.var(ddof=3))
    print(f"blocks at room temperature, {at.sum()}: slope on room {slope[1]:+.2f} +- {sd[1]:.2f} ", end="")
    print(f"(beyond the model's {device.transit_loss:.2f}), ", end="")
    print(f"on the gripper's error {slope[2]:+.2f} +- {sd[2]:.2f}")


def expected(device, grasps):
    """Return touches, mode, prior and the expansion of the readings, each grasp as its own material."""
    data, names = touches(grasps), sorted(set(grasps["material"].values.tolist()))
    own = [names.index(m) for m in grasps["material"].values]
    hypotheses = Hypotheses(*(h[own] for h in material_hypotheses(device, names)))
    mode = fit_pairs(device, data, np.arange(len(own)), hypotheses)
    prior = prior_of(device, data, hypotheses)
    found = jacobian(device.stack, nodes_for(data), data, mode.u, prior.sd > 0)
    return data, mode, prior, *found


def left_over(device, grasps):
    """Return touches, nuisances, derivatives, what the prior's means leave of the readings, its precision."""
    data, mode, prior, reading, by_u = expected(device, grasps)
    by_w = by_u * prior.sd[:, None, :]
    w = np.divide(mode.u - prior.mean, prior.sd, out=np.zeros_like(mode.u), where=prior.sd > 0)
    left = (data.y - reading + np.einsum("nik,nk->ni", by_w, w)) * (data.count > 0)
    inverse = np.linalg.inv(noise_covariance(data, device.noise) + by_w @ by_w.transpose(0, 2, 1))
    return data, mode.u, by_u, left, inverse


def shapes(device):
    """Print chi2 of the readings by file, and the significance of shapes that the model lacks."""
    total = {}
    for name, train in training():
        data, u, _, left, inverse = left_over(device, train)
        there = data.count > 0
        freedom = there.sum() - data.level.size  # the level before contact is fitted
        chi2 = np.einsum("ni,nij,nj->", left, inverse, left)
        print(f"{name}: chi2 / n {chi2 / freedom:.3f} +- {np.sqrt(2 / freedom):.3f}")
        for what, shape in lacking(data, u, train["t_gripper"].values).items():
            shape = shape * there
            news = (
                np.einsum("ni,nij,nj->", shape, inverse, left),
                np.einsum("ni,nij,nj->", shape, inverse, shape),
            )
            total[what] = total.get(what, 0.0) + np.array(news)
    print("z: " + ", ".join(f"{what} {s / np.sqrt(i):+.1f}" for what, (s, i) in total.items()))


def lacking(data, u, set_point):
    """Return shapes of readings that a gripper might show and the model does not, each (n, n_bin)."""
    level, block = u[:, LEVEL], u[:, T_OBJECT]
    after = np.maximum(data.t, 0.0)
    touching = (data.t > 0) * 1.0
    to_set, to_room, to_block = (
        x[:, None] for x in (set_point - level, data.t_ambient - level, block - level)
    )
    return {
        "to set point, t": to_set * data.ramp,
        "to set point, sqrt t": to_set * np.sqrt(after),
        "to room, t": to_room * data.ramp,
        "to room, sqrt t": to_room * np.sqrt(data.ramp),
        "to room once touched, t": to_room * after,
        "block to room, t": (data.t_ambient - block)[:, None] * after,
        "same for all, t": data.ramp,
        "same for all, sqrt t": np.sqrt(after),
        "step at contact": touching,
        "pulse at contact": touching * np.exp(-after / 0.5),
        "misfit, t": to_block * after,
        "misfit, sqrt t": to_block * np.sqrt(after),
        "misfit, early": to_block * touching * np.exp(-after),
    }


def shared(device):
    """Print the sd of an error that grasps of a group share, and its gain in -2 ln likelihood."""
    news = {}
    for name, train in training():
        _, _, by_u, left, inverse = left_over(device, train)
        score = np.einsum("nik,nij,nj->nk", by_u, inverse, left)
        information = np.einsum("nik,nij,njk->nk", by_u, inverse, by_u)
        for i, material in enumerate(train["material"].values.tolist()):
            sums = news.setdefault((name, material), np.zeros((2, score.shape[1])))
            sums += score[i], information[i]
    for what, k in (("ln h", H), ("ln tau_b", BUILD_UP), ("onset", ONSET), ("T_obj", T_OBJECT)):
        for group, size in (("file", 1), ("material in a file", 2)):
            for materials, left_out in (("all", ""), ("metals", "wood")):
                groups = {}
                for key, sums in news.items():
                    if key[1] != left_out:
                        groups[key[:size]] = groups.get(key[:size], 0.0) + sums[:, k]
                s, i = np.array([*groups.values()]).T

                def cost(ln_sd, s=s, i=i):
                    v = np.exp(2 * ln_sd)
                    return float((np.log1p(v * i) - s**2 * v / (1 + v * i)).sum())

                best = minimize_scalar(cost, bounds=(-8.0, 0.5), method="bounded")
                print(f"{what}, {group}, {materials}: sd {np.exp(best.x):.3f}, -2 ln L {best.fun:+.1f}")


def tails(device):
    """Print -2 ln likelihood of Student's t as a population less that of a normal one."""
    found = [expected(device, train)[1:3] for _, train in training()]
    mean, sd = (np.concatenate([getattr(prior, what) for _, prior in found]) for what in ("mean", "sd"))
    at = np.concatenate([mode.u for mode, _ in found]) - mean
    variance = np.concatenate([np.einsum("nii->ni", mode.covariance) for mode, _ in found])
    x = np.linspace(-8, 8, 4001)
    for what, k in (("ln h", H), ("ln tau_b", BUILD_UP), ("onset", ONSET), ("T_obj", T_OBJECT)):
        left = np.clip(variance[:, k] / sd[:, k] ** 2, 1e-4, 0.999)  # posterior over prior
        precision = 1 / left - 1  # of the readings alone
        z = at[:, k] / sd[:, k] / left / precision
        likelihood = np.exp(-0.5 * precision[:, None] * (x - z[:, None]) ** 2)

        def cost(ln_scale, density, likelihood=likelihood):
            each = likelihood @ density(x * np.exp(-ln_scale)) * np.exp(-ln_scale) * (x[1] - x[0])
            return -2 * float(np.log(each).sum())

        def least(density, cost=cost):
            return minimize_scalar(cost, bounds=(-1.0, 0.7), args=(density,), method="bounded").fun

        normal = least(stats.norm.pdf)
        gains = [f"{nu}: {least(stats.t(nu).pdf) - normal:+.1f}" for nu in (3, 5, 10, 30)]
        print(f"{what}, {(left < 0.3).sum()} informative grasps: Student's t with {', '.join(gains)}")


def integrals(device):
    """Print what Laplace's method leaves out of the evidence, and what that does to probabilities."""
    for what, grasps in (
        ("no difference", drawn(device, 30, 1)),
        (
            "5 K",
            simulate_grasps(
                device.grip(), FIVE, n=12, t_gripper=38.0, t_object=43.0, seed=2, **device.readings()
            ),
        ),
    ):
        names = sorted(set(grasps["material"].values.tolist()))
        data = touches(grasps)
        row = np.repeat(np.arange(data.level.size), len(names))
        one = material_hypotheses(device, names)
        hypotheses = Hypotheses(*(np.tile(h, data.level.size) for h in one))
        mode, prior = fit_pairs(device, data, row, hypotheses), prior_of(device, data.take(row), hypotheses)
        summed = np.array([summed_evidence(device, data, mode, prior, k, r) for k, r in enumerate(row)])
        p = [
            np.exp(z - logsumexp(z, axis=1, keepdims=True))
            for z in (v.reshape(-1, len(names)) for v in (mode.log_evidence, summed))
        ]
        off, differ = np.abs(p[0] - p[1]), p[0].argmax(axis=1) != p[1].argmax(axis=1)
        print(
            f"{what}, {len(p[0])} grasps: Laplace's are off by {np.sqrt((off**2).mean()):.4f}, ",
            end="",
        )
        print(f"at most {off.max():.3f}; {differ.sum()} names differ")


def summed_evidence(device, data, mode, prior, k, r, n=3000):
    """Return the log evidence of pair k, touch r, by importance sampling; the temperatures exactly."""
    rng, one = np.random.default_rng(k), data.take(np.array([r]))
    vary = [j for j in REST if prior.sd[k, j] > 0]
    near = stats.multivariate_t(mode.u[k, vary], 1.44 * mode.covariance[k][np.ix_(vary, vary)], df=5)
    wide = [stats.t(20, prior.mean[k, j], prior.sd[k, j]) for j in vary]
    points = np.concatenate(
        [
            near.rvs(2 * n // 3, random_state=rng),
            np.stack([s.rvs(n // 3, random_state=rng) for s in wide], axis=1),
        ]
    )
    proposed = np.logaddexp(
        np.log(2 / 3) + near.logpdf(points),
        np.log(1 / 3) + sum(s.logpdf(x) for s, x in zip(wide, points.T)),
    )
    log_prior = sum(
        stats.t(prior.dof[k, j], prior.mean[k, j], prior.sd[k, j]).logpdf(x) for j, x in zip(vary, points.T)
    )
    u = np.repeat(prior.mean[k][None], n, axis=0)
    u[:, vary] = points
    whitener, log_det = whiten(one, device.noise)
    beyond = device.beyond(one.t, u[:, EFFUSIVITY])
    likelihood = slipped(device, one, whitener, beyond, prior.sd[k], u)
    return logsumexp(likelihood + log_prior - proposed) - np.log(n) - 0.5 * log_det[0]


def named(device, grasps):
    """Return right or wrong, log loss and stated confidence of each grasp."""
    names = sorted(set(grasps["material"].values.tolist()))
    evidence = material_evidence(device, grasps, names)
    log_p = evidence - logsumexp(evidence, axis=1, keepdims=True)
    true = np.array([names.index(m) for m in grasps["material"].values])
    return log_p.argmax(axis=1) == true, -log_p[np.arange(true.size), true], np.exp(log_p.max(axis=1))


def drawn(device, repeats, seed):
    return simulate_grasps(
        device.grip(), THREE, n=repeats, t_gripper=28.0, t_object=28.0, seed=seed, **device.readings()
    )


def sets(device, n):
    """Print how sets of 24 grasps score, and sets of 40 of five materials 5 K apart."""
    found = [named(device, drawn(device, 8, 70000 + k)) for k in range(n)]
    right, loss = np.array([f[0] for f in found]), np.array([f[1] for f in found])
    score, per = right.mean(axis=1), right.reshape(n, 3, 8).mean(axis=(0, 2))
    print(f"{n} sets of 24: accuracy {score.mean():.3f}, sd {score.std():.3f}; ", end="")
    print(f"below {MUST}: {(score < MUST).mean():.3f}; copper, iron, wood {per.round(2).tolist()}; ", end="")
    print(f"log loss {loss.mean():.3f}, sd over sets {loss.mean(axis=1).std():.3f}")
    near = [
        simulate_grasps(
            device.grip(), FIVE, n=8, t_gripper=38.0, t_object=43.0, seed=80000 + k, **device.readings()
        )
        for k in range(n)
    ]
    loss = np.array([named(device, grasps)[1].mean() for grasps in near])
    print(f"{n} sets of 40, 5 K apart: log loss {loss.mean():.3f}, sd {loss.std():.3f}, ", end="")
    print(f"at most {loss.max():.3f}")


def refits(device, n):
    """Print how grippers that five grasps of each kind have taught score, beside the one that knows."""
    rows = []
    for k in range(n):
        seed = 90000 + 100 * k
        training = [
            simulate_grasps(
                device.grip(), names, n=5, t_gripper=float(grip), t_object=float(warm), until=float(end),
                seed=seed + i, **device.readings(),
            )
            for i, (warm, grip, names, end) in enumerate(CONDITIONS)
        ]  # fmt: skip
        learnt, fresh = calibrate_gripper(training), drawn(device, 80, seed + 50)
        rows.append([[part.mean() for part in named(d, fresh)] for d in (device, learnt)])
        print(f"refit {k}: knows {np.round(rows[-1][0], 3)}, learnt {np.round(rows[-1][1], 3)}", flush=True)
    if rows:
        mean = np.mean(rows, axis=0)
        print("accuracy, log loss, stated: ", end="")
        print(f"knows {mean[0].round(3).tolist()}, learnt {mean[1].round(3).tolist()}")


def generic(device, n):
    """Print how a support vector machine that five grasps of each material have taught names such sets."""
    found = []
    for k in range(n):
        grasps = drawn(device, 8, 70000 + k)
        grasps.attrs["name"] = "drawn"
        model = {"svm-pca": make_classifier("svm-pca", seed=0)}
        scores = evaluate(model, [grasps], split="random", repeats=8, probe=False).scores()[0]
        found.append([scores["accuracy"], scores["log_loss"]])
    if found:
        accuracy, loss = np.array(found).T
        print(f"svm-pca, {n} sets of 24: accuracy {accuracy.mean():.3f}, sd {accuracy.std():.3f}; ", end="")
        print(f"at least {MUST}: {(accuracy >= MUST).mean():.2f}; log loss {loss.mean():.2f}")


if __name__ == "__main__":
    main()
