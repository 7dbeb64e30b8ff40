r"""The model-predictive controller's step in Python, written to be read: what the C is compared with.

Each sample: advance the estimate under the drive that was applied, correct it with the reading, improve
the plan (:mod:`thermogrip.mpc.optimiser.rti`), answer with its first move.  A loop must never be left without
an answer, so every failure has a next best one, and the status says which.

Whatever the status, a drive is finite, inside its range, and within the slew limit of the one before.
It may be called at any rate (:mod:`thermogrip.mpc.estimator.call_times`): before a move is due the last one
is held; called more seldom, it answers with the mean of the plan until the next call is likely.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.mpc.controllers import advice
from thermogrip.mpc.controllers.base import SampledController, has_preview, targets_ahead
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.design.design import Design
from thermogrip.mpc.estimator.call_times import RESTART_S, opening, shifted
from thermogrip.mpc.estimator.reading_checks import ReadingMonitor, is_off
from thermogrip.mpc.interface import Move, Readings, Trajectory
from thermogrip.mpc.native.shared_constants import STAYS, WEAK
from thermogrip.mpc.optimiser.rti import BREAKS_FAR, Optimiser, Outcome, Sample
from thermogrip.mpc.plant.prediction import prediction_model

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant


@dataclass
class _Follows:
    """What the drives follow."""

    side: Array  # (n_controlled,) whence outputs come to targets: +1 from below, -1 from above, 0 neither
    ramped: Array  # (n_controlled,) where targets are that may only ramp, NaN before the first
    plan: Array | None = None  # (N, n_u), as it was made ``age_s`` ago
    age_s: float = 0.0
    on_pi: bool = False  # whether the PI has taken over


@dataclass
class _Past:
    """What was read last, NaN where it could not be used."""

    y: Array  # (n_y,)
    d: Array  # (n_d,) the last good ones
    x: Array  # (n_x,) where the estimate then stood
    fresh: bool = True  # whether nothing was read since the start
    silent_s: float = 0.0  # that nobody called, where it was too long to know the past


class _Choice(NamedTuple):
    """The drives that a call chooses, before their slew limit."""

    u: Array  # (n_u,)
    status: str
    why: str  # the advice, "" where there is none


class ReferenceController(SampledController):
    """The controller of a plant and a design whose step runs in Python; ``clock`` gives step times [s]."""

    def __init__(
        self, plant: Plant, design: Design, *, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        model = prediction_model(plant, design.dt)
        self.design, self.optimiser = design, Optimiser(model, design)
        super().__init__(model, design.controlled, self.optimiser.drives, design.patience_s, clock)
        self.observer = design.observer(model)
        self.pi = PIController(plant, design)
        self.monitor = ReadingMonitor(model.n_y, spike=model.spike)
        self._begin(np.full(model.n_y, np.nan), model.undisturbed(design.ambient), self.observer.reset)

    @property
    def plan(self) -> Array | None:
        """The plan that is still ahead, (N, n_u)."""
        plan = self._follows.plan
        return None if plan is None else shifted(plan, self._follows.age_s / self.dt)

    def reset(self, reading: Readings, *, in_room: bool = False) -> None:
        """Forget the past, see :meth:`thermogrip.mpc.controllers.mpc.Controller.reset`; ``in_room`` with the
        plant linearised in its room, as C has it."""
        self._begin(*self._read(reading), self.observer.reset_in_room if in_room else self.observer.reset)
        self.u = self._applied(reading, self.u)
        self.pi.reset(reading)
        self.times.reset()

    def step(self, reading: Readings, target: Trajectory) -> Move:
        """Return the move for this sample; see :meth:`thermogrip.mpc.controllers.mpc.Controller.step`."""
        started = self.clock()
        self.times.call(reading)
        y, d = self._read(reading)
        if self.times.stale:
            y = np.full(self.model.n_y, np.nan)
        if is_off([name for name in self.model.model.switches if name not in self.model.drives], reading):
            return self._pause(y, d, target, started)
        applied = self._applied(reading, self.u)
        self._pass(self.times.seconds, applied)
        wanted, wrong = self._wanted(target)
        is_new = self._is_new(wanted)
        # it may be called at any rate: before a move is due the last one is held; where the samples ahead are
        # known a new target is none
        if not self.times.moves(new_target=is_new and not has_preview(target)):
            self._refine(y)
            return self._held_move(started)
        event = self._absorb(y, d, applied) or (advice.STALE if self.times.stale else "")
        if is_new:
            self._follows.side = self._sides(wanted)
        self._target = wanted
        samples = np.arange(1, self.optimiser.N + 1)
        ahead = targets_ahead(
            target, self.controlled, wanted, samples, self.model.coldest, self.model.hottest
        )
        if self.design.ramp_per_s:
            wanted, ahead = self._ramp(wanted, ahead)
        choice = self._decide(wanted, ahead, started)
        status, lasting = choice.status, choice.why
        if status == "ok":  # what happened in this sample, before what has been so for long
            lasting = event or lasting
        if wrong and status == "ok":
            # of a target that is no number the move is the nearest that can be
            status = "infeasible"
        return self._answer(self._within(choice.u), status, wrong or lasting or event, started)

    def _begin(self, y: Array, d: Array, estimate: Callable[[Array, Array], None]) -> None:
        """Forget the past at readings y, disturbances d."""
        self._forget()
        d = np.where(np.isfinite(d), d, self.model.undisturbed(self.design.ambient))
        self._start(y, d, estimate, side=np.zeros(len(self._rows)))

    def _start(self, y: Array, d: Array, estimate: Callable[[Array, Array], None], *, side: Array) -> None:
        """Start the estimate again, by one of the observer's two ways: in the middle of a loop there is no
        time for the better one.  Drives in force and targets stay."""
        estimate(y, d)
        self._unread_s = np.zeros(len(self._rows))
        self._follows = _Follows(side, ramped=np.full(len(self._rows), np.nan))
        self._past = _Past(y, d, self.observer.now)
        self.monitor.forget(y)
        self.optimiser.forget()

    def _start_in_room(self, y: Array, d: Array) -> None:
        d = np.where(np.isfinite(d), d, self._past.d)
        self._start(y, d, self.observer.reset_in_room, side=self._follows.side)

    def _pass(self, seconds: float, applied: Array) -> None:
        """Let the estimate and the plan go on by so many seconds under the drives that were applied."""
        if self._past.fresh:
            return  # it begins with this reading
        if seconds > RESTART_S + self.dt:
            # until a reading comes to start again from, no more is predicted than a silence that would count
            self._past.silent_s, seconds = seconds, RESTART_S
        self.observer.advance(seconds, applied, self._past.d)
        self._follows.age_s += seconds

    def _absorb(self, y: Array, d: Array, applied: Array) -> str:
        """Correct the estimate with this reading; return what the operator should know."""
        elapsed, silent = self.times.waited_s, self._past.silent_s
        if silent and np.isfinite(y).any():
            self._start_in_room(y, d)
            self._past.fresh = False
            return advice.silence(silent)
        if not self._past.fresh:
            self.observer.look(self._past.d)
            self.monitor.expect(self.model.C @ (self.observer.now - self._past.x))
        self._past.fresh = False
        self.u = applied  # the slew limit counts from what was really applied
        self._past.d = np.where(np.isfinite(d), d, self._past.d)
        y, stays = self.monitor.screen(y, self.observer.reading())
        jumped = self._accept_jump(y, stays) if stays.any() else ""
        self.observer.update(y)
        self._past.y, self._past.x = y, self.observer.now
        lost = [name for name, value in zip(self.model.outputs, y) if not np.isfinite(value)]
        lost += [name for name, value in zip(self.model.disturbances, d) if not np.isfinite(value)]
        self._unread_s = np.where(np.isfinite(y[self._rows]), 0.0, self._unread_s + elapsed)
        return jumped or advice.lost_readings(lost, stuck=bool(self.monitor.stuck.any()))

    def _refine(self, y: Array) -> None:
        """Correct the estimate with a reading that comes before a move is due."""
        if self._past.fresh or not np.isfinite(y).any():
            return
        self.observer.look(self._past.d)
        self.monitor.expect(self.model.C @ (self.observer.now - self._past.x))
        self.observer.update(self.monitor.screen_between(y, self.observer.reading()))
        self._past.x = self.observer.now

    def _accept_jump(self, y: Array, stays: Mask) -> str:
        """Take a jump that stays for an offset of its sensor, or for another world; return what it was."""
        names = [name for name, jumped in zip(self.model.outputs, stays) if jumped]
        offset = bool(2 * stays.sum() < np.isfinite(y).sum())
        if offset:
            self.observer.set_offsets(y, stays)
        else:
            self.observer.reset_in_room(y, self._past.d)
        return advice.jump(names, offset=offset)

    def _sides(self, wanted: Array) -> Array:
        """Return from where the targets are approached: +1 from below, -1 from above, 0 neither."""
        return np.where(np.isfinite(wanted), np.sign(wanted - self.observer.reading()[self._rows]), 0.0)

    def _pause(self, y: Array, d: Array, target: Trajectory, started: float) -> Move:
        """Take the drive back while no water moves its heat; the estimate starts again afterwards."""
        u = self._within(self.drives.neutral)
        wanted, _ = self._wanted(target)
        self._start_in_room(y, d)
        self._target, self._follows.side = wanted, self._sides(wanted)
        stands = advice.pump_off(self.model.model.switches)
        # without a pump that is asked for nobody would switch it on again
        self._move = replace(self._answer(u, "off", stands, started), pump=1)
        return self._move

    def _first_of(self, plan: Array) -> Array:
        """Return what of a plan (N, n_u) to apply until the next call."""
        # of a loop that is called more seldom, the mean of the plan until the next call is likely
        return opening(plan, self.times.slew_s / self.dt)

    def _decide(self, wanted: Array, ahead: Array | None, started: float) -> _Choice:
        """Return the drives, the status and the advice: optimiser, else plan, else PI, else off."""
        if not np.isfinite(wanted).all():
            return _Choice(self.drives.safe, "off", advice.no_target(safe=bool(self.design.safe_drive)))
        if (self._unread_s > 0).all():
            if not self._lost.all():
                # no usable reading: the last plan goes on, for ``patience_s``
                plan = self._young_plan()
                return _Choice(self.u if plan is None else self._first_of(plan), "fallback_plan", "")
            self._follows.plan = None
            return _Choice(self.drives.safe, "off", advice.blind(self._unread_s.min()))
        if self.clock() - started >= self.design.deadline_s:
            # the deadline passed: the last plan goes on, or the PI, where there is none
            return self._fall_back("late", advice.TOO_LATE)
        low, high = self.drives.lowest - 1e-9, self.drives.highest + 1e-9
        outside = bool(np.any((self.u < low) | (self.u > high)))
        try:
            outcome = self._optimise(wanted, ahead)
        except (np.linalg.LinAlgError, ArithmeticError):
            return self._fall_back("fallback_plan", advice.solver("not finite"))
        self.observer.hold_drives(outcome.authority < WEAK)
        if outcome.status == "time limit":
            return self._fall_back("late", advice.TOO_LATE)
        if outcome.status != "solved":
            status = "infeasible" if outcome.status == "infeasible" else "fallback_plan"
            return self._fall_back(status, advice.solver(outcome.status))
        self._follows.plan = np.repeat(outcome.plan, self.design.blocks, axis=0)
        self._follows.age_s, self._follows.on_pi = 0.0, False
        if outside:
            # an applied drive out of range: the move is the nearest that can be
            return _Choice(self._first_of(self._follows.plan), "infeasible", advice.OUT_OF_RANGE)
        return _Choice(self._first_of(self._follows.plan), *self._judge(outcome, started))

    def _judge(self, outcome: Outcome, started: float) -> tuple[str, str]:
        """Return the status and the advice of a plan that was found."""
        if outcome.broken:
            units = dict(zip(self.model.outputs, self.model.unit.tolist()))
            name, over = max(outcome.broken.items(), key=lambda item: item[1] / units[item[0]])
            breaks_far = over > BREAKS_FAR * units[name]
            return "infeasible" if breaks_far else "ok", advice.limit_breaks(name, over)
        if self.clock() - started > self.design.deadline_s:
            return "late", advice.TOO_LATE
        if (self._unread_s > 0).any():
            return "fallback_plan", self.say_unseen(self._unread_s)
        # Of several controlled outputs one may be lost: the optimiser goes on, for ``patience_s`` with the
        # model in place of the reading, then without that output, while the drive for it goes to rest.
        return "ok", ""

    def say_unseen(self, unread_s: Array) -> str:
        """Return what is said where controlled outputs were not read for so long (n_controlled,)."""
        lost = unread_s > self._patience_s
        parked = [name for name, pair in zip(self.model.drives, self.optimiser.at_rest.pair) if lost[pair]]
        gone = bool(lost.any())
        out = lost if gone else unread_s > 0
        names = [name for name, is_out in zip(self.controlled, out) if is_out]
        return advice.unseen(names, parked, float(unread_s.max()), lost=gone)

    def _optimise(self, wanted: Array, ahead: Array | None) -> Outcome:
        last = self.drives.cut(self.u)
        observer = self.observer
        d = self._past.d + observer.disturbance_bias
        # linearised along the last plan, shifted, by blocks; else along the drive of now
        guess, plan = np.repeat(last[None, :], self.optimiser.n_b, axis=0), self.plan
        if plan is not None:
            lengths = np.asarray(self.design.blocks)
            guess = np.add.reduceat(plan, np.cumsum(lengths) - lengths, axis=0) / lengths[:, None]
        biases = observer.output_bias, observer.drive_bias
        slew_s = self.times.slew_s
        sample = Sample(
            observer.now, last, guess, d, wanted, self._follows.side, *biases, slew_s, self._lost, ahead
        )
        outcome = self.optimiser.solve(sample)
        # one program, or as many as the design asks for until the plan stays
        for _ in range(1, self.design.iterations if self.model.affine is None else 1):
            moved = np.abs(outcome.plan - sample.guess) > STAYS * self.model.span
            if outcome.status != "solved" or not moved.any():
                break
            sample = sample._replace(guess=outcome.plan)
            outcome = self.optimiser.solve(sample)
        return outcome

    def _ramp(self, wanted: Array, ahead: Array | None) -> tuple[Array, Array | None]:
        """Return the targets now (n_controlled,), of those that may only ramp a sample further on the way,
        and what is ahead (N, n_controlled) from there."""
        rates = np.array([self.design.ramp_per_s.get(name, np.inf) for name in self.controlled])
        shown = self._past.y[self._rows]
        begun = np.where(np.isfinite(self._follows.ramped), self._follows.ramped, shown)
        reach = rates * self.times.waited_s
        now = np.where(np.isfinite(begun), np.clip(wanted, begun - reach, begun + reach), wanted)
        self._follows.ramped = now
        later = np.arange(1, self.optimiser.N + 1)[:, None] * rates * self.dt
        if ahead is None and np.array_equal(now, wanted):
            return now, None
        ends = np.broadcast_to(wanted, later.shape) if ahead is None else ahead
        return now, np.clip(ends, now - later, now + later)

    def _young_plan(self) -> Array | None:
        return None if self._follows.on_pi or self._follows.age_s > self._patience_s else self.plan

    def _fall_back(self, status: str, why: str) -> _Choice:
        """Follow the plan while it is young; then PI, then off."""
        plan = self._young_plan()
        if plan is not None:
            return _Choice(self._first_of(plan), status, why)
        y = self._past.y[self._rows]
        if not self.pi.loops or not np.isfinite(y).all():
            return _Choice(self.drives.safe, "off", why)
        if not self._follows.on_pi:
            # taken over without a bump
            self.pi.follow(self.u, y, self._target)
        self._follows.on_pi = True
        self.pi.u = self.drives.cut(self.u)
        u = self.pi.propose(y, self._target, self.times)
        return _Choice(u, "fallback_pi" if status == "fallback_plan" else status, why)
