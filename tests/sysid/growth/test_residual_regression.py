"""The residual's search: it names what is missing, and nothing where nothing is."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import make_log
from thermogrip.sysid.growth.residual_regression import _parts, residual_terms
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant


def log_of(n=1500, *, seed=0, magnitude=0.0, noise=0.02, name="a"):
    """A heater of 60 s that also warms by the magnitude of its drive."""
    rng = np.random.default_rng(seed)
    drive = np.repeat(rng.uniform(-1, 1, n // 30), 30)
    a = np.exp(-1 / 60)
    t = 25 + lfilter([0, 1 - a], [1, -a], 8 * drive + magnitude * np.abs(drive))
    signals = {"drive": (drive, "1", "input"), "t": (t + noise * rng.standard_normal(n), "degC", "output")}
    return make_log(np.arange(float(n)), signals, name=name)


@pytest.fixture(scope="module")
def line() -> Plant:
    a = float(np.exp(-1 / 60))
    model = StateSpaceModel(("drive",), (), ("t",), A=[[a]], B=[[8 * (1 - a)]], C=[[1.0]], dt=1.0, y0=[25.0])
    return Plant(model, {}, dt=1.0)


@pytest.mark.parametrize("count", [1, 3])
def test_the_term_that_is_missing_is_named_with_its_size_and_time_constant(line, count):
    logs = [log_of(seed=s, magnitude=2.0, name=str(s)) for s in range(count)]
    found = residual_terms(line, logs, warmup=1.0)
    assert found[0].term == "|drive|"
    assert found[0].coefficient == pytest.approx(2.0, rel=0.35)
    assert 25 < found[0].tau < 150
    assert found[0].share > 0.7


def test_white_noise_gives_no_term(line):
    assert residual_terms(line, [log_of(seed=s, name=str(s)) for s in range(3)]) == ()


def test_a_log_that_says_nothing_is_refused(line):
    with pytest.raises(UserError, match="too short to learn from its residual"):
        residual_terms(line, [log_of(30), log_of(1500, name="b")])


@pytest.mark.parametrize(
    ("lengths", "stretches"),
    [
        ([8], [0, 0, 1, 1, 2, 2, 3, 3]),
        ([4, 8], [0, 1, 2, 3, 4, 4, 5, 5, 6, 6, 7, 7]),
        ([2, 3, 1], [0, 0, 1, 1, 1, 2]),
    ],
)
def test_of_three_logs_a_whole_one_is_left_out_and_of_fewer_a_quarter(lengths, stretches):
    assert _parts(lengths).tolist() == stretches
