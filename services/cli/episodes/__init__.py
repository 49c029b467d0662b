"""Episodes of a command: requested, recorded and reported."""
