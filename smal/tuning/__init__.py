"""Choosing weights, lengths, penalties and thresholds of place recognition, with labels or without."""
