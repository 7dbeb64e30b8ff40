"""Grasps without xarray: each part of the record as xarray has it, and by xarray what is no part of it."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import xarray as xr

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import example_path
from thermogrip.datasets.grasp_files import read_grasps, write_grasps
from thermogrip.datasets.netcdf import open_plain_netcdf
from thermogrip.datasets.plain_record import PlainGrasps, is_record
from thermogrip.datasets.schema import log_name, make_grasps, make_plain_grasps

NAME = "exp2_dT20"


@pytest.fixture(scope="module")
def both():
    return read_grasps(example_path(NAME)), read_grasps(example_path(NAME), plain=True)


def check_same(plain, record):
    """Check that two records are the same in every part."""
    assert isinstance(plain, PlainGrasps)
    assert isinstance(record, xr.Dataset)
    assert set(plain.variables) == set(record.variables)
    assert plain.sizes == {name: record.sizes[name] for name in plain.sizes}
    assert plain.attrs == record.attrs
    for name, found in plain.variables.items():
        np.testing.assert_array_equal(found.values, record.variables[name].values)
        assert (found.dims, found.attrs, found.dtype.kind) == (
            record.variables[name].dims, record.variables[name].attrs, record.variables[name].dtype.kind,
        )  # fmt: skip


def test_a_file_is_the_same_record_with_and_without_xarray(both, tmp_path):
    record, plain = both
    check_same(plain, record)
    path = write_grasps(record, tmp_path / f"{NAME}.nc")
    check_same(read_grasps(path, plain=True), read_grasps(path))
    assert (len(plain), log_name(plain), is_record(plain), is_record(record)) == (24, NAME, True, True)
    assert not is_record(plain["t_surface"])


def test_parts_of_it_are_those_of_xarray(both):
    record, plain = both
    mask = np.arange(24) % 3 == 0
    hot = plain["t_surface"].values > 30.0
    for of in (
        lambda g: g.isel(grasp=mask),
        lambda g: g.isel(grasp=[5, 2]),
        lambda g: g.isel(grasp=slice(3, 9)),
        lambda g: g.sel(time=slice(None, 3.05)),
        lambda g: g.sel(time=slice(-1.0, 3.0)),
        lambda g: g.assign(t_object=("grasp", np.arange(24.0))),
        lambda g: g.assign(t_surface=g["t_surface"].where(~hot)),
        lambda g: g.drop_vars("t_object"),
        lambda g: g.drop_vars("t_surface_2", errors="ignore"),
        lambda g: g[["t_surface", "material"]],
    ):
        check_same(of(plain), of(record))
    assert sorted(plain) == sorted(map(str, record))
    np.testing.assert_array_equal(np.asarray(plain["t_object"]), record["t_object"].values)
    check_same(plain, record)  # nothing of it was changed


def test_what_it_has_not_the_data_set_of_the_same_values_answers(both):
    record, plain = both
    xr.testing.assert_identical(plain.sel(time=[1.0, 2.0], method="nearest"),
                                record.sel(time=[1.0, 2.0], method="nearest"))  # fmt: skip
    xr.testing.assert_identical(plain.mean(), record.mean())
    xr.testing.assert_identical(plain[[1, 3]], record[[1, 3]])
    with pytest.raises(ValueError, match="t_surface_2"):
        plain.drop_vars("t_surface_2")
    with pytest.raises(AttributeError):
        plain.no_such_thing  # noqa: B018


def test_it_is_checked_as_any_record_is():
    with pytest.raises(UserError, match="t_object of 900 degC"):
        make_plain_grasps([-0.1, 0.1], [[23.0, 24.0]], ["a"], t_object=[900.0])
    with pytest.raises(UserError, match="has no 'weight'"):
        make_plain_grasps([-0.1, 0.1], [[23.0, 24.0]], ["a"], weight=[1.0])


def test_a_file_that_begins_at_contact_gets_its_level_before(tmp_path):
    made = make_grasps([0.0, 0.1, 0.2], [[23.0, 24.0, 25.0]], ["a"], t_gripper=[23.0])
    path = write_grasps(made, tmp_path / "late.csv")
    xr.testing.assert_identical(read_grasps(path, plain=True), read_grasps(path))


@pytest.mark.parametrize("change", ["packed", "other", "fill"])
def test_netcdf_of_others_is_left_to_xarray(tmp_path, change):
    made = make_grasps([-0.1, 0.1], [[23.0, 24.5]], ["a"])
    encoding = {}
    if change == "packed":
        encoding = {
            "t_surface": {"dtype": "int16", "scale_factor": 0.5, "add_offset": 20.0, "_FillValue": -9}
        }
    elif change == "fill":
        made["t_surface"].values[0, 1] = -1.0
        encoding = {"t_surface": {"_FillValue": -1.0}}
    else:
        del made.attrs["schema"]
    made.drop_vars("grasp").assign_coords(grasp_id=("grasp", ["a"])).to_netcdf(
        tmp_path / "g.nc", engine="h5netcdf", encoding=encoding
    )
    assert open_plain_netcdf(tmp_path / "g.nc") is None


def test_a_grasp_is_answered_without_what_takes_seconds_to_import(tmp_path):
    """By kernels that were compiled before; the first answer may need numba, the second must not."""
    path = tmp_path / "one.csv"
    write_grasps(read_grasps(example_path(NAME)).isel(grasp=[0]), path)
    code = f"""
import sys
from thermogrip.datasets.grasp_files import read_grasps
from thermogrip.classify.decisions.predict import classify_grasps
from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
model = PosteriorClassifier().with_device(load_default_gripper())
row, = classify_grasps(model, read_grasps({str(path)!r}, plain=True), ["copper", "wood"])
print(row["material"], repr(row["p_unknown"]), [m for m in sys.argv[1:] if m in sys.modules])
"""
    heavy = ["xarray", "pandas", "pyarrow", "scipy", "numba", "sklearn", "torch", "casadi"]
    said = [
        subprocess.run(
            [sys.executable, "-c", code, *heavy], check=True, capture_output=True, text=True
        ).stdout
        for _ in range(2)
    ]
    assert said[1].startswith("copper ")
    assert said[1].split("[")[0] == said[0].split("[")[0]  # the same answer, to the last bit
    if sys.platform == "linux":
        assert said[1].endswith("[]\n")
