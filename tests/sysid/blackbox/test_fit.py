"""Refits to resampled errors differ as refits to new logs of the same plant would."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import gmean

from tests.sysid.models.makers import steady_gain
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import make_log
from thermogrip.sysid import Plant, identify
from thermogrip.sysid.blackbox import fit as fitting
from thermogrip.sysid.blackbox.fit import BlackBoxFit, family_of, fit_black_box, with_refits
from thermogrip.sysid.blackbox.order_selection import Choice, Fold, StartPrior, Structure
from thermogrip.sysid.plant import log_grid
from thermogrip.sysid.plant.log_grid import Grid, Segment, make_grid
from thermogrip.sysid.validation.stated_errors import drawn_runs


def lagged_log(seed, n=1200, *, phi=0.9, noise=0.15):
    """Return a heater that warms a plate by 10 K, read through a sensor with a lag; the noise is AR(1)."""
    rng = np.random.default_rng(seed)
    q = np.repeat(rng.random(n // 20), 20)
    y = lfilter([0, 0.25], [1, -0.75], lfilter([0, 0.5], [1, -0.95], q))
    e = lfilter([np.sqrt(1 - phi**2)], [1, -phi], rng.standard_normal(n + 200))[200:] * noise
    return make_log(np.arange(float(n)), {"q": (q, "1", "input"), "t": (25 + y + e, "degC", "output")})


def fit_of(kind, log, **orders):
    """Return the fit of the first structure of these orders, which needs no choosing."""
    grid = make_grid([log], average=1.0)
    structure, model = next(iter(family_of(kind)(grid, **{k: (v,) for k, v in orders.items()}).items()))
    choice = Choice(structure, StartPrior(), {}, (), np.zeros((1, 1)), warmup=5, model=model)
    return BlackBoxFit(kind, Plant(model, {}, dt=1.0), choice, grid)


def slowest(model):
    return -model.dt / np.log(np.abs(model.poles()).max())


@pytest.mark.slow
@pytest.mark.parametrize("rows", [1200, 600])
@pytest.mark.parametrize(
    ("kind", "orders"), [("oe", {"poles": 2, "delays": 2}), ("subspace", {"orders": 2, "rows": 15})]
)
def test_refits_spread_as_fits_to_new_logs_do(kind, orders, rows):
    fitted, spread = [], []
    for seed in range(16):
        fit = fit_of(kind, lagged_log(seed, rows), **orders)
        drawn = [plant.model for plant in map(with_refits(fit, 12, seed=seed).draw, range(1, 13))]
        fitted.append([steady_gain(fit.choice.model)[0, 0], slowest(fit.choice.model)])
        spread.append([[steady_gain(m)[0, 0] for m in drawn], list(map(slowest, drawn))])
    from_logs = np.std(fitted, axis=0, ddof=1)
    from_refits = np.sqrt(np.mean(np.var(spread, axis=2, ddof=1), axis=0))
    # the sd of 16 values is known to 1/sqrt(30) = 18 %: three such either way
    assert np.all(np.abs(np.log(from_refits / from_logs)) < 0.55)


def curved_log(seed, n=900):
    """Return a heater whose losses grow with its temperature, read with AR(1) noise, and its true outputs."""
    rng = np.random.default_rng(seed)
    q, x = np.repeat(rng.random(n // 20), 20), np.zeros(n)
    for k in range(n - 1):
        x[k + 1] = x[k] + 0.08 * (10 * q[k] - x[k]) - 0.004 * x[k] ** 2
    e = 0.1 * lfilter([np.sqrt(1 - 0.81)], [1, -0.9], rng.standard_normal(n + 200))[200:]
    pairs = {"q": (q, "1", "input"), "t": (25 + x + e, "degC", "output")}
    return make_log(np.arange(float(n)), pairs), 25 + x


@pytest.mark.slow
def test_refits_of_sparse_equations_spread_as_fits_to_new_logs_do_and_cover_the_truth():
    fresh, true = curved_log(99)
    u, none = fresh["q"].values[None, :, None], np.zeros((1, 900, 0))

    def run(model):
        return model.rollout(model.rest([25.0], [0.0], [], ())[None], u, none, (), 1.0)[0][0, 40:-1, 0]

    fitted, spread = [], []
    for seed in range(10):
        fit = fit_of("sindy", curved_log(seed)[0], degrees=2, memories=1, thresholds=0.0)
        plant = with_refits(fit, 8, seed=seed)
        fitted.append(run(fit.choice.model))
        spread.append(np.var([run(plant.draw(k).model) for k in range(1, 9)], axis=0, ddof=1))
    ratio = np.sqrt(np.mean(spread) / np.mean(np.var(fitted, axis=0, ddof=1)))
    # an sd of 10 values is known to 1/sqrt(18) = 24 %: three such either way
    assert abs(np.log(ratio)) < 0.7
    # noise that is not white biases a regression: half a sd of one log, seen over ten
    sd = np.sqrt(np.mean(spread, axis=0))
    inside = [np.mean(np.abs(v - true[40:]) < 1.645 * sd) for v in fitted]
    assert np.mean(inside) > 0.6


def test_a_black_box_of_identify_can_be_drawn_saved_and_loaded(tmp_path):
    log = lagged_log(0)
    plant = identify(log, models=["oe"], average=1.0, draws=10).plant
    again = Plant.load(plant.save(tmp_path / "plant.json"))
    assert plant.uncertain
    assert len(again.refits) == 10
    for k in (1, 4):
        want, got = (p.draw(k).simulate(log)["t"].values for p in (plant, again))
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-12)
        assert np.abs(want - plant.simulate(log)["t"].values).max() > 1e-4
    assert plant.draw(0) is plant
    assert len(list(drawn_runs(plant, log))) == 30


@pytest.mark.parametrize("kind", ["arx", "oe", "subspace"])
def test_inputs_that_were_logged_behind_their_reading_are_found_out(kind, tmp_path):
    rng = np.random.default_rng(3)
    q = rng.random(700)
    y = 25 + lfilter([0, 2.0], [1, -0.6], q) + 0.02 * rng.standard_normal(700)

    def log_with(q):
        return make_log(np.arange(700.0), {"q": (q, "1", "input"), "t": (y, "degC", "output")})

    kept, behind = log_with(q), log_with(np.append(q[:1], q[:-1]))  # of each row the input of the row before
    assert not fit_black_box(kind, [kept], average=1.0).plant.inputs_end_at_row
    plant = fit_black_box(kind, [behind], average=1.0).plant
    assert plant.inputs_end_at_row
    loaded = Plant.load(plant.save(tmp_path / "plant.json"))
    assert loaded.inputs_end_at_row
    for some in (plant, loaded):
        miss = some.simulate(behind, warmup=20.0)["t"].values - y
        assert np.std(miss[20:]) < 0.025  # of 2 K that the input moves it


def test_short_logs_are_not_resampled_and_that_is_reported():
    log = lagged_log(0, 140, noise=0.02)
    with pytest.raises(UserError, match="140 rows of 1 s are too few to resample their errors"):
        with_refits(fit_black_box("arx", [log], average=1.0))
    found = identify(log, models=["arx"], average=1.0)
    assert not found.plant.uncertain
    assert any("no draws" in note for note in found.notes)


def test_a_plant_slower_than_its_errors_is_refitted():
    rng = np.random.default_rng(2)
    q, e = np.repeat(rng.random(16), 50), lfilter([0.6], [1, -0.8], rng.standard_normal(800))
    y = lfilter([0, 0.01], [1, -1.96, 0.9604], q) + 0.02 * e  # two lags of 25 s
    log = make_log(np.arange(800.0), {"q": (q, "1", "input"), "t": (25 + y, "degC", "output")})
    refits = with_refits(fit_of("oe", log, poles=2, delays=1), 6).refits
    assert len(refits) == 6
    assert abs(np.mean([steady_gain(m)[0, 0] for m in refits]) - 25.0) < 0.5


def test_kinds_whose_fit_takes_long_are_refused():
    fit = fit_of("oe", lagged_log(0), poles=2, delays=2)
    with pytest.raises(ValueError, match="neural is not refitted"):
        with_refits(replace(fit, kind="neural"))


def stub_grid(rows=(400,), dt=1.0, **more):
    parts = [
        Segment(np.arange(float(n)), np.outer(np.arange(n) % 2, [4.0, 20.0]), *2 * [np.zeros((n, 0))], log)
        for n, log in zip(rows, "abcd")
    ]
    return Grid((), (), ("s", "t"), (), dt, tuple(parts), 0.5, {"s": "K", "t": "V"}, **more)


@pytest.mark.parametrize(
    ("rows", "dt", "expected"),
    [
        ((100, 100, 120), 0.5, 10),  # 5 s of whole logs
        ((1000, 900), 2.0, 12),  # 50 samples of 0.5 s, 12.5 steps
        ((111,), 1.0, 6),  # a sixteenth of the rows
        ((20,), 1.0, 2),
    ],
)
def test_the_warm_up_is_five_seconds_of_whole_logs_and_fifty_samples_of_parts(rows, dt, expected):
    assert fitting._warmup_rows(stub_grid(rows, dt)) == expected


@pytest.mark.parametrize(("dt", "share"), [(2.0, 0.24), (20.0, 1.0)])  # (1 + 19 dt / 10) of 20 readings
def test_a_plant_keeps_what_the_choice_found(monkeypatch, dt, share):
    monkeypatch.setattr(fitting, "reading_excess", lambda logs, names, dt: {names[0]: dt, names[1]: 0.0})
    monkeypatch.setattr(fitting, "rows_of", lambda *_: None)
    grid, rmse = stub_grid((100, 60), dt, why="so", ends=True), np.array([[3.0, 1.0], [4.0, 7.0]])
    model = fit_of("oe", lagged_log(0, 100), poles=1, delays=1, terms=()).plant.model
    model = replace(model, outputs=("s", "t"), C=np.ones((2, model.n_x)), y0=np.zeros(2))
    prior = StartPrior(noise=0.1, nuisance=0.3)
    folds = (Fold("a", grid, ()), Fold("b", grid, ()))
    choice = Choice(Structure("lag", 3), prior, {}, folds, rmse, warmup=19, model=model)
    plant = fitting._plant(grid, choice, [lagged_log(0, 100)])
    assert plant.noise == pytest.approx({"s": 0.2 * share**0.5, "t": share**0.5})
    assert plant.nuisance == pytest.approx({"s": 0.6, "t": 3.0})
    assert (plant.units, plant.valid) == ({"s": "K", "t": "V"}, {"s": (0.0, 4.0), "t": (0.0, 20.0)})
    assert (plant.dt, plant.logs, plant.inputs_end_at_row) == (dt, ("a", "b"), True)
    scores = plant.scores
    assert (scores.structure, scores.average_s, scores.average_why) == ("lag", dt, "so")
    # errors of readings: those of means and by how much a reading lies off its mean
    assert scores.held_out_by_part["s"] == pytest.approx(np.hypot([3.0, 4.0], dt).tolist())
    assert scores.held_out_by_part["t"] == [1.0, 7.0]
    assert scores.reading_excess == {"s": dt, "t": 0.0}
    assert scores.reading_sd == {"s": np.inf, "t": 0.0}


@pytest.mark.parametrize(
    ("kind", "dt", "rows", "average", "errors", "kept"),  # by step, None: refused
    [
        ("arx", 2.0, 2000, None, {2.0: 0.3, 0.5: 0.2}, 0.5),
        ("arx", 2.0, 2000, None, {2.0: 0.2, 0.5: 0.2}, 2.0),
        ("arx", 2.0, 2000, None, {2.0: None, 0.5: 0.9}, 0.5),
        ("arx", 2.0, 2000, None, {2.0: 0.9, 0.5: None}, 2.0),
        ("arx", 2.0, 2000, None, {2.0: None, 0.5: None}, None),
        ("arx", 2.0, 2001, None, {2.0: 0.3}, 2.0),  # 8004 rows of the log
        ("arx", 0.75, 540, None, {0.75: 0.3, 2.5: 0.2}, 2.5),  # 810 rows of the log: five of them too
        ("arx", 0.75, 530, None, {0.75: 0.3}, 0.75),
        ("oe", 2.0, 400, 2.0, {2.0: 0.3}, 2.0),
        ("sindy", 2.0, 400, None, {2.0: 0.3}, 2.0),
        ("neural", 2.0, 400, None, {2.0: 0.3}, 2.0),
    ],
)
def test_a_second_step_is_tried_beside_the_chosen_one(monkeypatch, kind, dt, rows, average, errors, kept):
    tried, said = [], []

    def choose_by_step(grid, family, *, warmup, progress):
        tried.append(grid.dt)
        progress(0.5, "x")
        if errors[grid.dt] is None:
            raise UserError(f"at {grid.dt:g} s")
        return SimpleNamespace(error=errors[grid.dt])

    for module in (fitting, log_grid):
        monkeypatch.setattr(module, "make_grid", lambda *a, average, **n: stub_grid((rows,), average or dt))
    monkeypatch.setattr(fitting, "choose", choose_by_step)
    monkeypatch.setattr(fitting, "_within_steps", lambda *grids: 0.0)
    monkeypatch.setattr(fitting, "_with_convention", lambda kind, grid, choice, *more: (grid, choice))
    monkeypatch.setattr(fitting, "_plant", lambda *parts: None)

    def fit():
        return fit_black_box(kind, [], average=average, progress=lambda *what: said.append(what))

    if kept is None:
        with pytest.raises(UserError, match=r"at 2 s"):
            fit()
    else:
        found = fit()
        assert (found.kind, found.grid.dt, found.choice.error) == (kind, kept, errors[kept])
        better = "free runs over held-out parts err less than at"
        whys = {0.5: f"the logs' own: {better} 2 s", 2.5: f"five rows: {better} 0.75 s"}
        assert found.grid.why == whys.get(kept, "")
    assert tried == list(errors)
    assert said == [((k + 0.5) / len(errors), f"{kind}, x") for k in range(len(errors))]


def test_errors_of_means_are_compared_as_errors_of_the_readings_that_were_averaged():
    """A block that swings within five rows has no error left in its means, and all of it in its readings."""
    t = np.arange(1000.0)
    q = np.repeat([0.0, 1.0] * 50, 10)
    y = np.sin(2 * np.pi * t / 5) + 0.2 * q
    log = make_log(t, {"q": (q, "1", "input"), "t": (y, "degC", "output")})
    fine, coarse = (make_grid([log], average=step) for step in (1.0, 5.0))
    assert fitting._within_steps(fine, [fine, coarse]) == 0.0
    assert fitting._within_steps(coarse, [fine, coarse]) == pytest.approx(0.98, abs=0.03)


@pytest.mark.parametrize(("agree", "n"), [(6, 6), (1, 2), (0, 6)])  # of the tries after the first
def test_refits_that_err_more_than_half_as_much_again_are_left_out(monkeypatch, agree, n):
    made = []

    def family(grid, *, only, searches):
        made.append((only, len(grid.segments)))
        return {only[0]: None if len(made) == 1 else len(made)}

    errors = {0: 0.2, **{k: 0.3 if k <= agree + 1 else 0.301 for k in range(1, 99)}}
    monkeypatch.setattr(fitting, "family_of", lambda kind: family)
    monkeypatch.setattr(fitting, "_error", lambda fit, model: errors[model])
    monkeypatch.setattr(fitting, "_misses", lambda fit: [np.zeros((320, 1))])
    plant = fit_of("arx", lagged_log(0, 320), poles=1, delays=1, terms=()).plant
    choice = SimpleNamespace(structure="s", model=0)
    fit, said = BlackBoxFit("oe", plant, choice, stub_grid((320,))), []
    if agree < n:
        tried = {1: 6, 0: 8}[agree]  # as many as three a draw, or eight of which none agrees
        with pytest.raises(UserError, match=f"oe: of {tried} refits to resampled errors only {agree} agree"):
            with_refits(fit, n)
    else:
        found = with_refits(fit, n, progress=lambda *what: said.append(what))
        assert found.refits == tuple(range(2, n + 2))
        assert said == [(k / n, "oe, refits to resampled errors") for k in (0, *range(n))]
    assert (set(made), len(made)) == ({(("s",), 1)}, 7 if agree == n else tried)


@pytest.mark.parametrize("kind", ["arx", "oe", "subspace"])
def test_rounding_of_the_readings_changes_no_choice(kind):
    rng = np.random.default_rng(2)
    q, noise = np.repeat([2.0, 3.0], [2, 598]), 0.3 * lfilter([1.0], [1, -0.8], rng.standard_normal(600))
    y = 25 + lfilter([0, 0.8], [1, -0.98], q) + lfilter([0, 0.3], [1, -0.9], q) + noise
    found = []
    for size in (0.0, 1e-12):
        off = 1 + size * rng.standard_normal((2, 600))
        signals = {"q": (q * off[0], "1", "input"), "t": (y * off[1], "degC", "output")}
        log = make_log(np.arange(600.0), signals)
        found.append(fit_black_box(kind, [log], average=1.0).choice)
    assert found[0].structure == found[1].structure
    assert found[0].prior == found[1].prior
    for structure, errors in found[0].errors.items():
        np.testing.assert_allclose(found[1].errors[structure], errors, rtol=0.03)


def board_log(seed, name, n=1500):
    """Two readings of a heated block in a room that hardly changes; the pump never stops."""
    rng = np.random.default_rng(seed)
    q, room = np.repeat(2 * rng.random(n // 20) - 1, 20), 26 + 0.3 * np.sin(np.arange(n) / 300 + seed)
    t, s = (
        room + lfilter([0, 0.4], [1, -0.98], q + 0.5 * np.abs(q)) + 0.05 * rng.standard_normal(n)
        for _ in range(2)
    )
    signals = {"q": (q, "1", "input"), "pump": (np.ones(n), "1", "input"), "t": (t, "degC", "output")}
    signals |= {"room": (room, "degC", "disturbance"), "s": (s, "degC", "output")}
    return make_log(np.arange(float(n)), signals, name=name)


@pytest.mark.parametrize("kind", ["arx", "oe"])
def test_rounding_gives_an_input_that_never_moves_no_gain_in_any_structure(kind):
    models = family_of(kind)(make_grid([board_log(0, "a"), board_log(1, "b")], average=2.0))
    still = [model.inputs.index("pump") for model in models.values()]
    gains = [m.C @ np.linalg.solve(np.eye(m.n_x) - m.A, m.B)[:, at] for m, at in zip(models.values(), still)]
    assert max(np.abs(gain).max() for gain in gains) == 0.0


@pytest.mark.parametrize(("joule", "kept"), [(0.6, True), (0.0, False)])
@pytest.mark.parametrize(
    "kind", ["oe", *(pytest.param(k, marks=pytest.mark.slow) for k in ("subspace", "arx"))]
)
def test_the_square_of_a_heater_s_drive_is_kept_where_the_folds_show_it(kind, joule, kept):
    rng = np.random.default_rng(1)
    u = np.repeat(rng.random(60), 20)
    y = 25 + lfilter([0, 0.5], [1, -0.9], joule * u**2 + (1 - joule) * u)
    signals = {"q": (u, "1", "input"), "t": (y + 0.02 * rng.standard_normal(len(u)), "degC", "output")}
    found = fit_black_box(kind, [make_log(np.arange(float(len(u))), signals)], average=1.0)
    errors = {s: gmean(e) for s, e in found.choice.errors.items() if np.isfinite(e).all()}
    plain = min(error for s, error in errors.items() if "with q*q" not in s.label)
    if kept:
        assert found.plant.model.terms == ("q*q",)
        assert found.choice.error < 0.5 * plain
    else:
        assert found.choice.error < 1.05 * plain
        assert found.plant.model.terms == ()
