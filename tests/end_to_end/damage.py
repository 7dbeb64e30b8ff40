"""Whole files of every kind that a verb opens, and ways to damage them.

Each damaged file goes through the verb that reads it, in a child process with 20 s of CPU for it.
"""

from __future__ import annotations

import ast
import io
import json
import os
import random
import re
import resource
import shutil
import signal
import tempfile
import warnings
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests.end_to_end.conftest import HEADER, small_grasps, small_log_rows, small_plant
from thermogrip.cli.main import main
from thermogrip.datasets.errors import UserError
from thermogrip.mpc.design.spec import read_spec

CPU_S = 20
NUMBER = re.compile(rb"(?<![\w.])-?\d+(\.\d+)?(e[-+]?\d+)?(?![\w.])")
WRONG_TEXT = (b"nan", b"-1", b"0", b"1e308", b"9" * 400, b'"abc"', b"", b"[[[1]]]", b"{}", b"true", b"inf")
WRONG_VALUES: tuple[Any, ...] = (
    None, True, "abc", "", -1, 0, 1e-9, 1e9, 1e308, float("nan"), float("inf"), 10**400, [], {}, [[1.0]],
    {"a": 1}, ["abc"], [None], [1, 2, 3],
)  # fmt: skip


@dataclass(frozen=True)
class Kind:
    """A kind of file: what of the bench is damaged, and the command line, or where that takes minutes the
    function, that reads it."""

    files: tuple[str, ...]
    reader: str | Callable[[], object]


LOGS = (
    "log.csv", "log.csv.xz", "log.nc", "log.mat", "log.parquet", "log.xlsx", "one.bag", "one.db3", "one.mcap"
)  # fmt: skip
RUN = "--target 26 --settle-timeout 30 --out r --twin"
GRASPS = (("grasps.csv", "grasps_meta.csv"), ("g.nc",), ("g.parquet", "g_meta.csv"))
MODELS = ("bayes", "features-lda", "pca-lda", "posterior", "lstm")
KINDS = {
    **{name: Kind((name,), f"simulate plant.json {name} --out s.csv") for name in LOGS},
    **{files[0]: Kind(files, f"classify bayes {files[0]} --out p.csv") for files in GRASPS},
    "plant.json": Kind(("plant.json",), "simulate plant.json log.csv --out s.csv"),
    "network plant": Kind(("net.json", "net.nc"), "simulate net.json kit.csv --out s.csv"),
    "controller.json": Kind(("controller.json",), f"run controller.json {RUN} plant.json"),
    **{
        f"{name}/": Kind(
            (f"{name}/*",), f"classify {name} {'few' if name == 'posterior' else 'grasps'}.csv --out p.csv"
        )
        for name in MODELS
    },
    "guard.toml": Kind(("guard.toml",), f"run controller.json {RUN} plant.json --guard guard.toml"),
    "spec.toml": Kind(("spec.toml",), lambda: read_spec("spec.toml").design(small_plant())),
    "network.toml": Kind(
        ("network.toml",), "excite --kind prbs --minutes 60 --network network.toml --out s.csv"
    ),
    "topics.toml": Kind(("topics.toml",), "simulate plant.json one.mcap --out s.csv"),
    "run/": Kind(("run/*",), "recover run"),
}


def byte_damage(data: bytes, rng: random.Random) -> bytes:
    """Cut the data, flip bytes, write zeros, or swap two blocks."""
    out, n = bytearray(data), len(data)
    if n < 4:
        return b""
    kind, at = rng.choice(("cut", "flip", "zeros", "swap")), rng.randrange(n)
    length = rng.randint(1, max(1, n // 8))
    if kind == "cut":
        return data[:at]
    if kind == "flip":
        for _ in range(rng.randint(1, 8)):
            out[rng.randrange(n)] = rng.randrange(256)
    elif kind == "zeros":
        out[at : at + length] = bytes(len(out[at : at + length]))
    else:
        other = rng.randrange(n)
        out[at : at + length], out[other : other + length] = (
            out[other : other + length],
            out[at : at + length],
        )
    return bytes(out)


def text_damage(data: bytes, rng: random.Random) -> bytes:
    """Put something else in place of one number, or lose a line or its end."""
    found = list(NUMBER.finditer(data))
    if rng.random() < 0.2 or not found:
        lines = data.splitlines(keepends=True)
        at = rng.randrange(len(lines))
        lines[at] = rng.choice((b"", lines[at].rstrip(), lines[at] * 2))
        return b"".join(lines)
    one = rng.choice(found)
    return data[: one.start()] + rng.choice(WRONG_TEXT) + data[one.end() :]


def json_damage(data: bytes, rng: random.Random) -> bytes:
    """Change, nest or drop one value of a document, wherever it stands."""
    content = json.loads(data)
    outer: Any = {"whole": content}
    key: Any = "whole"
    while isinstance(outer[key], dict | list) and outer[key] and rng.random() < 0.8:
        outer = outer[key]
        key = rng.choice(list(outer) if isinstance(outer, dict) else range(len(outer)))
    if key != "whole" and rng.random() < 0.2:
        del outer[key]
    elif rng.random() < 0.1:
        depth = rng.choice((2, 60, 5000))
        outer[key] = "DEEP"
        return json.dumps(content).replace('"DEEP"', "[" * depth + "1" + "]" * depth).encode()
    else:
        outer[key] = rng.choice(WRONG_VALUES)
    return json.dumps(content).encode()


def damage(path: Path, rng: random.Random) -> None:
    """Damage a file in a way that its kind can have."""
    data, ways = path.read_bytes(), [byte_damage]
    if path.suffix == ".json":
        ways += [json_damage] * 3
    elif path.suffix in (".csv", ".toml", ".jsonl"):
        ways += [text_damage] * 2
    path.write_bytes(rng.choice(ways)(data, rng))


def whole_files(folder: Path) -> None:
    """Write every kind of file, whole."""
    from scipy.io import savemat

    from thermogrip.classify.estimators.registry import make_classifier, save_classifier
    from thermogrip.datasets.grasp_files import read_grasps, write_grasps
    from thermogrip.datasets.log_files import read_log, write_log
    from thermogrip.mpc.controllers.mpc import design_controller
    from thermogrip.sysid import Plant, load_network

    rows = [HEADER, *small_log_rows(240)]
    (folder / "log.csv").write_text("\n".join(rows) + "\n")
    log = read_log(folder / "log.csv")
    write_log(log, folder / "log.nc")
    write_log(log, folder / "log.parquet")
    write_log(log, folder / "log.csv.xz")
    numbers = np.array([row.split(",") for row in rows[1:]], dtype=float)
    savemat(folder / "log.mat", dict(zip(HEADER.split(","), numbers.T)), do_compression=True)
    import pandas as pd

    pd.DataFrame(numbers, columns=HEADER.split(",")).to_excel(folder / "log.xlsx", index=False)
    write_bags(folder, numbers)
    for name, count in (("grasps", 99), ("few", 1)):
        samples, meta = small_grasps()
        kept = [f"g{k:03d}," for k in range(count)] + ["grasp_id"]
        for suffix, text in ((".csv", samples), ("_meta.csv", meta)):
            lines = [line for line in text.splitlines() if line.startswith(tuple(kept))]
            (folder / f"{name}{suffix}").write_text("\n".join(lines) + "\n")
    grasps = read_grasps(folder / "grasps.csv")
    write_grasps(grasps, folder / "g.nc")
    pd.read_csv(folder / "grasps.csv").to_parquet(folder / "g.parquet")
    shutil.copy(folder / "grasps_meta.csv", folder / "g_meta.csv")
    for name in MODELS:
        params = {"epochs": 2} if name == "lstm" else {}
        save_classifier(make_classifier(name, **params).fit(grasps), folder / name)
    plant = small_plant()
    plant.save(folder / "plant.json")
    design_controller(plant, dt=2.0).save(folder / "controller.json")
    kit = load_network("tclab")
    heaters = dict.fromkeys(kit.inputs, (0.0, 100.0))
    p, rng = dict(zip(kit.parameters, kit.prior)), np.random.default_rng(0)
    net = Plant(
        kit, p, dt=kit.dt, units=kit.units, valid=heaters, free=tuple(kit.parameters),
        samples=kit.prior * np.exp(rng.normal(0, 0.01, (40, len(kit.prior)))),
    )  # fmt: skip
    net.save(folder / "net.json")
    header = ",".join(("time_s", *kit.inputs, *(f"{n}_degC" for n in (*kit.outputs, *kit.disturbances))))
    n_signals = len(kit.outputs) + len(kit.disturbances)
    lines = [f"{k},{50 * (k % 40 > 20)},0" + ",25" * n_signals for k in range(120)]
    (folder / "kit.csv").write_text("\n".join([header, *lines]) + "\n")
    here = os.getcwd()
    os.chdir(folder)
    try:
        for what in ("spec", "guard", "network"):
            assert main(["init", what, "--out", f"{what}.toml"]) == 0
        run = "run controller.json --target 30 --twin plant.json --object 20 --material wood --out run"
        assert main(run.split()) == 0
        (folder / "run" / "SHA256SUMS").unlink()  # as of a run that was killed: its files are looked at
    finally:
        os.chdir(here)


def write_bags(folder: Path, numbers: Any) -> None:
    """Write the log as a ROS 1 bag, SQLite and MCAP, and its topic map."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    columns = {"drive": 1, "pump": 2, "t_tank": 3, "t_surface": 4, "t_ambient": 5}
    text = 'schema = "thermogrip.topics"\nversion = 1\nclock = "t_tank"\n'
    for name in columns:
        unit, role = ("degC", "") if name.startswith("t_") else ("1", 'role = "input"\n')
        text += f'[columns.{name}]\ntopic = "/{name}"\nfield = "data"\nunit = "{unit}"\n{role}'
    (folder / "topics.toml").write_text(text)
    writers: list[tuple[Any, Any]] = [
        (Writer1(folder / "one.bag"), Stores.ROS1_NOETIC),
        (Writer(folder / "db3", version=9, storage_plugin=StoragePlugin.SQLITE3), Stores.ROS2_HUMBLE),
        (Writer(folder / "mcap", version=9, storage_plugin=StoragePlugin.MCAP), Stores.ROS2_HUMBLE),
    ]
    for writer, kind in writers:
        store, name = get_typestore(kind), "std_msgs/msg/Float64"
        pack = store.serialize_ros1 if kind is Stores.ROS1_NOETIC else store.serialize_cdr
        with writer:
            links = {topic: writer.add_connection(f"/{topic}", name, typestore=store) for topic in columns}
            for row in numbers:
                for topic, at in columns.items():
                    message = pack(store.types[name](data=float(row[at])), name)
                    writer.write(links[topic], int(1e9 * (1000 + row[0])), message)
    for name in ("db3", "mcap"):
        shutil.move(next((folder / name).glob(f"*.{name}")), folder / f"one.{name}")
        shutil.rmtree(folder / name)


def damaged_case(whole: Path, place: Path, kind: str, seed: int) -> None:
    """Copy the whole files to a place and damage one of the kind, or none where the seed is -1."""
    shutil.copytree(whole, place)
    if seed < 0:
        return
    rng = random.Random(f"{kind} {seed}")
    files = sorted(path for pattern in KINDS[kind].files for path in place.glob(pattern) if path.is_file())
    for file in rng.sample(files, min(len(files), rng.choice((1, 1, 2)))):
        damage(file, rng)


def read_one(kind: str, place: Path) -> str:
    """Read a kind of file in a place; return the exit code, or what is wrong with how it ended."""
    reader, said = KINDS[kind].reader, io.StringIO()
    os.chdir(place)
    with redirect_stderr(said), redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("always")
        try:
            code = main(reader.split()) if isinstance(reader, str) else int(reader() is None)
        except UserError:
            code = 2
        except Exception as error:
            return f"bug: {type(error).__name__}: {error}"
    lines = said.getvalue().splitlines() or [""]
    if code == 1:
        return lines[-1].partition("thermogrip: ")[2]
    odd = [line for line in lines if "Warning" in line or "Traceback" in line]
    return f"stray line: {odd[0]}" if odd else str(code)


def child(kind: str, whole: Path, seeds: Sequence[int], asked: int) -> None:
    """Read the damaged files, one after another, and write how each ended."""
    with open(asked, "w") as out, tempfile.TemporaryDirectory() as made:
        for seed in seeds:
            used = sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
            resource.setrlimit(resource.RLIMIT_CPU, (int(used) + CPU_S, resource.RLIM_INFINITY))
            place = Path(made) / str(seed)
            damaged_case(whole, place, kind, seed)
            out.write(f"{seed} {read_one(kind, place)!r}\n")
            out.flush()
            os.chdir(made)
            shutil.rmtree(place, ignore_errors=True)


def read_many(kind: str, whole: Path, seeds: Sequence[int]) -> dict[int, str]:
    """Damage a kind of file in many ways, each read in a child process, the next one where that died."""
    ends: dict[int, str] = {}
    while todo := [seed for seed in seeds if seed not in ends]:
        answers, asked = os.pipe()
        if os.fork() == 0:
            try:
                child(kind, whole, todo, asked)
            finally:
                os._exit(0)
        os.close(asked)
        with open(answers, errors="replace") as file:
            for line in file:
                seed, _, end = line.partition(" ")
                ends[int(seed)] = ast.literal_eval(end)
        _, status = os.wait()
        if dead := [seed for seed in todo if seed not in ends]:
            number = os.WTERMSIG(status)
            ends[dead[0]] = "endless" if number == signal.SIGXCPU else f"crash by signal {number}"
    return ends
