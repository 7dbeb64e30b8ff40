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


# {data}: the folder of public data; {out}: that of the results; {model}: a posterior of the example grasps
ALL = [
    Benchmark("terminal/mistakes.py"),
    Benchmark("hostile/files.py", quick="--only csv"),
    Benchmark("identify/time_fit.py", quick="--rows fit"),
    Benchmark(
        "identify/peers.py",
        "{data} --out {out}/peers.json",
        "{data} --out {out}/peers.json --only tclab_prbs",
        ("sippy", "nfoursid", "sysidentpy", "jax_sysid"),
    ),
    Benchmark("identify/bands.py", "{data}", "{data} --kinds arx"),
    Benchmark("identify/left.py", quick="--logs 5 --only tclab"),
    Benchmark("identify/lost.py", quick="--seeds 1 --only tclab"),
    Benchmark("identify/fleet.py", "--seeds 4", "--rigs 6 --seeds 1"),
    Benchmark("abroad/score.py", "{data}", "{data} --sets house,dryer"),
    Benchmark("coverage/study.py", "table", "table"),
    Benchmark("coverage/ranks.py", "run --count 100", "run --count 5"),
    Benchmark("mpc/compare.py", quick="--quick", needs=("do_mpc",)),
    Benchmark("mpc/twenty_plants.py", quick="--plants 2"),
    Benchmark("mpc/call_periods.py", quick="--draws 0 --controllers MPC"),
    Benchmark("control/mismatch.py", quick="--seeds 4 --only delay"),
    Benchmark("control/detectable.py"),
    Benchmark("control/faults.py", quick="--seeds 4"),
    Benchmark("control/ten_plants.py", quick="--plants tclab --without do-mpc"),
    Benchmark("classify/engine.py", quick="--grasps 5"),
    Benchmark("classify/table.py", "--splits 20", "--splits 2 --quick"),
    Benchmark("classify/fresh.py", quick="--sets 1 --test 5 --hundreds 0"),
    Benchmark("classify/grippers.py", quick="--grippers 1"),
    Benchmark("classify/transfer.py", quick="--sets 1 --test 3 --classifiers posterior,pca-lda"),
    Benchmark("classify/touches.py", "--out {out}", "--splits 1 --parts two --out {out}"),
    Benchmark("classify/late.py"),
    Benchmark("classify/lstm.py", quick="--measure 5", needs=("torch",)),
    Benchmark("classify/hold.py", "{data}", "{data} --classifiers bayes,pca-lda"),
    Benchmark("classify/scale.py", "{out}/scale --files 2 20 --kill", "{out}/scale --files 1 3 --kill"),
    Benchmark("classify/serve.py", "{model}", "{model} --grasps 400 --in-process 50", ("uvicorn",)),
    Benchmark("rig/jitter.py"),
    Benchmark("rig/day.py", "--out {out}/day", "--hours 0.5 --grasps 5 --minutes 5 --out {out}/day"),
]


def model_of(out: Path) -> Path:
    """Return a posterior trained on the example grasps, made where it is absent."""
    from thermogrip.datasets.examples import example_path

    model = out / "model"
    if not model.exists():
        grasps = str(example_path("exp1A_obj43_grip23"))
        words = ["train", grasps, "--classifier", "posterior", "--split", "all", "--out", str(model)]
        subprocess.run([sys.executable, "-m", "thermogrip", *words], check=True)
    return model


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
        model = model_of(given.out) if "{model}" in words else None
        filled = words.format(data=given.data, out=given.out, model=model).split()
        command = [sys.executable, str(HERE / benchmark.program), *filled]
        to = part_of(given.out, benchmark, ".txt")
        code, wall, cpu = ran(command, to, 60 * given.limit)
        failed += code != 0
        about = f"{wall:.0f} s, {cpu:.0f} s of CPU" + (f", exit code {code}" if code else "")
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
