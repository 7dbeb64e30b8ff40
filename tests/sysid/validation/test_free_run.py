"""Free run and its baselines: scipy's filter, the gap rule, false alarms at the stated rate, equal scores."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.log_files import read_log, write_log
from thermogrip.datasets.schema import make_log
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.plant.plant_data import fit_logs
from thermogrip.sysid.validation import free_run as module
from thermogrip.sysid.validation.free_run import free_run, no_input_baseline, score
from thermogrip.sysid.validation.residual_tests import CorrelationTest, ResidualCorrelations


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
    assert run.no_better == ()


def test_a_run_to_infinity_scores_infinity_in_one_step_too_and_warns_of_nothing():
    again = free_run(lag_plant(pole=3.0), lag_log(noise=0.1), tests=False)
    assert (again.scores["t"].rmse, again.one_step["t"].rmse) == (np.inf, np.inf)
    assert again.no_better == ("t",)


def test_readings_after_the_warmup_do_not_change_the_free_run():
    log, spoilt = lag_log(), lag_log()
    spoilt["t"].values[5:] += 30.0
    runs = [free_run(lag_plant(), each, warmup=4.0, score_from=5.0).log["t"].values for each in (log, spoilt)]
    np.testing.assert_array_equal(*runs)


def test_one_step_flatters_a_wrong_model_and_free_run_does_not():
    run = free_run(lag_plant(gain=0.1), lag_log(noise=0.0))
    assert run.one_step["t"].rmse < 0.1 * run.scores["t"].rmse
    assert any("correlates with q" in note for note in run.notes)


def test_after_a_gap_sixty_seconds_are_not_scored():
    log = lag_log(1000)
    keep = np.r_[0:400, 440:1000]
    run = free_run(lag_plant(), log.isel(time=keep))
    scored = run.log["scored"].values
    time = run.log["time"].values
    assert not scored[(time >= 440) & (time < 500)].any()
    assert scored[time >= 500].all()
    assert any("399 to 440 s" in note for note in run.notes)


def test_the_score_with_the_last_row_held_stands_beside_that_of_a_run_with_a_gap():
    log = lag_log(1000)
    steady, stepped = log.copy(deep=True), log.copy(deep=True)
    for each, q_in_gap in ((steady, 1.0), (stepped, 5.0)):
        q = log["q"].values.copy()
        q[395:441], q[400:440] = 1.0, q_in_gap
        t = lfilter([0, 0.5], [1, -0.95], q)
        each["q"], each["t"] = ("time", q, log["q"].attrs), ("time", t, log["t"].attrs)
    keep = np.r_[0:400, 440:1000]
    known, unknown = (free_run(lag_plant(), each.isel(time=keep)) for each in (steady, stepped))
    assert known.held["t"].rmse < 1e-5  # what was held is what was there
    assert unknown.held["t"].rmse > 0.01
    assert any(f"RMSE t {unknown.held['t'].rmse:.3g} degC" in note for note in unknown.notes)
    assert free_run(lag_plant(), log).held == {}


def test_averages_score_means():
    log = lag_log(2000, noise=0.3, seed=2)
    plain, mean = (free_run(lag_plant(), log, average=seconds).scores["t"] for seconds in (None, 10.0))
    assert mean.n == pytest.approx(plain.n / 10, abs=1)
    assert mean.rmse == pytest.approx(plain.rmse / np.sqrt(10), rel=0.15)


def test_inputs_outside_of_the_fit_are_noted():
    log = lag_log()
    log["q"].values[500:] += 5.0
    assert any("lies outside" in note for note in free_run(lag_plant(), log).notes)
    narrow = replace(lag_plant(gain=0.7), valid={"q": (0.0, 1.0), "t": (0.0, 0.1)})
    said = [note for note in free_run(narrow, log).notes if "correlates with q" in note]
    assert len(said) == 1
    assert "the fit has not seen q as here" in said[0]


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


def test_what_cannot_be_scored_is_refused():
    with pytest.raises(UserError, match="nothing is left"):
        score(np.array([np.nan]), np.array([1.0]))
    with pytest.raises(UserError, match="no such column"):
        free_run(lag_plant(), lag_log().drop_vars("q"))
    with pytest.raises(UserError, match="would score readings of the"):
        free_run(lag_plant(), lag_log(), warmup=50.0, score_from=5.0)


@pytest.mark.parametrize(
    ("measured", "simulated", "want"),
    [([1.0, np.nan, 3.0], [2.0, np.inf, 3.0], (100 * (1 - np.sqrt(0.5)), np.sqrt(0.5), "degC", 2)),
     ([2.0, 2.0], [2.0, 5.0], (np.nan, np.sqrt(4.5), "degC", 2)),
     ([1.0, 2.0, 3.0], [1.0, 2.0, 6.0], (100 * (1 - 3 / np.sqrt(2)), np.sqrt(3), "degC", 3)),
     ([1.0, np.nan, 3.0, 4.0], [np.nan, 2.0, 3.0, 4.0], (-np.inf, np.inf, "degC", 3))],
)  # fmt: skip
def test_the_score_is_that_of_the_known_readings(measured, simulated, want):
    found = score(np.array(measured), np.array(simulated))
    assert (found.fit_percent, found.rmse, found.unit, found.n) == pytest.approx(want, nan_ok=True)


@pytest.mark.parametrize("step", [1.0, 0.001])
def test_the_no_input_baseline_is_the_best_of_thirty_decays_from_the_first_five_readings(step):
    t, walks = 100 + step * np.arange(300.0), np.random.default_rng(0).standard_normal((9, 300))
    for y in (20 + 15 * np.exp(-np.arange(300.0) / 40), *walks.cumsum(axis=1)):
        y[:10] = np.nan
        first, mean = y[10:15].mean(), np.nanmean(y)
        # of 1 / 300 to 30 spans, of 1 s at least; or the mean alone
        taus = max(289 * step, 1.0) / 300 * 9000 ** (np.arange(30) / 29)
        runs = mean + (first - mean) * np.exp(-np.maximum(np.arange(300) - 10, 0) * step / taus[:, None])
        runs = np.vstack([np.full(300, mean), runs])
        best = runs[np.argmin(np.nansum((runs - y) ** 2, axis=1))]
        np.testing.assert_allclose(no_input_baseline(t, y), best)


def offset_run(off: float, *, n: int = 101, scored_from: int = 0, q=None):
    """A log whose readings are 0 and a run that reads ``off``."""
    time, zero = np.arange(float(n)), np.zeros(n)
    columns = {"q": (zero if q is None else q, "1", "input"), "t": (zero, "K", "output")}
    log = make_log(time, columns, name="log")
    return log, log.assign(t=log["t"] + off, scored=("time", 1.0 * (time >= scored_from)))


def test_baselines_are_those_of_the_scored_readings():
    log = lag_log(noise=0.1, seed=3)
    log["t"].values[40:50] = np.nan
    run = free_run(lag_plant(), log, tests=False)
    y, v = log["t"].values.copy(), run.log["t"].values
    y[:5] = np.nan
    known = np.isfinite(y)
    one = np.diff(y[known]) - np.diff(v[known])  # from the last reading that came
    assert run.one_step["t"].rmse == pytest.approx(np.sqrt(np.mean(one**2)))
    assert run.naive["mean"]["t"].rmse == pytest.approx(np.nanstd(y))
    assert run.naive["mean"]["t"].fit_percent == pytest.approx(0.0, abs=1e-9)
    assert run.residual.tests == {}
    assert run.band().level == 0.9


@pytest.mark.parametrize(
    ("gain", "pole", "how"),
    [
        (0.5 / 1.25, 0.95, "25 % more"),
        (0.5 / 0.8, 0.95, "20 % less"),
        (0.5 / 1.08, 0.95, None),
        (0.25, 0.975, None),
    ],
)
def test_one_gain_that_explains_most_of_the_error_is_said_and_a_lag_is_not_taken_for_it(gain, pole, how):
    log = lag_log(4000, noise=0.1, seed=1)
    two = log.assign(r=log["t"] * 10 + 3)
    model = StateSpaceModel(
        ("q",), (), ("t", "r"), A=[[pole]], B=[[gain]], C=[[1.0], [10.0]], dt=1.0, spread=[[4.0]]
    )
    plant = Plant(model, {}, dt=1.0, noise={"t": 0.01, "r": 0.1}, offsets={"r": 3.0})
    said = [note for note in free_run(plant, two).notes if "most of the error is one gain" in note]
    assert bool(said) == bool(how)
    if how:
        assert f"inputs do {how} than in the fit" in said[0]
        assert said[0].endswith("which would leave t 0.1 degC, r 1 degC")


def test_a_run_in_other_surroundings_has_an_offset_and_no_inputs_that_do_more():
    log = lag_log(4000, noise=0.1, seed=1)
    log = log.assign(t=log["t"] + 20 * (1 - 0.99 ** np.arange(4000.0)))  # comes slowly, and stays
    notes = " ".join(free_run(lag_plant(), log).notes)
    assert "most of it is a constant offset" in notes
    assert "inputs do" not in notes
    assert "t: worse than a model without input" in notes


@pytest.mark.parametrize(
    ("far", "rows", "share"),
    [(-0.11, 2, 2), (2.11, 2, 2), (2.11, 1, None), (-0.1, 9, None), (2.1, 9, None), (-0.101, 25, 25)],
)
def test_more_than_one_row_in_a_hundred_beyond_a_twentieth_of_the_range_is_outside(far, rows, share):
    log, _ = offset_run(0.0, n=100, q=np.where(np.arange(100) < rows, far, 1.0))
    plant = replace(lag_plant(), valid={"q": (0.0, 2.0), "t": (5.0, 6.0), "absent": (0.0, 1.0)})
    found = [("q", "0 to 2", share)] if share else []
    assert [note for note in free_run(plant, log, tests=False).notes if "outside" in note] == [
        f"{name} lies outside of {where}, the range of the fit, in {part} % of the rows"
        for name, where, part in [*found, ("t", "5 to 6", 100)]
    ]


@pytest.mark.parametrize(
    ("signal", "unit", "unseen", "says"),
    [("t squared", "degC", [], "the square of t (rms 0.5 degC, p = 1e-05): a loss that curves (radiation, "
      "free convection) is missing, or the plant is not what it was in the fit"),
     ("t squared", "1", [], "the square of t (rms 0.5, p = 1e-05): a term that curves is missing, or the "
      "plant is not what it was in the fit"),
     ("q", "K", ["q", "w"], "q (rms 0.5 K, p = 1e-05): the fit has not seen q, w as here, so this need not "
      "be a term that is missing")],
)  # fmt: skip
def test_a_correlation_is_stated_with_its_signal_size_and_meaning(signal, unit, unseen, says):
    found = ResidualCorrelations({"t": {signal: CorrelationTest(1e-5, 0.5, True)}}, {})
    run = SimpleNamespace(residual=found, warmup=5.0)
    (note,) = module._residual_notes(run, {"t": unit}, unseen, small=False)
    assert note == f"t: the residual correlates with {says}"
