"""Sections of the page that the verbs and the demo share, one function a result.

Each function takes one room's result and returns sections whose verdict is a sentence.  Numbers come from the
result alone; nothing is computed here but the choice of words.  Plants have
:mod:`thermogrip.report.plant`, controllers :mod:`thermogrip.report.control`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from thermogrip.report.console import Cells, Columns, cells
from thermogrip.report.html import Picture, Plot, Section, Table, Text
from thermogrip.report.plots import grasps_chart, loops_chart

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from thermogrip.classify.evaluation.comparison import Comparison
    from thermogrip.datasets.schema import Grasps
    from thermogrip.mpc.tuning.design_review import Check
    from thermogrip.rig.session.session import Session

_SCORES: Columns = (
    ("classifier", lambda row: row["classifier"]),
    ("condition", lambda row: row["condition"]),
    ("n", lambda row: f"{row['n']}/{row['n_test']}" if row["n_test"] > row["n"] else int(row["n"])),
    ("accuracy", lambda row: _with_interval(row["accuracy"], row["low"], row["high"])),
    ("caution", lambda row: row["caution"]),
    ("log loss", lambda row: _with_interval(row["log_loss"], row["log_loss_low"], row["log_loss_high"])),
    ("by chance", lambda row: f"{row['log_loss_chance']:.2f}"),
    ("by base rates", lambda row: f"{row['log_loss_base']:.2f}"),
    ("Brier", lambda row: _with_interval(row["brier"], row["brier_low"], row["brier_high"])),
    ("ECE", lambda row: _with_interval(row["ece"], row["ece_low"], row["ece_high"])),
    ("if calibrated", lambda row: f"{row['ece_calibrated']:.3f}"),
    ("fit [s]", lambda row: f"{row['fit_s']:.2f}"),
)

#: Materials whose effusivity a reader may compare with, from low to high.
_WELL_KNOWN = ("aerated concrete", "wood", "silicone", "glass", "granite", "titanium", "iron", "copper")

ECE_TEXT = (
    "ECE is the mean gap between confidence and accuracy over bins of 0.1. Few grasps raise it: a perfectly "
    "calibrated classifier of the same confidences would show what is under 'if calibrated'. "
    "Where no grasp was wrong, the interval of the log loss knows of no mistake; that of the accuracy does."
)


def session_section(sessions: Sequence[tuple[str, Session]], rig: str) -> Section:
    """Return the section of sessions on a rig: how each settled, temperatures and drive."""
    rows = tuple((title, s.verdict, s.settle_time, s.overshoot, s.bias) for title, s in sessions)
    head = ("session", "verdict", "settled after [s]", "overshoot [K]", "bias [K]")
    title, first = sessions[0]
    chart = loops_chart({title: first.log}, {title: float(first.log["target_t_surface"].values[0])})
    failed = [title for title, s in sessions if s.verdict != "settled"]
    verdict = f"{len(sessions) - len(failed)} of {len(sessions)} sessions settled on {rig}."
    contents: list[Any] = [Plot(chart, "The first session: settle, stop the pump, grasp."), Table(head, rows)]
    contents += [Text(f"{title}: {s.advice}") for title, s in sessions if s.advice]
    return Section("Does it settle and grasp?", tuple(contents), verdict, "warn" if failed else "good")


def touch_section(
    touched: Sequence[Grasps], rows: Sequence[dict[str, Any]], taught: Sequence[str]
) -> Section:
    """Return the section of the twin's grasps: the traces, and what a classifier that was ``taught`` some
    materials says of them."""
    if not rows:
        return Section("What did it touch?", (), "Nothing: no session came to a grasp.", "warn")
    taught_rows = [row for row in rows if row["true"] in taught]
    others = [row for row in rows if row["true"] not in taught]
    right = sum(row["material"] == row["true"] for row in taught_rows)
    noticed = sum(_unknown(row) for row in others)
    verdict = f"{right} of {len(taught_rows)} blocks of {', '.join(taught)} are named right"
    if others:
        names = ", ".join(dict.fromkeys(row["true"] for row in others))
        verdict += f"; {noticed} of {len(others)} that was not taught ({names}) is called unknown"
    named = [key for key in rows[0] if key.startswith("p_")]
    head = ("true", "answer", *(key.removeprefix("p_") for key in named), "decided at [s]")
    shares = [[None if row[key] is None else round(row[key], 4) for key in named] for row in rows]
    table = tuple((r["true"], r["material"], *of, r["decided_at_s"]) for r, of in zip(rows, shares))
    contents: list[Any] = [
        Plot(grasps_chart({"": touched}), "The grasps as recorded; dotted: the gripper's message."),
        Table(head, table, "Posterior classifier, trained on the bundled training grasps"),
        *(Text(f"{row['true'].capitalize()}: {row['why']}.") for row in rows if row.get("why")),
        Text(
            "Unknown is the probability that the block is none of the candidates; it is beside "
            "them, not in their sum; sd counts the spreads of the training grasps. The twin draws what no "
            "two grasps share, such as how far a block is from its nominal temperature. One grasp a material "
            "shows that the stages fit together, not how often they are right."
        ),
    ]
    wrong = right < len(taught_rows) or noticed < len(others) or any(_unknown(row) for row in taught_rows)
    return Section("What did it touch?", tuple(contents), f"{verdict}.", "warn" if wrong else "good")


def _unknown(row: Mapping[str, Any]) -> bool:
    """Return whether an answer says that the block is more likely none of the candidates."""
    return bool((row["p_unknown"] or 0.0) > 0.5)


def review_section(checks: Sequence[Check]) -> Section:
    """Return the section of a design review."""
    failed = [check.name for check in checks if check.verdict == "fail"]
    warned = [check.name for check in checks if check.verdict == "warn"]
    passed = len(checks) - len(failed) - len(warned)
    worse = {"failed": failed, "with a warning": warned}
    others = "; ".join(f"{words}: {', '.join(names)}" for words, names in worse.items() if names)
    verdict = f"{passed} of {len(checks)} checks pass" + (f" ({others})." if others else ".")
    rows = tuple((check.name, check.verdict, check.finding, check.fix) for check in checks)
    tone = "bad" if failed else "warn" if warned else "good"
    return Section(
        "Is the design sound?", (Table(("check", "verdict", "finding", "fix"), rows),), verdict, tone
    )


def comparison_sections(name: str, comparison: Comparison) -> list[Section]:
    """Return the section of one kind of split (``shipped``, ``random``, ``files``, ``session`` or ``block``):
    accuracies with n, confusions, calibration."""
    from thermogrip.classify.evaluation.comparison import POOLED
    from thermogrip.classify.figures import accuracy_figure, confusion_figure, reliability_figure

    scores = comparison.scores()
    groups = [row["condition"] for row in scores]
    shown = POOLED if POOLED in groups else groups[0]
    counted = "grasps" if comparison.repeats == 1 else f"grasps a split, mean of {comparison.repeats}"
    contents: list[Any] = [
        Picture(accuracy_figure(comparison), f"By condition.{_below(scores)} {comparison.interval_note}"),
        Table(
            *score_table(comparison),
            f"All scores, each with its {100 * comparison.level:.0f} % interval; n distinct grasps",
            dense=True,
        ),
        Text(ECE_TEXT),
        Picture(
            confusion_figure(comparison, shown),
            f"Confusion, {shown}: rows true, columns predicted; {counted}. Shade: share of the row.",
        ),
        Picture(
            reliability_figure(comparison, shown),
            f"Confidence beside accuracy, {shown}, in bins of 0.1 with 95 % intervals; below, grasps a bin.",
        ),
    ]
    if comparison.leaks and not any(row["leak"] for row in comparison.leaks):
        contents.append(Text("Leak probe: from samples before contact no classifier beats chance."))
    if comparison.notes:
        contents.append(Text("Notes: " + "; ".join(comparison.notes) + "."))
    kind = {
        "shipped": "Shipped split",
        "random": "Random splits",
        "files": "Other files",
        "session": "Sessions held out",
        "block": "Blocks held out",
    }
    title = "Which material?" + (f" {kind[name]}" if name in kind else "")
    cautions = [f"{line}." for line in comparison.caution_lines()]
    best, others = _who_wins(comparison, shown)
    if others:
        contents.insert(1, Text(others))
    verdict = " ".join([*cautions, best])
    return [Section(title, tuple(contents), verdict, "warn" if cautions else "plain")]


def _below(scores: Sequence[Mapping[str, Any]]) -> str:
    """Say why some conditions stand below a line, where some do."""
    pooled = any(row["apart"] for row in scores) and not all(row["apart"] for row in scores)
    return " Below the line: touched twice or of unknown temperature, not in the pool." if pooled else ""


def score_table(comparison: Comparison) -> Cells:
    """Return all scores, each with its interval, and what to read each with where there is anything."""
    rows = comparison.scores()
    shown = [column for column in _SCORES if column[0] != "caution" or any(row["caution"] for row in rows)]
    return cells(shown, rows)


def _with_interval(value: float, low: float | None, high: float | None) -> str:
    """Return a score with its interval, as narrow as three digits allow, where it has one."""
    if low is None or high is None:
        return f"{value:.3f}"
    low_text, high_text = (f"{end:.2f}".removeprefix("0") for end in (low, high))
    return f"{value:.3f} ({low_text}\N{EN DASH}{high_text})"


def effusivity_section(rows: Sequence[tuple[Mapping[str, Any], str]], of: int) -> Section:
    """Return the section of what ``effusivity`` found: each grasp's numbers with what was not explained
    of it, strips of those that have an answer; ``of`` counts all grasps."""
    import math

    from thermogrip.classify.figures import effusivity_figure
    from thermogrip.sysid.contact.materials import find_material
    from thermogrip.sysid.effusivity import EffusivityRow

    head = ("grasp", "effusivity", "5 %", "95 %", "object [degC]", "5 %", "95 %", "h_c [W m^-2 K^-1]", "note")
    keys = ["grasp_id", "effusivity", "effusivity_p05", "effusivity_p95"]
    keys += ["t_object", "t_object_p05", "t_object_p95", "h_c"]
    answered = [row for row, _ in rows if math.isfinite(row["effusivity"])]
    cells = []
    for row, why in rows:
        note = why or ("" if math.isfinite(row["effusivity"]) else "no contact, or no answer")
        cells.append((*(None if row[key] != row[key] else row[key] for key in keys), note))
    strange = sum(bool(why) for _, why in rows)
    verdict = f"{len(answered)} of {len(rows)} grasps have an effusivity."
    verdict += f" The model does not explain {strange} of them." if strange else ""
    verdict += f" The first {len(rows)} of {of} are shown." if of > len(rows) else ""
    contents: list[Any] = []
    if answered:
        strips = [EffusivityRow(**{k: v for k, v in row.items() if k != "misfit_sd"}) for row in answered]
        library = {name: find_material(name).effusivity for name in _WELL_KNOWN}
        caption = "Posterior of each grasp, median and 90 % interval; lines: some known materials."
        contents.append(Picture(effusivity_figure(strips, library), caption))
    caption = "Effusivity in W s^0.5 m^-2 K^-1, with 90 % intervals"
    contents.append(Table(head, tuple(cells), caption, dense=True))
    good = len(answered) == len(rows) and not strange
    return Section("What effusivity?", tuple(contents), verdict, "good" if good else "warn")


def _who_wins(comparison: Comparison, condition: str) -> tuple[str, str]:
    """Return who is best on the pooled grasps in a sentence; in others how the next ones do, and what n lets
    one say about them."""
    rows = sorted(
        (row for row in comparison.scores() if row["condition"] == condition), key=lambda row: row["log_loss"]
    )
    best = rows[0]
    tested = f" of {best['n_test']} in the test" if best["n_test"] > best["n"] else ""
    verdict = (
        f"{best['classifier']} has the lowest log loss ({best['log_loss']:.2f}; chance "
        f"{best['log_loss_chance']:.2f}) and {100 * best['accuracy']:.0f} % right of n = {best['n']} grasps"
        f"{tested} ({100 * best['low']:.0f} to {100 * best['high']:.0f} %)."
    )
    others = [
        f"{row['classifier']}: {100 * row['accuracy']:.0f} %, log loss {row['log_loss']:.2f}."
        for row in rows[1:]
    ]
    close = [
        d
        for d in comparison.differences(condition)
        if best["classifier"] in (d["first"], d["second"]) and d["p_value"] > 0.05
    ]
    if close:
        names = ", ".join(d["second"] if d["first"] == best["classifier"] else d["first"] for d in close)
        others.append(f"In accuracy n does not separate {best['classifier']} from {names}.")
    return verdict, " ".join(others)
