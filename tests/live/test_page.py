"""The live page in a browser: start, grasp, stop, trip, two viewers, questions, and either end killed."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from tests.end_to_end.conftest import small_plant
from tests.live.conftest import PATIENCE_MS, Running, paced_twin
from thermogrip.live.watch import Show, Watch
from thermogrip.mpc import Controller
from thermogrip.report.console import Console
from thermogrip.rig.simulation.virtual_device import VirtualDevice

Viewer = Callable[..., Any]


def until(page: Any, where: str, words: str) -> None:
    """Wait until a part of the page says this."""
    page.locator(where).filter(has_text=re.compile(words)).wait_for(timeout=PATIENCE_MS)


def test_two_viewers_see_a_session_from_its_start_over_the_grasp_to_its_end(
    watch: Watch, viewer: Viewer
) -> None:
    pages = [viewer(watch.address), viewer(watch.address, viewport={"width": 400, "height": 800})]
    asked: list[str] = []
    pages[0].on("request", lambda request: asked.append(request.url))
    for page in pages:
        until(page, "#word", "starting")
    rig = paced_twin()

    def stop(grasp: Any) -> bool:
        seconds = float(grasp["time"].values[-1])
        watch.posterior(
            seconds, {"copper": 0.5 + 0.1 * seconds, "wood": 0.5 - 0.1 * seconds, "iron": float("nan")}
        )
        rig.pause = 0.03  # the contact is to be seen
        return False

    running = Running(watch, rig, grasp=("copper", 18.0), grasp_time=4.0, stop=stop)
    for page in pages:
        until(page, "#word", "running")
        until(page, "#phase", "contact")
        until(page, "#left", r"^[0-4]\.\d s left$")
        until(page, "#materials", r"copper[5-9]\d %wood[1-4]?\d %iron–")
    session = running.result()
    for page in pages:
        until(page, "#phase", "settled")
        shown = page.locator("#tiles").inner_text()
        for words in ("t_surface", "target of t_surface", "28.0 °C", "± 0.25", "drive", "guard margin"):
            assert words in shown
        assert re.search(r"pump\s+off", shown)
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        # a session is shown at each look, of which a sample has several, and with its verdict at last
        assert page.evaluate("rows.length") > len(session.log["time"])
        # of the size of what was measured: about 28 degC over two minutes
        assert page.evaluate("rows.flat().every((x) => x === null || Math.abs(x) < 1000)")
        assert page.evaluate("$('c-skin').getContext('2d').getImageData(0, 0, 300, 150).data.some((x) => x)")
        page.hover("#c-skin")
        until(page, "#r-skin", r"^\d+\.\d s: target 28\.00, t_surface \d\d\.\d\d °C$")
    assert session.verdict == "settled"
    own = watch.address.split("?")[0]
    assert all(url.startswith(own) for url in asked)
    assert pages[0].url == own  # the token is not left in the address


def test_a_late_viewer_gets_what_was_before_and_the_end_is_said(viewer: Viewer) -> None:
    with Watch("run", Console(), Show(live=0)) as watch:
        running = Running(watch, paced_twin())
        running.result()
        page = viewer(watch.address)
        until(page, "#phase", "settled")
        assert page.evaluate("rows.length") > 50
        watch.ended("settled")
    until(page, "#word", "ended: settled")
    assert page.locator("#stop").is_disabled()


def test_stop_is_a_trip_of_the_guard_and_a_mark_is_an_event(watch: Watch, viewer: Viewer) -> None:
    page, rig = viewer(watch.address), paced_twin()
    running = Running(watch, rig, hold=10_000.0)
    until(page, "#phase", "hold")
    page.fill("#why", "it slipped")
    page.click("text=Mark as bad")
    until(page, "#events", "bad: it slipped")
    page.click("#stop")
    session = running.result()
    assert (session.verdict, session.trip.kind) == ("tripped", "operator")
    assert [event.text for event in session.events if event.kind == "bad"] == ["it slipped"]
    until(page, "#word", "tripped")
    until(page, "#trip", "a stop from the page")
    assert "It is no emergency stop" in page.locator("#actions").inner_text()
    assert rig.read().drive == {"drive": 0.0}


def test_a_trip_shows_its_reason_and_how_to_clear_it(watch: Watch, viewer: Viewer) -> None:
    page, rig = viewer(watch.address, color_scheme="dark"), paced_twin()
    running = Running(watch, rig, hold=10_000.0)
    until(page, "#phase", "hold")
    rig.broken = True
    session = running.result()
    until(page, "#word", "tripped")
    assert page.locator("#icon").inner_text() == "⚠"
    trip = session.trip
    for part in ("expected", "measured", "check", "clear"):
        assert page.locator(f"#trip-{part}").inner_text() == getattr(trip, part)
    assert page.locator("#trip-kind").inner_text() == "lost, t_surface"


def test_a_question_is_answered_on_the_page(watch: Watch, viewer: Viewer, monkeypatch: Any) -> None:
    ends = os.pipe()
    terminal = os.fdopen(ends[0])
    monkeypatch.setattr("sys.stdin", terminal)  # on which nobody types
    answers: list[str] = []

    def work() -> None:
        answers.append(watch.ask("trial 1 of 2: <b>copper</b>", "", (("", "It is ready"), ("q", "Stop"))))
        answers.append(watch.ask("was it good?", "", (("", "Keep it"),), "what was bad"))

    asking = threading.Thread(target=work)
    asking.start()
    page = viewer(watch.address)
    until(page, "#word", "waiting for you")
    until(page, "#question-text", "trial 1 of 2: <b>copper</b>")
    page.click("text=It is ready")
    until(page, "#question-text", "was it good")
    page.fill("#own-text", "it slipped")
    page.click("#own button")
    asking.join(30.0)
    assert answers == ["", "it slipped"]
    page.locator("#question").wait_for(state="hidden")
    os.close(ends[1])
    watch.typing.join()
    terminal.close()


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None: ...


@pytest.fixture
def neighbour() -> Iterator[str]:
    """Return the address of another server on this computer."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=Path(__file__).parent)) as server:
        threading.Thread(target=server.serve_forever).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


def test_another_page_of_this_computer_can_neither_read_nor_stop(
    watch: Watch, viewer: Viewer, neighbour: str
) -> None:
    page = viewer(watch.address)
    until(page, "#word", "starting")
    other = page.context.new_page()  # with the cookie: another port is the same site
    other.goto(neighbour)
    own = watch.address.split("?")[0]
    said = other.evaluate(
        """async (own) => {
            const known = {credentials: "include"}, post = {method: "POST", mode: "no-cors", body: "{}"};
            const asked = [fetch(own + "stop", {...known, ...post}), fetch(own + "events", known)];
            return (await Promise.allSettled(asked)).map((one) => one.status + (one.value?.type ?? ""));
        }""",
        own,
    )
    assert said == ["fulfilledopaque", "rejected"]
    time.sleep(0.3)
    assert watch.operator.stop_asked == ""


def test_where_the_page_is_killed_the_session_goes_on(
    watch: Watch, viewer: Viewer, capsys: pytest.CaptureFixture[str]
) -> None:
    page = viewer(watch.address)
    running = Running(watch, paced_twin(), hold=20.0)
    until(page, "#word", "running")
    assert watch.page is not None
    os.kill(watch.page.pid, signal.SIGKILL)
    until(page, "#word", "this page's server is gone")
    assert "the session does not need the page" in page.locator("#lost").inner_text().lower()
    assert running.result().verdict == "settled"
    assert capsys.readouterr().err.count("the page's process is gone; the session goes on") == 1


def test_where_the_session_is_killed_the_page_says_so_and_the_drive_is_zero(
    tmp_path: Path, viewer: Viewer
) -> None:
    plant = small_plant()
    controller = Controller(plant).save(tmp_path / "controller.json")
    with VirtualDevice(plant, link="socket", t_start=23.0) as device:
        words = [
            sys.executable,
            "-P",
            "-m",
            "thermogrip",
            "run",
            str(controller),
            "--port",
            device.port,
            "--live",
        ]
        words += ["--target", "40", "--out", str(tmp_path / "run")]
        run = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
        assert run.stderr is not None
        address = next(line.split()[1] for line in run.stderr if line.startswith("live: "))
        page = viewer(address)
        until(page, "#word", "running")
        until(page, "#tiles", r"drive\s*(1\.|0\.[1-9])")
        assert device.truth().drive["drive"] > 0.0
        run.kill()
        until(page, "#word", "session lost")
        until(
            page, "#lost-text", "the device switches drive and pump off by itself, at most 2 s".capitalize()
        )
        until(page, "#tiles", r"drive\s*0\s*expired")
        run.wait()
        run.stderr.close()
        end = time.monotonic() + 120.0  # of patience: it ends with the drive
        while device.truth().drive["drive"] and time.monotonic() < end:
            time.sleep(0.05)
        assert device.truth().drive == {"drive": 0.0}
    assert page.evaluate("fetch('/stop', {method: 'POST', body: '{}'}).then((a) => a.status)") == 409
