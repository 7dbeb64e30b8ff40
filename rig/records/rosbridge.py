"""The rig on a robot's network without ROS: a bridge that speaks rosbridge's JSON over a websocket.

A ``rosbridge_server`` (or roslibpy's peer, or Foxglove) understands four kinds of message that are used
here::

    {"op": "advertise", "topic": "/thermogrip/t_surface", "type": "sensor_msgs/Temperature"}
    {"op": "publish",   "topic": "/thermogrip/t_surface", "msg": {"header": {..}, "temperature": 38.0, ..}}
    {"op": "subscribe", "topic": "/thermogrip/target",    "type": "std_msgs/Float64"}
    {"op": "publish",   "topic": "/thermogrip/target",    "msg": {"data": 38.0}}        (from the server)

:class:`Messages` is the protocol alone: rows and events in, JSON out, and back; no socket, no clock.
:class:`Bridge` sends them from a thread of its own: a slow or dead network never delays the loop.  What
cannot be sent is dropped, oldest first; the run folder is the record, the bridge is a view.

A target that comes in is a wish: it must be a finite number inside ``limits``, else it is refused and said on
``/thermogrip/status``.  Nothing but a target is accepted.  Nothing is encrypted: use it on a network of your
own.
"""

from __future__ import annotations

import json
import queue
import threading
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from math import inf, isfinite, nan
from types import TracebackType
from typing import Any

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.units import split_header
from thermogrip.rig.session.loop import Event

__all__ = ["Bridge", "Messages"]

PREFIX = "/thermogrip"
MAX_BYTES = 1 << 16  # of a message from the server
_KEEP = 1000  # messages that wait for a slow network


class Messages:
    """The protocol: rows and events to JSON texts, JSON texts to targets.

    Parameters
    ----------
    prefix : str, optional
        Of all topics.
    limits : (float, float), optional
        A target outside is refused [degC].

    Examples
    --------
    >>> rosbridge = Messages()
    >>> for text in rosbridge.row({"time_s": 1.5, "drive": 0.25, "t_surface_degC": 30.0}, stamp=1700000000.5):
    ...     print(text)
    {"op": "advertise", "topic": "/thermogrip/drive", "type": "std_msgs/Float64"}
    {"op": "publish", "topic": "/thermogrip/drive", "msg": {"data": 0.25}}
    {"op": "advertise", "topic": "/thermogrip/t_surface", "type": "sensor_msgs/Temperature"}
    {"op": "publish", "topic": "/thermogrip/t_surface", "msg": {"header": {"stamp": {"sec": 1700000000, \
"nanosec": 500000000}, "frame_id": "thermogrip"}, "temperature": 30.0, "variance": 0.0}}
    >>> rosbridge.hear('{"op": "publish", "topic": "/thermogrip/target", "msg": {"data": 38.0}}')
    (38.0, '')
    >>> rosbridge.hear('{"op": "publish", "topic": "/thermogrip/target", "msg": {"data": 380}}')
    (None, 'target 380 is not between 10 and 50 degC')
    """

    def __init__(self, prefix: str = PREFIX, limits: tuple[float, float] = (10.0, 50.0)) -> None:
        self.prefix, self.limits = prefix, limits
        self._advertised: set[str] = set()

    def hello(self) -> list[str]:
        """Return what is said on a new connection; what was advertised before is forgotten."""
        self._advertised.clear()
        return [_text(op="subscribe", topic=f"{self.prefix}/target", type="std_msgs/Float64")]

    def row(self, row: Mapping[str, float], *, stamp: float) -> list[str]:
        """Return the messages of one row of this date [s since 1970]; JSON has no number that is lost."""
        found = []
        for header, value in row.items():
            name, unit = split_header(header)
            if header == "time_s" or not isfinite(value):
                continue
            if unit == "degC":
                content: dict[str, Any] = {"header": _header(stamp), "temperature": value, "variance": 0.0}
                found += self._publish(name, "sensor_msgs/Temperature", content)
            else:
                found += self._publish(name, "std_msgs/Float64", {"data": value})
        return found

    def event(self, event: Event) -> list[str]:
        """Return the messages of one event."""
        data = json.dumps({"time_s": event.time_s, "kind": event.kind, "text": event.text})
        return self._publish("event", "std_msgs/String", {"data": data})

    def status(self, text: str) -> list[str]:
        """Return the messages that say something to whoever listens."""
        return self._publish("status", "std_msgs/String", {"data": text})

    def hear(self, text: str | bytes) -> tuple[float | None, str]:
        """Return the target that a message is, or None and why not ("" where it is not for us)."""
        if len(text) > MAX_BYTES:
            return None, "a message was too long"
        try:
            message = json.loads(text)
        except (ValueError, RecursionError):
            return None, "a message was not JSON"
        if not isinstance(message, dict) or message.get("op") != "publish":
            return None, ""
        if message.get("topic") != f"{self.prefix}/target":
            return None, ""
        content = message.get("msg")
        value = content.get("data") if isinstance(content, dict) else None
        try:
            target = float(value) if isinstance(value, int | float) and not isinstance(value, bool) else nan
        except OverflowError:  # a whole number of JSON has no end
            target = inf
        if not isfinite(target):
            return None, "target is not a number"
        low, high = self.limits
        if not low <= target <= high:
            return None, f"target {target:g} is not between {low:g} and {high:g} degC"
        return target, ""

    def _publish(self, name: str, kind: str, content: Mapping[str, Any]) -> list[str]:
        topic, found = f"{self.prefix}/{name}", []
        if topic not in self._advertised:
            self._advertised.add(topic)
            found.append(_text(op="advertise", topic=topic, type=kind))
        return [*found, _text(op="publish", topic=topic, msg=content)]


class Bridge:
    """A recorder that publishes; a context manager.  It takes rows and events as the run folder does.

    Parameters
    ----------
    url : str
        ``ws://HOST:9090`` of a rosbridge server.
    clock : callable
        The date [s since 1970], for the messages' stamps.
    messages : Messages, optional
    behind : Recorder, optional
        A recorder that gets everything too, first (the run folder).
    timeout : float, optional
        Of connecting and sending [s].

    Attributes
    ----------
    target : float or None
        The newest target that came in [degC].
    sent, dropped : int
        Messages.

    Raises
    ------
    UserError
        If the package is missing or nothing answers at the start.
    """

    def __init__(
        self,
        url: str,
        *,
        clock: Callable[[], float],
        messages: Messages | None = None,
        behind: Any = None,
        timeout: float = 5.0,
    ) -> None:
        self.url, self.messages, self.behind = url, Messages() if messages is None else messages, behind
        self.target: float | None = None
        self.sent, self.dropped = 0, 0
        self._clock, self._timeout = clock, timeout
        self._waiting: queue.Queue[str | None] = queue.Queue(maxsize=_KEEP)
        self._lock = threading.Lock()
        self._open = ExitStack()
        self._socket: Any = self._connect()
        self._threads = [
            threading.Thread(target=work, daemon=True) for work in (self._send_all, self._hear_all)
        ]
        for thread in self._threads:
            thread.start()

    def sample(self, row: Mapping[str, float]) -> None:
        """Publish one row."""
        if self.behind is not None:
            self.behind.sample(row)
        with self._lock:
            self._put(self.messages.row(row, stamp=self._clock()))

    def event(self, event: Event) -> None:
        """Publish one event."""
        if self.behind is not None:
            self.behind.event(event)
        with self._lock:
            self._put(self.messages.event(event))

    def close(self) -> None:
        """Send what waits, for at most the time-out, and close; may be called twice."""
        with suppress(queue.Full):
            self._waiting.put(None, timeout=0.1)
        self._threads[0].join(self._timeout)
        with suppress(Exception):  # a network that is gone cannot be closed better than this
            self._open.close()
        self._threads[1].join(self._timeout)

    def __enter__(self) -> Bridge:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _connect(self) -> Any:
        """Return an open connection on which hello was said."""
        try:
            from websockets.exceptions import WebSocketException
            from websockets.sync.client import connect
        except ImportError as error:
            raise UserError("a bridge needs websockets", mend="pip install thermogrip[ros]") from error
        try:
            opening = connect(self.url, open_timeout=self._timeout, max_size=MAX_BYTES)
            socket = self._open.enter_context(opening)
            for text in self.messages.hello():
                socket.send(text)
            return socket
        except (OSError, TimeoutError, WebSocketException, ValueError) as error:
            self._open.close()
            mend = "start rosbridge_server, or check host and port"
            raise UserError(f"no rosbridge answers ({error})", file=self.url, mend=mend) from error

    def _put(self, texts: list[str]) -> None:
        """Queue messages; where the network is too slow the oldest go."""
        for text in texts:
            while True:
                try:
                    self._waiting.put_nowait(text)
                    break
                except queue.Full:
                    with suppress(queue.Empty):
                        self._waiting.get_nowait()
                        self.dropped += 1

    def _send_all(self) -> None:
        while (text := self._waiting.get()) is not None:
            try:
                self._socket.send(text)
                self.sent += 1
            except Exception:  # whatever the socket says: the view is gone, the session goes on
                self.dropped += 1
                return

    def _hear_all(self) -> None:
        with suppress(Exception):  # the end of the connection comes as one of many errors
            for text in self._socket:
                target, refused = self.messages.hear(text)
                if target is not None:
                    self.target = target
                with self._lock:
                    self._put(self.messages.status(refused) if refused else [])


def _header(stamp: float) -> dict[str, Any]:
    nanoseconds = round(stamp * 1e9)
    stamped = {"sec": nanoseconds // 1_000_000_000, "nanosec": nanoseconds % 1_000_000_000}
    return {"stamp": stamped, "frame_id": "thermogrip"}


def _text(**message: Any) -> str:
    return json.dumps(message, allow_nan=False)
