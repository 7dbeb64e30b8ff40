"""Training and test grasps that share nothing.

The samples of one grasp are not independent, nor are the touches of one ``touch_group``: the unit here is the
group, or the grasp where there is none, and every split keeps a unit whole.  A split is two index arrays into
the record's ``grasp`` dimension, (train, test), sorted and disjoint.
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
    """Return random splits with so many training units of each material; the others are the test."""
    material, unit = label_values(grasps, "material"), unit_names(grasps)
    _check_touch_groups(grasps, material, "material")
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
    has_material = material != ""
    for _ in range(repeats):
        chosen = np.concatenate([rng.permutation(units)[:train_per_class] for units in classes.values()])
        in_train = np.isin(unit, chosen)
        yield np.flatnonzero(has_material & in_train), np.flatnonzero(has_material & ~in_train)


def shipped(grasps: Grasps) -> Split:
    """Return the split in the record's own ``split``, train or test; other words there are in neither."""
    split = label_values(grasps, "split")
    _check_touch_groups(grasps, split, "split")
    train, test = np.flatnonzero(split == "train"), np.flatnonzero(split == "test")
    if not train.size or not test.size:
        problem = f"column split gives {train.size} training and {test.size} test grasps"
        raise UserError(problem, file=log_name(grasps), hint="write train and test there, or split by grasp")
    return train, test


def _check_touch_groups(grasps: Grasps, label: NDArray[np.str_], name: str) -> None:
    """Refuse a touch group whose touches differ in the label that is split by."""
    groups = label_values(grasps, "touch_group")
    for group in np.unique(groups[groups != ""]):
        labels = np.unique(label[groups == group]).tolist()
        if len(labels) > 1:
            problem = f"touch group {str(group)!r} is in {name} {labels[0]!r} and {labels[1]!r}"
            raise UserError(problem, file=log_name(grasps), hint="its touches must agree")
