"""Headers, units and roles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.units import (
    UNITS,
    assign_roles,
    guess_role,
    join_header,
    split_header,
    to_record_unit,
)

NAMES = st.from_regex(r"[a-z]{2,8}(_[0-9])?", fullmatch=True)


@pytest.mark.parametrize(
    ("value", "unit", "celsius"),
    [
        (273.15, "K", 0.0),
        (0.0, "K", -273.15),
        (32.0, "degF", 0.0),
        (212.0, "degF", 100.0),
        (-40.0, "degF", -40.0),
    ],
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
        ("t_tank_degc", "t_tank_degC"),
        ("t_tank_Celsius", "t_tank_degC"),
        ("t_tank_kelvin", "t_tank_K"),
        ("q1_pct", "q1_percent"),
        ("q1_%", "q1_percent"),
        ("time_sec", "time_s"),
        ("u_mV", "convert it and rename the column to u_V"),
        ("time_h", "convert it and rename the column to time_s"),
        ("p_bar", "use one of"),
        ("t_tank [degC]", "rename the column to t_tank_degC"),
        ("t_tank(C)", "rename the column to t_tank_degC"),
        ("Plate temp (°F)", "rename the column to Plate_temp_degF"),
        ("U [mV]", "write the unit as a suffix"),
        ("t_tank_°C", "t_tank_degC"),
    ],
)
def test_a_suffix_that_looks_like_another_unit_is_refused_with_a_hint(header, hint):
    with pytest.raises(UserError) as fault:
        split_header(header, file="a.csv")
    assert hint in str(fault.value)
    assert header in str(fault.value)
    assert "\n" not in str(fault.value)


@pytest.mark.parametrize("header", ["t_surface_2", "pump_a", "pump_c", "t_tank", "drive", "q1", "x_old"])
def test_a_suffix_that_is_no_unit_is_part_of_the_name(header):
    assert split_header(header) == (header, "1")


@pytest.mark.parametrize("header", ["_degC", "", "a b_degC", "a;b"])
def test_a_header_without_a_name_is_refused(header):
    with pytest.raises(UserError, match="no name"):
        split_header(header)


@pytest.mark.parametrize(
    ("name", "unit", "role"),
    [
        ("drive", "1", "input"),
        ("pump", "1", "input"),
        ("pump", "V", "input"),
        ("q2", "percent", "input"),
        ("pwm", "0_255", "input"),
        ("flow", "1", "input"),
        ("fan_left", "percent", "input"),
        ("t_ambient", "degC", "disturbance"),
        ("ambient", "degC", "disturbance"),
        ("room", "degC", "disturbance"),
        ("t_tank", "degC", "output"),
        ("chamber", "degC", "output"),
        ("pump", "degC", "output"),
        ("level", "V", "output"),
        ("setpoint", "degC", "other"),
        ("t_target", "degC", "other"),
        ("set", "degC", "other"),
        ("sp1", "degC", "other"),
        ("t1_sp", "degC", "other"),
        ("temp_set", "degC", "other"),
        ("target_t_tank", "degC", "other"),
        ("setpoint_2", "degC", "other"),
        ("heater_set", "percent", "input"),
        ("t_settled", "degC", "output"),
        ("spindle", "percent", "input"),
        ("battery", "1", "other"),
        ("rest", "s", "other"),
    ],
)
def test_roles_guessed_from_names_and_units(name, unit, role):
    assert guess_role(name, unit) == role


UNITS_OF = {"drive": "1", "pump": "1", "t_tank": "degC", "t_surface": "degC", "t_ambient": "degC"}


def test_a_given_list_is_complete():
    roles = assign_roles(UNITS_OF, outputs=["t_surface"])
    assert roles == {
        "drive": "input",
        "pump": "input",
        "t_tank": "other",
        "t_surface": "output",
        "t_ambient": "disturbance",
    }


def test_lists_override_the_guess_and_take_names_with_units():
    roles = assign_roles(UNITS_OF, inputs=["drive", "t_ambient_degC"], disturbances=[])
    assert roles["t_ambient"] == "input"
    assert roles["pump"] == "other"


def test_a_listed_name_must_exist_and_stand_once():
    with pytest.raises(UserError, match=r"t_thank.*it has drive, pump"):
        assign_roles(UNITS_OF, outputs=["t_thank"])
    with pytest.raises(UserError, match="listed as input and as output"):
        assign_roles(UNITS_OF, inputs=["drive"], outputs=["drive"])
