"""The parts of the search for modes, against linear algebra, densities and sums by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm
from scipy.stats import t as student_t

from thermogrip.datasets.examples import load_example_grasps
from thermogrip.sysid.effusivity import mode_kernel as kernel
from thermogrip.sysid.effusivity.data import touches, whiten
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
from thermogrip.sysid.effusivity.laplace_approximation import (
    fit_candidates,
    fit_pairs,
    material_hypotheses,
    nodes_for,
    pairs_asked,
    prior_of,
)


@pytest.mark.parametrize("dof", [np.inf, 4.0, 6.0])
def test_the_penalty_is_the_priors_density_beside_its_peak(dof):
    law, h = norm() if np.isinf(dof) else student_t(dof), 1e-6
    for w in (-2.7, -0.4, 0.0, 0.8, 6.0):
        value, slope, bound, own = kernel.penalty.py_func(w, 1 / dof)
        above, below = (kernel.penalty.py_func(w + off, 1 / dof) for off in (h, -h))
        assert value == pytest.approx(2 * (law.logpdf(0) - law.logpdf(w)))
        assert slope == pytest.approx((above[0] - below[0]) / (4 * h), rel=1e-5, abs=1e-8)
        assert own == pytest.approx(max((above[1] - below[1]) / (2 * h), 1e-3), rel=1e-5)
        # what makes of the slope a step to the mean
        assert bound == pytest.approx(slope / w) if w else bound >= own


def test_a_damped_step_solves_its_equations():
    rng = np.random.default_rng(0)
    slopes, right, out = rng.normal(size=(9, 7)), rng.normal(size=7), np.empty(7)
    product = kernel.solve.py_func(slopes.T @ slopes, right, np.empty((7, 7)), out)
    np.testing.assert_allclose(slopes.T @ slopes @ out, right)
    assert product == pytest.approx(right @ out)


def test_products_are_in_units_of_each_spread_and_none_of_what_is_known():
    gripper, record = load_default_gripper(), load_example_grasps()["exp1A_obj43_grip23"]
    data = touches(record.isel(grasp=[0, 1]))
    asked = pairs_asked(gripper.stack, nodes_for(data), data, np.array([0, 1]), None)
    u = np.array([[6.5, np.log(0.5), 0.0, 23.0, 43.0, 8.0, 10.0]]).repeat(2, axis=0)
    w = whiten(data, gripper.noise)[0]
    unit = kernel.products(asked, w, u, np.ones((2, 7)))
    for unknown in (np.array([3, 4]), np.array([0, 1, 3, 4, 5, 6])):
        sd, scale = np.zeros((2, 7)), np.zeros((2, 8))
        sd[:, unknown] = [0.5 + 0.1 * unknown, 2.0 + 0.1 * unknown]
        scale[:, :7], scale[:, 7] = sd, 1.0
        want = unit * scale[:, :, None] * scale[:, None, :]
        np.testing.assert_allclose(kernel.products(asked, w, u, sd), want, rtol=1e-9, atol=1e-9)


def means_of(nodes, rise, slope, times, bins, *, onset=0.0, late=-1.0):
    """Return bin means, of the value and of its slope, and what is delayed, of one sample a bin."""
    times, bins = np.array([times]), np.array([bins])
    n = times.shape[1]
    count = np.zeros((1, n))
    count[0, bins[bins >= 0]] = 1.0
    curves = np.zeros((1, 6, len(nodes)))
    bent, means, room = curves.copy(), np.empty((1, 6, n)), np.zeros((16, n))
    curves[0, 0], bent[0, 0] = rise, slope
    wanted, at = np.array([[True, False, False, False, False, True]]), np.array([0])
    kernel.bin_means.py_func(
        np.array(nodes, dtype=float), curves, bent, wanted, np.array([onset]), at, times, bins, count,
        means,
    )  # fmt: skip
    u, numbers = np.zeros((1, 7)), np.zeros((1, 7))
    if late >= 0:  # (C / e)^2 / 6, by a block that loses heat to its room
        u[0, 6], numbers[0, 5] = 0.5 * np.log(6 * late + 1e-30), 1.0
    kernel.predicted.py_func(
        means, wanted, at, count, times, times, times, np.zeros(1), numbers, np.zeros((1, 2, n)), u,
        np.zeros((1, 7), dtype=bool), room, np.empty((1, n)), np.empty((1, 8, n)),
    )  # fmt: skip
    return means[0, 0], means[0, 5], room[4], room[10]


def test_samples_find_their_nodes_whichever_way_they_come():
    """A straight line is its own interpolation; what is lost or before contact is nothing."""
    nodes, times = [0.0, 1.0, 2.0, 4.0], [0.5, 3.5, 9.0, 1.5, 2.5, 3.0, 1.6]
    found, rate, _, _ = means_of(nodes, nodes, np.ones(4), times, [0, 1, 2, 3, -1, 5, 6], onset=0.5)
    np.testing.assert_allclose(found, [0.0, 3.0, 4.0, 1.0, 0.0, 2.5, 1.1])
    np.testing.assert_allclose(rate, [0.0, 1.0, 1.0, 1.0, 0.0, 1.0, 1.0])


def test_between_nodes_a_cubic_is_met_with_its_slope():
    nodes, times = np.array([0.0, 1.0, 3.0]), [0.25, 1.5, 2.9]
    found, rate, _, _ = means_of(nodes, nodes**3 - nodes, 3 * nodes**2 - 1, times, [0, 1, 2])
    np.testing.assert_allclose(found, np.power(times, 3) - times)
    np.testing.assert_allclose(rate, 3 * np.square(times) - 1)


def test_a_delayed_integral_goes_by_straight_lines_between_the_points_that_count():
    """Readings 0, 2, 4 at 1, 2, 4 s, one lost between: integrals 0, 1, 7; looked at half a second late."""
    nodes, times, bins = [0.0, 1.0, 2.0, 4.0, 4.5], [1.0, 2.0, 3.0, 4.0, 4.5], [0, 1, -1, 3, 4]
    given = nodes, [0.0, 0.0, 2.0, 4.0, 4.0], np.zeros(5), times, bins
    _, _, total, value = means_of(*given, late=0.5)
    np.testing.assert_allclose(value, [0.0, 1.0, 0.0, 3.5, 4.0])
    np.testing.assert_allclose(total, [0.0, 0.25, 0.0, 1 + 1.5 * 2.75, 7.0])
    np.testing.assert_allclose(means_of(*given, late=0.0)[2], [0.0, 1.0, 0.0, 7.0, 9.0])
    assert not means_of(*given)[2].any()


@pytest.mark.usefixtures("one_grade")
def test_a_candidate_far_behind_is_left_and_changes_no_other():
    gripper, record = load_default_gripper(), load_example_grasps()["exp1A_obj43_grip23"]
    data = touches(record.isel(grasp=np.flatnonzero(record["material"].values == "copper")[:3]))
    names = ["copper", "iron", "wood"]
    raced, row, *_ = fit_candidates(gripper, data, names)
    one = material_hypotheses(gripper, names)
    alone = fit_pairs(gripper, data, row, type(one)(*(np.tile(column, 3) for column in one)))
    found = raced.log_evidence.reshape(3, 3)
    settled = raced.converged.reshape(3, 3)
    assert settled[:, :2].all()
    assert not settled[:, 2].any()
    assert (found[:, 2] < found[:, 0] - 60).all()
    np.testing.assert_allclose(raced.u[row < 3][settled.ravel()], alone.u[settled.ravel()], atol=0.05)
    assert (alone.log_evidence.reshape(3, 3)[:, 2] < found[:, 0] - 25).all()


def test_what_no_grade_of_a_disturbed_grasp_can_make_up_for_is_left_and_changes_no_evidence(monkeypatch):
    gripper, record = load_default_gripper(), load_example_grasps()["exp1A_obj43_grip23"].isel(grasp=[0])
    swings = 1.5 * np.sin(record["time"]).where(record["time"] > 1.0, 0.0)
    data, products, asked = (
        touches(record.assign(t_surface=record["t_surface"] + swings)),
        kernel.products,
        [],
    )

    def counted(pairs, *rest, **how):
        asked[-1] += pairs.row.size
        return products(pairs, *rest, **how)

    monkeypatch.setattr(kernel, "products", counted)
    evidence = []
    for no_part in (kernel.SEARCH.no_part, np.inf):
        monkeypatch.setattr(kernel, "SEARCH", kernel.SEARCH._replace(no_part=no_part))
        asked.append(0)
        evidence.append(fit_candidates(gripper, data, ["copper", "iron", "wood"]).mode.log_evidence)
    np.testing.assert_allclose(*evidence, atol=1e-9)
    assert asked[0] < 0.7 * asked[1]


def test_kernels_are_compiled_for_one_kind_of_arguments():
    """An array that must not be written to, or lies in memory in another order, is another kind: 2 s more."""
    gripper, record = load_default_gripper(), load_example_grasps()["exp1A_obj43_grip23"]
    data = touches(record.isel(grasp=[0, 1]))
    for beyond in (None, np.zeros((2, 2, data.y.shape[1])), np.zeros((1, 2, data.y.shape[1]))):
        found = pairs_asked(gripper.stack, nodes_for(data), data, np.array([0, 1]), beyond).beyond
        assert found.flags.writeable
        assert found.flags.c_contiguous


def test_a_search_that_begins_at_the_skins_temperature_ends_where_others_do():
    """Where object and skin are alike slopes say nothing of the rest, until the temperature has moved."""
    gripper, record = load_default_gripper(), load_example_grasps()["exp1A_obj43_grip23"]
    data = touches(record.isel(grasp=[0]).assign(t_object=("grasp", [np.nan])))
    row, one = np.zeros(1, dtype=np.int64), material_hypotheses(gripper, ["brass"])
    usual = fit_pairs(gripper, data, row, one)
    start = prior_of(gripper, data, one).mean
    start[:, 3] = start[:, 4] = data.level
    found = fit_pairs(gripper, data, row, one, start=start)
    assert found.converged.all()
    np.testing.assert_allclose(found.u, usual.u, atol=0.02)
    assert found.log_evidence[0] == pytest.approx(usual.log_evidence[0], abs=5e-3)
