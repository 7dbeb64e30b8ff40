"""Equations written down as machine code say what they say on numbers, for any batch, in any thread."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.mpc.native.test_codegen import PAIRS, WORDS, X, Y
from thermogrip.sysid.models.jit_rollout import WIDTH, Kernel
from thermogrip.sysid.models.model import Sizes

SIZES = Sizes(2, 2, 1, 3)


def mixed(x: Any, u: Any, d: Any, p: Any, h: Any) -> list[Any]:
    """Every operation of plain arithmetic, with symbols and numbers on either side."""
    gain, flow = p[0] * p[1] + u[1] * h, 0.5
    a = x[0] + h * (gain * (u[0] - x[0]) - 0.5 * x[1] / (2.0 + abs(x[0])) + 0.0 * d[0])
    b = -x[1] * 0.25 + 1.0 * d[0] * flow - (3.0 - x[0]) / 4 + 1.0 / (1.0 + x[0] * x[0])
    return [a / 1.0, b + 0.0]


def read(x: Any, p: Any) -> list[Any]:
    return [x[1], x[0] * p[2], 7.0 + 0.0 * x[0]]


def plain(x: Any, u: Any, d: Any, p: Any, h: float) -> tuple[Any, Any]:
    """The same for one member, on Python's own numbers."""
    y = [read(x, p)]
    for t in range(len(u)):
        x = mixed(x, u[t], d[t], p, h)
        y.append(read(x, p))
    return np.array(y), np.array(x)


def batch(rng: np.random.Generator, members: int, n: int, shared: str) -> list[Any]:
    """Arrays of a batch; the letters in ``shared`` have one row for all members."""
    one = {k: 1 if k in shared else members for k in "udp"}
    u = rng.uniform(-1, 1, (one["u"], n, 2))
    u[..., 1] = np.cumsum(rng.random(n) < 0.3)  # a switch that seldom moves
    d, p = rng.uniform(-1, 1, (one["d"], n, 1)), rng.uniform(0.5, 1.5, (one["p"], 3))
    return [rng.uniform(-2, 2, (members, 2)), u, d, p]


KERNEL = Kernel(mixed, read, SIZES, switches=[1])


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    members=st.integers(1, 2 * WIDTH + 1),
    n=st.integers(0, 12),
    shared=st.sampled_from(["", "u", "d", "p", "udp"]),
)
def test_compiled_equations_are_the_equations(seed: int, members: int, n: int, shared: str):
    rng = np.random.default_rng(seed)
    arrays = batch(rng, members, n, shared)
    y, end = KERNEL.rollout(*arrays, 0.25)
    assert (y.shape, end.shape) == ((members, n + 1, 3), (members, 2))
    for b in range(members):
        mine = [a[b % len(a)] for a in arrays]
        want, last = plain(*mine, 0.25)
        np.testing.assert_allclose(y[b], want, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(end[b], last, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("members", [1, WIDTH - 1, WIDTH, WIDTH + 1, 3 * WIDTH])
def test_a_member_does_not_depend_on_its_neighbours(members: int):
    arrays = batch(np.random.default_rng(7), members, 3000, "")  # long enough for threads
    y, end = KERNEL.rollout(*arrays, 0.1)
    for b in range(members):
        alone, last = KERNEL.rollout(*[a[b : b + 1] for a in arrays], 0.1)
        np.testing.assert_array_equal(alone[0], y[b], strict=True)
        np.testing.assert_array_equal(last[0], end[b], strict=True)


def test_rollouts_from_several_threads_do_not_disturb_each_other():
    arrays = batch(np.random.default_rng(8), 3 * WIDTH, 2500, "u")
    want = KERNEL.rollout(*arrays, 0.1)[0]
    with ThreadPoolExecutor(6) as pool:
        for got in pool.map(lambda _: KERNEL.rollout(*arrays, 0.1)[0], range(24)):
            np.testing.assert_array_equal(got, want)


def test_what_is_handed_over_is_left_alone_and_may_lie_anywhere_in_memory():
    rng = np.random.default_rng(9)
    arrays = batch(rng, 5, 30, "")
    odd = [np.asfortranarray(np.repeat(a, 2, axis=0))[::2] for a in arrays]
    before = [a.copy() for a in odd]
    np.testing.assert_array_equal(KERNEL.rollout(*odd, 0.1)[0], KERNEL.rollout(*arrays, 0.1)[0])
    for a, b in zip(odd, before):
        np.testing.assert_array_equal(a, b)


FORMULAS: dict[str, Any] = {
    "powers": lambda a, b: (
        a**2, a**3 + b**7, (a * a) ** 0.5, (a * a + 1.0) ** 1.3, (a * a) ** b, 2.0**a, b**1, np.power(b, 2)),
    "roots": lambda a, b: (
        np.sqrt(a * a), np.square(b), np.cbrt(a), np.hypot(a, b), np.abs(b), np.negative(a)),
    "growth": lambda a, b: (
        np.exp(a), np.expm1(b), np.log(a * a + 1), np.log1p(b * b), np.log10(2 + a * b / 5)),
    "angles": lambda a, b: (np.sin(a), np.cos(b), np.tan(a / 2), np.arctan(b), np.arctan2(a, b)),
    "bends": lambda a, b: (np.tanh(a), np.sinh(b), np.cosh(a), np.sign(b), np.sign(0.0 * a + b)),
    "ends": lambda a, b: (
        np.maximum(a, b), np.maximum(0.3, b), np.minimum(a, 0.2), np.minimum(a, b), np.clip(a, b, b)),
    "choices": lambda a, b: (
        np.where(a > b, a, 0.5), np.where(np.logical_and(a < 0.4, np.logical_not(b >= 0.1)), 1.0, b),
        np.where(np.logical_or(np.less(a, 0), np.greater(b, 0)), a, b), (a > 0) * b + a * (b < 0.0)),
    "tables": lambda a, b: (
        np.interp(a, [-1.0, 0.0, 1.5], [3.0, 2.0, 7.0]), np.interp(b, (0.0, 1.0), (0.0, 1.0))),
    "NumPy's numbers": lambda a, b: (
        np.float64(2.0) * a, np.float64(1.0) - b, np.float64(3.0) / (2 + a * a), 0.0 + (a < b)),
}  # fmt: skip


@pytest.mark.parametrize("name", FORMULAS)
def test_functions_of_numpy_are_compiled_as_numpy_means_them(name: str):
    x0 = np.random.default_rng(5).uniform(-2.0, 2.0, (40, 2))
    want = np.array(FORMULAS[name](*x0.T)).astype(float)
    y = applied(lambda x, _: FORMULAS[name](*x), x0)
    np.testing.assert_allclose(y.T, want, rtol=1e-14, atol=1e-15)


def applied(formula: Any, x0: Any) -> Any:
    """What a compiled formula, with symbols that NumPy's functions take, makes of states."""

    def output(x: Any, p: Any) -> list[Any]:
        return [ca.vertcat(value) for value in formula([ca.ArrayInterface(item, ndim=0) for item in x], p)]

    kernel = Kernel(lambda x, *_: x, output, Sizes(2, 0, 0, 0))
    return kernel.rollout(x0, np.zeros((1, 0, 0)), np.zeros((1, 0, 0)), np.ones((1, 0)), 1.0)[0][:, 0]


def test_every_operation_of_casadi_is_compiled_as_casadi_means_it():
    used = {ca.Function("f", [X, Y], [word]) for word in WORDS.values()}
    kernel = Kernel(lambda x, *_: x, lambda x, p: [f(*x) for f in used], Sizes(2, 0, 0, 0))
    y, _ = kernel.rollout(np.array(PAIRS), np.zeros((1, 0, 0)), np.zeros((1, 0, 0)), np.ones((1, 0)), 1.0)
    want = [[float(f(*pair)) for f in used] for pair in PAIRS]
    np.testing.assert_allclose(y[:, 0], want, rtol=1e-14)


def test_what_is_not_a_number_stays_so_in_a_maximum():
    x0 = np.array([[np.nan, 1.0], [1.0, np.nan], [2.0, 1.0]])
    y = applied(lambda x, p: [np.maximum(x[0], x[1]), np.minimum(x[0], 0.0)], x0)
    np.testing.assert_array_equal(y, [[np.nan, np.nan], [np.nan, 0.0], [2.0, 0.0]])


def test_pieces_are_steps_in_a_row_under_one_row_of_inputs():
    arrays, pieces = batch(np.random.default_rng(4), 3, 10, ""), 4
    fine = [a if k in (0, 3) else np.repeat(a, pieces, axis=1) for k, a in enumerate(arrays)]
    y, end = KERNEL.rollout(*arrays, 0.05, pieces)
    y_fine, end_fine = KERNEL.rollout(*fine, 0.05)
    np.testing.assert_array_equal(y, y_fine[:, ::pieces])
    np.testing.assert_array_equal(end, end_fine)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork there")
def test_a_forked_process_has_threads_of_its_own():
    """The parent's threads are not there in the child, so a pool that it inherits would wait for ever."""
    code = """
import os, signal, numpy as np
from thermogrip.sysid.models import jit_rollout as kernel
from thermogrip.sysid.models.network import load_network
kernel._cores = lambda: 2
model = load_network("tclab")
def run():
    q = np.ones((1, 2000, 2))
    x0, d = np.full((20, 4), 20.0), np.zeros((1, 2000, len(model.disturbances)))
    return model.rollout(x0, q, d, model.prior[None], 1.0)[1]
want, child = run(), os.fork()
if child == 0:
    signal.alarm(20)
    os._exit(0 if np.array_equal(run(), want) else 3)
print(os.waitpid(child, 0)[1])
"""
    words = [sys.executable, "-W", "ignore", "-c", code]
    done = subprocess.run(words, capture_output=True, text=True, timeout=600, check=False)
    assert done.stdout.split() == ["0"], done.stderr


@pytest.mark.parametrize("which", range(4))
def test_arrays_that_do_not_belong_together_are_refused(which: int):
    arrays = batch(np.random.default_rng(3), 4, 6, "")
    for wrong in (arrays[which][:3], arrays[which][..., :-1]):
        with pytest.raises(ValueError, match="do not belong together"):
            KERNEL.rollout(*arrays[:which], wrong, *arrays[which + 1 :], 0.1)
