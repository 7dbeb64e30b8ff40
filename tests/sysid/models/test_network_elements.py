"""Each element of a network by itself: who gets what heat, what a switch leaves, what a file may not say."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.models.network import NetworkModel, load_network
from thermogrip.sysid.models.network_spec import network_from_dict

KELVIN = 273.15


def fixed(unit: str, value: float) -> dict[str, Any]:
    return {"unit": unit, "value": value, "fixed": True}


def declared(numbers: dict[str, tuple[str, float]], **tables: Any) -> dict[str, Any]:
    """Two bodies a and b, whatever else there is, and the numbers with their units."""
    head = {"schema": "thermogrip.network", "version": 1, "name": "test", "dt": 1.0}
    usual = {
        "inputs": {"drive": {"unit": "1", "range": [-1.0, 1.0]}},
        "outputs": {"t": {"node": "a"}},
        "nodes": {"a": {"capacity": "C_a"}, "b": {"capacity": "C_b"}},
    }
    both = {"C_a": ("J/K", 30.0), "C_b": ("J/K", 60.0)} | numbers
    return head | usual | tables | {"parameters": {name: fixed(*item) for name, item in both.items()}}


def model_of(content: dict[str, Any]) -> NetworkModel:
    return NetworkModel(network_from_dict(content))


def heats(model: NetworkModel, x: list[float], u: list[float], d: tuple[float, ...] = ()) -> list[float]:
    return [float(q) for q in model.flows(x, u, list(d), model.prior.tolist())]


def test_a_bent_link_between_two_bodies_takes_from_one_what_it_gives_to_the_other():
    link = {"l": {"between": ["a", "b"], "conductance": "G", "bend": "bend"}}
    model = model_of(declared({"G": ("W/K", 2.0), "bend": ("1", 0.4)}, links=link))
    for a, b in ((20.0, 35.0), (35.0, 20.0)):
        given = 2.0 * (b - a) * (1 + 0.4 * 15.0 / 10)
        assert heats(model, [a, b], [0.0]) == pytest.approx([given, -given])


def peltier(unit: str, full: float, **more: str) -> NetworkModel:
    numbers = {
        "s": ("V/K", 0.05), "R": ("ohm", 2.0), "I": ("A", 6.0), "u0": ("1", 0.1), "r": ("1", 0.2)
    }  # fmt: skip
    element = {"face": "a", "sink": "b", "input": "drive", "seebeck": "s", "resistance": "R", "current": "I",
               "offset": "u0", "droop": "r"} | more  # fmt: skip
    inputs = {"drive": {"unit": unit, "range": [0.0, full]}}
    return model_of(declared(numbers, inputs=inputs, peltiers={"tec": element}))


@pytest.mark.parametrize(("unit", "full"), [("1", 1.0), ("percent", 100.0), ("0_255", 255.0)])
def test_an_element_sees_its_input_as_a_share_of_full_scale(unit: str, full: float):
    got = heats(peltier(unit, full), [40.0, 20.0], [0.5 * full])
    amps = 6.0 * 0.6 * (1 - 0.2 * 20.0 / 50)  # half of the range, and the offset on that scale
    joule = 2.0 * amps**2 / 2
    want = [0.05 * amps * (40.0 + KELVIN) + joule, -0.05 * amps * (20.0 + KELVIN) + joule]
    assert got == pytest.approx(want)
    heater = {"h": {"node": "a", "input": "drive", "power": "P"}}
    inputs = {"drive": {"unit": unit, "range": [0.0, full]}}
    link = {"l": {"between": ["a", "b"], "conductance": "G"}}
    numbers = {"P": ("W", 20.0), "G": ("W/K", 1.0)}
    model = model_of(declared(numbers, inputs=inputs, heaters=heater, links=link))
    assert heats(model, [25.0, 25.0], [full]) == pytest.approx([20.0, 0.0])


@pytest.mark.parametrize(
    ("said", "full"),
    [
        ({"unit": "W", "range": [0, 3000]}, 3000.0),
        ({"unit": "V", "range": [-12.0, 5.0]}, 12.0),
        ({"unit": "A", "range": [0.0, 0.5]}, 0.5),
        ({"unit": "V", "range": [0.0, 10.0], "full_scale": 24.0}, 24.0),
        ({"unit": "1", "range": [0.0, 0.6]}, 1.0),
        ({"unit": "1", "range": [0.0, 5.0]}, 5.0),
        ({"unit": "percent", "range": [0.0, 60.0]}, 100.0),
        ({"unit": "0_255", "range": [0, 100]}, 255.0),
    ],
)
def test_full_scale_has_one_meaning(said: dict[str, Any], full: float):
    heater = {"h": {"node": "a", "input": "drive", "power": "P"}}
    link = {"l": {"between": ["a", "b"], "conductance": "G"}}
    numbers = {"P": ("W", 20.0), "G": ("W/K", 1.0)}
    model = model_of(declared(numbers, inputs={"drive": said}, heaters=heater, links=link))
    assert heats(model, [25.0, 25.0], [full / 2]) == pytest.approx([10.0, 0.0])
    again = NetworkModel.from_dict(model.to_dict())
    assert heats(again, [25.0, 25.0], [full / 2]) == pytest.approx([10.0, 0.0])


def test_a_plant_of_version_0_1_0_keeps_its_full_scale_of_1():
    heater = {"h": {"node": "a", "input": "drive", "power": "P"}}
    link = {"l": {"between": ["a", "b"], "conductance": "G"}}
    inputs = {"drive": {"unit": "V", "range": [0.0, 10.0]}}
    numbers = {"P": ("W", 20.0), "G": ("W/K", 1.0)}
    content = model_of(declared(numbers, inputs=inputs, heaters=heater, links=link)).to_dict()
    del content["network"]["inputs"]["drive"]["full_scale"]
    assert heats(NetworkModel.from_dict(content), [25.0, 25.0], [0.5]) == pytest.approx([10.0, 0.0])


def test_a_duty_driver_heats_by_the_square_of_the_current_while_it_is_on():
    got = heats(peltier("1", 1.0, driver="duty"), [40.0, 20.0], [0.3])
    share, amps = 0.4, 6.0 * (1 - 0.2 * 20.0 / 50)
    joule = share * 2.0 * amps**2 / 2
    pumped = 0.05 * share * amps
    assert got == pytest.approx([pumped * (40.0 + KELVIN) + joule, -pumped * (20.0 + KELVIN) + joule])


def test_a_switch_that_names_nothing_to_be_left_leaves_nothing_and_a_film_goes_on():
    inputs = {"pump": {"unit": "1", "range": [0.0, 1.0], "switch": True}}
    links = {"l": {"between": ["a", "b"], "conductance": "G", "switch": "pump"}}
    tube = {"from": "b", "to": "a", "flow": "F", "delay": "D", "cells": 2, "switch": "pump",
            "wall_capacity": "C_w", "film": "G_f"}  # fmt: skip
    numbers = {
        "G": ("W/K", 2.0),
        "F": ("W/K", 5.0),
        "D": ("s", 3.0),
        "C_w": ("J/K", 4.0),
        "G_f": ("W/K", 8.0),
    }
    model = model_of(declared(numbers, inputs=inputs, links=links, pipes={"p": tube}))
    assert model.states == ("a", "b", "p.1", "p.1.wall", "p.2", "p.2.wall")
    x = [20.0, 30.0, 28.0, 26.0, 25.0, 24.0]
    still = [0.0, 0.0, 4.0 * (26.0 - 28.0), 4.0 * (28.0 - 26.0), 4.0 * (24.0 - 25.0), 4.0 * (25.0 - 24.0)]
    assert heats(model, x, [0.0]) == pytest.approx(still)
    moved = [
        2.0 * 10.0 + 5.0 * (25.0 - 20.0),
        -2.0 * 10.0,
        5.0 * (30.0 - 28.0),
        0.0,
        5.0 * (28.0 - 25.0),
        0.0,
    ]
    assert heats(model, x, [1.0]) == pytest.approx([a + b for a, b in zip(still, moved)])


def test_what_settles_within_a_step_has_settled_after_it():
    """L-stable: of a body that follows the room in a microsecond nothing is left after a second."""
    tables = {"disturbances": {"air": {}}, "links": {"l": {"between": ["a", "air"], "conductance": "G"},
              "m": {"between": ["b", "air"], "conductance": "G"}}}  # fmt: skip
    model = model_of(declared({"G": ("W/K", 1.0), "C_a": ("J/K", 1e-6), "C_b": ("J/K", 1e-6)}, **tables))
    room = np.full((1, 1, 1), 20.0)
    _, end = model.rollout(np.full((1, 2), 90.0), np.zeros((1, 1, 1)), room, model.prior[None], 1.0)
    np.testing.assert_allclose(end, 20.0, atol=1e-3)


def test_members_of_a_batch_switch_each_at_its_own_time():
    model, rng = load_network("gripper"), np.random.default_rng(1)
    u = np.stack([np.full((3, 60), 0.6), np.ones((3, 60))], axis=2)
    u[1, 20:40, 1] = 0.0
    u[2, 31:, 1] = 0.0
    x0, d = rng.uniform(20, 40, (3, model.n_x)), np.full((1, 60, 1), 24.0)
    _, end = model.rollout(x0, u, d, model.prior[None], 0.5)
    for b in range(3):
        alone = model.rollout(x0[b : b + 1], u[b : b + 1], d, model.prior[None], 0.5)[1][0]
        np.testing.assert_array_equal(end[b], alone)


def test_the_defaults_of_a_fit_go_by_the_step_and_the_spread_by_the_file():
    model = load_network("gripper")
    sd = [node.start_sd for node in model.network.nodes.values()]
    sd += [0.5] * (model.n_x - len(sd))  # water in tubes, and sensors that lag
    np.testing.assert_allclose(model.spread, np.diag(np.square(sd)))
    content = declared({"G": ("W/K", 1.0)}, dt=3.0, links={"l": {"between": ["a", "b"], "conductance": "G"}})
    assert (model_of(content).average, model_of(content).search_step) == (15.0, 3.0)
    fine = model_of(content | {"dt": 0.5})
    assert (fine.average, fine.search_step) == (5.0, 2.0)


# ---- at rest ----


def at_rest(model: NetworkModel, y: Any, u: Any, d: Any) -> np.ndarray:
    """The minimum of the module's theory by scipy's bounded least squares: the state, then the inputs."""
    units = {"1": 1.0, "percent": 100.0, "0_255": 255.0}
    moved = [name for name in model.inputs if name not in model.switches]
    low, high = np.array([model.network.inputs[name].range for name in moved]).T
    full = np.array([units[model.network.inputs[name].unit] for name in moved])
    at, n, y = [model.inputs.index(name) for name in moved], model.n_x, np.array(y, dtype=float)

    def residuals(z: np.ndarray) -> np.ndarray:
        v = np.array(u, dtype=float)
        v[at] = z[n:] * full
        heat = heats(model, z[:n].tolist(), v.tolist(), tuple(d))
        off = np.array(model.output(z[:n].tolist(), model.prior.tolist())) - y
        tie = 1e-3 * (z[n:] - np.array(u)[at] / full)
        return np.concatenate([heat, 1e2 * off[np.isfinite(y)], tie, 1e-6 * (z[:n] - np.nanmean(y))])

    free = np.full(n, 1e3)
    box = np.concatenate([-free, low / full - 1e-12]), np.concatenate([free, high / full + 1e-12])
    start = np.concatenate([np.full(n, np.nanmean(y)), np.clip(np.array(u)[at], low, high) / full])
    return least_squares(residuals, start, bounds=box, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-14).x


@pytest.mark.parametrize(
    ("name", "y", "u", "d"),
    [
        ("tclab", [40.0, 33.0], [30.0, 10.0], []),
        ("tclab", [40.0, np.nan], [30.0, 45.0], []),  # the second heater is where its input says
        ("gripper", [38.0, 36.0], [0.3, 1.0], [24.0]),
        ("gripper", [4.0, 12.0], [0.3, 0.0], [24.0]),
        ("peltier_chamber", [35.0], [0.0], [21.0]),
        ("peltier_chamber", [80.0], [0.0], [21.0]),  # more than the drive can hold
        ("tclab", [40.0, 19.0], [30.0, 10.0], []),  # colder than the room: no heater does that
    ],
)
def test_rest_is_the_minimum_that_its_theory_names(name: str, y: list[float], u: list[float], d: list[float]):
    model = load_network(name)
    x = model.rest(y, u, d, model.prior)
    np.testing.assert_allclose(x, at_rest(model, y, u, d)[: model.n_x], atol=2e-3)
    read = np.array(model.output(x, model.prior), dtype=float)
    np.testing.assert_allclose(read[np.isfinite(y)], np.array(y)[np.isfinite(y)], atol=1e-3)


# ---- what a file may not say ----


def heated() -> dict[str, Any]:
    """A heater and a Peltier element on two bodies in a room, joined by a link and a tube."""
    content = declared(
        {"G": ("W/K", 1.0), "F": ("W/K", 5.0), "D": ("s", 3.0), "P": ("W", 9.0), "s": ("V/K", 0.05),
         "R": ("ohm", 2.0), "I": ("A", 6.0)},
        disturbances={"air": {}},
        outputs={"t": {"node": "a", "reference": True}, "t2": {"node": "b"}},
        links={"l": {"between": ["a", "air"], "conductance": "G"}},
        pipes={"p": {"from": "a", "to": "b", "flow": "F", "delay": "D", "cells": 2}},
        heaters={"h": {"node": "a", "input": "drive", "power": "P"}},
        peltiers={"tec": {"face": "a", "sink": "b", "input": "drive", "seebeck": "s", "resistance": "R",
                          "current": "I"}},
    )  # fmt: skip
    network_from_dict(content)
    return content


@pytest.mark.parametrize(
    ("where", "change", "said"),
    [
        ("links.l", {"between": ["a", "a"]}, "links.l.between: joins a and a"),
        ("pipes.p", {"to": "air"}, "pipes.p.to: no node 'air'"),
        ("pipes.p", {"switch": "pump"}, "pipes.p.switch: no switch 'pump'"),
        ("pipes.p", {"loss": "G"}, "loss and surroundings come together"),
        ("pipes.p", {"surroundings": "air"}, "loss and surroundings come together"),
        ("pipes.p", {"film": "G"}, "wall_capacity and film come together"),
        ("heaters.h", {"node": "air"}, "heaters.h.node: no node 'air'"),
        ("peltiers.tec", {"sink": "air"}, "peltiers.tec.sink: no node 'air'"),
        ("peltiers.tec", {"input": "pump"}, "peltiers.tec.input: no input 'pump'"),
        ("outputs.t", {"wander": 0.1}, "wander and wander_time come together"),
        ("outputs.t2", {"reference": True}, "outputs: two are the reference"),
        ("links.l", {"switch": "drive", "off": "G"}, "no switch 'drive'"),
        ("parameters.G", {"low": -1.0}, "parameters.G: links.l.conductance must be positive"),
        ("parameters.G", {"sd": 0.1, "sd_log": 0.1}, "has both sd and sd_log"),
        ("parameters.G", {"per_log": 0.1}, "is fixed, so it cannot differ"),
        ("parameters.G", {"value": 0.0, "sd_log": 0.1}, "value 0 is not positive"),
        ("parameters.G", {"fixed": False, "sd": 0.1, "low": 1.0, "high": 1.0}, "lies outside 1 to 1"),
    ],
)
def test_what_contradicts_itself_is_refused_by_name(where: str, change: dict[str, Any], said: str):
    content = heated()
    table, key = where.split(".")
    content[table][key] |= change
    with pytest.raises(UserError, match=said):
        network_from_dict(content)


def test_what_a_switch_leaves_is_a_share():
    content = heated()
    content["inputs"]["pump"] = {"unit": "1", "range": [0.0, 1.0], "switch": True}
    content["links"]["l"] |= {"switch": "pump", "off": "left"}
    for value, low in ((1.2, 0.0), (0.5, -0.1)):
        wrong = copy.deepcopy(content)
        wrong["parameters"]["left"] = {"unit": "1", "value": value, "low": low, "high": 1.5, "fixed": True}
        with pytest.raises(UserError, match=r"links\.l\.off is what is left, 0 to 1"):
            network_from_dict(wrong)


def test_a_prior_is_bounded_five_of_its_deviations_away_on_its_own_scale():
    content = heated()
    content["parameters"]["G"] = {"unit": "W/K", "value": 2.0, "sd_log": 0.2}
    content["parameters"]["D"] = {"unit": "s", "value": 3.0, "sd": 0.5, "low": 0.1}
    found = network_from_dict(content).parameters
    assert found["G"].bounds == pytest.approx((2.0 * np.exp(-1.0), 2.0 * np.exp(1.0)))
    assert (found["D"].bounds, found["F"].bounds) == ((0.1, 5.5), (5.0, 5.0))
    assert [found[name].scale for name in ("G", "D")] == ["log", "linear"]
