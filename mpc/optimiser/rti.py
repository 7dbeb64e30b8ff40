r"""One sample's optimisation: linearise along the last plan, condense, solve one QP, say how it went.

This is a real-time iteration: the plan of the last sample, shifted, is where the prediction is linearised,
and one QP a sample improves it.  Unknowns are the block values of the drives in fractions of their range,
z = v/span. With y(v) ~ y0 + G (v - v0) over the horizon and Delta the difference along the blocks,

    H = 2 ( G'QG + move Delta'Delta + drive L ),    f = 2 ( G'Q (y0 - G v0 - r) - move Delta' e ),

where e has the drive that is applied now.  Rows: range and slew of each block (hard), the overshoot
band of the controlled outputs and the limits of any output at every sample (soft).

Near the optimum of a Peltier element the linearisation predicts cooling that a whole step does not give,
and beyond it more current heats. Three guards stand there. A Peltier's gain fades in proportion to its
drive, to nothing at the optimum: from what is left of it along the guess, against that at rest, follows
where the optimum is, and how far a block may go, as a share of the way there,

    share = max(17/20, min(e, 3 - 2 e)),     e = end of the range / optimum

(``docs/explanation/mpc.md`` says what that costs).  The bias of the drive that the observer has found is
counted where the gain is evaluated, not in the share: it is a heat flow, and heat moves no optimum.  A
drive that serves a limit and no loop is not held so, nor is any where a plan is improved until it stays.
Where the QP's plan costs more than the guess in the nonlinear simulation, it is taken only part of the way.
And since the far side is a trap (there, heating seems to ask for still more cooling current), plain ramps
that take the drive back, to none and to the other end, are looked at every fifth sample; so a drive does not
stay at an end of its range either, where a black box answers nothing at all.

A soft row that is exceeded by s costs its price times (s / 5 + s^2).  **Zones** replace the squared error of
an output by rows about its target, beyond which it costs that and its size, (s + s^2) for each sample's
weight: the size makes the edge one that a price does not cross by a little.  An energy price adds
``price_k u_k / span`` for each sample.  Rows of a hard limit cost a thousand times as much as of a soft one:
they give way where nothing else can.

A linear plant has none of those guards: G, H and the rows of the program are made once, only the free
response, f and the bounds are new in a sample, and the program's plan is the best there is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.mpc.design.design import Design
from thermogrip.mpc.estimator.observer import DisturbanceModel, Observer
from thermogrip.mpc.optimiser.qp import CondensedQP
from thermogrip.mpc.plant.along_plan import AlongPlan
from thermogrip.mpc.plant.prediction import PredictionModel

SHARES = (0.5, 0.25, 0.1, 0.0)
SAFE = 0.85  # of the way to the optimum, where the range runs on beyond it
FADING = 0.3  # of the gain at rest lost, from which on it is foreseen where it fades
LOOK_AROUND = 5  # samples between two trials of the ramps
LITTLE = 1e-7  # of its range, that a parked drive may be off in the program
#: Of the price of a square of 1, that a distance of 1 beyond a soft row costs: at 1 the noise of a reading,
#: which moves all of a prediction, was answered with full drive wherever the band was used.
FIRST = 0.2
_DEAR = 1000.0  # times the price of a soft limit, of a hard one
#: Of its unit, by which an output breaks its limit: it is reported, and the target cannot be had.
BREAKS, BREAKS_FAR = 0.1, 0.5
BARELY = 1.02  # a plan that is hardly better than the QP's is not worth a jump


class Sample(NamedTuple):
    """What one optimisation starts from, and what is asked of it."""

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
    caution: float = 1.0  # how many times the design's move weight counts
    ahead: Array | None = None  # (N, n_controlled) targets of each sample, where they change


@dataclass(frozen=True)
class Outcome:
    """What one optimisation gave."""

    plan: Array  # (n_b, n_u) drives by block; NaN where the solve failed
    y: Array  # (N, n_y) the outputs predicted under that plan, before any output bias
    status: str  # the solver's, ``"solved"`` where all is well
    # by how much a limit of an output will be broken [degC], where it is by more than BREAKS of its unit
    broken: dict[str, float]
    iterations: int
    # (n_u,) response of the controlled outputs to each drive's next block, over that at rest: below 0 the
    # gain has turned over
    authority: Array


class Optimiser:
    """Builds and solves the QP of a design."""

    def __init__(self, model: PredictionModel, design: Design) -> None:
        self.model, self.design = model, design
        self.blocks = design.blocks
        self.n_b, self.N = len(design.blocks), sum(design.blocks)
        self._rows = [model.outputs.index(name) for name in design.controlled]
        self._limited = [model.outputs.index(name) for name in design.limits]
        self._limits = np.array(list(design.limits.values()), dtype=float).reshape(-1, 2)
        n = self.n_b * model.n_u
        self._spans = np.tile(model.span, self.n_b)  # of each unknown
        self.differences = np.kron(np.eye(self.n_b) - np.eye(self.n_b, k=-1), np.eye(model.n_u))
        self._moves = self.differences.T @ self.differences
        self._hard = np.vstack([np.eye(n), self.differences])
        self.weight = np.array([design.weights.get(name, 1.0) for name in design.controlled])
        self._of_row = dict(zip(self._rows, self.weight))
        self._weight = np.full(self.N, design.track)  # of each sample
        self._weight[-1] += design.terminal
        self._lengths = np.array(self.blocks, dtype=float)
        lengths = np.repeat(self._lengths, model.n_u)
        self._drive_cost = design.drive * lengths
        self._fixed = 2 * (design.move * self._moves + np.diag(self._drive_cost))
        ranges = np.array([design.drive_range[name] for name in model.drives])
        self.lowest, self.highest = ranges.T
        low, high = (np.broadcast_to(end, (self.n_b, model.n_u)) for end in ranges.T)
        self._whole = low, high
        self.slew = design.dt * np.array([design.slew_per_s[name] for name in model.drives])
        # a later block may differ by what the slew allows between the middles of the two
        middles = np.cumsum(self.blocks) - 0.5 * np.array(self.blocks) + 0.5
        gaps = np.concatenate([[1.0], np.diff(middles)])
        self.reach = np.cumsum(gaps)
        self.slews = (gaps[:, None] * self.slew).ravel()
        self._slew_shares = self.slews / self._spans
        self._solves, self._move = 0, design.move
        # of a linear plant: G in the drives' ranges, the rows of the program, and H for what counts
        self._G: Array | None = None
        self._A: Array | None = None
        self._kept: tuple[Any, Array, list[Array]] | None = None
        self._seen_rows, self._parked = list(range(len(self._rows))), list[int]()
        self.neutral = np.clip(np.zeros(model.n_u), self.lowest, self.highest)
        safe = [design.safe_drive.get(name, rest) for name, rest in zip(model.drives, self.neutral)]
        self.safe = np.array(safe, dtype=float)
        self.zone = np.array([design.zones.get(name, 0.0) for name in design.controlled])
        self.energy = np.array([design.energy_price.get(name, 0.0) for name in model.drives])
        # what energy costs, by unknown, in ranges of the drives
        self._energy_cost = (self._lengths[:, None] * self.energy).ravel()
        self.at_rest = self._response_at_rest()
        self.pair = self._pairs()
        self.settled_gain = self._settled_gain()
        self.seen = np.abs(self.at_rest) > 0.02 * np.max(np.abs(self.at_rest), axis=0)
        # of a drive that is no loop's and serves a limit, what it does to a target may fade or turn over
        paired = {loop.drive for loop in design.loops}
        guarded = [name in paired or not (paired and design.limits) for name in model.drives]
        self.seen &= np.array(guarded)
        self._per_rest = np.where(self.seen, self.at_rest, 1.0)
        # price of a unit beyond each soft row, of each controlled output and each limit
        dear = [_DEAR if name in design.hard else 1.0 for name in design.limits]
        self.dear = design.price * np.array(dear)
        zoned, by_zone = self.zone[:, None] > 0, self.weight[:, None] * self._weight
        own, limited = np.where(zoned, by_zone, design.price), np.repeat(self.dear, self.N)
        first = np.where(zoned, by_zone, FIRST * design.price)
        prices = np.concatenate([np.full(2 * n, design.price), own.ravel(), limited])
        self.qp = CondensedQP(
            soft=np.arange(prices.size) >= 2 * n,
            linear=np.concatenate([np.full(2 * n, design.price), first.ravel(), FIRST * limited]),
            quadratic=2 * prices,
            time_limit_s=max(design.deadline_s, 1e-3),
        )

    @cached_property
    def _along(self) -> AlongPlan | None:
        return self.model.along(self.blocks, self.model.span)

    def solve(self, sample: Sample) -> Outcome:
        """Improve a plan."""
        x, last, guess, d, now, side, bias, drive_bias, slew_s, lost, caution, ahead = sample
        self._move = caution * self.design.move
        model, n_u = self.model, self.model.n_u
        # in samples, by how much more or less than in one the first move may go
        more = 0.0 if slew_s is None else slew_s / self.design.dt - 1.0
        self._seen_rows = [at for at in range(len(self._rows)) if lost is None or not lost[at]]
        self._parked = [j for j in range(n_u) if lost is not None and lost[self.pair[j]]]
        target = now[None] if ahead is None else ahead  # (1 or N, n_controlled)
        if lost is not None:
            side = np.where(lost, 0.0, side)
        if ahead is not None:  # nothing is beyond a target that moves
            side = np.zeros(len(now))
        guess = self._park(guess, last, more)
        linear = model.affine is not None
        y0, G = self._linearised(x, guess + drive_bias, d)
        authority = np.ones((self.n_b, n_u)) if linear else self._authority(G)
        y0 = y0 + bias
        free = y0 - G @ (guess / model.span).ravel()  # the response without any plan
        H, f = self._cost(G, free, target, last)
        ends = self._range(guess, drive_bias, authority, last, more)
        A, lower, upper = self._constraints(G, free, target, side, last, ends, more)
        answer = self.qp.solve(H, f, A, lower, upper)
        plan = self._park((answer.x * self._spans).reshape(self.n_b, n_u), last, more)
        if not answer.solved:
            return Outcome(plan, y0, answer.status, {}, answer.iterations, authority[0])
        if linear:
            y = free + G @ (plan / model.span).ravel()
            return Outcome(plan, y, "solved", self._broken(y), answer.iterations, authority[0])

        def predicted(plans: Array) -> Array:
            return self._simulate(x, plans + drive_bias, d) + bias

        def merit(plans: Array, y: Array) -> Array:
            return self._merit(plans, y, target, side, last)

        plan, y = self._best(plan, guess, y0, last, more, predicted, merit)
        return Outcome(plan, y, "solved", self._broken(y), answer.iterations, authority[0])

    def _linearised(self, x: Array, plan: Array, d: Array) -> tuple[Array, Array]:
        """Return the outputs along a plan, and G (N, n_y, n) by drives in their ranges."""
        if self._along is not None:
            y, G = self._along.trajectory(x, plan, d)
            return y, G.reshape(self.N, self.model.n_y, -1)
        y, G = self.model.trajectory(x, plan, d, self.blocks)
        if self._G is None or self.model.affine is None:
            self._G = G.reshape(self.N, self.model.n_y, -1) * self._spans
        return y, self._G

    def _pairs(self) -> NDArray[np.int_]:
        """Return which controlled output each drive is there for: its PI loop's, else what it moves most."""
        pair = np.array(self.strongest)
        for loop in self.design.loops:
            pair[self.model.drives.index(loop.drive)] = self.design.controlled.index(loop.output)
        return pair

    def _park(self, plans: Array, last: Array, more: float) -> Array:
        """Return plans (..., n_b, n_u) whose parked drives go to rest as fast as the slew allows."""
        if not self._parked:
            return plans
        reach = (self.reach[:, None] + more) * self.slew
        path = np.clip(self.safe, last - reach, last + reach)
        plans = np.array(plans)
        plans[..., self._parked] = path[:, self._parked]
        return plans

    def _best(
        self,
        plan: Array,
        guess: Array,
        y_guess: Array,
        last: Array,
        more: float,
        predicted: Callable[[Array], Array],
        merit: Callable[[Array, Array], Array],
    ) -> tuple[Array, Array]:
        """Return the QP's plan, or one that the nonlinear simulation finds better, with its outputs."""
        self._solves += 1
        y = predicted(plan[None])
        at_guess, cost = merit(np.stack([guess, plan]), np.stack([y_guess, y[0]]))
        others = np.zeros((0, *plan.shape))
        if cost > at_guess:
            others = guess + np.array(SHARES)[:, None, None] * (plan - guess)
        if self._solves % LOOK_AROUND == 1:
            others = np.concatenate([others, self._park(self._ramps(last, more), last, more)])
        if not len(others):
            return plan, y[0]
        y_others = predicted(others)
        costs = BARELY * merit(others, y_others)
        best = int(np.argmin(costs))
        return (others[best], y_others[best]) if costs[best] < cost else (plan, y[0])

    def _response(self, G: Array) -> Array:
        """Return the response (n_b, n_u) to each block, summed over time, of the output moved most."""
        G = G.reshape(self.N, self.model.n_y, self.n_b, self.model.n_u)
        found = np.empty(G.shape[2:])
        for j, at in enumerate(self.strongest):
            np.add.reduce(G[:, self._rows[at], :, j], axis=0, out=found[:, j])
        return found

    def _response_at_rest(self) -> Array:
        """Set which output each drive moves most; return the response at rest (n_b, n_u) of that one."""
        model = self.model
        x, u, room = model.at_rest(self.design.ambient)
        plan = np.repeat(u[None, :], self.n_b, axis=0)
        _, G = model.trajectory(x, plan, room, self.blocks)
        self.strongest = np.argmax(np.abs(G[:, self._rows].sum(axis=(0, 2))), axis=0)
        return self._response(G * model.span)

    def _settled_gain(self) -> Array | None:
        """Return the steady gain (n_u,) of the output that each drive moves most, at rest [degC a range];
        None where a drive moves nothing or the plant does not settle."""
        model, (x, u, d) = self.model, self.model.at_rest(self.design.ambient)
        _, A, B, _ = model.linearise(x, u, d)
        try:
            gain = model.C @ np.linalg.solve(np.eye(model.n_x) - A, B * model.span)
        except np.linalg.LinAlgError:
            return None
        gain = gain[np.array(self._rows)[self.strongest], np.arange(model.n_u)]
        return gain if np.isfinite(gain).all() and np.all(np.abs(gain) > 1e-9) else None

    def _authority(self, G: Array) -> Array:
        """Return each block's response over that at rest, (n_b, n_u); 1 where the horizon hides it."""
        return np.where(self.seen, self._response(G) / self._per_rest, 1.0)

    def _range(
        self, guess: Array, drive_bias: Array, authority: Array, last: Array, more: float
    ) -> tuple[Array, Array]:
        """Return the range (n_b, n_u) of each block: no further than where its gain will have faded."""
        if (authority < 1 - FADING).any():
            away, held = guess - self.neutral, last - self.neutral
            reach = (self.reach[:, None] + more) * self.slew
            least = np.where(away * held > 0, np.abs(held) - reach, 0.0)  # what the slew allows
            low, high = self.faded_range(away, drive_bias, authority, self.neutral, least)
        else:
            low, high = self._whole
        if not self._parked:
            return low, high
        little = np.zeros(self.model.n_u)
        little[self._parked] = LITTLE * self.model.span[self._parked]
        return self._park(low, last, more) - little, self._park(high, last, more) + little

    def faded_range(
        self, away: Array, bias: Array, left: Array, neutral: Array, least: Array | float = 0.0
    ) -> tuple[Array, Array]:
        """Return the ends of drives ``away`` from neutral, where what is ``left`` of their gain at rest
        will have faded; never nearer than the ``least`` distance."""
        if not (left < 1 - FADING).any():
            return self.lowest, self.highest
        best = np.abs(away + bias) / np.maximum(1 - left, FADING)  # where the gain is nothing
        end = np.abs(np.where(away < 0, self.lowest, self.highest) - neutral)
        room = np.maximum(best * allowed_share(end, best, self.model.span), least)
        low = np.where((left < 1 - FADING) & (away < 0), neutral - room, self.lowest)
        high = np.where((left < 1 - FADING) & (away > 0), neutral + room, self.highest)
        return np.maximum(low, self.lowest), np.minimum(high, self.highest)

    def _simulate(self, x: Array, plans: Array, d: Array) -> Array:
        """Return the outputs (B, N, n_y) of plans (B, n_b, n_u)."""
        if self._along is not None:
            return self._along.outputs(x, plans, d)
        states = np.repeat(x[None, :], len(plans), axis=0)
        y, _ = self.model.run(states, np.repeat(plans, self.blocks, axis=1), d)
        return y[:, 1:]

    def _ramps(self, last: Array, more: float) -> Array:
        """Return plans (2, n_b, n_u) that take the drives back: to none, and to the other end; where that is
        none, to the far one."""
        neutral, up = self.neutral, self.lowest == self.neutral
        up |= (last <= neutral) & (self.highest > neutral)
        ends = np.stack([neutral, np.where(up, self.highest, self.lowest)])[:, None, :]
        reach = ((self.reach[:, None] + more) * self.slew)[None]
        return np.asarray(np.clip(ends, last - reach, last + reach))

    def _merit(self, plans: Array, y: Array, target: Array, side: Array, last: Array) -> Array:
        """Return the cost (B,) of plans (B, n_b, n_u) whose outputs y (B, N, n_y) were simulated."""
        design, n_u = self.design, self.model.n_u
        shares = plans.reshape(len(plans), -1) / self._spans
        moves = shares.copy()
        moves[:, n_u:] -= shares[:, :-n_u]
        moves[:, :n_u] -= last / self.model.span
        squared = np.sum(moves * moves, axis=1)
        cost = self._move * squared + (shares * shares) @ self._drive_cost
        cost += shares @ self._energy_cost
        over: list[tuple[float, Array]] = []
        for at in self._seen_rows:
            error = y[:, :, self._rows[at]] - target[:, at]
            if self.zone[at]:
                slack = np.maximum(0.0, np.abs(error) - self.zone[at])
                cost += self.weight[at] * ((slack + slack**2) @ self._weight)
                continue
            cost += self.weight[at] * ((error * error) @ self._weight)
            if side[at]:
                over.append((design.price, side[at] * error - design.overshoot))
        for at, row in enumerate(self._limited):
            low, high = self._limits[at].tolist()
            over.append((self.dear[at], np.maximum(low - y[:, :, row], y[:, :, row] - high)))
        for price, beyond in over:
            if not beyond.max() <= 0.0:
                slack = np.maximum(0.0, beyond)
                cost += price * (FIRST * slack.sum(axis=1) + np.einsum("ij,ij->i", slack, slack))
        return np.asarray(cost)

    def forget(self) -> None:
        """Start afresh: the ramps are tried at the first solve."""
        self._solves = 0

    def linear_gains(self, G: Array, rows: list[int]) -> tuple[Array, Array, Array]:
        """Return H (n, n), and the unconstrained plan's gains on the free response (n, N n_controlled),
        sample by sample, and on the last drive (n, n_u).

        G (N, n_y, n) is the response to the plan in fractions of the drives' ranges; the first n_u rows of a
        gain are the first move.
        """
        n_u, span = self.model.n_u, np.tile(self.model.span, self.n_b)
        H, weighted = self._hessian(G, rows)
        linear = np.stack(weighted, axis=2)
        before = np.zeros((H.shape[0], n_u))
        before[:n_u] = np.diag(1 / self.model.span)
        last = 2 * self.design.move * self.differences.T @ before
        on_free = -span[:, None] * np.linalg.solve(H, linear.reshape(H.shape[0], -1))
        return H, on_free, span[:, None] * np.linalg.solve(H, last)

    def _hessian(self, G: Array, rows: Sequence[int]) -> tuple[Array, list[Array]]:
        """Return H, and by output the response (n, N) of each sample times twice its weight."""
        H = self._fixed.copy()
        weighted = [G[:, row, :].T * (2 * self._of_row[row] * self._weight) for row in rows]
        for row, part in zip(rows, weighted):
            H += part @ G[:, row, :]
        return H, weighted

    def _cost(self, G: Array, free: Array, target: Array, last: Array) -> tuple[Array, Array]:
        tracked = [at for at in self._seen_rows if not self.zone[at]]
        rows = [self._rows[at] for at in tracked]
        key = tuple(rows), self._move
        if self._kept is None or self._kept[0] != key or self.model.affine is None:
            H, weighted = self._hessian(G, rows)
            if self._move != self.design.move:
                H += 2 * (self._move - self.design.move) * self._moves
            self._kept = key, H, weighted
        _, H, weighted = self._kept
        f = self._energy_cost.copy()
        for at, row, part in zip(tracked, rows, weighted):
            f += part @ (free[:, row] - target[:, at])
        f[: self.model.n_u] -= 2 * self._move * (last / self.model.span)
        return H, f

    def _constraints(
        self,
        G: Array,
        free: Array,
        target: Array,
        side: Array,
        last: Array,
        ends: tuple[Array, Array],
        more: float,
    ) -> tuple[Array, Array, Array]:
        n, n_u, N = self.n_b * self.model.n_u, self.model.n_u, self.N
        soft = self._rows + self._limited
        if self._A is None:
            self._A = np.concatenate([self._hard, *(G[:, row] for row in soft)])
        elif self.model.affine is None:
            self._A[2 * n :][: len(soft) * N].reshape(len(soft), N, n)[...] = G[:, soft].transpose(1, 0, 2)
        lower, upper = np.empty(len(self._A)), np.empty(len(self._A))
        lower[:n], upper[:n] = ends[0].ravel() / self._spans, ends[1].ravel() / self._spans
        first, before = slice(n, n + n_u), last / self.model.span
        reach = self._slew_shares[:n_u] + more * self.slew / self.model.span
        lower[n : 2 * n], upper[n : 2 * n] = -self._slew_shares, self._slew_shares
        lower[first], upper[first] = before - reach, before + reach
        rows = slice(2 * n, 2 * n + N)
        for at, row in enumerate(self._rows):
            far, down, up = self.design.overshoot, side[at] < 0, side[at] > 0
            if self.zone[at]:
                far, down = self.zone[at], at in self._seen_rows
                up = down
            left = target[:, at] - free[:, row]
            lower[rows], upper[rows] = left - far if down else -np.inf, left + far if up else np.inf
            rows = slice(rows.stop, rows.stop + N)
        for at, row in enumerate(self._limited):
            lower[rows], upper[rows] = self._limits[at, :, None] - free[:, row]
            rows = slice(rows.stop, rows.stop + N)
        return self._A, lower, upper

    def _broken(self, y: Array) -> dict[str, float]:
        found = {}
        for at, (name, row) in enumerate(zip(self.design.limits, self._limited)):
            low, high = self._limits[at].tolist()
            over = float(max(low - y[:, row].min(), y[:, row].max() - high))
            if over > BREAKS * self.model.unit[row]:
                found[name] = over
        return found


def allowed_share(end: Array, best: Array, span: Array) -> Array:
    """Return how far a drive may go, as a share of the way to its optimum; its range ends at ``end``."""
    share = end / np.maximum(best, 1e-9 * span)
    return np.asarray(np.maximum(SAFE, np.minimum(share, 3 - 2 * share)))


class ControllerParts(Protocol):
    """The parts of a model-predictive controller, as its C code and its linear equivalent read them."""

    @property
    def model(self) -> PredictionModel: ...
    @property
    def design(self) -> Design: ...
    @property
    def disturbance(self) -> DisturbanceModel: ...
    @property
    def observer(self) -> Observer: ...
    @property
    def optimiser(self) -> Optimiser: ...
