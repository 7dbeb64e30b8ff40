"""A plant of one's own from the command line: identify, validate, simulate, and what is refused."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from tests.end_to_end.conftest import Bench
from thermogrip.datasets.log_files import read_log
from thermogrip.sysid.greybox.fit import fit_network
from thermogrip.sysid.models.user_model import load_object, own_model
from thermogrip.sysid.validation.free_run import free_run

REAL = Path(os.environ.get("THERMOGRIP_REAL_DATA", Path(__file__).parents[3] / "shared" / "data" / "real"))

TANK = """
import numpy as np

class Tank:
    inputs, outputs, states, dt = {"pump": "V"}, {"level": {"unit": "V", "sd": 0.05}}, {"level": 0.5}, 4.0
    parameters = {
        "gain": {"value": 0.05, "sd_log": 0.7, "unit": "1/s"},
        "drain": {"value": 0.05, "sd_log": 0.7, "unit": "V^0.5/s"},
    }

    def rhs(self, x, u, d, p):
        return [p.gain * u.pump - p.drain * np.sqrt(np.maximum(x.level, 0.0))]
"""


@pytest.fixture
def tank(bench: Bench) -> Bench:
    """A bench with tank.py and a log of it, tank.csv, made with gain 0.06 and drain 0.08."""
    (bench.path / "tank.py").write_text(TANK)
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 1600.0, 4.0)
    pump = np.repeat(rng.uniform(1.0, 5.0, 20), 20)
    model = own_model(load_object(bench.path / "tank.py", "Tank"))
    y, _ = model.rollout([[4.0]], pump[None, :, None], np.zeros((1, t.size, 0)), [[0.06, 0.08]], 4.0)
    rows = zip(t, pump, y[0, :-1, 0] + 0.05 * rng.standard_normal(t.size))
    text = "\n".join(f"{a:g},{b:.6f},{c:.4f}" for a, b, c in rows)
    (bench.path / "tank.csv").write_text(f"time_s,pump_V,level_V\n{text}\n")
    return bench


def test_a_class_goes_through_identify_validate_and_simulate(tank: Bench):
    own = ["--network", "tank.py:Tank"]
    found = tank.run("identify", "tank.csv", *own, "--models", "network", "--out", "tank.json", "--json")
    assert found.code == 0, found
    answer = json.loads(found.out)
    assert answer["parameters"]["drain"]["value"] == pytest.approx(0.08, rel=0.03)
    assert answer["parameters"]["drain"]["unit"] == "V^0.5/s"
    assert "degC" not in answer["verdict"]
    scored = tank.run(
        "validate", "tank.json", "tank.csv", *own, "--warmup", "20", "--score-from", "20", "--json"
    )
    assert scored.code == 0, scored
    assert json.loads(scored.out)["logs"][0]["outputs"]["level"]["rmse"] < 0.06
    done = tank.run("simulate", "tank.json", "tank.csv", *own, "--out", "seen.csv")
    assert done.code == 0, done
    assert "level_V" in (tank.path / "seen.csv").read_text().splitlines()[0]


@pytest.mark.parametrize(
    ("network", "names"),
    [
        ("tank.py:Pond", ("tank.py", "Pond", "Tank")),
        ("pond.py:Tank", ("pond.py", "no such file")),
        ("tank.py", ("tank.py:CLASS",)),
        ("bad.py:Tank", ("bad.py:12", "ZeroDivisionError")),
        ("lost.py:Tank", ("lost.py:12", "no attribute 'gian'", "gain, drain")),
    ],
)
def test_a_wrong_class_is_one_line_and_code_2(tank: Bench, network: str, names: tuple[str, ...]):
    (tank.path / "bad.py").write_text(TANK.replace("return [p", "return [1 / 0 * p"))
    (tank.path / "lost.py").write_text(TANK.replace("p.gain", "p.gian"))
    done = tank.run("identify", "tank.csv", "--network", network, "--models", "network", "--out", "x.json")
    assert done.code == 2, done
    assert len(done.said) == 1
    for name in names:
        assert name in done.said[0]
    assert not (tank.path / "x.json").exists()


@pytest.mark.skipif(
    not REAL.is_dir(), reason=f"no measurements of other labs in {REAL} (set THERMOGRIP_REAL_DATA)"
)
def test_the_example_of_two_tanks_predicts_a_log_that_it_has_not_seen():
    train, test = (REAL / f"cascaded_tanks_{part}.csv" for part in ("train", "test"))
    example = Path(__file__).parents[2] / "examples" / "cascaded_tanks.py"
    plant = fit_network(own_model(load_object(example, "CascadedTanks")), [read_log(train)])
    run = free_run(plant, read_log(test), warmup=200.0, score_from=200.0)
    assert run.scores["level"].rmse < 0.20  # a neural state space model has 0.303 under this rule
