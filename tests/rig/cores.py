"""Scripts of lines for the device's core, and what its reference in Python says to them."""

from __future__ import annotations

from thermogrip.rig.firmware.reference import Board, DeviceCore, Sensor, Value
from thermogrip.rig.serial.protocol import Channel, encode_line

GRIPPER = Board(
    sensors=(
        Sensor("t_tank", 2_000, 60_000),
        Sensor("t_surface", 3_000, 55_000),
        Sensor("t_ambient", guarded=False),
    )
)
LAB = Board(
    drives=(Channel("q1", "percent", 0, 1_000_000), Channel("q2", "percent", 0, 1_000_000)),
    sensors=(Sensor("t1", 2_000, 80_000), Sensor("t2", 2_000, 80_000)),
    pump=False,
    tachometer=False,
)
BOARDS = {"gripper": GRIPPER, "lab": LAB}


def reference(script: list[str]) -> str:
    """Return what the core in Python says to the same script."""
    board, core, out = GRIPPER, DeviceCore(), b""
    for line in script:
        word, *rest = line.split()
        if word == "board":
            board = BOARDS[rest[0]]
        elif word == "begin":
            core = DeviceCore(board, rest[0], int(rest[1]), int(rest[2]), serial=12345678)
            out += core.announcement()
        elif word == "bytes":
            out += core.receive(bytes.fromhex(rest[0]), int(rest[1]))
        elif word == "sample":
            values: list[Value] = [text if text.isalpha() else int(text) for text in rest[2:]]
            core.sample(values, flow=rest[0] == "1", now_ms=int(rest[1]))
        elif word == "pins":
            pins = core.outputs
            numbers = [pins.enable, *pins.drive, pins.pump, pins.grip]
            out += ("pins " + " ".join(map(str, numbers)) + "\n").encode()
    return out.decode()


def say(seq: int, *words: str, now: int) -> str:
    return f"bytes {encode_line(seq, *words).hex()} {now}"


WARM = "1 {now} 25000 25000 25000"
START = ["board gripper", "begin power 7 0", "sample " + WARM.format(now=0), say(1, "hello", now=5)]


def last_state(text: str) -> list[str]:
    """Return the words of the last state in what a core said."""
    lines = [line for line in text.splitlines() if " ok " in line]
    return lines[-1].split("*")[0].split(" ")[2:]


REFUSED = (
    "drive 2000 1 0", "hello", "drive 2000 0 1", "drive 2001 1 1", "drive 0 1 1", "drive 9 1 10001",
    "drive 9 1 1,1", "drive 9 1 -0", "drive 9", "fire", "grip 2", "grip 1", "read x", "drive 2000 0 0",
)  # fmt: skip

SCRIPTS = {
    "a drive expires": [
        *START,
        say(2, "drive", "2000", "1", "-2500", now=10),
        "pins",
        "sample " + WARM.format(now=2009),
        "pins",
        "sample " + WARM.format(now=2010),
        "pins",
        say(3, "read", now=2020),
    ],
    "a repeated question does nothing twice": [
        *START,
        say(2, "drive", "500", "1", "100", now=10),
        say(2, "drive", "500", "1", "100", now=400),
        "sample " + WARM.format(now=520),
        "pins",
    ],
    "an open sensor latches at the fourth sample": [
        *START,
        say(2, "drive", "2000", "1", "5000", now=10),
        *[f"sample 1 {100 * k} open 25000 25000" for k in range(1, 4)],
        "pins",
        "sample 1 400 open 25000 25000",
        "pins",
        say(3, "drive", "2000", "1", "5000", now=410),
        say(4, "clear", now=420),
        "sample " + WARM.format(now=500),
        say(5, "clear", now=510),
        say(6, "drive", "2000", "1", "5000", now=520),
        "pins",
    ],
    "too warm and too cold latch": [
        *START,
        *[f"sample 1 {100 * k} 60001 2999 99000" for k in range(1, 5)],
        say(3, "read", now=410),
        say(4, "off", now=420),
        "pins",
    ],
    "a pump that has stopped latches": [
        *START,
        say(2, "drive", "2000", "1", "5000", now=10),
        "sample 0 100 25000 25000 25000",
        say(3, "drive", "2000", "1", "5000", now=1900),
        "sample 0 3009 25000 25000 25000",
        "pins",
        "sample 0 3010 25000 25000 25000",
        "pins",
        say(4, "read", now=3020),
        say(5, "clear", now=3030),
        say(6, "drive", "2000", "1", "5000", now=3040),
        "sample 0 3050 25000 25000 25000",
        "pins",
        say(7, "drive", "2000", "1", "5000", now=5000),
        "sample 0 6040 25000 25000 25000",
        "pins",
    ],
    "what is refused": [
        "begin watchdog 65535 0",
        *[say(n, *words.split(" "), now=n) for n, words in enumerate(REFUSED, start=1)],
        "pins",
    ],
    "damage, echoes and empty lines": [
        *START,
        "bytes 0a0a 10",
        "bytes 3720726561642a304543383131 11",
        "bytes ff0a 12",
        say(9, "ok", "off", now=13),
        say(0, "boot", "x", now=14),
        "bytes " + "41" * 400 + "0a 15",
        say(10, "read", now=16),
    ],
    "the clock wraps after 49 days": [
        "begin power 1 4294967000",
        "sample 1 4294967000 25000 25000 25000",
        say(1, "hello", now=4294967001),
        say(2, "drive", "1000", "1", "7", now=4294967290),
        "sample 1 990 25000 25000 25000",
        "pins",
        "sample 1 994 25000 25000 25000",
        "pins",
        say(3, "read", now=1000),
    ],
    "two drives and no pump": [
        "board lab",
        "begin power 1 0",
        "sample 0 0 25000 25000",
        say(1, "hello", now=1),
        say(2, "drive", "2000", "0", "500000,1000000", now=2),
        "pins",
        "sample 0 5000 25000 25000",
        "pins",
    ],
}
