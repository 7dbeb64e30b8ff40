"""Control: prediction model, observer, condensed QP, controller, PI baseline, tuning, review."""
