"""Step times of acados' own solver, HPIPM, on the rods of sizes.py.

    LD_LIBRARY_PATH=INSTALLED/lib PYTHONPATH=HPIPM/interfaces/python/hpipm_python \
        OMP_NUM_THREADS=1 python benchmarks/mpc/hpipm.py

acados is in no package registry. Its C library, BLASFEO and HPIPM build from source (``cmake
-DACADOS_WITH_QPOASES=OFF -DACADOS_INSTALL_DIR=INSTALLED ..``, ``make install``); its Python package needs
``t_renderer`` besides, a program in Rust. What is timed here is the solver that acados calls in each sample:
HPIPM through its own Python package, in optimal control form (no condensing), a block a sample, with weights,
range and slew of the other programs and no soft band, cold, to 1e-6. The state is known; wall ms around one
call of the C.
"""

from __future__ import annotations

import os
import time

os.environ["ENV_RUN"] = "true"  # what HPIPM's shell script sets

import numpy as np
from hpipm_python import (
    hpipm_ocp_qp,
    hpipm_ocp_qp_dim,
    hpipm_ocp_qp_sol,
    hpipm_ocp_qp_solver,
    hpipm_ocp_qp_solver_arg,
)
from sizes import rod

SLEW, TERMINAL, SAMPLES = 0.125, 10.0, 150


def seconds(n: int, N: int, mode: str) -> list[float]:
    """Return the seconds of each solve of a closed loop on a rod that loses a tenth more."""
    model, truth = rod(n).model, rod(n, 0.0044).model
    nx, shown = n + 1, np.append(model.C[0], 0.0)  # the last state is the drive that is applied
    A, B = np.zeros((nx, nx)), np.vstack([model.B, [[1.0]]])
    A[:n, :n] = model.A
    before = np.eye(nx)[-1]
    track, cross = np.outer(shown, shown), -before[None]
    sizes = hpipm_ocp_qp_dim(N)
    for key, value, last in (
        ("nx", nx, N),
        ("nu", 1, N - 1),
        ("nbu", 1, N - 1),
        ("nbx", nx, 0),
        ("ng", 1, N - 1),
    ):
        sizes.set(key, value, 0, last)
    qp, one = hpipm_ocp_qp(sizes), np.ones((1, 1))
    stages = {
        "A": A, "B": B, "Q": track + np.outer(before, before), "S": cross, "R": one, "Jbu": one,
        "lbu": 0 * one, "ubu": one, "C": cross, "D": one, "lg": -SLEW * one, "ug": SLEW * one,
    }  # fmt: skip
    for key, values in stages.items():
        qp.set(key, values, 0, N - 1)
    qp.set("Q", (1 + TERMINAL) * track, N)
    qp.set("Jbx", np.eye(nx), 0)
    answer, settings = hpipm_ocp_qp_sol(sizes), hpipm_ocp_qp_solver_arg(sizes, mode)
    settings.set("mu0", 10.0)
    settings.set("iter_max", 50)
    for key in ("tol_stat", "tol_eq", "tol_ineq", "tol_comp"):
        settings.set(key, 1e-6)
    solver = hpipm_ocp_qp_solver(sizes, settings)
    state, found = np.zeros(nx), []
    for k in range(SAMPLES):
        pull = -(7.0 if k < SAMPLES // 2 else 3.0) * shown[:, None]
        qp.set("q", pull, 0, N - 1)
        qp.set("q", (1 + TERMINAL) * pull, N)
        qp.set("lbx", state[:, None], 0)
        qp.set("ubx", state[:, None], 0)
        began = time.perf_counter()
        solver.solve(qp, answer)
        found.append(time.perf_counter() - began)
        if solver.get("status") != 0:
            raise SystemExit(f"{n} states, N = {N}: no answer at sample {k}")
        drive = float(np.clip(np.ravel(answer.get("u", 0))[0], 0.0, 1.0))
        state = np.append(truth.A @ state[:n] + truth.B[:, 0] * drive, drive)
    return found[5:]


def main() -> None:
    """Print median and worst of each size."""
    print("| states | N | HPIPM, median and worst [ms] | mode balance |\n|---|---|---|---|")
    for n in (4, 16, 28, 60):
        for N in (25, 50, 100, 200):
            fast, sturdy = (1e3 * np.array(seconds(n, N, mode)) for mode in ("speed", "balance"))
            times = [f"{np.median(each):.3f}, {np.max(each):.3f}" for each in (fast, sturdy)]
            print(f"| {n} | {N} | {times[0]} | {times[1]} |", flush=True)


if __name__ == "__main__":
    main()
