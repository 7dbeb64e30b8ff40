"""What is written is read back, and no file, however broken, gives anything but a log or one line."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.log_files import read_log, write_log
from thermogrip.datasets.schema import make_log

ENDINGS = [".csv", ".csv.gz", ".csv.xz", ".nc", ".parquet"]
SLOW = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])

FLOATS = st.floats(allow_nan=False, allow_infinity=False, width=64)


@st.composite
def logs(draw):
    """Logs with any inputs; outputs that no spike rule would touch, with lost samples."""
    n = draw(st.integers(2, 30))
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


CELLS = st.one_of(
    st.sampled_from(
        ["", "nan", "inf", "-1e309", "warm", "1,5", '"', "'", "1e", "0x1F", "٣", "1_0", "#", " "]
    ),
    st.text(max_size=8),
    FLOATS.map(repr),
)


@SLOW
@given(
    rows=st.lists(st.lists(CELLS, min_size=1, max_size=5), max_size=8),
    header=st.sampled_from(["time_s,drive,t_a_degC", "time_s;drive;t_a_degC", "time_ms,t_a_K", "time_s"]),
)
def test_a_corrupted_csv_is_a_log_or_one_line(tmp_path, rows, header):
    path = tmp_path / "log.csv"
    path.write_text("\n".join([header, "0,1,20", *(",".join(r) for r in rows)]), encoding="utf-8", newline="")
    assert what_is_wrong(path) == ""


@SLOW
@given(data=st.binary(max_size=400), ending=st.sampled_from(ENDINGS))
def test_any_bytes_are_a_log_or_one_line(tmp_path, data, ending):
    path = tmp_path / f"log{ending}"
    path.write_bytes(data)
    assert what_is_wrong(path) == ""


@SLOW
@given(where=st.floats(0, 1), value=st.integers(0, 255), ending=st.sampled_from(ENDINGS))
@example(where=0.015625, value=13, ending=".csv")  # a carriage return in the header
def test_one_flipped_byte_is_a_log_or_one_line(tmp_path, small_log, where, value, ending):
    path = write_log(small_log, tmp_path / f"log{ending}")
    data = bytearray(path.read_bytes())
    data[int(where * (len(data) - 1))] = value
    path.write_bytes(bytes(data))
    assert what_is_wrong(path) == ""


@SLOW
@given(share=st.floats(0, 1), ending=st.sampled_from(ENDINGS))
def test_a_file_cut_anywhere_is_a_log_or_one_line(tmp_path, small_log, share, ending):
    path = write_log(small_log, tmp_path / f"log{ending}")
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    assert what_is_wrong(path) == ""


def what_is_wrong(path):
    """Return why a file gave neither a log that is one nor one line with its name in it; "" where it did."""
    try:
        log = read_log(path)
    except UserError as fault:
        line = str(fault)
        return "" if "\n" not in line and path.name in line else f"said {line!r}"
    time = log["time"].values
    whole = time.size >= 2 and np.isfinite(time).all() and (np.diff(time) > 0).all()
    return "" if whole and len(log.data_vars) >= 1 else f"gave {log}"


def test_what_is_neither_a_log_nor_a_line_is_noticed(tmp_path, monkeypatch):
    path = tmp_path / "log.csv"
    path.write_text("time_s,t_a_degC\n0,20\n1,20\n")
    assert what_is_wrong(path) == ""
    assert what_is_wrong(tmp_path / "none.csv") == ""  # one line, with its name

    def refuse(_path):
        raise UserError("a line that does not say which file")

    monkeypatch.setitem(globals(), "read_log", refuse)
    assert what_is_wrong(path) != ""
