"""Experiments with the method: evaluation, matching of image folders, and model reports."""
