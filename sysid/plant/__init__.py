"""A model with its numbers: the plant, its file, its free run over a log, and logs on the model's grid."""
