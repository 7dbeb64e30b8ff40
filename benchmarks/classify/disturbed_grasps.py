"""Grasps that the posterior's model does not explain: is it sure and wrong about them?

    OMP_NUM_THREADS=1 python benchmarks/classify/disturbed_grasps.py [--seed 1] [--each 12] [--parts rig]

- rig: test grasps of the examples, read one by one by the bundled gripper, as they are and disturbed by what
  happens to real fingers.  Kind by kind the size, its sign and the onset are drawn; sizes are shares of how
  far the grasp moved the skin's temperature.  Of the last ones the block is another than was taught: the
  grasp moves as the contact's own equations say.
- open: how well p_unknown tells materials of no block from the taught ones (AUROC).
- finite: fingers by finite volumes (finite_volumes.py), drawn anew by each seed and taught by plain grasps of
  four materials: materials and 90 % intervals of effusivity where blocks are covered, thin, or slip.
- outsiders: fingers of a thin soft skin, taught one day at one difference of 17 K, by which five materials,
  and nine that are none of them, are touched at other differences, and with temperatures stated wrongly.

Prints log loss beside chance, shares right, named, and wrong at p > .95; of intervals how many hold.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from finite_volumes import LENGTH, Disturbed, Rig, labelled
from numpy.typing import NDArray

from thermogrip.classify import answer, classify_grasps
from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import Grasps
from thermogrip.sysid.contact.materials import find_material
from thermogrip.sysid.contact.simulation import step_response, time_nodes
from thermogrip.sysid.effusivity.gripper_model import GripperModel, load_default_gripper
from thermogrip.sysid.effusivity.posterior import effusivity_posterior

Array = NDArray[np.float64]
Disturb = Callable[[Grasps, GripperModel, np.random.Generator], Array]

RECORDS = ("exp1A_obj43_grip23", "exp2_dT15", "exp2_dT20", "exp3A_obj43_grip23", "exp3B_obj28_grip48",
           "exp3C_obj18_grip38")  # fmt: skip
FOUR = ("copper", "iron", "stainless", "wood")
APART = ((43.0, 23.0), (28.0, 48.0), (18.0, 38.0))
TAUGHT = ("aluminium", "copper", "glass", "softwood", "stainless")
OUTSIDERS = ("acrylic", "brass", "brick", "concrete", "granite", "iron", "marble", "oak", "titanium")
DIFFERENCES = (6.0, 12.0, 22.0)  # K, of the finger above objects


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--each", type=int, default=12, help="grasps a kind; four times as many as they are")
    parser.add_argument("--parts", default="rig,open,finite")
    given = parser.parse_args()
    for part in given.parts.split(","):
        PARTS[part](given.seed, given.each)


def by_rig(seed: int, each: int) -> None:
    """Print what the bundled gripper makes of disturbed grasps of the examples."""
    device = load_default_gripper()
    known = PosteriorClassifier().with_device(device)
    classify_grasps(known, load_example_grasps()[RECORDS[0]].isel(grasp=[0]))
    begin_table("kind")
    disturbed, times = list[tuple[float, ...]](), dict[str, list[float]]()
    for kind in ("undisturbed", *KINDS):
        n, rows = each if kind in KINDS else 4 * each, list[tuple[float, ...]]()
        times[kind] = []
        for grasp in drawn_grasps(kind, n, seed, device):
            began = time.perf_counter()
            rows += scored(known, grasp, grasp.attrs["candidates"])
            times[kind].append(time.perf_counter() - began)
        say(kind, rows)
        disturbed += rows if kind in KINDS else []
    say("all disturbed", disturbed)
    plain, rest = np.array(times.pop("undisturbed")), np.concatenate([*times.values()])
    for what, took in (("undisturbed", plain), ("disturbed", rest)):
        print(f"one grasp, {what}: median {1e3 * np.median(took):.0f} ms, at most {1e3 * took.max():.0f} ms")


def by_open_set(seed: int, each: int) -> None:
    """Print how p_unknown tells materials of no block from the taught ones."""
    del seed, each
    known, examples = PosteriorClassifier().with_device(load_default_gripper()), load_example_grasps()
    test = examples["exp1A_obj43_grip23"]
    inside = p_unknown(known, test.isel(grasp=test["split"].values == "test"))
    others = examples["exp6_other_materials_obj43_grip23"]
    print("\n| material of no block | AUROC of p_unknown | least, median |\n|---|---|---|")
    for name in sorted(set(others["material"].values.tolist())):
        outside = p_unknown(known, others.isel(grasp=others["material"].values == name))
        print(f"| {name} | {auroc(outside, inside):.2f} | {outside.min():.2f}, {np.median(outside):.2f} |")
    print(f"| taught | | most {inside.max():.2f}, median {np.median(inside):.2f} |", flush=True)


def by_finite_volumes(seed: int, each: int) -> None:
    """Print materials and effusivities of disturbed grasps by a finger that the seed draws."""
    rig = drawn_rig(seed)
    known = PosteriorClassifier().fit(labelled(FOUR, repeats=5, seed=7000 + seed, rig=rig, conditions=APART))
    begin_table("finite volumes", "90 % intervals of e hold | width / plain |")
    disturbed, plain = list[tuple[float, ...]](), 1.0
    for kind, disturb in UNLIKE.items():
        repeats = max(1, round((3 if kind == "plain" else 1) * each / len(FOUR) / len(APART)))
        test = labelled(FOUR, repeats=repeats, seed=9000 + seed, rig=rig, conditions=APART, disturb=disturb)
        rows, holds, width = list[tuple[float, ...]](), list[bool](), list[float]()
        for record in test:
            for i in range(record.sizes["grasp"]):
                one = record.isel(grasp=[i])
                rows += scored(known, one, FOUR)
                true = find_material(str(one["material"].values[0])).effusivity
                (found,) = effusivity_posterior(known.device_, one)
                holds.append(found.effusivity_p05 <= true <= found.effusivity_p95)
                width.append(float(np.log(found.effusivity_p95 / found.effusivity_p05)))
        plain = float(np.median(width)) if kind == "plain" else plain
        say(kind, rows, f"{np.mean(holds):.2f} | {np.median(width) / plain:.2f} |")
        disturbed += rows if kind != "plain" else []
    say("all disturbed", disturbed)


def by_outsiders(seed: int, each: int) -> None:
    """Print what fingers taught at one difference make of others, of outsiders, and of wrong temperatures."""
    inside, outside = list[tuple[float, ...]](), list[tuple[Any, ...]]()
    slips = list[tuple[float, ...]]()
    beyond = 0
    for k in range(each // 2):
        rig = thin_finger(seed, k)
        known = PosteriorClassifier().fit(
            labelled(TAUGHT, repeats=4, seed=7000 + seed + k, rig=rig, conditions=((23.0, 40.0),))
        )
        beyond += known.device_.discrepancy is not None
        apart = tuple((23.0, 23.0 + difference) for difference in DIFFERENCES)
        for names, seen, repeats in ((TAUGHT, inside, 3), (OUTSIDERS, outside, 1)):
            test = labelled(names, repeats=repeats, seed=9000 + seed + k, rig=rig, conditions=apart)
            for difference, record in zip(DIFFERENCES, test):
                seen += [(difference, *row) for row in judged(known, record)]
        (record,) = labelled(TAUGHT, repeats=2, seed=9500 + seed + k, rig=rig, conditions=((23.0, 45.0),))
        for off in (-5.0, -2.5, 2.5, 5.0):
            wrong = record.assign(t_object=record["t_object"] + off)
            slips += [(off, *row) for row in judged(known, wrong)]
    print(f"\n{beyond} of {each // 2} fingers were found to read something beyond the model")
    columns = "log loss | right | refused | wrong, p > .95, p_unknown < .25 | and no note | not explained"
    for what, rows in (("difference [K]", inside), ("stated off by [K]", slips)):
        print(f"\n| {what} | {columns} |\n|---|---|---|---|---|---|---|")
        for value in dict.fromkeys(row[0] for row in rows):
            means = np.mean([row[1:7] for row in rows if row[0] == value], axis=0)
            print(f"| {value:g} | {' | '.join(f'{mean:.2f}' for mean in means)} |")
    columns = "p_unknown by difference | 90 % interval of e excludes what is named | and named"
    print(f"\n| none of the taught | {columns} |\n|---|---|---|---|")
    for name in OUTSIDERS:
        some = [row for row in outside if row[7] == name]
        by_difference = ", ".join(
            f"{np.mean([row[8] for row in some if row[0] == value]):.2f}" for value in DIFFERENCES
        )
        excluded = [row for row in some if row[9]]
        against = sum(row[8] < 0.5 for row in excluded)
        print(f"| {name} | {by_difference} | {len(excluded)} of {len(some)} | {against} |", flush=True)
    for value in DIFFERENCES:
        among, beside = (np.array([row[8] for row in rows if row[0] == value]) for rows in (outside, inside))
        print(f"AUROC of p_unknown at {value:g} K: {auroc(among, beside):.2f}")


def judged(known: PosteriorClassifier, record: Grasps) -> list[tuple[Any, ...]]:
    """Return of each grasp log loss, right, refused, wrong and sure, the same without a note, noted, its
    material, p_unknown, and whether the interval of its effusivity excludes the material that is nearest."""
    out = list[tuple[Any, ...]]()
    for i, true in enumerate(record["material"].values.astype(str).tolist()):
        one = record.isel(grasp=[i])
        (given,), (found,) = answer(known, one), effusivity_posterior(known.device_, one)
        p = {name: p or 0.0 for name, p in given.probabilities.items()}
        p_unknown = 1.0 if given.p_unknown is None else given.p_unknown
        sure = given.nearest != true and max(p.values()) > 0.95 and p_unknown < 0.25
        noted = any(note.code == "not_explained" for note in given.notes)
        e = find_material(given.nearest).effusivity if given.nearest else np.nan
        loss = -np.log(max(p.get(true, 1.0), 1e-9))
        out.append((loss, given.nearest == true, p_unknown > 0.5, sure, sure and not given.notes, noted, true,
                    p_unknown, not found.effusivity_p05 <= e <= found.effusivity_p95))  # fmt: skip
    return out


def thin_finger(seed: int, k: int) -> Rig:
    """Return a finger of a soft skin, a sensor in it, on metal with flowing water behind."""
    rng = np.random.default_rng([seed, 78, k])
    outer, inner = rng.uniform(2e-4, 5e-4, 2)
    soft = rng.uniform(0.5, 1.2), rng.uniform(1.6e6, 2.2e6)
    return Rig(
        layers=(
            (outer, *soft, 6), (inner, *soft, 6),
            (rng.uniform(5e-4, 2e-3), rng.uniform(100.0, 380.0), 3.4e6, 5),
            (1e-3, rng.uniform(2.0, 5.0), 4.2e6, 5), (0.03, 100.0, 4.2e6, 8),
        ),
        lag=rng.uniform(0.08, 0.3), h_c={}, h_c_else=rng.uniform(1100.0, 2200.0), h_c_sd=0.12,
        build=rng.uniform(0.25, 0.6), far=8.0, room=(22.5, 23.5), t_object_sd=0.2, scatter=0.04,
        noise=rng.uniform(0.01, 0.03), slow=0.003 * (k % 3 == 0), quantum=70 / 4096,
        # two of three have what the model lacks: a slow mass at the sensor, a skin that is not at rest
        beside=rng.uniform(0.2, 0.4) * (k % 3 == 1), tilt=rng.uniform(0.3, 0.6) * (k % 3 == 2),
    )  # fmt: skip


def drawn_rig(seed: int) -> Rig:
    """Return a finger with layers, lag and contact of its own."""
    rng = np.random.default_rng([seed, 77])
    sheet, inner, water = Rig().layers
    return Rig(
        layers=(
            (sheet[0] * rng.uniform(0.7, 1.6), sheet[1] * rng.uniform(0.6, 1.4), sheet[2], sheet[3]),
            (inner[0] * rng.uniform(0.7, 1.5), inner[1] * rng.uniform(0.7, 1.3), inner[2], inner[3]),
            water,
        ),
        lag=rng.uniform(0.08, 0.4), h_c_else=rng.uniform(900.0, 2200.0), build=rng.uniform(0.4, 0.9),
        h_c={"wood": rng.uniform(400.0, 800.0)}, far=rng.uniform(5.0, 25.0),
    )  # fmt: skip


def scored(
    known: PosteriorClassifier, grasps: Grasps, names: Sequence[str]
) -> list[tuple[float, float, bool, bool, bool]]:
    """Return log loss, chance, whether right, whether named, and whether sure and wrong, of each grasp."""
    out = []
    for row, true in zip(classify_grasps(known, grasps, names), grasps["material"].values.tolist()):
        p = {name: _p(row, name, len(names)) for name in names}
        best = max(p, key=p.__getitem__)
        named = row["material"] in names
        out.append((-np.log(max(p[true], 1e-9)), np.log(len(names)), best == true, named,
                    p[best] > 0.95 and best != true))  # fmt: skip
    return out


def _p(row: dict[str, Any], name: str, n: int) -> float:
    """Return the probability of a material; no answer counts as chance."""
    return 1.0 / n if row[f"p_{name}"] is None else float(row[f"p_{name}"])


def p_unknown(known: PosteriorClassifier, grasps: Grasps) -> Array:
    """Return p_unknown of each grasp, asked one by one."""
    each = (grasps.isel(grasp=[i]) for i in range(grasps.sizes["grasp"]))
    return np.array([float(classify_grasps(known, one)[0]["p_unknown"]) for one in each])


def auroc(high: Array, low: Array) -> float:
    """Return how often a value of the first kind is above one of the second."""
    above = (high[:, None] > low[None]) + 0.5 * (high[:, None] == low[None])
    return float(above.mean())


def begin_table(what: str, more: str = "") -> None:
    """Print the head of a table."""
    print(f"\n| {what} | log loss | chance | right | named | wrong at p > .95 | {more}")
    print("|---|---|---|---|---|---|" + "---|" * more.count("|"))


def say(kind: str, rows: Sequence[tuple[float, ...]], more: str = "") -> None:
    """Print one row of the table."""
    loss, chance, right, named, wrong = np.mean(np.array(rows, dtype=float), axis=0)
    shares = f"{right:.2f} | {named:.2f} | {wrong:.3f}"
    print(f"| {kind} | {loss:.2f} | {chance:.2f} | {shares} | {more}", flush=True)


def drawn_grasps(kind: str, n: int, seed: int, device: GripperModel) -> list[Grasps]:
    """Return ``n`` test grasps of the examples, records of one, disturbed by a kind of :data:`KINDS`."""
    examples = load_example_grasps()
    kinds = ("undisturbed", *KINDS)
    rng = np.random.default_rng([seed, kinds.index(kind)])
    out = []
    for _ in range(n):
        record = examples[RECORDS[rng.integers(len(RECORDS))]]
        test = np.flatnonzero(record["split"].values == "test")
        grasp = record.isel(grasp=[int(rng.choice(test))])
        if kind in KINDS:
            y = np.round(KINDS[kind](grasp, device, rng) * 16) / 16
            grasp = grasp.assign(t_surface=(("grasp", "time"), y[None]))
        grasp.attrs["candidates"] = sorted(set(record["material"].values.tolist()))
        out.append(grasp)
    return out


def second_time(grasp: Grasps, _: GripperModel, rng: np.random.Generator) -> Array:
    """A share of the response passes a second time constant."""
    t, y, level, _ = parts_of(grasp)
    share, tau = rng.uniform(0.1, 0.5), np.exp(rng.uniform(np.log(0.5), np.log(6.0)))
    return np.asarray((1 - share) * y + share * (level + lagged(t, y - level, tau)))


def slip(grasp: Grasps, _: GripperModel, rng: np.random.Generator) -> Array:
    """The finger comes off for a moment, falls back towards its own temperature, and a step remains."""
    t, y, level, swing = parts_of(grasp)
    onset, off = rng.uniform(0.5, 7.0), rng.uniform(0.2, 1.5)
    away = rng.uniform(0.05, 0.5) * ((t > onset) & (t < onset + off))
    remains = sign(rng) * rng.uniform(0.02, 0.25) * swing * (t > onset)
    return np.asarray(y - lagged(t, away * (y - level), 0.3) + lagged(t, remains, 0.3))


def regrasp(grasp: Grasps, _: GripperModel, rng: np.random.Generator) -> Array:
    """The finger leaves the block and closes again: the response goes back a way and begins anew."""
    t, y, level, _ = parts_of(grasp)
    onset, off = rng.uniform(1.0, 6.0), rng.uniform(0.5, 2.0)
    again = level + np.interp(t - onset - off, t, y - level, left=0.0)
    free = level + np.interp(onset, t, y - level) * np.exp(-(t - onset) / rng.uniform(1.0, 6.0))
    later = free + (again - level) * (1 - rng.uniform(0.2, 0.6))
    return np.asarray(np.where(t < onset, y, np.where(t < onset + off, free, later)))


def lag(grasp: Grasps, _: GripperModel, rng: np.random.Generator) -> Array:
    """The sensor is slower."""
    t, y, level, _ = parts_of(grasp)
    return level + lagged(t, y - level, np.exp(rng.uniform(np.log(0.2), np.log(2.0))))


def drift(grasp: Grasps, _: GripperModel, rng: np.random.Generator) -> Array:
    """The skin drifts."""
    t, y, _, swing = parts_of(grasp)
    return np.asarray(y + sign(rng) * rng.uniform(0.05, 0.4) * swing * (t + 2.0) / 12.0)


def offset(grasp: Grasps, _: GripperModel, rng: np.random.Generator) -> Array:
    """Readings are off from the contact on."""
    t, y, _, swing = parts_of(grasp)
    return np.asarray(y + sign(rng) * rng.uniform(0.03, 0.3) * swing * (t > 0.0))


def gain(grasp: Grasps, _: GripperModel, rng: np.random.Generator) -> Array:
    """The sensor's scale is off."""
    _, y, level, _ = parts_of(grasp)
    return np.asarray(level + (y - level) * (1 + sign(rng) * rng.uniform(0.03, 0.3)))


def stuck(grasp: Grasps, _: GripperModel, rng: np.random.Generator) -> Array:
    """Readings are dropped, the last one comes again in their place."""
    t, y, _, _ = parts_of(grasp)
    onset = rng.uniform(0.0, 8.0)
    kept = (t < onset) | (t > onset + rng.uniform(0.3, 3.0)) & (rng.uniform(size=t.size) > 0.2)
    last = np.maximum.accumulate(np.where(kept, np.arange(t.size), 0))
    return y[last]


def hum(grasp: Grasps, _: GripperModel, rng: np.random.Generator) -> Array:
    """A heater nearby switches."""
    t, y, _, swing = parts_of(grasp)
    wave = np.sin(2 * np.pi * t / rng.uniform(0.7, 8.0) + rng.uniform(0, 2 * np.pi))
    return np.asarray(y + rng.uniform(0.01, 0.15) * swing * lagged(t, np.sign(wave), 0.2))


def late(grasp: Grasps, _: GripperModel, rng: np.random.Generator) -> Array:
    """Contact is not at the closed message."""
    t, y, _, _ = parts_of(grasp)
    return np.asarray(np.interp(t - sign(rng) * rng.uniform(0.2, 0.9), t, y))


def warm(grasp: Grasps, device: GripperModel, rng: np.random.Generator) -> Array:
    """The object is not at its stated temperature."""
    off = sign(rng) * rng.uniform(1.0, 6.0)
    return changed(grasp, device, off=off)


def half(grasp: Grasps, device: GripperModel, rng: np.random.Generator) -> Array:
    """The block is thinner."""
    return changed(grasp, device, capacity=rng.uniform(0.25, 0.7))


def sheet(grasp: Grasps, device: GripperModel, rng: np.random.Generator) -> Array:
    """It is a sheet of one to two millimetres."""
    return changed(grasp, device, capacity=rng.uniform(0.05, 0.1))


def paint(grasp: Grasps, device: GripperModel, rng: np.random.Generator) -> Array:
    """A layer without capacity is between."""
    return changed(grasp, device, h_c=rng.uniform(0.25, 0.75))


def film(grasp: Grasps, device: GripperModel, rng: np.random.Generator) -> Array:
    """A layer that takes its time is between."""
    t, _, level, _ = parts_of(grasp)
    behind = changed(grasp, device, h_c=rng.uniform(0.3, 0.8))
    slow = lagged(t, behind - level, np.exp(rng.uniform(np.log(0.3), np.log(2.0))))
    return np.asarray(level + (1 - (share := rng.uniform(0.2, 0.7))) * (behind - level) + share * slow)


def press(grasp: Grasps, device: GripperModel, rng: np.random.Generator) -> Array:
    """The finger presses otherwise, and the contact builds up otherwise."""
    h_c, build_up = np.exp(rng.uniform(0.3, 0.8, 2) * rng.choice([-1.0, 1.0], 2))
    return changed(grasp, device, h_c=float(h_c), build_up=float(build_up))


def changed(
    grasp: Grasps, device: GripperModel, *, capacity: float = 1.0, h_c: float = 1.0, build_up: float = 1.0,
    off: float = 0.0,
) -> Array:  # fmt: skip
    """Return the readings of a grasp as of a block that differs by these factors, or is ``off`` [K]."""
    t, y, level, _ = parts_of(grasp)
    block, nodes = device.blocks[str(grasp["material"].values[0])], time_nodes(12.0)
    whole = block.heat_capacity * device.block_length * device.depth_share
    rise = step_response(
        device.stack, nodes, effusivity=np.exp(np.full(2, block.ln_effusivity)),
        capacity=whole * np.array([1.0, capacity]), h_c=np.exp(block.ln_h) * np.array([1.0, h_c]),
        build_up=device.stack.build_up * np.array([1.0, build_up]),
    ).rise  # fmt: skip
    before, after = (np.interp(np.maximum(t - device.onset, 0.0), nodes.t, row) for row in rise)
    away = float(grasp["t_object"].values[0]) - level
    return np.asarray(y + away * (after - before) + off * after)


KINDS: dict[str, Disturb] = {
    "second time": second_time, "slip": slip, "regrasp": regrasp, "lag": lag, "drift": drift,
    "offset": offset, "gain": gain, "stuck": stuck, "hum": hum, "late": late, "warm": warm, "half": half,
    "sheet": sheet, "paint": paint, "film": film, "press": press,
}  # fmt: skip


def _unlike(**drawn: Callable[[np.random.Generator, int], Array]) -> Callable[..., Disturbed]:
    def draw(n: int, rng: np.random.Generator) -> Disturbed:
        parts = vars(Disturbed.not_at_all(n))
        return Disturbed(**parts | {name: each(rng, n) for name, each in drawn.items()})

    return draw


UNLIKE: dict[str, Callable[..., Disturbed] | None] = {
    "plain": None,
    "film": _unlike(cover=lambda rng, n: rng.uniform(2e-5, 1e-4, n)),
    "paint": _unlike(cover=lambda rng, n: rng.uniform(1e-4, 2.5e-4, n)),
    "slip": _unlike(
        onset=lambda rng, n: rng.uniform(0.8, 6.0, n), off=lambda rng, n: rng.uniform(0.3, 1.5, n),
        during=lambda rng, n: rng.uniform(0.0, 0.5, n), after=lambda rng, n: rng.uniform(0.6, 1.3, n),
    ),
    "regrasp": _unlike(
        onset=lambda rng, n: rng.uniform(0.8, 4.0, n), off=lambda rng, n: rng.uniform(1.0, 3.0, n),
        during=lambda rng, n: np.full(n, 0.01), after=lambda rng, n: rng.uniform(0.5, 1.2, n),
    ),
    "sheet": _unlike(length=lambda rng, n: np.full(n, 1.5e-3)),
    "half": _unlike(length=lambda rng, n: LENGTH * rng.uniform(0.25, 0.6, n)),
}  # fmt: skip


def parts_of(grasp: Grasps) -> tuple[Array, Array, float, float]:
    """Return times [s], readings and level before the contact [degC], and how far the skin went [K]."""
    t, y = grasp["time"].values, grasp["t_surface"].values[0]
    level = float(np.nanmean(y[t < -0.25]))
    return t, y, level, float(np.nanmax(np.abs(y - level)))


def lagged(t: Array, x: Array, tau: float) -> Array:
    """Return what a first-order lag makes of ``x``."""
    out = np.array(x)
    for i in range(1, t.size):
        keep = np.exp(-(t[i] - t[i - 1]) / tau)
        out[i] = keep * out[i - 1] + (1 - keep) * x[i]
    return out


def sign(rng: np.random.Generator) -> float:
    """Return one or minus one."""
    return float(rng.choice([-1.0, 1.0]))


PARTS = {"rig": by_rig, "open": by_open_set, "finite": by_finite_volumes, "outsiders": by_outsiders}

if __name__ == "__main__":
    main()
