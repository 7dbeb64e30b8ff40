"""Bags of robots become logs: the same numbers from ROS 1, ROS 2 (db3, mcap) and JSON, whole or cut off."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags")
pytest.importorskip("mcap")

from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from thermogrip.datasets import rosbag
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.log_files import read_log, write_log
from thermogrip.datasets.rosbag import Column, Message, TopicMap, read_rosbag_table, read_topic_map
from thermogrip.datasets.schema import names

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
MAP = """
schema = "thermogrip.topics"
version = 1
[columns.t_tank]
topic = "/tank"
field = "temperature"
unit = "degC"
[columns.t_surface]
topic = "/skin"
field = "temperature"
unit = "K"
[columns.drive]
topic = "/cmd"
field = "data"
unit = "1"
role = "input"
"""


def messages() -> list[tuple[str, str, int, float]]:
    """Return (topic, type, time, number): tank at 2 Hz, skin at 2 Hz 20 ms later, a drive at 1 Hz."""
    out = []
    for k in range(60):
        at = START + k * SECOND // 2
        out.append(("/tank", "sensor_msgs/msg/Temperature", at, 25.0 + 0.1 * k))
        out.append(("/skin", "sensor_msgs/msg/Temperature", at + SECOND // 50, 298.15 + 0.05 * k))
        if k % 2 == 0:
            out.append(("/cmd", "std_msgs/msg/Float64", at - SECOND // 10, float(np.sin(k))))
    return out


def make(store: Any, kind: str, at: int, number: float, ros1: bool) -> Any:
    if kind.endswith("Float64"):
        return store.types[kind](data=number)
    stamp = store.types["builtin_interfaces/msg/Time"](sec=at // SECOND, nanosec=at % SECOND)
    extra = {"seq": 0} if ros1 else {}
    header = store.types["std_msgs/msg/Header"](stamp=stamp, frame_id="", **extra)
    return store.types[kind](header=header, temperature=number, variance=0.0)


def write_bag(path: Path, kind: str, *, packed: CompressionMode | None = None) -> Path:
    ros1 = kind == "bag"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    if ros1:
        writer: Any = Writer1(path / "run.bag")
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path / "run", version=9, storage_plugin=plugin)
    if packed is not None:
        writer.set_compression(packed, CompressionFormat.ZSTD)
    connections: dict[str, Any] = {}
    with writer:
        for topic, message_type, at, number in messages():
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message_type, typestore=store)
            message = make(store, message_type, at, number, ros1)
            encode = store.serialize_ros1 if ros1 else store.serialize_cdr
            writer.write(connections[topic], at, encode(message, message_type))
    return path / "run.bag" if ros1 else path / "run" / f"run.{kind}"


@pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
def test_the_three_kinds_of_bag_hold_the_same_log(tmp_path: Path, kind: str) -> None:
    file = write_bag(tmp_path, kind)
    (file.parent / "run.topics.toml").write_text(MAP)
    log = read_log(file)
    k = np.arange(60)
    assert names(log, "input") == ("drive",)
    assert names(log, "output") == ("t_tank", "t_surface")
    np.testing.assert_allclose(log["time"].values, 0.5 * k, atol=1e-6)
    np.testing.assert_allclose(log["t_tank"].values, 25.0 + 0.1 * k)
    np.testing.assert_allclose(log["t_surface"].values, 25.0 + 0.05 * k, atol=1e-9)  # kelvin became degC
    np.testing.assert_allclose(log["drive"].values, np.sin(2 * (k // 2)))  # each command holds until the next


def test_messages_that_are_compressed_one_by_one_are_unpacked_within_the_limits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = write_bag(tmp_path, "db3", packed=CompressionMode.MESSAGE)
    (file.parent / "topics.toml").write_text(MAP)
    for path in (file, file.parent):
        np.testing.assert_allclose(read_log(path)["t_tank"].values, 25.0 + 0.1 * np.arange(60))
    monkeypatch.setattr("thermogrip.datasets.limits.most_unpacked", lambda packed: 1000)
    with pytest.raises(UserError, match="unpacks to 1 kB"):
        read_log(file)


def test_a_bag_that_is_compressed_as_a_file_is_refused(tmp_path: Path) -> None:
    file = write_bag(tmp_path, "db3", packed=CompressionMode.FILE)
    listed = file.parent / "metadata.yaml"
    listed.write_text(listed.read_text().replace("run.db3.zstd", "run.db3"))
    (file.parent / "run.db3.zstd").rename(file)
    with pytest.raises(UserError, match="names files that are compressed whole"):
        read_log(file)


@pytest.mark.parametrize("kind", ["db3", "mcap"])
@pytest.mark.parametrize(
    "place", ["run/topics.toml", "run/run.topics.toml", "run.topics.toml", "topics.toml"]
)
def test_the_folder_of_a_ros_2_bag_is_its_file(tmp_path: Path, kind: str, place: str) -> None:
    file = write_bag(tmp_path, kind)
    (tmp_path / place).write_text(MAP)
    log = read_log(file.parent)
    assert log.attrs["name"] == "run"
    assert names(log, "input") == ("drive",)
    np.testing.assert_allclose(log["t_tank"].values, 25.0 + 0.1 * np.arange(60))
    assert read_log(f"{file.parent}@5:10").sizes["time"] == 10


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_a_bag_in_several_files_is_one_log_of_those_that_its_metadata_name(tmp_path: Path, kind: str) -> None:
    # ros2 bag splits at a size: a second bag, 100 s later, becomes the second file of the first
    global START
    file, first = write_bag(tmp_path, kind), START
    try:
        START += 100 * SECOND
        (tmp_path / "later").mkdir()
        later = write_bag(tmp_path / "later", kind)
    finally:
        START = first
    shutil.copy(later, file.parent / f"run_10.{kind}")
    shutil.copy(later, file.parent / f"of_another_day.{kind}")
    listed = file.parent / "metadata.yaml"
    listed.write_text(listed.read_text().replace(f"- run.{kind}\n", f"- run.{kind}\n  - run_10.{kind}\n", 1))
    log = read_log(file.parent)
    assert log.sizes["time"] == 120
    np.testing.assert_allclose(log["time"].values[[0, 59, 60, 119]], [0.0, 29.5, 100.0, 129.5])


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_a_folder_whose_writer_died_before_its_metadata_is_read_and_reported(
    tmp_path: Path, kind: str
) -> None:
    file = write_bag(tmp_path, kind)
    (file.parent / "metadata.yaml").unlink()
    log = read_log(file.parent)
    np.testing.assert_allclose(log["tank"].values, 25.0 + 0.1 * np.arange(60))
    assert "no metadata.yaml: its writer died" in log.attrs["repairs"]


@pytest.mark.parametrize(
    ("metadata", "said"),
    [
        ("[1, 2", "is no metadata of a ROS 2 bag"),
        ("rosbag2_bagfile_information: 3", "is no metadata of a ROS 2 bag"),
        ("rosbag2_bagfile_information: {relative_file_paths: []}", "has no topic with a single number"),
        (
            "rosbag2_bagfile_information: {relative_file_paths: [../gone.mcap]}",
            "gone.mcap, which is not there",
        ),
        ("!!python/object/apply:os.system ['true']", "is no metadata of a ROS 2 bag"),
        (None, "is a folder, and no ROS 2 bag"),
    ],
)
def test_a_folder_that_is_no_bag_is_refused_in_one_line(
    tmp_path: Path, metadata: str | None, said: str
) -> None:
    if metadata is not None:
        (tmp_path / "metadata.yaml").write_text(metadata)
    with pytest.raises(UserError, match=said):
        read_log(tmp_path)


def test_without_a_map_every_topic_with_one_number_is_a_column(tmp_path: Path) -> None:
    log = read_log(write_bag(tmp_path, "bag"))
    assert set(log.data_vars) == {"tank", "skin", "cmd"}
    assert log["tank"].attrs["units"] == "degC"
    assert names(log, "input") == ("cmd",)


def test_a_cut_off_mcap_gives_what_is_whole_and_reports_it(tmp_path: Path) -> None:
    from mcap.writer import Writer

    file = tmp_path / "cut.mcap"
    with file.open("wb") as stream:
        writer = Writer(stream, chunk_size=1024)
        writer.start()
        schema = writer.register_schema("t", "jsonschema", b"{}")
        meta = {"units": "degC", "role": "output"}
        channel = writer.register_channel("/t_tank", "json", schema, metadata=meta)
        for k in range(400):
            data = json.dumps({"value": 20.0 + 0.01 * k}).encode()
            writer.add_message(channel, START + k * SECOND, data, START + k * SECOND)
        writer.finish()
    whole = file.read_bytes()
    file.write_bytes(whole)
    assert "lost" not in read_log(file).attrs["repairs"]
    for share in (0.3, 0.55, 0.8):
        file.write_bytes(whole[: int(share * len(whole))])
        log = read_log(file)
        n = log.sizes["time"]
        assert 0.2 * 400 * share < n < 400
        assert re.search(rf"damaged after {n} messages|{n} whole messages were read", log.attrs["repairs"])
        np.testing.assert_allclose(log["t_tank"].values, 20.0 + 0.01 * np.arange(n))
        assert "the rest is lost" in log.attrs["repairs"] + str(log.attrs)


def test_a_damaged_chunk_is_never_read_as_numbers(tmp_path: Path) -> None:
    file = write_bag(tmp_path, "mcap")
    whole = bytearray(file.read_bytes())
    at = whole.find(b"/tank", len(whole) // 3)
    whole[at if at > 0 else len(whole) // 2] ^= 0xFF
    file.write_bytes(bytes(whole))
    try:
        log = read_log(file)
    except UserError:  # refused is as good as left out
        return
    n = log.sizes["time"]
    np.testing.assert_allclose(log["tank"].values, (25.0 + 0.1 * np.arange(60))[:n])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (('topic = "/skin"', 'topic = "/nose"'), "topic /nose has no message; it has /cmd"),
        (('field = "data"', 'field = "date"'), "has no number 'date'"),
        (('field = "data"', 'field = "__class__"'), "has no number '__class__'"),
        (('unit = "K"', 'unit = "Kelvin"'), "unit 'Kelvin' is unknown"),
        (("thermogrip.topics", "thermogrip.topic"), "is no topic map"),
        (('role = "input"', 'role = "in"'), "role 'in' is unknown"),
        (("version = 1", 'version = 1\nclock = "t3"'), "clock 't3' is no column; use t_tank"),
        (("version = 1", 'version = 1\nclocks = "t3"'), "has the unknown key 'clocks'; write a fresh one"),
        (("version = 1", 'version = 1\nstamp = "header"'), "stamp 'header' is not read; remove the line"),
        (('topic = "/cmd"', ""), "column drive: needs topic, field, unit, role; name its topic"),
        (('role = "input"', 'rôle = "input"'.replace("ô", "u")), "column drive: needs topic, field"),
        ((MAP[MAP.index("[columns.t_tank]") :], "[columns]\nx = 1"), "column x: needs topic, field"),
        ((MAP[MAP.index("[columns.t_tank]") :], "columns = 1"), "is no topic map"),
    ],
)
def test_a_wrong_map_is_one_line_that_says_what_repairs_it(
    tmp_path: Path, change: tuple[str, str], said: str
) -> None:
    file = write_bag(tmp_path, "bag")
    (tmp_path / "topics.toml").write_text(MAP.replace(*change))
    with pytest.raises(UserError) as caught:
        read_log(file)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def said(topic: str, at: float, content: Any, **attrs: str) -> Message:
    return Message(topic, "pkg/Kind", at, content, attrs)


SAID = [
    said("/skin_K", 11.5, {"data": 301.0}), said("/skin_K", 10.5, {"data": 300.0}),  # not in order
    *(said("/a/tank/", 10.0 + k, SimpleNamespace(temperature=25 + k / 4)) for k in range(4)),
    said("/pump", 9.0, {"data": True}), said("/pump", 11.5, {"data": False}), said("/pump", 9.5, {"data": 3}),
    said("/pump", 12.0, {"data": 2}), said("/pump", 14.0, {"data": 7}),
    said("/u", 12.9, {"value": [1], "data": 9.0}), said("/u", 10.8, {"data": 8}),
    said("/u_2", 13.0, {"value": 4.5}, units="V", role="other"),
    said("/word", 1.0, {"data": "none"}), said("/odd", 2.0, {"other": 1.0}),
]  # fmt: skip


def table_of(monkeypatch: Any, messages: list[Message], topics: TopicMap | None = None) -> Any:
    monkeypatch.setattr(rosbag, "_messages", lambda _file, _notes: iter(messages))
    return read_rosbag_table("run.mcap", topics)


def test_topics_of_a_number_stand_on_the_times_of_the_output_with_most_messages(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    table, nan = table_of(monkeypatch, SAID), np.nan
    wanted = {
        "time_s": [0.0, 1.0, 2.0, 3.0], "skin": [300.0, 300.0, 301.0, nan],
        "a_tank": [25.0, 25.25, 25.5, 25.75], "pump": [3.0, 3.0, 2.0, 2.0],
        "u": [nan, 8.0, 8.0, 9.0], "u_2": [4.5] * 4,
    }  # fmt: skip
    assert list(table.numbers) == list(wanted)
    for name, values in wanted.items():
        np.testing.assert_array_equal(table.numbers[name], values, err_msg=name)
    about = {name: tuple(of.values()) for name, of in table.attrs.items()}
    assert about == {"time_s": (), "skin": ("K", "output"), "a_tank": ("degC", "output"),
                     "pump": ("1", "input"), "u": ("1", "input"), "u_2": ("V", "other")}  # fmt: skip
    assert table.lines.tolist() == [1, 2, 3, 4]
    held, near = "the last message holds", "the nearest message is taken"
    of = {"skin": ("2 messages of /skin_K", near), "pump": ("5 messages of /pump", held),
          "u": ("2 messages of /u", held), "u_2": ("1 messages of /u_2", near)}  # fmt: skip
    assert table.notes == tuple(f"{n}: {had} on the times of a_tank; {how}" for n, (had, how) in of.items())


def test_a_map_names_the_clock_or_the_topic_with_most_messages_is_it(monkeypatch: pytest.MonkeyPatch) -> None:
    columns = {"p": Column("/pump", "data", "1", "input"), "v": Column("/u", "data", "1", "input")}
    found = table_of(monkeypatch, SAID, TopicMap(columns)).numbers
    assert found["time_s"].tolist() == [0.0, 0.5, 2.5, 3.0, 5.0]
    assert found["p"].tolist() == [1.0, 3.0, 0.0, 2.0, 7.0]
    found = table_of(monkeypatch, SAID, TopicMap(columns, clock="v")).numbers
    np.testing.assert_allclose(found["time_s"], [0.0, 2.1])
    assert (found["p"].tolist(), found["v"].tolist()) == ([3.0, 2.0], [8.0, 9.0])


@pytest.mark.parametrize(
    ("messages", "words"),
    [
        ([said("/a/b", 1.0, {"data": 1}), said("/a_b", 1.0, {"data": 1})],
         "run.mcap: two topics would be a_b; write a topic map (`thermogrip init topics`)"),
        ([said("/odd", 2.0, {"other": 1.0}), said("/a", 2.0, {})],
         "has no topic with a single number (topics: /a (pkg/Kind), /odd (pkg/Kind)); write a topic map"),
        ([], "has no topic with a single number (topics: none)"),
        ([said("/a", 1.0, {"data": 1}), said("/a", 2.0, {"data": "x"})],
         "column a: /a (pkg/Kind) has no number 'data'; correct the field in the topic map"),
    ],
)  # fmt: skip
def test_topics_that_make_no_table_are_one_line(
    monkeypatch: pytest.MonkeyPatch, messages: list[Message], words: str
) -> None:
    with pytest.raises(UserError, match=re.escape(words)):
        table_of(monkeypatch, messages)


def test_the_template_is_a_topic_map(tmp_path: Path) -> None:
    found = read_topic_map(Path(rosbag.__file__).with_name("data") / "topics.toml")
    assert set(found.columns) == {"t_surface", "t_tank", "drive", "pump"}
    assert found.clock == "t_surface"
    assert found.columns["drive"] == Column("/peltier/command", "data", "1", "input")
    (tmp_path / "topics.toml").write_text('schema = "thermogrip.topics"\n[columns.a]\ntopic = "/b"\n')
    assert read_topic_map(tmp_path / "topics.toml") == TopicMap({"a": Column("/b", "data", "1")})


@pytest.mark.parametrize("name", ["run.bag", "run.db3", "run.mcap"])
def test_what_is_no_bag_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"this is no bag at all" * 10)
    with pytest.raises(UserError, match=name):
        read_log(tmp_path / name)
    with pytest.raises(UserError, match=r"absent|no such file"):
        read_log(tmp_path / f"absent-{name}")


def test_a_truncated_ros1_bag_says_reindex(tmp_path: Path) -> None:
    file = write_bag(tmp_path, "bag")
    file.write_bytes(file.read_bytes()[:-400])
    with pytest.raises(UserError, match="reindex"):
        read_log(file)


def test_logs_are_not_written_as_bags(tmp_path: Path) -> None:
    log = read_log(write_bag(tmp_path, "bag"))
    with pytest.raises(UserError, match=r"not written with the ending \.bag; write .csv, .nc or .parquet"):
        write_log(log, tmp_path / "out.bag")


def test_a_channel_without_a_schema_is_named_by_its_encoding(tmp_path):
    writer_of = pytest.importorskip("mcap.writer").Writer
    file = tmp_path / "bare.mcap"
    with file.open("wb") as stream:
        writer = writer_of(stream)
        writer.start()
        schema = writer.register_schema("pkg/Word", "jsonschema", b"{}")
        for name, its in (("/bare", 0), ("/typed", schema)):
            channel = writer.register_channel(name, "json", its)
            writer.add_message(channel, 0, b'{"a": "x"}', 0)
        writer.finish()
    with pytest.raises(UserError, match=r"topics: /bare \(json\), /typed \(pkg/Word\)"):
        read_log(file)
