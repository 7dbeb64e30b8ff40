"""Interpolated responses: beside stepped ones, at the ends, and in whatever order they are asked for."""

import numpy as np
import pytest

from thermogrip.datasets.examples import load_example_grasps
from thermogrip.sysid.contact.response_table import ResponseTable
from thermogrip.sysid.contact.simulation import SOFT_FINGER, gripper_modes, time_nodes
from thermogrip.sysid.contact.time_stepping import contacts
from thermogrip.sysid.effusivity import data as touch_data
from thermogrip.sysid.effusivity import load_default_gripper
from thermogrip.sysid.effusivity.laplace_approximation import nodes_for, pairs_asked
from thermogrip.sysid.effusivity.mode_kernel import readings
from thermogrip.sysid.effusivity.posterior import effusivity_posterior

END = 12.0


def places(n: int, seed: int) -> np.ndarray:
    """Return contacts (n, 4) of metals and insulators."""
    rng = np.random.default_rng(seed)
    ln_e, ln_h = rng.uniform(3.0, 11.5, n), rng.uniform(5.5, 8.0, n)
    ln_c, ln_build_up = rng.uniform(9.5, 11.5, n), np.log(SOFT_FINGER.build_up) + rng.uniform(-0.5, 0.5, n)
    return np.exp(np.stack([ln_e, np.maximum(ln_c, ln_e - 1.0), ln_h, ln_build_up], axis=1))


def stepped(contact: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rise and slope without a table."""
    every = np.ones((len(contact), 5), dtype=bool)
    return contacts(time_nodes(END), gripper_modes(SOFT_FINGER), contact, every)[:2]


@pytest.fixture(scope="module")
def table() -> ResponseTable:
    return ResponseTable(SOFT_FINGER, END)


def test_interpolated_responses_are_the_stepped_ones(table):
    contact = places(60, 1)
    rise, slope = table.curves(contact, np.ones((60, 5), dtype=bool))
    there, rate = stepped(contact)
    assert np.abs(rise[:, 0] - there[:, 0]).max() < 2e-5
    assert np.abs(slope[:, 0] - rate[:, 0]).max() < 1e-4
    assert np.abs(rise - there).max() < 3e-4  # derivatives too


def test_values_alone_are_those_beside_derivatives(table):
    contact, wanted = places(10, 2), np.zeros((10, 5), dtype=bool)
    every = table.curves(contact, np.ones((10, 5), dtype=bool))
    wanted[:, 0] = True
    for one, beside in zip(table.curves(contact, wanted), every):
        assert one.shape[1] == 1
        np.testing.assert_allclose(one[:, 0], beside[:, 0], atol=1e-12)


def test_what_lies_outside_is_stepped(table):
    contact = places(6, 3)
    contact[::2, 2] = 20.0  # W m^-2 K^-1: hardly a contact
    rise, slope = table.curves(contact, np.ones((6, 5), dtype=bool))
    there, rate = stepped(contact)
    np.testing.assert_array_equal(rise[::2], there[::2])
    np.testing.assert_array_equal(slope[::2], rate[::2])
    assert np.abs(rise[1::2, 0] - there[1::2, 0]).max() < 2e-5


def test_answers_do_not_depend_on_what_was_asked_before(table):
    contact, every = places(20, 4), np.ones((20, 5), dtype=bool)
    fresh = ResponseTable(SOFT_FINGER, END)
    for at in (slice(7, 8), slice(3, 15)):
        fresh.curves(contact[at], every[at])
    for one, other in zip(table.curves(contact, every), fresh.curves(contact, every)):
        np.testing.assert_array_equal(one, other)


def test_a_long_block_has_no_far_face(table):
    contact = places(1, 5).repeat(2, axis=0)
    contact[:, 1] = contact[:, 0] * np.exp([4.0, 5.0])
    rise, _ = table.curves(contact, np.ones((2, 5), dtype=bool))
    np.testing.assert_array_equal(rise[0], rise[1])
    assert not rise[:, 4].any()


@pytest.mark.parametrize("lost", [False, True])
def test_bin_means_of_the_table_are_those_of_stepped_responses(monkeypatch, lost):
    """Samples at the same times as others', or, of a grasp with a sample lost, at times of their own."""
    monkeypatch.setattr(touch_data, "MANY", 25)
    gripper, record = load_default_gripper(), load_example_grasps()["exp1A_obj43_grip23"]
    if lost:
        record = record.copy(deep=True)
        record["t_surface"].values[:2, 40] = np.nan
    data = touch_data.with_tables(touch_data.touches(record))
    assert data.common is not None
    assert data.common[0] == (not lost)
    assert data.common[2]
    rng, row = np.random.default_rng(6), np.repeat(np.arange(4), 15)
    u = np.empty((60, 7))
    u[:, [5, 6, 0, 1]] = np.log(places(60, 7))
    u[:, 1] += np.log(gripper.stack.build_up / SOFT_FINGER.build_up)
    u[:, 2], u[:, 3], u[:, 4] = rng.uniform(-1.6, 0.9, 60), 23.0, 43.0
    every, found = np.ones((60, 7), dtype=bool), []
    for tabled in (True, False):
        asked = pairs_asked(gripper.stack, nodes_for(data), data, row, None, tabled=tabled)
        found.append(readings(asked, u, every))
    (y, by_u), (stepped_y, by_stepped_u) = found
    assert np.abs(y - stepped_y).max() < 20.0 * 3e-5
    n = slice(0, 7)  # what a caller has in the last column is nothing yet
    assert np.abs(by_u[:, :, n] - by_stepped_u[:, :, n]).max() < 20.0 * 1e-3
    assert (y != stepped_y).any()  # it was the table that answered
    assert np.abs(by_stepped_u[:, :, n]).max(axis=(0, 1)).min() > 0.1


def test_places_at_one_ln_e_share_sums_and_no_answer(table):
    """Beside others at their ln e, in any order, or alone: the same response."""
    contact = places(12, 8)
    contact[1::2, 0], contact[::3, 1] = contact[::2, 0], contact[0, 1]
    wanted = np.ones((12, 5), dtype=bool)
    wanted[::2, 3] = False
    wanted[::4, 1:] = False
    together = table.curves(contact, wanted)
    order = np.random.default_rng(9).permutation(12)
    for mixed, one in zip(together, table.curves(contact[order], wanted[order])):
        np.testing.assert_array_equal(mixed[order], one)
    for i in range(12):
        for mixed, one in zip(together, table.curves(contact[[i]], wanted[[i]])):
            np.testing.assert_allclose(mixed[i, : one.shape[1]], one[0], atol=1e-12)


def test_posteriors_are_those_of_stepped_responses(monkeypatch):
    grasps, gripper = load_example_grasps()["exp1A_obj43_grip23"], load_default_gripper()
    found = []
    for many in (grasps.sizes["grasp"], 10**6):
        monkeypatch.setattr(touch_data, "MANY", many)
        found.append(effusivity_posterior(gripper, grasps))
    for tabled, plain in zip(*found):
        width = np.log(plain.effusivity_p95 / plain.effusivity_p05)
        assert abs(np.log(tabled.effusivity / plain.effusivity)) < 0.03 * width
        assert abs(tabled.t_object - plain.t_object) < 0.02
    assert found[0] != found[1]  # it was the table that answered
