"""Thermal networks: heat is conserved, limits hold, all back-ends agree, a file is refused by name."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

from tests.sysid.models.makers import roll_rows
from thermogrip.datasets.errors import UserError
from thermogrip.sysid.models.network import NetworkModel, load_network
from thermogrip.sysid.models.network_spec import builtin_networks, named_network, network_from_dict

KELVIN = 273.15


def fixed(unit: str, value: float) -> dict[str, Any]:
    return {"unit": unit, "value": value, "fixed": True}


def declare(**tables: Any) -> dict[str, Any]:
    head = {"schema": "thermogrip.network", "version": 1, "name": "test", "dt": 1.0}
    return head | {"inputs": {"drive": {"unit": "1", "range": [-1.0, 1.0]}}} | tables


def everything() -> dict[str, Any]:
    """A small network with one element of each kind."""
    return declare(
        inputs={
            "drive": {"unit": "1", "range": [-1.0, 1.0]},
            "pump": {"unit": "1", "range": [0.0, 1.0], "switch": True},
            "q": {"unit": "percent", "range": [0.0, 100.0]},
        },
        disturbances={"air": {}},
        outputs={"t": {"node": "far", "lag": "lag"}},
        nodes={n: {"capacity": f"C_{n}"} for n in ("tank", "sink", "far")},
        boundaries={"room": {"temperature": "t_room"}},
        links={
            "loss": {"between": ["tank", "air"], "conductance": "G_loss"},
            "fin": {"between": ["room", "sink"], "conductance": "G_fin", "bend": "bend"},
            "bridge": {"between": ["tank", "far"], "conductance": "G_b", "switch": "pump", "off": "left"},
        },
        pipes={
            "out": {"from": "tank", "to": "far", "flow": "F", "delay": "delay", "cells": 2, "switch": "pump",
                    "off": "left", "wall_capacity": "C_tube", "film": "G_film", "film_off": "left",
                    "loss": "G_tube", "surroundings": "air"},
            "back": {"from": "far", "to": "tank", "flow": "F", "delay": "delay", "cells": 1, "switch": "pump",
                     "off": "left"},
        },
        radiation={"glow": {"between": ["sink", "room"], "area": "area", "emissivity": "eps"}},
        heaters={"h": {"node": "far", "input": "q", "power": "P"}},
        peltiers={"tec": {"face": "tank", "sink": "sink", "input": "drive", "seebeck": "a", "resistance": "R",
                          "conductance": "K", "current": "I", "offset": "u0", "cooling_gain": "g",
                          "droop": "r", "dead_zone": "v0", "seebeck_slope": "a1", "resistance_slope": "R1"}},
        parameters={
            "C_tank": fixed("J/K", 500.0), "C_sink": fixed("J/K", 200.0), "C_far": fixed("J/K", 80.0),
            "t_room": fixed("degC", 21.0), "G_loss": fixed("W/K", 0.7), "G_fin": fixed("W/K", 2.0),
            "G_b": fixed("W/K", 1.1),
            "left": {"unit": "1", "value": 0.1, "low": 0.0, "high": 1.0, "fixed": True},
            "F": fixed("W/K", 12.0), "delay": fixed("s", 8.0), "C_tube": fixed("J/K", 30.0),
            "G_film": fixed("W/K", 4.0), "G_tube": fixed("W/K", 0.3), "lag": fixed("s", 3.0),
            "area": fixed("m2", 0.05), "eps": fixed("1", 0.9), "P": fixed("W", 20.0), "a": fixed("V/K", 0.09),
            "R": fixed("ohm", 4.0), "K": fixed("W/K", 0.4), "I": fixed("A", 4.0), "u0": fixed("1", 0.02),
            "g": fixed("1", 0.9), "r": fixed("1", 0.15), "v0": fixed("1", 0.05), "bend": fixed("1", 0.4),
            "a1": fixed("1/K", 0.003), "R1": fixed("1/K", 0.005),
        },
    )  # fmt: skip


def everything_by_hand(
    t: float, x: np.ndarray, drive: float, pump: float, q: float, air: float
) -> list[float]:
    """The same network written out, independent of the code under test."""
    tank, sink, far, out1, wall1, out2, wall2, back, sensor = x
    on = 0.1 + 0.9 * pump
    F, film, tube = 12.0 * on, 2.0 * on, 0.15
    v = drive + 0.02
    v = 0.0 if abs(v) < 0.05 else v - 0.05 * np.sign(v)
    warm = (tank + sink) / 2 - 25.0
    seebeck, half_R = 0.09 * (1 + 0.003 * warm), 2.0 * (1 + 0.005 * warm)
    gain, sign = (1.0, 1.0) if v > 0 else (0.9, -1.0)
    amps = 4.0 * gain * v * (1 - sign * 0.15 * (tank - sink) / 50)
    into_tank = seebeck * amps * (tank + KELVIN) + half_R * amps**2 + 0.4 * (sink - tank)
    into_sink = -seebeck * amps * (sink + KELVIN) + half_R * amps**2 - 0.4 * (sink - tank)
    glow = 5.670374419e-8 * 0.05 * 0.9 * ((21.0 + KELVIN) ** 4 - (sink + KELVIN) ** 4)
    bridge = 1.1 * on * (far - tank)
    cell, wall, back_cell = 12.0 * 8.0 / 2, 30.0 / 2, 12.0 * 8.0
    return [
        (into_tank + 0.7 * (air - tank) + bridge + F * (back - tank)) / 500.0,
        (into_sink + 2.0 * (21.0 - sink) * (1 + 0.4 * abs(21.0 - sink) / 10) + glow) / 200.0,
        (-bridge + F * (out2 - far) + 20.0 * q / 100) / 80.0,
        (F * (tank - out1) + film * (wall1 - out1)) / cell,
        (film * (out1 - wall1) + tube * (air - wall1)) / wall,
        (F * (out1 - out2) + film * (wall2 - out2)) / cell,
        (film * (out2 - wall2) + tube * (air - wall2)) / wall,
        F * (far - back) / back_cell,
        (far - sensor) / 3.0,
    ]


def model_of(content: dict[str, Any]) -> NetworkModel:
    return NetworkModel(network_from_dict(content))


def test_every_element_agrees_with_an_independent_solver():
    model = model_of(everything())
    x = np.array([25.0, 24.0, 26.0, 25.0, 25.0, 25.5, 25.0, 25.0, 26.0])
    rows = [(0.8, 1.0, 30.0, 22.0), (-0.7, 1.0, 0.0, 22.5), (-0.7, 0.0, 60.0, 20.0), (0.0, 1.0, 0.0, 22.0)]
    h, n = 0.05, 1200
    u = np.repeat([row[:3] for row in rows], n, axis=0)[None]
    d = np.repeat([row[3:] for row in rows], n, axis=0)[None]
    y, end = model.rollout(x[None], u, d, model.prior[None], h)
    want = x
    for k, row in enumerate(rows):
        run = solve_ivp(
            everything_by_hand, (0, h * n), want, args=row, rtol=1e-10, atol=1e-10, method="LSODA"
        )
        want = run.y[:, -1]
        np.testing.assert_allclose(y[0, (k + 1) * n, 0], want[-1], atol=2e-5)
    np.testing.assert_allclose(end[0], want, atol=2e-5)


def test_halving_the_step_quarters_the_error():
    model = model_of(everything())
    x = np.full((1, model.n_x), 25.0)

    def end(steps: int) -> np.ndarray:
        u = np.tile([0.9, 1.0, 50.0], (1, steps, 1))
        return model.rollout(x, u, np.full((1, steps, 1), 20.0), model.prior[None], 64.0 / steps)[1][0]

    exact = end(4096)
    errors = [np.abs(end(n) - exact).max() for n in (64, 128, 256)]
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.25)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.2)


def pipe(cells: int) -> NetworkModel:
    return model_of(
        declare(
            disturbances={"source": {}},
            outputs={"t": {"node": "end"}},
            nodes={"end": {"capacity": "C"}},
            pipes={"p": {"from": "source", "to": "end", "flow": "F", "delay": "delay", "cells": cells}},
            parameters={"C": fixed("J/K", 1e-3), "F": fixed("W/K", 20.0), "delay": fixed("s", 9.0)},
        )
    )


@pytest.mark.parametrize("cells", [1, 5, 12])
def test_a_pipe_delays_by_its_declared_delay(cells: int):
    model, h = pipe(cells), 0.1
    y, _ = model.rollout(
        np.zeros((1, model.n_x)), np.zeros((1, 2000, 1)), np.ones((1, 2000, 1)), model.prior[None], h
    )
    mean_delay = float(np.sum(1 - (y[0, 1:, 0] + y[0, :-1, 0]) / 2) * h)
    assert mean_delay == pytest.approx(9.0, abs=2e-3)


@pytest.mark.parametrize("name", ["gripper", "peltier_chamber", "tclab", "everything"])
def test_compiled_rows_and_symbols_run_the_same_equations(name: str):
    import casadi as ca

    model = model_of(everything()) if name == "everything" else load_network(name)
    rng, n, batch = np.random.default_rng(3), 40, 3
    low, high = np.array([item.range for item in model.network.inputs.values()]).T
    u = rng.uniform(low, high, (batch, n, len(low)))
    d = rng.uniform(18.0, 28.0, (batch, n, len(model.disturbances)))
    x0 = rng.uniform(15.0, 45.0, (batch, model.n_x))
    p = model.prior * rng.uniform(0.8, 1.2, (batch, model.prior.size))
    y, end = model.rollout(x0, u, d, p, model.dt)
    y_rows, end_rows = roll_rows(model.step, model.output, x0, u, d, p, model.dt)
    np.testing.assert_allclose(y_rows, y, rtol=0, atol=1e-10)
    np.testing.assert_allclose(end_rows, end, rtol=0, atol=1e-10)
    parts = [
        ca.SX.sym(k, m) for k, m in (("x", model.n_x), ("u", len(low)), ("d", d.shape[2]), ("p", p.shape[1]))
    ]
    step = model.step(*[ca.vertsplit(part) if part.numel() else [] for part in parts], model.dt)
    function = ca.Function("step", parts, [ca.vertcat(*step)])
    for b in range(batch):
        x = ca.DM(x0[b])
        for k in range(n):
            x = function(x, ca.DM(u[b, k]), ca.DM(d[b, k]), ca.DM(p[b]))
        np.testing.assert_allclose(np.array(x).ravel(), end[b], rtol=0, atol=1e-10)


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_an_isolated_network_keeps_its_heat_and_evens_out(data: st.DataObject):
    n = data.draw(st.integers(2, 7))
    number = st.floats(-2.0, 2.0)
    links = [(i, data.draw(st.integers(0, i - 1))) for i in range(1, n)]  # a tree, so connected
    links += [(0, n - 1)] * (n > 2)
    capacity = [10.0 ** data.draw(number) for _ in range(n)]
    conductance = [10.0 ** data.draw(number) for _ in links]
    model = model_of(
        declare(
            outputs={"t": {"node": "n0"}},
            nodes={f"n{i}": {"capacity": f"C{i}"} for i in range(n)},
            links={
                f"l{k}": {"between": [f"n{i}", f"n{j}"], "conductance": f"G{k}"}
                for k, (i, j) in enumerate(links)
            },
            parameters={f"C{i}": fixed("J/K", c) for i, c in enumerate(capacity)}
            | {f"G{k}": fixed("W/K", g) for k, g in enumerate(conductance)},
        )
    )
    x0 = np.array([[data.draw(st.floats(-20.0, 90.0)) for _ in range(n)]])
    mean = float(np.average(x0[0], weights=capacity))
    for h in (0.1, 100.0):
        _, end = model.rollout(x0, np.zeros((1, 50, 1)), np.zeros((1, 50, 0)), model.prior[None], h)
        assert np.dot(capacity, end[0]) == pytest.approx(np.dot(capacity, x0[0]), rel=1e-9, abs=1e-6)
        spread = np.average((end[0] - mean) ** 2, weights=capacity)
        assert spread <= np.average((x0[0] - mean) ** 2, weights=capacity) * (1 + 1e-9) + 1e-12


def test_a_file_that_is_not_toml_is_refused(tmp_path: Any):
    path = tmp_path / "net.toml"
    path.write_text("[nodes\n")
    with pytest.raises(UserError, match=r"net\.toml: is not TOML"):
        named_network(path)
    with pytest.raises(UserError, match="no network 'griper'"):
        load_network("griper")


def test_a_network_survives_being_saved():
    for name in builtin_networks():
        model = load_network(name)
        again = NetworkModel.from_dict(model.to_dict())
        assert again.network == model.network
        assert again.states == model.states


# ---- each element by itself ----


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


def heats(model: NetworkModel, x: list[float], u: list[float], d: tuple[float, ...] = ()) -> list[float]:
    return [float(q) for q in model.heat(x, u, list(d), model.prior.tolist()).values()]


def test_a_bent_link_between_two_bodies_takes_from_one_what_it_gives_to_the_other():
    link = {"l": {"between": ["a", "b"], "conductance": "G", "bend": "bend"}}
    model = model_of(declared({"G": ("W/K", 2.0), "bend": ("1", 0.4)}, links=link))
    for a, b in ((20.0, 35.0), (35.0, 20.0)):
        given = 2.0 * (b - a) * (1 + 0.4 * 15.0 / 10)
        assert heats(model, [a, b], [0.0]) == pytest.approx([given, -given])


def test_of_two_elements_of_each_kind_each_has_its_own_numbers():
    bodies = {"r1": {"between": ["a", "b"], "area": "A1", "emissivity": "e1"},
              "r2": {"between": ["room", "a"], "area": "A2", "emissivity": "e2"}}  # fmt: skip
    heaters = {
        "h1": {"node": "a", "input": "q", "power": "P1"},
        "h2": {"node": "b", "input": "v", "power": "P2"},
    }
    inputs = {"q": {"unit": "percent", "range": [0.0, 100.0]}, "v": {"unit": "V", "range": [0.0, 12.0]},
              "s": {"unit": "1", "range": [0.0, 1.0], "switch": True}}  # fmt: skip
    links = {"l1": {"between": ["a", "b"], "conductance": "G1", "bend": "n1"},
             "l2": {"between": ["b", "room"], "conductance": "G2", "switch": "s", "off": "o2"},
             "l3": {"between": ["room", "a"], "conductance": "G3", "bend": "n3", "switch": "s",
                    "off": "o3"}}  # fmt: skip
    numbers = {"A1": ("m2", 0.5), "e1": ("1", 0.9), "A2": ("m2", 2.0), "e2": ("1", 0.3), "P1": ("W", 20.0),
               "P2": ("W", 50.0), "G1": ("W/K", 2.0), "n1": ("1", 0.4), "G2": ("W/K", 3.0),
               "G3": ("W/K", 5.0), "n3": ("1", 0.7), "t_room": ("degC", 15.0), "o2": ("1", 0.25),
               "o3": ("1", 0.5)}  # fmt: skip
    content = declared(numbers, inputs=inputs, heaters=heaters, radiation=bodies, links=links)
    content["boundaries"] = {"room": {"temperature": "t_room"}}
    for name in ("o2", "o3"):
        content["parameters"][name] |= {"low": 0.0, "high": 1.0}
    model, black = model_of(content), 5.670374419e-8
    for on in (1.0, 0.0):
        kept2, kept3 = 0.25 + 0.75 * on, 0.5 + 0.5 * on
        one = 2.0 * 20 * (1 + 0.4 * 2.0) + 0.45 * black * ((50 + KELVIN) ** 4 - (30 + KELVIN) ** 4)
        room = 5.0 * kept3 * -15 * (1 + 0.7 * 1.5) + 0.6 * black * ((15 + KELVIN) ** 4 - (30 + KELVIN) ** 4)
        want = [one + room + 20.0 * 0.4, -one + 3.0 * kept2 * -35 + 50.0 * 0.25]
        assert heats(model, [30.0, 50.0], [40.0, 3.0, on]) == pytest.approx(want)


def test_of_two_peltiers_each_has_its_own_numbers():
    names = ("seebeck", "resistance", "conductance", "current", "offset")
    names += ("heating_gain", "cooling_gain", "droop", "dead_zone")
    units = ["V/K", "ohm", "W/K", "A", "1", "1", "1", "1", "1"]
    first = [0.05, 2.0, 0.3, 6.0, 0.1, 0.9, 0.8, 0.2, 0.05]
    second = [0.02, 3.0, 0.7, 4.0, -0.2, 1.1, 0.7, 0.1, 0.1]
    numbers = {
        f"{n}{k}": (u, v) for k, each in enumerate((first, second)) for n, u, v in zip(names, units, each)
    }
    elements = {
        f"tec{k}": {"face": face, "sink": sink, "input": drive} | {n: f"{n}{k}" for n in names}
        for k, (face, sink, drive) in enumerate((("a", "b", "x"), ("b", "a", "y")))
    }
    inputs = {name: {"unit": "1", "range": [-1.0, 1.0]} for name in "xy"}
    model, want = model_of(declared(numbers, inputs=inputs, peltiers=elements)), np.zeros(2)
    t = np.array([40.0, 20.0])
    for (s, R, K, top, u0, up, down, r, dead), face, v in ((first, 0, 0.5), (second, 1, -0.4)):
        v += u0
        v = np.sign(v) * max(abs(v) - dead, 0.0)
        rise = t[face] - t[1 - face]
        amps = top * v * (up if v > 0 else down) * (1 - np.sign(v) * r * rise / 50)
        want[face] += s * amps * (t[face] + KELVIN) + R * amps**2 / 2 - K * rise
        want[1 - face] += -s * amps * (t[1 - face] + KELVIN) + R * amps**2 / 2 + K * rise
    assert heats(model, t.tolist(), [0.5, -0.4]) == pytest.approx(want.tolist())


def test_what_a_network_says_of_its_signals_is_what_its_file_says():
    content = everything()
    content["outputs"] = {
        "t": {"node": "far", "lag": "lag", "sd": 0.3, "log_sd": 0.2},
        "ref": {"node": "tank", "reference": True},
    }
    content["disturbances"]["air"] = {"log_sd": 0.7}
    content["inputs"]["q"]["step"] = 0.5
    content["nodes"]["sink"]["start_sd"] = 3.0
    model = model_of(content | {"average": 7.0, "dt": 0.5})
    assert (model.reference, model.sensor_sd) == ("ref", {"t": 0.3, "ref": 0.1})
    assert model.command_steps == {"q": 0.5}
    assert model.nuisance == {"t": 0.2, "ref": 0.0, "air": 0.7}
    assert (model.switches, model.average, model.dt) == (("pump",), 7.0, 0.5)
    assert (model.independent, model.warmup, model.smooth) == (60.0, 60.0, 20.0)
    np.testing.assert_allclose(np.sqrt(np.diag(model.spread)), [1.0, 3.0, 1.0] + [0.5] * 6)
    point = np.arange(20.0, 29.0) ** 1.5, [0.3, 1.0, 40.0], [22.0], model.prior
    capacities = [q / rate for q, rate in zip(model.heat(*point).values(), model.rates(*point).values())]
    assert capacities == pytest.approx([500.0, 200.0, 80.0, 48.0, 15.0, 48.0, 15.0, 96.0, 3.0])
    plain = model_of(everything())
    assert (plain.reference, plain.command_steps) == (None, {})
    assert "lag" not in model.to_dict()["network"]["outputs"]["ref"]
    with pytest.raises(UserError, match="the model holds no network; save the plant again"):
        NetworkModel.from_dict({"kind": "network"})
    with pytest.raises(UserError, match="no output has a reading to start from"):
        model.rest([np.nan, np.nan], [0.0, 1.0, 0.0], [20.0], model.prior)


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


def heated(**drive: Any) -> NetworkModel:
    """A heater of 20 W on the first body."""
    heater = {"h": {"node": "a", "input": "drive", "power": "P"}}
    link = {"l": {"between": ["a", "b"], "conductance": "G"}}
    numbers = {"P": ("W", 20.0), "G": ("W/K", 1.0)}
    return model_of(declared(numbers, inputs={"drive": drive}, heaters=heater, links=link))


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
    model = heated(**said)
    assert heats(model, [25.0, 25.0], [full / 2]) == pytest.approx([10.0, 0.0])
    again = NetworkModel.from_dict(model.to_dict())
    assert heats(again, [25.0, 25.0], [full / 2]) == pytest.approx([10.0, 0.0])


def test_a_plant_of_version_0_1_0_keeps_its_full_scale_of_1():
    content = heated(unit="V", range=[0.0, 10.0]).to_dict()
    del content["network"]["inputs"]["drive"]["full_scale"]
    assert heats(NetworkModel.from_dict(content), [25.0, 25.0], [0.5]) == pytest.approx([10.0, 0.0])


def test_a_plant_of_version_0_2_0_may_have_a_sensor_that_wanders():
    model = load_network("tclab")
    content = model.to_dict()
    content["network"]["outputs"]["t1"] |= {"wander": 0.1, "wander_time": 3000.0}
    assert NetworkModel.from_dict(content).to_dict() == model.to_dict()


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
    assert model_of(content).average == 15.0
    fine = model_of(content | {"dt": 0.5})
    assert fine.average == 5.0


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


@pytest.mark.parametrize(
    ("name", "y", "u", "d"),
    [("gripper", [38.0, np.nan], [0.3, 1.0], [24.0]), ("tclab", [62.0, 33.0], [90.0, 0.0], [])],
)
def test_rest_for_many_parameters_is_that_for_each(name: str, y: list[float], u: list[float], d: list[float]):
    model = load_network(name)
    p = model.prior * np.exp(np.random.default_rng(3).normal(0.0, 0.4, (9, model.prior.size)))
    found = model.rest_of_each(y, u, d, p)
    np.testing.assert_array_equal(found, [model.rest(y, u, d, row) for row in p])
    np.testing.assert_allclose(found[-1], model.rest_of_each(y, u, d, p[-1:])[0], rtol=0, atol=0)
    if name == "tclab":  # all of the heater holds some of them there, and not others
        nodes, full = len(model.network.nodes), [100.0, 0.0]
        gains = [sum(list(model.heat(x, full, d, row).values())[:nodes]) for x, row in zip(found, p)]
        assert min(gains) < -0.01
        assert max(gains) > 0.01


# ---- what a file may not say ----


@pytest.mark.parametrize(
    ("where", "change", "said"),
    [
        (
            "nodes.tank",
            {"capacity": "C_tnak"},
            r"no parameter 'C_tnak'; there are C_tank.*; did you mean 'C_tank'\?",
        ),
        ("nodes", {"lone": {"capacity": "C_tank"}}, "nodes.lone: no element touches it"),
        ("nodes", {"air": {"capacity": "C_tank"}}, "nodes.air: the name is in disturbances"),
        ("links.loss", {"speed": "F"}, "links.loss.speed"),
        ("links.loss", {"between": ["tank", "moon"]}, "links.loss.between: no node 'moon'"),
        ("links.loss", {"between": ["air", "room"]}, "joins air and room"),
        ("links.loss", {"between": ["tank", "tank"]}, "links.loss.between: joins tank and tank"),
        ("links.bridge", {"switch": "drive"}, "no switch 'drive'"),
        ("pipes.out", {"to": "air"}, "pipes.out.to: no node 'air'"),
        ("pipes.out", {"switch": "moon"}, "pipes.out.switch: no switch 'moon'"),
        ("pipes.out", {"cells": 0}, "pipes.out.cells"),
        ("pipes.out", {"film": None}, "wall_capacity and film come together"),
        ("pipes.out", {"wall_capacity": None}, "wall_capacity and film come together"),
        ("pipes.out", {"surroundings": None}, "loss and surroundings come together"),
        ("pipes.out", {"loss": None}, "loss and surroundings come together"),
        ("heaters.h", {"node": "air"}, "heaters.h.node: no node 'air'"),
        ("heaters.h", {"input": "heat"}, "heaters.h.input: no input 'heat'"),
        ("peltiers.tec", {"sink": "air"}, "peltiers.tec.sink: no node 'air'"),
        ("peltiers.tec", {"input": "fan"}, "peltiers.tec.input: no input 'fan'"),
        ("outputs.t", {"node": "nowhere"}, "outputs.t.node: no node 'nowhere'"),
        ("outputs", {k: {"node": "far", "reference": True} for k in "ab"}, "outputs: two are the reference"),
        ("inputs.q", {"unit": "furlong"}, "inputs.q.unit"),
        ("inputs.q", {"range": [5.0, 5.0]}, r"inputs.q.range: \[5.0, 5.0\] is empty"),
        ("parameters.C_tank", {"value": -5.0}, "parameters.C_tank: nodes.tank.capacity must be positive"),
        ("parameters.C_tank", {"value": 0.0}, "parameters.C_tank: nodes.tank.capacity must be positive"),
        ("pipes.out", {"cells": 61}, "pipes.out.cells"),
        ("nodes.tank", {"start_sd": 0.0}, "nodes.tank.start_sd"),
        ("parameters.C_tank", {"low": -1.0}, "parameters.C_tank: nodes.tank.capacity must be positive"),
        ("parameters.C_tank", {"unit": "W/K"}, "'W/K', but nodes.tank.capacity is in J/K"),
        ("parameters.C_tank", {"unit": None}, "parameters.C_tank.unit"),
        ("parameters.C_tank", {"fixed": False}, "C_tank: has no prior"),
        ("parameters.C_tank", {"sd": 0.1, "sd_log": 0.1}, "has both sd and sd_log"),
        ("parameters.C_tank", {"per_log": 0.1}, "is fixed, so it cannot differ"),
        ("parameters.C_tank", {"value": 0.0, "sd_log": 0.1}, "value 0 is not positive"),
        ("parameters.F", {"fixed": False, "sd": 0.1, "low": 12.0, "high": 12.0}, "lies outside 12 to 12"),
        ("parameters.left", {"high": 0.01}, "lies outside"),
        ("parameters.left", {"value": 1.2, "high": 1.5}, r"links\.bridge\.off is what is left, 0 to 1"),
        ("parameters.left", {"value": 0.5, "low": -0.1}, r"links\.bridge\.off is what is left, 0 to 1"),
        ("parameters", {"idle": fixed("W", 1.0)}, "parameters.idle: no element names it"),
        ("", {"version": 2}, "version"),
    ],
)
def test_what_contradicts_itself_is_refused_by_name(where: str, change: dict[str, Any], said: str):
    content: Any = everything()
    table = content
    for key in filter(None, where.split(".")):
        table = table[key]
    table |= change
    for key in [key for key, value in change.items() if value is None]:
        del table[key]
    with pytest.raises(UserError, match=said):
        network_from_dict(content)


def test_a_prior_is_bounded_five_of_its_deviations_away_on_its_own_scale():
    content = everything()
    content["parameters"]["F"] = {"unit": "W/K", "value": 2.0, "sd_log": 0.2}
    content["parameters"]["delay"] = {"unit": "s", "value": 3.0, "sd": 0.5, "low": 0.1}
    found = network_from_dict(content).parameters
    assert found["F"].bounds == pytest.approx((2.0 * np.exp(-1.0), 2.0 * np.exp(1.0)))
    assert (found["delay"].bounds, found["lag"].bounds) == ((0.1, 5.5), (3.0, 3.0))
    content["parameters"]["delay"] = {"unit": "s", "value": 3.0, "sd": 0.5, "high": 4.0}
    assert network_from_dict(content).parameters["delay"].bounds == (0.5, 4.0)
    content["parameters"]["u0"] = fixed("1", -0.02)  # an offset may have either sign
    assert network_from_dict(content).parameters["u0"].value == -0.02
    content["pipes"]["out"]["cells"] = 60
    assert network_from_dict(content).pipes["out"].cells == 60
    assert [found[name].scale for name in ("F", "delay")] == ["log", "linear"]
