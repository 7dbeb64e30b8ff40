"""tune and run from the command line: their pages, a class of one's own, two outputs, a PI that is best."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.end_to_end.conftest import Bench, small_plant
from thermogrip.mpc.native.runtime import compiler
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
    answer = json.loads(done.out)
    assert done.code == (0 if answer["meets_spec"] else 3), done
    assert {row["controller"] for row in answer["rows"]} == {"baseline", "tuned", "PI"}
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


def test_where_a_pi_is_best_the_pi_is_tuned_run_reviewed_and_exported(lab: Bench):
    """An output that is its drive a sample later: a filter that trusts such a model meets loads late."""
    model = StateSpaceModel(("q",), ("room",), ("t",), A=[[0.0]], B=[[1.0]], E=[[1.0]], C=[[1.0]], dt=1.0)
    units, valid = {"q": "percent", "room": "degC", "t": "degC"}, {"q": (0.0, 100.0), "t": (0.0, 90.0)}
    Plant(model, {}, dt=1.0, units=units, valid=valid, noise={"t": 0.05}).save(lab.path / "lag.json")
    lab.write(
        "lag.toml",
        "steps = [[30, 40]]\nhold_s = 300\nsettle_within_s = 250\nevaluations = 3\nslew_per_s = 0.3",
    )
    done = lab.run(
        *("tune", "lag.json", "--spec", "lag.toml", "--out", "pi.json", "--report", "t.html", "--json")
    )
    answer = json.loads(done.out)
    assert done.code == (0 if answer["meets_spec"] else 3), done
    assert answer["kind"] == "PI"
    assert answer["finding"].startswith("The PI is best and is what is saved: it scores ")
    page = (lab.path / "t.html").read_text(encoding="utf-8")
    assert answer["finding"].split(". ")[0] in page
    assert "q by 10" in page  # a load
    ran = lab.run(*("run", "pi.json", "--twin", "lag.json", "--target", "40", "--out", "r", "--json"))
    assert ran.code == 0, ran
    reviewed = json.loads(lab.run("review", "pi.json", "--json").out)
    assert "comes back after a load" in [
        check["name"] for check in reviewed["checks"] if check["verdict"] == "pass"
    ]
    node = lab.run("export", "pi.json", "--ros2", "--out", "node")
    assert (node.code, (lab.path / "node" / "topics.toml").exists()) == (0, True)
    refused = lab.run("export", "pi.json", "--arduino", "--out", "library")
    assert (refused.code, len(refused.said)) == (2, 1)
    if compiler() is None:
        pytest.skip("no gcc here")
    checked = lab.run("export", "pi.json", "--check", "--states", "300", "--out", "c", "--json")
    assert checked.code == 0, checked
    found = json.loads(checked.out)
    assert (found["same_status"], found["free"] > 20) == (300, True)
    assert found["difference"] < 1e-13
