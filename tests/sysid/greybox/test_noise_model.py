"""Numbers of a free run's error: found again where they are known, and reported in words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from thermogrip.sysid.greybox.noise_model import Block, ErrorModel, LogData, information, learn_error_model

Array = np.ndarray
NONE = np.array([-1])


def ar(rng: np.random.Generator, n: int, tau: float) -> Array:
    """Return a process of sd 1 that forgets over tau bins."""
    keep = np.exp(-1 / tau)
    return lfilter([np.sqrt(1 - keep**2)], [1.0, -keep], rng.normal(size=n + 2000))[2000:]


def log_of(y: Array, outputs: tuple[int, ...], *, parts: int = 1, effect: Array | None = None) -> LogData:
    """Return residuals (n, n_y) with one parameter that moves nothing, and perhaps an effect of the log."""
    still = np.zeros((*y.shape, 1))
    columns = [still] if effect is None else [still, effect[:, :, None]]
    whole = np.concatenate([*columns, y[:, :, None]], axis=2)
    blocks = tuple(Block.of(part, outputs) for part in np.array_split(whole, parts))
    kind = NONE if effect is None else np.array([-1, 0])
    return LogData(blocks, kind, 0 if effect is None else 1)


def test_correlation_times_and_noise_of_two_outputs_are_found_again():
    """Of 12 x 1500 bins; an sd of 20 memories of 25 bins a log is known to 5 %, and its memory to 10 %."""
    rng, logs = np.random.default_rng(0), []
    for _ in range(12):
        common, own = ar(rng, 1500, 25.0), [ar(rng, 1500, 25.0) for _ in range(2)]
        r = 0.6  # of the two outputs' slow errors
        slow = np.stack([np.sqrt(r) * common + np.sqrt(1 - r) * each for each in own], axis=1)
        logs.append(log_of(slow * [2.0, 0.5] + rng.normal(size=(1500, 2)) * [0.4, 0.3], (0, 1)))
    found = learn_error_model(logs, np.zeros(1), width=())
    want = ErrorModel((0.4, 0.3), (25.0,), ((2.0, 0.5),), (0.6,))
    # what counts is the covariance, however two memories share it
    np.testing.assert_allclose(found.covariance(50), want.covariance(50), rtol=0.15, atol=0.02)


def test_effects_of_logs_have_the_spread_that_made_them():
    rng, logs = np.random.default_rng(1), []
    for _ in range(16):
        effect = np.ones((60, 1))
        y = 2.0 * rng.normal() * effect + 0.3 * rng.normal(size=(60, 1))
        logs.append(log_of(y, (0,), effect=effect))
    found = learn_error_model(logs, np.zeros(1), width=(2.0,))
    assert found.spread[0] == pytest.approx(2.0, rel=4 / np.sqrt(2 * 16))
    sure = learn_error_model(logs, np.zeros(1), width=(0.01,))  # what was stated beforehand stays
    assert sure.spread[0] == pytest.approx(1.0, abs=0.02)


def test_what_is_learnt_is_likeliest_under_its_prior():
    rng, logs = np.random.default_rng(5), []
    for _ in range(6):
        effect = np.ones((60, 1))
        logs.append(log_of(3.0 * rng.normal() * effect + 0.3 * rng.normal(size=(60, 1)), (0,), effect=effect))
    width = 0.5
    found = learn_error_model(logs, np.zeros(1), width=(width,))
    assert 1.2 < found.spread[0] < 3.0  # between what was stated and what made them

    def worth(shift: float) -> float:
        s = float(np.exp(np.log(found.spread[0]) + shift))
        stated = information(replace(found, spread=(s,)), logs, np.zeros(1)).log_likelihood
        return stated - 0.5 * (np.log(s) / width) ** 2

    assert abs(worth(0.01) - worth(-0.01)) / 0.02 < 0.1
    assert worth(0.0) > max(worth(0.2), worth(-0.2))


def test_effects_go_with_the_parameters_that_explain_them_too():
    """A dense posterior of a parameter that all logs share and an effect of each, by normal equations."""
    rng = np.random.default_rng(2)
    raw = rng.normal(size=(3, 80, 1, 3))  # a parameter, an effect, the residual
    logs = [LogData((Block.of(x, (0,)),), np.array([-1, 0]), 1) for x in raw]
    numbers = ErrorModel((0.5,), (1e-3, 1e-3), ((1e-9,), (1e-9,)), (0.0, 0.0), (1.7,))
    ref = np.array([0.4])
    X, y = np.zeros((240, 4)), np.zeros(240)
    for k, x in enumerate(raw[:, :, 0]):
        rows = slice(80 * k, 80 * k + 80)
        X[rows, 0], X[rows, 1 + k] = x[:, 0], 1.7 * x[:, 1]
        y[rows] = x[:, 2] + x[:, 0] * ref[0]
    covariance = np.linalg.inv(np.eye(4) + X.T @ X / 0.25)
    mean = covariance @ X.T @ y / 0.25
    stated = information(numbers, logs, ref)
    np.testing.assert_allclose((stated.mean, stated.covariance[0]), (mean[:1], covariance[0, :1]), rtol=1e-9)
    for k, ((own, spread), joint) in enumerate(zip(stated.effects, stated.joint)):
        at = [0, 1 + k]
        np.testing.assert_allclose((own[0], spread[0, 0]), (mean[1 + k], covariance[1 + k, 1 + k]), rtol=1e-9)
        np.testing.assert_allclose(joint, covariance[np.ix_(at, at)], rtol=1e-9)


def test_the_error_is_reported_in_seconds_and_the_outputs_units():
    numbers = ErrorModel((1.0, 1.0), (2.0, 30.0), ((0.5, 0.2), (1.5, 0.1)), (0.25, -0.5))
    stated = numbers.describe(("t_tank", "power"), 5.0, [(0.2, "degC"), (10.0, "W")])
    assert stated == (
        "model error t_tank 0.1 degC, power 2 W over 10 s, correlation 0.25; "
        "t_tank 0.3 degC, power 1 W over 150 s, correlation -0.50"
    )
    one = ErrorModel((1.0,), (2.0,), ((0.5,),), (0.0,)).describe(("t",), 4.0, [(0.1, "degC")])
    assert one == "model error t 0.05 degC over 8 s"
