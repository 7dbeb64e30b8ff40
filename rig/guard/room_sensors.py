"""Which sensors read the room, and not what is driven.

Losing the room's sensor is no reason to stop, and no limit holds for it, so the guard has to know which it
is.  The plant says so: its disturbances that are temperatures.  A sensor that the plant does not know, and
every sensor where there is no plant, goes by its name, as a column of a log does
(:func:`~thermogrip.datasets.units.guess_role`).
"""

from __future__ import annotations

from collections.abc import Collection

from thermogrip.datasets.units import guess_role
from thermogrip.sysid.plant.plant import Plant

__all__ = ["room_disturbances", "room_sensors"]


def room_disturbances(plant: Plant) -> tuple[str, ...]:
    """Return the disturbances of a plant that are temperatures, in its order."""
    return tuple(name for name in plant.disturbances if plant.units.get(name, "degC") == "degC")


def room_sensors(
    names: Collection[str], plant: Plant | None = None, *, outputs: Collection[str] = ()
) -> frozenset[str]:
    """Return those of a rig's sensors that read the room.

    Parameters
    ----------
    names : collection of str
        The sensors.
    plant : Plant, optional
        The identified rig.
    outputs : collection of str, optional
        Sensors that are known to read what is driven, whatever they are called.

    Examples
    --------
    >>> sorted(room_sensors(("t_tank", "t_surface", "t_ambient")))
    ['t_ambient']
    >>> sorted(room_sensors(("t_ambient_block", "t_ambient"), outputs=("t_ambient_block",)))
    ['t_ambient']
    """
    known: set[str] = set(outputs)
    rooms: set[str] = set()
    if plant is not None:
        rooms = set(room_disturbances(plant))
        known |= {*plant.outputs, *plant.inputs, *plant.disturbances}
    rooms |= {name for name in names if name not in known and guess_role(name, "degC") == "disturbance"}
    return frozenset(name for name in names if name in rooms and name not in outputs)
