"""An exported controller: built with every warning an error, watched by sanitizers, equal to Python."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.mpc.makers import heater, kit
from thermogrip.datasets.errors import UserError
from thermogrip.mpc.controllers import export as exports
from thermogrip.mpc.controllers.export import Agreement, Export, check_export, export_controller
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.native.codegen import write_model
from thermogrip.mpc.native.runtime import compiler
from thermogrip.sysid.models.network import load_network

needs_gcc = pytest.mark.skipif(compiler() is None or shutil.which("make") is None, reason="no gcc here")


def long(*values: Any) -> Any:
    """Return a case whose build is left to the long tests."""
    return pytest.param(*values, marks=pytest.mark.slow)


@pytest.fixture(scope="module")
def controller(tank_maker) -> Controller:
    plant = tank_maker(joule=0.05)
    return Controller(plant, default_design(plant, limits={"t_tank": (8.0, 45.0)}))


def run_example(export: Export) -> subprocess.CompletedProcess[str]:
    subprocess.run(["make", "-s", "-C", export.folder, "example"], check=True)
    return subprocess.run([export.folder / "example"], capture_output=True, text=True, check=True)


@needs_gcc
def test_c_and_python_do_the_same_in_random_loops(controller, tmp_path):
    """The plan of the program costs more than the last one in a third of the samples: another is tried."""
    export = export_controller(controller, tmp_path)
    found = check_export(export, controller, states=600)
    assert found.difference <= 1e-9
    assert found.same_status == 600
    assert found.passed
    assert found.free > 140
    assert found.ram > 8 * controller.model.n_x**2  # its covariance, for one
    assert found.flash > found.constants > 0
    assert 0 < found.stack < 10_000
    done = run_example(export)
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
def test_a_program_in_cpp_includes_links_and_steps_an_export(tmp_path):
    controller = heater()
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
@pytest.mark.skipif(compiler() is None or shutil.which("g++") is None, reason="no g++ here")
def test_an_arduino_library_is_laid_out_builds_and_runs_its_example(controller, tmp_path):
    written = export_controller(controller, tmp_path / "library", arduino=True)
    folder = written.folder
    assert {path.name for path in folder.iterdir()} == {"library.properties", "README.md", "src", "examples"}
    lines = dict(line.split("=", 1) for line in (folder / "library.properties").read_text().splitlines())
    wanted = "name version author maintainer sentence paragraph category url architectures includes"
    assert list(lines) == wanted.split()
    assert (folder / "examples" / "loop" / "loop.ino").is_file()
    objects = []
    for source in sorted((folder / "src").glob("*.c")):
        objects.append(str(tmp_path / f"{source.stem}.o"))
        subprocess.run(["gcc", "-std=gnu17", "-c", str(source), "-o", objects[-1]], check=True)
    # what an IDE puts around a sketch; its sensor reads 25 degC after ten readings
    stub = """#include <cmath>
#include <cstdio>
struct { void begin(long) {} void print(const char *s) { std::printf("%s", s); }
         void println(const char *s) { std::printf("%s\\n", s); } } Serial;
static unsigned long now_ms = 0;
static unsigned long millis() { return now_ms; }
static void delay(unsigned long ms) { now_ms += ms; }
#include "loop.cpp"
int main() { setup(); for (int k = 0; k < 60; k++) loop(); std::printf("drive %g\\n", controller.u[0]); }
"""
    sketch = (folder / "examples" / "loop" / "loop.ino").read_text()
    for sensor, said, moved in (("NAN", "off", False), ("25.0", "ok", True)):
        (tmp_path / "loop.cpp").write_text(sketch.replace("return NAN;", f"return {sensor};"))
        (tmp_path / "board.cpp").write_text(stub)
        program = tmp_path / f"board_{said}"
        command = ["g++", "-std=gnu++17", f"-I{folder / 'src'}", str(tmp_path / "board.cpp"), *objects, "-lm"]
        subprocess.run([*command, "-o", str(program)], check=True)
        told = subprocess.run([str(program)], check=True, capture_output=True, text=True).stdout.splitlines()
        assert told[-2].startswith(said)
        assert (told[-1] != "drive 0") is moved


def test_a_wrong_number_in_the_export_is_found(controller, tmp_path):
    export = export_controller(controller, tmp_path)
    design = tmp_path / "tg_design.c"
    text = design.read_text()
    wrong = re.sub(r"\.move = ([0-9.e-]+),", r".move = 1.01 * \1,", text)
    assert wrong != text
    design.write_text(wrong)
    assert not check_export(export, controller, states=100, sanitize=False).passed


@needs_gcc
@pytest.mark.parametrize(
    ("make", "changes", "sanitize"),
    [
        (heater, {"ramp_per_s": {"t": 0.1}, "limits": {"t": (22.0, 40.0)}}, False),
        (
            kit,
            {
                "zones": {"t1": 1.5},
                "limits": {"t1": (20.0, 42.0), "t2": (15.0, 41.0)},
                "hard": ("t2",),
                "weights": {"t1": 2.0},
            },
            True,
        ),
        (
            kit,
            {
                "zones": {"t1": 1.5, "t2": 0.5},
                "energy_price": {"q1": 0.5, "q2": 2.0},
                "ramp_per_s": {"t2": 0.02},
            },
            False,
        ),
        long(heater, {"blocks": (1, 2, 3), "zones": {"t": 1.0}, "energy_price": {"q": 0.3}}, False),
        long(heater, {"limits": {"t": (10.0, 55.0)}}, False),
        long(heater, {"blocks": (1,)}, True),
        long(kit, {"dt": 10.0, "controlled": ("t2",), "limits": {"t1": (0.0, 50.0)}}, True),
        long(kit, {"blocks": (1, 2, 3)}, True),  # slews that end on ranges, a broken band
    ],
)
def test_controllers_of_any_size_build_and_do_the_same(make, changes, sanitize, tmp_path):
    controller = make(**changes)
    export = export_controller(controller, tmp_path)
    found = check_export(export, controller, states=40, sanitize=sanitize)
    assert found.difference <= (1e-6 if "hard" in changes else 1e-9)
    assert found.same_status == 40
    assert found.passed


@pytest.mark.skipif(os.name == "nt", reason="links need a privilege there")
def test_an_export_is_not_written_through_a_link(tmp_path):
    (tmp_path / "elsewhere").write_text("somebody's")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "tg_qp.c").symlink_to(tmp_path / "elsewhere")
    export_controller(heater(), tmp_path / "out")
    assert (tmp_path / "elsewhere").read_text() == "somebody's"


def test_an_export_asks_for_no_memory_and_for_nothing_of_python(controller, tmp_path):
    export = export_controller(controller, tmp_path)
    assert {"Makefile", "README.md", "tg_controller.h", "tg_design.c", "example.c"} <= set(export.files)
    for path in tmp_path.glob("tg_*.[ch]"):
        text = path.read_text()
        assert not re.search(r"\b(malloc|calloc|realloc|free|alloca)\s*\(", text), path.name
        includes = set(re.findall(r"#include <(.*?)>", text))
        assert includes <= {"math.h", "string.h"}, path.name
    readme = (tmp_path / "README.md").read_text()
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
    code = write_model(model, drives, model.dt)
    k = code.constants(model.prior.tolist())
    assert len(k) == code.n_k
    assert np.isfinite(k).all()
    # every constant has a reader, and no reader is without one
    read = {int(entry) for entry in re.findall(r"\bk\[(\d+)\]", code.source.split("_hold(", 1)[1])}
    assert read == set(range(code.n_k))


# ---- the check itself ----


@pytest.mark.parametrize(
    ("difference", "status", "passed"), [(1e-9, 7, True), (1.1e-9, 7, False), (0.0, 6, False)]
)
def test_an_export_passes_where_drives_and_statuses_are_the_same(
    difference: float, status: int, passed: bool
):
    assert Agreement(7, difference, 3, status, 1, 1, 1, 1).passed == passed


def test_the_readme_gives_the_controllers_own_numbers(tmp_path: Path):
    controller = kit(limits={"t1": (0.0, 50.0)})
    exports.export_controller(controller, tmp_path)
    text = " ".join((tmp_path / "README.md").read_text().split())
    assert "q1 in [0, 100]; q2 in [0, 100]" in text
    assert "double target[2] = {35.0, 35.0};" in text


def test_the_stack_is_the_largest_frame_of_the_library(tmp_path: Path):
    (tmp_path / "tg_a.su").write_text("a.c:1:2:f\t64\tstatic\na.c:9:2:g\t1200\tstatic\n")
    (tmp_path / "tg_b.su").write_text("b.c:1:2:h\t320\tstatic\n")
    (tmp_path / "check.su").write_text("check.c:1:2:main\t9000\tstatic\n")  # not of the library
    if shutil.which("size") is not None:
        assert exports.footprint(tmp_path)[1] == 1200
