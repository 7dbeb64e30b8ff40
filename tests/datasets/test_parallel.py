"""Work on several processes gives what one gives."""

from __future__ import annotations

import math
import os
import pickle
import signal
import subprocess
import sys
import threading
import weakref
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from thermogrip import __version__
from thermogrip.datasets import parallel
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.parallel import in_order, sub_progress


def run_parallel(*given, **options):
    return list(in_order(*given, **options))


OWN = ["__import__('os').getpid()"] * 4  # a process may not find this module, the builtin eval it does


def test_one_worker_works_here_in_order_and_reports():
    seen = []
    got = run_parallel(lambda n: n * n, [3, 1, 2], progress=lambda *a: seen.append(a), what="squares")
    assert got == [9, 1, 4]
    assert seen == [(pytest.approx(1 / 3), "squares"), (pytest.approx(2 / 3), "squares"), (1.0, "squares")]


def test_processes_give_the_same_in_the_same_order():
    fractions = []
    got = run_parallel(math.factorial, range(12), workers=2, progress=lambda f, _: fractions.append(f))
    assert got == [math.factorial(n) for n in range(12)]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0


def test_a_fault_in_a_process_is_raised_here_as_it_was():
    with pytest.raises(ValueError, match="factorial"):
        run_parallel(math.factorial, [3, -1, 4], workers=2)


@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="needs two processors")
def test_the_same_processes_do_the_work_of_every_call_also_after_a_fault() -> None:
    first = set(run_parallel(eval, OWN, workers=2))
    with pytest.raises(ValueError, match="factorial"):
        run_parallel(math.factorial, [3, -1, 4], workers=2)
    again = set(run_parallel(eval, OWN, workers=2))
    assert len(first | again) <= 2
    assert os.getpid() not in first | again


@pytest.mark.skipif(os.name == "nt" or (os.cpu_count() or 1) < 2, reason="needs POSIX and two processors")
def test_a_process_that_is_killed_is_one_line_and_the_next_call_has_others():
    with pytest.raises(UserError, match="a worker process was killed; lower --workers"):
        run_parallel(signal.raise_signal, [signal.SIGKILL] * 3, workers=2)
    assert run_parallel(abs, [-1, -2], workers=2) == [1, 2]


@pytest.fixture
def pools(monkeypatch):
    """Eight processors, and threads in place of processes: a list of how many each pool was asked for."""
    made = []
    monkeypatch.setattr(parallel, "_processes", lambda n: made.append(n) or ThreadPoolExecutor(n))
    monkeypatch.setattr(parallel.os, "cpu_count", lambda: 8)
    return made


def test_no_more_processes_are_started_than_there_are_processors(pools, monkeypatch):
    seen = []
    got = run_parallel(math.factorial, [4, 1, 3, 2, 0], workers=3, progress=lambda *a: seen.append(a))
    assert got == [24, 1, 6, 2, 1]
    assert seen[-1] == (1.0, "working")
    assert {round(5 * f) / 5 for f, _ in seen} >= {f for f, _ in seen}
    for workers in (99, 1):
        run_parallel(abs, [-1] * 6, workers=workers)
    monkeypatch.setattr(parallel.os, "cpu_count", lambda: None)
    run_parallel(abs, [-1] * 20, workers=99)
    assert pools == [3, 8]


@pytest.mark.parametrize("workers", [4, "tcp://127.0.0.1:9"])
def test_nothing_to_do_is_nothing_and_asks_no_cluster(workers):
    assert run_parallel(abs, [], workers) == []


@pytest.mark.parametrize(
    "workers", [0, "localhost", "tcp://localhost", "http://localhost:8786", "tcp://:8786"]
)
def test_workers_that_cannot_be_are_refused_before_any_work(workers):
    with pytest.raises(UserError, match=r"0 workers|no address of a scheduler"):
        run_parallel(abs, [1], workers)


def test_the_progress_of_a_part_stays_in_its_share_and_has_its_name():
    seen = []
    for name, what in (("tune", "run 3"), ("", "run 4"), ("tune", "")):
        part = sub_progress(lambda f, w: seen.append((f, w)), 0.5, 0.9, name)
        part(-1.0, what)
        part(1.5, what)
    low, high = pytest.approx(0.5), pytest.approx(0.9)
    assert seen == [(end, words) for words in ("tune: run 3", "run 4", "tune") for end in (low, high)]
    assert sub_progress(None, 0, 1) is None


def test_a_user_error_survives_the_way_between_processes():
    fault = UserError("bad", file="a.csv", row=3, column="x", hint="correct it")
    back = pickle.loads(pickle.dumps(fault))  # noqa: S301  what a process pool does
    assert str(back) == "a.csv, row 3, column x: bad; correct it"
    assert back.row == 3


@pytest.fixture(scope="module")
def cluster():
    """A scheduler and two workers in this process, spoken to over TCP as if they were elsewhere."""
    distributed = pytest.importorskip("distributed")
    made = distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=False,
        protocol="tcp",
        host="127.0.0.1",
        dashboard_address=":0",
    )
    yield made.scheduler_address
    distributed.get_client(made.scheduler_address).close()
    made.close()


def test_a_cluster_gives_the_same_in_the_same_order(cluster):
    seen = []
    got = run_parallel(math.lgamma, range(1, 40), cluster, lambda *a: seen.append(a), what="gammas")
    assert got == [math.lgamma(n) for n in range(1, 40)]
    assert [fraction for fraction, _ in seen] == [pytest.approx(n / 39) for n in range(1, 40)]


def test_a_fault_on_a_cluster_is_raised_here_as_it_was(cluster):
    with pytest.raises(ValueError, match="factorial"):
        run_parallel(math.factorial, [3, -1, 4], cluster)


@pytest.mark.slow  # starts four processes
@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
def test_a_cluster_does_again_what_a_killed_worker_had_in_hand_and_takes_in_a_late_one(tmp_path) -> None:
    distributed = pytest.importorskip("distributed")
    mark, late = tmp_path / "killed", tmp_path / "late"
    kill = f"{{n}} if __import__('os').path.exists({str(mark)!r}) else " + (
        f"(open({str(mark)!r}, 'w').close(), __import__('os').kill(__import__('os').getpid(), 9))"
    )
    named = f"open({str(late)!r} + str(__import__('os').getpid()), 'w').close()"
    pid = f"(__import__('time').sleep(0.2), {named}, {{n}})[2]"
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address=":0"
    ) as made:
        address = made.scheduler_address
        items = [(kill if n == 3 else pid).format(n=n) for n in range(40)]
        seen = []
        for n, found in enumerate(in_order(eval, items, address)):
            seen.append(found)
            if n == 0:
                made.scale(2)
        assert seen == list(range(40))
    assert mark.exists()
    assert len(list(tmp_path.glob("late*"))) >= 3  # the first, its successor, and the late one


def test_a_cluster_that_does_not_answer_is_one_line(monkeypatch):
    monkeypatch.setattr("thermogrip.datasets.parallel._CONNECT_S", 1)
    with pytest.raises(UserError, match="no scheduler answers at tcp"):
        run_parallel(abs, [1], "tcp://127.0.0.1:9")


@pytest.mark.parametrize("there", ["0.0.1", None])
def test_a_cluster_of_another_version_is_refused(cluster, monkeypatch, there):
    versions = distributed_client().get_versions

    def of_another_time(client, **asked):
        found = versions(client, **asked)
        found["scheduler"]["packages"]["thermogrip"] = there
        return found

    monkeypatch.setattr(distributed_client(), "get_versions", of_another_time)
    with pytest.raises(UserError, match=rf"has thermogrip {there or 'missing'} for {__version__}; install"):
        run_parallel(abs, [1], cluster)


def distributed_client():
    return pytest.importorskip("distributed").Client


def test_results_that_were_given_are_not_kept():
    given, alive = [], 0
    for result in in_order(np.ones, [3] * 12, 2):
        given.append(weakref.ref(result))
        alive = sum(one() is not None for one in given)
        del result
    assert len(given) == 12
    assert alive <= 2  # the last one, and one that waits for the next


def test_results_come_in_order_as_soon_as_they_can(pools):
    turn = threading.Event()

    def work(n):
        if n == 0:
            turn.wait(10)
        turn.set()
        return n

    assert list(in_order(work, range(9), 3)) == list(range(9))
    assert list(in_order(abs, [-2, -1])) == [2, 1]


@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="needs two processors")
def test_processes_begin_with_our_modules_and_not_with_files_of_the_folder(tmp_path):
    for name in ("colorsys", "loky", "numpy"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('of the folder')")
    program = """
import os, sys
sys.path.remove("")
from thermogrip.datasets.parallel import in_order
found = [*in_order(eval, ["hasattr(__import__('colorsys'), 'hsv_to_rgb')"] * 2, 2)]
threads = [*in_order(os.getenv, ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"], 2)]
print(found, threads, "PYTHONSAFEPATH" in os.environ, "OPENBLAS_NUM_THREADS" in os.environ)
"""
    apart = ("PYTHONSAFEPATH", *parallel.THREADS)
    given = {key: value for key, value in os.environ.items() if key not in apart} | {"OMP_NUM_THREADS": "3"}
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, env=given, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[True, True] ['3', '1'] False False"


@pytest.mark.skipif(os.name == "nt" or (os.cpu_count() or 1) < 2, reason="needs POSIX and two processors")
def test_a_ctrl_c_ends_the_processes_too(tmp_path):
    program = """
import os, signal, threading
from thermogrip.datasets.parallel import in_order
list(in_order(abs, [-1, 2], 2))
threading.Timer(1.0, os.killpg, (os.getpgid(0), signal.SIGINT)).start()
list(in_order(eval, ["__import__('time').sleep(300)"] * 2, 2))
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=200, start_new_session=True
    )
    assert done.stderr.rstrip().endswith("KeyboardInterrupt")
    assert done.stderr.count("Traceback") == 1


def test_the_client_of_a_scheduler_is_the_same_one_for_every_call(cluster, monkeypatch) -> None:
    made, make = [], distributed_client().__init__
    monkeypatch.setattr(
        distributed_client(), "__init__", lambda self, *a, **k: made.append(self) or make(self, *a, **k)
    )
    for _ in range(2):
        assert run_parallel(math.factorial, [3, 4], cluster) == [6, 24]
    [client] = made
    client.close()
