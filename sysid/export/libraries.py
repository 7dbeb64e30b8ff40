"""A plant in the words of other libraries: python-control, scipy.signal, CasADi.

:func:`to_control` and :func:`to_scipy` are linear, about an operating point
(:mod:`thermogrip.sysid.export.linearise`); :func:`to_casadi` is one step of the plant itself, for
optimisation, with exact derivatives.  The nonlinear plant as an FMU is in
:mod:`thermogrip.sysid.export.fmu`.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.export.linearise import LinearPlant, linearise_plant, steps_in

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant


def to_control(
    plant: Plant,
    *,
    inputs: Mapping[str, float] | None = None,
    disturbances: Mapping[str, float] | None = None,
    state: ArrayLike | None = None,
    dt: float | None = None,
) -> Any:
    """Return the plant about an operating point as a python-control ``StateSpace``.

    Its signals are changes from that point, by the plant's names (dots in the names of states become
    underscores); :func:`thermogrip.sysid.export.linearise.linearise_plant` with the same arguments has the
    point.

    Parameters
    ----------
    plant, inputs, disturbances, state, dt
        As for :func:`thermogrip.sysid.export.linearise.linearise_plant`.

    Raises
    ------
    UserError
        If ``control`` is not installed, or there is no linear model at the point.

    Examples
    --------
    >>> from thermogrip.sysid.greybox.problem import prior_plant
    >>> from thermogrip.sysid.models.network import load_network
    >>> system = to_control(prior_plant(load_network("tclab")), inputs={"q1": 30.0})
    >>> system.input_labels, system.output_labels, bool(max(system.poles().real) < 0)
    (['q1', 'q2'], ['t1', 't2'], True)
    """
    near = linearise_plant(plant, inputs=inputs, disturbances=disturbances, state=state, dt=dt)
    D = np.zeros((len(near.outputs), len(near.inputs)))
    return control_system(near, (near.A, near.B, near.C, D, near.dt or 0), near.name)


def control_system(labels: Any, numbers: Sequence[Any], name: str) -> Any:
    """Return A, B, C, D, dt as a ``StateSpace`` with the inputs, outputs and states that ``labels`` has."""
    return needed("control", "control").StateSpace(
        *numbers,
        **{what: list(getattr(labels, what)) for what in ("inputs", "outputs", "states")},
        name=name,
        remove_useless_states=False,
    )


def to_scipy(
    plant: Plant,
    *,
    inputs: Mapping[str, float] | None = None,
    disturbances: Mapping[str, float] | None = None,
    state: ArrayLike | None = None,
    dt: float | None = None,
) -> Any:
    """Return the plant about an operating point as a ``scipy.signal.StateSpace``, discrete where dt is given.

    scipy names no signals: inputs are the plant's without its switches, then its disturbances, in order.

    Parameters
    ----------
    plant, inputs, disturbances, state, dt
        As for :func:`thermogrip.sysid.export.linearise.linearise_plant`.

    Examples
    --------
    >>> from thermogrip.sysid.greybox.problem import prior_plant
    >>> from thermogrip.sysid.models.network import load_network
    >>> system = to_scipy(prior_plant(load_network("tclab")), inputs={"q1": 30.0}, dt=2.0)
    >>> type(system).__name__, system.dt, bool(np.abs(np.linalg.eigvals(system.A)).max() < 1)
    ('StateSpaceDiscrete', 2.0, True)
    """
    from scipy import signal

    near: LinearPlant = linearise_plant(plant, inputs=inputs, disturbances=disturbances, state=state, dt=dt)
    D = np.zeros((len(near.outputs), len(near.inputs)))
    if dt is None:
        return signal.StateSpace(near.A, near.B, near.C, D)
    return signal.StateSpace(near.A, near.B, near.C, D, dt=dt)


def to_casadi(plant: Plant, *, dt: float | None = None) -> Any:
    """Return one step of the plant as a CasADi ``Function`` (x, u, d, p) -> (x_next, y).

    y is what the sensors read at x, before the step.  The order within x, u, d, p and y is that of
    :func:`~thermogrip.sysid.export.linearise.state_labels`, ``plant.inputs`` (switches among them),
    ``plant.disturbances``, ``plant.model.parameters`` and ``plant.outputs``; ``plant.p`` are its parameters.

    Parameters
    ----------
    plant : Plant
    dt : float, optional
        Length of the step [s], a whole multiple of the plant's, which it is where absent.

    Raises
    ------
    UserError
        If dt is no multiple, or a model of the user's own cannot be written in symbols.

    Examples
    --------
    >>> from thermogrip.sysid.greybox.problem import prior_plant
    >>> from thermogrip.sysid.models.network import load_network
    >>> plant = prior_plant(load_network("tclab"))
    >>> step = to_casadi(plant)
    >>> step
    Function(step:(x[4],u[2],d[0],p[11])->(x_next[4],y[2]) SXFunction)
    """
    import casadi as ca

    model = plant.model
    n = 1 if dt is None else steps_in(plant, dt)
    sizes = (model.n_x, len(model.inputs), len(model.disturbances), len(model.parameters))
    x, u, d, p = (ca.SX.sym(name, size) for name, size in zip(("x", "u", "d", "p"), sizes))
    state = ca.vertsplit(x)
    inputs, disturbances, parameters = (ca.vertsplit(v) if v.numel() else [] for v in (u, d, p))
    try:
        y = model.output(state, parameters)
        for _ in range(n):
            state = model.step(state, inputs, disturbances, parameters, plant.dt)
        ports = [x, u, d, p], [ca.vertcat(*state), ca.vertcat(*y)]
        return ca.Function("step", *ports, ["x", "u", "d", "p"], ["x_next", "y"])
    except (TypeError, NotImplementedError, AttributeError, RuntimeError) as error:
        if model.kind != "own":
            raise
        raise UserError(
            f"the class cannot be written in symbols ({type(error).__name__}: {error})".splitlines()[0],
            hint="use plain arithmetic in it, and no branch on a state, an input or a parameter",
        ) from error


def needed(module: str, extra: str) -> Any:
    """Return an optional library, or raise the one line that says how to install it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.split(".")[0]
        raise UserError(
            f"{package} is not installed", hint=f"pip install 'thermogrip[{extra}]', or pip install {package}"
        ) from error
