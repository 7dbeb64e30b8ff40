"""A lumped thermal network as a model: nodes, links, pipes, Peltiers, heaters, sensors.

The network is declared in TOML (:mod:`thermogrip.sysid.models.network_spec`) and turned into lists of
integers (:mod:`thermogrip.sysid.models.network_equations`); the arithmetic of a step is written once
(:mod:`thermogrip.sysid.models.network_equations`) and runs compiled, on NumPy rows and on CasADi symbols.

**At rest** a plant whose sensors read y was held there by some input v, not necessarily by the one of the
first row.  :meth:`NetworkModel.rest` finds the temperatures x and the past input v together,

    min  |heat(x, v)|^2 + w_y |y - output(x)|^2 + w_u |v - u|^2,

v inside its range, with weights that make the sensors nearly exact and the input a mere tie-breaker: a tank
at room temperature was not driven, a chamber at 35 degC was held by the duty that balances its losses.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from thermogrip.datasets.arrays import Array, Run, Values
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log
from thermogrip.sysid.models.model import SMOOTH, Described, FreeRuns, roll_rows
from thermogrip.sysid.models.network_equations import ThermalSteps, build_layout, state_names
from thermogrip.sysid.models.network_spec import Network, named_network, network_from_dict

if TYPE_CHECKING:
    from thermogrip.sysid.models.jit_rollout import Kernel

_SENSOR_WEIGHT, _INPUT_WEIGHT, _LEVEL_WEIGHT = 1e2, 1e-3, 1e-6


class NetworkModel(Described):
    """The equations of a network; the numbers come as ``p``, in the order of :attr:`parameters`."""

    kind = "network"
    independent = warmup = 60.0  # [s]
    smooth = SMOOTH

    def __init__(self, network: Network) -> None:
        super().__init__(network)
        self.network = network
        self.steps = ThermalSteps(build_layout(network), len(network.inputs), len(network.parameters))
        self.states = state_names(network)
        self.n_x = len(self.states)
        self.reference = next((name for name, item in network.outputs.items() if item.reference), None)
        self.sensor_sd = {name: item.sd for name, item in network.outputs.items()}
        self.drift = {
            name: (item.wander, item.wander_time)
            for name, item in network.outputs.items()
            if item.wander is not None and item.wander_time is not None
        }
        self.command_steps = {k: item.step for k, item in network.inputs.items() if item.step is not None}
        self.average = network.average or max(5.0, 5 * self.dt)
        self.search_step = max(self.dt, 2.0)
        sd = np.full(self.n_x, 0.5)
        sd[: len(network.nodes)] = [node.start_sd for node in network.nodes.values()]
        self.spread = np.diag(sd**2)

    def prepared(self, logs: Sequence[Log], p: Array | None = None, *, free_runs: FreeRuns) -> NetworkModel:
        """Return the network itself: its implicit step is accurate whatever the logs."""
        return self

    def step(self, x: Values, u: Values, d: Values, p: Values, dt: float) -> list[Any]:
        """Return the state after ``dt`` seconds; numbers, NumPy rows or CasADi symbols alike."""
        steps = self.steps
        c = steps.prepare(p)
        return steps.advance(x, u, d, c, steps.renew(u, c, dt), dt)

    def output(self, x: Values, p: Values) -> list[Any]:
        """Return what the sensors read at state x [degC], a list of length n_y."""
        return self.steps.read(x, ())

    def flows(self, x: Values, u: Values, d: Values, p: Values) -> list[Any]:
        """Return the heat that each state receives [W] (sensors: [K]), a list of length n_x."""
        return self.steps.heat(x, u, d, p)

    def capacities(self, p: Values) -> list[Any]:
        """Return the heat capacity of each state [J/K] (sensors: lag [s]), a list of length n_x."""
        return self.steps.prepare(p)[: self.n_x]

    def rest(self, y: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike) -> Array:
        """Return the state (n_x,) of a plant at rest whose sensors read y; see the module's theory."""
        y, u, d, p = (np.asarray(value, dtype=float) for value in (y, u, d, p))
        if not np.isfinite(y).any():
            raise UserError(
                "no output has a reading to start from", hint="give a log whose first rows are read"
            )
        level = float(np.nanmean(y))
        moved = [i for i, name in enumerate(self.inputs) if name not in self.switches]
        low, high = np.array([self.network.inputs[self.inputs[i]].range for i in moved]).reshape(-1, 2).T
        full = np.array([self.network.inputs[self.inputs[i]].full_scale for i in moved])
        z = np.concatenate([np.full(self.n_x, level), np.clip(u[moved], low, high) / full])
        for _ in range(8):  # bilinear and T^4 at most: Gauss-Newton settles in three or four
            rows = self._rest_residuals(
                z[:, None] + np.hstack([np.zeros((len(z), 1)), 1e-4 * np.eye(len(z))]),
                y,
                u,
                d,
                p,
                moved,
                full,
            )
            move = _bounded_move(
                (rows[:, 1:] - rows[:, :1]) / 1e-4, rows[:, 0], z[self.n_x :], low / full, high / full
            )
            z = z + move
            z[self.n_x :] = np.clip(z[self.n_x :], low / full, high / full)
            if np.abs(move).max() < 1e-6:
                break
        return np.asarray(z[: self.n_x])

    def _rest_residuals(
        self, z: Array, y: Array, u: Array, d: Array, p: Array, moved: list[int], full: Array
    ) -> Array:
        """Return the residuals (n_r, B) at the columns of ``z``: states, then shares of the moved inputs."""
        x, v = z[: self.n_x], z[self.n_x :]
        inputs: list[Any] = list(u)
        for at, i in enumerate(moved):
            inputs[i] = v[at] * full[at]
        flow = np.array(self.flows(list(x), inputs, list(d), list(p)))
        known = np.isfinite(y)
        read = np.array(self.output(list(x), list(p)))
        return np.concatenate(
            [
                flow,
                _SENSOR_WEIGHT * (read - y[:, None])[known],
                _INPUT_WEIGHT * (v - (u[moved] / full)[:, None]),
                _LEVEL_WEIGHT * (x - np.nanmean(y)),
            ]
        )

    def rollout(self, x0: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike, dt: float) -> Run:
        """Simulate a batch, compiled where llvmlite is there."""
        x0, u, d, p = (np.ascontiguousarray(value, dtype=float) for value in (x0, u, d, p))
        switched = [self.inputs.index(name) for name in self.switches]
        renew = np.ones(u.shape[1], dtype=bool)
        renew[1:] = np.any(u[:, 1:, switched] != u[:, :-1, switched], axis=(0, 2))
        kernel = _kernel(self.steps)
        if kernel is None:
            return roll_rows(self.steps, x0, u, d, p, float(dt), renew)
        return kernel.rollout(x0, u, d, p, float(dt), renew)

    def to_dict(self) -> dict[str, Any]:
        """Return the whole network as plain JSON."""
        return {
            "kind": self.kind,
            "network": self.network.model_dump(by_alias=True, mode="json", exclude_none=True),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> NetworkModel:
        """Return the model of :meth:`to_dict`; raise :class:`UserError` where it is not one."""
        content = data.get("network")
        if not isinstance(content, Mapping):
            raise UserError("the model holds no network", hint="save the plant again")
        return cls(network_from_dict(_as_it_was_fitted(content)))


def _as_it_was_fitted(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return a plant's network; 0.1.0 wrote no ``full_scale`` and took 1 for that of V, A, W and 1."""
    out = dict(content)
    inputs = out.get("inputs")
    if isinstance(inputs, Mapping):
        out["inputs"] = {
            name: {"full_scale": 1.0, **item}
            if isinstance(item, Mapping) and item.get("unit") in ("1", "A", "V", "W")
            else item
            for name, item in inputs.items()
        }
    return out


def load_network(name_or_path: str | Path) -> NetworkModel:
    """Return a network by its name (``"gripper"``) or by the path of its TOML file.

    Parameters
    ----------
    name_or_path : str or Path
        ``"gripper"``, ``"peltier_chamber"``, ``"tclab"``, or a file as ``thermogrip init network`` writes it.

    Raises
    ------
    UserError
        If there is no such network or its file is refused.

    Examples
    --------
    >>> load_network("tclab").parameters[:3]
    ('C_heater', 'G_amb', 'G_between')
    """
    return NetworkModel(named_network(name_or_path))


def _bounded_move(jacobian: Array, residual: Array, v: Array, low: Array, high: Array) -> Array:
    """Return the Gauss-Newton step of states and inputs v; what would leave its range goes to the end of
    it, and the rest is found for that."""
    move = np.asarray(np.linalg.lstsq(jacobian, -residual, rcond=None)[0])
    first = move.size - v.size
    wanted = v + move[first:]
    beyond = np.append(np.zeros(first, dtype=bool), (wanted < low) | (wanted > high))
    if beyond.any():
        move[first:] = np.clip(wanted, low, high) - v
        left = residual + jacobian[:, beyond] @ move[beyond]
        move[~beyond] = np.linalg.lstsq(jacobian[:, ~beyond], -left, rcond=None)[0]
    return move


@lru_cache(maxsize=64)
def _kernel(steps: ThermalSteps) -> Kernel | None:
    """Return the compiled steps, or None (with a warning) where llvmlite is missing."""
    try:
        from thermogrip.sysid.models.jit_rollout import Kernel
    except ImportError:
        warnings.warn("llvmlite is missing: networks run in NumPy, 100 times slower or more", stacklevel=3)
        return None
    return Kernel(steps)
