"""The neural black box: its derivatives, what it learns, that it stays bounded, what it refuses."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import make_log
from thermogrip.sysid.blackbox.fit import fit_black_box
from thermogrip.sysid.blackbox.neural import neural_family, saturation_levels
from thermogrip.sysid.models.neural import NeuralModel
from thermogrip.sysid.models.recurrences import run_states, run_with_slopes
from thermogrip.sysid.plant.log_grid import make_grid
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.validation.free_run import free_run


def tank_log(n=700, *, seed=0, lost=0.0, name="tank"):
    """Water that leaves by the root of its level and cannot rise above 10."""
    rng = np.random.default_rng(seed)
    q = np.repeat(rng.uniform(0.2, 1.3, n // 20), 20)
    level, x = np.empty(n), 4.0
    for k in range(n):
        level[k] = x
        x = min(x + 0.25 * q[k] - 0.07 * np.sqrt(max(x, 0.0)), 10.0)
    t = np.where(rng.random(n) < lost, np.nan, level + 0.01 * rng.standard_normal(n) * (level < 10))
    return make_log(np.arange(float(n)), {"q": (q, "V", "input"), "level": (t, "V", "output")}, name=name)


@pytest.fixture(scope="module")
def tank(fit_one) -> NeuralModel:
    return fit_one("neural", make_grid([tank_log()], average=1.0), states=2, units=4, members=4)


def simulated(model, log, *, average=1.0):
    segment = make_grid([log], average=average).segments[0]
    x0 = model.rest(segment.y[0], segment.u[0], segment.d[0], ())
    return model.rollout(x0[None], segment.u[None], segment.d[None], (), average)[0][0, :-1], segment


def test_slopes_are_finite_differences_of_the_run():
    rng = np.random.default_rng(3)
    n, m, h, rows = 3, 2, 4, 40
    A = 0.3 * rng.standard_normal((n, n))
    n_theta = n * m + n + 2 * n * h + h * m + h
    theta, x0, w = 0.5 * rng.standard_normal(n_theta), rng.standard_normal(n), rng.standard_normal((rows, m))
    low, high = np.array([-np.inf, -0.6]), np.array([0.9, np.inf])
    y, slopes = run_with_slopes(A, theta, h, x0, w, low, high)
    z = np.concatenate([theta, x0])
    moved = np.concatenate([z + 1e-6 * np.eye(len(z)), z - 1e-6 * np.eye(len(z))])
    runs = run_states(
        np.tile(A, (len(moved), 1, 1)), moved[:, :n_theta].copy(), h, moved[:, n_theta:].copy(), w, low, high
    )[:, :-1, :2]
    assert (y[1:, 0] == 0.9).any()  # the rail is met, and its slope is none
    np.testing.assert_allclose(np.moveaxis((runs[: len(z)] - runs[len(z) :]) / 2e-6, 0, 2), slopes, atol=1e-7)


def test_what_bends_the_plant_is_learnt_and_a_linear_model_misses_it(tank, fit_one):
    fresh = tank_log(seed=1)
    grid = make_grid([tank_log()], average=1.0)
    linear = fit_one("subspace", grid, orders=2, rows=15, variant="moesp")
    errors = []
    for model in (tank, linear):
        seen, segment = simulated(model, fresh)
        errors.append(float(np.sqrt(np.nanmean((seen - segment.y)[50:] ** 2))))
    assert errors[0] < 0.12
    assert errors[0] < 0.25 * errors[1]


def test_a_drive_beyond_what_the_log_moved_goes_on_moving_the_output(tank):
    rest = tank.rest([4.0], [0.56], [], ())
    y, _ = tank.rollout(rest[None], np.full((1, 4, 1), 2.0), np.zeros((1, 4, 0)), (), 1.0)
    assert y[0, -1, 0] == pytest.approx(
        4.0 + 4 * (0.25 * 2.0 - 0.07 * 2.0), abs=0.15
    )  # the log ends at 1.3 V


def test_an_output_that_stands_at_its_end_is_clipped_there_and_nowhere_else(tank):
    assert tank.high.tolist() == [10.0]
    assert tank.low.tolist() == [-np.inf]
    free = make_grid([tank_log(60)], average=1.0, min_rows=10)
    assert [side.tolist() for side in saturation_levels(free)] == [[-np.inf], [np.inf]]


@settings(max_examples=20, deadline=None, derandomize=True)
@given(st.integers(0, 10_000), st.floats(1.0, 1e6))
def test_no_input_however_wild_leaves_the_bound(seed, size):
    tank = _wild(seed)
    rng = np.random.default_rng(seed)
    u = size * rng.choice([-1.0, 1.0], (1, 300, 1))
    y, x_end = tank.rollout(np.zeros((1, tank.n_x)), u, np.zeros((1, 300, 0)), (), 1.0)
    assert np.isfinite(x_end).all()
    push = np.abs(tank.B) @ tank.reach + np.abs(tank.c) + np.abs(tank.V).sum(axis=2)
    most, power = np.zeros_like(push), np.broadcast_to(np.eye(2), tank.A.shape)
    while (step := np.einsum("kij,kj->ki", np.abs(power), push)).max() > 1e-9 * push.max():
        most, power = most + step, power @ tank.A
    assert (np.abs((y[0, :, 0] - 5.0) / 2.0) <= most[:, 0].mean() + 1e-9).all()


def _wild(seed):
    rng = np.random.default_rng(seed)
    K, n, h = 2, 2, 3
    A = rng.standard_normal((K, n, n))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max(axis=1)[:, None, None]
    some = {
        key: 3 * rng.standard_normal((K, *shape))
        for key, shape in {"B": (n, 1), "c": (n,), "V": (n, h), "W": (h, n), "U": (h, 1), "b": (h,)}.items()
    }
    return NeuralModel(
        ("q",),
        (),
        ("level",),
        1.0,
        (),
        A=A,
        **some,
        y_middle=[5.0],
        y_size=[2.0],
        w_middle=[0.5],
        w_size=[0.3],
        reach=[2.0],
        low=[-np.inf],
        high=[np.inf],
    )


def test_rollout_is_step_and_casadi_runs_the_same_lines(tank):
    rng = np.random.default_rng(0)
    u, x0 = rng.uniform(0, 2, (2, 30, 1)), rng.standard_normal((2, tank.n_x))
    y, x_end = tank.rollout(x0, u, np.zeros((2, 30, 0)), (), 1.0)
    for b in range(2):
        x = list(x0[b])
        for k in range(30):
            x = tank.step(x, u[b, k], [], (), 1.0)
        np.testing.assert_allclose(x_end[b], x, rtol=1e-9)
        np.testing.assert_allclose(y[b, -1], tank.output(x, ()), rtol=1e-9)
    xs, us = ca.SX.sym("x", tank.n_x), ca.SX.sym("u", 1)
    after = tank.step(ca.vertsplit(xs), ca.vertsplit(us), [], (), 2.0)
    step = ca.Function("step", [xs, us], [ca.vertcat(*after)])
    np.testing.assert_allclose(
        np.asarray(step(x0[0], 0.3)).ravel(), tank.step(x0[0], [0.3], [], (), 2.0), rtol=1e-12
    )


def test_a_state_at_rest_reads_what_was_asked_and_hardly_moves(tank):
    x = tank.rest([6.0], [0.7], [], ())
    y, _ = tank.rollout(x[None], np.full((1, 1, 1), 0.7), np.zeros((1, 1, 0)), (), 1.0)
    assert y[0, 0, 0] == pytest.approx(6.0, abs=1e-9)
    # 0.25 q = 0.07 sqrt(6) holds it there: the input that the plant needs is 0.686
    assert y[0, 1, 0] == pytest.approx(6.0, abs=0.03)


def bent(**change):
    """Two members of two states, one output with rails, an input, a switch and a disturbance."""
    rng = np.random.default_rng(5)
    K, n, h, m = 2, 2, 3, 3
    shapes = {"B": (n, m), "c": (n,), "V": (n, h), "W": (h, n), "U": (h, m), "b": (h,)}
    content = {
        "inputs": ("q", "pump"), "disturbances": ("room",), "outputs": ("t",), "switches": ("pump",),
        "dt": 2.0,
        "A": [[[0.5, 0.2], [-0.1, 0.6]], [[0.3, -0.4], [0.2, 0.7]]],
        **{key: 0.4 * rng.standard_normal((K, *shape)) for key, shape in shapes.items()},
        "y_middle": [25.0], "y_size": [4.0], "w_middle": [0.5, 0.4, 20.0], "w_size": [0.3, 0.5, 3.0],
        "reach": [2.0, 1.5, 1.0], "low": [22.0], "high": [27.0],
    }  # fmt: skip
    return NeuralModel(**(content | change))


def test_one_unit_by_hand():
    scales = {"y_middle": [25.0], "y_size": [4.0], "w_middle": [0.5, 20.0], "w_size": [0.3, 3.0]}
    one = {"A": [[[0.5]]], "B": [[[0.2, -0.3]]], "c": [[0.05]], "V": [[[0.7]]], "W": [[[0.4]]],
           "U": [[[0.6, -0.1]]], "b": [[0.15]], "reach": [2.0, 1.0],
           "low": [-np.inf], "high": [np.inf]}  # fmt: skip
    model = bent(inputs=("q",), switches=(), **scales, **one)
    w = np.array([1.0, -1.0])  # q = 0.8; the room of 11 degC is clipped from -3 to -1
    after = (
        0.5 * 0.9 + 0.2 * w[0] - 0.3 * w[1] + 0.05 + 0.7 * np.tanh(0.4 * 0.9 + 0.6 * w[0] - 0.1 * w[1] + 0.15)
    )
    assert model.step([0.9], [0.8], [11.0], (), 2.0) == pytest.approx([after])
    assert model.output([0.9], ()) == pytest.approx([25.0 + 4 * 0.9])
    y, end = model.rollout([[0.9]], [[[0.8]]], [[[11.0]]], (), 2.0)
    assert end[0] == pytest.approx([after])
    assert y[0, :, 0] == pytest.approx([28.6, 25.0 + 4 * after])


@pytest.mark.parametrize("rails", [{}, {"low": [-np.inf]}, {"high": [np.inf]}])
def test_drives_disturbances_and_rails_are_those_of_the_step(rails):
    model, rng = bent(**rails), np.random.default_rng(1)
    u, d = rng.uniform(-0.5, 1.5, (2, 25, 2)), rng.uniform(15, 25, (2, 25, 1))
    x0 = 2 * rng.standard_normal((2, 4))
    for times in (1, 2):
        y, end = model.rollout(x0, u, d, (), 2.0 * times)
        together, _ = model.rollout(x0, u[:1], d[:1], (), 2.0 * times)
        np.testing.assert_allclose(together[0], y[0], rtol=1e-12)
        for b in range(2):
            x = list(x0[b])
            for k in range(25):
                np.testing.assert_allclose(y[b, k], model.output(x, ()), rtol=1e-9)
                x = model.step(x, u[b, k], d[b, k], (), 2.0 * times)
            np.testing.assert_allclose(end[b], x, rtol=1e-9, atol=1e-12)
    met = (y[:, 1:] == 22.0).any(), (y[:, 1:] == 27.0).any()
    assert met == (model.low[0] == 22.0, model.high[0] == 27.0) or len(rails) == 1
    np.testing.assert_array_equal(model.rollout(x0, u, d, (), 0.9)[0], model.rollout(x0, u, d, (), 2.0)[0])


@pytest.mark.parametrize("reading", [26.0, np.nan])
def test_rest_of_linear_members_is_the_least_squares_of_its_theory(reading):
    """Unknown are the hidden state, the reading where it is lost, and the input, but not the switch."""
    model = bent(V=np.zeros((2, 2, 3)), low=[-np.inf], high=[np.inf])
    x = model.rest([reading], [0.6, 0.8], [22.0], ()).reshape(2, 2)
    w = np.clip((np.array([0.6, 0.8, 22.0]) - model.w_middle) / model.w_size, -model.reach, model.reach)
    for k in range(2):
        flow = np.hstack([model.A[k] - np.eye(2), model.B[k]])
        free = [1, 2] if np.isfinite(reading) else [0, 1, 2]
        known = np.concatenate([[0.25 if np.isfinite(reading) else 0.0, 0.0], w])
        weight = np.diag([1e-2 if i == 2 else 1e-4 for i in free])
        rows, right = (
            np.vstack([flow[:, free], weight]),
            np.concatenate([-(flow @ known + model.c[k]), 0 * weight[0]]),
        )
        z = known.copy()
        z[free] += np.linalg.lstsq(rows, right, rcond=None)[0]
        np.testing.assert_allclose(x[k], z[:2], atol=1e-6)


def test_a_rest_far_from_the_middle_is_reached_in_steps_of_one_spread():
    """One state that no reading fixes, with x = 0.5 x + 2: at 4, four spreads away."""
    shapes = {"B": (2, 3), "V": (2, 3), "W": (3, 2), "U": (3, 3), "b": (3,)}
    none = {key: np.zeros((1, *shape)) for key, shape in shapes.items()}
    lone = bent(A=[[[0.5, 0.0], [0.0, 0.5]]], c=[[2.0, 2.0]], **none)
    np.testing.assert_allclose(lone.rest([np.nan], [0.6, 0.8], [22.0], ()), [4.0, 4.0], atol=1e-5)
    np.testing.assert_allclose(lone.rest([27.0], [0.6, 0.8], [22.0], ()), [0.5, 4.0], atol=1e-5)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"W": np.full((2, 3, 2), np.nan)}, r"W has shape \(2, 3, 2\), expected finite \(2, 3, 2\)"),
        ({"U": np.zeros((2, 3, 2))}, r"U has shape \(2, 3, 2\), expected finite \(2, 3, 3\)"),
        ({"y_size": [1.0, 1.0]}, r"y_size has shape \(2,\), expected finite \(1,\)"),
        ({"low": []}, r"low has shape \(0,\), expected finite \(1,\)"),
        ({"reach": [1.0]}, r"reach has shape \(1,\), expected finite \(3,\)"),
        ({"w_middle": [1.0]}, r"w_middle has shape \(1,\)"),
        ({"outputs": tuple("abc"), **dict.fromkeys(("y_middle", "y_size", "low", "high"), [1.0] * 3)},
         "2 states cannot hold 3 outputs"),
        ({"A": [np.eye(2), 0.5 * np.eye(2)]}, "the linear part of a member is not stable"),
    ],
)  # fmt: skip
def test_parts_that_do_not_fit_are_refused(change, said):
    with pytest.raises(ValueError, match=said):
        bent(**change)


def test_a_neural_model_comes_back_from_its_dict_with_its_rails():
    for rails in ({}, {"low": [-np.inf]}, {"high": [np.inf]}):
        model = bent(**rails)
        again = NeuralModel.from_dict(model.to_dict())
        assert again.to_dict() == model.to_dict()
        assert (again.low.tolist(), again.high.tolist()) == (model.low.tolist(), model.high.tolist())
    assert (model.n_x, model.spread.tolist(), model.stable) == (4, np.eye(4).tolist(), True)
    sizes = {"y_middle": [25.0, 1.0], "y_size": [4.0, 2.0], "low": [-np.inf] * 2, "high": [np.inf] * 2}
    two = bent(outputs=("t", "s"), **sizes)
    assert two.output([1.0, 2.0, 3.0, 6.0], ()) == [25.0 + 4 * 2.0, 1.0 + 2 * 4.0]


def test_a_fifth_of_the_readings_lost_costs_little(fit_one):
    fresh = tank_log(seed=2)
    grid = make_grid([tank_log(lost=0.2)], average=1.0)
    model = fit_one("neural", grid, states=2, units=4, members=2)
    seen, segment = simulated(model, fresh)
    assert float(np.sqrt(np.nanmean((seen - segment.y)[50:] ** 2))) < 0.15


def test_the_neural_fit_chooses_by_free_run_and_its_plant_comes_back_from_its_file(tmp_path):
    found = fit_black_box("neural", [tank_log(400)], average=2.0)
    assert found.plant.model.kind == "neural"
    assert found.choice.structure.label == "members of all sizes"
    again = Plant.load(found.plant.save(tmp_path / "plant.json"))
    fresh = tank_log(seed=4)
    one, other = (free_run(plant, fresh, warmup=50.0, score_from=50.0) for plant in (found.plant, again))
    assert one.scores["level"].rmse == other.scores["level"].rmse < 0.5


def test_what_is_not_a_model_is_refused(tank):
    assert not neural_family(make_grid([tank_log(100)], average=1.0), states=(9,))
    with pytest.raises(UserError, match="not a neural model"):
        NeuralModel.from_dict(tank.to_dict() | {"A": [[[1.0]]]})
    broken = tank.to_dict() | {"A": (1.2 * np.eye(2) + 0 * tank.A).tolist()}
    with pytest.raises(UserError, match="not stable"):
        NeuralModel.from_dict(broken)


def test_the_same_data_give_the_same_model():
    grid = make_grid([tank_log(300)], average=1.0)
    one, other = (neural_family(grid, states=(2,), units=(3,), members=2) for _ in range(2))
    for structure in one:
        np.testing.assert_array_equal(one[structure].V, other[structure].V)
