"""Classification of materials from grasps: estimators and the harness that compares them."""
