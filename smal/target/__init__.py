"""Target detection: learned from the ends of drives, and applied during a run."""
