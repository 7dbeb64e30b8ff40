r"""Review, what the loop does by itself: plant, observer and unconstrained move as one linear map.

While no limit is near the controller is a linear system
(:mod:`thermogrip.mpc.controllers.linear_equivalent`) from readings to drives. Together with a plant x+ = A x
+ B u, y = C x + q, it is one matrix M.  Its eigenvalues must lie inside the unit circle, on the plant and on
draws of it; those of the observer alone are of F (I - L H).  With a constant offset q of an output, in
steady state s = (I - M)^-1 b q, the controlled output must be back at its target: that is what free of
offset means.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thermogrip.mpc.controllers.linear_equivalent import LinearLaw, linear_law, linear_move
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.estimator.observer import choose_disturbances, detectability_margin
from thermogrip.mpc.optimiser.rti import Optimiser
from thermogrip.mpc.plant.prediction import PredictionModel
from thermogrip.mpc.review.check import Check
from thermogrip.mpc.tuning.trials import draws_of

__all__ = [
    "LinearLoop",
    "detectable",
    "eigenvalues",
    "hessian",
    "largest_eigenvalue",
    "loops_of",
    "observer_stable",
    "offset_free",
    "scaling",
    "weights",
]

Array = NDArray[np.float64]

_SLOW = 0.9995  # an eigenvalue beyond which a loop hardly settles
_IDLE = 1e-4  # relative change of the move below which a doubled weight does nothing
_ILL, _LOST = 1e8, 1e12  # condition of the Hessian


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
    """A double has 16 digits: a Hessian of condition 1e8 takes half of them from the answer."""
    H, _, _ = linear_move(controller)
    values = np.linalg.eigvalsh(H)
    condition = float(values[-1] / values[0]) if values[0] > 0 else float("inf")
    name, finding = "QP is well conditioned", f"{H.shape[0]} unknowns, condition {condition:.1e}"
    if values[0] <= 0 or condition > _LOST:
        return Check(name, "fail", finding, "raise the move weight")
    if condition > _ILL:
        return Check(name, "warn", finding, "raise the move weight or take fewer blocks")
    return Check(name, "pass", finding)


def scaling(controller: Controller) -> Check:
    """Drives are scaled by their ranges and temperatures count in degC, so the gains must be comparable."""
    name, (model, optimiser) = "variables are well scaled", (controller.model, controller.optimiser)
    response = np.abs(optimiser.at_rest).max(axis=0)
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
    n_u = controller.model.n_u
    on_free, on_last = (gain[:n_u] for gain in linear_move(controller)[1:])
    idle, seen = [], []
    for key in ("move", "terminal", "drive"):
        value = getattr(design, key)
        if value == 0:
            continue
        doubled = Optimiser(controller.model, replace(design, **{key: 2 * value}))
        free, last = (gain[:n_u] for gain in linear_move(controller, doubled)[1:])
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
    law = linear_law(controller)
    return [
        _loop(controller, law, draw) for draw in (0, *(k for k in draws_of(controller.plant, draws) if k))
    ]


def eigenvalues(loops: Sequence[LinearLoop]) -> Check:
    """Largest eigenvalue of plant, observer and unconstrained move, around the middle of the range.

    A slow part of the plant that the loop leaves as it is, a heatsink say, is no fault of the loop.
    """
    name = "closed loop is stable"
    sizes = [largest_eigenvalue(loop.matrix) for loop in loops]
    nominal, worst = sizes[0], max(sizes)
    finding = f"largest eigenvalue {nominal:.4f} on the plant, {worst:.4f} on {len(loops) - 1} draws"
    if worst >= 1 - 1e-9:
        return Check(name, "fail", finding, "raise the move weight, or make the observer slower")
    slow = [(size, largest_eigenvalue(loop.A)) for size, loop in zip(sizes, loops) if size > _SLOW]
    if any(abs(size - own) > 0.1 * (1 - own) for size, own in slow):
        return Check(name, "warn", finding, "something settles very slowly; see the observer's drive noise")
    return Check(name, "pass", finding + (": a slow part of the plant, as without the loop" if slow else ""))


def observer_stable(controller: Controller, loop: LinearLoop) -> Check:
    """The estimate must forget where it started, disturbances included."""
    name = "observer forgets its errors"
    size = largest_eigenvalue(loop.law.forgets)
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


def largest_eigenvalue(matrix: Array) -> float:
    """Return the size of the largest eigenvalue of a matrix."""
    return float(np.max(np.abs(np.linalg.eigvals(matrix))))


class LinearLoop:
    """A plant under the linear law, as one linear map; targets 0, no noise.

    Parameters
    ----------
    law : LinearLaw
    A, B, C : ndarray
        The plant at the controller's sample time.
    rows : list of int
        The controlled outputs.
    """

    def __init__(self, law: LinearLaw, A: Array, B: Array, C: Array, rows: list[int]) -> None:
        self.law, self.A, self.B, self.C, self.rows = law, A, B, C, rows

    @property
    def matrix(self) -> Array:
        """The (n, n) map of (plant, controller) to the next sample."""
        law, by_y = self.law, slice(0, self.law.n_y)
        return np.block(
            [
                [self.A + self.B @ law.D[:, by_y] @ self.C, self.B @ law.C],
                [law.B[:, by_y] @ self.C, law.A],
            ]
        )

    def left_of_offset(self) -> float:
        """Return the largest reading of a controlled output that stays for 1 degC of offset of any output."""
        law, by_y, n_x = self.law, slice(0, self.law.n_y), len(self.A)
        entry = np.vstack([self.B @ law.D[:, by_y], law.B[:, by_y]])
        try:
            states = np.linalg.solve(np.eye(len(entry)) - self.matrix, entry)
        except np.linalg.LinAlgError:
            return float("inf")
        readings = self.C @ states[:n_x] + np.eye(law.n_y)
        return float(np.max(np.abs(readings[self.rows])))


def _loop(controller: Controller, law: LinearLaw, draw: int) -> LinearLoop:
    model, design = controller.model, controller.design
    truth = PredictionModel(controller.plant.draw(draw), dt=design.dt)
    _, A, B, _ = truth.linearise(*truth.at_rest(design.ambient))
    return LinearLoop(law, A, B, truth.C, [model.outputs.index(name) for name in design.controlled])
