"""How often the right material is named by an engine that knows every number of the gripper.

    OMP_NUM_THREADS=1 python benchmarks/classify/own_bound.py

Grasps are drawn from the bundled gripper's own populations at the temperatures of exp1, exp2 and exp4 and
named with the same numbers: nothing is left to learn, so that no classifier of such grasps does better.
"""

from __future__ import annotations

import argparse

import numpy as np

from thermogrip.sysid.contact.simulation import simulate_grasps
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
from thermogrip.sysid.effusivity.posterior import material_posterior

THREE, FIVE = ("copper", "iron", "wood"), ("brass", "copper", "iron", "wood", "zinc")
# name: materials, object and gripper [degC], contact [s], how many times the usual number of grasps
ROWS = {
    "exp1A": (FIVE, 43.0, 23.0, 10.0, 1),
    "exp1B": (FIVE, 43.0, 38.0, 10.0, 1),
    "exp2, no difference": (THREE, 28.0, 28.0, 10.0, 10),
    "exp2, 5 K": (THREE, 28.0, 33.0, 10.0, 1),
    "exp2, 10 K": (THREE, 28.0, 38.0, 10.0, 1),
    "exp2, 20 K": (THREE, 28.0, 48.0, 10.0, 1),
    "exp4, 10 s": (FIVE, 18.0, 38.0, 10.0, 1),
    "exp4, 40 s": (FIVE, 18.0, 38.0, 40.0, 1),
}


def main() -> None:
    """Draw, name, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=160, help="grasps of each material")
    given = parser.parse_args()
    device = load_default_gripper()
    print("| row | grasps | accuracy | log loss |\n|---|---|---|---|")
    for seed, (row, (names, t_object, t_gripper, end, times)) in enumerate(ROWS.items(), start=3):
        drawn = simulate_grasps(
            device.grip(),
            names,
            n=times * given.repeats,
            t_gripper=t_gripper,
            t_object=t_object,
            until=end,
            seed=seed,
            **device.readings(),
        )
        p = material_posterior(device, drawn, names)
        own = np.array([names.index(name) for name in drawn["material"].values])
        loss = -np.log(np.maximum(p[np.arange(own.size), own], 1e-300))
        right = (p.argmax(axis=1) == own).mean()
        errors = [np.sqrt(right * (1 - right) / own.size), loss.std() / np.sqrt(own.size)]
        print(
            f"| {row} | {own.size} | {right:.3f} +- {errors[0]:.3f} | {loss.mean():.3f} +- {errors[1]:.3f} |"
        )


if __name__ == "__main__":
    main()
