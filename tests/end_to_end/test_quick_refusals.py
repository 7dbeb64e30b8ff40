"""What a look at the words or the disk can refuse is refused before a room is loaded."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from tests.end_to_end.mistakes import MISTAKES, mistaken_folder

HEAVY = ("torch", "sklearn", "numba", "casadi", "xarray", "scipy", "matplotlib")
ASK = f"""
import contextlib, io, json, sys
from thermogrip.cli.main import main
for words in json.load(sys.stdin):
    with contextlib.redirect_stderr(io.StringIO()) as said:
        code = main(words.split())
    print(json.dumps([words, code, said.getvalue(), [name for name in {HEAVY} if name in sys.modules]]))
"""
TABLES = ("values", "units", "scales", "bounds", "noise", "offsets", "nuisance", "valid", "scores")
PLANT = {key: {} for key in TABLES} | {"dt": 1.0, "free": [], "covariance": None, "reference": None}
PLANT |= {"logs": [], "verdict": ""}
CONTROLLER = {"schema": "thermogrip.controller", "version": 1, "design": {}, "notes": {}}
# What the folder holds, beside the empty folder m.
FILES = {
    "x.csv": "time_s\n",
    "r/samples.csv": "time_s\n",
    "b/batch.json": "{}",
    "deep.json": "[" * 50_000,
    "short.json": '{"schema": "thermogrip.plant", "version": 1}',
    "c.json": json.dumps(CONTROLLER | {"plant": PLANT, "design": {"dt": 1.0}}),
    "large.json": json.dumps(CONTROLLER | {"plant": PLANT, "design": {"dt": 1e200}}),
    "empty.csv": "",
    "binary.csv": "\0",
    "n.nc": "no",
    "n.toml": "a = " + "[" * 50_000,
}
# What is typed there -> what the line says.
REFUSED = {
    "nope": "No such command 'nope'; see thermogrip --help",
    "materials --draws 3": "No such option: --draws; see thermogrip materials --help",
    "classify nomodel x.csv --out p.csv": "nomodel: no such file or folder",
    "compare x.csv --classifiers bayes,bays --out o": "no classifier is called 'bays'",
    "identify nofile.csv --out p.json": "nofile.csv: no such file or folder",
    "identify x.csv --network nonet --out p.json": "no network 'nonet'",
    "identify x.csv --network n.toml --out p.json": "n.toml: is nested too deeply",
    "identify x.csv --network n.py --out p.json": "n.py: names no class",
    "identify x.csv --network n.py:Tank --out p.json": "n.py: no such file",
    "validate x.csv nofile.csv": "nofile.csv: no such file or folder",  # before plants are looked through
    "validate short.json x.csv --network n.py:": "n.py: names no class; write n.py:CLASS",
    "validate short.json x.csv nofile.csv@1:2": "nofile.csv@1:2: no such file or folder",
    "classify x.csv x.csv --out p.csv": "x.csv: is not a folder; give the folder that train",
    "validate deep.json x.csv": "deep.json: is nested too deeply",
    "validate short.json x.csv": "short.json: is not a whole plant (values: Field required)",
    "excite --kind optimal --minutes 5 --plant deep.json --out s.csv": "deep.json: is nested too deeply",
    "review deep.json": "deep.json: is nested too deeply",
    "review large.json": "large.json: design.dt is 1e+200, beyond",
    "identify empty.csv --out p.json": "empty.csv: is empty",
    "identify binary.csv@10:20 --out p.json": "binary.csv: is not text",
    "identify n.toml --out p.json": "n.toml: ending '.toml' is unknown",
    "simulate c.json n.nc --out s.csv": "c.json: is a controller, not a plant",
    "train x.csv --classifier bayes --out o": "x.csv: has a header but no rows",
    "classify m n.nc --out p.csv": "m/classifier.json: no such file",
    "compare m --out o": "m: holds no grasp files",
    "effusivity empty.csv --out o.csv": "empty.csv: its meta file is missing",
    "recover nodir": "nodir: no such file or folder",
    "recover m": "m: is no run folder",
    "recover b": "b: is a batch without a run; give the same batch command again",
    "recover x.csv": "x.csv: is no run folder",
    "recover r --out log.foo": "log.foo: cannot be written as a .foo file; name it log.nc",
    "identify x.csv --report r.txt --out p.json": "r.txt: cannot be written as a .txt file; name it r.html",
    "demo --out x.csv": "is a file",
    "materials unobtainium": "no material 'unobtainium'",
}


# What only the reader of a file can see, which a room is loaded for.
OF_READERS = {
    "review deep.json",
    "review large.json",
    "tune plant.json --spec typo.toml --out c.json",
    "run controller.json --target 38 --twin plant.json --guard loose.toml --out r",
    "identify n.toml --out p.json",
    "classify m n.nc --out p.csv",
    "compare m --out o",
    "identify binary.csv@10:20 --out p.json",
    "identify empty.csv --out p.json",
    "train x.csv --classifier bayes --out o",
    "identify long.csv.xz --disturbances t_ambeint",
    "validate plant.json bare.csv",
    "identify log.csv --inputs drvie",
    "identify log.csv@10:200 --outputs t_surfce",
}


def told(table: list[str], folder: Path) -> dict[str, str]:
    """Return the line on stderr of each mistake, in the order of the table."""
    at_once = [words for words in table if words not in OF_READERS]
    lines = _told(at_once, folder) | _told([w for w in table if w in OF_READERS], folder, at_once=False)
    return {words: lines[words] for words in table}


def _told(words: list[str], folder: Path, *, at_once: bool = True) -> dict[str, str]:
    """Return the line on stderr of each mistake: one line, code 2, and nothing heavy was imported for it, but
    for what the reader of a log or of grasps sees."""
    ask = [sys.executable, "-c", ASK]
    done = subprocess.run(
        ask, input=json.dumps(words), cwd=folder, capture_output=True, text=True, check=True
    )
    lines = {}
    for typed, code, said, loaded in map(json.loads, done.stdout.splitlines()):
        assert (code, said.count("\n")) == (2, 1), (typed, said)
        assert not (at_once and loaded), typed
        lines[typed] = said
    assert list(lines) == words
    return lines


def test_a_mistake_in_the_words_costs_no_import_of_a_room(tmp_path: Path) -> None:
    for folder in ("m", "r", "b"):
        (tmp_path / folder).mkdir()
    for name, content in FILES.items():
        (tmp_path / name).write_text(content)
    for words, said in told(list(REFUSED), tmp_path).items():
        assert REFUSED[words] in said
    assert {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")} == {"m", "r", "b", *FILES}


def test_what_people_mistype_is_mended_in_its_line(tmp_path: Path) -> None:
    mistaken_folder(tmp_path)
    before = {*tmp_path.rglob("*")}
    for words, said in told(list(MISTAKES), tmp_path).items():
        assert MISTAKES[words] in said, words
    assert {path for path in tmp_path.rglob("*") if "__pycache__" not in path.parts} == before
