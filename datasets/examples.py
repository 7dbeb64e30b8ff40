"""Example data: four logs and thirteen sets of grasps of a gripper rig, simulated by an independent program.

They are not measurements, but stand as they came out of a program that is richer than any model here:
repeated stamps, spikes and a hung logger included.  ``data/README.md`` describes each of them.
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from thermogrip.datasets.errors import UserError, known_names
from thermogrip.datasets.grasp_files import read_grasps
from thermogrip.datasets.log_files import read_log

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Grasps, Log

_FOLDER = Path(str(files("thermogrip.datasets"))) / "data"
EXAMPLE_LOGS = ("prbs_heating_cooling", "step_up_down", "multisine", "pump_on_off")


def example_grasps() -> tuple[str, ...]:
    """Return the names of the bundled sets of grasps, in order."""
    return tuple(sorted(p.name.removesuffix("_meta.csv.xz") for p in _FOLDER.glob("*_meta.csv.xz")))


def example_path(name: str) -> Path:
    """Return the path of a bundled file.

    Parameters
    ----------
    name : str
        One of :data:`EXAMPLE_LOGS` or of the sets of grasps, without ending.

    Raises
    ------
    UserError
        If there is none; the message names those there are.

    Examples
    --------
    >>> example_path("multisine").name
    'multisine.csv.xz'
    """
    path = _FOLDER / f"{name}.csv.xz"
    if not path.is_file():
        hint = known_names(name, [*EXAMPLE_LOGS, *example_grasps()], "there are {}")
        raise UserError(f"no example {name!r}", hint=hint)
    return path


def load_example_logs() -> dict[str, Log]:
    """Return the four bundled logs by name.

    Examples
    --------
    >>> {name: log.sizes["time"] for name, log in load_example_logs().items()}
    {'prbs_heating_cooling': 11806, 'step_up_down': 6620, 'multisine': 18000, 'pump_on_off': 10800}
    """
    return {name: read_log(example_path(name)) for name in EXAMPLE_LOGS}


def load_example_grasps() -> dict[str, Grasps]:
    """Return the bundled sets of grasps by name.

    Examples
    --------
    >>> load_example_grasps()["exp2_dT20"].sizes["grasp"]
    24
    """
    return {name: read_grasps(example_path(name)) for name in example_grasps()}
