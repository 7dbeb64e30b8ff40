"""Without PyTorch every verb works but the training of an LSTM, which says in one line what to install."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from thermogrip.classify import make_classifier, save_classifier
from thermogrip.classify.estimators import base
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.grasp_files import read_grasps
from thermogrip.studies import demo

HINT = 'lstm is trained with torch, which is not installed; pip install "thermogrip[lstm]"'


@pytest.fixture
def no_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    hidden = {"torch", "aeon"}
    monkeypatch.setattr(base, "find_spec", lambda name: None if name in hidden else find_spec(name))


@pytest.mark.usefixtures("no_torch")
@pytest.mark.parametrize(
    "words",
    [
        ["train", "grasps.csv", "--classifier", "lstm", "--out", "made"],
        ["train", "grasps.csv", "--classifier", "lstm-paper", "--out", "made"],
        ["compare", "grasps.csv", "--classifiers", "lstm", "--out", "made"],
        ["paper", "--out", "made"],
    ],
    ids=lambda words: " ".join(words[:4]),
)
def test_an_lstm_that_cannot_be_trained_is_reported_before_any_work(bench, words: list[str]) -> None:
    done = bench.run(*words)
    assert (done.code, done.out, done.err) == (2, "", f"thermogrip: {HINT}\n")
    assert list((bench.path).glob("made/*")) == []


@pytest.mark.usefixtures("no_torch")
@pytest.mark.parametrize("name", ["lstm", "rocket"])
def test_fit_names_the_extra_that_brings_what_it_needs(bench, name: str) -> None:
    with pytest.raises(UserError, match=rf'{name} is trained with .*; pip install "thermogrip\[{name}\]"$'):
        make_classifier(name).fit(read_grasps(bench.path / "grasps.csv"))


def test_a_saved_lstm_answers_without_torch(bench) -> None:
    grasps = read_grasps(bench.path / "grasps.csv")
    save_classifier(make_classifier("lstm", epochs=1, hidden=4).fit(grasps), bench.path / "model")
    code = (
        "import sys\n"
        "class NotInstalled:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] == 'torch':\n"
        "            raise ModuleNotFoundError(name)\n"
        "sys.meta_path.insert(0, NotInstalled())\n"
        "from thermogrip.cli.main import main\n"
        "sys.exit(main(['classify', 'model', 'grasps.csv', '--out', 'said.csv']))"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=bench.path)


@pytest.mark.usefixtures("no_torch")
def test_compare_by_default_leaves_the_lstm_out_and_reports_it(bench) -> None:
    done = bench.run("compare", "grasps.csv", "--repeats", "0", "--out", "made", "--json")
    assert done.code == 0, done.err
    assert done.err.count(f"warning: left out: {HINT}") == 1
    shipped = json.loads(done.out)["splits"]["shipped"]
    scored = {row["classifier"] for row in shipped["scores"]}
    assert scored == {"posterior", "bayes", "features-lda", "pca-lda"}
    assert shipped["notes"] == [f"left out: {HINT}"]
    page = Path(bench.path / "made/report.html").read_text(encoding="utf-8")
    assert "lstm is trained with torch, which is not installed" in page


def test_the_demo_compares_an_lstm_too() -> None:
    models, left_out = demo.compared_models(0)
    assert (tuple(models), left_out) == (("posterior", "bayes", "lstm"), ())


@pytest.mark.usefixtures("no_torch")
def test_the_demo_compares_what_is_installed() -> None:
    models, left_out = demo.compared_models(0)
    assert (tuple(models), left_out) == (("posterior", "bayes"), (f"left out: {HINT}",))
