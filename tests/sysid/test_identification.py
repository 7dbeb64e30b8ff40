"""Model comparison: held out means held out, equal scores are not good, real logs do as well as peers."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from tests.sysid.models.makers import steady_gain
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.log_files import read_log
from thermogrip.datasets.schema import log_name, make_log
from thermogrip.sysid import Plant, identification, identify
from thermogrip.sysid.blackbox.fit import fit_black_box
from thermogrip.sysid.blackbox.order_selection import Structure
from thermogrip.sysid.data import preparation
from thermogrip.sysid.export.dynamics import plant_dynamics
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.identification import Held, beyond_reach, choose_black_box
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant_data import ExpectedError, HeldOut, PlantScores, fit_logs
from thermogrip.sysid.validation import stated_errors
from thermogrip.sysid.validation.free_run import free_run, usual_warmup
from thermogrip.sysid.validation.stated_errors import between_runs, effect_of_inputs, expected_error

REAL = Path(os.environ.get("THERMOGRIP_REAL_DATA", Path(__file__).parents[3] / "shared" / "data" / "real"))
needs_real = pytest.mark.skipif(
    not REAL.is_dir(), reason=f"no measurements of other labs in {REAL} (set THERMOGRIP_REAL_DATA)"
)


def plant_log(n=900, *, seed=0, name="a", gain=0.5, noise=0.02):
    rng = np.random.default_rng(seed)
    q = np.repeat(rng.random(n // 25), 25)
    q[:25] = 0.0
    t = 25 + lfilter([0, 0, gain], [1, -0.95], q) + noise * rng.standard_normal(n)
    return make_log(np.arange(float(n)), {"q": (q, "1", "input"), "t": (t, "degC", "output")}, name=name)


def test_logs_left_out_on_other_processes_give_the_same(monkeypatch):
    logs = [plant_log(300, seed=s, name=name) for s, name in enumerate("ab")]
    own = identification._fitted

    def fit(kind, train, *given):
        if kind == "subspace" and train[0].attrs["name"] == "a" and len(train) == 1:
            raise UserError("no")
        return own(kind, train, *given)

    monkeypatch.setattr(identification, "_fitted", fit)
    how = {"models": ["arx", "subspace"], "leave_one_out": True, "average": 2.0, "draws": 0}
    alone, asked = identify(logs, **how), []

    def parallel(function, items, workers, *_, **__):
        asked.append((workers, len(items)))
        return [function(item) for item in items]

    monkeypatch.setattr(identification, "in_order", parallel)
    shared = identify(logs, **how, workers=2)
    assert asked == [(2, 4)]
    assert (shared.rows, shared.notes, shared.model) == (alone.rows, alone.notes, alone.model)
    assert "subspace without b: no" in shared.notes


def test_leaving_one_log_out_gives_a_row_for_every_model_and_log():
    logs = [plant_log(500, seed=s, name=name) for s, name in enumerate("abc")]
    found = identify(logs, models=["arx", "subspace"], leave_one_out=True, average=2.0, draws=0)
    held = {(row.model, row.log) for row in found.rows if row.held_out}
    assert held == {(model, log) for model in ("arx", "subspace") for log in "abc"}
    assert {row.log for row in found.rows if not row.held_out} == set("abc")
    assert found.good
    assert found.plant.logs == ("a", "b", "c")
    assert found.plant.fitted_to == fit_logs(logs)
    assert (found.plant.scores.average_s, found.plant.scores.average_why) == (2.0, "asked for")
    assert f"{found.model}: steps of 2 s (asked for)" in found.notes
    assert found.errors()[found.model] == min(found.errors().values())
    assert list(found.held_out_runs) == list("abc")
    for row in (row for row in found.rows if row.held_out and row.model == found.model):
        run = found.held_out_runs[row.log]
        assert (run.scores[row.output].rmse, log_name(run.measured)) == (row.rmse, row.log)
        assert row.log not in run.plant.logs


def test_a_log_is_scored_in_the_fit_with_the_warmup_that_its_held_out_part_had():
    # with 5 s in one and 50 s in the other, errors of the start made a fit seem less good on what it had seen
    logs = [plant_log(500, seed=s, name=name) for s, name in enumerate("abc")]
    one = identify(logs[0], models=["arx"], average=2.0, draws=0).rows
    assert {row.n for row in one if not row.held_out} == {450}
    assert {row.n for row in one if row.log.startswith("last")} == {150}
    several = identify(logs, models=["arx"], average=2.0, leave_one_out=True, draws=0).rows
    assert {row.n for row in several} == {495}


def test_every_part_held_out_of_every_candidate_is_in_the_table():
    found = identify(plant_log(), models=["arx", "oe", "subspace"], average=2.0, draws=0)
    held = [row for row in found.rows if row.held_out]
    blocks = [f"block {k} of 4" for k in (1, 2, 3, 4)]
    for model in ("arx", "oe", "subspace"):
        assert sorted(row.log for row in held if row.model == model) == [*blocks, "last 30 % of a"]
    assert list(found.held_out_runs) == ["last 30 % of a"]
    fit = fit_black_box("oe", [plant_log()], average=2.0)
    rows = [row for row in held if row.model == "oe" and row.log in blocks]
    assert [row.rmse for row in rows] == fit.plant.scores.held_out_by_part["t"][:4]
    # errors of readings: beside that of the means the noise of one of two readings
    assert all(row.rmse > rmse > 0 for row, rmse in zip(rows, fit.choice.rmse[:, 0]))
    for row, fold in zip(rows, fit.choice.folds):
        y = np.concatenate([run.segment.y[25:, 0] for run in fold.runs])
        assert row.fit_percent == pytest.approx(100 * (1 - row.rmse / np.std(y)))
    # 450 rows in four blocks of 112 or 113, each scored from its start and from its middle after 25 rows
    assert sum(row.n for row in rows) == 450 - 4 * 25 + 4 * 57 - 2 - 4 * 25
    assert all(row.no_input_rmse > 10 * row.rmse for row in rows)


@pytest.mark.parametrize(
    ("errors", "run", "chosen"),
    [
        ({"neural": [0.10, 0.10, 0.10, 0.10], "oe": [0.10, 0.11, 0.10, 0.10]}, 0, "oe"),
        # 10 percent more, the standard error is 14
        ({"neural": [0.10, 0.10, 0.10, 0.10], "oe": [0.08, 0.15, 0.10, 0.12]}, 0, "oe"),
        ({"neural": [0.10, 0.10, 0.10, 0.10], "oe": [0.12, 0.11, 0.12, 0.12]}, 0, "neural"),
        ({"subspace": [0.10, 0.10, 0.10, 0.10], "oe": [0.10, 0.11, 0.10, 0.10]}, 0, "subspace"),
        ({"subspace": [0.10, 0.10, 0.10, 0.10], "oe": [0.13, 0.13, 0.13, 0.13]}, 0, "subspace"),
        ({"oe": [0.1, 0.1, 0.1, 9.0], "arx": [0.2, 0.2, 0.2, 0.2]}, 0, "arx"),  # a geometric mean
        # with 7 percent 0.044 and 0.038 are 0.0827 and 0.0797: 4 percent more
        ({"subspace": [0.038] * 4, "oe": [0.044] * 4}, 0, "subspace"),
        ({"subspace": [0.038] * 4, "oe": [0.044] * 3 + [0.048]}, 0.14, "subspace"),
        ({"neural": [0.03] * 4, "oe": [0.044] * 4}, 0.14, "neural"),
        ({"neural": [0.040, 0.046] * 2, "oe": [0.044] * 4}, 0.14, "oe"),
    ],
)
def test_the_kind_of_the_least_error_is_kept_and_a_linear_one_near_it(monkeypatch, errors, run, chosen):
    # 0.14 K of a spread of 2 K, by which runs differ, are 7 percent
    monkeypatch.setattr(identification, "between_runs", lambda *_: {"t": np.full(9, run)})
    assert choose_black_box([fit_of(*item) for item in errors.items()], []).kind == chosen


def fit_of(kind, values):
    structure = Structure("s", 4 if kind == "oe" else 12)
    error = float(np.exp(np.mean(np.log(values))))
    choice = SimpleNamespace(structure=structure, errors={structure: np.array(values)}, error=error)
    grid = SimpleNamespace(logs=("a",), outputs=("t",), output_spread=lambda: np.array([2.0]))
    return SimpleNamespace(kind=kind, choice=choice, grid=grid, plant=None)


@pytest.mark.parametrize(
    ("oe", "run", "noise", "out"),
    [
        (0.0318, 0.14, 0.0, True),  # sqrt(1.1^2 - 1) = 0.458 of what differs between runs
        (0.0324, 0.14, 0.0, False),
        (0.001, 0.0, 0.0, False),
        (0.0109, 0.0, 0.01, True),
        (0.0111, 0.0, 0.01, False),
    ],
)
def test_a_kind_is_beyond_reach_where_noise_alone_would_not_be_a_tenth_better(
    monkeypatch, oe, run, noise, out
):
    monkeypatch.setattr(identification, "white_error", lambda fit: noise)
    monkeypatch.setattr(identification, "between_runs", lambda *_: {"t": np.full(9, run)})
    assert beyond_reach([fit_of("oe", [oe] * 4), fit_of("arx", [0.3] * 4)], []) == out
    assert not beyond_reach([fit_of("sindy", [1e-9] * 4)], [])


def test_neural_models_that_could_not_be_kept_are_left_out_with_the_reason():
    said = []
    found = identify(
        plant_log(500), models=["neural", "oe"], average=2.0, draws=0, progress=lambda _, w: said.append(w)
    )
    assert found.model == "oe"
    assert {row.model for row in found.rows} == {"oe"}
    assert any(note.startswith("neural: left out, for even without any error") for note in found.notes)
    assert any(what.startswith("oe: ") for what in said)
    assert not any(what.startswith("neural") for what in said)


def test_inputs_of_the_row_are_said_and_the_warm_up_of_a_fit_is_that_of_its_logs():
    rng = np.random.default_rng(3)
    q = rng.random(600)
    y = 25 + lfilter([2.0], [1, -0.6], q) + 0.02 * rng.standard_normal(600)
    log = make_log(np.arange(600.0), {"q": (q, "1", "input"), "t": (y, "degC", "output")}, name="a")
    found = identify(log, models=["arx"], average=1.0, draws=0)
    assert found.plant.inputs_end_at_row
    assert any("an input moves its own row's reading" in note for note in found.notes)
    assert usual_warmup(found.plant, log) == 50.0
    assert usual_warmup(found.plant, log.isel(time=slice(0, None, 2))) == 60.0  # of rows of 2 s
    assert usual_warmup(replace(found.plant, logs=("a", "b", "c")), log) == 5.0
    network = Plant(found.plant.model, {}, dt=1.0, logs=("a",))  # no errors of folds
    assert usual_warmup(network, log) == 5.0


def test_one_error_is_stated_of_another_run_everywhere():
    """It had three: in the verdict, for another run, and in the bands."""
    log = plant_log()
    found = identify(log, models=["oe"], average=2.0)
    parts = [row.rmse for row in found.rows if row.held_out]
    differs = np.sqrt(np.mean(between_runs(found.plant, [log])["t"] ** 2))
    (stated,) = found.expected.values()
    assert stated == expected_error(parts, float(differs))
    said = f"(oe). Expected error of another run like these: t {stated.words('degC')}. It would be t "
    assert f"{said}{stated.same_gain:.2g} degC, were gains the same from run to run" in found.verdict
    assert "Good for simulation and control on runs like these" in found.verdict
    assert Plant.from_dict(found.plant.to_dict()).scores.expected == found.expected
    again = free_run(found.plant, plant_log(seed=7))  # of the same kind, so its band is as stated
    assert again.band().expected["t"] == pytest.approx(stated.rmse, rel=0.2)
    assert again.verdict.standing in ("better", "as stated")
    logs = [plant_log(500, seed=s, name=name) for s, name in enumerate("abc")]
    three = identify(logs, models=["oe"], average=2.0, draws=0)
    assert "its gain off" not in three.verdict  # which whole logs show
    assert three.expected["t"].rmse < 0.2 * stated.rmse


def test_a_held_out_log_cannot_change_its_own_prediction():
    logs = [plant_log(500, seed=s, name=name) for s, name in enumerate("abc")]
    first = identify(logs, models=["arx"], leave_one_out=True, average=2.0, draws=0)
    logs[2]["t"].values[10:] += 3.0  # after its warm-up
    second = identify(logs, models=["arx"], leave_one_out=True, average=2.0, draws=0)
    structures = [next(r.structure for r in f.rows if r.log == "c" and r.held_out) for f in (first, second)]
    assert structures[0] == structures[1]
    errors = [next(r.rmse for r in f.rows if r.log == "c" and r.held_out) for f in (first, second)]
    assert errors[1] == pytest.approx(np.hypot(errors[0], 3.0), rel=0.02)


def test_an_output_that_ignores_the_input_is_never_called_good():
    rng = np.random.default_rng(0)
    log = plant_log(gain=0.0, noise=0.0)
    log["t"].values[:] = 25 + lfilter([0.1], [1, -0.99], rng.standard_normal(900))
    found = identify(log, models=["arx"], average=2.0)
    assert not found.good
    assert found.verdict.startswith("Not good")
    assert found.plant.verdict == found.verdict


def test_progress_goes_from_zero_to_one():
    calls = []
    identify(plant_log(), models=["arx"], average=2.0, progress=lambda done, what: calls.append((done, what)))
    fractions = [done for done, _ in calls]
    assert fractions == sorted(fractions)
    assert 0 <= fractions[0] <= fractions[-1] <= 1
    assert all("arx" in what for _, what in calls)


def test_what_subspace_models_say_is_known_before_others_are_fitted_at_their_step(monkeypatch):
    known, fitted = [], []
    fit = identification.fit_black_box

    def followed(kind, *given, **more):
        fitted.append((kind, None if more["grid"] is None else more["grid"].dt))
        return fit(kind, *given, **more)

    monkeypatch.setattr(identification, "fit_black_box", followed)

    def early(found):
        known.append((len(fitted), found))

    found = identify(plant_log(), models=["oe", "subspace"], draws=0, early=early)
    ((count, first),) = known
    assert (count, first.model, first.good) == (1, "subspace", True)
    assert "Expected error of another run like these: t" in first.plant.verdict
    assert fitted == [("subspace", None), ("oe", first.plant.dt)]
    assert {row.model for row in found.rows} == {"oe", "subspace"}
    identify(plant_log(), models=["arx"], average=2.0, draws=0, early=early)
    assert len(known) == 1


def test_a_record_of_ninety_slow_rows_is_fitted():
    # a heated room logged each half hour: 90 rows were refused as too short to hold a part out
    rng, t = np.random.default_rng(3), 1800.0 * np.arange(90)
    q = np.repeat(rng.random(15), 6)
    warm = 15 + lfilter([0, 4.0], [1, -0.8], q) + 0.05 * rng.standard_normal(90)
    log = make_log(t, {"q": (q, "1", "input"), "t_room": (warm, "degC", "output")}, name="room")
    found = identify(log, models=["arx", "oe"], draws=0)
    model = found.plant.model
    assert -model.dt / np.log(np.abs(model.poles()).max()) == pytest.approx(-1800 / np.log(0.8), rel=0.1)
    assert {row.n for row in found.rows if row.log == "block 1 of 4"} == {22 - 5 + 11 - 5}
    with pytest.raises(UserError, match=r"79 rows of 1800 s are too few: .* takes 80"):
        identify(log.isel(time=slice(79)), models=["oe"], draws=0)


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ({"models": ["arma"]}, "no model of kind 'arma'"),
        ({"models": ["network"]}, "no model is left"),
        ({"leave_one_out": True}, "at least two logs"),
        ({"outputs": ["t_hand"]}, "no such column"),
    ],
)
def test_impossible_wishes_are_refused_in_one_line(how, says):
    with pytest.raises(UserError, match=says) as caught:
        identify(plant_log(), average=2.0, **how)
    assert "\n" not in str(caught.value)


def test_a_heater_that_never_moves_keeps_its_prior_in_a_network_that_is_named():
    board, rng = prior_plant(load_network("tclab")), np.random.default_rng(0)
    t = np.arange(0.0, 800.0, 4.0)
    signals = {"q1": (60.0 * (t > 40) * (t < 500), "percent", "input"), "q2": (0 * t, "percent", "input")}
    signals |= {name: (np.full(t.size, 23.0), "degC", "output") for name in ("t1", "t2")}
    true = board.values | {"power_1": 1.3 * board.values["power_1"]}
    log = replace(board, values=true).simulate(make_log(t, signals))
    for name in ("t1", "t2"):
        log[name] = ("time", log[name].values + 0.1 * rng.normal(size=t.size), log[name].attrs)
    found = identify(log, "tclab", models=["network"])
    plant = found.plant
    assert plant.values["power_1"] == pytest.approx(true["power_1"], rel=0.1)
    assert plant.values["power_2"] == pytest.approx(board.values["power_2"], rel=1e-3)
    sd = np.sqrt(plant.covariance[plant.free.index("power_2")][plant.free.index("power_2")])
    assert sd == pytest.approx(board.model.specs["power_2"].sd_log, rel=1e-2)
    whys = {role.name: (role.role, role.why) for role in found.signals}
    assert whys["q2"] == (
        "input", "network tclab; it never moves: what it does is known from the prior only"
    )  # fmt: skip
    # black boxes beside it have the heater that moved
    both = identify(log, "tclab", models=["arx", "network"])
    assert {row.model for row in both.rows} == {"arx", "network"}
    with pytest.raises(UserError, match=r"q1 never moves.*q2 never moves"):
        identify(log.assign(q1=log["q2"]), "tclab", models=["network"])


def test_data_that_say_nothing_are_refused():
    constant = plant_log()
    constant["q"].values[:] = 0.3
    with pytest.raises(UserError, match="never moves"):
        identify(constant, models=["arx"])
    constant["t"].values[:] = np.nan
    with pytest.raises(UserError, match="column t: has no reading"):
        identify(constant, models=["arx"])


@needs_real
def test_a_tclab_log_is_predicted_as_well_as_by_the_best_subspace_tools():
    roles = {"inputs": ["q1", "q2"], "outputs": ["t1", "t2"]}
    train, test = (read_log(f"{REAL / 'tclab_prbs.csv'}{cut}", **roles) for cut in ("@:2550", "@2550:"))
    plant = fit_black_box("subspace", [train]).plant
    run = free_run(plant, test, warmup=50.0, score_from=50.0)
    # PO-MOESP of nfoursid reaches 0.740 and N4SID of SIPPY 0.786 on the same halves
    assert np.mean([s.rmse for s in run.scores.values()]) < 0.74
    assert all(s.n == 2500 for s in run.scores.values())


def test_an_output_that_never_moves_is_refused_by_name():
    log = plant_log()
    log["dead"] = ("time", np.full(log.sizes["time"], 25.0), {"units": "degC", "role": "output"})
    with pytest.raises(UserError, match=r"column dead: reads 25 whenever it reads.*--outputs"):
        identify(log, models=["arx"], average=1.0)
    assert identify(log, outputs=["t"], models=["arx"], average=1.0, draws=0).plant.outputs == ("t",)


@pytest.mark.parametrize("kind", ["oe", "network"])
def test_draws_that_cannot_be_made_are_a_note_and_the_fit_is_kept(monkeypatch, kind):
    def fails(*_, **__):
        raise np.linalg.LinAlgError("planted")

    log = plant_log(500)
    block = StateSpaceModel(("q",), (), ("t",), A=[[0.95]], B=[[0.5]], C=[[1.0]], dt=1.0, y0=[25.0])
    plant = Plant(block, {}, dt=1.0, units={"q": "1", "t": "degC"})
    monkeypatch.setattr("thermogrip.sysid.greybox.fit.fit_network", lambda *_, **__: plant)
    monkeypatch.setattr("thermogrip.sysid.greybox.posterior.fit_problem", lambda *_: None)
    for name in ("greybox.posterior.with_draws", "identification.with_refits"):
        monkeypatch.setattr(f"thermogrip.sysid.{name}", fails)
    signals = {"inputs": ("q",), "disturbances": (), "outputs": ("t",), "switches": ()}
    network = SimpleNamespace(name="block", units={}, **signals)
    found = identify(log, network, models=[kind], average=1.0)
    assert found.plant.samples is None
    assert not found.plant.refits
    assert f"{kind}: no draws, the fit is kept without: planted" in found.notes


def test_a_signal_that_only_a_later_log_has_is_left_out_and_reported():
    first, second = plant_log(), plant_log(seed=1, name="b")
    second["t_room"] = ("time", np.full(second.sizes["time"], 22.0), {"units": "degC", "role": "disturbance"})
    found = identify([first, second], models=["arx"], average=2.0, draws=0)
    assert "b: t_room left out, for a has no such signal" in found.notes


def with_still(role="input", **more):
    log = plant_log()
    for name, value in more.items():
        log[name] = ("time", np.full(900, value), {"units": "1", "role": role})
    return log


def test_a_guessed_column_that_never_moves_is_left_out_and_reported():
    log = with_still(fan=0.4, valve=7.0)
    log.attrs["guesses"] = "fan: its name is that of a drive\nvalve: its unit is V"
    found = identify(log, models=["arx"], average=2.0, draws=0)
    assert found.plant.inputs == ("q",)
    whys = {s.name: (s.role, s.why) for s in found.signals}
    assert whys["fan"] == ("left out", "its name is that of a drive, but it never moves")
    assert whys["valve"] == ("left out", "its unit is V, but it never moves")
    assert log["fan"].attrs["role"] == "input"  # the caller's log is as it was
    moved = with_still(fan=0.4)
    moved["fan"].values[400:500] = 0.9
    moved.attrs = dict(log.attrs, name="b")
    both = identify([log, moved], models=["arx"], average=2.0, draws=0)
    assert both.plant.inputs == ("q", "fan")


def test_stated_inputs_that_never_move_are_refused_together_with_the_way_out():
    with pytest.raises(UserError, match=r"fan never moves.*; valve never moves") as refused:
        identify(with_still(fan=0.4, valve=7.0), models=["arx"], average=2.0)
    assert "or name what you set with --inputs q" in str(refused.value)


@pytest.mark.parametrize("kind", ["oe", "subspace"])
def test_an_input_that_never_moves_has_no_gain(kind):
    log = plant_log()
    log["fan"] = ("time", np.ones(log.sizes["time"]), {"units": "1", "role": "input"})
    found = fit_black_box(kind, [log], average=1.0)
    gain = steady_gain(found.plant.model)[0]
    moved, still = (found.plant.model.inputs.index(name) for name in ("q", "fan"))
    assert gain[moved] == pytest.approx(10.0, rel=0.05)
    assert abs(gain[still]) < 1e-6


@pytest.mark.parametrize(
    ("rmse", "high", "held", "own", "checked", "doubts", "said"),  # errors [K] beside 2 K without input
    [
        (0.99, 1.9, 0.9, 0.9, "ok", (), "Good for simulation"),
        (1.01, 1.9, 0.9, 0.9, "ok", (), "Not good (arx): on another run t errs by 50% of no input's"),
        (0.5, 2.01, 0.9, 0.9, "ok", (), "Good for simulation"),  # one part of moves that no other has
        (0.5, 1.9, 1.01, 0.9, "ok", (), "Not good (arx): on parts held out t errs by 51%"),
        (0.5, 1.9, 0.9, 1.01, "ok", (), "Not good (arx): on the logs of its own fit t errs by 50%"),
        (0.5, 1.9, 0.9, 0.9, "fail", (), "Not good (arx): q never moves"),
        (0.5, 1.9, 0.9, 0.9, "tail", (), "Not good (arx): on the last part held out t errs by 90%"),
        (0.5, 1.9, 0.9, 0.9, "untested", (), "Not good (arx): q moves in no part held out whose rest moves"),
        (0.5, 1.9, 0.9, 0.9, "ok", ("a guess", "b"), "Not good (arx) as long as this is in doubt: a guess"),
    ],
)
def test_a_plant_is_good_where_it_errs_by_less_than_half_of_no_input_on_parts_in_the_fit_and_on_another_run(
    rmse: float, high: float, held: float, own: float, checked: str, doubts: tuple[str, ...], said: str
) -> None:
    rows = table({"arx": {"moves": held / 2, "still": 0.0}, "other": {"a": 0.9}})
    rows += table({"arx": {"own": own / 2}}, False)
    if checked == "tail":
        rows += table({"arx": {**{f"block {k}": 0.1 for k in range(9)}, "last 30 % of a": 0.9}})
    # where nothing moves a model without input errs by nothing: such a part condemns no plant
    rows[1] = replace(rows[1], rmse=0.01, no_input_rmse=1e-4)
    quality: Any = SimpleNamespace(findings=[SimpleNamespace(verdict=checked, says="q never moves")])
    untested = {"fan": 0.0, "q": 0.3} if checked == "untested" else {"fan": 0.0}
    scores = PlantScores(expected={"t": ExpectedError(rmse, 0.1, high)}, untested=untested)
    plant: Any = SimpleNamespace(scores=scores, units={"t": "K"}, logs=("a", "b", "c"), model=None)
    found, words = stated_errors.verdict_of("arx", plant, rows, quality, doubts)
    assert found == said.startswith("Good")
    assert words.startswith(said)
    assert words.endswith(f" Expected error of another run like these: t {rmse:.2g} K (0.1 to {high:.2g}).")


def test_no_part_held_out_tests_an_input_of_one_pulse_and_one_that_stays_on_is_of_the_operating_point():
    rng, t = np.random.default_rng(0), np.arange(800.0)
    pulse, steps, fan = np.clip((t - 30) // 9, 0, 3) * (t < 60), np.repeat(rng.random(40), 20), 2.0 * (t > 5)
    for q, spreads in ((pulse, {"q": pytest.approx(0.1, abs=0.06), "fan": 0.0}), (steps, {"fan": 0.0})):
        y = 20 + lfilter([0, 0.2], [1, -0.98], q) - 1e-4 * t + 0.01 * rng.standard_normal(800)
        columns = {"q": (q, "1", "input"), "fan": (fan, "1", "input"), "t": (y, "degC", "output")}
        found = identify(make_log(t, columns), models=["arx"], average=1.0)
        assert found.plant.scores.untested == spreads  # by draws; 0: no part of what is stated
        assert found.good is ("q" not in spreads)
        assert ("q moves in no part held out" in found.verdict) is ("q" in spreads)
        only_fan = make_log(t, columns | {"q": (0 * t + q.min(), "1", "input")})
        assert np.abs(effect_of_inputs(found.plant, [only_fan], 1.0)["t"]).max() < 1e-9


def table(shares, held=True):
    """Rows by candidate and log, of an error of ``share`` times that of a model without input, 2 K."""
    return [
        stated_errors.Row(log, "t", 2.0 * share, 90.0, "K", 100, model, "", 2.0, held)
        for model, logs in shares.items()
        for log, share in logs.items()
    ]


@pytest.mark.parametrize(
    ("shares", "chosen"),
    [({"arx": {"a": 0.2, "b": 0.4}, "oe": {"a": 0.25, "b": 0.3}}, "oe"), ({}, None),
     ({"arx": {"a": 0.2, "b": 0.4}, "oe": {"a": 0.1}}, "arx"),  # oe is not scored on every log
     ({"arx": {"a": 0.2, "b": 0.2}, "network": {"a": 0.22, "b": 0.22}}, "network"),
     ({"arx": {"a": 0.2, "b": 0.2}, "network": {"a": 0.22, "b": 0.221}}, "arx"),
     ({"arx": {"a": 0.2, "b": np.inf}, "oe": {"a": 0.9, "b": 0.9}}, "oe"),
     ({"arx": {"a": np.inf, "b": np.inf}}, "arx"),  # it diverged, and there is no network
     ({"oe": {"a": 0.1}}, None)],
)  # fmt: skip
def test_the_candidate_of_the_least_error_is_kept_and_a_network_within_a_tenth(shares, chosen):
    assert identification.choose_model(table(shares), 2) == chosen


def test_errors_stated_and_kept_are_those_of_what_was_held_out():
    tail = "last 30 % of a"
    rows = [*table({"arx": {tail: 1.5, "block 1 of 4": 1.0}}), *table({"oe": {"a": 1.0}})]
    rows += table({"arx": {"a": 1.0}}, False)
    rows[0] = replace(rows[0], fit_percent=np.nan)  # of a constant reading
    model = StateSpaceModel(("q",), (), ("t",), A=[[0.9]], B=[[1.0]], C=[[1.0]], dt=1.0)
    plant = identification._with_expected(Plant(model, {}, dt=1.0), "arx", rows, [], None)
    assert plant.scores.held_out == [
        HeldOut(tail, "t", 3.0, 0.0, "K", 100), HeldOut("block 1 of 4", "t", 2.0, 90.0, "K", 100),
    ]  # fmt: skip
    assert plant.scores.expected == {"t": expected_error([3.0, 2.0], 0.0)}
    assert plant.scores.expected["t"].rmse == pytest.approx(6.0**0.5)
    assert identification._mean_errors([replace(rows[0], no_input_rmse=0.0)]) == {"arx": 3e12}


@pytest.mark.parametrize(("off", "doubted"), [(1.1, False), (9.0, True), (1 / 9.0, True)])
def test_a_parameter_far_beyond_its_prior_is_a_doubt_that_names_the_network(off, doubted):
    """A printer's heater block was fitted by a furnace, a parameter nine times its prior's end, and good."""
    plant = prior_plant(load_network("tclab"))
    name = plant.free[0]
    spec = plant.model.specs[name]
    end = spec.value * np.exp(1.645 * spec.sd_log * (1 if off > 1 else -1))
    found = stated_errors._far_from_prior(replace(plant, values=plant.values | {name: end * off}))
    assert [name in line and "network tclab" in line for line in found] == [True] * doubted


@pytest.mark.parametrize(("gain", "doubts"), [(2.0, 0), (-0.26, 1)])
def test_a_heater_that_cools_is_a_doubt(gain, doubts):
    model = StateSpaceModel(("heater",), (), ("t",), A=[[0.9]], B=[[0.1 * gain]], C=[[1.0]], dt=1.0)
    plant = Plant(model, {}, dt=1.0, units={"heater": "percent", "t": "degC"}, valid={"heater": (0.0, 100.0)})
    found = stated_errors.doubts_of(plant, plant_dynamics(plant))
    assert len(found) == doubts
    assert all(f"heater lowers t (gain {gain:.2g}): recorded in closed loop" in line for line in found)


@pytest.mark.parametrize(("gain", "good"), [(1.0, True), (0.0, False)])
def test_an_input_whose_effect_has_no_certain_sign_is_a_doubt(gain, good):
    """A house was good for control by its weather alone: its heating had a gain of -.05 to .07."""
    rng = np.random.default_rng(5)
    q, room = np.repeat(rng.choice([0.0, 1.0], (2, 60)), 15, axis=1)
    t = lfilter([0.0, 0.1], [1, -0.9], gain * q + 3 * room) + 0.05 * rng.standard_normal(900)
    columns = {"q": (q, "1", "input"), "room": (room, "1", "disturbance"), "t": (t, "1", "output")}
    found = identify([make_log(np.arange(900.0), columns)], models=["arx"])
    assert found.good is good
    assert any("whether q raises or lowers t" in line for line in found.doubts) is not good


@pytest.mark.parametrize(
    ("step", "score_from", "dt", "expected"),
    [(0.5, 0.0, 1.0, (5.0, 5.0)), (0.5, 10.0, 1.0, (25.0, 25.0)), (0.5, 300.0, 1.0, (25.0, 300.0)),
     (2.0, 10.0, 1.0, (60.0, 60.0)), (0.5, 0.0, 7.0, (7.0, 7.0)), (2.0, 10.0, 90.0, (90.0, 90.0))],
)  # fmt: skip
def test_a_log_that_begins_warm_has_fifty_rows_of_warm_up(monkeypatch, step, score_from, dt, expected):
    asked = []
    monkeypatch.setattr(identification, "free_run", lambda *_, **how: asked.append(how))
    log = plant_log()
    held = Held(log.assign_coords(time=log["time"].values * step), "a", score_from)
    plant: Any = SimpleNamespace(dt=dt, model=SimpleNamespace(kind="arx"))
    identification.run_held_out(plant, held, unseen=True)
    assert asked == [{"warmup": expected[0], "score_from": expected[1], "tests": False}]


def test_columns_are_what_was_named_what_the_network_has_or_what_was_guessed():
    first, second = with_still(fan=0.4, lamp=0.1, room=3.0), with_still(fan=0.5, extra=1.0)
    first.attrs["guesses"] = "fan: its unit is V\nno colon"
    second.attrs["guesses"] = "fan: other\nt: its name is: x"
    second["q"].attrs["units"] = "V"
    logs = [first, second]
    assert preparation.moves([first.assign(lamp=first["lamp"] * np.nan)], "lamp")
    network: Any = SimpleNamespace(name="block", inputs=("q",), disturbances=("room",), outputs=("t",))
    lists = {"inputs": ["q"], "disturbances": None, "outputs": None}
    found, unused = preparation.signal_roles(logs, (("q",), ("room",), ("t",)), lists, network)
    assert unused == []  # a list says what is used
    assert [(s.name, s.unit, s.role, s.why, s.guessed) for s in found] == [
        ("q", "1", "input", "named", False),
        ("room", "1", "disturbance", "network block", False),
        ("t", "degC", "output", "network block", False),
        ("fan", "1", "left out", "its unit is V", True),
        ("extra", "1", "left out", "not named", False),
        ("lamp", "1", "left out", "not named", False),
    ]
