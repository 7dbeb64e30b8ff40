"""identify, validate, simulate, linearise: from logs to a plant, and what a plant says."""

from __future__ import annotations

import re
import shlex
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from thermogrip.cli import options as cli
from thermogrip.datasets.errors import UserError
from thermogrip.media.rendering import printable
from thermogrip.report.console import Console, significant

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from thermogrip.datasets.parallel import Progress
    from thermogrip.datasets.schema import Log
    from thermogrip.sysid.export.dynamics import Dynamics
    from thermogrip.sysid.greybox import Posterior
    from thermogrip.sysid.identification import Identification
    from thermogrip.sysid.models.model import GreyModel
    from thermogrip.sysid.plant.plant import Plant
    from thermogrip.sysid.validation import Band, FreeRun

MODELS = ("arx", "oe", "armax", "bj", "subspace", "parsim", "sindy", "neural", "network")
USUAL_MODELS = ",".join(model for model in MODELS if model not in ("armax", "bj", "parsim", "sindy"))
MOST_DOUBTS = 6  # that are printed: one command states what all of them are about
NO_POSTERIOR = "no posterior: the model that was kept is a black box, only networks have parameters to sample"


def _known_models(value: str) -> str:
    """Ask that every model of a list is known (``callback=``)."""
    for name in cli.comma(value) or ():
        cli.choice("--models", name, MODELS)
    return value


def _beside_log(ctx: typer.Context, value: Path | None) -> Path:
    """Return where the plant goes: LOG_plant.json where nothing names it (``callback=``)."""
    if value is not None:
        return value
    from thermogrip.datasets.files import file_stem, split_cut

    return Path(f"{file_stem(split_cut(ctx.params['paths'][0]).file)}_plant.json")


Warmup = Annotated[
    float, cli.opt("--warmup", "S", "Measured outputs of these first seconds may set the state.", min=0)
]
Average = Annotated[
    float | None, cli.opt("--average", "S", "Average over S seconds first (coarse sensors need it).", min=0)
]


def identify(
    ctx: typer.Context,
    paths: cli.LogFiles,
    out: Annotated[
        Path | None,
        cli.opt("--out", "FILE.json", "Where the plant goes; where absent, LOG_plant.json.", _beside_log),
    ] = None,
    network: Annotated[
        str | None,
        cli.opt(
            "--network",
            "NAME|FILE",
            "A shipped one (init network --like), none, FILE.toml, FILE.py:CLASS (which runs the file); "
            "where absent, the shipped one whose columns the logs have.",
        ),
    ] = None,
    inputs: Annotated[str | None, cli.opt("--inputs", "A,B", "Columns that are moved.")] = None,
    outputs: Annotated[str | None, cli.opt("--outputs", "C,D", "Columns to predict.")] = None,
    disturbances: Annotated[
        str | None, cli.opt("--disturbances", "E", "Columns that are measured and not moved.")
    ] = None,
    columns: cli.Columns = None,
    dt: cli.Step = None,
    models: Annotated[
        str,
        cli.opt(
            "--models",
            "LIST",
            "Which candidate models to fit, of these, armax, bj, parsim and sindy.",
            _known_models,
        ),
    ] = USUAL_MODELS,
    average: Average = None,
    leave_one_out: Annotated[
        bool, cli.flag("--leave-one-out", "Score each log by a fit to the others.")
    ] = False,
    posterior: Annotated[
        bool, cli.flag("--posterior/--no-posterior", "Sample the parameters' posterior until it converges.")
    ] = False,
    report: cli.Report = None,
    seed: cli.Seed = 0,
    workers: cli.Workers = 1,
    cluster: cli.Cluster = None,
    as_json: cli.AsJson = False,
) -> int:
    """Find the plant behind one or several logs.

    Checks the data, fits candidate models, scores each by free run on held-out data, keeps the best one.
    """
    wanted = cli.comma(models) or ()
    pool = cli.workers_of(workers, cluster)
    assert out is not None  # its callback names one
    cli.new_file(out, (".json",))
    roles = cli.comma(inputs), cli.comma(outputs), cli.comma(disturbances)
    a_network = "network" in wanted and network != "none"
    wanted_network = cli.find_network(network) if a_network and network else None
    console = Console(as_json)
    from thermogrip.datasets.units import find_column

    read = partial(cli.load_logs, paths, *roles, columns=cli.comma(columns), dt=dt)
    logs, wanted_network = _read(read, wanted_network, shipped=a_network)
    repairs = _repaired(console, logs)
    have = {str(name): str(values.attrs["units"]) for name, values in logs[0].data_vars.items()}
    inputs_read, outputs_read, disturbances_read = (  # what a word means may be written otherwise
        None if words is None else tuple(find_column(w, have) for w in words) for words in roles
    )
    roles = inputs_read, outputs_read, disturbances_read
    from thermogrip.datasets.parallel import sub_progress
    from thermogrip.report.html import write_report
    from thermogrip.report.plant import identification_sections
    from thermogrip.sysid.export.dynamics import settled_dynamics
    from thermogrip.sysid.identification import identify as fit_models

    record, lost = None, NO_POSTERIOR
    with console.progress("identify") as progress:
        identified = fit_models(
            logs,
            wanted_network,
            *roles,
            models=wanted,
            average=average,
            leave_one_out=leave_one_out,
            draws=0 if posterior else 24,
            seed=seed,
            workers=pool,
            progress=sub_progress(progress, 0.0, 0.6 if posterior else 1.0),
            early=None if network else partial(_write_early, console, out),
        )
        plant = identified.plant
        if network and wanted_network is not None and all(row.model != "network" for row in identified.rows):
            why = next((note for note in identified.notes if note.startswith("network")), "it was not fitted")
            raise UserError(f"--network {network}: {why}", hint="write --network none to do without")
        if posterior and identified.model == "network":
            plant, record, lost = _sampled(
                plant, logs, out, seed, sub_progress(progress, 0.6, 1.0, "posterior")
            )
    plant.save(out)
    dynamics = identified.dynamics if record is None else settled_dynamics(plant)
    if report is not None:
        lead = f"From {', '.join(log.attrs['name'] for log in logs)}."
        sections = identification_sections(identified, logs, plant, record, dynamics)
        write_report(report, "Identification", lead, sections)
    _show_identified(console, identified, plant, dynamics)
    if dynamics is None:
        console.say("no gains at rest: the plant does not settle in the middle of its logs")
    if posterior:
        console.say(lost if record is None else record.sampling.verdict)
    console.say(f"wrote {out}")
    more = {"dynamics": None if dynamics is None else dynamics.to_dict(), "repairs": repairs}
    console.answer(_identified(identified, plant, record, out) | more)
    for doubt in identified.doubts[:MOST_DOUBTS]:
        console.warn(f"in doubt: {doubt}")
    if (unprinted := len(identified.doubts) - MOST_DOUBTS) > 0:
        console.warn(f"in doubt: {unprinted} more, which --json lists")
    if posterior and (record is None or not record.chain.converged):
        return cli.ANSWER_IS_NO
    if identified.good:
        return cli.Done("good")
    guessed = any(s.guessed for s in identified.signals) or any(log.attrs.get("clock_doubts") for log in logs)
    if identified.doubts and guessed:
        command = _stating(identified, paths, ctx.meta[cli.TYPED], logs)
    else:
        command = _experiment(plant, out, logs)
    return cli.Done("not good", cli.ANSWER_IS_NO, command)


def _experiment(plant: Plant, path: Path, logs: Sequence[Log]) -> str:
    """Return the command of a schedule that is long enough to identify a plant by."""
    from thermogrip.sysid.blackbox.fit import FEWEST_RESAMPLED
    from thermogrip.sysid.validation.free_run import slowest_time

    # each of the four blocks that identify holds out shows 95 % of a move, and a log of fewer rows has no
    # intervals
    slowest_s = max(slowest_time(plant, log) for log in logs)
    step_s = max(float(log["time"].diff("time").median()) for log in logs)
    minutes = significant(max(4 * 3 * slowest_s, FEWEST_RESAMPLED * step_s) / 60, 2)
    kind = "prbs" if plant.covariance is None else "optimal"
    words = ["excite", "--kind", kind, "--minutes", minutes, "--plant", str(path), "--out", "schedule.csv"]
    return printable(shlex.join(words))


def _stating(found: Identification, paths: Sequence[str], typed: Sequence[str], logs: Sequence[Log]) -> str:
    """Return what was typed with what was guessed, to be corrected where the guess is wrong; an input that
    nothing but its course shows may be one that nobody sets, such as a lamp."""
    named = {r: [s.name for s in found.signals if s.role == r] for r in ("input", "output", "disturbance")}
    unsaid = {role: names for role, names in named.items() if f"--{role}s" not in typed}
    words = ["identify", *paths, *_stated_roles(unsaid)]
    if "--dt" not in typed and (doubts := "".join(log.attrs.get("clock_doubts", "") for log in logs)):
        step = float(logs[0]["time"].diff("time").median())
        unknown = re.search("no column is a clock|the time of all columns|apart at first", doubts)
        words += ["--dt", "S" if unknown else f"{step:g}"]  # S: to be filled in
    command = shlex.join([*words, *(word for word in typed if word not in paths)])
    by_course = [s.name for s in found.signals if s.role == "input" and s.guessed and "name" not in s.why]
    driven = [name for name in named["input"] if name not in by_course]
    if driven and by_course:
        measured = {"input": driven, "disturbance": [*named["disturbance"], *by_course]}
        command += f"  # can you set {', '.join(by_course)}? if not: {shlex.join(_stated_roles(measured))}"
    elif all(re.fullmatch(r"c\d+", signal.name) for signal in found.signals):
        command += "  # better, name its columns in their order: --columns time_s,heater_percent,oven_degC,-"
    return printable(command)


def _stated_roles(named: Mapping[str, Sequence[str]]) -> list[str]:
    return [word for r, names in named.items() if names for word in (f"--{r}s", ",".join(names))]


def _read(
    read: Callable[..., list[Log]], network: GreyModel | None, *, shipped: bool
) -> tuple[list[Log], GreyModel | None]:
    """Return the logs, and the network under the names of their columns: the given one, or a shipped one."""
    if network is None and not shipped:
        return read(), None
    from thermogrip.sysid.data.shipped_networks import in_columns, shipped_network
    from thermogrip.sysid.plant.log_grid import roles_of

    if network is None:
        logs = read()
        matching: GreyModel | None = shipped_network(logs)
    else:
        from thermogrip.sysid.models.network import NetworkModel

        logs = read(known=roles_of(network))
        matching = in_columns(network, logs[0]) if isinstance(network, NetworkModel) else network
    # what a network calls its own has the role that it has there
    return (logs if matching is network or matching is None else read(known=roles_of(matching))), matching


class _Sampled(NamedTuple):
    """A plant with samples of its parameters, or why there are none."""

    plant: Plant
    record: Posterior | None
    lost: str  # in words why there is no record


def _sampled(plant: Plant, logs: Sequence[Log], out: Path, seed: int, progress: Progress | None) -> _Sampled:
    """Sample a plant's parameters; the samples stay beside it until the chain has converged."""
    from thermogrip.sysid.greybox.posterior import sample_posterior
    from thermogrip.sysid.identification import NO_DRAWS, no_draws

    try:
        plant, record = sample_posterior(plant, logs, seed=seed, progress=progress)
    except NO_DRAWS as error:
        return _Sampled(plant, None, no_draws("network", "posterior", error))
    return _Sampled(plant, record, "")


def _write_early(console: Console, out: Path, found: Identification) -> None:
    """Write and show the plant of the first kind of models, before the others are fitted."""
    from thermogrip.report.plant import held_out_table

    found.plant.save(out)
    line = f"wrote {out} so far, and goes on with other models: {found.verdict}"
    console.early(line, "So far (RMSE of simulations)", *held_out_table(found.rows))


def _repaired(console: Console, logs: Sequence[Log]) -> dict[str, list[str]]:
    """Return what was repaired while the logs were read, by the log's name, and warn of it."""
    repairs = {}
    for log in logs:
        repairs[log.attrs["name"]] = [line for line in str(log.attrs.get("repairs", "")).splitlines() if line]
        for line in repairs[log.attrs["name"]]:
            console.warn(f"{log.attrs['name']}: {line}")
    return repairs


def _show_identified(
    console: Console, found: Identification, plant: Plant, dynamics: Dynamics | None
) -> None:
    """Print models, parameters and their identifiability, gains, the data check and the verdict."""
    from thermogrip.report.plant import (
        gain_table,
        held_out_table,
        parameter_table,
        signal_table,
        time_constant_words,
    )

    console.table("Columns of the logs", *signal_table(found))
    console.table("Free runs (RMSE)", *held_out_table(found.rows))
    if plant.free:
        console.table("Free parameters of the plant", *parameter_table(plant))
    if dynamics is not None:
        console.table("Gains at rest", *gain_table(dynamics))
        console.say(time_constant_words(dynamics))
    for sentence in _identifiability(plant):
        console.say(sentence)
    for finding in found.data_check.findings:
        if finding.verdict != "ok":
            where = f"{finding.log}: " if finding.log else ""
            console.say(f"{finding.verdict}: {where}{finding.says}")
    for note in found.notes:
        console.say(f"note: {note}")
    console.say(found.verdict)


def _identifiability(plant: Plant) -> list[str]:
    if not plant.free:  # a black box
        return []
    from thermogrip.sysid.greybox.identifiability import identifiability_report

    return identifiability_report(plant)


def _identified(found: Identification, plant: Plant, record: Posterior | None, out: Path) -> dict[str, Any]:
    """Return the JSON answer of ``identify``."""
    sampled = None
    if record is not None:
        sampled = vars(record.sampling) | {"n_steps": len(record.chain.steps)}
    return {
        "model": found.model,
        "network": getattr(plant.model, "name", None),
        "good": found.good,
        "expected_error": found.expected,
        "doubts": found.doubts,
        "verdict": found.verdict,
        "signals": found.signals,
        "rows": found.rows,
        "data_check": found.data_check.findings,
        "evidence": found.evidence,
        "parameters": {
            name: {"value": plant.values[name], "unit": plant.units.get(name, "1")} for name in plant.free
        },
        "intervals_90": plant.intervals(0.9),
        "identifiability": _identifiability(plant),
        "posterior": sampled,
        "notes": found.notes,
        "out": out,
    }


def validate(
    plant: cli.PlantFile,
    paths: cli.LogFiles,
    warmup: Annotated[
        float | None,
        cli.opt(
            "--warmup",
            "S",
            "Measured outputs of these first seconds may set the state; where absent a tenth of the slowest "
            "time constant, 5 s at least (of a black box what scored its fit), at most a tenth of the log.",
            min=0,
        ),
    ] = None,
    score_from: Annotated[
        float | None,
        cli.opt("--score-from", "S", "Samples before this are not scored; where absent, the warm-up.", min=0),
    ] = None,
    average: Average = None,
    network: cli.OwnNetwork = None,
    columns: cli.Columns = None,
    dt: cli.Step = None,
    report: cli.Report = None,
    seed: cli.Seed = 0,
    as_json: cli.AsJson = False,
) -> int:
    """Score a plant by free run.

    It sees the inputs and disturbances of the whole log, and measured outputs of the warm-up only."""
    from thermogrip.sysid.plant.log_grid import moved_beside, roles_of
    from thermogrip.sysid.plant.plant import said_not_good

    loaded = cli.load_plant(plant, network)
    console = Console(as_json)
    logs = cli.load_logs(paths, known=roles_of(loaded), columns=cli.comma(columns), dt=dt)
    from thermogrip.report.html import write_report
    from thermogrip.report.plant import band_words, free_run_section, run_table
    from thermogrip.sysid.validation.free_run import free_run

    repairs = _repaired(console, logs)
    for log in logs:
        for name in moved_beside(loaded, log):
            console.warn(f"{log.attrs['name']}: {name} moves in this log, and the plant has no such input")
    runs = []
    with console.progress("validate") as progress:
        for k, log in enumerate(logs):
            progress(k / len(logs), log.attrs["name"])
            runs.append(free_run(loaded, log, warmup=warmup, score_from=score_from, average=average))
    bands = [run.band() for run in runs]
    if report is not None:
        sections = [free_run_section(*pair) for pair in zip(runs, bands)]
        firsts = [run.warmup if score_from is None else score_from for run in runs]
        since = ", ".join(dict.fromkeys(f"{first:g} s" for first in firsts))
        lead = f"Inputs in, outputs out, nothing fed back; scored from {since} on."
        write_report(report, f"Free runs of {plant.name}", lead, sections)
    console.table(f"Free run of {plant.name}", *run_table(runs))
    for log, run, band in zip(logs, runs, bands):
        console.say(f"{log.attrs['name']}: {band_words(band)}")
        for note in run.notes:
            console.say(f"{log.attrs['name']}: {note}")
    answers = [run_answer(log.attrs["name"], run, band) for log, run, band in zip(logs, runs, bands)]
    console.answer({"logs": answers, "repairs": repairs})
    verdicts = [run.verdict for run in runs if run.verdict is not None]
    urgencies = [each.cause if each.cause in ("start", "seen") else each.standing for each in verdicts]
    if said_not_good(loaded.verdict) and set(urgencies) & {"as stated", "better", "seen"}:
        console.say(
            f"{plant.name}: identify did not call it good, and a run as was stated does not change that"
        )
        urgencies = ["worse" if pair in ("as stated", "better") else "no test" for pair in urgencies]
    most_urgent = next((pair for pair in _URGENT if pair in urgencies), "")
    code, command = cli.ANSWER_IS_NO if most_urgent in ("worse", "another plant", "start") else 0, ""
    if most_urgent == "no test":
        command = _experiment(loaded, plant, logs)
    elif most_urgent == "start":
        from thermogrip.sysid.validation.free_run import start_seconds

        seconds = min(start_seconds(loaded, log) for log in logs)
        more = ["--warmup", f"{seconds:g}", "--score-from", f"{seconds:g}"]
        command = printable(shlex.join(["validate", str(plant), *map(str, paths), *more]))
    return cli.Done(most_urgent, code, command)


#: Of verdicts on several logs, which one says what comes next.
_URGENT = ("another plant", "worse", "start", "as stated", "better", "no test", "seen")


def run_answer(name: str, run: FreeRun, band: Band) -> dict[str, Any]:
    """Return one log's free run as the JSON answer has it."""
    return {
        "log": name,
        "outputs": run.scores,
        "one_step": run.one_step,
        "naive": run.naive,
        "left": run.residual.to_json(),
        "band": {
            "level": band.level,
            "coverage": band.inside,
            "expected_rmse": band.expected,
            "likely_rmse": band.likely,
            "own_error": band.own_error,
            "draws": band.draws,
        },
        "verdict": run.verdict,
        "notes": run.notes,
    }


def simulate(
    plant: cli.PlantFile,
    path: Annotated[str, cli.arg("LOG", "Inputs and warm-up come from here.")],
    out: Annotated[Path, cli.opt("--out", "SIM.csv", "Where the log goes.")],
    warmup: Warmup = 5.0,
    network: cli.OwnNetwork = None,
    columns: cli.Columns = None,
    dt: cli.Step = None,
    seed: cli.Seed = 0,
    as_json: cli.AsJson = False,
) -> int:
    """Simulate a plant over the inputs of a log."""
    from thermogrip.datasets.log_files import check_written, write_log

    check_written(cli.new_file(out))
    from thermogrip.sysid.plant.log_grid import match_logs, roles_of

    console = Console(as_json)
    loaded = cli.load_plant(plant, network)
    (log,) = cli.load_logs([path], known=roles_of(loaded), columns=cli.comma(columns), dt=dt)
    repairs = _repaired(console, [log])[log.attrs["name"]]
    (log,), converted = match_logs(loaded, [log])
    for line in converted:
        console.warn(f"{log.attrs['name']}: {line}")
    simulated = loaded.simulate(log, warmup=warmup)
    write_log(simulated, out)
    console.say(f"wrote {out}: {', '.join(loaded.outputs)} at {simulated.sizes['time']} times")
    rows = simulated.sizes["time"]
    console.answer({"log": log.attrs["name"], "rows": rows, "out": out, "repairs": repairs})
    return 0


def linearise(
    plant: cli.PlantFile,
    at: Annotated[
        str | None,
        cli.opt(
            "--at",
            "NAME=X,...",
            "Inputs and disturbances of the operating point; the others are in the middle of the logs.",
        ),
    ] = None,
    dt: Annotated[
        float | None, cli.opt("--dt", "S", "Step of the matrices; none: continuous.", min=1e-9)
    ] = None,
    out: Annotated[Path | None, cli.opt("--out", "FILE", "Matrices as .json or .mat.")] = None,
    report: cli.Report = None,
    network: cli.OwnNetwork = None,
    seed: cli.Seed = 0,
    as_json: cli.AsJson = False,
) -> int:
    """Show a plant about an operating point: gains, time constants, dead times, matrices.

    Gains have 90 % intervals where the plant has draws."""
    if out is not None:
        cli.new_file(out, (".json", ".mat"))
    named = cli.numbers("--at", at)
    cli.choices("--at", named, plant, "inputs", "disturbances")
    loaded, console = cli.load_plant(plant, network), Console(as_json)
    from thermogrip.report.html import write_report
    from thermogrip.report.plant import dynamics_section, gain_table, time_constant_words
    from thermogrip.sysid.export.dynamics import plant_dynamics, usual_point
    from thermogrip.sysid.plant.linearise import linearise_plant, save_linear

    u, d = usual_point(
        loaded,
        {name: value for name, value in named.items() if name not in loaded.disturbances},
        {name: value for name, value in named.items() if name in loaded.disturbances},
    )
    dynamics = plant_dynamics(loaded, inputs=u, disturbances=d)
    console.table(f"Gains at rest of {plant.name}", *gain_table(dynamics))
    console.say(time_constant_words(dynamics))
    if report is not None:
        write_report(
            report,
            f"Linear model of {plant.name}",
            "Small changes about an operating point.",
            [dynamics_section(dynamics)],
        )
    answer = dynamics.to_dict()
    if out is not None:
        save_linear(linearise_plant(loaded, inputs=u, disturbances=d, dt=dt), out)
        console.say(f"wrote {out}")
        answer["out"] = out
    console.answer(answer)
    return 0
