"""A right model is suspected once in a hundred; delays, capacities and losses that curve are found."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import cho_factor, cho_solve
from scipy.signal import lfilter
from scipy.stats import binom

from thermogrip.datasets.schema import Log, columns, make_log
from thermogrip.sysid.greybox.noise_model import Block, band_weights
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.fit_record import PlantScores
from thermogrip.sysid.plant.log_grid import Stretch, at_rows, cut_stretches
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.plant.simulation import Start
from thermogrip.sysid.validation import residual_tests as tests
from thermogrip.sysid.validation.free_run import FreeRun, free_run
from thermogrip.sysid.validation.residual_tests import (
    Correlation,
    CorrelationTest,
    ResidualCorrelations,
    SlowNoise,
    _significant,
    autocorrelation,
    cross_correlation,
    learn_slow_noise,
    residual_correlations,
)

N = 1500


def heater(pole: float = 0.98) -> Plant:
    model = StateSpaceModel(
        ("q",), (), ("t",), A=[[pole]], B=[[5 * (1 - pole)]], C=[[1.0]], dt=1.0, spread=[[0.25]]
    )
    return Plant(model, {}, dt=1.0, noise={"t": 0.05})


def steps(rng: np.random.Generator) -> np.ndarray:
    return np.repeat(rng.random(N // 250), 250)


def pulses(rng: np.random.Generator) -> np.ndarray:
    return np.repeat(rng.integers(0, 2, N // 20).astype(float), 20)


def slow(rng: np.random.Generator, keep: float, sd: float = 0.05) -> np.ndarray:
    noise = lfilter([1.0], [1.0, -keep], rng.standard_normal(N + 2000))[2000:]
    return np.asarray(sd * np.sqrt(1 - keep**2) * noise)


def log_of(q: np.ndarray, t: np.ndarray) -> Log:
    return make_log(np.arange(float(len(q))), {"q": (q, "1", "input"), "t": (t, "degC", "output")})


def heated(q: np.ndarray, plant: Plant, start: float = 0.0) -> np.ndarray:
    y, _ = plant.model.rollout([[start]], q[None, :, None], np.zeros((1, len(q), 0)), (), 1.0)
    return np.asarray(y[0, :-1, 0])


def correlations(plant: Plant, log: Log, warmup: float = 5.0) -> ResidualCorrelations:
    run, stretches = plant.simulate(log, warmup), cut_stretches(plant, log)
    scored = run["scored"].values > 0
    return residual_correlations(plant, stretches, columns(run, plant.outputs), scored, warmup=warmup)


def signals_of(plant: Plant, log: Log, warmup: float = 20.0) -> dict[str, CorrelationTest]:
    return correlations(plant, log, warmup).tests["t"]


def suspected(run: FreeRun) -> bool:
    return any("correlates with" in note for note in run.notes)


@pytest.mark.slow
@pytest.mark.parametrize(("drive", "keep"), [(steps, 0.0), (pulses, 0.95), (steps, 0.998), (pulses, 0.998)])
def test_a_right_model_is_suspected_once_in_a_hundred(drive, keep: float):
    # white noise, and errors that last for 20 s and for a third of the log; two signals each (input, square)
    rng, plant, count = np.random.default_rng(3), heater(), 0
    for _ in range(40):
        q = drive(rng)
        count += any(
            f.significant for f in signals_of(plant, log_of(q, heated(q, plant) + slow(rng, keep))).values()
        )
    assert count <= binom.ppf(0.999, 40, 0.01)


def test_a_start_that_the_warmup_did_not_determine_is_reported_and_no_term_is_suspected():
    # the sensor lags the heater by 20 s: five seconds of readings hardly identify a heater 2 K warmer
    lag, cool = 0.95, 0.99
    A, B, C, spread = [[cool, 0.0], [1 - lag, lag]], [[0.05], [0.0]], [[0.0, 1.0]], np.diag([4.0, 0.25])
    model = StateSpaceModel(("q",), (), ("t",), A=A, B=B, C=C, dt=1.0, spread=spread)
    plant, rng = Plant(model, {}, dt=1.0, noise={"t": 0.05}), np.random.default_rng(5)
    reported = 0
    for _ in range(20):
        q = pulses(rng)
        x0 = [[2 * rng.standard_normal(), 0.0]]
        y = model.rollout(x0, q[None, :, None], np.zeros((1, N, 0)), (), 1.0)[0][0, :-1, 0]
        log = log_of(q, y + 0.05 * rng.standard_normal(N))
        short, long = free_run(plant, log), free_run(plant, log, 60.0, 60.0)
        assert not suspected(short)
        assert not suspected(long)
        assert not any("is the start" in note for note in long.notes)
        stated = [note for note in short.notes if "is the start" in note]
        if stated:  # that share goes with a longer warm-up; errors of 60 s are left in the short one
            share = float(stated[0].split()[1]) / 100
            gone = 1 - (long.scores["t"].rmse / short.scores["t"].rmse) ** 2
            assert share == pytest.approx(gone, abs=0.08)
        reported += bool(stated)
    assert reported >= 10


def test_uncertain_parameters_are_no_missing_term():
    # the gain is 3 % off, as its covariance says it may be; a plant that is sure of it is suspected
    rng, wrong = np.random.default_rng(6), heater()
    q = pulses(rng)
    log = log_of(q, 1.03 * heated(q, wrong) + slow(rng, 0.0))
    model = wrong.model
    refits = tuple(replace(model, B=np.asarray(model.B) * (1 + 0.03 * z)) for z in rng.standard_normal(24))
    assert signals_of(wrong, log)["q"].significant
    assert not signals_of(replace(wrong, refits=refits), log)["q"].significant


@pytest.mark.parametrize("seconds", [2, 5])
def test_a_delay_that_the_model_lacks_is_found(seconds: int):
    rng, plant = np.random.default_rng(7), heater()
    for _ in range(5):
        q = pulses(rng)
        late = np.append(np.zeros(seconds), heated(q, plant)[:-seconds])
        assert signals_of(plant, log_of(q, late + slow(rng, 0.0)))["q"].significant


def test_a_second_capacity_is_found_and_its_size_is_right():
    # 0.1 K per unit of input that comes with 100 s, twice the noise at most
    rng, plant = np.random.default_rng(8), heater()
    for _ in range(5):
        q = pulses(rng)
        more = lfilter([0.0, 0.01], [1.0, -0.99], 0.4 * q)
        found = signals_of(plant, log_of(q, heated(q, plant) + more + slow(rng, 0.0)))["q"]
        assert found.significant
        assert found.size == pytest.approx(np.std(more[20:]), rel=0.35)


def test_a_loss_that_curves_is_named_as_the_square_of_the_output():
    rng, plant = np.random.default_rng(9), heater()
    for _ in range(5):
        q = steps(rng)
        y = heated(q, plant)
        loss = lfilter([0.0, 0.02], [1.0, -0.98], 0.1 * (y - y.mean()) ** 2)
        found = signals_of(plant, log_of(q, y - loss + slow(rng, 0.0)))
        assert found["t squared"].significant
        assert found["t squared"].p < found["q"].p


def test_a_log_with_a_gap_and_lost_readings_is_tested_on_both_sides():
    rng, plant = np.random.default_rng(11), heater()
    q = pulses(rng)
    y = heated(q, plant) + slow(rng, 0.0)
    y[rng.random(N) < 0.1] = np.nan
    keep = np.r_[0:600, 640:N]
    run = free_run(plant, log_of(q, y).isel(time=keep), 20.0, 20.0)
    assert not suspected(run)
    late = np.append(np.zeros(5), heated(q, plant)[:-5]) + slow(rng, 0.0)
    only = np.where(np.arange(N) < 640, heated(q, plant) + slow(rng, 0.0), late)  # late after the gap alone
    assert suspected(free_run(plant, log_of(q, only).isel(time=keep), 20.0, 20.0))


def test_what_cannot_be_tested_is_left_alone():
    plant, q = heater(), pulses(np.random.default_rng(12))
    own = log_of(q, heated(q, plant))
    assert free_run(plant, own).residual.start.keys() <= {"t"}  # its own simulation: nothing is left
    short = log_of(q, heated(q, plant) + 0.1).isel(time=slice(0, 15))
    assert correlations(plant, short).tests == {}
    slow_rows = log_of(q, heated(q, plant) + 0.1 * q).isel(time=slice(0, 160, 4))  # 40, slower than the plant
    found = correlations(plant, slow_rows).tests["t"]
    assert found.keys() == {"q", "t squared"}
    wild = heater(1.5)  # it diverges
    assert free_run(wild, own).residual.tests == {}


def test_products_in_cosine_coordinates_are_those_of_the_covariance_in_time():
    noise, n = SlowNoise(0.5, (1.0, 0.7), (3.0, 20.0)), 200
    lag = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    V = 0.25 * np.eye(n)
    for a, tau in zip(noise.sd, noise.tau):
        fine = np.arange(40) / 40 + 0.0125  # the mean over a block, as a sum
        kernel = [np.exp(-np.abs(k + fine[:, None] - fine[None]) / tau).mean() for k in range(n)]
        V += a**2 * np.array(kernel)[lag]
    X = np.column_stack([np.repeat(np.random.default_rng(14).random(20), 10), np.linspace(0, 1, n)])
    want = X.T @ cho_solve(cho_factor(V), X)
    got = noise.products([Block.of(X[:, None, :], (0,))])
    np.testing.assert_allclose(got, want, rtol=0.1)


def test_an_input_that_the_fit_has_not_seen_like_that_is_no_missing_term():
    rng, plant = np.random.default_rng(16), heater()
    q = pulses(rng)
    late = np.append(np.zeros(5), heated(q, plant)[:-5]) + slow(rng, 0.0)
    run = free_run(replace(plant, valid={"q": (0.0, 0.5)}), log_of(q, late))
    note = next(note for note in run.notes if "correlates with q" in note)
    assert note.endswith("the fit has not seen q as here, so this need not be a term that is missing")


def test_a_plant_that_errs_more_than_its_fit_did_is_reported():
    # a plate that fills over 400 s, many times the noise of a mean
    rng, plant = np.random.default_rng(17), heater()
    q = pulses(rng)
    fitted = PlantScores(average_s=5.0, in_sample_rmse={"fit": {"t": 0.022}})
    plant = replace(plant, noise={"t": 0.05 / np.sqrt(5)}, scores=fitted)
    plate = lfilter([0.0, 1 / 400], [1.0, -1 + 1 / 400], 2.0 * q)
    noise = slow(rng, 0.0)
    excess = free_run(plant, log_of(q, heated(q, plant) + plate + noise), 20.0, 20.0)
    stated = [note for note in excess.notes if note.startswith("t: means over 5 s err by")]
    assert len(stated) == 1
    assert "0.022 degC in the fit" in stated[0]
    assert excess.exceeds_fit["t"] > 2.0
    same = free_run(plant, log_of(q, heated(q, plant) + noise), 20.0, 20.0)
    assert same.exceeds_fit == {}


@pytest.mark.parametrize(
    ("p", "significant"),
    [((0.0099,), "x"), ((0.01,), "-"), ((0.0033, 0.0049, 0.0099), "xxx"), ((0.0034, 1e-9, 0.0099), "xxx"),
     ((0.0034, 0.004, 0.0001), "xxx"), ((0.0033, 0.0051, 0.0099), "x--"), ((0.0034, 0.0035, 0.9), "---"),
     ((0.9, 0.5, 0.001), "--x")],
)  # fmt: skip
def test_one_right_model_in_a_hundred_is_suspected_by_any_of_its_tests(
    p: tuple[float, ...], significant: str
) -> None:
    found = _significant({f"y{k}": {"u": CorrelationTest(value, 1.0)} for k, value in enumerate(p)})
    assert "".join("x" if row["u"].significant else "-" for row in found.values()) == significant


def stretch(n: int, u: float | np.ndarray = 0.0, d: float | None = None) -> Stretch:
    room = np.zeros((n, 0)) if d is None else np.full((n, 1), d)
    return Stretch(slice(0, n), np.arange(float(n)), np.zeros((n, 1)), np.zeros((n, 1)) + u, room, 0.0, "a")


def in_blocks(rows: Stretch, residual: np.ndarray, start: Start | None = None) -> tests._Tested:
    """A stretch in blocks of a row."""
    start = start or Start(np.zeros(1), np.zeros(1), np.zeros(1), np.zeros(1), None, 0.0, "")
    return tests._Tested(rows, start, tests._Blocks(rows, residual, 1.0), after_gap=False)


def test_blocks_are_means_where_read_and_lines_between():
    # cells of 2 s from the first reading on: readings of the 3rd and 5th block are lost
    time, values = np.arange(46.0), np.arange(46.0) ** 2
    residual = np.zeros((46, 1))
    residual[[0, 1, 8, 9, 12], 0] = np.nan
    rows = stretch(46)
    blocks = tests._Blocks(rows, residual, 2.0)
    assert (blocks.n, blocks.enough) == (22, True)
    got = blocks.of_readings(values[:, None, None])[:, 0, 0]
    assert got[[0, 2, 3, 5, 21]].tolist() == [6.5, 42.5, (42.5 + 110.5) / 2, 169.0, 1980.5]
    assert blocks.of_inputs(values[:, None])[[0, 3, 5, 21], 0].tolist() == [6.5, 72.5, 156.5, 1980.5]
    for end, enough in ((44, True), (42, False)):  # twenty with readings, and nineteen
        part = np.where(time[:, None] < end, residual, np.nan)
        assert tests._Blocks(rows, part, 2.0).enough == enough
    assert tests._Blocks(rows, np.full((46, 1), np.nan), 2.0).n == 0


@pytest.mark.parametrize(
    ("off", "tested"),
    [(1.0, True), (2.01e6, False), (1.99e6, True), (1.9e-9, False), (2.1e-9, True), (np.inf, False)],
)
def test_a_run_that_diverged_or_made_the_log_has_no_residual(off, tested):
    read = np.where(np.arange(10) % 2 > 0, 2.0, 0.0)  # they range over 2 K
    read, scored = read[:, None], np.arange(10.0) > 2
    found = tests._residual(read, read - off, scored)
    assert (found is not None) == tested
    if found is not None:
        np.testing.assert_allclose(found[:, 0], np.where(scored, off, np.nan), rtol=1e-6)
    assert tests._residual(read, read - off, scored & False) is None


def test_noise_is_the_most_likely_under_the_stated_priors():
    # medians of the sizes, and of the times: 3 blocks and a twelfth of the series, 9 blocks at least
    rng = np.random.default_rng(20)
    for n in (60, 240):
        x, e = np.linspace(-1, 1, n), 0.3 * rng.standard_normal(n) + 0.5 * slow(rng, 0.9, 1.0)[:n]
        block = Block.of(np.column_stack([x, e])[:, None, :], (0,))

        def cost(v, block=block, n=n):
            noise = SlowNoise(v[0], (v[1], v[2]), (v[3], v[4]))
            P = np.tensordot(1 / noise.variances(n), block.products[:, 0, 0], axes=1)
            z = np.log(np.divide(v, [0.3, 0.5, 0.5, 3.0, max(n / 12, 9.0)])) / [2.0, 2.0, 2.0, 1.0, 1.2]
            like = block.sizes @ np.log(noise.variances(n)) + P[1, 1] - P[0, 1] ** 2 / (1 + P[0, 0])
            return 0.5 * (like + np.log(1 + P[0, 0]) + z @ z)

        found = learn_slow_noise([block])
        best = np.array([found.white, *found.sd, *found.tau])
        slopes = [cost(best * np.exp(d)) - cost(best * np.exp(-d)) for d in 0.03 * np.eye(5)]
        np.testing.assert_allclose(slopes, 0.0, atol=0.004)
    assert SlowNoise(0.0, (0.0, 0.0), (1.0, 1.0)).variances(4).tolist() == [1e-6] * len(band_weights(4))


@pytest.mark.parametrize(
    ("H", "g", "p", "beta"),
    [([[4.0]], [4.0], 0.0455003, [1.0]),  # (4 / 2)^2 of one degree of freedom
     ([[4.0, 0.0], [0.0, 25.0]], [4.0, 5.0], np.exp(-2.5), [1.0, 0.2]),  # 4 + 1 of two: exp(-5 / 2)
     ([[4.0, 4.0], [4.0, 4.0]], [4.0, 4.0], 0.0455003, [0.5, 0.5]),  # the other once more
     ([[0.0, 0.0], [0.0, 0.0]], [1.0, 1.0], 1.0, [0.0, 0.0]),
     ([[0.0, 0.0], [0.0, 4.0]], [9.0, 4.0], 0.0455003, [0.0, 1.0])],
)  # fmt: skip
def test_scores_of_one_direction_and_of_two(H, g, p, beta):
    found, size = tests._score_test(np.array(H), np.array(g))
    assert found == pytest.approx(p, rel=1e-5)
    np.testing.assert_allclose(size, beta, atol=1e-12)


def test_directions_of_a_start_that_move_nothing_or_diverge_are_left_out():
    moves = np.zeros((25, 1, 4))
    moves[0, 0], moves[1, 0, 1], moves[2, 0, 0] = [0.0, 0.0, 1e6, 0.0], 90.0, 0.021
    moves[3, 0, 3] = 0.019  # of 0.02 at least; 90 is taken as 30; 1e6 diverged
    modes = tests._modes(moves)
    assert sorted(np.abs(modes).max(axis=(0, 1)).tolist()) == pytest.approx([0.021, 30.0])


def test_draws_are_one_sd_all_together_and_of_thirty_rms_at_most():
    seen, rows = np.ones((30, 1)), stretch(30, 0.0)
    change = {1: 2.0, 2: -90.0, 3: np.inf}
    drawn = [SimpleNamespace(over=lambda *_, k=k: (seen + change.get(k, 0.0), [])) for k in range(25)]
    part = in_blocks(rows, rows.y)

    def changes(uncertain: bool) -> np.ndarray:
        plant = SimpleNamespace(uncertain=uncertain, draw=drawn.__getitem__)
        return tests._draw_changes(plant, [rows], [part], seen, np.array([0.5]), 5.0)[0]

    assert (changes(False).shape, changes(True).shape) == ((30, 1, 0), (30, 1, 23))
    np.testing.assert_allclose(changes(True)[0, 0, :3] * np.sqrt(23), [2.0, -15.0, 0.0])


def test_signals_are_lags_of_the_input_and_of_the_square_of_the_output():
    plant, n = heater(), 60
    u = np.where(np.arange(n) < 10, 2.0, 3.0)
    rows = stretch(n, u[:, None])
    blocks = tests._Blocks(rows, np.zeros((n, 1)), 2.0)
    run = np.append(np.zeros(30), np.full(31, 6.1))[:, None]
    found = tests._signals(plant, rows, run, [0], blocks, 2.0)
    lags = np.array([1.0, 4.0, 16.0, 64.0]) * 2  # of blocks of 2 s
    after = np.maximum(np.arange(n) - 10, 0.0)[:, None]  # a step of 1 at 10 s
    want = (1 - np.exp(-after / lags)).reshape(30, 2, 4).mean(axis=1)
    np.testing.assert_allclose(found["q"], want / want.max(), atol=1e-9)
    square = np.append(np.full(30, 3.1**2), np.full(30, 3.0**2))  # about the mean of 61 values, 3.1
    want = lfilter([1 - np.exp(-1 / 2)], [1, -np.exp(-1 / 2)], square)
    want = np.append(0.0, want)[:60].reshape(30, 2).mean(axis=1)
    np.testing.assert_allclose(found["t squared"][:, 0], want / want.max(), atol=1e-9)


@pytest.mark.parametrize(
    ("after_gap", "level", "start", "bias"),
    [(False, None, 1.0, 0.3), (True, 0.0, 3.0, 0.05), (False, 0.0, 0.1, 0.05)],
)
def test_a_start_counts_three_times_after_a_gap_and_a_tenth_at_rest(after_gap, level, start, bias):
    model = StateSpaceModel(
        ("q",), ("room",), ("t",), A=[[0.9]], B=[[0.5]], E=[[0.1]], C=[[2.0]], dt=1.0, spread=[[0.25]]
    )
    plant, n = Plant(model, {}, dt=1.0, nuisance={"room": 0.3}), np.arange(30.0)
    begin = Start(np.ones(1), np.zeros(1), np.zeros(1), np.full(1, 2.0), level, 0.0, "")
    rows = stretch(30, 1.0, 7.0)
    part = replace(in_blocks(rows, rows.y, begin), after_gap=after_gap)
    nominal = tests._run(plant, part, begin.x0[None])
    moved, biased = tests._start_changes(plant, part), tests._bias_changes(plant, part, nominal)
    np.testing.assert_allclose(np.abs(moved[:, 0, 0]), start * 0.5 * 2 * 0.9**n)
    np.testing.assert_allclose(biased[:, 0, 0], -bias * 2 * (1 - 0.9**n))  # 0.1 / (1 - 0.9) = 1
    np.testing.assert_allclose(nominal[0, :30, 0], 2 * (10 - 9 * 0.9**n))  # (0.5 + 0.1 * 5) / 0.1


def test_starts_run_a_few_at_a_time_move_the_blocks_as_all_runs_together(monkeypatch: pytest.MonkeyPatch):
    rng, n = np.random.default_rng(21), 400
    root = rng.standard_normal((7, 7))
    A = root @ np.diag(np.linspace(0.5, 0.99, 7)) @ np.linalg.inv(root)
    model = StateSpaceModel(
        ("q",), (), ("t", "s"), A=A, B=np.ones((7, 1)), C=rng.standard_normal((2, 7)), dt=1.0,
        spread=root @ root.T,
    )  # fmt: skip
    plant, residual = Plant(model, {}, dt=1.0), rng.standard_normal((n, 2))
    residual[rng.random((n, 2)) < 0.2] = np.nan
    rows = replace(stretch(n, rng.random((n, 1))), time=np.arange(n) + 0.3 * rng.random(n), y=residual)
    begin = Start(rng.standard_normal(7), np.zeros(7), np.zeros(2), np.zeros(0), None, 0.0, "")
    part = tests._Tested(rows, begin, tests._Blocks(rows, residual, 8.0), after_gap=False)

    sizes, axes = np.linalg.eigh(model.spread)
    x0 = np.vstack([begin.x0, begin.x0 + 0.1 * (axes * np.sqrt(sizes)).T])
    runs, _ = model.rollout(x0, rows.u[None], rows.d[None], (), 1.0)
    change = 10 * at_rows(rows, runs[1:] - runs[0], 1.0)
    block = (rows.time // 8).astype(int)
    change[:, np.isnan(residual)] = np.nan
    means = [np.nanmean(change[:, block == b], axis=1).T for b in range(n // 8)]
    monkeypatch.setattr(tests, "_AT_ONCE", 3 * 2 * n)  # three runs at a time
    np.testing.assert_allclose(tests._start_changes(plant, part), means, rtol=1e-9, atol=1e-11)


def test_correlations_of_nothing_and_of_huge_values():
    empty = Correlation(np.zeros(2), np.full(2, np.nan), 0.1)
    assert (np.isnan(empty.share_outside), empty.independent) == (True, False)
    e, u = np.random.default_rng(0).standard_normal((2, 200))
    for none in (np.full(200, np.nan), np.full(200, 3.0)):
        assert np.isnan(cross_correlation(e, none).values).all()
        assert np.isnan(cross_correlation(none, u).values).all()
    auto, cross = autocorrelation(e), cross_correlation(e, u)
    assert (auto.lags[[0, -1]].tolist(), cross.lags[[0, -1]].tolist()) == ([1, 40], [0, 40])
    np.testing.assert_allclose(cross_correlation(1e200 * e, 1e-100 * u).values, cross.values, atol=1e-12)
    ra, ru = (np.correlate(x - x.mean(), x - x.mean(), "full")[200:249] / (200 * x.var()) for x in (e, u))
    assert cross.band == pytest.approx(1.96 * np.sqrt(max(1 + 2 * ra @ ru, 1.0) / 200))
