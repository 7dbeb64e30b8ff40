"""A class of the user's own behaves as a network does, and whatever is wrong in it is one line."""
# ruff: noqa: RUF012 - tables on the class, as a user writes them

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import casadi
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.sysid.models.makers import roll_rows
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log, make_log
from thermogrip.sysid.greybox.fit import fit_network, free_runs
from thermogrip.sysid.greybox.posterior import fit_problem, with_draws
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.models.user_model import OwnModel, load_object, own_model
from thermogrip.sysid.plant.plant import Plant

PARAMETERS = {
    "C": {"unit": "J/K", "value": 50.0, "fixed": True},
    "G": {"unit": "W/K", "value": 0.5, "sd_log": 1.0},
    "P": {"unit": "W", "value": 10.0, "sd_log": 1.0},
}


class Block:
    """A heated block that loses heat to the air."""

    inputs = {"q": {"unit": "1", "range": (0.0, 1.0)}}
    disturbances = {"air": "degC"}
    outputs = {"t": {"unit": "degC", "sd": 0.05}}
    states = {"t": 0.5}
    parameters = PARAMETERS
    dt = 1.0

    def rhs(self, x: Any, u: Any, d: Any, p: Any) -> list[Any]:
        return [(p.P * u.q - p.G * (x.t - d.air)) / p.C]


class Tanks:
    """A pump into a tank that overflows and drains into a second one."""

    inputs = {"pump": {"unit": "V", "range": (0.0, 10.0)}}
    outputs = {"level": {"unit": "V", "sd": 0.05}}
    states = {"upper": 1.0, "lower": 0.1}
    parameters = {
        "gain": {"unit": "1/s", "value": 0.05, "sd_log": 0.7},
        "drain": {"unit": "V^0.5/s", "value": 0.05, "sd_log": 0.7},
        "spill": {"unit": "V^-0.5/s", "value": 0.5, "fixed": True},
    }
    limits = {"lower": (0.0, 10.0)}
    dt = 4.0
    height = 8.0  # a number of the class, read as self.height

    def rhs(self, x: Any, u: Any, d: Any, p: Any) -> list[Any]:
        over = np.maximum(x.upper - self.height, 0.0)
        out = p.drain * np.sqrt(np.maximum(x.upper, 0.0))
        wet = np.logical_and(x.lower > 0.0, x.lower > -1.0)
        drained = np.where(wet, p.drain * np.sqrt(np.maximum(x.lower, 0.0)), 0.0)
        return [p.gain * u.pump - out - p.spill * over**1.5, out - drained]

    def output(self, x: Any, p: Any) -> list[Any]:
        return [np.minimum(x.lower, 10.0)]


def varied(kind: type, **said: Any) -> type:
    """The class with some attributes changed; None takes one away."""
    content = {name: value for name, value in vars(kind).items() if not name.startswith("__")} | said
    return type(kind.__name__, (), {name: value for name, value in content.items() if value is not None})


def pumped(seed: int, seconds: float = 2400.0, sd: float = 0.0, **truth: float) -> Log:
    """A log of the tanks, driven by random steps."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 4.0)
    pump = np.repeat(rng.uniform(0.5, 6.0, t.size // 15 + 1), 15)[: t.size]
    model = replace(own_model(Tanks), pieces=8)
    p = np.array([[dict(zip(model.parameters, model.prior), **truth)[name] for name in model.parameters]])
    y, _ = model.rollout([[4.0, 3.0]], pump[None, :, None], np.zeros((1, t.size, 0)), p, 4.0)
    read = y[0, :-1, 0] + sd * rng.standard_normal(t.size)
    signals = {"pump": (pump, "V", "input"), "level": (read, "V", "output")}
    return make_log(t, signals, name=f"pumped{seed}")


def test_the_parameters_of_noisy_tanks_are_found_again():
    truth = {"gain": 0.062, "drain": 0.071}
    plant = fit_network(own_model(Tanks), [pumped(1, sd=0.05, **truth), pumped(2, sd=0.05, **truth)])
    for name, value in truth.items():
        assert plant.values[name] == pytest.approx(value, rel=0.02), name
    assert plant.noise["level"] < 0.06
    assert "V" in plant.verdict
    assert "degC" not in plant.verdict


SCALED = PARAMETERS | {"C": {"unit": "J/K", "value": 50.0, "sd_log": 0.5}}  # ratios alone are seen


def one_step(what: str) -> Log:
    """A log in which the heater is switched on once, and the block answers so."""
    rng, t = np.random.default_rng(0), np.arange(0.0, 600.0, 2.0)
    rise = 15.0 * -np.expm1(-np.maximum(t - 60.0, 0.0) / 150.0)
    made = {"as modelled": rise + 0.05 * rng.standard_normal(t.size), "cooling": -rise}[what]
    signals = {
        "q": ((t > 60.0).astype(float), "1", "input"),
        "air": (np.full(t.size, 22.0), "degC", "disturbance"),
        "t": (22.0 + made, "degC", "output"),
    }
    return make_log(t, signals, name=what)


@pytest.mark.parametrize("what", ["as modelled", "cooling"])
def test_one_step_leaves_no_parameter_less_known_than_its_prior_and_can_be_drawn(what: str):
    log, model = one_step(what), own_model(varied(Block, parameters=SCALED))
    plant = fit_network(model, [log])
    prior = np.array([model.specs[name].sd_log for name in plant.free])
    assert (np.sqrt(np.diag(plant.covariance)) <= prior * (1 + 1e-9)).all()
    for name, (low, high) in plant.intervals(0.9).items():  # 90 % of the prior: exp(2 * 1.645 sd)
        assert np.log(high / low) <= 2 * 1.6449 * model.specs[name].sd_log
    drawn = with_draws(plant, fit_problem(plant, [log]), 60).samples
    assert drawn is not None
    assert np.isfinite(drawn).all()
    scale = np.log(drawn).std(axis=0)  # of 60 draws a standard deviation is known to 9 %
    assert (scale < 1.3 * prior).all()
    if what == "as modelled":  # what all three share is known by the prior alone
        shared = (np.log(drawn / drawn[:, :1]) @ [0.0, 1.0, 1.0]).std()
        assert shared < 0.2 < np.log(drawn).sum(axis=1).std()


def test_a_long_run_agrees_with_an_independent_solver():
    model = replace(own_model(Tanks), pieces=16)
    pump = np.repeat([6.0, 1.0, 5.0], 50)[None, :, None]  # overflows, and empties far
    got, _ = model.rollout([[4.0, 3.0]], pump, np.zeros((1, 150, 0)), model.prior[None], 4.0)
    x, seen = np.array([4.0, 3.0]), [3.0]
    made = Tanks()
    for u in pump[0]:

        def rate(_t: float, x: Any, u: Any = u) -> Any:
            return made.rhs(model.code.X(*x), model.code.U(*u), None, model.code.P(*model.prior))

        x = solve_ivp(rate, (0.0, 4.0), x, rtol=1e-9, atol=1e-9).y[:, -1]
        seen.append(x[1])
    assert np.max(np.array(seen)) < 10  # the limit is not reached, so the solver needs none
    np.testing.assert_allclose(got[0, :, 0], seen, atol=2e-5)


def test_compiled_rows_and_symbols_agree():
    fast = replace(own_model(Tanks), pieces=3)
    rng = np.random.default_rng(0)
    x0, pump = rng.uniform(0.0, 12.0, (5, 2)), rng.uniform(0, 9, (1, 200, 1))
    p = fast.prior * rng.uniform(0.5, 2.0, (5, 3))
    run = x0, pump, np.zeros((1, 200, 0)), p
    code = fast.code
    ends = [roll_rows(code.step, code.output, *run, 4.0 / 3, pieces=3), fast.rollout(*run, 4.0)]
    np.testing.assert_allclose(ends[0][0], ends[1][0], atol=1e-10)
    np.testing.assert_allclose(ends[0][1], ends[1][1], atol=1e-10)
    x, u, q = (casadi.SX.sym(name, n) for name, n in (("x", 2), ("u", 1), ("p", 3)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # casadi warns of what numpy will make of its bare symbols
        symbols = fast.step(casadi.vertsplit(x), casadi.vertsplit(u), [], casadi.vertsplit(q), 4.0)
    step = casadi.Function("step", [x, u, q], [casadi.vertcat(*symbols)])
    for b in range(5):
        _, after = fast.rollout(x0[b : b + 1], pump[:, :1], np.zeros((1, 1, 0)), p[b : b + 1], 4.0)
        np.testing.assert_allclose(np.array(step(x0[b], pump[0, 0], p[b]))[:, 0], after[0], atol=1e-12)


def test_a_limit_holds_the_level_and_lets_it_go_at_once():
    class Bucket(Block):
        inputs, outputs, states, disturbances = {"pump": "V"}, {"level": "V"}, {"level": 1.0}, {}
        parameters = {"gain": {"value": 1.0, "sd_log": 1.0}}
        limits = {"level": (None, 3.0)}

        def rhs(self, x: Any, u: Any, d: Any, p: Any) -> list[Any]:
            return [p.gain * u.pump]

    pump = np.repeat([1.0, -1.0], [10, 2])[None, :, None]
    run = np.zeros((1, 1)), pump, np.zeros((1, 12, 0)), np.ones((1, 1)), 1.0
    model = own_model(Bucket)
    for y, _ in (model.rollout(*run), roll_rows(model.step, model.output, *run)):
        np.testing.assert_allclose(y[0, :, 0], [0, 1, 2, 3, 3, 3, 3, 3, 3, 3, 3, 2, 1], atol=1e-12)


def test_steps_are_cut_until_they_are_accurate():
    class Fast(Block):
        parameters = PARAMETERS | {
            "C": {"unit": "J/K", "value": 0.1, "fixed": True}
        }  # 0.2 s, in steps of 1 s

    t = np.arange(0.0, 60.0)
    q, air = (t % 20 < 10).astype(float), np.full(t.size, 21.0)
    signals = {"q": (q, "1", "input"), "air": (air, "degC", "disturbance"), "t": (air + q, "degC", "output")}
    runs, spread = partial(free_runs, [make_log(t, signals)]), {"t": 0.5}
    ready = own_model(Fast).prepared(runs, spread)
    assert ready.pieces >= 4
    exact = 21.0 + 20.0 * (1 - np.exp(-1.0 / 0.2))
    y, _ = ready.rollout([[21.0]], [[[1.0]]], [[[21.0]]], ready.prior[None], 1.0)
    assert abs(y[0, 1, 0] - exact) < 0.05
    assert ready.prepared(runs, spread) is ready


def test_a_plant_at_rest_is_held_there_by_some_input():
    model = own_model(Tanks)
    x = model.rest([4.0], [1.0], [], model.prior)
    np.testing.assert_allclose(x, [4.0, 4.0], atol=1e-3)  # both drains are alike, so both levels are
    held = 0.05 * np.sqrt(4.0) / 0.05
    rate = model.code.rhs(list(x), [held], [], list(model.prior))
    np.testing.assert_allclose(rate, 0.0, atol=1e-5)


def lag(**said: Any) -> OwnModel:
    """A state that follows its input, which reaches from 0 to 2; its reading is next to nothing."""
    content = {"inputs": {"q": {"unit": "1", "range": (0.0, 2.0)}}, "disturbances": {"air": "degC"},
               "outputs": {"t": {"unit": "degC", "sd": 1e4}}, "states": {"t": 0.5}, "dt": 1.0,
               "parameters": {"k": {"value": 1.0, "sd_log": 1.0}},
               "rhs": lambda self, x, u, d, p: [p.k * (u.q - x.t)]}  # fmt: skip
    return own_model(type("Lag", (), content | said))


def test_rest_weighs_readings_and_inputs_as_its_theory_does():
    """The flow is nought where x = v: left are (100 (x - y) / 1e4)^2 + (0.01 (x - u) / 2)^2."""
    x = lag().rest([1.8], [0.3], [0.0], [1.0])
    np.testing.assert_allclose(x, (4 * 1.8 + 0.3) / 5, rtol=1e-4)
    # out of reach of the input v = 2, with sd 50: (50 (2 - x) / 0.5)^2 + (100 (x - 9) / 50)^2
    x = lag(outputs={"t": {"unit": "degC", "sd": 50.0}}).rest([9.0], [0.3], [0.0], [1.0])
    np.testing.assert_allclose(x, (1e4 * 2.0 + 4 * 9.0) / 10004, rtol=1e-6)
    # the same with a warm-up of 1 s and a state of 4: (0.25 (2 - x))^2 + (2 (x - 9))^2
    wide = {"warmup": 1.0, "states": {"t": 4.0}, "outputs": {"t": {"unit": "degC", "sd": 50.0}}}
    np.testing.assert_allclose(
        lag(**wide).rest([9.0], [0.3], [0.0], [1.0]), (2.0 / 16 + 4 * 9.0) / (1 / 16 + 4), rtol=1e-6
    )
    # a switch stays where it is, and an input without a range is bounded by nothing
    free = {"q": {"unit": "1"}}
    np.testing.assert_allclose(lag(**wide, inputs=free).rest([9.0], [0.3], [0.0], [1.0]), 9.0, rtol=1e-4)
    held = {"q": {"unit": "1", "switch": True}}
    np.testing.assert_allclose(
        lag(**wide, inputs=held).rest([9.0], [0.3], [0.0], [1.0]), (0.3 / 16 + 4 * 9.0) / (1 / 16 + 4)
    )
    assert lag(limits={"t": (None, 1.2)}).rest([1.8], [0.3], [0.0], [1.0]) == pytest.approx([1.2], rel=1e-3)
    own = lag(limits={"t": (0.4, None)}, rest=lambda self, y, u, d, p: [y.t - u.q - d.air])
    assert [own.rest([1.8], [0.3], [air], [1.0])[0] for air in (1.0, 1.4)] == pytest.approx([0.5, 0.4])


@pytest.mark.parametrize(
    ("state", "second", "root"), [("t", 40.0, 2.0), ("hot", 40.0, 6.0), ("hot", 1.0, 2.0)]
)
def test_rest_is_found_near_the_readings(state: str, second: float, root: float):
    """|x - 4| = 2 on both sides; a state that no output is named after begins at the mean of all."""
    two = {"t": {"unit": "degC", "sd": 1e-3}, "s": {"unit": "degC", "sd": 1e3}}
    model = lag(states={state: 4.0}, outputs=two, inputs={"q": "1"},
                rhs=lambda self, x, u, d, p: [u.q + 0 * x[0]],
                output=lambda self, x, p: [abs(x[0] - 4.0) * (1 + 0 * p.k), second + 0 * x[0]])  # fmt: skip
    np.testing.assert_allclose(model.rest([2.0, second], [0.0], [0.0], [1.0]), root, atol=1e-3)


def test_what_a_class_does_not_state_follows_from_its_step():
    plain, said = own_model(Block), own_model(varied(Block, average=7.0, warmup=33.0, dt=0.5))
    assert (plain.average, plain.independent, plain.warmup) == (5.0, 20.0, 50.0)
    assert (said.average, said.independent, said.warmup) == (7.0, 28.0, 33.0)
    assert (plain.pieces, plain.sensor_sd, plain.spread.tolist()) == (1, {"t": 0.05}, [[0.25]])
    unknown = own_model(varied(Block, outputs={"t": "degC"}))
    assert unknown.sensor_sd == {"t": 1.0}
    assert replace(unknown, sd={"t": 0.3}).sensor_sd == {"t": 0.3}
    assert own_model(Tanks).code.limits.tolist() == [[-np.inf, np.inf], [0.0, 10.0]]
    assert [replace(own_model(Tanks), pieces=3)._pieces(dt) for dt in (4.0, 2.0, 0.1, 8.0)] == [3, 2, 1, 6]
    assert unknown.to_dict() == {
        "kind": "own", "class": "Block", "file": Path(__file__).name, "sha256": unknown.code.sha256,
        "inputs": ["q"], "disturbances": ["air"], "outputs": ["t"], "states": ["t"], "pieces": 1,
        "sd": {"t": 1.0},
    }  # fmt: skip


@pytest.mark.parametrize(
    ("off", "pieces"),
    [
        (lambda n: 0.0, 1),
        (lambda n: 0.0099 * (n > 1), 1),  # a tenth of the sd, 0.1 K, in all rows
        (lambda n: 0.0101 * (n > 1), 2),
        (lambda n: np.append(np.zeros(2499), 0.099 * (n > 1)), 1),  # the sd itself in one row of many
        (lambda n: np.append(np.zeros(2499), 0.101 * (n > 1)), 2),
        (lambda n: np.nan if n < 4 else 0.0, 4),
        (lambda n: 0.02 * np.log2(min(n, 256)), 256),
        (lambda n: 0.02 * np.log2(n), None),
        (lambda n: np.append(np.zeros(2499), np.nan), None),
    ],
)
def test_pieces_are_doubled_until_runs_agree(off: Any, pieces: int | None):
    """The second of two runs is off by so much; the class states no sd: it is 2 % of 5 K."""
    tried = []

    def runs(model: OwnModel, p: np.ndarray) -> Any:
        tried.append(model.pieces)
        return [
            ("first", np.zeros((1, 9, 1))),
            ("second", (off(model.pieces) + np.zeros(2500))[None, :, None]),
        ]

    model = own_model(varied(Block, outputs={"t": "degC"}, dt=0.5))
    still = model.prepared(lambda *_: [("still", np.zeros((1, 9, 1)))], {"t": 0.0})
    assert still.sd == {"t": 0.02}  # of an output that does not move: 2 % of 1 K
    if pieces:
        ready = model.prepared(runs, {"t": 5.0})
        assert (ready.pieces, ready.sd) == (pieces, {"t": pytest.approx(0.1)})
        assert tried == [2**k for k in range(len(tried))]
        assert tried[-1] == 2 * pieces
        assert ready.prepared(runs, {"t": 5.0}).pieces == pieces
    else:
        lost = not np.isfinite(off(1)).all()
        said = (
            r"no finite output 1249.5 s into second, with .*np\.maximum"
            if lost
            else r"too fast for 256 .* in dt = 0.5 s"
        )
        with pytest.raises(UserError, match=said):
            model.prepared(runs, {"t": 5.0})
        assert tried[-1] == 512


def test_what_a_plant_file_says_of_a_class_is_checked():
    model = own_model(Block)
    said = {"kind": "own", "class": "Block", "sha256": None, "pieces": 6, "sd": {"t": 0.4}}
    assert (model.restored(said).pieces, model.restored(said).sd) == (6, {"t": 0.4})
    assert model.restored(said | {"pieces": 0}).pieces == 1
    for change in ({"pieces": "many"}, {"sd": None}, {"sd": {"t": None}}, {"pieces": None}):
        with pytest.raises(UserError, match=r"its model is not whole \(.*\); fit the plant again"):
            model.restored(said | change)
    with pytest.raises(UserError, match="equations are a statespace, not Block"):
        model.restored({"kind": "statespace"})
    with pytest.raises(UserError, match="equations are Block, not Block"):
        model.restored({"kind": "network", "class": "Block"})
    with pytest.raises(UserError, match=r"class None of FILE\.py.*--network FILE\.py:None"):
        OwnModel.from_dict({})


def test_a_class_may_call_what_it_likes_and_what_cannot_be_compiled_is_refused():
    class Helped(Block):
        def loss(self, p: Any, x: Any, d: Any) -> Any:
            return p.G * (x.t - d.air)

        def rhs(self, x: Any, u: Any, d: Any, p: Any) -> list[Any]:
            return [(p.P * u.q - self.loss(p, x, d)) / p.C]

    class Sorted(Helped):
        def loss(self, p: Any, x: Any, d: Any) -> Any:
            return p.G * (np.sort(x.t) - d.air)

    class Tabled(Helped):
        def loss(self, p: Any, x: Any, d: Any) -> Any:
            return p.G * (np.interp(x.t, [-50.0, 30.0, 100.0], [-50.0, 30.0, 100.0]) - d.air)

    class Arrays(Block):
        def rhs(self, x: Any, u: Any, d: Any, p: Any) -> Any:
            return np.array([p.P * u.q + p.G * (d.air - x.t)]) / p.C

    class InPlace(Block):
        def rhs(self, x: Any, u: Any, d: Any, p: Any) -> Any:
            heat, loss = p.P * u.q, np.array([x.t, 1.0])
            loss[0] -= d.air
            loss *= p.G
            heat -= loss[0]
            heat /= p.C
            return [np.select([x.t > -99.0, x.t > -300.0], [heat, 1.0], 2.0)]

    class Filled(Block):
        def rhs(self, x: Any, u: Any, d: Any, p: Any) -> Any:
            rates, warm = np.zeros(1), np.ones((2,), dtype=float)
            warm[:] = x.t - d.air, 4.0
            rates[0] += p.P * u.q / p.C
            return rates - p.G * warm[:1] * np.exp(np.log1p(0.0 * warm[:1])) / p.C

    class Drawn(Block):
        calls = 0

        def rhs(self, x: Any, u: Any, d: Any, p: Any) -> Any:
            self.calls += 1  # as np.random would
            return [p.P * u.q + 1e-3 * self.calls]

    with pytest.raises(UserError, match=r"Sorted fails in rhs: .*sort"):
        own_model(Sorted)
    with pytest.raises(UserError, match=r"Drawn gives another rhs each time .* draw no random numbers"):
        own_model(Drawn)
    plain = own_model(Block)
    arguments = ([[25.0]], np.ones((1, 9, 1)), np.full((1, 9, 1), 21.0), plain.prior[None], 1.0)
    for kind in (Helped, Tabled, Arrays, InPlace, Filled):
        got = own_model(kind).rollout(*arguments)[0]
        np.testing.assert_allclose(got, plain.rollout(*arguments)[0], atol=1e-12)


def written(tmp_path: Path, body: str = "return [p.gain * u.pump - p.drain * x.level]") -> Path:
    """A file with a class of one tank."""
    file = tmp_path / "tank.py"
    file.write_text(
        "class Tank:\n"
        '    inputs, outputs, states, dt = {"pump": "V"}, {"level": "V"}, {"level": 0.5}, 4.0\n'
        '    parameters = {"gain": {"value": 0.05, "sd_log": 0.7}, "drain": {"value": 0.02, "sd_log": 0.7}}\n'
        "    def rhs(self, x, u, d, p):\n"
        f"        {body}\n"
    )
    return file


def test_a_saved_plant_needs_its_class_and_then_is_the_same(tmp_path):
    file = written(tmp_path)
    model = own_model(load_object(file, "Tank"))
    log = pumped(3)
    plant = fit_network(model, [log])
    path = plant.save(tmp_path / "plant.json")
    with pytest.raises(
        UserError, match=r"plant\.json: its equations are the class Tank of tank\.py.*--network"
    ):
        Plant.load(path)
    again = Plant.load(path, model=own_model(load_object(file, "Tank")))
    assert again.values == plant.values
    assert isinstance(again.model, OwnModel)
    assert isinstance(plant.model, OwnModel)
    assert again.model.pieces == plant.model.pieces
    got, want = (one.simulate(log)["level"].values for one in (again, plant))
    np.testing.assert_allclose(got, want, atol=1e-9)


def test_a_plant_refuses_a_class_that_has_changed_or_is_another(tmp_path):
    file = written(tmp_path)
    plant = prior_plant(own_model(load_object(file, "Tank")))
    path = plant.save(tmp_path / "plant.json")
    with pytest.raises(UserError, match="equations are Tank, not Block"):
        Plant.load(path, model=own_model(Block))
    file.write_text(file.read_text().replace("0.05", "0.06"))
    with pytest.raises(UserError, match=r"Tank is not what the plant was fitted with: its file has changed"):
        Plant.load(path, model=own_model(load_object(file, "Tank")))
    content = json.loads(path.read_text())
    content["model"] = {"kind": "statespace"}
    path.write_text(json.dumps(content))
    with pytest.raises(UserError, match=r"its model \(statespace\) needs no class"):
        Plant.load(path, model=own_model(Block))


@pytest.mark.parametrize(
    ("said", "line"),
    [
        ({"states": None}, r'Block states states: .*; write states = \{"level": 0.1\}'),
        ({"rhs": None}, "Block has no function rhs; write def rhs"),
        ({"outputs": {"hot": "degC"}}, "'hot' reads: it is no state"),
        ({"parameters": {"C": {"unit": "J/K", "value": 1.0}}}, "parameters C: has no prior"),
        ({"parameters": {"C": {"value": 1.0, "sd_lgo": 1.0}}}, "parameters C sd_lgo: "),
        ({"parameters": {}}, "states parameters: .* at least 1"),
        ({"inputs": ["q"]}, "states inputs: .* dictionary"),
        ({"states": {"t": -1.0}}, "states t: .* greater than 0"),
        ({"states": {"t 1": 1.0}}, "states t 1 .*use letters"),
        ({"states": {"lambda": 1.0}}, "no word of Python"),
        ({"dt": 0.0}, "states dt: .* greater than 0"),
        ({"limits": {"level": (0, 1)}}, "limits: 'level' is no state; write limits = "),
        ({"limits": {"t": (1, 1)}}, "limits: t is between 1 and 1"),
        ({"limits": {"t": ("a", 1)}}, "states limits t"),
        ({"average": float("inf")}, "states average: .*; give seconds"),
        ({"warmup": "long"}, "states warmup"),
        ({"__init__": lambda self, size: None}, r"cannot be made without arguments \(TypeError"),
        ({"limit": {"t": (0, 1)}}, "'limit', which nothing reads; call it 'limits'"),
        ({"rhs": lambda self, x, u, d, p: [x.t, x.t]}, "returns 2 numbers from rhs, not 1"),
        ({"rhs": lambda self, x, u, d, p: None}, "returns None from rhs, which is no number; return one for"),
        ({"rhs": lambda self, x, u, d, p: ["a"]}, "returns 'a' from rhs"),
        ({"rhs": lambda self, x, u, d, p: [np.array([x.t, 1.0])]}, r"returns array.* from rhs, which is no"),
        ({"rhs": lambda self, x, u, d, p: np.stack([x.t])}, r"stack of values .* makes an array; use arith"),
        ({"rhs": lambda self, x, u, d, p: [np.interp(x.t, [0], [1], period=2)]}, "no left, right or period"),
        ({"rhs": lambda self, x, u, d, p: [p.K * x.t]}, "no attribute 'K'; the parameters are C, G, P"),
        ({"rhs": lambda self, x, u, d, p: [x.t if x.t > 0 else 0.0]}, r"choose with np\.where"),
        ({"rhs": lambda self, x: [0.0]}, "fails in rhs: TypeError"),
        ({"output": lambda self, x, p: [x.t, x.t]}, "returns 2 numbers from output, not 1"),
    ],
)
def test_a_wrong_class_is_refused_in_one_line(said, line):
    with pytest.raises(UserError, match=line) as caught:
        own_model(varied(Block, **said))
    assert "\n" not in str(caught.value)


def test_an_exception_in_a_users_function_names_its_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = written(tmp_path, body="return [1 / 0]")
    with pytest.raises(
        UserError, match=r"^tank\.py:5: Tank fails in rhs: ZeroDivisionError: division by zero"
    ):
        own_model(load_object(file, "Tank"))


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("class Tank(:\n", r"bad\.py:1: fails with SyntaxError"),
        ("import math\nmath.nothing\n", r"bad\.py:2: fails with AttributeError"),
        ("class Other:\n    rhs = None\nclass Plain: pass\n", r"bad\.py: has no 'Tank'; it has Other$"),
        ("size = 3\n", r"bad\.py: has no 'Tank'; name a class that is in it"),
    ],
)
def test_a_file_that_fails_is_refused_with_its_line(tmp_path, monkeypatch, text, line):
    monkeypatch.chdir(tmp_path)
    Path("bad.py").write_text(text)
    with pytest.raises(UserError, match=line):
        load_object("bad.py", "Tank")


def test_a_file_counts_by_its_text_and_must_be_one_of_python(tmp_path):
    file = written(tmp_path)
    first = own_model(load_object(file, "Tank")).code.sha256
    file.write_bytes(file.read_bytes().replace(b"\n", b"\r\n"))
    assert own_model(load_object(file, "Tank")).code.sha256 == first
    assert own_model(type("Typed", (), {**vars(Block), "__module__": "nowhere"})).code.sha256 is None
    for name, said in (
        ("none.py", "no such file; check the path"),
        ("tank.txt", "cannot be imported; give a Python"),
    ):
        if name == "tank.txt":
            (tmp_path / name).write_text("x = 1\n")
        with pytest.raises(UserError, match=rf"{name}: {said}"):
            load_object(tmp_path / name, "Tank")


def test_equations_that_give_no_number_are_refused_before_the_fit():
    class Unguarded(Block):
        def rhs(self, x: Any, u: Any, d: Any, p: Any) -> list[Any]:
            return [-np.sqrt(x.t - 21.5)]  # of a negative number, as soon as it has cooled that far

        def rest(self, y: Any, u: Any, d: Any, p: Any) -> list[Any]:
            return [22.0]

    t = np.arange(0.0, 60.0)
    still = np.full(t.size, 22.0)
    signals = {
        "q": (0 * t, "1", "input"),
        "air": (still, "degC", "disturbance"),
        "t": (still, "degC", "output"),
    }
    with pytest.raises(UserError, match=r"Unguarded gives no finite output .* s into .*np\.maximum"):
        fit_network(own_model(Unguarded), [make_log(t, signals)])


@pytest.mark.parametrize(("rest", "lost"), [((np.nan, 1.0), "upper"), ((1.0, np.inf), "lower")])
def test_the_state_without_a_number_at_rest_is_named(rest: tuple[float, float], lost: str):
    model = own_model(varied(Tanks, rest=lambda self, y, u, d, p: list(rest)))
    with pytest.raises(UserError, match=rf"no finite state at rest \({lost} is not\)"):
        model.rest([4.0], [1.0], [], model.prior)
    with pytest.raises(UserError, match="no output has a reading to start from"):
        model.rest([np.nan], [1.0], [], model.prior)


def test_the_class_of_the_how_to_is_accepted(tmp_path):
    page = (Path(__file__).parents[3] / "docs" / "howto" / "own-network.md").read_text()
    file = tmp_path / "tank.py"
    file.write_text(page.split("```python\n")[1].split("```")[0])
    model = own_model(load_object(file, "Tank"))
    assert [name for name, spec in model.specs.items() if not spec.fixed] == ["gain", "drain", "volts"]
    x = model.rest([4.0], [1.0], [], model.prior)
    np.testing.assert_allclose(x, [2.0], atol=1e-4)  # 2 V/m


def cascade() -> tuple[OwnModel, Any]:
    """The example of two tanks, and its parameters."""
    example = Path(__file__).parents[3] / "examples" / "cascaded_tanks.py"
    model = replace(own_model(load_object(example, "CascadedTanks")), pieces=16)
    like = {"gain": 0.042, "drain_upper": 0.045, "drain_lower": 0.045, "weir": 1.5, "share": 0.66}
    like |= {"kink": 6.0, "kink_reading": 4.4, "slack": 0.1}
    return model, np.array([like.get(name, value) for name, value in zip(model.parameters, model.prior)])


def test_the_example_of_two_tanks_starts_where_its_lower_level_stands_still():
    model, p = cascade()
    for level in (1.0, 4.4, 8.0):  # below, at and above the kink of the sensor
        x = model.rest([level], [0.0], [], p)
        _, lower, reading = model.code.rhs(x, [0.0], [], p)
        np.testing.assert_allclose([lower, reading], 0.0, atol=1e-12)
        np.testing.assert_allclose(model.output(x, p), level)


def test_the_example_finds_the_kink_and_the_play_of_a_sensor_again():
    model, p = cascade()
    t = np.arange(1000) * model.dt
    swings = [np.sin(2 * np.pi * t / period + period) for period in (250.0, 420.0, 900.0, 1900.0)]
    pump = np.clip(2.7 + np.sum(swings, axis=0), 0.3, 7.0)[:, None]
    x = model.rest([5.0], pump[0], [], p)
    run, _ = model.rollout(x[None], pump[None], np.zeros((1, t.size, 0)), p[None], model.dt)
    read = run[0, :-1, 0] + 0.01 * np.random.default_rng(1).standard_normal(t.size)
    signals = {"pump": (pump[:, 0], "V", "input"), "level": (read, "V", "output")}
    found = fit_network(model, [make_log(t, signals)])
    truth = dict(zip(model.parameters, p))
    for name, within in {"kink": 0.02, "kink_reading": 0.02, "slack": 0.005, "gain": 0.0002}.items():
        assert abs(found.values[name] - truth[name]) < within, name


@pytest.mark.parametrize(
    ("air", "off"), [("degC", 0.0), ({"unit": "degC"}, 0.0), ({"unit": "degC", "log_sd": 0.5}, 0.5)]
)
def test_a_sensor_has_an_offset_where_its_class_says_so(air: Any, off: float) -> None:
    class Block:
        inputs = {"q": {"unit": "1", "range": (0.0, 1.0)}}
        disturbances = {"air": air}
        outputs = {"t": {"unit": "degC", "sd": 0.05}}
        states = {"t": 0.5}
        parameters = {"G": {"unit": "1/s", "value": 0.5, "sd_log": 1.0}}
        dt = 1.0

        def rhs(self, x: Any, u: Any, d: Any, p: Any) -> list[Any]:
            return [u.q - p.G * (x.t - d.air)]

    assert own_model(Block).nuisance == {"t": 0.0, "air": off}
