"""The parts of the choice by held-out free run, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.blackbox import order_selection as selection
from thermogrip.sysid.blackbox.order_selection import Choice, Run, StartPrior, Structure
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.log_grid import Grid, Segment

SMALL, MIDDLE, LARGE = Structure("small", 2), Structure("middle", 3), Structure("large", 5)


def segment(y, u=None, d=None, log="a"):
    y = np.asarray(y, dtype=float)
    u, d = (np.zeros((len(y), 0)) if some is None else np.asarray(some, dtype=float) for some in (u, d))
    return Segment(np.arange(float(len(y))), y, u, d, log)


def grid_of(*segments, inputs=(), disturbances=(), outputs=("t",), switches=()):
    return Grid(inputs, disturbances, outputs, switches, 2.0, segments, 2.0, {})


def rows(n, log="a"):
    return segment(np.arange(n)[:, None], log=log)


@pytest.mark.parametrize(
    ("lengths", "memory"),  # rows of 2 s; a quarter of a held-out part, of four blocks or a log of three
    [((80,), 10.0), ((50, 40), 11.25), ((30, 60, 30), 20.0)],
)
def test_each_noise_is_tried_with_each_offset_that_lasts_or_fades(lengths, memory):
    want = [(r, 0.0, np.inf) for r in (0.03, 0.1, 0.3)]
    for q in (0.1, 0.3, 1.0):
        want += [(r, q, lasts) for lasts in (np.inf, memory) for r in (0.03, 0.1, 0.3)]
    found = selection.priors_of(grid_of(*(rows(n, log) for n, log in zip(lengths, "abc"))))
    assert [(some.noise, some.nuisance, some.memory) for some in found] == want


def spans(segments):
    return [(s.log, int(s.time[0]), int(s.time[-1]) + 1) for s in segments]


def runs_of(fold):
    """Return what is run of a fold: log, first row, last row, first row that is scored."""
    return [(*span, run.scored_from) for run, span in zip(fold.runs, spans([r.segment for r in fold.runs]))]


def test_two_logs_are_cut_into_four_blocks_and_a_last_part_that_is_run_from_the_start():
    grid = grid_of(rows(50), rows(40, "b"))
    cases = [(fold.label, spans(fold.train.segments), runs_of(fold)) for fold in selection.folds(grid)]
    # at 22.5, 45 and 67.5 rows, of which halves go to the even one; of a block the second half once more
    assert cases == [
        ("block 1 of 4", [("a", 22, 50), ("b", 0, 40)], [("a", 0, 22, 0), ("a", 11, 22, 0)]),
        ("block 2 of 4", [("a", 0, 22), ("b", 0, 40)], [("a", 22, 45, 0), ("a", 33, 45, 0)]),
        (
            "block 3 of 4",
            [("a", 0, 45), ("b", 18, 40)],
            [("a", 45, 50, 0), ("b", 0, 18, 0), ("a", 47, 50, 0), ("b", 9, 18, 0)],
        ),
        ("block 4 of 4", [("a", 0, 50)], [("b", 18, 40, 0), ("b", 29, 40, 0)]),
        ("last 30 % of a and b", [("a", 0, 35), ("b", 0, 28)], [("a", 0, 50, 35), ("b", 0, 40, 28)]),
    ]
    assert len(selection.folds(grid_of(rows(80)))) == 5
    with pytest.raises(UserError, match=r"79 rows of 2 s are too few: .* which takes 80"):
        selection.folds(grid_of(rows(79)))


@pytest.mark.parametrize(("at", "blocks"), [(5, "234"), (30, "1234")])
def test_a_block_that_alone_has_a_step_is_not_held_out(at, blocks):
    # a step in block 1 is seen by no other block, one in block 2 by the levels before and after it
    moves = 0.001 * np.arange(80)[:, None] % 0.02 + 9.0 * (np.arange(80) >= at)[:, None]
    step = segment(np.arange(80.0)[:, None], moves)
    labels = [fold.label for fold in selection.folds(grid_of(step, inputs=("q",)))]
    assert labels == [*(f"block {n} of 4" for n in blocks), "last 30 % of a"]


@pytest.mark.parametrize(
    ("moving", "held"),  # the logs that move q, and those that move p
    [(("abc", "abc"), "abc"), (("abc", "c"), "ab"), (("a", "c"), "abc"), (("c", ""), "ab")],
)
def test_a_log_that_alone_moves_an_input_is_not_held_out_where_two_others_are_left(moving, held):
    logs = []
    for name in "abc":
        u = 3.0 * np.ones((30, 2))
        u[10:] += [name in some for some in moving]
        logs.append(segment(np.arange(30)[:, None], u, log=name))
    cases = [
        (name, train.logs, {run.segment.log for run in runs})
        for name, train, runs in selection.folds(grid_of(*logs))
    ]
    assert cases == [(name, tuple(n for n in "abc" if n != name), {name}) for name in held]


class Stands:
    """A model of two outputs that stand where they begin."""

    def __init__(self, *, stable=True, lost=()):
        self.stable, self.spread, self.lost = stable, np.zeros((2, 2)), lost

    def rest(self, y, u, d, more):
        return np.asarray(y)

    def rollout(self, x0, u, d, more, dt):
        y = np.repeat(x0[:, None], u.shape[1] + 1, axis=1)
        for row, column in self.lost:
            y[:, row:, column] = np.nan
        return y, x0


def test_errors_of_a_free_run_are_those_of_the_rows_after_the_warm_up_for_each_prior():
    long = segment([[10, 5], [12, 5], [14, 5], [13.5, 6], [np.nan, 7], [15.5, np.nan]])
    short = segment([[20, 5], [20, 5], [20, 5], [22, 2]])
    skipped = segment([[20, 5], [20, 5], [90, 5]])
    priors = [StartPrior(noise=0.5, nuisance=0.0), StartPrior(noise=1.0, nuisance=1.0)]
    how = {"dt": 2.0, "scale": np.array([2.0, 1.0]), "warmup": 3, "priors": priors}
    found = selection.free_run_errors(Stands(), [Run(s) for s in (long, short, skipped)], **how)
    # misses of 3.5, 5.5, 2 and 1, 2, -3; half of (0, 2, 4) times 3/(3 + 1) taken as offset: 1.5 less
    want = [[np.sqrt(46.5 / 3), np.sqrt(14 / 3)], [np.sqrt((4 + 16 + 4) / 3), np.sqrt(14 / 3)]]
    np.testing.assert_allclose(found, want)
    fading = [StartPrior(noise=1.0, nuisance=1.0, memory=5.0)]  # by exp(-2 s/5 s) a row
    (found,) = selection.free_run_errors(Stands(), [Run(long), Run(short)], **how | {"priors": fading})
    left = 1.5 * np.exp(-0.4 * (np.arange(3) + 1.5))
    misses = [3.5 - left[0], 5.5 - left[2], 2.0]  # nothing of the short one's is offset
    np.testing.assert_allclose(found[0], np.sqrt(np.mean(np.square(misses))))
    lost = selection.free_run_errors(
        Stands(lost=[(4, 0)]), [Run(long.part(0, 5))], **how
    )  # where nothing was read
    np.testing.assert_allclose(lost[0], [3.5, np.sqrt(2.5)])
    silent = segment([[10, 5], [12, 5], [14, 5], [np.nan, 6]])
    for model, some in ((Stands(stable=False), long), (Stands(lost=[(4, 1)]), long), (Stands(), silent)):
        assert np.isinf(selection.free_run_errors(model, [Run(some)], **how)).tolist() == [[True] * 2] * 2


@pytest.mark.parametrize(
    ("on_all", "chosen"), [(0.4, "small"), (0.401, "middle"), (None, "middle")]
)  # the 0.4 of its worst fold; one that cannot be fitted
def test_the_choice_has_the_errors_of_its_structure_and_of_its_best_prior(monkeypatch, on_all, chosen):
    grid = grid_of(
        *(segment(np.outer([0, 1] * 15, [4, 20]), log=n) for n in "abc"), outputs=("s", "t")
    )  # spreads of 2 and 10
    by_fold = {  # prior 4 serves all three best by the mean of logs, prior 7 by the mean
        SMALL: {"a": 0.2, "b": 0.3, "c": 0.4},
        MIDDLE: {"a": 0.21, "b": 0.29, "c": 0.4},
        LARGE: {"a": 0.01, "b": 0.01},
    }
    asked, said = [], []

    def family(part, *, only=None):
        asked.append((part.logs, only))
        of = set("abc") - set(part.logs)
        return {
            s: s
            for s, errors in by_fold.items()
            if (only is None or s in only) and of <= set(errors) and (only != (SMALL,) or on_all)
        }

    def errors_of(model, runs, *, dt, scale, warmup, priors):
        assert (dt, scale.tolist(), warmup) == (2.0, [2.0, 10.0], 6)
        if len(priors) == 1:
            assert priors[0] == selection.priors_of(grid)[4]
            error, shape = on_all if model == SMALL else 0.1, np.ones((1, 1))
        else:
            (log,) = {run.segment.log for run in runs}
            error, shape = by_fold[model][log], np.full((21, 1), 3.0)
            shape[4], shape[7] = 1.0, {"a": 1.2, "b": 1.2, "c": 0.8}[log]
        return error * shape * scale * [1.5, 0.5]  # their mean is 1

    monkeypatch.setattr(selection, "free_run_errors", errors_of)
    choice = selection.choose(grid, family, warmup=6, progress=lambda *what: said.append(what))
    errors = list(by_fold[choice.structure].values())
    assert (choice.structure.label, choice.model) == (chosen, choice.structure)
    assert (choice.prior, choice.warmup) == (selection.priors_of(grid)[4], 6)
    assert [fold.label for fold in choice.folds] == ["a", "b", "c"]
    np.testing.assert_allclose(choice.errors[choice.structure], errors)
    np.testing.assert_allclose(choice.rmse, np.outer(errors, [2 * 1.5, 10 * 0.5]))
    assert choice.error == pytest.approx(np.prod(errors) ** (1 / 3))
    assert np.isinf(choice.errors[LARGE]).tolist() == [False, False, True]
    assert said == [(0.0, "without a"), (1 / 3, "without b"), (2 / 3, "without c")]
    assert asked[:3] == [(("b", "c"), None), (("a", "c"), None), (("a", "b"), None)]
    late = {SMALL: {"b": 0.1, "c": 0.1}, MIDDLE: {"a": 0.2, "b": 0.2, "c": 0.2}}
    by_fold = late  # not fitted on the first fold
    choice = selection.choose(grid, family, warmup=6)
    assert (choice.structure, np.isinf(choice.errors[SMALL]).tolist()) == (MIDDLE, [True, False, False])


@pytest.mark.parametrize(("many", "fitted"), [(89, [None, None, (SMALL, LARGE)]), (90, [None] * 3)])
def test_of_many_rows_a_structure_that_a_smaller_one_beats_on_two_parts_is_not_fitted_again(
    monkeypatch, many, fitted
):
    grid = grid_of(*(segment(np.outer([0, 1] * 15, [4]), log=n) for n in "abc"))
    errors = {SMALL: 0.2, MIDDLE: 0.201, LARGE: 0.1}
    asked = []

    def family(part, *, only=None):
        asked.append(only and tuple(only))
        return {s: s for s in errors if only is None or s in only}

    def errors_of(model, runs, *, scale, priors, **_):
        return np.full((len(priors), 1), errors[model]) * scale

    monkeypatch.setattr(selection, "free_run_errors", errors_of)
    monkeypatch.setattr(selection, "MANY_ROWS", many)
    assert selection.choose(grid, family, warmup=6).structure == LARGE
    assert asked == [*fitted, (LARGE,)]


@pytest.mark.parametrize(
    ("excess", "within"),
    [
        ((0.0, 0.0), True),
        ((0.04, 0.04), False),
        ((-0.01, 0.0, 0.12), True),  # mean 0.0367, standard error sqrt(0.010467 / 2 / 3) = 0.0418
        ((0.01, 0.01, 0.1), False),  # 0.04, 0.03
        ((-0.3, 0.39), True),  # 0.045 of ln 1.05 = 0.0488
        ((-0.3, 0.4), False),
    ],
)
def test_an_excess_is_noise_within_a_standard_error_and_five_percent(excess, within):
    assert selection.excess_within_noise(np.array(excess), selection.ORDER_MARGIN) is within


@pytest.mark.parametrize(
    ("table", "chosen"),
    [
        ({MIDDLE: (0.1, 0.1), Structure("even", 3): (0.099, 0.1)}, "even"),  # of one size the better one
        ({SMALL: (2, 2, 2), MIDDLE: (1, 1.03, 1), LARGE: (1.01, 1, 0.99)}, "middle"),
        ({SMALL: (0.1, np.inf), LARGE: (0.5, 0.5)}, "large"),
        ({SMALL: (1e-13, 1e-13), LARGE: (0.0, 0.0)}, "small"),  # both no error at all
        ({SMALL: (1e-11, 1e-11), LARGE: (0.0, 0.0)}, "large"),
    ],
)
def test_the_smallest_of_the_good_ones_is_taken(table, chosen):
    errors = {structure: np.array(each) for structure, each in table.items()}
    found = selection.smallest_near_the_best(errors, selection.ORDER_MARGIN)
    assert found.label == chosen


@pytest.mark.parametrize(("errors", "mean"), [((0.02, 0.5), 0.1), ((0.0, 4.0), 2e-6)])
def test_the_error_of_a_choice_is_a_geometric_mean(errors, mean):
    choice = Choice(SMALL, StartPrior(), {SMALL: np.array(errors)}, (), np.zeros((2, 1)), 3, None)
    assert choice.error == pytest.approx(mean)


@pytest.mark.parametrize(
    ("logs", "products", "errors", "chosen"),
    [
        ("a", (), (0.1, 0.15, 0.155), "large"),  # 9 percent more, the standard error is 28
        ("abc", (), (0.1, 0.15, 0.155), "small"),
        ("a", ("q*q",), (0.1, 0.15, 0.155), "small"),
        ("a", ("q*q",), (0.1, 0.3, 0.16), "large"),  # 39 percent, the standard error 54
        ("a", ("q*q",), (0.16, 0.11, 0.13), "large"),  # 8 percent, the standard error 1
    ],
)
def test_over_whole_logs_a_fifth_more_is_within_noise_and_a_tenth_without_products(
    monkeypatch, logs, products, errors, chosen
):
    table = {SMALL: errors, LARGE._replace(products=products): (0.15, 0.1, 0.12)}
    scored = {s: selection._Errors(StartPrior(), np.array(e), np.ones((3, 1))) for s, e in table.items()}
    monkeypatch.setattr(selection, "_score", lambda *_: scored)
    monkeypatch.setattr(selection, "_fit_to_all", lambda grid, family, structure, *_: (structure, 0.1))
    grid = grid_of(*(rows(80, log) for log in logs))
    assert selection.choose(grid, lambda *_, **__: {}, warmup=2).structure.label == chosen


def test_drives_are_inputs_disturbances_and_products_of_which_still_ones_are_none():
    u = np.array([[-2.0, 5.0, 0.0], [3.0, 5.0 + 4e-9, 7.0], [1.0, 5.0, 7.0]])
    d = np.array([[20.0], [20.0 + 3e-8], [20.0]])  # a billionth of it is 2e-8
    parts = (segment(np.zeros((3, 1)), u, d), segment(np.zeros((1, 1)), u[1:2], d[:1]))
    grid = grid_of(*parts, inputs=("q", "still", "p"), disturbances=("room",))
    first, second = selection.drives(grid, ("|q|", "q*|q|"))
    want = np.column_stack([u[:, 0], [0] * 3, u[:, 2], d, [2, 3, 1], [-4, 9, 1]])
    np.testing.assert_array_equal(first, want)
    np.testing.assert_array_equal(second, [[3.0, 0.0, 7.0, 20.0, 3.0, 9.0]])


def test_the_spread_of_the_states_is_that_of_the_run_and_a_trace_more():
    parts = {"A": np.diag([0.5, 0.0]), "B": [[2.0], [0.0]], "C": [[1.0, 0.0]], "c": [0.0, 0.0]}
    grid = grid_of(
        segment(np.zeros((2, 1)), [[1.0], [2.0]]), segment(np.zeros((1, 1)), [[3.0]]), inputs=("q",)
    )
    W, A = np.array(parts["B"]), np.array(parts["A"])
    starts, how = [np.array([4.0, 0.0]), np.array([1.0, 0.0])], {"terms": ()}
    found = selection.as_state_space(grid, A, W, np.eye(1, 2), np.zeros(2), starts, **how)
    assert (found.dt, found.outputs) == (2.0, ("t",))
    # states 4, 4, 6 and 1, 6.5: sum 21.5, squares 111.25, so 18.8 / 4
    assert np.trace(found.spread) == pytest.approx(4.7 * (1 + 2e-8), rel=1e-12)
    assert found.spread[1, 1] == pytest.approx(4.7e-8)
    assert isinstance(found, StateSpaceModel)
    still = grid_of(segment(np.zeros((2, 1)), [[0.0], [0.0]]), inputs=("q",))
    spread = selection.with_spread(found, still, [np.zeros(2)]).spread
    np.testing.assert_allclose(spread, 1e-20 * np.eye(2), rtol=1e-6)
    assert selection.with_spread(found, grid, [np.array([np.inf, 0.0]), np.zeros(2)]) is found


def test_products_have_columns_of_their_own_after_inputs_and_disturbances():
    part = segment(np.zeros((2, 1)), np.zeros((2, 2)), np.zeros((2, 1)))
    grid = grid_of(part, inputs=("q", "p"), disturbances=("room",))
    matrices = np.eye(1) / 2, np.array([[1.0, 2.0, 3.0, 4.0]]), np.eye(1), np.ones(1), [np.zeros(1)]
    model = selection.as_state_space(grid, *matrices, terms=("|q|",), y0=np.array([7.0]))
    assert [part.tolist() for part in (model.B, model.E, model.F)] == [[[1.0, 2.0]], [[3.0]], [[4.0]]]
    assert (model.y0.tolist(), model.c.tolist(), model.terms) == ([7.0], [1.0], ("|q|",))


@pytest.mark.parametrize(
    ("levels", "terms"),
    [
        (np.linspace(0, 1, 50), [("q*q",)]),
        (np.linspace(-1, 0, 50), [("q*q",)]),
        (np.linspace(3, 4, 50), []),  # so far from 0 a square is nearly a line
        (np.linspace(-1, 1, 50), [("|q|",)]),
        (np.repeat([0.0, 9.0], 25), []),  # two levels have a line through them
        (np.r_[np.repeat([0.0, 9.0], 25), 8.0], []),
        (np.full(50, 7.0), []),
    ],
)
def test_squares_of_inputs_of_one_sign_are_tried_where_a_line_would_show(levels, terms):
    u = np.column_stack([levels, np.repeat([0.0, 1.0], [9, len(levels) - 9])])
    rows = segment(np.zeros((len(u), 1)), u)
    grid = grid_of(rows, inputs=("q", "pump"), switches=("pump",))
    assert list(selection.default_terms(grid)) == [(), *terms]
