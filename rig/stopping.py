"""Every way out ends with power off: what a signal does to a session, and what it may not interrupt.

Python turns Ctrl-C into an exception, so that ``finally`` switches off.  A ``kill`` (SIGTERM) and a closed
terminal (SIGHUP; on Windows SIGBREAK) end the process at once instead: :func:`stop_signals` makes them that
same exception.  And a second Ctrl-C must not interrupt the switching off: :func:`hold_signals` keeps signals
until it is done.

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

__all__ = ["hold_signals", "stop_signals"]

_STOP = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP", "SIGBREAK") if hasattr(signal, name))
_HOLD = (signal.SIGINT, *_STOP)


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt(signal.Signals(number).name)


@contextmanager
def stop_signals() -> Iterator[None]:
    """Make SIGTERM and SIGHUP a KeyboardInterrupt inside; elsewhere than in the main thread do nothing.

    One that is ignored stays so: under ``nohup`` a night's batch goes on when its terminal is closed.

    Examples
    --------
    >>> try:
    ...     with stop_signals():
    ...         signal.raise_signal(signal.SIGTERM)
    ... except KeyboardInterrupt as stopped:
    ...     print(stopped)
    SIGTERM
    """
    ours = [number for number in _STOP if signal.getsignal(number) != signal.SIG_IGN]
    with _handlers(dict.fromkeys(ours, _interrupt)):
        yield


@contextmanager
def hold_signals() -> Iterator[None]:
    """Keep SIGINT, SIGTERM and SIGHUP until the block is done, then let the first of them act.

    Examples
    --------
    >>> usual = signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job ignores it
    >>> try:
    ...     with hold_signals():
    ...         signal.raise_signal(signal.SIGINT)
    ...         print("switched off")
    ... except KeyboardInterrupt:
    ...     print("then stopped")
    switched off
    then stopped
    >>> _ = signal.signal(signal.SIGINT, usual)
    """
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
