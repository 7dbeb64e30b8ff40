"""Other people's controllers of the reference problem: same model, weights, limits and estimates as ours.

Each class is called as :data:`problem.Answer`.  All but GEKKO and do-mpc solve the very same program: a soft
row costs 50 (s + s^2) at each sample.  do-mpc has one slack a limit, linear; GEKKO has none, and its own
delay and its own discretisation, as its users write it.
"""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Mapping
from functools import partial
from typing import Any

import casadi as ca
import numpy as np
from dompc_values import hold_over_horizon
from numpy.typing import NDArray
from ours import Ours
from problem import DRIVE, DT, HORIZON, LAST, MODEL, MOVE, PRICE, SLEW, TANK, TRACK, ReferenceModel

__all__ = ["PEERS", "DoMPC", "Gekko", "Osqp", "Program"]

Array = NDArray[np.float64]

if hasattr(ca.GlobalOptions, "setNumpyMode"):
    ca.GlobalOptions.setNumpyMode(-1)


QUIET = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": 0}
#: IPOPT from the last solution, to 1e-5 in place of 1e-8: of seven settings that were tried the fastest.
WARM = {
    "ipopt.warm_start_init_point": "yes",
    "ipopt.warm_start_bound_push": 1e-6,
    "ipopt.warm_start_mult_bound_push": 1e-6,
    "ipopt.mu_init": 1e-5,
    "ipopt.tol": 1e-5,
}


class DoMPC:
    """do-mpc with its defaults: collocation off (the model is discrete), IPOPT; or with other settings of it,
    and nothing stored but the plan."""

    def __init__(self, settings: Mapping[str, object] | None = None) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import do_mpc
        own = ReferenceModel(MODEL)
        m = do_mpc.model.Model("discrete")
        x = [m.set_variable("_x", f"x{i}") for i in range(own.n_x)]
        before = m.set_variable("_x", "before")
        u = m.set_variable("_u", "u")
        given = {name: m.set_variable("_tvp", name) for name in ("q0", "q1", "goal", "low", "high")}
        after = own.step(x, [u], (given["q0"], given["q1"]), (), DT)
        for i, value in enumerate(after):
            m.set_rhs(f"x{i}", value)
        m.set_rhs("before", u)
        m.setup()
        c = do_mpc.controller.MPC(m)
        c.set_param(n_horizon=HORIZON, t_step=DT, n_robust=0, store_full_solution=settings is None)
        c.set_param(nlpsol_opts=QUIET | dict(settings or {}))
        error = (x[4] - given["goal"]) ** 2
        c.set_objective(mterm=LAST * error, lterm=TRACK * error + DRIVE * u**2 + MOVE * (u - before) ** 2)
        c.set_rterm(u=0.0)
        c.bounds["lower", "_u", "u"], c.bounds["upper", "_u", "u"] = -5.0, 5.0
        c.set_nl_cons("up", u - before, ub=SLEW)
        c.set_nl_cons("down", before - u, ub=SLEW)
        soft = {"soft_constraint": True, "penalty_term_cons": PRICE}
        c.set_nl_cons("hot", x[2], ub=TANK[1], **soft)
        c.set_nl_cons("cold", -x[2], ub=-TANK[0], **soft)
        c.set_nl_cons("above", x[4] - given["high"], ub=0, **soft)
        c.set_nl_cons("below", given["low"] - x[4], ub=0, **soft)
        self.values: dict[str, float] = dict.fromkeys(given, 0.0)
        hold_over_horizon(c, HORIZON, lambda: self.values)
        c.setup()
        self.c, self.first = c, True

    def __call__(self, x: Array, q: Array, before: float, goal: float, low: float, high: float) -> float:
        self.values = {"q0": q[0], "q1": q[1], "goal": goal, "low": low, "high": high}
        state = np.append(x, before)
        if self.first:
            self.c.x0 = state
            self.c.set_initial_guess()
            self.first = False
        return float(self.c.make_step(state).ravel()[0])


class Program:
    """The multiple-shooting program in CasADi, stage by stage, for IPOPT and fatrop."""

    def __init__(self, solver: str, options: dict[str, Any], *, keep_duals: bool) -> None:
        own = ReferenceModel(MODEL)
        n, self.n = own.n_x + 1, own.n_x + 1
        p = ca.SX.sym("p", n + 5)  # state with the current before, heat flows, goal, low, high
        q, goal, low, high = p[n : n + 2], p[n + 2], p[n + 3], p[n + 4]
        z, g, lower, upper, equal = [], [], [], [], []
        self.z_low, self.z_high, cost = [], [], 0
        states = [ca.SX.sym(f"x{k}", n) for k in range(HORIZON + 1)]

        def row(value: Any, a: float, b: float) -> None:
            g.append(value)
            lower.extend([a] * value.numel())
            upper.extend([b] * value.numel())
            equal.extend([a == b] * value.numel())

        for k in range(HORIZON + 1):
            x, last = states[k], k == HORIZON
            s = ca.SX.sym(f"s{k}", 0 if last else 2)  # fatrop wants no control at the last stage
            u = None if last else ca.SX.sym(f"u{k}")
            z += [x, s] if last else [x, u, s]
            self.z_low += [-np.inf] * n + ([] if last else [-5.0, 0.0, 0.0])
            self.z_high += [np.inf] * n + ([] if last else [5.0, np.inf, np.inf])
            if not last:
                after = own.step(ca.vertsplit(x)[:-1], [u], (q[0], q[1]), (), DT)
                row(states[k + 1] - ca.vertcat(*after, u), 0.0, 0.0)
                cost += DRIVE * u**2 + MOVE * (u - x[n - 1]) ** 2
            if k == 0:
                row(x - p[:n], 0.0, 0.0)
            if not last:
                row(u - x[n - 1], -SLEW, SLEW)
            if k:
                cost += (LAST if last else TRACK) * (x[4] - goal) ** 2
            if k and not last:
                row(x[4] - s[0] - high, -np.inf, 0.0)
                row(x[4] + s[0] - low, 0.0, np.inf)
                row(x[2] - s[1], -np.inf, TANK[1])
                row(x[2] + s[1], TANK[0], np.inf)
            if not last:
                cost += PRICE * (ca.sum1(s) + ca.sumsqr(s))
        nlp = {"x": ca.vertcat(*z), "p": p, "f": cost, "g": ca.vertcat(*g)}
        if solver == "fatrop":
            options = options | {
                "structure_detection": "manual",
                "equality": equal,
                "N": HORIZON,
                "nx": [n] * (HORIZON + 1),
                "nu": [3] * HORIZON + [0],
                "ng": [n + 1] + [5] * (HORIZON - 1) + [0],
            }
        self.solver = ca.nlpsol("program", solver, nlp, options)
        self.g_low, self.g_high = lower, upper
        self.guess: Array | None = None
        self.duals: dict[str, Any] = {}
        self.keep_duals, self.stride = keep_duals, n + 3

    def __call__(self, x: Array, q: Array, before: float, goal: float, low: float, high: float) -> float:
        state = np.append(x, before)
        if self.guess is None:
            stage = np.concatenate([state, [before, 0.0, 0.0]])
            self.guess = np.concatenate([np.tile(stage, HORIZON), state])
        p = np.concatenate([state, q, [goal, low, high]])
        bounds = {"lbx": self.z_low, "ubx": self.z_high, "lbg": self.g_low, "ubg": self.g_high}
        found = self.solver(x0=self.guess, p=p, **bounds, **self.duals)
        if not self.solver.stats()["success"]:
            return float("nan")
        answer = np.asarray(found["x"]).ravel()
        if self.keep_duals:
            self.duals = {"lam_x0": found["lam_x"], "lam_g0": found["lam_g"]}
        shifted = answer.copy()  # by a sample; the last two stages stay
        shifted[: self.stride * (HORIZON - 1)] = answer[self.stride : self.stride * HORIZON]
        self.guess = shifted
        return float(answer[self.n])


def _quiet(solver: str, **more: Any) -> dict[str, Any]:
    return {f"{solver}.print_level": 0, "print_time": 0, "error_on_fail": False, "expand": True, **more}


def ipopt() -> Program:
    """IPOPT as CasADi calls it."""
    return Program("ipopt", _quiet("ipopt", **{"ipopt.sb": "yes"}), keep_duals=False)


def ipopt_warm() -> Program:
    """IPOPT started from the last answer and its multipliers."""
    warm = {
        "ipopt.sb": "yes",
        "ipopt.warm_start_init_point": "yes",
        "ipopt.mu_init": 1e-4,
        "ipopt.warm_start_bound_push": 1e-8,
        "ipopt.warm_start_mult_bound_push": 1e-8,
        "ipopt.warm_start_slack_bound_push": 1e-8,
        "ipopt.tol": 1e-6,
    }
    return Program("ipopt", _quiet("ipopt", **warm), keep_duals=True)


def fatrop() -> Program:
    """fatrop, which knows the stages."""
    return Program("fatrop", _quiet("fatrop", **{"fatrop.mu_init": 1e-3}), keep_duals=False)


class Osqp(Ours):
    """Our condensing, with OSQP for its program: a slack for each soft row."""

    def __init__(self) -> None:
        super().__init__()
        self.optimiser.qp = _OsqpProgram(self.optimiser.qp.soft)  # type: ignore[assignment]


class _OsqpProgram:
    def __init__(self, soft: NDArray[np.bool_]) -> None:
        self.soft, self.problem = soft, None

    def forget(self) -> None:
        self.problem = None

    def solve(self, H: Array, f: Array, A: Array, lower: Array, upper: Array) -> Any:
        import osqp
        from scipy import sparse

        from thermogrip.mpc.optimiser.qp import QPAnswer

        n, s = len(f), int(self.soft.sum())
        P = sparse.block_diag([sparse.csc_matrix(np.triu(H)), 2 * PRICE * sparse.eye(s)], format="csc")
        rows = np.zeros((len(A) + 2 * s, n + s))
        rows[: len(A), :n] = A
        soft = np.flatnonzero(self.soft)
        rows[soft, n + np.arange(s)] = -1.0  # a'x - s <= upper
        rows[len(A) + np.arange(s), :n] = A[soft]
        rows[len(A) + np.arange(s), n + np.arange(s)] = 1.0  # a'x + s >= lower
        rows[len(A) + s + np.arange(s), n + np.arange(s)] = 1.0
        low = np.concatenate([np.where(self.soft, -np.inf, lower), lower[soft], np.zeros(s)])
        high = np.concatenate([upper, np.full(2 * s, np.inf)])
        linear = np.concatenate([f, np.full(s, PRICE)])
        if self.problem is None:  # entries that may ever be other than 0, so that the numbers alone change
            self.pattern = rows != 0.0
            self.pattern[soft, :n] = self.pattern[len(A) : len(A) + s, :n] = True
        columns, at = np.nonzero(self.pattern.T)
        begins = np.searchsorted(columns, np.arange(n + s + 1))
        matrix = sparse.csc_matrix((rows.T[self.pattern.T], at, begins), shape=rows.shape)
        with contextlib.redirect_stdout(io.StringIO()):
            if self.problem is None:
                self.problem = osqp.OSQP()
                self.problem.setup(
                    P, linear, matrix, low, high, verbose=False, eps_abs=1e-5, eps_rel=1e-5, max_iter=20000
                )
            else:
                self.problem.update(Px=P.data, Ax=matrix.data, q=linear, l=low, u=high)
            found = self.problem.solve(raise_error=False)
        good = found.info.status in ("solved", "solved inaccurate")
        none = np.zeros(len(lower))
        return QPAnswer(found.x[:n], "solved" if good else found.info.status, found.info.iter, none, none)


class Gekko:
    """GEKKO, control mode 6, its local IPOPT, its own delay objects."""

    def __init__(self) -> None:
        from gekko import GEKKO

        own, m = ReferenceModel(MODEL), GEKKO(remote=False)
        m.time = np.arange(HORIZON + 1) * DT
        names = ("h", "c", "w", "f", "s")
        x = [m.Var(value=25.0, name=name) for name in names]
        x[4] = m.CV(value=25.0, name="skin")
        u = m.MV(value=0.0, lb=-5.0, ub=5.0)
        u.STATUS, u.DMAX, u.DCOST = 1, SLEW, 0.0
        q = [m.Param(value=0.0), m.Param(value=0.0)]
        room, keeps = own.numbers["a"], own.keeps
        there, back = m.Var(value=25.0), m.Var(value=25.0)
        m.delay(x[2], there, own.cells)
        m.delay(x[3], back, own.cells)
        e, b = room + keeps * (there - room), room + keeps * (back - room)
        for value, slope in zip(x, own.rhs(x, u, q, e, b), strict=True):
            m.Equation(value.dt() == slope)
        self.goal = m.Param(value=25.0)
        before = m.Var(value=0.0)
        m.delay(u, before, 1)
        m.Minimize(TRACK * (x[4] - self.goal) ** 2 + DRIVE * u**2 + MOVE * (u - before) ** 2)
        m.options.IMODE, m.options.SOLVER, m.options.NODES = 6, 3, 2
        self.m, self.x, self.u, self.q = m, x, u, q

    def __call__(self, x: Array, q: Array, before: float, goal: float, low: float, high: float) -> float:
        for variable, value in zip(self.x, x[:5], strict=True):
            variable.value = float(value)
        for parameter, value in zip(self.q, q, strict=True):
            parameter.value = float(value)
        self.goal.value = goal
        self.m.solve(disp=False)
        return float(self.u.NEWVAL)


PEERS = {
    "do-mpc, defaults": DoMPC,
    "do-mpc, tuned": partial(DoMPC, WARM),
    "CasADi + IPOPT": ipopt,
    "CasADi + IPOPT, warm": ipopt_warm,
    "CasADi + fatrop": fatrop,
    "condensed + OSQP": Osqp,
    "GEKKO": Gekko,
}
