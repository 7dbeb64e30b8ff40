r"""Classifiers by name, and on disk.

A saved classifier is a folder: ``classifier.json`` (what it is, parameters, classes, small arrays), beside it
``weights.safetensors`` for the LSTM and ``device.json`` for the effusivity posterior.  All are data: reading
one runs no code, and it can be read by anything that reads JSON.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermogrip.classify.estimators import CLASSIFIERS, check_name
from thermogrip.classify.estimators.base import GraspClassifier
from thermogrip.datasets.errors import UserError, known_names, reading
from thermogrip.datasets.files import make_folder, read_bytes, read_json, write_atomic, write_json
from thermogrip.datasets.limits import array_within
from thermogrip.datasets.schema import make_grasps

_SAVED = "posterior, bayes, features-lda, pca-lda, lstm, lstm-paper"
_NETWORKS = ("lstm", "lstm-paper")
_CLASSIFIER_SCHEMA, _CLASSIFIER_VERSION = "thermogrip.classifier", 1
_RUNTIME_ONLY = ("device",)  # a start for the next fit, not part of what was learnt
_RETIRED = ("finish", "gripper")  # of files of 0.2.0: what they stated is decided grasp by grasp


def make_classifier(
    name: str, *, quick: bool = False, seed: int | None = None, **params: Any
) -> GraspClassifier:
    """Return an unfitted classifier.

    Parameters
    ----------
    name : str
        One of :data:`CLASSIFIERS`; or the import path of a scikit-learn classifier or pipeline,
        ``module:Class`` or ``module:object`` (the module is imported, so name only what you trust).
    quick : bool, optional
        200 epochs in place of 2000 for the LSTM; the others are quick as they are.
    seed : int, optional
        ``random_state``, where the classifier has one.
    **params
        Parameters of the classifier.

    Raises
    ------
    UserError
        If there is no such classifier or parameter.

    Examples
    --------
    >>> make_classifier("lstm", quick=True).epochs
    200
    """
    if name not in CLASSIFIERS and ("." in name or ":" in name):
        from thermogrip.classify.estimators.lda import ArrayClassifier, imported_estimator

        imported_estimator(name, params)  # a misspelt path is found here, not in the middle of a run
        return ArrayClassifier(name, params=params or None, random_state=seed)
    check_name(name)
    module, kind_name = CLASSIFIERS[name]
    kind: Any = getattr(import_module(f"thermogrip.classify.{module}"), kind_name)
    parameters = inspect.signature(kind.__init__).parameters
    for key in params:
        if key not in parameters:
            hint = known_names(key, [k for k in parameters if k != "self"], "it has {}")
            raise UserError(f"{name} has no parameter {key!r}", hint=hint)
    if quick and "epochs" in parameters:
        from thermogrip.classify.estimators.lstm import QUICK_EPOCHS

        params = {"epochs": QUICK_EPOCHS} | params
    if seed is not None and "random_state" in parameters:
        params = {"random_state": seed} | params
    made: GraspClassifier = kind(**params)
    return made


def classifier_name(classifier: GraspClassifier) -> str:
    """Return the name of a classifier in tables: its registry name, or its own."""
    for name, (_, kind) in CLASSIFIERS.items():
        if type(classifier).__name__ == kind:
            return name
    inner = getattr(classifier, "estimator", None)
    if steps := getattr(inner, "steps", None):  # of a pipeline: its last one decides
        inner = steps[-1][1]
    return inner if isinstance(inner, str) else type(inner if inner is not None else classifier).__name__


def trainable(
    names: Iterable[str], *, quick: bool = False, seed: int | None = None
) -> tuple[dict[str, GraspClassifier], tuple[UserError, ...]]:
    """Return unfitted classifiers by name, and for those that need a package that is not installed, the
    error."""
    models, left_out = {}, []
    for name in names:
        model = make_classifier(name, quick=quick, seed=seed)
        try:
            model.check_installed()
        except UserError as error:
            left_out.append(error)
        else:
            models[name] = model
    return models, tuple(left_out)


def can_be_saved(classifier: GraspClassifier) -> bool:
    """Return whether a classifier can become a file that is data alone."""
    return type(classifier).get_state is not GraspClassifier.get_state


def save_classifier(classifier: GraspClassifier, folder: str | Path) -> Path:
    """Write a fitted classifier to a folder and return the folder.

    Parameters
    ----------
    classifier : GraspClassifier
        A fitted one.
    folder : str or Path
        Made if missing.

    Raises
    ------
    UserError
        If this kind cannot be saved, or the folder cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> model = make_classifier("features-lda").fit(load_example_grasps()["exp2_dT20"])
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     [file.name for file in save_classifier(model, folder).iterdir()]
    ['classifier.json']
    """
    classifier._check_fitted()
    name = classifier_name(classifier)
    if name not in CLASSIFIERS or not can_be_saved(classifier):
        raise UserError(f"{name} cannot be saved", hint="compare it, or train one of " + _SAVED)
    numbers, arrays = classifier.get_state()
    path = Path(folder)
    make_folder(path)
    classifier.save_parts(path)
    content = {
        "name": name,
        "params": {k: v for k, v in classifier.get_params(deep=False).items() if k not in _RUNTIME_ONLY},
        "classes": [str(c) for c in classifier.classes_],
        "sensors": getattr(classifier, "sensors_", None),
        "numbers": numbers,
        "arrays": {},
    }
    if name in _NETWORKS:
        from safetensors.numpy import save

        tensors = {key: np.ascontiguousarray(value) for key, value in arrays.items()}
        write_atomic(path / "weights.safetensors", save(tensors))
    else:
        content["arrays"] = {key: np.asarray(value, dtype=float).tolist() for key, value in arrays.items()}
    # last, since it makes the folder a classifier
    write_json(path / "classifier.json", content, schema=_CLASSIFIER_SCHEMA, version=_CLASSIFIER_VERSION)
    return path


def load_classifier(folder: str | Path) -> GraspClassifier:
    """Return the classifier that :func:`save_classifier` wrote; its predictions are the same to the last bit.

    Parameters
    ----------
    folder : str or Path
        What ``train --out`` or :func:`save_classifier` made.

    Raises
    ------
    UserError
        If the folder holds no classifier, or a part of it is missing or damaged.

    Examples
    --------
    >>> import tempfile
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> grasps = load_example_grasps()["exp2_dT20"]
    >>> model = make_classifier("features-lda").fit(grasps)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     again = load_classifier(save_classifier(model, folder))
    >>> bool((again.predict_proba(grasps) == model.predict_proba(grasps)).all())
    True
    """
    path = Path(folder)
    if not path.is_dir():
        raise UserError("is not a folder", file=path, hint="give the folder that train --out made")
    file = path / "classifier.json"
    content = read_json(file, _CLASSIFIER_SCHEMA, _CLASSIFIER_VERSION)
    with reading("is damaged", file=file, hint="train the classifier again"):
        if content["name"] not in CLASSIFIERS:  # never an import path: reading a file runs no code
            raise KeyError(content["name"])
        params = {key: value for key, value in content["params"].items() if key not in _RETIRED}
        classifier = make_classifier(content["name"], **params)
        classifier.classes_ = np.asarray([str(c) for c in content["classes"]])
        if content["name"] in _NETWORKS:
            arrays = _read_weights(path / "weights.safetensors")
        else:
            arrays = {key: array_within(content["arrays"], key) for key in content["arrays"]}
        if content.get("sensors") is not None:
            classifier.sensors_ = int(content["sensors"])
        classifier.set_state(content["numbers"], arrays)
        classifier.load_parts(path)
        if arrays:
            _check_answer(classifier)
    return classifier


def _check_answer(classifier: GraspClassifier) -> None:
    """Raise where a classifier whose numbers each may be cannot answer for a made grasp."""
    time = np.round(np.arange(-2.0, 10.05, 0.1), 9)
    rise = 23 + 12 * (1 - np.exp(-np.maximum(time, 0) / 2.5))
    second = [rise] if getattr(classifier, "sensors_", None) == 2 else None
    grasp = make_grasps(time, [rise], ["made"], name="made", t_object=[43.0], t_surface_2=second)
    with suppress(UserError), np.errstate(all="ignore"):  # such as: the training had longer contacts
        log_p, unknown, *_ = classifier.answered(grasp)
        if log_p.shape != (1, len(classifier.classes_)) or unknown.shape != (1,):
            raise ValueError("its numbers give no answer")


def _read_weights(file: Path) -> dict[str, NDArray[Any]]:
    from safetensors.numpy import load

    with reading("is damaged", file=file, hint="train the classifier again"):
        arrays = dict(load(read_bytes(file)))
        for name in arrays:
            array_within(arrays, name)
        return arrays
