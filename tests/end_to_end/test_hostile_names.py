"""Names that a terminal, a spreadsheet or a page would obey are shown as text."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from tests.end_to_end.conftest import HEADER, Bench, small_grasps, small_log_rows, small_plant
from thermogrip.report.console import Console

ESC = "t\x1b[31m_x"


def spoilt_log(bench: Bench, name: str) -> Path:
    rows = small_log_rows(120)
    return bench.write("spoilt.csv", "\n".join([HEADER.replace("t_ambient", name), *rows]) + "\n")


def test_an_escape_sequence_in_a_column_reaches_no_terminal(bench: Bench) -> None:
    plant = small_plant().save(bench.path / "p.json")
    log = spoilt_log(bench, ESC)
    for words in (["validate", plant, log], ["validate", plant, log, "--json"], ["validate", ESC, log]):
        done = bench.run(*words)
        assert done.code == 2
        assert "\x1b" not in done.out + done.err
        assert "\\x1b" in done.err


def test_what_the_console_shows_is_text(capsys: pytest.CaptureFixture[str]) -> None:
    console = Console()
    console.say(f"a {ESC}")
    console.warn(f"b {ESC}")
    console.table(f"c {ESC} [red]", [f"d {ESC} [bold]", ":warning:"], [[f"e {ESC} [/]", 1.0]])
    with console.progress(f"f {ESC}") as progress:
        progress(0.5, f"g {ESC}")
    out, err = capsys.readouterr()
    assert "\x1b" not in out + err
    for letter, text in zip("abcdefg", (out, err, out, out, out, err, err)):
        assert f"{letter} t\\x1b[31m_x" in text
    for markup in ("[red]", "[bold]", "[/]", ":warning:"):
        assert markup in out


def test_a_formula_in_a_label_is_text_in_every_table(bench: Bench) -> None:
    samples, meta = small_grasps()
    for name in ("g000", "copper"):
        samples, meta = samples.replace(name, f"=1+{name}"), meta.replace(name, f"=1+{name}")
    bench.write("g.csv", samples)
    bench.write("g_meta.csv", meta)
    done = bench.run("train", bench.path / "g.csv", "--classifier", "bayes", "--out", bench.path / "m")
    assert done.code == 0, done.err
    model = json.loads((bench.path / "m" / "classifier.json").read_text())
    assert model["classes"] == ["=1+copper", "wood"]
    done = bench.run("classify", bench.path / "m", bench.path / "g.csv", "--out", bench.path / "p.csv")
    assert done.code == 0, done.err
    rows = list(csv.reader((bench.path / "p.csv").read_text().splitlines()))
    assert rows[1][:2] == ["'=1+g000", "'=1+copper"]
    assert not [cell for row in rows for cell in row if cell.startswith("=")]
