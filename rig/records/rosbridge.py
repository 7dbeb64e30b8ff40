"""The rig on a robot's network without ROS: a bridge in rosbridge's JSON over a websocket.

A ``rosbridge_server`` (or roslibpy's peer, or Foxglove) understands two kinds of message that are used
here::

    {"op": "advertise", "topic": "/thermogrip/t_surface", "type": "sensor_msgs/Temperature"}
    {"op": "publish",   "topic": "/thermogrip/t_surface", "msg": {"header": {..}, "temperature": 38.0, ..}}

Nothing is subscribed to, and nothing that comes in is taken.  Nothing is encrypted: use it on a network of
your own.
"""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from math import isfinite
from typing import Any

from thermogrip.datasets.errors import UserError, as_user_error
from thermogrip.datasets.units import split_header
from thermogrip.media.rendering import without_password
from thermogrip.rig.clock import BackOff
from thermogrip.rig.interface import Event
from thermogrip.rig.serial.port import FIRST_WAIT_S, LONGEST_WAIT_S
from thermogrip.rig.session.loop import Recorder

PREFIX = "/thermogrip"
_KEEP = 1000  # rows and events that wait for a slow network: a quarter of an hour of a session, MBs at most
_LOOK_S = 0.1  # how often the sender looks whether a try is due, or the server is gone: a row of a grasp


class Messages:
    """The protocol alone: rows and events to JSON texts; no socket, no clock."""

    def __init__(self) -> None:
        self._advertised: set[str] = set()

    def forget(self) -> None:
        """Begin a new connection: what was advertised on the last one is advertised again."""
        self._advertised.clear()

    def row(self, row: Mapping[str, float], *, stamp: float) -> list[str]:
        """Return the messages of one row of this date [s since 1970]; JSON has no number that is lost."""
        texts, (seconds, nanoseconds) = [], divmod(round(stamp * 1e9), 1_000_000_000)
        head = {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": "thermogrip"}
        for header, value in row.items():
            name, unit = split_header(header)
            if header == "time_s" or not isfinite(value):
                continue
            if unit == "degC":
                content: dict[str, Any] = {"header": head, "temperature": value, "variance": 0.0}
                texts += self._publish(name, "sensor_msgs/Temperature", content)
            else:
                texts += self._publish(name, "std_msgs/Float64", {"data": value})
        return texts

    def event(self, event: Event) -> list[str]:
        """Return the messages of one event."""
        data = json.dumps({"time_s": event.time_s, "kind": event.kind, "text": event.text})
        return self._publish("event", "std_msgs/String", {"data": data})

    def status(self, text: str) -> list[str]:
        """Return the messages of a status line."""
        return self._publish("status", "std_msgs/String", {"data": text})

    def _publish(self, name: str, kind: str, content: Mapping[str, Any]) -> list[str]:
        topic, texts = f"{PREFIX}/{name}", []
        if topic not in self._advertised:
            self._advertised.add(topic)
            texts.append(_text(op="advertise", topic=topic, type=kind))
        return [*texts, _text(op="publish", topic=topic, msg=content)]


class Bridge:
    """A recorder that publishes; a context manager.  It takes rows and events as the run folder does.

    Parameters
    ----------
    url : str
        ``ws://HOST:9090`` of a rosbridge server.
    clock : callable
        The date [s since 1970], for the messages' stamps.
    behind : Recorder, optional
        A recorder that gets everything too, first (the run folder), and what happens to the connection.
    timeout : float, optional
        Of connecting and of closing [s].
    monotonic : callable, optional
        Where the times of the back-off come from [s].

    Attributes
    ----------
    dropped : int
        Rows and events that were not sent.
    reports : tuple of str
        What happened to the connection, a line each.

    Raises
    ------
    UserError
        If the package is missing or nothing answers at the start.

    Examples
    --------
    What it sends of a row, after the topic is advertised:

    >>> messages = Messages()
    >>> messages.row({"drive": 0.5}, stamp=0.0)[-1]
    '{"op": "publish", "topic": "/thermogrip/drive", "msg": {"data": 0.5}}'
    """

    def __init__(
        self,
        url: str,
        *,
        clock: Callable[[], float],
        behind: Recorder | None = None,
        timeout: float = 5.0,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self.url, self._shown = url, without_password(url)
        self.messages = Messages()
        self.behind = behind
        self.dropped = 0
        self.reports: tuple[str, ...] = ()
        self._clock, self._timeout = clock, timeout
        self._back_off = BackOff(monotonic, first=FIRST_WAIT_S, longest=LONGEST_WAIT_S)
        self._waiting: deque[Callable[[], list[str]]] = deque()
        self._changed = threading.Condition()  # of all that the two threads share
        self._n_recorded, self._n_reported = 0, 0  # of the reports, and of what was dropped
        self._time_s, self._ending = 0.0, False
        self._link: Any = self._connect()
        # a thread of its own: a slow or dead network never delays the loop
        self._sender = threading.Thread(target=self._work, daemon=True)
        self._sender.start()

    def sample(self, row: Mapping[str, float]) -> None:
        """Publish one row."""
        self._time_s = row.get("time_s", self._time_s)
        if self.behind is not None:
            self.behind.sample(row)
        self._record()
        self._put(partial(self.messages.row, dict(row), stamp=self._clock()))

    def event(self, event: Event) -> None:
        """Publish one event."""
        if self.behind is not None:
            self.behind.event(event)
        self._put(partial(self.messages.event, event))

    @contextmanager
    def before(self, recorder: Recorder) -> Iterator[Bridge]:
        """Publish what this recorder gets, while the block runs; the connection outlasts it."""
        self.behind, self._time_s = recorder, 0.0
        try:
            yield self
        finally:
            with suppress(OSError):  # a full disk, which the run itself records
                self._record()
            self.behind = None

    def close(self) -> None:
        """Send what waits, for at most the time-out, and close; may be called twice."""
        with self._changed:
            self._ending = True
            self._changed.notify_all()
        self._sender.join(self._timeout)
        with self._changed:
            self.dropped += len(self._waiting)
            self._waiting.clear()
            if self.dropped > self._n_reported:
                self._report(f"{self._not_sent()} were not sent")
        self._hang_up()
        with suppress(OSError):  # it is closed already, or its disk is full, which the run itself records
            self._record()

    def __enter__(self) -> Bridge:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _connect(self) -> Any:
        hint = "pip install thermogrip[ros]"
        with as_user_error(ImportError, "a bridge needs websockets", hint=hint):
            from websockets.exceptions import WebSocketException
            from websockets.sync.client import connect
        hint = "start rosbridge_server, or check host and port"
        wrong = (OSError, TimeoutError, WebSocketException, ValueError)
        refused = as_user_error(wrong, "no rosbridge answers ({error})", file=self._shown, hint=hint)
        with refused, ExitStack() as undo:
            opening = connect(self.url, open_timeout=self._timeout, close_timeout=self._timeout)
            link = undo.enter_context(opening)
            link.ping()  # one that hangs up at once is no rosbridge
            undo.pop_all()  # from now on it is for _hang_up
        return link

    def _hang_up(self) -> None:
        """Close the connection; a network that is gone cannot be closed better than this."""
        link, self._link = self._link, None
        if link is not None:
            with suppress(Exception):
                link.close()

    def _work(self) -> None:
        """Send what waits; connect again where there is no connection."""
        while True:
            with self._changed:
                if not self._waiting and not self._ending:
                    self._changed.wait(_LOOK_S)
                if self._ending and not (self._link and self._waiting):
                    return
                item = self._waiting.popleft() if self._link and self._waiting else None
            if self._link is None:
                self._connect_again()
            else:
                self._send(item)

    def _connect_again(self) -> None:
        """Try to connect, if that is due."""
        if not self._back_off.due():
            time.sleep(_LOOK_S)
            return
        try:
            self._link = self._connect()
        except UserError:  # it is tried again, and the loss is reported already
            self._back_off.failed()
            return
        self._back_off.succeeded()
        self.messages.forget()
        with self._changed:
            text = f"connected to {self._shown} again; {self._not_sent()} were dropped"
            self._report(text)
            self._waiting.appendleft(partial(self.messages.status, text))

    def _send(self, item: Callable[[], list[str]] | None) -> None:
        """Send what an item makes, and take what came in, whose end is that of the connection."""
        try:
            for text in () if item is None else item():
                self._link.send(text)
            with suppress(TimeoutError):
                self._link.recv(timeout=0)
        except Exception as error:  # of whatever kind: the view is gone, the session goes on
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            with self._changed:
                self.dropped += item is not None
                self._report(f"the connection to {self._shown} was lost ({reason})")
            self._back_off.failed()
            self._hang_up()

    def _put(self, item: Callable[[], list[str]]) -> None:
        """Queue what makes messages; where the network is too slow the oldest goes."""
        # the run folder is the record, the bridge is a view
        with self._changed:
            if len(self._waiting) >= _KEEP:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append(item)
            self._changed.notify_all()

    def _report(self, text: str) -> None:
        self.reports = (*self.reports, text)

    def _not_sent(self) -> str:
        more, self._n_reported = self.dropped - self._n_reported, self.dropped
        return f"{more} rows and events"

    def _record(self) -> None:
        if self.behind is not None:
            for text in self.reports[self._n_recorded :]:
                self._n_recorded += 1
                self.behind.event(Event(self._time_s, "bridge", text))


def _text(**message: Any) -> str:
    return json.dumps(message, allow_nan=False)
