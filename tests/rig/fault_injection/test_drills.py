"""The fault table: one thing fails at a time, on a virtual device on a real pty."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.rig.fault_injection.drills import DRILLS, Drill, drill_plants, run_drill
from tests.rig.fault_injection.host_drills import HOST_DRILLS, ROWS, HostDrill, run_host_drill
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.rig.records.run_folder import recover

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs a pty")


@pytest.fixture(scope="module")
def controller() -> PIController:
    return PIController(drill_plants()[0], dt=1.0)


def test_without_a_fault_nothing_trips_and_every_row_is_right(
    controller: PIController, tmp_path: Path
) -> None:
    outcome = run_drill(None, controller, tmp_path / "run", hold=10.0)
    assert outcome.session.verdict == "settled"
    assert outcome.wrong == 0


#: A sensor of each kind of fault, a driver either way, a line, a device: the others end by the same checks.
LONG = {
    "tank sensor short", "tank sensor stuck, on the way", "tank sensor late by 5 s", "driver gives nothing",
    "driver stuck at full cooling", "1 % of all lines spoilt", "device browned out", "device deaf",
    "Ctrl-C", "host asked to end (SIGTERM)", "controller raises an exception",
}  # fmt: skip


def each(drills: Sequence[Drill | HostDrill]) -> list[Any]:
    """Return the drills as cases, those that others stand for marked as long."""
    return [
        pytest.param(drill, id=drill.name, marks=[pytest.mark.slow] * (drill.name in LONG))
        for drill in drills
    ]


@pytest.mark.parametrize("drill", each(DRILLS))
def test_a_fault_is_found_in_time_and_the_drive_is_zero(
    drill: Drill, controller: PIController, tmp_path: Path
) -> None:
    hold = 400.0 if drill.kinds else 10.0
    outcome = run_drill(drill, controller, tmp_path / "run", hold=hold)
    trip = outcome.session.trip
    assert outcome.wrong == 0
    assert outcome.excursion <= 2.0
    if not drill.kinds:
        assert outcome.session.verdict == "settled"
        return
    assert trip.kind in drill.kinds
    assert outcome.detected <= drill.within
    assert outcome.off <= 2.0
    assert trip.check
    assert trip.clear
    assert len(outcome.message.splitlines()) == 1


@pytest.mark.parametrize("drill", each(HOST_DRILLS))
def test_whatever_happens_to_the_host_the_drive_ends(drill: HostDrill, tmp_path: Path) -> None:
    outcome = run_host_drill(drill, tmp_path / "run")
    assert outcome.off <= 2.1  # 2 s on the device, and one of its samples
    assert outcome.excursion < 2.0
    assert outcome.rows >= ROWS - (drill.act is None)
    assert outcome.wrong == 0
    if drill.act is not None and drill.dead and outcome.returned == -signal.SIGKILL:
        assert recover(tmp_path / "run").run.about["verdict"] == "interrupted"
    else:
        assert outcome.run.about["verdict"] in ("tripped", "interrupted", "failed")
        assert outcome.said
    if "second program" in drill.name:
        assert "is used by another program" in outcome.said
        assert outcome.run.about["verdict"] == "interrupted"  # the first one did not notice: no drive ran out


def test_the_table_has_twenty_rows() -> None:
    assert len(DRILLS) + len(HOST_DRILLS) >= 20
    names = [drill.name for drill in (*DRILLS, *HOST_DRILLS)]
    assert len(set(names)) == len(names)
    page = (Path(__file__).parents[3] / "docs" / "reference" / "faults.md").read_text()
    for name in names:
        assert f"| {name}" in page, (
            "write it anew: python benchmarks/rig/faults.py --out docs/reference/faults.md"
        )
