"""What a plant's page says of a free run: its verdict and its colour agree with the notes under it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermogrip.datasets.schema import Log, make_log
from thermogrip.report.plant import _prior_intervals, free_run_section, parameter_rows
from thermogrip.sysid.experiment.information import plant_from_prior
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.validation.free_run import FreeRun, free_run
from thermogrip.sysid.validation.residual_tests import CorrelationTest, ResidualCorrelations


@pytest.fixture(scope="module")
def run() -> tuple[Plant, Log, FreeRun]:
    """Return a plant, a log of it with white noise, and its free run."""
    block = StateSpaceModel(("q",), (), ("t",), A=[[0.9]], B=[[1.0]], C=[[1.0]], dt=1.0)
    q = np.repeat([0.0, 1.0, 0.0, 2.0], 50)
    y = block.rollout([[0.0]], q[None, :, None], np.zeros((1, 200, 0)), (), 1.0)[0][0, :-1, 0]
    y = y + 0.05 * np.random.default_rng(0).standard_normal(200)
    log = make_log(np.arange(200.0), {"q": (q, "1", "input"), "t": (y, "degC", "output")})
    plant = Plant(block, {}, dt=1.0, noise={"t": 0.05})
    return plant, log, free_run(plant, log)


def test_a_good_free_run_is_green(run: tuple[Plant, Log, FreeRun]) -> None:
    plant, log, found = run
    section = free_run_section(log, found, plant)
    assert section.tone == "good"
    assert section.verdict.startswith("Free run (RMSE): t to 0.0")


def test_one_that_errs_more_than_its_fit_is_not_green_and_says_by_how_much(
    run: tuple[Plant, Log, FreeRun],
) -> None:
    plant, log, found = run
    section = free_run_section(log, replace(found, exceeds_fit={"t": 3.14}), plant)
    assert section.tone == "warn"
    assert "More than the fit left: t 3.1 times." in section.verdict


@pytest.mark.parametrize(
    ("signal", "words"),
    [
        ("q", "The residual still follows, of t, q."),
        ("t squared", "The residual still follows, of t, its own square."),
    ],
)
def test_one_whose_residual_follows_something_is_not_green_and_says_what(
    run: tuple[Plant, Log, FreeRun], signal: str, words: str
) -> None:
    plant, log, found = run
    follows = CorrelationTest(p=1e-6, size=0.02, significant=True)
    section = free_run_section(
        log, replace(found, residual=ResidualCorrelations({"t": {signal: follows}}, {})), plant
    )
    assert section.tone == "warn"
    assert words in section.verdict


def test_the_prior_of_a_network_stands_beside_what_was_learnt_and_a_black_box_has_none(
    run: tuple[Plant, Log, FreeRun],
) -> None:
    rows = parameter_rows(plant_from_prior(load_network("tclab")))  # of a plant that has learnt nothing
    assert len(rows) > 3
    for _, value, _, *learnt_and_prior in rows:
        low, high, *prior = learnt_and_prior
        assert low < value < high
        assert prior == [low, high]
    assert _prior_intervals(run[0]) == {}
