"""The C's own arrivals and swings, beside Python's, sample by sample."""

from __future__ import annotations

import numpy as np
import pytest

from tests.mpc.makers import InC, heater

DT, TARGET = 5.0, 40.0


def swinging(amplitude: float, period: float, noise: float = 0.03) -> np.ndarray:
    t = DT * np.arange(150)
    rng = np.random.default_rng(0)
    approach = np.linspace(25.0, 39.5, 12)
    swing = TARGET + amplitude * np.sin(2 * np.pi * t / period) + noise * rng.standard_normal(len(t))
    swing[[40, 41, 77]] = np.nan
    return np.concatenate([approach, swing])


READINGS = {
    "swings": swinging(0.6, 60.0),
    "swings fast": swinging(1.0, 33.0),
    "swings in as much noise": swinging(0.9, 33.0, 0.45),
    "rings within what is allowed": swinging(0.2, 60.0),
    "stays away": np.concatenate(
        [np.linspace(25.0, 37.0, 12), np.full(150, 37.0) + 0.01 * np.arange(150) % 2]
    ),
    "is lost on the way and comes": np.concatenate(
        [np.linspace(25.0, 30.0, 6), np.full(40, np.nan), np.linspace(30.0, 40.0, 10), np.full(60, 40.0)]
    ),
}


SWINGS = ("swings fast", "swings in as much noise")  # of what swings slowly a lag is told before


@pytest.mark.parametrize("what", READINGS)
@pytest.mark.parametrize("changes", [{}, {"zones": {"t": 0.6}}, {"ramp_per_s": {"t": 0.1}}], ids=str)
def test_c_says_when_python_does(what: str, changes: dict[str, dict[str, float]]):
    ours = heater(deadline_s=1e9, **changes)
    theirs = InC(ours.plant, ours.design)
    statuses, seen = [], set[str]()
    for k, t in enumerate(READINGS[what].tolist()):
        target = TARGET if k < 140 else TARGET + 1.0
        if not k:
            ours.reset({"t": t})
            theirs.reset({"t": t})
        both = [one.step({"t": t, "time_s": DT * k}, target) for one in (ours, theirs)]
        statuses.append(tuple(move.status for move in both))
        says, also = (move.advice for move in both)
        assert ("swings about its target" in says) == ("swings about its target" in also), (k, says, also)
        if "should have been at" in also:
            assert "should have been at" in says, (k, says, also)
        if "should have been at" in says:  # C has one advice, and what may be the cause is told first
            assert "should have been at" in also or ("follow" in says and "follow" in also), (k, says, also)
        seen |= {word for word in ("swings about", "should have been") if word in says}
    assert all(one == two for one, two in statuses), [(k, s) for k, s in enumerate(statuses) if s[0] != s[1]]
    if not changes:
        assert ("swings about" in seen) == (what in SWINGS)
        assert what not in SWINGS or "should have been" in seen  # nothing moves towards the last target
