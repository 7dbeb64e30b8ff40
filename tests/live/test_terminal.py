"""A session on a terminal, and where there is none."""

from __future__ import annotations

import io
from dataclasses import replace
from math import inf, nan

import pytest
from rich.console import Console

from thermogrip.live.terminal import line, numbers, panel
from thermogrip.rig.guard.trip import Trip
from thermogrip.rig.interface import Event
from thermogrip.rig.session.snapshot import Snapshot

NOW = Snapshot(
    time_s=12.5, phase="lead_in", left_s=3.4, dt=0.1, skin="t_surface",
    values={"t_tank": 31.4, "t_surface": 37.9, "t_ambient": nan}, target={"t_surface": 38.0}, band=0.25,
    drive={"drive": 0.42}, units={"drive": "1"}, pump=1, margin=17.1, nearest="t_surface", model_share=0.4,
    expires_s=2.0, events=(Event(0.0, "opened", "gripper opened"), Event(12.0, "phase", "lead_in")),
)  # fmt: skip
TRIP = Trip("limit", 12.5, "t_surface", "3 to 55 degC", "61.00 degC")


def test_the_numbers_of_a_session() -> None:
    assert dict(numbers(NOW)) == {
        "t_surface": "37.90 degC", "target of t_surface": "38 +- 0.25 degC", "t_tank": "31.40 degC",
        "t_ambient": "lost", "drive": "+0.42", "pump": "on", "phase": "lead in, 3 s left",
        "guard margin": "17.1 K to the limit of t_surface", "beside the model": "40 % of what is allowed",
    }  # fmt: skip
    bare = replace(NOW, target={}, band=nan, left_s=inf, margin=inf, units={"drive": "percent"}, pump=0)
    shown = dict(numbers(bare))
    assert (shown["phase"], shown["drive"], shown["pump"]) == ("lead in", "+0.42 %", "off")
    assert not shown.keys() & {"guard margin", "target of t_surface"}
    assert "pump" not in dict(numbers(replace(NOW, pump=None)))


def test_one_line_has_the_same_numbers_and_what_happened_last() -> None:
    assert line(NOW).startswith("12.5 s: t_surface 37.90 degC, target of t_surface 38 +- 0.25 degC")
    assert line(NOW).endswith("; phase: lead_in")
    assert line(replace(NOW, trip=TRIP, verdict="tripped")).endswith(f"; {TRIP.line()}")
    assert "\x1b" not in line(replace(NOW, events=(Event(0.0, "bad", "\x1b[2Jgone"),)))


@pytest.mark.parametrize("width", [120, 60])
def test_a_panel_fits_its_terminal_and_says_what_to_do_after_a_trip(width: int) -> None:
    out = io.StringIO()
    console = Console(file=out, width=width)
    for now in (None, NOW, replace(NOW, trip=TRIP, verdict="tripped"), replace(NOW, verdict="settled")):
        console.print(panel("run", now, note=" 45 %  settling", width=width))
    text = out.getvalue()
    assert max(map(len, text.splitlines())) <= width
    for words in ("37.90 degC", "38 +- 0.25 degC", "settling", "phase: lead_in", "tripped"):
        assert words in text, words
    assert "to clear: let it come back inside the limits" in " ".join(text.replace("│", "").split())
