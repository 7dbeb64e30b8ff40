"""Write the measured tables of docs/reference/faults.md: every fault that is drilled, what no sensor shows.

    python benchmarks/rig/faults.py --out docs/reference/faults.md

The drills are those of tests/rig/fault_injection/test_drills.py (:mod:`tests.rig.fault_injection.drills`,
:mod:`tests.rig.fault_injection.host_drills`).
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.interface import Move, Readings, Target
from thermogrip.rig.guard.guard import Guard
from thermogrip.rig.guard.trip import KINDS
from thermogrip.rig.interface import Reading
from thermogrip.rig.session.session import run_session
from thermogrip.rig.simulation.twin import Twin

sys.path.insert(0, str(Path(__file__).parents[2]))  # the drills are tests
from tests.rig.fault_injection.drills import DRILLS, Outcome, drill_plants, run_drill
from tests.rig.fault_injection.host_drills import HOST_DRILLS, HostOutcome, run_host_drill


def main() -> None:
    """Run every drill and write the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    out: Path = parser.parse_args().out
    controller = PIController(drill_plants()[0], dt=1.0)
    page = with_rows(out.read_text(encoding="utf-8"), "| fault |", drilled(controller))
    page = with_rows(page, "| held at [degC] |", unseen(controller))
    kinds = [f"| `{kind}` | {check} |" for kind, (check, _) in KINDS.items()]
    out.write_text(with_rows(page, "| kind |", kinds), encoding="utf-8")


def with_rows(page: str, head: str, rows: list[str]) -> str:
    """Return a page whose table with a head that begins so has other rows."""
    lines = page.split("\n")
    first = 2 + next(k for k, line in enumerate(lines) if line.startswith(head))
    return "\n".join([*lines[:first], *rows, *lines[lines.index("", first) :]])


def drilled(controller: PIController) -> list[str]:
    """Return a row for each drill."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for k, drill in enumerate(DRILLS):
            hold = 400.0 if drill.kinds else 60.0
            rows.append(_row(run_drill(drill, controller, Path(folder) / f"d{k}", hold=hold)))
            print(rows[-1], flush=True)
        for k, host in enumerate(HOST_DRILLS):
            rows.append(_host_row(run_host_drill(host, Path(folder) / f"h{k}")))
            print(rows[-1], flush=True)
    return rows


class Together(Twin):
    """A rig all of whose outputs are off by so many K per hour after half an hour, or read the room."""

    off_place, rate = False, -10.0

    def read(self) -> Reading:
        """Return what the sensors show."""
        found, room = super().read(), self.ambient
        off = self.rate * max(self.time / 3600 - 0.5, 0.0)
        values = {name: room if self.off_place else value + off for name, value in found.values.items()}
        return replace(found, values={**values, "t_ambient": room})


class Constant:
    """A controller that asks for one drive."""

    def __init__(self, drive: float) -> None:
        self.drive, self.dt = drive, 1.0

    def reset(self, reading: Readings) -> None: ...

    def step(self, reading: Readings, target: Target) -> Move:
        """Return the move."""
        return Move(drive=self.drive)


def unseen(controller: PIController) -> list[str]:
    """Return how far sensors that are wrong together lead, until that is found.

    How far they lead where no model is known is printed alone.
    """
    rows, (known, real) = [], drill_plants()
    for target in (46.0, 36.0, 20.0):
        rig = Together(real, ambient=25.0, seed=1)
        rig.rate = -10.0 if target > 25.0 else 10.0
        trip = run_session(rig, controller, target, hold=7200.0, guard=Guard(known)).trip
        off = "never" if trip is None else f"{10 * (rig.time / 3600 - 0.5):.1f}"
        rows.append(f"| {target:g} | {off} | {rig.truth()['t_surface']:.1f} |")
        print(rows[-1], trip and trip.line(), flush=True)
    for drive in (1.0, 0.49, 0.25, 0.1, 0.06, -0.06, -0.25, -1.0):
        rig = Together(real, ambient=25.0, seed=1)
        rig.off_place = True
        run_session(rig, Constant(drive), 35.0, guard=Guard(), settle_timeout=7200.0)
        beyond = max(abs(value - rig.ambient) for value in rig.truth().values())
        print(f"no model, drive {drive:g}: {beyond:.1f} K after {rig.time:.0f} s", flush=True)
    return rows


def _row(one: Outcome) -> str:
    name = one.drill.name + (", held" if one.drill.at > 100 and "held" not in one.drill.name else "")
    beyond = f"{max(one.excursion, 0.0):.1f}"
    if one.session.trip is None:
        return f"| {name} | - | the session goes on: {one.session.verdict} | - | {beyond} |"
    off = f"{one.off:.1f}" if one.off <= 0.1 else f"{one.detected + one.off:.1f} from the fault"
    return f"| {name} | {one.detected:.1f} | `{one.session.trip.kind}` | {off} | {beyond} |"


def _host_row(one: HostOutcome) -> str:
    trip = one.run.about.get("trip")
    by = f"`{trip['kind']}`" if trip else {"running": "the device alone"}.get(one.run.about["verdict"], "")
    by = by or ("refused; the first goes on" if "second" in one.drill.name else "power off on the way out")
    off = f"{one.off:.1f} from the fault"
    return f"| {one.drill.name} | - | {by} | {off} | {max(one.excursion, 0.0):.1f} |"


if __name__ == "__main__":
    main()
