"""excite: the amplitude of a schedule, its time constants, and what is expected of the optimal one."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.cli.conftest import Bench, StandIn, words_of
from tests.end_to_end.conftest import small_plant
from thermogrip.cli import excite as verb
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import make_log
from thermogrip.sysid.experiment.optimal import Expectation

LOG = make_log(np.arange(3.0), {"drive": (np.zeros(3), "1", "input")})
INFORMATION = "thermogrip.sysid.experiment.information"


@pytest.mark.parametrize(
    ("words", "asked", "answer", "said"),
    [
        ("", ("prbs", 5.0), {"share": 1.0}, ""),
        ("--plant plant.json --lowest 10 --highest 40", ("a plant", "prbs", 5.0, 10.0, 40.0),
         {"share": 0.625},
         "62 % of the drive's range keeps the outputs from 10 to 40 degC\n"),
        ("--network tclab", ("a prior", "prbs", 5.0, 5.0, 60.0), {"share": 0.625},
         "62 % of the drive's range keeps the outputs from 5 to 60 degC\n"),
        ("--plant plant.json --network own.py:Own", ("a plant", "prbs", 5.0, 5.0, 60.0), {"share": 0.625},
         "62 % of the drive's range keeps the outputs from 5 to 60 degC\n"),
    ],
)  # fmt: skip
def test_a_plain_schedule_fits_what_is_known_of_the_plant(
    words: str, asked: tuple[Any, ...], answer: dict[str, float], said: str, bench: Bench, stand_in: StandIn
) -> None:
    plants = stand_in("thermogrip.cli.options.load_plant", "a plant")
    stand_in("thermogrip.cli.options.find_network", lambda name: name)
    stand_in(f"{INFORMATION}.plant_from_prior", "a prior")
    plain = stand_in("thermogrip.sysid.experiment.schedules.excite", LOG)
    fitted = stand_in("thermogrip.cli.excite.schedule_for", (LOG, 0.625))
    bench.write("own.py", "")
    options = ["excite", "--kind", "prbs", "--minutes", "5", "--seed", "3", "--out", "s.csv", *words.split()]
    done = bench.run(*options)
    assert (done.code, done.out) == (0, f"{said}wrote s.csv: 3 rows\n"), done
    [call] = plain + fitted
    assert call.seed == 3
    limits = (call.lowest, call.highest) if fitted else ()
    assert (*call.args, *limits) == asked
    assert [call.args[1] for call in plants] == ["own.py:Own" if "own.py" in words else None] * len(plants)
    found = json.loads(bench.run(*options, "--json").out)
    assert found == {"kind": "prbs", "rows": 3, "out": "s.csv", **answer}


@pytest.mark.parametrize(("slew", "hold"), [(None, ()), ("2.5", ("drive", "pump"))])
def test_the_optimal_schedule_is_reported_beside_the_plain_ones(
    slew: str | None, hold: tuple[str, ...], bench: Bench, stand_in: StandIn
) -> None:
    widths = {"now": {"U": 4.0}, "prbs": {"U": 2.0}, "optimal": {"U": 0.5}}
    expected = Expectation({"now": 0.0, "prbs": 1.04, "optimal": 3.04}, widths, {})
    plant = SimpleNamespace(free=("U",), units={}, values={"U": 5.0})
    stand_in("thermogrip.cli.options.load_plant", plant)
    asked = stand_in("thermogrip.cli.excite.optimal_for", (LOG, expected, ["no staircase"]))
    words = ["excite", "--kind", "optimal", "--minutes", "7", "--plant", "plant.json", "--out", "s.csv"]
    words += ["--seed", "4", *(["--slew", slew, "--hold", ",".join(hold)] if slew else [])]
    done = bench.run(*words)
    assert done.code == 0, done
    [call] = asked
    assert (call.args, call.lowest, call.highest) == ((plant, 7.0), 5.0, 60.0)
    assert (call.slew, call.hold, call.seed) == (2.5 if slew else np.inf, hold, 4)
    said = words_of(done.out)
    assert "parameter unit value now prbs optimal" in said
    assert "U 1 5 4 2 0.5" in said
    assert "prbs: 1.0 bits; after optimal 4 times narrower in the mean, determinant 16 times smaller" in said
    assert "optimal: 3.0 bits note: no staircase wrote s.csv" in said
    assert "now: " not in said.split("0.5")[1]
    answer = json.loads(bench.run(*words, "--json").out)["expected"]
    assert answer == {
        "bits": expected.bits, "widths_90": widths, "ranges_90": {}, "notes": ["no staircase"],
        "determinant_ratio": {"now": pytest.approx(2**6.08), "prbs": pytest.approx(16.0)},
    }  # fmt: skip


def test_the_table_of_widths_ends_with_the_range_of_the_last_schedule() -> None:
    plant = SimpleNamespace(free=("U", "C"), units={"C": "J/K"}, values={"U": 5.0, "C": 80.0})
    widths = {"now": {"U": 4.0, "C": 40.0}, "prbs": {"U": 2.0, "C": 20.0}, "optimal": {"U": 1.0, "C": 10.0}}
    expected = Expectation({}, widths, {"prbs": {"U": (1.5, 3.0)}, "optimal": {"U": (0.8, 1.6)}})
    head, rows = verb.expected_rows(plant, expected)
    assert head == ["parameter", "unit", "value", "now", "prbs", "optimal", "from", "to"]
    assert rows == [["U", "1", 5.0, 4.0, 2.0, 1.0, 0.8, 1.6], ["C", "J/K", 80.0, 40.0, 20.0, 10.0]]


def limited(most: float, inputs: tuple[str, ...] = ("pump", "q", "r")) -> SimpleNamespace:
    """Return what keeps a plant below so much of the first drive, whose pump must run."""
    seen: list[np.ndarray] = []

    def stays(u: np.ndarray) -> bool:
        seen.append(u)
        return bool(u[:, inputs.index("q")].max() <= most)

    plant = SimpleNamespace(inputs=inputs)
    return SimpleNamespace(plant=plant, stays=stays, lowest=5.0, highest=60.0, seen=seen)


@pytest.mark.parametrize(
    ("drive", "middle", "reach"),
    [
        ((0.0, 100.0), 50.0, 50.0),
        ((20.0, 60.0), 40.0, 20.0),
        ((-1.0, 0.5), 0.0, 0.5),
        ((-0.25, 1.0), 0.0, 0.25),
    ],
)
def test_a_drive_swings_about_half_of_its_range_and_one_of_both_signs_about_zero(
    drive: tuple[float, float], middle: float, reach: float
) -> None:
    shape, other = np.array([-1.0, 1.0, 0.5]), np.array([1.0, 0.0, -1.0])
    ranges = {"q": drive, "r": (0.0, 10.0)}
    free = limited(np.inf)
    share, found = verb._largest(free, {"q": shape, "r": other}, ranges, np.arange(3.0))
    assert share == 1.0
    np.testing.assert_allclose(found["q"], middle + reach * shape)
    np.testing.assert_allclose(found["r"], 5.0 + 5.0 * other)
    [u] = free.seen
    np.testing.assert_array_equal(u, np.column_stack([np.ones(3), found["q"], found["r"]]))
    for share in (0.731, 0.3, 0.021):
        tight = limited(share * (middle + reach) * (1 + 1e-12))
        best, found = verb._largest(tight, {"q": shape, "r": other}, ranges, np.arange(3.0))
        assert share - 2.0**-verb.HALVINGS < best <= share * (1 + 1e-9)
        np.testing.assert_allclose(found["q"], best * (middle + reach * shape))
        assert len(tight.seen) == 1 + verb.HALVINGS == 13


def test_less_than_a_fiftieth_of_the_range_is_no_schedule() -> None:
    with pytest.raises(UserError, match="no schedule keeps the plant from 5 to 60 degC; widen --lowest and"):
        verb._largest(limited(1.9), {"q": np.ones(2)}, {"q": (0.0, 100.0)}, np.arange(2.0))


@pytest.mark.parametrize(
    ("answers", "dt", "expected"),
    [
        (
            {"t1": (1.0, 4.0, 100.0), "t2": (-3.0, 20.0, 600.0)},
            1.0,
            (30.0, 600.0),
        ),  # the greater gain: lag / 20
        ({"t1": (5.0, 40.0, 100.0), "t2": (-3.0, 20.0, 600.0)}, 1.0, (40.0, 100.0)),  # the delay
        ({"t1": (5.0, 0.0, 8.0), "t2": (0.0, 0.0, 0.0)}, 3.0, (6.0, 12.0)),  # two steps, and twice that
    ],
)
def test_a_drive_is_excited_by_the_time_constants_of_the_output_that_it_moves_most(
    answers: dict[str, tuple[float, float, float]],
    dt: float,
    expected: tuple[float, float],
    stand_in: StandIn,
) -> None:
    stand_in("thermogrip.cli.excite._ranges", {"q": (0.0, 1.0)})
    made = {name: SimpleNamespace(gain=g, delay=d, lag=lag) for name, (g, d, lag) in answers.items()}
    asked = stand_in("thermogrip.mpc.plant.prediction.step_response", lambda plant, drive, out: made[out])
    plant = SimpleNamespace(outputs=tuple(answers), dt=dt)
    assert verb._time_constants(plant) == {"q": expected}
    assert asked[0].args == (plant, "q", "t1")


def test_every_drive_has_its_range_and_the_pump_none() -> None:
    assert verb._ranges(small_plant()) == {"drive": (-1.0, 1.0)}


def test_each_drive_has_a_schedule_of_its_own_seed_unit_and_time_constants(stand_in: StandIn) -> None:
    stand_in("thermogrip.cli.excite._time_constants", {"q": (1.0, 5.0), "r": (2.0, 9.0)})
    stand_in("thermogrip.cli.excite._ranges", {"q": (0.0, 100.0), "r": (-1.0, 1.0)})
    plain = stand_in("thermogrip.sysid.experiment.schedules.excite", LOG)
    room = stand_in(f"{INFORMATION}.ExperimentForecast", lambda plant, **_: limited(np.inf))
    switched = SimpleNamespace(switches=("pump",))
    plant = SimpleNamespace(dt=0.5, units={"q": "percent"}, model=switched)
    log, share = verb.schedule_for(plant, "multisine", 4.0, lowest=8.0, highest=50.0, seed=6)
    assert [call.args for call in plain] == [("multisine", 4.0)] * 2
    assert [(call.dt, call.tau_fast, call.tau_slow, call.seed) for call in plain] == [
        (0.5, 1.0, 5.0, 6), (0.5, 2.0, 9.0, 7),
    ]  # fmt: skip
    assert (room[0].args, room[0].lowest, room[0].highest) == ((plant,), 8.0, 50.0)
    assert (share, log.attrs["name"]) == (1.0, "multisine schedule")
    units = {str(name): (item.attrs["units"], item.attrs["role"]) for name, item in log.items()}
    assert units == {"q": ("percent", "input"), "r": ("1", "input"), "pump": ("1", "input")}
    assert log["q"].values.tolist() == [50.0] * 3
    assert log["pump"].values.tolist() == [1.0] * 3


@pytest.mark.parametrize(("slew", "begins", "share"), [(np.inf, True, np.inf), (3.0, False, 1.5)])
def test_the_search_for_the_optimal_schedule_begins_from_the_plain_ones_unless_they_move_too_fast(
    slew: float, begins: bool, share: float, stand_in: StandIn
) -> None:
    def plain(plant: Any, kind: str, *_: Any, **__: Any) -> Any:
        if kind == "staircase":
            raise UserError("too hot", hint="widen")
        return LOG, 1.0

    fitted = stand_in("thermogrip.cli.excite.schedule_for", plain)
    stand_in("thermogrip.cli.excite._time_constants", {"q": (7.0, 50.0), "r": (3.0, 90.0)})
    stand_in("thermogrip.cli.excite._ranges", {"q": (0.0, 100.0), "r": (-1.0, 1.0)})
    searched = stand_in("thermogrip.sysid.experiment.optimal.optimal_schedule", "the best")
    expected = stand_in("thermogrip.sysid.experiment.optimal.expect", "expected")
    plant = SimpleNamespace(covariance=np.eye(1))
    limits = {"lowest": 8.0, "highest": 50.0, "seed": 6}
    found = verb.optimal_for(plant, 9.0, slew=slew, hold=("r",), **limits)
    assert found == ("the best", "expected", ["no staircase to compare with: too hot"])
    assert [call.args for call in fitted] == [
        (plant, kind, 9.0) for kind in ("prbs", "multisine", "staircase")
    ]
    assert {name: getattr(fitted[0], name) for name in limits} == limits
    kinds = {"prbs": LOG, "multisine": LOG}
    [search] = searched
    assert (search.args, search.begin) == ((plant, 9.0), kinds if begins else None)
    assert (search.shortest, search.slew, search.hold, search.seed) == (3.0, share, ("r",), 6)
    assert (search.lowest, search.highest, search.ranges["q"]) == (8.0, 50.0, (0.0, 100.0))
    assert expected[0].args == (plant, kinds | {"optimal": "the best"})
    with pytest.raises(UserError, match="the plant has no covariance"):
        verb.optimal_for(SimpleNamespace(covariance=None), 9.0, slew=slew, **limits)
