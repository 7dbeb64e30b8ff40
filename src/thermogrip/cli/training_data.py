"""What the verbs of grasps learn from: the part marked for it, without grasps that show no contact."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from thermogrip.cli.options import find_grasps, log_name, warn_of_contacts
from thermogrip.datasets.errors import UserError
from thermogrip.report.console import Console

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Grasps
    from thermogrip.sysid.effusivity.gripper_model import GripperModel
    from thermogrip.sysid.effusivity.multi_touch import Coupling

__all__ = ["calibrated_device", "touched_part", "training_part"]

_BUNDLED = 40.0  # s: the longest contacts that taught the bundled gripper


def calibrated_device(
    console: Console, calibrate: Sequence[str], seed: int
) -> tuple[GripperModel, Coupling | None, float]:
    """Return the calibrated gripper, from labelled grasps or the bundled one with a warning.

    Beside it stands how blocks move between touches, where the grasps tell, and how long contacts lasted that
    taught it [s].
    """
    from thermogrip.datasets.schema import has_touch_groups
    from thermogrip.sysid.effusivity.calibration import calibrate_gripper
    from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
    from thermogrip.sysid.effusivity.multi_touch import learn_coupling
    from thermogrip.sysid.effusivity.quality import longest_contact

    if not calibrate:
        console.warn(
            "the bundled gripper's calibration is used; give --calibrate with labelled grasps of yours"
        )
        return load_default_gripper(), None, _BUNDLED
    labelled = find_grasps(calibrate)
    warn_of_contacts(console, labelled)
    labelled = touched_part(console, labelled)
    with console.progress("calibrate") as progress:
        device = calibrate_gripper(labelled, seed=seed, progress=progress)
    coupling = None
    for record in filter(has_touch_groups, labelled):
        coupling = learn_coupling(device, record, start=coupling)
    return device, coupling, longest_contact(labelled)


def touched_part(console: Console, records: Sequence[Grasps]) -> list[Grasps]:
    """Return the grasps to learn from without those that show no contact."""
    from thermogrip.sysid.effusivity.quality import check_grasps

    kept = []
    for record in records:
        quality = check_grasps(record)
        for words in dict.fromkeys(filter(None, quality.reason)):
            console.warn(f"{log_name(record)}: {quality.reason.count(words)} left out: {words}")
        part = quality.usable_grasps(record)
        kept += [] if part is None else [part]
    if not kept:
        raise UserError("no grasp shows a contact", hint="give grasps that touched something")
    return kept


def training_part(console: Console, records: Sequence[Grasps], split: str | None) -> list[Grasps]:
    """Return the grasps to learn from: those marked ``train`` where there are any, or all."""
    kept = []
    for record in records:
        has_split = "split" in record and bool((record["split"].values != "").any())
        if split == "train" and not has_split:
            raise UserError(
                "has no split", file=log_name(record), hint="fill the column split, or use --split all"
            )
        if split == "all" or not has_split:
            kept.append(record)
            continue
        marked = record["split"].values == "train"
        if marked.any():
            kept.append(record.isel(grasp=marked))
        else:
            console.warn(f"{log_name(record)}: no grasp is marked train, it is left out")
    if not kept:
        raise UserError("no grasp is marked train", hint="use --split all")
    return kept
