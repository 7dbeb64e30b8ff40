"""tune and run from the command line: their pages, a class of one's own, two outputs, a cluster."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.end_to_end.conftest import Bench, small_plant
from thermogrip.mpc.design.spec import Spec
from thermogrip.mpc.tuning.tune import tune
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.models.user_model import load_object, own_model
from thermogrip.sysid.plant.plant import Plant

SPEC = """
steps = [[25, 29]]
hold_s = 200
settle_within_s = 180
evaluations = 2
search_draws = 1
check_draws = 1
sample_time_s = 2.0
"""

LAB = """
class Lab:
    inputs = {"q1": {"unit": "percent", "range": (0, 100)}, "q2": {"unit": "percent", "range": (0, 100)}}
    outputs = {"t1": {"unit": "degC", "sd": 0.1}, "t2": {"unit": "degC", "sd": 0.1}}
    disturbances = {"t_ambient": "degC"}
    states = {"h1": 0.5, "h2": 0.5, "t1": 0.3, "t2": 0.3}
    parameters = {
        "power": {"value": 0.006, "sd_log": 0.3, "unit": "K/s"},
        "loss": {"value": 0.006, "sd_log": 0.3, "unit": "1/s"},
        "between": 0.002,
        "lag": 0.06,
    }
    dt = 2.0

    def rhs(self, x, u, d, p):
        swap = p.between * (x.h2 - x.h1)
        return [
            p.power * u.q1 - p.loss * (x.h1 - d.t_ambient) + swap,
            0.7 * p.power * u.q2 - p.loss * (x.h2 - d.t_ambient) - swap,
            p.lag * (x.h1 - x.t1),
            p.lag * (x.h2 - x.t2),
        ]

    def rest(self, y, u, d, p):
        return [y[0], y[1], y[0], y[1]]
"""


@pytest.fixture
def lab(bench: Bench) -> Bench:
    """A bench with lab.py, its plant lab.json and a quick spec."""
    (bench.path / "lab.py").write_text(LAB)
    model = own_model(load_object(bench.path / "lab.py", "Lab"))
    values = {"power": 0.006, "loss": 0.006, "between": 0.002, "lag": 0.06}
    plant = Plant(
        model,
        values,
        dt=2.0,
        units=dict(model.units),
        free=("power", "loss"),
        scales={"power": "log", "loss": "log"},
        covariance=np.diag([0.02, 0.02]) ** 2,
        noise={"t1": 0.05, "t2": 0.05},
        valid={"q1": (0.0, 100.0), "q2": (0.0, 100.0), "t1": (20.0, 60.0), "t2": (20.0, 60.0)},
    )
    plant.save(bench.path / "lab.json")
    wanted = SPEC.replace("2.0", "4.0").replace("200", "400").replace("180", "390")
    (bench.path / "lab.toml").write_text(wanted)
    return bench


@pytest.mark.parametrize(
    ("spec", "says"),
    [
        ("steps = [[25, 140]]\nhold_s = 60", "steps: full drive does not reach 140 degC"),
        ("sample_time_s = 0.1", "sample_time_s: 0.1 s is no multiple of the plant's step of 2 s"),
    ],
)
def test_a_key_of_the_spec_that_only_the_plant_can_refuse_is_reported_with_its_file(lab: Bench, spec, says):
    lab.write("lab.toml", spec)
    words = ("lab.json", "--network", "lab.py:Lab", "--spec", "lab.toml", "--out", "c.json")
    found = lab.run("tune", *words)
    assert found.code == 2
    assert len(found.said) == 1
    assert f"lab.toml: {says}" in found.said[0]
    assert not (lab.path / "c.json").exists()


def test_a_class_of_ones_own_with_two_outputs_is_tuned_and_run(lab: Bench):
    own = ("--network", "lab.py:Lab")
    done = lab.run("tune", "lab.json", *own, "--spec", "lab.toml", "--out", "c.json", "--json")
    assert done.code in (0, 3), done
    assert {row["controller"] for row in json.loads(done.out)["rows"]} >= {"tuned", "LQR"}
    ran = lab.run(
        *("run", "c.json", "--twin", "lab.json", *own, "--target", "t1=31,t2=28", "--out", "r", "--json")
    )
    assert ran.code == 0, ran
    rows = (lab.path / "r" / "samples.csv").read_text().splitlines()
    last = dict(zip(rows[0].split(","), map(float, rows[-1].split(",")), strict=True))
    assert abs(last["t1_degC"] - 31) < 0.3
    assert abs(last["t2_degC"] - 28) < 0.3


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["tune", "lab.json", "--out", "c.json"], "hand the class in with --network lab.py:Lab"),
        (["tune", "lab.json", "--network", "lab.py:Lap", "--out", "c.json"], "Lab"),
        (["tune", "plant.json", "--cluster", "localhost", "--out", "c.json"], "write tcp://HOST:PORT"),
        (["tune", "volt.json", "--out", "c.json"], "level moves by 0.5 V in the logs"),
        (["tune", "still.json", "--out", "c.json"], "no drive moves t_surface"),
    ],
)
def test_what_cannot_be_controlled_is_one_line(lab: Bench, words: list[str], says: str):
    plant = small_plant()
    model = StateSpaceModel(("pump",), (), ("level",), A=[[0.9]], B=[[1.0]], C=[[1.0]], dt=1.0)
    units = {"pump": "1", "level": "V"}
    valid = {"pump": (0.0, 1.0), "level": (2.0, 2.5)}
    Plant(model, {}, dt=1.0, units=units, valid=valid).save(lab.path / "volt.json")
    still = replace(plant.model, B=np.zeros((2, 2)))
    replace(plant, model=still).save(lab.path / "still.json")
    done = lab.run(*words)
    assert done.code == 2, done
    assert len(done.said) == 1
    assert says in done.said[0]


@pytest.mark.slow
def test_a_cluster_finds_the_same_controller_bit_for_bit(lab: Bench):
    distributed = pytest.importorskip("distributed")
    model = own_model(load_object(lab.path / "lab.py", "Lab"))
    plant = Plant.load(lab.path / "lab.json", model=model)
    spec = Spec(
        steps=[(25, 29)], hold_s=200.0, evaluations=2, search_draws=1, check_draws=1, sample_time_s=4.0
    )
    here = tune(plant, spec)
    cluster = distributed.LocalCluster(
        n_workers=1,
        threads_per_worker=1,
        processes=False,
        protocol="tcp",
        host="127.0.0.1",
        dashboard_address=":0",
    )
    try:
        there = tune(plant, spec, workers=cluster.scheduler_address)
    finally:
        cluster.close()
    assert there.controller.design == here.controller.design
    assert there.scores == here.scores
    assert str(there.history) == str(here.history)  # a PI that does not settle has nan
    assert [row.to_dict() for row in there.rows] == [row.to_dict() for row in here.rows]
    assert there.pareto.rows() == here.pareto.rows()
    assert [item.to_dict() for item in there.sensitivity] == [item.to_dict() for item in here.sensitivity]
