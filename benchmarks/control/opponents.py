"""Who else could control it: PI by Skogestad's rule from the same logs, and do-mpc on the same model.

**SIMC.** Each output is fitted by a first-order model with delay from each input and measured disturbance,
all at once, on all logs (delays on a grid, by coordinate descent).  A loop's settings follow from its own
pair, with tau_c = delay; nothing else is tuned.  The integrator is held while the drive is limited.

**do-mpc.** The plant that ``identify`` kept, the weights and horizon of its default design, a move in every
sample, limits of range and slew; states and disturbances come from the package's filter.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.signal import lfilter
from truths import Case

sys.path.insert(0, str(Path(__file__).parents[1] / "mpc"))
from dompc_values import hold_over_horizon

from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.design.design import Design
from thermogrip.sysid.plant.plant import Plant as Model

Array = NDArray[np.float64]
Columns = Mapping[str, Array]


@dataclass(frozen=True)
class FirstOrder:
    """A gain, a lag [s] and a delay [s]."""

    gain: float
    lag: float
    delay: float


def first_order(case: Case, logs: Sequence[tuple[Array, Columns]], output: str) -> dict[str, FirstOrder]:
    """Return what each moving input and measured disturbance does to an output."""
    sources = [s.name for s in (*case.inputs, *case.disturbances) if s.name not in case.switches]
    dt, most = case.log_dt, logs[0][0][-1] / 2
    delays, lags = dict.fromkeys(sources, 0.0), dict.fromkeys(sources, 10 * dt)

    def columns(log: Columns, lags: Mapping[str, float]) -> Array:
        parts = []
        for name in sources:
            k, a = round(delays[name] / dt), float(np.exp(-dt / lags[name]))
            u = log[name] - log[name][0]
            u = np.concatenate([np.zeros(k + 1), u[: len(u) - k - 1]])
            parts.append(lfilter([1 - a], [1, -a], u))
        return np.column_stack(parts)

    def residuals(z: Array) -> Array:
        now = dict(zip(sources, np.exp(z).tolist(), strict=True))
        A = [np.hstack([columns(log, now), np.zeros((len(t), len(logs)))]) for t, log in logs]
        for i, part in enumerate(A):
            part[:, len(sources) + i] = 1.0
        A, y = np.vstack(A), np.concatenate([log[output] for _, log in logs])
        size = np.maximum(np.linalg.norm(A, axis=0), 1e-12)
        found = np.linalg.lstsq(A / size, y, rcond=None)[0] / size
        residuals.gains = found[: len(sources)]  # type: ignore[attr-defined]
        return A @ found - y

    def fit() -> tuple[float, Array]:
        start = np.log([min(max(lags[n], 1.1 * dt), 0.9 * most * 20) for n in sources])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = least_squares(residuals, start, bounds=(np.log(dt), np.log(20 * most)), max_nfev=25)
        return float(found.cost), np.exp(found.x)

    best, values = np.inf, np.zeros(len(sources))
    for factor in (10.0, 60.0, 300.0):  # of the first guess at the lags
        lags.update(dict.fromkeys(sources, factor * dt))
        cost, found = fit()
        if cost < best:
            best, values = cost, found
    lags.update(zip(sources, values.tolist(), strict=True))
    grid = [k * dt for k in (0, 1, 2, 3, 4, 6, 8, 10, 12, 14, 16, 20, 25, 30)]
    for _ in range(2):
        for name in sources:
            kept = delays[name]
            for value in grid:
                delays[name], before = value, dict(lags)
                cost, found = fit() if value != kept else (best, np.array(list(lags.values())))
                if cost < best * (1 - 1e-6):
                    best, kept = cost, value
                    lags.update(zip(sources, found.tolist(), strict=True))
                else:
                    lags.update(before)
            delays[name] = kept
    residuals(np.log([lags[n] for n in sources]))
    gains = residuals.gains  # type: ignore[attr-defined]
    return {n: FirstOrder(float(g), lags[n], delays[n] + dt / 2) for n, g in zip(sources, gains, strict=True)}


class SimcPI:
    """A PI loop for each pair, in the plant's inputs, about the drive at which it starts."""

    def __init__(self, case: Case, models: Mapping[str, FirstOrder], dt: float) -> None:
        self.case, self.dt, self.loops = case, dt, []
        names = [s.name for s in case.inputs]
        for drive, output in case.pairs:
            m = models[output]
            delay = max(m.delay, dt)
            Kc = m.lag / (m.gain * 2 * delay)
            at = names.index(drive)
            low, high = case.inputs[at].low, case.inputs[at].high
            self.loops.append((at, output, Kc, min(m.lag, 8 * delay), low, high))
        self.sum = [0.0] * len(self.loops)

    def reset(self, reading: Mapping[str, float]) -> None:
        """Begin."""
        self.sum = [0.0] * len(self.loops)

    def step(self, reading: Mapping[str, float], target: float) -> tuple[list[float], str]:
        """Return the inputs and a status."""
        u = list(self.case.rest)
        for k, (at, output, Kc, Ti, low, high) in enumerate(self.loops):
            error = target - reading[output]
            wanted = self.case.rest[at] + Kc * error + self.sum[k] + Kc / Ti * self.dt * error
            u[at] = float(np.clip(wanted, low, high))
            if u[at] == wanted or (wanted - u[at]) * Kc * error < 0:
                self.sum[k] += Kc / Ti * self.dt * error
        return u, "ok"


class DoMPC:
    """do-mpc with IPOPT on the identified plant."""

    def __init__(self, plant: Model, design: Design) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import do_mpc
        self.own = Controller(plant, design)  # its filter alone is used
        own, N = self.own.model, sum(design.blocks)
        m = do_mpc.model.Model("discrete")
        x = [m.set_variable("_x", f"x{i}") for i in range(own.n_x)]
        before = [m.set_variable("_x", f"before{j}") for j in range(own.n_u)]
        u = [m.set_variable("_u", f"u{j}") for j in range(own.n_u)]
        self.keys = [f"w{j}" for j in range(own.n_u)] + [f"d{k}" for k in range(own.n_d)]
        self.keys += [f"e{i}" for i in range(len(design.controlled))]  # target less the bias of an output
        tv = {key: m.set_variable("_tvp", key) for key in self.keys}
        full = [ca.SX(1.0)] * len(own.model.inputs)
        for j, at in enumerate(own.drive_index):
            full[at] = u[j] + tv[f"w{j}"]
        state = list(x)
        for _ in range(own.sub):
            d = [tv[f"d{k}"] for k in range(own.n_d)]
            state = list(own.model.step(state, full, d, own.p.tolist(), own.dt / own.sub))
        for i, value in enumerate(state):
            m.set_rhs(f"x{i}", value)
        for j in range(own.n_u):
            m.set_rhs(f"before{j}", u[j])
        m.setup()
        c = do_mpc.controller.MPC(m)
        c.set_param(n_horizon=N, t_step=own.dt, n_robust=0, store_full_solution=False)
        quiet = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": 0}
        c.set_param(nlpsol_opts=quiet)
        rows = [own.outputs.index(name) for name in design.controlled]
        y = own.model.output(x, own.p.tolist())
        error = sum((y[i] - tv[f"e{k}"]) ** 2 for k, i in enumerate(rows))
        moves = sum(((u[j] - before[j]) / float(own.span[j])) ** 2 for j in range(own.n_u))
        c.set_objective(mterm=design.terminal * error, lterm=design.track * error + design.move * moves)
        c.set_rterm(**{f"u{j}": 0.0 for j in range(own.n_u)})
        for j, name in enumerate(own.drives):
            c.bounds["lower", "_u", f"u{j}"], c.bounds["upper", "_u", f"u{j}"] = design.drive_range[name]
            slew = design.slew_per_s[name] * own.dt
            c.set_nl_cons(f"up{j}", u[j] - before[j], ub=slew)
            c.set_nl_cons(f"down{j}", before[j] - u[j], ub=slew)
        self.values = dict.fromkeys(self.keys, 0.0)
        hold_over_horizon(c, N, lambda: self.values)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            c.setup()
        self.c, self.dt, self.rows, self.first = c, own.dt, rows, True
        self.u: Array = own.neutral.copy()

    def reset(self, reading: Mapping[str, float]) -> None:
        """Begin."""
        self.own.reset(reading)
        self.first = True

    def step(self, reading: Mapping[str, float], target: float) -> tuple[list[float], str]:
        """Return the drives and a status."""
        observer, own = self.own.observer, self.own.model
        y = np.array([reading[name] for name in own.outputs])
        d = np.array([reading[name] for name in own.disturbances])
        if not self.first:
            observer.update(y)
        bias = observer.output_bias[self.rows]
        values = [*observer.drive_bias, *(d + observer.disturbance_bias), *(target - bias)]
        self.values = dict(zip(self.keys, map(float, values), strict=True))
        state = np.concatenate([observer.x, self.u])
        if self.first:
            self.c.x0 = state
            self.c.u0 = self.u
            self.c.set_initial_guess()
            self.first = False
        self.u = np.asarray(self.c.make_step(state), dtype=float).ravel()
        status = "ok" if self.c.solver_stats["success"] else "failed"
        observer.predict(self.u, d)
        return self.u.tolist(), status
