"""An input that is on or off and that the controller switches: closed loops on equations of their own, least
times on and off, the cheapest of all sequences, and what cannot be had."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import pytest

from tests.mpc.makers import make_tank, network_plant
from thermogrip.datasets.errors import UserError
from thermogrip.mpc.closed_loop.simulate import Surroundings, simulate_closed_loop
from thermogrip.mpc.controllers.export import export_controller
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.design.design import check_design
from thermogrip.mpc.design.spec import spec_from_dict
from thermogrip.mpc.interface import Move
from thermogrip.mpc.optimiser.switching import sequences
from thermogrip.mpc.plant.prediction import switching
from thermogrip.mpc.tuning.design_review import right_way

INLET, ROOM, DT = 15.0, 25.0, 5.0
KEYS = {"output": "t_tank", "steps": [[40.0, 30.0], [30.0, 45.0]], "hold_s": 1500.0, "sample_time_s": DT}
VALVE = {"valve": {"min_on_s": 60.0, "min_off_s": 90.0, "price": 0.2}}


def tank_of(on_off, **changes) -> Controller:
    """The controller of a tank with a heater and a valve that lets cold water through."""
    spec = spec_from_dict(KEYS | {"on_off": on_off})
    valid = {"heater": (0.0, 100.0), "t_tank": (15.0, 70.0), "t_inlet": (10.0, 20.0)}
    plant = spec.widened(network_plant("tank", **valid))
    return Controller(plant, spec.design(plant, **changes))


def run(controller, targets, seconds, *, stuck=()):
    """Close the loop on a tank of its own equations, by explicit steps of 0.1 s: 5 % less heat, 5 % more flow
    and water than the model; while ``stuck`` (from, to) [s] the valve is shut, and the reading says so."""
    power, flow, water, wall = 950.0, 42.0, 2.1e4, 3.0
    element = tank = shown = 40.0
    rng, rows, n = np.random.default_rng(3), [], round(seconds / DT)
    room = {"t_inlet": INLET, "t_ambient": ROOM}
    controller.reset({"t_tank": 40.0, "heater": 0.0, "valve": 0.0} | room)
    valve = 0.0
    for k in range(n * len(targets)):
        reading = {"time_s": k * DT, "t_tank": shown + 0.05 * rng.standard_normal()} | room
        blocked = bool(stuck) and stuck[0] <= k * DT < stuck[1]
        if stuck:
            reading["valve"] = valve
        move = controller.step(reading, targets[k // n])
        heat, valve = move.drives(("heater", "valve"))
        valve = 0.0 if blocked else valve
        rows.append((k * DT, tank, heat, valve, move.status, move.advice))
        for _ in range(round(DT / 0.1)):
            through = flow * (valve if valve else 0.02)
            into = 30.0 * (element - tank)
            element += 0.1 * (power * heat / 100.0 - into) / 200.0
            tank += 0.1 * (into - through * (tank - INLET) - wall * (tank - ROOM)) / water
            shown += 0.1 * (tank - shown) / 5.0
    columns = list(zip(*rows, strict=True))
    return [np.array(column) for column in columns[:4]] + columns[4:]


def stays(time, valve):
    """How long the valve was in each of its positions, but the first and the last."""
    at = np.flatnonzero(np.diff(valve)) + 1
    return [(int(valve[a]), float(time[b] - time[a])) for a, b in pairwise(at)]


def test_a_valve_is_open_while_it_pays_and_no_target_is_missed():
    time, tank, heat, valve, status, _ = run(tank_of(VALVE), (30.0, 45.0), 1000.0)
    for target, begin in ((30.0, 0.0), (45.0, 1000.0)):
        late = (time >= begin + 400.0) & (time < begin + 1000.0)
        assert np.all(np.abs(tank[late] - target) < 0.25)
    # cold water alone brings it down; then the heater alone holds it, which with an open valve takes 54 %
    first = time < 1000.0
    assert np.all(valve[time < 200.0] == 1.0)
    assert valve[first].mean() < 0.3
    assert heat[first & (time > 500.0)].mean() < 5.0
    assert valve[time > 1010.0].max() == 0.0
    assert set(status) == {"ok"}


def test_it_stays_on_and_off_for_as_long_as_it_must():
    # colder than the room, warmer than the inlet: it has to open again and again
    time, tank, _, valve, _, advice = run(tank_of(VALVE), (20.0,), 4000.0)
    found = stays(time, valve)
    assert len(found) >= 3
    assert min(seconds for on, seconds in found if on) >= 60.0
    assert min(seconds for on, seconds in found if not on) >= 90.0
    assert any(on and seconds == 60.0 for on, seconds in found)  # it would have shut before
    assert any(text.startswith("valve may go over in ") for text in advice)
    assert np.all(np.abs(tank[time > 1200.0] - 20.0) < 0.7)


def test_a_valve_that_somebody_shuts_is_seen_and_opened_again():
    time, tank, _, valve, *_ = run(tank_of(VALVE), (30.0,), 1200.0, stuck=(50.0, 250.0))
    assert valve[(time >= 50.0) & (time < 250.0)].max() == 0.0
    # each time it is found shut it is left so for 90 s
    assert valve[(time >= 325.0) & (time < 450.0)].mean() > 0.9
    assert np.all(np.abs(tank[time > 700.0] - 30.0) < 0.25)


def test_of_all_sequences_the_few_that_are_tried_hold_one_that_is_hardly_dearer():
    rng, ratios = np.random.default_rng(0), []
    for _ in range(6):
        controller = tank_of(VALVE, blocks=(1, 2, 4, 5, 8))
        begun = {"t_tank": rng.uniform(18.0, 45.0), "t_inlet": INLET, "t_ambient": ROOM}
        controller.reset(begun | {"heater": 30.0, "valve": float(rng.integers(2))})
        optimiser, lengths, seen = controller.optimiser, np.array(controller.design.blocks), []
        solve = optimiser.solve
        optimiser.solve = lambda sample, seen=seen, solve=solve: (seen.append(sample), solve(sample))[1]
        controller.step(begun | {"time_s": 0.0}, begun["t_tank"] + rng.uniform(-4.0, 4.0))
        (j, chosen), (_, _, price) = *optimiser.positions.items(), controller.design.on_off["valve"]
        costs = {}
        for positions in product((0.0, 1.0), repeat=len(lengths)):
            optimiser.positions = {j: np.array(positions)}
            costs[positions] = solve(seen[0]).cost + price * float(lengths @ positions)
        ratios.append(costs[tuple(chosen.tolist())] / min(costs.values()))
    assert np.median(ratios) < 1.02
    assert max(ratios) < 1.15


def test_the_sequences_of_an_input():
    begins = np.array([0.0, 5.0, 10.0, 20.0])
    free = sequences(begins, 0.0, 0.0, 10.0)
    assert free.tolist() == [
        [0, 0, 0, 0],
        [1, 1, 0, 0],
        [1, 1, 1, 1],
        [0, 1, 1, 1],
        [0, 0, 1, 1],
        [0, 0, 0, 1],
    ]
    assert sequences(begins, 1.0, 7.0, 100.0).tolist() == [[1, 1, 1, 1], [1, 1, 0, 0], [1, 1, 1, 0]]
    ten = sequences(np.arange(10.0), 0.0, 2.0, 3.0)
    assert ten.sum(axis=1).tolist() == [0, 3, 8, 7, 4, 1]
    assert sequences(begins, 1.0, 25.0, 0.0).tolist() == [[1, 1, 1, 1]]


def test_a_pi_keeps_to_both_positions_and_least_times():
    ours = tank_of(VALVE)
    controller = PIController.of(ours.plant, ours.design)
    time, _, _, valve, *_ = run(controller, (30.0, 20.0, 45.0), 600.0)
    assert set(valve) <= {0.0, 1.0}
    assert all(seconds >= (60.0 if on else 90.0) for on, seconds in stays(time, valve))


def test_a_review_takes_it_as_on():
    check = right_way(tank_of(VALVE))
    assert check.verdict == "pass"
    assert "valve" not in check.finding


def test_a_pump_that_does_nothing_is_off_where_it_costs_and_is_the_pump_of_the_move():
    moves = {}
    for price in (0.0, 0.5):
        keys = {"steps": [[28.0, 38.0]], "on_off": {"pump": {"price": price}}}
        spec = spec_from_dict(keys)
        plant = spec.widened(make_tank())
        controller = Controller(plant, spec.design(plant))
        controller.reset({"t_tank": 28.0, "t_surface": 28.0, "pump": 1.0})
        moves[price] = controller.step({"t_tank": 28.0, "t_surface": 28.0, "pump": 1.0}, 38.0)
    assert [(move.pump, move.status) for move in moves.values()] == [(1, "ok"), (0, "ok")]
    assert isinstance(moves[0.5].drive, float)
    assert moves[0.5].drives(("drive", "pump")) == [moves[0.5].drive, 0.0]
    assert Move({"q1": 1.0, "q2": 2.0}, pump=1).drives(("q2", "pump", "q1")) == [2.0, 1.0, 1.0]


def test_the_simulator_of_closed_loops_applies_the_positions():
    controller = tank_of(VALVE)
    around = Surroundings(ambient=25.0, noise=0.05, quantum=0.0)
    loop = simulate_closed_loop(
        controller, controller.plant, [(40.0, 600.0)], start=30.0, surroundings=around
    )
    assert set(loop.drive["valve"]) <= {0.0, 1.0}
    assert loop.settled
    assert loop.drive["valve"][-40:].max() == 0.0


def test_it_is_in_the_controllers_file_and_not_in_c(tmp_path):
    controller = tank_of(VALVE)
    again = Controller.load(controller.save(tmp_path / "c.json"))
    assert again.design == controller.design
    assert again.design.on_off == {"valve": (60.0, 90.0, 0.2)}
    assert again.model.drives == ("heater", "valve")
    with pytest.raises(UserError, match="on_off: C does not choose when valve goes over"):
        export_controller(controller, tmp_path / "c")
    with pytest.raises(UserError, match="on_off: what switches valve is no linear system"):
        controller.to_control()
    assert Controller(controller.plant, controller.design).c is None


REFUSED = [
    ({"on_off": {"pump": {}}}, "on_off: the plant has no on/off input pump"),
    ({"on_off": {"heater": {}}}, "on_off: the plant has no on/off input heater"),
    ({"on_off": {"valve": {"min_on": 3}}}, "on_off.valve.min_on: no such key"),
    ({"on_off": {"valve": {"min_on_s": -1}}}, "on_off.valve.min_on_s: input should be greater"),
    ({"on_off": {"valve": {}}, "energy_price": {"valve": 1.0}}, "energy_price: the plant has no drive valve"),
    (
        {"on_off": {"valve": {}}, "drive_limits": {"valve": [0, 1]}},
        "drive_limits: the plant has no drive valve",
    ),
]


@pytest.mark.parametrize(("keys", "said"), REFUSED)
def test_what_cannot_be_had_is_refused_in_one_line(keys, said):
    def designed():
        spec = spec_from_dict(KEYS | keys)
        spec.design(spec.widened(network_plant("tank", t_tank=(15.0, 70.0))))

    with pytest.raises(UserError) as refused:
        designed()
    assert refused.value.problem.startswith(said)
    assert "\n" not in str(refused.value)


def test_a_plant_without_an_on_off_input_says_so():
    with pytest.raises(
        UserError, match="no on/off input q1; it has none: such an input is 0 or 1 in all logs"
    ):
        switching(network_plant("tclab", t1=(15.0, 70.0), t2=(15.0, 70.0)), ["q1"])


def test_a_design_names_one_input_that_the_controller_switches_and_lets_it_go_over():
    controller = tank_of(VALVE)
    for changes, said in (
        ({"on_off": {"heater": (0.0, 0.0, 0.0), "valve": (0.0, 0.0, 0.0)}}, "on_off: one input is switched"),
        ({"on_off": {"pump": (0.0, 0.0, 0.0)}}, "on_off: pump is no on/off input"),
        ({"on_off": {"valve": (0.0, -1.0, 0.0)}}, "on_off of valve must be >= 0"),
        ({"slew_per_s": {"heater": 12.5, "valve": 0.1}}, "slew_per_s of valve must let it go over"),
    ):
        with pytest.raises(UserError) as refused:
            check_design(replace(controller.design, **changes), controller.plant)
        assert refused.value.problem.startswith(said)
