"""Equations written down as machine code say what they say on numbers, for any batch, in any thread."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thermogrip.sysid.models.jit_rollout import WIDTH, Kernel


@dataclass
class Written:
    """x+ = formula(x, u, d, p), with a gain that is made anew where a switch moves."""

    formula: Any
    sizes: tuple[int, int, int, int] = (2, 2, 1, 3)

    def prepare(self, p: Sequence[Any]) -> list[Any]:
        return [*p, 1.0, p[0] * p[1]]

    def renew(self, u: Sequence[Any], c: Sequence[Any], h: Any) -> list[Any]:
        return [c[4] + u[1] * h, 0.5]

    def advance(
        self, x: Sequence[Any], u: Sequence[Any], d: Sequence[Any], c: Sequence[Any], kept: Any, h: Any
    ) -> list[Any]:
        return list(self.formula(x, u, d, c, kept, h))

    def read(self, x: Sequence[Any], c: Sequence[Any]) -> list[Any]:
        return [x[1], x[0] * c[2], 7.0]

    def plain(self, x: Any, u: Any, d: Any, p: Any, h: float, renew: Any) -> tuple[Any, Any]:
        """The same for one member, on Python's own numbers."""
        c, kept = self.prepare(p), []
        y = [self.read(x, c)]
        for t in range(len(u)):
            kept = self.renew(u[t], c, h) if renew[t] else kept
            x = self.advance(x, u[t], d[t], c, kept, h)
            y.append(self.read(x, c))
        return np.array(y), np.array(x)


def mixed(x: Any, u: Any, d: Any, c: Any, kept: Any, h: Any) -> list[Any]:
    """Every operation that vectors know, with vectors and numbers on either side."""
    a = x[0] + h * (kept[0] * (u[0] - x[0]) - 0.5 * x[1] / (2.0 + abs(x[0])) + 0.0 * d[0])
    b = -x[1] * 0.25 + 1.0 * d[0] * kept[1] - (3.0 - x[0]) / 4 + 1.0 / (1.0 + x[0] * x[0]) * c[3]
    return [a / 1.0, b + 0.0]


def batch(rng: np.random.Generator, members: int, n: int, shared: str) -> list[Any]:
    """Arrays of a batch; the letters in ``shared`` have one row for all members."""
    one = {k: 1 if k in shared else members for k in "udp"}
    u = rng.uniform(-1, 1, (one["u"], n, 2))
    d, p = rng.uniform(-1, 1, (one["d"], n, 1)), rng.uniform(0.5, 1.5, (one["p"], 3))
    return [rng.uniform(-2, 2, (members, 2)), u, d, p]


KERNEL = Kernel(Written(mixed))


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    members=st.integers(1, 2 * WIDTH + 1),
    n=st.integers(0, 12),
    shared=st.sampled_from(["", "u", "d", "p", "udp"]),
)
def test_compiled_equations_are_the_equations(seed: int, members: int, n: int, shared: str):
    rng = np.random.default_rng(seed)
    arrays, renew = batch(rng, members, n, shared), rng.random(n) < 0.3
    renew[:1] = True
    y, end = KERNEL.rollout(*arrays, 0.25, renew)
    assert (y.shape, end.shape) == ((members, n + 1, 3), (members, 2))
    for b in range(members):
        mine = [a[b % len(a)] for a in arrays]
        want, last = KERNEL.equations.plain(*mine, 0.25, renew)
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
        a**2, a**3 + b**7, (a * a) ** 0.5, (a * a + 1.0) ** 1.3, (a * a) ** b, 2.0**a, b**1),
    "roots": lambda a, b: (
        np.sqrt(a * a), np.square(b), np.cbrt(a), np.hypot(a, b), np.abs(b), np.negative(a)),
    "growth": lambda a, b: (
        np.exp(a), np.expm1(b), np.log(a * a + 1), np.log1p(b * b), np.log10(2 + a * b / 5)),
    "angles": lambda a, b: (np.sin(a), np.cos(b), np.tan(a / 2), np.arctan(b), np.arctan2(a, b)),
    "bends": lambda a, b: (np.tanh(a), np.sinh(b), np.cosh(a), np.sign(b), np.sign(0.0 * a + b)),
    "ends": lambda a, b: (
        np.maximum(a, b), np.maximum(0.3, b), np.minimum(a, 0.2), np.minimum(a, b), np.clip(a, b, b)),
    "choices": lambda a, b: (
        np.where(a > b, a, 0.5), np.where((a < 0.4) & ~(b >= 0.1) | (a <= b), 1.0, b),
        np.where(np.logical_or(np.less(a, 0), np.greater(b, 0)), a, b), (a > 0) * b + a * (b < 0.0)),
    "tables": lambda a, b: (
        np.interp(a, [-1.0, 0.0, 1.5], [3.0, 2.0, 7.0]), np.interp(b, (0.0, 1.0), (0.0, 1.0))),
    "NumPy's numbers": lambda a, b: (
        np.float64(2.0) * a, np.float64(1.0) - b, np.float64(3.0) / (2 + a * a), a < b),
}  # fmt: skip


@pytest.mark.parametrize("name", FORMULAS)
def test_functions_of_numpy_are_compiled_as_numpy_means_them(name: str):
    def formula(x: Any, *_: Any) -> list[Any]:
        values = FORMULAS[name](x[0], x[1])
        return [
            np.where(values[k], 1.0, 0.0) if name.startswith("NumPy") and k == 3 else values[k] for k in at
        ]

    x0 = np.random.default_rng(5).uniform(-2.0, 2.0, (40, 2))
    count = len(FORMULAS[name](*x0.T))
    for at in ([k, (k + 1) % count] for k in range(count)):
        kernel = Kernel(Written(formula))
        _, end = kernel.rollout(x0, np.zeros((1, 1, 2)), np.zeros((1, 1, 1)), np.ones((1, 3)), 1.0)
        want = np.array([FORMULAS[name](*x0.T)[k] for k in at]).astype(float)
        np.testing.assert_allclose(end.T, want, rtol=1e-14, atol=1e-15)


def test_what_is_not_a_number_stays_so_in_a_maximum():
    kernel = Kernel(Written(lambda x, *_: [np.maximum(x[0], x[1]), np.minimum(x[0], 0.0)]))
    x0 = np.array([[np.nan, 1.0], [1.0, np.nan], [2.0, 1.0]])
    _, end = kernel.rollout(x0, np.zeros((1, 1, 2)), np.zeros((1, 1, 1)), np.ones((1, 3)), 1.0)
    np.testing.assert_array_equal(end, [[np.nan, np.nan], [np.nan, 0.0], [2.0, 0.0]])


@pytest.mark.parametrize(
    "formula",
    [
        lambda x, *_: [np.sort(x[0]), x[1]],
        lambda x, *_: [np.add.reduce(x[0]), x[1]],
        lambda x, *_: [x[0] and x[1], x[1]],
        lambda x, *_: [1.0 if x[0] > 0 else 2.0, x[1]],
        lambda x, *_: [np.floor(x[0]), x[1]],
    ],
)
def test_what_cannot_be_compiled_is_refused_with_its_reason(formula: Any):
    with pytest.raises(TypeError, match="known"):
        Kernel(Written(formula))


@pytest.mark.parametrize(("pieces", "renew"), [(4, None), (3, [1, 0, 0, 1, 0, 0, 0, 0, 1, 0])])
def test_pieces_are_steps_in_a_row_counted_anew_in_each_row(pieces: int, renew: list[int] | None):
    arrays = batch(np.random.default_rng(4), 3, 10, "")
    fine = [a if k in (0, 3) else np.repeat(a, pieces, axis=1) for k, a in enumerate(arrays)]
    moved, fine_moved = (
        None if renew is None else np.kron(renew, [1] + [0] * (n - 1)).astype(bool) for n in (1, pieces)
    )
    kernel = Kernel(Written(mixed), in_pieces=True)
    y, end = kernel.rollout(*arrays, 0.05, moved, pieces)
    y_fine, end_fine = KERNEL.rollout(*fine, 0.05, fine_moved)
    np.testing.assert_array_equal(y, y_fine[:, ::pieces])
    np.testing.assert_array_equal(end, end_fine)
    for made, wrong in ((KERNEL, 4), (kernel, 0)):
        with pytest.raises(ValueError, match=f"not made for {wrong}"):
            made.rollout(*arrays, 0.05, None, wrong)


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
