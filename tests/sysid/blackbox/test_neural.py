"""The parts of the neural fit, by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from thermogrip.datasets.schema import make_log
from thermogrip.sysid.blackbox import neural
from thermogrip.sysid.blackbox.neural import _Data, _Linear, _Member, saturation_levels
from thermogrip.sysid.blackbox.order_selection import Run, Structure, free_run_errors, priors_of
from thermogrip.sysid.models.neural import NeuralModel
from thermogrip.sysid.plant.log_grid import Grid, Segment, make_grid


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
    broken = np.insert(high, 9, part[0], axis=0)  # four rows at the end, and the others after it left it
    assert saturation_levels(grid_of(part, broken))[1].tolist() == [np.inf] * 2
    if not scatter:
        assert saturation_levels(grid_of(low - 1, part))[0].tolist() == [-1.0 if stands else -np.inf, -np.inf]


@pytest.mark.parametrize(
    ("readings", "how", "last", "sizes", "each"),
    [
        (2500, {}, False, [(3, 3), (3, 8), (4, 3), (4, 8)], 2),
        (2502, {}, False, [(3, 3), (3, 8), (4, 3), (4, 8)], 1),
        (2500, {"members": 5}, False, [(3, 3), (3, 8), (4, 3), (4, 8)], 5),
        (2500, {}, True, [(3, 3), (3, 8), (4, 3), (4, 8)], 6),
        (2502, {}, True, [(3, 3), (3, 8), (4, 3), (4, 8)], 3),
        (2500, {"states": (3, 9), "units": (2,)}, False, [(3, 2)], 2),  # no stable start of nine states
    ],
)
def test_how_many_members_are_trained(monkeypatch, readings, how, last, sizes, each):
    y = np.column_stack([np.arange(1300.0), np.arange(1300.0)])
    y[readings // 2 :] = np.nan
    made = []
    monkeypatch.setattr(neural, "_linear_starts", lambda grid, data, orders: {n: n for n in orders if n < 9})
    monkeypatch.setattr(
        neural, "_train_member", lambda data, n, h, *, seed: made.append((n, h, seed)) or (n, h)
    )
    monkeypatch.setattr(neural, "_averaged", lambda grid, data, parts: list(parts))
    # the smallest of three states and three units: A 9, B 9, c 3; V and W 18, U 9, b 3
    whole = Structure("members of all sizes", 51)
    found = neural.neural_family(grid_of(y), **how, only=[whole] if last else None)
    assert made == [(*size, k) for size in sizes for k in range(each)]
    assert list(found.values()) == [[size for size in sizes for _ in range(each)]]
    if "states" not in how:
        assert list(found) == [whole]
    assert not neural.neural_family(grid_of(y), only=[Structure("3 states, 8 units", 101)])


def data_of(w, y=()):
    one, none = np.ones(1), -np.full(1, np.inf)
    return _Data(
        list(y), [np.asarray(some, float) for some in w], 0 * one, one, 0 * one, one, one, none, -none
    )


def alike(c, B=None):
    """A model of one state and unit a member, which is c + B w after the first row."""
    c, none = np.asarray(c, float)[:, None], np.zeros((len(c), 1, 1))
    drive = none if B is None else np.asarray(B, float)[:, None, None]
    weights = {"A": none, "B": drive, "c": c, "V": none, "W": none, "U": none, "b": none[:, 0]}
    scales = {"y_middle": [0.0], "y_size": [1.0], "w_middle": [0.0], "w_size": [1.0], "reach": [10.0]}
    return NeuralModel(("q",), (), ("t",), 1.0, (), **weights, **scales, low=[-np.inf], high=[np.inf])


def driven(*drive):
    w = np.array(drive, float)[:, None]
    part = Segment(np.arange(float(len(w))), np.array([[2.0], [3.0], [4.0]][: len(w)]), w, w[:, :0], "a")
    return Grid(("q",), (), ("t",), (), 1.0, (part,), 1.0, {})


@pytest.mark.parametrize(
    ("values", "kept"),
    [((0, 9), [0, 1]), ((9, 0, 1), [0, 1, 2]), ((0, 9, 1, 2), [0, 2, 3]), ((4, 1, 2, 3, 0), [0, 1, 2, 3])],
)
def test_three_quarters_nearest_to_the_median_are_kept(values, kept):
    assert neural._nearest_to_median(alike(values), driven(0, 0, 0)).tolist() == kept


def test_the_inputs_run_in_reverse_order_and_the_quarter_that_fits_worst_is_left_out():
    grid, gains = driven(5.0, 0.0, 0.0), (0.0, 1.0, 0.1, 0.2)  # reversed, all but the run's end is alike
    assert neural._nearest_to_median(alike([0.0] * 4, gains), grid).tolist() == [0, 2, 3]
    members = [  # of five four fit; of four three agree
        _Member(
            {"A": np.zeros((1, 1)), **_numbered(np.array([0, value, 0, 0, 0, 0.0]), 1, 1, 1)},
            np.zeros((1, 1)),
            miss,
        )
        for value, miss in ((1.0, 0.5), (9.0, 0.1), (1.5, 0.9), (1.2, 0.2), (1.1, 0.3))
    ]
    assert neural._averaged(grid, neural._scaled_data(grid), members).c.ravel().tolist() == [1.0, 1.2, 1.1]


def _numbered(row, n, m, h):
    """A row of weights by name."""
    sizes = {"B": (n, m), "c": (n,), "V": (n, h), "W": (h, n), "U": (h, m), "b": (h,)}
    parts = np.split(row, np.cumsum([np.prod(size) for size in sizes.values()]))
    return {name: part.reshape(size) for (name, size), part in zip(sizes.items(), parts)}


def test_a_linear_record_keeps_its_linear_fit_and_random_weights_are_drawn_to_zero():
    w = np.random.default_rng(1).standard_normal((60, 1))
    x = [0.7]
    for drive in w[:-1, 0]:
        x.append(0.5 * x[-1] + 0.4 * drive + 0.1)
    y = np.array(x)[:, None]
    y[7] = np.nan
    linear = _Linear(np.array([[0.5]]), np.array([[0.4]]), np.array([0.1]), 2 * [np.array([0.7])])
    data = data_of([w, w], [y, y])
    found = neural._train_member(data, linear, 2, seed=0)
    weights = np.concatenate([found.arrays[name].ravel() for name in ("B", "c", "V", "W", "U", "b")])
    np.testing.assert_allclose(weights, [0.4, 0.1, *[0.0] * 8], atol=1e-5)
    assert found.x0[0, 0] == pytest.approx(0.7, abs=1e-5)
    assert found.miss < 1e-8
    off = neural._train_member(data, _Linear(linear.A, linear.B, linear.c + 0.2, linear.x0), 2, seed=0)
    assert off.arrays["c"] == pytest.approx(0.1, abs=0.02)  # drawn back by the readings


def test_linear_starts_run_as_the_best_subspace_model_in_scaled_units(coupled):
    grid = make_grid([coupled.log(n, seed=n, reading=0.05) for n in (300, 200)], average=1.0)
    data = neural._scaled_data(grid)
    starts = neural._linear_starts(grid, data, [2, 3])
    family = list(neural.subspace_family(grid, orders=(2, 3), terms=((),)).values())
    for n, linear in starts.items():
        runs = []
        for model in (some for some in family if some.n_x == n):
            x0 = [neural._head_start(model, s.y, s.u, s.d) for s in grid.segments]
            run = [
                model.rollout(x[None], s.u[None], s.d[None], (), 1.0)[0][0, :-1]
                for x, s in zip(x0, grid.segments)
            ]
            off = [(some - s.y) / data.y_size for some, s in zip(run, grid.segments)]
            runs.append((sum(np.sum(some**2) for some in off), run))
        best = min(runs, key=lambda pair: pair[0])[1]
        for x, w, run in zip(linear.x0, data.w, best):
            seen = []
            for row in w:
                seen.append(x[:2])
                x = linear.A @ x + linear.B @ row + linear.c
            np.testing.assert_allclose(seen, (run - data.y_middle) / data.y_size, atol=1e-6)
    assert list(starts) == [2, 3]


@pytest.mark.parametrize(("pole", "n"), [(0.98, 400), (1.0, 2400)], ids=["without noise", "an integrator"])
def test_a_plain_log_is_fitted(pole, n):
    q = np.repeat(np.random.default_rng(0).choice([-1.0, 1.0], n // 20), 20)
    noise = 0.0 if pole < 1 else 0.05 * np.random.default_rng(1).standard_normal(n)
    y = lfilter([0, 0.1], [1, -pole], q) + noise
    log = make_log(np.arange(float(n)), {"q": (q, "1", "input"), "t": (y, "degC", "output")})
    grid = make_grid([log], average=1.0)
    (model,) = neural.neural_family(grid, states=(2,), units=(3,), members=1).values()
    scale, runs = grid.output_spread(), [Run(segment) for segment in grid.segments]
    errors = free_run_errors(model, runs, dt=1.0, scale=scale, warmup=50, priors=priors_of(grid)) / scale
    assert errors.min() < 0.1


def test_outputs_that_are_sums_of_others_are_no_states_to_start_from(coupled):
    grid = make_grid([coupled.log(300, seed=1, reading=0.05)], average=1.0)
    part = grid.segments[0]
    three = np.column_stack([part.y, part.y @ [1.0, -1.0]])  # a PID log's error beside what it was taken of
    twice = replace(grid, outputs=(*grid.outputs, "error"), segments=(replace(part, y=three),))
    assert list(neural._linear_starts(grid, neural._scaled_data(grid), [2, 3, 4])) == [2, 3, 4]
    assert not neural._linear_starts(twice, neural._scaled_data(twice), [3, 4, 5])


def test_members_of_two_sizes_are_one_model_in_the_units_of_the_readings():
    u = [np.array([[0.0, 5.0, 20.0], [2.0, 7.0, 23.0], [4.0, 5.0, 20.0]])]
    grid = grid_of([[[1.0, 10.0], [3.0, 20.0], [2.0, 60.0]]][0], u=u)
    data, rng = neural._scaled_data(grid), np.random.default_rng(4)
    sizes = [(2, 3), (3, 1)]  # of n (3 + 1) + 2 n h + 3 h + h numbers
    members = [
        _Member(
            {"A": 0.3 * np.eye(n), **_numbered(rng.normal(size=n * 4 + 2 * n * h + 4 * h), n, 3, h)},
            rng.normal(size=(1, n)),
            0.1,
        )
        for n, h in sizes
    ]
    model = neural._averaged(grid, data, members)
    assert (model.A.shape, model.V.shape, model.U.shape) == ((2, 3, 3), (2, 3, 3), (2, 3, 3))
    x0, drive = np.concatenate([members[0].x0[0], [0.0], members[1].x0[0]]), u[0]
    (rows,) = model.states(x0[None], drive[None, :, :2], drive[None, :, 2:])
    spread = np.cov(rows.T)
    np.testing.assert_allclose(model.spread, spread + 1e-8 * np.trace(spread) * np.eye(6), rtol=1e-12)
    B, c, V, W, U, b = (members[0].arrays[name] for name in ("B", "c", "V", "W", "U", "b"))
    w = data.w[0][0]
    x = members[0].x0[0]
    z = np.tanh(W @ x + U @ w + b)
    np.testing.assert_allclose(rows[1][:2], 0.3 * x + B @ w + c + V @ z)
    assert (model.y_middle.tolist(), model.low.tolist()) == ([2.0, 30.0], [-np.inf] * 2)
