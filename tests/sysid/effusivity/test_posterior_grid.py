"""The grid's quantiles, and what Laplace's method leaves out, against sums that know no mode."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator
from scipy.special import logsumexp, ndtr
from scipy.stats import multivariate_normal, multivariate_t, norm
from scipy.stats import t as student_t

from thermogrip.datasets.examples import load_example_grasps
from thermogrip.sysid.contact.simulation import simulate_grasps
from thermogrip.sysid.effusivity import mode_kernel, posterior_grid
from thermogrip.sysid.effusivity.data import noise_covariance, touches, whiten
from thermogrip.sysid.effusivity.laplace_approximation import (
    EFFUSIVITY,
    SENSORS_APART,
    T_OBJECT,
    fit_candidates,
    fit_pairs,
    free_hypotheses,
    nodes_for,
    predict,
    prior_of,
    whitened,
)
from thermogrip.sysid.effusivity.posterior_grid import (
    LN_E_RANGE,
    SAMPLED,
    MarginalPosterior,
    _evidence_near,
    _more,
    free_evidence,
    grid_posteriors,
    log_integrals,
    log_integrals_of_two,
    mixture_quantiles,
    monotone,
    smooth_slopes,
)

LEVELS = (0.05, 0.5, 0.95)


@pytest.mark.parametrize("seed", range(6))
def test_the_mixture_has_its_levels_below_its_quantiles(seed):
    rng = np.random.default_rng(seed)
    weight, mean = rng.dirichlet(np.full(60, 0.3)), np.sort(10 + 2 * rng.standard_normal(60))
    sd = np.exp(rng.normal(-2, 1.5, 60))
    x = mixture_quantiles(weight, mean, sd, LEVELS)
    np.testing.assert_allclose((weight * ndtr((x[:, None] - mean) / sd)).sum(axis=1), LEVELS, atol=1e-9)


def test_a_level_that_has_arrived_waits_for_the_others(monkeypatch):
    """Sent back to the middle of its bounds, it took 36 rounds of 1500 error functions each."""
    rounds: list[int] = []
    monkeypatch.setattr("scipy.special.ndtr", lambda z: (rounds.append(1), ndtr(z))[1])
    x = np.linspace(9.4, 12.0, 500)
    mass = np.exp(-0.5 * ((x - 11.1) / 0.45) ** 2)
    mixture_quantiles(mass / mass.sum(), x, 0.05 + 0.07 * (x - 9.4), LEVELS)
    assert len(rounds) <= 8


@pytest.mark.parametrize("n", [3, 4, 7])
def test_curves_without_turns_between_points_are_those_of_scipy(n):
    rng = np.random.default_rng(n)
    x, y = np.sort(rng.uniform(0, 5, (40, n)), axis=1), rng.normal(size=(40, n))
    y[:9, 1] = y[:9, 2]  # level
    at = np.concatenate([x, rng.uniform(-1, 6, (40, 20))], axis=1)
    want = [PchipInterpolator(a, b)(np.clip(c, a[0], a[-1])) for a, b, c in zip(x, y, at)]
    np.testing.assert_allclose(monotone(x, y, at), want, atol=1e-12)


@pytest.fixture(scope="module")
def iron():
    """A grasp that knows of its heat capacity hardly more than a lower bound."""
    record = load_example_grasps()["exp3C_obj18_grip38"]
    return touches(record.isel(grasp=[int(np.flatnonzero(record["material"].values == "iron")[3])]))


def sampled_integrals(device, data, x, mode, *, n=6000, seed=0):
    """Return ln of the integrals by importance sampling from a wide Student's t."""
    rng, target, rest = np.random.default_rng(seed), MarginalPosterior(device, data), np.array(SAMPLED[1:])
    root = np.linalg.cholesky(1.4 * mode.covariance[:, rest[:, None], rest[None, :]])
    z = rng.standard_normal((n, 4)) * np.sqrt(5 / rng.chisquare(5, n))[:, None]
    out = []
    for k, at in enumerate(x):
        points = np.column_stack([np.full(n, at), mode.u[k, rest] + z @ root[k].T])
        law = multivariate_t(np.zeros(4), root[k] @ root[k].T, df=5)
        out.append(logsumexp(target(points) - law.logpdf(z @ root[k].T)) - np.log(n))
    # the density's constants: of the noise, and of four normal priors
    return np.array(out) - 0.5 * target.log_det - 2 * np.log(2 * np.pi)


@pytest.mark.usefixtures("one_grade")
def test_the_sum_is_what_importance_sampling_finds(device, iron):
    posterior = grid_posteriors(device, iron)[0]
    x = np.interp([0.02, 0.3, 0.7, 0.98], np.cumsum(posterior.mass), posterior.x)
    mode = fit_pairs(device, iron, np.zeros(4, dtype=np.int64), free_hypotheses(device, x))
    got = log_integrals(device, iron, x, mode.u, mode.covariance)
    # 6000 draws of weights with a relative sd near one: 0.013 nat, four of them and a hundredth for the rule
    want = sampled_integrals(device, iron, x, mode)
    np.testing.assert_allclose(got, want, atol=0.06)
    # the same error everywhere would move nothing: this one does not stay the same
    assert np.ptp(want - mode.log_evidence) > 0.08


@pytest.mark.usefixtures("one_grade")
def test_quantiles_are_those_of_the_summed_density(device, iron):
    posterior = grid_posteriors(device, iron)[0]
    below = np.cumsum(posterior.mass) - 0.5 * posterior.mass
    got = np.interp(LEVELS, below, posterior.x)
    x = np.linspace(*np.interp([1e-5, 1 - 1e-5], below, posterior.x), 80)
    mode = fit_pairs(device, iron, np.zeros(80, dtype=np.int64), free_hypotheses(device, x))
    value = sampled_integrals(device, iron, x, mode, n=800, seed=1)  # the same draws everywhere
    mass = np.exp(value - value.max())
    want = np.interp(LEVELS, (np.cumsum(mass) - 0.5 * mass) / mass.sum(), x)
    sd = np.sqrt((posterior.mass * x_squared(posterior)).sum())
    np.testing.assert_allclose(got, want, atol=0.06 * sd)


def x_squared(posterior):
    return (posterior.x - (posterior.mass * posterior.x).sum()) ** 2


@pytest.fixture(scope="module")
def finger(device):
    """A passive sensor of another skin beside the first, its thermometer 0.4 K above."""
    stack = replace(device.stack, lag=0.3, z_outer=1.5 * device.stack.z_outer)
    return replace(device, second=replace(device, stack=stack, bias=device.bias + 0.4))


@pytest.mark.parametrize("stated", [17.0, np.nan])
def test_two_sensors_are_integrated_over_every_temperature_of_their_object(finger, stated):
    """Beside a sum over the temperatures at both sensors, each held while the rest is integrated."""
    one, two = (
        simulate_grasps(
            replace(own.grip(), t_object_sd=0.0), ["iron"], t_object=18.3, t_gripper=skin, seed=3,
            ambient=25.0, **own.readings(),
        )
        for own, skin in ((finger, 38.0), (finger.second, 28.0))
    )  # fmt: skip
    told = {"t_object": ("grasp", [stated]), "t_object_sd": ("grasp", [0.5])}
    data = touches(one.assign(t_surface_2=two["t_surface"], **told))
    x, row = np.array([9.3, 9.8, 10.3, 10.8]), np.zeros(4, dtype=np.int64)
    mode = fit_pairs(finger, data, row, free_hypotheses(finger, x))
    noise = whiten(data, finger.noise)
    got = log_integrals_of_two(finger, data, x, mode.u, noise=noise, row=row)

    def held(own, seen, ln_e, t):  # ln p(y | ln e, T_obj), (4, n)
        unstated = replace(seen, second=None, t_object=np.full(1, np.nan))
        law = prior_of(own, unstated.known(row), free_hypotheses(own, ln_e))
        out = []
        for at in t:
            mean, sd = law.mean.copy(), law.sd.copy()
            mean[:, T_OBJECT], sd[:, T_OBJECT] = at, 1e-3
            prior, white = law._replace(mean=mean, sd=sd), whiten(unstated, own.noise)
            there = fit_pairs(own, unstated, row, free_hypotheses(own, ln_e), prior=prior)
            out.append(
                posterior_grid._integrals(own, unstated, ln_e, there.u, there.covariance, white, row, prior)
            )
        return np.stack(out, axis=1)

    alone, other = replace(finger, second=None), finger.second
    t = np.linspace(16.4, 19.6, 41)
    t_2 = t + 0.4
    ln_e_2 = other.found_effusivity(x - finger.effusivity_scale(x)[0])
    law = prior_of(finger, data.known(row[:1]), free_hypotheses(finger, x[:1]))
    mean, sd = law.mean[0, T_OBJECT], law.sd[0, T_OBJECT]
    before = norm.logpdf(t, mean, sd)
    if np.isfinite(stated):
        before = np.logaddexp(np.log(0.95) + before, np.log(0.05) + norm.logpdf(t, mean, 3 * sd))
    apart = norm.logpdf(t_2[None, :] - t[:, None] - 0.4, 0.0, SENSORS_APART)
    by_one, by_two = before + held(alone, data, x, t), held(other, data.second, ln_e_2, t_2)
    both = by_one[:, :, None] + apart + by_two[:, None]
    want = logsumexp(both, axis=(1, 2)) + 2 * np.log(t[1] - t[0])
    np.testing.assert_allclose(got, want, atol=0.08)
    # Laplace's method is off by four times as much from one effusivity to another
    assert np.ptp(got - want) < 0.25 * np.ptp(want - mode.log_evidence)


@pytest.mark.usefixtures("one_grade")
def test_a_spoiled_record_is_answered_as_by_laplaces_method(device):
    """A sensor that runs away: no effusivity fits, no mode settles, and nothing breaks."""
    record = load_example_grasps()["exp3C_obj18_grip38"].isel(grasp=[0])
    y = record["t_surface"].values.copy()
    y += 9.0 * np.maximum(record["time"].values - 2, 0.0)
    posterior = grid_posteriors(device, touches(record.assign(t_surface=(("grasp", "time"), y))))[0]
    assert posterior.log_evidence < -1e4
    assert posterior.mass.sum() == pytest.approx(1.0)


def test_marginal_density_is_that_of_the_joint_normal(device, files):
    """With both temperatures in the covariance, C + X S X', written out densely."""

    data = touches(files["exp2_dT20"].isel(grasp=[13]))
    points = np.array(
        [[9.7, 7.0, -0.8, 0.02, 11.0], [8.9, 6.6, -0.7, -0.05, 10.9], [11.0, 7.2, -0.9, 0.1, 11.1]]
    )
    cov, want = noise_covariance(data, device.noise)[0], []
    for p in points:
        prior = prior_of(device, data, free_hypotheses(device, p[:1]))
        u = prior.mean.copy()
        u[0, [5, 0, 1, 2, 6]] = p
        mean = predict(device.stack, nodes_for(data), data, u)[0]
        totals = [cov.copy(), cov.copy()]
        for k, wide in ((3, 1.0), (4, 3.0)):  # one stated temperature in twenty is three times as far off
            moved = u.copy()
            moved[0, k] += 1.0
            column = predict(device.stack, nodes_for(data), data, moved)[0] - mean
            for total, factor in zip(totals, (1.0, wide)):
                total += (factor * prior.sd[0, k]) ** 2 * np.outer(column, column)
        order = [0, 1, 2, 6]
        laws = [student_t(v) if np.isfinite(v) else norm() for v in prior.dof[0, order]]
        pulls = (p[1:] - prior.mean[0, order]) / prior.sd[0, order]
        own = sum(law.logpdf(w) for law, w in zip(laws, pulls)) - np.log(prior.sd[0, order]).sum()
        each = [multivariate_normal(mean, total).logpdf(data.y[0]) for total in totals]
        want.append(own + logsumexp(each, b=[0.95, 0.05]))
    got = MarginalPosterior(device, data)(points)
    np.testing.assert_allclose(np.diff(got), np.diff(want), rtol=1e-6)
    assert MarginalPosterior(device, data)(np.array([[0.0, 7.0, -0.8, 0.0, 11.0]]))[0] == -np.inf


def test_priors_are_the_densities_of_their_laws():
    """But for the normal density's root of 2 pi, which is left to the weights."""
    x, left = np.array([-1.0, 0.4, 3.0]), 0.5 * np.log(2 * np.pi)
    for dof, law in ((7.0, student_t(7, 0.5, 2.0)), (np.inf, norm(0.5, 2.0))):
        np.testing.assert_allclose(posterior_grid._log_student(x, 0.5, 2.0, dof), law.logpdf(x) + left)
    np.testing.assert_allclose(posterior_grid._log_student(x, 0.5, 2.0), norm(0.5, 2.0).logpdf(x) + left)


@pytest.mark.parametrize(
    ("value", "low", "high"),
    [([-20, -13, -11, 0, -12.5, -40], 1.0, 4.0), ([0, -1, -13, -20, -30, -40], 0.0, 2.0),
     ([-40, -30, -20, -13, -11, 0], 3.0, 5.0)],
)  # fmt: skip
def test_new_points_lie_between_the_neighbours_of_those_near_the_best(value, low, high):
    got = posterior_grid.refined(np.arange(6.0), np.array(value, dtype=float), 12.0, 18)
    np.testing.assert_allclose(got, low + (high - low) * (np.arange(18) + 0.5) / 18)


def test_a_refinement_keeps_off_the_points_that_there_are():
    """Of thirteen cells over two the seventh has its middle on a point of before."""
    x = np.arange(6.0)
    got = posterior_grid.refined(x, np.array([-20.0, 0, -20, -30, -40, -40]), 12.0, 13)
    assert np.abs(got[:, None] - x).min() > 0.1 * 2 / 13
    assert ((got > 0) & (got < 2)).all()
    assert got.size == 13


def test_the_integral_of_a_density_is_known_from_its_logarithm_at_some_points():
    """A normal one, and one with a cliff beside it, which makes no wave."""
    x = np.array([np.linspace(5.0, 13.0, 27), np.linspace(5.0, 13.0, 27)])
    value = 5.0 - 0.5 * ((x - 9.1) / 0.6) ** 2
    value[1, x[1] < 9.0] = -1e5
    got = posterior_grid.log_total(x, value)
    assert got[0] == pytest.approx(5.0 + np.log(0.6 * np.sqrt(2 * np.pi)), abs=2e-3)
    half = 5.0 + np.log(0.6 * np.sqrt(2 * np.pi)) + norm(9.1, 0.6).logsf(9.0)
    assert got[1] == pytest.approx(half, abs=0.1)


def test_the_evidence_of_a_free_effusivity_is_that_of_its_posterior(device, iron):
    (posterior,) = grid_posteriors(device, iron)
    assert posterior_grid.free_evidence(device, iron) == pytest.approx([posterior.log_evidence], abs=0.01)


def test_the_posterior_of_a_normal_density_is_that_density():
    """Far tails belong to no mixture."""
    x = np.linspace(6.0, 12.0, 121)
    value = 5.0 - 0.5 * ((x - 9.1) / 0.3) ** 2
    found = posterior_grid.posterior_of(x, value, 2 * x, 0.1 * x, 3 * x)
    range_ = np.log(1.1e5 / 17.0)
    assert found.log_evidence == pytest.approx(5.0 + np.log(0.3 * np.sqrt(2 * np.pi) / range_), abs=1e-3)
    assert found.mass.sum() == pytest.approx(1.0)
    assert found.mass @ found.x == pytest.approx(9.1, abs=1e-4)
    assert found.mass @ (found.x - 9.1) ** 2 == pytest.approx(0.09, rel=1e-3)
    # 20 nats are 6.32 sd, and the grid goes on to the next point; 1e-9 of the peak is at 6.44 sd
    assert (found.x[0], found.x[-1], found.x.size) == pytest.approx((7.2, 11.0, 160))
    assert (found.t_object.min() / 2, found.t_object.max() / 2) == pytest.approx((7.2, 11.0))
    assert found.weight @ found.t_object / 2 == pytest.approx(9.1, abs=1e-3)
    np.testing.assert_allclose(found.t_object_sd, found.t_object / 20)
    np.testing.assert_allclose(found.ln_h, 1.5 * found.t_object)


def test_half_of_all_objects_are_near_a_material_of_the_table():
    x = np.linspace(*posterior_grid.LN_E_RANGE, 4000)
    density = np.exp(posterior_grid.log_listed(x)) / (x[-1] - x[0])
    assert np.trapezoid(density, x) == pytest.approx(1.0, abs=0.01)
    wood, between, far = np.exp(posterior_grid.log_listed(np.log([367.0, 4700.0, 1e5])))
    assert far == pytest.approx(0.5, abs=0.02)
    assert wood > 2 * between > 1.0


@pytest.mark.parametrize("material", ["copper", "iron", "wood"])
@pytest.mark.usefixtures("one_grade")
def test_a_density_that_is_looked_for_from_a_candidate_has_the_integral_of_many_points(
    device, monkeypatch, material
):
    """Copper's density ends at the range's edge, wood's lies between two coarse points."""
    record = load_example_grasps()["exp1A_obj43_grip23"]
    data = touches(record.isel(grasp=np.flatnonzero(record["material"].values == material)[:3]))
    names = ["copper", "iron", "wood"]
    modes = fit_candidates(device, data, names)[0]
    for own in (material, "iron"):  # also from one beside
        near = modes.u.reshape(3, 3, -1)[:, names.index(own)]
        quick = _evidence_near(device, data, near, whitened(device, data))
        sure = np.isfinite(quick)
        assert sure.sum() >= 2
        with monkeypatch.context() as fine:
            fine.setattr(posterior_grid, "N_COARSE", 60)
            fine.setattr(posterior_grid, "REFINEMENTS", ((12.0, 40), (8.0, 40)))
            want = free_evidence(device, data)
        np.testing.assert_allclose(quick[sure], want[sure], atol=0.03)
        assert np.abs(quick[sure] - want[sure]).max() > 0.0  # by other points
        np.testing.assert_allclose(free_evidence(device, data, near), want, atol=0.03)


def test_a_density_that_has_not_ended_is_followed_and_a_steep_one_gets_points_between():
    x = np.linspace(5.0, 6.0, 9)
    assert _more(x, -8.0 * np.square((x - 5.5) / 0.45)) is None
    beyond = _more(x, -0.5 * np.square((x - 6.2) / 0.2))
    assert beyond is not None
    assert (beyond > x[-1]).all()
    between = _more(x, -0.5 * np.square((x - 5.5) / 0.03))
    assert between is not None
    assert ((between > 5.2) & (between < 5.8)).all()
    edge = np.linspace(LN_E_RANGE[0], LN_E_RANGE[0] + 1.0, 9)  # there is nothing beyond
    assert _more(edge, -9.0 * (edge - edge[0])) is None
    low = edge[0] + 4e-16 * np.abs(edge[0]) + edge - edge[0]  # rounding leaves nothing between it and the end
    assert low[0] != LN_E_RANGE[0]
    assert _more(low, -9.0 * (low - low[0])) is None
    high = np.linspace(LN_E_RANGE[1] - 1.0, np.nextafter(LN_E_RANGE[1], 0.0), 9)
    assert _more(high, 9.0 * (high - high[-1])) is None


def test_a_density_beyond_the_range_is_looked_for_at_its_end(device):
    record = load_example_grasps()["exp1A_obj43_grip23"]
    data = touches(record.isel(grasp=np.flatnonzero(record["material"].values == "copper")[:2]))
    near = fit_candidates(device, data, ["copper"])[0].u.reshape(2, 1, -1)[:, 0]
    for end in LN_E_RANGE:  # a start from which the search ends beyond the range, or at its end
        far = near.copy()
        far[:, EFFUSIVITY] = end
        with np.errstate(all="raise"):
            found = free_evidence(device, data, far)
        np.testing.assert_allclose(found, free_evidence(device, data), atol=0.1)


def test_slopes_by_five_points_are_those_of_a_quartic():
    rng = np.random.default_rng(3)
    x, c = np.sort(rng.uniform(0, 3, (5, 9)), axis=1), rng.normal(size=5)
    want = np.polynomial.polynomial.polyval(x, np.polynomial.polynomial.polyder(c))
    found = smooth_slopes(x, np.polynomial.polynomial.polyval(x, c))
    np.testing.assert_allclose(found, want, rtol=1e-6, atol=1e-8)


def test_what_goes_with_one_over_the_root_of_e_is_met_between_points_and_beyond():
    """Cubics of it between the points, parabolas beyond them."""
    rng = np.random.default_rng(4)
    knots = np.sort(rng.uniform(8.0, 11.0, (3, 9)), axis=1)
    inside, beyond = np.linspace(knots[:, 0], knots[:, -1], 13).T, np.array([[7.0, 12.0]] * 3)

    def curve(x, degree):
        powers = np.exp(-0.5 * (x - 9.0))[..., None] ** np.arange(degree + 1)
        return powers @ np.array([[1.0, -2.0], [0.5, 3.0], [2.0, -1.0], [-0.7, 0.3]])[: degree + 1]

    got = posterior_grid._between(inside, knots, curve(knots, 3))
    np.testing.assert_allclose(got, curve(inside, 3), rtol=1e-7)
    got = posterior_grid._between(beyond, knots, curve(knots, 2))
    ends = curve(knots, 2).min(axis=1, keepdims=True), curve(knots, 2).max(axis=1, keepdims=True)
    far = 2 * ends[0] - ends[1], 2 * ends[1] - ends[0]
    np.testing.assert_allclose(got, np.clip(curve(beyond, 2), *far), rtol=1e-6)
    assert (got == np.clip(got, *far)).all()
    assert (got[:, 1] != far[0][:, 0]).all()
    farther = posterior_grid._between(beyond - 3.0, knots, curve(knots, 2))[:, 0]
    assert ((farther == far[0][:, 0]) | (farther == far[1][:, 0])).all()


def test_points_are_moved_a_little_to_places_that_other_touches_have():
    rng = np.random.default_rng(5)
    first, apart = rng.uniform(8.0, 9.0, (40, 1)), rng.uniform(0.1, 0.19, (40, 1))
    grid = first + apart * np.arange(9)
    grid[0] = LN_E_RANGE[1] - 0.1 * np.arange(9)[::-1]
    got = posterior_grid._rounded(grid)
    assert (np.abs(got - grid) <= apart / 16 + 1e-12)[1:].all()
    assert got[0, -1] == LN_E_RANGE[1]
    assert np.unique(got[1:]).size < 0.5 * grid[1:].size
    near = grid[:, :1] + 0.01 * apart  # nothing comes upon a point that is there
    assert (np.abs(posterior_grid._rounded(grid, near) - grid) <= 0.001 * apart).all(where=grid < 11.6)


def test_a_density_with_few_points_gets_more():
    x = np.linspace(9.0, LN_E_RANGE[1], 9)
    assert _more(x, -7.5 * np.square((x - x[-1]) / (x[-1] - x[1]))) is None
    few = _more(x, -7.5 * np.square((x - x[-1]) / (x[-1] - x[2])))
    assert few is not None
    assert few.size == 4
    assert few.max() < x[-1]


def test_points_far_behind_are_found_roughly_and_the_best_as_ever(device, monkeypatch):
    record = load_example_grasps()["exp1A_obj43_grip23"]
    data = touches(record.isel(grasp=np.flatnonzero(record["material"].values == "iron")[:1]))
    x, asked = np.linspace(8.9, 10.2, 9), []
    products = mode_kernel._Touched.products

    def counted(self, at, u, *, first):
        asked.append(at.size)
        return products(self, at, u, first=first)

    monkeypatch.setattr(mode_kernel._Touched, "products", counted)
    found = {}
    for rough in (0.0, 3.0):
        asked.clear()
        args = device, data, np.zeros(9, dtype=np.int64), free_hypotheses(device, x)
        found[rough] = fit_pairs(*args, rivals=True, rough=rough), sum(asked)
    (exact, most), (rough, fewer) = found[0.0], found[3.0]
    assert fewer < most
    behind = exact.log_evidence.max() - exact.log_evidence
    assert behind.max() > 3.0
    off = np.abs(rough.log_evidence - exact.log_evidence)
    assert (off < 0.02 * np.exp(np.minimum(behind, 3.0)))[exact.converged].all()
    assert off[behind == 0.0] == 0.0
