"""Transfer: trained in one situation, tested in another room, on other blocks, with another gripper.

Random splits by grasp ask how well a classifier knows the day on which it was trained.  Here the training
grasps are those of one situation, and each *target* is a situation of its own; the first is best the same one
again, with fresh grasps, so that what another loses to it is the price of the change.  A test record is
answered by the training record at its temperatures, as for ``compare --test``.

Each training set is one repeat on the same test grasps.  Intervals are over test grasps; what another
training set would change stands beside them as the spread over those given.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from thermogrip.classify.decisions.predict import Row
from thermogrip.classify.estimators.base import GraspClassifier
from thermogrip.classify.evaluation.comparison import Comparison
from thermogrip.classify.evaluation.harness import evaluate
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.parallel import Progress, Workers, sub_progress
from thermogrip.datasets.schema import Grasps, log_name

__all__ = ["Transfer", "transfer"]


@dataclass(frozen=True)
class Transfer:
    """What was said of each target.

    Attributes
    ----------
    comparison : Comparison
        Conditions are ``target: record``, repeats are training sets.
    targets : dict of str to tuple of str
        The conditions of each target.
    """

    comparison: Comparison
    targets: Mapping[str, tuple[str, ...]]

    def table(self) -> list[Row]:
        """Return the row of scores of each classifier on each target, with ``target`` in front.

        As of :meth:`Comparison.scores`; ``sd_over_splits`` is over the training sets.
        """
        return [
            {"target": target} | self.comparison.pool(name, conditions)
            for name in self.comparison.classifiers
            for target, conditions in self.targets.items()
        ]


def transfer(
    classifiers: Mapping[str, GraspClassifier],
    training: Sequence[Sequence[Grasps]],
    targets: Mapping[str, Sequence[Grasps]],
    *,
    seed: int = 0,
    workers: Workers = 1,
    progress: Progress | None = None,
) -> Transfer:
    """Return what classifiers that were trained in one situation say in others.

    Parameters
    ----------
    classifiers : dict of str to GraspClassifier
        Unfitted.
    training : sequence of sequences of Grasps
        Training sets, each a record a condition.
    targets : dict of str to sequence of Grasps
        Test records of each situation, at temperatures that a training record has.
    seed, workers, progress : optional
        As for :func:`~thermogrip.classify.evaluation.harness.evaluate`.

    Raises
    ------
    UserError
        If there is no training set or target, or a test grasp is a training grasp.

    Examples
    --------
    >>> from thermogrip.classify import make_classifier
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> files = load_example_grasps()
    >>> models = {"pca-lda": make_classifier("pca-lda")}
    >>> found = transfer(models, [[files["exp2_dT20"]]], {"another session": [files["exp3B_obj28_grip48"]]})
    >>> [(row["target"], row["n"], row["accuracy"] > 0.9) for row in found.table()]
    [('another session', 24, True)]
    """
    if not training or not targets or not all(targets.values()):
        raise UserError("nothing to train on or to test", hint="give at least one of each")
    named = {name: [f"{name}: {log_name(g)}" for g in records] for name, records in targets.items()}
    tests = [
        record.assign_attrs(name=condition)
        for name, records in targets.items()
        for record, condition in zip(records, named[name])
    ]
    parts = [
        evaluate(
            classifiers,
            records,
            test=tests,
            seed=seed,
            workers=workers,
            probe=False,
            progress=sub_progress(progress, k / len(training), (k + 1) / len(training)),
        )
        for k, records in enumerate(training)
    ]
    joined = Comparison(
        split="files",
        repeats=len(parts),
        seed=seed,
        predictions=tuple(row | {"repeat": k} for k, part in enumerate(parts) for row in part.predictions),
        times=tuple(row | {"repeat": k} for k, part in enumerate(parts) for row in part.times),
        notes=tuple(dict.fromkeys(note for part in parts for note in part.notes)),
    )
    return Transfer(joined, {name: tuple(conditions) for name, conditions in named.items()})
