"""Outputs that swing about their targets, and those that do not."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from thermogrip.mpc.estimator.oscillation import Oscillation

DT, ALLOWED, PERIOD = 2.0, 0.3, 40.0


def signal() -> Oscillation:
    return Oscillation(DT, 20.0, ALLOWED)


def said(errors: Iterable[float], found: Oscillation | None = None) -> list[bool]:
    found = signal() if found is None else found
    return [found.note(error, DT) for error in errors]


def sine(amplitude: float, periods: float, *, noise: float = 0.0, period: float = PERIOD) -> list[float]:
    t = DT * np.arange(round(periods * period / DT))
    rng = np.random.default_rng(0)
    # behind the approach from -1, which does not count
    swing = amplitude * np.sin(2 * np.pi * t / period) + noise * rng.standard_normal(len(t))
    return [-1.0] * 3 + swing.tolist()


@pytest.mark.parametrize("period", [12.0, 40.0, 400.0])
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_a_swing_beyond_what_is_allowed_is_found_in_three_periods(period: float, noise: float):
    found = signal()
    errors = sine(1.0, 5.0, noise=noise, period=period)
    seen = said(errors, found)
    first = seen.index(True)
    assert all(seen[first:])
    assert 2.5 * period <= DT * (first - 3) <= 3.2 * period
    assert found.amplitude == pytest.approx(1.0, abs=0.12)
    assert found.period == pytest.approx(period, rel=0.12)


def test_a_swing_within_what_is_allowed_is_none_nor_one_slower_than_the_loop():
    assert not any(said(sine(0.95 * ALLOWED, 50.0)))
    assert not any(said(sine(1.0, 50.0, period=420.0)))
    assert any(said(sine(1.05 * ALLOWED, 50.0)))


@pytest.mark.parametrize(("damping", "swings"), [(0.03, True), (0.06, False)])
def test_what_rings_out_is_no_swing(damping: float, swings: bool):
    w = 2 * np.pi / PERIOD
    t = DT * np.arange(400)
    ringing = 20.0 * np.exp(-damping * w * t) * np.cos(w * t)
    assert any(said(ringing)) == swings


def test_loads_one_at_a_time_are_no_swings():
    load = [0.0] * 60 + (2.0 * np.sin(np.pi * np.arange(20) / 20)).tolist() + [-0.4] * 8
    assert not any(said(load * 20))


def test_noise_of_a_third_of_the_least_amplitude_is_no_swing():
    rng = np.random.default_rng(0)
    assert not any(said((ALLOWED / 3 * rng.standard_normal(50000)).tolist()))


def test_lost_readings_do_not_end_a_swing_and_quiet_does():
    errors = sine(1.0, 4.0)
    errors[50], errors[61] = float("nan"), float("nan")
    found = signal()
    assert said(errors, found)[-1]
    assert said([0.0] * 25, found)[-1] is False


def test_a_relay_with_hysteresis_swings():
    found, y, u = Oscillation(DT, 8.0, 0.3), 30.0, 1.0
    line, when = [0.0] * 4, []
    for k in range(400):
        if abs(y - 40.0) > 0.5:
            u = float(y < 40.0)
        line.append(u)
        y += DT / 100.0 * (25.0 + 30.0 * line.pop(0) - y)
        if found.note(y - 40.0, DT):
            when.append(k)
    assert when
    assert when[-1] == 399
