"""What a plant can be: thermal networks, classes of the user's own, linear, polynomial and neural models."""
