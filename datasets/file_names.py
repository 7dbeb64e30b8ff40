"""What the name of a table's file says: its format, its stem, and the part of a log that is meant."""

from __future__ import annotations

import math
import os
import re
from pathlib import Path
from typing import NamedTuple

from thermogrip.datasets.errors import UserError, as_user_error

FORMATS = {
    ".csv": "csv", ".csv.gz": "csv", ".csv.xz": "csv",
    ".txt": "text", ".dat": "text", ".tsv": "text", ".tab": "text", ".asc": "text", ".log": "text",
    ".lvm": "text", ".txt.gz": "text", ".txt.xz": "text", ".dat.gz": "text", ".dat.xz": "text",
    ".mat": "matlab", ".xlsx": "excel",
    ".nc": "netcdf", ".h5": "netcdf", ".hdf5": "netcdf",
    ".parquet": "parquet", ".pq": "parquet",
    ".bag": "rosbag", ".db3": "rosbag", ".mcap": "rosbag",
}  # fmt: skip
_CUT = re.compile(r"^(?P<path>.+)@(?P<start>[^@:/\\]*):(?P<stop>[^@:/\\]*)$")


def file_format(path: str | Path) -> str:
    """Return ``"csv"``, ``"netcdf"``, ``"parquet"`` or ``"rosbag"`` by a file name's ending."""
    ending = _ending(path)
    if ending not in FORMATS:
        raise UserError(f"ending {ending!r} is unknown", file=path, hint=f"use one of {' '.join(FORMATS)}")
    return FORMATS[ending]


def file_stem(path: str | Path) -> str:
    """Return the file name without its ending."""
    return Path(path).name[: -len(_ending(path)) or None]


def _ending(path: str | Path) -> str:
    name = Path(path).name.lower()
    return next((e for e in FORMATS if name.endswith(e)), Path(path).suffix.lower())


class CutFile(NamedTuple):
    """A file, and the part of it that is meant."""

    file: Path
    start: float  # [s], -inf from the first row on
    stop: float  # [s], inf to the last one


def split_cut(path: str | Path) -> CutFile:
    """Return file, start and stop [s] of ``PATH@START:STOP``; a path that exists is whole, whatever it is."""
    match = _CUT.match(str(path))
    if match is None or os.path.exists(path):
        return CutFile(Path(path), -math.inf, math.inf)
    ends = []
    for text, empty in ((match["start"], -math.inf), (match["stop"], math.inf)):
        hint = "write PATH@START:STOP in seconds"
        with as_user_error(ValueError, f"{text!r} is not a time", file=str(path), hint=hint):
            ends.append(float(text) if text.strip() else empty)
    start, stop = ends
    if not start < stop:
        raise UserError(f"the cut {start:g}:{stop:g} is empty", file=str(path), hint="write the start first")
    return CutFile(Path(match["path"]), start, stop)
