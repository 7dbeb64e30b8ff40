"""Grasps in Zarr stores: as in NetCDF, slice by slice, and what is refused before it is unpacked."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from thermogrip.datasets import zarr_store
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.grasp_files import (
    check_grasp_file,
    list_grasp_files,
    read_grasps,
    read_stored_grasps,
    write_grasps,
)
from thermogrip.datasets.netcdf import as_cf
from thermogrip.datasets.partitions import sources
from thermogrip.datasets.zarr_store import store_slices

pytest.importorskip("zarr")
GRASPS = load_example_grasps()["exp1A_obj43_grip23"]


def stored(path: Path, zarr_format: int = 2, chunk: int = 10, **options) -> Path:
    """Write the example grasps as a Zarr store."""
    encoding = {"t_surface": {"chunks": (chunk, 60), **options}}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # format 3 has no settled text of fixed length
        as_cf(GRASPS).to_zarr(path, mode="w", zarr_format=zarr_format, consolidated=False, encoding=encoding)
    return path


@pytest.mark.parametrize("zarr_format", [2, 3])
def test_a_store_holds_what_a_netcdf_file_holds(tmp_path, zarr_format):
    store = stored(tmp_path / "warm.zarr", zarr_format)
    check_grasp_file(store)
    found, want = read_grasps(store), read_grasps(write_grasps(GRASPS, tmp_path / "warm.nc"))
    xr.testing.assert_equal(found, want)
    assert found.attrs["name"] == want.attrs["name"]
    assert found["t_object"].attrs == want["t_object"].attrs


def test_a_store_is_read_in_slices_of_whole_chunks(tmp_path, monkeypatch):
    monkeypatch.setattr(zarr_store, "_SLICE", 16)
    store = stored(tmp_path / "warm.zarr", chunk=8)
    assert store_slices(store) == [(0, 16), (16, 32), (32, 40)]
    given = sources([tmp_path])
    assert [each.name for each in given] == ["warm.zarr[0:16]", "warm.zarr[16:32]", "warm.zarr[32:40]"]
    parts = [each.read() for each in given]
    assert [part.sizes["grasp"] for part in parts] == [16, 16, 8]
    whole = read_grasps(store)
    np.testing.assert_array_equal(np.concatenate([p["t_surface"] for p in parts]), whole["t_surface"])
    assert [g for p in parts for g in p["grasp"].values] == whole["grasp"].values.tolist()
    # so that an ended run knows its own
    assert len({str(each.stamp) for each in given}) == 3
    assert [each.stamp for each in sources([store])] == [each.stamp for each in given]
    stored(tmp_path / "warm.zarr", chunk=10)
    assert sources([store])[0].stamp != given[0].stamp


def test_stores_and_files_of_one_folder_are_both_read(tmp_path):
    stored(tmp_path / "warm.zarr")
    write_grasps(GRASPS, tmp_path / "other.csv")
    assert [path.name for path in list_grasp_files([tmp_path])] == ["other.csv", "warm.zarr"]
    assert [path.name for path in list_grasp_files([tmp_path / "warm.zarr"])] == ["warm.zarr"]


def change(file: Path, **changed) -> None:
    file.write_text(json.dumps(json.loads(file.read_text()) | changed))


@pytest.mark.parametrize(
    ("zarr_format", "changed", "words"),
    [
        (2, {"filters": [{"id": "pickle", "protocol": 5}]}, "packed with pickle"),
        (2, {"compressor": {"id": "mine"}}, "packed with mine"),
        (3, {"codecs": [{"name": "numcodecs.pickle"}]}, "packed with pickle"),
        (
            3,
            {"codecs": [{"name": "sharding_indexed", "configuration": {"codecs": [{"name": "evil"}]}}]},
            "evil",
        ),
        (2, {"shape": [10**9, 121], "chunks": [10**9, 121]}, "t_surface declares"),
        (2, {"chunks": [10**9, 60]}, "chunk of t_surface declares|t_surface declares"),
        (2, {"shape": "many"}, "no metadata of a Zarr array"),
        (3, {"shape": [40]}, "no shape of a record"),
        (2, {"shape": [-40, 121]}, "no shape of a record"),
    ],
)
def test_what_a_store_may_not_be_is_refused_unread(tmp_path, monkeypatch, zarr_format, changed, words):
    store = stored(tmp_path / "warm.zarr", zarr_format)
    change(store / "t_surface" / (".zarray" if zarr_format == 2 else "zarr.json"), **changed)
    monkeypatch.setattr(xr, "open_zarr", lambda *_, **__: pytest.fail("was opened"))
    with pytest.raises(UserError, match=words):
        read_grasps(store)


def test_a_store_whose_chunk_is_damaged_is_one_line(tmp_path):
    store = stored(tmp_path / "warm.zarr")
    chunk = store / "t_surface" / "0.0"
    chunk.write_bytes(chunk.read_bytes()[:20])
    with pytest.raises(UserError, match="is damaged or no Zarr store"):
        read_grasps(store)


@pytest.mark.parametrize("zarr_format", [2, 3])
def test_readings_without_a_file_are_noted_or_refused(tmp_path, zarr_format):
    store = stored(tmp_path / "warm.zarr", zarr_format)
    assert not read_grasps(store).attrs.get("repairs")
    name = "1.2" if zarr_format == 2 else "c/1/2"
    (store / "t_surface" / name).unlink()
    [line] = read_grasps(store).attrs["repairs"].splitlines()
    assert (
        line
        == f"1 chunk(s) of t_surface have no file, {name} first: no readings there, or copy the store again"
    )
    assert not read_stored_grasps(store, 20, 40).attrs.get("repairs")
    change(store / "t_surface" / (".zarray" if zarr_format == 2 else "zarr.json"), fill_value=0.0)
    with pytest.raises(UserError, match=f"column t_surface: 1 chunk.s. .*{name} first; copy the store again"):
        read_grasps(store)


def test_an_empty_store_or_one_without_grasps_is_refused(tmp_path):
    (tmp_path / "empty.zarr").mkdir()
    (tmp_path / "empty.zarr/.zgroup").write_text('{"zarr_format": 2}')
    with pytest.raises(UserError, match="holds no array"):
        read_grasps(tmp_path / "empty.zarr")
    xr.Dataset({"a": ("x", [1.0, 2.0])}).to_zarr(tmp_path / "other.zarr", zarr_format=2, consolidated=False)
    with pytest.raises(UserError, match="no array t_surface"):
        check_grasp_file(tmp_path / "other.zarr")
