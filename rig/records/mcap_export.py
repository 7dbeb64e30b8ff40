"""The rows and events of a run as MCAP: a channel of JSON messages a column, which any MCAP reader shows."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

import xarray as xr

from thermogrip.datasets.errors import as_user_error
from thermogrip.datasets.files import atomic_path
from thermogrip.rig.interface import Event


def write_mcap(path: Path, log: xr.Dataset, events: Sequence[Event], about: dict[str, Any]) -> None:
    """Write one channel a variable of the log (``{"time_s": .., "value": ..}``, unit and role as metadata)
    and one of events. Times are nanoseconds since 1970 by the run's date, since 0 where it is lost."""
    try:
        began_ns = round(datetime.fromisoformat(str(about.get("began", ""))).timestamp()) * 1_000_000_000
    except ValueError:
        began_ns = 0
    with as_user_error(ImportError, "needs the package mcap", file=path, hint="pip install thermogrip[ros]"):
        from mcap.writer import Writer

    def channel(name: str, fields: dict[str, str], attrs: dict[str, str]) -> int:
        properties = {key: {"type": kind} for key, kind in {"time_s": "number", **fields}.items()}
        schema = {"title": name, "type": "object", "properties": properties}
        data = json.dumps(schema).encode()
        schema_id = writer.register_schema(name=f"thermogrip.{name}", encoding="jsonschema", data=data)
        return int(
            writer.register_channel(
                topic=f"/{name}", message_encoding="json", schema_id=schema_id, metadata=attrs
            )
        )

    def message(channel_id: int, content: dict[str, Any]) -> None:
        stamp = began_ns + round(1e9 * content["time_s"])
        data = json.dumps(content).encode()
        writer.add_message(channel_id=channel_id, log_time=stamp, publish_time=stamp, data=data)

    with atomic_path(path) as temporary, temporary.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="thermogrip")
        writer.add_metadata("run", {"run.json": json.dumps(about)})
        for name, column in log.data_vars.items():
            attrs = {key: str(column.attrs[key]) for key in ("units", "role")}
            channel_id = channel(str(name), {"value": "number"}, attrs)
            for time_s, value in zip(log["time"].values.tolist(), column.values.tolist()):
                if value == value:  # a lost reading is no message
                    message(channel_id, {"time_s": time_s, "value": float(value)})
        events_id = channel("events", {"kind": "string", "text": "string"}, {})
        for event in events:
            message(events_id, asdict(event))
        writer.finish()  # type: ignore[no-untyped-call]
