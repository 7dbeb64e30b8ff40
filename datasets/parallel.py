"""Many independent pieces of work on local processes or on a Dask cluster.

Local processes are those of loky, which comes with joblib: each is a new interpreter, not a fork that would
copy locks which numerical libraries hold; they stay for the next call, for each takes seconds to import.
Only the user's own processes unpickle functions and items: those that this one started or those of the
cluster that was named.  Results come back in the order of the items, whatever the order of finishing.  What
a killed process had in hand is done again, by another one.

A cluster (``tcp://HOST:PORT`` of its scheduler, extra ``cluster``) runs the same functions on the same items,
so it gives the same bits where its machines' arithmetic does; every worker needs the versions of thermogrip,
Python and the numerical packages that are here.  Workers may join at any time, and leave.
"""

from __future__ import annotations

import atexit
import operator
import os
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager, suppress
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from multiprocessing.reduction import ForkingPickler
from queue import SimpleQueue
from typing import Any, TypeAlias, TypeVar
from warnings import catch_warnings, simplefilter

from thermogrip import __version__
from thermogrip.datasets.errors import UserError, as_user_error

Progress: TypeAlias = Callable[[float, str], None]
#: How many local processes, or the address of a Dask scheduler.
Workers: TypeAlias = int | str

_CONNECT_S = 10
_IDLE_S = 60  # after which a local process ends
_DEATHS = 3  # of processes, without a result between them
_THREADS = 32  # of run_threads, which mostly wait

#: Who sets one of these wants as many threads of linear algebra.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

_clients: dict[str, Any] = {}  # by the address of a scheduler
_lock = threading.Lock()  # of these, and of the environment in which processes are started
#: In a thread of :func:`run_threads`: set once the others are no longer wanted.
_thread = threading.local()

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def run_parallel(
    function: Callable[[_Item], _Result],
    items: Iterable[_Item],
    workers: Workers = 1,
    progress: Progress | None = None,
    *,
    what: str = "working",
    elsewhere: bool = False,
) -> list[_Result]:
    """Return ``[function(item) for item in items]``, computed on so many processes or on a cluster.

    The first exception that ``function`` raises stops the rest and is raised here.  With one worker it runs
    in this process, and so does a single item unless it is to run ``elsewhere``; more processes are never
    started than there are processors.
    ``progress`` is called with the fraction done and ``what``. UserError if processes are killed again and
    again, or the cluster cannot be reached, has no workers, or has other versions.
    """
    todo = list(items)
    found: dict[int, _Result] = {}
    with closing(_done(function, todo, workers, elsewhere)) as done:
        for i, result in done:
            found[i] = result
            if progress is not None:
                progress(len(found) / len(todo), what)
    return [found[i] for i in range(len(todo))]


def run_threads(
    function: Callable[[_Item], _Result],
    items: Iterable[_Item],
    workers: Workers = 1,
    progress: Progress | None = None,
    *,
    what: str = "working",
) -> list[_Result]:
    """Return ``[function(item) for item in items]``, each in a thread of this process, for functions that
    call :func:`run_parallel` with these workers: what one waits for leaves them to the others.

    Arguments are those of :func:`run_parallel`; with one worker it is one item after the other. A fault ends
    the other threads when they next ask for work.
    """
    todo = list(items)
    if workers == 1 or len(todo) < 2:
        return run_parallel(function, todo, 1, progress, what=what)
    over = threading.Event()

    def begin() -> None:
        _thread.over = over

    found: dict[int, _Result] = {}
    with ThreadPoolExecutor(min(len(todo), _THREADS), initializer=begin) as threads:
        try:
            futures = {threads.submit(function, item): i for i, item in enumerate(todo)}
            for future in as_completed(futures):
                found[futures[future]] = future.result()
                if progress is not None:
                    progress(len(found) / len(todo), what)
        except BaseException:
            over.set()
            threads.shutdown(wait=False, cancel_futures=True)
            raise
    return [found[i] for i in range(len(todo))]


def in_order(
    function: Callable[[_Item], _Result], items: Iterable[_Item], workers: Workers = 1
) -> Iterator[_Result]:
    """Yield the results of :func:`run_parallel` in the order of the items, each once it and those before it
    are there."""
    waiting: dict[int, _Result] = {}
    at = 0
    with closing(_done(function, list(items), workers)) as done:
        for i, result in done:
            waiting[i] = result
            while at in waiting:
                yield waiting.pop(at)
                at += 1


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


def pack(value: Any) -> bytes:
    """Return a value as processes send it, smaller, for an item that many tasks have in common; what comes
    from a file or from anyone else is not to be unpacked."""
    import lzma  # which not every Python has

    return lzma.compress(bytes(ForkingPickler.dumps(value)), preset=1)


def unpack(packed: bytes) -> Any:
    """Return what :func:`pack` of a process that shares this work has packed."""
    import lzma

    return ForkingPickler.loads(lzma.decompress(packed))


def joint_progress(progress: Progress | None, shares: Sequence[float]) -> list[Progress | None]:
    """Return the progress of each of some parts of a whole that are done side by side, or in turn; ``shares``
    are theirs of the whole."""
    done = [0.0] * len(shares)

    def part(at: int) -> Progress | None:
        if progress is None:
            return None

        def show(fraction: float, what: str) -> None:
            done[at] = min(max(fraction, 0.0), 1.0)
            progress(sum(map(operator.mul, done, shares)), what)

        return show

    return [part(at) for at in range(len(shares))]


def _done(
    function: Callable[[_Item], _Result], todo: list[_Item], workers: Workers, elsewhere: bool = False
) -> Generator[tuple[int, _Result], None, None]:
    """Yield the place of each item and its result, in the order of finishing."""
    check_workers(workers)
    over = getattr(_thread, "over", None)
    if over is not None and over.is_set():
        raise CancelledError
    if isinstance(workers, str):
        if todo:
            yield from _on_cluster(function, todo, workers)
        return
    n = min(workers, os.cpu_count() or 1)
    if n == 1 or len(todo) + elsewhere < 2:
        yield from enumerate(map(function, todo))
    else:
        yield from _on_processes(function, todo, n)


def _on_processes(
    function: Callable[[_Item], _Result], todo: list[_Item], n: int
) -> Generator[tuple[int, _Result], None, None]:
    remaining, deaths, pool = dict(enumerate(todo)), 0, _processes(n)
    while remaining:
        futures: dict[Future[_Result], int] = {}
        try:
            futures |= {pool.submit(function, item): i for i, item in remaining.items()}
            for future in as_completed([*futures]):
                result = future.result()
                i = futures.pop(future)  # it holds the result, of which only the caller may need many
                del remaining[i], future
                deaths = 0
                yield i, result
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


def begin_processes(workers: Workers, modules: Sequence[str]) -> None:
    """Begin to import ``modules`` for local processes, beside what this one imports, or connect to a cluster.

    UserError if a cluster cannot be reached, has no workers, or has other versions.
    """
    check_workers(workers)
    if isinstance(workers, str):
        _client_of(workers)
        return
    n = min(workers, os.cpu_count() or 1)
    for _ in range(n if n > 1 else 0):
        _processes(n).submit(_import, modules)


def _import(modules: Sequence[str]) -> None:
    for name in modules:
        with suppress(ImportError):  # the work itself says it
            import_module(name)


def _processes(n: int) -> Any:
    """Return the executor of n local processes, the one that there is unless it broke."""
    from joblib.externals.loky import get_reusable_executor

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


class Replaced:
    """Processes that answer calls of an event loop as they come, or with one worker a thread; one that is
    killed is started again, and what it had in hand is asked again.

    Each is a pool of its own: a pool is lost as a whole where one of its processes dies.
    """

    def __init__(self, workers: int) -> None:
        n = min(workers, os.cpu_count() or 1)
        self._threads = ThreadPoolExecutor(n)  # each waits for one process
        self._idle: SimpleQueue[Any] = SimpleQueue()
        for _ in range(n if n > 1 else 0):
            self._idle.put(_process())
        self._alone = n == 1

    async def call(self, function: Callable[[_Item], _Result], item: _Item) -> _Result:
        """Return ``function(item)``; UserError if processes are killed again and again over it."""
        import asyncio  # which a program without an event loop has no need of

        loop = asyncio.get_running_loop()
        if self._alone:
            return await loop.run_in_executor(self._threads, function, item)
        result: _Result = await loop.run_in_executor(self._threads, self._elsewhere, function, item)
        return result

    def _elsewhere(self, function: Callable[[Any], Any], item: Any) -> Any:
        for _ in range(_DEATHS):
            process = self._idle.get()
            try:
                return process.submit(function, item).result()
            except BrokenProcessPool:
                process.shutdown(wait=True, kill_workers=True)
                process = _process()
            finally:
                self._idle.put(process)
        raise UserError("worker processes are killed again and again", hint="memory may be short")


def _process() -> Any:
    from joblib.externals.loky import ProcessPoolExecutor

    with _lock, _sound_environment() as environment:
        process = ProcessPoolExecutor(1, initializer=_ignore_interrupts, env=environment)
        process.submit(int)
    return process


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
    own = _versions()
    hint = f"install thermogrip {__version__} on all of them"
    with as_user_error(ModuleNotFoundError, f"a worker of {address} has no thermogrip", hint=hint):
        theirs = client.run(_versions).values()
    differ = {name: {there[name] for there in theirs} - {own[name]} for name in own}
    if any(differ.values()):
        words = [f"{name} {', '.join(sorted(differ[name]))} for {own[name]}" for name in own if differ[name]]
        problem = f"a worker of {address} has {'; '.join(words)}"
        raise UserError(problem, hint="install the same versions on all of them")


def _versions() -> dict[str, str]:
    """Return the versions on which the last bits of answers depend."""
    found = {name: version(name) for name in ("numba", "numpy", "scipy")}
    return {"thermogrip": __version__, "Python": f"{sys.version_info[0]}.{sys.version_info[1]}"} | found
