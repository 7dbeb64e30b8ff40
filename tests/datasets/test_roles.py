"""Roles of the columns of a log: by name and unit, by the data, and what is doubtful."""

from __future__ import annotations

import numpy as np
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.roles import assign_roles, guess_role, roles_of_data


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


@pytest.mark.parametrize(
    ("name", "unit", "role"),
    [
        ("drive", "1", "input"),
        ("pump", "1", "input"),
        ("Zone-1.Cooling-SP", "1", "other"),
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
        ("pump", "degC", "output"),
        ("level", "V", "output"),
        ("setpoint", "degC", "other"),
        ("t_target", "degC", "other"),
        ("set", "degC", "other"),
        ("sp1", "degC", "other"),
        ("t1_sp", "degC", "other"),
        ("temp_set", "degC", "other"),
        ("Zieltemperatur", "degC", "other"),
        ("consigne", "degC", "other"),
        ("heater_set", "percent", "input"),
        ("t_settled", "degC", "output"),
        ("spindle", "percent", "input"),
        ("spindle", "V", "input"),
        ("battery", "percent", "other"),
        ("Humidity", "percent", "output"),
        ("room_humidity", "percent", "disturbance"),
        ("Proportional", "1", "other"),
        ("Std_Dev", "1", "other"),
        ("rest", "s", "other"),
    ],
)
def test_roles_guessed_from_names_and_units(name, unit, role):
    assert guess_role(name, unit) == role


UNITS_OF = {"drive": "1", "pump": "1", "t_tank": "degC", "t_surface": "degC", "t_ambient": "degC"}


def test_a_given_list_is_complete():
    found = assign_roles(UNITS_OF, outputs=["t_surface"])
    roles, reasons = found.of, found.reasons
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
    roles = assign_roles(UNITS_OF, inputs=["drive", "t_ambient_degC"], disturbances=[]).of
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
COARSE = np.round(16 * (0.3 * np.sin(np.arange(600) / 150) + 0.015 * NOISY)) / 16  # a DS18B20's steps


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
        ({"a": ROOM, "b": plant_of(ROOM), "c": np.r_[251, np.full(599, 100)]}, {},
         {"a": "input", "b": "output", "c": "other"}),
        ({"a": HELD, "b": plant_of(HELD), "c": COARSE}, {},
         {"a": "input", "b": "output", "c": "disturbance"}),
    ],
)  # fmt: skip
def test_the_data_show_what_moves_and_what_follows(columns, fixed, roles):
    units = dict.fromkeys(columns, "1") | {"room": "degC"}
    found = roles_of_data(columns, units, fixed)
    assert {name: role for name, (role, _) in found.items()} == roles


@pytest.mark.parametrize(("gain", "noise"), [(5.0, 0.02), (3.0, 4.0)])
def test_a_controller_s_output_is_an_input_though_its_reading_predicts_it(gain, noise):
    rng, y, u = np.random.default_rng(1), np.full(2000, 30.0), np.zeros(2000)
    for k in range(1, 2000):
        y[k] = y[k - 1] + 0.02 * u[k - 1] + 0.02 * rng.standard_normal()
        u[k] = gain * (30 - y[k - 1]) + noise * rng.standard_normal()
    units, why = {"u": "1", "y": "degC", "z": "1"}, "no other predicts the others more"
    assert roles_of_data({"u": u, "y": y}, units, {"y": "output"}) == {"u": ("input", why)}
    found = roles_of_data({"z": plant_of(y, noise=0.001), "y": y, "u": u}, units, {"y": "output"})
    assert (found["u"], found["z"][0]) == (("input", why), "output")


def test_names_go_first_and_data_are_asked_where_these_show_no_input_or_no_output():
    columns = {"a": HELD, "t_x": plant_of(HELD), "b": 50 + NOISY}
    units = {"a": "1", "t_x": "degC", "b": "1"}
    found = assign_roles(units, columns=columns)
    roles, reasons = found.of, found.reasons
    assert roles == {"a": "input", "t_x": "output", "b": "disturbance"}  # a is held, b moves in every row
    assert reasons["a"].startswith("it is held between ")
    assert reasons["t_x"] == "its name is that of a reading"
    assert assign_roles(units, columns=columns, inputs=["b"]).of["a"] == "other"
    named = {"q1": HELD, "t_x": plant_of(HELD), "b": NOISY}
    assert assign_roles({"q1": "1", "t_x": "degC", "b": "1"}, columns=named).of["b"] == "other"


def test_beside_held_inputs_what_nothing_predicts_is_a_disturbance():
    slow = 20 + 30 * plant_of(HELD)
    walk, room = np.cumsum(np.random.default_rng(8).standard_normal((2, 600)), axis=1)
    columns = {"c2": HELD, "c4": slow, "c5": 25 + 80 * walk / np.ptp(walk), "c6": 22 + room / np.ptp(room)}
    found = assign_roles(dict.fromkeys(columns, "1"), columns=columns)
    assert found.of == {"c2": "input", "c4": "output", "c5": "disturbance", "c6": "disturbance"}
    assert found.reasons["c5"] == "no other column predicts its course"


def test_beside_a_set_point_input_and_output_are_the_controllers():
    goal, pwm = np.repeat([30.0, 60.0], 300), 100 + 10 * NOISY
    columns = {"set": goal, "input": 20 + 5 * plant_of(HELD), "output": pwm}
    units = dict.fromkeys(columns, "1")
    roles = assign_roles(units, columns=columns).of
    assert roles == {"set": "other", "input": "output", "output": "input"}
    assert assign_roles(units, columns=columns, inputs=["input"]).of["input"] == "input"
    reading = {"temperature": columns["input"], "setpoint": goal}
    named = {"automatic": 1.0 * (goal > 40), **reading, "output": HELD}
    found = assign_roles(dict.fromkeys(named, "1"), columns=named)
    assert [found.of[name] for name in named] == ["other", "output", "other", "input"]
    assert not found.doubts
    del units["set"], columns["set"]
    assert assign_roles(units, columns=columns).of["input"] == "input"


def test_one_column_alone_or_beside_the_weather_is_the_output():
    columns = {"oat": ROOM, "meter": 2 * NOISY}
    roles = assign_roles({"oat": "1", "meter": "W"}, columns=columns).of
    assert roles == {"oat": "disturbance", "meter": "output"}
    late = np.maximum(np.arange(300.0) - 2, 0)  # a step test whose step is at its start
    columns = {"c2": 20.0 * (late > 0), "c4": np.round(24.7 + 6 * (1 - np.exp(-late / 60)), 1)}
    assert assign_roles(dict.fromkeys(columns, "1"), columns=columns).of == {"c2": "input", "c4": "output"}
    columns = {"c1": np.sin(np.arange(200.0) / 9), "c2": np.full(200, 635051.0)}
    assert assign_roles(dict.fromkeys(columns, "1"), columns=columns).of == {"c1": "output", "c2": "other"}


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
        ({"u": ("1", HELD), "t_a": ("degC", READING), "t_f": ("degC", 1.8 * READING + 32)},
         "input output other", "it is t_a in another unit"),
        ({"a": ("1", 2.55 * HELD), "q1": ("1", HELD), "t_a": ("degC", READING)},
         "other input output", "it is q1 in another unit"),
        # a second sensor of the same thing is none
        ({"u": ("1", HELD), "t_a": ("degC", READING), "t_b": ("degC", READING + 0.02 * NOISY)},
         "input output output", "its name is that of a reading"),
        ({"t_a": ("degC", READING), "cell": ("V", NOISY)}, "output input", "its unit is V"),
        ({"t_a": ("degC", READING), "cell": ("V", HELD)}, "output input", "its unit is V"),
        # counts of rows, and of the hours of a day
        ({"a": ("1", HELD), "t_a": ("degC", READING), "b": ("1", np.arange(600.0))},
         "input output other", "it counts rows or time"),
        ({"a": ("1", HELD), "t_a": ("degC", READING), "b": ("1", np.arange(600) % 24.0)},
         "input output other", "it counts rows or time"),
        ({"a": ("1", HELD), "t_a": ("degC", READING), "Hour": ("1", HELD[::-1])},
         "input output other", "its name is that of a clock, a controller's term or a computed value"),
        ({"u1": ("1", HELD), "t_a": ("degC", READING), "Kp": ("1", HELD[::-1])},
         "input output other", "its name is that of a clock, a controller's term or a computed value"),
    ],
)  # fmt: skip
def test_what_is_computed_or_counted_is_neither_moved_nor_read(columns, roles, reason):
    units = {name: unit for name, (unit, _) in columns.items()}
    values = {name: v for name, (_, v) in columns.items()}
    assigned = assign_roles(units, columns=values)
    found, reasons = assigned.of, assigned.reasons
    assert [found[name] for name in columns] == roles.split()
    odd = [name for name in columns if found[name] == "other" and name != "setpoint"]
    assert reasons[(odd or [*columns])[-1]] == reason
    # a user's word goes before, and twenty rows are what it takes to compare
    assert assign_roles(units, columns=values, outputs=[[*columns][-1]]).of[[*columns][-1]] == "output"
    few = {name: v[:19] for name, v in values.items()}
    assert not any("in another unit" in why for why in assign_roles(units, columns=few).reasons.values())


@pytest.mark.parametrize(("moves", "role"), [(1, "disturbance"), (4, "disturbance"), (5, "other")])
def test_columns_that_move_together_five_times_are_copies(moves, role):
    level = np.minimum(np.arange(20.0), moves) ** 2
    columns = {"q1": level, "t_ambient": 20 + 2 * level, "t_a": np.arange(20.0) % 7}
    units = {"q1": "percent", "t_ambient": "degC", "t_a": "degC"}
    assert assign_roles(units, columns=columns).of == {"q1": "input", "t_ambient": role, "t_a": "output"}


def relay(seed, n=3000):
    """Return an on/off course whose holds are drawn, of at least five rows."""
    rng = np.random.default_rng(seed)
    return np.concatenate([np.full(5 + int(rng.exponential(40)), at % 2, float) for at in range(n // 20)])[:n]


@pytest.mark.parametrize("names", [("pump", "valve"), ("a", "b"), ("heater", "cooler")])
@pytest.mark.parametrize("scale", [1.0, 100.0])
@pytest.mark.parametrize("seed", [1, 2])
def test_two_relays_that_know_nothing_of_each_other_are_two_inputs(names, scale, seed):
    first, second = relay(seed), scale * relay(seed + 10)
    columns = dict(zip(names, (first, second))) | {"t_a": 20 + plant_of(first + second / scale)}
    roles = assign_roles(dict.fromkeys(names, "1") | {"t_a": "degC"}, columns=columns)
    assert [roles.of[name] for name in columns] == ["input", "input", "output"]


def test_relays_that_are_never_on_together_are_two_inputs():
    heater = relay(3)
    cooler = relay(4) * (1 - heater)
    columns = {"heater": heater, "cooler": cooler, "t_a": 20 + plant_of(heater - cooler)}
    roles = assign_roles({"heater": "1", "cooler": "1", "t_a": "degC"}, columns=columns)
    assert [roles.of[name] for name in columns] == ["input", "input", "output"]
    assert roles.doubts == ()


@pytest.mark.parametrize("course", [relay(5), np.repeat(np.random.default_rng(0).uniform(0, 100, 150), 20)])
def test_heaters_that_always_move_together_are_one_named_pair_and_a_doubt(course):
    columns = {"top": course, "bottom": 0.5 * course + 1, "oven": 20 + plant_of(course)}
    roles = assign_roles({"top": "percent", "bottom": "percent", "oven": "degC"}, columns=columns)
    assert roles.of == {"top": "input", "bottom": "other", "oven": "output"}
    assert "their effects cannot be estimated separately: top is kept for both" in roles.doubts[0]
    stated = assign_roles(
        {"top": "percent", "bottom": "percent", "oven": "degC"}, columns=columns, inputs=["top", "bottom"]
    )
    assert (stated.of["bottom"], stated.doubts) == ("input", ())


def test_what_a_proportional_controller_drives_is_no_copy_of_what_it_reads():
    rng, y = np.random.default_rng(0), np.full(2000, 20.0)
    for k in range(1, 2000):
        y[k] = y[k - 1] + 0.02 * (40 - y[k - 1]) + 0.05 * rng.standard_normal()
    columns = {"heater": 3 * (50 - y), "t_plate": y}
    roles = assign_roles({"heater": "percent", "t_plate": "degC"}, columns=columns)
    assert roles.of == {"heater": "input", "t_plate": "output"}


@pytest.mark.parametrize(
    ("names", "roles"),
    [
        (("relay", "room", "outside"), "input output disturbance"),
        (("q1", "t_room", "weather"), "input output disturbance"),
        (("heater", "t_ambient", "oat"), "input output disturbance"),
    ],
)
def test_a_room_that_the_drive_heats_is_an_output_and_the_weather_never_is(names, roles):
    drive, weather = relay(6), 5 + np.cumsum(0.02 * np.random.default_rng(2).standard_normal(3000))
    columns = dict(zip(names, (drive, 18 + 4 * plant_of(drive, 0.98) + 0.2 * weather, weather)))
    units = dict(zip(names, ("1", "degC", "degC")))
    assert [assign_roles(units, columns=columns).of[name] for name in names] == roles.split()


def test_the_room_around_a_rig_stays_a_disturbance_though_the_rig_warms_it_a_little():
    drive = relay(7)
    skin = 20 + 10 * plant_of(drive, 0.95)
    columns = {"drive": drive, "t_surface": skin, "t_ambient": 20 + plant_of(0.05 * skin, 0.99)}
    units = {"drive": "1", "t_surface": "degC", "t_ambient": "degC"}
    assert assign_roles(units, columns=columns).of["t_ambient"] == "disturbance"


def test_a_column_that_is_left_out_is_a_doubt_where_it_helps_to_predict():
    drive, load = relay(8), np.random.default_rng(4).standard_normal(3000).cumsum()
    plate = 20 + plant_of(drive + 0.1 * load)
    for other, doubt in ((load, 1), (np.random.default_rng(5).standard_normal(3000), 0)):
        columns = {"heater": drive, "t_plate": plate, "blob": other}
        roles = assign_roles({"heater": "1", "t_plate": "degC", "blob": "1"}, columns=columns)
        assert (roles.of["blob"], len(roles.doubts)) == ("other", doubt)
        assert all("blob is left out" in line and "t_plate" in line for line in roles.doubts)


def test_roles_that_the_course_alone_shows_are_doubts():
    drive = relay(9)
    roles = assign_roles({"c1": "1", "c2": "1"}, columns={"c1": drive, "c2": plant_of(drive)})
    assert roles.of == {"c1": "input", "c2": "output"}
    assert len(roles.doubts) == 2
    assert assign_roles({"q1": "1", "t1": "1"}, columns={"q1": drive, "t1": plant_of(drive)}).doubts == ()
    kelvin = assign_roles({"q1": "1", "t1": "1"}, columns={"q1": drive, "t1": 3000 + plant_of(drive)}).doubts
    assert "t1 has no unit and a median of 30" in kelvin[0]
    assert [*assign_roles(dict.fromkeys(["u", "y", "y_hat", "y_avg"], "1")).of.values()][2:] == ["other"] * 2


@pytest.mark.parametrize(
    ("name", "role"),
    [("BeerSet", "other"), ("BeerTemp", "output"), ("extruder_temp", "output"), ("extruder_target", "other"),
     ("extruder_pwm", "input"), ("@", "input"), ("B@", "input"), ("T_target", "other"),
     ("outside", "disturbance"), ("T_Sollwert", "other"), ("Dew point", "other")],
)  # fmt: skip
def test_names_that_programs_give_their_columns(name, role):
    assert guess_role(name, "1") == role


def under_control(target, gain, rows=1800):
    """Return reading and drive of a PI loop on a plant of one time constant."""
    rng, y, u, total = np.random.default_rng(6), np.full(rows, 20.0), np.zeros(rows), 0.0
    for k in range(rows - 1):
        error = target[k] - y[k] + 0.05 * rng.standard_normal()
        total += 0.1 * error
        u[k] = np.clip(gain * error + total, 0, 100)
        y[k + 1] = y[k] + 0.02 * (20 + 0.8 * u[k] - y[k])
    return np.round(y, 2), np.round(u, 1)


GOALS = np.repeat(np.random.default_rng(1).permutation([30.0, 45.0, 60.0, 38.0, 52.0, 70.0]), 300)


def test_what_a_reading_comes_to_is_its_set_point_by_whatever_name():
    y, u = under_control(GOALS, 5.0)
    roles = assign_roles({"uno": "1", "due": "1", "tre": "1"}, columns={"uno": GOALS, "due": u, "tre": y})
    assert roles.of == {"uno": "other", "due": "input", "tre": "output"}
    assert any(line.startswith("uno is left out: tre settles at its levels") for line in roles.doubts)


@pytest.mark.parametrize("names", [("Setpoint", "Input", "Output"), ("SP", "PV", "OP")])
def test_the_terms_of_a_controller_are_neither_moved_nor_read(names):
    y, u = under_control(GOALS, 5.0)
    terms = {"P": 5 * (GOALS - y), "I": np.cumsum(GOALS - y), "D": np.gradient(y)}
    columns = dict(zip(names, (GOALS, y, u))) | terms
    roles = assign_roles(dict.fromkeys(columns, "1"), columns=columns)
    assert [roles.of[name] for name in columns] == ["other", "output", "input", *["other"] * 3]


@pytest.mark.parametrize(
    ("name", "role"), [("chiller", "input"), ("buiten", "disturbance"), ("gang", "output")]
)
def test_what_acts_on_an_output_without_a_name_has_its_role_and_a_doubt(name, role):
    """A second relay, the weather, and a room behind the heated one."""
    heater, weather = relay(6), 5 + np.cumsum(0.02 * np.random.default_rng(2).standard_normal(3000))
    behind = 10 + plant_of(plant_of(8 * heater, 0.98), 0.98)
    other = {"chiller": relay(11), "buiten": weather, "gang": behind}[name]
    room = 10 + plant_of(8 * heater + other, 0.98)
    units = {"heater": "1", "kamer": "degC", name: "1" if name == "chiller" else "degC"}
    roles = assign_roles(units, columns={"heater": heater, "kamer": room, name: other})
    assert roles.of == {"heater": "input", "kamer": "output", name: role}
    assert [line.split(" is taken")[0] for line in roles.doubts] == [name] * (role != "output")


def test_elements_without_a_clue_that_always_move_together_are_one_pair():
    course = np.repeat(np.random.default_rng(0).choice([0.0, 20, 50, 80], 150), 20)
    columns = {"left": course, "right": course, "oven": 20 + plant_of(course)}
    roles = assign_roles({"left": "1", "right": "1", "oven": "degC"}, columns=columns)
    assert roles.of == {"left": "input", "right": "other", "oven": "output"}
    assert any("right is left out: it always moves with left" in line for line in roles.doubts)


def test_what_a_drive_without_a_name_moves_is_no_weather():
    fan, chiller = relay(6), relay(11)
    kettle, pipe = 20 + plant_of(8 * chiller, 0.98, noise=0.05), 20 + plant_of(5 * fan + chiller, 0.98)
    columns = {"fan": fan, "chiller": chiller, "kettle": kettle, "pipe": pipe}
    units = {"fan": "1", "chiller": "1", "kettle": "degC", "pipe": "degC"}
    roles = assign_roles(units, columns=columns).of
    assert roles == {"fan": "input", "chiller": "input", "kettle": "output", "pipe": "output"}


STEPS = np.repeat(np.random.default_rng(3).choice([0.0, 20.0, 50.0, 90.0], 40), 25)
SLOW, SMOOTH = plant_of(STEPS), np.cumsum(plant_of(0 * STEPS, noise=1, seed=2)) / 50


@pytest.mark.parametrize(
    ("name", "values", "doubt"),
    [
        ("pump", np.repeat(np.random.default_rng(5).choice([0.0, 1.0], 50), 20), "no reading responds to it"),
        ("heater_total", np.cumsum(STEPS), "only rises or falls"),
        ("valve_feedback", np.r_[np.zeros(7), STEPS[:-7]], "follows heater"),
        ("power", 19 * STEPS + 20 * np.random.default_rng(6).standard_normal(STEPS.size), "follows heater"),
        ("ambient", plant_of(0.2 * STEPS, seed=7), "ambient is taken as disturbance"),
        ("sample", plant_of(0.3 * STEPS, 0.9, seed=8), "sample is left out"),
        ("target_plate", plant_of(0.3 * STEPS, 0.9, seed=8), "target_plate is left out"),
        ("power", plant_of(0.3 * STEPS, 0.9, seed=8), "power is taken as input"),
        ("level", np.cumsum(plant_of(0 * STEPS, noise=1, seed=9)), "level is taken as output"),
    ],
)
def test_a_name_that_the_course_of_the_column_denies_is_a_doubt(name, values, doubt):
    columns = {"heater": STEPS, "t_plate": SLOW + SMOOTH, name: values}
    roles = assign_roles({"heater": "percent", "t_plate": "degC", name: "1"}, columns=columns)
    assert any(doubt in line and name in line for line in roles.doubts)
    del columns[name]
    assert not assign_roles({"heater": "percent", "t_plate": "degC"}, columns=columns).doubts


def test_a_percentage_that_a_reading_moves_is_asked_about_as_an_input():
    t_box = np.cumsum(plant_of(0 * STEPS, noise=1, seed=9)) / 50
    columns = {"t_box": t_box, "wilgoc": 60 - plant_of(t_box, seed=10)}
    doubts = assign_roles({"t_box": "degC", "wilgoc": "percent"}, columns=columns).doubts
    assert "wilgoc is taken as input (its unit is percent), but responds to t_box: is it read?" in doubts


def test_an_output_with_an_input_of_its_own_is_not_left_out_in_silence():
    mist = np.repeat(np.random.default_rng(5).choice([0.0, 1.0], 50), 20)
    columns = {"heater": STEPS, "t_plate": SLOW, "mist": mist, "wet": plant_of(25 * mist, seed=8)}
    roles = assign_roles({"heater": "percent", "t_plate": "degC", "mist": "1", "wet": "1"}, columns=columns)
    assert [line for line in roles.doubts if "wet is left out" in line and "responds to mist" in line]


def test_a_spike_hides_no_response():
    spiked = np.where(np.arange(STEPS.size) == 300, 9e3, SLOW + SMOOTH)
    columns = {"heater": STEPS, "t_plate": spiked, "fan": relay(5)[: STEPS.size]}
    columns["air_temp"] = 20 + plant_of(columns["fan"])
    roles = assign_roles({"heater": "percent", "t_plate": "1", "fan": "1", "air_temp": "1"}, columns=columns)
    assert (roles.of["t_plate"], roles.doubts) == ("output", ())


def test_what_readings_say_of_each_other_is_a_doubt():
    drive = np.repeat(np.random.default_rng(3).choice([0.0, 40.0, 90.0], 40), 25)
    t_in = plant_of(drive)
    columns = {"duty": drive, "t_in": t_in, "t_out": plant_of(t_in, seed=1)}
    columns |= {
        "q": 70 * (t_in - columns["t_out"]),
        "t_hall": np.cumsum(plant_of(0 * drive, noise=1, seed=2)),
    }
    roles = assign_roles(dict.fromkeys(columns, "1"), columns=columns)
    assert list(roles.of.values()) == ["input", "output", "output", "input", "disturbance"]
    assert "but is computed from t_in and t_out: a heat" in roles.doubts[0]
    assert roles.doubts[1] == "t_hall is taken as disturbance: it does not respond to duty, q"


def test_a_held_column_that_moves_as_the_input_does_is_a_doubt():
    drive = np.repeat(np.random.default_rng(3).choice([0.0, 1.0, 2.0], 40), 25)
    t_cold = plant_of(drive, gain=-7.0)
    voltage = 2 * drive + 0.02 * t_cold + 0.001 * np.random.default_rng(4).standard_normal(drive.size)
    columns = {"kk": drive, "u_1": voltage, "t_cold": t_cold}
    roles = assign_roles({"kk": "1", "u_1": "V", "t_cold": "degC"}, columns=columns)
    assert roles.of["kk"] == "other"
    assert "kk is left out" in roles.doubts[0]
