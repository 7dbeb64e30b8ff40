"""The covariance of slow errors, and the responses of the model discrepancy."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from scipy.fft import dct
from scipy.linalg import toeplitz

from thermogrip.datasets.schema import make_log
from thermogrip.sysid.greybox import random_effects
from thermogrip.sysid.greybox.noise_model import ErrorModel, _frequency_bands
from thermogrip.sysid.greybox.problem import make_problem
from thermogrip.sysid.models.network import load_network

NUMBERS = ErrorModel((0.4, 0.7), (3.0, 15.0), ((0.5, 0.2), (0.3, 0.6)), (0.5, -0.3))


def test_the_covariance_of_the_cosines_is_that_in_time():
    lag = np.arange(60)
    alone = 0.5**2 * np.exp(-lag / 3.0) + 0.3**2 * np.exp(-lag / 15.0) + 0.4**2 * (lag == 0)
    together = 0.5 * 0.5 * 0.2 * np.exp(-lag / 3.0) - 0.3 * 0.3 * 0.6 * np.exp(-lag / 15.0)
    for k, in_time in enumerate((alone, together)):
        waves = dct(dct(toeplitz(in_time), axis=0, norm="ortho"), axis=1, norm="ortho")
        bands = np.split(np.diag(waves), _frequency_bands(60)[1:-1])
        expected = [band.mean() for band in bands]
        np.testing.assert_allclose(NUMBERS.covariance(60)[:, 0, k], expected, rtol=1e-9, atol=1e-12)


def test_signals_of_the_discrepancy_are_about_the_air_or_the_mean():
    model = SimpleNamespace(inputs=("drive", "pump"), disturbances=("air",), switches=("pump",))
    u, d = np.array([[-1.0, 1.0], [2.0, 0.0]]), np.array([[20.0], [21.0]])
    run = np.array([[25.0], [18.0], [99.0]])
    found = random_effects.signals(model, u, d, run)
    want = {
        "v |v|": [25.0, -9.0], "drive": [-1.0, 2.0], "drive v": [-5.0, -6.0], "|drive|": [1.0, 2.0],
        "pump": [1.0, 0.0], "pump v": [5.0, 0.0], "air ": [0.0, 1.0],
    }  # fmt: skip
    assert {name: value.tolist() for name, value in found.items()} == want
    model.disturbances = ()
    still = random_effects.signals(model, u, np.zeros((2, 0)), np.array([[25.0], [18.0], [23.0]]))
    assert still["v |v|"].tolist() == [9.0, -16.0]


def test_all_responses_of_the_discrepancy_have_the_stated_size_together():
    model, rng = load_network("tclab"), np.random.default_rng(0)
    signals = {name: (rng.uniform(0, 100, 300), "percent", "input") for name in model.inputs}
    signals |= {name: (25 + rng.normal(size=300), "degC", "output") for name in model.outputs}
    problem = make_problem(model, [make_log(np.arange(300.0), signals)], average=5.0, independent=5.0)
    run = rng.normal(25.0, 3.0, (len(problem.logs[0][0][0].u) + 1, 2))
    squares = [
        np.mean(np.square(moves[0]))  # of two outputs with as many bins
        for _, moves in random_effects.discrepancy_responses(problem, [[run]])
    ]
    assert len(squares) == 5 * len(random_effects.EFFECTS.lags)
    np.testing.assert_allclose(np.sqrt(np.sum(squares)), random_effects.EFFECTS.discrepancy_rms)
