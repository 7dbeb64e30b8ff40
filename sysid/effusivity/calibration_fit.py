"""The joint problem of calibration: shared parameters theta, nuisances of every grasp, and their arrow
matrix.

See :mod:`thermogrip.sysid.effusivity.calibration` for the theory,
:mod:`thermogrip.sysid.effusivity.calibration_prior` for theta's layout.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermogrip.sysid.contact.response import Stack, TimeNodes
from thermogrip.sysid.effusivity.calibration_prior import SHARED, STACK, Anchor, ThetaPrior
from thermogrip.sysid.effusivity.data import Touches
from thermogrip.sysid.effusivity.gripper_model import INSULATOR, LEVEL_SD, UNKNOWN_OBJECT_SD
from thermogrip.sysid.effusivity.laplace_approximation import (
    BUILD,
    CAPACITY,
    EFFUSIVITY,
    LEVEL,
    N_NUISANCE,
    ONSET,
    T_OBJECT,
    H,
    jacobian,
    nodes_for,
    predict,
)

__all__ = [
    "FLOORS",
    "Linearised",
    "Problem",
    "Spread",
    "joint_step",
    "linearise",
    "renew_spread",
]

Array = NDArray[np.float64]
Spread = dict[str, float]

FLOORS = {"ln_h": 0.02, "ln_build": 0.03, "onset": 0.005, "t_object": 0.02, "ln_effusivity": 0.02}
_COLUMN = {"ln_h": H, "ln_build": BUILD, "onset": ONSET, "t_object": T_OBJECT, "ln_effusivity": EFFUSIVITY}
_DIFFERENCE = {"leak": 1e-5}
_LONGEST = 1.5  # of a step of theta, mostly logarithms


@dataclass(frozen=True)
class Problem:
    """Labelled grasps and priors, fixed during a fit.

    ``data`` of n grasps; ``labels`` the materials, ``which`` (n,) the label of each; ``prior`` of theta;
    ``ln_capacity`` (n_label,) of rho c_p times the block's length.
    """

    data: Touches
    nodes: TimeNodes
    labels: tuple[str, ...]
    library: tuple[Anchor, ...]
    which: NDArray[np.int64]
    prior: ThetaPrior
    ln_capacity: Array

    @classmethod
    def of(
        cls, data: Touches, known: Mapping[str, Anchor], prior: ThetaPrior, block_length: float
    ) -> Problem:
        """Return the problem of these touches; ``known`` has a row for each label of theta, in its order."""
        labels = tuple(known)
        return cls(
            data,
            nodes_for(data),
            labels,
            tuple(known.values()),
            np.array([labels.index(m) for m in data.material.tolist()]),
            prior,
            np.log([row.heat_capacity * block_length for row in known.values()]),
        )

    @property
    def known(self) -> NDArray[np.bool_]:
        """Return where the object's temperature was known, (n,)."""
        return np.isfinite(self.data.t_object)

    @property
    def insulating(self) -> NDArray[np.bool_]:
        """Return which grasps are of insulators, (n,)."""
        return np.array([m.effusivity < INSULATOR for m in self.library])[self.which]

    def rows(self, spread: str) -> NDArray[np.bool_]:
        """Return which grasps inform a spread, (n,)."""
        everywhere = np.ones(self.which.size, dtype=bool)
        return {"t_object": self.known, "ln_effusivity": self.insulating}.get(spread, everywhere)

    def dof(self, spread: str) -> float:
        """Return the degrees of freedom of a spread: grasps and guesses less the means fitted to them."""
        insulators = np.unique(self.which[self.insulating]).size
        means = {"ln_h": np.unique(self.which).size, "ln_effusivity": insulators, "t_object": 2}
        guesses = self.prior.guesses
        return max(guesses, float(self.rows(spread).sum()) - means.get(spread, 1) + guesses)

    def index(self, name: str) -> int:
        """Return the place of a shared parameter in theta."""
        return [*STACK, *SHARED].index(name)

    def ln_h(self, theta: Array) -> Array:
        """Return ln h of each label, a view into theta."""
        n = len(self.labels)
        return theta[-2 * n : -n]

    def ln_e(self, theta: Array) -> Array:
        """Return ln e of each label, a view into theta."""
        return theta[-len(self.labels) :]

    def stack(self, theta: Array) -> Stack:
        """Return the gripper that theta describes."""
        value = dict(zip([*STACK, *SHARED], theta))
        names = [*STACK, "ln_build"]
        return Stack(
            **{k.removeprefix("ln_"): float(np.exp(value[k]) if "ln_" in k else value[k]) for k in names}
        )

    def room_difference(self) -> Array:
        """Return room minus object temperature where both are known, else 0, (n,)."""
        return np.nan_to_num(self.data.t_ambient - self.data.t_object)

    def centre(self, theta: Array) -> Array:
        """Return the prior mean of u, (n, 7)."""
        value = dict(zip([*STACK, *SHARED], theta))
        u = np.empty((self.which.size, N_NUISANCE))
        u[:, H] = self.ln_h(theta)[self.which]
        u[:, BUILD], u[:, ONSET], u[:, LEVEL] = value["ln_build"], value["onset"], self.data.level
        dial = np.where(self.known, self.data.t_object + value["bias"], self.data.level)
        u[:, T_OBJECT] = dial + value["carry"] * self.room_difference()
        u[:, EFFUSIVITY] = self.ln_e(theta)[self.which]
        u[:, CAPACITY] = self.ln_capacity[self.which] + value["ln_depth"]
        return u

    def scales(self, spread: Spread) -> Array:
        """Return the prior sd of u, (n, 7)."""
        s = np.zeros((self.which.size, N_NUISANCE))
        for name, column in _COLUMN.items():
            s[:, column] = np.where(
                self.rows(name), spread[name], UNKNOWN_OBJECT_SD if name == "t_object" else 0.0
            )
        own = self.data.t_object_sd
        s[:, T_OBJECT] = np.where(self.known & np.isfinite(own), own, s[:, T_OBJECT])
        s[:, LEVEL] = LEVEL_SD
        return s


class Linearised(NamedTuple):
    """Predictions (n, n_bin) and their derivatives by w (n, n_bin, 7) and by theta (n, n_bin, n_theta)."""

    y: Array
    by_w: Array
    by_theta: Array


def linearise(problem: Problem, theta: Array, w: Array, spread: Spread) -> Linearised:
    """Return the prediction of every grasp and its derivatives."""
    data, nodes, scale = problem.data, problem.nodes, problem.scales(spread)
    u = problem.centre(theta) + scale * w
    y, by_u = jacobian(problem.stack(theta), nodes, data, u, np.ones(u.shape, dtype=bool))
    k = np.zeros((*y.shape, theta.size))
    for i, name in enumerate(STACK):
        moved = theta.copy()
        moved[i] += _DIFFERENCE.get(name, 1e-4)
        if name == "ln_first" and moved[i] > 0:  # a share is 1 at most: the difference is taken inwards
            moved[i] = theta[i] - 1e-4
        k[:, :, i] = (predict(problem.stack(moved), nodes, data, u) - y) / (moved[i] - theta[i])
    shared = {
        "ln_build": by_u[:, :, BUILD],
        "onset": by_u[:, :, ONSET],
        "carry": by_u[:, :, T_OBJECT] * problem.room_difference()[:, None],
        "bias": by_u[:, :, T_OBJECT] * problem.known[:, None],
        "ln_depth": by_u[:, :, CAPACITY],
    }
    for name, values in shared.items():
        k[:, :, problem.index(name)] = values
    n = len(problem.labels)
    for m in range(n):
        own = problem.which == m
        k[own, :, theta.size - 2 * n + m] = by_u[own, :, H]
        k[own, :, theta.size - n + m] = by_u[own, :, EFFUSIVITY]
    return Linearised(y, by_u * scale[:, None, :], k)


class Step(NamedTuple):
    """One joint Gauss-Newton step.

    New ``theta`` and ``w``, the ``damping`` to go on with, the ``objective`` before it and the log
    determinant of the nuisances, their posterior variances ``variance`` (n, 7) in units of the prior, and
    the precision of theta.
    """

    theta: Array
    w: Array
    damping: float
    objective: float
    log_det: float
    variance: Array
    precision: Array


def joint_step(
    problem: Problem, theta: Array, w: Array, spread: Spread, whitener: Array, damping: float
) -> Step:
    """Return the state after one step of theta and all w, damped until the objective falls."""
    lin = linearise(problem, theta, w, spread)
    residual = np.einsum("nij,nj->ni", whitener, problem.data.y - lin.y)
    j, k = whitener @ lin.by_w, whitener @ lin.by_theta
    matrix = np.eye(N_NUISANCE) + j.transpose(0, 2, 1) @ j
    inverse = np.linalg.inv(matrix)
    border = j.transpose(0, 2, 1) @ k
    eliminate = border.transpose(0, 2, 1) @ inverse
    grad_w = np.einsum("nik,ni->nk", j, residual) - w
    prior = problem.prior
    grad = np.einsum("nik,ni->k", k, residual) - prior.precision @ (theta - prior.mean)
    grad -= np.einsum("nka,na->k", eliminate, grad_w)
    flat = k.reshape(-1, theta.size)
    precision = prior.precision + flat.T @ flat - (eliminate @ border).sum(axis=0)
    before = float((residual**2).sum() + (w**2).sum()) + prior.penalty(theta)
    new_theta, new_w = theta, w
    for _ in range(10):
        move = np.linalg.solve(precision + damping * np.diag(np.diag(precision)), grad)
        move_w = np.einsum("nab,nb->na", inverse, grad_w - border @ move)
        # from a cold start the first steps would leave the range of any gripper
        shorten = min(1.0, _LONGEST / float(np.abs(move).max()), 10 / float(np.abs(move_w).max()))
        move, move_w = shorten * move, shorten * move_w
        if _objective(problem, theta + move, w + move_w, spread, whitener) < before + 1e-9:
            new_theta, new_w, damping = theta + move, w + move_w, max(damping * 0.1, 1e-9)
            break
        damping = max(damping * 10, 1e-6)
    variance = np.diagonal(inverse, axis1=1, axis2=2)
    return Step(
        new_theta, new_w, damping, before, float(np.linalg.slogdet(matrix)[1].sum()), variance, precision
    )


def renew_spread(problem: Problem, spread: Spread, w: Array, variance: Array) -> tuple[Spread, Array]:
    """Return the spreads after one (over-relaxed) step of EM, and w in their units.

    The sum of squares is divided by the degrees of freedom, since means are fitted to the same grasps.
    A spread that no grasp informs, such as that of insulators where all are metals, stays.
    """
    new, scaled = dict(spread), w.copy()
    for name, column in _COLUMN.items():
        rows = problem.rows(name)
        if name == "t_object":
            rows = rows & ~np.isfinite(problem.data.t_object_sd)
        if not rows.any():
            continue
        squares = float((w[rows, column] ** 2 + variance[rows, column]).sum())
        squares += problem.prior.guesses * (problem.prior.spread[name] / spread[name]) ** 2
        ratio = np.sqrt(squares / problem.dof(name)) ** 1.5
        new[name] = max(FLOORS[name], float(spread[name] * ratio))
        scaled[rows, column] *= spread[name] / new[name]
    return new, scaled


def _objective(problem: Problem, theta: Array, w: Array, spread: Spread, whitener: Array) -> float:
    try:
        stack = problem.stack(theta)
    except ValueError:
        return np.inf  # outside the physical range: the step is refused and shortened
    u = problem.centre(theta) + problem.scales(spread) * w
    y = predict(stack, problem.nodes, problem.data, u)
    residual = np.einsum("nij,nj->ni", whitener, problem.data.y - y)
    return float((residual**2).sum() + (w**2).sum()) + problem.prior.penalty(theta)
