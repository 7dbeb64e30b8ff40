"""Until when compiled code is used: while no kernel is another one."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest

from thermogrip.datasets import compiled
from thermogrip.datasets.compiled import KERNELS, numba, sources_digest

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
    using = {path for path in OWN if "numba" in imports_of(path).get("thermogrip.datasets.compiled", [])}
    assert using == set(KERNELS)
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
