"""A chain in a file: kept as it grows, and gone on from if it belongs to the same problem.

What a chain belongs to is said by a hash of everything that decides its density and its moves: the model, the
fitted values and priors, every row of every log, the bins, which parameters are sampled, walkers and seed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, columns, log_name
from thermogrip.sysid.plant.plant import Plant

__all__ = ["mark_backend", "problem_hash"]

_MARK = "thermogrip_problem"
_METHOD = 2  # counts up when density or moves change, so that no chain goes on with other ones


def problem_hash(
    plant: Plant, logs: Sequence[Log], sampled: Sequence[int], average: float, walkers: int, seed: int
) -> str:
    """Return a hash of all that decides a chain.

    Parameters
    ----------
    plant : Plant
    logs : sequence of Log
    sampled : sequence of int
        Which free parameters.
    average : float
        Width of the bins [s].
    walkers, seed : int
    """
    settings = [
        _METHOD,
        list(plant.free),
        list(sampled),
        average,
        walkers,
        seed,
        {k: f"{t:.4g}" for k, t in plant.scores.get("weight_s", {}).items()},
    ]
    # a machine's last digits are its own
    values = {name: f"{value:.6g}" for name, value in plant.values.items()}
    said = {"model": plant.model.to_dict(), "values": values, "settings": settings}
    digest = hashlib.sha256(json.dumps(said, sort_keys=True).encode())
    for log in logs:
        digest.update(log_name(log).encode())
        names = (*plant.inputs, *plant.disturbances, *plant.outputs)
        digest.update(np.ascontiguousarray(log["time"].values, dtype=float).tobytes())
        digest.update(np.ascontiguousarray(columns(log, names), dtype=float).tobytes())
    return digest.hexdigest()


def mark_backend(backend: Any, path: str | Path, mark: str, shape: tuple[int, ...]) -> None:
    """Leave a backend its steps if they belong to ``mark``, else empty it and write the mark.

    Parameters
    ----------
    backend : emcee.backends.HDFBackend
    path : str or Path
        Its file.
    mark : str
        From :func:`problem_hash`.
    shape : (n_walker, n_dim)

    Raises
    ------
    UserError
        If there is a file that is no chain.
    """
    try:
        same = Path(path).exists() and backend.initialized and _read_mark(backend) == mark
        if not same:
            backend.reset(*shape)
            with backend.open("a") as file:
                file[backend.name].attrs[_MARK] = mark
    except (OSError, KeyError) as error:
        raise UserError(
            "is not a chain of a posterior", file=path, mend="delete it, or name another"
        ) from error


def _read_mark(backend: Any) -> str:
    with backend.open() as file:
        return str(file[backend.name].attrs.get(_MARK, ""))
