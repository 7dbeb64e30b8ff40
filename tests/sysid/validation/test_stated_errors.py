"""Bands cover as often as stated; an ensemble that disagrees over a log is refused."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import make_log
from thermogrip.sysid.greybox.fit import fit_network
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.identification import Held, run_held_out
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.models.neural import NeuralModel
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.plant.plant_data import HeldOut, PlantScores
from thermogrip.sysid.validation.free_run import free_run
from thermogrip.sysid.validation.stated_errors import (
    MOST_DISAGREEMENT,
    between_runs,
    check_ensemble,
    drawn_runs,
    ensemble_disagreement,
    expected_error,
    free_run_band,
    part_errors,
    unlike_fit,
)


@pytest.fixture
def heater():
    plant = prior_plant(load_network("tclab"))
    n = len(plant.free)
    return replace(plant, covariance=0.02**2 * np.eye(n), noise={"t1": 0.1, "t2": 0.1})


@pytest.fixture
def schedule():
    t = np.arange(0.0, 900.0, 2.0)
    signals = {
        "q1": (60.0 * (t % 600 < 300), "percent", "input"),
        "q2": (30.0 * (t % 400 < 200), "percent", "input"),
        "t1": (np.full(t.size, 23.0), "degC", "output"),
        "t2": (np.full(t.size, 23.0), "degC", "output"),
    }
    return make_log(t, signals)


def band_of(plant, log, run, **more):
    return free_run_band(plant, log, run, drawn_runs(plant, log, **more))


def measured(truth, schedule, seed):
    log = truth.simulate(schedule)
    rng = np.random.default_rng(seed)
    for name in truth.outputs:
        log[name] = log[name] + 0.1 * rng.standard_normal(log.sizes["time"])
    return log


@pytest.mark.parametrize("count", [10, pytest.param(40, marks=pytest.mark.slow)])
def test_readings_of_a_drawn_plant_lie_inside_as_often_as_stated(heater, schedule, count):
    shares = []
    for k in range(count):
        log = measured(heater.draw(100 + k), schedule, k)
        band = band_of(heater, log, heater.simulate(log))
        shares.append(np.mean(list(band.inside.values())))
    # one draw's error is slow, so a log is worth about one draw: sd of a share ~0.17
    assert np.mean(shares) == pytest.approx(0.9, abs=3 * 0.17 / np.sqrt(count))


def test_what_the_draws_do_not_explain_of_the_held_out_errors_is_in_the_band(schedule):
    def block(pole):
        A, B = pole * np.eye(2), 0.01 * np.eye(2)
        return StateSpaceModel(("q1", "q2"), (), ("t1", "t2"), A=A, B=B, C=np.eye(2), dt=2.0)

    errors = {"t1": [1.0], "t2": [0.001]}
    noise = {"t1": 0.1, "t2": 0.1}
    plant = Plant(block(0.9), {}, dt=2.0, noise=noise, scores=PlantScores(held_out_by_part=errors))
    run = plant.simulate(schedule)
    assert np.allclose(band_of(plant, schedule, run).half["t1"], 1.6449, rtol=1e-3)
    ensemble = replace(plant, refits=(block(0.905), block(0.895)))
    band = band_of(ensemble, schedule, run).half
    assert np.mean(band["t1"] ** 2) == pytest.approx(1.6449**2, rel=1e-3)  # no wider on average, and not even
    assert np.ptp(band["t1"]) > 0.01
    assert np.mean(band["t2"] ** 2) > (1.6449 * 0.001) ** 2  # draws that run further apart than it erred


def test_draws_run_over_a_log_in_other_units(heater, schedule):
    shares = schedule.assign(q1=(schedule["q1"] / 100).assign_attrs(schedule["q1"].attrs | {"units": "1"}))
    half, other = (band_of(heater, log, heater.simulate(log), draws=3).half for log in (schedule, shares))
    np.testing.assert_allclose(other["t1"], half["t1"], rtol=1e-9)


def first_order(gain=1.0, logs=("a",)):
    A, B = 0.98 * np.eye(2), 0.02 * gain * np.eye(2)
    block = StateSpaceModel(("q1", "q2"), (), ("t1", "t2"), A=A, B=B, C=np.eye(2), dt=2.0)
    return Plant(block, {}, dt=2.0, noise={"t1": 0.1, "t2": 0.1}, logs=logs)


def test_another_run_adds_what_its_gain_changes(schedule):
    schedule = schedule.assign({name: 0.0 * schedule[name] for name in ("t1", "t2")})
    for name in ("q1", "q2"):
        schedule[name] = schedule[name].copy(data=schedule[name].values - schedule[name].values.min())
    plant = first_order()
    run = plant.simulate(schedule)
    added = between_runs(plant, [schedule])
    for name in plant.outputs:  # linear from rest: 5 percent of the response
        np.testing.assert_allclose(added[name], 0.05 * run[name].values, atol=1e-9)
    half = band_of(plant, schedule, run).half["t1"]
    # half of it is a level, as wide where the inputs do nothing: that of another day
    changes = (added["t1"] ** 2 + np.mean(added["t1"] ** 2)) / 2
    np.testing.assert_allclose(half, 1.6449 * np.sqrt(0.01 + 0.6745**2 * changes), rtol=1e-3)
    both = between_runs(plant, [schedule, schedule.isel(time=slice(0, 20))])
    for name in plant.outputs:  # one log after the other
        np.testing.assert_allclose(both[name], [*added[name], *added[name][:20]], atol=1e-12)
    assert between_runs(first_order(logs=()), [schedule]) == {}
    assert between_runs(first_order(logs=("a", "b", "c")), [schedule]) == {}


@pytest.mark.parametrize(("shift", "least"), [(0.0, 0.0), (3.0, 3.0), (-3.0, -2.0)])
def test_an_input_that_never_was_0_varies_about_its_value_nearest_to_0(shift, least):
    q = np.repeat([0.0, 1.0, 0.2, 0.7], 100) + shift  # 0 to 1, 3 to 4, -3 to -2
    model = StateSpaceModel(("q",), (), ("t",), A=[[0.5]], B=[[2.0]], C=[[1.0]], dt=1.0)
    time = np.arange(400.0)
    log = make_log(time, {"q": (q, "1", "input"), "t": (0.0 * time, "degC", "output")})
    plant = Plant(model, {}, dt=1.0, logs=("a",), valid={"q": (q.min(), q.max())})
    added = between_runs(plant, [log])["t"]
    ends = [99, 199, 299, 399]  # at rest, with a gain of 4
    np.testing.assert_allclose(added[ends], 0.05 * 4 * (q[ends] - least), atol=1e-6)
    held = log.assign(q=log["q"].copy(data=np.full(400, q[99] + 1.0)))  # about the same value as in the fit
    assert between_runs(plant, [held])["t"][-1] == pytest.approx(0.05 * 4 * (q[99] + 1.0 - least))


def test_a_switch_has_no_gain_that_varies(schedule):
    model = StateSpaceModel(
        ("q1", "q2"), (), ("t1", "t2"), switches=("q2",), dt=2.0,
        A=0.98 * np.eye(2), B=0.02 * np.eye(2), C=np.eye(2),
    )  # fmt: skip
    schedule["q2"].values[:] = schedule["q2"].values > 0
    added = between_runs(Plant(model, {}, dt=2.0, logs=("a",)), [schedule])
    assert np.ptp(added["t1"]) > 1.0
    assert np.ptp(added["t2"]) == 0.0


@pytest.fixture
def shown():
    """A black box whose fit had an input of 0 to 50 percent and readings of 0 to 50, and a log like that."""
    model = StateSpaceModel(("q",), (), ("t",), A=[[0.5]], B=[[0.5]], C=[[1.0]], dt=1.0)
    q = np.repeat([0.0, 50.0, 20.0, 40.0], 100)
    plant = Plant(model, {}, dt=1.0, logs=("a",), units={"q": "percent"}, valid={"q": (0, 50), "t": (0, 50)})
    log = make_log(np.arange(400.0), {"q": (q, "percent", "input"), "t": (0.0 * q, "degC", "output")})
    log["t"] = log["t"].copy(data=plant.simulate(log)["t"].values)
    scores = PlantScores(held_out_by_part={"t": [0.1, 0.1]})
    return replace(plant, scores=scores), log


def times(log, factor):
    return log.assign({n: log[n].copy(data=factor * log[n].values) for n in ("q", "t")})


def test_a_run_like_the_fit_adds_nothing_to_its_band(shown):
    plant, log = shown
    assert np.max(unlike_fit(plant, log, plant.simulate(log), 5.0)["t"]) < 1e-6
    assert "unlike the fit" not in free_run(plant, log).band().own_error
    assert unlike_fit(replace(plant, scores=PlantScores()), log, plant.simulate(log), 5.0) == {}


def test_what_lies_beyond_the_readings_of_the_fit_is_in_doubt(shown):
    plant, log = shown
    far = times(log, 1.4)
    added = unlike_fit(plant, far, plant.simulate(far), 5.0)["t"]
    np.testing.assert_allclose(added[[99, 199, 299, 399]], [0.0, 4.0, 0.0, 1.2], atol=1e-3)
    band = free_run(plant, far, 5.0).band()
    assert "unlike the fit" in band.own_error
    assert band.half["t"][199] > 1.64 * 4.0
    assert band.expected["t"] == pytest.approx(np.sqrt(np.mean((band.half["t"][5:] / 1.6449) ** 2)), rel=1e-3)


def test_a_warm_up_outside_of_the_readings_of_the_fit_is_in_doubt(shown):
    plant, log = shown
    cold = log.assign(t=log["t"].copy(data=np.full(400, -7.0)))
    assert unlike_fit(plant, cold, plant.simulate(cold), 5.0)["t"][-1] == pytest.approx(1.4, abs=0.01)


@pytest.mark.parametrize("factor", [0.5, 0.9])
def test_smaller_moves_than_in_the_fit_add_nothing(shown, factor):
    """Of two runs of one protocol one has moves a third larger, by chance."""
    plant, log = shown
    other = times(log, factor)
    assert np.max(unlike_fit(plant, other, plant.simulate(other), 5.0)["t"]) < 1e-6


@pytest.mark.parametrize(
    ("errors", "gain", "rmse", "ends"),
    [
        ([0.1] * 5, 0.0, 0.1, (0.054, 0.186)),
        ([0.1, 0.1, 0.1, 0.1, 1.6], 0.0, 0.174, (0.025, 1.23)),  # a part unlike all others widens them
        ([0.1], 0.0, 0.1, (0.0215, 0.465)),  # one part alone: by what parts differ elsewhere
        ([0.1] * 5, 1.0, np.hypot(0.1, 0.6745), (0.12, 1.96)),  # a gain, |N(0, 1)|, beyond 1.96 in 5 %
    ],
)
def test_the_error_of_another_run_lies_about_those_of_the_parts_and_of_a_gain(errors, gain, rmse, ends):
    found = expected_error(errors, gain)
    assert found.rmse == pytest.approx(rmse, rel=0.01)
    assert (found.low, found.high) == pytest.approx(ends, rel=0.12)


def test_nine_of_ten_runs_lie_within_the_stated_ends_and_half_are_above_the_stated_error():
    rng = np.random.default_rng(5)
    inside, above = 0, 0
    for _ in range(400):  # plants whose parts and runs differ alike, one part more of each
        spread = 0.5 * np.sqrt(4 / rng.chisquare(4))
        parts = np.exp(0.3 * rng.standard_normal() + spread * rng.standard_normal(6))
        run = np.hypot(parts[5], 0.5 * rng.standard_normal())
        found = expected_error(parts[:5].tolist(), 0.5)
        inside += found.low <= run <= found.high
        above += run > found.rmse
    assert inside / 400 == pytest.approx(0.9, abs=0.04)
    assert above / 400 == pytest.approx(0.5, abs=0.07)


def test_the_error_of_a_plant_is_that_of_the_parts_held_out_and_of_whole_logs_where_it_has_several():
    tail = HeldOut("last 30 % of a", "t", 0.2, 90.0, "degC", 9)
    held = [tail, replace(tail, log="b", rmse=0.4), replace(tail, output="r", rmse=9.0)]
    one = replace(first_order(), scores=PlantScores(held_out=held))
    assert part_errors(one, "t") == [0.2, 0.4]
    assert part_errors(replace(one, logs=("a", "b", "c")), "t") == [0.4]
    assert part_errors(first_order(), "t1") == [0.1]  # a fit alone
    parts = PlantScores(held_out_by_part={"t1": [0.3, 0.6]})
    assert part_errors(replace(first_order(), scores=parts), "t1") == [0.3, 0.6]


def test_the_band_of_a_fit_to_means_covers_readings(heater, schedule):
    t = np.arange(0.0, 1500.0)
    moved = {"q1": 60.0 * (t % 200 < 100), "q2": 40.0 * (t % 330 < 150)}
    signals = {name: (values, "percent", "input") for name, values in moved.items()}
    signals |= {name: (np.full(t.size, 23.0), "degC", "output") for name in ("t1", "t2")}
    log = measured(replace(heater, covariance=None), make_log(t, signals), 3)
    plant = fit_network("tclab", [log])
    assert plant.scores.average_s > 3.0  # of several readings each
    run = plant.simulate(log, warmup=50.0, score_from=50.0)
    band = band_of(replace(plant, logs=("a", "b", "c")), log, run)  # nothing for another run
    assert min(band.inside.values()) == pytest.approx(0.9, abs=0.04)
    assert max(band.inside.values()) == pytest.approx(0.9, abs=0.04)


def pair(bend: float, *, size: float = 2.0) -> Plant:
    """Two members of one block; one is pushed by ``bend`` spreads at large drives."""
    model = NeuralModel(
        ("q",), (), ("t",), 1.0, (),
        A=[[[0.9]]] * 2, B=[[[0.1]]] * 2, c=[[0.0]] * 2,
        V=[[[0.0]], [[0.1 * bend]]], W=[[[0.0]]] * 2, U=[[[1.0]]] * 2, b=[[0.0]] * 2,
        y_middle=[30.0], y_size=[size], w_middle=[0.0], w_size=[1.0], reach=[9.0],
        low=[-np.inf], high=[np.inf],
    )  # fmt: skip
    return Plant(model, {}, dt=1.0, units={"q": "1", "t": "degC"}, noise={"t": 0.1})


def driven(q: float, rows: int = 400):
    u, t = np.full(rows, q), np.full(rows, 30.0)
    return make_log(np.arange(float(rows)), {"q": (u, "1", "input"), "t": (t, "degC", "output")}, name="far")


@pytest.mark.parametrize("bend", [0.2, 0.6, 2.0])
def test_the_share_is_half_the_difference_of_two_members_at_rest(bend):
    # a gain of 1 / (1 - 0.9) on 0.1 bend tanh(9), so they end `bend` spreads apart: 1/2 each from the mean
    share = ensemble_disagreement(pair(bend), driven(9.0, 4000))["t"]
    assert share == pytest.approx(bend / 2, rel=0.02)
    assert ensemble_disagreement(pair(bend, size=7.0), driven(9.0, 4000))["t"] == pytest.approx(share)


def stepped(time: np.ndarray, on: np.ndarray):
    q, t = 9.0 * on, np.full(time.size, 30.0)
    return make_log(time, {"q": (q, "1", "input"), "t": (t, "degC", "output")}, name="stepped")


def test_the_share_is_an_rms_over_the_log_at_the_models_own_pace():
    k = np.arange(20)  # after the drive the members part as 1 - 0.9^k
    share = ensemble_disagreement(pair(1.0), stepped(np.arange(120.0), np.arange(120) >= 100))["t"]
    assert share == pytest.approx(0.5 * np.sqrt(np.sum((1 - 0.9**k) ** 2) / 120), rel=0.05)


def test_a_disturbance_is_read_less_its_offset():
    model = NeuralModel(
        ("q",), ("room",), ("t",), 1.0, (),
        A=[[[0.9]]] * 2, B=[[[0.1, 0.0]]] * 2, c=[[0.0]] * 2,
        V=[[[0.0]], [[0.1]]], W=[[[0.0]]] * 2, U=[[[0.0, 1.0]]] * 2, b=[[0.0]] * 2,
        y_middle=[30.0], y_size=[2.0], w_middle=[0.0, 20.0], w_size=[1.0, 1.0], reach=[9.0, 9.0],
        low=[-np.inf], high=[np.inf],
    )  # fmt: skip

    def apart(room: float, offset: float) -> float:
        log = driven(0.0).assign(room=("time", np.full(400, room), {"units": "degC", "role": "disturbance"}))
        return ensemble_disagreement(Plant(model, {}, dt=1.0, offsets={"room": offset}), log)["t"]

    assert apart(25.0, 5.0) == apart(20.0, 0.0) == pytest.approx(0.0, abs=1e-9)
    assert apart(20.0, 5.0) == pytest.approx(apart(15.0, 0.0)) == pytest.approx(0.5, rel=0.05)


def test_members_that_agree_pass_and_those_that_do_not_are_refused_in_words():
    check_ensemble(pair(1.9 * MOST_DISAGREEMENT), driven(9.0))
    with pytest.raises(UserError, match=r"disagree over far: t by 4\d %"):
        check_ensemble(pair(2.2 * MOST_DISAGREEMENT), driven(9.0))
    check_ensemble(pair(5.0), driven(0.0))  # no drive, nothing to disagree about
    with pytest.raises(UserError, match=r"disagree over far: t by .* mean is not reliable"):
        check_ensemble(pair(5.0), driven(9.0))


def test_no_held_out_figure_comes_of_members_that_disagree():
    held = Held(driven(9.0), "far", 0.0)
    with pytest.raises(UserError, match="disagree over"):
        run_held_out(pair(5.0), held, unseen=True)
    assert run_held_out(pair(0.1), held, unseen=True).scores
    assert len(run_held_out(pair(5.0), held).scores) == 1


def still(**scores):
    """A plant at rest whose error is 0.4 K, a log of 12 readings and its run."""
    block = StateSpaceModel(("q",), (), ("t",), A=[[0.9]], B=[[0.1]], C=[[1.0]], dt=1.0)
    signals = {"q": (np.zeros(12), "1", "input"), "t": (np.zeros(12), "degC", "output")}
    plant = Plant(block, {}, dt=1.0, noise={"t": 0.4}, scores=PlantScores(**scores))
    log = make_log(np.arange(12.0), signals)
    return plant, log, plant.simulate(log)


def test_a_band_counts_scored_readings_and_adds_draws_the_fit_and_single_readings(monkeypatch):
    plant, log, run = still(reading_excess={"t": 0.3})
    log["t"].values[:] = [9, 9, 9, 9, 9, 0.82, -0.83, 0.82, np.nan, -0.82, 0.83, 0.0]  # 1.6449 * 0.5 = 0.822
    band = band_of(plant, log, run)
    assert (band.level, band.draws, band.own_error) == (0.9, 0, "the error of the fit")
    np.testing.assert_allclose(band.half["t"], 1.644854 * 0.5, rtol=1e-6)
    assert band.inside["t"] == 4 / 6
    assert np.isnan(band_of(plant, log, run.assign(scored=0 * run["scored"])).inside["t"])
    seeds = []

    def draw(_plant, k):
        seeds.append(k)
        return SimpleNamespace(over=lambda *_: (run["t"].values[:, None] + k, []))

    monkeypatch.setattr(Plant, "draw", draw)
    drawn = band_of(replace(plant, refits=(plant.model,)), log, run, draws=3)
    np.testing.assert_allclose(drawn.half["t"], 1.644854 * np.sqrt((1 + 4 + 9) / 3 + 0.25), rtol=1e-6)
    assert drawn.draws == 3
    assert band_of(replace(plant, refits=(plant.model,)), log, run).draws == 30
    assert seeds == [1, 2, 3, *range(1, 31)]


def test_the_words_of_a_band_say_what_its_own_error_is_and_what_is_assumed():
    plant, log, run = still(held_out_by_part={"t": [2.0, 1.0, 0.5]})
    band = band_of(plant, log, run)
    assert band.own_error == "the errors of free runs over parts held out of it"
    assert band.expected["t"] == pytest.approx(1.0)  # their geometric mean
    assert band.likely["t"][0] < 0.5 < 2.0 < band.likely["t"][1]
    again = " and a gain that varies by 5 % from run to run (assumed, 0 % of the squared error: "
    again += "{} cannot show it)"
    for logs, how in ((("a",), "one log"), (("a", "b"), "two logs"), (("a", "b", "c"), None), ((), None)):
        band = band_of(replace(still()[0], logs=logs), log, run)
        assert band.own_error == "the error of the fit" + (again.format(how) if how else "")
