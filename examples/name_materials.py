"""What was touched, and how sure: python examples/name_materials.py

Trains the effusivity-posterior classifier on the example grasps of one condition (object at 28 degC, gripper
at 48 degC), names those that it has not seen, and follows one contact sample by sample, as a robot would.
"""

from __future__ import annotations

from thermogrip.classify import Stream, classify_grasps, make_classifier
from thermogrip.datasets import load_example_grasps


def main() -> float:
    """Print a line a grasp and return the share that was named right."""
    grasps = load_example_grasps()["exp2_dT20"]
    training = grasps.isel(grasp=grasps["split"].values == "train")
    unseen = grasps.isel(grasp=grasps["split"].values == "test")
    finger = make_classifier("posterior").fit([training])

    rows = classify_grasps(finger, unseen)
    for row, true in zip(rows, unseen["material"].values):
        name, share = row["material"], row[f"p_{row['material']}"]
        print(f"{row['grasp_id']}: {name:7s} p {share:.3f}  unknown {row['p_unknown']:.2f}  (is {true})")

    first = unseen.isel(grasp=0)
    touch = Stream(finger, t_object=float(first["t_object"]), t_ambient=float(first["t_ambient"]))
    print(f"\nthe first one, {first['material'].item()}, while it is touched:")
    for time_s, t_surface in zip(first["time"].values, first["t_surface"].values):
        p = touch.update(float(time_s), float(t_surface))
        if time_s > 0 and abs(time_s - round(time_s)) < 0.01 and round(time_s) <= 4:
            print(f"  {time_s:3.0f} s  " + "  ".join(f"{name} {share:.3f}" for name, share in p.items()))
    right = [row["material"] == true for row, true in zip(rows, unseen["material"].values)]
    return sum(right) / len(right)


if __name__ == "__main__":
    main()
