"""The default design, fields that cannot be, and the same plant in another file or process."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.mpc.makers import make_tank
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.files import read_json
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.design.design import (
    Design,
    check_design,
    default_controlled,
    default_design,
    make_blocks,
    pair_loops,
    simc,
)
from thermogrip.mpc.plant.prediction import step_response
from thermogrip.mpc.tuning.design_review import review
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.plant.plant_data import InnovationNoise


@pytest.fixture(scope="module")
def sampled() -> Plant:
    """Return the gripper with 400 samples of what it knows least."""
    plant = prior_plant(load_network("gripper"))
    middle = np.array([plant.values[name] for name in plant.free])
    samples = middle * (1 + 0.05 * np.random.default_rng(0).uniform(-1, 1, (400, middle.size)))
    return replace(plant, samples=samples)


def test_the_file_of_a_controller_keeps_some_draws(sampled, tmp_path):
    controller = Controller(sampled, default_design(sampled))
    some = read_json(controller.save(tmp_path / "c.json"), "thermogrip.controller", 1)["plant"]
    every = sampled.to_dict()
    assert (len(some["draws"]), len(every["draws"])) == (50, 400)
    assert all(row in every["draws"] for row in some["draws"])


def block(
    delay: int, lag: float, *, dt: float = 1.0, unit: str = "percent", output: str = "degC", gain: float = 0.5
) -> Plant:
    """Return one input that moves one output ``delay`` steps of ``dt`` s late, with one lag [s]."""
    n, a = delay + 1, float(np.exp(-dt / lag))
    A, B = np.diag(np.ones(n - 1), -1), np.zeros((n, 1))
    A[n - 1, n - 1], B[0, 0] = a, 1.0
    A[n - 1, n - 2], E = gain * (1 - a), np.zeros((n, 1))
    E[n - 1, 0] = 1 - a
    C = np.eye(n)[n - 1 :]
    model = StateSpaceModel(("q",), ("room",), ("t",), A=A, B=B, C=C, dt=dt, E=E)
    valid = {"q": (0.0, 100.0), "t": (0.0, 90.0)}
    units = {"q": unit, "room": "degC", "t": output}
    return Plant(model, {}, dt=dt, units=units, valid=valid, noise={"t": 0.05})


@pytest.mark.parametrize(
    ("delay", "lag", "seconds"),
    [
        (10, 200.0, 80.0),  # eight delays of 9.998 s
        (10, 10.0, 44.0),  # no more than the delay of 9.95 s and three lags of 11.03 s
        (20, 300.0, 160.0),
    ],
)
def test_the_horizon_is_eight_delays_or_the_delay_and_three_lags(delay: int, lag: float, seconds: float):
    design = default_design(block(delay, lag), dt=2.0)
    assert sum(design.blocks) * 2.0 == seconds
    assert (len(design.blocks), design.deadline_s, design.patience_s) == (10, 1.0, 10.0)


def test_the_horizon_has_twenty_samples_at_least_and_eighty_at_most():
    assert sum(default_design(block(5, 6.0), dt=4.0).blocks) == 20
    assert sum(default_design(block(40, 900.0), dt=1.0).blocks) == 80


def test_the_sample_time_is_a_multiple_of_the_plants_step_and_a_quarter_of_the_delay():
    assert default_design(block(10, 50.0), dt=2.4).dt == 2.0
    assert default_design(block(10, 50.0), dt=0.1).dt == 1.0
    assert default_design(block(10, 50.0, dt=2.0), dt=5.2).dt == 6.0
    long = default_design(block(20, 200.0))
    assert (long.dt, long.deadline_s, long.patience_s) == (5.0, 2.5, 25.0)


@pytest.mark.parametrize(
    ("horizon", "count", "lengths"),
    [
        (20, 5, (1, 2, 3, 5, 9)),  # of ratio 1.7: 1, 1.7, 2.9, 5.0, 8.6 up to their rounded sums
        (12, 3, (1, 3, 8)),  # of ratio 2.85: 1, 2.85, 8.15
        (3, 10, (1, 1, 1)),
        (7, 1, (7,)),
        (7, 0, (7,)),
        (1000, 2, (1, 999)),
        (30, 3, (1, 5, 24)),  # of ratio 4.9
    ],
)
def test_blocks_grow_from_one_sample_and_sum_to_the_horizon(horizon, count, lengths):
    assert make_blocks(horizon, count) == lengths


@pytest.mark.parametrize(("unit", "ends"), [("percent", (0.0, 100.0)), ("0_255", (0.0, 255.0))])
def test_a_drive_may_move_an_eighth_of_its_range_a_second(unit: str, ends: tuple[float, float]):
    design = default_design(block(10, 50.0, unit=unit))
    assert design.drive_range == {"q": ends}
    assert design.slew_per_s == {"q": ends[1] / 8}


def test_an_output_in_any_unit_is_a_target_where_it_moves_by_more_than_a_unit():
    assert default_design(block(10, 50.0, output="V")) == default_design(block(10, 50.0))
    small = replace(block(10, 50.0, output="m"), valid={"q": (0.0, 1.0), "t": (2.0, 2.9)})
    with pytest.raises(UserError, match=r"t moves by 0\.9 m in the logs.*cm instead of m"):
        default_design(small)
    default_design(replace(small, valid={"t": (2.0, 3.0)}))


def test_what_nothing_moves_is_no_target():
    with pytest.raises(UserError, match="the plant has no output u; it has t"):
        default_design(block(10, 50.0), controlled=["u"])
    with pytest.raises(UserError, match="no drive moves t"):
        default_design(block(10, 50.0, gain=0.0), dt=1.0)


def recorded(plant: Plant, **record: Any) -> Plant:
    """Return a plant whose fit kept this record of noise."""
    given = {"state": 0.01, "reading": {"t": 0.04}, "input": {"q": 0.0}, "fastest": {"q": 0.0}} | record
    return replace(plant, scores=replace(plant.scores, innovations=InnovationNoise(**given)))


@pytest.mark.parametrize("delay", [5, 40])
def test_a_load_is_known_as_soon_as_its_loop_can_answer_sooner_by_a_quiet_sensor_or_as_the_logs_show(
    delay: int,
):
    plant, dt = block(delay, 100.0), 2.0
    plant = replace(plant, valid={**plant.valid, "t": (0.0, 50.0)})  # a unit of 1
    answer = step_response(plant, "q", "t")
    theta = answer.delay + dt
    for noise in (0.3, 0.01, 1e-5):  # .15 of a band of .15 is .0225
        found = default_design(recorded(plant, reading={"t": noise}), dt=dt).noise
        answered = noise * dt**0.5 * answer.lag / (answer.gain * theta**2)
        quiet = answered * (0.0225 / noise) ** (4 / 3) * (theta / dt) ** (2 / 3)
        assert found.drive["q"] == pytest.approx(min(max(answered, quiet), 0.01 / dt**0.5))
        assert found.load["q"] == pytest.approx(min(0.03, 2 * theta * found.drive["q"] / dt**0.5))
        assert found.state == 0.01
    for seen, drift in ((0.6, 0.006), (50.0, 0.01 / dt**0.5)):  # of a drive in percent
        noise = default_design(recorded(plant, reading={"t": 0.001}, input={"q": seen}), dt=dt).noise
        assert noise.drive["q"] >= drift * (1 - 1e-9)


def test_a_model_without_a_delay_is_trusted_no_sooner_than_by_its_lag():
    plant = block(0, 100.0, dt=2.0)
    assert step_response(plant, "q", "t").delay < 0.2
    noise = default_design(recorded(plant), dt=2.0).noise
    assert noise.drive["q"] < 1e-4
    assert noise.load["q"] == 0.0
    assert default_design(recorded(plant, input={"q": 0.1}), dt=2.0).noise.drive["q"] == pytest.approx(1e-3)


def test_a_drive_moves_as_fast_as_its_logs_show_or_an_eighth_of_its_range_a_second_or_all_in_a_sample():
    for seen, slew in ((0.0, 12.5), (20.0, 20.0), (400.0, 50.0)):
        design = default_design(recorded(block(5, 100.0), fastest={"q": seen}), dt=2.0)
        assert design.slew_per_s == {"q": slew}
    assert default_design(block(5, 100.0), dt=2.0).slew_per_s == {"q": 12.5}


@pytest.mark.parametrize(("width", "unit"), [(50.0, 1.0), (310.0, 5.0), (11.0, 0.2)])
def test_errors_count_in_the_unit_of_their_output(width: float, unit: float):
    plant = block(5, 100.0)
    plant = replace(plant, valid={**plant.valid, "t": (0.0, width)})
    design = default_design(plant, dt=2.0)
    assert design.weights == ({} if unit == 1.0 else {"t": pytest.approx(unit**-2)})
    assert design.overshoot == pytest.approx(max(0.15 * unit, 3 * 0.05))
    assert design.price == pytest.approx(25.0 / unit**2)
    noisy = default_design(recorded(plant, reading={"t": 0.4}), dt=2.0)
    assert noisy.overshoot == pytest.approx(max(0.15 * unit, 1.2))


NOISE = {"state": 0.01, "drive": {"drive": 0.002}, "output": 0.02, "reading": {}, "load": {}}
NOT_NEGATIVE = ("terminal", "drive", "price", "overshoot", "deadline_s", "patience_s")
#: Fields of older files, in use; without use they load.
GONE = {
    "travel": 2.0,
    "tariff": [[0.0, 2.0]],
    "on_off": {"pump": [1.0, 1.0, 0.0]},
    "offset_free": False,
    "move_delay": 1,
}
LOOP = {"drive": "drive", "output": "t_surface", "Kc": 0.1, "Ti": 50.0}


@pytest.fixture(scope="module")
def design(tank) -> dict:
    return default_design(tank, dt=2.0).to_dict()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"dt": 2.5}, "dt is 2.5 s, no multiple of the plant's step of 1 s"),
        ({"dt": 2.00001}, "no multiple"),
        *(({"dt": dt}, "dt: input should be") for dt in (0, "2", -2.0, 3601.0)),
        ({"track": True}, "track: input should be a valid number"),
        ({"price": float("nan")}, "price: input should be"),
        ({"price": 2e12}, "price: input should be less than or equal to 1000000000000"),
        *(({name: -1e-9}, f"{name}: input should be greater") for name in NOT_NEGATIVE),
        *(({name: 0.0}, f"{name}: input should be greater than 0") for name in ("track", "move")),
        *(({"ambient": ambient}, "ambient: input should be") for ambient in (-60.1, 150.1)),
        ({"blocks": [1001]}, "blocks sum to 1001 samples, more than the 1000"),
        ({"blocks": [3, 0]}, "blocks.1: input should be greater than or equal to 1"),
        ({"blocks": [1] * 201}, "201 blocks of 1 drives are more than 200 unknowns"),
        ({"blocks": []}, "blocks: tuple should have at least 1 item"),
        ({"blocks": None}, "blocks: input should be a valid tuple"),
        ({"controlled": []}, "controlled: tuple should have"),
        ({"controlled": ["t_nose"]}, "controlled: the plant has no output t_nose"),
        ({"controlled": ["t_surface", "t_surface"]}, "twice"),
        ({"drive_range": {"drive": [-1.1, 0.5]}}, "drive is -1.1 to 0.5, beyond"),
        ({"drive_range": {"drive": [-0.5, 1.1]}}, "beyond the drive's -1 to 1"),
        ({"drive_range": {"drive": [0.5, 0.5]}}, "drive_range.drive: 0.5 to 0.5 is empty"),
        ({"drive_range": {}}, "nothing for drive drive"),
        ({"drive_range": {"drive": [-1.0, 1.0], "fan": [0.0, 1.0]}}, "no drive fan"),
        ({"slew_per_s": {"drive": 0.1, "fan": 1.0}}, "slew_per_s: the plant has no drive fan"),
        ({"slew_per_s": {"drive": "fast"}}, "slew_per_s.drive: input should be a valid number"),
        ({"slew_per_s": {"drive": 0.0}}, "slew_per_s.drive: input should be greater than 0"),
        ({"slew_per_s": {}}, "slew_per_s: nothing for drive drive"),
        ({"limits": {"t_tank": [20.0]}}, "limits.t_tank.1: field required"),
        ({"limits": {"t_tank": [40.0, 20.0]}}, "limits.t_tank: 40 to 20 is empty"),
        ({"limits": {"t_tank": [float("-inf"), 60.0]}}, "limits.t_tank.0: input should be"),
        ({"limits": {"t_nose": [20.0, 40.0]}}, "limits: the plant has no output t_nose"),
        ({"loops": [{**LOOP, "Ti": 0.0}]}, "loops.0.Ti: input should be greater than 0"),
        ({"loops": [{**LOOP, "drive": "fan"}]}, "loops: t_surface by fan is no pair"),
        ({"loops": [{**LOOP, "output": "t_tank"}]}, "loops: t_tank by drive is no pair"),
        ({"loops": [LOOP, LOOP]}, "twice"),
        ({"loops": [{**LOOP, "setpoint": 1.1}]}, "loops.0.setpoint: input should be less than or equal to 1"),
        ({"loops": [{**LOOP, "Kc": "much"}]}, "loops.0.Kc: input should be a valid number"),
        ({"noise": NOISE | {"state": -1.0}}, "noise.state: input should be greater"),
        ({"noise": NOISE | {"output": 1.1e6}}, "noise.output: input should be less than or equal to 1000000"),
        ({"noise": NOISE | {"reading": {"t_tank": -1.0}}}, "noise.reading.t_tank: input should be"),
        ({"colour": 1}, "colour: no such key"),
        *(({name: value}, f"{name}: no such key") for name, value in GONE.items()),
    ],
)
def test_a_field_that_cannot_be_is_named(tank, design, change, says):
    with pytest.raises(UserError, match=says):
        check_design(Design.from_dict({**design, **change}), tank)


@pytest.mark.parametrize(
    "change",
    [
        *({"dt": dt} for dt in (3600.0, 2.000001)),
        *({"blocks": blocks} for blocks in ([1000], [1] * 200, [1])),
        *({"ambient": ambient} for ambient in (-60.0, 150.0)),
        *({name: 0.0} for name in NOT_NEGATIVE),
        {"noise": NOISE | {"state": 1e6, "drive": {"drive": 0.0}}},
        {"drive_range": {"drive": [-1 - 9e-10, 1 + 9e-10]}},
        {"loops": []},
    ],
)
def test_a_field_at_the_end_of_what_can_be_is_taken(tank, design, change):
    found = check_design(Design.from_dict({**design, **change}), tank).to_dict()
    for key, value in change.items():
        assert found[key] == value


@pytest.mark.parametrize("spec", [{"steps": "abc"}, {"steps": [[1], [None]]}])
def test_a_review_of_notes_that_were_edited_is_one_line(tank, spec):
    controller = Controller(tank, default_design(tank, dt=2.0), notes={"spec": spec})
    with pytest.raises(UserError, match="steps"):
        review(controller)


@pytest.mark.parametrize(
    ("delay", "lag", "tau_c", "closed", "integral"),
    [
        (10, 50.0, None, 9.99, 50.99),  # as fast as its delay; the lag is shorter than eight delays
        (10, 400.0, None, 9.9988, 8 * 9.9988),
        (10, 400.0, 30.0, 30.0, 4 * (30.0 + 9.9988)),
        (1, 50.0, None, 2.0, 4 * (2.0 + 1.0)),  # no faster than two steps of the plant
    ],
)
def test_simc_of_a_delayed_lag_is_its_closed_form(delay, lag, tau_c, closed, integral):
    plant = block(delay, lag)
    answer, loop = step_response(plant, "q", "t"), simc(plant, "q", "t", tau_c=tau_c)
    late = max(answer.delay, 1.0)
    assert late == pytest.approx({10: 10.0, 1: 1.0}[delay], abs=0.011)
    # 100 percent of drive give 50 degC
    assert loop.Kc == pytest.approx(100 * answer.lag / (answer.gain * (closed + late)), rel=1e-4)
    assert answer.lag / answer.gain == pytest.approx((lag + 1) / 50, rel=2e-3)
    assert loop.Ti == pytest.approx(integral, rel=1e-3)
    assert (loop.drive, loop.output) == ("q", "t")


def test_a_drive_of_the_other_sign_has_a_loop_of_the_other_sign_and_one_of_no_gain_has_none():
    cools, heats = (simc(block(10, 50.0, gain=gain), "q", "t") for gain in (-0.5, 0.5))
    assert (cools.Kc, cools.Ti) == pytest.approx((-heats.Kc, heats.Ti))
    with pytest.raises(ValueError, match="drive q does not move t"):
        simc(block(10, 50.0, gain=0.0), "q", "t")
    # the gain is for a range of 2 from -1 to 1
    tank, answer = make_tank(), step_response(make_tank(), "drive", "t_surface")
    loop = simc(tank, "drive", "t_surface", tau_c=answer.delay)
    assert loop.Kc == pytest.approx(2 * answer.lag / (answer.gain * 2 * answer.delay))


@pytest.mark.parametrize(
    ("drives", "outputs", "controlled"),
    [(1, "t_surface t_tank", "t_surface"), (1, "t_pipe t_tank", "t_tank"), (2, "t_surface a b", "a b")],
)
def test_the_skin_is_controlled_by_one_drive_and_by_several_the_last_outputs(
    drives: int, outputs: str, controlled: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("thermogrip.mpc.design.design.drive_names", lambda plant: tuple("uv"[:drives]))
    plant: Any = SimpleNamespace(outputs=tuple(outputs.split()))
    assert default_controlled(plant) == tuple(controlled.split())


def test_each_output_takes_the_drive_of_largest_gain_that_is_free():
    gains = np.array([[0.2, -0.3], [0.0, 0.4], [0.1, 0.1], [0.5, 0.6]])  # of a, b, c, d by p, q
    model = StateSpaceModel(
        ("p", "q"), (), tuple("abcd"), A=np.diag([0.9] * 4), B=gains, C=np.eye(4), dt=1.0, y0=[25.0] * 4
    )
    valid = {"p": (0.0, 1.0), "q": (0.0, 1.0)}
    plant = Plant(model, {}, dt=1.0, units=dict.fromkeys(tuple("pqabcd"), "1"), valid=valid)
    # b is left to q, which is a's; c gets p, and for d no drive is left
    assert [(loop.drive, loop.output) for loop in pair_loops(plant, tuple("abcd"))] == [
        ("q", "a"),
        ("p", "c"),
    ]
    assert [(loop.drive, loop.output) for loop in pair_loops(plant, ("d", "a"))] == [("q", "d"), ("p", "a")]
