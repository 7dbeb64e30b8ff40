"""Training and test grasps that share nothing.

The samples of one grasp are not independent, nor are the two touches of one ``touch_group``: a split by
sample measures memory.  The unit here is the touch group, or the grasp where there is none, and every
split keeps a unit whole.  Splits by session and by block keep those whole as well, and answer harder
questions: does it work tomorrow, does it work on another block of the same material.

A split is two index arrays into the record's ``grasp`` dimension, (train, test), sorted and disjoint.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps, label_values, log_name, unit_names

Split: TypeAlias = tuple[NDArray[np.int64], NDArray[np.int64]]


def by_grasp(
    grasps: Grasps, *, train_per_class: int = 5, repeats: int = 20, seed: int = 0
) -> Iterator[Split]:
    """Return random splits with so many training units of each material; the others are the test.

    Parameters
    ----------
    grasps : Grasps
        With ``material``; grasps without one are in neither part.
    train_per_class : int, optional
        Training grasps (or touch groups) of each material.
    repeats : int, optional
        Number of splits.
    seed : int, optional
        Same seed, same splits.

    Raises
    ------
    UserError
        If a material has no unit left for the test.

    Examples
    --------
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> train, test = next(by_grasp(load_example_grasps()["exp2_dT20"]))
    >>> train.size, test.size, set(train) & set(test)
    (15, 9, set())
    """
    material, unit = label_values(grasps, "material"), unit_names(grasps)
    _whole(grasps, material, "material")
    classes = {m: np.unique(unit[material == m]) for m in dict.fromkeys(material.tolist()) if m}
    if not classes:
        raise UserError("no grasp has a material", file=log_name(grasps), hint="give the column material")
    if train_per_class < 1:
        raise UserError(f"{train_per_class} training grasps a material", hint="give at least one")
    for name, units in classes.items():
        if units.size <= train_per_class:
            problem = (
                f"{units.size} grasp(s) of {name} cannot give {train_per_class} to train and one to test"
            )
            raise UserError(problem, file=log_name(grasps), hint="lower --train-per-class or record more")
    rng = np.random.default_rng(seed)
    known = material != ""
    for _ in range(repeats):
        chosen = np.concatenate([rng.permutation(units)[:train_per_class] for units in classes.values()])
        in_train = np.isin(unit, chosen)
        yield np.flatnonzero(known & in_train), np.flatnonzero(known & ~in_train)


def by_session(grasps: Grasps) -> Iterator[Split]:
    """Return one split a session: that session is the test, all others the training.

    Parameters
    ----------
    grasps : Grasps
        With ``material`` and ``session``.

    Raises
    ------
    UserError
        If there is only one session, or a touch group spans two.

    Examples
    --------
    >>> from thermogrip.datasets.schema import make_grasps
    >>> days = {"material": ["iron", "wood"] * 2, "session": ["monday", "monday", "friday", "friday"]}
    >>> made = make_grasps([-0.1, 0.1], [[23.0, 24.0]] * 4, ["a", "b", "c", "d"], **days)
    >>> [(train.tolist(), test.tolist()) for train, test in by_session(made)]
    [([2, 3], [0, 1]), ([0, 1], [2, 3])]
    """
    session, known = label_values(grasps, "session"), label_values(grasps, "material") != ""
    _whole(grasps, session, "session")
    sessions = list(dict.fromkeys(session[known].tolist()))
    if len(sessions) < 2:
        problem = f"{len(sessions)} session(s) cannot be split"
        raise UserError(problem, file=log_name(grasps), hint="give the column session, or split by grasp")
    for name in sessions:
        yield np.flatnonzero(known & (session != name)), np.flatnonzero(known & (session == name))


def by_block(grasps: Grasps, *, seed: int = 0) -> Iterator[Split]:
    """Return splits in which no block of the test was touched in training: one block of each material is
    held out.

    There are as many splits as the material with the fewest blocks has.

    Parameters
    ----------
    grasps : Grasps
        With ``material`` and ``block``.
    seed : int, optional
        Of the order in which blocks are held out.

    Raises
    ------
    UserError
        If a material has only one block, or a touch group spans two.

    Examples
    --------
    >>> from thermogrip.datasets.schema import make_grasps
    >>> blocks = {"material": ["iron", "iron", "wood", "wood"], "block": ["1", "2", "1", "2"]}
    >>> made = make_grasps([-0.1, 0.1], [[23.0, 24.0]] * 4, ["a", "b", "c", "d"], **blocks)
    >>> [(train.tolist(), test.tolist()) for train, test in by_block(made)]
    [([1, 3], [0, 2]), ([0, 2], [1, 3])]
    """
    material, block = label_values(grasps, "material"), label_values(grasps, "block")
    _whole(grasps, block, "block")
    rng = np.random.default_rng(seed)
    blocks: dict[str, NDArray[np.str_]] = {}
    for name in dict.fromkeys(material[material != ""].tolist()):
        blocks[name] = rng.permutation(np.unique(block[material == name]))
        if blocks[name].size < 2:
            problem = f"there is one block of {name}"
            raise UserError(problem, file=log_name(grasps), hint="give the column block, or split by grasp")
    if not blocks:
        raise UserError("no grasp has a material", file=log_name(grasps), hint="give the column material")
    for fold in range(min(b.size for b in blocks.values())):
        held = np.zeros(material.size, dtype=bool)
        for name, order in blocks.items():
            held |= (material == name) & (block == order[fold])
        yield np.flatnonzero((material != "") & ~held), np.flatnonzero(held)


def shipped(grasps: Grasps) -> Split:
    """Return the split that the record itself holds.

    Parameters
    ----------
    grasps : Grasps
        With ``split``: train or test; other words are in neither.

    Raises
    ------
    UserError
        If there is no such column, a part is empty, or a touch group is in both.

    Examples
    --------
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> train, test = shipped(load_example_grasps()["exp1A_obj43_grip23"])
    >>> train.size, test.size
    (25, 15)
    """
    split = label_values(grasps, "split")
    _whole(grasps, split, "split")
    train, test = np.flatnonzero(split == "train"), np.flatnonzero(split == "test")
    if not train.size or not test.size:
        problem = f"column split gives {train.size} training and {test.size} test grasps"
        raise UserError(problem, file=log_name(grasps), hint="write train and test there, or split by grasp")
    return train, test


def _whole(grasps: Grasps, label: NDArray[np.str_], name: str) -> None:
    """Refuse a touch group whose touches differ in the label that is split by."""
    groups = label_values(grasps, "touch_group")
    for group in np.unique(groups[groups != ""]):
        found = np.unique(label[groups == group]).tolist()
        if len(found) > 1:
            problem = f"touch group {str(group)!r} is in {name} {found[0]!r} and {found[1]!r}"
            raise UserError(problem, file=log_name(grasps), hint="its touches must agree")
