"""The record of a closed loop says what happened, and its plant applies each command when it is given."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import make_log
from thermogrip.mpc.closed_loop.simulate import (
    ClosedLoop,
    RecordedController,
    Segment,
    Surroundings,
    Truth,
    drive_shares,
    segment_of,
    session_loop,
    simulate_closed_loop,
)
from thermogrip.mpc.interface import Move
from thermogrip.mpc.plant.prediction import drive_names, drive_range
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant


def lag(unit: str = "1", valid: tuple[float, float] = (-1.0, 1.0), **more: Any) -> Plant:
    """A tank of 20 s that a drive moves by up to 20 K, and a skin that reads half of that."""
    model = StateSpaceModel(
        ("q", "pump"), ("t_ambient",), ("a", "b"), A=[[0.95]], B=[[1.0, 0.0]], E=[[0.0]], C=[[1.0], [0.5]],
        dt=1.0, y0=[25.0, 25.0], switches=("pump",),
    )  # fmt: skip
    units = {"q": unit, "pump": "1", "t_ambient": "degC", "a": "degC", "b": "degC"}
    return Plant(model, {}, dt=1.0, units=units, valid={"q": valid}, **more)


# ---- what can be moved ----


@pytest.mark.parametrize(
    ("unit", "valid", "expected"),
    [
        ("1", (-0.4, 0.6), (-1.0, 1.0)),
        ("1", (0.0, 0.6), (0.0, 1.0)),
        ("1", (-3.0, 0.5), (-3.0, 0.5)),  # no share: what the logs showed
        ("1", (-0.5, 1.04), (-1.0, 1.0)),
        ("percent", (-20.0, 50.0), (-100.0, 100.0)),
        ("percent", (0.0, 50.0), (0.0, 100.0)),
        ("0_255", (20.0, 90.0), (0.0, 255.0)),
        ("W", (2.0, 12.0), (2.0, 12.0)),
    ],
)
def test_a_range_goes_by_the_unit_and_cools_only_where_the_logs_did(
    unit: str, valid: tuple[float, float], expected: tuple[float, float]
) -> None:
    assert drive_range(lag(unit, valid), "q") == expected
    assert drive_names(lag()) == ("q",)


def test_a_drive_that_never_moved_has_no_range() -> None:
    with pytest.raises(UserError, match="drive q was constant in the logs"):
        drive_range(lag("W", (5.0, 5.0)), "q")


# ---- a segment in an operator's terms ----


def segment(y: np.ndarray, goal: float, **more: Any) -> Any:
    n = len(y) - 1
    usual = {"drive": np.zeros((n, 1)), "full": np.zeros(n, dtype=bool), "band": 0.25}
    return segment_of("t", 100.0 + np.arange(n + 1.0), y, goal, **usual | more)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_settling_overshoot_and_bias_by_hand(side: float) -> None:
    off = np.full(301, 0.1)
    off[:40], off[40:50], off[50:60], off[60] = -10.0, 1.5, 0.2, -0.3
    off[181:] += 0.04  # the last 120 s are 121 rows
    found = segment(30.0 + side * off, 30.0)
    assert (found.start, found.target) == (30.0 - 10 * side, 30.0)
    assert (found.begin_s, found.end_s, found.settle_s) == (100.0, 400.0, 61.0)
    assert found.overshoot == pytest.approx(1.5)
    assert found.bias == pytest.approx(side * (0.14 - 0.04 / 121))
    assert found.sd == pytest.approx(np.std(off[180:]))


def test_the_bias_of_a_short_segment_is_that_of_its_last_fifth() -> None:
    y = np.where(np.arange(201) >= 180, 30.2, 30.1)
    assert segment(y, 30.0).bias == pytest.approx(0.1 + 0.1 * 21 / 41)  # of the rows 160 to 200
    y = np.where(np.arange(241) >= 180, 30.2, 30.1)
    assert segment(y, 30.0).bias == pytest.approx(0.1 + 0.1 * 61 / 121)  # of the rows 120 to 240
    assert segment(np.array([29.0, 31.5, 30.0, 30.0]), 30.0).overshoot == 1.5  # by where it begins


def test_what_leaves_the_band_at_the_end_never_settles_and_what_is_in_it_has_settled() -> None:
    y = np.full(100, 30.0)
    y[-1] = 30.3
    assert np.isnan(segment(y, 30.0).settle_s)
    found = segment(np.full(100, 30.25), 30.0)
    assert (found.settle_s, found.overshoot) == (0.0, 0.0)  # from its own side
    assert segment(30.0 + 0.2 * np.sin(np.arange(100)), 30.0).overshoot == pytest.approx(0.2, abs=1e-3)
    assert segment(np.linspace(20.0, 29.0, 50), 30.0).overshoot == 0.0


def test_energy_travel_and_the_share_at_full_drive() -> None:
    y = np.where(np.arange(101) < 40, 20.0, 30.0)
    drive = np.repeat([1.0, 0.5, -0.5, 0.0], 25)[:, None]
    found = segment(y, 30.0, drive=drive, full=np.arange(100) < 25)
    assert found.energy_s == pytest.approx(25 * (1.0 + 0.25 + 0.25))  # seconds at full drive
    assert found.travel == pytest.approx(0.5 + 1.0 + 0.5)
    assert found.full_share == pytest.approx(25 / 40)  # of the time until it settled
    never = segment(np.full(101, 20.0), 30.0, drive=drive, full=np.arange(100) < 25)
    assert never.full_share == pytest.approx(0.25)


def test_one_drive_at_its_limit_is_enough() -> None:
    drives = np.array([[0.5, 100.0], [-0.3, 50.0], [1.0, 0.0]])
    shares, full = drive_shares(drives, np.array([-0.3, 0.0]), np.array([1.0, 100.0]))
    assert full.tolist() == [True, True, True]
    np.testing.assert_allclose(shares, [[0.5, 1.0], [-0.3, 0.5], [1.0, 0.0]])
    assert not drive_shares(drives, np.array([-1.0, -1.0]), np.array([2.0, 120.0]))[1].any()


# ---- the truth ----


def test_surroundings_are_those_of_a_thermocouple_amplifier_where_nothing_is_given() -> None:
    assert Surroundings() == Surroundings(25.0, 0.04, {}, 1 / 16, {}, {}, 0.0, 0.0, 1.0, (), {})
    assert all(kind.__dataclass_params__.frozen for kind in (Surroundings, Segment, ClosedLoop))


def test_two_drives_of_a_plant_of_half_a_second() -> None:
    model = StateSpaceModel(
        ("p", "q"), ("room",), ("t",), A=[[0.9]], B=[[1.0, 0.1]], E=[[0.2]], C=[[1.0]], dt=0.5, y0=[20.0],
        c=[-0.2 * 20.0],
    )  # fmt: skip
    plant = Plant(model, {}, dt=0.5, units={"p": "1", "q": "percent"}, valid={"p": (-1.0, 1.0)})
    around = Surroundings(ambient=20.0, noise=0.3, quantum=0.0, move_delay_s=1.0)
    truth = Truth(plant, 2.0, around, None, 3)
    assert (truth.sub, truth.dt, truth.late) == (4, 2.0, 2)
    first = float(np.random.default_rng(3).standard_normal(1)[0])
    assert truth.reading() == pytest.approx({"time_s": 0.0, "t": 20.0 + 0.3 * first, "room": 20.0})
    truth.apply(Move({"q": 50.0, "p": -0.5}))
    x, want = 0.0, [20.0]
    for push in (0.0, 0.0, 4.5, 4.5):
        x = 0.9 * x + push
        want.append(20.0 + x)
    np.testing.assert_allclose(np.ravel(truth.y), want, atol=1e-12)
    assert truth.reading()["time_s"] == 2.0


def test_a_move_is_applied_after_its_delay_and_held() -> None:
    for delay in (0.0, 1.0, 3.0):
        truth = Truth(lag(), 2.0, Surroundings(move_delay_s=delay, drive_share=0.5), 25.0, 0)
        x, want = 0.0, [25.0]
        moves = (0.5, -0.2, 1.0)
        for move in moves:
            truth.apply(Move(move, 1, "ok", "", 0.0))
        for u in [*[0.0] * round(delay), *np.repeat(moves, 2)][:6]:
            x = 0.95 * x + 0.5 * u
            want.append(25.0 + x)
        np.testing.assert_allclose([row[0] for row in truth.y], want, atol=1e-12)
        assert truth.time == 6.0


def test_a_slower_sensor_is_a_first_order_lag() -> None:
    slow = Truth(lag(), 2.0, Surroundings(sensor_lag_s=3.0), 25.0, 0)
    slow.apply(Move(1.0))
    x, shown, want = 0.0, 25.0, [25.0]
    for _ in range(2):
        x = 0.95 * x + 1.0
        shown += 0.25 * (25.0 + x - shown)
        want.append(shown)
    np.testing.assert_allclose([row[0] for row in slow.y], want, atol=1e-12)


def test_readings_have_offsets_noise_and_the_quantum_of_their_converter() -> None:
    around = Surroundings(
        ambient=22.0, noise=0.0, quantum=0.25, quanta={"b": 0.1}, offset={"a": 0.3, "t_ambient": -1.05}
    )
    truth = Truth(lag(offsets={"a": 0.2, "b": -0.2}), 1.0, around, 25.0, 0)
    assert truth.reading() == pytest.approx({"time_s": 0.0, "a": 25.5, "b": 24.8, "t_ambient": 21.0})
    assert truth.y[0] == pytest.approx([25.5, 24.8])
    truth.apply(Move(1.0, 1, "ok", "", 0.0))
    assert truth.y[1] == pytest.approx([26.5, 25.3])
    loud = Truth(lag(), 1.0, Surroundings(noise=0.3, quantum=0.0), 25.0, 0)
    read = np.array([loud.reading()["a"] for _ in range(2000)])
    assert read.std() == pytest.approx(0.3, rel=4 / np.sqrt(4000))
    assert read.mean() == pytest.approx(25.0, abs=4 * 0.3 / np.sqrt(2000))
    with pytest.raises(ValueError, match="not a multiple"):
        Truth(lag(), 1.5, Surroundings(), 25.0, 0)


def test_what_no_schedule_says_is_the_band_and_the_seed_and_a_call_is_the_least() -> None:
    runs = [
        simulate_closed_loop(
            Plan([0.1] * 5), lag(), [(30.0, 0.1), (28.0, 5.0), (26.0, 4.0)], start=27.0, **given
        )
        for given in ({}, {"seed": 0, "band": 0.25}, {"seed": 1, "band": 5.0})
    ]
    assert [run.band for run in runs] == [0.25, 0.25, 5.0]
    assert [(part.begin_s, part.end_s) for part in runs[0].segments] == [(0.0, 2.0), (2.0, 6.0), (6.0, 10.0)]
    same = [np.array_equal(run.readings["a"], runs[0].readings["a"]) for run in runs[1:]]
    assert same == [True, False]
    assert [run.settled for run in runs] == [False, False, True]


class Plan:
    """A controller that answers with a list of drives, and keeps what it was given."""

    dt, controlled = 2.0, ("a",)

    def __init__(self, drives: list[float]) -> None:
        self.drives, self.seen, self.begun = iter(drives), [], []

    def reset(self, readings: Any) -> None:
        self.begun.append(readings)

    def step(self, readings: Any, target: Any) -> Move:
        self.seen.append((readings, target))
        return Move(next(self.drives), 1, "ok", "", 0.0)


def test_a_schedule_is_recorded_segment_by_segment() -> None:
    plan: Any = Plan([1.0] * 5 + [0.0] * 10)
    quiet = Surroundings(noise=0.0, quantum=0.0)
    run = simulate_closed_loop(
        plan, lag(), [(30.0, 10.0), ({"a": 26.0}, 20.0)], start=25.0, surroundings=quiet
    )
    assert len(plan.begun) == 1
    assert plan.begun[0]["a"] == 25.0
    assert [target for _, target in plan.seen] == [30.0] * 5 + [{"a": 26.0}] * 10
    assert run.target["a"].tolist() == [30.0] * 5 + [26.0] * 10
    assert run.time.tolist() == [float(k) for k in range(31)]
    assert run.sample_time.tolist() == [2.0 * k for k in range(15)]
    assert run.readings["a"].tolist() == run.outputs["a"][:-1:2].tolist()
    first, second = run.segments
    assert (first.begin_s, first.end_s, first.target, first.start) == (0.0, 10.0, 30.0, 25.0)
    assert (second.begin_s, second.end_s, second.target) == (10.0, 30.0, 26.0)
    top = 25.0 + 20.0 * (1 - 0.95**10)
    assert second.start == pytest.approx(top)
    assert (first.energy_s, second.energy_s) == (10.0, 0.0)
    assert first.overshoot == pytest.approx(top - 30.0)
    assert run.drive["q"].tolist() == [1.0] * 5 + [0.0] * 10
    assert run.drive_range == {"q": (-1.0, 1.0)}


def test_a_controller_is_told_the_drive_that_holds_the_start_and_moves_count_from_there() -> None:
    plan: Any = Plan([0.5] * 5 + [-0.25] * 5)
    quiet = Surroundings(noise=0.0, quantum=0.0, held=("a",))
    run = simulate_closed_loop(plan, lag(), [(35.0, 10.0), (20.0, 10.0)], start=30.0, surroundings=quiet)
    # 20 K at full drive, so that a quarter of it holds 5 K more than the room
    assert plan.begun[0]["q"] == plan.seen[0][0]["q"] == pytest.approx(0.25, abs=1e-6)
    assert "q" not in plan.seen[1][0]  # it knows what it asked for
    assert set(run.readings) == {"a", "b", "t_ambient"}
    assert [part.travel for part in run.segments] == pytest.approx([0.25, 0.75], abs=1e-6)
    # where no drive holds the start the plant is as warm all over, and nothing is told
    loose: Any = Plan([0.5] * 5)
    run = simulate_closed_loop(loose, lag(), [(35.0, 10.0)], start=90.0, surroundings=quiet)
    assert "q" not in loose.begun[0]
    assert run.segments[0].travel == pytest.approx(0.5)


def test_each_output_has_its_own_noise() -> None:
    around = Surroundings(noise=0.3, noises={"b": 0.01}, quantum=0.0)
    truth = Truth(lag(), 1.0, around, 25.0, 0)
    rows = [truth.reading() for _ in range(500)]
    spread = {name: np.std([row[name] for row in rows]) for name in ("a", "b")}
    assert spread == pytest.approx({"a": 0.3, "b": 0.01}, rel=0.15)


# ---- a session ----


def test_a_recorder_keeps_each_move_with_the_time_of_its_reading() -> None:
    plan = Plan([0.3, -0.2, 0.1])
    kept = RecordedController(plan)
    kept.reset({"a": 25.0})
    assert (kept.dt, kept.controlled, plan.begun) == (2.0, ("a",), [{"a": 25.0}])
    moves = [kept.step(reading, 30.0) for reading in ({"a": 25.0}, {"a": 26.0, "time_s": 2.5}, {"a": 27.0})]
    assert [move.drive for move in moves] == [0.3, -0.2, 0.1]
    assert kept.moves == list(zip((0.0, 2.5, 4.0), moves, strict=True))
    assert plan.seen[1] == ({"a": 26.0, "time_s": 2.5}, 30.0)


def test_a_session_is_a_loop_up_to_its_last_move() -> None:
    q, a = [2.0, 1.0, -0.5, 0.0, 0.0, 9.0, 9.0], [20.0, 25.0, 30.3, 30.1, 30.2, 10.0, 10.0]
    parts = {"q": (q, "1", "input"), "a": (a, "degC", "output"), "b": (a[::-1], "degC", "output")}
    parts |= {"t_ambient": ([21.0] * 7, "degC", "disturbance"), "target_a": ([30.0] * 7, "degC", "other")}
    times, drives = [10.0, 11.0, 13.0000003, 13.9999997], {"q": (-0.5, 2.0)}
    moves = [
        (at, Move(0.0, 1, status, status[:2], 0.1 * at))
        for at, status in zip(times, ("ok", "late", "off", "infeasible"), strict=True)
    ]
    log = make_log(np.arange(10.0, 17.0), {k: (np.array(v), *rest) for k, (v, *rest) in parts.items()})
    run = session_loop(log, moves, drive_range=drives)
    assert run.time.tolist() == run.sample_time.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert run.status == ("ok", "late", "fallback_plan", "off", "infeasible")  # a reading was rejected
    assert run.advice == ("ok", "la", "", "of", "in")
    assert run.seconds.tolist() == pytest.approx([1.0, 1.1, 1.3, 1.4])
    found = {name: values.tolist() for name, values in {**run.outputs, **run.drive}.items()}
    assert found == {"a": a[:5], "b": a[:1:-1], "q": q[:5]}
    assert run.readings is run.outputs
    assert (run.target["a"].tolist(), run.band, run.drive_range) == ([30.0] * 5, 0.25, drives)
    (part,) = run.segments
    assert (part.output, part.start, part.target, part.begin_s, part.end_s) == ("a", 20.0, 30.0, 0.0, 4.0)
    assert (part.settle_s, part.overshoot, part.bias) == pytest.approx((3.0, 0.3, 0.2))
    # shares of full drive 1, 0.5, -0.25, 0, 0 over 4 s; at an end of the range in two of four samples
    assert (part.energy_s, part.travel, part.full_share) == pytest.approx((1.3125 * 0.8, 1.5, 0.5))
    assert run.settled
    own = session_loop(log, moves, drive_range=drives, band=0.1, figures={"a": {"bias": 0.7}, "b": {}})
    assert (own.segments[0].bias, own.settled, own.band) == (0.7, False, 0.1)
    for count in (0, 1):
        with pytest.raises(ValueError, match=f"{count} moves are no loop"):
            session_loop(log, moves[:count], drive_range=drives)
    assert session_loop(log, moves[:2], drive_range=drives).time.tolist() == [0.0, 1.0]
