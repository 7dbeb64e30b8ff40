r"""The plant at the controller's sample time: prediction, linearisation along a trajectory, steady states.

A plant is x+ = f(x, u, d; p) at its native step.  A controller moves every dt = n native steps with u
held, so one sample is f composed n times, or fewer times at a longer step where that changes the prediction
by less than 0.01 degC.  Delay needs no special case: it stands in the model's states (the water in the
tubes), and the prediction carries it.

The optimiser needs the predicted outputs and how they answer to the plan.  With the plan held over blocks,
u_k = v_b for k in block b, the outputs are linearised **along the predicted trajectory** [1]_:

    y(v) ~ y(v0) + G (v - v0),    G = dy/dv at v0, by stages y_k = h(x_k), x_k+1 = f(x_k, u_k).

Linearising there, not at the current state, is what keeps a Peltier drive safe: past the optimum current
more current heats, dT/du changes sign along the plan, and a controller that froze the sign drives into the
wrong side.

Two ways give the same G, both without a difference quotient.  ``trajectory`` runs the model's step on dual
numbers (:mod:`thermogrip.mpc.plant.tangents`), a direction for each block and drive, all in one batch of
machine code; ``trajectory_exact`` carries forward sensitivities S+ = A S + B through CasADi.  The first is
what the controller uses; the second is its check, and takes its place for a model whose step is more than
arithmetic.

References
----------
.. [1] M. Diehl, H. G. Bock, J. P. Schloeder, "A real-time iteration scheme for nonlinear optimization in
   optimal feedback control", SIAM Journal on Control and Optimization 43(5), 2005.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermogrip.datasets.errors import UserError
from thermogrip.mpc.plant.drives import drive_names, drive_range
from thermogrip.mpc.plant.tangents import DualSteps

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant

__all__ = [
    "ROOM",
    "PredictionModel",
    "StepResponse",
    "drive_range",
    "prediction_model",
    "sample_time",
    "step_response",
]

Array = NDArray[np.float64]

_STEP_ERROR = 0.01  # degC, of the prediction by a coarser step
#: The room's temperature where nothing is known of it [degC].
ROOM = 25.0


class PredictionModel:
    """A plant seen at the controller's sample time, its on/off inputs at 1.

    Parameters
    ----------
    plant : Plant
        What ``identify`` returned.
    dt : float, optional
        Sample time [s], rounded to a multiple of the plant's own step; by default :func:`sample_time`.

    Attributes
    ----------
    drives, disturbances, outputs : tuple of str
        Names in the order of u, d and y.
    dt : float
        Sample time [s].
    sub : int
        Steps of the model in a sample.
    lowest, highest, span : (n_u,) ndarray
        Each drive's range, and its width: the unit in which drives are scaled.
    neutral : (n_u,) ndarray
        No drive, or what is nearest to none.
    """

    def __init__(self, plant: Plant, *, dt: float | None = None) -> None:
        self.plant, self.model = plant, plant.model
        self.p: Array = np.asarray(plant.p, dtype=float)
        self.drives = drive_names(plant)
        if not self.drives:
            raise UserError(
                "the plant has no drive", hint="identify it with an input that a controller can move"
            )
        self.disturbances, self.outputs = tuple(self.model.disturbances), tuple(self.model.outputs)
        self.n_x, self.n_u, self.n_y = int(self.model.n_x), len(self.drives), len(self.outputs)
        self.n_d = len(self.disturbances)
        self.drive_index = [self.model.inputs.index(name) for name in self.drives]
        ranges = np.array([drive_range(plant, name) for name in self.drives])
        self.lowest, self.highest = ranges[:, 0], ranges[:, 1]
        self.span = self.highest - self.lowest
        self.neutral = np.clip(np.zeros(self.n_u), self.lowest, self.highest)
        wanted = sample_time(plant) if dt is None else float(dt)
        self.sub = max(1, round(wanted / plant.dt))
        self.dt = self.sub * plant.dt
        self.sub = self._fewest_steps()

    def _fewest_steps(self) -> int:
        """Return into how few steps a sample may be cut with a full swing of the drives within 0.01 degC.

        A plant's own step is chosen for identification; an implicit network is as good for control at four
        times that, and a controller's time goes into these steps.
        """
        own = self.sub
        d = np.full(self.n_d, ROOM)
        x = self.rest(np.full(self.n_y, ROOM), d)[None, :]
        plan = np.repeat(np.stack([self.highest, self.lowest]), 30, axis=0)[None]
        exact, _ = self.run(x, plan, d)
        for steps in range(1, own):
            if own % steps == 0:
                self.sub = steps
                if np.max(np.abs(self.run(x, plan, d)[0] - exact)) < _STEP_ERROR:
                    return steps
        self.sub = own
        return own

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

    def at_rest(self, ambient: float) -> tuple[Array, Array, Array]:
        """Return state, drives and disturbances where all is at rest in a room of this temperature [degC]."""
        d = np.full(self.n_d, ambient)
        return self.rest(np.full(self.n_y, ambient), d), self.neutral, d

    def output(self, x: ArrayLike) -> Array:
        """Return the outputs (n_y,) at state x (n_x,)."""
        y = self.model.output(np.asarray(x, float).tolist(), self.p.tolist())
        return np.array(y, dtype=np.float64)

    def run(self, x: Array, u: Array, d: Array) -> tuple[Array, Array]:
        """Simulate plans in one batch.

        Parameters
        ----------
        x : (B, n_x) ndarray
            Start states.
        u : (B, N, n_u) ndarray
            Drives, one row a sample.
        d : (n_d,) or (B, n_d) ndarray
            Disturbances, held.

        Returns
        -------
        y : (B, N + 1, n_y) ndarray
            Outputs at the samples, from the start on.
        x_end : (B, n_x) ndarray
        """
        fine = np.repeat(self.inputs(u), self.sub, axis=1)
        d = np.atleast_2d(d)
        held = np.ascontiguousarray(np.broadcast_to(d[:, None, :], (d.shape[0], fine.shape[1], d.shape[1])))
        y, x_end = self.model.rollout(
            np.ascontiguousarray(x), fine, held, self.p[None, :], self.dt / self.sub
        )
        return np.asarray(y)[:, :: self.sub], np.asarray(x_end)

    def next_state(self, x: Array, u: Array, d: Array) -> Array:
        """Return the state one sample later."""
        _, x_end = self.run(x[None, :], u[None, None, :], d)
        return np.asarray(x_end[0])

    def linearise(self, x: Array, u: Array, d: Array) -> tuple[Array, Array, Array, Array]:
        """Linearise one sample.

        Returns
        -------
        x_next : (n_x,) ndarray
        A : (n_x, n_x), B : (n_x, n_u), E : (n_x, n_d) ndarray
            Derivatives of the next state.
        """
        n_x, n_u = self.n_x, self.n_u
        if self._duals is None:
            found = self._casadi_sample(x, u, d)
            return found[0].ravel(), found[1], found[2], found[3]
        along = np.eye(n_x + n_u + self.n_d)
        _, after = self._tangents(
            x, u[None], d, along[:, :n_x], along[:, None, n_x : n_x + n_u], along[:, n_x + n_u :]
        )
        A, B, E = np.split(after[:, n_x:].T, [n_x, n_x + n_u], axis=1)
        return after[0, :n_x], A, B, E

    @property
    def by_duals(self) -> bool:
        """Whether derivatives come from dual numbers in machine code; else CasADi takes them."""
        return self._duals is not None

    @cached_property
    def _duals(self) -> Any:
        """The compiled step on dual numbers; None where the step is more than arithmetic."""
        from thermogrip.sysid.models.jit_rollout import Kernel

        try:
            return Kernel(DualSteps(self.model, self.drive_index, self.dt / self.sub))
        except (TypeError, AttributeError, NotImplementedError, UserError):
            return None  # a function of its own, or a branch: CasADi takes the derivatives

    def _tangents(self, x: Array, u: Array, d: Array, sx: Array, su: Array, sd: Array) -> tuple[Array, Array]:
        """Run samples u (N, n_u) with directions sx (B, n_x), su (B, N, n_u), sd (B, n_d).

        Returns outputs (B, N + 1, 2 n_y) and the last state (B, 2 n_x), values first, then directions.
        """
        count, n = len(su), len(u)
        states = np.concatenate([np.broadcast_to(x, (count, self.n_x)), sx], axis=1)
        drives = np.concatenate([np.broadcast_to(u, (count, n, self.n_u)), su], axis=2)
        held = np.concatenate([np.broadcast_to(d, (count, self.n_d)), sd], axis=1)[:, None]
        fine = np.repeat(drives, self.sub, axis=1)
        held = np.ascontiguousarray(np.broadcast_to(held, (count, fine.shape[1], 2 * self.n_d)))
        renew = np.zeros(fine.shape[1], dtype=bool)
        y, x_end = self._duals.rollout(states, fine, held, self.p[None, :], self.dt / self.sub, renew)
        return y[:, :: self.sub], x_end

    @cached_property
    def C(self) -> Array:
        """The (n_y, n_x) output matrix; outputs of a model are affine in its state."""
        zero = self.output(np.zeros(self.n_x))
        columns = [self.output(row) - zero for row in np.eye(self.n_x)]
        return np.stack(columns, axis=1)

    def trajectory(self, x: Array, plan: Array, d: Array, blocks: Sequence[int]) -> tuple[Array, Array]:
        """Predict along a plan, and how the prediction answers to its blocks.

        Parameters
        ----------
        x : (n_x,) ndarray
            State now.
        plan : (n_b, n_u) ndarray
            Drives, one row a block.
        d : (n_d,) ndarray
            Measured disturbances, held over the horizon.
        blocks : sequence of int
            Samples in each block.

        Returns
        -------
        y : (N, n_y) ndarray
            Outputs after 1...N samples, N = sum(blocks).
        G : (N, n_y, n_b, n_u) ndarray
            Their derivatives.
        """
        if self._duals is None:
            return self.trajectory_exact(x, plan, d, blocks)
        n_b, n_u = plan.shape
        along = np.eye(n_b * n_u).reshape(n_b * n_u, n_b, n_u)
        u, su = (np.repeat(values, np.asarray(blocks), axis=-2) for values in (plan, along))
        none = np.zeros((n_b * n_u, self.n_x)), np.zeros((n_b * n_u, self.n_d))
        y, _ = self._tangents(x, u, d, none[0], su, none[1])
        G = y[:, 1:, self.n_y :].transpose(1, 2, 0).reshape(len(u), self.n_y, n_b, n_u)
        return np.ascontiguousarray(y[0, 1:, : self.n_y]), G

    def trajectory_exact(self, x: Array, plan: Array, d: Array, blocks: Sequence[int]) -> tuple[Array, Array]:
        """Return what :meth:`trajectory` returns, from CasADi forward sensitivities."""
        n_b, n_u = plan.shape
        sensitivity: Array = np.zeros((self.n_x, n_b, n_u))
        outputs, gains = [], []
        for block, length in enumerate(blocks):
            for _ in range(length):
                x_next, A, B, _ = self._casadi_sample(x, plan[block], d)
                sensitivity = np.asarray(np.tensordot(A, sensitivity, axes=1), dtype=np.float64)
                sensitivity[:, block, :] += B
                x = x_next.ravel()
                outputs.append(self.output(x))
                gains.append(np.tensordot(self.C, sensitivity, axes=1))
        return np.stack(outputs), np.stack(gains)

    def casadi_step(self) -> Any:
        """Return the CasADi function (x, u, d) -> (x_next, A, B, E) of one sample; exact derivatives."""
        if "_casadi" not in self.__dict__:
            self._casadi = self._build_casadi()
        return self._casadi

    def _casadi_sample(self, x: Array, u: Array, d: Array) -> list[Array]:
        return [np.asarray(value.full()) for value in self.casadi_step()(x, u, d)]

    def _build_casadi(self) -> Any:
        import casadi as ca

        x, u = ca.SX.sym("x", self.n_x), ca.SX.sym("u", self.n_u)
        d = ca.SX.sym("d", self.n_d)
        full = [ca.SX(1.0)] * len(self.model.inputs)
        for at, value in zip(self.drive_index, ca.vertsplit(u), strict=True):
            full[at] = value
        disturbances = ca.vertsplit(d) if self.n_d else []
        state = ca.vertsplit(x)
        p = [float(value) for value in self.p]
        for _ in range(self.sub):
            state = self.model.step(state, full, disturbances, p, self.dt / self.sub)
        after = ca.vertcat(*state)
        blocks = [after, *(ca.densify(ca.jacobian(after, of)) for of in (x, u, d))]
        return ca.Function("sample", [x, u, d], blocks, ["x", "u", "d"], ["x_next", "A", "B", "E"])

    def steady_state(self, u: ArrayLike, d: ArrayLike) -> Array:
        """Return the state (n_x,) in which the plant stays under drives u (Newton); NaN: there is none."""
        u, d = np.asarray(u, float).reshape(self.n_u), np.asarray(d, float)
        x = self.rest(np.full(self.n_y, self.room(d)), d)
        for _ in range(30):
            after, A, _, _ = self.linearise(x, u, d)
            try:
                change = np.linalg.solve(np.eye(self.n_x) - A, after - x)
            except np.linalg.LinAlgError:
                return np.full(self.n_x, np.nan)  # an integrator: any state may stay
            x = x + np.clip(change, -200.0, 200.0)
            if not np.isfinite(x).all():
                break
            if np.max(np.abs(change)) < 1e-7:
                return x
        return np.full(self.n_x, np.nan)

    def steady_output(self, u: ArrayLike, d: ArrayLike) -> Array:
        """Return the outputs (n_y,) that the plant settles at under drives u."""
        return self.output(self.steady_state(u, d))

    def dc_gain(self, u: ArrayLike, d: ArrayLike) -> Array:
        """Return the (n_y, n_u) steady-state gain [degC per unit of drive] around drives u."""
        u, d = np.asarray(u, float).reshape(self.n_u), np.asarray(d, float)
        _, A, B, _ = self.linearise(self.steady_state(u, d), u, d)
        return np.asarray(self.C @ np.linalg.solve(np.eye(self.n_x) - A, B))

    def room(self, d: ArrayLike) -> float:
        """Return the room's temperature [degC] as the measured disturbances give it, 25 where they do not."""
        d = np.asarray(d, float).reshape(-1)
        return float(d[0]) if d.size and np.isfinite(d[0]) else ROOM

    def vector(self, values: Mapping[str, float], names: Sequence[str]) -> Array:
        """Return values by name as an array in the order of names, NaN where one is missing."""
        return np.array([float(values.get(name, np.nan)) for name in names])


@lru_cache(maxsize=16)
def prediction_model(plant: Plant, dt: float) -> PredictionModel:
    """Return :class:`PredictionModel`, the same one for the same plant: a search asks again and again."""
    return PredictionModel(plant, dt=dt)


@dataclass(frozen=True)
class StepResponse:
    """How one output answers to a step of one drive, from rest.

    Attributes
    ----------
    gain : float
        Settled change of the output for a whole range of the drive [degC].
    delay : float
        Apparent dead time: where the steepest tangent leaves zero [s].
    lag : float
        Dominant lag: gain over the steepest slope [s].
    time, y : (n,) ndarray
        The response for a whole range of the drive [s], [degC].
    """

    gain: float
    delay: float
    lag: float
    time: Array
    y: Array


def step_response(
    plant: Plant, drive: str, output: str, *, ambient: float = ROOM, longest: float = 14400.0
) -> StepResponse:
    """Simulate a small step of a drive from rest and read gain, delay and lag off it.

    Parameters
    ----------
    plant : Plant
    drive, output : str
        What is moved by a twentieth of its range, and what answers.
    ambient : float, optional
        Where all rests before [degC].
    longest : float, optional
        Simulated at most [s], where the output never settles.

    Returns
    -------
    StepResponse

    Examples
    --------
    See :func:`thermogrip.mpc.controllers.pi.simc`, which tunes from it.
    """
    model = PredictionModel(plant, dt=plant.dt)
    j, i = model.drives.index(drive), model.outputs.index(output)
    rest, start, d = model.at_rest(ambient)
    step = np.zeros(model.n_u)
    step[j] = (0.05 if start[j] + 0.05 * model.span[j] <= model.highest[j] else -0.05) * model.span[j]
    x = np.repeat(rest[None, :], 2, axis=0)
    time, answer, seconds = [np.zeros(1)], [np.zeros(1)], max(60.0, 100 * plant.dt)
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
    at = int(np.argmax(np.abs(slope)))
    gain, steepest = float(response[-1]), float(slope[at])
    if gain == 0 or steepest == 0:
        return StepResponse(0.0, float("inf"), float("inf"), t, response)
    delay = max(0.0, float(t[at] - response[at] / steepest))
    return StepResponse(gain, delay, abs(gain / steepest), t, response)


def sample_time(plant: Plant) -> float:
    """Return a sample time [s] for control: a quarter of the shortest apparent delay, on a 1-2-5 grid.

    Where there is next to no delay, a 400th of the lag; never below the plant's own step.
    """
    found = []
    for output in plant.model.outputs:
        answers = [step_response(plant, drive, output) for drive in drive_names(plant)]
        best = max(answers, key=lambda answer: abs(answer.gain))
        if best.gain:
            found.append(max(best.delay / 4, min(best.lag, 4000.0) / 400))
    wanted = max(found) if found else plant.dt
    grid = np.array([m * 10.0**e for e in range(-3, 3) for m in (1, 2, 5)])
    nice = float(grid[int(np.argmin(np.abs(np.log(grid / wanted))))])
    return max(1, round(nice / plant.dt)) * plant.dt
