"""Learn the gripper from labelled grasps: empirical Bayes over all of them together.

Every grasp has nuisances u = mean(theta) + s w, w ~ N(0, 1) (see
:mod:`thermogrip.sysid.effusivity.laplace_approximation`); theta holds what all grasps share: the stack, the
mean onset and build-up, the carrying loss, the depth, and ln h and ln e of each material.  Gauss-Newton
moves theta and all w at once.  The matrix is an arrow, a small block per grasp and a border for theta, so
the w are eliminated grasp by grasp:

    A_i = I + J_i' J_i,   S = P + sum_i K_i' K_i - K_i' J_i A_i^-1 J_i' K_i,   K_i = d(reading_i) / d theta.

After each step a spread is renewed as s^2 = sum(posterior mean^2 + posterior variance) / dof, one step of EM
for restricted likelihood: dof counts the grasps less the means fitted to them, and two for a first guess.
The noise is then found by maximum likelihood of the residuals with the nuisances marginalised, searched until
its slopes vanish, and the fit is repeated.  Priors of theta are wide; only ln e of each material leans on the
library, and the depth on the block's length.

What describes the gripper is learnt from all grasps, a block's finish (its ln h) from its own.  Grasps
without a label teach nothing and are refused: leave out what a classifier is later tested on.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.materials import Material, find_material
from thermogrip.datasets.schema import Grasps, log_name
from thermogrip.sysid.effusivity.calibration_fit import (
    Linearised,
    Problem,
    Spread,
    Step,
    joint_step,
    linearise,
    renew_spread,
)
from thermogrip.sysid.effusivity.calibration_prior import (
    anchors,
    device_theta,
    prior_of_device,
    wide_prior,
)
from thermogrip.sysid.effusivity.data import Noise, Touches, noise_fit, stack_touches, touches, whiten
from thermogrip.sysid.effusivity.gripper_model import (
    SHARED_NAMES,
    Block,
    Device,
    Knowledge,
    Spreads,
    block_names,
)

__all__ = ["calibrate_device", "calibrate_example_gripper"]

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]

_ROUNDS = 3  # of fit and noise
_STEPS = 40
_SETTLED = 0.05  # change of -2 ln evidence
_LEAST_FINISH = 0.2
# ln white, ln slow, ln memory, ln misfit, growth: about how well 200 grasps tell each; where they may be
_NOISE_STEPS = np.array([0.01, 0.1, 0.3, 0.1, 0.2])
_NOISE_RANGE = np.array([(-6.0, 0.0), (-8.0, 0.0), (-1.0, 4.0), (-9.0, -3.0), (0.0, 2.0)])
_NOISE_SEARCH, _NOISE_SLOPE = 300, 0.01  # steps at most, and nat per such step that end it


def calibrate_device(
    grasps: Sequence[Grasps],
    *,
    materials: Mapping[str, Material] | None = None,
    start: Device | None = None,
    prior: Device | None = None,
    block_length: float | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Device:
    """Return the device and populations that all labelled grasps support together.

    Parameters
    ----------
    grasps : sequence of Grasps
        Training grasps of all conditions, every one with a ``material``.
    materials : mapping of label to Material, optional
        Library rows of the labels; default the project's table.
    start : Device, optional
        An earlier calibration of this gripper.  A refit from it is quick and keeps its noise; it must not
        have seen the grasps that the refit is tested on where that matters.
    prior : Device, optional
        What is known before: an earlier calibration, with what is open in its ``knowledge``, or that of
        another gripper (:func:`~thermogrip.sysid.effusivity.gripper_model.another_gripper`).  The fit
        starts there and leans on it, so that a few grasps of one material suffice; its noise is kept, and so
        are its other blocks, and whether it is in doubt.
    block_length : float, optional
        Length of the blocks behind the contact face [m]; default 0.02, or that of ``prior``.
    seed : int, optional
        Unused by the deterministic fit; here so that every stage takes one.
    progress : callable, optional
        Called with (fraction done, what).

    Returns
    -------
    Device

    Raises
    ------
    UserError
        If there is no grasp, a grasp has no label, a material is not in the library, both ``start`` and
        ``prior`` are given, all grasps are of one material and there is no ``prior``, or no grasp has a known
        ``t_object``.

    Examples
    --------
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> file = load_example_grasps()["exp2_dT20"]
    >>> device = calibrate_device([file.isel(grasp=file["split"].values == "train")])
    >>> device.materials, bool(device.blocks["wood"].ln_h < device.blocks["copper"].ln_h)
    (('copper', 'iron', 'wood'), True)
    """
    if start is not None and prior is not None:
        raise UserError("both start and prior are given", hint="a prior is a start too: give it alone")
    data = _labelled(grasps, materials or {}, least=2 if prior is None else 1)
    length = block_length or (0.02 if prior is None else prior.block_length)
    problem = _problem(data, materials or {}, prior, length)
    earlier = start or prior
    theta, spread, noise = problem.prior.mean.copy(), dict(problem.prior.spread), Noise()
    if earlier is not None:
        theta = device_theta(earlier, problem.labels, theta)
        spread = {k: float(getattr(earlier.spreads, k)) for k in spread}
        noise = earlier.noise
    w = np.zeros((data.y.shape[0], 7))
    rounds = _ROUNDS if earlier is None else 1
    for i in range(rounds):
        last, w, spread = _fit(problem, theta, w, spread, noise, _reporter(progress, i, rounds))
        theta = last.theta
        if i < rounds - 1:
            noise = _fit_noise(problem, linearise(problem, theta, w, spread), w, noise)
    if progress is not None:
        progress(1.0, "calibrated")
    names = (*(() if prior is None else prior.trained_on), *(log_name(g) for g in grasps))
    return _device(problem, last, spread, noise, length, names, prior)


def calibrate_example_gripper(progress: Progress | None = None) -> Device:
    """Return the calibration of the bundled rig from the training grasps of exp1 to exp4 (195, in 20 s)."""
    from thermogrip.datasets.examples import load_example_grasps

    files = load_example_grasps()
    wanted = [files[name] for name in sorted(files) if name[:4] in ("exp1", "exp2", "exp3", "exp4")]
    return calibrate_device([g.isel(grasp=g["split"].values == "train") for g in wanted], progress=progress)


def _problem(
    data: Touches, materials: Mapping[str, Material], prior: Device | None, block_length: float
) -> Problem:
    touched = sorted(set(data.material.tolist()))
    library = {label: materials.get(label) or find_material(label) for label in touched}
    labels = touched if prior is None else sorted({*touched, *prior.materials})
    known = dict(zip(labels, anchors(labels, library, prior)))
    theta = wide_prior([*known.values()])
    if prior is not None:
        theta = prior_of_device(prior, labels, [*known.values()])
    return Problem.of(data, known, theta, block_length)


def _labelled(grasps: Sequence[Grasps], materials: Mapping[str, Material], least: int) -> Touches:
    if not grasps:
        raise UserError("no training grasps", hint="give at least one record with materials")
    parts = []
    for record in grasps:
        part = touches(record)
        if np.any(part.material == ""):
            lost = str(part.grasp_id[part.material == ""][0])
            raise UserError(
                f"grasp {lost!r} has no material", file=log_name(record), hint="label or remove it"
            )
        _check_labels(part, materials, log_name(record))
        parts.append(part)
    data = stack_touches(parts)
    if np.unique(data.material).size < least:
        raise UserError(
            f"all training grasps are of {str(data.material[0])!r}",
            file=log_name(grasps[0]),
            hint="give grasps of at least two materials, or a prior",
        )
    if not np.isfinite(data.t_object).any():
        raise UserError(
            "no training grasp has a known object temperature, so nothing tells how much of it the skin sees",
            file=log_name(grasps[0]),
            hint="fill in t_object_nominal_degC, if only of some",
        )
    return data


def _check_labels(part: Touches, materials: Mapping[str, Material], file: str) -> None:
    """Raise UserError, with file and grasp, at the first label that has no row to hold its scale to."""
    for label in dict.fromkeys(part.material.tolist()):
        try:
            materials.get(label) or find_material(label)
        except UserError as error:
            first = str(part.grasp_id[part.material == label][0])
            problem = f"grasp {first!r} is of {label!r}, which the materials table has not"
            hint = f"{error.hint} (every classifier but posterior takes any name)"
            raise UserError(problem, file=file, column="material", hint=hint) from error


def _reporter(progress: Progress | None, i: int, rounds: int) -> Progress:
    def report(fraction: float, what: str) -> None:
        if progress is not None:
            progress((i + fraction) / rounds, what)

    return report


def _fit(
    problem: Problem, theta: Array, w: Array, spread: Spread, noise: Noise, progress: Progress
) -> tuple[Step, Array, Spread]:
    """Alternate Gauss-Newton and EM until the evidence settles."""
    whitener, log_det = whiten(problem.data, noise)
    damping, before = 1e-3, np.inf
    for i in range(_STEPS):
        progress(i / _STEPS, f"gripper from {problem.which.size} grasps")
        step = joint_step(problem, theta, w, spread, whitener, damping)
        theta, damping = step.theta, step.damping
        spread, w = renew_spread(problem, spread, step.w, step.variance)
        value = step.objective + step.log_det + float(log_det.sum())
        if abs(before - value) < _SETTLED:
            break
        before = value
    return step, w, spread


def _fit_noise(problem: Problem, lin: Linearised, w: Array, noise: Noise) -> Noise:
    """Return the noise that makes the linearised residuals likeliest, nuisances marginalised."""
    data = problem.data
    there = data.count > 0
    j = lin.by_w * there[:, :, None]
    residual = (data.y - lin.y) * there + np.einsum("nik,nk->ni", j, w)
    outer = j @ j.transpose(0, 2, 1)

    def unpack(q: Array) -> Noise:
        white, slow, memory, misfit = np.exp(q[:4]).tolist()
        return Noise(white=white, slow=slow, memory=memory, misfit=misfit, growth=float(q[4]))

    def cost(q: Array) -> tuple[float, Array]:
        value, slopes = noise_fit(data, unpack(q), outer, residual)
        # weak priors keep what short records cannot tell in a sensible range
        value += 0.5 * (((q[2] - np.log(4)) / 0.7) ** 2 + ((q[4] - 0.5) / 0.5) ** 2)
        slopes[2] += (q[2] - np.log(4)) / 0.7**2
        slopes[4] += (q[4] - 0.5) / 0.5**2
        return value, slopes

    first = np.array([*np.log([noise.white, noise.slow, noise.memory, noise.misfit]), noise.growth])
    return unpack(_least(cost, first, n_grasp=data.level.size))


def _least(cost: Callable[[Array], tuple[float, Array]], first: Array, n_grasp: int) -> Array:
    """Return where the cost of a noise is least, (5,); ``cost`` gives its slopes too."""

    def scaled(z: Array) -> tuple[float, Array]:
        value, slopes = cost(z * _NOISE_STEPS)
        return value, slopes * _NOISE_STEPS

    # ftol 0: the slopes alone say when it is over
    best = minimize(
        scaled,
        first / _NOISE_STEPS,
        jac=True,
        method="L-BFGS-B",
        bounds=_NOISE_RANGE / _NOISE_STEPS[:, None],
        options={"maxiter": _NOISE_SEARCH, "ftol": 0.0, "gtol": _NOISE_SLOPE},
    )
    if not best.success:
        warnings.warn(
            f"the search for the noise of {n_grasp} grasps ended after {best.nit} steps before it settled "
            f"(slope {np.abs(best.jac).max():.2g}, wanted {_NOISE_SLOPE:g}): {best.message}",
            RuntimeWarning,
            stacklevel=4,
        )
    return np.asarray(best.x * _NOISE_STEPS)


def _device(
    problem: Problem,
    step: Step,
    spread: Spread,
    noise: Noise,
    block_length: float,
    names: tuple[str, ...],
    prior: Device | None,
) -> Device:
    theta = step.theta
    shared = {name: float(theta[problem.index(name)]) for name in ("onset", "carry", "bias", "ln_depth")}
    n = len(problem.labels)
    # given the gripper: the scale that all blocks share is no news about one of them
    own = np.sqrt(np.diag(np.linalg.inv(step.precision[-2 * n :, -2 * n :])))
    before = {} if prior is None else {label: block.n_grasp for label, block in prior.blocks.items()}
    count = [int((problem.which == k).sum()) + before.get(label, 0) for k, label in enumerate(problem.labels)]
    blocks = {
        label: Block(
            ln_h=float(problem.ln_h(theta)[k]),
            ln_h_sd=float(spread["ln_h"] / np.sqrt(count[k])),
            ln_effusivity=float(problem.ln_e(theta)[k]),
            ln_effusivity_sd=float(own[n + k]),
            library_effusivity=float(row.effusivity),
            library_sd_ln=float(row.sd_ln),
            heat_capacity=float(row.heat_capacity),
            n_grasp=count[k],
        )
        for k, (label, row) in enumerate(zip(problem.labels, problem.library))
    }
    slope, level, left = _finish_line(blocks)
    return Device(
        stack=problem.stack(theta),
        noise=noise,
        spreads=Spreads(
            **spread, finish=left, dof=problem.dof("ln_h"), insulator_dof=problem.dof("ln_effusivity")
        ),
        onset=shared["onset"],
        carry=shared["carry"],
        bias=shared["bias"],
        depth_share=float(np.exp(shared["ln_depth"])),
        block_length=block_length,
        finish_level=level,
        finish_slope=slope,
        blocks=blocks,
        trained_on=names,
        knowledge=_knowledge(problem, step),
        in_doubt=prior is not None and prior.in_doubt,
    )


def _knowledge(problem: Problem, step: Step) -> Knowledge:
    covariance = np.linalg.inv(step.precision)
    names = (*SHARED_NAMES, *block_names(problem.labels))
    return Knowledge(names, 0.5 * (covariance + covariance.T))


def _finish_line(blocks: Mapping[str, Block]) -> tuple[float, float, float]:
    """Return slope, level at ln e = 9 and sd of ln h against ln e; a shallow slope is preferred."""
    x = np.array([b.ln_effusivity for b in blocks.values()]) - 9.0
    y = np.array([b.ln_h for b in blocks.values()])
    design = np.stack([x, np.ones_like(x)], axis=1)
    slope, level = np.linalg.solve(design.T @ design + np.diag([0.2**2 / 0.2**2, 0.0]), design.T @ y)
    left = y - design @ np.array([slope, level])
    return (
        float(slope),
        float(level),
        max(_LEAST_FINISH, float(np.sqrt((left**2).sum() / max(1, y.size - 2)))),
    )
