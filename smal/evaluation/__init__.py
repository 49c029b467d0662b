"""Evaluation: ground truth, precision and recall, success rates, and baselines."""
