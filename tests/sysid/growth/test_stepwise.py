"""Growth keeps a term that the data ask for, refuses one that they do not, and says why."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from tests.sysid.greybox.makers import heater
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, make_log
from thermogrip.sysid.greybox.problem import prior_plant
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
from thermogrip.sysid.growth.stepwise import Growth, GrowthRow, _against, folds_of, grow, growth_table
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


def test_a_gain_that_a_line_in_time_gives_too_is_refused():
    assert "straight line" in _against(ZONE, gain=0.15, se=0.1, straight=0.05)
    assert _against(ZONE, gain=0.15, se=0.1, straight=0.1) == ""
    assert "standard error" in _against(ZONE, gain=0.15, se=0.2, straight=0.15)
    less = replace(ZONE, change="remove")
    assert _against(less, gain=-0.2, se=0.5, straight=0.0) == "its loss costs 20 %"
    assert [_against(less, gain=g, se=0.02, straight=0.0) == "" for g in (-0.019, -0.021)] == [True, False]


def test_what_one_log_alone_shows_is_scored_on_its_second_half():
    logs = logs_of(block(), {"G": 0.4, "P": 14.0})
    still = [log.assign(q=("time", np.zeros(log.sizes["time"]), log["q"].attrs)) for log in logs[:2]]
    folds = folds_of(block(), [*still, logs[2]])
    assert folds[2].score_from == pytest.approx(239.5)
    assert folds[2].train[2]["time"].values[-1] <= 240
    assert [len(fold.train) for fold in folds] == [2, 2, 3]


def test_one_log_is_cut_into_blocks_that_are_never_fitted_and_scored_at_once():
    log = logs_of(block(), {})[0]
    for fold in folds_of(block(), [log]):
        tested = set(fold.test["time"].values.tolist())
        assert all(tested.isdisjoint(part["time"].values.tolist()) for part in fold.train)
    with pytest.raises(UserError, match="too short"):
        folds_of(block(), [log.isel(time=slice(0, 200))])


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


@pytest.mark.parametrize("term", ["drive", "|drive|", "drive*drive", "t_tank*drive", "t_ambient", "pump"])
def test_whatever_a_term_proposes_is_a_network(term: str):
    gripper = load_network("gripper")
    asked = proposed(gripper, [ResidualTerm("t_surface", term, 100.0, 0.2)])
    assert asked
    for candidate, _ in asked:
        assert len(patched(gripper, candidate).parameters) > len(gripper.parameters), candidate.name


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
