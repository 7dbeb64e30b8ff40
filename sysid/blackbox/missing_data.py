"""Expected sums of a regression on past readings of which some were lost.

A regression of y[k] on y[k-1] ... y[k-na] and past drives needs every one of them, and a row is broken as
soon as any of its readings was lost.  With Gaussian noise the lost ones have a distribution given all that
was read, before and after, and the normal equations need its first two moments,

    E[X'X] = X^'X^ + sum_t cov(x_t),        E[X'y] = X^'y^ + sum_t cov(x_t, y_t),

X^ the mean.  The moments follow from the regression, by a Kalman smoother over the state [y[t], ...,
y[t-na]], and the regression from the moments.  In turn they climb to the greatest likelihood of what was
read, and no step lowers it (the EM algorithm: Shumway and Stoffer, J. Time Series Analysis 3 (1982); for
ARX models Isaksson, IEEE Trans. Automatic Control 38 (1993)).  A line through the holes is where it
begins; nothing of it is left at the end.

The covariances are what a filled hole lacks: without them a smooth filling resembles a plant without
noise, and biases the poles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.sysid.blackbox.order_selection import column_sizes
from thermogrip.sysid.plant.log_grid import Segment

MANY = 0.005  # of the rows lack a reading: below it they are left out, for little is lost with them
ENOUGH = 0.02  # of ln p: a round that gains less is the last one
ROUNDS = 60
_GUESSES = 5  # rounds that a first guess is worth
_FLOOR = 1e-10  # variance of an innovation in that of the output: a noise-free record has none


@dataclass(frozen=True, eq=False)
class Moments:
    """Sums over the rows of a regression, in the units of the readings."""

    gram: Array  # E[X'X], columns lag by lag [past y | switch x past y | past w | 1]
    cross: Array  # E[X'Y], (n_column, n_y)
    read: int  # number of readings used
    log_likelihood: tuple[float, ...]  # ln p of the readings after each round


def expected_moments(
    segments: Sequence[Segment], w: Sequence[Array], on: Sequence[Array], *, past_y: int, past_w: int
) -> Moments:
    """Return the moments of the regression on ``past_y`` readings and ``past_w`` drives."""
    depth = max(past_y, past_w)
    parts = [trio for trio in zip(segments, w, on) if len(trio[0].time) > depth + 1]
    em = _Em(parts, past_y, depth)
    smoothed, history = em.bridged(), [-np.inf]
    for _ in range(ROUNDS):
        smoothed, ln_p = em.smoothed(*em.solved(*em.sums(smoothed)))
        history.append(ln_p)
        if ln_p - history[-2] < ENOUGH:
            break
    gram, cross, _ = em.sums(smoothed, natural=True)
    return Moments(gram, cross, em.read, tuple(history[1:]))


def fill_readings(segments: Sequence[Segment], w: Sequence[Array], *, past: int = 4) -> list[Array]:
    """Return readings (n, n_y) with the mean of each lost one given all others, for a first guess."""
    none = [np.zeros((len(segment.time), 0)) for segment in segments]
    parts = [trio for trio in zip(segments, w, none) if len(trio[0].time) > past + 1]
    em = _Em(parts, past, past)
    smoothed = em.bridged()
    columns = past * (em.n_y + w[0].shape[1]) + 1
    for _ in range(_GUESSES if em.read > 2 * em.n_y * columns else 0):
        smoothed, _ = em.smoothed(*em.solved(*em.sums(smoothed)))
    means = iter(em.lines(smoothed))
    return [next(means) if len(s.time) > past + 1 else s.y for s in segments]


class _Em:
    """The two halves of a round, in units of the spread."""

    def __init__(self, parts: Sequence[tuple[Segment, Array, Array]], na: int, depth: int) -> None:
        y = np.concatenate([segment.y for segment, _, _ in parts])
        w = np.concatenate([drive for _, drive, _ in parts])
        self.middle, self.size = np.nanmean(y, axis=0), np.maximum(np.nanstd(y, axis=0), 1e-9)
        self.centre, self.reach = w.mean(axis=0), np.where(w.std(axis=0) > 1e-9, w.std(axis=0), 1.0)
        self.na, self.depth, self.n_y = na, depth, len(self.size)
        self.y = [(segment.y - self.middle) / self.size for segment, _, _ in parts]
        self.w = [drive for _, drive, _ in parts]
        self.on = [some for _, _, some in parts]
        self.read = sum(int(np.isfinite(some[depth:]).sum()) for some in self.y)

    def lines(self, smoothed: Sequence[tuple[Array, Array]]) -> list[Array]:
        """Return the means (n, n_y) in the readings' units, lines where no regression reaches."""
        first = [z[0, self.n_y :].reshape(-1, self.n_y)[::-1] for z, _ in self.bridged()]
        whole = [np.vstack([head, z[:, : self.n_y]]) for head, (z, _) in zip(first, smoothed)]
        return [self.middle + self.size * part for part in whole]

    def bridged(self) -> list[tuple[Array, Array]]:
        """Return means (n - depth, n_z) and no covariances: lines through the holes, however long."""
        out = []
        for y in self.y:
            rows = np.arange(len(y))
            known = np.isfinite(y)
            lines = [np.interp(rows, rows[k], v[k]) if k.any() else 0 * rows for k, v in zip(known.T, y.T)]
            filled, n = np.stack(lines, axis=1), len(y) - self.depth
            z = np.hstack([filled[self.depth - lag : len(y) - lag] for lag in range(self.na + 1)])
            out.append((z, np.zeros((n, z.shape[1], z.shape[1]))))
        return out

    def sums(
        self, smoothed: Sequence[tuple[Array, Array]], *, natural: bool = False
    ) -> tuple[Array, Array, Array]:
        """Return E[X'X], E[X'Y] and E[Y'Y]."""
        p, end = self.n_y, self.na * self.n_y
        width = self.depth * p
        n_all = width * (1 + self.on[0].shape[1]) + self.depth * self.w[0].shape[1] + 1
        gram, cross, square = np.zeros((n_all, n_all)), np.zeros((n_all, p)), np.zeros((p, p))
        for (z, V), w, on in zip(smoothed, self.w, self.on):
            if natural:
                size = np.tile(self.size, self.na + 1)
                z, V = z * size + np.tile(self.middle, self.na + 1), V * size * size[:, None]
            else:
                w = (w - self.centre) / self.reach
            X, factors = self._columns(z, w, on)
            gram, cross, square = gram + X.T @ X, cross + X.T @ z[:, :p], square + z[:, :p].T @ z[:, :p]
            for i, f in enumerate(factors.T):
                at = slice(i * width, i * width + end)
                cross[at] += np.einsum("t,tab->ab", f, V[:, p:, :p])
                for j, g in enumerate(factors.T):
                    gram[at, j * width : j * width + end] += np.einsum("t,tab->ab", f * g, V[:, p:, p:])
            square += V[:, :p, :p].sum(axis=0)
        return gram, cross, square

    def solved(self, gram: Array, cross: Array, square: Array) -> tuple[Array, Array]:
        """Return the regression (n_column, n_y) and the covariance of its innovations."""
        size = column_sizes(np.sqrt(np.diag(gram)))
        beta = np.linalg.lstsq(gram / size / size[:, None], cross / size[:, None], rcond=1e-12)[0]
        beta = beta / size[:, None]
        rows = sum(len(y) - self.depth for y in self.y)
        noise = (square - beta.T @ cross - cross.T @ beta + beta.T @ gram @ beta) / rows
        return beta, noise + _FLOOR * np.eye(self.n_y)

    def smoothed(self, beta: Array, noise: Array) -> tuple[list[tuple[Array, Array]], float]:
        """Return mean and covariance of [y[t], ..., y[t-na]] at each row, and ln p of what was read."""
        from thermogrip.sysid.blackbox.kalman_kernel import run_filter, run_smoother  # pulls in numba

        p, n, depth = self.n_y, (self.na + 1) * self.n_y, self.depth
        Q, S, R = np.zeros((n, n)), np.zeros((n, p)), np.zeros((p, p))
        Q[:p, :p], C, out, total = noise, np.eye(p, n), [], 0.0
        for y, w, on in zip(self.y, self.w, self.on):
            places, at = np.unique(on[depth - 1 : -1], axis=0, return_inverse=True)
            A, at = self._transitions(beta, places), np.ascontiguousarray(at.ravel(), dtype=np.int64)
            push = np.zeros((len(y) - depth, n))
            first = depth * p * (1 + on.shape[1])
            late = self._late((w - self.centre) / self.reach)
            push[:, :p] = np.hstack([late, np.ones((len(late), 1))]) @ beta[first:]
            past = np.concatenate([y[depth - 1 - lag] for lag in range(self.na)] + [np.zeros(p)])
            variance = np.diag((~np.isfinite(past)).astype(float))  # lost: anywhere in the output's spread
            x0 = A[at[0]] @ np.nan_to_num(past) + push[0]
            P0 = A[at[0]] @ variance @ A[at[0]].T + Q
            ahead, seen = np.append(at[1:], 0), np.ascontiguousarray(y[depth:])
            cost, *left = run_filter(A, ahead, _next(push), C, seen, Q, S, R, x0, P0)
            total += cost
            out.append(run_smoother(A, ahead, C, *left))
        return out, -total

    def _columns(self, z: Array, w: Array, on: Array) -> tuple[Array, Array]:
        """Return X (n, n_column) and the factors (n, 1 + n_s) of its past readings."""
        past = np.zeros((len(z), self.depth * self.n_y))
        past[:, : self.na * self.n_y] = z[:, self.n_y :]
        factors = np.hstack([np.ones((len(z), 1)), on[self.depth - 1 : -1]])
        scaled = [past * f[:, None] for f in factors.T]
        return np.hstack([*scaled, self._late(w), np.ones((len(z), 1))]), factors

    def _late(self, w: Array) -> Array:
        return np.hstack([w[self.depth - lag : len(w) - lag] for lag in range(1, self.depth + 1)])

    def _transitions(self, beta: Array, places: Array) -> Array:
        """Return A (k, n_z, n_z) at each position of the switches."""
        p, end, width = self.n_y, self.na * self.n_y, self.depth * self.n_y
        A = np.zeros((len(places), end + p, end + p))
        A[:, p:, :-p] = np.eye(end)
        for k, place in enumerate(places):
            for i, factor in enumerate([1.0, *place]):
                A[k, :p, :end] += factor * beta[i * width : i * width + end].T
        return A


def _next(push: Array) -> Array:
    """Return the push of each row towards the next one (the last leads nowhere)."""
    return np.ascontiguousarray(np.vstack([push[1:], np.zeros((1, push.shape[1]))]))
