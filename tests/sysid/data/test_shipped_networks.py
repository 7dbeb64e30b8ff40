"""The network of the package that the columns of a log can be, by their names."""

from __future__ import annotations

import numpy as np
import pytest

from thermogrip.datasets.schema import make_log
from thermogrip.sysid.data.shipped_networks import (
    in_columns,
    in_log_units,
    in_logged_room,
    renamed,
    shipped_network,
)
from thermogrip.sysid.models.network import NetworkModel
from thermogrip.sysid.models.network_spec import builtin_networks, named_network
from thermogrip.sysid.plant.log_grid import match_logs

TIME = np.arange(200.0)
DRIVE = np.where(TIME % 50 < 20, 60.0, 10.0)
SWITCH = np.where(TIME % 70 < 30, 1.0, 0.0)
WARM = 23 + 0.05 * TIME


def board(**signals):
    return make_log(
        TIME, {"q_1": (DRIVE, "percent", "input"), "Q2": (SWITCH * 40, "percent", "input"), **signals}
    )


TEMPERATURES = {"TC1": (WARM, "1", "output"), "TC2": (WARM, "degC", "output")}


@pytest.mark.parametrize("name", builtin_networks())
def test_each_network_is_found_by_its_names_in_whatever_case(name):
    network = named_network(name)
    signals = {
        of.upper(): (SWITCH if item.switch else DRIVE / 100 * item.range[1], item.unit, "input")
        for of, item in network.inputs.items()
    }
    signals |= {of: (WARM, item.unit, "disturbance") for of, item in network.disturbances.items()}
    signals |= {of.title(): (WARM, item.unit, "output") for of, item in network.outputs.items()}
    found = shipped_network([make_log(TIME, signals)])
    assert found.name == name
    assert {*found.inputs, *found.disturbances, *found.outputs} == {*signals}


def test_a_named_network_takes_a_log_without_one_of_its_inputs_in_the_case_of_the_others():
    log = make_log(
        TIME, {"Q1": (DRIVE, "percent", "input"), "T1": (WARM, "1", "output"), "T2": (WARM, "1", "output")}
    )
    assert shipped_network([log]) is None
    tclab = NetworkModel(named_network("tclab"))
    assert in_columns(tclab, log).inputs == ("Q1", "Q2")
    assert in_columns(tclab, log.rename(Q1="q1", T1="t1", T2="t2")).inputs == ("q1", "q2")
    assert in_columns(tclab, log.drop_vars("T2")) is tclab  # an output is needed


def test_a_network_whose_input_never_moves_is_none():
    log = make_log(
        TIME,
        {
            "q1": (DRIVE, "percent", "input"),
            "q2": (0 * DRIVE, "percent", "input"),
            "t1": (WARM, "degC", "output"),
            "t2": (WARM, "degC", "output"),
        },
    )
    assert shipped_network([log]) is None
    assert shipped_network([log, log.assign(q2=log["q1"])]).name == "tclab"
    other = log.assign(q2=log["q1"]).rename(q1="first", t1="TC1")
    assert shipped_network([other]) is None  # roles and units alone name no network


def test_a_network_that_is_named_takes_columns_in_any_case_and_stays_itself_in_its_own():
    model = NetworkModel(named_network("tclab"))
    signals = dict.fromkeys(("Q1", "Q2"), (DRIVE, "percent", "input"))
    log = make_log(TIME, signals | dict.fromkeys(("T1", "t2"), (WARM, "degC", "output")))
    found = in_columns(model, log)
    assert (found.inputs, found.outputs) == (("Q1", "Q2"), ("T1", "t2"))
    own = log.rename({"Q1": "q1", "Q2": "q2", "T1": "t1"})
    assert in_columns(model, own) is model
    assert in_columns(model, log.drop_vars("t2")) is model  # which says what is missing


def test_only_names_of_signals_change():
    network = named_network("tank")
    other = renamed(network, {"heater": "leak", "valve": "tap", "t_inlet": "cold", "t_tank": "hot"})
    assert (*other.inputs, *other.disturbances) == ("leak", "tap", "cold", "t_ambient")
    assert other.parameters == network.parameters
    used = {pipe.source for pipe in other.pipes.values()} | {link.switch for link in other.links.values()}
    assert "valve" not in used
    assert [heater.power for heater in other.heaters.values()] == [h.power for h in network.heaters.values()]
    assert renamed(network, {"heater": "heater"}) is network


@pytest.mark.parametrize(
    ("unit", "values", "full_scale", "top"),
    [
        ("percent", DRIVE, 100.0, 100.0),
        ("0_255", DRIVE * 2.55, 255.0, 255.0),
        ("1", DRIVE / 100, 1.0, 1.0),
        ("1", SWITCH, 1.0, 1.0),
        ("1", DRIVE, 100.0, 100.0),  # without a unit and beyond 1: a number of the network's own unit
    ],
)
def test_a_network_takes_its_inputs_in_the_unit_of_the_log(unit, values, full_scale, top):
    log = make_log(TIME, {"heater": (values, unit, "input"), "t_hotend": (WARM, "degC", "output")})
    network = in_log_units(NetworkModel(named_network("hotend")), [log])
    heater = network.network.inputs["heater"]
    assert (heater.unit, heater.full_scale, heater.range[1]) == (unit, full_scale, top)
    assert match_logs(network, [log])[0][0] is log
    heat = []
    for model in (network, NetworkModel(named_network("hotend"))):
        p = [parameter.value for parameter in model.network.parameters.values()]
        half = model.network.inputs["heater"].full_scale / 2
        heat.append(np.array(list(model.heat([25.0, 25.0, 25.0], [half], [], p).values()), dtype=float))
    np.testing.assert_allclose(*heat, rtol=1e-12)
    assert heat[0].max() == pytest.approx(20.0)  # W, of a cartridge of 40


@pytest.mark.parametrize("readings", [np.full(200, 31.0), 31 + np.sin(TIME)], ids=["still", "moving"])
def test_a_room_that_was_logged_is_the_prior_of_one_that_a_network_does_not_measure(readings):
    log = board(**TEMPERATURES, t_ambient=(readings, "degC", "other"))
    tclab = NetworkModel(named_network("tclab"))
    model, notes = in_logged_room(tclab, [log])
    room = model.network.parameters["t_room"]
    assert room.value == pytest.approx(31.0, abs=0.1)
    assert room.sd == pytest.approx(np.hypot(1.0, readings.std()))
    assert room.bounds == tclab.network.parameters["t_room"].bounds
    assert "t_ambient" in notes[0]
    untold = [
        log.drop_vars("t_ambient"),
        log.assign(t_outside=log["t_ambient"]),
        log.assign(t_ambient=log["t_ambient"] + 50),
    ]
    assert all(in_logged_room(tclab, [each]) == (tclab, []) for each in untold)
    assert in_logged_room(tclab, [log, untold[0]]) == (tclab, [])
