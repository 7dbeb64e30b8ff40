"""What the pages of a tuning and of a session say: numbers, units and tones."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from tests.mpc.makers import make_tank
from tests.report.conftest import part
from thermogrip.mpc.closed_loop.simulate import ClosedLoop, Segment
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.design.spec import Spec
from thermogrip.mpc.tuning.design_review import Check
from thermogrip.report import control
from thermogrip.report.charts import Chart
from thermogrip.report.html import Plot, Table, Text

NAN, INF = float("nan"), float("inf")

STEPS = [(28.0, 38.0), (28.0, 18.0)]


@pytest.fixture(autouse=True)
def drawn(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Return what each figure was drawn from; figures have tests of their own."""
    seen: dict[str, Any] = {}
    for name in ("closed_loop_chart", "steps_chart", "grasps_chart"):

        def draw(*args: Any, name: str = name, **options: Any) -> Any:
            seen.setdefault(name.rpartition("_")[0], []).append((args, options))
            return Chart(())

        monkeypatch.setattr(control, name, draw)
    return seen


class Stub(Controller):
    """As much of an MPC as a page asks for."""

    controlled: Any = ("t1", "t2")
    disturbance: Any = SimpleNamespace(names=("q", "t1"))

    def __init__(self, design: Any, plant: Any) -> None:
        self.design, self.plant = design, plant


def tuning_of(**changes: Any) -> Any:
    spec = Spec(
        steps=STEPS,
        settle_within_s=180.0,
        hold_s=200.0,
        search_draws=2,
        check_draws=5,
        evaluations=30,
        sensor_offset_degC=0.3,
    )
    design = SimpleNamespace(
        controlled=("t1", "t2"), dt=2.0, deadline_s=0.5, limits={}, slew_per_s={"q": 5.0},
        drive_range={"q": (0.0, 100.0)}, to_dict=dict,
    )  # fmt: skip
    plant = SimpleNamespace(uncertain=True, valid={}, units={})
    run = SimpleNamespace(
        segments=(), status=("ok",), advice=("", "wait"), band=0.25, seconds=(0.01, 0.02), settle=0.0
    )
    made = {
        "spec": spec, "scores": {"tuned": 1.23456, "PI": 2.0}, "verdict": "tuned", "finding": "Faster.",
        "meets_spec": True, "checks": (), "rows": [], "seed": 7,
        "runs": {"28 to 38, MPC": run, "28 to 38, PI": run, "28 to 18, MPC": run, "q by 10, MPC": run},
        "controller": Stub(design, plant),
    }  # fmt: skip
    return SimpleNamespace(**made | changes)


@pytest.mark.parametrize(
    ("figures", "tone"),
    [
        ({}, "good"),
        ({"settle_s": 460.0}, "warn"),
        ({"settle_s": np.nan}, "warn"),
        ({"overshoot": 0.31}, "warn"),
        ({"bias": -0.06}, "warn"),
    ],
)
def test_a_step_is_good_where_each_output_is_as_the_spec_asks(figures: dict[str, float], tone: str) -> None:
    met = {"output": "t1", "settle_s": 440.0, "overshoot": 0.29, "bias": -0.04}
    run: Any = SimpleNamespace(segments=[SimpleNamespace(**met), SimpleNamespace(**met | figures)])
    assert control._tone(Spec(steps=STEPS), run) == tone


@pytest.mark.parametrize(
    ("meets", "known", "tone", "says", "of"),
    [
        (True, True, "good", "The MPC meets the spec on every draw.", "5 draws of the plant that the search"),
        (False, False, "warn", "The MPC does not meet the spec: c: late.", "the plant, which has no"),
    ],
)
def test_a_tuned_controller_stands_with_its_scores_and_what_it_did_not_know(
    meets: bool, known: bool, tone: str, says: str, of: str
) -> None:
    tuning = tuning_of(meets_spec=meets, checks=() if meets else (Check("c", "fail", "late"),))
    tuning.controller.plant.uncertain = known
    section = control.tuning_section(tuning)
    assert (section.verdict, section.tone) == (says, tone)
    table = part(section, 1, Table)
    finding, about, scores = (part(section, at, Text).text for at in (2, 3, 4))
    assert finding == "Tuned. Faster."
    assert table.head == control.tuning_table(tuning)[0]
    assert table.caption.startswith(f"Closed loops on {of}")
    assert isinstance(section.parts[0], Plot)
    assert about.startswith("Band 0.25 degC. ")
    assert "offset of 0.3 degC" in about
    words = "At most 30 designs of each kind were tried"
    assert f"lower is better: tuned 1.235, PI 2.000. {words}" in scores


def test_what_was_asked_stands_beside_the_design_by_the_names_of_their_files() -> None:
    tank = make_tank()
    spec = Spec(steps=STEPS, zones={"t_surface": 0.05})
    controller = Controller(tank, spec.design(tank, move=0.125))
    section = control.spec_section(tuning_of(spec=spec, controller=controller))
    asked, found = (dict(part(section, at, Table).rows) for at in (0, 1))
    assert section.verdict == "Seed 7; the same seed gives the same design."
    assert (asked["steps"], asked["settle_within_s"]) == ("[[28, 38], [28, 18]]", "450")
    assert asked["zones"] == "t_surface = 0.05"
    assert "limits" not in asked
    assert (found["move"], found["controlled"]) == ("0.125", "[t_surface]")
    assert found["drive_range"] == "drive = [-1, 1]"


def test_the_page_of_a_pi_has_its_loops_and_no_weights() -> None:
    tank = make_tank()
    pi = PIController(tank, Spec(steps=STEPS).design(tank))
    tuning = tuning_of(spec=Spec(steps=STEPS), controller=pi)
    found = dict(part(control.spec_section(tuning), 1, Table).rows)
    assert list(found) == ["dt", "controlled", "drive_range", "slew_per_s", "loops"]
    assert found["loops"].startswith("[drive = drive; output = t_surface; Kc = ")
    assert control.tuning_section(tuning).verdict == "The PI meets the spec on every draw."


def test_a_tuning_has_a_section_for_each_step_and_load_of_its_controller(drawn: dict[str, Any]) -> None:
    tuning = tuning_of()
    titles = [section.title for section in control.tuning_sections(tuning)]
    assert titles == [
        "Does the controller meet the spec?", "The step from 28 to 38 degC",
        "The step from 28 to 18 degC", "A load on q by 10",
        "What was requested, and the design",
    ]  # fmt: skip
    design = tuning.controller.design
    options = {"limits": design.limits}
    assert drawn["closed_loop"][0] == ((tuning.runs["28 to 38, MPC"],), options)
    assert len(drawn["closed_loop"]) == 3
    [((runs,), _)] = drawn["steps"]
    assert runs is tuning.runs


@pytest.mark.parametrize(
    ("verdict", "advice", "tone", "moves", "sections"),
    [("settled", "", "good", 2, 3), ("tripped", "look", "bad", 2, 3), ("settled", "", "good", 1, 2)],
)
def test_a_session_stands_with_its_events_its_grasp_and_its_loop(
    verdict: str, advice: str, tone: str, moves: int, sections: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = SimpleNamespace(segments=(), status=("ok",), advice=(), band=0.25)
    looped = Mock(return_value=run)
    monkeypatch.setattr(control, "session_loop", looped)
    event = SimpleNamespace(time_s=3.0, kind="phase", text="settle")
    session: Any = SimpleNamespace(
        verdict=verdict, advice=advice, events=(event,), grasps="a grasp", contact=0.5, log="a log",
        settle_time=9.0, overshoot=0.1, bias=0.0,
    )  # fmt: skip
    moved: Any = [(0.0, SimpleNamespace(seconds=0.25)), (2.0, SimpleNamespace(seconds=0.125))][:moves]
    controller = tuning_of().controller
    controller.controlled = ("t1",)
    found = control.session_sections(session, moved, controller, "the twin")
    assert (len(found), found[0].verdict, found[0].tone) == (
        sections,
        f"{verdict.capitalize()} on the twin.",
        tone,
    )
    table, *rest = found[0].parts
    assert isinstance(table, Table)
    assert table.rows == ((3.0, "phase", "settle"),)
    assert rest == [Text("Advice: look.")] * bool(advice)
    if moves > 1:
        figures = {"t1": {"settle_s": 9.0, "overshoot": 0.1, "bias": 0.0}}
        looped.assert_called_once_with("a log", moved, drive_range={"q": (0.0, 100.0)}, figures=figures)
        assert found[2].tone == tone


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
    design: Any = SimpleNamespace(limits={}, slew_per_s={})
    section = control.loop_section(run, design, "loop")
    assert (section.verdict, section.tone) == (said, tone)
    assert part(section, 0, Plot).caption.endswith("By status: 2 ok, 1 late.")
    assert section.parts[1] == Text("Advice of the controller: wait.")
    assert control.loop_section(run, design, "loop", tone="bad").tone == "bad"


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
    grasps: Any = None
    section = control._contact_section(grasps, contact)
    assert (section.verdict, section.tone) == (said, tone)


def test_controllers_stand_beside_each_other_step_by_step_and_load_by_load() -> None:
    row = {
        "settle_mean_s": 10.04, "settle_worst_s": NAN, "overshoot_mean": 0.12345, "overshoot_worst": 0.5,
        "bias_worst": 0.01, "energy_mean_s": 7.0, "bound_s": INF, "output": "", "iae_mean": 55.5,
        "travel_mean": 2.5,
    }  # fmt: skip
    tuning: Any = SimpleNamespace(
        spec=SimpleNamespace(steps=[(28.0, 38.0), (28.0, 18.0)]),
        rows=[
            SimpleNamespace(controller="tuned", start=28.0, target=38.0, load="", **row),
            SimpleNamespace(controller="tuned", start=38.0, target=38.0, load="q by 10", **row),
            SimpleNamespace(controller="PI", start=28.0, target=38.0, load="", **row),
        ],
    )
    head, (first, second, load) = control.tuning_table(tuning)
    assert head == (
        "controller", "step [degC] or load", "settles in [s], mean", "worst", "overshoot [K], mean", "worst",
        "bias [K], worst", "IAE [K s]", "moves", "energy [s at full drive]", "minimum time [s]",
    )  # fmt: skip
    figures = (10.0, "does not settle", 0.123, 0.5, 0.01, 55.5, 2.5, 7.0)
    assert first == ("tuned", "28 to 38", *figures, "never")
    assert second[:2] == ("PI", "28 to 38")
    assert load == ("tuned", "q by 10", *figures, "")
