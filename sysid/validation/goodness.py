"""Whether a plant may be called good, and what puts it in doubt.

Over all parts held out, and over the logs of the fit, each output errs by less than half of the error without
input; a part in which nothing moves, where nothing can be better, weighs nothing.  On another run like these
it errs by X (:func:`thermogrip.sysid.validation.prediction_bands.expected_error`), and X is below half of the
error without input over whole logs.  A single part that was much worse than the others, of moves that no
other part has, widens the range of X and condemns no plant: the fit has seen that part in the end.

An output that half of the parts hardly excite may pass so far and be worse than no input on another run. So
where the parts show how they differ (two or more have moves) it has to err less than no input on another
part in 19 cases of 20: with e_f and b_f the errors on part f and those without input, ln (e_f / b_f) is
Student's t about its mean, weighted by b_f^2, with the same prior for its spread as in the error of another
run.  Of 11 outputs of public logs that were called good one was worse than no input on its log's other half,
and this alone shows it: there .95 of parts lie below 1.17, of the others below .06 to .79.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import stdtrit

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.data.data_quality import DataCheck
from thermogrip.sysid.plant.fit_record import RUN_GAIN_SD, SEVERAL
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.validation.held_out import Row, network_name
from thermogrip.sysid.validation.prediction_bands import PRIOR_PARTS, PRIOR_SPREAD

USEFUL = 0.5  # of the no-input error: below it a model is called good
FAR_FROM_PRIOR = 3.3  # sd: beyond it lies one parameter of a right network in a thousand


def verdict_of(
    model: str, plant: Plant, rows: Sequence[Row], checked: DataCheck, doubts: Sequence[str] = ()
) -> tuple[bool, str]:
    """Return whether the kept candidate may be called good, and in sentences why, and how much another run
    should err; a doubt forbids it."""
    expected, named = plant.scores.expected, network_name(plant)
    label = f"network {named}" if named else model
    errors = ", ".join(f"{name} {each.words(plant.units.get(name, '1'))}" for name, each in expected.items())
    another = f"Expected error of another run like these: {errors}."
    if 0 < len(plant.logs) < SEVERAL:
        another += f" That gains vary by {100 * RUN_GAIN_SD:.0f} % from run to run is assumed; {SEVERAL} "
        another += "logs would show it."
    kept = [row for row in rows if row.model == model]
    for name, error in expected.items():
        parts, parts_idle = _pooled([row for row in kept if row.output == name and row.held_out])
        whole, whole_idle = _pooled([row for row in kept if row.output == name and not row.held_out])
        if not parts < USEFUL * parts_idle:
            errs = f"on parts held out {name} errs by {parts:.2g}, without input by {parts_idle:.2g}"
            return False, f"Not good ({label}): {errs}; it needs more excitation, or another model. {another}"
        worst = _ratio_on_another_part([row for row in kept if row.output == name and row.held_out])
        if not worst < 1:
            errs = f"on another part {name} may err {worst:.2g} times as much as without input"
            return False, f"Not good ({label}): {errs}; it needs more excitation, or another model. {another}"
        if not whole < USEFUL * whole_idle:
            errs = f"on the logs of its own fit {name} errs by {whole:.2g}, without input by {whole_idle:.2g}"
            return False, f"Not good ({label}): {errs}; try other models, or longer logs. {another}"
        if not error.rmse < USEFUL * whole_idle:
            errs = f"without input {name} errs by {whole_idle:.2g}, so on another run it may be hardly better"
            return False, f"Not good ({label}): {errs}; it needs more excitation, or more logs. {another}"
    failed = [finding.says for finding in checked.findings if finding.verdict == "fail"]
    if failed:
        return False, f"Not good ({label}): {failed[0]}. {another}"
    if doubts:
        more = f" (and {len(doubts) - 1} more)" if len(doubts) > 1 else ""
        return False, f"Not good ({label}) as long as this is in doubt: {doubts[0]}{more}. {another}"
    return True, f"Good for simulation and control on runs like these ({label}). {another}"


def _pooled(rows: Sequence[Row]) -> tuple[float, float]:
    """Return the rms errors of a candidate and of no input over all of some rows: a part in which nothing
    moves weighs nothing."""
    both = [(row.rmse, row.no_input_rmse) for row in rows] or [(0.0, np.inf)]
    error, idle = np.sqrt(np.mean(np.square(both), axis=0)).tolist()
    return error, idle


def _ratio_on_another_part(rows: Sequence[Row]) -> float:
    """Return below what the error over that without input stays on another part, in 19 cases of 20, as in
    the module's theory; 0 where one part alone has moves."""
    no_input = np.array([row.no_input_rmse for row in rows if row.no_input_rmse > 0])
    if not no_input.size:
        return 0.0
    errors = np.array([row.rmse for row in rows if row.no_input_rmse > 0])
    logs = np.log(np.maximum(errors, 1e-12) / no_input)
    weights = no_input**2 / np.sum(no_input**2)
    n, middle = float(1 / np.sum(weights**2)), float(weights @ logs)
    if n < 2:
        return 0.0
    freedom = PRIOR_PARTS + n - 1
    squares = PRIOR_PARTS * PRIOR_SPREAD**2 + n * float(weights @ (logs - middle) ** 2)
    scale = np.sqrt(squares / freedom * (1 + 1 / n))
    return float(np.exp(middle + scale * stdtrit(freedom, 0.95)))


def doubts_of(plant: Plant) -> list[str]:
    """Return what of a plant itself is not certain, a line each."""
    return [*_far_from_prior(plant), *_heaters_that_cool(plant)]


def _far_from_prior(plant: Plant) -> list[str]:
    specs, out = getattr(plant.model, "specs", {}), []
    for name in plant.free:
        spec, value = specs[name], plant.values[name]
        off = (
            np.log(value / spec.value) / spec.sd_log
            if spec.sd_log
            else (value - spec.value) / (spec.sd or np.inf)
        )
        if abs(off) > FAR_FROM_PRIOR:
            unit = plant.units.get(name, "1")
            out.append(
                f"{name} of the network {network_name(plant)} is fitted as "
                f"{value:.3g}{'' if unit == '1' else f' {unit}'}, "
                f"{abs(off):.1f} standard deviations of its prior from {spec.value:.3g}: is it that plant?"
            )
    return out


def _heaters_that_cool(plant: Plant) -> list[str]:
    heaters = [name for name in plant.inputs if "heat" in name.lower()]
    warmed = [name for name in plant.outputs if plant.units.get(name) == "degC"]
    if not heaters or not warmed:
        return []
    from thermogrip.sysid.export.dynamics import plant_dynamics

    try:
        found = plant_dynamics(plant, draws=0)
    except UserError:  # it does not settle
        return []
    gains = {(row["input"], row["output"]): row["gain"] for row in found.rows()}
    return [
        f"{heater} lowers {output} (gain {gains[heater, output]:.2g}): recorded in closed loop, or not what "
        "heats it?"
        for heater in heaters
        for output in warmed
        if gains.get((heater, output), 0.0) < 0
    ]
