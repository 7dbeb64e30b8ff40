"""The command line as scripts see it: exit codes, one line for a mistake, one JSON object, a light help."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from thermogrip.cli.main import app, main

HEAVY = (
    "numpy",
    "scipy",
    "xarray",
    "pandas",
    "casadi",
    "numba",
    "llvmlite",
    "nlopt",
    "emcee",
    "arviz",
    "pysindy",
    "daqp",
    "torch",
    "sklearn",
    "matplotlib",
    "pyarrow",
    "h5py",
    "serial",
    "jinja2",
)

VERBS = [command.name for command in app.registered_commands]


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


def test_python_dash_m_is_the_command() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "thermogrip", "--version"],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert (done.returncode, done.stdout[:10]) == (0, "thermogrip"), done.stderr


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_help_that_names_its_options(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([verb, "--help"]) == 0
    text = capsys.readouterr().out
    assert "Usage: thermogrip" in text
    assert "--json" in text


def test_the_verbs_are_those_of_the_contract() -> None:
    verbs = "demo identify validate simulate excite tune review export run effusivity train classify compare"
    more = "paper materials init record recover virtual batch"
    assert set(VERBS) == {*verbs.split(), *more.split()}


def test_no_words_show_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    assert "Commands:" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["nope"], "No such command 'nope'"),
        (["identfy", "a.csv"], "Did you mean 'identify'"),
        (["--nope"], "No such option"),
        (["identify"], "Missing argument"),
        (["identify", "a.csv"], "Missing option '--out'"),
        (["demo", "--seed", "many"], "'--seed'"),
        (["demo", "--seed", "-1"], "'--seed'"),
        (["run", "c.json", "--target", "warm", "--out", "x"], "'--target'"),
        (["init", "everything"], "template 'everything' is unknown"),
        (["identify", "a.csv", "--out", "x.json", "--models", "arx,magic"], "'magic' is unknown"),
    ],
)
def test_a_bad_option_is_one_line_and_code_2(
    words: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith("thermogrip: ")
    assert says in err


def test_our_bug_is_code_1_and_shows_its_traceback_with_debug_only(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken() -> dict[str, object]:
        raise ZeroDivisionError("planted")

    monkeypatch.setattr("thermogrip.datasets.materials.load_materials", broken)
    assert main(["materials"]) == 1
    assert capsys.readouterr().err.count("\n") == 1
    assert main(["materials", "--debug"]) == 1
    assert "Traceback" in capsys.readouterr().err


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

    monkeypatch.setattr("thermogrip.datasets.materials.load_materials", interrupted)
    assert main(["materials"]) == 130
    assert capsys.readouterr().err == "thermogrip: stopped by Ctrl-C\n"


def test_json_is_one_object_and_nothing_else(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["materials", "copper", "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["materials"]
    assert row["name"] == "copper"
    assert row["effusivity"] == pytest.approx(3.64e4, rel=0.05)


@pytest.mark.parametrize("what", ["spec", "network", "topics", "guard"])
def test_a_template_is_printed_or_written_once(
    what: str, tmp_path: object, capsys: pytest.CaptureFixture[str]
) -> None:
    path = f"{tmp_path}/{what}.toml"
    assert main(["init", what]) == 0
    shown = capsys.readouterr().out
    assert main(["init", what, "--out", path]) == 0
    with open(path, encoding="utf-8") as file:
        assert file.read() == shown
    capsys.readouterr()
    assert main(["init", what, "--out", path]) == 2
    assert "exists already" in capsys.readouterr().err


def test_the_examples_come_out_ready_to_use(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["init", "examples", "--out", str(tmp_path), "--json"]) == 0
    files = [Path(name) for name in json.loads(capsys.readouterr().out)["files"]]
    assert all(path.is_file() for path in files)
    assert {path.parent for path in files} == {tmp_path, tmp_path / "grasps"}
    assert main(["init", "examples", "--out", str(tmp_path)]) == 0
    assert "4 logs" in capsys.readouterr().out
