"""Materials from grasps: scikit-learn estimators on grasp records, and the one harness that scores them.

Every classifier takes a Grasps record as ``X`` and material names as ``y`` (default: the record's own), and
follows the scikit-learn contract: ``fit``, ``predict``, ``predict_proba``, ``classes_``, ``get_params``,
``clone``.
"""

from thermogrip import lazy_exports

# doors of 0.1.0, which are found and not listed
_ALSO = {
    "advise_touches": "decisions.next_touch",
    "can_be_saved": "estimators.registry",
    "join_grasps": "estimators.base",
    "session_stop": "decisions.stopping_rule",
}

__all__, __getattr__, __dir__ = lazy_exports(__name__, _ALSO)
