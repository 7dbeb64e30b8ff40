"""The least that a drive can move to settle in a given time, on the `delay` truth of ten_plants.py.

    python benchmarks/control/least_moves.py [--most 360]

A heater behind 60 s of dead time and lags of 120 and 12 s, exactly known, without noise, from rest to the two
targets of the case one after the other, none told ahead: a linear program for each target and settling time,

    minimise sum_k |u_k - u_{k-1}|,    |y_k - r| <= band from the settling time on,    overshoot <= allowed,

in samples of 5 s, with a drive that ends where the target is held. No controller moves less, whatever it
knows: what comes after the second target, a load and noise, is beside. Moves are in whole ranges.
"""

from __future__ import annotations

import argparse
from functools import cache

import numpy as np
from scipy.linalg import expm
from scipy.optimize import linprog
from truths import CASES

DT, DELAY, GAIN, LAGS = 5.0, 60.0, 0.6, (120.0, 12.0)
OVERSHOOT = 0.3  # degC
CASE = next(case for case in CASES if case.name == "delay")


@cache
def step_response(n: int) -> np.ndarray:
    """Return the outlet (n + 1,) in samples after a drive went up by 1, the dead time left out."""
    slow, fast = LAGS
    generator = np.array([[-1 / slow, 0, GAIN / slow], [1 / fast, -1 / fast, 0], [0, 0, 0]])
    step, state, shown = expm(generator * DT), np.array([0.0, 0.0, 1.0]), []
    for _ in range(n + 1):
        shown.append(state[1])
        state = step @ state
    return np.array(shown)


def least_moves(at: float, way: float, settle_s: float, n: int = 180) -> float:
    """Return the least moves [percent] from drive ``at`` to a target ``way`` off; inf where none does it."""
    impulse = np.diff(step_response(n))
    answer = np.array([[impulse[k - 1 - j] if j < k else 0.0 for j in range(n)] for k in range(n + 1)])
    settled = np.arange(n + 1) >= round((settle_s - DELAY) / DT)
    sign, none = np.sign(way), np.zeros((n, n))
    inside = np.hstack([answer[settled], np.zeros((int(settled.sum()), n))])
    before = np.hstack([sign * answer[~settled], np.zeros((int((~settled).sum()), n))])
    difference = np.eye(n) - np.eye(n, k=-1)
    rows = [
        inside,
        -inside,
        before,
        np.hstack([difference, -np.eye(n)]),
        np.hstack([-difference, -np.eye(n)]),
    ]
    ends = [way + CASE.band, CASE.band - way, abs(way) + OVERSHOOT, 0.0, 0.0]
    found = linprog(
        np.concatenate([np.zeros(n), np.ones(n)]),
        A_ub=np.vstack(rows),
        b_ub=np.concatenate([np.full(len(part), end) for part, end in zip(rows, ends, strict=True)]),
        A_eq=np.concatenate([np.eye(n)[-1], none[0]])[None],
        b_eq=[way / GAIN],
        bounds=[(-at, 100.0 - at)] * n + [(0, None)] * n,
    )
    return float(found.fun) if found.status == 0 else np.inf


def main() -> None:
    """Print the least moves by the settling time of both targets in all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--most", type=float, default=360.0, help="longest settling time of both [s]")
    given = parser.parse_args()
    start = 20.0 + GAIN * CASE.rest[0]
    times = np.arange(85.0, 0.5 * given.most + 40.0, DT)
    first = [least_moves(CASE.rest[0], CASE.targets[0] - start, s) for s in times]
    held = CASE.rest[0] + (CASE.targets[0] - start) / GAIN
    second = [least_moves(held, CASE.targets[1] - CASE.targets[0], s) for s in times]
    print("| settling of both [s] | of each [s] | least moves [ranges] |\n|---|---|---|")
    for both in np.arange(200.0, given.most + 1, 10.0):
        pairs = [
            (first[i] + second[j], i, j)
            for i, a in enumerate(times)
            for j, b in enumerate(times)
            if a + b == both
        ]
        moves, i, j = min(pairs)
        if np.isfinite(moves):
            print(f"| {both:.0f} | {times[i]:.0f}, {times[j]:.0f} | {moves / 100:.2f} |")


if __name__ == "__main__":
    main()
