"""Materials from grasps: scikit-learn estimators on grasp records, and the one harness that scores them.

Every classifier takes a Grasps record as ``X`` and material names as ``y`` (default: the record's own), and
follows the scikit-learn contract: ``fit``, ``predict``, ``predict_proba``, ``classes_``, ``get_params``,
``clone``.
"""

from thermogrip import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(__name__)
