"""The identified plant as the arithmetic of the guard sees it: arrays in the order of inputs and outputs.

A drive has a range by its unit, not by what the logs covered: a drive beyond those is still a drive.  With
half that range a bias w of each drive is a fraction, and the input that the rig really gets is

    u + w * half.
"""

from __future__ import annotations

import numpy as np

from thermogrip.rig.interface import UNIT_RANGES
from thermogrip.sysid.models.model import Array
from thermogrip.sysid.plant.plant import Plant

__all__ = ["RigModel"]


class RigModel:
    """A plant with its drives told from its pump.

    Parameters
    ----------
    plant : Plant

    Attributes
    ----------
    drives : tuple of str
        The inputs that are not the pump.
    drive_at : (n_w,) ndarray of int
        Where they stand among the inputs.
    ranges, half : (n_w, 2), (n_w,) ndarray
        Least and most of each, and half of what lies between.
    offsets : (n_y,) ndarray
        What each sensor reads besides the model's output [K].
    p : (n_p,) ndarray
        The plant's parameters, or better ones.

    Examples
    --------
    >>> from thermogrip.sysid.models.state_space import StateSpaceModel
    >>> block = StateSpaceModel(("q",), (), ("t",), A=[[0.99]], B=[[0.5]], C=[[1.0]], dt=1.0, y0=[25.0])
    >>> model = RigModel(Plant(block, {}, dt=1.0, units={"q": "percent"}))
    >>> model.ranges.tolist(), model.half.tolist()
    ([[0.0, 100.0]], [50.0])
    >>> model.biased(np.array([[40.0]]), np.array([0.1])).tolist()
    [[45.0]]
    """

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self.drives = tuple(name for name in plant.inputs if name != "pump")
        self.drive_at = np.array([plant.inputs.index(name) for name in self.drives], dtype=int)
        self.ranges = np.array([self._range(name) for name in self.drives]).reshape(-1, 2)
        self.half = 0.5 * (self.ranges[:, 1] - self.ranges[:, 0])
        self.offsets = np.array([plant.offsets.get(name, 0.0) for name in plant.outputs])
        self.p = plant.p

    def _range(self, name: str) -> tuple[float, float]:
        unit = self.plant.units.get(name, "1")
        return UNIT_RANGES.get(unit) or self.plant.valid.get(name) or (-1.0, 1.0)

    def biased(self, u: Array, w: Array) -> Array:
        """Return inputs (..., n_u) as the rig gets them where its drives have biases w (n_w,)."""
        out = u.copy()
        out[..., self.drive_at] += w * self.half
        return out

    def rollout(self, x: Array, u: Array, d: Array, p: Array | None = None) -> tuple[Array, Array]:
        """Run a batch from x (B, n_x) under u (B, N, n_u), d (B, N, n_d), parameters p (B, n_p) or its own.

        Returns
        -------
        y, x : (B, N + 1, n_y), (B, n_x) ndarray
            Outputs without the offsets [degC], and the last states.
        """
        return self.plant.model.rollout(x, u, d, self.p[None] if p is None else p, self.plant.dt)

    def run(self, x: Array, u: Array, d: Array) -> Array:
        """Return the outputs (B, N + 1, n_y) of such a run without the offsets [degC]."""
        return np.asarray(self.rollout(x, u, d)[0])

    def output(self, x: Array) -> Array:
        """Return the outputs (n_y,) at a state x (n_x,) without the offsets [degC]."""
        return np.array(self.plant.model.output(x.tolist(), self.p.tolist()), dtype=float)

    def output_slope(self, x: Array) -> Array:
        """Return dy/dx (n_y, n_x) at a state, by differences."""
        n = x.size
        moved = np.repeat(x[:, None], n + 1, axis=1)
        moved[np.arange(n), np.arange(1, n + 1)] += 1e-3
        y = self.plant.model.output(list(moved), self.p.tolist())
        rows = np.array([np.broadcast_to(row, n + 1) for row in y], dtype=float)
        return np.asarray((rows[:, 1:] - rows[:, :1]) / 1e-3)
