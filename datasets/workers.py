"""Many independent pieces of work on local processes.

The processes are spawned, not forked: a fork copies locks that numerical libraries hold, and hangs.  So
the function must be importable (defined at the top of a module) and its items must pickle; only processes
that this one started read them.  Results come back in the order of the items, whatever the order of
finishing.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import TypeAlias, TypeVar

from thermogrip.datasets.errors import UserError

__all__ = ["Progress", "run_parallel", "sub_progress"]

Progress: TypeAlias = Callable[[float, str], None]

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def run_parallel(
    function: Callable[[_Item], _Result],
    items: Iterable[_Item],
    workers: int = 1,
    progress: Progress | None = None,
    *,
    what: str = "working",
) -> list[_Result]:
    """Return ``[function(item) for item in items]``, computed on so many processes.

    Parameters
    ----------
    function : callable
        Importable, of one item.  The first exception it raises stops the rest and is raised here.
    items : iterable
    workers : int, optional
        1 works in this process; more are never started than there are items or processors.
    progress : callable, optional
        Called with the fraction done and ``what``.
    what : str, optional
        What is being done, in words.

    Raises
    ------
    UserError
        If ``workers`` is below one, or a process was killed (usually for memory).

    Examples
    --------
    >>> run_parallel(abs, [-1, 2, -3])
    [1, 2, 3]
    """
    todo = list(items)
    if workers < 1:
        raise UserError(f"{workers} workers", mend="give at least one")
    n = min(workers, len(todo), os.cpu_count() or 1)
    if n <= 1:
        results = []
        for at, item in enumerate(todo):
            results.append(function(item))
            _tell(progress, (at + 1) / len(todo), what)
        return results
    return _on_processes(function, todo, n, progress, what)


def sub_progress(progress: Progress | None, start: float, stop: float) -> Progress | None:
    """Return the progress of a part that is start to stop of the whole.

    Examples
    --------
    >>> seen = []
    >>> part = sub_progress(lambda fraction, what: seen.append((fraction, what)), 0.5, 1.0)
    >>> part(0.5, "fit")
    >>> seen
    [(0.75, 'fit')]
    """
    if progress is None:
        return None
    return lambda fraction, what: progress(start + (stop - start) * fraction, what)


def _on_processes(
    function: Callable[[_Item], _Result], todo: list[_Item], n: int, progress: Progress | None, what: str
) -> list[_Result]:
    pool = ProcessPoolExecutor(n, mp_context=multiprocessing.get_context("spawn"))
    try:
        futures = [pool.submit(function, item) for item in todo]
        pending: set[Future[_Result]] = set(futures)
        while pending:
            done, pending = wait(pending, return_when=FIRST_COMPLETED)
            for future in done:
                future.result()
            _tell(progress, 1 - len(pending) / len(todo), what)
        return [future.result() for future in futures]
    except BrokenProcessPool as error:
        raise UserError("a worker process was killed", mend="lower --workers; memory may be short") from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _tell(progress: Progress | None, fraction: float, what: str) -> None:
    if progress is not None:
        progress(fraction, what)
