"""A worker that is killed in the middle of its work changes no answer of the verbs that share it out."""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from tests.end_to_end.conftest import Bench
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.grasp_files import write_grasps
from thermogrip.datasets.log_files import write_log
from thermogrip.datasets.schema import make_log
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.models.network import load_network

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/stat").exists() or (os.cpu_count() or 1) < 2, reason="needs /proc and two processors"
)

# how long it took, when it was written, and by which command
_OWN = re.compile(r'"(seconds|written|command)": [^\n]*')


class Killer(threading.Thread):
    """Kills the first child process that has computed for a third of a second."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.killed = 0
        self.over = threading.Event()

    def run(self) -> None:
        while not self.killed and not self.over.wait(0.02):
            for child in multiprocessing.active_children():
                if child.pid and cpu_s(child.pid) > 0.3:
                    os.kill(child.pid, signal.SIGKILL)
                    self.killed = child.pid
                    break


def cpu_s(pid: int) -> float:
    """Return the CPU time of a process [s], zero where it has ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")


def answer_of(path: Path) -> dict[str, str]:
    """Return what a verb wrote, without what differs from run to run."""
    files = [path] if path.is_file() else sorted(path.rglob("*.json"))
    return {str(file.relative_to(path)): _OWN.sub("", file.read_text()) for file in files}


def effusivity(bench: Bench) -> tuple[list[str], str]:
    record = load_example_grasps()["exp2_dT20"]
    for k in range(4):
        write_grasps(record.isel(grasp=np.arange(3) + 3 * k), bench.path / "many" / f"part{k}.csv")
    return ["effusivity", "many"], "answer.csv"


def identify(bench: Bench) -> tuple[list[str], str]:
    """Three logs of a board, each left out in turn."""
    board, rng, t = prior_plant(load_network("tclab")), np.random.default_rng(0), np.arange(0.0, 400.0, 2.0)
    for k in range(3):
        drives = [np.repeat(rng.uniform(0, 80, 10), 20) for _ in range(2)]
        signals = {f"q{i + 1}": (drive, "percent", "input") for i, drive in enumerate(drives)}
        signals |= {name: (np.full(t.size, 23.0), "degC", "output") for name in ("t1", "t2")}
        log = board.simulate(make_log(t, signals))
        for name in ("t1", "t2"):
            log[name] = ("time", log[name].values + 0.1 * rng.normal(size=t.size), log[name].attrs)
        write_log(log, bench.path / f"log{k}.csv")
    words = "identify log0.csv log1.csv log2.csv --network tclab --models network --leave-one-out"
    return words.split(), "answer.json"


@pytest.mark.slow
@pytest.mark.parametrize("verb", [effusivity, identify])
def test_a_killed_worker_changes_no_byte(bench: Bench, monkeypatch, verb) -> None:
    monkeypatch.chdir(bench.path)
    (bench.path / "many").mkdir(exist_ok=True)
    words, name = verb(bench)
    found = []
    for workers in (1, 2):
        killer = Killer()
        if workers == 2:
            killer.start()
        begin = time.monotonic()
        done = bench.run(*words, "--workers", workers, "--out", name)
        killer.over.set()
        assert done.code in (0, 3), done
        assert bool(killer.killed) == (workers == 2), time.monotonic() - begin
        found.append(answer_of(bench.path / name))
        if (bench.path / name).is_dir():
            (bench.path / name).rename(bench.path / f"answer{workers}")
        else:
            (bench.path / name).unlink()
    assert found[0] == found[1]
    assert found[0]
