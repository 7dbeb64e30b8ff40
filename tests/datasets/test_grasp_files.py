"""Grasps in files: the rig's, jittering ones, unknown facts, and what is refused."""

from __future__ import annotations

import lzma

import numpy as np
import pytest
import xarray as xr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import example_path
from thermogrip.datasets.grasp_files import read_grasps, write_grasps
from thermogrip.datasets.schema import make_grasps

META = "grasp_id,material,t_object_nominal_degC,t_gripper_set_degC\n"


def samples(*grasps, step=0.1, start=-5, stop=10):
    lines = ["grasp_id,time_s,t_surface_degC,pump"]
    lines += [f"{g},{n * step:.6g},{23 + n / 16},0" for g in grasps for n in range(start, stop + 1)]
    return "\n".join(lines) + "\n"


@pytest.fixture
def pair(write):
    """Write NAME.csv and NAME_meta.csv."""

    def writer(long: str, meta: str | None = None, name: str = "g"):
        if meta is not None:
            write(meta, f"{name}_meta.csv")
        return write(long, f"{name}.csv")

    return writer


def refused(path):
    with pytest.raises(UserError) as fault:
        read_grasps(path)
    assert "\n" not in str(fault.value)
    return str(fault.value)


def test_a_record_that_begins_at_contact_has_its_stated_level_before_it(pair):
    long = samples("a", "b", start=0)
    g = read_grasps(pair(long, META + "a,iron,43,23.5\nb,wood,43,24\n"))
    early = g["time"].values < 0
    assert early.sum() == 5
    assert -3.05 <= g["time"].values[0] < g["time"].values[early][-1] <= -1.95
    np.testing.assert_array_equal(g["t_surface"].values[:, early], np.repeat([[23.5], [24.0]], 5, axis=1))
    np.testing.assert_allclose(g["t_surface"].values[0, ~early], 23 + np.arange(11) / 16)
    assert "begins at contact" in g.attrs["repairs"]
    assert "before the closed message" in refused(pair(long, META + "a,iron,43,23.5\nb,wood,43,\n"))


def test_the_rigs_grasps_have_their_facts():
    g = read_grasps(example_path("exp4_cooled5_obj18_grip38_40s"))
    assert dict(g.sizes) == {"grasp": 40, "time": 421}
    assert float(g["time"][0]) == -2.0
    assert float(g["time"][-1]) == 40.0
    assert set(g["material"].values) == {"copper", "zinc", "brass", "iron", "wood"}
    assert set(g["t_object"].values) == {18.0}
    assert set(g["t_gripper"].values) == {38.0}
    assert set(g["session"].values) == {"exp4_cooled5_obj18_grip38_40s"}
    assert (g["block"].values == g["material"].values).all()
    assert g.attrs["repairs"] == ""


def test_two_touches_of_an_unknown_object():
    g = read_grasps(example_path("exp5_two_touch_unknown_object"))
    assert np.isnan(g["t_object"].values).all()
    groups, counts = np.unique(g["touch_group"].values, return_counts=True)
    assert groups.size == 48
    assert set(counts) == {2}
    assert set(g["touch"].values) == {1.0, 2.0}
    assert set(g["rest"].values) == {60.0}


def test_a_long_file_is_read_sample_for_sample():
    path = example_path("exp2_dT20")
    g = read_grasps(path)
    for line in lzma.decompress(path.read_bytes()).decode().splitlines()[1::97]:
        grasp, time, value, _ = line.split(",")
        assert float(g["t_surface"].sel(grasp=grasp, time=float(time))) == float(value)


def test_interleaved_grasps_are_sorted_out(pair):
    rows = samples("a", "b").splitlines()
    mixed = "\n".join([rows[0], *(r for two in zip(rows[1:17], rows[17:]) for r in two)]) + "\n"
    straight = read_grasps(pair(samples("a", "b"), META + "a,copper,43,23\nb,wood,43,23\n"))
    xr.testing.assert_identical(straight, read_grasps(pair(mixed)))


def test_the_meta_file_may_be_in_another_order(pair):
    g = read_grasps(pair(samples("a", "b"), META + "b,wood,18,38\na,copper,43,23\n"))
    assert g["material"].values.tolist() == ["copper", "wood"]
    assert g["t_object"].values.tolist() == [43.0, 18.0]


def test_an_empty_cell_is_unknown(pair):
    g = read_grasps(pair(samples("a", "b"), META + "a,,,23\nb,wood,43,23\n"))
    assert g["material"].values.tolist() == ["", "wood"]
    assert g["block"].values.tolist() == ["", "wood"]
    assert np.isnan(g["t_object"].values).tolist() == [True, False]


def test_units_are_those_of_the_headers(pair):
    long = samples("a").replace("time_s", "time_ms").replace("t_surface_degC", "t_surface_degF")
    g = read_grasps(pair(long, "grasp_id,t_object_nominal_K,rest_min\na,300,1\n"))
    assert float(g["t_object"][0]) == pytest.approx(26.85)
    assert float(g["rest"][0]) == 60.0
    assert float(g["time"][-1]) == pytest.approx(1e-3)
    assert float(g["t_surface"][0, 5]) == pytest.approx(-5.0)


def test_grasps_of_different_length_end_in_nan(pair):
    short = "\n".join(samples("b").splitlines()[1:9]) + "\n"
    g = read_grasps(pair(samples("a") + short, META + "a,copper,43,23\nb,wood,43,23\n"))
    assert np.isfinite(g["t_surface"].values).sum(axis=1).tolist() == [16, 8]
    assert np.isnan(g["t_surface"].values[1, 8:]).all()


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 10_000), size=st.floats(0.02, 0.24))
def test_jittering_stamps_are_interpolated_onto_one_axis(pair, seed, size):
    rng = np.random.default_rng(seed)
    lines = ["grasp_id,time_s,t_surface_degC"]
    for grasp in "ab":
        time = 0.1 * (np.arange(-20, 101) + size * rng.uniform(-1, 1, 121))
        lines += [f"{grasp},{t!r},{23 + 2 * t!r}" for t in time.tolist()]
    g = read_grasps(pair("\n".join(lines) + "\n", META + "a,copper,43,23\nb,wood,43,23\n"))
    ramp = 23 + 2 * g["time"].values
    got = g["t_surface"].values
    inner = np.isfinite(got)
    assert inner[:, 2:-2].all()
    # the outermost samples are held for up to half a step of 0.1 s on a ramp of 2 K/s
    assert np.abs(got - ramp)[inner].max() <= 0.1 + 1e-9
    np.testing.assert_allclose(got[:, 2:-2], np.broadcast_to(ramp, got.shape)[:, 2:-2], atol=1e-9)


@pytest.mark.parametrize(
    ("steps", "common"),
    [([0.1, 0.1009, 0.1009], 0.1), ([0.1015] * 3, 0.1015), ([0.1, 0.1, 0.11999], 0.1), ([1.23456], 1.235),
     ([0.1, 0.121, 0.1], "grasp 'g1' has a step of 0.121 s, the others 0.1 s")],
)  # fmt: skip
def test_the_step_is_the_median_in_two_digits_if_that_is_within_one_per_cent(pair, steps, common):
    rng = np.random.default_rng(0)
    lines, meta = ["grasp_id,time_s,t_surface_degC"], [META.strip()]
    for at, step in enumerate(steps):
        time = step * np.arange(-20, 41) + 0.2 * step * rng.uniform(-1, 1, 61)
        time[[0, -1]] = -20 * step, 40 * step  # the mean step is that of the ends
        time = np.delete(time, [30, 31])  # a hole counts as the steps that it is long
        lines += [f"g{at},{t!r},23" for t in time.tolist()]
        meta.append(f"g{at},copper,43,23")
    path = pair("\n".join(lines) + "\n", "\n".join(meta) + "\n")
    if isinstance(common, str):
        assert common in refused(path)
    else:
        assert read_grasps(path).attrs["repairs"].endswith(f"interpolated onto a step of {common:g} s")


def test_a_hole_in_a_jittering_grasp_stays_a_hole(pair):
    rng = np.random.default_rng(1)
    time = 0.1 * (np.arange(-20, 101) + 0.2 * rng.uniform(-1, 1, 121))
    keep = (time < 3) | (time > 4)
    lines = ["grasp_id,time_s,t_surface_degC", *(f"a,{t!r},{23 + t!r}" for t in time[keep].tolist())]
    g = read_grasps(pair("\n".join(lines) + "\n", META + "a,copper,43,23\n"))
    hole = g["t_surface"].sel(time=slice(3.15, 3.85))
    assert hole.size >= 7
    assert np.isnan(hole.values).all()
    assert "interpolated onto a step of 0.1 s" in g.attrs["repairs"]


ONE = META + "a,copper,43,23\n"


@pytest.mark.parametrize(
    ("long", "meta", "expected"),
    [
        (samples("a"), None, ["g.csv", "meta file is missing", "g_meta.csv"]),
        (samples("a", "b"), ONE, ["g_meta.csv", "no row for grasp 'b' of g.csv"]),
        (samples("a"), ONE + "b,wood,43,23\n", ["g_meta.csv", "row 3", "'b' has no samples in g.csv"]),
        (samples("a"), ONE + "a,wood,43,23\n", ["row 3, column material: wood of grasp 'a' was copper"]),
        (samples("a") + samples("a").partition("\n")[2], ONE, ["'a': time runs back from 1 s to -0.5 s"]),
        (samples("a"), ONE.replace("43", "warm"), ["g_meta.csv", "row 2", "t_object_nominal_degC", "'warm'"]),
        (samples("a"), ONE.replace("nominal_degC", "nominal_C"), ["column t_object_nominal_C"]),
        (samples("a"), ONE.replace("nominal_degC", "nominal_V"), ["unit 'V' does not fit"]),
        (samples("a"), "material\ncopper\n", ["g_meta.csv", "no column grasp_id"]),
        (samples("a", stop=0), ONE, ["grasp 'a' has no sample after"]),
        (samples("a", start=0), META + "a,copper,43,\n", ["grasp 'a' has no sample before"]),
        (samples("a").replace("grasp_id", "id"), ONE, ["no column grasp_id", "a grasp file has grasp_id"]),
        (samples("a").replace("time_s", "time"), ONE, ["column time: has no unit", "time_s"]),
        (samples("a").replace("time_s", "when_s"), ONE, ["no column time_s", "it has grasp_id, when_s"]),
        (samples("a").replace("t_surface_degC", "t_skin_degC"), ONE, ["no column t_surface_degC; rename"]),
        (samples("a").replace("t_surface_degC", "t_surface_V"), ONE, ["unit 'V' does not fit"]),
        (samples("a").replace("a,0.3", ",0.3"), ONE, ["row 10", "column grasp_id", "is empty"]),
        (samples("a").replace("a,0.3", "a,"), ONE, ["row 10", "has no time"]),
        (samples("a").replace("23.0", "x"), ONE, ["row 7", "column t_surface_degC", "'x'"]),
        (samples("a", "c") + samples("b", step=0.05).partition("\n")[2],
         META + "a,x,1,1\nb,x,1,1\nc,x,1,1\n", ["grasp 'b' has a step of 0.05 s, the others 0.1 s"]),
        ("grasp_id,time_s,t_surface_degC\na,-1,20\nb,1,20\n", META + "a,x,1,1\nb,x,1,1\n", ["two samples"]),
    ],
)  # fmt: skip
def test_a_fault_is_one_line_that_names_its_place(pair, long, meta, expected):
    line = refused(pair(long, meta))
    for part in expected:
        assert part in line
    assert "identify" not in line  # whose --columns a log has


@pytest.mark.parametrize("name", ["a.csv", "a.nc"])
def test_grasps_come_back_as_they_were_written(tmp_path, small_grasps, name):
    path = write_grasps(small_grasps, tmp_path / name)
    back = read_grasps(path)
    facts = [v for v in small_grasps.data_vars if name.endswith(".nc") or v not in ("session", "block")]
    for fact in facts:
        np.testing.assert_array_equal(back[fact].values, small_grasps[fact].values)
    np.testing.assert_array_equal(back["time"].values, small_grasps["time"].values)
    assert back["session"].values.tolist() == ["monday"] * 6
    assert back["block"].values.tolist() == ["b1", "b1", "b2", "b2", "b3", "b4"]


def test_a_netcdf_of_another_program_is_converted_by_its_units(tmp_path):
    data = xr.Dataset(
        {"t_surface": (("grasp", "time"), [[300.0, 300.0, 301.0]], {"units": "kelvin"})},
        coords={"grasp": [7], "time": ("time", [-100.0, 0.0, 100.0], {"units": "ms"})},
    )
    data.to_netcdf(tmp_path / "x.nc", engine="h5netcdf")
    g = read_grasps(tmp_path / "x.nc")
    np.testing.assert_allclose(g["t_surface"].values, [[26.85, 26.85, 27.85]])
    assert g["time"].values.tolist() == [-0.1, 0.0, 0.1]
    assert g["session"].values.tolist() == ["x"]
    assert g["grasp"].values.tolist() == ["7"]
    del data["t_surface"].attrs["units"]
    data.to_netcdf(tmp_path / "y.nc", engine="h5netcdf")
    assert "column t_surface: has no unit" in refused(tmp_path / "y.nc")


def test_a_log_is_no_grasps(tmp_path, small_log):
    from thermogrip.datasets.log_files import write_log

    assert "not grasps" in refused(write_log(small_log, tmp_path / "x.nc"))
    assert "no column grasp_id" in refused(write_log(small_log, tmp_path / "x.parquet"))


def test_columns_that_nobody_asked_for_are_left_out_and_reported(pair):
    plain = samples("a")
    head, *rows = plain.splitlines()
    more = "\n".join([f"{head},force_N,remark", *(f"{row},3.5,fine" for row in rows)]) + "\n"
    g = read_grasps(pair(more, ONE))
    assert "not used: force_N, remark" in g.attrs["repairs"]
    np.testing.assert_array_equal(g["t_surface"], read_grasps(pair(plain, ONE))["t_surface"])


def test_columns_of_the_meta_file_that_mean_nothing_are_left_out_and_reported(pair):
    meta = "grasp_id,material,object temp,t_room_degC\na,copper,28,25\nb,wood,28,25\n"
    file = pair(samples("a", "b"), meta)
    grasps = read_grasps(file)
    assert grasps["material"].values.tolist() == ["copper", "wood"]
    named = read_grasps(pair(samples("a", "b"), "grasp_id,Material,SPLIT\na,copper,train\nb,wood,test\n"))
    assert named["material"].values.tolist() == ["copper", "wood"]
    assert named["split"].values.tolist() == ["train", "test"]
    line = grasps.attrs["repairs"].splitlines()[-1]
    assert line.startswith("g_meta.csv: not used: object temp, t_room_degC; known are ")
    assert "t_ambient_degC" in line
    assert "t_object_nominal_degC" in line
    assert " repeat, touch, rest_s, " in line


def test_a_spreadsheet_s_semicolons_decimal_commas_and_utf_16_are_the_same_grasps(pair, tmp_path):
    plain, meta = samples("a", "b"), META + "a,copper,43.5,23\nb,wood,43.5,23\n"
    wanted = read_grasps(pair(plain, meta))
    swap = str.maketrans({",": ";", ".": ","})
    got = read_grasps(pair(plain.translate(swap), meta.translate(swap)))
    assert "numbers have a decimal comma" in got.attrs["repairs"]
    for name in ("t_surface", "t_object"):
        np.testing.assert_array_equal(got[name], wanted[name])
    (tmp_path / "wide.csv").write_bytes(plain.encode("utf-16"))
    (tmp_path / "wide_meta.csv").write_bytes(meta.encode("utf-16"))
    np.testing.assert_array_equal(read_grasps(tmp_path / "wide.csv")["t_surface"], wanted["t_surface"])


def test_the_first_and_the_last_sample_of_a_jittering_grasp_are_held_for_half_a_step(tmp_path):
    lines = ["grasp_id,time_s,t_surface_degC"]
    meta = ["grasp_id,material,t_object_nominal_degC,t_gripper_set_degC"]
    inner = (np.arange(-99, 100) / 10 + 0.001).tolist()
    for grasp, end in (("a", 10.0), ("b", 9.96), ("c", 9.94)):  # of a grid of 0.1 s to 10 s
        lines += [f"{grasp},{t!r},{20 + t!r}" for t in (-end, *inner, end)]
        meta.append(f"{grasp},wood,43,23")
    (tmp_path / "g.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "g_meta.csv").write_text("\n".join(meta) + "\n")
    grasps = read_grasps(tmp_path / "g.csv")
    assert "interpolated onto a step of 0.1 s" in grasps.attrs["repairs"]
    ends = grasps["t_surface"].values[:, [0, -1]]
    np.testing.assert_allclose(ends, [[10.0, 30.0], [10.04, 29.96], [np.nan, np.nan]], atol=1e-9)


def test_parquet_with_a_row_a_sample_is_the_csv(tmp_path):
    import pandas as pd

    made = make_grasps(
        [-0.1, 0.1],
        [[23.0, 24.5], [22.0, 25.0]],
        ["g0", "g1"],
        material=["iron", "wood"],
        t_object=[43.0, np.nan],
    )
    csv = read_grasps(write_grasps(made, tmp_path / "warm.csv"))
    samples, meta = pd.read_csv(tmp_path / "warm.csv"), pd.read_csv(tmp_path / "warm_meta.csv")
    (tmp_path / "parquet").mkdir()
    samples.merge(meta, on="grasp_id").to_parquet(tmp_path / "parquet" / "warm.parquet")
    found = read_grasps(tmp_path / "parquet" / "warm.parquet")
    assert found.identical(csv)


@pytest.fixture
def frame():
    import pandas as pd

    times = [-0.1, 0.0, 0.1]
    rows = [(g, t, 23.0 + t, "iron", 43.0) for g in ("g0", "g1") for t in times]
    return pd.DataFrame(
        rows, columns=["grasp_id", "time_s", "t_surface_degC", "material", "t_object_nominal_degC"]
    )


@pytest.mark.parametrize(
    ("column", "row", "value", "expected"),
    [
        ("t_surface_degC", 5, "warm", "row 5, column t_surface_degC: 'warm' is not a number"),
        ("t_object_nominal_degC", 6, "hot", "row 6, column t_object_nominal_degC: 'hot' is not a number"),
        ("t_object_nominal_degC", 5, 20.0, "row 5, column t_object_nominal_degC: 20.0 of grasp 'g1' was"),
        ("material", 3, "wood", "row 3, column material: wood of grasp 'g0' was iron in row 1"),
        ("t_object_nominal_degC", 2, None, "of grasp 'g0' was 43.0 in row 1"),
        ("grasp_id", 2, None, "row 2, column grasp_id: is empty"),
        ("time_s", 4, None, "row 4: has no time"),
        ("time_s", 3, -0.2, "grasp 'g0': time runs back"),
        ("t_surface_degC", 2, 5000.0, "grasp 'g0' has a t_surface of 5000 degC"),
    ],
)  # fmt: skip
def test_a_fault_in_parquet_names_its_file_row_and_column(
    frame, tmp_path, monkeypatch, column, row, value, expected
):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "full"))  # nothing is written on the way
    path = tmp_path / "part.parquet"
    cells = frame[column].tolist()
    cells[row - 1] = value
    if isinstance(value, str):
        cells = [str(cell) for cell in cells]
    frame.assign(**{column: cells}).to_parquet(path)
    line = refused(path)
    assert line.startswith(str(path))
    assert expected in line
    assert "identify" not in line


def test_what_the_rows_of_a_grasp_may_differ_in_is_left_out_and_reported(frame, tmp_path):
    path = tmp_path / "part.parquet"
    frame.assign(force_N=range(6)).to_parquet(path)
    assert read_grasps(path).attrs["repairs"].startswith("part.parquet: not used: force_N; known are")
