"""Two tanks in a cascade, with overflow: a plant of one's own, in one class.

A pump fills the upper tank, which drains into the lower one, which drains into the reservoir; only the lower
level is measured.  The plant is the Cascaded Tanks benchmark of Schoukens et al. (DOI
10.4121/12960104), whose levels are in volt of the sensor and whose upper tank overflows, in part into the
lower tank::

    tanks=examples/cascaded_tanks.py:CascadedTanks
    thermogrip identify cascaded_tanks_train.csv --network $tanks --models network --out tanks.json
    thermogrip validate tanks.json cascaded_tanks_test.csv --network $tanks --warmup 200 --score-from 200

Both tanks are 10 high.  The lower level is h, the upper level H, the pump's voltage u:

    dH/dt = gain u - q - s,            q = drain_upper H^(1/2),   s = weir (H - 10)+^1.5
    dh/dt = q + share s - r - o,       r = drain_lower h^(1/2),   o = weir (h - 10)+^1.5

Outflow is Torricelli's law.  Water over a rim flows as over a weir, which is smooth, so an overflow needs no
event.  What is read is not the level itself, and that is what the training log shows best:

* Its residuals follow the level: what the sensor reads, S(h), runs straight from (0, 0) to a kink at
  (kink, kink_reading) and from there, nearly twice as steep, to (10, 10).
* Each time the level turns round, the reading is constant for a while and then moves on at full speed, so
  there is play in the sensor: the reading follows only where S(h) is further than ``slack`` away.

The reading m is a state, which follows within a second: dm/dt = (m clipped to S(h) -+ slack) - m.

Left out is what the sensor does after the lower tank has run over: twice in the training log the reading then
falls to 5.5 V and drops there by half a volt within one sample, and no other fall has such a drop.

Run as a program, the file compares structures, with the training log alone: the halves and the thirds of the
log are hidden in turn, the rest is fitted, and the free run through what was hidden is scored after its first
50 rows, which set its start::

    python examples/cascaded_tanks.py cascaded_tanks_train.csv

Given the benchmark's own ``dataBenchmark.csv`` (both logs in one table) it writes the two logs first.
"""

# ruff: noqa: RUF012 - tables on the class, as a user writes them
import csv
import sys

import numpy as np

RIM = 10.0  # of both tanks; the sensor reads 10 V there, and ends
FOLLOW = 1.0  # [s] within which the sensor follows once it moves

# name: value without it, and its prior where it is free
PARAMETERS = {
    "gain": (0.05, {"value": 0.05, "sd_log": 1.0, "unit": "1/s", "about": "inflow per volt of the pump"}),
    "drain_upper": (0.05, {"value": 0.05, "sd_log": 1.0, "unit": "1/s", "about": "outflow at level 1"}),
    "drain_lower": (0.05, {"value": 0.05, "sd_log": 1.0, "unit": "1/s", "about": "outflow at level 1"}),
    "weir": (0.0, {"value": 1.0, "sd_log": 1.0, "unit": "1/s", "about": "overflow at 1 over the rim"}),
    "share": (0.0, {"value": 0.5, "sd": 0.3, "low": 0.0, "high": 1.0, "about": "of it into the lower tank"}),
    "kink": (5.0, {"value": 5.0, "sd": 1.5, "low": 2.0, "high": 9.0, "about": "level where it bends"}),
    "kink_reading": (5.0, {"value": 5.0, "sd": 1.5, "low": 1.0, "high": 9.0, "unit": "V"}),
    "slack": (0.0, {"value": 0.1, "sd_log": 0.7, "unit": "V", "about": "half the play of the sensor"}),
    "exponent_upper": (0.5, {"value": 0.5, "sd_log": 0.2}),
    "exponent_lower": (0.5, {"value": 0.5, "sd_log": 0.2}),
    "ratio": (1.0, {"value": 1.0, "sd_log": 0.5, "about": "upper cross-section over lower"}),
    "taper": (0.0, {"value": 0.0, "sd": 0.25, "low": -0.8, "high": 0.8, "about": "of the lower tank"}),
    "offset": (0.0, {"value": 0.0, "sd": 0.5, "unit": "V", "about": "reading of an empty tank"}),
    "leak_lower": (0.0, {"value": 0.002, "sd_log": 1.0, "unit": "1/s", "about": "outflow along the level"}),
}

_DRAIN = ("gain", "drain_upper", "drain_lower")
_RIMS = (*_DRAIN, "weir", "share")
_KINK = (*_RIMS, "kink", "kink_reading")
_BEST = (*_KINK, "slack")
STRUCTURES = {
    "no overflow": _DRAIN,
    "overflow is lost": (*_DRAIN, "weir"),
    "overflow is shared": _RIMS,
    "and the lower exponent is free": (*_RIMS, "exponent_lower"),
    "and the lower tank tapers": (*_RIMS, "exponent_lower", "taper"),
    "overflow is shared, play": (*_RIMS, "slack"),
    "overflow is shared, kink": _KINK,
    "overflow is shared, kink, play": _BEST,
    "the same and the lower exponent": (*_BEST, "exponent_lower"),
    "the same and the upper exponent": (*_BEST, "exponent_upper"),
    "the same and the ratio": (*_BEST, "ratio"),
    "the same and the sensor's offset": (*_BEST, "offset"),
    "the same and a leak": (*_BEST, "leak_lower"),
}
CHOSEN = "overflow is shared, kink, play"  # the fewest parameters within one standard error of the least


class CascadedTanks:
    """The two tanks; ``free`` names the parameters that are fitted, all others are left out."""

    inputs = {"pump": {"unit": "V", "range": (0.0, 10.0)}}
    outputs = {"level": {"unit": "V", "sd": 0.1}}
    states = {"upper": 3.0, "lower": 0.3, "reading": 0.03}  # how unsure each is where a log begins
    dt = 4.0  # [s]
    warmup = 200.0  # [s] of a log set its start: the upper level is not measured

    def __init__(self, free=STRUCTURES[CHOSEN]):
        self.parameters = {
            name: prior if name in free else without for name, (without, prior) in PARAMETERS.items()
        }

    def rhs(self, x, u, d, p):
        """Return how fast both levels and the reading move [1/s, 1/s, V/s]."""
        upper, lower = np.maximum(x.upper, 0.0), np.maximum(x.lower, 0.0)
        between = p.drain_upper * upper**p.exponent_upper
        spilt = p.weir * np.maximum(x.upper - RIM, 0.0) ** 1.5
        out = p.drain_lower * lower**p.exponent_lower + p.leak_lower * lower
        over = p.weir * np.maximum(x.lower - RIM, 0.0) ** 1.5
        area = np.maximum(1.0 + p.taper * (lower - RIM / 2) / (RIM / 2), 0.1)
        rise = (p.ratio * (between + p.share * spilt) - out - over) / area
        seen = self.sensor(lower, p)
        follow = np.minimum(np.maximum(x.reading, seen - p.slack), seen + p.slack) - x.reading
        return [p.gain * u.pump - between - spilt, rise, follow / FOLLOW]

    def sensor(self, level, p):
        """Return what a sensor without play reads [V]: straight, with a kink."""
        below = p.offset + (p.kink_reading - p.offset) * np.minimum(level, p.kink) / p.kink
        return below + (RIM - p.kink_reading) * np.maximum(level - p.kink, 0.0) / (RIM - p.kink)

    def output(self, x, p):
        """Return what the sensor reads [V]: nothing above the rim."""
        return [np.minimum(x.reading, RIM)]

    def rest(self, y, u, d, p):
        """Return the levels that hold each other, with the reading amid its play."""
        low = np.minimum(y.level, p.kink_reading) - p.offset
        high = np.maximum(y.level - p.kink_reading, 0.0)
        slope = (p.kink_reading - p.offset) / p.kink
        lower = np.maximum(low / slope + high * (RIM - p.kink) / (RIM - p.kink_reading), 0.0)
        out = p.drain_lower * lower**p.exponent_lower + p.leak_lower * lower
        return [(out / p.ratio / p.drain_upper) ** (1.0 / p.exponent_upper), lower, y.level]


def compare(file, structures=STRUCTURES, parts=(2, 3), start=50):
    """Yield structure, its number of free parameters, in-sample RMSE and RMSE of each hidden part [V]."""
    from thermogrip.datasets.log_files import read_log
    from thermogrip.sysid.greybox.fit import fit_network
    from thermogrip.sysid.models.user_model import own_model
    from thermogrip.sysid.validation.free_run import free_run

    log = read_log(file)
    rows = log.sizes["time"]
    cuts = [(rows * k // n, rows * (k + 1) // n) for n in parts for k in range(n)]

    def error(plant, part):
        seconds = start * CascadedTanks.dt
        return free_run(plant, part, warmup=seconds, score_from=seconds).scores["level"].rmse

    for name, free in structures.items():
        model, errors = own_model(CascadedTanks(free)), []
        for begin, stop in cuts:
            rest = [log.isel(time=piece) for piece in (slice(0, begin), slice(stop, rows))]
            plant = fit_network(model, [part for part in rest if part.sizes["time"]])
            errors.append(error(plant, log.isel(time=slice(begin, stop))))
        yield name, len(free), error(fit_network(model, [log]), log), errors


def split_benchmark(file):
    """Write the training and the test log from ``dataBenchmark.csv`` into this folder; return their names."""
    with open(file, newline="", encoding="utf-8") as table:
        rows = list(csv.DictReader(table))
    names = []
    for part, end in (("train", "Est"), ("test", "Val")):
        names.append(f"cascaded_tanks_{part}.csv")
        with open(names[-1], "w", encoding="utf-8") as log:
            log.write("time_s,pump_V,level_V\n")
            for k, row in enumerate(rows):
                log.write(f"{k * CascadedTanks.dt:g},{row[f'u{end}']},{row[f'y{end}']}\n")
    return names


def main(file):
    """Compare the structures on the training log and print a line for each."""
    with open(file, encoding="utf-8") as table:
        if "uEst" in table.readline():
            file, _ = split_benchmark(file)
    print(f"{'structure':34s} free  in sample  hidden, RMSE [V]  each half and third")
    for name, n, inside, errors in compare(file):
        together = np.sqrt(np.mean(np.square(errors)))
        parts = " ".join(f"{value:.3f}" for value in errors)
        print(f"{name:34s} {n:4d}  {inside:9.3f}  {together:16.3f}  {parts}", flush=True)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python examples/cascaded_tanks.py TRAINING_LOG.csv | dataBenchmark.csv")
    main(sys.argv[1])
