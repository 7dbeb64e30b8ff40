"""The two records and their rules."""

from __future__ import annotations

import re

import numpy as np
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import (
    check_grasps,
    check_log,
    column,
    columns,
    make_grasps,
    make_log,
    names,
)

GOOD = ([20.0, 21.0], "degC", "output")


@pytest.mark.parametrize(
    ("time", "variables", "words"),
    [
        ([0.0], {"t": ([20.0], "degC", "output")}, "1 row"),
        ([0.0, 0.0], {"t": GOOD}, "does not increase after 0 s"),
        ([0.0, np.nan], {"t": GOOD}, "not finite"),
        ([0.0, 1.0], {"t": ([np.nan, np.nan], "degC", "output")}, "column t: has no finite value"),
        ([0.0, 1.0, 2.0], {"u": ([np.nan, 1.0, 1.0], "1", "input")}, "column u: input is unknown in 1 row"),
        ([0.0, 1.0], {"d": ([np.inf, 1.0], "degC", "disturbance")}, "disturbance is unknown"),
        ([0.0, 1.0], {"t": ([1.0, 2.0], "degC", "thing")}, "role 'thing'"),
    ],
)
def test_a_log_that_breaks_a_rule_is_refused(time, variables, words):
    with pytest.raises(UserError) as fault:
        make_log(time, variables, name="mine")
    assert words in str(fault.value)
    assert "mine" in str(fault.value)


def test_an_output_may_have_lost_samples():
    log = make_log([0.0, 1.0], {"t": ([np.nan, 1.0], "degC", "output")})
    assert np.isnan(column(log, "t")[0])


def test_a_record_without_time_or_unit_is_refused(small_log):
    with pytest.raises(UserError, match="no time axis"):
        check_log(small_log.drop_vars("time"))
    del small_log["drive"].attrs["units"]
    with pytest.raises(UserError, match="column drive: no unit"):
        check_log(small_log)


def test_columns_come_in_the_order_asked_for(small_log):
    two = columns(small_log, ["t_tank", "drive"])
    np.testing.assert_array_equal(two[:, 1], column(small_log, "drive"))
    assert columns(small_log, []).shape == (40, 0)
    assert names(small_log, "input") == ("drive", "pump")
    with pytest.raises(UserError, match=r"column tank: no such column; it has drive"):
        column(small_log, "tank")


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"grasp_id": ["a", "a"]}, "'a' occurs twice"),
        ({"time": [0.0, 0.0, 1.0]}, "time does not increase"),
        ({"t_surface": np.full((2, 3), np.nan)}, "grasp 'a' has no temperature"),
        ({"weight": [1, 2]}, "has no 'weight'"),
    ],
)
def test_grasps_that_break_a_rule_are_refused(kwargs, words):
    good = {"time": [-0.1, 0.0, 0.1], "t_surface": np.full((2, 3), 20.0), "grasp_id": ["a", "b"]}
    with pytest.raises(UserError, match=words):
        make_grasps(**(good | kwargs))


def test_two_of_three_grasps_with_one_id_are_refused():
    with pytest.raises(UserError, match="'b' occurs twice"):
        make_grasps([-0.1, 0.0, 0.1], np.full((3, 3), 20.0), ["b", "a", "b"])


def test_no_grasp_at_all_is_refused(small_grasps):
    with pytest.raises(UserError, match="holds no grasp"):
        check_grasps(small_grasps.isel(grasp=slice(0, 0)))
    with pytest.raises(UserError, match="no t_surface"):
        check_grasps(small_grasps.drop_vars("t_surface"))
    with pytest.raises(UserError, match="no grasp axis"):
        check_grasps(small_grasps.drop_vars("grasp"))


def test_an_error_names_file_row_column_problem_and_hint_in_one_line():
    fault = UserError("is\nbad", file="a.csv", row=3, column="x", hint="correct\nit")
    assert str(fault) == "a.csv, row 3, column x: is bad; correct it"
    assert str(UserError("bad")) == "bad"


def test_grasps_in_milliseconds_are_refused() -> None:
    with pytest.raises(UserError, match="samples are 100 s apart; give times in seconds since the closed"):
        make_grasps(100.0 * np.arange(-20, 101), np.full((1, 121), 23.0), ["g0"])


@pytest.mark.parametrize(
    ("about", "words"),
    [
        ({"rest": [np.nan, -5.0, 60.0]}, "grasp 'b' has a rest of -5 s"),
        ({"touch": [1, 2, 1]}, "touch 1 of touch_group 'one' occurs twice; number its touches 1, 2, ...,"),
        ({"touch": [1, 2, np.nan]}, "grasp 'c' of touch_group 'one' has no touch, others of it have; number"),
    ],
)
def test_touches_without_an_order_or_before_each_other_are_refused(about, words) -> None:
    skins = [[23.0, 23.0, 25.0]] * 3
    with pytest.raises(UserError, match=re.escape(words)):
        make_grasps([-1.0, 0.0, 1.0], skins, ["a", "b", "c"], touch_group=["one"] * 3, **about)


def test_touches_may_be_numbered_by_their_rows() -> None:
    skins = [[23.0, 23.0, 25.0]] * 3
    about = {"touch_group": ["one", "one", ""], "rest": [np.nan, 0.0, np.nan]}
    for touch in ([np.nan] * 3, [3, 1, 1]):
        assert make_grasps([-1.0, 0.0, 1.0], skins, ["a", "b", "c"], touch=touch, **about).sizes["grasp"] == 3


@pytest.mark.parametrize("t_object", [-196.0, 200.0])
def test_liquid_nitrogen_and_a_block_of_200_degrees_are_temperatures(t_object: float) -> None:
    grasps = make_grasps([-1.0, 0.0, 1.0], [[23.0, 23.0, 25.0]], ["a"], t_object=[t_object])
    assert grasps["t_object"].values.tolist() == [t_object]


@pytest.mark.parametrize("name", ["t_object", "t_gripper", "t_ambient", "t_surface", "t_surface_2"])
@pytest.mark.parametrize("value", [293.15, 200.1, -200.1])
def test_what_only_kelvin_or_a_broken_sensor_shows_is_no_temperature_in_degC(name: str, value: float) -> None:
    skin = np.full((2, 3), 23.0)
    about = {"t_surface": skin, "t_surface_2": skin.copy(), "t_object": [43.0, 43.0]}
    about |= (
        {name: np.where([[False], [True]], value, 23.0) * np.ones((2, 3))}
        if "surface" in name
        else {name: [23.0, value]}
    )
    with pytest.raises(UserError, match=re.escape(f"grasp 'b' has a {name} of {value:g} degC; give degrees")):
        make_grasps([-1.0, 0.0, 1.0], grasp_id=["a", "b"], **about)


@pytest.mark.parametrize("label", ["Train", "test ", "TRAIN"])
def test_a_misspelt_split_is_refused(label: str) -> None:
    with pytest.raises(UserError, match="is neither train nor test; write 't"):
        make_grasps([-1.0, 0.0, 1.0], [[23.0] * 3] * 2, ["a", "b"], split=["train", label])
