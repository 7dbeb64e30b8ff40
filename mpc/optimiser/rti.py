r"""One sample's optimisation: linearise along the last plan, condense, solve one QP, say how it went.

A real-time iteration: the plan of the last sample, shifted, is where the prediction is linearised, and one QP
a sample improves it.  Unknowns are the block values of the drives in fractions of their range, z = v/span.
With y(v) ~ y0 + G (v - v0) over the horizon, Delta the difference along the blocks and e the drive now,

    H = 2 ( G'QG + move Delta'Delta + drive L ),    f = 2 ( G'Q (y0 - G v0 - r) - move Delta' e ).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.mpc.design.design import Design
from thermogrip.mpc.estimator.observer import Observer
from thermogrip.mpc.optimiser.drive_limits import DriveLimits
from thermogrip.mpc.optimiser.qp import CondensedQP
from thermogrip.mpc.plant.prediction import PredictionModel

SHARES = (0.5, 0.25, 0.1, 0.0)
SAFE = 0.85  # of the way to the optimum, where the range runs on beyond it
FADING = 0.3  # of the gain at rest lost, from which on it is foreseen where it fades
LOOK_AROUND = 5  # samples between two trials of the ramps
LITTLE = 1e-7  # of its range, that a parked drive may be off in the program
_DEAR = 1000.0  # times the price of a soft limit, of a hard one: it gives way where nothing else can
#: Of its unit, by which an output breaks its limit: it is reported, and the target cannot be had.
BREAKS, BREAKS_FAR = 0.1, 0.5
SHORTEST = 1e-12  # price, of which a root is taken
BARELY = 1.02  # a plan that is barely better than the QP's is not worth a jump


class Sample(NamedTuple):
    """What one optimisation starts from, and what it is to reach."""

    x: Array  # (n_x,) state
    last: Array  # (n_u,) drives that are applied now
    guess: Array  # (n_b, n_u) plan to linearise along
    d: Array  # (n_d,) disturbances, their bias included
    target: Array  # (n_controlled,) [degC]
    side: Array  # (n_controlled,) from where a target is approached: +1 below, -1 above, 0 neither
    bias: Array  # (n_y,) reading minus model
    drive_bias: Array  # (n_u,) in the drives' units
    slew_s: float | None = None  # seconds that the slew limit of the first move counts; a sample where absent
    lost: Mask | None = None  # (n_controlled,) outputs that cost nothing, and whose drives go to rest
    ahead: Array | None = None  # (N, n_controlled) targets of each sample, where they change


@dataclass(frozen=True)
class Outcome:
    """What one optimisation gave."""

    plan: Array  # (n_b, n_u) drives by block; NaN where the solve failed
    y: Array  # (N, n_y) the outputs predicted under that plan, before any output bias
    status: str  # the solver's, ``"solved"`` where all is well
    # by how much a limit of an output will be broken [degC], where it is by more than BREAKS of its unit
    broken: dict[str, float]
    # (n_u,) response of the controlled outputs to each drive's next block, over that at rest: below 0 the
    # gain has turned over
    authority: Array


@dataclass(frozen=True, eq=False)
class Weights:
    """What counts how much; n unknowns are the block values of all drives."""

    output: Array  # (n_controlled,) times that the squared error of each output counts
    sample: Array  # (N,) weight of each sample
    zone: Array  # (n_controlled,) half width about a target within which nothing counts, 0: none
    drive: Array  # (n,) of a squared drive
    energy: Array  # (n,) of a drive
    dear: Array  # (n_limited,) price of a unit beyond each limit
    differences: Array  # (n, n): each block less the one before it
    own: Array  # (n, n) of the Hessian, what moves and drives cost

    @classmethod
    def of(cls, model: PredictionModel, design: Design) -> Weights:
        """Return those of a design."""
        lengths = np.array(design.blocks, dtype=float)
        sample = np.full(sum(design.blocks), design.track)
        sample[-1] += design.terminal
        energy = np.array([design.energy_price.get(name, 0.0) for name in model.drives])
        dear = [_DEAR if name in design.hard else 1.0 for name in design.limits]
        n_b, drive = len(design.blocks), design.drive * np.repeat(lengths, model.n_u)
        differences = np.kron(np.eye(n_b) - np.eye(n_b, k=-1), np.eye(model.n_u))
        return cls(
            output=np.array([design.weights.get(name, 1.0) for name in design.controlled]),
            sample=sample,
            zone=np.array([design.zones.get(name, 0.0) for name in design.controlled]),
            drive=drive,
            energy=np.outer(lengths, energy).ravel(),
            dear=design.price * np.array(dear),
            differences=np.asarray(differences),
            own=2 * (design.move * (differences.T @ differences) + np.diag(drive)),
        )


@dataclass(frozen=True, eq=False)
class RestGains:
    """How the controlled outputs answer to drives at rest, in the drives' ranges."""

    strongest: NDArray[np.int_]  # (n_u,) which controlled output each drive moves most
    pair: NDArray[np.int_]  # (n_u,) which each is there for: its PI loop's, else what it moves most
    rows: NDArray[np.int_]  # (n_u,) the place of the strongest among all outputs
    response: Array  # (n_b, n_u) of that output to each block, summed over time
    # (n_b, n_u) whether the horizon shows the response of a drive whose gain may fade or turn over
    seen: Mask
    drive: Array  # (n_u,) where that is

    @classmethod
    def of(cls, model: PredictionModel, design: Design) -> RestGains:
        """Return those of a plant at rest in the design's room."""
        rows = np.array([model.outputs.index(name) for name in design.controlled])
        x, u, d = model.at_rest(design.ambient)
        _, G = model.trajectory(x, np.repeat(u[None, :], len(design.blocks), axis=0), d, design.blocks)
        strongest = np.argmax(np.abs(G[:, rows].sum(axis=(0, 2))), axis=0)
        pair = np.array(strongest)
        for loop in design.loops:
            pair[model.drives.index(loop.drive)] = design.controlled.index(loop.output)
        response = _strongest_response(G * model.span, rows[strongest])
        is_seen = np.abs(response) > 0.02 * np.max(np.abs(response), axis=0)
        # of a drive that is no loop's and serves a limit, what it does to a target may fade or turn over
        paired = {loop.drive for loop in design.loops}
        is_seen &= np.array([name in paired or not (paired and design.limits) for name in model.drives])
        return cls(strongest, pair, rows[strongest], response, is_seen, u)


def _strongest_response(G: Array, rows: NDArray[np.int_]) -> Array:
    """Return the responses (n_b, n_u), summed over time, of each drive's output in ``rows`` (n_u,), of
    G (N, n_y, n_b, n_u)."""
    return np.array([G[:, row, :, j].sum(axis=0) for j, row in enumerate(rows)]).T


@dataclass(frozen=True, eq=False)
class Problem:
    """What one program is about, beside its prediction."""

    last: Array  # (n_u,) drives that are applied now
    target: Array  # (1 or N, n_controlled)
    side: Array  # (n_controlled,)
    counted: list[int]  # controlled outputs that cost anything
    parked: list[int]  # drives that go to rest
    more: float = 0.0  # samples, by which the slew limit of the first move is longer than one


class LinearGains(NamedTuple):
    """The unconstrained plan of the condensed QP, whose Hessian is H (n, n)."""

    H: Array
    on_free: Array  # (n, N n_controlled) its gain on the free response, sample by sample
    on_last: Array  # (n, n_u) and on the last drive


class BoundedRows(NamedTuple):
    """Rows A (m, n) of the program and their bounds (m,)."""

    A: Array
    lower: Array
    upper: Array


class Optimiser:
    """Builds and solves the QP of a design."""

    def __init__(self, model: PredictionModel, design: Design) -> None:
        self.model, self.design = model, design
        self.n_b, self.N = len(design.blocks), sum(design.blocks)
        self.drives = DriveLimits.of(model, design.drive_range, design.slew_per_s, design.safe_drive)
        self.weights, self.at_rest = Weights.of(model, design), RestGains.of(model, design)
        self._rows = [model.outputs.index(name) for name in design.controlled]
        self._limits = [(model.outputs.index(name), *ends) for name, ends in design.limits.items()]
        self._spans = np.tile(model.span, self.n_b)  # of each unknown
        # a later block may differ by what the slew allows between the middles of the two
        middles = np.cumsum(design.blocks) - 0.5 * np.array(design.blocks) + 0.5
        gaps = np.concatenate([[1.0], np.diff(middles)])
        self._slews = (gaps[:, None] * self.drives.slew).ravel() / self._spans
        self._hard = np.concatenate([np.eye(self._spans.size), self.weights.differences])
        self.reach = np.cumsum(gaps)  # samples of slew (n_b,) from now to the middle of each block
        # beyond a soft row by this, 0.2 of a price of 25, the distance costs as much as its square: at 1 the
        # noise of a reading, which moves all of a prediction, was answered with full drive near the band
        self._first = max(design.price, SHORTEST) ** -0.5
        self.qp = self._program()
        self._solves = 0
        # of a linear plant, made once: G in the drives' ranges, the program's rows, and H for what counts
        self._G: Array | None = None
        self._A: Array | None = None
        self._kept: tuple[Any, Array, list[Array]] | None = None

    def _program(self) -> CondensedQP:
        """Return the program: ranges and slews, then of each controlled and limited output its samples."""
        design = self.design
        weights = self.weights
        n = weights.drive.size
        zoned, by_zone = weights.zone[:, None] > 0, weights.output[:, None] * weights.sample
        limited = np.repeat(weights.dear, self.N)
        # a row that is exceeded by s costs its price times (first s + s^2); that of a zone, which replaces
        # the squared error of its output, (s + s^2) times each sample's weight
        controlled = np.where(zoned, by_zone, design.price).ravel()
        first = np.where(zoned, by_zone, self._first * design.price).ravel()
        prices = np.concatenate([np.full(2 * n, design.price), controlled, limited])
        return CondensedQP(
            soft=np.arange(prices.size) >= 2 * n,
            linear=np.concatenate([np.full(2 * n, design.price), first, self._first * limited]),
            quadratic=2 * prices,
            time_limit_s=max(design.deadline_s, 1e-3),
        )

    def solve(self, sample: Sample) -> Outcome:
        """Improve a plan."""
        model, problem = self.model, self._problem(sample)
        x = sample.x
        d = sample.d
        bias = sample.bias
        drive_bias = sample.drive_bias
        guess = self._park(sample.guess, problem)
        y_guess, response = model.trajectory(x, guess + drive_bias, d, self.design.blocks)
        if self._G is None or model.affine is None:
            self._G = response.reshape(self.N, model.n_y, -1) * self._spans
        G = self._G  # by drives in their ranges
        authority = self._authority(G)
        y_guess = y_guess + bias
        free = y_guess - G @ (guess / model.span).ravel()  # the response without any plan
        H, f = self._cost(G, free, problem)
        ends = self._range(guess, drive_bias, authority, problem)
        answer = self.qp.solve(H, f, *self._constraints(G, free, ends, problem))
        plan = self._park((answer.x * self._spans).reshape(guess.shape), problem)
        if not answer.solved:
            return Outcome(plan, y_guess, answer.status, {}, authority[0])
        if model.affine is not None:
            y = free + G @ (plan / model.span).ravel()
        else:

            def predicted(plans: Array) -> Array:
                states = np.repeat(x[None, :], len(plans), axis=0)
                y, _ = model.run(states, np.repeat(plans + drive_bias, self.design.blocks, axis=1), d)
                return np.asarray(y[:, 1:] + bias)

            plan, y = self._best(plan, guess, y_guess, predicted, problem)
        return Outcome(plan, y, "solved", self._broken(y), authority[0])

    def _problem(self, sample: Sample) -> Problem:
        """Return what a sample asks for; nothing is beyond a target that moves, or that is lost."""
        lost = np.zeros(len(self._rows), dtype=bool) if sample.lost is None else sample.lost
        moves = sample.ahead is not None
        return Problem(
            last=sample.last,
            target=sample.target[None] if sample.ahead is None else sample.ahead,
            side=np.where(lost | moves, 0.0, sample.side),
            counted=np.flatnonzero(~lost).tolist(),
            parked=np.flatnonzero(lost[self.at_rest.pair]).tolist(),
            more=0.0 if sample.slew_s is None else sample.slew_s / self.design.dt - 1.0,
        )

    def _slewed(self, ends: Array, problem: Problem) -> Array:
        """Return plans (..., n_b, n_u) that go to these ends as fast as the slew allows."""
        reach = (self.reach[:, None] + problem.more) * self.drives.slew
        return np.asarray(np.clip(ends, problem.last - reach, problem.last + reach))

    def _park(self, plans: Array, problem: Problem) -> Array:
        """Return plans (..., n_b, n_u) whose parked drives go to rest."""
        if not problem.parked:
            return plans
        plans = np.array(plans)
        plans[..., problem.parked] = self._slewed(self.drives.safe, problem)[:, problem.parked]
        return plans

    def _ramps(self, problem: Problem) -> Array:
        """Return plans (2, n_b, n_u) that take the drives back: to none, and to the other end; where that is
        none, to the far one."""
        drives = self.drives
        up = drives.lowest == drives.neutral
        up |= (problem.last <= drives.neutral) & (drives.highest > drives.neutral)
        ends = np.stack([drives.neutral, np.where(up, drives.highest, drives.lowest)])
        return self._park(self._slewed(ends[:, None, :], problem), problem)

    def _best(
        self, plan: Array, guess: Array, y_guess: Array, predicted: Callable[[Array], Array], problem: Problem
    ) -> tuple[Array, Array]:
        """Return the QP's plan, or one that the nonlinear simulation finds better, with its outputs."""
        self._solves += 1
        y = predicted(plan[None])
        at_guess, cost = self._merit(np.array([guess, plan]), np.array([y_guess, y[0]]), problem)
        others = np.zeros((0, *plan.shape))
        # three guards stand near the optimum of a Peltier element, where the linearisation predicts cooling
        # that a whole step does not give: here a plan that costs more than the guess in the nonlinear
        # simulation is taken only part of the way
        if cost > at_guess:
            others = guess + np.array(SHARES)[:, None, None] * (plan - guess)
        # the far side is a trap: there, heating seems to ask for still more cooling current.  Nor does a
        # drive stay at an end of its range so, where a black box answers nothing at all
        if self._solves % LOOK_AROUND == 1:
            others = np.concatenate([others, self._ramps(problem)])
        if not len(others):
            return plan, y[0]
        y_others = predicted(others)
        costs = BARELY * self._merit(others, y_others, problem)
        best = int(np.argmin(costs))
        return (others[best], y_others[best]) if costs[best] < cost else (plan, y[0])

    def _authority(self, G: Array) -> Array:
        """Return each block's response over that at rest, (n_b, n_u); 1 where the horizon hides it."""
        # a linear plant has none of the guards
        if self.model.affine is not None:
            return np.ones((self.n_b, self.model.n_u))
        G = G.reshape(self.N, self.model.n_y, self.n_b, self.model.n_u)
        response = _strongest_response(G, self.at_rest.rows)
        share = np.ones(response.shape)
        return np.divide(response, self.at_rest.response, out=share, where=self.at_rest.seen)

    def _range(
        self, guess: Array, drive_bias: Array, authority: Array, problem: Problem
    ) -> tuple[Array, Array]:
        """Return the range (n_b, n_u) of each block: no further than where its gain will have faded."""
        drives, fades = self.drives, authority < 1 - FADING
        low, high = (np.broadcast_to(end, guess.shape) for end in (drives.lowest, drives.highest))
        if fades.any():
            # a Peltier's gain fades in proportion to its drive, to nothing at the optimum: what is left of it
            # along the guess, of what it was at rest, says where that is; not where no drive is away from
            # there.  The bias counts where the gain is evaluated, not in the share of the way there: it is a
            # heat flow, and heat moves no optimum
            begin = self.at_rest.drive
            away, last_away = guess - begin, problem.last - begin
            fades &= np.abs(away) > LITTLE * self.model.span
            reach = (self.reach[:, None] + problem.more) * drives.slew
            least = np.where(away * last_away > 0, np.abs(last_away) - reach, 0.0)  # what the slew allows
            best = np.abs(away + drive_bias) / np.maximum(1 - authority, FADING)  # where the gain is nothing
            end = np.abs(np.where(away < 0, drives.lowest, drives.highest) - begin)
            room = np.maximum(best * allowed_share(end, best, self.model.span), least)
            low = drives.cut(np.where(fades & (away < 0), begin - room, drives.lowest))
            high = drives.cut(np.where(fades & (away > 0), begin + room, drives.highest))
        if not problem.parked:
            return low, high
        little = np.zeros(self.model.n_u)
        little[problem.parked] = LITTLE * self.model.span[problem.parked]
        return self._park(low, problem) - little, self._park(high, problem) + little

    def _merit(self, plans: Array, y: Array, problem: Problem) -> Array:
        """Return the cost (B,) of plans (B, n_b, n_u) whose outputs y (B, N, n_y) were simulated."""
        design = self.design
        weights = self.weights
        n_u = self.model.n_u
        shares = plans.reshape(len(plans), -1) / self._spans
        moves = shares.copy()
        moves[:, n_u:] -= shares[:, :-n_u]
        moves[:, :n_u] -= problem.last / self.model.span
        cost = design.move * np.sum(moves * moves, axis=1)
        cost += (shares * shares) @ weights.drive + shares @ weights.energy
        beyond: list[tuple[float, Array]] = []
        for i in problem.counted:
            error = y[:, :, self._rows[i]] - problem.target[:, i]
            if weights.zone[i]:
                # the size beside the square makes the edge one that a price does not cross by a little
                slack = np.maximum(0.0, np.abs(error) - weights.zone[i])
                cost += weights.output[i] * ((slack + slack**2) @ weights.sample)
                continue
            cost += weights.output[i] * ((error * error) @ weights.sample)
            if problem.side[i]:
                beyond.append((design.price, problem.side[i] * error - design.overshoot))
        for dear, (row, low, high) in zip(weights.dear, self._limits):
            beyond.append((dear, np.maximum(low - y[:, :, row], y[:, :, row] - high)))
        for price, excess in beyond:
            if not excess.max() <= 0.0:
                slack = np.maximum(0.0, excess)
                cost += price * (self._first * slack.sum(axis=1) + np.einsum("ij,ij->i", slack, slack))
        return np.asarray(cost)

    def forget(self) -> None:
        """Start afresh: the ramps are tried at the first solve."""
        self._solves = 0

    def linear_gains(self, G: Array) -> LinearGains:
        """Return the unconstrained plan of responses G (N, n_y, n) to plans in fractions of their ranges."""
        n_u, span = self.model.n_u, self._spans
        H, weighted = self._hessian(G, range(len(self._rows)))
        linear = np.stack(weighted, axis=2)
        before = np.zeros((H.shape[0], n_u))
        before[:n_u] = np.diag(1 / self.model.span)
        last = 2 * self.design.move * self.weights.differences.T @ before
        on_free = -span[:, None] * np.linalg.solve(H, linear.reshape(H.shape[0], -1))
        return LinearGains(H, on_free, span[:, None] * np.linalg.solve(H, last))

    def _hessian(self, G: Array, outputs: Sequence[int]) -> tuple[Array, list[Array]]:
        """Return H, and by controlled output the response (n, N) of each sample times twice its weight."""
        H, weighted = self.weights.own.copy(), []
        for i in outputs:
            response = G[:, self._rows[i], :]
            weighted.append(response.T * (2 * self.weights.output[i] * self.weights.sample))
            H += weighted[-1] @ response
        return H, weighted

    def _cost(self, G: Array, free: Array, problem: Problem) -> tuple[Array, Array]:
        tracked = [i for i in problem.counted if not self.weights.zone[i]]
        if self._kept is None or self._kept[0] != tracked or self.model.affine is None:
            self._kept = tracked, *self._hessian(G, tracked)
        _, H, weighted = self._kept
        f = self.weights.energy.copy()
        for i, by_error in zip(tracked, weighted):
            f += by_error @ (free[:, self._rows[i]] - problem.target[:, i])
        f[: self.model.n_u] -= 2 * self.design.move * (problem.last / self.model.span)
        return H, f

    def _constraints(self, G: Array, free: Array, ends: tuple[Array, Array], problem: Problem) -> BoundedRows:
        """Return the rows A of the program and their bounds."""
        n, n_u = len(self._spans), self.model.n_u
        soft = [*self._rows, *(row for row, _, _ in self._limits)]
        if self._A is None or self.model.affine is None:
            # range and slew of each block are hard, the overshoot band and the limits at every sample soft
            rows = G[:, soft].transpose(1, 0, 2).reshape(-1, n)
            self._A = np.concatenate([self._hard, rows])
        slew, none = self._slews.copy(), np.full(self.N, np.inf)
        slew[:n_u] += problem.more * self.drives.slew / self.model.span
        before = np.zeros(n)
        before[:n_u] = problem.last / self.model.span
        lower = [ends[0].ravel() / self._spans, before - slew]
        upper = [ends[1].ravel() / self._spans, before + slew]
        for i, row in enumerate(self._rows):
            error, zone = problem.target[:, i] - free[:, row], self.weights.zone[i]
            allowed = zone or self.design.overshoot
            counts = i in problem.counted
            lower.append(error - allowed if (counts if zone else problem.side[i] < 0) else -none)
            upper.append(error + allowed if (counts if zone else problem.side[i] > 0) else none)
        for row, low, high in self._limits:
            lower.append(low - free[:, row])
            upper.append(high - free[:, row])
        return BoundedRows(self._A, np.concatenate(lower), np.concatenate(upper))

    def _broken(self, y: Array) -> dict[str, float]:
        """Return by how much limits will be broken, where it is worth a word."""
        broken = {}
        for name, (row, low, high) in zip(self.design.limits, self._limits):
            excess = float(max(low - y[:, row].min(), y[:, row].max() - high))
            if excess > BREAKS * self.model.unit[row]:
                broken[name] = excess
        return broken


def allowed_share(end: Array, best: Array, span: Array) -> Array:
    """Return how far a drive may go, as a share of the way to its optimum; its range ends at ``end``."""
    # docs/explanation/mpc.md says what that costs
    share = end / np.maximum(best, 1e-9 * span)
    return np.asarray(np.maximum(SAFE, np.minimum(share, 3 - 2 * share)))


class ControllerParts(Protocol):
    """The parts of a model-predictive controller, as its C code and its linear equivalent read them."""

    @property
    def model(self) -> PredictionModel: ...
    @property
    def design(self) -> Design: ...
    @property
    def observer(self) -> Observer: ...
    @property
    def optimiser(self) -> Optimiser: ...
