"""A browser without a window, and sessions on a twin that takes its time, shown on a live page."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tests.end_to_end.conftest import small_plant
from thermogrip.live.watch import Show, Watch
from thermogrip.mpc import PIController
from thermogrip.report.console import Console
from thermogrip.rig.session.session import Session, run_session
from thermogrip.rig.simulation.twin import Twin
from thermogrip.sysid.contact.simulation import Grip

PATIENCE_MS = 30_000  # of a loaded machine


class PacedTwin(Twin):
    """A twin whose every wait takes ``pause`` real seconds, and whose skin may be broken."""

    pause, broken = 0.01, False

    def wait(self, seconds: float) -> None:
        time.sleep(self.pause)
        super().wait(seconds)

    def _sensor(self, name: str, true: float) -> float:
        return float("nan") if self.broken and name == self.skin else super()._sensor(name, true)


def paced_twin(seed: int = 1) -> PacedTwin:
    """Return one of the small plant, at 23 degC."""
    return PacedTwin(small_plant(), seed=seed, contact=Grip(), t_start=23.0)


class Running:
    """A session in a thread, to 28 degC, shown by a watch."""

    def __init__(self, watch: Watch, rig: PacedTwin, **options: Any) -> None:
        self.session: Session | None = None

        def work() -> None:
            shown = {"progress": watch.progress, "listener": watch.listen, "operator": watch.operator}
            self.session = run_session(rig, PIController(rig.plant), 28.0, **shown, **options)

        self.thread = threading.Thread(target=work)
        self.thread.start()

    def result(self) -> Session:
        """Wait for the end."""
        self.thread.join(60.0)
        assert self.session is not None
        return self.session


@pytest.fixture
def viewer(chromium: Any) -> Iterator[Callable[..., Any]]:
    """Return what opens an address as somebody who was never there; pages that complain fail the test."""
    contexts, complaints = [], []

    def open_page(address: str, **options: Any) -> Any:
        contexts.append(chromium.new_context(**options))
        page = contexts[-1].new_page()
        page.set_default_timeout(PATIENCE_MS)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("console", lambda said: complaints.append(said.text) if "Security" in said.text else None)
        page.goto(address)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert complaints == []


@pytest.fixture
def watch() -> Iterator[Watch]:
    with Watch("run", Console(), Show(live=0)) as made:
        yield made
