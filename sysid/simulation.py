"""Free run of a plant over a log."""

from __future__ import annotations

from thermogrip.datasets.schema import Log
from thermogrip.sysid.plant import Plant

__all__ = ["simulate"]


def simulate(
    plant: Plant, log: Log, *, warmup: float = 5.0, score_from: float | None = None, gaps: str = "mend"
) -> Log:
    """Return the free run of ``plant`` over ``log``."""
    raise NotImplementedError("written in the next commit")
