"""Practical identifiability of a fit: condition, flat directions and trade-offs, in numbers and in words.

**Flat directions.** D H D scaled to a unit diagonal, H = J'J of the data without the prior, has one small
eigenvalue per combination of parameters that is not practically identifiable. Its eigenvector is reported
in words.

**Trade-offs.** On the scale of the priors (ln p of a positive one) a correlation r near 1 of two parameters
means that their ratio is known better than either, near -1 their product (of parameters that may be negative
the difference and the sum), with the variance s_1^2 + s_2^2 - 2 |r| s_1 s_2.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.sysid.models.network import NetworkModel
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.plant.plant_data import Identifiability


@dataclass(frozen=True)
class ReportSettings:
    """From when a parameter or a pair of them is reported."""

    unmoved_eigenvalue: float = 1e-11  # of the scaled Hessian: below it a direction changes no output
    flat_eigenvalue: float = 1e-4  # of the scaled Hessian: below it a direction is barely identifiable
    trade_off_correlation: float = 0.9  # from which two parameters are known together only
    n_pairs: int = 6  # that are reported, the closest first
    many_on_bounds: int = 3  # parameters, which have one cause
    odd_reach: float = 20.0  # times full scale, or a share of it: an input that is logged in another unit
    prior_only_sd: float = 0.9  # over prior sd, from which a parameter is known from the prior only


REPORT = ReportSettings()


class TradeOff(NamedTuple):
    """Two parameters that are known together much better than each."""

    first: str
    second: str
    correlation: float
    sd_together: float  # of the difference at positive correlation, of the sum at negative
    sd_each: float  # the smaller of the two


def trade_offs(names: Sequence[str], covariance: Array) -> list[TradeOff]:
    """Return the trade-offs at a covariance (n, n) on the scale of the priors, the closest first."""
    sd, pairs = np.sqrt(np.diag(covariance)), []
    for i, j in combinations(range(len(names)), 2):
        r = float(covariance[i, j] / (sd[i] * sd[j]))
        if abs(r) >= REPORT.trade_off_correlation:
            together = float(np.sqrt(max(sd[i] ** 2 + sd[j] ** 2 - 2 * abs(r) * sd[i] * sd[j], 0.0)))
            smaller_sd = float(min(sd[i], sd[j]))
            if together < smaller_sd:
                pairs.append(TradeOff(names[i], names[j], round(r, 3), together, smaller_sd))
    return sorted(pairs, key=lambda pair: pair.sd_together / pair.sd_each)


def identifiability_report(plant: Plant) -> list[str]:
    """Return which parameters are practically identifiable and which are not, a sentence each."""
    report = plant.scores.identifiability
    if report is None or plant.covariance is None:
        return []
    lines = [f"condition of the scaled Hessian {report.condition:.1g}"]
    how = "barely" if report.identifiable else "not"
    lines += [f"{how} identifiable from these logs: {way}, together" for way in report.flat]
    for name, end in report.on_bound.items():
        side, ends = ("lower", 0) if end == "low" else ("upper", 1)
        where = f" {plant.bounds[name][ends]:.3g}" if name in plant.bounds else ""
        cause = _cause_of_bound(plant, name, len(report.on_bound))
        lines.append(f"{name} is on its {side} bound{where}: {cause}")
    if report.prior_only:
        lines.append(f"known from the prior only: {', '.join(report.prior_only)}")
    pairs = trade_offs(plant.free, np.asarray(plant.covariance))
    return lines + [_trade_in_words(plant, pair) for pair in pairs[: REPORT.n_pairs]]


def _cause_of_bound(plant: Plant, name: str, on_bounds: int) -> str:
    """Return what most often drives a parameter of this kind onto a bound."""
    if isinstance(plant.model, NetworkModel):
        network = plant.model.network
        stated = [(item.input, item.power) for item in network.heaters.values()]
        stated += [(item.input, item.current) for item in network.peltiers.values()]
        driven = [drive for drive, which in stated if which == name or on_bounds >= REPORT.many_on_bounds]
        for drive in dict.fromkeys(driven):
            full, unit = network.inputs[drive].full_scale, network.inputs[drive].unit
            reach = max(abs(end) for end in plant.valid.get(drive, (full, full)))
            if not full / REPORT.odd_reach < reach < full * REPORT.odd_reach:
                shown = "" if unit == "1" else f" {unit}"
                return (
                    f"{drive} reaches {reach:g}{shown} in the logs and its full scale, at which powers and "
                    f"currents are stated, is {full:g}{shown}; check its unit, range or full_scale"
                )
    if on_bounds >= REPORT.many_on_bounds:
        return "several are, so check unit, full scale and sign of the inputs, and what is not modelled"
    return "its prior is off, or it makes up for something that is not modelled; widen the prior, or fix it"


def _trade_in_words(plant: Plant, pair: TradeOff) -> str:
    """Return a sentence on two parameters that are known together."""
    first, second, correlation, *sds = pair
    logs, alike = [plant.scales.get(name) == "log" for name in (first, second)], correlation > 0
    if all(logs):
        combination = "ratio" if alike else "product"
    elif any(logs):
        combination = "combination"
    else:
        combination = "difference" if alike else "sum"
    together_width, each_width = (_width(sd, all(logs)) for sd in sds)
    return (
        f"{first} and {second} trade off (correlation {correlation:.2f}): their {combination} is known "
        f"to {together_width}, each by itself to {each_width} at best; measure one or fix it"
    )


def _width(sd: float, log: bool) -> str:
    half = NormalDist().inv_cdf(0.95) * sd
    if not log:
        return f"±{half:.2g}"
    return f"±{100 * np.expm1(half):.2g} %" if half < np.log(2.0) else f"a factor of {np.exp(half):.2g}"


def describe(
    names: Sequence[str], jacobian: Array, covariance: Array, on_bound: Mapping[str, str], *, shift: Array
) -> Identifiability:
    """Return the identifiability report of a fit that lies ``shift`` prior sd off the prior's means."""
    size = np.linalg.norm(jacobian, axis=0)
    scaled = jacobian / np.where(size > 0, size, 1.0)
    values, axes = np.linalg.eigh(scaled.T @ scaled)  # rising
    least = max(float(values[0]), 0.0)
    sd, flat = np.sqrt(np.diag(covariance)), []
    for axis in axes.T[values < REPORT.flat_eigenvalue]:
        axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
        moved = [f"{n} {'up' if a > 0 else 'down'}" for n, a in zip(names, axis) if abs(a) > 0.3]
        flat.append(", ".join(moved))
    return Identifiability(
        condition=float(values[-1] / max(least, 1e-18)),
        flat=flat,
        identifiable=bool(least > REPORT.unmoved_eigenvalue),
        # Data that narrow a prior to a share s of its sd move it by sqrt(1 - s^2) of that: what is twice as
        # far off was moved, by data or by what the model lacks.
        prior_only=[
            name
            for name, s, off in zip(names, sd, np.abs(shift))
            if s > REPORT.prior_only_sd and off < 2 * np.sqrt(1 - REPORT.prior_only_sd**2)
        ],
        on_bound=dict(on_bound),
    )
