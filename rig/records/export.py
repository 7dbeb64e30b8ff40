"""A run in the formats of other programs: NetCDF, Parquet, CSV, and MCAP.

An MCAP file holds one channel a variable of the log, as JSON messages (``{"time_s": .., "value": ..}``) with
a JSON schema that carries unit and role, so that any MCAP reader shows it without our types, and one channel
of events.  Times are nanoseconds since the run began, counted from its date in ``run.json``.
"""

from __future__ import annotations

import calendar
import json
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from thermogrip.datasets.atomic_files import atomic_path
from thermogrip.datasets.errors import UserError, as_user_error
from thermogrip.datasets.log_files import write_log
from thermogrip.datasets.schema import column
from thermogrip.rig.records.run_folder import Run, read_run


def export_run(folder: str | Path, out: str | Path) -> Path:
    """Write the log of a run folder and return the path.

    Parameters
    ----------
    folder : str or Path
        Of the run.
    out : str or Path
        ``.nc``, ``.parquet``, ``.csv`` or ``.mcap``.

    Raises
    ------
    UserError
        If the run has no log, the ending is unknown, or MCAP is asked for without the package.

    Examples
    --------
    >>> from tempfile import mkdtemp
    >>> from thermogrip.rig.records.recorder import RunFolder
    >>> with RunFolder(Path(mkdtemp()) / "run") as run:
    ...     for k in range(2):
    ...         run.sample({"time_s": k, "t_surface_degC": 25.5})
    >>> export_run(run.path, run.path.parent / "log.csv").read_text().split()
    ['time_s,t_surface_degC', '0.0,25.5', '1.0,25.5']
    """
    run, path = read_run(folder), Path(out)
    if run.log is None:
        raise UserError("has fewer than two rows", file=folder, hint="give a run that recorded something")
    if path.suffix.lower() != ".mcap":
        return write_log(run.log, path)
    with atomic_path(path) as temporary:
        _write_mcap(run, temporary)
    return path


def _write_mcap(run: Run, path: Path) -> None:
    hint = "pip install thermogrip[ros]"
    with as_user_error(ImportError, "needs the package mcap", file=path, hint=hint):
        from mcap.writer import Writer
    log, began = run.log, _nanoseconds(run)
    assert log is not None
    columns = {str(name): column(log, str(name)) for name in log.data_vars}
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="thermogrip")
        writer.add_metadata("run", {"run.json": json.dumps(run.about)})
        channels = {}
        for name in columns:
            attrs = {key: str(log[name].attrs[key]) for key in ("units", "role")}
            channels[name] = _channel(writer, f"/{name}", f"sample_{name}", {"value": "number"}, attrs)
        events = _channel(writer, "/events", "event", {"kind": "string", "text": "string"}, {})
        for k, time_s in enumerate(log["time"].values.tolist()):
            for name, values in columns.items():
                if values[k] == values[k]:  # a lost reading is no message
                    content = {"time_s": time_s, "value": float(values[k])}
                    _message(writer, channels[name], began, k, content)
        for k, event in enumerate(run.events):
            _message(writer, events, began, k, asdict(event))
        writer.finish()  # type: ignore[no-untyped-call]


def _channel(writer: Any, topic: str, title: str, fields: dict[str, str], attrs: dict[str, str]) -> int:
    """Register a channel of JSON messages, whose schema has the time besides these fields."""
    properties = {key: {"type": kind} for key, kind in {"time_s": "number", **fields}.items()}
    schema = json.dumps({"title": title, "type": "object", "properties": properties}).encode()
    number = writer.register_schema(name=f"thermogrip.{title}", encoding="jsonschema", data=schema)
    channel = writer.register_channel(topic=topic, message_encoding="json", schema_id=number, metadata=attrs)
    return int(channel)


def _message(writer: Any, channel: int, began: int, k: int, content: dict[str, Any]) -> None:
    stamp, data = began + round(1e9 * content["time_s"]), json.dumps(content).encode()
    writer.add_message(channel_id=channel, log_time=stamp, publish_time=stamp, sequence=k, data=data)


def _nanoseconds(run: Run) -> int:
    """Return when the run began [ns since 1970], 0 where not known."""
    try:
        began = time.strptime(str(run.about.get("began", "")), "%Y-%m-%dT%H:%M:%SZ")
    except ValueError:
        return 0
    return calendar.timegm(began) * 1_000_000_000
