r"""Where is the rig now, and is this reading where the last ones say it must be?

State x, a bias w on each drive (a fraction of half its range; a driver is never quite what its command says)
and a bias b on each output but the reference (thermocouples are plugged anew) follow

    x+ = f(x, u + w, d),    w+ = w + noise,    b+ = b + noise,    y = h(x) + y0 + b + noise,

an extended Kalman filter with the model's own Jacobian by differences.  With z = (x, w, b) and its covariance
P, a native step carries on and a reading corrects by

    P = F P F' + Q,    S = H P H' + R,    K = P H' S^-1,    z += K (y - expected),

and P by (I - K H) P (I - K H)' + K R K', which stays positive whatever rounding does to K.

An innovation y - expected beyond ``jump_k`` of its own standard deviations sqrt(S) and ``jump_floor`` kelvin
is not a temperature of this rig.

It starts at rest at the first readings.  Where those agree neither with each other nor with the room nothing
is known of what cannot be read (a hot heatsink), and P starts a hundred times larger.

The identified plant as the arithmetic of the guard sees it: arrays in the order of inputs and outputs
------------------------------------------------------------------------------------------------------

A drive has a range by its unit, not by what the logs covered: a drive beyond those is still a drive.  With
half that range a bias w of each drive is a fraction, and the input that the rig really gets is

    u + w * half.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermogrip.rig.guard.history import InputSteps, Moment
from thermogrip.rig.guard.room_sensors import room_disturbances
from thermogrip.rig.interface import UNIT_RANGES
from thermogrip.sysid.models.model import Array
from thermogrip.sysid.plant.plant import Plant

__all__ = [
    "FilterSettings",
    "RigFilter",
    "RigModel",
]


class RigModel:
    """A plant with its drives told from its pump.

    Parameters
    ----------
    plant : Plant

    Attributes
    ----------
    drives : tuple of str
        The inputs that are not the pump.
    drive_at : (n_w,) ndarray of int
        Where they stand among the inputs.
    ranges, half : (n_w, 2), (n_w,) ndarray
        Least and most of each, and half of what lies between.
    offsets : (n_y,) ndarray
        What each sensor reads besides the model's output [K].
    p : (n_p,) ndarray
        The plant's parameters, or better ones.

    Examples
    --------
    >>> from thermogrip.sysid.models.state_space import StateSpaceModel
    >>> block = StateSpaceModel(("q",), (), ("t",), A=[[0.99]], B=[[0.5]], C=[[1.0]], dt=1.0, y0=[25.0])
    >>> model = RigModel(Plant(block, {}, dt=1.0, units={"q": "percent"}))
    >>> model.ranges.tolist(), model.half.tolist()
    ([[0.0, 100.0]], [50.0])
    >>> model.biased(np.array([[40.0]]), np.array([0.1])).tolist()
    [[45.0]]
    """

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self.drives = tuple(name for name in plant.inputs if name != "pump")
        self.drive_at = np.array([plant.inputs.index(name) for name in self.drives], dtype=int)
        self.ranges = np.array([self._range(name) for name in self.drives]).reshape(-1, 2)
        self.half = 0.5 * (self.ranges[:, 1] - self.ranges[:, 0])
        self.offsets = np.array([plant.offsets.get(name, 0.0) for name in plant.outputs])
        self.p = plant.p

    def _range(self, name: str) -> tuple[float, float]:
        unit = self.plant.units.get(name, "1")
        return UNIT_RANGES.get(unit) or self.plant.valid.get(name) or (-1.0, 1.0)

    def biased(self, u: Array, w: Array) -> Array:
        """Return inputs (..., n_u) as the rig gets them where its drives have biases w (n_w,)."""
        out = u.copy()
        out[..., self.drive_at] += w * self.half
        return out

    def rollout(self, x: Array, u: Array, d: Array, p: Array | None = None) -> tuple[Array, Array]:
        """Run a batch from x (B, n_x) under u (B, N, n_u), d (B, N, n_d), parameters p (B, n_p) or its own.

        Returns
        -------
        y, x : (B, N + 1, n_y), (B, n_x) ndarray
            Outputs without the offsets [degC], and the last states.
        """
        return self.plant.model.rollout(x, u, d, self.p[None] if p is None else p, self.plant.dt)

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


_LARGEST_DRIVE_BIAS = 0.5
_START_X, _START_W, _START_B = 0.5, 0.03, 0.3  # standard deviations at a start from rest
_NOT_AT_REST = 100.0  # times the variance of the states


@dataclass(frozen=True)
class FilterSettings:
    """What the filter believes.

    Attributes
    ----------
    jump_k, jump_floor : float
        One-step innovation that is not believed: standard deviations, and kelvin.
    state, drive, output, reading : float
        Heat in the states [K/sqrt(s)], wander of a drive bias [1/sqrt(s)] and of an output bias [K/sqrt(s)],
        noise of a reading [K].
    """

    jump_k: float = 8.0
    jump_floor: float = 3.0
    state: float = 0.01
    drive: float = 0.002
    output: float = 0.002
    reading: float = 0.08


class RigFilter:
    """Follow a rig: state, drive biases and output biases.

    Parameters
    ----------
    model : RigModel
    settings : FilterSettings
    keep : int
        Native steps of inputs to keep.

    Attributes
    ----------
    x, w, b : (n_x,), (n_w,), (n_y,) ndarray
        State, drive biases (fractions of half the range) and output biases [K].
    u, d : (n_u,), (n_d,) ndarray
        The inputs that were applied last, and the disturbances that were read last.
    expected : (n_y,) ndarray
        Readings that are expected now [degC].
    at_rest : bool
        Whether it started at rest.
    biased : (n_b,) ndarray of int
        The outputs that may have a bias: all but the reference.
    steps : InputSteps
        What was applied.

    Examples
    --------
    A heater that gives 10 % more than it is asked for: the bias of its drive is found.

    >>> from thermogrip.sysid.plant.plant import Plant
    >>> from thermogrip.sysid.models.state_space import StateSpaceModel
    >>> block = StateSpaceModel(("q",), (), ("t",), A=[[0.99]], B=[[0.5]], C=[[1.0]], dt=1.0, y0=[25.0])
    >>> rig = RigFilter(RigModel(Plant(block, {}, dt=1.0, units={"q": "1"})), FilterSettings(), 10)
    >>> rig.reset(0.0, np.array([25.0]), np.zeros(0))
    >>> t = 25.0
    >>> for k in range(1, 400):
    ...     t = 25.0 + 0.99 * (t - 25.0) + 0.5 * 0.55
    ...     rig.predict(float(k), np.array([0.5]), np.zeros(0))
    ...     rig.correct(np.array([t]))
    >>> rig.w.round(2).tolist()
    [0.05]
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
        walk = [np.full(n_w, s.drive), np.full(n_b, s.output)]
        self._q = np.concatenate([s.state * unit, *walk]) ** 2
        start = [_START_X * unit, np.full(n_w, _START_W), np.full(n_b, _START_B)]
        self._p0 = np.concatenate(start) ** 2
        self._R = np.array([max(plant.noise.get(n, s.reading), s.reading) for n in plant.outputs]) ** 2
        self._keep = keep

    def reset(self, time: float, y: Array, d: Array) -> None:
        """Start at a time [s] at readings y (n_y,) and disturbances d (n_d,), NaN where there is none."""
        plant = self.model.plant
        usual = float(np.nanmean(y)) if np.isfinite(y).any() else 25.0
        self.d = np.where(np.isfinite(d), d, usual)
        rest = np.where(np.isfinite(y), y - self.model.offsets, usual)
        self.at_rest = self._agree(y)
        if not self.at_rest:  # outputs that disagree are at no rest: the reference says how warm it is
            rest[:] = rest[self._reference]
        self.u = np.array([1.0 if n in plant.model.switches else 0.0 for n in plant.inputs])
        self.x = np.asarray(plant.model.rest(rest, self.u, self.d, self.model.p), dtype=float)
        self.w, self.b = np.zeros(len(self.model.drives)), np.zeros(len(plant.outputs))
        self._P = np.diag(self._p0)
        if not self.at_rest:
            n = self.x.size
            self._P[np.arange(n), np.arange(n)] *= _NOT_AT_REST
        self.steps = InputSteps(plant.dt, time, time)
        self.expected = self._now(time)

    def predict(self, time: float, u: Array, d: Array) -> None:
        """Carry the estimate on to a time [s] under u (n_u,) and d (n_d,), the last where it is NaN."""
        self.d = np.where(np.isfinite(d), d, self.d)
        steps = self.steps.add(time, u, self.d, self._keep)
        if steps:
            self._carry(*self.steps.rows(self.steps.done - steps))
        self.u = u
        self.expected = self._now(time)

    def correct(self, y: Array) -> None:
        """Correct the estimate with readings y (n_y,) [degC], NaN where one is not believed."""
        seen = np.flatnonzero(np.isfinite(y))
        if not seen.size:
            return
        H = self._H(seen)
        PH = self._P @ H.T
        gain = np.linalg.solve(H @ PH + np.diag(self._R[seen]), PH.T).T
        change = gain @ (y - self.expected)[seen]
        n, m = self.x.size, self.w.size
        self.x = self.x + change[:n]
        self.w = np.clip(self.w + change[n : n + m], -_LARGEST_DRIVE_BIAS, _LARGEST_DRIVE_BIAS)
        self.b[self.biased] += change[n + m :]
        left = np.eye(self._P.shape[0]) - gain @ H
        self._P = left @ self._P @ left.T + (gain * self._R[seen]) @ gain.T

    def loosen(self) -> None:
        """Know the states less: an output was not described for a while."""
        n = self.x.size
        self._P[np.arange(n), np.arange(n)] += self._p0[:n]

    def spread(self) -> Array:
        """Return the standard deviations (n_y,) of the innovations now [K]."""
        H = self._H(np.arange(len(self.model.plant.outputs)))
        return np.asarray(np.sqrt(np.diag(H @ self._P @ H.T + np.diag(self._R))))

    def is_jump(self, at: int, value: float) -> bool:
        """Say whether a reading [degC] of output ``at`` is not one of this rig, given all before it."""
        off = abs(value - float(self.expected[at]))
        return bool(off > max(self.settings.jump_floor, self.settings.jump_k * float(self.spread()[at])))

    def moment(self, time: float, y: Array) -> Moment:
        """Return the estimate as it is at a time [s], with the readings (n_y,) that came."""
        return Moment(time, self.steps.done, self.x.copy(), self.w.copy(), self.b.copy(), y)

    def driven(self, u: Array) -> Array:
        """Return inputs (..., n_u) with the drive biases of now, not beyond what a driver could give."""
        out, at = self.model.biased(u, self.w), self.model.drive_at
        slack = _LARGEST_DRIVE_BIAS * self.model.half
        out[..., at] = np.clip(out[..., at], self.model.ranges[:, 0] - slack, self.model.ranges[:, 1] + slack)
        return out

    def _agree(self, y: Array) -> bool:
        """Say whether all readings agree, and with the room: then the rig has not run for long.

        A tank that is a little warmer than the skin is not at rest: what stands in the tubes is not known.
        """
        plant = self.model.plant
        rooms = self.d[[plant.disturbances.index(name) for name in room_disturbances(plant)]]
        if not np.isfinite(y).any():
            return False
        level = (y - self.model.offsets)[np.isfinite(y)]
        near = not rooms.size or abs(float(level.mean()) - rooms[0]) < 2.0
        return bool(near and np.ptp(level) < 0.7)

    def _carry(self, u: Array, d: Array) -> None:
        """Take the estimate over whole native steps: u (N, n_u), d (N, n_d)."""
        model, n, m = self.model, self.x.size, self.w.size
        tiny = 1e-4 * np.maximum(1.0, np.abs(self.x))
        x = np.repeat(self.x[None], 1 + n + m, axis=0)
        x[np.arange(1, n + 1), np.arange(n)] += tiny
        many = np.repeat(self.driven(u)[None], 1 + n + m, axis=0)
        for j, at in enumerate(model.drive_at):
            many[1 + n + j, :, at] += 1e-3 * model.half[j]
        _, after = model.rollout(x, many, np.repeat(d[None], 1 + n + m, axis=0))
        if not np.isfinite(after).all():
            return  # a model that runs away says nothing; the readings go on being compared by the limits
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
        part = self.steps.part(time)
        if part > 1e-6:
            u = self.driven(self.u)[None, None]
            y = y + part * (self.model.run(self.x[None], u, self.d[None, None])[0, -1] - y)
        return np.asarray(y + self.model.offsets + self.b)

    def _H(self, seen: NDArray[np.intp]) -> Array:
        """Return how readings (n_seen,) depend on state, drive biases and output biases."""
        n_y = len(self.model.plant.outputs)
        C = self.model.output_slope(self.x)
        return np.hstack([C, np.zeros((n_y, self.w.size)), np.eye(n_y)[:, self.biased]])[seen]
