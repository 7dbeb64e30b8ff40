"""Whether a plant may be called good, and what a free run says of it, by the size of errors.

**Good** (`identify`).  Over all parts held out, and over the logs of the fit, each output errs by less than
half of the error without input.  On another run like these it errs by X
(:func:`thermogrip.sysid.validation.prediction_bands.expected_error`), below half of the error without input
over whole logs, and where two or more parts have moves, less than no input on another part in 19 cases of 20.

**A free run** (`validate`) is judged by size (``docs/explanation/validation.md``). A plant states for this
run the rms error X of each output, and the ends that 9 of 10 runs lie within. With e the error and b that of
the best decay without input, both of the same readings, it is better, as stated, worse, of another plant or
no test.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.plant.fit_record import RUN_GAIN_SD, SEVERAL

if TYPE_CHECKING:
    from thermogrip.sysid.data.data_quality import DataCheck
    from thermogrip.sysid.plant.plant import Plant
    from thermogrip.sysid.validation.prediction_bands import Band, InputEffect


NO_BETTER = 0.8  # of the no-input error: a free run above it has not shown that the input matters
MOST = 0.5  # of the squared error

Standing: TypeAlias = Literal["as stated", "better", "worse", "another plant", "no test"]
Cause: TypeAlias = Literal["", "gain", "slow", "offset", "start", "dynamics", "seen", "too little input"]

_MEANING: dict[Standing, str] = {
    "as stated": "the error is as stated",
    "better": "the error is smaller than stated",
    "worse": "the error is larger than stated",
    "another plant": "this is another plant, predicted no better than without input",
    "no test": "no test of the plant",
}
_BECAUSE: dict[Cause, str] = {
    "": "",
    "slow": "slow terms are missing, for inputs do more or less later",
    "offset": "most of it is a constant offset",
    "start": "most of it is the start, for the readings of the warm-up do not set the slow states",
    "dynamics": "the plant is not what it was in the fit, or was never run like this",
    "seen": "the rows are in the fit; another log is a test",
    "too little input": "the inputs do too little here",
}
USEFUL = 0.5  # of the no-input error: below it a model is called good
FAR_FROM_PRIOR = 3.3  # sd: beyond it lies one parameter of a right network in a thousand


@dataclass(frozen=True)
class Row:
    """One line of the table: one model, one log, one output."""

    model: str  # kind of the candidate
    structure: str  # its orders, delays or network
    log: str  # what was simulated
    output: str
    rmse: float  # of the free run
    fit_percent: float
    unit: str  # of the output
    n: int  # scored samples
    no_input_rmse: float  # the same of the no-input baseline
    held_out: bool  # whether the model was fitted without these rows


@dataclass(frozen=True)
class Verdict:
    """How far a free run bears its plant out."""

    standing: Standing
    over_stated: dict[str, float]  # error over the stated one, by output
    cause: Cause = ""  # by what it is worse, or why it is no test
    gain: float | None = None  # by how large a share inputs did more than in the fit, where that is the cause

    def __str__(self) -> str:
        times = ", ".join(f"{name} {ratio:.2g}" for name, ratio in self.over_stated.items())
        because = _BECAUSE.get(self.cause, "")
        if self.gain is not None:
            because = f"inputs do {100 * abs(self.gain):.0f} % {'more' if self.gain > 0 else 'less'}"
        words = _MEANING[self.standing] + (f": {because}" if because else "")
        return f"{words} (times the stated error: {times})"


def judge(
    band: Band,
    errors: Mapping[str, float],
    no_input: Mapping[str, float],
    *,
    causes: Mapping[str, Mapping[Cause, float]],
    by_inputs: InputEffect | None,
    seen: bool,
) -> Verdict:
    """Return the verdict on a run, by output: its rms errors, those of the no-input baseline, and of the
    start and of an offset the share of its squared error. ``seen``: its rows were in the fit."""
    stated = {name: size for name, size in band.expected.items() if size > 0}
    over = {name: error / stated[name] if name in stated else float("nan") for name, error in errors.items()}
    # X > 0.8 b: no right plant could have done better than without input
    hopeless = {name for name, size in stated.items() if size > NO_BETTER * no_input[name]}
    most = {name: no_input[name] * (1 / NO_BETTER if name in hopeless else NO_BETTER) for name in stated}
    # e > 0.8 b, and where that is hopeless clearly worse than b, e > b / 0.8
    lost = {name for name in stated if not errors[name] <= most[name]}
    # e above the high end, or above X and no better than without input, or most of it what inputs do
    worse = [
        name
        for name in stated
        if not errors[name] <= band.likely[name][1]
        or (over[name] > 1 and (name in lost or by_inputs is not None))
    ]
    if worse:
        worst = max(worse, key=lambda name: over[name])
        # the run diverged
        if not np.isfinite(errors[worst]):
            return Verdict("another plant", over, "dynamics")
        if by_inputs is not None and by_inputs.lag_s == 0:
            return Verdict("worse", over, "gain", by_inputs.gain)
        if by_inputs is not None:
            return Verdict("worse", over, "slow")
        # an offset or its start where one of them is most of the squared error, else its dynamics
        shares = causes.get(worst, {})
        cause = max(shares, key=lambda each: shares[each], default=None)
        if cause is not None and shares[cause] > MOST:
            return Verdict("worse", over, cause)
        # without one cause, and no better than without input
        return Verdict("another plant" if worst in lost else "worse", over, "dynamics")
    if seen:
        return Verdict("no test", over, "seen")
    if stated and len(hopeless) == len(stated):
        return Verdict("no test", over, "too little input")
    # e below the low end, every output
    better = bool(stated) and all(errors[name] < band.likely[name][0] for name in stated)
    return Verdict("better" if better else "as stated", over)


def verdict_of(
    model: str, plant: Plant, rows: Sequence[Row], checked: DataCheck, doubts: Sequence[str] = ()
) -> tuple[bool, str]:
    """Return whether the kept candidate may be called good, and in sentences why, and how much another run
    should err; a doubt forbids it."""
    expected, named = plant.scores.expected, network_name(plant)
    label = f"network {named}" if named else model
    errors = ", ".join(f"{name} {each.words(plant.units.get(name, '1'))}" for name, each in expected.items())
    another = f"Expected error of another run like these: {errors}."
    without = {name: each.same_gain for name, each in expected.items() if each.same_gain is not None}
    if without:
        sizes = ", ".join(
            f"{n} {e:.2g} {plant.units.get(n, '1')}".removesuffix(" 1") for n, e in without.items()
        )
        another += f" It would be {sizes}, were gains the same from run to run: that they vary by "
        another += f"{100 * RUN_GAIN_SD:.0f} % is assumed; {SEVERAL} logs would show it."
    own_rows = [row for row in rows if row.model == model]
    for name, error in expected.items():
        part_error, parts_idle = _pooled([row for row in own_rows if row.output == name and row.held_out])
        whole, whole_idle = _pooled([row for row in own_rows if row.output == name and not row.held_out])
        # a single part that was much worse, of moves that no other part has, widens the stated range and
        # condemns no plant: the fit has seen that part in the end
        if not part_error < USEFUL * parts_idle:
            errs = f"on parts held out {name} errs by {part_error:.2g}, without input by {parts_idle:.2g}"
            return False, f"Not good ({label}): {errs}; it needs more excitation, or another model. {another}"
        worst = _ratio_on_another_part([row for row in own_rows if row.output == name and row.held_out])
        if not worst < 1:
            errs = f"on another part {name} may err {worst:.2g} times as much as without input"
            return False, f"Not good ({label}): {errs}; it needs more excitation, or another model. {another}"
        if not whole < USEFUL * whole_idle:
            errs = f"on the logs of its own fit {name} errs by {whole:.2g}, without input by {whole_idle:.2g}"
            return False, f"Not good ({label}): {errs}; try other models, or longer logs. {another}"
        if not error.rmse < USEFUL * whole_idle:
            errs = f"without input {name} errs by {whole_idle:.2g}, so on another run it may be barely better"
            return False, f"Not good ({label}): {errs}; it needs more excitation, or more logs. {another}"
    failed = [finding.says for finding in checked.findings if finding.verdict == "fail"]
    if failed:
        return False, f"Not good ({label}): {failed[0]}. {another}"
    if doubts:
        more = f" (and {len(doubts) - 1} more)" if len(doubts) > 1 else ""
        return False, f"Not good ({label}) as long as this is in doubt: {doubts[0]}{more}. {another}"
    return True, f"Good for simulation and control on runs like these ({label}). {another}"


def _pooled(rows: Sequence[Row]) -> tuple[float, float]:
    """Return the rms errors of a candidate and of no input over all of some rows."""
    both = [(row.rmse, row.no_input_rmse) for row in rows] or [(0.0, np.inf)]
    error, idle = np.sqrt(np.mean(np.square(both), axis=0)).tolist()
    return error, idle


def _ratio_on_another_part(rows: Sequence[Row]) -> float:
    """Return below what the error over that without input stays on another part, in 19 cases of 20."""
    from scipy.special import stdtrit

    from thermogrip.sysid.validation.prediction_bands import PRIOR_PARTS, PRIOR_SPREAD

    # An output that half of the parts barely excite may be worse than no input on another run.  Of 11 outputs
    # of public logs one was so, with .95 of parts below 1.17, the others below .06 to .79.
    no_input = np.array([row.no_input_rmse for row in rows if row.no_input_rmse > 0])
    if not no_input.size:
        return 0.0
    errors = np.array([row.rmse for row in rows if row.no_input_rmse > 0])
    logs = np.log(np.maximum(errors, 1e-12) / no_input)
    # a part in which nothing moves weighs nothing
    weights = no_input**2 / np.sum(no_input**2)
    n, middle = float(1 / np.sum(weights**2)), float(weights @ logs)
    if n < 2:
        return 0.0
    # ln (e_f / b_f) is Student's t about its mean, with the prior of the error of another run for its spread
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
        dynamics = plant_dynamics(plant, draws=0)
    except UserError:  # it does not settle
        return []
    gains = {(row["input"], row["output"]): row["gain"] for row in dynamics.rows()}
    return [
        f"{heater} lowers {output} (gain {gains[heater, output]:.2g}): recorded in closed loop, or not what "
        "heats it?"
        for heater in heaters
        for output in warmed
        if gains.get((heater, output), 0.0) < 0
    ]


def network_name(plant: Plant) -> str:
    """Return the name of a plant's network; "" for a black box."""
    return str(getattr(plant.model, "name", ""))
