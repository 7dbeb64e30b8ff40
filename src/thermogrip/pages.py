"""What each result looks like on the page: the sections that the verbs and the demo share.

Each function takes one room's result and returns sections whose verdict is a sentence.  Numbers come from the
result alone; nothing is computed here but the choice of words.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

from thermogrip.datasets.schema import log_name
from thermogrip.figures import (
    free_run_figure,
    grasp_figure,
    ladder_figure,
    loop_figure,
    posterior_figure,
    residual_figure,
    steps_figure,
)
from thermogrip.report import Picture, Section, Table, Text

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermogrip.classify import Comparison
    from thermogrip.datasets.schema import Grasps, Log
    from thermogrip.mpc import Check, Tuning
    from thermogrip.rig import Session
    from thermogrip.sysid.bands import Band
    from thermogrip.sysid.growth import Growth
    from thermogrip.sysid.ladder import Identification
    from thermogrip.sysid.plant import Plant
    from thermogrip.sysid.posterior import Posterior
    from thermogrip.sysid.validate import FreeRun

__all__ = [
    "MODEL_HEAD",
    "PARAMETER_HEAD",
    "SCORE_OF_RUN",
    "TUNING_HEAD",
    "comparison_sections",
    "free_run_section",
    "growth_section",
    "identification_section",
    "identification_sections",
    "model_rows",
    "parameter_rows",
    "posterior_section",
    "review_section",
    "run_rows",
    "session_section",
    "touch_section",
    "tuning_rows",
    "tuning_section",
]

SCORE_OF_RUN = ("log", "output", "RMSE", "unit", "fit [%]", "n", "no input", "mean", "one step")

PARAMETER_HEAD = ("parameter", "value", "unit", "5 %", "95 %", "prior 5 %", "prior 95 %")
MODEL_HEAD = ("model", "log", "output", "RMSE", "unit", "fit [%]", "n", "no input", "")
TUNING_HEAD = (
    "controller",
    "step [degC]",
    "settles in [s], mean",
    "worst",
    "overshoot, worst [K]",
    "bias, worst [K]",
    "energy [s at full drive]",
    "full drive needs [s]",
)
SCORE_HEAD = (
    "classifier",
    "condition",
    "n",
    "accuracy",
    "from",
    "to",
    "log loss",
    "by chance",
    "ECE",
    "fit [s]",
)
SCORE_KEYS = (
    "classifier",
    "condition",
    "n",
    "accuracy",
    "low",
    "high",
    "log_loss",
    "log_loss_chance",
    "ece",
    "fit_s",
)


def run_rows(name: str, run: FreeRun) -> list[tuple[Any, ...]]:
    """Return a free run's scores beside its baselines (RMSE), a row an output."""
    return [
        (
            name,
            output,
            score.rmse,
            score.unit,
            score.fit_percent,
            score.n,
            run.naive["no_input"][output].rmse,
            run.naive["mean"][output].rmse,
            run.one_step[output].rmse,
        )
        for output, score in run.scores.items()
    ]


def model_rows(found: Identification) -> list[tuple[Any, ...]]:
    """Return the ladder's table: a row a model, log and output."""
    return [
        (
            row.model,
            row.log,
            row.output,
            row.rmse,
            row.unit,
            row.fit_percent,
            row.n,
            row.no_input_rmse,
            "held out" if row.held_out else "in the fit",
        )
        for row in found.rows
    ]


def model_table(found: Identification) -> Table:
    """Return the ladder as a small table: a row a model and output, a column a log."""
    held = [row for row in found.rows if row.held_out]
    logs = list(dict.fromkeys(row.log for row in held))
    rows = []
    for model, output, unit in dict.fromkeys((row.model, row.output, row.unit) for row in held):
        by_log = {row.log: row.rmse for row in held if (row.model, row.output) == (model, output)}
        rows.append((model, output, *(by_log.get(log) for log in logs), unit))
    for output, unit in dict.fromkeys((row.output, row.unit) for row in held):
        blind = {row.log: row.no_input_rmse for row in held if row.output == output}
        rows.append(("no input", output, *(blind.get(log) for log in logs), unit))
    return Table(
        ("model", "output", *logs, "unit"), tuple(rows), "Free-run RMSE on rows that were not fitted"
    )


def identification_section(found: Identification, plant: Plant) -> Section:
    """Return the section of the ladder: verdict, every model's free run, what the data check says."""
    from thermogrip.sysid.identifiability import identifiability_report

    checks = [
        (f.verdict, f.check, f.log, f.channel, f.says) for f in found.data_check.findings if f.verdict != "ok"
    ]
    parts: list[Any] = [
        Picture(
            ladder_figure(found.rows), "Free-run error of every model on rows that it was not fitted to."
        ),
        model_table(found),
        Table(
            ("log", "output", "RMSE", "unit", "fit [%]", "n"),
            tuple(
                (r.log, r.output, r.rmse, r.unit, r.fit_percent, r.n) for r in found.rows if not r.held_out
            ),
            f"{found.model}, fitted on everything, on its own logs",
        ),
    ]
    if plant.free:
        parts.append(Table(PARAMETER_HEAD, tuple(parameter_rows(plant)), "Free parameters"))
        parts += _per_log(plant)
        parts += [Text(_sentence(said[0].upper() + said[1:])) for said in identifiability_report(plant)]
    if checks:
        parts.append(Table(("verdict", "check", "log", "channel", "finding"), tuple(checks), "Data check"))
    parts += [Text(note) for note in found.notes]
    tone = "good" if found.good else "warn"
    return Section("Which plant is behind the logs?", tuple(parts), _sentence(found.verdict), tone)


def identification_sections(
    found: Identification,
    logs: Sequence[Log],
    plant: Plant,
    record: Posterior | None,
    growth: Growth | None = None,
) -> list[Section]:
    """Return the report of an identification: the ladder, any growth and posterior, every log in sample.

    ``plant`` is the chosen one, with samples where ``record`` says how they were drawn.
    """
    from thermogrip.sysid.validate import free_run

    sections = [identification_section(found, plant)]
    if growth is not None:
        sections.append(growth_section(growth))
    if record is not None:
        sections.append(posterior_section(plant, record))
    return sections + [free_run_section(log, free_run(plant, log), plant, seen=True) for log in logs]


def growth_section(growth: Growth) -> Section:
    """Return the section of the growth of a network: what was tried, what it gained, why it was refused."""
    from thermogrip.sysid.growth import growth_table

    head, rows = growth_table(growth)
    kept = [row.candidate for row in growth.rows if row.verdict == "kept" and row.change != "base"]
    verdict = f"Kept: {', '.join(kept)}." if kept else "No change earned its place."
    still = "; ".join(
        f"{term.output} still obeys {term.term} ({100 * term.share:.0f} % of the residual's variance)"
        for term in growth.residual
    )
    parts: list[Any] = [
        Table(tuple(head), tuple(tuple(row) for row in rows), "Held-out RMSE of each candidate, in free run"),
        Text(
            f"{growth.looks} comparisons on the same held-out logs: the best of so many is flattered by "
            "chance. A term is kept if it gains more than its standard error and the logs tell it."
        ),
    ]
    if still:
        parts.append(Text(_sentence(f"Before growth, {still}")))
    return Section("Which terms does the network need?", tuple(parts), verdict)


def posterior_section(plant: Plant, record: Posterior) -> Section:
    """Return the section of the parameters' posterior: marginals, corner plot, how it was sampled."""
    from thermogrip.sysid.corner import corner_figure

    figure = posterior_figure(record.samples, record.free, record.units, record.fitted)
    slowest = max(record.tau.values())
    parts: list[Any] = [
        Picture(figure, f"Marginals of {len(record.samples)} samples: 90 % shaded, fitted value red."),
        Picture(
            corner_figure(record), "The parameters that emcee sampled, pair by pair; grey lines: the fit."
        ),
        Text(_sentence(record.likelihood)),
        Text(
            f"emcee moved {', '.join(record.sampled)}; the others were integrated out by linearisation. "
            f"{record.n_steps} steps, longest autocorrelation time {slowest:.0f} steps "
            f"({record.n_steps / slowest:.0f} of them), {100 * record.acceptance:.0f} % accepted. "
            f"Medians lie within {record.off_centre:.2f} standard deviations of the fitted values."
        ),
    ]
    tone = "good" if record.converged else "warn"
    return Section("How well are its parameters known?", tuple(parts), _sentence(record.verdict), tone)


def parameter_rows(plant: Plant) -> list[tuple[Any, ...]]:
    """Return the free parameters with their 90 % intervals, and those of the prior."""
    intervals, before = plant.intervals(0.9), _prior_intervals(plant)
    nothing = (None, None)
    return [
        (
            name,
            plant.values[name],
            plant.units.get(name, "1"),
            *intervals.get(name, nothing),
            *before.get(name, nothing),
        )
        for name in plant.free
    ]


def _per_log(plant: Plant) -> list[Table]:
    """Return the table of what each log has of its own, empty where nothing is known of it."""
    found = plant.scores.get("per_log", {})
    rows = [(log, effect, *number) for log, effects in found.items() for effect, number in effects.items()]
    head = ("log", "effect", "value", "sd")
    return [Table(head, tuple(rows), "Effects of each log, beside the parameters that all share")] * bool(
        rows
    )


def _prior_intervals(plant: Plant) -> dict[str, tuple[float, float]]:
    """Return the prior's 90 % intervals by name; a black box has none."""
    from thermogrip.sysid.excite_information import prior_belief
    from thermogrip.sysid.grey_model import GreyModel

    if not hasattr(plant.model, "specs"):
        return {}
    return prior_belief(cast(GreyModel, plant.model)).intervals(0.9)


def session_section(sessions: Sequence[tuple[str, Session]], rig: str) -> Section:
    """Return the section of sessions on a rig: how each settled, temperatures and drive."""
    rows = tuple((title, s.verdict, s.settle_time, s.overshoot, s.bias) for title, s in sessions)
    head = ("session", "verdict", "settled after [s]", "overshoot [K]", "bias [K]")
    targets = {title: float(s.log["target_t_surface"].values[0]) for title, s in sessions}
    figure = loop_figure({title: s.log for title, s in sessions}, targets)
    failed = [title for title, s in sessions if s.verdict != "settled"]
    verdict = f"{len(sessions) - len(failed)} of {len(sessions)} sessions settled on {rig}."
    parts: list[Any] = [Table(head, rows), Picture(figure, "Sessions: settle, stop the pump, grasp.")]
    parts += [Text(f"{title}: {s.advice}") for title, s in sessions if s.advice]
    return Section("Does it settle and grasp?", tuple(parts), verdict, "warn" if failed else "good")


def touch_section(touched: Sequence[Grasps], rows: Sequence[dict[str, Any]], trained_on: str) -> Section:
    """Return the section of the twin's grasps: the traces, and what the classifier says of them."""
    if not rows:
        return Section("What did it touch?", (), "Nothing: no session came to a grasp.", "warn")
    right = sum(row["material"] == row["true"] for row in rows)
    named = [key for key in rows[0] if key.startswith("p_")]
    head = ("true", "said", *(key.removeprefix("p_") for key in named), "decided at [s]")
    table = tuple(
        (row["true"], row["material"], *(_probability(row[key]) for key in named), row["decided_at_s"])
        for row in rows
    )
    strange = [row["true"] for row in rows if (row["p_unknown"] or 0.0) > 0.5]
    verdict = f"{right} of {len(rows)} grasps of the twin were named right."
    if strange:
        verdict += f" That of {', '.join(strange)} is marked as unlike any block of the training (p unknown)."
    parts = (
        Picture(grasp_figure(touched), "The grasps as recorded."),
        Table(head, table, f"Posterior classifier, trained on {trained_on}"),
        Text(
            "Unknown is the probability that the block is none of the candidates; it stands beside "
            "them, not in their sum. One grasp a material shows that the stages fit together, not how often "
            "they are right."
        ),
    )
    tone = "good" if right == len(rows) and not strange else "warn"
    return Section("What did it touch?", parts, verdict, tone)


def _probability(p: float | None) -> float | None:
    return None if p is None else round(p, 4)


def _sentence(text: str) -> str:
    return text + ("" if text.endswith(".") else ".")


def free_run_section(log: Log, run: FreeRun, plant: Plant, *, seen: bool = False, title: str = "") -> Section:
    """Return the section of one log: free run beside the measurement, scores, residual tests, notes.

    ``seen`` says that the log was in the fit; ``title`` takes the place of the usual one.
    """
    from thermogrip.sysid.bands import free_run_band

    name = log_name(log)
    words = ", ".join(f"{output} to {score.rmse:.2g} {score.unit}" for output, score in run.scores.items())
    verdict = f"Free run (RMSE): {words}."
    if run.ties:
        verdict += f" {', '.join(run.ties)}: no better than a model without input."
    band = free_run_band(plant, log, run.log)
    parts: list[Any] = [
        Picture(
            free_run_figure(log, run.log, tuple(run.scores), band),
            f"{name}: measured, simulated from the inputs alone, and their difference. Readings of the first "
            f"seconds set the state; nothing is fed back after that. {_band_words(band)}",
        ),
        Table(SCORE_OF_RUN, tuple(run_rows(name, run)), "RMSE beside what needs no model"),
        Picture(
            residual_figure(run),
            "Correlation of the residuals with themselves and with the inputs before them; shaded: 95 % of "
            "the lags, were nothing left.",
        ),
    ]
    parts += [Text(_sentence(note)) for note in run.notes]
    title = title or f"Free run: {name}" + (" (in the fit)" if seen else "")
    return Section(title, tuple(parts), verdict, "warn" if run.ties else "good")


def _band_words(band: Band) -> str:
    """Return what the shaded band is, and how many readings it holds."""
    inside = ", ".join(f"{100 * share:.0f} % of {name}" for name, share in band.inside.items())
    drawn = f"{band.draws} draws of the parameters and the error of the fit"
    spans = drawn if band.draws else "the error of the fit alone"
    return f"Shaded: {100 * band.level:.0f} % band from {spans}; it holds {inside}."


def tuning_rows(tuning: Tuning) -> tuple[tuple[Any, ...], ...]:
    """Return the comparison of baseline, tuned and PI as table rows, step by step."""
    rows = sorted(tuning.rows, key=lambda row: tuning.spec.steps.index((row.start, row.target)))
    return tuple(
        (
            row.controller,
            f"{row.start:g} to {row.target:g}",
            row.settle_mean_s,
            row.settle_worst_s,
            row.overshoot_worst,
            row.bias_worst,
            row.energy_mean_s,
            row.bound_s,
        )
        for row in rows
    )


def tuning_section(tuning: Tuning) -> Section:
    """Return the section of a tuned controller: verdict, table, closed loops."""
    meets = (
        "It meets the spec on every draw."
        if tuning.meets_spec
        else "It does not meet the spec on every draw."
    )
    parts: list[Any] = [
        Table(
            TUNING_HEAD, tuning_rows(tuning), f"Closed loops on {tuning.spec.check_draws} draws of the plant"
        ),
        Picture(steps_figure(tuning.runs), "Closed loops on one draw of the plant, MPC and PI."),
        Text(
            f"Band {tuning.spec.band_degC:g} degC. The draws of this table were not used in the search; "
            f"noise, quantum and a sensor offset of {tuning.spec.sensor_offset_degC:g} degC are unknown to "
            "the controllers."
        ),
    ]
    tone = "good" if tuning.meets_spec else "warn"
    return Section("Does the controller hold?", tuple(parts), f"{meets} {tuning.finding}", tone)


def review_section(checks: Sequence[Check]) -> Section:
    """Return the section of a design review."""
    failed = [check.name for check in checks if check.verdict == "fail"]
    warned = [check.name for check in checks if check.verdict == "warn"]
    verdict = f"{len(checks) - len(failed) - len(warned)} of {len(checks)} checks pass."
    if warned:
        verdict += f" Warnings: {', '.join(warned)}."
    if failed:
        verdict += f" Failed: {', '.join(failed)}."
    rows = tuple((check.name, check.verdict, check.finding, check.fix) for check in checks)
    tone = "bad" if failed else "warn" if warned else "good"
    return Section(
        "Is the design sound?", (Table(("check", "verdict", "finding", "fix"), rows),), verdict, tone
    )


def comparison_sections(name: str, comparison: Comparison) -> list[Section]:
    """Return the section of one kind of split: accuracies with n, confusions, calibration.

    Parameters
    ----------
    name : str
        ``shipped``, ``random`` or ``files``.
    comparison : Comparison
    """
    from thermogrip.classify.comparison import POOLED
    from thermogrip.classify.figures import accuracy_figure, confusion_figure, reliability_figure

    scores = comparison.scores()
    groups = [row["condition"] for row in scores]
    shown = POOLED if POOLED in groups else groups[0]
    parts: list[Any] = [
        Picture(accuracy_figure(comparison), f"Accuracy by condition. {comparison.interval_note}"),
        Table(SCORE_HEAD, tuple(tuple(row[key] for key in SCORE_KEYS) for row in scores), "All scores"),
        Picture(confusion_figure(comparison, shown), f"Confusion, {shown}: rows true, columns said."),
        Picture(reliability_figure(comparison, shown), f"Confidence beside accuracy, {shown}."),
    ]
    leaks = [row for row in comparison.leaks if row["leak"]]
    if leaks:
        where = ", ".join(f"{row['classifier']} on {row['condition']}" for row in leaks)
        parts.append(Text(f"Leak probe: labels can be told from samples before contact by {where}."))
    elif comparison.leaks:
        parts.append(Text("Leak probe: from samples before contact no classifier beats chance."))
    if comparison.notes:
        parts.append(Text("Notes: " + "; ".join(comparison.notes) + "."))
    title = {"shipped": "Which material? Shipped split", "random": "Which material? Random splits"}
    return [Section(title.get(name, "Which material?"), tuple(parts), _who_wins(comparison, shown), "plain")]


def _who_wins(comparison: Comparison, condition: str) -> str:
    """Return who is best on the pooled grasps, and what n lets one say about the next."""
    rows = sorted(
        (row for row in comparison.scores() if row["condition"] == condition), key=lambda row: row["log_loss"]
    )
    best = rows[0]
    said = (
        f"{best['classifier']} has the lowest log loss ({best['log_loss']:.2f}; chance "
        f"{best['log_loss_chance']:.2f}) and {100 * best['accuracy']:.0f} % right of n = {best['n']} grasps "
        f"({100 * best['low']:.0f} to {100 * best['high']:.0f} %)."
    )
    for row in rows[1:]:
        said += f" {row['classifier']}: {100 * row['accuracy']:.0f} %, log loss {row['log_loss']:.2f}."
    close = [
        d
        for d in comparison.differences(condition)
        if best["classifier"] in (d["first"], d["second"]) and d["p_value"] > 0.05
    ]
    if close:
        others = ", ".join(d["second"] if d["first"] == best["classifier"] else d["first"] for d in close)
        said += f" In accuracy n does not separate it from {others}."
    return said
