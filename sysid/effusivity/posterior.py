"""From grasps to materials and effusivities: the posterior engine.

The calibrated gripper (:class:`~thermogrip.sysid.effusivity.gripper_model.GripperModel`) predicts the
readings of a grasp from seven unknowns, and Bayes' rule does the rest (``docs/explanation/effusivity.md``):
a **material** fixes effusivity and contact conductance up to their spread; an **effusivity** posterior
leaves the material open, with a log-uniform prior; an **unknown material** is recognised by the ratio of
the two evidences, since a posterior over known materials is most confident where none of them fits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import expit, logit, softmax

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.grasp_files import Records, as_grasps
from thermogrip.datasets.materials import Material
from thermogrip.datasets.schema import has_touch_groups
from thermogrip.sysid.effusivity.data import Touches, touches
from thermogrip.sysid.effusivity.gripper_model import (
    ANOTHER_SCALE_SD,
    INSULATOR,
    GripperModel,
    another_gripper,
)
from thermogrip.sysid.effusivity.laplace_approximation import T_OBJECT, H, fit_candidates
from thermogrip.sysid.effusivity.multi_touch import Coupling, free_touch_fit, touch_groups
from thermogrip.sysid.effusivity.posterior_grid import (
    GridPosterior,
    grid_posteriors,
    mixed,
    mixture_quantiles,
    rough_evidence,
)

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Grasps


@dataclass(frozen=True)
class EffusivityRow:
    """One grasp's posterior, one row of ``posterior.csv``."""

    grasp_id: str
    effusivity: float  # median [W s^0.5 m^-2 K^-1], on the library's scale
    effusivity_p05: float  # 5 % quantile
    effusivity_p95: float  # 95 % quantile
    t_object: float  # median of the object's temperature [degC]
    t_object_p05: float
    t_object_p95: float
    h_c: float  # posterior mean of ln h as a conductance [W m^-2 K^-1]
    log10_effusivity_sd: float
    other_gripper: float = 0.0  # probability that another gripper than the calibrated one took it


@dataclass(frozen=True)
class MaterialFit:
    """What each candidate makes of each grasp, all of shape (n_grasp, n_candidate)."""

    log_evidence: Array
    t_object: Array  # the object's temperature under the candidate [degC]
    t_object_sd: Array  # [K]
    prior_t_object: Array  # its prior mean, which a caller may replace (two touches of one block) [degC]
    prior_t_object_sd: Array  # [K]
    h_c: Array  # [W m^-2 K^-1]
    converged: Mask
    u: Array  # (n_grasp, n_candidate, 7), the modes of the nuisances


def material_fit(
    gripper: GripperModel, grasps: Grasps, candidates: Sequence[str | Material], *, finish: str = "known",
    until: float | None = None, start: Array | None = None,
) -> MaterialFit:  # fmt: skip
    """Return the fit of each candidate to each grasp.

    Candidates are labels that the gripper was calibrated with, or names or rows of the library, whose contact
    conductance is not known; one that is nowhere known or named twice raises a UserError.  ``finish`` says
    whether the blocks are those of the calibration ("known") or others of the same materials ("unknown");
    samples after ``until`` [s] are left out; ``start`` (n_grasp, n_candidate, 7) is ``u`` of a fit to fewer
    readings, from which the same answer is found sooner.  Without a ``t_object`` its prior is wide, without
    its sd that is the spread of the training grasps.
    """
    data = touches(grasps, until=until)
    mode, prior, _ = fit_candidates(gripper, data, candidates, finish, start=start)
    n, m = data.level.size, len(candidates)
    return MaterialFit(
        log_evidence=mode.log_evidence.reshape(n, m), t_object=mode.u[:, T_OBJECT].reshape(n, m),
        t_object_sd=np.sqrt(mode.covariance[:, T_OBJECT, T_OBJECT]).reshape(n, m),
        prior_t_object=prior.mean[:, T_OBJECT].reshape(n, m),
        prior_t_object_sd=prior.sd[:, T_OBJECT].reshape(n, m), h_c=np.exp(mode.u[:, H]).reshape(n, m),
        converged=mode.converged.reshape(n, m), u=mode.u.reshape(n, m, -1),
    )  # fmt: skip


def material_evidence(
    gripper: GripperModel, grasps: Grasps, candidates: Sequence[str | Material], *, finish: str = "known",
    until: float | None = None,
) -> Array:  # fmt: skip
    """Return the log evidence of each candidate for each grasp, shape (n_grasp, n_candidate), with the
    arguments of :func:`material_fit`."""
    return material_fit(gripper, grasps, candidates, finish=finish, until=until).log_evidence


def material_posterior(
    gripper: GripperModel, grasps: Grasps, candidates: Sequence[str | Material], *, finish: str = "known",
    until: float | None = None,
) -> Array:  # fmt: skip
    """Return probabilities of the candidates, (n_grasp, n_candidate), at equal prior odds; rows sum to 1."""
    evidence = material_evidence(gripper, grasps, candidates, finish=finish, until=until)
    return np.asarray(softmax(evidence, 1))


def effusivity_posterior(
    gripper: GripperModel, grasps: Records, *, until: float | None = None, coupling: Coupling | None = None,
    other_gripper: float = 0.0,
) -> list[EffusivityRow]:  # fmt: skip
    """Return one row a grasp: effusivity, object temperature and contact conductance, no material assumed.

    The prior of the effusivity is log-uniform between 17 and 110 000 on the gripper's scale, from plastic
    foam to diamond with room for the scale's own error; an interval that ends near there is bounded by the
    prior, as copper's often is.  The result is divided by the scale
    that the calibration's blocks show against the library, whose uncertainty widens the interval; so does
    an insulator's own scatter from grasp to grasp.  Touches of one ``touch_group`` share the joint posterior
    of the effusivity; each row has the object's temperature at its own touch.

    Arguments are those of :func:`material_fit`; ``coupling`` is how blocks move between touches, by default
    those of the example rig; ``other_gripper`` the probability, before the grasps are seen, that another
    gripper of its kind took them: three single touches or more are answered by both, as likely as each
    explains them all, and another one's scale of effusivities, which no block anchors, is known to 0.6 in the
    logarithm.
    """
    (grasps,) = as_grasps(grasps)
    rows = touch_groups(grasps) if has_touch_groups(grasps) else {}
    alone = np.setdiff1d(np.arange(grasps.sizes["grasp"]), np.concatenate([[], *rows.values()]).astype(int))
    found: dict[int, GridPosterior] = {}
    share = 0.0
    if alone.size:
        data = touches(grasps.isel(grasp=alone) if rows else grasps, until=until)
        single = grid_posteriors(gripper, data)
        if other_gripper > 0 and alone.size >= _SEVERAL:
            single, share = _by_either(gripper, data, single, other_gripper)
        found |= dict(zip(alone.tolist(), single))
    if rows:
        for name, fits in free_touch_fit(gripper, grasps, coupling=coupling, until=until).items():
            found |= dict(zip(rows[name].tolist(), fits))
    names = [str(name) for name in grasps["grasp"].values]
    shares = np.where(np.isin(np.arange(len(names)), alone), share, 0.0)
    return _rows(gripper, names, [found[i] for i in range(len(names))], shares)


_SEVERAL = 3  # single touches, from which on they decide whether another gripper took them
# grasps about which another gripper is asked one by one, until it is so unlikely, and when nobody asks more
_ASKED, _HARDLY, _UNLIKELY = 5, 0.001, 0.01


def _by_either(
    gripper: GripperModel, data: Touches, own: list[GridPosterior], prior: float
) -> tuple[list[GridPosterior], float]:
    """Return the posteriors of touches that one gripper took, the calibrated one or another, and how likely
    it was another."""
    other, n = another_gripper(gripper), len(own)
    odds = prior_odds = float(logit(prior))
    for i in np.unique(np.linspace(0, n - 1, min(n, _ASKED)).astype(int)):
        if expit(odds) > _HARDLY:
            odds += float(rough_evidence(other, data.take(np.array([i])))[0]) - own[i].log_evidence
    if (share := float(expit(odds))) < _UNLIKELY:
        return own, share
    fits = grid_posteriors(other, data)
    theirs = [fit._replace(x_sd=np.full(fit.x.size, ANOTHER_SCALE_SD)) for fit in fits]
    odds = prior_odds + sum(fit.log_evidence - one.log_evidence for fit, one in zip(theirs, own))
    if (share := float(expit(odds))) < _UNLIKELY:
        return own, share
    odds_of = np.log([max(1 - share, 1e-300), share])
    return [mixed([one, theirs[i]], odds_of) for i, one in enumerate(own)], share


_LEVELS = (0.05, 0.5, 0.95)


def _rows(
    gripper: GripperModel, names: Sequence[str], found: Sequence[GridPosterior], share: Array
) -> list[EffusivityRow]:
    x, mass, more = (_padded([np.asarray(p[k]) for p in found], edge=k != 1) for k in (0, 1, 7))
    scale, scale_sd = gripper.effusivity_scale(x)
    scatter = np.where(np.exp(x) < INSULATOR, gripper.spreads.ln_effusivity, 0.0)
    x, sd = x - scale, np.sqrt(scale_sd**2 + scatter**2 + more**2 + 1e-8)
    e = np.exp(mixture_quantiles(mass, x, sd, _LEVELS))
    mean = (mass * x).sum(axis=1)
    variance = (mass * ((x - mean[:, None]) ** 2 + sd**2)).sum(axis=1)
    weight, t_object, t_sd, ln_h = (
        _padded([np.asarray(p[k]) for p in found], edge=k != 3) for k in (3, 4, 5, 6)
    )
    t = mixture_quantiles(weight, t_object, t_sd, _LEVELS)
    if gripper.discrepancy is not None:  # it has no scale of its own: that of the temperatures it was told
        t = t - gripper.bias
    h_c, spread = np.exp((weight * ln_h).sum(axis=1)), np.sqrt(variance) / np.log(10)
    return [
        EffusivityRow(
            grasp_id=name, effusivity=float(e[i, 1]), effusivity_p05=float(e[i, 0]),
            effusivity_p95=float(e[i, 2]), t_object=float(t[i, 1]), t_object_p05=float(t[i, 0]),
            t_object_p95=float(t[i, 2]), h_c=float(h_c[i]), log10_effusivity_sd=float(spread[i]),
            other_gripper=float(share[i]),
        )
        for i, name in enumerate(names)
    ]  # fmt: skip


def _padded(parts: Sequence[Array], *, edge: bool) -> Array:
    """Return arrays (m,) as one (n, longest), padded with their last values or with zeros."""
    out = np.zeros((len(parts), max(part.size for part in parts)))
    for row, part in zip(out, parts):
        row[: part.size] = part
        if edge:
            row[part.size :] = part[-1]
    return out
