"""The likelihood of what was read is its normal density, whatever was lost; its maximum is the plant."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter
from scipy.stats import chi2, multivariate_normal

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import make_log
from thermogrip.sysid.blackbox.kalman import fit_likelihood, log_likelihood
from thermogrip.sysid.blackbox.kalman_kernel import run_adjoint, run_filter, run_smoother
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.log_grid import Segment, make_grid

K = np.array([[0.4, 0.1], [0.0, 0.3], [0.2, -0.5]])
R = np.array([[0.5, 0.2], [0.2, 0.3]])
X0 = np.array([0.3, -0.2, 1.0])


def coupled(**changes):
    """Two outputs of three states, a switch that changes how they couple, a product of inputs, offsets."""
    parts = {
        "A": [[0.8, 0.1, 0.0], [0.0, 0.6, 0.2], [0.1, 0.0, 0.5]],
        "B": [[0.3, 0.0], [0.0, 0.1], [0.2, 0.0]],
        "C": [[1.0, 0.5, 0.0], [0.0, 1.0, -1.0]],
        "E": [[0.1], [0.0], [0.2]],
        "F": [[0.0], [0.3], [0.0]],
        "c": [0.1, 0.0, -0.1],
        "y0": [20.0, 25.0],
        "A_switch": {"pump": [[0.0, 0.1, 0.0], [0.1, 0.0, 0.0], [0.0, 0.0, 0.2]]},
    }
    return StateSpaceModel(
        ("q", "pump"), ("room",), ("t1", "t2"), dt=1.0, switches=("pump",), terms=("|q|",), **parts | changes
    )


def record(n=9, seed=0, lost=0.0):
    rng = np.random.default_rng(seed)
    u = np.column_stack([rng.normal(size=n), np.arange(n) % 4 < 2])
    y = np.array([20.0, 25.0]) + rng.normal(size=(n, 2))
    y[rng.random((n, 2)) < lost] = np.nan
    return Segment(np.arange(float(n)), y, u, rng.normal(size=(n, 1)), "a")


def dense(model, segment, x0, gain, covariance):
    """ln p of the readings from the mean and covariance of all of them, written down by hand."""
    n, p = segment.y.shape
    free = model.rollout(x0[None], segment.u[None], segment.d[None], (), model.dt)[0][0, :-1]
    through = np.zeros((n * p, n * p))  # from the innovations of a row to the readings of a later one
    for row in range(n):
        state = gain.copy()
        through[row * p : (row + 1) * p, row * p : (row + 1) * p] = np.eye(p)
        for later in range(row + 1, n):
            through[later * p : (later + 1) * p, row * p : (row + 1) * p] = model.C @ state
            switched = sum(segment.u[later, model.inputs.index(k)] * m for k, m in model.A_switch.items())
            state = (model.A + switched) @ state
    whole = through @ np.kron(np.eye(n), covariance) @ through.T
    read = np.isfinite(segment.y).ravel()
    density = multivariate_normal(free.ravel()[read], whole[np.ix_(read, read)])
    return float(density.logpdf(segment.y.ravel()[read]))


@settings(max_examples=25)
@given(seed=st.integers(0, 10**6), lost=st.floats(0.0, 0.9))
def test_the_likelihood_is_the_normal_density_of_the_readings_that_are_there(seed, lost):
    segment = record(seed=seed, lost=lost)
    segment.y[0, 0] = 20.0  # scipy has no density of nothing
    found = log_likelihood(coupled(), [segment], [X0], gain=K, covariance=R)
    assert found == pytest.approx(dense(coupled(), segment, X0, K, R), abs=1e-9)


@pytest.mark.parametrize("where", [np.s_[:, 1], np.s_[3:6, :], np.s_[4, 0], np.s_[0, :]])
def test_a_lost_channel_lost_rows_and_a_lost_start_are_integrated_over(where):
    segment = record()
    segment.y[where] = np.nan
    found = log_likelihood(coupled(), [segment], [X0], gain=K, covariance=R)
    assert found == pytest.approx(dense(coupled(), segment, X0, K, R), abs=1e-9)


def test_densities_of_segments_multiply_and_nothing_read_has_density_one():
    one, two = record(), record(6, seed=1, lost=0.3)
    nothing = replace(one, y=np.full_like(one.y, np.nan))
    both = log_likelihood(coupled(), [one, two, nothing], [X0, 2 * X0, X0], gain=K, covariance=R)
    parts = [log_likelihood(coupled(), [s], [x], gain=K, covariance=R) for s, x in ((one, X0), (two, 2 * X0))]
    assert both == pytest.approx(sum(parts), abs=1e-12)


def test_an_unknown_input_and_a_covariance_that_is_none_are_refused():
    segment = record()
    segment.u[3, 0] = np.nan
    with pytest.raises(UserError, match="unknown in some rows"):
        log_likelihood(coupled(), [segment], [X0], gain=K, covariance=R)
    for none in (-R, np.zeros((2, 2)), np.diag([1.0, 0.0])):
        with pytest.raises(ValueError, match="not positive definite"):
            log_likelihood(coupled(), [record()], [X0], gain=K, covariance=none)


def noisy_system(seed=0):
    """Arguments of the kernel's filter: correlated noise, a doubtful start, lost channels and a lost row."""
    rng = np.random.default_rng(seed)
    n, p, rows = 3, 2, 12
    y = rng.normal(size=(rows, p))
    y[rng.random((rows, p)) < 0.4] = np.nan
    y[4] = np.nan
    root = rng.normal(size=(n + p, n + p))
    joint = root @ root.T
    noise = (joint[:n, :n].copy(), joint[:n, n:].copy(), joint[n:, n:].copy())
    A, C, b = 0.5 * rng.normal(size=(2, n, n)), rng.normal(size=(p, n)), rng.normal(size=(rows, n))
    return [A, rng.integers(0, 2, rows), b, C, y, *noise, rng.normal(size=n), 0.3 * np.eye(n)]


def test_the_backward_pass_gives_the_slopes_that_differences_give():
    system = noisy_system()
    _, *left = run_filter(*system)
    slopes = dict(zip("AbCQSRx", run_adjoint(system[0], system[1], system[3], *left)))
    for name, at in {"A": 0, "b": 2, "C": 3, "Q": 5, "S": 6, "R": 7, "x": 8}.items():
        for place in np.ndindex(*system[at].shape):
            costs = []
            for step in (1e-6, -1e-6):
                moved = [part.copy() for part in system]
                moved[at][place] += step / 2
                moved[at][place[::-1] if name in "QR" else place] += step / 2
                costs.append(run_filter(*moved)[0])
            assert (costs[0] - costs[1]) / 2e-6 == pytest.approx(slopes[name][place], abs=1e-7)


def test_the_smoother_is_the_mean_and_covariance_given_all_readings():
    A, at, b, C, y, Q, S, R_, x0, P0 = system = noisy_system(1)
    rows, p = y.shape
    n = len(x0)
    size = n + rows * (n + p)  # of [x0; v_0, e_0; v_1, e_1; ...], of which all is a sum
    joint = np.zeros((size, size))
    joint[:n, :n] = P0
    for t in range(rows):
        own = slice(n + t * (n + p), n + (t + 1) * (n + p))
        joint[own, own] = np.block([[Q, S], [S.T, R_]])
    state, mean, states, means, seen = np.eye(n, size), x0, [], [], []
    for t in range(rows):
        own = n + t * (n + p)
        states.append(state)
        means.append(mean)
        seen.append(C @ state + np.eye(p, size, own + n))
        state, mean = A[at[t]] @ state + np.eye(n, size, own), A[at[t]] @ mean + b[t]
    read = np.isfinite(y).ravel()
    H = np.concatenate(seen)[read]
    miss = y.ravel()[read] - np.concatenate([C @ m for m in means])[read]
    found, covariance = run_smoother(A, at, C, *run_filter(*system)[1:])
    for t in range(rows):
        cross = states[t] @ joint @ H.T @ np.linalg.inv(H @ joint @ H.T)
        np.testing.assert_allclose(found[t], means[t] + cross @ miss, atol=1e-9)
        want = states[t] @ joint @ states[t].T - cross @ H @ joint @ states[t].T
        np.testing.assert_allclose(covariance[t], want, atol=1e-9)


POLE, GAIN, NOISE = 0.95, 0.5, 0.1


def heater(seed, n=600, *, lost=0.5, burst=1):
    rng = np.random.default_rng(seed)
    q = np.repeat(rng.random(n // 20), 20)
    t = 25 + lfilter([0, GAIN], [1, -POLE], q) + NOISE * rng.standard_normal(n)
    t[np.repeat(rng.random(n // burst + 1) < lost, burst)[:n]] = np.nan
    return make_log(np.arange(float(n)), {"q": (q, "1", "input"), "t": (t, "degC", "output")}, name=str(seed))


def rough_start():
    return StateSpaceModel(("q",), (), ("t",), A=[[0.8]], B=[[1.0]], C=[[1.0]], dt=1.0, y0=[25.0])


def scatter(log):
    """Covariance of (pole, gain of a step) by the Cramer-Rao bound: white noise, offset and start unknown."""
    q, read = log["q"].values, np.isfinite(log["t"].values)

    def run(pole, b, level, x0):
        start = x0 * pole ** np.arange(len(q))
        return level + start + lfilter([0, b], [1, -pole], q)

    at = np.array([POLE, GAIN, 25.0, 0.0])
    slopes = [(run(*(at + h)) - run(*(at - h))) / 2e-6 for h in 1e-6 * np.eye(4)]
    J = np.array(slopes)[:, read].T / NOISE
    return np.linalg.inv(J.T @ J)[:2, :2]


@pytest.mark.parametrize("burst", [1, 10])
def test_with_half_of_the_readings_lost_the_parameters_scatter_as_the_cramer_rao_bound_says(burst):
    total, many = 0.0, 30
    for seed in range(many):
        log = heater(seed, burst=burst)
        model = fit_likelihood(make_grid([log], average=1.0), rough_start()).model
        pole = float(model.A[0, 0])
        off = np.array([pole - POLE, model.gain()[0, 0] * (1 - pole) - GAIN])
        total += off @ np.linalg.inv(scatter(log)) @ off
    low, high = chi2(2 * many).ppf([0.001, 0.999])
    assert low < total < high


def test_logs_are_merged_each_with_a_start_of_its_own_and_a_silent_one_adds_nothing():
    warm = heater(1, 300)
    warm["t"].values[:] += 3.0 * POLE ** np.arange(300)  # begins 3 K above
    silent = heater(2, 300)
    silent["t"].values[20:] = np.nan
    alone = fit_likelihood(make_grid([heater(0, 300)], average=1.0), rough_start())
    grid = make_grid([heater(0, 300), warm, silent], average=1.0)
    found = fit_likelihood(grid, rough_start())
    assert found.starts.shape == (3, 1)
    assert abs(found.model.A[0, 0] - POLE) < 4 * np.sqrt(scatter(heater(0, 300))[0, 0])
    lift = (found.starts @ found.model.C.T)[:, 0]
    assert lift[1] - lift[0] == pytest.approx(3.0, abs=4 * NOISE * np.sqrt(2 * (1 - POLE) / 0.5))
    again = log_likelihood(
        found.model, grid.segments, found.starts, gain=found.gain, covariance=found.covariance
    )
    assert found.log_likelihood == pytest.approx(again, abs=1e-6)
    assert alone.covariance[0, 0] == pytest.approx(NOISE**2, rel=4 * np.sqrt(2 / 150))


def test_noise_that_is_coloured_is_found_as_such():
    rng = np.random.default_rng(0)
    q = np.repeat(rng.random(150), 20)
    e = NOISE * rng.standard_normal(3000)
    t = 25 + lfilter([0, GAIN], [1, -POLE], q) + lfilter([1, -0.5], [1, -POLE], e)  # K = 0.95 - 0.5
    t[rng.random(3000) < 0.3] = np.nan
    log = make_log(np.arange(3000.0), {"q": (q, "1", "input"), "t": (t, "degC", "output")})
    found = fit_likelihood(make_grid([log], average=1.0), rough_start())
    assert (found.model.C @ found.gain)[0, 0] == pytest.approx(0.45, abs=4 / np.sqrt(0.7 * 3000))
    assert found.covariance[0, 0] == pytest.approx(NOISE**2, rel=4 * np.sqrt(2 / 2100))


def test_an_unstable_start_is_none():
    unstable = replace(rough_start(), A=np.array([[1.01]]))
    assert fit_likelihood(make_grid([heater(0)], average=1.0), unstable) is None


def two_sensors(n=400):
    """A block read in degC and, with twenty times its noise, in another unit; in a room that wanders."""
    rng = np.random.default_rng(3)
    A, B, E = np.array([[0.95, 0.0], [0.05, 0.9]]), np.array([0.5, 0.0]), np.array([0.05, 0.02])
    C, gain = np.diag([1.0, 20.0]), np.diag([0.3, 0.01])
    q, room = np.repeat(rng.random(n // 10), 10), 20 + np.cumsum(0.1 * rng.standard_normal(n))
    e = rng.multivariate_normal(np.zeros(2), [[0.04, 0.3], [0.3, 9.0]], n)
    x, y = np.zeros(2), np.zeros((n, 2))
    for k in range(n):
        y[k] = C @ x + [25.0, 300.0] + e[k]
        x = A @ x + B * q[k] + E * (room[k] - 20.0) + gain @ e[k]
    y[rng.random((n, 2)) < 0.2] = np.nan
    columns = {"q": (q, "1", "input"), "room": (room, "degC", "disturbance")}
    return make_log(np.arange(float(n)), columns | {f"t{k + 1}": (y[:, k], "degC", "output") for k in (0, 1)})


def test_what_is_found_of_two_sensors_and_a_room_is_the_maximum_and_says_its_likelihood():
    start = StateSpaceModel(
        ("q",), ("room",), ("t1", "t2"), A=[[0.9, 0.0], [0.1, 0.8]], B=[[1.0], [0.0]], C=np.diag([1.0, 10.0]),
        E=[[0.1], [0.1]], c=[-2.0, -2.0], dt=1.0, y0=[25.0, 300.0],
    )  # fmt: skip
    grid = make_grid([two_sensors()], average=1.0)
    found = fit_likelihood(grid, start)

    def of(gain=found.gain, covariance=found.covariance, model=found.model):
        return log_likelihood(model, grid.segments, found.starts, gain=gain, covariance=covariance)

    assert found.log_likelihood == pytest.approx(of(), abs=1e-6)
    # the last step gained less than 0.02, so what is left to gain in any direction is of that size
    for place in np.ndindex(2, 2):
        bit = np.zeros((2, 2))
        bit[place] = 0.05
        for step in (bit, -bit):
            root = np.eye(2) + step
            assert of(covariance=root @ found.covariance @ root.T) < found.log_likelihood + 0.1
            assert of(gain=found.gain @ root) < found.log_likelihood + 0.1
            assert of(model=replace(found.model, A=found.model.A + 0.02 * step)) < found.log_likelihood + 0.1
