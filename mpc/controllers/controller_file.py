"""The file of a controller: what each kind writes, and how it is read again.

A file has the kind of its controller, its design, the plant that it is of, and what the tuner found.  That of
an MPC is as it always was, without its kind; a PI's has a newer version, so that an older thermogrip refuses
it and does not run the MPC of its design.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from thermogrip.datasets.errors import UserError, reading
from thermogrip.datasets.files import read_json, write_json
from thermogrip.mpc.design.design import SCHEMA, Design
from thermogrip.mpc.interface import FILE_VERSIONS

if TYPE_CHECKING:
    from thermogrip.sysid.models.model import Model
    from thermogrip.sysid.plant.plant import Plant

KEPT_DRAWS = 50  # of the posterior, for the controller's review


class Parts(NamedTuple):
    """What a file holds."""

    kind: str  # ``"MPC"`` or ``"PI"``
    plant: Plant
    design: Design
    notes: dict[str, Any]

    def save(self, path: str | Path) -> Path:
        """Write the file and return its path."""
        content: dict[str, Any] = {"schema": SCHEMA, "version": FILE_VERSIONS[self.kind]}
        if self.kind != "MPC":
            content["kind"] = self.kind
        plant = self.plant.to_dict(draws=KEPT_DRAWS)
        content |= {"design": self.design.to_dict(), "notes": self.notes, "plant": plant}
        return write_json(path, content, schema=SCHEMA, version=FILE_VERSIONS[self.kind])


def read_parts(path: str | Path, *, model: Model | None = None) -> Parts:
    """Return what a file holds; a :class:`UserError` names what is wrong."""
    from thermogrip.sysid.plant.plant import Plant

    content = read_json(path, SCHEMA, max(FILE_VERSIONS.values()))
    with reading("its numbers make no controller", file=path, hint="tune the controller again"):
        kind = content.get("kind", "MPC")
        if kind not in FILE_VERSIONS:
            raise UserError(
                f"kind is {kind!r:.40}, not one of {', '.join(FILE_VERSIONS)}", hint="tune it again"
            )
        for key in ("design", "notes", "plant"):
            if not isinstance(content.get(key), dict):
                raise UserError(f"{key} is missing", hint="tune the controller again")
        equations = content["plant"].get("model")
        of_user = isinstance(equations, dict) and equations.get("kind") == "own"
        plant = Plant.from_dict(content["plant"], model=model if of_user else None)
        return Parts(kind, plant, Design.from_dict(content["design"]), content["notes"])
