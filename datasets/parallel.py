"""Many independent pieces of work on local processes or on a Dask cluster.

Local processes are those of loky: each is a new interpreter, not a fork that would copy locks which numerical
libraries hold; they stay for the next call, for each takes seconds to import.  Only the user's own processes
unpickle functions and items: those that this one started, or those of the cluster that was named
(``tcp://HOST:PORT`` of its scheduler, extra ``cluster``), which does again what a killed worker had in hand.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures.process import BrokenProcessPool
from importlib import import_module
from importlib.util import find_spec
from typing import Any, TypeAlias, TypeVar
from warnings import catch_warnings, simplefilter

from thermogrip.datasets.errors import UserError, as_user_error

Progress: TypeAlias = Callable[[float, str], None]
#: Number of local processes, or the address of a Dask scheduler.
Workers: TypeAlias = int | str

_CONNECT_S = 10  # a scheduler of the same network answers within one
_IDLE_S = 60  # after which a local process ends: longer than between two calls of one command
_SAME_VERSIONS = ("thermogrip", "numba", "numpy", "scipy")  # on which the last bits of answers depend

#: Who sets one of these wants as many threads of linear algebra.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

_lock = threading.Lock()  # of the environment in which processes are started
_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def in_order(
    function: Callable[[_Item], _Result],
    items: Iterable[_Item],
    workers: Workers = 1,
    progress: Progress | None = None,
    *,
    what: str = "working",
) -> Iterator[_Result]:
    """Yield ``function(item)`` of each item in their order, computed on so many processes or on a cluster,
    each once it and those before it are there.

    The first exception that ``function`` raises stops the rest and is raised here.  A single item runs in
    this process; more processes are never started than there are processors.  ``progress`` is called with
    the fraction done and ``what``.
    """
    todo = list(items)
    for count, result in enumerate(_results(function, todo, check_workers(workers)), start=1):
        if progress is not None:
            progress(count / len(todo), what)
        yield result


def check_workers(workers: Workers) -> Workers:
    """Return the workers as they were given, or raise :class:`UserError` before any work is done."""
    if not isinstance(workers, str):
        if workers < 1:
            raise UserError(f"{workers} workers", hint="give at least one")
        return workers
    host, _, port = workers.removeprefix("tcp://").rpartition(":")
    if not workers.startswith("tcp://") or not host or not port.isdigit():
        raise UserError(f"cluster {workers!r} is no address of a scheduler", hint="write tcp://HOST:PORT")
    if find_spec("distributed") is None:
        raise UserError("a cluster needs the package distributed", hint='pip install "thermogrip[cluster]"')
    return workers


def sub_progress(progress: Progress | None, start: float, stop: float, name: str = "") -> Progress | None:
    """Return the progress of a part, under a name of its own, that is ``start`` to ``stop`` of the whole."""
    if progress is None:
        return None

    def show(fraction: float, what: str) -> None:
        text = ": ".join(piece for piece in (name, what) if piece)
        progress(start + (stop - start) * min(max(fraction, 0.0), 1.0), text)

    return show


def _results(function: Callable[[_Item], _Result], todo: list[_Item], workers: Workers) -> Iterator[_Result]:
    """Yield the result of each item; what has not begun is cancelled where the rest is not asked for."""
    if isinstance(workers, str) and todo:
        from distributed import KilledWorker

        problem = f"workers of {workers} are killed again and again"
        with as_user_error(KilledWorker, problem, hint="give them more memory"):
            yield from _client_of(workers).get_executor(pure=False).map(function, todo)
        return
    n = min(workers, os.cpu_count() or 1) if isinstance(workers, int) else 1
    if n == 1 or len(todo) < 2:
        yield from map(function, todo)
        return
    pool, hint = _processes(n), "lower --workers; memory may be short"
    try:
        with as_user_error(BrokenProcessPool, "a worker process was killed", hint=hint):
            yield from pool.map(function, todo)
    except KeyboardInterrupt:
        pool.shutdown(wait=True, kill_workers=True)
        raise


def _processes(n: int) -> Any:
    """Return the executor of n local processes, the one that there is unless it broke."""
    from loky import get_reusable_executor

    # several threads of linear algebra in each process would get in each other's way
    variables = {"PYTHONSAFEPATH": "1"} | {name: os.environ.get(name, "1") for name in THREADS}
    # a Ctrl-C is left to the process that started this one, and that ends it
    ignored = {"initializer": signal.signal, "initargs": (signal.SIGINT, signal.SIG_IGN)}
    with _lock:
        before = os.environ.get("PYTHONSAFEPATH")
        # modules are ours, not those of the folder that this process happens to run in: loky's own helper
        # process gets no other environment than this one
        os.environ["PYTHONSAFEPATH"] = "1"
        try:
            pool = get_reusable_executor(n, timeout=_IDLE_S, env=variables, **ignored)
            pool.submit(int)  # which starts them
        finally:
            del os.environ["PYTHONSAFEPATH"]
            if before is not None:
                os.environ["PYTHONSAFEPATH"] = before
    return pool


def _client_of(address: str) -> Any:
    """Return the client of a scheduler: the current one of the program where it is of that address."""
    distributed: Any = import_module("distributed")  # its functions have no types
    hint = "start one with 'dask scheduler', or check the address"
    lost = as_user_error((OSError, ValueError), f"no scheduler answers at {address}", hint=hint)
    with catch_warnings(), lost:
        # its own words about versions are a table; _check_cluster says it in one line
        simplefilter("ignore", distributed.versions.VersionMismatchWarning)
        client = distributed.get_client(address, timeout=_CONNECT_S)
    try:
        _check_cluster(client, address)
    except UserError:
        client.close()
        raise
    return client


def _check_cluster(client: Any, address: str) -> None:
    """Refuse a cluster without workers, or one that would run other code."""
    versions = client.get_versions(packages=_SAME_VERSIONS)
    if not versions["workers"]:
        raise UserError(f"the cluster at {address} has no workers", hint=f"run 'dask worker {address}'")
    ours = versions["client"]["packages"]
    for machine in (versions["scheduler"], *versions["workers"].values()):
        for name in _SAME_VERSIONS:
            if (theirs := machine["packages"][name]) != ours[name]:
                problem = f"a machine of {address} has {name} {theirs or 'missing'} for {ours[name]}"
                raise UserError(problem, hint="install the same versions on all of them")
