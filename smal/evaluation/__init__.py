"""How well the method does: statistics of runs."""
