"""A contact ends when its stopping criterion is met, and errs as often as it was asked to.

What a robot sends sample by sample, contact or not.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from thermogrip.classify import StopRule, Stream, answer, classify_grasps, learn_stop_rule, load_stop_rule
from thermogrip.classify.decisions import stopping_rule
from thermogrip.classify.decisions.stopping_rule import (
    TIMES,
    Windows,
    growing_windows,
    learn_from_windows,
    stop_callback,
    stops,
)
from thermogrip.classify.estimators.base import pick
from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import Grasps
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper

THREE = ["copper", "iron", "wood"]


@pytest.fixture(scope="module")
def fresh() -> Grasps:
    """Test grasps at a difference of 20 degC, which the bundled calibration did not see."""
    grasps = load_example_grasps()["exp2_dT20"]
    return pick(grasps, grasps["split"].values == "test")


def _walks(n: int, seed: int, boast: float = 1.0) -> tuple[Windows, np.ndarray]:
    """Two candidates whose log odds gather evidence as a sequential test's do; ``boast`` overstates it."""
    rng = np.random.default_rng(seed)
    true = rng.integers(0, 2, n)
    odds = np.cumsum(rng.normal(0.5, 1.0, (n, 12)), axis=1) * np.where(true, 1, -1)[:, None] * boast
    log_p = np.stack([-np.logaddexp(0, odds), -np.logaddexp(0, -odds)], axis=2)
    return Windows(np.arange(1.0, 13.0), log_p), true


@pytest.mark.parametrize("boast", [1.0, 2.0])
def test_the_error_of_sure_contacts_is_as_stated_on_fresh_ones(boast: float) -> None:
    """Also where the stated probabilities are overconfident: the threshold is learnt, not taken as stated."""
    rule = learn_from_windows([_walks(600, 1, boast)], error=0.05, end=12.0)
    seen, true = _walks(6000, 2, boast)
    found = stops(rule, seen)
    sure = found.early
    # 600 training contacts leave the threshold's error uncertain by 0.01, 6000 tests by 0.003
    assert 0.015 < (found.answer != true)[sure].mean() < 0.05 + 0.02
    assert found.time.mean() < 9


@pytest.mark.parametrize(
    ("stated", "wrong", "error", "sure"),
    [
        # five of 100 err at 0.99, before the rest, at 0.96: 6/102 is more than 0.05, and less than 0.06
        ({0.99: 5, 0.96: 95}, 5, 0.05, 1.0),
        ({0.99: 5, 0.96: 95}, 5, 0.06, 0.5),
        # of 40 at 0.99 six are wrong, 0.167; with 960 more at 0.96, all right, it is 7/1002 again
        ({0.99: 40, 0.96: 960}, 6, 0.05, 1.0),
        # 30 of 30 right is a mean error of 1/32; but at 0.7 the classifier itself expects 0.3
        ({0.7: 30}, 0, 0.05, 1.0),
        ({0.7: 30}, 0, 0.29, 1.0),
        ({0.7: 30}, 0, 0.31, 0.5),
        # nobody errs or expects to: every contact ends at its first window
        ({0.96: 100}, 0, 0.05, 0.5),
    ],
)
def test_a_threshold_keeps_the_stated_error_in_count_and_in_expectation(
    stated: dict[float, int], wrong: int, error: float, sure: float
) -> None:
    top = np.repeat(list(stated), list(stated.values()))
    log_p = np.log(np.tile(np.stack([1 - top, top], axis=1)[:, None], (1, 2, 1)))
    seen = Windows(np.array([1.0, 10.0]), log_p)
    rule = learn_from_windows([(seen, (np.arange(top.size) >= wrong).astype(np.int64))], error=error)
    assert rule.sure == sure
    assert stops(rule, seen).time.tolist() == [10.0 if sure == 1.0 else 1.0] * top.size


def test_a_contact_ends_at_its_threshold() -> None:
    """To be as sure as asked is enough."""
    log_p = np.log(np.array([[[0.5, 0.5], [0.5, 0.5]], [[0.25, 0.75], [0.25, 0.75]]]))
    found = stops(StopRule(sure=float(np.exp(log_p[1, 0, 1]))), Windows(np.array([1.0, 10.0]), log_p))
    assert found.time.tolist() == [10.0, 1.0]
    assert found.early.tolist() == [False, True]


def two_windows(stated: list[float]) -> Windows:
    """Contacts that are so sure of the second of two candidates at 1 s, and at 10 s."""
    top = np.array(stated)
    log_p = np.log(np.tile(np.stack([1 - top, top], axis=1)[:, None], (1, 2, 1)))
    return Windows(np.array([1.0, 10.0]), log_p)


@pytest.mark.parametrize(
    ("low", "sure"),
    [(0.62, 0.65), (0.88, 0.9), (0.93, 0.95), (0.98, 1 - 0.05 * 500 ** (-4 / 27)), (0.99988, 0.9999)],
)
def test_the_threshold_is_the_next_of_its_grid_above_those_that_err(low: float, sure: float) -> None:
    """38 of 39 at nearly 1 are right, 2 / 41 < 0.05; the others are all wrong."""
    seen = two_windows([1 - 1e-12] * 39 + [low] * 20)
    true = np.ones(59, dtype=np.int64)
    true[[0, *range(39, 59)]] = 0
    assert learn_from_windows([(seen, true)]).sure == pytest.approx(sure, rel=1e-9)


def test_as_many_grasps_as_can_just_show_the_error_are_enough() -> None:
    """1 / (18 + 2) = 0.05; two of 39 + 1 err and one more: (1 + 1) / (38 + 2)."""
    right = np.ones(38, dtype=np.int64)
    assert learn_from_windows([(two_windows([1 - 1e-12] * 18), right[:18])]).sure == 0.5
    with pytest.raises(UserError, match=r"17 training grasps cannot show .* 0\.05; .* at least 0\.053"):
        learn_from_windows([(two_windows([0.9] * 17), right[:17])])
    right[3] = 0
    assert learn_from_windows([(two_windows([1 - 1e-12] * 38), right)]).sure == 0.5
    assert learn_from_windows([(two_windows([1 - 1e-12] * 37), right[:37])]).sure == 1.0


def test_a_silent_contact_ends_at_the_end_and_its_error_is_what_is_left() -> None:
    seen = two_windows([0.9, 0.8, 0.95])
    found = stops(StopRule(sure=0.85), seen, np.array([[True, True], [False, False], [False, False]]))
    assert found.time.tolist() == [10.0, 10.0, 1.0]
    assert found.answer.tolist() == [1, 1, 1]
    assert found.early.tolist() == [False, False, True]
    np.testing.assert_allclose(found.p_wrong, [0.1, 0.2, 0.05])
    sure = seen._replace(log_p=seen.log_p - seen.log_p.max() + 1e-17)
    assert stops(StopRule(sure=0.9), sure).p_wrong.min() == 0.0  # never less than nothing


def test_records_are_followed_to_their_end_among_their_own_materials(
    known: PosteriorClassifier, fresh: Grasps, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[dict[str, object]] = []

    def followed(classifier: object, grasps: Grasps, **options: object) -> Windows:
        asked.append(options)
        return two_windows([0.6] * grasps.sizes["grasp"])

    monkeypatch.setattr(stopping_rule, "growing_windows", followed)
    short = pick(fresh, [8, 0, 1]).sel(time=slice(None, 4.05)).assign_attrs(name="short")
    wood, told = pick(fresh, [7]).assign_attrs(name="wood"), list[tuple[float, str]]()
    records = [fresh, wood, short]
    rule = learn_stop_rule(known, records, error=0.2, progress=lambda *at: told.append(at))
    about = {"times": stopping_rule.TIMES}
    last = float(short["time"].values[-1])
    assert asked == [
        {"candidates": THREE, "end": 10.0, **about},
        {"candidates": ["copper", "wood"], "end": last, **about},
    ]
    assert told == [(k / 3, f"windows of {name}") for k, name in enumerate(("exp2_dT20", "wood", "short"))]
    assert (rule.n_grasp, rule.error) == (12, 0.2)
    for wrong in ({"error": 0.0}, {"error": 1.0}):
        with pytest.raises(UserError, match="is no share"):
            learn_stop_rule(known, fresh, **wrong)


def test_windows_end_once_and_count_the_prior_odds(known: PosteriorClassifier, fresh: Grasps) -> None:
    one = pick(fresh, [0])
    odds = {"copper": 1.0, "iron": 5.0, "wood": 2.0}
    given = PosteriorClassifier(priors=odds).with_device(load_default_gripper())
    plain, weighed = (
        growing_windows(model, one, candidates=THREE, times=[0.3, 10.0, 12.0]) for model in (known, given)
    )
    assert plain.times.tolist() == weighed.times.tolist() == [0.3, 10.0]
    shifted = plain.log_p[0] + np.log([1.0, 5.0, 2.0])
    shifted -= np.logaddexp.reduce(shifted, axis=1)[:, None]
    np.testing.assert_allclose(weighed.log_p[0], shifted, atol=1e-6)


def test_windows_know_nothing_of_what_comes_later(known: PosteriorClassifier, fresh: Grasps) -> None:
    other = fresh.copy(deep=True)
    other["t_surface"].values[:, fresh["time"].values > 1.05] = 33.0
    a, b = (growing_windows(known, g, candidates=THREE, times=[0.5, 1.0]) for g in (fresh, other))
    np.testing.assert_allclose(a.log_p[:, :2], b.log_p[:, :2], atol=1e-9)


def test_the_last_window_is_the_batch_answer(known: PosteriorClassifier, fresh: Grasps) -> None:
    seen = growing_windows(known, fresh, candidates=THREE, times=[1.0])
    np.testing.assert_allclose(
        np.exp(seen.log_p[:, -1]), np.exp(known.candidate_log_proba(fresh, THREE)), atol=2e-4
    )


def test_a_rule_survives_its_file_and_is_asked_for(tmp_path: Path) -> None:
    rule = StopRule(sure=0.97, times=(0.5, 2.0), end=8.0, error=0.03, n_grasp=55)
    rule.save(tmp_path / "stop_rule.json")
    assert load_stop_rule(tmp_path) == rule
    of_0_2_0 = json.loads((tmp_path / "stop_rule.json").read_text()) | {"gain": 0.004}
    (tmp_path / "stop_rule.json").write_text(json.dumps(of_0_2_0))
    assert load_stop_rule(tmp_path) == rule
    assert StopRule(sure=1.0) == StopRule(sure=1.0, times=TIMES, end=10.0, error=0.05, n_grasp=0)
    (tmp_path / "stop_rule.json").write_text('{"schema": "thermogrip.stop_rule", "version": 1, "sure": "x"}')
    with pytest.raises(UserError, match="not a whole stop rule"):
        load_stop_rule(tmp_path)
    (tmp_path / "stop_rule.json").unlink()
    with pytest.raises(UserError, match="has no stop rule"):
        load_stop_rule(tmp_path)


@pytest.mark.parametrize(
    "wrong",
    [{"sure": 1.5}, {"sure": 0.0}, {"error": 5.0}, {"error": 0.0},
     {"error": 1.0}, {"end": 0.0},
     {"end": 3601.0}, {"times": [0.0, 0.5]}, {"times": [3601.0]}, {"n_grasp": -1}],
)  # fmt: skip
def test_a_rule_out_of_range_is_refused_by_its_file(wrong: dict[str, object], tmp_path: Path) -> None:
    file = StopRule(sure=0.95).save(tmp_path / "rule.json")
    file.write_text(json.dumps(json.loads(file.read_text()) | wrong))
    message = r"rule\.json: is not a whole stop rule \((need 0 < sure <= 1|\w+ is .*, not |times )"
    with pytest.raises(UserError, match=message):
        StopRule.load(file)


def test_predictions_say_when_each_contact_was_decided(known: PosteriorClassifier, fresh: Grasps) -> None:
    rows = classify_grasps(known, fresh, THREE, rule=StopRule(sure=0.97))
    right = [row["material"] == m for row, m in zip(rows, fresh["material"].values)]
    assert np.mean(right) >= 8 / 9
    times = np.array([row["decided_at_s"] for row in rows])
    assert times.max() <= 10.0
    assert times.mean() < 4.0
    assert all(0 <= row["p_unknown"] <= 1 for row in rows)


def test_a_rule_does_not_cut_touches_of_one_block(known: PosteriorClassifier) -> None:
    two = load_example_grasps()["exp5_two_touch_unknown_object"].isel(grasp=[0, 48])
    with pytest.raises(UserError, match="answered together"):
        classify_grasps(known, two, THREE, rule=StopRule(sure=0.95))


def test_a_rule_is_learnt_from_labelled_records(known: PosteriorClassifier, fresh: Grasps) -> None:
    rule = learn_stop_rule(known, fresh, error=0.2, times=(0.5, 1.0, 2.0))
    assert (rule.n_grasp, rule.error, rule.times) == (9, 0.2, (0.5, 1.0, 2.0))
    assert 0.5 <= rule.sure <= 1.0
    with pytest.raises(UserError, match="no share"):
        learn_stop_rule(known, fresh, error=1.5)


def test_a_session_goes_by_samples_and_hides_the_label(known: PosteriorClassifier, fresh: Grasps) -> None:
    """What a rig passes on holds the material that it was asked to grasp; the decision must not see it."""
    one = pick(fresh, [8]).assign(material=("grasp", ["copper"]))  # it is wood
    stop = stop_callback(known, StopRule(sure=0.95), candidates=THREE)
    time = one["time"].values
    ended = [t for t in time[time > 0.2] if stop(one.sel(time=slice(None, t)))]
    assert ended[0] < 3.0
    assert np.array_equal(ended, time[time >= ended[0]])  # once decided it stays so


def test_one_callback_serves_grasp_after_grasp_and_tells_what_it_finds(
    known: PosteriorClassifier, fresh: Grasps
) -> None:
    """A batch has one for all its trials: what ended the first contact says nothing of the second."""
    told: list[tuple[float, dict[str, float]]] = []
    stop = stop_callback(known, StopRule(sure=0.95), candidates=THREE, tell=lambda *found: told.append(found))
    time = fresh["time"].values
    for k in (0, 8):
        told.clear()
        one = pick(fresh, [k])
        ended = [t for t in time[(time > 0.2) & (time < 3.0)] if stop(one.sel(time=slice(None, t)))]
        alone = stop_callback(known, StopRule(sure=0.95), candidates=THREE)
        assert ended == [t for t in time[(time > 0.2) & (time < 3.0)] if alone(one.sel(time=slice(None, t)))]
        assert max(told[-1][1], key=told[-1][1].__getitem__) == one["material"].values[0]
        assert [at for at, _ in told] == time[time < 3.0].tolist()


@pytest.mark.parametrize("late", [pytest.param(0.0, marks=pytest.mark.slow), 0.3])
def test_a_record_ends_when_its_stream_did_also_where_the_contact_is_late(
    late: float, known: PosteriorClassifier, fresh: Grasps
) -> None:
    """A skin that waits for its contact is no insulator: looked at too soon, all were wood."""
    moved = fresh.assign_coords(time=np.round(fresh["time"].values + late, 3)).sel(time=slice(-1.5, 10.0))
    some = pick(moved, [0, 6])
    rule = StopRule(sure=0.97)
    rows = classify_grasps(known, some, THREE, rule=rule)
    assert [row["material"] for row in rows] == some["material"].values.tolist()
    for i, row in enumerate(rows):
        about = {name: float(some[name].values[i]) for name in ("t_object", "t_ambient")}
        touch = Stream(known, candidates=THREE, rule=rule, **about)
        decided = None
        for time, reading in zip(some["time"].values, some["t_surface"].values[i]):
            p = list(touch.update(float(time), float(reading)).values())
            decided = p if decided is None and touch.decided_at is not None else decided
        assert row["decided_at_s"] == (touch.decided_at or 10.0)
        np.testing.assert_allclose([row[f"p_{name}"] for name in THREE], decided or p, atol=1e-3)
        batch = np.exp(known.candidate_log_proba(pick(some, [i]), THREE)[0])
        np.testing.assert_allclose(p, batch, atol=1e-3)
        np.testing.assert_allclose(list(touch.result().values()), batch, atol=1e-12)


def test_a_contact_without_a_reading_yet_is_waited_for(known: PosteriorClassifier, fresh: Grasps) -> None:
    """One reading a second, or the first of them lost: the rule's first times have nothing to look at."""
    rule, some = StopRule(sure=0.97), pick(fresh, [0, 6])
    slow = some.isel(time=slice(0, None, 10))
    rows = classify_grasps(known, slow, THREE, rule=rule)
    assert [row["material"] for row in rows] == ["copper", "wood"]
    assert {row["decided_at_s"] for row in rows} <= {1.0, 1.5, 2.0, 3.0}
    early = (some["time"] > 0) & (some["time"] < 1.2) & (some["grasp"] == some["grasp"][1])
    lost = some.assign(t_surface=some["t_surface"].where(~early))
    seen = growing_windows(known, lost, candidates=THREE, times=(0.5, 1.5))
    np.testing.assert_allclose(np.exp(seen.log_p[1, 0]), 1 / 3)
    whole = growing_windows(known, some, candidates=THREE, times=(0.5, 1.5))
    np.testing.assert_allclose(np.exp(seen.log_p[0]), np.exp(whole.log_p[0]), atol=1e-5)
    assert classify_grasps(known, lost, THREE, rule=rule)[1]["decided_at_s"] == 1.5


COPPER, WOOD = 2, 21
TIME = load_example_grasps()["exp2_dT20"]["time"].values
RULE = StopRule(sure=0.97)


def skin(i: int) -> np.ndarray:
    return np.array(load_example_grasps()["exp2_dT20"]["t_surface"].values[i], dtype=float)


def stream(
    readings: np.ndarray, time: np.ndarray = TIME, *, until: float = 10.0, t_object: float = 28.0
) -> Stream:
    known = PosteriorClassifier().with_device(load_default_gripper())
    touch = Stream(known, candidates=["copper", "wood"], t_object=t_object, t_ambient=27.0, rule=RULE)
    for t, y in zip(time[time <= until], readings):
        touch.update(float(t), float(y))
    return touch


def test_no_contact_ends_nothing_and_names_nothing() -> None:
    flat = 48.0 + 0.05 * np.random.default_rng(0).standard_normal(TIME.size)
    touch = stream(flat, until=3.5)
    assert touch.decided_at is None
    assert touch.nothing_because == "no contact"
    assert np.isnan(touch.log_p).all()
    assert np.isnan(list(touch.result().values())).all()


def test_the_wrong_object_temperature_ends_nothing() -> None:
    touch = stream(skin(WOOD), until=3.5, t_object=68.0)
    assert touch.decided_at is None
    assert "away from t_object" in touch.nothing_because


def test_a_spike_changes_no_answer_and_ends_nothing() -> None:
    for bad in (85.0, -127.0, 0.0):
        readings = skin(COPPER)
        readings[24] = bad
        plain = stream(np.where(readings == bad, np.nan, readings), until=1.5)
        touch = stream(readings, until=1.5)
        assert touch.decided_at == plain.decided_at
        assert touch.result() == pytest.approx(plain.result(), rel=1e-9)


def test_a_sensor_at_its_rail_ends_nothing() -> None:
    """The samples at it look like a contact that ran out of heat, of another metal, for certain."""
    readings = np.maximum(skin(COPPER), 41.0)
    first = TIME[int(np.argmax(readings == 41.0))]
    often = StopRule(sure=0.97, times=tuple(np.arange(0.3, 9.9, 0.1).round(1).tolist()))
    known = PosteriorClassifier().with_device(load_default_gripper())
    touch = Stream(known, candidates=["brass", "copper", "iron", "zinc"], t_object=28.0, rule=often)
    for t, y in zip(TIME[first + 2.5 >= TIME], readings):
        touch.update(float(t), float(y))
    assert touch.decided_at is None
    assert touch.result()["copper"] > 0.3


def test_what_is_no_sample_is_refused_and_the_next_one_taken() -> None:
    touch = stream(skin(COPPER), until=1.0)
    said = dict(zip(touch.candidates, np.exp(touch.log_p).tolist()))
    for time, reading, words in (
        (1.0, 45.0, "time 1 s after 1 s; give samples in order, each once"),
        (0.5, 45.0, "time 0.5 s after 1 s"),
        (np.nan, 45.0, "time nan s after 1 s"),
        (1.1, 318.0, "a reading of 318 degC; give degC"),
    ):
        with pytest.raises(UserError, match=words):
            touch.update(time, reading)
    assert touch.update(1.1, float("nan")) == said


def test_a_stream_that_begins_with_the_contact_reports_it() -> None:
    touch = stream(skin(COPPER), until=-3.0)
    touch.update(0.1, 45.0)
    with pytest.raises(UserError, match=r"no reading before contact, and now it is 0\.3 s; start at -1 s"):
        touch.update(0.3, 45.0)


def test_a_stream_begins_at_the_prior_odds():
    known = PosteriorClassifier(priors={"copper": 3.0}).with_device(load_default_gripper())
    touch = Stream(known, candidates=["copper", "wood"], t_object=28.0, t_ambient=27.0)
    assert touch.update(-1.0, 23.0) == pytest.approx({"copper": 0.75, "wood": 0.25})


@pytest.mark.parametrize(("material", "candidates"), [("copper", THREE), ("wood", ["copper", "iron"])])
def test_a_stream_knows_what_is_none_of_its_candidates_as_the_answer_does(material, candidates):
    known = PosteriorClassifier().with_device(load_default_gripper())
    grasps = load_example_grasps()["exp2_dT20"]
    grasp = grasps.isel(grasp=[grasps["material"].values.tolist().index(material)])
    about = {name: float(grasp[name].values[0]) for name in ("t_object", "t_ambient")}
    touch = Stream(known, candidates=candidates, **about)
    assert np.isnan(touch.p_unknown)  # before the contact
    for time, reading in zip(grasp["time"].values, grasp["t_surface"].values[0]):
        touch.update(float(time), float(reading))
    (found,) = answer(known, grasp, candidates)
    assert touch.p_unknown == pytest.approx(found.p_unknown, rel=1e-6)
    assert (touch.p_unknown > 0.5) == (material not in candidates)
