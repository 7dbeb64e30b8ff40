"""What a free run says of its plant: by how large the error is beside the stated one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from thermogrip.datasets.schema import Log, make_log
from thermogrip.sysid.blackbox.fit import fit_black_box
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.plant.plant_data import fit_logs
from thermogrip.sysid.validation.free_run import free_run
from thermogrip.sysid.validation.stated_errors import NO_BETTER, Band, InputEffect, judge

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
    """Return a band of these stated errors, each of half to twice that."""
    return Band({}, {}, 0, expected=expected, likely={n: (e / 2, 2 * e) for n, e in expected.items()})


@pytest.mark.parametrize(
    ("errors", "causes", "gain", "says"),
    [  # no input errs by a little less than 1.25 times what is stated of a, which cannot beat it; by 9 of b
        ((1.1, 2.0), {}, None, ("as stated", "")),
        ((1.1, 2.01), {}, None, ("worse", "dynamics")),
        ((1.1, 2.01), {"start": 0.6}, None, ("worse", "start")),
        ((1.1, 2.01), {"start": 0.4, "offset": 0.55}, None, ("worse", "offset")),
        ((1.1, 2.01), {"start": 0.5}, None, ("worse", "dynamics")),  # not most of it
        ((1.1, 8.0), {}, None, ("another plant", "dynamics")),  # beyond 0.8 times no input
        ((1.1, 8.0), {"start": 0.9}, None, ("worse", "start")),
        ((1.1, np.inf), {"start": 0.9}, -0.2, ("another plant", "dynamics")),
        ((1.1, 1.1), {}, -0.2, ("worse", "gain")),
        ((0.9, 0.9), {}, -0.2, ("as stated", "")),  # a gain within what was stated
        ((1.7, 0.9), {}, None, ("another plant", "dynamics")),  # beyond no input / 0.8
        ((0.4, 0.4), {}, None, ("better", "")),
        ((0.4, 0.6), {}, None, ("as stated", "")),
    ],
)
def test_the_verdict_follows_from_the_stated_error_and_from_no_input(errors, causes, gain, says):
    given = dict(zip("ab", errors))
    no_input = {"a": 0.99 / NO_BETTER, "b": 9.0}
    by_output = {"a": {}, "b": causes}
    for seen in (False, True):
        by_inputs = None if gain is None else InputEffect(gain, 0.0, {})
        found = judge(band(a=1.0, b=1.0), given, no_input, causes=by_output, by_inputs=by_inputs, seen=seen)
        untested = seen and says[0] in ("as stated", "better")
        assert (found.standing, found.cause) == (("no test", "seen") if untested else says)
        assert found.over_stated == given
        assert found.gain == (gain if found.cause == "gain" else None)


@pytest.mark.parametrize(("error", "standing"), [(0.9, "no test"), (1.2, "no test"), (1.3, "another plant")])
def test_where_no_output_can_beat_no_input_the_log_is_no_test_unless_it_did_far_worse(error, standing):
    found = judge(band(a=1.0), {"a": error}, {"a": 1.0}, causes={}, by_inputs=None, seen=False)
    assert found.standing == standing
    if standing == "no test":
        assert str(found) == (
            f"no test of the plant: the inputs do too little here (times the stated error: a {error:.2g})"
        )


def test_an_error_that_the_start_explains_does_not_clear_a_plant_that_is_far_worse_than_no_input():
    # 11.7 degC beside 3.99 without input was taken for a log that is no test
    found = judge(
        band(a=3.0), {"a": 11.7}, {"a": 3.99}, causes={"a": {"start": 0.95}}, by_inputs=None, seen=False
    )
    assert (found.standing, found.cause) == ("worse", "start")


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
    assert (larger.verdict.standing, larger.verdict.cause) == ("worse", "dynamics")
    assert any(note.endswith("or the plant is not what it was in the fit") for note in larger.notes)


def test_a_gain_is_another_plant_and_the_same_is_not():
    plant = block()
    standing = {gain: free_run(plant, log_of(gain)).verdict for gain in (1.0, 0.75)}
    assert [found.standing for found in standing.values() if found] == ["as stated", "worse"]
    assert standing[0.75].cause == "gain"
    assert standing[0.75].gain == pytest.approx(-0.25, abs=0.01)
    assert standing[1.0].over_stated["t"] == pytest.approx(1.0, abs=0.05)


def test_a_mass_that_soaks_for_longer_than_the_fit_lasted_is_slow_terms_and_no_gain():
    # a heat-up of minutes knows nothing of it; one gain explains more than half of the squared error
    time, q = np.arange(1200.0), np.ones(1200)
    fast = lfilter([0, 10 * (1 - KEEP)], [1, -KEEP], q)
    soaked = 5 * (1 - np.exp(-time / 1500))
    t = 20 + fast + soaked + 0.1 * np.random.default_rng(4).standard_normal(time.size)
    run = free_run(block(), make_log(time, {"q": (q, "1", "input"), "t": (t, "degC", "output")}))
    assert run.verdict is not None
    assert (run.verdict.standing, run.verdict.cause) == ("worse", "slow")
    assert "slow terms are missing" in str(run.verdict)


def test_a_black_box_begins_from_the_readings_that_its_fit_began_from():
    # an arm that rings: eight poles, of which five rows of readings say nothing
    poles = [0.995 * np.exp(1j * w) for w in (0.3, 0.9, 1.7, 2.3)]
    a = np.real(np.poly([*poles, *np.conj(poles)]))
    logs = []
    for seed in (0, 1):
        rng = np.random.default_rng(seed)
        u = rng.standard_normal(1000)
        y = lfilter([0, 1.0], a, u)[200:] + 0.01 * rng.standard_normal(800)
        logs.append(make_log(np.arange(800.0), {"u": (u[200:], "V", "input"), "y": (y, "m", "output")}))
    plant = fit_black_box("arx", [logs[0]]).plant
    run = free_run(plant, logs[1])
    assert run.warmup == 50.0
    assert not run.no_better


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
    assert [(each.standing, each.cause) for each in found if each] == [("no test", "seen"), ("as stated", "")]


def test_a_band_that_is_known_is_not_made_again():
    run = free_run(block(), log_of())
    assert run.band() is run.stated
    assert free_run(block(), log_of(), tests=False).verdict is None
