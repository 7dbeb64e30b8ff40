"""Sample at 100 Hz over a pty beside the MPC: is a sample lost, how late are they, beside a bare read loop?

    python benchmarks/rig/jitter.py --seconds 600

Four processes: two virtual devices, each on a pty; the session's side (this one), which samples the first in
a thread with our driver (:class:`~thermogrip.rig.drivers.background_sampler.Sampler`), solves the MPC in the
main thread once a sample time and applies its drive between two samples; and a bare loop at the same time on
the second device, which knows no protocol: write a fixed line, read until a line feed, sleep until the next
tick.

The first device measures by its own clock and keeps its readings until they are fetched, so a host that is
held up fetches them later; the bare loop, as any that asks for each sample, does not get what it did not ask
for in time (``--poll`` makes ours do the same).  Lost are samples that never came; for ours the gaps between
the times of the readings are counted too, which must say the same.

Lateness is when a tick's answer was there less when the tick was; percentiles over all ticks after the first
two seconds.  The last line asks whether our p99 is at most 1.5 times the bare loop's.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from thermogrip.rig.drivers.thermogrip import DeviceRig

BARE = """
import json, os, select, sys, time, tty
port, seconds, dt = sys.argv[1], float(sys.argv[2]), float(sys.argv[3])
line = os.open(port, os.O_RDWR | os.O_NOCTTY)
tty.setraw(line)
def ask(data):
    os.write(line, data)
    heard = b""
    while not heard.endswith(b"\\n"):
        select.select([line], [], [], 1.0)
        heard += os.read(line, 4096)
ask(sys.argv[5].encode() + b"\\n")
print("ready", flush=True)
sys.stdin.readline()
begin, k, late, missed = time.monotonic(), 0, [], 0
while k * dt < seconds:
    wait = begin + k * dt - time.monotonic()
    if wait > 0:
        time.sleep(wait)
    ask(sys.argv[4].encode() + b"\\n")
    now = time.monotonic()
    late.append(now - begin - k * dt)
    due = int((now - begin) / dt) + 1
    missed += due - k - 1
    k = due
print(json.dumps({"late": late, "missed": missed}))
"""


SHOWN = ("p50", "p99", "p99.9", "max")


def virtual(seed: int) -> tuple[subprocess.Popen[str], str]:
    """Start a virtual device in a process of its own and return it and its port."""
    words = [sys.executable, "-m", "thermogrip", "virtual", "--protocol", "thermogrip", "--seed", str(seed)]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    return process, process.stdout.readline().strip()


def figures(late: list[float], dt: float) -> dict[str, float]:
    """Return lateness percentiles in ms."""
    ms = 1000 * np.asarray(late[round(2.0 / dt) :])
    p50, p99, p999 = np.percentile(ms, [50, 99, 99.9])
    return {"n": ms.size, "p50": p50, "p99": p99, "p99.9": p999, "max": float(ms.max())}


class _Polled:
    """A rig that cannot measure by its own clock."""

    def __init__(self, rig: DeviceRig) -> None:
        self.read = rig.read


def steps_of(times: list[float], dt: float) -> str:
    """Return how far apart readings were by their own times."""
    apart = 1000 * np.diff(times)
    gaps = int(np.sum(np.round(apart / (1000 * dt)) - 1))
    p01, p99 = np.percentile(apart, [1, 99])
    return f"{p01:.2f} to {p99:.2f} ms apart (1 % to 99 %), {gaps} gaps"


def main() -> int:
    """Run and print the table; 0 if nothing was lost and the ratio holds."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--seconds", type=float, default=600.0)
    options.add_argument("--rate", type=float, default=100.0)
    options.add_argument("--poll", action="store_true", help="ask for each sample, as with an older firmware")
    options.add_argument("--compiled", action="store_true", help="the MPC's C instead of its Python")
    chosen = options.parse_args()
    os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"

    from thermogrip.mpc import Controller
    from thermogrip.rig.drivers.background_sampler import Sampler
    from thermogrip.rig.drivers.thermogrip import DeviceRig
    from thermogrip.rig.serial.port import Port
    from thermogrip.rig.serial.protocol import encode_line
    from thermogrip.rig.simulation.virtual_device import example_plant

    dt, steps = 1 / chosen.rate, []
    devices = [virtual(seed) for seed in (1, 2)]
    hello = encode_line(1, "hello").decode().strip()
    ask = encode_line(2, "read").decode().strip()  # the same number: the device repeats its answer
    bare = subprocess.Popen(
        [sys.executable, "-c", BARE, devices[1][1], str(chosen.seconds), str(dt), ask, hello],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        rig = DeviceRig(Port(devices[0][1]))
        controller = Controller(example_plant(), compiled=chosen.compiled)
        controller.reset(rig.read().as_controller_reading())
        for _ in range(3):
            controller.step(rig.read().as_controller_reading(), 35.0)  # what is built at the first step
        assert bare.stdin is not None
        assert bare.stdout is not None
        bare.stdout.readline()
        times, newest = [], rig.read()
        with Sampler(_Polled(rig) if chosen.poll else rig, dt) as sampler:
            bare.stdin.write("go\n")
            bare.stdin.flush()
            begin = time.monotonic()
            while (passed := time.monotonic() - begin) < chosen.seconds:
                readings = sampler.take()
                times += [reading.time_s for reading in readings]
                newest = readings[-1] if readings else newest
                move = controller.step(newest.as_controller_reading(), 35.0 if passed % 200 < 100 else 20.0)
                steps.append(move.seconds)
                drive = move.drive
                assert isinstance(drive, float)
                for part in (0.5, 1.0):  # a drive lives 2 s, as long as a sample of this controller
                    sampler.ask(lambda value=drive, pump=move.pump: rig.apply({"drive": value}, pump))
                    end = begin + (len(steps) - 1 + part) * controller.dt
                    time.sleep(max(0.0, end - time.monotonic()))
            times += [reading.time_s for reading in sampler.take()]
            ours, missed, dropped = list(sampler.late), sampler.missed, sampler.dropped
        theirs = json.loads(bare.communicate(timeout=60)[0])
        troubles = [notice for notice in rig.notices() if notice.kind != "link"]
        rig.close()
    finally:
        for process, _ in devices:
            process.terminate()
            process.wait()
        bare.kill()
        bare.wait()
    a, b = figures(ours, dt), figures(theirs["late"], dt)
    ratio, load, median = a["p99"] / b["p99"], os.getloadavg()[0], 1000 * np.median(steps)
    print(f"{chosen.seconds:g} s at {chosen.rate:g} Hz, load {load:.1f}; MPC steps {len(steps)}, ", end="")
    print(f"median {median:.1f} ms, longest {1000 * max(steps):.1f} ms")
    print(f"{'lateness [ms]':16s} {'samples':>8s}", *(f"{name:>7s}" for name in (*SHOWN, "lost")))
    for name, row, lost in (("ours beside MPC", a, missed + dropped), ("bare loop", b, theirs["missed"])):
        print(f"{name:16s} {row['n']:8.0f}", *(f"{row[key]:7.2f}" for key in SHOWN), f"{lost:7d}")
    print(f"readings taken {len(times)}, {steps_of(times, dt)}")
    print(f"reported by the rig {len(troubles)}, p99 ratio {ratio:.2f} (asked: at most 1.5)")
    return 0 if missed + dropped == 0 and a["p99"] <= 1.5 * b["p99"] else 1


if __name__ == "__main__":
    sys.exit(main())
