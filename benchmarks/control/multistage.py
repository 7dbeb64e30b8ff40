"""do-mpc's multi-stage example, a reactor whose kinetics are uncertain, beside the same programs here.

    python benchmarks/control/multistage.py [--draws 4] [--steps 50] [--only 1.05] [--peers ours,do-mpc]

The reactor is the van de Vusse CSTR of do-mpc's documentation ("CSTR": A to B to C, 2 A to D, a jacket), with
its numbers, bounds, horizon (20 samples of 18 s), start and uncertainties: alpha, on the activation energy of
the side reaction, in .95, 1, 1.05, and beta, on the rate of the first, in .9, 1, 1.1.  B is to come to 0.6
mol/l, the reactor is to stay below 140 degC, and all states are measured.  The truth below is the equations
once more, by Runge-Kutta steps of half a second, with alpha and beta at the corners and the middle of their
ranges, and drawn evenly in them.

* **do-mpc** as in its example, by its own package: one scenario, or nine that branch once.
* **ours**: the equations as a user's class, do-mpc's weights in shares of the drives' ranges (one weight for
  both drives, the geometric mean of the two), the limit of 140 degC hard, five programs a sample at most, the
  filter with its biases; one scenario, or nine that share the first move (``scenarios.py``).

Figures: the most above 140 degC and for how long, when B stays within 1 % of 0.6 mol/l, the sum of do-mpc's
own stage costs, B's offset in the last ten samples, and milliseconds a step, median and most (CPU).
"""

from __future__ import annotations

import argparse
import time
import warnings
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, ClassVar

import numpy as np
from scenarios import ScenarioOptimiser

from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.design.design import default_design
from thermogrip.sysid.models.user_model import own_model
from thermogrip.sysid.plant.plant import Plant

STEP_S, HORIZON, GOAL, HOTTEST, NEAR = 18.0, 20, 0.6, 140.0, 0.006
START = np.array([0.8, 0.5, 134.14, 130.0])  # A and B [mol/l], reactor and jacket [degC]
LOW, HIGH = np.array([5.0, -8500.0]), np.array([100.0, 0.0])  # inflow [1/h] and heat into the jacket [kJ/h]
ALPHA, BETA = (1.0, 1.05, 0.95), (1.0, 1.1, 0.9)
SCALE, MOVES = np.array([100.0, 2000.0]), np.array([0.1, 1e-3])  # do-mpc's, of a squared move
STATES = ("c_a", "c_b", "t_r", "t_k")


def rates(x: Any, u: Any, alpha: Any, beta: Any, exp: Any) -> list[Any]:
    """Return dx/dt in mol/l and degC an hour."""
    a, b, reactor, jacket = x
    inflow, heat = u
    first = beta * 1.287e12 * exp(-9758.3 / (reactor + 273.15)) * a
    second = 1.287e12 * exp(-9758.3 / (reactor + 273.15)) * b
    side = 9.043e9 * exp(-alpha * 8560.0 / (reactor + 273.15)) * a**2
    warmth, through = 0.9342 * 3.01, 4032.0 * 0.215 * (reactor - jacket)
    made = 4.2 * first - 11.0 * second - 41.85 * side
    return [
        inflow * (5.1 - a) - first - side,
        first - second - inflow * b,
        -made / warmth + inflow * (130.0 - reactor) - through / (warmth * 10.01),
        (heat + through) / 10.0,
    ]


class Reactor:
    """The equations for ``identify``: seconds, and concentrations in mmol/l."""

    inputs: ClassVar[dict[str, Any]] = {
        "inflow": {"unit": "1/h", "range": (5.0, 100.0)},
        "heat": {"unit": "kJ/h", "range": (-8500.0, 0.0)},
    }
    outputs: ClassVar[dict[str, Any]] = {"c_a": "mmol/l", "c_b": "mmol/l", "t_r": "degC", "t_k": "degC"}
    states: ClassVar[dict[str, Any]] = {"c_a": 100.0, "c_b": 50.0, "t_r": 5.0, "t_k": 5.0}
    parameters: ClassVar[dict[str, Any]] = {
        "alpha": {"value": 1.0, "sd_log": 0.03, "unit": "1"},
        "beta": {"value": 1.0, "sd_log": 0.06, "unit": "1"},
    }
    dt = STEP_S / 4

    def rhs(self, x: Any, u: Any, d: Any, p: Any) -> list[Any]:
        """Return dx/dt."""
        mol = (x.c_a / 1000.0, x.c_b / 1000.0, x.t_r, x.t_k)
        a, b, reactor, jacket = rates(mol, (u.inflow, u.heat), p.alpha, p.beta, np.exp)
        return [a / 3.6, b / 3.6, reactor / 3600.0, jacket / 3600.0]


@dataclass
class Run:
    """What became of one truth."""

    x: np.ndarray  # (n + 1, 4, fine) between samples
    u: np.ndarray  # (n, 2)
    ms: np.ndarray
    said: set[str]

    def figures(self) -> tuple[float, ...]:
        """Return what the module's text says."""
        over = np.maximum(self.x[:, 2] - HOTTEST, 0.0)
        at = self.x[::36]  # samples
        off = np.abs(self.x[:, 1] - GOAL)
        last = np.flatnonzero(off > NEAR)
        settled = 0.5 * (last[-1] + 1) if last.size and last[-1] + 1 < len(off) else np.nan * bool(last.size)
        moves = np.diff(self.u, axis=0) / SCALE
        cost = float(np.sum((at[1:, 1] - GOAL) ** 2) + np.sum(moves**2 * MOVES))
        offset = float(np.mean(at[-10:, 1] - GOAL))
        return float(over.max()), 0.5 * float(np.count_nonzero(over > 0)), settled, cost, offset


def truth(alpha: float, beta: float, step: Any, steps: int) -> Run:
    """Close a loop: ``step`` answers a state (4,) with drives (2,)."""
    x, rows, moves, ms, said = START.copy(), [START.copy()], [], [], set()
    for _ in range(steps):
        begin = time.process_time()
        u, status = step(x)
        ms.append(1e3 * (time.process_time() - begin))
        u = np.clip(np.asarray(u, dtype=float), LOW, HIGH)
        moves.append(u)
        said.add(status)
        h = 0.5 / 3600.0
        for _ in range(36):
            k = []
            for part in (0.0, 0.5, 0.5, 1.0):
                now = x + part * h * k[-1] if k else x
                k.append(np.array(rates(now, u, alpha, beta, np.exp)))
            x = x + h / 6 * (k[0] + 2 * k[1] + 2 * k[2] + k[3])
            rows.append(x.copy())
    return Run(np.array(rows), np.array(moves), np.array(ms), said)


def ours(many: bool) -> Any:
    """Return a step of the package's controller."""
    model = own_model(Reactor)
    drives = dict(zip(("inflow", "heat"), zip(LOW.tolist(), HIGH.tolist())))
    valid = drives | {
        "c_a": (500.0, 1500.0),
        "c_b": (400.0, 900.0),
        "t_r": (120.0, 140.0),
        "t_k": (110.0, 140.0),
    }
    noise = {"c_a": 0.5, "c_b": 0.5, "t_r": 0.05, "t_k": 0.05}
    plant = Plant(
        model, {"alpha": 1.0, "beta": 1.0}, dt=model.dt, units=model.units, valid=valid, noise=noise
    )
    share = MOVES * ((HIGH - LOW) / SCALE) ** 2 * 1e6  # of squared mmol/l
    limits = {"c_a": (100.0, 2000.0), "c_b": (100.0, 2000.0), "t_r": (50.0, HOTTEST), "t_k": (50.0, 140.0)}
    design = default_design(
        plant, controlled=("c_b",), dt=STEP_S, blocks=(1,) * HORIZON, move=float(np.sqrt(np.prod(share))),
        slew_per_s={name: (high - low) / STEP_S for name, (low, high) in drives.items()}, terminal=1.0,
        limits=limits, hard=("t_r", "t_k"), overshoot=1e3, deadline_s=STEP_S, iterations=5,
    )  # fmt: skip
    controller = Controller(plant, design)
    if many:
        pairs = [dict(zip(("alpha", "beta"), pair)) for pair in product(ALPHA, BETA)]
        controller.optimiser = ScenarioOptimiser(
            [replace(plant, values=pair) for pair in pairs], design, own=True
        )
    begun: list[float] = []

    def step(x: np.ndarray) -> tuple[np.ndarray, str]:
        shown = dict(zip(STATES, (x * [1e3, 1e3, 1.0, 1.0]).tolist()))
        if not begun:
            controller.reset(shown | {"inflow": 5.0, "heat": 0.0})
            still = np.zeros(len(controller.observer.w))
            controller.observer.found_offset = np.zeros(4)
            controller.observer.begin_again(np.array(list(shown.values())), still, np.full(4, 0.01))
            begun.append(1.0)
        move = controller.step(shown, 1e3 * GOAL)
        return np.array(move.drives(("inflow", "heat"))), move.status

    return step


def peer(many: bool) -> Any:
    """Return a step of do-mpc's example."""
    import casadi as ca
    import do_mpc

    model = do_mpc.model.Model("continuous", "SX")
    x = [model.set_variable("_x", name) for name in ("C_a", "C_b", "T_R", "T_K")]
    u = [model.set_variable("_u", name) for name in ("F", "Q")]
    p = [model.set_variable("_p", name) for name in ("alpha", "beta")]
    for name, rate in zip(("C_a", "C_b", "T_R", "T_K"), rates(x, u, *p, ca.exp)):
        model.set_rhs(name, rate)
    model.setup()
    mpc = do_mpc.controller.MPC(model)
    settings = mpc.settings
    settings.n_horizon, settings.n_robust, settings.t_step = HORIZON, int(many), STEP_S / 3600.0
    settings.state_discretization, settings.collocation_type = "collocation", "radau"
    settings.collocation_deg, settings.collocation_ni = 2, 1
    settings.store_full_solution = False
    settings.supress_ipopt_output()
    mpc.scaling["_x", "T_R"] = mpc.scaling["_x", "T_K"] = 100
    mpc.scaling["_u", "Q"], mpc.scaling["_u", "F"] = SCALE[1], SCALE[0]
    off = (model.x["C_b"] - GOAL) ** 2
    mpc.set_objective(mterm=off, lterm=off)
    mpc.set_rterm(F=MOVES[0], Q=MOVES[1])
    for name, low, high in (("C_a", 0.1, 2.0), ("C_b", 0.1, 2.0), ("T_R", 50.0, None), ("T_K", 50.0, 140.0)):
        mpc.bounds["lower", "_x", name] = low
        if high is not None:
            mpc.bounds["upper", "_x", name] = high
    for at, name in enumerate(("F", "Q")):
        mpc.bounds["lower", "_u", name], mpc.bounds["upper", "_u", name] = LOW[at], HIGH[at]
    mpc.set_nl_cons("T_R", model.x["T_R"], ub=HOTTEST, soft_constraint=True, penalty_term_cons=1e2)
    mpc.set_uncertainty_values(
        alpha=np.array(ALPHA if many else ALPHA[:1]), beta=np.array(BETA if many else BETA[:1])
    )
    mpc.setup()
    begun: list[float] = []

    def step(state: np.ndarray) -> tuple[np.ndarray, str]:
        if not begun:
            mpc.x0 = state.reshape(-1, 1)
            mpc.set_initial_guess()
            begun.append(1.0)
        u = mpc.make_step(state.reshape(-1, 1)).ravel()
        return u, "ok" if mpc.solver_stats["success"] else "failed"

    return step


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=4)
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--peers", default="ours,do-mpc")
    parser.add_argument("--only", default="", help="a text that the truth's name has")
    asked = parser.parse_args()
    warnings.simplefilter("ignore")
    rng = np.random.default_rng(0)
    truths = [(1.0, 1.0), *product(ALPHA[1:], BETA[1:])]
    truths += [(rng.uniform(0.95, 1.05), rng.uniform(0.9, 1.1)) for _ in range(asked.draws)]
    print("alpha, beta: most above 140 degC; s above; settled s; cost; offset mol/l; ms median, most; said")
    whole: dict[str, list[tuple[float, ...]]] = {}
    for alpha, beta in truths:
        name = f"{alpha:.3f} {beta:.3f}"
        if asked.only not in name:
            continue
        for kind, make in (("ours", ours), ("do-mpc", peer)):
            for many in (False, True) if kind in asked.peers.split(",") else ():
                run = truth(alpha, beta, make(many), asked.steps)
                label, found = f"{kind} {9 if many else 1}", run.figures()
                spent = float(np.median(run.ms[1:])), float(np.max(run.ms[1:]))
                whole.setdefault(label, []).append((*found, *spent))
                over, long, settled, cost, offset = found
                print(
                    f"{name} {label:9}: {over:5.2f}; {long:5.0f}; {settled:5.0f}; {cost:.4f}; {offset:+.4f}; "
                    f"{spent[0]:.0f}, {spent[1]:.0f}; {', '.join(sorted(run.said))}",
                    flush=True,
                )
    for label, rows in whole.items():
        over, long, settled, cost, offset, median, most = np.array(rows).T
        late = f"{np.nanmean(settled):.0f} ({np.count_nonzero(np.isnan(settled))} never)"
        print(
            f"all {len(rows)} {label}: {over.max():.2f}; {long.mean():.0f}; {late}; {cost.mean():.4f}; "
            f"{np.abs(offset).max():.4f}; {np.median(median):.0f}, {most.max():.0f}"
        )


if __name__ == "__main__":
    main()
