"""Two touches of one block: one object temperature, seen from two gripper temperatures.

One touch cannot tell a good conductor that is a little warm from a poor one that is hot.  Two touches at
different gripper temperatures can, since both must agree on the block.  Under a candidate each touch gives
a Gaussian factor of the block's temperature T, N(m_i, v_i), from
:func:`~thermogrip.sysid.effusivity.material_fit` with the wide prior divided out.  Between the touches the
block moves in a known way,

    T_2 = T_1 + a rho (T_grip - T_1) + (U rest / C) (T_amb - T_1) + N(0, s^2),

rho being the heat that the first touch moved per degree, over C = rho c_p L, which the gripper's model
gives; a the share of it that the next touch still finds, U the loss to the room per contact face.  All is
Gaussian, so the pair's evidence and the block's temperature are in closed form.  Leaving the coupling out
ruins metals: aluminium moves by several degrees in one touch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps, log_name
from thermogrip.sysid.effusivity import MaterialFit, material_fit
from thermogrip.sysid.grasp_hypotheses import Hypotheses, material_hypotheses
from thermogrip.sysid.grasp_response import step_response, time_nodes

if TYPE_CHECKING:
    from thermogrip.datasets.materials import Material
    from thermogrip.sysid.gripper_device import Device

__all__ = ["TouchGroups", "two_touch_fit"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TouchGroups:
    """``n`` groups of two touches and m candidates.

    ``groups`` (n,) names; ``first``, ``second`` (n,) rows of the touches; ``log_evidence`` (n, m);
    ``t_object`` and ``t_object_sd`` (n, m), the block's temperature at the first touch under each candidate
    [degC].
    """

    groups: tuple[str, ...]
    first: NDArray[np.int64]
    second: NDArray[np.int64]
    log_evidence: Array
    t_object: Array
    t_object_sd: Array


def two_touch_fit(
    device: Device,
    grasps: Grasps,
    candidates: Sequence[str | Material],
    *,
    rest: float = 60.0,
    found_again: float = 0.75,
    loss: float = 100.0,
    coupling_sd: float = 0.36,
    until: float | None = None,
) -> TouchGroups:
    """Return the evidence of each candidate from both touches of each ``touch_group``.

    Parameters
    ----------
    device, grasps, candidates, until
        As in :func:`~thermogrip.sysid.effusivity.material_fit`; rows that share ``touch_group`` are touches
        of one block, in their order.
    rest : float, optional
        Time between the touches [s].
    found_again : float, optional
        Share a of the first touch's heat that the second one finds.
    loss : float, optional
        U, to the room, per contact face [W m^-2 K^-1].
    coupling_sd : float, optional
        s [K].

    Raises
    ------
    UserError
        If the record has no ``touch_group``, or a group has not two touches.

    Examples
    --------
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> from thermogrip.sysid.gripper_device import load_default_device
    >>> grasps = load_example_grasps()["exp5_two_touch_unknown_object"]
    >>> wood = grasps.isel(grasp=grasps["material"].values == "wood")
    >>> fit = two_touch_fit(load_default_device(), wood, ["copper", "iron", "wood"])
    >>> fit.log_evidence.shape, bool((fit.log_evidence.argmax(axis=1) == 2).all())
    ((6, 3), True)
    """
    groups, first, second = _pairs(grasps)
    fit = material_fit(device, grasps, candidates, until=until)
    gain, offset = _coupling(device, grasps, first, candidates, rest, found_again, loss)
    (c1, m1, v1), (c2, m2, v2) = _factor(fit, first), _factor(fit, second)
    prior, spread = fit.prior_t_object[first], fit.prior_t_object_sd[first] ** 2
    # joint normal of what both touches would read, one 2 x 2 matrix a pair and candidate
    a, b = spread + v1, gain**2 * spread + coupling_sd**2 + v2
    cross = gain * spread
    det = a * b - cross**2
    d1, d2 = m1 - prior, m2 - (gain * prior + offset)
    square = (b * d1**2 - 2 * cross * d1 * d2 + a * d2**2) / det
    evidence = c1 + c2 - 0.5 * (square + np.log(4 * np.pi**2 * det))
    # the temperature at the first touch: its own factor, the prior and the second touch carried back
    precision = 1 / spread + 1 / v1 + gain**2 / (v2 + coupling_sd**2)
    mean = (prior / spread + m1 / v1 + gain * (m2 - offset) / (v2 + coupling_sd**2)) / precision
    return TouchGroups(groups, first, second, evidence, mean, 1 / np.sqrt(precision))


def _pairs(grasps: Grasps) -> tuple[tuple[str, ...], NDArray[np.int64], NDArray[np.int64]]:
    where = log_name(grasps)
    if "touch_group" not in grasps:
        raise UserError(
            "no touch_group", file=where, mend="give the two touches of a block the same touch_group"
        )
    label = grasps["touch_group"].values.astype(str)
    names = tuple(dict.fromkeys(label[label != ""].tolist()))
    if not names:
        raise UserError(
            "no touch_group", file=where, mend="give the two touches of a block the same touch_group"
        )
    rows = [np.flatnonzero(label == name) for name in names]
    for name, row in zip(names, rows):
        if row.size != 2:
            raise UserError(f"touch_group {name!r} has {row.size} touches", file=where, mend="give it two")
    return names, np.array([r[0] for r in rows]), np.array([r[1] for r in rows])


def _factor(fit: MaterialFit, rows: NDArray[np.int64]) -> tuple[Array, Array, Array]:
    """Return log size, mean and variance of the likelihood as a function of T, its prior divided out."""
    v, p = fit.t_object_sd[rows] ** 2, fit.prior_t_object_sd[rows] ** 2
    mean, prior = fit.t_object[rows], fit.prior_t_object[rows]
    variance = 1 / np.maximum(1 / v - 1 / p, 1e-9)
    centre = variance * (mean / v - prior / p)
    total = variance + p
    size = fit.log_evidence[rows] + 0.5 * (np.log(2 * np.pi * total) + (centre - prior) ** 2 / total)
    return size, centre, variance


def _coupling(
    device: Device,
    grasps: Grasps,
    first: NDArray[np.int64],
    candidates: Sequence[str | Material],
    rest: float,
    found_again: float,
    loss: float,
) -> tuple[Array, Array]:
    """Return gain and offset of T_2 = gain T_1 + offset, (n_group, n_candidate)."""
    one: Hypotheses = material_hypotheses(device, candidates)
    capacity = np.exp(one.ln_rho_c) * device.block_length * device.depth_share
    nodes = time_nodes(float(grasps["time"].values[-1]))
    flux = step_response(
        device.stack, nodes, effusivity=np.exp(one.ln_e), capacity=capacity, h_c=np.exp(one.ln_h)
    )[2]
    inside = nodes.t <= float(grasps["time"].values[-1])
    moved = found_again * np.trapezoid(flux[:, inside], nodes.t[inside], axis=1) / capacity
    lost = 1 - np.exp(-loss * rest / capacity)
    before = np.asarray(grasps["time"].values) < -0.25
    skin = np.nanmean(np.asarray(grasps["t_surface"].values)[first][:, before], axis=1)
    room = (
        np.asarray(grasps["t_ambient"].values)[first]
        if "t_ambient" in grasps
        else np.full(first.size, np.nan)
    )
    known = np.isfinite(room)[:, None]
    gain = 1 - moved[None, :] - np.where(known, lost[None, :], 0.0)
    offset = (
        moved[None, :] * skin[:, None] + np.where(known, lost[None, :], 0.0) * np.nan_to_num(room)[:, None]
    )
    return np.asarray(gain), np.asarray(offset)
