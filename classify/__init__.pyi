import typing

from thermogrip.classify.decisions.next_touch import choose_next_touch as choose_next_touch
from thermogrip.classify.decisions.predict import Answer as Answer
from thermogrip.classify.decisions.predict import answer as answer
from thermogrip.classify.decisions.stopping_rule import Stream as Stream
from thermogrip.classify.decisions.stopping_rule import load_stop_rule as load_stop_rule
from thermogrip.classify.estimators import CLASSIFIERS as CLASSIFIERS
from thermogrip.classify.estimators.base import GraspClassifier as GraspClassifier
from thermogrip.classify.estimators.base import Note as Note
from thermogrip.classify.estimators.base import as_array as as_array
from thermogrip.classify.estimators.registry import load_classifier as load_classifier
from thermogrip.classify.estimators.registry import make_classifier as make_classifier
from thermogrip.classify.estimators.registry import save_classifier as save_classifier
from thermogrip.classify.evaluation.harness import evaluate as evaluate

if typing.TYPE_CHECKING:  # doors of 0.1.0, which are found and not listed
    from thermogrip.classify.decisions.next_touch import advise_touches as advise_touches
    from thermogrip.classify.decisions.predict import classify_grasps as classify_grasps
    from thermogrip.classify.decisions.predict import write_predictions as write_predictions
    from thermogrip.classify.decisions.stopping_rule import StopRule as StopRule
    from thermogrip.classify.decisions.stopping_rule import learn_stop_rule as learn_stop_rule
    from thermogrip.classify.decisions.stopping_rule import session_stop as session_stop
    from thermogrip.classify.estimators.base import join_grasps as join_grasps
    from thermogrip.classify.estimators.lda import ArrayClassifier as ArrayClassifier
    from thermogrip.classify.estimators.registry import can_be_saved as can_be_saved
    from thermogrip.classify.evaluation.comparison import Comparison as Comparison
