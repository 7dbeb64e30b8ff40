"""May the free run of a neural model be believed?  Its members say so, without any reading.

The members of a :class:`~thermogrip.sysid.models.neural.NeuralModel` were fitted to the same rows from
different random weights, so they agree where the data speak.  On drives and temperatures that the data do
not cover one member runs into a state of rest of its own and another does not.  The standard deviation s of
the members about their mean over a run, beside the spread S of the output in the data of the fit, is told by
the drives alone, so it may refuse a run without having looked at what is to be predicted:

    s <= :data:`APART` S        or the run is refused.

The mean errs by about as much as its members differ, for they share what the data left open; a model without
input errs by about S, and one that errs by half of that is not called good
(:mod:`thermogrip.sysid.identification`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, log_name
from thermogrip.sysid.models.neural import NeuralModel
from thermogrip.sysid.plant.log_grid import cut_stretches
from thermogrip.sysid.plant.simulation import find_starts

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant

__all__ = ["APART", "members_apart", "refuse_strays"]

APART = 0.4  # of the output's spread in the data of the fit


def members_apart(plant: Plant, log: Log, *, warmup: float = 5.0) -> dict[str, float]:
    """Return by output the rms of the members' sd over the output's spread; empty where not neural."""
    model = plant.model
    if not isinstance(model, NeuralModel) or len(model.A) < 2:
        return {}
    stretches, n_y = cut_stretches(plant, log), len(model.outputs)
    parts = []
    for stretch, start in zip(stretches, find_starts(plant, plant.p, stretches, warmup)):
        d = stretch.d - start.d_offset
        x = model.states(start.x0[None], stretch.u[None], d[None], plant.dt)[0]
        parts.append(x.reshape(len(x), *model.A.shape[:2])[:, :, :n_y].var(axis=1))
    return dict(zip(model.outputs, np.sqrt(np.concatenate(parts).mean(axis=0)).tolist()))


def refuse_strays(plant: Plant, log: Log, *, warmup: float = 5.0) -> None:
    """Refuse a neural plant whose members run apart over the log; other plants pass."""
    for name, share in members_apart(plant, log, warmup=warmup).items():
        if share > APART:
            raise UserError(
                f"its members run apart over {log_name(log)}: {name} by {100 * share:.0f} % of what it "
                "moved in the fit, so their mean tells nothing",
                hint="fit logs that cover these drives and temperatures, or use another model",
            )
