"""run, batch, record, recover, virtual: sessions and schedules on a rig, its twin, or a simulated device."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from thermogrip.cli import options as cli
from thermogrip.cli.control import ControllerFile, load_controller
from thermogrip.datasets.errors import UserError, as_user_error
from thermogrip.report.console import Console
from thermogrip.rig.session.signals import check_stopped, stop_signals
from thermogrip.rig.simulation.faults import FAULTS
from thermogrip.sysid.contact.materials import find_material

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Grasps
    from thermogrip.live.watch import Watch
    from thermogrip.mpc.controllers.mpc import Controller
    from thermogrip.mpc.controllers.pi import PIController
    from thermogrip.mpc.design.relays import Relay
    from thermogrip.rig.clock import ScaledClock
    from thermogrip.rig.guard.guard import Guard
    from thermogrip.rig.guard.trip import Trip
    from thermogrip.rig.interface import Rig
    from thermogrip.rig.records.batch import Trial
    from thermogrip.rig.records.run_folder import RunFolder
    from thermogrip.rig.session.loop import Recorder
    from thermogrip.rig.session.session import Session
    from thermogrip.rig.simulation.twin import Twin
    from thermogrip.sysid.plant.plant import Plant


WATCHED_SPEED = 10.0  # of a twin [times real time]: settling, minutes long, in a few tens of seconds
PROTOCOLS = ("thermogrip", "tclab")


def _check_bridge(url: str | None) -> str | None:
    """Refuse what is no address of a websocket."""
    if url is not None and not url.startswith(("ws://", "wss://")):
        raise UserError(f"--bridge {url!r} is no address", hint=f"write ws://{url.rpartition('/')[2]}")
    return url


OutOption = Annotated[Path, cli.opt("--out", "DIR", "Folder of the run.")]
ProtocolOption = Annotated[str | None, cli.shared("--protocol", cli.one_of("--protocol", PROTOCOLS))]
StartOption = Annotated[float | None, cli.shared("--from")]
ObjOption = Annotated[float | None, cli.shared("--object")]
MaterialOption = Annotated[
    str | None, cli.shared("--material", lambda name: name and find_material(name).name)
]
GuardOption = Annotated[Path | None, cli.shared("--guard")]
BridgeOption = Annotated[str | None, cli.shared("--bridge", _check_bridge)]


@dataclass(frozen=True)
class ShowOptions:
    """Where a session is shown."""

    live: Annotated[int | None, cli.shared("--live")] = None
    foxglove: Annotated[int | None, cli.shared("--foxglove")] = None

    def watch(self, title: str, console: Console, out: Path, pace: float | None = None) -> Watch:
        """Return what shows a session, ``pace`` times as fast as real time where a twin is watched."""
        from thermogrip.live.watch import Show, Watch

        layout = out / "foxglove_layout.json"
        show = Show(live=self.live, foxglove=self.foxglove, layout=layout, pace=pace)
        return Watch(title, console, show)


@dataclass(frozen=True)
class RigOptions:
    """A rig on a port, or the twin of a plant."""

    port: Annotated[str | None, cli.shared("--port")] = None
    protocol: ProtocolOption = None
    speed: Annotated[float | None, cli.shared("--speed")] = None
    twin: Annotated[Path | None, cli.shared("--twin")] = None
    draw: Annotated[int, cli.shared("--draw")] = 0
    relays: Annotated[Path | None, cli.shared("--relays")] = None
    start: StartOption = None
    network: cli.OwnNetwork = None

    def check(self) -> None:
        """Raise UserError unless either hardware or a plant to simulate is named."""
        if (self.twin is None) == (self.port is None):
            problem = "no rig is given" if self.twin is None else "--port and --twin are both given"
            raise UserError(problem, hint="give --port DEV, or --twin PLANT to simulate")
        if self.port is not None and (self.start is not None or self.draw):
            raise UserError("--from and --draw are of the twin", hint="leave them away with --port")

    @property
    def name(self) -> str:
        """What it is called in records."""
        return str(self.port) if self.twin is None else f"{self.twin.name}, draw {self.draw}"

    def about(self) -> dict[str, Any]:
        """Return what a run keeps of it."""
        return {"port": self.port} if self.twin is None else {"twin": self.twin.name, "draw": self.draw}

    def pace(self, show: ShowOptions) -> float | None:
        """Return the factor on real time at which a twin runs, None where it runs as fast as it goes."""
        if self.twin is None or self.speed is not None:
            return None if self.twin is None else self.speed
        return None if show.live is None and show.foxglove is None else WATCHED_SPEED

    def clock(self, pace: float | None) -> ScaledClock:
        """Return the clock of sessions on it."""
        from thermogrip.rig.clock import ScaledClock

        return ScaledClock(pace or self.speed or 1.0)

    def guard(self, path: Path | None, plant: Plant | None, *, limit: float | None = None) -> Guard:
        """Return its guard."""
        return guard_of(path, plant, speed=self.speed or 1.0, limit=limit)

    def switched(self, otherwise: Mapping[str, Relay] | None) -> Mapping[str, Relay]:
        """Return the relays of the file, else these."""
        from thermogrip.rig.drivers.relays import read_relays

        return (otherwise or {}) if self.relays is None else read_relays(self.relays)

    def open(
        self,
        clock: ScaledClock,
        controller: Controller | PIController | None,
        *,
        pace: float | None,
        seed: int,
        relays: Mapping[str, Relay] | None = None,
        say: Callable[[str], None] | None = None,
    ) -> Rig:
        """Return the rig on a port, or the simulated one at a pace, with the relays of a file, else of the
        controller, else these; ``say`` what is switched, and what is round the simulated one."""
        from thermogrip.rig.clock import Metronome
        from thermogrip.rig.drivers.connect import open_rig
        from thermogrip.rig.drivers.relays import RelayRig, of_inputs

        switched = self.switched(relays if controller is None else controller.design.relays)
        if say is not None and switched:
            times = (
                f"{name} ({relay.on_s:g} s on, {relay.off_s:g} s off)" for name, relay in switched.items()
            )
            say(f"Switched, at least: {', '.join(times)}")
        if self.twin is not None:
            wait = None if pace is None else Metronome(clock, clock.sleep).wait
            simulated = self._twin(self.twin, controller, seed=seed, wait=wait)
            if say is not None and simulated.disturbances:
                values = (f"{name} {value:.4g}" for name, value in simulated.disturbances.items())
                say(f"The twin's world, from the middle of its plant's logs: {', '.join(values)}")
            switched = of_inputs(switched, simulated)
            return RelayRig(simulated, switched, lambda: simulated.time) if switched else simulated
        rig: Rig = open_rig(str(self.port), self.protocol, clock=clock, sleep=clock.sleep)
        try:
            rig = RelayRig(rig, switched, clock) if switched else rig
            inputs = () if controller is None else controller.plant.inputs
            if lacking := set(inputs) - set(rig.units) - {"pump"}:
                problem = f"the rig drives {', '.join(rig.units)}, not {', '.join(lacking)}"
                raise UserError(problem, hint="use its own controller")
        except UserError:
            rig.close()
            raise
        return rig

    def _twin(
        self,
        path: Path,
        controller: Controller | PIController | None,
        *,
        seed: int,
        wait: Callable[[float], None] | None,
    ) -> Twin:
        """Return the simulated rig; a drive whose unit does not say its range has the controller's."""
        from thermogrip.rig.interface import UNIT_RANGES
        from thermogrip.rig.simulation.twin import Twin
        from thermogrip.sysid.plant.linearise import ROOM
        from thermogrip.sysid.plant.plant import Plant

        try:
            plant = Plant.load(path)
        except UserError:
            if self.network is None:
                raise
            plant = cli.load_plant(path, self.network)
        ranges = {} if controller is None else controller.design.drive_range
        limits = {
            name: ends for name, ends in ranges.items() if plant.units.get(name, "1") not in UNIT_RANGES
        }
        room = ROOM if plant.room is None else plant.room
        drawn = plant.draw(self.draw)
        return Twin(drawn, seed=seed, ambient=room, t_start=self.start, limits=limits, pace=wait)


@dataclass(frozen=True)
class GraspOptions:
    """How long a session settles, and touches."""

    grasp_time: Annotated[float, cli.shared("--grasp-time")] = 10.0
    stop_early: Annotated[Path | None, cli.shared("--stop-early")] = None
    settle_timeout: Annotated[float | None, cli.shared("--settle-timeout")] = None

    def of_session(
        self, watch: Watch, controller: Controller | PIController, say: Callable[[str], None] | None
    ) -> dict[str, Any]:
        """Return them as a session takes them; ``say`` when it gives up."""
        from thermogrip.classify.decisions.stopping_rule import session_stop
        from thermogrip.mpc.tuning.design_review import settle_limit_s

        stop = None if self.stop_early is None else session_stop(self.stop_early, tell=watch.posterior)
        limit_s = self.settle_timeout
        if limit_s is None:
            limit_s = settle_limit_s(controller)
            if say is not None:
                say(f"Gives up settling after {limit_s:g} s, twice what the spec allows a step")
        return {"grasp_time": self.grasp_time, "settle_timeout": limit_s, "stop": stop}


@stop_signals()
@cli.grouped
def run(
    controller: ControllerFile,
    out: OutOption,
    rig: RigOptions,
    grasps: GraspOptions,
    show: ShowOptions,
    target: Annotated[
        str | None, cli.shared("--target", lambda value: value and (targets_of(value), value)[1])
    ] = None,
    profile: Annotated[Path | None, cli.shared("--profile")] = None,
    hold: Annotated[float, cli.shared("--hold")] = 0.0,
    obj: ObjOption = None,
    material: MaterialOption = None,
    guard: GuardOption = None,
    bridge: BridgeOption = None,
    report: cli.Report = None,
    seed: cli.Seed = 0,
    as_json: cli.AsJson = False,
) -> int:
    """Bring the skin to a temperature, stop the pump, grasp, record.

    Drive and pump are switched off on every way out, Ctrl-C included. With --object and --material it grasps
    after settling; without them it only regulates.
    """
    if (obj is None) != (material is None):
        problem = "one of --object and --material is missing"
        raise UserError(problem, hint="give both, or none to regulate only")
    grasp = None if obj is None or material is None else (material, obj)
    rig.check()
    wanted = _one_goal(target, profile, grasp is not None)
    cli.choices("--target", wanted if isinstance(wanted, dict) else (), controller, "outputs")
    from thermogrip.mpc.closed_loop.simulate import RecordedController
    from thermogrip.mpc.controllers.loop_monitor import LoopMonitor
    from thermogrip.mpc.tuning.design_review import beyond_logs, spec_of
    from thermogrip.report.control import session_sections
    from thermogrip.report.html import write_report
    from thermogrip.rig.session.profile import read_profile, tracking_error
    from thermogrip.rig.session.session import run_session

    if grasps.stop_early is not None and grasp is None:
        raise UserError("--stop-early without a grasp", hint="give --object and --material too")
    console, pace = Console(as_json), rig.pace(show)
    watch = show.watch("run", console, out, pace)
    loaded = load_controller(controller, rig.network)
    regulator, path = RecordedController(loaded, LoopMonitor(loaded.plant, loaded.design)), None
    if profile is not None:
        path = read_profile(profile, loaded.controlled, preview_s=loaded.dt * sum(loaded.design.blocks))
        wanted = path.at(0.0)
    wanted = _for_outputs(wanted, loaded.controlled)
    checks = rig.guard(guard, loaded.plant)
    by_name = wanted if isinstance(wanted, dict) else {loaded.controlled[0]: wanted}
    for output, value in by_name.items():
        checks.check_target(output, value)
    about = {"controller": controller.name, "target_degC": wanted, **rig.about()}
    about |= {} if profile is None else {"profile": profile.name}
    about |= {"from_degC": rig.start, "hold_s": hold, "object_degC": obj, "material": material, "seed": seed}
    clock = rig.clock(pace)
    of_grasp = grasps.of_session(watch, loaded, console.say if profile is None else None)
    if rig.port and (taken := spec_of(loaded, None)[0].surroundings_in_words(loaded.plant)):
        console.say(f"Where the rig does not read it, {taken}")
    opened = rig.open(clock, loaded, pace=pace, seed=seed, say=console.say)
    try:
        furthest = wanted if path is None else {n: float(v.max()) for n, v in path.targets.items()}
        for line in beyond_logs(loaded, furthest, grasps=grasp is not None):
            console.warn(line)
        with _recorded(out, about, bridge, watch) as (folder, recorder):
            session = run_session(
                opened,
                regulator,
                wanted,
                output=loaded.controlled[0],
                hold=hold,
                grasp=grasp,
                profile=path,
                guard=checks,
                clock=None if rig.port is None else clock,
                recorder=recorder,
                **watch.hooks,
                **of_grasp,
            )
            folder.finish(session)
            watch.ended(session.verdict)
    finally:
        opened.close()
    if report is not None:
        lead = f"One session on {rig.name}: what was read, asked and answered, sample by sample."
        write_report(report, "A session", lead, session_sections(session, regulator.moves, loaded, rig.name))
    goal = f"to {target} degC" if profile is None else f"along {profile.name}"
    errors = None if profile is None else tracking_error(session.log, loaded.controlled)
    return _session_code(console, session, f"{rig.name}, {goal}", out, errors)


def _session_code(
    console: Console, session: Session, title: str, out: Path, errors: tuple[float, float] | None
) -> int:
    """Print how a session went (along a profile its rms and largest error [K]); return the exit code."""
    figures = {"settle_time": session.settle_time, "overshoot": session.overshoot, "bias": session.bias}
    head = ["settled after [s]", "overshoot [K]", "bias [K]"]
    if errors is not None:
        figures = {"rms_error": errors[0], "largest_error": errors[1]}
        head = ["rms error [K]", "largest error [K]"]
    console.table(title, ["verdict", *head], [[session.verdict, *figures.values()]])
    if session.advice:
        console.say(session.advice)
    console.say(f"wrote {out}")
    console.answer({"verdict": session.verdict, "advice": session.advice, **figures, "out": out})
    return 0 if session.verdict in ("settled", "followed") else cli.ANSWER_IS_NO


@stop_signals()
@cli.grouped
def batch(
    controller: ControllerFile,
    plan: Annotated[
        Path,
        cli.arg(
            "PLAN.csv", "A row a grasp: material,t_object_degC,target_degC[,block,repeat,touch_group,...]."
        ),
    ],
    out: Annotated[Path, cli.opt("--out", "DIR", "Folder of the batch.")],
    rig: RigOptions,
    grasps: GraspOptions,
    show: ShowOptions,
    guard: GuardOption = None,
    ask: Annotated[bool, cli.flag("--ask/--no-ask", "With --port: ask before and after each grasp.")] = True,
    bridge: BridgeOption = None,
    seed: cli.Seed = 0,
    as_json: cli.AsJson = False,
) -> int:
    """Grasp one object after another by a plan, and record.

    The same command again goes on where it was stopped; trials that tripped or were called bad are done
    again. Drive and pump are off between grasps and on every way out. The good grasps are in DIR/grasps.csv,
    labelled for classify.
    """
    rig.check()
    from thermogrip.rig.records.batch import read_plan, run_batch

    trials, loaded = read_plan(plan), load_controller(controller, rig.network)
    pace, console = rig.pace(show), Console(as_json)
    clock, watch = rig.clock(pace), show.watch("batch", console, out, pace)
    checks = rig.guard(guard, loaded.plant)
    asks = ask and rig.port is not None and not as_json
    says = iter([console.say])  # at the first trial
    with _bridge(bridge) as through, watch:
        done = run_batch(
            lambda: rig.open(clock, loaded, pace=pace, seed=seed, say=next(says, None)),
            loaded,
            trials,
            cli.new_folder(out),
            ready=_ready(len(trials), watch) if asks else None,
            judge=_verdict(console, watch) if asks else None,
            cleared=_cleared(watch) if asks else None,
            through=through,
            guard=checks,
            first_touch=_first_touch,
            about=rig.about() | ({} if rig.twin is None else {"seed": seed}),
            output=loaded.controlled[0],
            clock=None if rig.port is None else clock,
            **watch.hooks,
            **grasps.of_session(watch, loaded, console.say),
        )
        watch.ended(done.verdict)
    console.say(f"{len(done.done)} of {len(trials)} grasps are good: {done.verdict}")
    if done.advice:
        console.say(done.advice)
    console.answer(
        {"verdict": done.verdict, "advice": done.advice, "good": len(done.done), "left": done.left}
    )
    return 0 if done.left == 0 else cli.ANSWER_IS_NO


@stop_signals()
@cli.grouped
def record(
    schedule: Annotated[str, cli.arg("SCHEDULE", "schedule.csv of excite.")],
    port: Annotated[str, cli.opt("--port", "DEV", "/dev/ttyACM0, COM3, socket://HOST:PORT.")],
    out: OutOption,
    show: ShowOptions,
    protocol: ProtocolOption = None,
    dt: Annotated[float, cli.opt("--sample", "S", "Seconds a row.", min=0.05)] = 1.0,
    guard: GuardOption = None,
    speed: Annotated[float, cli.opt("--speed", "X", "That of a virtual device.", min=0.01)] = 1.0,
    bridge: BridgeOption = None,
    seed: cli.Seed = 0,
    as_json: cli.AsJson = False,
) -> int:
    """Play a schedule on a rig and record the log.

    identify reads samples.csv of the folder. Everything is switched off on every way out, Ctrl-C included.
    """
    from thermogrip.datasets.log_files import read_log
    from thermogrip.rig.clock import ScaledClock
    from thermogrip.rig.drivers.connect import open_rig
    from thermogrip.rig.session.session import Playback, play

    plan, checks = read_log(schedule), guard_of(guard, None, speed=speed)
    console = Console(as_json)
    watch = show.watch("record", console, out)
    clock = ScaledClock(speed)
    rig = open_rig(port, protocol, clock=clock, sleep=clock.sleep)
    try:
        try:  # what it cannot play is refused before there is a folder
            Playback(plan, rig.units, dt)
        except UserError as error:
            raise UserError(error.problem, file=schedule, hint=error.hint) from error
        about = {"schedule": schedule, "port": port, "sample_s": dt, "seed": seed}
        with _recorded(out, about, bridge, watch) as (folder, recorder):
            log, ended = play(rig, plan, dt=dt, guard=checks, clock=clock, recorder=recorder, **watch.hooks)
            folder.played(ended)
            watch.ended("tripped" if ended else "played")
    finally:
        rig.close()
    if ended:
        console.say(ended)
    console.say(f"wrote {log.sizes['time']} rows to {out / 'samples.csv'}")
    console.answer({"rows": log.sizes["time"], "ended": ended, "out": out})
    return cli.ANSWER_IS_NO if ended else 0


def recover(
    folder: Annotated[Path, cli.arg("DIR", "Folder of a run, or of a batch of runs.")],
    out: Annotated[
        Path | None,
        cli.opt("--out", "FILE", "Also write the run's log: .nc, .parquet, .csv, or .mcap (with ros)."),
    ] = None,
    as_json: cli.AsJson = False,
) -> int:
    """Repair a run that was killed or lost its power.

    Cuts a torn last line, says what was lost, writes the sums. No measured number is changed, and what was
    cut is kept beside it. A folder that is whole is left as it is.
    """
    folders = _run_folders(folder)
    if len(folders) > 1 and out is not None:
        raise UserError("holds several runs", file=folder, hint="give the folder of one of them")
    if out is not None:
        cli.new_file(out, (".nc", ".parquet", ".csv", ".mcap"))
    from thermogrip.rig.records.run_folder import export_run, recover

    console = Console(as_json)
    results = []
    for run in folders:
        done = recover(run)
        for line in done.findings:
            console.say(f"{run.name}: {line}")
        rows = 0 if done.run.log is None else done.run.log.sizes["time"]
        verdict = done.run.about["verdict"]
        results.append(
            {"run": run, "changed": done.changed, "said": done.findings, "rows": rows, "verdict": verdict}
        )
    if out is not None:
        export_run(folders[0], out)
        console.say(f"wrote {out}")
    console.answer({"runs": results})
    if not all(result["rows"] for result in results):
        return cli.ANSWER_IS_NO
    return cli.Done("run" if folders == [folder] else "batch")


def virtual(
    protocol: Annotated[
        str, cli.opt("--protocol", "NAME", "thermogrip or tclab.", cli.one_of("--protocol", PROTOCOLS))
    ] = "thermogrip",
    plant: Annotated[
        Path | None, cli.opt("--plant", "PLANT", "plant.json of identify [default: a bundled network].")
    ] = None,
    pty: Annotated[bool, cli.flag("--pty", "On a pseudo-terminal, as a serial port.")] = False,
    socket: Annotated[
        int | None, cli.opt("--socket", "PORT", "On a TCP port of this computer.", min=0, max=65535)
    ] = None,
    speed: Annotated[float, cli.opt("--speed", "X", "Its time runs X times as fast.", min=0.01)] = 1.0,
    start: StartOption = None,
    ambient: Annotated[float, cli.opt("--ambient", "DEGC", "Temperature of the room.")] = 23.0,
    obj: ObjOption = None,
    material: MaterialOption = None,
    fault: Annotated[list[str] | None, cli.shared("--fault", faults=", ".join(FAULTS))] = None,
    seconds: Annotated[float | None, cli.opt("--seconds", "S", "End after this long.", min=0)] = None,
    seed: cli.Seed = 0,
    as_json: cli.AsJson = False,
) -> int:
    """Be a device: our firmware or a TCLab, with a simulated plant behind it.

    Prints the name of the port and serves until Ctrl-C.
    """
    if pty and socket is not None:
        raise UserError("--pty and --socket are both given", hint="give one")
    due = sorted(_fault(text) for text in fault or [])
    from thermogrip.rig.clock import ScaledClock
    from thermogrip.rig.simulation.virtual_device import VirtualDevice
    from thermogrip.sysid.plant.plant import Plant

    device = VirtualDevice(
        None if plant is None else Plant.load(plant),
        protocol=protocol,
        link="pty" if socket is None else "socket",
        socket_port=socket or 0,
        clock=ScaledClock(speed),
        seed=seed,
        ambient=ambient,
        t_start=start,
    )
    if material is not None and obj is not None:
        device.place(material, obj)
    console = Console(as_json)
    with stop_signals(), device:  # also a SIGTERM takes the port away
        console.say(device.port)
        console.answer({"port": device.port, "protocol": protocol})
        sys.stdout.flush()  # whoever started this waits for the name
        while seconds is None or device.time < seconds:
            check_stopped()
            while due and device.time >= due[0][0]:
                device.fault(due.pop(0)[1])
            time.sleep(0.05)
    return 0


def guard_of(
    path: Path | None, plant: Plant | None, *, speed: float = 1.0, limit: float | None = None
) -> Guard:
    """Return the guard of a rig; what no file says is as by default, and nothing may be beyond a ``limit``.
    Of a virtual device that runs ``speed`` times as fast this program may be as late as of others, in seconds
    of the computer."""
    from thermogrip.rig.guard.guard import Guard
    from thermogrip.rig.guard.settings import GuardSettings, read_guard

    settings = GuardSettings.of(plant) if path is None else read_guard(path)
    if speed > 1.0:
        settings = settings.model_copy(update={"expiry_s": speed * settings.expiry_s})
    if limit is not None:
        settings = settings.below(limit)
    return Guard(plant, settings)


def targets_of(target: str) -> float | dict[str, float]:
    """Return one target or targets by output ("38", "t1=40,t2=35")."""
    bare = target.rstrip("degC° ") or "one"
    hint = f"write {bare} [degC], or t1=40,t2=35 for several outputs"
    with as_user_error(ValueError, f"'--target' {target!r} is no temperature", hint=hint):
        values = cli.numbers("--target", target) if "=" in target else float(target)
    for value in values.values() if isinstance(values, dict) else (values,):
        if not isfinite(value):
            raise UserError(f"'--target' {target!r} is no temperature", hint=hint)
    return values


def _one_goal(target: str | None, profile: Path | None, grasps: bool) -> float | dict[str, float]:
    """Return the targets that were typed, none where a profile has them; one of the two must be given."""
    if (target is None) == (profile is None):
        problem = "no target is given" if target is None else "--target and --profile are both given"
        raise UserError(problem, hint="give --target DEGC, or --profile PROFILE.csv")
    if target is None and grasps:
        raise UserError("a profile ends without a grasp", hint="leave --object and --material away")
    return {} if target is None else targets_of(target)


def _for_outputs(target: float | dict[str, float], controlled: tuple[str, ...]) -> float | dict[str, float]:
    """Return the target of each regulated output; a single number is for all of them."""
    if isinstance(target, dict) and set(target) != set(controlled):
        hint = f"give one for each of {', '.join(controlled)}"
        raise UserError(f"--target names {', '.join(target)}", hint=hint)
    if isinstance(target, float) and len(controlled) > 1:
        return dict.fromkeys(controlled, target)
    return target


@contextmanager
def _recorded(
    out: Path, about: dict[str, Any], bridge: str | None, watch: Watch
) -> Iterator[tuple[RunFolder, Recorder]]:
    """Yield the run folder of a session that is watched, and what records into it."""
    from thermogrip.rig.records.run_folder import RunFolder

    with _bridge(bridge) as through, watch, RunFolder(out, about) as folder, through(folder) as recorder:
        yield folder, recorder


@contextmanager
def _bridge(url: str | None) -> Iterator[Callable[[Recorder], AbstractContextManager[Recorder]]]:
    """Yield what publishes whatever a recorder gets while a run lasts."""
    if url is None:
        yield nullcontext
        return
    from thermogrip.rig.records.rosbridge import Bridge

    with Bridge(url, clock=time.time) as bridge:
        yield bridge.before


def _ready(n: int, watch: Watch) -> Callable[[int, Trial], bool]:
    """Return what asks for the next object."""

    def ready(k: int, trial: Trial) -> bool:
        warmth = "unknown temperature" if trial.t_object is None else f"{trial.t_object} degC"
        block = f"{trial.material or 'unknown'}, {warmth}"
        question = f"trial {k + 1} of {n}: {block}, skin to {trial.target:g} degC"
        choices = (("", "It is ready"), ("q", "Stop the batch"))
        answer = watch.ask(question, "Enter when it is ready, q to stop", choices)
        return answer.lower() not in ("q", "quit", "n", "no")

    return ready


def _verdict(console: Console, watch: Watch) -> Callable[[int, Trial, Session], str]:
    """Return what asks whether a grasp was good."""

    def verdict(k: int, trial: Trial, session: Session) -> str:
        if session.contact != session.contact:
            console.warn("the skin felt nothing: no object, or one as warm as the skin")
        answer = watch.ask(
            "was it good", "Enter to keep it, or what was bad", (("", "Keep it"),), "what was bad"
        )
        return "" if answer.lower() in ("y", "yes", "ok") else answer

    return verdict


def _cleared(watch: Watch) -> Callable[[int, Trial, Trip], bool]:
    """Return what asks after a trip whether its cause is cleared."""

    def cleared(k: int, trial: Trial, trip: Trip) -> bool:
        choices = (("c", "It is cleared: do this trial again"), ("", "End the batch"))
        answer = watch.ask(trip.line(), "c when it is cleared, Enter to end the batch", choices)
        if done := answer.lower() in ("c", "cleared"):
            watch.cleared()
        return done

    return cleared


def _first_touch(grasps: Grasps) -> tuple[float, float]:
    """Return what a touch identifies of its object's temperature: median and standard deviation [degC]."""
    from thermogrip.sysid.effusivity import effusivity_posterior, load_default_gripper

    row = effusivity_posterior(load_default_gripper(), grasps)[0]
    return row.t_object, (row.t_object_p95 - row.t_object_p05) / 3.29


def _run_folders(folder: Path) -> list[Path]:
    """Return the runs in a folder by name: itself, or those of a batch; UserError where there is none."""
    tried = (folder, *sorted(folder.glob("*")))
    runs = [p for p in tried if (p / "run.json").is_file() or (p / "samples.csv").is_file()]
    if runs:
        return runs[:1] if runs[0] == folder else runs
    if (folder / "batch.json").is_file():
        raise UserError("is a batch without a run", file=folder, hint="give the same batch command again")
    raise UserError("is no run folder", file=folder, hint="give the folder of --out")


def _fault(text: str) -> tuple[float, str]:
    """Return when and what, of ``60:sensor_open``."""
    when, _, name = text.partition(":")
    try:
        due_s = float(when)
    except ValueError:
        due_s = float("nan")
    if not 0 <= due_s < float("inf"):
        raise UserError(f"--fault {text!r} has no time", hint="write 60:sensor_open")
    return due_s, cli.choice("--fault", name, tuple(FAULTS))
