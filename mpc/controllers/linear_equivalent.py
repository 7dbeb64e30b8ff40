r"""The controller as a linear system: what it is while no limit is near.

Without limits the first move of the QP is linear in the free response of the estimate, and the observer with
its settled gain L is linear too.  About rest in the design's room, with r the target, d the measured
disturbances and u^- the move of the sample before, it is in (z^, u^-) one state space from (y, r, d) to u:
what loop shaping and margins are made of.  The overshoot band and the limits of outputs are rows of the QP,
and not in it; nor are zones and prices: what is reviewed tracks the middle of a zone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError

if TYPE_CHECKING:
    from thermogrip.mpc.optimiser.rti import ControllerParts, LinearGains


@dataclass(frozen=True, eq=False)
class LinearLaw:
    """A controller without limits, in changes from rest."""

    A: Array  # (n, n) next state and drives from state and inputs
    B: Array
    C: Array
    D: Array
    inputs: tuple[str, ...]  # readings, ``target_<name>``, measured disturbances; drives; states
    outputs: tuple[str, ...]
    states: tuple[str, ...]
    dt: float  # sample time [s]


def linear_move(controller: ControllerParts) -> LinearGains:
    """Return the plan without limits, linearised where the plant settles without drive."""
    model = controller.model
    design = controller.design
    optimiser = controller.optimiser
    x_rest, u, d = model.at_rest(design.ambient)
    x = model.steady_state(u, d)
    # what settles nowhere is linearised where it rests
    x = x_rest if not np.isfinite(x).all() else x
    plan = np.repeat(u[None, :], optimiser.n_b, axis=0)
    _, G = model.trajectory(x, plan, d, design.blocks)
    flat = G.reshape(optimiser.N, model.n_y, -1) * np.tile(model.span, optimiser.n_b)
    return optimiser.linear_gains(flat)


def linear_law(controller: ControllerParts) -> LinearLaw:
    """Return the controller as a linear system, about rest in the design's room."""
    model, chosen = controller.model, controller.observer.disturbance
    n_u, n_w = model.n_u, chosen.n_w
    # the model with its disturbance states: z^+ = F z + B u + E d, y = H z
    _, A, by_u, by_d = model.linearise(*model.at_rest(controller.design.ambient))
    into = by_u @ (chosen.on_drive * model.span[:, None]) + by_d @ chosen.on_disturbance
    F = np.block([[A, into], [np.zeros((n_w, model.n_x)), np.eye(n_w)]])
    B, E = (np.pad(matrix, ((0, n_w), (0, 0))) for matrix in (by_u, by_d))
    H = np.hstack([model.C, chosen.on_output])
    n_z, L = len(F), controller.observer.settled_gain(F)
    rows = [model.outputs.index(name) for name in controller.design.controlled]
    # the free response of the controlled outputs to z and to d, sample by sample
    by_z, by_held_d = list[Array](), list[Array]()
    power, held_d = np.eye(n_z), np.zeros_like(E)
    for _ in range(sum(controller.design.blocks)):
        held_d, power = F @ held_d + E, F @ power
        by_z.append(H[rows] @ power)
        by_held_d.append(H[rows] @ held_d)
    move = linear_move(controller)
    on_free = move.on_free[:n_u]
    # the first move is u = K_z z + K_r r + K_d d + K_u u^-
    K_z, K_d = on_free @ np.vstack(by_z), on_free @ np.vstack(by_held_d)
    K_r = -on_free @ np.tile(np.eye(len(rows)), (len(by_z), 1))
    # z = z^ + L (y - H z^), the estimate of state and disturbances with this reading
    uncorrected = np.eye(n_z) - L @ H
    to_drive = np.hstack([K_z @ uncorrected, move.on_last[:n_u]])
    straight = np.hstack([K_z @ L, K_r, K_d])
    # z^+ = F z + B u + E d
    after = np.hstack([F @ uncorrected, np.zeros((n_z, model.n_u))])
    into_z = np.hstack([F @ L, np.zeros((n_z, len(rows))), E])
    targets = tuple(f"target_{name}" for name in controller.design.controlled)
    return LinearLaw(
        A=np.vstack([after + B @ to_drive, to_drive]),
        B=np.vstack([into_z + B @ straight, straight]),
        C=to_drive,
        D=straight,
        inputs=(*model.outputs, *targets, *model.disturbances),
        outputs=model.drives,
        states=(*(f"z{k}" for k in range(n_z)), *(f"last_{name}" for name in model.drives)),
        dt=model.dt,
    )


def to_control(controller: ControllerParts) -> Any:
    """Return the law as a python-control ``StateSpace``; see :meth:`Controller.to_control`."""
    from thermogrip.sysid.plant.linearise import control_system

    if controller.design.zones:
        problem = "zones: a controller that may rest anywhere in them is no linear system"
        raise UserError(problem, hint="tune without them")
    law = linear_law(controller)
    return control_system(law, (law.A, law.B, law.C, law.D, law.dt), "controller")
