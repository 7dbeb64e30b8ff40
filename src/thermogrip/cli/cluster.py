"""What a Dask worker does before it takes work: ``dask worker ADDRESS --preload thermogrip.cli.cluster``."""

from __future__ import annotations

import gc
from importlib import import_module
from typing import Any

from thermogrip.cli import classify, compare

#: What the verbs that share their work out compute with.
MODULES = (
    *classify.NEEDED,
    *compare.NEEDED,
    "thermogrip.sysid.identification",
)


def dask_setup(worker: Any) -> None:
    """Import what tasks need, which the first of them would wait for, and leave out what slows Python on a
    worker: Dask's profiler, and searches of what was imported for garbage."""
    for name in MODULES:
        import_module(name)
    for name in ("profile", "profile-cycle"):
        worker.periodic_callbacks.pop(name, None)
    gc.collect()
    gc.freeze()
