"""Sections of the page of a controller: its tuning, trade-offs and closed loops.

As in :mod:`thermogrip.report.classification`, each function returns sections whose verdict is a sentence.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from thermogrip.mpc.closed_loop.simulate import session_loop
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.design.spec import OnOff, Settling
from thermogrip.mpc.tuning.design_review import range_text
from thermogrip.mpc.tuning.figures import (
    closed_loop_chart,
    pareto_figure,
    step_time_figure,
)
from thermogrip.mpc.tuning.objective import bands_of, meets_spec
from thermogrip.report.console import Cells, Columns, cells, short
from thermogrip.report.html import Picture, Plot, Section, Table, Text
from thermogrip.report.plots import grasps_chart, steps_chart

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermogrip.datasets.schema import Grasps
    from thermogrip.mpc.closed_loop.simulate import ClosedLoop
    from thermogrip.mpc.design.design import Design
    from thermogrip.mpc.design.spec import Spec
    from thermogrip.mpc.interface import Move
    from thermogrip.mpc.tuning.tune import Row, Tuning
    from thermogrip.rig.session.session import Session

_STEPS_CAPTION = (
    "Closed loops on one draw of the plant, steps and then loads; dash and dot: the target. MPC is drawn "
    "broad and PI dashed, so that both show where they do the same."
)

_SPEC_WORDS = {
    "settle_within_s": "settle within [s]",
    "band_degC": "band, half width [degC]",
    "overshoot_degC": "overshoot, at most [degC]",
    "bias_degC": "bias at the end, at most [degC]",
    "hold_s": "each step is simulated for [s]",
    "energy_weight": "seconds of settling given for one at full drive",
    "moves_weight": "share of the minimum time given for one move of full drive less",
    "moves_limit": "moves charged beyond so many times those of the default design",
    "ambient_degC": "room of the simulations [degC]",
    "noise_degC": "noise of one reading [degC]",
    "sensor_offset_degC": "sensors are off by [degC]",
    "search_draws": "draws of the plant in the search",
    "check_draws": "draws in the comparison",
    "evaluations": "designs that each search may try",
    "extra_lag": "sensors slower than the model, tried [apparent delays]",
    "extra_delay": "delay longer than the model's, tried [apparent delays]",
    "lost_gain": "share of the drives that does nothing, tried",
}

_WISHES = {
    "disturbances": "measured, in the simulations and where nobody reads them",
    "settling": "of single outputs",
    "limits": "limits of outputs, soft [degC]",
    "weights": "how many times the errors of an output count",
    "zones": "anywhere within, about the target",
    "hard": "limits that give way last",
    "energy_price": "price of a sample at full drive",
    "tariff": "second of the day, times the price",
    "ramp_per_s": "fastest change of a target [per s]",
    "safe_drive": "drive without its loop",
    "on_off": "switched by the controller",
}


def tuning_table(tuning: Tuning) -> Cells:
    """Return the comparison of baseline, tuned and PI, step by step and load by load."""
    columns: Columns = (
        ("controller", lambda row: row.controller),
        ("step [degC] or load", _case),
        ("settles in [s], mean", lambda row: _shown(row.settle_mean_s)),
        ("worst", lambda row: _shown(row.settle_worst_s)),
        ("overshoot [K], mean", lambda row: _rounded(row.overshoot_mean)),
        ("worst", lambda row: _rounded(row.overshoot_worst)),
        ("bias [K], worst", lambda row: _rounded(row.bias_worst)),
        ("IAE [K s]", lambda row: _rounded(row.iae_mean)),
        ("moves", lambda row: _rounded(row.travel_mean)),
        ("energy [s at full drive]", lambda row: _shown(row.energy_mean_s)),
        ("minimum time [s]", lambda row: "" if row.load else _shown(row.bound_s)),
    )
    order = list(dict.fromkeys((row.start, row.target, row.load) for row in tuning.rows))
    ordered = sorted(tuning.rows, key=lambda row: order.index((row.start, row.target, row.load)))
    return cells(columns, ordered)


def _case(row: Row) -> str:
    """Return what a row is of, in words."""
    return f"{row.load or f'{row.start:g} to {row.target:g}'}{row.output and f', {row.output}'}"


def tuning_caption(tuning: Tuning) -> str:
    """Return what the comparison ran on."""
    count = tuning.spec.check_draws
    several = f"{count} draw{'' if count == 1 else 's'} of the plant"
    draws = several if _uncertain(tuning) else "the plant"
    return f"Closed loops on {draws}"


def tuning_sections(tuning: Tuning) -> list[Section]:
    """Return the whole report of a tuning."""
    design, kind = tuning.controller.design, kind_of(tuning.controller)
    runs = {title.rpartition(", ")[0]: run for title, run in tuning.runs.items() if title.endswith(kind)}
    steps = {f"{a:g} to {b:g}": f"The step from {a:g} to {b:g} degC" for a, b in tuning.spec.steps}
    sections = [tuning_section(tuning), pareto_section(tuning)]
    for title, run in runs.items():
        tone = _tone(tuning.spec, run) if title in steps else ""
        sections.append(loop_section(run, design, steps.get(title, f"A load on {title}"), tone=tone))
    seconds = [float(each) for run in runs.values() for each in run.seconds]
    if seconds:
        sections.append(timing_section(seconds, design))
    return [*sections, spec_section(tuning)]


def kind_of(controller: Controller | PIController) -> str:
    """Return ``"MPC"`` or ``"PI"``."""
    return "PI" if isinstance(controller, PIController) else "MPC"


def _tone(spec: Spec, run: ClosedLoop) -> str:
    """Return "good" where every output of a step is as the spec asks, else "warn"."""
    return "good" if all(meets_spec(segment, spec) for segment in run.segments) else "warn"


def tuning_section(tuning: Tuning) -> Section:
    """Return the section of a tuned controller: verdict, table, closed loops."""
    meets = (
        "The controller meets the spec on every draw."
        if tuning.meets_spec
        else "The controller does not meet the spec on every draw."
    )
    scores = ", ".join(f"{name} {value:.3f}" for name, value in tuning.scores.items())
    parts: list[Any] = [
        *([Plot(steps_chart(tuning.runs), _STEPS_CAPTION)] if tuning.runs else []),
        Table(*tuning_table(tuning), tuning_caption(tuning)),
        Text(f"{tuning.verdict.capitalize()}. {tuning.finding}"),
        Text(
            f"Band {_bands(bands_of(tuning.spec, tuning.controller.design.controlled))}. {_unseen(tuning)}; "
            f"noise, quantum and a sensor offset of {tuning.spec.sensor_offset_degC:g} degC are unknown to "
            f"the controllers. {_before_the_last_column(tuning.spec)}"
        ),
        Text(
            f"Scores on these draws, lower is better: {scores}. At most {tuning.spec.evaluations} designs of "
            "each kind were tried; a settling time counts in units of the last column, the IAE of a load in "
            "that of the PI by SIMC or the default MPC, whichever is smaller."
        ),
    ]
    tone = "good" if tuning.meets_spec else "warn"
    return Section("Does the controller meet the spec?", tuple(parts), meets, tone, shown=2)


def pareto_section(tuning: Tuning) -> Section:
    """Return the section of what may be traded: settling, overshoot and energy of many designs."""
    draws = tuning.spec.search_draws if _uncertain(tuning) else 1
    rows = sorted(tuning.pareto.rows(), key=lambda row: (row["settle_s"] is None, row["settle_s"]))
    columns: Columns = (
        ("controller", lambda row: row["controller"]),
        ("design", lambda row: row["name"]),
        ("settling [s]", lambda row: _shown(row["settle_s"])),
        ("overshoot, worst [K]", lambda row: _rounded(row["overshoot_degC"])),
        ("energy [s at full drive]", lambda row: _shown(row["energy_s"])),
        ("non-dominated", lambda row: "yes" if row["best"] else ""),
    )
    parts = (
        Picture(
            pareto_figure(tuning.pareto),
            "Each mark is a design; ringed: no other is as good in settling, overshoot and energy and "
            "better in one. Differences of a second, 0.05 K or half a per cent of energy do not count.",
        ),
        Table(
            *cells(columns, rows),
            f"Means over steps and the draws of the search ({draws}), {tuning.spec.hold_s:g} s each",
        ),
    )
    return Section("What can be traded?", parts, _trade(rows))


def loop_section(run: ClosedLoop, design: Design, title: str, *, tone: str = "") -> Section:
    """Return the section of one closed loop: temperatures with band and the design's limits, drive, slew;
    where no tone is given, the run's settling decides it."""
    words = "; ".join(
        f"{s.output} from {s.start:.1f} to {s.target:g} degC "
        + (f"settles in {s.settle_s:.0f} s" if np.isfinite(s.settle_s) else "does not settle")
        + f", overshoot {s.overshoot:.2f} K, bias {s.bias:z.3f} K"
        for s in run.segments
    )
    statuses = {status: run.status.count(status) for status in dict.fromkeys(run.status)}
    counts = ", ".join(f"{count} {status}" for status, count in statuses.items())
    chart = closed_loop_chart(run, limits=design.limits, slew_per_s=design.slew_per_s)
    caption = (
        f"Shaded: the band of \N{PLUS-MINUS SIGN}{_bands(run.band)}; dotted across: settled. Grey: limits of "
        f"drive and slew. By status: {counts}."
    )
    parts: list[Any] = [Plot(chart, caption)]
    advices = [text for text in dict.fromkeys(run.advice) if text]
    parts += [Text(f"Advice of the controller: {'; '.join(advices[:5])}.")] if advices else []
    whole = all(np.isfinite(segment.settle_s) for segment in run.segments)
    return Section(title, tuple(parts), f"{words}.", tone or ("good" if whole else "warn"))


def timing_section(seconds: Sequence[float], design: Design) -> Section:
    """Return the section of how long steps took, against the deadline."""
    times = np.asarray(seconds, dtype=float)
    late = int(np.sum(times > design.deadline_s))
    slowest = 1e3 * float(times.max())
    verdict = (
        f"{late} of {times.size} steps took longer than their deadline of {design.deadline_s:g} s."
        if late
        else f"The slowest of {times.size} steps took {slowest:.2g} ms of the {design.deadline_s:g} s it had."
    )
    figure = step_time_figure({"controller": times}, design.deadline_s, design.dt)
    caption = (
        "Wall time of a step in Python on this machine, whatever else it did; what is later than the "
        "deadline does not count, and the last plan goes on."
    )
    return Section("Is it fast enough?", (Picture(figure, caption),), verdict, "warn" if late else "good")


def spec_section(tuning: Tuning) -> Section:
    """Return the section of what was requested, and of the design that was found."""
    spec, design = tuning.spec, tuning.controller.design
    requested = [("steps [degC]", ", ".join(f"{a:g} to {b:g}" for a, b in spec.steps))]
    requested += [(words, getattr(spec, key)) for key, words in _SPEC_WORDS.items()]
    requested += [
        (words, _listed(getattr(spec, key))) for key, words in _WISHES.items() if getattr(spec, key)
    ]
    design_rows: list[tuple[str, Any]] = [
        ("regulated", ", ".join(design.controlled)),
        ("controller", kind_of(tuning.controller)),
        ("sample time [s]", design.dt),
        *((f"range of {name}", f"{low:g} to {high:g}") for name, (low, high) in design.drive_range.items()),
        *((f"slew of {name} [1/s]", value) for name, value in design.slew_per_s.items()),
        *((f"Kc, Ti [s] of {p.output} by {p.drive}", f"{p.Kc:.4g}, {p.Ti:.4g}") for p in design.loops),
    ]
    if isinstance(tuning.controller, Controller):
        design_rows += [
            ("horizon [s]", design.horizon_s),
            ("blocks [samples]", " ".join(map(str, design.blocks))),
            ("move weight", design.move),
            ("terminal weight", design.terminal),
            ("overshoot band [degC]", design.overshoot),
            *((f"process noise of {name}'s disturbance", sd) for name, sd in design.noise.drive.items()),
            ("process noise of an output's disturbance", design.noise.output),
            ("disturbances estimated", ", ".join(tuning.controller.disturbance.names)),
        ]
    parts = tuple(
        Table(head, tuple((words, short(value)) for words, value in rows), caption)
        for head, rows, caption in (
            (("requested", "value"), requested, "The spec"),
            (("design", "value"), design_rows, "The design"),
        )
    )
    words = f"Seed {tuning.seed}; the same seed gives the same design."
    return Section("What was requested, and the design", parts, words, shown=0)


def _bands(band: float | Mapping[str, float]) -> str:
    """Return the half width of the settling band in words, by output where they differ."""
    if not isinstance(band, Mapping):
        return f"{band:g} degC"
    return ", ".join(f"{half:g} degC of {name}" for name, half in band.items())


def _listed(value: Any) -> str:
    """Return a value of the spec as text: by output or drive, and of a tariff by its times."""
    if isinstance(value, OnOff):
        least = f"at least {value.min_on_s:g} s on, {value.min_off_s:g} s off"
        return f"{least}, a sample on costs {value.price:g}"
    if isinstance(value, Settling):
        own = {_SPEC_WORDS[f"settle_{key}" if key == "within_s" else key]: each for key, each in value}
        return ", ".join(f"{words} {each:g}" for words, each in own.items() if each is not None)
    if isinstance(value, dict):
        return ", ".join(f"{name} {_listed(each)}" for name, each in value.items())
    if isinstance(value, list):
        return ", ".join(each if isinstance(each, str) else f"{each[0]:g}: {each[1]:g}" for each in value)
    return range_text(*value) if isinstance(value, tuple) else f"{value:g}"


def session_sections(
    session: Session, moves: list[tuple[float, Move]], controller: Controller | PIController, rig: str
) -> list[Section]:
    """Return the report of a session on ``rig`` (in words): its events, its grasp, and its closed loop as the
    sensors read it, from the moves that ``RecordedController`` kept and within the controller's limits."""
    tone = "good" if session.verdict in ("settled", "followed") else "bad"
    events = tuple((event.time_s, event.kind, event.text) for event in session.events)
    table = Table(("time [s]", "event", "what"), events, "Events")
    parts: list[Any] = [table, *([Text(f"Advice: {session.advice}.")] if session.advice else [])]
    verdict = f"{session.verdict.capitalize()} on {rig}."
    found = [Section("How did the session go?", tuple(parts), verdict, tone)]
    if session.grasps is not None:
        found.append(_contact_section(session.grasps, session.contact))
    if len(moves) > 1:
        design = controller.design
        figures = _figures_of(session, controller.controlled)
        run = session_loop(session.log, moves, drive_range=design.drive_range, figures=figures)
        found.append(loop_section(run, design, "The closed loop, as its sensors read it", tone=tone))
        found.append(timing_section([move.seconds for _, move in moves], design))
    return found


def _figures_of(session: Session, controlled: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return the session's own figures, which the command line prints, of its worst output; what never
    settled has no bias."""
    if len(controlled) != 1:
        return {}
    figures = {"settle_s": session.settle_time, "overshoot": session.overshoot}
    return {controlled[0]: figures | ({"bias": session.bias} if np.isfinite(session.bias) else {})}


def _contact_section(grasps: Grasps, contact: float) -> Section:
    """Return the section of a session's grasp: its trace, and when the skin felt the object."""
    side = "before" if contact < -0.05 else "after"
    felt = (
        f'The skin felt the object {abs(contact):.1f} s {side} the "closed" message.'
        if np.isfinite(contact)
        else "The skin felt no object: no contact, or one as warm as the skin."
    )
    caption = "The grasp as recorded; dotted: the message."
    parts = (Plot(grasps_chart({"": [grasps]}), caption),)
    return Section("What did the skin feel?", parts, felt, "good" if np.isfinite(contact) else "warn")


def _trade(rows: list[dict[str, Any]]) -> str:
    """Return the sentence of the two ends of the front."""
    front = [row for row in rows if row["best"]]
    if not front:
        return "No design settled on all draws."
    fast = min(front, key=lambda row: row["settle_s"])
    frugal = min(front, key=lambda row: row["energy_s"])
    if fast is frugal or frugal["energy_s"] > 0.97 * fast["energy_s"]:
        return f"Nothing: the fastest design ({fast['settle_s']:.0f} s) is as frugal as any."
    saved = 100 * (1 - frugal["energy_s"] / fast["energy_s"])
    return (
        f"Speed for energy: {frugal['name']} takes {frugal['settle_s']:.0f} s instead of "
        f"{fast['settle_s']:.0f} s and {saved:.0f} % less energy."
    )


def _uncertain(tuning: Tuning) -> bool:
    plant = tuning.controller.plant
    return plant.samples is not None or plant.covariance is not None


def _before_the_last_column(spec: Spec) -> str:
    """Return what the minimum time means."""
    if spec.ramps:
        return (
            "Before the last column no drive inside its limits brings the output into the band, or the ramp "
            "has not brought the target there; a PI takes the target at once."
        )
    return (
        "Before the last column no drive inside its limits brings the output into the band, whatever the "
        "controller."
    )


def _unseen(tuning: Tuning) -> str:
    if _uncertain(tuning):
        return "The draws of this table were not used in the search"
    return "The plant has no uncertainty, so the table is of the plant itself, under noise of its own"


def _shown(value: float | None) -> Any:
    """Return a number of seconds, in words where there is none."""
    if value is None or np.isnan(value):
        return "does not settle"
    return "never" if np.isinf(value) else round(float(value), 1)


def _rounded(value: float | None) -> Any:
    return None if value is None or not np.isfinite(value) else round(float(value), 3)
