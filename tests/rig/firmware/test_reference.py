"""What the device's core does by itself: its reference in Python, from which the firmware does not differ."""

from __future__ import annotations

import re

from tests.rig.cores import SCRIPTS, START, last_state, reference, say


def test_a_drive_ends_after_its_time_and_not_before() -> None:
    pins = [line for line in reference(SCRIPTS["a drive expires"]).splitlines() if line.startswith("pins")]
    assert pins == ["pins 1 -2500 1 0", "pins 1 -2500 1 0", "pins 0 0 0 0"]
    assert last_state(reference(SCRIPTS["a drive expires"]))[0] == "expired"


def test_a_repeated_drive_does_not_live_longer() -> None:
    assert reference(SCRIPTS["a repeated question does nothing twice"]).endswith("pins 0 0 0 0\n")


def test_a_latch_holds_until_its_cause_is_over_and_it_is_cleared() -> None:
    said = reference(SCRIPTS["an open sensor latches at the fourth sample"])
    assert re.findall(r"(?:err|pins) (\w+)", said) == ["1", "0", "latched", "active", "1"]


def test_a_lost_room_sensor_is_no_reason_to_stop() -> None:
    script = [*START, *[f"sample 1 {100 * k} 25000 25000 open" for k in range(1, 9)]]
    assert last_state(reference([*script, say(2, "read", now=900)]))[::4] == ["off", "-", "25000,25000,open"]


def test_what_is_out_of_limits_is_named() -> None:
    said = reference(SCRIPTS["too warm and too cold latch"])
    assert last_state(said)[4] == "over:t_tank,under:t_surface"


def test_a_stalled_pump_switches_off_after_three_seconds_and_has_them_again_when_it_was_cleared() -> None:
    said = reference(SCRIPTS["a pump that has stopped latches"])
    assert re.findall(r"pins (\d)", said) == ["1", "0", "1", "0"]
    assert "pump" in said


def test_refusals_name_their_reason() -> None:
    said = reference(SCRIPTS["what is refused"])
    codes = ["hello", "interlock", *["ttl"] * 2, "range", *["syntax"] * 3, "unknown", *["syntax"] * 2]
    assert re.findall(r"err (\w+)", said) == codes
    assert said.endswith("pins 0 0 0 1\n")  # nothing was driven, only the gripper closed
