"""From probabilities to answers: name or unknown, when to stop, where to touch next."""
