"""The model-predictive controller: a plant, a design, a file, and one move for each reading.

With a compiler a step is done in C (:mod:`thermogrip.mpc.controllers.compiled`), without one in Python, by
the same rules and with the same statuses: :mod:`thermogrip.mpc.controllers.reference` has them all.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError, reading
from thermogrip.media.rendering import Shown
from thermogrip.mpc.controllers.compiled import CompiledStep
from thermogrip.mpc.controllers.controller_file import Parts, read_parts
from thermogrip.mpc.controllers.linear_equivalent import to_control
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.controllers.reference import ReferenceController
from thermogrip.mpc.design.design import Design, check_design, default_design
from thermogrip.mpc.interface import Move, Readings, Trajectory
from thermogrip.mpc.native.runtime import wanted

if TYPE_CHECKING:
    from thermogrip.sysid.models.model import Model
    from thermogrip.sysid.plant.plant import Plant


class Controller(Shown):
    """Model-predictive controller of a plant.

    Parameters
    ----------
    plant : Plant
    design : Design, optional
        By default :func:`thermogrip.mpc.design.design.default_design`.
    notes : dict, optional
        What the tuner found, kept in the file.
    clock : callable, optional
        Where step times come from [s].

    Examples
    --------
    A heater with 40 K, 100 s and 5 s of delay, asked for 35 degC:

    >>> import numpy as np
    >>> from thermogrip.sysid import Plant
    >>> from thermogrip.sysid.models.state_space import StateSpaceModel
    >>> a = float(np.exp(-0.05))
    >>> A, B = [[a, 40 * (1 - a)], [0, 0]], [[0], [1]]
    >>> heater = StateSpaceModel(("q",), (), ("t",), A=A, B=B, C=[[1.0, 0]], dt=5.0, y0=[25.0])
    >>> controller = Controller(Plant(heater, {}, dt=5.0, units={"q": "1"}, valid={"q": (0.0, 1.0)}))
    >>> controller.reset({"t": 25.0})
    >>> move = controller.step({"t": 25.0}, 35.0)
    >>> move.status, round(move.drive, 3), controller.step({"t": float("nan")}, 35.0).status
    ('ok', 0.625, 'fallback_plan')
    """

    def __init__(
        self,
        plant: Plant,
        design: Design | None = None,
        *,
        notes: dict[str, Any] | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.plant, self.notes = plant, dict(notes or {})
        self.design = default_design(plant) if design is None else check_design(design, plant)
        self.reference = ReferenceController(plant, self.design, clock=clock)
        self.model, self.controlled, self.dt = self.reference.model, self.design.controlled, self.reference.dt
        self.safe_drives = self.reference.safe_drives
        self.observer, self.optimiser = self.reference.observer, self.reference.optimiser
        compiled = _compiled_step(self.reference)
        self._law: ReferenceController | CompiledStep = compiled or self.reference
        #: The C that does the steps; None where Python does.
        self.c = None if compiled is None else compiled.c

    @property
    def plan(self) -> Array | None:
        """The plan that is still ahead, (N, n_u)."""
        return self._law.plan

    def _facts(self) -> dict[str, object]:
        """Return what is regulated by what, how often, and of which plant."""
        ranges = (f"{name} {low:g} to {high:g}" for name, (low, high) in self.design.drive_range.items())
        facts: dict[str, object] = {
            "regulates": ", ".join(self.controlled),
            "by": ", ".join(ranges),
            "every": f"{self.dt:g} s",
        }
        return facts | {"model": self.plant.model.kind, "logs": ", ".join(self.plant.logs) or "none"}

    def save(self, path: str | Path) -> Path:
        """Write the controller with its plant as JSON and return the path."""
        return Parts("MPC", self.plant, self.design, self.notes).save(path)

    @classmethod
    def load(cls, path: str | Path, *, model: Model | None = None) -> Controller:
        """Return the controller that :meth:`save` wrote.

        Parameters
        ----------
        path : str or Path
        model : Model, optional
            The equations of its plant, where they are a class of the user's own; ignored otherwise.

        Raises
        ------
        UserError
            If the file is absent, is no controller, or its numbers make none.

        Examples
        --------
        >>> from thermogrip.sysid import Plant, load_network
        >>> kit = load_network("tclab")
        >>> p, heaters = dict(zip(kit.parameters, kit.prior)), dict.fromkeys(kit.inputs, (0.0, 100.0))
        >>> plant = Plant(kit, p, dt=kit.dt, units=kit.units, valid=heaters)
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     path = design_controller(plant, dt=5.0).save(f"{folder}/controller.json")
        ...     Controller.load(path).dt
        5.0
        """
        controller = load_controller(path, model=model)
        if not isinstance(controller, Controller):
            hint = "thermogrip.mpc.load_controller reads every kind"
            raise UserError("holds a PI, not an MPC", file=path, hint=hint)
        return controller

    def to_control(self) -> Any:
        """Return the controller without its limits as a python-control ``StateSpace`` from readings,
        ``target_<name>`` and measured disturbances to drives, all in changes from rest."""
        return to_control(self)

    def reset(self, reading: Readings) -> None:
        """Forget the past; the plant is at rest at this reading, its drive at zero or as the reading has it.

        Parameters
        ----------
        reading : mapping of str to float
            As for :meth:`step`.

        Examples
        --------
        >>> from thermogrip.sysid import Plant, load_network
        >>> kit = load_network("tclab")
        >>> p, heaters = dict(zip(kit.parameters, kit.prior)), dict.fromkeys(kit.inputs, (0.0, 100.0))
        >>> plant = Plant(kit, p, dt=kit.dt, units=kit.units, valid=heaters)
        >>> controller = design_controller(plant, dt=5.0)
        >>> controller.reset({"t1": 30.0, "t2": 30.0})
        >>> controller.plan is None
        True
        """
        self._law.reset(reading)

    def step(self, reading: Readings, target: Trajectory) -> Move:
        """Return the move for this sample.

        Parameters
        ----------
        reading : mapping of str to float
            Temperatures by name [degC]; ``time_s`` may be absent, then one sample time has passed.  Before
            its sample time is over a move is held, but for a target that has stood for a sample time and is
            another one now; the seconds count all the same.  A drive's
            own name may stand there too: then that is what was applied, whatever was asked.  So may that of a
            switch (``"pump": 0``): then no water moves the heat, and the drive goes to zero until it runs.
        target : float or mapping of str to float
            [degC] by output name; a single number is the target of every controlled output. A sequence is a
            trajectory: the target now, and those of the samples ahead.

        Examples
        --------
        >>> from thermogrip.sysid import Plant, load_network
        >>> kit = load_network("tclab")
        >>> p, heaters = dict(zip(kit.parameters, kit.prior)), dict.fromkeys(kit.inputs, (0.0, 100.0))
        >>> plant = Plant(kit, p, dt=kit.dt, units=kit.units, valid=heaters)
        >>> controller = design_controller(plant, dt=5.0)
        >>> controller.reset({"t1": 25.0, "t2": 25.0})
        >>> move = controller.step({"t1": 25.0, "t2": 25.0}, {"t1": 40.0, "t2": 30.0})
        >>> move.status, {name: round(value, 1) for name, value in move.drive.items()}
        ('ok', {'q1': 62.5, 'q2': 62.5})
        """
        return self._law.step(reading, target)


def _compiled_step(reference: ReferenceController) -> CompiledStep | None:
    """Return the steps in C, None where there is no compiler, or nobody wants one."""
    if not wanted():
        return None
    try:
        return CompiledStep(reference)
    except (RuntimeError, NotImplementedError, TypeError, OSError) as error:
        # a gcc without headers, a step that has no C, a home that cannot be written
        warnings.warn(f"the controller's steps run in Python, slower: {error}", stacklevel=3)
        return None


def design_controller(plant: Plant, **changes: Any) -> Controller:
    """Return a controller of the plant's default design, with any field of Design changed.

    Parameters
    ----------
    plant : Plant
    **changes
        ``controlled``, ``dt``, and any other field of :class:`thermogrip.mpc.design.design.Design`.

    Examples
    --------
    >>> from thermogrip.sysid import Plant, load_network
    >>> kit = load_network("tclab")
    >>> p, heaters = dict(zip(kit.parameters, kit.prior)), dict.fromkeys(kit.inputs, (0.0, 100.0))
    >>> plant = Plant(kit, p, dt=kit.dt, units=kit.units, valid=heaters)
    >>> controller = design_controller(plant, controlled=("t1",), move=2.0)
    >>> controller.dt, controller.design.move
    (2.0, 2.0)
    """
    return Controller(plant, default_design(plant, **changes))


def load_controller(path: str | Path, *, model: Model | None = None) -> Controller | PIController:
    """Return the controller of a file, of whatever kind.

    Parameters
    ----------
    path : str or Path
    model : Model, optional
        The equations of its plant, where they are a class of the user's own; ignored otherwise.

    Raises
    ------
    UserError
        If the file is absent, is no controller, or its numbers make none.

    Examples
    --------
    >>> from thermogrip.sysid import Plant, load_network
    >>> from thermogrip.mpc import PIController, load_controller
    >>> kit = load_network("tclab")
    >>> p, heaters = dict(zip(kit.parameters, kit.prior)), dict.fromkeys(kit.inputs, (0.0, 100.0))
    >>> plant = Plant(kit, p, dt=kit.dt, units=kit.units, valid=heaters)
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = PIController(plant, dt=5.0).save(f"{folder}/controller.json")
    ...     type(load_controller(path)).__name__
    'PIController'
    """
    # numbers each of which may be can leave no gain or no estimate together
    with reading("its numbers make no controller", file=path, hint="tune the controller again"):
        content = read_parts(path, model=model)
        kind = PIController if content.kind == "PI" else Controller
        return kind(content.plant, content.design, notes=content.notes)
