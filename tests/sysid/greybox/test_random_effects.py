"""What a warm-up leaves unknown of a start, against repetition and the limits of no and of many readings."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.fft import dct
from scipy.linalg import toeplitz
from scipy.stats import chi2

from thermogrip.datasets.schema import make_log
from thermogrip.sysid.greybox import random_effects
from thermogrip.sysid.greybox.noise_model import ErrorModel, _frequency_bands
from thermogrip.sysid.greybox.problem import make_problem, prior_plant
from thermogrip.sysid.greybox.random_effects import WarmUp, linearise_logs, warm_noise
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.plant.simulation import predict

NUMBERS = ErrorModel((0.4, 0.7), (3.0, 15.0), ((0.5, 0.2), (0.3, 0.6)), (0.5, -0.3))


def some_start() -> WarmUp:
    rng = np.random.default_rng(0)
    return WarmUp((0, 1, 2), rng.normal(size=(12, 2, 3)), (0, 1), np.array([1.2, 0.9]))


def test_the_covariance_in_time_is_that_of_the_cosines():
    n = 60
    whole = NUMBERS.in_time(n)
    for j in range(2):
        for k in range(2):
            waves = dct(dct(whole[:, j, :, k], axis=0, norm="ortho"), axis=1, norm="ortho")
            bands = np.split(np.diag(waves), _frequency_bands(n)[1:-1])
            expected = [band.mean() for band in bands]
            np.testing.assert_allclose(NUMBERS.covariance(n)[:, j, k], expected, rtol=1e-9, atol=1e-12)
    slow = np.arange(n)
    alone = 0.5**2 * np.exp(-slow / 3.0) + 0.3**2 * np.exp(-slow / 15.0) + 0.4**2 * (slow == 0)
    np.testing.assert_allclose(whole[:, 0, :, 0], toeplitz(alone), rtol=1e-12)


def test_the_error_of_a_start_is_the_spread_of_repeated_estimates():
    first, spread = some_start(), np.array([1.0, 0.5, 2.0])
    n, n_y, k = first.columns.shape
    rng, count = np.random.default_rng(1), 4000
    B, r = first.columns.reshape(-1, k), np.tile(first.noise, n)
    C = NUMBERS.in_time(n).reshape(n * n_y, -1)
    start = spread * rng.normal(size=(count, k))
    readings = start @ B.T + rng.multivariate_normal(np.zeros(len(C)), C, size=count)
    rows = np.vstack([B / r[:, None], np.eye(k)])
    right = np.hstack([readings / r, np.zeros((count, k))])
    found = np.linalg.lstsq(rows, right.T, rcond=None)[0].T
    seen = np.linalg.solve(first.error(NUMBERS, spread), np.cov((found - start).T, bias=True))
    # whitened, each of the k variances is chi-squared over count
    low, high = chi2.ppf([1e-4, 1 - 1e-4], count) / count
    assert np.all((np.linalg.eigvals(seen).real > low - 0.05) & (np.linalg.eigvals(seen).real < high + 0.05))


def test_what_no_bin_feels_keeps_its_spread_and_what_all_feel_is_known():
    columns = np.zeros((12, 2, 2))
    columns[:, :, 1] = 1e4
    left = WarmUp((0, 1), columns, (0, 1), np.ones(2)).error(NUMBERS, np.array([0.7, 1.0]))
    assert left[0, 0] == pytest.approx(0.49)
    assert left[1, 1] < 1e-7


def test_a_warm_up_counts_a_reading_every_ten_seconds():
    # the mean of all bins: as well known as that of 7 readings
    assert warm_noise(60.0, 5.0) / np.sqrt(60.0 / 5.0) == pytest.approx(1 / np.sqrt(7.0))


def test_fits_know_their_starts_as_well_as_they_say():
    """Two heaters that were on, unseen, before the log begins."""
    model = load_network("tclab")
    plant = prior_plant(model)
    n, sd, count = 300, 0.4, 150
    hot = np.array([31.0, 27.0, 31.0, 27.0])
    u = np.zeros((n, 2))
    truth = model.rollout(hot[None], u[None], np.zeros((1, n, 0)), plant.p[None], 1.0)[0][0]
    rng, errors = np.random.default_rng(0), []
    for _ in range(count):
        columns = {name: (u[:, k], "percent", "input") for k, name in enumerate(model.inputs)}
        for k, name in enumerate(model.outputs):
            columns[name] = (truth[:-1, k] + sd * rng.standard_normal(n), "degC", "output")
        problem = make_problem(model, [make_log(np.arange(float(n)), columns)], average=5.0, independent=5.0)
        z = np.zeros(len(problem.free))
        run = predict(model, 1.0, plant.p[None], problem.logs[0][0], problem.start(z)[0])[0][0]
        errors.append((run - truth[:n])[2:58:5])  # the middle of the bins of the warm-up
    first = linearise_logs(problem, z, problem.by_log(z)).warm[0]
    assert first is not None
    # white noise of a second, five to a bin
    numbers = ErrorModel((1 / np.sqrt(5),) * 2, (1.0, 1.0), ((1e-9, 1e-9),) * 2, (0.0, 0.0))
    # one start again and again; its first guess, a mean of 2 s, differs by less than a state by its spread
    least, most, prior = (
        np.einsum("tjk,kl,tjl->tj", first.columns, left, first.columns) * sd**2
        for left in (
            *(first.error(numbers, s * np.ones(len(first.effects))) for s in (0, 1)),
            np.eye(len(first.effects)),
        )
    )
    seen = np.var(errors, axis=0)[: len(most)]
    low, high = chi2.ppf([1e-4, 1 - 1e-4], count) / count
    assert np.all((seen > low * least) & (seen < high * most)), (seen / least, seen / most)
    assert most[6:].max() < 0.03 * prior[6:].max()  # after half a minute 2 K are a third of a kelvin


def test_a_log_that_began_at_rest_has_no_start_to_estimate():
    model = load_network("gripper")
    t = np.arange(0.0, 600.0, 0.5)
    drive = np.where(t > 30, 0.3, 0.0)
    still = np.full(t.size, 22.0)
    signals = {
        "drive": (drive, "1", "input"),
        "pump": (np.ones(t.size), "1", "input"),
        "t_ambient": (still, "degC", "disturbance"),
    }
    readings = dict.fromkeys(model.outputs, (still, "degC", "output"))
    run = prior_plant(model).simulate(make_log(t, signals | readings))
    log = make_log(t, signals | {name: (run[name].values, "degC", "output") for name in model.outputs})
    problem = make_problem(model, [log], average=5.0, independent=60.0)
    z = np.zeros(len(problem.free))
    assert linearise_logs(problem, z, problem.by_log(z)).warm == [None]


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
        np.mean([np.square(bins / sd) for bins, sd in zip(moves[0][0], problem.sd)])
        for _, moves in random_effects.discrepancy_responses(problem, [[run]])
    ]
    assert len(squares) == 5 * len(random_effects.EFFECTS.lags)
    np.testing.assert_allclose(np.sqrt(np.sum(squares)), random_effects.EFFECTS.discrepancy_rms)
