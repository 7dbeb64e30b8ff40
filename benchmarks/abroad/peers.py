"""Other identification tools on the public sets of ``foreign_sets.py``, by the rule that scores ours.

    python -m venv peers && peers/bin/pip install . -r benchmarks/identify/requirements.txt
    OMP_NUM_THREADS=1 peers/bin/python benchmarks/abroad/peers.py FOLDER [--sets cstr] [--tools nfoursid]

Structures are chosen inside the training half (``benchmarks/identify/rules.py``).  Prints by set and tool the
RMSE of each output on the other half, their mean, and the mean over the spread.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import sys
import time
import warnings
from pathlib import Path

import numpy as np
from foreign_sets import ForeignSet, load, present

sys.path.append(str(Path(__file__).parents[1] / "identify"))
import rules
import tools
from rules import Problem, record

from thermogrip.datasets.schema import names


def problem_of(some: ForeignSet) -> Problem:
    """Return the set as the peers take it: disturbances are inputs to them."""
    inputs = (*names(some.train, "input"), *names(some.train, "disturbance"))
    outputs = names(some.train, "output")
    train, test = (record(log, inputs, outputs) for log in (some.train, some.test))
    return Problem(some.name, "1", inputs, outputs, train, test, (some.train, some.test))


def score_peer(problem: Problem, peer: rules.Peer) -> str:
    began = time.process_time()
    quiet = io.StringIO()
    try:
        with contextlib.redirect_stdout(quiet), contextlib.redirect_stderr(quiet), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            structure, simulator = rules.chosen(peer, problem)
            errors = rules.rmse(simulator, problem.test)
    except Exception as error:  # a tool that fails is a row of the table
        return f"failed ({type(error).__name__}: {error})"[:100]
    share = float(np.mean(errors / np.std(problem.test.y[rules.HEAD :], axis=0)))
    each = " / ".join(f"{error:.3g}" for error in errors)
    spent = time.process_time() - began
    return f"RMSE {errors.mean():.3f} ({share:.3f} of the spread) {each}  {structure}  {spent:.0f} s CPU"


def main() -> None:
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("folder", type=Path)
    words.add_argument("--sets", help="separated by commas; where absent, all whose files are there")
    words.add_argument("--tools", default="", help="whose name begins so, separated by commas")
    given = words.parse_args()
    for name in given.sets.split(",") if given.sets else present(given.folder):
        some = load(given.folder, name)
        problem = problem_of(some)
        rules.HEAD = tools.HEAD = round(some.warmup / problem.dt)  # fewer where the set is short
        for peer in tools.PEERS:
            if peer.name.startswith(tuple(given.tools.split(","))):
                print(f"{name:10s} {peer.name:20s} {score_peer(problem, peer)}", flush=True)


if __name__ == "__main__":
    main()
