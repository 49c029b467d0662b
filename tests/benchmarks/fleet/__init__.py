"""Fleet: several simulated robots at once, on one instance of each service."""
