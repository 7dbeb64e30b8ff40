"""The parts of the neural fit, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from thermogrip.sysid.blackbox import neural
from thermogrip.sysid.blackbox.neural import _Data, _Linear, saturation_levels
from thermogrip.sysid.models.neural_kernel import run_states
from thermogrip.sysid.plant.log_grid import Grid, Segment


def grid_of(*readings, u=None):
    """A grid of outputs s and t, inputs q and p, and a disturbance."""
    parts = []
    for at, y in enumerate(readings):
        w = np.zeros((len(y), 3)) if u is None else np.asarray(u[at], dtype=float)
        parts.append(Segment(np.arange(float(len(y))), np.asarray(y, float), w[:, :2], w[:, 2:], "a"))
    return Grid(("q", "p"), ("room",), ("s", "t"), (), 1.0, tuple(parts), 1.0, {})


@pytest.mark.parametrize(
    ("rows", "scatter", "stands"), [(8, 0, True), (7, 0, False), (8, 9e-10, True), (8, 2e-9, False)]
)
def test_eight_rows_at_an_end_are_a_rail(rows, scatter, stands):
    wave = np.array([1.0, 3.0, 2.0, np.nan, 4.0])
    top = np.full(rows, 5.0)
    top[::2] -= 5 * scatter
    high = np.column_stack([np.concatenate([wave, top]), np.arange(5.0 + rows)])
    low = np.column_stack([5 - high[:, 0], -high[:, 1]])
    part = np.column_stack([wave, 3 * wave])  # a segment that is not at its end
    assert [side.tolist() for side in saturation_levels(grid_of(part, high))] == [
        [-np.inf] * 2,
        [5.0 if stands else np.inf, np.inf],
    ]
    if not scatter:
        assert saturation_levels(grid_of(low - 1, part))[0].tolist() == [-1.0 if stands else -np.inf, -np.inf]


@pytest.mark.parametrize(
    ("readings", "how", "only", "seeds"),
    [
        (2500, {}, None, {(3, 3): 6, (3, 8): 6, (4, 3): 6, (4, 8): 6}),
        (2502, {}, None, {(3, 3): 3, (3, 8): 3, (4, 3): 3, (4, 8): 3}),
        (2500, {"members": 2}, None, {(3, 3): 2, (3, 8): 2, (4, 3): 2, (4, 8): 2}),
        (2500, {}, "4 states, 8 units", {(4, 8): 16}),
        (2502, {}, "4 states, 8 units", {(4, 8): 8}),
        (2502, {}, "members of all sizes", {(3, 3): 12, (3, 8): 12, (4, 3): 12, (4, 8): 12}),
        (2500, {"states": (5,), "units": (2,)}, None, {(5, 2): 6}),
        (2500, {"states": (3, 9), "units": (2,)}, None, {(3, 2): 6}),  # no stable start of nine states
    ],
)
def test_how_many_members_are_trained(monkeypatch, readings, how, only, seeds):
    y = np.column_stack([np.arange(1300.0), np.arange(1300.0)])
    y[readings // 2 :] = np.nan
    made = []
    monkeypatch.setattr(neural, "_linear_starts", lambda grid, data, orders: {n: n for n in orders if n < 9})
    monkeypatch.setattr(neural, "_train", lambda data, n, h, *, seed: made.append((n, h, seed)) or (n, h))
    monkeypatch.setattr(neural, "_averaged", lambda grid, data, parts: list(parts))
    named = {neural.structure_of(grid_of(y), *size).label: size for size in seeds}
    structures = [neural.structure_of(grid_of(y), n, h) for n in (3, 4) for h in (3, 8)]
    together = neural._together(structures)
    chosen = {some.label: some for some in [*structures, together]}.get(only)
    found = {s.label: parts for s, parts in neural.neural_family(grid_of(y), **how, only=chosen).items()}
    assert made == [(*size, k) for size, count in seeds.items() for k in range(count)]
    every = [size for size, count in seeds.items() for _ in range(count)]
    want = {label: [size] * seeds[size] for label, size in named.items()} if only != together.label else {}
    assert found == want | ({together.label: every} if len(seeds) > 1 else {})


def data_of(w, y=()):
    one, none = np.ones(1), -np.full(1, np.inf)
    return _Data(
        list(y), [np.asarray(some, float) for some in w], 0 * one, one, 0 * one, one, one, none, -none
    )


def test_a_linear_record_keeps_its_linear_fit_and_random_weights_are_drawn_to_zero():
    w = np.random.default_rng(1).standard_normal((60, 1))
    x = [0.7]
    for drive in w[:-1, 0]:
        x.append(0.5 * x[-1] + 0.4 * drive + 0.1)
    y = np.array(x)[:, None]
    y[7] = np.nan
    linear = _Linear(np.array([[0.5]]), np.array([[0.4]]), np.array([0.1]), 2 * [np.array([0.7])])
    data = data_of([w, w], [y, y])
    found = neural._train(data, linear, 2, seed=0)
    np.testing.assert_allclose(found.weights, [0.4, 0.1, *[0.0] * 8], atol=1e-5)
    assert (found.x0[0, 0], found.h) == (pytest.approx(0.7, abs=1e-5), 2)
    assert found.miss < 1e-8
    off = neural._train(data, _Linear(linear.A, linear.B, linear.c + 0.2, linear.x0), 2, seed=0)
    assert off.weights[1] == pytest.approx(0.1, abs=0.02)  # drawn back by the readings
    run = run_states(np.array(2 * [[[0.5]]]), np.tile(off.weights, (2, 1)), 2, off.x0, w, data.low, data.high)
    assert off.miss == pytest.approx(np.nansum((run[:, :-1] - y) ** 2))
