"""Signals while a session runs, while it switches off, and afterwards."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest

from thermogrip.rig.stopping import hold_signals, stop_signals

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


def switched_off(*numbers: signal.Signals) -> list[str]:
    """Send signals while a block is done that they may not interrupt; return how far it came."""
    done = []
    with stop_signals():
        with hold_signals():
            for number in numbers:
                signal.raise_signal(number)
            done.append("off")
        done.append("not stopped")
    return done


@pytest.mark.parametrize("number", HELD)
def test_a_signal_waits_for_the_end_of_the_block_and_then_acts(number: signal.Signals) -> None:
    done = []

    def end() -> None:
        with stop_signals(), hold_signals():
            signal.raise_signal(number)
            done.append("off")

    with pytest.raises(KeyboardInterrupt):
        end()
    assert done == ["off"]


def test_of_several_signals_the_first_acts() -> None:
    with pytest.raises(KeyboardInterrupt, match="SIGTERM"):
        switched_off(signal.SIGTERM, signal.SIGINT)
    with pytest.raises(KeyboardInterrupt, match=r"^$"):
        switched_off(signal.SIGINT, signal.SIGTERM)
    assert switched_off() == ["off", "not stopped"]


def test_a_block_that_nobody_interrupts_ends_as_it_would() -> None:
    with hold_signals():
        pass
    with pytest.raises(ValueError, match="its own"), hold_signals():
        raise ValueError("its own")


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
    finally:
        signal.signal(number, before)
