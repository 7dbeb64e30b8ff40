"""recover: a run that was cut off, brought into the state of a clean end, and written in other formats."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from thermogrip.console import Console
from thermogrip.datasets.errors import UserError
from thermogrip.verbs.common import ANSWER_IS_NO, AsJson, new_file

__all__ = ["recover"]


def recover(
    folder: Annotated[
        Path,
        typer.Argument(metavar="DIR", show_default=False, help="Folder of a run, or of a batch of runs."),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE",
            help="Also write the run's log: .nc, .parquet, .csv, or .mcap (with ros).",
        ),
    ] = None,
    bad: Annotated[
        str | None, typer.Option("--bad", metavar="WHY", help="Mark the trial as bad; nothing is removed.")
    ] = None,
    as_json: AsJson = False,
) -> int:
    """Repair a run that was killed or lost its power.

    Cuts a torn last line, says what was lost, writes the sums. No measured number is changed, and what was
    cut is kept beside it. A folder that is whole is left as it is.
    """
    from thermogrip.rig.run_export import export_run
    from thermogrip.rig.run_files import mark_bad, recover, run_folders

    console = Console(as_json)
    folders = run_folders(folder)
    if len(folders) > 1 and (out is not None or bad is not None):
        raise UserError("holds several runs", file=folder, mend="give the folder of one of them")
    results = []
    for each in folders:
        done = recover(each)
        for line in done.said:
            console.say(f"{each.name}: {line}")
        rows = 0 if done.run.log is None else done.run.log.sizes["time"]
        verdict = done.run.about["verdict"]
        results.append(
            {"run": each, "changed": done.changed, "said": done.said, "rows": rows, "verdict": verdict}
        )
    if bad is not None:
        mark_bad(folders[0], bad)
        console.say(f"{folders[0].name}: marked bad: {bad}")
    if out is not None:
        new_file(out, (".nc", ".parquet", ".csv", ".mcap"))
        export_run(folders[0], out)
        console.say(f"wrote {out}")
    console.answer({"runs": results})
    return 0 if all(result["rows"] for result in results) else ANSWER_IS_NO
