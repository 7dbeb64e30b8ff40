"""Many independent pieces of work on local processes or on a Dask cluster.

Local processes are not forked from this one: a fork copies locks that numerical libraries hold, and hangs.
They are spawned, on Linux forked from a server that was spawned and has only imported, once for all.  So
the function must be importable (defined at the top of a module) and its items must pickle; only the user's
own processes read them, those that this one started or those of the cluster that was named.  Results come
back in the order of the items, whatever the order of finishing.  What a killed process had in hand is done
again, by another one.

A cluster (``tcp://HOST:PORT`` of its scheduler, extra ``cluster``) runs the same functions on the same items,
so it gives the same bits where its machines' arithmetic does; every worker needs the versions of thermogrip,
Python and the numerical packages that are here.  Workers may join at any time, and leave.
"""

from __future__ import annotations

import atexit
import ctypes
import multiprocessing
import operator
import os
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import (
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    as_completed,
)
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager, suppress
from functools import cache, partial
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from multiprocessing.reduction import ForkingPickler
from queue import Empty, SimpleQueue
from typing import Any, TypeAlias, TypeVar
from warnings import catch_warnings, simplefilter

from thermogrip import __version__
from thermogrip.datasets.errors import UserError, as_user_error

Progress: TypeAlias = Callable[[float, str], None]
#: How many local processes, or the address of a Dask scheduler.
Workers: TypeAlias = int | str

_CONNECT_S = 10
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of malloc.h
_SWITCH_S = 5e-4
_DEATHS = 3  # of processes, without a result between them
_LOOK_S = 1.0  # without a result: then it is looked whether the processes are alive

_SENT = 16  # items to a cluster at once: it has work while the others are packed
_THREADS = 32  # of run_threads, which mostly wait

#: Who sets one of these wants as many threads of linear algebra.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

#: The processes that :func:`kept_processes` holds, if any, and its connections to schedulers by address.
_kept: list[ProcessPoolExecutor] = []
_kept_size: list[int] = []
_clients: dict[str, Any] = {}
_keeping: list[str] = []
_lock = threading.Lock()  # of these
_importing: list[threading.Thread] = []  # on a worker of a cluster
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

    ``function`` must be importable; the first exception that it raises stops the rest and is raised here.
    With one worker it runs in this process, and so does a single item unless it is to run ``elsewhere``;
    more are never started than there are items or processors.
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


@contextmanager
def kept_processes(workers: Workers) -> Iterator[None]:
    """Let every :func:`run_parallel` of the block that shares its work out use the same local processes, for
    each takes seconds to import and to load compiled code, or the same connection to a scheduler."""
    if isinstance(workers, str):
        with _kept_client(workers):
            yield
        return
    n = min(workers, os.cpu_count() or 1)
    if n == 1 or _kept:
        yield
        return
    _kept.append(_processes(n))
    _kept_size.append(n)
    try:
        yield
    finally:
        _kept_size.pop()
        _kept.pop().shutdown(wait=True, cancel_futures=True)


@contextmanager
def _kept_client(address: str) -> Iterator[None]:
    if address in _keeping:
        yield
        return
    _keeping.append(address)
    try:
        yield
    finally:
        _keeping.remove(address)
        client = _clients.pop(address, None)
        if client is not None:
            client.close()


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
    n = min(workers, len(todo), os.cpu_count() or 1)
    if n < 1 or (n == 1 and not (elsewhere and _kept)):
        yield from enumerate(map(function, todo))
    else:
        yield from _on_processes(function, todo, n)


def _on_processes(
    function: Callable[[_Item], _Result], todo: list[_Item], n: int
) -> Generator[tuple[int, _Result], None, None]:
    left, deaths = dict(enumerate(todo)), 0
    while left:
        kept = bool(_kept)
        pool = _kept[0] if kept else _processes(n)
        futures: dict[Future[_Result], int] = {}
        try:
            futures |= {pool.submit(function, item): i for i, item in left.items()}
            for future in _completed(pool, futures):
                result = future.result()
                i = futures.pop(future)  # it holds the result, of which only the caller may need many
                del left[i]
                deaths = 0
                yield i, result
        except BrokenProcessPool as error:  # all of the pool is lost
            deaths += 1
            if deaths > _DEATHS:
                raise UserError(
                    "worker processes are killed again and again", hint="lower --workers; memory may be short"
                ) from error
            with _lock:
                if kept and pool is _kept[0]:  # the first thread that sees it
                    _ended(pool, broken=True)
                    _kept[0] = _processes(_kept_size[0])
        finally:
            for future in futures:
                future.cancel()  # what has not begun
            if not kept:
                _ended(pool, broken=deaths > 0)


def _completed(pool: Executor, futures: Iterable[Future[_Result]]) -> Iterator[Future[_Result]]:
    """Yield futures as they complete; BrokenProcessPool where the pool broke and left one without an answer.

    CPython answers what a pool that breaks has in hand by a loop over a dictionary, and the thread that does
    so ends with an exception if an item is submitted meanwhile (3.11, ``terminate_broken``).
    """
    done: SimpleQueue[Future[_Result]] = SimpleQueue()
    left = 0
    for future in futures:
        future.add_done_callback(done.put)
        left += 1
    del future  # it would hold the last result
    while left:
        try:
            yield done.get(timeout=_LOOK_S)
            left -= 1
        except Empty:
            pool.submit(int)  # which a broken pool refuses; cancelled, it would end that thread as well


def _ended(pool: Executor, *, broken: bool) -> None:
    """End a pool, and the processes that one that broke may have left waiting for work."""
    processes = [*(getattr(pool, "_processes", None) or {}).values()] if broken else []
    pool.shutdown(wait=True)
    for process in processes:
        process.terminate()


def begin_processes(workers: Workers, modules: Sequence[str]) -> None:
    """Begin to import ``modules`` for local processes, or on a cluster, beside what this one imports.

    UserError if a cluster cannot be reached, has no workers, or has other versions.
    """
    check_workers(workers)
    if isinstance(workers, str):
        with _lock:
            if workers not in _clients:
                _clients[workers] = _connected(workers, modules)
    elif sys.platform == "linux" and min(workers, os.cpu_count() or 1) > 1:
        _serving(modules)


def _serving(modules: Sequence[str]) -> None:
    """Start the server that processes are forked from, if there is none, with these modules."""
    from multiprocessing import forkserver, resource_tracker  # Windows may have neither

    multiprocessing.set_forkserver_preload(list(modules))
    asked = {"PYTHONSAFEPATH": "1"}  # modules are ours, not those of the folder it happens to run in
    # processes of several threads each get in each other's way
    asked |= dict.fromkeys((name for name in THREADS if name not in os.environ), "1")
    kept = {name: os.environ[name] for name in asked if name in os.environ}
    os.environ |= asked
    resource_tracker.ensure_running()  # which leaves SIGINT unblocked
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])  # a Ctrl-C is for its processes
    try:
        forkserver.ensure_running()
        atexit.unregister(_end_server)
        atexit.register(_end_server, forkserver)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for name in asked:
            del os.environ[name]
        os.environ |= kept


def _end_server(forkserver: Any) -> None:
    """End the server with the program: it would first import all that it began with, and who waits for the
    end of stderr would wait for it."""
    pid = getattr(forkserver._forkserver, "_forkserver_pid", None)
    if pid is not None:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGTERM)


def _context() -> tuple[Any, Callable[[], None] | None]:
    """Return how processes are started, and what each does first."""
    if sys.platform != "linux":  # macOS has libraries that fail after any fork
        os.environ.setdefault("PYTHONSAFEPATH", "1")  # as in _serving
        return multiprocessing.get_context("spawn"), None
    _serving(sorted(name for name in sys.modules if name.startswith("thermogrip.")))
    ends = signal.getsignal(signal.SIGINT) is not signal.SIG_IGN  # by Ctrl-C: not under nohup
    return multiprocessing.get_context("forkserver"), _unblocked if ends else None


def _processes(n: int) -> ProcessPoolExecutor:
    context, unblocked = _context()
    pool = ProcessPoolExecutor(n, mp_context=context, initializer=unblocked)
    # All at once, as where processes are forked: one that is started as the pool breaks is waited for without
    # end, or it finds the pool's pipes closed, and submit() raises OSError or ValueError.
    setattr(pool, "_safe_to_dynamically_spawn_children", False)  # noqa: B010  typeshed has no such name
    return pool


def _unblocked() -> None:
    """Let Ctrl-C end what a process does, which the server has blocked; one from before is forgotten."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
    signal.signal(signal.SIGINT, signal.default_int_handler)


class Replaced:
    """Processes that answer calls of an event loop as they come, or with one worker a thread; one that is
    killed is started again, and what it had in hand is asked again.

    Each has a pipe of its own, whose end says that it died.  A pool of processes is lost as a whole where one
    dies, and a call that comes while it breaks may wait without end (``terminate_broken`` of CPython 3.11).
    """

    def __init__(self, workers: int) -> None:
        n = min(workers, os.cpu_count() or 1)
        self._threads = ThreadPoolExecutor(n)  # each waits for one process
        self._idle: SimpleQueue[tuple[Any, Any]] = SimpleQueue()
        for _ in range(n if n > 1 else 0):
            self._idle.put(_started())
        self._ask = self._elsewhere if n > 1 else _called

    async def call(self, function: Callable[[_Item], _Result], item: _Item) -> _Result:
        """Return ``function(item)``; UserError if processes are killed again and again over it."""
        import asyncio  # which a program without an event loop has no need of

        loop = asyncio.get_running_loop()
        error, result = await loop.run_in_executor(self._threads, self._ask, function, item)
        if error is not None:
            raise error
        return result  # type: ignore[no-any-return]

    def _elsewhere(self, function: Callable[[Any], Any], item: Any) -> tuple[Exception | None, Any]:
        for _ in range(_DEATHS):
            process, pipe = self._idle.get()
            try:
                pipe.send((function, item))
                answer: tuple[Exception | None, Any] = pipe.recv()
            except (EOFError, OSError):  # it was killed
                pipe.close()
                process.join()
                process, pipe = _started()
            else:
                return answer
            finally:
                self._idle.put((process, pipe))
        raise UserError("worker processes are killed again and again", hint="memory may be short")


def _started() -> tuple[Any, Any]:
    """Start a process that answers calls, and return it with the pipe to it."""
    context, unblocked = _context()
    pipe, theirs = context.Pipe()
    process = context.Process(target=_answer_calls, args=(theirs, unblocked), daemon=True)
    process.start()
    theirs.close()  # so that nothing but the process holds its end
    return process, pipe


def _answer_calls(pipe: Any, unblocked: Callable[[], None] | None) -> None:
    """Answer calls until the pipe ends, which it does with the program."""
    if unblocked is not None:
        unblocked()
    with suppress(EOFError, KeyboardInterrupt):
        while True:
            pipe.send(_called(*pipe.recv()))


def _called(function: Callable[[Any], Any], item: Any) -> tuple[Exception | None, Any]:
    """Return what a function raises, or returns."""
    try:
        return None, function(item)
    except Exception as error:  # for who called
        return error, None


def _on_cluster(
    function: Callable[[_Item], _Result], todo: list[_Item], address: str
) -> Generator[tuple[int, _Result], None, None]:
    import distributed

    dask: Any = distributed  # its functions have no types
    with _lock:
        kept = address in _keeping
        client = _clients.get(address) or _connected(address)
        if kept:
            _clients[address] = client
        else:  # one that was begun is taken over
            _clients.pop(address, None)
    futures: dict[Any, int] = {}
    try:
        # As bytes: the scheduler would import what they need, and unpack and pack them, before a worker may
        # begin; a thousandth of a second each.
        for at in range(0, len(todo), _SENT):
            packed = [dask.protocol.pickle.dumps((function, item)) for item in todo[at : at + _SENT]]
            futures |= {future: at + i for i, future in enumerate(client.map(_on_worker, packed, pure=False))}
        for future in dask.as_completed(futures, loop=client.loop):
            result = dask.protocol.pickle.loads(future.result())  # the first fault ends it
            yield futures.pop(future), result
    except dask.KilledWorker as error:
        problem = f"workers of {address} are killed again and again"
        raise UserError(problem, hint="give them more memory") from error
    finally:
        if kept:
            client.cancel(list(futures))
        else:
            client.close()  # which lets go of what is not done


def _connected(address: str, modules: Sequence[str] = ()) -> Any:
    """Return a client of a scheduler whose workers run this code, and begin to import ``modules``."""
    import distributed

    dask: Any = distributed  # its functions have no types
    hint = "start one with 'dask scheduler', or check the address"
    # its own words about versions are a table; _check_cluster says it in one line
    lost = as_user_error((OSError, ValueError), f"no scheduler answers at {address}", hint=hint)
    with catch_warnings(), lost:
        simplefilter("ignore", dask.versions.VersionMismatchWarning)
        client = dask.Client(address, timeout=_CONNECT_S, set_as_default=False)
    try:
        _check_cluster(client, address, modules)
    except BaseException:
        client.close()
        raise
    return client


def _on_worker(packed: bytes) -> bytes:
    """Return what a function returns for an item, packed as they came."""
    from distributed import protocol

    pickle: Any = protocol.pickle  # its functions have no types
    _keep_memory()
    # what computes lets the thread that talks to others go on: a result waits for it some five times
    sys.setswitchinterval(_SWITCH_S)
    for thread in _importing:  # else two threads import modules that import each other
        thread.join()
    function, item = pickle.loads(packed)
    return bytes(pickle.dumps(function(item)))


@cache
def _keep_memory() -> None:
    """Have glibc keep up to 256 MB of free memory, and take arrays of less than 32 MB from it.

    Dask's nanny has the C library give back what is freed at once (MALLOC_TRIM_THRESHOLD_), and arrays of
    some 100 kB, freed and wanted again a thousand times a second, then cost more than what is computed.
    """
    if sys.platform == "linux" and (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        mallopt(_TRIM_THRESHOLD, 256 << 20)
        mallopt(_MMAP_THRESHOLD, 32 << 20)


def _check_cluster(client: Any, address: str, modules: Sequence[str] = ()) -> None:
    """Refuse a cluster without workers, or one that would run other code; the others begin to import
    ``modules``."""
    if not client.scheduler_info()["workers"]:
        raise UserError(f"the cluster at {address} has no workers", hint=f"run 'dask worker {address}'")
    own = _versions()
    hint = f"install thermogrip {__version__} on all of them"
    with as_user_error(ModuleNotFoundError, f"a worker of {address} has no thermogrip", hint=hint):
        theirs = client.run(partial(_greeted, modules)).values()
    differ = {name: {there[name] for there in theirs} - {own[name]} for name in own}
    if any(differ.values()):
        words = [f"{name} {', '.join(sorted(differ[name]))} for {own[name]}" for name in own if differ[name]]
        problem = f"a worker of {address} has {'; '.join(words)}"
        raise UserError(problem, hint="install the same versions on all of them")


def _greeted(modules: Sequence[str]) -> dict[str, str]:
    """Return the versions of this worker, which begins to import ``modules`` in a thread."""
    if modules:
        thread = threading.Thread(target=_imported, args=(modules,), daemon=True)
        thread.start()
        _importing.append(thread)
    return _versions()


def _imported(modules: Sequence[str]) -> None:
    for name in modules:
        with suppress(ImportError):  # a task says it
            import_module(name)


def _versions() -> dict[str, str]:
    """Return the versions on which the last bits of answers depend."""
    found = {name: version(name) for name in ("numba", "numpy", "scipy")}
    return {"thermogrip": __version__, "Python": f"{sys.version_info[0]}.{sys.version_info[1]}"} | found
