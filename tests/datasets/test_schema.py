"""The two records and their rules."""

from __future__ import annotations

import hashlib
import re
import struct

import numpy as np
import pytest
import xarray as xr

from thermogrip.classify.estimators.base import record_list, unit_names
from thermogrip.datasets import schema
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import (
    check_grasps,
    check_log,
    column,
    columns,
    has_touch_groups,
    hash_columns,
    label_values,
    log_name,
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
        ([0.0, 1.0, 1.0, 0.5], {"t": ([1.0] * 4, "degC", "output")}, "does not increase after 1 s; sort"),
        ([0.0, 2.0, 1.0], {"t": ([1.0] * 3, "degC", "output")}, "does not increase after 2 s"),
        ([0.0, np.nan], {"t": GOOD}, "not finite"),
        ([0.0, 1.0], {"t": ([np.nan, np.nan], "degC", "output")}, "column t: has no finite value"),
        ([0.0, 1.0, 2.0], {"u": ([np.nan, 1.0, 1.0], "1", "input")}, "column u: input is unknown in 1 row"),
        ([0.0, 1.0, 2.0], {"d": ([1.0, np.nan, np.nan], "1", "disturbance")}, "unknown in 2 row(s); fill"),
        ([0.0, 1.0], {"d": ([np.inf, 1.0], "degC", "disturbance")}, "disturbance is unknown"),
        ([0.0, 1.0], {"t": ([1.0, 2.0], "degC", "thing")}, "role 'thing'"),
    ],
)
def test_a_log_that_breaks_a_rule_is_refused(time, variables, words):
    with pytest.raises(UserError) as fault:
        make_log(time, variables, name="mine")
    assert words in str(fault.value)
    assert "mine" in str(fault.value)


def test_the_types_of_records_are_loaded_when_they_are_asked_for():
    assert schema.Log is xr.Dataset
    assert issubclass(schema.Grasps, xr.Dataset)
    with pytest.raises(AttributeError, match=r"'thermogrip.datasets.schema' has no attribute 'Logs'"):
        _ = schema.Logs


def test_a_plain_dataset_becomes_a_record_that_counts_grasps():
    made = make_grasps([0.0, 1.0], [[1.0, 2.0], [3.0, 4.0]], ["a", "b"], material=["tin", "zinc"])
    plain = xr.Dataset(made.data_vars, coords=made.coords, attrs=made.attrs)
    [again] = record_list(plain)
    assert len(again.isel(time=[0])) == len(again.drop_vars("material")) == len(again.copy(deep=True)) == 2
    xr.testing.assert_identical(again, made)
    assert record_list(made)[0] is made
    assert list(again) == ["t_surface", "material"]


def test_a_record_has_its_marks_and_a_variable_only_its_time():
    log = make_log([0.0, 1.0], {"t": GOOD}, repairs=["one", "two"])
    assert log.attrs == {"schema": "thermogrip.log", "version": 1, "name": "log", "repairs": "one\ntwo"}
    assert (log["time"].attrs, log["t"].attrs) == ({"units": "s"}, {"units": "degC", "role": "output"})
    made = make_grasps([0.0, 1.0], [[1.0, 2.0]], [7], t_surface_2=[[3.0, 4.0]], rest=[5.0], material=["tin"])
    assert made.attrs == {"schema": "thermogrip.grasps", "version": 1, "name": "grasps"}
    assert [made[n].attrs.get("units") for n in made] == ["degC", "degC", "s", None]
    assert (made["grasp"].values.tolist(), made["t_surface_2"].values.tolist()) == (["7"], [[3.0, 4.0]])
    log["wide"] = (("time", "x"), np.zeros((2, 3)), {"units": "1", "role": "other"})
    with pytest.raises(UserError, match=r"log, column wide: dims are \('time', 'x'\), not \('time',\)"):
        check_log(log)


def test_the_hash_of_a_log_is_that_of_its_numbers():
    u, v = np.array([0.0, 1.0, 2.5]), np.array([-1.0, 3.0, 0.5])
    found = hash_columns({"a": u, "b": v})
    each = sorted(hashlib.sha256(struct.pack("<3d", *x)).digest() for x in (u, v))
    assert found == hashlib.sha256(b"".join(each)).hexdigest()
    assert found == hash_columns({"x": v, "y": u * [-1, 1, 1]})  # -0 is 0
    assert found != hash_columns({"a": u, "b": v + 1e-15})


def test_labels_that_are_absent_are_empty_and_a_touch_group_is_one_unit(small_grasps):
    assert label_values(small_grasps.drop_vars("split"), "split").tolist() == [""] * 6
    assert label_values(small_grasps, "split")[:2].tolist() == ["train", "test"]
    assert unit_names(small_grasps).tolist() == ["g0", "g1", "g2", "g3", "p1", "p1"]
    found = [has_touch_groups(g) for g in (small_grasps, small_grasps[{"grasp": slice(4)}])]
    assert found == [True, False]
    assert log_name(small_grasps.drop_attrs()) == "log"


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
        ({"grasp_id": ["b", "a", "b"], "t_surface": np.full((3, 3), 20.0)}, "'b' occurs twice"),
        ({"time": [0.0, 0.0, 1.0]}, "time does not increase"),
        ({"time": [0.0, 1.0, 0.5]}, "time does not increase"),
        ({"time": [0.0, 1.0, np.inf]}, "time does not increase"),
        ({"time": [0.0], "t_surface": [[20.0], [20.0]]}, "time does not increase"),
        ({"time": [0.0, 1.0, 10.5]}, "samples are 5.25 s apart; give times in seconds since the closed"),
        ({"t_surface": [[20.0, 20.0, 20.0], [np.nan] * 3]}, "grasp 'b' has no temperature"),
        ({"t_surface": np.full((2, 3), np.nan)}, "grasp 'a' has no temperature"),
        ({"weight": [1, 2]}, "has no 'weight'"),
    ],
)
def test_grasps_that_break_a_rule_are_refused(kwargs, words):
    good = {"time": [-0.1, 0.0, 0.1], "t_surface": np.full((2, 3), 20.0), "grasp_id": ["a", "b"]}
    with pytest.raises(UserError, match=words):
        make_grasps(**(good | kwargs))


def test_samples_may_be_5_s_apart():
    assert make_grasps([0.0, 1.0, 10.0], [[20.0, np.nan, 20.0]], ["a"]).sizes["time"] == 3


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


@pytest.mark.parametrize(
    ("about", "words"),
    [
        ({"rest": [np.nan, -5.0, 60.0]}, "grasp 'b' has a rest of -5 s"),
        ({"touch": [1, 2, 1]}, "touch 1 of touch_group 'one' occurs twice; number its touches 1, 2, ...,"),
        ({"touch": [1, 2, 2], "rest": [0.0, np.nan, 0.0]}, "touch 2 of touch_group 'one' occurs twice"),
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
