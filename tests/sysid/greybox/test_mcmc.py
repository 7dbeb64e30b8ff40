"""A chain of walkers: what is kept of it, when it has converged, its proposals, and what it belongs to."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import emcee
import numpy as np
import pytest
from scipy.stats import multivariate_t

from tests.sysid.greybox.test_posterior import TwoGains, a_log
from thermogrip.sysid.greybox import mcmc as chains
from thermogrip.sysid.greybox import mcmc as mcmc_file
from thermogrip.sysid.greybox.mcmc import Chain, problem_hash, run_chain
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.plant.fit_record import PlantScores

Array = np.ndarray
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
    apart = np.diff(kept[:, 0])
    assert apart.max() - apart.min() < 1.5  # evenly spread, to a step
    assert len(made.kept(10_000)) == 3 * (100 - burn)


@pytest.mark.parametrize(
    ("tau", "converged", "length"),
    [((1.5, 1.0), True, 100), ((1.0, 40.0), False, 120), ((2.4, 2.4), False, 120)],
)
def test_a_chain_has_converged_where_its_slowest_dimension_has(
    monkeypatch: pytest.MonkeyPatch, tau: tuple[float, float], converged: bool, length: int
):
    monkeypatch.setattr(chains, "_autocorrelation", lambda steps: np.array(tau))
    found = run_chain(normal, start(), max_steps=120)
    assert (found.converged, len(found.steps)) == (converged, length)


def test_a_walker_that_has_not_moved_yet_leaves_the_chain_as_slow_as_it_is_long():
    steps = np.random.default_rng(0).normal(size=(200, 6, 2))
    one, two = chains._autocorrelation(steps)
    steps[:, 3, 1] = 0.7
    assert chains._autocorrelation(steps).tolist() == [one, 200.0]
    assert max(one, two) < 3.0
    told: list[float] = []
    short = run_chain(normal, start(), max_steps=2, progress=lambda share, what: told.append(share))
    assert (short.tau.tolist(), short.converged, told) == ([2.0, 2.0], False, [1.0])
    assert short.kept(5).shape == (5, 2)

    def nowhere(x: Array) -> Array:  # every move away from the start is refused
        return np.where((x[:, None] == begin[None]).all(axis=2).any(axis=1), 0.0, -np.inf)

    begin = start()
    found = run_chain(nowhere, begin, max_steps=100, progress=lambda share, what: told.append(share))
    assert (found.converged, found.acceptance, told[1:]) == (False, 0.0, [0.5, 1.0])


def test_steps_that_are_there_already_count(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(chains, "_autocorrelation", lambda steps: np.array([30.0, 30.0]))
    backend = emcee.backends.Backend()
    first = run_chain(normal, start(), max_steps=60, backend=backend).steps.copy()
    whole = run_chain(normal, start(seed=9), max_steps=80, backend=backend)
    assert len(whole.steps) == 80
    np.testing.assert_array_equal(whole.steps[:60], first)
    assert len(run_chain(normal, start(), max_steps=80, backend=backend).steps) == 80


def test_a_chain_says_its_density_and_how_many_moves_were_taken():
    begin = start()
    found = run_chain(normal, begin, max_steps=40, normal=(MEAN, 2.0 * COVARIANCE))
    np.testing.assert_allclose(found.log_posterior, [normal(step) for step in found.steps])
    moved = np.any(np.diff(np.concatenate([begin[None], found.steps]), axis=0) != 0, axis=2)
    assert found.acceptance == pytest.approx(moved.mean())
    assert 0.2 < found.acceptance < 1.0


def test_a_seed_decides_the_moves_from_one_start():
    runs = [run_chain(normal, start(), max_steps=20, seed=seed).steps for seed in (1, 1, 2)]
    np.testing.assert_array_equal(runs[0], runs[1])
    assert np.any(runs[0] != runs[2])


def test_proposals_are_students_t_somewhat_wider_than_the_normal():
    propose = chains._proposals(MEAN, COVARIANCE)
    n, shape = 40_000, 1.25**2 * COVARIANCE
    old = start(n)
    new, ratio = propose(old, np.random.RandomState(0))
    t = multivariate_t(MEAN, shape, df=6)
    np.testing.assert_allclose(ratio, t.logpdf(old) - t.logpdf(new), atol=1e-9)
    # in its own axes each coordinate is a t of 6 degrees of freedom: variance 1.5, fourth moment 13.5
    axes = np.linalg.solve(np.linalg.cholesky(shape), (new - MEAN).T)
    assert np.abs(axes.mean(axis=1)).max() < 5 * np.sqrt(1.5 / n)
    assert np.abs(np.cov(axes) - 1.5 * np.eye(2)).max() < 5 * np.sqrt((13.5 - 1.5**2) / n)
    inside = np.mean(np.sum(axes**2, axis=0) / 2 < 1.7803)  # the median of F(2, 6) is 0.7798, 80 % are < 2.13
    assert inside == pytest.approx(1 - (1 + 1.7803 / 3) ** -3, abs=5 * 0.5 / np.sqrt(n))


# ---- what a chain belongs to ----


def hash_of(**changes: Any) -> str:
    plant = prior_plant(TwoGains(changes.pop("nuisance", 0.0)))  # type: ignore[arg-type]
    plant = replace(
        plant, values=changes.pop("values", plant.values), scores=changes.pop("scores", PlantScores())
    )
    usual: dict[str, Any] = {
        "logs": [a_log(1, seconds=60), a_log(2, seconds=60)],
        "sampled": [0],
        "average": 4.0,
        "walkers": 8,
        "seed": 3,
    }
    return problem_hash(plant, **usual | changes)


def changed(name: str, at: int) -> list[Any]:
    logs = [a_log(1, seconds=60), a_log(2, seconds=60)]
    logs[at][name].values[7] += 1e-3
    return logs


def test_a_chain_belongs_to_one_problem_whatever_is_changed():
    logs = [a_log(1, seconds=60), a_log(2, seconds=60)]
    later = logs[0].assign_coords(time=logs[0]["time"] + 0.5)
    seen = [
        hash_of(),
        hash_of(sampled=[1]),
        hash_of(sampled=[0, 1]),
        hash_of(average=5.0),
        hash_of(walkers=10),
        hash_of(seed=4),
        hash_of(scores=PlantScores(weight_s={"t": 30.0})),
        hash_of(values={"a": 4.001, "b": 4.0}),
        hash_of(logs=logs[:1]),
        hash_of(logs=logs[::-1]),
        hash_of(logs=[later, logs[1]]),
        hash_of(logs=changed("t", 0)),
        hash_of(logs=changed("t", 1)),
        hash_of(logs=changed("q", 0)),
    ]
    assert len(set(seen)) == len(seen)
    assert hash_of() == seen[0] == hash_of(values={"a": 4.0 + 1e-9, "b": 4.0})  # a machine's last digits
    assert hash_of(scores=PlantScores(weight_s={"t": 30.0}, seconds=7.0)) == seen[6]


def test_a_chain_belongs_to_one_model_and_one_method(monkeypatch: pytest.MonkeyPatch):
    before = hash_of()
    with monkeypatch.context() as patch:
        patch.setattr(mcmc_file, "_METHOD", mcmc_file._METHOD + 1)
        assert hash_of() != before
    monkeypatch.setattr(TwoGains, "to_dict", lambda self: {"kind": "two other gains"})
    assert hash_of() != before
