"""How well a gripper is known: the covariance of what a calibration found, and the spread between grippers.

A calibration ends with a posterior of theta, the numbers that all grasps share: the stack, the mean
build-up and onset, the carrying loss, the dial's bias, the depth, and ln h and ln e of each block.  Its
covariance is a :class:`Knowledge`.  A gripper that is in doubt is not taken as exact: theta is integrated
over in every answer (:mod:`thermogrip.sysid.effusivity.gripper_uncertainty`).

**Another gripper** of the same kind has other numbers.  How far they lie apart is stated here, from how such
a finger is made, not learnt from any gripper's grasps:

- a sheet of graphite is cut from stock and pressed on: thickness within 20 %; through its thickness it
  conducts by what binder and pressure leave, 30 %; its heat capacity is that of carbon, 10 %;
- a layer of filled silicone is cast by hand: thickness 25 %; conductivity by filler and settling, 25 %; heat
  capacity by mixing, 10 %;
- glue lines differ by half: conductance to the pipe's wall and to what stands beside it, 0.5 in the
  logarithm, and the sensor's lag through its own bond, 0.5; the water in the pipe 30 %;
- skin meets a block with another pressure: h of all blocks together 25 %, of each block by itself 10 % more;
  build-up time 0.4, share at first touch 0.5, settling time 0.3, all in the logarithm; creep 0.1;
- two thermistors of 1 % agree within 0.2 K; the moment of contact after the message within 0.05 s; the drift
  to the room once the pump is off, 3e-4 / s.

With conductivity k, heat capacity c and thickness d, ln e = (ln k + ln c) / 2 and ln z = ln d + (ln c - ln k)
/ 2, so the stack's own numbers are correlated.  The blocks stay the same: their effusivities and depth are as
well known as before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from thermogrip.sysid.effusivity.gripper_model import Device

__all__ = ["SHARED_NAMES", "GripperSpread", "Knowledge", "another_gripper", "block_names"]

Array = NDArray[np.float64]

# theta but for the blocks, in the order of the calibration
SHARED_NAMES = (
    "ln_e_outer", "ln_z_outer", "ln_e_inner", "ln_z_inner", "ln_g_back", "ln_lag", "ln_first", "creep",
    "ln_settle", "leak", "ln_g_side", "ln_c_side", "ln_g_far", "ln_build", "onset", "carry", "bias",
    "ln_depth",
)  # fmt: skip

NOTHING = 1e-3  # what stands for a conductance of nothing, which has no logarithm
_ROUNDING = 1e-6  # a correlation matrix may have an eigenvalue so far below zero by rounding alone


@dataclass(frozen=True)
class Knowledge:
    """``covariance`` (n, n) of the estimates called ``names`` (n,).

    Names are those of :data:`SHARED_NAMES`, then ``ln_h LABEL`` and ``ln_e LABEL`` of each block.
    """

    names: tuple[str, ...]
    covariance: Array = field(compare=False)

    def __post_init__(self) -> None:
        shape = (len(self.names),) * 2
        if self.covariance.shape != shape or not np.all(np.isfinite(self.covariance)):
            raise ValueError(f"covariance must be finite, of shape {shape}, got {self.covariance.shape}")
        if not np.allclose(self.covariance, self.covariance.T, rtol=1e-6, atol=1e-12):
            raise ValueError("covariance must be symmetric")
        sd = np.sqrt(np.maximum(np.diagonal(self.covariance), 1e-300))
        least = float(np.linalg.eigvalsh(self.covariance / np.outer(sd, sd)).min(initial=0.0))
        if least < -_ROUNDING:
            raise ValueError(f"covariance has a negative variance: {least:.2g} of correlations")
        if missing := [name for name in SHARED_NAMES if name not in self.names]:
            raise ValueError(f"covariance lacks {missing[0]}")

    def sd(self, name: str) -> float:
        """Return the standard deviation of one estimate."""
        i = self.names.index(name)
        return float(np.sqrt(self.covariance[i, i]))

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-able description."""
        return {"names": [*self.names], "covariance": self.covariance.tolist()}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Knowledge:
        """Return what :meth:`to_dict` described."""
        return cls(tuple(map(str, content["names"])), np.asarray(content["covariance"], dtype=float))


@dataclass(frozen=True, kw_only=True)
class GripperSpread:
    """Standard deviations between grippers of one kind; of logarithms but for the last five.

    ``sheet_*`` the outer layer's thickness, conductivity and heat capacity; ``layer_*`` those of the inner
    one; ``glue`` conductances to what is behind and beside; ``store`` the heat capacity beside; ``lag``;
    ``contact`` conductance of all blocks alike, ``block_contact`` of each by itself; ``build``, ``first``,
    ``settle`` of contact; ``creep``; ``leak`` [1/s]; ``onset`` [s]; ``carry``; ``bias`` [K].
    """

    sheet_thickness: float = 0.20
    sheet_conductivity: float = 0.30
    sheet_capacity: float = 0.10
    layer_thickness: float = 0.25
    layer_conductivity: float = 0.25
    layer_capacity: float = 0.10
    glue: float = 0.50
    store: float = 0.30
    lag: float = 0.50
    contact: float = 0.25
    block_contact: float = 0.10
    build: float = 0.40
    first: float = 0.50
    settle: float = 0.30
    creep: float = 0.10
    leak: float = 3e-4
    onset: float = 0.05
    carry: float = 0.005
    bias: float = 0.20

    def __post_init__(self) -> None:
        for part in fields(self):
            if not 0 <= getattr(self, part.name) < np.inf:
                raise ValueError(f"{part.name} must be >= 0 and finite, got {getattr(self, part.name):g}")

    def covariance(self, names: Sequence[str]) -> Array:
        """Return the covariance that another gripper adds to the estimates called ``names``, (n, n).

        Examples
        --------
        >>> names = ["ln_e_outer", "ln_z_outer", "ln_e copper"]
        >>> np.sqrt(np.diag(GripperSpread().covariance(names))).round(3)
        array([0.158, 0.255, 0.   ])
        """
        total = np.zeros((len(names), len(names)))
        for source in self._sources():
            column = np.array([source.get(name, source.get(name.split(" ")[0], 0.0)) for name in names])
            total += np.outer(column, column)
        own = [self.block_contact**2 if name.startswith("ln_h ") else 0.0 for name in names]
        return np.asarray(total + np.diag(own))

    def _sources(self) -> list[dict[str, float]]:
        """Return what each independent cause moves, and how far."""
        out: list[dict[str, float]] = []
        for where, layer in (("outer", "sheet"), ("inner", "layer")):
            e, z = f"ln_e_{where}", f"ln_z_{where}"
            out.append({z: getattr(self, f"{layer}_thickness")})
            k, c = 0.5 * getattr(self, f"{layer}_conductivity"), 0.5 * getattr(self, f"{layer}_capacity")
            out += [{e: k, z: -k}, {e: c, z: c}]
        out += [{"ln_g_back": self.glue}, {"ln_g_side": self.glue}, {"ln_c_side": self.store}]
        out += [{f"ln_{name}": getattr(self, name)} for name in ("lag", "build", "first", "settle")]
        out += [{name: getattr(self, name)} for name in ("creep", "leak", "onset", "carry", "bias")]
        return [*out, {"ln_h": self.contact}]


def another_gripper(device: Device, spread: GripperSpread | None = None) -> Device:
    """Return what one gripper's calibration says of another one of the same kind.

    Parameters
    ----------
    device : Device
        The calibrated one.  Where its file keeps no covariance, its own numbers count as exact.
    spread : GripperSpread, optional
        How far grippers lie apart; default what their making allows.

    Returns
    -------
    device : Device
        The same numbers, less well known, in doubt.  Answers carry that, and ``calibrate_device(...,
        prior=device)`` on a few known grasps of the other gripper takes it up.

    Examples
    --------
    >>> from thermogrip.sysid.effusivity.gripper_model import load_default_device
    >>> other = another_gripper(load_default_device())
    >>> round(other.knowledge.sd("ln_lag"), 2)
    0.5
    """
    known = device.knowledge
    if known is None:
        names = (*SHARED_NAMES, *block_names(device.materials))
        known = Knowledge(names, np.zeros((len(names), len(names))))
    extra = (spread or GripperSpread()).covariance(known.names)
    return replace(device, knowledge=Knowledge(known.names, known.covariance + extra), in_doubt=True)


def block_names(labels: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the blocks' estimates, ln h of each and then ln e of each."""
    return (*(f"ln_h {label}" for label in labels), *(f"ln_e {label}" for label in labels))
