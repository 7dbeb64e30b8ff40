"""Do intervals cover where logs do not begin at rest?  Two heaters that were on, unseen, before each log.

    python benchmarks/coverage/starts.py

``study.py`` has rigs that begin at rest.  Here the start is estimated from the first minute.  Parameters are
drawn about the prior medians of the network ``tclab`` (half its prior sd), both heaters were at random powers
for up to 20 min before, noise is AR(1), and each of two logs has 20 min of a random schedule.  Once there is
nothing else, once both heaters lose a little to a board of 6 J/K that the network lacks (4 to 15 per cent of
what they lose to the room).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from thermogrip.datasets.schema import Log, column, make_log
from thermogrip.sysid.experiment.schedules import excite
from thermogrip.sysid.greybox.fit import fit_network
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.models.network import NetworkModel, load_network
from thermogrip.sysid.models.network_spec import network_from_dict
from thermogrip.sysid.plant.plant import Plant

Array = NDArray[np.float64]

COUNT, SECONDS, BEFORE = 60, 1200, 1200
MEMORY, SD = 20.0, 0.4  # [s], [degC] of the noise


def with_board(model: NetworkModel) -> Plant:
    """Return the network on a board, at its prior medians."""
    content = model.to_dict()["network"]
    content["nodes"]["board"] = {"capacity": "C_board"}
    content["parameters"]["C_board"] = {"unit": "J/K", "value": 6.0, "fixed": True}
    for name, node in {"first": "heater1", "second": "heater2", "outer": "room"}.items():
        content["links"][name] = {"between": [node, "board"], "conductance": f"G_{name}"}
        content["parameters"][f"G_{name}"] = {"unit": "W/K", "value": 0.01, "fixed": True}
    return prior_plant(NetworkModel(network_from_dict(content)))


def draw(plant: Plant, model: NetworkModel, loss: tuple[float, float], rng: np.random.Generator) -> Plant:
    """Return the plant with parameters of the network's prior at half its width, and a loss to the board."""
    values = dict(plant.values)
    for name, spec in model.specs.items():
        if spec.sd_log is not None:
            values[name] = spec.value * float(np.exp(0.5 * spec.sd_log * rng.standard_normal()))
        elif spec.sd is not None:
            values[name] = spec.value + 0.5 * spec.sd * float(rng.standard_normal())
    share = float(np.exp(rng.uniform(*np.log(loss)))) * values["G_amb"]
    return replace(plant, values=values | {"G_first": share, "G_second": share})


def make(plant: Plant, seed: int, rng: np.random.Generator) -> Log:
    """Return a log that begins after an unseen past."""
    model, none = plant.model, np.zeros((1, SECONDS, 0))
    past = np.zeros((BEFORE, 2))
    past[: int(rng.integers(200, BEFORE))] = rng.uniform(0.0, 60.0, 2)
    start = np.full((1, model.n_x), plant.values["t_room"])
    _, x0 = model.rollout(start, past[None], np.zeros((1, BEFORE, 0)), plant.p[None], 1.0)
    shapes = [
        excite("prbs", SECONDS / 60, dt=1.0, tau_fast=20.0, tau_slow=150.0, seed=seed + k) for k in (0, 1)
    ]
    u = np.column_stack([25.0 + 25.0 * column(shape, "drive")[:SECONDS] for shape in shapes])
    y, _ = model.rollout(x0, u[None], none, plant.p[None], 1.0)
    phi, columns = (MEMORY - 1) / (MEMORY + 1), {}
    for k, name in enumerate(model.inputs):
        columns[name] = (u[:, k], "percent", "input")
    for k, name in enumerate(model.outputs):
        drive = SD * np.sqrt(1 - phi**2) * rng.standard_normal(SECONDS + 200)
        columns[name] = (y[0, :-1, k] + lfilter([1.0], [1.0, -phi], drive)[200:], "degC", "output")
    return make_log(np.arange(float(SECONDS)), columns, name=f"log {seed}")


def errors(loss: tuple[float, float]) -> tuple[list[str], Array]:
    """Return names and (COUNT, n) errors in stated standard deviations."""
    model = load_network("tclab")
    board, rows = with_board(model), []
    for k in range(COUNT):
        rng = np.random.default_rng(k)
        truth = draw(board, model, loss, rng)
        fit = fit_network(model, [make(truth, 4 * k + j, rng) for j in (0, 2)])
        known = replace(fit, values=fit.values | {name: truth.values[name] for name in fit.free})
        rows.append((fit.theta - known.theta) / np.sqrt(np.diag(np.asarray(fit.covariance))))
    return list(fit.free), np.array(rows)


def main() -> None:
    """Print coverage and rms error by parameter."""
    for title, loss in (("nothing is missing", (1e-7, 2e-7)), ("a board is missing", (0.04, 0.15))):
        names, z = errors(loss)
        inside = np.abs(z) < 1.645
        print(f"\n{title}: {COUNT} replications, {inside.mean():.1%} inside their 90 % intervals")
        for k, name in enumerate(names):
            rms = float(np.sqrt(np.mean(z[:, k] ** 2)))
            print(f"{name:<12}{inside[:, k].mean():8.1%}   rms error {rms:.2f} stated sd")


if __name__ == "__main__":
    main()
