"""A batch of grasps: a plan, one run folder a trial, resumed where it was stopped.

The columns of a plan and the folder of a batch are described in ``docs/reference/files.md``.  A trial that
was not good (tripped, did not settle, marked bad, cut off) is kept as it is and done again in ``0002-2``.

A batch that was stopped, by whatever, goes on where it was: every trial that has a good grasp on disk is
skipped.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, closing, nullcontext, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from thermogrip.datasets.errors import UserError, known_names, reading
from thermogrip.datasets.files import make_folder, read_json, write_json
from thermogrip.datasets.grasp_files import read_grasps, write_grasps
from thermogrip.datasets.schema import GRASP_LABELS, GRASP_NUMBERS, Grasps, make_grasps
from thermogrip.datasets.tables import read_csv_table
from thermogrip.mpc.interface import Controller
from thermogrip.rig.guard.guard import Guard
from thermogrip.rig.guard.trip import Trip
from thermogrip.rig.interface import DeviceRefusedError, Rig
from thermogrip.rig.records.run_folder import RunFolder, mark_bad, read_run
from thermogrip.rig.session.loop import Recorder
from thermogrip.rig.session.session import Object, Session, run_session
from thermogrip.rig.session.snapshot import Operator
from thermogrip.sysid.contact.materials import find_material

SCHEMA, VERSION = "thermogrip.batch", 1
#: Trips after which a trial may simply be done again: what they say is over once the rig answers.
AGAIN = ("cable", "device", "stale", "frozen")
TRIES = 3  # of a trial

_LABELS = {name: name for name in (*GRASP_LABELS, "repeat", "touch") if name != "material"} | {
    "rest_s": "rest"
}
_KNOWN = {"material", "t_object_degC", "t_object_sd_degC", "target_degC", *_LABELS}


@dataclass(frozen=True)
class Trial:
    """One row of a plan."""

    material: str  # empty where it is not known
    target: float  # of the skin [degC]
    t_object: float | str | None = None  # [degC]; the name of a sensor; None where it is not known
    t_object_sd: float | None = None  # [K]
    # ``block``, ``repeat``, ``session``, ``experiment``, ``split``, ``touch_group``, ``touch``, ``rest``
    labels: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Batch:
    """How a batch went."""

    done: tuple[Path, ...]  # folders of the good run of each trial that has one, in the order of the plan
    left: int  # trials without a good run
    verdict: str  # ``done``, ``stopped`` (by the operator), ``tripped`` or ``not settled``
    advice: str  # what to do before it goes on; empty when done
    sessions: int  # those run this time


def read_plan(path: str | Path) -> list[Trial]:
    """Return the trials of a plan.

    Parameters
    ----------
    path : str or Path
        A CSV table, see the module.

    Raises
    ------
    UserError
        If a column or a cell breaks a rule; the line names row and column.

    Examples
    --------
    >>> from tempfile import mkdtemp
    >>> path = Path(mkdtemp()) / "plan.csv"
    >>> n = path.write_text("material,t_object_degC,target_degC,block\\ncopper,18,38,c1\\n")
    >>> read_plan(path)
    [Trial(material='copper', target=38.0, t_object=18.0, t_object_sd=None, labels={'block': 'c1'})]
    """
    table = read_csv_table(path, text=lambda header: True)
    unknown = sorted(set(table.text) - _KNOWN)
    if unknown or "target_degC" not in table.text or "material" not in table.text:
        problem = f"has the unknown column {unknown[0]!r}" if unknown else "lacks material or target_degC"
        raise UserError(problem, file=path, row=1, hint=known_names("".join(unknown[:1]), sorted(_KNOWN)))
    trials = []
    for row, line in enumerate(table.lines.tolist()):
        cells = {name: values[row] for name, values in table.text.items() if values[row]}
        trials.append(_trial(cells, path, int(line)))
    return trials


def _trial(cells: Mapping[str, str], path: str | Path, line: int) -> Trial:
    def number(column: str) -> float | None:
        if column not in cells:
            return None
        value = _float(cells[column])
        if value is None or not np.isfinite(value):
            problem = f"{cells[column]!r} is not a number"
            raise UserError(problem, file=path, row=line, column=column, hint="write one")
        return value

    target = number("target_degC")
    if target is None:
        raise UserError("is empty", file=path, row=line, column="target_degC", hint="write a temperature")
    material = cells.get("material", "")
    if material:
        try:
            material = find_material(material).name
        except UserError as error:
            raise UserError(error.problem, file=path, row=line, column="material", hint=error.hint) from error
    given = cells.get("t_object_degC", "")
    sensor = given != "" and _float(given) is None
    labels: dict[str, Any] = {}
    for column, name in _LABELS.items():
        if column in cells:
            labels[name] = number(column) if name in GRASP_NUMBERS else cells[column]
    t_object = given if sensor else number("t_object_degC")
    return Trial(material, target, t_object, number("t_object_sd_degC"), labels)


def _float(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def run_batch(
    rig: Rig | Callable[[], Rig],
    controller: Controller,
    plan: Sequence[Trial],
    folder: str | Path,
    *,
    ready: Callable[[int, Trial], bool] | None = None,
    judge: Callable[[int, Trial, Session], str] | None = None,
    cleared: Callable[[int, Trial, Trip], bool] | None = None,
    through: Callable[[Recorder], AbstractContextManager[Recorder]] = nullcontext,
    stop: Callable[[Grasps], bool] | None = None,
    guard: Guard | None = None,
    about: Mapping[str, Any] | None = None,
    first_touch: Callable[[Grasps], tuple[float, float]] | None = None,
    progress: Callable[[float, str], None] | None = None,
    operator: Operator | None = None,
    **options: Any,
) -> Batch:
    """Do every trial of the plan that has no good grasp in the folder yet; return how that went.

    Parameters
    ----------
    rig : Rig, or a function that opens it
        A function is called again after a trip whose kind is in ``AGAIN``; the rig that it replaces is closed
        first, and the last one at the end.
    controller : Controller
    plan : sequence of Trial
    folder : str or Path
        Of the batch; made if absent.
    ready : callable, optional
        Asked before each trial (number from 0, trial), while the rig is off: the operator lays the object
        ready. False stops the batch.
    judge : callable, optional
        Asked after each good grasp that is not marked bad already: why the operator calls it bad, "" to keep
        it.
    cleared : callable, optional
        Asked after a trip of another kind than those of ``AGAIN``, but for a stop that was asked for: whether
        its cause is cleared.  Then the device's latch is cleared and the trial done again.
    through : callable, optional
        Handed each run folder, and returns for that run what records in its place, e.g.
        :meth:`~thermogrip.rig.records.rosbridge.Bridge.before`.
    stop : callable, optional
        As of :func:`~thermogrip.rig.session.session.run_session`: ends a contact early.
    guard : Guard, optional
        One for the whole batch: what it has learnt lasts from session to session.
    about : mapping, optional
        As of :class:`~thermogrip.rig.records.run_folder.RunFolder`.
    first_touch : callable, optional
        The temperature of a block from an earlier touch of it, (degC, standard deviation): asked for a
        trial without a temperature whose ``touch_group`` has a good grasp already.
    progress : callable, optional
        Called with (fraction of the plan, what is being done).
    operator : Operator, optional
        Whose stop ends the batch; handed to each session.
    **options
        Handed to :func:`~thermogrip.rig.session.session.run_session`.

    Raises
    ------
    UserError
        If the folder holds another plan, or a session's first reading makes no sense.

    Examples
    --------
    >>> from tempfile import mkdtemp
    >>> from thermogrip.mpc import PIController
    >>> from thermogrip.rig.simulation.twin import Twin
    >>> from thermogrip.rig.simulation.virtual_device import example_plant
    >>> plant = example_plant()
    >>> plan = [Trial("copper", 30.0, 18.0)]
    >>> batch = run_batch(Twin(plant, seed=1), PIController(plant), plan, mkdtemp(), grasp_time=2.0)
    >>> batch.verdict, batch.left
    ('done', 0)
    """
    path = Path(folder)
    _keep_plan(path, plan)
    sessions = 0
    verdict = "done"
    advice = ""
    with closing(_Source(rig)) as source:
        for k, trial in enumerate(plan):
            if good_run(path, k) is not None:
                continue
            if progress is not None:
                progress(k / len(plan), f"trial {k + 1} of {len(plan)}: {trial.material or 'unknown'}")
            for attempt in range(TRIES):
                stopped = operator is not None and operator.stop_asked
                if stopped or (ready is not None and not ready(k, trial)):
                    return _batch(path, plan, "stopped", "run the same command again to go on", sessions)
                run = next_folder(path, k)
                warmed = _with_temperature(trial, k, plan, path, first_touch)
                described = {**(about or {}), "trial": k + 1, **asdict(warmed)}
                with RunFolder(run, described) as run_folder, through(run_folder) as recorder:
                    session_args: dict[str, Any] = {"stop": stop, "guard": guard, "recorder": recorder}
                    session_args |= {"operator": operator, **options}
                    thing = _object(warmed, k)
                    session = run_session(source.rig, controller, warmed.target, grasp=thing, **session_args)
                    run_folder.finish(session)
                sessions += 1
                verdict, advice = _trial_verdict(session, k, trial, run, judge)
                if verdict == "done":
                    break
                trip = session.trip
                may = trip is None or trip.kind in AGAIN
                if trip is not None and may:
                    source.open_again()
                elif trip is not None and trip.kind != "operator" and cleared is not None:
                    may = cleared(k, trial, trip)
                    if may:
                        source.open_again()
                        source.clear()
                if not may or (trip is None and attempt + 1 >= TRIES):
                    return _batch(path, plan, verdict, advice, sessions)
            else:
                return _batch(path, plan, verdict, advice, sessions)
    return _batch(path, plan, "done", "", sessions)


class _Source:
    """The rig of a batch; one that a function opened is closed, and may be opened again."""

    def __init__(self, rig: Rig | Callable[[], Rig]) -> None:
        self._open = None if isinstance(rig, Rig) else rig
        self.rig: Rig = rig if isinstance(rig, Rig) else rig()

    def open_again(self) -> None:
        if self._open is not None:
            self.rig.close()
            self.rig = self._open()

    def clear(self) -> None:
        """Clear the device's latch; one whose cause is still there trips again."""
        clear = getattr(self.rig, "clear", None)  # of a device that latches
        if clear is not None:
            with suppress(DeviceRefusedError):
                clear()

    def close(self) -> None:
        if self._open is not None:
            self.rig.close()


def collect(folder: str | Path, *, name: str = "") -> Grasps:
    """Return the grasps of all good trials of a batch as one record; UserError where there is none."""
    path = Path(folder)
    content = read_json(path / "batch.json", SCHEMA, VERSION)
    with reading("is no plan of a batch", file=path / "batch.json", hint="give the folder of a batch"):
        n_trial = len(content["plan"])
    import pandas as pd

    runs = [run for k in range(n_trial) if (run := good_run(path, k)) is not None]
    if not runs:
        raise UserError("has no good grasp yet", file=path, hint="run the batch first")
    grasps = [read_grasps(run / "grasps.csv") for run in runs]
    step = float(np.median(np.diff(grasps[0]["time"].values)))
    traces = pd.DataFrame(
        {
            run.name: pd.Series(one["t_surface"].values[0], np.round(one["time"].values / step))
            for run, one in zip(runs, grasps)
        }
    ).sort_index()
    facts = pd.concat([one.drop_dims("time").to_dataframe() for one in grasps])
    facts = facts.fillna({label: "" for label in GRASP_LABELS if label in facts})
    time = np.round(traces.index.to_numpy() * step, 9)
    about = {str(key): values.tolist() for key, values in facts.items()}
    return make_grasps(time, traces.T.to_numpy(), [*traces], name=name or path.name, **about)


def good_run(folder: Path, k: int) -> Path | None:
    """Return the folder of trial k's good run, None where it has none yet."""
    for run in _attempts(folder, k):
        with suppress(UserError):  # a run that cannot be read is not good
            content = read_run(run)
            if (
                content.about.get("verdict") == "settled"
                and (run / "grasps.csv").is_file()
                and not content.bad
            ):
                return run
    return None


def next_folder(folder: Path, k: int) -> Path:
    """Return a folder for trial k that does not exist yet."""
    return _attempts(folder, k)[-1]


def _attempts(folder: Path, k: int) -> list[Path]:
    """Return the folders of trial k's runs, and as the last one that of its next."""
    attempts = [folder / f"{k + 1:04d}"]
    while attempts[-1].is_dir():
        attempts.append(folder / f"{k + 1:04d}-{len(attempts) + 1}")
    return attempts


def _object(trial: Trial, k: int) -> Object:
    temperature = {"t_object": trial.t_object, "t_object_sd": trial.t_object_sd}
    stated: dict[str, Any] = {name: value for name, value in temperature.items() if value is not None}
    return Object(trial.material, labels=trial.labels, grasp_id=f"{k + 1:04d}", **stated)


def _with_temperature(
    trial: Trial,
    k: int,
    plan: Sequence[Trial],
    path: Path,
    first_touch: Callable[[Grasps], tuple[float, float]] | None,
) -> Trial:
    """Return the trial with the object's temperature from an earlier touch of the same block."""
    group = trial.labels.get("touch_group")
    if first_touch is None or trial.t_object is not None or not group:
        return trial
    for earlier in range(k):
        if plan[earlier].labels.get("touch_group") == group and (run := good_run(path, earlier)) is not None:
            value, sd = first_touch(read_grasps(run / "grasps.csv"))
            return replace(trial, t_object=value, t_object_sd=sd)
    return trial


def _trial_verdict(
    session: Session, k: int, trial: Trial, run: Path, judge: Callable[[int, Trial, Session], str] | None
) -> tuple[str, str]:
    """Return verdict and advice of a trial, the operator's included."""
    if session.verdict != "settled":
        return session.verdict, session.advice
    why = marked = next((event.text for event in session.events if event.kind == "bad"), "")
    if not why and judge is not None:
        why = judge(k, trial, session)
    if why:
        if not marked:
            mark_bad(run, why)
        return "stopped", f"trial {k + 1} is bad: {why}"
    return "done", ""


def _batch(path: Path, plan: Sequence[Trial], verdict: str, advice: str, sessions: int) -> Batch:
    done = tuple(run for k in range(len(plan)) if (run := good_run(path, k)) is not None)
    if done:
        write_grasps(collect(path), path / "grasps.csv")
    return Batch(done, len(plan) - len(done), verdict, advice, sessions)


def _keep_plan(path: Path, plan: Sequence[Trial]) -> None:
    """Write the plan into the folder, or check that it is the one that is there."""
    if not plan:
        raise UserError("the plan has no trial", hint="give at least one row")
    content = json.loads(json.dumps([asdict(trial) for trial in plan]))
    if (path / "batch.json").is_file():
        if read_json(path / "batch.json", SCHEMA, VERSION).get("plan") != content:
            raise UserError("holds a batch of another plan", file=path, hint="choose another folder")
        return
    make_folder(path)
    write_json(path / "batch.json", {"plan": content}, schema=SCHEMA, version=VERSION)
