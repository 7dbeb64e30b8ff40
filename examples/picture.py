"""README's picture: a log predicted, a target reached, materials named; and each of the three alone.

    python examples/picture.py picture.svg
    python examples/picture.py loop.svg control

On the example data that come with the package; ten seconds.
"""

import sys
from functools import cache

import numpy as np
from matplotlib import rcParams
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from thermogrip.classify import classify_grasps, make_classifier
from thermogrip.datasets import cut, load_example_grasps, load_example_logs
from thermogrip.mpc import design_controller, simulate_closed_loop
from thermogrip.sysid import Plant, identify

MEASURED = {"color": "0.65", "linewidth": 2.5, "label": "measured"}
PREDICTED = {"color": "C3", "linewidth": 1, "label": "simulated"}


@cache
def plant() -> Plant:
    """Return the plant behind three of the example logs."""
    logs = load_example_logs()
    fitted = [logs[name] for name in ("prbs_heating_cooling", "step_up_down", "pump_on_off")]
    return identify(fitted, network="gripper", models=("network",)).plant


def prediction(axis: Axes) -> None:
    """Draw a log that the fit has not seen, and the plant in simulation."""
    test = cut(load_example_logs()["multisine"], stop=1200.0)
    for log, style in ((test, MEASURED), (plant().simulate(test), PREDICTED)):
        axis.plot(log["time"][::20], log["t_surface"][::20], **style)
    axis.set(title="Identify: simulation of an unseen log", xlabel="time [s]", ylabel="skin [degC]")


def loop(axis: Axes) -> None:
    """Draw a closed loop on a plant that is not the controller's model."""
    targets = [(28.0, 60.0), (38.0, 240.0), (30.0, 300.0)]
    run = simulate_closed_loop(design_controller(plant()), plant().draw(1), targets, start=28.0)
    axis.step(run.sample_time, run.target["t_surface"], color="0.65", linewidth=2.5, label="target")
    axis.plot(run.time, run.outputs["t_surface"], color="C0", linewidth=1, label="skin")
    axis.set(title="Control: MPC, plant off its model", xlabel="time [s]", ylabel="skin [degC]")


def touches(axis: Axes) -> None:
    """Draw a grasp of each material, with the name that it gets."""
    grasps = load_example_grasps()["exp2_dT20"]
    finger = make_classifier("posterior").fit(grasps[grasps["split"].values == "train"])
    test = grasps[grasps["split"].values == "test"]
    for k, material in enumerate(np.unique(test["material"].values)):
        one = test[[int(np.flatnonzero(test["material"].values == material)[0])]]
        (row,) = classify_grasps(finger, one)
        name = row["material"]
        named = f"{name}, {row[f'p_{name}']:.2f}"
        axis.plot(one["time"], one["t_surface"].values[0], color=f"C{k}", label=named)
    axis.set(title="Touch: material and probability", xlabel="time since contact [s]", xlim=(-2, 10))
    axis.set_ylabel("skin [degC]")


PANELS = {"identify": prediction, "control": loop, "touch": touches}


def main(out: str, *names: str) -> None:
    """Draw these of the three jobs side by side, or all."""
    rcParams["svg.hashsalt"] = "thermogrip"  # the same file again
    drawn = [PANELS[name] for name in names or PANELS]
    figure = Figure(figsize=(11 if len(drawn) > 1 else 6, 3.3), layout="constrained")
    for draw, axis in zip(drawn, figure.subplots(1, len(drawn), squeeze=False)[0]):
        draw(axis)
        axis.legend(frameon=False)
        axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(out, metadata={"Date": None} if out.endswith(".svg") else None)


if __name__ == "__main__":
    if len(sys.argv) < 2 or not PANELS.keys() >= set(sys.argv[2:]):
        sys.exit(f"usage: python picture.py OUT.svg [{'|'.join(PANELS)}]...")
    main(*sys.argv[1:])
