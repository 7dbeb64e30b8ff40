"""One session: settle, stop the pump, grasp, record.

The loop is the same for the twin and for hardware, because it keeps no clock of its own: it asks the rig for
a reading, the controller for a move, and lets the rig pass one sample time.

    settle    regulate until :func:`~thermogrip.rig.settle.has_settled` says yes, or the time-out is over
    hold      keep regulating for ``hold`` seconds
    lead_in   one second of fast samples under the last move
    pump_off  pump and drive off, one second, so that no water moves when the object touches
    contact   the gripper closes (time 0 of the grasp) and ``grasp_time`` seconds are recorded

Whatever ends it (done, time-out, a trip, an exception, Ctrl-C), drive and pump are off afterwards.  A session
that does not settle is an answer (a verdict), not an error.

Readings that cannot be believed trip it (:mod:`~thermogrip.rig.loop`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from thermogrip.datasets.schema import Grasps, Log, make_grasps
from thermogrip.mpc.interface import Controller, Move, Target
from thermogrip.rig.interface import Rig
from thermogrip.rig.loop import PHASES, Event, Loop, Recorder, TripError
from thermogrip.rig.settle import has_settled, step_figures

__all__ = ["PHASES", "Event", "Recorder", "Session", "run_session"]

LEAD_S = 1.0  # of fast samples before, and after, the pump stops


@dataclass(frozen=True)
class Session:
    """What a session returns.

    Attributes
    ----------
    log : Log
        Every sample: drive by input, ``pump``, ambient, outputs, ``target_<output>``, ``phase`` (index into
        :data:`PHASES`).
    grasps : Grasps or None
        The one grasp, time 0 at the "closed" message.
    events : tuple of Event
        Phases, changes of the controller's status, lost readings, the verdict.
    verdict : str
        ``settled``, ``not settled`` or ``tripped``.
    advice : str
        What to do about it; empty when settled.
    settle_time, overshoot, bias : float
        As in :class:`~thermogrip.rig.settle.StepFigures`; of the worst output where there are several.
    """

    log: Log
    grasps: Grasps | None
    events: tuple[Event, ...]
    verdict: str
    advice: str
    settle_time: float
    overshoot: float
    bias: float


def run_session(
    rig: Rig,
    controller: Controller,
    target: Target,
    *,
    output: str = "t_surface",
    hold: float = 0.0,
    grasp: tuple[str, float] | None = None,
    grasp_time: float = 10.0,
    grasp_dt: float = 0.1,
    settle_timeout: float = 900.0,
    band: float = 0.25,
    safe: tuple[float, float] = (-5.0, 75.0),
    stop: Callable[[Grasps], bool] | None = None,
    recorder: Recorder | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> Session:
    """Bring the skin to a temperature, stop the pump, grasp, record.

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
    grasp : (material, t_object), optional
        What to grasp, and its nominal temperature [degC]; without it the session ends after the hold.
    grasp_time, grasp_dt : float, optional
        Recorded time after contact and sample time of the grasp [s].
    settle_timeout : float, optional
        Give up settling after this long [s].
    band : float, optional
        Half width of the band that counts as settled [K].
    safe : (float, float), optional
        Readings outside are not believed; three in a row trip the session [degC].
    stop : callable, optional
        Asked with the grasp so far after each sample of the contact; True ends it early.
    recorder : Recorder, optional
        Takes every sample and event as it happens, e.g. :class:`~thermogrip.rig.recorder.RunFolder`.
    progress : callable, optional
        Called with (fraction done, what is being done).

    Returns
    -------
    session : Session

    Raises
    ------
    UserError
        If the rig has no sensor of a target's name, or a target is outside ``safe``.
    """
    run = Loop(rig, controller, recorder, progress, safe)
    verdict, touched = "tripped", None
    try:
        run.start(target if isinstance(target, Mapping) else {output: float(target)})
        verdict = "settled" if _settle(run, settle_timeout, band) else "not settled"
        if verdict == "settled":
            for _ in run.regulate("hold", hold):
                pass
            if grasp is not None:
                touched = _touch(run, *grasp, output=output, seconds=grasp_time, dt=grasp_dt, stop=stop)
    except TripError as trip:
        run.note("tripped", str(trip))
    finally:
        run.power_off()
    run.note("verdict", verdict)
    return _result(run, verdict, touched, band)


def _settle(run: Loop, timeout: float, band: float) -> bool:
    """Regulate until every target's output has settled; False when the time is over."""
    for passed in run.regulate("settle", timeout):
        run.report(0.9 * passed / timeout, "settling")
        if all(_has_settled(run, name, band) for name in run.target):
            return True
    return False


def _has_settled(run: Loop, name: str, band: float) -> bool:
    """Say whether one output has settled."""
    error = run.column(f"{name}_degC", last=40.0) - run.target[name]
    return has_settled(run.column("time_s", last=40.0), error, band=band)


def _touch(
    run: Loop,
    material: str,
    t_object: float,
    *,
    output: str,
    seconds: float,
    dt: float,
    stop: Callable[[Grasps], bool] | None,
) -> Grasps:
    """Stop the pump, close the gripper and record; return the one grasp."""
    first, n_lead = len(run.rows), max(1, round(LEAD_S / dt))
    t_gripper = run.target.get(output, np.nan)

    def grasp_so_far() -> Grasps:
        rows = run.rows[first:]
        return make_grasps(
            np.round([row["time_s"] - closed for row in rows], 6),
            [[row[f"{output}_degC"] for row in rows]],
            ["g0000"],
            name=f"{material} at {t_object:g} degC",
            material=[material],
            t_object=[t_object],
            t_gripper=[t_gripper],
            t_ambient=[rows[0].get("t_ambient_degC", np.nan)],
        )

    run.report(0.9, "grasping")
    run.sample("lead_in", n_lead, dt)
    run.move = Move(drive=run.no_drive(), pump=0)
    run.sample("pump_off", n_lead, dt)
    closed = run.reading.time_s
    run.rig.grasp(material, t_object)
    run.note("closed", f"gripper closed on {material} at {t_object:g} degC")
    for k in range(round(seconds / dt) + 1):
        run.sample("contact", 1, dt)
        run.report(0.9 + 0.1 * k * dt / seconds, "grasping")
        if stop is not None and k >= 2 and stop(grasp_so_far()):
            run.note("decided", f"stopped {k * dt:.1f} s after contact")
            break
    run.rig.release()
    return grasp_so_far()


def _result(run: Loop, verdict: str, grasps: Grasps | None, band: float) -> Session:
    """Return the session as a record."""
    regulated = run.column("phase") <= PHASES.index("hold")
    time = run.column("time_s")[regulated]
    figures = [
        step_figures(time, run.column(f"{name}_degC")[regulated], value, band=band)
        for name, value in run.target.items()
    ]
    advice = {
        "settled": "",
        "not settled": "give it more time, a wider band, or a target that the plant can reach",
        "tripped": next((event.text for event in run.events if event.kind == "tripped"), ""),
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
    )
