"""A controller as a ROS 2 node, without ROS: bag in and bag out, and its file beside a stand-in of rclpy."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.mpc.makers import kit
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.log_files import read_log
from thermogrip.datasets.rosbag import Column, TopicMap, read_topic_map, write_bag
from thermogrip.mpc.controllers.ros2_node import TopicLoop, load_loop, replay_bag, write_node
from thermogrip.mpc.interface import STATUSES

pytest.importorskip("rosbags")
pytest.importorskip("mcap")

FLOAT = "std_msgs/msg/Float64"
N, DT = 30, 5.0
RNG = np.random.default_rng(0)
ROWS = {"t1": 25 + np.cumsum(0.2 * RNG.random(N)), "t2": 25 + np.cumsum(0.1 * RNG.random(N))}
TARGETS = {"target_t1": 40.0, "target_t2": 30.0}


def number(value: Any) -> SimpleNamespace:
    return SimpleNamespace(data=value)


def recorded(folder: Path, rows: dict[str, np.ndarray], start: float = 1.7e9) -> Path:
    """A bag of readings every 5 s, each 10 ms before its tick, and of targets at the beginning."""
    said = [(f"/thermogrip/{name}", FLOAT, start, value) for name, value in TARGETS.items()]
    for k in range(N):
        at = start + DT * k - (0.01 if k else 0.0)
        said += [(f"/thermogrip/{name}", FLOAT, at, float(values[k])) for name, values in rows.items()]
    return write_bag(folder, said)


def test_a_bag_is_answered_as_the_controller_answers(tmp_path):
    controller = kit()
    assert write_node(controller, tmp_path / "node") == (
        "controller.json",
        "thermogrip_node.py",
        "topics.toml",
    )
    count = replay_bag(load_loop(tmp_path / "node"), recorded(tmp_path / "in", ROWS), tmp_path / "out")
    assert count == N
    (tmp_path / "out/topics.toml").write_text(
        # what was published, of the map of the node
        "\n\n".join(
            part
            for part in (tmp_path / "node/topics.toml").read_text().split("\n\n")
            if part.startswith(("#", "[columns.q", "[columns.pump", "[columns.status"))
        )
    )
    log = read_log(tmp_path / "out")
    assert log["q1"].attrs["role"] == "input"
    controller.reset({name: values[0] for name, values in ROWS.items()})
    moves = []
    for k in range(N):
        reading = {"time_s": 1.7e9 + DT * k} | {name: float(values[k]) for name, values in ROWS.items()}
        moves.append(controller.step(reading, {"t1": 40.0, "t2": 30.0}))
    np.testing.assert_array_equal(log["time"], DT * np.arange(N))
    for name in ("q1", "q2"):
        np.testing.assert_allclose(log[name], [move.drive[name] for move in moves], rtol=1e-12, atol=1e-12)
    assert log["status"].values.tolist() == [STATUSES.index(move.status) for move in moves]
    assert np.ptp(log["q1"].values) > 10
    with pytest.raises(UserError, match="is there already"):
        replay_bag(load_loop(tmp_path / "node"), tmp_path / "in", tmp_path / "out")


def loop_of(**changed: Column) -> TopicLoop:
    columns = {name: Column(f"/a/{name}", "data", "degC") for name in ("t1", "t2", "target_t1", "target_t2")}
    columns |= {name: Column(f"/a/{name}", "data", "percent") for name in ("q1", "q2")}
    return TopicLoop(kit(), TopicMap({k: v for k, v in (columns | changed).items() if v is not None}))


def test_messages_of_other_types_fields_and_units_are_converted():
    skin = Column("/skin", "temperature", "K")
    loop, same = loop_of(t1=skin), loop_of()
    assert dict(loop.subscriptions)["/skin"] == "sensor_msgs/msg/Temperature"
    for k in range(3):
        same.hear("/a/t1", number(24.0 + k), 5.0 * k)
        loop.hear("/skin", SimpleNamespace(temperature=297.15 + k), 5.0 * k)
        for each in (loop, same):
            each.hear("/a/t2", number(25.0), 5.0 * k)
            each.hear("/a/target_t1", number(40.0), 5.0 * k)
            each.hear("/a/target_t2", number(30), 5.0 * k)
        one, other = loop.tick(5.0 * k), same.tick(5.0 * k)
        assert list(one) == ["/a/q1", "/a/q2"]
        assert one == pytest.approx(other, abs=1e-9)
    with pytest.raises(UserError, match="has no number 'temperature'"):
        loop.hear("/skin", number(3.0), 20.0)


def test_nothing_is_sent_before_all_is_heard_and_again_after_a_reset():
    loop = loop_of()
    for topic, value in (("t1", 24.0), ("t2", 25.0), ("target_t1", 40.0)):
        loop.hear(f"/a/{topic}", number(value), 0.0)
        assert loop.tick(0.0) == {}
    assert "/a/target_t2" in loop.advice
    loop.hear("/a/target_t2", number(30.0), 0.0)
    assert set(loop.tick(5.0)) == {"/a/q1", "/a/q2"}
    assert loop.advice == ""
    loop.reset()
    assert loop.tick(10.0) == {}


def test_an_output_that_falls_silent_is_lost_and_the_drives_go_to_rest():
    loop = loop_of(status=Column("/a/status", "data", "1"))
    statuses = []
    for k in range(80):
        if k < 10:
            for topic, value in (("t1", 24.0), ("t2", 25.0), ("target_t1", 40.0), ("target_t2", 30.0)):
                loop.hear(f"/a/{topic}", number(value), 5.0 * k)
        answer = loop.tick(5.0 * k)
        statuses.append(STATUSES[round(answer["/a/status"])])
    assert statuses[1] == "ok"
    assert statuses[-1] == "off"
    assert (answer["/a/q1"], answer["/a/q2"]) == (0.0, 0.0)
    assert "no reading" in loop.advice


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"q1": None}, "has no column q1"),
        ({"target_t2": None}, "has no column target_t2"),
        ({"q1": Column("/a/q1", "data", "1")}, "is published as field 'data' in 'percent'"),
        ({"q1": Column("/a/q1", "value", "percent")}, "the map says otherwise"),
        ({"q1": Column("/a/q1", "data", "percent", "", "pkg/msg/Command")}, "publishes pkg/msg/Command"),
    ],
)
def test_maps_that_cannot_be_are_refused(changed, words):
    with pytest.raises(UserError, match=words):
        loop_of(**changed)


def test_an_edited_map_stays(tmp_path):
    write_node(kit(), tmp_path)
    file = tmp_path / "topics.toml"
    file.write_text(file.read_text().replace("/thermogrip/t1", "/left/skin"))
    write_node(kit(), tmp_path)
    assert read_topic_map(file).columns["t1"].topic == "/left/skin"
    assert ("/left/skin", FLOAT) in load_loop(tmp_path).subscriptions


class Ended(Exception):
    """What rclpy raises when ROS shuts down."""


class Ros:
    """A stand-in of rclpy: a node that hears what a test says, at the times that it says."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, spin: Any) -> None:
        self.sent: list[tuple[str, Any]] = []
        self.heard: dict[str, Any] = {}
        self.time, self.alive, self.warned = 0.0, True, []
        ros = self

        class Node:
            def __init__(self, name: str) -> None:
                self.name = name

            def create_publisher(self, kind: type, topic: str, depth: int) -> Any:
                return SimpleNamespace(publish=lambda message: ros.sent.append((topic, message.data)))

            def create_subscription(self, kind: type, topic: str, callback: Any, depth: int) -> None:
                ros.heard[topic] = callback

            def create_service(self, kind: type, name: str, callback: Any) -> None:
                ros.reset = callback

            def create_timer(self, seconds: float, callback: Any) -> None:
                ros.period, ros.tick = seconds, callback

            def get_clock(self) -> Any:
                return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=round(1e9 * ros.time)))

            def get_logger(self) -> Any:
                return SimpleNamespace(warning=lambda words, **_: ros.warned.append(words))

            def destroy_node(self) -> None:
                ros.alive = False

        def get_message(kind: str) -> type:
            start = {"Bool": False, "UInt8": 0}.get(kind.rpartition("/")[2], 0.0)
            return type(kind, (), {"data": start})

        modules = {
            "rclpy": {"init": lambda args: None, "ok": lambda: True, "spin": lambda node: spin(ros),
                      "try_shutdown": lambda: None},
            "rclpy.executors": {"ExternalShutdownException": Ended},
            "rclpy.node": {"Node": Node},
            "rosidl_runtime_py.utilities": {"get_message": get_message},
            "std_srvs.srv": {"Trigger": object},
        }  # fmt: skip
        for name in ("rosidl_runtime_py", "std_srvs", *modules):
            module = ModuleType(name)
            vars(module).update(modules.get(name, {}))
            monkeypatch.setitem(sys.modules, name, module)


def test_the_nodes_file_hears_ticks_resets_and_ends_with_safe_drives(tmp_path, monkeypatch):
    def spin(ros: Ros) -> None:
        ros.tick()
        assert ros.sent == []
        assert "no message yet" in ros.warned[-1]
        for name, value in {"t1": 24.0, "t2": 25.0, **TARGETS}.items():
            ros.heard[f"/thermogrip/{name}"](number(value))
        ros.time = DT
        ros.tick()
        response = ros.reset(None, SimpleNamespace())
        assert response.success
        ros.tick()
        raise Ended

    ros = Ros(monkeypatch, spin)
    write_node(kit(), tmp_path)
    monkeypatch.setattr(sys, "argv", ["thermogrip_node.py"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(tmp_path / "thermogrip_node.py"), run_name="__main__")
    assert ended.value.code == 0
    assert (ros.period, ros.alive) == (DT, False)
    answer, last = dict(ros.sent[:4]), dict(ros.sent[4:])
    assert set(answer) == {f"/thermogrip/{name}" for name in ("q1", "q2", "pump", "status")}
    assert answer["/thermogrip/q1"] > 0
    assert answer["/thermogrip/pump"] is True
    assert last == {"/thermogrip/q1": 0.0, "/thermogrip/q2": 0.0, "/thermogrip/pump": False,
                    "/thermogrip/status": STATUSES.index("off")}  # fmt: skip


def test_the_nodes_file_answers_a_bag_from_the_shell(tmp_path, monkeypatch, capsys):
    write_node(kit(), tmp_path)
    bag = recorded(tmp_path / "in", ROWS)
    monkeypatch.setattr(sys, "argv", ["n", "--bag", str(bag), "--out", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(tmp_path / "thermogrip_node.py"), run_name="__main__")
    assert (ended.value.code, f"{N} answers" in capsys.readouterr().out) == (0, True)
    monkeypatch.setattr(sys, "argv", ["n", "--bag", str(tmp_path / "no"), "--out", str(tmp_path / "new")])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(tmp_path / "thermogrip_node.py"), run_name="__main__")
    assert (ended.value.code, capsys.readouterr().err.count("\n")) == (2, 1)
