"""Every way out ends with power off: what a signal does to a session, and what it may not interrupt.

Python turns Ctrl-C into an exception, so that ``finally`` switches off.  A ``kill`` (SIGTERM) and a closed
terminal (SIGHUP; on Windows SIGBREAK) end the process at once instead: :func:`stop_signals` makes them that
same exception, and one of all that come.

``kill -9``, a crash of the interpreter and a frozen computer run no line of ours.  Then the device's own 2 s
switch off, or nothing does (a TCLab has no such time).
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

_STOP_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGTERM", "SIGHUP", "SIGBREAK") if hasattr(signal, name)
)
_HOLD = (signal.SIGINT, *_STOP_SIGNALS)


class _Stop:
    """A handler that raises at the first signal, and at no other."""

    def __init__(self) -> None:
        self.came = ""

    def __call__(self, number: int, frame: FrameType | None) -> None:
        # a second Ctrl-C, 10 ms or 10 s after the first, must not end what the first one began, which is to
        # switch off and to close the run folder
        if not self.came:
            self.came = signal.Signals(number).name
            raise KeyboardInterrupt(self.came)


@contextmanager
def stop_signals() -> Iterator[None]:
    """Make the first SIGINT, SIGTERM or SIGHUP a KeyboardInterrupt inside, and ignore those that follow it.

    A signal that is ignored stays so: under ``nohup`` a night's batch goes on when its terminal is closed.
    """
    if _in_force() is not None:
        yield
        return
    ours = [number for number in _STOP_SIGNALS if signal.getsignal(number) != signal.SIG_IGN]
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        ours.append(signal.SIGINT)
    with _handlers(dict.fromkeys(ours, _Stop())):
        yield


def check_stopped() -> None:
    """Raise the KeyboardInterrupt again that a signal of this :func:`stop_signals` raised, if one did."""
    # an exception can get lost (in a callback of C code), and no later signal raises another
    stop = _in_force()
    if stop is not None and stop.came and threading.current_thread() is threading.main_thread():
        raise KeyboardInterrupt(stop.came)


def _in_force() -> _Stop | None:
    """Return the handler of the :func:`stop_signals` around this, None outside of one."""
    return next((now for now in map(signal.getsignal, _HOLD) if isinstance(now, _Stop)), None)


@contextmanager
def hold_signals() -> Iterator[None]:
    """Keep SIGINT, SIGTERM and SIGHUP until the block is done, then let the first of them act."""
    came: list[int] = []
    with _handlers(dict.fromkeys(_HOLD, lambda number, frame: came.append(number))):
        yield
    if came:
        signal.raise_signal(came[0])


@contextmanager
def _handlers(wanted: dict[Any, Any]) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in wanted}
    try:
        for number, handler in wanted.items():
            signal.signal(number, handler)
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)
