"""Write docs/reference/cli.md and docs/reference/python/ from the program: `python .ci/reference.py`."""

from __future__ import annotations

import contextlib
import importlib
import inspect
import io
import os
import re
import textwrap
from collections import Counter
from pathlib import Path
from typing import Any

REFERENCE = Path(__file__).parents[1] / "docs" / "reference"
ROOMS = {
    "datasets": "Files of logs and grasps, example data",
    "sysid": "Identification, plants, effusivity, materials",
    "mpc": "Controllers, closed loops, tuning",
    "rig": "Devices, sessions, guard, records",
    "classify": "Classifiers, their comparison, decisions",
}
CLI_HEAD = """# Command line

Every verb has `--seed N`, `--json` (one JSON object on stdout and nothing else) and `--help` besides.
Exit codes: 0 done; 1 a bug; 2 your input is at fault; 3 done, but the answer is no; 130 Ctrl-C.
Written by `python .ci/reference.py`. Each verb's `--help` has two examples and what comes next.

## Options and arguments of several verbs

```text
{shared}
```
"""
ROOM_HEAD = """# thermogrip.{room}

{subject}: what `from thermogrip.{room} import ...` offers. `help(name)` has types, units and examples.
Written by `python .ci/reference.py`.
"""
_WIDTH = 100
_SEVERAL = 2  # verbs that share an option or an argument, from which on it is described once
#: An option or an argument of a help, with what stands behind it.
_OPTION = r"\n  ((?:--|[A-Z])[^\n]*?\S)(?: {2,}|\n {15,})([^\n]*(?:\n {10,}[^\n]*)*)"


def pages() -> dict[Path, str]:
    """Return the text of every page of the reference that is written from the program."""
    python = {REFERENCE / "python" / f"{room}.md": page_of_room(room) for room in ROOMS}
    return {REFERENCE / "cli.md": page_of_verbs(), **python}


def page_of_verbs() -> str:
    """Return what ``thermogrip VERB --help`` prints, a section a verb; options of several verbs once."""
    from thermogrip.cli.main import VERBS

    helps = {verb: help_of(verb) for verb in VERBS}
    options = {verb: dict(re.findall(_OPTION, text)) for verb, text in helps.items()}
    often = Counter((name, " ".join(about.split())) for by in options.values() for name, about in by.items())
    shared = {name: about for (name, about), n in often.items() if n >= _SEVERAL and name != "--out DIR"}
    sections = []
    for verb, text in helps.items():
        besides = [
            name for name, about in options[verb].items() if shared.get(name) == " ".join(about.split())
        ]
        for name in besides:
            text = re.sub(rf"\n  {re.escape(name)}(?: {{2,}}.*| *)(?:\n {{10,}}.*)*", "", text)
        text = re.sub(r"\n\n(?:Options|Arguments):(?=\n\n|$)", "", text)
        more = f"\nBesides: {', '.join(f'`{name.split()[0]}`' for name in besides)}.\n" if besides else ""
        sections.append(f"## {verb}\n\n```text\n{text}\n```\n{more}")
    rows = "\n".join(f"{name}  {about}" for name, about in sorted(shared.items()))
    return "\n".join([CLI_HEAD.format(shared=rows), *sections])


def help_of(verb: str) -> str:
    """Return what ``thermogrip VERB --help`` prints, without examples and the options that every verb has."""
    from thermogrip.cli.main import main

    os.environ["COLUMNS"] = str(_WIDTH)
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        main([verb, "--help"])
    text = out.getvalue().partition("\nExamples:")[0].rstrip()
    text = re.sub(r"\n  (?:--seed N|--json|-h, --help) .*(?:\n {20,}.*)*", "", text)
    return "\n".join(line.rstrip() for line in text.splitlines())


def page_of_room(room: str) -> str:
    """Return the call and the first sentence of every name that a room exports."""
    module = importlib.import_module(f"thermogrip.{room}")
    sections = [section(name, getattr(module, name)) for name in module.__all__]
    return "\n".join([ROOM_HEAD.format(room=room, subject=ROOMS[room]), *sections])


def section(name: str, value: Any) -> str:
    """Return what the reference says of a public name."""
    if inspect.ismodule(value):
        return f"## {name}\n\nA module. {first_sentence(value)}\n"
    if not callable(value):
        return f"## {name}\n\nA {type(value).__name__}.\n"
    text = f"## {name}\n\n```text\n{signature(name, value)}\n```\n\n{first_sentence(value)}\n"
    if methods := methods_of(value):
        text += "\n" + "".join(
            f"- `{method}`: {first_sentence(found)}\n" for method, found in methods.items()
        )
    return text


def methods_of(value: Any) -> dict[str, Any]:
    """Return the public methods and properties that a class of ours defines, with their docstrings."""
    kinds = inspect.getmro(value) if inspect.isclass(value) else ()
    found: dict[str, Any] = {}
    for kind in reversed([kind for kind in kinds if kind.__module__.startswith("thermogrip.")]):
        found |= {name: member for name, member in vars(kind).items() if not name.startswith("_")}
    routines = {name: getattr(member, "__func__", member) for name, member in found.items()}
    shown = (inspect.isfunction, inspect.isdatadescriptor)
    return {name: member for name, member in routines.items() if any(is_kind(member) for is_kind in shown)}


def first_sentence(value: Any) -> str:
    """Return the first sentence of a docstring, on one line."""
    paragraph = " ".join((inspect.getdoc(value) or "").partition("\n\n")[0].split())
    sentence = re.split(r"(?<=[.:])\s(?=[A-Z])", paragraph)[0]
    plain = re.sub(r":\w+:`~?(?:[\w.]+\.)?(\w+)`", r"`\1`", sentence)
    return plain.replace("``", "`")


def signature(name: str, value: Any) -> str:
    """Return how a function or class is called: names and defaults; ``help(name)`` has the types."""
    parameters = inspect.signature(value).parameters.values()
    bare = [parameter.replace(annotation=inspect.Parameter.empty) for parameter in parameters]
    line = re.sub(r"=<[^<>]*>", "=...", f"{name}{inspect.Signature(bare)}")
    return "\n".join(textwrap.wrap(line, _WIDTH, subsequent_indent="    ", break_long_words=False))


def main() -> None:
    """Write the pages."""
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
