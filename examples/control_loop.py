"""A loop of your own around a controller: python examples/control_loop.py

Identifies the example rig from two of its logs, takes the default controller for that plant, and lets it
bring a simulated skin from 28 to 38 degC.  The simulated rig is another draw of the plant's parameters, so
the controller's model is not the truth.  Put your sensors in the place of ``rig.read`` and your amplifier in
the place of ``rig.apply``; the rest stays.
"""

from __future__ import annotations

from thermogrip.datasets import load_example_logs
from thermogrip.mpc import Controller
from thermogrip.rig import Twin
from thermogrip.sysid import identify

TARGET = 38.0  # degC


def main(seconds: float = 200.0) -> float:
    """Run the loop, print a line every 20 s, and return how far off the skin is at the end [K]."""
    logs = load_example_logs()
    two = [logs["step_up_down"], logs["multisine"]]
    plant = identify(two, network="gripper", models=("network",)).plant
    controller = Controller(plant)
    rig = Twin(plant.draw(1), seed=1, t_start=28.0)
    try:
        controller.reset(rig.read().values)
        for k in range(round(seconds / controller.dt)):
            reading = rig.read().values  # {"t_tank": ..., "t_surface": ..., "t_ambient": ...} in degC
            move = controller.step(reading, TARGET)
            rig.apply({"drive": move.drive}, pump=1)
            if k % 10 == 0:
                now, skin = k * controller.dt, reading["t_surface"]
                print(f"{now:5.0f} s  skin {skin:6.2f} degC  drive {move.drive:+.2f}  {move.status}")
            rig.wait(controller.dt)
        return abs(float(rig.read().values["t_surface"]) - TARGET)
    finally:
        rig.close()  # everything off, whatever happens


if __name__ == "__main__":
    main()
