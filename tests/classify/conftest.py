"""Small touches with known answers: an exponential rise whose size and speed depend on the material."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from thermogrip.classify.estimators.base import GraspClassifier
from thermogrip.classify.estimators.lda import ArrayClassifier, FeaturesLda, PcaLda
from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.classify.estimators.registry import make_classifier
from thermogrip.datasets.schema import Grasps, make_grasps
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper

RISES = {"copper": (0.60, 0.8), "iron": (0.45, 1.2), "wood": (0.15, 2.0), "zinc": (0.52, 1.0)}


def touches(
    materials: tuple[str, ...] = ("copper", "iron", "wood"),
    *,
    each: int = 8,
    noise: float = 0.03,
    t_object: float = 43.0,
    end: float = 10.0,
    step: float = 0.2,
    seed: int = 0,
    name: str = "touches",
    shuffled: bool = False,
) -> Grasps:
    """Return ``each`` touches of every material at 23 degC; 5 of 8 are marked train."""
    rng = np.random.default_rng(seed)
    t = np.arange(-2.0, end + 1e-9, step)
    rows, labels, split = [], [], []
    for material in materials:
        share, tau = RISES[material]
        for k in range(each):
            level = 23 + 0.3 * rng.standard_normal()
            onset, size = 0.08 * rng.standard_normal(), share * (1 + 0.04 * rng.standard_normal())
            rise = -np.expm1(-np.maximum(t - onset, 0) / tau)
            rows.append(level + (t_object - level) * size * rise + noise * rng.standard_normal(t.size))
            labels.append(material)
            split.append("train" if k < round(0.625 * each) else "test")
    if shuffled:
        labels = [labels[i] for i in rng.permutation(len(labels))]
    n = len(rows)
    return make_grasps(
        t,
        rows,
        [f"{name}-{i}" for i in range(n)],
        name=name,
        material=labels,
        split=split,
        t_object=np.full(n, t_object),
        t_gripper=np.full(n, 23.0),
    )


@pytest.fixture
def make_touches() -> Callable[..., Grasps]:
    """The maker of synthetic touches."""
    return touches


@pytest.fixture(scope="session")
def three() -> Grasps:
    """Eight touches each of copper, iron and wood."""
    return touches()


@pytest.fixture(scope="session")
def known() -> PosteriorClassifier:
    """The posterior of the bundled gripper."""
    return PosteriorClassifier().with_device(load_default_gripper())


def tiny_lstm(**params: object) -> GraspClassifier:
    """Return a network that trains in a second."""
    return make_classifier(
        "lstm",
        **(
            {"epochs": 100, "hidden": 12, "series_per_class": 24, "batch": 24, "learning_rate": 0.006}
            | params
        ),
    )


ESTIMATORS: dict[str, Callable[[], GraspClassifier]] = {
    "bayes": lambda: make_classifier("bayes"),
    "features-lda": FeaturesLda,
    "pca-lda": PcaLda,
    "logistic": lambda: ArrayClassifier(params={"max_iter": 1000}),
    "nearest": lambda: ArrayClassifier("sklearn.neighbors.NearestCentroid"),
    "lstm": tiny_lstm,
}


@pytest.fixture(params=list(ESTIMATORS))
def estimator(request: pytest.FixtureRequest) -> GraspClassifier:
    """Every classifier that needs no calibrated gripper, unfitted."""
    return ESTIMATORS[request.param]()


@pytest.fixture
def make_tiny_lstm() -> Callable[..., GraspClassifier]:
    """The maker of small networks."""
    return tiny_lstm
