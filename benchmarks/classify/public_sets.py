"""Classifiers on two public sets of contacts, as published, one session held out after the other.

    python benchmarks/classify/public_sets.py FOLDER [--sets hold,toh] [--classifiers posterior,pca-lda]

``FOLDER`` has both repositories as they were cloned; of one that is missing nothing is printed.

**HOLD** (github ``joshsia/haptics-classification``, ``data/``): six objects that a PR2 held ten times each
for ten seconds with a BioTac, a finger filled with fluid whose core is warm.

**ToH** (github ``Healthcare-Robotics/thermal-ambiguity-ToH``, ``robot_study/test/``): 30 sets of nine
contacts of aluminium, wood and cooled wood with a heated and a passive thermistor at 200 Hz, smoothed by
their authors.
"""

from __future__ import annotations

import argparse
import ast
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat

from thermogrip.classify import evaluate
from thermogrip.datasets.errors import UserError, as_user_error, reading
from thermogrip.datasets.files import read_bytes
from thermogrip.datasets.schema import Grasps, make_grasps, with_lead_in

HOLD = re.compile(r"(?P<object>.+)_(?P<number>\d+)_(?P<trial>\d+)_HOLD\.mat")
TOH = re.compile(r"(?P<kind>M|W|CW)_count_(?P<number>\d+)_sensor_.*\.pkl")
KINDS = {"M": "aluminium", "W": "wood", "CW": "wood_cold"}
ARRAY = re.compile(
    rb"\(I(\d+)\nI(\d+)\ntcnumpy\ndtype\n.*?\(S'f8'\n.*?tbI0([01])\n(S['\"].*['\"])\ntb", re.DOTALL
)


def read_hold(folder: str | Path) -> Grasps:
    """Return the HOLD set, sixty grasps, as means of tenths of a second.

    ``material`` is the object's name, ``block`` its name and number, ``session`` the pair of trials in turn,
    ``t_gripper`` the level in the first tenth of a second.  No temperature of object or room is published.
    """
    shares, files = [], named_files(Path(folder), "*_HOLD.mat", HOLD)
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
    """Return the ToH set, 270 contacts of two sensors: ``t_surface`` is the heated one, ``t_surface_2`` the
    passive one, ``session`` the set.  Of rows that are smoothed as these little is lost at 20 Hz."""
    files = [f for n in range(1, 31) for f in named_files(Path(folder) / f"R_{n}", "*.pkl", TOH)]
    cube = np.stack([pickled_array(file)[::every, :3] for file, _ in files])
    return make_grasps(
        np.round(cube[0, :, 0], 6),
        cube[:, :, 2],
        [f"{f.parent.name}_{f.stem.split('_sensor')[0]}" for f, _ in files],
        t_surface_2=cube[:, :, 1],
        material=[KINDS[name["kind"]] for _, name in files],
        session=[f.parent.name.replace("R_", "set") for f, _ in files],
        name="toh",
    )


def named_files(folder: Path, pattern: str, name: re.Pattern[str]) -> Sequence[tuple[Path, re.Match[str]]]:
    """Return the files of a folder with what their names say, in order of name."""
    named = [(file, name.fullmatch(file.name)) for file in sorted(folder.glob(pattern))]
    files = [(file, match) for file, match in named if match is not None]
    if not files:
        raise UserError(f"holds no {pattern}", file=folder, hint="give the folder as it was published")
    return files


def pickled_array(file: Path) -> NDArray[np.float64]:
    """Return the array (n, m) in a pickle of protocol 0: time, passive and heated sensor, force."""
    # a pickle is a program, which is not run: the array's shape and bytes are taken out of its text
    array = ARRAY.search(read_bytes(file))
    wrong = (AttributeError, SyntaxError, TypeError, ValueError)
    with as_user_error(wrong, "is no pickled array of numbers", file=file, hint="give the file as published"):
        rows, columns, by_column, text = array.groups()  # type: ignore[union-attr]
        raw = ast.literal_eval("b" + text[1:].decode("ascii"))
        order = "F" if by_column == b"1" else "C"
        return np.frombuffer(raw, "<f8").reshape(int(rows), int(columns), order=order).copy()  # type: ignore[call-overload,no-any-return]


READERS = {
    "hold": ("haptics-classification/data", read_hold),
    "toh": ("thermal-ambiguity-ToH/robot_study/test", read_toh),
}


def main() -> None:
    """Print each set's accuracy and log loss."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--sets", default="hold,toh")
    parser.add_argument("--classifiers", default="posterior,pca-lda")
    arguments = parser.parse_args()
    for name in arguments.sets.split(","):
        below, read = READERS[name]
        if (arguments.folder / below).is_dir():
            found = evaluate(
                arguments.classifiers.split(","), [read(arguments.folder / below)], split="session"
            )
            for row in found.scores():
                scores = f"accuracy {row['accuracy']:.3f}, log loss {row['log_loss']:.3f}"
                print(f"{name:6}{row['classifier']:12}{row['n']} grasps, {scores}")


if __name__ == "__main__":
    main()
