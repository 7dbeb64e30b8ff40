r"""A plant made linear about an operating point, and in the words of python-control, scipy.signal, CasADi.

About inputs u0, disturbances d0 and a state x0, by default the one in which the plant settles under them,

    x = x0 + dx,  w = (u0, d0) + dw,  y = y0 + dy:      dx+ = A dx + B dw,   dy = C dx        (step dt)
                                                  or   dx/dt = A dx + B dw,  dy = C dx        (continuous).

A switch stays where it is put.  Discrete is at a whole multiple of the plant's step, inputs held (zero-order
hold): the plant's own arithmetic, n steps composed.

python-control and scipy are handed these; CasADi one step of the plant itself, with exact derivatives.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import logm

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError, as_user_error, known_names
from thermogrip.datasets.files import KEY, atomic_path, provenance, write_atomic
from thermogrip.sysid.models.model import GreyModel, whole_steps

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant_data import PlantData

ROOM = 25.0  # degC, where no temperature of the room is given


@dataclass(frozen=True)
class LinearSettings:
    """Steps and tolerances of a linearisation."""

    difference_step: float = 1e-3  # of the larger of 1 and the value: exact for what is bilinear
    growth: float = 1e-6  # of the modulus of a pole beyond one, that rounding does not explain
    integrator: float = 1e-10  # of 1 - A, below which a state stays wherever it is put
    delay: float = 1e-8  # modulus of a discrete pole that represents a delay
    short_step: float = 1e-3  # of the plant's step: errors of 1e-7 by its order, of 1e-8 by rounding


LINEAR = LinearSettings()


@dataclass(frozen=True, eq=False)
class LinearPlant:
    """Matrices with names, in the plant's units, and the operating point that they are about."""

    A: Array  # (n_x, n_x)
    B: Array  # (n_x, n_w)
    C: Array  # (n_y, n_x)
    states: tuple[str, ...]
    inputs: tuple[str, ...]  # the plant's inputs that are no switches, then its disturbances
    outputs: tuple[str, ...]
    x: Array  # (n_x,), of the operating point
    w: Array  # (n_w,), of it
    y: Array  # (n_y,), of it
    dt: float | None  # step [s]; None is continuous time

    @property
    def D(self) -> Array:
        """The (n_y, n_w) direct term: none, for what is applied at a row acts from it on."""
        return np.zeros((len(self.outputs), len(self.inputs)))

    def gain(self) -> Array:
        """Return the (n_y, n_w) gain at rest."""
        n = np.eye(len(self.A)) if self.dt is not None else np.zeros_like(self.A)
        return np.asarray(self.C @ np.linalg.solve(n - self.A, self.B))


def linearise_plant(
    plant: PlantData,
    *,
    inputs: Mapping[str, float] | None = None,
    disturbances: Mapping[str, float] | None = None,
    state: ArrayLike | None = None,
    dt: float | None = None,
) -> LinearPlant:
    """Return the plant made linear about an operating point.

    Parameters
    ----------
    plant : Plant
    inputs, disturbances : mapping of name to float, optional
        Where they are held, in their units.  Inputs that are not named are at 0, switches on; temperatures
        that are measured are at 25 degC.
    state : (n_x,) array_like, optional
        Where the plant is, in the units of its states; by default where it settles.
    dt : float, optional
        Step [s], a whole multiple of the plant's; continuous time where absent.

    Raises
    ------
    UserError
        If a name is unknown, the plant does not settle or runs away there, dt is no multiple of its step, or
        there is no continuous equivalent.

    Examples
    --------
    >>> from thermogrip.sysid.greybox.problem import prior_plant
    >>> from thermogrip.sysid.models.network import load_network
    >>> heaters = prior_plant(load_network("tclab"))
    >>> near = linearise_plant(heaters, inputs={"q1": 30.0, "q2": 20.0})
    >>> near.states
    ('heater1', 'heater2', 't1_sensor', 't2_sensor')
    >>> near.y.round(1).tolist(), near.gain().round(2).tolist()  # degC, and degC per percent
    ([40.1, 34.5], [[0.49, 0.09], [0.12, 0.38]])
    """
    u, d = operating_point(plant, inputs, disturbances)

    def step(x: Array) -> tuple[Array, Array]:
        return states_after(plant, x[None], u[None], d[None])[0], discrete_matrices(plant, x, u, d, [])[0]

    if state is None:
        start = plant.model.rest(np.full(len(plant.outputs), ROOM), u, d, plant.p)
        x = settled(step, np.asarray(start, dtype=float))
    else:
        x = np.asarray(state, dtype=float)
    if x.shape != (plant.model.n_x,):
        raise UserError(f"the state has {x.size} numbers", hint=f"give {plant.model.n_x}")
    if not np.isfinite(x).all():
        hint = "name other inputs, or give the state yourself"
        raise UserError("the plant does not settle under these inputs", hint=hint)
    moved = [k for k, name in enumerate(plant.inputs) if name not in plant.model.switches]
    A, B = discrete_matrices(plant, x, u, d, moved)
    size = np.abs(np.linalg.eigvals(A))
    if size.max() > 1 + LINEAR.growth:
        seconds = plant.dt / np.log(size.max())
        raise UserError(
            f"the plant runs away at this point (it grows e-fold in {seconds:.3g} s)",
            hint="choose another point, or identify a model that is stable",
        )
    if dt is None:
        A, B = _continuous(plant, x, u, d, moved)
    else:
        A, B = composed(A, B, whole_steps(dt, plant.dt))
    C, level = output_matrix(plant)
    names = (*(plant.inputs[k] for k in moved), *plant.disturbances)
    w = np.concatenate([u[moved], d])
    labels = state_labels(plant)
    return LinearPlant(A, B, C, labels, names, plant.outputs, x, w, level + C @ x, dt)


def save_linear(near: LinearPlant, path: str | Path) -> Path:
    """Write the matrices, names and operating point as JSON or MATLAB file."""
    file = Path(path)
    matrices = {"A": near.A, "B": near.B, "C": near.C, "D": near.D}
    labels = {"states": near.states, "inputs": near.inputs, "outputs": near.outputs}
    point = {"x0": near.x, "u0": near.w, "y0": near.y}
    if file.suffix == ".mat":
        from scipy.io import savemat

        names = {name: np.array(words, dtype=object) for name, words in labels.items()}
        with atomic_path(file) as temporary:
            savemat(temporary, matrices | names | point | {"dt": near.dt or 0.0}, appendmat=False)
        return file
    numbers = {name: value.tolist() for name, value in (matrices | point).items()}
    lists = {name: list(words) for name, words in labels.items()}
    return write_atomic(file, json.dumps(numbers | lists | {"dt": near.dt, KEY: provenance()}) + "\n")


def operating_point(
    plant: PlantData, inputs: Mapping[str, float] | None, disturbances: Mapping[str, float] | None
) -> tuple[Array, Array]:
    """Return u (n_u,) and d (n_d,) from what is named of them; see :func:`linearise_plant`."""
    given_u, given_d = dict(inputs or {}), dict(disturbances or {})
    for name in (*given_u, *given_d):
        if name not in (plant.inputs if name in given_u else plant.disturbances):
            hint = known_names(name, plant.inputs + plant.disturbances, "its inputs and disturbances are {}")
            raise UserError(f"the plant has no {name} there", hint=hint)
    u = [given_u.get(name, 1.0 if name in plant.model.switches else 0.0) for name in plant.inputs]
    usual = np.nan_to_num(plant.undisturbed(ROOM)).tolist()
    d = [given_d.get(name, value) for name, value in zip(plant.disturbances, usual)]
    return np.array(u, dtype=float), np.array(d, dtype=float)


def state_labels(plant: PlantData) -> tuple[str, ...]:
    """Return names of the states without dots, which signal names may not have."""
    if not isinstance(plant.model, GreyModel):
        return tuple(f"x{k + 1}" for k in range(plant.model.n_x))
    return tuple(name.replace(".", "_") for name in plant.model.states)


def output_matrix(plant: PlantData) -> tuple[Array, Array]:
    """Return C (n_y, n_x) and the level (n_y,) of the outputs, which are affine in the state."""
    zero, *moved = (
        np.array(plant.model.output(row.tolist(), plant.p.tolist()), dtype=float)
        for row in np.eye(plant.model.n_x + 1, plant.model.n_x, -1)
    )
    return np.stack(moved, axis=1) - zero[:, None], zero


def states_after(plant: PlantData, x: Array, u: Array, d: Array, dt: float | None = None) -> Array:
    """Return the states (B, n_x) a step of ``dt`` [s], or of the plant, after x (B, n_x) under u (B, n_u), d
    (B, n_d)."""
    p = np.repeat(plant.p[None], len(x), axis=0)
    return np.asarray(plant.model.rollout(x, u[:, None], d[:, None], p, dt or plant.dt)[1])


def settled(step: Callable[[Array], tuple[Array, Array]], x: Array) -> Array:
    """Return the state (n_x,) that a step leaves as it is, by Newton's method from x, NaN where there is none
    or any may stay; ``step(x)`` is the state after it and its derivative (n_x, n_x)."""
    with np.errstate(all="ignore"):
        for _ in range(60):
            after, A = step(x)
            I_minus_A = np.eye(x.size) - A
            if not np.isfinite(A).all() or np.linalg.norm(I_minus_A, -2) < LINEAR.integrator:
                break
            move = np.linalg.solve(I_minus_A, after - x)
            x = np.asarray(x + np.clip(move, -100.0, 100.0))
            if np.max(np.abs(move)) < 1e-7 * max(1.0, float(np.abs(x).max())):
                return x
    return np.full(x.size, np.nan)


def discrete_matrices(
    plant: PlantData, x: Array, u: Array, d: Array, moved: Sequence[int], dt: float | None = None
) -> tuple[Array, Array]:
    """Return A, and B of ``moved`` inputs and then disturbances, of a step of ``dt`` [s], or of the plant."""
    # central differences are exact for anything bilinear; where a drive of a Peltier heats and cools with
    # different gains the slope at zero is the mean of the two
    point, ends = np.concatenate([x, u, d]), [x.size, x.size + u.size]
    columns = [*range(x.size), *(x.size + k for k in moved), *range(ends[1], point.size)]
    size = LINEAR.difference_step * np.maximum(1.0, np.abs(point[columns]))
    ahead = np.zeros((len(columns), point.size))
    ahead[np.arange(len(columns)), columns] = size
    around_x, around_u, around_d = np.split(np.vstack([point + ahead, point - ahead]), ends, axis=1)
    values = states_after(plant, around_x, around_u, around_d, dt)
    both = ((values[: len(columns)] - values[len(columns) :]) / (2 * size[:, None])).T
    return both[:, : x.size], both[:, x.size :]


def composed(A: Array, B: Array, n: int) -> tuple[Array, Array]:
    """Return the matrices of n steps with the input held."""
    n_x, n_w = B.shape
    whole = np.block([[A, B], [np.zeros((n_w, n_x)), np.eye(n_w)]])
    power = np.linalg.matrix_power(whole, n)
    return power[:n_x, :n_x], power[:n_x, n_x:]


def _continuous(plant: PlantData, x: Array, u: Array, d: Array, moved: Sequence[int]) -> tuple[Array, Array]:
    # the logarithm of [[A, B], [0, 1]] over a step undoes the hold: a step so short that its own error is
    # lost, or over that of a black box, which takes no other; a delay has none
    dt = plant.dt * (LINEAR.short_step if isinstance(plant.model, GreyModel) else 1.0)
    A, B = discrete_matrices(plant, x, u, d, moved, dt=dt)
    poles = np.linalg.eigvals(A)
    if np.abs(poles).min() < LINEAR.delay or np.any((np.abs(poles.imag) < 1e-9) & (poles.real <= 0)):
        raise UserError(
            "the black box has a delay or a pole below zero, which no continuous model has",
            hint=f"export it at its own step, dt={plant.dt:g}",
        )
    n_x, n_w = B.shape
    log: Array = np.real(logm(np.block([[A, B], [np.zeros((n_w, n_x)), np.eye(n_w)]]))) / dt
    return log[:n_x, :n_x], log[:n_x, n_x:]


def control_system(labels: Any, numbers: Sequence[Any], name: str) -> Any:
    """Return A, B, C, D, dt as a ``StateSpace`` with the inputs, outputs and states that ``labels`` has."""
    hint = "pip install 'thermogrip[control]', or pip install control"
    with as_user_error(ImportError, "control is not installed", hint=hint):
        import control
    return control.StateSpace(
        *numbers,
        **{group: list(getattr(labels, group)) for group in ("inputs", "outputs", "states")},
        name=name,
        remove_useless_states=False,
    )
