"""A fit finds what made the data, with intervals, and reports what is not identifiable."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.sysid.greybox.makers import TRUTH, TwoGains, a_log, heater, made
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log
from thermogrip.sysid.greybox import fit as greybox
from thermogrip.sysid.greybox.fit import fit_network, residual_tau
from thermogrip.sysid.greybox.problem import Problem, make_problem
from thermogrip.sysid.greybox.sandwich import score_covariance
from thermogrip.sysid.models.network import NetworkModel
from thermogrip.sysid.models.network_spec import network_from_dict
from thermogrip.sysid.plant.plant import Plant


def test_the_fit_finds_what_made_the_data():
    plant = fit_network(heater(), [made(0), made(1)])
    for name, value in TRUTH.items():
        assert plant.values[name] == pytest.approx(value, rel=0.03), name
    assert "ran out of iterations" not in plant.verdict
    assert plant.scores.identifiability.identifiable
    assert plant.noise["t"] < 0.05
    assert plant.logs == ("made0", "made1")
    assert plant.valid["q"] == (0.0, 1.0)


def test_two_conductances_side_by_side_are_not_identifiable():
    model = heater({"G2": {"unit": "W/K", "value": 0.2, "sd_log": 1.0}})
    plant = fit_network(model, [made(0, seconds=500.0)])
    report = plant.scores.identifiability
    assert not report.identifiable
    assert set(report.flat[0].replace(" up", "").replace(" down", "").split(", ")) == {"G", "G2"}
    assert "not practically identifiable" in plant.verdict
    assert plant.values["G"] + plant.values["G2"] == pytest.approx(TRUTH["G"], rel=0.05)


def test_progress_rises_to_one():
    reported: list[tuple[float, str]] = []
    fit_network(heater(), [made(0, seconds=300.0)], progress=lambda f, what: reported.append((f, what)))
    fractions = [f for f, _ in reported]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    assert all(what for _, what in reported)


def test_logs_that_do_not_fit_the_network_are_refused():
    with pytest.raises(UserError, match="no log to fit"):
        fit_network("tclab", [])
    with pytest.raises(UserError, match="column q1: no such column"):
        fit_network("tclab", [made(0, seconds=60.0)])


def test_sensitivities_agree_with_an_independent_solver():
    problem = make_problem(heater(), [made(0, sd=0.0, seconds=300.0)], average=5.0, independent=5.0)
    (stretches, bins), z = problem.logs[0], np.array([0.4, 0.3, -0.5])
    u, d = stretches[0].u[:, 0], stretches[0].d[:, 0]

    def readings(values: np.ndarray) -> np.ndarray:
        _, G, P, lag = values  # C is 50 J/K
        x, out = np.full(2, 21.0), [21.0]
        for q, air in zip(u, d):
            rate = lambda _, x, q=q, air=air: [(P * q - G * (x[0] - air)) / 50.0, (x[0] - x[1]) / lag]  # noqa: E731
            x = solve_ivp(rate, (0.0, 1.0), x, rtol=1e-10, atol=1e-10).y[:, -1]
            out.append(x[1])
        return bins[0].operators[0] @ np.array(out)

    _, jacobian = problem.by_log(z, central=True)[0]
    for k in range(3):
        ends = problem.parameters(z + 1e-3 * np.outer([1.0, -1.0], np.eye(3)[k]))
        want = (readings(ends[0]) - readings(ends[1])) / 2e-3 / problem.sd[0]
        np.testing.assert_allclose(jacobian[:, k], want, atol=2e-3 * np.abs(want).max())


Array = np.ndarray


def problem_of(model: Any, logs: Sequence[Log], plant: Plant) -> tuple[Problem, Array]:
    problem = make_problem(model, logs, average=model.average, independent=model.independent)
    weights = [plant.scores.weight_s[name] / problem.average for name in model.outputs]
    problem = replace(problem, tau=np.array(weights))
    return problem, problem.standard(plant.values)


def rms(parts: Sequence[Array]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


# ---- how often an error repeats itself ----


def test_tau_is_the_sum_of_the_correlations_of_all_stretches_together():
    rng = np.random.default_rng(0)
    slow = [np.convolve(rng.normal(size=n + 5), np.ones(6), "valid") for n in (300, 180)]
    logs = [[[rng.normal(size=250)], [slow[0]]], [[slow[1]], [rng.normal(size=20)]]]  # 20 bins say too little
    series = [logs[0][0][0], *slow]
    want, k = 1.0, 1
    while True:
        rho = sum(s[k:] @ s[:-k] for s in series) / sum(s @ s for s in series)
        if rho < 0.05:
            break
        want, k = want + 2 * rho, k + 1
    assert k > 3
    assert residual_tau(logs, np.array([7.0]))[0] == pytest.approx(want)
    assert residual_tau([[[rng.normal(size=20)]]], np.array([7.0])).tolist() == [7.0]


def test_a_log_counts_for_twenty_readings_at_least():
    drift = np.linspace(-1.0, 1.0, 400)
    assert residual_tau([[[drift]]], np.ones(1)).tolist() == [20.0]
    assert residual_tau([[[drift], [drift]]], np.ones(1)).tolist() == [40.0]


def test_a_fit_whose_errors_are_whiter_than_a_reading_a_minute_is_done_again_with_more_weight():
    white, slow = (
        fit_network(TwoGains(), [a_log(k, memory=m, seconds=n) for k in (1, 2)])
        for m, n in ((0.5, 600), (300.0, 1800))
    )
    assert slow.scores.weight_s["t"] == 60.0
    weight = white.scores.weight_s["t"]
    assert weight < 0.2 * 60.0
    # and it ends where least squares with that weight does
    problem, z = problem_of(TwoGains(), [a_log(k, memory=0.5) for k in (1, 2)], white)
    residual, jacobian = problem.residual(z), problem.jacobian(z)
    assert np.abs(np.linalg.lstsq(jacobian, residual, rcond=None)[0]).max() < 1e-4


# ---- where it begins, where it ends ----


def test_a_model_that_needs_finer_steps_where_the_fit_ended_is_fitted_with_them():
    class Fine(TwoGains):
        lags = (20.0, 100.0)

    class Coarse(TwoGains):
        lags = (30.0, 80.0)

        def prepared(self, free_runs: Any, spread: Any, p: Array | None = None) -> TwoGains:
            assert spread == {"t": np.nanstd(np.concatenate([log["t"].values for log in logs]))}
            return self if p is None else Fine()

    logs = [a_log(1), a_log(2)]
    plant, straight = fit_network(Coarse(), logs), fit_network(Fine(), logs)
    assert type(plant.model) is Fine
    assert plant.values == pytest.approx(straight.values, rel=1e-3)


class Sharp(TwoGains):
    """Its sensor is stated to be far better than the model is."""

    sensor_sd = {"t": 0.01}  # noqa: RUF012


def test_a_fit_far_beyond_its_sensors_says_so():
    found = fit_network(Sharp(), [a_log(1, seconds=200)])
    assert "it does not explain the logs, do not use it" in found.verdict


# ---- what it reports ----


@pytest.fixture(scope="module")
def reported() -> tuple[Plant, list[Log], Problem, Array]:
    """Three logs, one of them far noisier, one with a smaller input, sensors with offsets."""
    logs = [a_log(k) for k in (1, 2, 3)]
    rng = np.random.default_rng(0)
    logs[1]["t"].values[:] += 3.0 * rng.normal(size=600)
    logs[2]["q"].values[:] *= 0.5
    logs[2]["t"].values[:] -= 3.0
    model = TwoGains(0.4)
    plant = fit_network(model, logs)
    return plant, logs, *problem_of(model, logs, plant)


def test_errors_offsets_and_ranges_are_those_of_the_fit(reported: Any):
    plant, logs, problem, z = reported
    errors = problem.errors(z)
    whole = rms([stretch[0] for log in errors for stretch in log])
    assert plant.noise["t"] == pytest.approx(whole, abs=1e-3)
    starts = [begin[0].y_offset[0] for begin in problem.start(z)]
    assert np.ptp(starts) > 0.1
    assert plant.offsets["t"] == pytest.approx(np.mean(starts), abs=1e-3)
    assert plant.verdict.startswith(f"in-sample error t {whole:.2f} degC")
    assert plant.logs == ("log 1", "log 2", "log 3")
    for name in ("q", "t"):
        values = np.concatenate([log[name].values for log in logs])
        assert plant.valid[name] == (values.min(), values.max())


def test_the_covariance_is_that_of_the_score_in_the_parameters_own_units(reported: Any):
    plant, _, problem, z = reported
    spread = score_covariance(problem, z)
    np.testing.assert_allclose(plant.covariance, 16.0 * spread.covariance, rtol=1e-2)  # the prior's sd is 4 K
    stated = plant.scores.intervals
    assert stated.coarsening == pytest.approx(spread.coarsening, rel=1e-2)


def test_the_rooms_offset_is_the_mean_of_those_of_its_logs():
    content, logs = heater().to_dict()["network"], []
    content["disturbances"]["air"]["log_sd"] = 0.5
    model = NetworkModel(network_from_dict(content))
    for k, bias in enumerate((0.5, -0.1)):
        log = made(k, seconds=200.0)
        log["air"].values[:] += bias
        logs.append(log)
    plant = fit_network(model, logs)
    problem, z = problem_of(model, logs, plant)
    each = [begin[0].d_offset[0] for begin in problem.start(z)]
    assert each[0] > each[1] + 0.3
    assert plant.offsets["air"] == pytest.approx(np.mean(each), abs=1e-3)


def test_a_fit_that_runs_out_of_iterations_says_so(monkeypatch: pytest.MonkeyPatch):
    logs = [a_log(1, seconds=200)]
    assert "ran out" not in fit_network(TwoGains(), logs).verdict
    whole = greybox.bounded_least_squares
    monkeypatch.setattr(greybox, "bounded_least_squares", partial(whole, evaluations=1))
    plant = fit_network(TwoGains(), logs)
    assert "the fit ran out of iterations" in plant.verdict


def test_free_runs_are_named_by_their_logs_and_start_from_half_of_a_short_one(monkeypatch):
    logs, model = [a_log(1, seconds=100), a_log(2, seconds=41)], TwoGains()
    asked, find_starts = [], greybox.find_starts
    monkeypatch.setattr(greybox, "find_starts", lambda *of: asked.append(of[-1]) or find_starts(*of))
    found = greybox.free_runs(logs, model, np.array([3.0, 5.0]))
    assert ([name for name, _ in found], asked) == (["log 1", "log 2"], [30.0, 20.0])
    for (_, run), log in zip(found, logs):
        y, _ = model.rollout(np.zeros((1, 2)), log["q"].values[None, :, None], np.zeros(0), [[3.0, 5.0]], 1.0)
        n = log.sizes["time"] - 1
        np.testing.assert_allclose(run[0, :n, 0], y[0, :n, 0], atol=0.05)


def test_no_point_outside_the_box_is_ever_asked_for():
    asked: list[Array] = []
    low, high = np.array([0.5, -2.0]), np.array([3.0, 0.2])

    def r(z: Array) -> Array:
        asked.append(z.copy())
        return np.array([10 * (z[1] - z[0] ** 2), 1 - z[0], z[1] + 5])

    def J(z: Array) -> Array:
        asked.append(z.copy())
        return np.array([[-20 * z[0], 10.0], [-1.0, 0.0], [0.0, 1.0]])

    greybox.bounded_least_squares(r, J, np.array([9.0, 9.0]), low=low, high=high)
    points = np.vstack(asked)
    assert np.all((points >= low) & (points <= high))


def test_what_cannot_be_simulated_never_wins():
    def r(z: Array) -> Array:
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.append(np.log(z) - np.log(0.1), 0.01 * z)  # NaN below nought

    ends = {"low": np.full(1, -1e6), "high": np.full(1, 1e6)}
    found = greybox.bounded_least_squares(
        r, lambda z: np.array([[1 / z[0]], [0.01]]), np.full(1, 5.0), **ends
    )
    assert found.success
    assert found.x[0] == pytest.approx(0.1, rel=1e-3)
