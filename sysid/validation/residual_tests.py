"""Tests of residuals: are they white, and do they correlate with the input?

**Correlations by lag.** With residuals e of n samples the autocorrelation r_k of a white sequence is N(0,
1/n), so 95 % of its lags lie inside +-1.96/sqrt(n). The cross-correlation with an input u that is itself
correlated is wider: with e and u independent, E e_i e_j u_i u_j = r_e(i - j) r_u(i - j), so c_k = (1/n)
sum_i e_i u_(i-k) has (Bartlett)

    var c_k = (1/n) sum_j r_e(j) r_u(j).

A residual that is not white means that one-step intervals are too narrow. Samples that are lost or not
scored are left out of the sums, pair by pair. A residual that correlates with the input after lag zero
means that a delay or a time constant is missing, but a count of lags outside of the band does not show it:
lags of a slow input are not independent, of 41 either none lies outside or most do, and right models fail
by the dozen. Hence a test.

**Score test.** The residual of an output, in means over blocks, is modelled as

    e = N b + x beta + w,        b ~ N(0, 1).

N b is what a right model may leave. Its columns are an offset of the sensor, of any size; the state in
which each stretch begins, one prior sd in each direction (a few seconds of readings determine it poorly);
the bias of an ambient; and the change by draws of the plant's parameters. w is white noise and two slow
errors, learnt from this residual. x are first-order lags of 1, 4, 16 and 64 blocks of the input: a delay, a
time constant or a heat flow that the model lacks is nearly a mixture of them. The output's own simulated
value about its mean, squared and lagged likewise, represents a loss that curves (radiation, free
convection). With V the covariance of N b + w and beta = 0,

    g = x' V^-1 e,      cov g = x' V^-1 x = H,      g' H^-1 g ~ chi-square, rank(H) degrees of freedom,

gives the probability p of at least this much. Of all pairs of an output and a signal those are significant
whose p is too small by Holm's rule at :data:`LEVEL`: at most one right model in a hundred has any, whatever
the correlation time of its errors and the number of pairs.

An error slower than a third of the log resembles an input that is as slow, and w absorbs it as noise:
effects over so long a time are found late. Where N b alone explains much of e by its starts, that is
reported too, for then a longer warm-up is missing, not a term.

**Noise of block means**: white, and two slow errors,

    cov(e_t, e_t') = w^2 [t = t'] + sum_m a_m^2 c(|t - t'|; tau_m),       m = 1, 2,

c the autocovariance of an Ornstein-Uhlenbeck process that is averaged over blocks, as readings are: with
the block as the unit of time and s = 1/tau,

    c(0) = 2 (s - 1 + exp(-s)) / s^2,       c(k) = (2 sinh(s/2) / s)^2 exp(-k s)    for k > 0.

The sampled form c(k) = exp(-k s) is too rough: fitted to a mean over blocks, whose fast part is weaker, it
loses a third of the variance at low frequencies, where inputs act.

The covariance is nearly diagonal in cosine coordinates (:mod:`thermogrip.sysid.greybox.noise_model`), with
S_f at frequency f. The numbers maximise the likelihood of the series with columns X, whose coefficients are
N(0, 1), integrated out, under wide log-normal priors:

    -2 ln L = sum ln S_f + e' S^-1 e - g' A^-1 g + ln |A|,      A = 1 + X' S^-1 X,   g = X' S^-1 e.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize
from scipy.signal import lfilter
from scipy.special import chdtrc

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.sysid.greybox.noise_model import Block, band_weights
from thermogrip.sysid.plant.log_grid import Stretch, at_rows
from thermogrip.sysid.plant.simulation import Start, find_starts

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant


@dataclass(frozen=True, eq=False)
class Correlation:
    """Correlations by lag, with the band that independence would keep."""

    lags: Array  # (n_lags,), lags [samples]; positive: the residual comes after the input
    values: Array  # (n_lags,), correlation coefficients; NaN where a lag has too few pairs
    band: float  # half-width of the 95 % band

    @property
    def share_outside(self) -> float:
        """Share of the lags outside of the band; about 0.05 under independence."""
        known = np.isfinite(self.values)
        return float(np.mean(np.abs(self.values[known]) > self.band)) if known.any() else float("nan")

    @property
    def independent(self) -> bool:
        """Whether the share outside is within what chance gives (99 % of a binomial with p = 0.05)."""
        n = int(np.isfinite(self.values).sum())
        return bool(n > 0 and self.share_outside * n <= 0.05 * n + 2.33 * np.sqrt(n * 0.05 * 0.95) + 0.5)


def autocorrelation(residual: ArrayLike, n_lags: int = 40) -> Correlation:
    """Return the autocorrelation of a residual at lags 1 to n_lags."""
    e = np.asarray(residual, dtype=float)
    lags = np.arange(1, max(1, min(n_lags, e.size // 4)) + 1)
    values = _correlate(e, e, lags)
    return Correlation(lags.astype(float), values, float(1.96 / np.sqrt(max(1, np.isfinite(e).sum()))))


def cross_correlation(residual: ArrayLike, drive: ArrayLike, n_lags: int = 40) -> Correlation:
    """Return the correlation of a residual with the input that came k samples before it, k = 0 to n_lags."""
    e, u = np.asarray(residual, dtype=float), np.asarray(drive, dtype=float)
    u = np.where(np.isfinite(e), u, np.nan)
    lags = np.arange(0, max(1, min(n_lags, e.size // 4)) + 1)
    values = _correlate(e, u, lags)
    wide = np.arange(1, max(2, e.size // 4))
    both = np.nan_to_num(_correlate(e, e, wide)) * np.nan_to_num(_correlate(u, u, wide))
    spread = max(1.0 + 2.0 * float(np.sum(both)), 1.0) / max(1, int(np.isfinite(e).sum()))
    return Correlation(lags.astype(float), values, float(1.96 * np.sqrt(spread)))


def _correlate(e: Array, u: Array, lags: NDArray[np.int_]) -> Array:
    """Return sum_i u[i] e[i + k] over the known pairs, scaled to a correlation coefficient."""
    known_e, known_u = np.isfinite(e), np.isfinite(u)
    if not known_e.any() or not known_u.any():
        return np.full(lags.shape, np.nan)
    a = np.where(known_e, e - e[known_e].mean(), 0.0)
    b = np.where(known_u, u - u[known_u].mean(), 0.0)
    largest = float(np.abs(a).max()), float(np.abs(b).max())
    if not min(largest) > 1e-150:
        return np.full(lags.shape, np.nan)
    a, b = a / largest[0], b / largest[1]  # a run that diverged has no squares
    size = float(np.sqrt((a**2).sum() * (b**2).sum()))
    n = len(e)
    length = 1 << int(np.ceil(np.log2(2 * n)))
    both = np.fft.irfft(np.fft.rfft(a, length) * np.conj(np.fft.rfft(b, length)), length)
    return np.asarray(both[lags] / size)


_SIZES = (0.3, 0.5, 0.5)  # prior medians of w and a_m, in rms of the series
_SIZE_SD, _MEMORY_SD = 2.0, (1.0, 1.2)  # of their logarithms, and of those of the correlation times
_FAST = 3.0  # prior median of the shorter correlation time [blocks]
_SLOW = (12, 9.0)  # of the longer one: this part of the series, and at least so many blocks
_LEAST = (
    1e-6  # variance of a frequency: less than a thousandth of the series is no noise that can be determined
)


@dataclass(frozen=True)
class SlowNoise:
    """Numbers of the covariance, in units of the series."""

    white: float  # w
    sd: tuple[float, float]  # a_m
    tau: tuple[float, float]  # tau_m [blocks]

    def variances(self, n: int) -> Array:
        """Return S_f of each band of frequencies of n blocks, (n_band,)."""
        weights, lag = band_weights(n), np.arange(n)
        out = np.full(len(weights), self.white**2)
        for sd, tau in zip(self.sd, self.tau):
            s = 1 / tau
            decay = (2 * np.sinh(s / 2) / s) ** 2 * np.exp(-s * lag)
            decay[0] = 2 * (s + np.expm1(-s)) / s**2
            out += sd**2 * (weights @ decay)
        return np.asarray(np.maximum(out, _LEAST))

    def products(self, blocks: Sequence[Block]) -> Array:
        """Return [X, e]' S^-1 [X, e], (q, q), of stretches of one output."""
        parts = [
            np.tensordot(1 / self.variances(block.n), block.products[:, 0, 0], axes=1) for block in blocks
        ]
        return np.asarray(np.sum(parts, axis=0))


def learn_slow_noise(blocks: Sequence[Block]) -> SlowNoise:
    """Return the numbers that a residual supports best."""
    longest = max(block.n for block in blocks)
    mean = np.log([*_SIZES, _FAST, max(longest / _SLOW[0], _SLOW[1])])
    sd = np.array([_SIZE_SD] * 3 + list(_MEMORY_SD))

    def cost(z: Array) -> float:
        noise = _unpack(mean + sd * z)
        logs = sum(float(block.sizes @ np.log(noise.variances(block.n))) for block in blocks)
        return 0.5 * (logs + _squares(noise.products(blocks)) + float(z @ z))

    found = minimize(
        cost, np.zeros(5), method="L-BFGS-B", bounds=[(-4.0, 4.0)] * 5, options={"maxiter": 40, "ftol": 1e-7}
    )
    return _unpack(mean + sd * found.x)


def _squares(products: Array) -> float:
    """Return e' S^-1 e - g' A^-1 g + ln |A|."""
    m = len(products) - 1
    root = np.linalg.cholesky(products[:m, :m] + np.eye(m))
    explained = np.linalg.solve(root, products[:m, -1])
    return float(products[-1, -1] - explained @ explained + 2 * np.log(np.diag(root)).sum())


def _unpack(v: Array) -> SlowNoise:
    white, first, second, fast, slow = np.exp(v).tolist()
    return SlowNoise(white, (first, second), (fast, slow))


SQUARED = " squared"  # appended to an output whose residual may correlate with its own square
LEVEL = 0.01  # share of right models for which any correlation may be significant
_BLOCKS = 400  # of the longest stretch, at most
_FEWEST = 20  # of a stretch, or it is left out
_LAGS = (1.0, 4.0, 16.0, 64.0)  # [blocks]
_DRAWS = 24
_WIDE = 30.0  # rms of the residual: an offset of which nothing is known; a draw or a start changes no more
_REST, _AFTER_GAP = 0.1, 3.0  # prior sd of a start at rest, and after a gap
_BIAS_AT_REST = 0.05  # [K] sd of an ambient's bias after a start at rest
_MODE = 0.02  # rms of the residual: a start that moves no block by more is left out
_FARTHEST = 1e6  # rms of the residual: from a start that moves more, the run diverged
_AT_ONCE = 1_000_000  # outputs of the runs from starts at a time, 8 MB, of which a few copies are alive
_RANK = 1e-6  # of the largest: directions of x that are the others over again


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
    plant: Plant, stretches: Sequence[Stretch], run: Array, scored: Mask, *, warmup: float
) -> ResidualCorrelations:
    """Test the residual of the free ``run`` (n, n_y) of a plant over the stretches of a log, at all rows;
    empty where it diverged, has no residual, or has fewer than twenty blocks."""
    residual = _residual(np.concatenate([stretch.y for stretch in stretches]), run, scored)
    rms = np.sqrt(np.nanmean(residual**2, axis=0)) if residual is not None else np.zeros(1)
    if residual is None or not rms.all():
        return ResidualCorrelations({}, {})
    parts = _parts(plant, stretches, run, residual, rms, warmup)
    if not parts:
        return ResidualCorrelations({}, {})
    signals = list(parts[0].tested)
    tests: dict[str, dict[str, CorrelationTest]] = {}
    start = {}
    for j, name in enumerate(plant.outputs):
        wanted = [s for s in signals if not s.endswith(SQUARED) or s == name + SQUARED]
        tests[name], start[name] = _of_output(parts, j, wanted, float(rms[j]))
    return ResidualCorrelations(_significant(tests), start)


@dataclass(frozen=True, eq=False)
class _Part:
    """One stretch in blocks, in rms of the residual of each output."""

    fixed: Array  # (n, n_y, m), columns of N that all stretches share
    starts: Array  # (n, n_y, k), its own columns of N
    tested: dict[str, Array]  # x (n, 4) by signal
    residual: Array


class _Blocks:
    """Which rows of a stretch make which block."""

    def __init__(self, stretch: Stretch, residual: Array, width: float) -> None:
        known = np.isfinite(residual)
        some = known.any(axis=1)
        cell = np.floor(stretch.time / width + 1e-9).astype(int)
        first, last = (int(cell[some][0]), int(cell[some][-1])) if some.any() else (0, -1)
        cell, self.n = cell - first, last - first + 1
        within = (cell >= 0) & (cell < self.n)
        self._of_outputs = [_Cells.of(cell, rows) for rows in known.T]
        self._of_inputs = _Cells.of(cell, within)
        self.enough = min(each.place.size for each in self._of_outputs) >= max(_FEWEST, self.n / 2)

    def of_readings(self, values: Array) -> Array:
        """Return means (n, n_y, q) of values (rows, n_y, q) where each output was read; lines between."""
        means = [cells.means(values[:, j], self.n) for j, cells in enumerate(self._of_outputs)]
        return np.stack(means, axis=1)

    def of_inputs(self, values: Array) -> Array:
        """Return means (n, q) of values (rows, q) that are known at every row."""
        return self._of_inputs.means(values, self.n)


@dataclass(frozen=True, eq=False)
class _Cells:
    """The blocks of one signal."""

    known: Mask  # which rows of the stretch count
    place: NDArray[np.int_]  # the blocks that have any of these
    where: NDArray[np.int_]  # of each known row, which of them
    count: NDArray[np.int_]  # rows in each

    @classmethod
    def of(cls, cell: NDArray[np.int_], known: Mask) -> _Cells:
        return cls(known, *np.unique(cell[known], return_inverse=True, return_counts=True))

    def means(self, values: Array, n: int) -> Array:
        """Return means (n, q) of values (rows, q), on lines between the blocks that have any."""
        at, out = np.arange(n), np.empty((n, values.shape[1]))
        for k, column in enumerate(values.T):
            out[:, k] = np.interp(at, self.place, np.bincount(self.where, column[self.known]) / self.count)
        return out


def _residual(read: Array, run: Array, scored: Mask) -> Array | None:
    """Return readings less free run (rows, n_y), NaN where not scored; None where nothing can be tested."""
    known = np.isfinite(read) & scored[:, None]
    if not known.any(axis=0).all() or not np.isfinite(run[scored]).all():
        return None
    size = np.array([np.ptp(y[k]) for y, k in zip(read.T, known.T)])
    most = np.array([np.abs(y - v)[k].max() for y, v, k in zip(read.T, run.T, known.T)])
    if np.any(most > 1e6 * size) or np.any(most < 1e-9 * size):  # it diverged, or it made the log
        return None
    return np.where(known, read - run, np.nan)


@dataclass(frozen=True, eq=False)
class _Tested:
    """A stretch that is long enough, its start and its blocks."""

    stretch: Stretch
    start: Start
    blocks: _Blocks
    after_gap: bool


def _parts(
    plant: Plant, stretches: Sequence[Stretch], run: Array, residual: Array, rms: Array, warmup: float
) -> list[_Part]:
    """Return the stretches that are long enough."""
    starts = find_starts(plant, plant.p, stretches, warmup)
    step = max(plant.dt, *(float(np.median(np.diff(s.time))) for s in stretches if s.time.size > 1), 1e-9)
    width = step * max(1, int(np.ceil(max(s.time[-1] for s in stretches) / step / _BLOCKS)))
    moved = [k for k in range(len(plant.inputs)) if any(np.ptp(s.u[:, k]) > 0 for s in stretches)]
    tested = [
        _Tested(stretch, start, _Blocks(stretch, residual[stretch.rows], width), after_gap=at > 0)
        for at, (stretch, start) in enumerate(zip(stretches, starts))
    ]
    tested = [one for one in tested if one.blocks.enough]
    draws = _draw_changes(plant, stretches, tested, run, rms, warmup) if tested else []
    out = []
    for one, drawn in zip(tested, draws):
        blocks, rows = one.blocks, residual[one.stretch.rows]
        nominal = _run(plant, one, one.start.x0[None])
        biases = _bias_changes(plant, one, nominal)
        offsets = np.tile(np.diag(np.full(len(rms), _WIDE)), (blocks.n, 1, 1))
        out.append(
            _Part(
                np.concatenate([offsets, *(part / rms[:, None] for part in (drawn, biases))], axis=2),
                _modes(_start_changes(plant, one) / rms[:, None]),
                _signals(plant, one.stretch, nominal[0], moved, blocks, width / plant.dt),
                blocks.of_readings(rows[:, :, None])[:, :, 0] / rms,
            )
        )
    return out


def _draw_changes(
    plant: Plant,
    stretches: Sequence[Stretch],
    tested: Sequence[_Tested],
    run: Array,
    rms: Array,
    warmup: float,
) -> list[Array]:
    """Return by stretch the changes (n, n_y, n_draw) of draws of the parameters, one sd all together."""
    out: list[list[Array]] = [[np.zeros((one.blocks.n, len(rms), 0))] for one in tested]
    for k in range(1, _DRAWS + 1 if plant.uncertain else 1):
        change = plant.draw(k).over(stretches, warmup)[0] - run
        if not np.isfinite(change).all():  # a draw that diverges has no information on small changes
            continue
        change /= max(1.0, float((np.abs(change).max(axis=0) / (_WIDE * rms)).max()))
        for means, one in zip(out, tested):
            means.append(one.blocks.of_readings(change[one.stretch.rows, :, None]))
    return [np.concatenate(means, axis=2) / np.sqrt(max(1, len(means) - 1)) for means in out]


def _run(plant: Plant, one: _Tested, x0: Array, bias: Array | float = 0.0) -> Array:
    """Return runs (B, N + 1, n_y) of a stretch from x0 (B, n_x), its ambients lower by ``bias`` (n_d,)."""
    d = one.stretch.d - one.start.d_offset - bias
    return plant.model.rollout(x0, one.stretch.u[None], d[None], plant.p[None], plant.dt)[0]


def _start_changes(plant: Plant, one: _Tested) -> Array:
    """Return what a start further by one prior sd in each direction changes, in means (n, n_y, n_x) over
    blocks.  A few directions are run at a time and none of their runs is kept, for there may be hundreds."""
    size, axes = np.linalg.eigh(plant.model.spread)
    root = axes * np.sqrt(np.maximum(size, 0.0))
    root = root * (_AFTER_GAP if one.after_gap else _REST if one.start.level is not None else 1.0)
    together = max(1, _AT_ONCE // (len(one.stretch.u) * len(plant.outputs)))
    means = []
    for begin in range(0, len(root), together):
        # a tenth of it: a state near a limit must not cross it
        moved = one.start.x0 + 0.1 * root.T[begin : begin + together]
        with np.errstate(over="ignore", invalid="ignore"):  # a run from a far start may diverge
            runs = _run(plant, one, np.vstack([one.start.x0, moved]))
            runs[1:] -= runs[0]
            change = at_rows(one.stretch, runs[1:], plant.dt)
            change *= 10.0
        np.clip(change, -1e100, 1e100, out=change)
        np.nan_to_num(change, copy=False, nan=1e100)  # what diverged is left out later
        means.append(one.blocks.of_readings(np.moveaxis(change, 0, 2)))
    return np.concatenate(means, axis=2)


def _bias_changes(plant: Plant, one: _Tested, nominal: Array) -> Array:
    """Return what the bias of each ambient changes of the run (1, N + 1, n_y), in means (n, n_y, k)."""
    changes = [np.zeros((one.blocks.n, len(plant.outputs), 0))]
    for k, name in enumerate(plant.disturbances):
        sd = min(plant.nuisance.get(name, 0.0), np.inf if one.start.level is None else _BIAS_AT_REST)
        if sd > 0:
            run = _run(plant, one, one.start.x0[None], sd * (np.arange(len(plant.disturbances)) == k))
            change = at_rows(one.stretch, run - nominal, plant.dt)[0]
            changes.append(one.blocks.of_readings(change[:, :, None]))
    return np.concatenate(changes, axis=2)


def _modes(columns_of: Array) -> Array:
    """Return the directions (n, n_y, k) in which starts (n, n_y, n_x) move the blocks at all."""
    flat = columns_of.reshape(-1, columns_of.shape[2])
    flat = flat[:, np.abs(flat).max(axis=0, initial=0.0) < _FARTHEST]
    modes = flat @ np.linalg.eigh(flat.T @ flat)[1]
    most = np.abs(modes).max(axis=0, initial=0.0)
    modes = modes[:, most > _MODE] / np.maximum(1.0, most[most > _MODE] / _WIDE)
    return np.asarray(modes.reshape(*columns_of.shape[:2], modes.shape[1]))


def _signals(
    plant: Plant, stretch: Stretch, run: Array, moved: Sequence[int], blocks: _Blocks, steps: float
) -> dict[str, Array]:
    """Return x (n, 4) by signal, of about unit size."""
    given = {plant.inputs[k]: stretch.u[:, k] - stretch.u[0, k] for k in moved}
    for k, name in enumerate(plant.outputs):
        given[name + SQUARED] = (run[:-1, k] - run[:, k].mean()) ** 2
    out = {}
    for name, values in given.items():
        keeps = [np.exp(-1 / (lag * steps)) for lag in _LAGS]
        slow = np.stack([np.append(0.0, lfilter([1 - k], [1, -k], values)) for k in keeps], axis=1)
        x = blocks.of_inputs(at_rows(stretch, slow[None], plant.dt)[0])
        out[name] = x / max(float(np.abs(x).max()), 1e-300)
    return out


def _of_output(
    parts: Sequence[_Part], j: int, signals: Sequence[str], rms: float
) -> tuple[dict[str, CorrelationTest], float]:
    """Return the tests of one output's residual, and the share of its squares that is due to starts."""
    own = [part.starts.shape[2] for part in parts]
    ends, rows = np.cumsum([0, *own]), []
    for part, begin in zip(parts, ends):
        starts = np.zeros((len(part.residual), ends[-1]))
        starts[:, begin : begin + part.starts.shape[2]] = part.starts[:, j]
        x = [part.tested[name] for name in signals]
        rows.append(np.column_stack([part.fixed[:, j], starts, *x, part.residual[:, j]]))
    n_fixed = parts[0].fixed.shape[2]
    m = n_fixed + int(ends[-1])
    stored = [Block.of(row[:, None, :], (0,)) for row in rows]
    null_columns = [*range(m), rows[0].shape[1] - 1]
    null = [Block(b.n, b.outputs, b.products[..., null_columns, :][..., null_columns]) for b in stored]
    P = learn_slow_noise(null).products(stored)
    inner = np.linalg.inv(P[:m, :m] + np.eye(m))
    H = P[m:, m:] - P[m:, :m] @ inner @ P[:m, m:]
    plain = np.concatenate(rows)
    moved = plain[:, n_fixed:m] @ (inner @ P[:m, -1])[n_fixed:]
    rest = plain[:, -1] - moved
    # of the squares of rows, which are 1 in the mean; means over blocks have less noise
    share = max(0.0, float(plain[:, -1] @ plain[:, -1] - rest @ rest) / len(rest))
    out = {}
    for k, name in enumerate(signals):
        at = slice(len(_LAGS) * k, len(_LAGS) * (k + 1))
        p, beta = _score_test(H[at, at], H[at, -1])
        left = plain[:, m:-1][:, at] - plain[:, :m] @ inner @ P[:m, m:-1][:, at]
        out[name] = CorrelationTest(p, rms * float(np.sqrt(np.mean((left @ beta) ** 2))))
    return out, share


def _score_test(H: Array, g: Array) -> tuple[float, Array]:
    """Return p of the score g with covariance H, and beta = H^-1 g, in the directions that H has."""
    size = np.sqrt(np.maximum(np.diag(H), 0.0))
    size = np.where(size > 0, size, 1.0)
    values, axes = np.linalg.eigh(H / np.outer(size, size))
    keep = values > _RANK * max(float(values[-1]), 1e-300)
    if not keep.any() or values[-1] <= 0:
        return 1.0, np.zeros(len(g))
    axes, values = axes[:, keep], values[keep]
    along = axes.T @ (g / size)
    return float(chdtrc(int(keep.sum()), float(along**2 @ (1 / values)))), axes @ (along / values) / size


def _significant(found: Mapping[str, Mapping[str, CorrelationTest]]) -> dict[str, dict[str, CorrelationTest]]:
    """Return the same tests, marked as significant by Holm's rule."""
    pairs = sorted((one.p, name, after) for name, row in found.items() for after, one in row.items())
    names: set[tuple[str, str]] = set()
    for k, (p, name, after) in enumerate(pairs):
        if not p < LEVEL / (len(pairs) - k):
            break
        names.add((name, after))
    return {
        name: {after: replace(one, significant=(name, after) in names) for after, one in row.items()}
        for name, row in found.items()
    }
