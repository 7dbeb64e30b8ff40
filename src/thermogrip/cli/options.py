"""What the verbs share: options of one meaning, exit codes, and what is given to a verb, checked beforehand.

What a file is, its name and its beginning say: one of the wrong kind is refused with the verbs it is for.
What a verb takes in a place of its command line is known by what that place is called in its help.  Nothing
heavy is loaded, and a file that nothing is known of is left to its reader.
"""

from __future__ import annotations

import gzip
import json
import lzma
import os
import re
import sys
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import IntEnum
from functools import cache, wraps
from importlib import import_module, resources
from inspect import Parameter, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from thermogrip.cli.grasp_arguments import matching_files
from thermogrip.datasets.errors import UserError, as_user_error, known_names
from thermogrip.datasets.files import make_folder

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Grasps, Log
    from thermogrip.sysid.effusivity.quality import GraspQuality
    from thermogrip.sysid.models.model import GreyModel
    from thermogrip.sysid.plant.plant import Plant


class ExitCode(IntEnum):
    """What the process ends with."""

    DONE = 0
    BUG = 1  # ours
    USER = 2  # the user's input is at fault
    ANSWER_IS_NO = 3  # the work was done
    INTERRUPTED = 130  # by Ctrl-C


ANSWER_IS_NO = ExitCode.ANSWER_IS_NO
#: Repairs of one file that are printed.
SHOWN_REPAIRS = 5
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


class Done(int):
    """Exit status of a verb that has done its work, and ``what`` it found, by which the command that comes
    next is chosen; ``command`` is that command where what was found decides it."""

    what: str
    command: str

    def __new__(cls, what: str, code: int = 0, command: str = "") -> Done:
        """Make one."""
        made = super().__new__(cls, code)
        made.what, made.command = what, command
        return made


def check_network(text: str) -> None:
    """Refuse what is no network, or no file of one."""
    if text == "none":
        return
    file, name = _split_class(text)
    if name or Path(text).suffix:
        check_exists(file)
    if not name:
        from thermogrip.sysid.models.network_spec import named_network

        named_network(text)


def _split_class(text: str) -> tuple[str, str]:
    """Return file and class of ``FILE.py:CLASS``; no class where a network is named."""
    file, _, name = text.rpartition(":")
    if text.endswith((".py", ".py:")):
        whole = text.removesuffix(":")
        raise UserError("names no class", file=whole, hint=f"write {whole}:CLASS")
    return (file, name) if file.endswith(".py") else (text, "")


def check_new_page(value: str) -> None:
    """Refuse a page that cannot be written there."""
    new_file(Path(value), (".html",))


def check_port(value: str) -> None:
    """Refuse a device that is not there, with those that are."""
    if "://" not in value and sys.platform != "win32" and not os.path.exists(value):
        patterns = ("ttyACM*", "ttyUSB*", "cu.*")
        devices = sorted(str(path) for pattern in patterns for path in Path("/dev").glob(pattern))
        words = "use {}" if devices else "none is here"
        hint = known_names(value, devices, f"{words}; check name, cable and power")
        raise UserError("no such port", file=value, hint=hint)


def check_folder(value: str) -> None:
    """Refuse what is no folder."""
    if not os.path.isdir(value):
        raise UserError("is not a folder", file=value, hint="give the folder that train --out made")


def one_of(option: str, allowed: Sequence[str]) -> Callable[[str | None], str | None]:
    """Return the check that an option, where it is given, is one of the allowed words (``callback=``)."""

    def check(value: str | None) -> str | None:
        return value if value is None else choice(option, value, allowed)

    return check


def opt(
    name: str,
    metavar: str | None,
    words: str,
    check: Callable[..., Any] | None = None,
    *,
    min: float | None = None,
    max: float | None = None,
) -> Any:
    """Return the Typer option of a name, what its value is called, its help, a ``callback=``, its bounds."""
    return typer.Option(name, metavar=metavar or "N", help=words, callback=check, min=min, max=max)


@cache
def _option_table() -> dict[str, dict[str, Any]]:
    return tomllib.loads((resources.files(__package__) / "options.toml").read_text(encoding="utf-8"))


def shared(name: str, check: Callable[..., Any] | None = None, **words: str) -> Any:
    """Return the Typer option of ``options.toml``, with a ``callback=`` and words in place of {names}."""
    about = _option_table()[name]
    return typer.Option(name, callback=check, **(about | {"help": about["help"].format(**words)}))


def flag(name: str, words: str) -> Any:
    """Return the Typer option that is there or not."""
    return typer.Option(name, help=words)


def arg(metavar: str, words: str, check: Callable[..., Any] | None = None) -> Any:
    """Return the Typer argument of a place on the command line."""
    return typer.Argument(metavar=metavar, help=words, callback=check)


def grouped(verb: Callable[..., int]) -> Callable[..., int]:
    """Return a verb with the fields of its parameters that are dataclasses in their place, as options."""
    whole = signature(verb, eval_str=True)
    groups: dict[str, Any] = {
        name: one.annotation for name, one in whole.parameters.items() if is_dataclass(one.annotation)
    }
    parameters = []
    for name, parameter in whole.parameters.items():
        if name not in groups:
            parameters.append(parameter.replace(kind=Parameter.KEYWORD_ONLY))
            continue
        hints = get_type_hints(groups[name], include_extras=True)
        for one in fields(groups[name]):
            option = Parameter(one.name, Parameter.KEYWORD_ONLY, default=one.default)
            parameters.append(option.replace(annotation=hints[one.name]))

    @wraps(verb)
    def with_options(**given: Any) -> int:
        for name, group in groups.items():
            given[name] = group(**{one.name: given.pop(one.name) for one in fields(group)})
        return verb(**given)

    vars(with_options)["__signature__"] = whole.replace(parameters=parameters)
    with_options.__annotations__ = {one.name: one.annotation for one in parameters}
    return with_options


AsJson = Annotated[bool, flag("--json", "Print one JSON object on stdout and nothing else there.")]
Seed = Annotated[int, opt("--seed", None, "Seed of everything random.", min=0)]
Workers = Annotated[int, opt("--workers", None, "Local processes for work that can be shared out.", min=1)]
Cluster = Annotated[
    str | None,
    opt("--cluster", "tcp://HOST:PORT", "Dask cluster that does this work in place of local processes."),
]
Report = Annotated[Path | None, opt("--report", "FILE.html", "Also write a one-page report with figures.")]
PlantFile = Annotated[Path, arg("PLANT", "plant.json of identify.")]
LogFiles = Annotated[
    list[str],
    arg(
        "LOG...",
        "Text, .mat, .xlsx, NetCDF, Parquet; LOG@120:1800 takes seconds 120 to 1800 (either end may be "
        "empty).",
    ),
]
Columns = Annotated[str | None, opt("--columns", "A,B", "Headers in place of the log's; - leaves one out.")]
Step = Annotated[float | None, opt("--dt", "S", "Seconds between rows.", min=1e-9)]
OwnNetwork = Annotated[
    str | None,
    opt(
        "--network",
        "FILE.py:CLASS",
        "The class that the plant was fitted with, where it is your own (which runs the file).",
    ),
]


def without_meta_files(paths: list[str] | None) -> list[str] | None:
    """Leave out the meta files that a pattern of the shell gives beside the grasps they belong to."""
    all_paths = {*(paths or ())}
    return paths and [path for path in paths if path.replace("_meta.", ".") not in all_paths - {path}]


GraspFiles = Annotated[
    list[str],
    arg(
        "GRASPS...",
        "Grasp files (CSV with its _meta.csv, NetCDF, Parquet), folders or patterns.",
        without_meta_files,
    ),
]


def comma(text: str | None) -> tuple[str, ...] | None:
    """Return the words of a comma list, None where the option was not given."""
    if text is None:
        return None
    words = tuple(word.strip() for word in text.split(",") if word.strip())
    if not words:
        raise UserError(f"{text!r} names nothing", hint="write names with commas between them")
    return words


def numbers(option: str, text: str | None) -> dict[str, float]:
    """Return the numbers of ``NAME=X,...`` by name."""
    out = {}
    for word in comma(text) or ():
        name, _, number = word.partition("=")
        if name.strip() in out:
            raise UserError(f"{option} {text!r} names {name.strip()} twice", hint="name each once")
        with as_user_error(
            ValueError, f"{option} {word!r} is no NAME=NUMBER", hint="write q1=30,t_ambient=22"
        ):
            out[name.strip()] = float(number)
    return out


def workers_of(workers: int, cluster: str | None) -> int | str:
    """Return who does the work: so many local processes, or the cluster where one is named."""
    from thermogrip.datasets.parallel import check_workers

    return workers if cluster is None else check_workers(cluster)


def choice(option: str, value: str, allowed: Sequence[str]) -> str:
    """Return the value if it is one of the allowed, else raise the error that lists them."""
    if value not in allowed:
        raise UserError(f"{option} {value!r} is unknown", hint=known_names(value, allowed))
    return value


def listed(path: Path, *keys: str) -> list[str]:
    """Return the names that a JSON file of ours lists under these keys, before its reader; none where it is
    at fault, which the reader explains."""
    try:
        content = json.loads(path.read_bytes())
        for level in ("plant", "model", "network"):
            content = content.get(level, content)
        return [str(name) for key in keys for name in content[key]]
    except Exception:  # whatever is wrong with it, its reader says so
        return []


def choices(option: str, names: Iterable[str], path: Path, *keys: str) -> None:
    """Refuse names that a JSON file of ours does not list under these keys."""
    if allowed := listed(path, *keys):
        for name in names:
            choice(option, name, allowed)


def new_file(path: Path, suffixes: Sequence[str] = ()) -> Path:
    """Return a path that can be written, its folder made; raise UserError before any work is done."""
    if suffixes and path.suffix.lower() not in suffixes:
        raise UserError(
            f"cannot be written as a {path.suffix} file" if path.suffix else "has no ending",
            file=path,
            hint=f"name it {path.with_suffix(suffixes[0])}",
        )
    if path.is_dir():
        raise UserError("is a folder", file=path, hint="give the name of a file")
    _writable(path.parent)
    return path


def new_folder(path: Path) -> Path:
    """Return a folder that can be written, made where it is absent."""
    if path.exists() and not path.is_dir():
        raise UserError("is a file", file=path, hint="give the name of a folder")
    _writable(path)
    return path


def _writable(folder: Path) -> None:
    make_folder(folder)
    if not os.access(folder, os.W_OK | os.X_OK):
        raise UserError("this folder cannot be written", file=folder, hint="choose another place")


def load_logs(
    paths: Sequence[str],
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    disturbances: Sequence[str] | None = None,
    *,
    known: Mapping[str, str] | None = None,
    columns: Sequence[str] | None = None,
    dt: float | None = None,
) -> list[Log]:
    """Read several logs with the same roles; ``known`` are those that a model gives to its signals."""
    import numpy as np

    from thermogrip.datasets.log_files import read_log

    logs: list[Log] = []
    for path in paths:
        # what is guessed of the first log is so in all
        first = {str(n): str(v.attrs["role"]) for log in logs[:1] for n, v in log.data_vars.items()}
        roles = {**first, **known} if known else first or None
        logs.append(read_log(path, inputs, outputs, disturbances, known=roles, columns=columns, dt=dt))
    # a column that never moves in any log is not guessed to be an input or an output
    for line in str(logs[0].attrs.get("guesses", "")).splitlines():
        name, why = line.split(": ", 1)[0], "it never moves"
        if name not in logs[0]:  # of a file whose column was lost
            continue
        values = np.concatenate([log[name].values for log in logs if name in log])
        level = float(np.nanmax(values))
        role = logs[0][name].attrs["role"]
        if level > np.nanmin(values) or (role == "input" and level in (0.0, 1.0)) or role == "other":
            continue  # a switch that stays as it is may still be a switch
        for log in (log for log in logs if name in log):
            log[name].attrs["role"] = "other"
            log.attrs["guesses"] = str(log.attrs.get("guesses", "")).replace(line, f"{name}: {why}")
    return logs


def warn_of_contacts(
    warn: Callable[[str], None], records: Sequence[Grasps], qualities: Sequence[GraspQuality] | None = None
) -> None:
    """Warn of what was repaired in records while they were read, and of contacts that are missing or late;
    ``qualities`` are those of the records where a caller has them."""
    from thermogrip.sysid.effusivity.quality import check_grasps, contact_faults, torn_groups, touched_groups

    for grasps, quality in zip(records, qualities or map(check_grasps, records)):
        repairs = [line for line in str(grasps.attrs.get("repairs", "")).splitlines() if line]
        more = [f"{len(repairs) - SHOWN_REPAIRS} more like these"] if len(repairs) > SHOWN_REPAIRS else []
        for words in [*repairs[:SHOWN_REPAIRS], *more, *contact_faults(grasps, quality)]:
            warn(f"{grasps.attrs['name']}: {words}")
    for words in torn_groups((record.attrs["name"], touched_groups(record)) for record in records):
        warn(words)


def find_network(text: str) -> GreyModel:
    """Return the model of ``--network``: a network by name or TOML file, or ``FILE.py:NAME``, run."""
    from thermogrip.sysid.models.network import NetworkModel, load_network
    from thermogrip.sysid.models.user_model import load_object, own_model

    file, name = _split_class(text)
    if not name:
        return load_network(text)
    own_object = load_object(file, name)
    # a class of the user's own, or what makes a NetworkModel without arguments
    if isinstance(own_object, type) and not issubclass(own_object, NetworkModel):
        return own_model(own_object)
    made = _made(own_object, file, name)
    return made if isinstance(made, NetworkModel) else own_model(made)


def _made(found: Any, file: str, name: str) -> Any:
    """Return what a user's function makes."""
    try:
        return found()
    except UserError:
        raise
    except Exception as error:  # the user's own code may raise anything
        problem = f"{name} fails with {type(error).__name__}: {error}"
        raise UserError(problem, file=file, hint="correct the file") from error


def load_plant(path: Path, network: str | None = None) -> Plant:
    """Return the plant of a file; ``network`` is the ``FILE.py:CLASS`` of one with equations of its own."""
    from thermogrip.sysid.plant.plant import Plant

    return Plant.load(path, model=None if network is None else find_network(network))


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
    # of grasps a pattern may stand for several
    files = [(p, k) for path, k in files for p in (matching_files(path) if k == "grasps" else [path])]
    for path, _ in files:
        check_exists(path, _hint_of_extra_word(ctx, path))
    for path, kind in files:
        check_kind(ctx, path, kind)
    for path, kind in named_files:
        if where := KINDS[kind].get("check"):
            module, name = where.split(":")
            getattr(import_module(module), name)(path)
