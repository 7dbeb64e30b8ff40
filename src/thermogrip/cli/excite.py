"""excite: an input schedule to identify a plant by, and what it is expected to tell."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thermogrip.cli.options import (
    AsJson,
    Seed,
    comma,
    existing_network,
    existing_plant,
    find_network,
    load_plant,
    new_file,
    one_of,
)
from thermogrip.datasets.errors import UserError
from thermogrip.report.console import Console

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Log
    from thermogrip.sysid.plant.plant import Plant

__all__ = ["excite"]

KINDS = ("prbs", "multisine", "staircase", "optimal")


def excite(
    kind: Annotated[
        str,
        typer.Option(
            "--kind",
            metavar="|".join(KINDS),
            show_default=False,
            callback=one_of("--kind", KINDS),
            help="Shape of the excitation.",
        ),
    ],
    minutes: Annotated[
        float,
        typer.Option("--minutes", metavar="M", min=0.1, show_default=False, help="Length of the experiment."),
    ],
    out: Annotated[
        Path, typer.Option("--out", metavar="SCHEDULE.csv", show_default=False, help="Where it goes.")
    ],
    plant: Annotated[
        Path | None,
        typer.Option(
            "--plant",
            metavar="PLANT",
            callback=existing_plant,
            help="Fit time constants and amplitude to this plant.",
        ),
    ] = None,
    network: Annotated[
        str | None,
        typer.Option(
            "--network",
            metavar="NAME|FILE",
            callback=existing_network,
            help="Before any log: a network at its priors; with a plant of your own, its FILE.py:CLASS.",
        ),
    ] = None,
    lowest: Annotated[
        float, typer.Option("--lowest", metavar="DEGC", help="With a plant: no output below this.")
    ] = 5.0,
    highest: Annotated[
        float, typer.Option("--highest", metavar="DEGC", help="With a plant: no output above this.")
    ] = 60.0,
    hold: Annotated[
        str | None, typer.Option("--hold", metavar="A,B", help="With optimal: inputs that do not move.")
    ] = None,
    slew: Annotated[
        float | None,
        typer.Option("--slew", metavar="PER_S", min=1e-9, help="With optimal: a drive changes no faster."),
    ] = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> int:
    """Write an input schedule to identify a plant by.

    ``optimal`` shrinks the intervals of the plant's parameters most and says by how much, beforehand."""
    from thermogrip.cli.schedules import schedule_for
    from thermogrip.datasets.log_files import write_log
    from thermogrip.sysid.experiment.schedules import excite as plain_schedule

    new_file(out)
    console = Console(as_json)
    subject = _subject(plant, network)
    answer: dict[str, Any] = {"kind": kind}
    if kind == "optimal":
        if subject is None:
            raise UserError(
                "--kind optimal needs to know what it is optimal for", hint="give --plant or --network"
            )
        limits = {"lowest": lowest, "highest": highest, "slew": float("inf") if slew is None else slew}
        log, answer["expected"] = _optimal(console, subject, minutes, limits, comma(hold) or (), seed)
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
        return load_plant(plant, network)
    if network is None:
        return None
    from thermogrip.sysid.experiment.information import plant_from_prior

    return plant_from_prior(find_network(network))


def _optimal(
    console: Console,
    plant: Plant,
    minutes: float,
    limits: dict[str, float],
    hold: tuple[str, ...],
    seed: int,
) -> tuple[Log, dict[str, Any]]:
    """Return the most informative schedule and what is expected of it, and show that."""
    from thermogrip.cli.schedules import expected_rows, optimal_for

    with console.progress("excite") as progress:
        log, expected, notes = optimal_for(plant, minutes, **limits, hold=hold, seed=seed, progress=progress)
    console.table("Width of the 90 % intervals: now, and expected after", *expected_rows(plant, expected))
    for kind, bits in expected.bits.items():
        if kind != "now":
            against = ""
            if kind != "optimal":
                against = (
                    f"; after optimal {expected.narrower('optimal', kind):.3g} times narrower in the mean, "
                    f"determinant {expected.determinant_ratio('optimal', kind):.3g} times smaller"
                )
            console.say(f"{kind}: {bits:.1f} bits{against}")
    for note in notes:
        console.say(f"note: {note}")
    ratios = {
        kind: expected.determinant_ratio("optimal", kind) for kind in expected.bits if kind != "optimal"
    }
    answer = {"bits": expected.bits, "widths_90": expected.widths, "ranges_90": expected.ranges}
    return log, answer | {"determinant_ratio": ratios, "notes": notes}
