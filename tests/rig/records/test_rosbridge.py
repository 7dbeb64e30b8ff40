"""The bridge against a minimal rosbridge server: what is published, comes in, and is lost."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from itertools import pairwise
from typing import Any

import pytest

from tests.rig.makers import PATIENCE_S, SteppedClock
from thermogrip.datasets.errors import UserError
from thermogrip.rig.interface import Event
from thermogrip.rig.records.rosbridge import Bridge, Messages
from thermogrip.rig.session.session import run_session
from thermogrip.rig.simulation.twin import Twin
from thermogrip.sysid.plant.plant import Plant

pytest.importorskip("websockets")
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import serve


class Server:
    """As much of rosbridge as is needed: it keeps what is published and can publish itself."""

    def __init__(self, port: int = 0) -> None:
        self.heard: list[dict[str, Any]] = []
        self.sockets: list[Any] = []
        self.server = serve(self.talk, "127.0.0.1", port)
        self.port = self.server.socket.getsockname()[1]
        self.url = f"ws://127.0.0.1:{self.port}"
        self.thread = threading.Thread(target=self.server.serve_forever, daemon=True)
        self.thread.start()

    def talk(self, socket: Any) -> None:
        self.sockets.append(socket)
        with suppress(ConnectionClosed):
            for text in socket:
                self.heard.append(json.loads(text))

    def reported(self, name: str) -> list[str]:
        """Return what was published as text on a topic."""
        topic = f"/thermogrip/{name}"
        return [m["msg"]["data"] for m in self.heard if m["op"] == "publish" and m["topic"] == topic]

    def reported_numbers(self, name: str) -> list[float]:
        """Return what was published as a number on a topic."""
        return [float(value) for value in self.reported(name)]

    def publish(self, topic: str, content: Any) -> None:
        self.sockets[-1].send(json.dumps({"op": "publish", "topic": topic, "msg": content}))

    def close(self) -> None:
        self.server.shutdown()
        self.thread.join(PATIENCE_S)
        for socket in self.sockets:
            socket.close()


def wait_for(check: Callable[[], Any]) -> bool:
    """Let the other threads go on until something is so."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        if check():
            return True
        time.sleep(0.005)
    return False


@pytest.fixture
def server() -> Iterator[Server]:
    made = Server()
    yield made
    made.close()


def test_a_session_is_published_row_by_row(server: Server, plant: Plant, controller: Any) -> None:
    with Bridge(server.url, clock=lambda: 1.7e9) as bridge:
        session = run_session(Twin(plant, seed=1), controller, 30.0, recorder=bridge, settle_timeout=20.0)
        server.publish("/thermogrip/target", {"data": 38.5})  # nothing is accepted
        assert wait_for(lambda: server.reported("event")[-1:] and "verdict" in server.reported("event")[-1])
    topics = {m["topic"]: m["type"] for m in server.heard if m["op"] == "advertise"}
    assert topics["/thermogrip/t_surface"] == "sensor_msgs/Temperature"
    assert topics["/thermogrip/drive"] == "std_msgs/Float64"
    assert "subscribe" not in {m["op"] for m in server.heard}
    skin = [m["msg"]["temperature"] for m in server.heard
            if m["op"] == "publish" and m["topic"] == "/thermogrip/t_surface"]  # fmt: skip
    assert skin == session.log["t_surface"].values.tolist()
    events = [json.loads(m["msg"]["data"]) for m in server.heard
              if m["op"] == "publish" and m["topic"] == "/thermogrip/event"]  # fmt: skip
    assert [e["kind"] for e in events] == [e.kind for e in session.events]


def test_a_slow_network_costs_the_oldest_messages_not_time(server: Server) -> None:
    bridge = Bridge(server.url, clock=lambda: 0.0)
    bridge.close()  # nobody takes from the queue any more
    for k in range(3000):
        bridge.sample({"time_s": float(k), "drive": 0.0})
    assert bridge.dropped == 2000


class Kept:
    """A recorder behind the bridge."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self.rows: list[Mapping[str, float]] = []

    def sample(self, row: Mapping[str, float]) -> None:
        self.rows.append(row)

    def event(self, event: Event) -> None:
        self.events.append(event)


def test_a_server_that_starts_again_is_found_again_and_gets_what_it_missed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock, tried, kept, server = SteppedClock(), [], Kept(), Server()
    connect = Bridge._connect
    monkeypatch.setattr(Bridge, "_connect", lambda bridge: (tried.append(clock()), connect(bridge))[1])
    with Bridge(server.url, clock=lambda: 0.0, behind=kept, monotonic=clock) as bridge:
        bridge.sample({"time_s": 0.0, "drive": 0.5})
        assert wait_for(lambda: server.reported("drive"))
        server.close()
        assert wait_for(lambda: bridge.reports)
        for k in range(1500):
            bridge.sample({"time_s": 1.0 + k, "drive": 0.25})
        assert bridge.dropped == 500
        for n in range(2, 6):  # nobody is there: ever later tries
            assert wait_for(lambda: clock.sleep(0.1) or len(tried) >= n)  # noqa: B023
        waits = [later - before for before, later in pairwise(tried)]
        assert all(wait >= least for wait, least in zip(waits, (0.1, 0.1, 0.2, 0.4), strict=False))
        again = Server(server.port)
        assert wait_for(lambda: clock.sleep(0.1) or len(again.reported("drive")) == 1000)
        bridge.sample({"time_s": 1501.0, "drive": 0.75})
        assert wait_for(lambda: again.reported("drive")[-1] == 0.75)
    again.close()
    assert "/thermogrip/drive" in {m["topic"] for m in again.heard if m["op"] == "advertise"}
    said = [event.text for event in kept.events if event.kind == "bridge"]
    assert len(said) == 2
    assert "was lost" in said[0]
    assert "again; 500 rows and events were dropped" in said[1]
    assert again.reported("status") == said[1:]
    assert bridge.dropped == 500


def test_what_was_not_sent_at_the_end_is_reported(server: Server) -> None:
    kept = Kept()
    with Bridge(server.url, clock=lambda: 0.0, behind=kept, monotonic=lambda: 0.0) as bridge:
        server.close()
        assert wait_for(lambda: bridge.reports)
        for k in range(3):
            bridge.sample({"time_s": float(k), "drive": 0.0})
    assert [e.text for e in kept.events if e.kind == "bridge"][-1] == "3 rows and events were not sent"
    assert bridge.dropped == 3


def test_a_message_beyond_all_measure_costs_the_connection_and_it_comes_back(server: Server) -> None:
    clock = SteppedClock()
    with Bridge(server.url, clock=lambda: 0.0, monotonic=clock) as bridge:
        assert wait_for(lambda: server.sockets)
        server.publish("/thermogrip/camera", "x" * 2_000_000)
        assert wait_for(lambda: clock.sleep(0.1) or len(bridge.reports) == 2)
    assert "was lost" in bridge.reports[0]
    assert "again" in bridge.reports[1]


def test_no_record_has_the_password_of_an_address(server: Server) -> None:
    with Bridge(server.url.replace("://", "://me:hunter2@"), clock=lambda: 0.0) as bridge:
        assert wait_for(lambda: server.sockets)
        server.sockets[0].close()
        assert wait_for(lambda: bridge.reports)
    assert "the connection to ws://...@" in bridge.reports[0]
    assert not [line for line in bridge.reports if "hunter2" in line]


def test_nobody_there_is_one_line() -> None:
    with pytest.raises(UserError, match="no rosbridge answers"):
        Bridge("ws://127.0.0.1:9", clock=lambda: 0.0, timeout=1.0)


def test_a_server_that_hangs_up_at_once_is_one_line(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    from websockets.exceptions import ConnectionClosedError
    from websockets.sync.client import ClientConnection

    closed = []

    def hang_up(self: ClientConnection) -> None:
        raise ConnectionClosedError(None, None)

    monkeypatch.setattr(ClientConnection, "ping", hang_up)
    monkeypatch.setattr(ClientConnection, "close", lambda self, *given: closed.append(self))
    with pytest.raises(UserError, match="no rosbridge answers"):
        Bridge(server.url, clock=lambda: 0.0, timeout=1.0)
    assert closed


def test_after_a_new_connection_topics_are_advertised_again() -> None:
    messages = Messages()
    event = Event(0.0, "phase", "settle")
    assert len(messages.event(event)) == 2
    assert len(messages.event(event)) == 1
    messages.forget()
    assert len(messages.event(event)) == 2


def test_a_row_is_a_message_a_column_with_its_date_and_a_lost_reading_is_not_sent() -> None:
    row = {"time_s": 1.5, "drive": 0.25, "t_tank_degC": float("nan"), "t_surface_degC": 30.0}
    sent = [json.loads(text) for text in Messages().row(row, stamp=1700000000.5)]
    stamp = {"sec": 1700000000, "nanosec": 500000000}
    skin = {"header": {"stamp": stamp, "frame_id": "thermogrip"}, "temperature": 30.0, "variance": 0.0}
    assert [m["msg"] for m in sent if m["op"] == "publish"] == [{"data": 0.25}, skin]


def test_one_connection_serves_run_after_run(server: Server) -> None:
    first, second = Kept(), Kept()
    with Bridge(server.url, clock=lambda: 0.0) as bridge:
        for k, folder in enumerate((first, second)):
            with bridge.before(folder) as recorder:
                recorder.sample({"time_s": float(k), "drive": 0.25})
            assert bridge.behind is None
        assert wait_for(lambda: len(server.reported_numbers("drive")) == 2)
    assert [row["time_s"] for row in first.rows + second.rows] == [0.0, 1.0]
    assert len(server.sockets) == 1
