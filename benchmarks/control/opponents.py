"""Who else could control it: PI by Skogestad's rule from the same logs, and do-mpc on the same model.

**SIMC.** Each output is fitted by a first-order model with delay from each input and measured disturbance,
all at once, on all logs (delays on a grid, by coordinate descent).  A loop's settings follow from its own
pair, with tau_c = delay; nothing else is tuned.  The integrator is held while the drive is limited.

**do-mpc.** The plant that ``identify`` kept, the weights and horizon of its default design, a move in every
sample, limits of range and slew, and a plain Kalman filter with a bias for each drive.
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

from thermogrip.mpc.design.design import Design
from thermogrip.mpc.plant.prediction import PredictionModel, prediction_model
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


class PlainFilter:
    """An extended Kalman filter of a plant's states and one bias for each drive, as a user of do-mpc writes
    it: white noise of 3 % of a drive's range on its way to the states, a bias that drifts by 1 % a sample."""

    def __init__(self, model: PredictionModel) -> None:
        self.model, n, m = model, model.n_x, model.n_u
        self.H = np.hstack([model.C, np.zeros((model.n_y, m))])
        known = model.plant.noise | model.plant.scores.reading_sd  # the sensor's noise
        self.R = np.diag([known[name] ** 2 for name in model.outputs])
        self.P, self.n, self.m = np.eye(n + m), n, m

    def reset(self, y: Array, u: Array, d: Array) -> None:
        """Start where the plant rests under drives u, with the bias that its reading is then off by."""
        x = self.model.rest(y, d)
        for _ in range(2000):
            x = self.model.next_state(x, u, d)
        self.z, self.P = np.concatenate([x, np.zeros(self.m)]), np.diag([1e-6] * self.n + [0.0] * self.m)
        self.offset = y - self.model.output(x)

    def update(self, y: Array) -> None:
        """Correct the estimate with a reading."""
        K = self.P @ self.H.T @ np.linalg.inv(self.H @ self.P @ self.H.T + self.R)
        self.z = self.z + K @ (y - self.offset - self.model.output(self.z[: self.n]))
        self.P = self.P - K @ self.H @ self.P

    def predict(self, u: Array, d: Array) -> None:
        """Go a sample on."""
        step = self.model.linearise(self.z[: self.n], u + self.z[self.n :] * self.model.span, d)
        B, one, none = step.B * self.model.span, np.eye(self.m), np.zeros((self.m, self.n))
        F, G = np.block([[step.A, B], [none, one]]), np.block([[0.03 * B, 0 * B], [0 * one, 0.01 * one]])
        self.z, self.P = np.concatenate([step.after, self.z[self.n :]]), F @ self.P @ F.T + G @ G.T


class DoMPC:
    """do-mpc with IPOPT on the identified plant."""

    def __init__(self, plant: Model, design: Design, rest: Sequence[float]) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import do_mpc
        self.model = own = prediction_model(plant, design.dt)
        self.filter, N = PlainFilter(own), sum(design.blocks)
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
        weights = [design.weights.get(name, 1.0) for name in design.controlled]
        error = sum(w * (y[i] - tv[f"e{k}"]) ** 2 for k, (i, w) in enumerate(zip(rows, weights, strict=True)))
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
        self.rest = np.array(rest)[own.drive_index]
        self.u: Array = self.rest

    def reset(self, reading: Mapping[str, float]) -> None:
        """Begin."""
        self.u, self.first = self.rest, True
        self.filter.reset(*self._read(reading, self.rest))

    def _read(self, reading: Mapping[str, float], u: Array) -> tuple[Array, Array, Array]:
        own = self.model
        y, d = (np.array([reading[name] for name in names]) for names in (own.outputs, own.disturbances))
        return y, u, d

    def step(self, reading: Mapping[str, float], target: float | Sequence[float]) -> tuple[list[float], str]:
        """Return the drives and a status; a sequence is a target with those ahead."""
        y, _, d = self._read(reading, self.u)
        if not self.first:
            self.filter.update(y)
        x, bias = self.filter.z[: self.filter.n], self.filter.z[self.filter.n :] * self.model.span
        ahead = [np.ravel(target) - self.filter.offset[row] for row in self.rows]
        self.values = dict(zip(self.keys, [*bias, *d, *ahead], strict=True))
        state = np.concatenate([x, self.u])
        if self.first:
            self.c.x0, self.c.u0, self.first = state, self.u, False
            self.c.set_initial_guess()
        self.u = np.asarray(self.c.make_step(state), dtype=float).ravel()
        self.filter.predict(self.u, d)
        return self.u.tolist(), "ok" if self.c.solver_stats["success"] else "failed"
