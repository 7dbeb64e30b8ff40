"""What of a plant can be moved, and how far."""

from __future__ import annotations

from typing import TYPE_CHECKING

from thermogrip.datasets.errors import UserError

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant

__all__ = ["drive_names", "drive_range"]


def drive_names(plant: Plant) -> tuple[str, ...]:
    """Return the inputs that a controller moves: all but those that are on or off.

    Examples
    --------
    >>> from thermogrip.sysid import Plant
    >>> from thermogrip.sysid.models.network import load_network
    >>> gripper = load_network("gripper")
    >>> plant = Plant(gripper, dict(zip(gripper.parameters, gripper.prior.tolist())), dt=gripper.dt)
    >>> drive_names(plant), plant.inputs
    (('drive',), ('drive', 'pump'))
    """
    switches = tuple(plant.model.switches)
    return tuple(name for name in plant.model.inputs if name not in switches)


def drive_range(plant: Plant, name: str) -> tuple[float, float]:
    """Return a drive's range: by its unit (-1...1, 0...100 percent, 0...255), else what the logs showed.

    Raises
    ------
    UserError
        If its unit says no range, and it was constant in the logs.
    """
    unit = plant.units.get(name, "1")
    low, high = plant.valid.get(name, (-1.0, 1.0))
    if unit == "percent":
        return (-100.0 if low < 0 else 0.0), 100.0
    if unit == "0_255":
        return 0.0, 255.0
    if unit == "1" and low >= -1.05 and high <= 1.05:
        return (-1.0 if low < 0 else 0.0), 1.0
    if not low < high:
        raise UserError(f"drive {name} was constant in the logs", hint="identify with a log that moves it")
    return float(low), float(high)
