"""What a posterior says of itself, from its own samples; which parameters it samples, from which starts."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.sysid.greybox.test_posterior import TwoGains, a_fit, a_log
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log
from thermogrip.sysid.greybox import posterior
from thermogrip.sysid.greybox.fit import fit_network
from thermogrip.sysid.greybox.posterior import Posterior, sample_posterior, with_draws
from thermogrip.sysid.models.network_spec import Parameter
from thermogrip.sysid.plant.fit_record import PlantScores, Sampling
from thermogrip.sysid.plant.plant import Plant

Array = NDArray[np.float64]


class Three(TwoGains):
    """The gains behind a parameter that is fixed, one of them on a logarithmic scale."""

    parameters = ("tube", "a", "b")  # type: ignore[assignment]
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
    return fit_network(Three(), logs), logs  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def sampled(fitted: tuple[Plant, list[Log]]) -> tuple[Plant, Posterior]:
    return sample_posterior(*fitted, max_steps=60, n_samples=300, seed=2)


def test_the_record_is_in_the_parameters_own_units(fitted: Any, sampled: tuple[Plant, Posterior]):
    plant, record = sampled
    assert record.free == record.sampled == ("a", "b")
    assert record.units == {"a": "K", "b": "W"}
    assert record.fitted == {name: fitted[0].values[name] for name in "ab"}
    assert plant.samples is not None
    np.testing.assert_array_equal(plant.samples, record.samples)
    assert record.samples.shape == (300, 2)
    low, middle, high = np.quantile(record.samples, [0.05, 0.5, 0.95], axis=0)
    for k, name in enumerate("ab"):
        assert record.quantiles[name] == pytest.approx((low[k], middle[k], high[k]))
    # all were sampled, so that the samples are rows of the chain
    rows = record.chain.steps.reshape(-1, 2)
    for sample in record.samples[::50]:
        assert np.abs(rows / sample - 1).max(axis=1).min() < 1e-9


def test_the_record_says_how_far_its_middle_lies_from_the_fit(fitted: Any, sampled: tuple[Plant, Posterior]):
    _, record = sampled
    z = np.column_stack([np.log(record.samples[:, 0]), record.samples[:, 1]])
    fit = np.array([np.log(fitted[0].values["a"]), fitted[0].values["b"]])
    off = np.abs(np.median(z, axis=0) - fit) / z.std(axis=0)
    assert record.off_centre == pytest.approx(off.max())


def test_the_record_counts_its_steps_in_the_slowest_autocorrelation_time(sampled: tuple[Plant, Posterior]):
    plant, record = sampled
    slowest = max(record.tau.values())
    assert list(record.tau) == ["a", "b"]
    assert list(record.tau.values()) == record.chain.tau.tolist()
    assert record.tau["a"] != record.tau["b"]
    assert record.verdict == f"not converged: {60 / slowest:.0f} autocorrelation times"
    assert plant.scores.posterior == Sampling(record.verdict, False, record.likelihood, record.tau)


def test_what_is_saved_is_by_walker_and_step_under_the_parameters_name(
    fitted: Any, sampled: tuple[Plant, Posterior]
):
    _, record = sample_posterior(*fitted, free=["b"], max_steps=50)
    data = record.inference_data()
    assert list(data.posterior) == ["b"]
    np.testing.assert_allclose(data.posterior["b"].values, record.chain.steps[:, :, 0].T)
    np.testing.assert_allclose(data.sample_stats["lp"].values, record.chain.log_posterior.T)
    assert list(data.posterior_whole) == ["a", "b"]


def test_those_are_sampled_that_the_data_know_best_in_their_own_order():
    plant: Any = SimpleNamespace(free=("a", "b", "c", "d"))
    spread = np.diag([0.5, 0.1, 0.9, 0.2])
    choose = posterior._choose
    assert choose(plant, None, 2, spread) == [1, 3]
    assert choose(plant, None, 3, spread) == [0, 1, 3]
    assert choose(plant, None, 9, spread) == [0, 1, 2, 3]
    assert choose(plant, ["d", "a", "d"], 2, spread) == [3, 0]
    with pytest.raises(UserError, match="no parameter to sample; choose from a, b, c, d"):
        choose(plant, [], 2, spread)


@pytest.mark.parametrize(("asked", "walkers"), [(None, 6), (3, 6), (11, 11)])
def test_there_are_two_walkers_a_dimension_and_four_more_or_as_many_as_asked_for(
    fitted: Any, asked: int | None, walkers: int
):
    _, record = sample_posterior(*fitted, n_sampled=1, walkers=asked, max_steps=2, n_samples=5)
    assert record.chain.steps.shape == (2, walkers, 1)
    assert len(record.sampled) == 1


def test_walkers_start_where_the_density_is_not_nought():
    candidates = np.arange(10.0)[:, None]

    def density(x: Array) -> Array:
        return np.where(x[:, 0] % 2 == 0, 0.0, -np.inf)

    assert posterior._inside(candidates, density, 3)[:, 0].tolist() == [0.0, 2.0, 4.0]
    with pytest.raises(UserError, match="lies at a bound"):
        posterior._inside(candidates, density, 6)


def test_the_density_has_the_bins_and_weights_of_the_fit(fitted: tuple[Plant, list[Log]]):
    plant, logs = fitted
    plant = replace(plant, scores=replace(plant.scores, weight_s={"t": 24.0}, average_s=8.0))
    problem = posterior._problem(plant, logs, None)
    assert (problem.average, problem.tau.tolist()) == (8.0, [3.0])
    problem = posterior._problem(plant, logs, 6.0)
    assert (problem.average, problem.tau.tolist()) == (6.0, [4.0])
    assert posterior._problem(plant, logs, 30.0).tau.tolist() == [1.0]  # a bin is a reading at most
    free = replace(plant, scores=PlantScores())
    assert posterior._problem(free, logs, None).tau.tolist() == [15.0]


def test_the_error_that_was_learnt_is_taken_for_the_fits_own_logs_alone(
    fitted: tuple[Plant, list[Log]], monkeypatch: pytest.MonkeyPatch
):
    plant, logs = fitted
    given: list[Any] = []
    whole = posterior.score_covariance

    def watched(problem: Any, z: Any, numbers: Any = None) -> Any:
        given.append(numbers)
        return whole(problem, z, numbers=numbers)

    monkeypatch.setattr(posterior, "score_covariance", watched)
    with_draws(plant, logs, 2)
    with_draws(plant, [logs[0], a_log(7)], 2)
    with_draws(plant, logs[:1], 2)
    assert [numbers is not None for numbers in given] == [True, False, False]


def test_a_seed_decides_the_draws(fitted: tuple[Plant, list[Log]]):
    made = [with_draws(*fitted, 3, seed=seed).samples for seed in (0, 0, 1)]
    np.testing.assert_array_equal(made[0], made[1])
    assert np.any(made[0] != made[2])
    assert np.all(np.asarray(made)[:, :, 0] > 0)


def test_what_is_integrated_out_goes_with_its_own_sample() -> None:
    plant, logs = a_fit()
    _, record = sample_posterior(plant, logs, free=["b"], max_steps=60, n_samples=300)
    rows = record.chain.steps.reshape(-1)
    kept = record.samples[:, 1]
    assert all(np.abs(rows - value).min() < 1e-9 for value in kept[::30])
    # the logs tell a from b by how soon it is warm: they trade off against each other, sample by sample
    assert np.corrcoef(record.samples.T)[0, 1] < -0.3


def test_one_seed_moves_the_starts_too(fitted: tuple[Plant, list[Log]]) -> None:
    begins = [
        sample_posterior(*fitted, max_steps=1, n_samples=2, seed=s)[1].chain.steps[0] for s in (0, 0, 1)
    ]
    np.testing.assert_array_equal(begins[0], begins[1])
    assert not np.isclose(begins[0], begins[2]).any()
