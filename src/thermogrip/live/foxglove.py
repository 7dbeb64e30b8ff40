"""The session in Foxglove: a channel a column, and a layout.

    /NAME    {"time_s": .., "value": ..}            each temperature, drive, the pump, the target
    /events  {"time_s": .., "kind": .., "text": ..}

It is a view: nothing that Foxglove sends is taken.
"""

from __future__ import annotations

import json
import time
from typing import Any

from thermogrip.datasets.files import write_atomic


class Mirror:
    """Publish what a session sends, on a loopback port; the layout is written once the columns are known."""

    def __init__(self, port: int, title: str, layout: str | None) -> None:
        import foxglove

        self._foxglove = foxglove
        self._layout = layout
        self._server = foxglove.start_server(name=title, host="127.0.0.1", port=port)
        self._channels: dict[str, Any] = {}
        self._events = self._channel("events", {"kind": "string", "text": "string"}, {})
        self._shown: list[Any] = []
        self._zero, self._last = 0.0, float("inf")

    def take(self, message: dict[str, Any]) -> None:
        """Publish one message of the session."""
        columns, units = message["columns"], message["units"]
        if columns and not self._channels:
            for name, unit in zip(columns[1:], units[1:]):
                self._channels[name] = self._channel(name, {"value": "number"}, {"units": unit})
            if self._layout is not None:
                write_atomic(self._layout, self.layout(columns, units))
        for row in message["rows"]:
            stamp = self._stamp(row[0])
            for name, value in zip(columns[1:], row[1:]):
                if value is not None:
                    self._channels[name].log({"time_s": row[0], "value": value}, log_time=stamp)
        events = message["now"].get("events", [])
        for event in events:
            if event not in self._shown:
                self._events.log(event, log_time=round(1e9 * (self._zero + event["time_s"])))
        self._shown = events

    def layout(self, columns: list[str], units: list[str]) -> str:
        """Return the layout file of these columns: temperatures with the target, drives, what happened."""
        # as the application imports it; what foxglove.layouts builds is for notebooks alone

        def plot(title: str, names: list[str]) -> dict[str, Any]:
            shown = {"enabled": True, "timestampMethod": "receiveTime"}
            paths = [{"value": f"/{name}.value", "label": name, **shown} for name in names]
            return {"foxglovePanelTitle": title, "paths": paths, "xAxisVal": "timestamp", "showLegend": True}

        warm = [name for name, unit in zip(columns, units) if unit == "degC"]
        moved = [name for name, unit in zip(columns, units) if unit != "degC"][1:]
        panels = {
            "Plot!temperatures": plot("Temperatures [degC]", warm),
            "Plot!drives": plot("Drive and pump", moved),
            "RawMessages!events": {"topicPath": "/events"},
        }
        top, middle, bottom = panels
        below = {"direction": "column", "first": middle, "second": bottom, "splitPercentage": 67}
        content = {
            "configById": panels,
            "globalVariables": {},
            "userNodes": {},
            "playbackConfig": {"speed": 1},
            "layout": {"direction": "column", "first": top, "second": below, "splitPercentage": 50},
        }
        return json.dumps(content, indent=1)

    def _stamp(self, time_s: float) -> int:
        """Return the date of a session's time [ns since 1970]: that of its first sample, and what passed."""
        if time_s < self._last:  # another session
            self._zero = time.time() - time_s
        self._last = time_s
        return round(1e9 * (self._zero + time_s))

    def _channel(self, name: str, fields: dict[str, str], attrs: dict[str, str]) -> Any:
        properties = {key: {"type": kind} for key, kind in {"time_s": "number", **fields}.items()}
        schema = {"title": f"thermogrip.{name}", "type": "object", "properties": properties}
        return self._foxglove.Channel(f"/{name}", schema=schema, message_encoding="json", metadata=attrs)
