"""A spec in the user's words: the template is the defaults, and every mistake names its key."""

from __future__ import annotations

import tomllib

import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.mpc.design.spec import SPEC_TEMPLATE, Spec, read_spec, spec_from_dict


def test_the_template_says_the_defaults():
    assert Spec.model_validate(tomllib.loads(SPEC_TEMPLATE)) == Spec()


def test_every_line_of_the_template_that_is_commented_out_is_valid_too():
    lines = []
    for line in SPEC_TEMPLATE.splitlines():
        body = line.removeprefix("# ")
        lines.append(body if line.startswith("# ") and ("= " in body or body.startswith("[")) else line)
    text = "\n".join(lines)
    assert Spec.model_validate(tomllib.loads(text)).limits == {"t_tank": (2.0, 65.0)}


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("band_degC = -1", "band_degC"),
        ("band_degC = 'narrow'", "band_degC"),
        ("settle_within_s = inf", "settle_within_s"),
        ("steps = []", "steps"),
        ("steps = [[28, 38, 40]]", "steps"),
        ("steps = [[28, 28.1]]", "steps"),
        ("steps = [[28, 4000]]", "steps"),
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
        ("limits = { t_tank = [-inf, 60] }", "limits.t_tank.0 is -inf, not a finite number"),
        ("settle_within_s = 900", "settle_within_s: 900 s is longer than each step is simulated"),
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


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"output": "t_nose"}, "t_nose"),
        ({"limits": {"t_nose": (10, 20)}}, "limits"),
        ({"drive_limits": {"fan": (0, 1)}}, "fan"),
        ({"drive_limits": (-3, 3)}, "drive_limits"),
        ({"slew_per_s": {"fan": 1}}, "fan"),
        ({"sample_time_s": 0.1}, "sample_time_s: 0.1 s is no multiple of the plant's step of 1 s; write 1"),
        ({"sample_time_s": 2.5}, "sample_time_s"),
        ({"sample_time_s": 200}, "less than 5 samples"),
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
    assert design.limits == {"t_tank": (2.0, 65.0)}
