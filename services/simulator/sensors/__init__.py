"""Sensors of the simulated robot."""
