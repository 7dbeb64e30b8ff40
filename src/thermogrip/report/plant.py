"""Sections and charts of the page of a plant: the models compared, its parameters, posterior, free runs.

As in :mod:`thermogrip.report.classification`, each function returns sections whose verdict is a sentence.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.schema import column, log_name, names
from thermogrip.report.charts import (
    DASHES,
    PALETTE,
    Chart,
    Curve,
    Panel,
    difference_unit,
    stretches,
    with_unit,
)
from thermogrip.report.console import Cells, significant
from thermogrip.report.html import Picture, Plot, Section, Table, Text

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.figure import Figure

    from thermogrip.datasets.schema import Log
    from thermogrip.sysid.export.dynamics import Dynamics, Estimate
    from thermogrip.sysid.greybox import Posterior
    from thermogrip.sysid.identification import Identification
    from thermogrip.sysid.plant.plant import Plant
    from thermogrip.sysid.validation import Band, FreeRun
    from thermogrip.sysid.validation.stated_errors import Row

_BASELINES = (
    "Beside the free run: the best decay without input, the log's mean, and one step from each last "
    "reading (RMSE)"
)
_HELD_OUT = "Free-run RMSE on rows that were not fitted (blocks: of means over a step of the model)"
MEASURED, PREDICTED = "#9dabb9", PALETTE[1]  # a broad line, and a thin one of dashes over it
_TIME_CONSTANTS = 6  # the slowest, in a sentence


def free_run_chart(run: FreeRun, outputs: Sequence[str], band: Band | None = None) -> Chart:
    """Return outputs measured and in free run, their difference and the inputs, a column an output; rows
    whose ``scored`` is 0 stand on grey, and where a band is given readings are expected in the shade."""
    log, simulated = run.measured, run.log
    t = np.asarray(log["time"].values, dtype=float)
    shaded = stretches(t, column(simulated, "scored") == 0) if "scored" in simulated else ()
    inputs = tuple(
        Curve(with_unit(u, log[u].attrs["units"]), t, column(log, u), PALETTE[(2 + k) % 8], step=True)
        for k, u in enumerate(names(log, "input"))
    )
    columns = []
    for name in outputs:
        measured, model = column(log, name), column(simulated, name)
        unit = log[name].attrs["units"]
        read = Curve("measured", t, measured, MEASURED, width=5.0)
        freely = Curve("free run", t, model, PREDICTED, width=1.6, dash="--")
        error = Curve("measured - free run", t, measured - model, width=0.9)
        above: tuple[Curve, ...] = (read, freely)
        below: tuple[Curve, ...] = (error,)
        if band is not None:
            half = band.half[name]
            above = (read, replace(freely, low=model - half, high=model + half))
            below = (Curve("expected", t, 0 * half, PREDICTED, 1.0, "--", low=-half, high=half), error)
        columns.append(
            (
                Panel(with_unit(name, unit), above, name, 2.4, shaded=shaded),
                Panel(f"error [{difference_unit(unit)}]", below, height=1.3, shaded=shaded),
                Panel("inputs", inputs),
            )
        )
    return Chart(tuple(columns))


def step_response_chart(found: Dynamics) -> Chart:
    """Return the response of each output, a panel each, to a unit step of each input, a column each."""
    outputs, inputs = found.linear.outputs, found.linear.inputs
    time, step = found.step_response()
    units = {name: found.units.get(name, "1") for name in (*outputs, *inputs)}

    def panel(i: int, j: int) -> Panel:
        value, low, high = (np.asarray(values)[:, i, j] for values in step)
        ends = (low, high) if np.isfinite(low).all() else (None, None)
        curve = Curve(outputs[i], time, value, PALETTE[i % 8], low=ends[0], high=ends[1])
        by = units[inputs[j]]
        title = f"{inputs[j]} + 1{'' if by == '1' else ' ' + difference_unit(by)}"
        label = with_unit(outputs[i], difference_unit(units[outputs[i]]))
        return Panel(label, (curve,), title if i == 0 else "", 1.3)

    rows = range(len(outputs))
    columns = tuple(tuple(panel(i, j) for i in rows) for j in range(len(inputs)))
    return Chart(columns, wide=max(3.2, 6.4 / len(inputs)))


def bode_chart(found: Dynamics) -> Chart:
    """Return magnitude and phase from each input, a column each, to every output, a line each."""
    outputs, inputs = found.linear.outputs, found.linear.inputs
    omega, magnitude, phase = found.frequency_response()
    least = 1e-4 * magnitude.value.max(axis=(0, 1))  # of each input: the scale has no zero
    turned = type(phase)(*(np.where(magnitude.value < least, np.nan, part) for part in phase))

    def curve(part: Estimate, i: int, j: int, floor: float) -> Curve:
        value, low, high = (ends[:, i, j] for ends in part)
        line = Curve(
            outputs[i], omega, np.where(value < floor, np.nan, value), PALETTE[i % 8], dash=DASHES[i % 4]
        )
        if not np.isfinite(high).any():
            return line
        visible = high >= floor
        low, high = np.where(visible, np.maximum(low, floor), np.nan), np.where(visible, high, np.nan)
        return replace(line, low=low, high=high)

    rows = range(len(outputs))
    columns = []
    for j, name in enumerate(inputs):
        sizes = tuple(curve(magnitude, i, j, float(least[j])) for i in rows)
        turns = tuple(curve(turned, i, j, -np.inf) for i in rows)
        above = Panel("magnitude", sizes, name, 1.5, log=True)
        columns.append((above, Panel("phase [deg]", turns, height=1.3)))
    return Chart(tuple(columns), "frequency [rad/s]", log=True, wide=max(3.2, 6.4 / len(inputs)))


def run_table(runs: Sequence[FreeRun]) -> Cells:
    """Return the scores of free runs beside their baselines (RMSE), a row a log and output."""
    head = ("log", "output", "RMSE", "unit", "fit [%]", "n", "no input", "mean", "one step")
    rows = []
    for run in runs:
        for output, score in run.scores.items():
            naive = (run.naive[kind][output].rmse for kind in ("no_input", "mean"))
            scores = (score.rmse, score.unit, score.fit_percent, score.n, *naive, run.one_step[output].rmse)
            rows.append((log_name(run.log), output, *scores))
    return head, tuple(rows)


def signal_table(found: Identification) -> Cells:
    """Return what each column of the logs was taken for, and whether that is a guess."""
    rows = ((s.name, s.unit, s.role, f"guess: {s.why}" if s.guessed else s.why) for s in found.signals)
    return ("column", "unit", "role", "why"), tuple(rows)


def held_out_table(errors: Sequence[Row]) -> Cells:
    """Return the errors of candidate models: a row a model, log and output; blocks of a log share one row."""
    groups: dict[tuple[str, str, str, bool], list[Row]] = {}
    for row in errors:
        log = "blocks" if re.fullmatch(r"block \d+ of \d+", row.log) else row.log
        groups.setdefault((row.model, log, row.output, row.held_out), []).append(row)
    out = []
    for (model, log, output, held_out), rows in groups.items():
        n = np.array([row.n for row in rows])
        rmse, idle = (
            float(np.sqrt(n @ np.square([getattr(row, name) for row in rows]) / n.sum()))
            for name in ("rmse", "no_input_rmse")
        )
        fit, first = float(np.mean([row.fit_percent for row in rows])), rows[0]
        title = log if len(rows) == 1 else f"{len(rows)} blocks: {', '.join(f'{r.rmse:.2g}' for r in rows)}"
        where = "held out" if held_out else "in the fit"
        out.append((model, title, output, rmse, first.unit, fit, int(n.sum()), idle, where))
    return ("model", "log", "output", "RMSE", "unit", "fit [%]", "n", "no input", ""), tuple(out)


def identification_section(found: Identification) -> Section:
    """Return the section of the model comparison: verdict, every model's free run, data check."""
    checks = [
        (f.verdict, f.check, f.log, f.channel, f.says) for f in found.data_check.findings if f.verdict != "ok"
    ]
    evidence: list[Any] = [
        Table(*held_out_table([row for row in found.rows if row.held_out]), _HELD_OUT),
        Table(*signal_table(found), "Columns of the logs"),
        Table(
            ("log", "output", "RMSE", "unit", "fit [%]", "n"),
            tuple(
                (r.log, r.output, r.rmse, r.unit, r.fit_percent, r.n) for r in found.rows if not r.held_out
            ),
            f"{found.model}, fitted on everything, on its own logs",
        ),
    ]
    if checks:
        evidence.append(Table(("verdict", "check", "log", "channel", "finding"), tuple(checks), "Data check"))
    evidence += [Text(_sentence(note)) for note in found.notes]
    tone = "good" if found.good else "warn"
    return Section("Which plant is behind the logs?", tuple(evidence), _sentence(found.verdict), tone)


def identification_sections(
    found: Identification,
    logs: Sequence[Log],
    plant: Plant,
    record: Posterior | None,
    dynamics: Dynamics | None = None,
) -> list[Section]:
    """Return the report of an identification: the model comparison, what was held out, parameters, responses,
    every log; ``plant`` is the chosen one, with samples where ``record`` says how they were drawn."""
    from thermogrip.sysid.validation.free_run import free_run

    sections = [identification_section(found)]
    if found.held_out_runs:
        sections.append(held_out_section(found))
    if plant.free:
        sections.append(parameters_section(plant, record))
    if dynamics is not None:
        sections.append(dynamics_section(dynamics))
    for log, known in zip(logs, found.runs):
        # those of the comparison again, now with residual tests and a band of this plant's draws
        run = free_run(plant, log, known.warmup)
        sections.append(free_run_section(run, seen=True))
    return sections


def held_out_section(found: Identification) -> Section:
    """Return the section of the kept model over what it was fitted without: measured beside free run."""
    runs = found.held_out_runs
    words = (
        ", ".join(f"{o} {s.rmse:.2g}{_spaced(s.unit)}" for o, s in r.scores.items()) for r in runs.values()
    )
    errors = "; ".join(f"{name}: {error}" for name, error in zip(runs, words))
    # without a band: of a fit that has not seen what it is to predict, draws may lie anywhere
    evidence = tuple(
        Plot(
            free_run_chart(run, tuple(run.scores)[k : k + 2]),
            f"{name}: {found.model} fitted without it, simulated from the inputs alone (dashed), over what "
            f"was measured. Readings of the first {run.warmup:.3g} s set the state. On grey: not scored.",
        )
        for name, run in runs.items()
        for k in range(0, len(run.scores), 2)
    )
    return Section("Does it predict what it has not seen?", evidence, f"RMSE of {errors}.", "plain")


def gain_table(found: Dynamics) -> Cells:
    """Return the gains at rest with their intervals, dead times and rise times: a row an input and output."""
    head = ("input", "output", "gain", "low", "high", "unit", "dead time [s]", "63 % after [s]")
    return head, tuple(tuple(row.values()) for row in found.rows())


def time_constant_words(found: Dynamics) -> str:
    """Return the operating point, the time constants and what the intervals are of, in a sentence."""
    linear = found.linear
    point = ", ".join(
        f"{name} {w:.3g}{_spaced(found.units.get(name, '1'))}" for name, w in zip(linear.inputs, linear.w)
    )
    slow = [(tau, s) for tau, s in zip(found.time_constants, found.poles) if s.imag >= 0]
    taus = ", ".join(
        f"{significant(tau, 3)} s"
        + (f" (period {significant(2 * np.pi / s.imag, 3)} s)" if s.imag > 1e-9 * abs(s) else "")
        for tau, s in slow[:_TIME_CONSTANTS]
    )
    taus += f" and {len(slow) - _TIME_CONSTANTS} faster" if len(slow) > _TIME_CONSTANTS else ""
    words = f"about {point}: time constants {taus or 'none'}"
    if np.isnan(found.gain.low).all():
        return f"{words}; no intervals, for the plant has no draws"
    words += f"; {100 * found.level:.0f} % intervals from {len(found.draws)} draws"
    if found.gain_sd.any():
        words += f" and a gain that varies by {100 * found.gain_sd.max():.0f} % from run to run"
    return words


def dynamics_section(found: Dynamics) -> Section:
    """Return the section of gains, step and frequency responses."""
    evidence = (
        Plot(
            step_response_chart(found),
            "Response of each output to a step of one unit of each input; shaded: the interval.",
        ),
        Table(*gain_table(found), "Gains in steady state, with intervals"),
        Plot(bode_chart(found), "Frequency response from each input; shaded: the interval."),
    )
    words = time_constant_words(found)
    return Section("How does the plant respond?", evidence, _sentence(words[0].upper() + words[1:]))


def _spaced(unit: str) -> str:
    return "" if unit == "1" else f" {unit}"


def parameters_section(plant: Plant, record: Posterior | None = None) -> Section:
    """Return the section of the free parameters: how well each is known, and the posterior of ``record``."""
    from thermogrip.sysid.greybox.identifiability import identifiability_report

    evidence: list[Any] = [Table(*parameter_table(plant, record), "Free parameters", dense=True)]
    verdict, *least = known_words(plant)
    evidence += [Text(words) for words in least]
    identifiability, tone = plant.scores.identifiability, "plain"
    if identifiability is not None and identifiability.flat:
        evidence.append(Text(f"These cannot be estimated separately: {'; '.join(identifiability.flat)}."))
        tone = "warn"
    if record is not None:
        chain, sampling = record.chain, record.sampling
        tone = tone if chain.converged else "warn"
        verdict += "" if chain.converged else f" The sampler has {sampling.verdict}."
        caption = f"{len(record.samples)} samples of what emcee moved, pair by pair; grey lines: the fit."
        evidence += [
            Picture(corner_figure(plant, record), caption),
            Text(_sentence(sampling.likelihood)),
            Text(
                f"emcee moved {', '.join(record.sampled)}, which have an effective number of samples (ESS); "
                "the others were integrated out and fitted to each sample. "
                f"{len(chain.steps)} steps, {sampling.verdict}, {100 * chain.acceptance:.0f} % accepted. "
                f"Medians lie within {record.off_centre:.2f} standard deviations of the fitted values."
            ),
        ]
    evidence += [Text(_sentence(said)) for said in identifiability_report(plant)]
    return Section("How well are its parameters known?", tuple(evidence), verdict, tone, shown=0)


def known_words(plant: Plant) -> list[str]:
    """Return in a sentence how well the free parameters are known by their 90 % intervals, and in
    another which are known least."""
    intervals = plant.intervals(0.9)
    if not intervals:
        return [f"{len(plant.free)} free parameters, without intervals."]
    off = {
        name: (high - low) / 2 / max(abs(plant.values[name]), 1e-300)
        for name, (low, high) in intervals.items()
    }
    within_tenth, half = (sum(width <= share for width in off.values()) for share in (0.1, 0.5))
    least = sorted(off, key=lambda name: -off[name])[:3]
    ends = ", ".join(
        f"{name} ({intervals[name][0]:.3g} to {intervals[name][1]:.3g}{_spaced(plant.units.get(name, '1'))})"
        for name in least
    )
    return [
        f"{within_tenth} of {len(off)} parameters are known within \N{PLUS-MINUS SIGN}10 %, {half} within "
        f"\N{PLUS-MINUS SIGN}50 % (90 % intervals).",
        f"Known least: {ends}.",
    ]


def parameter_table(plant: Plant, record: Posterior | None = None) -> Cells:
    """Return the free parameters with their 90 % intervals, and those of the prior; with ``record`` mean, sd
    and effective number of samples too."""
    intervals = plant.intervals(0.9)
    before = _prior_intervals(plant)
    nothing = (None, None)
    head = ["parameter", "value", "unit", "5 %", "95 %", "prior 5 %", "prior 95 %"]
    rows: list[list[Any]] = []
    for name in plant.free:
        ends = (*intervals.get(name, nothing), *before.get(name, nothing))
        rows.append([name, plant.values[name], plant.units.get(name, "1"), *ends])
    if record is not None:
        head[3:3], head[7:7] = ["mean", "sd"], ["ESS"]
        effective = dict(zip(record.sampled, record.chain.ess.tolist()))
        for k, row in enumerate(rows):
            draws = record.samples[:, k]
            row[3:3] = [float(draws.mean()), float(draws.std(ddof=1))]
            ess = effective.get(row[0])
            row[7:7] = [None if ess is None else round(ess)]
    return tuple(head), tuple(map(tuple, rows))


def _prior_intervals(plant: Plant) -> dict[str, tuple[float, float]]:
    """Return the prior's 90 % intervals by name; a black box has none."""
    from thermogrip.sysid.experiment.information import plant_from_prior
    from thermogrip.sysid.models.model import GreyModel

    if not hasattr(plant.model, "specs"):
        return {}
    return plant_from_prior(cast(GreyModel, plant.model)).intervals(0.9)


def free_run_section(
    run: FreeRun, band: Band | None = None, *, seen: bool = False, title: str = ""
) -> Section:
    """Return the section of a log: free run beside the measurement, scores, residual tests, notes; ``seen``
    says that the log was in the fit, ``title`` takes the place of the usual one."""
    # a caller that has printed the band has it already
    band = run.band() if band is None else band
    name = log_name(run.log)
    units = {output: "" if score.unit == "1" else f" {score.unit}" for output, score in run.scores.items()}
    words = (f"{output} to {score.rmse:.2g}{units[output]}" for output, score in run.scores.items())
    clauses = [f"Free run (RMSE): {', '.join(words)}"]
    if run.no_better:
        clauses.append(f"{', '.join(run.no_better)} no better than a model without input")
    if run.verdict is not None:
        clauses.append(str(run.verdict))
    outputs = tuple(run.scores)
    evidence: list[Any] = [
        *(
            Plot(
                free_run_chart(run, outputs[k : k + 2], band),
                f"{name}: measured, simulated from the inputs alone (dashed), and their difference. Readings "
                f"of the first {run.warmup:.3g} s set the state; nothing is fed back after that. Shaded: "
                f"{band_words(band)}. On grey: not scored.",
            )
            for k in range(0, len(outputs), 2)
        ),
        Table(*run_table([run]), _BASELINES),
    ]
    evidence += [Text(_sentence(note)) for note in run.notes if note != str(run.verdict)]
    title = title or f"Free run: {name}" + (" (in the fit)" if seen else "")
    if run.verdict is None:
        tone = "warn" if run.no_better else "good"
    elif run.verdict.cause == "seen":  # an answer neither for the plant nor against it
        tone = "warn" if run.no_better else "plain"
    else:
        tone = "good" if run.verdict.standing in ("as stated", "better") and not run.no_better else "warn"
    return Section(title, tuple(evidence), f"{'; '.join(clauses)}.", tone)


def band_words(band: Band) -> str:
    """Return what the shaded band is, and the share of the readings that it covers."""
    inside = ", ".join(f"{100 * share:.0f} % of {name}" for name, share in band.inside.items())
    draws = f"{band.draws} draws of the parameters and " if band.draws else ""
    words = f"{100 * band.level:.0f} % band from {draws}{band.own_error}; it covers {inside}"
    errors = ", ".join(
        f"{name} {band.expected[name]:.2g} ({low:.2g} to {high:.2g})"
        for name, (low, high) in band.likely.items()
    )
    return words + (f" and has an expected RMSE of {errors}" if errors else "")


def _sentence(text: str) -> str:
    return text + ("" if text.endswith(".") else ".")


def corner_figure(plant: Plant, record: Posterior) -> Figure:
    """Draw the samples of each pair of parameters that emcee moved, with marginals and the fitted values."""
    from matplotlib.figure import Figure

    names = record.sampled
    columns = record.samples[:, [record.free.index(name) for name in names]]
    n = len(names)
    # without pyplot: no window system is asked for, and nothing global is left behind
    figure = Figure(figsize=(1.7 * n + 0.6, 1.7 * n + 0.6), layout="constrained")
    axes = figure.subplots(n, n, squeeze=False)
    for i in range(n):
        for j in range(n):
            _corner_panel(axes[i, j], columns, names, plant, i, j)
    return figure


def _corner_panel(ax: Any, columns: Array, names: Sequence[str], plant: Plant, i: int, j: int) -> None:
    """Draw row i, column j of the corner figure."""
    if j > i:
        ax.set_axis_off()
        return
    ax.tick_params(labelsize=6)
    ax.locator_params(axis="x", nbins=3)
    ax.axvline(plant.values[names[j]], color="0.6", lw=0.8)
    if i == j:
        ax.hist(columns[:, i], bins=25, color="tab:blue", alpha=0.6)
        for edge in np.quantile(columns[:, i], (0.05, 0.95)).tolist():
            ax.axvline(edge, color="tab:blue", lw=0.8, ls="--")
        ax.set_yticks([])
    else:
        # a ridge where two parameters trade off: neither is known well, a combination is
        ax.plot(columns[:, j], columns[:, i], ".", ms=1.5, alpha=0.4, rasterized=True)  # of thousands
        ax.axhline(plant.values[names[i]], color="0.6", lw=0.8)
        ax.tick_params(labelleft=j == 0)  # a row shares its scale
    if i == len(names) - 1:
        ax.set_xlabel(f"{names[j]} [{plant.units.get(names[j], '1')}]", fontsize=7)
    if j == 0 and i > 0:
        ax.set_ylabel(f"{names[i]} [{plant.units.get(names[i], '1')}]", fontsize=7)
