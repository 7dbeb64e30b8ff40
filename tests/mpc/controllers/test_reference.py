"""The step in Python, part by part: what follows from optimiser, clock and readings."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tests.mpc.makers import crossed
from thermogrip.mpc.controllers.base import targets_ahead
from thermogrip.mpc.controllers.reference import ReferenceController
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.optimiser.rti import Outcome

REST = {"t_tank": 25.0, "t_surface": 25.0, "t_ambient": 25.0}
NAN = float("nan")


def test_the_pi_takes_over_without_a_bump(tank, monkeypatch):
    controller = ReferenceController(tank, default_design(tank, dt=2.0, patience_s=6.0))
    controller.reset(REST)
    for _ in range(4):
        before = controller.step({**REST, "t_surface": 37.9, "t_tank": 39.0}, 38.0).drive

    def broken(*args, **kwargs):
        raise np.linalg.LinAlgError("planted")

    monkeypatch.setattr(type(controller.optimiser), "solve", broken)
    controller._plan = None
    move = controller.step({**REST, "t_surface": 37.9, "t_tank": 39.0}, 38.0)
    assert move.status == "fallback_pi"
    assert move.drive == pytest.approx(before, abs=0.02)


READ = {"a": 24.0, "b": 27.0, "room": 22.0}
OLD = np.arange(1.0, 13.0).reshape(6, 2)  # a plan of six samples
FOUND = Outcome(
    np.array([[10.0, 1.0], [20.0, 2.0], [30.0, 4.0]]),
    np.column_stack([np.linspace(24.0, 31.0, 6), np.linspace(27.0, 32.0, 6)]),
    "solved", {}, 9, np.array([0.05, 0.049]),
)  # fmt: skip
MEAN = [16.0, 1.6]  # of its first 2.5 samples: (10 + 20 + 20 / 2) / 2.5
OLD_MEAN = [4.6, 5.6]  # of OLD, one sample later: (3 + 5 + 7 / 2) / 2.5


def waited(two: ReferenceController, seconds: float) -> None:
    """Let so many seconds pass since the last move."""
    two.times.call({"time_s": 0.0})
    two.times.moved()
    two.times.call({"time_s": seconds})


def make_two(**changes) -> ReferenceController:
    """Return the controller of b and a, whose blocks are 1, 2 and 3 samples, at rest; no time passes."""
    given = {"controlled": ("b", "a"), "blocks": (1, 2, 3), "deadline_s": 0.25, "patience_s": 6.0} | changes
    two = ReferenceController(crossed(), default_design(crossed(), **given), clock=lambda: 1.0)
    two.reset(READ)
    return two


@pytest.fixture
def two(monkeypatch) -> ReferenceController:
    two = make_two()
    two._plan, two._age_s, two._on_pi = OLD.copy(), 2.0, True
    waited(two, 5.0)
    two._u, two._target, two._side = np.array([41.0, 63.0]), np.array([33.0, 30.0]), np.array([1.0, -1.0])
    monkeypatch.setattr(two.reach, "missed", lambda *args, **kwargs: None)
    monkeypatch.setattr(two.optimiser, "solve", lambda *args, **kwargs: FOUND)
    monkeypatch.setattr(two, "_fall_back", lambda status, advice: (np.zeros(2), f"back {status}", advice))
    return two


UNKNOWN = {"a": 30.0, "b": 31.0, "c": 1.0}  # one that is not controlled
TOO_LATE = "the step took longer than its deadline"
BEYOND = "the drive that was applied is out of range: brought back"


@pytest.mark.parametrize(
    ("clock", "state", "found", "decided"),
    [
        ([1.0], {}, {}, (MEAN, "ok", "")),
        ([1.2, 1.25], {}, {}, (MEAN, "ok", "")),
        ([1.2, 1.26], {}, {}, (MEAN, "late", TOO_LATE)),
        ([1.25], {}, {}, ([0, 0], "back late", TOO_LATE)),
        ([1.0], {}, {"status": "time limit"}, ([0, 0], "back late", TOO_LATE)),
        ([1.0], {}, {"status": "infeasible"}, ([0, 0], "back infeasible", "optimiser: infeasible")),
        ([1.0], {}, {"status": "cycling"}, ([0, 0], "back fallback_plan", "optimiser: cycling")),
        ([1.0], {"_u": np.array([-1e-8, 63.0])}, {}, (MEAN, "infeasible", BEYOND)),
        ([1.0], {"_u": np.array([41.0, 100.0 + 1e-8])}, {}, (MEAN, "infeasible", BEYOND)),
        ([1.0], {"_u": np.array([-5e-10, 100.0 + 5e-10])}, {}, (MEAN, "ok", "")),
        ([1.0], {}, {"broken": {"a": 0.2, "b": 0.5}},
         (MEAN, "ok", "limit of b will be broken by 0.5 degC: choose a nearer target")),
        ([1.0], {}, {"broken": {"a": 0.74, "b": 0.3}},
         (MEAN, "infeasible", "limit of a will be broken by 0.7 degC: choose a nearer target")),
        ([1.0], {"_unread_s": np.array([4.0, 0.0])}, {},
         (MEAN, "fallback_plan", "b: no usable reading, the model replaces it")),
        ([1.0], {"_unread_s": np.array([0.0, 7.4])}, {},
         (MEAN, "fallback_plan", "no reading of a for 7 s: q2 to rest, the others go on")),
        ([9.0], {"_unread_s": np.array([1.0, 2.0]), "_on_pi": False}, {}, (OLD_MEAN, "fallback_plan", "")),
        ([9.0], {"_unread_s": np.array([1.0, 2.0])}, {}, ([41.0, 63.0], "fallback_plan", "")),  # the PI is on
        ([9.0], {"_unread_s": np.array([6.0, 7.0]), "_on_pi": False}, {}, (OLD_MEAN, "fallback_plan", "")),
        ([9.0], {"_unread_s": np.array([8.0, 6.6])}, {},
         ([0, 0], "off", "no reading for 7 s: check the sensor")),
    ],
)  # fmt: skip
def test_a_step_is_decided_from_readings_clock_and_plan(two, monkeypatch, clock, state, found, decided):
    times = iter(clock)
    two.clock = lambda: next(times, clock[-1])
    for name, value in state.items():
        setattr(two, name, value)
    monkeypatch.setattr(two.optimiser, "solve", lambda *args, **kwargs: replace(FOUND, **found))
    u, status, advice = two._decide(two._target, None, 1.0)
    assert (np.round(u, 12).tolist(), status, advice) == decided
    if status == "off":
        assert two._plan is None
    elif decided[0] is MEAN:
        rows = [[10.0, 1.0]] + [[20.0, 2.0]] * 2 + [[30.0, 4.0]] * 3
        assert (two._plan.tolist(), two._age_s, two._on_pi, two.last_iterations) == (rows, 0.0, False, 9)
        assert two.observer._held.tolist()[:4] == [False, False, False, True]  # below 0.05 of its gain


def test_a_target_out_of_reach_is_named_from_what_is_known_of_it(two, monkeypatch):
    asked = {}
    monkeypatch.setattr(two.reach, "missed", lambda *args, **kwargs: asked.update(kwargs) or (1, 28.26))
    two._unread_s, two._y = np.array([4.0, 0.0]), np.array([24.5, 27.5])
    u, *said = two._decide(two._target, None, 1.0)
    assert said == ["infeasible", "no drive holds a at 30.0 degC: 28.3 degC can be held"]
    assert u.tolist() == pytest.approx(MEAN)
    assert {name: value.tolist() for name, value in asked.items()} == {
        "target": [33.0, 30.0], "side": [1.0, -1.0], "ahead": [32.0, 31.0],
        "seen": [False, True],
    }  # fmt: skip


def test_a_prediction_that_fails_is_a_fallback_and_no_target_is_off(two, monkeypatch):
    def broken(*args, **kwargs):
        raise FloatingPointError("planted")

    monkeypatch.setattr(two.optimiser, "solve", broken)
    assert two._decide(two._target, None, 1.0)[1:] == ("back fallback_plan", "optimiser: not finite")
    u, *said = two._decide(np.array([33.0, NAN]), None, 1.0)
    assert (u.tolist(), said) == ([0.0, 0.0], ["off", "no target yet: drive to zero"])


def test_the_optimiser_starts_from_the_estimate_and_the_last_plan(monkeypatch):
    two, asked = make_two(), []
    monkeypatch.setattr(two.optimiser, "solve", lambda sample: asked.append(sample) or FOUND)
    two.observer.x, two.observer.w, two.observer.found_offset = (
        np.array([20.0, 30.0]), np.array([0.03, -0.02]), np.array([0.4, 0.7]),
    )  # fmt: skip
    two._u, two._side = np.array([120.0, 60.0]), np.array([1.0, -1.0])
    waited(two, 5.0)
    two._unread_s = np.array([3.0, 9.0])
    for plan, guess in (
        (None, [[100.0, 60.0]] * 3),
        (
            OLD,
            [[3.0, 4.0], [6.0, 7.0], [31 / 3, 34 / 3]],
        ),  # from the second sample on, by blocks; the end stays
    ):
        two._plan, two._age_s = plan, 2.0
        two._optimise(np.array([33.0, 30.0]), None)
        for name, wanted in {
            "x": [20.0, 30.0], "last": [100.0, 60.0], "guess": guess, "d": [22.0], "slew_s": 5.0,
            "target": [33.0, 30.0], "side": [1.0, -1.0], "bias": [0.4, 0.7], "drive_bias": [3.0, -2.0],
            "lost": [False, True],
        }.items():  # fmt: skip
            np.testing.assert_allclose(getattr(asked[-1], name), wanted, rtol=1e-12)


@pytest.mark.parametrize(
    ("state", "status", "decided", "calls"),
    [
        ({}, "late", (OLD_MEAN, "late"), ""),
        ({"_age_s": 6.0}, "fallback_plan", ([8.6, 9.6], "fallback_plan"), ""),  # (7 + 9 + 11 / 2) / 2.5
        ({"_age_s": 6.1}, "fallback_plan", ([7.0, 8.0], "fallback_pi"), "follow hold propose"),
        ({"_plan": None}, "late", ([7.0, 8.0], "late"), "follow hold propose"),
        ({"_on_pi": True}, "fallback_plan", ([7.0, 8.0], "fallback_pi"), "hold propose"),
        ({"_plan": None, "_y": np.array([NAN, 27.0])}, "late", ([0.0, 0.0], "off"), ""),
        ({"_plan": None, "pi": SimpleNamespace(loops=())}, "late", ([0.0, 0.0], "off"), ""),
    ],
)
def test_without_an_answer_there_is_the_plan_then_the_pi_then_none(
    monkeypatch, state, status, decided, calls
):
    two, called = make_two(), {}

    def keep(name, answer=None):
        return lambda *args, **kwargs: called.update({name: (args, kwargs)}) or answer

    for name, answer in (("follow", None), ("hold", None), ("propose", np.array([7.0, 8.0]))):
        monkeypatch.setattr(two.pi, name, keep(name, answer))
    two._plan, two._age_s, two._y = OLD.copy(), 2.0, np.array([24.0, 27.0])
    waited(two, 5.0)
    two._u, two._target = np.array([-3.0, 140.0]), np.array([33.0, 30.0])
    for name, value in state.items():
        setattr(two, name, value)
    u, *said = two._fall_back(status, "why")
    assert (np.round(u, 12).tolist(), said) == (decided[0], [decided[1], "why"])
    assert " ".join(called) == calls
    assert two._on_pi == bool(calls)
    if "follow" in called:
        np.testing.assert_equal(called["follow"][0], ([-3.0, 140.0], [27.0, 24.0], [33.0, 30.0], [22.0]))
    if calls:
        np.testing.assert_equal(called["hold"][0], ([0.0, 100.0],))
        assert called["propose"][1] == {"seconds": 5.0}
        np.testing.assert_equal(called["propose"][0], ([27.0, 24.0], [33.0, 30.0], [22.0]))


@pytest.mark.parametrize(
    ("y", "d", "state", "said", "unread", "room"),
    [
        ([24.1, 27.1], [21.0], {}, "", [0.0, 0.0], 21.0),
        ([24.1, NAN], [21.0], {}, "b: no usable reading", [6.5, 0.0], 21.0),
        ([NAN, 27.1], [NAN], {}, "a, room: no usable reading", [0.0, 4.5], 22.0),
        ([34.1, 27.1], [21.0], {}, "a: no usable reading", [0.0, 4.5], 21.0),  # 10 degC off
        ([24.0, 27.1], [21.0], {"stuck": 2.1},
         "a: no usable reading, stuck: it should have moved", [0.0, 4.5], 21.0),
        ([34.1, 27.1], [21.0], {"jumps": 3},
         "a: a jump that stays, the estimate was started again", [0.0, 0.0], 21.0),
        ([NAN, NAN], [21.0], {"silent": 45.4}, "a, b: no usable reading", [6.5, 4.5], 21.0),
        ([24.1, NAN], [21.0], {"silent": 45.4},
         "no reading for 45 s: the estimate was started again", [0, 0], 21.0),
    ],
)  # fmt: skip
def test_a_reading_is_taken_in_with_what_it_lacks(y, d, state, said, unread, room):
    two = make_two()
    two.times.call({"time_s": 5.0})
    two.times.moved()
    two.times.call({"time_s": 8.5})
    two._fresh, two._unread_s, two._u = False, np.array([3.0, 1.0]), np.array([41.0, 63.0])
    two._target, two._side, two._silent_s = (
        np.array([33.0, 30.0]),
        np.array([1.0, -1.0]),
        state.get("silent", 0.0),
    )
    two.monitor._spikes[0], two.monitor._moved[0] = state.get("jumps", 0), state.get("stuck", 0.0)
    assert two._absorb(np.array(y), np.array(d), np.array([12.0, 13.0])) == said
    assert two._unread_s.tolist() == unread  # 3.5 s more
    assert two._d.tolist() == [room]
    again = said.startswith("no reading for")
    assert two._u.tolist() == ([41.0, 63.0] if again else [12.0, 13.0])
    assert not two._fresh
    assert (two._target.tolist(), two._side.tolist()) == ([33.0, 30.0], [1.0, -1.0])
    if again:
        assert (two._in_force.tolist(), two._silent_s, two._plan) == ([12.0, 13.0], 0.0, None)
        np.testing.assert_array_equal(two._y, y)


def test_what_the_model_moves_is_expected_of_the_readings_since_the_last():
    two = make_two()
    for fresh, moved in ((True, [0.0, 0.0]), (False, [0.5, -0.25])):
        two._fresh, two._seen = fresh, two.observer.now - [0.5, -0.25]
        two._absorb(np.array([24.0, 27.0]), np.array([22.0]), np.zeros(2))
        np.testing.assert_allclose(two.monitor._moved, moved, atol=1e-12)  # the readings stay the very same
        np.testing.assert_array_equal(two._seen, two.observer.now)


@pytest.mark.parametrize(
    ("fresh", "seconds", "silent", "passed"),
    [(True, 5.0, 0.0, None), (False, 5.0, 0.0, 5.0), (False, 32.0, 0.0, 32.0), (False, 32.5, 32.5, 30.0)],
)
def test_after_a_long_silence_no_more_is_predicted_than_half_a_minute(
    monkeypatch, fresh, seconds, silent, passed
):
    two, advanced = make_two(), []
    monkeypatch.setattr(two.observer, "advance", lambda *args: advanced.append(args))
    two._fresh, two._age_s = fresh, 1.5
    two._pass(seconds, np.array([12.0, 13.0]))
    assert (two._silent_s, two._age_s) == (silent, 1.5 + (passed or 0.0))
    np.testing.assert_equal(advanced, [] if passed is None else [(passed, [12.0, 13.0], [22.0])])


def test_a_drive_goes_back_by_its_slew_while_the_pump_is_off(tank):
    one = ReferenceController(tank, default_design(tank, dt=2.0, slew_per_s={"drive": 0.1}))
    one.reset(REST)
    for _ in range(3):
        one.step(REST, 38.0)
    still = {"t_tank": 30.0, "t_surface": 31.0, "t_ambient": NAN, "pump": 0.0}
    for k, drive in enumerate((0.4, 0.2, 0.0)):  # from 0.6 on
        move = one.step({**still, "t_ambient": 23.0} if k == 0 else still, {"t_surface": 29.0} if k else NAN)
        assert move.drive == pytest.approx(drive, abs=1e-12)
        assert (move.status, move.pump) == ("off", 1)
        assert move.advice == "pump is off: drive to zero until it runs"
        assert one._held_move(0.0).pump == 1
        assert (one._d.tolist(), one._plan, one._in_force.tolist()) == ([23.0], None, [move.drive])
        assert (one._target.tolist(), one._side.tolist()) == (([29.0], [-1.0]) if k else ([38.0], [1.0]))
    np.testing.assert_allclose(one.observer.reading(), [30.0, 31.0], atol=0.3)


@pytest.mark.parametrize(
    ("decided", "said", "target", "answered"),
    [
        (("ok", "there"), "", 30.0, ("ok", "there")),
        (("ok", "there"), "here", 30.0, ("ok", "here")),
        (("late", "there"), "here", 30.0, ("late", "there")),
        (("late", ""), "here", 30.0, ("late", "here")),
        (("ok", ""), "here", UNKNOWN, ("infeasible", "target names c, controlled is b, a")),
        (("late", "there"), "", UNKNOWN, ("late", "target names c, controlled is b, a")),
    ],
)  # fmt: skip
def test_an_answer_has_the_status_and_the_first_cause(monkeypatch, decided, said, target, answered):
    two = make_two()
    two._u = np.array([41.0, 63.0])
    monkeypatch.setattr(two, "_absorb", lambda y, d, applied: said)
    monkeypatch.setattr(two, "_decide", lambda wanted, ahead, started: (np.array([99.0, 60.0]), *decided))
    move = two.step(READ, target)
    assert (move.status, move.advice) == answered
    assert move.drive == {"q1": 66.0, "q2": 60.0}  # 25 a sample
    assert two._in_force.tolist() == [66.0, 60.0]
    wanted = two._target.tolist()
    assert (wanted, two._side.tolist()) == ([30.0 + isinstance(target, dict), 30.0], [1.0, 1.0])
    two._side = np.array([7.0, 7.0])
    two.step(READ, {"a": 30.0, "b": wanted[0]})
    assert two._side.tolist() == [7.0, 7.0]  # from where the same target is approached stays
    two.step(READ, {"a": 20.0, "b": wanted[0]})
    assert two._side.tolist() == [1.0, -1.0]


def test_what_was_applied_is_read_drive_by_drive_and_a_stale_reading_is_none(monkeypatch):
    two, seen = make_two(), []
    monkeypatch.setattr(two, "_absorb", lambda *args: seen.append(args) or "")
    two._in_force = np.array([41.0, 63.0])
    assert two.step({**READ, "time_s": 4.0, "q2": 5.0}, 30.0).advice == ""
    two._in_force = np.array([41.0, 63.0])
    assert (
        two.step({**READ, "time_s": 4.0, "q1": 6.0}, 30.0).advice
        == "reading is stale: its time has not moved on"
    )
    np.testing.assert_equal(seen, [([24.0, 27.0], [22.0], [41.0, 5.0]), ([NAN, NAN], [22.0], [6.0, 63.0])])


def test_a_controller_has_what_its_design_says_and_a_reset_forgets_the_rest():
    ranges, slews = {"q1": (5.0, 80.0), "q2": (0.0, 90.0)}, {"q1": 4.0, "q2": 7.0}
    two = make_two(drive_range=ranges, slew_per_s=slews, dt=4.0)
    assert [loop.feedforward for loop in two.pi.loops] == [0.0, 0.0]
    assert [loop.Kc for loop in two.pi.loops] == [loop.Kc for loop in two.design.loops]
    for made in (two, two.pi):
        assert (made.dt, made.controlled, made._patience_s) == (4.0, ("b", "a"), pytest.approx(6.0, rel=2e-6))
        assert [each.tolist() for each in (made.lowest, made.highest, made.slew)] == [
            [5, 0],
            [80, 90],
            [16, 28],
        ]
    two._unread_s, two._silent_s, two._on_pi, two._age_s = np.ones(2), 40.0, True, 9.0
    two._target, two._side, two._plan, two.pi.integral = np.ones(2), np.ones(2), OLD, np.ones(2)
    two.optimiser._solves, two.reach._unreachable, two.times.since = 3, True, 9.0
    two.monitor._spikes[:], two._fresh, two._u = 2, False, np.array([9.0, 9.0])
    two.reset({"a": 31.0, "b": NAN, "room": NAN})
    assert (two._unread_s.tolist(), two._silent_s, two._on_pi, two._age_s) == ([0.0, 0.0], 0.0, False, 0.0)
    np.testing.assert_equal([two._target, two._side], [np.full(2, NAN), np.zeros(2)])
    np.testing.assert_equal([two._y, two._d, two._u, two._in_force], [[31, NAN], [25], [5, 0], [5, 0]])
    assert (two._plan, two.pi.integral.tolist()) == (None, [0.0, 0.0])
    assert (two.optimiser._solves, two.reach._unreachable, two.times.since) == (0, False, 0.0)
    assert (two.monitor._spikes.tolist(), two._fresh, two.plan) == ([0, 0], True, None)
    np.testing.assert_equal(two.monitor._last, [31.0, NAN])


@pytest.mark.parametrize(
    ("innovation", "caution"), [([2.9, -3.0], 1.0), ([-12.0, 1.0], 4.0), ([0.0, 1e3], 30.0)]
)
def test_moves_weigh_more_while_readings_are_far_from_the_filter(two, monkeypatch, innovation, caution):
    given = []
    monkeypatch.setattr(two.optimiser, "solve", lambda sample: given.append(sample) or FOUND)
    two.observer.innovation = np.array(innovation)
    two._optimise(two._target, None)
    assert given[0].caution == caution


def test_of_a_trajectory_each_sample_has_its_target_and_what_is_none_has_the_one_of_now():
    line, at = {"a": [28.0, 29.0, 30.0, NAN, 31.0]}, 1 + np.arange(1, 5)
    ahead = targets_ahead(line, ("a", "b"), np.array([28.0, 33.0]), at, -60.0, 200.0)
    np.testing.assert_array_equal(ahead, [[30.0, 33.0], [28.0, 33.0], [31.0, 33.0], [31.0, 33.0]])
    assert targets_ahead({"a": 28.0}, ("a",), np.array([28.0]), at, -60.0, 200.0) is None
