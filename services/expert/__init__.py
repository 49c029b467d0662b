"""Scripted expert: a client that drives by the true pose, with the four keys of a person."""
