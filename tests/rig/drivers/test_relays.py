"""Relays as drives: least times, the mean, and a heater and a cooler that never meet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from tests.rig.makers import STILL, Constant, make_lab
from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.log_files import read_log
from thermogrip.datasets.schema import make_log
from thermogrip.mpc import Controller, PIController
from thermogrip.mpc.closed_loop.simulate import RecordedController
from thermogrip.mpc.controllers.loop_monitor import LoopMonitor
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.design.relays import Relay
from thermogrip.mpc.plant.prediction import step_response
from thermogrip.rig.drivers.relays import RelayRig, read_relays
from thermogrip.rig.guard.guard import Guard
from thermogrip.rig.guard.settings import GuardSettings
from thermogrip.rig.interface import Reading, Rig
from thermogrip.rig.records.run_folder import RunFolder
from thermogrip.rig.session.session import play, run_session
from thermogrip.rig.simulation.twin import Twin
from thermogrip.sysid.identification import identify


class Board:
    """Inputs of a device, and when each was set to what."""

    expires_s, has_pump = 2.0, True
    grasp = release = notices = close = None

    def __init__(self, **units: str) -> None:
        self.units, self.now = units, 0.0
        self.drive, self.pump = dict.fromkeys(units, 0.0), 0
        self.set: list[tuple[float, dict[str, float]]] = [(0.0, dict(self.drive))]

    def apply(self, drive: Mapping[str, float], pump: int) -> None:
        self.drive, self.pump = dict(drive), pump
        self.set.append((self.now, self.drive))

    def wait(self, seconds: float) -> None:
        self.now += seconds

    def read(self) -> Reading:
        return Reading(self.now, {}, self.drive, self.pump)

    def spells(self, name: str) -> list[tuple[float, float]]:
        """Return each value that an input had, and for how long [s]; the last one is not over."""
        changes = [self.set[0], *(b for a, b in pairwise(self.set) if a[1][name] != b[1][name])]
        return [(a[1][name], b[0] - a[0]) for a, b in pairwise(changes)]

    def integral(self, name: str) -> tuple[Array, Array]:
        """Return times, and the integral of an input until then."""
        times = np.array([at for at, _ in self.set] + [self.now])
        values = np.array([drive[name] for _, drive in self.set])
        return times, np.concatenate([[0.0], np.cumsum(values * np.diff(times))])


def played(board: Board, relay: Relay, requests: Array, look_s: float = 0.5) -> RelayRig:
    rig = RelayRig(board, {"drive": relay}, lambda: board.now)  # type: ignore[arg-type]
    for request in requests.tolist():
        rig.apply({"drive": request}, 1)
        rig.wait(look_s)
    return rig


def restless(seed: int, low: float, n: int = 4000) -> Array:
    """Return requests that a bad loop makes: steps of any length, the ends among them, and noise."""
    rng = np.random.default_rng(seed)
    steps = np.repeat(rng.uniform(low - 0.3, 1.3, n), rng.integers(1, 80, n))[:n]
    return np.clip(steps + 0.02 * rng.standard_normal(n), low, 1.0)


@pytest.mark.parametrize(("on_s", "off_s"), [(10.0, 10.0), (3.0, 30.0), (40.0, 5.0), (0.3, 0.2)])
@pytest.mark.parametrize("seed", range(3))
def test_a_relay_keeps_its_least_times_and_the_mean_of_what_is_requested(
    on_s: float, off_s: float, seed: int
) -> None:
    board, requests = Board(drive="1"), restless(seed, 0.0)
    requests[: round(2 * off_s)] = 0.0  # for what a start waits nothing is owed
    played(board, Relay("drive", on_s=on_s, off_s=off_s), requests)
    spells = board.spells("drive")[1:]  # the first is from before
    assert {value for value, _ in spells} == {0.0, 1.0}
    assert min(length for value, length in spells if value == 1.0) >= on_s - 1e-4
    assert min(length for value, length in spells if value == 0.0) >= off_s - 1e-4
    times, had = board.integral("drive")
    asked = np.concatenate([[0.0], 0.5 * np.cumsum(requests)])
    wanted = np.interp(times, 0.5 * np.arange(requests.size + 1), asked)
    owed = wanted - had
    resolution = 0.02  # of two waits
    assert owed.min() >= -0.5 * on_s - resolution
    assert owed.max() <= max(0.5 * on_s, off_s) + resolution


@pytest.mark.parametrize("share", [0.02, 0.25, 0.5, 0.8, 0.99])
def test_over_its_period_a_relay_is_on_for_the_share_that_is_requested(share: float) -> None:
    board = Board(drive="percent")
    played(board, Relay("drive", on_s=5.0, off_s=5.0), np.full(6000, 100 * share))
    spells = board.spells("drive")[-4:]
    on = sum(length for value, length in spells if value == 100.0)
    assert on / sum(length for _, length in spells) == pytest.approx(share, abs=1e-4)


@pytest.mark.parametrize("request_", [0.0, 1.0])
def test_nothing_and_everything_are_not_switched(request_: float) -> None:
    board = Board(drive="1")
    played(board, Relay("drive", on_s=5.0, off_s=5.0), np.full(400, request_))
    assert len(board.spells("drive")) == request_


@pytest.mark.parametrize("same", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_heater_and_cooler_never_meet(same: bool, seed: int) -> None:
    board = Board(drive="1") if same else Board(heat="percent", cool="1")
    relay = Relay("drive", "drive", 8.0, 12.0, 6.0) if same else Relay("heat", "cool", 8.0, 12.0, 6.0)
    played(board, relay, restless(seed, -1.0))
    if same:
        states = [(at, drive["drive"]) for at, drive in board.set]
    else:
        assert not any(drive["heat"] and drive["cool"] for _, drive in board.set)
        states = [(at, np.sign(drive["heat"]) - drive["cool"]) for at, drive in board.set]
    assert {state for _, state in states} == {-1.0, 0.0, 1.0}
    ended = {1.0: -np.inf, -1.0: -np.inf}  # when each was on last
    for (_, before), (at, state) in pairwise(states):
        if before:
            ended[before] = at
        if state and state != before:
            assert at - ended[-state] >= 6.0 - 1e-4


def test_two_drives_that_are_a_pair_never_meet_whatever_is_asked_of_both() -> None:
    board = Board(heat="percent", cool="1")
    relays = {"heat": Relay("heat", "cool", 8.0, 12.0, 6.0), "cool": Relay(on_s=5.0, off_s=9.0)}
    rig = RelayRig(board, relays, lambda: board.now)  # type: ignore[arg-type]
    for heat, cool in zip(restless(1, -0.5).clip(0), restless(2, -0.5).clip(0)):
        rig.apply({"heat": 100 * heat, "cool": cool}, 1)
        rig.wait(0.5)
    ended, states = {"heat": -np.inf, "cool": -np.inf}, []
    for (_, before), (at, now) in pairwise(board.set):
        states.append(tuple(value > 0 for value in now.values()))
        ended |= {name: at for name in ended if before[name]}
        assert not (now["heat"] and not before["heat"] and at - ended["cool"] < 6.0 - 1e-4)
        assert not (now["cool"] and not before["cool"] and at - ended["heat"] < 6.0 - 1e-4)
    assert set(states) == {(False, False), (True, False), (False, True)}
    for name, on_s, off_s in (("heat", 8.0, 12.0), ("cool", 5.0, 9.0)):
        assert min(length for value, length in board.spells(name)[1:] if value) >= on_s - 1e-4
        assert min(length for value, length in board.spells(name)[1:] if not value) >= off_s - 1e-4


def test_a_drive_of_one_sign_gets_its_mean_from_its_own_relay() -> None:
    board = Board(heat="1", cool="1")
    played(board, Relay("heat", "cool", 5.0, 5.0, 10.0), np.full(4000, -0.3))
    assert board.integral("heat")[1][-1] == 0.0
    assert board.integral("cool")[1][-1] / 2000.0 == pytest.approx(0.3, abs=0.005)


@pytest.mark.parametrize("by_hand", [0.0, 1.0])  # a hand-over is a start
def test_least_off_is_kept_from_the_start_and_after_a_stop(by_hand: float) -> None:
    board = Board(drive="1")
    board.set[0][1]["drive"] = by_hand
    rig = played(board, Relay("drive", on_s=60.0, off_s=30.0), np.full(100, 1.0))
    assert board.spells("drive")[-1] == (0.0, pytest.approx(30.0))  # nobody knows since when it was off
    rig.apply({"drive": 0.0}, 0)  # on for 20 s
    stopped_s = board.now
    for _ in range(80):
        rig.apply({"drive": 1.0}, 1)
        rig.wait(0.5)
    on_again_s = next(at for at, drive in board.set if at > stopped_s and drive["drive"])
    assert on_again_s - stopped_s == pytest.approx(30.0, abs=0.5)
    board = Board(drive="1")  # what it waited for at the start is not owed
    played(board, Relay("drive", on_s=10.0, off_s=60.0), np.repeat([1.0, 0.0], [200, 40]))
    assert board.spells("drive") == [(0.0, pytest.approx(60.0)), (1.0, pytest.approx(45.0, abs=0.1))]


@pytest.mark.parametrize(("lost_s", "highest", "kind"), [(90.0, 60.0, "lost"), (np.inf, 28.0, "limit")])
def test_a_trip_switches_off_at_once(lost_s: float, highest: float, kind: str) -> None:
    lab = make_lab()
    twin = Twin(lab, **STILL, skin="t1")
    rig = RelayRig(twin, {"q1": Relay(on_s=100.0)}, lambda: twin.time)
    read = rig.read

    def read_until_lost() -> Reading:
        reading = read()
        return reading if twin.time < lost_s else replace(reading, values={**reading.values, "t1": np.nan})

    rig.read = read_until_lost  # type: ignore[method-assign]
    watch = Guard(lab, GuardSettings.of(lab, "t1").below(highest), skin="t1")
    session = run_session(rig, Constant({"q1": 90.0, "q2": 0.0}), {"t1": 27.0}, output="t1", guard=watch)
    on_s = [row["time_s"] for row in twin.history if row["q1"] == 100.0]
    assert (session.trip and session.trip.kind, twin.read().drive) == (kind, {"q1": 0.0, "q2": 0.0})
    assert 10.0 < on_s[-1] - on_s[0] < 90.0  # of the 100 s that it is on at least


def test_a_reading_has_the_request_while_the_device_does_what_it_was_told() -> None:
    board = Board(drive="1", heat="percent", cool="percent")
    rig = RelayRig(board, {"t": Relay("heat", "cool", 9.0, 9.0)}, lambda: board.now)  # type: ignore[arg-type]
    assert rig.units == {"t": "1", "drive": "1"}
    rig.apply({"t": 0.25, "drive": -0.5}, 1)
    rig.wait(40.0)
    reading = rig.read()
    assert reading.drive == {"t": 0.25, "drive": -0.5}
    assert reading.mean_drive is not None
    assert reading.mean_drive["t"] == pytest.approx(board.integral("heat")[1][-1] / 100.0 / 40.0)
    assert rig.read().mean_drive == reading.mean_drive  # the same sample
    board.drive = {"drive": -0.5, "heat": 0.0, "cool": 100.0}  # a relay that sticks
    assert rig.read().drive == {"t": -1.0, "drive": -0.5}


def test_a_log_under_relays_has_what_they_gave_and_identifies_the_plant(tmp_path: Path) -> None:
    lab = make_lab()
    twin = Twin(lab, seed=1, skin="t1")
    relays = {name: Relay(on_s=10.0, off_s=10.0) for name in lab.inputs}
    rig = RelayRig(twin, relays, lambda: twin.time)
    levels = np.repeat(np.random.default_rng(1).uniform(0.0, 100.0, (2, 171)), 7, axis=1)
    columns = {name: (level, "percent", "input") for name, level in zip(lab.inputs, levels)}
    schedule = make_log(np.arange(levels.shape[1]), columns, name="levels")
    with RunFolder(tmp_path / "run") as folder:
        log, ended = play(rig, schedule, guard=Guard(lab, skin="t1"), recorder=folder)
        folder.played(ended)
    assert (isinstance(rig, Rig), ended) == (True, "")
    written = read_log(tmp_path / "run" / "samples.csv")
    for name in lab.inputs:
        device = np.array([row[name] for row in twin.history[1:]])
        np.testing.assert_allclose(log[name].values, device, atol=1e-6)  # a row is a step of the twin
        np.testing.assert_allclose(written[name].values, device, atol=1e-6)
        assert {written[name].attrs["role"], written[f"asked_{name}"].attrs["role"]} == {"input", "other"}
        assert np.ptp(written[f"asked_{name}"].values) < 100.0 == np.ptp(device)
    found = identify(tmp_path / "run" / "samples.csv", models=("arx",), draws=0).plant
    for drive, output in (("q1", "t1"), ("q2", "t2")):
        assert step_response(found, drive, output).gain == pytest.approx(30.3, rel=0.05)
    twin = Twin(lab, **STILL, skin="t1")
    rig = RelayRig(twin, relays, lambda: twin.time)
    half, watch = Constant({"q1": 50.0, "q2": 0.0}), Guard(found, skin="t1")  # 15.15 K by its equations
    session = run_session(rig, half, {"t1": 40.15}, output="t1", band=1.5, settle_timeout=2000.0, guard=watch)
    assert (session.trip, session.verdict) == (None, "settled")
    assert set(session.log["asked_q1"].values) == {50.0}


@pytest.mark.parametrize("on_s", [2.0, 10.0])
def test_a_loop_has_settled_when_what_is_left_is_the_ripple_of_its_relays(on_s: float) -> None:
    lab = make_lab()
    twin = Twin(lab, seed=1, skin="t1")
    rig = RelayRig(twin, {name: Relay(on_s=on_s, off_s=on_s) for name in lab.inputs}, lambda: twin.time)
    design = default_design(lab, controlled=("t1",), drive_range=dict.fromkeys(lab.inputs, (0.0, 100.0)))
    session = run_session(rig, Controller(lab, design), {"t1": 45.0}, output="t1", hold=200.0)
    ripple = session.log["t1"].values[-200:] - 45.0
    assert (np.std(ripple) > 0.25) == (on_s == 10.0)
    assert (session.verdict, abs(session.bias) < 0.1) == ("settled", True)
    assert session.settle_time < session.log["time"].values[-1] - 200.0


def test_what_relays_gave_is_no_fault_of_the_plant() -> None:
    lab, relays = make_lab(), {"q1": Relay(on_s=100.0, off_s=100.0)}
    loop, twin = PIController(lab, controlled=("t1",)), Twin(lab, seed=2, skin="t1")
    watched = RecordedController(loop, LoopMonitor(lab, loop.design))
    rig = RelayRig(twin, relays, lambda: twin.time)
    run_session(rig, watched, {"t1": 40.0}, output="t1", settle_timeout=1500.0, band=0.05)
    assert {move.advice for _, move in watched.moves} == {""}


@pytest.mark.parametrize(
    ("text", "words"),
    [("", "has no relay; write [q1]"), ("q1 = 3\n", "q1: input should be a dictionary"),
     ("[q1]\non = 3\n", "q1.on: no such key"),
     ("[q1]\non_s = -1\n", "q1.on_s: input should be greater than or equal to 0"),
     ("[q1]\non_s = true\n", "q1.on_s: input should be a valid number"),
     ("[q1]\ncooler = 3\n", "q1.cooler: input should be a valid string")],
)  # fmt: skip
def test_a_file_that_is_wrong_anywhere_is_refused(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "relays.toml"
    path.write_text(text)
    with pytest.raises(UserError) as refused:
        read_relays(path)
    assert words in str(refused.value)


def test_a_relay_of_no_input_is_refused() -> None:
    with pytest.raises(UserError, match="the rig has no input 'q3'"):
        RelayRig(Twin(make_lab()), {"t": Relay("q3")}, lambda: 0.0)
