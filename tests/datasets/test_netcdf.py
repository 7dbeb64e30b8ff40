"""NetCDF files as the CF conventions have them, looked at with h5py and rules of their own."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

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
    with h5py.File(tmp_path / "log.nc") as file:
        assert file["phase"].attrs["flag_values"].tolist() == [0, 1, 2]
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
