"""How long an answer of ``classify --serve`` takes, beside the same call in this process.

    python benchmarks/classify/serve.py MODEL_DIR [--grasps 10000] [--in-process 500] [--workers N]
        [--same-gripper]

The example condition ``exp1A_obj43_grip23``, each trace with new white noise of 0.02 K. First one client,
with a tenth of the requests (at most 500), then four at once: with one thread that answers each waits for
three others, with four processes (``--workers 4``) for none. Every request has a number, which its answer
must bring back. A request is timed from its first byte to the last of its answer, over a connection that
stays open. With ``--same-gripper``, as for a robot whose gripper is the training's, no answer asks whether
another one took the grasp. Progress goes to stderr; memory is that of the server and of all its processes.
"""

from __future__ import annotations

import argparse
import http.client
import json
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from thermogrip.classify.decisions.serve import HOST, grasp_of
from thermogrip.cli.classify import _Question
from thermogrip.datasets.examples import load_example_grasps


def requests(n: int) -> list[bytes]:
    """Return n requests of different traces."""
    grasps, rng = load_example_grasps()["exp1A_obj43_grip23"], np.random.default_rng(0)
    time_s, skin, t_object = (grasps[name].values for name in ("time", "t_surface", "t_object"))
    found = []
    for k in range(n):
        trace = skin[k % len(skin)] + rng.normal(0, 0.02, skin.shape[1])
        about = {"id": k, "t_object_nominal_degC": float(t_object[k % len(skin)])}
        traces = {"time_s": time_s.tolist(), "t_surface_degC": trace.round(4).tolist()}
        found.append(json.dumps(traces | about).encode())
    return found


def timed(port: int, bodies: list[bytes], tell: bool = False) -> list[float]:
    """Return the seconds of each answer [s]; an answer to another request, or none, is an error."""
    line, seconds = http.client.HTTPConnection(HOST, port), []
    for body in bodies:
        begin = time.perf_counter()
        line.request("POST", "/", body)
        response = line.getresponse()
        found = json.loads(response.read())
        seconds.append(time.perf_counter() - begin)
        if tell and len(seconds) % 250 == 0:
            print(f"  {len(seconds)} of {len(bodies)} of the first client", file=sys.stderr, flush=True)
        if response.status != 200 or found["id"] != json.loads(body)["id"]:
            raise SystemExit(f"lost: {found}")
    return seconds


def line_of(name: str, seconds: list[float]) -> str:
    """Return a row of the table."""
    p50, p99 = 1e3 * np.quantile(seconds, [0.5, 0.99])
    return f"{name:12s} {len(seconds):7d} {p50:8.1f} {p99:8.1f}"


def peak_mb(pid: int) -> float:
    """Return the most memory that a process and those that it started have had [MB]."""
    text = Path(f"/proc/{pid}/status").read_text()
    started = [task.read_text().split() for task in Path(f"/proc/{pid}/task").glob("*/children")]
    own = int(text.partition("VmHWM:")[2].split()[0]) / 1024
    return own + sum(peak_mb(int(child)) for each in started for child in each)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("--grasps", type=int, default=10_000)
    parser.add_argument("--in-process", type=int, default=500)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--same-gripper", action="store_true")
    given = parser.parse_args()
    bodies = requests(given.grasps)
    print("             answers  p50 [ms]  p99 [ms]")
    answer, seconds = _Question(given.model, same_gripper=given.same_gripper).answerer(), []
    for body in [bodies[0], *bodies[: given.in_process]]:
        begin = time.perf_counter()
        answer(grasp_of(json.loads(body)))
        seconds.append(time.perf_counter() - begin)
    print(line_of("in process", seconds[1:]), flush=True)  # the first one loads compiled code
    words = [sys.executable, "-m", "thermogrip", "classify", str(given.model), "--serve", "--port", "0"]
    words += ["--workers", str(given.workers)] + ["--same-gripper"] * given.same_gripper
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        port = int(process.stderr.readline().strip().rstrip("/").rpartition(":")[2])
        try:
            with ThreadPoolExecutor(4 * given.workers) as pool:  # each process loads compiled code
                list(pool.map(lambda k: timed(port, bodies[k : k + 1]), range(4 * given.workers)))
            print(line_of("one client", timed(port, bodies[: min(given.grasps // 10, 500)])), flush=True)
            before = peak_mb(process.pid)
            begin = time.perf_counter()
            with ThreadPoolExecutor(4) as pool:
                found = list(pool.map(lambda k: timed(port, bodies[k::4], k == 0), range(4)))
            spent = time.perf_counter() - begin
            print(line_of("four clients", [s for each in found for s in each]))
            print(f"{given.grasps / spent:.0f} answers/s; none lost; peak memory of the server "
                  f"{before:.0f} MB before, {peak_mb(process.pid):.0f} MB after")  # fmt: skip
        finally:
            process.terminate()


if __name__ == "__main__":
    main()
