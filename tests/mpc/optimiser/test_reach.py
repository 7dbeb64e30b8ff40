"""When a target that cannot be held is reported, and that no other is."""

from __future__ import annotations

import re

import numpy as np
import pytest

from thermogrip.mpc.closed_loop.simulate import simulate_closed_loop
from thermogrip.mpc.closed_loop.simulate_native import compiled_loop
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.native.build import wanted

LIMIT = {"t_tank": (8.0, 50.0)}
LEAKY = {"heat": 0.14, "loss": 1 / 150}  # 45.6 degC at most, and the model expects 102
WEAK = {"heat": 0.02}  # 38.7 degC at most
OPTIMUM = {"joule": 0.1}  # 5.5 degC at least, as far as its drive may go

#: truth, its model, limits, targets with seconds, after how many samples at most the last target is reported
#: as unreachable (None: never), and the value that can be held
ROWS = {
    "more loss than the model's, 1.4 K out of reach": (LEAKY, {}, {}, [(34, 180), (47, 300)], 100, 45.6),
    "more loss than the model's, 4.4 K out of reach": (LEAKY, {}, {}, [(34, 180), (50, 300)], 85, 45.6),
    "more loss than the model's, in reach": (LEAKY, {}, {}, [(34, 180), (45, 300)], None, 0),
    "a limit of the tank": ({}, {}, LIMIT, [(34, 180), (60, 500)], 1, 49.5),
    "nearly a limit of the tank": ({}, {}, LIMIT, [(34, 180), (48, 500)], None, 0),
    "an optimum": (OPTIMUM, OPTIMUM, {}, [(0, 600)], 2, 5.5),
    "far beyond an optimum": (OPTIMUM, OPTIMUM, {}, [(-20, 600)], 3, 5.5),
    "nearly an optimum": (OPTIMUM, OPTIMUM, {}, [(6, 600)], None, 0),
    "an end of the drive": (WEAK, WEAK, {}, [(42, 600)], 1, 38.7),
    "hardly beyond an end of the drive": (WEAK, WEAK, {}, [(39.5, 600)], 12, 38.7),
    "nearly an end of the drive": (WEAK, WEAK, {}, [(38, 600)], None, 0),
    "less power than the model's": ({"heat": 0.077}, {}, {}, [(34, 180), (38, 300)], None, 0),
}


@pytest.mark.parametrize("row", ROWS)
def test_a_target_out_of_reach_is_reported_soon_and_kept_and_no_other_is(row, tank_maker):
    truth, model, limits, schedule, latest, value = ROWS[row]
    plant, truth = tank_maker(**model), tank_maker(**truth)
    design = default_design(plant, dt=2.0, limits=limits, deadline_s=1e9)
    loop = simulate_closed_loop(Controller(plant, design), truth, schedule)
    first = sum(round(seconds / 2) for _, seconds in schedule[:-1])
    before, after = loop.status[:first], loop.status[first:]
    assert set(before) <= {"ok"}
    if latest is None:
        assert set(after) == {"ok"}
    else:
        first_said = after.index("infeasible")
        assert first_said <= latest
        assert set(after[first_said:]) == {"infeasible"}
        found = re.search(r"no drive holds .* degC: (-?[0-9.]+) degC can be held", loop.advice[-1])
        assert float(found[1]) == pytest.approx(value, abs=0.6)
    if wanted():
        compiled = compiled_loop(Controller(plant, design, compiled=True), truth, schedule)
        assert compiled.status == loop.status
        np.testing.assert_allclose(compiled.drive["drive"], loop.drive["drive"], atol=1e-5)
