"""Models and logs of the grey-box tests: a heated block, two gains whose fit is linear, rigs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.signal import lfilter

from thermogrip.datasets.schema import Log, make_log
from thermogrip.sysid.greybox.fit import fit_network
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.models.network import NetworkModel, load_network
from thermogrip.sysid.models.network_spec import Parameter, network_from_dict
from thermogrip.sysid.plant.plant import Plant

Array = NDArray[np.float64]


def heater(extra: dict[str, Any] | None = None) -> NetworkModel:
    """A heated block with a sensor lag; ``extra`` parameters may split its loss into two."""
    content: dict[str, Any] = {
        "schema": "thermogrip.network", "version": 1, "name": "block", "dt": 1.0,
        "inputs": {"q": {"unit": "1", "range": [0.0, 1.0]}},
        "disturbances": {"air": {}},
        "outputs": {"t": {"node": "block", "lag": "lag", "sd": 0.05, "reference": True}},
        "nodes": {"block": {"capacity": "C"}},
        "links": {"loss": {"between": ["block", "air"], "conductance": "G"}},
        "heaters": {"h": {"node": "block", "input": "q", "power": "P"}},
        "parameters": {
            "C": {"unit": "J/K", "value": 50.0, "fixed": True},
            "G": {"unit": "W/K", "value": 0.5, "sd_log": 1.0},
            "P": {"unit": "W", "value": 10.0, "sd_log": 1.0},
            "lag": {"unit": "s", "value": 5.0, "sd_log": 1.0},
        },
    }  # fmt: skip
    if extra:
        content["links"]["second"] = {"between": ["block", "air"], "conductance": "G2"}
        content["parameters"] |= extra
    return NetworkModel(network_from_dict(content))


TRUTH = {"G": 0.8, "P": 17.0, "lag": 9.0}


def made(seed: int, sd: float = 0.05, seconds: float = 900.0, drift: float = 0.0) -> Log:
    """A log of the true block, with white noise and, if asked, a slow drift of the reading."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 0.5)
    q = np.repeat(rng.random(int(seconds // 30) + 1) < 0.5, 60)[: t.size].astype(float) * (t >= 5)
    still = np.full(t.size, 21.0)
    signals = {"q": (q, "1", "input"), "air": (still, "degC", "disturbance")}
    plant = prior_plant(heater())
    plant = replace(plant, values=plant.values | TRUTH)
    run = plant.simulate(make_log(t, signals | {"t": (still, "degC", "output")}))
    slow = np.zeros(t.size)
    if drift:
        steps = rng.standard_normal(t.size)
        for k in range(1, t.size):  # an AR(1) error of 40 s
            slow[k] = slow[k - 1] * np.exp(-0.5 / 40) + steps[k] * np.sqrt(1 - np.exp(-1.0 / 40))
    read = run["t"].values + sd * rng.standard_normal(t.size) + drift * slow
    return make_log(t, signals | {"t": (read, "degC", "output")}, name=f"made{seed}")


class TwoGains:
    """y = a x1 + b x2, x1 and x2 the input through first-order lags of 20 s and 100 s: linear in (a, b)."""

    kind = "two gains"
    inputs = ("q",)
    disturbances: tuple[str, ...] = ()
    outputs = ("t",)
    switches: tuple[str, ...] = ()
    parameters = ("a", "b")
    n_x = 2
    lags = (20.0, 100.0)
    states = ("soon", "late")
    smooth = 0.0
    command_steps: Mapping[str, float] = {}
    name, dt, average, independent, warmup = "two gains", 1.0, 4.0, 60.0, 5.0
    reference: str | None = None
    units: Mapping[str, str] = {"q": "1", "t": "degC", "a": "K", "b": "K"}
    sensor_sd: Mapping[str, float] = {"t": 0.1}
    specs: Mapping[str, Parameter] = {
        "a": Parameter(unit="K", value=4.0, sd=4.0, low=-40.0, high=40.0),
        "b": Parameter(unit="K", value=4.0, sd=4.0, low=-40.0, high=40.0),
    }

    def __init__(self, nuisance: float = 0.0) -> None:
        self.nuisance = {"t": nuisance}

    def prepared(self, free_runs: Any, spread: Any, p: Array | None = None) -> TwoGains:
        return self

    @property
    def spread(self) -> Array:
        return 1e-8 * np.eye(2)  # it starts at zero

    def rest(self, y: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike) -> Array:
        return np.zeros(2)

    def step(
        self, x: Sequence[Any], u: Sequence[Any], d: Sequence[Any], p: Sequence[Any], dt: float
    ) -> list[Any]:
        return [x[i] + (1 - np.exp(-dt / lag)) * (u[0] - x[i]) for i, lag in enumerate(self.lags)]

    def output(self, x: Sequence[Any], p: Sequence[Any]) -> list[Any]:
        return [p[0] * x[0] + p[1] * x[1]]

    def rollout(
        self, x0: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike, dt: float
    ) -> tuple[Array, Array]:
        q, gains, begin = np.asarray(u, float)[0, :, 0], np.asarray(p, float), np.asarray(x0, float)
        keep = np.exp(-dt / np.array(self.lags))
        forced = np.stack([np.append(0.0, lfilter([1 - k], [1, -k], q)) for k in keep])
        states = forced + begin[:, :, None] * keep[:, None] ** np.arange(q.size + 1)
        y = np.einsum("bi,bik->bk", np.broadcast_to(gains, (len(begin), 2)), states)
        return y[:, :, None], states[:, :, -1]

    def to_dict(self) -> dict[str, Any]:
        return {"kind": self.kind}


TRUE = {"a": 3.0, "b": 5.0}
CORRELATION_TIME, MODEL_ERROR, NOISE = 30.0, 0.3, 0.03


def a_fit(*seeds: int, nuisance: float = 0.0, **of_log: Any) -> tuple[Plant, list[Log]]:
    """Return the fit of as many logs, and the logs."""
    logs = [a_log(seed, **of_log) for seed in seeds or (1, 2)]
    return fit_network(TwoGains(nuisance), logs), logs


def a_log(seed: int, *, seconds: int = 600, memory: float = CORRELATION_TIME) -> Log:
    """Return a log whose model error is an AR(1) process."""
    rng = np.random.default_rng(seed)
    t = np.arange(float(seconds))
    q = np.repeat(rng.uniform(0, 1, seconds // 40 + 1), 40)[:seconds]
    y, _ = TwoGains().rollout(
        np.zeros((1, 2)), q[None, :, None], np.zeros((1, seconds, 0)), [[3.0, 5.0]], 1.0
    )
    keep = np.exp(-1.0 / memory)
    drive = rng.normal(0.0, MODEL_ERROR * np.sqrt(1 - keep**2), seconds + 500)
    error = lfilter([1.0], [1.0, -keep], drive)[500:]
    seen = y[0, :-1, 0] + error + rng.normal(0.0, NOISE, seconds)
    return make_log(t, {"q": (q, "1", "input"), "t": (seen, "degC", "output")}, name=f"log {seed}")


BOARD = prior_plant(load_network("tclab"))
N_FREE = len(BOARD.free)
WIDTH = np.array([BOARD.model.specs[n].sd_log or BOARD.model.specs[n].sd for n in BOARD.free])
OWN = np.array([name != "t_room" for name in BOARD.free])  # what is a rig's, not the room's
OFF, SPREAD = np.full(N_FREE, 0.4), np.array([0.1, 0.3, 0.1, 0.2, 0.4, 0.2, 0.3])  # in sd of the prior


def fits(n, rng, rows=10, size=8.0):
    """Return truths (n, k) in units of the prior, and the plants that linear logs of each leave."""
    z = OFF + SPREAD * rng.normal(size=(n, N_FREE))
    plants = {}
    for i, true in enumerate(z):
        J = size * rng.normal(size=(rows, N_FREE))
        S = np.linalg.inv(J.T @ J + np.eye(N_FREE))
        plants[f"r{i}"] = plant_at(S @ J.T @ (J @ true + rng.normal(size=rows)), S)
    return z, plants


def plant_at(z, S):
    values = dict(zip(BOARD.free, BOARD.natural(BOARD.theta + WIDTH * z).tolist()))
    return replace(BOARD, values=BOARD.values | values, covariance=S * np.outer(WIDTH, WIDTH))
