"""demo, paper, init: everything at once, and templates to start from."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Annotated

import typer

from thermogrip.console import Console
from thermogrip.datasets.errors import UserError
from thermogrip.verbs.common import AsJson, Seed, choice, new_file, new_folder

__all__ = ["demo", "init", "paper"]


def demo(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where everything goes.")] = Path(
        "thermogrip-demo"
    ),
    seed: Seed = 0,
    as_json: AsJson = False,
) -> int:
    """Do all of the below once on the example data.

    Identify, validate, tune, run on the simulated rig, grasp, compare; under 5 minutes on 2 cores, with a
    report.
    """
    raise NotImplementedError


def paper(
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", show_default=False, help="Where everything goes.")
    ],
    quick: Annotated[bool, typer.Option("--quick", help="LSTM of 200 epochs instead of 2000.")] = False,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> int:
    """Repeat the paper's experiments, table beside table."""
    raise NotImplementedError


def init(
    what: Annotated[str, typer.Argument(metavar="spec|network", show_default=False, help="Which template.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE.toml", help="Where it goes [default: stdout].")
    ] = None,
    as_json: AsJson = False,
) -> int:
    """Write a commented template to start from.

    spec: what tune aims at; network: a thermal network for identify --network."""
    choice("template", what, ("spec", "network"))
    text = _template(what)
    console = Console(as_json)
    if out is None:
        console.say(text.rstrip("\n"))
    else:
        from thermogrip.datasets.files import write_atomic

        new_file(out, (".toml",))
        if out.exists():
            raise UserError("exists already", file=out, mend="remove it or choose another name")
        write_atomic(out, text)
        console.say(f"wrote {out}")
    console.answer({"template": what, "text": text, "out": out})
    return 0


def _template(what: str) -> str:
    """Return the text of a template."""
    if what == "spec":
        from thermogrip.mpc import SPEC_TEMPLATE

        return SPEC_TEMPLATE
    return resources.files("thermogrip").joinpath("templates", "network.toml").read_text(encoding="utf-8")
