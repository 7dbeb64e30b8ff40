"""Logs on a grid: which step, which holes are bridged, where pieces end, what a driver makes of commands."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.log_files import read_log
from thermogrip.datasets.schema import Log, make_log
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.plant.log_grid import (
    Grid,
    Segment,
    at_rows,
    bridge,
    cut_stretches,
    dominant_time,
    inputs_off,
    make_grid,
    match_logs,
    misfit,
    moved_before,
    quantum,
    rows_of,
    signals,
    whole_readings,
)

T = np.arange(200.0)
TRIED = (1, 2, 3, 4, 5, 6, 8, 10, 12, 15, 20, 25, 30, 40, 50)


def log_of(y: Any, t: np.ndarray = T, q: Any = None, name: str = "a", **more: Any) -> Log:
    u = (np.arange(t.size) // 20 % 2).astype(float) if q is None else q
    return make_log(t, {"q": (u, "percent", "input"), "t": (y, "degC", "output")} | more, name=name)


def lagged(tau: float, n: int, dt: float = 1.0, hold: int = 200, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Return times, a random input held for ``hold`` rows, and what a lag of ``tau`` s makes of it."""
    q = np.repeat(np.random.default_rng(seed).random(n // hold + 1), hold)[:n]
    y, x = np.zeros(n), 0.0
    for k in range(n):
        y[k] = x
        x += (1 - np.exp(-dt / tau)) * (q[k] - x)
    return dt * np.arange(n), q, y


def slowest_of(logs: list[Log], *outputs: str) -> float:
    """Return the dominant time [s] of the outputs, ``t`` where none is named, driven by ``q``."""
    return dominant_time([rows_of(log, ["q"], outputs or ["t"], ()) for log in logs])


@pytest.mark.parametrize(("hole", "filled"), [(1, True), (5, True), (6, False)])
def test_holes_of_up_to_five_rows_are_bridged_each_output_on_its_own_line(hole: int, filled: bool):
    y = np.column_stack([2.0 * np.arange(20.0), 100 - 3 * np.arange(20.0)])
    broken = y.copy()
    broken[7 : 7 + hole, 0] = broken[10:12, 1] = broken[:2] = np.nan
    found = bridge(broken)
    assert np.isnan(found[:2]).all()  # before the first reading there is no line
    want = y if filled else np.column_stack([broken[:, 0], y[:, 1]])
    np.testing.assert_allclose(found[2:], want[2:])


def test_a_grid_ends_with_the_last_whole_row_and_begins_with_the_first_reading():
    y = T**2
    grid = make_grid([log_of(y)], average=4.0)
    (part,) = grid.segments
    assert part.time.tolist() == (4.0 * np.arange(50)).tolist()
    # a mean over two seconds to either side of the line through t^2 is (0 + 1 + 1 + 4 ...) / 4 above it
    np.testing.assert_allclose(part.y[1:-1, 0], (4.0 * np.arange(1, 49)) ** 2 + 1.5)
    assert part.y[0, 0] == 0.0
    with pytest.raises(UserError, match=r"averaging over 0.9 s is shorter than the sample time 1 s"):
        make_grid([log_of(y)], average=0.9)


def test_a_bin_without_a_reading_is_lost():
    y = T.copy()
    y[41:60] = np.nan
    other = np.where(T % 50 == 3, np.nan, T)
    grid = make_grid([log_of(y, t2=(other, "degC", "output"))], average=4.0)
    lost = np.isnan(grid.segments[0].y)
    assert lost[:, 0].tolist() == [44 <= t <= 56 for t in grid.segments[0].time]


# ---- what a grid says of itself ----


def test_every_signal_has_the_range_and_spread_of_its_own_readings():
    y, other, room = 20 + T / 10, np.where(T == 7, np.nan, -T), 5.0 + (T > 100)
    more = {
        "t2": (other, "degC", "output"),
        "room": (room, "degC", "disturbance"),
        "p": (3 * T, "A", "input"),
    }
    grid = make_grid([log_of(y, **more)], average=1.0)
    assert grid.ranges() == {
        "q": (0.0, 1.0), "p": (0.0, 597.0), "room": (5.0, 6.0), "t": (20.0, 39.9), "t2": (-199.0, 0.0),
    }  # fmt: skip
    np.testing.assert_allclose(grid.output_spread(), [y.std(), np.nanstd(other)])
    assert grid.units == {"q": "percent", "p": "A", "room": "degC", "t": "degC", "t2": "degC"}
    part = grid.segments[0].part(3, 6)
    assert part.time.tolist() == [3.0, 4.0, 5.0]
    assert part.d.shape == (3, 1)
    less = replace(grid, segments=(part,))
    assert (less.segments, less.inputs) == ((part,), grid.inputs)
    bare = Grid(("q",), (), ("t",), (), 1.0, (part,), 1.0, {})
    assert (bare.why, bare.ends) == ("", False)
    named = make_grid([log_of(y, **more)], inputs=["p"], outputs=["t"], disturbances=[], average=1.0)
    assert (named.inputs, named.outputs, named.disturbances) == (("p",), ("t",), ())
    assert (part.y[:, 0].tolist(), part.u[:, 1].tolist()) == (y[3:6].tolist(), [9.0, 12.0, 15.0])


def test_a_log_is_cut_behind_the_row_before_a_gap_and_named_once():
    t = np.concatenate([T[:50], T[:60] + 64.0, T[:20] + 134.0])  # of 15 s, then of 11 s
    log = log_of(t / 7, t, name="first")
    grid = make_grid([log, log_of(T, name="second")], average=1.0)
    ends = [(part.time[0], part.time[-1], part.log) for part in grid.segments]
    assert ends == [
        (0.0, 49.0, "first"), (64.0, 123.0, "first"), (134.0, 153.0, "first"), (0.0, 199.0, "second"),
    ]  # fmt: skip
    assert grid.logs == ("first", "second")
    assert len(make_grid([log], average=1.0, min_rows=20).segments) == 3  # of 20 rows is long enough
    assert len(make_grid([log], average=1.0, min_rows=21).segments) == 2


def test_the_sample_time_of_several_logs_is_their_median():
    slow = 4.0 * np.arange(60)
    logs = [log_of(slow, slow), log_of(T), log_of(T)]
    assert make_grid(logs, average=2.0).native == 1.0
    assert [part.time[1] for part in make_grid(logs, average=2.0).segments] == [2.0, 2.0, 2.0]


def test_uneven_rows_are_put_on_an_even_grid():
    t = T + 0.2 * (np.arange(200) % 10 == 5)  # the usual step is 1 s all the same
    (part,) = make_grid([log_of(3.0 * t, t)], average=1.0).segments
    np.testing.assert_allclose(part.time, t[0] + np.arange(part.time.size), atol=1e-9)
    np.testing.assert_allclose(part.y[1:-1, 0], 3.0 * part.time[1:-1], atol=1e-9)


@pytest.mark.parametrize("step", [3.0, 5.0, 4.0, 2.0])
def test_a_row_is_the_mean_of_the_line_through_the_readings_about_it(step: float):
    y, t = np.random.default_rng(1).normal(20.0, 1.0, T.size), T + 50.0
    (part,) = make_grid([log_of(y, t)], average=step).segments
    fine = np.linspace(-1.0, 1.0, 4001)[:-1] + 0.5 / 2000  # middles of 4000 slices
    half = np.minimum(step / 2, np.minimum(part.time - 50.0, 249.0 - part.time))  # the ends have less
    want = np.interp(part.time[:, None] + half[:, None] * fine, t, y).mean(axis=1)
    np.testing.assert_allclose(part.y[:, 0], want, atol=1e-5)


@pytest.mark.parametrize(("t", "average", "rows"), [
    (0.1 * np.arange(21), 0.3, 7),  # (2.0 + 0.1) / 0.3 falls short of 7 by rounding
    (T[:20] + 1.1, 1.0, 20),
    (T[:3] + 7.0, 1.0, 3),
    (T[:2] + 7.0, 1.0, 2),
])  # fmt: skip
def test_a_stretch_has_as_many_rows_as_steps_fit_into_it(t: np.ndarray, average: float, rows: int):
    (part,) = make_grid([log_of(t, t)], average=average, min_rows=2).segments
    np.testing.assert_allclose(part.time, t[0] + average * np.arange(rows))


@pytest.mark.parametrize("average", [1.0, 4.0])
def test_a_lone_row_between_gaps_is_no_stretch(average: float):
    t = np.concatenate([T[:50], [100.0], T[:50] + 150.0])
    grid = make_grid([log_of(t, t)], average=average, min_rows=2)
    assert [part.time[0] for part in grid.segments] == [0.0, 150.0]


@pytest.mark.parametrize(("longer", "jitter", "own"), [
    (5e-7, 0.0, True), (2e-6, 0.0, False), (0.0, 0.3, True), (0.0, 0.6, False)
])  # fmt: skip
def test_samples_stand_as_they_are_on_their_own_even_grid(longer: float, jitter: float, own: bool):
    """A step off by a millionth of 20 s, or steps that differ by 2 % of it, are the limits."""
    t = 20.0 * T + jitter * (T % 10 == 5) / 2  # a longer step before it, a shorter one behind
    y = T**2
    (part,) = make_grid([log_of(y, t)], average=20.0 * (1 + longer)).segments
    assert (part.y[:, 0].tolist() == y.tolist()) is own


def test_an_output_needs_two_readings_for_a_line_and_the_others_stand():
    logs = []
    for n in (1, 2):
        first, second = T.copy(), 3 * T
        first[n:] = np.nan
        logs.append(log_of(first, t2=(second, "degC", "output")))
    for part, known in zip(make_grid(logs, average=2.0).segments, (0, 2)):
        assert np.isfinite(part.y[:, 0]).sum() == known
        assert np.isfinite(part.y[:, 1]).all()


def test_one_reading_on_either_side_of_its_middle_keeps_a_row():
    y = T.copy()
    y[31:61] = np.nan
    y[39] = y[52] = 50.0  # before the middle of the row at 40 s, after that of the row at 50 s
    (part,) = make_grid([log_of(y)], average=5.0).segments
    lost = part.time[np.isnan(part.y[:, 0])]
    assert lost.tolist() == [35.0, 45.0, 55.0]


# ---- holes ----


def test_a_row_is_whole_where_all_its_outputs_are():
    y = np.column_stack([np.arange(200.0)] * 2)
    y[2::5, 0] = y[4::5, 1] = np.nan  # windows of three rows: none is whole in both, two of five in either
    none = np.zeros((200, 0))
    (found,) = whole_readings([Segment(T, y, none, none, "a")], 3)
    assert np.isfinite(found[5:-5]).all()


@pytest.mark.parametrize("lost", [1, 3])
def test_windows_at_either_end_count(lost: int):
    """Of three windows of three rows one is whole."""
    y = np.arange(5.0)[:, None]
    y[lost] = np.nan
    (found,) = whole_readings([Segment(T[:5], y, np.zeros((5, 0)), np.zeros((5, 0)), "a")], 3)
    assert found[:, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]


@pytest.mark.parametrize(("every", "filled"), [(5, True), (6, False), (8, False)])
def test_readings_are_bridged_where_most_windows_of_so_many_rows_are_broken(every: int, filled: bool):
    """One row in 6 lost leaves 3 of 6 windows of three rows, which is half; one in 5 leaves 2 of 5."""
    y = np.arange(200.0)[:, None]
    y[every // 2 :: every] = np.nan
    none, n = np.zeros((200, 0)), 24 * every + 2
    (found,) = whole_readings([Segment(T[:n], y[:n], none, none, "a")], 3)
    assert np.isfinite(found[7:-7]).all() == filled


# ---- signals ----


def test_roles_are_those_of_the_first_log_where_nothing_is_named():
    log = log_of(T, room=(T, "degC", "disturbance"), note=(T, "1", "other"))
    assert signals([log]) == (("q",), ("t",), ("room",))
    assert signals([log], outputs=["t", "room"]) == (("q",), ("t", "room"), ())
    assert signals([log], inputs=["room"]) == (("room",), ("t",), ())


def test_an_output_may_rest_in_one_log_if_it_moves_in_another():
    still = log_of(np.full(200, 20.0))
    assert signals([still, log_of(T)])[1] == ("t",)
    with pytest.raises(UserError, match="reads 20 whenever it reads"):
        signals([still, log_of(np.where(T < 9, np.nan, 20.0))])
    assert signals([still, log_of(np.full(200, 21.0))])[1] == ("t",)


def test_what_cannot_be_fitted_is_refused_by_name():
    room = (np.where(T == 3, np.nan, 20.0), "degC", "output")  # only a reading may be lost in a log
    for role in ("inputs", "disturbances"):
        with pytest.raises(UserError, match="room: is unknown in some rows"):
            signals([log_of(T, room=room)], outputs=["t"], **{role: ["room"]})
    assert signals([log_of(np.where(T == 3, np.nan, T))])[1] == ("t",)  # a reading may be lost
    with pytest.raises(UserError, match=r"no output among the columns; name it with --outputs"):
        signals([make_log(T, {"q": (T, "1", "input")})])
    counts = pd.DataFrame({"time_s": T, "q": T % 7, "adc": [f"0x{k:03x}" for k in range(T.size)]})
    with pytest.raises(UserError, match=r"adc is left out: its cells are no numbers \(0x000\); name"):
        signals([read_log(counts, inputs=["q"])])
    with pytest.raises(UserError, match=r"no input among the columns; name it with --inputs"):
        signals([make_log(T, {"t": (T, "degC", "output")})])
    still = {"t": (T, "degC", "other"), "number": (0 * T, "1", "other")}
    both = r"no input and no output .*; name them with --inputs and --outputs, of t; never moved: number$"
    with pytest.raises(UserError, match=both):
        signals([make_log(T, still)])
    with pytest.raises(UserError, match="no segment between gaps has 20 rows of 20 s"):
        make_grid([log_of(T)], average=20.0)
    mute = log_of(3.0 * T, name="b")
    mute["t"].values[:] = np.nan
    with pytest.raises(UserError, match=r"^b, column t: has no reading; leave the log out"):
        signals([log_of(T), mute])
    with pytest.raises(UserError, match="no log to identify from"):
        make_grid([])


def test_switches_are_shares_that_are_nought_or_one():
    on = (T > 50).astype(float)
    more = {"half": (0.5 * on, "1"), "s": (on, "1"), "c": (on, "0_255"), "a": (on, "A")}
    log = log_of(T, q=on, **{name: (*item, "input") for name, item in more.items()})
    assert make_grid([log], average=1.0).switches == ("s",)
    off = log_of(T, q=on, s=(0 * on, "1", "input"))
    assert make_grid([off], inputs=["q", "s"], average=1.0).switches == ("s",)  # off throughout
    alone = log_of(T, heater=(on, "1", "input"))
    assert make_grid([alone], inputs=["heater"], average=1.0).switches == ()  # a drive that is on or off


# ---- the step ----


@pytest.mark.parametrize("q", [0.0625, 0.25, 0.0488])
def test_a_staircase_with_steps_that_were_never_read_has_the_quantum_of_its_others(q: float):
    rng = np.random.default_rng(0)
    steps = np.concatenate([rng.integers(-10, 11, 500), [40, 41, 55, 90]])
    assert quantum(q * steps) == pytest.approx(q, abs=1e-6)
    assert quantum(np.round(q * steps, 3)) == pytest.approx(q, abs=1e-3)  # as a logger writes it
    assert quantum(np.where(steps == 3, np.nan, q * steps)) == pytest.approx(q, abs=1e-6)


def test_a_channel_without_steps_has_no_quantum():
    assert quantum(np.random.default_rng(0).normal(size=500)) == 0.0
    assert quantum(np.where(T > 100, 20.0, 21.0)) == 0.0  # two levels may be anything
    assert quantum(0.5 * (T % 3)) == 0.5
    assert quantum(0.5 * (T[:10] % 5)) == 0.5  # half as many levels as readings
    assert quantum(0.5 * (T[:9] % 5)) == 0.0


@pytest.mark.parametrize(("n", "dt"), [(4000, 1.0), (130, 20.0)])
def test_the_dominant_time_is_that_of_the_lag(n: int, dt: float):
    """Where rows are averaged, means reach half a step ahead, into another input: it costs a third."""
    tau = 300.0
    t, q, y = lagged(tau, n, dt, hold=max(1, round(200 / dt)))
    found = slowest_of([log_of(y, t, q)])
    assert found == pytest.approx(tau, rel=0.35 if n == 4000 else 0.01)


@pytest.mark.parametrize(("tau", "n", "found"), [
    (50.0, 22, 50.0),  # 20 rows with one before and one after them
    (50.0, 21, 20.0),  # a twentieth of 400 s
    (20.0 / 3.8, 130, 20.0 / 3.8),
    (20.0 / 4.0, 130, 129.0),  # less than 0.02 is left after a step
])  # fmt: skip
def test_a_time_constant_needs_twenty_rows_and_some_memory(tau: float, n: int, found: float):
    t, q, y = lagged(tau, n, 20.0, hold=2)
    few = np.where(t < 60.0, y, np.nan)  # another sensor does not keep it from being found
    log = log_of(y, t, q, few=(few, "degC", "output"))
    assert slowest_of([log], "few", "t") == pytest.approx(found, rel=1e-6)


def test_an_integrator_has_no_time_constant():
    t, q, _ = lagged(1.0, 130, 20.0, hold=4)
    whole = np.append(0.0, np.cumsum(q - 0.4)[:-1])
    assert slowest_of([log_of(whole, t, q)]) == 129.0


def test_of_several_logs_the_dominant_time_is_the_median():
    logs = []
    for tau in (100.0, 300.0, 320.0):
        t, q, y = lagged(tau, 130, 20.0, hold=10)
        logs.append(log_of(y, t, q))
    assert slowest_of(logs) == pytest.approx(300.0, rel=0.01)


def test_a_slow_drift_of_the_reading_does_not_pass_for_the_plants_own_time():
    rng = np.random.default_rng(4)
    t, q, y = lagged(60.0, 8000, hold=100)
    slow = np.zeros(t.size)
    for k in range(1, t.size):
        slow[k] = 0.998 * slow[k - 1] + rng.normal(0.0, 0.1 * np.sqrt(1 - 0.998**2))
    found = slowest_of([log_of(y + slow, t, q)])
    assert found == pytest.approx(60.0, rel=0.25)  # 500 s is the correlation time of the drift


def test_lost_readings_do_not_hide_the_dominant_time():
    t, q, y = lagged(300.0, 4000)
    y[np.random.default_rng(0).random(t.size) < 0.2] = np.nan
    y[1000:1400] = np.nan
    found = slowest_of([log_of(y, t, q)])
    whole = slowest_of([log_of(lagged(300.0, 4000)[2], t, q)])
    assert found == pytest.approx(whole, rel=0.03)


def test_a_log_that_identifies_no_time_constant_counts_for_a_twentieth_of_its_length():
    still = log_of(np.random.default_rng(0).normal(size=200), q=np.full(200, 0.5))
    assert slowest_of([still, log_of(T[:10], T[:10])]) == 199 / 20


def coarse(y: np.ndarray, q: float) -> np.ndarray:
    return q * np.round(y / q)


def longest_below(y: np.ndarray, q: float) -> int:
    """Return the longest step in which a reading that is not yet rounded moves by less than q (rms)."""
    moves = {n: np.sqrt(np.mean(np.diff(y[::n]) ** 2)) for n in TRIED}
    return max(n for n in TRIED if all(moves[k] < q for k in TRIED if k <= n))


@pytest.mark.parametrize(
    ("tau", "n", "gain", "want", "dt"),
    [
        (100.0, 3000, 10.73, 2, 1.0),
        (100.0, 3000, 7.36, 3, 1.0), (100.0, 3000, 5.94, 4, 0.5), (100.0, 3000, 4.79, 5, 1.0),
        (100.0, 3000, 3.86, 6, 2.0), (100.0, 3000, 2.95, 8, 1.0), (150.0, 4000, 3.29, 10, 1.0),
        (150.0, 4000, 2.8, 12, 0.5), (400.0, 12_000, 5.63, 15, 1.0), (400.0, 12_000, 4.3, 20, 1.0),
        (400.0, 12_000, 3.47, 25, 1.0), (400.0, 12_000, 2.5, 30, 1.0), (600.0, 14_000, 3.11, 40, 1.0),
        (600.0, 14_000, 1.18, 50, 1.0),
    ],
)  # fmt: skip
def test_a_coarse_converter_asks_for_the_longest_step_that_moves_by_less_than_its_quantum(
    tau: float, n: int, gain: float, want: int, dt: float
):
    t, u, y = lagged(tau, n)
    log = log_of(coarse(gain * y, 0.0625), dt * t, u)
    assert longest_below(gain * y, 0.0625) == want
    assert tau / 75 < want < tau / 10  # above a hundredth of the time constant, below a tenth
    grid = make_grid([log])
    assert (grid.dt, grid.why) == (want * dt, "t moves less than its converter's 0.0625 in shorter steps")


def test_a_step_that_happens_to_be_a_period_is_not_asked_for():
    t = np.arange(3000.0)
    log = log_of(coarse(5 * np.sin(t * np.pi / 10), 0.25), t, 0.5 + 0.5 * np.cos(t * np.pi / 10))
    assert make_grid([log]).dt == 1.0


def test_the_coarsest_log_and_the_moves_of_all_logs_count():
    t, u, y = lagged(400.0, 12_000)
    fine, rough = log_of(5.0 * y, t, u), log_of(coarse(5.0 * y, 0.0625), t, u)
    want = longest_below(5.0 * y, 0.0625)
    for logs in ([fine, rough], [rough, fine], [rough, rough, rough]):
        assert make_grid(logs).dt == want
    # one that moves three times as much beside two that hardly do: the rms is between
    logs = [log_of(coarse(g * y, 0.0625), t, u) for g in (9.0, 2.0, 2.0)]
    assert make_grid(logs).dt == longest_below(np.sqrt(89 / 3) * y, 0.0625)


def test_a_step_is_held_at_a_tenth_of_the_time_constant():
    t, u, y = lagged(100.0, 12_000)
    grid = make_grid([log_of(coarse(1.0 * y, 0.0625), t, u)])
    assert longest_below(y, 0.0625) > 11
    assert grid.dt == pytest.approx(10.0, abs=1.0)
    assert "moves less than its converter's" in grid.why
    assert "; held at" in grid.why


def test_a_fine_log_says_which_rule_set_its_step():
    t, u, y = lagged(400.0, 12_000)
    grid = make_grid([log_of(y, t, u)])
    slowest = slowest_of([log_of(y, t, u)])
    assert grid.dt == round(slowest / 100)
    assert grid.why == f"a hundredth of the dominant time constant, {slowest:.3g} s"
    assert "held" not in grid.why
    after_weeks = make_grid([log_of(y, t + 1e7 * (t > t[-1] / 2), u)])  # of which nothing was recorded
    assert after_weeks.dt == pytest.approx(grid.dt, rel=0.2)
    slow = make_grid([log_of(y[::10], t[::10], u[::10])])
    assert (slow.dt, slow.why) == (10.0, "the logs' own")
    assert make_grid([log_of(y, t, u)], average=7.0).why == "asked for"
    thirds = make_grid([log_of(y, 0.3 * t, u)])  # 120 s: of rows of 0.3 s, 4 are 1.2 s
    assert thirds.dt == pytest.approx(0.3 * round(slowest / 100))


# ---- the grid of a free run ----


def chamber(pwm: Any, t: np.ndarray) -> Log:
    still = np.full(t.size, 22.0)
    model = load_network("peltier_chamber")
    columns = {"pwm": (pwm, "0_255", "input")}
    columns |= dict.fromkeys(model.disturbances, (still, "degC", "disturbance"))
    columns |= dict.fromkeys(model.outputs, (still, "degC", "output"))
    return make_log(t, columns)


def test_a_driver_drops_what_lies_behind_its_step():
    plant, t = prior_plant(load_network("peltier_chamber")), np.arange(0.0, 20.0)
    assert plant.dt == 1.0
    pwm = np.array([0.0, 0.3, 17.99, 18.0, 18.6, 200.999, 3 * 0.1 * 10, 54.99999999999999, -0.6, -18.6])
    pwm = np.concatenate([pwm, np.full(10, 5.0)])
    (found,) = cut_stretches(plant, chamber(pwm, t))
    assert found.u[:10, 0].tolist() == [0.0, 0.0, 17.0, 18.0, 18.0, 200.0, 3.0, 55.0, 0.0, -18.0]


def test_inputs_that_end_at_their_rows_are_moved_by_one_and_nothing_else_is():
    plant, t = prior_plant(load_network("peltier_chamber")), np.arange(0.0, 40.0, 2.0)
    log = chamber(np.arange(20.0) ** 2, t)
    room = plant.disturbances[0]
    log[room].values[:] = 20.0 + np.arange(20.0) ** 2
    before, (plain,) = log.copy(deep=True), cut_stretches(plant, log)
    (found,) = cut_stretches(replace(plant, inputs_end_at_row=True), log)
    # rows of 2 s on a grid of 1 s; after the last row the last value stays
    assert found.u[:, 0].tolist() == [k**2 for k in (*range(1, 20), 19) for _ in "ab"][: len(found.u)]
    np.testing.assert_array_equal(found.d, plain.d)
    np.testing.assert_array_equal(found.y, plain.y)
    assert log.identical(before)
    names = {"inputs": plant.inputs, "disturbances": (room,), "outputs": plant.outputs[:1]}
    log[plant.outputs[0]].values[:] += np.arange(20.0)
    grid = make_grid([log], **names, average=2.0, ends=True)
    assert grid.ends
    assert grid.segments[0].u[:, 0].tolist() == [k**2 for k in (*range(1, 20), 19)]


def heater(**more: Any) -> Any:
    """A plant of one input and one output, of steps of 2 s."""
    model = SimpleNamespace(smooth=more.pop("smooth", 0.0), command_steps=more.pop("command_steps", {}))
    roles: dict[str, Any] = {
        "inputs": ("q",),
        "outputs": ("t",),
        "disturbances": (),
        "inputs_end_at_row": False,
        "units": {},
    }
    plant = SimpleNamespace(dt=2.0, model=model, **roles)
    vars(plant).update(more)
    return plant


@pytest.mark.parametrize(
    ("smooth", "unit", "want"),
    [
        (
            6.0,
            "degC",
            [14 / 4, 55 / 6, 139 / 6, 271 / 6, 230 / 4],
        ),  # means of k^2 over 3 s to either side of 1, 3 ..
        (0.5, "degC", [0.5, 6.5, 20.5, 42.5, 72.5]),  # no less than the step
        (6.0, "1", [0.5, 6.5, 20.5, 42.5, 72.5]),  # a lamp acts when it changes
    ],
)
def test_a_disturbance_is_smoothed_about_the_middle_of_each_step(smooth: float, unit: str, want: list[float]):
    t = T[:10]
    log = log_of(t, t + 3.0, room=(t**2, unit, "disturbance"))
    (found,) = cut_stretches(heater(disturbances=("room",), smooth=smooth, units={"room": unit}), log)
    np.testing.assert_allclose(found.d[:, 0], want)


def test_gaps_may_be_held_and_steps_are_as_many_as_reach_the_last_row():
    t = np.concatenate([T[:16], T[:5] + 60.0, [90.0]]) + 1.1  # the fifteenth second is 2e-15 s late
    log = log_of(t, t)
    found = cut_stretches(heater(dt=1.0), log)
    assert [(len(part.u), part.gap) for part in found] == [(15, 0.0), (4, pytest.approx(45.0)), (1, 26.0)]
    (whole,) = cut_stretches(heater(dt=1.0), log, gaps="hold")
    assert (len(whole.u), whole.time[-1]) == (90, pytest.approx(90.0))


@pytest.mark.parametrize("name", ["q", "room"])
def test_a_run_needs_every_input_and_room_for_its_grid(name: str, monkeypatch: pytest.MonkeyPatch):
    log = log_of(T[:9], 2 * T[:9], room=(3 * T[:9], "degC", "disturbance"))
    plant = heater(disturbances=("room",))
    room = 4 * 8 * 8 * 3  # four arrays of 8 bytes, 8 steps and three signals
    monkeypatch.setattr("thermogrip.sysid.plant.log_grid.MOST_BYTES", room)
    assert len(cut_stretches(plant, log)[0].u) == 8
    monkeypatch.setattr("thermogrip.sysid.plant.log_grid.MOST_BYTES", room - 1)
    with pytest.raises(UserError, match="a: would be simulated in 8 steps of 2 s; cut the log, or use"):
        cut_stretches(plant, log)
    log[name].values[4] = np.nan
    with pytest.raises(UserError, match=f"a, column {name}: is unknown in some rows; fill or cut them"):
        cut_stretches(plant, log)


def test_rows_between_steps_are_on_the_line_between_them():
    plant, t = prior_plant(load_network("peltier_chamber")), np.array([0.0, 1.5, 2.5, 7.0, 30.0, 31.0, 33.0])
    log = chamber(np.zeros(7), t)
    first, second = cut_stretches(plant, log)
    assert (first.gap, second.gap) == (0.0, 23.0)
    run = np.arange(0.0, 12.0)[None, :, None] ** 2  # at 0, 2, 4 ... s
    np.testing.assert_allclose(at_rows(first, run, 2.0)[0, :, 0], [0.0, 0.75, 1.75, 9 + 0.5 * 7])
    late = replace(first, time=np.array([0.0, 21.0, 22.0, 23.0, 99.0]))  # the run ends at 22 s
    assert at_rows(late, run, 2.0)[0, :, 0].tolist() == [0.0, 110.5, 121.0, 121.0, 121.0]


@pytest.mark.parametrize(
    ("unit", "want", "valid", "largest", "made"),
    [
        ("percent", "1", (-1.0, 1.0), 60.0, 0.6),
        ("percent", "1", (0.0, 80.0), 60.0, None),  # the plant's 1 is no share
        ("percent", "1", (-80.0, 0.0), 60.0, None),
        ("percent", "1", (0.0, 1.1), 60.0, None),
        ("percent", "1", (0.0, 1 + 5e-10), 60.0, 0.6),
        ("percent", "1", (0.0, 1 + 1.5e-9), 60.0, None),
        ("percent", "1", None, 60.0, 0.6),
        ("1", "percent", (0.0, 100.0), 1 + 5e-10, 100 + 5e-8),
        ("1", "percent", (0.0, 100.0), 1 + 1.5e-9, 1 + 1.5e-9),
        ("1", "percent", (0.0, 100.0), 0.6, 60.0),
        ("1", "percent", (0.0, 100.0), 1.0, 100.0),
        ("1", "percent", (0.0, 100.0), 1.1, 1.1),
        ("1", "percent", (0.0, 100.0), 60.0, 60.0),  # has no unit, and is no share
        ("percent", "0_255", (0.0, 255.0), 60.0, 153.0),
        ("percent", "W", (0.0, 1.0), 60.0, None),
        ("W", "1", (0.0, 1.0), 0.6, None),
        ("W", "W", (0.0, 9.0), 6.0, 6.0),
        ("1", "W", (0.0, 9.0), 6.0, 6.0),
    ],
)
def test_a_drive_is_converted_where_both_units_are_shares_of_full_scale(
    unit: str, want: str, valid: tuple[float, float] | None, largest: float, made: float | None
):
    drive = np.where(T < 100, 0.0, largest)
    model: Any = SimpleNamespace(
        inputs=("q",), disturbances=(), outputs=("t",), units={"q": want, "t": "degC"}
    )
    if valid:
        model.valid = {"q": valid}
    log = make_log(T, {"q": (drive, unit, "input"), "t": (0 * T, "degC", "output")})
    if made is None:
        said = f"is in '{unit}', the plant's is in '{want}'.*convert it"
        with pytest.raises(UserError, match=said) as fault:
            match_logs(model, [log])
        assert ("leave the unit away" in str(fault.value)) is (want == "1")
    else:
        (matched,), said = match_logs(model, [log])
        np.testing.assert_allclose(matched["q"].values.max(), made, rtol=1e-12)
        assert matched["q"].attrs["units"] == want
        assert len(said) == (unit != want)


def bare(**units: str) -> Any:
    """A model of the signals of the logs here."""
    return SimpleNamespace(inputs=("q", "p"), disturbances=("room",), outputs=("t",), units=units)


def test_what_was_converted_is_reported_once_and_columns_take_the_models_roles():
    columns = {"q": (T, "1"), "p": (T / 2, "1"), "room": (T, "K"), "t": (0 * T, "1"), "n": (T, "s")}
    log = make_log(T, {name: (*item, "input") for name, item in columns.items()})
    log["t"].values[:] = np.nan
    model = bare(q="W", p="percent", t="degC")
    said = ["q: has no unit, taken as W", "p: has no unit and values up to 99.5, taken as percent",
            "t: has no unit, taken as degC"]  # fmt: skip
    for keep, note in ((False, "other"), (True, "input")):
        (got, again), lines = match_logs(model, [log, log], keep_others=keep)
        assert lines == said
        assert [got[name].attrs["role"] for name in columns] == [
            "input",
            "input",
            "disturbance",
            "output",
            note,
        ]
        assert [got[name].attrs["units"] for name in columns] == ["W", "percent", "K", "degC", "s"]
        assert got.identical(again)
    assert match_logs(model, [got], keep_others=True)[0][0] is got
    (matched,), lines = match_logs(bare(), [log])  # nothing to convert, but its roles
    assert (lines, matched["room"].attrs["role"], log["room"].attrs["role"]) == ([], "disturbance", "input")
    assert match_logs(model, []) == ([], [])
    assert match_logs(bare(p="percent"), [log.assign(p=log["p"] / 100)])[1] == [
        "p: converted from 1 to percent"
    ]


@pytest.mark.parametrize(
    ("ranges", "switches", "beside", "off"),
    [
        ({"q": (0, 9), "p": (0, 100)}, (), {}, ["p"]),
        ({"q": (0, 9), "p": (5, 100)}, (), {}, []),  # it cannot be 0
        ({"q": (0, 9)}, (), {}, []),  # nothing is known of its range
        ({"q": (0, 9), "p": (0, 1)}, ("p",), {}, []),  # a pump that is not logged may well run
        ({"q": (0, 9), "p": (0, 100)}, (), {"heater": (T, "1", "input")}, []),  # may be p by another name
        ({"q": (0, 9), "p": (0, 100)}, (), {"heater": (T, "1", "other")}, ["p"]),
    ],
)
def test_an_input_that_a_log_lacks_is_off_where_nothing_else_can_be_it(ranges, switches, beside, off):
    model = bare(p="percent")
    model.valid, model.switches = ranges, switches
    log = log_of(T, room=(T, "degC", "disturbance"), **beside)
    assert inputs_off(model, log) == off
    assert (misfit(model, log) is None) is bool(off)
    if off:
        (matched,), lines = match_logs(model, [log])
        assert lines == ["p: no such column, taken as 0 percent throughout"]
        assert (matched["p"].attrs["role"], np.ptp(matched["p"].values), "p" in log) == ("input", 0.0, False)
    assert inputs_off(model, log.drop_vars("q")) == []  # no input at all is another log


def test_a_drive_that_was_on_before_the_log_is_named_and_a_room_is_not():
    room, t, still = (25.0 + 0 * T, "degC"), (T, "degC", "output"), 50.0 + 0 * T
    log = make_log(T, {"t_room": (*room, "other"), "Q1": (still, "percent", "other"), "t": t})
    assert moved_before(log) == (
        "; if Q1 was not 50 before, write a row with its value of then above the first"
    )
    assert moved_before(log.assign(Q1=log["Q1"] * 0)) == ""
    assert moved_before(log.drop_vars("Q1")) == ""
    with pytest.raises(UserError, match=r"no input among the columns; .*if Q1 was not 50 before"):
        signals([log])


def test_a_log_that_does_not_fit_is_refused_by_what_it_lacks():
    log = log_of(T, p=(T, "1", "input"), room=(T, "degC", "disturbance"))
    assert misfit(bare(), log) is None
    lost = misfit(bare(), log.drop_vars(["p", "t"]))
    assert str(lost) == "a: has no input p, no output t; its columns are q, room"
    assert "is in 'percent', the plant's is in 'W'" in str(misfit(bare(q="W"), log))


def test_a_log_that_shows_no_move_over_a_step_says_nothing_of_it():
    t = np.arange(30.0)
    y = 25 + 0.1 * (t % 7 == 0) + 0.1 * (t % 5 == 0)
    y[2:-2] = np.nan
    drive, t_tank = (1.0 * (t > 5), "1", "input"), (y, "degC", "output")
    assert make_grid([make_log(t, {"drive": drive, "t_tank": t_tank})]).native == 1.0
