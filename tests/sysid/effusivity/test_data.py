"""The noise of bin means: its inverse, and the slopes of its likelihood."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import make_grasps
from thermogrip.sysid.effusivity.data import (
    KNOTS,
    Noise,
    at_knots,
    noise_covariance,
    noise_fit,
    object_range,
    stack_touches,
    touches,
    whiten,
    with_object_range,
)

TIME = np.round(np.arange(-2.0, 10.05, 0.1), 1)


def test_whitener_inverts_the_covariance_and_leaves_lost_bins_out():
    y = np.full((2, TIME.size), 30.0)
    y[1, 30:40] = np.nan
    data = touches(make_grasps(TIME, y + 3 * (TIME > 0), ["a", "b"]))
    w, log_det = whiten(data, Noise())
    cov = noise_covariance(data, Noise())
    for i in range(2):
        there = data.count[i] > 0
        part = cov[i][np.ix_(there, there)]
        inverse = (w[i].T @ w[i])[np.ix_(there, there)]
        np.testing.assert_allclose(inverse @ part, np.eye(there.sum()), atol=1e-8)
        assert log_det[i] == pytest.approx(np.linalg.slogdet(2 * np.pi * part)[1])
    assert (data.count[1] == 0).any()


@pytest.mark.parametrize("smooth", [False, True])
def test_slopes_of_the_noise_are_those_of_its_likelihood(smooth):
    """The likelihood put together from the covariance, a sample lost, another uncertain parameter."""
    y = np.random.default_rng(3).normal(0.0, 0.05, (2, TIME.size)) + 3 * (TIME > 0)
    y[1, 30:40] = np.nan
    data = touches(make_grasps(TIME, y, ["a", "b"]))
    there = data.count > 0
    left = np.random.default_rng(4).normal(0.0, 0.1, there.shape) * there
    extra = 0.01 * there[:, :, None] * there[:, None, :]
    q = np.array([*np.log([0.05, 0.02, 3.0, 0.002]), 0.7])

    def cost(q):
        white, slow, memory, misfit = np.exp(q[:4])
        noise = Noise(
            white=white, slow=slow, correlation_time=memory, misfit=misfit, growth=q[4], smooth=smooth
        )
        cov = noise_covariance(data, noise) + extra
        want = sum(r @ np.linalg.solve(c, r) + np.linalg.slogdet(c)[1] for r, c in zip(left, cov))
        return 0.5 * want, noise_fit(data, noise, extra, left)

    want, (value, slopes) = cost(q)
    assert value == pytest.approx(want, rel=1e-10)
    steps = 1e-5 * np.eye(5)
    differences = [(cost(q + s)[0] - cost(q - s)[0]) / 2e-5 for s in steps]
    np.testing.assert_allclose(slopes, differences, rtol=1e-5, atol=1e-4)


def test_averages_are_those_of_samples_between_fixed_times():
    time = np.round(np.arange(-30, 501) / 10, 1)
    skin = 23.0 + np.where(time > 0.05, np.sqrt(np.maximum(time, 0.0)), 0.01 * time)
    grasps = make_grasps(time, [skin, skin], ["a", "b"], t_object=[43.0, np.nan], t_ambient=[21.0, 22.0])
    data = touches(grasps)
    # half seconds before contact, samples about it, then means of 0.25, 0.5, 1.5 and 5 s
    want = [4, *[5] * 4, *[1] * 22, *[3, 2] * 5, *[5] * 12, *[15] * 20, *[50] * 2]
    assert data.count[0].tolist() == pytest.approx(want)
    edges = np.cumsum([0, *want])
    pieces = [slice(a, b) for a, b in pairwise(edges)]
    np.testing.assert_allclose(data.y[1], [skin[at].mean() for at in pieces])
    np.testing.assert_allclose(data.t[1], [time[at].mean() for at in pieces])
    np.testing.assert_allclose(data.ramp[0], [np.maximum(time[at] + 1.0, 0.0).mean() for at in pieces])
    np.testing.assert_array_equal(data.sample_bin[1], np.repeat(np.arange(len(want)), want))
    assert data.level == pytest.approx(skin[time < -0.25].mean())
    assert data.excursion == pytest.approx(data.y[0, -1] - data.level[0])
    assert (data.end, data.t_object[0], data.t_ambient.tolist()) == (50.0, 43.0, [21.0, 22.0])
    short = touches(grasps, until=10.0)
    assert (short.end, short.y.shape[1]) == (10.0, touches(grasps.isel(time=slice(0, 131))).y.shape[1])
    part = data.take(np.array([1]))
    assert (part.grasp_id.tolist(), part.t_ambient.tolist(), part.y.shape) == (["b"], [22.0], (1, len(want)))
    np.testing.assert_array_equal(touches(grasps.isel(time=slice(9, None))).y[0], data.y[0, 2:])


def test_an_excursion_is_that_of_readings_from_0_15_s_on():
    skin = 23.0 + 0.01 * (TIME > 0)
    skin[[5, 21]] += 0.5, -0.4  # long before, and at 0.1 s
    assert touches(make_grasps(TIME, [skin], ["a"])).excursion[0] < 0.1
    skin[22] -= 0.3  # at 0.2 s
    data = touches(make_grasps(TIME, [skin], ["a"]))
    assert data.excursion[0] == pytest.approx(data.level[0] - skin[22])


@pytest.mark.parametrize(
    ("lost", "match"),
    [
        ((0.15, 10.0), "grasp 'b' has no sample after contact"), ((0.25, 10.0), None),
        ((-2.0, -0.15), "grasp 'b' has no sample before contact"), ((-2.0, -0.35), None),
    ],
)  # fmt: skip
def test_a_reading_before_and_one_after_contact_are_needed(lost, match):
    skin = np.where((lost[0] <= TIME) & (lost[1] >= TIME), np.nan, 30.0)
    grasps = make_grasps(TIME, [np.full(TIME.size, 30.0), skin], ["a", "b"])
    if match is None:
        assert touches(grasps).count[1].sum() == np.isfinite(skin).sum()
        return
    with pytest.raises(UserError, match=match):
        touches(grasps)


def test_a_negative_sd_is_refused_with_its_grasp():
    rows = np.full((2, TIME.size), 30.0)
    assert touches(make_grasps(TIME, rows, ["a", "b"], t_object_sd=[0.0, 1.0])).t_object_sd[0] == 0.0
    with pytest.raises(UserError, match="'b' has a negative t_object_sd"):
        touches(make_grasps(TIME, rows, ["a", "b"], t_object_sd=[0.0, -0.1]))


def test_what_an_unknown_object_may_be():
    skin = np.full(TIME.size, 90.0)
    grasps = make_grasps(TIME, [skin] * 2, ["a", "b"], t_ambient=[21.0, np.nan], t_object=[np.nan, 43.0])
    np.testing.assert_allclose(object_range(grasps), [[1.0, 41.0], [2.5, 42.5]])  # of a usual room
    np.testing.assert_array_equal(object_range(grasps, (-60.0, 200.0)), [[-60.0, 200.0]] * 2)
    assert with_object_range(grasps, None) is grasps
    stated = with_object_range(grasps.assign(t_object_sd=("grasp", [np.nan, 0.2])), (10.0, 40.0))
    assert stated["t_object"].values.tolist() == [25.0, 43.0]
    np.testing.assert_allclose(stated["t_object_sd"].values, [30.0 / np.sqrt(12.0), 0.2])
    for wrong in ((-60.1, 20.0), (20.0, 20.0), (20.0, 200.1), (np.nan, 20.0)):
        with pytest.raises(UserError, match=r"an object range of .* to .* degC; give the lower end first"):
            object_range(grasps, wrong)


def test_records_are_stacked_with_lost_samples_and_empty_bins():
    one = touches(make_grasps(TIME, [30.0 + TIME], ["a"], material=["wood"]))
    two = touches(make_grasps(TIME[:60], [[40.0] * 60], ["b"]))
    both = stack_touches([two, one])
    assert (both.grasp_id.tolist(), both.material.tolist()) == (["b", "a"], ["", "wood"])
    np.testing.assert_array_equal(both.y[1], one.y[0])
    n, m = two.y.shape[1], two.sample_t.shape[1]
    assert (both.y[0, n:] == 0).all()
    assert (both.count[0, n:] == 0).all()
    assert (both.sample_bin[0, m:] == -1).all()
    np.testing.assert_array_equal(both.sample_bin[0, :m], two.sample_bin[0])
    assert both.end == 10.0


def test_the_covariance_is_the_sum_of_its_three_parts():
    """Between means at 0, 1 and 10 s of an excursion of 5 K, with lag 1.5 s and growth 2."""
    time = np.array([-1.0, -0.9, -0.5, 0.0, 1.0, 10.0])
    data = touches(make_grasps(time, [[23.0, 23.0, 23.0, 23.0, 25.0, 28.0]], ["a"]))
    cov = noise_covariance(data, Noise(white=0.1, slow=0.2, correlation_time=1.5, misfit=0.03, growth=2.0))[0]
    assert data.count[0].tolist() == [2, 1, 1, 1, 1]
    at_1, at_10 = 0.03 * 5 * 1.1**2, 0.03 * 5 * 2.0**2
    alike = (1 + 1 / 0.3) / (1 + 10 / 0.3)  # exp(-|du|)
    want = {
        (0, 0): 0.04 + 0.01 / 2, (2, 2): 0.04 + 0.01, (0, 2): 0.04 * np.exp(-0.95 / 1.5),
        (2, 3): 0.04 * np.exp(-1 / 1.5), (3, 3): 0.05 + at_1**2, (4, 4): 0.05 + at_10**2,
        (3, 4): 0.04 * np.exp(-9 / 1.5) + at_1 * at_10 * alike,
    }  # fmt: skip
    for (i, k), value in want.items():
        assert cov[i, k] == pytest.approx(value, rel=1e-9)
        assert cov[k, i] == pytest.approx(value, rel=1e-9)


def test_a_smooth_noise_has_a_slope_and_its_scale():
    near, far = Noise(smooth=True).correlation(np.array([1e-3, 1.0]))
    assert 1 - near < 2e-6 < 1 - Noise().correlation(np.array(1e-3))  # of second order, of first
    assert far == pytest.approx((1 + 3**0.5) * np.exp(-(3**0.5)))


def test_a_second_sensor_is_binned_as_the_first_and_goes_along():
    one = np.stack([20.0 + k + 3 * (TIME > 0) for k in range(3)])
    both = make_grasps(TIME, one, ["a", "b", "c"], t_surface_2=one[::-1])
    data = touches(both)
    np.testing.assert_array_equal(data.second.y, data.y[::-1])
    np.testing.assert_array_equal(data.take(np.array([2])).second.y, data.y[:1])
    two = stack_touches([data, data])
    np.testing.assert_array_equal(two.second.y, np.concatenate([data.y[::-1]] * 2))
    assert stack_touches([data, touches(both.drop_vars("t_surface_2"))]).second is None


def test_weights_of_the_knots_are_straight_lines_between_them():
    t = np.array([-2.0, -1.5, -1.25, 0.0, 0.15, 41.0])
    np.testing.assert_allclose(at_knots(t) @ KNOTS, [0.0, 0.0, -0.5, 0.0, 0.15, 40.0])
    np.testing.assert_allclose(at_knots(t).sum(axis=1), [0.0, 0.0, 0.5, 1.0, 1.0, 1.0])
