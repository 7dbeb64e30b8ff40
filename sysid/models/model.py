"""Equations without numbers: what every model offers, and which class reads a saved one back.

With the state x, the inputs u, the measured disturbances d and the parameters p,

    x+ = step(x, u, d, p, dt),        y = output(x, p),

both in plain arithmetic, so that NumPy rows and CasADi symbols run the same lines.

A :class:`GreyModel` also states what was known before any log was seen: a prior and bounds for each
parameter, how well each sensor reads, and the times over which the fit averages.  A thermal network from a
TOML file (:mod:`thermogrip.sysid.models.network`) and a class of the user's own
(:mod:`thermogrip.sysid.models.user_model`) both are, and both answer most of it from tables
(:class:`Described`); :func:`thermogrip.sysid.greybox.fit.fit_network`, the posterior and the report take
either.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log
from thermogrip.sysid.models.network_spec import Parameter

Array = NDArray[np.float64]

SMOOTH = 20.0  # [s] mean of a measured ambient, for its sensor is slow and coarse

# Which class reads a saved model, by its kind; a file can name no other code.
_KINDS = {
    "network": ("thermogrip.sysid.models.network", "NetworkModel"),
    "statespace": ("thermogrip.sysid.models.state_space", "StateSpaceModel"),
    "neural": ("thermogrip.sysid.models.neural", "NeuralModel"),
    "sindy": ("thermogrip.sysid.models.polynomial", "SindyModel"),
    "own": ("thermogrip.sysid.models.user_model", "OwnModel"),  # which refuses: its code is not in the file
}


class Model(Protocol):
    """Equations of a plant; the numbers stand in a :class:`~thermogrip.sysid.plant.plant.Plant`.

    ``kind`` says what reads a model back; ``inputs``, ``disturbances`` and ``outputs`` name u, d and y;
    ``switches`` are the inputs that are on or off, such as a pump; ``parameters`` name p, in order;
    ``spread`` is the prior covariance (n_x, n_x) of a state about :meth:`rest`, for estimating a start;
    ``smooth`` the seconds over which a disturbance is averaged, a step at least; ``command_steps`` what the
    driver of an input drops: all behind a multiple of this.
    """

    @property
    def kind(self) -> str: ...
    @property
    def inputs(self) -> tuple[str, ...]: ...
    @property
    def disturbances(self) -> tuple[str, ...]: ...
    @property
    def outputs(self) -> tuple[str, ...]: ...
    @property
    def switches(self) -> tuple[str, ...]: ...
    @property
    def n_x(self) -> int: ...
    @property
    def parameters(self) -> tuple[str, ...]: ...
    @property
    def spread(self) -> Array: ...
    @property
    def smooth(self) -> float: ...
    @property
    def command_steps(self) -> Mapping[str, float]: ...

    def rest(self, y: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike) -> Array:
        """Return the state (n_x,) of a plant at rest whose outputs read y, held by some input near u."""
        ...

    def step(
        self, x: Sequence[Any], u: Sequence[Any], d: Sequence[Any], p: Sequence[Any], dt: float
    ) -> list[Any]:
        """Return the state one step later; u and d are held over the step."""
        ...

    def output(self, x: Sequence[Any], p: Sequence[Any]) -> list[Any]:
        """Return the outputs at state x."""
        ...

    def rollout(
        self, x0: ArrayLike, u: ArrayLike, d: ArrayLike, p: ArrayLike, dt: float
    ) -> tuple[Array, Array]:
        """Simulate a batch: x0 (B, n_x), u (B|1, N, n_u), d (B|1, N, n_d), p (B|1, n_p).

        Returns y (B, N + 1, n_y), row 0 at x0, and the last state (B, n_x).
        """
        ...

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON; key ``kind`` says what reads it back."""
        ...


def check_spread(spread: Any) -> None:
    """Raise ValueError where the covariance of a state has a variance that is not positive."""
    found = np.asarray(spread, dtype=float)
    if found.ndim == 2 and not (np.diagonal(found) > 0).all():
        raise ValueError("spread has a variance that is not positive")


def load_model(content: Mapping[str, Any], *, code: Model | None = None) -> Model:
    """Return the model that ``Model.to_dict`` wrote, by its ``kind``."""
    kind = content.get("kind") if isinstance(content, Mapping) else None
    if not isinstance(kind, str) or kind not in _KINDS:
        raise UserError(f"model of kind {kind!r} is unknown", hint=f"it is one of {', '.join(_KINDS)}")
    if code is not None:
        restored = getattr(code, "restored", None)
        if restored is None or kind != code.kind:
            raise UserError(f"its model ({kind}) needs no class", hint="leave the class out")
        own: Model = restored(content)
        return own
    module, name = _KINDS[kind]
    model: Model = getattr(importlib.import_module(module), name).from_dict(content)
    return model


@runtime_checkable
class GreyModel(Model, Protocol):
    """Equations with priors.

    ``name`` is what tables call it; ``dt`` the step of the simulation [s]; ``specs`` unit, prior and bounds
    of each parameter; ``units`` those of signals and parameters; ``sensor_sd`` the sd of the mean over a bin
    about the model, by output; ``drift`` sd and correlation time [s] of the slow error, of the outputs that
    have one; ``nuisance`` how far each output and disturbance is off, from log to log; ``reference`` the
    output that has no offset of its own, if one does not; ``average`` the length of the bins of a fit [s],
    where none is asked for; ``independent`` the seconds per independent residual, until that is measured;
    ``warmup`` the seconds of a log from which a fit may estimate how it starts; ``search_step`` the step of a
    global search [s], which may be coarser.
    """

    @property
    def name(self) -> str: ...
    @property
    def dt(self) -> float: ...
    @property
    def specs(self) -> Mapping[str, Parameter]: ...
    @property
    def units(self) -> dict[str, str]: ...
    @property
    def states(self) -> tuple[str, ...]: ...
    @property
    def sensor_sd(self) -> dict[str, float]: ...
    @property
    def drift(self) -> dict[str, tuple[float, float]]: ...
    @property
    def nuisance(self) -> dict[str, float]: ...
    @property
    def reference(self) -> str | None: ...
    @property
    def average(self) -> float: ...
    @property
    def independent(self) -> float: ...
    @property
    def warmup(self) -> float: ...
    @property
    def search_step(self) -> float: ...

    def prepared(self, logs: Sequence[Log], p: Array | None = None, *, free_runs: FreeRuns) -> GreyModel:
        """Return the model made ready for these logs, its step short enough at p (at the prior where absent).

        The model itself where it is ready as it is.
        """
        ...


# (model, logs, p (n_p,)) -> (log's name, simulated outputs (1, N + 1, n_y)) of each stretch without a gap
FreeRuns = Callable[[GreyModel, Sequence[Log], Array], list[tuple[str, Array]]]


class Described:
    """The part of a :class:`GreyModel` that its tables answer.

    ``tables`` has ``inputs``, ``disturbances``, ``outputs`` and ``parameters`` by name, ``name`` and ``dt``.
    """

    def __init__(self, tables: Any) -> None:
        self.tables = tables
        self.name, self.dt = str(tables.name), float(tables.dt)
        groups = (tables.inputs, tables.disturbances, tables.outputs, tables.parameters)
        self.inputs, self.disturbances, self.outputs, self.parameters = map(tuple[str, ...], groups)
        self.switches = tuple(name for name, item in tables.inputs.items() if item.switch)
        self.specs: dict[str, Parameter] = dict(tables.parameters)
        self.units: dict[str, str] = {name: item.unit for group in groups for name, item in group.items()}
        sensors = (*tables.outputs.items(), *tables.disturbances.items())
        self.nuisance: dict[str, float] = {name: item.log_sd for name, item in sensors}

    @property
    def prior(self) -> Array:
        """Prior median (mean) of each parameter, shape (n_p,)."""
        return np.array([item.value for item in self.specs.values()])
