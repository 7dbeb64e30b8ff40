"""Write the section of docs/reference/faults.md on how far beyond a limit a rig goes.

    python benchmarks/rig/limits.py --out docs/reference/faults.md

The runs are those of tests/rig/session/test_looks.py (:mod:`tests.rig.fault_injection.limits`).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from thermogrip.rig.guard.guard import LIMIT_MARGIN
from thermogrip.rig.session.loop import LOOK_S

sys.path.insert(0, str(Path(__file__).parents[2]))  # the runs are tests
from tests.rig.fault_injection.limits import LIMITS, ROOM, SAMPLES_S, drive_into

# ruff: noqa: E501

BEGIN, END = "## How far beyond a limit", "## "
NEAR_ROOM = ("TCLab", 28.0)
TEXT = """\
{begin}

**The guard's guarantee**: power is off before a limit is exceeded by {margin:g} K. The rig is looked at, and its drive
renewed, every {look:g} s or sooner, whatever `--sample` and the controller's own sample time are. A limit takes two readings beyond it, so that one
bad reading ends no session.

Full drive of everything from {room:g} degC into the limit, all sensors honest; in K beyond the limit, of the warmest
true temperature (the most over samples of {samples} s; `python benchmarks/rig/limits.py --out docs/reference/faults.md`):

| device, limit of all sensors | when power went off | the highest afterwards | driven beyond the limit for |
|---|---|---|---|
{rows}

What is in a heater when power goes off still comes: on the last line, 5 K above the room at full power, it is most of what is seen. Keep such a
distance from what must not be exceeded, or drive more gently.

"""


def main() -> None:
    """Drive every device into its limit at every sample time and write the section."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    out: Path = parser.parse_args().out
    out.write_text(with_limits(out.read_text(encoding="utf-8")), encoding="utf-8")


def with_limits(page: str) -> str:
    """Return the page with its section on limits measured anew."""
    rows = []
    for device, limit in (*LIMITS, NEAR_ROOM):
        beyond = [drive_into(device, limit, dt) for dt in SAMPLES_S]
        at_off, highest, driven_s = (
            max(getattr(one, name) for one in beyond) for name in ("at_off", "highest", "driven")
        )
        rows.append(f"| {device}, {limit:g} degC | {at_off:.1f} | {highest:.1f} | {driven_s:.1f} s |")
        print(rows[-1], flush=True)
    samples = ", ".join(f"{dt:g}" for dt in SAMPLES_S)
    text = TEXT.format(
        begin=BEGIN, margin=LIMIT_MARGIN, look=LOOK_S, room=ROOM, samples=samples, rows="\n".join(rows)
    )
    before, _, rest = page.partition(BEGIN)
    return before + text + rest[rest.index(END) :]


if __name__ == "__main__":
    main()
