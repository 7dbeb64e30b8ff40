"""Pages in a browser: they fit a telephone, show numbers, zoom, print, and ask nobody for anything."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from thermogrip.report.charts import Chart, Curve, Panel
from thermogrip.report.html import Commands, Picture, Plot, Section, Table, Text, write_report

TIME = np.arange(1000, dtype=float)


def panel(title: str, *, log: bool = False) -> Panel:
    wave = 30 + 5 * np.sin(TIME / 100)
    late = Curve("target", TIME[::50], np.full(20, 33.0), "#1d2733", dash="--", step=True)
    odd = Curve("odd", TIME[100:103], np.full(3, 28.0), "#a3262a", dash="")
    skin = Curve("skin", TIME, np.where(TIME == 500, np.nan, wave), low=wave - 1, high=wave + 1)
    return Panel("T [degC]", (skin, late, odd), title, 2.0, log, ((100.0, 200.0),), (300.0,))


@pytest.fixture(scope="module")
def page_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a page with one of each part, as wide as they come."""
    columns = tuple((panel(f"log {k}"), Panel("drive", (Curve("u", TIME, np.cos(TIME)),))) for k in range(3))
    wide = Figure(figsize=(14, 3))
    wide.subplots().plot([1, 2])
    head = tuple(f"column {k}" for k in range(14))
    words = "a sentence that says at length what was found, and what one may do about it"
    parts = (
        Text("one_name_without_any_space_" * 12),
        Commands(("thermogrip identify LOG... --network gripper --posterior --out plant.json " * 2,)),
        Table(head, tuple(tuple(f"{k + j}.1234" for k in range(14)) for j in range(3)), words, dense=True),
        Table(("verdict", "finding", "fix"), (("warn", words, words), ("pass", words, ""))),
        Plot(Chart(columns), "Three logs."), Plot(Chart(((panel("alone", log=True),),), log=False), "One."),
        Picture(wide, "A wide figure."),
    )  # fmt: skip
    path = tmp_path_factory.mktemp("page") / "report.html"
    write_report(path, "A page", words, [Section("First?", parts, words, "warn"), Section("Second?", ())])
    return path


@pytest.fixture
def opened(chromium: Any, page_file: Path) -> Iterator[Any]:
    """Return what opens the page: any complaint of the browser, and any request but for the page, fails."""
    contexts, faults = [], []

    def open_page(width: int = 1200, *, folded: bool = False, **options: Any) -> Any:
        context = chromium.new_context(viewport={"width": width, "height": 900}, **options)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: faults.append(message.text))
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("request", lambda r: None if r.url.startswith(("file:", "data:")) else faults.append(r.url))
        page.goto(page_file.as_uri())
        if not folded:
            page.locator("summary").click()
        if not folded and options.get("java_script_enabled", True):
            page.locator("canvas").nth(6).wait_for()
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert faults == []


WIDER = """() => [...document.querySelectorAll("figure, figure img, canvas, .legend, p, h2, pre, nav li")]
    .filter(e => e.getBoundingClientRect().right > document.documentElement.clientWidth + 0.5).length"""
OVERFLOW = "document.documentElement.scrollWidth - document.documentElement.clientWidth"


@pytest.mark.parametrize("width", [400, 1200])
def test_nothing_but_a_table_that_scrolls_is_wider_than_the_window(opened: Any, width: int) -> None:
    page = opened(width)
    assert page.evaluate(OVERFLOW) == 0
    assert page.evaluate(WIDER) == 0
    assert page.locator("canvas").count() == 7
    boxes = page.locator(".scroll").all()
    assert all(box.bounding_box()["width"] <= width for box in boxes)
    assert page.evaluate('getComputedStyle(document.querySelector(".scroll")).overflowX') == "auto"


def test_a_chart_shows_the_numbers_under_the_pointer_and_zooms_all_its_panels(opened: Any) -> None:
    page = opened()
    room = page.locator("figure.chart").first
    plots = room.locator(".u-over")
    plots.first.scroll_into_view_if_needed()
    box = plots.first.bounding_box()
    plots_of = "document.querySelector('figure.chart').plots"
    shows = f"{plots_of}.map(plot => [plot.scales.x.min, plot.scales.x.max])"
    whole = page.evaluate(shows)
    assert len(whole) == 6
    at = box["x"] + 0.25 * box["width"]
    page.mouse.move(at, box["y"] + 20)
    assert plots.first.bounding_box() == box  # what is shown moves nothing
    legend = room.locator(".legend").first
    seconds = float(legend.locator(".at").inner_text().removesuffix(" s"))
    low, high = whole[0]
    assert seconds == pytest.approx(low + 0.25 * (high - low), abs=3.0)
    words = legend.locator("output").all_inner_texts()
    wave = 30 + 5 * np.sin(seconds / 100)
    value, ends = words[0].rstrip(")").split(" (")
    assert float(value) == pytest.approx(wave, abs=0.02)
    assert [float(end) for end in ends.split(" to ")] == pytest.approx([wave - 1, wave + 1], abs=0.02)
    assert words[1] == "33"
    page.mouse.down()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 20, steps=4)
    page.mouse.up()
    zoomed = page.evaluate(shows)
    assert all(b - a == pytest.approx((high - low) / 4, rel=0.05) for a, b in zoomed)
    room.get_by_text("Whole range").click()
    assert page.evaluate(shows) == whole


def test_a_name_in_the_legend_hides_its_curve(opened: Any) -> None:
    page = opened()
    button = page.locator("figure.chart").nth(1).get_by_role("button", name="skin")
    shown = "document.querySelectorAll('figure.chart')[1].plots[0].series.map(s => s.show)"
    assert page.evaluate(shown).count(False) == 0
    button.click()
    assert button.get_attribute("aria-pressed") == "false"
    assert page.evaluate(shown).count(False) == 3  # the curve and the ends of its band
    button.click()
    assert page.evaluate(shown).count(False) == 0


def test_details_are_drawn_when_they_are_opened_and_printed_where_they_are_open(opened: Any) -> None:
    page = opened(folded=True)
    assert page.locator("section p").filter(visible=True).count() == 2  # the answer, and the first part
    assert page.locator("canvas").count() == 0
    page.emulate_media(media="print")
    assert not page.locator("summary").is_visible()
    page.emulate_media(media="screen")
    page.locator("summary").click()
    page.locator("canvas").nth(6).wait_for()
    widths = "[...document.querySelectorAll('figure.chart')].flatMap(f => f.plots.map(p => p.width))"
    assert min(page.evaluate(widths)) > 300
    page.locator("summary").click()
    page.locator("summary").click()
    assert page.locator("canvas").count() == 7  # and not once more


def visible(page: Any) -> tuple[bool, bool]:
    return page.locator(".still").first.is_visible(), page.locator("canvas").first.is_visible()


def test_paper_and_readers_without_scripts_have_the_figure_at_rest(opened: Any) -> None:
    page = opened()
    assert visible(page) == (False, True)
    page.emulate_media(media="print")
    assert visible(page) == (True, False)
    plain = opened(java_script_enabled=False)
    assert plain.locator(".still").first.is_visible()
    assert plain.locator("canvas").count() == 0
    assert plain.locator("button").filter(visible=True).count() == 0


def test_paper_clips_no_column(opened: Any) -> None:
    page = opened(700)  # as wide as A4 between its margins
    page.emulate_media(media="print")
    clipped = "[...document.querySelectorAll('table')].map(t => t.getBoundingClientRect().right - innerWidth)"
    assert max(page.evaluate(clipped)) <= 0


def contrast(page: Any, what: str) -> float:
    """Return the contrast of a text to the paper under it, as WCAG 2.2 defines it."""
    colours = page.locator(what).first.evaluate(
        """e => { const ground = of => getComputedStyle(of).backgroundColor;
            let under = e;
            while (ground(under) === "rgba(0, 0, 0, 0)") under = under.parentElement;
            return [getComputedStyle(e).color, ground(under)]; }"""
    )
    light = []
    for colour in colours:
        part = np.array([int(c) for c in colour[4:-1].split(",")]) / 255
        linear = np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)
        light.append(float(linear @ [0.2126, 0.7152, 0.0722]))
    return (max(light) + 0.05) / (min(light) + 0.05)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_text_can_be_read_by_day_and_by_night(opened: Any, scheme: str) -> None:
    page = opened(color_scheme=scheme)
    for what in (
        "h1",
        ".lead",
        ".verdict",
        ".status.warn",
        ".status.good",
        "td",
        ".caption",
        "figcaption",
        "pre",
    ):
        assert contrast(page, what) > 4.5, what
    ground = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (int(ground[4:].split(",")[0]) < 60) == (scheme == "dark")
    turned = page.locator(".uplot").first.evaluate("e => getComputedStyle(e).filter")
    assert (turned != "none") == (scheme == "dark")
