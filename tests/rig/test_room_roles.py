"""Which sensor is the room's is what the plant says; a name decides only where no plant knows the sensor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from math import isfinite, nan
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest

from tests.rig.makers import Constant
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import names
from thermogrip.rig.guard.guard import Findings, Guard
from thermogrip.rig.guard.sensor_checks import room_sensors
from thermogrip.rig.guard.settings import GuardSettings
from thermogrip.rig.interface import Reading
from thermogrip.rig.records.run_folder import RunFolder, read_run
from thermogrip.rig.session.session import run_session
from thermogrip.rig.simulation.twin import Twin
from thermogrip.sysid.contact.simulation import Grip
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

BLOCK, ROOM = "t_ambient_block", "t_room"
STEADY = {"t_surface": 25.0, BLOCK: 25.0, ROOM: 25.0}


def swapped(*disturbances: str, units: dict[str, str] | None = None) -> Plant:
    """An output that is called like a room, and a room that is not."""
    model = StateSpaceModel(
        ("drive",),
        disturbances,
        ("t_surface", BLOCK),
        A=0.95 * np.eye(2),
        B=[[1.0], [1.0]],
        C=np.eye(2),
        E=np.zeros((2, len(disturbances))),
        dt=1.0,
        y0=[25.0, 25.0],
    )
    degrees = dict.fromkeys(disturbances, "degC")
    return Plant(model, {}, dt=1.0, units={"drive": "1", **degrees, **(units or {})})


PLANT = swapped(ROOM)


def read_by(guard: Guard, *changes: dict[str, float]) -> list[Findings]:
    """Return what a guard says of readings at rest, a second apart, that differ so."""
    guard.start(Reading(0.0, STEADY, {"drive": 0.0}, 1), 0.0, {"drive": "1"})
    noise = np.random.default_rng(0).normal(0, 0.04, (len(changes), 2)).tolist()
    found = []
    for k, (change, (a, b)) in enumerate(zip(changes, noise), start=1):
        values = {"t_surface": 25.0 + a, BLOCK: 25.0 + b, ROOM: 25.0, **change}
        found.append(guard.check(Reading(float(k), values, {"drive": 0.0}, 1), float(k)))
    return found


@pytest.mark.parametrize(
    ("have", "plant", "rooms"),
    [(("t_surface", BLOCK, ROOM), PLANT, {ROOM}),
     (("t_surface", "t_hall", "t_ambient"), swapped("t_hall"), {"t_hall", "t_ambient"}),
     (("t_surface", "wind"), swapped("wind", units={"wind": "W"}), set()),
     (("t_tank", "t_surface", "t_ambient"), None, {"t_ambient"}),
     (("t_surface", "t_room", "t_amb", "t_lamb", "t_outside_2"), None, {"t_room", "t_amb", "t_outside_2"})],
)  # fmt: skip
def test_the_rooms_sensors_are_the_plants_measured_temperatures_else_those_called_so(
    have: tuple[str, ...], plant: Plant | None, rooms: set[str]
) -> None:
    assert room_sensors(have, plant) == rooms


def test_a_room_that_no_plant_knows_is_stated_or_guessed_and_the_guess_is_reported(plant: Plant) -> None:
    have = ("t_tank", "t_surface", "t_ambient")
    assert room_sensors(have, stated=("t_tank",)) == {"t_tank"}
    assert room_sensors(have, stated=()) == set()
    assert room_sensors(("t_surface", BLOCK, ROOM), PLANT, stated=(BLOCK,)) == {ROOM}

    def events(guard: Guard) -> list[str]:
        session = run_session(Twin(plant, ambient=25.0), Constant(), 25.0, guard=guard)
        return [event.text for event in session.events if event.kind == "room"]

    assert events(Guard(plant)) == []
    assert events(Guard(settings=GuardSettings.from_dict({"room_sensors": ["t_ambient"]}))) == []
    (guess,) = events(Guard())
    assert guess.startswith("t_ambient by name taken for the room's; state room_sensors")
    with pytest.raises(UserError, match="no sensor 't_tnk' that may read the room"):
        events(Guard(settings=GuardSettings(room_sensors=("t_tnk",))))
    with pytest.raises(UserError, match="room_sensors: input should be a valid tuple"):
        GuardSettings.from_dict({"room_sensors": "t_ambient"})


@pytest.mark.parametrize(
    ("guard", "change", "kind"),
    [(Guard(PLANT, GuardSettings(limits={BLOCK: (20.0, 26.0)})), {BLOCK: 27.0}, "limit"),
     (Guard(PLANT), {BLOCK: nan}, "lost"),
     (Guard(PLANT), {BLOCK: 45.0}, "jump"),
     (Guard(skin=BLOCK), {BLOCK: nan}, "lost"),
     (Guard(PLANT, GuardSettings(others_degC=(0.0, 30.0))), {ROOM: 33.0}, ""),
     (Guard(PLANT), {ROOM: nan}, ""),
     (Guard(), {ROOM: nan}, "")],
)  # fmt: skip
def test_an_output_is_guarded_whatever_its_name_and_no_room_ends_a_session(
    guard: Guard, change: dict[str, float], kind: str
) -> None:
    found = read_by(guard, change, change, change, change)
    assert next((f.trip.kind for f in found if f.trip is not None), "") == kind
    assert found[-1].fresh == (kind in ("", "limit"))
    room = change.get(ROOM, nan)
    assert found[0].values[ROOM] == (room if isfinite(room) else 25.0)  # a room may jump


def test_a_room_that_stands_still_is_not_stuck_and_a_block_that_does_is() -> None:
    moves = [dict.fromkeys((BLOCK, ROOM), 25.0 + 0.0625 * (k % 2)) for k in range(25)]
    still = [{}] * 60
    assert all(one.trip is None for one in read_by(Guard(PLANT), *moves, *still))
    block = [{BLOCK: 25.0}] * 60
    assert "stuck" in [one.trip.kind for one in read_by(Guard(PLANT), *moves, *block) if one.trip]


def test_what_is_regulated_is_guarded_without_a_plant_too() -> None:
    guard = Guard()
    guard.target = {BLOCK: 25.0}
    assert [one.trip is None for one in read_by(guard, *[{BLOCK: nan}] * 3)] == [True, True, False]


def test_a_twin_has_its_room_in_every_measured_temperature_and_asks_for_the_rest() -> None:
    assert Twin(PLANT, ambient=21.0).read().values[ROOM] == 21.0
    with pytest.raises(UserError, match="does not say what its disturbance 'heat_ambient' was in the logs"):
        Twin(swapped("heat_ambient", units={"heat_ambient": "W"}))


class Lying(Twin):
    """A twin of which some sensors read something else."""

    error: Mapping[str, float] = MappingProxyType({})

    def read(self) -> Reading:
        true = super().read()
        return replace(true, values={**true.values, **self.error})


def test_a_session_starts_without_its_room_and_not_without_an_output() -> None:
    rig = Lying(PLANT, ambient=25.0, contact=Grip())
    rig.error = {BLOCK: nan}
    with pytest.raises(UserError, match=f"{BLOCK} reads nan"):
        run_session(rig, Constant(), 25.0, guard=Guard(PLANT))
    rig.error = {ROOM: nan}
    session = run_session(rig, Constant(), 25.0, guard=Guard(PLANT))
    assert (session.verdict, ROOM in session.log) == ("settled", False)  # it was never read


def test_a_sessions_log_and_grasp_have_the_rooms_of_the_plant_and_read_back_so(tmp_path: Path) -> None:
    rig = Twin(PLANT, ambient=25.0, contact=Grip())
    with RunFolder(tmp_path / "run") as folder:
        session = run_session(
            rig, Constant(), 25.0, guard=Guard(PLANT), grasp=("wood", 20.0), grasp_time=2.0, recorder=folder
        )
        folder.finish(session)
    for made in (session, read_run(tmp_path / "run")):
        assert made.log is not None
        assert names(made.log, "disturbance") == (ROOM,)
        assert names(made.log, "output") == ("t_surface", BLOCK)
        assert made.grasps["t_ambient"].values.tolist() == [25.0]
