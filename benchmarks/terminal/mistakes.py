"""What each mistake of a command line costs until it is told: seconds of CPU of a process, and its line.

    python benchmarks/terminal/mistakes.py [RUNS]

Each is to be told in less than 0.5 s, with code 2 and the mend of ``tests/end_to_end/mistakes.py``.  The
figure is the median of so many runs (3), since others share the processor; the last line has its speed.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.end_to_end.mistakes import MISTAKES, mistaken_folder

SECONDS = 0.5


def told(words: str, folder: str) -> tuple[float, int, str]:
    """Return seconds of CPU, exit code and the line on stderr."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", "thermogrip", *words.split()]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return spent, done.returncode, done.stderr.strip()


def speed() -> float:
    """Return the CPU time of five million additions [s]."""
    before, total = time.process_time(), 0
    for k in range(5_000_000):
        total += k
    return time.process_time() - before


def main() -> int:
    """Print a row a mistake; return how many were not told as they should be."""
    runs = int(sys.argv[1]) if sys.argv[1:] else 3
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    bad, most = 0, 0.0
    with tempfile.TemporaryDirectory() as folder:
        mistaken_folder(Path(folder))
        told("--help", folder)
        print("| typed | CPU [s] | told |\n|---|---|---|")
        for words, mend in MISTAKES.items():
            tried = [told(words, folder) for _ in range(runs)]
            spent, (_, code, line) = median(cpu for cpu, _, _ in tried), tried[0]
            good = code == 2 and mend in line and "\n" not in line and spent < SECONDS
            bad, most = bad + (not good), max(most, spent)
            print(
                f"| `{words}` | {spent:.2f} | {'' if good else '**'}{line.removeprefix('thermogrip: ')} |",
                flush=True,
            )
    print(f"\n{len(MISTAKES)} mistakes, {bad} not told as they should be, at most {most:.2f} s of CPU")
    print(f"five million additions: {speed():.2f} s")
    return bad


if __name__ == "__main__":
    raise SystemExit(main())
