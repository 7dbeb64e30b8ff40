"""Classifiers of grasps as scikit-learn estimators, by name."""
