"""One session: settle, stop the pump, grasp, record; or play a schedule.

    settle    regulate until the target has settled (:func:`has_settled`) and the guard has compared the
              skin with the model for long enough, or the time-out is over
    hold      keep regulating for ``hold`` seconds
    lead_in   one second of fast samples under the last move
    pump_off  pump and drive off, one second, so that no water moves when the object touches
    contact   the gripper closes (time 0 of the grasp) and ``grasp_time`` seconds are recorded, fewer where
              ``stop`` ends it; then it opens

Whatever ends it (done, time-out, a trip, an exception, Ctrl-C, ``kill``), drive and pump are off afterwards.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError, known_names
from thermogrip.datasets.schema import GRASP_LABELS, GRASP_NUMBERS, Grasps, Log, make_grasps
from thermogrip.datasets.units import join_header
from thermogrip.mpc.interface import Controller, Move, Readings, Target
from thermogrip.rig.guard.guard import Guard
from thermogrip.rig.guard.trip import Trip
from thermogrip.rig.interface import UNIT_RANGES, Event, Rig
from thermogrip.rig.session.loop import PHASES, Loop, Recorder
from thermogrip.rig.session.profile import Profile
from thermogrip.rig.session.snapshot import Listener, Operator
from thermogrip.sysid.effusivity.quality import find_contact

FEWEST_ROWS = 5  # through which a line and the scatter about it are fitted
ROUNDED = 1e-9  # of a mean over a row


@dataclass(frozen=True)
class StepFigures:
    """Settling time, overshoot and bias of a regulated step."""

    # time from the start after which the smoothed error stays inside the band [s]; NaN if it does not
    settle_time: float
    # of the smoothed temperature beyond the target, in the direction of approach [K]
    overshoot: float
    # mean error of the last 120 s, or since it settled where that is shorter [K]; NaN if it did not
    bias: float


def has_settled(
    time: ArrayLike, error: ArrayLike, *, band: float, window: float = 30.0, quantum: float = 1 / 16
) -> bool:
    """Say whether level and drift of the last ``window`` seconds are surely inside the band."""
    t, e = np.asarray(time, dtype=float), np.asarray(error, dtype=float)
    if t.size == 0 or t[-1] - t[0] < window:
        return False
    recent = (t >= t[-1] - window) & np.isfinite(e)
    t, e = t[recent], e[recent]
    if t.size < FEWEST_ROWS:
        return False
    slope, level = np.polyfit(t - t.mean(), e, 1)
    se_level = _standard_error(e - level - slope * (t - t.mean()), quantum)
    se_slope = np.sqrt(12.0) * se_level / window
    # even at two standard errors; with noise that could hide a drift as large as the band it is never met
    level_ok = abs(level) + 2 * se_level <= band
    return bool(level_ok and window * (abs(slope) + 2 * se_slope) <= band)


def step_figures(
    time: ArrayLike, reading: ArrayLike, target: float, *, band: float = 0.25, smooth: float = 5.0
) -> StepFigures:
    """Return settling time, overshoot and bias of a temperature that was brought to a constant target."""
    t, y = np.asarray(time, dtype=float), np.asarray(reading, dtype=float)
    t, y = t[np.isfinite(y)], y[np.isfinite(y)]
    if t.size == 0:
        return StepFigures(np.nan, 0.0, np.nan)
    # the mean over the ``smooth`` seconds round each time, fewer at the ends
    total = np.concatenate([[0.0], np.cumsum(y)])
    lo, hi = np.searchsorted(t, t - smooth / 2, "left"), np.searchsorted(t, t + smooth / 2, "right")
    error = (total[hi] - total[lo]) / (hi - lo) - target
    outside = np.flatnonzero(np.abs(error) > band)
    approach = np.sign(target - y[0])
    beyond = approach * error if abs(y[0] - target) > band else np.abs(error)
    overshoot = max(0.0, float(beyond.max()))
    if outside.size and outside[-1] == t.size - 1:
        return StepFigures(np.nan, overshoot, np.nan)
    settled_at = t[outside[-1] + 1] if outside.size else t[0]
    last = t >= max(settled_at, t[-1] - 120.0)
    return StepFigures(float(settled_at - t[0]), overshoot, float(np.mean(y[last] - target)))


def _standard_error(residual: Array, quantum: float) -> float:
    """Return the standard error of the mean of correlated residuals about a line."""
    # n samples whose lag-one correlation is r are worth n (1 - r) / (1 + r) independent ones; the residual sd
    # is at least the rounding error
    n = residual.size
    sd = max(float(np.sqrt(residual @ residual / (n - 2))), quantum / np.sqrt(12.0))
    power = float(residual @ residual)
    lag_one = float(residual[1:] @ residual[:-1]) / power if power > 0 else 0.0
    # 1/n and 3/n undo the bias of a lag-one correlation about a fitted line
    r = min(max(lag_one + (1 + 3 * max(lag_one, 0.0)) / n, 0.0), 0.95)
    return float(sd / np.sqrt(max(n * (1 - r) / (1 + r), 2.0)))


LEAD_S = 1.0  # of fast samples before, and after, the pump stops


@dataclass(frozen=True)
class Object:
    """What is grasped, and how the grasp is labelled."""

    material: str  # empty where it is not known
    # temperature [degC], or the sensor that measures it; NaN where it is not known
    t_object: float | str = np.nan
    t_object_sd: float = np.nan  # its uncertainty, standard deviation [K]; NaN where not known
    # ``block``, ``session``, ``experiment``, ``split``, ``touch_group``, ``repeat``, ``touch``, ``rest``
    labels: Mapping[str, Any] = field(default_factory=dict)
    grasp_id: str = "g0000"


@dataclass(frozen=True)
class Session:
    """What a session returns."""

    # every sample: drives, ``pump``, ambient, outputs, ``target_<output>``, ``phase`` (index into
    # :data:`PHASES`)
    log: Log
    grasps: Grasps | None  # the one grasp, time 0 at the "closed" message
    events: tuple[Event, ...]  # phases, changes of the controller's status, lost readings, the verdict
    verdict: str  # ``settled``, ``followed`` (a profile), ``not settled`` or ``tripped``
    advice: str  # what to do about it; empty when settled
    # [s], as in :class:`StepFigures`; of the worst output where there are several, NaN along a profile
    settle_time: float
    overshoot: float  # [K], likewise
    bias: float  # [K], likewise; along a profile the mean error
    # when the skin made contact [s after the "closed" message]; NaN where there was no contact
    contact: float = np.nan
    trip: Trip | None = None  # what ended it, where the guard did


def run_session(
    rig: Rig,
    controller: Controller,
    target: Target,
    *,
    output: str = "t_surface",
    hold: float = 0.0,
    grasp: Object | tuple[str, float] | None = None,
    grasp_time: float = 10.0,
    grasp_dt: float = 0.1,
    settle_timeout: float = 900.0,
    band: float = 0.25,
    profile: Profile | None = None,
    guard: Guard | None = None,
    clock: Callable[[], float] | None = None,
    stop: Callable[[Grasps], bool] | None = None,
    recorder: Recorder | None = None,
    progress: Callable[[float, str], None] | None = None,
    listener: Listener | None = None,
    operator: Operator | None = None,
) -> Session:
    """Bring the skin to a temperature, stop the pump, grasp, record; return what came of it.

    Parameters
    ----------
    rig : Rig
        Twin or hardware; it is powered down but not closed at the end.
    controller : Controller
        Asked once every ``controller.dt`` seconds; reset at the first reading.
    target : float or mapping of str to float
        Temperature of ``output``, or temperatures by output [degC].
    output : str, optional
        What a single target is for.
    hold : float, optional
        Regulate for this long after it has settled [s].
    grasp : Object or (material, t_object), optional
        What to grasp, and its nominal temperature [degC]; without it the session ends after the hold.
    grasp_time, grasp_dt : float, optional
        Recorded time after contact and sample time of the grasp [s].
    settle_timeout : float, optional
        Give up settling after this long [s].
    band : float, optional
        Half width of the band that counts as settled [K].
    profile : Profile, optional
        Targets over time to follow to their end, in place of settling at one.
    guard : Guard, optional
        By default one without a model.
    clock : callable, optional
        The host's time [s], with real hardware; the rig's own where absent.
    stop : callable, optional
        Asked with the grasp so far after each sample of the contact; True ends it early.
    recorder : Recorder, optional
        Takes every sample and event as it happens: :class:`~thermogrip.rig.records.run_folder.RunFolder`.
    progress : callable, optional
        Called with (fraction done, what is being done).
    listener : callable, optional
        Called with a :class:`~thermogrip.rig.session.snapshot.Snapshot` at each look, and with a last one
        that has the verdict; the loop waits for it.
    operator : Operator, optional
        Whose requests, made in other threads, are seen at each look.

    Raises
    ------
    UserError
        If the rig has no sensor of a target's name, or a target or first reading makes no sense.

    Examples
    --------
    >>> from thermogrip.mpc import PIController
    >>> from thermogrip.rig.simulation.twin import Twin
    >>> from thermogrip.rig.simulation.virtual_device import example_plant
    >>> plant = example_plant()
    >>> session = run_session(Twin(plant, seed=1), PIController(plant), 30.0)
    >>> session.verdict, abs(session.bias) < 0.25
    ('settled', True)
    """
    watch, requests = Guard(skin=output) if guard is None else guard, operator or Operator()
    run = Loop(rig, controller, recorder, progress, watch, clock, listener, requests, band)
    thing = Object(*grasp) if isinstance(grasp, tuple) else grasp
    if thing is not None and isinstance(thing.t_object, str) and thing.t_object not in run.reading.values:
        hint = known_names(thing.t_object, run.reading.values, "use one of {}, or a number")
        raise UserError(f"the rig has no sensor {thing.t_object!r}", hint=hint)
    # not to settle is an answer and not an error, and so is an end by the guard
    verdict, touched = "not settled", None
    with run.powered():
        run.start(target if isinstance(target, Mapping) else {output: float(target)})
        if profile is not None:
            for name, values in profile.targets.items():
                run.check_targets(name, values)
            for passed in run.regulate("hold", profile.seconds, profile):
                run.report(passed / profile.seconds, "following the profile")
            verdict = "followed"
        elif _settle(run, settle_timeout, band):
            verdict = "settled"
            for _ in run.regulate("hold", hold):
                pass
            if thing is not None:
                touched = _grasp_object(run, thing, output=output, seconds=grasp_time, dt=grasp_dt, stop=stop)
    verdict = verdict if run.trip is None else "tripped"
    run.note("verdict", verdict)
    run.show(run.no_drive(), verdict=verdict, trip=run.trip)
    return _session_of(run, verdict, touched, band)


def _settle(run: Loop, timeout: float, band: float) -> bool:
    """Regulate until every target's output has settled; False when the time is over."""
    for passed in run.regulate("settle", timeout):
        run.report(0.9 * passed / timeout, "settling")
        if not run.guard.ready(run.reading.time_s):
            continue
        # 30 s, or as long as the readings that the line takes: a slow plant is read every few minutes
        window = max(30.0, FEWEST_ROWS * run.controller.dt)
        recent_s = 1.4 * window
        time = run.column("time_s", last=recent_s)
        errors = [run.column(f"{name}_degC", last=recent_s) - value for name, value in run.target.items()]
        if all(has_settled(time, error, band=band, window=window) for error in errors):
            return True
        if _settled_but_for_ripple(run, band):
            return True
    return False


def _settled_but_for_ripple(run: Loop, band: float) -> bool:
    """Say whether the means over whole cycles of a relay have settled, once one has ended."""
    # a relay gives more and less than is asked for in turn, by as much: over a cycle the ripple has no mean
    time = run.column("time_s")
    for name in run.reading.mean_drive or ():
        header = join_header(name, run.rig.units[name])
        given, asked = (np.abs(run.column(column)) for column in (header, f"asked_{header}"))
        is_on = (given > 0) & (given >= asked * (1 - ROUNDED))
        begins = np.flatnonzero(is_on[1:-1] & ~is_on[:-2]) + 1  # the newest row is not over
        if begins.size <= FEWEST_ROWS or begins[-1] < time.size - 2:
            continue
        cycles = [slice(*ends) for ends in pairwise(begins)]
        middles = np.array([time[cycle].mean() for cycle in cycles])
        errors = [run.column(f"{output}_degC") - value for output, value in run.target.items()]
        means = [np.array([np.nanmean(error[cycle]) for cycle in cycles]) for error in errors]
        window = max(30.0, float(middles[-1] - middles[-FEWEST_ROWS]))
        if all(has_settled(middles, mean, band=band, window=window) for mean in means):
            run.cycle_s = float(np.mean(np.diff(middles[-FEWEST_ROWS:])))
            return True
    return False


def _grasp_object(
    run: Loop, thing: Object, *, output: str, seconds: float, dt: float, stop: Callable[[Grasps], bool] | None
) -> Grasps:
    """Stop the pump, close the gripper, record and open it; return the one grasp."""
    first, n_lead = len(run.rows), max(1, round(LEAD_S / dt))
    run.report(0.9, "grasping")
    run.ends = run.reading.time_s + n_lead * dt
    run.sample("lead_in", n_lead, dt)
    run.move = Move(drive=run.no_drive(), pump=0)
    run.ends = run.reading.time_s + n_lead * dt
    run.sample("pump_off", n_lead, dt)
    closed, t_object_source = run.reading.time_s, thing.t_object
    run.ends = closed + seconds
    t_object = float(run.accepted[t_object_source] if isinstance(t_object_source, str) else t_object_source)
    t_gripper = run.target.get(output, np.nan)
    about = {"grasp_id": thing.grasp_id, "material": thing.material, "t_object": t_object}
    about |= {"t_object_sd": thing.t_object_sd, "t_gripper": t_gripper, **thing.labels}
    as_json = {key: None if value != value else value for key, value in about.items()}

    def grasp_so_far() -> Grasps:
        return grasp_of_rows(run.rows[first:], closed, output, about, run.rooms)

    try:
        run.touching = True
        run.ask(lambda: run.rig.grasp(thing.material, t_object))
        run.note("closed", f"gripper closed on {thing.material} at {t_object:g} degC", as_json)
        for k in range(round(seconds / dt) + 1):
            if run.reading.time_s - closed > seconds + 0.5 * dt:
                break  # this program was late, its time is over all the same
            run.sample("contact", 1, dt)
            run.report(0.9 + 0.1 * k * dt / seconds, "grasping")
            if stop is not None and k >= 2 and stop(grasp_so_far()):
                run.note("decided", f"stopped {k * dt:.1f} s after contact")
                break
    finally:
        run.open_gripper()
    return grasp_so_far()


def grasp_of_rows(
    rows: Sequence[Mapping[str, float]],
    closed: float,
    output: str,
    about: Mapping[str, Any],
    rooms: Collection[str],
) -> Grasps:
    """Return the one grasp of a session's rows: of the skin ``output``, with the labels of ``about``."""
    room = next((value for name, value in rows[0].items() if name.removesuffix("_degC") in rooms), np.nan)
    labels = {key: [about.get(key) or ""] for key in GRASP_LABELS if about.get(key)}
    stated_numbers = {key: about[key] for key in GRASP_NUMBERS if key in about}
    numbers = {key: [np.nan if value is None else float(value)] for key, value in stated_numbers.items()}
    second = f"{output}_2_degC"
    twin = [[row[second] for row in rows]] if second in rows[0] else None
    material, t_object = labels.get("material", [""])[0], numbers.get("t_object", [np.nan])[0]
    return make_grasps(
        np.round([row["time_s"] - closed for row in rows], 6),
        [[row[f"{output}_degC"] for row in rows]],
        [str(about["grasp_id"])],
        name=f"{material} at {t_object:g} degC",
        t_surface_2=twin,
        **{"t_ambient": [room], **numbers, **labels},
    )


def _session_of(run: Loop, verdict: str, grasps: Grasps | None, band: float) -> Session:
    trip = run.trip
    if len(run.rows) < 2:
        raise UserError("the session ended at its first reading", hint="" if trip is None else trip.line())
    contact: float | None = np.nan
    if grasps is not None:
        contact = find_contact(grasps["time"].values, grasps["t_surface"].values[0])
    if contact is None:
        run.note("no contact", "no contact was found: no object, or one as warm as the skin")
    figures = [_figures(run, name, band) for name in run.target]
    advice = {
        "settled": "",
        "followed": "",
        "not settled": "give it more time, a wider band, or a target that the plant can reach",
        "tripped": "" if trip is None else trip.line(),
    }
    biases = [figure.bias for figure in figures]
    return Session(
        log=run.log(),
        grasps=grasps,
        events=tuple(run.events),
        verdict=verdict,
        advice=advice[verdict],
        settle_time=float(np.max([figure.settle_time for figure in figures])),
        overshoot=float(np.max([figure.overshoot for figure in figures])),
        bias=float(biases[int(np.argmax(np.abs(biases)))]),
        contact=np.nan if contact is None else contact,
        trip=trip,
    )


def _figures(run: Loop, name: str, band: float) -> StepFigures:
    """Return the figures of one output, which along a profile is no step."""
    regulated = run.column("phase") <= PHASES.index("hold")
    values, targets = run.column(f"{name}_degC")[regulated], run.column(f"target_{name}_degC")[regulated]
    if np.ptp(targets) > 0:
        return StepFigures(np.nan, np.nan, float(np.nanmean(values - targets)))
    time, target = run.column("time_s")[regulated], float(targets[0])
    figures = step_figures(time, values, target, band=band)
    if not run.cycle_s:
        return figures
    by_cycle = step_figures(time, values, target, band=band, smooth=run.cycle_s)  # without the ripple
    return replace(by_cycle, overshoot=figures.overshoot)


class Player(Controller, Protocol):
    """A controller without a target, which ends."""

    seconds: float  # how long it plays at most
    done: bool  # whether nothing is left to play


class Playback:
    """A schedule as a controller: it returns the row in force, whatever the reading."""

    done = False  # it ends with its time

    def __init__(self, schedule: Log, units: Mapping[str, str], dt: float) -> None:
        self.dt, self._begin = dt, 0.0  # sample time [s]
        self._time = np.asarray(schedule["time"].values, dtype=float)
        self._time = self._time - self._time[0]
        # the last row holds as long as the one before it
        self.seconds = float(self._time[-1] + (np.diff(self._time)[-1] if self._time.size > 1 else dt))
        for name, unit in units.items():
            if name not in schedule or str(schedule[name].attrs.get("units", "1")) != unit:
                hint = f"the rig needs a column of {name} in {unit}; excite --plant writes it"
                raise UserError(f"the schedule has no {name} in {unit}", hint=hint)
        self._drives = {name: np.asarray(schedule[name].values, dtype=float) for name in units}
        self._pump = np.asarray(schedule["pump"].values) if "pump" in schedule else np.ones(self._time.size)
        for line in str(schedule.attrs.get("repairs", "")).splitlines():  # logs may be repaired, orders not
            if line.partition(":")[0] in (*units, "pump") or "of an input dropped" in line:
                raise UserError(f"the schedule is not whole ({line})", hint="write a number into every row")
        for name, unit in units.items():
            self._check(name, self._drives[name], UNIT_RANGES.get(unit, (-np.inf, np.inf)))
        self._check("pump", np.where(np.isin(self._pump, (0, 1)), 0.0, self._pump), (0, 0), "0 or 1")

    def _check(self, name: str, values: Array, span: tuple[float, float], allowed: str = "") -> None:
        wrong = np.flatnonzero(~((values >= span[0]) & (values <= span[1])))  # also NaN
        if wrong.size:
            row, hint = int(wrong[0]), allowed or f"{span[0]:g} to {span[1]:g}"
            problem = f"the schedule's {name} is {values[row]:g} at {self._time[row]:g} s"
            raise UserError(problem, hint=f"write {hint}")

    def reset(self, reading: Readings) -> None:
        """Begin at this reading's time."""
        self._begin = reading["time_s"]

    def step(self, reading: Readings, target: Target) -> Move:
        """Return the row in force."""
        row = int(np.searchsorted(self._time, reading["time_s"] - self._begin + 1e-9, "right")) - 1
        drive = {name: float(values[row]) for name, values in self._drives.items()}
        pump = int(self._pump[row])
        return Move(drive=drive if pump else dict.fromkeys(drive, 0.0), pump=pump)


def play(
    rig: Rig,
    schedule: Log | Player,
    *,
    dt: float = 1.0,
    guard: Guard | None = None,
    clock: Callable[[], float] | None = None,
    recorder: Recorder | None = None,
    progress: Callable[[float, str], None] | None = None,
    listener: Listener | None = None,
    operator: Operator | None = None,
) -> tuple[Log, str]:
    """Play a schedule, sampled every ``dt`` [s]; return the log, and the line of the trip that ended it.

    A :class:`Player` has a sample time of its own; the other arguments are those of :func:`run_session`.
    """
    player = Playback(schedule, rig.units, dt) if isinstance(schedule, Log) else schedule
    watch = Guard() if guard is None else guard
    run = Loop(rig, player, recorder, progress, watch, clock, listener, operator or Operator())
    with run.powered():
        run.start({})
        for passed in run.regulate("hold", player.seconds):
            run.report(passed / player.seconds, "playing the schedule")
            if player.done:
                break
    ended = "" if run.trip is None else run.trip.line()
    run.show(run.no_drive(), verdict="tripped" if ended else "played", trip=run.trip)
    if len(run.rows) < 2:
        raise UserError("the rig ended at its first reading", hint=ended)
    return run.log(), ended
