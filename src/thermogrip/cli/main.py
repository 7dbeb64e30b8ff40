"""The command line: one verb a stage, and one line for every mistake.

    logs -> plant -> controller -> session -> grasps -> classifier -> report

Exit codes: 0 done; 1 our bug; 2 the user's input is at fault; 3 done, but the answer is no; 130 Ctrl-C.  A
mistake of the user is one line on stderr that says what is wrong and what to do; a traceback is shown with
``--debug`` only.  ``verbs.toml`` has the examples of each verb by job, and the line that comes next.
"""

from __future__ import annotations

import errno
import json
import os
import re
import shlex
import sys
import tomllib
import traceback
from collections.abc import Sequence
from contextlib import chdir, suppress
from difflib import get_close_matches
from functools import cache
from importlib import import_module, resources
from inspect import signature
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

# none of these loads a heavy package: --help is there within half a second
from thermogrip import __version__
from thermogrip.cli.options import TYPED, ExitCode, check_files
from thermogrip.datasets.errors import UserError, known_names, os_fault
from thermogrip.datasets.files import note_seed, work
from thermogrip.media.rendering import printable, without_password

#: Options that may stand alone, and what they mean then: any free port, and the one that Foxglove asks for.
ALONE = {"--live": "0", "--foxglove": "8765"}
#: Each verb and its module of this package, in the order of the documentation.
VERBS = {
    "demo": "project", "identify": "identify", "validate": "identify",
    "simulate": "identify", "linearise": "identify", "excite": "excite",
    "tune": "control", "review": "control", "export": "control",
    "autotune": "autotune", "run": "rig", "record": "rig", "virtual": "rig", "batch": "rig", "recover": "rig",
    "effusivity": "classify", "train": "classify", "classify": "classify", "compare": "compare",
    "paper": "project", "materials": "classify", "init": "project", "warm-up": "project",
}  # fmt: skip


@cache
def jobs() -> dict[str, dict[str, list[Any]]]:
    """Return job -> verb -> two examples and what comes next."""
    return tomllib.loads((resources.files("thermogrip.cli") / "verbs.toml").read_text(encoding="utf-8"))


def _whole_words(formatter: Any) -> Any:
    """Return a help formatter that ends no line within a word: at no hyphen, and in a list behind a comma."""
    write = formatter.write
    write_text = formatter.write_text
    write_dl = formatter.write_dl

    def marked(text: str) -> str:
        return re.sub(r"(?<=\w)-(?=\w)", "\u2011", re.sub(r",(?=\S)", ",\ue000 ", text))

    formatter.write = lambda text: write(re.sub("\ue000 ?", "", text).replace("\u2011", "-"))
    formatter.write_text = lambda text: write_text(marked(text))
    formatter.write_dl = lambda rows: write_dl([(name, marked(about)) for name, about in rows])
    return formatter


class Verb(TyperCommand):
    """A command whose files are looked at once its words are right, before the verb imports any room."""

    def __init__(self, name: str | None, **attrs: Any) -> None:
        super().__init__(name, **attrs)
        (*self.examples, self.then) = next(verbs[str(name)] for verbs in jobs().values() if name in verbs)
        for param in self.params:  # its type stands after an argument, and its metavar says enough
            if param.param_type_name == "argument":
                vars(param)["display_type_rich"] = lambda ctx: None

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Give an option its usual value where it stands alone."""
        ctx.meta[TYPED] = args
        words: list[str] = []
        for word, after in zip(args, [*args[1:], ""]):
            words += [word, ALONE[word]] if word in ALONE and not after.isdigit() else [word]
        return super().parse_args(ctx, words)

    def invoke(self, ctx: Any) -> Any:
        """Check what was given, run the verb, and where that went well say on stderr what to type next."""
        note_seed(ctx.params.get("seed"))
        check_files(ctx)
        code = super().invoke(ctx)
        outcome = getattr(code, "what", None)  # also where the work is done and the answer is no
        if (not code or outcome is not None) and not ctx.params.get("as_json"):
            sys.stdout.flush()
            stated = {name: value for name, value in ctx.params.items() if value}
            command = getattr(code, "command", "") or self.next(stated, ctx.meta[TYPED], outcome or "")
            sys.stderr.write(f"next: thermogrip {command}\n")
        return code

    def next(self, given: dict[str, Any], typed: Sequence[str] = (), found: str = "") -> str:
        """Return the command that comes next after what the verb ``found``, with what was given in place of
        its names: what was typed once more where that wrote no file for it."""
        words = {str(param.name): str(param.metavar).split("|")[0].rstrip(".") for param in self.params}
        kind_of_work = given.get("what", "")
        then = (
            self.then
            if isinstance(self.then, str)
            else self.then[found or kind_of_work or next(iter(self.then))]
        )
        if kind_of_work == "examples":
            words["out"] = "."
        elif typed and "{out}" in then and "out" not in given:
            file = f"{kind_of_work}.toml" if kind_of_work else self.examples[0].rpartition("--out ")[2]
            return printable(shlex.join([str(self.name), *typed, "--out", file]))
        for name, value in given.items():
            words[name] = printable(shlex.join(map(str, value if isinstance(value, list) else [value])))
        words.setdefault("target", _target(given.get("controller")))
        rig = "port" if "port" in given else "twin"
        words["rig"] = f"--{rig} {words.get(rig, 'PLANT')}"
        line = str(then).format(**words)
        own_network = str(
            given.get("network", "")
        )  # a class of the user's own, which no file of a plant holds
        if ".py:" in own_network and "--network" not in line:
            takes_it = "network" in signature(function_of(line.split()[0])).parameters
            line += f" --network {printable(shlex.quote(own_network))}" if takes_it else ""
        return line

    def get_short_help_str(self, limit: int = 200) -> str:
        """Return the first sentence of the help, whole."""
        return super().get_short_help_str(limit)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help, no word of it broken."""
        super().format_help(ctx, _whole_words(formatter))

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the options and each argument once."""
        return ["[OPTIONS]", *(str(p.metavar) for p in self.params if p.param_type_name == "argument")]

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write two examples and the verb that comes next; a command is one line."""
        with formatter.section("Examples"):
            for line in self.examples:
                formatter.write(f"  thermogrip {line}\n")
        with formatter.section("Next"):
            formatter.write(f"  thermogrip {self.next({})}\n")


def _target(controller: Any) -> str:
    """Return the first target that a controller in a file was tuned for, 38 where it was tuned for none."""
    with suppress(Exception):  # what else it may hold costs a better word, not the verb
        steps = json.loads(Path(controller).read_text(encoding="utf-8"))["notes"]["spec"]["steps"]
        return f"{float(steps[0][1]):g}"
    return "38"


def function_of(verb: str) -> Any:
    """Return the function of a verb."""
    return getattr(import_module(f"thermogrip.cli.{VERBS[verb]}"), verb.replace("-", "_"))


class Verbs(TyperGroup):
    """The verbs, by job; each is imported and its options are read when it is asked for."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of the verbs."""
        return list(VERBS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a verb by its name, None where there is none."""
        if cmd_name in VERBS and cmd_name not in self.commands:
            alone = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
            alone.command(cmd_name, cls=Verb)(function_of(cmd_name))
            self.commands[cmd_name] = typer.main.get_command(alone)
        return self.commands.get(cmd_name)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the verb that was typed; where there is none, name those that are spelt like it."""
        if args[0] in VERBS or args[0].startswith("-"):
            return super().resolve_command(ctx, args)
        like = ", ".join(map(repr, get_close_matches(args[0], VERBS)))
        return ctx.fail(f"No such command {args[0]!r}.{f' Did you mean {like}?' if like else ''}")

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help, no word of it broken."""
        super().format_help(ctx, _whole_words(formatter))

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write a section a job, each verb with the whole first sentence of its help."""
        for job, verbs in jobs().items():
            with formatter.section(job):
                formatter.write_dl(
                    [(name, self.get_command(ctx, name).get_short_help_str()) for name in verbs]
                )


app = typer.Typer(
    name="thermogrip",
    cls=Verbs,
    no_args_is_help=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Exit codes: 0 done; 1 a bug of ours; 2 your input is at fault; 3 done, but the answer is no; "
    "130 Ctrl-C. --debug anywhere shows the traceback of a bug.",
)


def _version(wanted: bool) -> None:
    if wanted:
        sys.stdout.write(f"thermogrip {__version__}\n")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Thermal touch with a finger that sets its own temperature.

    Identify the plant from logs, tune the MPC, run a session, name the material of what was touched.
    """


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command line, the words after ``thermogrip``, and return its exit code."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # matrices here are small: threads cost more than they give
    _ignore_settings_of_folder()
    words = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"] or ["--help"]
    words = [*words[1:], "--help"] if words[0] == "help" else words
    try:
        width = 10_000 if sys.stdout.isatty() else 100  # of help, at most
        with work(["thermogrip", *map(without_password, words)]):
            code = app(args=words, prog_name="thermogrip", standalone_mode=False, max_content_width=width)
        sys.stdout.flush()
    except (KeyboardInterrupt, typer.Abort):
        return _fail("stopped by Ctrl-C", ExitCode.INTERRUPTED)
    except UserError as error:
        return _fail(str(error), ExitCode.USER, debug)
    except typer.TyperException as error:
        return _fail(_option_line(error), ExitCode.USER, debug)
    except SystemExit:
        if type(sys.stdout).__name__ == "PacifyFlushWrapper":  # typer's, of a pipe that was closed in a verb
            return ExitCode.DONE
        raise
    except OSError as error:
        if error.errno == errno.EPIPE:  # `thermogrip ... | head` is no mistake
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return ExitCode.DONE
        return _fail(str(os_fault(error, error.filename or "the system")), ExitCode.USER, debug)
    except Exception as error:  # the outermost edge: whatever is left is our bug
        return _fail(
            f"bug: {type(error).__name__}: {error}; run again with --debug and report the traceback",
            ExitCode.BUG,
            debug,
        )
    if code == ExitCode.INTERRUPTED:  # typer makes a code of a Ctrl-C inside a verb
        return _fail("stopped by Ctrl-C", ExitCode.INTERRUPTED)
    return int(code or ExitCode.DONE)


def _ignore_settings_of_folder() -> None:
    """Keep libraries from settings in the working folder, which may be somebody's data."""
    # .numba_config.yaml, before which this goes, names a folder of pickles, which run code
    os.environ.setdefault("NUMBA_CACHE_DIR", "")
    if os.path.lexists("matplotlibrc"):  # goes before $MATPLOTLIBRC, and can start LaTeX
        with chdir(Path(__file__).parent):  # no thread runs yet
            import_module("matplotlib")


def _fail(line: str, code: int, debug: bool = False) -> int:
    """Write one line on stderr (and the traceback, if asked) and return the code."""
    if debug:
        traceback.print_exc()
    sys.stderr.write(f"thermogrip: {printable(' '.join(line.split()))}\n")
    return code


def _option_line(error: typer.TyperException) -> str:
    """Return what is wrong with an option and where its help is."""
    context = getattr(error, "ctx", None)
    path = context.command_path if context is not None else "thermogrip"
    words, about = error.format_message().rstrip("."), vars(error)
    if about.get("possibilities"):
        like = known_names(about["option_name"], about["possibilities"], "")
        words = "; ".join(filter(None, (about["message"].rstrip("."), like)))
    elif re.fullmatch("-[a-z]", letter := str(about.get("option_name", ""))) and context is not None:
        long = [name for param in context.command.params for name in param.opts if name[1:3] == letter]
        words = f"{words}; options are whole words: {', '.join(long)}" if long else words
    elif "param_type" in about and isinstance(command := getattr(context, "command", None), Verb):
        words = f"{words}; for example thermogrip {command.examples[0]}"
    elif number := re.match(r"[-+]?\d+(\.\d+)?(?=[^\d.])", typed := _given(error)):
        option, begin = about["param"].opts[0], words.partition(": ")[0]
        words = f"{begin}: {typed!r} is no number; write {option} {number[0]}"
    return f"{words}; see {path} --help"


def _given(error: Exception) -> str:
    """Return what an option was given that its type cannot take, "" where that is not known."""
    faults: list[dict[str, object]] = getattr(error.__cause__, "errors", list)()
    return str(faults[0]["input"]) if faults else ""
