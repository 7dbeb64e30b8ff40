"""Growth keeps a term that the data ask for, refuses one that they do not, and says why."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from tests.sysid.greybox.makers import heater
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, make_log
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.growth import stepwise
from thermogrip.sysid.growth.candidates import (
    Candidate,
    ResidualTerm,
    _parts,
    lagging_air,
    meaning,
    patched,
    proposed,
    residual_terms,
    suggested,
)
from thermogrip.sysid.growth.stepwise import Fold, Growth, GrowthRow, _against, folds_of, grow, growth_table
from thermogrip.sysid.models.network import NetworkModel, load_network
from thermogrip.sysid.models.network_spec import network_from_dict
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant

ZONE = Candidate(
    "second zone",
    {
        "nodes": {"core": {"capacity": "C_core"}},
        "links": {"core": {"between": ["block", "core"], "conductance": "G_core"}},
        "parameters": {
            "C_core": {"unit": "J/K", "value": 20.0, "sd_log": 1.0},
            "G_core": {"unit": "W/K", "value": 1.0, "sd_log": 1.4},
        },
    },
)
BEND = Candidate(
    "convection",
    {
        "links": {"loss": {"bend": "bend"}},
        "parameters": {"bend": {"unit": "1", "value": 0.1, "sd": 0.1, "low": 0.0}},
    },
)


@pytest.fixture(autouse=True)
def local_fits(monkeypatch):
    """A network that lacks a term looks stuck, and a random search finds it no better end."""
    monkeypatch.setattr("thermogrip.sysid.greybox.fit._looks_stuck", lambda problem, solution: False)


def block() -> NetworkModel:
    """The heated block without its sensor's lag."""
    content = heater().to_dict()["network"]
    del content["outputs"]["t"]["lag"], content["parameters"]["lag"]
    return NetworkModel(network_from_dict(content))


def logs_of(model: NetworkModel, values: dict[str, float]) -> list[Log]:
    """Three runs of a true model with white noise."""
    out = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        t = np.arange(0.0, 480.0, 1.0)
        q = np.repeat(rng.random(31) < 0.5, 30)[: t.size] * (t >= 10.0)
        air = np.full(t.size, 21.0)
        start = {"q": (q, "1", "input"), "air": (air, "degC", "disturbance"), "t": (air, "degC", "output")}
        plant = prior_plant(model)
        run = replace(plant, values=plant.values | values).simulate(make_log(t, start))
        read = run["t"].values + 0.05 * rng.standard_normal(t.size)
        out.append(make_log(t, start | {"t": (read, "degC", "output")}, name=f"run{seed}"))
    return out


def test_a_planted_second_zone_is_found_and_convection_that_is_not_there_refused():
    truth = {"C_core": 30.0, "G_core": 0.7, "G": 0.4, "P": 14.0}
    logs = logs_of(patched(block(), ZONE), truth)
    grown = grow(block(), logs, [BEND, ZONE], folds=folds_of(block(), logs)[:2])
    kept = [row for row in grown.rows if row.verdict == "kept"]
    assert [row.candidate for row in kept] == ["block", "second zone"]
    assert kept[1].gain > max(0.5, kept[1].se)
    last = next(row for row in grown.rows if row.round == 2)
    assert (last.candidate, last.verdict) == ("convection", "refused")
    assert last.why
    assert grown.evaluations == len(grown.rows) - 1 == 3
    for name, value in truth.items():
        assert grown.plant.values[name] == pytest.approx(value, rel=0.1), name


def test_a_term_that_nothing_asks_for_is_refused_and_a_needless_one_dropped():
    logs = logs_of(block(), {"G": 0.4, "P": 14.0})
    folds = folds_of(block(), logs)[:2]
    grown = grow(block(), logs, [ZONE, BEND], folds=folds, rounds=1)
    assert [row.verdict for row in grown.rows] == ["kept", "refused", "refused"]
    needless = Candidate("no zone", {"nodes": {"core": None}, "links": {"core": None}}, "remove")
    pruned = grow(patched(block(), ZONE), logs, [needless], folds=folds, rounds=1)
    assert pruned.rows[1].verdict == "kept"
    assert pruned.network.parameters == block().parameters


@pytest.mark.parametrize(
    ("change", "gain", "se", "straight", "why"),
    [
        ("add", 0.15, 0.1, 0.075, ""), ("add", 0.15, 0.15, 0.15, ""), ("add", 0.01, 0.005, 0.01, ""),
        ("add", 0.15, 0.1, 0.074, "a straight line in time explains its gain as well"),
        ("add", 0.15, 0.151, 0.15, "gain within one standard error"),
        ("add", 0.0099, 0.001, 0.0099, "no gain on held-out logs"),
        ("add", -0.0099, 0.001, 0.0, "no gain on held-out logs"),
        ("add", -0.0101, 0.001, 0.0, "larger error on held-out logs"),
        ("remove", -0.2, 0.5, 0.0, "its loss costs 20 %"), ("remove", -0.0299, 0.5, 0.0, ""),
        ("remove", -0.0301, 0.5, 0.0, "its loss costs 3 %"), ("remove", -0.019, 0.02, 0.0, ""),
        ("remove", -0.021, 0.02, 0.0, "its loss costs 2 %"), ("remove", -0.0099, 0.001, 0.0, ""),
        ("remove", -0.0101, 0.001, 0.0, "its loss costs 1 %"),
    ],
)  # fmt: skip
def test_what_held_out_logs_refuse(change, gain, se, straight, why):
    assert _against(replace(ZONE, change=change), gain=gain, se=se, straight=straight) == why


def test_errors_are_compared_in_pairs_as_geometric_means():
    assert stepwise._size([np.array([2.0, -2.0]), np.array([8.0, 8.0, 8.0])]) == pytest.approx(4.0)
    gain, se = stepwise._gain(np.array([2.0, 4.0]), np.array([1.0, 4.0]))
    assert (gain, se) == pytest.approx((np.log(2) / 2, np.log(2) / 2))
    assert stepwise._gain(np.array([2.0]), np.array([1.0])) == (pytest.approx(np.log(2)), np.inf)
    time, odd = np.array([100.0, 101.0, 102.0, 103.0]), np.array([1.0, -1.0, -1.0, 1.0])
    np.testing.assert_allclose(stepwise._without_line(time, 3.0 + 2.0 * time + odd), odd, atol=1e-9)


def report(**given):
    return SimpleNamespace(
        **({"on_bound": [], "prior_only": [], "condition": 10.0, "weakest": "a and b"} | given)
    )


@pytest.mark.parametrize(
    ("change", "after", "before", "why"),
    [
        ("add", {}, {}, ""), ("add", {"on_bound": ["P"]}, {"on_bound": ["P"]}, ""),
        ("add", {"on_bound": ["P", "G_core"]}, {"on_bound": ["P"]}, "on a bound: G_core"),
        ("add", {"prior_only": ["P"]}, {}, ""),
        ("add", {"prior_only": ["C_core", "G_core"]}, {}, "known from the prior only: C_core, G_core"),
        ("add", {"condition": 1e7}, {}, ""), ("add", {"condition": 1.1e7}, {}, "badly conditioned: a and b"),
        ("add", {"condition": 2.9e8}, {"condition": 1e8}, ""), ("remove", {"condition": 1e9}, {}, ""),
        ("add", {"condition": 3.1e8}, {"condition": 1e8}, "badly conditioned: a and b"),
    ],
)  # fmt: skip
def test_what_is_not_identifiable_is_refused(change, after, before, why):
    candidate, grown = replace(ZONE, change=change), patched(block(), ZONE)
    assert stepwise._not_identifiable(candidate, block(), grown, report(**after), report(**before)) == why


@pytest.mark.parametrize(
    ("warmup", "score_from", "used"),
    [(5.0, 0.0, (5.0, 5.0)), (0.2, 100.0, (1.0, 100.0)), (200.0, 100.0, (100.0, 100.0))],
)
def test_a_held_out_log_is_scored_behind_its_warm_up(warmup, score_from, used):
    air = np.full(4, 21.0)
    signals = {"q": (air, "1", "input"), "air": (air, "degC", "disturbance")}
    log = make_log(np.arange(4.0), signals | {"t": ([1.0, 2.0, np.nan, 4.0], "degC", "output")})
    seen = {}

    def simulate(test, **given):
        seen.update(given)
        return test.assign(t=test["t"] + [9.0, 0.5, 0.5, 0.25], scored=("time", [0, 1, 1, 1]))

    fold = Fold("a", (), log, score_from)
    ((time, error),) = stepwise._held_out_errors(SimpleNamespace(simulate=simulate), fold, ["t"], warmup)
    assert (seen["warmup"], seen["score_from"]) == used
    assert (time.tolist(), error.tolist()) == ([1.0, 3.0], [0.5, 0.25])


def test_growth_goes_from_the_best_candidate_on(monkeypatch):
    """Held-out errors by what a network has: its zone saves a half, its bend a tenth, both together more."""
    errors = {(): 1.0, ("zone",): 0.5, ("bend",): 0.9, ("bend", "zone"): 0.4}
    seen = []

    def trial(model, cases, wanted, warmup, base):
        has = tuple(n for n, key in (("bend", "bend"), ("zone", "C_core")) if key in model.parameters)
        seen.append((has, len(cases), wanted, warmup, None if base is None else base.rmse[0]))
        return stepwise._Trial(model, (), errors[has] * np.ones(2), errors[has] * np.array([1.0, 1.001]))

    fits = []
    monkeypatch.setattr(stepwise, "_try", trial)
    monkeypatch.setattr(
        stepwise, "fit_network", lambda m, logs, near=None: (fits.append(near), prior_plant(m))[1]
    )
    monkeypatch.setattr(stepwise, "_identifiability", lambda plant: report(condition=len(plant.values)))
    monkeypatch.setattr(stepwise, "residual_terms", lambda plant, logs, warmup: (warmup,))
    cases, told = [SimpleNamespace(name="f"), SimpleNamespace(name="g")], []
    grown = grow(block(), [], [ZONE, BEND, replace(BEND, name="again")], folds=cases, warmup=7.0,
                 progress=lambda f, w: told.append((f, w)))  # fmt: skip
    about = [(r.round, r.candidate, r.verdict, r.why, r.condition) for r in grown.rows]
    assert about == [
        (0, "block", "kept", "as it came", 3), (1, "second zone", "kept", "50 % less error", 5),
        (1, "convection", "good", "10 % less error", 4), (1, "again", "good", "10 % less error", 4),
        (2, "convection", "kept", "20 % less error", 6), (2, "again", "good", "20 % less error", 6),
    ]  # fmt: skip
    assert grown.rows[1].gain == pytest.approx(np.log(2))
    assert (grown.rows[1].rmse, grown.evaluations, grown.residual) == ({"f": 0.5, "g": 0.5}, 5, (7.0,))
    assert set(grown.network.parameters) == {"C", "G", "P", "C_core", "G_core", "bend"}
    assert seen[0] == ((), 2, ("t",), 7.0, None)
    assert [s[4] for s in seen[1:]] == [1.0, 1.0, 1.0, 0.5, 0.5]
    assert fits[:2] == [None, prior_plant(block()).values]
    assert [round(f, 3) for f, _ in told] == [0.0, 0.167, 0.333, 0.5, 0.75, 1.0]
    assert (told[1][1], told[-1][1]) == ("round 1: convection", "grown")
    with pytest.raises(UserError, match="no output 'x'; there are t"):
        grow(block(), [], [ZONE], folds=cases, outputs=["x"])
    # without candidates the residual proposes, anew behind each change but the last
    asked = []
    monkeypatch.setattr(
        stepwise,
        "_proposals",
        lambda m, terms, wanted, others=None: (
            asked.append((len(m.parameters), terms, wanted, others)),
            [(ZONE if len(asked) == 1 else BEND, f"t: {len(asked)}")],
        )[1],
    )
    named = [(r.candidate, r.asked, r.verdict) for r in grow(block(), [], folds=cases, warmup=7.0).rows[1:]]
    assert named == [("second zone", "t: 1", "kept"), ("convection", "t: 2", "kept")]
    assert asked == [(3, (7.0,), ("t",), None), (5, (7.0,), ("t",), [])]
    # once, where one round is asked for; what costs nothing goes
    assert [r.round for r in grow(block(), [], [ZONE], folds=cases, rounds=1).rows] == [0, 1]
    errors[()] = 0.5
    less = Candidate("no zone", {"nodes": {"core": None}, "links": {"core": None}}, "remove")
    pruned = grow(patched(block(), ZONE), [], [less], folds=cases)
    assert [(r.verdict, r.why) for r in pruned.rows[1:]] == [("kept", "costs nothing")]
    monkeypatch.setattr(
        stepwise, "_identifiability", lambda plant: report(prior_only=["C_core"], condition=2.0)
    )
    errors[()] = 1.0
    (_, row) = grow(block(), [], [ZONE], folds=cases).rows
    assert (row.verdict, row.why, row.condition) == ("refused", "known from the prior only: C_core", 2.0)


def test_what_one_log_alone_shows_is_scored_on_its_second_half():
    logs = logs_of(block(), {"G": 0.4, "P": 14.0})
    still = [log.assign(q=("time", np.zeros(log.sizes["time"]), log["q"].attrs)) for log in logs[:2]]
    folds = folds_of(block(), [*still, logs[2]])
    assert folds[2].score_from == pytest.approx(239.5)
    assert folds[2].train[2]["time"].values[-1] <= 240
    assert [len(fold.train) for fold in folds] == [2, 2, 3]


def test_fewer_logs_are_cut_into_blocks_that_are_never_fitted_and_scored_at_once():
    log, other = (part.isel(time=slice(0, 361)) for part in logs_of(block(), {})[:2])
    folds = folds_of(block(), [log, other])
    assert [fold.name for fold in folds] == [f"run{i}, part {k}" for i in (0, 1) for k in (1, 2, 3)]
    assert [len(fold.train) for fold in folds] == [2, 3, 2] * 2
    assert {fold.score_from for fold in folds} == {100.0}
    ends = [fold.test["time"].values[[0, -1]].tolist() for fold in folds[:3]]
    np.testing.assert_allclose(ends, [[0, 120], [120, 240], [240, 360]], atol=1.0)
    for fold in folds:
        assert fold.train[0] is (other if fold.name.startswith("run0") else log)
        tested = set(fold.test["time"].values.tolist())
        assert all(tested.isdisjoint(part["time"].values.tolist()) for part in fold.train[1:])
    with pytest.raises(UserError, match="too short to hold a part out; give a longer log"):
        folds_of(block(), [log.isel(time=slice(0, 360))])


@pytest.mark.parametrize("name", ["gripper", "peltier_chamber", "tclab"])
def test_every_suggestion_is_a_network_of_its_own(name: str):
    model = load_network(name)
    found = suggested(model)
    assert len({c.name for c in found}) == len(found) > 3
    for candidate in found:
        changed = patched(model, candidate)
        more = len(changed.parameters) - len(model.parameters)
        assert more > 0 if candidate.change == "add" else more < 0, candidate.name


def test_an_unmodelled_zone_shows_in_the_residual_proposes_itself_and_is_kept(monkeypatch):
    monkeypatch.setattr("thermogrip.sysid.growth.stepwise.suggested", lambda model: [BEND])
    logs = logs_of(patched(block(), ZONE), {"C_core": 60.0, "G_core": 0.5, "G": 0.4, "P": 14.0})
    grown = grow(block(), logs, folds=folds_of(block(), logs)[:2], rounds=1)
    kept = next(row for row in grown.rows if row.verdict == "kept" and row.change == "add")
    assert kept.candidate == "block: second zone"
    assert kept.asked.startswith("t: ")
    assert grown.residual
    assert (grown.rows[-1].candidate, grown.rows[-1].asked) == ("convection", "")  # beside what is asked for


def test_terms_propose_what_they_stand_for_the_largest_first_and_nothing_that_is_there():
    gripper = load_network("gripper")
    still = ResidualTerm("t_surface", "pump*t_tank", 40.0, 0.1)
    slow = ResidualTerm("t_tank", "t_tank", 200.0, 0.4)
    asked = proposed(gripper, [still, slow])
    assert [c.name for c, _ in asked] == [
        "water: second zone", "G_tube_film: film follows the flow",
        "wall_water: film follows the flow", "finger_pipe: film follows the flow",
    ]  # fmt: skip
    assert [term for _, term in asked] == [slow, still, still, still]
    parameters = asked[0][0].patch["parameters"]
    assert parameters["C_water_zone"]["value"] / parameters["G_water_zone"]["value"] == pytest.approx(200.0)
    grown = patched(gripper, asked[0][0])
    assert "water: second zone" not in [c.name for c, _ in proposed(grown, [slow])]
    assert "water: second zone" not in [c.name for c in suggested(grown)]


def test_lagging_air_is_the_ambient_through_a_first_order_lag():
    model = patched(block(), lagging_air(block().network, "air", tau=100.0))
    t = np.arange(0.0, 2000.0)
    air, none = np.where(t < 100, 20.0, 22.0), np.zeros(t.size)
    signals = {"q": (none, "1", "input"), "air": (air, "degC", "disturbance")}
    log = make_log(t, signals | {"t": (np.full(t.size, 20.0), "degC", "output")})
    read = prior_plant(model).simulate(log)["t"].values
    since = np.maximum(t - 100, 0.0)
    one, other = 100.0, 50.0 / 0.5  # of the air, and of the block: equal time constants
    assert one == other
    expected = 20.0 + 2.0 * (1 - (1 + since / one) * np.exp(-since / one))
    # the measured ambient is smoothed over 20 s; the block takes 1 % of the air's heat
    np.testing.assert_allclose(read, expected, atol=0.05)


def test_a_film_that_follows_the_flow_carries_less_while_the_pump_rests():
    model = load_network("gripper")
    film = next(c for c in suggested(model) if c.name == "finger_pipe: film follows the flow")
    changed = patched(model, film).network.links["finger_pipe"]
    assert (changed.switch, changed.off) == ("pump", "G_film_off")


def log_of(n=1500, *, seed=0, magnitude=0.0, noise=0.02, name="a"):
    """A heater of 60 s that also warms by the magnitude of its drive."""
    rng = np.random.default_rng(seed)
    drive = np.repeat(rng.uniform(-1, 1, n // 30), 30)
    a = np.exp(-1 / 60)
    t = 25 + lfilter([0, 1 - a], [1, -a], 8 * drive + magnitude * np.abs(drive))
    signals = {"drive": (drive, "1", "input"), "t": (t + noise * rng.standard_normal(n), "degC", "output")}
    return make_log(np.arange(float(n)), signals, name=name)


@pytest.fixture(scope="module")
def line() -> Plant:
    a = float(np.exp(-1 / 60))
    model = StateSpaceModel(("drive",), (), ("t",), A=[[a]], B=[[8 * (1 - a)]], C=[[1.0]], dt=1.0, y0=[25.0])
    return Plant(model, {}, dt=1.0)


@pytest.mark.parametrize("count", [1, 3])
def test_the_term_that_is_missing_is_named_with_its_time_constant(line, count):
    logs = [log_of(seed=s, magnitude=2.0, name=str(s)) for s in range(count)]
    found = residual_terms(line, logs, warmup=1.0)
    assert found[0].term == "|drive|"
    assert 25 < found[0].tau < 150
    assert found[0].share > 0.7


def test_white_noise_gives_no_term(line):
    assert residual_terms(line, [log_of(seed=s, name=str(s)) for s in range(3)]) == ()


def test_a_log_that_says_nothing_is_refused(line):
    with pytest.raises(UserError, match="too short to learn from its residual"):
        residual_terms(line, [log_of(30), log_of(1500, name="b")])


@pytest.mark.parametrize(
    ("lengths", "stretches"),
    [
        ([8], [0, 0, 1, 1, 2, 2, 3, 3]),
        ([4, 8], [0, 1, 2, 3, 4, 4, 5, 5, 6, 6, 7, 7]),
        ([2, 3, 1], [0, 0, 1, 1, 1, 2]),
    ],
)
def test_of_three_logs_a_whole_one_is_left_out_and_of_fewer_a_quarter(lengths, stretches):
    assert _parts(lengths).tolist() == stretches


def test_the_table_of_a_record_has_a_row_for_each_comparison():
    row = GrowthRow(1, "h1: zone", "add", {"run": 0.31}, 0.02, 0.05, np.nan, "refused", "noise", "t: q")
    header, (cells,) = growth_table(Growth(block(), prior_plant(block()), (row,), 1))
    assert dict(zip(header, cells)) == {
        "round": "1", "candidate": "h1: zone", "proposed by": "t: q", "change": "add", "run": "0.310",
        "gain [%]": "2.0 +- 5.0", "condition": "-", "verdict": "refused", "why": "noise",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("term", "kind"), [("drive*|drive|", "|u|*u"), ("pump*t_tank", "T*s"), ("t_ambient", "d"), ("drive", "u")]
)
def test_a_term_has_the_kinds_of_its_signals_in_a_fixed_order(term: str, kind: str):
    assert meaning(load_network("gripper"), term) == kind
