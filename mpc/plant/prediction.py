r"""The plant at the controller's sample time: prediction, linearisation along a trajectory, steady states.

A plant is x+ = f(x, u, d; p) at its native step.  A controller moves every dt = n native steps with u
held, so one sample is f composed n times, or fewer times at a longer step where that changes the prediction
by less than a hundredth of an output's unit (:func:`unit_of`).  Delay is in the model's states.

With the plan held over blocks, u_k = v_b for k in block b, the outputs are linearised **along the predicted
trajectory**:

    y(v) ~ y(v0) + G (v - v0),    G = dy/dv at v0, by stages y_k = h(x_k), x_k+1 = f(x_k, u_k).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.errors import UserError
from thermogrip.sysid.models.model import Model, Sizes, Values
from thermogrip.sysid.models.user_model import OwnModel
from thermogrip.sysid.plant.linearise import settled

if TYPE_CHECKING:
    from thermogrip.sysid.models.jit_rollout import Kernel
    from thermogrip.sysid.plant.plant import Plant


def drive_names(plant: Plant) -> tuple[str, ...]:
    """Return the inputs that a controller moves: all but those that are on or off, which stay on."""
    return tuple(name for name in plant.model.inputs if name not in plant.model.switches)


def drive_range(plant: Plant, name: str) -> tuple[float, float]:
    """Return a drive's range: by its unit (-1...1, 0...100 percent, 0...255), else what the logs showed; a
    UserError where they held it constant."""
    unit = plant.units.get(name, "1")
    low, high = plant.valid.get(name, (-1.0, 1.0))
    if unit == "percent":
        return (-100.0 if low < 0 else 0.0), 100.0
    if unit == "0_255":
        return 0.0, 255.0
    if unit == "1" and low >= -1.05 and high <= 1.05:
        return (-1.0 if low < 0 else 0.0), 1.0
    if not low < high:
        raise UserError(f"drive {name} was constant in the logs", hint="identify with a log that moves it")
    return float(low), float(high)


_STEP_ERROR = 0.01  # of an output's unit, of the prediction by a coarser step
#: The room's temperature where nothing is known of it [degC].
ROOM = 25.0
#: Readings outside, and beyond twice what the logs showed, are a broken wire [degC].
PLAUSIBLE = (-60.0, 200.0)
#: A reading so far from the prediction is a loose plug, unless it stays [degC]; of a wide range, a tenth.
SPIKE = 6.0
_FAR = 10.0  # ranges of the logs outside of them, where no disturbance is that is no temperature
_UNBOUNDED = 1e30
_KNOWN_BEYOND_LOGS = 5.0  # units from what the logs showed, where a black box still knows what it does


class LinearStep(NamedTuple):
    """One sample, linearised."""

    after: Array  # (n_x,) the state after it
    A: Array  # (n_x, n_x) its derivative by the state
    B: Array  # (n_x, n_u) by the drives
    E: Array  # (n_x, n_d) by the disturbances


class Response(NamedTuple):
    """Outputs after 1...N samples of a linear plant, by what they come from."""

    by_x: Array  # (N, n_y, n_x)
    by_rest: Array  # (N, n_y, n_x), of what is added to the state in every sample
    G: Array  # (N, n_y, n_b, n_u)


class Rest(NamedTuple):
    """Where all is at rest in a room."""

    x: Array  # (n_x,)
    u: Array  # (n_u,)
    d: Array  # (n_d,)


class PredictionModel:
    """A plant seen at the controller's sample time, on/off inputs that are no drives at 1."""

    def __init__(self, plant: Plant, *, dt: float | None = None) -> None:
        self.plant, self.model = plant, plant.model
        self.p: Array = np.asarray(plant.p, dtype=float)
        self.drives = drive_names(plant)
        if not self.drives:
            raise UserError(
                "the plant has no drive", hint="identify it with an input that a controller can move"
            )
        self.disturbances, self.outputs = tuple(self.model.disturbances), tuple(self.model.outputs)
        self.n_x = int(self.model.n_x)
        self.n_u = len(self.drives)
        self.n_y = len(self.outputs)
        self.n_d = len(self.disturbances)
        # which measured disturbances are temperatures of the room
        self.rooms: Mask = np.array([plant.is_room(name) for name in self.disturbances], dtype=bool)
        self.drive_index = [self.model.inputs.index(name) for name in self.drives]
        ranges = np.array([drive_range(plant, name) for name in self.drives])
        self.lowest, self.highest = ranges[:, 0], ranges[:, 1]
        self.span = self.highest - self.lowest  # the unit in which drives are scaled
        self.neutral = np.clip(np.zeros(self.n_u), self.lowest, self.highest)
        seen = np.array([plant.valid.get(name, (-np.inf, np.inf)) for name in self.outputs], dtype=float)
        warm = np.array([plant.units.get(name, "degC") == "degC" for name in self.outputs])
        # outputs that share a level at rest: the temperatures, or all
        self.warm: Mask = warm if warm.any() else ~warm
        self._seen, spread = seen, np.nan_to_num(seen[:, 1] - seen[:, 0], posinf=0.0)
        self.unit = unit_of(spread)  # in which figures of an output count
        away = np.nan_to_num(seen + spread[:, None] * [-1.0, 1.0], posinf=0.0, neginf=0.0)
        self.spike = np.maximum(SPIKE, 0.1 * spread)
        self.coldest = min(PLAUSIBLE[0], float(away[:, 0].min()))
        self.hottest = max(PLAUSIBLE[1], float(away[:, 1].max()))
        seen = np.array([plant.valid.get(name, (0.0, 0.0)) for name in self.disturbances], dtype=float)
        self.seen_d = seen.reshape(-1, 2)
        low, high = self.seen_d.T
        width_allowed = np.where(high > low, _FAR * (high - low), _UNBOUNDED)
        self.least_d = np.where(self.rooms, self.coldest, low - width_allowed)
        self.most_d = np.where(self.rooms, self.hottest, high + width_allowed)
        wanted = sample_time(plant) if dt is None else float(dt)
        # a sample is n native steps with u held; where fewer, longer ones change the prediction by less than
        # a hundredth of an output's unit, it is cut into these
        self.sub = max(1, round(wanted / plant.dt))
        self.dt = self.sub * plant.dt
        self._responses: dict[tuple[int, ...], Response] = {}
        self._directions: dict[tuple[int, ...], list[Array]] = {}
        self.sub = self._fewest_steps()

    def _fewest_steps(self) -> int:
        """Return into how few steps a sample may be cut: a controller's time goes into these."""
        native_steps = self.sub
        d = self.undisturbed(ROOM)
        x = self.rest(self.usual(ROOM), d)[None, :]
        plan = np.repeat(np.stack([self.highest, self.lowest]), 30, axis=0)[None]
        exact, _ = self.run(x, plan, d)
        # an implicit network is as good for control at four times its own step
        for steps in range(1, native_steps):
            if native_steps % steps == 0:
                self.sub = steps
                if np.max(np.abs(self.run(x, plan, d)[0] - exact) / self.unit) < _STEP_ERROR:
                    return steps
        self.sub = native_steps
        return native_steps

    def inputs(self, u: ArrayLike) -> Array:
        """Return the model's input vector for drives of shape (..., n_u), switches on."""
        u = np.asarray(u, dtype=float)
        full = np.ones((*u.shape[:-1], len(self.model.inputs)))
        full[..., self.drive_index] = u
        return full

    def rest(self, y: ArrayLike, d: ArrayLike) -> Array:
        """Return the state at rest with outputs y (n_y,), disturbances d (n_d,) and no drive."""
        x = self.model.rest(np.asarray(y, float), self.inputs(self.neutral), np.asarray(d, float), self.p)
        return np.asarray(x, dtype=np.float64)

    def at_rest(self, ambient: float) -> Rest:
        """Return state, drives and disturbances where all is at rest in a room of this temperature [degC];
        where no log was there, amid what the logs showed."""
        d = self.undisturbed(ambient)
        y = self.usual(ambient)
        v = self.neutral
        if np.any(y != ambient):
            logs = [self.plant.valid.get(name, (neutral, neutral)) for name, neutral in zip(self.drives, v)]
            v = np.clip(np.mean(np.array(logs, dtype=float), axis=1), self.lowest, self.highest)
        x = self.model.rest(y, self.inputs(v), d, self.p)
        return Rest(np.asarray(x, dtype=np.float64), v, d)

    def undisturbed(self, ambient: float) -> Array:
        """Return the measured disturbances (n_d,) where nobody reads them, in a room of this temperature
        [degC]; what is no temperature and of which the plant says nothing is 0."""
        return np.nan_to_num(self.plant.undisturbed(ambient))

    def usual(self, ambient: float) -> Array:
        """Return outputs (n_y,) that are as warm as the room [degC], or the middle of what the logs showed of
        those that never were."""
        low, high = self._seen.T
        margin = _KNOWN_BEYOND_LOGS * self.unit
        away = (ambient < low - margin) | (ambient > high + margin)
        return np.asarray(np.mean(np.where(away, self._seen.T, ambient), axis=0), dtype=np.float64)

    def output(self, x: ArrayLike) -> Array:
        """Return the outputs (n_y,) at state x (n_x,)."""
        y = self.model.output(np.asarray(x, float).tolist(), self.p.tolist())
        return np.array(y, dtype=np.float64)

    def run(self, x: Array, u: Array, d: Array) -> tuple[Array, Array]:
        """Simulate plans u (B, N, n_u) from states x (B, n_x) under d (n_d,), (B, n_d) or (1, N, n_d); return
        outputs (B, N + 1, n_y) from the start on, and last states (B, n_x)."""
        fine = self.inputs(u) if self.sub == 1 else np.repeat(self.inputs(u), self.sub, axis=1)
        d = np.repeat(d, self.sub, axis=1) if d.ndim == 3 else np.atleast_2d(d)[:, None, :]
        d_of_steps = np.ascontiguousarray(np.broadcast_to(d, (d.shape[0], fine.shape[1], d.shape[2])))
        y, x_end = self.model.rollout(
            np.ascontiguousarray(x), fine, d_of_steps, self.p[None, :], self.dt / self.sub
        )
        return np.asarray(y)[:, :: self.sub], np.asarray(x_end)

    def next_state(self, x: Array, u: Array, d: Array) -> Array:
        """Return the state one sample later."""
        if self.affine is not None:
            from_zero = self.affine
            return np.asarray(from_zero.A @ x + from_zero.B @ u + from_zero.E @ d + from_zero.after)
        _, x_end = self.run(x[None, :], u[None, None, :], d)
        return np.asarray(x_end[0])

    def linearise(self, x: Array, u: Array, d: Array) -> LinearStep:
        """Return one sample's next state (n_x,), and its derivatives A, B, E by x, u (n_x, n_u) and d."""
        if self.affine is not None:
            return self.affine._replace(after=self.next_state(x, u, d))
        _, ends = self._along(self._sample_directions, x, u, d)
        after, by = ends[0, : self.n_x], ends[:, self.n_x :].T
        n_xu = self.n_x + self.n_u
        return LinearStep(after, by[:, : self.n_x], by[:, self.n_x : n_xu], by[:, n_xu:])

    @cached_property
    def affine(self) -> LinearStep | None:
        """One sample from zero without drives and disturbances, where the step is linear; else None."""
        import casadi as ca

        symbols = [ca.SX.sym(name, n) for name, n in zip("xud", (self.n_x, self.n_u, self.n_d))]
        numbers = self.p.tolist(), self.dt / self.sub
        (after,) = symbolic_step(self.model, self.drive_index, symbols, *numbers)
        if any(ca.which_depends(after, ca.vertcat(*symbols), 2, True)):
            return None
        # CasADi's own: once, which is not worth a compiled step
        for _ in range(1, self.sub):
            (after,) = symbolic_step(self.model, self.drive_index, [after, *symbols[1:]], *numbers)
        blocks = [after, *(ca.densify(ca.jacobian(after, of)) for of in symbols)]
        from_zero = ca.Function("sample", symbols, blocks)(*(np.zeros(of.numel()) for of in symbols))
        at_zero, *derivatives = (np.asarray(value.full()) for value in from_zero)
        return LinearStep(at_zero.ravel(), *derivatives)

    @cached_property
    def _kernel(self) -> Kernel:
        """The compiled step with its derivative in one direction: of x, u, d, each with its direction."""
        import casadi as ca

        from thermogrip.sysid.models.jit_rollout import Kernel

        C, level, n_x = self.C, self.output(np.zeros(self.n_x)), self.n_x

        def step(x: Values, u: Values, d: Values, p: Values, h: Any) -> list[Any]:
            halves = [(v[: len(v) // 2], v[len(v) // 2 :]) for v in (x, u, d)]
            point, along = ([ca.vertcat(*half) for half in each] for each in zip(*halves))
            numbers = self.p.tolist(), self.dt / self.sub
            after, slope = symbolic_step(self.model, self.drive_index, list(point), *numbers, list(along))
            return [*ca.vertsplit(after), *ca.vertsplit(slope)]

        def output(x: Values, p: Values) -> list[Any]:
            point, along = ca.vertcat(*x[:n_x]), ca.vertcat(*x[n_x:])
            return [*ca.vertsplit(C @ point + level), *ca.vertsplit(C @ along)]

        # parameters are numbers in the step, switches stay on
        return Kernel(step, output, Sizes(2 * n_x, 2 * self.n_u, 2 * self.n_d, 0))

    @cached_property
    def _sample_directions(self) -> list[Array]:
        """Room for a sample from x, u, d in front of each direction of these."""
        n_xu = self.n_x + self.n_u
        by_x, by_u, by_d = np.split(np.eye(n_xu + self.n_d), [self.n_x, n_xu], axis=1)
        by_u, by_d = (np.repeat(by[:, None], self.sub, axis=1) for by in (by_u, by_d))
        return [np.concatenate([0 * by, by], axis=-1) for by in (by_x, by_u, by_d)]

    def _plan_directions(self, blocks: tuple[int, ...]) -> list[Array]:
        """Room for a run along a plan in front of each direction of the plan, the same for these blocks."""
        if blocks not in self._directions:
            n = len(blocks) * self.n_u
            by_u = np.repeat(np.eye(n).reshape(n, -1, self.n_u), np.multiply(blocks, self.sub), axis=1)
            by_x, by_d = np.zeros((n, 2 * self.n_x)), np.zeros((n, by_u.shape[1], 2 * self.n_d))
            self._directions[blocks] = [by_x, np.concatenate([0 * by_u, by_u], axis=2), by_d]
        return self._directions[blocks]

    def _along(self, directions: list[Array], x: Array, u: Array, d: Array) -> tuple[Array, Array]:
        """Return outputs (B, n + 1, 2 n_y) and last states (B, 2 n_x) of a run from x under u (n, n_u) or
        (n_u,) and d, each followed by its derivatives in the directions behind."""
        start, drives, disturbances = (room.copy() for room in directions)  # threads share a model
        start[:, : self.n_x] = x
        drives[..., : self.n_u] = u
        disturbances[..., : self.n_d] = d
        return self._kernel.rollout(start, drives, disturbances, np.zeros((1, 0)), self.dt / self.sub)

    @cached_property
    def C(self) -> Array:
        """The (n_y, n_x) output matrix; outputs of a model are affine in its state."""
        zero = self.output(np.zeros(self.n_x))
        columns = [self.output(row) - zero for row in np.eye(self.n_x)]
        return np.stack(columns, axis=1)

    def trajectory(self, x: Array, plan: Array, d: Array, blocks: Sequence[int]) -> tuple[Array, Array]:
        """Return the outputs (N, n_y) of a plan (n_b, n_u) of blocks after 1...N samples, and their
        derivatives (N, n_y, n_b, n_u), of a linear plant the same array each time."""
        if self.affine is not None:
            from_zero = self.affine
            by_x, by_rest, G = self.response(tuple(blocks))
            y = by_x @ x + by_rest @ (from_zero.E @ d + from_zero.after) + np.tensordot(G, plan, axes=2)
            return y + self.output(np.zeros(self.n_x)), G
        # Linearised along the plan, as M. Diehl, H. G. Bock, J. P. Schloeder, "A real-time iteration scheme
        # for nonlinear optimization in optimal feedback control", SIAM Journal on Control and Optimization
        # 43(5), 2005: past the optimum current of a Peltier drive more current heats, dT/du changes sign
        # along the plan, and a controller that froze the sign drives into the wrong side.
        of_steps = np.repeat(plan, np.multiply(blocks, self.sub), axis=0)
        y, _ = self._along(self._plan_directions(tuple(blocks)), x, of_steps, d)
        y = y[:, self.sub :: self.sub]
        return y[0, :, : self.n_y], y[:, :, self.n_y :].transpose(1, 2, 0).reshape(-1, self.n_y, *plan.shape)

    def response(self, blocks: tuple[int, ...]) -> Response:
        """Return how a linear plant's outputs answer, made once for these blocks."""
        if blocks in self._responses:
            return self._responses[blocks]
        if self.affine is None:
            raise RuntimeError("the plant is not linear")
        A, B = self.affine.A, self.affine.B
        rows, sums = self.C, np.zeros_like(self.C)
        by_x = []
        by_rest = []
        impulse = []
        for _ in range(sum(blocks)):
            impulse.append(rows @ B)
            sums = sums + rows
            rows = rows @ A
            by_x.append(rows)
            by_rest.append(sums)
        # a block's answer is the sum of what its samples do
        steps = np.concatenate([np.zeros((1, *impulse[0].shape)), np.cumsum(impulse, axis=0)])
        G, first = np.zeros((len(impulse), self.n_y, len(blocks), self.n_u)), 0
        for block, length in enumerate(blocks):
            since = np.arange(len(impulse)) - first + 1
            G[:, :, block] = steps[np.maximum(since, 0)] - steps[np.maximum(since - length, 0)]
            first += length
        self._responses[blocks] = Response(np.stack(by_x), np.stack(by_rest), G)
        return self._responses[blocks]

    def steady_state(self, u: ArrayLike, d: ArrayLike) -> Array:
        """Return the state (n_x,) in which the plant stays under drives u (Newton); NaN: there is none."""
        u, d = np.asarray(u, float).reshape(self.n_u), np.asarray(d, float)
        start = self.rest(self.usual(self.room(d)), d)
        return settled(lambda x: self.linearise(x, u, d)[:2], start)

    def steady_output(self, u: ArrayLike, d: ArrayLike) -> Array:
        """Return the outputs (n_y,) that the plant settles at under drives u."""
        return self.output(self.steady_state(u, d))

    def room(self, d: ArrayLike) -> float:
        """Return the room's temperature [degC] as the first measured disturbance that is one gives it, 25
        where it does not."""
        room_read = np.asarray(d, float).reshape(-1)[self.rooms][:1]
        return float(room_read[0]) if np.isfinite(room_read).any() else ROOM


def symbolic_step(
    model: Model, drives: Sequence[int], point: Sequence[Any], p: Values, h: float, *directions: Sequence[Any]
) -> list[Any]:
    """Return the state after a step, inputs that are no ``drives`` on, and its derivatives, as symbols."""
    import casadi as ca

    arguments = (*_all_inputs(model, drives, point, 1.0), p, h)
    after = ca.densify(ca.vertcat(*model.step(*arguments)))
    if isinstance(model, OwnModel):
        slopes = [model.slope(*arguments, _all_inputs(model, drives, along, 0.0)) for along in directions]
    else:
        slopes = [ca.jtimes(after, ca.vertcat(*point), ca.vertcat(*along)) for along in directions]
    return [after, *map(ca.densify, slopes)]


def _all_inputs(
    model: Model, drives: Sequence[int], point: Sequence[Any], others: float
) -> tuple[list[Any], list[Any], list[Any]]:
    """Return x, u, d as lists, u with the inputs that are no drives."""
    import casadi as ca

    x, u, d = (ca.vertsplit(item) if item.numel() else [] for item in point)
    full = [ca.SX(others)] * len(model.inputs)
    for place, value in zip(drives, u, strict=True):
        full[place] = value
    return x, full, d


@lru_cache(maxsize=64)
def prediction_model(plant: Plant, dt: float) -> PredictionModel:
    """Return :class:`PredictionModel`, the same one for the same plant: a search asks again and again."""
    return PredictionModel(plant, dt=dt)


def unit_of(spread: Array) -> Array:
    """Return in what figures of outputs count whose logs have ranges ``spread`` (n,): a fortieth of them,
    rounded down to 1, 2 or 5 times a power of ten; 1 where no log was there.

    >>> unit_of(np.array([42.0, 310.0, 11.0, 0.0]))
    array([1. , 5. , 0.2, 1. ])
    """
    share = np.where(spread > 0, spread / 40.0, 1.0)
    ten = 10.0 ** np.floor(np.log10(share) + 1e-9)
    first = share / ten
    return np.asarray(ten * np.where(first >= 5.0 - 1e-9, 5.0, np.where(first >= 2.0 - 1e-9, 2.0, 1.0)))


@dataclass(frozen=True)
class StepResponse:
    """How one output answers to a step of one drive, from rest."""

    gain: float  # settled change of the output for a whole range of the drive [degC]
    delay: float  # apparent dead time: where the steepest tangent towards the gain leaves zero [s]
    lag: float  # dominant lag: gain over the steepest slope towards it [s]
    time: Array  # (n,) the response for a whole range of the drive [s], [degC]
    y: Array


@lru_cache(maxsize=256)  # a design and its monitor ask for the same ones
def step_response(
    plant: Plant, drive: str, output: str, *, ambient: float = ROOM, longest: float = 14400.0
) -> StepResponse:
    """Read gain, delay and lag off a simulated step of a twentieth of a drive's range. Shared: read it."""
    model = PredictionModel(plant, dt=plant.dt)
    j, i = model.drives.index(drive), model.outputs.index(output)
    x_rest, start, d = model.at_rest(ambient)
    step = np.zeros(model.n_u)
    step[j] = (0.05 if start[j] + 0.05 * model.span[j] <= model.highest[j] else -0.05) * model.span[j]
    x = np.repeat(x_rest[None, :], 2, axis=0)
    time = [np.zeros(1)]
    answer = [np.zeros(1)]
    seconds = max(60.0, 100 * plant.dt)
    while True:
        n = round(seconds / plant.dt)
        u = np.stack([np.tile(start, (n, 1)), np.tile(start + step, (n, 1))])
        y, x = model.run(x, u, d)
        answer.append((y[1, 1:, i] - y[0, 1:, i]) / (step[j] / model.span[j]))
        time.append(time[-1][-1] + plant.dt * np.arange(1, n + 1))
        t, response = np.concatenate(time), np.concatenate(answer)
        slope = np.gradient(response, t)
        if abs(slope[-1]) < 1e-3 * np.max(np.abs(slope)) or t[-1] >= longest:
            break
        seconds = t[-1]
    gain = float(response[-1])
    steepest_at = int(np.argmax(slope * np.sign(gain)))  # what first goes the other way is part of the delay
    steepest = float(slope[steepest_at])
    if gain == 0 or steepest == 0:
        return StepResponse(0.0, float("inf"), float("inf"), t, response)
    delay = max(0.0, float(t[steepest_at] - response[steepest_at] / steepest))
    return StepResponse(gain, delay, abs(gain / steepest), t, response)


def sample_time(plant: Plant) -> float:
    """Return a sample time [s] for control, a multiple of the plant's step near a 1-2-5 grid."""
    sample_times = []
    for output in plant.model.outputs:
        answers = [step_response(plant, drive, output) for drive in drive_names(plant)]
        best = max(answers, key=lambda answer: abs(answer.gain))
        if best.gain:
            low, high = plant.valid.get(output, (-np.inf, np.inf))
            # a quarter of the delay; where there is next to none, a 400th of the lag, 10 s at most; of what
            # adds up what it gets, a 40th of the time in which a full drive leads through all of the logs
            through = best.lag * (high - low) / abs(best.gain)
            short = through / 40 if through < best.lag / 20 else min(best.lag, 4000.0) / 400
            sample_times.append(max(best.delay / 4, short))
    wanted = max(sample_times) if sample_times else plant.dt
    grid = np.array([m * 10.0**e for e in range(-3, 3) for m in (1, 2, 5)])
    nice = float(grid[int(np.argmin(np.abs(np.log(grid / wanted))))])
    return max(1, round(nice / plant.dt)) * plant.dt


#: Newton's steps, how often one is halved, and by how much a state may move in a sample [degC].
_NEWTON_STEPS, _HALVINGS, _BALANCED = 20, 9, 1e-7


@dataclass(frozen=True)
class Holding:
    """The drive that holds a target."""

    u: Array  # (n_u,) drives
    x: Array  # (n_x,) the state at these drives
    y: Array  # (n_y,) all outputs [degC]
    # largest distance of a controlled output from its target [degC]; 0 where the target can be held
    miss: float


def holding_drive(
    model: PredictionModel,
    controlled: tuple[str, ...],
    target: ArrayLike,
    d: ArrayLike,
    *,
    within: tuple[Array, Array] | None = None,
) -> Holding:
    """Return the drives inside their range, or ``within`` these ends, that hold the controlled outputs
    nearest to target (n_controlled,) [degC] in the least-squares sense."""
    wanted = np.asarray(target, dtype=float).reshape(len(controlled))
    d = np.asarray(d, dtype=float)
    rows = [model.outputs.index(name) for name in controlled]

    def miss(scaled: Array) -> Array:
        y = model.steady_output(scaled * model.span, d)[rows]
        return np.where(np.isfinite(y), y - wanted, 1e3)

    def slope(scaled: Array) -> Array:
        # of what is at rest, C (I - A)^-1 B: near no drive differences of two steady states are noise
        u = scaled * model.span
        x = model.steady_state(u, d)
        step = model.linearise(np.nan_to_num(x), u, d)
        moved = np.linalg.lstsq(np.eye(model.n_x) - step.A, step.B * model.span, rcond=None)[0]
        return np.asarray((model.C @ moved)[rows] * np.isfinite(x).all())

    low, high = (ends / model.span for ends in within or (model.lowest, model.highest))
    # the first step is as long as the start, but where that is zero: 1e-17 would be the end
    starts = [np.round(low + share * (high - low), 9) for share in (0.1, 0.3, 0.5, 0.7, 0.9)]
    # a small weight of the drive itself picks the smaller of two that hold the same temperature
    costs = [float(np.sum(miss(start) ** 2) + 1e-2 * np.sum(start**2)) for start in starts]
    begin = starts[int(np.argmin(costs))]
    solution = least_squares(miss, begin, slope, bounds=(low, high), xtol=1e-10)
    u = solution.x * model.span
    x = model.steady_state(u, d)
    if not np.max(np.abs(model.output(x)[rows] - wanted) / model.unit[rows]) < _STEP_ERROR:
        # an integrator rests at any temperature or at none: what balances it may be out of range.  And where
        # a bent plant runs away by itself, no search over drives finds what holds it: from the room such
        # drives lead elsewhere
        balanced, balance = _balance(model, rows, wanted, d)
        in_range = np.all((low * model.span <= balance) & (balance <= high * model.span))
        if not np.isfinite(x).all() or (in_range and np.isfinite(balanced).all()):
            x, u = balanced, balance
    y = model.output(x)
    off = np.where(np.isfinite(y[rows]), y[rows] - wanted, 1e3)
    return Holding(u, x, y, float(np.max(np.abs(off))))


_HELD = 0.25  # of an output's unit: a start that drives miss by less is held


@lru_cache(maxsize=256)  # trials of many designs begin there
def held_start(
    model: PredictionModel, controlled: tuple[str, ...], start: float, d: tuple[float, ...]
) -> tuple[Array, Array | None]:
    """Return the state (n_x,) in which drives (n_u,) hold the controlled outputs at ``start`` [degC] for
    good, and these; where none do, that of a plant which is as warm all over, and None. Shared: read it."""
    holding = holding_drive(model, controlled, np.full(len(controlled), start), d)
    x, u = holding.x, holding.u
    unit = model.unit[[model.outputs.index(name) for name in controlled]].min()
    in_range = np.all((model.lowest <= u) & (u <= model.highest))
    if in_range and holding.miss < _HELD * unit and np.isfinite(x).all():
        return x, u
    return model.rest(np.full(model.n_y, start), d), None


def _balance(model: PredictionModel, rows: list[int], wanted: Array, d: Array) -> tuple[Array, Array]:
    """Return a state that stays and has these outputs (NaN: there is none), and its drives, by Newton, each
    of whose steps is halved until it comes nearer."""

    def off(x: Array, u: Array) -> tuple[LinearStep, Array]:
        step = model.linearise(x, u, d)
        return step, np.concatenate([step.after - x, model.output(x)[rows] - wanted])

    x, u = model.rest(np.full(model.n_y, wanted.mean()), d), model.neutral
    step, miss = off(x, u)
    for _ in range(_NEWTON_STEPS):
        if np.max(np.abs(miss)) < _BALANCED:
            return x, u
        outputs = np.hstack([model.C[rows], np.zeros((len(rows), model.n_u))])
        by = np.vstack([np.hstack([step.A - np.eye(model.n_x), step.B * model.span]), outputs])
        move, before = np.linalg.lstsq(by, -miss, rcond=None)[0], np.linalg.norm(miss)
        for share in 0.5 ** np.arange(_HALVINGS):
            nearer = x + share * move[: model.n_x], u + share * move[model.n_x :] * model.span
            step, miss = off(*nearer)
            if np.linalg.norm(miss) < before:
                break
        x, u = nearer
    return np.full(model.n_x, np.nan), u
