"""README's picture: a log predicted, a target reached, materials named.

    python examples/picture.py picture.svg

On the example data that come with the package; ten seconds.
"""

import sys

import numpy as np
from matplotlib import rcParams
from matplotlib.figure import Figure

from thermogrip.classify import classify_grasps, make_classifier
from thermogrip.datasets import cut, load_example_grasps, load_example_logs
from thermogrip.mpc import design_controller, simulate_closed_loop
from thermogrip.sysid import identify

MEASURED = {"color": "0.65", "linewidth": 2.5, "label": "measured"}
PREDICTED = {"color": "C3", "linewidth": 1, "label": "predicted"}


def main(out: str) -> None:
    """Draw the three jobs side by side."""
    rcParams["svg.hashsalt"] = "thermogrip"  # the same file again
    figure = Figure(figsize=(11, 3.3), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    logs = load_example_logs()
    fitted = [logs[name] for name in ("prbs_heating_cooling", "step_up_down", "pump_on_off")]
    plant = identify(fitted, network="gripper", models=("network",)).plant

    test = cut(logs["multisine"], stop=1200.0)
    for log, style in ((test, MEASURED), (plant.simulate(test), PREDICTED)):
        left.plot(log["time"][::20], log["t_surface"][::20], **style)
    left.set(title="Identify: free run on an unseen log", xlabel="time [s]", ylabel="skin [degC]")
    left.legend(frameon=False)

    loop = simulate_closed_loop(
        design_controller(plant), plant.draw(1), [(28.0, 60.0), (38.0, 240.0), (30.0, 300.0)], start=28.0
    )
    middle.step(loop.sample_time, loop.target["t_surface"], color="0.65", linewidth=2.5, label="target")
    middle.plot(loop.time, loop.outputs["t_surface"], color="C0", linewidth=1, label="skin")
    middle.set(title="Control: MPC, plant off its model", xlabel="time [s]")
    middle.legend(frameon=False)

    grasps = load_example_grasps()["exp2_dT20"]
    finger = make_classifier("posterior").fit(grasps[grasps["split"].values == "train"])
    test = grasps[grasps["split"].values == "test"]
    for k, material in enumerate(np.unique(test["material"].values)):
        one = test[[int(np.flatnonzero(test["material"].values == material)[0])]]
        (row,) = classify_grasps(finger, one)
        name = row["material"]
        named = f"{name}, {row[f'p_{name}']:.2f}"
        right.plot(one["time"], one["t_surface"].values[0], color=f"C{k}", label=named)
    right.set(title="Touch: material and probability", xlabel="time since contact [s]", xlim=(-2, 10))
    right.legend(frameon=False)
    for axis in (left, middle, right):
        axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(out, metadata={"Date": None} if out.endswith(".svg") else None)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python picture.py OUT.svg")
    main(sys.argv[1])
