"""Information of an experiment: in closed form, and what a forecast keeps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.sysid.experiment.makers import EVERY, POWER, SD, C, G, heated_block
from thermogrip.datasets.errors import UserError
from thermogrip.sysid.experiment.information import (
    ExperimentForecast,
    interval_widths,
    plant_from_prior,
    reading_noise,
)
from thermogrip.sysid.models.network import NetworkModel, load_network
from thermogrip.sysid.models.network_spec import network_from_dict
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.plant.plant_data import Intervals, PlantScores


@pytest.fixture(scope="module")
def gripper() -> Plant:
    return plant_from_prior(load_network("gripper"))


def lag() -> Plant:
    """A lag of 10 K a unit over a base of 25 degC, beside a count that no limit holds for."""
    model = StateSpaceModel(
        ("q",), (), ("t", "n"), A=[[0.5]], B=[[5.0]], C=[[1.0], [100.0]], dt=2.0, y0=[25.0, 0.0]
    )
    return Plant(model, {}, dt=2.0, units={"q": "V", "t": "degC", "n": "rpm"}, valid={"q": (0.0, 3.0)})


@pytest.mark.parametrize(
    ("limits", "margin", "kept"),
    [
        ({"highest": 34.9}, 0.0, True),
        ({"highest": 34.8}, 0.0, False),
        ({"highest": 34.9}, 0.1, False),
        ({"highest": 35.0}, 0.1, True),
        ({"lowest": 25.0}, 0.0, True),
        ({"lowest": 25.1}, 0.0, False),
        ({"lowest": 25.0}, 0.1, False),
        ({}, 5.0, True),
    ],
)
def test_limits_are_of_temperatures_and_a_margin_is_inside_them(
    limits: dict[str, float], margin: float, kept: bool
):
    forecast = ExperimentForecast(lag(), **limits)
    u = np.ones((6, 1))  # 25, 30, 32.5 .. 34.84
    assert forecast.outputs(u)[0, :, 0].tolist() == pytest.approx([35 - 10 * 0.5**k for k in range(7)])
    assert forecast.stays(u, margin=margin) is kept
    assert (forecast.n_draws, forecast.dt) == (0, 2.0)
    assert not forecast.stays(np.full((6, 1), np.inf))
    only = replace(lag(), units={"q": "V", "t": "rpm", "n": "rpm"})
    assert ExperimentForecast(only, **limits).stays(u, margin=margin)


def test_signals_that_are_no_temperatures_begin_where_the_logs_had_them():
    model = StateSpaceModel(
        ("q",), ("wind", "air"), ("t", "n"), A=[[0.5]], B=[[5.0]], C=[[1.0], [0.0]], dt=2.0
    )
    units = {"q": "V", "wind": "m/s", "air": "degC", "t": "degC", "n": "rpm"}
    plant = Plant(model, {}, dt=2.0, units=units, valid={"wind": (2.0, 7.0), "n": (30.0, 90.0)})
    seen: list[Any] = []
    object.__setattr__(model, "rest", lambda *args: seen.append(args) or np.zeros(1))
    forecast = ExperimentForecast(plant)
    forecast.outputs(np.zeros((2, 1)))
    y, u, d, _ = seen[0]
    assert (y.tolist(), u.tolist(), d.tolist()) == ([25.0, 30.0], [0.0], [4.5, 25.0])


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


@pytest.mark.parametrize("name", ["gripper", "tclab"])
def test_the_belief_before_any_log_is_the_priors(name):
    model = load_network(name)
    plant = plant_from_prior(model)
    sd = dict(zip(plant.free, np.sqrt(np.diag(np.asarray(plant.covariance)))))
    wanted = {n: s.sd_log if s.scale == "log" else s.sd for n, s in model.specs.items() if n in plant.free}
    assert sd == pytest.approx(wanted)
    assert {model.specs[n].scale for n in sd} == {"log", "linear"}
    assert plant.valid == {n: item.range for n, item in model.network.inputs.items() if item.range}


def test_a_log_tells_so_many_times_less_than_the_weights_of_the_fit_say(gripper: Plant):
    sd, seconds = reading_noise(gripper)
    assert seconds.tolist() == [60.0, 60.0]
    assert sd.tolist() == [gripper.model.sensor_sd[name] for name in gripper.outputs]
    known = PlantScores(weight_s={"t_tank": 20.0, "t_surface": 45.0}, intervals=Intervals(coarsening=3.0))
    assert reading_noise(replace(gripper, scores=known))[1].tolist() == [60.0, 135.0]
    with pytest.raises(UserError, match="no stated error; identify a network"):
        reading_noise(lag())


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
