"""Equations without numbers: what every model offers, and which class reads a saved one back.

With the state x, the inputs u, the measured disturbances d and the parameters p,

    x+ = step(x, u, d, p, dt),        y = output(x, p),

both in plain arithmetic, so that NumPy rows and CasADi symbols run the same lines.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermogrip.datasets.errors import UserError

__all__ = ["Array", "Model", "load_model"]

Array = NDArray[np.float64]

# Which class reads a saved model, by its kind; a file can name no other code.
_KINDS = {
    "network": ("thermogrip.sysid.models.network", "NetworkModel"),
    "statespace": ("thermogrip.sysid.models.state_space", "StateSpaceModel"),
    "neural": ("thermogrip.sysid.models.neural", "NeuralModel"),
    "sindy": ("thermogrip.sysid.models.polynomial", "SindyModel"),
    "own": ("thermogrip.sysid.models.user_model", "OwnModel"),  # which refuses: its code is not in the file
}


class Model(Protocol):
    """Equations of a plant; the numbers stand in a :class:`Plant`."""

    @property
    def kind(self) -> str:
        """What reads it back: ``"network"``, ``"statespace"``, ``"neural"``, ``"sindy"``."""
        ...

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of u."""
        ...

    @property
    def disturbances(self) -> tuple[str, ...]:
        """Names of d."""
        ...

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of y."""
        ...

    @property
    def switches(self) -> tuple[str, ...]:
        """The inputs that are on or off, such as a pump."""
        ...

    @property
    def n_x(self) -> int:
        """Number of states."""
        ...

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of p, in order."""
        ...

    @property
    def spread(self) -> Array:
        """Prior covariance (n_x, n_x) of a state about :meth:`rest`, for estimating a start."""
        ...

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


def load_model(content: Mapping[str, Any], *, code: Model | None = None) -> Model:
    """Return the model that ``Model.to_dict`` wrote, by its ``kind``.

    Parameters
    ----------
    content : dict
    code : Model, optional
        The equations of a model of the user's own, which no file holds.

    Raises
    ------
    UserError
        If the kind is unknown or the model's own reader refuses.

    Examples
    --------
    >>> try:
    ...     load_model({"kind": "pickle"})
    ... except UserError as error:
    ...     print(error)
    model of kind 'pickle' is unknown; it is one of network, statespace, neural, sindy, own
    """
    kind = content.get("kind") if isinstance(content, Mapping) else None
    if not isinstance(kind, str) or kind not in _KINDS:
        raise UserError(f"model of kind {kind!r} is unknown", mend=f"it is one of {', '.join(_KINDS)}")
    if code is not None:
        restored = getattr(code, "restored", None)
        if restored is None or kind != code.kind:
            raise UserError(f"its model ({kind}) needs no class", mend="leave the class out")
        own: Model = restored(content)
        return own
    module, name = _KINDS[kind]
    model: Model = getattr(importlib.import_module(module), name).from_dict(content)
    return model
