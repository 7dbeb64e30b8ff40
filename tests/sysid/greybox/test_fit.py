"""A fit finds what made the data, says how sure it is, and says what the data do not tell."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares
from scipy.stats import binom

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, make_log
from thermogrip.sysid.greybox.fit import fit_network, residual_tau
from thermogrip.sysid.greybox.identifiability import jackknife_sd, weakest_direction
from thermogrip.sysid.greybox.levenberg_marquardt import levenberg_marquardt
from thermogrip.sysid.greybox.problem import make_problem, prior_plant
from thermogrip.sysid.models.network import NetworkModel, load_network
from thermogrip.sysid.models.network_spec import network_from_dict


def heater(extra: dict[str, Any] | None = None) -> NetworkModel:
    """A heated block with a sensor lag; ``extra`` parameters may split its loss into two."""
    content: dict[str, Any] = {
        "schema": "thermogrip.network", "version": 1, "name": "block", "dt": 1.0,
        "inputs": {"q": {"unit": "1", "range": [0.0, 1.0]}},
        "disturbances": {"air": {}},
        "outputs": {"t": {"node": "block", "lag": "lag", "sd": 0.05, "reference": True}},
        "nodes": {"block": {"capacity": "C"}},
        "links": {"loss": {"between": ["block", "air"], "conductance": "G"}},
        "heaters": {"h": {"node": "block", "input": "q", "power": "P"}},
        "parameters": {
            "C": {"unit": "J/K", "value": 50.0, "fixed": True},
            "G": {"unit": "W/K", "value": 0.5, "sd_log": 1.0},
            "P": {"unit": "W", "value": 10.0, "sd_log": 1.0},
            "lag": {"unit": "s", "value": 5.0, "sd_log": 1.0},
        },
    }  # fmt: skip
    if extra:
        content["links"]["second"] = {"between": ["block", "air"], "conductance": "G2"}
        content["parameters"] |= extra
    return NetworkModel(network_from_dict(content))


TRUTH = {"G": 0.8, "P": 17.0, "lag": 9.0}


def made(seed: int, sd: float = 0.05, seconds: float = 900.0, drift: float = 0.0) -> Log:
    """A log of the true block, with white noise and, if asked, a slow wander of the reading."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 0.5)
    q = np.repeat(rng.random(int(seconds // 30) + 1) < 0.5, 60)[: t.size].astype(float) * (t >= 5)
    still = np.full(t.size, 21.0)
    signals = {"q": (q, "1", "input"), "air": (still, "degC", "disturbance")}
    plant = prior_plant(heater())
    plant = replace(plant, values=plant.values | TRUTH)
    run = plant.simulate(make_log(t, signals | {"t": (still, "degC", "output")}))
    slow = np.zeros(t.size)
    if drift:
        steps = rng.standard_normal(t.size)
        for k in range(1, t.size):  # an AR(1) error of 40 s
            slow[k] = slow[k - 1] * np.exp(-0.5 / 40) + steps[k] * np.sqrt(1 - np.exp(-1.0 / 40))
    read = run["t"].values + sd * rng.standard_normal(t.size) + drift * slow
    return make_log(t, signals | {"t": (read, "degC", "output")}, name=f"made{seed}")


def test_the_fit_finds_what_made_the_data():
    plant = fit_network(heater(), [made(0), made(1)])
    for name, value in TRUTH.items():
        assert plant.values[name] == pytest.approx(value, rel=0.03), name
    assert plant.scores.converged
    assert plant.scores.identifiability.identifiable
    assert plant.noise["t"] < 0.05
    assert plant.logs == ("made0", "made1")
    assert plant.valid["q"] == (0.0, 1.0)


def test_ninety_per_cent_intervals_cover_also_where_the_error_is_slow():
    inside = total = 0
    for seed in range(0, 36, 3):
        plant = fit_network(heater(), [made(seed + k, drift=0.1, seconds=600.0) for k in range(3)])
        for name, (low, high) in plant.intervals(0.9).items():
            inside += low <= TRUTH[name] <= high
            total += 1
    # three parameters of one fit are not independent, so 12 fits count, not 36 intervals
    assert inside / total >= binom.ppf(0.01, 12, 0.9) / 12
    assert total == 36


def test_white_noise_intervals_are_not_absurdly_wide():
    plant = fit_network(heater(), [made(k) for k in range(3)])
    low, high = plant.intervals(0.9)["P"]
    assert high / low < 1.1


def test_two_conductances_side_by_side_are_not_told_apart():
    model = heater({"G2": {"unit": "W/K", "value": 0.2, "sd_log": 1.0}})
    plant = fit_network(model, [made(0, seconds=500.0)])
    report = plant.scores.identifiability
    assert not report.identifiable
    assert set(report.weakest.replace(" up", "").replace(" down", "").split(", ")) == {"G", "G2"}
    assert "do not tell" in plant.verdict
    assert plant.values["G"] + plant.values["G2"] == pytest.approx(TRUTH["G"], rel=0.05)


def test_a_lost_channel_and_nan_are_left_out_of_the_cost():
    log = made(0)
    holes = log.copy(deep=True)
    holes["t"][200:400] = np.nan
    plant = fit_network(heater(), [holes])
    assert plant.values["P"] == pytest.approx(TRUTH["P"], rel=0.05)


def test_a_gap_does_not_spoil_the_fit():
    log = made(3)
    t = log["time"].values
    plant = fit_network(heater(), [log.isel(time=np.flatnonzero((t < 400) | (t > 437)))])
    for name, value in TRUTH.items():
        assert plant.values[name] == pytest.approx(value, rel=0.06), name


def test_sensitivities_agree_with_casadi():
    import casadi as ca

    model, n = load_network("gripper"), 60
    p = ca.SX.sym("p", len(model.parameters))
    rng = np.random.default_rng(0)
    u = np.column_stack([rng.uniform(-1, 1, n), (np.arange(n) < 40).astype(float)])
    x: list[Any] = [25.0 + 0.3 * i for i in range(model.n_x)]
    x0 = np.array(x, dtype=float)
    for row in u:
        x = model.step(x, row.tolist(), [24.0], ca.vertsplit(p), model.dt)
    end = ca.vertcat(*model.output(x, ca.vertsplit(p)))
    exact = np.array(ca.Function("J", [p], [ca.jacobian(end, p)])(model.prior))
    step = 1e-5 * np.maximum(np.abs(model.prior), 1e-3)
    around = np.vstack([model.prior, model.prior + np.diag(step)])
    ends = model.rollout(np.tile(x0, (len(around), 1)), u[None], np.full((1, n, 1), 24.0), around, model.dt)[
        0
    ]
    differences = ((ends[1:, -1] - ends[0, -1]) / step[:, None]).T
    np.testing.assert_allclose(differences, exact, rtol=2e-3, atol=1e-4 * np.abs(exact).max())


def test_the_problems_jacobian_is_the_slope_of_its_residuals():
    problem = make_problem(heater(), [made(0, seconds=300.0)], average=5.0, independent=60.0)
    z = np.array([0.3, 0.4, -0.2])
    _, jacobian = problem.linearise(z)
    h = 1e-3
    ends = problem.trials(np.vstack([z + h * np.eye(3), z - h * np.eye(3)]))
    np.testing.assert_allclose(jacobian, ((ends[:3] - ends[3:]) / (2 * h)).T, rtol=2e-3, atol=1e-3)


def test_a_random_search_ends_where_the_local_fit_does():
    logs = [made(0, seconds=400.0)]
    local, searched = fit_network(heater(), logs), fit_network(heater(), logs, starts=1)
    assert searched.scores.starts == 1
    assert searched.values["P"] == pytest.approx(local.values["P"], rel=1e-3)


def test_progress_rises_to_one():
    told: list[tuple[float, str]] = []
    fit_network(heater(), [made(0, seconds=300.0)], progress=lambda f, what: told.append((f, what)))
    fractions = [f for f, _ in told]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    assert all(what for _, what in told)


def test_logs_that_do_not_fit_the_network_are_refused():
    with pytest.raises(UserError, match="no log"):
        fit_network("tclab", [])
    with pytest.raises(UserError, match="column q1: no such column"):
        fit_network("tclab", [made(0, seconds=60.0)])


def test_tau_counts_how_often_an_error_repeats_itself():
    rng = np.random.default_rng(2)
    n, rho = 20000, 0.8
    slow = np.zeros(n)
    for k in range(1, n):
        slow[k] = rho * slow[k - 1] + rng.standard_normal()
    tau = residual_tau([[[rng.standard_normal(n), slow]]], np.ones(2))
    np.testing.assert_allclose(tau, [1.0, (1 + rho) / (1 - rho)], rtol=0.15)


def test_the_jackknife_is_the_spread_of_logs_over_their_number():
    rng = np.random.default_rng(0)
    jacobian = -np.ones((50, 1))
    apart = [(shift + 0.5 * rng.standard_normal(50), jacobian) for shift in (-0.4, 0.4, -0.4, 0.4)]
    # sd 0.4 of four means over sqrt(3); the noise of each mean is 0.07
    assert jackknife_sd(apart)[0] == pytest.approx(0.4 / np.sqrt(3), rel=0.3)


def test_the_weakest_direction_is_found():
    jacobian = np.array([[1.0, 0.0, 2.0], [0.0, 1.0, 0.0], [1.0, 1.0, 2.0]])
    condition, least, words = weakest_direction(jacobian, "abc")
    assert words in ("a up, c down", "a down, c up")
    assert least < 1e-12
    assert condition > 1e12


def test_the_optimiser_agrees_with_scipy_in_a_curved_valley():
    t = np.linspace(0, 4, 30)
    data = np.exp(-1.1 * t) + np.exp(-0.9 * t)

    def residuals(z: np.ndarray) -> np.ndarray:
        rates = np.exp(z)
        return np.exp(-rates[:, :1] * t) + np.exp(-rates[:, 1:] * t) - data

    def linearise(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rates = np.exp(z)
        return residuals(z[None])[0], np.stack([-rate * t * np.exp(-rate * t) for rate in rates], axis=1)

    start, far = np.array([2.0, -2.0]), np.full(2, 5.0)
    ours = levenberg_marquardt(
        linearise, residuals, start, low=-far, high=far, tolerance=1e-12, iterations=200
    )
    theirs = least_squares(lambda z: residuals(z[None])[0], start)
    assert ours.converged
    assert ours.cost <= 2 * theirs.cost + 1e-12
    np.testing.assert_allclose(np.sort(np.exp(ours.z)), [0.9, 1.1], atol=5e-3)


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


def test_a_fit_near_an_earlier_one_ends_where_that_one_did():
    logs = [made(k) for k in range(3)]
    cold = fit_network(heater(), logs)
    warm = fit_network(heater(), logs, near={name: 1.05 * value for name, value in cold.values.items()})
    assert warm.scores.iterations <= cold.scores.iterations
    sd = np.sqrt(np.diag(cold.covariance))
    moved = [np.log(warm.values[name] / cold.values[name]) for name in cold.free]
    assert np.abs(moved / sd).max() < 0.05
