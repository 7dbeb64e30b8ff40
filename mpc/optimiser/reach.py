r"""Which targets can be held: the nearest steady outputs that drives and limits allow.

**The model's answer.**  A horizon does not show it: on the way up, a plan at full drive comes nearer to any
target.  So the steady state itself is sought, with the estimated biases in it, from the last one on, by
Newton's method for the state and least squares inside the ranges for the drives together,

    x_s+ = x_s + (I - A)^-1 (f(x_s, u_s) - x_s + B z),    min_z |r - y(x_s+)|^2,    u_s+ = u_s + z in range.

An output 1 degC beyond its target counts what it costs the optimiser, one beyond its limits a hundred times.
Where the plant integrates there may be no answer, and then the model says nothing.

**How sure it is.**  The biases are estimates with covariance P_w, so the steady outputs have the variance

    sigma^2 = J P_w J',    J = C (I - A)^-1 [B W_u + E W_d] + W_y.

P_w is right while the innovations are white: sigma is multiplied by the mean normalised innovation of the
last samples, in its own standard deviations, where that is above 1.  Misses beyond a tenth of an output's
unit (:func:`thermogrip.mpc.plant.prediction.unit_of`) then sum up as in Page's test,

    S+ = max(0, S + min((miss - unit / 10) / sigma, 2) - 1/2),    unreachable at S >= 3:

two samples where the target is out of reach by 2 sigma, more where it is by less.  A target more than a tenth
of a unit beyond its output's own limits is reported at once.

A target is asked about until five samples in a row say that it can be held, then no more until it moves.
Where no steady state is found after the answer was that it cannot (near an optimum Newton's method may not
converge), that answer is kept until the plan ends at the target.
"""

from __future__ import annotations

from operator import mul
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array
from thermogrip.mpc.optimiser.rti import FIRST, Optimiser

if TYPE_CHECKING:
    from thermogrip.mpc.estimator.observer import Observer
Mask = NDArray[np.bool_]

STEADY_STEPS, SWEEPS = 12, 200
STRIDE = 0.3  # of its range, that a drive may go in a step
CONVERGED = 1e-4  # of the largest unit, and of the range: the steady state is found
BEYOND_LIMIT = 100.0  # weight of an output beyond its limits
CANNOT, CAN = 0.1, 0.05  # of its unit that an output is from the target: it cannot be had, it can
LEAST_SD = 0.05  # of its unit, of a steady output where no bias is estimated
# of Page's test
MISS_CLIP = 2.0
MISS_ALLOWANCE = 0.5
MISS_ALARM = 3.0
TAKE_BACK = 5  # samples in a row


class Reach:
    """Reports whether targets can be held; what it does is described at the head of this module."""

    def __init__(self, optimiser: Optimiser, observer: Observer) -> None:
        self._optimiser, self.model = optimiser, optimiser.model
        design, model = optimiser.design, optimiser.model
        self._rows = [model.outputs.index(name) for name in design.controlled]
        self._limited = [model.outputs.index(name) for name in design.limits]
        self._limits = np.array(list(design.limits.values()), dtype=float).reshape(-1, 2).T
        own_limits = [design.limits.get(name, (-np.inf, np.inf)) for name in design.controlled]
        self._own = np.array(own_limits, dtype=float).T
        self._beyond = np.sqrt(design.price * (FIRST + 1.0) / design.track)  # weight beyond a target
        self.forget()

    def forget(self) -> None:
        """Start afresh."""
        self._x: Array | None = None
        self._u = self.model.neutral
        self._sum = 0.0
        self._in = 0
        self._unreachable = False
        self._target = np.full(len(self._rows), np.nan)

    def missed(
        self,
        observer: Observer,
        u: Array,
        d: Array,
        *,
        target: Array,
        side: Array,
        ahead: Array,
        seen: Mask,
    ) -> tuple[int, float] | None:
        """Return which controlled output cannot be held at its target, and where it can; None: all can.

        u (n_u,) are the drives now, d (n_d,) the measured disturbances; of the controlled outputs (n,) ahead
        are those at the end of the plan, side from where the targets are approached, and
        seen which of them count [degC].
        """
        if not np.array_equal(target, self._target):
            self._target = target.copy()
            self._sum = 0.0
            self._in = 0
            self._unreachable = False
        if self._in >= TAKE_BACK and not self._unreachable:
            return None
        unit = self.model.unit[self._rows]
        limit, lost = unit * (CAN if self._unreachable else CANNOT), False
        if np.any(seen & (np.abs(target - ahead) > limit)):
            reached, J = self._held(observer, u, d + observer.disturbance_bias, target, side, seen)
            lost = reached is target and self._sum >= MISS_ALARM  # none was found
        else:
            reached, J = target, np.zeros((len(target), observer.w.size))
        w_at = slice(self.model.n_x, self.model.n_x + observer.w.size)
        P = observer.estimate()["P"][w_at, w_at]
        sd = np.maximum(np.sqrt(np.einsum("ij,jk,ik->i", J, P, J)), LEAST_SD * unit)
        miss = np.where(seen, np.abs(target - reached), 0.0)
        scaled = (miss - CANNOT * unit) / (sd * max(1.0, observer.innovation_bias))
        if not lost:
            step = float(np.clip(scaled.max(), -1, MISS_CLIP)) - MISS_ALLOWANCE
            self._sum = min(max(0.0, self._sum + step), MISS_ALARM)
        allowed = np.clip(target, *self._own)
        barred = seen & (np.abs(target - allowed) > CANNOT * unit)
        out = (miss > limit) | barred
        self._in = 0 if out.any() or lost else self._in + 1
        if self._unreachable:
            self._unreachable = self._in < TAKE_BACK
        else:
            self._unreachable = self._sum >= MISS_ALARM or bool(barred.any())
        if not self._unreachable:
            return None
        if out.any():
            ends = np.where(miss > limit, reached, target)
            ends = np.where(barred & ~(np.abs(target - ends) > np.abs(target - allowed)), allowed, ends)
            self._worst = int(np.argmax(np.where(out, np.abs(target - ends), -1.0)))
            self._value = float(ends[self._worst])
        return self._worst, self._value

    def _held(
        self, observer: Observer, u: Array, d: Array, target: Array, side: Array, seen: Mask
    ) -> tuple[Array, Array]:
        """Return the controlled outputs nearest to the targets, and their derivatives by the biases w; the
        targets and zeros where no steady state is found."""
        model = self.model
        rows = self._rows
        optimiser = self._optimiser
        bias = observer.output_bias
        drive_bias = observer.drive_bias
        disturbance = observer.disturbance
        x_s, u_s = (observer.now, u) if self._x is None else (self._x, self._u)
        u_s, self._x = optimiser.drives.cut(u_s), None
        nothing = target, np.zeros((len(target), observer.w.size))
        for _ in range(STEADY_STEPS):
            after, A, B, E = model.linearise(x_s, u_s + drive_bias, d)
            by_w = B @ (disturbance.on_drive * model.span[:, None]) + E @ disturbance.on_disturbance
            try:
                by = np.linalg.solve(
                    np.eye(model.n_x) - A, np.column_stack([after - x_s, B * model.span, by_w])
                )
            except np.linalg.LinAlgError:
                return nothing
            if not np.isfinite(by).all():
                return nothing
            y = model.output(x_s + by[:, 0]) + bias
            G = model.C @ by[:, 1 : 1 + model.n_u]
            low, high = self._range(G, u_s, drive_bias)
            low = np.minimum(np.maximum((low - u_s) / model.span, -STRIDE), STRIDE)
            high = np.maximum(np.minimum((high - u_s) / model.span, STRIDE), low)
            z = self._nearest(G, y, target, side, seen, low, high)
            x_s, u_s = x_s + by[:, 0] + by[:, 1 : 1 + model.n_u] @ z, u_s + z * model.span
            moved = max(np.max(np.abs(by[:, 0])) / model.unit.max(), np.max(np.abs(z)))
            if moved < CONVERGED:
                self._x, self._u = x_s, u_s
                return (y + G @ z)[rows], (model.C @ by[:, 1 + model.n_u :] + disturbance.on_output)[rows]
        return nothing

    def _nearest(
        self, G: Array, y: Array, target: Array, side: Array, seen: Mask, low: Array, high: Array
    ) -> Array:
        """Return the change z (n_u,) of the drives, in ranges, that brings the outputs y nearest."""
        rows, limited = self._rows, self._limited
        allowed, near_limit = CAN * self.model.unit[rows], CAN * self.model.unit[limited]
        weight = np.where(seen, 1.0, 0.0)
        over = np.zeros(len(limited))  # +1 where the upper limit is in force, -1 the lower
        z = np.zeros(len(low))
        for _ in range(len(rows) + len(limited)):
            ends = np.where(over > 0, self._limits[1], self._limits[0])
            e = np.concatenate(
                [weight * (target - y[rows]), BEYOND_LIMIT * np.abs(over) * (ends - y[limited])]
            )
            weighted_gains = np.concatenate(
                [weight[:, None] * G[rows], (BEYOND_LIMIT * np.abs(over))[:, None] * G[limited]]
            )
            z = _least_squares_in_box(weighted_gains, e, low, high)
            new = y + G @ z
            before = weight, over
            weight = np.where(seen & (side * (new[rows] - target) > allowed), self._beyond, weight)
            over = np.where(new[limited] > self._limits[1] + near_limit, 1.0, over)
            over = np.where(new[limited] < self._limits[0] - near_limit, -1.0, over)
            if np.array_equal(weight, before[0]) and np.array_equal(over, before[1]):
                break  # another pass is the same
        return z

    def _range(self, G: Array, u: Array, drive_bias: Array) -> tuple[Array, Array]:
        """Return the ends (n_u,) of the drives: no further than the optimiser goes where a gain fades."""
        drives = self._optimiser.drives
        at_rest = self._optimiser.at_rest
        neutral = self.model.neutral
        if at_rest.settled is None:
            return drives.lowest, drives.highest
        gain = G[np.array(self._rows)[at_rest.strongest], np.arange(len(u))]
        return self._optimiser.faded_range(u - neutral, drive_bias, gain / at_rest.settled, neutral)


def _least_squares_in_box(G: Array, e: Array, low: Array, high: Array) -> Array:
    """Return z (n,) between low and high that makes |e - G z| least, by coordinates in turn."""
    H, f = (G.T @ G).tolist(), (G.T @ e).tolist()  # of a drive or two: lists are faster than arrays
    least = 1e-12 * max(sum(row[j] for j, row in enumerate(H)), 1e-300)
    ends, z = list(zip(low.tolist(), high.tolist())), [0.0] * len(f)
    for _ in range(SWEEPS):
        moved = 0.0
        for j, (row, (lowest, highest)) in enumerate(zip(H, ends)):
            gradient = f[j] - sum(map(mul, row, z))
            best = min(max(z[j] + gradient / (row[j] + least), lowest), highest)
            moved, z[j] = max(moved, abs(best - z[j])), best
        if moved < 1e-9:
            break
    return np.array(z)
