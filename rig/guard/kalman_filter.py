r"""The state of a rig, estimated from its readings, and the minutes that led there.

State x, a bias w on each drive (a fraction of half its range) and a bias b on each output but the reference
(thermocouples are plugged anew) follow

    x+ = f(x, u + w, d),    w+ = w + noise,    b+ = b + noise,    y = h(x) + y0 + b + noise,

an extended Kalman filter with the model's own Jacobian by differences.  With z = (x, w, b) and its covariance
P, a native step predicts and a reading corrects by

    P = F P F' + Q,    S = H P H' + R,    K = P H' S^-1,    z += K (y - expected),

and P by (I - K H) P (I - K H)' + K R K', which stays positive whatever rounding does to K.  It starts at rest
at the first readings; where those agree neither with each other nor with the room nothing is known of what
cannot be read (a hot heatsink), and P starts a hundred times larger.

**Inputs between readings.**  A model steps with its own dt, readings come when they come.  What was applied
is averaged over each native step of the model, as the twin and the fits do: with u(t) held between calls,

    u_k = (1 / dt) * integral of u(t) from k dt to (k + 1) dt.

An estimate that is kept with the number of its step can so be simulated again under what was applied since,
or under what may have been.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.limits import keyed
from thermogrip.rig.guard.sensor_checks import room_disturbances
from thermogrip.rig.interface import range_of
from thermogrip.sysid.plant.plant import Plant


@dataclass
class InputSteps:
    """Inputs averaged over native steps."""

    dt: float  # of a step [s]
    start: float  # when the first step began [s]
    time: float  # until when inputs are known [s]
    done: int = 0  # steps that are complete
    first: int = 0  # the oldest that is kept
    _total: Array = field(default_factory=lambda: np.zeros(0))
    _passed: float = 0.0
    _u: deque[Array] = field(default_factory=deque)
    _d: deque[Array] = field(default_factory=deque)

    def add(self, until: float, u: Array, d: Array, keep: int) -> int:
        """Hold u (n_u,) and d (n_d,) until a time [s], keep the newest ``keep`` complete steps (but all of
        this call), and return the number completed."""
        before = self.done
        while (grid := self.start + (self.done + 1) * self.dt) <= until + 1e-9:
            self._accumulate(grid - self.time, u)
            self._u.append(self._total / self._passed)
            self._d.append(d.copy())
            self._total = np.zeros_like(u)
            self._passed = 0.0
            self.time = grid
            self.done += 1
        self._accumulate(max(until - self.time, 0.0), u)
        self.time = max(until, self.time)
        while len(self._u) > max(keep, self.done - before):
            self._u.popleft()
            self._d.popleft()
            self.first += 1
        return self.done - before

    def rows(self, since: int) -> tuple[Array, Array]:
        """Return inputs (N, n_u) and disturbances (N, n_d) of the steps from this one on, if it is kept."""
        if since < self.first:
            raise ValueError(f"step {since} is forgotten, the oldest that is kept is {self.first}")
        places = range(since - self.first, len(self._u))
        return np.array([self._u[k] for k in places]), np.array([self._d[k] for k in places])

    def part(self, time: float) -> float:
        """Return how much of the step that is not complete has passed at a time, as a fraction."""
        return (time - self.start) / self.dt - self.done

    def _accumulate(self, seconds: float, u: Array) -> None:
        if self._total.size == 0:
            self._total = np.zeros_like(u)
        self._total = self._total + seconds * u
        self._passed += seconds


@dataclass(frozen=True)
class Estimate:
    """The estimate at a tick, and the reading that came with it."""

    time: float  # [s]
    step: int  # native steps that were complete
    x: Array  # (n_x,) state
    w: Array  # (n_w,) drive biases, fractions of half the range
    b: Array  # (n_y,) output biases [K]
    y: Array  # (n_y,) readings [degC], NaN where one is not compared


class History:
    """The estimates of the last seconds, and the inputs between them (to which the filter goes on adding)."""

    def __init__(self, steps: InputSteps, seconds: float) -> None:
        self.steps = steps
        self._seconds = seconds
        self._kept: deque[Estimate] = deque()

    @property
    def now(self) -> float:
        """Time of the newest estimate [s]."""
        return self._kept[-1].time

    def add(self, one: Estimate) -> None:
        """Keep an estimate, and drop what is too old."""
        self._kept.append(one)
        while one.time - self._kept[0].time > self._seconds:
            self._kept.popleft()

    def begin(self, time: float) -> Estimate | None:
        """Return the newest estimate up to a time [s]; None where there is none or inputs since are lost."""
        begin = next((one for one in reversed(self._kept) if one.time <= time + 1e-6), None)
        return begin if begin is not None and begin.step >= self.steps.first else None

    def after(self, time: float) -> list[Estimate]:
        """Return the estimates later than a time [s]."""
        return [m for m in self._kept if m.time > time]

    def errors(self, begin: Estimate, y: Array) -> Array:
        """Return reading less path (B, n_readings, n_y) of every later estimate, for paths with the outputs
        ``y`` (B, N + 1, n_y) [degC] at native steps, that of ``begin`` first."""
        later = self.after(begin.time)
        steps_since = [m.step - begin.step for m in later]
        return np.asarray(np.array([m.y for m in later])[None] - y[:, steps_since])


class RigModel:
    """The identified plant as arrays in the order of inputs and outputs, with its drives apart from its pump.

    A drive has a range by its unit, not by what the logs covered.  With half that range a bias w of each
    drive is a fraction, and the input that the rig really gets is u + w * half.
    """

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self.drives = tuple(name for name in plant.inputs if name != "pump")
        self.drive_at = np.array([plant.inputs.index(name) for name in self.drives], dtype=int)
        ranges = [range_of(plant.units.get(name, "1"), plant.valid.get(name)) for name in self.drives]
        self.ranges = np.array([ends or (-1.0, 1.0) for ends in ranges]).reshape(-1, 2)
        self.half = 0.5 * (self.ranges[:, 1] - self.ranges[:, 0])
        self.offsets = np.array([plant.offsets.get(name, 0.0) for name in plant.outputs])
        self.p = plant.p

    def biased(self, u: Array, w: Array) -> Array:
        """Return inputs (..., n_u) as the rig gets them where its drives have biases w (n_w,)."""
        out = u.copy()
        out[..., self.drive_at] += w * self.half
        return out

    def rollout(self, x: Array, u: Array, d: Array) -> tuple[Array, Array]:
        """Return outputs (B, N + 1, n_y) without offsets and last states (B, n_x) of runs from x (B, n_x)
        under u (B, N, n_u) and d (B, N, n_d)."""
        return self.plant.model.rollout(x, u, d, self.p[None], self.plant.dt)

    def run(self, x: Array, u: Array, d: Array) -> Array:
        """Return the outputs (B, N + 1, n_y) of such a run without the offsets [degC]."""
        return np.asarray(self.rollout(x, u, d)[0])

    def output(self, x: Array) -> Array:
        """Return the outputs (n_y,) at a state x (n_x,) without the offsets [degC]."""
        return np.array(self.plant.model.output(x.tolist(), self.p.tolist()), dtype=float)

    def output_slope(self, x: Array) -> Array:
        """Return dy/dx (n_y, n_x) at a state, by differences."""
        n = x.size
        moved = np.repeat(x[:, None], n + 1, axis=1)
        moved[np.arange(n), np.arange(1, n + 1)] += 1e-3
        y = self.plant.model.output(list(moved), self.p.tolist())
        rows = np.array([np.broadcast_to(row, n + 1) for row in y], dtype=float)
        return np.asarray((rows[:, 1:] - rows[:, :1]) / 1e-3)


@dataclass(frozen=True)
class FilterSettings:
    """Noise intensities of the filter, and the innovation that makes a reading suspect."""

    jump_k: float = keyed(8.0, "jump_k", 3, 100)  # standard deviations ...
    jump_floor: float = keyed(3.0, "jump_floor_K", 0.1, 50)  # ... and kelvin
    state: float = keyed(0.01, "state_K_per_sqrt_s", 1e-4, 1)  # process noise of the states [K/sqrt(s)]
    drive: float = keyed(0.002, "drive_per_sqrt_s", 1e-5, 0.1)  # of a drive's bias [1/sqrt(s)]
    output: float = keyed(0.002, "output_K_per_sqrt_s", 1e-5, 1)  # of an output's bias [K/sqrt(s)]
    reading: float = keyed(0.08, "reading_K", 0.001, 5)  # least noise of a reading [K]
    largest_drive_bias: float = 0.5  # a driver that gives half, or half more, is at fault in any case
    # standard deviations at a start from rest: of the states and of outputs' biases [K], of drives' biases
    start_state: float = 0.5
    start_drive: float = 0.03
    start_output: float = 0.3
    not_at_rest: float = 100.0  # times the variance of the states: 5 K, as a heatsink may be off the water


class RigFilter:
    """Estimate state x (n_x,), drive biases w (n_w,) and output biases b (n_y,) of a rig.

    ``expected`` (n_y,) are the readings predicted for now [degC], ``u`` and ``d`` what was applied and read
    last, ``biased`` the outputs that may have a bias: all but the reference.
    """

    def __init__(self, model: RigModel, settings: FilterSettings, keep: int) -> None:
        self.model, self.settings = model, settings
        plant, s = model.plant, settings
        reference = plant.reference or plant.outputs[0]
        self._reference = plant.outputs.index(reference)
        self.biased = np.array([k for k, name in enumerate(plant.outputs) if name != reference], dtype=int)
        unit = np.sqrt(np.maximum(np.diag(np.atleast_2d(plant.model.spread)), 1e-12))
        unit = np.maximum(unit / max(float(unit.max()), 1e-12), 0.1)
        n_w, n_b = len(model.drives), len(self.biased)
        biases = [np.full(n_w, s.drive), np.full(n_b, s.output)]
        self._q = np.concatenate([s.state * unit, *biases]) ** 2
        start = [s.start_state * unit, np.full(n_w, s.start_drive), np.full(n_b, s.start_output)]
        self._p0 = np.concatenate(start) ** 2
        self._R = np.array([max(plant.noise.get(n, s.reading), s.reading) for n in plant.outputs]) ** 2
        self._keep = keep

    def reset(self, time: float, y: Array, d: Array) -> None:
        """Start at a time [s] at readings y (n_y,) and disturbances d (n_d,), NaN where there is none."""
        plant = self.model.plant
        usual = float(np.nanmean(y)) if np.isfinite(y).any() else 25.0
        self.d = np.where(np.isfinite(d), d, np.nan_to_num(plant.undisturbed(usual)))
        resting_outputs = np.where(np.isfinite(y), y - self.model.offsets, usual)
        self.at_rest = self._agree(y)
        if not self.at_rest:  # outputs that disagree are at no rest: the reference says how warm it is
            resting_outputs[:] = resting_outputs[self._reference]
        self.u = np.array([1.0 if n in plant.model.switches else 0.0 for n in plant.inputs])
        self.x = np.asarray(plant.model.rest(resting_outputs, self.u, self.d, self.model.p), dtype=float)
        self.w, self.b = np.zeros(len(self.model.drives)), np.zeros(len(plant.outputs))
        self._P = np.diag(self._p0)
        if not self.at_rest:
            n = self.x.size
            self._P[np.arange(n), np.arange(n)] *= self.settings.not_at_rest
        self.steps = InputSteps(plant.dt, time, time)
        self.expected = self._now(time)

    def predict(self, time: float, u: Array, d: Array) -> None:
        """Predict the estimate at a time [s] under u (n_u,) and d (n_d,), the last one where it is NaN."""
        self.d = np.where(np.isfinite(d), d, self.d)
        steps = self.steps.add(time, u, self.d, self._keep)
        if steps:
            self._propagate(*self.steps.rows(self.steps.done - steps))
        self.u = u
        self.expected = self._now(time)

    def correct(self, y: Array) -> None:
        """Correct the estimate with readings y (n_y,) [degC], NaN where one is suspect."""
        read_outputs = np.flatnonzero(np.isfinite(y))
        if not read_outputs.size:
            return
        H = self._H(read_outputs)
        PH = self._P @ H.T
        gain = np.linalg.solve(H @ PH + np.diag(self._R[read_outputs]), PH.T).T
        change = gain @ (y - self.expected)[read_outputs]
        n, m = self.x.size, self.w.size
        self.x = self.x + change[:n]
        largest = self.settings.largest_drive_bias
        self.w = np.clip(self.w + change[n : n + m], -largest, largest)
        self.b[self.biased] += change[n + m :]
        remaining = np.eye(self._P.shape[0]) - gain @ H
        self._P = remaining @ self._P @ remaining.T + (gain * self._R[read_outputs]) @ gain.T

    def loosen(self) -> None:
        """Add the start's variance to the states': an output was not described for a while."""
        n = self.x.size
        self._P[np.arange(n), np.arange(n)] += self._p0[:n]

    def spread(self) -> Array:
        """Return the standard deviations (n_y,) of the innovations now [K]."""
        H = self._H(np.arange(len(self.model.plant.outputs)))
        return np.asarray(np.sqrt(np.diag(H @ self._P @ H.T + np.diag(self._R))))

    def bias_spread(self) -> Array:
        """Return the standard deviations (n_w,) of the drive biases now."""
        n, m = self.x.size, self.w.size
        return np.asarray(np.sqrt(np.diag(self._P)[n : n + m]))

    def is_jump(self, at: int, value: float) -> bool:
        """Say whether the innovation of a reading [degC] of output ``at`` is too large."""
        off = abs(value - float(self.expected[at]))
        s = self.settings
        return off > s.jump_floor and bool(off > s.jump_k * self.spread()[at])

    def moment(self, time: float, y: Array) -> Estimate:
        """Return the estimate as it is at a time [s], with the readings (n_y,) that came."""
        return Estimate(time, self.steps.done, self.x.copy(), self.w.copy(), self.b.copy(), y)

    def driven(self, u: Array) -> Array:
        """Return inputs (..., n_u) with the drive biases of now, not beyond what a driver could give."""
        out, columns = self.model.biased(u, self.w), self.model.drive_at
        slack = self.settings.largest_drive_bias * self.model.half
        out[..., columns] = np.clip(
            out[..., columns], self.model.ranges[:, 0] - slack, self.model.ranges[:, 1] + slack
        )
        return out

    def _agree(self, y: Array) -> bool:
        """Say whether all readings agree, and with the room: then the rig has not run for long.  A tank that
        is a little warmer than the skin is not at rest: the water in the tubes is not known."""
        plant = self.model.plant
        rooms = self.d[[plant.disturbances.index(name) for name in room_disturbances(plant)]]
        if not np.isfinite(y).any():
            return False
        level = (y - self.model.offsets)[np.isfinite(y)]
        near_room = not rooms.size or abs(float(level.mean()) - rooms[0]) < 2.0
        return bool(near_room and np.ptp(level) < 0.7)

    def _propagate(self, u: Array, d: Array) -> None:
        """Predict over whole native steps: u (N, n_u), d (N, n_d)."""
        model = self.model
        n = self.x.size
        m = self.w.size
        tiny = 1e-4 * np.maximum(1.0, np.abs(self.x))
        x = np.repeat(self.x[None], 1 + n + m, axis=0)
        x[np.arange(1, n + 1), np.arange(n)] += tiny
        many = np.repeat(self.driven(u)[None], 1 + n + m, axis=0)
        for j, input_index in enumerate(model.drive_at):
            many[1 + n + j, :, input_index] += 1e-3 * model.half[j]
        _, after = model.rollout(x, many, np.repeat(d[None], 1 + n + m, axis=0))
        if not np.isfinite(after).all():
            return  # a diverging model predicts nothing; limits still hold
        size = self._P.shape[0]
        F = np.eye(size)
        F[:n, :n] = ((after[1 : n + 1] - after[0]) / tiny[:, None]).T
        F[:n, n : n + m] = ((after[n + 1 :] - after[0]) / 1e-3).T
        self.x = after[0]
        self._P = F @ self._P @ F.T
        self._P[np.diag_indices(size)] += self._q * len(u) * model.plant.dt

    def _now(self, time: float) -> Array:
        """Return the readings expected at a time that may lie between two native steps."""
        y = self.model.output(self.x)
        passed_share = self.steps.part(time)
        if passed_share > 1e-6:
            u = self.driven(self.u)[None, None]
            y = y + passed_share * (self.model.run(self.x[None], u, self.d[None, None])[0, -1] - y)
        return np.asarray(y + self.model.offsets + self.b)

    def _H(self, seen: NDArray[np.intp]) -> Array:
        """Return how readings (n_seen,) depend on state, drive biases and output biases."""
        n_y = len(self.model.plant.outputs)
        C = self.model.output_slope(self.x)
        return np.hstack([C, np.zeros((n_y, self.w.size)), np.eye(n_y)[:, self.biased]])[seen]
