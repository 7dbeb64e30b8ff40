"""A controller against a plant that is not its model."""
