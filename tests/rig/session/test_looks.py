"""However long a sample is, the rig is looked at and its drive renewed within half a second."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.rig.fault_injection.limits import LIMITS, drive_into
from tests.rig.makers import SteppedClock
from tests.rig.session.test_loop import rig_of, shown, started, told, trip_of
from thermogrip.mpc.interface import Move
from thermogrip.rig.guard.guard import LIMIT_MARGIN
from thermogrip.rig.interface import Event, Reading
from thermogrip.rig.session.loop import LOOK_S


@pytest.mark.parametrize(("device", "limit"), LIMITS)
def test_no_limit_is_exceeded_by_two_kelvin_though_a_sample_is_an_hour(device: str, limit: float) -> None:
    beyond = drive_into(device, limit, 3600.0)
    assert beyond.ended.startswith("limit:")
    assert 0.0 < beyond.at_off <= beyond.highest < LIMIT_MARGIN
    assert beyond.driven < 5.0


@pytest.mark.parametrize("dt", [0.1, 0.5, 1.5, 60.0])
def test_a_rig_is_read_checked_renewed_and_shown_within_half_a_second(dt: float) -> None:
    run = started(Move(drive=40.0), rig=rig_of())
    run.controller.dt, seen, begin = dt, shown(run), run.rig.time
    for _ in run.regulate("hold", 1.9 * dt):
        pass
    looks = np.diff([begin] + [one.time_s for one in seen[1:]])
    assert looks.max() <= LOOK_S + 1e-9
    assert run.rig.apply.call_count == len(seen) == pytest.approx(2 * max(1, dt / LOOK_S))
    assert run.column("time_s").tolist() == [begin, begin + dt]  # rows and the controller keep their time
    assert [time for time, _ in run.controller.seen[1:]] == [begin, begin + dt]


def test_a_computer_that_comes_late_keeps_the_time_of_its_samples() -> None:
    run = started(Move(drive=40.0), rig=rig_of())
    late = iter([0.0, 1.1, 0.0, 0.3] + [0.0] * 99)

    def wait(seconds: float) -> None:
        run.rig.time = round(run.rig.time + seconds + next(late), 9)

    run.rig.wait.side_effect = wait
    run.wait(5.0)
    assert abs(run.rig.time - 15.0) <= 0.5 * LOOK_S


@pytest.mark.parametrize("fault", ["operator", "lost", "reset"])
def test_what_happens_within_a_long_sample_ends_it_there(fault: str) -> None:
    run = started(Move(drive=40.0), rig=rig_of())
    step = run.rig.wait.side_effect

    def wait(seconds: float) -> None:
        step(seconds)
        if run.rig.time > 20.0:
            if fault == "operator":
                run.operator.stop("the page")
            elif fault == "lost":
                run.rig.values["t_tank"] = float("nan")
            else:
                run.rig.notices.return_value = [replace(run.events[0], kind="reset", text="reset")]

    run.rig.wait.side_effect = wait
    trip = trip_of(lambda: run.wait(3600.0))
    assert trip.kind == {"reset": "device"}.get(fault, fault)
    assert 20.0 < trip.time_s <= 20.0 + 3 * LOOK_S
    assert fault != "lost" or len(told(run, "lost")) == 1


@pytest.mark.parametrize(
    ("drive", "expires", "notice", "kind"),
    [(40.0, 2.0, "", ""), (40.0, 2.0, "expired", "frozen"), (40.0, np.inf, "", "frozen"),
     (0.0, np.inf, "", "")],
)  # fmt: skip
@pytest.mark.parametrize("in_a_wait", [True, False])
def test_a_program_that_came_late_goes_on_where_the_device_says_that_its_drive_has_held(
    drive: float, expires: float, notice: str, kind: str, in_a_wait: bool
) -> None:
    run, clock = started(Move(drive=drive), rig=rig_of()), SteppedClock(10.0)
    rig, run.clock, run.rig.expires_s = run.rig, clock, expires
    rig.read.side_effect = lambda: Reading(clock(), dict(rig.values), rig.apply.call_args.args[0], 1)
    clock.sleep(30.0)  # a controller may take its time while nothing is driven
    run.move = Move(drive=drive)
    run.record("hold")
    rig.wait.side_effect = lambda seconds: clock.sleep(seconds + 2.2 * in_a_wait)
    rig.notices.return_value = [Event(42.0, notice, "the drive has ended")] if notice else []

    def go_on() -> None:
        run.wait(0.5)
        clock.sleep(2.2 * (not in_a_wait))
        run.record("hold")

    if kind:
        trip = trip_of(go_on)
        assert (trip.kind, "what stopped the program" in trip.check) == (kind, True)
    else:
        go_on()
        lateness = [text.partition(" measured ")[2] for _, text in told(run, "late")]
        assert lateness == ["after 2.7 s"] * bool(drive)


def test_a_computer_that_is_late_at_first_is_no_fault_of_the_rigs_clock() -> None:
    run, clock = started(Move(drive=40.0), rig=rig_of()), SteppedClock(10.0)
    late = iter([1.9, 0.0, 1.4, 0.0])  # seconds from a measurement to its end in the program

    def read() -> Reading:
        reading = Reading(clock(), dict(run.rig.values), run.rig.apply.call_args.args[0], 1)
        clock.sleep(next(late))
        return reading

    run.clock, run.rig.read.side_effect, run.rig.wait.side_effect = clock, read, clock.sleep
    for _ in run.regulate("hold", 2.0):
        pass
    assert len(run.rows) >= 2
