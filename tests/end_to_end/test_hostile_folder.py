"""A folder of somebody's data, as unpacked from an archive, in which every program and setting is a trap."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.end_to_end.conftest import Bench
from thermogrip.datasets.errors import UserError
from thermogrip.mpc.controllers.export import check_export, export_controller
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.native.code_cache import code_cache
from thermogrip.mpc.native.runtime import build_library, compiler
from thermogrip.sysid.plant.plant import Plant

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX: programs by their mode")
needs_gcc = pytest.mark.skipif(compiler() is None, reason="no gcc here")


@dataclass(frozen=True)
class Folder:
    """The folder, and how to see which of its traps went off."""

    path: Path
    programs: Path  # on the PATH: what settings can have started

    def python(self, code: str, *words: object) -> subprocess.CompletedProcess[str]:
        """Run Python code in the folder, as an installed script is run: without the folder on sys.path."""
        path = os.pathsep.join([str(self.programs), os.environ["PATH"]])
        command = [sys.executable, "-P", "-c", code, *map(str, words)]
        return subprocess.run(
            command,
            cwd=self.path,
            env=os.environ | {"PATH": path},
            capture_output=True,
            text=True,
            check=False,
        )

    def trap(self, path: Path) -> None:
        """Write a program that leaves its name."""
        path.write_text(f"#!/bin/sh\necho {path.name} >> {self.programs}/ran\nexit 1\n")
        path.chmod(0o755)

    @property
    def ran(self) -> str:
        """The names of what went off."""
        names = self.programs / "ran"
        return names.read_text() if names.exists() else ""


@pytest.fixture
def folder(bench: Bench, tmp_path_factory: pytest.TempPathFactory) -> Folder:
    return Folder(bench.path, tmp_path_factory.mktemp("programs"))


@pytest.mark.parametrize(
    "words",
    [
        "validate plant.json good.csv --report new.html",
        pytest.param(
            "identify good.csv --models arx --workers 2 --out new.json --report new.html",
            marks=pytest.mark.slow,  # three processes import everything
        ),
    ],
)
def test_neither_modules_nor_settings_of_the_working_folder_are_obeyed(words: str, folder: Folder) -> None:
    for name in ("json", "multiprocessing", "numpy", "sitecustomize", "thermogrip", "usercustomize"):
        code = f"with open({str(folder.programs / 'ran')!r}, 'a') as stream:\n    stream.write({name!r})\n"
        (folder.path / f"{name}.py").write_text(code)
    for name in ("latex", "dvipng"):
        folder.trap(folder.programs / name)
    (folder.path / "matplotlibrc").write_text("text.usetex: True\n")
    program = "import sys; from thermogrip.__main__ import main; sys.exit(main())"
    done = folder.python(program, *words.split())
    assert (folder.ran, done.returncode) == ("", 0), done.stderr
    assert (folder.path / "new.html").stat().st_size > 10_000


@pytest.mark.parametrize(
    "begin", ["", "from thermogrip.cli.main import main; main(['materials', 'copper']); "]
)
def test_the_working_folder_does_not_say_where_compiled_kernels_are_read_from(
    begin: str, folder: Folder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    (folder.path / ".numba_config.yaml").write_text("cache_dir: kernels\n")
    kernel = "from thermogrip.sysid.contact.time_stepping import step_contacts"
    done = folder.python(f"{begin}{kernel}; print(step_contacts.stats.cache_path)")
    assert done.returncode == 0, done.stderr
    assert "kernels" not in done.stdout.splitlines()[-1]


@needs_gcc
def test_a_check_of_an_export_runs_nothing_that_lay_in_its_folder(folder: Folder) -> None:
    controller = Controller(Plant.load(folder.path / "plant.json"))
    out = folder.path / "c99"
    export_controller(controller, out)
    for name in ("check", "sanitized"):
        folder.trap(out / name)
        os.utime(out / name, (4e9, 4e9))  # newer than all that it is built from
    (out / "GNUmakefile").write_text(f"all sanitized:\n\techo GNUmakefile >> {folder.programs}/ran\n")
    before = {path.name for path in out.iterdir()}
    found = check_export(export_controller(controller, out), controller, states=5)
    assert (folder.ran, found.same_status) == ("", 5)
    assert {path.name for path in out.iterdir()} == before


def test_a_relative_cache_folder_is_no_folder_of_the_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("XDG_CACHE_HOME", "cache")
    assert code_cache() == tmp_path / "home" / ".cache" / "thermogrip"


@needs_gcc
def test_a_library_that_others_could_have_written_is_built_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (tmp_path / "thermogrip").mkdir()
    (tmp_path / "thermogrip").chmod(0o777)
    files = {"one.c": "int one(void);\nint one(void) { return 1; }\n"}
    path = build_library(files)
    path.write_bytes(b"planted")
    path.chmod(0o666)
    assert build_library(files).read_bytes().startswith(b"\x7fELF")
    assert [oct(place.stat().st_mode & 0o777) for place in (path.parent, path)] == ["0o755", "0o755"]


def test_compiled_code_is_not_kept_in_a_folder_of_somebody_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(path: Path, mode: int) -> None:
        raise PermissionError(path)

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (tmp_path / "thermogrip").mkdir()
    (tmp_path / "thermogrip").chmod(0o777)
    monkeypatch.setattr(Path, "chmod", refused)
    with pytest.raises(UserError, match="belongs to somebody else"):
        code_cache()
