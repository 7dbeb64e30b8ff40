"""Physics features say what the touch was, whatever the temperatures and the onset."""

from __future__ import annotations

import numpy as np
import pytest

from thermogrip.classify import extract_features
from thermogrip.classify.estimators.features import (
    _slope,
    can_normalise,
    feature_noise,
    linear_features,
)
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import make_grasps

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


STEADY = np.arange(-2.5, 11.1, 0.25)  # exact in binary: samples lie on the limits at -0.5, 5 and 10 s


def rough() -> np.ndarray:
    """A noisy rise, one that is lost before -2 s, at 3 s and from 8.75 s on, a fall that ends at 4.75 s."""
    noise = 0.05 * np.random.default_rng(3).standard_normal((3, STEADY.size))
    tau, onset, size = (
        np.array([[0.4], [1.1], [0.7]]),
        np.array([[0.1], [-0.2], [0.3]]),
        [[8.0], [3.0], [-5.0]],
    )
    rows = 23.5 + 0.02 * STEADY - size * np.expm1(-np.maximum(STEADY - onset, 0) / tau) + noise
    rows[1, (STEADY < -2) | (STEADY == 3) | (STEADY >= 8.75)] = np.nan
    rows[2, STEADY > 4.75] = np.nan
    return rows


def plain_features(row: np.ndarray, at: tuple[float, ...]) -> dict[str, float]:
    """The features of a grasp in kelvin, one least-squares fit after another."""
    base = np.nanmedian(row[STEADY <= -0.5])
    ok = np.isfinite(row)
    own = (STEADY[ok][0] <= STEADY) & (STEADY[ok][-1] >= STEADY)
    t, y = STEADY[own], np.interp(STEADY[own], STEADY[ok], row[ok]) - base
    used = (t > -0.5) & (t <= 10)
    fits = []
    for onset in np.linspace(-0.4, 0.4, 21):
        for tau in 0.15 * 20 ** (np.arange(14) / 13):
            s = np.maximum(t - onset, 0)
            shapes = 1 - np.exp(-np.column_stack([s / tau, s / 6]))
            ridge = np.vstack([shapes[used], 1e-3 * np.eye(2)])
            target = np.append(y[used], [0, 0])
            size = np.linalg.lstsq(ridge, target, rcond=None)[0]
            loss = np.sum((ridge @ size - target) ** 2)
            slope = size @ [1 / tau, 1 / 6]
            fits.append([loss, onset, np.log(tau), size.sum(), slope, *(shapes @ size)])
    loss, onset = np.array(fits)[:, :2].T
    variance = max(loss.min() / max(used.sum(), 5), 0.03**2)
    weight = np.exp(-0.5 * (loss - loss.min()) / variance - 0.5 * (onset / 0.15) ** 2)
    _, start, log_tau, size, slope, *curve = weight @ np.array(fits) / weight.sum()
    early, late = t <= -0.5, (t >= 5) & (t <= 10)
    found = {
        "level": base,
        "level_drift": np.polyfit(t[early], y[early], 1)[0],
        "onset": start,
        "initial_slope": slope,
        "fitted_rise": size if t[-1] >= 5 else np.nan,
        "log_time_constant": log_tau if t[-1] >= 5 else np.nan,
        "late_slope": np.polyfit(t[late], y[late], 1)[0] if t[-1] >= 9 else np.nan,
    }
    for after in at:
        when = min(start + after, t[-1])
        near = np.abs(t - when) <= 0.3
        read = np.interp(when, t, curve) + (y - curve)[near].mean()
        found[f"response_{after:g}s"] = read if start + after <= t[-1] + 0.6 else np.nan
    return found


def test_features_are_those_of_fits_made_one_by_one() -> None:
    rows, at = rough(), (0.5, 2.0, 5.0, 8.0, 9.1, 9.6)
    g = make_grasps(STEADY, rows, list("abc"), t_object=[43.0, np.nan, 11.0])
    kelvin, ratio = (extract_features(g, times=at, normalise=how) for how in (False, None))
    gap = [43.0 - float(kelvin[0, 0]), np.nan, 11.0 - float(kelvin[2, 0])]
    for k, row in enumerate(rows):
        expected = plain_features(row, at)
        names = list(expected)
        np.testing.assert_allclose(kelvin[k].sel(feature=names), list(expected.values()), rtol=1e-6)
        over = [1 if n in ("level", "level_drift", "onset", "log_time_constant") else gap[k] for n in names]
        expected_ratio = np.array(list(expected.values())) / over
        np.testing.assert_allclose(ratio[k].sel(feature=names), expected_ratio, rtol=1e-6)
    lost = {"response_9.1s": 1, "response_9.6s": 2, "response_8s": 1, "response_5s": 0, "fitted_rise": 1}
    assert {name: int(np.isnan(kelvin.sel(feature=name)).sum()) for name in lost} == lost
    units = ["degC", "K/s", "s", "K/s", *["K"] * 6, "K", "ln s", "K/s"]
    assert kelvin["unit"].values.tolist() == units
    assert ratio["unit"].values.tolist() == [*units[:3], "1/s", *["1"] * 7, "ln s", "1/s"]


@pytest.mark.parametrize(
    ("end", "known"),
    [
        (4.94, [0.5, 1, 2]),
        (4.95, [0.5, 1, 2, 5]),
        (9.95, [0.5, 1, 2, 5, 10]),
        (40.0, [0.5, 1, 2, 5, 10, 20, 40]),
    ],
)
def test_responses_are_read_up_to_the_end_of_the_record(end: float, known: list[float]) -> None:
    t = np.append(np.arange(-1.0, end - 0.5, 0.5), end)
    names = extract_features(make_grasps(t, [np.ones(t.size)], ["g"]))["feature"].values
    assert [n for n in names if n.startswith("response")] == [f"response_{x:g}s" for x in known]


@pytest.mark.parametrize(("end", "known"), [(5.0, True), (4.75, False)])
def test_a_rise_is_known_from_5_seconds_on(end: float, known: bool) -> None:
    t = STEADY[end >= STEADY]
    f = extract_features(make_grasps(t, [23 + np.maximum(t, 0)], ["g"]))
    assert np.isfinite(f.sel(feature=["fitted_rise", "log_time_constant"])).values.tolist() == [[known] * 2]


@pytest.mark.parametrize(
    ("difference", "divides"), [(1.0, True), (-1.0, True), (0.99, False), (-0.99, False)]
)
def test_a_response_is_divided_by_1_kelvin_or_more(difference: float, divides: bool) -> None:
    t_object = [23.0 + difference, np.nan]
    g = make_grasps(STEADY, 23 + np.maximum(STEADY, 0) * [[0.5], [0.5]], list("ab"), t_object=t_object)
    assert can_normalise(g) is divides
    known = np.isfinite(extract_features(g, normalise=True).sel(feature="fitted_rise")).values
    assert known.tolist() == [divides, False]


@pytest.mark.parametrize(
    ("start", "stop", "end", "expected"),
    [
        (-np.inf, -0.5, 9, 11.2),  # 1, 0, 4, 9 at -3, -1, 1, 3 times 0.125 s: (28 * 0.125) / (20 * 0.125^2)
        (-1.0, -0.5, 9, 18.0),  # both limits are in: 0, 4, 9
        (-0.75, -0.5, 9, np.nan),  # two samples
        (-1.25, 0.75, 3, np.nan),  # read up to -0.5 s, more than 1 s before the stop
        (-1.25, 0.5, 3, 11.2),  # no more than 1 s
    ],
)
def test_a_slope_is_that_of_least_squares_between_its_limits(
    start: float, stop: float, end: int, expected: float
) -> None:
    t, row = np.array([-1.25, -1.0, -0.75, -0.5, 0.25, 0.5]), np.array([[1.0, 0, 4, 9, 7, 7]])
    seen = (np.arange(6) <= end).astype(float)[None, :]
    assert _slope(t, row, seen, start, stop)[0] == pytest.approx(expected, nan_ok=True)


def test_noise_is_read_from_second_differences_and_is_at_least_10_mK() -> None:
    wave = 0.05 * (-1.0) ** np.arange(STEADY.size)
    jump = 4.0 * (STEADY > 1.0) + 9.0 * (STEADY == 1.0)
    names = ["late_slope", "log_time_constant", "fitted_rise"]
    half_lost = np.where(np.arange(STEADY.size) % 2, np.nan, 23.0)
    g = make_grasps(STEADY, [wave + 23 + jump, jump + 23 + wave / 100, half_lost, wave + 23], list("abcd"))
    noise = feature_noise(g, names)
    sd = np.array([0.2 / (0.6745 * np.sqrt(6)), 0.01, 0.01, 0.2 / (0.6745 * np.sqrt(6))])
    late = np.arange(-10, 11) * 0.25  # s, about 7.5 s
    np.testing.assert_allclose(noise[:, 0, 0], sd**2 / np.sum(late**2), rtol=1e-6)
    of_rise = np.sqrt(noise[:, 2, 2])
    np.testing.assert_allclose(of_rise / of_rise[1], sd / 0.01)
    np.testing.assert_allclose(np.sqrt(noise[:2, 1, 1]), of_rise[:2] / 4, rtol=0.05)  # at 4 K from 1 s on
    assert noise[2:, 1, 1].tolist() == [1.0, 1.0]  # of nothing, all is noise


def test_noise_of_the_level_shifts_what_comes_after() -> None:
    """A median of n samples has pi / 2 n of the variance of one; 3 samples are read where fewer lead."""
    names = ["response_5s", "fitted_rise"]
    after = STEADY[STEADY > -0.5]
    variance, pulse = [], 1e-3 * (STEADY > -0.5)
    for count in (1, 5, 17):
        t = np.append(-0.5 - 0.25 * np.arange(count)[::-1], after)
        variance.append(feature_noise(make_grasps(t, [np.full(t.size, 23.0)], ["g"]), names)[0] / 1e-4)
    shift = (
        extract_features(make_grasps(STEADY, [pulse], ["g"]), times=(5.0,)).sel(feature=names).values[0]
        / 1e-3
    )
    for one, other, share in ((0, 1, 1 / 3 - 1 / 5), (1, 2, 1 / 5 - 1 / 17)):
        expected = np.pi / 2 * share * np.outer(shift, shift)
        np.testing.assert_allclose(variance[one] - variance[other], expected, rtol=1e-3)


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


def test_without_an_object_temperature_nothing_can_be_divided() -> None:
    unknown = make_grasps(T, [rise()], ["g"])
    assert np.isnan(extract_features(unknown, normalise=True).sel(feature="response_2s").values).all()
    assert "K" in extract_features(unknown)["unit"].values


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


def test_a_trace_without_a_start_is_refused() -> None:
    late = rise()
    late[T < 1] = np.nan
    with pytest.raises(UserError, match="'g' has no sample before contact"):
        extract_features(make_grasps(T, [late], ["g"]))


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
