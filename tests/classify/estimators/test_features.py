"""Physics features say what the touch was, whatever the temperatures and the onset."""

from __future__ import annotations

import numpy as np
import pytest

from thermogrip.classify.estimators.features import feature_noise, linear_features
from thermogrip.datasets.schema import make_grasps

T = np.arange(-2.0, 10.05, 0.1)


STEADY = np.arange(-2.5, 11.1, 0.25)  # exact in binary: samples lie on the limits at -0.5, 5 and 10 s


@pytest.mark.parametrize("end", [10.0, 9.6])
def test_linear_features_of_a_parabola_are_its_local_lines(end: float) -> None:
    """A line through the samples about a time is off a parabola by its curvature only."""
    time = np.arange(-2.0, 10.01, 0.1)
    after = np.maximum(time, 0)
    rise = np.where(time <= end + 1e-9, 3 * after - 0.1 * after**2, np.nan)
    grasps = make_grasps(time, [20 + rise, 20 + 2 * rise], ["a", "b"])
    found = linear_features(grasps, [0.5, 2.0, 5.0, end, 1.021 * end])
    names = ["change_0.5s", "change_2s", "change_5s", f"change_{end:g}s", f"change_{1.021 * end:g}s"]
    assert found["feature"].values.tolist() == [*names, "late_slope"]
    x = found.values
    np.testing.assert_allclose(x[1, :4], 2 * x[0, :4])
    assert np.isnan(x[:, 4]).all()
    assert np.isfinite(linear_features(grasps, [1.019 * end]).values[:, 0]).all()
    for k, (t, half) in enumerate([(0.5, 0.3), (2.0, 0.4), (5.0, 1.0)]):
        near = time[np.abs(time - t) < half + 0.01]
        assert x[0, k] == pytest.approx(3 * t - 0.1 * t**2 - 0.1 * np.mean((near - t) ** 2), abs=1e-9)
    last = time[(time > end - 0.2 * end - 0.01) & (time < end + 0.01)]
    line = np.polyfit(last, 3 * last - 0.1 * last**2, 1)
    assert x[0, 3] == pytest.approx(np.polyval(line, end), abs=1e-9)
    if end < 9.8:  # the mean slope until 9.6 s is another number
        assert np.isnan(x[:, 5]).all()
        return
    late = time[(time > 4.99) & (time < end + 0.01)]
    assert x[0, 5] == pytest.approx(3 - 0.2 * late.mean(), abs=1e-9)


def test_the_noise_of_linear_features_is_that_of_their_sums() -> None:
    rng = np.random.default_rng(1)
    time = np.arange(-2.0, 10.01, 0.1)
    grasps = make_grasps(
        time, 20 + 0.05 * rng.standard_normal((3000, time.size)), [str(k) for k in range(3000)]
    )
    names = ["change_0.5s", "change_2s", "change_10s", "late_slope"]
    found = linear_features(grasps, [0.5, 2.0, 10.0]).values
    expected = feature_noise(grasps, names).mean(axis=0)
    sd = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(np.cov(found.T) / np.outer(sd, sd), expected / np.outer(sd, sd), atol=0.06)


def test_noise_is_read_from_second_differences_and_is_at_least_10_mK() -> None:
    """Of straight lines there is none, however steep; the level's error shifts all changes alike."""
    time = np.arange(-2.0, 10.01, 0.1)
    names = ["change_2s", "change_10s"]
    steep = make_grasps(time, [20 + 0.3 * time], ["g"])
    noisy = make_grasps(time, [20 + 0.1 * np.random.default_rng(2).standard_normal(time.size)], ["g"])
    least, more = (feature_noise(grasps, names)[0] for grasps in (steep, noisy))
    np.testing.assert_allclose(more / least, np.full((2, 2), more[0, 0] / least[0, 0]))
    assert np.sqrt(more[0, 0] / least[0, 0]) == pytest.approx(10.0, rel=0.3)
    assert least[0, 1] > 0.3 * least[0, 0]
