"""Evidence of a hypothesis about one grasp: Gauss-Newton to the mode, Laplace's method around it.

A hypothesis (a material, or an effusivity) fixes a Gaussian prior over the seven nuisances of a grasp,

    u = (ln h, ln tau_b, t0, b, T_obj, ln e, ln C),

and predicts the bin means f(u).  With the whitener W of the noise and u = mean + sd w the objective is
``|W (y - f)|^2 + |w|^2``, its Gauss-Newton matrix A = I + J' J, and

    ln Z = -1/2 objective - 1/2 ln det A - 1/2 ln det(2 pi C).

A nuisance whose spread was learnt from few grasps has Student's t as its prior instead of a normal one: the
sum of (nu + 1) ln(1 + w^2 / nu) replaces its w^2, the density's own curvature its 1 in A, and ln Z gains the
ratio of the two peaks.  b and T_obj enter f linearly, so for them Laplace's method is exact
marginalisation; the others are nearly Gaussian given them.  A nuisance with sd 0 is known.  Every function
works on a batch of (grasp, hypothesis) pairs.

What a hypothesis expects before the data
-----------------------------------------

- A **material with training grasps**: its block's ln h and ln e as calibrated, with the spread from grasp to
  grasp.
- **Another block** of such a material (``finish="unknown"``): ln h is 0.4 off, as much as ground faces of one
  metal whose roughness is a factor of 1.5 apart (between 0.25 and 2.5 um conductance changes fivefold), ln e
  by the table's uncertainty of the material and 5 % of composition.
- A **material of the library**: its effusivity on the gripper's scale, with the row's uncertainty, on a block
  of unknown contact conductance.
- A **free effusivity**: a point of ln e, unknown contact conductance, rho c_p of solids in general (3.2
  MJ/m^3K for metals, 1.7 for insulators).

What comes from the gripper and the nominal temperature (build-up time, onset, object temperature) is common
to all of them.

Somebody stated the nominal temperature, and blocks are mistaken, or not at rest: one in twenty is three times
as far off as the training's were (Tukey's contaminated normal).  T_obj enters linearly, so the readings' own
say, the ratio of its posterior and prior, gives mode and evidence under the wider prior too, and the answer
is the mixture (:func:`doubted`).

Uncertain grippers
------------------

A calibration leaves theta (:mod:`thermogrip.sysid.effusivity.gripper_model`) with a covariance P.  theta
moves the response, and the prior means of the nuisances: u = v + M (theta - t0), with v as it was for the
gripper t0.  With theta = t0 + R z, R R' = P, the unknowns are v and z, and z ~ N(0, 1) is one more prior:
the search for the mode and Laplace's method around it are those of u alone, for both together, and the
evidence at the end is integrated over both.

Every hypothesis finds a gripper of its own.  From the calibration's gripper the way there may be long, with
one that was right 50 nats behind after the first step, so a search is left only after a dozen of them, where
it would end 20 nats behind and gains less than that in four.  The likeliest
hypothesis of a touch begins there, and each other one where the one before it along ln e ended, if that is
nearer: z as the same a, theta = t0 + P a, since P depends on the block.  The density of a free effusivity
falls to either side of the likeliest, so beyond a point that is 20 nats behind no other is searched.

Where the block is not of the calibration its effusivity is on the scale that the calibration's blocks
define, so P is taken given theirs; the scale's own uncertainty is added where effusivities are reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaln, logsumexp

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.materials import Material, find_material
from thermogrip.sysid.contact.simulation import (
    LAYER_NAMES,
    Stack,
    TimeNodes,
    gripper_modes,
    nearby_modes,
    time_nodes,
)
from thermogrip.sysid.effusivity.data import Touches, Whitened, graded, whiten
from thermogrip.sysid.effusivity.gripper_model import (
    INSULATOR,
    LEVEL_SD,
    SHARED_NAMES,
    UNKNOWN_OBJECT_SD,
    GripperModel,
    stack_numbers,
)

H, BUILD_UP, ONSET, LEVEL, T_OBJECT, EFFUSIVITY, CAPACITY = range(7)
N_NUISANCE = 7
_EARLIEST_ONSET = 1.5  # s before the closed message
SENSORS_APART = 0.3  # K: two thermistors of 1 %
_DOF, _COUNTS, _GAIN_SD = 20.0, 2.0, 0.1
_ALIKE_SD = 1.0  # K
# Tukey's contaminated normal: one stated temperature of an object in twenty is three times as far off
SLIPS, _SLIP = 0.05, 3.0
_TELLING = 0.5  # of the prior variance of the temperature: readings that leave more do not tell a slip
# s of onset, and share of an object's distance from the skin, where logarithms of the rest are one off: a
# message that is late by a third of a second, an object that has gone a fifth of its way
_UNLIKE_ONSET, _UNLIKE_OBJECT = 0.3, 0.2
_FINISH_SD, _GRADE_SD = 0.4, 0.05  # between blocks of one material: of ln h, and of ln e beside the table's


class Prior(NamedTuple):
    """Mean and sd of u, (n_pair, 7) each; where ``dof`` (n_pair, 7) is given and finite, Student's t with so
    many degrees of freedom and scale ``sd``: a spread estimated from few grasps is itself uncertain."""

    mean: Array
    sd: Array
    dof: Array | None = None


class Mode(NamedTuple):
    """Where Gauss-Newton ended, a row a pair."""

    u: Array  # (n, 7)
    covariance: Array  # (n, 7, 7), of u
    log_evidence: Array  # (n,)
    converged: Mask  # (n,)
    misfit: Array  # (n,), |W (y - f)|^2


def nodes_for(data: Touches) -> TimeNodes:
    """Return the time nodes that reach the last sample of an early contact."""
    return time_nodes(data.end + _EARLIEST_ONSET)


def predict(stack: Stack, nodes: TimeNodes, data: Touches, u: Array, beyond: Array | None = None) -> Array:
    """Return the bin means that nuisances u (n_pair, 7) predict, (n_pair, n_bin) [degC]."""
    return jacobian(stack, nodes, data, u, np.zeros(u.shape, dtype=bool), beyond)[0]


def jacobian(
    stack: Stack, nodes: TimeNodes, data: Touches, u: Array, vary: Mask, beyond: Array | None = None
) -> tuple[Array, Array]:
    """Return the prediction (n_pair, n_bin) and its derivatives by u, (n_pair, n_bin, 7), zero where not
    ``vary`` (n_pair, 7), the unknown nuisances; ``beyond`` (n_pair, 2, n_bin) the gripper's discrepancy."""
    from thermogrip.sysid.effusivity.mode_kernel import readings

    y, slopes = readings(pairs_asked(stack, nodes, data, np.arange(len(u)), beyond), u, vary)
    return y, slopes[:, :N_NUISANCE].transpose(0, 2, 1)


def pairs_asked(
    stack: Stack, nodes: TimeNodes, data: Touches, row: NDArray[np.int64], beyond: Array | None
) -> Any:
    """Return the pairs of some rows and a gripper as the search takes them."""
    from thermogrip.sysid.effusivity.mode_kernel import Asked

    shape = (row.size, 2, data.y.shape[1])
    # a copy in C order: for other kinds of arrays kernels are compiled anew
    nothing = np.zeros(shape) if beyond is None else np.array(np.broadcast_to(beyond, shape), order="C")
    return Asked(nodes, gripper_modes(stack), data, row, nothing)


def find_modes(
    stack: Stack, data: Touches, row: NDArray[np.int64], whitener: Whitened, prior: Prior, *,
    start: Array | None = None, max_steps: int = 20, beyond: Array | None = None, rivals: bool = False,
    rough: float = 0.0,
) -> Mode:  # fmt: skip
    """Return mode, covariance and log evidence of every pair by damped Gauss-Newton.

    Pair p is touch ``row[p]`` under row p of ``prior``; ``whitener`` is what
    :func:`~thermogrip.sysid.effusivity.data.whiten` returns for ``data``.  It starts at the prior's mean with
    the level as measured, or at ``start`` (n_pair, 7); a pair that has not settled within ``max_steps`` is
    hopeless in practice, and where pairs of one touch are ``rivals`` one far behind the best is left early,
    or roughly found (``rough``, :func:`~thermogrip.sysid.effusivity.mode_kernel.modes`).
    """
    from thermogrip.sysid.effusivity.mode_kernel import modes

    vary = prior.sd > 0
    u = prior.mean.copy() if start is None else np.where(vary, start, prior.mean)
    if start is None:
        u[:, LEVEL] = np.where(vary[:, LEVEL], data.level[row], u[:, LEVEL])
    dof = np.full(u.shape, np.inf) if prior.dof is None else prior.dof
    w_matrix, log_det = whitener
    asked = pairs_asked(stack, nodes_for(data), data, row, beyond)
    law = np.stack([prior.mean, prior.sd, dof], axis=1)
    covariance, objective, misfit, settled = modes(
        asked, w_matrix, law, u, max_steps, rivals=rivals, rough=rough
    )
    evidence = -0.5 * (objective + log_det[row]) + peak_ratio(dof, vary)
    return Mode(u, covariance, evidence, settled, misfit)


def peak_ratio(dof: Array, vary: Mask) -> Array:
    """Return the log of Student's peak density over the normal one of the same scale, summed, (n_pair,)."""
    heavy = vary & np.isfinite(dof)
    nu = np.where(heavy, dof, 1.0)
    ratio = gammaln(0.5 * (nu + 1)) - gammaln(0.5 * nu) - 0.5 * np.log(0.5 * nu)
    return np.asarray(np.where(heavy, ratio, 0.0).sum(axis=1))


_AT = {name: i for i, name in enumerate((*SHARED_NAMES, "ln_h", "ln_e"))}
_STEPS = 90
_BESIDE = 3  # hypotheses that start from where the one before them ended
_STILL = 0.1  # of -2 ln density: a smaller predicted decrease ends the search
_HOPELESS = 20.0  # nats behind the likeliest
_EARLIEST, _PACE = 12, 4  # steps before a search may be left, and over which its gains are looked at
_DIFFERENCE = 1e-6
_LAYERS = np.array([_AT[f"ln_{name}"] for name in LAYER_NAMES])
_CONTACT = ("ln_lag", "ln_first", "creep", "ln_settle", "ln_g_far", "leak")
_NUMBERS = np.array([_AT[name] for name in _CONTACT])
_BY_LOGARITHM = np.array([name.startswith("ln_") for name in _CONTACT])
_MOVED = [*_LAYERS, *_NUMBERS[:-1]]
_LOGARITHMS = np.array([H, BUILD_UP, EFFUSIVITY, CAPACITY])
_FARTHER = 2.0  # times as many standard deviations as logarithms a step may move
_AT_ONCE = 16  # pairs, whose curves stay in the processor's cache


def uncertain_gripper_modes(
    gripper: GripperModel, data: Touches, row: NDArray[np.int64], whitener: tuple[Array, Array], prior: Prior,
    block: NDArray[np.int64], *, start: Array | None = None, max_steps: int = 20,
) -> Mode:  # fmt: skip
    """Return mode, covariance and log evidence of every pair, the gripper's parameters integrated over.

    As :func:`find_modes`; ``block`` (n_pair,) is the place in ``gripper.materials`` of a hypothesis' block,
    -1 for others.  ``u`` and its covariance are for the gripper that each hypothesis found.
    """
    beyond = gripper.beyond(data.take(row).t, prior.mean[:, EFFUSIVITY])
    first = find_modes(
        gripper.stack, data, row, whitener, prior, start=start, max_steps=max_steps, beyond=beyond
    )
    pairs = WithGripper.of(gripper, data, row, whitener[0], prior, block, beyond)
    found, asked = pairs.nothing_found(), np.zeros(row.size, dtype=bool)
    along = bool((block < 0).all() and not (prior.sd[:, EFFUSIVITY] > 0.0).any())
    order = np.lexsort((prior.mean[:, EFFUSIVITY], row))
    ends = np.searchsorted(row[order], np.arange(data.level.size + 1)).tolist()
    likely, sides = first.log_evidence[order], []
    for begin, end in pairwise(ends):
        if end > begin:
            lead = begin + int(np.argmax(likely[begin:end]))
            sides += [(lead, 1, end), (lead, -1, begin - 1)]
    leads = order[[lead for lead, way, _ in sides if way > 0]]
    pairs.settle(found, first.u, leads, None)
    asked[leads] = True
    while sides := [side for side in sides if side[0] + side[1] != side[2]]:
        turns = [[*range(place, end, way)][1 : _BESIDE + 1] for place, way, end in sides]
        at = order[np.concatenate(turns)]
        beside = order[np.repeat([side[0] for side in sides], [len(turn) for turn in turns])]
        pairs.settle(found, first.u, at, beside)
        asked[at] = True
        sides = [(turn[-1], way, end) for turn, (_, way, end) in zip(turns, sides)]
        if along:  # the density of an effusivity falls to either side
            enough = pairs.best + 2 * _HOPELESS
            sides = [s for s in sides if found.cost[order[s[0]]] < enough[row[order[s[0]]]]]
    mode = pairs.mode(found, whitener[1], Prior(prior.mean, pairs.sd[:, :N_NUISANCE], prior.dof))
    if asked.all():
        return mode
    best = np.full(data.level.size, -np.inf)
    np.maximum.at(best, row[asked], mode.log_evidence[asked])
    behind = np.minimum(first.log_evidence, best[row] - _HOPELESS)
    first = first._replace(log_evidence=behind, converged=np.zeros(row.size, dtype=bool))
    pick = [np.where(asked.reshape(-1, *[1] * (own.ndim - 1)), own, rest) for own, rest in zip(mode, first)]
    return Mode(*pick)


class WithGripper(NamedTuple):
    """Pairs whose unknowns are v (7,) and the gripper, theta = t0 + R z, as a search takes them."""

    data: Touches
    nodes: TimeNodes
    whitener: Array
    row: NDArray[np.int64]
    beyond: Array  # (n, 2, n_bin)
    centre: Array  # (n_number,), the stack's numbers of t0
    root: Array  # (n, n_theta, n_z), R R' = P
    by_mean: Array  # (n, 7, n_theta): how theta moves the prior's mean of u
    law: Any
    sd: Array  # (n, 7 + n_z)
    best: Array  # (n_touch,), -2 ln posterior

    @classmethod
    def of(
        cls, gripper: GripperModel, data: Touches, row: NDArray[np.int64], whitener: Array, prior: Prior,
        block: NDArray[np.int64], beyond: Array,
    ) -> WithGripper:  # fmt: skip
        """Return the pairs of some touches under hypotheses and the blocks of these."""
        from thermogrip.sysid.effusivity.mode_kernel import Law

        own = np.array([gripper.blocks[gripper.materials[b]].ln_h_sd if b >= 0 else 0.0 for b in block])
        sd = prior.sd.copy()
        # how well the block's mean is known is in the covariance
        sd[:, H] = np.sqrt(np.maximum(sd[:, H] ** 2 - own**2, 1e-12))
        kinds, kind = np.unique(block, return_inverse=True)
        roots = _roots(np.stack([_covariance(gripper, b) for b in kinds.tolist()]))
        n, n_z = row.size, roots.shape[2]
        dof = np.full(sd.shape, np.inf) if prior.dof is None else prior.dof
        rest = np.zeros((n, n_z))
        law = Law.of(
            np.concatenate([prior.mean, rest], axis=1), np.concatenate([sd, rest + 1.0], axis=1),
            np.concatenate([dof, rest + np.inf], axis=1),
        )  # fmt: skip
        return cls(
            data, nodes_for(data), whitener, row, np.array(np.broadcast_to(beyond, (n, 2, data.y.shape[1]))),
            stack_numbers(gripper.stack), roots[kind], _mean_slopes(data)[row], law,
            np.concatenate([sd, rest + 1.0], axis=1), np.full(data.level.size, np.inf),
        )  # fmt: skip

    def nothing_found(self) -> Any:
        """Return what :meth:`settle` fills."""
        from thermogrip.sysid.effusivity.mode_kernel import Found

        n, m = self.sd.shape
        return Found(
            np.zeros((n, m)), np.zeros((n, m + 1, m + 1)), np.full(n, np.inf), np.zeros(n, dtype=bool)
        )

    def settle(self, found: Any, v: Array, at: NDArray[np.int64], beside: NDArray[np.int64] | None) -> None:
        """Search the modes of some pairs, from ``v`` (n, 7) and the guess, or from where the search of those
        ``beside`` ended, where that is better."""
        from thermogrip.sysid.effusivity.mode_kernel import search

        begin = np.zeros((at.size, self.sd.shape[1]))
        begin[:, :N_NUISANCE] = v[at]
        if beside is not None:
            there = begin.copy()
            there[:, :N_NUISANCE] = found.u[beside, :N_NUISANCE]
            there[:, :N_NUISANCE] += (self.law.mean[at] - self.law.mean[beside])[:, :N_NUISANCE]
            there[:, N_NUISANCE:] = self.moved_alike(found.u[beside, N_NUISANCE:], beside, at)
            better = self.costs(at, there) < self.costs(at, begin)
            begin[better] = there[better]
        for whole, part in zip(
            found, search(_Some.of(self, at), self.law.take(at), self.sd[at], begin, _STEPS, least=_STILL)
        ):
            whole[at] = part
        np.minimum.at(self.best, self.row[at], found.cost[at])

    def moved_alike(self, z: Array, of: NDArray[np.int64], at: NDArray[np.int64]) -> Array:
        """Return the z of pairs ``at`` for grippers that pairs ``of`` found, through a, theta = t0 + P a."""
        a = np.linalg.pinv(self.root[of].transpose(0, 2, 1), rcond=1e-6) @ z[:, :, None]
        return np.asarray((self.root[at].transpose(0, 2, 1) @ a)[:, :, 0])

    def costs(self, at: NDArray[np.int64], x: Array) -> Array:
        """Return -2 ln posterior of points (n, 7 + n_z), infinite where there can be no such gripper."""
        columns, able = self.columns(at, x, slopes=False)
        white = self.whitener[self.row[at]] @ columns
        cost = (white[:, :, -1] ** 2).sum(axis=1) + self.law.take(at).penalty(x).value
        return np.asarray(np.where(able, cost, np.inf))

    def products(self, at: NDArray[np.int64], x: Array) -> Array:
        """Return J' J, and J' r and r' r in the last row and column, in units of the prior's sd."""
        columns, able = self.columns(at, x, slopes=True)
        white = self.whitener[self.row[at]] @ columns
        matrix = np.matmul(white.transpose(0, 2, 1), white)
        scale = np.ones((at.size, matrix.shape[1]))
        scale[:, :-1] = self.sd[at]
        matrix *= scale[:, :, None]
        matrix *= scale[:, None, :]
        matrix[~able, -1, -1] = np.inf
        return np.asarray(matrix)

    def columns(self, at: NDArray[np.int64], x: Array, *, slopes: bool) -> tuple[Array, Mask]:
        """Return derivatives of the bin means by v and z, and what is left, (n, n_bin, 7 + n_z + 1), and
        where there can be such a gripper; where no slopes are asked for, what is left alone."""
        from thermogrip.sysid.contact.time_stepping import grippers
        from thermogrip.sysid.effusivity.mode_kernel import Asked, readings

        data, row, n, by_mean = self.data, self.row[at], at.size, self.by_mean[at]
        moved = (self.root[at] @ x[:, N_NUISANCE:, None])[:, :, 0]
        numbers = self.centre + moved[:, : self.centre.size]
        able = _able(numbers)
        numbers = np.where(able[:, None], numbers, self.centre)
        u = x[:, :N_NUISANCE] + (by_mean @ moved[:, :, None])[:, :, 0]
        k = len(_MOVED) + 1 if slopes else 1
        layers = np.exp(numbers[:, _LAYERS])
        steps = np.eye(len(_LAYERS)) * _DIFFERENCE if slopes else np.empty((0, len(_LAYERS)))
        base, near = nearby_modes(layers, layers[:, None] * np.exp(steps))
        own = np.where(_BY_LOGARITHM, np.exp(numbers[:, _NUMBERS]), numbers[:, _NUMBERS])
        contact = np.empty((n, k, 1 + own.shape[1]))
        contact[:, :, 0], contact[:, :, 1:] = base.resistance[:, None], own[:, None]
        parts = [np.repeat(part[:, None], k, axis=1) for part in base[:3]]
        if slopes:
            m = len(_LAYERS)
            contact[:, :m, 0] = near.resistance.reshape(n, m)
            for j in range(own.shape[1] - 1):
                contact[:, m + j, 1 + j] += _DIFFERENCE * (own[:, j] if _BY_LOGARITHM[j] else 1.0)
            for part, there in zip(parts, near[:3]):
                part[:, :m] = there.reshape(n, m, -1)
        lam, face, sensor = (part.reshape(n * k, -1) for part in parts)
        each = np.repeat(row, k)
        device = grippers(lam, face, sensor, contact.reshape(n * k, -1))
        asked = Asked(self.nodes, device, data, each, np.repeat(self.beyond[at], k, axis=0))
        vary = np.zeros((n * k, N_NUISANCE), dtype=bool)
        vary[k - 1 :: k] = slopes
        y, found = readings(asked, np.repeat(u, k, axis=0), vary)
        own_columns = found[k - 1 :: k].transpose(0, 2, 1)
        if not slopes:
            return own_columns[:, :, -1:], able
        by_u = own_columns[:, :, :N_NUISANCE]
        by_theta = by_u @ by_mean
        y = y.reshape(n, k, -1)
        by_theta[:, :, _MOVED] = ((y[:, :-1] - y[:, -1:]) / _DIFFERENCE).transpose(0, 2, 1)
        away = np.where(np.isfinite(data.t_ambient[row]), data.t_ambient[row] - u[:, LEVEL], 0.0)
        by_theta[:, :, _AT["leak"]] = away[:, None] * data.ramp[row]
        return np.concatenate([by_u, by_theta @ self.root[at], own_columns[:, :, -1:]], axis=2), able

    def mode(self, found: Any, log_det: Array, prior: Prior) -> Mode:
        """Return the modes where a search ended, of u = v + M (theta - t0)."""
        from thermogrip.sysid.effusivity.mode_kernel import curvature

        inverse, log_curved = curvature(found.matrix, self.law.penalty(found.u).own)
        turn = self.by_mean @ self.root
        u = found.u[:, :N_NUISANCE] + (turn @ found.u[:, N_NUISANCE:, None])[:, :, 0]
        whole = np.concatenate([np.broadcast_to(np.eye(N_NUISANCE), (len(u), 7, 7)), turn], axis=2)
        whole = whole * self.sd[:, None, :]
        covariance = whole @ inverse @ whole.transpose(0, 2, 1)
        dof = np.full(u.shape, np.inf) if prior.dof is None else prior.dof
        evidence = -0.5 * (found.cost + log_curved + log_det[self.row]) + peak_ratio(dof, prior.sd > 0)
        return Mode(u, covariance, evidence, found.settled, found.matrix[:, -1, -1])


class _Some(NamedTuple):
    """Some of the pairs, of which a search asks in turn some."""

    whole: WithGripper
    at: NDArray[np.int64]
    before: Array  # (_PACE, n), -2 ln posterior at the last steps

    @classmethod
    def of(cls, whole: WithGripper, at: NDArray[np.int64]) -> _Some:
        """Return some of the pairs, before any step."""
        return cls(whole, at, np.full((_PACE, at.size), np.inf))

    def products(self, at: NDArray[np.int64], u: Array, *, first: bool) -> Array:
        """Return the products of some pairs."""
        every = self.at[at]
        parts = range(0, at.size, _AT_ONCE)
        found = [self.whole.products(every[i : i + _AT_ONCE], u[i : i + _AT_ONCE]) for i in parts]
        return np.concatenate(found)

    def longest(self, at: NDArray[np.int64], move: Array) -> Array:
        """Return by how much steps move the logarithms among the unknowns at most, (n,)."""
        far = np.concatenate([move[:, _LOGARITHMS], move[:, N_NUISANCE:] / _FARTHER], axis=1)
        return np.asarray(np.abs(far).max(axis=1))

    def hopeful(self, step: int, at: NDArray[np.int64], cost: Array, decrease: Array) -> Mask | None:
        """Return which are worth another step; far from the guess, the first ones say little about where they
        end."""
        gain = self.before[step % _PACE, at] - cost
        self.before[step % _PACE, at] = cost
        if step < _EARLIEST:
            return None
        behind = cost - decrease - self.whole.best[self.whole.row[self.at[at]]]
        return np.asarray((behind < 2 * _HOPELESS) | (gain > behind))

    def slack(self, at: NDArray[np.int64]) -> float:
        """Return how many times the least decrease a last step may gain."""
        return 1.0


def _able(numbers: Array) -> Mask:
    """Return which numbers (n, n_number) are those of a stack."""
    able = np.isfinite(numbers).all(axis=1) & (np.abs(numbers) < 60.0).all(axis=1)
    return np.asarray(able & (numbers[:, _AT["ln_first"]] <= 0.0) & (numbers[:, _AT["creep"]] >= -0.2))


def _roots(covariance: Array) -> Array:
    """Return R (k, n, m) with R R' = ``covariance`` (k, n, n), m the most directions of any that vary."""
    size, vectors = np.linalg.eigh(covariance)
    n = int((size > 1e-12 * size.max(axis=1, keepdims=True)).sum(axis=1).max())
    n = max(n, 1)
    return np.asarray((vectors * np.sqrt(np.maximum(size, 0.0))[:, None, :])[:, :, -n:])


def _covariance(gripper: GripperModel, block: int) -> Array:
    """Return P of the shared numbers and of the block's ln h and ln e, (n_theta, n_theta)."""
    assert gripper.uncertainty is not None
    names, full = gripper.uncertainty.names, gripper.uncertainty.covariance
    pick = np.zeros((len(_AT), len(names)))
    for name in SHARED_NAMES:
        pick[_AT[name], names.index(name)] = 1.0
    if block >= 0:
        label = gripper.materials[block]
        pick[_AT["ln_h"], names.index(f"ln_h {label}")] = 1.0
        pick[_AT["ln_e"], names.index(f"ln_e {label}")] = 1.0
        return np.asarray(pick @ full @ pick.T)
    ln_h = [i for i, name in enumerate(names) if name.startswith("ln_h ")]
    ln_e = [i for i, name in enumerate(names) if name.startswith("ln_e ")]
    pick[_AT["ln_h"], ln_h] = 1 / len(ln_h)
    cross = pick @ full[:, ln_e]
    # what lies within rounding of zero is known exactly
    known = np.linalg.pinv(full[np.ix_(ln_e, ln_e)], rcond=1e-10, hermitian=True)
    return np.asarray(pick @ full @ pick.T - cross @ known @ cross.T)


def _mean_slopes(data: Touches) -> Array:
    """Return the derivatives of the prior means of u by theta, (n, 7, n_theta)."""
    known = np.isfinite(data.t_object)
    out = np.zeros((known.size, N_NUISANCE, len(_AT)))
    for k, name in ((BUILD_UP, "ln_build_up"), (ONSET, "onset"), (CAPACITY, "ln_depth"), (H, "ln_h")):
        out[:, k, _AT[name]] = 1.0
    out[:, EFFUSIVITY, _AT["ln_e"]] = 1.0
    out[known, T_OBJECT, _AT["bias"]] = 1.0
    out[known, T_OBJECT, _AT["transit_loss"]] = np.nan_to_num(data.t_ambient - data.t_object)[known]
    return out


class Hypotheses(NamedTuple):
    """``n`` hypotheses: mean and sd of ln h, of ln e and of ln(rho c_p), (n,) each."""

    ln_h: Array
    ln_h_sd: Array
    ln_e: Array
    ln_e_sd: Array
    ln_rho_c: Array
    ln_rho_c_sd: Array
    ln_h_dof: Array  # degrees of freedom behind the spread of ln h
    ln_e_dof: Array  # and of ln e
    block: Array  # place in ``gripper.materials`` of a block that was calibrated, -1 for others


def material_hypotheses(
    gripper: GripperModel, candidates: Sequence[str | Material], finish: str = "known"
) -> Hypotheses:
    """Return one hypothesis a candidate, in their order."""
    if finish not in ("known", "unknown"):
        raise UserError(f"finish {finish!r} is unknown", hint="use 'known' or 'unknown'")
    names = [c if isinstance(c, str) else c.name for c in candidates]
    if not names:
        raise UserError("no candidate materials", hint="name at least one")
    for name in names:
        if names.count(name) > 1:
            raise UserError(f"candidate {name!r} is named twice", hint="name each once")
    rows = [
        _trained(gripper, name, finish)
        if name in gripper.blocks
        else _untrained(gripper, candidate if isinstance(candidate, Material) else find_material(name))
        for name, candidate in zip(names, candidates)
    ]
    return Hypotheses(*np.array(rows).T)


def free_hypotheses(gripper: GripperModel, ln_e: ArrayLike) -> Hypotheses:
    """Return one hypothesis for each effusivity ln e on the gripper's own scale, h_c unknown."""
    x = np.asarray(ln_e, dtype=float).ravel()
    metal = 1 / (1 + np.exp(-4 * (x - np.log(4500.0))))
    spread = np.full(x.size, gripper.spreads.ln_h_of_blocks)
    return Hypotheses(
        ln_h=gripper.expected_ln_h(x), ln_h_sd=np.hypot(spread, gripper.spreads.ln_h), ln_e=x,
        ln_e_sd=np.zeros(x.size), ln_rho_c=np.log(1.7e6) + metal * np.log(3.2e6 / 1.7e6),
        ln_rho_c_sd=0.4 - 0.2 * metal, ln_h_dof=np.full(x.size, np.inf), ln_e_dof=np.full(x.size, np.inf),
        block=np.full(x.size, -1.0),
    )  # fmt: skip


def prior_of(gripper: GripperModel, data: Touches, hypotheses: Hypotheses) -> Prior:
    """Return the prior of each (touch, hypothesis) pair, row by row; both have n rows."""
    n = data.level.size
    mean, sd = np.empty((n, N_NUISANCE)), np.empty((n, N_NUISANCE))
    dof = np.full((n, N_NUISANCE), np.inf)
    spreads = gripper.spreads
    dof[:, H], dof[:, EFFUSIVITY] = hypotheses.ln_h_dof, hypotheses.ln_e_dof
    dof[:, BUILD_UP] = dof[:, ONSET] = spreads.dof
    mean[:, H], sd[:, H] = hypotheses.ln_h, hypotheses.ln_h_sd
    mean[:, BUILD_UP], sd[:, BUILD_UP] = np.log(gripper.stack.build_up), spreads.ln_build_up
    mean[:, ONSET], sd[:, ONSET] = gripper.onset, spreads.onset
    if (own_blocks := gripper.discrepancy_of(hypotheses.ln_e)) is not None:
        mean[:, ONSET] += own_blocks.onset
    mean[:, LEVEL], sd[:, LEVEL] = data.level, LEVEL_SD
    known = np.isfinite(data.t_object)
    lost = gripper.transit_loss * np.nan_to_num(data.t_ambient - data.t_object)
    room = np.where(np.isfinite(data.t_ambient), data.t_ambient, data.level)
    mean[:, T_OBJECT] = np.where(known, data.t_object + gripper.bias + lost, room)
    # normal, so that it can be integrated exactly: with the variance of Student's t, which has none at two
    # degrees of freedom, of one training grasp a material: then the nominal one counts little
    beyond = max(spreads.dof - 2, 1e-9)
    learnt = min(spreads.t_object * np.sqrt(spreads.dof / beyond), UNKNOWN_OBJECT_SD)
    own = np.where(np.isfinite(data.t_object_sd), data.t_object_sd, learnt)
    if not gripper.uncertain:  # else it is integrated with all the rest
        own = np.hypot(own, gripper.nominal_sd(data.t_ambient - data.t_object))
    sd[:, T_OBJECT] = np.where(known, own, UNKNOWN_OBJECT_SD)
    mean[:, EFFUSIVITY], sd[:, EFFUSIVITY] = hypotheses.ln_e, hypotheses.ln_e_sd
    mean[:, CAPACITY] = hypotheses.ln_rho_c + np.log(gripper.block_length * gripper.depth_share)
    sd[:, CAPACITY] = hypotheses.ln_rho_c_sd
    if data.unlike.any():
        for k in (H, BUILD_UP, CAPACITY):
            sd[:, k] = np.hypot(sd[:, k], data.unlike)
        sd[:, ONSET] = np.hypot(sd[:, ONSET], _UNLIKE_ONSET * data.unlike)
        away = np.abs(mean[:, T_OBJECT] - data.level)
        sd[:, T_OBJECT] = np.hypot(sd[:, T_OBJECT], _UNLIKE_OBJECT * data.unlike * away)
    return Prior(mean, sd, dof)


def fit_pairs(
    gripper: GripperModel, data: Touches, row: NDArray[np.int64], hypotheses: Hypotheses, *,
    start: Array | None = None, max_steps: int = 20, noise: Whitened | None = None,
    prior: Prior | None = None, rivals: bool = False, rough: float = 0.0,
) -> Mode:  # fmt: skip
    """Return the modes of pairs, hypothesis i against touch ``row[i]``, integrated over an uncertain
    gripper's parameters, a second sensor used; ``noise`` and ``prior`` are
    :func:`~thermogrip.sysid.effusivity.data.whiten` and :func:`prior_of` where a caller has them."""
    prior = prior_of(gripper, data.known(row), hypotheses) if prior is None else prior
    # what else counts may bring another one up
    rivals = rivals and gripper.discrepancy is None and (gripper.second is None or data.second is None)
    mode = _own_modes(gripper, data, row, hypotheses, prior, start, max_steps, noise, rivals, rough)
    mode = with_second(gripper, data, row, hypotheses, prior, mode)
    n = (data.count[row] > 0).sum(axis=1)
    if gripper.second is not None and data.second is not None:
        n = n + (data.second.count[row] > 0).sum(axis=1)
    if gripper.discrepancy is not None:
        mode = widened(mode, prior, n, gripper.bias)
        if gripper.discrepancy.from_room.size:
            unknown = ~np.isfinite(data.t_object[row])
            mode = as_in_training(mode, prior, gripper.discrepancy.from_room, unknown)
    return mode


def with_second(
    gripper: GripperModel, data: Touches, row: NDArray[np.int64], hypotheses: Hypotheses, prior: Prior,
    mode: Mode,
) -> Mode:  # fmt: skip
    """Return the modes of pairs by the first sensor with what the second one saw, if there is one."""
    second = gripper.second
    if second is None or data.second is None:
        return mode
    beside, own = second_modes(gripper, data, row, hypotheses, mode)
    return joined_modes(mode, prior, beside, own, second.bias - gripper.bias)


def second_modes(
    gripper: GripperModel, data: Touches, row: NDArray[np.int64], hypotheses: Hypotheses, mode: Mode
) -> tuple[Mode, Prior]:
    """Return the modes of pairs by the second sensor alone, and its prior; ``mode`` is the first one's."""
    assert gripper.second is not None
    assert data.second is not None
    second, others = gripper.second, hypotheses_of_second(gripper, gripper.second, hypotheses)
    own = prior_of(second, data.second.known(row), others)
    begin = own.mean.copy()
    begin[:, LEVEL], begin[:, T_OBJECT] = data.second.level[row], mode.u[:, T_OBJECT]
    return _own_modes(second, data.second, row, others, own, begin, 20, None), own


def whitened(gripper: GripperModel, data: Touches) -> Whitened:
    """Return what whitens the first sensor's noise as :func:`fit_pairs` takes it."""
    return whiten(data, gripper.noise)


def _own_modes(
    gripper: GripperModel, data: Touches, row: NDArray[np.int64], hypotheses: Hypotheses, prior: Prior,
    start: Array | None, max_steps: int, noise: Whitened | None, rivals: bool = False, rough: float = 0.0,
) -> Mode:  # fmt: skip
    """Return the modes of pairs by the first sensor alone."""
    noise = whitened(gripper, data) if noise is None else noise
    if gripper.uncertain:
        block = hypotheses.block.astype(np.int64)
        return uncertain_gripper_modes(
            gripper, data, row, noise, prior, block, start=start, max_steps=max_steps
        )
    beyond = None if gripper.discrepancy is None else gripper.beyond(data.t[row], prior.mean[:, EFFUSIVITY])
    return find_modes(
        gripper.stack, data, row, noise, prior, start=start, max_steps=max_steps, beyond=beyond,
        rivals=rivals, rough=rough,
    )  # fmt: skip


def hypotheses_of_second(gripper: GripperModel, second: GripperModel, one: Hypotheses) -> Hypotheses:
    """Return the hypotheses as they stand for the second sensor, on its own scale of effusivities."""
    ln_e = second.found_effusivity(one.ln_e - gripper.effusivity_scale(one.ln_e)[0])
    spread = np.full(ln_e.size, np.hypot(second.spreads.ln_h_of_blocks, second.spreads.ln_h))
    other = [second.expected_ln_h(ln_e), spread, ln_e, *one[3:8], np.full(ln_e.size, -1.0)]
    for i, block in enumerate(one.block.astype(int)):
        name = gripper.materials[block] if block >= 0 else ""
        if name in second.blocks:
            known = "known" if np.isfinite(one.ln_h_dof[i]) else "unknown"
            for column, value in zip(other, _trained(second, name, known)):
                column[i] = value
    return Hypotheses(*other)


def joined_modes(first: Mode, prior: Prior, second: Mode, own: Prior, apart: float) -> Mode:
    r"""Return the modes of one object that two sensors touched, with its temperature x common to both: what
    the second saw of x is its posterior over its prior, a normal likelihood of precision :math:`1/V_2 -
    1/V_{02}`, its thermometer ``apart`` [K] above the first one's, give or take 0.3 K; all else is each
    sensor's own."""
    seen, width = _seen_temperature(second, own)
    off = seen - apart - first.u[:, T_OBJECT]
    variance = first.covariance[:, T_OBJECT, T_OBJECT] + width + SENSORS_APART**2
    evidence = first.log_evidence + second.log_evidence + _log_normal(off, variance)
    evidence -= _log_normal(seen - own.mean[:, T_OBJECT], own.sd[:, T_OBJECT] ** 2 + width)
    settled, misfit = first.converged & second.converged, first.misfit + second.misfit
    column = first.covariance[:, :, T_OBJECT]
    moved = first.covariance - column[:, :, None] * (column / variance[:, None])[:, None, :]
    return Mode(first.u + (off / variance)[:, None] * column, moved, evidence, settled, misfit)


def at_temperature(mode: Mode, prior: Prior, mean: Array, variance: Array) -> Mode:
    """Return the modes of pairs under another prior of the object's temperature, N(mean, variance), (n,)
    each."""
    seen, width = _seen_temperature(mode, prior)
    own = prior.sd[:, T_OBJECT] ** 2
    evidence = mode.log_evidence + _log_normal(seen - mean, variance + width)
    evidence -= _log_normal(seen - prior.mean[:, T_OBJECT], own + width)
    before = mode.covariance[:, T_OBJECT, T_OBJECT]
    after = variance * width / (variance + width)
    column = mode.covariance[:, :, T_OBJECT] / before[:, None]
    moved = (mean * width + seen * variance) / (variance + width) - mode.u[:, T_OBJECT]
    covariance = mode.covariance + (after - before)[:, None, None] * column[:, :, None] * column[:, None, :]
    return mode._replace(
        u=mode.u + moved[:, None] * column, covariance=covariance, log_evidence=np.asarray(evidence)
    )


def temperatures_by_the_other(
    first: Mode, prior: Prior, second: Mode, own: Prior, apart: float
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return mean and variance of the object's temperature as each of two sensors' thermometers shows it, by
    its prior and what the other sensor saw: arguments as of :func:`joined_modes`."""
    x0, v0 = prior.mean[:, T_OBJECT], prior.sd[:, T_OBJECT] ** 2
    (seen, width), (other, other_width) = _seen_temperature(first, prior), _seen_temperature(second, own)
    other_width = other_width + SENSORS_APART**2
    by_second = (x0 * other_width + (other - apart) * v0) / (v0 + other_width)
    by_first = (x0 * width + seen * v0) / (v0 + width)
    return (
        (by_second, v0 * other_width / (v0 + other_width)),
        (by_first + apart, v0 * width / (v0 + width) + SENSORS_APART**2),
    )


def widened(mode: Mode, prior: Prior, n: NDArray[np.int64], bias: float) -> Mode:
    r"""Return what a gripper with a discrepancy knows: less than its model says, least where that misfits.

    A grasp's noise is larger or smaller than the others' as the discrepancy was: with a variance of inverse
    gamma distribution, :math:`\nu = 20`, the misfit S of ``n`` readings counts
    :math:`(\nu + n) \ln(1 + S / \nu)` in place of S.  All evidence counts half, since what differs from
    grasp to grasp is not the noise that it is taken for.  The object's temperature is known to a tenth of its
    distance from the skin at best, and to the thermometer's own ``bias`` [K], of which the discrepancy may
    have taken a part.
    """
    evidence = mode.log_evidence + 0.5 * (mode.misfit - (_DOF + n) * np.log1p(mode.misfit / _DOF))
    seen, width = _seen_temperature(mode, prior)
    x0, v0 = prior.mean[:, T_OBJECT], prior.sd[:, T_OBJECT] ** 2
    width *= np.maximum(_COUNTS * (_DOF + mode.misfit) / (_DOF + n), 1.0)
    width += (_GAIN_SD * (mode.u[:, T_OBJECT] - mode.u[:, LEVEL])) ** 2 + bias**2
    u, covariance = mode.u.copy(), mode.covariance.copy()
    covariance[:, T_OBJECT, T_OBJECT] = v0 * width / (v0 + width)
    u[:, T_OBJECT] = (x0 * width + seen * v0) / (v0 + width)
    return mode._replace(u=u, covariance=covariance, log_evidence=evidence / _COUNTS)


def as_in_training(mode: Mode, prior: Prior, from_room: Array, unknown: Mask) -> Mode:
    """Return the modes under even odds that an object of unknown temperature is as far from its room as some
    object of the training was, within 1 K, or anywhere in its range."""
    seen, width = _seen_temperature(mode, prior)
    room, v0 = prior.mean[:, T_OBJECT], prior.sd[:, T_OBJECT] ** 2
    off, variance = room[:, None] + from_room - seen[:, None], (width + _ALIKE_SD**2)[:, None]
    ratio = _log_normal(off, variance) - _log_normal(seen - room, v0 + width)[:, None]
    each = np.exp(np.clip(ratio, -700.0, 300.0)) / (2 * from_room.size)
    # where it lies: the range's own answer, or that of an object of the training
    weight = np.column_stack([np.full(seen.size, 0.5), each])
    means = seen[:, None] + (width[:, None] / variance) * off
    means = np.column_stack([mode.u[:, T_OBJECT], means])
    within = (width * _ALIKE_SD**2 / (width + _ALIKE_SD**2))[:, None] * np.ones(each.shape)
    within = np.column_stack([mode.covariance[:, T_OBJECT, T_OBJECT], within])
    total = weight.sum(axis=1)
    mean = (weight * means).sum(axis=1) / total
    spread = (weight * (within + (means - mean[:, None]) ** 2)).sum(axis=1) / total
    u, covariance = mode.u.copy(), mode.covariance.copy()
    u[unknown, T_OBJECT] = mean[unknown]
    covariance[unknown, T_OBJECT, T_OBJECT] = spread[unknown]
    evidence = mode.log_evidence + np.where(unknown, np.log(total), 0.0)
    return mode._replace(u=u, covariance=covariance, log_evidence=evidence)


def slip_of(sd: ArrayLike) -> Array:
    """Return how many times as far off as its ``sd`` [K] a stated temperature that is a slip may be: three,
    no farther than one that nobody stated."""
    return np.clip(UNKNOWN_OBJECT_SD / np.asarray(sd), 1.0, _SLIP)


def doubted(gripper: GripperModel, data: Touches, prior: Prior, mode: Mode) -> Mode:
    """Return the modes of pairs, a row of data each, where the stated temperature of an object may be off by
    more than the training's were: with a probability of 0.05 the sd about it is three times its own."""
    off = gripper.nominal_sd(data.t_ambient - data.t_object) if gripper.uncertain else 0.0
    v0 = prior.sd[:, T_OBJECT] ** 2 + np.square(off)
    x0, v = prior.mean[:, T_OBJECT], mode.covariance[:, T_OBJECT, T_OBJECT]
    # beyond what readings know of it the normal distribution around the mode is no guide
    telling = np.isfinite(data.t_object) & (v < _TELLING * v0) & mode.converged
    precision = np.where(telling, 1 / v - 1 / v0, 1.0)
    seen, width = x0 + (mode.u[:, T_OBJECT] - x0) / (v * precision), 1 / precision
    wide = slip_of(np.sqrt(v0)) ** 2 * v0
    ratio = _log_normal(seen - x0, wide + width) - _log_normal(seen - x0, v0 + width)
    slip = np.where(telling, SLIPS * np.exp(np.clip(ratio, -700.0, 300.0)), 0.0)
    total = np.where(telling, 1 - SLIPS, 1.0) + slip
    share, apart = slip / total, (wide * seen + width * x0) / (wide + width) - mode.u[:, T_OBJECT]
    within = share * (wide * width / (wide + width) - v) + share * (1 - share) * apart**2
    # the rest of what is unknown goes along with the temperature
    column = mode.covariance[:, :, T_OBJECT] / v[:, None]
    u = mode.u + column * (share * apart)[:, None]
    covariance = mode.covariance + within[:, None, None] * column[:, :, None] * column[:, None, :]
    return mode._replace(u=u, covariance=covariance, log_evidence=mode.log_evidence + np.log(total))


def _seen_temperature(mode: Mode, prior: Prior) -> tuple[Array, Array]:
    """Return what the readings alone say of T_obj, the ratio of posterior and prior: mean and variance."""
    x0, v = prior.mean[:, T_OBJECT], mode.covariance[:, T_OBJECT, T_OBJECT]
    precision = np.maximum(1 / v - 1 / prior.sd[:, T_OBJECT] ** 2, 1e-9)
    return x0 + (mode.u[:, T_OBJECT] - x0) / (v * precision), 1 / precision


def _log_normal(x: Array, variance: Array) -> Array:
    return np.asarray(-0.5 * (x**2 / variance + np.log(variance)))


def fit_candidates(
    gripper: GripperModel, data: Touches, candidates: Sequence[str | Material], finish: str = "known", *,
    start: Array | None = None, noise: Whitened | None = None,
) -> tuple[Mode, Prior, NDArray[np.int64]]:  # fmt: skip
    """Return modes of every touch under every candidate, (n m,) rows, from nuisances ``start`` (n, m, 7), and
    the prior and the touch of each.

    Evidence is the sum over the gripper's grades, all else that of the grade which counts most; ``noise`` is
    :func:`whitened` of the graded touches where a caller has it."""
    n, m, n_grade = data.level.size, len(candidates), len(gripper.grades)
    begin = None if start is None else np.repeat(start.reshape(n, m, -1), n_grade, axis=0)
    every = graded(data, gripper.grades)
    mode, prior, _ = candidate_modes(gripper, every, candidates, finish, start=begin, noise=noise)
    each = over_grades(gripper, mode.log_evidence.reshape(n, n_grade, m))
    best = each.argmax(axis=1)
    at = ((np.arange(n)[:, None] * n_grade + best) * m + np.arange(m)).ravel()
    dof = None if prior.dof is None else prior.dof[at]
    mode = Mode(*(part[at] for part in mode))._replace(log_evidence=logsumexp(each, axis=1).ravel())
    return mode, Prior(prior.mean[at], prior.sd[at], dof), np.repeat(np.arange(n), m)


def over_grades(gripper: GripperModel, log_evidence: Array) -> Array:
    """Return evidences (n, n_grade, ...) times the prior probability of each grade, in logarithms."""
    log_prior = np.log([grade.prior for grade in gripper.grades])
    return np.asarray(log_evidence + log_prior.reshape(-1, *[1] * (log_evidence.ndim - 2)))


def candidate_modes(
    gripper: GripperModel, data: Touches, candidates: Sequence[str | Material], finish: str = "known", *,
    start: Array | None = None, noise: Whitened | None = None,
) -> tuple[Mode, Prior, NDArray[np.int64]]:  # fmt: skip
    """Return :func:`fit_candidates` under the grade that each of the touches has."""
    one = material_hypotheses(gripper, candidates, finish)
    n, m = data.level.size, len(candidates)
    row = np.repeat(np.arange(n), m)
    hypotheses = Hypotheses(*(np.tile(h, n) for h in one))
    begin = None if start is None else start.reshape(n * m, -1)
    each = data.known(row)
    prior = prior_of(gripper, each, hypotheses)
    mode = fit_rivals(gripper, data, row, hypotheses, start=begin, noise=noise, prior=prior)
    return doubted(gripper, each, prior, mode), prior, row


def fit_rivals(
    gripper: GripperModel, data: Touches, row: NDArray[np.int64], hypotheses: Hypotheses, *,
    start: Array | None, noise: Whitened | None, prior: Prior, rough: float = 0.0,
) -> Mode:  # fmt: skip
    """Return :func:`fit_pairs` of hypotheses that compete for each touch.

    Where nuisances may be far from usual a density may have several modes (a sheet, or a block in poor
    contact): then each hypothesis is also looked for from where the likeliest of its touch ended."""
    noise = whitened(gripper, data) if noise is None else noise
    mode = fit_pairs(
        gripper, data, row, hypotheses, start=start, noise=noise, prior=prior, rivals=True, rough=rough
    )
    order = np.lexsort((mode.log_evidence, row))
    likeliest = np.empty(data.level.size, dtype=np.int64)
    likeliest[row[order]] = order  # of several the last one stays
    at = np.flatnonzero((data.unlike[row] > 0) & (likeliest[row] != np.arange(row.size)))
    if not at.size:
        return mode
    begin = mode.u[likeliest[row[at]]]
    begin[:, EFFUSIVITY] = mode.u[at, EFFUSIVITY]
    dof = None if prior.dof is None else prior.dof[at]
    again = fit_pairs(
        gripper, data, row[at], Hypotheses(*(part[at] for part in hypotheses)), start=begin, noise=noise,
        prior=Prior(prior.mean[at], prior.sd[at], dof), rivals=True, rough=rough,
    )  # fmt: skip
    better = again.log_evidence > mode.log_evidence[at]
    for whole, part in zip(mode, again):
        whole[at[better]] = part[better]
    return mode


def _trained(gripper: GripperModel, name: str, finish: str) -> tuple[float, ...]:
    block, spreads, own = gripper.blocks[name], gripper.spreads, finish == "known"
    between = max(_FINISH_SD, spreads.ln_h_of_blocks)
    spread = spreads.ln_h if own else float(np.hypot(between, spreads.ln_h))
    scatter = spreads.ln_effusivity if block.library_effusivity < INSULATOR else 0.0
    composition = 0.0 if own else float(np.hypot(_GRADE_SD, min(block.library_sd_ln, 0.3)))
    return (
        block.ln_h,
        float(np.hypot(spread, block.ln_h_sd)),
        block.ln_effusivity,
        float(np.hypot(scatter, composition)),
        float(np.log(block.heat_capacity)),
        0.0,
        spreads.dof if own else np.inf,
        spreads.insulator_dof if scatter and own else np.inf,
        float(gripper.materials.index(name)),
    )


def _untrained(gripper: GripperModel, row: Material) -> tuple[float, ...]:
    found = float(gripper.found_effusivity(np.log([row.effusivity]))[0])
    scale_sd = gripper.effusivity_scale(np.array([found]))[1]
    scatter = gripper.spreads.ln_effusivity if row.effusivity < INSULATOR else 0.0
    return (
        float(gripper.expected_ln_h(np.array(found))),
        float(np.hypot(gripper.spreads.ln_h_of_blocks, gripper.spreads.ln_h)),
        float(found),
        float(np.sqrt(row.effusivity_sd_ln**2 + float(scale_sd[0]) ** 2 + scatter**2)),
        float(np.log(row.rho * row.c_p)),
        0.05,
        np.inf,
        np.inf,
        -1.0,
    )
