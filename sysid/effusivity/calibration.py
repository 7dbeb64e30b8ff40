"""Learn the gripper from labelled grasps: empirical Bayes over all of them together.

Every grasp has nuisances u = mean(theta) + s w, w ~ N(0, 1) (see
:mod:`thermogrip.sysid.effusivity.laplace_approximation`); theta holds what all grasps share: the stack, the
mean onset and build-up time, heat loss in transit, the depth, and ln h and ln e of each material.
Gauss-Newton moves theta and all w at once.  The noise is then found by maximum likelihood of the residuals
with the nuisances marginalised, and the fit is repeated.  With an earlier calibration theta ~ N(its
parameters, its covariance).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.optimize import minimize

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.grasp_files import Records, as_grasps
from thermogrip.datasets.parallel import Progress
from thermogrip.datasets.schema import log_name
from thermogrip.sysid.contact.materials import Material, find_material, load_materials
from thermogrip.sysid.contact.simulation import TimeNodes
from thermogrip.sysid.effusivity.data import (
    KNOTS,
    UNKNOWN_OBJECT_SD,
    Noise,
    Touches,
    at_knots,
    noise_fit,
    room_temperature,
    stack_touches,
    touches,
    whiten,
)
from thermogrip.sysid.effusivity.gripper_model import (
    INSULATOR,
    LEVEL_SD,
    SHARED_NAMES,
    Block,
    Discrepancy,
    GripperModel,
    ParameterCovariance,
    Spreads,
    block_names,
    stack_numbers,
    stack_of,
)
from thermogrip.sysid.effusivity.laplace_approximation import (
    BUILD_UP,
    CAPACITY,
    EFFUSIVITY,
    LEVEL,
    N_NUISANCE,
    ONSET,
    T_OBJECT,
    H,
    Hypotheses,
    fit_pairs,
    jacobian,
    material_hypotheses,
    nodes_for,
    predict,
    shared_slopes,
)

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Grasps

# of SHARED_NAMES: prior mean and sd; all wide, in the units of the name
_WIDE: dict[str, tuple[float, float]] = {
    "ln_e_outer": (float(np.log(2e3)), 1.0),
    "ln_z_outer": (float(np.log(0.1)), 1.0),
    "ln_e_inner": (float(np.log(2.5e3)), 1.0),
    "ln_z_inner": (float(np.log(6.0)), 0.7),
    "ln_g_back": (float(np.log(100.0)), 1.5),
    "ln_lag": (float(np.log(0.2)), 1.0),
    "ln_first": (float(np.log(0.05)), 1.0),
    "creep": (0.3, 0.5),
    "ln_settle": (float(np.log(3.0)), 0.7),
    "leak": (5e-4, 2e-3),
    "ln_g_side": (float(np.log(100.0)), 1.5),
    "ln_c_side": (float(np.log(2e4)), 1.0),
    "ln_g_far": (float(np.log(20.0)), 1.5),
    "ln_build_up": (float(np.log(0.5)), 1.0),
    "onset": (0.0, 0.3),
    "transit_loss": (0.02, 0.03),
    "bias": (0.0, 0.3),
    "ln_depth": (0.0, 0.05),
}
FIRST_SPREAD = {"ln_h": 0.15, "ln_build_up": 0.1, "onset": 0.1, "t_object": 0.5, "ln_effusivity": 0.1}
_LN_H = (float(np.log(1500.0)), 1.0)


@dataclass(frozen=True)
class CalibrationSettings:
    """How the search goes, and what little is believed before it."""

    guesses: float = 2.0  # grasps that the first guess of a spread counts for
    # that an earlier calibration's spread counts for at most: another day is alike, not the same
    earlier_grasps: float = 10.0
    # of a wide prior's sd: numbers that count as exact keep this much, so that matrices invert
    exact: float = 1e-3
    # of theta, mostly logarithms: from a cold start the first steps would leave the range of any gripper
    longest_step: float = 1.5
    # of fit and noise; a fourth moves no number of the bundled gripper by a hundredth of its sd
    rounds: int = 3
    steps: int = 40  # of one fit, at most
    settled: float = 0.05  # change of -2 ln evidence
    roughly_settled: float = 1.0  # before the noise is found anew, which makes more difference
    least_ln_h_spread: float = 0.2  # from block to block: a few blocks cannot show less
    slow_ln_build_up: float = 2.3  # ln s: a contact that builds up for as long as it lasts
    least_white_K: float = 0.003  # a search that begins with less ends where rounding stops it
    always_sd_K: float = 0.5  # of a discrepancy common to all grasps
    share_sd: float = 0.02  # of a discrepancy by the difference between object and skin
    onset_sd_s: float = 0.2  # of contact with each block about the mean
    noise_steps: int = 300  # at most
    noise_slope: float = 0.01  # nat per noise step that end the search
    noise_slope_roughly: float = 0.3  # where it is found once more


SETTINGS = CalibrationSettings()


class Anchor(NamedTuple):
    """A row of the materials table: effusivity, its relative sd, and rho c_p."""

    effusivity: float
    sd_ln: float
    heat_capacity: float


_ANY = Anchor(800.0, 2.0, 2e6)  # of a label that the table has not: from foam to metal, all of solids


@dataclass(frozen=True)
class ThetaPrior:
    """What is believed of theta before the fit."""

    mean: Array  # (n_theta,)
    precision: Array  # (n_theta, n_theta)
    spread: Mapping[str, float]  # from grasp to grasp
    guesses: float = SETTINGS.guesses  # number of grasps that the spread counts for

    def penalty(self, theta: Array) -> float:
        """Return the squared distance of theta from the mean, in standard deviations."""
        off = theta - self.mean
        return float(off @ self.precision @ off)


def anchors(
    labels: Sequence[str], library: Mapping[str, Material], gripper: GripperModel | None
) -> tuple[Anchor, ...]:
    """Return what is written of each label, in the library or else in an earlier calibration, or nothing."""
    out = []
    for label in labels:
        if label in library:
            row = library[label]
            out.append(Anchor(row.effusivity, row.effusivity_sd_ln, row.rho * row.c_p))
        elif gripper is not None and label in gripper.blocks:
            block = gripper.blocks[label]
            out.append(Anchor(block.library_effusivity, block.library_sd_ln, block.heat_capacity))
        else:
            out.append(_ANY)
    return tuple(out)


def wide_prior(known: Sequence[Anchor]) -> ThetaPrior:
    """Return the prior of a gripper that nobody has seen, with blocks of these effusivities."""
    # theta is laid out in the order of SHARED_NAMES, then ln h and ln e of each block
    table = [*_WIDE.values(), *[_LN_H] * len(known)]
    # only ln e leans on the library, and the depth on the block's length
    table += [(float(np.log(row.effusivity)), row.sd_ln) for row in known]
    mean, sd = np.array(table).T
    return ThetaPrior(mean, np.diag(sd**-2.0), dict(FIRST_SPREAD))


def prior_of_gripper(gripper: GripperModel, labels: Sequence[str], known: Sequence[Anchor]) -> ThetaPrior:
    """Return the prior that an earlier calibration is; labels that it has not met have a wide one."""
    wide = wide_prior(known)
    names = (*SHARED_NAMES, *block_names(labels))
    mean, sd = gripper_theta(gripper, labels, wide.mean), np.diag(wide.precision) ** -0.5
    covariance = np.diag((SETTINGS.exact * sd) ** 2)
    known_to = gripper.uncertainty
    for i, name in enumerate(names):
        label = name.partition(" ")[2]
        if label and label not in gripper.blocks:
            covariance[i, i] = sd[i] ** 2
    if known_to is not None:
        ours = [i for i, name in enumerate(names) if name in known_to.names]
        theirs = [known_to.names.index(names[i]) for i in ours]
        covariance[np.ix_(ours, ours)] += known_to.covariance[np.ix_(theirs, theirs)]
    spread = {k: float(getattr(gripper.spreads, k)) for k in FIRST_SPREAD}
    return ThetaPrior(
        mean, np.asarray(np.linalg.inv(covariance)), spread, min(SETTINGS.earlier_grasps, gripper.spreads.dof)
    )


def gripper_theta(gripper: GripperModel, labels: Sequence[str], otherwise: Array) -> Array:
    """Return theta of a calibration, (n_theta,); ``otherwise`` where it has no block of a label."""
    theta = otherwise.copy()
    shared = gripper.onset, gripper.transit_loss, gripper.bias, np.log(gripper.depth_share)
    theta[: len(SHARED_NAMES)] = [*stack_numbers(gripper.stack), *shared]
    n = len(labels)
    for k, label in enumerate(labels):
        if label in gripper.blocks:
            theta[-2 * n + k] = gripper.blocks[label].ln_h
            theta[-n + k] = gripper.blocks[label].ln_effusivity
    return theta


Spread = dict[str, float]

FLOORS = {"ln_h": 0.02, "ln_build_up": 0.03, "onset": 0.005, "t_object": 0.02, "ln_effusivity": 0.02}
_COLUMN = {
    "ln_h": H,
    "ln_build_up": BUILD_UP,
    "onset": ONSET,
    "t_object": T_OBJECT,
    "ln_effusivity": EFFUSIVITY,
}


@dataclass(frozen=True)
class Problem:
    """Labelled grasps and priors, fixed during a fit."""

    data: Touches  # of n grasps
    nodes: TimeNodes
    labels: tuple[str, ...]  # the materials
    library: tuple[Anchor, ...]
    which: NDArray[np.int64]  # (n,), the label of each grasp
    prior: ThetaPrior  # of theta
    ln_capacity: Array  # (n_label,), of rho c_p times the block's length
    fixed: Discrepancy | None = None  # that of an earlier calibration, by label

    def beyond(self, theta: Array) -> Array | None:
        """Return the discrepancy of every grasp, (n, 2, n_bin), None where none is fitted."""
        if (discrepancy := self.discrepancy(theta)) is None:
            return None
        weight = at_knots(self.data.t)
        share = (weight * discrepancy.share[self.which][:, None, :]).sum(axis=2)
        return np.stack([weight @ discrepancy.always, share], axis=1)

    def discrepancy(self, theta: Array) -> Discrepancy | None:
        """Return the discrepancy in theta, between the shared numbers and the blocks' own."""
        n = len(self.labels)
        values = theta[len(SHARED_NAMES) : theta.size - 2 * n]
        if not values.size:
            return self.fixed
        curves = values[:-n].reshape(-1, KNOTS.size)
        return Discrepancy(curves[0], curves[1:], values[-n:])

    @property
    def known(self) -> Mask:
        """Return where the object's temperature was known, (n,)."""
        return np.isfinite(self.data.t_object)

    @property
    def insulating(self) -> Mask:
        """Return which grasps are of insulators, (n,)."""
        return np.array([m.effusivity < INSULATOR for m in self.library])[self.which]

    def rows(self, spread: str) -> Mask:
        """Return which grasps inform a spread, (n,)."""
        everywhere = np.ones(self.which.size, dtype=bool)
        return {"t_object": self.known, "ln_effusivity": self.insulating}.get(spread, everywhere)

    def dof(self, spread: str) -> float:
        """Return the degrees of freedom of a spread: grasps and guesses less the means fitted to them."""
        insulators = np.unique(self.which[self.insulating]).size
        means = {"ln_h": np.unique(self.which).size, "ln_effusivity": insulators, "t_object": 2}
        # means are fitted to the same grasps; two more for a first guess of the spread
        guesses = self.prior.guesses
        return max(guesses, float(self.rows(spread).sum()) - means.get(spread, 1) + guesses)

    def ln_h(self, theta: Array) -> Array:
        """Return ln h of each label, a view into theta."""
        n = len(self.labels)
        return theta[-2 * n : -n]

    def ln_e(self, theta: Array) -> Array:
        """Return ln e of each label, a view into theta."""
        return theta[-len(self.labels) :]

    def room_difference(self) -> Array:
        """Return room minus object temperature where both are known, else 0, (n,)."""
        return np.nan_to_num(self.data.t_ambient - self.data.t_object)

    def centre(self, theta: Array) -> Array:
        """Return the prior mean of u, (n, 7)."""
        value = dict(zip(SHARED_NAMES, theta))
        u = np.empty((self.which.size, N_NUISANCE))
        u[:, H] = self.ln_h(theta)[self.which]
        u[:, BUILD_UP], u[:, ONSET], u[:, LEVEL] = value["ln_build_up"], value["onset"], self.data.level
        stated = self.data.t_object + value["bias"]
        nominal = np.where(self.known, stated, room_temperature(self.data.t_ambient))
        u[:, T_OBJECT] = nominal + value["transit_loss"] * self.room_difference()
        if (discrepancy := self.discrepancy(theta)) is not None:
            u[:, ONSET] += discrepancy.onset[self.which]
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
        stated_sd = self.data.t_object_sd
        s[:, T_OBJECT] = np.where(self.known & np.isfinite(stated_sd), stated_sd, s[:, T_OBJECT])
        s[:, LEVEL] = LEVEL_SD
        return s


class Linearised(NamedTuple):
    """Predictions (n, n_bin) and their derivatives by w (n, n_bin, 7) and by theta (n, n_bin, n_theta)."""

    y: Array
    by_w: Array
    by_theta: Array


def linearise(problem: Problem, theta: Array, w: Array, spread: Spread) -> Linearised:
    """Return the prediction of every grasp and its derivatives."""
    data = problem.data
    nodes = problem.nodes
    scale = problem.scales(spread)
    u = problem.centre(theta) + scale * w
    beyond = problem.beyond(theta)
    y, by_u = jacobian(stack_of(theta), nodes, data, u, np.ones(u.shape, dtype=bool), beyond)
    k = np.zeros((*y.shape, theta.size))
    k[:, :, : len(SHARED_NAMES)] = shared_slopes(theta, data, u, by_u, beyond)
    n = len(problem.labels)
    for m in range(n):
        of_label = problem.which == m
        k[of_label, :, theta.size - 2 * n + m] = by_u[of_label, :, H]
        k[of_label, :, theta.size - n + m] = by_u[of_label, :, EFFUSIVITY]
    if theta.size > len(SHARED_NAMES) + 2 * n:
        assert beyond is not None
        weight = at_knots(data.t) * (data.count > 0)[:, :, None]
        first = len(SHARED_NAMES)
        k[:, :, first : first + KNOTS.size] = weight
        difference = (u[:, T_OBJECT] - u[:, LEVEL])[:, None, None]
        for m in range(n):
            of_label, first = problem.which == m, first + KNOTS.size
            k[of_label, :, first : first + KNOTS.size] = (weight * difference)[of_label]
            k[of_label, :, theta.size - 3 * n + m] = by_u[of_label, :, ONSET]
    return Linearised(y, by_u * scale[:, None, :], k)


class Step(NamedTuple):
    """One joint Gauss-Newton step."""

    theta: Array  # new, as ``w``
    w: Array
    damping: float  # to go on with
    objective: float  # before it
    log_det: float  # of the nuisances, before it
    variance: Array  # (n, 7), posterior variances of the nuisances in units of the prior
    precision: Array  # of theta


def joint_step(
    problem: Problem, theta: Array, w: Array, spread: Spread, whitener: Array, damping: float
) -> Step:
    """Return the state after one step of theta and all w, damped until the objective falls."""
    lin = linearise(problem, theta, w, spread)
    residual = np.einsum("nij,nj->ni", whitener, problem.data.y - lin.y)
    j, k = whitener @ lin.by_w, whitener @ lin.by_theta
    # an arrow, a small block A_i = I + J_i' J_i per grasp and a border for theta: the w are eliminated first
    matrix = np.eye(N_NUISANCE) + j.transpose(0, 2, 1) @ j
    inverse = np.linalg.inv(matrix)
    border = j.transpose(0, 2, 1) @ k
    eliminate = border.transpose(0, 2, 1) @ inverse
    grad_w = np.einsum("nik,ni->nk", j, residual) - w
    prior = problem.prior
    grad = np.einsum("nik,ni->k", k, residual) - prior.precision @ (theta - prior.mean)
    grad -= np.einsum("nka,na->k", eliminate, grad_w)
    flat = k.reshape(-1, theta.size)
    # S = P + sum_i K_i' K_i - K_i' J_i A_i^-1 J_i' K_i, K_i = d(reading_i) / d theta
    precision = prior.precision + flat.T @ flat - (eliminate @ border).sum(axis=0)
    before = float((residual**2).sum() + (w**2).sum()) + prior.penalty(theta)
    new_theta, new_w = theta, w
    for _ in range(10):
        move = np.linalg.solve(precision + damping * np.diag(np.diag(precision)), grad)
        move_w = np.einsum("nab,nb->na", inverse, grad_w - border @ move)
        # from a cold start the first steps would leave the range of any gripper
        shorten = min(
            1.0, SETTINGS.longest_step / float(np.abs(move).max()), 10 / float(np.abs(move_w).max())
        )
        move, move_w = shorten * move, shorten * move_w
        if _objective(problem, theta + move, w + move_w, spread, whitener) < before + 1e-9:
            new_theta = theta + move
            new_w = w + move_w
            damping = max(damping * 0.1, 1e-9)
            break
        damping = max(damping * 10, 1e-6)
    variance = np.diagonal(inverse, axis1=1, axis2=2)
    return Step(
        new_theta, new_w, damping, before, float(np.linalg.slogdet(matrix)[1].sum()), variance, precision
    )


def renew_spread(problem: Problem, spread: Spread, w: Array, variance: Array) -> tuple[Spread, Array]:
    """Return the spreads after one (over-relaxed) step of EM, and w in their units."""
    new, scaled = dict(spread), w.copy()
    for name, column in _COLUMN.items():
        rows = problem.rows(name)
        if name == "t_object":
            rows = rows & ~np.isfinite(problem.data.t_object_sd)
        if not rows.any():  # a spread that no grasp informs, such as that of insulators among metals, stays
            continue
        # s^2 = sum(posterior mean^2 + posterior variance) / dof, one step of EM for restricted likelihood
        squares = float((w[rows, column] ** 2 + variance[rows, column]).sum())
        squares += problem.prior.guesses * (problem.prior.spread[name] / spread[name]) ** 2
        ratio = np.sqrt(squares / problem.dof(name)) ** 1.5
        new[name] = max(FLOORS[name], float(spread[name] * ratio))
        scaled[rows, column] *= spread[name] / new[name]
    return new, scaled


def _objective(problem: Problem, theta: Array, w: Array, spread: Spread, whitener: Array) -> float:
    try:
        stack = stack_of(theta)
    except ValueError:
        return np.inf  # outside the physical range: the step is refused and shortened
    u = problem.centre(theta) + problem.scales(spread) * w
    y = predict(stack, problem.nodes, problem.data, u, problem.beyond(theta))
    residual = np.einsum("nij,nj->ni", whitener, problem.data.y - y)
    return float((residual**2).sum() + (w**2).sum()) + problem.prior.penalty(theta)


_SMOOTH = Noise(slow=0.01, correlation_time=1.2, misfit=0.005, growth=1.5, smooth=True)
# ln white, ln slow, ln correlation time, ln misfit, growth: how well 200 grasps know each; where they may be
_NOISE_STEPS = np.array([0.01, 0.1, 0.3, 0.1, 0.2])
_NOISE_RANGE = np.array([(-8.0, 0.0), (-8.0, 0.0), (-1.0, 4.0), (-9.0, -3.0), (0.0, 2.0)])


def calibrate_gripper(
    grasps: Records, *, materials: Mapping[str, Material] | None = None,
    start: GripperModel | None = None, prior: GripperModel | None = None, block_length: float | None = None,
    seed: int = 0, progress: Progress | None = None,
) -> GripperModel:  # fmt: skip
    """Return the gripper and populations that all labelled grasps support together.

    Parameters
    ----------
    grasps : Grasps, str, Path, or sequence of them
        Training grasps of all conditions, every one with a ``material``.
    materials : mapping of label to Material, optional
        Library rows of the labels; default the project's table.  A label without a row is learnt from its
        grasps alone, beside one that has a row.
    start : GripperModel, optional
        An earlier calibration of this gripper.  A refit from it is quick and keeps its noise; it must not
        have seen the grasps that the refit is tested on where that matters.
    prior : GripperModel, optional
        What is known before: an earlier calibration with its ``uncertainty``, or that of
        another gripper (:func:`~thermogrip.sysid.effusivity.gripper_model.another_gripper`).  The fit
        starts there and leans on it, so that a few grasps of one material suffice; its noise is kept, and so
        are its other blocks.
    block_length : float, optional
        Length of the blocks behind the contact face [m]; default 0.02, or that of ``prior``.
    seed : int, optional
        Unused by the deterministic fit; here so that every stage takes one.
    progress : callable, optional
        Called with (fraction done, what).

    Returns
    -------
    GripperModel

    Raises
    ------
    UserError
        If there is no grasp, a grasp has no label, no material is in the library, both ``start`` and
        ``prior`` are given, or all grasps are of one material and there is no ``prior``.

    Examples
    --------
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> file = load_example_grasps()["exp2_dT20"]
    >>> gripper = calibrate_gripper([file.isel(grasp=file["split"].values == "train")])
    >>> gripper.materials, bool(gripper.blocks["wood"].ln_h < gripper.blocks["copper"].ln_h)
    (('copper', 'iron', 'wood'), True)
    """
    if start is not None and prior is not None:
        raise UserError("both start and prior are given", hint="a prior is a start too: give it alone")
    grasps = as_grasps(grasps)
    data = _labelled_touches(grasps, materials or {}, least=2 if prior is None else 1)
    names = (*(() if prior is None else prior.trained_on), *(log_name(g) for g in grasps))
    length = block_length or (0.02 if prior is None else prior.block_length)
    report = progress or (lambda fraction, what: None)
    gripper = _calibrated_sensors(data, materials or {}, start, prior, length, names, report)
    report(1.0, "calibrated")
    return gripper


def _calibrated_sensors(
    data: Touches, materials: Mapping[str, Material], start: GripperModel | None, prior: GripperModel | None,
    length: float, names: tuple[str, ...], report: Progress, first: GripperModel | None = None,
) -> GripperModel:  # fmt: skip
    """Return what the first sensor supports, and with it what a second one does, which is given ``first``."""
    earlier = start or prior
    problem = _problem(data, materials, prior, length)
    if earlier is not None and earlier.discrepancy is not None:
        ln_e = problem.ln_e(gripper_theta(earlier, problem.labels, problem.prior.mean))
        problem = replace(problem, fixed=earlier.discrepancy_of(ln_e))
    theta = problem.prior.mean.copy()
    spread = dict(problem.prior.spread)
    noise = Noise()
    if earlier is not None:
        theta = gripper_theta(earlier, problem.labels, theta)
        spread = {k: float(getattr(earlier.spreads, k)) for k in spread}
        noise = earlier.noise
    w = _first_nuisances(problem, theta, spread)
    rounds = SETTINGS.rounds if earlier is None else 1
    for i in range(rounds):

        def report_round(fraction: float, what: str, i: int = i) -> None:
            report((i + fraction) / rounds, what)

        # the noise found after a round makes more difference than the end of its search
        settled = SETTINGS.settled if i == rounds - 1 else SETTINGS.roughly_settled
        fit = _fit_to_evidence(problem, theta, w, spread, noise, report_round, settled=settled)
        theta, w, spread = fit.step.theta, fit.w, fit.spread
        if i < rounds - 1:
            slope = SETTINGS.noise_slope if i == rounds - 2 else SETTINGS.noise_slope_roughly
            noise = _fit_noise(problem, linearise(problem, theta, w, spread), w, noise, slope)
    if rounds > 1:
        fit = _discrepant(fit, report, first)
    gripper = _gripper_model(fit, length, names, prior)
    if data.second is None:
        return gripper
    # unknown object temperatures are those that the first sensor found for the blocks that they are of
    by_block = material_hypotheses(gripper, gripper.materials)
    true_hypotheses = Hypotheses(*(h[problem.which] for h in by_block))
    mode = fit_pairs(gripper, replace(data, second=None), np.arange(problem.which.size), true_hypotheses)
    t_object = np.where(problem.known, data.t_object, mode.u[:, T_OBJECT])
    sd = np.where(problem.known, data.t_object_sd, np.sqrt(mode.covariance[:, T_OBJECT, T_OBJECT]))
    beside = _calibrated_sensors(
        replace(data.second, t_object=t_object, t_object_sd=sd),
        materials,
        None if start is None else start.second,
        None if prior is None else prior.second,
        length,
        names,
        report,
        gripper,
    )
    return replace(gripper, second=beside)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Where a fit ended."""

    problem: Problem
    step: Step  # the last
    w: Array  # nuisances
    spread: Spread
    noise: Noise


def _discrepant(bare: _Fit, progress: Progress, first: GripperModel | None) -> _Fit:
    """Return the fit with a discrepancy in a smooth noise where its evidence is greater, else as it was; a
    first look at twice three steps decides whether a search is worth it.  The evidence has several maxima, so
    that the search begins from contacts that build up fast, near the fit without one, from slow ones, and
    for a second sensor also from what surrounds the first."""
    least = _log_evidence(bare)
    problem, near = _with_discrepancy(bare.problem, bare.step.theta)
    begin = replace(_SMOOTH, white=bare.noise.white)  # from elsewhere a search may end without misfit
    fast = near, bare.w, bare.spread, (bare.noise, begin)
    if _search_discrepancy(problem, *fast, (3, 3), least, progress) is None:
        return bare
    slow, spread = problem.prior.mean.copy(), dict(problem.prior.spread)
    slow[SHARED_NAMES.index("ln_build_up")] = SETTINGS.slow_ln_build_up
    begin = replace(_SMOOTH, white=max(bare.noise.white, SETTINGS.least_white_K))
    starts = [fast, (slow, np.zeros(bare.w.shape), spread, (begin, begin))]
    if not problem.known.all():  # objects as warm as the skin may show nothing, as far beyond too much
        starts.append((slow, _first_nuisances(problem, slow, spread), spread, (begin, begin)))
    if first is not None:
        # the same skin: on two of three folds of real contacts 1,300 and 3,600 nats above the other starts
        theta_of_first = gripper_theta(first, problem.labels, bare.problem.prior.mean)
        alike = _with_discrepancy(bare.problem, theta_of_first)[1]
        starts.append((alike, np.zeros(bare.w.shape), spread, (begin, begin)))
    looks = (SETTINGS.steps, SETTINGS.steps, SETTINGS.steps)
    searched = [_search_discrepancy(problem, *start, looks, least, progress) for start in starts]
    found = [fit for fit in searched if fit is not None]
    return max(found, key=_log_evidence, default=bare)


def _search_discrepancy(
    problem: Problem, theta: Array, w: Array, spread: Spread, noises: tuple[Noise, Noise],
    looks: Sequence[int], least: float, progress: Progress,
) -> _Fit | None:  # fmt: skip
    """Return a fit with the problem's discrepancy, after ``looks`` of so many steps, the noise found anew
    between them; None where the evidence is below ``least`` once the noise is fitted.  ``noises``: to begin
    with, and from where it is searched."""
    noise, begin = noises
    for i, steps in enumerate(looks):
        fit = _fit_to_evidence(problem, theta, w, spread, noise, progress, steps=steps)
        theta, w, spread = fit.step.theta, fit.w, fit.spread
        if i > 0 and _log_evidence(fit) < least:
            return None
        if i < len(looks) - 1:
            slope = SETTINGS.noise_slope_roughly if steps < SETTINGS.steps else SETTINGS.noise_slope
            noise = _fit_noise(problem, linearise(problem, theta, w, spread), w, begin, slope)
    return fit


def _log_evidence(fit: _Fit) -> float:
    """Return the log evidence of all grasps by Laplace's method, up to what the grasps alone decide."""
    problem, step = fit.problem, fit.step
    free = np.linalg.slogdet(step.precision)[1] - np.linalg.slogdet(problem.prior.precision)[1]
    return -0.5 * float(step.objective + step.log_det + whiten(problem.data, fit.noise)[1].sum() + free)


def _with_discrepancy(problem: Problem, theta: Array) -> tuple[Problem, Array]:
    """Return the problem and theta with a discrepancy of nothing, of which little is expected."""
    n = len(problem.labels)
    prior = problem.prior
    first = len(SHARED_NAMES)
    x = np.log1p((KNOTS + 1.5) / 0.5)
    correlation = np.exp(-0.5 * ((x[:, None] - x) / 0.4) ** 2) + 1e-4 * np.eye(KNOTS.size)
    # What all grasps have in common and what goes along with the difference between object and skin are
    # separated by objects on both sides of the skin.  Else all of it goes along, as heat does: a part that
    # did not would be what is left of an estimate's error, and at another difference a misfit.
    differences = problem.data.t_object - problem.data.level
    both_sides = (differences < 0).any() and (differences > 0).any()
    always_sd = SETTINGS.always_sd_K if both_sides else SETTINGS.exact * SETTINGS.always_sd_K
    alike = 0.7 + 0.3 * np.eye(n)
    precision = block_diag(
        prior.precision[:first, :first],
        np.linalg.inv(correlation) / always_sd**2,
        np.kron(np.linalg.inv(alike), np.linalg.inv(correlation)) / SETTINGS.share_sd**2,
        np.eye(n) / SETTINGS.onset_sd_s**2,
        prior.precision[first:, first:],
    )
    nothing = np.zeros((n + 1) * KNOTS.size + n)
    mean = np.concatenate([prior.mean[:first], nothing, prior.mean[first:]])
    grown = np.concatenate([theta[:first], nothing, theta[first:]])
    return replace(problem, prior=replace(prior, mean=mean, precision=precision)), grown


def calibrate_example_gripper(progress: Progress | None = None) -> GripperModel:
    """Return the calibration of the bundled rig from the training grasps of exp1 to exp4 (195)."""
    from thermogrip.datasets.examples import load_example_grasps

    files = load_example_grasps()
    wanted = [files[name] for name in sorted(files) if name[:4] in ("exp1", "exp2", "exp3", "exp4")]
    return calibrate_gripper([g.isel(grasp=g["split"].values == "train") for g in wanted], progress=progress)


def _problem(
    data: Touches, materials: Mapping[str, Material], prior: GripperModel | None, block_length: float
) -> Problem:
    touched = sorted(set(data.material.tolist()))
    library = {label: row for label in touched if (row := _library_row(label, materials)) is not None}
    # blocks that are not touched now stay in theta: what they have in common with the touched ones moves with
    # them
    labels = touched if prior is None else sorted({*touched, *prior.materials})
    anchor_of = dict(zip(labels, anchors(labels, library, prior)))
    theta = wide_prior([*anchor_of.values()])
    if prior is not None:
        theta = prior_of_gripper(prior, labels, [*anchor_of.values()])
    return Problem(
        data,
        nodes_for(data),
        tuple(labels),
        tuple(anchor_of.values()),
        np.array([labels.index(m) for m in data.material.tolist()]),
        theta,
        np.log([row.heat_capacity * block_length for row in anchor_of.values()]),
    )


def _first_nuisances(problem: Problem, theta: Array, spread: Spread) -> Array:
    """Return the nuisances to start from, (n, 7): those expected, but for objects of unknown temperature,
    which are as far beyond where the skin ended as it came; as warm as it they would show nothing."""
    w, data = np.zeros((problem.which.size, N_NUISANCE)), problem.data
    last = (data.count > 0).cumsum(axis=1).argmax(axis=1)
    went = data.y[np.arange(last.size), last] - data.level
    away = data.level + 2 * went - problem.centre(theta)[:, T_OBJECT]
    w[~problem.known, T_OBJECT] = (away / problem.scales(spread)[:, T_OBJECT])[~problem.known]
    return w


def _labelled_touches(grasps: Sequence[Grasps], materials: Mapping[str, Material], least: int) -> Touches:
    if not grasps:
        raise UserError("no training grasps", hint="give at least one record with materials")
    records = []
    for record in grasps:
        binned = touches(record)
        if np.any(binned.material == ""):
            lost = str(binned.grasp_id[binned.material == ""][0])
            raise UserError(
                f"grasp {lost!r} has no material", file=log_name(record), hint="label or remove it"
            )
        _check_labels(binned, materials, log_name(record))
        records.append(binned)
    data = stack_touches(records)
    if np.unique(data.material).size < least:
        raise UserError(
            f"all training grasps are of {str(data.material[0])!r}",
            file=log_name(grasps[0]),
            hint="give grasps of at least two materials, or a prior",
        )
    labels = dict.fromkeys(data.material.tolist())
    if least > 1 and not any(_library_row(label, materials) for label in labels):
        first = f"grasp {str(data.grasp_id[0])!r} is of {str(data.material[0])!r}"
        problem = f"{first}, and the materials table has none of the labels"
        hint = "name one of them at least as 'thermogrip materials' does: it holds the scale"
        raise UserError(problem, file=log_name(grasps[0]), column="material", hint=hint)
    return data


def _check_labels(part: Touches, materials: Mapping[str, Material], file: str) -> None:
    """Raise UserError, with file and grasp, at a label that is almost the word of the table's."""
    for label in dict.fromkeys(part.material.tolist()):
        similar = get_close_matches(label.lower(), load_materials(), 1, 0.8)
        if similar and _library_row(label, materials) is None:
            first = str(part.grasp_id[part.material == label][0])
            problem = f"grasp {first!r} is of {label!r}, which the materials table has not"
            hint = f"did you mean {similar[0]}? (another material needs a name less like those of the table)"
            raise UserError(problem, file=file, column="material", hint=hint)


def _library_row(label: str, materials: Mapping[str, Material]) -> Material | None:
    """Return the library's row of a label, None where it has none."""
    try:
        return materials.get(label) or find_material(label)
    except UserError:
        return None


def _fit_to_evidence(
    problem: Problem, theta: Array, w: Array, spread: Spread, noise: Noise, progress: Progress,
    steps: int = SETTINGS.steps, settled: float = SETTINGS.settled,
) -> _Fit:  # fmt: skip
    """Alternate Gauss-Newton and EM until the evidence settles."""
    whitener, log_det = whiten(problem.data, noise)
    damping, before = 1e-3, np.inf
    for i in range(steps):
        progress(i / SETTINGS.steps, f"gripper from {problem.which.size} grasps")
        step = joint_step(problem, theta, w, spread, whitener, damping)
        theta, damping = step.theta, step.damping
        spread, w = renew_spread(problem, spread, step.w, step.variance)
        value = step.objective + step.log_det + float(log_det.sum())
        if abs(before - value) < settled:
            break
        before = value
    return _Fit(problem, step, w, spread, noise)


def _fit_noise(
    problem: Problem, lin: Linearised, w: Array, noise: Noise, slope: float = SETTINGS.noise_slope
) -> Noise:
    """Return the noise that makes the linearised residuals likeliest, nuisances marginalised, within
    ``slope``."""
    data = problem.data
    has_samples = data.count > 0
    j = lin.by_w * has_samples[:, :, None]
    residual = (data.y - lin.y) * has_samples + np.einsum("nik,nk->ni", j, w)
    outer = j @ j.transpose(0, 2, 1)

    def unpack(q: Array) -> Noise:
        white, slow, time, misfit = np.exp(q[:4]).tolist()
        return replace(
            noise, white=white, slow=slow, correlation_time=time, misfit=misfit, growth=float(q[4])
        )

    def cost(q: Array) -> tuple[float, Array]:
        value, slopes = noise_fit(data, unpack(q), outer, residual)
        # weak priors keep what short records do not identify in a sensible range
        value += 0.5 * (((q[2] - np.log(4)) / 0.7) ** 2 + ((q[4] - 0.5) / 0.5) ** 2)
        slopes[2] += (q[2] - np.log(4)) / 0.7**2
        slopes[4] += (q[4] - 0.5) / 0.5**2
        return value, slopes

    first = np.array([*np.log([noise.white, noise.slow, noise.correlation_time, noise.misfit]), noise.growth])
    return unpack(_least(cost, first, data.level.size, slope))


def _least(
    cost: Callable[[Array], tuple[float, Array]],
    first: Array,
    n_grasp: int,
    slope: float = SETTINGS.noise_slope,
) -> Array:
    """Return where the cost of a noise is least, (5,), within ``slope``; ``cost`` gives its slopes too."""

    def scaled(z: Array) -> tuple[float, Array]:
        value, slopes = cost(z * _NOISE_STEPS)
        return value, slopes * _NOISE_STEPS

    # the slopes say when it is over, or where a step gains less than the sum's rounding (4e-6 of 24,000 nats)
    best = minimize(
        scaled,
        first / _NOISE_STEPS,
        jac=True,
        method="L-BFGS-B",
        bounds=_NOISE_RANGE / _NOISE_STEPS[:, None],
        options={"maxiter": SETTINGS.noise_steps, "ftol": 1e-9, "gtol": slope},
    )
    if not best.success:
        warnings.warn(
            f"the search for the noise of {n_grasp} grasps ended after {best.nit} steps before it settled "
            f"(slope {np.abs(best.jac).max():.2g}, wanted {slope:g}): {best.message}",
            RuntimeWarning,
            stacklevel=4,
        )
    return np.asarray(best.x * _NOISE_STEPS)


def _gripper_model(
    fit: _Fit, block_length: float, names: tuple[str, ...], prior: GripperModel | None
) -> GripperModel:
    problem, step, theta = fit.problem, fit.step, fit.step.theta
    shared = dict(zip(SHARED_NAMES, theta.tolist()))
    n = len(problem.labels)
    of_theta = np.delete(np.arange(theta.size), np.s_[len(SHARED_NAMES) : theta.size - 2 * n])
    # given the gripper: the scale that all blocks share is no news about one of them
    block_sd = np.sqrt(np.diag(np.linalg.inv(step.precision[-2 * n :, -2 * n :])))
    before = {} if prior is None else {label: block.n_grasp for label, block in prior.blocks.items()}
    count = [int((problem.which == k).sum()) + before.get(label, 0) for k, label in enumerate(problem.labels)]
    blocks = {
        label: Block(
            ln_h=float(problem.ln_h(theta)[k]),
            ln_h_sd=float(block_sd[k]),
            ln_effusivity=float(problem.ln_e(theta)[k]),
            ln_effusivity_sd=float(block_sd[n + k]),
            library_effusivity=float(row.effusivity),
            library_sd_ln=float(row.sd_ln),
            heat_capacity=float(row.heat_capacity),
            n_grasp=count[k],
        )
        for k, (label, row) in enumerate(zip(problem.labels, problem.library))
    }
    line = _ln_h_line(blocks)
    covariance = np.linalg.inv(step.precision)[np.ix_(of_theta, of_theta)]
    names_of_theta = (*SHARED_NAMES, *block_names(problem.labels))
    return GripperModel(
        stack=stack_of(theta),
        noise=fit.noise,
        spreads=Spreads(
            **fit.spread,
            ln_h_of_blocks=line.sd,
            dof=problem.dof("ln_h"),
            insulator_dof=problem.dof("ln_effusivity"),
        ),
        onset=shared["onset"],
        transit_loss=shared["transit_loss"],
        bias=shared["bias"],
        depth_share=float(np.exp(shared["ln_depth"])),
        block_length=block_length,
        ln_h_level=line.level,
        ln_h_slope=line.slope,
        blocks=blocks,
        trained_on=names,
        uncertainty=ParameterCovariance(names_of_theta, 0.5 * (covariance + covariance.T)),
        discrepancy=problem.discrepancy(theta),
    )


@dataclass(frozen=True)
class _LnHLine:
    """ln h of blocks against ln e."""

    slope: float
    level: float  # at ln e = 9
    sd: float


def _ln_h_line(blocks: Mapping[str, Block]) -> _LnHLine:
    """Return the line through the blocks; a shallow slope is preferred."""
    x = np.array([b.ln_effusivity for b in blocks.values()]) - 9.0
    y = np.array([b.ln_h for b in blocks.values()])
    design = np.stack([x, np.ones_like(x)], axis=1)
    slope, level = np.linalg.solve(design.T @ design + np.diag([0.2**2 / 0.2**2, 0.0]), design.T @ y)
    residual = y - design @ np.array([slope, level])
    sd = float(np.sqrt((residual**2).sum() / max(1, y.size - 2)))
    return _LnHLine(float(slope), float(level), max(SETTINGS.least_ln_h_spread, sd))
