"""NetCDF files as the CF conventions have them, looked at with h5py and rules of their own."""

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

UDUNITS = {"1", "degC", "percent", "V", "A", "W", "s", repr(1 / 255)}  # what udunits2 knows of ours


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


def text(value: object) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)


def assert_cf(path: Path) -> None:
    with h5py.File(path) as file:
        assert text(file.attrs["Conventions"]).startswith("CF-1.")
        assert text(file.attrs["title"]) == "warm"
        of_scale = {"CLASS", "NAME", "_Netcdf4Dimid", "_Netcdf4Coordinates"}
        for name, variable in file.items():
            if "NAME" in variable.attrs and text(variable.attrs["NAME"]).startswith(
                "This is a netCDF dimension"
            ):
                continue  # a dimension without a coordinate
            attrs = {key: value for key, value in variable.attrs.items() if key not in of_scale}
            coordinate = variable.shape == (file[name].shape[0],) and "NAME" in variable.attrs
            if coordinate:
                assert variable.dtype.kind in "fiu", name
                assert np.all(np.diff(variable[:]) > 0), name
                assert "_FillValue" not in attrs, name
            if variable.dtype.kind in "fiu":
                assert text(attrs["units"]) in UDUNITS, name
                assert attrs["long_name"], name
                assert (text(attrs["units"]) == "degC") == ("units_metadata" in attrs), name
            if "flag_meanings" in attrs:
                assert attrs["flag_values"].dtype == variable.dtype, name
                assert len(attrs["flag_values"]) == len(text(attrs["flag_meanings"]).split()), name
                assert set(variable[:]) <= set(attrs["flag_values"]), name
            for auxiliary in text(attrs.get("coordinates", "")).split():
                assert auxiliary in file, name


def test_a_log_and_grasps_are_written_by_the_conventions(log: Log, grasps: Grasps, tmp_path: Path) -> None:
    assert_cf(write_log(log, tmp_path / "log.nc"))
    assert_cf(write_grasps(grasps, tmp_path / "grasps.nc"))
    with h5py.File(tmp_path / "grasps.nc") as file:
        assert text(file["t_surface"].attrs["coordinates"]) == "grasp_id"
        assert text(file["t_object"].attrs["units_metadata"]) == "temperature: on_scale"
        assert text(file["t_object_sd"].attrs["units_metadata"]) == "temperature: difference"
        named = {name: text(file[name].attrs["long_name"]) for name in ("time", "t_surface", "rest")}
        assert named == {"time": "time since the gripper closed", "t_surface": "temperature of the skin",
                         "rest": "time since the touch before"}  # fmt: skip
        skin = file["t_surface"]
        assert (skin.compression, skin.compression_opts, skin.fletcher32) == ("gzip", 4, True)
        assert np.isnan(skin.attrs["_FillValue"])
    with h5py.File(tmp_path / "log.nc") as file:
        assert file["phase"].attrs["flag_values"].tolist() == [0, 1, 2]
        assert file["phase"].dtype == np.int8
        named = [text(file[n].attrs["long_name"]) for n in ("time", "drive")]
        assert named == ["time of the log", "drive (input)"]
        assert text(file.attrs["source"]) == "thermogrip"
        assert file["pwm"][5] * float(text(file["pwm"].attrs["units"])) == pytest.approx(250 / 255)


def test_they_are_read_back_as_they_were(log: Log, grasps: Grasps, tmp_path: Path) -> None:
    back = read_log(write_log(log, tmp_path / "log.nc"))
    assert back.drop_attrs().identical(log.drop_attrs())
    assert {n: dict(back[n].attrs) for n in back.data_vars} == {n: dict(log[n].attrs) for n in log.data_vars}
    assert back.attrs["repairs"] == log.attrs["repairs"]
    assert set(back.attrs) - {"sha256", "guesses"} == set(log.attrs)  # what reading a file adds
    assert read_grasps(write_grasps(grasps, tmp_path / "grasps.nc")).identical(grasps)


def test_files_of_before_are_still_read(log: Log, grasps: Grasps, tmp_path: Path) -> None:
    log.to_netcdf(tmp_path / "log.nc", engine="h5netcdf")
    grasps.to_netcdf(tmp_path / "grasps.nc", engine="h5netcdf")
    assert read_log(tmp_path / "log.nc")["pwm"].identical(log["pwm"])
    assert read_grasps(tmp_path / "grasps.nc").identical(grasps)


def test_phases_that_are_no_counts_keep_their_type_and_a_record_without_a_name_has_a_title(log: Log) -> None:
    log["phase"].values[:] = [0, 1, 0.5, 2, 1, 300]
    del log.attrs["name"], log["drive"].attrs["role"]
    found = netcdf.as_cf(log)
    assert (found["phase"].dtype, found["phase"].attrs["flag_values"].dtype) == (float, float)
    assert (found.attrs["title"], found["drive"].attrs["long_name"]) == ("record", "drive (other)")
    assert netcdf.from_cf(found).attrs == log.attrs
    other = netcdf.as_cf(log).assign_attrs(schema="other")
    assert netcdf.from_cf(other).attrs["source"] == "thermogrip"


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
        netcdf.check_hdf5(file, tmp_path / "a.nc")
        each = [800, 80, 60, 3 * size, 24]  # by their names
        assert declared == [(size, total) for total in np.cumsum(each)]
        for part, most, limit, found in (  # of 3, 5 and 7 letters and 64 bytes each, some at a time
            (0, 1000, 24, 67 + 69 + 71), (2, 1000, 24, 207), (2, 60, 24, 136), (0, 60, 24, 67),
            (0, 67, 24, 136), (0, 1000, 23, 24), (3, 60, 24, 24),
        ):  # fmt: skip
            monkeypatch.setattr(netcdf, "_PART", part * size)
            monkeypatch.setattr(netcdf, "most_unpacked", lambda _, most=most: most)
            monkeypatch.setattr(netcdf, "most_bytes", lambda limit=limit: limit)
            assert netcdf._in_memory(file["words"]) == found


def test_text_of_any_kind_is_text_and_units_are_those_of_the_conventions() -> None:
    data = xr.Dataset({"a": (("x", "y"), np.array([[b"p", b"qq"]])), "b": ("x", np.array([1.5], object))})
    found = netcdf.text_as_str(data)
    assert (found["a"].values.tolist(), found["b"].values.tolist()) == ([["p", "qq"]], ["1.5"])
    ours = [netcdf.convention_unit(unit, "a", "f") for unit in ("degrees_C", "%", "", repr(1 / 255), "V")]
    assert ours == ["degC", "percent", "1", "0_255", "V"]
    values, unit = netcdf.record_unit(xr.DataArray([300, 301], attrs={"units": "kelvin"}), "a", "f")
    assert (values.round(9).tolist(), unit) == ([26.85, 27.85], "degC")
    for array, words in (
        (xr.DataArray(["x"]), "f, column a: holds <U1, not numbers; leave it out"),
        (xr.DataArray([1.0]), "f, column a: has no unit; set its attribute units"),
        (xr.DataArray([1.0], attrs={"units": "bar"}), "f, column a: unit 'bar' is unknown; use one of"),
    ):
        with pytest.raises(UserError, match=re.escape(words)):
            netcdf.record_unit(array, "a", "f")


def test_times_with_a_date_and_lapses_stay_numbers(tmp_path: Path) -> None:
    data = xr.Dataset({"wait": ("time", [1.0, 2.0], {"units": "minutes"})}, {"time": [0.0, 1.0]})
    data["time"].attrs["units"] = "seconds"
    data.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    found = netcdf.open_netcdf(tmp_path / "a.nc")
    assert (found["wait"].values.tolist(), found["time"].values.tolist()) == ([1.0, 2.0], [0.0, 1.0])
    data["time"].attrs["units"] = "seconds since 2026-01-01"
    data.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    assert netcdf.open_netcdf(tmp_path / "a.nc")["time"].values.tolist() == [0.0, 1.0]
