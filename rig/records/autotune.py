"""From a rig that nobody has seen to its tuned loop, in one folder that can be gone on with.

    step test      each drive in turn, a few minutes (:mod:`~thermogrip.rig.session.step_test`)
    first plant    identified from that alone; a PI of its responses by SIMC
    loops          under that PI a step to the target, then targets that a PRBS moves, until the verdict of
                   ``identify`` on all logs is good or the time is over
    tune           of the last plant
    check          a session to the target under the controller that came of it

Each session has a run folder of its own in the folder (``01-step``, ``02-loop``, ...), and what is known so
far stands beside them.  Whatever ended it, the same call goes on from the sessions that are there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.files import make_folder, read_json, write_json
from thermogrip.datasets.parallel import sub_progress
from thermogrip.datasets.schema import Log, column
from thermogrip.rig.guard.guard import LIMIT_MARGIN, Guard
from thermogrip.rig.interface import Rig, known_range
from thermogrip.rig.records.run_folder import Run, RunFolder, read_run, recover
from thermogrip.rig.session.profile import Profile
from thermogrip.rig.session.session import Session, play, run_session, step_figures
from thermogrip.rig.session.step_test import StepTest

if TYPE_CHECKING:
    from thermogrip.datasets.parallel import Progress, Workers
    from thermogrip.mpc.design.relays import Relay
    from thermogrip.mpc.design.spec import Spec
    from thermogrip.mpc.interface import Move
    from thermogrip.mpc.tuning.tune import Tuning
    from thermogrip.sysid.identification import Identification
    from thermogrip.sysid.plant.plant import Plant

SCHEMA, VERSION = "thermogrip.autotune", 1
#: Candidates that a log of minutes is fitted with; the others take longer, and longer logs.
MODELS = ("arx", "oe", "subspace", "network")


@dataclass(frozen=True)
class LoopLog:
    """How the log under the first loop is excited."""

    hold: float = 6.0  # integral times for which the step is held: the loop has settled by then
    bits: int = 15  # the period of a register of four bits, the shortest in which every pair of bits occurs
    overshoot: float = 0.15  # of the way from where it began, kept off the limit: by SIMC a tenth
    excited: float = 0.25  # of the way to the target, by which a target is moved
    least_s: float = 120.0  # the first minute of a log sets the state, and is not scored


LOG = LoopLog()


class Tripped(Exception):
    """The guard ended a session of it; the line of the trip."""


@dataclass
class Autotune:
    """An autotune in its folder: what was asked, how a rig is had, and how it is shown.

    ``open_rig`` and ``make_guard`` are called for each session, the latter with the plant that the guard may
    trust, None before there is one; ``shown`` are the ``listener`` and ``operator`` of sessions.
    """

    folder: Path
    target: float | Mapping[str, float]
    open_rig: Callable[[], Rig]
    make_guard: Callable[[Plant | None], Guard]
    minutes: float = 30.0  # of step test and loops together, at most
    spec: Spec | None = None
    relays: Mapping[str, Relay] = field(default_factory=dict)  # of the rig's drives
    about: Mapping[str, Any] = field(default_factory=dict)
    clock: Callable[[], float] | None = None
    progress: Progress | None = None
    shown: Mapping[str, Any] = field(default_factory=dict)
    say: Callable[[str], None] = print
    models: Sequence[str] = MODELS
    workers: Workers = 1
    seed: int = 0

    def __post_init__(self) -> None:
        self.known: dict[str, Any] = {}  # figures by stage, as they are in the file
        self.found: Identification  # in the logs so far
        self.tuning: Tuning | None = None
        self.session: Session | None = None
        self.moves: list[tuple[float, Move]] = []

    def run(self) -> None:
        """Do what is left to do; :class:`Tripped` where the guard ends a session."""
        self._begin()
        if "checked" in self.known:
            return
        if not self.logs():
            self._test()
        self._identify()
        while not (self.found.good and "pi" in self.known) and self._loop():
            self._identify()
        self._tune()
        self._check()

    def _begin(self) -> None:
        """Make the folder, or take up what is in it; UserError where that was asked otherwise."""
        make_folder(self.folder)
        file, target = self.folder / "autotune.json", self.target
        request = {"target": dict(target) if isinstance(target, Mapping) else target, **self.about}
        if file.exists():
            content = read_json(file, SCHEMA, VERSION)
            if content["asked"] != request:
                differs = next(key for key in request if content["asked"].get(key) != request[key])
                problem = f"is of another autotune, with {differs} {content['asked'].get(differs)}"
                raise UserError(problem, file=self.folder, hint="choose another folder, or ask the same")
            self.known = content["known"]
            for run_folder in self._folders():
                recover(run_folder)
            if spent := self.spent_s:
                self.say(f"goes on after {spent / 60:.1f} min on the rig")
        elif any(self.folder.iterdir()):
            raise UserError("holds something else", file=self.folder, hint="give a new folder")
        self._asked = request
        self._note()

    def _note(self, **known: Any) -> None:
        """Keep what is known by now."""
        self.known |= known
        content = {"asked": self._asked, "known": self.known}
        write_json(self.folder / "autotune.json", content, schema=SCHEMA, version=VERSION)

    def _part(self, begin: float, end: float) -> Progress | None:
        return sub_progress(self.progress, begin, end)

    def _folders(self, kind: str = "*") -> list[Path]:
        return sorted(path for path in self.folder.glob(f"[0-9][0-9]-{kind}") if path.is_dir())

    def logs(self) -> list[Log]:
        """Return what the sessions before the tuning recorded, a step test only where it was played out."""
        logs = []
        for path in (*self._folders("step"), *self._folders("loop")):
            run = read_run(path)
            whole = run.about.get("verdict") == "played" or path.name.endswith("loop")
            if run.log is not None and whole and np.ptp(run.log["time"].values) >= LOG.least_s:
                logs.append(run.log)
        return logs

    @property
    def spent_s(self) -> float:
        """Time on the rig so far, but for the check [s]."""
        logs = [read_run(path).log for kind in ("step", "loop") for path in self._folders(kind)]
        return sum(float(np.ptp(log["time"].values)) for log in logs if log is not None)

    def _test(self) -> None:
        """Play the step test."""
        with closing(self.open_rig()) as rig:
            reading, guard = rig.read(), self.make_guard(None)
            rooms = guard.rooms(reading.values)
            begin = {name: value for name, value in reading.values.items() if name not in rooms}
            if isinstance(self.target, Mapping):
                goals = {name: self.target[name] for name in begin if name in self.target}
            else:
                goals = dict.fromkeys(begin, self.target)
            for name, goal in goals.items():
                guard.check_target(name, goal)
            goals = {name: self._highest(guard, name, begin[name], goal) for name, goal in goals.items()}
            if not goals:
                names = ", ".join(begin)
                raise UserError(f"the rig has no sensor of {self.target}", hint=f"it has {names}")
            hint = "record a log of it, and go on with identify and tune"
            ranges = {name: known_range(name, unit, None, hint=hint) for name, unit in rig.units.items()}
            test = StepTest(ranges, goals, seconds=30 * self.minutes, has_pump=rig.has_pump)
            self._note(start={name: round(value, 2) for name, value in begin.items()})
            with RunFolder(self._next("step"), self._asked) as folder:
                options = {"progress": self._part(0.0, 0.1), **self.shown}
                log, ended = play(rig, test, guard=guard, clock=self.clock, recorder=folder, **options)
                folder.played(ended)
        if ended:
            raise Tripped(ended)
        self.say(f"step test: {np.ptp(log['time'].values) / 60:.1f} min")

    def _highest(self, guard: Guard, name: str, begin: float, goal: float) -> float:
        """Return the target of an output, or as far as one may go without a limit in reach."""
        low, high = guard.limits_of(name)
        reserve = LIMIT_MARGIN + LOG.overshoot * abs(goal - begin)
        return float(np.clip(goal, low + reserve, high - reserve))

    def _next(self, kind: str) -> Path:
        return self.folder / f"{len(self._folders()) + 1:02d}-{kind}"

    def _identify(self) -> None:
        """Find the plant behind all logs so far, and keep it with the controller by default."""
        from thermogrip.mpc.controllers.pi import PIController
        from thermogrip.mpc.design.design import default_design
        from thermogrip.sysid.data.shipped_networks import shipped_network
        from thermogrip.sysid.identification import identify

        logs = self.logs()
        self.found = identify(
            logs, shipped_network(logs), models=self.models, seed=self.seed, workers=self.workers,
            progress=self._part(0.4, 0.5),
        )  # fmt: skip
        plant = self.found.plant
        plant.save(self.folder / "plant.json")
        design = default_design(plant, controlled=tuple(self._targets(plant)))
        PIController(plant, design).save(self.folder / "controller.json")
        loops = (run for run in map(read_run, self._folders("loop")) if run.log is not None)
        steps = [step for run in loops if (step := first_step(run, self._targets(plant)))]
        if steps:  # also of a loop that was stopped after its first step
            self._note(pi=steps[0])
        self.say(self.found.verdict)

    def _targets(self, plant: Plant) -> dict[str, float]:
        """Return the target of each regulated output."""
        from thermogrip.mpc.design.design import default_controlled

        if not isinstance(self.target, Mapping):
            return dict.fromkeys(default_controlled(plant), self.target)
        if unknown := [name for name in self.target if name not in plant.outputs]:
            problem = f"--target names {unknown[0]}, which no drive moves"
            raise UserError(problem, hint=f"these answer: {', '.join(plant.outputs)}")
        return dict(self.target)

    def _loop(self) -> bool:
        """Record a loop under the PI; False where there is no time for one."""
        from thermogrip.mpc.controllers.pi import PIController

        plant = self.found.plant
        targets = self._targets(plant)
        loop = PIController(plant, controlled=tuple(targets))
        slowest = max(loop_of_pi.Ti for loop_of_pi in loop.loops)
        seconds = min(60 * self.minutes - self.spent_s, (LOG.hold + 0.5 * LOG.bits) * slowest)
        if seconds < LOG.least_s:
            return False
        if "first" not in self.known:
            loops = [f"{p.drive} on {p.output}, Kc {p.Kc:.3g}, Ti {p.Ti:.3g} s" for p in loop.loops]
            self.say(f"first loop after {self.spent_s / 60:.1f} min: {'; '.join(loops)}")
            self._note(first={"minutes": round(self.spent_s / 60, 1), "loops": loops})
        with closing(self.open_rig()) as rig:
            guard = self.make_guard(None)
            profile = self._excited(targets, slowest, seconds, guard)
            with RunFolder(self._next("loop"), self._asked) as folder:
                session = run_session(
                    rig, loop, profile.at(0.0), output=loop.controlled[0], profile=profile, guard=guard,
                    clock=self.clock, recorder=folder, progress=self._part(0.1, 0.4), **self.shown,
                )  # fmt: skip
                folder.finish(session)
        if session.trip is not None:
            raise Tripped(session.advice)
        return True

    def _excited(self, targets: Mapping[str, float], slowest: float, seconds: float, guard: Guard) -> Profile:
        """Return the targets of a loop's log: held, then moved by a PRBS, each output by its own."""
        from thermogrip.sysid.experiment.schedules import prbs

        # SIMC's integral time is 8 delays of what it controls (or the lag, where that is shorter); a bit
        # lasts half of one, in which the loop answers a change of its target
        bits = int((seconds - LOG.hold * slowest) / (0.5 * slowest))
        turn = len(self._folders("loop"))
        time = LOG.hold * slowest + 0.5 * slowest * np.repeat(np.arange(max(bits, 0) + 1), 2)[1:-1]
        moved = {}
        for k, (name, goal) in enumerate(targets.items()):
            begin = self.known["start"].get(name, goal)
            highest = self._highest(guard, name, begin, goal + LOG.excited * (goal - begin))
            base = goal if abs(goal - begin) < abs(highest - begin) else highest
            shape = prbs(max(bits, 1), hold=1, seed=turn + k)
            levels = highest + LOG.excited * (goal - begin) * (shape - 1)
            moved[name] = np.concatenate([[base, base], np.repeat(levels[: max(bits, 0)], 2)])
        begins = np.array([0.0, LOG.hold * slowest])
        return Profile(np.concatenate([begins, time]) if bits > 0 else np.array([0.0, seconds]), moved)

    def _tune(self) -> None:
        """Tune for a step from where it began to the target, and keep the controller."""
        from thermogrip.mpc.design.spec import Spec
        from thermogrip.mpc.tuning.tune import tune

        plant = self.found.plant
        targets, spec = self._targets(plant), self.spec or Spec()
        begin = [self.known["start"].get(name, goal) for name, goal in targets.items()]
        step = float(np.mean(begin)), float(np.mean(list(targets.values())))
        wanted: dict[str, Any] = {"steps": [step], "output": list(targets)}
        wanted |= spec.model_dump(exclude_unset=True)
        spec = Spec(**wanted).completed(plant)
        switched = {name: relay for name, relay in self.relays.items() if name in plant.inputs}
        spec = spec.model_copy(update={"relays": switched or None})
        self.tuning = tune(plant, spec, progress=self._part(0.5, 0.9), seed=self.seed)
        self.tuning.save(self.folder / "controller.json")
        if self.tuning.interrupted:
            raise KeyboardInterrupt
        figures_so_far = {"minutes": round(self.spent_s / 60, 1), "good": self.found.good}
        self._note(tuned=figures_so_far | {"verdict": self.tuning.verdict})
        self.say(f"{self.tuning.verdict}: {self.tuning.finding}")

    def _check(self) -> None:
        """Run a session to the target under the tuned controller."""
        from thermogrip.mpc.closed_loop.simulate import RecordedController

        assert self.tuning is not None
        plant, regulator = self.found.plant, RecordedController(self.tuning.controller)
        targets = self._targets(plant)
        with closing(self.open_rig()) as rig, RunFolder(self._next("check"), self._asked) as folder:
            self.session = run_session(
                rig, regulator, targets, output=next(iter(targets)), hold=120.0,
                guard=self.make_guard(plant), clock=self.clock, recorder=folder,
                progress=self._part(0.9, 1.0), **self.shown,
            )  # fmt: skip
            folder.finish(self.session)
        self.moves = regulator.moves
        figures = {"settle_s": self.session.settle_time, "overshoot": self.session.overshoot}
        self._note(checked={"verdict": self.session.verdict, **_finite(figures)})


def first_step(run: Run, targets: Iterable[str]) -> dict[str, float | None] | None:
    """Return the figures of a loop's first step, those of the worst output; None where it ended in it."""
    log = run.log
    assert log is not None
    time = np.asarray(log["time"].values, dtype=float)
    goals = {name: column(log, f"target_{name}") for name in targets}
    moved = np.any([goal != goal[0] for goal in goals.values()], axis=0)
    if not moved.any() and run.about.get("verdict") != "followed":
        return None
    n = int(np.argmax(moved)) or time.size
    steps = [step_figures(time[:n], column(log, name)[:n], float(goals[name][0])) for name in goals]
    settle, overshoot = np.max([(step.settle_time, step.overshoot) for step in steps], axis=0)
    return _finite({"settle_s": float(settle), "overshoot": float(overshoot)})


def _finite(figures: Mapping[str, float]) -> dict[str, float | None]:
    """Return figures as JSON has them, which knows no NaN."""
    return {key: round(value, 3) if value == value else None for key, value in figures.items()}
