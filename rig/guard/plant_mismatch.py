r"""How far a rig may be from its plant, and what its first healthy sessions teach about that.

A plant is identified on one day; a room, its water and its thermal paste are others on the next.  With
theta_i the plant's parameters and s the drift that the user states (a share, 0.05 say), the rig has

    theta_i (1 + s delta_i),    |delta_i| <= 1,    before anything is seen delta_i uniform: variance 1/3

(of a parameter on a linear scale whose value may be next to 0, s is a share of at least 0.2).

*What is allowed.*  A window of the monitor (:mod:`~thermogrip.rig.guard.model_checks`) ends elsewhere by G
delta, G its slopes.  With the covariance S of delta, a residual is no fault where it is below

    allowed + min(3 sqrt(G S G'), allowed),

so no window ever is more than twice as wide as without.  The bias of a drive beyond its limit is no fault
where all that it does in a longest window is below min(3 sqrt(G S G'), allowed): near its optimum a Peltier
element hardly answers to its current, and a few percent of heat look like a quarter of the drive.

*What is learnt.*  Residuals r of the longest windows, one after another and never the same second twice, from
paths without the biases of the drives, are r = G (delta - mean) + e, e of a third of what is allowed.  That
is linear regression with a prior; mean and S follow in closed form,

    S^-1 += sum G' G / sd^2,    S^-1 mean += sum G' (r + G mean) / sd^2,

and the mean is cut off at -1 and 1.

*What cannot be learnt away.*  Only sessions that settled without a trip are learnt from, only the first
:data:`LEARN_FROM` of them, and in all no parameter is moved by more than s: a driver that weakens from
session to session is followed to s and trips later than it would, but it trips (measured in
docs/records/faults.md).  After that the file stays, and the windows are nearly as sharp as for a plant that
is known.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.atomic_files import read_json, write_json
from thermogrip.datasets.errors import UserError, reading
from thermogrip.sysid.plant.plant import Plant

SCHEMA, VERSION = "thermogrip.plant_drift", 1
LEARN_FROM = 12  # healthy sessions
USUAL_DRIFT, MOST_DRIFT = 0.05, 0.2
_LEAST_LINEAR = 0.2
_SIGMAS = 3.0


@dataclass(frozen=True)
class Evidence:
    """One window of one output."""

    residual: float  # measured less where the plant goes without biases of its drives [K]
    slopes: Array  # of the path's end to delta [K]
    sd: float  # what else the residual may be, standard deviation [K]


@dataclass(frozen=True)
class PlantDrift:
    """What is known of delta."""

    plant: str  # hash of the plant's parameters
    names: tuple[str, ...]  # of the parameters
    drift: float  # s, the share by which each may be off
    mean: Array  # of delta
    covariance: Array  # of delta
    sessions: int = 0  # how many it was learnt from
    windows: int = 0  # how many it was learnt from
    file: Path | None = field(default=None, compare=False)  # where it is kept

    @classmethod
    def unknown(cls, plant: Plant, drift: float, *, file: Path | None = None) -> PlantDrift:
        """Return the prior; a plant without parameters is a :class:`UserError`."""
        names = tuple(plant.model.parameters)
        if not names:
            problem = "the plant has no parameters that could drift"
            raise UserError(problem, hint="identify a network, or leave the drift out")
        if not 0 < drift <= MOST_DRIFT:
            raise ValueError(f"a drift of {drift:g} is not above 0 and up to {MOST_DRIFT:g}")
        n = len(names)
        return cls(_hash(plant), names, drift, np.zeros(n), np.eye(n) / 3, file=file)

    @classmethod
    def load(cls, path: str | Path, plant: Plant) -> PlantDrift:
        """Return what a file holds; one that is damaged or of another plant is a :class:`UserError`."""
        content = read_json(path, SCHEMA, VERSION)
        with reading("is damaged", file=path, hint="remove it to learn anew"):
            found = cls._of(content, Path(path))
        if found.plant != _hash(plant) or found.names != tuple(plant.model.parameters):
            hint = "name another file: what is learnt of a rig holds for one plant"
            raise UserError("was learnt with another plant", file=path, hint=hint)
        return found

    @classmethod
    def _of(cls, content: Mapping[str, Any], file: Path) -> PlantDrift:
        names = tuple(str(name) for name in content["shares"])
        mean = np.array(content["delta"]["mean"], dtype=float)
        covariance = np.array(content["delta"]["covariance"], dtype=float)
        drift, n = float(content["drift"]), len(names)
        if mean.shape != (n,) or covariance.shape != (n, n):
            raise ValueError(f"{n} shares, mean {mean.shape}, covariance {covariance.shape}")
        if not (0 < drift <= MOST_DRIFT and np.abs(mean).max(initial=0.0) <= 1):
            raise ValueError("a parameter is moved by more than the drift")
        eigenvalues = np.linalg.eigvalsh(0.5 * (covariance + covariance.T))
        if not (eigenvalues.min() >= -1e-9 and eigenvalues.max() <= 1 / 3 + 1e-9):
            raise ValueError("the covariance is not that of a drift")
        sessions, windows = int(content["sessions"]), int(content["windows"])
        return cls(str(content["plant"]), names, drift, mean, covariance, sessions, windows, file)

    def save(self, path: str | Path) -> Path:
        """Write it as JSON in one step and return the path."""
        content = {
            "plant": self.plant,
            "drift": self.drift,
            "sessions": self.sessions,
            "windows": self.windows,
            "shares": self.shares(),
            "delta": {"mean": self.mean.tolist(), "covariance": self.covariance.tolist()},
        }
        return write_json(path, content, schema=SCHEMA, version=VERSION)

    @property
    def learns(self) -> bool:
        """Whether the next healthy session is still one of the first, and there is a file for it."""
        return self.file is not None and self.sessions < LEARN_FROM

    def shares(self) -> dict[str, float]:
        """Return the posterior mean of each parameter's relative error."""
        return {name: round(self.drift * float(m), 4) for name, m in zip(self.names, self.mean)}

    def line(self) -> str:
        """Return one line of text: the parameters that moved most."""
        may = f"the guard lets each parameter of the plant be off by {100 * self.drift:g} %"
        if not self.sessions:
            return may
        moved = sorted(self.shares().items(), key=lambda pair: -abs(pair[1]))[:3]
        most = ", ".join(f"{name} {100 * share:+.1f} %" for name, share in moved)
        ends = f"{self.sessions} of {LEARN_FROM} sessions"
        return f"{may}; learnt from {ends}, {self.windows} windows: {most}"

    def steps(self, plant: Plant) -> Array:
        """Return the change (n_p,) of each parameter that delta_i = 1 is."""
        least = [_LEAST_LINEAR if plant.scales.get(name) == "linear" else 0.0 for name in self.names]
        return np.asarray(self.drift * np.maximum(np.abs(plant.p), least), dtype=float)

    def parameters(self, plant: Plant) -> Array:
        """Return the posterior mean (n_p,) of the rig's parameters."""
        return np.asarray(plant.p + self.mean * self.steps(plant), dtype=float)

    def spread(self, slopes: Array) -> Array:
        """Return three standard deviations of where a path ends [K], slopes (n_y, n_p) -> (n_y,)."""
        return np.asarray(_SIGMAS * np.sqrt(np.einsum("yp,pq,yq->y", slopes, self.covariance, slopes)))

    def learnt(self, seen: Sequence[Evidence]) -> PlantDrift:
        """Return the posterior after one more healthy session."""
        information = np.linalg.inv(self.covariance)
        total = information @ self.mean
        for one in seen:
            information += np.outer(one.slopes, one.slopes) / one.sd**2
            total = total + one.slopes * (one.residual + one.slopes @ self.mean) / one.sd**2
        covariance = np.linalg.inv(information)
        covariance = 0.5 * (covariance + covariance.T)
        mean = np.clip(covariance @ total, -1.0, 1.0)
        sessions, windows = self.sessions + 1, self.windows + len(seen)
        return replace(self, mean=mean, covariance=covariance, sessions=sessions, windows=windows)


def _hash(plant: Plant) -> str:
    """Return the hash of a plant's parameters and step."""
    content = json.dumps([plant.dt, sorted(plant.values.items())])
    return hashlib.sha256(content.encode()).hexdigest()
