"""Logs out of robots: ROS 1 .bag, ROS 2 .db3 and .mcap, and MCAP files of JSON, without ROS installed.

A topic map says which field of which topic is which column (as in ``data/topics.toml``): it is read from
``<name>.topics.toml`` or ``topics.toml`` beside the bag.  Without one, every topic of a single number becomes
a column: a ``sensor_msgs/Temperature`` a temperature, others what their name's suffix says.

**One axis.**  Rows are the times of one topic, the *clock* (by default the output with the most messages).
An input has the value of its last message at or before the row, for a command holds until the next.  Anything
else has its nearest message if that is within half a usual step of its own topic, and is lost otherwise:
nothing is interpolated.

**Cut-off files.**  An MCAP whose writer died has no index and no end; its messages are read up to the first
damage, and what is missing is noted.  A .bag without its index must be reindexed by ROS (``rosbag reindex``),
a .db3 is SQLite, which repairs itself.  A folder without ``metadata.yaml``, which the writer makes last, is
all of its ``.mcap`` and ``.db3`` files.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from operator import itemgetter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.atomic_files import read_bytes, read_toml
from thermogrip.datasets.errors import UserError, known_names, os_fault, os_faults, reading
from thermogrip.datasets.file_names import file_stem
from thermogrip.datasets.limits import Unpacker, check_size, check_source
from thermogrip.datasets.roles import guess_role
from thermogrip.datasets.schema import ROLES
from thermogrip.datasets.tables import Table
from thermogrip.datasets.units import UNITS, split_header, to_record_unit

Floats = NDArray[np.float64]

_UNPACK = "unpack it, or write it anew with `ros2 bag convert`, not compressed as a file"
_STORED = (".mcap", ".db3")  # what a ROS 2 bag is made of
_NO_NUMBER = (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError)
_SINGLE_FIELDS = {"temperature": "degC", "data": ""}  # the one field of a message without a map, and its unit


@dataclass(frozen=True)
class Column:
    """Where a column comes from: topic, field (dots and indices), unit, role ("" to guess), and the type of
    its messages, which a bag says itself and a node does not."""

    topic: str
    field: str
    unit: str
    role: str = ""
    type: str = ""


@dataclass(frozen=True)
class TopicMap:
    """Columns by name, which of them is the clock ("" to choose), and which time counts."""

    columns: Mapping[str, Column]
    clock: str = ""
    stamp: str = "log"


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
    clock, stamp = str(content.get("clock", "")), str(content.get("stamp", "log"))
    if clock and clock not in columns:
        raise UserError(f"clock {clock!r} is no column", file=path, hint=known_names(clock, columns))
    if stamp not in ("log", "header"):
        raise UserError(f"stamp {stamp!r} is unknown", file=path, hint="use log or header")
    return TopicMap(columns, clock, stamp)


def _column(name: str, entry: Any, path: str | Path) -> Column:
    keys = {"topic", "field", "unit", "role", "type"}
    if not isinstance(entry, dict) or set(entry) - keys or "topic" not in entry:
        raise UserError("needs topic, field, unit, role", file=path, column=name, hint="name its topic")
    unit, role = str(entry.get("unit", "1")), str(entry.get("role", ""))
    if unit not in (*UNITS, "1"):
        problem = f"unit {unit!r} is unknown"
        raise UserError(problem, file=path, column=name, hint=f"use {' '.join(UNITS)} or 1")
    if role not in (*ROLES, ""):
        raise UserError(f"role {role!r} is unknown", file=path, column=name, hint=known_names(role, ROLES))
    field, kind = str(entry.get("field", "data")), str(entry.get("type", ""))
    return Column(str(entry["topic"]), field, unit, role, kind)


def read_rosbag_table(path: str | Path, topics: TopicMap | None = None) -> Table:
    """Return the columns of a bag on one time axis, by this map, the TOML file beside the bag, or guessed."""
    file = Path(path)
    wanted = _map_beside(file) if topics is None else topics
    notes: list[str] = []
    series: dict[str, tuple[list[float], list[float]]] = {}
    columns: dict[str, Column] = {} if wanted is None else dict(wanted.columns)
    stamp = "log" if wanted is None else wanted.stamp
    type_of_topic: dict[str, str] = {}
    for message in _messages(file, notes):
        type_of_topic[message.topic] = message.type
        if wanted is None:
            _guess_column(message, columns, file)
        for name, column in columns.items():
            if column.topic == message.topic:
                times, values = series.setdefault(name, ([], []))
                times.append(_stamped(message, stamp, file))
                values.append(_message_number(message, column, name, file))
    _check_found(columns, series, type_of_topic, file)
    return _bag_table(file, columns, series, "" if wanted is None else wanted.clock, notes)


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
    """Return the files of the ROS 2 bag that a folder is; UserError where it is none, or its
    ``metadata.yaml`` names no file, or one that is missing or not read."""
    place = Path(folder)
    listed = place / "metadata.yaml"
    if not listed.is_file():
        if stored := sorted(path for path in place.iterdir() if path.suffix.lower() in _STORED):
            return stored
        raise UserError("is a folder, and no ROS 2 bag", file=place, hint="name a file in it")
    names = _files_in_metadata(listed)
    hint = "copy the whole bag again"
    if not names:
        raise UserError("names no file of a bag", file=listed, hint=hint)
    for name in names:
        if Path(name).suffix.lower() not in _STORED:
            raise UserError(f"names {name}, which is not read", file=listed, hint=_UNPACK)
        if not (place / name).is_file():
            raise UserError(f"names {name}, which is not there", file=listed, hint=hint)
    return [place / name for name in names]


def _files_in_metadata(path: Path) -> list[str]:
    """Return the files that the metadata of a bag name, without their folders."""
    _need("rosbags", path)
    from ruamel.yaml import YAML

    data = read_bytes(path)
    check_size(len(data), file=path, share=64)
    with reading("is no metadata of a ROS 2 bag", file=path, hint="copy the bag again"):
        about_bag = YAML(typ="safe").load(data)["rosbag2_bagfile_information"]
        names = [Path(str(name)).name for name in about_bag["relative_file_paths"]]
        packed_whole = str(about_bag.get("compression_mode", "")).lower() == "file"
    if packed_whole:
        problem = f"names {names[0] if names else 'files'}, which is compressed whole"
        raise UserError(problem, file=path, hint=_UNPACK)
    return names


def _map_beside(file: Path) -> TopicMap | None:
    inside = (file / f"{file.name}.topics.toml", file / "topics.toml") if os.path.isdir(file) else ()
    for path in (*inside, file.parent / f"{file_stem(file)}.topics.toml", file.parent / "topics.toml"):
        if path.is_file():
            return read_topic_map(path)
    return None


def _guess_column(message: Message, columns: dict[str, Column], file: Path) -> None:
    """Add a column for a topic that is seen for the first time and has one number."""
    if any(column.topic == message.topic for column in columns.values()):
        return
    number_field = next((f for f in _SINGLE_FIELDS if _has(message.content, f)), "")
    field = "value" if message.attrs.get("units") else number_field
    try:
        float(_field(message.content, field))
    except _NO_NUMBER:
        return
    name = message.topic.strip("/").replace("/", "_")
    unit = message.attrs.get("units") or _SINGLE_FIELDS.get(field, "")
    if not unit:
        name, unit = split_header(name, file=str(file))
    if name in columns:
        hint = "write a topic map (`thermogrip init topics`)"
        raise UserError(f"two topics would be {name}", file=file, hint=hint)
    columns[name] = Column(message.topic, field, unit, message.attrs.get("role", ""))


def _has(content: Any, field: str) -> bool:
    return field in content if isinstance(content, dict) else hasattr(content, field)


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


def _stamped(message: Message, stamp: str, file: Path) -> float:
    if stamp == "log":
        return message.time
    try:
        of_header = _field(message.content, "header.stamp")
        fields = ("sec", "nanosec") if _has(of_header, "sec") else ("secs", "nsecs")  # ROS 2, ROS 1
        return float(_field(of_header, fields[0])) + 1e-9 * float(_field(of_header, fields[1]))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        problem = f"{message.topic} ({message.type}) has no header.stamp"
        raise UserError(problem, file=file, hint='set stamp = "log" in the topic map') from error


def _check_found(
    columns: Mapping[str, Column], series: Mapping[str, Any], seen: Mapping[str, str], file: Path
) -> None:
    have = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(seen.items())) or "none"
    for name, column in columns.items():
        if name not in series:
            hint = f"it has {have}"
            raise UserError(f"topic {column.topic} has no message", file=file, column=name, hint=hint)
    if not columns:
        problem = f"has no topic with a single number (topics: {have})"
        raise UserError(problem, file=file, hint="write a topic map (`thermogrip init topics`)")


def _bag_table(
    file: Path,
    columns: Mapping[str, Column],
    series: Mapping[str, tuple[list[float], list[float]]],
    clock: str,
    notes: list[str],
) -> Table:
    in_time = itemgetter(0)
    sorted_series = {name: np.asarray(sorted(zip(*pair), key=in_time)).T for name, pair in series.items()}
    units = {name: to_record_unit(v, columns[name].unit)[1] for name, (_, v) in sorted_series.items()}
    roles = {name: column.role or guess_role(name, units[name]) for name, column in columns.items()}
    if not clock:
        outputs = [name for name in columns if roles[name] == "output"] or list(columns)
        clock = max(outputs, key=lambda name: len(sorted_series[name][0]))
    axis = sorted_series[clock][0]
    numbers: dict[str, Floats] = {"time_s": axis - axis[0]}
    attrs: dict[str, dict[str, str]] = {"time_s": {}}
    for name, column in columns.items():
        times, values = sorted_series[name]
        is_input = roles[name] == "input"
        numbers[name] = (_held if is_input else _nearest)(axis, times, values)
        attrs[name] = {"units": column.unit, "role": roles[name]}
        if name != clock:
            how = "the last message holds" if is_input else "the nearest message is taken"
            notes.append(f"{name}: {len(times)} messages of {column.topic} on the times of {clock}; {how}")
    return Table(str(file), numbers, {}, np.arange(1, axis.size + 1), attrs, {}, tuple(notes))


def _held(axis: Floats, times: Floats, values: Floats) -> Floats:
    row = np.searchsorted(times, axis, "right") - 1
    return np.where(row >= 0, values[np.maximum(row, 0)], np.nan)


def _nearest(axis: Floats, times: Floats, values: Floats) -> Floats:
    after = np.clip(np.searchsorted(times, axis), 0, times.size - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(times[after] - axis) <= np.abs(axis - times[before]), after, before)
    step = float(np.median(np.diff(times))) if times.size > 1 else np.inf
    return np.where(np.abs(times[nearest] - axis) <= 0.5 * step + 1e-6, values[nearest], np.nan)


def _messages(file: Path, notes: list[str]) -> Iterator[Message]:
    if not file.exists():
        raise os_fault(FileNotFoundError(2, "missing"), file)
    if not os.path.isdir(file):
        yield from _messages_of_file(file, notes)
        return
    bag_files = bag_parts(file)
    if not (file / "metadata.yaml").is_file():
        notes.append("has no metadata.yaml: its writer died; all of its files are read")
    elif all(bag_file.suffix.lower() == ".db3" for bag_file in bag_files):
        check_size(sum(check_source(bag_file) for bag_file in bag_files), file=file)
        bag_files = bag_files[:1]  # the reader of one reads all that the metadata name
    for bag_file in bag_files:
        part_notes: list[str] = []
        yield from _messages_of_file(bag_file, part_notes)
        notes += [f"{bag_file.name}: {line}" for line in part_notes]


def _messages_of_file(file: Path, notes: list[str]) -> Iterator[Message]:
    return _mcap_messages(file, notes) if file.suffix.lower() == ".mcap" else _bag_messages(file)


def _bag_messages(file: Path) -> Iterator[Message]:
    """Yield the messages of a .bag or .db3."""
    _need("rosbags", file)
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    bag1 = file.suffix.lower() == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if bag1 else Stores.ROS2_HUMBLE)
    hint = "run `rosbag reindex` on it" if bag1 else "copy it again, or export it as MCAP"
    with reading("is damaged or no bag", file=file, hint=hint):
        check_size(check_source(file), file=file)
        whole = not bag1 and (file.parent / "metadata.yaml").is_file()  # a .db3 belongs to its folder
        with AnyReader(
            [file.parent if whole and bag_parts(file.parent) else file], default_typestore=store
        ) as reader:
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
        unpack.declare(record.uncompressed_size)
        if record.compression:
            try:
                whole = unpack(record.compression, record.data)
            except KeyError as error:
                raise McapError(f"compression {record.compression!r} is not read") from error
            record = replace(record, compression="", data=whole)
        yield from breakup_chunk(record, validate_crc=True)


def _mcap_contents(data: bytes, file: Path) -> Iterator[tuple[Any, Any, Any]]:
    """Yield (schema or None, channel, message) in the order of the file."""
    from mcap.reader import NonSeekingReader

    reader: Any = NonSeekingReader(io.BytesIO())
    reader._stream_reader = SimpleNamespace(
        records=_mcap_records(data, file)
    )  # its own unpacks without limits
    yield from reader.iter_messages(log_time_order=False)


def _mcap_messages(file: Path, notes: list[str]) -> Iterator[Message]:
    """Yield the messages of an MCAP up to its end, or to its first damage, which is noted."""
    _need("mcap", file)
    data, count = read_bytes(file), 0
    last = 0.0
    decoders = _Decoders(file)
    try:
        for schema, channel, message in _mcap_contents(data, file):
            content = decoders.decode(schema, channel, message.data)
            count, last = count + 1, 1e-9 * message.log_time
            kind = schema.name if schema is not None else channel.message_encoding
            yield Message(channel.topic, kind, last, content, channel.metadata)
    except UserError:
        raise
    except Exception as error:  # whatever damage makes a reader, unpacker or decoder stumble over
        reason = str(error) or type(error).__name__
        if not count:
            hint = "copy it again; nothing could be read"
            raise UserError(f"is damaged or no MCAP ({reason})", file=file, hint=hint) from error
        notes.append(f"cut off or damaged after {count} messages ({reason}); the rest is lost")
        return
    if not data.endswith(b"\x89MCAP0\r\n"):
        notes.append(f"has no end: its writer died; {count} whole messages were read, the rest is lost")


class _Decoders:
    """From bytes to numbers, by what the file says of its messages."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._store: Any = None
        self._known: dict[str, str] = {}

    def decode(self, schema: Any, channel: Any, data: bytes) -> Any:
        if channel.message_encoding == "json":
            return json.loads(data)
        if channel.message_encoding in ("cdr", "ros1") and schema is not None:
            kind = self._type(schema)
            if channel.message_encoding == "cdr":
                return self._store.deserialize_cdr(data, kind)
            return self._store.deserialize_ros1(data, kind)
        hint = "export it as CDR, ROS 1 or JSON"
        problem = f"{channel.topic} is encoded as {channel.message_encoding!r}, which is not read"
        raise UserError(problem, file=self._file, hint=hint)

    def _type(self, schema: Any) -> str:
        """Return the message's type, registered from the definition in the file."""
        _need("rosbags", self._file)
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        if self._store is None:
            self._store = get_typestore(Stores.EMPTY)
        if schema.name not in self._known:
            name = schema.name if "/msg/" in schema.name else schema.name.replace("/", "/msg/", 1)
            problem = f"the definition of {schema.name} cannot be read"
            with reading(problem, file=self._file, hint="write the file again"):
                definitions = get_types_from_msg(schema.data.decode(), name)
                self._store.register({k: v for k, v in definitions.items() if k not in self._store.fielddefs})
            self._known[schema.name] = name
        return self._known[schema.name]


def _need(package: str, file: Path) -> None:
    if find_spec(package) is None:
        raise UserError(f"needs the package {package}", file=file, hint="pip install thermogrip[ros]")
