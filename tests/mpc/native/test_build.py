"""Libraries of C: built once for the same files, flags and machine, and used where nobody says no."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

import pytest

from thermogrip.mpc.native import build
from thermogrip.mpc.native.build import build_library, compiler, wanted

needs_gcc = pytest.mark.skipif(compiler() is None, reason="no gcc here")


@needs_gcc
def test_no_compiler_is_used_where_the_environment_forbids_it(monkeypatch):
    monkeypatch.setenv("THERMOGRIP_COMPILED", "0")
    assert not wanted()
    monkeypatch.delenv("THERMOGRIP_COMPILED")
    assert wanted()
    monkeypatch.setenv("PATH", "")
    assert not wanted()


@needs_gcc
def test_a_library_is_built_once(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    files = {"one.c": "int one(void);\nint one(void) { return 1; }\n"}
    path = build_library(files)
    built = os.stat(path).st_mtime_ns
    assert build_library(files) == path
    assert os.stat(path).st_mtime_ns == built
    other = build_library({"one.c": files["one.c"].replace("1;", "2;")})
    assert other != path
    with pytest.raises(RuntimeError, match="gcc refused"):
        build_library({"one.c": "int one(void) { return }"})
    assert sorted(tmp_path.joinpath("thermogrip").iterdir()) == sorted([path, other])  # nothing half-built


@needs_gcc
def test_a_library_is_another_where_compiler_flags_or_machine_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    files = {"one.c": "int one(void);\nint one(void) { return 1; }\n", "one.h": "\n"}
    first = build_library(files)
    assert first.parent == tmp_path / "thermogrip"
    seen = {first, build_library({"one.c": files["one.c"], "two.h": "\n"})}
    monkeypatch.setattr(build, "_machine", lambda gcc: "another")
    seen.add(build_library(files))
    monkeypatch.setattr(build, "_FLAGS", build._FLAGS[:1] + build._FLAGS[2:])
    seen.add(build_library(files))
    assert len(seen) == 4
    assert build_library(dict(reversed(files.items()))) in seen  # the order of the files says nothing


@needs_gcc
def test_a_nan_stays_one_in_a_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    source = "int lost(double x);\nint lost(double x) { return x != x; }\n"
    library = ctypes.CDLL(str(build_library({"lost.c": source})))
    library.lost.argtypes = [ctypes.c_double]
    assert [library.lost(x) for x in (0.0, float("inf"), float("nan"))] == [0, 0, 1]


def test_without_gcc_no_library_is_built(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PATH", "")
    with pytest.raises(RuntimeError, match="no gcc"):
        build_library({"one.c": "\n"})
