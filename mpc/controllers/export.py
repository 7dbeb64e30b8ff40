"""A controller as C99 without malloc, and the proof that it does what Python does; its headers are C++, too.

``export_controller`` writes a folder that needs nothing but a C compiler: the model's step and its tangents
(:mod:`thermogrip.mpc.native.codegen`), the numbers of the design, and the solver, observer and loop that
every export shares (``csource/``).  ``check_export`` builds it with every warning an error, runs it under
the sanitizers of gcc, and compares a whole sample (observer, optimiser, limits) with Python from random
states: the drives, now and in the plan, and the status.

It is one sample, not a run, that is compared.  Of two controllers on the readings of one loop only one has
its moves applied; the other's estimate goes on under moves that never were, and what a controller makes of
readings alone need not be stable.  On a TCLab one of whose heaters must break its limit, 1e-14 between two
Python controllers is 2e-9 after 60 samples and half the range after 160.  Given what was applied, or each in
a loop of its own, C and Python stay within 1e-11 all the way.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from thermogrip import __version__
from thermogrip.datasets.arrays import Array
from thermogrip.datasets.atomic_files import write_atomic
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.media import markdown
from thermogrip.datasets.parallel import Progress
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.reference import ReferenceController
from thermogrip.mpc.design.design import DAY
from thermogrip.mpc.interface import STATUSES
from thermogrip.mpc.native import design_struct
from thermogrip.mpc.native.codegen import write_model
from thermogrip.mpc.native.runtime import SOURCES, c_source, compiler

if TYPE_CHECKING:
    from thermogrip.mpc.design.design import Design

_COPIED = (*SOURCES, "tg_design.h", "Makefile", "example.c", "check.c")
# of a drive's range; where dozens of soft rows are broken, a plan is a small difference of large multipliers,
# and C as well as Python is up to 1e-10 off the exact one; with hard limits, a thousand times as dear, 3e-9
_TOLERANCE, _HARD_TOLERANCE = 1e-9, 1e-8
_RESTS = 100  # from which random states depart


@dataclass(frozen=True)
class Export:
    """What was written."""

    folder: Path
    files: tuple[str, ...]


@dataclass(frozen=True)
class Agreement:
    """What a check found."""

    states: int
    difference: float  # largest difference of a drive, now or anywhere in the plan, in fractions of its range
    free: int  # in how many states the drive stood at no limit of range or slew, so that every weight counts
    same_status: int  # in how many states
    # bytes: code with constants, one controller, its design, and the largest frame of a function
    flash: int
    ram: int
    constants: int
    stack: int
    tolerance: float = _TOLERANCE  # of the difference

    @property
    def passed(self) -> bool:
        """Whether C and Python do the same."""
        return self.same_status == self.states and self.difference <= self.tolerance


def export_controller(controller: Controller, folder: str | Path, *, arduino: bool = False) -> Export:
    """Write a controller as C99 into a folder, made where absent; files of the same names are replaced.

    With ``arduino`` the folder is a library of the Arduino IDE, its example a loop to fill in.
    """
    if controller.design.on_off:
        problem = f"on_off: C does not choose when {', '.join(controller.design.on_off)} goes over"
        raise UserError(problem, hint="export a controller whose spec leaves it on")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    model = controller.model
    code = write_model(model.model, model.drive_index, model.dt / model.sub)
    sizes = design_struct.sizes_of(controller, code, room=False)
    constants_of = np.array(code.constants(model.p.tolist()))
    numbers = design_struct.numbers_of(controller, constants_of)
    files = {name: c_source(name) for name in _COPIED} | code.files
    files |= {
        "tg_config.h": design_struct.config_header(sizes),
        "tg_design.c": '#include "tg_design.h"\n\nconst tg_design tg_the_design = {\n'
        + design_struct.initialiser(sizes, numbers)
        + "\n};\n",
    }
    files["README.md"] = _readme(controller, sizes)
    if arduino:
        files = _as_library(controller, files)
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_atomic(folder / name, content)
    return Export(folder, tuple(sorted(files)))


def _as_library(controller: Controller, files: dict[str, str]) -> dict[str, str]:
    """Return these files as the Arduino IDE wants them; it refuses boards of four-byte doubles."""
    ends = ", ".join(controller.controlled)
    lines = {
        "name": "thermogrip_controller",
        "version": __version__,
        "author": "thermogrip",
        "maintainer": "thermogrip",
        "sentence": f"Model-predictive controller of {_one_line(ends)}.",
        "paragraph": f"Written for one plant; a step each {controller.dt:g} s.",
        "category": "Device Control",
        "url": "https://arxiv.org/abs/2111.15344",
        "architectures": "esp32,rp2040,mbed,samd,stm32,renesas_uno,teensy",
        "includes": "tg_design.h",
    }
    wide = '#if __SIZEOF_DOUBLE__ < 8\n#error "this board\'s double has 4 bytes"\n#endif\n'
    library = {"library.properties": "".join(f"{key}={value}\n" for key, value in lines.items())}
    library |= {"README.md": files["README.md"], "examples/loop/loop.ino": c_source("loop.ino")}
    parts = {name: files[name] for name in files if name.startswith("tg_")}
    parts["tg_config.h"] = parts["tg_config.h"].replace("typedef", wide + "\ntypedef", 1)
    return library | {f"src/{name}": content for name, content in parts.items()}


def _one_line(text: str) -> str:
    """Return a text whose characters may stand in a properties file."""
    return "".join(letter if letter.isprintable() else " " for letter in text)


def check_export(
    export: Export,
    controller: Controller,
    *,
    states: int = 3_000,
    seed: int = 0,
    sanitize: bool = True,
    progress: Progress | None = None,
) -> Agreement:
    """Build an export (with sanitizers too), step it from so many random states, and compare with Python; a
    UserError where there is no gcc, or it refuses the code."""
    if compiler() is None:
        raise UserError("no gcc here to build the export with", hint="install gcc, or leave --check out")
    twin = _twin(controller)
    rng = np.random.default_rng(seed)
    given = [_random_state(twin, rng) for _ in range(states)]
    with tempfile.TemporaryDirectory(dir=export.folder) as place:  # what else is in the folder is not run
        build = replace(export, folder=Path(place))
        for name in export.files:
            shutil.copyfile(export.folder / name, build.folder / name)
        _make(build.folder, "all", *(("sanitized",) if sanitize else ()))
        (ram, constants), answers = _answers(build, given, sanitize)
        flash, stack = _footprint(build.folder)
    found = np.zeros((states, 3))
    for at, (state, answer) in enumerate(zip(given, answers, strict=True)):
        found[at] = _compare(twin, state, answer.split())
        if progress is not None and at % 100 == 0:
            progress(at / states, "states")
    difference, free, status = found.T
    return Agreement(
        states,
        float(np.max(difference)),
        int(np.sum(free)),
        int(np.sum(status)),
        flash,
        ram,
        constants,
        stack,
        _HARD_TOLERANCE if controller.design.hard else _TOLERANCE,
    )


class _Clock:
    """A clock that does not move, or by a minute at every call."""

    def __init__(self) -> None:
        self.now, self.step = 0.0, 0.0

    def __call__(self) -> float:
        self.now += self.step
        return self.now


@dataclass(frozen=True)
class _State:
    """A controller in the middle of things, and the sample that it is given."""

    x: Array  # the estimate
    w: Array
    d: Array  # disturbances of the last sample, drives in force, and the plan (N, n_u) that it left, if any
    u: Array
    plan: Array | None
    plan_text: Array
    target: Array  # of the last sample
    side: Array
    y: Array
    d_now: Array
    wanted: Array
    late: bool  # the deadline passes before the optimiser can start
    time_s: float = np.nan  # of the last sample, where there is a tariff
    ramped: Array = field(default_factory=lambda: np.empty(0))  # where targets are that may only ramp

    def flat(self) -> Array:
        """Return the line that the C program reads."""
        has = [float(self.plan is not None)]
        before = (self.x, self.w, self.d, self.u, has, self.plan_text.ravel(), self.target, self.side)
        ramped = self.ramped if self.ramped.size else np.full(len(self.wanted), np.nan)
        after = (self.y, self.d_now, self.wanted, [float(self.late), self.time_s], ramped)
        return np.concatenate([*before, *after])


class _Twin(ReferenceController):
    """A controller that can be put into the middle of things."""

    _rests: tuple[tuple[Array, Array, Array], ...] = ()

    def random_rest(self, rng: np.random.Generator) -> tuple[Array, Array, Array]:
        """Return readings, measured disturbances and state at rest somewhere in the valid range, one of a
        hundred: each is a program to solve, which takes longer than a step."""
        if len(self._rests) < _RESTS:
            low, high = _range_of(self)
            y = rng.uniform(low, high) + 0.02 * (high - low) * rng.normal(size=self.model.n_y)
            around = 2 * self.model.close_d * rng.normal(size=self.model.n_d)  # of a room 1 degC
            room = self.model.undisturbed(self.design.ambient) + around
            self._rests += ((y, room, self.model.rest(y, room)),)
            return self._rests[-1]
        return self._rests[rng.integers(_RESTS)]

    def place(self, state: _State) -> None:
        """Put the loop into the middle of things; what is not named there is as after a reset."""
        self._start(np.full(self.model.n_y, self.design.ambient), state.d, self.observer.reset_in_room)
        self.observer.found_offset = np.zeros(self.model.n_y)
        self.observer.x, self.observer.w = state.x.copy(), state.w.copy()
        self._u = self._in_force = state.u.copy()
        self._plan = None if state.plan is None else state.plan.copy()
        self._target, self._side, self._fresh = state.target.copy(), state.side.copy(), False
        self.times.reset()
        self.times.begin(state.time_s)
        if state.ramped.size:
            self._ramped = state.ramped.copy()


def _twin(controller: Controller) -> _Twin:
    """Return the controller with a clock that only states move."""
    design: Design = replace(controller.design, deadline_s=1.0)
    return _Twin(controller.plant, design, clock=_Clock())


def _random_state(twin: _Twin, rng: np.random.Generator) -> _State:
    """Return a state near rest somewhere in the valid range, with a plan, a reading, and some misfortune."""
    model, design, n_c = twin.model, twin.design, len(twin.controlled)
    low, high = _range_of(twin)
    rest, room, x_rest = twin.random_rest(rng)
    # from next to settled to far away, so that the drive is at its limits in some states and free in others
    share = 10 ** rng.uniform(-3.0, 0.0)
    far = share * (high - low)
    x = x_rest + 0.1 * far * rng.normal(size=model.n_x)
    w = 0.1 * rng.normal(size=twin.disturbance.n_w) * np.where(twin.observer.is_drive, 0.2, 1.0)
    span = twin.optimiser.highest - twin.optimiser.lowest
    u = rng.uniform(twin.optimiser.lowest, twin.optimiser.highest)
    u = twin.optimiser.neutral + share * (u - twin.optimiser.neutral)
    u = u + (rng.random() < 0.02) * 0.1 * span  # now and then out of range
    N = sum(design.blocks)
    drift = u + np.cumsum(0.05 * span * rng.normal(size=(N, model.n_u)), axis=0)
    plan = np.clip(drift, twin.optimiser.lowest, twin.optimiser.highest)
    # near what is expected of this sample, or the reading would be left out as a jump and nothing be solved
    chosen = twin.disturbance
    after = model.next_state(x, u + chosen.on_drive @ w * model.span, room + chosen.on_disturbance @ w)
    y = model.output(after) + twin.observer.offset + chosen.on_output @ w
    y += 0.05 * far * rng.normal(size=model.n_y)
    y[rng.random(model.n_y) < 0.03] = np.nan
    target = rest[[model.outputs.index(name) for name in twin.controlled]] + far * rng.normal(size=n_c)
    same = rng.random() < 0.7  # else it has just moved
    wanted = target if same else target + far * rng.normal(size=n_c)
    late = bool(rng.random() < 0.05)
    none = rng.random() < (0.5 if late else 0.05)  # late and without a plan, it is the PI's turn
    return _State(
        *(x, w, room, u, None if none else plan, plan, target, rng.choice([-1.0, 0.0, 1.0], n_c), y),
        room + 0.2 * model.close_d * rng.normal(size=model.n_d),
        wanted,
        late,
        rng.uniform(0.0, DAY) if design.tariff else np.nan,
        target + far * rng.normal(size=n_c) if design.ramp_per_s and rng.random() < 0.9 else np.empty(0),
    )


def _range_of(controller: Controller | ReferenceController) -> tuple[float, float]:
    low, high = controller.model.plant.valid.get(controller.controlled[0], (15.0, 45.0))
    return float(low), float(high)


def _compare(twin: _Twin, state: _State, answer: list[str]) -> tuple[float, bool, bool]:
    """Return the difference of the drives, whether they are at no limit, and whether statuses agree."""
    model, optimiser = twin.model, twin.optimiser
    clock = twin.clock
    if isinstance(clock, _Clock):
        clock.step = 60.0 if state.late else 0.0
    twin.place(state)
    reading = dict(zip(model.outputs, state.y.tolist()))
    reading |= dict(zip(model.disturbances, state.d_now.tolist()))
    move = twin.step(reading, dict(zip(twin.controlled, state.wanted.tolist())))
    drive = np.array(move.drives(model.drives))
    plan = np.zeros((0, model.n_u)) if twin.plan is None else twin.plan
    ours = np.concatenate([drive[None], plan])
    theirs = np.array([float.fromhex(word) for word in answer[1:]]).reshape(-1, model.n_u)
    difference = float(np.max(np.abs(ours - theirs) / model.span)) if ours.shape == theirs.shape else np.inf
    low, high = (
        np.maximum(optimiser.lowest, state.u - optimiser.slew),
        np.minimum(optimiser.highest, state.u + optimiser.slew),
    )
    free = bool(np.all((drive > low + 1e-9) & (drive < high - 1e-9)))
    return difference, free, STATUSES[int(answer[0])] == move.status


def _run(program: Path, text: str) -> list[str]:
    """Return the lines that a program answers to these states."""
    command = [str(program.resolve())]
    done = subprocess.run(command, input=text, capture_output=True, text=True, check=False)
    if done.returncode:
        why = done.stderr.strip()[:300] or f"exit code {done.returncode}"  # a trap says nothing
        raise UserError(f"the export stopped: {why}", hint="report it: it must not")
    return done.stdout.splitlines()


def _answers(export: Export, given: list[_State], sanitize: bool) -> tuple[tuple[int, int], list[str]]:
    """Return the bytes of a controller and of a design, and what the C program answers to these states."""
    text = "\n".join(" ".join(float(v).hex() for v in state.flat()) for state in given) + "\n"
    head, *answers = _run(export.folder / "check", text)
    if sanitize:  # other flags, another program: it must live, and say the same
        _same_answers(answers, _run(export.folder / "sanitized", text)[1:])
    _, ram, _, constants = head.split()
    return (int(ram), int(constants)), answers


def _same_answers(plain: list[str], sanitized: list[str]) -> None:
    for one, two in zip(plain, sanitized, strict=True):
        ours, theirs = one.split(), two.split()
        drives, others = (np.array([float.fromhex(word) for word in part[1:]]) for part in (ours, theirs))
        if ours[0] != theirs[0] or not np.allclose(drives, others, rtol=_TOLERANCE, atol=_TOLERANCE):
            raise UserError(
                "the export answers otherwise under the sanitizers", hint="report it: it must not"
            )


def _make(folder: Path, *targets: str) -> None:
    command = ["make", "-s", "-C", str(folder), *targets]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        raise UserError("no make here to build the export with", hint="install make") from None
    if done.returncode:
        problem = done.stderr.strip().splitlines()[0] if done.stderr.strip() else "without a message"
        raise UserError(f"the export does not build: {problem}", hint="report it: it must")


def _footprint(folder: Path) -> tuple[int, int]:
    """Return the flash of the library's objects, and the largest frame on the stack [bytes]."""
    objects = sorted(str(path) for path in folder.glob("tg_*.o"))
    sizes = subprocess.run(["size", *objects], capture_output=True, text=True, check=False).stdout
    rows = [line.split() for line in sizes.splitlines()[1:]]
    flash = sum(int(row[0]) + int(row[1]) for row in rows)
    frames = [line.split() for path in folder.glob("tg_*.su") for line in path.read_text().splitlines()]
    return flash, max((int(frame[1]) for frame in frames), default=0)


def _listed(names: Sequence[str]) -> str:
    return ", ".join(markdown(name) for name in names)


def _readme(controller: Controller, sizes: design_struct.Sizes) -> str:
    model, design = controller.model, controller.design
    low, high = _range_of(controller)
    ranges = "; ".join(f"{markdown(name)} in [{a:g}, {b:g}]" for name, (a, b) in design.drive_range.items())
    n_d, controlled = max(1, model.n_d), design.controlled
    d, units = model.undisturbed(design.ambient), model.plant.units
    d_names = [f"{markdown(name)} [{units.get(name, 'degC')}]" for name in model.disturbances]
    return c_source("README.md.in").format(
        model=model,
        design=design,
        sizes=sizes,
        outputs=_listed(controlled),
        drives=_listed(model.drives),
        y_example=", ".join(["25.0"] * model.n_y),
        y_names=_listed(model.outputs),
        n_d_room=n_d,
        d_example=", ".join(f"{value:.1f}" for value in d) if model.n_d else f"{design.ambient:.1f}",
        d_names=", ".join(d_names) or "none",
        n_c=len(controlled),
        c_names=_listed(controlled),
        c_example=", ".join(["35.0"] * len(controlled)),
        n_u_last=model.n_u - 1,
        drives_ranges=ranges,
        iterations=design_struct.ITERATION_LIMIT,
        rest_error=_rest_error(controller, low, high),
        low=low,
        high=high,
    )


def _rest_error(controller: Controller, low: float, high: float) -> float:
    """Return by how much the state at rest is off that is linearised in the room, at most [degC]."""
    model, ambient = controller.model, controller.design.ambient
    room = model.undisturbed(ambient)
    observer = controller.design.observer(model)
    worst = 0.0
    for level in np.linspace(low, high, 5):
        y = np.full(model.n_y, level)
        observer.reset_in_room(y, room)
        mapped = observer.x
        observer.reset(y, room)
        worst = max(worst, float(np.max(np.abs(mapped - observer.x))))
    return worst
