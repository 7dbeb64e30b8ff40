"""A rig that has drifted from its plant: what the guard allows, learns, and cannot learn away."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.rig.fault_injection.drills import DRILLS, drill_plants, run_drill
from thermogrip.datasets.errors import UserError
from thermogrip.mpc.controllers.pi import PIController
from thermogrip.rig.guard.guard import Guard, GuardSettings
from thermogrip.rig.guard.model_checks import ModelSettings
from thermogrip.rig.guard.plant_mismatch import LEARN_FROM, Evidence, PlantDrift
from thermogrip.rig.session.session import Session, run_session
from thermogrip.rig.simulation.twin import Twin
from thermogrip.sysid.plant.plant import Plant

KNOWN, REAL = drill_plants()
N = len(KNOWN.model.parameters)
OFF = {"current": 0.96, "C_water": 1.04, "G_tank": 0.96}
DRIFTED = replace(KNOWN, values={name: v * OFF.get(name, 1.0) for name, v in KNOWN.values.items()})


def unknown(n: int = 2, drift: float = 0.05) -> PlantDrift:
    names = tuple(f"p{k}" for k in range(n))
    return PlantDrift("0", names, drift, np.zeros(n), np.eye(n) / 3)


def evidence(rng: np.random.Generator, delta: np.ndarray, n: int, sd: float = 0.1) -> list[Evidence]:
    slopes = rng.normal(size=(n, delta.size))
    return [Evidence(float(g @ delta + rng.normal() * sd), g, sd) for g in slopes]


def with_drift(drift: PlantDrift | None = None, **monitor: float) -> Guard:
    return Guard(KNOWN, GuardSettings(model=replace(ModelSettings(), **monitor)), drift=drift)


def session_on(real: Plant, guard: Guard, target: float, seed: int = 0, hold: float = 60.0) -> Session:
    rig = Twin(real, ambient=25.0, seed=seed)
    return run_session(rig, PIController(KNOWN, dt=1.0), target, hold=hold, guard=guard)


# ---- what is learnt ----


def test_what_is_learnt_is_the_least_squares_solution_with_the_prior_as_rows_of_its_own() -> None:
    rng = np.random.default_rng(0)
    seen = evidence(rng, np.array([0.4, -0.2]), 12)
    rows = np.vstack([np.array([e.slopes / e.sd for e in seen]), np.sqrt(3.0) * np.eye(2)])
    right = np.concatenate([[e.residual / e.sd for e in seen], np.zeros(2)])
    solution = np.linalg.lstsq(rows, right, rcond=None)[0]
    np.testing.assert_allclose(unknown().learnt(seen).mean, solution, rtol=1e-9)


def test_learning_session_by_session_comes_to_the_same_as_all_at_once() -> None:
    rng, delta = np.random.default_rng(1), np.array([0.3, -0.5])
    first, second = evidence(rng, delta, 5), evidence(rng, delta, 7)
    halfway = unknown().learnt(first)
    # residuals of a later session are from the corrected plant: less by what is known already
    rest = [replace(e, residual=e.residual - float(e.slopes @ halfway.mean)) for e in second]
    at_once = unknown().learnt([*first, *second])
    np.testing.assert_allclose(halfway.learnt(rest).mean, at_once.mean, rtol=1e-9)
    np.testing.assert_allclose(halfway.learnt(rest).covariance, at_once.covariance, rtol=1e-9)


@settings(max_examples=100, deadline=None)
@given(
    st.lists(
        st.tuples(st.floats(-50, 50), st.floats(-5, 5), st.floats(-5, 5), st.floats(0.05, 2)), max_size=20
    )
)
def test_no_parameter_moves_by_more_than_the_drift_and_nothing_becomes_less_known(
    seen: list[tuple[float, float, float, float]],
) -> None:
    before = unknown()
    after = before.learnt([Evidence(r, np.array([a, b]), sd) for r, a, b, sd in seen])
    assert np.abs(after.mean).max() <= 1.0
    assert max(abs(share) for share in after.shares().values()) <= 0.05
    slopes = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, -1.0]])
    assert (after.spread(slopes) <= before.spread(slopes) + 1e-9).all()


def test_a_healthy_session_brings_the_guards_plant_nearer_to_the_rig(tmp_path: Path) -> None:
    guard = with_drift(PlantDrift.unknown(KNOWN, 0.05, file=tmp_path / "rig.json"))
    for k, target in enumerate((38.0, 20.0)):
        assert session_on(DRIFTED, guard, target, k).verdict == "settled"
    learnt = guard.model.drift
    assert learnt.sessions == 2
    better = replace(KNOWN, values=dict(zip(learnt.names, learnt.parameters(KNOWN).tolist())))

    truth = free_run(DRIFTED)  # of a run that was not learnt from
    off = [float(np.sqrt(np.mean((free_run(plant) - truth) ** 2))) for plant in (KNOWN, better)]
    assert off[1] < 0.5 * off[0]


def free_run(plant: Plant) -> np.ndarray:
    """Return the true outputs of a plant that is heated, then cooled."""
    twin = Twin(plant, ambient=25.0)
    for k in range(300):
        twin.apply({"drive": 0.5 if k < 150 else -0.3}, 1)
        twin.wait(1.0)
    return np.array([[row[name] for name in plant.outputs] for row in twin.history])


# ---- what cannot be learnt away ----


def test_a_driver_that_weakens_from_the_first_session_on_trips_all_the_same(tmp_path: Path) -> None:
    guard = with_drift(PlantDrift.unknown(KNOWN, 0.05, file=tmp_path / "rig.json"))
    for k in range(1, 5):
        weak = REAL.values | {"current": REAL.values["current"] * (1 - 0.09 * k)}
        session = session_on(replace(REAL, values=weak), guard, (36.0, 20.0)[k % 2], k)
        if session.trip is not None:
            break
    assert session.trip is not None, "36 % less current, and nobody noticed"
    assert max(abs(share) for share in guard.model.drift.shares().values()) <= 0.05


def test_a_session_that_tripped_teaches_nothing(tmp_path: Path) -> None:
    guard = with_drift(PlantDrift.unknown(KNOWN, 0.05, file=tmp_path / "rig.json"))
    weak = replace(REAL, values=REAL.values | {"current": 0.3 * REAL.values["current"]})
    session = session_on(weak, guard, 38.0)
    assert session.trip is not None
    assert guard.learn() is None
    assert not (tmp_path / "rig.json").exists()


def test_after_the_first_sessions_the_file_stays_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "rig.json"
    done = replace(PlantDrift.unknown(KNOWN, 0.05, file=path), sessions=LEARN_FROM)
    done.save(path)
    before = path.read_bytes()
    session = session_on(REAL, with_drift(PlantDrift.load(path, KNOWN)), 36.0)
    assert session.verdict == "settled"
    assert path.read_bytes() == before
    assert "learnt" not in [event.kind for event in session.events]
    assert "drift" in [event.kind for event in session.events]


@pytest.mark.parametrize("name", ["skin sensor drifts 0.1 K/s", "driver stuck at full drive"])
def test_faults_are_found_in_their_time_with_a_drift_of_which_nothing_is_known_yet(
    name: str, tmp_path: Path
) -> None:
    drill = next(one for one in DRILLS if one.name == name)
    drifted = GuardSettings(model=replace(ModelSettings(), drift=0.05))
    controller = PIController(KNOWN, dt=1.0)
    outcome = run_drill(drill, controller, tmp_path / "run", hold=400.0, link="socket", settings=drifted)
    assert outcome.session.trip.kind in drill.kinds
    assert outcome.detected <= drill.within


# ---- the file, and what is reported ----


def test_what_a_session_learnt_is_kept_and_noted(tmp_path: Path) -> None:
    path = tmp_path / "rig.json"
    session = session_on(REAL, with_drift(PlantDrift.unknown(KNOWN, 0.05, file=path)), 38.0, hold=120.0)
    kinds = [event.kind for event in session.events]
    assert kinds.index("drift") < kinds.index("learnt")
    reported = next(event for event in session.events if event.kind == "learnt")
    content = json.loads(path.read_text())
    assert reported.data == content["shares"]
    assert content["sessions"] == 1
    assert f"learnt from 1 of {LEARN_FROM} sessions" in reported.text
    kept = PlantDrift.load(path, KNOWN)
    assert kept.windows == content["windows"] >= 2
    np.testing.assert_array_equal(kept.mean, content["delta"]["mean"])


def test_a_file_that_cannot_be_kept_ends_no_session_and_is_noted(tmp_path: Path) -> None:
    gone = tmp_path / "gone" / "rig.json"
    session = session_on(REAL, with_drift(PlantDrift.unknown(KNOWN, 0.05, file=gone)), 38.0, hold=120.0)
    assert session.verdict == "settled"
    reported = next(event.text for event in session.events if event.kind == "learnt")
    assert "not kept" in reported


@pytest.mark.parametrize(
    ("change", "said"),
    [({"drift": 0.5}, "moved by more"), ({"drift": float("1e-400")}, "moved by more"),
     ({"delta": {"mean": [2.0], "covariance": [[0.1]]}}, "is damaged"),
     ({"delta": {"mean": [0.0], "covariance": (np.eye(N) / 3).tolist()}}, rf"{N} shares, mean \(1,\)"),
     ({"delta": {"mean": [0.0] * N, "covariance": [[0.3]]}}, r"covariance \(1, 1\)"),
     ({"sessions": "many"}, "is damaged"), ({"plant": "0"}, "another plant"), ({"version": 9}, "version 9")],
)  # fmt: skip
def test_a_file_that_was_tampered_with_is_refused(
    change: dict[str, object], said: str, tmp_path: Path
) -> None:
    path = PlantDrift.unknown(KNOWN, 0.05).save(tmp_path / "rig.json")
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(UserError, match=said) as refused:
        PlantDrift.load(path, KNOWN)
    assert "rig.json" in str(refused.value)


@pytest.mark.parametrize(
    ("mean", "covariance", "said"),
    [(1.2, 0.1, "moved by more than the drift"), (-1.2, 0.1, "moved by more than the drift"),
     (0.5, 0.4, "the covariance is not that of a drift"),
     (0.5, -0.01, "the covariance is not that of a drift")],
)  # fmt: skip
def test_numbers_that_no_learning_gives_are_refused(
    mean: float, covariance: float, said: str, tmp_path: Path
) -> None:
    n = len(KNOWN.model.parameters)
    path = PlantDrift.unknown(KNOWN, 0.05).save(tmp_path / "rig.json")
    content = json.loads(path.read_text())
    usual = {"mean": np.full(n, 0.9).tolist(), "covariance": (0.3 * np.eye(n)).tolist()}
    path.write_text(json.dumps(content | {"delta": usual}))
    assert PlantDrift.load(path, KNOWN).mean.tolist() == usual["mean"]
    known = {"mean": np.full(n, mean).tolist(), "covariance": (covariance * np.eye(n)).tolist()}
    path.write_text(json.dumps(content | {"delta": known}))
    with pytest.raises(UserError, match=said):
        PlantDrift.load(path, KNOWN)


def test_a_share_is_of_the_parameter_and_on_a_linear_scale_of_a_fifth_at_least() -> None:
    values = {"drive_offset": -0.5, "cooling_gain": 0.1, "seebeck": 0.083}
    scales = KNOWN.scales | {"drive_offset": "linear", "cooling_gain": "linear"}
    plant = replace(KNOWN, values=KNOWN.values | values, scales=scales)
    drift = PlantDrift.unknown(plant, 0.05)
    steps = dict(zip(drift.names, drift.steps(plant)))
    # C_water has no prior, so no scale: it is as any quantity that is positive
    want = {
        "drive_offset": 0.025,
        "cooling_gain": 0.01,
        "seebeck": 0.05 * 0.083,
        "C_water": 0.05 * plant.values["C_water"],
    }
    assert {name: steps[name] for name in want} == pytest.approx(want)
    moved = replace(drift, mean=np.linspace(-1, 1, len(drift.names)))
    np.testing.assert_allclose(moved.parameters(plant), plant.p + moved.mean * drift.steps(plant))


def test_the_first_dozen_sessions_teach_and_only_where_there_is_a_file(tmp_path: Path) -> None:
    drift = PlantDrift.unknown(KNOWN, 0.05, file=tmp_path / "rig.json")
    learns = [replace(drift, sessions=n).learns for n in (0, 11, 12)]
    assert learns == [True, True, False]
    assert not replace(drift, file=None).learns


def test_what_moved_most_is_reported_first() -> None:
    known = replace(unknown(5), mean=np.array([0.1, -0.9, 0.0, 0.5, -0.2]), sessions=2, windows=7)
    assert known.line().endswith("learnt from 2 of 12 sessions, 7 windows: p1 -4.5 %, p3 +2.5 %, p4 -1.0 %")


def test_a_path_may_end_three_standard_deviations_elsewhere() -> None:
    cov = np.array([[0.2, -0.1], [-0.1, 0.3]])
    known = replace(unknown(), covariance=cov)
    slopes = np.array([[1.0, 2.0], [0.0, -3.0]])
    assert known.spread(slopes) == pytest.approx([3 * np.sqrt(0.2 - 0.4 + 1.2), 3 * np.sqrt(2.7)])


def test_without_a_stated_drift_nothing_is_allowed_and_nothing_learnt() -> None:
    guard = with_drift()
    session = session_on(REAL, guard, 36.0)
    assert guard.model.drift is None
    assert guard.model.evidence == []
    assert {"drift", "learnt"}.isdisjoint(event.kind for event in session.events)
