r"""The state of a rig, estimated from its readings, and the minutes that led there.

State x, a bias w on each drive (a fraction of half its range) and a bias b on each output but the reference
(thermocouples are plugged anew) follow

    x+ = f(x, u + w, d),    w+ = w + noise,    b+ = b + noise,    y = h(x) + y0 + b + noise,

an extended Kalman filter of z = (x, w, b), with the model's own Jacobian F by differences.  An estimate is
kept with the number of its native step, so that it can be simulated again under what was applied since.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.rig.guard.sensor_checks import room_disturbances
from thermogrip.rig.guard.settings import ModelSettings
from thermogrip.rig.interface import range_of
from thermogrip.sysid.plant.plant import Plant

LARGEST_DRIVE_BIAS = 0.5  # a driver that gives half, or half more, is at fault in any case


@dataclass(frozen=True)
class StartSettings:
    """Standard deviations at a start from rest."""

    state_K: float = 0.5  # of the state that moves most
    drive: float = 0.03  # of a drive's bias, in half its range
    output_K: float = 0.3  # of an output's bias
    not_at_rest: float = 100.0  # times the variance of the states: 5 K, as a heatsink may be off the water


START = StartSettings()


@dataclass(frozen=True)
class Estimate:
    """The estimate at a reading, and that reading."""

    time: float  # [s]
    step: int  # native steps that were complete
    x: Array  # (n_x,) state
    w: Array  # (n_w,) drive biases, fractions of half the range
    b: Array  # (n_y,) output biases [K]
    y: Array  # (n_y,) readings [degC], NaN where one is not compared


class RigFilter:
    """Estimate state x (n_x,), drive biases w (n_w,) and output biases b (n_y,) of a rig.

    ``half`` is half the range of each drive: the input that the rig really gets is u + w * half.
    ``expected`` (n_y,) are the readings predicted for now [degC], ``u`` and ``d`` what was applied and read
    last; ``applied`` are those of the newest ``keep`` native steps, of ``done`` that are complete.
    """

    def __init__(self, plant: Plant, settings: ModelSettings, keep: int) -> None:
        self.plant = plant
        self.settings = settings
        self.drives = tuple(name for name in plant.inputs if name != "pump")
        self.drive_at = np.array([plant.inputs.index(name) for name in self.drives], dtype=int)
        ranges = [range_of(plant.units.get(name, "1"), plant.valid.get(name)) for name in self.drives]
        low, high = np.array([ends or (-1.0, 1.0) for ends in ranges]).reshape(-1, 2).T
        self.half = 0.5 * (high - low)
        self.offsets = np.array([plant.offsets.get(name, 0.0) for name in plant.outputs])
        reference = plant.reference or plant.outputs[0]
        self._reference = plant.outputs.index(reference)
        self.biased = np.array([k for k, name in enumerate(plant.outputs) if name != reference], dtype=int)
        unit = np.sqrt(np.maximum(np.diag(np.atleast_2d(plant.model.spread)), 1e-12))
        unit = np.maximum(unit / max(float(unit.max()), 1e-12), 0.1)
        n_w, n_b = len(self.drives), len(self.biased)
        bias_noise = [np.full(n_w, settings.drive_per_sqrt_s), np.full(n_b, settings.output_K_per_sqrt_s)]
        self._q = np.concatenate([settings.state_K_per_sqrt_s * unit, *bias_noise]) ** 2
        start_sd = [START.state_K * unit, np.full(n_w, START.drive), np.full(n_b, START.output_K)]
        self._p0 = np.concatenate(start_sd) ** 2
        least_noise = settings.reading_K
        self._R = np.array([max(plant.noise.get(n, 0.0), least_noise) for n in plant.outputs]) ** 2
        # how readings depend on (x, w, b): outputs of a model are affine in its state
        self._p = plant.p
        at_zero = self._output(np.zeros(plant.model.n_x))
        by_state = [self._output(row) - at_zero for row in np.eye(plant.model.n_x)]
        n_y = len(plant.outputs)
        self._H = np.hstack([np.stack(by_state, axis=1), np.zeros((n_y, n_w)), np.eye(n_y)[:, self.biased]])
        self._keep_s = keep * plant.dt
        self.applied: deque[tuple[Array, Array]] = deque(maxlen=keep)
        self.estimates: deque[Estimate] = deque()

    def reset(self, time: float, y: Array, d: Array) -> None:
        """Start at a time [s] at readings y (n_y,) and disturbances d (n_d,), NaN where there is none."""
        plant = self.plant
        usual = float(np.nanmean(y)) if np.isfinite(y).any() else 25.0
        self.d = np.where(np.isfinite(d), d, np.nan_to_num(plant.undisturbed(usual)))
        resting_outputs = np.where(np.isfinite(y), y - self.offsets, usual)
        self.at_rest = self._agree(y)
        if not self.at_rest:  # outputs that disagree are at no rest: the reference says how warm it is
            resting_outputs[:] = resting_outputs[self._reference]
        self.u = np.array([1.0 if n in plant.model.switches else 0.0 for n in plant.inputs])
        self.x = np.asarray(plant.model.rest(resting_outputs, self.u, self.d, self._p), dtype=float)
        self.w, self.b = np.zeros(len(self.drives)), np.zeros(len(plant.outputs))
        self._P = np.diag(self._p0)
        if not self.at_rest:  # nothing is known of what cannot be read, such as a hot heatsink
            n = self.x.size
            self._P[np.arange(n), np.arange(n)] *= START.not_at_rest
        self.done = 0
        self.applied.clear()
        self.estimates.clear()
        self._start = self._until = time  # of the first step; until when inputs are known
        self._dose = np.zeros(len(plant.inputs))  # integral of u over the step that is not complete
        self.expected = self._now(time)
        self._keep(time, y)

    def predict(self, time: float, u: Array, d: Array) -> None:
        """Predict the estimate at a time [s] under u (n_u,) and d (n_d,), the last one where it is NaN."""
        self.d = np.where(np.isfinite(d), d, self.d)
        # a model has its own steps, readings come when they come: u_k = (1 / dt) int u(t) dt over step k
        steps, dt = [], self.plant.dt
        while (grid := self._start + (self.done + 1) * dt) <= time + 1e-9:
            steps.append(((self._dose + (grid - self._until) * u) / dt, self.d))
            self._dose, self._until = np.zeros_like(u), grid
            self.done += 1
        self._dose = self._dose + max(time - self._until, 0.0) * u
        self._until = max(time, self._until)
        if steps:
            self._propagate(np.array([one for one, _ in steps]), np.array([one for _, one in steps]))
        self.applied.extend(steps)
        self.u = u
        self.expected = self._now(time)

    def correct(self, time: float, y: Array) -> None:
        """Correct the estimate with readings y (n_y,) [degC] of a time [s], NaN where one is suspect."""
        read_outputs = np.flatnonzero(np.isfinite(y))
        if read_outputs.size:
            H = self._H[read_outputs]
            PH = self._P @ H.T
            # K = P H' (H P H' + R)^-1
            gain = np.linalg.solve(H @ PH + np.diag(self._R[read_outputs]), PH.T).T
            change = gain @ (y - self.expected)[read_outputs]
            n, m = self.x.size, self.w.size
            self.x = self.x + change[:n]
            self.w = np.clip(self.w + change[n : n + m], -LARGEST_DRIVE_BIAS, LARGEST_DRIVE_BIAS)
            self.b[self.biased] += change[n + m :]
            remaining = np.eye(self._P.shape[0]) - gain @ H
            # (I - K H) P (I - K H)' + K R K' stays positive whatever rounding does to K
            self._P = remaining @ self._P @ remaining.T + (gain * self._R[read_outputs]) @ gain.T
        self._keep(time, y)

    def loosen(self) -> None:
        """Add the start's variance to the states': an output was not described for a while."""
        n = self.x.size
        self._P[np.arange(n), np.arange(n)] += self._p0[:n]

    def spread(self) -> Array:
        """Return the standard deviations (n_y,) of the innovations now [K]."""
        return np.asarray(np.sqrt(np.diag(self._H @ self._P @ self._H.T) + self._R))

    def bias_spread(self) -> Array:
        """Return the standard deviations (n_w,) of the drive biases now."""
        n, m = self.x.size, self.w.size
        return np.asarray(np.sqrt(np.diag(self._P)[n : n + m]))

    def is_jump(self, output_index: int, value: float) -> bool:
        """Say whether the innovation of a reading [degC] of an output is too large."""
        off = abs(value - float(self.expected[output_index]))
        s = self.settings
        return off > s.jump_floor_K and bool(off > s.jump_k * self.spread()[output_index])

    def begin(self, seconds: float) -> Estimate | None:
        """Return the newest estimate that is so old; None where there is none or inputs since are lost."""
        begin_s = self.estimates[-1].time - seconds
        begin = next((one for one in reversed(self.estimates) if one.time <= begin_s + 1e-6), None)
        return begin if begin is not None and begin.step >= self.done - len(self.applied) else None

    def applied_since(self, step: int) -> tuple[Array, Array]:
        """Return inputs (N, n_u) and disturbances (N, n_d) of the steps from this one on that are kept."""
        newest = list(self.applied)[len(self.applied) - (self.done - step) :]
        return np.array([u for u, _ in newest]), np.array([d for _, d in newest])

    def path(self, begin: Estimate, u: Array, d: Array) -> Array:
        """Return readings (N + 1, n_y) [degC] from an estimate on under u (N, n_u) and d (N, n_d)."""
        y = self.run(begin.x[None], self.driven(u, begin.w)[None], d[None])[0]
        return np.asarray(y + self.offsets + begin.b)

    def run(self, x: Array, u: Array, d: Array) -> Array:
        """Return the outputs (B, N + 1, n_y) without offsets of runs from x (B, n_x) under u (B, N, n_u) and
        d (B, N, n_d)."""
        return np.asarray(self._rollout(x, u, d)[0])

    def driven(self, u: Array, w: Array) -> Array:
        """Return inputs (..., n_u) as the rig gets them where its drives have biases w (n_w,)."""
        out = u.copy()
        out[..., self.drive_at] += w * self.half
        return out

    def _keep(self, time: float, y: Array) -> None:
        """Keep the estimate as it is, with the readings that came, and drop what is too old."""
        self.estimates.append(Estimate(time, self.done, self.x.copy(), self.w.copy(), self.b.copy(), y))
        while time - self.estimates[0].time > self._keep_s:
            self.estimates.popleft()

    def _rollout(self, x: Array, u: Array, d: Array) -> tuple[Array, Array]:
        return self.plant.model.rollout(x, u, d, self._p[None], self.plant.dt)

    def _agree(self, y: Array) -> bool:
        """Say whether all readings agree, and with the room: then the rig has not run for long.  A tank that
        is a little warmer than the skin is not at rest: the water in the tubes is not known."""
        plant = self.plant
        rooms = self.d[[plant.disturbances.index(name) for name in room_disturbances(plant)]]
        if not np.isfinite(y).any():
            return False
        level = (y - self.offsets)[np.isfinite(y)]
        near_room = not rooms.size or abs(float(level.mean()) - rooms[0]) < 2.0
        return bool(near_room and np.ptp(level) < 0.7)

    def _propagate(self, u: Array, d: Array) -> None:
        """Predict over whole native steps: u (N, n_u), d (N, n_d)."""
        n = self.x.size
        m = self.w.size
        tiny = 1e-4 * np.maximum(1.0, np.abs(self.x))
        x = np.repeat(self.x[None], 1 + n + m, axis=0)
        x[np.arange(1, n + 1), np.arange(n)] += tiny
        many = np.repeat(self.driven(u, self.w)[None], 1 + n + m, axis=0)
        for j, input_index in enumerate(self.drive_at):
            many[1 + n + j, :, input_index] += 1e-3 * self.half[j]
        _, after = self._rollout(x, many, np.repeat(d[None], 1 + n + m, axis=0))
        if not np.isfinite(after).all():
            return  # a diverging model predicts nothing; limits still hold
        size = self._P.shape[0]
        F = np.eye(size)
        F[:n, :n] = ((after[1 : n + 1] - after[0]) / tiny[:, None]).T
        F[:n, n : n + m] = ((after[n + 1 :] - after[0]) / 1e-3).T
        self.x = after[0]
        self._P = F @ self._P @ F.T
        self._P[np.diag_indices(size)] += self._q * len(u) * self.plant.dt

    def _now(self, time: float) -> Array:
        """Return the readings expected at a time that may lie between two native steps."""
        y = self._output(self.x)
        passed_share = (time - self._start) / self.plant.dt - self.done
        if passed_share > 1e-6:
            u = self.driven(self.u, self.w)[None, None]
            y = y + passed_share * (self.run(self.x[None], u, self.d[None, None])[0, -1] - y)
        return np.asarray(y + self.offsets + self.b)

    def _output(self, x: Array) -> Array:
        return np.array(self.plant.model.output(x.tolist(), self._p.tolist()), dtype=float)
