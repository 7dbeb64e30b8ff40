"""Posteriors against an exactly solvable plant: two known responses with unknown gains."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from scipy.signal import lfilter
from scipy.stats import binom

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, make_log
from thermogrip.sysid.corner import corner_figure
from thermogrip.sysid.discrepancy import (
    Discrepancy,
    LogResiduals,
    fit_discrepancy,
    log_jackknife,
    marginal_likelihood,
)
from thermogrip.sysid.likelihood import Likelihood, linearise, make_bins
from thermogrip.sysid.mode import find_mode
from thermogrip.sysid.plant import Plant
from thermogrip.sysid.posterior import run_chain, sample_posterior

Array = NDArray[np.float64]


class TwoGains:
    """y = a x1 + b x2, x1 and x2 the input through first-order lags of 20 s and 100 s: linear in (a, b)."""

    kind = "two gains"
    inputs = ("q",)
    disturbances: tuple[str, ...] = ()
    outputs = ("t",)
    switches: tuple[str, ...] = ()
    parameters = ("a", "b")
    n_x = 2
    lags = (20.0, 100.0)

    @property
    def spread(self) -> Array:
        return 1e-8 * np.eye(2)  # it starts at zero

    def rest(self, y: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike) -> Array:
        return np.zeros(2)

    def step(
        self, x: Sequence[Any], u: Sequence[Any], d: Sequence[Any], p: Sequence[Any], dt: float
    ) -> list[Any]:
        return [x[i] + (1 - np.exp(-dt / lag)) * (u[0] - x[i]) for i, lag in enumerate(self.lags)]

    def output(self, x: Sequence[Any], p: Sequence[Any]) -> list[Any]:
        return [p[0] * x[0] + p[1] * x[1]]

    def rollout(
        self, x0: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike, dt: float
    ) -> tuple[Array, Array]:
        q, gains, begin = np.asarray(u, float)[0, :, 0], np.asarray(p, float), np.asarray(x0, float)
        keep = np.exp(-dt / np.array(self.lags))
        forced = np.stack([np.append(0.0, lfilter([1 - k], [1, -k], q)) for k in keep])
        states = forced + begin[:, :, None] * keep[:, None] ** np.arange(q.size + 1)
        y = np.einsum("bi,bik->bk", np.broadcast_to(gains, (len(begin), 2)), states)
        return y[:, :, None], states[:, :, -1]

    def to_dict(self) -> dict[str, Any]:
        return {"kind": self.kind}


TRUE = {"a": 3.0, "b": 5.0}
MEMORY, MODEL_ERROR, NOISE = 30.0, 0.3, 0.03


def a_plant(**changes: Any) -> Plant:
    given: dict[str, Any] = {"values": dict(TRUE), "covariance": np.diag([0.2, 0.2]), "free": ("a", "b")}
    return Plant(TwoGains(), dt=1.0, **(given | changes))


def a_log(seed: int, *, seconds: int = 600, memory: float = MEMORY) -> Log:
    """Return a log whose model error is an AR(1) process."""
    rng = np.random.default_rng(seed)
    t = np.arange(float(seconds))
    q = np.repeat(rng.uniform(0, 1, seconds // 40 + 1), 40)[:seconds]
    y, _ = TwoGains().rollout(
        np.zeros((1, 2)), q[None, :, None], np.zeros((1, seconds, 0)), [[3.0, 5.0]], 1.0
    )
    keep = np.exp(-1.0 / memory)
    drive = rng.normal(0.0, MODEL_ERROR * np.sqrt(1 - keep**2), seconds + 500)
    error = lfilter([1.0], [1.0, -keep], drive)[500:]
    seen = y[0, :-1, 0] + error + rng.normal(0.0, NOISE, seconds)
    return make_log(t, {"q": (q, "1", "input"), "t": (seen, "degC", "output")}, name=f"log {seed}")


def exact(linear: Sequence[LogResiduals], at: Array, numbers: Discrepancy) -> tuple[Array, Array]:
    """Return mean and covariance of z from one dense solve, the textbook way."""
    precision, right = np.eye(at.size), np.zeros(at.size)
    for log in linear:
        weight = np.linalg.inv(numbers.covariance(log))
        precision += log.sensitivity.T @ weight @ log.sensitivity
        right += log.sensitivity.T @ weight @ (log.residual + log.sensitivity @ at)
    return np.linalg.solve(precision, right), np.linalg.inv(precision)


@pytest.mark.parametrize("sampled", [[0, 1], [0], [1]])
def test_samples_are_those_of_the_exact_gaussian(sampled: list[int]) -> None:
    bins = make_bins(a_plant(), [a_log(1), a_log(2)])
    numbers = Discrepancy((MEMORY,), ((MODEL_ERROR,),), (0.0,))
    at = np.array([0.1, -0.1])
    linear = linearise(bins, at)
    mean, covariance = exact(linear, at, numbers)
    target = Likelihood(bins, linear, at, numbers, sampled)
    rng = np.random.default_rng(0)
    start = rng.multivariate_normal(mean[sampled], covariance[np.ix_(sampled, sampled)], size=24)
    chain = run_chain(target.log_posterior, start, max_steps=3000)
    assert chain.converged
    z = target.complete(chain.kept(4000), rng)
    worth = 24 * len(chain.steps) / chain.tau.max()  # independent draws in the chain
    sd = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(z.mean(axis=0), mean, atol=4 * sd.max() / np.sqrt(worth))
    np.testing.assert_allclose(z.std(axis=0) / sd, 1.0, atol=4 / np.sqrt(2 * worth))
    assert np.corrcoef(z.T)[0, 1] == pytest.approx(covariance[0, 1] / sd.prod(), abs=0.1)


def test_the_mode_is_the_exact_mean_from_anywhere() -> None:
    bins = make_bins(a_plant(), [a_log(3)])
    numbers = Discrepancy((MEMORY,), ((MODEL_ERROR,),), (0.0,))
    far = np.array([2.0, -2.0])
    mean, covariance = exact(linearise(bins, far), far, numbers)
    z, spread, _ = find_mode(bins, far, numbers, linearise(bins, far))
    np.testing.assert_allclose(z, mean, atol=1e-6)
    np.testing.assert_allclose(spread, covariance, rtol=1e-6)


def test_the_marginal_likelihood_is_the_density_of_the_data() -> None:
    from scipy.stats import multivariate_normal

    bins = make_bins(a_plant(), [a_log(4), a_log(5)])
    at, numbers = np.array([0.2, 0.1]), Discrepancy((MEMORY, 5.0), ((0.3,), (0.1,)), (0.0, 0.0))
    linear = linearise(bins, at)
    data = np.concatenate([log.residual + log.sensitivity @ at for log in linear])
    j = np.vstack([log.sensitivity for log in linear])
    n = linear[0].residual.size
    whole = j @ j.T
    whole[:n, :n] += numbers.covariance(linear[0])
    whole[n:, n:] += numbers.covariance(linear[1])
    assert marginal_likelihood(numbers, linear, at) == pytest.approx(
        multivariate_normal(cov=whole).logpdf(data)
    )


def test_memory_of_the_model_error_is_found() -> None:
    bins = make_bins(a_plant(), [a_log(seed, seconds=1600) for seed in range(4)])
    at = np.zeros(2)
    numbers = fit_discrepancy(linearise(bins, at), at)
    lag = np.array([0.0, MEMORY, 3 * MEMORY])
    found = sum(s[0] ** 2 * np.exp(-lag / tau) for s, tau in zip(numbers.sd, numbers.tau))
    # 4 x 1600 s hold about 100 independent stretches: variance to 15 %
    np.testing.assert_allclose(found / MODEL_ERROR**2, np.exp(-lag / MEMORY), atol=0.3)


def test_logs_that_agree_as_they_should_widen_nothing_and_others_do() -> None:
    numbers, at = Discrepancy((MEMORY,), ((MODEL_ERROR,),), (0.0,)), np.zeros(2)
    bins = make_bins(a_plant(), [a_log(seed) for seed in range(8)])
    # 8 logs tell 16 squares of mean 1: f^2 within 1 +- 3 sqrt(2 / 16)
    assert log_jackknife(numbers, linearise(bins, at), at) < np.sqrt(1 + 3 * np.sqrt(2 / 16))
    trusting = Discrepancy((MEMORY,), ((MODEL_ERROR / 4,),), (0.0,))
    assert log_jackknife(trusting, linearise(bins, at), at) > 2
    assert log_jackknife(trusting, linearise(bins, at)[:2], at) == 1.0


def cover(memory: bool, n: int) -> Array:
    """Return how often the 90 % intervals of a and b hold the truth, of n logs."""
    inside = np.zeros(2)
    for seed in range(n):
        _, record = sample_posterior(
            a_plant(), [a_log(100 + seed)], max_steps=100, memory=memory, n_samples=1000, seed=seed
        )
        inside += [q[0] <= TRUE[name] <= q[2] for name, q in record.quantiles.items()]
    return inside


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    inside = cover(True, 40)
    # 99 % bounds of a binomial of 40 at 0.9, per parameter; a prior at ten times the fit's sd adds nothing
    low, high = binom.ppf([0.003, 0.999], 40, 0.9)
    assert np.all((inside >= low) & (inside <= high)), inside


def test_independent_residuals_would_give_intervals_that_do_not_hold() -> None:
    inside = cover(False, 20)
    assert np.all(inside <= binom.ppf(0.01, 20, 0.9)), inside


def test_too_few_steps_are_not_converged() -> None:
    _, record = sample_posterior(a_plant(), [a_log(1)], max_steps=100)
    assert not record.converged
    assert record.verdict.startswith("not converged")
    assert record.n_steps == 100


def test_walkers_that_agree_with_each_other_prove_nothing() -> None:
    # all walkers near one of two far modes: R-hat would be 1; a short chain must still not pass
    def two_modes(x: Array) -> Array:
        return np.asarray(np.logaddexp(-0.5 * (x[:, 0] - 5) ** 2 / 0.1, -0.5 * (x[:, 0] + 5) ** 2 / 0.1))

    start = 5 + 0.1 * np.random.default_rng(0).normal(size=(12, 1))
    assert not run_chain(two_modes, start, max_steps=100).converged


def test_one_seed_is_one_posterior() -> None:
    def quantiles(seed: int) -> dict[str, tuple[float, float, float]]:
        return sample_posterior(a_plant(), [a_log(1)], max_steps=60, seed=seed)[1].quantiles

    assert quantiles(1) == quantiles(1)
    assert quantiles(1) != quantiles(2)


def test_the_plant_keeps_its_values_and_gains_samples_for_every_free_parameter() -> None:
    plant, record = sample_posterior(a_plant(), [a_log(1)], free=["b"], max_steps=200, n_samples=100)
    assert plant.values == TRUE
    assert plant.samples is not None
    assert plant.samples.shape == (100, 2)
    assert record.sampled == ("b",)
    assert set(record.quantiles) == {"a", "b"}
    assert plant.draw(3).values != plant.values


def test_integrating_out_gives_the_same_width_as_sampling_all() -> None:
    widths = []
    for free in (["a", "b"], ["b"]):
        q = sample_posterior(a_plant(), [a_log(1)], free=free, max_steps=1500, n_samples=3000)[1].quantiles
        widths.append([q[name][2] - q[name][0] for name in ("a", "b")])
    # 8 walkers for 50 tau are 400 draws: a 90 % width is known to 4.6 %, a ratio to 6.4 %; three times that
    np.testing.assert_allclose(widths[0], widths[1], rtol=0.19)


def test_samples_stay_inside_the_bounds() -> None:
    plant, _ = sample_posterior(a_plant(bounds={"a": (2.9, 10.0)}), [a_log(1)], max_steps=200)
    assert plant.samples is not None
    assert plant.samples[:, 0].min() >= 2.9


def test_a_sensor_offset_with_a_known_spread_widens_the_interval_of_a_gain() -> None:
    def width(spread: float) -> float:
        record = sample_posterior(a_plant(nuisance={"t": spread}), [a_log(1)], max_steps=400, n_samples=2000)[
            1
        ]
        return record.quantiles["b"][2] - record.quantiles["b"][0]

    assert width(1.0) > 1.1 * width(0.0)


def test_lost_readings_are_left_out() -> None:
    log = a_log(1)
    log["t"].values[100:110] = np.nan
    log["t"].values[300:302] = np.nan
    bins = make_bins(a_plant(), [log])
    whole = make_bins(a_plant(), [a_log(1)])
    r, w = bins.residuals(np.zeros((1, 2)))[0], whole.residuals(np.zeros((1, 2)))[0]
    assert np.isfinite(r).all()
    assert w.size - r.size in (2, 3)


def test_the_saved_posterior_reads_back_with_arviz(tmp_path: Path) -> None:
    import warnings

    _, record = sample_posterior(a_plant(), [a_log(1)], max_steps=60)
    path = record.save(tmp_path / "posterior.nc")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        import arviz
    data = arviz.from_netcdf(str(path), engine="h5netcdf")
    np.testing.assert_allclose(data.posterior["a"].values, record.chain.steps[:, :, 0].T)
    np.testing.assert_allclose(data.posterior_whole["b"].values[0], record.samples[:, 1])
    assert [p.name for p in tmp_path.iterdir()] == ["posterior.nc"]


def test_the_corner_figure_has_a_panel_for_each_pair() -> None:
    _, record = sample_posterior(a_plant(), [a_log(1)], max_steps=60)
    figure = corner_figure(record)
    assert sum(ax.axison for ax in figure.axes) == 3
    with pytest.raises(UserError, match="not sampled"):
        corner_figure(record, ["c"])


@pytest.mark.parametrize(
    ("changes", "text"),
    [({"free": (), "covariance": None}, "no free parameter"), ({"covariance": None}, "neither prior")],
)
def test_a_plant_without_free_parameters_or_prior_is_refused(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(UserError, match=text):
        sample_posterior(a_plant(**changes), [a_log(1)])


def test_a_name_that_is_not_free_is_refused() -> None:
    with pytest.raises(UserError, match="'c' is not a free parameter"):
        sample_posterior(a_plant(), [a_log(1)], free=["c"])


def test_a_log_of_a_few_bins_is_refused() -> None:
    with pytest.raises(UserError, match="too short"):
        sample_posterior(a_plant(), [a_log(1, seconds=40)], average=10.0)
