"""Grasps drawn from a calibrated gripper's own populations, sample by sample.

What a device believes about grasps can be played forward: nuisances from its spreads, readings from its
response, noise as a time series.  Simulated grasps show what accuracy the spreads allow at all (the
engine's own bound), check that stated confidence is earned, and train classifiers that need more grasps
than anybody records.  They know only what the device knows: its misfit is left out.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicHermiteSpline

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps, make_grasps
from thermogrip.sysid.contact.response import far_response, step_response, time_nodes
from thermogrip.sysid.effusivity.gripper_model import INSULATOR, GripperModel

__all__ = ["simulate_blocks", "simulate_grasps"]

Array = NDArray[np.float64]

_PUMP_OFF = -1.0
_REGULATION = 0.35  # K: how far from its set point a gripper is at contact


def simulate_grasps(
    device: GripperModel,
    *,
    ln_e: ArrayLike,
    ln_h: ArrayLike,
    ln_rho_c: ArrayLike,
    t_gripper: float,
    t_object: float,
    t_ambient: float = 27.0,
    material: Sequence[str] | None = None,
    end: float = 10.0,
    seed: int = 0,
) -> tuple[Grasps, Array]:
    """Return grasps of given blocks, and the object temperatures that they really had.

    Parameters
    ----------
    device : GripperModel
    ln_e, ln_h, ln_rho_c : (n,) array_like
        Logarithms of effusivity, conductance and rho c_p of each block, on the gripper's scale.
    t_gripper, t_object, t_ambient : float
        Set point of the gripper, dial of the warmer, room [degC].
    material : sequence of str, optional
        Labels (n,).
    end : float, optional
        Recorded contact time [s].
    seed : int, optional

    Returns
    -------
    grasps : Grasps
        10 Hz from -2 s.
    t_true : (n,) ndarray
        Block temperatures at contact [degC], which the record does not hold.

    Examples
    --------
    >>> from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
    >>> grasps, t_true = simulate_grasps(load_default_gripper(), ln_e=[10.5], ln_h=[7.1], ln_rho_c=[15.0],
    ...                                  t_gripper=23.0, t_object=43.0)
    >>> grasps["t_surface"].shape, bool(abs(t_true[0] - 43) < 2)
    ((1, 121), True)
    """
    rng = np.random.default_rng(seed)
    e, h, rho_c = (np.asarray(v, dtype=float) for v in (ln_e, ln_h, ln_rho_c))
    n, spreads, stack = e.size, device.spreads, device.stack
    onset = device.onset + spreads.onset * rng.standard_normal(n)
    level = t_gripper + _REGULATION * rng.standard_normal(n)
    dial = t_object + device.bias + device.transit_loss * (t_ambient - t_object)
    t_true = dial + spreads.t_object * rng.standard_normal(n)
    nodes = time_nodes(end + 1.0)
    capacity = np.exp(rho_c) * device.block_length * device.depth_share
    rise, slope, _ = step_response(
        stack,
        nodes,
        effusivity=np.exp(e),
        capacity=capacity,
        h_c=np.exp(h),
        build_up=stack.build_up * np.exp(spreads.ln_build_up * rng.standard_normal(n)),
    )
    by_room = far_response(stack, nodes, rise, effusivity=np.exp(e), capacity=capacity)
    time = np.round(np.arange(-20, round(end * 10) + 1) / 10, 1)
    f = np.stack(
        [
            CubicHermiteSpline(nodes.t, r, s)(np.maximum(time - t0, 0.0))
            for r, s, t0 in zip(rise, slope, onset)
        ]
    )
    drift = stack.leak * (t_ambient - level)[:, None] * np.maximum(time - _PUMP_OFF, 0.0)
    drift += (t_ambient - t_true)[:, None] * np.stack(
        [np.interp(time - t0, nodes.t, g) for g, t0 in zip(by_room, onset)]
    )
    y = level[:, None] + (t_true - level)[:, None] * f + drift + _noise(device, n, time, rng)
    grasps = make_grasps(
        time,
        y,
        [f"sim{seed}-{i}" for i in range(n)],
        name=f"simulated-{seed}",
        material=[""] * n if material is None else list(material),
        t_object=np.full(n, t_object),
        t_gripper=np.full(n, t_gripper),
        t_ambient=np.full(n, t_ambient),
    )
    return grasps, np.asarray(t_true)


def simulate_blocks(
    device: GripperModel,
    materials: Sequence[str],
    *,
    repeats: int,
    t_gripper: float,
    t_object: float,
    t_ambient: float = 27.0,
    end: float = 10.0,
    seed: int = 0,
) -> Grasps:
    """Return labelled grasps of the device's own blocks, ``repeats`` of each material.

    Raises
    ------
    UserError
        If the device was not calibrated with a material.

    Examples
    --------
    >>> from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
    >>> rig = load_default_gripper()
    >>> grasps = simulate_blocks(rig, ["copper", "wood"], repeats=3, t_gripper=23.0, t_object=43.0)
    >>> grasps["material"].values.tolist()
    ['copper', 'copper', 'copper', 'wood', 'wood', 'wood']
    """
    for name in materials:
        if name not in device.blocks:
            raise UserError(
                f"no block of {name!r} in the calibration", hint=f"it has {', '.join(device.blocks)}"
            )
    rng = np.random.default_rng([seed, 1])
    labels = [m for m in materials for _ in range(repeats)]
    blocks = [device.blocks[m] for m in labels]
    scatter = np.where([b.library_effusivity < INSULATOR for b in blocks], device.spreads.ln_effusivity, 0.0)
    return simulate_grasps(
        device,
        ln_e=np.array([b.ln_effusivity for b in blocks]) + scatter * rng.standard_normal(len(blocks)),
        ln_h=np.array([b.ln_h for b in blocks]) + device.spreads.ln_h * rng.standard_normal(len(blocks)),
        ln_rho_c=np.log([b.heat_capacity for b in blocks]),
        t_gripper=t_gripper,
        t_object=t_object,
        t_ambient=t_ambient,
        material=labels,
        end=end,
        seed=seed,
    )[0]


def _noise(device: GripperModel, n: int, time: Array, rng: np.random.Generator) -> Array:
    """Return white noise and a stationary first-order Gauss-Markov series, (n, n_time)."""
    noise = device.noise
    keep = np.exp(-np.diff(time) / noise.correlation_time)
    slow = np.empty((n, time.size))
    slow[:, 0] = rng.standard_normal(n)
    for k in range(1, time.size):
        slow[:, k] = keep[k - 1] * slow[:, k - 1] + np.sqrt(1 - keep[k - 1] ** 2) * rng.standard_normal(n)
    return np.asarray(noise.slow * slow + noise.white * rng.standard_normal(slow.shape))
