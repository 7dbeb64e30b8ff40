"""Physics features say what the touch was, whatever the temperatures and the onset."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from thermogrip.classify import extract_features
from thermogrip.classify.estimators.features import feature_noise
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps, make_grasps

T = np.arange(-2.0, 10.05, 0.1)


def rise(
    *, onset: float = 0.0, tau: float = 1.0, share: float = 0.5, level: float = 23.0, t_object: float = 43.0
) -> np.ndarray:
    return level + (t_object - level) * share * -np.expm1(-np.maximum(T - onset, 0) / tau)


def test_an_exponential_rise_is_read_as_what_it_is() -> None:
    f = extract_features(make_grasps(T, [rise(onset=0.1, tau=0.8)], ["g"], t_object=[43.0])).sel(grasp="g")
    assert float(f.sel(feature="onset")) == pytest.approx(0.1, abs=0.03)
    assert float(f.sel(feature="fitted_rise")) == pytest.approx(0.5, abs=0.01)
    assert float(f.sel(feature="log_time_constant")) == pytest.approx(np.log(0.8), abs=0.15)
    for t in (0.5, 1.0, 2.0, 5.0):
        expected = 0.5 * -np.expm1(-t / 0.8)
        assert float(f.sel(feature=f"response_{t:g}s")) == pytest.approx(expected, abs=0.02)
    assert float(f.sel(feature="late_slope")) == pytest.approx(0.0, abs=1e-3)
    assert float(f.sel(feature="level")) == 23.0


def test_normalised_features_do_not_depend_on_the_temperatures() -> None:
    traces = [rise(), rise(level=38.0), rise(level=48.0, t_object=28.0)]
    g = make_grasps(T, traces, ["a", "b", "c"], t_object=[43.0, 43.0, 28.0])
    f = extract_features(g)
    names = [n for n in f["feature"].values if str(n).startswith(("response", "fitted", "initial", "late"))]
    spread = f.sel(feature=names).values.std(axis=0)
    assert spread.max() < 5e-3
    level = extract_features(make_grasps(T, [rise(), rise(t_object=23.2)], ["a", "b"], t_object=[43.0, 23.2]))
    np.testing.assert_allclose(level.sel(feature="response_5s"), [0.5, np.nan], atol=0.02)  # b alone is lost
    assert set(f["unit"].values) >= {"1", "1/s"}


@pytest.mark.parametrize("onset", [-0.2, -0.1, 0.1, 0.2])
def test_onset_jitter_moves_features_far_less_than_fixed_times_would(onset: float) -> None:
    at = lambda t0: make_grasps(T, [rise(onset=t0)], ["g"], t_object=[43.0])  # noqa: E731
    names = ["response_0.5s", "response_1s", "response_2s"]
    moved = (
        extract_features(at(onset)).sel(feature=names).values
        - extract_features(at(0.0)).sel(feature=names).values
    )
    fixed = [np.interp(t, T, rise(onset=onset)) - np.interp(t, T, rise()) for t in (0.5, 1.0, 2.0)]
    assert np.abs(moved).max() < 0.25 * np.abs(np.array(fixed) / 20).max()


@pytest.mark.parametrize("tau", [0.5, 0.8])
@pytest.mark.parametrize("onset", [-0.2, 0.0, 0.2])
def test_the_onset_is_read_from_the_first_samples_of_the_rise(onset: float, tau: float) -> None:
    found = extract_features(make_grasps(T, [rise(onset=onset, tau=tau)], ["g"], t_object=[43.0]))
    assert float(found.sel(feature="onset").values[0]) == pytest.approx(onset, abs=0.01)


def test_an_unknown_object_temperature_leaves_kelvin() -> None:
    unknown = extract_features(make_grasps(T, [rise()], ["g"]))
    known = extract_features(make_grasps(T, [rise()], ["g"], t_object=[43.0]))
    np.testing.assert_allclose(
        unknown.sel(feature="response_2s").values, 20 * known.sel(feature="response_2s").values, rtol=1e-9
    )
    assert "K" in set(unknown["unit"].values)
    forced = extract_features(make_grasps(T, [rise()], ["g"]), normalise=True)
    assert np.isnan(forced.sel(feature="response_2s").values).all()


def test_equal_temperatures_are_not_divided_by() -> None:
    quiet = 28 + 0.03 * np.random.default_rng(0).standard_normal((5, T.size))
    f = extract_features(make_grasps(T, quiet, list("abcde"), t_object=[28.0] * 5))
    assert np.isfinite(f.values).all()
    assert "K" in set(f["unit"].values)
    assert np.abs(f.sel(feature="response_5s").values).max() < 0.1
    assert np.abs(f.sel(feature="onset").values).max() < 0.25


def test_noise_of_features_is_what_noise_of_samples_makes_of_them() -> None:
    names = ["response_0.5s", "response_2s", "response_10s", "fitted_rise", "late_slope"]
    quiet = 28 + 0.03 * np.random.default_rng(0).standard_normal((800, T.size))
    g = make_grasps(T, quiet, [str(i) for i in range(800)])
    scatter = np.cov(extract_features(g).sel(feature=names).values.T)
    stated = feature_noise(g, names).mean(axis=0)
    sd = np.sqrt(np.diag(scatter))
    np.testing.assert_allclose(np.sqrt(np.diag(stated)), sd, rtol=0.15)  # a median is not quite Gaussian
    np.testing.assert_allclose(stated / np.outer(sd, sd), scatter / np.outer(sd, sd), atol=0.2)


def test_what_a_short_trace_did_not_reach_is_nan() -> None:
    g = make_grasps(T[T < 3], [rise()[T < 3]], ["g"], t_object=[43.0])
    f = extract_features(g, times=(1.0, 2.0, 5.0))
    assert np.isfinite(f.sel(feature=["response_1s", "response_2s"]).values).all()
    assert np.isnan(f.sel(feature=["response_5s", "late_slope"]).values).all()


def test_lost_samples_are_bridged(make_touches: Callable[..., Grasps]) -> None:
    whole = make_touches(noise=0.0)
    holed = whole.copy(deep=True)
    holed["t_surface"].values[:, 15::6] = np.nan
    a, b = extract_features(whole), extract_features(holed)
    names = ["response_2s", "response_5s", "fitted_rise"]
    assert np.abs(a.sel(feature=names).values - b.sel(feature=names).values).max() < 0.02


def test_a_trace_without_a_start_is_refused() -> None:
    late = rise()
    late[T < 1] = np.nan
    with pytest.raises(UserError, match="'g' has no sample before contact"):
        extract_features(make_grasps(T, [late], ["g"]))
