"""Pages say what the numbers behind them say: verdicts, tones, units and tables of results made by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from thermogrip.datasets.schema import make_log
from thermogrip.mpc.closed_loop.simulate import ClosedLoop, Segment
from thermogrip.report import classification, control, plant
from thermogrip.report.html import Table, Text

NAN, INF = float("nan"), float("inf")


@pytest.fixture(autouse=True)
def _no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures have tests of their own."""
    for name in (
        "decision_figure",
        "effusivity_figure",
        "curve_figure",
    ):
        monkeypatch.setattr(f"thermogrip.classify.figures.{name}", lambda *_, **__: Figure())
    for name in ("closed_loop_figure", "step_time_figure", "pareto_figure", "grasp_figure"):
        monkeypatch.setattr(control, name, lambda *_, **__: Figure())
    monkeypatch.setattr(classification, "loop_figure", lambda *_, **__: Figure())


@pytest.mark.parametrize(
    ("verdicts", "said", "tone"),
    [
        ("pass pass", "2 of 2 checks pass.", "good"),
        ("pass warn pass", "2 of 3 checks pass. Warnings: c1.", "warn"),
        ("fail warn fail", "0 of 3 checks pass. Warnings: c1. Failed: c0, c2.", "bad"),
    ],
)
def test_a_review_counts_what_passes_and_names_the_rest(verdicts: str, said: str, tone: str) -> None:
    checks = [
        SimpleNamespace(name=f"c{k}", verdict=verdict, finding=f"f{k}", fix="")
        for k, verdict in enumerate(verdicts.split())
    ]
    section = classification.review_section(checks)
    assert (section.verdict, section.tone) == (said, tone)
    assert section.parts[0].rows[0] == ("c0", verdicts.split()[0], "f0", "")


def test_sessions_that_did_not_settle_are_counted_and_their_advice_shown() -> None:
    log = make_log([0.0, 1.0], {"target_t_surface": ([38.0, 38.0], "degC", "other")})
    rest = {"log": log, "settle_time": 9.0, "overshoot": 0.1, "bias": 0.02}
    runs = [
        ("first", SimpleNamespace(verdict="settled", advice="", **rest)),
        ("second", SimpleNamespace(verdict="tripped", advice="look at the pump", **rest)),
    ]
    section = classification.session_section(runs, "the twin")
    assert (section.verdict, section.tone) == ("1 of 2 sessions settled on the twin.", "warn")
    assert section.parts[0].rows[1] == ("second", "tripped", 9.0, 0.1, 0.02)
    assert [part for part in section.parts if isinstance(part, Text)] == [Text("second: look at the pump")]
    assert classification.session_section(runs[:1], "the twin").tone == "good"


@pytest.mark.parametrize(
    ("ends", "said"),
    [((0.25, 0.75), "0.500 (.25\N{EN DASH}.75)"), ((0.5, 1.0), "0.500 (.50\N{EN DASH}1.00)")],
)
def test_a_score_stands_with_both_ends_or_alone(ends: tuple[float, float], said: str) -> None:
    assert classification._between(0.5, *ends) == said
    assert classification._between(0.5, None, None) == "0.500"


DECIDED = {
    "classifier": "slow", "condition": "all", "n": 20, "time": 4.0, "time_low": 3.0, "time_high": 5.26,
    "end": 10.0,
    "accuracy": 0.9, "low": 0.68, "high": 0.988, "accuracy_at_end": 0.95, "early": 0.8, "error": 0.05,
    "wrong_early": 0.1, "wrong_early_low": 0.01, "wrong_early_high": 0.32, "expected_early": 0.04,
}  # fmt: skip


def test_the_fastest_classifier_is_reported_with_what_its_short_contacts_cost() -> None:
    single = DECIDED | {"classifier": "quick", "n": 1, "time": 2.04, "wrong_early": None}
    found = SimpleNamespace(table=lambda: [DECIDED, single, single | {"time": 1.0}], notes=("one was cut",))
    section = classification.decision_section(found)
    assert section.verdict == (
        "quick ends contacts after 2.0 s of 10 s on average and names 90 % of n = 1 right then (68 to 99 %), "
        "95 % at the end of contact."
    )
    [table] = [part for part in section.parts if isinstance(part, Table)]
    slow, quick = table.rows[:2]
    dash = "\N{EN DASH}"
    assert slow[3:5] == (f"4.00 (3.0{dash}5.3)", "10")
    assert slow[7:] == ("80 %", f"10 % (1{dash}32)", "4 %", "5 %")
    assert (quick[3], *quick[8:10]) == ("2.04", "-", "-")
    assert Text("Notes: one was cut.") in section.parts


def test_more_grasps_are_worth_what_the_best_of_the_most_gains() -> None:
    row = {"accuracy": 0.5, "low": 0.4, "high": 0.6, "log_loss_chance": 1.1}
    learning = [
        row | {"classifier": name, "train_per_class": n, "log_loss": loss}
        for name, n, loss in (("a", 5, 0.5), ("a", 2, 2.3), ("a", 3, 0.1), ("b", 2, 0.6), ("b", 5, 0.4))
    ]
    timed = [row | {"classifier": "a", "contact_s": s, "log_loss": 1 / s} for s in (1.0, 2.0, 10.0)]
    far = [row | {"classifier": "a", "difference_K": 5.0, "log_loss": 0.3}]
    section = classification.curves_section(
        {"train_per_class": learning, "contact_s": timed, "difference_K": far}
    )
    assert section.verdict == (
        "From 2 to 5 training grasps a material the log loss of b goes from 0.60 to 0.40. "
        "From 1 to 10 s of contact the log loss of a goes from 1.00 to 0.10."
    )
    assert len(section.parts) == 3


def test_effusivities_inside_their_interval_are_counted_in_the_order_of_the_library() -> None:
    drawn: list[Any] = []
    rows = [
        SimpleNamespace(grasp_id=name, effusivity_p05=low, effusivity_p95=high)
        for name, low, high in (("w", 100.0, 1e3), ("c", 1e4, 1e5), ("i", 1.0, 2.0))
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "thermogrip.classify.figures.effusivity_figure",
            lambda rows, library, materials: (drawn.extend(materials), Figure())[1],
        )
        section = classification.strips_section(rows, ["wood", "copper", "iron"])
    assert drawn == ["wood", "iron", "copper"]
    assert "2 of 3 test grasps have the library's value" in section.verdict


@pytest.mark.parametrize(
    ("p_value", "more"), [(0.2, " In accuracy n does not separate it from b."), (0.01, "")]
)
def test_who_wins_has_the_least_log_loss_and_is_set_apart_only_where_n_can(p_value: float, more: str) -> None:
    score = {"condition": "pooled", "log_loss_chance": 1.1, "n": 20, "low": 0.683, "high": 0.988}
    scores = [
        score | {"classifier": "b", "log_loss": 0.5, "accuracy": 0.85},
        score | {"classifier": "a", "log_loss": 0.25, "accuracy": 0.9},
        score | {"classifier": "c", "log_loss": 0.1, "accuracy": 1.0, "condition": "other"},
    ]
    pairs = [
        {"first": "b", "second": "a", "p_value": p_value},
        {"first": "b", "second": "c", "p_value": 0.9},
    ]
    found = SimpleNamespace(scores=lambda: scores, differences=lambda condition: pairs)
    assert classification._who_wins(found, "pooled") == (
        "a has the lowest log loss (0.25; chance 1.10) and 90 % right of n = 20 grasps (68 to 99 %). "
        f"b: 85 %, log loss 0.50.{more}"
    )


@pytest.mark.parametrize(
    ("seconds", "said", "tone"),
    [
        ([0.001, 0.0123], "The slowest of 2 steps took 12 ms of the 0.5 s it had.", "good"),
        ([0.5, 0.1], "The slowest of 2 steps took 5e+02 ms of the 0.5 s it had.", "good"),
        ([0.6, 0.1, 0.7], "2 of 3 steps took longer than their deadline of 0.5 s.", "warn"),
    ],
)
def test_steps_are_late_only_beyond_their_deadline(seconds: list[float], said: str, tone: str) -> None:
    section = control.timing_section(seconds, SimpleNamespace(deadline_s=0.5, dt=2.0))
    assert (section.verdict, section.tone) == (said, tone)


@pytest.mark.parametrize(
    ("front", "said"),
    [
        (
            [("A", 50.0, 20.0), ("B", 80.0, 15.0), ("C", 60.0, 18.0)],
            "B takes 80 s instead of 50 s and 25 % less",
        ),
        ([("A", 50.0, 20.0), ("B", 80.0, 19.6)], "Nothing: the fastest design (50 s) is as frugal as any."),
        ([("A", 50.0, 20.0)], "Nothing: the fastest design (50 s) is as frugal as any."),
        ([], "No design settled on all draws."),
    ],
)
def test_speed_is_traded_for_energy_along_the_front_of_the_mpc_alone(
    front: list[tuple[str, float, float]], said: str
) -> None:
    rows = [
        {"name": name, "settle_s": settle, "energy_s": energy, "best": True, "controller": "MPC"}
        for name, settle, energy in front
    ]
    others = [
        {"name": "x", "settle_s": 1.0, "energy_s": 1.0, "best": best, "controller": of}
        for best, of in ((False, "MPC"), (True, "PI"))
    ]
    assert said in control._trade([*others, *rows])


@pytest.mark.parametrize(
    ("seconds", "shown"), [(12.34, 12.3), (None, "does not settle"), (NAN, "does not settle"), (INF, "never")]
)
def test_a_missing_time_is_reported_in_words(seconds: float | None, shown: object) -> None:
    assert control._shown(seconds) == shown


@pytest.mark.parametrize(("value", "shown"), [(0.12345, 0.123), (None, None), (NAN, None), (INF, None)])
def test_a_number_that_is_none_is_left_out(value: float | None, shown: float | None) -> None:
    assert control._rounded(value) == shown


@pytest.mark.parametrize(
    ("settle", "tone", "said"),
    [
        (41.6, "good", "t from 25.0 to 38 degC settles in 42 s, overshoot 0.25 K, bias -0.010 K."),
        (NAN, "warn", "t from 25.0 to 38 degC does not settle, overshoot 0.25 K, bias -0.010 K."),
    ],
)
def test_a_closed_loop_is_reported_by_output_with_its_statuses(settle: float, tone: str, said: str) -> None:
    segment = Segment("t", 25.0, 38.0, 0.0, 100.0, settle, 0.25, -0.01, 0.02, 5.0, 1.0, 0.5)
    none: Any = np.zeros(3)
    run = ClosedLoop(
        none, {}, none, {}, {}, {}, ("ok", "late", "ok"), ("", "wait", "wait"), none, 0.2, {}, (segment,)
    )
    section = control.loop_section(run, SimpleNamespace(limits={}, slew_per_s={}), "loop")
    assert (section.verdict, section.tone) == (said, tone)
    assert section.parts[0].caption.endswith("By status: 2 ok, 1 late.")
    assert section.parts[1] == Text("Advice of the controller: wait.")
    assert (
        control.loop_section(run, SimpleNamespace(limits={}, slew_per_s={}), "loop", tone="bad").tone == "bad"
    )


@pytest.mark.parametrize(
    ("contact", "said", "tone"),
    [
        (0.42, 'The skin felt the object 0.4 s after the "closed" message.', "good"),
        (0.04, 'The skin felt the object 0.0 s after the "closed" message.', "good"),
        (-0.04, 'The skin felt the object 0.0 s after the "closed" message.', "good"),
        (-0.31, 'The skin felt the object 0.3 s before the "closed" message.', "good"),
        (NAN, "The skin felt no object: no contact, or one as warm as the skin.", "warn"),
    ],
)
def test_when_the_skin_felt_the_object_is_reported(contact: float, said: str, tone: str) -> None:
    section = control._contact_section(None, contact)
    assert (section.verdict, section.tone) == (said, tone)


def test_what_never_settled_has_no_bias_and_several_outputs_no_common_figures() -> None:
    session = SimpleNamespace(settle_time=12.0, overshoot=0.3, bias=NAN)
    assert control._figures_of(session, ("t",)) == {"t": {"settle_s": 12.0, "overshoot": 0.3}}
    session.bias = 0.05
    assert control._figures_of(session, ("t",))["t"]["bias"] == 0.05
    assert control._figures_of(session, ("t1", "t2")) == {}


def test_steps_of_a_tuning_stand_in_the_order_of_the_spec() -> None:
    row = {
        "settle_mean_s": 10.04, "settle_worst_s": NAN, "overshoot_mean": 0.12345, "overshoot_worst": 0.5,
        "bias_worst": 0.01, "energy_mean_s": 7.0, "bound_s": INF,
    }  # fmt: skip
    tuning = SimpleNamespace(
        spec=SimpleNamespace(steps=[(28.0, 38.0), (28.0, 18.0)]),
        rows=[
            SimpleNamespace(controller="PI", start=28.0, target=18.0, **row),
            SimpleNamespace(controller="tuned", start=28.0, target=38.0, **row),
        ],
    )
    first, second = control.tuning_rows(tuning)
    assert first == ("tuned", "28 to 38", 10.0, "does not settle", 0.123, 0.5, 0.01, 7.0, "never")
    assert second[:2] == ("PI", "28 to 18")


def test_the_table_of_models_has_a_column_a_log_of_what_was_held_out() -> None:
    row = {"output": "t", "unit": "degC", "fit_percent": 90.0, "n": 50}
    rows = [
        SimpleNamespace(model=model, log=log, rmse=rmse, no_input_rmse=2 + rmse, held_out=held, **row)
        for model, log, rmse, held in (
            ("arx", "a", 0.1, True),
            ("oe", "b", 0.2, True),
            ("oe", "a", 0.9, False),
        )
    ]
    found = SimpleNamespace(rows=rows)
    table = plant.model_table(found)
    assert table.head == ("model", "output", "a", "b", "unit")
    assert table.rows == (
        ("arx", "t", 0.1, None, "degC"),
        ("oe", "t", None, 0.2, "degC"),
        ("no\N{NO-BREAK SPACE}input", "t", 2.1, 2.2, "degC"),
    )
    assert [row[-1] for row in plant.model_rows(found)] == ["held out", "held out", "in the fit"]


@pytest.mark.parametrize(
    ("effect", "unit"),
    [("offset of t", "K"), ("gain", "1"), ("R", "K/W")],
)
def test_an_effect_of_one_log_has_the_unit_of_a_difference_or_of_its_parameter(
    effect: str, unit: str
) -> None:
    known = SimpleNamespace(
        units={"t": "degC", "R": "K/W", "gain": "K/s"}, scales={"gain": "log", "R": "natural"}
    )
    assert plant._unit_of_effect(known, effect) == unit


@pytest.mark.parametrize(
    ("apart", "reported"), [([False, False], False), ([True, True], False), ([False, True], True)]
)
def test_conditions_below_the_line_are_reported_where_there_are_others_above_it(
    apart: list[bool], reported: bool
) -> None:
    said = classification._below([{"apart": value} for value in apart])
    assert bool(said) == reported
    assert not reported or "touched twice or of unknown temperature, not in the pool" in said
