"""The covariance of a fit: its parts against dense algebra, its widths against repetition and resampling."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.fft import dct
from scipy.linalg import block_diag, toeplitz
from scipy.special import digamma
from scipy.stats import chi2

from tests.sysid.greybox.makers import TRUTH, TwoGains, a_log, heater, made
from thermogrip.datasets.errors import UserError
from thermogrip.sysid.greybox import noise_model
from thermogrip.sysid.greybox.fit import bounded_least_squares, fit_network
from thermogrip.sysid.greybox.noise_model import Block, ErrorModel, LogData, information
from thermogrip.sysid.greybox.problem import Problem, make_problem
from thermogrip.sysid.greybox.random_effects import linearise_logs
from thermogrip.sysid.greybox.sandwich import (
    LogScores,
    ScoreCovariance,
    common_factor,
    disagreement,
    score_covariance,
)
from thermogrip.sysid.models.network import NetworkModel
from thermogrip.sysid.models.network_spec import network_from_dict

N, N_Z, N_TERM, N_OWN = 60, 3, 2, 2
OUTPUTS = ((0, 1), (0, 1), (1,))
NO_TERMS = np.zeros((0, 0, 0))


def some_logs() -> tuple[list[np.ndarray], list[LogData]]:
    """Three logs of random columns: parameters, model discrepancy, effects, residual; one lacks output 0."""
    rng = np.random.default_rng(0)
    raw = [0.1 * rng.normal(size=(N, len(o), N_Z + N_TERM + N_OWN + 1)).cumsum(axis=0) for o in OUTPUTS]
    kind = np.array([-1, -1, -1, 0, 0, 1, -1])
    logs = [LogData((Block.of(x, o),), kind, N_OWN) for x, o in zip(raw, OUTPUTS)]
    return raw, logs


NUMBERS = ErrorModel((0.1, 0.2), (3.0, 15.0), ((0.2, 0.1), (0.3, 0.4)), (0.5, -0.3), (0.7, 1.4))
REF = np.array([0.3, -0.5, 1.0])


def test_the_likelihood_is_the_density_of_the_data_with_everything_integrated_out():
    raw, logs = some_logs()
    blocks, shared, left = [], [], []
    repeat = np.diff(noise_model._frequency_bands(N))
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
    stated = information(NUMBERS, logs, REF)
    assert stated.log_likelihood == pytest.approx(density, rel=1e-10)
    np.testing.assert_allclose(stated.mean, X.T @ np.linalg.solve(K, r), rtol=1e-8)


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
    assert np.repeat(S, np.diff(noise_model._frequency_bands(N))).sum() == pytest.approx(
        N
    )  # the variance is kept
    scaled = exact / np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
    assert np.abs(scaled - np.eye(N)).max() < 0.25


@pytest.mark.slow
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


def test_a_parameter_that_may_differ_from_log_to_log_has_an_effect_of_each():
    content = heater().to_dict()["network"]
    content["parameters"]["P"]["per_log"] = 0.05
    shares, logs = (1.06, 0.95, 1.0), []
    for k, share in enumerate(shares):
        log = made(k, seconds=600.0)
        logs.append(
            log.assign(q=log["q"].copy(data=log["q"].values / share))
        )  # the same heat from another supply
    model = NetworkModel(network_from_dict(content))
    problem = make_problem(model, logs, average=model.average, independent=60.0)
    z = problem.standard(fit_network(model, logs).values)
    data = linearise_logs(problem, z, problem.by_log(z))
    effects = information(score_covariance(problem, z).numbers, data.logs, z).effects
    column = [name for name in data.kinds if not name.startswith("term ")].index("P")
    scale = 0.05 * score_covariance(problem, z).numbers.spread[data.kinds.index("P")]
    # what is common to all logs is the parameter's own; the differences are the logs'
    found = [scale * mean[column] for mean, _ in effects]
    np.testing.assert_allclose(np.diff(found), np.diff(np.log(shares)), atol=0.02)


def test_a_parameter_that_no_log_feels_disagrees_with_none():
    felt = np.zeros((3, 2, 2))
    felt[:, 0, 0] = 10.0
    pull = np.array([[2.0, 0.0], [-2.0, 0.0], [0.0, 0.0]])
    q = disagreement(LogScores(felt, felt * 0.4, pull, NO_TERMS), np.zeros(2))
    assert q[0] == pytest.approx(0.96, abs=0.01)  # as without it
    assert q[1] == 1.0


def test_fewer_than_three_logs_say_nothing_of_each_other():
    assert common_factor(np.array([9.0, 9.0]), 2) == 1.0


Array = np.ndarray
SMALL = 1e-9


def fitted(*seeds: int, seconds: int = 600) -> tuple[Problem, Array, list[tuple[Array, Array]]]:
    logs = [a_log(seed, seconds=seconds) for seed in seeds]
    problem = make_problem(TwoGains(), logs, average=4.0, independent=60.0)
    low, high = problem.box
    z = bounded_least_squares(
        problem.residual, problem.jacobian, np.zeros(2), low=low, high=high, tolerance=1e-12
    ).x
    return problem, z, problem.by_log(z, central=True)


def white(problem: Problem, z: Array, w: float) -> ErrorModel:
    """Return the numbers of white errors of sd w a bin, without memory, model discrepancy or effects."""
    learnt = score_covariance(problem, z).numbers
    none = ((SMALL,), (SMALL,))
    return ErrorModel((w,), (1e-3, 1e-3), none, (0.0, 0.0), (SMALL,) * len(learnt.spread))


def by_hand(
    problem: Problem, z: Array, by_log: list[tuple[Array, Array]], w: float
) -> tuple[Array, Array, LogScores]:
    """Return P, the sum of V and each log's part, of bins whose errors are white."""
    hessian = np.array([J.T @ J for _, J in by_log])
    score = np.array([-J.T @ r for r, J in by_log])  # reading less model pulls upwards
    scores = LogScores(hessian, w**2 * hessian, score, NO_TERMS)
    return np.eye(2) + hessian.sum(axis=0), w**2 * hessian.sum(axis=0), scores


@pytest.mark.parametrize("w", [0.4, 2.5])
def test_white_errors_of_three_logs_give_the_sandwich_of_their_slopes(w: float):
    problem, z, by_log = fitted(1, 2, 3)
    found = score_covariance(problem, z, by_log, white(problem, z, w))
    P, V, scores = by_hand(problem, z, by_log, w)
    np.testing.assert_allclose(found.hessian, P, rtol=1e-6)
    phi = common_factor(disagreement(scores, z), 3)
    assert found.phi == pytest.approx(phi, rel=1e-4)
    np.testing.assert_allclose(found.spread, phi * V, rtol=1e-4)
    inverse = np.linalg.inv(P)
    np.testing.assert_allclose(found.covariance, inverse @ (np.eye(2) + phi * V) @ inverse, rtol=1e-4)
    coarse = np.trace(inverse @ (phi * V)) / np.trace(inverse @ (P - np.eye(2)))
    assert found.coarsening == pytest.approx(max(1.0, coarse), rel=1e-4)
    assert found.bin_s == 4.0


def test_a_parameter_is_never_stated_less_surely_than_by_its_prior_and_no_other_more_surely_for_that():
    problem, z, by_log = fitted(1, 2, 3)
    found = score_covariance(problem, z, by_log, white(problem, z, 48.0))
    P, V, scores = by_hand(problem, z, by_log, 48.0)
    phi = common_factor(disagreement(scores, z), 3)
    whole = np.linalg.inv(P) @ (np.eye(2) + phi * V) @ np.linalg.inv(P)
    sd = np.sqrt(np.diag(whole))
    assert sd.min() < 0.9 < 1.0 < sd.max()
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), np.minimum(sd, 1.0), rtol=1e-4)
    correlation = found.covariance[0, 1] / np.sqrt(np.prod(np.diag(found.covariance)))
    assert correlation == pytest.approx(whole[0, 1] / sd.prod(), rel=1e-3)


def test_long_logs_are_averaged_and_a_mean_stands_for_its_bins():
    problem, z, by_log = fitted(1, 2, 3, seconds=2000)  # 500 bins, of which two make one
    w = 1.3
    found = score_covariance(problem, z, by_log, white(problem, z, w))
    assert found.bin_s == 8.0
    V = np.zeros((2, 2))
    for _, J in by_log:
        means = J.reshape(-1, 2, 2).mean(axis=1)
        V += (2 * w) ** 2 * means.T @ means
    np.testing.assert_allclose(found.spread / found.phi, V, rtol=1e-3)
    np.testing.assert_allclose(found.hessian, np.eye(2) + V / (2 * w**2), rtol=1e-3)


def test_what_a_discrepancy_moves_is_uncertain_in_all_logs_alike():
    problem, z, by_log = fitted(1, 2, 3)
    numbers = white(problem, z, 0.4)
    none = score_covariance(problem, z, by_log, numbers)
    some, twice = (
        score_covariance(problem, z, by_log, replace(numbers, spread=(s,) * len(numbers.spread)))
        for s in (0.5, 1.0)
    )
    inverse = np.linalg.inv(some.hessian)
    own = [found.covariance - inverse @ found.spread @ inverse for found in (none, some, twice)]
    # the factor by which logs differ is theirs, not that of what all logs share
    np.testing.assert_allclose(np.diag(own[0]), np.diag(inverse @ inverse), rtol=1e-3)
    more = np.diag(own[1] - own[0])
    assert more.max() > 1e-3 * np.diag(none.covariance).max()
    np.testing.assert_allclose(np.diag(own[2] - own[0]), 4 * more, rtol=1e-3)


def left_out(scores: LogScores, z: Array) -> Array:
    """Return q_i: how far leaving a log out moves the estimate, over what its errors let expect."""
    A, V = scores.hessian, scores.spread
    n, logs = z.size, range(len(A))
    pulls = [scores.score[k] + A[k] @ z for k in logs]
    whole = np.linalg.inv(np.eye(n) + sum(A))
    q = []
    for out in logs:
        rest = np.linalg.inv(np.eye(n) + sum(A[k] for k in logs if k != out))
        weights = [rest - whole if k != out else -whole for k in logs]  # of each pull in the difference
        moved = sum(weight @ pull for weight, pull in zip(weights, pulls))
        covariance = (rest - whole) @ (rest - whole).T  # the prior's own draw
        covariance = covariance + sum(weight @ v @ weight.T for weight, v in zip(weights, V))
        q.append(moved**2 / np.diag(covariance))
    return np.mean(q, axis=0)


@pytest.mark.parametrize("n_log", [3, 4, 7])
def test_logs_agree_by_how_far_leaving_each_out_moves_the_estimate(n_log: int):
    rng = np.random.default_rng(n_log)
    J = rng.normal(size=(n_log, 9, 3))
    A = np.einsum("lij,lik->ljk", J, J)
    W = rng.normal(size=(n_log, 5, 3))
    scores = LogScores(A, np.einsum("lij,lik->ljk", W, W), 3.0 * rng.normal(size=(n_log, 3)), NO_TERMS)
    z = rng.normal(size=3)
    np.testing.assert_allclose(disagreement(scores, z), left_out(scores, z), rtol=1e-9)


def test_logs_that_agree_better_than_they_should_count_with_the_model_as_one_more():
    low = np.full(6, 1e-4)
    alone = np.exp(np.log(1e-4) - digamma(2) + np.log(2))
    assert common_factor(low, 5) == pytest.approx((1 + 4 * alone) / 5)
    assert common_factor(np.full(4, 9.0), 5) > 9.0  # the mean of ln q is below the ln of its mean


def test_nine_bins_are_too_few_and_ten_are_not():
    problem, z, by_log = fitted(1, seconds=37)
    assert sum(r.size for r, _ in by_log) == 9
    with pytest.raises(UserError, match=r"too short: fewer than 10 means of 4 s"):
        score_covariance(problem, z, by_log)
    problem, z, by_log = fitted(1, seconds=41)
    assert sum(r.size for r, _ in by_log) == 10
    assert isinstance(score_covariance(problem, z, by_log), ScoreCovariance)
