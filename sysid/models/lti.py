"""Linear algebra of discrete state-space models: products of inputs, state at the start.

**Start.**  A log seldom begins where the model would: the state is unknown, and the sensors are off by some
amount o that is constant over the log.  With x0 = x_rest + s, s ~ N(0, P), o ~ N(0, q^2) and white reading
noise r, the readings of the warm-up are linear in (s, o), so their posterior mean is a ridge regression.  P
comes from the data of the fit; (r, q) decide how a first error is shared between state and sensor, and so how
fast it fades.  They cannot be read off one-step errors; they are chosen, like the orders, by held-out free
run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from thermogrip.datasets.arrays import Array, Values
from thermogrip.datasets.errors import UserError

if TYPE_CHECKING:
    from thermogrip.sysid.models.model import Model


def products(terms: Sequence[str], names: Sequence[str], signals: Sequence[Any]) -> list[Any]:
    """Return the products ``terms`` of the signals ``names`` (numbers, columns or symbols)."""
    out = []
    for factors in read_terms(terms, names):
        value: Any = 1.0
        for index, magnitude in factors:
            value = value * (abs(signals[index]) if magnitude else signals[index])
        out.append(value)
    return out


def evaluate_terms(terms: Sequence[str], names: Sequence[str], rows: Array) -> Array:
    """Return the products ``terms`` of the columns ``names``."""
    columns = products(terms, names, list(np.moveaxis(rows, -1, 0)))
    return np.stack(columns, axis=-1) if columns else np.ones((*rows.shape[:-1], 0))


def constrained_lstsq(rows: Array, right: Array, fixed: Array, value: Array) -> Array:
    """Return the z of least |rows z - right| with fixed z = value (least squares where that conflicts)."""
    z, *_ = np.linalg.lstsq(fixed, value, rcond=None) if len(value) else (np.zeros(rows.shape[1]),)
    _, sizes, vh = np.linalg.svd(fixed)
    rank = int(np.sum(sizes > 1e-10 * max(1e-300, float(sizes.max(initial=0.0)))))
    free = vh[rank:].T
    move, *_ = np.linalg.lstsq(rows @ free, right - rows @ z, rcond=None)
    return np.asarray(z + free @ move)


def symmetric_root(covariance: Array) -> Array:
    """Return R with R R' = covariance, one column an axis; a variance lost to rounding is 0."""
    size, axes = np.linalg.eigh(covariance)
    return np.asarray(axes * np.sqrt(np.maximum(size, 0.0)))


def read_terms(terms: Sequence[str], names: Sequence[str]) -> list[list[tuple[int, bool]]]:
    """Read each term as a list of (column, whether its magnitude is meant)."""
    out = []
    for term in terms:
        words = term.split("*")
        bare = [word.strip("|") for word in words]
        unknown = [word for word in bare if word not in names]
        if unknown:
            raise ValueError(f"term {term!r} names {unknown[0]!r}, which is not among {', '.join(names)}")
        out.append([(list(names).index(name), word.startswith("|")) for name, word in zip(bare, words)])
    return out


def join_columns(u: Array, d: Array) -> Array:
    """Return u and d side by side in the last axis, batches broadcast against each other."""
    shape = np.broadcast_shapes(u.shape[:-1], d.shape[:-1])
    return np.concatenate(
        [np.broadcast_to(columns, (*shape, columns.shape[-1])) for columns in (u, d)], axis=-1
    )


def whole_steps(dt: float, own: float) -> int:
    """Return ``dt`` [s] in steps of ``own``, or refuse it."""
    times = round(dt / own)
    if times < 1 or abs(times * own - dt) > 1e-6 * dt:
        problem = f"{dt:g} s is no whole multiple of the plant's step"
        raise UserError(problem, hint=f"take a multiple of {own:g} s")
    return times


def dot(row: Array, values: Values) -> Any:
    """Return the dot product without the zero entries, so that symbolic graphs stay small."""
    total: Any = 0.0
    for i in np.flatnonzero(row):
        total = total + float(row[i]) * values[int(i)]
    return total


def first_readings(y: Array) -> Array:
    """Return the first reading (n_y,) of each output of y (n, n_y), NaN where it has none."""
    return np.asarray(y[np.argmax(np.isfinite(y), axis=0), np.arange(y.shape[1])])


@dataclass(frozen=True)
class StartPrior:
    """Noise of a reading and spread of a sensor's offset, in units of the output's standard deviation."""

    noise: float = 0.1  # r, per row of the warm-up
    nuisance: float = 0.0  # q; 0 means that sensors have no offset of their own
    memory: float = np.inf  # [s] in which an offset falls to 1/e


def estimate_starts(
    model: Model, y: Array, u: Array, d: Array, *, dt: float, scale: Array, priors: Sequence[StartPrior]
) -> tuple[Array, Array]:
    """Return the start for each prior."""
    n_y = y.shape[1]
    x_rest = model.rest(first_readings(y), u.mean(axis=0), d.mean(axis=0), ())
    is_read = np.isfinite(y)
    if not is_read.any():
        return np.tile(x_rest, (len(priors), 1)), np.zeros((len(priors), n_y))
    root = symmetric_root(model.spread)
    runs = model.rollout(np.vstack([x_rest, x_rest + root.T]), u[None], d[None], (), dt)[0][:, :-1]
    if not np.isfinite(runs).all():  # equations that diverge within the warm-up
        return np.tile(x_rest, (len(priors), 1)), np.zeros((len(priors), n_y))
    weight = np.broadcast_to(1 / scale, y.shape)[is_read]
    by_state = (runs[1:] - runs[0])[:, is_read].T * weight[:, None]
    by_offset = np.broadcast_to(np.eye(n_y), (len(y), n_y, n_y))[is_read] * (scale * weight[:, None])
    miss = (y - runs[0])[is_read] * weight
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
    return x_rest + z[:, :n_s] @ root.T, q[:, None] * scale * z[:, n_s:]
