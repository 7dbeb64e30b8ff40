r"""The model-predictive controller as a loop sees it: a reading in, one move out, always.

Each sample: advance the estimate under the drive that was applied, correct it with the reading, improve
the plan (:mod:`thermogrip.mpc.optimiser.rti`), answer with its first move.  The reading of a lost sensor is
left out; the room's temperature is fed forward as measured.

A loop must never be left without an answer, so every failure has a next best one, and the status says which:

* ``ok``: the optimiser's move;
* ``late``: the deadline passed, so the last plan goes on (the PI, where there is none);
* ``infeasible``: what was asked cannot be (a target that is no number or out of reach, a limit that must
  break, an applied drive out of range); the move is the nearest that can be;
* ``fallback_plan``: no usable reading, or the solver failed; the last plan goes on, for ``patience_s``.  Of
  several controlled outputs one may be lost: the optimiser goes on, for ``patience_s`` with the model in
  place of the reading, then without that output, and the drive that is there for it goes to rest;
* ``fallback_pi``: the plan has run out; PI on the reading, taken over without a bump (and without
  feed-forward: the drive that is taken over has it);
* ``off``: no reading to act on, or the pump is off; the drive goes to zero.

Where mean innovations exceed 3 standard deviations, the weight of moves is multiplied by their third, up
to 30 times: a gain that is off by 30 % does not swing.

What a loop shows beyond one sample, an output that swings or does not arrive, another plant than the model,
:class:`thermogrip.mpc.controllers.loop_monitor.LoopMonitor` watches from beside it.

Whatever the status, a drive is finite, inside its range, and within the slew limit of the one before.  What
cannot be a reading is found by :mod:`thermogrip.mpc.estimator.reading_checks`.

It may be called at any rate (:mod:`thermogrip.mpc.estimator.call_times`).  Estimate and plan go on by the
seconds that passed, fractions of a sample included, and the slew limit counts from the last move.  Before a
move is due the last one is held, with its status; called more seldom than its sample time, it answers with
the mean of the plan over the time until it is likely to be called again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.atomic_files import read_json, write_json
from thermogrip.datasets.errors import UserError, reading
from thermogrip.datasets.shown import Shown
from thermogrip.mpc.controllers.base import STALE, SampledController
from thermogrip.mpc.controllers.linear_equivalent import to_control
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.design.design import DAY, SCHEMA, VERSION, Design, check_design, default_design
from thermogrip.mpc.estimator.call_times import RESTART_S, opening, shifted
from thermogrip.mpc.estimator.reading_checks import ReadingMonitor, is_off
from thermogrip.mpc.interface import Move, Readings, Trajectory
from thermogrip.mpc.native.shared_constants import CAUTION, MOST_CAUTION, STAYS, WEAK
from thermogrip.mpc.optimiser.reach import Reach
from thermogrip.mpc.optimiser.rti import Optimiser, Outcome, Sample
from thermogrip.mpc.optimiser.switching import choose
from thermogrip.mpc.plant.prediction import prediction_model

if TYPE_CHECKING:
    from thermogrip.mpc.native.runtime import CompiledController
    from thermogrip.sysid.models.model import Model
    from thermogrip.sysid.plant.plant import Plant

_KEPT_DRAWS = 50  # of the posterior, in the controller's file for its review


class Controller(Shown, SampledController):
    """Model-predictive controller of a plant.

    Parameters
    ----------
    plant : Plant
    design : Design, optional
        By default :func:`thermogrip.mpc.design.design.default_design`.
    notes : dict, optional
        What the tuner found, kept in the file.
    clock : callable, optional
        Where step times come from [s].
    compiled : bool, optional
        Whether estimate and program are worked out in C (:mod:`thermogrip.mpc.native.runtime`), for which gcc
        must be there: the same answers.  The checks of a step stay in Python and take most of its time, so
        a single step gains little by it; closed loops that run in C as a whole gain much.

    Examples
    --------
    A heater with 40 K, 100 s and 5 s of delay, asked for 35 degC:

    >>> from thermogrip.sysid import Plant
    >>> from thermogrip.sysid.models.state_space import StateSpaceModel
    >>> a = float(np.exp(-0.05))
    >>> A, B = [[a, 40 * (1 - a)], [0, 0]], [[0], [1]]
    >>> heater = StateSpaceModel(("q",), (), ("t",), A=A, B=B, C=[[1.0, 0]], dt=5.0, y0=[25.0])
    >>> controller = Controller(Plant(heater, {}, dt=5.0, units={"q": "1"}, valid={"q": (0.0, 1.0)}))
    >>> controller.reset({"t": 25.0})
    >>> move = controller.step({"t": 25.0}, 35.0)
    >>> move.status, round(move.drive, 3), controller.step({"t": float("nan")}, 35.0).status
    ('ok', 0.625, 'fallback_plan')
    """

    def __init__(
        self,
        plant: Plant,
        design: Design | None = None,
        *,
        notes: dict[str, Any] | None = None,
        clock: Callable[[], float] = time.perf_counter,
        compiled: bool = False,
    ) -> None:
        design = default_design(plant) if design is None else check_design(design, plant)
        model = prediction_model(plant, design.dt)
        slew = design.dt * np.array([design.slew_per_s[name] for name in model.drives])
        super().__init__(
            *(model, design.controlled, design.drive_range, slew, design.patience_s, clock),
            design.safe_drive,
            design.on_off,
        )
        self.plant, self.design, self.notes = plant, design, dict(notes or {})
        self.observer = design.observer(self.model)
        self.disturbance = self.observer.disturbance
        self.optimiser = Optimiser(self.model, design)
        self.c: CompiledController | None = None
        if compiled:
            self._compile()
        self.pi = PIController.of(plant, design, tuple(replace(p, feedforward=0.0) for p in design.loops))
        self.monitor = ReadingMonitor(self.model.n_y, spike=self.model.spike)
        self.reach = Reach(self.optimiser, self.observer)
        self.last_iterations = 0  # of the program, in the last step
        self._waits = 0.0  # seconds until an on/off drive may go over, where it is to
        self._slew_s = self.dt  # for which the slew limit counts in this step
        self._in_force: Array
        self._plan: Array | None  # (N, n_u), as it was made ``_age_s`` ago
        self._ahead: Array | None = None  # targets of the samples that are predicted, where they change
        self._coming: Array | None = None  # (N, n_d) measured disturbances of those, NaN where not told
        self._ramped = np.full(len(design.controlled), np.nan)  # where targets are that may only ramp
        self._start(np.full(self.model.n_y, np.nan), self.model.undisturbed(design.ambient))

    def _compile(self) -> None:
        if self.design.on_off:
            raise NotImplementedError("no C chooses when an input is on or off")
        from thermogrip.mpc.native.runtime import CompiledController, CompiledObserver, CompiledOptimiser

        self.c = CompiledController(self)
        self.optimiser = CompiledOptimiser(self.optimiser, self.c)
        self.observer = CompiledObserver(self.observer, self.c)

    @property
    def plan(self) -> Array | None:
        """The plan that is still ahead, (N, n_u)."""
        return None if self._plan is None else shifted(self._plan, self._age_s / self.dt)

    def _facts(self) -> dict[str, object]:
        """Return what is regulated by what, how often, and of which plant."""
        ranges = (f"{name} {low:g} to {high:g}" for name, (low, high) in self.design.drive_range.items())
        facts: dict[str, object] = {
            "regulates": ", ".join(self.controlled),
            "by": ", ".join(ranges),
            "every": f"{self.dt:g} s",
        }
        return facts | {"model": self.plant.model.kind, "logs": ", ".join(self.plant.logs) or "none"}

    def save(self, path: str | Path) -> Path:
        """Write the controller with its plant as JSON and return the path."""
        return write_json(path, self.to_dict(), schema=SCHEMA, version=VERSION)

    def to_dict(self) -> dict[str, Any]:
        """Return what the file has, as plain JSON."""
        return {
            "schema": SCHEMA,
            "version": VERSION,
            "design": self.design.to_dict(),
            "notes": self.notes,
            "plant": self.plant.to_dict(draws=_KEPT_DRAWS),
        }

    @classmethod
    def load(cls, path: str | Path, *, model: Model | None = None) -> Controller:
        """Return the controller that :meth:`save` wrote.

        Parameters
        ----------
        path : str or Path
        model : Model, optional
            The equations of its plant, where they are a class of the user's own; ignored otherwise.

        Raises
        ------
        UserError
            If the file is absent, is no controller, or its numbers make none.

        Examples
        --------
        >>> from thermogrip.sysid import Plant, load_network
        >>> kit = load_network("tclab")
        >>> p, heaters = dict(zip(kit.parameters, kit.prior)), dict.fromkeys(kit.inputs, (0.0, 100.0))
        >>> plant = Plant(kit, p, dt=kit.dt, units=kit.units, valid=heaters)
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     path = design_controller(plant, dt=5.0).save(f"{folder}/controller.json")
        ...     Controller.load(path).dt
        5.0
        """
        from thermogrip.sysid.plant.plant import Plant

        content = read_json(path, SCHEMA, VERSION)
        # numbers each of which may be can leave no gain or no estimate together
        with reading("its numbers make no controller", file=path, hint="tune the controller again"):
            for key in ("design", "notes", "plant"):
                if not isinstance(content.get(key), dict):
                    raise UserError(f"{key} is missing", hint="tune the controller again")
            equations = content["plant"].get("model")
            own = isinstance(equations, dict) and equations.get("kind") == "own"
            plant = Plant.from_dict(content["plant"], model=model if own else None)
            return cls(plant, Design.from_dict(content["design"]), notes=content["notes"])

    def to_control(self) -> Any:
        """Return the controller without its limits as a python-control ``StateSpace`` from readings,
        ``target_<name>`` and measured disturbances to drives, all in changes from rest."""
        return to_control(self)

    def reset(self, reading: Readings) -> None:
        """Forget the past; the plant is at rest at this reading, its drive at zero or as the reading has it.

        Parameters
        ----------
        reading : mapping of str to float
            As for :meth:`step`.

        Examples
        --------
        >>> from thermogrip.sysid import Plant, load_network
        >>> kit = load_network("tclab")
        >>> p, heaters = dict(zip(kit.parameters, kit.prior)), dict.fromkeys(kit.inputs, (0.0, 100.0))
        >>> plant = Plant(kit, p, dt=kit.dt, units=kit.units, valid=heaters)
        >>> controller = design_controller(plant, dt=5.0)
        >>> controller.reset({"t1": 30.0, "t2": 30.0})
        >>> controller.observer.reading().round(3)
        array([30., 30.])
        """
        self._start(*self._read(reading))
        self._begin_positions()
        self._u = self._in_force = self._applied(reading, self._u)
        self.pi.reset(reading)
        self.times.reset()

    def step(
        self,
        reading: Readings,
        target: Trajectory,
        *,
        coming: Mapping[str, Sequence[float]] | None = None,
    ) -> Move:
        """Return the move for this sample.

        Parameters
        ----------
        reading : mapping of str to float
            Temperatures by name [degC]; ``time_s`` may be absent, then one sample time has passed.  Before
            its sample time is over a move is held; the seconds count all the same.  A drive's
            own name may stand there too: then that is what was applied, whatever was asked.  So may that of a
            switch (``"pump": 0``): then no water moves the heat, and the drive goes to zero until it runs.
        target : float or mapping of str to float
            [degC] by output name; a single number is the target of every controlled output. A sequence is a
            trajectory: the target now, and those of the samples ahead.
        coming : mapping of str to sequence of float, optional
            Measured disturbances of the samples ahead, by name, the first a sample from now; the last stays.

        Examples
        --------
        >>> from thermogrip.sysid import Plant, load_network
        >>> kit = load_network("tclab")
        >>> p, heaters = dict(zip(kit.parameters, kit.prior)), dict.fromkeys(kit.inputs, (0.0, 100.0))
        >>> plant = Plant(kit, p, dt=kit.dt, units=kit.units, valid=heaters)
        >>> controller = design_controller(plant, dt=5.0)
        >>> controller.reset({"t1": 25.0, "t2": 25.0})
        >>> move = controller.step({"t1": 25.0, "t2": 25.0}, {"t1": 40.0, "t2": 30.0})
        >>> move.status, {name: round(value, 1) for name, value in move.drive.items()}
        ('ok', {'q1': 62.5, 'q2': 62.5})
        """
        started = self.clock()
        self.last_iterations = 0
        self.times.call(reading)
        self._slew_s = self.times.slew_s
        y, d = self._read(reading)
        if is_off([name for name in self.model.model.switches if name not in self.model.drives], reading):
            return self._pause(y, d, target, started)
        applied = self._applied(reading, self._in_force)
        self._pass(self.times.seconds, applied)
        if not self.times.due:
            if not self.times.stale:
                self._refine(y)
            return self._held_move(started)
        if self.times.stale:
            y = np.full(self.model.n_y, np.nan)
        said = self._absorb(y, d, applied) or (STALE if self.times.stale else "")
        in_force = self._u.copy()
        wanted, wrong = self._wanted(target)
        self._coming = self._forecast(coming or {})
        if not np.array_equal(wanted, self._target):
            self._side = self._sides(wanted)
        self._target = wanted
        self._ahead = self._trajectory(target)
        if self.design.ramp_per_s:
            wanted = self._ramp(wanted)
        u, status, advice = self._decide(wanted, started)
        if status == "ok":  # what happened in this sample, before what has been so for long
            advice = said or advice
        if wrong and status == "ok":
            status = "infeasible"
        self._u = self._within(u, self._slew_s)
        # where the computer is slow, the drive of now goes on while the new one is worked out
        self._in_force = in_force if self.design.move_delay else self._u
        return self._answer(status, wrong or advice or said, started, self._predicted())

    # ---- one step, in order ----

    def _start(self, y: Array, d: Array) -> None:
        self._d = np.where(np.isfinite(d), d, self.model.undisturbed(self.design.ambient))
        self.observer.reset(y, self._d)
        self._forget()
        self._in_force = self._u
        self._side = np.zeros(len(self._rows))
        self._plan = None
        self._y_plan = np.zeros((0, self.model.n_y))
        self._age_s = 0.0  # since the plan was made
        self._ramped = np.full(len(self._rows), np.nan)
        self._silent_s = 0.0  # that nobody called, where it was too long to know the past
        self._y = y
        self._seen = self.observer.now  # where the estimate stood after the last reading
        self._fresh = True
        self._on_pi = False
        self.monitor.forget(y)
        self.reach.forget()
        self.optimiser.forget()

    def _pass(self, seconds: float, applied: Array) -> None:
        """Let the estimate and the plan go on by so many seconds under the drives that were applied."""
        if self._fresh:
            return  # it begins with this reading
        if seconds > RESTART_S + self.dt:
            # until a reading comes to start again from, no more is predicted than a silence that would count
            self._silent_s, seconds = seconds, RESTART_S
        self.observer.advance(seconds, applied, self._d)
        self._age_s += seconds

    def _absorb(self, y: Array, d: Array, applied: Array) -> str:
        """Correct the estimate with this reading; return what the operator should know."""
        elapsed, silent = self.times.waited_s, self._silent_s
        if silent and np.isfinite(y).any():
            u, target, side = self._u, self._target, self._side
            self._start(y, np.where(np.isfinite(d), d, self._d))
            self._u, self._in_force, self._fresh = u, applied, False
            self._target, self._side, self._y = target, side, y
            return f"no reading for {silent:.0f} s: the estimate was started again"
        if not self._fresh:
            self.observer.look(self._d)
            self.monitor.expect(self.model.C @ (self.observer.now - self._seen))
        self._fresh = False
        if not self.design.move_delay:
            self._u = applied  # the slew limit counts from what was really applied
        self._d = np.where(np.isfinite(d), d, self._d)
        y, stays = self.monitor.screen(y, self.observer.reading())
        jumped = self._accept_jump(y, stays) if stays.any() else ""
        self.observer.update(y)
        self._y, self._seen = y, self.observer.now
        lost = [name for name, value in zip(self.model.outputs, y) if not np.isfinite(value)]
        lost += [name for name, value in zip(self.model.disturbances, d) if not np.isfinite(value)]
        self._unread_s = np.where(np.isfinite(y[self._rows]), 0.0, self._unread_s + elapsed)
        stuck = ", stuck: it should have moved" if self.monitor.stuck.any() else ""
        return jumped or (f"{', '.join(lost)}: no usable reading{stuck}" if lost else "")

    def _refine(self, y: Array) -> None:
        """Correct the estimate with a reading that comes before a move is due."""
        if self._fresh or not np.isfinite(y).any():
            return
        self.observer.look(self._d)
        self.monitor.expect(self.model.C @ (self.observer.now - self._seen))
        self.observer.refine(self.monitor.screen_between(y, self.observer.reading()))
        self._seen = self.observer.now

    def _accept_jump(self, y: Array, stays: Mask) -> str:
        """Take a jump that stays for an offset of its sensor, or for another world; return what it was."""
        names = ", ".join(name for name, jumped in zip(self.model.outputs, stays) if jumped)
        if 2 * stays.sum() < np.isfinite(y).sum():
            self.observer.set_offsets(y, stays)
            return f"{names}: a jump that stays, taken for an offset of the sensor"
        self.observer.reset(y, self._d)
        return f"{names}: a jump that stays, the estimate was started again"

    def _sides(self, wanted: Array) -> Array:
        """Return from where the targets are approached: +1 from below, -1 from above, 0 neither."""
        return np.where(np.isfinite(wanted), np.sign(wanted - self.observer.reading()[self._rows]), 0.0)

    def _pause(self, y: Array, d: Array, target: Trajectory, started: float) -> Move:
        """Take the drive back while no water moves its heat; the estimate starts again afterwards."""
        u = self._within(self._neutral, self._slew_s)
        wanted, _ = self._wanted(target)
        self._start(y, np.where(np.isfinite(d), d, self._d))
        self._u = self._in_force = u
        self._target, self._side = wanted, self._sides(wanted)
        advice = f"{', '.join(self.model.model.switches)} is off: drive to zero until it runs"
        # without a pump that is asked for nobody would switch it on again
        self._move = replace(self._answer("off", advice, started, self._predicted()), pump=1)
        return self._move

    def _first_of(self, plan: Array) -> Array:
        """Return what of a plan (N, n_u) to apply until the next call."""
        return opening(plan, self._slew_s / self.dt)

    def _decide(self, wanted: Array, started: float) -> tuple[Array, str, str]:
        """Return the drives, the status and the advice: optimiser, else plan, else PI, else off."""
        if not np.isfinite(wanted).all():
            return self._safe, "off", f"no target yet: {self._away}"
        if (self._unread_s > 0).all():
            return self._without_readings()
        if self.clock() - started >= self.design.deadline_s:
            return self._fall_back("late", "the deadline passed before the optimiser could start")
        outside = np.any(self._u < self.optimiser.lowest - 1e-9) or np.any(
            self._u > self.optimiser.highest + 1e-9
        )
        try:
            outcome = self._optimise(wanted)
            self.last_iterations = outcome.iterations
        except (np.linalg.LinAlgError, ArithmeticError) as error:
            return self._fall_back("fallback_plan", f"the prediction failed: {error}")
        self.observer.hold_drives(outcome.authority < WEAK)
        if outcome.status != "solved":
            status = {"infeasible": "infeasible", "time limit": "late"}.get(outcome.status, "fallback_plan")
            return self._fall_back(status, f"optimiser: {outcome.status}")
        self._plan = np.repeat(outcome.plan, self.design.blocks, axis=0)
        self._y_plan, self._age_s, self._on_pi = outcome.y, 0.0, False
        u = self._first_of(self._plan)
        if outside:
            return u, "infeasible", "the drive that was applied is out of range: brought back"
        end, zone = outcome.y[-1, self._rows], self.optimiser.zone
        missed = self.reach.missed(
            self.observer,
            self._u,
            self._d,
            target=np.where(zone > 0, np.clip(end, wanted - zone, wanted + zone), wanted),
            side=self._side,
            ahead=end,
            seen=self._unread_s == 0,
        )
        if missed is not None:
            what = f"{self.controlled[missed[0]]} at {wanted[missed[0]]:.1f} degC"
            return u, "infeasible", f"no drive holds {what}: {missed[1]:.1f} degC can be held"
        if outcome.broken:
            name, over = max(outcome.broken.items(), key=lambda item: item[1])
            advice = f"limit of {name} will be broken by {over:.1f} degC: choose a nearer target"
            return u, "infeasible" if over > 0.5 else "ok", advice
        if self.clock() - started > self.design.deadline_s:
            return u, "late", "the step took longer than its deadline"
        if (self._unread_s > 0).any():
            lost = self._lost
            parked = [name for name, at in zip(self.model.drives, self.optimiser.pair) if lost[at]]
            return u, "fallback_plan", self._unseen(parked)
        waits = f"{', '.join(self.design.on_off)} may go over in {self._waits:.0f} s" if self._waits else ""
        return u, "ok", waits

    def _optimise(self, wanted: Array) -> Outcome:
        last = np.clip(self._u, self.optimiser.lowest, self.optimiser.highest)
        observer = self.observer
        d = self._d + observer.disturbance_bias
        x = observer.now
        if self.design.move_delay:  # the drive applied now stays for one more sample
            x = self.model.next_state(x, last + observer.drive_bias, d)
        guess, biases = self._guess(wanted, last), (observer.output_bias, observer.drive_bias)
        caution = min(max(1.0, float(np.max(np.abs(observer.innovation))) / CAUTION), MOST_CAUTION)
        if self._coming is not None:
            d = np.where(np.isfinite(self._coming), self._coming, self._d) + observer.disturbance_bias
        sample = Sample(x, last, guess, d, wanted, self._side, *biases, self._slew_s, self._lost, caution)
        sample = sample._replace(ahead=self._ahead, prices=self._prices())
        self._waits = 0.0
        if not self.design.on_off:
            return self._converged(sample)
        ((name, (on_s, off_s, price)),) = self.design.on_off.items()
        j = self.model.drives.index(name)
        at = float(round(last[j]))
        choice = choose(
            self.optimiser,
            j,
            lambda: self._converged(sample),
            position=at,
            wait_s=self._wait_s(j),
            stays_s=off_s if at else on_s,
            price=price,
        )
        self._waits = choice.wait_s
        return choice.outcome

    def _converged(self, sample: Sample) -> Outcome:
        """Return what one program gives, or as many as the design asks for until the plan stays."""
        found, changes = self.optimiser.solve(sample), 0
        for _ in range(1, self.design.iterations if self.model.affine is None else 1):
            moved = np.abs(found.plan - sample.guess) > STAYS * self.model.span
            if found.status != "solved" or not moved.any():
                break
            sample, changes = sample._replace(guess=found.plan), changes + found.iterations
            found = self.optimiser.solve(sample)
        return replace(found, iterations=found.iterations + changes)

    @property
    def _away(self) -> str:
        """Where drives go without a loop, in words."""
        return "drives to their safe values" if self.design.safe_drive else "drive to zero"

    def _prices(self) -> Array | None:
        """Return how many times the energy price counts in the samples (N,) that are predicted."""
        tariff = self.design.tariff
        if not tariff or not np.isfinite(self.times.now):
            return None
        seconds = (self.times.now + self.dt * np.arange(self.optimiser.N)) % DAY
        starts, factors = np.array(tariff).T
        at = np.searchsorted(starts, seconds, side="right") - 1  # -1: of the day before
        return np.asarray(factors[at], dtype=np.float64)

    def _forecast(self, coming: Mapping[str, Sequence[float]]) -> Array | None:
        """Return what is told of the measured disturbances (N, n_d), NaN where nothing is."""
        lines = [_line(coming.get(name)) for name in self.model.disturbances]
        if not any(np.isfinite(line).any() for line in lines):
            return None
        at = self.design.move_delay + np.arange(self.optimiser.N) - 1  # in a sample its start is in force
        told = np.column_stack([line[np.clip(at, 0, len(line) - 1)] for line in lines])
        told[at < 0] = np.nan
        return np.where((told >= self.model.coldest) & (told <= self.model.hottest), told, np.nan)

    def _ramp(self, wanted: Array) -> Array:
        """Return the targets now (n_controlled,), of those that may only ramp a sample further on the way;
        what is ahead goes on from there."""
        rates = np.array([self.design.ramp_per_s.get(name, np.inf) for name in self.controlled])
        shown = self._y[self._rows]
        begun = np.where(np.isfinite(self._ramped), self._ramped, shown)
        reach = rates * self.times.waited_s
        now = np.where(np.isfinite(begun), np.clip(wanted, begun - reach, begun + reach), wanted)
        self._ramped = now
        later = (self.design.move_delay + np.arange(1, self.optimiser.N + 1))[:, None] * rates * self.dt
        ends = np.broadcast_to(wanted, later.shape) if self._ahead is None else self._ahead
        if np.any(now != wanted) or self._ahead is not None:
            self._ahead = np.clip(ends, now - later, now + later)
        return now

    def _trajectory(self, target: Trajectory) -> Array | None:
        """Return the targets (N, n_controlled) of the samples that are predicted; None where they stay."""
        if not isinstance(target, Mapping) or not any(isinstance(v, Sequence) for v in target.values()):
            return None
        at = self.design.move_delay + np.arange(1, self.optimiser.N + 1)
        lines = [np.atleast_1d(target.get(name, now)) for name, now in zip(self.controlled, self._target)]
        ahead = np.column_stack([line[np.minimum(at, len(line) - 1)] for line in lines]).astype(float)
        low, high = self.model.coldest, self.model.hottest
        return np.where((ahead >= low) & (ahead <= high), ahead, self._target)  # NaN is neither

    def _guess(self, wanted: Array, last: Array) -> Array:
        """Return the plan to linearise along: the last one, shifted, by blocks; else the drive of now."""
        plan = self.plan
        if plan is None:
            return np.repeat(last[None, :], self.optimiser.n_b, axis=0)
        lengths = np.asarray(self.design.blocks)
        begins = np.cumsum(lengths) - lengths
        return np.asarray(np.add.reduceat(plan, begins, axis=0) / lengths[:, None])

    def _without_readings(self) -> tuple[Array, str, str]:
        if not self._lost.all():
            plan = self._young_plan()
            return self._u if plan is None else self._first_of(plan), "fallback_plan", ""
        self._plan = None
        return self._safe, "off", f"no reading for {self._unread_s.min():.0f} s: check the sensor"

    def _young_plan(self) -> Array | None:
        return None if self._on_pi or self._age_s > self._patience_s else self.plan

    def _fall_back(self, status: str, advice: str) -> tuple[Array, str, str]:
        """Follow the plan while it is young; then PI, then off."""
        plan = self._young_plan()
        if plan is not None:
            return self._first_of(plan), status, advice
        y = self._y[self._rows]
        if not self.pi.loops or not np.isfinite(y).all():
            return self._safe, "off", advice
        if not self._on_pi:
            self.pi.follow(self._u, y, self._target, self._d)
        self._on_pi = True
        self.pi.hold(np.clip(self._u, self.optimiser.lowest, self.optimiser.highest))
        u = self.pi.propose(y, self._target, self._d, seconds=self._slew_s)
        return u, "fallback_pi" if status == "fallback_plan" else status, advice

    def _predicted(self) -> dict[str, tuple[float, ...]]:
        return {name: tuple(self._y_plan[:, i].tolist()) for i, name in enumerate(self.model.outputs)}


def _line(values: object) -> Array:
    """Return numbers in a row, NaN where they are none."""
    try:
        line = np.ravel(np.asarray(values, dtype=float))
    except (TypeError, ValueError):
        line = np.empty(0)
    return line if line.size else np.full(1, np.nan)


def design_controller(plant: Plant, **changes: Any) -> Controller:
    """Return a controller of the plant's default design, with any field of Design changed.

    Parameters
    ----------
    plant : Plant
    **changes
        ``controlled``, ``dt``, and any other field of :class:`thermogrip.mpc.design.design.Design`.

    Examples
    --------
    >>> from thermogrip.sysid import Plant, load_network
    >>> kit = load_network("tclab")
    >>> p, heaters = dict(zip(kit.parameters, kit.prior)), dict.fromkeys(kit.inputs, (0.0, 100.0))
    >>> plant = Plant(kit, p, dt=kit.dt, units=kit.units, valid=heaters)
    >>> controller = design_controller(plant, controlled=("t1",), move=2.0)
    >>> controller.dt, controller.design.move
    (2.0, 2.0)
    """
    return Controller(plant, default_design(plant, **changes))
