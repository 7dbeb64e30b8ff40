"""Make files that claim, unpack or nest more than they should, and read each with the command that would.

    python benchmarks/hostile/files.py [--only WORD]

Prints for every file its size, the exit code, the seconds of CPU (and how many more than for a file of one
zero byte), the peak memory and the line on stderr.  Each is to end with code 2 within 2 s of CPU and 500 MB;
a packed table may take what it may unpack to besides, once, and the seconds of that.
The files are written into a temporary folder; the large Parquet takes half a minute to write.
"""

from __future__ import annotations

import argparse
import gzip
import json
import lzma
import os
import shutil
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from thermogrip.datasets.limits import most_unpacked

SECONDS, MEGABYTES = 2.0, 500.0
UNPACKED_MB_PER_S = 300.0  # of CPU; gzip: 359 of zeros, 542 of rows
ROWS = "time_s,drive,pump,t_tank_degC,t_surface_degC,t_ambient_degC\n" + "".join(
    f"{k},{0.5 * (k % 40 > 20)},1,{25 + 0.01 * k:.2f},{25 + 0.008 * k:.3f},25.0\n" for k in range(120)
)


# ---- what holds more than it seems ----


def netcdf_of_rows(path: Path, rows: int) -> None:
    """Claim rows that were never written."""
    import h5py

    with h5py.File(path, "w") as file:
        for name in ("time", "t_tank"):
            one = file.create_dataset(name, (rows,), dtype="f8", chunks=(1 << 16,))
            one.attrs["units"] = "s" if name == "time" else "degC"
            if name == "time":
                one.make_scale("time")
            else:
                one.dims[0].attach_scale(file["time"])


def netcdf_of_one_text(path: Path, count: int, length: int) -> None:
    """Name one long text very often."""
    import h5py

    with h5py.File(path, "w") as file:
        one = file.create_dataset("material", (count,), dtype=h5py.string_dtype(), fillvalue="x" * length)
        one.attrs["units"] = "1"


def netcdf_elsewhere(path: Path) -> None:
    """Store the numbers in another file."""
    import h5py

    with h5py.File(path, "w") as file:
        file.create_dataset("time", (8,), dtype="u1", external=[("/etc/hostname", 0, 8)])


def parquet_of_rows(path: Path, rows: int) -> None:
    """Write one value so many times: a dictionary and a run length."""
    import pyarrow as pa
    import pyarrow.parquet as parquet

    part = min(rows, 1 << 25)
    column = pa.array(np.zeros(part))
    schema = pa.schema([("time_s", pa.float64()), ("t_tank_degC", pa.float64())])
    with parquet.ParquetWriter(path, schema, compression="zstd") as writer:
        for _ in range(rows // part):
            writer.write_table(pa.table([column, column], schema=schema), row_group_size=part)


def xz_of(path: Path, start: bytes, line: bytes, size: int) -> None:
    """Pack one line so often that it unpacks to ``size`` bytes."""
    packer = lzma.LZMACompressor()
    with path.open("wb") as file:
        file.write(packer.compress(start))
        piece = line * ((1 << 20) // len(line))
        for _ in range(size // len(piece)):
            file.write(packer.compress(piece))
        file.write(packer.flush())


def mcap_of_chunk(path: Path, size: int, packing: str) -> None:
    """Write an MCAP with one chunk that unpacks to ``size`` bytes."""
    import lz4.frame
    import zstandard

    data = bytes(size)
    packed = zstandard.compress(data) if packing == "zstd" else lz4.frame.compress(data)
    name = packing.encode()
    body = struct.pack("<QQQII", 0, 0, size, 0, len(name)) + name
    body += struct.pack("<Q", len(packed)) + packed
    head = struct.pack("<I", 0) + struct.pack("<I", 0)
    with path.open("wb") as file:
        file.write(b"\x89MCAP0\r\n" + struct.pack("<BQ", 1, len(head)) + head)
        file.write(struct.pack("<BQ", 6, len(body)) + body)


def bag_of_messages(folder: Path, size: int) -> Path:
    """Write a ROS 2 bag of one message, compressed by itself, that unpacks to ``size`` more bytes."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    writer = Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer:
        link = writer.add_connection(
            "/text", "std_msgs/msg/String", typestore=get_typestore(Stores.ROS2_HUMBLE)
        )
        writer.write(link, 1, struct.pack("<II", 256, size) + bytes(size))
    return folder


def bag_of_chunk(path: Path, size: int) -> None:
    """Write a ROS 1 bag whose chunk of one message unpacks to ``size`` more bytes."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    writer = Writer(path)
    writer.set_compression(Writer.CompressionFormat.BZ2)
    with writer:
        link = writer.add_connection("/text", "std_msgs/msg/String", typestore=store)
        writer.write(link, 1, struct.pack("<I", size) + bytes(size))


def safetensors_of(path: Path, numbers: int) -> None:
    """Write a header that claims so many numbers."""
    head = json.dumps({"w": {"dtype": "F32", "shape": [numbers], "data_offsets": [0, 4 * numbers]}}).encode()
    path.write_bytes(struct.pack("<Q", len(head)) + head)


# ---- models ----


def plant() -> dict[str, Any]:
    """Return a small plant: a tank with a drive and a skin behind a pump."""
    from thermogrip.sysid.models.state_space import StateSpaceModel
    from thermogrip.sysid.plant.plant import Plant

    model = StateSpaceModel(
        ("drive", "pump"), ("t_ambient",), ("t_tank", "t_surface"), A=[[0.99, 0.0], [0.05, 0.95]],
        B=[[0.2, 0.0], [0.0, 0.0]], E=[[0.01], [0.0]], C=np.eye(2), dt=1.0, switches=("pump",),
    )  # fmt: skip
    units = {"drive": "1", "pump": "1", "t_ambient": "degC", "t_tank": "degC", "t_surface": "degC"}
    noise = {"t_tank": 0.05, "t_surface": 0.05}
    return Plant(model, {}, dt=1.0, units=units, noise=noise, valid={"drive": (-1.0, 1.0)}).to_dict()


def controller() -> dict[str, Any]:
    """Return a controller of the small plant."""
    from thermogrip.mpc import Controller
    from thermogrip.mpc.design.design import default_design
    from thermogrip.sysid.plant.plant import Plant

    small = Plant.from_dict(plant())
    with tempfile.TemporaryDirectory() as folder:
        path = Controller(small, default_design(small)).save(Path(folder) / "c.json")
        found: dict[str, Any] = json.loads(path.read_text())
    return found


def changed(content: dict[str, Any], where: str, value: Any) -> str:
    """Return the JSON of content with one entry replaced, numbers written as they are given."""
    copy = json.loads(json.dumps(content))
    inner: Any = copy
    *path, last = where.split(".")
    for key in path:
        inner = inner[int(key) if isinstance(inner, list) else key]
    inner[int(last) if isinstance(inner, list) else last] = "@"
    return json.dumps(copy).replace('"@"', value if isinstance(value, str) else json.dumps(value))


def network(**changes: Any) -> str:
    """Return the template of a network, with keys of its top replaced."""
    from importlib import resources

    text = (resources.files("thermogrip.sysid") / "networks" / "tclab.toml").read_text(encoding="utf-8")
    for key, value in changes.items():
        lines = text.splitlines()
        at = next(k for k, line in enumerate(lines) if line.startswith(f"{key} ="))
        text = "\n".join([*lines[:at], f"{key} = {value}", *lines[at + 1 :]]) + "\n"
    return text


def large_network(nodes: int) -> str:
    """Return a chain of so many nodes."""
    parts = ['schema = "thermogrip.network"\nversion = 1\nname = "chain"\ndt = 1.0\n']
    parts.append('[inputs.drive]\nunit = "1"\nrange = [0, 1]\n[outputs.t_tank]\nnode = "n0"\n')
    parts += [f'[nodes.n{k}]\ncapacity = "C"\n' for k in range(nodes)]
    parts += [f'[links.l{k}]\nbetween = ["n{k}", "n{k + 1}"]\nconductance = "G"\n' for k in range(nodes - 1)]
    parts.append('[heaters.h]\nnode = "n0"\ninput = "drive"\npower = "P"\n')
    units = {"C": "J/K", "G": "W/K", "P": "W"}
    parts += [f'[parameters.{n}]\nunit = "{u}"\nvalue = 1.0\nsd_log = 0.5\n' for n, u in units.items()]
    return "".join(parts)


NESTED = "[" * 50_000 + "]" * 50_000
Case = tuple[Callable[[Path], Any], list[str]]


def cases(folder: Path) -> dict[str, Case]:
    """Return by name what makes a file and the words of the command that reads it; FILE is its path."""
    made_plant, made_controller = plant(), controller()
    good_plant, good_log = folder / "good-plant.json", folder / "good.csv"
    good_plant.write_text(json.dumps(made_plant))
    good_log.write_text(ROWS)
    validate = ["validate", "FILE", str(good_log)]
    log = ["validate", str(good_plant), "FILE"]
    out = str(folder / "o.json")
    fit = ["identify", str(good_log), "--network", "FILE", "--models", "network", "--out", out]
    tune = ["tune", str(good_plant), "--spec", "FILE", "--out", out]
    review = ["review", "FILE"]
    grasps = ["train", "FILE", "--classifier", "bayes", "--out", str(folder / "model")]

    def text(content: str | bytes) -> Callable[[Path], Any]:
        return lambda path: path.write_bytes(content if isinstance(content, bytes) else content.encode())

    head = ROWS.splitlines(keepends=True)[0].encode()
    found: dict[str, Case] = {
        "toml nested.toml": (text(f"a = {NESTED}\n"), tune),
        "toml tables nested.toml": (text("a = " + "{b=" * 50_000 + "1" + "}" * 50_000 + "\n"), tune),
        "toml 5000 digits.toml": (text(f"hold_s = {'9' * 5000}\n"), tune),
        "toml key of 200000 parts.toml": (text(".".join(["a"] * 200_000) + " = 1\n"), tune),
        "toml table of 200000 parts.toml": (text("[" + ".".join(["a"] * 200_000) + "]\n"), tune),
        "toml 100 MB.toml": (text(b"# " + b"a" * 100_000_000 + b"\n"), tune),
        "network of 20000 nodes.toml": (text(large_network(20_000)), fit),
        "network of 3000 nodes.toml": (text(large_network(3000)), fit),
        "json nested.json": (text('{"a":' + NESTED + "}"), validate),
        "json nested 900.json": (
            text('{"schema":"thermogrip.plant","version":1,"a":' + "[" * 900 + "]" * 900 + "}"), validate,
        ),
        "json 5000 digits.json": (text(changed(made_plant, "dt", "9" * 5000)), validate),
        "json 100 MB of brackets.json": (text("[" + "[],[{}]," * 12_500_000 + "0]"), validate),
        "json at the limit.json": (text("[" + "[]," * ((8 << 20) // 3 - 2) + "0]"), validate),
        "netcdf 3e9 rows.nc": (lambda path: netcdf_of_rows(path, 3_000_000_000), log),
        "netcdf 1e8 rows.nc": (lambda path: netcdf_of_rows(path, 100_000_000), log),
        "netcdf one text.nc": (lambda path: netcdf_of_one_text(path, 100_000, 60_000), grasps),
        "netcdf elsewhere.nc": (netcdf_elsewhere, log),
        "parquet 19 GB.parquet": (lambda path: parquet_of_rows(path, 1_200_000_000), log),
        "empty lines 200 MB.csv.xz": (lambda path: xz_of(path, head, b"\n", 200_000_000), log),
        "empty lines 15 MB.csv.xz": (lambda path: xz_of(path, head, b"\n", 15_000_000), log),
        "short rows 15 MB.csv.xz": (lambda path: xz_of(path, b"time_s\n", b"1\n", 15_000_000), log),
        "commas 15 MB.csv.xz": (lambda path: xz_of(path, b"a,", b"b,", 15_000_000), log),
        "zeros 4 GB.csv.gz": (
            lambda path: path.write_bytes(gzip.compress(bytes(1 << 20)) * 4096), log,
        ),
        "sparse 1 TB.csv": (lambda path: (path.touch(), os.truncate(path, 10**12)), log),
        "device.csv": (lambda path: path.symlink_to("/dev/zero"), log),
        "pipe.csv": (os.mkfifo, log),
        "device.json": (lambda path: path.symlink_to("/dev/zero"), validate),
        "mcap zstd 1 GB.mcap": (lambda path: mcap_of_chunk(path, 1 << 30, "zstd"), log),
        "mcap lz4 1 GB.mcap": (lambda path: mcap_of_chunk(path, 1 << 30, "lz4"), log),
        "messages of 1 GB.bag2": (lambda path: bag_of_messages(path, 1 << 30), log),
        "rows 4 GB.csv.gz": (
            lambda path: path.write_bytes(gzip.compress(head + b"1,2,3,4,5,6\n" * (1 << 17)) * 2500), log,
        ),
        "chunk of 1 GB.bag": (lambda path: bag_of_chunk(path, 1 << 30), log),
    }  # fmt: skip
    for value in ("1e-9", "1e-6", "-1", "0", "1e308", "1e999"):
        found[f"network dt {value}.toml"] = (text(network(dt=value)), fit)
        found[f"plant dt {value}.json"] = (text(changed(made_plant, "dt", value)), validate)
        found[f"plant model dt {value}.json"] = (text(changed(made_plant, "model.dt", value)), validate)
        found[f"controller dt {value}.json"] = (text(changed(made_controller, "design.dt", value)), review)
    for where in ("model.A.0.0", "model.B.0.0", "model.C.0.0", "model.y0.0", "noise.t_tank"):
        found[f"plant {where} 1e308.json"] = (text(changed(made_plant, where, "1e308")), validate)
    for where in ("design.track", "design.slew_per_s.drive", "plant.model.A.0.0", "design.noise.reading"):
        try:
            spoilt = changed(made_controller, where, "1e308")
        except KeyError:
            continue
        found[f"controller {where} 1e308.json"] = (text(spoilt), review)
    return found


def measure(words: list[str], folder: Path) -> tuple[int, float, float, str]:
    """Run one command line; return exit code, seconds of CPU, peak memory [MB] and its last line."""
    # a process of its own counts: the peak of a child begins with that of the parent that it came from
    limits = ["sh", "-c", 'ulimit -v 12000000; exec timeout 60 "$@"', "sh"]
    counted = ["/usr/bin/time", "-o", str(folder / "used"), "-f", "%x %U %S %M", *limits]
    command = [*counted, sys.executable, "-m", "thermogrip", *words]
    done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, check=False)
    lines = done.stderr.decode("utf-8", "replace").strip().splitlines() or [""]
    code, user, system, peak = (folder / "used").read_text().splitlines()[-1].split()
    return int(code), float(user) + float(system), float(peak) / 1000, lines[-1]


def main() -> int:
    """Print the table and return whether a file got past the limits."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="files whose name contains this")
    only = parser.parse_args().only
    beyond = 0
    head = ("file", "size", "exit", "CPU s", "more than one zero byte", "peak MB", "line")
    print(f"| {' | '.join(head)} |\n{'|---' * len(head)}|")
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        starts: dict[str, float] = {}
        for name, (make, words) in cases(folder).items():
            if only not in name:
                continue
            path = folder / name.replace(" ", "_")
            make(path)
            size = path.lstat().st_size
            if words[0] not in starts:  # what the command takes to refuse any file at all, compiled once
                (folder / "zero").write_bytes(b"\0")
                asked = [str(folder / "zero") if word == "FILE" else word for word in words]
                starts[words[0]] = min(measure(asked, folder)[1] for _ in range(2))
            code, seconds, peak, line = measure([str(path) if w == "FILE" else w for w in words], folder)
            shutil.rmtree(path) if path.is_dir() else path.unlink()
            # a reader holds what a file may unpack to before it can tell that there is more
            unpacked = most_unpacked(size) / 1e6 if path.suffix in {".gz", ".xz"} else 0.0
            wrong = (
                code != 2 or seconds > SECONDS + unpacked / UNPACKED_MB_PER_S or peak > MEGABYTES + unpacked
            )
            beyond += wrong
            shown = line.replace(f"{folder}/", "").replace("thermogrip: ", "")[:150]
            mark = " (!)" if wrong else ""
            more = seconds - starts[words[0]]
            cells = (f"{name}{mark}", size, code, f"{seconds:.1f}", f"{more:.1f}", f"{peak:.0f}", shown)
            print(f"| {' | '.join(map(str, cells))} |", flush=True)
    return int(beyond > 0)


if __name__ == "__main__":
    raise SystemExit(main())
