r"""State and disturbance estimate: an extended Kalman filter that makes regulation free of offset.

The plant never is the model.  What is missing is put into w disturbance states that the model does not
have, each constant but for slow random noise, and the controller then drives the *corrected* prediction to
the target:

    x+ = f(x, u + W_u w, d + W_d w),     w+ = w + noise,     y = C x + y0 + W_y w + noise.

The filter uses the Jacobian of the whole sample, delays included, at the current estimate.  It starts from a
plant at rest whose sensors are off (:func:`resting_state`), and looks at readings between samples too.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import Field, Strict
from scipy.linalg import block_diag, solve_discrete_are

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.errors import UserError
from thermogrip.mpc.estimator.call_times import SAME
from thermogrip.mpc.plant.prediction import ROOM, PredictionModel

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant

#: Of a plant without a record of its noise: of a reading, in its output's unit, and the drift of a drive's
#: bias in ranges a second.
NOISE, DRIFT = 0.05, 0.002

#: Of an output in its unit: standard deviation of a sensor's offset that nobody knows; of how far a plant
#: that is reported to be at rest moves in a sample; of its state from its own rest, where no reading shows.
OFFSET = 0.3
_RATE = 0.2
_FAR = 10.0


@dataclass(frozen=True, eq=False)
class RestingState:
    """Where a plant at rest may be, before its sensors are looked at."""

    x: Array  # (n_x,) mean
    P: Array  # (n_x, n_x) covariance
    # (n_x,) how the mean answers to the level of the readings and to the measured disturbances
    by_level: Array
    by_d: Array  # (n_x, n_d)
    # (n_u, n_x) the past drive of another state is that of the mean, plus this times the difference
    to_drive: Array
    drive: Array  # (n_u,) past drive of the mean

    def past_drive(self, x: Array) -> Array:
        """Return the drive (n_u,) that most likely held state x (n_x,)."""
        return np.asarray(self.drive + self.to_drive @ (x - self.x))


def resting_state(
    model: PredictionModel, x: Array, v: Array, y: Array, d: Array, *, unit: Array
) -> RestingState:
    """Return where a plant at rest may be, linearised at state x and drive v, in each state's ``unit``."""
    return _resting_state(model, *(tuple(values.tolist()) for values in (x, v, y, d, unit)))


# trials of many designs begin at the same readings: on a gripper 43 of 69 ms of a trial go into it
@lru_cache(maxsize=256)
def _resting_state(model: PredictionModel, *at: tuple[float, ...]) -> RestingState:
    x, v, y, d, unit = (np.array(values) for values in at)
    after, A, B, E = model.linearise(x, v, d)
    away = np.eye(model.n_x) - A
    push = after - A @ x + B @ (model.neutral - v)
    # linearised, (I - A) x = push + B (v - rest) + r with S = B span^2 B' + diag(rate^2), and so
    # P^-1 = (I - A)' S^-1 (I - A): a state that would leave its place by units within a sample is not
    # At rest the state stays where it is under some past drive v, but for a small rate r, and each reading is
    # off by an offset b of its own: v ~ N(rest, span^2), r ~ N(0, rate^2), b ~ N(0, offset^2).
    # accepted, whatever the sensors read, and what is left open the next readings decide
    scaled = B * model.span
    S = scaled @ scaled.T + np.diag((_RATE * unit) ** 2)
    weighted = np.linalg.solve(S, away).T  # (I - A)' S^-1
    # a slow mode moves little wherever it is: what no reading shows of it stays near the plant's own rest
    weak = 1.0 / (_FAR * unit) ** 2
    information = weighted @ away + np.diag(weak)
    P = np.linalg.inv(0.5 * (information + information.T))

    def own(step: float, change: Array) -> Array:
        # temperatures share a mean, outputs in other units are as they read
        return model.rest(np.where(model.warm, y + step, y), d + change)

    still = np.zeros(model.n_d)
    mean = P @ (weighted @ push + weak * own(0.0, still))
    by_level = P @ (weak * (own(1.0, still) - own(-1.0, still)) / 2)
    own_by_d = np.array([(own(0.0, e) - own(0.0, -e)) / 2 for e in np.eye(model.n_d)])
    by_d = P @ (weighted @ E + weak[:, None] * own_by_d.reshape(model.n_d, model.n_x).T)
    to_drive = model.span[:, None] * np.linalg.solve(S, scaled).T
    drive = model.neutral + to_drive @ (away @ mean - push)
    return RestingState(mean, 0.5 * (P + P.T), by_level, by_d, to_drive @ away, drive)


_REPEATS, _STEADY = 5, 1e-3  # of the start on a nonlinear plant, and when it is still [units]
#: Of a drive, in fractions of its range: what is larger, no drive could make up for.
LARGEST_BIAS = 1.0


@dataclass(frozen=True)
class DisturbanceModel:
    """Where the disturbance states enter."""

    names: tuple[str, ...]  # ``"drive"`` names first, e.g. ``("input drive", "output t_surface")``
    on_drive: Array  # (n_u, n_w) the matrices W_u, W_d, W_y; drives in fractions of their range
    on_disturbance: Array
    on_output: Array
    # how far the rank test is from failing: the smallest singular value over the largest allowed, see
    # :func:`detectability_margin`
    margin: float

    @property
    def n_w(self) -> int:
        """Number of disturbance states."""
        return len(self.names)


#: A standard deviation, in any unit.
Deviation = Annotated[float, Strict(), Field(ge=0, le=1e6)]


@dataclass(frozen=True)
class ObserverNoise:
    """Noise that the filter assumes, as standard deviations in a second; a reading's as it is."""

    state: Deviation = 0.005  # random heat in the states, over how they varied in the logs
    drive: dict[str, Deviation] = field(default_factory=dict)  # of a drive's bias, in its ranges
    output: Deviation = 0.03  # of a bias of an output, in its unit
    reading: dict[str, Deviation] = field(default_factory=dict)  # of one reading where the plant does not say
    # white noise of a drive on its way to the states, mean over a sample, in its ranges
    load: dict[str, Deviation] = field(default_factory=dict)


def reading_noise(plant: Plant, output: str) -> float | None:
    """Return the standard deviation of a reading, as the plant's record has it."""
    innovations = plant.scores.innovations
    by_fit = innovations.reading if innovations else {}
    return (by_fit or plant.scores.reading_sd or plant.noise).get(output)


def detectability_margin(
    A: Array, C: Array, into_state: Array, into_output: Array, *, scale: Array | None = None
) -> float:
    """Return how detectable disturbances in units of ``scale`` (n_w,) are: 0 where the rank test fails."""
    n_x, n_w = A.shape[0], into_state.shape[1]
    # With as many disturbances as measured outputs, and the augmented model detectable, the estimate can only
    # stand still where predicted and measured outputs agree: what the controller sees as settled is settled
    # (U. Maeder, F. Borrelli, M. Morari, "Linear offset-free model predictive control", Automatica 45, 2009).
    if n_w > C.shape[0]:
        return 0.0
    scale = np.ones(n_w) if scale is None else scale
    poles, vectors = np.linalg.eig(A)
    slow = np.abs(poles) >= 1 - 1e-9
    seen_of_slow = np.linalg.norm(C @ vectors[:, slow], axis=0) if slow.any() else np.ones(1)
    if np.any(seen_of_slow < 1e-9):
        return 0.0  # a mode that does not die out and cannot be seen
    # An integrator has no steady effects: the rank test itself decides.  A pole beyond 1, as a nonlinear
    # model may have at one point, is none: its equilibrium moves by as much as any other's.
    if np.any(np.abs(poles - 1) < 1e-9):
        # rank [A - I, B W_u + E W_d; C, W_y] = n_x + n_w, beside detectability of (A, C) itself
        whole = np.block([[A - np.eye(n_x), into_state * scale], [C, into_output * scale]])
        values = np.linalg.svd(whole, compute_uv=False)
        return float(values[-1] / values[0]) if values[-1] > 1e-9 * values[0] else 0.0
    # the least singular value is the change [degC] that the worst combination makes in steady state
    effect = into_output + C @ np.linalg.solve(np.eye(n_x) - A, into_state)
    values = np.linalg.svd(effect * scale, compute_uv=False)
    return float(values[-1]) if values[-1] > 1e-9 * max(1.0, float(values[0])) else 0.0


def choose_disturbances(
    model: PredictionModel, controlled: tuple[str, ...], *, ambient: float = 25.0, least: float = 1e-3
) -> DisturbanceModel:
    """Return the first set of disturbance states, one an output, that is detectable at rest."""
    _, A, B, E = model.linearise(*model.at_rest(ambient))
    chosen: list[tuple[str, int]] = []
    margin = float("inf")
    first = [i for i, name in enumerate(model.outputs) if name in controlled]
    uncontrolled = [i for i in range(model.n_y) if i not in first]
    # a bias on each drive (a heat flow that is wrong by a few watts), on the controlled outputs (a
    # thermocouple that sits elsewhere), on the other outputs, on the measured disturbances
    order = [("input", j) for j in range(model.n_u)]
    order += [("output", i) for i in first + uncontrolled]
    order += [("disturbance", k) for k in range(model.n_d)]
    for entry in order:
        if len(chosen) == model.n_y:
            break
        trial = _disturbance_matrices(model, [*chosen, entry])
        # 1 % of a drive's range, or 1 degC of bias, must make a steady change of ``least`` [degC]
        scale = np.array([0.01 if kind == "input" else 1.0 for kind, _ in [*chosen, entry]])
        into_state = B @ (trial["input"] * model.span[:, None]) + E @ trial["disturbance"]
        trial_margin = detectability_margin(A, model.C, into_state, trial["output"], scale=scale)
        if trial_margin > least:
            chosen, margin = [*chosen, entry], trial_margin
    if len(chosen) < len(controlled):
        from thermogrip.sysid.plant.plant import said_not_good

        problem = f"no disturbance model of {model.n_y} states is detectable from {', '.join(model.outputs)}"
        not_good = ": identify does not call this plant good" * said_not_good(model.plant.verdict)
        raise UserError(problem, hint=f"control an output that a drive can move{not_good}")
    on = _disturbance_matrices(model, chosen)
    names = {"input": model.drives, "output": model.outputs, "disturbance": model.disturbances}
    labels = tuple(f"{kind} {names[kind][row]}" for kind, row in chosen)
    return DisturbanceModel(labels, on["input"], on["disturbance"], on["output"], margin)


def _disturbance_matrices(model: PredictionModel, entries: list[tuple[str, int]]) -> dict[str, Array]:
    """Return on what each disturbance state (n_w) acts, by the kind of row."""
    sizes = {"input": model.n_u, "disturbance": model.n_d, "output": model.n_y}
    matrices = {kind: np.zeros((size, len(entries))) for kind, size in sizes.items()}
    for column, (kind, row) in enumerate(entries):
        matrices[kind][row, column] = 1.0
    return matrices


class Observer:
    """The filter: ``reset`` at rest, then ``update`` with a reading and ``predict`` with the move, in turn;
    at other times ``advance`` by the seconds that passed, ``look``, then ``update``."""

    def __init__(
        self,
        model: PredictionModel,
        disturbance: DisturbanceModel,
        noise: ObserverNoise | None = None,
        *,
        ambient: float = ROOM,
    ) -> None:
        self.model = model
        self.disturbance = disturbance
        self.ambient = ambient
        self.noise = noise if noise is not None else ObserverNoise()
        plant = model.plant
        self.offset = np.array([float(plant.offsets.get(name, 0.0)) for name in model.outputs])
        usual = NOISE * model.unit
        reading_sds = [self.noise.reading.get(name, reading_noise(plant, name)) for name in model.outputs]
        self.R = np.where([sd is None for sd in reading_sds], usual, [sd or 0.0 for sd in reading_sds]) ** 2
        self._H = np.hstack([model.C, disturbance.on_output])
        # States wander as they did in the logs, by all of their covariance over the outputs' spread. By its
        # diagonal alone the coordinates would matter: those of an output error integrate such noise three
        # times (a plate on its profile: IAE 1019 degC s, with all of the covariance 614).
        covariance = np.atleast_2d(plant.model.spread)
        covariance = covariance / max(float(np.diag(model.C @ covariance @ model.C.T).max()), 1e-24)
        self.unit = np.sqrt(np.maximum(np.diag(covariance), 1e-24))  # of each state by itself
        self._step_unit = self.unit * model.unit.max()  # what counts as a unit of each state at rest
        self.is_drive = disturbance.on_drive.any(axis=0)
        self._largest = np.where(self.is_drive, LARGEST_BIAS, np.inf)
        drives = np.array([self.noise.drive.get(name, DRIFT) for name in model.drives])
        # the unit of an output's bias is the output's, that of a measured disturbance's its own
        bias_unit = np.where(disturbance.on_output.any(axis=0), disturbance.on_output.T @ model.unit, 1.0)
        drift = np.where(self.is_drive, disturbance.on_drive.T @ drives, self.noise.output * bias_unit)
        by_drive = model.linearise(*model.at_rest(ambient)).B
        load = by_drive * model.span * [self.noise.load.get(name, 0.0) for name in model.drives]
        by_state = model.dt * self.noise.state**2 * covariance + load @ load.T
        self.Q = block_diag(by_state, np.diag(model.dt * drift**2))
        self.x = np.zeros(model.n_x)  # at the last sample
        self.w = np.zeros(disturbance.n_w)
        # what each sensor was found to read too much at the start or after a jump that stayed
        self.found_offset = np.zeros(model.n_y)
        self.P0 = np.where(self.is_drive, 0.03, OFFSET * bias_unit) ** 2
        # the start finds an offset where it is among the disturbance states, and it may drift;
        # a sensor without an offset among the disturbance states is read as loosely, once
        self.fixed: Mask = np.asarray(~disturbance.on_output.any(axis=1))
        self.R_start = self.R + np.where(self.fixed, (OFFSET * model.unit) ** 2, 0.0)
        self._n = model.n_x + disturbance.n_w
        self._P = np.zeros((self._n, self._n))
        self._held = np.zeros(self._n, dtype=bool)
        self._one = np.eye(self._n)
        self._to_drive = disturbance.on_drive * model.span[:, None]  # (n_u, n_w) in the drives' units
        self._on_sample()

    def hold_drives(self, weak: Mask) -> None:
        """Stop learning the bias of drives (n_u,) whose gain is weak or has turned over."""
        # near the optimum of a Peltier element a bias of the drive cannot be seen, and past it, it would be
        # learnt with the wrong sign; the other disturbances go on
        self._held[self.model.n_x : self._n] = (self.disturbance.on_drive * weak[:, None]).any(axis=0)

    def reset(self, y: Array, d: Array) -> None:
        """Start at rest at reading y (n_y,), NaN where a sensor is lost."""
        model, level = self.model, self._level(y, d)
        levels = np.where(np.isfinite(y), y - self.offset, model.usual(self.ambient))
        rests = np.where(model.warm, level, levels)
        x, v = model.rest(rests, d), model.neutral
        for _ in range(_REPEATS):  # Gauss-Newton: of a nonlinear plant the update is repeated at its answer
            resting = resting_state(model, x, v, rests, d, unit=self._step_unit)
            self._begin(resting.x, resting.P, y)
            moved = np.max(np.abs(self.x - x) / self.unit)
            x = self.x
            v = np.clip(resting.past_drive(x), model.lowest, model.highest)
            if not moved > _STEADY:
                break

    def reset_in_room(self, y: Array, d: Array) -> None:
        """Start as :meth:`reset`, with the plant linearised where all rests in the room: what the C does."""
        resting = self.rest_in_room
        x = resting.x + resting.by_level * (self._level(y, d) - self.ambient)
        x = x + resting.by_d @ (d - self.model.undisturbed(self.ambient))
        self._begin(x, resting.P, y)

    def _level(self, y: Array, d: Array) -> float:
        read_warm = np.isfinite(y) & self.model.warm
        return float(np.mean((y - self.offset)[read_warm])) if read_warm.any() else self.model.room(d)

    @cached_property
    def rest_in_room(self) -> RestingState:
        """Where the plant may rest, linearised where all is as warm as the room, or amid the logs."""
        model = self.model
        x, v, d = model.at_rest(self.ambient)
        usual = model.usual(self.ambient)
        level = float(np.mean(usual[model.warm]))
        resting = resting_state(model, x, v, np.where(model.warm, level, usual), d, unit=self._step_unit)
        return replace(resting, x=resting.x + (self.ambient - level) * resting.by_level)

    def _begin(self, x: Array, P: Array, y: Array) -> None:
        """Start from a Gaussian state and a reading (n_y,)."""
        self.x, self.w = x, np.zeros(self.disturbance.n_w)
        self._held[:] = False
        self._on_sample()
        self.found_offset = np.zeros(self.model.n_y)
        self._P = block_diag(P, np.diag(self.P0))
        # one Kalman update is the weighted least-squares answer for state, offsets and past drive together
        self._correct(y, self.R_start)
        self.set_offsets(y, np.asarray(self.fixed))

    def estimate(self) -> dict[str, Array]:
        """Return what the filter knows: ``x``, ``w``, their covariance ``P`` and ``found_offset``."""
        return {"x": self.x, "w": self.w, "P": self._P, "found_offset": self.found_offset}

    def set_offsets(self, y: Array, which: Mask) -> None:
        """Take what a reading (n_y,) differs by for offsets of the sensors ``which`` (n_y,)."""
        is_read = which & np.isfinite(y)
        self.found_offset = self.found_offset + np.where(is_read, np.nan_to_num(y) - self.reading(), 0.0)

    def _on_sample(self) -> None:
        # seconds since x, and the drives summed over them
        self._into, self._dose = 0.0, np.zeros(self.model.n_u)
        # of a sample: where readings are compared, and how much of Q is in P
        self._share, self._noised = 0.0, 0.0
        # the state there, its derivative by (x, w), and how far an output may be from a straight line [degC]
        self._ahead, self._way = self.x, np.zeros((0, 0))
        self._bent = np.zeros(self.model.n_y)

    @property
    def now(self) -> Array:
        """The state (n_x,) where readings are compared: at the last sample or between it and the next."""
        return self._ahead if self._share else self.x

    @property
    def drive_bias(self) -> Array:
        """What to add to the drives (n_u,), in their units."""
        return np.asarray(self.disturbance.on_drive @ self.w * self.model.span)

    @property
    def disturbance_bias(self) -> Array:
        """What to add to the measured disturbances (n_d,)."""
        return np.asarray(self.disturbance.on_disturbance @ self.w)

    @property
    def output_bias(self) -> Array:
        """What to add to the model's outputs to get readings (n_y,)."""
        return np.asarray(self.offset + self.found_offset + self.disturbance.on_output @ self.w)

    def reading(self) -> Array:
        """Return the reading (n_y,) that the filter expects now."""
        return self.model.output(self.now) + self.output_bias

    def settled_gain(self, step: Array) -> Array:
        """Return the gain (n_x + n_w, n_y) that the filter settles at with this Jacobian of a sample."""
        n = step.shape[0]
        Q = self._noise(1.0)[:n, :n] + 1e-12 * np.eye(n)
        P = solve_discrete_are(step.T, self._H.T, Q, np.diag(self.R))
        innovation = self._H @ P @ self._H.T + np.diag(self.R)
        return np.asarray(np.linalg.solve(innovation, self._H @ P).T)

    def update(self, y: Array) -> Array:
        """Correct the estimate with a reading (n_y,), NaN where lost; return the innovation (n_y,)."""
        return self._correct(y, self.R + self._bent**2)

    def _correct(self, y: Array, R: Array) -> Array:
        """Correct the estimate with a reading whose variances are R (n_y,), but for states that are held."""
        innovation = y - self.reading()
        read = np.flatnonzero(np.isfinite(y))  # the prediction replaces the others
        if read.size:
            H = self._H[read] @ self._way if self._share else self._H[read]
            PH = self._P @ H.T
            S = H @ PH + np.diag(R[read])
            gain = np.linalg.solve(S, PH.T).T
            gain[np.asarray(self._held, dtype=bool)] = 0.0  # C holds whole numbers
            uncorrected = self._one - gain @ H  # Joseph's form: right for any gain
            self._P = uncorrected @ self._P @ uncorrected.T + (gain * R[read]) @ gain.T
            change, n_x = gain @ innovation[read], self.model.n_x
            w = self.w + change[n_x:]
            w = np.minimum(np.maximum(w, -self._largest), self._largest)
            if self._share:
                change[n_x:] = w - self.w
                self._ahead = self._ahead + (self._way @ change)[:n_x]
            self.x, self.w = self.x + change[:n_x], w
        return np.asarray(innovation)

    def _noise(self, share: float) -> Array:
        """Return the covariance that a share of a sample adds to the states (n_x + n_w, n_x + n_w)."""
        return np.where(self._held, 0.0, share * self.Q)

    def predict(self, u: Array, d: Array) -> None:
        """Carry the estimate one sample on under drives u (n_u,) and disturbances d (n_d,)."""
        self.x, step = self._sample(u, d)
        self._P = step @ self._P @ step.T + self._noise(1 - self._noised)
        self._on_sample()

    def advance(self, seconds: float, u: Array, d: Array) -> None:
        """Let so many seconds pass under drives u (n_u,) and disturbances d (n_d,)."""
        dt, remaining_s = self.model.dt, seconds
        while self._into + remaining_s >= dt * (1 - SAME):
            to_sample_s = dt - self._into
            mean = u if self._into <= SAME * dt else (self._dose + to_sample_s * u) / dt
            self.predict(mean, d)
            remaining_s -= to_sample_s
        self._into, self._dose = self._into + remaining_s, self._dose + remaining_s * u

    def look(self, d: Array) -> None:
        """Look where :meth:`advance` has come to, between two samples: readings are compared there."""
        share = self._into / self.model.dt
        if share <= SAME:
            return
        # x stays on a grid of samples, each predicted under the mean of the drives that were applied in it: a
        # model whose delays are shift registers can be advanced by whole samples alone
        after, step = self._sample(self._dose / self._into, d)
        P = self._P + self._noise(share - self._noised)  # the states' noise grows with the seconds
        self._P = P
        self._share = share
        self._noised = share
        # x_s = (1 - s) x + s f(x, u, d) and H_s = H ((1 - s) 1 + s F), u the mean of the drives since x: a
        # register between two samples holds the mean of its neighbours, and since x itself is never
        # interpolated nothing is smeared from sample to sample
        self._ahead = (1 - share) * self.x + share * after
        self._way = (1 - share) * self._one + share * step
        # a straight line between two samples is not the path of an output that moves
        self._bent = 4 * share * (1 - share) * (self.model.C @ (after - self.x))

    def _sample(self, u: Array, d: Array) -> tuple[Array, Array]:
        """Return the state a sample later, and the Jacobian of the filter's states."""
        n_x, disturbance = self.model.n_x, self.disturbance
        after, A, B, E = self.model.linearise(self.x, u + self.drive_bias, d + self.disturbance_bias)
        step = self._one.copy()
        step[:n_x, :n_x] = A
        step[:n_x, n_x:] = B @ self._to_drive + E @ disturbance.on_disturbance
        return after, step
