"""Step times over the size of a plant and of a horizon, and how often DAQP's own solve goes into each.

    OMP_NUM_THREADS=1 python benchmarks/mpc/sizes.py --quick
    OMP_NUM_THREADS=1 peers/bin/python benchmarks/mpc/sizes.py --peer --markdown sizes.md

Two loops: the reference problem (a Peltier tank, not linear; ``problem.py``), N = 50; and a rod of n masses,
heated at one end, linear, closed on a rod that loses a tenth more: 32, then 28 degC, 150 samples each.

CPU ms, median and worst: of the whole step in C (filter, program, status) and of the program alone in C, both
read in C; of the program in Python; DAQP's own solve of the same run; the step over that (of the reference
problem the program); and do-mpc on the same model, weights and limits (no soft bands), with its defaults and
with IPOPT warm, to 1e-5, its constant derivatives known.
Before a program much else was computed in Python: its memory is cold, that of a step is not.
``--quick`` takes N = 50 alone and half the samples: 50 s.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from floor import Floor
from numpy.typing import NDArray
from ours import Ours
from problem import run_loop
from scipy.linalg import expm
from stopwatch import Stopwatch

from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.design.design import MOST_UNKNOWNS, Design, default_design, make_blocks
from thermogrip.mpc.native.runtime import CompiledController, CompiledOptimiser
from thermogrip.mpc.optimiser.rti import Optimiser, Outcome, Sample
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

Array = NDArray[np.float64]
OURS = ("step, C", "program, C", "program, Python", "DAQP's solve", "times DAQP")
STATES, HORIZONS, SAMPLES = (4, 16, 28, 60), (25, 50, 100, 200), 300


def rod(n: int, loss: float = 0.004) -> Plant:
    """Return n masses in a row, the first heated, the fourth read."""
    flow = np.diag(np.full(n, -loss))
    for k in range(n - 1):
        flow[k : k + 2, k : k + 2] += 0.3 * np.array([[-1.0, 1.0], [1.0, -1.0]])
    whole = np.zeros((n + 1, n + 1))
    whole[:n, :n], whole[0, n] = flow, 1.0
    step, C = expm(whole), np.zeros((1, n))
    C[0, min(3, n - 1)] = 1.0
    model = StateSpaceModel(("q",), (), ("t",), A=step[:n, :n], B=step[:n, n:], C=C, dt=1.0, y0=[25.0])
    return Plant(model, {}, dt=1.0, units={"q": "1", "t": "degC"}, valid={"q": (0.0, 1.0), "t": (20.0, 60.0)})


@dataclass
class Clocked:
    """An optimiser whose solves are timed."""

    optimiser: Optimiser

    def __post_init__(self) -> None:
        self.seconds: list[float] = []
        self._solve: Callable[[Sample], Outcome] = self.optimiser.solve
        vars(self.optimiser)["solve"] = self.solve

    def solve(self, sample: Sample) -> Outcome:
        """Improve a plan."""
        began = time.thread_time()
        found = self._solve(sample)
        self.seconds.append(time.thread_time() - began)
        return found


def design_of(plant: Plant, N: int, blocks: int) -> Design:
    """Return the default design with this horizon; a block a sample where there are as many."""
    lengths = (1,) * N if blocks >= N else make_blocks(N, blocks)
    return replace(default_design(plant, dt=1.0), blocks=lengths, deadline_s=60.0)


def loop(n: int, step: Callable[[float, float], float], samples: int) -> None:
    """Close a loop of (reading, target) -> drive on a rod that is not the model."""
    truth = Controller(rod(n, 0.0044)).model
    x, rng = truth.rest(np.array([25.0]), np.zeros(0)), np.random.default_rng(0)
    for k in range(samples):
        drive = step(float(truth.output(x)[0] + 0.02 * rng.standard_normal()), 32.0 if k < 150 else 28.0)
        x = truth.next_state(x, np.array([drive]), np.zeros(0))


def ours(n: int, N: int, blocks: int, samples: int) -> dict[str, tuple[float, float]]:
    """Return median and worst [ms] of our steps, by what is timed."""
    plant, found = rod(n), dict[str, list[float]]()
    design = design_of(plant, N, blocks)
    for name, compiled in (("Python", False), ("C", True)):
        controller = Controller(plant, design, compiled=compiled)
        clocked = Clocked(controller.optimiser)
        if isinstance(controller.optimiser, CompiledOptimiser):
            watch = Stopwatch()
            controller.optimiser._run = watch.of(controller.optimiser._c.library.tg_host_optimise)
            clocked.seconds = watch.seconds
        else:
            found["DAQP's solve"] = floor(n, plant, design, samples)
        controller.reset({"t": 25.0})
        loop(n, lambda y, r, of=controller: float(of.step({"t": y}, r).drive), samples)
        found[f"program, {name}"] = clocked.seconds
    python = Controller(plant, design)
    python.reset({"t": 25.0})
    whole, watch = CompiledController(python), Stopwatch()
    whole.reset(np.array([25.0]), np.zeros(0), python.observer)
    whole.library.tg_host_step = watch.of_step(whole.library.tg_host_step)

    def step(y: float, r: float) -> float:
        drive, _, _ = whole.step(np.array([y]), np.zeros(0), np.array([r]))
        return float(drive[0])

    loop(n, step, samples)
    found["step, C"] = watch.seconds
    del whole.library.tg_host_step  # the library is another controller's, too
    return in_ms(found)


def floor(n: int, plant: Plant, design: Design, samples: int) -> list[float]:
    """Return DAQP's own seconds for each sample of the loop."""
    controller = Controller(plant, design, compiled=False)
    own = Floor(controller.optimiser.qp)
    controller.reset({"t": 25.0})
    loop(n, lambda y, r: float(controller.step({"t": y}, r).drive), samples)
    return own.seconds


def in_ms(seconds: dict[str, list[float]]) -> dict[str, tuple[float, float]]:
    """Return median and worst [ms] of each list, its first five left out."""
    return {key: (1e3 * float(np.median(v[5:])), 1e3 * float(np.max(v[5:]))) for key, v in seconds.items()}


def reference(blocks: int, samples: int) -> dict[str, tuple[float, float]]:
    """Return the same of the reference problem, whose filter is nobody's."""
    found, watch = dict[str, list[float]](), Stopwatch()
    compiled = Ours(compiled=True, blocks=blocks)
    timed, given = watch.of(compiled.optimiser._c.library.tg_host_replan), compiled.replan.args
    compiled.replan = lambda: timed(*given)
    run_loop(compiled, steps=samples)
    found["program, C"] = watch.seconds
    found["program, Python"] = run_loop(Ours(compiled=False, blocks=blocks), steps=samples).cpu.tolist()
    python = Ours(compiled=False, blocks=blocks)
    own = Floor(python.optimiser.qp)
    run_loop(python, steps=samples)
    found["DAQP's solve"] = own.seconds
    return in_ms(found)


def peer(n: int, N: int, samples: int = 25, *, tuned: bool = False) -> tuple[float, float]:
    """Return the same of do-mpc, its state known."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import do_mpc
    from peers import QUIET, WARM

    constant = dict.fromkeys(("ipopt.hessian_constant", "ipopt.jac_c_constant"), "yes")
    plant = rod(n)
    own, design = Controller(plant).model, design_of(plant, N, N)
    assert own.affine is not None
    A, B, _, added = own.affine
    model = do_mpc.model.Model("discrete")
    x = model.set_variable("_x", "x", (n, 1))
    u, goal = model.set_variable("_u", "u"), model.set_variable("_tvp", "goal")
    model.set_rhs("x", A @ x + B @ u + added.reshape(-1, 1))
    model.setup()
    controller = do_mpc.controller.MPC(model)
    controller.set_param(n_horizon=N, t_step=1.0, n_robust=0, store_full_solution=not tuned)
    controller.set_param(nlpsol_opts=QUIET | (WARM | constant if tuned else {}))
    error = (float(own.output(np.zeros(n))[0]) + (own.C @ x)[0] - goal) ** 2
    controller.set_objective(mterm=design.terminal * error, lterm=design.track * error)
    controller.set_rterm(u=design.move)
    controller.bounds["lower", "_u", "u"], controller.bounds["upper", "_u", "u"] = 0.0, 1.0
    told = controller.get_tvp_template()

    def goals(_now: float) -> object:
        told["_tvp", :] = 32.0
        return told

    controller.set_tvp_fun(goals)
    controller.setup()
    state = own.rest(np.array([25.0]), np.zeros(0)).reshape(-1, 1)
    controller.x0 = state
    controller.set_initial_guess()
    seconds = []
    for _ in range(samples):
        began = time.thread_time()
        drive = controller.make_step(state)
        seconds.append(time.thread_time() - began)
        state = A @ state + B @ drive + added.reshape(-1, 1)
    return 1e3 * float(np.median(seconds[2:])), 1e3 * float(np.max(seconds[2:]))


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--peer", action="store_true", help="do-mpc beside, where each sample is a block")
    parser.add_argument("--states", default=",".join(map(str, STATES)), help="by commas")
    parser.add_argument("--markdown", type=Path, help="also write the table here")
    parser.add_argument("--quick", action="store_true", help="N = 50 alone, half the samples")
    given = parser.parse_args()
    columns = (*OURS, "do-mpc", "do-mpc, tuned")
    lines = [f"| states | N | blocks | {' | '.join(columns)} |", "|---" * (len(columns) + 3) + "|"]
    print(f"5 million additions in Python: {additions():.2f} s", file=sys.stderr)
    print(*lines, sep="\n")
    medians: dict[tuple[int, int, str, str], float] = {}
    sizes, samples = [int(n) for n in given.states.split(",")], SAMPLES // (2 if given.quick else 1)
    for n, N, kind in cases(sizes, quick=given.quick):
        blocks = N if kind == "N" else 10
        found = ours(n, N, blocks, samples) if n else reference(blocks, 2 * samples)
        step = found["step, C" if n else "program, C"][0]
        found["times DAQP"] = step / found["DAQP's solve"][0], np.nan
        if given.peer and kind == "N" and n:
            found["do-mpc"], found["do-mpc, tuned"] = peer(n, N), peer(n, N, tuned=True)
        if n:
            medians |= {(n, N, kind, key): value for key, (value, _) in found.items()}
        texts = [cell(key, found) for key in columns]
        lines.append(f"| {n or 'reference'} | {N} | {blocks} | {' | '.join(texts)} |")
        print(lines[-1], flush=True)
    grown = exponents(medians, columns)
    print(*grown, sep="\n")
    if given.markdown is not None:
        given.markdown.write_text("\n".join([*lines, *grown]) + "\n", encoding="utf-8")


def cases(sizes: Sequence[int], *, quick: bool) -> Iterator[tuple[int, int, str]]:
    """Yield states, samples and kinds of blocks; no states are the reference problem."""
    for n, N in [(0, 50), *((n, N) for n in sizes for N in ((50,) if quick else HORIZONS))]:
        for kind in ("N", "10"):
            if kind == "10" or N <= MOST_UNKNOWNS:
                yield n, N, kind


def cell(key: str, found: dict[str, tuple[float, float]]) -> str:
    """Return a cell of the table."""
    if key not in found:
        return ""
    median, worst = found[key]
    return f"{median:.4f}, {worst:.3f}" if np.isfinite(worst) else f"{median:.1f}"


def additions() -> float:
    """Return the CPU time of five million additions [s]."""
    began, total = time.process_time(), 0
    for i in range(5_000_000):
        total += i
    return time.process_time() - began


def exponents(medians: dict[tuple[int, int, str, str], float], columns: Sequence[str]) -> list[str]:
    """Return lines of how medians by (states, N, kind of blocks, column) grow with N and with the states."""
    lines = ["", f"| grows with | at | blocks | {' | '.join(columns)} |", "|---" * (len(columns) + 3) + "|"]
    for place, name, at in ((1, "N", "states"), (0, "states", "N")):
        for fixed, kind in sorted({(key[1 - place], key[2]) for key in medians}):
            cells = []
            for column in columns:
                seen = [
                    (key[place], value)
                    for key, value in medians.items()
                    if (key[1 - place], key[2], key[3]) == (fixed, kind, column)
                ]
                slope = np.polyfit(*np.log(np.array(seen).T), 1)[0] if len(seen) > 2 else np.nan
                cells.append(f"{slope:.2f}" if np.isfinite(slope) else "")
            if any(cells):
                lines.append(f"| {name} | {fixed} {at} | {kind} | {' | '.join(cells)} |")
    return lines


if __name__ == "__main__":
    main()
