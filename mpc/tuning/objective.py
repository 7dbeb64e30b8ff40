r"""What a controller is tried on, and what that costs.

Steps of the spec, and loads after as long at rest at the first target, on draws of the posterior.  A step's
settling time counts in units of the bound, so that short and long steps weigh alike; what the spec forbids is
charged on top, steeply:

    step = (settle + energy_weight E) / bound + moves_weight M
           + 3 (overshoot / allowed - 0.9)+ + (|bias| / allowed - 0.9)+ / 2 + 3 (M / allowed - 0.9)+
    load = IAE / (IAE of the reference) + moves_weight M + 3 (M / allowed - 0.9)+

The reference is the PI by SIMC or the default MPC, whichever has the smaller IAE of that load.  The score is
the sum of both.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError
from thermogrip.mpc.closed_loop.simulate import ClosedLoop, Segment, Surroundings, simulate_closed_loop
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.design.design import Design
from thermogrip.mpc.design.spec import Spec
from thermogrip.mpc.estimator.observer import reading_noise
from thermogrip.mpc.interface import Regulator
from thermogrip.mpc.plant.prediction import drive_names, held_start, prediction_model, step_response
from thermogrip.mpc.tuning.minimum_time import full_drive_bound

if TYPE_CHECKING:
    from thermogrip.mpc.native.runtime import CompiledController
    from thermogrip.sysid.plant.plant import Plant


@dataclass(frozen=True)
class CostSettings:
    """What trials cost, and how large their loads are: see the module's text."""

    overshoot: float = 3.0  # of the whole allowed overshoot more
    bias: float = 0.5  # of the whole allowed bias more
    moves: float = 3.0  # of the whole allowed moves more
    error: float = 0.5  # of a band of error where a trial does not settle
    free: float = 0.9  # of what is allowed, that costs nothing
    load: float = 0.1  # of a drive's range, and of the first step
    load_times: float = 6.0  # integral times that a load's trial lasts
    sensor_off: float = 0.02  # of what the logs showed, a sensor of a disturbance that is not the room's
    judged_from: int = 100  # draws on which a controller is judged, apart from those of a search
    noises: int = 2  # in which each trial of a search is run: one noise alone moves a score by a tenth


COSTS = CostSettings()


@dataclass(frozen=True)
class Load:
    """What disturbs a plant at rest."""

    on: str  # a drive or a controlled output
    size: float  # in its unit
    lag_s: float = 0.0  # with which it comes [s]

    @property
    def words(self) -> str:
        """What it is, e.g. ``"q1 by -10"``."""
        return f"{self.on} by {self.size:.3g}"


@dataclass(frozen=True)
class Case:
    """One closed loop: a step, or a load where start and target are one, on a draw of the plant."""

    start: float  # [degC]
    target: float
    draw: int
    lacks: str = ""  # which of :func:`lacking` the plant has besides
    load: Load | None = None
    seconds: float | None = None  # how long it runs; ``hold_s`` of the spec where absent

    @property
    def step(self) -> tuple[float, float]:
        """Start and target [degC]."""
        return self.start, self.target

    @property
    def key(self) -> Case:
        """What controllers are compared by, whatever the plant lacks."""
        return replace(self, lacks="", seconds=None)


@dataclass(frozen=True)
class StepResult:
    """What one case came to; of the worst output where several are controlled."""

    case: Case
    settle_s: float  # NaN where it did not settle
    overshoot: float  # [degC]; of a load the largest error
    bias: float  # signed, of the output where it is largest
    last_error: float
    energy_s: float  # see :class:`thermogrip.mpc.closed_loop.simulate.Segment`
    travel: float
    full_share: float
    length_s: float
    iae: float = 0.0  # integral of the absolute error [degC s]


def draws_of(plant: Plant, count: int) -> list[int]:
    """Return which draws to try: 1 to count, or the plant itself alone where it has no uncertainty."""
    return list(range(1, count + 1)) if plant.uncertain else [0]


def judged_draws(plant: Plant, count: int) -> list[int]:
    """Return on which draws a controller is judged, of which a search has seen none."""
    return [draw + COSTS.judged_from if draw else 0 for draw in draws_of(plant, count)]


def judged_seed(plant: Plant, seed: int) -> int:
    """Return the seed of the noise there: a plant without draws has one that the search had not."""
    return seed if plant.uncertain else seed + COSTS.noises


@lru_cache(maxsize=16)
def apparent_delays(plant: Plant, controlled: tuple[str, ...]) -> tuple[float, ...]:
    """Return the apparent delay [s] of each controlled output behind the drive that moves it most."""
    drives = drive_names(plant)
    answers = [[step_response(plant, drive, output) for drive in drives] for output in controlled]
    return tuple(max(max(of, key=lambda answer: abs(answer.gain)).delay, plant.dt) for of in answers)


def lacking(plant: Plant, spec: Spec, controlled: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return what a spec states that a model may lack: in words, and as changes of the surroundings."""
    delay = max(apparent_delays(plant, tuple(controlled)))
    lag = spec.extra_lag * delay
    late = spec.extra_delay * delay
    lost = spec.lost_gain
    tried = [
        (lag, f"sensors slower by {lag:.2g} s", {"sensor_lag_s": lag}),
        (late, f"delay longer by {late:.2g} s", {"move_delay_s": late}),
        (lost, f"drive weaker by {100 * lost:.2g} %", {"drive_share": 1.0 - lost}),
    ]
    return {words: changes for value, words, changes in tried if value > 0}


def loads_of(plant: Plant, spec: Spec, design: Design) -> list[Load]:
    """Return the loads that are tried; a drive's goes where it has more room."""
    (start, target), loads = spec.steps[0], []
    model = prediction_model(plant, plant.dt)
    d = tuple(model.undisturbed(spec.ambient_degC).tolist())
    _, holding_drive = held_start(model, design.controlled, target, d)
    for name in drive_names(plant):
        low, high = design.drive_range[name]
        drive = 0.0 if holding_drive is None else float(holding_drive[model.drives.index(name)])
        side = 1.0 if high - drive >= drive - low else -1.0
        # on a drive it is what it does to the outputs of the undisturbed plant there, added to them: the same
        # thing where the plant is linear
        loads.append(Load(name, side * COSTS.load * (high - low)))
    # on an output four times the band that a spec has by default, as late as a drive's would be seen
    delays = zip(design.controlled, apparent_delays(plant, design.controlled))
    return loads + [Load(name, COSTS.load * (start - target), delay) for name, delay in delays]


def load_seconds(design: Design) -> float:
    """Return how long the trial of a load lasts [s]."""
    # as long as a drive takes to go as far as its load, and until the slowest PI by SIMC has settled
    spans = {name: high - low for name, (low, high) in design.drive_range.items()}
    moving = max(COSTS.load * span / design.slew_per_s[name] for name, span in spans.items())
    slowest = max((loop.Ti for loop in design.loops), default=0.0)
    return max(COSTS.load_times * slowest + moving, 10 * design.dt)


def meets_spec(result: StepResult | Segment, spec: Spec) -> bool:
    """Return whether one step is as wanted."""
    return (
        result.settle_s <= spec.settle_within_s  # False where NaN
        and result.overshoot <= spec.overshoot_degC
        and abs(result.bias) <= spec.bias_degC
    )


@lru_cache(maxsize=64)
def drawn(plant: Plant, draw: int) -> Plant:
    """Return a draw, the same one each time: its models and held states are worked out once."""
    # all draws have the model's structure: what it may lack besides is tried where the spec states it
    return plant.draw(draw)


def readings_a_move(plant: Plant, output: str, dt: float) -> float:
    """Return the number of readings of an output, as often as in the logs, that come in a sample time [s]."""
    # where rows were averaged, the excess of one reading over a mean of n is recorded: s^2 - s^2 / n
    sd, excess = (of.get(output, 0.0) for of in (plant.scores.reading_sd, plant.scores.reading_excess))
    averaged = 1 / (1 - (excess / sd) ** 2) if 0 <= excess < sd < np.inf else 1.0
    return max(1.0, averaged * dt / plant.dt)


def as_tried(design: Design, plant: Plant) -> Design:
    """Return the design of an MPC whose filter expects the mean of the readings that come between moves."""
    # it takes all of them; a trial shows it one, with the noise of their mean, and a PI the last one
    reading_sd = {name: design.noise.reading.get(name, reading_noise(plant, name)) for name in plant.outputs}
    means = {
        name: sd / readings_a_move(plant, name, design.dt) ** 0.5
        for name, sd in reading_sd.items()
        if sd is not None
    }
    return replace(design, noise=replace(design.noise, reading=means))


def made_for_trials(
    kind: str, plant: Plant, design: Design, *, c: CompiledController | None = None
) -> Controller | PIController:
    """Return a controller whose trials run in C where there is one; a PI's in the library ``c`` of an MPC."""
    if kind == "PI":
        loops = PIController(plant, design)
        loops.c = c or Controller(plant, design).c
        return loops
    return Controller(plant, as_tried(design, plant))


def surroundings_of(
    spec: Spec, controlled: Sequence[str], plant: Plant, *, filtered_s: float = 0.0
) -> Surroundings:
    """Return the room and the sensors of the trials, with the noise of the mean of the readings in
    ``filtered_s``, where that is given."""
    # of the logs, of which their quantum is a part; where they did not tell, the spec's and a thermocouple's
    reading_sd = {name: sd for name, sd in plant.scores.reading_sd.items() if np.isfinite(sd)}
    stated = "noise_degC" in spec.model_fields_set
    offset = dict.fromkeys(controlled, spec.sensor_offset_degC)
    others = [name for name in plant.disturbances if not plant.is_room(name)]
    for name in plant.disturbances:
        low, high = plant.valid.get(name, (0.0, 0.0))
        offset[name] = COSTS.sensor_off * (high - low) if name in others else 1.5 * spec.sensor_offset_degC
    usual = Surroundings(
        ambient=spec.ambient_degC,
        noise=spec.noise_degC,
        noises={} if stated else reading_sd,
        quanta=dict.fromkeys([*reading_sd, *others], 0.0),
        offset=offset,
        held=tuple(controlled),
        relays=spec.relays or {},
    )
    if not filtered_s:
        return usual
    steps = usual.steps_of(plant.outputs)
    single_sd = np.hypot(usual.noises_of(plant.outputs), steps / np.sqrt(12))  # a quantum is even noise
    counts = [readings_a_move(plant, name, filtered_s) for name in plant.outputs]
    means = dict(zip(plant.outputs, (single_sd / np.sqrt(counts)).tolist()))
    return replace(usual, noises=means, quanta=usual.quanta | dict.fromkeys(plant.outputs, 0.0))


@lru_cache(maxsize=256)
def signal_of(
    load: Load, plant: Plant, controlled: tuple[str, ...], at: float, ambient: float, n: int
) -> Array:
    """Return what a load adds to the outputs (n, n_y) of a plant at rest at a temperature [degC]."""
    model = prediction_model(plant, plant.dt)
    if load.on in model.outputs:
        added = np.zeros((n, model.n_y))
        rise = 1.0 - np.exp(-model.dt * np.arange(n) / load.lag_s)
        added[:, model.outputs.index(load.on)] = load.size * rise
        return added
    d = model.undisturbed(ambient)
    x, holding_drive = held_start(model, controlled, at, tuple(d.tolist()))
    plans = np.tile(model.neutral if holding_drive is None else holding_drive, (2, n - 1, 1))
    plans[1, :, model.drives.index(load.on)] += load.size
    y, _ = model.run(np.repeat(x[None], 2, axis=0), plans, d)
    return np.asarray(y[1] - y[0])


def trial(controller: Regulator, plant: Plant, spec: Spec, case: Case, *, seed: int = 0) -> ClosedLoop:
    """Run a case, wholly in C where the controller is in C."""
    # drives have held the start for long, and the controller knows them, as a running loop knows its own
    seconds = spec.hold_s if case.seconds is None else case.seconds
    truth, controlled = drawn(plant, case.draw), tuple(controller.controlled)
    filtered_s = controller.dt if isinstance(controller, Controller) else 0.0
    around = surroundings_of(spec, controlled, plant, filtered_s=filtered_s)
    if case.lacks:
        around = replace(around, **lacking(plant, spec, controlled)[case.lacks])  # type: ignore[arg-type]
    schedule = [(case.target, seconds)]
    if case.load is not None:
        # As long at rest before: a filter that has just begun learns any load at once, which of those that
        # barely move made winners that meet loads on the truth of a sous-vide bath with five times the error.
        schedule *= 2
        rest = max(1, round(seconds / controller.dt)) * max(1, round(controller.dt / truth.dt))
        n = round(seconds / truth.dt) + 1
        load = signal_of(case.load, truth, controlled, case.target, spec.ambient_degC, n)
        load = np.concatenate([np.zeros((rest, load.shape[1])), load])
        around = replace(around, load=load, offset={})
    about: dict[str, Any] = {
        "start": case.start,
        "surroundings": around,
        "band": spec.band_degC,
        "seed": 1000 * seed + case.draw,
    }
    if isinstance(controller, Controller | PIController) and controller.c is not None:
        from thermogrip.mpc.closed_loop.simulate_native import compiled_loop

        run = compiled_loop(controller, truth, schedule, **about)
    else:
        run = simulate_closed_loop(controller, truth, schedule, **about)
    return replace(run, segments=run.segments[-len(controlled) :])  # without the rest before a load


def run_trials(
    controller: Regulator, plant: Plant, spec: Spec, cases: Iterable[Case], *, seed: int = 0
) -> list[StepResult]:
    """Return the result of each of these cases."""
    return [result_of(trial(controller, plant, spec, case, seed=seed), case) for case in cases]


def steps_on(spec: Spec, draws: Iterable[int], lacks: str = "") -> list[Case]:
    """Return every step of a spec on these draws."""
    return [Case(start, target, draw, lacks) for start, target in spec.steps for draw in draws]


def result_of(run: ClosedLoop, case: Case) -> StepResult:
    """Return what a case came to, of the worst output."""
    parts, rows = run.segments, run.time >= run.segments[0].begin_s
    worst = max(parts, key=lambda part: abs(part.bias))
    errors = [run.outputs[part.output][rows] - part.target for part in parts]
    length = parts[0].end_s - parts[0].begin_s
    beyond = [part.overshoot for part in parts] if case.load is None else [np.max(np.abs(e)) for e in errors]
    return StepResult(
        case=case,
        settle_s=float(np.max([part.settle_s for part in parts])),  # NaN wins, as it should
        overshoot=float(max(beyond)),
        bias=worst.bias,
        last_error=float(max((error[-1] for error in errors), key=abs)),
        energy_s=parts[0].energy_s,
        travel=parts[0].travel,
        full_share=parts[0].full_share,
        length_s=length,
        iae=length * float(max(np.mean(np.abs(error)) for error in errors)),
    )


#: Shortest times [s] by start, target and draw.
Bounds = dict[tuple[float, float, int], float]


@dataclass(frozen=True)
class Scales:
    """What trials are counted in."""

    bounds: Bounds  # shortest times [s]
    # by start, target, draw and load: full drives that the default MPC moves, the reference's IAE [degC s]
    moves: dict[Case, float]
    iae: dict[Case, float]


@dataclass(frozen=True)
class Score:
    """What a controller costs; lower is better."""

    steps: float
    loads: float

    @property
    def total(self) -> float:
        """The sum."""
        return self.steps + self.loads


def score(results: Sequence[StepResult], spec: Spec, scales: Scales) -> Score:
    """Return the score of a set of trials; one in several noises costs their mean."""
    costs: dict[Case, list[float]] = {}
    for result in results:
        case, cost_of = result.case, _cost_of_load if result.case.load else _cost_of_step
        cost = cost_of(result, spec, scales)
        # a plant that lacks structure is run for longer than the reference was
        default_moves = np.inf if case.lacks else scales.moves.get(case.key, np.inf)
        # what moves more than the default design wears a valve for little
        most = (spec.moves_limit or np.inf) * default_moves
        cost += spec.moves_weight * result.travel + COSTS.moves * max(0.0, result.travel / most - COSTS.free)
        costs.setdefault(case, []).append(cost)
    steps = [float(np.mean(noises)) for case, noises in costs.items() if not case.load]
    loads = [float(np.mean(noises)) for case, noises in costs.items() if case.load]
    return Score(_mean_and_worst(steps), _mean_and_worst(loads))


def _mean_and_worst(costs: Sequence[float]) -> float:
    """Return the mean, and half of what the worst is above it."""
    # the draws stand for what the plant may be
    return float(0.5 * (np.mean(costs) + np.max(costs))) if costs else 0.0


def _cost_of_step(result: StepResult, spec: Spec, scales: Scales) -> float:
    # before the bound no target is reached: a time near it is the actuator's, and no weight's
    bound = scales.bounds[(*result.case.step, result.case.draw)]
    unit = max(bound if np.isfinite(bound) else result.length_s, 1.0)
    if np.isfinite(result.settle_s):
        cost = result.settle_s / unit + COSTS.bias * max(0.0, abs(result.bias) / spec.bias_degC - COSTS.free)
    else:
        # of what never settles the error says how far it was from it
        cost = result.length_s / unit + COSTS.error * abs(result.last_error) / spec.band_degC
    cost += COSTS.overshoot * max(0.0, result.overshoot / spec.overshoot_degC - COSTS.free)
    return float(cost + spec.energy_weight * result.energy_s / unit)


def _cost_of_load(result: StepResult, spec: Spec, scales: Scales) -> float:
    cost = result.iae / max(scales.iae[result.case.key], 1e-12)
    if not np.isfinite(result.settle_s):
        cost += COSTS.error * abs(result.last_error) / spec.band_degC
    return float(cost)


def bounds_of(plant: Plant, design: Design, spec: Spec, draws: Sequence[int]) -> Bounds:
    """Return the shortest time of every step on these draws: of full drive, or of the slowest ramp."""
    bounds: Bounds = {}
    for step in spec.steps:
        way = abs(step[1] - step[0]) - spec.band_degC
        ramp_s = max((way / rate for rate in design.ramp_per_s.values()), default=0.0)
        for draw in draws:
            bound = full_drive_bound(drawn(plant, draw), design, step, spec)
            bounds[(*step, draw)] = float(np.maximum(bound, ramp_s))  # NaN stays NaN
    if not np.isfinite(list(bounds.values())).any():
        raise UserError(
            f"steps: full drive does not reach {spec.steps[0][1]:g} degC, nor any other target",
            hint="choose nearer targets, a wider drive range, or a longer hold_s",
        )
    return bounds
