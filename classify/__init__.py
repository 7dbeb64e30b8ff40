"""Materials from grasps: scikit-learn estimators on grasp records, and the one harness that scores them.

Every classifier takes a Grasps record as ``X`` and material names as ``y`` (default: the record's own), and
follows the scikit-learn contract: ``fit``, ``predict``, ``predict_proba``, ``classes_``, ``get_params``,
``clone``.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

__all__ = [
    "CLASSIFIERS",
    "ArrayClassifier",
    "Comparison",
    "GraspClassifier",
    "as_array",
    "classify_grasps",
    "evaluate",
    "extract_features",
    "join_grasps",
    "load_classifier",
    "make_classifier",
    "save_classifier",
    "write_predictions",
]

_HOMES = {
    "CLASSIFIERS": "registry",
    "ArrayClassifier": "linear",
    "Comparison": "comparison",
    "GraspClassifier": "base",
    "as_array": "base",
    "classify_grasps": "predictions",
    "evaluate": "harness",
    "extract_features": "features",
    "join_grasps": "base",
    "load_classifier": "registry",
    "make_classifier": "registry",
    "save_classifier": "registry",
    "write_predictions": "predictions",
}


def __getattr__(name: str) -> Any:  # PEP 562: scikit-learn and torch load when they are asked for
    if name in _HOMES:
        return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
