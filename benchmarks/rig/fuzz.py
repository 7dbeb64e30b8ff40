"""Throw damaged and hostile bytes at the protocol parser and the log readers.

    python benchmarks/rig/fuzz.py --inputs 1000000 --seed 1

Five targets share the inputs: the host's parser (a conversation whose lines are spoilt), the same for
readings that the device took by its own clock, the device's parser (the same, the other way), the TCLab
driver's reading of a scan, and the reader of logs (files spoilt from a corpus). An input is a spoilt piece of
a right one: bits flipped, bytes replaced, lost, invented, digits swapped, lines cut and spliced.

What must never happen: an exception that is not the reader's own error, a wait of more than a second, memory
that grows, a line taken that nobody sent.  The lines that only the CRC refused are counted: of so many, one
CRC alone would have let one in 65536 through.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from random import Random

import numpy as np

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.log_files import read_log
from thermogrip.rig.drivers.tclab import _NUMBER
from thermogrip.rig.firmware.reference import DeviceCore
from thermogrip.rig.serial.protocol import (
    Answer,
    Damaged,
    Hello,
    HostEnd,
    Line,
    LineParser,
    Read,
    State,
    Take,
    Taken,
    encode_line,
)
from thermogrip.rig.simulation.cable import spoil

SHARES = {"host": 0.35, "readings": 0.10, "device": 0.40, "tclab": 0.14, "logs": 0.01}
SLOW_S = 1.0


def answers(rng: Random) -> list[bytes]:
    """Return what a device may say: states with all kinds of numbers, refusals, a reset."""
    core = DeviceCore(boot=rng.randrange(65536))
    core.sample([rng.randrange(-5_000, 90_000) for _ in range(3)], flow=True, now_ms=0)
    core.receive(encode_line(1, "hello"), 0)
    core.receive(encode_line(2, "drive", "2000", "1", str(rng.randrange(-10_000, 10_001))), 5)
    said = [core.receive(encode_line(k, "read"), rng.randrange(10, 2_000)) for k in range(3, 6)]
    return [*said, core.receive(encode_line(6, "fire"), 2_000), core.announcement()]


def readings(rng: Random) -> list[bytes]:
    """Return what a device may say of the readings that it took by its own clock; the first is its hello."""
    core = DeviceCore()
    said = [core.receive(encode_line(1, "hello"), 0)]
    core.receive(encode_line(2, "sample", "10"), 0)
    for k in range(rng.randrange(1, 60)):
        core.keep([rng.randrange(-5_000, 90_000), "open", rng.randrange(99_000)], 10 * k + rng.randrange(9))
    return [*said, *(core.receive(encode_line(9, "take", "0"), 900) for _ in range(3))]


def damaged(lines: list[bytes], rng: Random) -> bytes:
    """Return a stream of the lines, spoilt here and there, perhaps spliced."""
    stream = b"".join(spoil(line, rng) if rng.random() < 0.7 else line for line in lines)
    if rng.random() < 0.3 and len(stream) > 2:
        a, b = sorted(rng.randrange(len(stream)) for _ in range(2))
        stream = stream[:a] + stream[b:]
    return stream


class Fuzz:
    """The targets and what they did."""

    def __init__(self, seed: int, folder: Path) -> None:
        self.rng, self.folder = Random(seed), folder
        self.count: Counter[str] = Counter()
        self.slowest = 0.0
        self.failures: list[str] = []
        self.corpus = [answers(self.rng) for _ in range(50)]
        self.taken = [readings(self.rng) for _ in range(50)]
        self.asked = [
            encode_line(k % 65535 + 1, *parts)
            for k, parts in enumerate(
                [
                    ("read",),
                    ("drive", "2000", "1", "2500"),
                    ("off",),
                    ("grip", "1"),
                    ("hello",),
                    ("sample", "10"),
                    ("take", "0"),
                ]
            )
        ]
        self.csv, self.events = corpus_of_logs()

    def host(self) -> None:
        """A host that has asked hears spoilt answers; what it takes must have been said."""
        said = self.rng.choice(self.corpus)
        seq = int(said[0].split()[0])
        host = HostEnd()
        host._seq, host._open = seq, Read()
        stream = damaged(self.rng.sample(said, len(said)), self.rng)
        parser, right = LineParser(), {line[:-1] for line in said}
        for line in parser.feed(stream):
            if isinstance(line, Damaged):
                self.count[f"host lines refused: {line.why}"] += 1
            else:
                self.count["host lines taken"] += 1
                self.count["host lines taken wrongly"] += encode_line(line.seq, *line.words)[:-1] not in right
        for event in host.hear(stream):
            if isinstance(event, Answer) and isinstance(event.content, State):
                self.count["answers used"] += 1
                text = encode_line(seq, "ok", *event.content.words())[:-1]
                self.count["answers used wrongly"] += text not in right

    def readings(self) -> None:
        """A host that has asked for readings hears spoilt ones; what it takes must have been said."""
        hello, *said = self.rng.choice(self.taken)
        host = HostEnd()
        host.ask(Hello())
        host.hear(hello)
        host._seq, host._open = 9, Take(0)
        for event in host.hear(damaged(said, self.rng)):
            if isinstance(event, Answer) and isinstance(event.content, Taken):
                self.count["readings used"] += 1
                self.count["readings used wrongly"] += encode_line(9, "ok", *event.content.words()) != said[0]

    def device(self) -> None:
        """A device hears spoilt questions; what it obeys must have been asked."""
        core = DeviceCore()
        core.sample([25_000, 25_000, 25_000], flow=True, now_ms=0)
        core.receive(encode_line(9, "hello"), 0)
        stream = damaged(self.rng.sample(self.asked, len(self.asked)), self.rng)
        right = {line[:-1] for line in self.asked}
        for line in LineParser().feed(stream):
            if isinstance(line, Line):
                self.count["device lines taken"] += 1
                self.count["device lines taken wrongly"] += (
                    encode_line(line.seq, *line.words)[:-1] not in right
                )
        back = core.receive(stream, 10)
        assert all(isinstance(line, Line) for line in LineParser().feed(back)), (
            "a device said what is no line"
        )
        assert core.outputs.drive in ((0,), (2500,)) or self.count["device lines taken wrongly"], core.outputs

    def tclab(self) -> None:
        """A scan of four numbers, spoilt: there is no check, so only what is no number can be refused."""
        lines = [b"%.3f\r\n" % self.rng.uniform(-50, 120) for _ in range(4)]
        heard = damaged(lines, self.rng).splitlines(keepends=True)
        for line in heard:
            if _NUMBER.fullmatch(line):
                assert -1e4 < float(line) < 1e4

    def logs(self) -> None:
        """A log or a run's events, spoilt: read, or refused in one line."""
        text = spoil(self.csv, self.rng)
        for _ in range(self.rng.randrange(3)):
            text = spoil(text, self.rng)
        path = self.folder / "log.csv"
        path.write_bytes(text)
        try:
            log = read_log(path)
            self.count["logs read"] += 1
            assert all(np.asarray(log[name].values).dtype.kind in "fiub" for name in log.data_vars)
        except UserError as error:
            self.count["logs refused"] += 1
            one_line = "\n" not in str(error)
            if not one_line:
                raise AssertionError(f"not one line: {error}") from error

    def run(self, inputs: int) -> None:
        """Try so many inputs."""
        targets: dict[str, Callable[[], None]] = {
            "host": self.host,
            "readings": self.readings,
            "device": self.device,
            "tclab": self.tclab,
            "logs": self.logs,
        }
        names = self.rng.choices(list(SHARES), list(SHARES.values()), k=inputs)
        for k, name in enumerate(names):
            begin = time.perf_counter()
            try:
                targets[name]()
            except Exception as error:  # whatever it is, it is a finding
                self.failures.append(f"input {k} ({name}): {type(error).__name__}: {error}")
                if len(self.failures) > 20:
                    return
            took = time.perf_counter() - begin
            self.slowest = max(self.slowest, took)
            if took > SLOW_S and name != "logs":
                self.count["slower than 1 s"] += 1
            self.count[f"inputs to {name}"] += 1
            if k % 50_000 == 0:
                print(f"{k} inputs, {len(self.failures)} failures", file=sys.stderr, flush=True)


def corpus_of_logs() -> tuple[bytes, bytes]:
    """Return a right log as CSV, and a run's events."""
    rows = ["time_s,drive,pump,t_tank_degC,t_surface_degC,t_ambient_degC"]
    rows += [
        f"{k * 0.5:.1f},{np.sin(k / 5):.4f},1,{25 + k / 10:.3f},{24 + k / 11:.3f},25.0" for k in range(60)
    ]
    events = [json.dumps({"time_s": k, "kind": "phase", "text": "hold"}) for k in range(5)]
    return "\n".join(rows).encode() + b"\n", "\n".join(events).encode() + b"\n"


def main() -> int:
    """Run and print what happened; 1 if anything did that must not."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--inputs", type=int, default=1_000_000)
    options.add_argument("--seed", type=int, default=1)
    chosen = options.parse_args()
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        fuzz = Fuzz(chosen.seed, Path(folder))
        fuzz.run(min(chosen.inputs, 2000))  # everything is imported and compiled
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        begin = time.perf_counter()
        fuzz.run(chosen.inputs - min(chosen.inputs, 2000))
        seconds = time.perf_counter() - begin
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    total = sum(number for name, number in fuzz.count.items() if name.startswith("inputs"))
    print(f"{total} inputs in {seconds:.0f} s, slowest {fuzz.slowest:.2f} s, grew {grown:.1f} MiB")
    for name, number in sorted(fuzz.count.items()):
        print(f"  {name:28s} {number}")
    for line in fuzz.failures:
        print("  FAILED", line)
    wrong = sum(number for name, number in fuzz.count.items() if name.endswith("wrongly"))
    print(f"failures {len(fuzz.failures)}, lines taken wrongly {wrong}")
    return 1 if fuzz.failures or wrong else 0


if __name__ == "__main__":
    sys.exit(main())
