"""A plant and a controller once more, from a closed loop in which the old one was not the plant.

The logs that the plant came from, with the log of the loop, give a plant of the same kind (the same network,
or black boxes anew).  Both plants run freely over the last 30 percent of the loop, to which neither was
fitted: the new one is fitted without them first.  If it errs less by a tenth the controller is tuned on it
with the spec of the old one, and both close the loop on its draws.

In a closed loop the drives answer to noise and disturbances.  A free run does not: its errors are the plant's
alone, whatever the drives were, as long as targets moved them (a direct method, output errors [1]_).

References
----------
.. [1] L. Ljung, System Identification: Theory for the User, 2nd ed., Prentice Hall, 1999, section 13.4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, cast

import numpy as np

from thermogrip.datasets.parallel import Progress, Workers, sub_progress
from thermogrip.datasets.schema import Log
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.design.spec import Spec
from thermogrip.mpc.tuning.objective import StepResult, draws_of, run_trials, steps_on
from thermogrip.mpc.tuning.tune import Tuning, tune
from thermogrip.sysid.identification import Identification, identify
from thermogrip.sysid.models.model import BlackBox
from thermogrip.sysid.validation.held_out import cases_of, run_held_out

if TYPE_CHECKING:
    from thermogrip.sysid.models.model import GreyModel
    from thermogrip.sysid.plant.plant import Plant

_BETTER = 0.9  # of the old plant's error, below which the new one is taken


@dataclass(frozen=True)
class RunError:
    """Errors of an output over the end of the loop."""

    output: str
    unit: str
    old: float
    new: float


@dataclass(frozen=True)
class Retuning:
    """What a closed loop taught."""

    identification: Identification
    errors: tuple[RunError, ...]
    tuning: Tuning | None  # None where the new plant is no better
    old: tuple[StepResult, ...]  # the old and the new controller on draws of the new plant
    new: tuple[StepResult, ...]

    @property
    def better(self) -> bool:
        """Whether the new plant errs less by a tenth: the geometric mean over its outputs."""
        ratios = [np.log(max(error.new, 1e-12) / max(error.old, 1e-12)) for error in self.errors]
        return bool(np.mean(ratios) < np.log(_BETTER))


def retune(
    controller: Controller | PIController,
    loop: Log,
    logs: Sequence[Log] = (),
    *,
    spec: Spec | None = None,
    progress: Progress | None = None,
    workers: Workers = 1,
    seed: int = 0,
) -> Retuning:
    """Return the controller for the plant that a closed loop shows.

    Parameters
    ----------
    controller : Controller or PIController
        That closed the loop.
    loop : Log
        The loop's.
    logs : sequence of Log, optional
        Those that the controller's plant came from.
    spec : Spec, optional
        What is wanted; the defaults where absent.
    progress : callable, optional
        Called with (fraction done, what is being done).
    workers : int or str, optional
        Local processes for the identification, or the address of a Dask cluster.
    seed : int, optional

    Raises
    ------
    UserError
        If no plant can be identified or tuned for.

    Examples
    --------
    >>> retune(Controller.load("controller.json"), read_log("run/samples.csv"))  # doctest: +SKIP
    """
    spec = Spec() if spec is None else spec
    found = _identified(controller.plant, [loop, *logs], sub_progress(progress, 0.0, 0.3), workers, seed)
    result = Retuning(found, _errors(controller.plant, found, loop), None, (), ())
    if not result.better:
        return result
    tuned = tune(found.plant, spec, progress=sub_progress(progress, 0.3, 0.9), seed=seed)
    plant, both = tuned.controller.plant, (controller, tuned.controller)
    cases = steps_on(spec, draws_of(plant, spec.check_draws))
    old, new = (tuple(run_trials(c, plant, spec, cases, seed=seed)) for c in both)
    return Retuning(found, result.errors, tuned, old, new)


def _identified(
    plant: Plant, logs: Sequence[Log], progress: Progress | None, workers: Workers, seed: int
) -> Identification:
    """Return what is found of a plant of the same kind."""
    again = partial(identify, logs, seed=seed, workers=workers, progress=progress)
    if isinstance(plant.model, BlackBox):
        return again(inputs=plant.inputs, outputs=plant.outputs, disturbances=plant.disturbances)
    return again(network=cast("GreyModel", plant.model), models=("network",))


def _errors(old: Plant, found: Identification, loop: Log) -> tuple[RunError, ...]:
    """Return the errors of both plants over the end of the loop, the new one fitted without it."""
    [case] = cases_of([loop], leave_one_out=False)
    [held] = case.held
    scores = run_held_out(old, held).scores
    own = [row for row in found.rows if row.held_out and (row.model, row.log) == (found.model, held.name)]
    return tuple(RunError(row.output, row.unit, scores[row.output].rmse, row.rmse) for row in own)
