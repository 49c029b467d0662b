"""Evaluation on laps of a real robot: learn one lap, localize on the others, open loop."""
