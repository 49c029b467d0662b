"""Actuation of any wheeled robot: the choice of the obeyed command, and the episodes."""
