"""The command line: one verb a stage, and one line for every mistake.

    logs -> plant -> controller -> session -> grasps -> classifier -> report

Exit codes: 0 done; 1 our bug; 2 the user's input is at fault; 3 done, but the answer is no; 130 Ctrl-C.  A
mistake of the user is one line on stderr that says what is wrong and what to do; a traceback is shown with
``--debug`` only.
"""

from __future__ import annotations

import errno
import os
import re
import sys
import traceback
from collections.abc import Sequence
from contextlib import chdir
from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer

# none of these loads a heavy package: --help is there within half a second
from thermogrip import __version__
from thermogrip.cli.options import ExitCode
from thermogrip.cli.verbs import Verb, Verbs
from thermogrip.datasets.errors import UserError, known_names, os_fault
from thermogrip.datasets.files import work
from thermogrip.datasets.media import printable, without_password

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
