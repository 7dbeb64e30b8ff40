"""A run folder on a loaded machine: a row waits as long as it takes for its thread."""

from __future__ import annotations

import pytest

from tests.rig.makers import PATIENCE_S
from thermogrip.rig.records import run_folder


@pytest.fixture(autouse=True)
def _patient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_folder, "_AT_ONCE_S", PATIENCE_S)
