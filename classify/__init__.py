"""Materials from grasps: scikit-learn estimators on grasp records, and the one harness that scores them.

Every classifier takes a Grasps record as ``X`` and material names as ``y`` (default: the record's own), and
follows the scikit-learn contract: ``fit``, ``predict``, ``predict_proba``, ``classes_``, ``get_params``,
``clone``.
"""

from thermogrip import lazy_exports

# doors of 0.1.0, which are found and not listed
_ALSO = {
    "decisions.next_touch": ("advise_touches",),
    "decisions.predict": ("write_predictions",),
    "decisions.stopping_rule": ("StopRule", "learn_stop_rule", "session_stop"),
    "estimators.base": ("join_grasps",),
    "estimators.features": ("extract_features",),
    "estimators.lda": ("ArrayClassifier",),
    "estimators.registry": ("can_be_saved",),
    "evaluation.comparison": ("Comparison",),
}

__all__, __getattr__, __dir__ = lazy_exports(__name__, _ALSO)
