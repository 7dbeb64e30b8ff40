"""The Bayesian classifier, and what both classifiers on features do with small differences."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import xarray as xr
from scipy.stats import multivariate_t

from thermogrip.classify import make_classifier
from thermogrip.classify.estimators.base import GraspClassifier, join_grasps, pick
from thermogrip.classify.estimators.bayes import (
    BayesClassifier,
    FeatureReader,
    Readings,
    _log_evidence_of_feature,
    _log_t,
    _usable,
)
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import Grasps

Maker = Callable[..., Grasps]
MATERIALS = ("copper", "iron", "wood")
LEARNERS = ["bayes", "features-lda"]


def right(model: GraspClassifier, grasps: Grasps) -> float:
    return float((model.predict(grasps) == grasps["material"].values).mean())


@pytest.mark.parametrize("name", LEARNERS)
def test_one_grasp_without_a_difference_leaves_the_others_normalised(name: str, make_touches: Maker) -> None:
    warm = make_touches(MATERIALS)
    level = pick(make_touches(("wood",), t_object=23.2, name="level"), [0])
    model = make_classifier(name).fit([warm, level])
    alone = make_classifier(name).fit(warm)
    milder = make_touches(MATERIALS, t_object=33.0, seed=5, name="milder")
    assert right(model, milder) >= right(alone, milder) >= 0.9  # in kelvin it was 0.33
    np.testing.assert_allclose(model.predict_proba(milder), alone.predict_proba(milder), atol=0.1)


def test_readings_are_normalised_from_a_difference_of_1_kelvin_on() -> None:
    difference = np.array([-1.0, 1.0, 0.99, -0.99, np.nan])
    noise, sd = np.tile([[0.16, 0.04], [0.04, 0.09]], (5, 1, 1)), np.array([np.nan, 0.2, 0.2, 0.2, np.nan])
    gain = np.tile([4.0, 1.0], (5, 1))  # the second is a time constant
    x, noise = Readings(np.full((5, 2), [6.0, 3.0]), gain, noise, sd, difference).normalised()
    lost = [np.nan, np.nan]
    np.testing.assert_array_equal(x, [[1.5, 3.0], [1.5, 3.0], lost, lost, [1.5, 3.0]])
    # 0.16 / 16 + (0.5 / 4 * 1.5)^2 with the nominal error of 0.5 K, and with its own of 0.2 K
    np.testing.assert_allclose(noise[0], [[0.01 + 0.1875**2, 0.01], [0.01, 0.09]])
    np.testing.assert_allclose(noise[1], [[0.01 + 0.075**2, 0.01], [0.01, 0.09]])
    np.testing.assert_array_equal(noise[4], noise[0])
    assert np.isnan(noise[2:4]).all()


def test_a_material_is_known_from_half_a_grasp_of_full_weight_on() -> None:
    """A grasp of 1 K weighs 1 / (1 + 4), one of 2 K 4 / (4 + 4), one within 1 K nothing."""
    known = {"a": [2.0], "b": [1.0, -1.0, 1.0], "c": [9.0, np.nan, 0.3]}
    short = {"p": [1.0, 1.0], "q": [0.99] * 9, "r": [np.nan], "s": [1.9]}
    everything = {**known, **short}
    labels = np.array([m for m, d in everything.items() for _ in d])
    usable, notes = _usable(np.concatenate(list(everything.values())), labels)
    assert labels[usable].tolist() == ["a", "b", "b", "b", "c", "c"]
    assert notes == [
        "p, q, r, s left out: no object of known temperature 1 K from the skin's",
        "1 grasps left out: their object temperature is unknown",
    ]
    for enough in ("a", "ab"):
        of = [m in (*enough, "p") for m in labels]
        usable, notes = _usable(np.concatenate(list(everything.values()))[of], labels[of])
        assert usable.any() == (enough == "ab")
    assert _usable(np.array([5.0, 5.0]), np.array(["a", "b"]))[1] == []


def test_which_features_are_learnt_and_how_long_a_contact_must_be(make_touches: Maker) -> None:
    """Of a record, those that more than half of its grasps have; of the ends, the median up to 10 s."""
    warm = make_touches(MATERIALS, each=2, step=0.25, end=11.0)
    late = warm.time.values > np.array([1.75, 5.5, 3.0, 5.5, 5.5, 8.25])[:, None]
    part = warm.assign(t_surface=warm["t_surface"].where(xr.DataArray(~late, dims=("grasp", "time"))))
    reader, read, usable, _ = FeatureReader.learn([part], part["material"].values)
    assert reader.names == ["change_0.5s", "change_1s", "change_2s", "change_5s"]
    assert reader.end == 5.5
    assert read.y.shape == (6, 4)
    assert usable.all()
    half = part.isel(grasp=[0, 1, 2, 3])  # two of four reach 5 s
    assert "change_5s" not in FeatureReader.learn([half], half["material"].values).reader.names
    assert FeatureReader.learn([warm], warm["material"].values).reader.end == 10.0
    to = lambda end: warm.sel(time=slice(None, end))  # noqa: E731
    assert np.isfinite(reader.read(to(3.0)).y).all(axis=0).tolist() == [True, True, True, False]
    empty = pick(warm, [0, 1]).assign(t_surface=pick(warm, [0, 1])["t_surface"].where(warm.time < 0))
    with pytest.raises(UserError, match="no feature is known"):
        FeatureReader.learn([empty], empty["material"].values)


def conditioned(model: BayesClassifier, read: Readings, at: np.ndarray, g: int) -> tuple[np.ndarray, ...]:
    """Mean and covariance of (x, delta) given the features that a grasp has, and what it says of a mean.

    The equation y = gain x + delta ray + noise, conditioned by adding information.
    """
    zero, scale = model.center_ / model.scale_, model.scale_
    has = np.isfinite(read.y[g])
    gain, mean, d = np.diag(read.gain[g])[has], model.means_[at[g]], read.y.shape[1]
    sd = read.t_object_sd[g] if np.isfinite(read.t_object_sd[g]) else model.t_object_sd_
    ray = ((mean + zero) * (read.gain[g] != 1))[has]
    y = (read.y[g] / scale - read.gain[g] * zero)[has]
    design = np.column_stack([gain, ray])
    noise = (read.noise[g] / np.outer(scale, scale))[np.ix_(has, has)]
    prior = np.zeros((d + 1, d + 1))
    prior[:d, :d], prior[d, d] = np.linalg.inv(model.covariance_), sd**-2
    covariance = np.linalg.inv(prior + design.T @ np.linalg.inv(noise) @ design)
    centre = covariance @ (prior @ np.append(mean, 0) + design.T @ np.linalg.inv(noise) @ y)
    whole = noise + gain @ model.covariance_ @ gain.T + sd**2 * np.outer(ray, ray)
    return centre, covariance, gain.T @ np.linalg.inv(whole) @ gain, gain.T @ np.linalg.inv(whole) @ y


@pytest.mark.parametrize("all_known", [False, True])
def test_the_density_agrees_with_the_conditional_expectations_of_its_grasps(all_known: bool) -> None:
    rng, n = np.random.default_rng(2), 21
    at = np.repeat([0, 1, 2], 7)
    gap = rng.uniform(2, 15, n) * np.where(np.arange(n) % 3, 1, -1)
    gain = np.column_stack([gap, gap, np.ones(n)])
    x = np.array([[0.6, 0.3, 0.1], [0.4, 0.5, 0.9], [0.2, 0.2, -0.4]])[at]
    x = x + rng.standard_normal((n, 3)) @ [[0.05, 0.02, 0], [0, 0.04, 0.05], [0, 0, 0.1]]
    root = rng.standard_normal((n, 3, 3)) * [0.2, 0.3, 0.05]
    noise = np.einsum("gij,gik->gjk", root, root) + 1e-4 * np.eye(3)
    y = gain * x + np.column_stack([x[:, :2] * rng.normal(0, 1, (n, 1)), np.zeros(n)])
    y[[1, 9], 1], y[15, 2] = np.nan, np.nan
    sd = np.where(all_known | (np.arange(n) % 4 == 0), 0.7, np.nan)
    read = Readings(y, gain, noise, sd, gap)
    model = BayesClassifier(shrinkage=3.0)
    model.reader_, model.classes_ = FeatureReader(["a", "b", "c"], True, 10.0), np.array(list("xyz"))
    model._fit_density(read, at)

    weight = np.where(np.isfinite(y), (gap**2 / (gap**2 + 4))[:, None], np.nan)
    over = lambda rows, w: np.nansum(rows * w, axis=0) / np.nansum(w, axis=0)  # noqa: E731
    np.testing.assert_allclose(model.center_, over(y / gain, weight))
    within = y / gain - np.array([over((y / gain)[at == m], weight[at == m]) for m in range(3)])[at]
    freedom = np.nansum(weight, axis=0) - 3
    np.testing.assert_allclose(model.scale_, np.sqrt(np.nansum(weight * within**2, axis=0) / freedom))

    parts = [conditioned(model, read, at, g) for g in range(n)]
    kappa, total, left, off = model.mean_shrinkage_, 3.0 * np.eye(3), np.zeros((3, 3)), 0.0
    for g, (centre, covariance, _, _) in enumerate(parts):
        total += np.outer(centre[:3] - model.means_[at[g]], centre[:3] - model.means_[at[g]])
        left += covariance[:3, :3]
        off += 0 if np.isfinite(sd[g]) else centre[3] ** 2 + covariance[3, 3]
    for m in range(3):
        told, pull = (sum(parts[g][k] for g in np.flatnonzero(at == m)) for k in (2, 3))
        spread = np.linalg.inv(kappa * np.linalg.inv(model.covariance_) + told)
        np.testing.assert_allclose(model.mean_covariance_[m], spread, rtol=1e-3, atol=1e-6)
        np.testing.assert_allclose(model.means_[m], spread @ pull, rtol=1e-3, atol=1e-3)
        total += kappa * np.outer(model.means_[m], model.means_[m])
    np.testing.assert_allclose(model.covariance_, (total + left) / (3 + n + 2), atol=1e-3)
    guessed = np.trace(np.linalg.solve(model.covariance_, left)) / 3  # grasps whose features noise hides
    assert model.dof_ == pytest.approx(3 + n - guessed + 2, abs=0.01)
    unsure = int(np.isnan(sd).sum())  # beside four grasps of 0.5 K
    expected = np.sqrt((off + 4 * 0.25) / (4 + unsure)) if unsure else 0.5
    assert model.t_object_sd_ == pytest.approx(expected, abs=1e-3)


def test_evidence_is_that_of_the_grasps_one_after_another() -> None:
    """Each is Student-t distributed given those before it; what is left out does not depend on the priors."""
    rng = np.random.default_rng(5)
    at = np.array([0, 1, 1, 0, 2, 1, 0, 1])
    x = rng.standard_normal((8, 2)) @ [[1.0, 0.4], [0.0, 0.6]] + np.array([[2.0, 0], [0, 1], [-1, 3]])[at]

    def in_turn(extra: float, kappa: float) -> float:
        found, scatter, counts, sums = 0.0, extra * np.eye(2), np.zeros(3), np.zeros((3, 2))
        for i, (row, m) in enumerate(zip(x, at)):
            dof, have = extra + 3 + i - 1, kappa + counts[m]
            shape, mean = scatter * (have + 1) / (have * dof), sums[m] / have
            found += multivariate_t.logpdf(row, mean, shape, df=dof)
            scatter = scatter + np.outer(row - mean, row - mean) * have / (have + 1)
            counts[m], sums[m] = counts[m] + 1, sums[m] + row
        return float(found)

    counts = np.bincount(at).astype(float)
    means = np.array([x[at == m].mean(axis=0) for m in range(3)])
    within = (x - means[at]).T @ (x - means[at])
    priors = [(0.5, 0.1), (4.0, 0.02), (30.0, 2.0)]
    got = np.diff([_log_evidence_of_feature(within, means, counts, *prior) for prior in priors])
    np.testing.assert_allclose(got, np.diff([in_turn(*prior) for prior in priors]))


def test_an_unknown_temperature_is_integrated_over_what_it_may_be(make_touches: Maker) -> None:
    model = make_classifier("bayes").fit(make_touches(MATERIALS))
    asked = pick(make_touches(MATERIALS, t_object=33.0, seed=4), [1, 9, 20]).assign(
        t_ambient=("grasp", [25.0, 25.0, 25.0])
    )
    unknown = asked.assign(t_object=("grasp", [np.nan, 33.0, np.nan]))
    found = model._log_density(unknown)
    np.testing.assert_allclose(found[1], model._log_density(asked)[1])
    fine = np.arange(4.0, 47.0, 0.25)  # 5 to 45 degC, each end as blurred as the rest
    each = []
    for t in fine:
        at = asked.assign(t_object=("grasp", np.full(3, t)), t_object_sd=("grasp", np.full(3, 1.2)))
        each.append(model._log_density(at))
    inside = (fine >= 5) & (fine <= 45)
    expected = np.logaddexp.reduce(np.array(each)[inside], axis=0) - np.log(inside.sum())
    np.testing.assert_allclose(found[[0, 2]], expected[[0, 2]], rtol=0.01)
    p = model.predict_proba(unknown)
    assert p[0].max() < model.predict_proba(asked)[0].max()
    stated = asked.assign(t_object_sd=("grasp", np.full(3, 8.0)))
    bells = np.exp(-0.5 * ((fine - 33.0) / 8.0) ** 2)
    expected = np.logaddexp.reduce(np.array(each) + np.log(bells / bells.sum())[:, None, None], axis=0)
    np.testing.assert_allclose(model._log_density(stated), expected, rtol=0.015)


def test_a_material_that_was_not_trained_is_drawn_like_the_trained_ones(make_touches: Maker) -> None:
    model = make_classifier("bayes").fit(make_touches(MATERIALS))
    asked = pick(make_touches(MATERIALS, t_object=33.0, seed=4), [1, 9, 20])
    read, middle = model.reader_.read(asked), model.means_.mean(axis=0)
    between = 4 / 3 * np.cov(model.means_.T)
    zero = model.center_ / model.scale_
    for g in range(3):
        y = read.y[g] / model.scale_ - read.difference[g] * zero
        noise = read.noise[g] / np.outer(model.scale_, model.scale_)
        scale = read.difference[g] ** 2 * (between + model.covariance_) + noise
        scale = scale + model.t_object_sd_**2 * np.outer(middle + zero, middle + zero)
        expected = multivariate_t.logpdf(y, read.difference[g] * middle, scale, df=2)
        assert model._log_density(asked)[g, -1] == pytest.approx(expected)
    log_p, unknown = model.open_set_log_proba(asked, ["iron", "wood"])
    np.testing.assert_allclose(log_p, model.candidate_log_proba(asked, ["iron", "wood"]), atol=1e-12)
    density = model._log_density(asked)
    known = np.logaddexp(density[:, 1], density[:, 2]) - np.log(2)
    odds = np.exp(density[:, 3] - known) * 0.1 / 0.9
    np.testing.assert_allclose(unknown, odds / (1 + odds))
    np.testing.assert_array_equal(model.p_unknown(asked, ["iron", "wood"]), unknown)
    assert unknown[0] > 0.5 > unknown[1:].max()  # copper, which is no candidate


def test_nothing_seen_leaves_every_class_alike() -> None:
    assert _log_t(np.zeros((3, 0)), np.zeros((3, 0, 0)), 5.0).tolist() == [0.0] * 3


def test_the_answer_is_the_t_distribution_of_each_grasps_own_difference(make_touches: Maker) -> None:
    model = make_classifier("bayes").fit(make_touches(MATERIALS))
    asked = pick(make_touches(MATERIALS, t_object=31.0, seed=3, end=12.0, step=0.25), [2, 9, 20, 21])
    early = xr.DataArray([12.0, 12.0, 9.75, 12.0], dims="grasp")
    asked = asked.assign(t_object_sd=("grasp", [np.nan, 2.0, np.nan, 0.1]))
    asked = asked.assign(t_surface=asked["t_surface"].where(asked.time <= early))
    read, expected = model.reader_.read(asked), np.empty((4, 3))
    missing = np.isnan(read.y)
    assert read.t_object_sd.tolist()[1] == 2.0
    for g, m in np.ndindex(4, 3):
        has, gap = ~missing[g], float(read.difference[g])
        s = model.scale_[has]
        ray = model.means_[m][has] * s + model.center_[has]  # the normalised mean of the material
        sd = model.t_object_sd_ if g in (0, 2) else read.t_object_sd[g]
        block = (model.covariance_ + model.mean_covariance_[m])[np.ix_(has, has)] * np.outer(s, s)
        shape = gap**2 * block + sd**2 * np.outer(ray, ray) + read.noise[g][np.ix_(has, has)]
        expected[g, m] = multivariate_t.logpdf(read.y[g][has], gap * ray, shape, df=model.dof_)
    expected -= np.logaddexp.reduce(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(model.predict_log_proba(asked), expected, atol=1e-8)


@pytest.mark.parametrize("name", LEARNERS)
def test_the_smaller_the_difference_the_less_is_reported(name: str, make_touches: Maker) -> None:
    model = make_classifier(name).fit(make_touches(MATERIALS))
    sure = [
        model.predict_proba(make_touches(MATERIALS, t_object=t, seed=6, name=f"at {t}")).max(axis=1).mean()
        for t in (43.0, 25.0, 23.0)
    ]
    assert sure[0] > sure[1] > sure[2]
    assert sure[2] < 0.7  # levels scatter by 0.3 K about the object: metals and wood differ all the same


def test_errors_of_nominal_temperatures_are_learnt_where_differences_differ(make_touches: Maker) -> None:
    rng = np.random.default_rng(0)
    records = []
    for k, t in enumerate((43.0, 28.0, 18.0)):
        true = make_touches(("copper", "iron", "zinc"), each=20, t_object=t, seed=k, name=f"at {t}")
        gain = (t + rng.normal(0, 1.0, 60) - 23) / (t - 23)
        base = true["t_surface"].isel(time=slice(None, 7)).median("time")
        skin = base + (true["t_surface"] - base) * xr.DataArray(gain, dims="grasp")
        records.append(true.assign(t_surface=skin.transpose("grasp", "time")))
    model = make_classifier("bayes").fit(records)
    assert model.t_object_sd_ == pytest.approx(1.0, rel=0.3)


def test_bayes_learns_from_all_conditions_of_the_rig_together() -> None:
    """Its features were in kelvin for all of them, for the sake of the files without a difference."""
    records = [g for name, g in load_example_grasps().items() if name[:4] in ("exp1", "exp2", "exp3", "exp4")]
    train, test = ([pick(g, g["split"].values == which) for g in records] for which in ("train", "test"))
    model = make_classifier("bayes").fit(train)
    hits = {}
    for g in test:
        names = np.unique(g["material"].values.astype(str))
        best = model.candidate_log_proba(g, list(names)).argmax(axis=1)
        hits[str(g.attrs["name"])[:9]] = names[best] == g["material"].values
    assert np.concatenate(list(hits.values())).mean() > 0.8  # 0.29 to 0.58 by condition
    far = [hit for name, hit in hits.items() if name in ("exp2_dT15", "exp2_dT20", "exp3A_obj", "exp3B_obj")]
    assert np.concatenate(far).mean() > 0.9
    assert "change_40s" in model.feature_names_  # of one condition alone, and of use there


@pytest.mark.parametrize("name", LEARNERS)
def test_what_cannot_be_learnt_from_is_reported(name: str, make_touches: Maker) -> None:
    warm = make_touches(MATERIALS)
    unknown = make_touches(("iron", "zinc"), name="unknown").drop_vars("t_object")
    model = make_classifier(name).fit([warm, unknown])
    assert model.classes_.tolist() == list(MATERIALS)
    assert model.notes_ == [
        "zinc left out: no object of known temperature 1 K from the skin's",
        "8 grasps left out: their object temperature is unknown",
    ]
    assert "features stay in kelvin" in make_classifier(name).fit(unknown).notes_[0]
    assert make_classifier(name).fit(warm).notes_ == []


def test_conditions_of_other_rates_and_lengths_are_learnt_from_together(make_touches: Maker) -> None:
    records = [make_touches(MATERIALS), make_touches(MATERIALS, end=40.0, step=0.25, seed=2, name="long")]
    model = make_classifier("bayes").fit(records)
    assert {"change_10s", "change_40s"} <= set(model.feature_names_)
    assert min(right(model, g) for g in records) > 0.9
    assert model.shrinkage_ > 0
    with pytest.raises(UserError, match="labels for"):
        make_classifier("bayes").fit(records, ["a", "b"])
    with pytest.raises(UserError, match="shrinkage must be > 0"):
        make_classifier("bayes", shrinkage=-1.0).fit(records)
    assert join_grasps(records).sizes["time"] < records[0].sizes["time"]  # what the others learn from


def test_the_bayesian_predictive_is_the_t_distribution_of_its_formula(three: Grasps) -> None:
    kelvin = three.drop_vars("t_object")  # without differences there is neither noise nor a gain
    model = make_classifier("bayes").fit(kelvin)
    z = (model.reader_.read(kelvin).y - model.center_) / model.scale_
    counts = 8 + model.mean_shrinkage_
    log_p = np.column_stack(
        [
            multivariate_t.logpdf(z, mean, model.covariance_ * (1 + 1 / counts), df=model.dof_)
            for mean in model.means_
        ]
    )
    assert model.dof_ == pytest.approx(model.shrinkage_ + 24 + 2)
    assert model.t_object_sd_ == 0.0
    own = np.array([z[8 * m : 8 * m + 8].mean(axis=0) for m in range(3)])
    np.testing.assert_allclose(model.means_, own * 8 / counts, atol=1e-9)
    rest = z - np.repeat(own, 8, axis=0)
    tried = {
        (extra, kappa): _log_evidence_of_feature(rest.T @ rest, own, np.full(3, 8.0), extra, kappa)
        for extra in np.geomspace(0.5, 200, 25)
        for kappa in np.geomspace(0.001, 30, 16)
    }
    assert (model.shrinkage_, model.mean_shrinkage_) == pytest.approx(max(tried, key=tried.__getitem__))
    expected = log_p - np.logaddexp.reduce(log_p, axis=1, keepdims=True)
    np.testing.assert_allclose(model.predict_log_proba(kelvin), expected, atol=1e-8)


def test_materials_that_do_not_differ_get_equal_probabilities(make_touches: Maker) -> None:
    one = make_touches(("copper",), each=30)
    y = np.array(["a", "b", "c"])[np.arange(30) % 3]
    p = make_classifier("bayes").fit(one, y).predict_proba(make_touches(("copper",), seed=8))
    assert p.max() < 0.75


def test_a_grasp_counts_for_a_feature_by_its_own_gain() -> None:
    """The second is 20 K from half of the objects and 0.05 K from the others, where noise is all it reads."""
    rng, at = np.random.default_rng(0), np.repeat([0, 1], 20)
    gain = np.column_stack([np.full(40, 20.0), np.tile([20.0, 0.05], 20)])
    y = gain * np.array([[0.6, 0.3], [0.2, 0.1]])[at] + 0.05 * rng.standard_normal((40, 2))
    noise = np.tile(0.05**2 * np.eye(2), (40, 1, 1))
    model = BayesClassifier(shrinkage=3.0)
    model.reader_ = FeatureReader(["change_2s", "change_5s"], True, 10.0)
    model.classes_ = np.array(["x", "y"])
    model._fit_density(Readings(y, gain, noise, np.full(40, 0.01), gain[:, 0]), at)
    means = model.means_ * model.scale_ + model.center_
    np.testing.assert_allclose(means, [[0.6, 0.3], [0.2, 0.1]], atol=0.01)
    assert model.scale_.max() < 0.05  # noise over 0.05 K has an sd of 1
