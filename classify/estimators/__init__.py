"""Classifiers of grasps as scikit-learn estimators, by names that can be checked without loading one."""

from __future__ import annotations

from thermogrip.datasets.errors import UserError, known_names

CLASSIFIERS = {
    "posterior": ("estimators.posterior", "PosteriorClassifier"),
    "bayes": ("estimators.bayes", "BayesClassifier"),
    "features-lda": ("estimators.lda", "FeaturesLda"),
    "pca-lda": ("estimators.lda", "PcaLda"),
    "forest": ("estimators.lda", "ForestClassifier"),
    "svm-pca": ("estimators.lda", "SvmPca"),
    "rocket": ("estimators.lda", "RocketClassifier"),
    "lstm": ("estimators.lstm", "LstmClassifier"),
    "lstm-paper": ("estimators.lstm", "PaperLstm"),
}
"""Name on the command line -> module and class."""


def check_name(name: str) -> None:
    """Raise :class:`UserError` unless a classifier of ours has this name."""
    if name not in CLASSIFIERS:
        raise UserError(
            f"no classifier is called {name!r}",
            hint=known_names(name, CLASSIFIERS, "use {}, or module:Class or module:object"),
        )


def classifier_names(value: str | None) -> str | None:
    """Return a list of classifiers (commas between them, or None) if each may be one; import paths are tried
    later."""
    for name in (value or "").split(","):
        if name.strip() and not set(":.") & set(name):
            check_name(name.strip())
    return value
