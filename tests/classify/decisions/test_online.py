"""What a robot sends sample by sample, contact or not."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from thermogrip.classify import StopRule, Stream
from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper

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


@pytest.mark.parametrize(
    ("changes", "asked", "ends"),
    [({}, 1, True), ({"p": 0.5 - 1e-9}, 1, False), ({"p": 0.5 - 1e-9, "gain": 0.09}, 1, True),
     ({"gain": 0.1, "p": 0.4}, 1, False), ({"time": 1.0 - 2e-6}, 0, False), ({"time": 1.0 - 0.5e-6}, 1, True),
     ({"time": 3.0}, 2, True), ({"evaluated": 1}, 1, False), ({"undecided": True}, 1, False),
     ({"rule": None}, 0, False), ({"decided": 0.5}, 0, False)],
)  # fmt: skip
def test_the_rule_is_asked_at_its_times_and_ends_a_contact_from_its_probability_or_below_its_gain(
    changes: dict[str, Any], asked: int, ends: bool
) -> None:
    given = {
        "p": 0.5,
        "gain": 0.2,
        "time": 1.2,
        "evaluated": 0,
        "undecided": False,
        "decided": None,
    } | changes
    rule = changes.get("rule", SimpleNamespace(times=(1.0, 2.0), sure=0.5, gain=0.1))
    touch: Any = SimpleNamespace(
        _rule=rule, _time=[given["time"]], _evaluated=given["evaluated"], decided_at=given["decided"],
        log_p=np.log([given["p"], 1e-3]), _gain=lambda grasp, rule: given["gain"],
    )  # fmt: skip
    Stream._decide(touch, None, SimpleNamespace(undecided=[given["undecided"]]))
    assert touch._evaluated == max(asked, given["evaluated"])
    assert touch.decided_at == (given["time"] if ends else given["decided"])


def test_readings_count_from_a_quarter_of_a_second_to_the_end_of_the_training() -> None:
    touch = stream(np.array([23.0]), np.array([-1.0]))
    prior = dict(zip(touch.candidates, np.exp(touch.log_p).tolist()))
    touch._model.longest_ = last = 10.0
    taken: list[float] = []
    touch._evaluate = lambda: taken.append(touch._time[-1])  # type: ignore[method-assign]
    assert touch.nothing_because == ""
    for time in (0.25, 0.2500001, 5.0, last, last + 5e-7, last + 2e-6, 12.0):
        assert touch.update(time, np.nan if time == 5.0 else -200.0 if time == 12 else 24.0) == prior
    assert taken == [0.2500001, last, last + 5e-7]
    with pytest.raises(UserError, match=r"a reading of 200\.1 degC"):
        touch.update(13.0, 200.1)
    early = stream(np.array([23.0, np.nan]), np.array([-0.25, -0.3 + 0.2]))  # no level before -0.25 s
    early.update(0.25, 24.0)
    with pytest.raises(UserError, match="no reading before contact"):
        early.update(0.26, 24.0)


def test_without_a_least_gain_nothing_is_expected() -> None:
    assert Stream._gain(SimpleNamespace(), None, SimpleNamespace(gain=0.0)) == np.inf  # type: ignore[arg-type]


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
