"""A fifth of the readings lost: every rung still fits, and nearly as well as with all of them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from thermogrip.datasets.schema import make_log
from thermogrip.sysid.blackbox import BLACK_BOXES, family_of
from thermogrip.sysid.segments import bridge, make_grid


def heater_log(n=900, *, seed=0, lost=0.0):
    rng = np.random.default_rng(seed)
    q = np.repeat(rng.random(n // 25), 25)
    t = 25 + lfilter([0, 0.5], [1, -0.95], q) + 0.02 * rng.standard_normal(n)
    t = np.where(rng.random(n) < lost, np.nan, t)
    return make_log(np.arange(float(n)), {"q": (q, "1", "input"), "t": (t, "degC", "output")})


def error(model, segment):
    x0 = model.rest(segment.y[0], segment.u[0], segment.d[0], ())
    seen, _ = model.rollout(x0[None], segment.u[None], segment.d[None], (), 1.0)
    return float(np.sqrt(np.mean((seen[0, :-1] - segment.y)[100:] ** 2)))


@pytest.mark.parametrize("kind", BLACK_BOXES)
def test_every_rung_fits_with_a_fifth_of_the_readings_lost(kind):
    fresh = make_grid([heater_log(seed=1)], average=1.0).segments[0]
    assert np.isnan(heater_log(lost=0.2)["t"].values).mean() == pytest.approx(0.2, abs=0.04)
    best = min(
        error(model, fresh)
        for model in family_of(kind)(make_grid([heater_log(lost=0.2)], average=1.0)).values()
    )
    assert best < 0.15  # of a spread of 2.4 degC


def test_long_holes_and_open_ends_are_not_bridged():
    y = np.array([np.nan, 1.0, *[np.nan] * 6, 8.0, np.nan, 10.0, np.nan])[:, None]
    filled = bridge(y)[:, 0]
    assert np.isnan(filled[[0, 2, 7, 11]]).all()
    assert filled[9] == 9.0
