"""Headers and units."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.units import UNITS, join_header, read_header, split_header, to_record_unit

NAMES = st.from_regex(r"[a-z]{2,8}(_[0-9])?", fullmatch=True)


@pytest.mark.parametrize(
    ("value", "unit", "celsius"),
    [(273.15, "K", 0.0), (0.0, "K", -273.15), (32.0, "degF", 0.0), (212.0, "degF", 100.0)],
)
def test_fixed_points_of_the_scales(value, unit, celsius):
    got, got_unit = to_record_unit(np.array([value]), unit)
    assert got_unit == "degC"
    assert got[0] == pytest.approx(celsius, abs=1e-9)


def test_times_become_seconds():
    assert to_record_unit(np.array([1500.0]), "ms") == (np.array([1.5]), "s")
    assert to_record_unit(np.array([1.5]), "min") == (np.array([90.0]), "s")


def test_kelvin_of_a_sixteenth_grid_gives_the_sixteenth_back():
    celsius = np.arange(-100, 1000) / 16
    got, _ = to_record_unit(np.round(celsius + 273.15, 4), "K")
    np.testing.assert_array_equal(got, celsius)


@given(NAMES, st.sampled_from(["1", *UNITS]))
def test_a_header_is_read_as_it_was_written(name, unit):
    assert split_header(join_header(name, unit)) == (name, unit)


@pytest.mark.parametrize(
    ("header", "hint"),
    [
        ("t_tank_C", "t_tank_degC"),
        ("t_tank_F", "t_tank_degF"),
        ("t_tank_c", "t_tank_degC"),
        ("t_tank_Celsius", "t_tank_degC"),
        ("t_tank_kelvin", "t_tank_K"),
        ("q1_pct", "q1_percent"),
        ("q1_%", "q1_percent"),
        ("time_sec", "time_s"),
        ("u_mV", "convert it and rename the column to u_V"),
        ("time_h", "convert it and rename the column to time_s"),
        ("p_bar", "use one of"),
        ("t_tank [degC]", "rename the column to t_tank_degC"),
        ("Plate temp (°F)", "rename the column to Plate_temp_degF"),
        ("U [mV]", "convert it and rename the column to U_V"),
        ("p (bar)", "use one of"),
        ("t_tank_°C", "t_tank_degC"),
    ],
)
def test_a_suffix_that_looks_like_another_unit_is_refused_with_a_hint(header, hint):
    with pytest.raises(UserError) as fault:
        split_header(header, file="a.csv")
    assert hint in str(fault.value)
    assert header in str(fault.value)
    assert "\n" not in str(fault.value)


@pytest.mark.parametrize(
    ("header", "read"),
    [
        ("Heater 1 (%)", ("Heater_1", "percent", 1)),
        ("Temperature, degC", ("Temperature", "degC", 1)),
        ("Temp 1 in \N{DEGREE SIGN}C", ("Temp_1", "degC", 1)),
        ("Temp / \N{DEGREE CELSIUS}", ("Temp", "degC", 1)),
        ("T [\N{DEGREE SIGN}]", ("T", "degC", 1)),
        ("oven_c", ("oven", "degC", 1)),
        ("pump_c", ("pump_c", "1", 1)),
        ("Zone C", ("Zone_C", "1", 1)),
        ("T (k)", ("T", "K", 1)),
        ("I [mA]", ("I", "A", 1e-3)),
        ("Time (min) Run #1", ("Time_Run_#1", "min", 1)),
        ("U [mV]", ("U", "V", 1e-3)),
        ("Temp, \N{DEGREE SIGN}C (LGR S/N: 1)", ("Temp_LGR_S_N:_1", "degC", 1)),
        ("P (mW)", ("P", "W", 1e-3)),
        ("dT [mK]", ("dT", "K", 1e-3)),
        ("time [days]", ("time", "s", 86400)),
        ("t (ns)", ("t", "s", 1e-9)),
        ("P {kW}", ("P", "W", 1e3)),
        ("Time (\N{MICRO SIGN}s)", ("Time", "s", 1e-6)),
        ("time_h", ("time", "s", 3600)),
        ("T min", ("T_min", "1", 1)),
        ("flow_L_min", ("flow_L_min", "1", 1)),
        ("ramp_K_s", ("ramp_K_s", "1", 1)),
        ("T [MIN]", ("T", "min", 1)),
        ("angle_deg", ("angle_deg", "1", 1)),
        ("temp_deg", ("temp", "degC", 1)),
        ("PWM [0-255]", ("PWM", "0_255", 1)),
        ("gain [-]", ("gain", "1", 1)),
        ("Temp (left)", ("Temp_left", "1", 1)),
        ("p (bar)", ("p_bar", "1", 1)),
        ("Plate temp_degF", ("Plate_temp", "degF", 1)),
        ("(degC)", ("", "degC", 1)),
        ('a "b"; cd', ("a_b_cd", "1", 1)),
    ],
)
def test_a_header_of_any_program_is_name_unit_and_factor(header, read):
    assert read_header(header, ["time_h", "oven_c"]) == read


def test_a_letter_of_a_series_is_no_unit():
    assert read_header("T_C", ["T_A", "T_B", "T_C"]) == ("T_C", "1", 1.0)
    assert read_header("heater_A", ["heater_A", "heater_V"]) == ("heater", "A", 1.0)
    assert join_header("T_C", "1", ["T_A"]) == "T_C"
    with pytest.raises(UserError, match="cannot stand in a header"):
        join_header("T_C", "1")


@pytest.mark.parametrize("header", ["t_surface_2", "pump_a", "pump_c", "t_tank", "drive", "q1", "x_l_min"])
def test_a_suffix_that_is_no_unit_is_part_of_the_name(header):
    assert split_header(header) == (header, "1")


@pytest.mark.parametrize("header", ["_degC", "", "a b_degC", "a;b"])
def test_a_header_without_a_name_is_refused(header):
    with pytest.raises(UserError, match="no name"):
        split_header(header)
