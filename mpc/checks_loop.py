r"""Review, what the loop does by itself: plant, observer and unconstrained move as one linear map.

With y+ = G (v - v0) the move of the optimiser without limits is linear, u = K_1 (free response - r) + K_2
u_before, and so is the observer with its settled gain L.  Together with a plant,

    x+ = A x + B u,    z = z^ + L (C x + q - H z^),    z^+ = F z + B u,

they are one matrix M.  Its eigenvalues must lie inside the unit circle, on the plant and on draws of it;
those of the observer alone are of F (I - L H).  With a constant offset q of an output, in steady state
s = (I - M)^-1 b q, the controlled output must be back at its target: that is what free of offset means.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from thermogrip.mpc.controller import Controller
from thermogrip.mpc.finding import Check
from thermogrip.mpc.observer import choose_disturbances, detectability_margin
from thermogrip.mpc.optimiser import Optimiser
from thermogrip.mpc.prediction import PredictionModel
from thermogrip.mpc.trials import draws_of

__all__ = [
    "LinearLoop",
    "detectable",
    "eigenvalues",
    "hessian",
    "largest_eigenvalue",
    "linear_move",
    "loops_of",
    "observer_stable",
    "offset_free",
    "scaling",
    "weights",
]

Array = NDArray[np.float64]

_IDLE = 1e-4  # relative change of the move below which a doubled weight does nothing


def detectable(controller: Controller) -> Check:
    """Where the gain of a drive is small its bias can hardly be seen, so the test is made over the range."""
    name, model = "disturbances are detectable", controller.model
    if not controller.design.offset_free:
        fix = "set offset_free"
        return Check(name, "fail", "no disturbance states: the loop ends off its target", fix)
    chosen = choose_disturbances(model, controller.controlled, ambient=controller.design.ambient)
    d = np.full(model.n_d, controller.design.ambient)
    scale = np.array([0.01 if label.startswith("input") else 1.0 for label in chosen.names])
    margins = []
    for share in (0.1, 0.3, 0.5, 0.7, 0.9):
        u = model.lowest + share * model.span
        _, A, B, E = model.linearise(model.steady_state(u, d), u, d)
        into = B @ (chosen.on_drive * model.span[:, None]) + E @ chosen.on_disturbance
        margins.append(
            detectability_margin(A, model.C, into, chosen.on_output, scale=scale)
            if np.isfinite(A).all()
            else 0.0
        )
    finding = (
        f"{', '.join(chosen.names)}; 1 % of the drive or 1 degC shows as {min(margins):.2f} "
        f"to {max(margins):.2f} degC"
    )
    if min(margins) <= 1e-6:
        return Check(name, "fail", finding, "narrow drive_limits to where the gain keeps its sign")
    if min(margins) < 0.02:
        return Check(name, "warn", finding, "expect slow removal of offsets where the gain is small")
    return Check(name, "pass", finding)


def hessian(controller: Controller) -> Check:
    H, _, _ = linear_move(controller)
    values = np.linalg.eigvalsh(H)
    condition = float(values[-1] / values[0]) if values[0] > 0 else float("inf")
    name, finding = "QP is well conditioned", f"{H.shape[0]} unknowns, condition {condition:.1e}"
    if values[0] <= 0 or condition > 1e12:
        return Check(name, "fail", finding, "raise the move weight")
    if condition > 1e8:
        return Check(name, "warn", finding, "raise the move weight or take fewer blocks")
    return Check(name, "pass", finding)


def scaling(controller: Controller) -> Check:
    """Drives are scaled by their ranges and temperatures count in degC, so the gains must be comparable."""
    name, (model, optimiser) = "variables are well scaled", (controller.model, controller.optimiser)
    response = (
        np.abs(optimiser.at_rest) if optimiser.at_rest.ndim == 1 else np.abs(optimiser.at_rest).max(axis=0)
    )
    # summed over the horizon: what a whole range of a drive moves on average
    moved = response / sum(controller.design.blocks)
    told = ", ".join(f"{drive} {gain:.3g} degC" for drive, gain in zip(model.drives, moved))
    finding = f"a whole range of a drive moves its output over the horizon by {told}"
    if np.min(moved) < 1e-4 * max(1.0, float(np.max(moved))):
        return Check(
            name, "fail", finding, "leave out the drive that moves nothing, or widen its drive_limits"
        )
    if np.max(moved) > 300 * np.min(moved) or np.max(moved) > 3000 or np.min(moved) < 0.05:
        return Check(name, "warn", finding, "look at the units of the drives, and at drive_limits")
    return Check(name, "pass", finding)


def weights(controller: Controller) -> Check:
    """A weight that can be doubled without any change of the move is not worth thinking about."""
    name, design = "every weight does something", controller.design
    _, on_free, on_last = linear_move(controller)
    idle, seen = [], []
    for key in ("move", "terminal", "drive"):
        value = getattr(design, key)
        if value == 0:
            continue
        doubled = Optimiser(controller.model, replace(design, **{key: 2 * value}))
        _, free, last = linear_move(controller, doubled)
        change = float(np.linalg.norm(free - on_free) + np.linalg.norm(last - on_last))
        share = change / float(np.linalg.norm(on_free) + np.linalg.norm(on_last))
        seen.append(f"{key} {value:.3g} ({100 * share:.2g} %)")
        if share < _IDLE:
            idle.append(key)
    finding = f"doubled, they change the move by: {', '.join(seen)}"
    if len(idle) == len(seen):
        return Check(name, "fail", finding, "the move no longer depends on any weight: take them nearer to 1")
    if idle:
        return Check(name, "warn", finding, f"leave {', '.join(idle)} alone: tuning it changes nothing")
    return Check(name, "pass", finding)


def loops_of(controller: Controller, draws: int) -> list[LinearLoop]:
    """Return the loop on the plant itself, and on draws of it."""
    return [_loop(controller, draw) for draw in (0, *(k for k in draws_of(controller.plant, draws) if k))]


def eigenvalues(loops: Sequence[LinearLoop]) -> Check:
    """Largest eigenvalue of plant, observer and unconstrained move, around the middle of the range."""
    name = "closed loop is stable"
    sizes = [largest_eigenvalue(loop.matrix) for loop in loops]
    nominal, worst = sizes[0], max(sizes)
    finding = f"largest eigenvalue {nominal:.4f} on the plant, {worst:.4f} on {len(loops) - 1} draws"
    if worst >= 1 - 1e-9:
        return Check(name, "fail", finding, "raise the move weight, or make the observer slower")
    if worst > 0.9995:
        return Check(name, "warn", finding, "something settles very slowly; see the observer's drive noise")
    return Check(name, "pass", finding)


def observer_stable(controller: Controller, loop: LinearLoop) -> Check:
    """The estimate must forget where it started, disturbances included."""
    name = "observer forgets its errors"
    size = largest_eigenvalue(loop.F @ (np.eye(loop.n_z) - loop.gain @ loop.H))
    slow = -controller.dt / np.log(size) if 0 < size < 1 else float("inf")
    finding = f"largest eigenvalue {size:.4f}: an error falls to a third in {slow:.0f} s"
    if size >= 1 - 1e-9:
        return Check(
            name, "fail", finding, "measure another output, or give the observer's drive noise a value"
        )
    if slow > 3600:
        return Check(
            name, "warn", finding, "raise the observer's drive and output noise: it learns too slowly"
        )
    return Check(name, "pass", finding)


def offset_free(loops: Sequence[LinearLoop]) -> Check:
    """What is left, in steady state, of 1 degC of offset of each output, on the plant and on draws."""
    name = "no offset is left in steady state"
    left = max(loop.left_of_offset() for loop in loops)
    finding = f"of an offset of 1 degC {left:.4f} degC is left, plant and {len(loops) - 1} draws"
    if not left < 0.05:
        return Check(
            name, "fail", finding, "set offset_free; let an output that a drive can move be controlled"
        )
    return Check(name, "pass", finding)


def linear_move(controller: Controller, optimiser: Optimiser | None = None) -> tuple[Array, Array, Array]:
    """Return H of the QP, and the first move's gains on the free response and on the drive before."""
    model, design = controller.model, controller.design
    optimiser = controller.optimiser if optimiser is None else optimiser
    d = np.full(model.n_d, design.ambient)
    u = np.clip(np.zeros(model.n_u), model.lowest, model.highest)
    x = model.steady_state(u, d)
    x = model.rest(np.full(model.n_y, design.ambient), d) if not np.isfinite(x).all() else x
    plan = np.repeat(u[None, :], optimiser.n_b, axis=0)
    _, G = model.trajectory(x, plan, d, design.blocks)
    flat = G.reshape(optimiser.N, model.n_y, -1) * np.tile(model.span, optimiser.n_b)
    rows = [model.outputs.index(name) for name in design.controlled]
    return optimiser.linear_gains(flat, rows)


def largest_eigenvalue(matrix: Array) -> float:
    """Return the size of the largest eigenvalue of a matrix."""
    return float(np.max(np.abs(np.linalg.eigvals(matrix))))


def _loop(controller: Controller, draw: int) -> LinearLoop:
    model, design = controller.model, controller.design
    truth = PredictionModel(controller.plant.draw(draw), dt=design.dt)
    u = np.clip(np.zeros(model.n_u), model.lowest, model.highest)
    return LinearLoop(controller, truth, u, np.full(model.n_d, design.ambient))


class LinearLoop:
    """Plant, observer with its settled gain, and the unconstrained move, as one linear map."""

    def __init__(self, controller: Controller, truth: PredictionModel, u: Array, d: Array) -> None:
        model, observer = controller.model, controller.observer
        self.A, self.B = truth.linearise(truth.rest(np.full(truth.n_y, d[0] if d.size else 25.0), d), u, d)[
            1:3
        ]
        self.C = truth.C
        x = model.rest(np.full(model.n_y, d[0] if d.size else 25.0), d)
        _, self.Am, self.Bm, Em = model.linearise(x, u, d)
        chosen = controller.disturbance
        into = self.Bm @ (chosen.on_drive * model.span[:, None]) + Em @ chosen.on_disturbance
        n_x, n_w = model.n_x, chosen.n_w
        self.F = np.block([[self.Am, into], [np.zeros((n_w, n_x)), np.eye(n_w)]])
        self.H = np.hstack([model.C, chosen.on_output])
        self.gain = observer.settled_gain(self.F)
        _, self.on_free, self.on_last = linear_move(controller)
        self.blocks, self.n_x, self.n_u, self.n_z = controller.design.blocks, n_x, model.n_u, n_x + n_w
        self.rows = [model.outputs.index(name) for name in controller.controlled]
        self.n_t = truth.n_x
        self.size = self.n_t + self.n_z + self.n_u

    @cached_property
    def matrix(self) -> Array:
        """Return the loop as one matrix (size, size)."""
        return np.stack([self.step(row) for row in np.eye(self.size)], axis=1)

    def left_of_offset(self) -> float:
        """Return the largest reading of a controlled output that stays for 1 degC of offset of any output."""
        closed, left = np.eye(self.size) - self.matrix, 0.0
        for offset in np.eye(len(self.C)):
            try:
                state = np.linalg.solve(closed, self.step(np.zeros(self.size), offset))
            except np.linalg.LinAlgError:
                return float("inf")
            reading = self.C @ state[: self.n_t] + offset
            left = max(left, float(np.max(np.abs(reading[self.rows]))))
        return left

    def step(self, state: Array, offset: float | Array = 0.0) -> Array:
        """Return (plant, estimate before the reading, drive) one sample later; target 0, no noise."""
        x, z, last = np.split(state, [self.n_t, self.n_t + self.n_z])
        z = z + self.gain @ (self.C @ x + offset - self.H @ z)
        # the free response of the estimate, its biases held, without any drive
        free, ahead = [], z
        for _ in range(sum(self.blocks)):
            ahead = self.F @ ahead
            free.append((self.H @ ahead)[self.rows])
        u = self.on_free @ np.concatenate(free) + self.on_last @ last
        after = np.concatenate([self.Bm @ u, np.zeros(self.n_z - self.n_x)])
        return np.concatenate([self.A @ x + self.B @ u, self.F @ z + after, u])
