"""Step tests that are recorded from the step on."""

from __future__ import annotations

import numpy as np
import pytest

from tests.sysid.models.makers import steady_gain
from thermogrip.datasets.schema import make_log
from thermogrip.sysid.data.preparation import role_doubts, with_rest
from thermogrip.sysid.identification import identify
from thermogrip.sysid.validation.free_run import free_run

N = 500
T = np.arange(float(N))


def step_test(at=1, *, until=N, noise=0.1, quantum=0.0, drift=0.0, level=50.0, name="step"):
    """A heater of 0.7 K a percent and 150 s behind a sensor of 20 s, from 21 degC."""
    q = np.where((at <= T) & (until > T), level, 0.0)
    block = sensor = 21.0
    y = []
    for each in q:
        y.append(sensor)
        sensor += (block - sensor) / 20
        block += (21 + 0.7 * each - block) / 150
    y = np.array(y) + noise * np.random.default_rng(3).standard_normal(N) + drift * T
    y = quantum * np.round(y / quantum) if quantum else y
    log = make_log(T, {"q": (q, "percent", "input"), "t": (y, "degC", "output"), "other": (T, "1", "other")})
    return log.assign_attrs(name=name)


@pytest.mark.parametrize(
    ("log", "rests"),
    [
        (step_test(), True),
        (step_test(at=10), True),
        (step_test(at=11), False),  # its own rest, short as it is
        (step_test(at=0), False),  # never moves
        (step_test(until=300), False),  # its second move tells the gain
        (step_test(at=3, drift=2.0), False),  # does not rest
        (step_test(noise=0.05, quantum=0.32), True),
    ],
)
def test_rest_is_added_before_the_only_move_of_a_log_that_begins_flat(log, rests):
    (out,), said = with_rest([log], ["q"], ["t"])
    assert len(said) == rests
    if not rests:
        assert out is log
        return
    assert out.time.values.tolist() == [*range(-50, 0), *range(N)]
    assert not out[["q", "other"]].isel(time=slice(50)).to_array().any()
    move = int(np.argmax(log.q.values > 0))
    np.testing.assert_allclose(out.t.values[:50], log.t.values[: move + 1].mean())
    assert out.isel(time=slice(50, None)).identical(log.assign_attrs(sha256=out.attrs["sha256"]))


def test_a_later_move_of_any_log_tells_the_gain_of_all():
    logs = [step_test(), step_test(until=300, name="b")]
    assert with_rest(logs, ["q"], ["t"]) == (logs, [])
    longer, said = with_rest(
        [step_test(), step_test(level=30.0, name="b"), step_test(at=0, name="c")], ["q"], ["t"]
    )
    assert ([log.sizes["time"] for log in longer], len(said)) == ([N + 50, N + 50, N], 2)


def test_named_roles_settle_no_doubt_on_readings():
    log = step_test().assign_attrs(clock_doubts="dt", reading_doubts="t jumps", role_doubts="t jumps\nq is")
    for named_all, doubts in ((False, ("dt", "t jumps", "q is")), (True, ("dt", "t jumps"))):
        assert role_doubts([log], named_all=named_all) == doubts


@pytest.mark.parametrize("kind", ["arx", "subspace"])
def test_a_log_that_climbs_before_its_only_move_is_fitted_and_its_gain_in_doubt(kind):
    log = step_test(at=100).isel(time=slice(99, 189))
    climbs = log.assign(t=log.t.copy(data=log.t.values + 15 * (1 - np.exp(-np.arange(90) / 20))))
    found = identify(climbs, models=[kind], draws=0)
    assert (found.plant.model.inputs, found.good) == (("q",), False)
    assert "q moves in the first rows alone, where the plant was not at rest" in found.doubts[0]


def test_a_step_test_recorded_from_its_step_on_gives_the_gain_and_runs_a_step_of_twice_the_size():
    found = identify(step_test(noise=0.05, quantum=0.32), models=["arx", "oe", "subspace"], draws=8)
    assert any("begins with the only move of an input" in note for note in found.notes)
    (gain,) = np.ravel(steady_gain(found.plant.model))
    assert abs(gain - 0.7) < 0.07
    twice = step_test(level=100.0, noise=0.05, quantum=0.32)
    assert free_run(found.plant, twice).scores["t"].rmse < 4  # of 70 K; 42 K off without the rest
