"""PI loops as C99: three files and a README, and the proof that they do what Python does.

The C is called once a sample.
"""

from __future__ import annotations

import ctypes
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.files import write_atomic
from thermogrip.datasets.parallel import Progress
from thermogrip.media.rendering import markdown
from thermogrip.mpc.controllers.export import Agreement, Export, footprint, relay_files, run_build
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.estimator.call_times import SAME
from thermogrip.mpc.interface import STATUSES
from thermogrip.mpc.native.runtime import c_source, compiler
from thermogrip.mpc.native.shared_constants import UNCUT

_WARN = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-pedantic", "-O2")
_PI_TOLERANCE = 1e-12  # of a range: the same operations in the same order
_RUN = 100  # samples between two resets
_LOST_SHARE = 0.05  # of readings, and of targets


def export_pi(controller: PIController, folder: str | Path) -> Export:
    """Write PI loops as C99 into a folder, made where absent."""
    if len(controller.loops) < len(controller.controlled):
        raise UserError("an output has no loop, and C has no drive for it", hint="export the MPC")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    files = {name: c_source(name) for name in ("tg_pi.h", "tg_pi.c")}
    relays, section = relay_files(controller)
    files |= {"tg_pi_config.h": _config(controller), "README.md": _pi_readme(controller) + section} | relays
    for name, content in files.items():
        write_atomic(folder / name, content)
    return Export(folder, tuple(sorted(files)))


def _config(controller: PIController) -> str:
    """Return the header with the numbers of the loops, in the order of the controlled outputs."""
    model, loop_of = controller.model, {i: k for k, (_, i) in enumerate(controller.ends)}
    loops = [controller.loops[loop_of[i]] for i in range(len(controller.controlled))]
    arrays: dict[str, ArrayLike] = {
        "Kc": [loop.Kc for loop in loops],
        "Ti": [loop.Ti for loop in loops],
        "setpoint": [loop.setpoint for loop in loops],
        "lowest": controller.drives.lowest,
        "highest": controller.drives.highest,
        "slew": controller.drives.slew,
        "safe": controller.safe_drives,
        "uncut": UNCUT * model.span,
    }
    drives = ", ".join(str(model.drives.index(loop.drive)) for loop in loops)
    lines = [
        "typedef double tg_real; /* of four bytes on small boards */",
        f"#define TG_NC {len(loops)}",
        f"#define TG_NU {model.n_u}",
        f"#define TG_DT ((tg_real){controller.dt!r})",
        f"#define TG_PATIENCE ((tg_real){controller.design.patience_s * (1 + SAME)!r})",
        f"#define TG_COLDEST ((tg_real){float(model.coldest)!r})",
        f"#define TG_HOTTEST ((tg_real){float(model.hottest)!r})",
        f"static const int tg_drive[] = {{{drives}}};",
    ]
    for name, values in arrays.items():
        numbers = ", ".join(f"(tg_real){value!r}" for value in np.asarray(values, float).tolist())
        lines.append(f"static const tg_real tg_{name}[] = {{{numbers}}};")
    return "\n".join(["/* The numbers of the loops. */", *lines, ""])


def _pi_readme(controller: PIController) -> str:
    drives = controller.model.drives
    ends = zip(drives, controller.drives.lowest.tolist(), controller.drives.highest.tolist())
    count = len(controller.controlled)
    return c_source("README_pi.md.in").format(
        outputs=", ".join(markdown(name) for name in controller.controlled),
        drives=", ".join(markdown(name) for name in drives),
        y_example=", ".join(["25.0"] * count),
        target_example=", ".join(["35.0"] * count),
        dt=controller.dt,
        last=len(drives) - 1,
        ranges="; ".join(f"{markdown(name)} in [{low:g}, {high:g}]" for name, low, high in ends),
        patience=controller.design.patience_s,
    )


def check_pi(
    export: Export,
    controller: PIController,
    *,
    states: int = 3_000,
    seed: int = 0,
    progress: Progress | None = None,
) -> Agreement:
    """Build an export and run it beside Python, with readings and targets that are lost."""
    gcc = compiler()
    if gcc is None:
        raise UserError("no gcc here to build the export with", hint="install gcc, or leave --check out")
    with tempfile.TemporaryDirectory() as place:
        library, source = Path(place) / "pi.so", str(export.folder / "tg_pi.c")
        run_build([gcc, *_WARN, "-shared", "-fPIC", source, "-o", str(library), "-lm"])
        run_build([gcc, *_WARN, "-fstack-usage", "-c", source, "-o", str(Path(place) / "tg_pi.o")])
        flash, stack = footprint(Path(place))
        loops = ctypes.CDLL(str(library))
        compared = _differences_from_c(loops, controller, states, seed, progress)
    difference, free, same = compared.T
    n_c, n_u = len(controller.controlled), controller.model.n_u
    return Agreement(
        states=states,
        difference=float(np.max(difference)),
        free=int(np.sum(free)),
        same_status=int(np.sum(same)),
        flash=flash,
        ram=8 * (4 * n_c + n_u),
        constants=8 * (3 * n_c + 5 * n_u) + 4 * n_c,
        stack=stack,
        tolerance=_PI_TOLERANCE,
    )


def _differences_from_c(
    library: ctypes.CDLL, controller: PIController, states: int, seed: int, progress: Progress | None
) -> Array:
    """Return by sample the largest difference of a drive in ranges, whether none is limited, and whether the
    status is the same (states, 3)."""
    real = ctypes.c_double
    rng = np.random.default_rng(seed)
    model = controller.model
    controlled = controller.controlled
    n_c, n_u = len(controlled), model.n_u
    state = (real * (4 * n_c + n_u))()
    low, high = np.array([controller.plant.valid.get(name, (15.0, 60.0)) for name in controlled]).T
    python = PIController(controller.plant, controller.design)
    compared, target = np.zeros((states, 3)), 0.5 * (low + high)
    for k in range(states):
        y = rng.uniform(low, high) * np.where(rng.random(n_c) < _LOST_SHARE, np.nan, 1.0)
        if k % _RUN == 0:
            python.times.reset()
            u = rng.uniform(python.drives.lowest, python.drives.highest)
            python.reset(dict(zip(controlled, y)) | dict(zip(model.drives, u)))
            library.tg_pi_reset(state, (real * n_c)(*y), (real * n_u)(*u))
        if rng.random() < _LOST_SHARE:
            target = rng.uniform(low, high)
        move = python.step(dict(zip(controlled, y)), dict(zip(controlled, target)))
        status = library.tg_pi_step(state, (real * n_c)(*y), (real * n_c)(*target))
        ours, theirs = np.array(move.drives(model.drives)), np.array(state[4 * n_c :])
        limited = np.any((ours <= python.drives.lowest) | (ours >= python.drives.highest))
        same = STATUSES[status] == move.status
        compared[k] = np.max(np.abs(ours - theirs) / model.span), not limited, same
        if progress is not None and k % 100 == 0:
            progress(k / states, "samples")
    return compared
