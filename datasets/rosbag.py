"""Logs out of robots: ROS 1 .bag, ROS 2 .db3 and .mcap, and MCAP files of JSON, without ROS installed.

A topic map says which field of which topic is which column (as in ``data/topics.toml``): it is read from
``<name>.topics.toml`` or ``topics.toml`` beside the bag.  Without one, every topic of a single number becomes
a column: a ``sensor_msgs/Temperature`` a temperature, others what their name's suffix says.

Rows are the times of one topic, the *clock* (by default the output with the most messages); nothing is
interpolated.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError, as_user_error, known_names, os_faults, reading
from thermogrip.datasets.files import check_source, file_stem, read_bytes, read_toml
from thermogrip.datasets.limits import Unpacker, check_size
from thermogrip.datasets.roles import guess_role
from thermogrip.datasets.schema import ROLES
from thermogrip.datasets.tables import Table
from thermogrip.datasets.units import UNITS, split_header, to_record_unit

_NO_NUMBER = (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError)
_SINGLE_FIELDS = {"temperature": "degC", "data": ""}  # the one field of a message without a map, and its unit


@dataclass(frozen=True)
class Column:
    """Where a column comes from: topic, field (dots and indices), unit, role ("" to guess), and the type of
    its messages, which a bag says itself and a node does not."""

    topic: str
    field: str = "data"
    unit: str = "1"
    role: str = ""
    type: str = ""


@dataclass(frozen=True)
class TopicMap:
    """Columns by name, and which of them is the clock ("" to choose)."""

    columns: Mapping[str, Column]
    clock: str = ""


@dataclass(frozen=True)
class Message:
    """One decoded message."""

    topic: str
    type: str
    time: float  # s since 1970
    content: Any
    attrs: Mapping[str, str]


def read_topic_map(path: str | Path) -> TopicMap:
    """Return the topic map of a TOML file."""
    content = read_toml(path, hint="compare it with `init topics`")
    unknown = sorted(set(content) - {"schema", "version", "clock", "stamp", "columns"})
    is_map = content.get("schema") == "thermogrip.topics" and isinstance(content.get("columns"), dict)
    if unknown or not is_map:
        fault = f"has the unknown key {unknown[0]!r}" if unknown else "is no topic map"
        raise UserError(fault, file=path, hint="write a fresh one with `thermogrip init topics`")
    columns = {name: _column(name, entry, path) for name, entry in content["columns"].items()}
    clock = str(content.get("clock", ""))
    if clock and clock not in columns:
        raise UserError(f"clock {clock!r} is no column", file=path, hint=known_names(clock, columns))
    if (stamp := content.get("stamp", "log")) != "log":  # which version 0.2 had beside "header"
        hint = "remove the line: a message counts from when it was recorded"
        raise UserError(f"stamp {stamp!r} is not read", file=path, hint=hint)
    return TopicMap(columns, clock)


def _column(name: str, entry: Any, path: str | Path) -> Column:
    place: dict[str, Any] = {"file": path, "column": name}
    no_column = (AttributeError, TypeError)  # no table, another key, or no topic
    with as_user_error(no_column, "needs topic, field, unit, role", **place, hint="name its topic"):
        column = Column(**{key: str(value) for key, value in entry.items()})
    for kind, word, known in (("unit", column.unit, (*UNITS, "1")), ("role", column.role or "other", ROLES)):
        if word not in known:
            raise UserError(f"{kind} {word!r} is unknown", **place, hint=known_names(word, known))
    return column


def read_rosbag_table(path: str | Path, topics: TopicMap | None = None) -> Table:
    """Return the columns of a bag on one time axis, by this map, the TOML file beside the bag, or guessed."""
    file = Path(path)
    maps = [file / f"{file.name}.topics.toml", file / "topics.toml"]  # in the folder of a bag, or beside it
    maps += [file.parent / f"{file_stem(file)}.topics.toml", file.parent / "topics.toml"]
    map_beside = next((path for path in maps if path.is_file()), None)
    topic_map = topics or (read_topic_map(map_beside) if map_beside else TopicMap({}))
    notes: list[str] = []
    readings: dict[str, list[tuple[float, float]]] = {}  # time and value, by column
    columns = dict(topic_map.columns)
    has_map = bool(columns)
    type_of_topic: dict[str, str] = {}
    for message in _messages(file, notes):
        type_of_topic[message.topic] = message.type
        if not has_map:
            _guess_column(message, columns, file)
        for name, column in columns.items():
            if column.topic == message.topic:
                value = _message_number(message, column, name, file)
                readings.setdefault(name, []).append((message.time, value))
    have = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(type_of_topic.items())) or "none"
    for name, column in columns.items():
        if name not in readings:
            problem = f"topic {column.topic} has no message"
            raise UserError(problem, file=file, column=name, hint=f"it has {have}")
    if not columns:
        problem = f"has no topic with a single number (topics: {have})"
        raise UserError(problem, file=file, hint="write a topic map (`thermogrip init topics`)")
    return _bag_table(file, columns, readings, topic_map.clock, notes)


def bag_messages(path: str | Path) -> list[Message]:
    """Return the messages of a bag in the order of their times."""
    return sorted(_messages(Path(path), []), key=lambda message: message.time)


def column_value(message: Message, column: Column, name: str, source: str | Path) -> float:
    """Return the number that a message has for a column, in the unit of the records."""
    value = np.array([_message_number(message, column, name, Path(source))])
    return float(to_record_unit(value, column.unit)[0][0])


def write_bag(folder: str | Path, messages: Iterable[tuple[str, str, float, float]]) -> Path:
    """Write messages (topic, type of ``std_msgs``, time [s], value) as a ROS 2 bag (MCAP) and return its
    folder, which must not be there yet."""
    place = Path(folder)
    _need("rosbags", place)
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    if place.exists():
        raise UserError("is there already", file=place, hint="choose a new folder")
    store, connections = get_typestore(Stores.ROS2_HUMBLE), dict[str, Any]()
    with os_faults(place), Writer(place, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, kind, seconds, value in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            make, whole = store.types[kind], "Float" not in kind
            content = make(data=(bool(value) if kind.endswith("Bool") else int(value)) if whole else value)
            writer.write(connections[topic], round(1e9 * seconds), store.serialize_cdr(content, kind))
    return place


def bag_parts(folder: str | Path) -> list[Path]:
    """Return the files of the ROS 2 bag that a folder is; UserError where it is none, or a file that its
    ``metadata.yaml`` names is missing."""
    place = Path(folder)
    listed = place / "metadata.yaml"
    if not listed.is_file():  # which the writer makes last
        if stored := sorted(path for path in place.iterdir() if path.suffix.lower() in (".mcap", ".db3")):
            return stored
        raise UserError("is a folder, and no ROS 2 bag", file=place, hint="name a file in it")
    _need("rosbags", place)
    from ruamel.yaml import YAML

    data, hint = read_bytes(listed, most=32 << 20), "copy the whole bag again"
    with reading("is no metadata of a ROS 2 bag", file=listed, hint=hint):
        about_bag = YAML(typ="safe").load(data)["rosbag2_bagfile_information"]
        bag_files = [place / Path(str(name)).name for name in about_bag["relative_file_paths"]]
        if str(about_bag.get("compression_mode", "")).lower() == "file":  # unpacked by rosbags without limits
            unpack = "unpack it, or write it anew with `ros2 bag convert`, not compressed as a file"
            raise UserError("names files that are compressed whole", file=listed, hint=unpack)
    for bag_file in bag_files:
        if not bag_file.is_file():
            raise UserError(f"names {bag_file.name}, which is not there", file=listed, hint=hint)
    return bag_files


def _guess_column(message: Message, columns: dict[str, Column], file: Path) -> None:
    """Add a column for a topic that is seen for the first time and has one number."""
    if any(column.topic == message.topic for column in columns.values()):
        return
    for field in ("value",) if message.attrs.get("units") else _SINGLE_FIELDS:
        with suppress(*_NO_NUMBER):
            float(_field(message.content, field))
            break
    else:
        return
    name = message.topic.strip("/").replace("/", "_")
    unit = message.attrs.get("units") or _SINGLE_FIELDS.get(field, "")
    if not unit:
        name, unit = split_header(name, file=str(file))
    if name in columns:
        hint = "write a topic map (`thermogrip init topics`)"
        raise UserError(f"two topics would be {name}", file=file, hint=hint)
    columns[name] = Column(message.topic, field, unit, message.attrs.get("role", ""))


def _field(content: Any, path: str) -> Any:
    """Return a nested field; only data is looked at, no method is called."""
    for key in path.split("."):
        if key.lstrip("-").isdigit():
            content = content[int(key)]
        elif isinstance(content, dict):
            content = content[key]
        elif key.startswith("_"):
            raise KeyError(key)
        else:
            content = getattr(content, key)
    return content


def _message_number(message: Message, column: Column, name: str, file: Path) -> float:
    try:
        return float(_field(message.content, column.field))
    except _NO_NUMBER as error:
        problem = f"{message.topic} ({message.type}) has no number {column.field!r}"
        raise UserError(problem, file=file, column=name, hint="correct the field in the topic map") from error


def _bag_table(
    file: Path,
    columns: Mapping[str, Column],
    readings: Mapping[str, list[tuple[float, float]]],
    clock: str,
    notes: list[str],
) -> Table:
    import pandas as pd

    frames = {
        name: pd.DataFrame(rows, columns=["time", "value"]).sort_values("time", kind="stable")
        for name, rows in readings.items()
    }
    units = {name: to_record_unit(np.zeros(1), column.unit)[1] for name, column in columns.items()}
    roles = {name: column.role or guess_role(name, units[name]) for name, column in columns.items()}
    if not clock:
        outputs = [name for name in columns if roles[name] == "output"] or list(columns)
        clock = max(outputs, key=lambda name: len(frames[name]))
    axis = frames[clock][["time"]]
    rows = axis["time"].to_numpy()
    numbers: dict[str, Array] = {"time_s": rows - rows[0]}
    attrs: dict[str, dict[str, str]] = {"time_s": {}}
    for name, column in columns.items():
        messages = frames[name]
        rule: dict[str, Any] = {"direction": "backward"}  # a command holds until the next
        if roles[name] != "input":
            # the nearest message within half a usual step of its own topic; else the row has lost it
            step = messages["time"].diff().median() if len(messages) > 1 else np.inf
            rule = {"direction": "nearest", "tolerance": 0.5 * step + 1e-6}
        numbers[name] = pd.merge_asof(axis, messages, on="time", **rule)["value"].to_numpy(dtype=float)
        attrs[name] = {"units": column.unit, "role": roles[name]}
        if name != clock:
            how = "the last message holds" if roles[name] == "input" else "the nearest message is taken"
            notes.append(f"{name}: {len(messages)} messages of {column.topic} on the times of {clock}; {how}")
    return Table(str(file), numbers, {}, np.arange(1, rows.size + 1), attrs, {}, tuple(notes))


def _messages(file: Path, notes: list[str]) -> Iterator[Message]:
    bag_files = bag_parts(file) if os.path.isdir(file) else [file]
    if os.path.isdir(file) and not (file / "metadata.yaml").is_file():
        notes.append("has no metadata.yaml: its writer died; all of its files are read")
    elif all(bag_file.suffix.lower() == ".db3" for bag_file in bag_files):
        check_size(sum(check_source(bag_file) for bag_file in bag_files), file=file)
        bag_files = bag_files[:1]  # the reader of one reads all that the metadata name
    for bag_file in bag_files:
        file_notes: list[str] = []
        is_mcap = bag_file.suffix.lower() == ".mcap"
        yield from _mcap_messages(bag_file, file_notes) if is_mcap else _bag_messages(bag_file)
        notes += [f"{bag_file.name}: {line}" if bag_file != file else line for line in file_notes]


def _bag_messages(file: Path) -> Iterator[Message]:
    """Yield the messages of a .bag or .db3."""
    _need("rosbags", file)
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    bag1 = file.suffix.lower() == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if bag1 else Stores.ROS2_HUMBLE)
    # a .db3 is SQLite, which repairs itself; a .bag without its index only ROS can repair
    hint = "run `rosbag reindex` on it" if bag1 else "copy it again, or export it as MCAP"
    with reading("is damaged or no bag", file=file, hint=hint):
        check_size(check_source(file), file=file)
        # the metadata say how the messages of a .db3 are compressed, and which files continue it
        whole = not bag1 and (file.parent / "metadata.yaml").is_file() and bag_parts(file.parent)
        with AnyReader([file.parent if whole else file], default_typestore=store) as reader:
            unpack = _bound_chunks(reader, file) if bag1 else _bound_messages(reader, file)
            for connection, stamp, raw in reader.messages():
                content = reader.deserialize(unpack(raw), connection.msgtype)
                yield Message(connection.topic, connection.msgtype, 1e-9 * stamp, content, {})


def _bound_messages(reader: Any, file: Path) -> Callable[[bytes], bytes]:
    """Return what unpacks the messages of a ROS 2 bag within the limits, in place of its reader."""
    packed = [bag.storage for bag in reader.readers if bag.compression_mode == "message"]
    for storage in packed:
        storage.metadata = storage.metadata._replace(compression_mode=None)
    return partial(Unpacker(file), "zstd") if packed else lambda raw: raw


def _bound_chunks(reader: Any, file: Path) -> Callable[[bytes], bytes]:
    """Have the chunks of a ROS 1 bag unpacked within the limits; its messages are as they are."""
    from rosbags.rosbag1.reader import decompressors

    unpack = Unpacker(file)
    packings = {function: name for name, function in decompressors.items() if name != "none"}
    for bag in reader.readers:
        for offset, chunk in bag.chunks.items():
            if chunk.decompressor in packings:
                bounded = partial(unpack, packings[chunk.decompressor])
                bag.chunks[offset] = chunk._replace(decompressor=bounded)
    return lambda raw: raw


def _mcap_records(data: bytes, file: Path) -> Iterator[Any]:
    """Yield the records of an MCAP, those inside its chunks too, unpacked within the limits."""
    from mcap.exceptions import McapError
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader, breakup_chunk

    unpack = Unpacker(file)
    stream = StreamReader(io.BytesIO(data), emit_chunks=True, validate_crcs=True, record_size_limit=1 << 30)
    for record in stream.records:
        if not isinstance(record, Chunk):
            yield record
            continue
        if record.compression:
            try:
                whole = unpack(record.compression, record.data)
            except KeyError as error:
                raise McapError(f"compression {record.compression!r} is not read") from error
            record = replace(record, compression="", data=whole)
        yield from breakup_chunk(record, validate_crc=True)


def _mcap_messages(file: Path, notes: list[str]) -> Iterator[Message]:
    """Yield the messages of an MCAP up to its end, or to its first damage, which is noted."""
    _need("mcap", file)
    from mcap import records

    data, count = read_bytes(file), 0
    schemas: dict[int, Any] = {}
    channels: dict[int, Any] = {}
    decoders: dict[int, Callable[[bytes], Any]] = {}  # by channel
    try:
        for record in _mcap_records(data, file):
            if isinstance(record, records.Schema):
                schemas[record.id] = record
            elif isinstance(record, records.Channel):
                channels[record.id] = record
            elif isinstance(record, records.Message):
                channel = channels[record.channel_id]
                schema = schemas.get(channel.schema_id)
                if channel.id not in decoders:
                    decoders[channel.id] = _decoder(schema, channel, file)
                content = decoders[channel.id](record.data)
                kind = channel.message_encoding if schema is None else schema.name
                count += 1
                yield Message(channel.topic, kind, 1e-9 * record.log_time, content, channel.metadata)
    except UserError:
        raise
    except Exception as error:  # whatever damage makes a reader, unpacker or decoder stumble over
        # one whose writer died has no index and no end, and is whole up to there
        reason = str(error) or type(error).__name__
        if not count:
            hint = "copy it again; nothing could be read"
            raise UserError(f"is damaged or no MCAP ({reason})", file=file, hint=hint) from error
        notes.append(f"cut off or damaged after {count} messages ({reason}); the rest is lost")
        return
    if not data.endswith(b"\x89MCAP0\r\n"):
        notes.append(f"has no end: its writer died; {count} whole messages were read, the rest is lost")


def _decoder(schema: Any, channel: Any, file: Path) -> Callable[[bytes], Any]:
    """Return what makes numbers of a channel's bytes, by what the file says of them."""
    encoding = channel.message_encoding
    if encoding == "json":
        return json.loads
    if encoding not in ("cdr", "ros1") or schema is None:
        problem = f"{channel.topic} is encoded as {encoding!r}, which is not read"
        raise UserError(problem, file=file, hint="export it as CDR, ROS 1 or JSON")
    _need("rosbags", file)
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    kind = schema.name if "/msg/" in schema.name else schema.name.replace("/", "/msg/", 1)
    problem = f"the definition of {schema.name} cannot be read"
    with reading(problem, file=file, hint="write the file again"):
        store.register(get_types_from_msg(schema.data.decode(), kind))
    return partial(store.deserialize_cdr if encoding == "cdr" else store.deserialize_ros1, typename=kind)


def _need(package: str, file: Path) -> None:
    if find_spec(package) is None:
        raise UserError(f"needs the package {package}", file=file, hint="pip install thermogrip[ros]")
