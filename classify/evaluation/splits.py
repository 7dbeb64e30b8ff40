"""Training and test grasps of each condition: by the shipped split, at random, by session or block, by files.

A condition is one record (one file).  The unit of a split is the grasp, or the block that was touched twice
(``touch_group``): never a sample, never an augmented copy.  A condition that a split cannot serve is left out
with a note on the reason.

``session`` holds out one session after the other, ``block`` one block of each material: in all conditions at
once, since a classifier that learns from all of them would else know the held-out block from another one.
Without the column, a file is a session, and all grasps of a material are of one block.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermogrip.classify.estimators.base import despiked, grasp_labels, pick, record_list, unit_names
from thermogrip.classify.evaluation.comparison import Caution
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.grasp_files import Records
from thermogrip.datasets.schema import Grasps, has_touch_groups, label_values, log_name

_TELLING_VALUES = 10


@dataclass(frozen=True)
class Fold:
    """One condition in one repeat."""

    condition: str
    repeat: int
    train: Grasps
    test: Grasps
    apart: bool  # not pooled with others: its blocks were touched twice or their temperature is unknown

    @property
    def candidates(self) -> tuple[str, ...]:
        """The materials of the training grasps, sorted."""
        return tuple(sorted({str(m) for m in grasp_labels(self.train)}))


@dataclass(frozen=True)
class Plan:
    """All folds; ``training[repeat]``: training grasps of every condition; ``notes``: what is left out;
    ``cautions``: what the scores have to be read with."""

    folds: tuple[Fold, ...]
    training: tuple[tuple[Grasps, ...], ...]
    notes: tuple[str, ...]
    cautions: tuple[Caution, ...] = ()


def plan_folds(
    conditions: Records,
    *,
    split: str = "shipped",
    repeats: int = 20,
    train_per_class: int = 5,
    test: Records | None = None,
    seed: int = 0,
) -> Plan:
    """Return who trains and who is tested; the arguments are those of ``evaluate``."""
    records = despiked(record_list(conditions))
    _refuse_repeated(records)
    if test is not None:
        plan = _from_files(records, despiked(record_list(test)))
    elif split == "shipped":
        plan = _shipped(records)
    elif split == "random":
        plan = _random(records, repeats, train_per_class, seed)
    elif split in ("session", "block"):
        plan = _sessions_held_out(records, split, seed)
    else:
        raise UserError(f"split {split!r} is unknown", hint="use 'shipped', 'random', 'session' or 'block'")
    to_compare = records if test is None else []  # of test files no copy is let in
    copies = [Caution("leak", name, words) for name, words in _copied_records(to_compare).items()]
    nothing_to_score = dict.fromkeys(
        f"{fold.condition}: nothing to score, as no training grasp is of {', '.join(sorted(tested))}"
        for fold in plan.folds
        if not (tested := set(grasp_labels(fold.test))) & set(fold.candidates)
    )
    return replace(plan, notes=(*plan.notes, *nothing_to_score), cautions=(*plan.cautions, *copies))


def scored_apart(grasps: Grasps) -> bool:
    """Return whether a condition has touch groups or an object of unknown temperature."""
    unknown = "t_object" not in grasps or not bool(np.isfinite(grasps["t_object"].values).all())
    return has_touch_groups(grasps) or unknown


def _shipped(records: Sequence[Grasps]) -> Plan:
    trains = [marked for marked in (_marked(g, "train") for g in records) if marked is not None]
    folds, notes = [], []
    for grasps in records:
        name, test = log_name(grasps), _marked(grasps, "test")
        if test is None:
            notes.append(f"{name}: no grasp is marked 'test' in its split, so it only trains")
            continue
        like = _marked(grasps, "train")
        _refuse_torn(grasps, label_values(grasps, "split"), "split")
        if like is None:
            alike = _alike(test, trains)
            if alike is None:
                notes.append(f"{name}: no training grasps, nor a condition at its temperatures: left out")
                continue
            like = alike
            notes.append(f"{name}: no training grasps of its own, those of {log_name(like)} are used")
        if len(set(grasp_labels(like))) < 2:
            notes.append(f"{name}: its training grasps are of one material: left out")
            continue
        folds.append(Fold(name, 0, like, test, scored_apart(test)))
    if not folds:
        raise UserError(
            "no condition has a split with training and test grasps",
            file=", ".join(map(log_name, records)),
            hint="; ".join([*notes, "fill the column 'split' with train and test, or ask for random splits"]),
        )
    return Plan(tuple(folds), (tuple(trains),), tuple(notes))


def _random(records: Sequence[Grasps], repeats: int, train_per_class: int, seed: int) -> Plan:
    if repeats < 1:
        raise UserError(f"{repeats} repeats", hint="give at least one")
    if train_per_class < 1:
        raise UserError(f"{train_per_class} training grasps a material", hint="give at least one")
    folds: list[Fold] = []
    notes, cautions = [], list[Caution]()
    for number, whole in enumerate(records):
        name = log_name(whole)
        few = _too_few(whole, train_per_class)
        enough_grasps = ~np.isin(grasp_labels(whole), list(few))
        if len(set(grasp_labels(whole)[enough_grasps])) < 2:
            enough = (
                "grasps of one material"
                if not few
                else "grasps of two materials are needed, and " + ("; ".join(few.values()))
            )
            notes.append(f"{name}: {enough}: left out")
            continue
        cautions += [
            Caution("excluded_material", name, words, brief=f"no {material}")
            for material, words in few.items()
        ]
        grasps = pick(whole, enough_grasps) if few else whole
        try:
            _refuse_torn(grasps, grasp_labels(grasps), "material")
        except UserError as error:
            notes.append(f"{name}: {error.problem}: left out")
            continue
        rng = np.random.default_rng(seed + 7919 * number)
        labels, units = grasp_labels(grasps), unit_names(grasps)
        units_of = [np.unique(units[labels == material]) for material in dict.fromkeys(labels.tolist())]
        for repeat in range(repeats):
            chosen = np.concatenate([rng.permutation(names)[:train_per_class] for names in units_of])
            train = np.isin(units, chosen)
            folds.append(Fold(name, repeat, pick(grasps, train), pick(grasps, ~train), scored_apart(grasps)))
    if not folds:
        raise UserError("no condition can be split", hint="; ".join(notes))
    training = tuple(tuple(f.train for f in folds if f.repeat == repeat) for repeat in range(repeats))
    return Plan(tuple(folds), training, tuple(notes), tuple(cautions))


def _too_few(grasps: Grasps, train_per_class: int) -> dict[str, str]:
    """Return the materials that cannot give so many grasps to train and one to test, and that in words."""
    labels, units = grasp_labels(grasps), unit_names(grasps)
    counts = {str(m): np.unique(units[labels == m]).size for m in np.unique(labels)}
    return {
        name: f"{name} is left out: {n} grasp(s) cannot give {train_per_class} to train and one to test"
        for name, n in counts.items()
        if n <= train_per_class
    }


def _sessions_held_out(records: Sequence[Grasps], kind: str, seed: int) -> Plan:
    """Return a repeat for each session, or for the first, second ... block of each material."""
    keys = [_groups(grasps, kind) for grasps in records]
    rounds = _rounds(records, keys, kind, seed)
    folds: list[Fold] = []
    training, notes = [], []
    for repeat, held_out in enumerate(rounds):
        training_parts = []
        for grasps, key in zip(records, keys):
            name, out = log_name(grasps), np.isin(key, list(held_out))
            train = None if out.all() else pick(grasps, ~out)
            if train is not None:
                training_parts.append(train)
            if not out.any():
                continue
            if train is None or len(set(grasp_labels(train))) < 2:
                notes.append(f"{name}: without {', '.join(sorted(held_out))} too little is left to train on")
                continue
            folds.append(Fold(name, repeat, train, pick(grasps, out), scored_apart(grasps)))
        training.append(tuple(training_parts))
    if not folds:
        raise UserError(f"no condition can be split by {kind}", hint="; ".join(dict.fromkeys(notes)))
    return Plan(tuple(folds), tuple(training), tuple(dict.fromkeys(notes)))


def _groups(grasps: Grasps, kind: str) -> NDArray[np.str_]:
    """Return the session, or the material and block, of each grasp."""
    if kind == "session":
        named = (
            grasps["session"].values.astype(str)
            if "session" in grasps
            else np.full(grasps.sizes["grasp"], "")
        )
        return np.where(named == "", log_name(grasps), named)
    labels = grasp_labels(grasps)
    named = grasps["block"].values.astype(str) if "block" in grasps else labels
    return np.char.add(np.char.add(labels, " "), np.where(named == "", labels, named))


def _rounds(
    records: Sequence[Grasps], keys: Sequence[NDArray[np.str_]], kind: str, seed: int
) -> list[set[str]]:
    """Return what each repeat holds out."""
    for grasps, key in zip(records, keys):
        _refuse_torn(grasps, key, kind)
    every = np.unique(np.concatenate(keys)).tolist()
    if kind == "session":
        return [{name} for name in every]
    materials = np.concatenate([grasp_labels(grasps) for grasps in records])
    of = dict(zip(np.concatenate(keys).tolist(), materials.tolist()))
    rng = np.random.default_rng(seed)
    blocks = {m: rng.permutation([k for k in every if of[k] == m]).tolist() for m in sorted(set(of.values()))}
    fewest = min(len(names) for names in blocks.values())
    if fewest < 2:
        only = next(m for m, names in blocks.items() if len(names) < 2)
        raise UserError(f"there is one block of {only}", hint="give the column block, or split by grasp")
    return [{names[k] for names in blocks.values()} for k in range(fewest)]


def _refuse_torn(grasps: Grasps, labels: NDArray[np.str_], kind: str) -> None:
    """Refuse a block whose touches differ in the label that is split by."""
    units = unit_names(grasps)
    for unit in np.unique(units):
        if np.unique(labels[units == unit]).size > 1:
            hint = "its touches must agree"
            raise UserError(f"touches of {str(unit)!r} differ in {kind}", file=log_name(grasps), hint=hint)


def _from_files(records: Sequence[Grasps], tests: Sequence[Grasps]) -> Plan:
    """Return a fold for each test record, trained on the condition at its temperatures."""
    _refuse_repeated(tests)
    # of each record what is marked, or all of one that marks none
    marked = [_marked(record, "train") for record in records]
    trains = [record if of_it is None else of_it for record, of_it in zip(records, marked)]
    _refuse_shared(trains, tests)
    folds, notes = [], []
    for test in tests:
        like = trains[0] if len(trains) == 1 else _alike(test, trains)
        if like is None:
            raise UserError(
                "no training condition has its object and gripper temperatures",
                file=log_name(test),
                hint=f"the training files are {', '.join(map(log_name, trains))}",
            )
        notes.append(f"{log_name(test)}: candidates and training grasps are those of {log_name(like)}")
        folds.append(Fold(log_name(test), 0, like, test, scored_apart(test)))
    return Plan(tuple(folds), (tuple(trains),), tuple(notes))


def _refuse_shared(trains: Sequence[Grasps], tests: Sequence[Grasps]) -> None:
    """Refuse a test grasp that is in the training, by its name or by its samples."""
    for train in trains:
        for test in tests:
            shared = np.intersect1d(train["grasp"].values, test["grasp"].values)
            if shared.size:
                raise UserError(
                    f"grasp_id {str(shared[0])!r} is in training ({log_name(train)}) and in test",
                    file=log_name(test),
                    column="grasp_id",
                    hint="a grasp may be in one of them only; rename it if it is another grasp",
                )
    for name, words in _copied_records([*trains, *tests]).items():
        if name in map(log_name, tests):
            raise UserError(words, file=name, hint="leave one of the two out")


def _refuse_repeated(records: Sequence[Grasps]) -> None:
    """Refuse what is given twice: it would train in one place and be tested in another."""
    names = [log_name(g) for g in records]
    for name in names:
        if names.count(name) > 1:
            raise UserError(
                f"two conditions are called {name!r}", hint="give each file once, under its own name"
            )
    record_of: dict[tuple[str, bytes], str] = {}
    for grasps in records:
        for grasp_id, trace in zip(grasps["grasp"].values, grasps["t_surface"].values):
            key = (str(grasp_id), trace.tobytes())
            if key in record_of:
                raise UserError(
                    f"grasp {grasp_id!s} is in {record_of[key]} too",
                    file=log_name(grasps),
                    hint="leave one out",
                )
            record_of[key] = log_name(grasps)


def _copied_records(records: Sequence[Grasps]) -> dict[str, str]:
    """Return by record the number of its grasps that have the samples of others, where any has, in words."""
    first_of: dict[bytes, str] = {}
    copies: dict[str, list[str]] = {}
    for grasps in records:
        for grasp_id, trace in zip(grasps["grasp"].values, grasps["t_surface"].values):
            key, name = trace.tobytes(), log_name(grasps)
            if np.unique(trace[np.isfinite(trace)]).size < _TELLING_VALUES:
                continue  # a coarse sensor that reads the same twice
            if key in first_of:
                copies.setdefault(name, []).append(f"{grasp_id} of {first_of[key]}")
            first_of.setdefault(key, f"{name}/{grasp_id}")
    return {
        name: f"{len(pairs)} grasp(s) have the samples of another, {pairs[0]} first: a copy in training and "
        "in test is a leak"
        for name, pairs in copies.items()
    }


def _marked(grasps: Grasps, split: str) -> Grasps | None:
    if "split" not in grasps:
        return None
    rows = grasps["split"].values == split
    return pick(grasps, rows) if rows.any() else None


def _alike(test: Grasps, trains: Sequence[Grasps]) -> Grasps | None:
    """Return a training record at the same temperatures: of its name, its experiment, else the richest."""
    same = [t for t in trains if _temperatures(t) == _temperatures(test)]
    named = [t for t in same if log_name(t) == log_name(test)]
    kin = [t for t in same if _experiment(t) and _experiment(t) == _experiment(test)]
    rich = sorted(same, key=lambda t: -len(set(grasp_labels(t))))
    return next(iter(named + kin + rich), None)


def _temperatures(grasps: Grasps) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the set points of object and gripper [degC], to 0.1 degC."""

    def known(key: str) -> tuple[float, ...]:
        values = grasps[key].values if key in grasps else np.empty(0)
        return tuple(float(v) for v in np.unique(np.round(values[np.isfinite(values)], 1)))

    return known("t_object"), known("t_gripper")


def _experiment(grasps: Grasps) -> str:
    return str(grasps["experiment"].values[0]) if "experiment" in grasps else ""
