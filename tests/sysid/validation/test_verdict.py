"""What a free run says of its plant: by how large the error is beside the stated one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from thermogrip.datasets.schema import Log, make_log
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.fit_record import fit_logs
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.validation.free_run import free_run
from thermogrip.sysid.validation.prediction_bands import Band
from thermogrip.sysid.validation.verdict import EXCEEDS, NO_BETTER, judge

KEEP = 0.95


def block(noise: float = 0.1) -> Plant:
    model = StateSpaceModel(
        ("q",), (), ("t",), A=[[KEEP]], B=[[10 * (1 - KEEP)]], C=[[1.0]], dt=1.0, y0=[20.0]
    )
    valid = {"q": (0.0, 2.0), "t": (20.0, 40.0)}
    return Plant(model, {}, dt=1.0, noise={"t": noise}, units={"t": "degC"}, valid=valid)


def log_of(
    gain: float = 1.0, *, n: int = 4000, moves: float = 2.0, noise: float = 0.1, slow: float = 0.0
) -> Log:
    """Return a log of a lag with this share of the block's gain, and a slow error that is in no model."""
    rng = np.random.default_rng(3)
    q = moves * np.repeat(rng.integers(0, 2, n // 50 + 1), 50)[:n]
    t = 20 + lfilter([0, 10 * gain * (1 - KEEP)], [1, -KEEP], q) + noise * rng.standard_normal(n)
    t = t + slow * lfilter([1 - 0.99], [1, -0.99], q - q.mean())
    return make_log(np.arange(float(n)), {"q": (q, "1", "input"), "t": (t, "degC", "output")})


def band(**expected: float) -> Band:
    return Band(0.9, {}, {}, 0, expected=expected)


@pytest.mark.parametrize(
    ("errors", "start", "gain", "no_better", "standing"),
    [
        ((EXCEEDS, 1.0), {}, None, (), "as stated"),
        ((EXCEEDS + 0.01, 1.0), {}, None, (), "changed"),
        ((3.0, 1.0), {"a": 0.6}, None, (), "start"),  # most of it is the start
        ((3.0, 1.0), {"a": 0.6}, None, ("a", "b"), "start"),  # whatever no input would have done
        ((1.5, 1.0), {"a": 0.6}, None, (), "as stated"),
        ((3.0, 1.0), {"b": 0.6}, None, (), "changed"),
        ((1.1, 0.1), {}, -0.2, (), "changed"),
        ((0.9, 0.1), {}, -0.2, (), "as stated"),  # a gain within what was stated
        ((1.1, 1.0), {}, None, ("b",), "weak"),
        ((1.1, 1.0), {}, None, ("a",), "as stated"),  # which could not beat it
        ((3.0, 1.0), {}, None, ("a", "b"), "changed"),
        ((np.inf, 1.0), {}, None, ("a",), "changed"),
    ],
)
def test_a_plant_is_another_one_beyond_twice_what_was_stated(errors, start, gain, no_better, standing):
    no_input = {"a": 0.99 / NO_BETTER, "b": 1.01 / NO_BETTER}
    given = dict(zip("ab", errors))
    found = judge(band(a=1.0, b=1.0), given, start, no_input, no_better=no_better, gain=gain, seen=False)
    assert found.standing == standing
    assert list(found.over_stated) == ["a", "b"]
    seen = judge(band(a=1.0, b=1.0), given, start, no_input, no_better=no_better, gain=gain, seen=True)
    assert seen.standing == ("seen" if standing == "as stated" else standing)


def test_where_no_output_can_beat_no_input_the_log_is_no_test():
    found = judge(band(a=1.0), {"a": 0.9}, {}, {"a": 1.0}, no_better=("a",), gain=None, seen=False)
    assert found.standing == "no test"
    assert str(found) == (
        "errs as was stated, but the inputs do too little here to test the plant "
        "(times the stated error: a 0.9)"
    )


def test_an_error_between_once_and_twice_what_was_stated_is_reported_as_larger():
    found = judge(band(a=1.0), {"a": 1.5}, {}, {"a": 9.0}, no_better=(), gain=None, seen=False)
    assert str(found) == (
        "errs by more than was stated, but no more than chance may do (times the stated error: a 1.5)"
    )


def test_hours_of_readings_do_not_make_another_plant_of_what_is_real_and_small():
    plant = block()
    run = free_run(plant, log_of(slow=0.1))
    (note,) = [note for note in run.notes if "correlates with q" in note]
    assert note.endswith("a delay, lag or term is missing, within the error that was stated")
    assert run.verdict is not None
    assert run.verdict.standing == "as stated"
    assert run.notes[-1] == str(run.verdict)
    larger = free_run(plant, log_of(slow=2.0))
    assert larger.verdict is not None
    assert larger.verdict.standing == "changed"
    assert any(note.endswith("or the plant is not what it was in the fit") for note in larger.notes)


def test_a_gain_is_another_plant_and_the_same_is_not():
    plant = block()
    standing = {gain: free_run(plant, log_of(gain)).verdict for gain in (1.0, 0.75)}
    assert [found.standing for found in standing.values() if found] == ["as stated", "changed"]
    assert standing[0.75].gain == pytest.approx(-0.25, abs=0.01)
    assert standing[1.0].over_stated["t"] == pytest.approx(1.0, abs=0.05)


def test_the_verdict_is_of_readings_whatever_is_averaged():
    log = log_of()
    one, mean = (free_run(block(), log, average=each) for each in (None, 20.0))
    assert mean.scores["t"].rmse < 0.5 * one.scores["t"].rmse
    assert mean.verdict == one.verdict


def test_inputs_that_hardly_move_are_no_test_and_nothing_is_said_against_the_plant():
    run = free_run(block(), log_of(moves=0.01))
    assert run.no_better == ("t",)
    assert run.verdict is not None
    assert run.verdict.standing == "no test"
    assert not any("relied on" in note for note in run.notes)


def test_rows_of_the_fit_are_no_test_but_those_behind_them_are():
    log = log_of()
    used = replace(fit_logs([log])[0], stop_s=1999.0)
    plant = replace(block(), fitted_to=(used,))
    found = [free_run(plant, log, score_from=begin).verdict for begin in (5.0, 2000.0)]
    assert [each.standing for each in found if each] == ["seen", "as stated"]


def test_a_band_that_is_known_is_not_made_again():
    run = free_run(block(), log_of())
    assert run.band() is run.stated
    assert run.band(0.5).level == 0.5
    assert free_run(block(), log_of(), tests=False).verdict is None
