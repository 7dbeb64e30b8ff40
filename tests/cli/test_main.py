"""The command line as scripts see it: exit codes, one line for a mistake, one JSON object, a light help."""

from __future__ import annotations

import errno
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer

from thermogrip.cli.main import VERBS, Verb, Verbs, main
from thermogrip.cli.rig import RigOptions
from thermogrip.datasets.errors import UserError

HEAVY = ["numpy", "scipy", "xarray", "pandas", "casadi", "numba", "llvmlite", "nlopt", "emcee", "arviz"]
HEAVY += ["pysindy", "daqp", "torch", "sklearn", "matplotlib", "pyarrow", "h5py", "serial", "jinja2"]


def in_a_fresh_process(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=120, check=False
    )


@pytest.mark.parametrize("words", [["--help"], ["--version"], ["run", "--help"], ["identify", "-h"]])
def test_help_imports_no_heavy_package(words: list[str]) -> None:
    code = f"import sys; from thermogrip.cli.main import main; main({words!r})"
    code += "; print('|' + ' '.join(sys.modules))"
    done = in_a_fresh_process(code)
    assert done.returncode == 0, done.stderr
    loaded = {name.split(".")[0] for name in done.stdout.rsplit("|", 1)[1].split()}
    assert loaded.isdisjoint(HEAVY)


def test_the_rooms_are_importable_without_their_heavy_packages() -> None:
    rooms = "thermogrip.datasets, thermogrip.sysid, thermogrip.mpc, thermogrip.rig, thermogrip.classify"
    done = in_a_fresh_process(f"import sys, {rooms}; print(' '.join(sys.modules))")
    assert done.returncode == 0, done.stderr
    loaded = {name.split(".")[0] for name in done.stdout.split()}
    assert loaded.isdisjoint(
        {"casadi", "llvmlite", "numba", "nlopt", "emcee", "arviz", "pysindy", "daqp", "torch", "sklearn"}
    )


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_two_examples_that_its_own_options_understand_and_a_next_one(
    verb: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([verb, "--help"]) == 0
    shown = capsys.readouterr().out
    options, rest = shown.split("\nExamples:\n")
    examples, following = rest.split("\nNext:\n")
    lines = [line.split() for line in examples.splitlines()]
    assert [line[:2] for line in lines] == [["thermogrip", verb]] * 2
    for word in (word for line in lines for word in line if word.startswith("--")):
        assert f"{word} " in options or f"{word}\n" in options, word
    (program, after, *_), *more = [line.split() for line in following.splitlines()]
    assert (program, after in VERBS, more) == ("thermogrip", True, [])
    assert not re.search(r"<[a-z]", options)  # no <list[str]>


#: What other people's scripts type; an option goes only with a major version.
SCRIPTED = {
    "demo": "--out",
    "identify": "--out --network --inputs --outputs --disturbances --models --average --leave-one-out "
    "--posterior --no-posterior --report --json",
    "validate": "--warmup --score-from --average --json",
    "simulate": "--out --warmup",
    "excite": "--kind --minutes --plant --out",
    "tune": "--out --spec --report",
    "export": "--out --check",
    "run": "--target --port --twin --draw --from --hold --object --material --grasp-time --settle-timeout "
    "--out",
    "effusivity": "--calibrate --out",
    "train": "--classifier --split --out",
    "classify": "--materials --out",
    "compare": "--test --classifiers --repeats --train-per-class --out",
    "paper": "--quick --out",
    "virtual": "--protocol --plant",
}


@pytest.mark.parametrize("verb", SCRIPTED)
def test_what_scripts_type_is_an_option(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    main([verb, "--help"])
    assert set(SCRIPTED[verb].split()) <= set(re.findall(r"--[a-z-]+", capsys.readouterr().out))


def test_the_help_says_of_each_verb_a_whole_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    main(["--help"])
    shown = capsys.readouterr().out.split("To begin:")[1]
    assert set(re.findall(r"(?m)^  ([a-z-]+) ", shown.split("Exit codes")[0])) == {*VERBS}
    assert "..." not in shown


def test_what_is_next_is_said_on_stderr_with_what_was_given(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "a spec.toml"
    assert main(["init", "spec", "--out", str(out)]) == 0
    assert capsys.readouterr().err == f"next: thermogrip tune PLANT --spec '{out}' --out controller.json\n"
    assert main(["init", "guard"]) == 0  # on stdout: once more, into a file
    assert capsys.readouterr().err == "next: thermogrip init guard --out guard.toml\n"
    monkeypatch.chdir(tmp_path)
    assert main(["init", "examples"]) == 0
    [then] = capsys.readouterr().err.splitlines()
    assert then == "next: thermogrip identify ./multisine.csv.xz --out plant.json"
    assert Path("./multisine.csv.xz").is_file()
    assert main(["materials", "copper", "--json"]) == 0
    assert main(["materials", "gold leaf"]) == 2
    assert "next:" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "target"),
    [
        ('{"notes": {"spec": {"steps": [[150, 200.5], [200, 220]]}}}', "200.5"),
        ('{"notes": {}}', "38"),
        ("", "38"),
    ],
)
def test_what_is_next_of_a_controller_goes_to_a_target_that_it_was_tuned_for(
    text: str, target: str, tmp_path: Path
) -> None:
    file = tmp_path / "c.json"
    file.write_text(text, encoding="utf-8")
    assert Verb("review").next({"controller": file}).endswith(f"--target {target} --out DIR")
    assert (
        Verb("export").next({"controller": "none.json"}) == "run none.json --port DEV --target 38 --out DIR"
    )


def alternatives(verb: str) -> list[str]:
    """Return what a verb may have found, by which the next command is chosen."""
    then = command_of(verb).then
    return [""] if isinstance(then, str) else list(then)


GIVEN = {
    "plant": "p.json", "controller": "c.json", "out": "out", "path": "log.csv", "paths": ["a.csv", "b.csv"],
    "folder": "run", "grasps": ["g.csv"], "like": "tclab",
}  # fmt: skip
RIGS = ({}, {"twin": "p.json"}, {"port": "COM3"}, {"network": "own.py:Tank", "twin": "p.json"})


@pytest.mark.parametrize("verb", VERBS)
@pytest.mark.parametrize("given", [{}, *(GIVEN | rig for rig in RIGS)])
def test_what_is_next_has_the_options_and_arguments_of_its_verb(verb: str, given: dict[str, Any]) -> None:
    known = {param.name for param in command_of(verb).params} if given else set()
    for found in alternatives(verb):
        mine = {name: value for name, value in given.items() if name in known}
        line = command_of(verb).next(mine, found=found)
        after, *words = shlex.split(line)
        command = command_of(after)
        options, rest, _ = command.make_parser(command.context_class(command)).parse_args(words)
        assert rest == [], line
        assert [p.name for p in command.params if p.required and not options.get(p.name)] == [], line
        if {"port", "twin"} <= {param.name for param in command.params}:
            RigOptions(port=options.get("port"), twin=options.get("twin")).check()
        if "network" in mine and "network" in {param.name for param in command.params}:
            assert options["network"] == mine["network"], line


def command_of(verb: str) -> Any:
    return Verbs(name="thermogrip").get_command(None, verb)


def test_help_is_as_wide_as_the_terminal_and_at_most_100_columns_of_a_pipe(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for terminal, columns, least, most in ((False, 300, 90, 100), (True, 140, 101, 140), (True, 60, 50, 60)):
        monkeypatch.setenv("COLUMNS", str(columns))
        monkeypatch.setattr("sys.stdout.isatty", lambda terminal=terminal: terminal)
        main(["identify", "--help"])
        shown = capsys.readouterr().out
        assert least < max(map(len, shown.split("Examples:")[0].splitlines())) <= most
        assert "\x1b" not in shown
    monkeypatch.setattr("sys.stdout.isatty", lambda: False)
    for verb in VERBS:
        main([str(verb), "--help"])
        assert max(map(len, capsys.readouterr().out.splitlines())) <= 100, verb


def test_help_ends_no_line_within_a_word(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    for verb in VERBS:
        shown = {}
        for columns in (60, 300):
            monkeypatch.setenv("COLUMNS", str(columns))
            main([str(verb), "--help"])
            shown[columns] = {part for part in re.split(r"\s+|(?<=,)", capsys.readouterr().out) if part}
        assert shown[60] <= shown[300], verb


def test_a_shell_completes_verbs_and_options() -> None:
    for typed, found in (("thermogrip val", "validate"), ("thermogrip identify --net", "--network")):
        asked = {"_THERMOGRIP_COMPLETE": "complete_bash", "COMP_WORDS": typed}
        done = subprocess.run(
            [sys.executable, "-c", "from thermogrip.__main__ import main; main()"],
            env=os.environ | asked | {"COMP_CWORD": str(typed.count(" "))},
            capture_output=True, text=True, timeout=120, check=False,
        )  # fmt: skip
        assert (done.returncode, done.stdout.split()) == (0, [found]), done.stderr


def test_no_words_show_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    assert "On the rig:" in capsys.readouterr().out


def test_help_of_a_verb_is_its_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["help", "materials"]) == main(["materials", "--help"]) == 0
    asked, usual = capsys.readouterr().out.split("Usage: thermogrip materials")[1:]
    assert asked == usual


def test_ctrl_c_while_the_program_is_imported_is_one_quiet_line() -> None:
    """The signal comes as the last module before the command line is looked for."""
    code = (
        "import os, signal, sys\n"
        "class Finder:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'thermogrip.cli.main':\n"
        "            os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Finder())\n"
        "sys.argv = ['thermogrip', 'materials']\n"
        "from thermogrip.__main__ import main\n"
        "sys.exit(main())"
    )
    done = in_a_fresh_process(code)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "thermogrip: stopped by Ctrl-C\n")


def test_after_the_imports_ctrl_c_is_python_s_own_again() -> None:
    code = (
        "import signal, sys; from thermogrip.__main__ import main; sys.argv = ['thermogrip', '--version']\n"
        "main(); print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)\n"
        "signal.signal(signal.SIGINT, signal.SIG_IGN); main()\n"
        "print(signal.getsignal(signal.SIGINT) is signal.SIG_IGN)"
    )
    done = in_a_fresh_process(code)
    assert [line for line in done.stdout.splitlines() if "thermogrip" not in line] == ["True", "True"]


def test_ctrl_c_is_code_130(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted() -> dict[str, object]:
        raise KeyboardInterrupt

    monkeypatch.setattr("thermogrip.sysid.contact.materials.load_materials", interrupted)
    assert main(["materials"]) == 130
    assert capsys.readouterr().err == "thermogrip: stopped by Ctrl-C\n"


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (UserError("a\n  b", file="x.csv", hint="correct it"), 2, "x.csv: a b; correct it"),
        (OSError(errno.ENOSPC, "full", "out.csv"), 2, "out.csv: "),
        (OSError(errno.EIO, "broken"), 2, "the system: "),
        (ZeroDivisionError("zero"), 1, "bug: ZeroDivisionError: zero; run again with --debug and report the"),
        (typer.Abort(), 130, "stopped by Ctrl-C"),
    ],
)
def test_every_error_has_its_code_and_one_line(
    error: Exception,
    code: int,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def broken() -> None:
        raise error

    monkeypatch.setattr("thermogrip.sysid.contact.materials.load_materials", broken)
    for words in (["materials"], ["materials", "--debug"]):
        assert main(words) == code
        out, err = capsys.readouterr()
        assert out == ""
        *before, line = err.splitlines()
        assert line.startswith(f"thermogrip: {said}")
        assert bool(before) == ("--debug" in words and code != 130)


def test_a_pipe_that_is_closed_is_no_mistake() -> None:
    done = subprocess.run(
        [sys.executable, "-c", "import os, sys; from thermogrip.cli.main import main\n"
         "r, w = os.pipe(); os.dup2(w, 1); os.close(w); os.close(r)\n"
         "codes = main(['materials']), main(['init', 'network', '--json']), main(['materials', 'copper'])\n"
         "sys.exit(sum(codes) + 5)"],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (5, "")


def test_linear_algebra_has_one_thread_unless_somebody_says_otherwise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    monkeypatch.setenv(names[0], "3")
    for name in names[1:]:
        monkeypatch.delenv(name, raising=False)
    main(["--version"])
    assert [os.environ[name] for name in names] == ["3", "1", "1"]
    for name in names[1:]:
        monkeypatch.setenv(name, "1")
