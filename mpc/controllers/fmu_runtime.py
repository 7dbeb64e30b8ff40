"""What a controller's FMU runs: its file, read once."""

from __future__ import annotations

from pathlib import Path

from thermogrip.mpc.controllers.fmu import Core
from thermogrip.mpc.controllers.mpc import Controller


def core_of(path: Path) -> Core:
    """Return the core of the controller in a JSON file of ``Controller.save``."""
    return Core(Controller.load(path))
