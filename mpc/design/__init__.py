"""What is wanted from a controller, and what it is made of."""
