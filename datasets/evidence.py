"""What a reader may take for granted of a log: a decision has evidence, or it is a doubt.

A name is half of the evidence of a role, the course of the column is the other half:

* an output responds to an input;
* an input makes an output respond; it is no reading of another input, no total, not computed from readings;
* a disturbance does not respond to an input;
* what is left out never moves, counts, is one signal with another column or computed from some, is a set
  point or of its controller, or neither responds nor makes an output respond.

A role with one half alone is a doubt, and so is every other finding that is a :class:`Doubt`.  That a column
x makes y respond is shown by prediction (Granger 1969): the past of x helps beside that of y.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise, product
from typing import NamedTuple, TypeAlias

import numpy as np

from thermogrip.datasets.arrays import Array

Columns: TypeAlias = Mapping[str, Array]


@dataclass(frozen=True)
class EvidenceSettings:
    """Limits of the rules; 38 of 40 kinds of logs are right and 2 asked with them (benchmarks/hostile)."""

    held_share: float = 0.5  # of rows with a move at most, of a column that is held
    held_size: float = 0.05  # of its range, that the median of its moves has at least: beyond noise
    fewest_rows: int = 20  # of fewer, chance looks like a rule
    counter_share: float = 0.9  # of the rows of a counter have the same step
    fewest_moves: int = 5  # of two columns that may be one signal: fewer moves agree by chance
    exact: float = 1e-6  # of a column's range: beyond the rounding of files
    rounding_share: float = 0.05  # of its standard deviation, that rounding takes at most
    lags: tuple[int, ...] = (2, 6)  # rows; of a smooth input few leave what its output contains of it
    strong_gain: float = 10.0  # of the criterion: "very strong" evidence (Kass and Raftery 1995)
    most_rows: int = 20_000  # that are looked at, for time
    blocks: tuple[int, ...] = (1, 3, 10, 30)  # rows that are averaged: slow effects drown in noise at one
    latest: int = 10  # rows by which a reading of an input is late
    filters: tuple[int, ...] = (3, 10, 30)
    telling_rows: int = 200  # of fewer, an effect may not be seen
    follows: float = 0.9  # share of its variance that another input explains
    parts: tuple[int, ...] = (2, 4, 8)  # that a log is cut into
    part_block: int = 10  # rows that are averaged there: of 3 late effects are lost, of 30 fast ones
    no_help: float = 0.8  # of the mean square error that remains is none
    unlike: float = 8.0  # times the errors elsewhere; of 102 outputs of sound logs 6 at most
    misled: float = 5.0  # the same where drives add to the error; of these 2.4, of 439 simulated 4.6


EVIDENCE = EvidenceSettings()


def is_moved(columns: Columns, name: str, drives: Sequence[str], beside: Sequence[str] = ()) -> bool:
    """Tell whether the past of a drive helps to predict a column beside its own and that of others."""
    reading, *causes = _standardised([columns[n] for n in (name, *drives, *beside)])
    gains = [_gains(reading, _bases(causes[: len(drives)], k), causes[len(drives) :]) for k in EVIDENCE.lags]
    return bool(np.any(np.min(gains, axis=0) > EVIDENCE.strong_gain))


def responds(columns: Columns, name: str, drives: Sequence[str], beside: Sequence[str]) -> bool:
    """Tell whether drives help to predict a column, from row to row or more slowly."""
    return is_moved(columns, name, drives) or any(_acts(columns, u, name, beside) for u in drives)


def is_held(values: Array) -> bool:
    """Tell whether a column moves in few rows, and then far, as what a person or a relay sets does."""
    finite = values[np.isfinite(values)]
    moves = np.abs(np.diff(finite))
    rarely_moves = 0 < np.count_nonzero(moves) <= EVIDENCE.held_share * finite.size
    far = rarely_moves and np.median(moves[moves > 0]) >= EVIDENCE.held_size * np.ptp(finite)
    return bool(far and not _flickers(finite))


def _flickers(values: Array) -> bool:
    """Tell whether a column goes to and fro between neighbours of its levels, three or more, as the steps of
    a converter do: a relay has two, a staircase goes on, set levels skip some."""
    levels, places = np.unique(values, return_inverse=True)
    ways = np.diff(places.ravel())
    ways = ways[ways != 0]
    back = ways[1:] == -ways[:-1]
    enough = levels.size > 2 and ways.size >= EVIDENCE.fewest_rows
    # of 75 drives that are held .82 of the moves and .33 are so at most, of 14 coarse readings .93 and .59
    return bool(enough and np.mean(np.abs(ways) == 1) > 0.9 and np.mean(back[1:] & back[:-1]) > 0.5)


def one_signal(one: Array, other: Array) -> bool:
    """Tell whether two columns are multiples of each other and a constant, each within its own steps."""
    return explains(one, other) and explains(other, one)


def explains(y: Array, *some: Array) -> bool:
    """Tell whether a column is a sum of multiples of others but for rounding; of few moves nobody can."""
    if min(np.count_nonzero(np.diff(v)) for v in (y, some[-1])) < EVIDENCE.fewest_moves:
        return False
    x = np.column_stack([np.ones(y.size), *some])
    whole = np.isfinite(x).all(axis=1) & np.isfinite(y)
    x, y = x[whole], y[whole]
    moves = np.abs(np.diff(y))
    least = max(EVIDENCE.exact * float(np.ptp(y)), float(moves[moves > 0].min(initial=np.inf)))
    for rows in (slice(0, 200), slice(None)):
        residual = y[rows] - x[rows] @ np.linalg.lstsq(x[rows], y[rows], rcond=None)[0]
        if np.abs(residual).max() > least or residual.std() > EVIDENCE.rounding_share * y.std():
            return False
    return True


def predictive_gain(columns: Sequence[Array]) -> Array:
    """Return how much column i helps to predict column j, G (n, n), the least over the lags."""
    scaled = _standardised(columns)
    pasts = (_bases(scaled, lags) for lags in EVIDENCE.lags)
    least = np.min([[_gains(y, bases, ()) for y in scaled] for bases in pasts], axis=0)
    return np.reshape(least, (len(scaled), len(scaled))).T * (1 - np.eye(len(scaled)))


def some_rows(values: Array) -> Array:
    """Return every n-th row of a long column: what moves late counts as what moves first."""
    return values[:: -(-values.size // EVIDENCE.most_rows)]


def _standardised(columns: Sequence[Array]) -> list[Array]:
    """Return the rows that are looked at of columns, gaps filled, of mean 0 and standard deviation 1."""
    scaled = []
    for values in map(some_rows, columns):
        rows, finite = np.arange(values.size), np.isfinite(values)
        filled = np.interp(rows, rows[finite], values[finite]) if finite.any() else np.zeros(values.size)
        scaled.append((filled - filled.mean()) / (np.std(filled) or 1.0))
    return scaled


def _bases(causes: Sequence[Array], lags: int) -> Array:
    """Return an orthonormal basis of each cause's past (n_cause, n_row, lags), empty where rows are few."""
    if not causes or len(causes[0]) < 6 * lags:
        return np.zeros((len(causes), 0, lags))
    axes, sizes, _ = np.linalg.svd([_past(cause, lags) for cause in causes], full_matrices=False)
    return np.asarray(axes * (sizes > 1e-9 * sizes[:, :1])[:, None])


def _gains(y: Array, bases: Array, beside: Sequence[Array]) -> Array:
    """Return the gain in the information criterion of y, where the past of each cause stands beside its own
    and that of others; 0 where it is negative, or rows are too few."""
    n_causes, rows, lags = bases.shape
    if not bases.size:
        return np.zeros(n_causes)
    # what the pasts of y and of others explain is taken out of all once (Frisch and Waugh 1933)
    axes = _basis([np.ones(rows), *(_past(values, lags) for values in (y, *beside))])
    target, explained = y[lags:] - axes @ (axes.T @ y[lags:]), axes.T @ bases
    shares, directions = np.linalg.eigh(np.eye(lags) - explained.transpose(0, 2, 1) @ explained)
    shares = np.where(shares > 1e-14, shares, np.inf)[:, None]  # less is rounding: it adds nothing
    factors = directions / shares @ directions.transpose(0, 2, 1) @ (target @ bases)[..., None]
    errors = target - (bases @ factors - axes @ (explained @ factors))[..., 0]
    # G = N log(RSS without new columns / RSS with them) - n log N, of n columns and N rows (Granger 1969)
    before, after = (np.sum(r**2, axis=-1) + 1e-12 * rows for r in (target, errors))
    return np.asarray(np.maximum(rows * np.log(before / after) - lags * np.log(rows), 0.0))


def _past(values: Array, lags: int, first: int = 1) -> Array:
    return np.stack([values[lags - k : len(values) - k] for k in range(first, lags + 1)], axis=1)


def _basis(terms: Sequence[Array]) -> Array:
    """Return an orthonormal basis of what columns span."""
    axes, sizes, _ = np.linalg.svd(matrix := np.column_stack(terms), full_matrices=False)
    return np.asarray(axes[:, sizes > np.finfo(float).eps * max(matrix.shape) * sizes.max(initial=0.0)])


def comes_to(reading: Array, goal: Array) -> bool:
    """Tell whether most of the levels that a goal is held at, three at least, are those that a reading has in
    the last half of each hold."""
    bounds = [0, *(np.flatnonzero(np.diff(goal)) + 1), goal.size]
    spans = [(a, b) for a, b in pairwise(bounds) if b - a >= EVIDENCE.fewest_rows]
    halves = {a: reading[(a + b) // 2 : b] for a, b in spans if np.isfinite(reading[(a + b) // 2 : b]).all()}
    levels = np.array([goal[a] for a in halves])
    reached = [abs(goal[a] - np.median(v)) <= EVIDENCE.held_size * np.ptp(levels) for a, v in halves.items()]
    return np.unique(levels).size >= 3 and float(np.mean(reached)) > 0.5


def only_rises(values: Array) -> bool:
    """Tell whether a column never falls, or never rises, as totals and counters do."""
    moves = np.diff(values[np.isfinite(values)])
    rising = np.all(moves >= 0) or np.all(moves <= 0)
    return bool(rising and np.unique(moves).size > 1 and np.count_nonzero(moves) > EVIDENCE.fewest_rows)


def share_followed(values: Array, other: Array) -> float:
    """Return the share of a column's variance that another one explains, at once, late or filtered."""
    y, x = _standardised([values, other])
    rows = y.size - EVIDENCE.latest
    if rows < 20 * EVIDENCE.latest:  # of few rows the other's many terms explain any course
        return float(np.mean(y * x)) ** 2
    from scipy.signal import lfilter

    filtered = [lfilter([1 / n], [1, 1 / n - 1], x)[EVIDENCE.latest :] for n in EVIDENCE.filters]
    axes = _basis([np.ones(rows), _past(x, EVIDENCE.latest, first=0), *filtered])
    target = y[EVIDENCE.latest :]
    return 1 - float(np.var(target - axes @ (axes.T @ target)) / (np.var(target) or 1.0))


def role_doubts(
    columns: Columns, roles: Mapping[str, str], reasons: Mapping[str, str], goals: Sequence[str]
) -> Iterator[str]:
    """Yield a line for each role with a reason that the column's course denies; goals are set points."""
    moving = [n for n, v in columns.items() if np.nanmax(v, initial=-np.inf) > np.nanmin(v, initial=np.inf)]
    inputs, outputs, disturbances, others = (
        [n for n in moving if roles[n] == role] for role in ("input", "output", "disturbance", "other")
    )
    if not inputs or not outputs:
        return
    read = [*outputs, *disturbances]
    for name in [name for name in inputs if name in reasons]:
        beside = [n for n in inputs if n != name]
        # a percentage is of a drive, or of a humidity or a level, which the outputs move
        by_unit = reasons[name].startswith("its unit is") and not is_held(columns[name])
        movers = [n for n in outputs if by_unit and _acts(columns, n, name, beside)]
        what = f"responds to {', '.join(movers)}: is it read?" if movers else ""
        if what := what or _unlike_an_input(name, columns, beside, outputs, read):
            yield f"{name} is taken as input ({reasons[name]}), but {what}"
    for n in [n for n in outputs if n in reasons and columns[n].size >= EVIDENCE.telling_rows]:
        if not responds(columns, n, inputs, read):
            yield f"{n} is taken as output ({reasons[n]}), but does not respond to {', '.join(inputs)}"
    for name in [name for name in disturbances if name in reasons]:
        if is_moved(columns, name, inputs):
            yield f"{name} is taken as disturbance ({reasons[name]}), but responds to {', '.join(inputs)}"
    for name in [name for name in others if name in reasons and not only_rises(columns[name])]:
        is_goal = name in goals and is_held(columns[name])
        if is_goal and any(comes_to(columns[n], columns[name]) for n in outputs):
            continue
        # what is held like a drive may be the drive, and the input with a name its reading
        beside = [] if is_held(columns[name]) else inputs
        helped = next((n for n in outputs if is_moved(columns, n, [name], beside)), None)
        if helped is not None:
            yield f"{name} is left out ({reasons[name]}), and helps to predict {helped}"
            continue
        # what is left out may be an output with an input of its own, which is left out with it
        idle = [] if is_held(columns[name]) else [n for n in others if n in reasons and is_held(columns[n])]
        for drives in (inputs, [n for n in idle if n not in goals]):
            if is_moved(columns, name, drives):
                what = f"responds to {', '.join(drives)}: is it an output?"
                yield f"{name} is left out ({reasons[name]}), but {what}"
                break


def effect_doubts(
    columns: Columns, inputs: Sequence[str], outputs: Sequence[str], disturbances: Sequence[str]
) -> Iterator[str]:
    """Yield a line for each input computed from a disturbance, and for each output that does not follow the
    inputs in some part of a log as elsewhere."""
    for name, other in product(inputs, disturbances):
        if explains(columns[name], columns[other]):
            yield f"{name} is computed from {other}: their effects cannot be estimated separately"
    names = [*inputs, *outputs, *disturbances]
    scaled = dict(zip(names, _standardised([columns[n] for n in names])))
    for output in outputs if inputs else ():
        is_read = some_rows(np.isfinite(columns[output]).astype(float))
        drives, others = [scaled[n] for n in inputs], [scaled[n] for n in disturbances]
        if part := _part_unlike_others(scaled[output], drives, others, is_read):
            says = f"{output} does not follow {', '.join(inputs)} in {part} of the log as it does elsewhere"
            yield f"{says}: did a drive, a sensor, a unit or the step of the rows change there?"


def _part_unlike_others(y: Array, drives: Sequence[Array], others: Sequence[Array], is_read: Array) -> str:
    """Return the part of a log in which drives, by their effect in the others, predict y no better than its
    past alone does, and far worse than there; empty without one."""
    of_y, read, *rest = _means_of_rows([y, is_read, *drives, *others], EVIDENCE.part_block)
    whole = _past(read, 2, first=0).min(axis=1) == 1
    at_once = [_past(means, 2, first=0)[whole] for means in rest]
    known = [np.ones(whole.sum()), _past(of_y, 2)[whole], *at_once[len(drives) :]]
    by_past, by_drives = (_Fit(of_y[2:][whole], terms) for terms in (known, known + at_once[: len(drives)]))
    n_new = by_drives.basis.shape[1] - by_past.basis.shape[1]
    for count in EVIDENCE.parts:
        rows = len(by_past.errors) // count
        for place in range(count if rows >= EVIDENCE.fewest_rows else 0):
            part = slice(place * rows, (place + 1) * rows)
            past, driven = by_past.without(part), by_drives.without(part)
            gain = (count - 1) * rows * np.log(past.elsewhere / driven.elsewhere)
            times = EVIDENCE.misled if driven.here_fair > past.here else EVIDENCE.unlike
            least = max(EVIDENCE.no_help * past.here, times * driven.elsewhere)
            if gain > EVIDENCE.strong_gain + n_new * np.log(count * rows) and driven.here_fair > least:
                return f"part {place + 1} of {count}"
    return ""


class _PartErrors(NamedTuple):
    """Mean square errors of a fit to the rows outside of a part."""

    here: float
    here_fair: float  # less where terms go further than elsewhere: an error of an effect grows with them
    elsewhere: float


class _Fit:
    """A regression, and what it would be without a part of its rows."""

    def __init__(self, target: Array, terms: Sequence[Array]) -> None:
        self.basis = _basis(terms)
        self.errors = target - self.basis @ (self.basis.T @ target)

    def without(self, part: slice) -> _PartErrors:
        """Return the errors of a fit without these rows (Woodbury's identity)."""
        inside, elsewhere = self.basis[part], len(self.basis) - len(self.basis[part])
        covariance = np.linalg.pinv(np.eye(inside.shape[1]) - inside.T @ inside, 1e-9, hermitian=True)
        change = covariance @ (inside.T @ self.errors[part])
        here = (self.errors[part] + inside @ change) ** 2
        there = self.errors @ self.errors + change @ change - here.sum()  # errors are orthogonal to the basis
        further = np.sum(inside @ covariance * inside, axis=1) * elsewhere / len(inside)
        return _PartErrors(here.mean(), np.mean(here / (1 + further)), max(there, 1e-12) / elsewhere)


def _unlike_an_input(
    name: str, columns: Columns, other_inputs: Sequence[str], outputs: Sequence[str], read: Sequence[str]
) -> str:
    """Return what speaks against a column as an input, empty where nothing does."""
    values = columns[name]
    if only_rises(values):
        return "only rises or falls, as a total does"
    for pair in () if is_held(values) else combinations(read, 2):
        # under a proportional controller one reading is enough
        both = [columns[n] for n in pair]
        if explains(values, *both) and not any(explains(values, one) for one in both):
            return f"is computed from {' and '.join(pair)}: a heat or a flow, or a drive under feedback"
    for other in other_inputs:
        if share_followed(values, columns[other]) > EVIDENCE.follows:
            return f"follows {other}: it may be its reading, and their effects cannot be estimated separately"
    others_held = any(is_held(columns[n]) for n in other_inputs)
    if others_held and not is_held(values) and is_moved(columns, name, other_inputs):
        return f"responds to {', '.join(other_inputs)}: is it read?"
    beside = [*other_inputs, *outputs]
    if values.size >= EVIDENCE.telling_rows and not any(_acts(columns, name, y, beside) for y in outputs):
        return f"no reading responds to it ({', '.join(outputs)})"
    return ""


def _acts(columns: Columns, name: str, output: str, beside: Sequence[str]) -> bool:
    """Tell whether a column, alone or by switching what a reading does, acts on an output at any speed."""
    scaled = _standardised([columns[n] for n in (output, name, *(n for n in beside if n != output))])
    for n, lags in product(EVIDENCE.blocks, EVIDENCE.lags):
        y, x, *rest = _means_of_rows(scaled, n)
        gains = _gains(y, _bases([x, x * y, *(x * o for o in rest)], lags), rest)
        if gains.max() > EVIDENCE.strong_gain:
            return True
    return False


def _means_of_rows(columns: Sequence[Array], n: int) -> list[Array]:
    """Return the means of columns over n rows each."""
    return [v[: v.size // n * n].reshape(-1, n).mean(axis=1) for v in columns]
