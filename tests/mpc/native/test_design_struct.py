"""The numbers of a controller's C struct: sizes, offsets, rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from tests.mpc.makers import heater, kit, make_tank
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.native import design_struct
from thermogrip.mpc.native.codegen import ModelCode, _Line
from thermogrip.mpc.native.design_struct import numbers_of, sizes_of

#: Hands over 5, 7 and 6 numbers.
CODE = ModelCode("", "", 5, 7, 6, _Line())


def test_a_search_has_room_for_its_variants_and_an_export_for_itself():
    controller: Controller = kit(controlled=("t2",), limits={"t1": (0.0, 50.0)})
    tight, wide = (sizes_of(controller, CODE, room=room) for room in (False, True))
    N = sum(controller.design.blocks)
    assert (tight.NH, tight.NC, tight.NL, tight.NS) == (N, 1, 1, 2)
    assert (wide.NH % 32, wide.NC, wide.NL, wide.NS) == (0, 2, 2, 4)
    assert N <= wide.NH < N + 32
    model = controller.model
    assert (model.n_x, 2, model.n_d, 2) == (tight.NX, tight.NU, tight.ND, tight.NY)
    assert (tight.NK, tight.NF, tight.NM) == (5, 7, 6)
    assert model.n_x + controller.observer.disturbance.n_w == tight.NZ


def test_rows_of_the_response_are_as_long_as_the_last_of_four_samples_in_whole_groups_of_four():
    """Blocks 1, 1, 3, 2 of two drives: samples 1 to 4 end in block 3, 5 to 7 in block 4, 8 numbers each."""
    assert design_struct._row_lengths((1, 1, 3, 2), 2) == 4 * 8 + 3 * 8
    assert design_struct._row_lengths((1,) * 9, 1) == 4 * 4 + 4 * 8 + 12


def test_numbers_of_a_design_are_the_plants_offsets_and_its_rest_in_any_room():
    plant = replace(make_tank(), offsets={"t_tank": 0.4, "t_surface": -0.2})
    controller = Controller(plant, default_design(plant))
    model, ambient = controller.model, controller.design.ambient
    numbers = numbers_of(controller, np.zeros(3))
    assert numbers["offset"].tolist() == [0.4, -0.2]
    y, d = np.array([31.0, 28.0]), np.array([19.0])
    level = np.mean(y - numbers["offset"])
    x = numbers["rest"] + numbers["rest_level"] * (level - ambient) + numbers["rest_d"] @ (d - ambient)
    H = np.hstack([model.C, numbers["on_output"]])
    P = block_diag(numbers["P_rest"], np.diag(numbers["P0"]))
    miss = y - numbers["offset"] - model.output(x)
    after = x + (P @ H.T @ np.linalg.solve(H @ P @ H.T + np.diag(numbers["R_start"]), miss))[: model.n_x]
    controller.observer.reset(y, d)
    np.testing.assert_allclose(after, controller.observer.x, atol=1e-9)  # exactly so for a linear plant
    assert np.abs(numbers["rest_d"]).max() > 1e-4


def test_what_is_smaller_than_its_field_stands_in_the_fields_first_corner():
    sizes = replace(sizes_of(heater(), CODE, room=False), NB=3, NU=4)
    found = design_struct._padded(sizes, "at_rest", [[1, 2], [3, 4]])
    assert found.tolist() == [[1, 2, 0, 0], [3, 4, 0, 0], [0, 0, 0, 0]]
