"""Schedules: inside limits and slew, balanced, with the spectrum and crest factor that they specify."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.experiment.schedules import KINDS, excite, multisine, prbs, staircase


@settings(max_examples=60, deadline=None)
@given(
    kind=st.sampled_from(KINDS),
    minutes=st.floats(5.0, 40.0),
    low=st.floats(-1.0, 0.2),
    width=st.floats(0.1, 1.0),
    slew=st.floats(0.01, 10.0),
    seed=st.integers(0, 1000),
)
def test_every_schedule_stays_inside_limits_and_slew(kind, minutes, low, width, slew, seed):
    log = excite(kind, minutes, low=low, high=low + width, slew=slew, dt=0.5, seed=seed)
    drive = log["drive"].values
    assert drive.min() >= low - 1e-12
    assert drive.max() <= low + width + 1e-12
    assert np.abs(np.diff(drive)).max() <= slew * 0.5 + 1e-9
    assert log.sizes["time"] == round(minutes * 60 / 0.5)
    assert np.ptp(drive[:12]) == 0  # 6 s at the middle


@pytest.mark.parametrize("bits", [3, 4, 5, 6, 7, 8, 9, 10])
def test_a_prbs_is_of_maximum_length(bits):
    n = 2**bits - 1
    sequence = prbs(n, hold=1, seed=1)
    assert abs(sequence.sum()) == 1  # balanced but for one bit
    shifts = [float(sequence @ np.roll(sequence, k)) for k in range(1, n)]
    np.testing.assert_allclose(shifts, -1.0)  # the two-level autocorrelation of an m-sequence


def test_a_prbs_spectrum_is_flat():
    sequence = prbs(1023, hold=1, seed=3)
    power = np.abs(np.fft.rfft(sequence))[1:] ** 2
    np.testing.assert_allclose(power, 1024.0, rtol=1e-9)


@settings(max_examples=30, deadline=None)
@given(n=st.integers(500, 8000), seed=st.integers(0, 9))
def test_a_multisine_is_balanced_and_has_a_low_crest_factor(n, seed):
    wave = multisine(n, slowest=n / 1.5, fastest=20.0, seed=seed)
    assert abs(wave.mean()) < 1e-9  # whole periods
    crest = np.abs(wave).max() / wave.std()
    assert crest < 3.2  # 25 cosines in phase would have 7.1
    power = np.abs(np.fft.rfft(wave)) ** 2
    assert power[int(n / 20.0) + 1 :].max() < 1e-9 * power.max()  # nothing faster than asked


@pytest.mark.parametrize("seed", [0, 1])
def test_a_staircase_visits_both_ends_and_is_balanced(seed):
    stairs = staircase(4800, hold=600, seed=seed)
    assert stairs.max() == 1.0
    assert stairs.min() == -1.0
    assert abs(stairs.mean()) < 0.02


def test_a_prbs_begins_elsewhere_with_another_seed():
    first, second = (excite("prbs", 30.0, seed=seed)["drive"].values for seed in (1, 2))
    assert not np.array_equal(first, second)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"kind": "chirp"}, "no schedule of kind 'chirp'"),
        ({"minutes": 1.0}, "too short"),
        ({"low": 1.0, "high": -1.0}, "empty"),
        ({"tau_fast": 300.0}, "tau_fast < tau_slow"),
    ],
)
def test_impossible_schedules_are_refused(change, says):
    with pytest.raises(UserError, match=says):
        excite(**({"kind": "prbs", "minutes": 20.0} | change))
