"""Any number in a file of a model is used, or refused in one line; no run is without an end."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from tests.end_to_end.conftest import HEADER, Bench, small_log_rows, small_plant
from thermogrip.classify.decisions.stopping_rule import StopRule
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import example_path
from thermogrip.datasets.grasp_files import read_grasps
from thermogrip.datasets.log_files import read_log
from thermogrip.datasets.schema import Grasps
from thermogrip.mpc import Controller
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.design.spec import Spec, read_spec
from thermogrip.rig.guard.settings import GUARD_TEMPLATE, read_guard
from thermogrip.sysid.effusivity.gripper_model import GripperModel, another_gripper, load_default_gripper
from thermogrip.sysid.effusivity.multi_touch import Coupling
from thermogrip.sysid.effusivity.posterior import effusivity_posterior
from thermogrip.sysid.models.network_spec import network_from_dict
from thermogrip.sysid.plant.plant import Plant

STEPS = (1e-9, 1e-6, -1.0, 0.0, 1e12, 1e308)
HOSTILE = (-1, 0, 1e-9, 1e12, 1e99, -1e99)


def places(content: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield where numbers stand; of a list the first two."""
    inner = content.items() if isinstance(content, dict) else ()
    inner = enumerate(content[:2]) if isinstance(content, list) else inner
    if isinstance(content, int | float) and not isinstance(content, bool):
        yield at
    for key, value in inner:
        yield from places(value, (*at, key))


def changed(content: dict[str, Any], at: tuple[Any, ...], value: Any) -> dict[str, Any]:
    copy = json.loads(json.dumps(content))
    inner = copy
    for key in at[:-1]:
        inner = inner[key]
    inner[at[-1]] = value
    return copy


def refusal(work: Callable[[], object]) -> str:
    """Return the line with which the work is refused, nothing where it is done."""
    try:
        work()
    except UserError as error:
        return str(error)
    return ""


def test_any_number_of_a_plant_is_used_or_refused(bench: Bench) -> None:
    log = read_log(bench.write("a.csv", "\n".join([HEADER, *small_log_rows(40)]) + "\n"))
    content = small_plant().to_dict()
    refused = 0
    for at in places(content):
        for value in HOSTILE:
            spoilt = changed(content, at, value)
            line = refusal(lambda spoilt=spoilt: Plant.from_dict(spoilt).simulate(log))
            refused += bool(line)
            assert len(line) < 300, line
    assert refused > 50


NOT_NUMBERS = (float("nan"), float("inf"), 10**400, "abc", [[1.0]])


def toml(value: Any) -> str:
    """Return a value as TOML has it, a table inline."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {toml(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    return repr(value) if isinstance(value, float) else json.dumps(value)


def a_spec() -> dict[str, Any]:
    optional = {"sample_time_s": 2.0, "slew_per_s": {"drive": 0.25}, "drive_limits": [-1.0, 1.0]}
    found = Spec(**optional, patience_s=10.0, limits={"t_tank": (2, 65)}).model_dump(mode="json")
    del found["output"]
    return found


def a_guard() -> dict[str, Any]:
    return tomllib.loads(GUARD_TEMPLATE) | {"limits": {"t_tank": [2.0, 65.0]}}


def a_gripper() -> dict[str, Any]:
    return load_default_gripper().to_dict() | {"schema": "thermogrip.device", "version": 2}


def a_gripper_with_a_covariance() -> dict[str, Any]:
    return a_gripper() | another_gripper(load_default_gripper()).to_dict()


def a_coupling() -> dict[str, Any]:
    return Coupling(longest_rest=300.0).to_dict() | {"schema": "thermogrip.coupling", "version": 1}


def a_stop_rule() -> dict[str, Any]:
    return asdict(StopRule(sure=0.9)) | {"schema": "thermogrip.stop_rule", "version": 1}


@cache
def two_grasps(name: str, second: int) -> Grasps:
    """Return the first of the bundled grasps and another one, as touches of one block where they have one."""
    grasps = read_grasps(example_path(name)).isel(grasp=[0, second])
    return grasps.assign(touch_group=("grasp", ["one", "one"])) if "touch_group" in grasps else grasps


def use_gripper(path: Path) -> None:
    effusivity_posterior(GripperModel.load(path), two_grasps("exp2_dT20", 12))


def use_coupling(path: Path) -> None:
    grasps = two_grasps("exp5_two_touch_unknown_object", 1)
    effusivity_posterior(load_default_gripper(), grasps, coupling=Coupling.load(path))


@pytest.mark.parametrize(
    ("make", "use"),
    [
        pytest.param(a_spec, lambda path: read_spec(path).design(small_plant()), id="spec"),
        pytest.param(a_guard, read_guard, id="guard"),
        pytest.param(a_stop_rule, StopRule.load, id="stop rule"),
        pytest.param(a_coupling, use_coupling, id="coupling"),
        pytest.param(a_gripper, use_gripper, id="gripper", marks=pytest.mark.slow),
        pytest.param(a_gripper_with_a_covariance, GripperModel.load, id="gripper with a covariance"),
    ],
)
def test_any_number_of_a_settings_file_is_used_or_refused(
    make: Callable[[], dict[str, Any]], use: Callable[[Path], object], tmp_path: Path
) -> None:
    content = make()
    path = tmp_path / "file"
    for at in places(content):
        if at[0] in ("schema", "version") or at[:2] in (("blocks", "copper"), ("blocks", "iron")):
            continue
        for value in (0, -1, 1e-9, 1e308, -1e308, *NOT_NUMBERS):
            spoilt = changed(content, at, value)
            is_json = "schema" in content
            path.write_text(
                json.dumps(spoilt) if is_json else "\n".join(f"{k} = {toml(v)}" for k, v in spoilt.items())
            )
            line = refusal(lambda: use(path))
            assert len(line) < 400, line
            assert line or not (value in NOT_NUMBERS or abs(value) > 1e300), (at, value)


@pytest.mark.parametrize(
    "where",
    [("design", "dt"), ("plant", "dt"), ("plant", "noise", "t_surface"), ("plant", "valid", "drive", 1),
     ("design", "noise", "state"), ("design", "track"), ("plant", "model", "C", 1, 1)],
)  # fmt: skip
@pytest.mark.parametrize("value", [0.0, -1e99, 1e12, 1e99])
def test_a_number_of_a_controller_is_used_or_refused(
    where: tuple[str, ...], value: float, tmp_path: Path
) -> None:
    plant = small_plant()
    path = Controller(plant, default_design(plant)).save(tmp_path / "c.json")
    content = json.loads(path.read_text())
    path.write_text(json.dumps(changed(content, where, value)))
    line = refusal(lambda: Controller.load(path))
    assert str(path) in line or abs(value) < 1e99


def chain(nodes: int, **top: Any) -> dict[str, Any]:
    """Return a network of nodes in a row."""
    links = {f"l{k}": {"between": [f"n{k}", f"n{k + 1}"], "conductance": "G"} for k in range(nodes - 1)}
    units = {"C": "J/K", "G": "W/K", "P": "W"}
    return {
        "schema": "thermogrip.network", "version": 1, "name": "chain", "dt": 1.0,
        "inputs": {"q": {"unit": "1", "range": [0, 1]}}, "outputs": {"t": {"node": "n0"}},
        "nodes": {f"n{k}": {"capacity": "C"} for k in range(nodes)}, "links": links,
        "heaters": {"h": {"node": "n0", "input": "q", "power": "P"}},
        "parameters": {name: {"unit": unit, "value": 1.0, "sd_log": 0.5} for name, unit in units.items()},
    } | top  # fmt: skip


def test_a_network_has_a_step_a_size_and_numbers_that_can_be() -> None:
    assert len(network_from_dict(chain(20)).nodes) == 20
    hostile = [chain(20_000), *(chain(3, dt=step) for step in (*STEPS, float("nan"), float("inf")))]
    for value in (1e308, -1e308, float("inf"), float("nan")):
        for key in ("value", "sd_log", "low", "high"):
            spoilt = chain(3)
            spoilt["parameters"]["G"][key] = value
            hostile.append(spoilt)
    for content in hostile:
        with pytest.raises(UserError) as caught:
            network_from_dict(content)
        assert len(str(caught.value)) < 300


def test_a_log_of_more_steps_than_there_is_room_for_is_refused(bench: Bench) -> None:
    rows = small_log_rows(40)
    rows[-1] = "1e12" + rows[-1][rows[-1].index(",") :]
    log = read_log(bench.write("a.csv", "\n".join([HEADER, *rows]) + "\n"))
    plant = small_plant()
    with pytest.raises(UserError, match=r"would be simulated in 2\d{12} steps of 0.5 s"):
        plant.simulate(log, gaps="hold")


def test_a_gap_of_a_day_is_carried_through(bench: Bench) -> None:
    rows = small_log_rows(80)
    cells = [row.split(",") for row in rows]
    late = [",".join([str(float(time) + 86_400), "0.9", *rest]) for time, _, *rest in cells]
    log = read_log(bench.write("a.csv", "\n".join([HEADER, *rows, *late]) + "\n"))
    assert "a gap of 86360.5 s" in str(small_plant().simulate(log).attrs["notes"])
