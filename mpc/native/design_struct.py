"""A controller's numbers for its C code: one table says what the C struct holds, and every form of it.

From the same table come the declaration of ``tg_design`` in C, the ``ctypes`` view of it, and the constant
initialiser of an export, so that none of the three can drift from the others.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.mpc.native.shared_constants import shared_definitions

if TYPE_CHECKING:
    from thermogrip.mpc.design.design import Design
    from thermogrip.mpc.native.codegen import ModelCode
    from thermogrip.mpc.optimiser.rti import ControllerParts
    from thermogrip.mpc.plant.prediction import PredictionModel

ITERATION_LIMIT = 500

#: name -> (whole number?, shape in names of sizes, comment)
_FIELDS: dict[str, tuple[bool, tuple[str, ...], str]] = {
    "n_b": (True, (), "blocks of the plan"),
    "N": (True, (), "samples of the horizon"),
    "sub": (True, (), "steps of the model in a sample"),
    "n_c": (True, (), "controlled outputs"),
    "n_l": (True, (), "limited outputs"),
    "n_loops": (True, (), "of the PI controller"),
    "iteration_limit": (True, (), "of the quadratic program"),
    "blocks": (True, ("NB",), "samples in each block"),
    "controlled": (True, ("NC",), "which outputs"),
    "limited": (True, ("NL",), "which outputs"),
    "loop_drive": (True, ("NC",), "what each loop moves"),
    "loop_output": (True, ("NC",), "and which controlled output it controls"),
    "pair": (True, ("NU",), "controlled output that each drive is there for"),
    "strongest": (True, ("NU",), "controlled output that each drive moves most"),
    "seen": (True, ("NB", "NU"), "whether the horizon shows a block's response"),
    "fixed": (True, ("NY",), "whether the offset of a sensor is found at the start, and stays"),
    "iterations": (True, (), "programs a sample, at most"),
    "linear": (True, (), "whether the plant is linear, so that its derivatives never change"),
    "read_from": (True, ("NY",), "the first state that an output reads, and the first behind the last"),
    "read_to": (True, ("NY",), ""),
    "dt": (False, (), "sample time [s]"),
    "track": (False, (), "weights of the cost"),
    "terminal": (False, (), ""),
    "weight": (False, ("NC",), "factor on the error of each controlled output"),
    "move": (False, (), ""),
    "drive": (False, (), ""),
    "price": (False, (), "of an output in the overshoot band"),
    "dear": (False, ("NL",), "of one beyond its limits"),
    "zone": (False, ("NC",), "half width about a target in which an output may be anywhere, 0: none"),
    "energy": (False, ("NU",), "of a sample at full drive"),
    "ramp": (False, ("NC",), "fastest change of a target [its unit per s], 0: any"),
    "overshoot": (False, (), "band beyond the target [degC]"),
    "patience_s": (False, (), "how long a plan is followed without a solve [s]"),
    "ambient": (False, (), "room where none is measured [degC]"),
    "room": (True, (), "which measured disturbance is the room's temperature, -1: none"),
    "warm": (True, ("NY",), "whether an output is one whose mean is the level at rest"),
    "usual_d": (False, ("ND",), "measured disturbances where none is read"),
    "least_d": (False, ("ND",), "what they may be"),
    "most_d": (False, ("ND",), ""),
    "spike": (False, ("NY",), "off its prediction a reading is a loose plug, unless it stays [degC]"),
    "unit": (False, ("NY",), "in what figures of an output count"),
    "coldest": (False, (), "what a reading may be [degC]"),
    "hottest": (False, (), ""),
    "reach": (False, ("NB",), "samples of slew from now to the middle of a block"),
    "lowest": (False, ("NU",), "range of the drives"),
    "highest": (False, ("NU",), ""),
    "span": (False, ("NU",), "unit of the drives in the program"),
    "slew": (False, ("NU",), "largest change in a sample"),
    "neutral": (False, ("NU",), "drive at rest"),
    "safe": (False, ("NU",), "where a drive goes when its loop fails"),
    "limit_low": (False, ("NL",), "[degC]"),
    "limit_high": (False, ("NL",), "[degC]"),
    "at_rest": (False, ("NB", "NU"), "response to each block at rest"),
    "begin": (False, ("NU",), "the drives there"),
    "Kc": (False, ("NC",), "gain of each loop [drive units per degC]"),
    "Ti": (False, ("NC",), "its integral time [s]"),
    "setpoint": (False, ("NC",), "share of a change of the target that its gain answers to"),
    "k": (False, ("NK",), "what the parameters fix in the model's step"),
    "C": (False, ("NY", "NX"), "outputs from the state"),
    "y0": (False, ("NY",), ""),
    "on_drive": (False, ("NU", "NW"), "where the disturbance states enter"),
    "on_disturbance": (False, ("ND", "NW"), ""),
    "on_output": (False, ("NY", "NW"), ""),
    "offset": (False, ("NY",), "sensor offsets [degC]"),
    "R": (False, ("NY",), "variance of a reading"),
    "Q": (False, ("NZ", "NZ"), "covariance that a sample adds"),
    "P0": (False, ("NW",), "variance of the disturbance states at rest"),
    "R_start": (False, ("NY",), "variance of a reading at rest"),
    "rest": (False, ("NX",), "state at rest where all is at `ambient` and `usual_d`"),
    "rest_level": (False, ("NX",), "how it answers to the mean of the readings"),
    "rest_d": (False, ("NX", "ND"), "and to the measured disturbances"),
    "by_x": (False, ("NO", "NX"), "of a linear plant, the soft rows of each sample by the state,"),
    "by_d": (False, ("NO", "ND"), "by the disturbances,"),
    "by_none": (False, ("NO",), "and without them"),
    "P_rest": (False, ("NX", "NX"), "covariance of the states in which the plant may rest"),
}


@dataclass(frozen=True)
class Sizes:
    """Lengths of the arrays."""

    NX: int  # states, drives, measured disturbances, outputs, disturbance states
    NU: int
    ND: int
    NY: int
    NW: int
    NB: int  # at most so many blocks, samples, controlled and limited outputs
    NH: int
    NC: int
    NL: int
    NE: int  # numbers in the rows of the response
    NR: int  # targets of all samples, where some may only ramp
    NO: int  # soft rows of all samples, of a linear plant
    NK: int  # what the model's ``prepare``, ``hold`` and ``partials`` hand over
    NF: int
    NM: int
    LEAN: int  # whether soft rows are so many that the broken ones are eliminated

    @property
    def NS(self) -> int:
        """Soft rows of a sample."""
        return self.NC + self.NL

    @property
    def NZ(self) -> int:
        """States of the observer."""
        return self.NX + self.NW

    def shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of a field, as NumPy has it."""
        return tuple(getattr(self, size) for size in _FIELDS[name][1])


def sizes_of(controller: ControllerParts, code: ModelCode, *, room: bool) -> Sizes:
    """Return the sizes of a controller; with ``room``, such that its variants in a search fit too."""
    model, design = controller.model, controller.design
    N, n_y = sum(design.blocks), model.n_y
    controlled, limited = (n_y, n_y) if room else (len(design.controlled), len(design.limits))
    most = -(-N // 32) * 32 if room else N
    longest = _multiple_of_four(len(design.blocks) * model.n_u)
    entries = most * longest if room else _row_lengths(design.blocks, model.n_u)
    return Sizes(
        NX=model.n_x,
        NU=model.n_u,
        ND=model.n_d,
        NY=n_y,
        NW=controller.observer.disturbance.n_w,
        NB=len(design.blocks),
        NH=most,
        NC=controlled,
        NL=limited,
        NE=(controlled + limited) * entries,
        NR=most * controlled if design.ramp_per_s else 0,
        NO=0 if model.affine is None else most * (controlled + limited),
        NK=code.n_k,
        NF=code.n_h,
        NM=code.n_m,
        LEAN=int(N * (len(design.controlled) + len(design.limits)) >= 4 * len(design.blocks) * model.n_u),
    )


def _multiple_of_four(n: int) -> int:
    """Return n numbers in whole groups of four, as the C has its rows."""
    return -(-n // 4) * 4


def _row_lengths(blocks: Sequence[int], n_u: int) -> int:
    """Return the sum of the lengths of one output's rows: those of four samples are as long as the last."""
    of_sample = np.repeat(np.arange(1, len(blocks) + 1), blocks)
    last = np.minimum(np.arange(len(of_sample)) // 4 * 4 + 3, len(of_sample) - 1)
    return sum(_multiple_of_four(int(b) * n_u) for b in of_sample[last])


def config_header(sizes: Sizes) -> str:
    """Return ``tg_config.h``: the sizes, and the struct of a design."""
    names = [*(entry.name for entry in fields(Sizes)), "NS"]
    lines = ["/* Sizes and numbers of one controller. */", "#ifndef TG_CONFIG_H", "#define TG_CONFIG_H", ""]
    lines += [f"#define TG_{name} {getattr(sizes, name)}" for name in names]
    lines += ["", "/* What the C shares with the Python. */", *shared_definitions()]
    lines += ["", "typedef struct {"]
    for name, (whole, _, comment) in _FIELDS.items():
        shape = sizes.shape(name)
        room = f"[{max(1, int(np.prod(shape)))}]" if _FIELDS[name][1] else ""
        note = f" /* {comment} */" if comment else ""
        lines.append(f"    {'int' if whole else 'double'} {name}{room};{note}")
    return "\n".join([*lines, "} tg_design;", "", "#endif", ""])


def as_structure(sizes: Sizes, numbers: dict[str, Any]) -> ctypes.Structure:
    """Return ``tg_design`` as ctypes sees it, filled."""
    fields = []
    for name, (whole, shape, _) in _FIELDS.items():
        kind: Any = ctypes.c_int if whole else ctypes.c_double
        fields.append((name, kind * max(1, int(np.prod(sizes.shape(name)))) if shape else kind))
    struct: type[ctypes.Structure] = type("tg_design", (ctypes.Structure,), {"_fields_": fields})
    design = struct()
    for name, (whole, shape, _) in _FIELDS.items():
        if shape:
            flat = _padded(sizes, name, numbers[name]).ravel().tolist()
            getattr(design, name)[: len(flat)] = [int(v) for v in flat] if whole else flat
        else:
            setattr(design, name, int(numbers[name]) if whole else float(numbers[name]))
    return design


def initialiser(sizes: Sizes, numbers: dict[str, Any]) -> str:
    """Return the text between the braces of a constant ``tg_design``."""
    lines = []
    for name, (whole, shape, _) in _FIELDS.items():
        values = _padded(sizes, name, numbers[name]).ravel().tolist() if shape else [numbers[name]]
        texts = [str(int(v)) if whole else repr(float(v)) for v in values] or ["0"]
        rows = [", ".join(texts[first : first + 6]) for first in range(0, len(texts), 6)]
        joined = ",\n        ".join(rows)
        lines.append(f"    .{name} = {{{joined}}}," if shape else f"    .{name} = {joined},")
    return "\n".join(lines)


def numbers_of(controller: ControllerParts, k: Array) -> dict[str, Any]:
    """Return every number of the table for a controller; ``k`` is what ``prepare`` gave."""
    model = controller.model
    design = controller.design
    optimiser = controller.optimiser
    observer = controller.observer
    loops = design.loops
    resting = observer.rest_in_room
    rows = [model.outputs.index(name) for name in (*design.controlled, *design.limits)]
    limits = np.array(list(design.limits.values()), dtype=float).reshape(-1, 2)
    same_names = (
        (model, "sub dt span C spike unit coldest hottest least_d most_d warm"),
        (design, "iterations blocks track terminal move drive price overshoot patience_s ambient"),
        (optimiser, "reach"),
        (optimiser.drives, "lowest highest slew neutral safe"),
        (optimiser.weights, "dear zone"),
        (optimiser.at_rest, "pair strongest seen"),
        (observer, "fixed offset R Q P0 R_start"),
        (observer.disturbance, "on_drive on_disturbance on_output"),
    )
    return {name: getattr(source, name) for source, names in same_names for name in names.split()} | {
        "n_b": len(design.blocks),
        "N": sum(design.blocks),
        "n_c": len(design.controlled),
        "n_l": len(design.limits),
        "room": int(np.argmax(model.rooms)) if model.rooms.any() else -1,
        "usual_d": model.undisturbed(design.ambient),
        "n_loops": len(loops),
        "iteration_limit": ITERATION_LIMIT,
        "ramp": [design.ramp_per_s.get(name, 0.0) for name in design.controlled],
        "controlled": rows[: len(design.controlled)],
        "limited": rows[len(design.controlled) :],
        "loop_drive": [model.drives.index(loop.drive) for loop in loops],
        "loop_output": [design.controlled.index(loop.output) for loop in loops],
        "linear": model.affine is not None,
        "read_from": [int(np.argmax(row != 0)) for row in model.C],
        "read_to": [model.n_x - int(np.argmax(row[::-1] != 0)) if row.any() else 0 for row in model.C],
        "limit_low": limits[:, 0],
        "limit_high": limits[:, 1],
        "weight": optimiser.weights.output,
        "energy": [design.energy_price.get(name, 0.0) for name in model.drives],
        "at_rest": optimiser.at_rest.response,
        "begin": optimiser.at_rest.drive,
        **{name: [getattr(loop, name) for loop in loops] for name in ("Kc", "Ti", "setpoint")},
        "k": k,
        "y0": model.output(np.zeros(model.n_x)),
        "rest": resting.x,
        "rest_level": resting.by_level,
        "rest_d": resting.by_d,
        "P_rest": resting.P,
        **_free_response(model, design, rows),
    }


def _free_response(model: PredictionModel, design: Design, rows: list[int]) -> dict[str, Any]:
    """Return what a linear plant's outputs of these rows are in each sample where drives are 0, by the
    state, by the disturbances, and besides."""
    if model.affine is None:
        return {"by_x": np.zeros((0, model.n_x)), "by_d": np.zeros((0, model.n_d)), "by_none": np.zeros(0)}
    from_zero = model.affine
    by_x, by_rest, _ = model.response(design.blocks)
    by_none = by_rest @ from_zero.after + model.output(np.zeros(model.n_x))
    responses = {"by_x": by_x, "by_d": by_rest @ from_zero.E, "by_none": by_none}
    return {
        name: response[:, rows].reshape(len(response) * len(rows), *response.shape[2:])
        for name, response in responses.items()
    }


def _padded(sizes: Sizes, name: str, values: Any) -> Array:
    """Return the values in an array of the field's size; what is beyond them is 0."""
    array = np.asarray(values, dtype=float)
    full = np.zeros(sizes.shape(name))
    full[tuple(slice(0, n) for n in array.shape)] = array
    return full
