"""Many independent pieces of work on local processes or on a Dask cluster.

Local processes are spawned, not forked: a fork copies locks that numerical libraries hold, and hangs.  So
the function must be importable (defined at the top of a module) and its items must pickle; only the user's
own processes read them, those that this one started or those of the cluster that was named.  Results come
back in the order of the items, whatever the order of finishing.

A cluster (``tcp://HOST:PORT`` of its scheduler, extra ``cluster``) runs the same functions on the same items,
so it gives the same bits where its machines' arithmetic does; every worker needs this version of thermogrip.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any, TypeAlias, TypeVar

from thermogrip import __version__
from thermogrip.datasets.errors import UserError, as_user_error

Progress: TypeAlias = Callable[[float, str], None]
#: How many local processes, or the address of a Dask scheduler.
Workers: TypeAlias = int | str

_CONNECT_S = 10

#: The processes that :func:`kept_processes` holds, if any.
_kept: list[ProcessPoolExecutor] = []

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def run_parallel(
    function: Callable[[_Item], _Result],
    items: Iterable[_Item],
    workers: Workers = 1,
    progress: Progress | None = None,
    *,
    what: str = "working",
) -> list[_Result]:
    """Return ``[function(item) for item in items]``, computed on so many processes or on a cluster.

    ``function`` must be importable; the first exception that it raises stops the rest and is raised here.
    With one worker it runs in this process; more are never started than there are items or processors.
    ``progress`` is called with the fraction done and ``what``. UserError if a process was killed, or the
    cluster cannot be reached, has no workers, or has another version of thermogrip.
    """
    todo = list(items)
    check_workers(workers)
    if isinstance(workers, str):
        return _on_cluster(function, todo, workers, progress, what) if todo else []
    n = min(workers, len(todo), os.cpu_count() or 1)
    if n <= 1:
        return _counted(map(function, todo), len(todo), progress, what)
    return _on_processes(function, todo, n, progress, what)


@contextmanager
def kept_processes(workers: Workers) -> Iterator[None]:
    """Let every :func:`run_parallel` of the block that shares its work out use the same local processes, for
    each takes seconds to import and to load compiled code."""
    n = 1 if isinstance(workers, str) else min(workers, os.cpu_count() or 1)
    if n == 1 or _kept:
        yield
        return
    _kept.append(_processes(n))
    try:
        yield
    finally:
        _kept.pop().shutdown(wait=True, cancel_futures=True)


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


def _on_processes(
    function: Callable[[_Item], _Result], todo: list[_Item], n: int, progress: Progress | None, what: str
) -> list[_Result]:
    kept = bool(_kept)
    pool = _kept[0] if kept else _processes(n)
    futures: list[Future[_Result]] = []
    try:
        futures += [pool.submit(function, item) for item in todo]
        _counted((future.result() for future in as_completed(futures)), len(todo), progress, what)
        return [future.result() for future in futures]
    except BrokenProcessPool as error:
        raise UserError("a worker process was killed", hint="lower --workers; memory may be short") from error
    finally:
        for future in futures:
            future.cancel()  # what has not begun
        if not kept:
            pool.shutdown(wait=True)


def _processes(n: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(n, mp_context=multiprocessing.get_context("spawn"))


def _on_cluster(
    function: Callable[[_Item], _Result],
    todo: list[_Item],
    address: str,
    progress: Progress | None,
    what: str,
) -> list[_Result]:
    import distributed

    dask: Any = distributed  # its functions have no types

    hint = "start one with 'dask scheduler', or check the address"
    with as_user_error((OSError, ValueError), f"no scheduler answers at {address}", hint=hint):
        client = dask.Client(address, timeout=_CONNECT_S, set_as_default=False)
    try:
        _check_cluster(client, address)
        futures = client.map(function, todo, pure=False)
        done = dask.as_completed(futures, loop=client.loop)
        _counted((future.result() for future in done), len(todo), progress, what)  # the first fault ends it
        return list(client.gather(futures))
    except dask.KilledWorker as error:
        raise UserError(f"a worker of {address} was killed", hint="give its workers more memory") from error
    finally:
        client.close()  # which lets go of what is not done


def _check_cluster(client: Any, address: str) -> None:
    """Refuse a cluster without workers, or one that would run other code."""
    if not client.scheduler_info()["workers"]:
        raise UserError(f"the cluster at {address} has no workers", hint=f"run 'dask worker {address}'")
    hint = f"install thermogrip {__version__} on all of them"
    with as_user_error(ModuleNotFoundError, f"a worker of {address} has no thermogrip", hint=hint):
        versions = set(client.run(_version).values())
    if versions != {__version__}:
        found = ", ".join(sorted(versions - {__version__}))
        raise UserError(f"a worker of {address} has thermogrip {found}", hint=hint)


def _version() -> str:
    return __version__


def _counted(results: Iterable[_Result], n: int, progress: Progress | None, what: str) -> list[_Result]:
    """Return the n results, and report the progress with each."""
    found: list[_Result] = []
    for result in results:
        found.append(result)
        if progress is not None:
            progress(len(found) / n, what)
    return found
