"""The bundled data, the package's face, and public logs where they are at hand."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import thermogrip.datasets
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import (
    EXAMPLE_LOGS,
    example_grasps,
    example_path,
    load_example_grasps,
    load_example_logs,
)
from thermogrip.datasets.log_files import read_log
from thermogrip.datasets.schema import column
from thermogrip.sysid.contact.materials import find_material


def test_the_logs_hold_what_their_description_says():
    logs = load_example_logs()
    assert tuple(logs) == EXAMPLE_LOGS
    steps = {"prbs_heating_cooling": 0.2, "step_up_down": 0.5, "multisine": 0.1, "pump_on_off": 0.25}
    for name, log in logs.items():
        assert log.attrs["name"] == f"{name}"
        assert np.median(np.diff(log["time"].values)) == pytest.approx(steps[name], rel=0.02)
        assert np.abs(column(log, "drive")).max() <= 1.0
        assert set(np.unique(column(log, "pump"))) <= {0.0, 1.0}
        for t in ("t_tank", "t_surface"):
            values = column(log, t)[np.isfinite(column(log, t))]
            assert 5 < values.min() < values.max() < 65
            assert np.abs(np.diff(values[:30])).max() < 0.5  # at rest in the beginning


def test_there_are_thirteen_sets_of_grasps():
    grasps = load_example_grasps()
    assert tuple(grasps) == example_grasps()
    assert sum(g.sizes["grasp"] for g in grasps.values()) == 2 * 40 + 8 * 24 + 40 + 96 + 18
    for name, g in grasps.items():
        assert g.attrs["name"] == name
        assert np.isfinite(g["t_surface"].values).all()
    ids = np.concatenate([g["grasp"].values for g in grasps.values()])
    assert np.unique(ids).size == ids.size


def test_every_material_of_the_example_grasps_is_in_the_table():
    for g in load_example_grasps().values():
        for name in np.unique(g["material"].values):
            assert find_material(str(name)).effusivity > 0


def test_an_example_that_is_not_there_is_refused_with_the_list():
    with pytest.raises(UserError, match="multisine"):
        example_path("none")


def test_the_data_is_small_and_described():
    folder = example_path("multisine").parent
    assert sum(p.stat().st_size for p in folder.iterdir()) < 3_000_000
    text = (folder / "README.md").read_text(encoding="utf-8")
    assert "simulated, not measured" in text
    for name in EXAMPLE_LOGS:
        assert name in text


def test_every_exported_name_is_there():
    for name in (*thermogrip.datasets.__all__, "gaps"):
        assert getattr(thermogrip.datasets, name) is not None
    assert dir(thermogrip.datasets) == sorted(thermogrip.datasets.__all__)
    assert "gaps" not in thermogrip.datasets.__all__
    assert not hasattr(thermogrip.datasets, "nothing_such")


def test_importing_the_room_loads_nothing_heavy():
    code = (
        "import sys, thermogrip.datasets; "
        "print([m for m in ('xarray', 'pyarrow', 'scipy', 'h5py', 'numpy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


PUBLIC = Path(os.environ.get("THERMOGRIP_REAL_DATA", Path(__file__).parents[3] / "shared" / "data" / "real"))
needs_public = pytest.mark.skipif(
    not PUBLIC.is_dir(), reason=f"no measurements of other labs in {PUBLIC} (set THERMOGRIP_REAL_DATA)"
)


@needs_public
@pytest.mark.parametrize(
    ("name", "roles"),
    [
        ("tclab_prbs.csv", {"q1": "input", "q2": "input", "t1": "output", "t2": "output"}),
        (
            "peltier_chamber.csv",
            {"pwm": "input", "chamber": "output", "ambient": "disturbance", "setpoint": "other"},
        ),
        ("cascaded_tanks_train.csv", {"pump": "input", "level": "output"}),
        ("heat_exchanger.csv", {"flow": "input", "outlet": "output"}),
    ],
)
def test_measured_logs_are_read_with_the_right_roles_and_hardly_touched(name, roles):
    log = read_log(PUBLIC / name)
    assert {str(n): v.attrs["role"] for n, v in log.data_vars.items()} == roles
    assert sum(int(np.isnan(v.values).sum()) for v in log.data_vars.values()) <= 1


@needs_public
def test_the_one_glitch_of_the_heater_board_is_the_only_spike():
    # 46.357, 40.718, 46.325 degC around 1789 s
    assert read_log(PUBLIC / "tclab_prbs.csv").attrs["repairs"] == (
        "t1: 1 spike sample rejected (40.718 at 1789.00 s)"
    )
