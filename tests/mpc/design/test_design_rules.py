"""A controller's file closes a loop as it says, or one line names the field that cannot be."""

from __future__ import annotations

import json

import numpy as np
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.mpc.controllers.mpc import Controller, design_controller
from thermogrip.mpc.design.design import LONGEST_HORIZON, Design, check_design, default_design
from thermogrip.mpc.review.review import review
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

LOOP = {"drive": "drive", "output": "t_surface", "Kc": 0.1, "Ti": 50.0, "Tt": 50.0, "feedforward": 0.0}


@pytest.fixture(scope="module")
def design(tank) -> dict:
    return default_design(tank, dt=2.0).to_dict()


def test_a_default_design_is_sound(tank, design):
    assert check_design(Design.from_dict(design), tank).dt == 2.0


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"dt": 0}, "dt"),
        ({"dt": 2.5}, "dt is 2.5 s, no multiple of the plant's step of 1 s"),
        ({"dt": 1e9}, "longer than"),
        ({"dt": "2"}, "dt must be a finite number"),
        ({"track": True}, "track"),
        ({"price": float("nan")}, "price"),
        ({"overshoot": -0.1}, "overshoot"),
        ({"ambient": 1e6}, "ambient"),
        ({"patience_s": -1}, "patience_s"),
        ({"deadline_s": -1}, "deadline_s"),
        ({"offset_free": "no"}, "offset_free"),
        ({"blocks": [LONGEST_HORIZON + 1]}, "blocks"),
        ({"blocks": [1] * 300}, "unknowns"),
        ({"controlled": []}, "controlled"),
        ({"controlled": ["t_surface", "t_surface"]}, "twice"),
        ({"drive_range": {"drive": [-5.0, 5.0]}}, "beyond the drive's -1 to 1"),
        ({"drive_range": {"drive": [-1.0, 1.0], "fan": [0.0, 1.0]}}, "no drive fan"),
        ({"slew_per_s": {"drive": "fast"}}, "slew_per_s"),
        ({"limits": {"t_tank": [float("-inf"), 60.0]}}, "limits of t_tank"),
        ({"loops": [{**LOOP, "drive": "fan"}]}, "loops"),
        ({"loops": [{**LOOP, "output": "t_tank"}]}, "loops"),
        ({"loops": [LOOP, LOOP]}, "twice"),
        ({"loops": [{**LOOP, "Ti": 0.0}]}, "Ti"),
        ({"loops": [{**LOOP, "Kc": "much"}]}, "PI of t_surface"),
        ({"noise": {"state": -1.0}}, "noise"),
    ],
)
def test_a_field_that_cannot_be_is_named(tank, design, change, says):
    with pytest.raises(UserError, match=says):
        check_design(Design.from_dict({**design, **change}), tank)


def test_a_file_whose_range_goes_beyond_the_drive_is_refused_with_its_name(tank, tmp_path):
    path = design_controller(tank, dt=2.0).save(tmp_path / "c.json")
    content = json.loads(path.read_text())
    content["design"]["drive_range"]["drive"] = [-5.0, 5.0]
    path.write_text(json.dumps(content))
    with pytest.raises(UserError, match=r"c\.json: drive_range of drive"):
        Controller.load(path)


@pytest.mark.parametrize("spec", [{"steps": "abc"}, {"steps": [[1], [None]]}])
def test_a_review_of_notes_that_were_edited_is_one_line(tank, spec):
    controller = Controller(tank, default_design(tank, dt=2.0), notes={"spec": spec})
    with pytest.raises(UserError, match="steps"):
        review(controller)


def test_a_review_of_a_plant_that_only_adds_up_asks_for_no_rest():
    block = StateSpaceModel(("q",), (), ("t",), A=[[1.0]], B=[[0.5]], C=[[1.0]], dt=1.0, y0=[25.0])
    plant = Plant(block, {}, dt=1.0, units={"q": "1"}, valid={"q": (-1.0, 1.0), "t": (20.0, 60.0)})
    found = {check.name: check for check in review(design_controller(plant, dt=2.0), wanted=(25.0, 35.0))}
    assert found["gain keeps its sign over the drive"].verdict == "warn"
    assert found["targets can be held in steady state"].verdict == "pass"  # with the drive at zero
    assert found["a PI controller stands in"].verdict == "pass"
    assert np.all([check.finding for check in found.values()])
