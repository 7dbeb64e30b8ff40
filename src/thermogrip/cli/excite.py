"""excite: an input schedule to identify a plant by, and how well it is expected to identify it."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from thermogrip.cli import options as cli
from thermogrip.datasets.errors import UserError
from thermogrip.report.console import Console

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from thermogrip.datasets.parallel import Progress
    from thermogrip.datasets.schema import Log
    from thermogrip.sysid.experiment.information import ExperimentForecast
    from thermogrip.sysid.experiment.optimal import Expectation
    from thermogrip.sysid.plant.plant import Plant

KINDS = ("prbs", "multisine", "staircase", "optimal")
HALVINGS = 12  # of the bisection


def excite(
    kind: Annotated[
        str, cli.opt("--kind", "|".join(KINDS), "Shape of the excitation.", cli.one_of("--kind", KINDS))
    ],
    minutes: Annotated[float, cli.opt("--minutes", "M", "Length of the experiment.", min=0.1)],
    out: Annotated[Path, cli.opt("--out", "SCHEDULE.csv", "Where it goes.")],
    plant: Annotated[
        Path | None, cli.opt("--plant", "PLANT", "Fit time constants and amplitude to this plant.")
    ] = None,
    network: Annotated[
        str | None,
        cli.opt(
            "--network",
            "NAME|FILE",
            "Before any log: a network at its priors; with a plant of your own, its FILE.py:CLASS.",
        ),
    ] = None,
    lowest: Annotated[float, cli.opt("--lowest", "DEGC", "With a plant: no output below this.")] = 5.0,
    highest: Annotated[float, cli.opt("--highest", "DEGC", "With a plant: no output above this.")] = 60.0,
    hold: Annotated[str | None, cli.opt("--hold", "A,B", "With optimal: inputs that do not move.")] = None,
    slew: Annotated[
        float | None, cli.opt("--slew", "PER_S", "With optimal: a drive changes no faster.", min=1e-9)
    ] = None,
    seed: cli.Seed = 0,
    as_json: cli.AsJson = False,
) -> int:
    """Write an input schedule to identify a plant by.

    ``optimal`` shrinks the intervals of the plant's parameters most and says by how much, beforehand."""
    if plant is not None:
        cli.choices("--hold", cli.comma(hold) or (), plant, "inputs")
    from thermogrip.datasets.log_files import check_written, write_log

    check_written(cli.new_file(out))
    from thermogrip.sysid.experiment.schedules import excite as plain_schedule

    console = Console(as_json)
    subject = _subject(plant, network)
    answer: dict[str, Any] = {"kind": kind}
    if kind == "optimal":
        if subject is None:
            raise UserError(
                "--kind optimal needs to know what it is optimal for", hint="give --plant or --network"
            )
        limits = {"lowest": lowest, "highest": highest, "slew": float("inf") if slew is None else slew}
        log, answer["expected"] = _optimal(console, subject, minutes, limits, cli.comma(hold) or (), seed)
    elif subject is None:
        log, answer["share"] = plain_schedule(kind, minutes, seed=seed), 1.0
    else:
        log, share = schedule_for(subject, kind, minutes, lowest=lowest, highest=highest, seed=seed)
        answer["share"] = share
        console.say(
            f"{100 * share:.0f} % of the drive's range keeps the outputs from {lowest:g} to {highest:g} degC"
        )
    write_log(log, out)
    console.say(f"wrote {out}: {log.sizes['time']} rows")
    console.answer(answer | {"rows": log.sizes["time"], "out": out})
    return 0


def _subject(plant: Path | None, network: str | None) -> Plant | None:
    """Return the plant to excite: a fitted one, a network at its priors, or none."""
    if plant is not None and network is not None and ".py:" not in network:
        raise UserError("--plant and --network exclude each other", hint="give one of them")
    if plant is not None:
        return cli.load_plant(plant, network)
    if network is None:
        return None
    from thermogrip.sysid.experiment.information import plant_from_prior

    return plant_from_prior(cli.find_network(network))


def _optimal(
    console: Console, plant: Plant, minutes: float, limits: dict[str, float], hold: tuple[str, ...], seed: int
) -> tuple[Log, dict[str, Any]]:
    """Return the most informative schedule and what is expected of it, and show that."""
    with console.progress("excite") as progress:
        optimal = optimal_for(plant, minutes, **limits, hold=hold, seed=seed, progress=progress)
    expected = optimal.expected
    head = ["parameter", "unit", "value", *expected.widths]
    rows = []
    for name in plant.free:
        widths = [of_schedule[name] for of_schedule in expected.widths.values()]
        rows.append([name, plant.units.get(name, "1"), plant.values[name], *widths])
    console.table("Width of the 90 % intervals: now, and expected after", head, rows)
    for kind, bits in expected.bits.items():
        if kind != "now":
            narrower = f"; after optimal {expected.narrower('optimal', kind):.3g} times narrower in the mean"
            console.say(f"{kind}: {bits:.1f} bits{'' if kind == 'optimal' else narrower}")
    for note in optimal.notes:
        console.say(f"note: {note}")
    answer = {"bits": expected.bits, "widths_90": expected.widths}
    return optimal.log, answer | {"notes": optimal.notes}


def schedule_for(
    plant: Plant, kind: str, minutes: float, *, lowest: float, highest: float, seed: int
) -> tuple[Log, float]:
    """Return a schedule for every drive of a plant, and the share of the drives' ranges that it uses;
    UserError if not even a fiftieth of them keeps every output in degC from ``lowest`` to ``highest``."""
    import numpy as np

    from thermogrip.datasets.schema import column, make_log
    from thermogrip.sysid.experiment.information import ExperimentForecast
    from thermogrip.sysid.experiment.schedules import excite as plain_schedule

    full: dict[str, NDArray[np.float64]] = {}
    for k, (name, (low, high)) in enumerate(_ranges(plant).items()):
        fast, slow = _time_constants(plant, name)
        log = plain_schedule(kind, minutes, dt=plant.dt, tau_fast=fast, tau_slow=slow, seed=seed + k)
        # a drive that cannot go below zero swings about half of its share, one of both signs about zero
        middle, reach = (0.5 * (low + high), 0.5 * (high - low)) if low >= 0 else (0.0, min(-low, high))
        full[name] = middle + reach * column(log, "drive")
    time = np.asarray(log["time"].values, dtype=float)
    # simulated from a room of 25 degC, with eight draws of the parameters too; found by bisection
    share = _largest_interval(ExperimentForecast(plant, lowest=lowest, highest=highest), full, time.size)
    variables = {name: (share * drive, plant.units.get(name, "1"), "input") for name, drive in full.items()}
    variables |= {name: (np.ones(time.size), "1", "input") for name in plant.model.switches}
    return make_log(time, variables, name=f"{kind} schedule"), share


class OptimalSchedule(NamedTuple):
    """The most informative schedule and what is to be said of it."""

    log: Log
    expected: Expectation  # the intervals after it and after the plain ones
    notes: list[str]


def optimal_for(
    plant: Plant,
    minutes: float,
    *,
    lowest: float,
    highest: float,
    slew: float,
    hold: Collection[str] = (),
    seed: int = 0,
    progress: Progress | None = None,
) -> OptimalSchedule:
    """Return the most informative schedule; ``slew`` is a drive's greatest change in a second, in its unit
    (the plain ones are compared without it), ``hold`` names inputs that do not move.  The plant needs a
    covariance, else UserError."""
    from thermogrip.sysid.experiment.optimal import expect, optimal_schedule
    from thermogrip.sysid.experiment.schedules import KINDS as PLAIN

    if plant.covariance is None:
        raise UserError(
            "the plant has no covariance, so no schedule can be called the best for it",
            hint="identify a network, or start from its priors with --network",
        )
    plain: dict[str, Log] = {}
    notes = []
    for kind in PLAIN:
        try:
            plain[kind], _ = schedule_for(plant, kind, minutes, lowest=lowest, highest=highest, seed=seed)
        except UserError as error:
            notes.append(f"no {kind} to compare with: {error.problem}")
    ranges = _ranges(plant)
    best = optimal_schedule(
        plant,
        minutes,
        ranges=ranges,
        shortest=min(_time_constants(plant, drive)[0] for drive in ranges),
        lowest=lowest,
        highest=highest,
        slew=slew / min(high - low for low, high in ranges.values()),
        hold=hold,
        seed=seed,
        progress=progress,
    )
    return OptimalSchedule(best, expect(plant, plain | {"optimal": best}), notes)


def _ranges(plant: Plant) -> dict[str, tuple[float, float]]:
    from thermogrip.mpc.plant.prediction import drive_names, drive_range

    return {name: drive_range(plant, name) for name in drive_names(plant)}


def _time_constants(plant: Plant, drive: str) -> tuple[float, float]:
    """Return the fast and the slow time constant [s] to excite by a drive, of the output it moves most."""
    from thermogrip.mpc.plant.prediction import step_response

    responses = [step_response(plant, drive, output) for output in plant.outputs]
    largest = max(responses, key=lambda response: abs(response.gain))
    fast = max(largest.delay, largest.lag / 20, 2 * plant.dt)
    return fast, max(largest.lag, 2 * fast)


def _largest_interval(
    forecast: ExperimentForecast, full: dict[str, NDArray[np.float64]], n_rows: int
) -> float:
    """Return the largest share of the drives (n_rows,) at full range whose simulated outputs stay inside."""
    import numpy as np

    inputs = forecast.plant.inputs
    moved = np.array([name in full for name in inputs])
    u = np.column_stack([full.get(name, np.ones(n_rows)) for name in inputs])
    if forecast.stays(u):
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if forecast.stays(np.where(moved, middle * u, u)) else (low, middle)
    if low < 0.02:
        raise UserError(
            f"no schedule keeps the plant from {forecast.lowest:g} to {forecast.highest:g} degC",
            hint="widen --lowest and --highest",
        )
    return low
