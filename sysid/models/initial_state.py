"""The state at the start of a free run, from the readings of a short warm-up.

A log seldom begins where the model would: the state is unknown, and the sensors are off by some amount o
that is constant over the log.  With x0 = x_rest + s, s ~ N(0, P), o ~ N(0, q^2) and white reading noise r,
the readings of the warm-up are linear in (s, o), so their posterior mean is a ridge regression.  P comes
from the data of the fit; (r, q) decide how a first error is shared between state and sensor, and so how
fast it fades.  They cannot be read off one-step errors; they are chosen, like the orders, by held-out free
run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thermogrip.sysid.models.lti import covariance_root

if TYPE_CHECKING:
    from thermogrip.sysid.models.model import Model

__all__ = ["StartPrior", "estimate_starts"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StartPrior:
    """Noise of a reading and spread of a sensor's offset, in units of the output's standard deviation."""

    noise: float = 0.1  # r, per row of the warm-up
    nuisance: float = 0.0  # q; 0 means that sensors have no offset of their own


def estimate_starts(
    model: Model, y: Array, u: Array, d: Array, *, dt: float, scale: Array, priors: Sequence[StartPrior]
) -> tuple[Array, Array]:
    """Return the start for each prior."""
    n_y = y.shape[1]
    first = y[np.argmax(np.isfinite(y), axis=0), np.arange(n_y)]  # NaN where a channel is lost
    rest = model.rest(first, u.mean(axis=0), d.mean(axis=0), ())
    known = np.isfinite(y)
    if not known.any():
        return np.tile(rest, (len(priors), 1)), np.zeros((len(priors), n_y))
    root = covariance_root(model.spread)
    seen = model.rollout(np.vstack([rest, rest + root.T]), u[None], d[None], (), dt)[0][:, :-1]
    if not np.isfinite(seen).all():  # equations that diverge within the warm-up
        return np.tile(rest, (len(priors), 1)), np.zeros((len(priors), n_y))
    weight = np.broadcast_to(1 / scale, y.shape)[known]
    by_state = (seen[1:] - seen[0])[:, known].T * weight[:, None]
    by_offset = np.broadcast_to(np.eye(n_y), (len(y), n_y, n_y))[known] * (scale * weight[:, None])
    miss = (y - seen[0])[known] * weight
    r, q = (np.array([getattr(prior, name) for prior in priors]) for name in ("noise", "nuisance"))
    n, n_s = len(miss), root.shape[1]
    # the prior as rows of their own: squares of a nearly unstable model's slopes would swamp it
    rows = np.zeros((len(priors), n + n_s + n_y, n_s + n_y))
    rows[:, :n, :n_s] = by_state / r[:, None, None]
    rows[:, :n, n_s:] = by_offset * (q / r)[:, None, None]
    rows[:, n:] = np.eye(n_s + n_y)
    orthogonal, triangle = np.linalg.qr(rows)
    right = np.einsum("bnk,n->bk", orthogonal[:, :n], miss) / r[:, None]
    z = np.linalg.solve(triangle, right[:, :, None])[:, :, 0]
    return rest + z[:, :n_s] @ root.T, q[:, None] * scale * z[:, n_s:]
