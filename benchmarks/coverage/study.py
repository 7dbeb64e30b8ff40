"""Do 90 per cent intervals cover the truth nine times in ten?  Simulated rigs, fitted by the default fit.

    python benchmarks/coverage/study.py run --family wall --first 0 --count 200
    python benchmarks/coverage/study.py table
    python benchmarks/coverage/study.py figure docs/explanation/coverage.svg

Each replication draws a rig (its parameters from the network's prior, its missing terms, see rig.py), makes
four logs of 20 to 40 minutes, fits ``bath.toml`` and writes one line to ``results/FAMILY.csv``: seed, and for
each parameter the truth, the estimate and the ends of the interval that ``Plant.intervals`` gives.  A
replication that is there already is not run again, so a study that was stopped goes on; several processes may
run at once on different families or seeds.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom, norm

from rig import FAMILIES, draw_rig, make_logs
from thermogrip.datasets.schema import Log
from thermogrip.sysid.greybox.fit import fit_network
from thermogrip.sysid.models.network import NetworkModel, load_network
from thermogrip.sysid.plant.plant import Plant

HERE = Path(__file__).parent
RESULTS = HERE / "results"
LEVEL = 0.9

Row = dict[str, float]


def replicate(model: NetworkModel, family: str, seed: int) -> tuple[Row, Plant, list[Log]]:
    """Return one line of the study, the fitted plant and its logs."""
    rng = np.random.default_rng([seed, FAMILIES.index(family)])
    rig = draw_rig(model, family, rng)
    logs = make_logs(rig, rng)
    plant = fit_network(model, logs)
    return line(plant, rig.truth, seed), plant, logs


def line(plant: Plant, truth: dict[str, float], seed: int) -> Row:
    """Return truth, estimate and interval of each parameter, on the scale of its prior."""
    row: Row = {"seed": seed, "between_logs": plant.scores.intervals.between_logs}
    for name, (low, high) in plant.intervals(LEVEL).items():
        scale = np.log if plant.scales[name] == "log" else float
        ends = {"true": truth[name], "fit": plant.values[name], "low": low, "high": high}
        row |= {f"{name}.{end}": round(float(scale(value)), 6) for end, value in ends.items()}
    return row


def run(family: str, first: int, count: int) -> None:
    """Do the replications that are not there yet."""
    model, path = load_network(HERE / "bath.toml"), RESULTS / f"{family}.csv"
    RESULTS.mkdir(exist_ok=True)
    done = {int(row["seed"]) for row in read(path)}
    for seed in range(first, first + count):
        if seed in done:
            continue
        row, _, _ = replicate(model, family, seed)
        new = not path.exists()
        with path.open("a", newline="") as file:
            writer = csv.DictWriter(file, list(row))
            if new:
                writer.writeheader()
            writer.writerow(row)


def read(path: Path) -> list[Row]:
    """Return the lines of a results file, by seed; none where there is no file."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        rows = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
    return sorted(rows, key=lambda row: row["seed"])


def inside(rows: Sequence[Row]) -> tuple[list[str], NDArray[np.bool_]]:
    """Return the parameters' names and whether each interval (n_row, n_parameter) holds its truth."""
    names = [key.removesuffix(".true") for key in rows[0] if key.endswith(".true")]
    return names, np.array([[r[f"{n}.low"] <= r[f"{n}.true"] <= r[f"{n}.high"] for n in names] for r in rows])


def table() -> str:
    """Return the coverage of each family and parameter as a Markdown table."""
    found = {family: read(RESULTS / f"{family}.csv") for family in FAMILIES}
    found = {family: rows for family, rows in found.items() if rows}
    names, _ = inside(next(iter(found.values())))
    heads = [f"{family} (n = {len(rows)})" for family, rows in found.items()]
    lines = [f"| parameter | {' | '.join(heads)} |", "|---" * (len(heads) + 1) + "|"]
    hits = [inside(rows)[1] for rows in found.values()]
    for k, name in enumerate(names):
        lines.append(f"| {name} | {' | '.join(f'{hit[:, k].mean():.1%}' for hit in hits)} |")
    lines.append(f"| **all** | {' | '.join(f'**{hit.mean():.1%}**' for hit in hits)} |")
    ends = [binom.ppf([0.005, 0.995], len(hit), LEVEL) / len(hit) for hit in hits]
    bounds = " | ".join(f"{a:.0%} to {b:.0%}" for a, b in ends)
    lines.append(f"| 99 % of such studies, one parameter | {bounds} |")
    widths = [_relative_width(rows, names) for rows in found.values()]
    lines.append(f"| median width over that of the prior | {' | '.join(f'{w:.2f}' for w in widths)} |")
    return "\n".join(lines)


def _relative_width(rows: Sequence[Row], names: Sequence[str]) -> float:
    specs = load_network(HERE / "bath.toml").specs
    prior = {n: 2 * norm.ppf(0.5 + LEVEL / 2) * float(specs[n].sd_log or specs[n].sd or 1.0) for n in names}
    return float(np.median([[(r[f"{n}.high"] - r[f"{n}.low"]) / prior[n] for n in names] for r in rows]))


def figure(path: Path) -> None:
    """Draw the coverage of each parameter, and how far truths lie from estimates."""
    from matplotlib.figure import Figure

    found = {family: rows for family in FAMILIES if (rows := read(RESULTS / f"{family}.csv"))}
    drawn = Figure(figsize=(8.4, 5.6), layout="constrained")
    above, below = drawn.subplots(2, len(found), sharex="row", sharey="row", squeeze=False)
    for ax, beneath, (family, rows) in zip(above, below, found.items()):
        names, hit = inside(rows)
        low, high = binom.ppf([0.005, 0.995], len(rows), LEVEL) / len(rows)
        ax.axvspan(low, high, color="0.9")
        ax.axvline(LEVEL, color="0.6", lw=0.8)
        ax.plot(hit.mean(axis=0), range(len(names)), "o", ms=4, color="tab:blue")
        ax.set_yticks(range(len(names)), names, fontsize=7)
        ax.set_title(f"{family}: {hit.mean():.1%} of {hit.size}", fontsize=9)
        ax.set_xlabel("coverage of 90 % intervals", fontsize=8)
        ends = 2 * norm.ppf(0.5 + LEVEL / 2)
        sd = np.array([[(r[f"{n}.high"] - r[f"{n}.low"]) / ends for n in names] for r in rows])
        z = np.array([[r[f"{n}.true"] - r[f"{n}.fit"] for n in names] for r in rows]).ravel() / sd.ravel()
        grid = np.linspace(-4, 4, 200)
        edges = np.linspace(-4, 4, 41)
        beneath.hist(np.clip(z, -4, 4), bins=edges, density=True, color="tab:blue", alpha=0.5)
        beneath.plot(grid, norm.pdf(grid), color="0.3", lw=1)
        beneath.set_xlabel("(truth - estimate) / stated sd", fontsize=8)
        beneath.set_yticks([])
    drawn.savefig(path)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description="Coverage of the intervals that a fit states.")
    verbs = parser.add_subparsers(dest="verb", required=True)
    verb = verbs.add_parser("run")
    verb.add_argument("--family", choices=FAMILIES, required=True)
    verb.add_argument("--first", type=int, default=0)
    verb.add_argument("--count", type=int, default=200)
    verbs.add_parser("table")
    verbs.add_parser("figure").add_argument("path", type=Path)
    given = parser.parse_args()
    if given.verb == "run":
        run(given.family, given.first, given.count)
    elif given.verb == "table":
        print(table())
    else:
        figure(given.path)


if __name__ == "__main__":
    main()
