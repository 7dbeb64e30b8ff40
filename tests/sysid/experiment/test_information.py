"""Information of an experiment: a learnt error by hand in one parameter, what a forecast keeps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.sysid.experiment.makers import EVERY, POWER, SD, C, G, heated_block
from thermogrip.datasets.errors import UserError
from thermogrip.sysid.experiment.information import (
    Experiment,
    ExperimentForecast,
    ReadingError,
    interval_widths,
    learnt_error,
    plant_from_prior,
    reading_noise,
)
from thermogrip.sysid.greybox.noise_model import ErrorModel
from thermogrip.sysid.greybox.random_effects import Response
from thermogrip.sysid.models.network import NetworkModel, load_network
from thermogrip.sysid.models.network_spec import network_from_dict
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.fit_record import DiscrepancyTerm, ErrorNumbers, Intervals, PlantScores
from thermogrip.sysid.plant.plant import Plant


def rows(*values: float) -> np.ndarray:
    """One column of one output; the last row is left over behind the last bin of two rows."""
    return np.array([*values, 99.0])[None, :, None]


WHITE = ErrorModel((0.3,), (1.0,), ((0.0,),), (0.0,))


def learnt(**change: Any) -> ReadingError:
    content = {
        "numbers": WHITE, "hessian": np.array([[400.0]]), "unit": np.array([0.5]),
        "sensor": np.array([0.2]),
        "bin_s": 2.0, "merge": 2.0, "phi": 1.5, "offset": np.array([0.1]), "bias": np.zeros(0),
        "parameter_sd": np.zeros(1), "stretches": 3, "pull": np.array([[80.0]]),
        "terms": (Response("q", 20.0, np.array([0.25]), 2.0),),
    }  # fmt: skip
    return ReadingError(**(content | change))


def experiment(n: int = 7, warm_up: float = 0.0) -> Experiment:
    """In units of 0.5: bins of 4, 6, 2; an effect of 2, 2, 4, a start of 2, 0, 0, a term of 0.5, 1, 1.5."""
    rise, effect = rows(1, 3, 2, 4, 0, 2), rows(2, 0, 1, 1, 3, 1)
    start, lagged = rows(1, 1, 0, 0, 0, 0), np.array([[1.0, 1, 2, 2, 3, 3, 7]])
    return Experiment(rise[:, :n], effect[:, :n], start[:, :n], lagged[:, :n], 1.0, warm_up)


NOISE, OWN, OFFSET, START = 4 * 0.09 * 56, (2 * 28) ** 2, (2 * 2.4) ** 2, 16**2  # of 2 J'x, J'J = 56


@pytest.mark.parametrize(
    ("rms", "pull", "shared", "factor"),
    [
        (2.0, 80.0, 0.4, 4 / (3 + 11 / 4)),  # the mean square of the lagged signal is 11
        (4.0, 80.0, 0.4, 4 / (3 + 11 / 16)),
        (2.0, 300.0, 1.0, 4 / (3 + 11 / 4)),  # 1.5, cut to 1
        (2.0, -80.0, -0.4, 4 / (3 + 11 / 4)),
    ],
)
def test_the_gain_of_an_experiment_by_hand(rms: float, pull: float, shared: float, factor: float):
    """With R = 0.5 the fit's Hessian is 100, the experiment's 2 * 56; the term's pull on it is 2 * 11."""
    error = learnt(terms=(Response("q", 20.0, np.array([0.25]), rms),), pull=np.array([[pull]]))
    both = (100 * shared + 22) ** 2 * factor
    score = 100**2 * (1 - shared**2) + both + 1.5 * (NOISE + OWN + OFFSET + START)
    got = error.gain(np.array([[0.5]]), experiment())
    np.testing.assert_allclose(got, [[212**2 / score]])


def test_without_terms_or_bins_nothing_is_shared_or_added():
    bare = learnt(terms=(), pull=np.zeros((1, 0)))
    new = replace(experiment(), lagged=np.zeros((0, 7)))
    score = 100**2 + 1.5 * (NOISE + OWN + OFFSET + START)
    np.testing.assert_allclose(bare.gain(np.array([[0.5]]), new), [[212**2 / score]])
    np.testing.assert_allclose(
        bare.gain(np.array([[0.5]]), replace(experiment(3), lagged=new.lagged[:, :3])), [[1.0]]
    )
    two = replace(experiment(4), lagged=new.lagged[:, :4])  # two bins count: 4 and 6
    after, own = 100 + 2 * 52, (2 * 20) ** 2
    score = 100**2 + 1.5 * (4 * 0.09 * 52 + own + (2 * 2.0) ** 2 + START)
    np.testing.assert_allclose(bare.gain(np.array([[0.5]]), two), [[after**2 / score]])
    coarse = replace(new, dt=9.0)  # a row is longer than a bin: it is one
    J = np.array([1, 3, 2, 4, 0, 2, 99.0]) / 0.5
    B, S = np.array([2, 0, 1, 1, 3, 1, 99.0]) / 0.5, np.array([1, 1, 0, 0, 0, 0, 99.0]) / 0.5
    score = 100**2 + 1.5 * (0.36 * J @ J + 4 * ((J @ B) ** 2 + (0.2 * J.sum()) ** 2 + (J @ S) ** 2))
    np.testing.assert_allclose(bare.gain(np.array([[0.5]]), coarse), [[(100 + 2 * J @ J) ** 2 / score]])


@pytest.mark.parametrize(("warm_up", "n"), [(4.0, 2), (0.5, 1), (40.0, 3)])
def test_a_warm_up_leaves_of_the_start_what_its_bins_do_not_show(warm_up: float, n: int):
    """Bins of noise r have an error of 0.3: H = (1 - K B)(1 - K B)' + 0.09 K K', K = (B'B + r^2)^-1 B'."""
    r = np.sqrt(warm_up / (1 + warm_up / 10) / 2.0) * 0.2 / 0.5
    B = np.array([[0.2, 2.0], [0.2, 0.0], [0.2, 0.0]])[:n]
    K = np.linalg.solve(B.T @ B + r**2 * np.eye(2), B.T)
    left = (np.eye(2) - K @ B) @ (np.eye(2) - K @ B).T + 0.09 * K @ K.T
    start = np.array([4.8, 16.0])
    bare = learnt(terms=(), pull=np.zeros((1, 0)))
    new = replace(experiment(warm_up=warm_up), lagged=np.zeros((0, 7)))
    score = 100**2 + 1.5 * (NOISE + OWN + start @ left @ start)
    np.testing.assert_allclose(bare.gain(np.array([[0.5]]), new), [[212**2 / score]])


@pytest.fixture(scope="module")
def gripper() -> Plant:
    return plant_from_prior(load_network("gripper"))


def test_what_a_fit_has_learnt_is_taken_from_its_record(gripper: Plant):
    n, first = len(gripper.free), gripper.free[0]
    numbers = ErrorNumbers((0.1, 0.2), (3.0,), ((0.4, 0.5),), (0.6,), (0.7, 0.8), 9.0, 2, (1.1,))
    spread = {"offset of t_tank": 0.3, "bias of t_ambient": 0.4, first: 0.5}
    term = DiscrepancyTerm("v |v|", 20.0, [0.1, 0.2], 0.05)
    known = Intervals(numbers, np.eye(n).tolist(), [term], 4, np.ones((n, 1)).tolist(), "", 0.7, spread)
    plant = replace(gripper, scores=PlantScores(intervals=known))
    found = learnt_error(plant)
    assert found is not None
    assert found.numbers == ErrorModel((0.1, 0.2), (3.0,), ((0.4, 0.5),), (0.6,), (1.1,))
    assert (found.unit.tolist(), found.bin_s, found.merge, found.phi, found.stretches) == (
        [0.7, 0.8],
        9.0,
        2.0,
        1.0,
        4,
    )
    assert (found.offset.tolist(), found.bias.tolist()) == ([0.3, 0.0], [0.4])
    assert found.parameter_sd.tolist() == [0.5] + [0.0] * (n - 1)
    assert found.sensor.tolist() == [plant.model.sensor_sd[name] for name in plant.outputs]
    assert (found.pull.shape, found.hessian.shape) == ((n, 1), (n, n))
    (got,) = found.terms
    assert (got.signal, got.lag, got.size.tolist(), got.rms) == ("v |v|", 20.0, [0.1, 0.2], 0.05)
    wide = learnt_error(
        replace(plant, scores=PlantScores(intervals=replace(known, between_logs=2.5, terms=[], pull=[])))
    )
    assert wide is not None
    assert (wide.phi, wide.pull.shape) == (2.5, (n, 0))
    for less in (
        {"covariance": None},
        {"scores": PlantScores()},
        {"scores": PlantScores(intervals=replace(known, numbers=None))},
    ):
        assert learnt_error(replace(plant, **less)) is None


def lag() -> Plant:
    """A lag of 10 K a unit over a base of 20 degC, beside a count that no limit holds for."""
    model = StateSpaceModel(
        ("q",), (), ("t", "n"), A=[[0.5]], B=[[5.0]], C=[[1.0], [100.0]], dt=2.0, y0=[20.0, 0.0]
    )
    return Plant(model, {}, dt=2.0, units={"q": "V", "t": "degC", "n": "rpm"}, valid={"q": (0.0, 3.0)})


@pytest.mark.parametrize(
    ("limits", "margin", "kept"),
    [
        ({"highest": 29.9}, 0.0, True),
        ({"highest": 29.8}, 0.0, False),
        ({"highest": 29.9}, 0.1, False),
        ({"highest": 30.0}, 0.1, True),
        ({"lowest": 20.0}, 0.0, True),
        ({"lowest": 20.1}, 0.0, False),
        ({"lowest": 20.0}, 0.1, False),
        ({}, 5.0, True),
    ],
)
def test_limits_are_of_temperatures_and_a_margin_is_inside_them(
    limits: dict[str, float], margin: float, kept: bool
):
    forecast = ExperimentForecast(lag(), room=20.0, **limits)
    u = np.ones((6, 1))  # 20, 25, 27.5 .. 29.84
    assert forecast.outputs(u)[0, :, 0].tolist() == pytest.approx([30 - 10 * 0.5**k for k in range(7)])
    assert forecast.stays(u, margin=margin) is kept
    assert (forecast.n_draws, forecast.dt, forecast.starts) == (0, 2.0, True)
    assert not forecast.stays(np.full((6, 1), np.inf))
    only = replace(lag(), units={"q": "V", "t": "rpm", "n": "rpm"})
    assert ExperimentForecast(only, room=20.0, **limits).stays(u, margin=margin)


def test_signals_that_are_no_temperatures_begin_where_the_logs_had_them():
    model = StateSpaceModel(
        ("q",), ("wind", "air"), ("t", "n"), A=[[0.5]], B=[[5.0]], C=[[1.0], [0.0]], dt=2.0
    )
    units = {"q": "V", "wind": "m/s", "air": "degC", "t": "degC", "n": "rpm"}
    plant = Plant(model, {}, dt=2.0, units=units, valid={"wind": (2.0, 7.0), "n": (30.0, 90.0)})
    seen: list[Any] = []
    object.__setattr__(model, "rest", lambda *args: seen.append(args) or np.zeros(1))
    forecast = ExperimentForecast(plant, room=22.0)
    forecast.outputs(np.zeros((2, 1)))
    y, u, d, _ = seen[0]
    assert (y.tolist(), u.tolist(), d.tolist()) == ([22.0, 30.0], [0.0], [4.5, 22.0])
    assert ExperimentForecast(replace(plant, valid={})).room == 25.0


def test_draws_keep_the_limits_too_and_are_counted(gripper: Plant):
    u = np.tile([0.1, 1.0], (20, 1))
    assert ExperimentForecast(gripper).outputs(u).shape == (9, 21, 2)
    assert ExperimentForecast(gripper, draws=3).outputs(u).shape == (4, 21, 2)
    assert ExperimentForecast(replace(gripper, covariance=None)).outputs(u).shape == (1, 21, 2)
    few = ExperimentForecast(gripper, draws=3)
    spread = few.outputs(u)
    np.testing.assert_allclose(spread[2], ExperimentForecast(gripper.draw(2), draws=0).outputs(u)[0])
    kept = ExperimentForecast(gripper, draws=3, highest=float(spread.max()) - 1e-6)
    assert kept.evaluate(u) == -np.inf
    assert ExperimentForecast(gripper, draws=0, highest=float(spread[0].max()) + 1e-9).stays(u)
    assert few.evaluate(u) == pytest.approx(few.bits(u), rel=1e-9)


def test_the_information_of_a_step_is_the_integral_in_closed_form():
    block, n, tau = heated_block(), 1200, C / G
    u = np.full((n, 1), 100.0)
    t, rise = float(n), POWER / G
    # y is proportional to P, so dy/dln P = y - room
    square = rise**2 * (t - 2 * tau * (1 - np.exp(-t / tau)) + tau / 2 * (1 - np.exp(-2 * t / tau)))
    F = square / (SD**2 * EVERY)
    forecast = ExperimentForecast(block)
    # the sum over steps of 1 s beside the integral: half a step of the last value, 1e-3 of the whole
    np.testing.assert_allclose(forecast.covariance(u), [[1 / (1 + F)]], rtol=3e-3)
    assert forecast.bits(u) == pytest.approx(0.5 * np.log2(1 + F), rel=3e-4)


def test_noise_is_what_the_fit_saw_and_never_less_than_the_sensors():
    seen = PlantScores(independent_s={"t1": 20.0, "t2": 20.0}, average_s=5.0)
    board = replace(plant_from_prior(load_network("tclab")), scores=seen, noise={"t1": 0.9, "t2": 0.01})
    sd, seconds = reading_noise(board)
    assert (sd.tolist(), seconds.tolist()) == ([0.9, 0.4], [20.0, 20.0])


@pytest.mark.parametrize("name", ["gripper", "tclab"])
def test_the_belief_before_any_log_is_the_priors(name):
    model = load_network(name)
    plant = plant_from_prior(model)
    sd = dict(zip(plant.free, np.sqrt(np.diag(np.asarray(plant.covariance)))))
    wanted = {n: s.sd_log if s.scale == "log" else s.sd for n, s in model.specs.items() if n in plant.free}
    assert sd == pytest.approx(wanted)
    assert {model.specs[n].scale for n in sd} == {"log", "linear"}
    assert plant.valid == {n: item.range for n, item in model.network.inputs.items() if item.range}


def test_a_reading_counts_once_a_bin_or_correlation_time(gripper: Plant):
    sd, seconds = reading_noise(gripper)
    assert seconds.tolist() == [60.0, 60.0]
    assert sd.tolist() == [gripper.model.sensor_sd[name] for name in gripper.outputs]
    known = PlantScores(average_s=30.0, independent_s={"t_tank": 20.0, "t_surface": 45.0})
    assert reading_noise(replace(gripper, scores=known))[1].tolist() == [30.0, 45.0]
    black = replace(lag(), noise={"t": 0.2, "n": 0.3})
    assert [part.tolist() for part in reading_noise(black)] == [[0.2, 0.3], [60.0, 60.0]]
    with pytest.raises(UserError, match="the plant has no sensor error for n; identify it again"):
        reading_noise(replace(lag(), noise={"t": 0.2}))


def test_widths_are_of_ninety_percent_intervals_in_natural_units():
    content = load_network("tclab").to_dict()["network"]
    plant = plant_from_prior(NetworkModel(network_from_dict(content)))
    n = len(plant.free)
    log, linear = (next(k for k in plant.free if plant.scales[k] == scale) for scale in ("log", "linear"))
    plant = replace(plant, bounds={}, samples=np.ones((3, n)))
    wide = interval_widths(plant, np.diag(np.full(n, 0.04)))
    assert wide[log] == pytest.approx(plant.values[log] * 2 * np.sinh(1.6448536 * 0.2))
    assert wide[linear] == pytest.approx(2 * 1.6448536 * 0.2)
    assert interval_widths(plant, np.diag(np.full(n, 0.04)), 0.5)[linear] == pytest.approx(
        2 * 0.6744898 * 0.2
    )
