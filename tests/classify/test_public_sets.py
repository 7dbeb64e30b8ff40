"""The benchmark's readers of public sets, on files of the published form that are made here."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from thermogrip.datasets.errors import UserError

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "classify" / "public_sets.py"


@pytest.fixture(scope="module")
def sets():
    spec = importlib.util.spec_from_file_location("public_sets", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def counts(t):
    """Return what a BioTac reads at a temperature: its thermistor in its divider, 12 bits."""
    ratio = np.exp(4025.0 / (t + 273.15))
    return 4095 * 155183.0 / (ratio + 46555.0)


def python_2_pickle(array, quote="'"):
    """Return an array as Python 2 pickled it, protocol 0, by columns as numpy kept a transposed one."""
    text = "".join(f"\\x{byte:02x}" for byte in np.asfortranarray(array).tobytes("F"))
    rows, columns = array.shape
    return (
        f"cnumpy.core.multiarray\n_reconstruct\np1\n(cnumpy\nndarray\np2\n(I0\ntS'b'\ntRp3\n(I1\n(I{rows}\nI{columns}\n"
        f"tcnumpy\ndtype\np4\n(S'f8'\nI0\nI1\ntRp5\n(I3\nS'<'\nNNNI-1\nI-1\nI0\ntbI01\nS{quote}{text}{quote}\ntb."
    ).encode()


@pytest.fixture
def holds(tmp_path):
    """Two objects, three holds each, one of them a sample longer."""
    for k, name in enumerate(("steel_vase_702", "acrylic_211")):
        for trial in (1, 2, 3):
            t = 49.0 - k - 0.05 * np.arange(1000 + trial % 2) / 100 - 0.1 * trial
            file = tmp_path / f"{name}_{trial:02d}_HOLD.mat"
            savemat(file, {"F0tdc": np.round(counts(t)).astype("<u2")[None], "F1tdc": np.zeros((1, 4))})
    return tmp_path


def test_a_hold_is_the_core_temperature_of_finger_0(sets, holds):
    g = sets.read_hold(holds)
    names = [f"{o}_{t:02d}" for o in ("acrylic", "steel_vase") for t in (1, 2, 3)]
    assert g["grasp"].values.tolist() == names
    assert g["material"].values.tolist() == ["acrylic"] * 3 + ["steel vase"] * 3
    assert g["block"].values[-1] == "steel_vase_702"
    assert g["session"].values[:3].tolist() == ["pair1", "pair1", "pair2"]
    after = g["time"].values > 0
    np.testing.assert_allclose(g["time"].values[after], 0.05 + 0.1 * np.arange(100))
    want = 47.9 - 0.05 * (g["time"].values[after] - 0.005)
    np.testing.assert_allclose(g["t_surface"].values[0, after], want, atol=0.01)  # a count is 0.014 K
    before = g["t_surface"].values[:, ~after]
    assert before.shape[1] >= 3
    np.testing.assert_array_equal(before, np.repeat(g["t_gripper"].values[:, None], before.shape[1], axis=1))
    np.testing.assert_array_equal(g["t_gripper"], g["t_surface"].values[:, after][:, 0])
    assert "t_object" not in g


@pytest.mark.parametrize("quote", ["'", '"'])
def test_the_two_sensors_are_read_without_running_the_pickle(sets, tmp_path, quote):
    time = np.arange(-20, 40) / 200
    rows = np.stack([time, np.full(60, 22.0), 29.5 - np.arange(60) / 9, np.zeros(60), np.ones(60)])
    for n, kind in ((1, "CW_count_2"), (12, "M_count_0")):
        folder = tmp_path / f"R_{n}"
        folder.mkdir()
        warmer = rows.T + n * np.array([0, 1, 1, 0, 0])
        (folder / f"{kind}_sensor_29.5.pkl").write_bytes(python_2_pickle(warmer, quote))
    for n in [k for k in range(1, 31) if k not in (1, 12)]:
        (tmp_path / f"R_{n}").mkdir()
        (tmp_path / f"R_{n}" / "W_count_4_sensor_29.5.pkl").write_bytes(python_2_pickle(rows.T, quote))
    g = sets.read_toh(tmp_path, every=20)
    assert dict(g.sizes) == {"grasp": 30, "time": 3}
    assert g["material"].values[[0, 1, 11]].tolist() == ["wood_cold", "wood", "aluminium"]
    assert g["session"].values[[0, 11]].tolist() == ["set1", "set12"]
    np.testing.assert_allclose(g["time"], [-0.1, 0.0, 0.1])
    np.testing.assert_allclose(g["t_surface"].values[0], 30.5 - np.array([0, 20, 40]) / 9)
    np.testing.assert_allclose(g["t_surface_2"].values[11], 34.0)


def test_what_is_no_such_set_is_refused_in_one_line(sets, tmp_path, holds):
    with pytest.raises(UserError, match=r"holds no \*.pkl"):
        sets.read_toh(tmp_path)
    savemat(holds / "acrylic_211_02_HOLD.mat", {"F1tdc": np.zeros((1, 4))})
    with pytest.raises(UserError, match=r"acrylic_211_02_HOLD\.mat: has no F0tdc"):
        sets.read_hold(holds)
    (tmp_path / "R_1").mkdir()
    for n in range(1, 31):
        (tmp_path / f"R_{n}").mkdir(exist_ok=True)
        (tmp_path / f"R_{n}" / "M_count_0_sensor_29.5.pkl").write_bytes(b"cos\nsystem\n(S'touch evil'\ntR.")
    with pytest.raises(UserError, match="is no pickled array of numbers"):
        sets.read_toh(tmp_path)
