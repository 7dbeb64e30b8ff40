"""How long identification takes.

    python benchmarks/identify/time_fit.py [--rows fit,first,...] [--threads 1]

Each name is a process of its own (Linux) on the four rig logs that come with the package:

    fit         network "gripper" from its priors; logs and kernel are there before the clock starts
    first       the same in a new process: imports, reading, compiling, fitting
    identify    ``thermogrip identify LOGS --report``: black boxes, held-out scores, intervals, figures
    posterior   ``thermogrip identify LOGS --models network --posterior``

Wall and processor time [s], largest resident memory [MB], and surface RMSE of the bins over all logs [degC].
On a machine that others use read the processor time.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from thermogrip.datasets.examples import EXAMPLE_LOGS, example_path, load_example_logs

Row = dict[str, Any]
HERE = Path(__file__).resolve()


def clocked(what: str, work: Callable[[], Any]) -> tuple[Row, Any]:
    """Do it, and return a row with its wall and processor time."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    return {"what": what, "wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu}, result


def fit() -> list[Row]:
    """The network, compiled beforehand."""
    from thermogrip.sysid.greybox.fit import fit_network
    from thermogrip.sysid.models.network import load_network

    logs, model = list(load_example_logs().values()), load_network("gripper")
    model.rollout(
        np.full((1, model.n_x), 25.0), np.ones((1, 1, 2)), np.full((1, 1, 1), 25.0), model.prior[None], 0.5
    )
    row, plant = clocked("fit", lambda: fit_network("gripper", logs))
    return [row | _said(plant)]


def _said(plant: Any) -> Row:
    return {"rmse": plant.noise["t_surface"]}


def first_fit() -> list[Row]:
    """The network in a new process."""
    from thermogrip.sysid.greybox.fit import fit_network

    return [_said(fit_network("gripper", list(load_example_logs().values())))]


INSIDE: dict[str, Callable[[], list[Row]]] = {"fit": fit, "first": first_fit}
COMMANDS = {"identify": ["--report", "report.html"], "posterior": ["--models", "network", "--posterior"]}


def measured(name: str, threads: int) -> list[Row]:
    """Run one name in a process of its own, in an empty folder, and return its rows."""
    if name in INSIDE:
        command = [sys.executable, str(HERE), "--inside", name]
    else:
        logs = [str(example_path(log)) for log in EXAMPLE_LOGS]
        command = [
            sys.executable,
            "-m",
            "thermogrip",
            "identify",
            *logs,
            "--out",
            "plant.json",
            *COMMANDS[name],
        ]
    count = str(threads)
    variables = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), count)
    with tempfile.TemporaryDirectory() as folder, open(Path(folder) / "said", "w+") as said:
        began = time.perf_counter()
        child = subprocess.Popen(
            command,
            env=os.environ | variables | {"NUMBA_CACHE_DIR": folder},
            cwd=folder,
            stdout=said,
            stderr=said,
        )
        _, status, usage = os.wait4(child.pid, 0)
        wall = time.perf_counter() - began
        said.seek(0)
        text = said.read()
    if status:
        raise SystemExit(f"{name} failed:\n{text[-2000:]}")
    whole = {
        "what": name,
        "wall": wall,
        "cpu": usage.ru_utime + usage.ru_stime,
        "memory": usage.ru_maxrss / 1024,
    }
    rows = json.loads(text.splitlines()[-1]) if name in INSIDE else [{"note": text.splitlines()[-2][:60]}]
    return [whole | row for row in rows]


def table(rows: list[Row]) -> str:
    """Return the rows as a table for Markdown."""
    out = ["| | wall [s] | processor [s] | memory [MB] | RMSE [degC] | |", "|---|---|---|---|---|---|"]
    for row in rows:
        rmse = f"{row['rmse']:.4f}" if "rmse" in row else ""
        numbers = f"{row['wall']:.2f} | {row['cpu']:.2f} | {row['memory']:.0f}"
        out.append(f"| {row['what']} | {numbers} | {rmse} | {row.get('note', '')} |")
    return "\n".join(out)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", default="fit,first", help="which, with commas")
    parser.add_argument("--threads", type=int, default=1, help="processor cores that the process may use")
    parser.add_argument("--inside", help=argparse.SUPPRESS)
    wanted = parser.parse_args()
    if wanted.inside:
        sys.stdout.write(json.dumps(INSIDE[wanted.inside]()) + "\n")
        return
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: wanted.threads])  # the processes inherit it
    rows = [row for name in wanted.rows.split(",") for row in measured(name, wanted.threads)]
    sys.stdout.write(table(rows) + "\n")


if __name__ == "__main__":
    main()
