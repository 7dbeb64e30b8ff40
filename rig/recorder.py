"""The run folder: what a session was, sample by sample, readable after a crash.

    run.json       what was run: schema ``thermogrip.run``, the caller's description, at the end the verdict
    samples.csv    one line a sample, written through at every line; the header names the units
    events.jsonl   one JSON object a line: ``time_s``, ``kind``, ``text``
    grasps.csv, grasps_meta.csv    the grasp, where there was one

Line-buffered text is the one format that a killed process leaves whole; everything else is exported from it
later.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.files import write_json
from thermogrip.rig.loop import Event
from thermogrip.rig.session import Session

__all__ = ["RunFolder"]

SCHEMA, VERSION = "thermogrip.run", 1


class RunFolder:
    """Write a session as it happens; a context manager.

    Parameters
    ----------
    path : str or Path
        The folder; made if absent, refused if it holds a run already.
    about : dict, optional
        What is run: controller, plant, target, seed (JSON-able).

    Raises
    ------
    UserError
        If the folder holds a run, or cannot be made.
    """

    def __init__(self, path: str | Path, about: Mapping[str, Any] | None = None) -> None:
        self.path, self.about = Path(path), dict(about or {})
        if (self.path / "run.json").exists():
            raise UserError("holds a run already", file=self.path, mend="choose another folder")
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            self._write_about({"verdict": "running"})
            self._samples: TextIO = (self.path / "samples.csv").open("w", buffering=1, newline="\n")
            self._events: TextIO = (self.path / "events.jsonl").open("w", buffering=1, newline="\n")
        except OSError as error:
            raise UserError(f"cannot be written ({error.strerror})", file=self.path) from error
        self._header: tuple[str, ...] = ()

    def sample(self, row: Mapping[str, float]) -> None:
        """Write one row; the first one sets the columns.

        Raises
        ------
        ValueError
            If the columns change.
        """
        if not self._header:
            self._header = tuple(row)
            self._samples.write(",".join(self._header) + "\n")
        if tuple(row) != self._header:
            raise ValueError(f"columns changed from {self._header} to {tuple(row)}")
        # one write a line: a killed process leaves no half value
        self._samples.write(",".join(_number(value) for value in row.values()) + "\n")

    def event(self, event: Event) -> None:
        """Write one event."""
        line = {"time_s": event.time_s, "kind": event.kind, "text": event.text}
        self._events.write(json.dumps(line) + "\n")

    def finish(self, session: Session) -> None:
        """Write the verdict, and the grasp where there is one."""
        if session.grasps is not None:
            from thermogrip.datasets.io import write_grasps  # reads tables: not needed before the end

            write_grasps(session.grasps, self.path / "grasps.csv")
        figures = {"settle_time": session.settle_time, "overshoot": session.overshoot, "bias": session.bias}
        finite = {key: value if value == value else None for key, value in figures.items()}  # JSON has no NaN
        self._write_about({"verdict": session.verdict, "advice": session.advice, **finite})

    def close(self) -> None:
        """Close the files; may be called twice."""
        self._samples.close()
        self._events.close()

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _write_about(self, result: Mapping[str, Any]) -> None:
        write_json(self.path / "run.json", {"about": self.about, **result}, schema=SCHEMA, version=VERSION)


def _number(value: float) -> str:
    """Return a number as the CSV has it; an empty cell where it is lost."""
    return f"{value:.9g}" if value == value else ""
