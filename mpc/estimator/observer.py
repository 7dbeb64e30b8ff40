r"""State and disturbance estimate: an extended Kalman filter that makes regulation free of offset.

The plant never is the model.  What is missing is put into w disturbance states that the model does not
have, each constant but for slow random noise, and the controller then drives the *corrected* prediction to
the target:

    x+ = f(x, u + W_u w, d + W_d w),     w+ = w + noise,     y = C x + y0 + W_y w + noise.

With as many disturbances as measured outputs, and the augmented model detectable, the estimate can only
stand still where predicted and measured outputs agree, so the output that the controller sees as settled is
settled [1]_. Detectability of the augmented model is the rank condition

    rank [ A - I    B W_u + E W_d ]
         [ C        W_y           ]  =  n_x + n_w,

together with detectability of (A, C) itself.  ``choose_disturbances`` tests it and takes the first set
that passes, in this order: a bias on each drive (a heat flow that is wrong by a few watts), a bias on the
controlled outputs (a thermocouple that sits elsewhere), on the other outputs, on the measured disturbances.

The filter uses the Jacobian of the whole sample, delays included, at the current estimate.  A reading that
is NaN is left out of the update: the prediction replaces it.  The bias of a drive ends at its whole
range: what is larger, no drive could make up for.
Near the optimum of a Peltier element a bias of the drive cannot be seen, and past it, it would be learnt
with the wrong sign: it is held there.

The first samples of a black box's response are a fit's and no physics, and a loop that learns a drive's bias
from them rings; one that learns slowly leaves an offset for minutes after a load.  So its bias is learnt
slowly, and 5 times as fast while the mean of some 50 innovations is off by 3 of its standard deviations: what
lasts is a load.

The filter starts from a plant at rest whose sensors are off (see below).
Where an output has an offset among the disturbance states, that is where the start finds it, and it may
drift; of the other outputs the start keeps a constant offset.

**Between samples.**  Readings come when they come, and a model whose delays are shift registers can be
advanced by whole samples alone.  So x stays on a grid of samples, each predicted under the mean of the
drives that were applied in it, and a reading that comes the share s of a sample after x is one of

    x_s = (1 - s) x + s f(x, u, d),     H_s = H ((1 - s) 1 + s F),

u the mean of the drives since x and F the Jacobian of the sample.  A register between two samples holds the
mean of its neighbours, and nothing is smeared from sample to sample, because x itself is never interpolated.
The noise of the states grows with the seconds, by s Q in the share s of a sample.  Every reading counts, also
one that comes before a move is due; but where the output moves, a straight line between two samples is not
its path, and the standard deviation of such a reading is larger by 4 s (1 - s) times its move. What the line
leaves out has the same sign within a sample and looks like a lag (below): readings between two moves leave
lags and scales where they are.

**A plant that is slower than the model.**  A sensor's pocket, a layer or a longer tube that the model lacks
looks like a drive that is too weak, until it looks like one that is too strong, and the loop swings.  So each
controlled output is read through a lag T of its own, 0 at the start and never below,

    s+ = s + a (z - s),    y = s + a (z - s) + biases,    a = dt / (dt + T),    z = C x + k (C x - C x_0),

with s, what was shown last, T and k among the states of the filter.  k is by what share the output moves more
than the model's since the start: on a ramp a loss or a coupling that is off by a few percent looks like a lag
that grows with the way gone, and would be taken for one.  It is 0 at the start and becomes uncertain by and
by, for the first samples of a rise show a lag.  The way (z - s) and the share a come as a product and are
both unknown; its derivatives are small where the output stands still, and taken alone they would find a lag
in noise.  Deviations e, f of a joint Gaussian have var(e f) = var(e) var(f) + cov(e, f)^2, so that a reading
has

    a'^2 ( var(z - s) var(T) + cov(z - s, T)^2 ),    a' = da/dT = -dt / (dt + T)^2,

of variance besides.  The plan still brings x to the target, not s: whether the skin is slow or its sensor,
what follows x through a lag does not go beyond it.  Where T would be negative, or beyond what is looked for
(six samples, or four times its standard deviation at the start), the estimate is the conditional mean at
that end [2]_.  Where a delay is as short as a sample or two, a pocket of some samples costs nothing to allow
for, and much to overlook: T has a larger standard deviation at the start there (``default_design``).

References
----------
.. [1] U. Maeder, F. Borrelli, M. Morari, "Linear offset-free model predictive control", Automatica 45(10),
   2009.
.. [2] D. Simon, "Kalman filtering with state constraints: a survey of linear and nonlinear algorithms", IET
   Control Theory and Applications 4(8), 2010.

What state a plant at rest is in, when its sensors do not agree
---------------------------------------------------------------

At rest the state stays where it is under some past drive v, but for a small rate r,

    x = f(x, v, d) + r,     v ~ N(rest, span^2),     r ~ N(0, (0.2 degC a sample)^2),

and each reading is off by an offset of its own, b ~ N(0, (0.3 degC)^2).  Linearised, x is Gaussian with

    (I - A) x = h + B (v - rest) + r,     P^-1 = (I - A)' S^-1 (I - A),     S = B span^2 B' + diag(rates^2),

and one Kalman update with the readings is the weighted least-squares answer for state, offsets and past drive
together.  A state that would leave its place by degrees within a sample is not accepted, whatever the sensors
read: they are off.  What is left open between a state that moves and a sensor that is off is in the
covariance, and the next readings decide.  A slow mode moves little wherever it is; what no reading shows of
it stays within 10 degC of where the plant's own ``rest`` has it at the mean of the readings; of outputs in
several units the temperatures alone share a mean, others are as they read.

For a nonlinear plant the update is repeated at its own answer (Gauss-Newton).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.linalg import solve_discrete_are

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.errors import UserError
from thermogrip.mpc.estimator.call_times import SAME
from thermogrip.mpc.plant.prediction import ROOM, PredictionModel

#: Standard deviation of a sensor's offset that nobody knows [degC].
OFFSET = 0.3
_RATE = 0.2  # degC a sample, of a plant that is reported to be at rest
_NOISIEST = 4.0  # times the sensor's noise that a reading of a black box may have
_FAR = 10.0  # degC from the plant's own rest, of what neither rest nor readings hold


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
    """Return where a plant at rest may be, linearised at state x (n_x,) and drive v (n_u,), for outputs y
    (n_y,), temperatures all at the mean of their readings; ``unit`` (n_x,) is what counts as 1 degC of each
    state. Shared: read it."""
    return _resting_state(model, *(tuple(values.tolist()) for values in (x, v, y, d, unit)))


@lru_cache(maxsize=256)  # trials of many designs begin at the same readings
def _resting_state(model: PredictionModel, *at: tuple[float, ...]) -> RestingState:
    x, v, y, d, unit = (np.array(values) for values in at)
    after, A, B, E = model.linearise(x, v, d)
    away = np.eye(model.n_x) - A
    push = after - A @ x + B @ (model.neutral - v)
    scaled = B * model.span
    S = scaled @ scaled.T + np.diag((_RATE * unit) ** 2)
    weighted = np.linalg.solve(S, away).T  # (I - A)' S^-1
    weak = 1.0 / (_FAR * unit) ** 2
    information = weighted @ away + np.diag(weak)
    P = np.linalg.inv(0.5 * (information + information.T))

    def own(step: float, change: Array) -> Array:
        return model.rest(np.where(model.warm, y + step, y), d + change)

    still = np.zeros(model.n_d)
    mean = P @ (weighted @ push + weak * own(0.0, still))
    by_level = P @ (weak * (own(1.0, still) - own(-1.0, still)) / 2)
    own_by_d = np.array([(own(0.0, e) - own(0.0, -e)) / 2 for e in np.eye(model.n_d)])
    by_d = P @ (weighted @ E + weak[:, None] * own_by_d.reshape(model.n_d, model.n_x).T)
    to_drive = model.span[:, None] * np.linalg.solve(S, scaled).T
    drive = model.neutral + to_drive @ (away @ mean - push)
    return RestingState(mean, 0.5 * (P + P.T), by_level, by_d, to_drive @ away, drive)


@lru_cache(maxsize=16)
def resting_state_in_room(model: PredictionModel, ambient: float, unit: tuple[float, ...]) -> RestingState:
    """Return :func:`resting_state` linearised where all rests in a room of ``ambient`` [degC], or amid what
    the logs showed."""
    x, v, d = model.at_rest(ambient)
    usual = model.usual(ambient)
    level = float(np.mean(usual[model.warm]))
    y = np.where(model.warm, level, usual)
    rest = resting_state(model, x, v, y, d, unit=np.array(unit))
    return replace(rest, x=rest.x + (ambient - level) * rest.by_level)


#: Lag of an output beyond the model's: the longest, in samples and in standard deviations at the start, and
#: how far it drifts [s per sqrt(s)].
LONGEST_LAG, _LONGEST, _LAG_DRIFT = 6.0, 4.0, 0.02
#: Per sqrt(sample), of the share by which an output moves more than the model's.
_SCALE_DRIFT = 0.001
_REPEATS, _SAME = 5, 1e-3  # of the start on a nonlinear plant, and when it is still [degC]
NEWEST_INNOVATION = 0.2  # share of the newest innovation in their mean
# the same in the mean that shows what lasts, from how many of its standard deviations on it does, and how
# many times as fast a black box then learns what a drive lacks
LASTING, LASTS, _QUICKER = 0.02, 3.0, 5.0
#: Of a drive, in fractions of its range: no drive makes up for more.
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


@dataclass(frozen=True)
class ObserverNoise:
    """Noise that the filter assumes, as standard deviations."""

    state: float = 0.005  # random heat in the states [degC per sqrt(s)], in units of each state's own swing
    drive: float = 0.002  # process noise of a drive bias [fraction of its range per sqrt(s)]
    output: float = 0.002  # process noise of an output bias [degC per sqrt(s)]
    reading: float = 0.05  # of one reading where the plant does not say [degC]
    lag: float = 1.5  # of what an output lags behind the model, at the start [samples]


def detectability_margin(
    A: Array, C: Array, into_state: Array, into_output: Array, *, scale: Array | None = None
) -> float:
    """Return how detectable the disturbances are: 0 is not at all.

    Their steady effect on the outputs is G = W_y + C (I - A)^-1 W_x, with W_x (n_x, n_w) and W_y (n_y, n_w).
    Its least singular value, disturbances in units of ``scale`` (n_w,) and outputs in degC, is the change
    that the worst combination of them makes; 0 exactly where the rank test fails. Without (I - A)^-1 (an
    integrator) the rank test itself decides.
    """
    n_x, n_w = A.shape[0], into_state.shape[1]
    if n_w > C.shape[0]:
        return 0.0
    scale = np.ones(n_w) if scale is None else scale
    poles, vectors = np.linalg.eig(A)
    slow = np.abs(poles) >= 1 - 1e-9
    seen = np.linalg.norm(C @ vectors[:, slow], axis=0) if slow.any() else np.ones(1)
    if np.any(seen < 1e-9):
        return 0.0  # a mode that does not die out and cannot be seen
    if slow.any():
        whole = np.block([[A - np.eye(n_x), into_state * scale], [C, into_output * scale]])
        values = np.linalg.svd(whole, compute_uv=False)
        return float(values[-1] / values[0]) if values[-1] > 1e-9 * values[0] else 0.0
    effect = into_output + C @ np.linalg.solve(np.eye(n_x) - A, into_state)
    values = np.linalg.svd(effect * scale, compute_uv=False)
    return float(values[-1]) if values[-1] > 1e-9 * max(1.0, float(values[0])) else 0.0


def choose_disturbances(
    model: PredictionModel,
    controlled: tuple[str, ...],
    *,
    ambient: float = 25.0,
    least: float = 1e-3,
    count: int | None = None,
) -> DisturbanceModel:
    """Return the first set of ``count`` disturbance states (one an output by default) that passes the rank
    test of the module's theory.

    The test is made at rest at ``ambient``; ``least`` is the steady change [degC] that 1 % of a drive's
    range, or 1 degC of bias, must make. A UserError says that no set is detectable.
    """
    wanted = model.n_y if count is None else count
    _, A, B, E = model.linearise(*model.at_rest(ambient))
    chosen: list[tuple[str, int]] = []
    margin = float("inf")
    for entry in _in_order(model, controlled):
        if len(chosen) == wanted:
            break
        trial = _matrices(model, [*chosen, entry])
        scale = np.array([0.01 if kind == "input" else 1.0 for kind, _ in [*chosen, entry]])
        into_state = B @ (trial[0] * model.span[:, None]) + E @ trial[1]
        found = detectability_margin(A, model.C, into_state, trial[2], scale=scale)
        if found > least:
            chosen, margin = [*chosen, entry], found
    if len(chosen) < min(wanted, len(controlled)):
        raise UserError(
            f"no disturbance model of {wanted} states is detectable from {', '.join(model.outputs)}",
            hint="control an output that a drive can move"
            + (": identify does not call this plant good" if "; not good: " in model.plant.verdict else ""),
        )
    on_drive, on_disturbance, on_output = _matrices(model, chosen)
    names = {"input": model.drives, "output": model.outputs, "disturbance": model.disturbances}
    labels = tuple(f"{kind} {names[kind][at]}" for kind, at in chosen)
    return DisturbanceModel(labels, on_drive, on_disturbance, on_output, margin if chosen else 0.0)


def _in_order(model: PredictionModel, controlled: tuple[str, ...]) -> list[tuple[str, int]]:
    first = [i for i, name in enumerate(model.outputs) if name in controlled]
    rest = [i for i in range(model.n_y) if i not in first]
    order = [("input", j) for j in range(model.n_u) if j not in model.on_off]
    order += [("output", i) for i in first + rest]
    return order + [("disturbance", k) for k in range(model.n_d)]


def _matrices(model: PredictionModel, entries: list[tuple[str, int]]) -> tuple[Array, Array, Array]:
    n_w = len(entries)
    found = {
        "input": np.zeros((model.n_u, n_w)),
        "disturbance": np.zeros((model.n_d, n_w)),
        "output": np.zeros((model.n_y, n_w)),
    }
    for column, (kind, at) in enumerate(entries):
        found[kind][at, column] = 1.0
    return found["input"], found["disturbance"], found["output"]


class Observer:
    """The filter: ``reset`` at rest, then ``update`` with a reading and ``predict`` with the move, in turn.

    Where readings come at other times: ``advance`` by the seconds that passed, ``look``, then ``update``. x
    (n_x,) is the state at the last sample, w (n_w,) the disturbances, ``found_offset`` (n_y,) what each
    sensor was found to read too much at the start or after a jump that stayed [degC], ``innovation`` (n_y,)
    the mean of the last innovations in their standard deviations.  Of the outputs ``lagged``, ``shown`` is
    what they showed a sample before x [degC], ``lag`` by how much they lag behind the model [s], ``scale`` by
    what share they move more than it does since they stood at ``start`` [degC].
    """

    def __init__(
        self,
        model: PredictionModel,
        disturbance: DisturbanceModel,
        noise: ObserverNoise | None = None,
        *,
        ambient: float = ROOM,
        lagged: Sequence[int] = (),
    ) -> None:
        self.model, self.disturbance, self.ambient = model, disturbance, ambient
        self.lagged = list(lagged)
        self.noise = noise if noise is not None else ObserverNoise()
        self.first_lag = self.noise.lag * model.dt
        self.longest_lag = max(LONGEST_LAG, _LONGEST * self.noise.lag) * model.dt
        plant = model.plant
        self.offset = np.array([float(plant.offsets.get(name, 0.0)) for name in model.outputs])
        sd = [plant.noise.get(name, self.noise.reading) for name in model.outputs]
        # a black box has the noise that shares a first error with the state best: at most sensor and model;
        # what a free run strays by lasts, and is no noise: of a poor model so many times the sensor's
        known, errs = plant.scores.reading_sd, plant.scores.held_out_rmse
        own = [np.hypot(known.get(n, np.inf), errs.get(n, np.inf)) for n in model.outputs]
        most = [_NOISIEST * known.get(n, 0.0) or np.inf for n in model.outputs]
        self.R = np.maximum(np.minimum(np.minimum(sd, own), most), 0.02) ** 2
        self._H = np.hstack([model.C, disturbance.on_output])
        # a state's own unit: its spread, seen against the spread of the outputs
        spread = np.sqrt(np.maximum(np.diag(np.atleast_2d(plant.model.spread)), 1e-12))
        seen = np.sqrt(np.einsum("ij,j,ij->i", model.C, spread**2, model.C)).max()
        self.unit = spread / max(float(seen), 1e-12)
        self.is_drive = disturbance.on_drive.any(axis=0)
        drift = np.where(self.is_drive, self.noise.drive, self.noise.output)
        n_l, still = len(self.lagged), np.zeros(len(self.lagged))
        lag = still + (_LAG_DRIFT * model.dt) ** 2
        scale = still + _SCALE_DRIFT**2 / model.dt
        own = [(self.noise.state * self.unit) ** 2, drift**2, still, lag, scale]
        self.Q = np.concatenate(own) * model.dt
        quicker = _QUICKER**2 if plant.scores.structure else 1.0
        self._sooner = np.ones(self.Q.size)
        self._sooner[model.n_x : model.n_x + disturbance.n_w] = np.where(self.is_drive, quicker, 1.0)
        self.x = np.zeros(model.n_x)
        self.w = np.zeros(disturbance.n_w)
        self.shown, self.lag, self.scale, self.start = (still.copy() for _ in range(4))
        self.found_offset = np.zeros(model.n_y)
        self.P0 = np.where(self.is_drive, 0.03, OFFSET) ** 2
        # a sensor without an offset among the disturbance states is read as loosely, once
        self.fixed: Mask = np.asarray(~disturbance.on_output.any(axis=1))
        self.R_start = self.R + np.where(self.fixed, OFFSET**2, 0.0)
        self._n = model.n_x + disturbance.n_w
        self._P = np.zeros((self._n + 3 * n_l,) * 2)
        self._held = np.zeros(self._n + 3 * n_l, dtype=bool)
        self.innovation, self.lasting = np.zeros(model.n_y), np.zeros(model.n_y)
        self._on_sample()

    def expect_lags(self) -> None:
        """After a reset, allow for outputs that lag behind the model."""
        n_l, P = len(self.lagged), self._P.copy()
        at = np.arange(self._n + n_l, self._n + 2 * n_l)
        P[at, at] = self.first_lag**2
        self._P = P

    def hold_drives(self, weak: Mask) -> None:
        """Stop learning the bias of drives (n_u,) whose gain is weak or has turned over, where a bias
        explains nothing or everything with the wrong sign; the other disturbances go on."""
        self._held[self.model.n_x : self._n] = (self.disturbance.on_drive * weak[:, None]).any(axis=0)

    def reset(self, y: Array, d: Array) -> None:
        """Start at rest at reading y (n_y,), NaN where a sensor is lost; see the module's theory."""
        model, level = self.model, self._level(y, d)
        own = np.where(np.isfinite(y), y - self.offset, model.usual(self.ambient))
        rests = np.where(model.warm, level, own)
        x, v = model.rest(rests, d), model.neutral
        for _ in range(_REPEATS):
            rest = resting_state(model, x, v, rests, d, unit=self.unit)
            self._begin(rest.x, rest.P, y)
            moved = np.max(np.abs(self.x - x) / self.unit)
            x = self.x
            v = np.clip(rest.past_drive(x), model.lowest, model.highest)
            if not moved > _SAME:
                break

    def reset_in_room(self, y: Array, d: Array) -> None:
        """Start as :meth:`reset`, with the plant linearised where all rests in the room: what the C does."""
        rest = self.rest_in_room()
        x = rest.x + rest.by_level * (self._level(y, d) - self.ambient)
        x = x + rest.by_d @ (d - self.model.undisturbed(self.ambient))
        self._begin(x, rest.P, y)

    def _level(self, y: Array, d: Array) -> float:
        known = np.isfinite(y) & self.model.warm
        return float(np.mean((y - self.offset)[known])) if known.any() else self.model.room(d)

    def rest_in_room(self) -> RestingState:
        """Return where the plant may rest, linearised where all is as warm as the room."""
        return resting_state_in_room(self.model, self.ambient, tuple(self.unit.tolist()))

    def _begin(self, x: Array, P: Array, y: Array) -> None:
        """Start from a Gaussian state and a reading (n_y,)."""
        n_x, n, n_l = self.model.n_x, self._n, len(self.lagged)
        self.x, self.w = x, np.zeros(self.disturbance.n_w)
        self.lag, self.scale = np.zeros(n_l), np.zeros(n_l)
        self.shown = self.model.output(x)[self.lagged]
        self._held[:] = False
        self._on_sample()
        self.found_offset, self.innovation = np.zeros(self.model.n_y), np.zeros(self.model.n_y)
        self.lasting = np.zeros(self.model.n_y)
        whole = np.zeros((n + 3 * n_l,) * 2)
        whole[:n_x, :n_x] = P
        whole[n_x:n, n_x:n] = np.diag(self.P0)
        self._P = whole
        self._correct(y, self.R_start)
        # at rest every output shows what the model has
        shows = np.eye(n + 3 * n_l)
        shows[n : n + n_l, :n_x] = self.model.C[self.lagged]
        self._P = shows @ self._P @ shows.T
        self.shown = self.start = self.model.output(self.x)[self.lagged]
        self.set_offsets(y, np.asarray(self.fixed))

    def estimate(self) -> dict[str, Array]:
        """Return what the filter knows: ``x``, ``w``, ``shown``, ``lag``, ``scale``, their covariance ``P``,
        ``found_offset`` and ``start``."""
        about = {"x": self.x, "w": self.w, "shown": self.shown, "lag": self.lag, "scale": self.scale}
        return about | {"P": self._P, "found_offset": self.found_offset, "start": self.start}

    @property
    def lag_sd(self) -> Array:
        """Standard deviations of the lags [s]."""
        at, n_l = self._n + len(self.lagged), len(self.lagged)
        return np.asarray(np.sqrt(np.diag(self._P)[at : at + n_l]))

    def set_offsets(self, y: Array, which: Mask) -> None:
        """Take what a reading (n_y,) differs by for offsets of the sensors ``which`` (n_y,)."""
        seen = which & np.isfinite(y)
        self.found_offset = self.found_offset + np.where(seen, np.nan_to_num(y) - self.reading(), 0.0)

    def _on_sample(self) -> None:
        # seconds since x, and the drives summed over them
        self._into, self._dose = 0.0, np.zeros(self.model.n_u)
        # of a sample: where readings are compared, and how much of Q is in P
        self._share, self._noised = 0.0, 0.0
        # the state there, its derivative by (x, w), and how far an output may be from a straight line [degC]
        self._ahead, self._shown_ahead, self._way = self.x, self.shown, np.zeros((0, 0))
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
        """What to add to the model's outputs to get readings (n_y,), once none lags."""
        bias = self._sensor_bias
        bias[self.lagged] += self.scale * (self.model.output(self.now)[self.lagged] - self.start)
        return bias

    @property
    def _sensor_bias(self) -> Array:
        return np.asarray(self.offset + self.found_offset + self.disturbance.on_output @ self.w)

    def reading(self) -> Array:
        """Return the reading (n_y,) that the filter expects now."""
        y = self.model.output(self.now)
        y[self.lagged] = self._behind(y[self.lagged], self._shown_now)[0]
        return y + self._sensor_bias

    @property
    def _shown_now(self) -> Array:
        return self._shown_ahead if self._share else self.shown

    def _shows(self, x: Array, shown: Array) -> tuple[Array, Array]:
        """Return what the outputs (n_y,) show without biases, and its derivatives by the filter's states."""
        model, n, n_l = self.model, self._n, len(self.lagged)
        y, H = model.output(x), np.hstack([self._H, np.zeros((model.n_y, 3 * n_l))])
        y[self.lagged], share, risen, far = self._behind(y[self.lagged], shown)
        H[self.lagged, : model.n_x] *= (share * (1 + self.scale))[:, None]
        by_own = np.concatenate([1 - share, -far * share**2 / model.dt, share * risen])
        H[3 * self.lagged, np.arange(n, n + 3 * n_l)] = by_own
        return y, H

    def _behind(self, y: Array, shown: Array) -> tuple[Array, Array, Array, Array]:
        """Return what lagging outputs y show that showed so much a sample before, the share of the way that
        this is, how far the model has risen since the start, and the way."""
        share, risen = self.model.dt / (self.model.dt + self.lag), y - self.start
        far = y + self.scale * risen - shown
        return shown + share * far, share, risen, far

    def settled_gain(self, step: Array) -> Array:
        """Return the gain (n_x + n_w, n_y) that the filter settles at with this Jacobian of a sample."""
        n = step.shape[0]
        P = solve_discrete_are(step.T, self._H.T, np.diag(self.Q[:n] + 1e-12 * np.ones(n)), np.diag(self.R))
        innovation = self._H @ P @ self._H.T + np.diag(self.R)
        return np.asarray(np.linalg.solve(innovation, self._H @ P).T)

    def update(self, y: Array) -> Array:
        """Correct the estimate with a reading (n_y,), NaN where lost; return the innovation (n_y,)."""
        return self._correct(y, self.R + self._bent**2, remember=NEWEST_INNOVATION)

    def refine(self, y: Array) -> None:
        """Correct the estimate with a reading (n_y,) between two moves; the mean innovation is that of
        moves, and what a straight line leaves out is not taken for a lag."""
        held = self._held.copy()
        held[self._n + len(self.lagged) :] = True
        self._correct(y, self.R + self._bent**2, held=held)

    @property
    def innovation_bias(self) -> float:
        """How far the mean innovation is from 0, in standard deviations of that mean; the largest of all."""
        return float(np.max(np.abs(self.innovation)) * np.sqrt((2 - NEWEST_INNOVATION) / NEWEST_INNOVATION))

    def _correct(self, y: Array, R: Array, *, remember: float = 0.0, held: Mask | None = None) -> Array:
        """Correct the estimate with a reading whose variances are R (n_y,), but for states that are held."""
        innovation = y - self.reading()
        seen = np.flatnonzero(np.isfinite(y))
        if seen.size:
            H = self._shows(self.now, self._shown_now)[1][seen]
            H = H @ self._way if self._share else H
            R = R + self._doubt()
            PH = self._P @ H.T
            S = H @ PH + np.diag(R[seen])
            gain = np.linalg.solve(S, PH.T).T
            scaled, last = innovation[seen] / np.sqrt(np.diag(S)), LASTING if remember else 0.0
            mean, lasting = self.innovation.copy(), self.lasting.copy()
            mean[seen] += remember * (scaled - mean[seen])
            lasting[seen] += last * (scaled - lasting[seen])
            self.innovation, self.lasting = mean, lasting
            held = np.asarray(self._held if held is None else held, dtype=bool)  # C holds whole numbers
            gain[held] = 0.0
            left = np.eye(self._P.shape[0]) - gain @ H  # Joseph's form: right for any gain
            self._P = left @ self._P @ left.T + (gain * R[seen]) @ gain.T
            self._change(self._inside(gain @ innovation[seen], held))
        return np.asarray(innovation)

    @property
    def Q_lasting(self) -> Array:
        """Variance that a sample adds to the states while innovations stay on one side."""
        return np.asarray(self.Q * self._sooner)

    def _noise(self, share: float) -> Array:
        """Return the variance that a share of a sample adds to the states."""
        lasts = np.max(np.abs(self.lasting)) * np.sqrt((2 - LASTING) / LASTING) > LASTS
        return np.where(self._held, 0.0, share * (self.Q_lasting if lasts else self.Q))

    def _doubt(self) -> Array:
        """Return the variance (n_y,) of readings by the product of how far an output has to go and the share
        that its lag lets it go in a sample, both unknown."""
        model, n, n_l = self.model, self._n, len(self.lagged)
        y = model.output(self.now)[self.lagged]
        to_go = np.zeros((n_l, n + 3 * n_l))
        to_go[:, : model.n_x] = model.C[self.lagged] * (1 + self.scale)[:, None]
        own = np.arange(n_l)
        to_go[own, n + own] = -1.0
        to_go[own, n + 2 * n_l + own] = y - self.start
        if self._share:
            to_go = to_go @ self._way
        PG = self._P @ to_go.T
        at = n + n_l + own
        slope = model.dt / (model.dt + self.lag) ** 2
        found = np.zeros(model.n_y)
        with_lag = PG[at, own]
        found[self.lagged] = slope**2 * (np.einsum("ij,ji->i", to_go, PG) * self._P[at, at] + with_lag**2)
        return found

    def _inside(self, change: Array, held: Mask) -> Array:
        """Return a change of the states that leaves each lag in its range: the mean, given that end."""
        for at, lag in enumerate(self.lag, start=self._n + len(self.lag)):
            beyond = lag + change[at] - min(max(lag + change[at], 0.0), self.longest_lag)
            if beyond:
                change = change - np.where(held, 0.0, self._P[:, at] * (beyond / self._P[at, at]))
        return change

    def _change(self, change: Array) -> None:
        """Change the states."""
        n_x, n, n_l = self.model.n_x, self._n, len(self.lagged)
        w = self.w + change[n_x:n]
        w = np.where(self.is_drive, np.clip(w, -LARGEST_BIAS, LARGEST_BIAS), w)
        lags = slice(n + n_l, n + 2 * n_l)
        lag = np.clip(self.lag + change[lags], 0.0, self.longest_lag)
        if self._share:
            change[n_x:n], change[lags] = w - self.w, lag - self.lag
            ahead = self._way @ change
            self._ahead, self._shown_ahead = self._ahead + ahead[:n_x], self._shown_ahead + ahead[n : n + n_l]
        self.x, self.w = self.x + change[:n_x], w
        self.shown, self.lag = self.shown + change[n : n + n_l], lag
        self.scale = self.scale + change[n + 2 * n_l :]

    def predict(self, u: Array, d: Array) -> None:
        """Carry the estimate one sample on under drives u (n_u,) and disturbances d (n_d,)."""
        self.x, self.shown, step = self._sample(u, d)
        self._P = step @ self._P @ step.T
        self._P[np.diag_indices_from(self._P)] += self._noise(1 - self._noised)
        self._on_sample()

    def advance(self, seconds: float, u: Array, d: Array) -> None:
        """Let so many seconds pass under drives u (n_u,) and disturbances d (n_d,)."""
        dt, left = self.model.dt, seconds
        while self._into + left >= dt * (1 - SAME):
            rest = dt - self._into
            mean = u if self._into <= SAME * dt else (self._dose + rest * u) / dt
            self.predict(mean, d)
            left -= rest
        self._into, self._dose = self._into + left, self._dose + left * u

    def look(self, d: Array) -> None:
        """Look where :meth:`advance` has come to, between two samples: readings are compared there."""
        share = self._into / self.model.dt
        if share <= SAME:
            return
        after, shown, step = self._sample(self._dose / self._into, d)
        P = self._P
        P[np.diag_indices_from(P)] += self._noise(share - self._noised)
        self._P, self._share, self._noised = P, share, share
        self._ahead = (1 - share) * self.x + share * after
        self._shown_ahead = (1 - share) * self.shown + share * shown
        self._way = (1 - share) * np.eye(len(P)) + share * step
        self._bent = 4 * share * (1 - share) * (self.model.C @ (after - self.x))

    def _sample(self, u: Array, d: Array) -> tuple[Array, Array, Array]:
        """Return the state a sample later, what is shown now, and the Jacobian of the filter's states."""
        model, n_x, n, n_l = self.model, self.model.n_x, self._n, len(self.lagged)
        after, A, B, E = model.linearise(self.x, u + self.drive_bias, d + self.disturbance_bias)
        step = np.eye(n + 3 * n_l)
        step[:n_x, :n_x] = A
        into = B @ (self.disturbance.on_drive * model.span[:, None]) + E @ self.disturbance.on_disturbance
        step[:n_x, n_x:n] = into
        y, H = self._shows(self.x, self.shown)
        step[n : n + n_l] = H[self.lagged]
        step[n : n + n_l, n_x:n] = 0.0  # without the biases
        return after, y[self.lagged], step
