"""Heat that is logged and that nobody drives: a tank under a lamp, as a network and as a black box."""

from __future__ import annotations

import numpy as np
import pytest

from tests.end_to_end.conftest import Bench
from thermogrip.datasets.log_files import write_log
from thermogrip.datasets.schema import Log, make_log
from thermogrip.mpc import Controller, default_design, tune
from thermogrip.mpc.design.spec import Spec
from thermogrip.report.html import Plot
from thermogrip.report.plant import identification_sections
from thermogrip.sysid import Plant, identify
from thermogrip.sysid.export.dynamics import plant_dynamics
from thermogrip.sysid.identification import Identification
from thermogrip.sysid.models.network import load_network

CAPACITY, LOSS, HEATER_W, LAMP_W = 4000.0, 2.0, 60.0, 10.0  # J/K, W/K
NETWORK = """
schema = "thermogrip.network"
version = 1
name = "lit_tank"
dt = 10.0
[inputs]
heater = { unit = "percent", range = [0, 100] }
[disturbances]
t_room = { unit = "degC" }
lamp = { unit = "1" }
[outputs]
t_tank = { node = "water", sd = 0.1 }
[nodes]
water = { capacity = "C" }
[links]
air = { between = ["water", "t_room"], conductance = "G" }
[heaters]
heater = { node = "water", input = "heater", power = "P" }
light = { node = "water", input = "lamp", power = "P_lamp" }
[parameters]
P = { unit = "W", value = 60.0, fixed = true }
P_lamp = { unit = "W", value = 20.0, sd_log = 1.0 }
C = { unit = "J/K", value = 6000.0, sd_log = 1.0 }
G = { unit = "W/K", value = 1.0, sd_log = 1.0 }
"""


@pytest.fixture(scope="module")
def log() -> Log:
    """A tank at 10 s, its heater and its lamp switched by chance, in a room that drifts by 1 degC."""
    rng, rows = np.random.default_rng(1), 1500
    heater = np.repeat(rng.choice([0.0, 20.0, 50.0, 80.0, 100.0], rows // 30), 30)
    lamp = np.repeat(rng.integers(0, 2, rows // 50), 50).astype(float)
    heater[:30] = lamp[:50] = 0.0
    room = 20 + np.sin(np.linspace(0, 9, rows))
    decay, tank = np.exp(-10 * LOSS / CAPACITY), np.full(rows, 20.0)
    for k in range(rows - 1):
        rest = room[k] + (HEATER_W * heater[k] / 100 + LAMP_W * lamp[k]) / LOSS
        tank[k + 1] = rest + decay * (tank[k] - rest)
    return make_log(
        10.0 * np.arange(rows),
        {
            "heater": (heater, "percent", "input"),
            "lamp": (lamp, "1", "disturbance"),
            "t_room": (room, "degC", "disturbance"),
            "t_tank": (tank + 0.03 * rng.standard_normal(rows), "degC", "output"),
        },
    )


@pytest.fixture(scope="module", params=["network", "subspace"])
def found(
    request: pytest.FixtureRequest, log: Log, tmp_path_factory: pytest.TempPathFactory
) -> Identification:
    file = tmp_path_factory.mktemp("lamp") / "tank.toml"
    file.write_text(NETWORK)
    network = load_network(file) if request.param == "network" else None
    return identify([log], network, models=[request.param], draws=4)


@pytest.fixture(scope="module")
def plant(found: Identification) -> Plant:
    return found.plant


def test_each_band_of_the_page_is_of_the_size_of_what_it_is_about(found: Identification, log: Log) -> None:
    sections = identification_sections(found, [log], found.plant, None)
    charts = [item.chart for section in sections for item in section.parts if isinstance(item, Plot)]
    panels = [panel for chart in charts for column in chart.columns for panel in column]
    bands = [(panel, c) for panel in panels for c in panel.curves if c.low is not None and c.high is not None]
    assert len(bands) == 2
    for panel, band in bands:
        drawn = np.concatenate([curve.y for curve in panel.curves])
        widest = max(float(np.ptp(drawn)), 5.0)  # 20 K at full drive, 5 % of it assumed to vary: 2 K
        assert np.max(band.high - band.low) < widest, panel.label


def test_the_gain_of_a_lamp_is_its_power_over_the_loss(plant: Plant) -> None:
    gains = {row["input"]: row["gain"] for row in plant_dynamics(plant).rows()}
    assert gains["lamp"] == pytest.approx(LAMP_W / LOSS, rel=0.03)
    assert gains["heater"] == pytest.approx(HEATER_W / LOSS / 100, rel=0.03)


def test_a_start_that_was_read_costs_the_powers_of_a_network_nothing(found: Identification) -> None:
    # its readings tell the start to 0.02 K, though the network's own spread of a start is 1 K
    if found.plant.free:
        low, high = found.plant.intervals()["P_lamp"]
        assert low < LAMP_W < high
        assert high - low < 0.05 * LAMP_W  # 2.3 W where that spread alone counts


def test_a_controller_drives_the_heater_alone_and_gives_it_less_under_the_lamp(plant: Plant) -> None:
    few = {"evaluations": 3, "search_draws": 1, "check_draws": 1}
    spec = Spec(ambient_degC=20.0, steps=[(22.0, 32.0)], hold_s=8000.0, **few)
    tuned = tune(plant, spec).controller
    assert (tuned.model.drives, tuned.model.disturbances) == (("heater",), tuple(plant.disturbances))
    for controller in (tuned, Controller(plant, default_design(plant))):
        moves = []
        for lamp in (0.0, 1.0):
            reading = {"t_tank": 30.0, "t_room": 20.0, "lamp": lamp, "time_s": 0.0}
            controller.reset(reading)
            for k in range(60):
                move = controller.step(reading | {"time_s": 10.0 * k}, 30.0)
            moves.append(move.drive)
        # held at 30: 10 K of loss, of which the lamp gives its own
        assert moves[0] - moves[1] == pytest.approx(100 * LAMP_W / HEATER_W, abs=8), moves


def test_the_verdict_says_how_much_of_the_stated_error_is_a_gain_that_is_assumed_to_vary(
    plant: Plant,
) -> None:
    stated = plant.scores.expected["t_tank"]
    assert stated.same_gain == pytest.approx(0.03, rel=0.2)  # the noise; 5 % of up to 20 K are assumed
    assert stated.rmse > 5 * stated.same_gain
    assert f"It would be t_tank {stated.same_gain:.2g} degC, were gains the same" in plant.verdict


def test_a_lamp_joins_no_nodes_and_a_temperature_heats_nothing(log: Log, bench: Bench) -> None:
    write_log(log, bench.path / "tank.csv")
    for old, new, said in (
        ('"water", "t_room"', '"water", "lamp"', "links.air.between: no node 'lamp'"),
        ('input = "lamp"', 'input = "t_room"', "heaters.light.input: no input 't_room'"),
    ):
        bench.write("tank.toml", NETWORK.replace(old, new))
        done = bench.run("identify", "tank.csv", "--network", "tank.toml", "--out", "p.json")
        assert (done.code, said in done.said[0]) == (2, True), done.err
    load = bench.write("load.toml", NETWORK.replace("value = 20.0, sd_log = 1.0", "value = -20.0, sd = 20.0"))
    assert load_network(load).specs["P_lamp"].value == -20.0  # one that takes heat


def test_what_may_be_a_lamp_is_asked_about(log: Log, bench: Bench) -> None:
    write_log(log, bench.path / "tank.csv")
    line = bench.run("identify", "tank.csv", "--models", "arx", "--out", "p.json").err.splitlines()[-1]
    assert "identify tank.csv --inputs heater,lamp --outputs t_tank --disturbances t_room" in line
    assert line.endswith("# can you set lamp? if not: --inputs heater --disturbances t_room,lamp")
