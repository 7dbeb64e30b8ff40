"""Posteriors against an exactly solvable plant: two known responses with unknown gains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import logsumexp
from scipy.stats import binom

from tests.sysid.greybox.makers import TRUE, TwoGains, a_fit, a_log
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log
from thermogrip.sysid.greybox import posterior
from thermogrip.sysid.greybox.fit import fit_network
from thermogrip.sysid.greybox.posterior import (
    Chain,
    Posterior,
    RandomizedMap,
    fit_problem,
    run_chain,
    sample_posterior,
    with_draws,
)
from thermogrip.sysid.greybox.problem import make_problem
from thermogrip.sysid.greybox.sandwich import score_covariance
from thermogrip.sysid.models.network_spec import Parameter
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.plant.plant_data import PlantScores, Sampling

Array = NDArray[np.float64]


def density(plant: Plant, logs: Sequence[Log]) -> tuple[RandomizedMap, Array, Array]:
    """Return the density, its mode and its covariance, which is exactly normal for a linear plant."""
    problem = make_problem(plant.model, logs, average=4.0, independent=60.0)
    problem = replace(problem, tau=np.array([plant.scores.weight_s["t"] / 4.0]))
    z = problem.standard(plant.values)
    target = RandomizedMap(problem, z, score_covariance(problem, z))
    return target, z, target.covariance


@pytest.mark.parametrize("sampled", [[0, 1], [1]])
def test_samples_are_those_of_the_exact_gaussian(sampled: list[int]) -> None:
    target, mean, covariance = density(*a_fit())
    rng = np.random.default_rng(0)
    start = rng.multivariate_normal(mean[sampled], covariance[np.ix_(sampled, sampled)], size=24)
    chain = run_chain(lambda z: target.log_profile(z, sampled), start, max_steps=3000)
    assert chain.converged
    kept = chain.kept(300)
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
    z, sd = target.draws(300), np.sqrt(np.diag(covariance))
    np.testing.assert_allclose((z.mean(axis=0) - mean) / sd, 0.0, atol=4 / np.sqrt(300))
    np.testing.assert_allclose(z.std(axis=0) / sd, 1.0, atol=4 / np.sqrt(600))
    assert np.corrcoef(z.T)[0, 1] == pytest.approx(covariance[0, 1] / sd.prod(), abs=4 / np.sqrt(1000))


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
    reported = SimpleNamespace(spread=slope.T @ slope, coarsening=1.0)
    target = RandomizedMap(bent, np.zeros(2), reported)
    along, across = np.array([0.0, 1.0, 2.0, 3.0]), np.linspace(-6.0, 6.0, 4001)
    whole = [target.log_profile(np.column_stack([np.full(across.size, a), across]), [0, 1]) for a in along]
    exact = np.array([logsumexp(row) for row in whole])
    found = target.log_profile(along[:, None], [0])
    np.testing.assert_allclose(found - found[0], exact - exact[0], atol=0.5)


def test_draws_take_the_error_that_the_fit_has_learnt(monkeypatch: pytest.MonkeyPatch) -> None:
    plant, logs = a_fit(1, 2, 3)
    forgetful = replace(plant, scores=replace(plant.scores, intervals=None))
    anew = with_draws(forgetful, fit_problem(forgetful, logs), 5)
    assert anew.intervals() == plant.intervals()
    assert anew.draw(4).values != plant.values
    monkeypatch.setattr("thermogrip.sysid.greybox.sandwich.learn_error_model", None)
    again = with_draws(plant, fit_problem(plant, logs), 5)
    assert anew.samples is not None
    assert again.samples is not None
    np.testing.assert_allclose(again.samples, anew.samples, rtol=1e-6)


@pytest.mark.slow
def test_intervals_cover_the_truth_as_often_as_stated() -> None:
    inside = np.zeros(2)
    for seed in range(25):
        plant, logs = a_fit(100 + 2 * seed, 101 + 2 * seed)
        drawn = with_draws(plant, fit_problem(plant, logs), 60, seed=seed).samples
        quantiles = np.quantile(np.asarray(drawn), [0.05, 0.95], axis=0)
        inside += (quantiles[0] <= list(TRUE.values())) & (quantiles[1] >= list(TRUE.values()))
    # 99 % bounds of a binomial of 25 at 0.9, per parameter; the prior's sd of 4 adds nothing
    low, high = binom.ppf([0.003, 0.999], 25, 0.9)
    assert np.all((inside >= low) & (inside <= high)), inside


def test_samples_stay_inside_the_bounds() -> None:
    class Bounded(TwoGains):
        specs = TwoGains.specs | {"a": Parameter(unit="K", value=4.0, sd=4.0, low=2.9, high=40.0)}

    logs = [a_log(1)]
    plant, _ = sample_posterior(fit_network(Bounded(), logs), logs, max_steps=200)
    assert plant.samples is not None
    assert plant.samples[:, 0].min() >= 2.9


def test_a_sensor_offset_with_a_known_spread_widens_the_interval_of_a_gain() -> None:
    def width(spread: float, seed: int) -> float:
        low, high = a_fit(seed, nuisance=spread)[0].intervals(0.9)["b"]
        return high - low

    wider = [np.log(width(1.0, seed) / width(0.0, seed)) for seed in range(1, 21)]
    # the error that is learnt differs by chance; the mean over logs is above 0 by three of its own sd
    assert np.mean(wider) > 3 * np.std(wider, ddof=1) / np.sqrt(len(wider))


@pytest.fixture
def one_sampled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(posterior, "DRAW", replace(posterior.DRAW, n_sampled=1))


def test_the_saved_posterior_reads_back_with_arviz(tmp_path: Path, one_sampled: None) -> None:
    import warnings

    reported: list[float] = []
    _, record = sample_posterior(
        *a_fit(), max_steps=60, n_samples=20, progress=lambda share, _: reported.append(share)
    )
    assert reported == sorted(reported)
    assert 0 <= reported[0] < 0.1 < reported[2] < reported[-1] == 1.0
    path = record.save(tmp_path / "posterior.nc")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        import arviz
    data = arviz.from_netcdf(str(path), engine="h5netcdf")
    assert (list(data.posterior), list(data.posterior_whole)) == (["a"], ["a", "b"])
    np.testing.assert_allclose(data.posterior["a"].values, record.chain.steps[:, :, 0].T)
    np.testing.assert_allclose(data.sample_stats["lp"].values, record.chain.log_posterior.T)
    np.testing.assert_allclose(data.posterior_whole["b"].values[0], record.samples[:, 1])
    assert [p.name for p in tmp_path.iterdir()] == ["posterior.nc"]


def test_the_effective_number_of_samples_is_that_behind_the_burn_in_over_tau(
    sampled: tuple[Plant, Posterior],
) -> None:
    record = sampled[1]
    kept = record.chain.settled
    assert record.chain.ess.tolist() == [kept[..., 0].size / record.sampling.tau[n] for n in record.sampled]


def test_a_plant_without_free_parameters_or_priors_is_refused() -> None:
    plant, logs = a_fit(1)
    with pytest.raises(UserError, match="no free parameter"):
        sample_posterior(replace(plant, free=(), covariance=None), logs)
    box = StateSpaceModel(("q",), (), ("t",), A=[[0.9]], B=[[4.0]], C=[[1.0]], dt=1.0)
    black = Plant(box, {}, dt=1.0, units={"q": "1", "t": "degC"})
    with pytest.raises(UserError, match="no free parameter"):
        sample_posterior(black, logs)


MEAN, COVARIANCE = np.array([1.0, -2.0]), np.array([[4.0, 1.2], [1.2, 0.5]])


def normal(x: Array) -> Array:
    apart = x - MEAN
    return np.asarray(-0.5 * np.einsum("bi,ij,bj->b", apart, np.linalg.inv(COVARIANCE), apart))


def start(n: int = 12, seed: int = 0) -> Array:
    return np.random.default_rng(seed).multivariate_normal(MEAN, COVARIANCE, size=n)


@pytest.mark.parametrize(("tau", "burn"), [((5.0, 2.0), 15), ((0.9, 4.1), 13), ((90.0, 1.0), 50)])
def test_three_autocorrelation_times_are_left_out_and_half_the_chain_at_most(
    tau: tuple[float, float], burn: int
):
    steps = np.arange(100.0)[:, None, None] + np.array([0.1, 0.2, 0.3])[:, None] + np.zeros(2)
    made = Chain(steps, steps[:, :, 0], np.array(tau), True, 0.5)
    kept = made.kept(10)
    assert kept.shape == (10, 2)
    assert (kept[0, 0], kept[-1, 0]) == (burn + 0.1, 99.3)
    counts = np.unique(np.round(kept[:, 0] % 1, 1), return_counts=True)[1]
    assert len(counts) == 3
    assert np.ptp(counts) <= 1  # all walkers alike
    assert np.ptp(np.diff(np.sort(kept[:, 0] // 1))[1:-1]) < 100 / 3  # and all times
    assert len(made.kept(10_000)) == 3 * (100 - burn)


@pytest.mark.parametrize(
    ("tau", "converged", "length"),
    [((1.5, 1.0), True, 100), ((1.0, 40.0), False, 120), ((2.4, 2.4), False, 120)],
)
def test_a_chain_has_converged_where_its_slowest_dimension_has(
    monkeypatch: pytest.MonkeyPatch, tau: tuple[float, float], converged: bool, length: int
):
    monkeypatch.setattr("emcee.EnsembleSampler.get_autocorr_time", lambda self, **_: np.array(tau))
    found = run_chain(normal, start(), max_steps=120)
    assert (found.converged, len(found.steps)) == (converged, length)


def test_a_walker_that_has_not_moved_yet_leaves_the_chain_as_slow_as_it_is_long():
    reported: list[float] = []
    short = run_chain(normal, start(), max_steps=2, progress=lambda share, what: reported.append(share))
    assert (short.tau.tolist(), short.converged, reported) == ([2.0, 2.0], False, [1.0])
    assert short.kept(5).shape == (5, 2)

    def nowhere(x: Array) -> Array:  # every move away from the start is refused
        return np.where((x[:, None] == begin[None]).all(axis=2).any(axis=1), 0.0, -np.inf)

    begin = start()
    found = run_chain(nowhere, begin, max_steps=100, progress=lambda share, what: reported.append(share))
    assert (found.converged, found.acceptance, reported[1:]) == (False, 0.0, [0.5, 1.0])


def test_a_chain_says_its_density_and_how_many_moves_were_taken():
    begin = start()
    found = run_chain(normal, begin, max_steps=40, normal=(MEAN, 2.0 * COVARIANCE))
    np.testing.assert_allclose(found.log_posterior, [normal(step) for step in found.steps])
    moved = np.any(np.diff(np.concatenate([begin[None], found.steps]), axis=0) != 0, axis=2)
    assert found.acceptance == pytest.approx(moved.mean())
    assert 0.2 < found.acceptance < 1.0


class Three(TwoGains):
    """The gains behind a parameter that is fixed, one of them on a logarithmic scale."""

    parameters = ("tube", "a", "b")
    specs = {  # noqa: RUF012
        "tube": Parameter(unit="s", value=7.0, fixed=True),
        "a": Parameter(unit="K", value=4.0, sd_log=1.0, low=0.01, high=400.0),
        "b": Parameter(unit="W", value=4.0, sd=4.0, low=-40.0, high=40.0),
    }
    units = TwoGains.units | {"tube": "s", "b": "W"}

    def output(self, x: Any, p: Any) -> list[Any]:
        return super().output(x, p[1:])

    def rollout(self, x0: Any, u: Any, d: Any, p: Any, dt: float) -> Any:
        return super().rollout(x0, u, d, np.asarray(p, float)[:, 1:], dt)


@pytest.fixture(scope="module")
def fitted() -> tuple[Plant, list[Log]]:
    logs = [a_log(1), a_log(2)]
    return fit_network(Three(), logs), logs


@pytest.fixture(scope="module")
def sampled(fitted: tuple[Plant, list[Log]]) -> tuple[Plant, Posterior]:
    return sample_posterior(*fitted, max_steps=60, n_samples=300, seed=2)


def test_the_record_is_in_the_parameters_own_units_and_counts_its_steps(
    fitted: Any, sampled: tuple[Plant, Posterior]
):
    plant, record = sampled
    assert record.free == record.sampled == ("a", "b")
    assert plant.values == fitted[0].values != plant.draw(3).values
    assert plant.samples is not None
    np.testing.assert_array_equal(plant.samples, record.samples)
    assert record.samples.shape == (300, 2)
    # all were sampled, so that the samples are rows of the chain
    rows = record.chain.steps.reshape(-1, 2)
    for sample in record.samples[::50]:
        assert np.abs(rows / sample - 1).max(axis=1).min() < 1e-9
    # how far its middle lies from the fit
    z = np.column_stack([np.log(record.samples[:, 0]), record.samples[:, 1]])
    fit = np.array([np.log(fitted[0].values["a"]), fitted[0].values["b"]])
    off = np.abs(np.median(z, axis=0) - fit) / z.std(axis=0)
    assert record.off_centre == pytest.approx(off.max())
    tau = record.sampling.tau
    assert tau == dict(zip("ab", record.chain.tau.tolist()))
    assert tau["a"] != tau["b"]
    assert (record.chain.converged, len(record.chain.steps)) == (False, 60)
    verdict = f"not converged: {60 / max(tau.values()):.0f} autocorrelation times"
    assert plant.scores.posterior == Sampling(verdict, False, record.sampling.likelihood, tau)


def test_there_are_two_walkers_a_dimension_and_four_more(fitted: Any, one_sampled: None):
    _, record = sample_posterior(*fitted, max_steps=2, n_samples=5)
    assert record.chain.steps.shape == (2, 6, 1)


def test_the_density_has_the_bins_and_weights_of_the_fit(fitted: tuple[Plant, list[Log]]):
    plant, logs = fitted
    plant = replace(plant, scores=replace(plant.scores, weight_s={"t": 24.0}, average_s=8.0))
    problem = posterior.fit_problem(plant, logs)
    assert (problem.average, problem.tau.tolist()) == (8.0, [3.0])
    long = replace(plant, scores=replace(plant.scores, average_s=30.0))
    assert posterior.fit_problem(long, logs).tau.tolist() == [1.0]  # a bin is a reading at most
    free = replace(plant, scores=PlantScores())
    assert posterior.fit_problem(free, logs).tau.tolist() == [15.0]


@pytest.mark.parametrize("what", ["moves from one start", "starts", "draws"])
def test_a_seed_decides(fitted: tuple[Plant, list[Log]], what: str):
    make: Any = {
        "moves from one start": lambda s: run_chain(normal, start(), max_steps=20, seed=s).steps,
        "starts": lambda s: sample_posterior(*fitted, max_steps=1, n_samples=2, seed=s)[1].chain.steps[0],
        "draws": lambda s: with_draws(fitted[0], fit_problem(*fitted), 3, seed=s).samples,
    }[what]
    one, again, other = (make(seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert np.any(one != other) if what.startswith("moves") else not np.isclose(one, other).any()
    if what == "draws":
        assert np.all(np.asarray([one, other])[:, :, 0] > 0)


def test_what_is_integrated_out_goes_with_its_own_sample(one_sampled: None) -> None:
    _, record = sample_posterior(*a_fit(), max_steps=60, n_samples=300)
    assert record.sampled == ("a",)
    rows = record.chain.steps.reshape(-1)
    kept = record.samples[:, 0]
    assert all(np.abs(rows - value).min() < 1e-9 for value in kept[::30])
    # the logs distinguish a from b by how soon it is warm: they trade off, sample by sample
    assert np.corrcoef(record.samples.T)[0, 1] < -0.3


def bent_map(fit: float = 0.0) -> RandomizedMap:
    slope = Bent.STEEP * np.array([[-1.0, 1.0]])
    return RandomizedMap(Bent(), np.full(2, fit), SimpleNamespace(spread=slope.T @ slope, coarsening=4.0))  # type: ignore[arg-type]


def test_the_density_is_that_of_the_prior_of_moves_along_the_slopes_and_off_them() -> None:
    """d = 5 (x + 0.3 x^3) in the first reading, and V = A: half of (d / 5)^2 in units of the span's 5."""
    target = bent_map(0.7)
    z = np.array([[0.7, 0.7], [0.2, 1.4], [9.0, 9.0], [-9.0, -9.0], [9.1, 9.0]])
    d = 5 * (1.2 + 0.3 * 1.2**3)
    want = [0.0, -0.5 * (0.25 + 0.49) - 0.5 * d**2 / 1.001, -(8.3**2), -(9.7**2), -np.inf]
    np.testing.assert_allclose(target.log_profile(z, [0, 1]), want, rtol=1e-6)
    np.testing.assert_allclose(target.information, 25 / 1.001 * np.array([[1, -1], [-1, 1]]), rtol=1e-6)
    np.testing.assert_allclose(target.covariance, np.linalg.inv(np.eye(2) + target.information))
    assert np.isneginf(target.log_profile(np.array([[9.1], [-9.1]]), [0])).all()
