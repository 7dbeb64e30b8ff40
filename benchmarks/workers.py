"""How much faster two workers are than one, and whether their answers are the same bytes.

    python benchmarks/workers.py FOLDER [effusivity compare tune identify] [--kill] [--files 12] [--large]
        [--workers 2]

Each verb runs with one process on one core, with ``--workers 2`` (or as many as are given) and, where
``distributed`` is installed, on a Dask scheduler with as many worker processes of this machine, which are
there before the clock starts. Efficiency is the wall time of one over that of n times n, the start of the
program included. One process is kept to one core, for some of its steps (rollouts of networks) run on all
cores as threads; so it is measured what two cores are worth.
With ``--kill`` a worker is ended by SIGKILL once it has computed for some seconds, and only bytes are
compared.

``tune`` begins with an empty cache each time, for what it compiles is part of its work.

The loop at the end of a line is the CPU time of five million additions right after the run: a machine that
others share has several speeds.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "classify"))
sys.path.insert(0, str(Path(__file__).parents[1]))
from scale import make

from tests.end_to_end.test_killed_workers import cpu_s
from thermogrip.datasets.examples import copy_examples

OWN = re.compile(rb'"(seconds|fit_s|predict_s_per_grasp|written|command)": [^\n]*')
LOGS = ("prbs_heating_cooling", "step_up_down", "multisine", "pump_on_off")


def verbs(folder: Path, n_files: int, *, large: bool = False) -> dict[str, list[str]]:
    """Return the command of each verb, without its output."""
    if not (folder / "prbs_heating_cooling.csv.xz").exists():
        copy_examples(folder)
    logs = [str(folder / f"{name}.csv.xz") for name in LOGS]
    plant = folder / "plant.json"
    if not plant.exists():
        ran(["identify", *logs, "--network", "gripper", "--models", "network", "--out", str(plant)])
    grasps, spec, models = folder / "grasps", folder / "spec.toml", "arx,oe,subspace,sindy,network"
    conditions = ["exp1A_obj43_grip23"]
    more: list[str] = []
    if large:  # two minutes of one process, or more
        conditions += ["exp2_dT10", "exp2_dT15", "exp2_dT20", "exp3A_obj43_grip23", "exp3B_obj28_grip48"]
        models += ",armax,bj,parsim,neural"
        n_files, more = 4 * n_files, ["--repeats", "80"]
    spec.write_text(f"evaluations = {60 if large else 20}\nsearch_draws = {4 if large else 2}\n")
    return {
        "effusivity": ["effusivity", str(make(folder / "many", n_files)), "--out", "answer.csv"],
        "compare": [
            "compare", *(str(grasps / f"{name}.csv.xz") for name in conditions), "--classifiers",
            "posterior,bayes,features-lda", *more, "--out", "answer",
        ],
        "tune": ["tune", str(plant), "--spec", str(spec), "--out", "answer.json"],
        "identify": [
            "identify", *logs, "--network", "gripper", "--models", models,
            "--leave-one-out", "--out", "answer.json",
        ],
    }  # fmt: skip


def ran(words: list[str], cwd: Path | None = None, kill: bool = False, *, one_core: bool = False) -> float:
    """Return the wall time [s] of one run, a worker of which may be killed."""
    begin = time.perf_counter()
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    core = ["taskset", "--cpu-list", str(min(os.sched_getaffinity(0)))] if one_core else []
    with subprocess.Popen([*core, sys.executable, "-m", "thermogrip", *words], cwd=cwd, **quiet) as process:
        if kill and not killed_one(process.pid):
            print("  no worker was there to be killed")
        if process.wait() not in (0, 1):
            raise SystemExit(f"failed: {words}")
    return time.perf_counter() - begin


def children(pid: int) -> list[int]:
    """Return the processes that a process started, theirs too."""
    own = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        own += [int(word) for word in task.read_text().split()]
    return own + [more for child in own for more in children(child)]


def killed_one(pid: int, seconds: float = 6.0) -> bool:
    """Kill the first worker of a process that has computed so long."""
    while Path(f"/proc/{pid}/stat").exists():
        for child in children(pid):
            if cpu_s(child) > seconds:
                os.kill(child, signal.SIGKILL)
                return True
        if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
            return False
        time.sleep(0.1)
    return False


@contextmanager
def cluster(folder: Path, n: int = 2) -> Iterator[tuple[str, int]]:
    """Give the address of a scheduler with ``n`` workers, and the process that started these."""
    run = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0"]
    file = folder / "scheduler.json"
    file.unlink(missing_ok=True)
    work = [sys.executable, "-m", "distributed.cli.dask_worker", "--scheduler-file", str(file)]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": folder}
    ahead = [*run, "--no-dashboard", "--scheduler-file", str(file)]
    behind = [*work, "--nworkers", str(n), "--nthreads", "1", "--no-dashboard"]
    behind += ["--preload", "thermogrip.cli.cluster"]  # as docs/howto/cluster.md starts them
    with subprocess.Popen(ahead, **quiet) as scheduler, subprocess.Popen(behind, **quiet) as two:
        from distributed import Client

        try:
            with Client(scheduler_file=str(file)) as client:
                client.wait_for_workers(n)
                address = client.scheduler.address
            yield address, two.pid
        finally:
            two.terminate()
            two.wait()
            scheduler.terminate()


def digest(folder: Path) -> str:
    """Return what the output of a run amounts to, without times and the command."""
    found = hashlib.sha256()
    for path in sorted((*folder.rglob("answer*.csv"), *folder.rglob("*.json"))):
        found.update(OWN.sub(b"", path.read_bytes()))
    return found.hexdigest()[:12]


def loop() -> float:
    """Return the CPU time of five million additions [s]."""
    begin, total = time.process_time(), 0
    for i in range(5_000_000):
        total += i
    return time.process_time() - begin


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("verbs", nargs="*", default=["effusivity", "compare", "tune", "identify"])
    parser.add_argument("--kill", action="store_true")
    parser.add_argument("--files", type=int, default=12)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--large", action="store_true", help="some two minutes of one process")
    given = parser.parse_args()
    folder = given.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    words = verbs(folder, given.files, large=given.large)
    for verb in given.verbs:
        alone, first = 0.0, ""
        for how in ("one process", f"{given.workers} workers", f"Dask, {given.workers} workers"):
            out = folder / "out"
            shutil.rmtree(out, ignore_errors=True)
            out.mkdir()
            cache = folder / "cache"
            shutil.rmtree(cache, ignore_errors=True)
            if verb == "tune":  # the C of the last run is built anew
                os.environ["XDG_CACHE_HOME"] = str(cache)
            else:
                os.environ.pop("XDG_CACHE_HOME", None)
            if how.startswith("Dask"):
                with cluster(folder, given.workers) as (address, _):
                    wall = ran([*words[verb], "--cluster", address], out)
            else:
                n = 1 if how == "one process" else given.workers
                one = [*words[verb], "--workers", str(n)]
                wall = ran(one, out, kill=given.kill and n > 1, one_core=n == 1)
            alone, first = alone or wall, first or digest(out)
            same = "same bytes" if digest(out) == first else "OTHER BYTES"
            share = "" if how == "one process" else f"efficiency {alone / wall / given.workers:.2f}"
            print(f"{verb:11s} {how:18s} {wall:7.1f} s  {share:16s} {same}  loop {loop():.2f} s", flush=True)


if __name__ == "__main__":
    main()
