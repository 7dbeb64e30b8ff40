"""The posterior engine on grasps whose truth is known and is not its model: finite volumes.

    OMP_NUM_THREADS=1 python benchmarks/classify/truth.py

``finite_volumes.py`` makes the grasps; what the engine lacks is in them (side and far losses, contact by a
stretched exponential that creeps with the root of time).  Blocks have the library's properties exactly, so
that errors are the engine's.  Prints found over true effusivity, how often 90 % intervals cover the truth,
and stated confidence beside accuracy, on fresh grasps.  Last, the engine's own bound: grasps of four metals
drawn from the bundled gripper's populations, contact conductance too, whose
effusivity it finds with nothing to unlearn.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np
from finite_volumes import labelled

from thermogrip.datasets.materials import find_material
from thermogrip.datasets.schema import Grasps
from thermogrip.sysid.contact.simulation import Blocks, simulate_grasps
from thermogrip.sysid.effusivity.calibration import calibrate_gripper
from thermogrip.sysid.effusivity.gripper_model import GripperModel, load_default_gripper
from thermogrip.sysid.effusivity.posterior import effusivity_posterior, material_posterior

FIVE = ("brass", "copper", "iron", "wood", "zinc")
METALS = ("brass", "copper", "iron", "zinc")
STRANGE = ("acrylic", "stainless", "aluminium")


def main() -> None:
    """Calibrate on five materials, print what is found about fresh grasps of theirs and of others."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=8, help="fresh grasps of each material and condition")
    given = parser.parse_args()
    training = labelled(FIVE, repeats=5, seed=0)
    device = calibrate_gripper(training)
    print("\n| material | how | grasps | rms log10 error | mean | 90 % interval covers | width |")
    print("|---|---|---|---|---|---|---|")
    for name in FIVE:
        others = [g.isel(grasp=g["material"].values != name) for g in training]
        fresh = labelled((name,), repeats=given.repeats, seed=1)
        print_effusivity(name, "left out", calibrate_gripper(others), fresh)
    for name in STRANGE:
        print_effusivity(name, "never shown", device, labelled((name,), repeats=given.repeats, seed=1))
    print("\n| condition | grasps | accuracy | stated |\n|---|---|---|---|")
    for record in labelled(FIVE, repeats=2 * given.repeats, seed=2):
        p = material_posterior(device, record, FIVE)
        right = np.array(FIVE)[p.argmax(axis=1)] == record["material"].values
        where = f"{record['t_object'].values[0]:g} touched at {record['t_gripper'].values[0]:g} degC"
        print(f"| {where} | {right.size} | {right.mean():.3f} | {p.max(axis=1).mean():.3f} |")
    scale = {name: np.exp(b.ln_effusivity) / b.library_effusivity for name, b in device.blocks.items()}
    print(
        "\nfound / library of the calibration's own blocks: ",
        {k: round(float(v), 3) for k, v in scale.items()},
    )
    own_bound()


def own_bound(n: int = 120) -> None:
    """Print the error of log10 e on grasps of the engine's own populations, 20 K apart."""
    device, rng, every = load_default_gripper(), np.random.default_rng(0), []
    spread = float(np.hypot(device.spreads.ln_h_of_blocks, device.spreads.ln_h))
    for name in METALS:
        block = device.blocks[name]
        ln_e, ln_rho_c = np.full(n, block.ln_effusivity), np.full(n, np.log(block.heat_capacity))
        ln_h = device.expected_ln_h(ln_e) + spread * rng.standard_normal(n)
        grip = device.grip()
        blocks = Blocks(np.exp(ln_e), np.exp(ln_h), np.exp(ln_rho_c) * grip.length)
        grasps = simulate_grasps(
            grip, [name] * n, blocks=blocks, t_gripper=23.0, t_object=43.0, seed=5, **device.readings()
        )
        rows = effusivity_posterior(device, grasps)
        true = np.exp(block.ln_effusivity - device.effusivity_scale(ln_e[:1])[0][0])
        error = np.log10([row.effusivity / true for row in rows])
        inside = np.mean([row.effusivity_p05 < true < row.effusivity_p95 for row in rows])
        every.append(error)
        print(f"own bound, {name}: rms {np.sqrt((error**2).mean()):.3f}, 90 % interval covers {inside:.2f}")
    print(f"own bound, metals: rms {np.sqrt((np.array(every) ** 2).mean()):.3f}")


def print_effusivity(name: str, how: str, device: GripperModel, records: Sequence[Grasps]) -> None:
    """Print a row for one material over the conditions with a difference of 20 K."""
    wide = [g for g in records if abs(g["t_object"].values[0] - g["t_gripper"].values[0]) > 15]
    rows = [row for g in wide for row in effusivity_posterior(device, g)]
    true = find_material(name).effusivity
    error = np.log10([row.effusivity / true for row in rows])
    inside = np.mean([row.effusivity_p05 < true < row.effusivity_p95 for row in rows])
    width = np.mean([np.log10(row.effusivity_p95 / row.effusivity_p05) for row in rows])
    print(
        f"| {name} | {how} | {len(rows)} | {np.sqrt((error**2).mean()):.3f} | {error.mean():+.3f} "
        f"| {inside:.2f} | {width:.2f} |"
    )


if __name__ == "__main__":
    main()
