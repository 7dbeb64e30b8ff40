"""Optimal excitation: known answers, limits that are met, and expected information that fits confirm."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from tests.sysid.experiment.makers import heated_block
from thermogrip.cli.excite import optimal_for, schedule_for
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, make_log
from thermogrip.sysid.experiment import optimal
from thermogrip.sysid.experiment.information import (
    ExperimentForecast,
    interval_widths,
    plant_from_prior,
)
from thermogrip.sysid.experiment.optimal import Expectation, expect, inputs_of, optimal_schedule
from thermogrip.sysid.greybox.fit import fit_network
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.fit_record import PlantScores
from thermogrip.sysid.plant.plant import Plant


@pytest.fixture(scope="module")
def block() -> Plant:
    return heated_block()


@pytest.fixture(scope="module")
def boards() -> Plant:
    """Two heaters that differ from the prior medians, whose residuals repeat themselves for 20 s."""
    plant = plant_from_prior(load_network("tclab"))
    values = plant.values | {"G_amb": 0.013, "power_1": 1.2, "lag_1": 15.0, "G_between": 0.005}
    return replace(
        plant, values=values, scores=PlantScores(independent_s={"t1": 20.0, "t2": 20.0}, average_s=5.0)
    )


def test_constant_full_input_is_best_where_only_the_gain_is_unknown(block):
    log = optimal_schedule(block, 20.0, ranges=block.valid, evaluations=100)
    q = log["q"].values
    assert np.all(q[:6] == 0.0)  # at rest, so that the start is known
    np.testing.assert_array_equal(q[6:], 100.0)


def test_twice_the_experiment_is_the_same_experiment_read_twice_as_well(boards):
    u = inputs_of(boards, schedule_for(boards, "prbs", 20.0, lowest=5.0, highest=90.0, seed=0)[0])
    sharper = replace(boards, scores=PlantScores(independent_s={"t1": 10.0, "t2": 10.0}, average_s=5.0))
    P = np.linalg.inv(np.asarray(boards.covariance))
    once, twice = (np.linalg.inv(ExperimentForecast(plant).covariance(u)) - P for plant in (boards, sharper))
    np.testing.assert_allclose(twice, 2 * once, rtol=1e-6, atol=1e-6 * np.abs(once).max())


@pytest.fixture(scope="module")
def designs(boards):
    """Plain schedules and the optimal one for 20 min, and what is expected of them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(optimal, "EVALUATIONS", 600)
        best, expected, notes = optimal_for(boards, 20.0, lowest=5.0, highest=90.0, slew=np.inf, seed=0)
    assert not notes
    prbs, _ = schedule_for(boards, "prbs", 20.0, lowest=5.0, highest=90.0, seed=0)
    return {"prbs": prbs, "optimal": best}, expected


def test_the_optimal_schedule_informs_more_than_every_plain_one(designs):
    _, expected = designs
    for kind in ("prbs", "multisine", "staircase"):
        assert expected.bits["optimal"] > expected.bits[kind] + 3.0  # measured: 5 to 6 bits
        assert expected.determinant_ratio("optimal", kind) > 64.0
    assert expected.narrower("optimal", "now") == pytest.approx(2 ** (expected.bits["optimal"] / 7))


def _noise(rng: np.random.Generator, n: int, tau: float, sd: float) -> np.ndarray:
    """Return AR(1) noise at 1 s that repeats itself tau-fold: (1 + phi) / (1 - phi) = tau."""
    phi = (tau - 1) / (tau + 1)
    drive = np.sqrt(1 - phi**2) * rng.standard_normal(n)
    drive[0] /= np.sqrt(1 - phi**2)
    return sd * lfilter([1.0], [1.0, -phi], drive)


def _run(boards: Plant, kind: str, seed: int, u: np.ndarray, y: np.ndarray) -> Log:
    rng = np.random.default_rng(seed)
    columns = {name: (u[:, k], "percent", "input") for k, name in enumerate(boards.inputs)}
    for k, name in enumerate(boards.outputs):
        columns[name] = (y[:, k] + _noise(rng, len(u), 20.0, 0.4), "degC", "output")
    return make_log(np.arange(float(len(u))), columns, name=f"{kind} {seed}")


@settings(max_examples=6, deadline=None)
@given(
    highest=st.floats(40.0, 90.0),
    most=st.floats(20.0, 100.0),
    slew=st.sampled_from([np.inf, 0.05, 0.01]),
    seed=st.integers(0, 99),
)
def test_limits_hold_for_the_plant_and_its_draws(highest, most, slew, seed):
    plant = plant_from_prior(load_network("tclab"))
    plant = replace(plant, covariance=0.04 * np.asarray(plant.covariance))
    ranges = {"q1": (0.0, most), "q2": (5.0, 60.0)}
    log = optimal_schedule(
        plant, 10.0, ranges=ranges, highest=highest, slew=slew, seed=seed, evaluations=40, shortest=15.0
    )
    u = inputs_of(plant, log)
    for k, (low, high) in enumerate(ranges.values()):
        assert low - 1e-12 <= u[:, k].min() <= u[:, k].max() <= high + 1e-12
        assert np.abs(np.diff(u[:, k])).max() <= slew * (high - low) * plant.dt + 1e-9
    assert ExperimentForecast(plant).outputs(u).max() <= highest
    for k in range(1, 9):  # the same as one draw after the other
        assert ExperimentForecast(plant.draw(k), draws=0).outputs(u)[0].max() <= highest + 1e-9


def test_a_pump_is_switched_and_does_not_stutter():
    plant = plant_from_prior(load_network("gripper"))
    log = optimal_schedule(
        plant, 10.0, ranges={"drive": (-1.0, 1.0)}, highest=60.0, evaluations=60, switch_hold=45.0
    )
    pump = log["pump"].values
    assert set(pump) == {0.0, 1.0}
    edges = np.flatnonzero(np.diff(pump))
    assert np.diff(edges).min() * plant.dt >= 45.0
    held = optimal_schedule(
        plant, 10.0, ranges={"drive": (-1.0, 1.0)}, highest=60.0, evaluations=20, hold=["pump"]
    )
    assert set(held["pump"].values) == {1.0}
    assert np.ptp(held["drive"].values) > 0.5


def test_a_schedule_is_the_same_with_the_same_seed(boards):
    first, again, other = (
        optimal_schedule(boards, 10.0, ranges=boards.valid, evaluations=30, seed=seed) for seed in (3, 3, 4)
    )
    assert first.identical(again)
    assert not first.identical(other)


def test_what_cannot_be_designed_is_refused(boards, block):
    black = StateSpaceModel(("q",), (), ("t",), A=[[0.9]], B=[[4.0]], C=[[1.0]], dt=10.0)
    plant = Plant(black, {}, dt=10.0, units={"q": "percent", "t": "degC"}, noise={"t": 0.1})
    with pytest.raises(UserError, match="no covariance"):
        expect(plant, {"x": make_log([0.0, 10.0], {"q": ([0.0, 1.0], "percent", "input")}, name="x")})
    with pytest.raises(UserError, match=r"no schedule keeps the plant and 8 draws"):
        optimal_schedule(block, 20.0, ranges=block.valid, lowest=30.0, evaluations=5)
    with pytest.raises(UserError, match="not finite"):
        ExperimentForecast(replace(block, covariance=np.full((1, 1), np.nan)), draws=0).bits(np.ones((60, 1)))
    with pytest.raises(UserError, match="cannot hold"):
        optimal_schedule(block, 20.0, ranges=block.valid, hold=["q"])
    with pytest.raises(UserError, match="too short"):
        optimal_schedule(block, 0.1, ranges=block.valid)
    with pytest.raises(UserError, match="no such input"):
        inputs_of(block, make_log([0.0, 1.0], {"pump": ([0.0, 1.0], "1", "input")}, name="x"))


def test_a_design_at_the_prior_medians_is_better_where_the_truth_is_another():
    plant = plant_from_prior(load_network("tclab"))
    best, _, _ = optimal_for(plant, 30.0, lowest=5.0, highest=80.0, slew=np.inf, seed=0)
    prbs, _ = schedule_for(plant, "prbs", 30.0, lowest=5.0, highest=80.0, seed=0)
    for k in range(1, 9):  # measured: 4 to 7 bits
        truth = ExperimentForecast(plant.draw(k), draws=0)
        assert truth.bits(inputs_of(plant, best)) > truth.bits(inputs_of(plant, prbs)) + 3.0


def _before_and_after(boards: Plant, u: dict[str, np.ndarray], y: dict[str, np.ndarray], count: int):
    """Return fits to a PRBS, and the sd (count, n_free) that fits to that and the optimal schedule state."""
    before, after = [], []
    for seed in range(count):
        logs = [
            _run(boards, kind, at + seed, u[kind], y[kind]) for kind, at in (("prbs", 0), ("optimal", 100))
        ]
        before.append(fit_network(boards.model, logs[:1]))
        after.append(np.sqrt(np.diag(np.asarray(fit_network(boards.model, logs).covariance))))
    return before, np.array(after)


@pytest.fixture(scope="module")
def kept(boards, designs):
    """Schedules, four fits before the optimal one and what those after it state."""
    u = {kind: inputs_of(boards, log) for kind, log in designs[0].items()}
    y = {kind: ExperimentForecast(boards, draws=0).outputs(row)[0][:-1] for kind, row in u.items()}
    return u, *_before_and_after(boards, u, y, 4)


# the same algebra, with error and values learnt anew from twice the data: tau of some 480 bins is
# known to sqrt(2 * 13 / 480) = 0.23, so a standard deviation to 0.12, and the mean of four to 0.06
ONE = 0.12
TOLERANCE = 4 * ONE / np.sqrt(4)


def _mean_ratios(forecasts: list[ExperimentForecast], u: np.ndarray, stated: np.ndarray) -> np.ndarray:
    expected = [np.sqrt(np.diag(forecast.covariance(u))) for forecast in forecasts]
    return np.asarray(np.exp(np.mean(np.log(stated / expected), axis=0)))


def test_the_forecast_is_right_for_each_parameter(kept):
    u, before, stated = kept
    forecasts = [ExperimentForecast(plant, draws=0) for plant in before]
    np.testing.assert_allclose(_mean_ratios(forecasts, u["optimal"], stated), 1.0, atol=TOLERANCE)
    now = np.sqrt([np.diag(np.asarray(plant.covariance)) for plant in before])
    assert np.median(stated / now) < np.sqrt(0.5)  # more than the same experiment once more would bring


@pytest.mark.parametrize(
    ("forgotten", "where"),
    [("the model discrepancy", "t_room"), ("what the warm-up shows of the start", "lag_2")],
)
def test_a_forecast_without_what_a_fit_knows_is_wrong(kept, forgotten, where):
    u, before, stated = kept
    forecasts = [ExperimentForecast(plant, draws=0) for plant in before]
    for forecast in forecasts:
        if "discrepancy" in forgotten:
            forecast.__dict__["_error"] = replace(forecast._error, terms=(), pull=np.zeros((7, 0)))
        else:
            forecast._warm_up = lambda rows: 0.0
    ratio = _mean_ratios(forecasts, u["optimal"], stated)[before[0].free.index(where)]
    assert abs(ratio - 1.0) > TOLERANCE


def test_square_waves_of_several_inputs_are_tried_together_and_a_quarter_apart():
    def shapes(n):
        low, high = np.zeros(n), np.ones(n)
        limits = SimpleNamespace(n_cell=8, low=low, high=high, switch=low > high)
        return [x.T.astype(int).tolist() for x in optimal._plain_shapes(limits)]

    wave, later = [1, 1, 1, 1, 0, 0, 0, 0], [1, 1, 0, 0, 0, 0, 1, 1]
    assert (len(shapes(1)), len(shapes(2))) == (2 + 4, 2 + 8)
    assert shapes(2)[:4] == [[[1] * 8] * 2, [[0] * 8] * 2, [wave, wave], [wave, later]]


def frame(
    minutes: float = 20.0, shortest: float = 10.0, hold: tuple[str, ...] = (), slew: float = np.inf, **ranges
):
    """A drive from -2 to 3 and a pump that keeps its position for 25 s, on steps of 1 s."""
    plant = SimpleNamespace(dt=1.0, inputs=("q", "pump"), model=SimpleNamespace(switches=("pump",)))
    return optimal._Frame(plant, minutes, {"q": (-2.0, 3.0)} | ranges, shortest, 25.0, slew, hold)


@pytest.mark.parametrize(
    ("said", "n", "ratio", "cell", "n_cell", "together"),
    [
        ({}, 1200, 1, 10, 120, [1, 3]),  # (1200 - 6) / 10, in tens of seconds
        ({"minutes": 60.0}, 3600, 4, 4, 225, [1, 2]),  # 15 s in steps of 4 s; 3594 / 16
        ({"minutes": 60.0, "shortest": 5.0}, 3600, 4, 4, 225, [1, 2]),  # no more than 240
        ({"shortest": 0.2}, 1200, 1, 5, 239, [1, 5]),
        ({"minutes": 60.0, "shortest": 6.0, "hold": ("pump",)}, 3600, 4, 4, 225, [1, 1]),
        ({"minutes": 16 / 60, "shortest": 4.0}, 16, 1, 4, 3, [1, 7]),
    ],
)
def test_a_schedule_is_cut_into_cells(said, n, ratio, cell, n_cell, together):
    found = frame(**said)
    assert (found.n, found.ratio, found.dt, found.cell, found.n_cell) == (
        n,
        ratio,
        float(ratio),
        cell,
        n_cell,
    )
    assert (found.rest, found.together.tolist(), found.still.tolist()) == (6, together, [0.0, 1.0])
    held = "hold" in said
    assert (found.low.tolist(), found.high.tolist()) == ([-2.0, 1.0 if held else 0.0], [3.0, 1.0])
    assert found.switch.tolist() == [False, not held]


def test_a_range_without_nought_rests_at_its_nearer_end_and_nothing_to_move_is_refused():
    assert frame(q=(0.5, 3.0)).still.tolist() == [0.5, 1.0]
    assert frame(q=(-2.0, -1.0), hold=("q",)).low.tolist() == [-1.0, 0.0]
    with pytest.raises(UserError, match="no input has a range to move in"):
        frame(q=(1.0, 1.0), hold=("pump",))
    with pytest.raises(UserError, match=r"0.25 min are too short; take 0.3"):
        frame(minutes=0.25)


def test_cells_become_rows_and_rows_cells():
    wide = frame(minutes=60.0)
    cells = np.column_stack([np.linspace(-2, 3, 225), np.repeat(np.arange(113) % 2, 2)[:225]])
    fine, coarse = wide.inputs(cells, coarse=False), wide.inputs(cells, coarse=True)
    assert (fine.shape, coarse.shape) == ((3600, 2), (900, 2))
    assert fine[:6].tolist() == [[0.0, 1.0]] * 6
    assert coarse[:2].tolist() == [[0.0, 1.0]] * 2
    for k in (0, 7, 223):
        assert fine[6 + 16 * k : 22 + 16 * k].tolist() == [cells[k].tolist()] * 16
        assert coarse[2 + 4 * k : 6 + 4 * k].tolist() == [cells[k].tolist()] * 4
    np.testing.assert_array_equal(wide.to_cells(fine), cells)
    beyond = wide.to_cells(fine * [9.0, 0.6])  # inside the range; a switch is one or nought
    np.testing.assert_allclose(beyond, np.column_stack([np.clip(9 * cells[:, 0], -2, 3), cells[:, 1]]))
    slow = frame(minutes=60.0, slew=0.01)  # 0.05 V of 5 V in a second; the pump is switched at once
    drive = slow.inputs(np.tile([3.0, 0.0], (225, 1)), coarse=False)
    np.testing.assert_allclose(drive[6:70, 0], np.minimum(0.05 * np.arange(1, 65), 3.0))
    assert drive[6:70, 1].tolist() == [0.0] * 64
    np.testing.assert_allclose(
        slow.inputs(np.tile([3.0, 0.0], (225, 1)), coarse=True)[2:12, 0], 0.2 * np.arange(1, 11)
    )


def test_cells_beyond_the_limits_are_drawn_towards_rest_by_halving():
    plain = frame()
    cells = np.column_stack([np.full(120, 3.0), np.zeros(120)])
    drawn = optimal._drawn(plain, cells, 0.25)
    assert drawn[0].tolist() == [0.75, 0.0]  # a switch stays
    found, value = optimal._shrunk(plain, lambda c: float(c.max()) if c.max() <= 1.2 else -np.inf, cells)
    assert (found[0].tolist(), value) == ([3 * 0.375, 0.0], 3 * 0.375)  # 1/4, 3/8 of 1/2, 7/16, 13/32
    assert optimal._shrunk(plain, lambda c: 7.0, cells) == (cells, 7.0)
    assert optimal._shrunk(plain, lambda c: -np.inf, cells)[1] == -np.inf

    def keep(most: float):
        return optimal._keep_limits(plain, SimpleNamespace(stays=lambda u: u[:, 0].max() <= most), cells)

    assert keep(3.0)[-1].tolist() == [3.0, 0.0]
    assert keep(1.2)[-1].tolist() == [3 * 409 / 1024, 0.0]  # the tenth halving of what is 0.4
    assert keep(-1.0) is None


def test_an_exchange_moves_one_block_of_one_input_inside_its_range():
    plain, rng = frame(), np.random.default_rng(0)
    cells = np.column_stack([np.linspace(-2, 3, 120), np.repeat(np.arange(40) % 2, 3)])
    pool = optimal._plain_shapes(plain)
    moved, lengths = np.zeros(2), []
    for _ in range(400):
        new = optimal._exchanged(plain, cells, pool, rng)
        changed = (new != cells).any(axis=0)
        assert changed.sum() <= 1
        moved += changed
        assert -2.0 <= new[:, 0].min() <= new[:, 0].max() <= 3.0
        assert set(new[:, 1]) <= {0.0, 1.0}
        assert (new[:, 1].reshape(40, 3) == new[::3, 1][:, None]).all()  # three cells change as one
        where = np.flatnonzero((new != cells).any(axis=1))
        lengths.append(np.ptp(where) + 1 if where.size else 0)
    assert moved.min() > 100
    assert max(lengths) <= 60  # half of the schedule
    assert max(lengths) > 40
    held = frame(hold=("pump",))
    for _ in range(50):
        assert (optimal._exchanged(held, cells * [1, 0] + [0, 1], pool, rng)[:, 1] == 1.0).all()
    levels = np.array([optimal._level(plain, 0, rng) for _ in range(2000)])
    share = [np.mean(levels == -2.0), np.mean(levels == 3.0), np.mean(levels == 0.5)]
    np.testing.assert_allclose(share, [0.35, 0.35, 0.1], atol=5 * np.sqrt(0.35 * 0.65 / 2000))
    assert -2.0 <= levels.min() <= levels.max() <= 3.0
    assert {optimal._level(plain, 1, rng) for _ in range(50)} == {0.0, 1.0}


def test_ratios_of_schedules_are_powers_of_two_of_their_bits():
    """Half a log2 of the determinant is a bit."""
    found = Expectation({"now": 0.0, "a": 3.0, "b": 1.0, "c": 900.0}, {"b": {"x": 1.0, "y": 2.0}})
    assert (found.determinant_ratio("a", "b"), found.narrower("a", "b")) == (16.0, 2.0)
    assert found.determinant_ratio("c", "now") == 2.0**1000
    assert found in {found}  # itself alone, and a key although its fields are none


def test_a_schedule_without_a_switch_has_it_on(block):
    switched = SimpleNamespace(inputs=("q", "pump"), model=SimpleNamespace(switches=("pump",)))
    log = make_log([0.0, 1.0], {"q": ([0.25, 0.5], "1", "input")}, name="x")
    assert inputs_of(switched, log).tolist() == [[0.25, 1.0], [0.5, 1.0]]
    plain = expect(block, {"x": make_log(np.arange(60.0), {"q": (np.full(60, 50.0), "percent", "input")})})
    assert plain.bits["now"] == 0.0
    assert plain.widths["now"] == interval_widths(block, np.asarray(block.covariance))
    assert plain.widths["x"]["P"] < plain.widths["now"]["P"]
