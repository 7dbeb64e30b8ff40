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
    "CLASSIFIERS": "estimators.registry",
    "ArrayClassifier": "estimators.lda",
    "Comparison": "evaluation.comparison",
    "GraspClassifier": "estimators.base",
    "Costs": "decisions.next_touch",
    "StopRule": "decisions.stopping_rule",
    "Stream": "decisions.online",
    "advise_touches": "decisions.next_touch",
    "as_array": "estimators.base",
    "choose_next_touch": "decisions.next_touch",
    "can_be_saved": "estimators.registry",
    "classify_grasps": "decisions.predict",
    "evaluate": "evaluation.harness",
    "extract_features": "estimators.features",
    "join_grasps": "estimators.base",
    "learn_stop_rule": "decisions.stopping_rule",
    "load_classifier": "estimators.registry",
    "load_stop_rule": "decisions.stopping_rule",
    "make_classifier": "estimators.registry",
    "name_or_unknown": "decisions.next_touch",
    "reasons": "decisions.explain",
    "save_classifier": "estimators.registry",
    "session_stop": "decisions.online",
    "write_predictions": "decisions.predict",
}


def __getattr__(name: str) -> Any:  # PEP 562: scikit-learn and torch load when they are asked for
    if name in _HOMES:
        return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
