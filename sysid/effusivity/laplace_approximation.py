"""Evidence of a hypothesis about one grasp: Gauss-Newton to the mode, Laplace's method around it.

A hypothesis (a material, or an effusivity) fixes a Gaussian prior over the seven nuisances of a grasp,

    u = (ln h, ln tau_b, t0, b, T_obj, ln e, ln C),

and predicts the bin means f(u).  With the whitener W of the noise and u = mean + sd w the objective is
``|W (y - f)|^2 + |w|^2``, its Gauss-Newton matrix A = I + J' J.  A nuisance with sd 0 is known.  Every
function works on a batch of (grasp, hypothesis) pairs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaln

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.errors import UserError
from thermogrip.sysid.contact.materials import Material, find_material
from thermogrip.sysid.contact.simulation import Stack, TimeNodes, gripper_modes, time_nodes
from thermogrip.sysid.effusivity.data import (
    UNKNOWN_OBJECT_SD,
    Touches,
    Whitened,
    graded,
    room_temperature,
    whiten,
)
from thermogrip.sysid.effusivity.gripper_model import (
    INSULATOR,
    LEVEL_SD,
    NOISE_TIMES,
    SHARED_NAMES,
    STACK_NAMES,
    GripperModel,
    block_names,
    stack_numbers,
    stack_of,
)

H, BUILD_UP, ONSET, LEVEL, T_OBJECT, EFFUSIVITY, CAPACITY = range(7)
N_NUISANCE = 7


@dataclass(frozen=True)
class DoubtSettings:
    """How far what was stated, or taught, may be off, and what then counts."""

    earliest_onset_s: float = 1.5  # before the closed message
    # of the size of a grasp's noise beside a learnt discrepancy (ToH: log loss .32 with it, .57 as
    # stated)
    noise_dof: float = 20.0
    # beside a learnt discrepancy an object's distance from the skin is known to this share
    gain_sd: float = 0.1
    # an object that is less well known is one of a range of temperatures, 5 K or more
    stated_sd_K: float = 1.5
    # where logarithms of the rest are one off: a message that is late by a third of a second
    unlike_onset_s: float = 0.3
    # of an object's distance from the skin there: one that has gone a fifth of its way
    unlike_object_share: float = 0.2


DOUBT = DoubtSettings()

SENSORS_APART = 0.3  # K: two thermistors of 1 %
UNEXPLAINED = 4.0  # standard deviations of the misfit; the example rig's grasps have 2.3 at most


class Prior(NamedTuple):
    """Mean and sd of u, (n_pair, 7) each; where ``dof`` (n_pair, 7) is given and finite, Student's t with so
    many degrees of freedom and scale ``sd``: a spread estimated from few grasps is itself uncertain."""

    mean: Array
    sd: Array
    dof: Array | None = None

    def take(self, index: Any) -> Prior:
        """Return some of the rows."""
        return Prior(self.mean[index], self.sd[index], None if self.dof is None else self.dof[index])


class Mode(NamedTuple):
    """Where Gauss-Newton ended, a row a pair."""

    u: Array  # (n, 7)
    covariance: Array  # (n, 7, 7), of u
    log_evidence: Array  # (n,)
    converged: Mask  # (n,)
    misfit: Array  # (n,), |W (y - f)|^2

    def take(self, index: Any) -> Mode:
        """Return some of the rows."""
        fields: Any = (field[index] for field in self)
        return Mode(*fields)


def nodes_for(data: Touches) -> TimeNodes:
    """Return the time nodes that reach the last sample of an early contact."""
    return time_nodes(data.end + DOUBT.earliest_onset_s)


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
    from thermogrip.sysid.effusivity.mode_kernel import Pairs

    shape = (row.size, 2, data.y.shape[1])
    # a copy in C order: for other kinds of arrays kernels are compiled anew
    nothing = np.zeros(shape) if beyond is None else np.array(np.broadcast_to(beyond, shape), order="C")
    return Pairs(nodes, gripper_modes(stack), data, row, nothing)


def stack_slopes(theta: Array, data: Touches, u: Array, beyond: Array | None = None) -> Array:
    """Return the derivatives of what nuisances u (n, 7) predict of n touches by the numbers of a stack that
    begin ``theta``, (n, n_bin, n_number), without its build-up time."""
    nodes, names = nodes_for(data), STACK_NAMES[: STACK_NAMES.index("ln_build_up")]
    y = predict(stack_of(theta), nodes, data, u, beyond)
    slopes = np.empty((*y.shape, len(names)))
    for i, name in enumerate(names):
        if name == "leak":
            away = np.nan_to_num(data.t_ambient - u[:, LEVEL])
            slopes[:, :, i] = away[:, None] * data.ramp * (data.count > 0)
            continue
        moved = theta.copy()
        moved[i] += 1e-4
        if name == "ln_first" and moved[i] > 0:  # a share is 1 at most: the difference is taken inwards
            moved[i] = theta[i] - 1e-4
        slopes[:, :, i] = (predict(stack_of(moved), nodes, data, u, beyond) - y) / (moved[i] - theta[i])
    return slopes


def shared_slopes(theta: Array, data: Touches, u: Array, by_u: Array, beyond: Array | None = None) -> Array:
    """Return the derivatives of what nuisances u predict of n touches by the numbers that all grasps share,
    which begin ``theta``, (n, n_bin, n_shared); ``by_u`` are those by the nuisances."""
    slopes = np.zeros((*by_u.shape[:2], len(SHARED_NAMES)))
    by_stack = stack_slopes(theta, data, u, beyond)
    slopes[:, :, : by_stack.shape[2]] = by_stack
    is_stated = np.isfinite(data.t_object)
    to_room = np.nan_to_num(data.t_ambient - data.t_object)
    shared = {
        "ln_build_up": by_u[:, :, BUILD_UP],
        "onset": by_u[:, :, ONSET],
        "transit_loss": by_u[:, :, T_OBJECT] * to_room[:, None],
        "bias": by_u[:, :, T_OBJECT] * is_stated[:, None],
        "ln_depth": by_u[:, :, CAPACITY],
    }
    for name, values in shared.items():
        slopes[:, :, SHARED_NAMES.index(name)] = values
    return slopes


def find_modes(
    stack: Stack, data: Touches, row: NDArray[np.int64], whitener: Whitened, prior: Prior, *,
    start: Array | None = None, beyond: Array | None = None, rivals: bool = False,
) -> Mode:  # fmt: skip
    """Return mode, covariance and log evidence of every pair by damped Gauss-Newton.

    Pair p is touch ``row[p]`` under row p of ``prior``; ``whitener`` is what
    :func:`~thermogrip.sysid.effusivity.data.whiten` returns for ``data``.  It starts at the prior's mean with
    the level as measured, or at ``start`` (n_pair, 7); a pair that has not settled within 20 steps is
    hopeless in practice, and where pairs of one question are ``rivals`` one far behind is left early.
    """
    from thermogrip.sysid.effusivity.mode_kernel import Law, curvature, search

    vary = prior.sd > 0
    u = prior.mean.copy() if start is None else np.where(vary, start, prior.mean)
    if start is None:
        u[:, LEVEL] = np.where(vary[:, LEVEL], data.level[row], u[:, LEVEL])
    dof = np.full(u.shape, np.inf) if prior.dof is None else prior.dof
    pairs = pairs_asked(stack, nodes_for(data), data, row, beyond)
    heavy = vary & np.isfinite(dof)
    law = Law(prior.mean, prior.sd, np.where(heavy, 1.0 / dof, 0.0))
    ended = search(pairs, whitener, law, u, rivals=rivals)
    inverse, log_det_curvature = curvature(ended.matrix, ended.own)
    covariance = inverse * (prior.sd[:, :, None] * prior.sd[:, None, :])
    # b and T_obj enter f linearly, so for them this is exact; the others are nearly Gaussian given them
    objective = ended.cost + log_det_curvature
    # a nuisance whose spread was learnt from few grasps has Student's t as its prior: the sum of (nu + 1)
    # ln(1 + w^2 / nu) replaces its w^2, the density's own curvature its 1 in A, and ln Z gains the ratio of
    # the peaks of Student's densities over the normal ones' of the same scale
    nu = np.where(heavy, dof, 1.0)
    ratio = gammaln(0.5 * (nu + 1)) - gammaln(0.5 * nu) - 0.5 * np.log(0.5 * nu)
    # ln Z = -1/2 objective - 1/2 ln det A - 1/2 ln det(2 pi C)
    evidence = -0.5 * (objective + whitener[1][row]) + np.where(heavy, ratio, 0.0).sum(axis=1)
    return Mode(ended.u, covariance, evidence, ended.settled, ended.matrix[:, -1, -1])


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


def material_hypotheses(gripper: GripperModel, candidates: Sequence[str | Material]) -> Hypotheses:
    """Return one hypothesis a candidate, in their order."""
    names = [c if isinstance(c, str) else c.name for c in candidates]
    if not names:
        raise UserError("no candidate materials", hint="name at least one")
    for name in names:
        if names.count(name) > 1:
            raise UserError(f"candidate {name!r} is named twice", hint="name each once")
    rows = [
        _trained(gripper, name)
        if name in gripper.blocks
        else _untrained(gripper, candidate if isinstance(candidate, Material) else find_material(name))
        for name, candidate in zip(names, candidates)
    ]
    return Hypotheses(*(np.array([row[name] for row in rows]) for name in Hypotheses._fields))


def free_hypotheses(gripper: GripperModel, ln_e: ArrayLike) -> Hypotheses:
    """Return one hypothesis for each effusivity ln e on the gripper's own scale, h_c unknown."""
    # rho c_p of solids in general: 3.2 MJ/m3K for metals, 1.7 for insulators
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
    # What comes from the gripper and the nominal temperature (build-up time, onset, object temperature) is
    # common to all hypotheses.
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
    is_stated = np.isfinite(data.t_object)
    lost = gripper.transit_loss * np.nan_to_num(data.t_ambient - data.t_object)
    room = room_temperature(data.t_ambient)
    mean[:, T_OBJECT] = np.where(is_stated, data.t_object + gripper.bias + lost, room)
    # normal, so that it can be integrated exactly: with the variance of Student's t, which has none at two
    # degrees of freedom, of one training grasp a material: then the nominal one counts little
    beyond = max(spreads.dof - 2, 1e-9)
    learnt = min(spreads.t_object * np.sqrt(spreads.dof / beyond), UNKNOWN_OBJECT_SD)
    stated_sd = np.where(np.isfinite(data.t_object_sd), data.t_object_sd, learnt)
    stated_sd = np.hypot(stated_sd, gripper.nominal_sd(data.t_ambient - data.t_object))
    sd[:, T_OBJECT] = np.where(is_stated, stated_sd, UNKNOWN_OBJECT_SD)
    mean[:, EFFUSIVITY], sd[:, EFFUSIVITY] = hypotheses.ln_e, hypotheses.ln_e_sd
    mean[:, CAPACITY] = hypotheses.ln_rho_c + np.log(gripper.block_length * gripper.depth_share)
    sd[:, CAPACITY] = np.hypot(hypotheses.ln_rho_c_sd, data.thin)
    if data.unlike.any():
        for k in (H, BUILD_UP, CAPACITY):
            sd[:, k] = np.hypot(sd[:, k], data.unlike)
        sd[:, ONSET] = np.hypot(sd[:, ONSET], DOUBT.unlike_onset_s * data.unlike)
        away = np.abs(mean[:, T_OBJECT] - data.level)
        sd[:, T_OBJECT] = np.hypot(sd[:, T_OBJECT], DOUBT.unlike_object_share * data.unlike * away)
    return Prior(mean, sd, dof)


def fit_pairs(
    gripper: GripperModel, data: Touches, row: NDArray[np.int64], hypotheses: Hypotheses, *,
    start: Array | None = None, noise: Whitened | None = None,
    prior: Prior | None = None, rivals: bool = False,
) -> Mode:  # fmt: skip
    """Return the modes of pairs, hypothesis i against touch ``row[i]``, a second sensor used; ``noise``
    (:func:`~thermogrip.sysid.effusivity.data.whiten`) and ``prior`` (:func:`prior_of`) where a caller has
    them."""
    prior = prior_of(gripper, data.known(row), hypotheses) if prior is None else prior
    # what else counts may bring another one up
    rivals = rivals and gripper.discrepancy is None and (gripper.second is None or data.second is None)
    mode = _own_modes(gripper, data, row, hypotheses, prior, start, noise, rivals)
    mode = with_second(gripper, data, row, hypotheses, mode)
    n = (data.count[row] > 0).sum(axis=1)
    if gripper.second is not None and data.second is not None:
        n = n + (data.second.count[row] > 0).sum(axis=1)
    if gripper.discrepancy is not None:
        mode = widened(mode, prior, n, gripper.bias)
    return mode


def with_second(
    gripper: GripperModel, data: Touches, row: NDArray[np.int64], hypotheses: Hypotheses, mode: Mode
) -> Mode:
    """Return the modes of pairs by the first sensor with what the second one saw, if there is one."""
    second = gripper.second
    if second is None or data.second is None:
        return mode
    beside, second_prior = second_modes(gripper, data, row, hypotheses, mode)
    return joined_modes(mode, beside, second_prior, second.bias - gripper.bias)


def second_modes(
    gripper: GripperModel, data: Touches, row: NDArray[np.int64], hypotheses: Hypotheses, mode: Mode
) -> tuple[Mode, Prior]:
    """Return the modes of pairs by the second sensor alone, and its prior; ``mode`` is the first one's."""
    assert gripper.second is not None
    assert data.second is not None
    second, read = gripper.second, data.second
    others = hypotheses_of_second(gripper, second, hypotheses)
    second_prior = prior_of(second, read.known(row), others)
    begin = second_prior.mean.copy()
    begin[:, LEVEL], begin[:, T_OBJECT] = read.level[row], mode.u[:, T_OBJECT]

    def search(some: NDArray[np.int64], start: Array) -> Mode:
        one = Hypotheses(*(field[some] for field in others))
        return _own_modes(second, read, row[some], one, second_prior.take(some), start, None)

    # a passive sensor of an object of unknown temperature has several modes, some 15 K apart
    every = np.arange(row.size)
    return restarted(search(every, begin), row, every >= 0, search), second_prior


def _own_modes(
    gripper: GripperModel, data: Touches, row: NDArray[np.int64], hypotheses: Hypotheses, prior: Prior,
    start: Array | None, noise: Whitened | None, rivals: bool = False,
) -> Mode:  # fmt: skip
    """Return the modes of pairs by the first sensor alone."""
    noise = whiten(data, gripper.reading_noise) if noise is None else noise
    beyond = None if gripper.discrepancy is None else gripper.beyond(data.t[row], prior.mean[:, EFFUSIVITY])
    return find_modes(gripper.stack, data, row, noise, prior, start=start, beyond=beyond, rivals=rivals)


def hypotheses_of_second(gripper: GripperModel, second: GripperModel, one: Hypotheses) -> Hypotheses:
    """Return the hypotheses as they stand for the second sensor, on its own scale of effusivities."""
    ln_e = second.found_effusivity(one.ln_e - gripper.effusivity_scale(one.ln_e)[0])
    spread = np.full(ln_e.size, np.hypot(second.spreads.ln_h_of_blocks, second.spreads.ln_h))
    other = [second.expected_ln_h(ln_e), spread, ln_e, *one[3:8], np.full(ln_e.size, -1.0)]
    for i, block in enumerate(one.block.astype(int)):
        name = gripper.materials[block] if block >= 0 else ""
        if name in second.blocks:
            trained = _trained(second, name)
            for column, number in zip(other, Hypotheses._fields):
                column[i] = trained[number]
    return Hypotheses(*other)


def joined_modes(first: Mode, second: Mode, own: Prior, apart: float) -> Mode:
    r"""Return the modes of one object that two sensors touched, with its temperature x common to both: what
    the second saw of x is its posterior over its prior, a normal likelihood of precision :math:`1/V_2 -
    1/V_{02}`, its thermometer ``apart`` [K] above the first one's, within +-0.3 K; all else is each
    sensor's own."""
    second_mean, width = _seen_temperature(second, own)
    off = second_mean - apart - first.u[:, T_OBJECT]
    variance = first.covariance[:, T_OBJECT, T_OBJECT] + width + SENSORS_APART**2
    evidence = first.log_evidence + second.log_evidence + _log_normal(off, variance)
    evidence -= _log_normal(second_mean - own.mean[:, T_OBJECT], own.sd[:, T_OBJECT] ** 2 + width)
    settled, misfit = first.converged & second.converged, first.misfit + second.misfit
    column = first.covariance[:, :, T_OBJECT]
    moved = first.covariance - column[:, :, None] * (column / variance[:, None])[:, None, :]
    return Mode(first.u + (off / variance)[:, None] * column, moved, evidence, settled, misfit)


def widened(mode: Mode, prior: Prior, n: NDArray[np.int64], bias: float) -> Mode:
    r"""Return what a gripper with a discrepancy knows: less than its model says, least where that misfits.

    A grasp's noise is larger or smaller than the others' as the discrepancy was: with a variance of inverse
    gamma distribution, :math:`\nu = 20`, the misfit S of ``n`` readings counts
    :math:`(\nu + n) \ln(1 + S / \nu)` in place of S.  The object's temperature is known to a tenth of its
    distance from the skin at best, and to the thermometer's own ``bias`` [K], of which the discrepancy may
    have taken a part.
    """
    counts = NOISE_TIMES**2  # readings were whitened by so much more variance, S is theirs without it
    misfit = counts * mode.misfit
    evidence = mode.log_evidence + 0.5 / counts * (
        misfit - (DOUBT.noise_dof + n) * np.log1p(misfit / DOUBT.noise_dof)
    )
    measured, width = _seen_temperature(mode, prior)
    x0, v0 = prior.mean[:, T_OBJECT], prior.sd[:, T_OBJECT] ** 2
    width *= np.maximum((DOUBT.noise_dof + misfit) / (DOUBT.noise_dof + n), 1 / counts)
    width += (DOUBT.gain_sd * (mode.u[:, T_OBJECT] - mode.u[:, LEVEL])) ** 2 + bias**2
    u, covariance = mode.u.copy(), mode.covariance.copy()
    covariance[:, T_OBJECT, T_OBJECT] = v0 * width / (v0 + width)
    u[:, T_OBJECT] = (x0 * width + measured * v0) / (v0 + width)
    return mode._replace(u=u, covariance=covariance, log_evidence=evidence, misfit=misfit)


def _seen_temperature(mode: Mode, prior: Prior) -> tuple[Array, Array]:
    """Return what the readings alone say of T_obj, the ratio of posterior and prior: mean and variance."""
    x0, v = prior.mean[:, T_OBJECT], mode.covariance[:, T_OBJECT, T_OBJECT]
    precision = np.maximum(1 / v - 1 / prior.sd[:, T_OBJECT] ** 2, 1e-9)
    return x0 + (mode.u[:, T_OBJECT] - x0) / (v * precision), 1 / precision


def _log_normal(x: Array, variance: Array) -> Array:
    return np.asarray(-0.5 * (x**2 / variance + np.log(variance)))


class Fitted(NamedTuple):
    """Modes of n touches under m candidates, (n m,) rows."""

    mode: Mode  # of the grade that counts most, with the evidence of all
    row: NDArray[np.int64]  # (n m,), the touch of each
    plain: Mode  # as grasps like those of the training
    plain_prior: Prior
    unlike: Array  # (n,), probability that a touch is unlike those
    sure: Array  # (n, m), evidence were the calibration exact, as it counts beside a free effusivity


def fit_candidates(
    gripper: GripperModel,
    data: Touches,
    candidates: Sequence[str | Material],
    *,
    start: Array | None = None,
    noise: Whitened | None = None,
) -> Fitted:
    """Return the modes of every touch under every candidate, from nuisances ``start`` (n, m, 7), and evidence
    that is the sum over the gripper's grades; ``noise`` whitens the graded touches, where a caller has it."""
    n = data.level.size
    m = len(candidates)
    n_grade = len(gripper.grades)
    one, every = material_hypotheses(gripper, candidates), graded(data, gripper.grades)
    row = np.repeat(np.arange(n * n_grade), m)
    hypotheses = Hypotheses(*(np.tile(field, n * n_grade) for field in one))
    begin = None
    if start is not None:
        begin = np.repeat(start.reshape(n, m, -1), n_grade, axis=0).reshape(row.size, -1)
    prior = prior_of(gripper, every.known(row), hypotheses)
    mode = fit_rivals(gripper, every, row, hypotheses, start=begin, noise=noise, prior=prior)
    place, candidate = np.arange(n)[:, None] * n_grade, np.arange(m)
    first = (place * m + candidate).ravel()
    sure = np.logaddexp.reduce(over_grades(gripper, mode.log_evidence.reshape(n, n_grade, m)), axis=1)
    if gripper.uncertainty is not None and gripper.discrepancy is None:
        pairs = data.take(np.repeat(np.arange(n), m))
        every_pair = Hypotheses(*(np.tile(field, n) for field in one))
        mode.log_evidence[first] = evidence_in_doubt(
            gripper, pairs, every_pair, prior.take(first), mode.take(first)
        )
    by_grade_and_candidate = over_grades(gripper, mode.log_evidence.reshape(n, n_grade, m))
    best_grade = ((place + by_grade_and_candidate.argmax(axis=1)) * m + candidate).ravel()
    by_grade = np.logaddexp.reduce(by_grade_and_candidate, axis=2)
    return Fitted(
        mode.take(best_grade)._replace(
            log_evidence=np.logaddexp.reduce(by_grade_and_candidate, axis=1).ravel()
        ),
        np.repeat(np.arange(n), m),
        mode.take(first),
        prior.take(first),
        -np.expm1(by_grade[:, 0] - np.logaddexp.reduce(by_grade, axis=1)),
        sure,
    )


def evidence_in_doubt(
    gripper: GripperModel, data: Touches, hypotheses: Hypotheses, prior: Prior, mode: Mode
) -> Array:
    """Return the log evidence of pairs, a row of data each, where the calibration errs by as much as it knows
    (n,): with covariance P of all that grasps share and of the pair's block, and K the slopes by them at the
    modes, K P K' is noise."""
    # P of the stack alone would count twice what one known grasp leaves open: its conductance and its stack
    # compensate each other (six other grippers, one known grasp: log loss 1.05, with all of P .99)
    uncertainty, n = gripper.uncertainty, data.level.size
    assert uncertainty is not None
    _, by_u = jacobian(gripper.stack, nodes_for(data), data, mode.u, np.ones(mode.u.shape, dtype=bool))
    shared = shared_slopes(stack_numbers(gripper.stack), data, mode.u, by_u)
    slopes = np.concatenate([shared, by_u[:, :, [H, EFFUSIVITY]]], axis=2)
    spread, sd = np.zeros((n, slopes.shape[2], slopes.shape[2])), prior.sd.copy()
    blocks = hypotheses.block.astype(int)
    for block in np.unique(blocks):
        of_block, names = blocks == block, [*SHARED_NAMES]
        if block >= 0 and (names_of_block := block_names([gripper.materials[block]]))[0] in uncertainty.names:
            names += names_of_block
            # what of the block is not known is in P
            outside_spread = sd[of_block, H] ** 2 - uncertainty.sd(names_of_block[0]) ** 2
            sd[of_block, H] = np.sqrt(np.maximum(outside_spread, gripper.spreads.ln_h**2))
        place = [uncertainty.names.index(name) for name in names]
        spread[of_block, : len(place), : len(place)] = uncertainty.covariance[np.ix_(place, place)]
    in_spread = gripper.nominal_sd(data.t_ambient - data.t_object)
    sd[:, T_OBJECT] = np.sqrt(np.maximum(sd[:, T_OBJECT] ** 2 - in_spread**2, 0.0))
    noise = whiten(data, gripper.noise, slopes @ spread @ slopes.transpose(0, 2, 1))
    row = np.arange(n)
    return fit_pairs(
        gripper, data, row, hypotheses, start=mode.u, noise=noise, prior=prior._replace(sd=sd)
    ).log_evidence


def unexplained(data: Touches, row: NDArray[np.int64], mode: Mode, prior: Prior) -> list[tuple[float, str]]:
    """Return of each of n modes of touches ``row`` its misfit [standard deviations], and in words why it
    does not explain the touch, if it does not."""
    n = (data.count[row] > 0).sum(axis=1)
    if data.second is not None:
        n = n + (data.second.count[row] > 0).sum(axis=1)
    misfits, reasons = (mode.misfit - n) / np.sqrt(2 * n), []
    # of an object that is anywhere in a range the prior has the sd of a uniform law
    off, sd = np.abs(mode.u - prior.mean)[:, T_OBJECT], prior.sd[:, T_OBJECT]
    for misfit, outside in zip(misfits.tolist(), (sd > DOUBT.stated_sd_K) & (off > np.sqrt(3.0) * sd)):
        words = "the trace is not explained by the model" if misfit > UNEXPLAINED else ""
        if outside and not words:
            words = "explained only by an object outside of its range of temperatures"
        reasons.append((misfit, f"{words}: the answer is unreliable" if words else ""))
    return reasons


def over_grades(gripper: GripperModel, log_evidence: Array) -> Array:
    """Return evidences (n, n_grade, ...) times the prior probability of each grade, in logarithms."""
    log_prior = np.log([grade.prior for grade in gripper.grades])
    return np.asarray(log_evidence + log_prior.reshape(-1, *[1] * (log_evidence.ndim - 2)))


def fit_rivals(
    gripper: GripperModel, data: Touches, row: NDArray[np.int64], hypotheses: Hypotheses, *,
    start: Array | None, noise: Whitened | None, prior: Prior,
) -> Mode:  # fmt: skip
    """Return :func:`fit_pairs` of hypotheses that compete for each touch.

    Where nuisances may be off by a factor of e a density may have several modes (a sheet, or a block in poor
    contact): then each hypothesis is also looked for from where the likeliest of its touch ended."""
    # Elsewhere, and where the trace counts little, that changes no answer: none of 136 disturbed grasps by
    # .01, no end of an interval of ln e by .01.
    several = (np.maximum(data.unlike, data.thin) >= 1.0) & (data.share < 0.1)
    noise = whiten(data, gripper.reading_noise) if noise is None else noise
    mode = fit_pairs(gripper, data, row, hypotheses, start=start, noise=noise, prior=prior, rivals=True)

    def again(some: NDArray[np.int64], begin: Array) -> Mode:
        one = Hypotheses(*(field[some] for field in hypotheses))
        return fit_pairs(
            gripper, data, row[some], one, start=begin, noise=noise, prior=prior.take(some), rivals=True
        )

    return restarted(mode, row, several[row], again)


def restarted(
    mode: Mode, row: NDArray[np.int64], doubtful: Mask, search: Callable[[NDArray[np.int64], Array], Mode]
) -> Mode:
    """Return the modes of pairs of touches ``row``, of which the doubtful ones are looked for from where the
    likeliest of their touch ended, too: ``search`` takes some rows, and from where."""
    order = np.lexsort((mode.log_evidence, row))
    likeliest = np.empty(int(row.max()) + 1, dtype=np.int64)
    likeliest[row[order]] = order  # of several the last one stays
    again_for = np.flatnonzero(doubtful & (likeliest[row] != np.arange(row.size)))
    if not again_for.size:
        return mode
    begin = mode.u[likeliest[row[again_for]]]
    begin[:, EFFUSIVITY] = mode.u[again_for, EFFUSIVITY]
    again = search(again_for, begin)
    better = again.log_evidence > mode.log_evidence[again_for]
    for whole, field in zip(mode, again):
        whole[again_for[better]] = field[better]
    return mode


def _trained(gripper: GripperModel, name: str) -> dict[str, float]:
    """Return the numbers of :class:`Hypotheses` for a block that was calibrated."""
    block, spreads = gripper.blocks[name], gripper.spreads
    scatter = spreads.ln_effusivity if block.library_effusivity < INSULATOR else 0.0
    return {
        "ln_h": block.ln_h,
        "ln_h_sd": float(np.hypot(spreads.ln_h, block.ln_h_sd)),
        "ln_e": block.ln_effusivity,
        "ln_e_sd": scatter,
        "ln_rho_c": float(np.log(block.heat_capacity)),
        "ln_rho_c_sd": 0.0,
        "ln_h_dof": spreads.dof,
        "ln_e_dof": spreads.insulator_dof if scatter else np.inf,
        "block": float(gripper.materials.index(name)),
    }


def _untrained(gripper: GripperModel, row: Material) -> dict[str, float]:
    # its effusivity on the gripper's scale, with the row's uncertainty, on a block of unknown conductance
    ln_effusivity = float(gripper.found_effusivity(np.log([row.effusivity]))[0])
    scale_sd = gripper.effusivity_scale(np.array([ln_effusivity]))[1]
    scatter = gripper.spreads.ln_effusivity if row.effusivity < INSULATOR else 0.0
    return {
        "ln_h": float(gripper.expected_ln_h(np.array(ln_effusivity))),
        "ln_h_sd": float(np.hypot(gripper.spreads.ln_h_of_blocks, gripper.spreads.ln_h)),
        "ln_e": float(ln_effusivity),
        "ln_e_sd": float(np.sqrt(row.effusivity_sd_ln**2 + float(scale_sd[0]) ** 2 + scatter**2)),
        "ln_rho_c": float(np.log(row.rho * row.c_p)),
        "ln_rho_c_sd": 0.05,
        "ln_h_dof": np.inf,
        "ln_e_dof": np.inf,
        "block": -1.0,
    }
