"""Laps of a real robot: taught on one, asked on all others, open loop."""
