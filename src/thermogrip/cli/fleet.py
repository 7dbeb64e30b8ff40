"""fleet: rigs of one kind identified together."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from thermogrip.cli import options as cli
from thermogrip.datasets.errors import UserError
from thermogrip.report.console import Console

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Log
    from thermogrip.sysid.models.network import NetworkModel
    from thermogrip.sysid.plant.plant import Plant


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
    all rigs together say of each. Reports which rig is unlike the others (exit code 3 if one is).
    """
    pool = cli.workers_of(workers, cluster)
    paths = _rigs(folder)
    cli.new_folder(out)
    console = Console(as_json)
    from thermogrip.datasets.parallel import run_parallel
    from thermogrip.report.fleet import fleet_sections, population_table, rig_table
    from thermogrip.report.html import write_report
    from thermogrip.sysid.data.shipped_networks import shipped_network
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
    if report is not None:
        lead = f"{len(rigs)} rigs, {sum(map(len, logs))} logs, network {population.network}."
        write_report(report, "Fleet", lead, fleet_sections(plants, population, rigs))
    console.table("A new rig of this kind", *population_table(population, found[0]))
    console.table("Each rig against the others", *rig_table(rigs, population))
    ill = [rig.name for rig in rigs if rig.ill]
    console.say(f"unlike the others: {', '.join(ill)}" if ill else "no rig is unlike the others")
    console.say(f"wrote {out / 'population.json'}")
    console.answer(
        {
            "population": vars(population) | {"intervals_90": population.intervals(0.9)},
            "rigs": [
                {"rig": r.name, "ill": r.ill, "distance": r.distance, "chance": r.chance,
                 "deviation": dict(zip(population.parameters, r.deviation.tolist())),
                 "out": out / f"{r.name}_plant.json"} for r in rigs
            ],
            "ill": ill, "out": out / "population.json",
        }
    )  # fmt: skip
    return cli.ANSWER_IS_NO if ill else 0


def _fitted(model: NetworkModel, seed: int, logs: list[Log]) -> Plant:
    """Return the plant of one rig."""
    from thermogrip.sysid.greybox.fit import fit_network

    return fit_network(model, logs, seed=seed)


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
