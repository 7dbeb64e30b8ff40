"""How far a free run may be off: the band that the parameters' uncertainty and the plant's own error span.

With v_k the free run of the k-th draw of the parameters and s the error of the fit (model error and sensor
together, ``Plant.noise``), a reading is expected within

    v +- z sqrt(var_k v_k + s^2 + r^2),        z = 1.645 for 90 %.

A fit compares means over bins of n readings, so s is an error of means.  A reading of white noise w lies off
its mean by r besides, r^2 = w^2 (1 - 1/n); w is told by the second differences of the logs of the fit, whose
variance is 6 w^2 (:func:`thermogrip.sysid.data.data_quality.reading_excess`).

A draw has its own start: state and sensor offsets are estimated anew from the warm-up.  A plant without
uncertainty of its parameters (a neural model) has the second part alone, and says so.

A black box chose its structure by free runs over parts that were held out, so it knows what those erred
by, h, the wrong structure and the doubt about its numbers together.  Its s is what the draws do not
explain of that,

    s^2 = max(h^2 - mean_k,t (v_k - v)^2, 0),

so that on average the band is as wide as its held-out errors, and wider where its draws run apart.  (Its
``Plant.noise`` is smaller: that is the weight of a reading in a warm-up.)

**Where that is too narrow.**  On average over parts is not on each: a tank that overflows in one stretch and
not in the next errs there three times as much.  With e_f the error on part f and h_f that on all the others,
a band of the others should have held, of that part, the share

    2 Phi(z h_f / e_f) - 1.

Where the least of these falls short the band says so (:func:`foretold_shares`); no factor on h is right for
both kinds of stretches.  Parts that are alike say nothing of logs that are not: a plant that drifts, or is
driven where it never was, errs by more than any of its parts.
"""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from thermogrip.datasets.schema import Log, column
from thermogrip.sysid.plant.plant import Plant

__all__ = ["Band", "foretold_shares", "free_run_band"]

Array = NDArray[np.float64]

SHORT = 0.1  # of the level: a part on which the band falls short by more is told


@dataclass(frozen=True, eq=False)
class Band:
    """A band about a free run.

    Parameters
    ----------
    level : float
        Probability that it should hold a reading.
    half : dict of output -> (n,) ndarray
        Half-width at each row of the log, in the output's unit.
    inside : dict of output -> float
        Share of the scored readings that it does hold.
    draws : int
        Draws of the parameters; 0: the plant has none, the band is the plant's own error alone.
    own_error : str
        What stands for the plant's own error, in words.
    """

    level: float
    half: dict[str, Array]
    inside: dict[str, float]
    draws: int
    own_error: str = "the error of the fit"


def free_run_band(plant: Plant, log: Log, simulated: Log, *, level: float = 0.9, draws: int = 30) -> Band:
    """Return the band about a free run of the plant.

    Parameters
    ----------
    plant : Plant
    log : Log
        What was measured.
    simulated : Log
        Its free run, as :meth:`thermogrip.sysid.plant.plant.Plant.simulate` returns it.
    level : float, optional
    draws : int, optional
        Draws of the parameters, seeds 1 to ``draws``.

    Returns
    -------
    Band

    Examples
    --------
    >>> from thermogrip.datasets.schema import make_log
    >>> from thermogrip.sysid.models.state_space import StateSpaceModel
    >>> block = StateSpaceModel(("q",), (), ("t",), A=[[0.9]], B=[[1.0]], C=[[1.0]], dt=1.0)
    >>> plant = Plant(block, {}, dt=1.0, noise={"t": 0.2})
    >>> still = {"q": (np.zeros(60), "1", "input"), "t": (np.zeros(60), "degC", "output")}
    >>> log = make_log(np.arange(60.0), still)
    >>> band = free_run_band(plant, log, plant.simulate(log))
    >>> round(float(band.half["t"][-1]), 3), band.inside["t"], band.draws
    (0.329, 1.0, 0)
    """
    if not 0 < level < 1:
        raise ValueError(f"level must lie between 0 and 1, got {level:g}")
    wide = NormalDist().inv_cdf(0.5 + level / 2)
    taken = draws if plant.uncertain else 0
    runs = [plant.draw(k).simulate(log) for k in range(1, taken + 1)]
    scored = np.asarray(simulated["scored"].values) > 0
    half, inside = {}, {}
    for name in plant.outputs:
        nominal = column(simulated, name)
        spread = np.array([column(run, name) - nominal for run in runs]).reshape(taken, len(nominal))
        variance = np.mean(spread**2, axis=0) if taken else np.zeros(len(nominal))
        own = _own_variance(plant, name, variance) + plant.scores.reading_excess.get(name, 0.0) ** 2
        half[name] = wide * np.sqrt(variance + own)
        miss = np.abs(column(log, name) - nominal)
        known = scored & np.isfinite(miss)
        inside[name] = float(np.mean(miss[known] <= half[name][known])) if known.any() else float("nan")
    return Band(level, half, inside, taken, _own_words(plant, level))


def foretold_shares(plant: Plant, level: float = 0.9) -> dict[str, Array]:
    """Return, by output, what share of each held-out part a band of the other parts' errors should hold."""
    wide = NormalDist().inv_cdf(0.5 + level / 2)
    out = {}
    for name, errors in plant.scores.held_out_by_part.items():
        squares = np.maximum(np.square(errors), 1e-24)
        if len(squares) > 1:
            others = (squares.sum() - squares) / (len(squares) - 1)
            out[name] = 2 * ndtr(wide * np.sqrt(others / squares)) - 1
    return out


def _own_words(plant: Plant, level: float) -> str:
    """Return what stands for the plant's own error, and where a band of it falls short."""
    if not plant.scores.held_out_rmse:
        return "the error of the fit"
    words = "the errors of free runs over parts held out of it"
    shares = np.concatenate([np.empty(0), *foretold_shares(plant, level).values()])
    if not shares.size or shares.min() > level - SHORT:
        return words
    return (
        f"{words}, which differ: too narrow where errors are as on the worst part, "
        f"of which a band of the others should hold {100 * shares.min():.0f} %"
    )


def _own_variance(plant: Plant, name: str, drawn: Array) -> float:
    """Return s^2, of a black box what its draws do not explain of its held-out errors."""
    held_out = plant.scores.held_out_rmse.get(name)
    if held_out is None:
        return float(plant.noise.get(name, 0.0) ** 2)
    return float(max(held_out**2 - drawn.mean(), 0.0))
