"""What an experiment promises beside what it keeps, where the promise may well fail.

    python benchmarks/excite/promise.py

1. The design is optimal at the plant's present values.  Here the truth is one of eight draws of the prior
   instead: is the schedule still better than the plain ones?
2. The bundled logs come from a program with terms that the network lacks.  From a fit on two of them: what
   does the third log, in which the pump stops, promise, and what does a fit on all three state?
"""

from __future__ import annotations

import numpy as np

from thermogrip.datasets.examples import example_path
from thermogrip.datasets.io import read_log
from thermogrip.datasets.resample import hold_average
from thermogrip.sysid.excite_information import Outlook, prior_belief
from thermogrip.sysid.excite_optimal import inputs_of
from thermogrip.sysid.greybox import fit_network
from thermogrip.sysid.network import load_network
from thermogrip.verbs.schedules import optimal_for, schedule_for


def other_truths(name: str, minutes: float, highest: float) -> None:
    """Print the bits of each schedule where the truth is a draw of the prior."""
    plant = prior_belief(load_network(name))
    limits = {"lowest": 5.0, "highest": highest}
    best, _, _ = optimal_for(plant, minutes, **limits, slew=np.inf)
    kinds = ("prbs", "multisine", "staircase")
    u = {kind: inputs_of(plant, schedule_for(plant, kind, minutes, **limits, seed=0)[0]) for kind in kinds}
    u["optimal"] = inputs_of(plant, best)
    print(f"\n{name}, {minutes:g} min below {highest:g} degC: bits where the truth is draw k of the prior")
    print("k  " + "".join(f"{kind:>11}" for kind in u))
    for k in range(9):
        outlook = Outlook(plant.draw(k), draws=0)
        print(f"{k:<3}" + "".join(f"{outlook.bits(row):11.1f}" for row in u.values()))


def third_log() -> None:
    """Print what the third log promises and what the fit with it states."""
    names = ("prbs_heating_cooling", "step_up_down", "pump_on_off")
    logs = [read_log(example_path(name)) for name in names]
    before, after = fit_network("gripper", logs[:2]), fit_network("gripper", logs)
    time = logs[2]["time"].values
    edges = time[0] + before.dt * np.arange(int((time[-1] - time[0]) / before.dt) + 1)
    u = hold_average(logs[2], before.inputs, edges)
    outlook = Outlook(before, draws=0)
    promised = np.sqrt(np.diag(outlook.covariance(u)))
    now, stated = np.sqrt(np.diag(before.covariance)), np.sqrt(np.diag(after.covariance))
    print(f"\npump_on_off after the other two: {outlook.bits(u):.1f} bits promised; sd of theta")
    print(f"{'parameter':<15}{'now':>10}{'promised':>10}{'stated':>10}{'stated/promised':>17}")
    for row in zip(before.free, now, promised, stated, stated / promised):
        print("{:<15}{:10.3f}{:10.3f}{:10.3f}{:17.2f}".format(*row))
    ratio = stated / promised
    print(f"median {np.median(ratio):.2f}, from {ratio.min():.2f} to {ratio.max():.2f}")


if __name__ == "__main__":
    other_truths("tclab", 30.0, 80.0)
    other_truths("gripper", 30.0, 60.0)
    third_log()
