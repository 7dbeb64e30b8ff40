"""Signals while a session runs, while it switches off, and afterwards."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from tests.rig.makers import Constant
from thermogrip.mpc.interface import Move, Readings, Target
from thermogrip.rig.records.run_folder import RunFolder, recover, sums_agree
from thermogrip.rig.session.session import run_session
from thermogrip.rig.session.signals import hold_signals, stop_signals
from thermogrip.rig.simulation.twin import Twin
from thermogrip.sysid.plant.plant import Plant

STOPS = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
HELD = [signal.SIGINT, *STOPS]


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """What Python does by itself, also where the tests run in the background; afterwards all as before."""
    usual = dict.fromkeys(STOPS, signal.SIG_DFL) | {signal.SIGINT: signal.default_int_handler}
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    after = {number: signal.getsignal(number) for number in HELD}
    for number, handler in before.items():
        signal.signal(number, handler)
    assert after == usual


@pytest.mark.parametrize("second", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("first", HELD)
def test_signals_wait_for_the_end_of_the_block_and_then_the_first_acts(
    first: signal.Signals, second: signal.Signals
) -> None:
    done = []

    @stop_signals()
    def end() -> None:
        with hold_signals():
            signal.raise_signal(first)
            signal.raise_signal(second)
            done.append("off")
        done.append("not stopped")

    with pytest.raises(KeyboardInterrupt, match=first.name):
        end()
    assert done == ["off"]


def test_a_block_that_nobody_interrupts_ends_as_it_would() -> None:
    with stop_signals(), hold_signals():
        pass
    with pytest.raises(ValueError, match="its own"), hold_signals():
        raise ValueError("its own")


def test_a_session_that_lost_its_interrupt_in_a_callback_ends_at_the_next_sample(plant: Plant) -> None:
    class Loses(Constant):
        """A controller whose library drops an exception that a signal raised, as C code does."""

        moves = 0

        def step(self, reading: Readings, target: Target) -> Move:
            self.moves += 1
            with suppress(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
            return super().step(reading, target)

    loses, twin = Loses(0.1), Twin(plant, seed=1)
    with pytest.raises(KeyboardInterrupt, match="SIGINT"):
        run_session(twin, loses, 38.0)
    assert loses.moves == 1
    assert not any(twin.read().drive.values())


def test_what_a_signal_did_before_it_does_again_afterwards() -> None:
    heard: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, frame: heard.append(number))
    try:
        with pytest.raises(KeyboardInterrupt, match="SIGTERM"), stop_signals():
            signal.raise_signal(signal.SIGTERM)
        with hold_signals():
            signal.raise_signal(signal.SIGTERM)
            assert heard == []
        assert heard == [signal.SIGTERM]
    finally:
        signal.signal(signal.SIGTERM, before)


@pytest.mark.parametrize("number", STOPS)
def test_what_is_ignored_stays_ignored(number: signal.Signals) -> None:
    before = signal.signal(number, signal.SIG_IGN)
    try:
        with stop_signals():
            signal.raise_signal(number)
            assert signal.getsignal(number) is signal.SIG_IGN
    finally:
        signal.signal(number, before)


TRACED = ("run_folder.py", "signals.py", "contextlib.py", "files.py")


def at_line(n: int, act: Callable[[], None]) -> Callable[..., Any]:
    """Return a trace function that acts once, before the n-th line of how a run ends."""
    left = [n]

    def trace(frame: FrameType, event: str, argument: Any) -> Any:
        if Path(frame.f_code.co_filename).name not in TRACED:
            return None
        if event == "line":
            left[0] -= 1
            if left[0] == 0:
                act()
        return trace

    return trace


def ctrl_c() -> None:
    signal.raise_signal(signal.SIGINT)


@pytest.mark.skipif(sys.platform == "win32", reason="signals are POSIX here")
def test_wherever_a_second_ctrl_c_comes_the_run_is_closed_as_with_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    came: list[int] = []
    monkeypatch.setattr(os, "fsync", lambda file: None)  # the disk takes the time here

    def interrupted(path: Path, n: int) -> None:
        """Interrupt a run, and once more n lines later."""
        with stop_signals(), RunFolder(path) as folder:
            folder.sample({"time_s": 0.0, "t_surface_degC": 20.0})
            sys.settrace(at_line(n, lambda: (came.append(n), ctrl_c())))
            try:
                ctrl_c()
            finally:
                sys._getframe().f_trace = None

    usual, n = sys.gettrace(), 1
    try:
        while not came or came[-1] == n:
            n += 5  # every fifth line: each costs a run folder
            with pytest.raises(KeyboardInterrupt):
                interrupted(tmp_path / str(n), n)
            sys.settrace(usual)
            assert sums_agree(tmp_path / str(n)) == [], n
            assert json.loads((tmp_path / str(n) / "run.json").read_text())["verdict"] == "interrupted"
            assert not recover(tmp_path / str(n)).changed
    finally:
        sys.settrace(usual)
    assert n > 60
