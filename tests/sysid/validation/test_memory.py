"""What validating a long log takes."""

from __future__ import annotations

import subprocess
import sys

import pytest

_CHILD = """
import resource

import numpy as np

from thermogrip.datasets.schema import make_log
from thermogrip.sysid import Plant
from thermogrip.sysid.models.neural import NeuralModel
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.validation.free_run import free_run

rng = np.random.default_rng(0)
members, n, h = 20, 5, 3  # 100 states
weights = {"V": (n, h), "W": (h, n), "U": (h, 1), "b": (h,)}
weights = {name: 0.1 * rng.normal(size=(members, *shape)) for name, shape in weights.items()}
A = np.diag([0.99, 0.98, 0.9, 0.8, 0.5])
root = rng.normal(size=(members * n, members * n))
one, none = np.ones(1), np.zeros((members, n))
weights |= {"A": np.tile(A, (members, 1, 1)), "B": none[:, :, None] + 0.01, "c": none}
scales = {"y_middle": 30 * one, "y_size": one, "w_middle": 0 * one, "w_size": one, "reach": 2 * one}
scales |= {"low": -np.inf * one, "high": np.inf * one, "spread": root @ root.T / len(root)}
neural = NeuralModel(("q",), (), ("t",), switches=(), dt=1.0, **weights, **scales)
shift, first = np.diag(np.ones(59), -1), np.eye(60)[:1]
shift[0, 0] = 0.98
lags = StateSpaceModel(("q",), (), ("t",), A=shift, B=first.T, C=first, dt=1.0, spread=np.eye(60))

def peak(rows):
    q = np.repeat(rng.random(rows // 50), 50)
    for model in (neural, lags):
        x0, none = np.zeros((1, model.n_x)), np.zeros((1, rows, 0))
        y = model.rollout(x0, q[None, :, None], none, (), 1.0)[0][0, :-1, 0] + rng.standard_normal(rows)
        log = make_log(np.arange(float(rows)), {"q": (q, "1", "input"), "t": (y, "degC", "output")})
        plant = Plant(model, {}, dt=1.0, noise={"t": 1.0}, refits=(model,), logs=("log",))
        assert free_run(plant, log).residual.tests["t"]
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

few = peak(1000)
print(peak(10000) - few)
"""


@pytest.mark.slow
def test_validating_ten_times_the_rows_keeps_no_run_of_each_direction_of_the_start():
    # all kept, 100 directions of 100 states over 9000 rows more are 720 MB, and 60 of 60 are 260 MB
    child = subprocess.run([sys.executable, "-c", _CHILD], capture_output=True, text=True, check=False)
    assert child.returncode == 0, child.stderr
    assert float(child.stdout) < 150
