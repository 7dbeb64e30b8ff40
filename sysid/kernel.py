"""The compiled face of :mod:`thermogrip.sysid.thermal_step`: the same functions through numba.

Importing this module imports numba, so :mod:`thermogrip.sysid.network` does it at the first rollout only.
The compiled code is kept on disk; it releases the interpreter lock, so a batch runs on all cores as plain
threads.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
from numba import njit
from numba.extending import register_jitable
from numpy.typing import NDArray

from thermogrip.sysid import thermal_step
from thermogrip.sysid.thermal_step import Layout

__all__ = ["rollout"]

Array = NDArray[np.float64]

# Fewer steps than this are done sooner than threads are started.
_WORTH_THREADS = 4000

for _function in ("coefficients", "conductances", "heat", "factor", "solve", "advance", "march"):
    register_jitable(getattr(thermal_step, _function))

# compiled from a function of that file, so that the code kept on disk is made anew whenever the file changes
_run = njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})(thermal_step.run_members)


def rollout(
    x0: Array, u: Array, d: Array, p: Array, h: float, renew: NDArray[np.bool_], layout: Layout
) -> tuple[Array, Array]:
    """Simulate a batch; shapes as in :class:`thermogrip.sysid.plant.Model`."""
    x, n_batch, n = x0.copy(), len(x0), u.shape[1]
    y = np.empty((n_batch, n + 1, len(layout.output)))
    workers = min(
        n_batch, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    if workers < 2 or n_batch * n < _WORTH_THREADS:
        _run(x, u, d, p, h, renew, layout, y, 0, n_batch)
        return y, x
    edges = np.linspace(0, n_batch, workers + 1).astype(int).tolist()
    with ThreadPoolExecutor(workers) as pool:
        jobs = [
            pool.submit(_run, x, u, d, p, h, renew, layout, y, begin, end) for begin, end in pairwise(edges)
        ]
        for job in jobs:
            job.result()
    return y, x
