"""Why another room costs: the same made grasps in two rooms, with the nominal temperature used in 3 ways.

    OMP_NUM_THREADS=1 python benchmarks/classify/room.py [--test 24]

Grasps by finite volumes (finite_volumes.py) of five materials, with the same random numbers in the room of
the training (22 to 29 degC) and in a cold one (8 to 15); blocks that lose heat, and blocks that do not,
training grasps and test grasps alike.  The calibrated gripper is asked as it is; with the nominal
temperature as exact as its spread; and with the true temperature in its place: the truth has no bias, and
its blocks have not moved towards the room before contact.  Differences of log loss
are paired, grasp by grasp, to the same room.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from finite_volumes import Rig, labelled
from numpy.typing import NDArray
from transfer import COLD, FIVE

from thermogrip.classify.evaluation.metrics import calibration_interval
from thermogrip.datasets.schema import Grasps
from thermogrip.sysid.effusivity.calibration import calibrate_gripper
from thermogrip.sysid.effusivity.gripper_model import GripperModel
from thermogrip.sysid.effusivity.posterior import material_posterior


def main() -> None:
    """Calibrate, ask, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--test", type=int, default=24, help="grasps of a material and pair of temperatures")
    given = parser.parse_args()
    print("| training | losses | room | nominal | accuracy | log loss | more | ECE |\n|" + "---|" * 8)
    for loses, base in (("yes", Rig()), ("no", Rig(far=0.0, sides=0.0))):
        rooms = {"the same": base, "cold": replace(base, room=COLD)}
        grasps = {name: labelled(FIVE, repeats=given.test, seed=11, rig=rig) for name, rig in rooms.items()}
        for seed in (100, 101):
            device = calibrate_gripper(labelled(FIVE, repeats=5, seed=seed, rig=base))
            first = None
            for room, records in grasps.items():
                for how, asked in nominals(device).items():
                    loss, right, confidence = answers(asked, records)
                    first = loss if first is None else first
                    figures = row(loss, loss - first, right, confidence)
                    print(f"| {seed} | {loses} | {room} | {how} | {figures} |", flush=True)


def row(
    loss: NDArray[np.float64],
    more: NDArray[np.float64],
    right: NDArray[np.bool_],
    confidence: NDArray[np.float64],
) -> str:
    """Return accuracy, log loss, how much more it is with its standard error, and ECE."""
    ece = calibration_interval(confidence, right, np.arange(right.size)).value
    spread = more.std() / np.sqrt(more.size)
    return f"{right.mean():.3f} | {loss.mean():.3f} | {more.mean():+.3f} +- {spread:.3f} | {ece:.3f}"


def nominals(device: GripperModel) -> dict[str, GripperModel]:
    """Return the gripper with its nominal temperature taken in each way."""
    exact = replace(device, uncertainty=None)
    return {"as it is": device, "exact": exact, "the truth": replace(exact, transit_loss=0.0, bias=0.0)}


def answers(
    device: GripperModel, records: list[Grasps]
) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.float64]]:
    """Return log loss, whether it was right, and stated confidence of each grasp."""
    p = np.concatenate([material_posterior(device, record, FIVE) for record in records])
    truth = np.array([FIVE.index(str(m)) for record in records for m in record["material"].values])
    loss = -np.log(np.maximum(p[np.arange(truth.size), truth], 1e-15))
    return loss, p.argmax(axis=1) == truth, p.max(axis=1)


if __name__ == "__main__":
    main()
