"""The client that TCLab's makers wrote, against thermogrip's virtual board: python examples/tclab_client.py

The client takes only ports that look like an Arduino's, so this one is named as such.
"""

from __future__ import annotations

import tclab

from thermogrip.rig import VirtualDevice


def main() -> None:
    """Connect, heat for ten seconds, and print what the Historian wrote down."""
    with VirtualDevice(protocol="tclab", t_start=23.0) as device:
        tclab.tclab.list_ports.comports = lambda: [(device.port, "virtual", "USB VID:PID=2341:8036")]
        with tclab.TCLab(port=device.port) as lab:
            lab.Q1(80)
            history = tclab.Historian(lab.sources)
            for now in tclab.clock(10):
                history.update(now)
            print(*history.columns)
            for row in history.log:
                print(*(f"{number:7.3f}" for number in row))
        print("after close:", device.applied_drive)


if __name__ == "__main__":
    main()
