"""What a plant's page says of a free run: its verdict and its colour agree with the notes under it."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from matplotlib.figure import Figure

from tests.report.conftest import part
from thermogrip.datasets.schema import Log, make_log
from thermogrip.report import plant
from thermogrip.report.html import Plot, Table, Text
from thermogrip.report.plant import _prior_intervals, free_run_section, parameter_table
from thermogrip.sysid.data.preparation import SignalRole
from thermogrip.sysid.experiment.information import plant_from_prior
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.plant.plant_data import Identifiability, Sampling
from thermogrip.sysid.validation.free_run import FreeRun, free_run
from thermogrip.sysid.validation.stated_errors import Band


@pytest.fixture(scope="module")
def run() -> tuple[Plant, Log, FreeRun]:
    """Return a plant, a log of it with white noise, and its free run."""
    block = StateSpaceModel(("q",), (), ("t",), A=np.full((1, 1), 0.9), B=np.eye(1), C=np.eye(1), dt=1.0)
    q = np.repeat([0.0, 1.0, 0.0, 2.0], 50)
    y = block.rollout([[0.0]], q[None, :, None], np.zeros((1, 200, 0)), (), 1.0)[0][0, :-1, 0]
    y = y + 0.05 * np.random.default_rng(0).standard_normal(200)
    log = make_log(np.arange(200.0), {"q": (q, "1", "input"), "t": (y, "degC", "output")})
    plant = Plant(block, {}, dt=1.0, noise={"t": 0.05})
    return plant, log, free_run(plant, log)


def test_a_good_free_run_is_green(run: tuple[Plant, Log, FreeRun]) -> None:
    _, _, found = run
    section = free_run_section(found)
    assert section.tone == "good"
    assert section.verdict.startswith("Free run (RMSE): t to 0.0")
    assert re.search(
        r" degC; the error is as stated \(times the stated error: t [\d.]+\)\.$", section.verdict
    )
    bare = replace(found, scores={name: replace(s, unit="1") for name, s in found.scores.items()})
    assert free_run_section(bare).verdict == section.verdict.replace(" degC", "")


def test_the_prior_of_a_network_stands_beside_what_was_learnt_and_a_black_box_has_none(
    run: tuple[Plant, Log, FreeRun],
) -> None:
    learnt_nothing = plant_from_prior(load_network("tclab"))
    head, rows = parameter_table(learnt_nothing)
    assert len(rows) > 3
    assert head == ("parameter", "value", "unit", "5 %", "95 %", "prior 5 %", "prior 95 %")
    for _, value, _, *learnt_and_prior in rows:
        low, high, *prior = learnt_and_prior
        assert low < value < high
        assert prior == [low, high]
    assert _prior_intervals(run[0]) == {}


def test_a_free_run_s_page_has_its_scores_band_and_baselines(run: tuple[Plant, Log, FreeRun]) -> None:
    _, log, found = run
    section = free_run_section(found)
    assert section.title == f"Free run: {log.attrs['name']}"
    assert free_run_section(found, seen=True).title.endswith(" (in the fit)")
    assert free_run_section(found, seen=True, title="Mine").title == "Mine"
    picture, table = part(section, 0, Plot), part(section, 1, Table)
    assert [panel.label for panel in picture.chart.columns[0]] == ["t [degC]", "error [K]", "inputs"]
    assert f"Readings of the first {found.warmup:.3g} s set the state" in picture.caption
    score, naive = found.scores["t"], found.naive
    assert table.rows == (
        (log.attrs["name"], "t", score.rmse, score.unit, score.fit_percent, score.n,
         naive["no_input"]["t"].rmse, naive["mean"]["t"].rmse, found.one_step["t"].rmse),
    )  # fmt: skip
    tied = free_run_section(replace(found, no_better=("t",), notes=("a note",)))
    assert (tied.tone, tied.parts[-1]) == ("warn", Text("a note."))
    assert "; t no better than a model without input; " in tied.verdict


@pytest.mark.parametrize(
    ("draws", "words"), [(7, "7 draws of the parameters and the noise"), (0, "the noise")]
)
def test_a_band_says_what_it_is_made_of_and_covers(draws: int, words: str) -> None:
    band = Band({}, {"t": 0.876, "s": 0.95}, draws, "the noise")
    said = f"90 % band from {words}; it covers 88 % of t, 95 % of s"
    assert plant.band_words(band) == said
    band = replace(band, expected={"t": 0.123, "s": 4.0}, likely={"t": (0.1, 0.2), "s": (2.0, 9.0)})
    assert plant.band_words(band) == f"{said} and has an expected RMSE of t 0.12 (0.1 to 0.2), s 4 (2 to 9)"


def test_signals_are_shown_with_their_roles_and_guesses_are_marked() -> None:
    signals = (
        SignalRole("q", "W", "input", "named", False),
        SignalRole("s", "degC", "left out", "its name", True),
    )
    found: Any = SimpleNamespace(signals=signals)
    assert plant.signal_table(found) == (
        ("column", "unit", "role", "why"),
        (("q", "W", "input", "named"), ("s", "degC", "left out", "guess: its name")),
    )


@pytest.fixture
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plant, "corner_figure", lambda *_, **__: Figure())
    monkeypatch.setattr(
        "thermogrip.sysid.greybox.identifiability.identifiability_report", lambda _: ["U is known"]
    )


def identified(good: bool = True) -> Any:
    rows = [
        SimpleNamespace(model="oe", log=log, output="t", rmse=0.5, no_input_rmse=2.0, held_out=held,
                        unit="degC", fit_percent=90.0, n=50)
        for log, held in (("a", True), ("b", False))
    ]  # fmt: skip
    findings = [
        SimpleNamespace(verdict=verdict, check="gaps", log="a", channel="t", says="a gap")
        for verdict in ("ok", "warn")
    ]
    checked = SimpleNamespace(findings=findings)
    return SimpleNamespace(
        rows=rows, data_check=checked, good=good, verdict="oe is best", notes=("arx failed",),
        model="oe", signals=(), runs=(), held_out_runs={},
    )  # fmt: skip


@pytest.mark.usefixtures("no_figures")
@pytest.mark.parametrize(("good", "tone"), [(True, "good"), (False, "warn")])
def test_an_identification_has_its_tables_and_verdict(good: bool, tone: str) -> None:
    section = plant.identification_section(identified(good))
    assert (section.verdict, section.tone) == ("oe is best.", tone)
    tables = [part for part in section.parts if isinstance(part, Table)]
    assert [table.caption for table in tables][:3] == [
        "Free-run RMSE on rows that were not fitted (blocks: of means over a step of the model)",
        "Columns of the logs",
        "oe, fitted on everything, on its own logs",
    ]
    assert tables[2].rows == (("b", "t", 0.5, "degC", 90.0, 50),)
    assert tables[-1].rows == (("warn", "gaps", "a", "t", "a gap"),)
    texts = [part for part in section.parts if isinstance(part, Text)]
    assert texts == [Text("arx failed.")]
    clean = identified()
    clean.data_check.findings = clean.data_check.findings[:1]
    captions = [part.caption for part in plant.identification_section(clean).parts if isinstance(part, Table)]
    assert captions == [table.caption for table in tables[:3]]


@pytest.mark.usefixtures("no_figures")
def test_parameters_stand_where_there_are_any(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plant, "free_run_section", lambda *args, **options: (args, options))
    simulated = Mock(return_value="a run")
    monkeypatch.setattr("thermogrip.sysid.validation.free_run.free_run", simulated)
    found = identified()
    found.runs = (SimpleNamespace(warmup=9.0),)
    board = plant_from_prior(load_network("tclab"))
    logs: Any = ["a log"]
    sections = plant.identification_sections(found, logs, board, None)
    simulated.assert_called_once_with(board, "a log", 9.0)
    own_run: Any = sections[-1]
    assert own_run == (("a run",), {"seen": True})
    assert [section.title for section in sections[:2]] == [
        "Which plant is behind the logs?", "How well are its parameters known?",
    ]  # fmt: skip
    black: Any = SimpleNamespace(free=())
    assert len(plant.identification_sections(found, logs, black, None)) == 2


def test_what_was_held_out_is_drawn_and_its_error_is_the_answer(run: tuple[Plant, Log, FreeRun]) -> None:
    _, log, found = run
    kept = identified()
    kept.held_out_runs = {"last 30 % of one": found}
    section = plant.held_out_section(kept)
    assert section.verdict == f"RMSE of last 30 % of one: t {found.scores['t'].rmse:.2g} degC."
    (drawn,) = section.parts
    assert isinstance(drawn, Plot)
    measured, simulated = drawn.chart.columns[0][0].curves
    np.testing.assert_array_equal(measured.y, log["t"].values)
    np.testing.assert_array_equal(simulated.y, found.log["t"].values)
    assert (measured.dash, simulated.dash) == ("-", "--")
    assert measured.colour != simulated.colour


@pytest.mark.usefixtures("no_figures")
def test_parameters_answer_for_themselves_and_the_sampler_only_where_it_failed() -> None:
    board = plant_from_prior(load_network("tclab"))
    section = plant.parameters_section(board)
    _, rows = parameter_table(board)
    off = {row[0]: (row[4] - row[3]) / 2 / row[1] for row in rows}
    least = max(off, key=lambda name: off[name])
    near = sum(width <= 0.1 for width in off.values())
    assert section.verdict.startswith(f"{near} of {len(rows)} parameters are known within \u00b110 %")
    assert part(section, 1, Text).text.startswith(f"Known least: {least} (")
    assert section.parts[-1] == Text("U is known.")
    names = board.free
    samples = np.random.default_rng(0).normal(3.0, 0.5, (400, len(names)))
    record: Any = SimpleNamespace(
        samples=samples, free=names, sampled=names[:1], off_centre=0.123,
        sampling=Sampling("converged: 50 autocorrelation times", True, "normal", {names[0]: 10.0}),
        chain=SimpleNamespace(steps=range(500), converged=True, acceptance=0.3, ess=np.array([812.4])),
    )  # fmt: skip
    known = plant.parameters_section(board, record)
    assert (known.verdict, known.tone) == (section.verdict, "plain")
    table = part(known, 0, Table)
    assert table.head == (
        "parameter", "value", "unit", "mean", "sd", "5 %", "95 %", "ESS", "prior 5 %", "prior 95 %"
    )  # fmt: skip
    assert table.rows[0][3:5] == (pytest.approx(3.0, abs=0.1), pytest.approx(0.5, abs=0.1))
    assert (table.rows[0][7], table.rows[1][7]) == (812, None)
    assert "500 steps, converged: 50 autocorrelation times, 30 % accepted" in part(known, 4, Text).text
    record.chain.converged = False
    record.sampling = replace(record.sampling, verdict="not converged: 9 autocorrelation times")
    unsure = plant.parameters_section(board, record)
    assert unsure.tone == "warn"
    assert unsure.verdict.endswith("The sampler has not converged: 9 autocorrelation times.")
    flat = Identifiability(1e6, ["a up, b up"], True, [], {})
    loose = plant.parameters_section(replace(board, scores=replace(board.scores, identifiability=flat)))
    assert (loose.tone, loose.verdict) == ("warn", section.verdict)
    assert loose.parts[2] == Text("These cannot be estimated separately: a up, b up.")


def test_blocks_of_a_log_share_a_row_that_shows_each() -> None:
    row = {"model": "oe", "output": "t", "unit": "degC", "held_out": True}
    rows: Any = [
        SimpleNamespace(log=log, rmse=rmse, fit_percent=fit, n=n, no_input_rmse=idle, **row)
        for log, rmse, fit, n, idle in (
            ("block 1 of 2", 3.0, 80.0, 10, 6.0),
            ("block 2 of 2", 4.0, 90.0, 30, 2.0),
            ("last 30 % of a", 5.0, 50.0, 7, 8.0),
            ("block copper", 6.0, 50.0, 7, 8.0),  # a log's own name
            ("block wood", 7.0, 50.0, 7, 8.0),
        )
    ]
    head, (both, tail, *logs) = plant.held_out_table(rows)
    assert head == ("model", "log", "output", "RMSE", "unit", "fit [%]", "n", "no input", "")
    assert [row[1] for row in logs] == ["block copper", "block wood"]
    assert both[:3] == ("oe", "2 blocks: 3, 4", "t")
    assert both[3] == pytest.approx(np.sqrt((10 * 9 + 30 * 16) / 40))
    assert both[4:7] == ("degC", 85.0, 40)
    assert both[7] == pytest.approx(np.sqrt((10 * 36 + 30 * 4) / 40))
    assert tail == ("oe", "last 30 % of a", "t", 5.0, "degC", 50.0, 7, 8.0, "held out")


def test_a_parameter_is_known_as_well_as_half_its_interval_is_wide() -> None:
    ends = {"a": (9.0, 11.0), "b": (1.6, 2.4), "c": (-3.0, 1.0)}
    known: Any = SimpleNamespace(
        free=tuple(ends),
        units={"b": "W/K"},
        values={"a": 10.0, "b": 2.0, "c": -1.0},
        intervals=lambda level: ends,
    )
    share, least = plant.known_words(known)
    assert share.startswith("1 of 3 parameters are known within \N{PLUS-MINUS SIGN}10 %, 2 within")
    assert least == "Known least: c (-3 to 1), b (1.6 to 2.4 W/K), a (9 to 11)."


def test_a_pair_of_poles_is_said_once_with_its_period() -> None:
    poles = np.array([-0.05 + 0.5j, -0.05 - 0.5j, -1.0])
    found: Any = SimpleNamespace(
        linear=SimpleNamespace(inputs=("q",), w=(0.5,)), units={"q": "W"}, poles=poles, draws=(), level=0.9,
        time_constants=-1 / poles.real, gain=SimpleNamespace(low=np.array([np.nan])),
    )  # fmt: skip
    assert "time constants 20 s (period 12.6 s), 1 s; no intervals" in plant.time_constant_words(found)
