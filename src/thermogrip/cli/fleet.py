"""fleet: rigs of one kind identified together."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from thermogrip.cli import options as cli
from thermogrip.datasets.errors import UserError
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
    paths = _rigs(folder)
    cli.new_folder(out)
    console = Console(as_json)
    from thermogrip.datasets.parallel import run_parallel
    from thermogrip.report.fleet import drift_table, fleet_sections, population_table, rig_table
    from thermogrip.report.html import write_report
    from thermogrip.sysid.data.shipped_networks import shipped_network
    from thermogrip.sysid.greybox.drift import find_drift
    from thermogrip.sysid.greybox.population import pool_rigs, pooled_plant
    from thermogrip.sysid.models.network import NetworkModel
    from thermogrip.sysid.plant.log_grid import roles_of

    model = (
        cli.find_network(network) if network else shipped_network(cli.load_logs(next(iter(paths.values()))))
    )
    if not isinstance(model, NetworkModel):
        raise UserError("these logs are of no thermal network", file=folder, hint="name one with --network")
    logs = [cli.load_logs(files, known=roles_of(model)) for files in paths.values()]
    with console.progress("fleet") as progress:
        found = run_parallel(partial(_fitted, model, seed), logs, pool, progress, what="fitting rigs")
    plants = dict(zip(paths, found))
    population, rigs = pool_rigs(plants)
    population.save(out / "population.json")
    for rig in rigs:
        pooled_plant(plants[rig.name], rig).save(out / f"{rig.name}_plant.json")
    days, dated = _days(console, paths, logs)
    moved: tuple[Drift, ...] = ()
    if days:
        of_rig = dict(zip(paths, logs))
        each = [(name, log) for name in days for log in of_rig[name]]
        fit = partial(_fitted, population.prior_of(model), seed)
        with console.progress("drift") as progress:
            alone = run_parallel(fit, [[log] for _, log in each], pool, progress, what="fitting logs")
        by_rig = {name: [plant for (rig, _), plant in zip(each, alone) if rig == name] for name in days}
        moved, _ = find_drift(by_rig, days)
    if report is not None:
        lead = f"{len(rigs)} rigs, {sum(map(len, logs))} logs, network {population.network}."
        write_report(report, "Fleet", lead, fleet_sections(plants, population, rigs, moved, dated=dated))
    console.table("A new rig of this kind", *population_table(population, found[0]))
    console.table("Each rig against the others", *rig_table(rigs, population))
    ill, drifting = [rig.name for rig in rigs if rig.ill], [rig.name for rig in moved if rig.drifts]
    if moved:
        console.table("Each rig from its first log to its last", *drift_table(moved, population, dated=dated))
    console.say(f"unlike the others: {', '.join(ill)}" if ill else "no rig is unlike the others")
    if moved:
        console.say(f"changing: {', '.join(drifting)}" if drifting else "no rig is seen to change")
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
            "ill": ill, "changing": drifting, "out": out / "population.json",
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


def _rigs(folder: Path) -> dict[str, list[str]]:
    """Return the logs of each rig by its name, in order of their names."""
    if not folder.is_dir():
        raise UserError("is no folder", file=folder, hint="give a folder with one folder of logs a rig")
    found = {
        rig.name: [str(p) for p in sorted(rig.iterdir()) if p.is_file() and not p.name.startswith(".")]
        for rig in sorted(folder.iterdir())
        if rig.is_dir()
    }
    for name, files in found.items():
        if not files:
            raise UserError("has no log", file=folder / name, hint="take the empty folder away")
    if len(found) < 3:
        raise UserError(f"has {len(found)} folders of rigs", file=folder, hint="three rigs make a population")
    return found
