"""Open a rig on a port: recognise the device and return the driver for it.

Our firmware answers a line of its own protocol, a TCLab answers ``VER``.  Neither question moves anything: to
our firmware ``VER`` is a damaged line, to a TCLab ours is an unknown word, which switches its heaters off.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from thermogrip.rig.drivers.tclab import TCLabRig
from thermogrip.rig.drivers.thermogrip import DeviceRig
from thermogrip.rig.serial.port import Port, PortError
from thermogrip.rig.serial.protocol import Answer, Boot, Hello, HostEnd, Refused

_ROUND_S = 0.5


def recognise(port: Port, *, seconds: float = 6.0) -> str:
    """Return the protocol behind an open port, ``thermogrip`` or ``tclab``, or raise PortError; an Arduino
    starts anew when its port is opened, so it has ``seconds`` (real ones) to answer."""
    host, heard_all = HostEnd(), b""
    for _ in range(max(1, round(seconds / (2 * _ROUND_S)))):
        for question in (b"\n" + host.ask(Hello()), b"\r\nVER\r\n"):
            heard = _hear(port, question)
            heard_all += heard
            if any(isinstance(event, Answer | Boot | Refused) for event in host.hear(heard)):
                return "thermogrip"
            if b"TCLab Firmware" in heard:
                return "tclab"
    answer = "nothing" if not heard_all else f"only {heard_all[-60:]!r}"
    hint = "check power and firmware, or name the language with --protocol"
    raise PortError(f"says {answer}", file=port.url, hint=hint)


def open_rig(
    url: str | Port,
    protocol: str | None = None,
    *,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> DeviceRig | TCLabRig:
    """Return the rig behind a port.

    Parameters
    ----------
    url : str or Port
        ``/dev/ttyACM0``, ``COM3``, ``socket://127.0.0.1:5000``.
    protocol : {"thermogrip", "tclab"}, optional
        Found out where absent.
    clock, sleep : callable, optional
        The rig's clock and how it waits [s].

    Raises
    ------
    PortError
        If the port cannot be opened or nobody known is there.

    Examples
    --------
    >>> from thermogrip.rig.simulation.virtual_device import VirtualDevice
    >>> with VirtualDevice(protocol="tclab", link="socket") as device:
    ...     rig = open_rig(device.port)
    ...     rig.units
    ...     rig.close()
    {'q1': 'percent', 'q2': 'percent'}
    """
    port: Port = Port(url, clock=clock) if isinstance(url, str) else url
    port.open()
    try:
        spoken = recognise(port) if protocol is None else protocol
        kind = TCLabRig if spoken == "tclab" else DeviceRig
        return kind(port, clock=clock, sleep=sleep)
    except BaseException:
        port.close()
        raise


def _hear(port: Port, question: bytes) -> bytes:
    """Return what comes within a round, up to its first pause after a whole line."""
    port.drop_input()
    port.write(question)
    heard, end = b"", time.monotonic() + _ROUND_S
    while (remaining_s := end - time.monotonic()) > 0:
        piece = port.read(remaining_s)
        heard += piece
        if not piece or heard.endswith(b"\n"):
            break
    return heard
