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

    from thermogrip.classify.estimators.bayes import BayesClassifier
    from thermogrip.classify.evaluation.comparison import Comparison
    from thermogrip.datasets.schema import Grasps
    from thermogrip.mpc.tuning.design_review import Check
    from thermogrip.rig.session.session import Session

_SCORES: Columns = (
    ("classifier", lambda row: row["classifier"]),
    ("condition", lambda row: row["condition"]),
    ("n", lambda row: _of_tested(row)),
    ("accuracy", lambda row: _between(row["accuracy"], row["low"], row["high"])),
    ("caution", lambda row: row["caution"]),
    ("log loss", lambda row: _between(row["log_loss"], row["log_loss_low"], row["log_loss_high"])),
    ("by chance", lambda row: f"{row['log_loss_chance']:.2f}"),
    ("by base rates", lambda row: f"{row['log_loss_base']:.2f}"),
    ("Brier", lambda row: _between(row["brier"], row["brier_low"], row["brier_high"])),
    ("ECE", lambda row: _between(row["ece"], row["ece_low"], row["ece_high"])),
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
    parts: list[Any] = [Plot(chart, "The first session: settle, stop the pump, grasp."), Table(head, rows)]
    parts += [Text(f"{title}: {s.advice}") for title, s in sessions if s.advice]
    return Section("Does it settle and grasp?", tuple(parts), verdict, "warn" if failed else "good")


def touch_section(
    touched: Sequence[Grasps], rows: Sequence[dict[str, Any]], taught: Sequence[str]
) -> Section:
    """Return the section of the twin's grasps: the traces, and what a classifier that was ``taught`` some
    materials says of them."""
    if not rows:
        return Section("What did it touch?", (), "Nothing: no session came to a grasp.", "warn")
    known = [row for row in rows if row["true"] in taught]
    others = [row for row in rows if row["true"] not in taught]
    right = sum(row["material"] == row["true"] for row in known)
    noticed = sum(_unknown(row) for row in others)
    verdict = f"{right} of {len(known)} blocks of {', '.join(taught)} are named right"
    if others:
        names = ", ".join(dict.fromkeys(row["true"] for row in others))
        verdict += f"; {noticed} of {len(others)} that was not taught ({names}) is called unknown"
    named = [key for key in rows[0] if key.startswith("p_")]
    head = ("true", "answer", *(key.removeprefix("p_") for key in named), "decided at [s]")
    shares = [[None if row[key] is None else round(row[key], 4) for key in named] for row in rows]
    table = tuple((r["true"], r["material"], *of, r["decided_at_s"]) for r, of in zip(rows, shares))
    parts: list[Any] = [
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
    wrong = right < len(known) or noticed < len(others) or any(_unknown(row) for row in known)
    return Section("What did it touch?", tuple(parts), f"{verdict}.", "warn" if wrong else "good")


def _unknown(row: Mapping[str, Any]) -> bool:
    """Return whether an answer says that the block is more likely none of the candidates."""
    return bool((row["p_unknown"] or 0.0) > 0.5)


def review_section(checks: Sequence[Check]) -> Section:
    """Return the section of a design review."""
    failed = [check.name for check in checks if check.verdict == "fail"]
    warned = [check.name for check in checks if check.verdict == "warn"]
    idle = [check.name for check in checks if check.verdict not in ("pass", "warn", "fail")]
    passed = len(checks) - len(failed) - len(warned) - len(idle)
    worse = {"failed": failed, "with a warning": warned, "not tried": idle}
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
    parts: list[Any] = [
        Picture(accuracy_figure(comparison), f"By condition.{_below(scores)} {comparison.interval_note}"),
        Table(
            *score_table(comparison),
            f"All scores, each with its {100 * comparison.level:.0f} % interval; n distinct grasps",
            dense=True,
        ),
        Text(ECE_TEXT),
        Picture(confusion_figure(comparison, shown), _confusion_caption(comparison, shown)),
        Picture(
            reliability_figure(comparison, shown),
            f"Confidence beside accuracy, {shown}, in bins of 0.1 with 95 % intervals; below, grasps a bin.",
        ),
    ]
    if comparison.leaks and not any(row["leak"] for row in comparison.leaks):
        parts.append(Text("Leak probe: from samples before contact no classifier beats chance."))
    if comparison.notes:
        parts.append(Text("Notes: " + "; ".join(comparison.notes) + "."))
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
        parts.insert(1, Text(others))
    verdict = " ".join([*cautions, best])
    return [Section(title, tuple(parts), verdict, "warn" if cautions else "plain")]


def _below(scores: Sequence[Mapping[str, Any]]) -> str:
    """Say why some conditions stand below a line, where some do."""
    pooled = any(row["apart"] for row in scores) and not all(row["apart"] for row in scores)
    return " Below the line: touched twice or of unknown temperature, not in the pool." if pooled else ""


def _confusion_caption(comparison: Comparison, shown: str) -> str:
    """Return what the numbers of the confusions count."""
    counted = "grasps" if comparison.repeats == 1 else f"grasps a split, mean of {comparison.repeats}"
    return f"Confusion, {shown}: rows true, columns predicted; {counted}. Shade: share of the row."


def score_table(comparison: Comparison) -> Cells:
    """Return all scores, each with its interval, and what to read each with where there is anything."""
    rows = comparison.scores()
    shown = [column for column in _SCORES if column[0] != "caution" or any(row["caution"] for row in rows)]
    return cells(shown, rows)


def _of_test(row: Mapping[str, Any]) -> str:
    return f" of {row['n_test']} in the test" if row["n_test"] > row["n"] else ""


def _of_tested(row: Mapping[str, Any]) -> int | str:
    """Return how many grasps were scored, of how many tested where some were not."""
    return f"{row['n']}/{row['n_test']}" if row["n_test"] > row["n"] else int(row["n"])


def _between(value: float, low: float | None, high: float | None) -> str:
    """Return a score with its interval, as narrow as three digits allow, where it has one."""
    if low is None or high is None:
        return f"{value:.3f}"
    low_text, high_text = (f"{end:.2f}".removeprefix("0") for end in (low, high))
    return f"{value:.3f} ({low_text}\N{EN DASH}{high_text})"


def curves_section(curves: Mapping[str, Sequence[dict[str, Any]]]) -> Section:
    """Return the section of what more grasps, more time or another temperature would bring, from rows by what
    they run over: ``train_per_class``, ``contact_s``, ``difference_K``."""
    from thermogrip.classify.figures import curve_figure

    captions = {
        "train_per_class": "Learning curve: random splits, all conditions pooled.",
        "contact_s": "Contact time: training and test grasps are cut alike.",
        "difference_K": "Temperature difference: a point a condition; more materials are harder.",
    }
    parts = tuple(
        Picture(curve_figure(rows, over), captions[over] + _off_the_page(rows))
        for over, rows in curves.items()
        if len({row[over] for row in rows}) > 1  # one point is no curve
    )
    gains = [_gain(over, rows) for over, rows in curves.items() if over != "difference_K" and rows]
    return Section("What would help?", parts, " ".join(gains), "plain")


def _off_the_page(rows: Sequence[Mapping[str, Any]]) -> str:
    """Say which classifiers have a log loss above twice that of chance, where the picture ends."""
    limit = 2 * max(row["log_loss_chance"] for row in rows)
    beyond = dict.fromkeys(str(row["classifier"]) for row in rows if row["log_loss"] > limit)
    return f" Off the page, above twice chance: {', '.join(beyond)}." if beyond else ""


def _gain(over: str, rows: Sequence[dict[str, Any]]) -> str:
    """Return how the log loss of the best classifier changes from one end of a curve to the other."""
    places = sorted({row[over] for row in rows})
    last = min((row for row in rows if row[over] == places[-1]), key=lambda row: row["log_loss"])
    first = next(r for r in rows if r[over] == places[0] and r["classifier"] == last["classifier"])
    unit = {"train_per_class": "training grasps a material", "contact_s": "s of contact"}[over]
    return (
        f"From {places[0]:g} to {places[-1]:g} {unit} the log loss of {last['classifier']} goes from "
        f"{first['log_loss']:.2f} to {last['log_loss']:.2f}."
    )


def strips_section(rows: Sequence[Any], materials: Sequence[str]) -> Section:
    """Return the section of effusivity posteriors: a strip a test grasp in front of the library's lines;
    ``materials`` is what each grasp really was."""
    from thermogrip.classify.figures import effusivity_figure
    from thermogrip.datasets.materials import find_material

    known = {name: find_material(name) for name in dict.fromkeys(materials)}
    library = {name: material.effusivity for name, material in known.items()}
    spread = sorted(100 * material.effusivity_sd_ln for material in known.values())
    order = sorted(range(len(rows)), key=lambda k: (library[materials[k]], rows[k].grasp_id))
    figure = effusivity_figure([rows[k] for k in order], library, materials=[materials[k] for k in order])
    inside = sum(r.effusivity_p05 <= library[m] <= r.effusivity_p95 for r, m in zip(rows, materials))
    verdict = (
        f"Without knowledge of the material, {inside} of {len(rows)} test grasps have the library's value in "
        f"their 90 % interval; the library's own rows are uncertain by {spread[0]:.0f} to {spread[-1]:.0f} %."
    )
    return Section("What effusivity?", (Picture(figure, "Posterior strips of the test grasps."),), verdict)


def effusivity_section(rows: Sequence[tuple[Mapping[str, Any], str]], of: int) -> Section:
    """Return the section of what ``effusivity`` found: each grasp's numbers with what was not explained
    of it, strips of those that have an answer; ``of`` counts all grasps."""
    import math

    from thermogrip.classify.figures import effusivity_figure
    from thermogrip.datasets.materials import find_material
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
    parts: list[Any] = []
    if answered:
        strips = [EffusivityRow(**{k: v for k, v in row.items() if k != "misfit_sd"}) for row in answered]
        library = {name: find_material(name).effusivity for name in _WELL_KNOWN}
        caption = "Posterior of each grasp, median and 90 % interval; lines: a few of `thermogrip materials`."
        parts.append(Picture(effusivity_figure(strips, library), caption))
    caption = "Effusivity in W s^0.5 m^-2 K^-1, with 90 % intervals"
    parts.append(Table(head, tuple(cells), caption, dense=True))
    good = len(answered) == len(rows) and not strange
    return Section("What effusivity?", tuple(parts), verdict, "good" if good else "warn")


def feature_section(model: BayesClassifier, records: Sequence[Grasps]) -> Section:
    """Return the section of what ``bayes`` looks at: the features of the grasps that it was fitted to, their
    densities, and which materials are hard to tell apart at which difference."""
    import numpy as np

    from thermogrip.classify.figures import feature_figure

    parts = [model.reader_.read(record) for record in records]
    read = type(parts[0])(**{k: np.concatenate([getattr(p, k) for p in parts]) for k in vars(parts[0])})
    labels = np.concatenate([record["material"].values.astype(str) for record in records])
    names, noise = [str(c) for c in model.classes_], read.noise.mean(axis=0)
    gaps = (5.0, 10.0, 20.0) if model.reader_.normalise else (1.0,)
    apart = [model.separation(noise, gap) for gap in gaps]
    pairs = [(i, k) for i in range(len(names)) for k in range(i)]
    order = sorted(pairs, key=lambda pair: float(apart[-1][pair]))
    head = ("materials", *((f"at {g:g} K" for g in gaps) if model.reader_.normalise else ("apart",)))
    rows = tuple(
        (f"{names[k]}, {names[i]}", *(round(float(a[i, k]), 1) for a in apart)) for i, k in order[:8]
    )
    i, k = order[0]
    verdict = (
        f"{names[k]} and {names[i]} are the hardest to tell apart: {apart[-1][i, k]:.1f} standard deviations"
        + (f" at {gaps[-1]:g} K, {apart[0][i, k]:.1f} at {gaps[0]:g} K." if len(gaps) > 1 else ".")
    )
    caption = (
        "Changes after contact, over the difference of object and skin where it is known, and the slope from "
        "5 s to 10 s. Above, the density under each material; below, the grasps with the sd of their noise."
    )
    table = Table(head, rows, "Standard deviations between two materials, by difference of temperature")
    figure = feature_figure(model, read, labels)
    return Section("What does bayes look at?", (Picture(figure, caption), table), verdict, "plain")


def _who_wins(comparison: Comparison, condition: str) -> tuple[str, str]:
    """Return who is best on the pooled grasps in a sentence; in others how the next ones do, and what n lets
    one say about them."""
    rows = sorted(
        (row for row in comparison.scores() if row["condition"] == condition), key=lambda row: row["log_loss"]
    )
    best = rows[0]
    said = (
        f"{best['classifier']} has the lowest log loss ({best['log_loss']:.2f}; chance "
        f"{best['log_loss_chance']:.2f}) and {100 * best['accuracy']:.0f} % right of n = {best['n']} grasps"
        f"{_of_test(best)} ({100 * best['low']:.0f} to {100 * best['high']:.0f} %)."
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
    return said, " ".join(others)
