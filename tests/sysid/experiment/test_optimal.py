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
from thermogrip.sysid.experiment.information import ExperimentForecast, interval_widths, plant_from_prior
from thermogrip.sysid.experiment.optimal import Expectation, expect, inputs_of, optimal_schedule
from thermogrip.sysid.greybox.fit import fit_network
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.plant.plant_data import PlantScores


@pytest.fixture(scope="module")
def block() -> Plant:
    return heated_block()


@pytest.fixture(scope="module")
def boards() -> Plant:
    """Two heaters that differ from the prior medians, whose residuals repeat themselves for 20 s."""
    plant = plant_from_prior(load_network("tclab"))
    values = plant.values | {"G_amb": 0.013, "power_1": 1.2, "lag_1": 15.0, "G_between": 0.005}
    return replace(plant, values=values, scores=PlantScores(weight_s={"t1": 20.0, "t2": 20.0}))


def test_constant_full_input_is_best_where_only_the_gain_is_unknown(block):
    log = optimal_schedule(block, 20.0, ranges=block.valid, evaluations=100)
    q = log["q"].values
    assert np.all(q[:6] == 0.0)  # at rest, so that the start is known
    np.testing.assert_array_equal(q[6:], 100.0)


def test_twice_the_experiment_is_the_same_experiment_read_twice_as_well(boards):
    u = inputs_of(boards, schedule_for(boards, "prbs", 20.0, lowest=5.0, highest=90.0, seed=0)[0])
    sharper = replace(boards, scores=PlantScores(weight_s={"t1": 10.0, "t2": 10.0}))
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
    log = optimal_schedule(plant, 10.0, ranges={"drive": (-1.0, 1.0)}, highest=60.0, evaluations=60)
    pump = log["pump"].values
    assert set(pump) == {0.0, 1.0}
    edges = np.flatnonzero(np.diff(pump))
    assert np.diff(edges).min() * plant.dt >= 30.0
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
    best = optimal_for(plant, 30.0, lowest=5.0, highest=80.0, slew=np.inf, seed=0).log
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


def _mean_ratios(forecasts: list[ExperimentForecast], u: np.ndarray, stated: np.ndarray) -> np.ndarray:
    expected = [np.sqrt(np.diag(forecast.covariance(u))) for forecast in forecasts]
    return np.asarray(np.exp(np.mean(np.log(stated / expected), axis=0)))


def test_the_forecast_is_right_within_a_factor_and_a_half_for_most_parameters(kept):
    """What discrepancy the fits allow for is not in the forecast: the room's temperature is off by 2.4."""
    u, before, stated = kept
    ratios = _mean_ratios([ExperimentForecast(plant, draws=0) for plant in before], u["optimal"], stated)
    assert np.median(ratios) < 1.5
    assert ratios.min() > 0.8
    assert ratios.max() < 2.6
    now = np.sqrt([np.diag(np.asarray(plant.covariance)) for plant in before])
    assert np.median(stated / now) < np.sqrt(0.5)  # more than the same experiment once more would bring


def test_ratios_of_schedules_are_powers_of_two_of_their_bits():
    found = Expectation({"now": 0.0, "a": 3.0, "b": 1.0, "c": 900.0}, {"b": {"x": 1.0, "y": 2.0}})
    assert found.narrower("a", "b") == 2.0  # two bits, of two parameters
    assert found in {found}  # itself alone, and a key although its fields are none


def test_a_schedule_without_a_switch_has_it_on(block):
    switched = SimpleNamespace(inputs=("q", "pump"), model=SimpleNamespace(switches=("pump",)))
    log = make_log([0.0, 1.0], {"q": ([0.25, 0.5], "1", "input")}, name="x")
    assert inputs_of(switched, log).tolist() == [[0.25, 1.0], [0.5, 1.0]]
    plain = expect(block, {"x": make_log(np.arange(60.0), {"q": (np.full(60, 50.0), "percent", "input")})})
    assert plain.bits["now"] == 0.0
    assert plain.widths["now"] == interval_widths(block, np.asarray(block.covariance))
    assert plain.widths["x"]["P"] < plain.widths["now"]["P"]
