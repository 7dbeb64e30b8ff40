"""Numba, with compiled code that is kept while the sources of the kernels are the same.

Numba keeps compiled code beside a module until the module's file is written again: each installation would
compile all kernels anew, half a minute of work, and a kernel that calls a changed one of another module would
go on with the old one.  Here a digest of the sources of all kernels decides.
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path
from typing import Any

import numba as numba
from numba.core import caching

_ROOMS = Path(__file__).parents[1]
KERNELS = tuple(
    _ROOMS / name
    for name in (
        "classify/estimators/lstm_training.py",
        "sysid/blackbox/kalman_kernel.py",
        "sysid/contact/table_kernel.py",
        "sysid/contact/time_stepping.py",
        "sysid/effusivity/mode_kernel.py",
        "sysid/models/neural_kernel.py",
    )
)


@cache
def sources_digest() -> str:
    """Return the SHA-256 of the sources of all kernels."""
    return hashlib.sha256(b"\0".join(path.read_bytes() for path in KERNELS)).hexdigest()


class _BySources:
    """Until when the compiled code of a kernel may be used."""

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Any:
        if Path(py_file) not in KERNELS:
            return None
        return super().from_function(py_func, py_file)  # type: ignore[misc]

    def get_source_stamp(self) -> str:
        return sources_digest()


class _BesideModule(_BySources, caching.InTreeCacheLocator):  # type: ignore[misc]
    """Beside the kernel's module."""


class _OfUser(_BySources, caching.UserWideCacheLocator):  # type: ignore[misc]
    """In the user's cache folder, where that of the module cannot be written."""


# after the folder of NUMBA_CACHE_DIR
caching.CacheImpl._locator_classes[1:1] = [_BesideModule, _OfUser]
