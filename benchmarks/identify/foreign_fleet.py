"""Fleets of rigs that share nothing with the package, through its command line as a user has it.

    python benchmarks/identify/foreign_fleet.py CASE --out DIR [--seed 0] [--workers 2]

Rigs are explicit Euler in steps of 0.05 s and written as text by hand.  Two heaters with a sensor each, as
the shipped ``tclab`` has them; ``structure`` has a base plate, natural convection and a dead time besides.
CASE: dressed, structure, loose, fan, drift, single, alike, copies, groups, tied, wide, prior.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

NAMES = ("G_amb", "G_between", "power_1", "power_2", "lag_1", "lag_2")
MIDDLE = np.log([0.0125, 0.0032, 1.2, 0.9, 15.0, 17.0])
SIGMA, STEP = 5.67e-8, 0.05
BOARDS = (
    "Prüfstand 1", "rig β (lab 2)", "Büro Süd", "台 4", "rig-5", "No. 6", "a b  c", "Ørsted", "9", "J&J",
    "k'11", "zwölf",
)  # fmt: skip


def run_rig(theta, drives, room, *, structure=False):
    """Return the two sensors (n, 2) at every step; ``drives`` (n, 2) in percent, theta in ln."""
    loss, between, p1, p2, lag1, lag2 = np.exp(theta)
    power, lag, mass, eps = (p1, p2), (lag1, lag2), 2.0, 0.9
    heat, sensor, plate = [room, room], [room, room], room
    late = 60 if structure else 0
    out = np.empty((len(drives), 2))
    for i in range(len(drives)):
        out[i] = sensor
        q = drives[max(i - late, 0)]
        kelvin = [h + 273.15 for h in heat]
        air = (room + 273.15) ** 4
        swap = between * (heat[1] - heat[0]) + SIGMA * eps * 2e-4 * (kelvin[1] ** 4 - kelvin[0] ** 4)
        flow = []
        for k in (0, 1):
            dT = heat[k] - room
            g = loss * (abs(dT) / 30) ** 0.25 if structure else loss
            flow.append(power[k] * q[k] / 100 - g * dT + SIGMA * eps * 1e-3 * (air - kelvin[k] ** 4))
        flow[0] += swap
        flow[1] -= swap
        if structure:
            for k in (0, 1):
                flow[k] -= 0.006 * (heat[k] - plate)
            plate += STEP * (0.006 * (heat[0] + heat[1] - 2 * plate) - 0.01 * (plate - room)) / 12.0
        for k in (0, 1):
            sensor[k] += STEP * (heat[k] - sensor[k]) / lag[k]
            heat[k] += STEP * flow[k] / mass
    return out


def record(path, theta, rng, *, minutes=10, every=2.0, unit="degC", day=None, noise=0.15, structure=False):
    """Write a log of a rig."""
    hold, n = round(50 / STEP), round(60 * minutes / STEP)
    moves = rng.uniform(0, 80, (n // hold + 1, 2)).round()
    moves[0] = 0
    drives = np.repeat(moves, hold, axis=0)[:n]
    room = 22.5 + 0.7 * rng.normal()
    take = round(every / STEP)
    read = run_rig(theta, drives, room, structure=structure)[::take]
    drives = drives[::take]
    if noise:
        read = 0.05 * np.round((read + noise * rng.normal(size=read.shape)) / 0.05)
    scale = {"degC": lambda x: x, "degF": lambda x: 1.8 * x + 32, "K": lambda x: x + 273.15}[unit]
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = ["time_s,q1_percent,q2_percent," + f"t1_{unit},t2_{unit}"]
    if day is not None:
        lines[0] = lines[0].replace("time_s", "time")
    for i, (q, y) in enumerate(zip(drives, scale(read))):
        when = (
            f"{i * every:.2f}"
            if day is None
            else (day + timedelta(seconds=i * every)).isoformat(" ", "milliseconds")
        )
        lines.append(f"{when},{q[0]:.0f},{q[1]:.0f},{y[0]:.3f},{y[1]:.3f}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def rigs_of(case, rng):
    """Return the truth (n, 6) of a case's rigs."""
    n = {"drift": 8, "alike": 8, "copies": 4}.get(case, 12)
    sd = np.array([0.15] * 4 + [0.3] * 2)
    if case in ("loose", "fan", "drift"):
        sd = np.array([0.1] * 4 + [0.15] * 2)
    if case == "wide":
        sd = np.full(6, 0.5)
    if case in ("alike", "copies"):
        sd = np.zeros(6)
    z = rng.normal(size=(n, 6))
    if case == "tied":
        sd = np.array([0.2] * 6)
        common = rng.normal(size=n)
        for k in (0, 2, 3):
            z[:, k] = np.sqrt(0.95) * common + np.sqrt(0.05) * z[:, k]
    theta = MIDDLE + sd * z
    if case == "groups":
        theta[:, 0] = MIDDLE[0] + 0.05 * z[:, 0] + np.log(2) * (np.arange(n) % 2) - np.log(2) / 2
    if case == "loose":
        theta[3, 4] += np.log(2.0)
    if case == "fan":
        theta[3, 0] += np.log(0.4)
    return theta


def write_fleet(case, folder, seed):
    """Write the logs of a case's fleet and return the truth."""
    rng = np.random.default_rng([seed, 2026])
    theta = rigs_of(case, rng)
    for i, row in enumerate(theta):
        if case == "dressed":
            name = BOARDS[i]
        else:
            name = f"rig{i:02d}"
        for j in range({"drift": 6, "copies": 1}.get(case, 3)):
            path, own = folder / name / f"log {j}.csv", {}
            if case == "dressed":
                own = {"every": (0.5, 2.0, 10.0)[i % 3], "unit": ("degC", "degF", "K")[i // 3 % 3]}
                own["day"] = datetime(2026, 3, 1 + 9 * j + i % 5, 9, 30)
            if case == "drift":
                day = row + 0.02 * rng.normal(size=6)
                day[0] += np.log(1.2) * j / 5 * (i == 2)
                record(path, day, rng, minutes=15, day=datetime(2026, 1 + j, 5 + i % 3, 8))
                continue
            if case == "single" and i == 5 and j:
                continue
            if case == "copies":
                rng = np.random.default_rng(1)
            record(path, row, rng, structure=case == "structure", **own)
    return theta


def thermogrip(*words):
    """Return exit code and answer of a command."""
    begin = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "thermogrip", *map(str, words), "--json"], capture_output=True, text=True
    )
    said = f"exit {done.returncode}, {time.perf_counter() - begin:.0f} s"
    print(f"$ thermogrip {' '.join(map(str, words))}: {said}")
    for line in done.stderr.splitlines():
        if not line.startswith("\r") and line.strip():
            print("  |", line[:300])
    return done.returncode, json.loads(done.stdout) if done.stdout.strip() else {}


def theta_of(path):
    """Return ln of the parameters of a plant, and their 90 % intervals."""
    from thermogrip.sysid.plant.plant import Plant

    plant = Plant.load(path)
    return np.log([plant.values[name] for name in NAMES]), np.log([plant.intervals(0.9)[n] for n in NAMES])


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("case")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--noise", type=float, default=0.15, help="of the new rigs of prior [K]")
    parser.add_argument("--network", default="tclab", help="of the new rigs of prior")
    parser.add_argument("--write-only", action="store_true")
    given = parser.parse_args()
    case, out = given.case, given.out
    folder = out / "rigs"
    if case == "prior":
        new_rigs(out, given.seed, given.noise, given.network)
        return
    theta = write_fleet(case, folder, given.seed)
    out.joinpath("truth.json").write_text(json.dumps(theta.tolist()))
    if given.write_only:
        return
    _, answer = thermogrip(
        "fleet", folder, "--network", "tclab", "--out", out / "fleet", "--workers", given.workers,
        "--report", out / "fleet.html",
    )  # fmt: skip
    if not answer:
        return
    print("ill", answer["ill"], "changing", answer["changing"])
    first = sorted(answer["rigs"], key=lambda rig: rig["chance"])[:2]
    for rig in first:
        far = max(rig["deviation"], key=lambda name: abs(rig["deviation"][name]))
        print(f"  {rig['rig']}: chance {rig['chance']:.2g}, {far} off by {rig['deviation'][far]:+.1f} sd")
    population = answer["population"]
    at = [population["parameters"].index(name) for name in NAMES]
    print("spread found", np.round(np.array(population["spread"])[at], 3))
    print("spread true ", theta.std(axis=0, ddof=1).round(3))
    print("mean off    ", (np.array(population["mean"])[at] - theta.mean(axis=0)).round(3))
    low, high = np.log([population["intervals_90"][name] for name in NAMES]).T
    print(f"the population's 90 % has {np.mean((low < theta) & (theta < high)):.3f} of its own rigs")
    new = np.array([rigs_of(case, np.random.default_rng([7, k])) for k in range(50)]).reshape(-1, 6)
    print(f"and of new rigs {np.mean((low < new) & (new < high)):.3f}, by parameter",
          ((low < new) & (new < high)).mean(axis=0).round(2))  # fmt: skip
    for rig in answer["rigs"]:
        moved = rig["from_first_to_last"]
        if case == "drift" and moved:
            change, sd = moved["change"]["G_amb"], moved["sd"]["G_amb"]
            print(
                f"  {rig['rig']}: ln G_amb changed by {change:+.3f} +- {sd:.3f}, chance {moved['chance']:.2g}"
            )
    if case in ("dressed", "single", "tied", "wide", "structure", "groups", "alike"):
        against_alone(case, out, theta, given.seed)


def against_alone(case, out, theta, seed):
    """Print errors of each rig fitted by itself beside those of its pooled plant."""
    from thermogrip.datasets.log_files import read_log
    from thermogrip.sysid.greybox.fit import fit_network
    from thermogrip.sysid.greybox.population import pool_rigs
    from thermogrip.sysid.models.network import load_network

    names = sorted(p.name for p in (out / "rigs").iterdir())
    order = sorted(range(len(theta)), key=lambda i: BOARDS[i] if case == "dressed" else f"rig{i:02d}")
    theta = theta[order]
    model = load_network("tclab")
    fits = {}
    for name in names:
        logs = [read_log(str(p)) for p in sorted((out / "rigs" / name).iterdir())]
        fits[name] = fit_network(model, logs)
    _, rigs = pool_rigs(fits)
    alone = np.log([[fits[name].values[p] for p in NAMES] for name in names])
    pooled, sds, inside = [], [], []
    for rig in rigs:
        value, bands = theta_of(out / "fleet" / f"{rig.name}_plant.json")
        pooled.append(value)
        sds.append((bands[:, 1] - bands[:, 0]) / 3.29)
    pooled = np.array(pooled)
    inside = [
        [
            r.others.intervals(0.9)[p][0] < np.exp(v) < r.others.intervals(0.9)[p][1]
            for p, v in zip(NAMES, row)
        ]
        for r, row in zip(rigs, theta)
    ]
    a, b = alone - theta, pooled - theta
    print(f"rms of ln p: alone {np.sqrt((a**2).mean()):.3f}, pooled {np.sqrt((b**2).mean()):.3f}; by rig")
    for name, x, y, s in zip(names, a, b, sds):
        print(
            f"  {name}: {np.sqrt((x**2).mean()):.3f} {np.sqrt((y**2).mean()):.3f}, pooled sd {s.mean():.3f}"
        )
    ranges = np.log([[fits[name].intervals(0.9)[p] for p in NAMES] for name in names])
    own = np.mean((ranges[..., 0] < theta) & (theta < ranges[..., 1]))
    of_all = np.mean(np.abs(b) < 1.645 * np.array(sds))
    print(f"the fits' own 90 % intervals have {own:.3f}; the pooled plants' {of_all:.3f}")
    print(f"the others' 90 % intervals have {np.mean(inside):.3f}")
    if case == "structure":
        rng, errors = np.random.default_rng([seed, 5]), []
        for name, row in zip(names, theta):
            record(out / "check" / f"{name}.csv", row, rng, minutes=20, noise=0, structure=True)
            log = read_log(str(out / "check" / f"{name}.csv"))
            from dataclasses import replace

            from thermogrip.sysid.plant.plant import Plant

            room = float(log["t1"].values[0])
            for plant in (fits[name], Plant.load(out / "fleet" / f"{name}_plant.json")):
                run = replace(plant, offsets={}, values=plant.values | {"t_room": room}).simulate(log)
                errors.append(np.mean([((run[k] - log[k]) ** 2).mean() for k in ("t1", "t2")]))
        one, other = np.sqrt(np.reshape(errors, (-1, 2)).mean(axis=0))
        print(f"free run of 20 min: alone {one:.2f} K, pooled {other:.2f} K")


def new_rigs(out, seed, noise, network):
    """Print the errors of ten new rigs, one log of 5 min each, with and without the population as prior."""
    prior = out / "fleet" / "population.json"
    rng, rows, inside = np.random.default_rng([seed, 99]), [], []
    truths = rigs_of("dressed", rng)[:10]
    for i, theta in enumerate(truths):
        log = out / f"new/{i}.csv"
        record(log, theta, rng, minutes=5, noise=noise)
        both = []
        for more in ((), ("--prior", prior)):
            plant = out / f"new/{i}{'_with' * bool(more)}.json"
            thermogrip("identify", log, "--network", network, "--models", "network", "--out", plant, *more)
            value, bands = theta_of(plant)
            both += [((value - theta) ** 2).mean()]
            inside.append(((bands[:, 0] < theta) & (theta < bands[:, 1])).mean())
        rows.append(both)
    rows = np.sqrt(np.array(rows))
    print(
        "rms of ln p, without and with:",
        np.sqrt((rows**2).mean(axis=0)).round(3),
        "better in",
        int((rows[:, 1] < rows[:, 0]).sum()),
    )
    print("90 % intervals have, without and with:", np.reshape(inside, (-1, 2)).mean(axis=0).round(3))


if __name__ == "__main__":
    main()
