"""Build the firmware for real boards and try the very program on a simulated chip, with our own driver.

    apt-get install gcc-avr avr-libc binutils-avr arduino-core-avr simavr libsimavr-dev
    python benchmarks/rig/board.py

The sketch is compiled with avr-g++ against Arduino's core, ours with every warning an error (an int has 16
bits there, so ``-Wconversion`` finds what a PC does not), for an Uno (ATmega328P) and a Mega (ATmega2560).
``board_sim.c`` runs the result under simavr at 16 MHz, its serial line on a pseudo-terminal at 115200 baud,
where :class:`~thermogrip.rig.drivers.thermogrip.DeviceRig` finds it.  Each check prints what was measured on
the chip's own clock; the exit status is 0 if all hold and 77 if a tool is missing.
"""

from __future__ import annotations

import argparse
import math
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from thermogrip.rig.drivers.thermogrip import DeviceRefusedError, DeviceRig
from thermogrip.rig.serial.port import Port
from thermogrip.rig.serial.protocol import LineParser

ARDUINO = Path("/usr/share/arduino/hardware/arduino/avr")
TOOLS = ("avr-g++", "avr-gcc", "avr-size", "avr-nm", "gcc")
MISSING = 77
COMMON = ("-c", "-g", "-Os", "-ffunction-sections", "-fdata-sections", "-DF_CPU=16000000L", "-DARDUINO=10819")
CXX = ("-std=gnu++11", "-fno-exceptions", "-fno-threadsafe-statics")
OURS = ("-Wall", "-Wextra", "-Werror")


@dataclass(frozen=True)
class Board:
    """A board: its chip, Arduino's name for its pins, and what it has [bytes]."""

    name: str
    chip: str
    variant: str
    flash: int
    ram: int


BOARDS = (
    Board("Uno", "atmega328p", "standard", 32256, 2048),
    Board("Mega", "atmega2560", "mega", 253952, 8192),
)


class Check:
    """Count what holds and print it."""

    def __init__(self) -> None:
        self.failed = 0

    def __call__(self, holds: bool, what: str) -> None:
        self.failed += not holds
        print(f"  {'ok  ' if holds else 'FAIL'} {what}", flush=True)


def missing() -> str:
    """Return what is not installed, nothing where all is."""
    tools = [tool for tool in TOOLS if shutil.which(tool) is None]
    paths = [str(path) for path in (ARDUINO, Path("/usr/include/simavr/sim_avr.h")) if not path.exists()]
    return ", ".join(tools + paths)


def run(*words: str | Path) -> str:
    """Run a program and return its output; a failure ends everything with its own words."""
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{words[0]} failed:\n{done.stderr}")
    return done.stdout


def build(board: Board, out: Path) -> Path:
    """Compile and link the sketch for a board and return the ELF."""
    sketch, core = Path(str(files("thermogrip.rig"))) / "firmware", ARDUINO / "cores" / "arduino"
    include = [core, ARDUINO / "variants" / board.variant, ARDUINO / "libraries" / "EEPROM" / "src", sketch]
    chip = [f"-mmcu={board.chip}", *(f"-I{path}" for path in include)]
    objects = []

    def compile_one(source: Path, *flags: str) -> None:
        plain = source.suffix == ".c"
        objects.append(out / f"{source.name}.o")
        compiler, language = ("avr-gcc", ("-std=gnu11",)) if plain else ("avr-g++", CXX)
        run(compiler, *COMMON, *language, *chip, *flags, source, "-o", objects[-1])

    for source in sorted([*core.glob("*.c"), *core.glob("*.cpp")]):
        compile_one(source, "-w", "-DDECIMAL_DIG=__DECIMAL_DIG__")  # which this compiler's float.h leaves out
    for source in sorted(sketch.glob("*.cpp")):
        compile_one(source, *OURS, "-Wconversion")
    compile_one(sketch / "firmware.ino", *OURS, "-include", "Arduino.h", "-xc++")
    elf = out / f"{board.name}.elf"
    run("avr-gcc", "-Os", "-Wl,--gc-sections", f"-mmcu={board.chip}", "-o", elf, *objects, "-lm")
    return elf


def sizes(elf: Path) -> tuple[int, int]:
    """Return flash and static RAM of a program [bytes]."""
    sections = {}
    for line in run("avr-size", "-A", elf).splitlines():
        words = line.split()
        if len(words) == 3 and words[0].startswith("."):
            sections[words[0]] = int(words[1])
    flash = sections[".text"] + sections[".data"]
    return flash, sum(sections.get(name, 0) for name in (".data", ".bss", ".noinit"))


@dataclass(frozen=True)
class Status:
    """What a simulated chip reports of itself."""

    ms: float
    enable: int
    heat: int
    cool: int
    pump: int
    grip: int
    stack: int
    answer_us: float
    turn_us: float
    lines: int
    boots: int

    @property
    def pins(self) -> tuple[int, int, int, int]:
        """Supply, widths of both sides, pump."""
        return (self.enable, self.heat, self.cool, self.pump)


OFF = (0, 0, 0, 0)


class Chip:
    """A running simulation."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        assert process.stdin is not None
        assert process.stdout is not None
        self._to, self._from = process.stdin, process.stdout
        self.port = self._from.readline().strip()

    def say(self, text: str) -> None:
        """Send a command."""
        self._to.write(text + "\n")
        self._to.flush()

    def status(self) -> Status:
        """Ask how it is."""
        self.say("status")
        words = self._from.readline().split()
        ints = [int(word) for word in words[1:7]]
        return Status(float(words[0]), *ints, float(words[7]), float(words[8]), int(words[9]), int(words[10]))

    def wait(self, ms: float, until: Callable[[Status], bool] = lambda _: False) -> Status:
        """Let so much of its time pass, or less if something has happened."""
        end = self.status().ms + ms
        while not until(now := self.status()) and now.ms < end:
            time.sleep(0.0005)
        return now

    def warm(self) -> None:
        """Give all sensors 25 degC, a healthy pump."""
        for k in range(3):
            self.say(f"adc {k} 2500")
        self.say("tacho 1")


@contextmanager
def simulated(board: Board, elf: Path, simulator: Path) -> Iterator[Chip]:
    """Run a program on a chip for as long as the block lasts."""
    words = [str(simulator), board.chip, str(elf)]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            chip = Chip(process)
            chip.warm()
            chip.wait(300)
            yield chip
        finally:
            process.kill()


def celsius(millivolt: int) -> float:
    """Return what the thermistor of config.h has at a voltage [degC]."""
    counts = millivolt * 1023 // 5000
    return 1 / (1 / 298.15 + math.log(counts / (1023 - counts)) / 3950) - 273.15


def check_talk(chip: Chip, rig: DeviceRig, check: Check) -> None:
    """Hello, temperatures, both directions, the end of a drive."""
    check(rig.identity.sensors == ("t_tank", "t_surface", "t_ambient"), f"hello: {rig.identity.sensors}")
    volts = (2100, 2900, 2600)
    for k, millivolt in enumerate(volts):
        chip.say(f"adc {k} {millivolt}")
    chip.wait(250)
    off = [abs(v - celsius(mv)) for v, mv in zip(rig.read().values.values(), volts)]
    check(max(off) <= 0.11, f"read: temperatures off by {max(off):.3f} K at most (a count is 0.1 K)")
    chip.warm()
    for value, width in ((0.5, (1, 127, 0, 1)), (-0.25, (1, 0, 63, 1)), (1.0, (1, 255, 0, 1))):
        rig.apply({"drive": value}, 1)
        check(
            chip.status().pins == width, f"drive {value:g}: enable, heat, cool, pump = {chip.status().pins}"
        )
    rig.apply({"drive": 0.0}, 0)
    check(chip.status().pins == OFF, "off: all pins low")


def check_expiry(chip: Chip, rig: DeviceRig, check: Check, name: str = "expiry") -> None:
    """A drive that nobody renews ends after 2 s of the chip's time."""
    rig.apply({"drive": 0.5}, 1)
    begin = chip.status().ms
    took = chip.wait(2500, lambda s: s.pins == OFF).ms - begin
    check(1900 <= took <= 2100, f"{name}: off {took / 1000:.2f} s after the last drive")
    check(rig.read().drive == {"drive": 0.0} and rig.state is not None and rig.state.mode == "expired",
          f"{name}: mode {rig.state and rig.state.mode}")  # fmt: skip


def check_latch(chip: Chip, rig: DeviceRig, check: Check) -> None:
    """Open, short, too warm, and a pump that has stopped: off, refused, cleared when repaired."""
    for what, millivolt in (("open:t_surface", 5000), ("short:t_surface", 0), ("over:t_surface", 1000)):
        rig.apply({"drive": 0.5}, 1)
        begin = chip.status().ms
        chip.say(f"adc 1 {millivolt}")
        took = chip.wait(1500, lambda s: s.pins == OFF).ms - begin
        refused = refusal(lambda: rig.apply({"drive": 0.5}, 1))
        still = refusal(rig.clear)
        check(
            took <= 450 and what in refused and "still there" in still, f"latch {what}: off in {took:.0f} ms"
        )
        chip.warm()
        chip.wait(200)
        rig.clear()
    rig.apply({"drive": 0.5}, 1)
    chip.say("tacho 0")
    begin = chip.status().ms
    while (now := chip.status()).pins != OFF and now.ms < begin + 4000:
        rig.wait(0.1)
        with suppress(DeviceRefusedError):  # it has latched since it was asked
            rig.apply({"drive": 0.5}, 1)
    check(now.pins == OFF and 2800 <= now.ms - begin <= 3300, f"latch pump: off in {now.ms - begin:.0f} ms")
    chip.warm()
    rig.clear()


def refusal(call: Callable[[], None]) -> str:
    """Return what a device says no with."""
    try:
        call()
    except DeviceRefusedError as refused:
        return str(refused)
    return ""


def check_damage(chip: Chip, rig: DeviceRig, check: Check) -> None:
    """A damaged line is refused and changes nothing; so is one that is far too long."""
    rig.apply({"drive": 0.5}, 1)
    for name, line in (("crc", b"7 off*059E26DEBE\n"), ("overlong", b"x" * 400 + b"\n")):
        rig.port.write(line)
        heard, end = b"", time.monotonic() + 1.0
        while not heard.endswith(b"\n") and time.monotonic() < end:
            heard += rig.port.read(0.1)
        said = [getattr(event, "words", None) for event in LineParser().feed(heard)]
        check(said == [("err", "corrupt")], f"damage ({name}): {heard.decode().strip()}")
    check(chip.status().pins == (1, 127, 0, 1), "damage: the drive goes on")


def check_load(chip: Chip, rig: DeviceRig, check: Check, seconds: float = 10.0) -> None:
    """A host that asks as fast as it can: the loop turns, and every answer begins in time."""
    chip.say("forget")
    begin = chip.status().ms
    while chip.status().ms < begin + 1000 * seconds:
        rig.apply({"drive": 0.2}, 1)
        rig.read()
    worst = chip.status()
    check(worst.turn_us < 10_000, f"under load: the loop's longest turn took {worst.turn_us / 1000:.1f} ms")
    check(worst.answer_us < 50_000, f"under load: answers began within {worst.answer_us / 1000:.1f} ms")


def check_wrap(chip: Chip, rig: DeviceRig, check: Check, elf: Path) -> None:
    """The chip's clock goes round (after 49 days): a drive lives 2 s all the same."""
    symbols = run("avr-nm", elf).splitlines()
    address = next(line.split()[0] for line in symbols if line.endswith(" timer0_millis"))
    rig.apply({"drive": 0.0}, 0)  # the leap itself is no time without flow
    chip.say(f"poke {int(address, 16) - 0x800000:x} {2**32 - 1000}")
    rig.read()
    check_expiry(chip, rig, check, "across the end of the clock")


def check_watchdog(chip: Chip, rig: DeviceRig, check: Check) -> None:
    """A program that hangs is reset by the chip, and the host sees it."""
    rig.apply({"drive": 0.5}, 1)
    boots, begin = chip.status().boots, chip.status().ms
    chip.say("hang")
    off = chip.wait(3000, lambda s: s.pins == OFF).ms - begin
    chip.wait(1000, lambda s: s.boots > boots)
    rig.read()
    reported = [notice.text for notice in rig.notices() if notice.kind == "reset"]
    named = bool(reported) and "watchdog" in reported[0]
    check(off <= 1300 and named, f"watchdog: off in {off:.0f} ms; {reported}")
    rig.apply({"drive": 0.5}, 1)
    check(chip.status().pins == (1, 127, 0, 1), "watchdog: driven again after a new hello")


def check_board(chip: Chip, elf: Path, check: Check) -> int:
    """Try everything and return the deepest stack [bytes]."""
    rig = DeviceRig(Port(chip.port))
    check_talk(chip, rig, check)
    check_expiry(chip, rig, check)
    check_latch(chip, rig, check)
    check_damage(chip, rig, check)
    deepest = chip.status().stack
    check_load(chip, rig, check)
    check_wrap(chip, rig, check, elf)
    check_watchdog(chip, rig, check)
    rig.close()
    check(chip.wait(100).pins == OFF, "close: all pins low")
    return max(deepest, chip.status().stack)


def main() -> int:
    """Build, measure, run."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--board", choices=[board.name for board in BOARDS], help="only this one")
    chosen = options.parse_args()
    absent = missing()
    if absent:
        print(f"not installed: {absent}")
        return MISSING
    check = Check()
    with tempfile.TemporaryDirectory(prefix="thermogrip-board-") as folder:
        simulator = Path(folder) / "board_sim"
        source = Path(__file__).with_name("board_sim.c")
        run("gcc", "-O2", "-Wall", "-Wextra", "-Werror", source, "-o", simulator, "-lsimavr", "-lutil")
        for board in (board for board in BOARDS if chosen.board in (None, board.name)):
            out = Path(folder) / board.name
            out.mkdir()
            elf = build(board, out)
            flash, ram = sizes(elf)
            print(
                f"{board.name} ({board.chip}): flash {flash} of {board.flash} bytes, RAM {ram} of {board.ram}"
            )
            with simulated(board, elf, simulator) as chip:
                stack = check_board(chip, elf, check)
            left = board.ram - ram - stack
            check(left >= 128, f"stack: {stack} bytes at the deepest, {left} never touched")
    print("all hold" if not check.failed else f"{check.failed} do not hold")
    return int(bool(check.failed))


if __name__ == "__main__":
    sys.exit(main())
