"""A spec in the user's words: the template is the defaults, and every mistake names its key."""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace
from types import SimpleNamespace

import pytest

from tests.mpc.makers import crossed, heater, make_tank, network_plant
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.limits import LARGEST
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.design.spec import SPEC_TEMPLATE, Spec, _spec_drive_ranges, read_spec, spec_from_dict
from thermogrip.mpc.plant.prediction import drive_range


def test_the_template_says_the_defaults():
    assert Spec.model_validate(tomllib.loads(SPEC_TEMPLATE)) == Spec()


def test_every_line_of_the_template_that_is_commented_out_is_valid_too():
    lines = []
    for line in SPEC_TEMPLATE.splitlines():
        body = line.removeprefix("# ")
        lines.append(body if line.startswith("# ") and ("= " in body or body.startswith("[")) else line)
    text = "\n".join(lines)
    assert Spec.model_validate(tomllib.loads(text)).limits == {"t_tank": (4.0, 58.0)}


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("band_degC = -1", "band_degC"),
        ("band_degC = 'narrow'", "band_degC"),
        ("settle_within_s = inf", "settle_within_s"),
        ("steps = []", "steps"),
        ("steps = [[28, 38, 40]]", "steps"),
        ("steps = [[28, 28.1]]", "steps"),
        ("steps = [[28, 4e12]]", "steps"),
        ("setle_within_s = 3", "setle_within_s"),
        ("drive_limits = [1, -1]", "drive_limits"),
        ("evaluations = 0", "evaluations"),
        ("[limits]\nt_tank = [60, 20]", "limits"),
        ("steps = ", "TOML"),
        ("sensor_offset_degC = nan", "sensor_offset_degC"),
        ("sensor_offset_degC = inf", "sensor_offset_degC"),
        ("ambient_degC = nan", "finite"),
        ("output = []", "output: list should have at least 1"),
        ('output = ["t", "t"]', "output: names one twice"),
        ("slew_per_s = 0", "slew_per_s: input should be greater than 0"),
        ("slew_per_s = { drive = -1 }", "slew_per_s.drive: input should be greater than 0"),
        ("limits = { t_tank = { most = 60 } }", "limits.t_tank: write [low, high], { min = low } or { max"),
        ("limits = { t_tank = {} }", "limits.t_tank: write [low, high]"),
        ("limits = { t_tank = { max = 'hot' } }", "limits.t_tank.1"),
        ("weights = { t1 = 0 }", "weights.t1: input should be greater than 0"),
        ("limits = { t_tank = [-inf, 60] }", "limits.t_tank.0 is -inf, not a finite number"),
        ("steps = [[28, 28.25]]", "steps: 28 -> 28.25 stays inside the band"),
        ("steps = [[28, -1.1e12]]", "steps.0.1: input should be greater than or equal to -1000000000000"),
        ("steps = [[1.1e12, 28]]", "steps.0.0: input should be less than or equal to 1000000000000"),
        (f"steps = {[[28, 38]] * 21}", "steps: list should have at most 20"),
        ("hold_s = 9.9", "hold_s: input should be greater than or equal to 10"),
        ("hold_s = 36001", "hold_s: input should be less than or equal to 36000"),
        ("noise_degC = -0.1", "noise_degC: input should be greater than or equal to 0"),
        ("noise_degC = 51", "noise_degC: input should be less than or equal to 50"),
        ("sensor_offset_degC = -51", "sensor_offset_degC: input should be greater than or equal to -50"),
        ("energy_weight = -0.1", "energy_weight: input should be greater than or equal to 0"),
        ("moves_weight = -0.1", "moves_weight: input should be greater than or equal to 0"),
        ("extra_lag = 11", "extra_lag: input should be less than or equal to 10"),
        ("lost_gain = 1", "lost_gain: input should be less than 1"),
        ("patience_s = -1", "patience_s: input should be greater than or equal to 0"),
        ("search_draws = 51", "search_draws: input should be less than or equal to 50"),
        ("check_draws = 201", "check_draws: input should be less than or equal to 200"),
        ("evaluations = 10001", "evaluations: input should be less than or equal to 10000"),
        ("drive_limits = { q = [5, 5] }", "drive_limits.q: 5 to 5 is empty"),
        ("drive_limits = [-2e12, 1]", "greater than or equal to -1000000000000"),
        ("settle_within_s = 900\nhold_s = 600", "settle_within_s: 900 s is longer than each step is"),
    ],
)
def test_a_mistake_in_the_spec_is_one_line_that_names_file_and_key(tmp_path, text, key):
    path = tmp_path / "spec.toml"
    path.write_text(text)
    with pytest.raises(UserError) as caught:
        read_spec(path)
    assert "spec.toml" in str(caught.value)
    assert key in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_is_just_allowed_is_taken_and_a_spec_stays_as_it_is():
    ends = {"steps": [(28.0, 28.26)] * 19 + [(-20.0, 1500.0)], "hold_s": 36000, "settle_within_s": 36000}
    ends |= {"noise_degC": 50, "sensor_offset_degC": -50, "search_draws": 50, "check_draws": 200}
    ends |= {"evaluations": 10000, "energy_weight": 0, "patience_s": 0, "output": ["a", "b"]}
    assert spec_from_dict(ends).model_dump(exclude_unset=True) == ends
    low = {"hold_s": 10, "search_draws": 1, "check_draws": 1, "evaluations": 1, "noise_degC": 0}
    assert spec_from_dict(low).hold_s == 10.0  # shorter than settling is allowed by default
    with pytest.raises(ValueError, match="frozen"):
        Spec().band_degC = 1.0


def drives(least: float, most: float) -> SimpleNamespace:
    return SimpleNamespace(drive_range={"p": (-1.0, 2.0), "q": (least, most)})


@pytest.mark.parametrize(
    ("own", "limits", "problem"),
    [
        ((-1.0, 1.0), (-0.5, 0.0), ""),
        ((-1.0, 1.0), (0.0, 0.5), ""),
        ((-1.0, 1.0), (0.1, 0.5), "0.1 to 0.5 of q leaves out 0, where a failing loop goes"),
        ((-1.0, 1.0), (-0.5, -0.1), "-0.5 to -0.1 of q leaves out 0"),
        ((0.0, 1.0), (0.1, 0.5), "leaves out 0"),
        ((-1.0, 0.0), (-0.5, -0.1), "leaves out 0"),
        ((0.1, 1.0), (0.2, 0.5), ""),  # no drive of this range is 0
        ((-1.0, -0.1), (-0.5, -0.2), ""),
        ((-1.0, 1.0), (-1.0 - 9e-10, 1.0 + 9e-10), ""),
        ((-1.0, 1.0), (-1.1, 0.5), "-1.1 to 0.5 of q leaves its range; stay in -1 to 1"),
        ((-1.0, 1.0), (-0.5, 1.1), "leaves its range"),
    ],
)
def test_limits_of_a_drive_are_inside_its_range_about_0(own, limits, problem):
    spec = Spec(drive_limits={"q": limits})
    if problem:
        with pytest.raises(UserError, match=problem):
            _spec_drive_ranges(spec, drives(*own))
    else:
        assert _spec_drive_ranges(spec, drives(*own)) == {"p": (-1.0, 2.0), "q": limits}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"output": "t_nose"}, "t_nose"),
        ({"limits": {"t_nose": (10, 20)}}, "limits"),
        ({"drive_limits": {"fan": (0, 1)}}, "fan"),
        ({"weights": {"t_tank": 2.0}}, "weights: t_tank is not regulated"),
        ({"drive_limits": (-3, 3)}, "drive_limits"),
        ({"slew_per_s": {"fan": 1}}, "fan"),
        ({"sample_time_s": 0.1}, "sample_time_s: 0.1 s is no multiple of the plant's step of 1 s; write 1"),
        ({"sample_time_s": 2.5}, "sample_time_s"),
        ({"sample_time_s": 2.00001}, "no multiple of the plant's step of 1 s; write 2,"),
        ({"sample_time_s": 200}, "less than 5 samples"),
        ({"limits": {"t_surface": (38.5, 50)}}, "and a step goes to 38"),
        ({"hold_s": 10, "sample_time_s": 4}, "hold_s: 10 s are less than 5 samples"),
        ({"drive_limits": (0.2, 1)}, "leaves out 0"),
        ({"limits": {"t_surface": (20, 30)}}, "limits: t_surface is to stay in 20 to 30 degC, and a step"),
    ],
)
def test_a_spec_that_does_not_fit_the_plant_is_refused(tank, change, says):
    with pytest.raises(UserError, match=says):
        spec_from_dict(change).design(tank)


def test_the_spec_says_how_long_the_model_stands_in(tank):
    assert Spec(patience_s=45).design(tank).patience_s == 45
    assert Spec().design(tank).patience_s == max(10.0, 5 * Spec().design(tank).dt)


def test_the_spec_reaches_the_design(tank):
    spec = Spec(
        drive_limits=(-0.5, 0.8), slew_per_s=0.1, sample_time_s=3.0, overshoot_degC=0.2, ambient_degC=20.0
    )
    design = spec.design(tank)
    assert design.drive_range == {"drive": (-0.5, 0.8)}
    assert design.slew_per_s == {"drive": 0.1}
    assert (design.dt, design.overshoot, design.ambient) == (3.0, 0.1, 20.0)
    assert Spec(overshoot_degC=2.0).design(tank).overshoot == default_design(tank).overshoot
    assert design.limits == {"t_tank": (4.0, 58.0)}
    assert Spec(output="t_tank").design(tank).limits == {}  # what is regulated has its targets
    ends = {"t_surface": (18.0, 43.0), "t_tank": (30.0, 31.0)}  # targets 18 to 43; of the tank there is none
    assert Spec(limits=ends).design(tank, track=3.0).limits == ends
    one = Spec(limits={"t_tank": {"max": 60.0}, "t_surface": {"min": 5.0}}).design(tank).limits
    assert one == {"t_tank": (-LARGEST, 60.0), "t_surface": (5.0, LARGEST)}
    assert Spec(weights={"t_surface": 4.0}).design(tank).weights == {"t_surface": 4.0}
    assert Spec(limits=ends).design(tank, track=3.0).track == 3.0
    assert Spec(limits={}, output=["t_tank", "t_surface"]).design(tank).controlled == ("t_tank", "t_surface")
    assert Spec(hold_s=20, sample_time_s=4).design(tank).dt == 4.0  # five samples are enough
    assert Spec(sample_time_s=4.000003).design(tank).dt == 4.0


def test_a_sample_time_is_held_against_the_step_of_its_plant():
    plant = replace(heater().plant, valid={"q": (0.0, 1.0)})  # of 5 s
    assert Spec(sample_time_s=15).design(plant).dt == 15.0
    with pytest.raises(UserError, match="18 s is no multiple of the plant's step of 5 s; write 20, or"):
        Spec(sample_time_s=18).design(plant)


def test_a_drive_whose_range_only_its_logs_showed_is_as_wide_as_the_spec_has_it(tank):
    volts = replace(tank, units=tank.units | {"drive": "V"}, valid=tank.valid | {"drive": (2.0, 4.0)})
    spec = Spec(drive_limits={"drive": (0.0, 3.0)})
    wide = spec.widened(volts)
    assert drive_range(wide, "drive") == (0.0, 4.0)
    assert spec.design(wide).drive_range == {"drive": (0.0, 3.0)}
    with pytest.raises(UserError, match="drive_limits: 0 to 3 of drive leaves its range"):
        spec.design(volts)
    with pytest.raises(UserError, match="leaves its range"):  # of a drive whose unit has a range
        (beyond := Spec(drive_limits=(-2.0, 2.0))).design(beyond.widened(tank))


def test_a_plant_without_a_skin_gets_steps_inside_its_logs():
    board = network_plant("tclab", t1=(20.0, 60.0), t2=(30.0, 70.0))
    spec = Spec.of(board)
    assert spec.steps == [(39.0, 51.0), (51.0, 39.0)]  # 0.3 and 0.7 of what both covered, 30 to 60
    assert (spec.band_degC, spec.overshoot_degC, spec.bias_degC, spec.output) == (0.3, 0.6, 0.12, None)
    spec.design(board)  # fits
    assert spec_from_dict(tomllib.loads(spec.in_toml())) == spec


def test_what_a_file_does_not_say_is_taken_for_the_plant():
    board = network_plant("tclab", t1=(20.0, 60.0), t2=(30.0, 70.0))
    usual = Spec.of(board)
    assert Spec().completed(board) == usual
    slow = spec_from_dict({"settle_within_s": 7200, "relays": {"q1": {"on_s": 300.0, "off_s": 300.0}}})
    completed = slow.completed(board)
    assert (completed.steps, completed.band_degC) == (usual.steps, usual.band_degC)
    assert (completed.settle_within_s, completed.hold_s) == (7200.0, 9600.0)
    assert completed.design(board).relays["q1"].on_s == 300.0
    assert spec_from_dict({"hold_s": 100.0}).completed(board).settle_within_s == 75.0
    with pytest.raises(UserError, match="q1 goes on and off in 600 s, longer than settle_within_s"):
        spec_from_dict({"relays": slow.relays}).completed(board).design(board)


def test_a_spec_of_a_plant_asks_for_three_times_what_its_slowest_output_takes_by_itself():
    seen = {"a": (20.0, 60.0), "b": (20.0, 60.0), "room": (16.0, 19.0)}
    spec = Spec.of(replace(crossed(), valid={**crossed().valid, **seen}))
    assert spec.settle_within_s == pytest.approx(3 * 2 / -math.log(0.9), rel=0.12)  # the pole of 0.9, 2 s
    assert (spec.hold_s > spec.settle_within_s, spec.ambient_degC) == (True, 17.5)


def test_outputs_that_share_no_range_are_not_both_regulated():
    apart = replace(crossed(), valid={**crossed().valid, "a": (20.0, 60.0), "b": (70.0, 90.0)})
    assert Spec.of(apart).output == ["b"]  # which the first drive moves
    assert Spec.of(replace(apart, valid={**apart.valid, "b": (70.0, 70.5)})) == Spec()


def test_a_skin_gets_the_defaults():
    assert Spec.of(make_tank()) == Spec()
