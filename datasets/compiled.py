"""Kernels: functions that Numba compiles, with code that is kept while the sources of all are the same.

Numba keeps compiled code beside a module until the module's file is written again: each installation would
compile all kernels anew, and a kernel that calls a changed one of another module would
go on with the old one.  Here a digest of the sources of all kernels decides.

A :func:`kernel` is called without Numba at first, where its code was kept
(:mod:`thermogrip.datasets.native_code`): a program that answers one grasp ends before Numba would have been
imported.  One that goes on calling it is given Numba's own function, whose calls are quicker.
"""

from __future__ import annotations

import gc
import hashlib
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, cached_property, update_wrapper
from pathlib import Path
from typing import Any

_ROOMS = Path(__file__).parents[1]
KERNELS = tuple(
    _ROOMS / name
    for name in (
        "sysid/blackbox/kalman_kernel.py",
        "sysid/contact/time_stepping.py",
        "sysid/effusivity/mode_kernel.py",
        "sysid/models/neural_kernel.py",
    )
)


@cache
def sources_digest() -> str:
    """Return the SHA-256 of the sources of all kernels, and of how their code is kept."""
    return hashlib.sha256(b"\0".join([b"2", *(path.read_bytes() for path in KERNELS)])).hexdigest()


_CALLS = 1000  # of a kernel's kept code, until numba is worth its import


class Kernel:
    """A compiled function; all else that is asked of it is that of numba's function."""

    def __init__(self, function: Callable[..., None], options: dict[str, Any]) -> None:
        update_wrapper(self, function)
        self.py_func, self._options, self._left = function, options, _CALLS
        self._run: Callable[..., Any] = self._begin

    def __call__(self, *args: Any) -> None:
        self._run(*args)

    @cached_property
    def dispatcher(self) -> Any:
        """Return numba's function."""
        return _numba().njit(**self._options)(self.py_func)

    @property
    def _source(self) -> Path:
        return Path(self.py_func.__code__.co_filename)

    @property
    def _file(self) -> str:
        return f"{self._source.stem}.{self.py_func.__name__}.native"

    def _begin(self, *args: Any) -> None:
        """Find out by whom to be run, and run."""
        if "numba" not in sys.modules:
            from thermogrip.datasets import native_code

            if native_code.possible():
                code = native_code.linked(self._file, self._source, sources_digest())
                if code is not None:
                    self._native, self._run = code, self._natively
                    self._natively(*args)
                    return
        self._by_numba(*args)

    def _natively(self, *args: Any) -> None:
        self._left -= 1
        if self._left < 0 or not self._native(*args):
            self._by_numba(*args)

    def _by_numba(self, *args: Any) -> None:
        """Run numba's function from now on; what it compiles at once is kept."""
        self._run = run = self.dispatcher
        with _no_collection():
            run(*args)
        stats = getattr(run, "stats", None)  # which a plain function has not (NUMBA_DISABLE_JIT)
        if stats is not None and sum(stats.cache_misses.values()) == 1 == len(run.overloads):
            from thermogrip.datasets import native_code

            if native_code.possible():
                (compiled,) = run.overloads.values()
                native_code.keep(compiled, self._file, self._source, sources_digest())

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.dispatcher, name)


@contextmanager
def _no_collection() -> Iterator[None]:
    """Let no garbage be looked for, which a compiler makes little of: that takes a sixth of its time."""
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()


def kernel(**options: Any) -> Callable[[Callable[..., None]], Kernel]:
    """Return a decorator as ``numba.njit(**options)`` of functions that return nothing."""
    return lambda function: Kernel(function, options)


def __getattr__(name: str) -> Any:  # PEP 562: numba is imported when it is needed
    if name != "numba":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return _numba()


@cache
def _numba() -> Any:
    """Return numba, which keeps code as said above."""
    os.environ.setdefault("NUMBA_CACHE_DIR", "")  # else .numba_config.yaml of the working folder may name one
    import numba
    from numba.core import caching

    class BySources:
        """Until when the compiled code of a kernel may be used."""

        @classmethod
        def from_function(cls, py_func: Any, py_file: str) -> Any:
            if Path(py_file) not in KERNELS:
                return None
            return super().from_function(py_func, py_file)  # type: ignore[misc]

        def get_source_stamp(self) -> str:
            return sources_digest()

    class InSetFolder(BySources, caching.UserProvidedCacheLocator):  # type: ignore[misc]
        """In the folder of NUMBA_CACHE_DIR, where that is set."""

    class BesideModule(BySources, caching.InTreeCacheLocator):  # type: ignore[misc]
        """Beside the kernel's module."""

    class OfUser(BySources, caching.UserWideCacheLocator):  # type: ignore[misc]
        """In the user's cache folder, where that of the module cannot be written."""

    caching.CacheImpl._locator_classes[:0] = [InSetFolder, BesideModule, OfUser]
    return numba
