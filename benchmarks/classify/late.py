"""Contacts that began earlier or later than the gripper said: do the candidates stay right?

    python benchmarks/classify/late.py

Every ninth single touch of the example conditions, whose times are moved by some tenths of a second, under
the bundled gripper, taken for certain; five candidates, with the object's temperature as stated and unknown.
"""

from __future__ import annotations

import time

import numpy as np

from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper

FIVE = ["brass", "copper", "iron", "wood", "zinc"]
LATE = (0.0, -0.4, 0.6, 1.2)  # s
LEFT_OUT = ("exp4", "exp5", "exp6")  # 40 s, two touches, other materials


def main() -> None:
    """Print right answers and log loss by how late contacts are."""
    known = PosteriorClassifier().with_device(load_default_gripper()).certain()
    files = {n: g for n, g in sorted(load_example_grasps().items()) if not n.startswith(LEFT_OUT)}
    print("late [s]  temperature   n  right  log loss  CPU [s]")
    for late in LATE:
        for unknown in (False, True):
            losses, right, begin = [], [], time.process_time()
            for grasps in files.values():
                for k in range(0, grasps.sizes["grasp"], 9):
                    one = grasps.isel(grasp=[k])
                    one = one.assign_coords(time=np.round(one["time"].values + late, 3))
                    one = one.sel(time=slice(-1.5, 10.0))
                    if unknown:
                        one = one.assign(t_object=one["t_object"] * np.nan)
                    log_p = known.candidate_log_proba(one, FIVE)[0]
                    true = FIVE.index(str(one["material"].values[0]))
                    losses.append(-max(float(log_p[true]), np.log(1e-12)))
                    right.append(int(np.argmax(log_p)) == true)
            spent, said = time.process_time() - begin, "unknown" if unknown else "stated"
            print(
                f"{late:8.1f}  {said:11s} {len(right):3d}  {np.mean(right):5.3f}  {np.mean(losses):8.3f}"
                f"  {spent:7.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
