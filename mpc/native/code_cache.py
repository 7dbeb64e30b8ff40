"""The folder of compiled code: it is run, so nobody but its user may have written to it."""

from __future__ import annotations

import os
from pathlib import Path

from thermogrip.datasets.errors import UserError

_OF_OTHERS = 0o022  # may be written by the group, or by anybody


def code_cache() -> Path:
    """Return the folder ``thermogrip`` of the user's cache folder, made where absent; UserError where it
    belongs to somebody else."""
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if not base.is_absolute():  # the XDG specification has these ignored
        base = Path.home() / ".cache"
    folder = base / "thermogrip"
    folder.mkdir(mode=0o755, parents=True, exist_ok=True)
    if not only_ours(folder):
        try:
            folder.chmod(folder.stat().st_mode & ~_OF_OTHERS)
        except PermissionError as error:
            hint = "set XDG_CACHE_HOME to a folder of your own: compiled code is kept in it"
            raise UserError("belongs to somebody else", file=folder, hint=hint) from error
    return folder


def only_ours(path: Path) -> bool:
    """Return whether a file or folder is the user's or root's, and nobody else may write to it."""
    if os.name == "nt":  # whose files have no such modes
        return True
    about = path.stat()
    return about.st_uid in (0, os.geteuid()) and not about.st_mode & _OF_OTHERS
