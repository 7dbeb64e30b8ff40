"""identify, validate, simulate: what reaches the room, what is printed and answered, and the exit code."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.io import loadmat

from tests.cli.conftest import Bench, StandIn, shares, words_of
from tests.end_to_end.conftest import small_plant
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.log_files import read_log
from thermogrip.datasets.schema import make_log
from thermogrip.report.console import short
from thermogrip.report.plant import band_words
from thermogrip.sysid.data.data_quality import Finding
from thermogrip.sysid.data.preparation import SignalRole
from thermogrip.sysid.experiment.information import plant_from_prior
from thermogrip.sysid.export.dynamics import plant_dynamics
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.models.network_spec import builtin_networks
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.linearise import linearise_plant
from thermogrip.sysid.plant.log_grid import roles_of
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.plant.plant_data import ExpectedError, PlantScores, Sampling
from thermogrip.sysid.validation.free_run import free_run, usual_warmup
from thermogrip.sysid.validation.stated_errors import Row, Standing, Verdict

BOARD = plant_from_prior(load_network("tclab"))
DYNAMICS = plant_dynamics(BOARD, inputs={"q1": 30.0, "q2": 10.0}, draws=9)
IDENTIFICATION = "thermogrip.sysid.identification"


@dataclass(frozen=True)
class Covered:
    """Stands for what the plant rests on."""

    minutes: float


def row(model: str) -> Row:
    return Row("log a", "t1", 0.1234, 91.5, "degC", 77, model, "order 1", 2.5, True)


def found_of(model: str = "network", **changes: Any) -> SimpleNamespace:
    findings = (
        Finding("noise", "log a", "t1", 0.1, "K", "warn", "t1 is noisy"),
        Finding("gaps", "", "", 0.0, "s", "fail", "a gap"),
        Finding("jitter", "", "", 0.0, "s", "ok", "no jitter"),
    )
    found = {
        "plant": BOARD, "model": model, "rows": (row("arx"), row(model)), "good": True, "doubts": (),
        "verdict": "it is good", "data_check": SimpleNamespace(findings=findings),
        "evidence": Covered(3.0), "notes": ("arx: slow",),
        "signals": (SignalRole("q1", "percent", "input", "its unit", True),),
        "expected": {"t1": ExpectedError(0.4, 0.2, 0.9)}, "dynamics": DYNAMICS,
    }  # fmt: skip
    return SimpleNamespace(**found | changes)


@pytest.fixture
def room(bench: Bench, stand_in: StandIn, monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Return a bench whose logs, networks and fits are stand-ins, with their calls."""
    idle = ([0.0, 0.0], "1", "other")
    signals = {"t1": ([20.0, 20.0], "degC", "output"), "q1": idle, "q2": idle, "room": idle}
    log = make_log([0.0, 1.0], signals, name="log a")
    for name in ("good.csv", "two.csv"):
        bench.write(name, "time_s,q1,q2,t1_degC,room\n0,1,1,20,20\n1,1,1,20,20\n")
    log.attrs["repairs"] = "one row dropped\n\ntwo rows swapped"

    def fit(*_: Any, progress: Any, **__: Any) -> SimpleNamespace:
        progress(0.0, "a")
        progress(0.5, "b")
        return made.found

    made = SimpleNamespace(bench=bench, like="gripper", found=found_of(), record=None, dynamics=DYNAMICS)
    made.asked = stand_in("thermogrip.sysid.export.dynamics.plant_dynamics", lambda *_, **__: made.dynamics)
    made.read, made.log = stand_in("thermogrip.datasets.log_files.read_log", log), log
    made.networks = stand_in("thermogrip.cli.options.find_network", load_network)
    made.fits = stand_in(f"{IDENTIFICATION}.identify", fit)
    made.shipped = stand_in(
        "thermogrip.sysid.data.shipped_networks.shipped_network",
        lambda _: load_network(made.like) if made.like in builtin_networks() else None,
    )
    stand_in("thermogrip.sysid.greybox.identifiability.identifiability_report", ["U is identifiable"])
    made.sections = stand_in("thermogrip.report.plant.identification_sections", ["a section"])
    made.pages = stand_in("thermogrip.report.html.write_report")
    return made


@pytest.mark.parametrize(
    ("words", "like", "network"),
    [
        ("", "gripper", "gripper"),
        ("", "thermal_chamber", "thermal_chamber"),
        ("", "none of them", None),
        ("--network tclab", "none of them", "tclab"),
        ("--network none", "gripper", None),
        ("--models arx,network", "room", "room"),
        ("--models arx,oe --network tclab", "tclab", None),
        ("--models arx,oe", "gripper", None),
    ],
)
def test_the_network_is_the_one_asked_for_or_a_shipped_one_whose_columns_the_logs_have(
    words: str, like: str, network: str | None, room: SimpleNamespace
) -> None:
    room.like = like
    done = room.bench.run("identify", "good.csv", *words.split(), "--out", "p.json")
    assert done.code == 0, done
    [fit] = room.fits
    assert (fit.args[1] if fit.args[1] is None else fit.args[1].name) == network
    # read by its names and units first, then again in the network's roles
    roles = None if network is None else roles_of(load_network(network))
    chosen = network is not None and "--network" not in words
    assert [call.known for call in room.read] == [None] * chosen + [roles]
    looked = "--network" not in words and words != "--models arx,oe"
    assert [[log.attrs["name"] for log in call.args[0]] for call in room.shipped] == [["log a"]] * looked
    assert not fit.leave_one_out


def test_words_reach_the_fit_by_their_meaning(room: SimpleNamespace) -> None:
    words = "good.csv two.csv --network tclab --inputs q1,q2 --outputs T1_degC --disturbances room"
    words += " --models arx,network --average 2.5 --leave-one-out"
    words += " --seed 7 --report r.html --workers 3"
    done = room.bench.run("identify", *words.split(), "--out", "p.json")
    assert done.code == 0, done
    words, roles = (("q1", "q2"), ("T1_degC",), ("room",)), (("q1", "q2"), ("t1",), ("room",))
    assert [call.args for call in room.read] == [("good.csv", *words), ("two.csv", *words)]
    assert room.read[0].known == {"q1": "input", "q2": "input", "t1": "output", "t2": "output"}
    [fit] = room.fits
    assert (len(fit.args[0]), fit.args[2:]) == (2, roles)
    assert (fit.models, fit.average, fit.leave_one_out) == (("arx", "network"), 2.5, True)
    assert (fit.draws, fit.seed, fit.workers) == (24, 7, 3)
    [page] = room.pages
    assert page.args == (Path("r.html"), "Identification", "From log a, log a.", ["a section"])
    [asked] = room.sections
    assert (asked.args[0], asked.args[2:]) == (room.found, (BOARD, None, DYNAMICS))
    assert shares(done.err, "identify") == [0, 50]
    assert done.err.count("warning: log a: one row dropped\n") == 2
    assert done.err.count("warning: log a: two rows swapped\n") == 2
    assert "not compiled" not in done.err


def test_how_a_table_is_read_is_passed_on_and_the_plant_is_named_after_the_log(room: SimpleNamespace) -> None:
    done = room.bench.run("identify", "good.csv@:3", "--columns", "time_s,-,t1", "--dt", "2")
    assert (done.code, "wrote good_plant.json" in done.out) == (0, True)
    assert done.err.endswith("next: thermogrip validate good_plant.json LOG\n")
    assert [(call.columns, call.dt) for call in room.read] == [(("time_s", "-", "t1"), 2.0)] * len(room.read)


def test_what_was_found_is_printed(room: SimpleNamespace) -> None:
    done = room.bench.run("identify", "good.csv", "--network", "tclab", "--out", "p.json")
    said = words_of(done.out)
    for words in (
        "arx log a t1 0.1234 degC 91.5 77 2.5 held out",
        "q1 percent input guess: its unit",
        "input output gain low high unit dead time [s] 63 % after [s]",
        f"q2 t1 {DYNAMICS.gain.value[0, 1]:.4g} {DYNAMICS.gain.low[0, 1]:.4g}",
        "about q1 30 percent, q2 10 percent: time constants ",
        "90 % intervals from 9 draws U is identifiable",
        "warn: log a: t1 is noisy fail: a gap note: arx: slow it is good wrote p.json",
    ):
        assert words in said
    assert said.startswith("Columns of the logs")
    assert "Free parameters of the plant" in said
    assert not room.pages
    room.found = found_of("arx", plant=small_plant())
    assert "Free parameters" not in room.bench.run("identify", "good.csv", "--out", "p.json").out


def test_a_plant_that_does_not_settle_has_no_gains(room: SimpleNamespace) -> None:
    room.found = found_of(dynamics=None)
    done = room.bench.run("identify", "good.csv", "--out", "p.json")
    assert "no gains at rest: the plant does not settle" in done.out
    assert "Gains at rest" not in done.out
    done = room.bench.run("identify", "good.csv", "--out", "p.json", "--json")
    assert json.loads(done.out)["dynamics"] is None


def test_the_answer_of_identify_is_what_was_found(room: SimpleNamespace) -> None:
    done = room.bench.run("identify", "good.csv", "--network", "tclab", "--json", "--out", "p.json")
    found = room.found
    assert json.loads(done.out) == {
        "model": "network", "network": "tclab", "good": True, "verdict": "it is good",
        "expected_error": {"t1": {"rmse": 0.4, "low": 0.2, "high": 0.9, "same_gain": None}},
        "signals": [asdict(each) for each in found.signals], "rows": [asdict(each) for each in found.rows],
        "data_check": [asdict(finding) for finding in found.data_check.findings],
        "evidence": {"minutes": 3.0},
        "parameters": {
            name: {"value": BOARD.values[name], "unit": BOARD.units[name]} for name in BOARD.free
        },
        "intervals_90": {name: list(ends) for name, ends in BOARD.intervals(0.9).items()},
        "identifiability": ["U is identifiable"], "posterior": None,
        "notes": ["arx: slow"], "doubts": [], "out": "p.json", "dynamics": DYNAMICS.to_dict(),
        "repairs": {"log a": ["one row dropped", "two rows swapped"]},
    }  # fmt: skip


def test_an_answer_that_is_no_ends_with_3_and_says_what_would_help(room: SimpleNamespace) -> None:
    room.found = found_of(good=False, verdict="not good")
    done = room.bench.run("identify", "good.csv", "--out", "p.json")
    assert done.code == 3
    assert "next: thermogrip excite --kind optimal --minutes 2.7 --plant p.json" in done.err.splitlines()[-1]
    assert Path("p.json").exists()  # the plant is kept all the same


def test_a_guess_that_decides_is_a_warning_and_the_command_that_states_it_comes_next(
    room: SimpleNamespace,
) -> None:
    signals = (
        SignalRole("q1", "percent", "input", "its unit", True),
        SignalRole("t1", "degC", "output", "its unit", True),
        SignalRole("fan 2", "1", "left out", "", True),
    )
    room.found = found_of(good=False, doubts=("fan 2 is left out, and helps to predict t1",), signals=signals)
    done = room.bench.run("identify", "good.csv", "--out", "p.json")
    assert done.code == 3
    assert "thermogrip: warning: in doubt: fan 2 is left out, and helps to predict t1" in done.err
    command = "thermogrip identify good.csv --inputs q1 --outputs t1 --out p.json"
    assert done.err.splitlines()[-1] == f"next: {command}"
    typed = ["--outputs", "t1", "good.csv", "--models", "arx", "--report", "r.html", "--out", "p.json"]
    last_line = room.bench.run("identify", *typed).err.splitlines()[-1]
    typed.remove("good.csv")  # the rest of what was typed stays
    assert last_line == f"next: thermogrip identify good.csv --inputs q1 {' '.join(typed)}"
    nameless = tuple(replace(signal, name=f"c{place}") for place, signal in enumerate(signals, 2))
    room.found = found_of(good=False, doubts=("c2 is taken as input",), signals=nameless)
    last_line = room.bench.run("identify", "good.csv", "--out", "p.json").err.splitlines()[-1]
    assert "--inputs c2 --outputs c3 --out p.json  # better, name its columns in their order" in last_line
    of_two = "a is taken as the time of all columns, and b goes 2 s a row"
    for doubt, step in (("t1 is taken as the time", "1"), ("no column is a clock", "S"), (of_two, "S")):
        room.log.attrs["clock_doubts"] = doubt
        assert (
            f"--outputs c3 --dt {step} --out" in room.bench.run("identify", "good.csv", "--out", "p.json").err
        )
    named = tuple(replace(signal, guessed=False) for signal in signals)  # no roles will mend the other doubts
    room.log.attrs["clock_doubts"] = ""
    room.found = found_of(good=False, doubts=("U is far from its prior",), signals=named)
    done = room.bench.run("identify", "good.csv", "--out", "p.json")
    assert done.code == 3
    assert "next: thermogrip excite --kind optimal --minutes 2.7 --plant p.json" in done.err.splitlines()[-1]


@pytest.mark.parametrize(
    ("notes", "why"),
    [(("arx: slow", "network: it does not converge"), "network: it does not converge"),
     (("arx: slow",), "it was not fitted")],
)  # fmt: skip
def test_a_network_that_was_asked_for_and_not_fitted_is_an_error(
    notes: tuple[str, ...], why: str, room: SimpleNamespace
) -> None:
    room.found = found_of("arx", notes=notes)
    done = room.bench.run("identify", "good.csv", "--network", "tclab", "--out", "p.json")
    assert (done.code, done.said) == (
        2,
        [f"thermogrip: --network tclab: {why}; write --network none to do without"],
    )
    assert room.bench.run("identify", "good.csv", "--out", "p.json").code == 0  # nobody asked for one


SAMPLING = Sampling("well sampled", True, "normal", {"U": 9.0})


@pytest.mark.parametrize(
    ("converged", "model", "code", "said"),
    [
        (True, "network", 0, "well sampled"),
        (False, "network", 3, "well sampled"),
        (None, "network", 3, "network: no posterior, the fit is kept without: at a bound"),
        (True, "arx", 3, "no posterior: the model that was kept is a black box"),
    ],
)
def test_a_posterior_is_an_answer_of_yes_where_it_has_converged(
    converged: bool | None, model: str, code: int, said: str, room: SimpleNamespace, stand_in: StandIn
) -> None:
    sampling = replace(SAMPLING, converged=bool(converged))
    chain = SimpleNamespace(converged=converged, steps=range(500))
    record = SimpleNamespace(sampling=sampling, chain=chain)
    outcome: Any = UserError("at a bound")
    if converged is not None:

        def outcome(plant: Any, *_: Any, progress: Any, **__: Any) -> Any:
            progress(0.5, "c")
            return plant, record

    sampled = stand_in("thermogrip.sysid.greybox.posterior.sample_posterior", outcome)
    room.found = found_of(model)
    done = room.bench.run("identify", "good.csv", "--posterior", "--seed", "5", "--out", "p.json", "--json")
    assert done.code == code
    shown = room.bench.run("identify", "good.csv", "--posterior", "--report", "p.html", "--out", "p.json").out
    assert f"{said}" in shown
    assert room.fits[0].draws == 0
    used = model == "network" and converged is not None
    assert json.loads(done.out)["posterior"] == (vars(sampling) | {"n_steps": 500} if used else None)
    assert room.sections[0].args[3] is (record if used else None)
    if model == "network":
        assert (sampled[0].args[0], sampled[0].seed) == (BOARD, 5)
    if used:
        assert shares(done.err, "identify") == [0, 30, 80]
        assert "posterior: c" in done.err


def test_a_plant_is_scored_log_by_log_beside_its_baselines(bench: Bench) -> None:
    words = ["validate", "plant.json", "good.csv@:100", "good.csv@100:250"]
    options = ["--warmup", "7", "--score-from", "9"]
    done = bench.run(*words, *options, "--report", "v.html")
    assert done.code == 0, done
    said = words_of(done.out)
    answer = json.loads(bench.run(*words, *options, "--json").out)
    assert answer["repairs"] == {
        "good@:100": ["taken from the start to 100 s"], "good@100:250": ["taken from 100 s to 250 s"]
    }  # fmt: skip
    plant = Plant.load("plant.json")
    for found, cut in zip(answer["logs"], ("@:100", "@100:250"), strict=True):
        run = free_run(plant, read_log(f"good.csv{cut}"), warmup=7.0, score_from=9.0)
        assert found["log"] == f"good{cut}"
        for key, scores in (("outputs", run.scores), ("one_step", run.one_step)):
            assert found[key] == {name: asdict(score) for name, score in scores.items()}
        assert set(found["naive"]) == {"no_input", "mean"}
        assert found["verdict"]["standing"] == run.verdict.standing
        band = run.band()
        assert (found["band"]["coverage"], found["band"]["draws"]) == (band.inside, 0)
        for name, score in run.scores.items():
            naive = [run.naive[kind][name].rmse for kind in ("no_input", "mean")]
            shown = (score.rmse, "degC", score.fit_percent, score.n, *naive, run.one_step[name].rmse)
            assert f"good{cut} {name} {' '.join(map(short, shown))}" in said
        assert f"good{cut}: {band_words(band)}" in said
    assert shares(done.err, "validate") == [0, 50]
    page = Path("v.html").read_text(encoding="utf-8")
    assert "scored from 9 s on." in page
    assert all(f"Free run: good{cut}" in page for cut in ("@:100", "@100:250"))


@pytest.fixture
def runs_stand_in(stand_in: StandIn) -> Callable[[Any], None]:
    """Return what makes each free run this one, of which nothing is shown but the verdict."""
    stand_in("thermogrip.report.plant.band_words", "a band")
    stand_in("thermogrip.report.plant.run_table", ((), ()))
    stand_in("thermogrip.cli.identify.run_answer", {})
    return lambda run: stand_in("thermogrip.sysid.validation.free_run.free_run", run) and None


def verdict_of(what: str) -> Verdict:
    """Return a verdict of this standing, or for this cause."""
    standing: dict[str, Standing] = {"seen": "no test", "start": "worse"}
    cause: Any = what if what in standing else ""
    return Verdict(standing.get(what, what), {"t": 1.0}, cause)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("verdicts", "code", "then"),
    [
        (("as stated",), 0, "tune plant.json --out controller.json"),
        (("better",), 0, "tune plant.json --out controller.json"),
        (("as stated", "worse"), 3, "identify LOG_OF_FIT good.csv good.csv@100:200 --out both.json"),
        (("another plant", "as stated"), 3, "identify LOG_OF_FIT good.csv good.csv@100:200 --out both.json"),
        (("no test", "seen"), 0, "excite --kind prbs --minutes 60 --plant plant.json --out schedule.csv"),
        (("seen", "as stated"), 0, "tune plant.json --out controller.json"),
        (("seen",), 0, "validate plant.json LOG"),
        (("start",), 3, "validate plant.json good.csv --warmup {s} --score-from {s}"),
    ],
)
def test_what_comes_after_validate_follows_from_what_it_found(
    bench: Bench, runs_stand_in: Callable[[Any], None], verdicts: tuple[str, ...], code: int, then: str
) -> None:
    found = iter(verdicts)

    def run(*_args: Any, **_options: Any) -> SimpleNamespace:
        return SimpleNamespace(notes=(), band=lambda: None, verdict=verdict_of(next(found)))

    runs_stand_in(run)
    logs = ["good.csv", "good.csv@100:200"][: len(verdicts)]
    done = bench.run("validate", "plant.json", *logs)
    assert done.code == code, done
    seconds = done.err.split("--warmup ")[-1].split()[0]
    assert done.err.endswith(f"next: thermogrip {then.format(s=seconds)}\n")
    assert verdicts != ("start",) or 5 < float(seconds) <= 60  # a tenth of a log of ten minutes at most


@pytest.mark.parametrize(
    ("standing", "then"),
    [
        ("as stated", "identify LOG_OF_FIT good.csv --out both.json"),
        ("seen", "excite --kind prbs --minutes 60 --plant plant.json --out schedule.csv"),
    ],
)
def test_a_plant_that_is_not_good_is_identified_anew_whatever_a_run_says(
    bench: Bench, runs_stand_in: Callable[[Any], None], standing: str, then: str
) -> None:
    runs_stand_in(SimpleNamespace(notes=(), band=lambda: None, verdict=verdict_of(standing)))
    file = bench.path / "plant.json"
    content = json.loads(file.read_text(encoding="utf-8"))
    file.write_text(
        json.dumps(content | {"verdict": "arx na 2; not good: 0.9 of no input"}), encoding="utf-8"
    )
    done = bench.run("validate", "plant.json", "good.csv")
    assert "plant.json: identify did not call it good" in words_of(done.out)
    assert done.err.endswith(f"next: thermogrip {then}\n")


def test_a_plant_is_linearised_where_it_is_asked_for(bench: Bench) -> None:
    (bench.path / "board.json").write_text(json.dumps(replace(BOARD, samples=None).to_dict()))
    words = ("linearise", "board.json", "--at", "q1=30, q2=20", "--dt", "4", "--out", "l.json", "--seed", 3)
    done = bench.run(*words, "--report", "l.html")
    assert done.code == 0, done
    near = linearise_plant(BOARD, inputs={"q1": 30.0, "q2": 20.0}, dt=4.0)
    said = words_of(done.out)
    assert "Gains at rest of board.json" in said
    assert "about q1 30 percent, q2 20 percent: time constants 124 s" in said
    assert said.endswith("wrote l.json")
    written = json.loads((bench.path / "l.json").read_text())
    made = written["provenance"]
    assert (made["command"], made["seed"], list(made["inputs"])) == (
        "thermogrip linearise board.json --at 'q1=30, q2=20' --dt 4 --out l.json --seed 3 --report l.html", 3,
        ["board.json"],
    )  # fmt: skip
    page = (bench.path / "l.html").read_text(encoding="utf-8")
    assert made["inputs"]["board.json"] in page
    assert page.count('type="application/json"') == 2
    assert {key: written[key] for key in ("states", "inputs", "outputs", "dt")} == {
        "states": list(near.states), "inputs": ["q1", "q2"], "outputs": ["t1", "t2"], "dt": 4.0,
    }  # fmt: skip
    for key, wanted in (("A", near.A), ("B", near.B), ("C", near.C), ("D", np.zeros((2, 2)))):
        np.testing.assert_allclose(written[key], wanted, rtol=1e-9)
    np.testing.assert_allclose(written["x0"] + written["u0"] + written["y0"], [*near.x, *near.w, *near.y])
    continuous = linearise_plant(BOARD, inputs={"q1": 30.0, "q2": 0.0})
    assert bench.run("linearise", "board.json", "--at", "q1=30,q2=0", "--out", "l.mat").code == 0
    matlab = loadmat(bench.path / "l.mat")
    np.testing.assert_allclose(matlab["A"], continuous.A, rtol=1e-9)
    assert (matlab["dt"].item(), [name.item() for name in matlab["inputs"][0]]) == (0.0, ["q1", "q2"])
    answer = json.loads(bench.run("linearise", "board.json", "--json").out)
    assert answer["operating_point"] == pytest.approx({"q1": 50.0, "q2": 50.0})
    assert len(answer["gains"]) == 4


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("--at q9=3", "--at 'q9' is unknown; use q1, q2"),
        ("--at q1", "--at 'q1' is no NAME=NUMBER"),
        ("--at q1=hot", "--at 'q1=hot' is no NAME=NUMBER"),
        ("--dt 0.3 --out l.json", "no whole multiple"),
        ("--out l.txt", "l.txt"),
    ],
)
def test_what_cannot_be_linearised_is_refused_in_one_line(words: str, says: str, bench: Bench) -> None:
    (bench.path / "board.json").write_text(json.dumps(replace(BOARD, samples=None).to_dict()))
    done = bench.run("linearise", "board.json", *words.split())
    assert (done.code, len(done.said)) == (2, 1)
    assert says in done.said[0]
    assert not (bench.path / "l.json").exists()


def test_a_plant_begins_from_as_many_readings_as_its_slowest_time_constant_asks_for() -> None:
    """5 s set the state of a plant of 500 s, and what that start left was taken out of its error."""
    t = np.arange(0.0, 6000.0, 5.0)
    signals = {"q": (0.0 * t, "1", "input"), "t": (20.0 + t % 2, "degC", "output")}
    log = make_log(t, signals, name="log")
    model = StateSpaceModel(("q",), (), ("t",), A=[[np.exp(-5 / 500)]], B=[[1.0]], C=[[1.0]], dt=5.0)
    box = Plant(model, {}, dt=5.0, logs=("a", "b", "c"), valid={"q": (0.0, 1.0), "t": (0.0, 50.0)})
    scores = PlantScores(held_out_by_part={"t": [0.1]})
    assert usual_warmup(replace(box, scores=scores), log) == 50.0
    assert usual_warmup(replace(box, scores=scores), log.isel(time=slice(80))) == 40.0
    assert usual_warmup(box, log) == 50.0
