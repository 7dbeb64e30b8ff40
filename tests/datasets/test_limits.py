"""What claims, unpacks or nests too much is refused in one line before it takes memory or time."""

from __future__ import annotations

import importlib.util
import io
import json
import lzma
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.io import savemat

from thermogrip.datasets import limits, netcdf, tables
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.files import read_json, read_toml
from thermogrip.datasets.grasp_files import read_grasps
from thermogrip.datasets.log_files import read_log
from thermogrip.datasets.tables import read_csv_table

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "hostile" / "files.py"
NESTED = "[" * 50_000 + "]" * 50_000
HEAD = b"time_s,t_tank_degC\n"


@pytest.fixture(scope="module")
def made() -> Any:
    """The makers of the benchmark's files."""
    if not SCRIPT.is_file():
        pytest.skip("the benchmarks are not beside the tests")
    spec = importlib.util.spec_from_file_location("hostile_files", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def refused(read: Callable[[Path], object], path: Path) -> str:
    with pytest.raises(UserError) as caught:
        read(path)
    line = str(caught.value)
    assert str(path) in line or repr(str(path)) in line
    assert "\n" not in line
    assert len(line) < len(str(path)) + 400
    return line


def toml(path: Path) -> object:
    return read_toml(path, hint="write it anew")


def document(path: Path) -> object:
    return read_json(path, "thermogrip.plant", 1)


def plant(text: str) -> str:
    return f'{{"schema": "thermogrip.plant", "version": 1, "a": {text}}}'


@pytest.mark.parametrize(
    ("read", "text", "words"),
    [
        (toml, f"a = {NESTED}", "nested too deeply"),
        (toml, "a = " + "{b = " * 50_000 + "1" + "}" * 50_000, "nested too deeply"),
        (toml, "a = " + "[" * 70 + "]" * 70, "more than 64 levels"),
        (toml, "a = " + "9" * 5000, "is not TOML"),
        (toml, "a = 1e999", "a is inf, not a finite number"),
        (toml, "a = nan", "a is nan"),
        (toml, "b.c = [1.0, -1e308]", "b.c.1 is -1e+308, beyond"),
        (toml, ".".join(["a"] * 200_000) + " = 1", "a key of more than 32 parts"),
        (toml, "[" + " . ".join(["'a'", '"b"'] * 100) + "]", "a key of more than 32 parts"),
        (toml, "#" + "a" * (1 << 20), "is 1049 kB, more than the 1049 kB"),
        (document, plant(NESTED), "nested too deeply"),
        (document, plant("[" * 70 + "]" * 70), "more than 64 levels"),
        (document, plant("9" * 5000), "is not JSON"),
        (document, plant("9" * 4000), "beyond 1e+100"),
        (document, plant("1e999"), "a is inf"),
        (document, plant('{"b": [0, {"c": 1e101}]}'), "a.b.1.c is 1e+101, beyond"),
        (document, plant('"' + "a" * (8 << 20) + '"'), "is 8389 kB, more than the 8389 kB"),
    ],
)
def test_a_document_beyond_its_limits_is_refused(
    read: Callable[[Path], object], text: str, words: str, tmp_path: Path
) -> None:
    path = tmp_path / "a.file"
    path.write_text(text)
    assert words in refused(read, path)


def test_a_document_within_its_limits_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.file"
    path.write_text(f"a = {'[' * 62 + ']' * 62}\nb = 1e100\n{'.'.join(['c'] * 30)} = 'd.{'e.' * 30}'\n")
    assert read_toml(path, hint="")["b"] == 1e100
    path.write_text(plant("[" * 62 + "-1e100" + "]" * 62))
    assert document(path)


@given(
    st.recursive(
        st.floats() | st.integers() | st.booleans() | st.none(),
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=4),
    )
)
def test_no_number_beyond_use_is_inside_a_document_that_passes(content: Any) -> None:
    def largest(value: Any) -> float:
        inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
        own = abs(value) if isinstance(value, int | float) else 0.0
        return max([np.inf if own != own else own, *map(largest, inner)])

    beyond = largest(content) > limits.MOST_NUMBER
    try:
        limits.check_content({"a": content})
    except UserError:
        assert beyond
    else:
        assert not beyond


@pytest.mark.parametrize(
    ("name", "make", "words"),
    [
        ("a.nc", lambda made, path: made.netcdf_of_rows(path, 3_000_000_000), "declares 24000 MB, more than"),
        ("a.nc", lambda made, path: made.netcdf_of_rows(path, 10_000_000), "declares 80 MB or more from"),
        ("a.nc", lambda made, path: made.netcdf_elsewhere(path), "is stored in another file"),
        ("a.parquet", lambda made, path: made.parquet_of_rows(path, 1 << 22), "declares 67 MB or more from"),
        (
            "a.mat",
            lambda made, path: savemat(path, {"x": np.zeros(1 << 21)}, do_compression=True),
            "declares 17 MB or more from",
        ),
        ("a.csv.xz", lambda made, path: made.xz_of(path, HEAD, b"\n", 40 << 20), "unpacks to 8389 kB or"),
        ("a.csv.xz", lambda made, path: made.xz_of(path, HEAD, b"\n", 3 << 20), "a header but no rows"),
        ("a.csv", lambda made, path: (path.touch(), os.truncate(path, 10**12)), "is 1000000 MB"),
        ("a.csv", lambda made, path: path.symlink_to("/dev/zero"), "is no file but a device"),
        ("a.nc", lambda made, path: path.symlink_to("/dev/zero"), "is no file but a device"),
        ("a.parquet", lambda made, path: os.mkfifo(path), "is no file but a device"),
        ("a.csv", lambda made, path: path.write_text(",".join(f"c{k}" for k in range(5000))), "5000 names"),
    ],
)
def test_a_log_that_holds_more_than_it_may_is_refused(
    name: str, make: Callable[[Any, Path], Any], words: str, made: Any, tmp_path: Path
) -> None:
    make(made, tmp_path / name)
    assert words in refused(read_log, tmp_path / name)


@pytest.mark.parametrize("kind", ["zstd.mcap", "lz4.mcap", "bag"])
def test_a_bag_whose_chunk_unpacks_to_too_much_is_refused(
    kind: str, made: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("rosbags")
    path, size = tmp_path / f"a.{kind.split('.')[-1]}", 3 << 20
    if kind == "bag":
        made.bag_of_chunk(path, size)
    else:
        made.mcap_of_chunk(path, size, kind.split(".")[0])
    for most, too_large in ((2 << 20, True), (4 << 20, False)):
        monkeypatch.setattr(limits, "MOST_BYTES", most)
        assert ("more than the 2097 kB of a file" in refused(read_log, path)) == too_large


def test_a_chunk_that_says_less_than_it_holds_is_stopped(
    made: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mcap")
    made.mcap_of_chunk(tmp_path / "a.mcap", 3 << 20, "zstd")
    sizes = [size.to_bytes(8, "little") for size in (3 << 20, 9)]
    (tmp_path / "a.mcap").write_bytes((tmp_path / "a.mcap").read_bytes().replace(*sizes))
    monkeypatch.setattr(limits, "MOST_BYTES", 2 << 20)
    assert "unpacks to 2097 kB, more than" in refused(read_log, tmp_path / "a.mcap")


def test_one_text_named_often_counts_as_often(made: Any, tmp_path: Path) -> None:
    made.netcdf_of_one_text(tmp_path / "a.nc", 1_000, 60_000)
    assert "declares 15 MB or more" in refused(read_grasps, tmp_path / "a.nc")


def test_a_group_that_holds_itself_or_points_elsewhere_is_refused(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "loop.nc", "w") as file:
        file["a"] = file["/"]
    assert "members" in refused(read_log, tmp_path / "loop.nc")
    with h5py.File(tmp_path / "link.nc", "w") as file:
        file["time"] = h5py.ExternalLink("loop.nc", "/a")
    assert "column time: is a link" in refused(read_log, tmp_path / "link.nc")


def test_what_a_shell_hands_over_is_read(tmp_path: Path) -> None:
    read, write = os.pipe()
    os.write(write, b"a = 1\n")
    os.close(write)
    assert toml(Path(f"/dev/fd/{read}")) == {"a": 1}
    os.close(read)


def test_rows_among_empty_lines_keep_their_line_numbers(tmp_path: Path) -> None:
    lines = [b"time_s,t_tank_degC", b"", b"0,25", b"", b"", b"1,26", b"2,27"]
    for end in (b"\n", b"\r\n"):
        (tmp_path / "a.csv.xz").write_bytes(lzma.compress(end.join(lines)))
        assert read_csv_table(tmp_path / "a.csv.xz").lines.tolist() == [3, 6, 7]


@pytest.mark.parametrize(
    ("check", "most"),
    [
        (lambda size: limits.check_size(size, file="a"), 1 << 20),
        (lambda size: limits.check_size(size, file="a", most=4096), 4096),
        (lambda size: limits.check_unpacked(1, size, file="a"), 1 << 20),
        (lambda depth: limits.check_content(json.loads("[" * depth + "]" * depth)), 64),
        (lambda size: limits.number_within({"a": size}, "a", 0, 7), 7),
        (lambda size: limits.number_within({"a": -size}, "a", -7, 0), 7),
        (lambda size: limits.array_within({"a": [0, -size]}, "a", 7), 7),
        (lambda size: limits.array_within({"a": [0, size]}, "a", 7), 7),
    ],
)
def test_a_limit_itself_is_within_it(
    check: Callable[[int], object], most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "MOST_BYTES", 1 << 20)
    check(most)
    with pytest.raises((UserError, ValueError)):
        check(most + 1)


def test_what_is_packed_may_grow_200_times() -> None:
    limits.check_unpacked(1 << 20, 200 << 20, file="a")
    with pytest.raises(UserError, match="210 MB or more from 1049 kB"):
        limits.check_unpacked(1 << 20, (200 << 20) + 1, file="a")


@pytest.mark.parametrize(("size", "left"), [(6, 0), (7, 0), (8, 1), (20, 13)])
def test_a_byte_more_than_the_limit_is_read_and_no_further(size: int, left: int) -> None:
    stream = io.BytesIO(bytes(size))
    assert len(limits.read_within(stream, 6)) == size - left
    assert len(stream.read()) == left


def test_a_table_may_have_as_many_columns_as_its_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tables, "MOST_COLUMNS", 3)
    wide = tmp_path / "b.csv"
    wide.write_text("time_s,a,b,c\n0,1,2,3\n")
    assert "has 4 names, more than 3" in refused(read_csv_table, wide)
    for names in (["time_s", "a", "b"], ["time_s", "a", "b", "c"]):
        parquet.write_table(pa.table({name: [0.0, 1.0] for name in names}), tmp_path / "a.parquet")
        if len(names) > 3:
            assert "has 4 columns, more than 3" in refused(tables.read_parquet_table, tmp_path / "a.parquet")
        else:
            assert len(tables.read_parquet_table(tmp_path / "a.parquet").lines) == 2


def test_a_file_of_as_many_members_as_its_limit_is_checked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "a.nc"
    with h5py.File(path, "w") as file:
        for name in "abc":
            file[name] = [1.0, 2.0]
    for most in (3, 2):
        monkeypatch.setattr(netcdf, "_MOST_MEMBERS", most)
        if most < 3:
            assert "has more than 2 members" in refused(netcdf.check_netcdf, path)
        else:
            netcdf.check_netcdf(path)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere files are read in the process itself")
@pytest.mark.parametrize(
    ("read", "said"),
    [(lambda path: os._exit(1), "its reader crashed"), (lambda path: time.sleep(600), "not come to an end"),
     (lambda path: int("x"), "invalid literal")],
)  # fmt: skip
def test_a_reader_that_crashes_or_never_returns_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, read: Callable[[Path], Any], said: str
) -> None:
    (tmp_path / "a.mat").write_bytes(b"a")
    monkeypatch.setattr(limits, "_READ_S", 0.5)
    with pytest.raises(ValueError, match=said):
        limits.in_own_process(read, tmp_path / "a.mat")


def test_a_file_that_is_sound_is_read_in_a_process_of_its_own(tmp_path: Path) -> None:
    assert (limits.in_own_process(lambda path: os.getpid(), SCRIPT) == os.getpid()) == (
        sys.platform != "linux"
    )
