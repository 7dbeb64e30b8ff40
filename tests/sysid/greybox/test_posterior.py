"""Posteriors against an exactly solvable plant: two known responses with unknown gains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from scipy.signal import lfilter
from scipy.special import logsumexp
from scipy.stats import binom

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, make_log
from thermogrip.report.plots import corner_figure
from thermogrip.sysid.greybox.fit import fit_network
from thermogrip.sysid.greybox.mcmc import run_chain
from thermogrip.sysid.greybox.posterior import sample_posterior, with_draws
from thermogrip.sysid.greybox.problem import make_problem
from thermogrip.sysid.greybox.randomized_map import Agreement
from thermogrip.sysid.greybox.sandwich import score_covariance
from thermogrip.sysid.models.network_spec import Parameter
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

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
    name, dt, average, independent, warmup, search_step = "two gains", 1.0, 4.0, 60.0, 5.0, 2.0
    reference: str | None = None
    units: Mapping[str, str] = {"q": "1", "t": "degC", "a": "K", "b": "K"}
    sensor_sd: Mapping[str, float] = {"t": 0.1}
    specs: Mapping[str, Parameter] = {
        "a": Parameter(unit="K", value=4.0, sd=4.0, low=-40.0, high=40.0),
        "b": Parameter(unit="K", value=4.0, sd=4.0, low=-40.0, high=40.0),
    }

    def __init__(self, nuisance: float = 0.0) -> None:
        self.nuisance = {"t": nuisance}

    def prepared(self, logs: Sequence[Log], p: Array | None = None, **_: Any) -> TwoGains:
        return self

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


def a_fit(*seeds: int, nuisance: float = 0.0, **of_log: Any) -> tuple[Plant, list[Log]]:
    """Return the fit of as many logs, and the logs."""
    logs = [a_log(seed, **of_log) for seed in seeds or (1, 2)]
    return fit_network(TwoGains(nuisance), logs), logs  # type: ignore[arg-type]


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


def density(plant: Plant, logs: Sequence[Log]) -> tuple[Agreement, Array, Array]:
    """Return the density, its mode and its covariance, which is exactly normal for a linear plant."""
    problem = make_problem(plant.model, logs, average=4.0, independent=60.0)  # type: ignore[arg-type]
    problem = problem.with_tau(np.array([plant.scores.weight_s["t"] / 4.0]))
    z = problem.standard(plant.values)
    target = Agreement(problem, z, score_covariance(problem, z))
    return target, z, target.covariance


@pytest.mark.parametrize("sampled", [[0, 1], [0], [1]])
def test_samples_are_those_of_the_exact_gaussian(sampled: list[int]) -> None:
    target, mean, covariance = density(*a_fit())
    rng = np.random.default_rng(0)
    start = rng.multivariate_normal(mean[sampled], covariance[np.ix_(sampled, sampled)], size=24)
    chain = run_chain(lambda z: target.log_profile(z, sampled), start, max_steps=3000)
    assert chain.converged
    kept = chain.kept(1000)
    z = target.draws(len(kept), held=kept, columns=sampled)
    worth = min(24 * len(chain.steps) / chain.tau.max(), len(kept))  # independent draws in the chain
    sd = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose((z.mean(axis=0) - mean) / sd, 0.0, atol=4 / np.sqrt(worth))
    np.testing.assert_allclose(z.std(axis=0) / sd, 1.0, atol=4 / np.sqrt(2 * worth))
    assert np.corrcoef(z.T)[0, 1] == pytest.approx(covariance[0, 1] / sd.prod(), abs=0.15)


def curved(x: Array) -> Array:
    """A bent ridge: x_1 ~ N(0, 1), x_2 = x_1^2 / 2 + N(0, 1), and four normal dimensions beside it."""
    return np.asarray(-0.5 * (x[:, 0] ** 2 + (x[:, 1] - x[:, 0] ** 2 / 2) ** 2 + (x[:, 2:] ** 2).sum(axis=1)))


def test_proposals_about_a_poor_normal_leave_the_density_as_it_is() -> None:
    rng = np.random.default_rng(0)
    away, covariance = np.full(6, 0.4), 0.6 * np.eye(6)
    start = rng.multivariate_normal(away, covariance, size=32)
    chain = run_chain(curved, start, max_steps=6000, normal=(away, covariance), seed=3)
    assert chain.converged
    kept = chain.kept(10**6)
    worth = kept.shape[0] / chain.tau.max()
    expected = np.array([0.0, 0.5, 0.0, 0.0, 0.0, 0.0])
    sd = np.array([1.0, np.sqrt(1.5), 1.0, 1.0, 1.0, 1.0])
    np.testing.assert_allclose((kept.mean(axis=0) - expected) / sd, 0.0, atol=4 / np.sqrt(worth))
    np.testing.assert_allclose(kept.std(axis=0) / sd, 1.0, atol=8 / np.sqrt(2 * worth))  # the ridge has tails


def test_proposals_of_a_normal_approximation_mix_faster_than_walkers_alone() -> None:
    start = np.random.default_rng(0).normal(size=(16, 6))

    def normal(x: Array) -> Array:
        return np.asarray(-0.5 * (x**2).sum(axis=1))

    alone = run_chain(normal, start, max_steps=2500)
    both = run_chain(normal, start, max_steps=2500, normal=(np.zeros(6), np.eye(6)))
    assert both.converged
    assert both.tau.max() < 0.4 * alone.tau.max()


def test_draws_are_those_of_the_exact_gaussian() -> None:
    target, mean, covariance = density(*a_fit())
    z, sd = target.draws(1000), np.sqrt(np.diag(covariance))
    np.testing.assert_allclose((z.mean(axis=0) - mean) / sd, 0.0, atol=4 / np.sqrt(1000))
    np.testing.assert_allclose(z.std(axis=0) / sd, 1.0, atol=4 / np.sqrt(2000))
    assert np.corrcoef(z.T)[0, 1] == pytest.approx(covariance[0, 1] / sd.prod(), abs=4 / np.sqrt(1000))


def test_the_density_is_highest_at_the_fit_and_falls_as_the_covariance_says() -> None:
    target, z, covariance = density(*a_fit())
    step = np.random.default_rng(1).multivariate_normal(np.zeros(2), covariance, size=20)
    fall = target.log_density(z[None])[0] - target.log_density(z + step)
    expected = 0.5 * np.einsum("bi,ij,bj->b", step, np.linalg.inv(covariance), step)
    np.testing.assert_allclose(fall, expected, rtol=1e-3, atol=1e-3)


def test_what_is_integrated_out_leaves_the_marginal() -> None:
    target, z, covariance = density(*a_fit())
    step = np.sqrt(covariance[0, 0]) * np.array([-2.0, -1.0, 1.0, 2.0])
    fall = target.log_profile(z[:1][None], [0])[0] - target.log_profile((z[0] + step)[:, None], [0])
    np.testing.assert_allclose(fall, 0.5 * step**2 / covariance[0, 0], rtol=1e-3, atol=1e-3)


class Bent:
    """A residual of two parameters: they go together, and its slopes are true only where they do."""

    STEEP, BEND = 5.0, 0.3
    box = np.array([-9.0, -9.0]), np.array([9.0, 9.0])

    def start(self, z: Array) -> None:
        """There is none to estimate."""

    def residuals(self, z: Array, starts: None) -> list[Array]:
        apart = z[:, 1] - z[:, 0]
        return [self.STEEP * np.column_stack([apart + self.BEND * apart**3, 0 * apart])]

    def by_log(self, z: Array, *, central: bool) -> list[tuple[Array, Array]]:
        return [(self.residuals(z[None], None)[0][0], self.STEEP * np.array([[-1.0, 1.0], [0.0, 0.0]]))]


def test_what_is_integrated_out_is_followed_far_from_the_fit() -> None:
    bent, slope = Bent(), Bent.STEEP * np.array([[-1.0, 1.0]])
    told = SimpleNamespace(spread=slope.T @ slope, coarse=1.0)
    target = Agreement(bent, np.zeros(2), told)  # type: ignore[arg-type]
    along, across = np.array([0.0, 1.0, 2.0, 3.0]), np.linspace(-6.0, 6.0, 4001)
    whole = [target.log_density(np.column_stack([np.full(across.size, a), across])) for a in along]
    exact = np.array([logsumexp(row) for row in whole])
    found = target.log_profile(along[:, None], [0])
    np.testing.assert_allclose(found - found[0], exact - exact[0], atol=0.5)


def test_intervals_are_those_of_the_fit_and_samples_lie_about_its_values() -> None:
    plant, logs = a_fit(1, 2, 3)
    sampled, record = sample_posterior(plant, logs, max_steps=1500, n_samples=1000)
    assert sampled.intervals(0.9) == plant.intervals(0.9)
    for name, (low, high) in plant.intervals(0.9).items():
        assert plant.values[name] == pytest.approx((low + high) / 2)
    assert record.off_centre < 0.25


def test_a_few_draws_stand_in_for_the_posterior() -> None:
    plant, logs = a_fit(1, 2, 3)
    few = with_draws(plant, logs, 20)
    assert few.samples is not None
    assert few.samples.shape == (20, 2)
    assert few.intervals() == plant.intervals()
    assert few.draw(7).values != plant.values


def test_draws_take_the_error_that_the_fit_has_learnt(monkeypatch: pytest.MonkeyPatch) -> None:
    plant, logs = a_fit(1, 2, 3)
    forgetful = replace(plant, scores=replace(plant.scores, intervals=None))
    anew = with_draws(forgetful, logs, 5)
    monkeypatch.setattr("thermogrip.sysid.greybox.sandwich.learn_error_model", None)
    again = with_draws(plant, logs, 5)
    assert anew.samples is not None
    assert again.samples is not None
    np.testing.assert_allclose(again.samples, anew.samples, rtol=1e-6)


def cover(n: int, logs: int) -> Array:
    """Return how often the 90 % posterior intervals of a and b hold the truth, of n fits."""
    inside = np.zeros(2)
    for seed in range(n):
        plant, made = a_fit(*range(100 + logs * seed, 100 + logs * (seed + 1)))
        _, record = sample_posterior(plant, made, max_steps=100, n_samples=1000, seed=seed)
        inside += [q[0] <= TRUE[name] <= q[2] for name, q in record.quantiles.items()]
    return inside


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    inside = cover(25, 2)
    # 99 % bounds of a binomial of 25 at 0.9, per parameter; the prior's sd of 4 adds nothing
    low, high = binom.ppf([0.003, 0.999], 25, 0.9)
    assert np.all((inside >= low) & (inside <= high)), inside


def test_too_few_steps_are_not_converged() -> None:
    _, record = sample_posterior(*a_fit(), max_steps=45)  # no autocorrelation time is below one step
    assert not record.converged
    assert record.verdict.startswith("not converged")
    assert record.n_steps == 45


def test_walkers_that_agree_with_each_other_prove_nothing() -> None:
    # all walkers near one of two far modes: R-hat would be 1; a short chain must still not pass
    def two_modes(x: Array) -> Array:
        return np.asarray(np.logaddexp(-0.5 * (x[:, 0] - 5) ** 2 / 0.1, -0.5 * (x[:, 0] + 5) ** 2 / 0.1))

    start = 5 + 0.1 * np.random.default_rng(0).normal(size=(12, 1))
    assert not run_chain(two_modes, start, max_steps=100).converged


def test_one_seed_is_one_posterior() -> None:
    plant, logs = a_fit()

    def quantiles(seed: int) -> dict[str, tuple[float, float, float]]:
        return sample_posterior(plant, logs, max_steps=60, seed=seed)[1].quantiles

    assert quantiles(1) == quantiles(1)
    assert quantiles(1) != quantiles(2)


def test_a_chain_that_was_stopped_goes_on_where_it_stopped(tmp_path: Path) -> None:
    plant, logs = a_fit()
    path = tmp_path / "chain.h5"

    def stop(fraction: float, what: str) -> None:
        if what.startswith("sampling"):
            raise KeyboardInterrupt  # after the first 50 steps

    with pytest.raises(KeyboardInterrupt):
        sample_posterior(plant, logs, max_steps=120, backend=path, progress=stop)
    _, resumed = sample_posterior(plant, logs, max_steps=120, backend=path)
    _, whole = sample_posterior(plant, logs, max_steps=120)
    np.testing.assert_array_equal(resumed.chain.steps, whole.chain.steps)


@pytest.mark.parametrize("change", ["log", "values", "seed"])
def test_a_chain_of_another_problem_is_not_gone_on_with(tmp_path: Path, change: str) -> None:
    plant, logs = a_fit()
    path = tmp_path / "chain.h5"
    sample_posterior(plant, logs, max_steps=60, backend=path)
    if change == "log":
        logs = [logs[0], a_log(9)]
    if change == "values":
        plant = replace(plant, values=plant.values | {"a": plant.values["a"] + 1e-3})
    seed = 1 if change == "seed" else 0
    _, again = sample_posterior(plant, logs, max_steps=60, backend=path, seed=seed)
    _, fresh = sample_posterior(plant, logs, max_steps=60, seed=seed)
    np.testing.assert_array_equal(again.chain.steps, fresh.chain.steps)


def test_a_file_that_is_no_chain_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "chain.h5"
    path.write_text("hello")
    with pytest.raises(UserError, match="not a chain"):
        sample_posterior(*a_fit(), max_steps=60, backend=path)


def test_the_plant_keeps_its_values_and_gains_samples_for_every_free_parameter() -> None:
    fitted, logs = a_fit()
    plant, record = sample_posterior(fitted, logs, free=["b"], max_steps=200, n_samples=100)
    assert plant.values == fitted.values
    assert plant.samples is not None
    assert plant.samples.shape == (100, 2)
    assert record.sampled == ("b",)
    assert set(record.quantiles) == {"a", "b"}
    assert plant.draw(3).values != plant.values


def test_integrating_out_gives_the_same_width_as_sampling_all() -> None:
    widths = []
    for free in (["a", "b"], ["b"]):
        q = sample_posterior(*a_fit(), free=free, max_steps=1500, n_samples=3000)[1].quantiles
        widths.append([q[name][2] - q[name][0] for name in ("a", "b")])
    # 8 walkers for 50 tau are 400 draws: a 90 % width is known to 4.6 %, a ratio to 6.4 %; three times that
    np.testing.assert_allclose(widths[0], widths[1], rtol=0.19)


def test_samples_stay_inside_the_bounds() -> None:
    class Bounded(TwoGains):
        specs = TwoGains.specs | {"a": Parameter(unit="K", value=4.0, sd=4.0, low=2.9, high=40.0)}

    logs = [a_log(1)]
    plant, _ = sample_posterior(fit_network(Bounded(), logs), logs, max_steps=200)  # type: ignore[arg-type]
    assert plant.samples is not None
    assert plant.samples[:, 0].min() >= 2.9


def test_a_sensor_offset_with_a_known_spread_widens_the_interval_of_a_gain() -> None:
    def width(spread: float, seed: int) -> float:
        low, high = a_fit(seed, nuisance=spread)[0].intervals(0.9)["b"]
        return high - low

    wider = [np.log(width(1.0, seed) / width(0.0, seed)) for seed in range(1, 21)]
    # the error that is learnt differs by chance; the mean over logs is above 0 by three of its own sd
    assert np.mean(wider) > 3 * np.std(wider, ddof=1) / np.sqrt(len(wider))


def test_lost_readings_are_bridged() -> None:
    plant, logs = a_fit(1)
    holes = logs[0].copy(deep=True)
    holes["t"].values[100:110] = np.nan
    holes["t"].values[300:302] = np.nan
    lost = fit_network(TwoGains(), [holes])  # type: ignore[arg-type]
    assert plant.intervals(0.9).keys() == set(plant.free)
    for name, (low, high) in plant.intervals(0.9).items():
        first, last = lost.intervals(0.9)[name]
        assert last - first == pytest.approx(high - low, rel=0.2)


def test_the_saved_posterior_reads_back_with_arviz(tmp_path: Path) -> None:
    import warnings

    told: list[float] = []
    _, record = sample_posterior(*a_fit(), max_steps=60, progress=lambda share, _: told.append(share))
    assert told == sorted(told)
    assert 0 <= told[0] < 0.1 < told[2] < told[-1] == 1.0
    path = record.save(tmp_path / "posterior.nc")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        import arviz
    data = arviz.from_netcdf(str(path), engine="h5netcdf")
    np.testing.assert_allclose(data.posterior["a"].values, record.chain.steps[:, :, 0].T)
    np.testing.assert_allclose(data.posterior_whole["b"].values[0], record.samples[:, 1])
    assert [p.name for p in tmp_path.iterdir()] == ["posterior.nc"]


def test_the_corner_figure_has_a_panel_for_each_pair() -> None:
    _, record = sample_posterior(*a_fit(), max_steps=60)
    figure = corner_figure(record)
    assert sum(ax.axison for ax in figure.axes) == 3
    with pytest.raises(UserError, match="not sampled"):
        corner_figure(record, ["c"])


def test_a_plant_without_free_parameters_or_priors_is_refused() -> None:
    plant, logs = a_fit(1)
    with pytest.raises(UserError, match="no free parameter"):
        sample_posterior(replace(plant, free=(), covariance=None), logs)
    box = StateSpaceModel(("q",), (), ("t",), A=[[0.9]], B=[[4.0]], C=[[1.0]], dt=1.0)
    black = Plant(box, {}, dt=1.0, units={"q": "1", "t": "degC"})
    with pytest.raises(UserError, match="no free parameter"):
        sample_posterior(black, logs)


def test_a_name_that_is_not_free_is_refused() -> None:
    with pytest.raises(UserError, match="'c' is not a free parameter"):
        sample_posterior(*a_fit(), free=["c"])


def test_a_log_of_a_few_bins_is_refused() -> None:
    with pytest.raises(UserError, match="too short"):
        a_fit(1, seconds=30)
