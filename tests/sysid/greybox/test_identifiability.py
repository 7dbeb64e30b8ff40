"""Parameters that are not identifiable from the logs are reported, and so are identifiable combinations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermogrip.sysid.greybox.identifiability import describe, identifiability_report, trade_offs
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.plant.plant_data import PlantScores


def a_plant(correlation: float, jacobian: np.ndarray | None = None) -> Plant:
    """A plant whose power and loss have this correlation and a standard deviation of 20 % each."""
    plant = prior_plant(load_network("tclab"))
    n = len(plant.free)
    covariance = 0.04 * np.eye(n)
    i, j = plant.free.index("power_1"), plant.free.index("G_amb")
    covariance[i, j] = covariance[j, i] = 0.04 * correlation
    report = describe(
        plant.free, np.eye(n) if jacobian is None else jacobian, covariance, {}, shift=np.zeros(n)
    )
    return replace(plant, covariance=covariance, scores=PlantScores(identifiability=report))


def test_a_ratio_that_is_known_is_named_with_its_width():
    stated = [line for line in identifiability_report(a_plant(0.99)) if "trade off" in line]
    # sd of the difference sqrt(2 * 0.04 * 0.01) = 0.028: 1.645 of it is 4.8 %, of 0.2 it is 39 %
    assert len(stated) == 1
    assert "G_amb and power_1 trade off (correlation 0.99): their ratio is known to ±4.8 %" in stated[0]
    assert "each by itself to ±39 % at best" in stated[0]


@pytest.mark.parametrize(
    ("scales", "correlation", "what"),
    [
        (("log", "log"), -0.99, "their product is known to ±4.8 %, each by itself to ±39 % at best"),
        (("linear", "linear"), 0.99, "their difference is known to ±0.047, each by itself to ±0.33"),
        (("linear", "linear"), -0.99, "their sum is known to ±0.047, each by itself to ±0.33 at best"),
        (("log", "linear"), 0.99, "their combination is known to ±0.047"),
    ],
)
def test_what_is_known_goes_by_scale_and_sign(scales, correlation: float, what: str):
    plant = a_plant(correlation)
    plant = replace(plant, scales=plant.scales | dict(zip(("power_1", "G_amb"), scales)))
    assert what in identifiability_report(plant)[-1]


def test_a_wide_interval_on_a_log_scale_is_a_factor():
    plant = a_plant(0.99)
    stated = identifiability_report(replace(plant, covariance=np.asarray(plant.covariance) * 16))[-1]
    assert "each by itself to a factor of 3.7 at best" in stated  # exp(1.645 * 0.8)


def test_bounds_and_parameters_known_from_the_prior_only_are_named():
    plant = a_plant(0.0)
    bounds = {"a": "low", "b": "high"}
    found = replace(plant.scores.identifiability, on_bound=bounds, prior_only=["c", "d"])
    stated = identifiability_report(replace(plant, scores=PlantScores(identifiability=found)))
    for line in ("a is on its lower bound", "b is on its upper bound", "known from the prior only: c, d"):
        assert any(words.startswith(line) for words in stated)


def test_the_closest_pair_comes_first():
    sd, r = np.array([1.0, 1.0, 1.0, 1.0]), np.eye(4)
    r[0, 1] = r[1, 0] = 0.98
    r[2, 3] = r[3, 2] = -0.995
    pairs = trade_offs("abcd", r * np.outer(sd, sd))
    assert [(p.first, p.second) for p in pairs] == [("c", "d"), ("a", "b")]
    assert [p.sd_together for p in pairs] == pytest.approx([np.sqrt(2 * 0.005), np.sqrt(2 * 0.02)])


def test_parameters_that_are_known_by_themselves_are_not_named():
    assert trade_offs(["a", "b"], np.diag([1.0, 2.0])) == []
    assert not any("trade off" in line for line in identifiability_report(a_plant(0.5)))


@pytest.mark.parametrize("small", [0.0, 3e-3])
def test_flat_directions_are_reported_in_words(small: float):
    plant = a_plant(0.0)
    jacobian = np.eye(len(plant.free))
    i, j = plant.free.index("lag_1"), plant.free.index("lag_2")
    jacobian[j] = jacobian[i]
    jacobian[j, j] = jacobian[i, j] = 1.0  # the logs see the sum of both
    jacobian[j, j] += small
    stated = identifiability_report(a_plant(0.0, jacobian))
    how = "barely" if small else "not"
    assert f"{how} identifiable from these logs: lag_1 up, lag_2 down, together" in stated


def test_the_spectrum_of_the_scaled_hessian_knows_no_units():
    rng = np.random.default_rng(0)
    jacobian = rng.normal(size=(30, 4))
    reports = [
        describe("abcd", jacobian * scale, np.eye(4), {}, shift=np.zeros(4))
        for scale in (1.0, [1, 10, 1e3, 0.1])
    ]
    assert reports[0].condition == pytest.approx(reports[1].condition)
    scaled = jacobian / np.linalg.norm(jacobian, axis=0)
    assert reports[0].condition == pytest.approx(np.linalg.cond(scaled.T @ scaled))


def test_a_plant_without_a_fit_has_nothing_to_say():
    assert identifiability_report(prior_plant(load_network("tclab"))) == []


@pytest.mark.parametrize(
    ("reach", "bounds", "cause"),
    [
        (3000.0, ("power_1",), "q1 reaches 3000 percent in the logs and its full scale"),
        (0.9, ("power_1",), "q1 reaches 0.9 percent in the logs and its full scale"),
        (80.0, ("power_1",), "its prior is off, or it makes up for something that is not modelled"),
        (80.0, ("G_amb", "lag_1", "lag_2"), "several are, so check unit, full scale and sign"),
        (3000.0, ("G_amb", "lag_1", "lag_2"), "q1 reaches 3000 percent in the logs and its full scale"),
    ],
)
def test_a_parameter_on_its_bound_is_reported_with_the_likely_cause(reach, bounds, cause):
    plant = replace(a_plant(0.0), valid={"q1": (0.0, reach), "q2": (0.0, 80.0)})
    plant.scores.identifiability.on_bound.update(dict.fromkeys(bounds, "high"))
    stated = [line for line in identifiability_report(plant) if "bound" in line]
    assert len(stated) == len(bounds)
    for name, line in zip(bounds, stated):
        assert line.startswith(f"{name} is on its upper bound {plant.bounds[name][1]:.3g}: {cause}")


def test_what_a_fit_says_of_its_parameters():
    """Two alike but for 2 % of one, one that moves nothing: of the scaled Hessian 0, 1e-4 (nearly) and 2."""
    jacobian = np.array([[1.0, 1.0, 0.0], [0.0, 0.02, 0.0]])
    sd = np.array([0.89, 0.91, 1.0])
    for tilt, flat in (
        (0.018, ["c up", "a up, b down"]),
        (0.016, ["c up", "a up, b down"]),
        (0.022, ["c up"]),
    ):
        jacobian[1, 1] = tilt
        shift = np.array([0.0, 0.5, -0.8])
        found = describe("abc", jacobian, np.diag(sd**2), {"a": "low"}, shift=shift)
        least = 1 - 1 / np.sqrt(1 + tilt**2)
        assert [way.replace("a down, b up", "a up, b down") for way in found.flat] == (
            flat if least < 1e-4 or len(flat) == 1 else ["c up"]
        )
    assert found.prior_only == ["b", "c"]
    assert (found.identifiable, found.flat[0], found.on_bound) == (False, "c up", {"a": "low"})
    assert found.condition == pytest.approx((2 - least) / 1e-18, rel=1e-3)
    # what was moved by more than data that narrow it by a tenth may do is not the prior's
    pulled = describe("abc", jacobian, np.diag(sd**2), {}, shift=np.array([0.0, 0.5, -2.4]))
    assert pulled.prior_only == ["b"]
    alone = describe("ab", jacobian[:, :2], np.eye(2), {}, shift=np.zeros(2))
    assert alone.identifiable
    assert alone.condition == pytest.approx((2 - least) / least, rel=1e-6)


def test_a_trade_off_begins_at_nine_tenths_and_where_both_are_known_better():
    for r, stated in ((0.899, False), (0.901, True)):
        assert bool(trade_offs("ab", np.array([[1.0, r], [r, 1.0]]))) == stated
    # 1 and 4 at 0.95: of the difference 3.07 remain
    assert trade_offs("ab", np.array([[1.0, 3.8], [3.8, 16.0]])) == []
    covariance = 0.05 * np.eye(8) + 0.95
    assert len(trade_offs("abcdefgh", covariance)) == 28
