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
    read_header,
    roles_of_data,
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
        ("T_Celsius", ("T", "degC", 1)),
        ("Temp 1 in \N{DEGREE SIGN}C", ("Temp_1", "degC", 1)),
        ("Temp / \N{DEGREE CELSIUS}", ("Temp", "degC", 1)),
        ("T [\N{DEGREE SIGN}]", ("T", "degC", 1)),
        ("oven_c", ("oven", "degC", 1)),
        ("pump_c", ("pump_c", "1", 1)),
        ("Zone C", ("Zone_C", "1", 1)),
        ("T (k)", ("T", "K", 1)),
        ("I [mA]", ("I", "A", 1e-3)),
        ("I [uA]", ("I", "A", 1e-6)),
        ("U [mV]", ("U", "V", 1e-3)),
        ("U, kV", ("U", "V", 1e3)),
        ("P (mW)", ("P", "W", 1e-3)),
        ("dT [mK]", ("dT", "K", 1e-3)),
        ("time [days]", ("time", "s", 86400)),
        ("t (ns)", ("t", "s", 1e-9)),
        ("P {kW}", ("P", "W", 1e3)),
        ("Time (\N{MICRO SIGN}s)", ("Time", "s", 1e-6)),
        ("time_h", ("time", "s", 3600)),
        ("T min", ("T_min", "1", 1)),
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


@pytest.mark.parametrize("word", ["steps", "multisine", "walk", "ramps", "slow noise"])
@pytest.mark.parametrize("noise", [0.002, 0.02])
@pytest.mark.parametrize("pole", [0.9, 0.99])
def test_an_input_of_any_course_is_told_from_its_output(word, noise, pole):
    rng, t = np.random.default_rng(3), np.arange(3000)
    u = {
        "steps": np.repeat(rng.uniform(0, 1, 30), 100),
        "multisine": sum(np.sin(2 * np.pi * f * t + 9 * f) for f in (0.002, 0.005, 0.009, 0.02)),
        "walk": np.cumsum(rng.standard_normal(3000)),
        "ramps": np.interp(t, np.arange(0, 3001, 100), rng.uniform(0, 1, 31)),
        "slow noise": plant_of(rng.standard_normal(3000), 0.95, noise=0),
    }[word]
    y = plant_of(u, pole, noise=noise * np.std(u))
    found = roles_of_data({"y": y, "u": u}, {"u": "1", "y": "1"}, {})
    assert {name: role for name, (role, _) in found.items()} == {"u": "input", "y": "output"}


def test_a_letter_of_a_series_is_no_unit():
    assert read_header("T_C", ["T_A", "T_B", "T_C"]) == ("T_C", "1", 1.0)
    assert join_header("T_C", "1", ["T_A"]) == "T_C"
    with pytest.raises(UserError, match="cannot stand in a header"):
        join_header("T_C", "1")


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
        ("t_inlet", "degC", "disturbance"),
        ("Supply_Air_Temperature", "1", "disturbance"),
        ("inlet_flow", "1", "other"),
        ("t_outlet", "degC", "output"),
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
        ("spindle", "0_255", "input"),
        ("spindle", "V", "input"),
        ("battery", "1", "other"),
        ("rest", "s", "other"),
        ("t_settled", "s", "other"),
    ],
)
def test_roles_guessed_from_names_and_units(name, unit, role):
    assert guess_role(name, unit) == role


UNITS_OF = {"drive": "1", "pump": "1", "t_tank": "degC", "t_surface": "degC", "t_ambient": "degC"}


def test_a_given_list_is_complete():
    roles, reasons = assign_roles(UNITS_OF, outputs=["t_surface"])
    assert reasons["t_ambient"] == "its name is that of the surroundings"
    assert "t_tank" not in reasons
    assert roles == {
        "drive": "input",
        "pump": "input",
        "t_tank": "other",
        "t_surface": "output",
        "t_ambient": "disturbance",
    }


def test_lists_override_the_guess_and_take_names_with_units():
    roles, _ = assign_roles(UNITS_OF, inputs=["drive", "t_ambient_degC"], disturbances=[])
    assert roles["t_ambient"] == "input"
    assert roles["pump"] == "other"


def test_a_listed_name_must_exist_and_stand_once():
    with pytest.raises(UserError, match=r"t_thank.*it has drive, pump"):
        assign_roles(UNITS_OF, outputs=["t_thank"])
    with pytest.raises(UserError, match="listed as input and as output"):
        assign_roles(UNITS_OF, inputs=["drive"], outputs=["drive"])


def plant_of(u, pole=0.9, gain=1.0, noise=0.01, seed=0):
    """Return the response of a first-order plant to an input, one row later, with noise."""
    rng, y = np.random.default_rng(seed), np.zeros(len(u))
    for k in range(1, len(u)):
        y[k] = pole * y[k - 1] + gain * (1 - pole) * u[k - 1]
    return y + noise * rng.standard_normal(len(u))


RNG = np.random.default_rng(5)
HELD = np.repeat(RNG.integers(0, 5, 30), 20).astype(float)
NOISY = RNG.standard_normal(600)
ROOM = 20 + np.cumsum(0.01 * RNG.standard_normal(600))


@pytest.mark.parametrize(
    ("columns", "fixed", "roles"),
    [
        ({"a": HELD, "b": plant_of(HELD)}, {}, {"a": "input", "b": "output"}),
        ({"a": HELD, "b": np.round(10 * plant_of(HELD, pole=0.97, noise=0)) / 10}, {},
         {"a": "input", "b": "output"}),
        ({"b": plant_of(HELD), "a": HELD}, {}, {"a": "input", "b": "output"}),
        ({"a": NOISY, "b": plant_of(NOISY), "c": np.ones(600)}, {},
         {"a": "input", "b": "output", "c": "other"}),
        ({"a": np.sign(NOISY), "b": plant_of(np.sign(NOISY))}, {}, {"a": "input", "b": "output"}),
        ({"a": HELD, "b": plant_of(HELD + ROOM), "room": ROOM}, {},
         {"a": "input", "b": "output", "room": "disturbance"}),
        ({"a": HELD, "b": plant_of(HELD), "c": HELD - 1}, {"c": "other"}, {"a": "input", "b": "output"}),
        ({"a": NOISY, "b": plant_of(NOISY)}, {"b": "output"}, {"a": "input"}),
        ({"a": np.where(NOISY > 2.5, np.nan, NOISY), "b": plant_of(NOISY)}, {},
         {"a": "input", "b": "output"}),
        ({"a": NOISY[:8], "b": NOISY[8:16]}, {}, {"a": "input", "b": "output"}),
    ],
)  # fmt: skip
def test_the_data_show_what_moves_and_what_follows(columns, fixed, roles):
    units = dict.fromkeys(columns, "1") | {"room": "degC"}
    found = roles_of_data(columns, units, fixed)
    assert {name: role for name, (role, _) in found.items()} == roles


@pytest.mark.parametrize(
    ("gain", "noise", "why"),
    [(5.0, 0.02, "no other is likelier one"),
     (3.0, 4.0, "it predicts the others more than they predict it")],
)  # fmt: skip
def test_a_controller_s_output_is_an_input_though_its_reading_predicts_it(gain, noise, why):
    rng, y, u = np.random.default_rng(1), np.full(2000, 30.0), np.zeros(2000)
    for k in range(1, 2000):
        y[k] = y[k - 1] + 0.02 * u[k - 1] + 0.02 * rng.standard_normal()
        u[k] = gain * (30 - y[k - 1]) + noise * rng.standard_normal()
    units = {"u": "1", "y": "degC", "z": "1"}
    assert roles_of_data({"u": u, "y": y}, units, {"y": "output"}) == {"u": ("input", why)}
    found = roles_of_data({"z": plant_of(y, noise=0.001), "y": y, "u": u}, units, {"y": "output"})
    assert (found["u"], found["z"][0]) == (("input", why), "output")


def test_names_go_first_and_data_are_asked_where_these_show_no_input_or_no_output():
    columns = {"a": HELD, "t_x": plant_of(HELD), "b": 50 + NOISY}
    units = {"a": "1", "t_x": "degC", "b": "1"}
    roles, reasons = assign_roles(units, columns=columns)
    assert roles == {"a": "input", "t_x": "output", "b": "disturbance"}  # a is held, b moves in every row
    assert reasons["a"].startswith("it is held between ")
    assert reasons["t_x"] == "its name is that of a reading"
    assert assign_roles(units, columns=columns, inputs=["b"])[0]["a"] == "other"
    named = {"q1": HELD, "t_x": plant_of(HELD), "b": NOISY}
    assert assign_roles({"q1": "1", "t_x": "degC", "b": "1"}, columns=named)[0]["b"] == "other"


def test_beside_held_inputs_a_second_sensor_is_read_and_the_rest_is_a_disturbance():
    slow = 20 + 30 * plant_of(HELD)
    walk, room = np.cumsum(np.random.default_rng(8).standard_normal((2, 600)), axis=1)
    columns = {"c2": HELD, "c4": slow, "c5": 25 + 80 * walk / np.ptp(walk), "c6": 22 + room / np.ptp(room)}
    roles, reasons = assign_roles(dict.fromkeys(columns, "1"), columns=columns)
    assert roles == {"c2": "input", "c4": "output", "c5": "output", "c6": "disturbance"}
    assert reasons["c5"] == "its values lie as those of c4"


def test_beside_a_set_point_input_and_output_are_the_controllers():
    goal, pwm = np.repeat([30.0, 60.0], 300), 100 + 10 * NOISY
    columns = {"set": goal, "input": 20 + 5 * plant_of(HELD), "output": pwm}
    units = dict.fromkeys(columns, "1")
    roles = assign_roles(units, columns=columns)[0]
    assert roles == {"set": "other", "input": "output", "output": "input"}
    assert assign_roles(units, columns=columns, inputs=["input"])[0]["input"] == "input"
    del units["set"], columns["set"]
    assert assign_roles(units, columns=columns)[0]["input"] == "input"


def test_one_column_beside_the_weather_is_the_output():
    columns = {"oat": ROOM, "meter": 2 * NOISY}
    roles = assign_roles({"oat": "1", "meter": "W"}, columns=columns)[0]
    assert roles == {"oat": "disturbance", "meter": "output"}


def test_columns_beyond_all_use_have_no_role_and_overflow_nothing():
    columns = {"u": HELD, "a": 8.988e307 * np.sign(NOISY), "b": plant_of(HELD)}
    roles = assign_roles(dict.fromkeys("uab", "1"), columns=columns)[0]
    assert roles == {"u": "input", "a": "other", "b": "output"}


READING = np.round(4 * (20 + 5 * plant_of(HELD, noise=0.02))) / 4  # degC, a converter of 0.25
GOAL = np.repeat([30.0, 60.0], 300)


@pytest.mark.parametrize(
    ("columns", "roles", "reason"),
    [
        # a PID's log: what it computes is neither moved nor read
        ({"u": ("1", HELD), "t_a": ("degC", READING), "setpoint": ("1", GOAL), "dev": ("1", GOAL - READING)},
         "input output other other", "it is computed from setpoint and t_a"),
        ({"u": ("1", HELD), "t_a": ("degC", READING), "setpoint": ("1", GOAL),
          "dev": ("1", np.trunc(GOAL - READING))},
         "input output other other", "it is computed from setpoint and t_a"),
        ({"u": ("1", HELD), "t_a": ("degC", READING), "raw": ("1", 100 - 2.5 * READING)},
         "input output other", "it is t_a in another unit"),
        ({"u": ("1", HELD), "t_a": ("degC", READING), "adc": ("1", np.rint(9e3 * np.exp(0.01 * READING)))},
         "input output other", "it is t_a in another unit"),
        ({"u": ("1", HELD), "t_a": ("degC", np.round(READING + NOISY, 2)), "r": ("1", 9 / (READING + NOISY))},
         "input output other", "it is t_a in another unit"),
        ({"u": ("1", HELD), "t_a": ("degC", READING), "t_f": ("degC", 1.8 * READING + 32)},
         "input output other", "it is t_a in another unit"),
        ({"a": ("1", 2.55 * HELD), "q1": ("1", HELD), "t_a": ("degC", READING)},
         "other input output", "it is q1 in another unit"),
        # a second sensor of the same thing is none
        ({"u": ("1", HELD), "t_a": ("degC", READING), "t_b": ("degC", READING + 0.02 * NOISY)},
         "input output output", "its name is that of a reading"),
        # volts: of a sensor where the drive is held, of a drive where a controller moves it or it is held
        ({"a": ("1", HELD), "t_a": ("degC", READING), "cell": ("V", NOISY)},
         "input output other", "it moves in most rows, and a is held between its moves, as inputs are"),
        ({"a": ("1", HELD), "t_a": ("degC", READING), "cell": ("V", np.r_[[np.inf] * 3, NOISY[3:]])},
         "input output other", "it moves in most rows, and a is held between its moves, as inputs are"),
        ({"t_a": ("degC", READING), "cell": ("V", NOISY)}, "output input", "its unit is V"),
        ({"t_a": ("degC", READING), "cell": ("V", HELD)}, "output input", "its unit is V"),
        # counts of rows, and of the hours of a day
        ({"a": ("1", HELD), "t_a": ("degC", READING), "b": ("1", np.arange(600.0))},
         "input output other", "it counts rows or time"),
        ({"a": ("1", HELD), "t_a": ("degC", READING), "b": ("1", np.arange(600) % 24.0)},
         "input output other", "it counts rows or time"),
        ({"a": ("1", HELD), "t_a": ("degC", READING), "Hour": ("1", HELD[::-1])},
         "input output other", "its name is that of a number of the clock's or the controller's"),
        ({"u1": ("1", HELD), "t_a": ("degC", READING), "Kp": ("1", HELD[::-1])},
         "input output other", "its name is that of a number of the clock's or the controller's"),
    ],
)  # fmt: skip
def test_what_is_computed_or_counted_is_neither_moved_nor_read(columns, roles, reason):
    units = {name: unit for name, (unit, _) in columns.items()}
    values = {name: v for name, (_, v) in columns.items()}
    found, reasons = assign_roles(units, columns=values)
    assert [found[name] for name in columns] == roles.split()
    odd = [name for name in columns if found[name] == "other" and name != "setpoint"]
    assert reasons[(odd or [*columns])[-1]] == reason
    # a user's word goes before, and twenty rows are what it takes to compare
    assert assign_roles(units, columns=values, outputs=[[*columns][-1]])[0][[*columns][-1]] == "output"
    few = {name: v[:19] for name, v in values.items()}
    assert not any("in another unit" in why for why in assign_roles(units, columns=few)[1].values())


@pytest.mark.parametrize(("moves", "role"), [(1, "disturbance"), (4, "disturbance"), (5, "other")])
def test_columns_that_move_together_five_times_are_copies(moves, role):
    level = np.minimum(np.arange(20.0), moves) ** 2
    columns = {"q1": level, "t_ambient": 20 + 2 * level, "t_a": np.arange(20.0) % 7}
    units = {"q1": "percent", "t_ambient": "degC", "t_a": "degC"}
    assert assign_roles(units, columns=columns)[0] == {"q1": "input", "t_ambient": role, "t_a": "output"}
