"""Which columns are inputs, disturbances and outputs: a model's roles hold, guesses are marked as such."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from tests.end_to_end.conftest import Bench
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

ROOM = """
schema = "thermogrip.network"
version = 1
name = "a_room"
dt = 10.0
inputs.setting = { unit = "percent", range = [0, 100] }
outputs.t_room = { node = "room", sd = 0.05 }
nodes.room = { capacity = "C" }
boundaries.outside = { temperature = "t_outside" }
links.wall = { between = ["room", "outside"], conductance = "G" }
heaters.stove = { node = "room", input = "setting", power = "P" }

[parameters]
C = { unit = "J/K", value = 20000.0, sd_log = 0.5 }
G = { unit = "W/K", value = 20.0, sd_log = 0.5 }
P = { unit = "W", value = 500.0, fixed = true }
t_outside = { unit = "degC", value = 10.0, sd = 5.0 }
"""


@pytest.fixture
def house(bench: Bench) -> Bench:
    """A bench with room.toml and room.csv, 500 W on 20 kJ/K and 20 W/K, the setting in counts of 255."""
    bench.write("room.toml", ROOM)
    rng = np.random.default_rng(0)
    share = np.repeat(rng.uniform(0.0, 1.0, 20), 20)
    t_room, now = [], 15.0
    for q in share:
        t_room.append(now + 0.05 * rng.standard_normal())
        now += 10.0 * (500.0 * q - 20.0 * (now - 5.0)) / 20000.0
    rows = [f"{10 * k},{255 * q:.3f},{t:.3f}" for k, (q, t) in enumerate(zip(share, t_room))]
    rows[7] = rows[7].rsplit(",", 1)[0] + ","  # a reading that was lost
    bench.write("room.csv", "\n".join(["time_s,setting_0_255,t_room_degC", *rows]) + "\n")
    block = StateSpaceModel(
        ("setting",), (), ("t_room",), A=[[0.99]], B=[[0.0025]], C=[[1.0]], y0=[5.0], dt=10.0
    )
    units = {"setting": "percent", "t_room": "degC"}
    Plant(block, {}, dt=10.0, units=units, noise={"t_room": 0.05}).save(bench.path / "room.json")
    return bench


def test_an_output_that_is_called_like_a_room_is_an_output_where_the_plant_declares_it(house: Bench):
    done = house.run("validate", "room.json", "room.csv", "--average", "20", "--json")
    assert done.code == 0, done
    scored = json.loads(done.out)["logs"][0]
    assert scored["outputs"]["t_room"]["rmse"] < 0.1
    assert "setting: converted from 0_255 to percent" in scored["notes"]
    done = house.run("simulate", "room.json", "room.csv", "--out", "seen.csv")
    assert done.code == 0, done
    header = (house.path / "seen.csv").read_text().splitlines()[0]
    assert header.startswith("time_s,t_room_degC,setting_percent")
    assert "setting: converted from 0_255 to percent" in done.err


def test_the_names_of_a_network_file_are_inputs_and_outputs_and_the_plant_has_the_log_s_units(house: Bench):
    """A lamp burns in the part that is held out alone: what it gives is as unknown as its prior says."""
    head, parameters = ROOM.split("[parameters]")
    lamp = 'inputs.lamp = { unit = "1", range = [0, 1] }\n'
    lamp += 'heaters.lamp = { node = "room", input = "lamp", power = "L" }\n'
    unknown = 'L = { unit = "W", value = 50.0, sd_log = 4.0 }\n'
    house.write("room.toml", f"{head}{lamp}[parameters]{parameters}{unknown}")
    rows = (house.path / "room.csv").read_text().splitlines()
    lit = [f"{row},{int(k > 320)}" for k, row in enumerate(rows[1:])]
    house.write("room.csv", "\n".join([f"{rows[0]},lamp", *lit]) + "\n")
    done = house.run(
        *("identify", "room.csv", "--network", "room.toml", "--models", "network"),
        *("--average", "20", "--out", "found.json", "--report", "found.html", "--json"),
    )
    assert done.code == 3, done  # the fit without that part misses what the lamp gives
    answer = json.loads(done.out)
    again = json.loads(house.run("validate", "found.json", "room.csv@1000:", "--json").out)
    assert again["logs"][0]["notes"][0].startswith("all of it is in the fit (as room)")
    assert answer["parameters"]["G"]["value"] == pytest.approx(20.0, rel=0.05)
    assert Plant.load(house.path / "found.json").units["setting"] == "0_255"  # as the log has it


@pytest.mark.parametrize(
    ("header", "network", "names"),
    [
        ("time_s,dial_0_255,t_room_degC", "room.toml", ("room", "a_room does not apply", "no input setting")),
        ("time_s,setting_0_255,t_room_degC", "tclab", ("tclab does not apply", "no input q1")),
        ("time_s,setting_V,t_room_degC", "room.toml", ("setting is in 'V'", "'percent'")),
    ],
)
def test_a_network_that_was_asked_for_and_does_not_apply_is_code_2(
    house: Bench, header: str, network: str, names: tuple[str, ...]
):
    text = (house.path / "room.csv").read_text().replace("time_s,setting_0_255,t_room_degC", header)
    house.write("room.csv", text)
    done = house.run("identify", "room.csv", "--network", network, "--out", "found.json")
    assert done.code == 2, done
    assert len(done.said) == 1
    for name in names:
        assert name in done.said[0]
    assert not (house.path / "found.json").exists()


def test_the_role_of_every_column_is_printed_and_a_guess_is_marked(house: Bench):
    rows = (house.path / "room.csv").read_text().splitlines()
    more = [f"{row},{18 + 3 * (k // 150)},{20 + k // 200}" for k, row in enumerate(rows[1:])]
    house.write("set.csv", "\n".join([f"{rows[0]},set_degC,sp1_degC", *more]) + "\n")
    words = ("--outputs", "t_room", "--models", "arx", "--average", "10", "--out", "found.json")
    done = house.run("identify", "set.csv", *words)
    assert done.code == 0, done
    roles = done.out.split("Free runs")[0]
    table = {line.split()[0]: " ".join(line.split()[1:]) for line in roles.splitlines() if line.split()}
    assert table["setting"] == "0_255 input guess: its unit is 0_255"
    assert table["t_room"] == "degC output named"
    assert table["set"] == table["sp1"] == "degC left out guess: its name is that of a set point"
    again = house.run("identify", "set.csv", *words, "--report", "found.html", "--json")
    signals = json.loads(again.out)["signals"]
    assert {s["name"]: (s["role"], s["guessed"]) for s in signals} == {
        "setting": ("input", True),
        "t_room": ("output", False),
        "set": ("left out", True),
        "sp1": ("left out", True),
    }
    page = " ".join(re.sub(r"<[^>]*>", " ", (house.path / "found.html").read_text()).split())
    for name in ("setting", "t_room", "set", "sp1"):
        assert f"{name} {table[name]}" in page


@pytest.mark.parametrize(
    ("kind", "says"),
    [("held", "wanted is constant but for 2 jumps in 400 rows"), ("computed", "wanted has no noise")],
)
def test_an_output_without_noise_is_questioned(house: Bench, kind: str, says: str):
    rows, k = (house.path / "room.csv").read_text().splitlines(), np.arange(400)
    odd = 18.0 + 3.0 * (k // 150) ** 2 if kind == "held" else 20.0 + np.sin(k / 60.0)
    more = [f"{row},{value:.12g}" for row, value in zip(rows[1:], odd)]
    house.write("odd.csv", "\n".join([f"{rows[0]},wanted_degC", *more]) + "\n")
    words = ("--outputs", "t_room,wanted", "--models", "arx", "--average", "60", "--out", "found.json")
    done = house.run("identify", "odd.csv", *words)  # too few rows for any model
    assert (done.code, done.said[0].count(says)) == (2, 1)
