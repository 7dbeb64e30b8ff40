"""Classifiers by name, votes of several, and the same predictions after a file."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from thermogrip.classify import CLASSIFIERS, load_classifier, make_classifier, save_classifier
from thermogrip.classify.estimators.base import GraspClassifier
from thermogrip.classify.estimators.lda import ArrayClassifier
from thermogrip.classify.estimators.registry import can_be_saved
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps
from thermogrip.sysid.effusivity.gripper_model import GripperModel, load_default_gripper


@pytest.mark.parametrize("name", ["bayes", "features-lda", "pca-lda", "lstm"])
@pytest.mark.parametrize("materials", [("copper", "wood"), ("copper", "iron", "wood")])
def test_a_saved_classifier_predicts_the_same_bits(
    name: str, materials: tuple[str, ...], tmp_path: Path, make_touches: Callable[..., Grasps]
) -> None:
    params = {"epochs": 3, "hidden": 5, "series_per_class": 10} if name == "lstm" else {}
    grasps = make_touches(materials)
    model = make_classifier(name, **params).fit(grasps)
    again = load_classifier(save_classifier(model, tmp_path / "a" / "model"))
    assert np.array_equal(model.predict_log_proba(grasps), again.predict_log_proba(grasps))
    assert again.get_params() == model.get_params()
    assert again.classes_.tolist() == list(materials)
    resaved = load_classifier(save_classifier(again, tmp_path / "b"))
    assert np.array_equal(resaved.predict_proba(grasps), model.predict_proba(grasps))


def test_the_network_is_safetensors_and_everything_else_json(
    tmp_path: Path, three: Grasps, make_tiny_lstm: Callable[..., GraspClassifier]
) -> None:
    save_classifier(make_tiny_lstm(epochs=1).fit(three), tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["classifier.json", "weights.safetensors"]
    head = json.loads((tmp_path / "classifier.json").read_text())
    assert (head["schema"], head["name"], head["classes"]) == (
        "thermogrip.classifier",
        "lstm",
        ["copper", "iron", "wood"],
    )


def test_an_unknown_name_is_refused_with_those_there_are() -> None:
    with pytest.raises(UserError, match="no classifier is called 'svm'; use posterior, bayes, features-lda"):
        make_classifier("svm")
    with pytest.raises(UserError, match="bayes has no parameter 'depth'; it has shrinkage"):
        make_classifier("bayes", depth=3)


def test_every_name_makes_a_classifier_without_its_heavy_packages() -> None:
    code = (
        "import sys; import thermogrip.classify as c; before = 'sklearn' in sys.modules;"
        "[c.make_classifier(n, quick=True) for n in c.CLASSIFIERS];"
        "print(before, 'torch' in sys.modules, 'emcee' in sys.modules, 'casadi' in sys.modules)"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.split() == ["False"] * 4
    names = {"posterior", "bayes", "features-lda", "pca-lda", "lstm", "lstm-paper"}
    assert set(CLASSIFIERS) == names | {"svm-pca", "rocket", "forest"}


def test_what_cannot_be_saved_is_refused_before_it_is_trained() -> None:
    kept = {name for name in CLASSIFIERS if can_be_saved(make_classifier(name))}
    assert kept == {"posterior", "bayes", "features-lda", "pca-lda", "lstm", "lstm-paper"}
    assert not can_be_saved(make_classifier("sklearn.ensemble:RandomForestClassifier"))


def test_a_path_with_a_colon_is_the_path_with_a_dot(three: Grasps) -> None:
    by_colon, by_dot = (make_classifier(f"sklearn.neighbors{c}NearestCentroid").fit(three) for c in ":.")
    np.testing.assert_array_equal(by_colon.predict_proba(three), by_dot.predict_proba(three))


def test_a_path_may_name_an_object_which_stays_as_it_is(
    three: Grasps, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "of_the_lab.py").write_text(
        "from sklearn.neighbors import KNeighborsClassifier\n"
        "from sklearn.pipeline import make_pipeline\n"
        "from sklearn.preprocessing import StandardScaler\n"
        "MODEL, WORD = make_pipeline(StandardScaler(), KNeighborsClassifier(3)), 'a word'\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    model = make_classifier("of_the_lab:MODEL").fit(three)
    assert not hasattr(sys.modules["of_the_lab"].MODEL, "classes_")
    assert model.model_.steps[-1][1].n_neighbors == 3
    with pytest.raises(UserError, match="'of_the_lab:WORD' is no scikit-learn classifier"):
        make_classifier("of_the_lab:WORD")


def test_what_would_run_code_is_not_saved(tmp_path: Path, three: Grasps) -> None:
    with pytest.raises(UserError, match="cannot be saved"):
        save_classifier(ArrayClassifier("sklearn.neighbors.NearestCentroid").fit(three), tmp_path)


DAMAGES: dict[str, Callable[[dict[str, Any]], object]] = {
    **{
        f"no {key}": lambda head, key=key: head.pop(key) for key in ("params", "arrays", "numbers", "classes")
    },
    "an import path": lambda head: head.update(name="modulefinder:ModuleFinder", params={}),
    "empty arrays": lambda head: head.update(arrays={}),
    "fewer classes": lambda head: head["classes"].pop(),
    "more classes": lambda head: head["classes"].append("zirconium"),
    "shorter array": lambda head: head["arrays"]["center_"].pop(),
    "word for number": lambda head: head["arrays"]["scale_"].insert(0, "wide"),
    "sensors": lambda head: head.update(sensors="both"),
}


def damaged(folder: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """Change the file of a saved classifier."""
    head = json.loads((folder / "classifier.json").read_text())
    change(head)
    (folder / "classifier.json").write_text(json.dumps(head))
    return folder


@pytest.mark.parametrize("name", ["bayes", "features-lda", "pca-lda"])
def test_a_damaged_file_is_refused_in_one_line(name: str, three: Grasps, tmp_path: Path) -> None:
    model = make_classifier(name).fit(three)
    for what, change in DAMAGES.items():
        if (name, what) == ("pca-lda", "no numbers"):
            continue  # it has none
        folder = damaged(save_classifier(model, tmp_path / what), change)
        with pytest.raises(UserError, match=r"classifier\.json: is damaged") as caught:
            load_classifier(folder)
        assert "\n" not in str(caught.value), what
        assert "train the classifier again" in str(caught.value)
    assert "modulefinder" not in sys.modules  # reading a file imports nothing that it names


def test_a_network_of_other_classes_is_refused(
    three: Grasps, tmp_path: Path, make_tiny_lstm: Callable[..., GraspClassifier]
) -> None:
    folder = save_classifier(make_tiny_lstm(epochs=1).fit(three), tmp_path)
    with pytest.raises(UserError, match=r"is damaged .readout"):
        load_classifier(damaged(folder, lambda head: head["classes"].pop()))


@pytest.mark.parametrize(("name", "value"), [("prior_unknown", "x"), ("priors", {"wood": "x"})])
def test_a_damaged_parameter_is_refused(
    name: str, value: object, known: GraspClassifier, tmp_path: Path
) -> None:
    folder = save_classifier(known, tmp_path)
    with pytest.raises(UserError):
        load_classifier(damaged(folder, lambda head: head["params"].update({name: value})))


def test_a_missing_folder_and_broken_weights_are_the_users_error(
    tmp_path: Path, three: Grasps, make_tiny_lstm: Callable[..., GraspClassifier]
) -> None:
    with pytest.raises(UserError, match="is not a folder"):
        load_classifier(tmp_path / "nowhere")
    save_classifier(make_tiny_lstm(epochs=1).fit(three), tmp_path)
    (tmp_path / "weights.safetensors").write_bytes(b"not tensors")
    with pytest.raises(UserError, match=r"weights\.safetensors: is damaged"):
        load_classifier(tmp_path)


@pytest.mark.parametrize("value", [-1e9, 1e9, 1e99, 1e999])
@pytest.mark.parametrize("name", ["z_outer", "e_inner", "ln_h", "onset"])
def test_a_gripper_that_no_material_makes_is_refused(name: str, value: float) -> None:
    content = load_default_gripper().to_dict()
    inner = next(part for part in (content, content["stack"], content["spreads"]) if name in part)
    inner[name] = value
    with pytest.raises(UserError, match=re.escape(f"{name} is {value:g}, not ")):
        GripperModel.from_dict(content)
