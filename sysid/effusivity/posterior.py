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
from scipy.special import softmax

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.grasp_files import Records, as_grasps
from thermogrip.datasets.schema import has_touch_groups
from thermogrip.sysid.contact.materials import Material
from thermogrip.sysid.effusivity.data import touches
from thermogrip.sysid.effusivity.gripper_model import INSULATOR, GripperModel
from thermogrip.sysid.effusivity.laplace_approximation import T_OBJECT, fit_candidates
from thermogrip.sysid.effusivity.multi_touch import Coupling, free_touch_fit, touch_groups
from thermogrip.sysid.effusivity.posterior_grid import GridPosterior, grid_posteriors, mixture_quantiles

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


@dataclass(frozen=True)
class MaterialFit:
    """What each candidate makes of each grasp, all of shape (n_grasp, n_candidate)."""

    log_evidence: Array
    t_object: Array  # the object's temperature under the candidate [degC]
    t_object_sd: Array  # [K]
    u: Array  # (n_grasp, n_candidate, 7), the modes of the nuisances

    @property
    def probabilities(self) -> Array:
        """Probabilities of the candidates at equal prior odds, (n_grasp, n_candidate)."""
        return np.asarray(softmax(self.log_evidence, 1))


def material_fit(
    gripper: GripperModel,
    grasps: Grasps,
    candidates: Sequence[str | Material],
    *,
    until: float | None = None,
    start: Array | None = None,
) -> MaterialFit:
    """Return the fit of each candidate to each grasp.

    Candidates are labels that the gripper was calibrated with, or names or rows of the library, whose contact
    conductance is not known; one that is nowhere known or named twice raises a UserError.  Samples after
    ``until`` [s] are left out; ``start`` (n_grasp, n_candidate, 7) is ``u`` of a fit to fewer readings, from
    which the same answer is found sooner.  Without a ``t_object`` its prior is wide, without its sd that is
    the spread of the training grasps.
    """
    data = touches(grasps, until=until)
    mode = fit_candidates(gripper, data, candidates, start=start).mode
    n, m = data.level.size, len(candidates)
    return MaterialFit(
        log_evidence=mode.log_evidence.reshape(n, m),
        t_object=mode.u[:, T_OBJECT].reshape(n, m),
        t_object_sd=np.sqrt(mode.covariance[:, T_OBJECT, T_OBJECT]).reshape(n, m),
        u=mode.u.reshape(n, m, -1),
    )


def effusivity_posterior(
    gripper: GripperModel, grasps: Records, *, until: float | None = None, coupling: Coupling | None = None
) -> list[EffusivityRow]:
    """Return one row a grasp: effusivity, object temperature and contact conductance, no material assumed.

    The prior of the effusivity is log-uniform between 17 and 100 000; an interval that ends near there is
    bounded by it, as copper's often is.  The result is divided by the scale that the calibration's blocks
    show against the library, whose uncertainty widens the interval; so does an insulator's own scatter.
    Touches of one ``touch_group`` share the joint posterior of the effusivity; each row has the object's
    temperature at its own touch.

    Arguments are those of :func:`material_fit`; ``coupling`` is how blocks move between touches, by default
    those of the example rig.
    """
    (grasps,) = as_grasps(grasps)
    rows = touch_groups(grasps) if has_touch_groups(grasps) else {}
    alone = np.setdiff1d(np.arange(grasps.sizes["grasp"]), np.concatenate([[], *rows.values()]).astype(int))
    posterior_of: dict[int, GridPosterior] = {}
    if alone.size:
        single = grid_posteriors(gripper, touches(grasps, until=until, at=alone))
        posterior_of |= dict(zip(alone.tolist(), single))
    if rows:
        for name, fits in free_touch_fit(gripper, grasps, coupling=coupling, until=until).items():
            posterior_of |= dict(zip(rows[name].tolist(), fits))
    return [
        _effusivity_row(gripper, str(name), posterior_of[i]) for i, name in enumerate(grasps["grasp"].values)
    ]


_QUANTILES = (0.05, 0.5, 0.95)


def _effusivity_row(gripper: GripperModel, name: str, found: GridPosterior) -> EffusivityRow:
    scale, scale_sd = gripper.effusivity_scale(found.x)
    scatter = np.where(np.exp(found.x) < INSULATOR, gripper.spreads.ln_effusivity, 0.0)
    ln_e, sd = found.x - scale, np.sqrt(scale_sd**2 + scatter**2 + 1e-8)
    low, middle, high = np.exp(mixture_quantiles(found.mass, ln_e, sd, _QUANTILES)).tolist()
    variance = found.mass @ ((ln_e - found.mass @ ln_e) ** 2 + sd**2)
    t = np.array(mixture_quantiles(found.weight, found.t_object, found.t_object_sd, _QUANTILES))
    if gripper.discrepancy is not None:  # it has no scale of its own: that of the stated temperatures
        t = t - gripper.bias
    return EffusivityRow(
        grasp_id=name, effusivity=middle, effusivity_p05=low, effusivity_p95=high, t_object=float(t[1]),
        t_object_p05=float(t[0]), t_object_p95=float(t[2]),
        h_c=float(np.exp(found.weight @ found.ln_h)),
        log10_effusivity_sd=float(np.sqrt(variance) / np.log(10)),
    )  # fmt: skip
