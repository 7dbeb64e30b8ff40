"""A controller between ROS 2 topics: messages in, messages out, without ROS.

The node that :func:`write_node` writes does what ROS needs (subscriptions, a timer of the controller's sample
time, publishers) and has this loop do the rest, so that the same loop answers a recorded bag
(:func:`replay_bag`).  A topic map (:class:`~thermogrip.datasets.rosbag.TopicMap`) names the topic of each
reading, of each target (``target_<output>``), of each drive, of ``pump`` and of ``status`` (the place in
:data:`thermogrip.mpc.interface.STATUSES`); the same file tells ``identify`` what a bag of the session holds.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from importlib import resources
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.files import write_atomic
from thermogrip.datasets.rosbag import (
    Column,
    Message,
    TopicMap,
    bag_messages,
    column_value,
    read_topic_map,
    write_bag,
)
from thermogrip.mpc.controllers.mpc import Controller, load_controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.interface import STATUSES

#: An output that was not heard for so many sample times is lost; a measured disturbance stays.
KEPT_SAMPLES = 3
TARGET = "target_"  # with the name of an output
_OF_NODE = {"pump": "std_msgs/msg/Bool", "status": "std_msgs/msg/UInt8"}
_TEMPERATURE_TYPE, _FLOAT_TYPE = "sensor_msgs/msg/Temperature", "std_msgs/msg/Float64"
_SENT = {
    "Bool", "Float32", "Float64", "Int8", "Int16", "Int32", "Int64", "UInt8", "UInt16", "UInt32", "UInt64"
}  # fmt: skip


class _Heard(NamedTuple):
    value: float  # in the unit of the records
    time: float  # s, of the node's clock


class TopicLoop:
    """A controller whose readings and targets come as messages; ``advice`` is a clause for the operator."""

    def __init__(
        self, controller: Controller | PIController, topics: TopicMap, *, file: str | Path = "topics"
    ) -> None:
        self.controller, self.dt, self._columns = controller, controller.dt, dict(topics.columns)
        model = controller.model
        self._targets = {TARGET + name: name for name in controller.controlled}
        needed = (*controller.controlled, *self._targets, *model.drives)
        for name in (name for name in needed if name not in self._columns):
            hint = f"add [columns.{name}], or write the folder again"
            raise UserError(f"has no column {name}", file=file, hint=hint)
        self._readings = [name for name in (*model.outputs, *model.disturbances) if name in self._columns]
        self._published = [name for name in (*model.drives, *_OF_NODE) if name in self._columns]
        for name in self._published:
            kind, unit = self._type(name), controller.plant.units.get(name, "1")
            if not kind.startswith("std_msgs/msg/") or kind.rpartition("/")[2] not in _SENT:
                problem = f"publishes {kind}"
                raise UserError(
                    problem, file=file, column=name, hint=f"type = {_FLOAT_TYPE!r}, field = 'data'"
                )
            if self._columns[name].unit != unit or self._columns[name].field != "data":
                problem = f"is published as field 'data' in {unit!r}, the map says otherwise"
                raise UserError(problem, file=file, column=name, hint="convert it where it is received")
        self.reset()

    @property
    def subscriptions(self) -> tuple[tuple[str, str], ...]:
        """Topics to hear, with their types, each once."""
        return tuple(
            {self._columns[n].topic: self._type(n) for n in (*self._readings, *self._targets)}.items()
        )

    @property
    def publications(self) -> tuple[tuple[str, str], ...]:
        """Topics that are published, with their types."""
        return tuple((self._columns[name].topic, self._type(name)) for name in self._published)

    def _type(self, name: str) -> str:
        column = self._columns[name]
        usual = _TEMPERATURE_TYPE if column.field == "temperature" else _FLOAT_TYPE
        return column.type or _OF_NODE.get(name, usual)

    def reset(self) -> None:
        """Forget the past: it starts at rest at what is heard from now on."""
        self._heard: dict[str, _Heard] = {}
        self._running, self.advice = False, ""

    def hear(self, topic: str, message: Any, seconds: float) -> None:
        """Take the readings and targets of a message that came at this time of the node's clock [s]."""
        for name in (*self._readings, *self._targets):
            column = self._columns[name]
            if column.topic == topic:
                heard_message = Message(topic, self._type(name), seconds, message, {})
                self._heard[name] = _Heard(column_value(heard_message, column, name, "topics.toml"), seconds)

    def tick(self, seconds: float) -> dict[str, float]:
        """Return what is published at this time of the node's clock [s], a number by topic."""
        waiting = [n for n in (*self.controller.controlled, *self._targets) if n not in self._heard]
        if waiting and not self._running:
            self.advice = f"no message yet of {', '.join(self._columns[name].topic for name in waiting)}"
            return {}
        reading = {name: self._reading(name, seconds) for name in self._readings if name in self._heard}
        if not self._running:
            self.controller.reset(reading)
            self._running = True
        targets = {output: self._heard[name].value for name, output in self._targets.items()}
        move = self.controller.step({"time_s": seconds, **reading}, targets)
        self.advice = move.advice
        drives = self.controller.model.drives
        answer = dict(zip(drives, move.drives(drives), strict=True))
        return self._by_topic(
            answer | {"pump": float(move.pump), "status": float(STATUSES.index(move.status))}
        )

    def stop(self) -> dict[str, float]:
        """Return what is published at the end: drives at their safe values, the pump off."""
        safe = dict(zip(self.controller.model.drives, self.controller.safe_drives.tolist(), strict=True))
        return self._by_topic(safe | {"pump": 0.0, "status": float(STATUSES.index("off"))})

    def _reading(self, name: str, seconds: float) -> float:
        heard = self._heard[name]
        old = seconds - heard.time > KEPT_SAMPLES * self.dt
        return math.nan if old and name in self.controller.model.outputs else heard.value

    def _by_topic(self, answer: Mapping[str, float]) -> dict[str, float]:
        return {self._columns[name].topic: answer[name] for name in self._published}


def write_node(controller: Controller | PIController, folder: str | Path) -> tuple[str, ...]:
    """Write a controller as a ROS 2 node into a folder, but for a ``topics.toml`` that is there already."""
    place = Path(folder)
    place.mkdir(parents=True, exist_ok=True)
    controller.save(place / "controller.json")
    source = resources.files("thermogrip.mpc.controllers") / "ros2_node.py.in"
    write_atomic(place / "thermogrip_node.py", source.read_text(encoding="utf-8"))
    if not (place / "topics.toml").exists():
        write_atomic(place / "topics.toml", _topics_of(controller))
    load_loop(place)
    return "controller.json", "thermogrip_node.py", "topics.toml"


def load_loop(folder: str | Path) -> TopicLoop:
    """Return the loop of a folder that :func:`write_node` wrote."""
    file = Path(folder) / "topics.toml"
    return TopicLoop(load_controller(Path(folder) / "controller.json"), read_topic_map(file), file=file)


def replay_bag(loop: TopicLoop, bag: str | Path, out: str | Path) -> int:
    """Write what a loop answers to a recorded bag as a ROS 2 bag (MCAP), and return the number of answers."""
    types = dict(loop.publications)
    answered = [(seconds, answer) for seconds, answer in _ticks(loop, bag) if answer]
    messages = (
        (topic, types[topic], seconds_of, value)
        for seconds_of, answer in answered
        for topic, value in answer.items()
    )
    write_bag(out, messages)
    return len(answered)


def _ticks(loop: TopicLoop, bag: str | Path) -> Iterator[tuple[float, dict[str, float]]]:
    """Yield the time of each tick [s] and what the loop then answers."""
    topics, due_message = {topic for topic, _ in loop.subscriptions}, 0
    heard = [message for message in bag_messages(bag) if message.topic in topics]
    if not heard:
        raise UserError("has none of the loop's topics", file=bag, hint="correct topics.toml")
    loop.reset()
    for k in count():
        due = heard[0].time + k * loop.dt
        while due_message < len(heard) and heard[due_message].time <= due:
            loop.hear(heard[due_message].topic, heard[due_message].content, heard[due_message].time)
            due_message += 1
        yield due, loop.tick(due)
        if due_message == len(heard):
            return


def _topics_of(controller: Controller | PIController) -> str:
    """Return a topic map to edit."""
    model, units = controller.model, controller.plant.units
    lines = [
        "# Which field of which topic is which reading, target or drive: edit the topics, fields, units and",
        "# types.  Readings and targets may have any type and unit (degC K degF percent ...); drives are",
        "# published as std_msgs numbers in the unit below.  `identify` reads a bag of the session by this.",
        'schema = "thermogrip.topics"',
        "version = 1",
    ]
    roles = dict.fromkeys(model.outputs, "output") | dict.fromkeys(model.disturbances, "disturbance")
    roles |= {TARGET + name: "other" for name in controller.controlled}
    roles |= dict.fromkeys(model.drives, "input") | dict.fromkeys(_OF_NODE, "other")
    for name, role in roles.items():
        unit = units.get(name.removeprefix(TARGET), "1")
        kind = _OF_NODE.get(name, _FLOAT_TYPE)
        column = Column(f"/thermogrip/{name}", "data", unit, role, kind)
        entries = [f'{key} = "{value}"' for key, value in vars(column).items()]
        lines += ["", f"[columns.{name}]", *entries]
    return "\n".join(lines) + "\n"
