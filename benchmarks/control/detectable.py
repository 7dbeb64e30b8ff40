"""How soon any test could report a plant that fouls or fades: the most powerful one, on the reference plant.

    python benchmarks/control/detectable.py --markdown detectable.md

Under the drives of one closed loop the readings of an honest plant are y ~ N(y_0, V), V = R + J J' with J
what a standard deviation of each of the model's numbers does (``mismatch.POSTERIOR``), and those of one
that changes y ~ N(y_0 + a, V).  Both are simulated by ``simulator.py``; nothing else is unknown: no start, no
sensor's offset.  No test of size alpha has more power than the likelihood ratio's (Neyman and Pearson),

    power = Phi(d - z_alpha),    d^2 = a' V^-1 a,

and d^2 / 2 is the Kullback-Leibler divergence of the two.  alpha is 1e-3 for one look an hour, and 1e-3 / 360
for the 360 that a monitor takes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from mismatch import NOISE, POSTERIOR, Controller, asked, close_loop, default_design, model_of
from scipy.stats import norm
from simulator import Array, Plant, Truth

FALSE_ALARMS, LOOKS = 1e-3, 360  # an hour
FIELDS = {"S": "seebeck", "R": "resistance", "K": "conductance", "F": "flow"} | {
    "k_fs": "to_skin",
    "G_s": "loss",
    "G_c": "wall_loss",
    "G_h": "sink",
}
CHANGES = {"fouling 5 % a minute": Truth(fouling=0.05), "Peltier fades by 17 %": Truth(fading=0.17)}
SECONDS = (30, 60, 90, 120, 150, 180, 240, 300)


def shown(truth: Truth, currents: Array, dt: float) -> Array:
    """Return the readings (n, 3) of a plant under currents, without noise."""
    plant, rows = Plant(truth), []
    for current in currents:
        rows.append(plant.read().copy())
        plant.run(float(current), dt)
    return np.array(rows)


def distances(truth: Truth, currents: Array, dt: float) -> list[float]:
    """Return d at the times ``SECONDS``."""
    honest = shown(Truth(), currents, dt)
    a = (shown(truth, currents, dt) - honest) / NOISE
    columns = []
    for name, sd in POSTERIOR.items():
        factor = float(np.exp(sd))
        other = replace(Truth(), **{FIELDS[name]: factor * getattr(Truth(), FIELDS[name])})
        if name == "F":  # the water takes as much less time through the tubes
            other = replace(other, delay=Truth().delay / factor)
        columns.append((shown(other, currents, dt) - honest) / NOISE)
    found = []
    for seconds in SECONDS:
        n = int(seconds / dt) + 1
        J = np.array([column[:n].ravel() for column in columns])
        left = a[:n].ravel()
        own = J @ left
        found.append(float(np.sqrt(left @ left - own @ np.linalg.solve(np.eye(len(J)) + J @ J.T, own))))
    return found


def main() -> None:
    """Run, print, write."""
    given, model = asked(__doc__, "4"), model_of()
    controller = Controller(model, default_design(model), compiled=not given.python)
    lines = [
        "| plant | after [s] | d | power, one look an hour | power, 360 looks an hour |",
        "|---|---|---|---|---|",
    ]
    for name, truth in CHANGES.items():
        loops = [close_loop(controller, truth, int(seed)).current for seed in given.seeds.split(",")]
        d = np.mean([distances(truth, currents, controller.dt) for currents in loops], axis=0)
        for seconds, at in zip(SECONDS, d, strict=True):
            powers = [norm.cdf(at - norm.isf(FALSE_ALARMS / looks)) for looks in (1, LOOKS)]
            lines.append(f"| {name} | {seconds} | {at:.1f} | {powers[0]:.3f} | {powers[1]:.3f} |")
    print(*lines, sep="\n")
    if given.markdown is not None:
        given.markdown.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
