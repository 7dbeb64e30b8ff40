"""tune, review, run: from a plant to a controller, and through a session on the simulated rig."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from thermogrip.console import Console
from thermogrip.datasets.errors import UserError
from thermogrip.verbs.common import ANSWER_IS_NO, AsJson, Report, Seed, Workers, new_file, new_folder

__all__ = ["review", "run", "tune"]

ControllerFile = Annotated[
    Path, typer.Argument(metavar="CONTROLLER", show_default=False, help="controller.json of tune.")
]


def tune(
    plant: Annotated[
        Path, typer.Argument(metavar="PLANT", show_default=False, help="plant.json of identify.")
    ],
    out: Annotated[
        Path,
        typer.Option("--out", metavar="FILE.json", show_default=False, help="Where the controller goes."),
    ],
    spec: Annotated[
        Path | None,
        typer.Option(
            "--spec", metavar="SPEC.toml", help="What is wanted; `thermogrip init spec` writes one to edit."
        ),
    ] = None,
    report: Report = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> int:
    """Find the MPC's weights for what you want.

    You say settling time, overshoot, energy. Runs closed loops on posterior draws of the plant; shows baseline, tuned and PI side by side.
    """
    raise NotImplementedError


def review(controller: ControllerFile, seed: Seed = 0, as_json: AsJson = False) -> int:
    """Check a controller's design.

    Each check passes, warns or fails, and says the fix."""
    raise NotImplementedError


def run(
    controller: ControllerFile,
    target: Annotated[
        float,
        typer.Option(
            "--target", metavar="DEGC", show_default=False, help="Skin temperature at contact, 10 to 50."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", show_default=False, help="Folder of the run.")],
    twin: Annotated[
        Path | None,
        typer.Option("--twin", metavar="PLANT", help="Simulate this plant; no hardware is opened."),
    ] = None,
    draw: Annotated[
        int, typer.Option("--draw", min=0, help="Posterior draw of the twin's plant (0: the fit).")
    ] = 0,
    start: Annotated[
        float | None,
        typer.Option("--from", metavar="DEGC", help="Temperature at the start [default: the room's]."),
    ] = None,
    hold: Annotated[
        float, typer.Option("--hold", metavar="S", min=0, help="Regulate this long after settling.")
    ] = 0.0,
    obj: Annotated[
        float | None, typer.Option("--object", metavar="DEGC", help="Temperature of the object.")
    ] = None,
    material: Annotated[
        str | None, typer.Option("--material", metavar="NAME", help="Material of the object.")
    ] = None,
    grasp_time: Annotated[
        float, typer.Option("--grasp-time", metavar="S", min=0.5, help="Recorded time of contact.")
    ] = 10.0,
    settle_timeout: Annotated[
        float, typer.Option("--settle-timeout", metavar="S", min=1, help="Give up settling after this long.")
    ] = 900.0,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> int:
    """Bring the skin to a temperature, stop the pump, grasp, record.

    Drive and pump are switched off on every way out, Ctrl-C included. With --object and --material it grasps
    after settling; without them it only regulates.
    """
    raise NotImplementedError
