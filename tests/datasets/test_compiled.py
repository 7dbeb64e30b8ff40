"""Until when compiled code is used: while no kernel is another one."""

from __future__ import annotations

import ast
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from thermogrip.datasets import compiled, native_code
from thermogrip.datasets.compiled import KERNELS, Kernel, numba, sources_digest

ROOMS = Path(compiled.__file__).parents[1]
OWN = [
    path for room in ("datasets", "sysid", "mpc", "rig", "classify") for path in (ROOMS / room).rglob("*.py")
]


def imports_of(path: Path) -> dict[str, list[str]]:
    """Return what a module imports, by the module that it is from."""
    out: dict[str, list[str]] = {}
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            out.setdefault(str(node.module), []).extend(name.name for name in node.names)
        elif isinstance(node, ast.Import):
            out |= {name.name: [] for name in node.names}
    return out


def test_all_modules_with_kernels_count_and_take_nothing_from_others_that_do_not():
    taken = {path: imports_of(path).get("thermogrip.datasets.compiled", []) for path in OWN}
    assert {path for path, names in taken.items() if {"numba", "kernel"} & {*names}} == set(KERNELS)
    assert {path.name for path in OWN if "numba" in imports_of(path)} == {"compiled.py"}
    kernels = {"thermogrip." + ".".join(path.relative_to(ROOMS).with_suffix("").parts) for path in KERNELS}
    for path in KERNELS:
        of_ours = {name for name in imports_of(path) if name.startswith("thermogrip")}
        assert of_ours <= kernels | {"thermogrip.datasets.arrays", "thermogrip.datasets.compiled"}


SOURCE = """
from thermogrip.datasets.compiled import numba

@numba.njit(cache=True)
def twice(x):
    return {factor} * x
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A function that writes, counts as a kernel and imports a module."""
    paths = (tmp_path / "a.py", tmp_path / "b.py")
    monkeypatch.setattr(compiled, "KERNELS", paths)
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)

    def load(factor: int, other: str = "", name: str = "a"):
        sources_digest.cache_clear()
        paths[0].write_text(SOURCE.format(factor=factor))
        paths[1].write_text(other)
        path = tmp_path / f"{name}.py"
        if name not in ("a", "b"):
            path.write_text(SOURCE.format(factor=factor))
        space = {"__name__": "thermogrip_of_a_test", "__file__": str(path)}
        exec(compile(path.read_text(), str(path), "exec"), space)
        space["twice"](np.float64(1.0))
        return space["twice"]

    yield load
    sources_digest.cache_clear()


def test_code_is_kept_over_a_new_installation_and_compiled_anew_when_any_kernel_changes(module):
    assert sum(module(2).stats.cache_misses.values()) == 1
    again = module(2)  # the file is written again, as an installation does
    assert (sum(again.stats.cache_misses.values()), sum(again.stats.cache_hits.values())) == (0, 1)
    other = module(2, "changed = True")
    assert (sum(other.stats.cache_misses.values()), other(3.0)) == (1, 6.0)
    own = module(5, "changed = True")
    assert (sum(own.stats.cache_misses.values()), own(3.0)) == (1, 15.0)


def test_code_of_others_is_numbas_own_affair(module):
    stamp = module(2, name="c")._cache._impl.locator.get_source_stamp()
    assert stamp != sources_digest()
    assert len(stamp) == 2  # time and size of its file
    assert module(2)._cache._impl.locator.get_source_stamp() == sources_digest()
    assert numba.__name__ == "numba"


def test_code_is_kept_for_the_user_where_the_package_cannot_be_written(module, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    (tmp_path / "__pycache__").write_text("in the way")  # as of another user
    first = module(2)
    assert (tmp_path / "home") in Path(first.stats.cache_path).parents
    again = module(2)
    assert (sum(again.stats.cache_misses.values()), sum(again.stats.cache_hits.values())) == (0, 1)
    assert again._cache._impl.locator.get_source_stamp() == sources_digest()


KERNEL = """
import numpy as np
from thermogrip.datasets.compiled import kernel

@kernel(cache=True, error_model="numpy")
def scaled(x, by, y):
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            y[i, j] = {factor} * by * np.exp(x[i, j])
"""


@pytest.fixture
def made(tmp_path, monkeypatch):
    """A function that writes and imports a kernel as a program does that has not imported numba."""
    path = tmp_path / "k.py"
    monkeypatch.setattr(compiled, "KERNELS", (path,))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kept"))
    monkeypatch.setattr(native_code, "possible", lambda: True)

    def load(factor: float = 2.0, *, fresh: bool = True):
        sources_digest.cache_clear()
        before = path.stat() if path.exists() else None
        path.write_text(KERNEL.format(factor=factor))
        if before is not None:  # the file is the same for numba
            os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
        if fresh:
            monkeypatch.delitem(sys.modules, "numba", raising=False)
        space = {"__name__": "thermogrip_of_a_test", "__file__": str(path)}
        exec(compile(path.read_text(), str(path), "exec"), space)
        return space["scaled"]

    yield load
    sources_digest.cache_clear()


def ran(function, x, by=3.0):
    y = np.zeros(x.shape)
    function(x, by, y)
    return y


@pytest.mark.skipif(sys.platform != "linux", reason="needs POSIX and two processors")
def test_kept_code_runs_before_its_compiler_and_gives_the_same_bits(made, monkeypatch, tmp_path):
    x = np.arange(6.0).reshape(2, 3)
    first = ran(made(), x)
    np.testing.assert_allclose(first, 6.0 * np.exp(x), rtol=1e-14)
    (kept,) = (tmp_path / "kept").rglob("*.native")

    again = made()
    monkeypatch.setattr(Kernel, "_by_numba", None)
    np.testing.assert_array_equal(ran(again, x), first)
    np.testing.assert_array_equal(ran(again, x[:0]), first[:0])
    with pytest.raises(TypeError):  # other sources
        ran(made(5.0), x)
    kept.write_bytes(kept.read_bytes()[:-9] + b"123456789")  # a damaged file
    with pytest.raises(TypeError):
        ran(made(), x)


@pytest.mark.skipif(sys.platform != "linux", reason="needs POSIX and two processors")
def test_numba_takes_other_arrays_and_many_calls(made, monkeypatch):
    x = np.arange(6.0).reshape(2, 3)
    ran(made(), x)
    asked = []
    by_numba = Kernel._by_numba
    monkeypatch.setattr(Kernel, "_by_numba", lambda self, *args: (asked.append(1), by_numba(self, *args)))
    for other in (x.T, x.astype(np.float32), np.broadcast_to(x[:1], (2, 3))):
        np.testing.assert_allclose(ran(made(), other), 6.0 * np.exp(other), rtol=1e-6)
    assert len(asked) == 3
    monkeypatch.setattr(compiled, "_CALLS", 4)
    function = made()
    for _ in range(6):
        np.testing.assert_array_equal(ran(function, x), ran(made(), x))
    assert len(asked) == 4


@pytest.mark.skipif(sys.platform != "linux", reason="needs POSIX and two processors")
def test_code_is_kept_anew_when_another_kernel_changes(made, monkeypatch):
    """In the folder of NUMBA_CACHE_DIR too, where numba would go by the kernel's own file."""
    x = np.ones((2, 3))
    monkeypatch.setattr(numba.core.config, "CACHE_DIR", os.environ["NUMBA_CACHE_DIR"])
    ran(made(), x)
    monkeypatch.setattr(compiled, "sources_digest", lambda: "of a changed other one")
    ran(made(), x)
    monkeypatch.setattr(Kernel, "_by_numba", None)
    np.testing.assert_allclose(ran(made(), x), 6.0 * np.exp(x))


def test_a_program_that_has_imported_numba_calls_it_at_once(made, monkeypatch):
    ran(made(), np.ones((1, 1)))
    monkeypatch.setattr(native_code, "linked", None)
    assert ran(made(fresh=False), np.zeros((1, 1)))[0, 0] == 6.0
    assert made(fresh=False).py_func.__name__ == "scaled"


def test_code_is_kept_for_numba_as_it_comes_alone(monkeypatch):
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    assert not native_code.possible()


def test_code_is_kept_for_a_numba_that_was_tried_alone(monkeypatch):
    monkeypatch.setattr(native_code, "version", lambda name: "0.63.7")
    usual = native_code.possible()
    monkeypatch.setattr(native_code, "version", lambda name: "0.630.0")
    assert not native_code.possible()
    assert usual == (sys.platform == "linux")
