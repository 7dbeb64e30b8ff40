"""A plant inside another file, or on its way to another process, is the same plant."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

from thermogrip.datasets.files import read_json
from thermogrip.mpc.controller import Controller
from thermogrip.mpc.design import default_design
from thermogrip.mpc.search import Search
from thermogrip.mpc.spec import Spec
from thermogrip.sysid.greybox_problem import prior_plant
from thermogrip.sysid.network import load_network
from thermogrip.sysid.plant import Plant


@pytest.fixture(scope="module")
def sampled() -> Plant:
    """Return the gripper with 400 samples of what it knows least."""
    plant = prior_plant(load_network("gripper"))
    middle = np.array([plant.values[name] for name in plant.free])
    samples = middle * (1 + 0.05 * np.random.default_rng(0).uniform(-1, 1, (400, middle.size)))
    return replace(plant, samples=samples)


def test_a_controller_keeps_some_draws_and_a_worker_gets_them_all(sampled, tmp_path):
    controller = Controller(sampled, default_design(sampled))
    some = read_json(controller.save(tmp_path / "c.json"), "thermogrip.controller", 1)["plant"]
    every = sampled.to_dict()
    assert (len(some["draws"]), len(every["draws"])) == (50, 400)
    assert all(row in every["draws"] for row in some["draws"])


@pytest.mark.parametrize("k", [1, 2, 13])
def test_the_kth_draw_is_the_same_in_another_process(sampled, k):
    assert Plant.from_dict(sampled.to_dict()).draw(k).values == sampled.draw(k).values


def test_a_search_that_travels_judges_the_same_draws(sampled):
    spec = Spec(steps=[(28, 30)], hold_s=120.0, search_draws=1, check_draws=1)
    search = Search(sampled, spec, default_design(sampled), seed=0)
    there = pickle.loads(pickle.dumps(search))  # noqa: S301, what a process pool does
    for draw in (*search.draws, *search.unseen):
        assert there.plant.draw(draw).values == search.plant.draw(draw).values
