"""Schedules: inside limits, balanced, with the spectrum and crest factor that they specify."""

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
    seed=st.integers(0, 1000),
)
def test_every_schedule_stays_inside_limits(kind, minutes, low, width, seed):
    log = excite(kind, minutes, low=low, high=low + width, dt=0.5, seed=seed)
    drive = log["drive"].values
    assert drive.min() >= low - 1e-12
    assert drive.max() <= low + width + 1e-12
    assert log.sizes["time"] == round(minutes * 60 / 0.5)
    assert np.ptp(drive[:12]) == 0  # 6 s at the middle


@pytest.mark.parametrize("bits", [3, 4, 5, 6, 7, 8, 9, 10])
def test_a_prbs_is_of_maximum_length(bits):
    n = 2**bits - 1
    sequence = prbs(n, hold=1, seed=1)
    assert abs(sequence.sum()) == 1  # balanced but for one bit
    shifts = [float(sequence @ np.roll(sequence, k)) for k in range(1, n)]
    np.testing.assert_allclose(shifts, -1.0)  # the two-level autocorrelation of an m-sequence


@settings(max_examples=30, deadline=None)
@given(n=st.integers(500, 8000), seed=st.integers(0, 9))
def test_a_multisine_is_balanced_and_has_a_low_crest_factor(n, seed):
    wave = multisine(n, slowest=n / 1.5, fastest=20.0, seed=seed)
    assert abs(wave.mean()) < 1e-9  # whole periods
    crest = np.abs(wave).max() / wave.std()
    assert crest < 3.2  # 25 cosines in phase would have 7.1
    power = np.abs(np.fft.rfft(wave)) ** 2
    assert power[int(n / 20.0) + 1 :].max() < 1e-9 * power.max()  # nothing faster than asked


def test_a_schedule_is_its_shape_between_the_limits_behind_a_rest():
    """Periods reach from pi 10 s to 2 pi 200 s, in rows of 0.5 s."""
    plain = {
        "prbs": prbs(2388, hold=20, seed=0),
        "multisine": multisine(2388, slowest=800 * np.pi, fastest=20 * np.pi, seed=0),
        "staircase": staircase(2388, hold=1200, seed=0),
    }
    for kind, shape in plain.items():
        log = excite(kind, 20.0)
        assert log.attrs["name"] == f"{kind} schedule"
        assert log["time"].values[[1, -1]].tolist() == [0.5, 1199.5]
        assert log["drive"].values.tolist() == [0.0] * 12 + shape.tolist()
        assert log["pump"].values.tolist() == [1.0] * 2400
        less = excite(kind, 20.0, low=0.2, high=0.6)
        np.testing.assert_allclose(less["drive"].values, 0.4 + 0.2 * log["drive"].values, atol=1e-15)
    quick = excite("staircase", 20.0, tau_slow=50.0)["drive"].values
    assert quick[12:].tolist() == staircase(2388, hold=300).tolist()
    slow = excite("prbs", 20.0, dt=4.0, tau_fast=22.0, seed=3)["drive"].values
    assert slow.tolist() == [0.0] * 2 + prbs(298, hold=6, seed=3).tolist()  # 5.5 rows, and 6 s are two


@pytest.mark.parametrize(("n", "hold", "period"), [
    (4, 2, 7), (28, 2, 7), (29, 2, 7), (30, 2, 15), (40, 2, 15), (2046, 2, 1023), (9000, 2, 1023)
])  # fmt: skip
def test_a_prbs_has_the_longest_period_that_fits(n: int, hold: int, period: int):
    found = prbs(n, hold=hold)
    assert found.tolist() == np.resize(np.repeat(prbs(period, hold=1), hold), n).tolist()


@pytest.mark.parametrize(
    ("slowest", "fastest", "least", "most"),
    [
        (500.0, 20.0, 2, 50),
        (499.0, 20.0, 3, 50),
        (1e9, 1.0, 1, 250),
        (1e9, 900.0, 1, 2),
        (200.0, 900.0, 5, 6),
    ],
)
def test_a_multisine_has_one_amplitude_over_its_harmonics(
    slowest: float, fastest: float, least: int, most: int
):
    wave = multisine(1000, slowest=slowest, fastest=fastest)
    assert np.abs(wave).max() == 1.0
    size = np.abs(np.fft.rfft(wave))
    there = np.flatnonzero(size > 1e-6)
    assert (there[0], there[-1]) == (least, most)
    assert len(there) == len(set(np.geomspace(least, most, 25).round().astype(int)))
    np.testing.assert_allclose(size[there], size[least])


def test_a_multisine_of_few_harmonics_has_the_phases_of_schroeder_or_better():
    for n in (3, 6):
        k, t = np.arange(1, n + 1), 2 * np.pi * np.arange(1000) / 1000
        plain = np.cos(np.outer(t, k) - np.pi * k * (k - 1) / n).sum(axis=1)
        crest = [np.abs(w).max() / w.std() for w in (multisine(1000, slowest=1e9, fastest=1000 / n), plain)]
        assert crest[0] <= crest[1] + 1e-9


@pytest.mark.parametrize(("hold", "up"), [
    (100, [0.5, 1.0, 0.5, 0.0]), (700, [0.5, 1.0, 0.5, 0.0]), (80, [0.5, 1.0, 0.5, 0.0]),
    (70, [1 / 3, 2 / 3, 1.0, 2 / 3, 1 / 3, 0.0]), (1, [0.25, 0.5, 0.75, 1.0, 0.75, 0.5, 0.25, 0.0]),
])  # fmt: skip
def test_stairs_go_up_and_down_by_equal_steps(hold: int, up: list[float]):
    """800 rows hold 8, 6 at least, 10, 11 and 18 at most of them, of which a quarter lead to the top."""
    levels = np.array([*up, *(-v for v in up)])
    want = levels[(np.arange(800) * len(levels)) // 800]
    np.testing.assert_allclose(staircase(800, hold=hold), want, atol=1e-15)
    np.testing.assert_allclose(staircase(800, hold=hold, seed=3), -want, atol=1e-15)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"kind": "chirp"}, "no schedule of kind 'chirp'"),
        ({"minutes": 1.0}, "too short"),
        ({"low": 1.0, "high": -1.0}, "empty"),
        ({"tau_fast": 300.0}, "tau_fast < tau_slow"),
        ({"tau_fast": 200.0}, "tau_fast < tau_slow"),
        ({"tau_fast": 0.0}, "tau_fast < tau_slow"),
        ({"dt": 0.0}, "dt > 0"),
        ({"low": 1.0}, "limits 1 to 1 are empty"),
        ({"minutes": 205.0 / 60}, "3.41667 min are too short .* from 10 s; take 3.4 min or more"),
        ({"minutes": 399.0 / 60, "dt": 10.0, "tau_fast": 1.0}, "6.65 min are too short"),
    ],
)
def test_impossible_schedules_are_refused(change, says):
    with pytest.raises(UserError, match=says):
        excite(**({"kind": "prbs", "minutes": 20.0} | change))
    assert excite("prbs", 206.0 / 60).sizes["time"] == 412
    assert excite("prbs", 400.0 / 60, dt=10.0, tau_fast=1.0).sizes["time"] == 40
