"""Write docs/reference/faults.md: every fault that is drilled, and what it costs.

    python benchmarks/rig/faults.py --out docs/reference/faults.md

The drills are those of tests/rig/test_fault_table.py (:mod:`thermogrip.rig.drills`,
:mod:`thermogrip.rig.host_drills`).
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from thermogrip.mpc.pid import PIController
from thermogrip.rig.drills import DRILLS, Outcome, drill_plants, run_drill
from thermogrip.rig.host_drills import HOST_DRILLS, HostOutcome, run_host_drill
from thermogrip.rig.trips import KINDS

# ruff: noqa: E501
HEAD = """\
# What happens when something fails

Every line is a test (`tests/rig/test_fault_table.py`) on a virtual device behind a real pseudo-terminal; this
page is written by `python benchmarks/rig/faults.py --out docs/reference/faults.md`. The device's plant is a few
percent off the model that guard and controller know; the room is 25 degC, the skin is on its way from 25 to
36 degC or, where it says *held*, was there.

- **found**: from the fault to the trip, by the device's clock. A sample is 1 s, and the fault comes between two.
- **off**: from the trip to zero drive at the module. Where the host is dead or the cable out no line of ours
  runs: there it is the time from the fault, and the device's own 2 s end it.
- **beyond**: how far the true temperatures of water and skin left the range of a session without the fault.
- **rows**: on disk afterwards. None was lost and none is wrong, in every line: before the fault each is the truth
  within noise; what a broken sensor said is on disk as it said it.

**A TCLab cannot do this.** Its firmware has no time to live: if its host dies, or its cable is pulled, it heats on
until somebody pulls the supply. Everything that the host can see is watched on it as well.

**The guard's promise**: no limit is exceeded by more than 2 K before power is off.

| fault | found after [s] | by | off after [s] | beyond [K] | rows |
|---|---|---|---|---|---|
"""

SLOW = """
## Why some take their time

| fault | found after [s] | why not sooner |
|---|---|---|
"""

SAID = """
## What is said

One line on the terminal, the same as JSON in `events.jsonl` and `run.json`. Two of them:

"""

TAIL = """
## Every kind of trip

| kind | check | to clear |
|---|---|---|
"""


def main() -> None:
    """Run every drill and write the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    out: Path = parser.parse_args().out
    controller = PIController(drill_plants()[0], dt=1.0)
    outcomes, hosts = [], []
    with tempfile.TemporaryDirectory() as folder:
        for k, drill in enumerate(DRILLS):
            hold = 400.0 if drill.kinds else 60.0
            outcomes.append(run_drill(drill, controller, Path(folder) / f"d{k}", hold=hold))
            print(drill.name, flush=True)
        for k, host in enumerate(HOST_DRILLS):
            hosts.append(run_host_drill(host, Path(folder) / f"h{k}"))
            print(host.name, flush=True)
    lines = [_row(one) for one in outcomes] + [_host_row(one) for one in hosts]
    slow = [f"| {o.drill.name} | {o.detected:.1f} | {o.drill.why} |" for o in outcomes if o.drill.why]
    said = [
        f"    {o.message}" for o in outcomes if o.drill.name in ("pump stands still", "driver gives nothing")
    ]
    kinds = [f"| `{kind}` | {check} | {clear} |" for kind, (check, clear) in KINDS.items()]
    text = HEAD + "\n".join(lines) + "\n" + SLOW + "\n".join(slow) + "\n" + SAID + "\n\n".join(said) + "\n"
    out.write_text(text + TAIL + "\n".join(kinds) + "\n")


def _row(one: Outcome) -> str:
    name = one.drill.name + (", held" if one.drill.at > 100 and "held" not in one.drill.name else "")
    beyond = f"{max(one.excursion, 0.0):.1f}"
    if one.session.trip is None:
        return f"| {name} | - | the session goes on: {one.session.verdict} | - | {beyond} | {one.rows} |"
    off = f"{one.off:.1f}" if one.off <= 0.1 else f"{one.detected + one.off:.1f} from the fault"
    return f"| {name} | {one.detected:.1f} | `{one.session.trip.kind}` | {off} | {beyond} | {one.rows} |"


def _host_row(one: HostOutcome) -> str:
    trip = one.run.about.get("trip")
    by = f"`{trip['kind']}`" if trip else {"running": "the device alone"}.get(one.run.about["verdict"], "")
    by = by or ("refused; the first goes on" if "second" in one.drill.name else "power off on the way out")
    off = f"{one.off:.1f} from the fault"
    return f"| {one.drill.name} | - | {by} | {off} | {max(one.excursion, 0.0):.1f} | {one.rows} |"


if __name__ == "__main__":
    main()
