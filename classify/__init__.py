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
    "Costs",
    "GraspClassifier",
    "StopRule",
    "Stream",
    "advise_touches",
    "as_array",
    "can_be_saved",
    "choose_next_touch",
    "classify_grasps",
    "evaluate",
    "extract_features",
    "join_grasps",
    "learn_stop_rule",
    "load_classifier",
    "load_stop_rule",
    "make_classifier",
    "name_or_unknown",
    "reasons",
    "save_classifier",
    "session_stop",
    "write_predictions",
]

_HOMES = {
    "CLASSIFIERS": "registry",
    "ArrayClassifier": "linear",
    "Comparison": "comparison",
    "GraspClassifier": "base",
    "Costs": "decide",
    "StopRule": "stopping",
    "Stream": "stream",
    "advise_touches": "decide",
    "as_array": "base",
    "choose_next_touch": "decide",
    "can_be_saved": "registry",
    "classify_grasps": "predictions",
    "evaluate": "harness",
    "extract_features": "features",
    "join_grasps": "base",
    "learn_stop_rule": "stopping",
    "load_classifier": "registry",
    "load_stop_rule": "stopping",
    "make_classifier": "registry",
    "name_or_unknown": "decide",
    "reasons": "strain",
    "save_classifier": "registry",
    "session_stop": "stream",
    "write_predictions": "predictions",
}


def __getattr__(name: str) -> Any:  # PEP 562: scikit-learn and torch load when they are asked for
    if name in _HOMES:
        return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
