"""The report page: one file, nothing from elsewhere, scripts by their hash alone, everything escaped."""

from __future__ import annotations

import base64
import json
import re
from hashlib import sha256
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.figure import Figure

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.files import work
from thermogrip.report.charts import Chart, Curve, Panel
from thermogrip.report.html import (
    SETTINGS,
    Commands,
    Picture,
    Plot,
    Section,
    Table,
    Text,
    html_page,
    write_report,
)


def picture(points: int = 3) -> Picture:
    figure = Figure(figsize=(2, 1))
    figure.subplots().scatter(range(points), [k * 7919 % 1000 for k in range(points)])
    return Picture(figure, "a line")


def plot(points: int = 500, curves: int = 1, name: str = "skin") -> Plot:
    x = np.arange(points, dtype=float)
    y = np.where(x == 7, np.nan, np.sin(x / 10))
    own = tuple(Curve(name, x, y + k, low=y + k - 1, high=y + k + 1) for k in range(curves))
    return Plot(Chart(((Panel("T [degC]", own, name),),)), "a curve")


class Tree(HTMLParser):
    """The elements of a page, each closed where it must be."""

    VOID = frozenset({"meta", "img", "br", "wbr"})

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, list[str]] = {}
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.found.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)
            self.texts.setdefault(tag, []).append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open:
            self.texts[self.open[-1]][-1] += data


def whole_page(tmp_path: Path, *more: Any) -> Tree:
    path = tmp_path / "report.html"
    parts = (Text("words"), Commands(("thermogrip demo",)), Table(("n", "who"), ((1.0, "a"),)), picture())
    with work(["thermogrip", "demo", "--out", "x y"]):
        write_report(
            path, "title", "lead", [Section("one", (*parts, *more), "fine", "good"), Section("two", ())]
        )
    return Tree(path.read_text(encoding="utf-8"))


def test_a_page_is_well_formed_and_needs_nothing_from_elsewhere(tmp_path: Path) -> None:
    page = whole_page(tmp_path, plot())
    assert page.open == []
    addresses = [a[key] for _, a in page.found for key in ("src", "href") if key in a]
    assert addresses
    assert all(str(address).startswith(("data:image/", "#")) for address in addresses)
    code = "".join(page.texts["script"] + page.texts["style"])
    assert not re.findall(r"@import|url\(|fetch\(|XMLHttpRequest|WebSocket|importScripts|\.src\b", code)
    assert not any(key.startswith("on") or key == "style" for _, a in page.found for key in a)


@pytest.mark.parametrize("more", [(), (plot(),)], ids=["figures at rest", "charts"])
def test_the_policy_opens_scripts_and_styles_by_the_hashes_of_those_on_the_page(
    tmp_path: Path, more: tuple[Plot, ...]
) -> None:
    page = whole_page(tmp_path, *more)
    (policy,) = [a["content"] for tag, a in page.found if a.get("http-equiv") == "Content-Security-Policy"]
    rules = dict(rule.strip().split(" ", 1) for rule in str(policy).split(";"))
    assert rules["default-src"] == "'none'"
    for tag, rule in (("script", "script-src"), ("style", "style-src")):
        kinds = [a.get("type") for each, a in page.found if each == tag]
        texts = [text for text, kind in zip(page.texts[tag], kinds) if kind != "application/json"]
        hashes = [base64.b64encode(sha256(text.encode()).digest()).decode() for text in texts]
        assert rules[rule] == " ".join(f"'sha256-{digest}'" for digest in hashes)
    assert ("Leon Sorokin" in page.texts["script"][-1]) == bool(more)  # the licence goes where uPlot goes


def test_a_page_begins_with_its_contents_and_ends_with_where_it_comes_from(tmp_path: Path) -> None:
    page = whole_page(tmp_path)
    ids = {a["id"] for _, a in page.found if "id" in a}
    links = [str(a["href"])[1:] for tag, a in page.found if tag == "a"]
    assert links == ["s1", "s2", "provenance"]
    assert set(links) <= ids
    assert page.texts["span"][-5:] == ["thermogrip", "demo", "--out", "'x", "y'"]  # no word is broken
    assert {"thermogrip", "written"} <= set(page.texts["dt"])


def test_two_equal_pages_are_the_same_but_for_their_date() -> None:
    pages = [html_page("t", "l", [Section("s", (picture(), plot()), "v")]) for _ in range(2)]
    first, second = (re.sub(r"\d{4}-\d\d-\d\dT[\d:]{8}Z", "", page) for page in pages)
    assert first == second


def test_a_verdict_has_a_sign_and_a_word_and_so_have_cells_of_verdicts() -> None:
    table = Table(("check", "verdict"), (("fail", "fail"), ("b", "pass"), ("c", "odd")))
    sections = [Section(tone, (table,), "so", tone) for tone in ("plain", "good", "warn", "bad")]
    page = Tree(html_page("t", "l", sections))
    words = [text.strip() for text in page.texts["span"]]
    for said in ("i Result", "\u2713 Good", "! Caution", "\u2715 Bad"):
        assert words.count(said) == 2
    assert words.count("\u2715 fail") == words.count("\u2713 pass") == 4


def numbers(text: str) -> Array:
    return np.frombuffer(base64.b64decode(text), dtype="<f4").astype(float)


def test_the_numbers_of_a_chart_are_those_of_its_curves_and_a_gap_is_no_number() -> None:
    drawn = plot(20)
    content = json.loads(drawn.data(100))
    (curve,) = content["columns"][0][0]["curves"]
    x, y, low = (numbers(content["arrays"][curve[name]]) for name in ("x", "y", "low"))
    own = drawn.chart.columns[0][0].curves[0]
    np.testing.assert_allclose(x, own.x, rtol=1e-6)
    np.testing.assert_allclose(y, own.y, rtol=1e-6, atol=1e-6)
    assert own.low is not None
    np.testing.assert_allclose(low, own.low, rtol=1e-6, atol=1e-6)
    assert np.isnan(y[7])
    assert content["columns"][0][0]["unit"] == " s"


def test_arrays_that_curves_share_are_there_once() -> None:
    x = np.arange(9, dtype=float)
    chart = Chart(((Panel("a", (Curve("a", x, x), Curve("b", x, x), Curve("c", x, x + 1))),),))
    assert len(json.loads(Plot(chart, "").data(100))["arrays"]) == 2


def test_names_in_a_chart_end_no_script_and_hold_no_control_character() -> None:
    page = html_page("t", "l", [Section("s", (plot(name="</script><script>alert(1)//\x1b<!--"),), "v")])
    assert "alert(1)//\\\\x1b" in page
    assert "</script><script>alert" not in page
    assert "\x1b" not in page


def test_a_page_of_many_long_curves_stays_small() -> None:
    parts = tuple(plot(20_000, 6) for _ in range(8))
    page = html_page("t", "l", [Section("s", parts, "v")])
    data = re.findall(r'<script type="application/json">(.*?)</script>', page, re.S)
    assert len(data) == 8
    assert sum(map(len, data)) < 1.1 * SETTINGS.numbers * 16 / 3  # base64 of four bytes
    assert len(page) < 3_000_000


def test_every_text_is_escaped_and_has_no_control_characters() -> None:
    evil = '<img src=x onerror="alert(1)">t\x1b[31m\u202e\x00'
    part = Table((evil,), ((evil,),), evil)
    page = html_page(evil, evil, [Section(evil, (Text(evil), Commands((evil,)), part), evil)])
    assert "<img src=x" not in page
    assert page.count("&lt;img src=x") >= 8
    assert "t\\x1b[31m\\u202e\\x00" in page
    assert not set(page) & set("\x1b\u202e\x00")


def test_a_number_that_is_missing_stands_under_the_others_and_words_do_not() -> None:
    table = Table(("model", "RMSE", "why"), (("arx", 1.0, None), ("neural", None, None)))
    assert [number for _, number in table.heads] == [False, True, False]
    assert table.cells[1] == [("neural", False), ("-", True), ("-", False)]


@pytest.mark.parametrize(
    "name", ["$\\frac{$", "$x$", "\x1b[31m", "a\u202eb", "_$", "%s {x} \\alpha", "$^{2}$"]
)
def test_a_figure_sets_any_name_as_it_stands(name: str) -> None:
    figure = Figure(figsize=(3, 2))
    axes = figure.subplots()
    axes.plot([1, 2], label=f"of {name}")
    axes.set(title=name, xlabel=f"{name} [W s$^{{0.5}}$]", ylabel=name, xscale="log")
    axes.set_yticks([1, 2], [name, name])
    axes.annotate(name, (1, 1))
    axes.legend(title=name)
    figure.suptitle(name)
    for _ in range(2):  # what was made literal stays as it is
        uri = Picture(figure, name).data_uri
        page = base64.b64decode(uri.split(",")[1]).decode()
        ElementTree.fromstring(page)
    assert [text.get_text() for text in axes.get_yticklabels()] == [axes.get_title()] * 2
    assert axes.get_xlabel().endswith(" [W s$^{0.5}$]")


def test_letters_that_the_font_has_not_are_no_warning(tmp_path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure()
    figure.subplots().set_title("木")
    write_report(tmp_path / "r.html", "t", "l", [Section("s", (Picture(figure, "木"),), "v")])
    assert "木" in (tmp_path / "r.html").read_text(encoding="utf-8")
