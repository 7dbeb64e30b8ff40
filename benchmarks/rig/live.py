"""What a live page costs the control loop, and what holds where one end is killed or a request is forged.

    chrt -f 1 python benchmarks/rig/live.py --seconds 120 --block 5     other work of the computer is kept out

**Cost.**  One loop, as a session runs it (guard, controller, snapshot), regulates a twin that waits on the
computer's clock, at 100 Hz, and keeps when each sample began.  Blocks of ``--block`` seconds alternate:
without ``--live`` (lines on no terminal); with it and three viewers, each a process of its own, that read
all it sends.  So both see the same load of the computer.  Of the periods (nominal 10 ms) p50, p99 and the
largest are printed, and the ratio of the two p99, which must be at most 1.1.

**Killed.**  The page's process, in a session: is it finished, and how long did the loop's longest period
take?  The session's process, on a virtual device in real time: how long until a viewer is told, and until
the device's drive is zero?

**Forged.**  The requests of ``tests/live/test_server.py``: how many are refused.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from contextlib import redirect_stderr
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.end_to_end.conftest import small_plant
from tests.live.test_server import FORGED, ask
from thermogrip.live.watch import Show, Watch
from thermogrip.mpc import Controller, PIController
from thermogrip.report.console import Console
from thermogrip.rig.clock import Metronome
from thermogrip.rig.guard.guard import Guard
from thermogrip.rig.session.loop import Loop
from thermogrip.rig.simulation.twin import Twin
from thermogrip.rig.simulation.virtual_device import VirtualDevice

VIEWER = """
import sys, urllib.request
address, cookie = sys.argv[1:3]
request = urllib.request.Request(address + "events", headers={"Cookie": cookie})
with urllib.request.urlopen(request, timeout=30) as events:
    n = 0
    for line in events:
        n += len(line)
print(n)
"""


class RealTime(Twin):
    """A twin whose waits take real time, on a grid; keeps when each ended."""

    def __init__(self, **options: Any) -> None:
        super().__init__(small_plant(), **options)
        self.beat, self.ends = Metronome(time.monotonic), []

    def wait(self, seconds: float) -> None:
        """Wait and simulate."""
        end = self.beat.next(seconds)
        time.sleep(max(0.0, end - time.monotonic()))
        self.ends.append(time.monotonic())
        super().wait(seconds)


def started(rig: Twin, watch: Watch) -> Loop:
    """Return a loop at 100 Hz that regulates to 28 degC."""
    loop = Loop(rig, PIController(rig.plant), None, None, Guard(rig.plant), listener=watch.listen)
    loop.start({"t_surface": 28.0})
    return loop


def block(seconds: float, dt: float, viewers: int) -> tuple[np.ndarray, int]:
    """Return the periods of a loop [s] with so many viewers, or without a page, and what a viewer got."""
    rig = RealTime(seed=1, t_start=25.0)
    with Watch("run", Console(True), Show(live=0 if viewers else None)) as watch:
        address, cookie = reached(watch.address) if viewers else ("", "")
        words = [sys.executable, "-c", VIEWER, address, cookie]
        reading = [subprocess.Popen(words, stdout=subprocess.PIPE) for _ in range(viewers)]
        time.sleep(1.0)
        loop = started(rig, watch)
        loop.sample("hold", round(seconds / dt), dt)
        watch.ended("done")
    got = [int(one.communicate(timeout=30)[0]) for one in reading]
    return np.diff(rig.ends[round(1 / dt) :]), min(got, default=0)


def reached(address: str) -> tuple[str, str]:
    """Return a page's address without its token, and the cookie that has it."""
    own, token = address.split("?token=")
    return own, f"thermogrip_{own.split(':')[2].rstrip('/')}={token}"


def percentiles(periods: np.ndarray) -> list[float]:
    """Return p50, p99 and the largest [ms]."""
    return [*(1000 * np.percentile(periods, [50, 99])).tolist(), 1000 * float(periods.max())]


def page_killed(dt: float) -> dict[str, Any]:
    """Kill the page's process in a session of 6 s."""
    rig = RealTime(seed=1, t_start=25.0)
    with Watch("run", Console(True), Show(live=0)) as watch:
        assert watch._page is not None
        threading.Timer(3.0, os.kill, (watch._page.pid, signal.SIGKILL)).start()
        loop = started(rig, watch)
        loop.sample("hold", round(6.0 / dt), dt)
    return {
        "samples": len(loop.rows),
        "of": round(6.0 / dt),
        "longest_ms": 1000 * float(np.diff(rig.ends).max()),
    }


def session_killed(speaks: str) -> dict[str, Any]:
    """Kill a session that drives a virtual device."""
    plant = small_plant()
    device = VirtualDevice(plant, protocol=speaks, link="socket", t_start=23.0)
    with tempfile.TemporaryDirectory() as folder, device:
        controller = Controller(plant).save(Path(folder) / "c.json")
        words = [sys.executable, "-P", "-m", "thermogrip", "run", str(controller), "--port", device.port]
        words += ["--target", "40", "--out", f"{folder}/run", "--live"]
        run = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
        assert run.stderr is not None
        own, cookie = reached(next(line.split()[1] for line in run.stderr if line.startswith("live: ")))
        asked = urllib.request.Request(own + "events", headers={"Cookie": cookie})
        with urllib.request.urlopen(asked, timeout=30) as events:
            said = (json.loads(line[6:]) for line in events if line.startswith(b"data: "))
            next(one for one in said if any(one.get("now", {}).get("drive", {}).values()))
            run.kill()
            killed = time.monotonic()
            last = next(one for one in said if one["lost"])
            told = time.monotonic() - killed
        while any(device.applied_drive.values()) and time.monotonic() < killed + 10.0:
            time.sleep(0.01)
        zero = time.monotonic() - killed
        run.wait()
        run.stderr.close()
    expires = last["now"]["expires_s"]
    return {"told_s": told, "drive_zero_s": zero if zero < 10 else None, "page_says_expires_s": expires}


def forged() -> dict[str, int]:
    """Send what is forged, and a good request last."""
    with Watch("run", Console(True), Show(live=0)) as watch:
        token = watch.address.split("token=")[1]
        made = [ask(watch, kind, path.format(token=token), **more)[0] for kind, path, more in FORGED.values()]
        time.sleep(0.3)
        untouched = not watch.operator.stop_asked
        return {"sent": len(made), "refused": sum(s in (400, 403) for s in made), "unchanged": int(untouched)}


def main() -> int:
    """Print the tables; 1 where something does not hold."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--block", type=float, default=10.0)
    parser.add_argument("--viewers", type=int, default=3)
    parser.add_argument("--hz", type=float, default=100.0)
    given = parser.parse_args()
    dt, pairs = 1 / given.hz, max(1, round(given.seconds / given.block / 2))
    found: dict[int, list[np.ndarray]] = {0: [], given.viewers: []}
    got = []
    for pair in range(pairs):
        for viewers in (0, given.viewers) if pair % 2 == 0 else (given.viewers, 0):
            with redirect_stderr(io.StringIO()):
                periods, size = block(given.block, dt, viewers)
            found[viewers].append(periods)
            got += [size] if viewers else []
    print(f"{'':26} {'n':>6} {'p50':>8} {'p99':>8} {'largest':>8}  [ms]")
    p99 = {}
    for viewers, parts in found.items():
        periods = np.concatenate(parts)
        p50, p99[viewers], largest = percentiles(periods)
        name = f"--live, {viewers} viewers" if viewers else "without --live"
        print(f"{name:26} {periods.size:6d} {p50:8.3f} {p99[viewers]:8.3f} {largest:8.2f}")
    ratio = p99[given.viewers] / p99[0]
    rate = min(got) / given.block / 1000
    print(f"p99 ratio {ratio:.3f} (at most 1.1); each viewer got at least {rate:.1f} kB/s\n")
    with redirect_stderr(io.StringIO()):
        killed, lost, refused = page_killed(dt), session_killed("thermogrip"), forged()
    print(f"page killed: {killed}\nsession killed: {lost}\nforged: {refused}")
    good = ratio <= 1.1 and killed["samples"] == killed["of"] and refused["sent"] == refused["refused"]
    return 0 if good and lost["drive_zero_s"] is not None and refused["unchanged"] else 1


if __name__ == "__main__":
    raise SystemExit(main())
