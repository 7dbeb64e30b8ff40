"""NetCDF files: what is written is read back, older ones too, and none declares more than it may hold."""

from __future__ import annotations

import re
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr

from thermogrip.datasets import netcdf
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.grasp_files import read_grasps, write_grasps
from thermogrip.datasets.log_files import read_log, write_log
from thermogrip.datasets.schema import Grasps, Log, make_grasps, make_log


@pytest.fixture
def log() -> Log:
    t = np.arange(6.0)
    made = make_log(
        t,
        {
            "drive": (t / 6, "1", "input"), "duty": (10 * t, "percent", "input"),
            "pwm": (50 * t, "0_255", "input"),
            "t_tank": (np.where(t == 3, np.nan, 25 + t), "degC", "output"), "phase": (t // 2, "1", "other"),
        },
        name="warm", repairs=["t_tank: 1 lost sample left empty"],
    )  # fmt: skip
    made["phase"].attrs["flag_meanings"] = "settle hold contact"
    return made


@pytest.fixture
def grasps() -> Grasps:
    skin = [[23.0, 23.0, 24.0], [23.0, np.nan, 25.0]]
    labels = {
        "material": ["copper", "wood"],
        "split": ["train", ""],
        "session": ["a", "b"],
        "block": ["c", "d"],
    }
    numbers = {"t_object": [43.0, np.nan], "t_object_sd": [0.1, 0.2], "rest": [np.nan, 60.0]}
    return make_grasps([-0.1, 0.0, 0.1], skin, ["g0", "g1"], name="warm", **labels, **numbers)


def test_they_are_read_back_as_they_were(log: Log, grasps: Grasps, tmp_path: Path) -> None:
    back = read_log(write_log(log, tmp_path / "log.nc"))
    assert back.drop_attrs().identical(log.drop_attrs())
    assert {n: dict(back[n].attrs) for n in back.data_vars} == {n: dict(log[n].attrs) for n in log.data_vars}
    assert back.attrs["repairs"] == log.attrs["repairs"]
    assert set(back.attrs) - {"sha256", "guesses"} == set(log.attrs)  # what reading a file adds
    assert read_grasps(write_grasps(grasps, tmp_path / "grasps.nc")).identical(grasps)


def test_files_of_version_0_2_are_still_read(log: Log, grasps: Grasps, tmp_path: Path) -> None:
    """Its units are those of UDUNITS, and the names of grasps are no coordinate."""
    log["pwm"].attrs["units"] = repr(1 / 255)
    log.to_netcdf(tmp_path / "log.nc", engine="h5netcdf")
    names = grasps["grasp"].values
    older = grasps.drop_vars("grasp").assign_coords(grasp_id=("grasp", names))
    older.to_netcdf(tmp_path / "grasps.nc", engine="h5netcdf")
    back = read_log(tmp_path / "log.nc")
    assert back["pwm"].attrs["units"] == "0_255"
    assert read_grasps(tmp_path / "grasps.nc").identical(grasps)


def test_what_an_array_takes_in_memory_is_what_it_declares(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["abc", "defgh", "ijklmno"]
    with h5py.File(tmp_path / "a.nc", "w") as file:
        file["few"] = np.zeros(10, np.float32)  # read as float of 8 bytes
        file["long"] = np.zeros(3, "S20")
        file.create_dataset("chunk", (10,), np.float64, maxshape=(None,), chunks=(100,))
        file.create_dataset("words", data=words, dtype=h5py.string_dtype())
        file.create_dataset("pairs", data=[words], dtype=h5py.string_dtype())
    with h5py.File(tmp_path / "a.nc") as file:
        size = file.id.get_filesize()
        taken = [netcdf._in_memory(file[name]) for name in ("few", "chunk", "words", "pairs")]
        assert taken == [80, 800, 24, 3 * size]
        declared: list[tuple[int, int]] = []
        monkeypatch.setattr(netcdf, "check_unpacked", lambda *sizes, **_: declared.append(sizes))
        netcdf.check_netcdf(tmp_path / "a.nc")
        each = [800, 80, 60, 3 * size, 24]  # by their names
        assert declared == [(size, total) for total in np.cumsum(each)]
        for part, most, limit, found in (  # of 3, 5 and 7 letters and 64 bytes each, some at a time
            (0, 1000, 24, 67 + 69 + 71), (2, 1000, 24, 207), (2, 60, 24, 136), (0, 60, 24, 67),
            (0, 67, 24, 136), (0, 1000, 23, 24), (3, 60, 24, 24),
        ):  # fmt: skip
            monkeypatch.setattr(netcdf, "_PART", part * size)
            monkeypatch.setattr(netcdf, "most_unpacked", lambda _, most=most: most)
            monkeypatch.setattr(netcdf, "MOST_BYTES", limit)
            assert netcdf._in_memory(file["words"]) == found


def test_text_of_any_kind_is_text_and_units_are_those_of_the_conventions(tmp_path: Path) -> None:
    data = xr.Dataset({"a": (("x", "y"), np.array([[b"p", b"qq"]])), "b": ("x", np.array(["r"], object))})
    data.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    found = netcdf.open_netcdf(tmp_path / "a.nc")
    assert [(v.dtype.kind, v.values.tolist()) for v in found.values()] == [("U", [["p", "qq"]]), ("U", ["r"])]
    ours = [netcdf.convention_unit(unit, "a", "f") for unit in ("degrees_C", "%", "", repr(1 / 255), "V")]
    assert ours == ["degC", "percent", "1", "0_255", "V"]
    for stated, wanted in (({"units": "kelvin"}, "K"), ({}, "")):
        values, unit = netcdf.numbers_and_unit(xr.DataArray([300, 301], attrs=stated), "a", "f")
        assert (values.tolist(), unit) == ([300.0, 301.0], wanted)
    for array, words in (
        (xr.DataArray(["x"]), "f, column a: holds <U1, not numbers; leave it out"),
        (xr.DataArray([1.0], attrs={"units": "bar"}), "f, column a: unit 'bar' is unknown; use one of"),
    ):
        with pytest.raises(UserError, match=re.escape(words)):
            netcdf.numbers_and_unit(array, "a", "f")


def test_times_with_a_date_and_lapses_stay_numbers(tmp_path: Path) -> None:
    data = xr.Dataset({"wait": ("time", [1.0, 2.0], {"units": "minutes"})}, {"time": [0.0, 1.0]})
    data["time"].attrs["units"] = "seconds"
    data.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    found = netcdf.open_netcdf(tmp_path / "a.nc")
    assert (found["wait"].values.tolist(), found["time"].values.tolist()) == ([1.0, 2.0], [0.0, 1.0])
    data["time"].attrs["units"] = "seconds since 2026-01-01"
    data.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    assert netcdf.open_netcdf(tmp_path / "a.nc")["time"].values.tolist() == [0.0, 1.0]
