"""Evaluation: ground truth, precision and recall, the protocol of drivers, and baselines."""
