"""What a network may lack, in its own numbers, and the regression that asks for it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from thermogrip.sysid.growth import candidates
from thermogrip.sysid.growth.candidates import (
    LEAST,
    Candidate,
    ResidualTerm,
    lagging_air,
    patched,
    proposed,
    second_zone,
    suggested,
)
from thermogrip.sysid.models.network import NetworkModel, load_network
from thermogrip.sysid.models.network_spec import network_from_dict

GRIPPER = {
    "module": "droop, dead zone, S(T), R(T)",
    **dict.fromkeys(("heatsink", "water", "pipe", "foam"), "second zone, steady bench"),
    **dict.fromkeys(("wall", "finger"), "second zone"),
    **dict.fromkeys(("heatsink_air", "tank_air", "pipe_air", "foam_air"), "convection"),
    "t_ambient": "lagging air",
    **dict.fromkeys(("G_tube_film", "wall_water", "finger_pipe"), "film follows the flow"),
}
CHAMBER = {
    "module": "dead zone, S(T), R(T)", **dict.fromkeys(("body", "heatsink"), "second zone, steady bench"),
    **dict.fromkeys(("plate", "box"), "second zone"), "ambient": "lagging air",
    **dict.fromkeys(("body_air", "heatsink_air"), "convection"),
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "adds", "removes"),
    [
        (
            "gripper",
            GRIPPER,
            "lag_tank K_module drive_offset cooling_gain heatsink_air tank_air pipe_air foam",
        ),
        # its command is never negative, and the box has one link
        ("peltier_chamber", CHAMBER, "K_module drive_offset body_air heatsink_air box"),
        ("tclab", dict.fromkeys(("heater1", "heater2"), "second zone"), "lag_1 lag_2"),
    ],
)
def test_what_is_suggested(name, adds, removes):
    found = suggested(load_network(name))
    wanted = {f"{element}: {kind}" for element, kinds in adds.items() for kind in kinds.split(", ")}
    assert {c.name for c in found if c.change == "add"} == wanted
    assert [c.name for c in found if c.change == "remove"] == [f"without {n}" for n in removes.split()]


@pytest.mark.parametrize(
    ("name", "numbers"),
    [
        ("module: droop", {"module_droop": (0.0, 0.14, None)}),
        ("module: S(T)", {"module_seebeck_slope": (0.0, 0.002, None)}),
        ("module: dead zone", {"module_dead_zone": (0.01, 0.02, 0.0)}),
        ("module: R(T)", {"module_resistance_slope": (0.0, 0.005, None)}),
        ("tank_air: convection", {"tank_air_bend": (0.1, 0.1, 0.0)}),
        ("water: steady bench", {"t_water_bench": (22.0, 2.0, None), "G_water_bench": (0.25, 1.0, None)}),
        ("wall_water: film follows the flow", {"G_wall_off": (0.5, 0.3, 0.0)}),
        ("G_tube_film: film follows the flow", {"G_tube_film_off": (0.5, 0.3, 0.0)}),
        # 0.3 of the capacity, which follows in 15 s
        ("wall: second zone", {"C_wall_zone": (18.0, 1.0, None), "G_wall_zone": (1.2, 1.4, None)}),
        # a hundred times the largest capacity, which lags by a minute
        ("t_ambient: lagging air", {"C_t_ambient_near": (9e4, None, None), "G_t_ambient_near": (1500.0,
            1.4, None)}),
    ],
)  # fmt: skip
def test_new_parameters_begin_where_their_physics_has_them(name, numbers):
    model = load_network("gripper")
    candidate = next(c for c in suggested(model) if c.name == name)
    after = patched(model, candidate)
    assert set(after.parameters) - set(model.parameters) == set(numbers)
    for key, (value, sd, low) in numbers.items():
        made = after.network.parameters[key]
        assert made.value == pytest.approx(value)
        assert sd in (made.sd, made.sd_log)
        assert candidate.patch["parameters"][key].get("low") == low
        assert made.fixed == (sd is None)
    again = [c.name for c in suggested(after)]
    assert name not in again


def test_zones_and_air_have_the_time_constant_of_their_term():
    network = load_network("gripper").network
    zone = second_zone(network, "pipe", tau=80.0).patch["parameters"]
    assert (zone["C_pipe_zone"]["value"], zone["G_pipe_zone"]["value"]) == pytest.approx((1.2, 0.015))
    small = second_zone(load_network("tclab").network, "heater1").patch["parameters"]
    assert (small["C_heater1_zone"]["value"], small["G_heater1_zone"]["value"]) == pytest.approx(
        (1.0, 1 / 15)
    )
    air = lagging_air(network, "t_ambient", tau=300.0)
    assert air.patch["parameters"]["G_t_ambient_near"]["value"] == pytest.approx(300.0)
    changed = patched(load_network("gripper"), air).network
    assert changed.links["foam_air"].between == ["foam", "t_ambient_near"]
    assert {pipe.surroundings for pipe in changed.pipes.values()} == {"t_ambient_near"}
    assert changed.nodes["t_ambient_near"].start_sd == 0.5


def test_radiation_and_elements_without_a_need_are_left_where_they_are():
    """One node that glows to the air, one beside it: the glow goes to the air that lags."""
    content = load_network("peltier_chamber").network.model_dump(
        by_alias=True, mode="json", exclude_none=True
    )
    content["radiation"] = {
        "glow": {"between": ["body", "ambient"],
            "area": "A_body", "emissivity": "eps"}, "own": {"between": ["body", "box"],
            "area": "A_body", "emissivity": "eps"}
    }  # fmt: skip
    content["parameters"]["A_body"] = {"unit": "m2", "value": 0.02, "sd_log": 0.5}
    content["parameters"]["eps"] = {"unit": "1", "value": 0.9, "sd": 0.1}
    model = NetworkModel(network_from_dict(content))
    patch = lagging_air(model.network, "ambient").patch
    assert patch["radiation"] == {"glow": {"between": ["body", "ambient_near"]}}
    assert set(patch["links"]) == {"body_air", "heatsink_air", "ambient_near"}


@pytest.mark.parametrize(
    ("term", "output", "names"),
    [
        ("drive", "t_surface", ["module: dead zone", "pipe: second zone"]),
        ("drive*drive", "t_surface", ["module: droop", "module: R(T)", "pipe: second zone"]),
        ("drive*|drive|", "t_surface", ["module: droop", "module: R(T)"]),
        ("t_tank*drive", "t_tank", ["module: S(T)", "module: droop"]),
        ("t_tank", "t_tank", ["water: second zone"]),
        ("t_tank*|drive|", "t_tank", ["module: R(T)", "module: S(T)"]),
        ("t_tank*t_tank", "t_tank", [f"{n}_air: convection" for n in ("heatsink", "tank", "pipe", "foam")]),
        ("t_ambient", "t_tank",
         ["t_ambient: lagging air", *(f"{n}: steady bench" for n in ("heatsink", "water", "pipe", "foam"))]),
        ("t_ambient*t_tank", "t_tank", [f"{n}_air: convection" for n in ("heatsink", "tank", "pipe", "foam")]
         + [f"{n}: steady bench" for n in ("heatsink", "water", "pipe", "foam")]),
        ("pump", "t_tank", ["G_tube_film: film follows the flow", "wall_water: film follows the flow",
                            "finger_pipe: film follows the flow", "pump: heat of the pump"]),
        ("drive*pump", "t_tank", ["G_tube_film: film follows the flow", "wall_water: film follows the flow",
                                  "finger_pipe: film follows the flow"]),
    ],
)  # fmt: skip
def test_what_each_kind_of_term_proposes(term, output, names):
    found = proposed(load_network("gripper"), [ResidualTerm(output, term, 90.0, 0.1)])
    assert [c.name for c, _ in found] == names
    for candidate, _ in found:
        own = candidate.patch["parameters"]
        assert len(patched(load_network("gripper"), candidate).parameters) > len(
            load_network("gripper").parameters
        )
        if candidate.name.endswith("lagging air"):
            assert own["C_t_ambient_near"]["value"] / own["G_t_ambient_near"]["value"] == pytest.approx(90.0)
        if candidate.name == "pump: heat of the pump":
            assert candidate.patch["heaters"] == {
                "pump_motor": {"node": "water", "input": "pump", "power": "P_pump"}
            }
            heated = patched(load_network("gripper"), candidate)
            assert heated.network.parameters["P_pump"].value == 0.5
            assert candidate.name not in [
                c.name for c, _ in proposed(heated, [ResidualTerm(output, "pump", 9.0, 0.1)])
            ]


def test_six_terms_propose_and_the_first_that_asks_is_named():
    terms = [ResidualTerm("t_tank", name, 90.0, share) for name, share in (
        ("drive*|drive|", 0.02), ("t_tank*drive", 0.03), ("t_tank", 0.04), ("pump", 0.06), ("drive", 0.05),
        ("t_ambient", 0.07), ("t_tank*t_tank", 0.01),
    )]  # fmt: skip
    found = {c.name: term.term for c, term in proposed(load_network("gripper"), terms)}
    assert found["module: droop"] == "t_tank*drive"
    assert "module: R(T)" in found
    assert not any("convection" in name for name in found)


def test_block_means_leave_out_what_is_lost():
    cell = np.array([0, 0, 2, 2, 2, 5])
    values = np.array([[1.0, 2.0], [3.0, np.nan], [4.0, np.nan], [np.inf, np.nan], [8.0, np.nan], [9.0, 1.0]])
    np.testing.assert_array_equal(candidates._means(values, cell), [[2.0, 2.0], [6.0, np.nan], [9.0, 1.0]])


def test_terms_are_signals_that_move_their_magnitudes_and_products():
    plant = SimpleNamespace(inputs=("u", "v"), disturbances=("air",), outputs=("t",))
    signals = np.array([[-1.0, 0.0, 21.0, 25.0], [1.0, 1.0, 21.0, 26.0]])
    assert candidates._labels(plant, signals) == [
        "u", "v", "t", "|u|", "u*u", "u*v", "u*t", "u*|u|", "v*v", "v*t", "v*|u|", "t*t", "t*|u|", "|u|*|u|"
    ]  # fmt: skip


def test_terms_lag_log_by_log_and_from_their_first_value():
    plant = SimpleNamespace(inputs=("u",), disturbances=(), outputs=("t",))
    u = np.array([2.0, 2.0, 6.0, 6.0])
    runs = [(np.array([0.0, 1.0, 3.0, 4.0]), np.column_stack([u, u]), None)] * 2
    half = np.log(2.0)  # by tau = 1 / ln 2 a second halves what is left
    lagged = candidates._filtered(runs, ["u", "u*u"], plant, 1 / half)
    np.testing.assert_allclose(lagged[:4, 0], [2.0, 2.0, 2.0, 4.0])
    np.testing.assert_allclose(lagged[4:, 1], [4.0, 4.0, 4.0, 20.0])


@pytest.mark.parametrize(("weight", "kept"), [(0.2, 1), (0.5, 2)])
def test_a_term_enters_for_two_per_cent_of_what_is_left_on_stretches_not_fitted(weight, kept):
    """Orthogonal by construction in each stretch: the second one's share is w^2 / (1 + w^2), 4 % or 20 %."""
    rng = np.random.default_rng(4)
    parts = np.repeat(np.arange(3), 400)
    wave = [np.tile(np.sign(np.sin(2 * np.pi * k * (np.arange(400) + 0.5) / 400)), 3) for k in (2, 4, 8)]
    r = wave[0] + (weight if kept == 2 else 0.1) * wave[1] + 3.0 * parts
    r[5] = np.nan
    features = np.stack([np.column_stack([wave[1], wave[2], wave[0]]), rng.normal(size=(1200, 3))])
    found = candidates._grow(r, features, parts, ["a", "b", "c"], np.array([10.0, 20.0]), "t", 4)
    assert [(f.output, f.term, f.tau) for f in found] == [("t", "c", 10.0), ("t", "a", 10.0)][:kept]
    share = 1 / (1 + (weight if kept == 2 else 0.1) ** 2)
    assert found[0].share == pytest.approx(share, abs=3e-3)
    if kept == 2:
        assert found[1].share == pytest.approx(1 - share, abs=3e-3)
    assert LEAST == 0.02
    assert len(candidates._grow(r, features, parts, ["a", "b", "c"], np.array([10.0, 20.0]), "t", 1)) == 1


def test_what_is_explained_is_predicted_from_the_other_stretches():
    """Slopes 1 and 3 of two stretches: each predicts the other's with an error of 2 x."""
    x, where = np.array([1.0, 2.0, 1.0, 2.0]), np.array([0, 0, 1, 1])
    r = x * np.array([1.0, 1.0, 3.0, 3.0])
    assert candidates._explained(x[:, None], r, where) == pytest.approx(
        1 - (4 * 5 + 4 * 5) / (5 + 45), abs=1e-6
    )


def test_rows_are_block_means_of_a_four_hundredth_of_the_longest_log(monkeypatch):
    """Six hundred seconds in steps of 1.5; time constants from two steps to the longest log."""
    from thermogrip.datasets.schema import make_log
    from thermogrip.sysid.models.state_space import StateSpaceModel
    from thermogrip.sysid.plant.plant import Plant

    a = float(np.exp(-1 / 60))
    model = StateSpaceModel(("u",), (), ("t",), A=[[a]], B=[[8 * (1 - a)]], C=[[1.0]], dt=1.0, y0=[25.0])
    u = np.repeat(np.random.default_rng(0).uniform(-1, 1, 30), 20)
    t = 25 + lfilter([0, 1 - a], [1, -a], 8 * u) + 0.5
    log = make_log(np.arange(600.0), {"u": (u, "1", "input"), "t": (t, "degC", "output")}, name="a")
    seen = {}
    monkeypatch.setattr(candidates, "_grow", lambda *given: seen.setdefault("given", given) and [])
    candidates.residual_terms(Plant(model, {}, dt=1.0), [log], warmup=30.0)
    residual, features, parts, labels, taus, name, most = seen["given"]
    assert (taus[0], taus[-1], taus.size) == pytest.approx((2 * 599 / 400, 599.0, 24))
    assert features.shape == (24, residual.size, len(labels))
    assert (name, most, set(parts.tolist())) == ("t", 4, {0, 1, 2, 3})
    assert 399 <= residual.size <= 401
    assert np.isnan(residual[:19]).all()  # the warm-up is not scored
    assert np.isfinite(residual[22:]).all()


def test_what_was_taken_from_a_module_is_suggested_again_but_a_cooling_gain_of_one_that_only_warms():
    for name, two_sided in (("gripper", True), ("peltier_chamber", False)):
        model = load_network(name)
        for key, kind, value in (
            ("cooling_gain", "cooling gain", (1.0, 0.3, 0.2)),
            ("offset", "drive offset", (0.0, 0.05, None)),
        ):
            less = patched(model, Candidate("less", {"peltiers": {"module": {key: None}}}))
            new = [c.patch["parameters"] for c in suggested(less) if c.name == f"module: {kind}"]
            assert bool(new) == (two_sided or key == "offset")
            for made in (own[f"module_{key}"] for own in new):
                assert (made["value"], made["sd"], made.get("low")) == value
