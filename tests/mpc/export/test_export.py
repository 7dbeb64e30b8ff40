"""An exported controller: built with every warning an error, watched by sanitizers, equal to Python."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from thermogrip.cli.main import main
from thermogrip.datasets.errors import UserError
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.export.export import check_export, export_controller
from thermogrip.mpc.native.codegen import write_model
from thermogrip.mpc.native.runtime import compiler
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

needs_gcc = pytest.mark.skipif(compiler() is None or shutil.which("make") is None, reason="no gcc here")


@pytest.fixture(scope="module")
def controller(tank_maker) -> Controller:
    plant = tank_maker(joule=0.05)
    return Controller(plant, default_design(plant, limits={"t_tank": (8.0, 45.0)}))


@needs_gcc
def test_c_and_python_do_the_same_from_random_states(controller, tmp_path):
    export = export_controller(controller, tmp_path)
    found = check_export(export, controller, states=300)
    assert found.difference <= 1e-9
    assert found.same_status == found.same_iterations == 300
    assert found.passed
    assert found.free > 60
    assert found.ram == export.ram  # what Python counts is what sizeof says
    assert found.flash > export.constants
    assert 0 < found.stack < 10_000
    done = subprocess.run([tmp_path / "example"], capture_output=True, text=True, check=True)
    last = done.stdout.splitlines()[-1].split()
    assert abs(float(last[3]) - float(last[5])) < 0.02  # its own loop settles


CPP = """
#include "tg_model.h"
#include "tg_design.h"
#include <cmath>
#include <cstdio>
static tg_controller controller;
int main() {
    double y[TG_NY], d[TG_SOME(TG_ND)], target[TG_NC];
    for (double &value : y) value = 25.0;
    for (double &value : d) value = 22.0;
    for (double &value : target) value = 30.0;
    tg_reset(&controller, &tg_the_design, y, d);
    tg_qp_forget(&controller.qp);
    const tg_move move = tg_step(&controller, NAN, y, d, nullptr, target);
    double next[TG_NX];
    tg_model_next(controller.x, move.drive, d, tg_the_design.k, next);
    std::printf("%.17g %s", move.drive[0], tg_status_text(move.status));
}
"""


@needs_gcc
@pytest.mark.skipif(shutil.which("g++") is None, reason="no g++ here")
@pytest.mark.parametrize("make", [None, "heater"])
def test_a_program_in_cpp_includes_links_and_steps_an_export(controller, make, tmp_path):
    controller = controller if make is None else heater()
    export_controller(controller, tmp_path)
    (tmp_path / "main.cpp").write_text(CPP)
    warn = ["-std=c++11", "-Wall", "-Wextra", "-Wconversion", "-pedantic", "-Werror"]
    subprocess.run(["make", "-s", "-C", tmp_path, "libtg.a"], check=True)
    words = ["g++", *warn, "main.cpp", "libtg.a", "-lm", "-o", "cpp"]
    built = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    drive, status = subprocess.run(
        [tmp_path / "cpp"], capture_output=True, text=True, check=True
    ).stdout.split()
    model = controller.model
    reading = dict.fromkeys(model.outputs, 25.0) | dict.fromkeys(model.disturbances, 22.0)
    controller.reset(reading)
    move = controller.step(reading, dict.fromkeys(controller.controlled, 30.0))
    assert status == move.status == "ok"
    ours = move.drive if isinstance(move.drive, float) else move.drive[model.drives[0]]
    assert float(drive) == pytest.approx(ours, abs=1e-9)


@needs_gcc
def test_a_wrong_number_in_the_export_is_found(controller, tmp_path):
    export = export_controller(controller, tmp_path)
    design = tmp_path / "tg_design.c"
    text = design.read_text()
    wrong = re.sub(r"\.move = ([0-9.e-]+),", r".move = 1.01 * \1,", text)
    assert wrong != text
    design.write_text(wrong)
    assert not check_export(export, controller, states=20, sanitize=False).passed


def heater(**changes) -> Controller:
    """One drive, one output, nothing measured beside."""
    a = float(np.exp(-0.05))
    A, B = [[a, 40 * (1 - a)], [0, 0]], [[0], [1]]
    model = StateSpaceModel(("q",), (), ("t",), A=A, B=B, C=[[1.0, 0]], dt=5.0, y0=[25.0])
    plant = Plant(model, {}, dt=5.0, units={"q": "1"}, valid={"q": (0.0, 1.0), "t": (20.0, 60.0)})
    return Controller(plant, default_design(plant, **changes))


def kit(**changes) -> Controller:
    """Two heaters, two sensors, a fan's room: drives in percent."""
    model = load_network("tclab")
    values = dict(zip(model.parameters, model.prior.tolist(), strict=True))
    valid = dict.fromkeys(model.inputs, (0.0, 100.0)) | dict.fromkeys(model.outputs, (20.0, 60.0))
    plant = Plant(model, values, dt=model.dt, units=model.units, valid=valid)
    return Controller(plant, default_design(plant, dt=5.0, **changes))


@needs_gcc
@pytest.mark.parametrize(
    ("make", "changes"),
    [
        (heater, {}),
        (heater, {"offset_free": False, "limits": {"t": (10.0, 55.0)}}),
        (heater, {"blocks": (1,), "move_delay": 1}),
        (kit, {}),
        (kit, {"controlled": ("t2",), "limits": {"t1": (0.0, 50.0)}}),
    ],
)
def test_controllers_of_any_size_build_and_do_the_same(make, changes, tmp_path):
    controller = make(**changes)
    found = check_export(export_controller(controller, tmp_path), controller, states=40)
    assert found.difference <= 1e-9
    assert found.same_status == found.same_iterations == 40
    assert found.passed


@needs_gcc
def test_more_rows_at_their_bounds_than_unknowns_and_soft_rows_are_no_trouble(tmp_path):
    # ranges, and slews that end on them, beside a band that is broken at every sample
    controller = kit(blocks=(1, 2, 3))
    found = check_export(export_controller(controller, tmp_path), controller, states=40, seed=3)
    assert found.same_status == found.same_iterations == 40
    assert found.difference <= 1e-9


@pytest.mark.skipif(os.name == "nt", reason="links need a privilege there")
def test_an_export_is_not_written_through_a_link(tmp_path):
    (tmp_path / "elsewhere").write_text("somebody's")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "tg_qp.c").symlink_to(tmp_path / "elsewhere")
    export_controller(heater(), tmp_path / "out")
    assert (tmp_path / "elsewhere").read_text() == "somebody's"


@pytest.mark.parametrize(("make", "most"), [(heater, 1e-9), (kit, 1.0)])
def test_the_readme_says_how_far_the_state_at_rest_may_be_off(make, most, tmp_path):
    export_controller(make(), tmp_path)
    text = " ".join((tmp_path / "README.md").read_text().split())
    (off,) = re.findall(r"the full solution by at most (\S+) degC", text)
    assert 0 <= float(off) < most  # a linear plant's map is exact; the kit radiates, so its is nearly


def test_the_example_of_the_readme_has_a_target_for_every_output(tmp_path):
    export_controller(kit(), tmp_path)
    assert "double target[2] = {35.0, 35.0};" in (tmp_path / "README.md").read_text()


def test_an_export_asks_for_no_memory_and_for_nothing_of_python(controller, tmp_path):
    export = export_controller(controller, tmp_path)
    assert {"Makefile", "README.md", "tg_controller.h", "tg_design.c", "example.c"} <= set(export.files)
    for path in tmp_path.glob("tg_*.[ch]"):
        text = path.read_text()
        assert not re.search(r"\b(malloc|calloc|realloc|free|alloca)\s*\(", text), path.name
        includes = set(re.findall(r"#include <(.*?)>", text))
        assert includes <= {"math.h", "string.h"}, path.name
    readme = (tmp_path / "README.md").read_text()
    assert f"{export.ram} bytes" in readme
    assert not re.search(r"\{\w*[:}]", readme)  # nothing left to fill in


def test_without_gcc_a_check_is_refused_in_one_line(controller, tmp_path, monkeypatch):
    export = export_controller(controller, tmp_path)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(UserError, match="no gcc here"):
        check_export(export, controller, states=1)


@pytest.mark.parametrize("name", ["gripper", "peltier_chamber", "tclab"])
def test_what_the_parameters_fix_is_worked_out_without_a_compiler(name):
    model = load_network(name)
    drives = [i for i, key in enumerate(model.inputs) if key not in model.switches]
    code = write_model(model, drives, model.dt, name="tg_model")
    k = code.constants(model.prior.tolist())
    assert len(k) == code.n_k
    assert np.isfinite(k).all()
    # every constant has a reader, and no reader is without one
    read = {int(entry) for entry in re.findall(r"\bk\[(\d+)\]", code.source.split("_next(", 1)[1])}
    assert read == set(range(code.n_k))


def test_the_export_of_another_design_is_another_export(controller, tmp_path):
    export_controller(controller, tmp_path / "a")
    other = Controller(controller.plant, replace(controller.design, move=3.0))
    export_controller(other, tmp_path / "b")
    texts = [(tmp_path / name / "tg_design.c").read_text() for name in "ab"]
    assert texts[0] != texts[1]


def test_the_command_writes_the_folder_and_says_what_it_takes(controller, tmp_path, capsys):
    file = controller.save(tmp_path / "controller.json")
    assert main(["export", str(file), "--out", str(tmp_path / "c99"), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["ram"] > said["constants"] > 0
    assert (tmp_path / "c99" / "Makefile").is_file()


@needs_gcc
def test_the_command_checks_what_it_wrote(controller, tmp_path, capsys):
    file = controller.save(tmp_path / "controller.json")
    words = ["--out", str(tmp_path / "c99"), "--check", "--states", "5", "--json"]
    assert main(["export", str(file), *words]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["passed"]
    assert said["same_iterations"] == said["states"] == 5
