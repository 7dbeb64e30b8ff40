"""The session in Foxglove: its channels over a websocket, and a layout that names them."""

from __future__ import annotations

import json
import re
import socket
import struct
from pathlib import Path

from websockets.sync.client import connect
from websockets.typing import Subprotocol

from tests.live.conftest import Running, paced_twin
from thermogrip.live.watch import Show, Watch
from thermogrip.report.console import Console


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def test_a_viewer_gets_the_channels_of_the_run_and_the_layout_names_them(tmp_path: Path) -> None:
    port, layout = free_port(), tmp_path / "layout.json"
    with Watch("run", Console(), Show(foxglove=port, layout=layout)) as watch:
        assert watch.address == ""  # no page was asked for
        running = Running(watch, paced_twin(), hold=300.0)
        link = connect(f"ws://127.0.0.1:{port}", subprotocols=[Subprotocol("foxglove.sdk.v1")])
        with link:
            topics: dict[str, int] = {}
            while not {"/t_surface", "/drive"} <= topics.keys():  # the last one, too
                said = link.recv(timeout=20)
                if isinstance(said, str) and json.loads(said)["op"] == "advertise":
                    topics |= {c["topic"]: c["id"] for c in json.loads(said)["channels"]}
            wanted = [{"id": 7, "channelId": topics["/t_surface"]}]
            link.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
            while not isinstance(said := link.recv(timeout=20), bytes) or said[0] != 1:
                pass
        kind, subscription, stamp = struct.unpack("<BIQ", said[:13])
        content = json.loads(said[13:])
        assert (kind, subscription) == (1, 7)
        assert set(content) == {"time_s", "value"}
        assert 20.0 < content["value"] < 35.0
        assert stamp > 1.7e18  # a date
        watch.operator.stop("the test")
        running.result()
    named = set(re.findall(r'"(/[a-z_]+)(?:\.value)?"', layout.read_text()))
    assert named == set(topics)
    content = json.loads(layout.read_text())  # as the application exports it
    assert {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"} == set(content)
    split, panels = content["layout"], [content["layout"]["first"]]
    panels += [split["second"]["first"], split["second"]["second"]]
    assert panels == list(content["configById"])
    assert [panel.partition("!")[0] for panel in panels] == ["Plot", "Plot", "RawMessages"]
