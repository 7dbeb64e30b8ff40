"""fleet: rigs of one kind identified together."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated

from thermogrip.cli import options as cli
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.file_names import is_table
from thermogrip.report.console import Console

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Log
    from thermogrip.sysid.greybox.drift import Drift
    from thermogrip.sysid.models.network import NetworkModel
    from thermogrip.sysid.plant.plant import Plant

_DATE = re.compile(r"(?<!\d)(20\d\d)[-_.]?(0[1-9]|1[0-2])[-_.]?(0[1-9]|[12]\d|3[01])(?!\d)")


def fleet(
    folder: Annotated[Path, cli.arg("LOGS_BY_RIG", "A folder with one folder of logs for each rig.")],
    out: Annotated[Path, cli.opt("--out", "DIR", "Where population.json and each RIG_plant.json go.")],
    network: Annotated[
        str | None, cli.opt("--network", "NAME|FILE", "As of identify; where absent, by the logs' columns.")
    ] = None,
    report: cli.Report = None,
    seed: cli.Seed = 0,
    workers: cli.Workers = 1,
    cluster: cli.Cluster = None,
    as_json: cli.AsJson = False,
) -> int:
    """Identify rigs of one kind together.

    Fits the network to the logs of each rig, finds how far each parameter differs from rig to rig, and what
    all rigs together say of each. Reports which rig is unlike the others, and of rigs with three logs or more
    which one changes from log to log, by their dates (of their clocks, or as 2026-03-01 in their names); exit
    code 3 if one is or does.
    """
    pool = cli.workers_of(workers, cluster)
    console = Console(as_json)
    paths = _rigs(console, folder)
    from thermogrip.datasets.parallel import run_parallel
    from thermogrip.report.fleet import (
        drift_table,
        drift_words,
        fleet_sections,
        ill_words,
        population_table,
        rig_table,
    )
    from thermogrip.report.html import write_report
    from thermogrip.sysid.data.shipped_networks import shipped_network
    from thermogrip.sysid.greybox.drift import find_drift
    from thermogrip.sysid.greybox.population import pool_rigs, pooled_plant, poorly_fitted
    from thermogrip.sysid.models.network import NetworkModel

    model = (
        cli.find_network(network) if network else shipped_network(cli.load_logs(next(iter(paths.values()))))
    )
    if not isinstance(model, NetworkModel):
        raise UserError("these logs are of no thermal network", file=folder, hint="name one with --network")
    logs = [_read(console, model, name, files) for name, files in paths.items()]
    _warn_of_repairs(console, paths, logs)
    fresh = not out.exists()
    cli.new_folder(out)
    try:
        with console.progress("fleet") as progress:
            found = run_parallel(partial(_fitted, model, seed), logs, pool, progress, what="fitting rigs")
    except (UserError, KeyboardInterrupt):  # a log is too short, say
        if fresh:
            out.rmdir()
        raise
    plants = dict(zip(paths, found))
    _warn_of_sd(console, model, found)
    population, rigs = pool_rigs(plants)
    population.save(out / "population.json")
    for rig in rigs:
        pooled_plant(plants[rig.name], rig).save(out / f"{rig.name}_plant.json")
    ill, badly = [rig.name for rig in rigs if rig.ill], poorly_fitted(plants)
    days, dated = _days(console, paths, logs)
    moved: tuple[Drift, ...] = ()
    if days:
        of_rig = dict(zip(paths, logs))
        each = [(name, log) for name in days for log in of_rig[name]]
        # ill rigs are no part of the population; a prior that has them too is as wide as they need
        wide = next((rig.others for rig in rigs if not rig.ill), population) if ill else population
        fit = partial(_fitted, wide.prior_of(model), seed)
        with console.progress("drift") as progress:
            alone = run_parallel(fit, [[log] for _, log in each], pool, progress, what="fitting logs")
        by_rig = {name: [plant for (rig, _), plant in zip(each, alone) if rig == name] for name in days}
        moved, _ = find_drift(by_rig, days)
    if report is not None:
        lead = f"{len(rigs)} rigs, {sum(map(len, logs))} logs, network {population.network}."
        write_report(report, "Fleet", lead, fleet_sections(plants, population, rigs, moved, dated=dated))
    console.table("A new rig of this kind", *population_table(population, found[0]))
    console.table("Each rig against the others", *rig_table(plants, rigs, population))
    drifting = [rig.name for rig in moved if rig.drifts]
    if moved:
        console.table("Each rig from its first log to its last", *drift_table(moved, population, dated=dated))
    console.say(ill_words(plants, rigs, population))
    if moved:
        console.say(drift_words(moved, population))
    console.say(f"wrote {out / 'population.json'}")
    change = {
        rig.name: {"drifts": rig.drifts, "chance": rig.chance, "days": rig.days.tolist() if dated else None,
                   "change": dict(zip(population.parameters, rig.change.tolist())),
                   "sd": dict(zip(population.parameters, rig.change_sd.tolist()))} for rig in moved
    }  # fmt: skip
    console.answer(
        {
            "population": vars(population) | {"intervals_90": population.intervals(0.9)},
            "rigs": [
                {"rig": r.name, "ill": r.ill, "distance": r.distance, "chance": r.chance,
                 "deviation": dict(zip(population.parameters, r.deviation.tolist())),
                 "from_first_to_last": change.get(r.name),
                 "out": out / f"{r.name}_plant.json"} for r in rigs
            ],
            "ill": ill, "misfit": list(badly), "changing": drifting, "out": out / "population.json",
        }
    )  # fmt: skip
    return cli.ANSWER_IS_NO if ill or drifting else 0


def _fitted(model: NetworkModel, seed: int, logs: list[Log]) -> Plant:
    """Return the plant of one rig."""
    from thermogrip.sysid.greybox.fit import fit_network

    return fit_network(model, logs, seed=seed)


def _days(
    console: Console, paths: Mapping[str, Sequence[str]], logs: Sequence[Sequence[Log]]
) -> tuple[dict[str, list[float]], bool]:
    """Return when the logs of rigs that have three or more began [days], and whether they are dated.

    Where one has no date, they are counted in the order of their names.
    """
    many = {name: (files, own) for (name, files), own in zip(paths.items(), logs) if len(own) >= 3}
    days: dict[str, list[float]] = {}
    for name, (files, own) in many.items():
        for file, log in zip(files, own):
            named = _DATE.search(Path(file).name)
            text = str(log.attrs.get("began", "-".join(named.groups()) if named else ""))
            try:
                at = datetime.fromisoformat(text).replace(tzinfo=UTC)
            except ValueError:
                console.warn(
                    f"{file}: says no date; the rigs' logs are taken in the order of their names (a date as "
                    "2026-03-01 in each name, or a clock in each file, says when they are of)"
                )
                return {rig: [*map(float, range(len(names)))] for rig, (names, _) in many.items()}, False
            days.setdefault(name, []).append(at.timestamp() / 86400)
    return {name: at for name, at in days.items() if max(at) > min(at)}, True


def _rigs(console: Console, folder: Path) -> dict[str, list[str]]:
    """Return the logs of each rig by its name, in order of their names, and warn of what is none."""
    if not folder.is_dir():
        raise UserError("is no folder", file=folder, hint="give a folder with one folder of logs a rig")
    found: dict[str, list[str]] = {}
    for rig in sorted(folder.iterdir()):
        if rig.name.startswith("."):
            continue
        if not rig.is_dir():
            if is_table(rig):
                console.warn(f"{rig}: is in no rig's folder and left out")
            continue
        inside = sorted(p for p in rig.iterdir() if not p.name.startswith("."))
        files = [p for p in inside if p.is_file() and is_table(p)]
        if not files:
            deeper = any(p.is_dir() for p in inside)
            hint = "put its logs into it, not deeper" if deeper else "put its logs there, or take it away"
            raise UserError("has no log", file=rig, hint=hint)
        for path in inside:
            if path not in files:
                console.warn(f"{path}: is no log and left out")
        found[rig.name] = [str(p) for p in files]
    if len(found) < 3:
        raise UserError(f"has {len(found)} folders of rigs", file=folder, hint="three rigs make a population")
    return found


def _read(console: Console, model: NetworkModel, rig: str, files: Sequence[str]) -> list[Log]:
    """Return the logs of a rig under its name, and warn of inputs that are missing or never move."""
    import numpy as np

    from thermogrip.sysid.plant.log_grid import match_logs, roles_of

    logs = cli.load_logs(files, known=roles_of(model))
    matched, said = match_logs(model, [log.assign_attrs(name=file) for file, log in zip(files, logs)])
    for line in said:
        console.warn(f"rig {rig}: {line}")
    for name in model.inputs:
        values = [log[name].values for log in matched]
        if max(float(np.nanmax(each)) for each in values) <= min(float(np.nanmin(each)) for each in values):
            console.warn(f"rig {rig}: {name} never moves; what it does is known from the other rigs only")
    return [log.assign_attrs(name=f"{rig}/{log.attrs['name']}") for log in logs]


def _warn_of_repairs(
    console: Console, paths: Mapping[str, Sequence[str]], logs: Sequence[Sequence[Log]]
) -> None:
    """Warn of what was repaired or converted while logs were read, once of what many have in common."""
    found: dict[str, list[str]] = {}
    seen: dict[str, str] = {}
    for files, own in zip(paths.values(), logs):
        for file, log in zip(files, own):
            if (first := seen.setdefault(str(log.attrs.get("sha256", file)), file)) != file:
                console.warn(f"{file}: has the data of {first}, and counts as another log; take one away")
            for line in filter(None, str(log.attrs.get("repairs", "")).splitlines()):
                if "counted from the first row" not in line:  # a clock, which is no fault
                    found.setdefault(line, []).append(file)
    for line, files in found.items():
        more = f" (and {len(files) - 1} more logs)" if len(files) > 1 else ""
        console.warn(f"{files[0]}{more}: {line}")


def _warn_of_sd(console: Console, model: NetworkModel, plants: Sequence[Plant]) -> None:
    """Warn of outputs whose sd in the network is far above what fits leave: it is what the population is
    weighed against."""
    for name, output in model.network.outputs.items():
        left = median(plant.noise[name] for plant in plants)
        if left < output.sd / 2:
            console.warn(
                f"{name}: fits leave {left:.2g} K, the network's sd is {output.sd:g}; lower it in a copy of "
                "the network, or the population pulls a rig away from what its logs say"
            )
