"""Our models beside the identification tools that can be installed from PyPI, in one run on real data.

    python -m venv peers && peers/bin/pip install . -r benchmarks/identify/requirements.txt
    peers/bin/python benchmarks/identify/peers.py FOLDER --out peers.json

FOLDER holds the public logs; docs/measured.md names their sources.  Prints a Markdown table: free-run RMSE
on rows that nothing was fitted to, and the CPU seconds of choosing and fitting.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rules import HEAD, Peer, Problem, chosen, problems, rmse
from tools import PEERS

OURS = ("arx", "oe", "subspace", "sindy", "neural")
NETWORKS = {
    "peltier_chamber": "peltier_chamber",
    "tclab_prbs": "tclab",
    "cascaded_tanks": str(Path(__file__).parents[2] / "examples" / "cascaded_tanks.py") + ":CascadedTanks",
}


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument(
        "--out", type=Path, required=True, help="JSON; what it holds already is not run again"
    )
    parser.add_argument("--only", default="", help="data sets, separated by commas")
    parser.add_argument("--tools", default="", help="tools whose name begins so, separated by commas")
    asked = parser.parse_args()
    rows = json.loads(asked.out.read_text()) if asked.out.exists() else []
    done = {(row["data"], row["tool"]) for row in rows}
    for problem in problems(asked.folder, [name for name in asked.only.split(",") if name]):
        for tool, run in _runs(problem):
            if (problem.name, tool) in done or not tool.startswith(tuple(asked.tools.split(","))):
                continue
            rows.append({"data": problem.name, "unit": problem.unit, "tool": tool} | _measure(run))
            print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
            asked.out.write_text(json.dumps(rows, indent=1))
    print(_table(rows))


def _runs(problem: Problem) -> Iterator[tuple[str, Any]]:
    """Yield (tool, a function that chooses, fits and scores)."""
    for kind in OURS:
        yield f"thermogrip {kind}", lambda kind=kind: _ours(problem, kind)
    if problem.name in NETWORKS:
        yield "thermogrip network", lambda: _grey(problem)
    for peer in PEERS:
        yield peer.name, lambda peer=peer: _peer(problem, peer)


def _ours(problem: Problem, kind: str) -> tuple[str, list[float]]:
    from thermogrip.sysid.blackbox.fit import fit_black_box

    roles = {"inputs": problem.inputs, "outputs": problem.outputs, "disturbances": ()}
    plant = fit_black_box(kind, [problem.logs[0]], **roles).plant
    return plant.scores.structure, _score(problem, plant)


def _grey(problem: Problem) -> tuple[str, list[float]]:
    from thermogrip.cli.options import find_network
    from thermogrip.sysid.greybox.fit import fit_network

    average = problem.dt if problem.name == "peltier_chamber" else None
    plant = fit_network(find_network(NETWORKS[problem.name]), [problem.logs[0]], average=average)
    return f"{len(plant.free)} free", _score(problem, plant)


def _score(problem: Problem, plant: Any) -> list[float]:
    from thermogrip.sysid.validation.free_run import free_run

    head = HEAD * problem.dt
    run = free_run(plant, problem.logs[1], warmup=head, score_from=head)
    return [run.scores[name].rmse for name in problem.outputs]


def _peer(problem: Problem, peer: Peer) -> tuple[str, list[float]]:
    structure, simulator = chosen(peer, problem)
    return str(structure), rmse(simulator, problem.test).tolist()


def _measure(run: Any) -> dict[str, Any]:
    began = time.process_time(), time.perf_counter()
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            structure, errors = run()
        answer = {"structure": structure, "rmse": [round(float(e), 4) for e in errors]}
    except Exception as error:  # a tool that fails is a row of the table
        answer = {"structure": "", "rmse": [], "failed": f"{type(error).__name__}: {error}"[:200]}
    cpu, wall = time.process_time() - began[0], time.perf_counter() - began[1]
    return answer | {"cpu_s": round(cpu, 1), "wall_s": round(wall, 1)}


def _table(rows: list[dict[str, Any]]) -> str:
    names = list(dict.fromkeys(row["data"] for row in rows))
    units = {row["data"]: row["unit"] for row in rows}
    lines = [
        "| tool | " + " | ".join(f"{name} [{units[name]}]" for name in names) + " |",
        "|---|" + "---|" * len(names),
    ]
    for tool in dict.fromkeys(row["tool"] for row in rows):
        cells = [_cell([r for r in rows if (r["data"], r["tool"]) == (name, tool)]) for name in names]
        lines.append(f"| {tool} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _cell(rows: list[dict[str, Any]]) -> str:
    if not rows:
        return "-"
    (row,) = rows
    if "failed" in row:
        return "failed"
    if not np.isfinite(row["rmse"]).all() or max(row["rmse"]) > 1e3:
        return f"diverged ; {row['cpu_s']:.0f} s"
    return f"{' / '.join(f'{e:.3g}' for e in row['rmse'])} ; {row['cpu_s']:.0f} s"


if __name__ == "__main__":
    main()
