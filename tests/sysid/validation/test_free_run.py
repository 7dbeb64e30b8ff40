"""Free run and its baselines: scipy's filter, the gap rule, false alarms at the stated rate, equal scores."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.log_files import read_log, write_log
from thermogrip.datasets.schema import make_log
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.fit_record import fit_logs
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.validation.free_run import free_run, no_input_baseline, score
from thermogrip.sysid.validation.residual_tests import Correlation, autocorrelation, cross_correlation


def lag_plant(pole: float = 0.95, gain: float = 0.5) -> Plant:
    model = StateSpaceModel(("q",), (), ("t",), A=[[pole]], B=[[gain]], C=[[1.0]], dt=1.0, spread=[[4.0]])
    return Plant(model, {}, dt=1.0, noise={"t": 0.01}, valid={"q": (0.0, 1.0)})


def lag_log(n: int = 1000, *, noise: float = 0.0, seed: int = 0):
    rng = np.random.default_rng(seed)
    q = np.repeat(rng.random(n // 20), 20)
    t = lfilter([0, 0.5], [1, -0.95], q) + noise * rng.standard_normal(n)
    return make_log(np.arange(float(n)), {"q": (q, "1", "input"), "t": (t, "degC", "output")})


def test_a_free_run_is_scipys_filter():
    log = lag_log()
    run = free_run(lag_plant(), log)
    want = lfilter([0, 0.5], [1, -0.95], log["q"].values)
    np.testing.assert_allclose(run.log["t"].values[5:], want[5:], atol=2e-3)
    assert run.scores["t"].n == 995
    assert run.scores["t"].fit_percent > 99.9


def test_the_rmse_of_the_true_plant_is_the_noise():
    run = free_run(lag_plant(), lag_log(4000, noise=0.1, seed=1))
    # sd of a sample standard deviation: 0.1 / sqrt(2 n)
    assert run.scores["t"].rmse == pytest.approx(0.1, abs=4 * 0.1 / np.sqrt(2 * 3995) + 0.002)
    assert run.whiteness["t"].independent
    assert run.no_better == ()


def test_readings_after_the_warmup_do_not_change_the_free_run():
    log, spoilt = lag_log(), lag_log()
    spoilt["t"].values[5:] += 30.0
    runs = [free_run(lag_plant(), each, warmup=4.0, score_from=5.0).log["t"].values for each in (log, spoilt)]
    np.testing.assert_array_equal(*runs)


def test_one_step_flatters_a_wrong_model_and_free_run_does_not():
    run = free_run(lag_plant(gain=0.1), lag_log(noise=0.0))
    assert run.one_step["t"].rmse < 0.1 * run.scores["t"].rmse
    assert any("correlates with q" in note for note in run.notes)


def test_a_model_that_ignores_its_input_is_no_better_than_the_no_input_baseline():
    run = free_run(lag_plant(gain=0.0), lag_log())
    assert run.no_better == ("t",)
    assert any("without input" in note for note in run.notes)


def test_the_no_input_baseline_is_never_worse_than_the_mean_and_exact_for_a_decay():
    time = np.arange(500.0)
    y = 20 + 15 * np.exp(-time / 40)
    assert np.sqrt(np.mean((no_input_baseline(time, y) - y) ** 2)) < np.std(y)
    rng = np.random.default_rng(0)
    for _ in range(10):
        y = rng.standard_normal(200).cumsum()
        assert np.mean((no_input_baseline(np.arange(200.0), y) - y) ** 2) <= np.var(y) + 1e-12


def test_after_a_gap_sixty_seconds_are_not_scored_and_holding_stands_beside():
    log = lag_log(1000)
    keep = np.r_[0:400, 440:1000]
    run = free_run(lag_plant(), log.isel(time=keep))
    scored = run.log["scored"].values
    time = run.log["time"].values
    assert not scored[(time >= 440) & (time < 500)].any()
    assert scored[time >= 500].all()
    assert run.held["t"].rmse >= 0
    assert any("399 to 440 s" in note for note in run.notes)


def test_a_log_whose_start_was_cut_off_says_that_its_state_is_guessed():
    log = lag_log()
    late = log.isel(time=slice(300, None))
    assert any("starts at 300 s" in note for note in free_run(lag_plant(), late).notes)
    assert not any("starts at" in note for note in free_run(lag_plant(), log).notes)


def test_averages_score_block_means():
    log = lag_log(2000, noise=0.3, seed=2)
    plain, mean = (free_run(lag_plant(), log, average=a).scores["t"] for a in (None, 10.0))
    assert mean.n == pytest.approx(plain.n / 10, abs=1)
    assert mean.rmse == pytest.approx(plain.rmse / np.sqrt(10), rel=0.15)


def test_inputs_outside_of_the_fit_are_noted():
    log = lag_log()
    log["q"].values[500:] += 5.0
    assert any("lies outside" in note for note in free_run(lag_plant(), log).notes)


@pytest.mark.parametrize(
    ("validated", "says"),
    [
        ("copy.csv", "all of it is in the fit (as log@:500): "),
        ("log.csv", "0 to 499 s of 0 to 999 s are in the fit (as log@:500): there "),
        ("log.csv@200:800", "200 to 499 s of 200 to 799 s are in the fit (as log@:500): there "),
        ("log.csv@500:", None),
        ("other.csv", None),
    ],
)
def test_a_log_of_the_fit_is_known_by_its_data(tmp_path, validated, says):
    write_log(lag_log(noise=0.02), tmp_path / "log.csv")
    (tmp_path / "copy.csv").write_bytes((tmp_path / "log.csv").read_bytes())
    write_log(lag_log(noise=0.02, seed=1), tmp_path / "other.csv")
    plant = replace(lag_plant(), fitted_to=fit_logs([read_log(f"{tmp_path}/log.csv@:500")]))
    plant = Plant.load(plant.save(tmp_path / "plant.json"))
    cut = "@:500" if validated == "copy.csv" else ""
    notes = free_run(plant, read_log(f"{tmp_path}/{validated}{cut}"), tests=False).notes
    found = [note for note in notes if "in the fit" in note]
    assert [note.startswith(str(says)) for note in found] == ([] if says is None else [True])


def test_a_plant_file_of_version_0_1_0_knows_no_data_of_its_fit(tmp_path):
    content = lag_plant().to_dict()
    del content["fitted_to"]
    plant = Plant.from_dict(content)
    assert plant.fitted_to == ()
    assert not any("in the fit:" in note for note in free_run(plant, lag_log(), tests=False).notes)


@pytest.mark.parametrize("n_lags", [20, 40])
def test_whiteness_bands_alarm_for_five_percent_of_the_lags_of_white_noise(n_lags):
    rng = np.random.default_rng(4)
    runs = [autocorrelation(rng.standard_normal(1000), n_lags) for _ in range(200)]
    outside = sum(round(run.share_outside * n_lags) for run in runs)
    low, high = binom.ppf([0.0005, 0.9995], 200 * n_lags, 0.05)
    assert low <= outside <= high
    assert np.mean([run.independent for run in runs]) > 0.95


def test_correlations_are_the_sums_over_the_known_pairs():
    rng = np.random.default_rng(4)
    e, u = rng.standard_normal(37), rng.standard_normal(37)
    e[[5, 6, 20]] = np.nan
    known = np.isfinite(e)
    a, b = (np.where(known, x - x[known].mean(), 0.0) for x in (e, u))
    auto, cross = autocorrelation(e), cross_correlation(e, u)
    assert auto.lags.tolist() == list(range(1, 10))  # a quarter of the record at most
    assert cross.lags.tolist() == list(range(10))
    np.testing.assert_allclose(auto.values, [a[k:] @ a[:-k] / (a @ a) for k in range(1, 10)], atol=1e-12)
    want = [a[k:] @ b[: 37 - k] / np.sqrt((a @ a) * (b @ b)) for k in range(10)]
    np.testing.assert_allclose(cross.values, want, atol=1e-12)
    assert auto.band == pytest.approx(1.96 / np.sqrt(34))


def test_a_residual_that_comes_three_samples_after_the_input_stands_out_at_lag_three():
    u = np.random.default_rng(5).standard_normal(4000)
    late = cross_correlation(np.roll(u, 3), u, 10)
    assert late.values[3] == pytest.approx(1.0, abs=0.01)
    assert np.abs(np.delete(late.values, 3)).max() < 4 / np.sqrt(4000)
    assert cross_correlation(np.roll(u, -3), u, 10).independent  # it cannot come before


def test_the_band_of_two_slow_sequences_is_bartletts():
    # of two AR(1) with a = 0.8 and b = 0.9 the sum of a^|j| b^|j| is (1 + ab) / (1 - ab); twenty thousand
    # samples leave each correlation uncertain by 0.015 and 0.022, and the band by about 3 %
    n, rng = 20_000, np.random.default_rng(6)
    e, u = (lfilter([1.0], [1.0, -a], rng.standard_normal(n)) for a in (0.8, 0.9))
    assert cross_correlation(e, u).band == pytest.approx(1.96 * np.sqrt(1.72 / 0.28 / n), rel=0.08)


@pytest.mark.parametrize(("outside", "independent"), [(0, True), (5, True), (6, False)])
def test_of_forty_lags_five_may_lie_outside_of_the_band(outside: int, independent: bool):
    # 2 are expected; 99 % of a binomial ends at 2 + 2.33 * sqrt(40 * 0.05 * 0.95) + 0.5 = 5.7
    values = np.where(np.arange(50) < outside, -0.2, 0.05)
    values[40:] = np.nan
    run = Correlation(np.arange(50.0), values, 0.1)
    assert run.independent == independent
    assert run.share_outside == outside / 40


def test_scores_by_hand():
    found = score(np.array([1.0, 2.0, 3.0]), np.array([1.0, 2.0, 6.0]))
    assert found.rmse == pytest.approx(np.sqrt(3))
    assert found.fit_percent == pytest.approx(100 * (1 - 3 / np.sqrt(2)))
    assert np.isinf(score(np.array([1.0, 2.0]), np.array([1.0, np.inf])).rmse)


def test_what_cannot_be_scored_is_refused():
    with pytest.raises(UserError, match="nothing is left"):
        score(np.array([np.nan]), np.array([1.0]))
    with pytest.raises(UserError, match="no such column"):
        free_run(lag_plant(), lag_log().drop_vars("q"))
    with pytest.raises(UserError, match="would score readings of the"):
        free_run(lag_plant(), lag_log(), warmup=50.0)


def test_an_input_that_stands_still_correlates_with_nothing():
    log = lag_log(noise=0.01)
    still = make_log(
        log["time"].values,
        {"q": (np.full(1000, 0.3), "1", "input"), "t": (log["t"].values, "degC", "output")},
    )
    run = free_run(lag_plant(), still)
    assert run.input_correlation["t"] == {}
    assert not any("correlates with" in note for note in run.notes)
