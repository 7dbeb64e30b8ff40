"""Score test of residuals: do they correlate with an input, or with the square of an output?

The residual of an output, in means over blocks, is modelled as

    e = N b + x beta + w,        b ~ N(0, 1).

N b is what a right model may leave: an offset of the sensor, of any size; the state in which each stretch
begins, one prior sd in each direction; and the change by draws of the plant's parameters. x are first-order
lags of the input, or of the squared output about its mean. With V the covariance of N b + w and beta = 0,

    g = x' V^-1 e,      cov g = x' V^-1 x = H,      g' H^-1 g ~ chi-square, rank(H) degrees of freedom,

gives the probability p of at least this much.  What the test rarely finds is in
``docs/explanation/validation.md``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import pinvh
from scipy.optimize import minimize
from scipy.signal import lfilter
from scipy.special import chdtrc

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.sysid.models.state_space import symmetric_root
from thermogrip.sysid.plant.log_grid import Stretch, at_rows
from thermogrip.sysid.plant.simulation import find_starts

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant


SQUARED = " squared"  # appended to an output whose residual may correlate with its own square
LEVEL = 0.01  # share of right models for which any correlation may be significant


@dataclass(frozen=True)
class ScoreTestSettings:
    """Settings of the score test; lags and correlation times in blocks, sizes in rms of the residual."""

    most_blocks: int = 300  # of a log: a covariance of that size is inverted in milliseconds
    fewest_blocks: int = 20  # with fewer, noise and input cannot be distinguished
    input_lags: tuple[float, ...] = (1.0, 4.0, 16.0, 64.0)  # two octaves apart, to a fifth of the log
    noise_taus: tuple[float, ...] = (2.0, 8.0, 32.0, 128.0)  # likewise, to a third of the log and more
    noise_sd: float = 0.3  # prior median of each part of w
    noise_log_sd: float = 2.0  # of its logarithm: it may be a fiftieth of that or fifty times
    offset_sd: float = 30.0  # an offset of which nothing is known; no other column changes more
    least_start: float = 0.02  # a direction of the start that moves no block by more is no column
    draws: int = 24  # of the parameters
    runs_at_once: int = 1_000_000  # outputs of the runs from starts at a time, 8 MB


_SCORE_TEST = ScoreTestSettings()


@dataclass(frozen=True)
class CorrelationTest:
    """Test of the residual of one output for correlation with one signal."""

    p: float  # probability of at least this much under no correlation
    size: float  # rms of the part of the residual that correlates with the signal, in the output's unit
    significant: bool = False  # by Holm's rule over all pairs of this log


@dataclass(frozen=True)
class ResidualCorrelations:
    """By output: tests against the inputs that move and ``"OUTPUT squared"``, and the share of the start."""

    tests: dict[str, dict[str, CorrelationTest]]
    start: dict[str, float]  # share of the squared error due to a start that the warm-up left unknown

    def to_json(self) -> dict[str, Any]:
        """Return the value of key ``left`` of ``validate --json``."""
        follows = {
            name: {after: {"p": t.p, "size": t.size, "named": t.significant} for after, t in row.items()}
            for name, row in self.tests.items()
        }
        return {"follows": follows, "start": self.start}


def residual_correlations(
    plant: Plant,
    stretches: Sequence[Stretch],
    run: Array,
    scored: Mask,
    *,
    warmup: float,
    drawn: Sequence[Array] = (),
) -> ResidualCorrelations:
    """Test the residual of the free ``run`` (n, n_y) of a plant over the stretches of a log, at all rows,
    beside those of draws of its parameters; empty where it diverged, has no residual, or has fewer than
    twenty blocks."""
    residual = _residual(np.concatenate([stretch.y for stretch in stretches]), run, scored)
    rms = np.sqrt(np.nanmean(residual**2, axis=0)) if residual is not None else np.zeros(1)
    if residual is None or not rms.all():
        return ResidualCorrelations({}, {})
    block, width = _blocks_of_rows(plant, stretches)
    read = np.isfinite(residual)
    if min(len(np.unique(block[rows])) for rows in read.T) < _SCORE_TEST.fewest_blocks:
        return ResidualCorrelations({}, {})
    # one sd all together; a draw that diverges has no information on small changes
    moves = (other - run for other in drawn[: _SCORE_TEST.draws])
    changes = [change for change in moves if np.isfinite(change).all()]
    drawn_changes = np.array(changes).reshape(-1, *run.shape) / np.sqrt(max(1, len(changes)))
    starts = _start_changes(plant, stretches, warmup, block, read)
    signals = _signals(plant, stretches, run, width)
    tests: dict[str, dict[str, CorrelationTest]] = {}
    start_share: dict[str, float] = {}
    for j, name in enumerate(plant.outputs):
        means = partial(_block_means, block=block, read=read[:, j])
        modes = starts[j] @ np.linalg.eigh(starts[j].T @ starts[j])[1] / rms[j]
        null = _Null(
            block=np.unique(block[read[:, j]]),
            residual=means(residual[:, j] / rms[j]),
            starts=modes[:, np.abs(modes).max(axis=0, initial=0.0) > _SCORE_TEST.least_start],
            drawn=means(drawn_changes[:, :, j].T / rms[j]),
        )
        start_share[name] = null.start_share()
        tests[name] = {
            signal: null.test(means(x), float(rms[j]))
            for signal, x in signals.items()
            if not signal.endswith(SQUARED) or signal == name + SQUARED
        }
    return ResidualCorrelations(marked_by_holm(tests), start_share)


def _residual(read: Array, run: Array, scored: Mask) -> Array | None:
    """Return readings less free run (rows, n_y), NaN where not scored; None where nothing can be tested."""
    is_scored = np.isfinite(read) & scored[:, None]
    if not is_scored.any(axis=0).all() or not np.isfinite(run[scored]).all():
        return None
    size = np.array([np.ptp(y[k]) for y, k in zip(read.T, is_scored.T)])
    most = np.array([np.abs(y - v)[k].max() for y, v, k in zip(read.T, run.T, is_scored.T)])
    if np.any(most > 1e6 * size) or np.any(most < 1e-9 * size):  # it diverged, or it made the log
        return None
    return np.where(is_scored, read - run, np.nan)


def _blocks_of_rows(plant: Plant, stretches: Sequence[Stretch]) -> tuple[NDArray[np.int_], float]:
    """Return the number of each row's block, and the blocks' width [s]."""
    steps = [float(np.median(np.diff(s.time))) for s in stretches if s.time.size > 1]
    step = max(plant.dt, *steps, 1e-9)
    seconds = sum(float(stretch.time[-1]) for stretch in stretches)
    width = step * max(1, int(np.ceil(seconds / step / _SCORE_TEST.most_blocks)))
    block, first = [], 0
    for stretch in stretches:
        block.append(first + np.floor(stretch.time / width + 1e-9).astype(int))
        # stretches are so many numbers apart that their errors are barely correlated
        first = int(block[-1][-1]) + _SCORE_TEST.most_blocks
    return np.concatenate(block), width


def _block_means(values: Array, block: NDArray[np.int_], read: Mask) -> Array:
    """Return means of values (rows, ...) over the rows of each block that were read, of blocks with any."""
    _, place, count = np.unique(block[read], return_inverse=True, return_counts=True)
    sums = np.zeros((len(count), *values.shape[1:]))
    np.add.at(sums, place, values[read])
    return np.asarray(sums / count.reshape(-1, *[1] * (values.ndim - 1)))


def _start_changes(
    plant: Plant, stretches: Sequence[Stretch], warmup: float, block: NDArray[np.int_], read: Mask
) -> list[Array]:
    """Return by output what a start of each stretch further by one prior sd in each direction changes in its
    blocks, as columns (n, n_stretch n_x); what diverges is left at 0."""
    n_x, n_y = plant.model.n_x, len(plant.outputs)
    directions = symmetric_root(plant.model.spread).T
    blocks = [np.unique(block[rows]) for rows in read.T]
    columns = [np.zeros((len(numbers), len(stretches) * n_x)) for numbers in blocks]
    for index, (stretch, start) in enumerate(zip(stretches, find_starts(plant, plant.p, stretches, warmup))):
        u, d = stretch.u[None], (stretch.d - start.d_offset)[None]
        together = max(1, _SCORE_TEST.runs_at_once // (len(stretch.u) * n_y))
        for begin in range(0, n_x, together):
            # a tenth of it: a state near a limit must not cross it
            moved = start.x0 + 0.1 * directions[begin : begin + together]
            with np.errstate(over="ignore", invalid="ignore"):  # a run from a far start may diverge
                runs = plant.model.rollout(np.vstack([start.x0, moved]), u, d, plant.p[None], plant.dt)[0]
                change = 10.0 * at_rows(stretch, runs[1:] - runs[0], plant.dt)
            change[~np.isfinite(change).all(axis=(1, 2))] = 0.0
            first = index * n_x + begin
            for j, numbers in enumerate(blocks):
                inside = np.isin(numbers, block[stretch.rows])
                means = _block_means(change[:, :, j].T, block[stretch.rows], read[stretch.rows, j])
                columns[j][inside, first : first + len(moved)] = means
    return columns


def _signals(plant: Plant, stretches: Sequence[Stretch], run: Array, width: float) -> dict[str, Array]:
    """Return x (rows, n_lag), of about unit size, of each input that moves and of each output's square."""
    signals = {
        name: [stretch.u[:, k] - stretch.u[0, k] for stretch in stretches]
        for k, name in enumerate(plant.inputs)
        if any(np.ptp(stretch.u[:, k]) > 0 for stretch in stretches)
    }
    for j, name in enumerate(plant.outputs):
        # a loss that curves
        squares = (run[:, j] - run[:, j].mean()) ** 2
        signals[name + SQUARED] = [
            np.interp(plant.dt * np.arange(len(s.u)), s.time, squares[s.rows]) for s in stretches
        ]
    # a delay, time constant or heat flow that the model lacks is nearly a mixture of these lags
    keeps = [np.exp(-plant.dt / (lag * width)) for lag in _SCORE_TEST.input_lags]
    out = {}
    for name, values in signals.items():
        rows = []
        for stretch, on_grid in zip(stretches, values):
            slow = np.stack([np.append(0.0, lfilter([1 - k], [1, -k], on_grid)) for k in keeps], axis=1)
            rows.append(at_rows(stretch, slow[None], plant.dt)[0])
        x = np.concatenate(rows)
        out[name] = x / max(float(np.abs(x).max()), 1e-300)
    return out


class _Null:
    """The residual of one output in blocks (n,), and what it is made of where the model is right."""

    def __init__(self, *, block: NDArray[np.int_], residual: Array, starts: Array, drawn: Array) -> None:
        offset = np.full((len(residual), 1), _SCORE_TEST.offset_sd)
        columns = np.hstack([offset, starts, drawn])
        columns /= np.maximum(1.0, np.abs(columns).max(axis=0) / _SCORE_TEST.offset_sd)
        self.residual, self.columns = residual, columns  # N, (n, q)
        self.starts = columns[:, 1 : 1 + starts.shape[1]]
        self.inverse = np.linalg.inv(learn_noise(block, residual, columns) + columns @ columns.T)  # V^-1

    def start_share(self) -> float:
        """Return the share of the squared residual that is due to starts."""
        without_start = self.residual - self.starts @ (self.starts.T @ (self.inverse @ self.residual))
        # of the squares of rows, which are 1 in the mean; means over blocks have less noise
        return max(
            0.0, float(self.residual @ self.residual - without_start @ without_start) / len(without_start)
        )

    def test(self, x: Array, rms: float) -> CorrelationTest:
        """Test the residual against a signal x (n, n_lag)."""
        weighted = self.inverse @ x
        H, g = x.T @ weighted, weighted.T @ self.residual
        size = np.sqrt(np.maximum(np.diag(H), 1e-300))
        inverse, rank = pinvh(H / np.outer(size, size), rtol=1e-6, return_rank=True)
        beta = inverse @ (g / size) / size  # H^-1 g, in the directions that H has
        p = float(chdtrc(rank, g @ beta)) if rank else 1.0
        beyond_right = x - self.columns @ (self.columns.T @ weighted)
        return CorrelationTest(p, rms * float(np.sqrt(np.mean((beyond_right @ beta) ** 2))))


def learn_noise(block: NDArray[np.int_], residual: Array, columns: Array) -> Array:
    """Return the covariance of w over blocks (n,) that a residual with columns N supports best."""
    # w is the likeliest sum of white noise and slow errors with beta = 0, under wide log-normal priors
    # Slow errors are Ornstein-Uhlenbeck processes with correlation times tau on a grid, averaged over blocks
    # as readings are: with the block as the unit of time and s = 1/tau,
    #     c(0) = 2 (s - 1 + exp(-s)) / s^2,       c(k) = (2 sinh(s/2) / s)^2 exp(-k s)    for k > 0.
    # The sampled form exp(-k s) loses a third of the variance at low frequencies, where inputs act.
    lag = np.abs(np.subtract.outer(block, block))
    kernels = [np.eye(len(block))]
    for s in 1 / np.array(_SCORE_TEST.noise_taus):
        kernels.append(
            np.where(
                lag == 0, 2 * (s + np.expm1(-s)) / s**2, (2 * np.sinh(s / 2) / s) ** 2 * np.exp(-s * lag)
            )
        )
    right = columns @ columns.T + 1e-6 * np.eye(len(block))

    def variances(z: Array) -> Array:
        return np.asarray(_SCORE_TEST.noise_sd**2 * np.exp(2 * _SCORE_TEST.noise_log_sd * z))

    def cost(z: Array) -> tuple[float, Array]:
        """Return -ln of likelihood and prior, and its slopes."""
        sizes = variances(z)
        V = right + np.einsum("k,kij->ij", sizes, kernels)
        inverse, (_, log_det) = np.linalg.inv(V), np.linalg.slogdet(V)
        explained = inverse @ residual
        slope = [np.sum(inverse * kernel) - explained @ kernel @ explained for kernel in kernels]
        slopes = _SCORE_TEST.noise_log_sd * sizes * np.array(slope) + z
        return 0.5 * float(log_det + residual @ explained + z @ z), slopes

    start = np.zeros(len(kernels))
    best = minimize(
        cost, start, jac=True, method="L-BFGS-B", bounds=[(-4.0, 4.0)] * len(start), options={"ftol": 1e-7}
    )
    return np.asarray(np.einsum("k,kij->ij", variances(best.x), kernels))


def marked_by_holm(
    found: Mapping[str, Mapping[str, CorrelationTest]],
) -> dict[str, dict[str, CorrelationTest]]:
    """Return the same tests, marked as significant by Holm's rule."""
    # at most one right model in a hundred has any, whatever the correlation time of its errors and the number
    # of pairs
    pairs = sorted((one.p, name, after) for name, row in found.items() for after, one in row.items())
    adjusted = np.maximum.accumulate([p * (len(pairs) - k) for k, (p, _, _) in enumerate(pairs)])
    names = {(name, after) for (_, name, after), p in zip(pairs, adjusted) if p < LEVEL}
    return {
        name: {after: replace(one, significant=(name, after) in names) for after, one in row.items()}
        for name, row in found.items()
    }
