"""Naming materials where gripper and object are equally warm: what limits it, and what is luck.

    OMP_NUM_THREADS=1 python benchmarks/classify/no_difference.py [--sets 200] [--refits 6]

- temperatures: of the shipped training grasps, how far the blocks miss their dials, the material known, by
  file; whether they follow the room's sensor or the gripper's own error;
- sets: 24 grasps (copper, iron, wood) drawn from the bundled gripper's populations, as many as exp2 dT 0 has,
  and named by the engine that knows them; and 40 of five materials 5 K apart, as in exp1B;
- refits: the same by grippers that were calibrated on five simulated grasps of each material and condition.

No test grasp of the example files is looked at.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.special import logsumexp

from thermogrip.datasets.examples import load_example_grasps
from thermogrip.sysid.calibration import calibrate_device
from thermogrip.sysid.effusivity import material_evidence, material_fit
from thermogrip.sysid.grasp_simulation import simulate_blocks
from thermogrip.sysid.gripper_device import load_default_device

THREE, FIVE = ["copper", "iron", "wood"], ["brass", "copper", "iron", "wood", "zinc"]
# object, gripper [degC], materials, contact time [s]: exp1 to exp4
CONDITIONS = (
    (43, 23, FIVE, 10), (43, 38, FIVE, 10), (28, 28, THREE, 10), (28, 33, THREE, 10), (28, 38, THREE, 10),
    (28, 43, THREE, 10), (28, 48, THREE, 10), (43, 23, THREE, 10), (28, 48, THREE, 10), (18, 38, THREE, 10),
    (18, 38, FIVE, 40),
)  # fmt: skip
MUST = 0.54


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", type=int, default=200)
    parser.add_argument("--refits", type=int, default=6)
    given = parser.parse_args()
    device = load_default_device()
    temperatures(device)
    sets(device, given.sets)
    refits(device, given.refits)


def temperatures(device):
    """Print how far blocks miss their dials, and what that follows."""
    rows = []
    for name, record in load_example_grasps().items():
        if name[:4] not in ("exp1", "exp2", "exp3", "exp4"):
            continue
        train = record.isel(grasp=record["split"].values == "train")
        names = sorted(set(train["material"].values.tolist()))
        own = np.array([names.index(m) for m in train["material"].values])
        fit, each = material_fit(device, train, names), np.arange(own.size)
        expected = fit.prior_t_object[each, own]
        dial, room = train["t_object"].values, train["t_ambient"].values
        level = train["t_surface"].values[:, train["time"].values < -0.25].mean(axis=1)
        missed = fit.t_object[each, own] - expected
        spread = np.sqrt((missed**2 + fit.t_object_sd[each, own] ** 2).mean())
        print(f"{name}: {own.size} blocks miss the expected temperature by {spread:.2f} K")
        rows.append(np.stack([dial, missed, room - dial, level - train["t_gripper"].values]))
    dial, missed, room, error = np.concatenate(rows, axis=1)
    at = dial == 28
    design = np.stack([np.ones(at.sum()), room[at], error[at]], axis=1)
    slope = np.linalg.lstsq(design, missed[at], rcond=None)[0]
    left = missed[at] - design @ slope
    sd = np.sqrt(np.diag(np.linalg.inv(design.T @ design)) * left.var(ddof=3))
    print(f"blocks at room temperature, {at.sum()}: slope on room {slope[1]:+.2f} +- {sd[1]:.2f} ", end="")
    print(f"(beyond the model's {device.carry:.2f}), on the gripper's error {slope[2]:+.2f} +- {sd[2]:.2f}")


def named(device, grasps):
    """Return right or wrong, log loss and stated confidence of each grasp."""
    names = sorted(set(grasps["material"].values.tolist()))
    evidence = material_evidence(device, grasps, names)
    log_p = evidence - logsumexp(evidence, axis=1, keepdims=True)
    true = np.array([names.index(m) for m in grasps["material"].values])
    return log_p.argmax(axis=1) == true, -log_p[np.arange(true.size), true], np.exp(log_p.max(axis=1))


def drawn(device, repeats, seed):
    return simulate_blocks(device, THREE, repeats=repeats, t_gripper=28.0, t_object=28.0, seed=seed)


def sets(device, n):
    """Print how sets of 24 grasps score, and sets of 40 of five materials 5 K apart."""
    found = [named(device, drawn(device, 8, 70000 + k)) for k in range(n)]
    right, loss = np.array([f[0] for f in found]), np.array([f[1] for f in found])
    score, per = right.mean(axis=1), right.reshape(n, 3, 8).mean(axis=(0, 2))
    print(f"{n} sets of 24: accuracy {score.mean():.3f}, sd {score.std():.3f}; ", end="")
    print(f"below {MUST}: {(score < MUST).mean():.3f}; copper, iron, wood {per.round(2).tolist()}; ", end="")
    print(f"log loss {loss.mean():.3f}, sd over sets {loss.mean(axis=1).std():.3f}")
    near = [
        simulate_blocks(device, FIVE, repeats=8, t_gripper=38.0, t_object=43.0, seed=80000 + k)
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
            simulate_blocks(
                device, names, repeats=5, t_gripper=float(grip), t_object=float(warm), end=float(end),
                seed=seed + i,
            )
            for i, (warm, grip, names, end) in enumerate(CONDITIONS)
        ]  # fmt: skip
        learnt, fresh = calibrate_device(training), drawn(device, 80, seed + 50)
        rows.append([[part.mean() for part in named(d, fresh)] for d in (device, learnt)])
        print(f"refit {k}: knows {np.round(rows[-1][0], 3)}, learnt {np.round(rows[-1][1], 3)}", flush=True)
    if rows:
        mean = np.mean(rows, axis=0)
        print("accuracy, log loss, stated: ", end="")
        print(f"knows {mean[0].round(3).tolist()}, learnt {mean[1].round(3).tolist()}")


if __name__ == "__main__":
    main()
