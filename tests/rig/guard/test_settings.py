"""What the guard allows, from a file: the template is the defaults, a mistake is one line, a limit trips."""

from __future__ import annotations

import tomllib
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest

from tests.rig.makers import Constant
from thermogrip.datasets.errors import UserError
from thermogrip.rig.guard.guard import LIMIT_MARGIN, Guard
from thermogrip.rig.guard.settings import GUARD_TEMPLATE, GuardSettings, read_guard
from thermogrip.rig.session.session import run_session
from thermogrip.rig.simulation.twin import Twin
from thermogrip.sysid.plant.plant import Plant


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "guard.toml"
    path.write_text(text)
    return path


def test_the_template_is_the_defaults_with_every_key(tmp_path: Path) -> None:
    assert GuardSettings.from_dict(tomllib.loads(GUARD_TEMPLATE)) == GuardSettings()
    assert GuardSettings.from_dict({}) == GuardSettings()
    assert read_guard(written(tmp_path, "")).file == str(tmp_path / "guard.toml")
    content = tomllib.loads(GUARD_TEMPLATE)
    every = GuardSettings().model_dump(exclude={"limits", "room_sensors"})
    assert {key: set(value) if isinstance(value, dict) else () for key, value in every.items()} == {
        key: set(value) if isinstance(value, dict) else () for key, value in content.items()
    }


def test_every_line_of_the_template_may_be_changed() -> None:
    for table, keys in {"": tomllib.loads(GUARD_TEMPLATE), **tomllib.loads(GUARD_TEMPLATE)}.items():
        for key, value in keys.items() if isinstance(keys, dict) else ():
            if isinstance(value, dict) or key in ("windows_s", "floors_K", "expiry_s"):
                continue
            other: Any = [one * 0.9 for one in value] if isinstance(value, list) else value * 0.9
            other = {"bad_in_a_row": 2, "believable_degC": [-6, 76]}.get(key, other)
            content = {key: other} if not table else {table: {key: other}}
            assert GuardSettings.from_dict(content) != GuardSettings(), key


REFUSED: dict[str, tuple[str, tuple[str, ...]]] = {
    "not TOML": ("stale_s =", ("is not TOML",)),
    "a key of version 0.2.0": ("[no_model]\nleave_K = 5", ("no_model.leave_K", "`thermogrip init guard`")),
    "pairs of version 0.2.0": ('[[pairs]]\nsensors = ["a", "b"]', ("pairs: no such key", "init guard")),
    "an unknown key": ("happiness = 3", ("happiness", "no such key", "init guard")),
    "another unit of time": ("stale_ms = 500", ("stale_ms", "did you mean 'stale_s'")),
    "a unit left out": ("[sensors]\nnoise = 5", ("sensors.noise", "did you mean 'sensors.noise_K'")),
    "a key above its table": ("share = 0.3", ("share", "write it below [model]")),
    "a limit in fahrenheit": ("[limits]\nt_tank = [36, 149]", ("limits.t_tank", "plausible")),
    "a number with its unit": ('stale_s = "2 s"', ("stale_s", "valid number")),
    "yes": ("stale_s = true", ("stale_s", "valid number")),
    "not a number": ("stale_s = nan", ("stale_s", "not a finite number")),
    "longer than the device lives": ("expiry_s = 10", ("expiry_s", "less than or equal to 2")),
    "a check switched off": ("[model]\ndrive_limit = 1.0", ("model.drive_limit", "or equal to 0.45")),
    "one limit": ("skin_degC = 55", ("skin_degC", "valid tuple")),
    "limits the wrong way round": ("[limits]\nt_tank = [65, 2]", ("limits.t_tank", "is empty")),
    "a limit that is never reached": ("others_degC = [-1, 90]", ("others_degC", "sensors.believable_degC")),
    "half a reading": ("[sensors]\nbad_in_a_row = 2.5", ("sensors.bad_in_a_row", "valid integer")),
    "a floor too few": ("[model]\nwindows_s = [10, 30]", ("2 windows_s and 3 floors_K",)),
    "windows that fall": ("[model]\nwindows_s = [30, 10, 90]", ("windows_s", "shortest first")),
    "a window twice": ("[model]\nwindows_s = [10, 10, 90]", ("windows_s", "shortest first")),
    "smoother than a window": ("[model]\nsmooth_s = 10", ("smooth_s", "shorten")),
    "no window": ("[model]\nwindows_s = []", ("model.windows_s", "at least 1")),
    "a number in place of a table": ("sensors = 3", ("sensors", "valid dictionary")),
    "a room that is a number": ('room_sensors = ["t_lab", 3]', ("room_sensors", "valid string")),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_a_mistake_is_one_line_with_file_key_and_hint(what: str, tmp_path: Path) -> None:
    text, names = REFUSED[what]
    with pytest.raises(UserError) as refused:
        read_guard(written(tmp_path, text))
    line = str(refused.value)
    assert "guard.toml" in line
    assert "\n" not in line
    assert refused.value.hint
    for name in names:
        assert name in line


RANGES = """stale_s .5 60; expiry_s .5 2; clock_slack_s .1 60; drive_slack .005 .5; forget_s 0 3600;
sensors.rate_K_per_s .05 100; sensors.slack_K 0 10; sensors.bad_in_a_row 1 20; sensors.noise_K .001 5;
sensors.alpha 1e-15 1e-3; sensors.pair_limit_K .1 50; sensors.pair_s 0 3600; model.share 0 2;
model.switching_K 0 20; model.jump_k 3 100; model.jump_floor_K .1 50; model.bias_limit_K .1 20;
model.drive_limit .01 .45; model.warm_up_s 0 3600; model.state_K_per_sqrt_s 1e-4 1;
model.drive_per_sqrt_s 1e-5 .1; model.output_K_per_sqrt_s 1e-5 1; model.reading_K .001 5;
no_model.full_drive_s 1 3600; no_model.least_K .05 50; no_model.far_K .5 100"""


@pytest.mark.parametrize("row", [row.strip() for row in RANGES.split(";")])
def test_each_number_has_a_range_in_which_its_check_works(row: str) -> None:
    name, low, high = row.split()
    table, _, key = name.rpartition(".")
    step = 1 if key == "bad_in_a_row" else 1e-9
    convert = int if key == "bad_in_a_row" else float
    ends = convert(low), convert(high)
    for value in (*ends, ends[0] - step, ends[1] + step):
        with nullcontext() if value in ends else pytest.raises(UserError, match=f"{name}: .* than or equal"):
            GuardSettings.from_dict({table: {key: value}} if table else {key: value})


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"none\.toml"):
        read_guard(tmp_path / "none.toml")


@pytest.mark.parametrize(("drive", "pair"), [(1.0, (2.0, 40.0)), (-1.0, (15.0, 60.0))])
def test_a_limit_of_the_file_trips_at_its_second_reading(
    plant: Plant, tmp_path: Path, drive: float, pair: tuple[float, float]
) -> None:
    settings = read_guard(written(tmp_path, f"[limits]\nt_tank = [{pair[0]}, {pair[1]}]\n"))
    twin = Twin(plant, seed=1)
    session = run_session(twin, Constant(drive), 28.0, guard=Guard(settings=settings), settle_timeout=300.0)
    assert (session.trip.kind, session.trip.subject) == ("limit", "t_tank")
    assert session.trip.expected == f"{pair[0]:g} to {pair[1]:g} degC"
    beyond = max(twin.truth()["t_tank"] - pair[1], pair[0] - twin.truth()["t_tank"])
    assert 0.0 < beyond < LIMIT_MARGIN
    by_default = run_session(Twin(plant, seed=1), Constant(drive), 28.0, guard=Guard(), settle_timeout=60.0)
    assert by_default.trip is None


def test_other_numbers_of_the_file_count_too(plant: Plant, tmp_path: Path) -> None:
    """0.4 K/s at full drive: beyond 0.05 K/s and no slack this water is too fast to be plausible."""
    settings = read_guard(written(tmp_path, "[sensors]\nrate_K_per_s = 0.05\nslack_K = 0.2\n"))
    session = run_session(
        Twin(plant), Constant(1.0), 40.0, guard=Guard(settings=settings), settle_timeout=60.0
    )
    assert session.trip.kind == "jump"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[limits]\nt_tnk = [2, 40]", "no sensor 't_tnk' to guard; name one of t_tank, t_surface"),
        ("[limits]\nt_ambient = [10, 30]", "no sensor 't_ambient' to guard"),
        ("[limits]\nt_surface = [10, 27]", "target 28 degC is unsafe; choose one from 10 to 27 degC"),
        ("skin_degC = [10, 27]", "target 28 degC is unsafe; choose one from 10 to 27 degC"),
    ],
)
def test_what_does_not_fit_the_rig_is_refused_before_anything_is_driven(
    plant: Plant, tmp_path: Path, text: str, said: str
) -> None:
    twin = Twin(plant)
    with pytest.raises(UserError) as refused:
        run_session(twin, Constant(1.0), 28.0, guard=Guard(settings=read_guard(written(tmp_path, text))))
    assert said in str(refused.value)
    assert "guard.toml" in str(refused.value)
    assert twin.time == 0.0


def test_both_sensors_of_a_skin_have_the_skins_limits() -> None:
    guard = Guard(settings=GuardSettings(limits={"t_surface_2": (5.0, 40.0)}))
    assert guard.limits_of("t_surface") == (3.0, 55.0)
    assert guard.limits_of("t_surface_2") == (5.0, 40.0)
    assert Guard().limits_of("t_surface_2") == (3.0, 55.0)
    assert Guard().limits_of("t_tank") == (-1.0, 70.0)
