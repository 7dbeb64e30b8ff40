"""Where runs lie on the disk, told by a look at the names alone."""

from __future__ import annotations

from pathlib import Path

from thermogrip.datasets.errors import UserError

__all__ = ["run_folders"]


def run_folders(folder: str | Path) -> list[Path]:
    """Return the runs in a folder, in order of name: itself, or those of a batch.

    Raises
    ------
    UserError
        If there is none.
    """
    path = Path(folder)
    if (path / "run.json").is_file() or (path / "samples.csv").is_file():
        return [path]
    found = sorted(p for p in path.glob("*") if (p / "run.json").is_file() or (p / "samples.csv").is_file())
    if not found and (path / "batch.json").is_file():
        raise UserError("is a batch without a run", file=path, hint="give the same batch command again")
    if not found:
        raise UserError("is no run folder", file=path, hint="give the folder of --out")
    return found
