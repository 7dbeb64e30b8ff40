"""A controller as C99 without malloc, and the proof that it does what Python does; its headers are C++, too.

``export_controller`` writes a folder that needs nothing but a C compiler: the model's step and its tangents
(:mod:`thermogrip.mpc.native.codegen`), the numbers of the design, and what every export shares
(``csource/``).  ``check_export`` compares drives, now and in the plan, and status with Python's.

In a loop C is given what was applied, Python's moves.  Of two controllers on the readings of one loop only
one has its moves applied; without them the other's estimate goes on under moves that never were, and what a
controller makes of readings alone need not be stable: on a TCLab one of whose heaters must break its limit,
1e-14 between two Python controllers is half the range after 160 samples.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from thermogrip import __version__
from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.files import write_atomic
from thermogrip.datasets.parallel import Progress
from thermogrip.media.rendering import markdown
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.controllers.reference import ReferenceController
from thermogrip.mpc.design.relays import Switches
from thermogrip.mpc.interface import STATUSES
from thermogrip.mpc.native import design_struct
from thermogrip.mpc.native.codegen import write_model
from thermogrip.mpc.native.runtime import SOURCES, SWITCHES, c_source, compiler, relays_header
from thermogrip.mpc.plant.prediction import drive_range

_COPIED = (*SOURCES, "tg_design.h", "Makefile", "example.c", "check.c")
# of a drive's range; where dozens of soft rows are broken, a plan is a small difference of large multipliers,
# and C as well as Python is up to 1e-10 off the exact one; hard limits weigh a thousand times as much
_TOLERANCE, _HARD_TOLERANCE = 1e-9, 1e-6
_LOOP = 40  # samples of a loop, from rest
_NEWS = 0.04  # probability of a new target, of a lost reading, of a step that is late, in a sample


@dataclass(frozen=True)
class Export:
    """What was written."""

    folder: Path
    files: tuple[str, ...]


@dataclass(frozen=True)
class Agreement:
    """What a check found."""

    states: int  # samples of random loops
    difference: float  # largest difference of a drive, now or anywhere in the plan, in fractions of its range
    free: int  # samples in which the drive stood at no limit of range or slew, so that every weight counts
    same_status: int  # samples with the same status
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
    """Write a controller as C99 into a folder, with ``arduino`` as a library of the Arduino IDE."""
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
    relays, section = relay_files(controller)
    files |= {"README.md": _readme(controller, sizes) + section} | relays
    if arduino:
        files = _as_library(controller, files)
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_atomic(folder / name, content)
    return Export(folder, tuple(sorted(files)))


def relay_files(controller: Controller | PIController) -> tuple[dict[str, str], str]:
    """Return the C of a controller's relays, and its section of the README; nothing where it has none."""
    relays, drives = controller.design.relays, controller.model.drives
    if not relays:
        return {}, ""
    switches = Switches(relays, {name: drive_range(controller.plant, name) for name in relays})
    files = {name: c_source(name) for name in SWITCHES} | {"tg_relays.h": relays_header(switches, drives)}
    names = ", ".join(f"{k} is {markdown(one.channel)}" for k, one in enumerate(switches.each))
    return files, c_source("README_relays.md.in").format(names=names)


def _as_library(controller: Controller, files: dict[str, str]) -> dict[str, str]:
    """Return these files as the Arduino IDE wants them; it refuses boards of four-byte doubles."""
    ends = ", ".join(controller.controlled)
    ends = "".join(letter if letter.isprintable() else " " for letter in ends)  # on one line
    lines = {
        "name": "thermogrip_controller",
        "version": __version__,
        "author": "thermogrip",
        "maintainer": "thermogrip",
        "sentence": f"Model-predictive controller of {ends}.",
        "paragraph": f"Written for one plant; a step each {controller.dt:g} s.",
        "category": "Device Control",
        "url": "https://arxiv.org/abs/2111.15344",
        "architectures": "esp32,rp2040,mbed,samd,stm32,renesas_uno,teensy",
        "includes": "tg_design.h",
    }
    wide = '#if __SIZEOF_DOUBLE__ < 8\n#error "this board\'s double has 4 bytes"\n#endif\n'
    library = {"library.properties": "".join(f"{key}={value}\n" for key, value in lines.items())}
    library |= {"README.md": files["README.md"], "examples/loop/loop.ino": c_source("loop.ino")}
    sources = {name: files[name] for name in files if name.startswith("tg_")}
    sources["tg_config.h"] = sources["tg_config.h"].replace("typedef", wide + "\ntypedef", 1)
    return library | {f"src/{name}": content for name, content in sources.items()}


def check_export(
    export: Export,
    controller: Controller,
    *,
    states: int = 3_000,
    seed: int = 0,
    sanitize: bool = True,
    progress: Progress | None = None,
) -> Agreement:
    """Build an export (with sanitizers too), run it in random loops, and compare with Python."""
    if compiler() is None:
        raise UserError("no gcc here to build the export with", hint="install gcc, or leave --check out")
    played = _random_loop(controller, states, seed, progress)
    with tempfile.TemporaryDirectory(dir=export.folder) as place:  # what else is in the folder is not run
        build = replace(export, folder=Path(place))
        for name in export.files:
            shutil.copyfile(export.folder / name, build.folder / name)
        make = ["make", "-s", "-C", str(build.folder), "all"]
        run_build([*make, "sanitized"] if sanitize else make)
        text = "".join(f"{sample.given}\n" for sample in played)
        head, *answers = _run_program(build.folder / "check", text)
        if sanitize:
            _run_program(build.folder / "sanitized", text)  # it must live
        flash, stack = footprint(build.folder)
    pairs = list(zip(played, answers, strict=True))
    return Agreement(
        states=states,
        difference=max(_drive_difference(sample, answer, controller.model.span) for sample, answer in pairs),
        free=sum(sample.free for sample in played),
        same_status=sum(sample.status == STATUSES[int(answer.split()[0])] for sample, answer in pairs),
        flash=flash,
        ram=int(head.split()[1]),
        constants=int(head.split()[3]),
        stack=stack,
        tolerance=_HARD_TOLERANCE if controller.design.hard else _TOLERANCE,
    )


class _Clock:
    """A clock that does not move, or by a minute at every call."""

    def __init__(self) -> None:
        self.now, self.step = 0.0, 0.0

    def __call__(self) -> float:
        self.now += self.step
        return self.now


@dataclass(frozen=True)
class _Sample:
    """What a controller is given and what Python answers."""

    given: str  # the line that the C program reads
    status: str
    drives: Array  # (1 + N, n_u) now and in the plan, in fractions of their ranges; (1, n_u) without a plan
    free: bool  # whether the drive stands at no limit of range or slew


def _random_loop(controller: Controller, samples: int, seed: int, progress: Progress | None) -> list[_Sample]:
    """Return what a controller in Python does on its own model, from rest to far targets and near ones."""
    clock = _Clock()
    twin = ReferenceController(controller.plant, replace(controller.design, deadline_s=1.0), clock=clock)
    model = twin.model
    rng = np.random.default_rng(seed)
    played = list[_Sample]()
    low, high = controller.plant.valid.get(controller.controlled[0], (15.0, 45.0))
    span = twin.drives.highest - twin.drives.lowest
    rows = [model.outputs.index(name) for name in twin.controlled]
    for k in range(samples):
        begins = k % _LOOP == 0
        if begins:
            level = rng.uniform(low, high) + 0.02 * (high - low) * rng.normal(size=model.n_y)
            d = model.undisturbed(twin.design.ambient)
            d = d + np.fmax(0.05 * np.ptp(model.seen_d, axis=1), 0.02 * abs(d)) * rng.normal(size=model.n_d)
            x = model.rest(level, d)
            # from next to settled to far away, so that the drive is at its limits in some loops
            distance = 10 ** rng.uniform(-3.0, 0.0) * (high - low)
            applied = twin.safe_drives + distance / (high - low) * rng.uniform(-0.5, 0.5, model.n_u) * span
        if begins or rng.random() < _NEWS:
            target = level[rows] + distance * rng.normal(size=len(rows))
        if rng.random() < _NEWS:  # out of range, now and then
            applied = rng.uniform(twin.drives.lowest - 0.1 * span, twin.drives.highest + 0.1 * span)
        y = model.output(x) + 0.01 * distance * rng.normal(size=model.n_y)
        y[rng.random(model.n_y) < _NEWS] = np.nan
        late = bool(rng.random() < _NEWS)
        clock.step = 60.0 if late else 0.0
        reading = dict(zip(model.outputs, y)) | dict(zip(model.disturbances, d))
        reading |= dict(zip(model.drives, applied))
        if begins:
            twin.reset(reading, in_room=True)
        move = twin.step(reading, dict(zip(twin.controlled, target)))
        drive = np.array(move.drives(model.drives))
        ahead = np.zeros((0, model.n_u)) if twin.plan is None else twin.plan
        least = np.maximum(twin.drives.lowest, applied - twin.drives.slew)
        most = np.minimum(twin.drives.highest, applied + twin.drives.slew)
        free = bool(np.all((drive > least + 1e-9) & (drive < most - 1e-9)))
        numbers = np.concatenate([[begins, late], y, d, applied, target])
        line = " ".join(float(number).hex() for number in numbers)
        played.append(_Sample(line, move.status, np.concatenate([drive[None], ahead]) / model.span, free))
        x, applied = model.next_state(x, drive, d), drive
        if progress is not None and k % 100 == 0:
            progress(k / samples, "samples")
    return played


def _drive_difference(sample: _Sample, answer: str, span: Array) -> float:
    """Return the largest difference of a drive, now or in the plan, in fractions of its range."""
    numbers = np.array([float.fromhex(word) for word in answer.split()[1:]])
    drives = numbers.reshape(-1, len(span)) / span
    return float(np.max(np.abs(drives - sample.drives))) if drives.shape == sample.drives.shape else np.inf


def _run_program(program: Path, text: str) -> list[str]:
    """Return the lines that a program answers to these samples."""
    command = [str(program.resolve())]
    done = subprocess.run(command, input=text, capture_output=True, text=True, check=False)
    if done.returncode:
        why = done.stderr.strip()[:300] or f"exit code {done.returncode}"  # a trap says nothing
        raise UserError(f"the export stopped: {why}", hint="report it: it must not")
    return done.stdout.splitlines()


def run_build(command: list[str]) -> None:
    """Build an export; what refuses it is a UserError with its first line."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        program = Path(command[0]).name
        raise UserError(f"no {program} here to build the export with", hint=f"install {program}") from None
    if done.returncode:
        problem = done.stderr.strip().splitlines()[0] if done.stderr.strip() else "without a message"
        raise UserError(f"the export does not build: {problem}", hint="report it: it must")


def footprint(folder: Path) -> tuple[int, int]:
    """Return the flash of the library's objects, and the largest frame on the stack [bytes]."""
    objects = sorted(str(path) for path in folder.glob("tg_*.o"))
    sizes = subprocess.run(["size", *objects], capture_output=True, text=True, check=False).stdout
    rows = [line.split() for line in sizes.splitlines()[1:]]
    flash = sum(int(row[0]) + int(row[1]) for row in rows)
    frames = [line.split() for path in folder.glob("tg_*.su") for line in path.read_text().splitlines()]
    return flash, max((int(frame[1]) for frame in frames), default=0)


def _name_list(names: Sequence[str]) -> str:
    return ", ".join(markdown(name) for name in names)


def _readme(controller: Controller, sizes: design_struct.Sizes) -> str:
    model, design = controller.model, controller.design
    ranges = "; ".join(f"{markdown(name)} in [{a:g}, {b:g}]" for name, (a, b) in design.drive_range.items())
    n_d, controlled = max(1, model.n_d), design.controlled
    d, units = model.undisturbed(design.ambient), model.plant.units
    d_names = [f"{markdown(name)} [{units.get(name, 'degC')}]" for name in model.disturbances]
    return c_source("README.md.in").format(
        model=model,
        design=design,
        sizes=sizes,
        outputs=_name_list(controlled),
        drives=_name_list(model.drives),
        y_example=", ".join(["25.0"] * model.n_y),
        y_names=_name_list(model.outputs),
        n_d_room=n_d,
        d_example=", ".join(f"{value:.1f}" for value in d) if model.n_d else f"{design.ambient:.1f}",
        d_names=", ".join(d_names) or "none",
        n_c=len(controlled),
        c_names=_name_list(controlled),
        c_example=", ".join(["35.0"] * len(controlled)),
        n_u_last=model.n_u - 1,
        drives_ranges=ranges,
        iterations=design_struct.ITERATION_LIMIT,
    )
