"""Wall time, CPU time, peak memory and grasps per core-second of ``effusivity``, or with ``--classify`` of
``classify``, by the number of grasps.

    python benchmarks/classify/scale.py FOLDER [--files 2 20] [--workers N] [--classify MODEL_DIR]

Files of 500 grasps each are made in FOLDER/files by as many processes: traces of the example condition
``exp1A_obj43_grip23``, drawn at random, with new white noise of 0.02 K; those that are there are kept, so
10^4, 10^5 and 3 10^5 grasps (``--files 20 200 600``) take 600 files of 1.8 MB. The rate leaves out the
start, by the difference of two numbers of files. Memory is that of the largest process. The loop at the end
of a line is the CPU time of five million additions right after the run: a machine that others share has
several speeds.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path

import numpy as np

from thermogrip.datasets.examples import example_path
from thermogrip.datasets.grasp_files import read_grasps, write_grasps
from thermogrip.datasets.parallel import run_parallel
from thermogrip.datasets.schema import Grasps

PER_FILE = 500
EXAMPLE = "exp1A_obj43_grip23"


def make(folder: Path, n_files: int, workers: int = 1) -> Path:
    """Return a folder of so many files, made where they are absent, by so many processes."""
    files, of_them = folder / "files", folder / f"{n_files}"
    for each in (files, of_them):
        each.mkdir(parents=True, exist_ok=True)
    absent = [k for k in range(n_files) if not all(path.exists() for path in both(files, k))]
    run_parallel(partial(make_one, files), absent, workers)
    for k in range(n_files):
        for path in both(files, k):
            if not (there := of_them / path.name).exists():
                os.link(path, there)
    return of_them


def both(folder: Path, k: int) -> tuple[Path, Path]:
    """Return the paths of the samples and of what is known of the grasps."""
    return folder / f"part{k:04d}.csv", folder / f"part{k:04d}_meta.csv"


def make_one(folder: Path, k: int) -> None:
    """Write file ``k``."""
    grasps, rng = example(), np.random.default_rng(k)
    part = grasps.isel(grasp=rng.integers(0, grasps.sizes["grasp"], PER_FILE))
    part = part.assign_coords(grasp=[f"{k}-{i}" for i in range(PER_FILE)])
    noise = rng.normal(0, 0.02, part["t_surface"].shape)
    part = part.assign(t_surface=(("grasp", "time"), part["t_surface"].values + noise, {"units": "degC"}))
    part.attrs["name"] = (path := both(folder, k)[0]).stem
    write_grasps(part, path)


@cache
def example() -> Grasps:
    """Return the grasps that traces are drawn from."""
    return read_grasps(example_path(EXAMPLE))


def ran(words: list[str]) -> tuple[float, float, float]:
    """Return wall and CPU time [s] and the peak memory [MB] of one run of the program: CPU time of all its
    processes, memory of the largest."""
    begin = time.perf_counter()
    command = [sys.executable, "-m", "thermogrip", *words]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, start_new_session=True)
    cpu: dict[int, float] = {}  # workers are forked from a server, so that nobody here waits for them
    largest = 0.0
    while (status := process.poll()) is None:
        for pid, seconds, megabytes in of_session(process.pid):
            cpu[pid] = max(seconds, cpu.get(pid, 0.0))
            largest = max(largest, megabytes)
        time.sleep(0.1)
    if status:
        raise SystemExit(f"failed: {words}")
    return time.perf_counter() - begin, sum(cpu.values()), largest


def of_session(session: int) -> Iterator[tuple[int, float, float]]:
    """Give each process of a session: its number, CPU time [s], largest memory so far [MB]."""
    tick = os.sysconf("SC_CLK_TCK")
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            words = (entry / "stat").read_text().rpartition(")")[2].split()
            if int(words[3]) != session:
                continue
            status = dict(line.split(":", 1) for line in (entry / "status").read_text().splitlines())
        except (OSError, ValueError):
            continue  # it has ended
        memory = float(status.get("VmHWM", "0 kB").split()[0]) / 1024
        yield int(entry.name), (int(words[11]) + int(words[12])) / tick, memory


def loop() -> float:
    """Return the CPU time of five million additions [s]."""
    begin, total = time.process_time(), 0
    for i in range(5_000_000):
        total += i
    return time.process_time() - begin


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--files", type=int, nargs="+", default=[2, 20])
    parser.add_argument("--classify", metavar="MODEL_DIR")
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    verb = ["classify", given.classify] if given.classify else ["effusivity"]
    verb += ["--workers", str(given.workers)]
    begin = time.perf_counter()
    make(given.folder, max(given.files), given.workers)
    print(f"files made in {time.perf_counter() - begin:.0f} s")
    print("grasps   wall [s]  CPU [s]  memory [MB]  grasps a core-second")
    before: tuple[int, float] | None = None
    for n_files in given.files:
        folder, out = make(given.folder, n_files), given.folder / f"{n_files}.csv"
        wall, cpu, memory = ran([*verb, str(folder), "--out", str(out)])
        n = n_files * PER_FILE
        rate = "" if before is None else f"{(n - before[0]) / (cpu - before[1]):.0f}"
        print(f"{n:6d} {wall:10.0f} {cpu:8.1f} {memory:12.0f}  {rate:10s} loop {loop():.2f}", flush=True)
        before = n, cpu


if __name__ == "__main__":
    main()
