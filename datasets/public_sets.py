"""Public sets of contacts, read from a folder as their authors published them; nothing is downloaded.

**HOLD** (github ``joshsia/haptics-classification``, ``data/``): six objects that a PR2 held ten times each
for ten seconds with a BioTac, a finger filled with fluid whose core is warm.

**ToH** (github ``Healthcare-Robotics/thermal-ambiguity-ToH``, ``robot_study/test/``): 30 sets of nine
contacts of aluminium, wood and cooled wood with a heated and a passive thermistor at 200 Hz, smoothed by
their authors.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.errors import UserError, as_user_error, reading
from thermogrip.datasets.files import read_bytes
from thermogrip.datasets.schema import Grasps, make_grasps, with_lead_in

_HOLD = re.compile(r"(?P<object>.+)_(?P<number>\d+)_(?P<trial>\d+)_HOLD\.mat")
_TOH = re.compile(r"(?P<kind>M|W|CW)_count_(?P<number>\d+)_sensor_.*\.pkl")
_KINDS = {"M": "aluminium", "W": "wood", "CW": "wood_cold"}
_ARRAY = re.compile(
    rb"\(I(\d+)\nI(\d+)\ntcnumpy\ndtype\n.*?\(S'f8'\n.*?tbI0([01])\n(S['\"].*['\"])\ntb", re.DOTALL
)


def read_hold(folder: str | Path) -> Grasps:
    """Return the HOLD set, sixty grasps, as means of tenths of a second.

    Parameters
    ----------
    folder : str or Path
        The folder ``data`` of the published repository.

    Returns
    -------
    grasps : Grasps
        ``material`` is the object's name, ``block`` its name and number, ``session`` the pair of trials in
        turn (``pair1`` has trials 1 and 2), ``t_gripper`` the level in the first tenth of a second, which
        stands before contact too.  No temperature of an object or the room is published.

    Raises
    ------
    UserError
        If the folder holds no such file, or one is damaged.

    Examples
    --------
    >>> read_hold("elsewhere")
    Traceback (most recent call last):
    ...
    thermogrip.datasets.errors.UserError: elsewhere: holds no *_HOLD.mat; give the folder as it was published
    """
    from scipy.io import loadmat

    shares, files = [], _named_files(Path(folder), "*_HOLD.mat", _HOLD)
    for file, _ in files:
        with reading("has no F0tdc", file=file, hint="give the files as published"):
            shares.append(loadmat(file)["F0tdc"][0] / 4095)  # finger 0's core at 100 Hz, in 12 bits
    n = min(map(len, shares)) // 10
    x = np.stack([share[: 10 * n] for share in shares])
    with np.errstate(divide="ignore", invalid="ignore"):
        core = 4025 / np.log((155183 - 46555 * x) / x) - 273.15  # the maker's divider and thermistor
    rows = core.reshape(len(files), n, 10).mean(axis=2)
    names = [name.groupdict() for _, name in files]
    # the files begin with the hold, and fluid and skin delay what the core feels: its first tenth of a second
    # counts as the level before contact
    return with_lead_in(
        make_grasps(
            0.1 * (np.arange(n) + 0.5),
            rows,
            [f"{name['object']}_{name['trial']}" for name in names],
            material=[name["object"].replace("_", " ") for name in names],
            block=[f"{name['object']}_{name['number']}" for name in names],
            session=[f"pair{(int(name['trial']) + 1) // 2}" for name in names],
            t_gripper=rows[:, 0],
            name="hold",
        )
    )


def read_toh(folder: str | Path, *, every: int = 10) -> Grasps:
    """Return the ToH set, 270 contacts of two sensors.

    Parameters
    ----------
    folder : str or Path
        The folder ``robot_study/test`` of the published repository.
    every : int, optional
        Rows of 200 Hz from one sample to the next; smoothed as they are, little is lost at 20 Hz.

    Returns
    -------
    grasps : Grasps
        ``t_surface`` is the heated sensor, ``t_surface_2`` the passive one; ``material`` is ``aluminium``,
        ``wood`` or ``wood_cold``, ``session`` the set, ``set1`` to ``set30``.

    Raises
    ------
    UserError
        If the folder holds no such file, or one is no array of numbers.

    Examples
    --------
    >>> read_toh("elsewhere")
    Traceback (most recent call last):
    ...
    thermogrip.datasets.errors.UserError: elsewhere/R_1: holds no *.pkl; give the folder as it was published
    """
    files = [f for n in range(1, 31) for f in _named_files(Path(folder) / f"R_{n}", "*.pkl", _TOH)]
    cube = np.stack([_pickled_array(file)[::every, :3] for file, _ in files])
    return make_grasps(
        np.round(cube[0, :, 0], 6),
        cube[:, :, 2],
        [f"{f.parent.name}_{f.stem.split('_sensor')[0]}" for f, _ in files],
        t_surface_2=cube[:, :, 1],
        material=[_KINDS[name["kind"]] for _, name in files],
        session=[f.parent.name.replace("R_", "set") for f, _ in files],
        name="toh",
    )


def _named_files(folder: Path, pattern: str, name: re.Pattern[str]) -> Sequence[tuple[Path, re.Match[str]]]:
    """Return the files of a folder with what their names say, in order of name."""
    named = [(file, name.fullmatch(file.name)) for file in sorted(folder.glob(pattern))]
    files = [(file, match) for file, match in named if match is not None]
    if not files:
        raise UserError(f"holds no {pattern}", file=folder, hint="give the folder as it was published")
    return files


def _pickled_array(file: Path) -> NDArray[np.float64]:
    """Return the array (n, m) in a pickle of protocol 0: time, passive and heated sensor, force."""
    # a pickle is a program, which is not run: the array's shape and bytes are taken out of its text
    array = _ARRAY.search(read_bytes(file))
    wrong = (AttributeError, SyntaxError, TypeError, ValueError)
    with as_user_error(wrong, "is no pickled array of numbers", file=file, hint="give the file as published"):
        rows, columns, by_column, text = array.groups()  # type: ignore[union-attr]
        raw = ast.literal_eval("b" + text[1:].decode("ascii"))
        order = "F" if by_column == b"1" else "C"
        return np.frombuffer(raw, "<f8").reshape(int(rows), int(columns), order=order).copy()  # type: ignore[call-overload,no-any-return]
