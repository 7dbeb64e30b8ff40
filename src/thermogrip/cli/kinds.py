"""What a file is, by its name and its beginning: one of the wrong kind is refused with the verbs it is for.

What a verb takes in a place of its command line is known by what that place is called in its help.  Nothing
heavy is loaded, and a file that nothing is known of is left to its reader.
"""

from __future__ import annotations

import gzip
import lzma
import os
import re
import tomllib
from importlib import import_module, resources
from pathlib import Path
from typing import Any

from thermogrip.cli.grasp_arguments import matching_files
from thermogrip.datasets.errors import UserError, known_names

KINDS: dict[str, dict[str, Any]] = tomllib.loads(
    (resources.files("thermogrip.cli") / "kinds.toml").read_text(encoding="utf-8")
)
#: What ``init`` writes.
TEMPLATES = [kind for kind, about in KINDS.items() if "template" in about]
TAKES = {place: kind for kind, about in KINDS.items() for place in about.get("places", ())}
_KIND_BY_CONTENT = {
    "classifier.json": "classifier",
    "batch.json": "batch",
    "run.json": "run",
    "samples.csv": "run",
}
_FILES_OF_RUN = {"log": "samples.csv", "grasps": "grasps.csv"}  # of a run
BOTH = ({"run", "batch"}, {"batch", "grasps"})  # one may be given for the other
TYPED = "thermogrip.typed"  # key of the words of a verb in what its check is handed
_HEAD = 1 << 16  # bytes that show what a file is


def kind_of(path: str | Path) -> str:
    """Return what a file or folder is, "" where it is no known kind."""
    if os.path.isdir(path):
        return next((kind for name, kind in _KIND_BY_CONTENT.items() if os.path.isfile(Path(path, name))), "")
    name = str(path).lower()
    openers: dict[str, Any] = {".gz": gzip.open, ".xz": lzma.open}
    try:
        if not os.path.isfile(path):  # a pipe is read once
            return ""
        with openers.get(name[-3:], open)(path, "rb") as stream:
            head = stream.read(_HEAD)
    except (OSError, EOFError, lzma.LZMAError):
        return ""
    if name.endswith((".csv", ".csv.gz", ".csv.xz")):
        return _kind_of_table(head)
    mark = rb"" if name.endswith(".nc") else rb"schema\W+"
    if schema := re.search(
        mark + rb"thermogrip\.(plant|controller|classifier|grasps|log|network|topics)\b", head
    ):
        return schema[1].decode()
    return _kind_of_toml(head) if name.endswith(".toml") else ""


def _kind_of_table(head: bytes) -> str:
    """Return what the header of a table says that it is."""
    lines = (line for line in head.decode("utf-8", "replace").splitlines() if line[:1] not in "#")
    names = [name.strip(' "').lower() for name in re.split(r"[,;\t]", next(lines, ""))]
    timed = any(re.match(r"time|stamp|seconds|t$|t_m?s$", name) for name in names)
    if "grasp_id" in names:
        return "grasps" if timed else "meta"
    if {"material", "target_degc"} <= {*names}:
        return "plan"
    return "log" if timed and len(names) > 1 else ""


def _kind_of_toml(head: bytes) -> str:
    """Return which template a TOML file has most keys of, "" where two have as many."""
    keys = _toml_keys(head.decode("utf-8", "replace"))
    shared = {kind: len(keys & _toml_keys(template_text(kind))) for kind in ("spec", "guard")}
    most = max(shared.values())
    alike = [kind for kind, n_keys in shared.items() if n_keys == most]
    return alike[0] if len(alike) == 1 and most > len(keys) / 2 else ""


def _toml_keys(text: str) -> set[str]:
    """Return the keys and tables of a TOML file, those that are commented out among them."""
    shown = re.findall(r"(?m)^(?:# )?(?:\[+(\w+)[\].]|(\w+) *= *)", text)
    return {table or key for table, key in shown}


def template_text(kind: str) -> str:
    """Return the template of a kind of file."""
    package, name = KINDS[kind]["template"]
    return resources.files(package).joinpath(name).read_text(encoding="utf-8")


def check_exists(text: str, meant: str = "") -> None:
    """Refuse a file that is not there, with what was ``meant`` or one that is called nearly so."""
    path = Path(re.sub(r"@[^@/]*:[^@/]*$", "", text))  # LOG@120:1800
    if os.path.exists(text) or os.path.exists(path):
        return
    if os.path.exists(whole := text.rpartition("@")[0]):
        hint = f"a part of a log is {whole}@START:STOP, in seconds"
        raise UserError("no such file, and no part of one", file=text, hint=hint)
    while not path.parent.is_dir():
        path = path.parent
    names = os.listdir(path.parent) if os.access(path.parent, os.R_OK) else []
    same = [name for name in names if name.split(".")[0] == path.name.split(".")[0]]  # but for its ending
    hint = meant or known_names(path.name, same or names, "check the path")
    raise UserError("no such file or folder", file=text, hint=hint)


def check_kind(ctx: Any, path: str, wanted: str) -> None:
    """Refuse what is known to be another kind of file, with what to type instead."""
    actual, verb = kind_of(path if os.path.exists(path) else path.rpartition("@")[0]), ctx.command.name
    if actual in ("", wanted) or {actual, wanted} in BOTH:
        return
    verbs_of, above = ctx.parent.command, ctx.parent
    fits = {v: _places(verbs_of.get_command(above, v), actual) for v in verbs_of.list_commands(above)}
    verbs = [name for name, (_, takes) in fits.items() if takes]
    hint = KINDS[actual].get("hint", f"it is for {', '.join(verbs)}")
    if wanted in _FILES_OF_RUN and os.path.isfile(file_inside := Path(path, _FILES_OF_RUN[wanted])):
        hint = f"give {file_inside}"
    elif kind_of(folder := Path(path).parent) == wanted:
        hint = f"give {folder}"
    elif verb in verbs:
        hint = f"write {' '.join([verb, *fits[verb][0]])}"
    if needs := KINDS[wanted].get("needs"):
        hint = f"{hint}; {KINDS[wanted]['words']} has {needs}"
    raise UserError(f"is {KINDS[actual]['words']}, not {KINDS[wanted]['words']}", file=path, hint=hint)


def _places(command: Any, kind: str) -> tuple[list[str], bool]:
    """Return a verb's arguments with its options for this kind of file, and whether it takes any."""
    takes = [p for p in command.params if p.name != "out" and TAKES.get(p.metavar) == kind]
    first = [p.metavar for p in command.params if p.param_type_name == "argument"]
    named = [f"{p.opts[0]} {p.metavar}" for p in takes if p.metavar not in first]
    return first + named, bool(takes)


def _hint_of_extra_word(ctx: Any, word: str) -> str:
    """Return the hint for a word that stands behind the value of an option that takes names with commas."""
    lists = {opt for p in ctx.command.params if "," in str(p.metavar) for opt in p.opts}
    for option, first, then in zip(*(ctx.meta[TYPED][k:] for k in range(3))):
        if option in lists and then == word:
            return f"names of one option are joined by commas: {option} {first},{word}"
    return ""


def _meant(path: str, kind: str) -> list[str]:
    """Return the files that a path is, where a pattern may stand for them."""
    return matching_files(path) if kind == "grasps" else [path]


def check_files(ctx: Any) -> None:
    """Refuse what is not there, of another kind, or not whole among what a verb was given."""
    named_files = []
    for param in ctx.command.params:
        kind, value = TAKES.get(param.metavar, ""), ctx.params.get(param.name)
        if kind and value and param.name != "out":
            named_files += [
                (str(path), kind) for path in (value if isinstance(value, list | tuple) else [value])
            ]
    named_files.sort(
        key=lambda each: each[1] != "network"
    )  # a misspelt name is refused before files are read
    named = ("network", "page", "port")  # which need no file
    files = [(path, kind) for path, kind in named_files if kind not in named or os.path.isfile(path)]
    files = [(each, kind) for path, kind in files for each in _meant(path, kind)]
    for path, _ in files:
        check_exists(path, _hint_of_extra_word(ctx, path))
    for path, kind in files:
        check_kind(ctx, path, kind)
    for path, kind in named_files:
        if where := KINDS[kind].get("check"):
            module, name = where.split(":")
            getattr(import_module(module), name)(path)
