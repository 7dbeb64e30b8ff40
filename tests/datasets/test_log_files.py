"""Logs in files: messy ones, faults that are named, cuts and roles; what is written is read back."""

from __future__ import annotations

import gzip
import lzma
import pickle
import sys
import zipfile

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
import xarray as xr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.io import savemat
from scipy.signal import lfilter

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import example_path
from thermogrip.datasets.files import split_cut
from thermogrip.datasets.log_files import as_logs, read_clock, read_log, write_log
from thermogrip.datasets.schema import column, make_log, names

HEAD = "time_s,drive,t_tank_degC\n"
ROWS = "0.0,0.5,25.0\n0.5,0.5,25.5\n1.0,0.6,26.0\n"


def repairs(log):
    return [line for line in log.attrs["repairs"].splitlines() if line]


def refused(path, **kwargs):
    """Return the one line with which reading is refused."""
    with pytest.raises(UserError) as fault:
        read_log(path, **kwargs)
    line = str(fault.value)
    assert "\n" not in line
    return line


def test_the_prbs_example_is_repaired_and_says_how():
    log = read_log(example_path("prbs_heating_cooling"))
    said = "\n".join(repairs(log))
    assert "5 repeated time stamps dropped (rows 1419, 2368, 6498, 7325, 10632)" in said
    assert "t_tank: 11 lost samples left empty" in said
    assert "t_surface: 21 lost samples left empty" in said
    assert "t_tank: 1 spike sample rejected (-3.5 at 1998.73 s)" in said
    assert "t_surface: 1 spike sample rejected (127.938 at 874.54 s)" in said
    assert "gap of 38.70 s from 1129.94 to 1168.64 s (drive -0.0443 before, -0.9553 after" in said
    assert "median step 0.2 s" in said
    assert log.sizes["time"] == 11811 - 5
    assert int(np.isnan(column(log, "t_tank")).sum()) == 12
    assert int(np.isnan(column(log, "t_surface")).sum()) == 22
    assert names(log, "input") == ("drive", "pump")
    assert names(log, "disturbance") == ("t_ambient",)
    assert names(log, "output") == ("t_tank", "t_surface")


@pytest.mark.parametrize("name", ["multisine", "pump_on_off"])
def test_the_clean_examples_need_no_repair(name):
    assert repairs(read_log(example_path(name))) == []


def test_a_compressed_log_is_the_log(write):
    plain = read_log(write(HEAD + ROWS))
    packed = read_log(write(gzip.compress((HEAD + ROWS).encode()), "log.csv.gz"))
    tight = read_log(write(lzma.compress((HEAD + ROWS).encode()), "log.csv.xz"))
    text = read_log(write(gzip.compress((HEAD + ROWS).encode()), "log.txt.gz"))
    xr.testing.assert_identical(plain, packed)
    xr.testing.assert_identical(plain, text)
    xr.testing.assert_identical(plain, tight)


@pytest.mark.parametrize(
    "text",
    [
        (HEAD + ROWS).replace("\n", "\r\n"),
        (HEAD + ROWS).replace("\n", "\r"),
        (HEAD + ROWS).replace(",", ";"),
        (HEAD + ROWS).replace(",", "\t"),
        (HEAD + ROWS).replace(",", " , "),
        "\ufeff" + HEAD + ROWS,
        "# made by hand\n\n" + HEAD + ROWS,
        HEAD + ROWS.rstrip("\n"),
        HEAD + ROWS.replace("\n", "\n\n"),
        '"time_s","drive","t_tank_degC"\n' + ROWS,
    ],
)
def test_the_same_table_in_other_dress(write, text):
    log = read_log(write(text))
    np.testing.assert_array_equal(log["time"].values, [0.0, 0.5, 1.0])
    np.testing.assert_array_equal(column(log, "t_tank"), [25.0, 25.5, 26.0])


def test_a_lost_input_is_held_a_lost_disturbance_interpolated_and_a_lost_output_left_empty(write):
    log = read_log(write("time_s,drive,t_tank_degC\n0,,20\n1,0.5,inf\n2,nan,21\n3,0.7,22\n"))
    np.testing.assert_array_equal(log["time"].values, [1.0, 2.0, 3.0])  # the start is dropped
    np.testing.assert_array_equal(column(log, "drive"), [0.5, 0.5, 0.7])
    assert np.isnan(column(log, "t_tank")).tolist() == [True, False, False]
    log = read_log(write("time_s,t_room_degC,t_a_degC\n0,20,30\n1,,\n3,23,31\n"))
    np.testing.assert_allclose(column(log, "t_room"), [20.0, 21.0, 23.0])
    assert np.isnan(column(log, "t_a")).tolist() == [False, True, False]
    assert "t_room: 1 lost value interpolated" in repairs(log)


def test_the_unfinished_last_line_of_a_killed_logger_is_dropped(write):
    log = read_log(write(HEAD + ROWS + "1.5,0."))
    assert log.sizes["time"] == 3
    assert repairs(log)[0] == "row 5 is the last and was cut off (2 of 3 cells): dropped"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (HEAD + "0,0.5,25\n1,0.5,warm\n2,0,25\n", ["row 3", "column t_tank_degC", "'warm' is not a number"]),
        ("# note\n" + HEAD + "0,x,25\n1,0,25\n", ["row 3", "column drive", "'x'"]),
        (HEAD + "0,x,25\n1,0\n2,0,hot\n3,0,25\n", ["row 3: has 2 cell(s), the header has 3; complete"]),
        (HEAD + "0,0.5,25\n1,0.5,warm\n2,0,25\n", ["or drop the column (- in --columns)"]),
        (HEAD.replace(",", ";") + "0;0,5;25\n1;0.5;25\n", ["row 2", "column drive", "write a decimal point"]),
        (HEAD + "0,0.5,25\n", ["1 row(s) are not a log"]),
        ("", ["is empty", "header"]),
        ("# only\n# comments\n", ["only comments"]),
        ("time_s\n0\n1\n", ["nothing else"]),
        ("date;t_degC\n" + "1-3-2019 00:05;20\n" * 20 + ";20\n" * 4, ["row 22", "a time to 4 rows"]),
        (b"time_s,t_degC\n0,1\n1,\xff\xfe\n", ["row 3", "is not a number"]),
        ((HEAD + ROWS).encode("utf-16-le"), ["is not text"]),
        (bytes(range(256)) * 20, ["is not text"]),
        (pickle.dumps({"a": 1}), ["is not text"]),
        (b"cos\nsystem\n(S'echo owned'\ntR.", ["log.csv"]),
        (HEAD + "0,0,-300\n1,0,-300\n", ["absolute zero"]),
        (HEAD + "0,,25\n1,,25\n2,1,25\n", ["2 row(s) left out in which drive is not known: rows 2, 3"]),
    ],
)
def test_a_fault_is_one_line_that_names_its_place(write, text, expected):
    line = refused(write(text))
    for part in ("log.csv", *expected):
        assert part in line


@pytest.mark.parametrize(
    ("text", "row"),
    [
        (HEAD + "0,0,25\n2,0,25\n1,0,25\n", 4),
        (HEAD.strip() + "\r\n0,0,25\r\n2,0,25\r\n1,0,25\r\n", 4),
        (HEAD + "\n0,0,25\n\n2,0,25\n1,0,25\n", 6),
        ("# one\n# two\n" + HEAD + "0,0,25\n2,0,25\n\n1,0,25\n", 7),
        (HEAD + "0,0,25\n2,0,25\n1,0,25", 4),
    ],
)
def test_the_row_of_a_fault_is_the_line_that_an_editor_shows(write, text, row):
    assert f"row {row}: time runs back from 2 s to 1 s" in refused(write(text))


def test_the_rows_of_a_parquet_file_count_from_one(tmp_path):
    table = pa.table({"time_s": [0.0, 2.0, 1.0], "t_a_degC": [20.0, 21.0, 22.0]})
    parquet.write_table(table, tmp_path / "log.parquet")
    assert "row 3: time runs back from 2 s to 1 s" in refused(tmp_path / "log.parquet")


def test_a_flipped_bit_in_the_numbers_of_a_parquet_file_is_found(tmp_path, small_log):
    path = write_log(small_log, tmp_path / "log.parquet")
    whole = path.read_bytes()
    pages = len(whole) - 8 - int.from_bytes(whole[-8:-4], "little")  # the rest describes them
    found = 0
    for at in range(4, pages, 53):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 16]) + whole[at + 1 :])
        try:
            log = read_log(path)
        except UserError:
            found += 1
        else:  # the head of a page has fields that nobody reads
            np.testing.assert_array_equal(log.to_array().values, small_log.to_array().values)
    assert found > 0


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("log.nc", b"not hdf", "is not NetCDF"),
        ("log.nc", b"", "is not NetCDF"),
        ("log.nc", b"CDF\x01" + b"\0" * 40, "is NetCDF-3"),
        ("log.nc", b"\x89HDF\r\n\x1a\n" + b"\0" * 500, "is damaged"),
        ("log.nc", pickle.dumps([1, 2]), "is not NetCDF"),
        ("log.parquet", b"PAR1 no", "is not Parquet"),
        ("log.parquet", pickle.dumps([1, 2]), "is not Parquet"),
        ("log.csv.gz", b"not gzip", "is damaged"),
        ("log.csv.gz", gzip.compress(b"time_s,a\n" * 99, mtime=0)[:-9], "is damaged"),
        ("log.csv.xz", b"not xz", "is damaged"),
        ("log.xlsx", b"PK", "is no Excel workbook, or is damaged"),
        ("log.mat", b"PK", "is no MATLAB file, or is damaged"),
        ("log.mat", b"MATLAB 7.3 MAT-file" + b" " * 200, "is MATLAB 7.3; save('x.mat', ..., '-v7')"),
        ("log.odt", b"PK", "ending '.odt' is unknown"),
        ("log", b"x", "is unknown"),
    ],
)
def test_garbage_in_any_dress_is_one_line(write, name, content, expected):
    line = refused(write(content, name))
    assert expected in line
    assert name in line


def test_a_missing_file_and_a_folder_are_named(tmp_path):
    assert "no such file" in refused(tmp_path / "none.csv")
    (tmp_path / "folder.csv").mkdir()
    assert "is a folder" in refused(tmp_path / "folder.csv")


def test_a_file_that_may_not_be_read_is_named(write, monkeypatch):
    path = write(HEAD + ROWS)

    def deny(*_args, **_kwargs):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("builtins.open", deny)
    assert "permission denied" in refused(path)


def test_opening_a_pickle_runs_nothing(tmp_path):
    touched = tmp_path / "touched"

    class Bomb:
        def __reduce__(self):
            return (touched.write_text, ("boom",))

    for name in ("a.csv", "a.nc", "a.parquet", "a.csv.gz", "a.csv.xz"):
        (tmp_path / name).write_bytes(pickle.dumps(Bomb()))
        refused(tmp_path / name)
    assert not touched.exists()


def test_cuts_are_half_open_and_share_no_sample(write):
    path = write("time_s,t_a_degC\n" + "".join(f"{n},{20 + n}\n" for n in range(10)))
    first, second = read_log(f"{path}@:4"), read_log(f"{path}@4:")
    assert first["time"].values.tolist() == [0.0, 1.0, 2.0, 3.0]
    assert second["time"].values[0] == 4.0
    assert first.sizes["time"] + second.sizes["time"] == 10
    middle = read_log(f"{path}@2.5:7")
    assert middle["time"].values.tolist() == [3.0, 4.0, 5.0, 6.0]
    assert middle.attrs["name"] == "log@2.5:7"
    assert repairs(middle) == ["taken from 2.5 s to 7 s"]
    assert repairs(first) == ["taken from the start to 4 s"]
    assert (first.attrs["name"], second.attrs["name"]) == ("log@:4", "log@4:end")


def test_a_cut_is_made_after_the_repairs(write):
    path = write("time_s,drive,t_a_degC\n0,1,20\n1,,20\n2,,20\n3,0,20\n")
    log = read_log(f"{path}@1:3")
    assert column(log, "drive").tolist() == [1.0, 1.0]
    assert "speak of the whole log" in repairs(log)[-1]


@pytest.mark.parametrize(
    ("cut", "expected"),
    [
        ("@5:2", "is empty"),
        ("@1:1", "the cut 1:1 is empty"),
        ("@a:2", "'a' is not a time"),
        ("@900:", "leaves 0 row"),
        ("@nan:3", "is empty"),
    ],
)
def test_a_cut_that_cannot_be_is_refused(write, cut, expected):
    assert expected in refused(f"{write(HEAD + ROWS)}{cut}")


def test_an_existing_file_with_an_at_sign_is_not_cut(tmp_path):
    path = tmp_path / "run@1:2.csv"
    path.write_text(HEAD + ROWS)
    assert read_log(path).sizes["time"] == 3
    assert read_log(f"{path}@0:0.7").sizes["time"] == 2
    assert split_cut(tmp_path / "me@home.csv").file.name == "me@home.csv"


def test_roles_can_be_given(write):
    path = write("time_s,pump_V,level_V,t_room_degC\n0,1,2,20\n1,1,2,20\n")
    log = read_log(path)
    assert (names(log, "input"), names(log, "output")) == (("pump",), ("level",))
    log = read_log(path, inputs=["level_V"], outputs=["t_room"], disturbances=[])
    assert (names(log, "input"), names(log, "output")) == (("level",), ("t_room",))
    assert names(log, "other") == ("pump",)
    assert "column t_rom: no such column" in refused(path, outputs=["t_rom"])


def test_the_rules_of_spikes_and_codes_are_for_readings_alone(write):
    rows = "".join(f"{n},{90 if n == 50 else 20},{90 if n == 50 else 20}\n" for n in range(100))
    log = read_log(write("time_s,t_a_degC,t_set_degC\n" + rows))
    assert np.isnan(column(log, "t_a")).sum() == 1
    assert column(log, "t_set")[50] == 90
    levels = np.repeat([20, 22, 85, 20, 22], 60)  # of a drive without a name: 85 is no DS18B20's code
    log = read_log(write("".join(f"{n},{level},{n % 7}\n" for n, level in enumerate(levels))))
    assert column(log, "c2").tolist() == levels.tolist()


def test_a_netcdf_of_another_program_is_read_by_its_units(tmp_path):
    data = xr.Dataset(
        {
            "drive": ("time", [0.0, 1.0, 1.0]),
            "t_tank": ("time", [300.0, 301.0, np.nan], {"units": "kelvin"}),
            "picture": (("time", "x"), np.zeros((3, 2))),
        },
        coords={"time": ("time", [0.0, 1000.0, 2000.0], {"units": "ms"})},
    )
    data.to_netcdf(tmp_path / "other.nc", engine="h5netcdf")
    log = read_log(tmp_path / "other.nc")
    np.testing.assert_allclose(column(log, "t_tank"), [26.85, 27.85, np.nan])
    np.testing.assert_array_equal(log["time"].values, [0.0, 1.0, 2.0])
    assert "left out, not over time alone: picture" in repairs(log)
    data["t_tank"].attrs["units"] = "furlong"
    data.to_netcdf(tmp_path / "odd.nc", engine="h5netcdf")
    assert "unit 'furlong' is unknown" in refused(tmp_path / "odd.nc")


def test_grasps_are_not_a_log(tmp_path, small_grasps):
    from thermogrip.datasets.grasp_files import write_grasps

    write_grasps(small_grasps, tmp_path / "g.nc")
    assert "not a log" in refused(tmp_path / "g.nc")


def test_a_clock_of_seconds_since_1970_starts_at_the_first_row_and_a_late_start_stays(write):
    late = "".join(f"{1767261600 + k}.5,0.5,{25 + k}\n" for k in range(4))
    log = read_log(write(HEAD + late))
    assert log["time"].values.tolist() == [0.0, 1.0, 2.0, 3.0]
    assert "since 1970: counted from the first row, 1767261600 s" in log.attrs["repairs"]
    millis = read_log(write(HEAD.replace("time_s", "time_ms") + late.replace(".5,0.5", "500,0.5")))
    assert millis["time"].values.tolist() == [0.0, 1.0, 2.0, 3.0]
    assert read_log(write(HEAD + "1e6,0.5,25\n1000001,0.5,26\n"))["time"].values[0] == 1e6


def test_of_two_times_the_one_that_starts_again_with_each_cycle_is_not_taken(write):
    rows = "".join(f"{k % 5},{1683363163 + k}000000000,{k % 3},{25 + k / 10}\n" for k in range(30))
    log = read_log(write("Time,Time(ns),Q1,T1\n" + rows))
    np.testing.assert_allclose(log["time"].values, np.arange(30.0), atol=1e-6)


ENDINGS = [".csv", ".csv.gz", ".csv.xz", ".nc", ".parquet"]
SLOW = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])

FLOATS = st.floats(-9e37, 9e37, width=64)


@st.composite
def logs(draw):
    """Logs with any inputs; outputs that no spike rule would touch, with lost samples."""
    n = draw(st.integers(2, 19))  # of twenty rows and more, a column that is another's copy has no role
    steps = draw(arrays(float, n, elements=st.floats(1e-3, 5.0)))
    base = draw(st.floats(-50, 100))
    t_a = base + draw(arrays(float, n, elements=st.floats(-0.25, 0.25)))
    lost = draw(arrays(bool, n))
    lost[draw(st.integers(0, n - 1))] = False
    return make_log(
        draw(st.floats(-1e3, 1e3)) + np.cumsum(steps),
        {
            "drive": (draw(arrays(float, n, elements=FLOATS)), "1", "input"),
            "pwm": (draw(arrays(float, n, elements=st.floats(0, 255))), "0_255", "input"),
            "q1": (draw(arrays(float, n, elements=st.floats(0, 100))), "percent", "input"),
            "t_ambient": (draw(arrays(float, n, elements=st.floats(-20, 40))), "degC", "disturbance"),
            "t_a": (np.where(lost, np.nan, t_a), "degC", "output"),
            "setpoint": (draw(arrays(float, n, elements=FLOATS)), "degC", "other"),
        },
        name="log",
    )


@SLOW
@given(log=logs(), ending=st.sampled_from(ENDINGS))
def test_every_number_unit_and_role_comes_back(tmp_path, log, ending):
    back = read_log(write_log(log, tmp_path / f"log{ending}"))
    xr.testing.assert_equal(back, log)
    for name in log.data_vars:
        assert back[name].attrs == log[name].attrs
    assert back.attrs["name"] == "log"


@pytest.mark.parametrize("ending", [".nc", ".parquet"])
def test_netcdf_and_parquet_keep_everything_unrepaired(tmp_path, small_log, ending):
    small_log["t_tank"].values[20] = 500.0  # a spike in a record that was made on purpose
    small_log["battery"].attrs["role"] = "input"
    back = read_log(write_log(small_log, tmp_path / f"x{ending}"))
    xr.testing.assert_equal(back, small_log)
    assert list(back.data_vars) == list(small_log.data_vars)
    assert back["battery"].attrs == {"units": "V", "role": "input"}
    assert back.attrs["repairs"] == "one line\nand another"
    assert back.attrs["name"] == "small"


def test_the_bytes_of_a_file_depend_on_the_log_alone(tmp_path, small_log):
    for ending in (".csv", ".csv.gz", ".csv.xz"):
        first = write_log(small_log, tmp_path / f"a{ending}").read_bytes()
        assert write_log(small_log, tmp_path / f"b{ending}").read_bytes() == first


def test_reading_the_repaired_example_again_finds_no_more(tmp_path):
    from thermogrip.datasets.examples import example_path

    log = read_log(example_path("prbs_heating_cooling"))
    again = read_log(write_log(log, tmp_path / "again.csv"))
    xr.testing.assert_equal(again, log)
    assert not any("spike" in line or "repeated" in line for line in again.attrs["repairs"].splitlines())


def test_a_log_that_a_header_cannot_say_is_refused(tmp_path):
    log = make_log([0.0, 1.0], {"t_C": ([1, 2], "1", "other")})
    with pytest.raises(UserError, match="t_C"):
        write_log(log, tmp_path / "a.csv")
    log = make_log([0.0, 1.0], {"p": ([1, 2], "bar", "other")})
    with pytest.raises(UserError, match="bar"):
        write_log(log, tmp_path / "a.csv")
    with pytest.raises(UserError, match="ending"):
        write_log(log, tmp_path / "a.txt")
    assert list(tmp_path.iterdir()) == []


DAY, HOUR = 86400, 3600
ISO = [f"1970-01-01 00:00:{k:02d}" for k in range(10)]


@pytest.mark.parametrize(
    ("cells", "seconds", "note"),
    [
        (["12:00 AM", "12:30 pm", "1:30:15.5 PM", "11:59 am"],
         [0, 12.5 * HOUR, 13.5 * HOUR + 15.5, 12 * HOUR - 60], ""),
        (["23:59:59", "00:00:01", "23:59:59", "0:00"], [DAY - 1, DAY + 1, 2 * DAY - 1, 2 * DAY], ""),
        (["2/1/1970 00:00:01:250", "13/1/1970 00:00"], [DAY + 1.25, 12 * DAY], ""),
        (["12:00:00,25", "01:00:00", "13:00:00", "01:00:00"],
         [12 * HOUR + 0.25, HOUR, 13 * HOUR, HOUR], ""),  # half a day back is no midnight
        (["1970-01-02 00:00:00Z", "1970-01-02T01:00:00+01:30", "1970-01-02 01:00-0130", "1970-01-02"],
         [DAY, DAY - HOUR / 2, DAY + 2.5 * HOUR, DAY], ""),
        (["1/2/1970", "12/3/1970"], [DAY, 336 * DAY], " (taken as month/day)"),
        (["1/2/1970", "13/2/1970"], [31 * DAY, 43 * DAY], ""),
        (["1/12/1970", "1/13/1970"], [11 * DAY, 12 * DAY], ""),
        (["2/12/1970", "3/12/1970"], [335 * DAY, 336 * DAY],
         " (taken as day/month/year, in which the days follow each other)"),
        (["2/12/1970", "3/11/1970"], [42 * DAY, 69 * DAY], " (taken as month/day)"),
        (["1.2.1970 0:00", "31.2.1970 0:00"], [31 * DAY, np.nan], ""),
        (["2-Jan-1970", "03-feb-70"], [DAY, 36558 * DAY], ""),  # 2070: 100 years with 25 leap days
        (["32-1-2", "32-1-3"], [22646 * DAY, 22647 * DAY], ""),  # 2 January 2032, 62 years with 15 leap days
        (["1.2.100", "1.2.99", "1.2.9999"], [np.nan, 47148 * DAY, np.nan], ""),  # 2099
        ([*ISO, "x"], [*range(10), np.nan], ""),
        ([*ISO[:8], "x"], None, ""),
        (["5", "6"], None, ""),
    ],
)  # fmt: skip
def test_a_clock_is_seconds_since_1970_or_midnight(cells, seconds, note):
    found = read_clock(cells)
    assert (found is None) == (seconds is None)
    if found is not None:
        np.testing.assert_allclose(found[0], seconds, rtol=0, atol=1e-6)
        assert found[1] == note


@pytest.mark.parametrize(
    ("text", "time", "left"),
    [
        ("t,time,q1\n5,0,1\n6,2,1\n", [0, 2], ["t", "q1"]),  # the plainer name goes first
        ("time_s,t,q1\n0,5,1\n2,6,1\n", [0, 2], ["t", "q1"]),
        ("ts,q1\n1700000000000000000,1\n1700000002500000000,1\n", [0, 2.5], ["q1"]),  # ns since 1970
        ("ts,q1\n1700000000000000,1\n1700000002500000,1\n", [0, 2.5], ["q1"]),  # us
        ("ts,q1\n1700000000000,1\n1700000002500,1\n", [0, 2.5], ["q1"]),  # ms
        ("ts,q1\n1700000000,1\n1700000003,1\n", [0, 3], ["q1"]),  # s
        ("ts,q1\n1700000000,1\n1700000992,1\n", [1.7e6, 1700000.992], ["q1"]),  # ms of a board
        ("ts,q1\n133540000000000000,1\n133540000025000000,1\n", [0, 2.5], ["q1"]),  # FILETIME of Windows
        ("ts,q1\n638400000000000000,1\n638400000025000000,1\n", [0, 2.5], ["q1"]),  # ticks of .NET
        ("ts,q1\n45323.25,1\n45323.255,1\n", [0, 432], ["q1"]),  # a spreadsheet's days
        ("ts,q1\n739315.25,1\n739315.255,1\n", [0, 432], ["q1"]),  # MATLAB's
        ("ts,q1\n45323.5,1\n45324.0,1\n", [45323.5, 45324], ["q1"]),  # no plant is read twice a day
        ("hours,q1\n1,1\n1.5,1\n", [3600, 5400], ["q1"]),
        ("us,q1\n1000,1\n1500,1\n", [1e-3, 1.5e-3], ["q1"]),
        ("n,q1\n0,1\n10,1\n20,1\n30,1\n42,1\n", [0, 10, 20, 30, 42], ["q1"]),
        ("n,q1\n0,1\n10,1\n20,1\n30,1\n43,1\n", [0, 1, 2, 3, 4], ["n", "q1"]),
        ("n,q1\n0,1\n10,1\n20,1\n30,1\n", [0, 1, 2, 3], ["n", "q1"]),
        ("q1,dt\n1,0\n1,0\n", [0, 1], ["q1", "dt"]),
        ("seconds,q1\n5,1\n5,1\n", [0, 1], ["seconds", "q1"]),
        ("seconds,q1\n" + "".join(f"{k},1\n" for k in (5, 4, 6, 8)), [0, 1, 2, 3], ["seconds", "q1"]),
    ],
)
def test_which_column_is_the_time_and_in_what_unit(write, text, time, left):
    log = read_log(write(text))
    np.testing.assert_allclose(log["time"].values, time, rtol=0, atol=1e-5)
    assert list(log) == left
    assert ("in days of" in log.attrs["clock_doubts"]) == (time == [0, 432])


def test_a_netcdf_file_is_repaired_and_has_names_of_its_own(tmp_path):
    late = xr.Dataset({"a": ("time", [1.0, 2.0, 3.0])}, {"time": ("time", [0.0, 2.0, 1.0], {"units": "s"})})
    late.to_netcdf(tmp_path / "late.nc", engine="h5netcdf")
    assert "row 3: time runs back from 2 s to 1 s" in refused(tmp_path / "late.nc")
    with pytest.raises(UserError, match="has names of its own; leave --columns out"):
        read_log(tmp_path / "late.nc", columns=["a"])


FOREIGN = [
    ("time_s,Power_W,Plate\n0,1.2 kW,20 °C\n1,950 W,21 °C\n2,0 W,22.5 °C\n", [0, 1, 2],
     "Power W input 1200|Plate degC output 20", []),
    ("Time (sec), Heater 1 (%), Temperature 1 (degC), Set Point 1 (degC)\n0,10,20,23\n2,10,21,23\n",
     [0, 2], "Heater_1 percent input 10|Temperature_1 degC output 20|Set_Point_1 degC other 23",
     ["time: Time (sec) is taken as the time in s", "read 'Heater 1 (%)' as Heater_1 [percent], "]),
    ("Datum;Uhrzeit;Temp 1 in °C;Heizung [%]\n01.02.2026;10:00:00;20,5;40\n01.02.2026;10:00:02,5;20,6;45\n",
     [0, 2.5], "Temp_1 degC output 20.5|Heizung percent input 40",
     ["time: Datum and Uhrzeit counted from the first row, 01.02.2026 10:00:00",
      "numbers have a decimal comma"]),
    ("Logger X\nSerial: 12\n\nDate Time,T1 (°F),P [kW],state\n2/13/2026 11:59:58 AM,212,1.5,on\n"
     "2/13/2026 12:00:01 PM,32,1.5,off\n", [0, 3], "T1 degC output 100|P W other 1500|state 1 input 1",
     ["2 line(s) before the table passed over",
      "state: words as 'on' read as 0 and 1", "T1: converted from degF",
      "P: converted to W (times 1000)"]),
    ("# made by numpy\n# t u y\n0.0 1 2\n0.5 1 2.5\n", [0, 0.5], "u 1 input 1|y 1 output 2", []),
    ("Time,Temp,Heater\ns,degC,%\n0,20,1\n1,20,1\n", [0, 1],
     "Temp degC output 20|Heater percent input 1", []),
    ("  1.0e+00\t  5.0e-01\t\n  2.0e+00\t  7.0e-01\t\n", [0, 1], "c1 1 input 1|c2 1 input 0.5",
     ["no header: columns named c1 to c2 by position; --columns", "rows are taken 1 s apart; --dt S"]),
    ("0,5 1,25\n1,5 1,5\n2,5 1\n", [0, 1, 2], "c1 1 input 0.5|c2 1 output 1.25", ["decimal comma"]),
    ("n,u,y\n1,4,5\n2,4,6\n3,4,5\n4,4,6\n5,4,5\n", [1, 2, 3, 4, 5], "u 1 input 4|y 1 output 5",
     ["time: n is taken as the time in s; --dt S sets another step"]),
    ("ts;q1;y\n1700000000000;1;2\n1700000000500;1;3\n", [0, 0.5], "q1 1 input 1|y 1 output 2",
     ["time: ts is taken as the time in s, times 0.001", "since 1970"]),
    ("millis,q1,y\n500,1,2\n1000,1,3\n", [0.5, 1], "q1 1 input 1|y 1 output 2", ["times 0.001"]),
    ("Elapsed time [h],q1,y\n0,1,2\n0.5,1,3\n", [0, 1800], "q1 1 input 1|y 1 output 2", ["times 3600"]),
    ("23:59:59,4,5\n00:00:01,4,6\n", [0, 2], "c2 1 other 4|c3 1 input 5",
     ["c1 counted from the first row, 23:"]),
    ("time,q1,T_a (°C)\n2026-01-01T00:59:59.5+01:00,1,20\n2026-01-01 00:00:00.5Z,1,20\n", [0, 1],
     "q1 1 input 1|T_a degC output 20", []),
    ("Zeit;q1;y\n13.01.26 10:00;1;2\n13.01.26 10:01;1;2\n", [0, 60], "q1 1 input 1|y 1 output 2", []),
    ("time,q1,y\n02-Jan-2026 10:00:00,1,2\n03-Feb-2026 10:00:00,1,2\n", [0, 32 * 86400],
     "q1 1 input 1|y 1 output 2", []),
    ("time,q1,y\n3/4/2026 10:00,1,2\n4/4/2026 10:00,1,2\n", [0, 86400], "q1 1 input 1|y 1 output 2",
     ["(taken as day/month/year, in which the days follow each other)"]),
    ("time,q1,y\n13/4/2026,1,2\n14/4/2026,1,2\n", [0, 86400], "q1 1 input 1|y 1 output 2", []),
    ("t,pump_mA,T_C,zone_a,zone_b,zone_c,p (bar)\n0,500,20,1,2,3,4\n1,500,20,1,2,3,4\n", [0, 1],
     "pump A input .5|T degC output 20|zone_a 1 other 1|zone_b 1 other 2|zone_c 1 other 3|p_bar 1 other 4",
     ["pump: converted to A (times 0.001)"]),
    ("time_s,q1,,t_degC,t_degC\n0,1,7,20,30\n1,1,7,20,30\n", [0, 1],
     "q1 1 input 1|c3 1 other 7|t degC output 20|2_t degC output 30",
     ["without a name: c3", "t_degC occurs again: named 2_t_degC"]),
    ("time_s,q1,y,note\n0,1,,a\n1,1,,b\n", [0, 1], "q1 1 input 1",
     ["y: has no number in any row, left out", "left out, no numbers: note"]),
    ("drive|t_a_degC|\n0|20|\n1|20|\n", [0, 1], "drive 1 input 0|t_a degC output 20", ["1 s apart; --dt S"]),
    (b"time_s,T_\xb0C,q1\n0,20,1\n1,20,1\n", [0, 1], "T degC output 20|q1 1 input 1", ["as Windows-1252"]),
    (HEAD + "".join(f"{k},{'ERR' if k == 4 else .5},20\n" for k in range(40)) + "# end\n", range(40),
     "drive 1 input .5|t_tank degC output 20",
     ["comments between rows passed over (row 42)",
      "drive: 1 cell(s) that are no numbers left empty (row 6: 'ERR')", "drive: 1 lost value held"]),
    (HEAD + "".join(f"{k // 5},.5,20\n" for k in range(20)), np.arange(20) / 5,
     "drive 1 input .5|t_tank degC output 20", ["time has 4 stamps for 20 rows: rows spread evenly"]),
]  # fmt: skip


@pytest.mark.parametrize(("text", "time", "columns", "notes"), FOREIGN)
@pytest.mark.parametrize("name", ["log.csv", "log.dat"])
def test_a_log_of_any_program_is_read_and_what_was_done_is_reported(write, text, time, columns, notes, name):
    log = read_log(write(text, name))
    np.testing.assert_allclose(log["time"].values, [*time], rtol=0, atol=1e-9)
    found = {str(n): (v.attrs["units"], v.attrs["role"], v.values[0]) for n, v in log.data_vars.items()}
    wanted = [each.split() for each in columns.split("|")]
    assert found == {n: (unit, role, pytest.approx(float(value))) for n, unit, role, value in wanted}
    for note in notes:
        assert note in log.attrs["repairs"]
    again = read_log(write_log(log, write("", "again.csv")))
    assert {n: v.attrs["units"] for n, v in again.items()} == {n: v.attrs["units"] for n, v in log.items()}


def test_columns_and_the_step_can_be_given(write):
    text = "".join(f"{k} {k % 3} {20 + k} 7\n" for k in range(6))
    log = read_log(write(text, "log.txt"), columns=["n", "heater_percent", "T (degF)", "-"], dt=0.5)
    np.testing.assert_allclose(log["time"].values, np.arange(6) / 2)
    assert [(n, v.attrs["units"]) for n, v in log.items()] == [("heater", "percent"), ("T", "degC")]
    assert "--columns" not in log.attrs["repairs"]
    log = read_log(write(HEAD + ROWS), columns=["-", "u", "y_V"], dt=10)
    assert (list(log), log["time"].values.tolist()) == (["u", "y"], [0.0, 10.0, 20.0])
    assert list(read_log(write(text, "log.txt"), columns=["-", "-", "u", "u"])) == ["u", "u_2"]
    log = read_log(write(HEAD + ROWS), dt=10)
    assert (list(log), log["time"].values.tolist()) == (["drive", "t_tank"], [0.0, 10.0, 20.0])
    assert "rows are 10 s apart, as asked in place of time_s" in log.attrs["repairs"]
    log = read_log(write(text, "log.dat"), dt=2)
    assert (list(log), log["time"].values[1]) == (["c2", "c3", "c4"], 2.0)
    line = refused(write(text), columns=["a", "b"])
    assert "has 4 columns, --columns names 2; write a name for each" in line


def test_long_headers_and_runs_of_blanks_are_read_in_one_pass(write):
    many = 300_000
    log = read_log(write("time_s," + "[" * 120_000 + ",q1 " + " " * 120_000 + "x\n0,1,2\n1,1,2\n"))
    assert log["time"].values.tolist() == [0.0, 1.0]
    log = read_log(write(f"0 1 {' ' * many}7\r\n1 2 {' ' * many}8 \r\n", "log.dat"), columns=["t", "q1", "y"])
    assert column(log, "y").tolist() == [7.0, 8.0]


def test_names_of_roles_may_be_headers_in_any_case(write):
    path = write("Time (s);Heater 1 (%);Plate\n0;1;2\n1;1;3\n")
    log = read_log(path, inputs=["heater 1 (%)"], outputs=["PLATE"])
    assert (names(log, "input"), names(log, "output")) == (("Heater_1",), ("Plate",))
    for pair in ("oven_degF,oven_percent", "oven_percent,oven_degF"):  # of two of one name the unit tells
        path = write(f"time_s,{pair},plate_degC\n0,1,2,3\n1,1,3,4\n", "pair.csv")
        log = read_log(path, inputs=["oven_percent"], outputs=["Oven_degF"])
        signals = (log[names(log, role)[0]] for role in ("input", "output"))
        assert [signal.attrs["units"] for signal in signals] == ["percent", "degC"]


def matlab(tmp_path, name="log.mat", **content):
    savemat(tmp_path / name, content, do_compression=True)
    return tmp_path / name


def test_a_matlab_file_is_a_log_of_its_columns_and_its_step(tmp_path):
    rows = np.column_stack([np.arange(9) / 2, np.arange(9) // 5, np.arange(9) ** 2])
    log = read_log(matlab(tmp_path, data=rows))
    assert (list(log), log["time"].values[1]) == (["c2", "c3"], 0.5)
    log = read_log(matlab(tmp_path, u=rows[:, 1], y=rows[::-1, 2], Ts=0.25))
    assert (list(log), log["time"].values[1]) == (["u", "y"], 0.25)
    assert "rows are taken 0.25 s apart; --dt" in log.attrs["repairs"]
    assert log.attrs["clock_doubts"] == ""
    log = read_log(matlab(tmp_path, u=rows[:, 1], y=rows[::-1, 2]))
    assert log.attrs["clock_doubts"] == "no column is a clock: rows are taken 1 s apart"
    assert "has no columns of numbers" in refused(matlab(tmp_path, name="words.mat", s="text"))


def test_a_matlab_file_with_functions_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("scipy.io.whosmat", lambda _: [("f", None, "function")])
    assert "has MATLAB's own objects among its variables; save" in refused(matlab(tmp_path, u=[1.0]))


def workbook(path, unpacked=b"<sheet/>"):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("xl/worksheets/sheet1.xml", unpacked)
    return path


def test_the_largest_sheet_of_a_workbook_is_read_as_its_text_would_be(tmp_path, monkeypatch):
    stamps = pd.date_range("2026-01-01 23:59:58", periods=3, freq="2s")
    rows = [["Plant 7", None, None], ["Date", "Heater (%)", "T1 (°C)"]]
    frame = pd.DataFrame([*rows, *zip(stamps, [0, 1, 1], [20.5, 20.6, 20.7])])
    monkeypatch.setattr(pd, "read_excel", lambda source, **_: {"About": frame[:1], "Run": frame})
    log = read_log(workbook(tmp_path / "log.xlsx"))
    assert log["time"].values.tolist() == [0.0, 2.0, 4.0]
    assert (names(log, "input"), column(log, "T1").tolist()) == (("Heater",), [20.5, 20.6, 20.7])
    notes = "the sheet Run is read, the largest; others: About\n1 line(s) before the table passed over"
    assert notes in log.attrs["repairs"]
    assert read_log(tmp_path / "log.xlsx", columns=["-", "u", "y"]).sizes["time"] == 3


def test_a_workbook_without_its_reader_or_of_too_much_is_refused(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    path = workbook(tmp_path / "log.xlsx")
    assert "needs the package openpyxl; pip install openpyxl, or export CSV" in refused(path)
    assert "which no record does" in refused(workbook(path, bytes(30 << 20)))


def test_a_workbook_of_its_writer_is_a_log(tmp_path):
    pytest.importorskip("openpyxl", reason="not installed: openpyxl")
    frame = pd.DataFrame({"time_s": [0.0, 0.5], "q1_percent": [1, 2], "T (°C)": [20.0, 21.0]})
    frame.to_excel(tmp_path / "log.xlsx", index=False)
    log = read_log(tmp_path / "log.xlsx")
    assert (log["time"].values.tolist(), column(log, "T").tolist()) == ([0.0, 0.5], [20.0, 21.0])


def test_logs_and_data_frames_are_taken_together():
    frame = pd.DataFrame({"time_s": [0, 1, 2], "a": [1, 2, 3], "b": [3, 4, 3]})
    made = make_log([0.0, 1.0], {"u": ([0, 1], "1", "input")})
    assert as_logs(made) == [made]
    first, second, third = as_logs([made, frame, frame], ["b"], ["a"])
    assert (first is made, second.attrs["name"], third.attrs["name"]) == (True, "DataFrame 2", "DataFrame 3")
    assert (names(second, "input"), names(second, "output")) == (("b",), ("a",))
    assert as_logs(frame, ["a"])[0].attrs["name"] == "DataFrame"


def test_a_data_frame_is_a_log():
    stamps = pd.date_range("2026-01-01", periods=3, freq="2s", name="when")
    columns = {"Heater (%)": [1, 2, 3], "T1 [°F]": [32.0, None, 50.0], "note": ["a", "b", "c"]}
    frame = pd.DataFrame(columns, stamps)
    log = read_log(frame, outputs=["T1"])
    assert (log.attrs["name"], log["time"].values.tolist()) == ("DataFrame", [0.0, 2.0, 4.0])
    np.testing.assert_allclose(column(log, "T1"), [0.0, np.nan, 10.0])
    assert "left out, no numbers: note" in log.attrs["repairs"]
    lapse = pd.DataFrame({"time": stamps - stamps[0], "y": [1, 2, 3]})
    assert read_log(lapse)["time"].values.tolist() == [0.0, 2.0, 4.0]
    bare = pd.DataFrame({"y": [1.0, 2.0]}, index=[0.5, 2.0])
    assert read_log(bare)["time"].values.tolist() == [0.5, 2.0]
    assert "DataFrame: 1 row(s) are not a log; give at least two" in refused(bare[:1].reset_index())
    assert "DataFrame: has names of its own; rename its columns" in refused(bare, columns=["t"])


STYLES = [
    (lambda t: f"{t:.3f}", "time_s"), (lambda t: f"{t:.3f}", "Time (sec)"),
    (lambda t: f"{1e3 * t:.0f}", "time [ms]"), (lambda t: f"{t / 60:.9f}", "Time, min"),
    (lambda t: f"{1.7e9 + t:.3f}", "epoch"), (lambda t: f"{1.7e12 + 1e3 * t:.0f}", "timestamp"),
    (lambda t: str(np.datetime64("2026-03-01T22:00:00") + np.timedelta64(round(1e3 * t), "ms")), "Date"),
]  # fmt: skip


@SLOW
@given(
    steps=st.lists(st.integers(1, 4000), min_size=5, max_size=30),
    style=st.sampled_from(STYLES),
    separator=st.sampled_from([",", ";", "\t", "|", " "]),
    comma=st.booleans(),
    bracket=st.sampled_from([" [{}]", "_{}", " ({})", " in {}"]),
    lead=st.sampled_from(["", "# a comment\n", "Device 7\n\n"]),
    seed=st.integers(0, 9),
)
def test_a_log_survives_every_way_of_writing_it(
    tmp_path, steps, style, separator, comma, bracket, lead, seed
):
    stamp, header = style
    comma = comma and separator != ","
    if separator == " ":
        header, bracket = header.replace(" ", "").replace(",", "_"), "_{}"
    time = np.concatenate([[0], np.cumsum(steps)]) / 1000
    rng = np.random.default_rng(seed)
    drive, temperature = rng.integers(0, 100, time.size), rng.uniform(20, 20.5, time.size).round(3)
    lines = [separator.join([header, "Heater" + bracket.format("%"), "Plate" + bracket.format("degC")])]
    for t, u, y in zip(time, drive, temperature):
        row = [stamp(t), str(u), f"{y:.3f}"]
        lines.append(separator.join(c.replace(".", ",") if comma else c for c in row))
    path = tmp_path / "log.txt"
    path.write_text(lead + "\n".join(lines) + "\n", encoding="utf-8")
    log = read_log(path)
    np.testing.assert_allclose(log["time"].values, time, rtol=0, atol=1e-5)
    np.testing.assert_array_equal(column(log, "Heater"), drive)
    np.testing.assert_allclose(column(log, "Plate"), temperature, rtol=0, atol=1e-9)
    assert (names(log, "input"), names(log, "output")) == (("Heater",), ("Plate",))


def test_a_table_with_a_reading_of_one_signal_in_a_row_has_a_column_for_each_signal(tmp_path):
    path = tmp_path / "long.csv"
    rows = [f"{name},{k},{60 * k}\n" for k in range(10) for name in ("heater", "oven")]
    path.write_text("".join(["sensor,state,time_s\n", *rows]))
    log = read_log(path)
    assert {str(name): item.values.tolist() for name, item in log.items()} == {
        "heater": [*range(10)],
        "oven": [*range(10)],
    }
    assert "heater, oven each hold until their next reading" in log.attrs["repairs"]
    history = ["entity_id,state,last_changed\n"]
    for k in range(20):
        switch, plate = "on" if k % 2 else "off", "unavailable" if k == 3 else 20 + k
        history.append(f"switch.heater,{switch},2024-01-13T00:{k:02}:00.5+00:00\n")
        history.append(f"sensor.plate_temperature,{plate},2024-01-13T00:{k:02}:30.5+00:00\n")
    path.write_text("".join(history))
    log = read_log(path)
    assert (names(log, "input"), column(log, "heater")[:6].tolist()) == (("heater",), [0, 0, 1, 1, 0, 0])
    assert column(log, "plate_temperature")[1:7].tolist() == [20, 20, 21, 21, 22, 22]
    assert np.isnan(column(log, "plate_temperature")[[0, 7, 8]]).all()  # not read yet, and lost
    assert np.diff(log["time"].values).tolist() == [30.0] * 39
    in_turn = [f"{60 * k},plate,{20 + k}\n{60 * k + 1},fan,{k}\n" for k in range(30)]
    path.write_text("".join(["time_s,name,value\n", *in_turn]))
    log = read_log(path)
    assert "signals are read in turn, each every 60 s: average the log" in log.attrs["role_doubts"]
    path.write_text("".join(["note,state,time_s\n", *(f"n{k},{k},{k}\n" for k in range(10))]))  # all differ
    assert list(read_log(path).data_vars) == ["state"]


def test_an_annotated_table_of_readings_in_a_row_is_read_by_what_varies(write):
    head = (
        "#group,false,false,true,false,false,true,true\r\n,result,table,_start,_time,_value,_unit,_field\r\n"
    )
    tables = [
        f",,{at},1970-01-01T00:00:00Z,2024-01-01T00:{k:02}:{15 * at}Z,{20 + at * k},{unit},{name}\r\n"
        for at, (name, unit) in enumerate([("heater", "%"), ("fan", "%"), ("tank_temp", "C")])
        for k in range(30)
    ]
    log = read_log(write("".join([head, *tables[:30], head, *tables[30:60], head, *tables[60:]])))
    assert {str(name): float(item[-1]) for name, item in log.items()} == {
        "heater": 20,
        "fan": 49,
        "tank_temp": 78,
    }
    assert "comments between rows passed over (rows 33, 65)" in log.attrs["repairs"]


def test_a_logger_that_was_started_again_writes_its_header_again(write):
    run = "time,q1,temp\n" + "".join(f"{k},{k // 9},{20 + k / 8}\n" for k in range(30))
    log = read_log(write(run + run))
    assert "the header stands again in row 32" in log.attrs["repairs"]
    assert "the clock starts again in row 33" in log.attrs["repairs"]
    assert log.sizes["time"] == 60


def test_a_unit_behind_each_number_is_the_column_s(write):
    rows = "".join(f"10:00:{k:02},{k} %,{68 + k:.1f} °F\n" for k in range(9))
    log = read_log(write("Time,Heater,Tank\n" + rows))
    assert (log["Heater"].attrs["units"], log["Tank"].attrs["units"]) == ("percent", "degC")
    np.testing.assert_allclose(column(log, "Tank"), 20 + np.arange(9) / 1.8)


PLACES = np.arange(600)
HEATER = np.random.default_rng(1).choice([20.0, 50.0, 90.0], 30).repeat(20)
PLATE = np.convolve(HEATER, np.ones(60) / 60)[:600] + 0.1 * np.random.default_rng(0).standard_normal(600)
LATER = (PLACES >= 300) * 1.0
CODE = (PLACES % 200 > 125) & (PLACES % 200 < 136)
SHUFFLED_IN_FIVES = np.random.default_rng(0).permuted(PLACES[2:597].reshape(-1, 5), axis=1).ravel()


@pytest.mark.parametrize(
    ("order", "heater", "plate", "doubt"),
    [
        (PLACES, HEATER, PLATE, ""),
        (np.r_[:300, 200:500], HEATER, PLATE, "rows 302 to 401 repeat those from 202 on"),
        (np.c_[:300, 300:600].ravel(), HEATER, PLATE, "goes to and fro from row to row"),
        (PLACES, HEATER, np.repeat(PLATE[::10], 10), "read in every 10th row only, held"),
        (PLACES, HEATER, np.interp(PLACES, PLACES[::10], PLATE[::10]), "10th row only, drawn straight"),
        (PLACES, HEATER, np.where((PLACES > 300) & (PLACES < 340), PLATE[300], PLATE), "is held at"),
        (PLACES, HEATER, np.where(CODE, -46.85, PLATE), "plate jumps to -46.85 and stays in 30 row(s)"),
        (PLACES, np.where(CODE, 0, HEATER), np.where(CODE, -46.85, PLATE), "is held at -46.85"),
        (PLACES, HEATER, np.minimum(PLATE, 60), "plate is held at 60 for "),  # a sensor at its end
        (PLACES, 2.55 * HEATER, PLATE, "heater goes to 229.5 percent: if it is none, name it heater_0_255"),
        (PLACES, HEATER / 100, PLATE, "heater goes to 0.9 percent: if it is none"),
        (PLACES, HEATER, PLATE[np.minimum(PLACES + 10, 599)], "plate moves 11 s before heater does"),
        (PLACES, HEATER, PLATE + LATER * (32 + 0.8 * PLATE), "stays there, as nowhere else"),
        (PLACES, np.where(LATER, 110 - HEATER, HEATER), PLATE, "of the log as it does elsewhere"),
        (PLACES, HEATER, np.r_[-30, PLATE[1:]], "jumps to -30 and stays in 1 row(s) while no input moves"),
        (np.r_[:2, SHUFFLED_IN_FIVES, 597:600], HEATER, PLATE, "to and fro in 18 of its 18 moves"),
        (PLACES, np.interp(PLACES, PLACES[::5], HEATER[::5]), PLATE, "in 5 rows, 18 times: is it an average"),
        (PLACES, np.interp(PLACES, PLACES[::5], 9.0 * (HEATER[::5] > 30)), PLATE, ""),  # of a limited rate
        (PLACES, HEATER, np.floor(PLATE / 4 + 0.9 * (PLACES % 2)), ""),  # a coarse reading that flickers
    ],
)
def test_columns_that_are_not_one_course_of_one_unit_are_doubts(write, order, heater, plate, doubt):
    cells = zip(PLACES, heater[order], plate[order])
    text = "time_s,heater_percent,plate_degC\n" + "".join(f"{k},{u:g},{y:.3f}\n" for k, u, y in cells)
    doubts = read_log(write(text)).attrs["role_doubts"]
    assert doubt in doubts
    assert bool(doubts) == bool(doubt)
    attrs = read_log(write(text), ["heater"], ["plate"]).attrs  # roles settle none in silence
    assert doubt in attrs["reading_doubts"] + attrs["repairs"]


@pytest.mark.parametrize(("out", "doubt"), [("sun", ""), ("outdoor_degC", "outdoor is held at 0 for")])
def test_a_sensor_ends_at_0_degrees_and_light_at_night(write, out, doubt):
    course = np.maximum(9 * np.sin(PLACES / 50) + 0.01 * np.random.default_rng(0).standard_normal(600), 0)
    rows = "".join(f"{k},{u:g},{y:.3f},{d:.3f}\n" for k, u, y, d in zip(PLACES, HEATER, PLATE, course))
    path = write(f"time_s,heater,plate_degC,{out}\n{rows}")
    doubts = read_log(path, ["heater"], ["plate"], [out.removesuffix("_degC")]).attrs["repairs"]
    assert doubts[: len(doubt) or None] == doubt


@pytest.mark.parametrize(("lost", "rows"), [((PLACES > 300) & (PLACES < 341), 560), (PLACES % 20 > 0, 600)])
def test_an_input_that_is_lost_in_a_long_hole_and_not_between_its_moves_is_unknown(write, lost, rows):
    cells = zip(PLACES, np.where(lost, "", HEATER.astype(str)), PLATE)
    log = read_log(write("time_s,heater,plate_degC\n" + "".join(f"{k},{u},{y:.2f}\n" for k, u, y in cells)))
    assert (log.sizes["time"], "gap of 41.00 s" in log.attrs["repairs"]) == (rows, rows < 600)


@pytest.mark.parametrize(
    ("late", "heats", "logged", "part"),
    [
        (np.arange(30_000) > 21_000, lambda u: 110 - u, lambda u: u, "2 of 2"),  # its sign is turned
        (np.abs(np.arange(3_000) - 940) < 200, lambda u: u, lambda u: u[0], "3 of 8"),  # it is stuck
        (np.arange(3_000) > 3_000, lambda u: u, lambda u: u, ""),
    ],
)
def test_a_part_in_which_a_reading_does_not_follow_the_drive_as_elsewhere_is_a_doubt(
    write, late, heats, logged, part
):
    heater = np.tile(HEATER, late.size // 600)
    noise = 2 * np.random.default_rng(0).standard_normal(late.size)
    plate = lfilter([0.03], [1, -0.97], np.where(late, heats(heater), heater)) + noise
    rows = zip(np.where(late, logged(heater), heater), plate)
    text = "time_s,heater,plate_degC\n" + "".join(f"{k},{u:g},{y:.3f}\n" for k, (u, y) in enumerate(rows))
    doubts = read_log(write(text)).attrs["reading_doubts"]
    assert bool(doubts) == bool(part)
    assert not part or f"plate does not follow heater in part {part} of the log" in doubts


@pytest.mark.parametrize(
    ("head", "cells", "doubt"),
    [
        ("time_s;heater;t_a_degC", "{k};1.{u:.0f}00;{y:.1f}", ""),
        ("time_s;heater;t_a_degC", "{k};1,{u:.0f}00;{y:.1f}", "a number of thousands? It is read as 1."),
        ("time_s;heater;t_a_degC", "{k};1.{u:.0f}00;{y:.0f},5", "a number of thousands? It is read as 1."),
        ("time_s;heater;t_a_degC", "{k};1,{u:.0f}00;{y:.0f},5", ""),
        ("Scale;values x10;\ntime_s;heater;t_a_degC", "{k};{u};{y:.1f}", "line 1 may change the numbers"),
        ("time_s;heater;t_a_degC;code", "{k};{u};{y:.1f};0x{k:03x}/7", "code is left out: its cells are no"),
    ],
)
def test_numbers_that_can_be_read_in_two_ways_are_doubts(write, head, cells, doubt):
    rows = [cells.format(k=k, u=u / 10, y=y) for k, u, y in zip(PLACES, HEATER, PLATE)]
    doubts = read_log(write("\n".join([head, *rows]) + "\n")).attrs["role_doubts"]
    assert doubt in doubts
    assert ("thousands" in doubts) == ("thousands" in doubt)


@pytest.mark.parametrize("swapped", [True, False])
def test_sensors_changed_over_are_asked_about(write, swapped):
    heater = np.repeat([20, 80, 50, 90, 30, 70], 100)
    noise = 0.1 * np.random.default_rng(0).standard_normal((2, 600))
    near, far = [[1], [0.4]] * np.convolve(heater, np.ones(60) / 60)[:600] + noise
    late = np.arange(600) >= (370 if swapped else 600)
    pairs = zip(heater, np.where(late, far, near), np.where(late, near, far))
    rows = "".join(f"{k},{u},{a:.2f},{b:.2f}\n" for k, (u, a, b) in enumerate(pairs))
    doubts = read_log(write("time_s,heater,t_a_degC,t_b_degC\n" + rows)).attrs["role_doubts"]
    assert doubts.count("stays there, as nowhere else") == 2 * swapped
    assert ("LOG@370:" in doubts) == swapped


def test_rows_that_were_written_twice_are_read_once(write):
    rows = "".join(2 * f"{2 * k},{k // 9},{20 + k / 8}\n" for k in range(40))
    log = read_log(write("time_s,q,temp\n" + rows))
    assert log["time"].values.tolist() == [*range(0, 80, 2)]
    assert "40 rows dropped that repeat the one before and its time" in log.attrs["repairs"]


def test_a_supply_that_the_weather_sets_is_asked_about(write):
    outside = np.round(10 + 8 * np.sin(PLACES / 40), 1)
    supply = np.round(60 - 1.3 * outside)
    room = lfilter([0.03], [1, -0.97], supply) + 0.05 * np.random.default_rng(0).standard_normal(600)
    rows = "".join(f"{k},{u:g},{w},{y:.2f}\n" for k, (u, w, y) in enumerate(zip(supply, outside, room)))
    log = read_log(write("time_s,supply_degC,outside_degC,room_degC\n" + rows), ["supply"], ["room"])
    assert "supply is computed from outside: their effects cannot" in log.attrs["reading_doubts"]


def test_a_server_s_readings_of_bad_quality_are_asked_about(write):
    row = "{0},u,{1},Good\n{0},T,{2},Good\n"
    rows = "".join(row.format(k, k // 9, 9 + k % 3) for k in range(60)) + "60,u,0,Bad\n60,T,9,Good\n"
    log = read_log(write("time,item,value,quality\n" + rows))
    assert "quality does not call each reading good: leave those cells empty" in log.attrs["role_doubts"]


@pytest.mark.parametrize(
    ("rows", "began"),
    [
        (["time,q,t_degC", "2026-03-01 10:00:00,0,20", "2026-03-01 10:00:02,1,20.1"], "2026-03-01T10:00:00Z"),
        (["date,q,t_degC", "01.02.2026 23:59:59,0,20", "02.02.2026 00:00:01,1,20.1"], "2026-02-01T23:59:59Z"),
        (["time_s,q,t_degC", "1767261600,0,20", "1767261602,1,20.1"], "2026-01-01T10:00:00Z"),
        (["time_ms,q,t_degC", "1767261600000,0,20", "1767261602000,1,20.1"], "2026-01-01T10:00:00Z"),
        (["time,q,t_degC", "10:00:00,0,20", "10:00:02,1,20.1"], None),
        (["time_s,q,t_degC", "5,0,20", "7,1,20.1"], None),
    ],
)
def test_a_log_knows_its_date_where_its_clock_does(tmp_path, rows, began):
    path = tmp_path / "log.csv"
    path.write_text("\n".join(rows) + "\n")
    log = read_log(path)
    assert log.attrs.get("began") == began
    assert log["time"].values[1] - log["time"].values[0] == pytest.approx(2.0)
    assert read_log(write_log(log, tmp_path / "log.nc")).attrs.get("began") == began


def test_an_output_without_a_long_part_of_the_readings_is_left_out_beside_a_whole_one(tmp_path):
    heater, noise = np.repeat([0, 60] * 15, 20), np.random.default_rng(0).standard_normal((2, 600))
    near, far = (20 + lfilter([1 - a], [1, -a], np.r_[0, heater[:-1]]) for a in (0.9, 0.95))
    near, far = near + 0.05 * noise[0], far + 0.05 * noise[1]
    rows = [f"{k},{heater[k]},{near[k] if k < 400 else ''},{far[k]}\n" for k in range(600)]
    (tmp_path / "half.csv").write_text("time_s,heater,near_degC,far_degC\n" + "".join(rows))
    log = read_log(tmp_path / "half.csv")
    assert (log["near"].attrs["role"], log["far"].attrs["role"]) == ("other", "output")
    assert "near is left out: it has no reading in 33 % of the rows, far has" in log.attrs["role_doubts"]
    assert "LOG@0:399" in log.attrs["role_doubts"]
    stated = read_log(tmp_path / "half.csv", outputs=["near", "far"])
    assert stated["near"].attrs["role"] == "output"


def test_the_rows_after_the_only_sensor_stuck_are_left_out(tmp_path):
    heater = np.repeat([0, 60] * 15, 20)
    plate = np.round(20 + lfilter([0.1], [1, -0.9], np.r_[0, heater[:-1]]), 2)
    plate[300:] = plate[300]
    rows = [f"{k},{heater[k]},{plate[k]}\n" for k in range(600)]
    (tmp_path / "stuck.csv").write_text("time_s,heater,plate_degC\n" + "".join(rows))
    log = read_log(tmp_path / "stuck.csv")
    assert log.sizes["time"] == 300
    assert "300 rows at the ends of the log, in which no output reads, left out" in log.attrs["repairs"]


@pytest.mark.parametrize(
    ("lost", "how"),
    [("205:230", "drawn"), ("50:350", "drawn"), ("405:435", "held"), ("300:330", "zero"), ("0:0", "held")],
)
def test_rows_that_a_program_filled_in_all_columns_at_once_are_left_out(write, lost, how):
    is_lost = np.isin(PLACES, np.arange(*map(int, lost.split(":"))))
    ramp = np.where((PLACES > 110) & (PLACES < 171), PLACES - 90, HEATER)  # by the drive itself
    noise = 0.05 * np.random.default_rng(0).standard_normal((2, 600))
    columns = [ramp, *(lfilter([1 - a], [1, -a], ramp) + v for a, v in zip((0.9, 0.97), noise))]
    last = np.maximum.accumulate(np.where(is_lost, 0, PLACES))
    for k, v in enumerate(columns):
        drawn = np.interp(PLACES, PLACES[~is_lost], v[~is_lost])
        columns[k] = {"drawn": drawn, "held": v[last], "zero": np.where(is_lost, 0, v)}[how]
    rows = "".join(f"{k},{u:.3f},{a:.3f},{b:.3f}\n" for k, (u, a, b) in enumerate(zip(*columns)))
    log = read_log(write("time_s,heater,plate_degC,block_degC\n" + rows))
    assert np.setxor1d(log["time"].values, PLACES[~is_lost]).size <= 2
    assert ("left out in which a program filled all columns: row" in log.attrs["repairs"]) == is_lost.any()


def test_a_gap_that_was_drawn_straight_is_left_out(write):
    for filled, said in ((slice(0), ""), (slice(150, 230), "drawn straight from")):
        plate = PLATE.copy()
        plate[filled] = np.linspace(PLATE[149], PLATE[230], 82)[1:-1][: plate[filled].size]
        rows = [f"{k},{u},{y:.3f}\n" for k, u, y in zip(PLACES, HEATER, plate)]
        log = read_log(write("".join(["time_s,heater,plate_degC\n", *rows])))
        assert said in log.attrs["repairs"]
        assert np.isnan(column(log, "plate")).sum() == pytest.approx(plate[filled].size, abs=2)
    rng = np.random.default_rng(19)
    heater = np.repeat(50 * rng.integers(0, 2, 60), 20)  # makes noise where it is on
    noise = np.where(heater > 0, 0.5, 0.05) * rng.standard_normal(1200)
    coarse = np.floor(2 * (lfilter([0.01], [1, -0.99], heater) + noise)) / 2  # slow, in steps of .5 degC
    rows = [f"{k},{u},{y}\n" for k, (u, y) in enumerate(zip(heater, coarse))]
    assert np.isfinite(column(read_log(write("".join(["time_s,heater,plate_degC\n", *rows]))), "plate")).all()
