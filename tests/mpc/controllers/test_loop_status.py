"""What PI loops say of themselves, on plants that are their model and on others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.mpc.makers import make_tank, network_plant
from thermogrip.mpc import simulate_closed_loop
from thermogrip.mpc.closed_loop.simulate import ClosedLoop, Surroundings
from thermogrip.mpc.controllers.loop_status import LoopStatus, settling_time
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.design.design import PILoop, default_design
from thermogrip.mpc.plant.prediction import PredictionModel
from thermogrip.sysid.plant.plant import Plant

KIT = network_plant("tclab", t1=(20.0, 60.0), t2=(20.0, 60.0))


def run(
    plant: Plant,
    *,
    gain: float = 1.0,
    target: float = 40.0,
    seconds: float = 1500.0,
    surroundings: Surroundings | None = None,
) -> ClosedLoop:
    design = default_design(KIT, dt=4.0)
    loops = tuple(replace(loop, Kc=gain * loop.Kc) for loop in design.loops)
    loop = PIController.of(KIT, design, loops)
    return simulate_closed_loop(loop, plant, [(target, seconds)], surroundings=surroundings)


def test_a_loop_that_settles_is_ok_and_also_with_a_third_less_power():
    assert set(run(KIT).status) == {"ok"}
    around = Surroundings(drive_share=0.7)
    assert set(run(KIT, surroundings=around).status) == {"ok"}


def test_a_loop_whose_gain_is_much_too_high_swings():
    found = run(KIT, gain=20.0)
    assert found.status[-1] == "mismatch"
    assert "swings about its target" in found.advice[-1]


def test_a_target_out_of_reach_is_infeasible():
    found = run(KIT, target=120.0, seconds=3000.0)
    assert found.status[-1] == "infeasible"
    assert "off its target while q" in found.advice[-1]
    assert "is at its limit: a load" in found.advice[-1]


def test_drives_that_push_the_other_way_are_told_of():
    turned = make_tank(heat=-0.11)
    model = make_tank()
    loop = PIController(model, controlled=("t_tank",))
    found = simulate_closed_loop(loop, turned, [(35.0, 300.0)])
    first = found.status.index("mismatch")
    assert found.advice[first].startswith("t_tank goes away from its target while drive is at its limit")
    assert first < 60


def test_the_settling_time_is_that_of_a_simulated_loop_after_a_load():
    gain, delay, lag, Kc, Ti, dt = 2.0, 4.0, 100.0, 5.0, 60.0, 0.05
    expected = settling_time(gain, delay, lag, Kc, Ti)
    y, total, line, left = 0.0, 0.0, [0.0] * round(delay / dt), []
    for _ in range(round(5 * expected / dt)):
        total -= dt * Kc / Ti * y
        line.append(-Kc * y + total)
        y += dt / lag * (gain * line.pop(0) + 1.0 - y)
        left.append(abs(y))
    settled = dt * (np.flatnonzero(np.array(left) > 0.02 * max(left))[-1] + 1)
    assert 0.9 * expected < settled < 1.3 * expected
    assert settling_time(-1.0, 4.0, 100.0, 5.0, 60.0) == np.inf


def loops_of_a_tank() -> tuple[LoopStatus, float]:
    model = PredictionModel(make_tank(), dt=2.0)
    loop = PILoop("drive", "t_tank", Kc=0.5, Ti=60.0)
    found = LoopStatus(model, [loop], lowest=model.lowest[:1], highest=model.highest[:1], allowed=0.3)
    return found, float(found._promised[0])


def test_what_does_not_arrive_is_told_after_three_times_the_promise_and_no_time_counts_at_a_limit():
    found, promised = loops_of_a_tank()
    y, target, u = np.array([30.0]), np.array([40.0]), np.array([0.5])
    n = int((3 * promised + 20) / 2)
    assert {found.note(y, target, u, 2.0) for _ in range(n)} == {("ok", "")}
    told = [found.note(y, target, u, 2.0) for _ in range(4)][-1]
    assert told[0] == "mismatch"
    assert told[1].startswith("t_tank should have been at 40 ")
    found, _ = loops_of_a_tank()
    at_limit = [found.note(np.array([39.0 - 8.0 * 0.998**k]), target, np.array([1.0]), 2.0) for k in range(n)]
    assert {status for status, _ in at_limit} == {"ok"}


@pytest.mark.parametrize(("left", "status"), [(0.7, "ok"), (0.8, "infeasible")])
def test_a_distance_that_stays_at_a_limit_is_held_by_nothing(left: float, status: str):
    found, _ = loops_of_a_tank()
    window = float(found._delay[0] + found._lag[0])
    said = []
    for k in range(int(3 * window / 2)):
        off = 10.0 * left ** (2 * k / window)
        said.append(found.note(np.array([40.0 - off]), np.array([40.0]), np.array([1.0]), 2.0)[0])
    assert said[-1] == status
    found.restart()
    assert found.note(np.array([30.0]), np.array([40.0]), np.array([1.0]), 2.0) == ("ok", "")
