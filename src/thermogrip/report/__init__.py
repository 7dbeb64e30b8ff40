"""Pages, plots and tables: what results look like."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from thermogrip.classify import Comparison
    from thermogrip.mpc.closed_loop.simulate import ClosedLoop
    from thermogrip.sysid import Plant
    from thermogrip.sysid.identification import Identification
    from thermogrip.sysid.validation import FreeRun

__all__ = ["plot"]


def plot(result: Identification | FreeRun | Plant | ClosedLoop | Comparison, *, bode: bool = False) -> Figure:
    """Draw a result as its page shows it.

    Parameters
    ----------
    result : Identification, FreeRun, Plant, ClosedLoop or Comparison
        Measured and simulated outputs, over what was held out where a model was identified; step responses
        about the middle of the logs; outputs and drives; accuracies with their intervals.
    bode : bool, optional
        Of a plant: frequency responses in place of the step responses.

    Returns
    -------
    figure : matplotlib.figure.Figure
        Made without ``pyplot``; ``figure.savefig("plot.png")`` writes it.

    Raises
    ------
    TypeError
        If there is no picture of such a result.

    Examples
    --------
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> from thermogrip.classify import evaluate
    >>> comparison = evaluate(["features-lda"], [load_example_grasps()["exp2_dT20"]], probe=False)
    >>> plot(comparison).axes[0].get_xlabel()
    'accuracy on test grasps'
    """
    from thermogrip.classify.evaluation.comparison import Comparison
    from thermogrip.classify.figures import accuracy_figure
    from thermogrip.mpc.closed_loop.simulate import ClosedLoop
    from thermogrip.report.charts import draw_chart
    from thermogrip.report.plant import bode_chart, free_run_chart, step_response_chart
    from thermogrip.report.plots import closed_loop_chart
    from thermogrip.sysid.export.dynamics import plant_dynamics
    from thermogrip.sysid.identification import Identification
    from thermogrip.sysid.plant.plant import Plant
    from thermogrip.sysid.validation.free_run import FreeRun

    if isinstance(result, Identification):
        result = next(iter(result.held_out_runs.values()), result.runs[0])
    if isinstance(result, FreeRun):
        return draw_chart(free_run_chart(result, tuple(result.scores)))
    if isinstance(result, Plant):
        dynamics = plant_dynamics(result)
        return draw_chart(bode_chart(dynamics) if bode else step_response_chart(dynamics))
    if isinstance(result, ClosedLoop):
        return draw_chart(closed_loop_chart(result))
    if isinstance(result, Comparison):
        return accuracy_figure(result)
    raise TypeError(f"there is no picture of a {type(result).__name__}")
