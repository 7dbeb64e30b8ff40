r"""What a tuner searches: the parameters, the design that they make, and its score on trials.

A :class:`Search` is made of plain data (its plant travels as JSON; of a class of the user's own, its file and
name travel, and the file is run where it arrives), so that other processes can evaluate designs too.

**Score.**  A step's settling time counts in units of the bound, so that short and long steps weigh alike;
what the spec forbids is charged on top, steeply:

    score = (settle + energy_weight E) / bound + moves_weight M
            + 3 (overshoot / allowed - 0.9)+ + (|bias| / allowed - 0.9)+ / 2 + 3 (M / allowed - 0.9)+

M is by how many full drives the drives move in all: of two designs that settle alike, the one that answers
less to noise wins. The moves allowed are ``moves_limit`` times those of the PI by SIMC in the same trial,
where that settles: what moves more wears a valve for little. A step that never settles is charged its whole
length and half of its last error in bands.
So a plant in mK, with a spec in mK, has the score of the same plant in K. Where a design is tried in several
noises, a step on a draw costs their mean. Over the runs, the score is the mean plus half of what the worst is
above it: the draws stand for what the plant may be. All of them have the model's structure. What that may
lack (sensors that are slower, a longer delay, a weaker drive) is tried one by one on the first draw, for as
long as a step is held, since such runs settle last; their mean counts a little. What a spec doubts more
than the default does is expected: it counts as any other draw. Beyond five bounds a run that lacks structure
counts by its logarithm: one that does not settle lasts as long as the spec holds a step, which has nothing to
do with the plant.

**Trials.**  A step begins where drives have held its start for long, and the controller is told these drives,
as a running loop knows them; M counts from there. Readings are as noisy as those of the logs were found to be
(which includes the logs' quantum), unless the spec states a noise; where the logs did not tell, they have the
spec's and a thermocouple's quantum.

**Bound.**  Before :func:`thermogrip.mpc.tuning.minimum_time.full_drive_bound` no drive inside its limits
brings the skin into the band.  Staying there takes longer still, since the drive must be taken back in time,
so a settling time near the bound cannot be improved by weights: the actuator is the limit.  A target that may
only ramp is in the band no sooner than its ramp brings it there, which is the bound where it is later.
"""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.parallel import Progress, Workers, pack, run_parallel, unpack
from thermogrip.mpc.closed_loop.simulate import ClosedLoop, Segment, Surroundings, simulate_closed_loop
from thermogrip.mpc.controllers.lqr import LQRController
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.design.design import Design, PILoop, make_blocks
from thermogrip.mpc.design.spec import Spec
from thermogrip.mpc.interface import Regulator
from thermogrip.mpc.native.runtime import CompiledTruth, known_codes, remember_codes, wanted
from thermogrip.mpc.optimiser.rti import Optimiser
from thermogrip.mpc.plant.prediction import HeldStarts, graded_drives, prediction_model, step_response
from thermogrip.mpc.tuning.minimum_time import full_drive_bound

if TYPE_CHECKING:
    from thermogrip.mpc.native.runtime import CompiledController
    from thermogrip.sysid.plant.plant import Plant


class Record:
    """What is written into a controller's notes."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON, None for what is not finite."""
        return {
            key: None if isinstance(value, float) and not np.isfinite(value) else value
            for key, value in vars(self).items()
        }


@dataclass(frozen=True)
class StepResult(Record):
    """One step on one draw; of the worst output where several are controlled."""

    start: float  # [degC]
    target: float
    draw: int  # which draw of the plant was the truth
    settle_s: float  # NaN where it did not settle
    overshoot: float  # [degC]; the bias is signed, of the output where it is largest
    bias: float
    last_error: float
    energy_s: float  # see :class:`thermogrip.mpc.closed_loop.simulate.Segment`
    travel: float
    full_share: float
    length_s: float
    output: str = ""  # the one it is of, where each is judged by itself


def draws_of(plant: Plant, count: int) -> list[int]:
    """Return which draws to try: 1 to count, or the plant itself alone where it has no uncertainty."""
    return list(range(1, count + 1)) if plant.uncertain else [0]


#: From this number on a draw lacks structure: 2001 is draw 1 with the second of :func:`lacking`.
STRUCTURE = 1000
#: How much runs on such draws count in the score beside the others, and beyond what one counts by its log.
LACKING, LATE = 0.05, 5.0
# what the whole allowed overshoot and bias more cost, and a band of error where a step does not settle
_OVERSHOOT, _BIAS, _ERROR, _MOVES = 3.0, 0.5, 0.5, 3.0
#: Of what is allowed, that costs nothing.
FREE = 0.9
#: In which an MPC is tried where its trials run in C: one noise alone moves a score by a tenth.
NOISES = 3
_LEAST_SLOPE = 0.02  # of the largest, of a drive that is there for an output
_SENSOR_OFF = 0.02  # of what the logs showed, a sensor of a disturbance that is no temperature of the room


@lru_cache(maxsize=16)
def apparent_delay(plant: Plant, controlled: tuple[str, ...]) -> float:
    """Return the longest apparent delay [s] of a controlled output behind the drive that moves it most."""
    drives = graded_drives(plant)
    answers = [[step_response(plant, drive, output) for drive in drives] for output in controlled]
    delays = [max(of, key=lambda answer: abs(answer.gain)).delay for of in answers]
    return max(*delays, plant.dt)


def lacking(plant: Plant, spec: Spec, controlled: Sequence[str]) -> list[tuple[str, dict[str, Any]]]:
    """Return what a plant may have that its model lacks: in words, and as changes of the surroundings."""
    delay = apparent_delay(plant, tuple(controlled))
    lag, late, lost = spec.extra_lag * delay, spec.extra_delay * delay, spec.lost_gain
    tried = [
        (lag, f"sensors slower by {lag:.2g} s", {"sensor_lag_s": lag}),
        (late, f"delay longer by {late:.2g} s", {"move_delay_s": late}),
        (lost, f"drive weaker by {100 * lost:.2g} %", {"drive_share": 1.0 - lost}),
    ]
    return [(words, changes) for value, words, changes in tried if value > 0]


_DOUBTS = ("extra_lag", "extra_delay", "lost_gain")  # in the order of :func:`lacking`


def expected(spec: Spec) -> set[int]:
    """Return which structures of :func:`lacking`, counted from 1, the spec doubts more than the default does:
    a user who states that the sensor may be slower by 6 s wants a design for it."""
    tried = [name for name in _DOUBTS if getattr(spec, name) > 0]
    usual = {name: Spec.model_fields[name].default for name in tried}
    return {at for at, name in enumerate(tried, start=1) if getattr(spec, name) > usual[name]}


def meets_spec(result: StepResult | Segment, spec: Spec) -> bool:
    """Return whether one run is as wanted."""
    asked = spec.asked(result.output)
    return (
        result.settle_s <= asked.within_s  # False where NaN
        and result.overshoot <= asked.overshoot_degC
        and abs(result.bias) <= asked.bias_degC
    )


def counting(results: Sequence[StepResult], spec: Spec) -> list[StepResult]:
    """Return the results whose plant is as its model is, or as the spec expects it to be."""
    planned = expected(spec) | {0}
    return [result for result in results if result.draw // STRUCTURE in planned]


def cold_steps(plant: Plant, spec: Spec, controlled: Sequence[str]) -> list[tuple[float, float]]:
    """Return the step from rest in the room to the first target, where a log was as cold and it is further
    than any step of the spec, else none: a run begins there, its integrator has all of the drive to find."""
    cold, target = spec.ambient_degC, spec.steps[0][1]
    seen = [plant.valid.get(name, (np.inf, -np.inf)) for name in controlled]
    begun = all(low - spec.band_degC <= cold <= high for low, high in seen)
    warm = all(plant.units.get(name, "degC") == "degC" for name in controlled)
    further = abs(target - cold) > max(abs(end - start) for start, end in spec.steps)
    return [(cold, target)] if begun and warm and further else []


@lru_cache(maxsize=64)
def drawn(plant: Plant, draw: int) -> Plant:
    """Return a draw, the same one each time: its models and held states are worked out once."""
    return plant.draw(draw)


def surroundings_of(
    spec: Spec,
    controlled: Sequence[str],
    plant: Plant,
) -> Surroundings:
    """Return the room and the sensors of the trials: the controlled ones are off, the room's are, and those
    of other disturbances by a share of what the logs showed; noise is that of the logs by output, of which
    their quantum is a part."""
    known = {name: sd for name, sd in plant.scores.reading_sd.items() if np.isfinite(sd)}
    stated = "noise_degC" in spec.model_fields_set
    offset = dict.fromkeys(controlled, spec.sensor_offset_degC)
    others = [name for name in plant.disturbances if not plant.is_room(name)]
    for name in plant.disturbances:
        low, high = plant.valid.get(name, (0.0, 0.0))
        offset[name] = _SENSOR_OFF * (high - low) if name in others else 1.5 * spec.sensor_offset_degC
    room = spec.ambient_degC
    return Surroundings(
        ambient=room,
        noise=spec.noise_degC,
        noises={} if stated else known,
        quanta=dict.fromkeys([*known, *others], 0.0),
        offset=offset,
        held=tuple(controlled),
    )


def bands_of(spec: Spec, controlled: Sequence[str]) -> float | dict[str, float]:
    """Return the half width of the settling band [degC], by output where they may differ."""
    return {name: spec.asked(name).band_degC for name in controlled} if spec.settling else spec.band_degC


def trial(
    controller: Regulator,
    plant: Plant,
    spec: Spec,
    step: tuple[float, float],
    draw: int,
    length_s: float,
    seed: int,
    *,
    around: Surroundings | None = None,
) -> ClosedLoop:
    """Run a step (start, target) [degC] of the spec on one draw of the plant for so many seconds, wholly in C
    where the controller is in C; in the surroundings of the spec where there are no others."""
    structure, draw = divmod(draw, STRUCTURE)
    if around is None:
        around = surroundings_of(spec, controller.controlled, plant)
    if structure:
        around = replace(around, **lacking(plant, spec, controller.controlled)[structure - 1][1])
    truth, schedule = drawn(plant, draw), [(step[1], length_s)]
    about: dict[str, Any] = {
        "surroundings": around,
        "band": bands_of(spec, controller.controlled),
        "seed": 1000 * seed + draw,
    }
    if isinstance(controller, Controller | PIController) and controller.c is not None:
        from thermogrip.mpc.closed_loop.simulate_native import compiled_loop

        return compiled_loop(controller, truth, schedule, start=step[0], **about)
    return simulate_closed_loop(controller, truth, schedule, start=step[0], **about)


def run_trials(
    controller: Regulator,
    plant: Plant,
    spec: Spec,
    draws: Sequence[int],
    *,
    lengths: Sequence[float] | None = None,
    seed: int = 0,
) -> list[StepResult]:
    """Run every step of the spec on these draws; ``lengths`` are seconds by step, ``hold_s`` where absent.
    Where the spec has ``settling`` there is a result for each output, else one of the worst."""
    results = []
    for at, step in enumerate(spec.steps):
        length = spec.hold_s if lengths is None else lengths[at]
        for draw in draws:
            run = trial(controller, plant, spec, step, draw, length, seed)
            results += results_of(run, spec, step, draw)
    return results


def results_of(run: ClosedLoop, spec: Spec, step: tuple[float, float], draw: int) -> list[StepResult]:
    """Return what a step on a draw comes to: for each output where the spec has ``settling``, else of the
    worst."""
    if spec.settling:
        return [_result(run, [part], step, draw, part.output) for part in run.segments]
    return [_result(run, run.segments, step, draw)]


#: By start, target and draw; where outputs are judged apart by output too.
Bounds = dict[tuple[float, float, int] | tuple[float, float, int, str], float]


def bound_of(bounds: Bounds, result: StepResult) -> float:
    """Return the shortest time [s] of what a result is of."""
    key = (result.start, result.target, result.draw % STRUCTURE)
    return bounds[(*key, result.output) if result.output else key]


#: Of the PI by SIMC, by start, target and draw: how many full drives its drives move, where it settles.
PIMoves = dict[tuple[float, float, int], float]


def moves_of(results: Sequence[StepResult]) -> PIMoves:
    """Return how far drives moved in the runs that settled; one that held its start says nothing."""
    settled = [result for result in results if np.isfinite(result.settle_s) and result.travel > 0]
    return {(result.start, result.target, result.draw): result.travel for result in settled}


def score(
    results: Sequence[StepResult], spec: Spec, bounds: Bounds, pi_moves: PIMoves | None = None
) -> float:
    """Return the score of a set of trials, see the module's text; lower is better; ``bounds`` are shortest
    times [s]; moves have no limit where those of a PI are not given."""
    costs: dict[tuple[float, float, int, str], list[float]] = {}
    times_pi = spec.moves_limit or np.inf
    for result in results:
        bound, asked = bound_of(bounds, result), spec.asked(result.output)
        unit = max(bound if np.isfinite(bound) else result.length_s, asked.pace_s, 1.0)
        settled = np.isfinite(result.settle_s)
        taken = max(result.settle_s, asked.pace_s)  # sooner than an output's own time wins nothing
        cost = taken / unit
        if not settled:
            cost = result.length_s / unit + _ERROR * abs(result.last_error) / asked.band_degC
        cost += _OVERSHOOT * max(0.0, result.overshoot / asked.overshoot_degC - FREE)
        cost += _BIAS * max(0.0, abs(result.bias) / asked.bias_degC - FREE) if settled else 0.0
        cost += spec.energy_weight * result.energy_s / unit + spec.moves_weight * result.travel
        most = (pi_moves or {}).get((result.start, result.target, result.draw % STRUCTURE), np.inf)
        cost += _MOVES * max(0.0, result.travel / (times_pi * most) - FREE)
        costs.setdefault((result.start, result.target, result.draw, result.output), []).append(cost)
    of = {key: float(np.mean(noises)) for key, noises in costs.items()}
    planned = expected(spec) | {0}
    own: list[float] = []
    others: list[float] = []
    for (_, _, draw, _), cost in of.items():
        structure = draw // STRUCTURE
        if structure and cost > LATE:
            cost = LATE * (1 + np.log(cost / LATE))
        (own if structure in planned else others).append(cost)
    return float(0.5 * (np.mean(own) + np.max(own)) + LACKING * np.sum(others) / max(1, len(others)))


def bounds_of(plant: Plant, design: Design, spec: Spec, draws: Sequence[int]) -> Bounds:
    """Return :func:`full_drive_bound` of every step of the spec on these draws, or the ramp's time."""
    found: Bounds = {}
    for draw in draws:
        for step in spec.steps:
            if not spec.settling:
                found[(*step, draw)] = full_drive_bound(drawn(plant, draw), design, step, spec)
                continue
            for name in design.controlled:
                found[(*step, draw, name)] = full_drive_bound(drawn(plant, draw), design, step, spec, name)
            found[(*step, draw)] = max(found[(*step, draw, name)] for name in design.controlled)
    return ramped_bounds(found, design, spec)


def ramped_bounds(bounds: Bounds, design: Design, spec: Spec) -> Bounds:
    """Return these bounds, or when the slowest ramp brings the target of a step into the band of its end."""
    found: Bounds = {}
    for key, bound in bounds.items():
        of = {name: rate for name, rate in design.ramp_per_s.items() if key[3:] in ((), (name,))}
        times = [spec.way(key[:2], name) / rate for name, rate in of.items()]
        found[key] = float(np.maximum(bound, max(times, default=0.0)))  # NaN stays NaN
    return found


#: An output that the drive can bring into its band in this share of the time that is asked of it alone goes
#: gently: its target ramps, for so long at most.
AT_EASE, RAMPED = 0.7, 0.8


def paced(design: Design, spec: Spec, bounds: Bounds) -> Design:
    """Return the design with a ramp for each output that may take its time, as slow as its longest step."""
    ramps = dict(design.ramp_per_s)
    for name in design.controlled:
        asked = spec.asked(name).pace_s
        slowest = max((bound for key, bound in bounds.items() if key[3:] == (name,)), default=np.inf)
        if name not in ramps and slowest <= AT_EASE * asked:
            ramps[name] = max(spec.way(step, name) for step in spec.steps) / (RAMPED * asked)
    return replace(design, ramp_per_s=ramps)


def check_steps(bounds: Bounds) -> None:
    """Raise UserError where no step can be reached at all."""
    if bounds and not any(np.isfinite(bound) for bound in bounds.values()):
        first = next(iter(bounds))
        raise UserError(
            f"steps: full drive does not reach {first[1]:g} degC, nor any other target",
            hint="choose nearer targets, a wider drive range, or a longer hold_s",
        )


def _result(
    run: ClosedLoop, parts: Sequence[Segment], step: tuple[float, float], draw: int, output: str = ""
) -> StepResult:
    settles = [part.settle_s for part in parts]
    worst = max(parts, key=lambda part: abs(part.bias))
    last = max((run.outputs[p.output][-1] - p.target for p in parts), key=abs)
    return StepResult(
        start=step[0],
        target=step[1],
        draw=draw,
        settle_s=float(np.max(settles)),  # NaN wins, as it should
        overshoot=max(part.overshoot for part in parts),
        bias=worst.bias,
        last_error=float(last),
        energy_s=parts[0].energy_s,
        travel=parts[0].travel,
        full_share=parts[0].full_share,
        length_s=parts[0].end_s - parts[0].begin_s,
        output=output,
    )


#: What the search varies: name, smallest, largest; all on a logarithmic scale, walks as factors of the noise.
MPC_PARAMETERS = (
    ("move", 0.02, 5000.0),
    ("terminal", 0.3, 300.0),
    ("overshoot_share", 0.05, 0.9),
    ("drive_walk", 0.03, 10.0),
    ("output_walk", 0.03, 10.0),
    ("state_walk", 0.1, 1.0),
)
PI_PARAMETERS = (
    ("Kc", 0.2, 5.0),
    ("Ti", 0.2, 5.0),
    ("setpoint", 0.1, 1.0),
    ("feedforward", 0.05, 1.0),
)
#: Of a PI whose delay is below two steps of the plant: no log shows it, SIMC's gain is the highest tried.
PI_OF_UNSEEN_DELAY = (("Kc", 0.2, 1.0), ("Ti", 0.6, 5.0), *PI_PARAMETERS[2:])
LONGEST_TI = 1.5  # of a PI's gain, both in those of SIMC: a load's integrated error is at most half more
LQR_PARAMETERS = (
    ("move", 0.02, 500.0),
    ("drive", 1e-4, 100.0),
    ("state_walk", 0.1, 1.0),
    ("drive_walk", 0.03, 10.0),
    ("output_walk", 0.03, 10.0),
)

#: What a design that prices travel is searched by: of the error that a spec allows, what moves no drive.
STILL = ("still", 0.003, 0.6)
_CHECK_FROM = 100  # draws of the comparison, apart from those of the search


@dataclass(frozen=True)
class Trial:
    """One design that was tried, over all steps and draws."""

    controller: str  # ``"MPC"``, ``"LQR"`` or ``"PI"``
    parameters: dict[str, float]  # what made it
    score: float  # lower is better, see :func:`thermogrip.mpc.tuning.objective.score`
    settle_s: float  # means over steps and draws; NaN where one did not settle
    overshoot: float  # the worst [degC]
    energy_s: float  # means over steps and draws; NaN where one did not settle
    travel: float = 0.0  # mean of how many full drives the drives move


#: Draws, a seed, and whether a run is for as long as steps are held.
_Runs: TypeAlias = tuple[Sequence[int], int, bool]
# closed loops that a process is given at once: a tenth of a second and more
_RUNS_IN_C, _RUNS_IN_PYTHON, _PI_IN_C = 9, 3, 6
_TRIALS_IN_C = 4  # of PIs


class _Part(NamedTuple):
    """A share of a trial, for one process."""

    name: str
    parameters: dict[str, float] | None  # None: the default design
    whole: bool  # whether of all steps, the cold start too
    runs: Sequence[_Runs]


class _Built:
    """Structures of designs whose C is built."""

    def __init__(self) -> None:
        self.structures: set[Any] = set()
        self.locks: defaultdict[Any, threading.Lock] = defaultdict(threading.Lock)


def _structure(design: Design) -> Any:
    """Return on what it depends which C a design needs."""
    return design.blocks, tuple(design.ramp_per_s)


def _unpacked_here(packed: bytes) -> Search:
    """Return a search that came to this process: the same one each time, of which a thread has its own."""
    return _unpacked(packed, threading.get_ident())


@lru_cache(maxsize=16)
def _unpacked(packed: bytes, thread: int) -> Search:
    state = unpack(packed)
    search = object.__new__(Search)
    search.__dict__.update(state, plant=_plant_of(state["plant"], thread), workers=1)
    search._made, search._library, search._packed, search._built = {}, None, None, _Built()
    remember_codes(search._codes)
    return search


@lru_cache(maxsize=16)
def _plant_of(packed: bytes, thread: int) -> Plant:
    """Return a plant as it travels, with all that is worked out for it; a user's own class is read here."""
    from thermogrip.sysid.models.user_model import load_object, own_model
    from thermogrip.sysid.plant.plant import Plant

    content, where = unpack(packed)
    return Plant.from_dict(content, model=None if where is None else own_model(load_object(*where)))


class Search:
    """Evaluates designs on the search's draws.

    It is made of plain data, so that it travels to other processes: what one trial consists of is shared out
    among ``workers``.  What each process would work out for itself (where draws are at rest, the C of the
    model) travels along, and a process unpacks the same search once.
    """

    def __init__(
        self, plant: Plant, spec: Spec, baseline: Design, seed: int, *, workers: Workers = 1
    ) -> None:
        self.plant, self.spec, self.seed, self.workers = plant, spec, seed, workers
        self._compiled = wanted() and not baseline.on_off
        self._library: CompiledController | None = None  # in which trials of PI loops run
        self._made: dict[str, tuple[dict[str, float] | None, Regulator]] = {}  # for the last part of a name
        self._built = _Built()
        self._packed: bytes | None = None
        self._starts: dict[int, HeldStarts] = {}  # by draw
        self._codes: list[Any] = []
        self._by_pi: dict[int, list[StepResult]] = {}  # of SIMC's PI, by draw
        self.draws = draws_of(plant, spec.search_draws)
        self.certain = self.draws == [0]  # no draws: the comparison takes the same plant, and fresh noise
        self.check_seed = seed + 1 if self.certain else seed
        # the comparison takes draws that the search has not seen
        self.unseen = [draw + _CHECK_FROM if draw else 0 for draw in draws_of(plant, spec.check_draws)]
        cold = cold_steps(plant, spec, baseline.controlled)
        self.whole_spec = spec.model_copy(update={"steps": [*spec.steps, *cold]})  # of trials at full length
        self.baseline = baseline
        self.bounds = self._first_bounds(sorted({*self.draws, *self.unseen}))
        self.baseline = baseline = paced(baseline, spec, self.bounds)
        self.bounds = ramped_bounds(self.bounds, baseline, spec)
        if cold:
            begun = spec.model_copy(update={"steps": cold})
            self.bounds |= bounds_of(plant, baseline, begun, self.draws)
        count = len(lacking(plant, spec, baseline.controlled))
        self.lacking = [STRUCTURE * (k + 1) + self.draws[0] for k in range(count)]
        check_steps(self.bounds)
        unseen = apparent_delay(plant, baseline.controlled) < 2 * plant.dt
        own = PI_OF_UNSEEN_DELAY if unseen else PI_PARAMETERS
        self.pi: Sequence[tuple[str, float, float]] = own[:-1] if self.certain else own
        self.pi_moves = self._moves_of_pi()
        # long enough to see it settle and stay, short enough to try many in Python
        slowest = [max(self.bounds[(*step, draw)] for draw in self.draws) for step in spec.steps]
        least = min(120.0, spec.hold_s)
        self.lengths = [float(np.clip(1.35 * bound + 40.0, least, spec.hold_s)) for bound in slowest]
        # a plant that settles long after the bound (its delay, what is not known of it) is watched for longer
        for at, settled in enumerate(self._settled()):
            self.lengths[at] = float(np.clip(1.25 * settled + 40.0, self.lengths[at], spec.hold_s))
        self._packed = None

    def _first_bounds(self, draws: Sequence[int]) -> Bounds:
        """Return the bounds on these draws; meanwhile one of several workers writes and builds the C, and
        what else needs no bounds is worked out."""
        if self.workers == 1:
            return bounds_of(self.plant, self.baseline, self.spec, draws)
        items: list[Callable[[], Any]] = [self._begin_c, *(partial(self._begin, draw) for draw in draws)]
        if not self.spec.settling:  # else bounds may pace the default design
            items.append(self._price)
        (self._compiled, self._codes), *found = run_parallel(_called, items, self.workers, what="bounds")
        self._built.structures.add(_structure(self.baseline))
        remember_codes(self._codes)
        self._packed = None
        bounds: Bounds = {}
        for draw, (starts, of, by_pi) in zip(draws, found):
            self._starts[draw] = starts
            bounds |= of
            if by_pi:
                self._by_pi[draw] = by_pi
        if not self.spec.settling:
            self.travel = found[-1]
        return bounds

    def _begin_c(self) -> tuple[bool, list[Any]]:
        """Return whether C can be had, and the model's code."""
        if self._compiled and self._controller(self.baseline).c is not None:
            CompiledTruth(prediction_model(self.plant, self.plant.dt))
        return self._compiled, known_codes()

    def _begin(self, draw: int) -> tuple[HeldStarts, Bounds, list[StepResult]]:
        """Return where a draw is at rest, its bounds and, if these cannot pace the default design, what
        SIMC's PI does."""
        of = bounds_of(self.plant, self.baseline, self.spec, [draw])
        by_pi = self._by_simc(draw) if self.spec.moves_limit and not self.spec.settling else []
        return prediction_model(drawn(self.plant, draw), self.plant.dt).held_starts, of, by_pi

    def _moves_of_pi(self) -> PIMoves:
        """Return what the PI by SIMC moves, on the search's draws and on those of the comparison."""
        if not self.spec.moves_limit:
            return {}
        known, self._by_pi = self._by_pi, {}
        if not known:
            draws = sorted({*self.unseen, *self.draws})
            found = run_parallel(self._by_simc, draws, self.workers, what="moves of a PI")
            known = dict(zip(draws, found, strict=True))
        return moves_of([result for results in known.values() for result in results])

    def _by_simc(self, draw: int) -> list[StepResult]:
        """Return the results on a draw of SIMC's PI by itself, at the rate at which readings come; it is not
        told what drive holds a target."""
        self._know([draw])
        loops = tuple(replace(loop, feedforward=0.0) for loop in self.baseline.loops)
        made = PIController.of(self.plant, replace(self.baseline, dt=self.plant.dt), loops)
        return run_trials(made, self.plant, self.whole_spec, [draw], seed=self.check_seed)

    def _settled(self) -> list[float]:
        """Return when the default design has settled on the slowest draw [s], by step; inf where never."""
        spec = self.spec
        found = self._results("MPC", None, [(self.draws, self.seed, True)], whole=False)
        times = {step: [r.settle_s for r in found if (r.start, r.target) == step] for step in spec.steps}
        return [float(np.nan_to_num(times[step], nan=np.inf).max()) for step in spec.steps]

    def __reduce__(self) -> Any:
        if self._packed is None:
            own = getattr(self.plant.model, "code", None)
            where = None if own is None else (str(Path(own.file).resolve()), own.name)
            apart = ("_made", "_library", "_packed", "_built", "workers")
            state = {key: value for key, value in self.__dict__.items() if key not in apart}
            self._packed = pack({**state, "plant": pack((self.plant.to_dict(), where))})
        return _unpacked_here, (self._packed,)

    def __copy__(self) -> Search:
        made = object.__new__(type(self))
        made.__dict__.update(self.__dict__)
        return made

    def design(self, parameters: dict[str, float]) -> Design:
        """Return the baseline with these parameters; those that are not named stay."""
        base = self.baseline
        noise = replace(
            base.noise,
            state=parameters.get("state_walk", 1.0) * base.noise.state,
            drive={n: parameters.get("drive_walk", 1.0) * sd for n, sd in base.noise.drive.items()},
            output=parameters.get("output_walk", 1.0) * base.noise.output,
        )
        horizon = max(10, round(parameters.get("horizon", sum(base.blocks))))
        count = max(2, round(parameters.get("blocks", len(base.blocks))))
        same = (horizon, count) == (sum(base.blocks), len(base.blocks))
        share = parameters.get("overshoot_share")
        return replace(
            base,
            blocks=base.blocks if same else make_blocks(horizon, count),
            move=parameters.get("move", base.move),
            terminal=parameters.get("terminal", base.terminal),
            travel=parameters["still"] * self.travel if "still" in parameters else base.travel,
            drive=parameters.get("drive", base.drive),
            overshoot=base.overshoot if share is None else share * self.spec.overshoot_degC,
            noise=noise,
            drive_range=_capped(base.drive_range, parameters.get("drive_share", 1.0)),
            ramp_per_s={**base.ramp_per_s, **self._ramps(parameters["ramp"])}
            if "ramp" in parameters
            else base.ramp_per_s,
        )

    @cached_property
    def travel(self) -> float:
        """The price of travel at which a prediction that is off by the allowed bias moves no drive."""
        return _price_of_travel(self.plant, self.baseline, self.spec)

    def _price(self) -> float:
        return self.travel

    @property
    def at_once(self) -> list[str]:
        """The controlled outputs whose targets need not ramp."""
        return [name for name in self.baseline.controlled if name not in self.baseline.ramp_per_s]

    def _ramps(self, times: float) -> dict[str, float]:
        """Return how fast targets may change: a step's ramp lasts so many times its bound, or longer."""
        spec, rates = self.spec, dict.fromkeys(self.at_once, np.inf)
        for step in spec.steps:
            found = np.array([self.bounds[(*step, draw)] for draw in self.draws])
            if np.isfinite(found).any():
                lasts = times * float(np.mean(found[np.isfinite(found)]))
                rates = {name: min(rate, spec.way(step, name) / lasts) for name, rate in rates.items()}
        return rates

    def evaluate(
        self,
        parameters: dict[str, float],
        name: str = "MPC",
        *,
        at_length: bool = False,
        other_noise: int = 0,
        noises: int = NOISES,
    ) -> Trial:
        """Return the trial of an ``"MPC"``, ``"PI"`` or ``"LQR"``, at full length if asked; other noise
        than the search's is counted from 1, and only an MPC in C is tried in several ``noises``."""
        quick = name == "MPC" and self._compiled  # whole loops in C: under a tenth of the time
        # a PI for as long as a step is held, to see what its integrator has still to do; and what is quick:
        # the end of a short run is not the bias that stays
        whole = quick or name == "PI" or at_length
        count = noises if quick else 1
        # the comparison of a plant without draws has a seed of its own
        others = range(count * other_noise, count * (other_noise + 1))
        seeds = [self.seed + (noise and noise + 1) for noise in others]
        counted = expected(self.spec)
        lacks = [draw for draw in self.lacking if draw // STRUCTURE not in counted]
        planned = [draw for draw in self.lacking if draw // STRUCTURE in counted]
        runs = []
        for seed in seeds:
            runs.append((self.draws, seed, whole))
            if planned:  # which settles last: for as long as a step is held
                runs.append((planned, seed, True))
        if name != "LQR":
            runs.append((lacks, seeds[0], True))
        found = self._results(name, parameters, runs, whole=whole)
        results = counting(found, self.spec)
        return Trial(
            controller=name,
            parameters=dict(parameters),
            score=score(found, self.spec, self.bounds, self.pi_moves),
            settle_s=float(np.mean([result.settle_s for result in results])),
            overshoot=max(result.overshoot for result in results),
            energy_s=float(np.mean([result.energy_s for result in results])),
            travel=float(np.mean([result.travel for result in results])),
        )

    def evaluate_each(
        self, name: str, several: Sequence[dict[str, float]], progress: Progress | None = None, *, what: str
    ) -> list[Trial]:
        """Return the trial of each of several sets of parameters; a process is given some at once."""
        n = _TRIALS_IN_C if self._compiled else 1
        parts = [several[at : at + n] for at in range(0, len(several), n)]
        of = partial(self._trials, name)
        done = run_parallel(of, parts, self.workers, progress, what=what, elsewhere=True)
        return [tried for part in done for tried in part]

    def _trials(self, name: str, several: Sequence[dict[str, float]]) -> list[Trial]:
        return [self.evaluate(parameters, name) for parameters in several]

    def _results(
        self, name: str, parameters: dict[str, float] | None, runs: Sequence[_Runs], *, whole: bool
    ) -> list[StepResult]:
        """Return the results of runs, in their order; those of a draw go to one process."""
        if self.workers == 1:
            return [result for part in self._run(_Part(name, parameters, whole, runs)) for result in part]
        if name != "PI" and self._compiled:
            self._build_once(self.baseline if parameters is None else self.design(parameters))
        each = [([draw], seed, full) for draws, seed, full in runs for draw in draws]
        n = _RUNS_IN_C if self._compiled and name != "LQR" else _RUNS_IN_PYTHON
        n = max(1, (_PI_IN_C if name == "PI" and self._compiled else 1) * n // len(self.spec.steps))
        if name != "PI":  # whose searches have others beside them
            n = min(n, -(-len(each) // 2))
        parts = [_Part(name, parameters, whole, each[at : at + n]) for at in range(0, len(each), n)]
        done = run_parallel(self._run, parts, self.workers, elsewhere=True)
        of = iter([results for part in done for results in part])
        steps = len((self.whole_spec if whole else self.spec).steps)
        found: list[StepResult] = []
        for draws, _, _ in runs:
            by_draw = [next(of) for _ in draws]
            for at in range(steps):  # the order of one process: by step, then by draw
                for results in by_draw:
                    count = len(results) // steps
                    found += results[count * at : count * (at + 1)]
        return found

    def _run(self, part: _Part) -> list[list[StepResult]]:
        """Return the results of each of a part's runs."""
        name, parameters, whole, runs = part
        if name not in self._made or self._made[name][0] != parameters:
            self._made[name] = (parameters, self._regulator(name, parameters))
        controller, spec = self._made[name][1], self.whole_spec if whole else self.spec
        found = []
        for draws, seed, full in runs:
            self._know(draws)
            lengths = None if full else self.lengths
            found.append(run_trials(controller, self.plant, spec, draws, lengths=lengths, seed=seed))
        return found

    def _regulator(self, name: str, parameters: dict[str, float] | None) -> Regulator:
        if parameters is None:
            return self.made(name, self.baseline)
        if name == "PI":
            return self._pi(scaled_loops(self.baseline.loops, parameters))
        return self.made(name, self.design(parameters))

    def _know(self, draws: Sequence[int]) -> None:
        """Take over where these draws are at rest, which another process has found."""
        for draw in {draw % STRUCTURE for draw in draws} & self._starts.keys():
            prediction_model(drawn(self.plant, draw), self.plant.dt).held_starts |= self._starts[draw]

    def _builds(self, design: Design) -> bool:
        return self._controller(design).c is not None

    def _build_once(self, design: Design) -> None:
        """Have one process build the C of a structure, which the others find built: it takes seconds."""
        structure = _structure(design)
        with self._built.locks[structure]:
            if structure not in self._built.structures:
                run_parallel(self._builds, [design], self.workers, elsewhere=True)
                self._built.structures.add(structure)

    def evaluate_at_length(self, item: tuple[str, dict[str, float]]) -> Trial:
        """Return a trial at full length: slow ones settle too."""
        name, parameters = item
        return self.evaluate(parameters, name, at_length=True)

    def at_length(self, trial: Trial) -> bool:
        """Return whether a trial of the search was already at full length."""
        return trial.controller == "PI" or (trial.controller == "MPC" and self._compiled)

    def evaluate_in_other_noise(self, item: tuple[dict[str, float], int]) -> Trial:
        """Return a trial of an MPC at full length in another noise than the search's, counted from 1."""
        parameters, other = item
        return self.evaluate(parameters, at_length=True, other_noise=other)

    def check(self, item: tuple[str, Design, int]) -> list[StepResult]:
        """Return the results of a controller on one draw, at full length."""
        name, design, draw = item
        self._know([draw])
        return run_trials(self.made(name, design), self.plant, self.spec, [draw], seed=self.check_seed)

    def made(self, name: str, design: Design) -> Regulator:
        """Return the controller of a design, ``"PI"``, ``"LQR"`` or by any other name an MPC, with filter and
        optimiser in C where there is a compiler."""
        if name == "PI":
            return self._pi(design.loops)
        controller = self._controller(design)
        if name == "LQR":
            return LQRController(self.plant, design, observer=controller.observer)
        return controller

    def _pi(self, loops: tuple[PILoop, ...]) -> PIController:
        """Return PI loops whose trials run in C where the default design's do."""
        made = PIController.of(self.plant, self.baseline, loops)
        if self._library is None and self._compiled:
            self._library = self._controller(self.baseline).c
        made.c = self._library
        return made

    def _controller(self, design: Design) -> Controller:
        """Return an MPC; from the first time on that its steps cannot be had in C, none are expected to."""
        made = Controller(self.plant, design)
        self._compiled = self._compiled and made.c is not None
        return made


def _called(function: Callable[[], Any]) -> Any:
    return function()


def _price_of_travel(plant: Plant, design: Design, spec: Spec) -> float:
    """Return the price of travel at which a whole prediction that is off by the allowed bias moves no drive:
    the slope of its squared errors along the drive that answers least over the horizon."""
    optimiser = Optimiser(prediction_model(plant, design.dt), design)
    bias = np.array([spec.asked(name).bias_degC for name in design.controlled]) * optimiser.weight
    slopes = 2 * design.track * np.abs(optimiser.at_rest.sum(axis=0)) * bias[optimiser.strongest]
    return float(np.min(slopes, where=slopes > _LEAST_SLOPE * slopes.max(), initial=slopes.max()))


def _capped(ranges: dict[str, tuple[float, float]], share: float) -> dict[str, tuple[float, float]]:
    """Return this share of each range, about no drive or what is nearest to none."""
    rests = {name: min(max(0.0, low), high) for name, (low, high) in ranges.items()}
    return {
        name: (rests[name] + share * (low - rests[name]), rests[name] + share * (high - rests[name]))
        for name, (low, high) in ranges.items()
    }


def parameters_of(design: Design, spec: Spec) -> dict[str, float]:
    """Return the parameters of the MPC that make a design."""
    return {
        "move": design.move,
        "terminal": design.terminal,
        "overshoot_share": design.overshoot / spec.overshoot_degC,
        "state_walk": 1.0,
        "drive_walk": 1.0,
        "output_walk": 1.0,
        "horizon": float(sum(design.blocks)),
        "blocks": float(len(design.blocks)),
    }


def scaled_loops(loops: tuple[PILoop, ...], factors: dict[str, float]) -> tuple[PILoop, ...]:
    """Return PI loops with each number times its factor, feed-forward and setpoint weight as given; a step of
    the load leaves an integrated error of Ti / Kc, at most half more than that of the loops given."""
    Ti = min(factors["Ti"], LONGEST_TI * factors["Kc"])
    return tuple(
        replace(
            loop,
            Kc=factors["Kc"] * loop.Kc,
            Ti=Ti * loop.Ti,
            feedforward=factors["feedforward"],
            setpoint=factors["setpoint"],
        )
        for loop in loops
    )
