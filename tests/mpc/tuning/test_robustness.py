"""What a PI loop bears: its peak sensitivity beside closed forms, and beside loops that are simulated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.mpc.design.test_design import block
from thermogrip.mpc.design.design import PILoop, simc
from thermogrip.mpc.tuning import robustness
from thermogrip.mpc.tuning.robustness import peak_sensitivity, worst_sensitivity


def closed_form(loop: PILoop, w: np.ndarray, lag: float, delay: float) -> np.ndarray:
    """Of 10 s of delay and a lag of 50 s, 0.5 degC a percent."""
    z, a = np.exp(1j * w), np.exp(-1 / 50)
    G = 0.5 * (1 - a) * z**-11 / (1 - a / z) * np.exp(-1j * w * delay) / (1 + 1j * w * lag)
    return np.abs(1 / (1 + loop.Kc * (1 + 1 / (loop.Ti * (z - 1))) * G))


@pytest.mark.parametrize(("lag", "delay"), [(0.0, 0.0), (5.0, 0.0), (0.0, 5.0)])
def test_the_peak_of_a_delayed_lag_is_its_closed_form(lag: float, delay: float):
    plant = block(10, 50.0)
    loop = simc(plant, "q", "t")
    exact = closed_form(loop, np.linspace(1e-3, np.pi, 200_000), lag, delay).max()
    assert peak_sensitivity(plant, loop, 1.0, lag=lag, delay=delay) == pytest.approx(exact, rel=5e-3)


def test_a_loop_whose_peak_is_without_bound_oscillates_for_good():
    plant, rule = block(10, 50.0), simc(block(10, 50.0), "q", "t")

    def swing(loop: PILoop) -> float:
        """Return the last fifth's range over that of the fifth before."""
        y, held, total = np.zeros(1001), [0.0] * 10, 0.0
        for k in range(1000):
            error = 1.0 - y[k]
            held.append(loop.Kc * error + total)
            total += loop.Kc / loop.Ti * error
            y[k + 1] = np.exp(-1 / 50) * y[k] + 0.5 * (1 - np.exp(-1 / 50)) * held.pop(0)
        return float(np.ptp(y[800:]) / np.ptp(y[600:800]))

    gains = rule.Kc * np.geomspace(1.0, 5.0, 60)
    peaks = [peak_sensitivity(plant, replace(rule, Kc=gain), 1.0) for gain in gains]
    worst = gains[int(np.argmax(peaks))]
    assert max(peaks) > 15
    assert swing(replace(rule, Kc=worst / 1.1)) < 0.6
    assert swing(replace(rule, Kc=worst * 1.1)) > 1.5


def test_a_level_grows_on_where_its_response_ends():
    """SIMC's own figure on what adds up is 1.70; the delay is half a sample longer in a loop that samples."""
    plant = block(20, 4e5)  # of which a step is watched for four hours
    assert peak_sensitivity(plant, simc(plant, "q", "t"), 1.0) == pytest.approx(1.70, abs=0.06)


def test_the_loop_is_sampled_as_slowly_as_it_is_called():
    plant = block(10, 50.0)
    loop = simc(plant, "q", "t")
    slow = peak_sensitivity(plant, loop, 5.0)  # half a sample of 5 s for one of 1 s
    later = peak_sensitivity(plant, loop, 1.0, delay=2.0)
    assert slow == pytest.approx(later, rel=0.05)
    assert slow > 1.1 * peak_sensitivity(plant, loop, 1.0)


def test_what_is_borne_is_two_steps_that_no_log_shows_or_half_a_delay(monkeypatch: pytest.MonkeyPatch):
    asked: list[tuple[str, dict[str, float]]] = []

    def peak(plant: object, loop: PILoop, dt: float, **more: float) -> float:
        asked.append((loop.drive, more))
        return {"lag": 1.5, "delay": 1.2}[next(iter(more))] * loop.Kc

    monkeypatch.setattr(robustness, "peak_sensitivity", peak)
    loops = [PILoop("q", "t", 1.0, 50.0), PILoop("q", "t", 3.0, 50.0)]
    assert worst_sensitivity(block(10, 50.0), loops, 1.0) == pytest.approx(4.5)
    worst_sensitivity(block(1, 50.0, dt=0.5), loops[:1], 1.0)
    assert [more for _, more in asked[-2:]] == [{"lag": 1.0}, {"delay": 1.0}]
    assert asked[0][1]["lag"] == pytest.approx(5.0, abs=0.01)
