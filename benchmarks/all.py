"""All benchmarks, one after the other, and their tables on one page.

    python benchmarks/all.py OUT [--quick] [--data FOLDER] [--only classify,mpc] [--limit MINUTES] [--list]

``OUT/NAME.txt`` is what a benchmark printed, ``OUT/tables.md`` all of them under their commands, with wall
and CPU time: the tables that ``docs/`` quotes are these.  Runs of some at a time (``--only``) into one OUT
make one page.  ``--quick`` takes small sizes, and its figures are as unsure.  One that takes longer than
``--limit`` is ended, with its processes, and counts as failed.  Public data are read in ``--data``; without
it, and without a peer's package, a benchmark is left out and the page says so.  Peers: the
``requirements.txt`` of each folder, in an environment of their own, whose interpreter then runs this.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import threading
import time
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).parent


class Benchmark(NamedTuple):
    """A program, its arguments in full and for ``--quick``, and the packages without which it has no peer."""

    program: str
    full: str = ""
    quick: str = ""
    needs: tuple[str, ...] = ()


# {data}: the folder of public data; {out}: that of the results
ALL = [
    Benchmark("hostile/files.py", quick="--only csv"),
    Benchmark("hostile/logs.py"),
    Benchmark("identify/time_fit.py", quick="--rows fit"),
    Benchmark("identify/left.py", quick="--logs 5 --only tclab"),
    Benchmark("abroad/score.py", "{data}", "{data} --sets house,dryer"),
    Benchmark("coverage/study.py", "table", "table"),
    Benchmark("excite/predicted_precision.py"),
    Benchmark("mpc/compare.py", quick="--quick", needs=("do_mpc",)),
    Benchmark("control/mismatch.py", quick="--seeds 4 --only delay"),
    Benchmark(
        "control/eight_plants.py",
        "--keep {out}/eight",
        "--plants sous_vide --who ours,simc --keep {out}/eight",
    ),
    Benchmark("control/false_alarms.py", "--keep {out}/eight", "--hours 0.2 --keep {out}/eight"),
    Benchmark(
        "control/ten_plants.py", "--keep {out}/ten", "--plants tclab --without do-mpc --keep {out}/ten"
    ),
    Benchmark("classify/disturbed_grasps.py", quick="--parts rig --each 1"),
    Benchmark("classify/lstm.py", quick="--epochs 5 --blocks 2", needs=("torch",)),
    Benchmark("classify/public_sets.py", "{data}", "{data} --classifiers pca-lda"),
    Benchmark("rig/relays.py"),
    Benchmark("rig/board.py"),
]
#: These write a page of the docs themselves.
NOT_RUN = ("rig/faults.py", "rig/limits.py")
MISSING = 77  # the exit code of a benchmark that lacks a tool of the system


def left_out(benchmark: Benchmark, words: str, data: Path | None) -> str:
    """Return why a benchmark cannot be run here, empty where it can."""
    if "{data}" in words and data is None:
        return "no --data"
    missing = [name for name in benchmark.needs if find_spec(name) is None]
    return f"no {', '.join(missing)}" if missing else ""


def ran(command: list[str], to: Path, limit_s: float) -> tuple[int, float, float]:
    """Run a benchmark into a file; return its exit code, and wall and CPU time [s]."""
    begin = time.perf_counter()
    with open(to, "w", encoding="utf-8") as file:
        process = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT, start_new_session=True)
        end = threading.Timer(limit_s, os.killpg, (process.pid, signal.SIGKILL))
        end.start()
        try:
            _, status, used = os.wait4(process.pid, 0)
        except BaseException:  # Ctrl-C reaches this process alone
            os.killpg(process.pid, signal.SIGTERM)
            raise
        finally:
            end.cancel()
    return os.waitstatus_to_exitcode(status), time.perf_counter() - begin, used.ru_utime + used.ru_stime


def page(out: Path) -> str:
    """Return what all benchmarks that were run into a folder printed, in their order."""
    parts = [part_of(out, benchmark, ".md") for benchmark in ALL]
    return "\n".join(["# Benchmarks", "", *(p.read_text(encoding="utf-8") for p in parts if p.exists())])


def part_of(out: Path, benchmark: Benchmark, suffix: str) -> Path:
    """Return a file of one benchmark."""
    return out / f"{benchmark.program.replace('/', '-').removesuffix('.py')}{suffix}"


def main() -> int:
    """Run, write and say how many failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--data", type=Path)
    parser.add_argument("--only", default="", help="beginnings of their names, by commas")
    parser.add_argument("--limit", type=float, default=120.0, help="of each [min]")
    parser.add_argument("--list", action="store_true", help="only the commands")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    failed = 0
    for benchmark in ALL:
        if not benchmark.program.startswith(tuple(given.only.split(","))):
            continue
        words = benchmark.quick if given.quick else benchmark.full
        said = f"python benchmarks/{benchmark.program} {words}".strip()
        why, part = left_out(benchmark, words, given.data), part_of(given.out, benchmark, ".md")
        if given.list or why:
            print(said, f"  left out: {why}" if why else "", flush=True)
            if not given.list:
                part.write_text(f"`{said}`: left out, {why}.\n", encoding="utf-8")
            continue
        filled = words.format(data=given.data, out=given.out).split()
        command = [sys.executable, str(HERE / benchmark.program), *filled]
        to = part_of(given.out, benchmark, ".txt")
        code, wall, cpu = ran(command, to, 60 * given.limit)
        failed += code not in (0, MISSING)
        end = ", a tool is missing" if code == MISSING else f", exit code {code}" if code else ""
        about = f"{wall:.0f} s, {cpu:.0f} s of CPU{end}"
        print(f"{said}  ({about})", flush=True)
        printed = to.read_text(encoding="utf-8", errors="replace").rstrip()
        rows = [f"## {benchmark.program}", "", f"`{said}` ({about})", "", "```", printed, "```", ""]
        part.write_text("\n".join(rows), encoding="utf-8")
        (given.out / "tables.md").write_text(page(given.out), encoding="utf-8")  # so far
    if given.list:
        return 0
    (given.out / "tables.md").write_text(page(given.out), encoding="utf-8")
    print(f"{failed} failed; wrote {given.out / 'tables.md'}")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
