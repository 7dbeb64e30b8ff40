"""Work on several processes gives what one gives."""

from __future__ import annotations

import math
import os
import signal

import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.workers import run_parallel, sub_progress


def test_one_worker_works_here_in_order_and_tells():
    seen = []
    got = run_parallel(lambda n: n * n, [3, 1, 2], progress=lambda *a: seen.append(a), what="squares")
    assert got == [9, 1, 4]
    assert seen == [(pytest.approx(1 / 3), "squares"), (pytest.approx(2 / 3), "squares"), (1.0, "squares")]


def test_nothing_to_do_is_nothing():
    assert run_parallel(abs, [], workers=4) == []


@pytest.mark.slow
def test_processes_give_the_same_in_the_same_order():
    fractions = []
    got = run_parallel(math.factorial, range(12), workers=2, progress=lambda f, _: fractions.append(f))
    assert got == [math.factorial(n) for n in range(12)]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0


@pytest.mark.slow
def test_a_fault_in_a_process_is_raised_here_as_it_was():
    with pytest.raises(ValueError, match="factorial"):
        run_parallel(math.factorial, [3, -1, 4], workers=2)


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt" or (os.cpu_count() or 1) < 2, reason="needs POSIX and two processors")
def test_a_killed_process_is_one_line():
    with pytest.raises(UserError, match="a worker process was killed"):
        run_parallel(signal.raise_signal, [signal.SIGKILL] * 3, workers=2)


def test_workers_below_one_are_refused():
    with pytest.raises(UserError, match="0 workers"):
        run_parallel(abs, [1], workers=0)


def test_the_progress_of_a_part_stays_in_its_share():
    seen = []
    part = sub_progress(lambda f, w: seen.append((f, w)), 0.2, 0.6)
    assert part is not None
    part(0.0, "a")
    part(1.0, "b")
    assert seen == [(0.2, "a"), (pytest.approx(0.6), "b")]
    assert sub_progress(None, 0, 1) is None


def test_a_user_error_survives_the_way_between_processes():
    import pickle

    fault = UserError("bad", file="a.csv", row=3, column="x", mend="mend it")
    back = pickle.loads(pickle.dumps(fault))  # noqa: S301  what a process pool does
    assert str(back) == "a.csv, row 3, column x: bad; mend it"
    assert back.row == 3
