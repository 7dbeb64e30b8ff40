"""Sections of the page of a controller: its tuning and its closed loops.

As in :mod:`thermogrip.report.classification`, each function returns sections whose verdict is a sentence.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from thermogrip.mpc.closed_loop.simulate import session_loop
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.tuning.objective import meets_spec
from thermogrip.report.console import Cells, Columns, cells, short
from thermogrip.report.html import Plot, Section, Table, Text
from thermogrip.report.plots import closed_loop_chart, grasps_chart, steps_chart

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermogrip.datasets.schema import Grasps
    from thermogrip.mpc.closed_loop.simulate import ClosedLoop
    from thermogrip.mpc.design.design import Design
    from thermogrip.mpc.design.spec import Spec
    from thermogrip.mpc.interface import Move
    from thermogrip.mpc.tuning.tune import Tuning
    from thermogrip.rig.session.session import Session

_STEPS_CAPTION = (
    "Closed loops on one draw of the plant, steps and then loads; dash and dot: the target. MPC is drawn "
    "broad and PI dashed, so that both show where they do the same."
)

#: What of a design counts for a PI.
_OF_A_PI = ("dt", "controlled", "drive_range", "slew_per_s", "loops")


def tuning_table(tuning: Tuning) -> Cells:
    """Return the comparison of baseline, tuned and PI, step by step and load by load."""
    columns: Columns = (
        ("controller", lambda row: row.controller),
        ("step [degC] or load", lambda row: row.load or f"{row.start:g} to {row.target:g}"),
        ("settles in [s], mean", lambda row: _seconds_cell(row.settle_mean_s)),
        ("worst", lambda row: _seconds_cell(row.settle_worst_s)),
        ("overshoot [K], mean", lambda row: _rounded_cell(row.overshoot_mean)),
        ("worst", lambda row: _rounded_cell(row.overshoot_worst)),
        ("bias [K], worst", lambda row: _rounded_cell(row.bias_worst)),
        ("IAE [K s]", lambda row: _rounded_cell(row.iae_mean)),
        ("moves", lambda row: _rounded_cell(row.travel_mean)),
        ("energy [s at full drive]", lambda row: _seconds_cell(row.energy_mean_s)),
        ("minimum time [s]", lambda row: "" if row.load else _seconds_cell(row.bound_s)),
    )
    order = list(dict.fromkeys((row.start, row.target, row.load) for row in tuning.rows))
    ordered = sorted(tuning.rows, key=lambda row: order.index((row.start, row.target, row.load)))
    return cells(columns, ordered)


def tuning_caption(tuning: Tuning) -> str:
    """Return what the comparison ran on."""
    count = tuning.spec.check_draws
    if not tuning.controller.plant.uncertain:
        return "Closed loops on the plant, which has no uncertainty, under noise that the search did not have"
    return f"Closed loops on {count} draw{'' if count == 1 else 's'} of the plant that the search did not see"


def tuning_sections(tuning: Tuning) -> list[Section]:
    """Return the whole report of a tuning."""
    design, kind = tuning.controller.design, kind_of(tuning.controller)
    runs = {title.rpartition(", ")[0]: run for title, run in tuning.runs.items() if title.endswith(kind)}
    steps = {f"{a:g} to {b:g}": f"The step from {a:g} to {b:g} degC" for a, b in tuning.spec.steps}
    sections = [tuning_section(tuning)]
    for title, run in runs.items():
        tone = _tone(tuning.spec, run) if title in steps else ""
        sections.append(loop_section(run, design, steps.get(title, f"A load on {title}"), tone=tone))
    return [*sections, spec_section(tuning)]


def kind_of(controller: Controller | PIController) -> str:
    """Return ``"MPC"`` or ``"PI"``."""
    return "PI" if isinstance(controller, PIController) else "MPC"


def _tone(spec: Spec, run: ClosedLoop) -> str:
    """Return "good" where every output of a step is as the spec asks, else "warn"."""
    return "good" if all(meets_spec(segment, spec) for segment in run.segments) else "warn"


def tuning_section(tuning: Tuning) -> Section:
    """Return the section of a tuned controller: verdict, table, closed loops."""
    scores = ", ".join(f"{name} {value:.3f}" for name, value in tuning.scores.items())
    evidence: list[Any] = [
        *([Plot(steps_chart(tuning.runs), _STEPS_CAPTION)] if tuning.runs else []),
        Table(*tuning_table(tuning), tuning_caption(tuning)),
        Text(f"{tuning.verdict.capitalize()}. {tuning.finding}"),
        Text(
            f"Band {tuning.spec.band_degC:g} degC. Noise, quantum and a sensor offset of "
            f"{tuning.spec.sensor_offset_degC:g} degC are unknown to the controllers. Before the minimum "
            "time no drive inside its limits brings the output into the band, or the ramp has not brought "
            "the target there; a PI takes the target at once."
        ),
        Text(
            f"Scores on these draws, lower is better: {scores}. At most {tuning.spec.evaluations} designs of "
            "each kind were tried; a settling time counts in units of the last column, the IAE of a load in "
            "that of the PI by SIMC or the default MPC, whichever is smaller."
        ),
    ]
    tone = "good" if tuning.meets_spec else "warn"
    question = "Does the controller meet the spec?"
    return Section(question, tuple(evidence), f"{spec_answer(tuning)}.", tone, shown=2)


def spec_answer(tuning: Tuning) -> str:
    """Return the sentence that says whether the spec is met, and what its review fails."""
    failed = "; ".join(f"{check.name}: {check.finding}" for check in tuning.checks if check.verdict == "fail")
    kind = kind_of(tuning.controller)
    return f"The {kind} {'does not meet the spec: ' + failed if failed else 'meets the spec on every draw'}"


def loop_section(run: ClosedLoop, design: Design, title: str, *, tone: str = "") -> Section:
    """Return the section of one closed loop: temperatures with band and the design's limits, and drives; its
    settling decides the tone where none is given."""
    words = "; ".join(
        f"{s.output} from {s.start:.1f} to {s.target:g} degC "
        + (f"settles in {s.settle_s:.0f} s" if np.isfinite(s.settle_s) else "does not settle")
        + f", overshoot {s.overshoot:.2f} K, bias {s.bias:z.3f} K"
        for s in run.segments
    )
    statuses = {status: run.status.count(status) for status in dict.fromkeys(run.status)}
    counts = ", ".join(f"{count} {status}" for status, count in statuses.items())
    chart = closed_loop_chart(run, limits=design.limits)
    caption = (
        f"Shaded: the band of \N{PLUS-MINUS SIGN}{run.band:g} degC; dotted across: settled. "
        f"Grey: limits of the drives. By status: {counts}."
    )
    evidence: list[Any] = [Plot(chart, caption)]
    advices = [text for text in dict.fromkeys(run.advice) if text]
    evidence += [Text(f"Advice of the controller: {'; '.join(advices[:5])}.")] if advices else []
    whole = all(np.isfinite(segment.settle_s) for segment in run.segments)
    return Section(title, tuple(evidence), f"{words}.", tone or ("good" if whole else "warn"))


def spec_section(tuning: Tuning) -> Section:
    """Return the section of what was requested, and of the design that was found, by the names that their
    files have."""
    kind, design = kind_of(tuning.controller), tuning.controller.design.to_dict()
    requested = tuning.spec.model_dump(mode="json")
    chosen = {name: design[name] for name in _OF_A_PI} if kind == "PI" else design
    evidence = tuple(
        Table(
            (head, "value"),
            tuple(
                (name, _as_written(value)) for name, value in values.items() if value not in (None, [], {})
            ),
            caption,
        )
        for head, values, caption in (("key", requested, "The spec"), ("field", chosen, f"The {kind}"))
    )
    words = f"Seed {tuning.seed}; the same seed gives the same design."
    return Section("What was requested, and the design", evidence, words, shown=0)


def _as_written(value: Any) -> str:
    """Return a value much as TOML has it, numbers with four digits."""
    if isinstance(value, Mapping):
        return "; ".join(f"{name} = {_as_written(item)}" for name, item in value.items())
    if isinstance(value, list):
        return f"[{', '.join(_as_written(item) for item in value)}]"
    return short(value)


def session_sections(
    session: Session, moves: list[tuple[float, Move]], controller: Controller | PIController, rig: str
) -> list[Section]:
    """Return the report of a session on ``rig`` (in words): its events, its grasp, and its closed loop as the
    sensors read it, from the moves that ``RecordedController`` kept and within the controller's limits."""
    tone = "good" if session.verdict in ("settled", "followed") else "bad"
    events = tuple((event.time_s, event.kind, event.text) for event in session.events)
    table = Table(("time [s]", "event", "what"), events, "Events")
    evidence: list[Any] = [table, *([Text(f"Advice: {session.advice}.")] if session.advice else [])]
    verdict = f"{session.verdict.capitalize()} on {rig}."
    sections = [Section("How did the session go?", tuple(evidence), verdict, tone)]
    if session.grasps is not None:
        sections.append(_contact_section(session.grasps, session.contact))
    if len(moves) > 1:
        design = controller.design
        figures = _figures_of(session, controller.controlled)
        run = session_loop(session.log, moves, drive_range=design.drive_range, figures=figures)
        sections.append(loop_section(run, design, "The closed loop, as its sensors read it", tone=tone))
    return sections


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
    evidence = (Plot(grasps_chart({"": [grasps]}), caption),)
    return Section("What did the skin feel?", evidence, felt, "good" if np.isfinite(contact) else "warn")


def _seconds_cell(value: float | None) -> Any:
    """Return a number of seconds, in words where there is none."""
    if value is None or np.isnan(value):
        return "does not settle"
    return "never" if np.isinf(value) else round(float(value), 1)


def _rounded_cell(value: float | None) -> Any:
    return None if value is None or not np.isfinite(value) else round(float(value), 3)
