"""The covariance of a fit: its parts against dense algebra, its widths against repetition and resampling."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.fft import dct
from scipy.linalg import block_diag, toeplitz
from scipy.stats import chi2

from tests.sysid.greybox.test_fit import TRUTH, heater, made
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log
from thermogrip.sysid.greybox import noise_model
from thermogrip.sysid.greybox.fit import fit_network
from thermogrip.sysid.greybox.noise_model import Block, ErrorModel, LogData, information
from thermogrip.sysid.greybox.problem import Problem, make_problem
from thermogrip.sysid.greybox.sandwich import LogScores, agreement, moderated, score_covariance
from thermogrip.sysid.models.network import NetworkModel
from thermogrip.sysid.models.network_spec import network_from_dict
from thermogrip.sysid.plant.plant import Plant

N, N_Z, N_TERM, N_OWN = 60, 3, 2, 2
OUTPUTS = ((0, 1), (0, 1), (1,))


def some_logs() -> tuple[list[np.ndarray], list[LogData]]:
    """Three logs of random columns: parameters, missing terms, effects, residual; one lacks output 0."""
    rng = np.random.default_rng(0)
    raw = [0.1 * rng.normal(size=(N, len(o), N_Z + N_TERM + N_OWN + 1)).cumsum(axis=0) for o in OUTPUTS]
    kind = np.array([-1, -1, -1, 0, 0, 1, -1])
    logs = [LogData("a", (Block.of(x, o),), kind, N_OWN) for x, o in zip(raw, OUTPUTS)]
    return raw, logs


NUMBERS = ErrorModel((0.1, 0.2), (3.0, 15.0), ((0.2, 0.1), (0.3, 0.4)), (0.5, -0.3), (0.7, 1.4))
REF = np.array([0.3, -0.5, 1.0])


def test_the_likelihood_is_the_density_of_the_data_with_everything_integrated_out():
    raw, logs = some_logs()
    blocks, shared, left = [], [], []
    repeat = np.diff(noise_model._bands(N))
    for x, log, outputs in zip(raw, logs, OUTPUTS):
        waves = dct(x, axis=0, norm="ortho") * np.append(NUMBERS.scale(log.kind), 1.0)
        S = np.repeat(NUMBERS.covariance(N), repeat, axis=0)[:, outputs][:, :, outputs]
        own = waves[:, :, N_Z + N_TERM : -1].reshape(-1, N_OWN)
        blocks.append(block_diag(*S) + own @ own.T)
        shared.append(waves[:, :, : N_Z + N_TERM].reshape(-1, N_Z + N_TERM))
        left.append((waves[:, :, -1] + waves[:, :, :N_Z] @ REF).ravel())
    X, r = np.vstack(shared), np.concatenate(left)
    K = block_diag(*blocks) + X @ X.T
    density = -0.5 * r @ np.linalg.solve(K, r) - 0.5 * np.linalg.slogdet(K)[1]
    said = information(NUMBERS, logs, REF)
    assert said.log_likelihood == pytest.approx(density, rel=1e-10)
    np.testing.assert_allclose(said.mean, X.T @ np.linalg.solve(K, r), rtol=1e-8)


def test_its_slope_is_the_difference_of_its_values():
    _, logs = some_logs()
    v = 0.3 * np.random.default_rng(1).normal(size=12)
    _, slope = noise_model._evidence(v, logs, REF, 2, 2)
    ends = [
        [noise_model._evidence(v + sign * 1e-5 * e, logs, REF, 2, 2)[0] for sign in (1, -1)]
        for e in np.eye(12)
    ]
    np.testing.assert_allclose(slope, [(a - b) / 2e-5 for a, b in ends], rtol=1e-5, atol=1e-5)


def test_cosines_make_an_autoregressive_error_nearly_diagonal():
    numbers = ErrorModel((1e-9,), (1e-6, 20.0), ((1e-9,), (1.0,)), (0.0, 0.0))
    basis = dct(np.eye(N), axis=0, norm="ortho")
    exact = basis @ toeplitz(np.exp(-np.arange(N) / 20.0)) @ basis.T
    S = numbers.covariance(N)[:, 0, 0]
    np.testing.assert_allclose(S[:12], np.diag(exact)[:12], rtol=1e-9)  # bands of one frequency
    assert np.repeat(S, np.diff(noise_model._bands(N))).sum() == pytest.approx(N)  # the variance is kept
    scaled = exact / np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
    assert np.abs(scaled - np.eye(N)).max() < 0.25


def problem_of(plant: Plant, logs: list[Log]) -> tuple[Problem, np.ndarray]:
    model = heater()
    problem = make_problem(model, logs, average=model.average, independent=model.independent)
    problem = problem.with_tau(np.array([plant.scores.weight_s["t"] / problem.average]))
    return problem, problem.standard(plant.values)


def test_stated_widths_are_the_spread_of_repeated_fits():
    fits = [
        fit_network(heater(), [made(3 * k + j, drift=0.1, seconds=600.0) for j in range(3)])
        for k in range(24)
    ]
    stated = np.mean([np.diag(fit.covariance) for fit in fits], axis=0)
    errors = np.log([[fit.values[name] / TRUTH[name] for name in fit.free] for fit in fits])
    # 24 squares over their variance; an interval may be up to 1.7 times too wide, not too narrow
    low, high = chi2.ppf([0.001, 0.999], 24) / 24
    ratio = np.mean(errors**2, axis=0) / stated
    assert np.all(ratio < high), ratio
    assert np.all(ratio > low / 1.7**2), ratio


def test_a_block_bootstrap_of_the_residuals_gives_the_same_widths():
    rng = np.random.default_rng(0)
    logs = [made(k, drift=0.1, seconds=1800.0) for k in range(3)]
    plant = fit_network(heater(), logs)
    problem, z = problem_of(plant, logs)
    by_log = problem.by_log(z, central=True)
    inverse = np.linalg.inv(np.eye(z.size) + sum(J.T @ J for _, J in by_log))
    length = 20  # bins of 5 s: two and a half memories of the error
    draws = []
    for _ in range(400):
        pull = np.zeros(z.size)
        for r, J in by_log:
            begin = rng.integers(0, r.size - length, size=r.size // length + 1)
            sign = rng.choice([-1.0, 1.0], size=begin.size)  # blocks keep no mean
            new = np.concatenate([s * r[b : b + length] for s, b in zip(sign, begin)])[: r.size]
            pull += J.T @ new
        draws.append(inverse @ pull)
    resampled = np.std(draws, axis=0)
    stated = np.sqrt(np.diag(score_covariance(problem, z, by_log).covariance))
    # three logs: the agreement of logs is known to a factor of 2; the bootstrap cuts memories short
    assert np.all((stated / resampled > 0.8) & (stated / resampled < 3.0)), stated / resampled


def test_logs_that_differ_widen_the_interval_of_what_differs():
    def width(shares: tuple[float, ...]) -> float:
        logs = []
        for k, share in enumerate(shares):
            log = made(k, seconds=600.0).copy(deep=True)
            log["q"].values[:] *= share  # the supply differs, and nobody says so
            logs.append(log)
        low, high = fit_network(heater(), logs).intervals(0.9)["P"]
        return float(np.log(high / low))

    assert width((1.05, 0.95, 1.08, 0.93)) > 4 * width((1.0, 1.0, 1.0, 1.0))


def test_the_offset_of_each_log_is_found_with_its_width():
    content = heater().to_dict()["network"]
    content["outputs"]["second"] = {"node": "block", "lag": "lag", "sd": 0.05, "log_sd": 0.3}
    rng, logs, offsets = np.random.default_rng(5), [], [0.2, -0.1, 0.4]
    for k, offset in enumerate(offsets):
        log = made(k, seconds=600.0)
        second = log["t"].copy(data=log["t"].values + offset + 0.05 * rng.standard_normal(log.sizes["time"]))
        logs.append(log.assign(second=second))
    effects = fit_network(NetworkModel(network_from_dict(content)), logs).scores.per_log
    for log, offset in zip(effects.values(), offsets, strict=True):
        found, sd = log["offset of second"]
        assert sd < 0.05
        assert abs(found - offset) < 4 * sd


def test_a_parameter_that_may_differ_from_log_to_log_has_an_effect_of_each():
    content = heater().to_dict()["network"]
    content["parameters"]["P"]["per_log"] = 0.05
    shares, logs = (1.06, 0.95, 1.0), []
    for k, share in enumerate(shares):
        log = made(k, seconds=600.0)
        logs.append(
            log.assign(q=log["q"].copy(data=log["q"].values / share))
        )  # the same heat from another supply
    plant = fit_network(NetworkModel(network_from_dict(content)), logs)
    found = [log["P"][0] for log in plant.scores.per_log.values()]
    # what is common to all logs is the parameter's own; the differences are the logs'
    np.testing.assert_allclose(np.diff(found), np.diff(np.log(shares)), atol=0.02)


def test_a_fixed_parameter_cannot_differ_from_log_to_log():
    content = heater().to_dict()["network"]
    content["parameters"]["C"]["per_log"] = 0.05
    with pytest.raises(UserError, match="is fixed, so it cannot differ"):
        network_from_dict(content)


def test_factors_that_differ_no_more_than_chance_are_pooled():
    rng = np.random.default_rng(3)
    phi, common, freedom = moderated(2.0 * rng.chisquare(3, size=400) / 3, 4)
    assert common == pytest.approx(2.0, rel=0.15)  # mean of 400 logarithms of chi-squares of sd 0.97
    assert freedom > 50
    assert np.ptp(phi) < 0.5


def test_a_parameter_that_no_log_feels_disagrees_with_none():
    felt = np.zeros((3, 2, 2))
    felt[:, 0, 0] = 10.0
    pull = np.array([[2.0, 0.0], [-2.0, 0.0], [0.0, 0.0]])
    q = agreement(LogScores(felt, felt * 0.4, pull), np.zeros(2))
    assert q[0] == pytest.approx(0.96, abs=0.01)  # as without it
    assert q[1] == 1.0


def test_fewer_than_three_logs_say_nothing_of_each_other():
    phi, common, _ = moderated(np.array([9.0, 9.0]), 2)
    assert phi.tolist() == [1.0, 1.0]
    assert common == 1.0
