"""Two tanks in a cascade, with overflow: a plant of one's own, in one class.

A pump fills the upper tank, which drains into the lower one, which drains into the reservoir; only the lower
level is measured.  The plant is the Cascaded Tanks benchmark of Schoukens et al. (DOI
10.4121/12960104), whose levels are in volt of the sensor and whose upper tank overflows, in part into the
lower tank::

    tanks=examples/cascaded_tanks.py:CascadedTanks
    thermogrip identify cascaded_tanks_train.csv --network $tanks --models network --out tanks.json
    thermogrip validate tanks.json cascaded_tanks_test.csv --network $tanks --warmup 200 --score-from 200

The lower level is h, the upper level H, the pump's voltage u:

    dH/dt = gain u - q - s,                            q = drain_upper H^a,   s = weir_upper (H - 10)+^1.5
    dh/dt = (ratio (q + share s) - r - o) / A(h),      r = drain_lower h^b,   o = weir_lower (h - 10)+^1.5
    A(h)  = 1 + taper z + bend z^2,                    z = (h - 5) / 5,       reading = min(h, 10)

Torricelli's law has a = b = 1/2; pipes and their friction move the exponents.  Water over a rim flows as
over a weir, which is smooth, so an overflow needs no event.  A is the cross-section of the lower tank, or the
sensor's nonlinearity: the level alone does not tell them apart.

Left out is what the sensor does after the lower tank has run over: twice in the training log the reading then
falls to 5.5 V and drops there by half a volt within one sample, and no other fall has such a drop.

Run as a program, the file compares structures, with the training log alone: the readings of each quarter are
hidden in turn (but for the first 50 rows of the log, which tell how it starts), the others are fitted, and
the free run through the whole log is scored on what was hidden::

    python examples/cascaded_tanks.py cascaded_tanks_train.csv
"""

# ruff: noqa: RUF012 - tables on the class, as a user writes them
import sys
from itertools import pairwise

import numpy as np

RIM = 10.0  # [V] of both tanks; the sensor ends there as well
MIDDLE = 5.0  # [V]

# name: value without it, and its prior where it is free
PARAMETERS = {
    "gain": (0.05, {"value": 0.05, "sd_log": 1.0, "unit": "1/s", "about": "inflow per volt of the pump"}),
    "drain_upper": (0.05, {"value": 0.05, "sd_log": 1.0, "unit": "1/s", "about": "outflow at 1 V"}),
    "drain_lower": (0.05, {"value": 0.05, "sd_log": 1.0, "unit": "1/s", "about": "outflow at 1 V"}),
    "weir_upper": (
        0.0,
        {"value": 0.5, "sd_log": 1.0, "unit": "1/s", "about": "overflow at 1 V over the rim"},
    ),
    "share": (0.0, {"value": 0.5, "sd": 0.3, "low": 0.0, "high": 1.0, "about": "of it into the lower tank"}),
    "weir_lower": (
        0.0,
        {"value": 0.5, "sd_log": 1.0, "unit": "1/s", "about": "overflow at 1 V over the rim"},
    ),
    "exponent_upper": (0.5, {"value": 0.5, "sd_log": 0.2}),
    "exponent_lower": (0.5, {"value": 0.5, "sd_log": 0.2}),
    "ratio": (1.0, {"value": 1.0, "sd_log": 0.5, "about": "upper cross-section over lower"}),
    "taper": (0.0, {"value": 0.0, "sd": 0.25, "low": -0.8, "high": 0.8}),
    "bend": (0.0, {"value": 0.0, "sd": 0.25, "low": -0.1, "high": 0.8}),
    "curve": (0.0, {"value": 0.0, "sd": 0.1, "about": "of the pump: inflow gain u (1 + curve (u - 3) / 3)"}),
    "leak_lower": (0.0, {"value": 0.002, "sd_log": 1.0, "unit": "1/s", "about": "outflow along the level"}),
}

_DRAIN = ("gain", "drain_upper", "drain_lower")
_RIMS = (*_DRAIN, "weir_upper", "share", "weir_lower")
_FREE = (*_RIMS, "exponent_lower")
_BEST = (*_FREE, "taper")
STRUCTURES = {
    "no overflow": _DRAIN,
    "overflow is lost": (*_DRAIN, "weir_upper"),
    "overflow is shared": (*_DRAIN, "weir_upper", "share"),
    "and the lower tank has a rim": _RIMS,
    "and the lower exponent is free": _FREE,
    "and the upper, and the ratio": (*_FREE, "exponent_upper", "ratio"),
    "lower exponent, taper": _BEST,
    "the same and bend": (*_BEST, "bend"),
    "the same and the upper exponent": (*_BEST, "exponent_upper"),
    "the same and the ratio": (*_BEST, "ratio"),
    "the same and curve of the pump": (*_BEST, "curve"),
    "the same and a leak": (*_BEST, "leak_lower"),
}
CHOSEN = "lower exponent, taper"  # the fewest parameters within one standard error of the least hidden error


class CascadedTanks:
    """The two tanks; ``free`` names the parameters that are fitted, all others are left out."""

    inputs = {"pump": {"unit": "V", "range": (0.0, 10.0)}}
    outputs = {"level": {"unit": "V", "sd": 0.1}}
    states = {"upper": 3.0, "lower": 0.3}  # how unsure each is where a log begins [V]
    dt = 4.0  # [s]
    warmup = 200.0  # [s] of a log tell how it starts: the upper level is not measured

    def __init__(self, free=STRUCTURES[CHOSEN]):
        self.parameters = {
            name: prior if name in free else without for name, (without, prior) in PARAMETERS.items()
        }

    def rhs(self, x, u, d, p):
        """Return how fast both levels rise [V/s]."""
        upper, lower = np.maximum(x.upper, 0.0), np.maximum(x.lower, 0.0)
        inflow = p.gain * u.pump * (1.0 + p.curve * (u.pump - 3.0) / 3.0)
        between = p.drain_upper * upper**p.exponent_upper
        spilt = p.weir_upper * np.maximum(x.upper - RIM, 0.0) ** 1.5
        out = p.drain_lower * lower**p.exponent_lower + p.leak_lower * lower
        over = p.weir_lower * np.maximum(x.lower - RIM, 0.0) ** 1.5
        z = (lower - MIDDLE) / MIDDLE
        area = np.maximum(1.0 + p.taper * z + p.bend * z * z, 0.1)
        rise = (p.ratio * (between + p.share * spilt) - out - over) / area
        return [inflow - between - spilt, rise]

    def output(self, x, p):
        """Return what the sensor reads [V]: nothing above the rim."""
        return [np.minimum(x.lower, RIM)]

    def rest(self, y, u, d, p):
        """Return the levels that hold each other [V]."""
        lower = np.maximum(y.level, 0.0)
        out = p.drain_lower * lower**p.exponent_lower + p.leak_lower * lower
        return [(out / p.ratio / p.drain_upper) ** (1.0 / p.exponent_upper), lower]


def compare(file, quarters=4):
    """Yield structure, its number of free parameters, in-sample RMSE and RMSE of each hidden part [V]."""
    from thermogrip.datasets.io import read_log
    from thermogrip.sysid.greybox import fit_network
    from thermogrip.sysid.own_model import own_model

    log = read_log(file)
    rows, level = log.sizes["time"], log["level"].values

    def error(plant, begin, stop):
        seen = plant.simulate(log, warmup=200.0)["level"].values
        return float(np.sqrt(np.mean((seen - level)[begin:stop] ** 2)))

    edges = [50, *(rows * k // quarters for k in range(1, quarters + 1))]
    for name, free in STRUCTURES.items():
        model, errors = own_model(CascadedTanks(free)), []
        for begin, stop in pairwise(edges):
            rest = log.copy(deep=True)
            rest["level"].values[begin:stop] = np.nan
            errors.append(error(fit_network(model, [rest], starts=0), begin, stop))
        yield name, len(free), error(fit_network(model, [log], starts=0), 50, rows), errors


if __name__ == "__main__":
    print(f"{'structure':40s} free  in sample  hidden, RMSE [V]  by quarter")
    for name, n, inside, errors in compare(sys.argv[1]):
        together = np.sqrt(np.mean(np.square(errors)))
        quarters = " ".join(f"{value:.3f}" for value in errors)
        print(f"{name:40s} {n:4d}  {inside:9.3f}  {together:16.3f}  {quarters}", flush=True)
