"""Many independent pieces of work on local processes or on a Dask cluster.

Local processes are those of loky: each is a new interpreter, not a fork that would copy locks which numerical
libraries hold; they stay for the next call, for each takes seconds to import.  Only the user's own processes
unpickle functions and items: those that this one started, or those of the cluster that was named
(``tcp://HOST:PORT`` of its scheduler, extra ``cluster``).  What a killed process had in hand is done again.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from importlib.metadata import version
from importlib.util import find_spec
from typing import Any, TypeAlias, TypeVar
from warnings import catch_warnings, simplefilter

from thermogrip import __version__
from thermogrip.datasets.errors import UserError, as_user_error

Progress: TypeAlias = Callable[[float, str], None]
#: Number of local processes, or the address of a Dask scheduler.
Workers: TypeAlias = int | str

_CONNECT_S = 10  # a scheduler of the same network answers within one
_IDLE_S = 60  # after which a local process ends: longer than between two calls of one command
_DEATHS = 3  # of processes without a result between them: one or two may be chance, three are the work's

#: Who sets one of these wants as many threads of linear algebra.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

_clients: dict[str, Any] = {}  # by the address of a scheduler
_lock = threading.Lock()  # of these, and of the environment in which processes are started
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

    The first exception that ``function`` raises stops the rest and is raised here.  A single item runs in
    this process; more processes are never started than there are processors.  ``progress`` is called with
    the fraction done and ``what``.
    """
    return list(in_order(function, items, workers, progress, what=what))


def in_order(
    function: Callable[[_Item], _Result],
    items: Iterable[_Item],
    workers: Workers = 1,
    progress: Progress | None = None,
    *,
    what: str = "working",
) -> Iterator[_Result]:
    """Yield the results of :func:`run_parallel` in the order of the items, each once it and those before it
    are there."""
    todo = list(items)
    waiting: dict[int, _Result] = {}
    following = 0
    with closing(_done(function, todo, workers)) as done:
        for count, (place, result) in enumerate(done, start=1):
            waiting[place] = result
            if progress is not None:
                progress(count / len(todo), what)
            while following in waiting:
                yield waiting.pop(following)
                following += 1


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


def _done(
    function: Callable[[_Item], _Result], todo: list[_Item], workers: Workers
) -> Generator[tuple[int, _Result], None, None]:
    """Yield the place of each item and its result, in the order of finishing."""
    check_workers(workers)
    if isinstance(workers, str):
        if todo:
            yield from _on_cluster(function, todo, workers)
        return
    n = min(workers, os.cpu_count() or 1)
    if n == 1 or len(todo) < 2:
        yield from enumerate(map(function, todo))
    else:
        yield from _on_processes(function, todo, n)


def _on_processes(
    function: Callable[[_Item], _Result], todo: list[_Item], n: int
) -> Generator[tuple[int, _Result], None, None]:
    remaining, pool = dict(enumerate(todo)), _processes(n)
    deaths = 0
    while remaining:
        futures: dict[Future[_Result], int] = {}
        try:
            futures |= {pool.submit(function, item): i for i, item in remaining.items()}
            for future in as_completed([*futures]):
                result = future.result()
                place = futures.pop(future)  # it holds the result, of which only the caller may need many
                del remaining[place], future
                deaths = 0
                yield place, result
        except BrokenProcessPool as error:  # all of the pool is lost
            deaths += 1
            if deaths > _DEATHS:
                raise UserError(
                    "worker processes are killed again and again", hint="lower --workers; memory may be short"
                ) from error
            pool = _processes(n)
        except KeyboardInterrupt:
            pool.shutdown(wait=True, kill_workers=True)
            raise
        finally:
            for future in futures:
                future.cancel()  # what has not begun


def _processes(n: int) -> Any:
    """Return the executor of n local processes, the one that there is unless it broke."""
    from loky import get_reusable_executor

    with _lock, _sound_environment() as environment:
        settings: dict[str, Any] = {"timeout": _IDLE_S, "initializer": _ignore_interrupts, "env": environment}
        pool = get_reusable_executor(n, **settings)
        pool.submit(int)  # which starts them
    return pool


@contextmanager
def _sound_environment() -> Iterator[dict[str, str]]:
    """Start processes whose modules are ours, not those of the folder that this one happens to run in, and
    yield the variables that they keep: several threads each would get in each other's way."""
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield {"PYTHONSAFEPATH": "1"} | {name: os.environ.get(name, "1") for name in THREADS}
    finally:
        del os.environ["PYTHONSAFEPATH"]
        if before is not None:
            os.environ["PYTHONSAFEPATH"] = before


def _ignore_interrupts() -> None:
    """Leave a Ctrl-C to the process that started this one, and that ends it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _on_cluster(
    function: Callable[[_Item], _Result], todo: list[_Item], address: str
) -> Generator[tuple[int, _Result], None, None]:
    import distributed

    dask: Any = distributed  # its functions have no types
    client = _client_of(address)
    # as bytes: the scheduler would import what they need, and unpack and pack them, before a worker may begin
    packed = [dask.protocol.pickle.dumps((function, item)) for item in todo]
    futures = {future: i for i, future in enumerate(client.map(_on_worker, packed, pure=False))}
    try:
        for future in dask.as_completed([*futures], loop=client.loop):
            result = dask.protocol.pickle.loads(future.result())  # the first fault ends it
            yield futures.pop(future), result
    except dask.KilledWorker as error:
        problem = f"workers of {address} are killed again and again"
        raise UserError(problem, hint="give them more memory") from error
    finally:
        client.cancel([*futures])


def _client_of(address: str) -> Any:
    """Return the client of a scheduler, the same one until the program ends."""
    with _lock:
        if address not in _clients or _clients[address].status != "running":
            _clients[address] = _connected(address)
            atexit.register(_clients[address].close)
        return _clients[address]


def _connected(address: str) -> Any:
    """Return a client of a scheduler whose workers run this code."""
    import distributed

    dask: Any = distributed  # its functions have no types
    hint = "start one with 'dask scheduler', or check the address"
    # its own words about versions are a table; _check_cluster says it in one line
    lost = as_user_error((OSError, ValueError), f"no scheduler answers at {address}", hint=hint)
    with catch_warnings(), lost:
        simplefilter("ignore", dask.versions.VersionMismatchWarning)
        client = dask.Client(address, timeout=_CONNECT_S, set_as_default=False)
    try:
        _check_cluster(client, address)
    except BaseException:
        client.close()
        raise
    return client


def _on_worker(packed: bytes) -> bytes:
    """Return what a function returns for an item, packed as they came."""
    from distributed import protocol

    pickle: Any = protocol.pickle  # its functions have no types
    function, item = pickle.loads(packed)
    return bytes(pickle.dumps(function(item)))


def _check_cluster(client: Any, address: str) -> None:
    """Refuse a cluster without workers, or one that would run other code."""
    if not client.scheduler_info()["workers"]:
        raise UserError(f"the cluster at {address} has no workers", hint=f"run 'dask worker {address}'")
    ours = _versions()
    hint = f"install thermogrip {__version__} on all of them"
    with as_user_error(ModuleNotFoundError, f"a worker of {address} has no thermogrip", hint=hint):
        theirs = client.run(_versions).values()
    others = {
        name: sorted({versions[name] for versions in theirs} - {our_version})
        for name, our_version in ours.items()
    }
    if differ := [f"{name} {', '.join(those)} for {ours[name]}" for name, those in others.items() if those]:
        problem = f"a worker of {address} has {'; '.join(differ)}"
        raise UserError(problem, hint="install the same versions on all of them")


def _versions() -> dict[str, str]:
    """Return the versions on which the last bits of answers depend."""
    packages = {name: version(name) for name in ("numba", "numpy", "scipy")}
    return {"thermogrip": __version__, "Python": f"{sys.version_info[0]}.{sys.version_info[1]}"} | packages
